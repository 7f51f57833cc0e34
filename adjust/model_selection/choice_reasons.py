"""Why a model was chosen, in words: what the data ask for, and a sentence on each other candidate near to it."""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from adjust.model_selection.candidates import Candidate, Nested, f_test
from adjust.model_selection.models import Model
from adjust.quality.significance import LEVEL


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
    """A sentence on every other candidate that differs from the chosen one in one thing alone: distortion,
    transformation or bends."""
    if chosen is None:
        return tuple(f"{each.model.name}: {each.problem}" for each in candidates)
    near = [each for each in candidates if _differences(each.model, chosen.model) == 1]
    return tuple(_reason(each, chosen) for each in near)


def _differences(one: Model, other: Model) -> int:
    lens = (one.family, one.parameters) != (other.family, other.parameters)
    return lens + (one.transformation != other.transformation) + (one.bends != other.bends)


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
    return f"it predicts points left out to {a.rms_um:.2f} um, the chosen one to {b.rms_um:.2f} um"
