"""Scan orientation of a frame, one of eight: decided by features that break its symmetry, or reported as undecided.

Each orientation assigns other names to the marks found. Under the right one, their images fit (identification dots,
different marks), their coordinates fit (asymmetries larger than their standard deviations), and the writing around the
frame has the direction and place known from the camera. The log-likelihoods are summed. An orientation is decided only
if its odds against every other are a thousand to one. Among equal ones an unmirrored orientation has the higher prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.annotations.fields import Line
from measure.annotations.orientation_from_text import line_score, main_pose, writing_likelihoods
from measure.array_types import Array
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.interior_orientation import FrameFit, fit_frame
from measure.fiducials.options import SCATTER_DEGREES, FiducialOptions
from measure.fiducials.orientation_pictures import Drawings, MarkSite, PosedMark
from measure.geometry import pose_in_camera, up_from_camera
from measure.marks.shapes import LEARNED_ORIGIN, Disk, FiducialLayout, LayoutMark, Mark, MarkShape, MarkTemplate
from measure.results import MarkFit, Pose
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan

DECIDED = 7.0  # log-odds: a thousand to one
TOLD = 1.0  # log-odds: weaker evidence, below e to one, is not reported
_NAMED = 4.0  # in gates: largest distance of a mark from its predicted place for which it gets the name
_UNMIRRORED = 2.3  # prior log-odds of an unmirrored scan: ten to one; of 16 scans of archives none was mirrored
_QUOTED = 3  # lines of writing that are quoted
_FREE_MM = 1e3  # standard deviation of a place that is not given


@dataclass(frozen=True, eq=False)
class _Verdict:
    """Log-likelihoods of one scan orientation.

    Attributes
    ----------
    pose : scan orientation.
    names : index of the mark at each site, -1 for none.
    pictures : (sites,) log-likelihoods of the images.
    coordinates : log-likelihood of the coordinates.
    chi_square : chi-square of the coordinates.
    by_chance : log-likelihood of all images if their differences do not belong to the marks.
    writing : log-likelihood of the writing.
    """

    pose: str
    names: tuple[int, ...]
    pictures: Array
    coordinates: float
    chi_square: float
    by_chance: float
    writing: float = 0.0

    @property
    def pictures_total(self) -> float:
        return float(np.logaddexp(self.pictures.sum(), self.by_chance))

    @property
    def likelihood(self) -> float:
        """Log-likelihood of all observations."""
        return self.pictures_total + self.coordinates + self.writing

    @property
    def total(self) -> float:
        """Log-likelihood plus the prior. Selects the assumed orientation, but never decides one."""
        return self.likelihood + (0.0 if self.pose.endswith("m") else _UNMIRRORED)


def decide_pose(
    scan: Scan,
    layout: FiducialLayout,
    placements: Sequence[Placement],
    frame: Frame,
    options: FiducialOptions,
    lines: Sequence[Line] = (),
) -> Pose:
    """Decide the scan orientation of a measured frame.

    Parameters
    ----------
    scan, layout, options : scan, marks of the camera, and options.
    placements : one for each orientation, all at the place of the measured frame.
    frame : frame measured in one of the orientations.
    lines : writing around the frame, as far as it was read.
    """
    fits = [fit for fit in frame.fits if fit is not None]
    missed = frame.missed_px
    named = [
        each
        for each in (_Named.from_placement(placement, layout, fits, missed, options) for placement in placements)
        if each is not None
    ]
    if not named:
        return _decision([], layout, len(fits))
    scan_from_up = frame.pixel_from_camera[:, :2] @ np.linalg.inv(up_from_camera(frame.placement.pose))
    blur_px = float(np.median([fit.blur_px for fit in fits]))
    drawings = Drawings([mark.mark for mark in layout.marks], scan_from_up, blur_px)
    reach_px = frame.first_search_px
    sites = [MarkSite(scan, fit, fit.center_px, frame.weights, drawings, reach_px) for fit in fits]
    # Sites without a mark take contrast and noise from a typical one: another orientation may predict a mark there.
    usual = sorted(fits, key=lambda fit: abs(fit.contrast_dn))[len(fits) // 2]
    sites += [MarkSite(scan, usual, place, frame.weights, drawings, reach_px) for place in missed]

    def site_likelihoods(index: int) -> Array:
        return sites[index].likelihoods([each.posed_mark(index, layout) for each in named])

    pictures = np.array(map_in_threads(site_likelihoods, range(len(sites)))).reshape(len(sites), len(named))
    by_chance = _chance_likelihood(pictures) if any(_is_bare_chip(mark.mark) for mark in layout.marks) else -np.inf
    verdicts = [each.verdict(pictures[:, index], by_chance) for index, each in enumerate(named)]
    if not lines or not frame.accepted:
        return _decision(verdicts, layout, len(fits))
    written = writing_likelihoods(lines, layout.writing, [verdict.pose for verdict in verdicts])
    verdicts = [replace(each, writing=own) for each, own in zip(verdicts, written.tolist(), strict=True)]
    return _decision(verdicts, layout, len(fits), lines)


def _is_bare_chip(mark: Mark) -> bool:
    """Whether a mark is a chip cut from a single scan: its mark cannot be separated from background or writing."""
    return isinstance(mark, MarkTemplate) and mark.steadiness is None


def _chance_likelihood(pictures: Array) -> float:
    """Log-likelihood of the images (sites, poses) under the null hypothesis that each of them favours an orientation
    at random, all with equal probability."""
    return float((np.logaddexp.reduce(pictures, axis=1) - np.log(pictures.shape[1])).sum())


@dataclass(frozen=True, eq=False)
class _Named:
    """Names that an orientation assigns to the places of found and missed marks (-1: none), and the fit of the frame to
    the found ones, if there are two."""

    pose: str
    names: tuple[int, ...]
    fit: FrameFit | None

    @classmethod
    def from_placement(
        cls,
        placement: Placement,
        layout: FiducialLayout,
        fits: Sequence[MarkFit],
        missed: Sequence[Array],
        options: FiducialOptions,
    ) -> "_Named | None":
        """Name each place after the nearest predicted mark, and fit the frame. Returns None if a name is assigned
        twice, or fewer than two of two or more marks found are named."""
        pitch, camera = np.asarray(placement.pitch_mm), np.array([mark.xy_mm for mark in layout.marks])
        predicted = placement.places_px(camera)
        centers = np.array([*(fit.center_px for fit in fits), *missed])
        distance = np.hypot(*np.moveaxis((predicted[:, None] - centers[None]) * pitch, -1, 0))
        nearest = distance.argmin(axis=0)
        near = distance.min(axis=0) < _NAMED * options.gate_mm
        names = np.where(near, nearest, -1)
        if len(np.unique(names[near])) < near.sum():
            return None
        near, centers = near[: len(fits)], centers[: len(fits)]
        if near.sum() < 2:
            alone = cls(placement.pose, tuple(names.tolist()), None)
            return alone if len(fits) < 2 else None
        own = names[: len(fits)][near]
        given = np.array([_given_sigma_mm(layout.marks[name]) for name in own])
        measured = np.array([np.sqrt(np.trace(fit.covariance_px2) / 2) for fit in fits])[near] * pitch.mean()
        sigma = np.sqrt(given**2 + measured**2 + options.film_sigma_mm**2)
        ideal = centers[near] if options.lens is None else options.lens.ideal_px(centers[near])
        up = ideal * pitch * (1.0, -1.0)
        fit = fit_frame(camera[own], up, sigma, up_from_camera(placement.pose), options.film_model)
        return cls(placement.pose, tuple(names.tolist()), fit)

    def posed_mark(self, site: int, layout: FiducialLayout) -> PosedMark:
        name = self.names[site]
        return PosedMark(None if name < 0 else layout.marks[name].mark, up_from_camera(self.pose))

    def verdict(self, pictures: Array, by_chance: float) -> _Verdict:
        """Log-likelihoods of this orientation. The coordinates follow Student's t distribution, since the scatter of
        the film is known with few degrees of freedom."""
        if self.fit is None:
            return _Verdict(self.pose, self.names, pictures, 0.0, 0.0, by_chance)
        degrees = SCATTER_DEGREES + max(self.fit.redundancy, 0)
        coordinates = -degrees / 2 * float(np.log1p(self.fit.chi_square / SCATTER_DEGREES))
        return _Verdict(self.pose, self.names, pictures, coordinates, self.fit.chi_square, by_chance)


def _given_sigma_mm(mark: LayoutMark) -> float:
    """Standard deviation of a given place, including that of a learned mark's origin: it differs from name to name."""
    origin_mm = LEARNED_ORIGIN * mark.mark.learned_mm if isinstance(mark.mark, MarkTemplate) else 0.0
    return float(np.hypot(min(max(mark.sigma_mm), _FREE_MM), origin_mm))


