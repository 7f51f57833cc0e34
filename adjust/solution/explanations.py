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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from adjust.errors import AdjustmentError
from adjust.least_squares.iteration import linearise
from adjust.least_squares.numbering import Numbering
from adjust.problem.probabilities import Probabilities
from adjust.quality.snooping import GrossError, Search, contradictions, rest_without, search
from adjust.rank_defect.diagnosis import singular_directions
from adjust.solution.explanation_words import noise_words, sentence
from adjust.solution.model_hypotheses import ModelHypothesis, apart, model_hypotheses
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
class Explained:
    """What explains the residuals, the most first, and the adjustment with it: as it was where nothing does."""

    explanations: tuple[Explanation, ...]
    run: Run


def explain(run: Run, redundancy: int, probabilities: Probabilities) -> Explained:
    """What explains residuals that are larger than the standard deviations given, if anything does.

    Nothing is sought where sigma0 is at most 1, or the adjustment has no solution.
    """
    if not run.converged or run.found is None or redundancy < CHECKED or run.end.vpv <= redundancy:
        return Explained((), run)
    first = _Model(run, redundancy, probabilities)
    found, last = _added(first)
    if last.is_beyond(LEVEL) and not last.contradicting:
        noise = added_noise(last.run, last.redundancy)
        if noise is not None:
            found = (*found, _of_noise(noise, last))
            last = replace(last, run=noise.run)
    explains = not last.is_beyond(probabilities.family)
    explains |= last.variance - 1.0 < LEFT * (first.variance - 1.0)
    return Explained(found, last.run) if found and explains else Explained((), run)


def _added(model: "_Model") -> tuple[tuple[Explanation, ...], "_Model"]:
    """The hypotheses that explain most, one beside the other, and the adjustment with them."""
    found: list[Explanation] = []
    for _ in range(ROUNDS):
        if found and not model.is_beyond(model.probabilities.family):
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

    def is_beyond(self, level: float) -> bool:
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
        return rest_without(self._search, [each.unit for each in self.contradicting])

    def criterion(self, variance: float) -> float:
        """v'Pv over a variance without gross errors, and what these and their choice cost."""
        if not self.contradicting:
            return self.vpv / variance
        gross = self.redundancy - self.rest[1] + len(self.contradicting) * float(np.log(len(self._search.critical)))
        return self.rest[0] / variance + 2.0 * gross

    @cached_property
    def _search(self) -> Search:
        run = self.run
        if run.found is None:
            raise AdjustmentError("There is no solution whose observations could be tested.")
        return search(run.numbering, run.end, run.factor, run.found, run.weighting, self.probabilities)


@dataclass(frozen=True)
class _Candidate:
    """A hypothesis that was adjusted, and the probability of so large a fall of v'Pv by chance.

    has_rival: gross errors of single observations explain the residuals as well.
    """

    hypothesis: ModelHypothesis
    model: _Model
    p: float
    has_rival: bool = False

    def criterion(self, variance: float) -> float:
        return self.model.criterion(variance) + 2.0 * (len(self.hypothesis.added) + self.hypothesis.choices)


def _best(model: _Model) -> list[_Candidate]:
    """The best hypotheses that explain what chance does not; several where they do so alike."""
    hypotheses = list(model_hypotheses(model.run))
    falls = [_fall(model.run, each) for each in hypotheses]
    level = LEVEL / max(len(hypotheses), 1)
    likely = [
        (fall, each)
        for fall, each in zip(falls, hypotheses, strict=True)
        if fall > WORTH * max(falls) and _probability(each, model, fall) < level
    ]
    likely.sort(key=lambda pair: -pair[0])
    candidates = [_adjusted(model, each) for _, each in likely[:MOST_ADJUSTED]]
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


