"""Scan orientation of a frame, one of eight: decided by features that break its symmetry, or reported as undecided.

Each orientation assigns other names to the marks found. Under the right one, their images fit (identification dots,
different marks), their coordinates fit (asymmetries larger than their standard deviations), and the writing around the
frame has the direction and place known from the camera. The log-likelihoods are summed. An orientation is decided only
if its odds against every other are a thousand to one. Among equal ones an unmirrored orientation has the higher prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from measure.annotations.lines import Line, line_score, main_pose, writing_likelihoods
from measure.array_types import Array
from measure.fiducials.frame import Frame
from measure.fiducials.interior_orientation import fit_frame
from measure.fiducials.options import SCATTER_DEGREES
from measure.fiducials.orientation_pictures import Drawings, MarkSite, PosedMark
from measure.geometry import POSES, UP_FROM_CAMERA, pose_in_camera
from measure.marks.shapes import LEARNED_ORIGIN, Disk, FiducialLayout, LayoutMark, Mark, MarkShape, MarkTemplate
from measure.results import MarkFit, Pose
from measure.scans.parallel import map_in_threads

DECIDED = 7.0  # log-odds: a thousand to one
TOLD = 1.0  # log-odds: weaker evidence, below e to one, is not reported
_NAMED = 4.0  # in gates: largest distance of a mark from its predicted place for which it gets the name
_UNMIRRORED = 2.3  # prior log-odds of an unmirrored scan: ten to one; of 16 scans of archives none was mirrored
_QUOTED = 3  # lines of writing that are quoted
_FREE_MM = 1e3  # standard deviation of a place that is not given


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
    by_chance : log-likelihood of all images if their differences do not belong to the marks.
    writing : log-likelihood of the writing.
    """

    pose: str
    names: tuple[int, ...]
    coordinates: float = 0.0
    chi_square: float = 0.0
    pictures: Array = field(default_factory=lambda: np.zeros(0))
    by_chance: float = -np.inf
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


def decide_pose(frame: Frame, lines: Sequence[Line] = (), poses: Sequence[str] = POSES) -> Pose:
    """Decide the scan orientation of a measured frame.

    Parameters
    ----------
    frame : frame measured in one of the orientations.
    lines : writing around the frame, as far as it was read.
    poses : orientations that are compared.
    """
    layout, fits = frame.layout, list(frame.inlier_fits.values())
    inside = np.array([detection.inside for detection in frame.detections])
    missed = frame.predicted_px[inside & ~frame.inliers]
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
        shown = [PosedMark(None if name < 0 else layout.marks[name].mark, turn) for name, turn in names]
        return MarkSite(frame.scan, *places[index], frame.weights, drawings, reach_px).likelihoods(shown)

    pictures = np.array(map_in_threads(site_likelihoods, range(len(places)))).reshape(len(places), len(hypotheses))
    by_chance = -np.inf
    if any(isinstance(mark.mark, MarkTemplate) and mark.mark.steadiness is None for mark in layout.marks):
        # A chip cut from a single scan cannot be separated from background or writing: its images may favour
        # orientations at random.
        by_chance = float((np.logaddexp.reduce(pictures, axis=1) - np.log(pictures.shape[1])).sum())
    lines = lines if frame.accepted else ()
    written = np.zeros(len(hypotheses))
    if lines:
        written = writing_likelihoods(lines, layout.writing, [each.pose for each in hypotheses])
    likelihoods = zip(hypotheses, pictures.T, written.tolist(), strict=True)
    hypotheses = [replace(each, pictures=own, by_chance=by_chance, writing=text) for each, own, text in likelihoods]
    return _decision(hypotheses, layout, len(fits), lines)


