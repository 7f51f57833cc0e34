"""Scan orientation of a frame, one of eight: decided by features that break its symmetry, or reported as undecided.

Each orientation assigns other names to the marks found. Under the right one, their images fit (identification dots,
different marks), their coordinates fit (asymmetries larger than their standard deviations), and the writing around the
frame has the direction and place known from the camera. The log-likelihoods are summed. An orientation is decided only
if its odds against every other are a thousand to one. Among equal ones an unmirrored orientation has the higher prior.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy import ndimage
from scipy.special import gammaln

from measure.annotations.lines import Line, is_of_film, is_plate, signs
from measure.array_types import Array, Mask
from measure.fiducials.interior_orientation import fit_frame
from measure.fiducials.measure_frame import Frame
from measure.fiducials.options import SCATTER_DEGREES
from measure.geometry import POSES, UP_FROM_CAMERA, linear_scale, pose_in_camera, turn_by_quarters
from measure.marks.rendering import ROUGH_CELLS, chip_mask, detail_px, extent_px, picture
from measure.marks.shapes import (
    LEARNED_ORIGIN,
    Disk,
    FiducialLayout,
    Mark,
    MarkShape,
    MarkTemplate,
    Side,
    WrittenPlace,
)
from measure.noise.robust_estimation import TukeyFit, robust_scale, tukey_fit
from measure.results import MarkFit, ScanOrientation
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan, means

DECIDED = 7.0  # log-odds: a thousand to one
LEAST_REPORTED = 1.0  # log-odds: weaker evidence, below e to one, is not reported
_NAMED = 4.0  # in gates: largest distance of a mark from its predicted place for which it gets the name
_UNMIRRORED = 2.3  # prior log-odds of an unmirrored scan: ten to one; of 16 scans of archives none was mirrored
_QUOTED = 3  # lines of writing that are quoted
_FREE_MM = 1e3  # standard deviation of a place that is not given
_ALIKE = 0.05  # fraction of the contrast: images that differ nowhere by more count as equal
_FINEST_PX = 3.0  # smallest width of the finest line on the grid
_CUBIC_PX = 3.0  # border that cubic interpolation needs
_ABOUT_PX = 3.0  # width of the background around the drawings that is compared
_PIXELS_PER_DEGREE = 4.0  # pixels per degree of freedom: blur, grain and compression correlate neighbours
_OUTLIER = 4.0  # in standard deviations: larger residuals of a pixel are clipped
_ROUNDS, _LEAST_SCALE = 4, 1e-9  # reweightings of the robust fit; smallest standard deviation in it
_FLIP = np.diag([1.0, -1.0])  # from right and up to columns and rows
_ALIGNMENTS = 3  # Gauss-Newton steps; the chip is already placed to within a cell
_FEWEST = 40  # pixels needed to compare two chips
_CHANCE_SIGMAS = 3.0  # standard deviations by which noise may enlarge a difference
DISTURBANCE_P = 0.01  # probability that writing, dust or another object imitates or hides a difference between marks
_A_CHARACTER = 1.4  # log-odds of an orientation for each legible character more than in another one
# Log-odds that a line lies where the camera writes rather than by chance, among four sides with two directions. On
# seven real frames none of 29 lines with a title field lay elsewhere, and other words (counted by frames, since a
# stamp may have several) on none of the seven; numbers may be written by hand at any side.
_A_FIELD, _A_WORD, _A_NUMBER = 6.2, 4.8, 3.6
_MISLEADING_TEXT_P = 1 / 3000  # of 3000 readings with a lead of 3 characters none was wrong
_LEAST_RATIO = 1.5  # least ratio of legible characters to those of any other orientation
_DIRECTIONS: Mapping[Side, tuple[int, int]] = {"left": (-1, 0), "right": (1, 0), "top": (0, 1), "bottom": (0, -1)}


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """Scan orientation with its log-likelihoods.

    Attributes
    ----------
    pose : scan orientation.
    names : index of the mark at each site, of marks found and then of missed ones; -1 for none.
    coordinates : log-likelihood of the coordinates. They follow Student's t distribution, since the scatter of the film
        is known with few degrees of freedom.
    chi_square : chi-square of the coordinates.
    pictures : (sites,) log-likelihoods of the images.
    null_likelihood : log-likelihood of all images if their differences do not belong to the marks.
    writing : log-likelihood of the writing.
    """

    pose: str
    names: tuple[int, ...]
    coordinates: float = 0.0
    chi_square: float = 0.0
    pictures: Array = field(default_factory=lambda: np.zeros(0))
    null_likelihood: float = -np.inf
    writing: float = 0.0

    @property
    def pictures_total(self) -> float:
        return float(np.logaddexp(self.pictures.sum(), self.null_likelihood))

    @property
    def likelihood(self) -> float:
        """Log-likelihood of all observations."""
        return self.pictures_total + self.coordinates + self.writing

    @property
    def total(self) -> float:
        """Log-likelihood plus the prior. Selects the assumed orientation, but never decides one."""
        return self.likelihood + (0.0 if self.pose.endswith("m") else _UNMIRRORED)


def decide_scan_orientation(frame: Frame, lines: Sequence[Line] = (), poses: Sequence[str] = POSES) -> ScanOrientation:
    """Decide the scan orientation of a measured frame.

    Parameters
    ----------
    frame : frame measured in one of the orientations.
    lines : writing around the frame, as far as it was read.
    poses : orientations that are compared.
    """
    layout, fits = frame.layout, list(frame.inlier_fits.values())
    missed = frame.predicted_px[frame.inside & ~frame.inliers]
    every = (_name_sites(frame, pose, fits, missed) for pose in poses)
    hypotheses = [each for each in every if each is not None]
    if not hypotheses:
        return _decision([], layout, len(fits))
    scan_from_up = frame.pixel_from_camera[:, :2] @ np.linalg.inv(UP_FROM_CAMERA[frame.placement.pose])
    blur_px = float(np.median([fit.blur_px for fit in fits]))
    drawings = Drawings([mark.mark for mark in layout.marks], scan_from_up, blur_px)
    # Sites without a mark take contrast and noise from a typical one: another orientation may predict a mark there.
    usual = sorted(fits, key=lambda fit: abs(fit.contrast_dn))[len(fits) // 2]
    places = [*((fit, fit.center_px) for fit in fits), *((usual, place) for place in missed)]
    reach_px = frame.first_search_px

    def site_likelihoods(index: int) -> Array:
        """(hypotheses,) log-likelihoods of the image at a site."""
        names = [(each.names[index], UP_FROM_CAMERA[each.pose]) for each in hypotheses]
        shown = [OrientedMark(None if name < 0 else layout.marks[name].mark, turn) for name, turn in names]
        return MarkSite(frame.scan, *places[index], frame.weights, drawings, reach_px).likelihoods(shown)

    pictures = np.array(map_in_threads(site_likelihoods, range(len(places)))).reshape(len(places), len(hypotheses))
    null_likelihood = -np.inf
    if any(isinstance(mark.mark, MarkTemplate) and mark.mark.steadiness is None for mark in layout.marks):
        # A chip cut from a single scan cannot be separated from background or writing: its images may favour
        # orientations at random.
        null_likelihood = float((np.logaddexp.reduce(pictures, axis=1) - np.log(pictures.shape[1])).sum())
    lines = lines if frame.accepted else ()
    written = np.zeros(len(hypotheses))
    if lines:
        written = writing_likelihoods(lines, layout.writing, [each.pose for each in hypotheses])
    likelihoods = zip(hypotheses, pictures.T, written.tolist(), strict=True)
    hypotheses = [
        replace(each, pictures=own, null_likelihood=null_likelihood, writing=text) for each, own, text in likelihoods
    ]
    return _decision(hypotheses, layout, len(fits), lines)


def _name_sites(frame: Frame, pose: str, fits: Sequence[MarkFit], missed: Array) -> _Hypothesis | None:
    """Name each site after the nearest mark that an orientation predicts, and fit the frame. Returns None if a name is
    assigned twice, or fewer than two of two or more marks found are named."""
    options, pitch = frame.options, frame.pitch_mm
    centers = np.array([*(fit.center_px for fit in fits), *missed])
    predicted = frame.fitted_placement.reorient(pose, frame.camera_mm).places_px(frame.camera_mm)
    distance = np.hypot(*np.moveaxis((predicted[:, None] - centers[None]) * pitch, -1, 0))
    near = distance.min(axis=0) < _NAMED * options.gate_mm
    names = np.where(near, distance.argmin(axis=0), -1)
    found = near[: len(fits)]
    if len(np.unique(names[near])) < near.sum() or (found.sum() < 2 <= len(fits)):
        return None
    hypothesis = _Hypothesis(pose, tuple(names.tolist()))
    if len(fits) < 2:
        return hypothesis
    own = names[: len(fits)][found]
    given = []
    for mark in (frame.layout.marks[name] for name in own):
        # The origin of a learned mark differs from name to name.
        origin_mm = LEARNED_ORIGIN * mark.mark.learned_mm if isinstance(mark.mark, MarkTemplate) else 0.0
        given.append(float(np.hypot(min(max(mark.sigma_mm), _FREE_MM), origin_mm)))
    measured = np.array([fit.sigma_px for fit in fits])[found] * pitch.mean()
    sigma = np.sqrt(np.array(given) ** 2 + measured**2 + options.film_sigma_mm**2)
    up = frame.up_mm(centers[: len(fits)][found])
    fit = fit_frame(frame.camera_mm[own], up, sigma, UP_FROM_CAMERA[pose], options.film_model)
    redundancy = max(fit.redundancy, 0)
    degrees = SCATTER_DEGREES + redundancy
    coordinates = -degrees / 2 * float(np.log1p(fit.chi_square / SCATTER_DEGREES))
    # Orientations that name fewer marks explain fewer coordinates: a mark without a name may lie anywhere in the gate.
    # That it looks like a mark is counted with the pictures.
    coordinates += float(
        gammaln(degrees / 2) - redundancy / 2 * np.log(np.pi * SCATTER_DEGREES) - 2 * np.log(sigma).sum()
    )
    coordinates -= (len(fits) - len(own)) * float(np.log(np.pi * (_NAMED * options.gate_mm) ** 2))
    return replace(hypothesis, coordinates=coordinates, chi_square=fit.chi_square)


def _decision(
    hypotheses: Sequence[_Hypothesis], layout: FiducialLayout, found: int, lines: Sequence[Line] = ()
) -> ScanOrientation:
    """Select the most likely orientation, with the evidence in sentences. found: number of marks found."""
    if not hypotheses:
        return ScanOrientation("0", False, ("no scan orientation names the marks that were found.",))
    best_likelihood = max(each.likelihood for each in hypotheses)
    alike = [each for each in hypotheses if best_likelihood - each.likelihood < DECIDED]
    best = max(alike, key=lambda each: each.total)
    others = [each for each in hypotheses if each not in alike]
    against = _against(best, max(others, key=lambda each: each.total), layout, lines) if others else ()
    written, main = {each.pose: each.writing for each in hypotheses} if lines else {}, main_orientation(lines)
    if len(alike) == 1:
        reasons = against or (f"no other scan orientation explains the {found} marks found.",)
        return ScanOrientation(best.pose, True, reasons, written, main)
    first, lead = alike[0].pose, best.total - alike[0].total
    near = [each.pose for each in alike if best.total - each.total < LEAST_REPORTED]
    # Among equal ones: that in which most of the writing is upright, so that the frames of a roll agree.
    upright = next((pose for pose in near if main and pose_in_camera(main, pose) == "0"), "")
    assumed = upright or (best.pose if lead > LEAST_REPORTED else first)
    names = ", ".join(each.pose for each in alike)
    chosen = f"{assumed} is assumed{', in which most of what is written is upright' if upright else ''}"
    if lead > LEAST_REPORTED:
        equal = [pose for pose in near if pose != assumed]
        as_likely = f"as likely as {', '.join(equal)} and " if equal else ""
        sentence = (
            f"the {found} marks found do not separate the scan orientations {names} significantly: {chosen}, "
            f"{as_likely}likelier than {first} by log-odds of only {lead:.1f}."
        )
    else:
        sentence = (
            f"nothing in the {found} marks found separates the scan orientations {names}: their pictures and given "
            f"coordinates are alike; {chosen}."
        )
    rivals = tuple(pose_in_camera(each.pose, assumed) for each in alike if each.pose != assumed)
    return ScanOrientation(assumed, False, (sentence, *against), written, main, rivals=rivals)


def _against(best: _Hypothesis, rival: _Hypothesis, layout: FiducialLayout, lines: Sequence[Line]) -> tuple[str, ...]:
    """Sentences with the evidence for the best orientation against the most likely rejected one."""
    sentences = []
    by_site, lead = best.pictures - rival.pictures, best.pictures_total - rival.pictures_total
    if lead > LEAST_REPORTED:
        supporting = [site for site in np.argsort(-by_site, kind="stable").tolist() if by_site[site] > LEAST_REPORTED]
        kinds = sorted({_difference(best.names[site], rival.names[site], layout) for site in supporting})
        sentences.append(
            f"{' and '.join(kinds)} at {len(supporting)} of {len(by_site)} marks are evidence against the next best "
            f"orientation {rival.pose} with log-odds {lead:.1f}."
        )
    asymmetry = float(np.sqrt(max(rival.chi_square - best.chi_square, 0.0)))
    if abs(best.coordinates - rival.coordinates) > LEAST_REPORTED:
        word = "against" if best.coordinates > rival.coordinates else "for"
        sentences.append(
            f"the asymmetry of the marks' given coordinates, {asymmetry:.1f} sigmas, is evidence {word} orientation "
            f"{rival.pose} with log-odds {abs(best.coordinates - rival.coordinates):.1f}."
        )
    if abs(best.writing - rival.writing) > LEAST_REPORTED:
        lead = best.writing - rival.writing
        by_line = [
            (line_score(line, layout.writing, best.pose) - line_score(line, layout.writing, rival.pose)) * np.sign(lead)
            for line in lines
        ]
        supporting = [index for index in np.argsort(-np.array(by_line), kind="stable").tolist() if by_line[index] > 0]
        quoted = ", ".join(f'"{lines[index].text}"' for index in supporting[:_QUOTED])
        word = "against" if lead > 0 else "for"
        sentences.append(
            f"the writing, such as {quoted}, is evidence {word} orientation {rival.pose} with log-odds {abs(lead):.1f}."
        )
    return tuple(sentences)


def _difference(one: int, other: int, layout: FiducialLayout) -> str:
    """Feature that distinguishes two marks of the camera."""
    if one < 0 or other < 0:
        return "marks where the other orientation has none"
    figures: list[tuple[object, int]] = []  # irrespective of the rotation, without identification dots; their number
    for mark in (layout.marks[index].mark for index in (one, other)):
        parts = mark.parts if isinstance(mark, MarkShape) else ()
        dots = [part for part in parts if isinstance(part, Disk) and part.center_mm != (0.0, 0.0)]
        rest = sorted(type(part).__name__ for part in parts if part not in dots)
        figures.append((rest if isinstance(mark, MarkShape) else mark, len(dots)))
    if figures[0][0] != figures[1][0]:
        return "different marks"
    return "identification dots" if figures[0] != figures[1] else "the marks' directions"


def writing_likelihoods(lines: Sequence[Line], places: Sequence[WrittenPlace], poses: Sequence[str]) -> Array:
    """(n,) log-likelihoods of scan orientations, 0 for the best, bounded below by the probability of misleading
    text."""
    scores = np.array([sum((line_score(line, places, pose) for line in lines), 0.0) for pose in poses])
    return bounded(scores)


def bounded(scores: Array) -> Array:
    """(n,) log-likelihoods, bounded below by the probability of misleading text."""
    return np.asarray(
        np.log((1 - _MISLEADING_TEXT_P) * np.exp(scores - scores.max(initial=-np.inf)) + _MISLEADING_TEXT_P)
    )


def line_score(line: Line, places: Sequence[WrittenPlace], pose: str) -> float:
    """Log-likelihood of one line in a scan orientation, up to a constant of the line."""
    own = {pose_in_camera(way, pose): reading.legible for way, reading in line.ways.items()}
    upright = {way: legible for way, legible in own.items() if not way.endswith("m")}
    anyhow = _A_CHARACTER * max(upright.values())
    plate = is_plate(line)
    expected = [] if is_of_film(line) else [place for place in places if place.plate == plate]
    if not expected:
        return anyhow
    side = side_in_camera(line.side, pose)
    there = [max(upright.values()) if place.pose is None else upright.get(place.pose, 0.0)
             for place in expected if place.side == side]  # fmt: skip
    # Log-odds that it lies where the camera writes.
    odds = max(_A_FIELD * signs(line), _A_WORD if any(each.isalpha() for each in line.text) else _A_NUMBER)
    return max([anyhow - odds, *(_A_CHARACTER * legible for legible in there)])


def side_in_camera(side: Side, pose: str) -> Side:
    """Side of the camera's drawing at a side of a scan with the given orientation."""
    direction = UP_FROM_CAMERA[pose].T @ _DIRECTIONS[side]
    return next(name for name, other in _DIRECTIONS.items() if np.allclose(direction, other))