def _fall(run: Run, hypothesis: ModelHypothesis) -> float:
    """By how much v'Pv falls with the added unknowns, to the first order; 0 where they are not determined."""
    weighted, covariance = run.weighting.applied(hypothesis.problem)
    numbering = Numbering(weighted)
    at = linearise(numbering, covariance, weighted.start())
    if at is None or singular_directions(weighted, at.state, numbering.free, at.factor):
        return 0.0
    return at.factor.length() ** 2


def _adjusted(model: _Model, hypothesis: ModelHypothesis) -> _Candidate | None:
    """The hypothesis adjusted; None where that has no solution."""
    run = again(replace(model.run, problem=hypothesis.problem), model.run.weighting, STEPS, hypothesis.problem.start())
    if not run.converged or run.found is None:
        return None
    left = model.redundancy - len(hypothesis.added)
    larger = _Model(run, left, model.probabilities, bool(model.contradicting))
    return _Candidate(hypothesis, larger, _probability(hypothesis, model, model.vpv - larger.vpv))


def _probability(hypothesis: ModelHypothesis, model: _Model, fall: float) -> float:
    """Of such a fall of v'Pv, or a larger one, by chance."""
    single = _of_fall(model, fall, len(hypothesis.added))
    if not hypothesis.contrasts:
        return single
    bonferroni = np.exp(min(0.0, np.log(max(single, 1e-300)) + hypothesis.choices))
    return float(min(bonferroni, _of_fall(model, fall, hypothesis.contrasts)))


def _of_fall(model: _Model, fall: float, count: int) -> float:
    left = model.redundancy - count
    if fall <= 0.0 or left < 1:
        return 1.0
    variance = (model.vpv - fall) / left
    return float(fdtrc(count, left, fall / (count * variance)) if variance > 1.0 else chdtrc(count, fall))


def _following(candidate: _Candidate) -> _Model | None:
    """The adjustment in which more is sought: groups of images with all of their lens apart; None where that has no
    solution."""
    hypothesis, model = candidate.hypothesis, candidate.model
    if hypothesis.kind != "groups":
        return model
    problem = apart(model.run)
    if problem is None:
        return None
    run = again(replace(model.run, problem=problem), model.run.weighting, STEPS, problem.start())
    if not run.converged or run.found is None:
        return None
    added = len(run.numbering.free) - len(model.run.numbering.free)
    return _Model(run, model.redundancy - added, model.probabilities, model.has_suspects)


def _explanation(candidate: _Candidate, model: _Model) -> Explanation:
    larger = candidate.model
    coordinates = 2 * len(model.run.end.v_mm)
    sigma_um = 1000.0 * float(np.sqrt(np.mean(np.trace(_covariance(model.run), axis1=1, axis2=2)) / 2.0))
    explained_um = sigma_um * float(np.sqrt(max(model.vpv - larger.vpv, 0.0) / coordinates))
    cause, remedy = sentence(candidate.hypothesis, larger.run, explained_um)
    sigma0 = float(np.sqrt(model.variance)), float(np.sqrt(larger.variance))
    return _as_explanation(candidate.hypothesis.kind, cause, remedy, candidate.p, sigma0)


def _covariance(run: Run) -> Array:
    return run.problem.network.observations.covariance_mm2


def _of_noise(noise: AddedNoise, model: _Model) -> Explanation:
    cause, remedy = noise_words(noise, model.run)
    sigma0 = float(np.sqrt(model.variance)), float(np.sqrt(noise.run.end.vpv / model.redundancy))
    return _as_explanation("noise", cause, remedy, float(chdtrc(model.redundancy, model.vpv)), sigma0)


def _as_explanation(kind: str, cause: str, remedy: str, p: float, sigma0: tuple[float, float]) -> Explanation:
    chance = f"p = {p:.1g}" if p > 1e-99 else "p < 1e-99"
    figures = f"with this in the model σ₀ falls from {sigma0[0]:.3g} to {sigma0[1]:.3g} ({chance})"
    return Explanation(kind, f"{cause}; {figures}.", remedy, p, sigma0)
