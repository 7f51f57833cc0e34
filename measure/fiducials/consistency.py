"""Consistency of a frame's marks with their given coordinates: one linear model with the film as a random effect.

    o - g = F x + H a + K c + film + noise                     (mark by mark, mm, in the camera's axes)

F x: shifts, a rotation and the additional terms of the project's film model, all free. H a: size, stretch and shear of
the film, normally distributed around those of the camera's other frames, or with `AFFINITY_SIGMA` in a single frame.
K c: a perspective, 0 unless the film was photographed obliquely. The film scatters each mark independently; measured
and given places have their own covariances.

The chi-square of the residuals tests the frame, a mean shift of mark k tests the mark (data snooping: Baarda 1968), a
shift that all marks beyond a column or row of the scan share tests for a jump of the scanner or a seam.
Hypotheses are compared by their evidence (marginal likelihood): the film is ordinary, bent, stretched by a wrong pitch,
or photographed obliquely; under each of these nothing else is wrong, or one mark has a gross error, or the scan a jump.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.distance import pdist
from scipy.special import chdtrc, chdtri, fdtrc, logsumexp

from measure.array_types import Array, Mask
from measure.fiducials.options import AFFINITY_SIGMA, MOST_BENT_MM, SCATTER_DEGREES, SCATTER_MM, film_terms, interleaved
from measure.flags import FALSE_DOUBT

NAMED = float(np.log(100.0))  # log-odds above which one cause is accepted against all others
_SUSPECT = -float(np.log(10.0))  # log-odds above which a mark may have the gross error
_RANK = 1e-9  # fraction of the largest singular value, below which a direction is a null direction
_LEAST_MM = 1e-6  # smallest standard deviation of a mark
_KNOWN = 1e6  # degrees of freedom of a known variance
_MOST_OFF_MM = 0.5  # largest standard deviation of a gross error: marks are not searched farther off than some 1 mm
_APART = 1 / 3  # fraction of the least distance of two marks: a jump is sought between columns of marks at least so far
_FEWEST_BEYOND = 2  # marks on either side of a jump: of one mark alone it is a gross error
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


class Hypothesis(IntEnum):
    """State of a frame's film, in addition to a possible gross error in one mark."""

    SOUND = 0
    BENT = 1
    PITCH = 2
    PERSPECTIVE = 3


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
    covariance_mm2 : (2n, 2n) covariance without the scatter of the film.
    scan_mm : (n, 2) measured places in the scan's axes.
    model : film deformation model of the project.
    """

    given_mm: Array
    off_mm: Array
    covariance_mm2: Array
    scan_mm: Array
    model: str = "affine"

    @classmethod
    def from_places(
        cls, given_mm: Array, measured_mm: Array, covariances_mm2: Array, model: str = "affine"
    ) -> "FrameMarks":
        """Rotate and shift measured places (n, 2) onto given ones (n, 2), with a mirror if needed. The measured places
        and their covariances (n, 2, 2) are in the scan's axes."""
        centers = given_mm.mean(axis=0), measured_mm.mean(axis=0)
        left, _, right = np.linalg.svd((given_mm - centers[0]).T @ (measured_mm - centers[1]))
        turn = left @ right
        n = len(given_mm)
        covariance = np.zeros((n, 2, n, 2))
        covariance[np.arange(n), :, np.arange(n)] = turn @ covariances_mm2 @ turn.T + _LEAST_MM**2 * np.eye(2)
        off = (measured_mm - centers[1]) @ turn.T - (given_mm - centers[0])
        return cls(given_mm - centers[0], off, covariance.reshape(2 * n, 2 * n), measured_mm, model)

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

    def scatter_degrees(self, film: Scatter) -> float:
        """Degrees of freedom of the variance of a residual, of which only the film's part is estimated (Welch and
        Satterthwaite)."""
        total_mm2 = 1 / np.mean(1 / (self._beyond_affine.variances + film.sigma**2))
        return float(film.degrees * (total_mm2 / film.sigma**2) ** 2)

    @cached_property
    def _beyond_affine(self) -> "_Reduced":
        return _Reduced.from_free(self, self.affine)

    @cached_property
    def _beyond_congruent(self) -> "_Reduced":
        return _Reduced.from_free(self, np.zeros((self.off_mm.size, 0)))

    @property
    def redundancy(self) -> int:
        """Redundancy with size, stretch and shear free."""
        return len(self._beyond_affine.variances)

    def chi_square(self, film_mm: float) -> float:
        """Chi-square of the misfit with size, stretch and shear free, for a film scatter of film_mm."""
        reduced = self._beyond_affine
        return float((reduced.residuals**2 / (reduced.variances + film_mm**2)).sum())

    def film_variance_mm2(self) -> float:
        """Variance of the film's scatter with which chi-square equals the redundancy (Paule and Mandel, 1982).

        An imprecise mark does not dilute the misfit of the others. 0 where the marks' covariances explain the misfit.
        """
        if self.redundancy == 0 or self.chi_square(0.0) <= self.redundancy:
            return 0.0
        most = float(np.sqrt((self._beyond_affine.residuals**2).sum()))
        return float(brentq(lambda film_mm: self.chi_square(film_mm) - self.redundancy, 0.0, most)) ** 2

    def added_variance_mm2(self, among: Mask, film_mm: float, affinity: Affinity) -> float:
        """Variance along an axis of some marks, among (n,), in addition to their covariances.

        Estimated like that of the film, from the chi-square of these marks given the others. Stretch and shear, and a
        size that is not free, are random as in the affinity.
        """
        first = int(affinity.size_is_free)
        strain = affinity.scatter.sigma * self.affine[:, first:]
        spread = strain @ strain.T + film_mm**2 * np.eye(len(strain))
        expected = self.expecting((self.affine @ affinity.mean).reshape(-1, 2), spread)
        reduced = _Reduced.from_free(expected, self.affine[:, :first])
        whitened = reduced.basis[np.repeat(among, 2)] / np.sqrt(reduced.variances)
        shares, axes = np.linalg.eigh(whitened.T @ whitened)  # 0: misfit of the other marks alone
        residuals = axes.T @ (reduced.residuals / np.sqrt(reduced.variances))
        affected = shares > _RANK * shares[-1]
        squares, shares = residuals[affected] ** 2, shares[affected]
        if squares.sum() <= len(squares):
            return 0.0
        most = float((squares / shares).max())
        return float(brentq(lambda mm2: float(np.sum(squares / (1 + mm2 * shares))) - len(squares), 0.0, most))

    def log_density(self, film_mm: float) -> float:
        """Log density of the misfit up to a constant, size, stretch and shear free."""
        return -0.5 * (float(np.log(self._beyond_affine.variances + film_mm**2).sum()) + self.chi_square(film_mm))

    def precision(self, film_mm: float) -> Array:
        """(2n, 2n) weight matrix of off_mm for a film scatter of film_mm, after elimination of all free parameters,
        size, stretch and shear included."""
        reduced = self._beyond_affine
        return np.asarray(reduced.weighted(film_mm) @ reduced.basis.T)

    def affinity(self, film_mm: float) -> tuple[Array, Array]:
        """Least-squares estimate (3,) of size, stretch and shear, and its covariance (3, 3)."""
        reduced = self._beyond_congruent
        moved = reduced.weighted(film_mm) @ (reduced.basis.T @ self.affine)
        covariance = np.asarray(np.linalg.pinv(self.affine.T @ moved, hermitian=True), dtype=np.float64)
        return covariance @ (moved.T @ self.off_mm.ravel()), covariance

    def distances_mm(self) -> Array:
        """(n,) residual lengths of an unweighted least-squares fit of all free parameters, size, stretch and shear
        included."""
        reduced = self._beyond_affine
        return np.asarray(np.hypot(*(reduced.basis @ reduced.residuals).reshape(-1, 2).T))

    def expecting(self, off_mm: Array, covariance_mm2: Array) -> "FrameMarks":
        """Subtract an expected misfit off_mm (n, 2), and add its covariance (2n, 2n)."""
        return replace(self, off_mm=self.off_mm - off_mm, covariance_mm2=self.covariance_mm2 + covariance_mm2)

    def widen(self, variances_mm2: Array) -> "FrameMarks":
        """Add variances (n,) to both coordinates of each mark."""
        return replace(self, covariance_mm2=self.covariance_mm2 + np.diag(np.repeat(variances_mm2, 2)))

    def select(self, index: NDArray[np.intp]) -> "FrameMarks":
        """Keep the marks of the given indices."""
        both = (2 * index[:, None] + np.arange(2)).ravel()
        covariance = self.covariance_mm2[np.ix_(both, both)]
        given, off, scan = self.given_mm[index], self.off_mm[index], self.scan_mm[index]
        return replace(self, given_mm=given, off_mm=off, covariance_mm2=covariance, scan_mm=scan)

    def rotate(self, turn: Array) -> "FrameMarks":
        """Transform to axes that are rotated, or mirrored, by turn (2, 2)."""
        every = np.kron(np.eye(len(self.given_mm)), turn)
        return replace(
            self,
            given_mm=self.given_mm @ turn.T,
            off_mm=self.off_mm @ turn.T,
            covariance_mm2=every @ self.covariance_mm2 @ every.T,
        )


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Misfit of a frame projected on the complement of its free parameters.

    basis: (2n, m) orthonormal, diagonalises the covariance; variances (m,) and residuals (m,) in this basis, mm.
    """

    basis: Array
    variances: Array
    residuals: Array

    @classmethod
    def from_free(cls, marks: FrameMarks, also: Array) -> "_Reduced":
        """Eliminate shift, rotation, the terms of the film model, and also: (2n, k) further free parameters."""
        x, y = marks.given_mm.T
        one, none = np.ones_like(x), np.zeros_like(x)
        measured = (marks.given_mm + marks.off_mm) / marks.radius_mm
        more = film_terms(marks.model, marks.given_mm / marks.radius_mm, measured)
        free = np.hstack([interleaved((one, none), (none, one), (-y, x)), also, more])
        free = np.hstack([free, marks.affine]) if more.shape[1] else free
        left, sizes, _ = np.linalg.svd(free / np.linalg.norm(free, axis=0))
        basis = left[:, int((sizes > _RANK * sizes[0]).sum()) :]
        variances, vectors = np.linalg.eigh(basis.T @ marks.covariance_mm2 @ basis)
        basis = basis @ vectors
        return cls(basis, np.maximum(variances, _LEAST_MM**2), basis.T @ marks.off_mm.ravel())

    def shifted(self, beyond: Mask) -> Array:
        """(m, n + j, 2) derivatives of the residuals by a shift of each mark, and of those beyond each jump."""
        basis = self.basis.reshape(len(beyond), 2, -1)
        return np.concatenate([basis, np.einsum("naj,ng->gaj", basis, beyond)]).transpose(2, 0, 1)

    def weighted(self, film_mm: float) -> Array:
        """(2n, m) basis over the variances, for a film scatter of film_mm."""
        return np.asarray(self.basis / (self.variances + film_mm**2))


@dataclass(frozen=True, eq=False)
class FrameConsistency:
    """Result of the consistency test of a frame.

    Attributes
    ----------
    log_evidence : (4, 1 + n + j) log evidence of the hypotheses with nothing else wrong (first column), with a gross
        error in each mark, and with each jump, given that something is wrong.
    off_mm : (n + j, 2) estimated gross error of each mark, and size of each jump, if it is the only one.
    beyond_jumps : (n, j) marks beyond each jump.
    """

    log_evidence: Array
    off_mm: Array
    beyond_jumps: Mask

    @property
    def log_odds(self) -> Array:
        """(n + 1,) log-odds of a gross error in each mark, and of any jump, against all other explanations."""
        whole, n = logsumexp(self.log_evidence, axis=0), len(self.beyond_jumps)
        causes = np.append(whole[: n + 1], logsumexp(np.append(whole[n + 1 :], -np.inf)))
        others = np.where(np.eye(n + 2)[1:], -np.inf, causes)
        return np.asarray(causes[1:] - logsumexp(others, axis=1))

    @property
    def log_gain(self) -> Array:
        """(n,) log-odds of a gross error in each mark against none, with or without a jump."""
        whole, n = logsumexp(self.log_evidence, axis=0), len(self.beyond_jumps)
        return np.asarray(whole[1 : n + 1] - logsumexp([whole[0], *whole[n + 1 :]]))

    @property
    def wrong_mark(self) -> int | None:
        """Mark whose gross error is accepted; None if there is none."""
        odds, best = self.log_odds, int(self.log_odds.argmax())
        return best if odds[best] > NAMED and best < len(self.beyond_jumps) else None

    @property
    def jump_mm(self) -> float | None:
        """Size of the likeliest jump, if there is one; None otherwise. Its place may be ambiguous."""
        n = len(self.beyond_jumps)
        likeliest = int(logsumexp(self.log_evidence, axis=0)[n + 1 :].argmax()) if self.beyond_jumps.size else 0
        return float(np.hypot(*self.off_mm[n + likeliest])) if self.log_odds[-1] > NAMED else None

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
    chi_square, degrees, reduced = marks.chi_square(film.sigma), marks.redundancy, marks._beyond_affine
    p_values = [1.0]
    if degrees:
        spread = reduced.variances + film.variances(_AVERAGED)[:, None]
        p_values.append(float(chdtrc(degrees, (reduced.residuals**2 / spread).sum(axis=1)).mean()))
    fitted, covariance = marks.affinity(film.sigma)
    if np.linalg.matrix_rank(covariance, tol=_RANK * np.trace(covariance)) == len(fitted):
        apart, spread = fitted - affinity.mean, covariance + affinity.scatter.sigma**2 * np.eye(3)
        first = int(affinity.size_is_free)
        apart, spread, tested = apart[first:], spread[first:, first:], len(apart) - first
        p_values.append(float(fdtrc(tested, affinity.scatter.degrees, apart @ np.linalg.solve(spread, apart) / tested)))
    if degrees > 2:
        shifts, weight = reduced.shifted(marks.beyond_jumps), 1 / (reduced.variances + film.sigma**2)
        pulls = np.einsum("m,mga->ga", weight * reduced.residuals, shifts)
        blocks = np.einsum("m,mga,mgb->gab", weight, shifts, shifts, optimize=True)
        known = np.linalg.eigvalsh(blocks)[:, 0] > _RANK * np.trace(blocks, axis1=1, axis2=2).max()
        solved = np.linalg.solve(blocks[known], pulls[known][..., None])[..., 0]
        share = float((pulls[known] * solved).sum(axis=1).max(initial=0.0))
        scatter_degrees = marks.scatter_degrees(film)
        others = scatter_degrees + degrees - 2
        ratio = share / 2 * others / (scatter_degrees + max(chi_square - share, 0.0))
        p_values.append(len(shifts[0]) * float(fdtrc(2, others, ratio)))
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
    states = _states(marks, film, affinity)
    reduced = marks._beyond_congruent
    moved = reduced.shifted(marks.beyond_jumps)
    groups = moved.shape[1]
    residual = marks.off_mm.ravel() - marks.affine @ affinity.mean
    effects = reduced.basis.T @ np.column_stack([marks.affine, marks.perspective])
    shifts = np.column_stack([reduced.basis.T @ residual, moved.reshape(len(moved), -1)])
    spread = reduced.variances + states.film[:, None]
    known = states.log_prior - 0.5 * np.log(spread).sum(axis=1)
    width = np.sqrt(states.effects)
    weighted = width[:, :, None] * effects.T / spread[:, None]
    inner = np.eye(5) + weighted @ effects * width[:, None, :]
    cross = weighted @ shifts
    taken = np.linalg.solve(inner, cross)
    chi_square = (shifts[:, 0] ** 2 / spread).sum(axis=1) - (cross[:, :, 0] * taken[:, :, 0]).sum(axis=1)
    known = known - 0.5 * (np.linalg.slogdet(inner)[1] + chi_square)
    pulls = (shifts[:, 0] / spread) @ shifts[:, 1:] - np.einsum("sp,spj->sj", cross[:, :, 0], taken[:, :, 1:])
    pulls = pulls.reshape(-1, groups, 2)
    # Only the diagonal 2 x 2 blocks of the weight matrix are needed: the whole one of many marks would take minutes.
    by_mark = (len(spread), 5, groups, 2)
    blocks = (1 / spread) @ (moved[..., :, None] * moved[..., None, :]).reshape(len(moved), -1)
    blocks = blocks.reshape(-1, groups, 2, 2) - np.einsum(
        "spka,spkb->skab", cross[:, :, 1:].reshape(by_mark), taken[:, :, 1:].reshape(by_mark)
    )
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
    evidence = np.array([logsumexp(every[states.hypothesis == each], axis=0) for each in Hypothesis])
    evidence[Hypothesis.SOUND, 0] = -np.inf
    weights = np.exp(every - logsumexp(every, axis=0))
    off_mm = np.stack([(weights[:, 1:] * off[-1]).sum(axis=0) for off in (off_x, off_y)], axis=1)
    return FrameConsistency(evidence, off_mm, marks.beyond_jumps)


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


@dataclass(frozen=True, eq=False)
class _States:
    """Grid of s states of film and scan, over which the evidence is summed.

    Attributes
    ----------
    hypothesis : (s,) `Hypothesis`.
    film : (s,) variance of the film's scatter, mm2.
    effects : (s, 5) variances of affinity (3) and perspective (2).
    log_prior : (s,) log prior probability.
    """

    hypothesis: NDArray[np.intp]
    film: Array
    effects: Array
    log_prior: Array


def _states(marks: FrameMarks, film: Scatter, affinity: Affinity) -> _States:
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
    return _States(hypothesis.astype(np.intp), film_mm2, effects, prior)


def _widths(most_mm: float) -> Array:
    return np.geomspace(SCATTER_MM, most_mm, _WIDTHS)
