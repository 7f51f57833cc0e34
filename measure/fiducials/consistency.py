"""Consistency of a camera's frames: the misfits of their marks to the given coordinates, and what explains them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.special import chdtrc, chdtri, fdtrc, logsumexp

from measure.fiducials.doubts import TOLD, observed
from measure.fiducials.options import MOST_BENT_MM, SCATTER_DEGREES
from measure.flags import FALSE_DOUBT
from measure.geometry import linear_scale, up_from_camera
from measure.marks.shapes import FiducialLayout
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.results import FrameMeasurement

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

LEAST_MM, _FREE_MM = 1e-6, 10.0  # the least standard deviation, and that of a mark that is left out
_WIDTHS = 24  # of a scatter that nobody knows: standard deviations from what is believed of film to the most it is bent
_SAME_SITE = 1 / 3  # of how near marks are to one another: marks of two frames lie at one place of the scan
_AS_ODD = 0.5  # of the logarithm of the least probability: frames that stand out as well are looked at together
_LEAST_CHANCE = 1e-300
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Misfit:
    """The n marks of a frame that are observations: index (n,) in the layout; site (n,) of the pattern they share;
    given_mm (n, 2); off_mm (n, 2) from the given places, in the pattern's axes, but for an affine transformation;
    variance_mm2 (n,) of a coordinate, film included; mm: of a pixel."""

    index: Ints
    site: Ints
    given_mm: Array
    off_mm: Array
    variance_mm2: Array
    mm: float

    @classmethod
    def of(cls, frame: FrameMeasurement, layout: FiducialLayout) -> "Misfit | None":
        """With the marks' own variances, in the camera's axes; None of a frame that is not checked by its marks."""
        number = {mark.id: place for place, mark in enumerate(layout.marks)}
        marks = [mark for mark in observed(frame) if mark.point in number]
        matrix = frame.pixel_from_camera
        if matrix is None or len(marks) < 4:
            return None
        index = np.array([number[mark.point] for mark in marks], dtype=np.intp)
        given = np.array([layout.marks[place].xy_mm for place in index])
        if np.linalg.matrix_rank(_affine(given)) < 3:
            return None
        mm = float(1 / linear_scale(matrix))
        centers = np.array([mark.center_px for mark in marks])
        camera = (centers - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
        variances = [np.trace(mark.covariance_px2) / 2 for mark in marks if mark.covariance_px2 is not None]
        return cls(index, index, given, camera - given, np.maximum(mm * np.sqrt(variances), LEAST_MM) ** 2, mm)

    @property
    def degrees(self) -> int:
        return 2 * (len(self.index) - 3)

    @cached_property
    def beyond_affine(self) -> Array:
        """(n, n - 3) an orthonormal basis of what no affine transformation makes."""
        return np.linalg.qr(_affine(self.given_mm), mode="complete")[0][:, 3:]

    @cached_property
    def z(self) -> Array:
        """(n - 3, 2)."""
        return np.asarray(self.beyond_affine.T @ self.off_mm)

    @cached_property
    def weight(self) -> Array:
        """(n, n) of off_mm, any affine transformation being free."""
        n = self.beyond_affine
        return np.asarray(n @ np.linalg.solve(n.T @ (self.variance_mm2[:, None] * n), n.T))

    def widened(self, more_mm2: Array | float) -> "Misfit":
        return replace(self, variance_mm2=self.variance_mm2 + more_mm2)

    def free(self, mark: int) -> "Misfit":
        """With one mark left out, as good as."""
        return self.widened(np.where(np.arange(len(self.index)) == mark, _FREE_MM**2, 0.0))

    def in_scan_axes(self, pose: str, sites: Array) -> "Misfit":
        """The same with the scan's axes, right and up, and with the sites (m, 2) of the scan that the marks lie at."""
        turn = up_from_camera(pose)
        places = self.given_mm @ turn.T
        site = np.hypot(*np.moveaxis(places[:, None] - sites[None], -1, 0)).argmin(axis=1)
        return replace(self, site=site, off_mm=self.off_mm @ turn.T)

    def log_density(self, expected: Array, covariance: Array, more_mm2: Array | float = 0.0) -> float:
        """Of the misfit where a pattern is expected (n, 2) with a covariance (n, n), and the marks vary by more."""
        n = self.beyond_affine
        spread = n.T @ (np.diag(self.variance_mm2 + more_mm2) + covariance) @ n
        left = self.z - n.T @ expected
        return -float(np.linalg.slogdet(spread)[1] + (left * np.linalg.solve(spread, left)).sum() / 2)

    def chi_square(self, expected: Array, covariance: Array) -> float:
        """Of the misfit, likewise."""
        n = self.beyond_affine
        left = self.z - n.T @ expected
        return float((left * np.linalg.solve(n.T @ (np.diag(self.variance_mm2) + covariance) @ n, left)).sum())

    def distances_mm(self, expected: Array) -> Array:
        """(n,) of each mark from where the given places and the pattern have it, under the best affine one."""
        off = self.off_mm - expected
        design, weights = _affine(self.given_mm), 1 / np.sqrt(self.variance_mm2)[:, None]
        return np.asarray(np.hypot(*(off - design @ np.linalg.lstsq(design * weights, off * weights, rcond=None)[0]).T))


