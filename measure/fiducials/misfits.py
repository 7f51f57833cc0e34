"""Explanation of the misfits of a camera's frames: a common pattern, film scatter and affinity, or gross errors.

The pattern is estimated from all frames, film scatter and affinity from those that are no outliers. Each frame is
tested by `frame_consistency` against the other frames.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtrc, chdtri

from measure.array_types import Array, Mask
from measure.fiducials.consistency import (
    LONE_AFFINITY,
    MOST_STRETCHED,
    Affinity,
    FrameMarks,
    Hypothesis,
    Scatter,
    frame_consistency,
    frame_p_value,
)
from measure.fiducials.options import SCATTER_DEGREES
from measure.flags import FALSE_DOUBT

_UNKNOWN_MM = 1.0  # standard deviation of a pattern without prior knowledge
_LEAST_MM = 1e-6  # smallest standard deviation of a site
_FEWEST_ALIKE = 3  # frames of one scan orientation: of two, either may be the outlier
_ROUNDS = 3  # alternations of pattern and film scatter
_AS_ODD = 0.5  # fraction of the log of the smallest p-value: frames below it are explained in the same round
_CLIPPED_AT = 0.25  # upper-tail probability at whose quantile chi-squares are clipped
_CLIPPED_EFFICIENCY = 0.6  # of a variance from clipped chi-squares, relative to one from the mean of squares


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

    @classmethod
    def from_marks(cls, marks: FrameMarks, sites: NDArray[np.intp], pose: str, weak: Mask) -> "FrameMisfit":
        """Start with no explanation."""
        return cls(marks, sites, pose, weak, np.zeros(len(sites)), np.zeros(len(sites)))

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
class Pattern:
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
            covariance = self._beyond_affine @ covariance @ self._beyond_affine
        return frame.enlarged_marks.expecting((covariance @ right)[frame.places].reshape(-1, 2), covariance[own])

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
    def _beyond_affine(self) -> Array:
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
class Explanation:
    """Explanation of all frames of a camera, with their common pattern. film_is_more: whether the film scatters
    significantly more than its prior."""

    pattern: Pattern
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
    def is_quiet(self) -> bool:
        """Whether there is no outlier."""
        return not (self.film_is_more or any(each.film_mm or each.off_mm.any() for each in self.frames.values()))

    @property
    def log_evidence(self) -> float:
        """Log evidence of the explanation. Each outlying frame or mark has the prior probability `FALSE_DOUBT`."""
        odd = sum((each.film_mm is not None) + np.count_nonzero(each.off_mm) for each in self.frames.values())
        alone = sum(each.enlarged_marks.log_density(each.film_mm or self.film.sigma) for each in self.frames.values())
        return float(alone + self.pattern.log_density + odd * np.log(FALSE_DOUBT))


def explain_by_pattern(frames: Frames, sites: Pattern, believed_mm: float) -> Explanation:
    """Explain the frames with a pattern larger than the standard deviations of its sites.

    Its prior standard deviation is set to its estimated size, since a wider prior lowers the evidence of the
    hypothesis.
    """
    wide = explain(frames, replace(sites, free_mm=_UNKNOWN_MM), believed_mm)
    size_mm = float(np.sqrt(np.mean(wide.pattern.mm**2)))
    return explain(frames, replace(sites, free_mm=max(size_mm, believed_mm)), believed_mm)


def explain(frames: Frames, sites: Pattern, believed_mm: float) -> Explanation:
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
            film, is_more = _film([expected[place] for place in ordinary], believed_mm)
            films_mm = films_mm | {place: _own_film_mm(expected[place], film) for place in ordinary}
        affinities = _affinities({place: (expected[place], frames[place].pose) for place in ordinary}, film.sigma)
        tests = {}
        for place in ordinary:
            variance = _weak_mm2(frames[place], expected[place], film.sigma, affinities[place])
            # Weak marks are no evidence on the frame.
            widened = expected[place].widen(np.where(frames[place].weak, variance, 0.0))
            tests[place] = widened, film, affinities[place]
        p_values = {place: frame_p_value(*test) for place, test in tests.items()}
        least = min(p_values.values(), default=1.0)
        if least * len(frames) >= FALSE_DOUBT:
            films_mm = {place: each.film_mm or film.sigma for place, each in frames.items()}
            for place, each in frames.items():
                variance = _weak_mm2(each, expected[place], films_mm[place], affinities.get(place, LONE_AFFINITY))
                frames[place] = replace(each, weak_mm2=variance)
            return Explanation(replace(sites, frames=frames, films_mm=films_mm), film, is_more)
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


def _film(frames: Sequence[FrameMarks], believed_mm: float) -> tuple[Scatter, bool]:
    """Film scatter from ordinary frames, combined with its prior; and whether it is significantly larger than that."""
    frames = [each for each in frames if each.redundancy]
    if len(frames) < 2:
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