def _decision(verdicts: Sequence[_Verdict], layout: FiducialLayout, found: int, lines: Sequence[Line] = ()) -> Pose:
    """Select the most likely orientation, with the evidence in sentences.

    Among equally likely ones, the orientation in which most of the writing is upright is assumed, so that the frames of
    a roll are named consistently. found: number of marks found; the verdicts also use the places of missed ones.
    """
    if not verdicts:
        return Pose("0", False, ("no pose names the marks that were found.",))
    best_likelihood = max(verdict.likelihood for verdict in verdicts)
    alike = [verdict for verdict in verdicts if best_likelihood - verdict.likelihood < DECIDED]
    best = max(alike, key=lambda verdict: verdict.total)
    others = sorted((v for v in verdicts if v not in alike), key=lambda verdict: -verdict.total)
    against = _against(best, others[0], layout, lines) if others else ()
    written = {verdict.pose: verdict.writing for verdict in verdicts} if lines else {}
    main = main_pose(lines)
    if len(alike) == 1:
        reasons = against or (f"no other pose explains the {found} marks found.",)
        return Pose(best.pose, True, reasons, written, main)
    names = ", ".join(verdict.pose for verdict in alike)
    lead = best.total - alike[0].total
    near = [verdict for verdict in alike if best.total - verdict.total < TOLD]
    upright = next((verdict.pose for verdict in near if main and pose_in_camera(main, verdict.pose) == "0"), "")
    like_writing = ", in which most of what is written is upright" if upright else ""
    if lead > TOLD:
        assumed = upright or best.pose
        equal = [verdict.pose for verdict in near if verdict.pose != assumed]
        as_likely = f"as likely as {', '.join(equal)} and " if equal else ""
        sentence = (
            f"the {found} marks found do not separate the poses {names} significantly: {assumed} is assumed"
            f"{like_writing}, {as_likely}likelier than {alike[0].pose} by log-odds of only {lead:.1f}."
        )
    else:
        assumed = upright or alike[0].pose
        sentence = (
            f"nothing in the {found} marks found separates the poses {names}: their pictures and given coordinates are "
            f"alike; {assumed} is assumed{like_writing}."
        )
    rivals = tuple(pose_in_camera(verdict.pose, assumed) for verdict in alike if verdict.pose != assumed)
    return Pose(assumed, False, (sentence, *against), written, main, rivals=rivals)


