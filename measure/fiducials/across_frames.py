"""Joint check of a camera's frames: gross errors, bent film, wrong given coordinates, scanner distortion.

Wrong given coordinates cause equal residuals of an affine transformation in all frames in the camera's axes, scanner
distortion in the scan's axes. Residuals of one frame only come from its film or a gross error. Measured
places are not changed: film deformation adds a variance to the marks of its frame, and a single mark with a gross error
becomes weak.

The pattern of residuals is estimated from all frames, film scatter and affinity from those that are no outliers. Each
frame is tested by `frame_consistency` against the other frames: its own misfit is left out of the scatter, where it
would hide a wrong mark.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.distance import pdist
from scipy.special import chdtrc, chdtri

from measure.array_types import Array, Mask
from measure.fiducials.consistency import (
    LONE_AFFINITY,
    MOST_STRETCHED,
    NAMED,
    Affinity,
    FrameMarks,
    Hypothesis,
    Scatter,
    frame_consistency,
    frame_p_value,
)
from measure.fiducials.mark_comparison import check_own_figures
from measure.fiducials.options import ANY_FILM, SCATTER_DEGREES, BelievedFilm
from measure.flags import FALSE_DOUBT, NO_REASON, Cause, Code, Reason, Status
from measure.geometry import UP_FROM_CAMERA
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.results import FrameMeasurement, MarkMeasurement

_UNKNOWN_MM = 1.0  # standard deviation of a pattern without prior knowledge
_LEAST_MM = 1e-6  # smallest standard deviation of a site
_FEWEST_ALIKE = 3  # frames of one scan orientation: of two, either may be the outlier
_ROUNDS = 3  # alternations of pattern and film scatter
_AS_ODD = 0.5  # fraction of the log of the smallest p-value: frames below it are explained in the same round
_CLIPPED_AT = 0.25  # upper-tail probability at whose quantile chi-squares are clipped
_CLIPPED_EFFICIENCY = 0.6  # of a variance from clipped chi-squares, relative to one from the mean of squares
_SAME_SITE = 1 / 3  # fraction of the least distance of two marks: closer marks of two frames share a site of the scan
_MANY = 20  # frames of which one is no longer left out of the film scatter that it is tested by
_NAMED_MARKS = 4  # largest number of marks named in a sentence


@dataclass(frozen=True, eq=False)
class FrameMisfit:
    """Marks of a frame and the explanation of their misfit.

    Attributes
    ----------
    marks : n marks.
    sites : (n,) their sites in the pattern.
    pose : scan orientation.
    weak : (n,) marks with the status weak.
    p_value : p-value of an outlying frame.
    film_mm : own scatter of its film; None for an ordinary frame.
    hypothesis : accepted hypothesis.
    off_mm : (n,) size of the gross errors; 0 for other marks.
    jump_mm : size of a jump within the scan; None without one.
    suspect_mm2 : (n,) variances of marks that may have a gross error.
    weak_mm2 : variance along an axis that the weak marks have in addition.
    """

    marks: FrameMarks
    sites: NDArray[np.intp]
    pose: str
    weak: Mask
    off_mm: Array
    suspect_mm2: Array
    p_value: float = 1.0
    film_mm: float | None = None
    hypothesis: Hypothesis = Hypothesis.SOUND
    jump_mm: float | None = None
    weak_mm2: float = 0.0

    @property
    def places(self) -> NDArray[np.intp]:
        """(2n,) indices of its marks' coordinates in the pattern."""
        return np.asarray((2 * self.sites[:, None] + np.arange(2)).ravel())

    @cached_property
    def enlarged_marks(self) -> FrameMarks:
        """Marks with variances enlarged by their gross errors."""
        return self.marks.widen(self.off_mm**2)


Frames = Mapping[int, FrameMisfit]  # by index among the camera's frames


