"""The frames of a camera checked together: wrong marks, bent film, wrong given coordinates, scanner distortion.

What a frame's marks leave beside an affine transformation is alike in all frames in the camera's axes where given
coordinates are wrong, in the scan's axes where the scanner bends; in one frame it is its film or a mark. Patterns are
estimated from all frames, film and affinity from those that do not stand out, and each frame is tested by
`frame_consistency` against what the others have. Nothing that was measured is changed: film is a variance of its
frame's marks, and a mark that alone is wrong is weak.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.distance import pdist
from scipy.special import chdtrc, chdtri, fdtrc

from measure.fiducials.consistency import (
    LONE_AFFINITY,
    NAMED,
    Affinity,
    FrameMarks,
    Hypothesis,
    Scatter,
    frame_consistency,
    frame_p_value,
)
from measure.fiducials.frame import may_be_wrong
from measure.fiducials.options import ANY_FILM, SCATTER_DEGREES, BelievedFilm
from measure.flags import FALSE_DOUBT, NO_REASON, Cause, Code, Reason, Status
from measure.geometry import up_from_camera
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.results import FrameMeasurement, MarkMeasurement

Array = NDArray[np.float64]

_AXES = 2
_BELIEVED_DEGREES = 4.0  # of freedom of the factor of second places' variances: on real film the edges differ by 1.4
_UNKNOWN_MM = 1.0  # of a pattern of which nothing is known beforehand
_LEAST_MM = 1e-6
_SAME_SITE = 1 / 3  # of the least distance of two marks: marks of two frames nearer by lie at one place of the scan
_FEWEST_ALIKE = 3  # frames: of two nobody knows which one is off
_ROUNDS = 3  # of pattern, film and affinity in turn
_AS_ODD = 0.5  # of the logarithm of the least p-value: frames that stand out as well are explained together
_CLIPPED_AT = 0.25  # p-value of a frame beyond which its chi-square counts as this quantile
_CLIPPED_EFFICIENCY = 0.6  # of a variance from these, against one from the mean of squares
_NAMED_MARKS = 4  # in a sentence


@dataclass(frozen=True, eq=False)
class CheckedFrames:
    """frames: with the statuses, covariances and problems that all frames together give. film_sigma_mm: of each frame,
    along an axis; what is believed beforehand where the frames do not contradict it."""

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
    pitches_um: of each scan, in x and y. film: what is believed of it beforehand.
    """
    checked = [_doubt_marks(frame, own) for frame, own in zip(frames, second_place_doubts(frames), strict=True)]
    films = [film.sigma_mm] * len(frames)
    found = {i: _frame_marks(*pair, layout, film.model) for i, pair in enumerate(zip(checked, pitches_um, strict=True))}
    marks = {place: each for place, each in found.items() if each is not None}
    if not marks:
        return CheckedFrames(tuple(checked), tuple(films))
    given = np.array([min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks])
    poses = {place: pose.name if (pose := checked[place].pose) else "0" for place in marks}
    shared, problem = _shared(marks, poses, layout, given, film.sigma_mm)
    for place in marks:
        names = [layout.marks[index].id for index in shared.frames[place].sites]
        checked[place], films[place] = _explain_frame(checked[place], shared, place, names, film)
        if problem and shared.frames[place].marks.redundancy:
            checked[place] = replace(checked[place], problems=(*checked[place].problems, problem))
    return CheckedFrames(tuple(checked), tuple(films))


# Second places. The edges of a mark put it elsewhere than the match does where it is damaged or not as drawn.
#
# Noise explains such a difference by its covariance. Where more is left in many of a camera's marks, their drawings are
# not quite true, or the film's noise is not quite what it is taken for: their median gives the factor of the variance
# of the differences, beside 1 as it is believed. A mark that stands out among them too is damaged, and weak; any other
# is known no better than its two places differ, and weak only if that is more than a measured mark may be off by.


@dataclass(frozen=True)
class _Doubt:
    """How far off a check puts a mark, and the cause to which that is counted; reason: why it is no longer called
    measured, empty where it still is, only less well known."""

    reason: Reason
    off_px: float
    cause: Cause


