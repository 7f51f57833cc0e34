"""`adjustment.json`, the result with everything it came from, and `adjustment.npz`, its full covariance."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.board import BOARD_NAMES
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.camera import Camera
from adjust.problem.images import adjusted_image
from adjust.problem.network import EXTERIOR_NAMES, Board, Image, ObjectPoint, Scanner
from adjust.problem.parameter import Kind, Parameter
from adjust.quality.contradiction import CalibrationTest
from adjust.quality.residuals import FurtherResidual
from adjust.quality.significance import SignificanceTest
from adjust.solution.result import Adjustment
from pipeline.provenance import of_file
from pipeline.results.adjustment_reader import FURTHER_NUMBERS, covariance_path
from pipeline.results.covariance_arrays import covariance_arrays, covariance_note
from pipeline.results.joined_frames import frames_json
from pipeline.results.reliability_json import point_tests, reliability_json, suspect_json
from pipeline.text.atomic import atomic_path
from pipeline.text.text_file import without_nan

Array = NDArray[np.float64]
Json = dict[str, Any]

ANGLES = ("omega", "phi", "kappa", "angle")
DEG_PER_RAD = 180.0 / math.pi
_AT_A_TIME = 10_000  # words of JSON


def write_adjustment(
    adjustment: Adjustment,
    path: Path,
    made_from: Mapping[str, str] | None = None,
    frames_mm: Mapping[str, tuple[float, float]] | None = None,
) -> None:
    """Write the result to `path` and its covariance beside it, each by way of a temporary file.

    Angles are in degrees in the JSON file and in rad in the covariance. sigma0_from: the redundancy of the observations
    that sigma0 comes from, whether standard deviations are a priori ones for want of these, and the groups of given
    values that take no part in sigma0 and are not multiplied by it (see `VarianceFactor`). Beyond the keys of the
    format every quantity has `given`, what was known of it beforehand, and every residual its place in the camera. A
    camera without an image and a point that nobody saw are not in it. Where no object point is seen, there is no
    exterior orientation (null) and no calibration (a camera's values are those given, their sigmas null). made_from:
    fingerprints of all that was adjusted; the covariance has that of the JSON file. Raises InputError where a file
    cannot be written. frames_mm: by camera the size of its frame.
    """
    content = adjustment_json(adjustment, frames_mm)
    content = {"reseau": content.pop("reseau"), "made_from": dict(made_from or {}), **content}
    # Both are whole before either takes its place: a covariance belongs to its adjustment.
    with atomic_path(covariance_path(path)) as covariance, atomic_path(path) as result:
        with result.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(_json_text(content))
        del content
        belongs_to, arrays = np.array(of_file(result)), covariance_arrays(adjustment)
        with covariance.open("wb") as data:
            np.savez_compressed(data, allow_pickle=False, fingerprint=belongs_to, **arrays)


def _json_text(content: Json) -> Iterator[str]:
    """Some of it at a time: as one text a large result takes several times as much memory as in the file."""
    parts = json.JSONEncoder(indent=1, ensure_ascii=False, allow_nan=False).iterencode(without_nan(content))
    while some := "".join(islice(parts, _AT_A_TIME)):
        yield some
    yield "\n"


def adjustment_json(adjustment: Adjustment, frames_mm: Mapping[str, tuple[float, float]] | None = None) -> Json:
    """The result as `adjustment.json` holds it; numbers that mean nothing are still NaN or infinite."""
    frames_mm = frames_mm or {}
    network = adjustment.network
    used = {image.camera for image in network.images}
    return {
        "reseau": version("reseau"),
        "converged": adjustment.converged,
        "termination": adjustment.termination,
        "iterations": adjustment.iterations,
        # A prior is an observation and a condition; a measured point is two of each.
        "observations": adjustment.conditions,
        "conditions": adjustment.conditions,
        "unknowns": adjustment.unknowns,
        "redundancy": adjustment.redundancy,
        "vpv": adjustment.vpv,
        "sigma0": adjustment.sigma0,
        "sigma0_from": {
            "redundancy": adjustment.variance.redundancy,
            "a_priori": adjustment.variance.is_a_priori,
            "left_out": [each._asdict() for each in adjustment.variance.left_out],
        },
        "covariance": covariance_note(adjustment),
        "singular": [
            {"parameters": _texts(null.parameters), "cause": null.cause, "remedy": null.remedy}
            for null in adjustment.singular
        ],
        "correlations": [
            {
                "parameters": _texts(each.parameters),
                "rho": each.rho,
                "cause": each.cause,
                "remedy": each.remedy,
            }
            for each in adjustment.correlations
        ],
        "warnings": list(adjustment.warnings),
        "notes": list(adjustment.notes),
        "left_out": dict(adjustment.left_out),
        "variance_factors": dict(adjustment.variance_factors),
        "variance_sigmas": dict(adjustment.variance_sigmas),
        "explanations": [
            {"kind": each.kind, "cause": each.cause, "remedy": each.remedy, "p": each.p, "sigma0": list(each.sigma0)}
            for each in adjustment.explanations
        ],
        "suspects": [suspect_json(suspect) for suspect in adjustment.suspects],
        "reliability": reliability_json(adjustment),
        "cameras": {
            camera.name: _camera(adjustment, camera) | _lens_known(adjustment, camera, frames_mm.get(camera.name))
            for camera in network.cameras
            if camera.name in used
        },
        "scanners": {scanner.name: _scanner(adjustment, scanner) for scanner in network.scanners},
        "boards": {board.name: _board(adjustment, board) for board in network.boards},
        "images": {image.name: _image(adjustment, image) for image in network.images},
        "frames": frames_json(adjustment),
        "points": {
            point.id: _point(adjustment, point)
            for point in network.points
            if adjustment.has(Parameter.point(point.id, "X"))
        },
        "residuals": _residuals(adjustment),
        "refraction": network.line_of_sight.refraction,
        "earth_curvature": network.line_of_sight.curvature,
        "distances": _distances(adjustment),
        "calibrations": _named(adjustment, "calibration"),
        "calibration_tests": [_contradiction(each) for each in adjustment.contradictions],
        "antennas": _named(adjustment, "antenna"),
        "groups": {
            name: {
                "sigma0": group.sigma0,
                "rms_x_um": group.rms_x_um,
                "rms_y_um": group.rms_y_um,
                "redundancy": group.redundancy,
            }
            for name, group in adjustment.groups.items()
        },
        "history": [step._asdict() for step in adjustment.history],
    }


def _texts(parameters: Sequence[Parameter]) -> list[str]:
    return [each.text for each in parameters]


def _camera(adjustment: Adjustment, camera: Camera) -> Json:
    idle = camera.name in adjustment.network.idle_cameras
    tests, together = _single_and_together(adjustment, "interior", camera.name)

    def quantity(name: str, given: Prior | None) -> Json:
        known = _quantity(adjustment, Parameter.interior(camera.name, name), given)
        return known | {"sigma": math.nan} if idle else known | tests.get(name, {})

    distortion = distortion_settings(camera.distortion)
    for parameter in parameter_names(camera.distortion.family):
        given = camera.distortion.parameters.get(parameter, Prior(0.0))
        distortion[parameter] = quantity(parameter, given)
    return {
        "principal_distance_mm": quantity("c", camera.principal_distance_mm),
        "principal_point_mm": {
            "x": quantity("x0", camera.x0_mm),
            "y": quantity("y0", camera.y0_mm),
        },
        "distortion": distortion,
        "significance": together,
        "fiducials": {
            id: {
                "x_mm": _quantity(adjustment, x, fiducial.x_mm),
                "y_mm": _quantity(adjustment, y, fiducial.y_mm),
                "rho": _correlation(adjustment, x, y),
            }
            for id, fiducial in camera.fiducials.items()
            for x, y in [[Parameter.fiducial(camera.name, id, axis) for axis in "xy"]]
        },
    }


def _lens_known(adjustment: Adjustment, camera: Camera, frame_mm: tuple[float, float] | None) -> Json:
    """How far out the lens is known; nothing where there is no solution, or no target."""
    reach = adjustment.lens_reach(camera, frame_mm)
    return {} if reach is None else {"lens_known": asdict(reach) | {"share": reach.share}}


def distortion_settings(distortion: Distortion) -> Json:
    """What stands beside a family's parameters: its name and settings, and its axes where they are not the camera's."""
    settings: Json = {"family": distortion.family, "r0_mm": distortion.r0_mm}
    if distortion.family == "torlegard":
        settings["decentering"] = distortion.decentering
    if family(distortion.family).needs == "half_mm":
        settings["half_mm"] = list(distortion.half_mm)
    if family(distortion.family).y_down:
        settings["axes"] = "x right, y down"
    return settings


def _scanner(adjustment: Adjustment, scanner: Scanner) -> Json:
    """How far the scanner puts a point beside its place, in mm, as products of Legendre polynomials over an extent."""
    terms, together = _terms(adjustment, "scanner", scanner.name, scanner.terms)
    extent = {"center_mm": list(scanner.center_mm), "half_mm": list(scanner.half_mm)}
    return {**extent, "terms": terms, "significance": together}


def _board(adjustment: Adjustment, board: Board) -> Json:
    """How far the board's middle stands off its plane, in object units, along each axis; points: how many it has."""
    bends = dict(zip(BOARD_NAMES, board.bends, strict=True))
    terms, together = _terms(adjustment, "board", board.name, bends)
    return {"points": len(board.places), **terms, "significance": together}


def _terms(adjustment: Adjustment, kind: Kind, owner: str, terms: Mapping[str, Prior]) -> tuple[Json, list[Json]]:
    """Every term with its test, and the test of all together."""
    tests, together = _single_and_together(adjustment, kind, owner)
    quantities = {
        name: _quantity(adjustment, Parameter(kind, owner, "", name), prior) | tests.get(name, {})
        for name, prior in terms.items()
    }
    return quantities, together


def _single_and_together(adjustment: Adjustment, kind: Kind, owner: str) -> tuple[dict[str, Json], list[Json]]:
    """Tests of significance: of single parameters by name, and of groups."""
    tests = adjustment.significance.get((kind, owner), ())
    single = {test.name: {"t": test.statistic, "p": test.p} for test in tests if not test.is_group}
    return single, [_group_test(test) for test in tests if test.is_group]


def _group_test(test: SignificanceTest) -> Json:
    return {"group": test.name, "parameters": list(test.parameters), "F": test.statistic, "p": test.p}


def _image(adjustment: Adjustment, image: Image) -> Json:
    transformation: Json = {"kind": image.transformation, "mirrored": image.name in adjustment.mirrored}
    for parameter in film_parameter_names(image.transformation):
        key, scale = (f"{parameter}_deg", DEG_PER_RAD) if parameter in ANGLES else (parameter, 1.0)
        transformation[key] = _quantity(adjustment, Parameter.film(image.name, parameter), None, scale)
    exterior: Json = {}
    for i, element in enumerate(EXTERIOR_NAMES):
        known = image.exterior
        of_antenna = known is not None and known.has_antenna and i < 3
        given = None if known is None or of_antenna else Prior(float(known.values[i]), float(known.sigmas[i]))
        of_element = Parameter.exterior(image.frame, element)
        if element in ANGLES:
            exterior[f"{element}_deg"] = _quantity(adjustment, of_element, given, DEG_PER_RAD)
        else:
            exterior[element] = _quantity(adjustment, of_element, given)
    if image.name in adjustment.network.unoriented:
        exterior = {key: quantity | {"sigma": math.nan} for key, quantity in exterior.items()}
    part = {"part_of": image.part_of} if image.part_of else {}
    return {
        "camera": image.camera,
        "scanner": image.scanner,
        **part,
        "transformation": transformation,
        "exterior": exterior,
    }


def _point(adjustment: Adjustment, point: ObjectPoint) -> Json:
    """Where it is, and what was given of it; a point of a bent board is off the place that is given."""
    given = {"X": point.X, "Y": point.Y, "Z": point.Z}
    place = {axis: _quantity(adjustment, Parameter.point(point.id, axis), prior) for axis, prior in given.items()}
    for board in adjustment.network.boards:
        if point.id in board.places:
            unknowns = [Parameter.point(point.id, axis) for axis in "XYZ"]
            unknowns += [Parameter.board(board.name, each) for each in BOARD_NAMES]
            by_unknowns = np.hstack([np.eye(3), board.lifted_by[point.id].T])
            values = by_unknowns @ adjustment.values_of(unknowns)
            variances = np.diag(by_unknowns @ adjustment.cofactor_of(unknowns) @ by_unknowns.T)
            for axis, value, variance in zip("XYZ", values, variances, strict=True):
                sigma = adjustment.sigma0 * math.sqrt(variance) if _has_solution(adjustment) else math.nan
                place[axis] |= {"value": float(value), "sigma": sigma}
    return place


def _quantity(adjustment: Adjustment, parameter: Parameter, given: Prior | None = None, scale: float = 1.0) -> Json:
    """Value and a-posteriori sigma, and what was given: null where nothing was, its sigma null where it was free."""
    quantity: Json = {"value": scale * adjustment.value(parameter), "sigma": scale * _sigma(adjustment, parameter)}
    if given is not None:
        quantity["given"] = {"value": scale * given.value, "sigma": scale * given.sigma}
    return quantity


def _sigma(adjustment: Adjustment, parameter: Parameter) -> float:
    """NaN where there is no solution: a zero would say that the quantity was fixed."""
    return adjustment.sigma(parameter) if _has_solution(adjustment) else math.nan


def _correlation(adjustment: Adjustment, x: Parameter, y: Parameter) -> float:
    q = adjustment.cofactor_of([x, y])
    product = q[0, 0] * q[1, 1]
    return float(q[0, 1] / math.sqrt(product)) if product > 0.0 and _has_solution(adjustment) else 0.0


def _has_solution(adjustment: Adjustment) -> bool:
    return adjustment.termination in ("converged", "iteration limit")


def _residuals(adjustment: Adjustment) -> list[Json]:
    observations, residuals = adjustment.network.observations, adjustment.residuals
    sigma_um = 1e3 * np.sqrt(np.diagonal(observations.covariance_mm2, axis1=1, axis2=2))
    v_um = 1e3 * residuals.v_mm
    weights = adjustment.weights if adjustment.weights.size else np.ones(len(observations))
    tests = point_tests(adjustment)
    camera_mm = _in_camera(adjustment, observations.xy_mm)
    v_camera_um = 1e3 * (_in_camera(adjustment, observations.xy_mm + residuals.v_mm) - camera_mm)
    return [
        {
            "image": observations.image[i],
            "point": observations.point[i],
            "kind": observations.kind[i],
            "vx_um": float(v_um[i, 0]),
            "vy_um": float(v_um[i, 1]),
            "redundancy_x": float(residuals.redundancy[i, 0]),
            "redundancy_y": float(residuals.redundancy[i, 1]),
            "w": float(_larger(residuals.w[i])),
            "w_x": float(residuals.w[i, 0]),
            "w_y": float(residuals.w[i, 1]),
            "weight": float(weights[i]),
            "sx_um": float(sigma_um[i, 0]),
            "sy_um": float(sigma_um[i, 1]),
            "x_mm": float(observations.xy_mm[i, 0]),
            "y_mm": float(observations.xy_mm[i, 1]),
            "camera_x_mm": float(camera_mm[i, 0]),
            "camera_y_mm": float(camera_mm[i, 1]),
            "camera_vx_um": float(v_camera_um[i, 0]),
            "camera_vy_um": float(v_camera_um[i, 1]),
            **tests[i],
        }
        for i in range(len(observations))
    ]


def _distances(adjustment: Adjustment) -> list[Json]:
    """In the unit of the object coordinates."""
    rows = (row for row in adjustment.further if row.group == "distance")
    return [
        {"from": given.start, "to": given.end, "distance": row.observed, **_further_numbers(row)}
        for given, row in zip(adjustment.network.distances, rows, strict=True)
    ]


def _named(adjustment: Adjustment, group: str) -> list[Json]:
    """One row a quantity of an earlier calibration (mm) or a coordinate of an antenna (object unit), as observed."""
    return [
        {"name": row.name, "value": row.observed, **_further_numbers(row)}
        for row in adjustment.further
        if row.group == group
    ]


def _contradiction(test: CalibrationTest) -> Json:
    """An earlier calibration as a whole: whether the images contradict it, and in what, the most telling first."""
    return {
        "F": test.statistic,
        "freedom": test.freedom,
        "p": test.probability,
        "direction": [
            {"name": test.parameters[i].text, "difference": float(test.difference[i]), "sigma": float(test.sigma[i])}
            for i in test.direction
        ],
    }


def _further_numbers(row: FurtherResidual) -> Json:
    return {name: getattr(row, name) for name in FURTHER_NUMBERS}


def _in_camera(adjustment: Adjustment, xy_mm: Array) -> Array:
    """Every observation's comparator coordinates (n, 2) in its own camera, mm."""
    images = np.array(adjustment.network.observations.image)
    camera_mm = np.empty_like(xy_mm)
    for name in sorted(set(images)):
        rows = images == name
        camera_mm[rows] = adjusted_image(adjustment, name).camera_from_comparator(xy_mm[rows])
    return camera_mm


def _larger(w: Array) -> float:
    """The standardised residual of the axis that fits worse; NaN where neither axis is checked."""
    known = w[np.isfinite(w)]
    return float(known[np.argmax(np.abs(known))]) if known.size else math.nan
