"""Values of a camera to cite, and the table of its parameters: value, sigma, prior, effect and significance."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.families import family as family_of
from adjust.functional_model.families import parameter_names
from adjust.problem.parameter import Parameter, parameter_from_text
from adjust.quality.significance import LEVEL
from pipeline.report.data import ReportData
from pipeline.report.lens import largest_effects_um
from pipeline.report.numbers import fixed, significant, value_and_sigma
from pipeline.results.adjustment_record import CameraRecord, GivenQuantity, GroupTestRecord, Quantity
from pipeline.results.image_unit import FILM_UNIT, ImageUnit, pixel_intrinsics
from pipeline.text.wording import capitalised
from pipeline.types import Array

INTERIOR_MEANING = {
    "c": "principal distance",
    "x0": "principal point",
    "y0": "principal point",
    "fx": "focal length, columns",
    "fy": "focal length, rows",
    "cx": "principal point, column",
    "cy": "principal point, row",
}
SYMBOLS = {"x0": "x₀′", "y0": "y₀′"}
MOSTLY_PRIOR = 0.9  # fraction of the prior sigma above which the observations have contributed little


@dataclass(frozen=True)
class CameraValue:
    """Calibration value. name: as in adjustment.json or OpenCV; sigma: standard deviation to use, 0 if fixed."""

    name: str
    value: float
    sigma: float
    unit: str

    @property
    def symbol(self) -> str:
        return SYMBOLS.get(self.name, self.name)

    @property
    def meaning(self) -> str:
        """Name in words; "" for distortion parameters."""
        return INTERIOR_MEANING.get(self.name, "")

    @property
    def is_focal(self) -> bool:
        return self.name in ("c", "fx", "fy")


def camera_values(data: ReportData, name: str) -> list[CameraValue]:
    """Interior orientation and distortion of a calibrated camera, without distortion parameters fixed at 0.

    The standard deviation is the larger of that of the adjustment and that by leaving out images, if computed.
    """
    assert data.adjustment is not None
    camera, unit = data.adjustment.cameras[name], data.unit_of_camera(name)
    known = {key: each for key, each in camera.interior.items() if each.value != 0.0 or each.sigma != 0.0}
    known = {key: camera.interior[key] for key in ("c", "x0", "y0")} | known
    keys = [Parameter.interior(name, key) for key in known]
    sigmas = np.array([each.sigma for each in known.values()])
    model = np.diag(sigmas**2) if data.covariance is None else data.covariance.select(keys)
    mm, family = {key: each.value for key, each in known.items()}, family_of(camera.distortion.family)
    if unit.is_pixel and family.y_down:
        values, by_mm = pixel_intrinsics(mm, 1.0 / unit.per_mm)
    else:
        scale = np.array([unit.per_mm if key in ("c", "x0", "y0") else 1.0 for key in mm])
        values, by_mm = dict(zip(mm, (scale * list(mm.values())).tolist(), strict=True)), np.diag(scale)
    sigma = _sigmas(by_mm, model) if np.isfinite(sigmas).all() else np.abs(by_mm) @ sigmas
    if data.covariance is not None and data.covariance.clusters is not None:
        sigma = np.maximum(sigma, _sigmas(by_mm, data.covariance.clusters.select(keys)))
    units = [unit.long_name if name in INTERIOR_MEANING else family.unit(name) for name in values]
    return list(map(CameraValue, values, values.values(), sigma.tolist(), units))


def _sigmas(by_mm: Array, covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diagonal(by_mm @ covariance @ by_mm.T), 0.0)))


@dataclass(frozen=True)
class ParameterRow:
    """Row of the table. given: prior; effect: displacement at the outermost target; meaning: whether the parameter is
    significant, or how far the observations determined it."""

    symbol: str
    unit: str
    quantity: Quantity
    given: str
    effect: str
    meaning: str


def parameter_rows(
    name: str, camera: CameraRecord, prior_scale: float, radius_mm: float, unit: ImageUnit = FILM_UNIT
) -> Iterator[ParameterRow]:
    """Yield rows of principal distance, principal point and distortion.

    Parameters
    ----------
    prior_scale : factor by which the adjustment scaled the given standard deviations.
    radius_mm : radius at which the effect of the distortion is stated.
    """
    family, names = family_of(camera.distortion.family), parameter_names(camera.distortion.family)
    for parameter, in_mm in list(camera.interior.items())[:3]:
        quantity, symbol = _convert_unit(in_mm, unit.per_mm), SYMBOLS.get(parameter, parameter)
        meaning = _origin(quantity, prior_scale, unit)
        yield ParameterRow(symbol, unit.long_name, quantity, _given_text(quantity), "", meaning)
    effects = largest_effects_um(camera.lens(), radius_mm) if names else {}
    for parameter, um_per_unit in effects.items():
        known = camera.distortion.parameters.get(parameter)
        if known is not None and (known.value != 0.0 or known.sigma != 0.0):
            effect = _convert_unit(known, um_per_unit * unit.per_um)
            made = significant(effect.value, 3)
            if known.sigma > 0.0:
                made = " ± ".join(value_and_sigma(effect.value, effect.sigma))
            yield ParameterRow(parameter, family.unit(parameter), known, _given_text(known), made, _significance(known))


def term_rows(terms: Mapping[str, Quantity]) -> Iterator[ParameterRow]:
    """Yield rows of the terms of a scanner's geometric error, µm."""
    for name, known in terms.items():
        in_um = _convert_unit(known, 1e3)
        yield ParameterRow(name, "µm", in_um, _given_text(in_um), "", _significance(known))


