"""Consistency of a frame's marks with their given coordinates, by the linear model of their misfit (`FrameMarks`).

The chi-square of the residuals tests the frame, a mean shift of mark k tests the mark (data snooping: Baarda 1968), a
shift that all marks beyond a column or row of the scan share tests for a jump of the scanner or a seam.
Hypotheses are compared by their evidence (marginal likelihood): the film is ordinary, bent, stretched by a wrong pitch,
or photographed obliquely; under each of these nothing else is wrong, or one mark has a gross error, or the scan a jump.

The model (`FrameMarks`) is linear, with the film as a random effect:

    o - g = F x + H a + K c + film + noise                     (mark by mark, mm, in the camera's axes)

F x: shifts, a rotation and the additional terms of the project's film model, all free. H a: size, stretch and shear of
the film, normally distributed around those of the camera's other frames, or with `AFFINITY_SIGMA` in a single frame.
K c: a perspective, 0 unless the film was photographed obliquely. The film scatters each mark independently; measured
and given places have their own covariances.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import bsr_array, csr_array
from scipy.spatial.distance import pdist
from scipy.special import chdtrc, chdtri, fdtrc, logsumexp

from measure.array_types import Array, Mask
from measure.fiducials.interior_orientation import AFFINITY_SIGMA, film_terms, interleaved
from measure.fiducials.options import MOST_BENT_MM, SCATTER_DEGREES, SCATTER_MM
from measure.flags import FALSE_DOUBT

NAMED = float(np.log(100.0))  # log-odds above which one cause is accepted against all others
_SUSPECT = -float(np.log(10.0))  # log-odds above which a mark may have the gross error
_MOST_OFF_MM = 0.5  # largest standard deviation of a gross error: marks are not searched farther off than some 1 mm
_FEWEST = 3  # marks needed for a frame
_AT_ONCE = 20  # one in so many marks may be removed at once: each hardly shifts the others then
_LEAST_GATE = 0.1  # fraction of the gate: film may displace a mark by this much, however well most of them agree
_TURNED = 0.2  # shear per stretch that a wrong pitch causes in a frame rotated by up to 6 degrees
MOST_STRETCHED = 0.05  # largest stretch by a wrong pitch
_MOST_PERSPECTIVE = 2e-4  # per mm: film photographed from 0.6 m, tilted by 7 degrees
_PRIOR = np.log(FALSE_DOUBT)  # log prior probability of each deviation from an ordinary frame
_AVERAGED = 300  # equally probable variances of film over which a p-value is averaged: it is decided at one in 200
_WIDTHS = 10  # standard deviations, in equal logarithmic steps, of an effect of which only the range is known
_TESTS = 2  # independent tests of a frame: misfit beyond an affine transformation (global or one mark), and affinity
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

    def shift_derivatives(self, reduced: "Reduced") -> tuple[Any, Any]:
        """(n + j, m) derivatives of the misfit by a shift along x and y of each mark, and of those beyond each column
        or row of the scan at which a jump may lie."""
        least_mm, beyond = _APART * float(pdist(self.scan_mm).min()), list[Mask]()
        for place in self.scan_mm.T:
            steps = np.sort(place)
            beyond += [place > steps[k] for k in np.flatnonzero(np.diff(steps) > least_mm)]
        jumps = [each for each in beyond if _FEWEST_BEYOND <= each.sum() <= len(each) - _FEWEST_BEYOND]
        groups: Any = np.vstack([np.eye(len(self.given_mm)), *jumps])
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


class Hypothesis(IntEnum):
    """State of a frame's film, in addition to a possible gross error in one mark."""

    SOUND = 0
    BENT = 1
    PITCH = 2
    PERSPECTIVE = 3


