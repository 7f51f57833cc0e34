"""How a camera's marks lie in its frames beside their given places, and how likely that is.

A frame's marks are compared with the given places under an affine transformation, whichever: what it cannot take is the
misfit (n - 3 numbers along each axis). It is normal, with variances of what may have moved the marks: their own, those
of film, and a pattern that frames share (`Pattern`), in the camera's axes or in those of the scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.special import logsumexp

from measure.checks.doubts import observed
from measure.film import MOST_BENT_MM
from measure.marks.poses import up_from_camera
from measure.marks.shapes import FiducialLayout
from measure.results import FrameMeasurement

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

LEAST_MM, _FREE_MM = 1e-6, 10.0  # the least standard deviation, and that of a mark that is left out
_WIDTHS = 24  # of a scatter that nobody knows: standard deviations from what is believed of film to the most it is bent
_SAME_SITE = 1 / 3  # of how near marks are to one another: marks of two frames lie at one place of the scan


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
        mm = float(1 / np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
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