def _affine(places: Array) -> Array:
    return np.column_stack([places, np.ones(len(places))])


def scan_sites(misfits: Sequence[Misfit], poses: Sequence[str]) -> Array:
    """(m, 2) places in the scan's axes at which marks lie in frames of those poses."""
    places = [each.given_mm @ up_from_camera(pose).T for each, pose in zip(misfits, poses, strict=True)]
    near = _SAME_SITE * min(float(pdist(own).min()) for own in places)
    sites = list[Array]()
    for place in np.unique(np.round(np.concatenate(places), 6), axis=0):
        if not any(np.hypot(*(place - site)) < near for site in sites):
            sites.append(place)
    return np.array(sites)


def log_densities_wider(misfit: Misfit, expected: Array, covariance: Array, film_mm: float) -> Array:
    """(1 + n,) of a misfit whose marks all vary more than film does, and of one of which a single mark does; by how
    much more nobody knows."""
    widths = np.geomspace(film_mm, MOST_BENT_MM, _WIDTHS) ** 2
    shares = np.concatenate([np.ones((1, len(misfit.index))), np.eye(len(misfit.index))])
    found = [[misfit.log_density(expected, covariance, width * share) for width in widths] for share in shares]
    return np.asarray(logsumexp(found, axis=1) - np.log(_WIDTHS))


@dataclass(frozen=True, eq=False)
class Pattern:
    """How far off the given places marks lie in all frames alike, at m sites: information (m, m) and right-hand side
    (m, 2) of what the frames say of it; sigma_mm (m,): of each site, and free_mm, by how much more it may be."""

    sigma_mm: Array
    free_mm: float
    information: Array
    right: Array

    @classmethod
    def of(cls, frames: Sequence[Misfit], sigma_mm: Array, free_mm: float) -> "Pattern":
        information, right = np.zeros((len(sigma_mm),) * 2), np.zeros((len(sigma_mm), 2))
        for frame in frames:
            information[np.ix_(frame.site, frame.site)] += frame.weight
            right[frame.site] += frame.weight @ frame.off_mm
        return cls(sigma_mm, free_mm, information, right)

    def without(self, frame: Misfit) -> tuple[Array, Array]:
        """The pattern (n, 2) expected at a frame's marks by all others, and its covariance (n, n)."""
        information, right = self._posterior.copy(), self.right.copy()
        information[np.ix_(frame.site, frame.site)] -= frame.weight
        right[frame.site] -= frame.weight @ frame.off_mm
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        return (covariance @ right)[frame.site], covariance[np.ix_(frame.site, frame.site)]

    @cached_property
    def mm(self) -> Array:
        """(m, 2) its estimate."""
        return np.asarray(np.linalg.solve(self._posterior, self.right))

    @property
    def degrees(self) -> int:
        return 2 * int(np.linalg.matrix_rank(self.information, hermitian=True))

    def chi_square(self) -> float:
        """Of the pattern against nothing but its sites' standard deviations."""
        spread = self.information + self.information @ np.diag(self.sigma_mm**2) @ self.information
        return float((self.right * (np.linalg.pinv(spread, hermitian=True) @ self.right)).sum())

    def log_density(self, frames: Sequence[Misfit]) -> float:
        """Of the misfits of the frames that it was made of, all together."""
        nothing = [(np.zeros_like(frame.off_mm), np.zeros((len(frame.site),) * 2)) for frame in frames]
        alone = sum(frame.log_density(*none) for frame, none in zip(frames, nothing, strict=True))
        shared = np.log(self._prior_information).sum() - np.linalg.slogdet(self._posterior)[1]
        return float(alone + shared + (self.right * self.mm).sum() / 2)

    @cached_property
    def _prior_information(self) -> Array:
        return np.asarray(1 / (self.sigma_mm**2 + self.free_mm**2 + LEAST_MM**2))

    @cached_property
    def _posterior(self) -> Array:
        return self.information + np.diag(self._prior_information)


