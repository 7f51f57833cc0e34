"""design.json: expected precision and reliability, improvements, and sweeps."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.network import EXTERIOR_NAMES, Image
from adjust.problem.observations import ObservationKind
from adjust.problem.parameter import Parameter
from pipeline.design.expected import Alternative, Expected, error_unit, rms
from pipeline.design.sweeps import Layouts, Swept
from pipeline.results.adjustment_content import ANGLES, DEG_PER_RAD

Content = dict[str, object]


@dataclass(frozen=True, eq=False)
class Design:
    """Result of a plan.

    alone: standard deviations without given fiducials and interior orientation; files: written files by a description:
    design.json first, then the plot of every sweep.
    """

    scene: Path
    expected: Expected
    alone: Mapping[Parameter, float]
    layouts: Layouts
    helpful: tuple[Alternative, ...]
    swept: tuple[Swept, ...]
    files: Mapping[str, Path]

    @property
    def has_findings(self) -> bool:
        """Whether some parameter is not estimable, or weakly determined."""
        return bool(self.expected.plan.singular or self.expected.plan.adjustment.warnings)

    def content(self) -> Content:
        """Content of design.json. A standard deviation of null: the observations do not determine the parameter."""
        expected, plan = self.expected, self.expected.plan
        pictures, observations = list(self.files.values())[1:], expected.network.observations
        counts = Counter(zip(observations.image, observations.kind, strict=True))
        return {
            "reseau": version("reseau"),
            "scene": str(self.scene),
            "sigma0": plan.sigma0,
            **_network(expected),
            "singular": [
                {"parameters": [each.text for each in null.parameters], "cause": null.cause, "remedy": null.remedy}
                for null in plan.singular
            ],
            "warnings": plan.adjustment.warnings,
            "cameras": {expected.camera: _camera(expected)},
            "scanners": {
                each.name: {term: _quantity(expected, Parameter.scanner(each.name, term)) for term in each.terms}
                for each in expected.network.scanners
            },
            "photographs_alone": {parameter.text: sigma for parameter, sigma in self.alone.items()},
            "images": {image.name: _image(expected, image, counts) for image in expected.network.images},
            "points": dict(_points(expected)),
            "point_summary": dict(_point_summary(expected)),
            "distances": _distances(expected),
            "reliability": _reliability(expected),
            "layouts": {
                "count": self.layouts.count,
                "sigmas": {
                    name: {"mean": mean, "spread": self.layouts.spread[name]}
                    for name, mean in self.layouts.mean.items()
                },
            },
            "what_would_help": [
                {"change": one.change, "gain_percent": one.gain_percent, "sigmas": one.expected.camera_sigmas}
                for one in self.helpful
            ],
            "sweeps": [_sweep(swept, path.name) for swept, path in zip(self.swept, pictures, strict=True)],
        }


def _network(expected: Expected) -> Content:
    """Sizes of the network."""
    network, adjustment = expected.network, expected.plan.adjustment
    return {
        "images_planned": len(network.images),
        "points_planned": len(network.points),
        "marks": {kind: network.observations.kind.count(kind) for kind in ("target", "fiducial")},
        "observations": adjustment.conditions,
        "unknowns": adjustment.unknowns,
        "redundancy": adjustment.redundancy,
    }


def _camera(expected: Expected) -> Content:
    camera = expected.network.cameras[0]
    name, family = camera.name, camera.distortion.family
    parameters = {each: _quantity(expected, Parameter.interior(name, each)) for each in parameter_names(family)}
    return {
        "principal_distance_mm": _quantity(expected, Parameter.interior(name, "c")),
        "principal_point_mm": {axis: _quantity(expected, Parameter.interior(name, f"{axis}0")) for axis in "xy"},
        "distortion": {"family": family, "r0_mm": camera.distortion.r0_mm, **parameters},
        "fiducials": {
            id: {f"{axis}_mm": _quantity(expected, Parameter.fiducial(name, id, axis)) for axis in "xy"}
            for id in camera.fiducials
        },
        "precision_at_radii": expected.curve,
        "sigmas": expected.camera_sigmas,
    }


def _image(expected: Expected, image: Image, counts: Mapping[tuple[str, ObservationKind], int]) -> Content:
    """Image; counts: of observations by image and kind."""
    film = {name: Parameter.film(image.name, name) for name in film_parameter_names(image.transformation)}
    exterior = {name: Parameter.exterior(image.name, name) for name in EXTERIOR_NAMES}
    return {
        "targets": counts[image.name, "target"],
        "fiducials": counts[image.name, "fiducial"],
        "transformation": {"kind": image.transformation, **_degree_quantities(expected, film)},
        "exterior": _degree_quantities(expected, exterior),
    }


def _degree_quantities(expected: Expected, parameters: Mapping[str, Parameter]) -> Content:
    """Quantities by name; angles in degrees, with names that say so."""
    return {
        f"{name}_deg" if name in ANGLES else name: _quantity(expected, each, DEG_PER_RAD if name in ANGLES else 1.0)
        for name, each in parameters.items()
    }


def _points(expected: Expected) -> Iterator[tuple[str, Content]]:
    observations = expected.network.observations
    pairs = zip(observations.point, observations.kind, strict=True)
    observed = Counter(point for point, kind in pairs if kind == "target")
    for point in expected.network.points:
        axes = {axis: _quantity(expected, Parameter.point(point.id, axis)) for axis in "XYZ"}
        yield point.id, {**axes, "images": observed[point.id]}


def _point_summary(expected: Expected) -> Iterator[tuple[str, Content]]:
    for axis, sigmas in zip("XYZ", expected.point_sigmas.T, strict=True):
        estimated = sigmas[(sigmas > 0.0) & np.isfinite(sigmas)]
        largest, undetermined = float(estimated.max(initial=0.0)), int(np.isinf(sigmas).sum())
        counts = {"estimated": len(estimated), "undetermined": undetermined}
        yield axis, {"rms": rms(estimated), "largest": largest, **counts}


def _distances(expected: Expected) -> list[Content]:
    sigma0 = expected.plan.sigma0
    return [
        {
            "name": each.name,
            "sigma": sigma0 * each.sigma,
            "redundancy": each.redundancy,
            "detectable": sigma0 * each.detectable,
        }
        for each in expected.plan.adjustment.further
        if each.group == "distance"
    ]


def _reliability(expected: Expected) -> Content:
    """Reliability by groups and of the camera; null for a smallest error: nothing checks the group."""
    groups = {
        one.group: {
            "coordinates": one.coordinates,
            "redundancy": one.redundancy,
            "smallest_error": {"median": one.median, "largest": one.largest, "unit": error_unit(one.group)},
            "unchecked": one.unchecked,
        }
        for one in expected.groups
    }
    camera = [
        {"parameter": one.parameter.text, "effect_in_sigmas": one.in_sigmas, "error_in": one.cause}
        for one in expected.outer_effects
    ]
    return {"groups": groups, "camera": camera}


def _quantity(expected: Expected, parameter: Parameter, scale: float = 1.0) -> Content:
    return {"value": scale * expected.plan.adjustment.value(parameter), "sigma": scale * expected.plan.sigma(parameter)}


def _sweep(swept: Swept, picture: str) -> Content:
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
                "sigmas": step.sigmas.mean,
                "spread": step.sigmas.spread,
            }
            for step in swept.steps
        ],
        "log_log_slopes": {name: slope for name, slope in slopes.items() if not math.isnan(slope)},
    }