@dataclass(frozen=True, eq=False)
class MisfitPattern:
    """Misfit of m sites that is common to all frames.

    Attributes
    ----------
    places_mm, sigma_mm : (m, 2) places of the sites, (m,) their standard deviations.
    free_mm : prior standard deviation of the pattern in addition to sigma_mm.
    frames, films_mm : frames from which it is estimated, and the film scatter of each.
    """

    places_mm: Array
    sigma_mm: Array
    free_mm: float = 0.0
    frames: Frames = field(default_factory=dict)
    films_mm: Mapping[int, float] = field(default_factory=dict)

    def expected_marks(self, place: int, is_pooled: bool = False) -> FrameMarks:
        """Marks of a frame less the pattern of all other frames. is_pooled: remove the affinity from the pattern; it
        cannot be separated from the mean affinity of the frames, and is counted there."""
        frame = self.frames[place]
        if len(self.frames) == 1:  # many marks keep separate covariances
            return frame.enlarged_marks.widen(1 / self._prior_information[frame.places[::2]])
        own, (weights, _, right) = np.ix_(frame.places, frame.places), self._normal
        information, right = self._posterior.copy(), right.copy()
        information[own] -= weights[place]
        right[frame.places] -= weights[place] @ frame.marks.off_mm.ravel()
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        if is_pooled:
            covariance = self._affine_complement @ covariance @ self._affine_complement
        expected, marks = (covariance @ right)[frame.places].reshape(-1, 2), frame.enlarged_marks
        return replace(marks, off_mm=marks.off_mm - expected, shared_mm2=covariance[own])

    @cached_property
    def mm(self) -> Array:
        """(m, 2) estimated pattern, mm."""
        return np.asarray(np.linalg.solve(self._posterior, self._normal[2])).reshape(-1, 2)

    @property
    def p_value(self) -> float:
        """p-value of the pattern under the null hypothesis that the sites deviate by sigma_mm only."""
        _, information, right = self._normal
        spread = information + information @ np.diag(np.repeat(self.sigma_mm**2, 2)) @ information
        chi_square = float(right @ np.linalg.pinv(spread, hermitian=True) @ right)
        return float(chdtrc(max(int(np.linalg.matrix_rank(information, hermitian=True)), 1), chi_square))

    @property
    def log_density(self) -> float:
        """Log density of all frames with the pattern, relative to that without."""
        shared = np.log(self._prior_information).sum() - np.linalg.slogdet(self._posterior)[1]
        return float(shared + self._normal[2] @ self.mm.ravel()) / 2

    @cached_property
    def _normal(self) -> tuple[dict[int, Array], Array, Array]:
        """Weight matrices (2n, 2n) of the frames' marks; their sum (2m, 2m) and the right side (2m,)."""
        weights, size = dict[int, Array](), 2 * len(self.sigma_mm)
        information, right = np.zeros((size, size)), np.zeros(size)
        for place, frame in self.frames.items():
            weights[place] = frame.enlarged_marks.precision(self.films_mm[place])
            information[np.ix_(frame.places, frame.places)] += weights[place]
            right[frame.places] += weights[place] @ frame.marks.off_mm.ravel()
        return weights, information, right

    @cached_property
    def _affine_complement(self) -> Array:
        """(2m, 2m) projection on the complement of affine transformations of the sites."""
        design = np.kron(np.column_stack([self.places_mm, np.ones(len(self.places_mm))]), np.eye(2))
        return np.eye(len(design)) - design @ np.linalg.pinv(design)

    @cached_property
    def _prior_information(self) -> Array:
        return np.repeat(1 / (self.sigma_mm**2 + self.free_mm**2 + _LEAST_MM**2), 2)

    @cached_property
    def _posterior(self) -> Array:
        return self._normal[1] + np.diag(self._prior_information)


@dataclass(frozen=True, eq=False)
class FramesExplanation:
    """Explanation of all frames of a camera, with their common pattern. film_is_more: whether the film scatters
    significantly more than its prior."""

    pattern: MisfitPattern
    film: Scatter
    film_is_more: bool

    @property
    def frames(self) -> Frames:
        return self.pattern.frames

    @property
    def is_lone(self) -> bool:
        """Whether no other frame checks the misfit of any: at most one has more marks than an affine transformation
        needs."""
        return sum(each.marks.redundancy > 0 for each in self.frames.values()) < 2

    @property
    def log_evidence(self) -> float:
        """Log evidence of the explanation. Each outlying frame or mark has the prior probability `FALSE_DOUBT`."""
        odd = sum((each.film_mm is not None) + np.count_nonzero(each.off_mm) for each in self.frames.values())
        alone = sum(each.enlarged_marks.log_density(each.film_mm or self.film.sigma) for each in self.frames.values())
        return float(alone + self.pattern.log_density + odd * np.log(FALSE_DOUBT))