def _against(best: _Verdict, rival: _Verdict, layout: FiducialLayout, lines: Sequence[Line]) -> tuple[str, ...]:
    """Sentences with the evidence for the best orientation against the most likely rejected one."""
    sentences = []
    by_site, lead = best.pictures - rival.pictures, best.pictures_total - rival.pictures_total
    if lead > TOLD:
        telling = [site for site in np.argsort(-by_site, kind="stable").tolist() if by_site[site] > TOLD]
        kinds = sorted({_difference(best.names[site], rival.names[site], layout) for site in telling})
        sentences.append(
            f"{' and '.join(kinds)} at {len(telling)} of {len(by_site)} marks are evidence against the next best pose "
            f"{rival.pose} with log-odds {lead:.1f}."
        )
    asymmetry = float(np.sqrt(max(rival.chi_square - best.chi_square, 0.0)))
    if abs(best.coordinates - rival.coordinates) > TOLD:
        word = "against" if best.coordinates > rival.coordinates else "for"
        sentences.append(
            f"the asymmetry of the marks' given coordinates, {asymmetry:.1f} sigmas, is evidence {word} pose "
            f"{rival.pose} with log-odds {abs(best.coordinates - rival.coordinates):.1f}."
        )
    if abs(best.writing - rival.writing) > TOLD:
        sentences.append(_writing_sentence(best, rival, layout, lines))
    return tuple(sentences)


def _writing_sentence(best: _Verdict, rival: _Verdict, layout: FiducialLayout, lines: Sequence[Line]) -> str:
    """Sentence with the evidence of the writing on two orientations, quoting the most significant lines."""
    lead = best.writing - rival.writing
    by_line = [
        (line_score(line, layout.writing, best.pose) - line_score(line, layout.writing, rival.pose)) * np.sign(lead)
        for line in lines
    ]
    telling = [index for index in np.argsort(-np.array(by_line), kind="stable").tolist() if by_line[index] > 0]
    quoted = ", ".join(f'"{lines[index].text}"' for index in telling[:_QUOTED])
    word = "against" if lead > 0 else "for"
    return f"of {len(lines)} lines of writing {quoted} are evidence {word} pose {rival.pose}: log-odds {abs(lead):.1f}."


def _difference(one: int, other: int, layout: FiducialLayout) -> str:
    """Feature that distinguishes two marks of the camera."""
    if one < 0 or other < 0:
        return "marks where the other pose has none"
    (core, dots), (other_core, other_dots) = (_figure(layout.marks[index].mark) for index in (one, other))
    if core != other_core:
        return "different marks"
    return "identification dots" if dots != other_dots else "the marks' directions"


def _figure(mark: Mark) -> tuple[object, int]:
    """Figure of a mark irrespective of its rotation, and number of its identification dots."""
    if not isinstance(mark, MarkShape):
        return mark, 0
    dots = [part for part in mark.parts if isinstance(part, Disk) and part.center_mm != (0.0, 0.0)]
    rest = [part for part in mark.parts if part not in dots]
    return sorted(type(part).__name__ for part in rest), len(dots)
