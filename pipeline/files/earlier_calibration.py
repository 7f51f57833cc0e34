"""Earlier calibration of a camera, `adjustment.json` with its covariance, as a correlated prior observation."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import INTERIOR_NAMES, Distortion, Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.observations import Calibration
from adjust.problem.parameter import Parameter
from pipeline.results.adjustment_file import ParameterCovariance, covariance_path, read_adjustment, read_covariance
from pipeline.results.adjustment_record import CameraRecord, DistortionRecord
from pipeline.text.toml_tables import Table
from pipeline.types import Array

_ALIKE = 1e-6  # relative difference of numbers that differ only by rounding
_TOGETHER = "Take both files as one adjustment wrote them."


@dataclass(frozen=True)
class EarlierCalibration:
    """A-posteriori values of a camera from an earlier adjustment.

    Attributes
    ----------
    path : of adjustment.json.
    parameters : its n estimated parameters; its camera may have another name than the present one.
    values, covariance : (n,) and (n, n) of these parameters.
    held : values of parameters that it held fixed.
    """

    path: Path
    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    held: Mapping[Parameter, float]

    def apply_to(self, camera: Camera) -> tuple[Camera, Calibration]:
        """The camera, with priors removed where the calibration replaces them, and the calibration for the network."""
        here = tuple(each._replace(owner=camera.name) for each in self.parameters)
        given = {(each.id, each.quantity): value for each, value in zip(here, self.values.tolist(), strict=True)}

        def prior(id: str, quantity: str, otherwise: Prior | None) -> Prior | None:
            return Prior(given[id, quantity], np.inf) if (id, quantity) in given else otherwise

        distortion = {}
        for name in parameter_names(camera.distortion.family):
            otherwise = camera.distortion.parameters.get(name, Prior(0.0, 0.0))
            distortion[name] = prior("", name, otherwise) or otherwise
        free = replace(
            camera,
            principal_distance_mm=prior("", "c", camera.principal_distance_mm),
            x0_mm=prior("", "x0", camera.x0_mm),
            y0_mm=prior("", "y0", camera.y0_mm),
            distortion=replace(camera.distortion, parameters=distortion),
            fiducials={
                id: Fiducial(prior(id, "x", mark.x_mm) or mark.x_mm, prior(id, "y", mark.y_mm) or mark.y_mm)
                for id, mark in camera.fiducials.items()
            },
        )
        return free, Calibration(here, self.values, self.covariance)


def read_calibration(path: Path, sigma: Table, fiducials_too: bool, camera: Camera) -> EarlierCalibration:
    """Read the earlier calibration that the table [sigma] of a camera file names.

    fiducials_too: whether it says where the fiducials are. Raises InputError where the file has no calibration of this
    camera, or another lens model.
    """
    content, covariance = read_adjustment(path), read_covariance(path)
    if not content.converged:
        raise sigma.error("calibration", f"{path} holds no calibration: its adjustment did not converge.")
    names = list(content.cameras)
    if camera.name not in names and len(names) != 1:
        raise sigma.error(
            "calibration",
            f"{path} holds the cameras {', '.join(names)}, but none with the name {camera.name!r} of this file.",
        )
    name = camera.name if camera.name in names else names[0]
    distortion = content.cameras[name].distortion
    _check_family(sigma, path, distortion, camera.distortion)
    earlier = _calibration(path, covariance, name, camera, fiducials_too)
    if not np.isfinite(earlier.values).all():
        raise sigma.error("calibration", f"{path} holds no interior orientation: it was made without object points.")
    _check_agreement(sigma, path, name, content.cameras[name], covariance)
    _check_held(sigma, earlier, camera)
    return earlier


def _check_agreement(
    sigma: Table, path: Path, name: str, camera: CameraRecord, covariance: ParameterCovariance
) -> None:
    """Check that JSON and covariance file agree on the camera; the network uses the latter."""
    stored = {Parameter.interior(name, key): quantity for key, quantity in camera.interior.items()}
    for id, mark in camera.fiducials.items():
        stored |= {Parameter.fiducial(name, id, "x"): mark.x_mm, Parameter.fiducial(name, id, "y"): mark.y_mm}
    listed = {each for each in covariance.parameters if each.kind in ("interior", "fiducial") and each.owner == name}
    for each in sorted(stored.keys() ^ listed):
        has, lacks = (path, covariance_path(path)) if each in stored else (covariance_path(path), path)
        raise sigma.error("calibration", f"{has} holds {each.label}, and {lacks.name} does not. {_TOGETHER}")
    parameters = tuple(stored)
    values = dict(zip(covariance.parameters, covariance.values.tolist(), strict=True))
    matrix = covariance.select(parameters)
    for each, variance in zip(parameters, np.diag(matrix).tolist(), strict=True):
        here = stored[each]
        for what, in_json, in_npz in (
            ("value", here.value, values[each]),
            ("standard deviation", here.sigma, math.sqrt(variance) if variance >= 0.0 else -math.inf),
        ):
            if math.isfinite(in_json) and not math.isclose(in_json, in_npz, rel_tol=_ALIKE):
                raise sigma.error(
                    "calibration",
                    f"{path} gives {each.label} the {what} {in_json:.10g}, and {covariance_path(path).name} "
                    f"{in_npz:.10g}. {_TOGETHER}",
                )
    if wrong := _no_covariance(parameters, matrix):
        raise sigma.error("calibration", f"{covariance_path(path)}: {wrong}. {_TOGETHER}")


def _no_covariance(parameters: Sequence[Parameter], matrix: Array) -> str:
    """Why a matrix is not a covariance matrix, and where; "" if it is one."""
    finite = np.isfinite(matrix)
    known = np.where(finite, matrix, 0.0)
    variance = np.clip(np.diag(known), 0.0, None)
    scale = np.sqrt(np.outer(variance, variance))
    for wrong, where in (
        ("is no finite number", ~finite),
        ("is not that of the exchanged pair", np.abs(known - known.T) > _ALIKE * scale),
        ("is larger than their standard deviations allow", np.abs(known) > (1.0 + _ALIKE) * scale),
    ):
        if where.any():
            i, j = np.argwhere(where)[0]
            return f"the covariance of {parameters[i].label} and {parameters[j].label} {wrong}"
    free = variance > 0.0
    if np.linalg.eigvalsh(matrix[np.ix_(free, free)] / scale[np.ix_(free, free)]).min(initial=0.0) < -_ALIKE:
        return "the matrix gives some combinations of the camera's quantities a negative variance"
    return ""


def _check_family(sigma: Table, path: Path, earlier: DistortionRecord, distortion: Distortion) -> None:
    here = {
        "family": distortion.family,
        "r0_mm": distortion.r0_mm,
        "decentering": distortion.decentering,
        "half_mm": distortion.half_mm,
    }
    for key, value in here.items():
        there = getattr(earlier, key)
        if there not in (value, None):
            raise sigma.error(
                "calibration",
                f"{path} was adjusted with {key} = {there!r}, and this camera has {value!r}. A calibration can be "
                "used with the distortion it was made with: make the two alike.",
            )


def _calibration(
    path: Path, covariance: ParameterCovariance, there: str, camera: Camera, fiducials: bool
) -> EarlierCalibration:
    parameters = [
        Parameter.interior(there, name) for name in (*INTERIOR_NAMES, *parameter_names(camera.distortion.family))
    ]
    if fiducials:
        parameters += [Parameter.fiducial(there, id, axis) for id in camera.fiducials for axis in "xy"]
    value = dict(zip(covariance.parameters, covariance.values.tolist(), strict=True))
    parameters = [each for each in parameters if each in value]
    matrix = covariance.select_larger(parameters)
    values = np.array([value[each] for each in parameters])
    free = np.diag(matrix) > 0.0
    return EarlierCalibration(
        path=path,
        parameters=tuple(each for each, is_free in zip(parameters, free, strict=True) if is_free),
        values=values[free],
        covariance=matrix[np.ix_(free, free)],
        held={key: value for key, value, is_free in zip(parameters, values.tolist(), free, strict=True) if not is_free},
    )


def _check_held(sigma: Table, earlier: EarlierCalibration, camera: Camera) -> None:
    """Check that parameters that the earlier adjustment held fixed are fixed at the same values here."""
    given: dict[tuple[str, str], Prior | None] = {  # by fiducial id and quantity
        ("", "c"): camera.principal_distance_mm,
        ("", "x0"): camera.x0_mm,
        ("", "y0"): camera.y0_mm,
        **{("", name): prior for name, prior in camera.distortion.parameters.items()},
    }
    for id, mark in camera.fiducials.items():
        given |= {(id, "x"): mark.x_mm, (id, "y"): mark.y_mm}
    for parameter, value in earlier.held.items():
        here = given.get((parameter.id, parameter.quantity), Prior(0.0, 0.0))
        if here is None or here.sigma > 0.0 or not np.isclose(here.value, value, rtol=1e-9, atol=0.0):
            raise sigma.error(
                "calibration",
                f"{earlier.path} held {parameter.label} fixed at {value:.10g}, and the rest of it is right for "
                "that value alone. Fix it there in this file, with a standard deviation of 0.",
            )
