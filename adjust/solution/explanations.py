"""Why residuals are larger than the standard deviations given: the models, and the noise, that explain them.

A hypothesis adds k unknowns to the model. One linearised step from the end of the adjustment without them tells by how
much v'Pv falls to the first order; what that makes likely is adjusted and tested by the fall itself,

    F = fall / (k s²),   s² = max(1, v'Pv / r of the larger model),

chi-square over k where s² = 1. The groups of a partition that was chosen for it are tested by the smaller of two
bounds: Scheffé's, with the unknowns of all contrasts, and Bonferroni's, over all partitions. All hypotheses of a round
share the probability LEVEL. Hypotheses are compared with each other, and with gross errors of single observations, by
v'Pv plus twice the unknowns and the logarithm of the choices (Akaike); what comes within TOLD_APART is named with the
best. Nothing is named unless all that is named takes more than half of what v'Pv has beyond its redundancy.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, fdtrc

from adjust.least_squares.iteration import linearise
from adjust.least_squares.numbering import Numbering
from adjust.problem.probabilities import Probabilities
from adjust.problem.problem import Problem
from adjust.quality.run import GrossError, Run
from adjust.quality.snooping import TOLD_APART, Snooping
from adjust.rank_defect.diagnosis import singular_directions
from adjust.solution.model_hypotheses import GROUPS, ModelHypothesis, model_hypotheses, separate_lenses
from adjust.solution.noise_hypothesis import added_noise
from adjust.solution.reweighting import again

LEVEL = 0.001  # probability of naming anything where the model is right
CHECKED = 10  # redundancy from which on an explanation is one
ROUNDS = 3  # of explanations, each on top of those before
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
    if not run.converged or not run.is_tested or redundancy < CHECKED or run.end.vpv <= redundancy:
        return Explained((), run)
    first = last = _Model(run, redundancy, probabilities)
    found: list[Explanation] = []
    for _ in range(ROUNDS):
        if found and not last.exceeds(probabilities.family):
            break
        alike, has_rival = _best(last)
        found += [_model_explanation(each, last) for each in alike]
        if not alike or has_rival:
            break
        following = _following(alike[0]) if len(alike) == 1 else None
        last = following or alike[0]
        if following is None:
            break
    if last.exceeds(LEVEL) and not last.gross_errors and (noise := added_noise(last.run, last.redundancy)):
        noisy = replace(last, run=noise.run)
        found.append(_explanation("noise", noise.words, float(chdtrc(last.redundancy, last.vpv)), last, noisy))
        last = noisy
    explains = not last.exceeds(probabilities.family) or last.variance - 1.0 < LEFT * (first.variance - 1.0)
    return Explained(tuple(found), last.run) if found and explains else Explained((), run)


@dataclass(frozen=True)
class _Model:
    """An adjustment, and how well it agrees with its observations, with and without the worst of them.

    has_suspects: whether gross errors are looked for; where the simpler model has none, they are not. hypothesis: what
    it has more than the simpler one, p: the probability of so large a fall of v'Pv by chance.
    """

    run: Run
    redundancy: int
    probabilities: Probabilities
    has_suspects: bool = True
    hypothesis: ModelHypothesis | None = None
    p: float = 1.0

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
    def _snooping(self) -> Snooping:
        return Snooping(self.run, self.probabilities)

    @cached_property
    def gross_errors(self) -> list[GrossError]:
        return self._snooping.contradictions if self.has_suspects else []

    @cached_property
    def rest(self) -> tuple[float, float]:
        """v'Pv and redundancy without what contradicts the others."""
        units = [each.unit for each in self.gross_errors]
        return self._snooping.rest(units) if units else (self.vpv, float(self.redundancy))

    def criterion(self, variance: float) -> float:
        """v'Pv over a variance without gross errors, and what these and their choice cost."""
        if not self.gross_errors:
            return self.vpv / variance
        chosen_from = len(self.gross_errors) * float(np.log(len(self._snooping.critical)))
        return self.rest[0] / variance + 2.0 * (self.redundancy - self.rest[1] + chosen_from)

    @property
    def costs(self) -> float:
        """Of the unknowns and the choice of the hypothesis."""
        return 2.0 * (len(self.hypothesis.added) + self.hypothesis.choices) if self.hypothesis else 0.0

    def probability(self, hypothesis: ModelHypothesis, fall: float) -> float:
        """Of such a fall of v'Pv by a hypothesis, or a larger one, by chance."""
        single = self._fall_probability(fall, len(hypothesis.added))
        if not hypothesis.contrasts:
            return single
        bonferroni = np.exp(min(0.0, np.log(max(single, 1e-300)) + hypothesis.choices))
        return float(min(bonferroni, self._fall_probability(fall, hypothesis.contrasts)))

    def _fall_probability(self, fall: float, count: int) -> float:
        left = self.redundancy - count
        if fall <= 0.0 or left < 1:
            return 1.0
        variance = (self.vpv - fall) / left
        return float(fdtrc(count, left, fall / (count * variance)) if variance > 1.0 else chdtrc(count, fall))