def second_place_doubts(frames: Sequence[FrameMeasurement]) -> Iterator[dict[str, _Doubt]]:
    """For each frame the marks whose second places differ from the matched ones by more than noise explains."""
    tested = [[mark for mark in _observed(frame) if "second_method_sigmas" in mark.quality] for frame in frames]
    squares = np.array([mark.quality["second_method_sigmas"] ** 2 for own in tested for mark in own])
    by_noise = chdtrc(_AXES, squares) * len(squares)
    among_others = _p_values_among_others(squares) * len(squares)
    p_values = iter(zip(by_noise.tolist(), among_others.tolist(), strict=True))
    for own in tested:
        each = [(mark, *next(p_values)) for mark in own]
        yield {mark.point: _edge_doubt(mark, among < FALSE_DOUBT) for mark, noise, among in each if noise < FALSE_DOUBT}


def _p_values_among_others(squares: Array) -> Array:
    """(n,) that a mark's two places differ by so many standard deviations, squared, as the others' do."""
    others = [np.median(np.delete(squares, n)) for n in range(len(squares))] if len(squares) > 1 else [0.0]
    degrees = MEDIAN_EFFICIENCY * _AXES * (len(squares) - 1)
    factor = (_BELIEVED_DEGREES + degrees * np.array(others) / chdtri(_AXES, 0.5)) / (_BELIEVED_DEGREES + degrees)
    # Differences that are smaller than noise makes them are no reason to ask more of the others.
    return np.asarray(fdtrc(_AXES, _BELIEVED_DEGREES + degrees, squares / _AXES / np.maximum(factor, 1.0)))


def _edge_doubt(mark: MarkMeasurement, is_alone: bool) -> _Doubt:
    assert mark.covariance_px2 is not None  # an observation has one
    off_px = float(np.hypot(mark.quality["second_method_col_px"], mark.quality["second_method_row_px"]))
    reason = Reason(
        f"its edges put it {off_px:#.2g} px elsewhere, {mark.quality['second_method_sigmas']:.1f} standard "
        "deviations of the difference: it is damaged or unlike its drawing",
        Code.EDGES,
    )
    before, after = mark.covariance_px2, mark.covariance_px2 + off_px**2 / 2 * np.eye(2)
    is_weak = is_alone or (may_be_wrong(after) and not may_be_wrong(before))
    return _Doubt(reason if is_weak else NO_REASON, off_px, Cause.SECOND_METHOD)


def _observed(frame: FrameMeasurement) -> list[MarkMeasurement]:
    """The fiducials of a frame that are observations."""
    return [mark for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation]


def _doubt_marks(frame: FrameMeasurement, doubts: Mapping[str, _Doubt]) -> FrameMeasurement:
    """Make fiducials weak, or less well known by the mean square, an axis, of how far they are off."""
    marks = list(frame.marks)
    for number, mark in enumerate(marks):
        doubt = doubts.get(mark.point) if mark.kind == "fiducial" else None
        if doubt is None or mark.covariance is None:
            continue
        marks[number] = replace(mark, covariance=mark.covariance.plus(doubt.cause, doubt.off_px**2 / 2 * np.eye(2)))
        if doubt.reason:
            reason = Reason.combine((mark.reason, doubt.reason))
            marks[number] = replace(marks[number], status=Status.WEAK, reason=reason)
    return replace(frame, marks=tuple(marks))


# Misfits.


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame's marks, the sites (n,) of the pattern at which they lie, and what explains them. p_value: of one that
    stands out; film_mm: of its film, None of an ordinary one; hypothesis: the best; off_mm: how far wrong marks lie
    off, by their number; suspect_mm2 (n,): variances of marks that may be wrong."""

    marks: FrameMarks
    sites: NDArray[np.intp]
    p_value: float = 1.0
    film_mm: float | None = None
    hypothesis: Hypothesis = Hypothesis.SOUND
    off_mm: Mapping[int, float] = field(default_factory=dict)
    suspect_mm2: Array = field(default_factory=lambda: np.zeros(1))

    @property
    def places(self) -> NDArray[np.intp]:
        """(2n,) of its marks' coordinates in the pattern."""
        return np.asarray((2 * self.sites[:, None] + np.arange(2)).ravel())

    @cached_property
    def widened(self) -> FrameMarks:
        """With the variances of marks that are wrong."""
        off = np.zeros(len(self.sites))
        off[list(self.off_mm)] = list(self.off_mm.values())
        return self.marks.widen(off**2)