def main_orientation(lines: Sequence[Line]) -> str:
    """Orientation of most of the text in the scan; "" where another has nearly as many legible characters."""
    if not lines:
        return ""
    ways: dict[str, float] = {}
    for line in lines:
        ways[line.pose] = ways.get(line.pose, 0.0) + line.legible
    best, *others = sorted(ways, key=lambda way: -ways[way])
    return best if not others or ways[best] > _LEAST_RATIO * ways[others[0]] else ""


class OrientedMark(NamedTuple):
    """Mark that a scan orientation predicts at a site. turn (2, 2): from its x and y to right and up. mark None: plain
    background."""

    mark: Mark | None
    turn: Array


@dataclass(frozen=True, eq=False)
class MarkImage:
    """Image of a mark on the drawings' grid, with its origin in the middle.

    Attributes
    ----------
    grey : (size, size) image.
    known : (size, size) mask of the pixels with known grey values: a learned chip also contains the background of other
        scans.
    covered : (size, size) mask of the chip's area; everything for a drawn mark.
    noise : standard deviation of the chip's pixels, fraction of the contrast; inf where unknown.
    """

    grey: Array
    known: Mask
    covered: Mask
    noise: float = 0.0

    def change(self, change: Callable[[Any], Any]) -> "MarkImage":
        """Apply the same change, for example a rotation, to the image and both masks."""
        return replace(self, grey=change(self.grey), known=change(self.known), covered=change(self.covered))

    @property
    def is_chip(self) -> bool:
        return not bool(self.covered.all())

    def fit(self, window: Array, used: Mask) -> TukeyFit:
        """Robust fit to a window in the pixels used. Factors: offset, gain, derivatives with respect to row and
        column."""
        slopes = [np.asarray(np.gradient(self.grey, axis=axis))[used] for axis in (0, 1)]
        columns = np.stack([np.ones(int(used.sum())), self.grey[used], *slopes])
        return tukey_fit(columns, window[used], _ROUNDS, _LEAST_SCALE)

    def align(self, window: Array) -> "MarkImage":
        """Shift by a fraction of a cell to match a window (size, size), on which it already lies to within a cell."""
        used, moved, shift = self.known & self.covered, self, np.zeros(2)
        for _ in range(_ALIGNMENTS):
            factors = moved.fit(window, used).factors
            if factors[1] == 0.0:
                return self
            shift = np.clip(shift - factors[2:] / factors[1], -1.0, 1.0)
            moved = replace(self, grey=np.asarray(ndimage.shift(self.grey, shift, order=3, mode="nearest")))
        return moved

    def unlike(self, other: "MarkImage", contrast: float) -> float:
        """Sum of squared differences of two chips beyond their noise, where both are known, after alignment. contrast:
        of the image in the scan, in standard deviations of its noise; differences are clipped as its outliers are."""
        used = self.known & other.known & self.covered & other.covered
        if used.sum() < _FEWEST:
            return 0.0
        moved = replace(self, known=used, covered=used).align(other.grey)
        residuals = moved.fit(other.grey, used).residuals
        noise = min(robust_scale(residuals), float(np.hypot(self.noise, other.noise)))
        alike = max(_OUTLIER * noise, _ALIKE)
        return float(((residuals**2 - alike**2) * contrast**2).clip(0.0, _OUTLIER**2).sum())