@dataclass(frozen=True, eq=False)
class FrameConsistency:
    """Result of the consistency test of a frame.

    Attributes
    ----------
    log_evidence : (4, 1 + n + j) log evidence of the hypotheses with nothing else wrong (first column), with a gross
        error in each mark, and with each jump, given that something is wrong.
    off_mm : (n + j, 2) estimated gross error of each mark, and size of each jump, if it is the only one.
    marks : n marks.
    """

    log_evidence: Array
    off_mm: Array
    marks: int

    @cached_property
    def _whole(self) -> Array:
        """(1 + n + j,) log evidence over all hypotheses on the film."""
        return np.asarray(logsumexp(self.log_evidence, axis=0))

    @property
    def log_odds(self) -> Array:
        """(n + 1,) log-odds of a gross error in each mark, and of any jump, against all other explanations."""
        causes = np.append(self._whole[: self.marks + 1], logsumexp(np.append(self._whole[self.marks + 1 :], -np.inf)))
        others = np.where(np.eye(self.marks + 2)[1:], -np.inf, causes)
        return np.asarray(causes[1:] - logsumexp(others, axis=1))

    @property
    def log_gain(self) -> Array:
        """(n,) log-odds of a gross error in each mark against none, with or without a jump."""
        whole, n = self._whole, self.marks
        return np.asarray(whole[1 : n + 1] - logsumexp([whole[0], *whole[n + 1 :]]))

    @property
    def wrong_mark(self) -> int | None:
        """Mark whose gross error is accepted; None if there is none."""
        odds, best = self.log_odds, int(self.log_odds.argmax())
        return best if odds[best] > NAMED and best < self.marks else None

    @property
    def jump_mm(self) -> float | None:
        """Size of the likeliest jump, if there is one; None otherwise. Its place may be ambiguous."""
        if self.log_odds[-1] <= NAMED:
            return None
        return float(np.hypot(*self.off_mm[self.marks + int(self._whole[self.marks + 1 :].argmax())]))

    @property
    def suspects(self) -> Mask:
        """(n,) mask of the marks that may have a gross error."""
        return self.log_odds[:-1] > _SUSPECT

    @property
    def best_hypothesis(self) -> Hypothesis:
        """Hypothesis without a gross error that is accepted against all others; bent film if none is."""
        own = self.log_evidence[:, 0]
        best = Hypothesis(int(own.argmax()))
        rest = np.delete(self.log_evidence, best, axis=0)
        return best if own[best] - logsumexp(rest) > NAMED else Hypothesis.BENT


def frame_p_value(marks: FrameMarks, film: Scatter = LONE_FILM, affinity: Affinity = LONE_AFFINITY) -> float:
    """p-value of a frame, with film and affinity as they are known.

    The smallest p-value, corrected for the number of tests, of: the misfit beyond an affine transformation; the
    affinity; and the largest misfit of a single mark, or of the marks beyond a jump.
    """
    degrees, reduced, p_values = marks.redundancy, marks.beyond_affine, [1.0]
    if degrees:
        p_values.append(float(chdtrc(degrees, reduced.chi_squares(film.variances(_AVERAGED))).mean()))
    if marks.beyond_congruent.redundancy == degrees + len(affinity.mean):  # size, stretch and shear are not free
        fitted, covariance = marks.affinity(film.sigma)
        apart, spread = fitted - affinity.mean, covariance + affinity.scatter.sigma**2 * np.eye(3)
        first = int(affinity.size_is_free)
        apart, spread, tested = apart[first:], spread[first:, first:], len(apart) - first
        p_values.append(float(fdtrc(tested, affinity.scatter.degrees, apart @ np.linalg.solve(spread, apart) / tested)))
    if degrees > 2:
        weight = reduced.weigh(np.array([film.sigma**2]))
        (pulls,), (blocks,) = weight.shifts(reduced.residuals, *marks.shift_derivatives(reduced))
        known = np.linalg.eigvalsh(blocks)[:, 0] > RANK * np.trace(blocks, axis1=1, axis2=2).max()
        solved = np.linalg.solve(blocks[known], pulls[known][..., None])[..., 0]
        share = float((pulls[known] * solved).sum(axis=1).max(initial=0.0))
        # Only the film's part of a residual's variance is estimated: degrees of freedom by Welch and Satterthwaite.
        total_mm2 = degrees / float(np.trace(blocks[: len(marks.given_mm)], axis1=1, axis2=2).sum())
        scatter_degrees = film.degrees * (total_mm2 / film.sigma**2) ** 2
        others = scatter_degrees + degrees - 2
        ratio = share / 2 * others / (scatter_degrees + max(marks.chi_square(film.sigma) - share, 0.0))
        p_values.append(len(blocks) * float(fdtrc(2, others, ratio)))
    return min(1.0, _TESTS * min(p_values))