def _frame_marks(
    frame: FrameMeasurement, pitch_um: tuple[float, float], layout: FiducialLayout, model: str
) -> _Frame | None:
    """None of a frame of fewer than three marks, or of marks in a line."""
    number = {mark.id: place for place, mark in enumerate(layout.marks)}
    marks = [mark for mark in _observed(frame) if mark.point in number and mark.covariance_px2 is not None]
    sites = np.array([number[mark.point] for mark in marks], dtype=np.intp)
    given = np.array([layout.marks[place].xy_mm for place in sites]).reshape(-1, 2)
    if frame.pixel_from_camera is None or np.linalg.matrix_rank(given - given.mean(axis=0)) < 2:
        return None
    mm = np.diag([pitch_um[0], -pitch_um[1]]) / 1000
    measured = np.array([mm @ np.asarray(mark.center_px) for mark in marks])
    covariances = np.array([mm @ np.asarray(mark.covariance_px2) @ mm.T for mark in marks])
    return _Frame(FrameMarks.from_places(given, measured, covariances, model), sites)


@dataclass(frozen=True, eq=False)
class _Pattern:
    """How far off the given places marks lie in all frames alike, at m sites: information (2m, 2m) and right-hand side
    (2m,) of what the frames say of it; sigma_mm (m,): of each site, and free_mm, by how much more it may be;
    places_mm (m, 2)."""

    sigma_mm: Array
    free_mm: float
    information: Array
    right: Array
    places_mm: Array

    @classmethod
    def from_frames(
        cls, frames: Iterable[tuple[_Frame, float]], sigma_mm: Array, free_mm: float, places_mm: Array
    ) -> "_Pattern":
        information, right = np.zeros((2 * len(sigma_mm),) * 2), np.zeros(2 * len(sigma_mm))
        for frame, film_mm in frames:
            weight = frame.widened.precision(film_mm)
            information[np.ix_(frame.places, frame.places)] += weight
            right[frame.places] += weight @ frame.marks.off_mm.ravel()
        return cls(sigma_mm, free_mm, information, right, places_mm)

    def expected_marks(self, frame: _Frame, film_mm: float, is_pooled: bool = False) -> FrameMarks:
        """The frame's marks beside the pattern that all others show. is_pooled: the pattern's own affinity, which no
        frame shows, is counted to the mean affinity of the frames."""
        weight = frame.widened.precision(film_mm)
        information, right = self._posterior.copy(), self.right.copy()
        information[np.ix_(frame.places, frame.places)] -= weight
        right[frame.places] -= weight @ frame.marks.off_mm.ravel()
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        if is_pooled:
            covariance = self._beyond_affine @ covariance @ self._beyond_affine
        off = (covariance @ right)[frame.places].reshape(-1, 2)
        return frame.widened.expecting(off, covariance[np.ix_(frame.places, frame.places)])

    @cached_property
    def mm(self) -> Array:
        """(m, 2) its estimate."""
        return np.asarray(np.linalg.solve(self._posterior, self.right)).reshape(-1, 2)

    @property
    def p_value(self) -> float:
        """Of the pattern against nothing but its sites' standard deviations."""
        spread = self.information + self.information @ np.diag(np.repeat(self.sigma_mm**2, 2)) @ self.information
        chi_square = float(self.right @ np.linalg.pinv(spread, hermitian=True) @ self.right)
        return float(chdtrc(max(int(np.linalg.matrix_rank(self.information, hermitian=True)), 1), chi_square))

    @property
    def log_density(self) -> float:
        """Of all frames with it over that without any."""
        shared = np.log(self._prior_information).sum() - np.linalg.slogdet(self._posterior)[1]
        return float(shared + self.right @ self.mm.ravel()) / 2

    @cached_property
    def _beyond_affine(self) -> Array:
        """(2m, 2m) projection on what no affine transformation makes of the sites."""
        design = np.kron(np.column_stack([self.places_mm, np.ones(len(self.places_mm))]), np.eye(2))
        return np.eye(len(design)) - design @ np.linalg.pinv(design)

    @cached_property
    def _prior_information(self) -> Array:
        return np.repeat(1 / (self.sigma_mm**2 + self.free_mm**2 + _LEAST_MM**2), 2)

    @cached_property
    def _posterior(self) -> Array:
        return self.information + np.diag(self._prior_information)