def _name_sites(frame: Frame, pose: str, fits: Sequence[MarkFit], missed: Array) -> _Hypothesis | None:
    """Name each site after the nearest mark that an orientation predicts, and fit the frame. Returns None if a name is
    assigned twice, or fewer than two of two or more marks found are named."""
    options, pitch = frame.options, frame.pitch_mm
    centers = np.array([*(fit.center_px for fit in fits), *missed])
    predicted = frame.fitted_placement.posed(pose, frame.camera_mm).places_px(frame.camera_mm)
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
    given = np.array([_given_sigma_mm(frame.layout.marks[name]) for name in own])
    measured = np.array([fit.sigma_px for fit in fits])[found] * pitch.mean()
    sigma = np.sqrt(given**2 + measured**2 + options.film_sigma_mm**2)
    up = frame.up_mm(centers[: len(fits)][found])
    fit = fit_frame(frame.camera_mm[own], up, sigma, UP_FROM_CAMERA[pose], options.film_model)
    degrees = SCATTER_DEGREES + max(fit.redundancy, 0)
    coordinates = -degrees / 2 * float(np.log1p(fit.chi_square / SCATTER_DEGREES))
    return replace(hypothesis, coordinates=coordinates, chi_square=fit.chi_square)


def _given_sigma_mm(mark: LayoutMark) -> float:
    """Standard deviation of a given place, including that of a learned mark's origin: it differs from name to name."""
    origin_mm = LEARNED_ORIGIN * mark.mark.learned_mm if isinstance(mark.mark, MarkTemplate) else 0.0
    return float(np.hypot(min(max(mark.sigma_mm), _FREE_MM), origin_mm))


def _decision(
    hypotheses: Sequence[_Hypothesis], layout: FiducialLayout, found: int, lines: Sequence[Line] = ()
) -> Pose:
    """Select the most likely orientation, with the evidence in sentences. found: number of marks found."""
    if not hypotheses:
        return Pose("0", False, ("no pose names the marks that were found.",))
    best_likelihood = max(each.likelihood for each in hypotheses)
    alike = [each for each in hypotheses if best_likelihood - each.likelihood < DECIDED]
    best = max(alike, key=lambda each: each.total)
    others = [each for each in hypotheses if each not in alike]
    against = _against(best, max(others, key=lambda each: each.total), layout, lines) if others else ()
    written, main = {each.pose: each.writing for each in hypotheses} if lines else {}, main_pose(lines)
    if len(alike) == 1:
        reasons = against or (f"no other pose explains the {found} marks found.",)
        return Pose(best.pose, True, reasons, written, main)
    first, lead = alike[0].pose, best.total - alike[0].total
    near = [each.pose for each in alike if best.total - each.total < TOLD]
    # Among equal ones: that in which most of the writing is upright, so that the frames of a roll agree.
    upright = next((pose for pose in near if main and pose_in_camera(main, pose) == "0"), "")
    assumed = upright or (best.pose if lead > TOLD else first)
    names = ", ".join(each.pose for each in alike)
    chosen = f"{assumed} is assumed{', in which most of what is written is upright' if upright else ''}"
    if lead > TOLD:
        equal = [pose for pose in near if pose != assumed]
        as_likely = f"as likely as {', '.join(equal)} and " if equal else ""
        sentence = (
            f"the {found} marks found do not separate the poses {names} significantly: {chosen}, "
            f"{as_likely}likelier than {first} by log-odds of only {lead:.1f}."
        )
    else:
        sentence = (
            f"nothing in the {found} marks found separates the poses {names}: their pictures and given coordinates are "
            f"alike; {chosen}."
        )
    rivals = tuple(pose_in_camera(each.pose, assumed) for each in alike if each.pose != assumed)
    return Pose(assumed, False, (sentence, *against), written, main, rivals=rivals)


def _against(best: _Hypothesis, rival: _Hypothesis, layout: FiducialLayout, lines: Sequence[Line]) -> tuple[str, ...]:
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


def _writing_sentence(best: _Hypothesis, rival: _Hypothesis, layout: FiducialLayout, lines: Sequence[Line]) -> str:
    """Sentence with the evidence of the writing on two orientations, quoting the most significant lines."""
    lead = best.writing - rival.writing
    by_line = [
        (line_score(line, layout.writing, best.pose) - line_score(line, layout.writing, rival.pose)) * np.sign(lead)
        for line in lines
    ]
    telling = [index for index in np.argsort(-np.array(by_line), kind="stable").tolist() if by_line[index] > 0]
    quoted = ", ".join(f'"{lines[index].text}"' for index in telling[:_QUOTED])
    word = "against" if lead > 0 else "for"
    return f"the writing, such as {quoted}, is evidence {word} pose {rival.pose} with log-odds {abs(lead):.1f}."


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