@dataclass(frozen=True)
class Film:
    """How marks scatter by film and scanner beside what all frames share: sigma_mm along an axis, known with so many
    degrees of freedom. is_more: whether that is more than was believed beforehand, beyond chance."""

    sigma_mm: float
    degrees: float
    is_more: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame's misfit, with its marks' own variances, and what explains it. chance: the probability that ordinary
    film makes as much; film_mm: of film that stands out, None of ordinary film; off_mm: by how much marks are off, by
    their number in the misfit, and variances_mm2 (n,), what that adds to theirs."""

    misfit: Misfit
    variances_mm2: Array
    chance: float = 1.0
    film_mm: float | None = None
    off_mm: Mapping[int, float] = field(default_factory=dict)

    def under(self, film: Film) -> Misfit:
        """The misfit with all variances."""
        return self.misfit.widened(self.variances_mm2 + (film.sigma_mm if self.film_mm is None else self.film_mm) ** 2)


@dataclass(frozen=True, eq=False)
class Explanation:
    """Of all frames of a camera, by their places, with the pattern that they share."""

    frames: Mapping[int, Frame]
    pattern: Pattern
    film: Film

    def expected_mm(self, place: int) -> tuple[Array, Array]:
        """The pattern at a frame's marks, by all others, and its covariance."""
        return self.pattern.without(self.frames[place].under(self.film))

    @property
    def log_evidence(self) -> float:
        """What is strange costs as much as it is rare."""
        strange = sum((each.film_mm is not None) + len(each.off_mm) for each in self.frames.values())
        misfits = [each.under(self.film) for each in self.frames.values()]
        return self.pattern.log_density(misfits) + strange * float(np.log(FALSE_DOUBT))

    @property
    def chance_of_pattern(self) -> float:
        """That what the frames share is no more than its sites' standard deviations say."""
        statistic = self.pattern.chi_square() / max(self.pattern.degrees, 1)
        return float(fdtrc(max(self.pattern.degrees, 1), self.film.degrees, statistic))


def explained(misfits: Mapping[int, Misfit], sigma_mm: Array, free_mm: float, believed_mm: float) -> Explanation:
    """The frames beside what the others have: those that stand out beyond chance, the worst first, are explained by one
    of their marks, where that alone does it far better than all else, or by their film.

    sigma_mm: of the pattern's sites; free_mm: by how much it may differ from that beforehand; believed_mm: of film.
    """
    frames = {place: Frame(each, np.zeros(len(each.index))) for place, each in misfits.items()}
    film = Film(believed_mm, SCATTER_DEGREES)
    while True:
        for _ in range(_ROUNDS):  # film tells the weights of the pattern, and the pattern what is left for film
            own = {place: each.under(film) for place, each in frames.items()}
            pattern = Pattern.of(list(own.values()), sigma_mm, free_mm)
            ordinary = [own[place] for place, each in frames.items() if each.film_mm is None]
            film = _film(ordinary, pattern, film, believed_mm)
        pattern = Pattern.of([each.under(film) for each in frames.values()], sigma_mm, free_mm)
        result = Explanation(frames, pattern, film)
        open_ = [place for place, each in frames.items() if each.film_mm is None]
        chances = {place: _chance(frames[place], pattern, film, believed_mm) for place in open_}
        least = min(chances.values(), default=1.0)
        if least * len(frames) >= FALSE_DOUBT:
            return result
        odd = [p for p in open_ if chances[p] * len(frames) < FALSE_DOUBT and _log(chances[p]) < _AS_ODD * _log(least)]
        frames = {
            place: _explained(replace(each, chance=chances[place]), result, place) if place in odd else each
            for place, each in frames.items()
        }


