"""Linear model of the misfit of a frame's marks with their given coordinates, with the film as a random effect.

    o - g = F x + H a + K c + film + noise                     (mark by mark, mm, in the camera's axes)

F x: shifts, a rotation and the additional terms of the project's film model, all free. H a: size, stretch and shear of
the film, normally distributed around those of the camera's other frames, or with `AFFINITY_SIGMA` in a single frame.
K c: a perspective, 0 unless the film was photographed obliquely. The film scatters each mark independently; measured
and given places have their own covariances.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.distance import pdist
from scipy.special import chdtri

from measure.array_types import Array, Mask
from measure.fiducials.options import AFFINITY_SIGMA, SCATTER_DEGREES, SCATTER_MM, film_terms, interleaved

RANK = 1e-9  # fraction of the largest singular value, below which a direction is a null direction
_LEAST_MM = 1e-6  # smallest standard deviation of a mark
_KNOWN = 1e6  # degrees of freedom of a known variance
_DENSE = 100  # marks up to which free parameters are eliminated once, by eigenvectors of the covariance of all marks
_APART = 1 / 3  # fraction of the least distance of two marks: a jump is sought between columns of marks at least so far
_FEWEST_BEYOND = 2  # marks on either side of a jump: of one mark alone it is a gross error


@dataclass(frozen=True)
class Scatter:
    """Standard deviation sigma, estimated with the given degrees of freedom."""

    sigma: float
    degrees: float = _KNOWN

    def variances(self, count: int = 3) -> Array:
        """(count,) equally probable variances: quantiles of the scaled inverse chi-square distribution."""
        quantiles = (np.arange(count) + 0.5) / count
        return np.asarray(self.sigma**2 * self.degrees / chdtri(self.degrees, 1 - quantiles))


@dataclass(frozen=True, eq=False)
class Affinity:
    """Size, stretch and shear of the frames with one scan orientation: mean (3,) and scatter of each. size_is_free: the
    size is not tested; so in a single frame, where it depends on the pitch."""

    mean: Array = field(default_factory=lambda: np.zeros(3))
    scatter: Scatter = field(default_factory=lambda: Scatter(AFFINITY_SIGMA))
    size_is_free: bool = False


LONE_FILM, LONE_AFFINITY = Scatter(SCATTER_MM, SCATTER_DEGREES), Affinity(size_is_free=True)


@dataclass(frozen=True, eq=False)
class FrameMarks:
    """Marks of a frame, n >= 3.

    Attributes
    ----------
    given_mm : (n, 2) given places, relative to their centroid.
    off_mm : (n, 2) measured less given places, in the camera's axes, after a rotation and shift onto the given ones.
    covariances_mm2 : (n, 2, 2) covariance of each mark without the scatter of the film.
    scan_mm : (n, 2) measured places in the scan's axes.
    model : film deformation model of the project.
    shared_mm2 : (2n, 2n) covariance of what is subtracted from all marks in common; None without it.
    """

    given_mm: Array
    off_mm: Array
    covariances_mm2: Array
    scan_mm: Array
    model: str = "affine"
    shared_mm2: Array | None = None

    @classmethod
    def from_places(
        cls, given_mm: Array, measured_mm: Array, covariances_mm2: Array, model: str = "affine"
    ) -> "FrameMarks":
        """Rotate and shift measured places (n, 2) onto given ones (n, 2), with a mirror if needed. The measured places
        and their covariances (n, 2, 2) are in the scan's axes."""
        centers = given_mm.mean(axis=0), measured_mm.mean(axis=0)
        left, _, right = np.linalg.svd((given_mm - centers[0]).T @ (measured_mm - centers[1]))
        turn = left @ right
        off = (measured_mm - centers[1]) @ turn.T - (given_mm - centers[0])
        covariances = turn @ covariances_mm2 @ turn.T + _LEAST_MM**2 * np.eye(2)
        return cls(given_mm - centers[0], off, covariances, measured_mm, model)

    @property
    def radius_mm(self) -> float:
        return float(np.hypot(*self.given_mm.T).max())

    @cached_property
    def affine(self) -> Array:
        """(2n, 3) derivatives of the places with respect to size, stretch and shear."""
        x, y = self.given_mm.T
        return interleaved((x, y), (x, -y), (y, x))

    @cached_property
    def perspective(self) -> Array:
        """(2n, 2) derivatives with respect to a perspective, per mm of displacement of the outermost mark."""
        return film_terms("projective", self.given_mm, self.given_mm + self.off_mm) / self.radius_mm**2

    @cached_property
    def beyond_jumps(self) -> Mask:
        """(n, j) marks beyond each column or row of the scan at which a jump may lie."""
        least_mm, sides = _APART * float(pdist(self.scan_mm).min()), list[Mask]()
        for place in self.scan_mm.T:
            steps = np.sort(place)
            sides += [place > steps[k] for k in np.flatnonzero(np.diff(steps) > least_mm)]
        kept = [each for each in sides if _FEWEST_BEYOND <= each.sum() <= len(each) - _FEWEST_BEYOND]
        return np.array(kept, dtype=bool).reshape(-1, len(self.scan_mm)).T

    def shift_derivatives(self, reduced: "Reduced") -> tuple[Any, Any]:
        """(n + j, m) derivatives of the misfit by a shift along x and y of each mark, and of those beyond each jump."""
        groups: Any = np.vstack([np.eye(len(self.given_mm)), self.beyond_jumps.T])
        groups = groups if isinstance(reduced.axes, np.ndarray) else csr_array(groups)
        return groups @ reduced.axes[::2], groups @ reduced.axes[1::2]

    @cached_property
    def beyond_affine(self) -> "Reduced":
        """Misfit with size, stretch and shear free."""
        return Reduced.from_free(self, self.affine)

    @cached_property
    def beyond_congruent(self) -> "Reduced":
        """Misfit with shift and rotation free."""
        return Reduced.from_free(self, np.zeros((self.off_mm.size, 0)))

    @property
    def redundancy(self) -> int:
        """Redundancy with size, stretch and shear free."""
        return self.beyond_affine.redundancy

    def chi_square(self, film_mm: float) -> float:
        """Chi-square of the misfit with size, stretch and shear free, for a film scatter of film_mm."""
        return float(self.beyond_affine.chi_squares(np.array([film_mm**2]))[0])

    def film_variance_mm2(self) -> float:
        """Variance of the film's scatter with which chi-square equals the redundancy (Paule and Mandel, 1982).

        An imprecise mark does not dilute the misfit of the others. 0 where the marks' covariances explain the misfit.
        """
        if self.redundancy == 0 or self.chi_square(0.0) <= self.redundancy:
            return 0.0
        most = float(np.sqrt((self.beyond_affine.residuals**2).sum()))
        return float(brentq(lambda film_mm: self.chi_square(film_mm) - self.redundancy, 0.0, most)) ** 2

    def added_variance_mm2(self, among: Mask, film_mm: float, affinity: Affinity) -> float:
        """Variance along an axis of some marks, among (n,), in addition to their covariances.

        Estimated like that of the film, from the chi-square of these marks given the others. Stretch and shear, and a
        size that is not free, are random as in the affinity.
        """
        first = int(affinity.size_is_free)
        reduced = Reduced.from_free(self, self.affine[:, :first])
        scatter = np.full((1, 3 - first), affinity.scatter.sigma)
        weight = reduced.weigh(np.array([film_mm**2]), self.affine[:, first:], scatter)
        residuals = reduced.principal(self.off_mm.ravel() - self.affine @ affinity.mean)
        images = np.column_stack([reduced.axes.T @ np.eye(2 * len(among))[:, np.repeat(among, 2)], residuals])
        products = weight.products(images)[0]
        shares, axes = np.linalg.eigh(products[:-1, :-1])  # 0: misfit of the other marks alone
        affected = shares > RANK * shares[-1]
        squares, shares = (products[-1, :-1] @ axes)[affected] ** 2 / shares[affected], shares[affected]
        if squares.sum() <= len(squares):
            return 0.0
        most = float((squares / shares).max())
        return float(brentq(lambda mm2: float(np.sum(squares / (1 + mm2 * shares))) - len(squares), 0.0, most))

    def log_density(self, film_mm: float) -> float:
        """Log density of the misfit up to a constant, size, stretch and shear free."""
        weight = self.beyond_affine.weigh(np.array([film_mm**2]))
        return -0.5 * (float(weight.log_determinant[0]) + self.chi_square(film_mm))

    def precision(self, film_mm: float) -> Array:
        """(2n, 2n) weight matrix of off_mm for a film scatter of film_mm, after elimination of all free parameters,
        size, stretch and shear included."""
        reduced = self.beyond_affine
        return np.asarray(reduced.weigh(np.array([film_mm**2])).products(reduced.axes.T @ np.eye(self.off_mm.size))[0])

    def affinity(self, film_mm: float) -> tuple[Array, Array]:
        """Least-squares estimate (3,) of size, stretch and shear, and its covariance (3, 3)."""
        reduced = self.beyond_congruent
        images = np.column_stack([reduced.axes.T @ self.affine, reduced.residuals])
        products = reduced.weigh(np.array([film_mm**2])).products(images)[0]
        covariance = np.asarray(np.linalg.pinv(products[:3, :3], hermitian=True), dtype=np.float64)
        return covariance @ products[:3, 3], covariance

    def distances_mm(self) -> Array:
        """(n,) residual lengths of an unweighted least-squares fit of all free parameters, size, stretch and shear
        included."""
        reduced = self.beyond_affine
        return np.asarray(np.hypot(*(reduced.axes @ reduced.residuals).reshape(-1, 2).T))

    def expecting(self, off_mm: Array, covariance_mm2: Array) -> "FrameMarks":
        """Subtract an expected misfit off_mm (n, 2) with its covariance (2n, 2n)."""
        return replace(self, off_mm=self.off_mm - off_mm, shared_mm2=covariance_mm2)

    def widen(self, variances_mm2: Array) -> "FrameMarks":
        """Add variances (n,) to both coordinates of each mark."""
        return replace(self, covariances_mm2=self.covariances_mm2 + variances_mm2[:, None, None] * np.eye(2))

    def select(self, index: NDArray[np.intp]) -> "FrameMarks":
        """Keep the marks of the given indices, of a frame without a shared covariance."""
        given, off = self.given_mm[index], self.off_mm[index]
        return FrameMarks(given, off, self.covariances_mm2[index], self.scan_mm[index], self.model)

    def rotate(self, turn: Array) -> "FrameMarks":
        """Transform to axes that are rotated, or mirrored, by turn (2, 2), without a shared covariance."""
        covariances = turn @ self.covariances_mm2 @ turn.T
        return FrameMarks(self.given_mm @ turn.T, self.off_mm @ turn.T, covariances, self.scan_mm, self.model)


