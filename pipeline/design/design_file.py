"""design.json: what is expected, what would help, and how it follows the quantities that were varied."""

import math
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.network import EXTERIOR_NAMES, Image
from adjust.problem.parameter import Parameter
from pipeline.design.alternatives import Alternative
from pipeline.design.expected import Expected, error_unit, rms
from pipeline.design.sweeps import Layouts, Swept, Variations
from pipeline.results.adjustment_content import ANGLES, DEG_PER_RAD
from pipeline.text.text_file import without_nan

Json = dict[str, Any]


def design_json(
    scene: Variations,
    expected: Expected,
    alone: Mapping[Parameter, float],
    layouts: Layouts,
    helpful: tuple[Alternative, ...],
    swept: tuple[tuple[Swept, str], ...],
) -> Json:
    """The contents of design.json; a standard deviation of null: the observations do not determine the quantity.

    alone: the standard deviations without given fiducials and interior orientation.
    swept: every sweep with the name of its picture.
    """
    adjustment = expected.plan.adjustment
    observations = expected.network.observations
    content = {
        "reseau": version("reseau"),
        "scene": str(scene.path),
        "sigma0": expected.plan.sigma0,
        "images_planned": len(expected.network.images),
        "points_planned": len(expected.network.points),
        "marks": {kind: observations.kind.count(kind) for kind in ("target", "fiducial")},
        "observations": adjustment.conditions,
        "unknowns": adjustment.unknowns,
        "redundancy": adjustment.redundancy,
        "singular": [
            {"parameters": [each.text for each in null.parameters], "cause": null.cause, "remedy": null.remedy}
            for null in expected.plan.singular
        ],
        "warnings": list(adjustment.warnings),
        "cameras": {expected.camera: _camera(expected)},
        "scanners": {
            scanner.name: {term: _quantity(expected, Parameter.scanner(scanner.name, term)) for term in scanner.terms}
            for scanner in expected.network.scanners
        },
        "photographs_alone": {parameter.text: sigma for parameter, sigma in alone.items()},
        "images": {image.name: _image(expected, image) for image in expected.network.images},
        "points": _points(expected),
        "point_summary": _point_summary(expected),
        "distances": [
            {
                "name": each.name,
                "sigma": expected.plan.sigma0 * each.sigma,
                "redundancy": each.redundancy,
                "detectable": expected.plan.sigma0 * each.detectable,
            }
            for each in adjustment.further
            if each.group == "distance"
        ],
        "reliability": _reliability(expected),
        "layouts": _layouts(layouts),
        "what_would_help": [
            {"change": one.change, "gain_percent": dict(one.gain_percent), "sigmas": dict(one.expected.camera_sigmas)}
            for one in helpful
        ],
        "sweeps": [_sweep(one, picture) for one, picture in swept],
    }
    return dict(without_nan(content))


def _camera(expected: Expected) -> Json:
    camera = expected.network.cameras[0]
    distortion: Json = {"family": camera.distortion.family, "r0_mm": camera.distortion.r0_mm}
    for parameter in parameter_names(camera.distortion.family):
        distortion[parameter] = _quantity(expected, Parameter.interior(camera.name, parameter))
    return {
        "principal_distance_mm": _quantity(expected, Parameter.interior(camera.name, "c")),
        "principal_point_mm": {axis: _quantity(expected, Parameter.interior(camera.name, f"{axis}0")) for axis in "xy"},
        "distortion": distortion,
        "fiducials": {
            id: {f"{axis}_mm": _quantity(expected, Parameter.fiducial(camera.name, id, axis)) for axis in "xy"}
            for id in camera.fiducials
        },
        "precision_at_radii": [
            {
                "radius_mm": at.radius_mm,
                "radial_um": at.radial_um,
                "tangential_um": at.tangential_um,
                "ray_um": at.ray_um,
            }
            for at in expected.curve
        ],
        "sigmas": dict(expected.camera_sigmas),
    }


def _image(expected: Expected, image: Image) -> Json:
    observations = expected.network.observations
    kinds = [kind for name, kind in zip(observations.image, observations.kind, strict=True) if name == image.name]
    transformation: Json = {"kind": image.transformation}
    for parameter in film_parameter_names(image.transformation):
        key, scale = (f"{parameter}_deg", DEG_PER_RAD) if parameter in ANGLES else (parameter, 1.0)
        transformation[key] = _quantity(expected, Parameter.film(image.name, parameter), scale)
    exterior = {}
    for element in EXTERIOR_NAMES:
        key, scale = (f"{element}_deg", DEG_PER_RAD) if element in ANGLES else (element, 1.0)
        exterior[key] = _quantity(expected, Parameter.exterior(image.name, element), scale)
    return {
        "targets": kinds.count("target"),
        "fiducials": kinds.count("fiducial"),
        "transformation": transformation,
        "exterior": exterior,
    }


def _points(expected: Expected) -> Json:
    observed = [
        point
        for point, kind in zip(expected.network.observations.point, expected.network.observations.kind, strict=True)
        if kind == "target"
    ]
    return {
        point.id: {axis: _quantity(expected, Parameter.point(point.id, axis)) for axis in "XYZ"}
        | {"images": observed.count(point.id)}
        for point in expected.network.points
    }


def _point_summary(expected: Expected) -> Json:
    """Over the points whose coordinate is not fixed and is determined; how many are not determined."""
    summary: Json = {}
    for axis, sigmas in zip("XYZ", expected.point_sigmas.T, strict=True):
        estimated = sigmas[(sigmas > 0.0) & np.isfinite(sigmas)]
        summary[axis] = {
            "rms": rms(estimated),
            "largest": float(estimated.max(initial=0.0)),
            "estimated": len(estimated),
            "undetermined": int(np.isinf(sigmas).sum()),
        }
    return summary


def _reliability(expected: Expected) -> Json:
    """null for a smallest error: nothing checks any of the group."""
    return {
        "groups": {
            one.group: {
                "coordinates": one.coordinates,
                "redundancy": one.redundancy,
                "smallest_error": {"median": one.median, "largest": one.largest, "unit": error_unit(one.group)},
                "unchecked": one.unchecked,
            }
            for one in expected.reliability.groups
        },
        "camera": [
            {"parameter": one.parameter.text, "effect_in_sigmas": one.in_sigmas, "error_in": one.cause}
            for one in expected.reliability.camera
        ],
    }


def _quantity(expected: Expected, parameter: Parameter, scale: float = 1.0) -> Json:
    return {"value": scale * expected.plan.adjustment.value(parameter), "sigma": scale * expected.plan.sigma(parameter)}


def _layouts(layouts: Layouts) -> Json:
    return {
        "count": layouts.count,
        "sigmas": {name: {"mean": layouts.mean[name], "spread": layouts.spread[name]} for name in layouts.mean},
    }


def _sweep(swept: Swept, picture: str) -> Json:
    slopes = {name: swept.slope(name) for name in swept.names}
    return {
        "quantity": swept.quantity,
        "picture": picture,
        "layouts": swept.steps[0].sigmas.count,
        "steps": [
            {
                "value": step.value,
                "points": step.points,
                "redundancy": step.redundancy,
                "null_directions": step.singular,
                "sigmas": dict(step.sigmas.mean),
                "spread": dict(step.sigmas.spread),
            }
            for step in swept.steps
        ],
        "log_log_slopes": {name: slope for name, slope in slopes.items() if not math.isnan(slope)},
    }