@dataclass(frozen=True, eq=False)
class _Explanation:
    """Of all frames of a camera, by their places, with the pattern that they share. film_is_more: whether they scatter
    more than was believed, beyond chance."""

    frames: Mapping[int, _Frame]
    pattern: _Pattern
    film: Scatter
    film_is_more: bool

    @property
    def is_quiet(self) -> bool:
        """Whether nothing stands out."""
        return not (self.film_is_more or any(each.film_mm or each.off_mm for each in self.frames.values()))

    @property
    def log_evidence(self) -> float:
        """What stands out costs as much as it is rare."""
        odd = sum((each.film_mm is not None) + len(each.off_mm) for each in self.frames.values())
        alone = sum(each.widened.log_density(each.film_mm or self.film.sigma) for each in self.frames.values())
        return alone + self.pattern.log_density + odd * float(np.log(FALSE_DOUBT))


def _shared(
    frames: Mapping[int, _Frame], poses: Mapping[int, str], layout: FiducialLayout, given_mm: Array, film_mm: float
) -> tuple[_Explanation, Reason]:
    """What explains the misfits best: the given places being right, or wrong, or the scanner bending all scans; and a
    sentence where it is not the first."""
    places = np.array([mark.xy_mm for mark in layout.marks])
    if len(frames) == 1:
        return _explain(frames, poses, places, given_mm, 0.0, film_mm), NO_REASON
    by_places = _explain_by_pattern(frames, poses, places, given_mm, film_mm)
    is_clear, lie_alike = by_places.pattern.p_value >= FALSE_DOUBT, len(set(poses.values())) == 1
    if is_clear and (by_places.is_quiet or lie_alike):
        return _explain(frames, poses, places, given_mm, 0.0, film_mm), NO_REASON
    if lie_alike:
        scanner = " The scanner may do the same: all frames lie alike in it."
        return by_places, _wrong_places(by_places, layout, scanner)
    sites = _scan_sites(frames, poses)
    turned = {place: _in_scan_axes(each, poses[place], sites, given_mm) for place, each in frames.items()}
    by_scanner = _explain_by_pattern(turned, poses, sites, np.zeros(len(sites)), film_mm)
    lead = by_scanner.log_evidence - by_places.log_evidence
    if lead > NAMED and by_scanner.pattern.p_value < FALSE_DOUBT:
        kept = {place: replace(each, sites=frames[place].sites) for place, each in by_scanner.frames.items()}
        return replace(by_scanner, frames=kept), _bent_scans(by_scanner)
    if is_clear:
        return _explain(frames, poses, places, given_mm, 0.0, film_mm), NO_REASON
    return by_places, _wrong_places(by_places, layout, "" if lead < -NAMED else " The scanner may do the same.")


def _scan_sites(frames: Mapping[int, _Frame], poses: Mapping[int, str]) -> Array:
    """(m, 2) places in the scan's axes at which marks lie in frames of those poses."""
    places = [each.marks.given_mm @ up_from_camera(poses[place]).T for place, each in frames.items()]
    near = _SAME_SITE * min(float(pdist(own).min()) for own in places)
    sites = list[Array]()
    for place in np.unique(np.round(np.concatenate(places), 6), axis=0):
        if not any(np.hypot(*(place - site)) < near for site in sites):
            sites.append(place)
    return np.array(sites)