def _convert_unit(known: Quantity, factor: float) -> Quantity:
    """Convert a quantity to another unit."""
    given = known.given and GivenQuantity(factor * known.given.value, factor * known.given.sigma)
    return replace(known, value=factor * known.value, sigma=factor * known.sigma, given=given)


def group_sentences(tests: Sequence[GroupTestRecord]) -> list[str]:
    """State the significance tests of groups of parameters."""
    return [
        f"{capitalised(test.group)} ({', '.join(test.parameters)}) together: "
        + _test_text(f"F = {significant(test.F, 3)}", test.p)
        for test in tests
    ]


def axes_sentence(camera: CameraRecord) -> str:
    """State the axes of a distortion family that has its own; "" for others."""
    name, known = camera.distortion.family, camera.distortion.parameters
    shown = [each for each in family_of(name).y_down if each in known and known[each].value != 0.0]
    if not shown:
        return ""
    return (
        f"The values of {name} are OpenCV’s own and refer to its axes, x right and y down. With y up, as everywhere "
        f"else here, {', '.join(shown)} would have the other sign."
    )


def spoken_name(text: str, cameras: Collection[str]) -> str:
    """Name of a quantity in the report from its text in adjustment.json: IO.RC 20.x0 is x₀′. The camera's name is added
    if there are several."""
    parameter = parameter_from_text(text, cameras)
    whose = f", {parameter.owner}" if len(cameras) > 1 else ""
    if parameter.kind == "interior":
        return SYMBOLS.get(parameter.quantity, parameter.quantity) + whose
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


def _undetermined_text(sigma: float) -> str:
    return "not determined" if math.isnan(sigma) else "held at the given value" if sigma == 0.0 else ""


def _origin(quantity: Quantity, prior_scale: float, unit: ImageUnit) -> str:
    """State the change from the given value, and whether observations or prior determined the value."""
    given, sigma = quantity.given, quantity.sigma
    if sentence := _undetermined_text(sigma):
        return sentence
    if given is None or not given.sigma > 0.0:
        return "determined by the observations alone"
    moved_by = (quantity.value - given.value) * unit.per_um / unit.per_mm * 1e3
    moved = f"moved by {fixed(moved_by, 2 if unit.is_pixel else 0, sign=True)} {unit.short_name}"
    if quantity.p is not None and quantity.p < LEVEL:
        moved += f", more than the given σ allows ({_p_value(quantity.p)})"
    left = sigma / (prior_scale * given.sigma)
    if left > MOSTLY_PRIOR:
        return f"{moved}; known from the given value, hardly from the observations"
    share = f"{100.0 * left**2:.0f} %" if left > 0.1 else "below 1 %"
    return f"{moved}; the given value's share is {share}"


def _significance(quantity: Quantity) -> str:
    if sentence := _undetermined_text(quantity.sigma):
        return sentence
    size = abs(quantity.value) / quantity.sigma
    return _test_text(f"{size:.1f} σ" if size < 100.0 else f"{size:.0f} σ", quantity.p)


def _test_text(found: str, p: float | None) -> str:
    if p is None or math.isnan(p):
        return f"not tested ({found})"
    return f"{'significant' if p < LEVEL else 'not significant'} ({found}, {_p_value(p)})"


def _p_value(p: float) -> str:
    return f"p = {p:.3f}" if p >= 0.001 else "p < 0.001"