def explain_by_pattern(frames: Frames, sites: MisfitPattern, believed_mm: float) -> FramesExplanation:
    """Explain the frames with a pattern larger than the standard deviations of its sites.

    Its prior standard deviation is set to its estimated size, since a wider prior lowers the evidence of the
    hypothesis.
    """
    wide = explain(frames, replace(sites, free_mm=_UNKNOWN_MM), believed_mm)
    size_mm = float(np.sqrt(np.mean(wide.pattern.mm**2)))
    return explain(frames, replace(sites, free_mm=max(size_mm, believed_mm)), believed_mm)


def explain(frames: Frames, sites: MisfitPattern, believed_mm: float) -> FramesExplanation:
    """Explain outlying frames, the worst first, each by a gross error in one of its marks or by its film.

    Parameters
    ----------
    frames : frames, by index.
    sites : pattern without frames, with the prior of its sites.
    believed_mm : prior standard deviation of the film's scatter.
    """
    frames, film, is_more = dict(frames), Scatter(believed_mm, SCATTER_DEGREES), False
    while True:
        ordinary = [place for place, each in frames.items() if each.film_mm is None]
        alike = Counter(frames[place].pose for place in ordinary)
        films_mm = {place: each.film_mm or film.sigma for place, each in frames.items()}
        for _ in range(_ROUNDS):  # the film scatter weights the pattern; the residuals of the pattern give the scatter
            pattern = replace(sites, frames=frames, films_mm=films_mm)
            expected = {
                place: pattern.expected_marks(place, alike[each.pose] >= _FEWEST_ALIKE)
                for place, each in frames.items()
            }
            film, is_more = _film([expected[place] for place in ordinary], believed_mm, fewest=2)
            films_mm = films_mm | {place: _own_film_mm(expected[place], film) for place in ordinary}
        affinities = _affinities({place: (expected[place], frames[place].pose) for place in ordinary}, film.sigma)
        tests = {}
        for place in ordinary:
            variance = _weak_mm2(frames[place], expected[place], film.sigma, affinities[place])
            # Weak marks are no evidence on the frame.
            widened = expected[place].widen(np.where(frames[place].weak, variance, 0.0))
            others = [expected[each] for each in ordinary if each != place]
            by_others = _film(others, believed_mm)[0] if len(ordinary) < _MANY else film
            tests[place] = widened, by_others, affinities[place]
        p_values = {place: frame_p_value(*test) for place, test in tests.items()}
        least = min(p_values.values(), default=1.0)
        if least * len(frames) >= FALSE_DOUBT:
            films_mm = {place: each.film_mm or film.sigma for place, each in frames.items()}
            for place, each in frames.items():
                variance = _weak_mm2(each, expected[place], films_mm[place], affinities.get(place, LONE_AFFINITY))
                frames[place] = replace(each, weak_mm2=variance)
            return FramesExplanation(replace(sites, frames=frames, films_mm=films_mm), film, is_more)
        limit = min(FALSE_DOUBT / len(frames), max(least, 1e-300) ** _AS_ODD)
        for place, p_value in p_values.items():
            if p_value < limit or p_value == least:
                frames[place] = _explain_alone(replace(frames[place], p_value=p_value), *tests[place])


def _explain_alone(frame: FrameMisfit, marks: FrameMarks, film: Scatter, affinity: Affinity) -> FrameMisfit:
    """Explain an outlying frame by a gross error in one mark, or else by a jump, film, pitch or perspective."""
    found = frame_consistency(marks, film, affinity)
    off_mm, mark = np.hypot(*found.off_mm.T)[: len(frame.sites)], found.wrong_mark
    if mark is not None and not frame.off_mm[mark]:
        return replace(frame, off_mm=np.where(np.arange(len(off_mm)) == mark, off_mm, frame.off_mm))
    hypothesis = found.best_hypothesis
    if hypothesis is Hypothesis.PITCH:
        return replace(frame, film_mm=film.sigma, hypothesis=hypothesis)
    film_mm = float(np.sqrt(film.sigma**2 + marks.film_variance_mm2()))
    suspect = np.where(found.suspects, off_mm**2 / 2, 0.0)
    return replace(frame, film_mm=film_mm, hypothesis=hypothesis, suspect_mm2=suspect, jump_mm=found.jump_mm)