def _in_scan_axes(frame: _Frame, pose: str, sites: Array, given_mm: Array) -> _Frame:
    """The frame in the scan's axes, right and up, and at the sites (m, 2) of the scan, its given places as uncertain as
    given_mm says."""
    marks = frame.marks.widen(given_mm[frame.sites] ** 2).rotate(up_from_camera(pose))
    nearest = np.hypot(*np.moveaxis(marks.given_mm[:, None] - sites[None], -1, 0)).argmin(axis=1)
    return _Frame(marks, nearest)


def _explain_by_pattern(
    frames: Mapping[int, _Frame], poses: Mapping[int, str], places_mm: Array, sigma_mm: Array, film_mm: float
) -> _Explanation:
    """With a pattern beyond its sites' standard deviations, as large as it is: what is not believed beforehand speaks
    against a hypothesis by how much room it takes."""
    wide = _explain(frames, poses, places_mm, sigma_mm, _UNKNOWN_MM, film_mm)
    size_mm = float(np.sqrt(np.mean(wide.pattern.mm**2)))
    return _explain(frames, poses, places_mm, sigma_mm, max(size_mm, film_mm), film_mm)


def _explain(
    frames: Mapping[int, _Frame],
    poses: Mapping[int, str],
    places_mm: Array,
    sigma_mm: Array,
    free_mm: float,
    believed_mm: float,
) -> _Explanation:
    """Explain the frames that stand out, the worst first, each by one of its marks or by its film.

    places_mm, sigma_mm: of the pattern's sites; free_mm: by how much it may differ from that beforehand; believed_mm:
    of film.
    """
    frames, film, is_more = dict(frames), Scatter(believed_mm, SCATTER_DEGREES), False
    while True:
        ordinary = [place for place, each in frames.items() if each.film_mm is None]
        alike = Counter(poses[place] for place in ordinary)
        pooled = {place for place in frames if alike[poses[place]] >= _FEWEST_ALIKE}
        widths = {place: each.film_mm or film.sigma for place, each in frames.items()}
        for _ in range(_ROUNDS):  # film gives the weights of the pattern, and the pattern what is left for film
            pattern = _Pattern.from_frames([(frames[p], widths[p]) for p in frames], sigma_mm, free_mm, places_mm)
            expected = {p: pattern.expected_marks(each, widths[p], p in pooled) for p, each in frames.items()}
            film, is_more = _film([expected[place] for place in ordinary], believed_mm)
            widths |= {place: _own_width_mm(expected[place], film) for place in ordinary}
        affinities = _affinities({place: expected[place] for place in ordinary}, poses, film.sigma)
        tests = {place: (expected[place], film, affinities[place]) for place in ordinary}
        p_values = {place: frame_p_value(*test) for place, test in tests.items()}
        least = min(p_values.values(), default=1.0)
        if least * len(frames) >= FALSE_DOUBT:
            alike_films = [(each, each.film_mm or film.sigma) for each in frames.values()]
            pattern = _Pattern.from_frames(alike_films, sigma_mm, free_mm, places_mm)
            return _Explanation(frames, pattern, film, is_more)
        limit = min(FALSE_DOUBT / len(frames), max(least, 1e-300) ** _AS_ODD)
        for place in ordinary:
            if p_values[place] < limit or p_values[place] == least:
                frames[place] = _explain_frame_alone(replace(frames[place], p_value=p_values[place]), *tests[place])


def _explain_frame_alone(frame: _Frame, marks: FrameMarks, film: Scatter, affinity: Affinity) -> _Frame:
    """Explain a frame that stands out by a mark, or else by its film, its pitch or a perspective. Marks that may be the
    wrong one are known no better than they would then lie off."""
    found = frame_consistency(marks, film, affinity)
    off_mm, mark = np.hypot(*found.off_mm.T), found.wrong_mark
    if mark is not None and mark not in frame.off_mm:
        return replace(frame, off_mm={**frame.off_mm, mark: float(off_mm[mark])})
    hypothesis = found.best_hypothesis
    if hypothesis is Hypothesis.PITCH:
        return replace(frame, film_mm=film.sigma, hypothesis=hypothesis)
    film_mm = float(np.sqrt(film.sigma**2 + marks.film_variance_mm2()))
    suspect = np.where(found.suspects, off_mm**2 / 2, 0.0)
    return replace(frame, film_mm=film_mm, hypothesis=hypothesis, suspect_mm2=suspect)