def _best(model: _Model) -> tuple[list[_Model], bool]:
    """The models with the best hypotheses that explain what chance does not, several where they do so alike; and
    whether gross errors of single observations explain the residuals as well."""
    falls = [(_first_order_fall(model.run, each), each) for each in model_hypotheses(model.run)]
    level = LEVEL / max(len(falls), 1)
    worth = WORTH * max((fall for fall, _ in falls), default=0.0)
    likely = [(fall, each) for fall, each in falls if fall > worth and model.probability(each, fall) < level]
    likely.sort(key=lambda each: -each[0])
    candidates = [_larger_model(model, each) for _, each in likely[:MOST_ADJUSTED]]
    found = [each for each in candidates if each is not None and each.p < level]
    if not found:
        return [], False
    variance = max(1.0, min(each.rest[0] / each.rest[1] for each in (model, *found)))
    criteria = [each.criterion(variance) + each.costs for each in found]
    without = model.criterion(variance) - min(criteria) if model.gross_errors else np.inf
    if without < -TOLD_APART:
        return [], False
    alike = [each for each, own in zip(found, criteria, strict=True) if own < min(criteria) + TOLD_APART]
    return alike, bool(without < TOLD_APART)


def _first_order_fall(run: Run, hypothesis: ModelHypothesis) -> float:
    """By how much v'Pv falls with the added unknowns, to the first order; 0 where they are not determined."""
    weighted, covariance = run.weighting.applied(hypothesis.problem)
    numbering = Numbering(weighted)
    at = linearise(numbering, covariance, weighted.start())
    if at is None or singular_directions(weighted, at.state, numbering.free, at.factor):
        return 0.0
    return at.factor.length() ** 2


def _larger_model(model: _Model, hypothesis: ModelHypothesis) -> _Model | None:
    """The hypothesis adjusted; None where that has no solution."""
    run = _refit(model.run, hypothesis.problem)
    if run is None:
        return None
    left = model.redundancy - len(hypothesis.added)
    p = model.probability(hypothesis, model.vpv - run.end.vpv)
    return _Model(run, left, model.probabilities, bool(model.gross_errors), hypothesis, p)


def _following(model: _Model) -> _Model | None:
    """The adjustment in which more is sought: groups of images with all of their lens apart; None where that has no
    solution."""
    if model.hypothesis is None or model.hypothesis.kind != GROUPS:
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
    return larger if larger.converged and larger.is_tested else None


def _model_explanation(larger: _Model, model: _Model) -> Explanation:
    assert larger.hypothesis is not None
    hypothesis, coordinates = larger.hypothesis, 2 * len(model.run.end.v_mm)
    covariance = model.run.problem.network.observations.covariance_mm2
    sigma_um = 1000.0 * float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)) / 2.0))
    explained_um = sigma_um * float(np.sqrt(max(model.vpv - larger.vpv, 0.0) / coordinates))
    words = hypothesis.words(larger.run, hypothesis.added, explained_um)
    return _explanation(hypothesis.kind, words, larger.p, model, larger)


def _explanation(kind: str, words: tuple[str, str], p: float, without: _Model, larger: _Model) -> Explanation:
    sigma0 = float(np.sqrt(without.variance)), float(np.sqrt(larger.variance))
    chance = f"p = {p:.1g}" if p > 1e-99 else "p < 1e-99"
    figures = f"with this in the model σ₀ falls from {sigma0[0]:.3g} to {sigma0[1]:.3g} ({chance})"
    return Explanation(kind, f"{words[0]}; {figures}.", words[1], p, sigma0)
