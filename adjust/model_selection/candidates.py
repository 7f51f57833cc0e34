"""Comparison of adjusted models: nested ones by the F-test, any two by Akaike's criterion.

    F = ((v'Pv_s - v'Pv_r) / (u_r - u_s)) / (v'Pv_r / r_r)  ~  F(u_r - u_s, r_r)
    AIC = v'Pv + 2 u                                            for known variances
    AICc = n ln(v'Pv / n) + 2 K + 2 K (K + 1) / (n - K - 1)     K = u + 1, variance factor estimated

n counts the observations with the priors, u the unknowns. Sources: K. R. Koch, Parameter estimation and hypothesis
testing in linear models, 1999, chapter 4.2; K. P. Burnham and D. R. Anderson, Model selection and multimodel inference,
2002, chapter 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from adjust.model_selection.cross_validation import CrossValidation
from adjust.model_selection.models import Model
from adjust.quality.significance import LEVEL

DECISIVE = 10.0  # difference of AICc above which the worse model has essentially no support (Burnham and Anderson)


@dataclass(frozen=True)
class Candidate:
    """Adjusted model.

    Attributes
    ----------
    model : the model.
    problem : why it has no solution; empty where it has one.
    observations, unknowns, redundancy : counts.
    vpv, sigma0 : of the adjustment.
    cross_validation : prediction errors.
    correlated : pairs of highly correlated interior parameters, with their correlation.
    warnings : of the adjustment.
    """

    model: Model
    problem: str = ""
    observations: int = 0
    unknowns: int = 0
    redundancy: int = 0
    vpv: float = 0.0
    sigma0: float = 0.0
    cross_validation: CrossValidation | None = None
    correlated: tuple[tuple[str, str, float], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def aic(self) -> float:
        return self.vpv + 2.0 * self.unknowns

    @property
    def aicc(self) -> float:
        """AICc; inf with too few observations."""
        k, n = self.unknowns + 1, self.observations
        if n - k - 1 <= 0:
            return np.inf
        return float(n * np.log(max(self.vpv, np.finfo(float).tiny) / n) + 2 * k + 2 * k * (k + 1) / (n - k - 1))


@dataclass(frozen=True)
class Nested:
    """F-test of a model against a richer one that contains it."""

    simpler: Model
    richer: Model
    f: float
    degrees: tuple[int, int]
    p: float


def simplest_sufficient(candidates: Sequence[Candidate]) -> Candidate | None:
    """Select the simplest candidate that no richer one improves significantly; None without a solution."""
    chosen = None
    for candidate in sorted(_solved(candidates), key=lambda each: (each.unknowns, each.vpv)):
        if chosen is None or _is_better(candidate, chosen):
            chosen = candidate
    return chosen


def _is_better(richer: Candidate, simpler: Candidate) -> bool:
    """Whether a model is significantly better than one with no more unknowns, and also predicts better."""
    a, b = richer.cross_validation, simpler.cross_validation
    if a is not None and b is not None and a.sigmas >= b.sigmas:
        return False
    if a is None and b is not None:
        return False
    if richer.model.contains(simpler.model):
        return f_test(simpler, richer).p < LEVEL
    return simpler.aicc - richer.aicc > DECISIVE


def f_test(simpler: Candidate, richer: Candidate) -> Nested:
    """Test two nested models by the F-test."""
    more, redundancy = richer.unknowns - simpler.unknowns, richer.redundancy
    variance = richer.vpv / redundancy if redundancy > 0 else 1.0
    f = max(simpler.vpv - richer.vpv, 0.0) / more / variance
    p = fdtrc(more, redundancy, f) if redundancy > 0 else chdtrc(more, f * more)
    return Nested(simpler.model, richer.model, float(f), (more, redundancy), float(p))


def nested_tests(candidates: Sequence[Candidate]) -> tuple[Nested, ...]:
    """Test all neighbouring pairs: one contains the other, with no candidate between them."""
    solved = _solved(candidates)
    models = [each.model for each in solved]
    return tuple(
        f_test(simpler, richer)
        for richer in solved
        for simpler in solved
        if richer.model.contains(simpler.model)
        and richer.unknowns > simpler.unknowns
        and not any(richer.model.contains(each) and each.contains(simpler.model) for each in models)
    )


def _solved(candidates: Sequence[Candidate]) -> list[Candidate]:
    return [each for each in candidates if not each.problem]


def verdict(given: Model, chosen: Candidate | None) -> str:
    if chosen is None:
        return "No model has a solution."
    text = f"The data ask for {chosen.model.name}."
    if chosen.model == given:
        text += " That is the model as it is given."
    low, high = (float(np.sqrt(chdtri(chosen.redundancy, above) / chosen.redundancy)) for above in (0.995, 0.005))
    if chosen.redundancy > 0 and not low <= chosen.sigma0 <= high:
        text += (
            f" Its sigma0 of {chosen.sigma0:.2f} is not what the given standard deviations allow, {low:.2f} to "
            f"{high:.2f}: they are not right, or no candidate is."
        )
    return text


def reasons(candidates: Sequence[Candidate], chosen: Candidate | None) -> tuple[str, ...]:
    """Explain the rejection of every candidate that differs from the chosen one in one respect only.

    Respects are distortion, transformation and scanner terms.
    """
    if chosen is None:
        return tuple(f"{each.model.name}: {each.problem}" for each in candidates)
    own, near = chosen.model, []
    for each in candidates:
        model = each.model
        lens = (model.family, model.parameters) != (own.family, own.parameters)
        if lens + (model.transformation != own.transformation) + (model.bends != own.bends) == 1:
            near.append(each)
    return tuple(_reason(each, chosen) for each in near)


def _reason(other: Candidate, chosen: Candidate) -> str:
    name = other.model.name
    if other.problem:
        return f"{name} cannot be had: {other.problem}"
    predicts = _prediction(other, chosen)
    if chosen.model.contains(other.model):
        test = f_test(other, chosen)
        return f"{name} is too simple: {_f_words(test)}; {predicts}."
    if other.model.contains(chosen.model) and other.unknowns > chosen.unknowns:
        test = f_test(chosen, other)
        needless = "adds nothing that is significant" if test.p >= LEVEL else "fits significantly better"
        return f"{name} {needless}: {_f_words(test)}; {predicts}."
    better = "higher" if other.aicc >= chosen.aicc else "lower"
    size = "richer" if other.unknowns > chosen.unknowns else "no richer"
    return f"{name}, {size}, has an AICc {abs(other.aicc - chosen.aicc):.1f} {better}; {predicts}."


def _f_words(test: Nested) -> str:
    chance = f"p = {test.p:.3f}" if test.p >= 0.001 else "p < 0.001"
    return f"F({test.degrees[0]}, {test.degrees[1]}) = {test.f:.3g}, {chance}"


def _prediction(other: Candidate, chosen: Candidate) -> str:
    a, b = other.cross_validation, chosen.cross_validation
    if a is None or b is None:
        return "it was not cross-validated" if a is None else "the chosen one was not cross-validated"
    return f"it predicts points left out to {a.rms_um:.2f} µm, the chosen one to {b.rms_um:.2f} µm"