def _weak_mm2(frame: FrameMisfit, marks: FrameMarks, film_mm: float, affinity: Affinity) -> float:
    """Variance that the weak marks of a frame have in addition: whatever made them weak may have moved them."""
    if not frame.weak.any():
        return 0.0
    if frame.hypothesis is Hypothesis.PITCH:
        affinity = replace(affinity, scatter=Scatter(MOST_STRETCHED))
    return marks.widen(frame.suspect_mm2).added_variance_mm2(frame.weak, film_mm, affinity)


def _own_film_mm(marks: FrameMarks, film: Scatter) -> float:
    """Film scatter of one frame, with Student's t across frames: outlying ones get little weight in the pattern."""
    known = SCATTER_DEGREES * film.sigma**2 + marks.redundancy * marks.film_variance_mm2()
    return float(np.sqrt(known / (SCATTER_DEGREES + marks.redundancy)))


def _film(frames: Sequence[FrameMarks], believed_mm: float, fewest: int = 1) -> tuple[Scatter, bool]:
    """Film scatter from ordinary frames, combined with its prior; and whether it is significantly larger than that.

    fewest: number of frames below which the prior stands.
    """
    frames = [each for each in frames if each.redundancy]
    if len(frames) < fewest:
        return Scatter(believed_mm, SCATTER_DEGREES), False
    degrees = np.array([each.redundancy for each in frames], dtype=float)
    shown = _clipped_variance(lambda variance: np.array([each.chi_square(variance**0.5) for each in frames]), degrees)
    known = _CLIPPED_EFFICIENCY * float(degrees.sum())
    variance = (SCATTER_DEGREES * believed_mm**2 + known * shown) / (SCATTER_DEGREES + known)
    is_more = bool(chdtrc(known, known * shown / believed_mm**2) < FALSE_DOUBT)
    return Scatter(float(np.sqrt(variance)), SCATTER_DEGREES + known), is_more


def _affinities(frames: Mapping[int, tuple[FrameMarks, str]], film_mm: float) -> dict[int, Affinity]:
    """For each frame, median and scatter of the affinity of the others with the same scan orientation."""
    result = dict.fromkeys(frames, LONE_AFFINITY)
    for pose in {pose for _, pose in frames.values()}:
        alike = [place for place, (_, own) in frames.items() if own == pose]
        if len(alike) < _FEWEST_ALIKE:
            continue
        fitted, covariances = map(np.array, zip(*(frames[p][0].affinity(film_mm) for p in alike), strict=True))
        apart, size = fitted - np.median(fitted, axis=0), fitted.shape[1]

        def chi_squares(variance: float, apart: Array = apart, covariances: Array = covariances) -> Array:
            spread = covariances + max(variance, 1e-18) * np.eye(apart.shape[1])
            return np.asarray(np.einsum("fi,fi->f", apart, np.linalg.solve(spread, apart[..., None])[..., 0]))

        variance = _clipped_variance(chi_squares, np.full(len(alike), float(size)))
        others = len(alike) - 1
        of_median = np.pi / 2 / others * (variance + float(np.trace(covariances.mean(axis=0))) / size)
        scatter = Scatter(float(np.sqrt(variance + of_median)), _CLIPPED_EFFICIENCY * size * others)
        for number, place in enumerate(alike):
            result[place] = Affinity(np.median(np.delete(fitted, number, axis=0), axis=0), scatter)
    return result


def _clipped_variance(chi_squares: Callable[[float], Array], degrees: Array) -> float:
    """Variance with which the sum of the clipped chi-squares (n,) equals its expectation: robust against outliers."""
    limit = chdtri(degrees, _CLIPPED_AT)
    expected = degrees * (1 - chdtrc(degrees + 2, limit)) + _CLIPPED_AT * limit

    def excess(variance: float) -> float:
        return float((np.minimum(chi_squares(variance), limit) - expected).sum())

    if excess(0.0) <= 0:
        return 0.0
    most = _UNKNOWN_MM**2
    while excess(most) > 0:
        most *= 10
    return float(brentq(excess, 0.0, most))