def frame_consistency(
    marks: FrameMarks, film: Scatter = LONE_FILM, affinity: Affinity = LONE_AFFINITY
) -> FrameConsistency:
    """Compare the hypotheses on what is wrong with a frame.

    Parameters
    ----------
    marks : the frame's marks.
    film : scatter of marks along an axis, mm.
    affinity : affinity of frames with the same scan orientation.

    Returns
    -------
    FrameConsistency
        Evidence of each hypothesis, gross error of each mark, and size of each jump.

    Notes
    -----
    All distributions are normal. Unknown standard deviations are averaged over equal logarithmic steps, so that an
    effect which needs a large one is the less likely, the smaller that part of the range is. The p-value alone decides
    whether something is wrong; the evidence compares only the alternatives. Random effects of low rank are added by the
    matrix determinant lemma (Harville 1997, 18.1).
    """
    hypotheses, films_mm2, effects_mm2, log_prior = _states(marks, film, affinity)
    reduced = marks.beyond_congruent
    residuals = reduced.principal(marks.off_mm.ravel() - marks.affine @ affinity.mean)
    # A perspective, per mm of displacement of the outermost mark.
    perspective = film_terms("projective", marks.given_mm, marks.given_mm + marks.off_mm) / marks.radius_mm**2
    weight = reduced.weigh(films_mm2, np.column_stack([marks.affine, perspective]), np.sqrt(effects_mm2))
    chi_square = weight.products(residuals[:, None])[:, 0, 0]
    known = log_prior - 0.5 * (weight.log_determinant + chi_square)
    pulls, blocks = weight.shifts(residuals, *marks.shift_derivatives(reduced))
    # An error of variance s in mark k, or in all marks beyond jump k, changes the evidence by |I + s B| and p' d, where
    # d = (I / s + B)^-1 p is the estimated error. B: weight matrix of the mark; p: weighted misfit. All are written out
    # for 2 x 2 matrices.
    (xx, xy), (_, yy) = np.moveaxis(blocks, (2, 3), (0, 1))
    x, y = np.moveaxis(pulls, 2, 0)
    off_mm2 = _widths(_MOST_OFF_MM)[:, None, None] ** 2
    wider = (1 + off_mm2 * xx) * (1 + off_mm2 * yy) - (off_mm2 * xy) ** 2
    off_x = off_mm2 * (x + off_mm2 * (yy * x - xy * y)) / wider
    off_y = off_mm2 * (y + off_mm2 * (xx * y - xy * x)) / wider
    gain = 0.5 * (off_x * x + off_y * y - np.log(wider))
    with_mark = logsumexp(gain, axis=0) - np.log(_WIDTHS) + _PRIOR
    every = known[:, None] + np.column_stack([np.zeros(len(known)), with_mark])
    evidence = np.array([logsumexp(every[hypotheses == each], axis=0) for each in Hypothesis])
    evidence[Hypothesis.SOUND, 0] = -np.inf
    weights = np.exp(every - logsumexp(every, axis=0))
    off_mm = np.stack([(weights[:, 1:] * off[-1]).sum(axis=0) for off in (off_x, off_y)], axis=1)
    return FrameConsistency(evidence, off_mm, len(marks.given_mm))