def _own_width_mm(marks: FrameMarks, film: Scatter) -> float:
    """A frame's film where films scatter as Student's t: a frame that stands out has little weight in the pattern."""
    known = SCATTER_DEGREES * film.sigma**2 + marks.redundancy * marks.film_variance_mm2()
    return float(np.sqrt(known / (SCATTER_DEGREES + marks.redundancy)))


def _film(frames: Sequence[FrameMarks], believed_mm: float) -> tuple[Scatter, bool]:
    """From frames that do not stand out, beside what is believed; and whether it is more than that."""
    degrees = np.array([each.redundancy for each in frames], dtype=float)
    frames = [each for each in frames if each.redundancy]
    degrees = degrees[degrees > 0]
    if len(frames) < 2:
        return Scatter(believed_mm, SCATTER_DEGREES), False
    shown = _clipped_variance(lambda variance: np.array([each.chi_square(variance**0.5) for each in frames]), degrees)
    known = _CLIPPED_EFFICIENCY * float(degrees.sum())
    variance = (SCATTER_DEGREES * believed_mm**2 + known * shown) / (SCATTER_DEGREES + known)
    is_more = bool(chdtrc(known, known * shown / believed_mm**2) < FALSE_DOUBT)
    return Scatter(float(np.sqrt(variance)), SCATTER_DEGREES + known), is_more


def _affinities(frames: Mapping[int, FrameMarks], poses: Mapping[int, str], film_mm: float) -> dict[int, Affinity]:
    """Of each frame what the others show that lie alike, about their median."""
    result = dict.fromkeys(frames, LONE_AFFINITY)
    for pose in {poses[place] for place in frames}:
        alike = [place for place in frames if poses[place] == pose]
        if len(alike) < _FEWEST_ALIKE:
            continue
        fits = [frames[place].affinity(film_mm) for place in alike]
        fitted, covariances = (np.array(each) for each in zip(*fits, strict=True))
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
    """The variance with which clipped chi-squares (n,) have their expected mean: what stands out moves it little."""
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


# What the user reads.


def _explain_frame(
    frame: FrameMeasurement, shared: _Explanation, place: int, names: Sequence[str], film: BelievedFilm
) -> tuple[FrameMeasurement, float]:
    """The frame with what its marks say, and its film's standard deviation."""
    own, alone = shared.frames[place], len(shared.frames) == 1
    film_mm = own.film_mm or (shared.film.sigma if shared.film_is_more else film.sigma_mm)
    mm = 1 / frame.px_per_mm if frame.px_per_mm else 1.0
    has_it = "the other marks have it, more than film and given places explain"
    if not alone:
        has_it = "the camera's other frames have it, more than they scatter"
    code, cause = (Code.OFF_GIVEN, Cause.GIVEN_PLACES) if alone else (Code.OFF_FRAMES, Cause.OTHER_FRAMES)
    doubts = {
        names[mark]: _Doubt(Reason(f"it lies {off:.3f} mm from where {has_it}", code), off / mm, cause)
        for mark, off in own.off_mm.items()
    }
    added = film_mm**2 - film.added_later_mm**2 if film_mm > film.sigma_mm else 0.0
    variances = np.maximum(added, own.suspect_mm2 * np.ones(len(names)))
    frame = _add_film(_doubt_marks(frame, doubts), dict(zip(names, variances.tolist(), strict=True)), mm)
    problems = (*frame.problems, *_problems(own, shared, names, variances, frame.problems))
    return replace(frame, problems=problems), film_mm


