"""The table of a camera's parameters: value, standard deviation, what was given, and what that says."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.families import family as family_of
from adjust.functional_model.families import parameter_names
from adjust.problem.parameter import Parameter, parameter_from_text
from adjust.quality.significance import LEVEL
from pipeline.report.lens import largest_effects_um, lens
from pipeline.report.numbers import fixed, significant, value_and_sigma
from pipeline.results.adjustment_record import CameraRecord, GivenQuantity, GroupTestRecord, Quantity
from pipeline.results.covariance_file import Covariance

MOSTLY_PRIOR = 0.9  # of the prior's sigma is left: the data have told little
HIGH_CORRELATION = 0.9

_SYMBOLS = {"x0": "x₀′", "y0": "y₀′"}


@dataclass(frozen=True)
class ParameterRow:
    """A quantity of the table, what was given of it, and what that says. effect: at the outermost target, in um."""

    symbol: str
    unit: str
    quantity: Quantity
    given: str
    effect: str
    meaning: str


def parameter_rows(name: str, camera: CameraRecord, prior_scale: float, radius_mm: float) -> Iterator[ParameterRow]:
    """Principal distance, principal point and distortion. radius_mm: where the distortion's effect is stated;
    prior_scale: what the adjustment has multiplied given standard deviations by."""
    family, names = family_of(camera.distortion.family), parameter_names(camera.distortion.family)
    for parameter, quantity in list(camera.interior.items())[:3]:
        meaning = _origin(quantity, prior_scale)
        yield ParameterRow(_SYMBOLS.get(parameter, parameter), "mm", quantity, _given_text(quantity), "", meaning)
    effects = largest_effects_um(lens(name, camera), radius_mm) if names else {}
    for parameter, um_per_unit in effects.items():
        known = camera.distortion.parameters.get(parameter)
        if known is not None and (known.value != 0.0 or known.sigma != 0.0):
            effect = significant(um_per_unit * known.value, 3)
            if known.sigma > 0.0:
                effect = " ± ".join(value_and_sigma(um_per_unit * known.value, um_per_unit * known.sigma))
            unit = family.unit(parameter)
            yield ParameterRow(parameter, unit, known, _given_text(known), effect, _significance(known))


def term_rows(terms: Mapping[str, Quantity]) -> Iterator[ParameterRow]:
    """The terms of a scanner's bend, in um."""
    for name, known in terms.items():
        given = known.given and GivenQuantity(1e3 * known.given.value, 1e3 * known.given.sigma)
        in_um = replace(known, value=1e3 * known.value, sigma=1e3 * known.sigma, given=given)
        yield ParameterRow(name, "µm", in_um, _given_text(in_um), "", _significance(known))


def high_correlations(name: str, camera: CameraRecord, covariance: Covariance) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the observations hardly tell apart, the highest correlation first."""
    parameters = ["c", "x0", "y0", *parameter_names(camera.distortion.family)]
    block = covariance.of(Parameter.interior(name, parameter) for parameter in parameters)
    sigma = np.sqrt(np.maximum(np.diag(block), 0.0))
    free = np.flatnonzero(sigma > 0.0)
    correlation = block[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    pairs = [
        (parameters[free[i]], parameters[free[j]], float(correlation[i, j]))
        for i, j in zip(*np.triu_indices(len(free), 1), strict=True)
        if abs(correlation[i, j]) > HIGH_CORRELATION
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def group_sentences(tests: Sequence[GroupTestRecord]) -> list[str]:
    """Which parameters the data need together, as sentences."""
    return [
        f"{test.group[0].upper()}{test.group[1:]} ({', '.join(test.parameters)}) together: "
        + _tested(f"F = {significant(test.F, 3)}", test.p)
        for test in tests
    ]


def axes_sentence(camera: CameraRecord) -> str:
    """Of a family with axes of its own, which they are; empty of the others."""
    name, known = camera.distortion.family, camera.distortion.parameters
    shown = [each for each in family_of(name).y_down if each in known and known[each].value != 0.0]
    if not shown:
        return ""
    return (
        f"The values of {name} are OpenCV’s own and belong to its axes, x right and y down. With y up, as everywhere "
        f"else here, {', '.join(shown)} would have the other sign."
    )


def spoken_name(text: str, cameras: Collection[str]) -> str:
    """A quantity, by its text in adjustment.json, as this report calls it elsewhere: IO.RC 20.x0 is x₀′. With the
    camera's name, where there are several."""
    parameter = parameter_from_text(text, cameras)
    whose = f", {parameter.owner}" if len(cameras) > 1 else ""
    if parameter.kind == "interior":
        return _SYMBOLS.get(parameter.quantity, parameter.quantity) + whose
    if parameter.kind == "fiducial":
        return f"{parameter.quantity}′ of fiducial {parameter.id}{whose}"
    return parameter.label


def _given_text(quantity: Quantity) -> str:
    given = quantity.given
    if given is None:
        return "nothing"
    if math.isnan(given.sigma):
        return f"{significant(given.value, 6)}, free"
    if given.sigma == 0.0:
        return f"{significant(given.value, 8)}, fixed"
    return f"{significant(given.value, 6)} ± {significant(given.sigma, 2)}"


def _undetermined(sigma: float) -> str:
    return "not determined" if math.isnan(sigma) else "held at the given value" if sigma == 0.0 else ""


def _origin(quantity: Quantity, prior_scale: float) -> str:
    """How far the value moved from the given one, and whether data or prior determined it."""
    given, sigma = quantity.given, quantity.sigma
    if sentence := _undetermined(sigma):
        return sentence
    if given is None or not given.sigma > 0.0:
        return "determined by the observations alone"
    moved = f"moved by {fixed(1e3 * (quantity.value - given.value), 0, sign=True)} µm"
    if quantity.p is not None and quantity.p < LEVEL:
        moved += f", more than the given σ allows ({_p_value(quantity.p)})"
    left = sigma / (prior_scale * given.sigma)
    if left > MOSTLY_PRIOR:
        return f"{moved}; known from the given value, hardly from the observations"
    share = f"{100.0 * left**2:.0f} %" if left > 0.1 else "below 1 %"
    return f"{moved}; the given value's share is {share}"


def _significance(quantity: Quantity) -> str:
    if sentence := _undetermined(quantity.sigma):
        return sentence
    size = abs(quantity.value) / quantity.sigma
    return _tested(f"{size:.1f} σ" if size < 100.0 else f"{size:.0f} σ", quantity.p)


def _tested(found: str, p: float | None) -> str:
    if p is None or math.isnan(p):
        return f"not tested ({found})"
    return f"{'significant' if p < LEVEL else 'not significant'} ({found}, {_p_value(p)})"


def _p_value(p: float) -> str:
    return f"p = {p:.3f}" if p >= 0.001 else "p < 0.001"