def _observed_fiducials(frame: FrameMeasurement) -> list[MarkMeasurement]:
    return [mark for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation]


def _doubt(mark: MarkMeasurement, cause: Cause, variance_px2: float, reason: Reason = NO_REASON) -> MarkMeasurement:
    """Add a variance along an axis to an observed mark; it becomes weak if there is a reason."""
    assert mark.covariance is not None
    status, reasons = (Status.WEAK if reason else mark.status), Reason.combine((mark.reason, reason))
    covariance = mark.covariance.plus(cause, variance_px2 * np.eye(2))
    return replace(mark, covariance=covariance, status=status, reason=reasons)


def _replace_marks(frame: FrameMeasurement, changed: Mapping[str, MarkMeasurement]) -> FrameMeasurement:
    """Replace some fiducials, by name."""
    marks = (changed.get(mark.point, mark) if mark.kind == "fiducial" else mark for mark in frame.marks)
    return replace(frame, marks=tuple(marks))


@dataclass(frozen=True, eq=False)
class CheckedFrames:
    """Frames after the joint check.

    Attributes
    ----------
    frames : with the statuses, covariances and problems that follow from all frames.
    film_sigma_mm : of each frame, scatter of the film along an axis; the prior unless the frames contradict it.
    """

    frames: tuple[FrameMeasurement, ...]
    film_sigma_mm: tuple[float, ...]


def check_frames(
    frames: Sequence[FrameMeasurement],
    layout: FiducialLayout,
    pitches_um: Sequence[tuple[float, float]],
    film: BelievedFilm = ANY_FILM,
) -> CheckedFrames:
    """Check all measured frames of one camera together.

    Parameters
    ----------
    frames : measured frames.
    layout : marks of the camera.
    pitches_um : pixel pitch of each scan, in x and y.
    film : prior knowledge of the film.
    """
    checked, films = check_own_figures(frames), [film.sigma_mm] * len(frames)
    found = {i: _misfit(*pair, layout, film) for i, pair in enumerate(zip(checked, pitches_um, strict=True))}
    misfits = {place: each for place, each in found.items() if each is not None}
    # Frames of another size than the given coordinates tell nothing of what those of the camera have in common.
    stretched = [place for place in misfits if any(Code.PITCH in each.codes for each in checked[place].problems)]
    if 2 * len(stretched) < len(misfits):
        for place in stretched:
            misfits[place] = replace(misfits[place], film_mm=film.sigma_mm, hypothesis=Hypothesis.PITCH)
    if misfits:
        shared, problem = _explain_together(misfits, layout, film.sigma_mm)
        common = [problem] if problem else []
        if shared.film_is_more:  # next to frames that scatter so much a wrong mark hides
            sentence = (
                "in the frames of its camera film or scanner displaces the marks by "
                f"{1000 * shared.film.sigma:.0f} µm along an axis, where {1000 * film.sigma_mm:.0f} µm are expected: a "
                "mark that is wrong by several times as much is not seen. Their standard deviations are set to it. If "
                "it is right, state film_sigma_um under [adjust]."
            )
            common.append(Reason(sentence, Code.BENT_FRAME))
        for place, own in shared.frames.items():
            names = [layout.marks[index].id for index in misfits[place].sites]
            checked[place], films[place] = _add_findings(checked[place], place, shared, names, film)
            if own.marks.redundancy:
                checked[place] = replace(checked[place], problems=(*checked[place].problems, *common))
    return CheckedFrames(tuple(checked), tuple(films))


def _misfit(
    frame: FrameMeasurement, pitch_um: tuple[float, float], layout: FiducialLayout, film: BelievedFilm
) -> FrameMisfit | None:
    """Misfit of a frame; None for fewer than three marks, or collinear ones."""
    number = {mark.id: place for place, mark in enumerate(layout.marks)}
    marks = [mark for mark in _observed_fiducials(frame) if mark.point in number]
    sites = np.array([number[mark.point] for mark in marks], dtype=np.intp)
    given = np.array([layout.marks[place].xy_mm for place in sites]).reshape(-1, 2)
    if frame.pixel_from_camera is None or np.linalg.matrix_rank(given[1:] - given[:1]) < 2:
        return None
    mm = np.diag([pitch_um[0], -pitch_um[1]]) / 1000
    places = np.array([mark.center_px for mark in marks])
    measured = (places if film.lens is None else film.lens.ideal_px(places)) @ mm
    covariances = np.array([mm @ np.asarray(mark.covariance_px2) @ mm.T for mark in marks])
    pose = frame.pose.name if frame.pose else "0"
    weak = np.array([mark.status is Status.WEAK for mark in marks])
    own = FrameMarks.from_places(given, measured, covariances, film.model)
    return FrameMisfit(own, sites, pose, weak, off_mm=np.zeros(len(marks)), suspect_mm2=np.zeros(len(marks)))