@dataclass(frozen=True, eq=False)
class Reduced:
    """Misfit of a frame in principal axes of its covariance, where any scatter of the film adds to the variances alone.

    axes (2n, m): orthonormal; variances (m,), residuals (m,). Of few marks the axes are orthogonal to the free
    parameters. Of many marks, each has its own two, as a sparse matrix, and basis (m, f) spans the free parameters.
    """

    axes: Any
    variances: Array
    residuals: Array
    basis: Array

    @classmethod
    def from_free(cls, marks: FrameMarks, also: Array) -> "Reduced":
        """Eliminate shift, rotation, the terms of the film model, and also: (2n, k) further free parameters."""
        x, y = marks.given_mm.T
        one, none = np.ones_like(x), np.zeros_like(x)
        measured = (marks.given_mm + marks.off_mm) / marks.radius_mm
        more = film_terms(marks.model, marks.given_mm / marks.radius_mm, measured)
        free = np.hstack([interleaved((one, none), (none, one), (-y, x)), also, more])
        free = np.hstack([free, marks.affine]) if more.shape[1] else free
        is_sparse = len(x) > _DENSE and marks.shared_mm2 is None
        left, sizes, _ = np.linalg.svd(free / np.linalg.norm(free, axis=0), full_matrices=not is_sparse)
        rank = int((sizes > RANK * sizes[0]).sum())
        if is_sparse:
            own, vectors = np.linalg.eigh(marks.covariances_mm2)
            axes = csr_array(bsr_array((vectors, np.arange(len(x)), np.arange(len(x) + 1))))
            basis, variances = axes.T @ left[:, :rank], own.ravel()
        else:
            covariance = np.zeros((len(x), 2, len(x), 2))
            covariance[np.arange(len(x)), :, np.arange(len(x))] = marks.covariances_mm2
            whole = covariance.reshape(2 * len(x), -1)
            whole = whole if marks.shared_mm2 is None else whole + marks.shared_mm2
            variances, vectors = np.linalg.eigh(left[:, rank:].T @ whole @ left[:, rank:])
            axes, basis = left[:, rank:] @ vectors, np.zeros((len(variances), 0))
        reduced = cls(axes, np.maximum(variances, _LEAST_MM**2), np.zeros(0), basis)
        return replace(reduced, residuals=reduced.principal(marks.off_mm.ravel()))

    @property
    def redundancy(self) -> int:
        return int(len(self.variances) - self.basis.shape[1])

    def principal(self, off_mm: Array) -> Array:
        """(m,) misfit off_mm (2n,) in the principal axes, less its unweighted fit by the free parameters."""
        off = np.asarray(self.axes.T @ off_mm)
        return np.asarray(off - self.basis @ (self.basis.T @ off))

    def chi_squares(self, films_mm2: Array) -> Array:
        """(s,) chi-squares of the misfit for variances films_mm2 (s,) of the film's scatter."""
        if self.basis.size:
            return np.asarray(self.weigh(films_mm2).products(self.residuals[:, None])[:, 0, 0])
        return np.asarray((self.residuals**2 / (self.variances + films_mm2[:, None])).sum(axis=1))

    def weigh(self, films_mm2: Array, effects: Array | None = None, sigmas: Array | None = None) -> "Weight":
        """Weight matrices for variances films_mm2 (s,) of the film's scatter, and random effects, if any, with the
        derivatives effects (2n, e) and standard deviations sigmas (s, e)."""
        weights, free = 1 / (self.variances + films_mm2[:, None]), self.basis.shape[1]
        columns, scale = self.basis, np.ones((len(weights), free))
        if effects is not None and sigmas is not None:
            columns, scale = np.hstack([columns, self.axes.T @ effects]), np.hstack([scale, sigmas])
        weighted = scale[:, :, None] * columns.T * weights[:, None]
        normal = weighted @ columns * scale[:, None]
        normal += np.diag(np.arange(columns.shape[1]) >= free)
        factor = np.linalg.cholesky(normal)
        determinant = 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1) - np.log(weights).sum(axis=1)
        return Weight(weights, np.linalg.solve(factor, weighted), np.asarray(determinant))


