"""The table of a camera's parameters: value, standard deviation, what was given, and what that says."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from adjust.functional_model.families import family as family_of
from adjust.functional_model.families import parameter_names
from adjust.problem.parameter import Parameter, parameter_from_text
from adjust.quality.significance import LEVEL
from pipeline.report.data import Json
from pipeline.report.lens import largest_effects_um, lens
from pipeline.report.numbers import fixed, significant, value_and_sigma
from pipeline.results.adjustment_reader import Covariance

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


def parameter_rows(name: str, camera: Json, prior_scale: float, radius_mm: float) -> list[ParameterRow]:
    """Principal distance, principal point and distortion. radius_mm: where the distortion's effect is stated;
    prior_scale: what the adjustment has multiplied given standard deviations by."""
    point, distance = camera["principal_point_mm"], camera["principal_distance_mm"]
    interior = [("c", distance), (_SYMBOLS["x0"], point["x"]), (_SYMBOLS["y0"], point["y"])]
    family = camera["distortion"]["family"]
    effects = largest_effects_um(lens(name, camera), radius_mm) if parameter_names(family) else {}
    rows = [_row(symbol, "mm", quantity, "", _origin(quantity, prior_scale)) for symbol, quantity in interior]
    for parameter in parameter_names(family):
        quantity = camera["distortion"].get(parameter)
        if quantity is not None and (quantity["value"] != 0.0 or quantity["sigma"] != 0.0):
            effect = _effect(quantity, effects[parameter])
            rows.append(_row(parameter, family_of(family).unit(parameter), quantity, effect, _significance(quantity)))
    return rows


def term_rows(terms: Json) -> list[ParameterRow]:
    """The terms of a scanner's bend, in um."""
    return [_row(name, "µm", _in_um(quantity), "", _significance(quantity)) for name, quantity in terms.items()]


def _in_um(quantity: Json) -> Json:
    scaled = {key: None if quantity[key] is None else 1e3 * quantity[key] for key in ("value", "sigma")}
    given = quantity["given"]
    return scaled | {"given": {key: None if number is None else 1e3 * number for key, number in given.items()}}


def high_correlations(name: str, camera: Json, covariance: Covariance) -> list[tuple[str, str, float]]:
    """Pairs of parameters that the observations hardly tell apart, the highest correlation first."""
    parameters = ["c", "x0", "y0", *parameter_names(camera["distortion"]["family"])]
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


def group_sentences(camera: Json) -> list[str]:
    """Which parameters the data need together, as sentences."""
    return [
        f"{_group(test['group'])} ({', '.join(test['parameters'])}) together: "
        + _verdict(f"F = {significant(test['F'], 3)}", test["p"])
        for test in camera.get("significance", ())
    ]


def axes_sentence(camera: Json) -> str:
    """Of a family with axes of its own, which they are; empty of the others."""
    name = camera["distortion"]["family"]
    shown = [each for each in family_of(name).y_down if camera["distortion"].get(each, {"value": 0.0})["value"]]
    if not shown:
        return ""
    return (
        f"The values of {name} are OpenCV’s own and belong to its axes, x right and y down. With y up, as everywhere "
        f"else here, {', '.join(shown)} would have the other sign."
    )


def _group(name: str) -> str:
    return name[0].upper() + name[1:]


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


def _row(symbol: str, unit: str, quantity: Json, effect: str, meaning: str) -> ParameterRow:
    value, sigma = value_and_sigma(quantity["value"], quantity["sigma"])
    return ParameterRow(symbol, unit, value, sigma, _given(quantity), effect, meaning)


def _given(quantity: Json) -> str:
    given = quantity.get("given")
    if given is None:
        return "nothing"
    if given["sigma"] is None:
        return f"{significant(given['value'], 6)}, free"
    if given["sigma"] == 0.0:
        return f"{significant(given['value'], 8)}, fixed"
    return f"{significant(given['value'], 6)} ± {significant(given['sigma'], 2)}"


def _origin(quantity: Json, prior_scale: float) -> str:
    """How far the value moved from the given one, and whether data or prior determined it."""
    given, sigma = quantity.get("given"), quantity["sigma"]
    if sigma is None:
        return "not determined"
    if sigma == 0.0:
        return "held at the given value"
    if given is None or not given["sigma"]:
        return "determined by the observations alone"
    moved = f"moved by {fixed(1e3 * (quantity['value'] - given['value']), 0, sign=True)} µm"
    p = quantity.get("p")
    if p is not None and p < LEVEL:
        moved += f", more than the given σ allows ({_chance(p)})"
    left = sigma / (prior_scale * given["sigma"])
    if left > MOSTLY_PRIOR:
        return f"{moved}; known from the given value, hardly from the observations"
    share = f"{100.0 * left**2:.0f} %" if left > 0.1 else "below 1 %"
    return f"{moved}; the given value's share is {share}"


def _significance(quantity: Json) -> str:
    if quantity["sigma"] is None:
        return "not determined"
    if quantity["sigma"] == 0.0:
        return "held at the given value"
    size = abs(quantity["value"]) / quantity["sigma"]
    return _verdict(f"{size:.1f} σ" if size < 100.0 else f"{size:.0f} σ", quantity.get("p"))


def _verdict(found: str, p: float | None) -> str:
    if p is None:
        return f"not tested ({found})"
    return f"{'significant' if p < LEVEL else 'not significant'} ({found}, {_chance(p)})"


def _chance(p: float) -> str:
    return f"p = {p:.3f}" if p >= 0.001 else "p < 0.001"


def _effect(quantity: Json, um_per_unit: float) -> str:
    value, sigma = value_and_sigma(um_per_unit * quantity["value"], um_per_unit * (quantity["sigma"] or 0.0))
    return f"{value} ± {sigma}" if quantity["sigma"] else significant(um_per_unit * quantity["value"], 3)