def _explain_together(frames: Frames, layout: FiducialLayout, film_mm: float) -> tuple[FramesExplanation, Reason]:
    """Explain the misfits by film and marks alone, wrong given coordinates or the scanner, with the problem."""
    given_mm = np.array([min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks])
    given = MisfitPattern(layout.places_mm, given_mm)
    by_given = explain(frames, given, film_mm)
    if by_given.is_lone:
        return by_given, NO_REASON
    by_places = explain_by_pattern(frames, given, film_mm)
    is_clear = by_places.pattern.p_value >= FALSE_DOUBT
    rest = " The scanner may do the same: all frames lie alike in it."
    has_outliers = by_places.film_is_more or any(
        each.film_mm or each.off_mm.any() for each in by_places.frames.values()
    )
    if len({each.pose for each in frames.values()}) > 1 and (has_outliers or not is_clear):
        sites, turned = _turn_to_scan_axes(frames, given_mm)
        by_scanner = explain_by_pattern(turned, MisfitPattern(sites, np.zeros(len(sites))), film_mm)
        lead = by_scanner.log_evidence - by_places.log_evidence
        if lead > NAMED and by_scanner.pattern.p_value < FALSE_DOUBT:
            most = float(np.hypot(*by_scanner.pattern.mm.T).max())
            return by_scanner, Reason(
                f"all scans are bent in the same way in the scanner's axes, by up to {most:.3f} mm after an affine "
                f"transformation (p = {by_scanner.pattern.p_value:.1g} without): the scanner does it.",
                Code.BENT_SCANS,
            )
        rest = "" if lead < -NAMED else " The scanner may do the same."
    if is_clear:
        return by_given, NO_REASON
    off_mm = np.hypot(*by_places.pattern.mm.T)
    worst = np.argsort(-off_mm, kind="stable")[:_NAMED_MARKS]
    off = ", ".join(f"{layout.marks[k].id} by {off_mm[k]:.3f} mm" for k in worst)
    off += f", {len(off_mm) - len(worst)} others by less" if len(off_mm) > len(worst) else ""
    return by_places, Reason(
        f"the given coordinates differ from all frames of the camera in the same way, {off}, after an affine "
        f"transformation: p = {by_places.pattern.p_value:.1g} for their standard deviations. Check whether they are "
        f"those of this camera.{rest}",
        Code.OFF_GIVEN,
    )


def _turn_to_scan_axes(frames: Frames, given_mm: Array) -> tuple[Array, dict[int, FrameMisfit]]:
    """(m, 2) sites of the marks of all frames in the scan's axes; and the frames in these axes, each mark at the
    nearest site, with the variances of its given place added."""
    places = [each.marks.given_mm @ UP_FROM_CAMERA[each.pose].T for each in frames.values()]
    near = _SAME_SITE * min(float(pdist(own).min()) for own in places)
    distinct = list[Array]()
    for place in np.unique(np.round(np.concatenate(places), 6), axis=0):
        if not any(np.hypot(*(place - site)) < near for site in distinct):
            distinct.append(place)
    sites, turned = np.array(distinct), {}
    for place, frame in frames.items():
        marks = frame.marks.widen(given_mm[frame.sites] ** 2).rotate(UP_FROM_CAMERA[frame.pose])
        nearest = np.hypot(*np.moveaxis(marks.given_mm[:, None] - sites[None], -1, 0)).argmin(axis=1)
        turned[place] = replace(frame, marks=marks, sites=nearest)
    return sites, turned