@dataclass(frozen=True, eq=False)
class Weight:
    """Weight matrices of s states in the principal axes: diag(weights) - taken' taken, with weights (s, m), taken
    (s, a, m) by free parameters and random effects; log_determinant: (s,) of the covariance."""

    weights: Array
    taken: Array
    log_determinant: Array

    def products(self, images: Array) -> Array:
        """(s, c, c) products of images (m, c) with the weight matrix between them."""
        taken = self.taken @ images
        return np.asarray((images.T * self.weights[:, None]) @ images - taken.swapaxes(1, 2) @ taken)

    def shifts(self, residuals: Array, columns: Any, rows: Any) -> tuple[Array, Array]:
        """Weighted misfits (s, g, 2) and weight matrices (s, g, 2, 2) of shifts of g groups of marks; columns, rows
        (g, m): their derivatives along x and y."""
        weighted = self.weights * residuals - ((self.taken @ residuals)[:, None] @ self.taken)[:, 0]
        images, count = self.taken.reshape(-1, self.taken.shape[-1]), self.taken.shape[:2]
        taken = [(each @ images.T).reshape(each.shape[0], *count) for each in (columns, rows)]
        pairs = ((0, 0), (0, 1), (1, 1))
        xx, xy, yy = (
            ((columns, rows)[i] * (columns, rows)[j]) @ self.weights.T - (taken[i] * taken[j]).sum(axis=2)
            for i, j in pairs
        )
        pulls = np.stack([each @ weighted.T for each in (columns, rows)], axis=-1)
        blocks = np.stack([xx, xy, xy, yy], axis=-1).reshape(*xx.shape, 2, 2)
        return pulls.swapaxes(0, 1), blocks.swapaxes(0, 1)
