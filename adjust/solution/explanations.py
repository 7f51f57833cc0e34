"""Why residuals are larger than the standard deviations given: the models, and the noise, that explain them.

A hypothesis adds k unknowns to the model. One linearised step from the end of the adjustment without them tells by how
much v'Pv falls to the first order; what that makes likely is adjusted and tested by the fall itself,

    F = fall / (k s²),   s² = max(1, v'Pv / r of the larger model),

chi-square over k where s² = 1. The groups of a partition that was chosen for it are tested by the smaller of two
bounds: Scheffé's, with the unknowns of all contrasts, and Bonferroni's, over all partitions. All hypotheses of a round
share the probability LEVEL. Hypotheses are compared with each other, and with gross errors of single observations, by
v'Pv plus twice the unknowns and the logarithm of the choices (Akaike); what comes within TOLD_APART is named beside the
best. Nothing is named unless all that is named takes more than half of what v'Pv has beyond its redundancy.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from adjust.errors import AdjustmentError
from adjust.least_squares.iteration import linearise
from adjust.least_squares.numbering import Numbering
from adjust.problem.probabilities import Probabilities
from adjust.problem.problem import Problem
from adjust.quality.snooping import GrossError, Search, contradictions, rest_after, search
from adjust.rank_defect.diagnosis import singular_directions
from adjust.solution.explanation_words import (
    board_words,
    decentering_words,
    group_words,
    noise_words,
    pixel_words,
    radial_words,
)
from adjust.solution.model_hypotheses import (
    ModelHypothesis,
    bent_board,
    decentering_terms,
    radial_terms,
    second_interior_orientation,
    separate_lenses,
    unequal_pixels,
)
from adjust.solution.noise_hypothesis import AddedNoise, added_noise
from adjust.solution.reweighting import Run, again

Indices = NDArray[np.intp]

Array = NDArray[np.float64]

LEVEL = 0.001  # probability of naming anything where the model is right
TOLD_APART = 7.0  # difference of two criteria from which on one explanation is clearly the better: odds of 30 to 1
CHECKED = 10  # redundancy from which on an explanation is one
ROUNDS = 3  # of explanations, each beside those before
MOST_ADJUSTED = 4  # hypotheses of a round
LEFT = 0.5  # of what v'Pv has beyond its redundancy that may remain of what is explained
WORTH = 0.3  # of the largest fall, to the first order, from which on a hypothesis is adjusted
STEPS = 20


@dataclass(frozen=True)
class Explanation:
    """What makes residuals larger than the standard deviations given, beyond chance.

    cause: in words with figures; remedy: what to do. kind: "radial", "decentering", "pixels", "groups", "board" or
    "noise". p: probability of so much by chance; sigma0: without and with it in the model.
    """

    kind: str
    cause: str
    remedy: str
    p: float
    sigma0: tuple[float, float]


@dataclass(frozen=True)
class HypothesisKind:
    """What a model may lack: how it is extended by it, and the cause and the remedy in words."""

    name: str
    extensions: Callable[[Run], Iterator[ModelHypothesis]]
    words: Callable[[ModelHypothesis, Run, float], tuple[str, str]]


GROUPS = HypothesisKind("groups", second_interior_orientation, group_words)
KINDS = (
    HypothesisKind("radial", radial_terms, radial_words),
    HypothesisKind("decentering", decentering_terms, decentering_words),
    HypothesisKind("pixels", unequal_pixels, pixel_words),
    GROUPS,
    HypothesisKind("board", bent_board, board_words),
)


@dataclass(frozen=True)
class Explained:
    """What explains the residuals, the most first, and the adjustment with it: as it was where nothing does."""

    explanations: tuple[Explanation, ...]
    run: Run


def explain(run: Run, redundancy: int, probabilities: Probabilities) -> Explained:
    """What explains residuals that are larger than the standard deviations given, if anything does.

    Nothing is sought where sigma0 is at most 1, or the adjustment has no solution.
    """
    if not run.converged or run.misfits is None or redundancy < CHECKED or run.end.vpv <= redundancy:
        return Explained((), run)
    first = _Model(run, redundancy, probabilities)
    found, last = _add_hypotheses(first)
    if last.exceeds(LEVEL) and not last.contradicting:
        noise = added_noise(last.run, last.redundancy)
        if noise is not None:
            found = (*found, _noise_explanation(noise, last))
            last = replace(last, run=noise.run)
    explains = not last.exceeds(probabilities.family)
    explains |= last.variance - 1.0 < LEFT * (first.variance - 1.0)
    return Explained(found, last.run) if found and explains else Explained((), run)


def _add_hypotheses(model: "_Model") -> tuple[tuple[Explanation, ...], "_Model"]:
    """The hypotheses that explain most, one beside the other, and the adjustment with them."""
    found: list[Explanation] = []
    for _ in range(ROUNDS):
        if found and not model.exceeds(model.probabilities.family):
            break
        alike = _best(model)
        found += [_explanation(each, model) for each in alike]
        if not alike or alike[0].has_rival:
            break
        following = _following(alike[0]) if len(alike) == 1 else None
        model = following or alike[0].model
        if following is None:
            break
    return tuple(found), model


@dataclass(frozen=True)
class _Model:
    """An adjustment, and how well it agrees with its observations, with and without the worst of them.

    has_suspects: whether gross errors are looked for; where the simpler model has none, they are not.
    """

    run: Run
    redundancy: int
    probabilities: Probabilities
    has_suspects: bool = True

    @property
    def vpv(self) -> float:
        return self.run.end.vpv

    @property
    def variance(self) -> float:
        return self.vpv / self.redundancy

    def exceeds(self, level: float) -> bool:
        """Whether v'Pv is larger than chance makes it with a probability."""
        return bool(chdtrc(self.redundancy, self.vpv) < level)

    @cached_property
    def contradicting(self) -> list[GrossError]:
        return contradictions(self._search) if self.has_suspects else []

    @cached_property
    def rest(self) -> tuple[float, float]:
        """v'Pv and redundancy without what contradicts the others."""
        if not self.contradicting:
            return self.vpv, float(self.redundancy)
        return rest_after(self._search, [each.unit for each in self.contradicting])

    def criterion(self, variance: float) -> float:
        """v'Pv over a variance without gross errors, and what these and their choice cost."""
        if not self.contradicting:
            return self.vpv / variance
        gross = self.redundancy - self.rest[1] + len(self.contradicting) * float(np.log(len(self._search.critical)))
        return self.rest[0] / variance + 2.0 * gross

    @cached_property
    def _search(self) -> Search:
        run = self.run
        if run.misfits is None:
            raise AdjustmentError("There is no solution whose observations could be tested.")
        return search(run.numbering, run.end, run.factor, run.misfits, run.weighting, self.probabilities)