def _add_film(frame: FrameMeasurement, variances_mm2: Mapping[str, float], mm: float) -> FrameMeasurement:
    """Add what the film does to the covariance of each of its fiducials. mm: of a pixel."""
    marks = tuple(
        replace(mark, covariance=mark.covariance.plus(Cause.FILM, variance / mm**2 * np.eye(2)))
        if mark.kind == "fiducial"
        and mark.covariance is not None
        and (variance := variances_mm2.get(mark.point, 0)) > 0
        else mark
        for mark in frame.marks
    )
    return replace(frame, marks=marks)


def _problems(
    own: _Frame, shared: _Explanation, names: Sequence[str], variances_mm2: Array, before: Sequence[Reason]
) -> list[Reason]:
    """Sentences of a frame that stands out."""
    if own.film_mm is None:
        return []
    alone = len(shared.frames) == 1
    expected = shared.pattern.expected_marks(own, own.film_mm)
    p_value, known_um = f"p = {own.p_value:.1g} for film deformation alone", 1000 * float(np.sqrt(variances_mm2.max()))
    widened = f"The standard deviation of its marks is set to {known_um:.0f} µm."
    than = "the given coordinates" if alone else "what the camera's frames have in common"
    if own.hypothesis is Hypothesis.PITCH:
        if any(Code.PITCH in problem.codes for problem in before):
            return []
        sentence = (
            f"its marks are stretched against {than}; {p_value}. A wrong pitch, or film that is stretched more, "
            "explains it best: check pitch_um in the project."
        )
        return [Reason(sentence, Code.BENT_FRAME, Code.PITCH)]
    if own.hypothesis is Hypothesis.PERSPECTIVE:
        sentence = (
            f"its marks show a perspective against {than}, {_distances(names, expected.distances_mm())} beside an "
            f'affine transformation; {p_value}. The film was photographed obliquely: set transformation = "projective" '
            f"under [adjust]. {widened}"
        )
        return [Reason(sentence, Code.BENT_FRAME)]
    if not own.marks.redundancy:
        sentence = (
            f"its three marks {', '.join(names)} do not have the shape that {than} have; {p_value}, and nothing else "
            f"checks three marks. One of the marks is off, or the pitch is wrong. {widened}"
        )
        return [Reason(sentence, Code.OFF_GIVEN if alone else Code.OFF_FRAMES)]
    cause = (
        "Film or scanner bent it, a mark is wrong, or the coordinates are not those of this camera; one frame does not "
        "tell."
        if alone
        else "Its film is bent, or was moved while it was scanned, or one of few marks is wrong."
    )
    sentence = (
        f"no affine transformation takes {than} to its marks, which lie off, "
        f"{_distances(names, expected.distances_mm())}; {p_value}. {cause} {widened}"
    )
    return [Reason(sentence, Code.BENT_FRAME)]


def _wrong_places(shared: _Explanation, layout: FiducialLayout, rest: str) -> Reason:
    names = [mark.id for mark in layout.marks]
    return Reason(
        f"in all frames of the camera the marks lie beside the given coordinates in the same way, "
        f"{_distances(names, np.hypot(*shared.pattern.mm.T))}, under an affine transformation: p = "
        f"{shared.pattern.p_value:.1g} for their standard deviations. Check whether these are the coordinates of this "
        f"camera.{rest}",
        Code.OFF_GIVEN,
    )


def _bent_scans(shared: _Explanation) -> Reason:
    most = float(np.hypot(*shared.pattern.mm.T).max())
    return Reason(
        f"all scans are bent in the same way in the scanner's axes, by up to {most:.3f} mm beside an affine "
        f"transformation (p = {shared.pattern.p_value:.1g} without): the scanner does it.",
        Code.BENT_SCANS,
    )


def _distances(names: Sequence[str], off_mm: Array) -> str:
    """Those marks farthest off, with their distances."""
    worst = np.argsort(-off_mm, kind="stable")[:_NAMED_MARKS]
    rest = f", {len(names) - len(worst)} others by less" if len(names) > len(worst) else ""
    return ", ".join(f"{names[k]} by {off_mm[k]:.3f} mm" for k in worst) + rest