_EVERYWHERE = np.ones((1, 1), dtype=bool)
_BARE = MarkImage(np.zeros((1, 1)), _EVERYWHERE, _EVERYWHERE)


def _turn_and_pad(picture: Any, turn: Array, spare: int) -> Any:
    """Rotate by quarter turns, and pad by repeating the edge."""
    return np.pad(turn_by_quarters(picture, turn), spare, mode="edge")


class Drawings:
    """Images of a camera's marks on a grid that is upright in the frame.

    Scan orientations rotate the marks by quarter turns and mirror them, so each mark is drawn once. The grid is coarser
    than the scan, as far as the finest line of the marks allows: the differences between marks are coarser.
    """

    def __init__(self, marks: Collection[Mark], scan_from_up: Array, blur_px: float) -> None:
        """Draw the marks. scan_from_up (2, 2): from mm right and up in the frame to px of the scan; blur_px: blur of
        the scan."""
        finest_px = min(detail_px(mark, scan_from_up) for mark in marks)
        self.reduction = max(1, int(finest_px / _FINEST_PX))
        per_mm = linear_scale(scan_from_up) / self.reduction
        grid_from_up = per_mm * _FLIP
        self.scan_from_grid = scan_from_up @ np.linalg.inv(grid_from_up)
        self._views = {mark: _draw_view(mark, grid_from_up, blur_px / self.reduction) for mark in set(marks)}

    def views(self, shown: Sequence[OrientedMark], spare: int) -> list[MarkImage]:
        """Image that each orientation predicts at a place, centred on grids of one size: spare cells larger on every
        side than the largest image."""
        drawn = [_BARE if each.mark is None else self._views[each.mark] for each in shown]
        half = max(len(each.grey) // 2 for each in drawn) + spare
        turns = [_FLIP @ each.turn @ _FLIP for each in shown]
        return [
            each.change(partial(_turn_and_pad, turn=turn, spare=half - len(each.grey) // 2))
            for each, turn in zip(drawn, turns, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class MarkSite:
    """Place where a mark was found, or predicted but not found.

    Attributes
    ----------
    like : fit of the mark, or of a typical one where none was found.
    weights : of the scan's channels.
    reach_px : largest shift of a chip in another orientation than the one it was found in. The origin of a drawn mark
        is its middle in every orientation; the origin of a chip is where the user clicked, and a chip that contains
        only an edge is found anywhere along it.
    """

    scan: Scan
    like: MarkFit
    center_px: Array
    weights: Sequence[float] | None
    drawings: Drawings
    reach_px: float

    def likelihoods(self, shown: Sequence[OrientedMark]) -> Array:
        """Log-likelihood of the image under each orientation, up to a constant: 0 for the best, at least
        log(`DISTURBANCE_P`), the probability that something else disturbs the image."""
        chips = any(isinstance(each.mark, MarkTemplate) for each in shown)
        spare = int(np.ceil(self.reach_px / self.drawings.reduction)) if chips else 0
        views, view_of = _distinct(self.drawings.views(shown, spare))
        if len(views) == 1:
            return np.zeros(len(shown))
        window = self._window(len(views[0].grey))
        views = [self._placed(window, view, spare) for view in views]
        # Pixels on and around all drawings; no mark explains the image farther off.
        greys = [view.grey for view in views]
        outside = (np.max(greys, axis=0) - np.min(greys, axis=0).clip(max=0.0) < _ALIKE).astype(np.uint8)
        area: Mask = np.asarray(cv2.distanceTransform(outside, cv2.DIST_L2, 5) <= _ABOUT_PX)
        residuals = [self._residuals(window, view.grey, area & view.known) for view in views]
        # Large residuals of even the best image are not noise, and reduce the significance of the differences.
        noise_dn = self.like.noise_dn / self.drawings.reduction
        scale = max(noise_dn, min(robust_scale(each) for each in residuals), 1e-9)
        misfits = np.full((len(views), *window.shape), _OUTLIER**2)  # unknown pixels of a chip count as outliers
        for misfit, view, residual in zip(misfits, views, residuals, strict=True):
            misfit[area & view.known] = np.minimum(np.abs(residual) / scale, _OUTLIER) ** 2
        excess = _excess(misfits, np.stack([area & view.covered for view in views]))
        best = views[int(excess.argmin())]
        if best.is_chip:
            excess = np.minimum(excess, [self._most_excess(best, view, scale) for view in views])
        relative = np.exp(-excess / 2 / _PIXELS_PER_DEGREE)
        return np.asarray(np.log((1 - DISTURBANCE_P) * relative + DISTURBANCE_P))[view_of]

    def _most_excess(self, best: MarkImage, view: MarkImage, scale_dn: float) -> float:
        """Largest excess misfit of a chip over the best one that their difference explains, noise included."""
        if view is best or not view.is_chip:
            return 0.0 if view is best else np.inf
        squares = view.unlike(best, abs(self.like.stored_contrast_dn) / scale_dn)
        return squares + 2 * _CHANCE_SIGMAS * float(np.sqrt(squares))

    def _placed(self, window: Array, view: MarkImage, spare: int) -> MarkImage:
        """Shift a chip to the maximum of its correlation (NCC) with the window."""
        if not view.is_chip or not view.known.any():
            return view
        core = slice(spare, len(window) - spare)
        grey, known = (np.asarray(each[core, core], np.float32) for each in (view.grey, view.known))
        likeness = cv2.matchTemplate(np.asarray(window, np.float32), grey, cv2.TM_CCOEFF_NORMED, mask=known)
        likeness = np.where(np.isfinite(likeness), np.sign(self.like.contrast_dn) * likeness, -1.0)
        row, col = np.unravel_index(int(likeness.argmax()), likeness.shape)
        shift = int(row) - spare, int(col) - spare
        return view.change(partial(np.roll, shift=shift, axis=(0, 1))).align(window)

    def _window(self, size: int) -> Array:
        """(size, size) grey values of the scan on the drawings' grid, centred on the site."""
        reduction = self.drawings.reduction
        fine = size * reduction
        scan_from_fine = self.drawings.scan_from_grid / reduction
        reach = np.abs(scan_from_fine).sum(axis=1) * fine / 2 + _CUBIC_PX
        low, high = np.floor(self.center_px - reach).astype(int), np.ceil(self.center_px + reach).astype(int)
        width, height = (high - low + 1).tolist()
        window = self.scan.window(int(low[0]), int(low[1]), width, height, self.weights)
        first = self.center_px - low - scan_from_fine @ np.full(2, (fine - 1) / 2)
        scan_from_fine = np.column_stack([scan_from_fine, first])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        upright = cv2.warpAffine(window, scan_from_fine, (fine, fine), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(means(np.asarray(upright, np.float32)[..., None], reduction)[..., 0], np.float64)

    def _residuals(self, window: Array, shown: Array, area: Mask) -> Array:
        """Residuals of a fit of the image, slightly shifted, on a plane background, with the found polarity."""
        grey = window[area]
        row, col = np.nonzero(area)
        ground = [np.ones_like(grey), col / len(window), row / len(window)]
        if shown.any():
            by_row, by_col = (np.asarray(np.gradient(shown, axis=axis)) for axis in (0, 1))
            columns = [*ground, shown[area], by_row[area], by_col[area]]
            fit = tukey_fit(np.stack(columns), grey, _ROUNDS, _LEAST_SCALE)
            if fit.factors[len(ground)] * self.like.contrast_dn > 0:
                return fit.residuals
        return tukey_fit(np.stack(ground), grey, _ROUNDS, _LEAST_SCALE).residuals


def _draw_view(mark: Mark, grid_from_mark: Array, blur_px: float) -> MarkImage:
    """Draw a mark centred on its origin."""
    place = np.column_stack([grid_from_mark, np.zeros(2)])
    half = int(np.ceil(np.abs(extent_px(mark, place)).max() + 2 * _ABOUT_PX))
    place[:, 2] = half
    size = 2 * half + 1
    known, covered, noise = np.ones((size, size), dtype=bool), np.ones((size, size), dtype=bool), 0.0
    if isinstance(mark, MarkTemplate):
        known = chip_mask(mark, place, size, size)
        covered = chip_mask(replace(mark, steady=None), place, size, size)
        # As a fraction of the contrast; of a mean of several scans, each with its share.
        of_mean = float(np.sqrt(sum(share**2 for share in mark.shares.values())))
        noise = mark.noise_dn * of_mean / max(float(np.ptp(mark.image)), 1e-9) if mark.noise_dn else np.inf
    return MarkImage(picture(mark, place, size, size, blur_px, ROUGH_CELLS), known, covered, noise)


def _distinct(views: Sequence[MarkImage]) -> tuple[list[MarkImage], list[int]]:
    """Views with different images, and the index of each view among these."""
    kinds: list[MarkImage] = []
    index = []
    for each in views:
        alike = [number for number, kind in enumerate(kinds) if np.abs(kind.grey - each.grey).max() < _ALIKE]
        index.append(alike[0] if alike else len(kinds))
        if not alike:
            kinds.append(each)
    return kinds, index


def picture_kinds(
    marks: Sequence[Mark], poses: Sequence[str], scan_from_up: Array, blur_px: float
) -> dict[str, list[int]]:
    """Kind of picture of every mark by orientation; equal ones differ nowhere visibly."""
    shown = [OrientedMark(mark, UP_FROM_CAMERA[pose]) for pose in poses for mark in marks]
    _, kinds = _distinct(Drawings(marks, scan_from_up, blur_px).views(shown, 0))
    return {pose: kinds[number * len(marks) :][: len(marks)] for number, pose in enumerate(poses)}


def _excess(misfits: Array, areas: Mask) -> Array:
    """(n,) excess of misfits (n, size, size) over the best one's, over the area common to both."""
    counts = areas.sum(axis=(1, 2)).clip(min=1)
    best = int(((misfits * areas).sum(axis=(1, 2)) / counts).argmin())
    excess = ((misfits - misfits[best]) * (areas & areas[best])).sum(axis=(1, 2))
    return np.asarray(excess - excess.min())
