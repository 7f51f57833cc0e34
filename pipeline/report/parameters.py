"""The table of a camera's parameters: value, standard deviation, what was given, and what that says."""

import math
from collections.abc import Collection, Mapping, Sequence
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
    """A row in words and numbers ready to print. effect: at the outermost target, in um."""

    symbol: str
    unit: str
    value: str
    sigma: str
    given: str
    effect: str
    meaning: str


def parameter_rows(name: str, camera: CameraRecord, prior_scale: float, radius_mm: float) -> list[ParameterRow]:
    """Principal distance, principal point and distortion. radius_mm: where the distortion's effect is stated;
    prior_scale: what the adjustment has multiplied given standard deviations by."""
    point, distortion = camera.principal_point_mm, camera.distortion
    interior = [("c", camera.principal_distance_mm), (_SYMBOLS["x0"], point.x), (_SYMBOLS["y0"], point.y)]
    family = distortion.family
    effects = largest_effects_um(lens(name, camera), radius_mm) if parameter_names(family) else {}
    rows = [_row(symbol, "mm", quantity, "", _origin(quantity, prior_scale)) for symbol, quantity in interior]
    for parameter in parameter_names(family):
        quantity = distortion.parameters.get(parameter)
        if quantity is not None and (quantity.value != 0.0 or quantity.sigma != 0.0):
            effect = _effect(quantity, effects[parameter])
            rows.append(_row(parameter, family_of(family).unit(parameter), quantity, effect, _significance(quantity)))
    return rows


def term_rows(terms: Mapping[str, Quantity]) -> list[ParameterRow]:
    """The terms of a scanner's bend, in um."""
    return [_row(name, "µm", _scale_to_um(quantity), "", _significance(quantity)) for name, quantity in terms.items()]


def _scale_to_um(quantity: Quantity) -> Quantity:
    given = quantity.given and GivenQuantity(1e3 * quantity.given.value, 1e3 * quantity.given.sigma)
    return replace(quantity, value=1e3 * quantity.value, sigma=1e3 * quantity.sigma, given=given)


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
        + _verdict(f"F = {significant(test.F, 3)}", test.p)
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


def _row(symbol: str, unit: str, quantity: Quantity, effect: str, meaning: str) -> ParameterRow:
    value, sigma = value_and_sigma(quantity.value, quantity.sigma)
    return ParameterRow(symbol, unit, value, sigma, _given_text(quantity), effect, meaning)


def _given_text(quantity: Quantity) -> str:
    given = quantity.given
    if given is None:
        return "nothing"
    if math.isnan(given.sigma):
        return f"{significant(given.value, 6)}, free"
    if given.sigma == 0.0:
        return f"{significant(given.value, 8)}, fixed"
    return f"{significant(given.value, 6)} ± {significant(given.sigma, 2)}"


def _origin(quantity: Quantity, prior_scale: float) -> str:
    """How far the value moved from the given one, and whether data or prior determined it."""
    given, sigma = quantity.given, quantity.sigma
    if math.isnan(sigma):
        return "not determined"
    if sigma == 0.0:
        return "held at the given value"
    if given is None or not given.sigma > 0.0:
        return "determined by the observations alone"
    moved = f"moved by {fixed(1e3 * (quantity.value - given.value), 0, sign=True)} µm"
    p = quantity.p
    if p is not None and p < LEVEL:
        moved += f", more than the given σ allows ({_p_value(p)})"
    left = sigma / (prior_scale * given.sigma)
    if left > MOSTLY_PRIOR:
        return f"{moved}; known from the given value, hardly from the observations"
    share = f"{100.0 * left**2:.0f} %" if left > 0.1 else "below 1 %"
    return f"{moved}; the given value's share is {share}"


def _significance(quantity: Quantity) -> str:
    if math.isnan(quantity.sigma):
        return "not determined"
    if quantity.sigma == 0.0:
        return "held at the given value"
    size = abs(quantity.value) / quantity.sigma
    return _verdict(f"{size:.1f} σ" if size < 100.0 else f"{size:.0f} σ", quantity.p)


def _verdict(found: str, p: float | None) -> str:
    if p is None or math.isnan(p):
        return f"not tested ({found})"
    return f"{'significant' if p < LEVEL else 'not significant'} ({found}, {_p_value(p)})"


def _p_value(p: float) -> str:
    return f"p = {p:.3f}" if p >= 0.001 else "p < 0.001"


def _effect(quantity: Quantity, um_per_unit: float) -> str:
    if not quantity.sigma > 0.0:
        return significant(um_per_unit * quantity.value, 3)
    return " ± ".join(value_and_sigma(um_per_unit * quantity.value, um_per_unit * quantity.sigma))