def _log(chance: float) -> float:
    return float(np.log(max(chance, _LEAST_CHANCE)))


def _chance(frame: Frame, pattern: Pattern, film: Film, believed_mm: float) -> float:
    """That film as it is believed, or as the other frames show it, makes as large a misfit, or one mark lie so far from
    where the others have it."""
    expected, covariance = pattern.without(frame.under(film))
    chances = [1.0]
    for sigma_mm, known in ((film.sigma_mm, film.degrees), (believed_mm, SCATTER_DEGREES)):
        own = frame.under(Film(sigma_mm, known))
        whole, degrees = own.chi_square(expected, covariance), own.degrees
        chances.append(float(fdtrc(degrees, known, whole / degrees)))
        if degrees > 2:
            rest = np.array([own.free(mark).chi_square(expected, covariance) for mark in range(len(own.index))])
            known += degrees - 2
            ratios = (whole - rest) / 2 / ((known - degrees + 2 + rest) / known)
            chances.append(len(rest) * float(fdtrc(2, known, ratios.max())))
    return min(chances)


def _explained(frame: Frame, result: Explanation, place: int) -> Frame:
    """A frame that stands out."""
    expected, covariance = result.expected_mm(place)
    own, film = frame.under(result.film), result.film
    densities = log_densities_wider(own, expected, covariance, film.sigma_mm)
    mark = int(densities[1:].argmax())
    if densities[mark + 1] - np.delete(densities, mark + 1).max() > TOLD:
        off_mm = float(own.free(mark).distances_mm(expected)[mark])
        variances = frame.variances_mm2 + np.where(np.arange(len(own.index)) == mark, off_mm**2, 0.0)
        return replace(frame, variances_mm2=variances, off_mm={**frame.off_mm, mark: off_mm})
    shown = _film_mm2(own.widened(-(film.sigma_mm**2)), expected, covariance)
    known = SCATTER_DEGREES * film.sigma_mm**2 + own.degrees * shown
    return replace(frame, film_mm=float(np.sqrt(known / (SCATTER_DEGREES + own.degrees))))


def _film_mm2(misfit: Misfit, expected: Array, covariance: Array) -> float:
    """What of the misfit's mean square its marks' own variances and the pattern's do not make."""
    n = misfit.beyond_affine
    made = 2 * float(np.trace(n.T @ (np.diag(misfit.variance_mm2) + covariance) @ n))
    return max(float(((misfit.z - n.T @ expected) ** 2).sum()) - made, 0.0) / misfit.degrees


def _film(misfits: list[Misfit], pattern: Pattern, before: Film, believed_mm: float) -> Film:
    """From the lower median of the frames, which those that stand out do not widen, beside what is believed."""
    if len(misfits) < 2:
        return Film(believed_mm, SCATTER_DEGREES)
    shown = sorted(
        _film_mm2(each.widened(-(before.sigma_mm**2)), *pattern.without(each))
        * each.degrees
        / float(chdtri(each.degrees, 0.5))
        for each in misfits
    )[(len(misfits) - 1) // 2]
    degrees = MEDIAN_EFFICIENCY * sum(each.degrees for each in misfits)
    variance = (SCATTER_DEGREES * believed_mm**2 + degrees * shown) / (SCATTER_DEGREES + degrees)
    is_more = bool(chdtrc(degrees, degrees * shown / believed_mm**2) < FALSE_DOUBT)
    return Film(float(np.sqrt(variance)), SCATTER_DEGREES + degrees, is_more)