@dataclass(frozen=True)
class _Candidate:
    """A hypothesis that was adjusted, and the probability of so large a fall of v'Pv by chance.

    has_rival: gross errors of single observations explain the residuals as well.
    """

    kind: HypothesisKind
    hypothesis: ModelHypothesis
    model: _Model
    p: float
    has_rival: bool = False

    def criterion(self, variance: float) -> float:
        return self.model.criterion(variance) + 2.0 * (len(self.hypothesis.added) + self.hypothesis.choices)


def _best(model: _Model) -> list[_Candidate]:
    """The best hypotheses that explain what chance does not; several where they do so alike."""
    tried = [(_first_order_fall(model.run, each), kind, each) for kind in KINDS for each in kind.extensions(model.run)]
    level = LEVEL / max(len(tried), 1)
    least = WORTH * max((fall for fall, _, _ in tried), default=0.0)
    likely = [each for each in tried if each[0] > least and _probability(each[2], model, each[0]) < level]
    likely.sort(key=lambda each: -each[0])
    candidates = [_candidate(model, kind, each) for _, kind, each in likely[:MOST_ADJUSTED]]
    found = [each for each in candidates if each is not None and each.p < level]
    if not found:
        return []
    variance = max(1.0, min(each.rest[0] / each.rest[1] for each in (model, *(one.model for one in found))))
    least = min(each.criterion(variance) for each in found)
    without = model.criterion(variance) if model.contradicting else np.inf
    if without < least - TOLD_APART:
        return []
    alike = [each for each in found if each.criterion(variance) < least + TOLD_APART]
    return [replace(each, has_rival=without < least + TOLD_APART) for each in alike]


