"""Consistency of a frame's marks with their given coordinates, by the linear model of their misfit (`FrameMarks`).

The chi-square of the residuals tests the frame, a mean shift of mark k tests the mark (data snooping: Baarda 1968), a
shift that all marks beyond a column or row of the scan share tests for a jump of the scanner or a seam.
Hypotheses are compared by their evidence (marginal likelihood): the film is ordinary, bent, stretched by a wrong pitch,
or photographed obliquely; under each of these nothing else is wrong, or one mark has a gross error, or the scan a jump.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc, logsumexp

from measure.array_types import Array, Mask
from measure.fiducials.misfit_model import LONE_AFFINITY, LONE_FILM, RANK, Affinity, FrameMarks, Scatter
from measure.fiducials.options import AFFINITY_SIGMA, MOST_BENT_MM, SCATTER_MM
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
    weight = reduced.weigh(films_mm2, np.column_stack([marks.affine, marks.perspective]), np.sqrt(effects_mm2))
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