def gross_errors(marks: FrameMarks, film: Scatter, gate_mm: float) -> NDArray[np.bool_]:
    """Find the marks of a single frame that are excluded from its interior orientation.

    Marks are removed one by one, of many marks some at a time, the most likely gross errors first, until the others
    agree. Of these, the set with the highest evidence is taken, if it explains the frame significantly better than no
    gross error. Each of its marks is then tested with the agreeing marks: it is excluded if its gross error is
    accepted, or exceeds the gate.

    Returns
    -------
    (n,) mask of the excluded marks.
    """
    order, odds, kept = list[int](), [0.0], np.arange(len(marks.given_mm))
    while len(kept) > _FEWEST and frame_p_value(own := marks.select(kept), film) < FALSE_DOUBT:
        gained = frame_consistency(own, film).log_gain
        worst = np.argsort(-gained, kind="stable")[: max(len(kept) // _AT_ONCE, 1)]
        worst = worst[gained[worst] >= min(NAMED, gained.max())]
        order += kept[worst].tolist()
        odds += (odds[-1] + np.cumsum(gained[worst])).tolist()
        kept = np.delete(kept, worst)
    out = np.zeros(len(marks.given_mm), dtype=bool)
    if max(odds) <= NAMED:
        return out
    wrong = order[: int(np.argmax(odds))]
    agreeing = np.setdiff1d(np.arange(len(out)), wrong)
    for mark in wrong:
        own = marks.select(np.append(agreeing, mark))
        out[mark] = own.distances_mm().max() > gate_mm
        if not out[mark]:
            found = frame_consistency(own, film)
            is_far = float(np.hypot(*found.off_mm[len(agreeing)])) > _LEAST_GATE * gate_mm
            out[mark] = is_far and found.wrong_mark == len(agreeing)
    return out


def _states(marks: FrameMarks, film: Scatter, affinity: Affinity) -> tuple[NDArray[np.intp], Array, Array, Array]:
    """Grid of s states of film and scan, over which the evidence is summed.

    Returns
    -------
    (s,) `Hypothesis`; (s,) variance of the film's scatter, mm2; (s, 5) variances of affinity (3) and perspective (2);
    (s,) log prior probability.
    """
    films, stretches, bends = film.variances(), affinity.scatter.variances(), _widths(MOST_BENT_MM)
    bent = (films.mean() + bends**2, stretches, np.zeros(1))
    pitch = (films, np.geomspace(AFFINITY_SIGMA / 10, MOST_STRETCHED, _WIDTHS) ** 2, np.zeros(1))
    most_mm = max(_MOST_PERSPECTIVE * marks.radius_mm**2, 2 * SCATTER_MM)
    oblique = (films.mean(keepdims=True), stretches.mean(keepdims=True), _widths(most_mm) ** 2)
    # Prior of bent film: the density falls with the inverse square of the standard deviation.
    rarity = {Hypothesis.BENT: np.repeat(1 / bends, len(stretches))}
    parts = []
    for hypothesis, each in enumerate(((films, stretches, np.zeros(1)), bent, pitch, oblique)):
        grid = np.stack(np.meshgrid(*each, indexing="ij"), axis=-1).reshape(-1, 3)
        weights = rarity.get(Hypothesis(hypothesis), np.ones(len(grid)))
        prior = np.log(weights / weights.sum()) + (_PRIOR if hypothesis else 0.0)
        parts.append(np.column_stack([np.full(len(grid), hypothesis), grid, prior]))
    hypothesis, film_mm2, stretch, perspective, prior = np.concatenate(parts).T
    effects = np.repeat([stretch, perspective], [3, 2], axis=0).T
    is_pitch = hypothesis == Hypothesis.PITCH
    effects[is_pitch, :3] = stretches.mean() + stretch[is_pitch, None] * (1.0, 1.0, _TURNED**2)
    effects[:, 0] += (MOST_STRETCHED * affinity.size_is_free) ** 2
    return hypothesis.astype(np.intp), film_mm2, effects, prior


def _widths(most_mm: float) -> Array:
    return np.geomspace(SCATTER_MM, most_mm, _WIDTHS)