def _first_order_fall(run: Run, hypothesis: ModelHypothesis) -> float:
    """By how much v'Pv falls with the added unknowns, to the first order; 0 where they are not determined."""
    weighted, covariance = run.weighting.applied(hypothesis.problem)
    numbering = Numbering(weighted)
    at = linearise(numbering, covariance, weighted.start())
    if at is None or singular_directions(weighted, at.state, numbering.free, at.factor):
        return 0.0
    return at.factor.length() ** 2


def _candidate(model: _Model, kind: HypothesisKind, hypothesis: ModelHypothesis) -> _Candidate | None:
    """The hypothesis adjusted; None where that has no solution."""
    run = _refit(model.run, hypothesis.problem)
    if run is None:
        return None
    left = model.redundancy - len(hypothesis.added)
    larger = _Model(run, left, model.probabilities, bool(model.contradicting))
    return _Candidate(kind, hypothesis, larger, _probability(hypothesis, model, model.vpv - larger.vpv))


def _probability(hypothesis: ModelHypothesis, model: _Model, fall: float) -> float:
    """Of such a fall of v'Pv, or a larger one, by chance."""
    single = _fall_probability(model, fall, len(hypothesis.added))
    if not hypothesis.contrasts:
        return single
    bonferroni = np.exp(min(0.0, np.log(max(single, 1e-300)) + hypothesis.choices))
    return float(min(bonferroni, _fall_probability(model, fall, hypothesis.contrasts)))


def _fall_probability(model: _Model, fall: float, count: int) -> float:
    left = model.redundancy - count
    if fall <= 0.0 or left < 1:
        return 1.0
    variance = (model.vpv - fall) / left
    return float(fdtrc(count, left, fall / (count * variance)) if variance > 1.0 else chdtrc(count, fall))


def _following(candidate: _Candidate) -> _Model | None:
    """The adjustment in which more is sought: groups of images with all of their lens apart; None where that has no
    solution."""
    model = candidate.model
    if candidate.kind is not GROUPS:
        return model
    problem = separate_lenses(model.run)
    run = None if problem is None else _refit(model.run, problem)
    if run is None:
        return None
    added = len(run.numbering.free) - len(model.run.numbering.free)
    return replace(model, run=run, redundancy=model.redundancy - added)


def _refit(run: Run, problem: Problem) -> Run | None:
    """A larger problem adjusted from where it starts, with the same weights; None where that has no solution."""
    larger = again(replace(run, problem=problem), run.weighting, STEPS, problem.start())
    return larger if larger.converged and larger.misfits is not None else None


def _explanation(candidate: _Candidate, model: _Model) -> Explanation:
    larger = candidate.model
    covariance, coordinates = model.run.problem.network.observations.covariance_mm2, 2 * len(model.run.end.v_mm)
    sigma_um = 1000.0 * float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)) / 2.0))
    explained_um = sigma_um * float(np.sqrt(max(model.vpv - larger.vpv, 0.0) / coordinates))
    words = candidate.kind.words(candidate.hypothesis, larger.run, explained_um)
    return _quantified(candidate.kind.name, words, candidate.p, model.variance, larger.variance)


def _noise_explanation(noise: AddedNoise, model: _Model) -> Explanation:
    p = float(chdtrc(model.redundancy, model.vpv))
    variance = noise.run.end.vpv / model.redundancy
    return _quantified("noise", noise_words(noise, model.run), p, model.variance, variance)


def _quantified(kind: str, words: tuple[str, str], p: float, before: float, after: float) -> Explanation:
    """before, after: the variance factors without and with what explains it."""
    sigma0 = float(np.sqrt(before)), float(np.sqrt(after))
    chance = f"p = {p:.1g}" if p > 1e-99 else "p < 1e-99"
    figures = f"with this in the model σ₀ falls from {sigma0[0]:.3g} to {sigma0[1]:.3g} ({chance})"
    return Explanation(kind, f"{words[0]}; {figures}.", words[1], p, sigma0)