def _add_findings(
    frame: FrameMeasurement, place: int, shared: FramesExplanation, names: Sequence[str], film: BelievedFilm
) -> tuple[FrameMeasurement, float]:
    """Add the findings to a frame: covariances, statuses and problems. Returns also the film's standard deviation."""
    own = shared.frames[place]
    film_mm = own.film_mm or (shared.film.sigma if shared.film_is_more else film.sigma_mm)
    px_per_mm = frame.px_per_mm or 1.0
    code, cause = Code.OFF_FRAMES, Cause.OTHER_FRAMES
    has_it = "the camera's other frames have it, more than they scatter"
    if shared.is_lone:
        code, cause = Code.OFF_GIVEN, Cause.GIVEN_PLACES
        has_it = "the other marks have it, more than film and given places explain"
    added_later_mm = film.sigma_mm if film.is_stated else 0.0
    added = film_mm**2 - added_later_mm**2 if film_mm > film.sigma_mm else 0.0
    variances = np.maximum(added, own.suspect_mm2)
    changed = {mark.point: mark for mark in _observed_fiducials(frame)}
    for name, off, variance, is_weak in zip(names, own.off_mm.tolist(), variances.tolist(), own.weak, strict=True):
        reason = Reason(f"it lies {off:.3f} mm from where {has_it}", code) if off else NO_REASON
        mark = _doubt(changed[name], cause, (off**2 / 2 + own.weak_mm2 * is_weak) * px_per_mm**2, reason)
        changed[name] = _doubt(mark, Cause.FILM, variance * px_per_mm**2)
    known_um = 1000 * float(np.sqrt(max(variances.max(), film_mm**2)))  # including what the adjustment adds later
    problem = _problem(place, shared, names, known_um)
    is_known = own.hypothesis is Hypothesis.PITCH and any(Code.PITCH in each.codes for each in frame.problems)
    other_problems = [each for each in frame.problems if not {*each.codes} & {*problem.codes} & {Code.PERSPECTIVE}]
    problems = (*other_problems, problem) if problem and not is_known else frame.problems
    return replace(_replace_marks(frame, changed), problems=problems), film_mm


def _problem(place: int, shared: FramesExplanation, names: Sequence[str], known_um: float) -> Reason:
    """Problem of an outlying frame, empty for any other. known_um: standard deviation that its marks are given."""
    own = shared.frames[place]
    if own.film_mm is None:
        return NO_REASON
    alone = shared.is_lone
    most_mm = float(shared.pattern.expected_marks(place).distances_mm().max())
    than = "the given coordinates" if alone else "what the camera's frames have in common"
    p_value = f"p = {own.p_value:.1g} for film deformation alone"
    widened = f"The standard deviation of its marks is set to {known_um:.0f} µm."
    if own.hypothesis is Hypothesis.PITCH:
        return Reason(
            f"the frame is stretched against {than}; {p_value}. A wrong pitch, or film that is stretched more, "
            "explains it best: check pitch_um in the project.",
            Code.BENT_FRAME,
            Code.PITCH,
        )
    if own.hypothesis is Hypothesis.PERSPECTIVE:
        return Reason(
            f"the frame shows a perspective against {than}, up to {most_mm:.3f} mm after an affine transformation; "
            f'{p_value}. The film was photographed obliquely: set transformation = "projective" under [adjust]. '
            f"{widened}",
            Code.BENT_FRAME,
            Code.PERSPECTIVE,
        )
    if not own.marks.redundancy:
        return Reason(
            f"its three marks {', '.join(names)} do not have the shape that {than} have; {p_value}, and nothing else "
            f"checks three marks. One of the marks is off, or the pitch is wrong. {widened}",
            Code.OFF_GIVEN if alone else Code.OFF_FRAMES,
        )
    cause = "Its film is bent, or was moved while it was scanned."
    if own.jump_mm is not None:
        cause = (
            f"A jump of the scanner, or a seam of joined strips, of {own.jump_mm:.3f} mm explains it, or film that is "
            "bent: look at the scan, or scan the film again."
        )
    elif alone:
        cause = (
            "Film or scanner bent it, or the coordinates are not those of this camera; one frame does not tell which."
        )
    if own.suspect_mm2.any():
        cause += " Or one of its marks is wrong: look at all of them."
    return Reason(
        f"the frame is deformed against {than} by up to {most_mm:.3f} mm after an affine transformation; {p_value}. "
        f"{cause} {widened}",
        Code.BENT_FRAME,
    )
