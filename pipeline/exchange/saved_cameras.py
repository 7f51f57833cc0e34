"""`reseau cameras --save`: write calibrated cameras as camera files, each with its calibration and covariance, as prior
knowledge for later projects.

Calibrations of one camera from several projects (archives) are combined by their covariances. Differences beyond these
are described by a variance component between archives, estimated for each quantity separately by the method of moments
(DerSimonian and Laird, 1986). It is added to the variances of each archive, and so
counts in its weight.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adjust.functional_model.lens import Prior
from adjust.problem.parameter import Parameter
from pipeline.archive.made_from import current_adjustment
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, camera_text, read_camera
from pipeline.files.camera_tables import Source
from pipeline.files.earlier_calibration import EarlierCalibration
from pipeline.files.mark_table import picture_writer
from pipeline.files.project_file import Project
from pipeline.results.adjustment_file import (
    ParameterCovariance,
    covariance_path,
    read_own_covariance,
    write_with_covariance,
)
from pipeline.results.adjustment_record import AdjustmentRecord, CameraRecord, FiducialRecord, Quantity
from pipeline.results.comparator_file import read_comparator
from pipeline.text.files import write_atomically
from pipeline.text.wording import counted, listed
from pipeline.types import Array

_ONE_CAMERA = ("interior", "fiducial")  # kinds of parameters that belong to a camera
_HEAD = "# Adjusted camera, saved by reseau"


@dataclass(frozen=True, eq=False)
class _Calibration:
    """A camera as adjusted in one project: its parameters with values (n,) and covariance (n, n)."""

    project: Project
    camera: CameraFile
    record: AdjustmentRecord
    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    frames: int
    scanners: frozenset[str]  # by name; those without one are each archive's own


@dataclass(frozen=True)
class SavedCamera:
    """A camera file that was written, and its source."""

    name: str
    path: Path
    source: Source

    def sentence(self) -> str:
        """Sentence that describes what was saved."""
        return f"{self.name}: {self.path}, {self.source.text}"


def save_cameras(projects: Sequence[Project], folder: Path) -> list[SavedCamera]:
    """Write every calibrated camera of adjusted projects into a folder. Cameras of the same name are one camera.

    Raises
    ------
    InputError : nothing is adjusted, an adjustment is stale, no camera is calibrated, the calibrations of one camera
        have different lens models, or a file of that name exists and was not saved by this command.
    """
    found: dict[str, list[_Calibration]] = {}
    for project in projects:
        for one in _calibrations(project):
            found.setdefault(one.camera.name, []).append(one)
    if not found:
        paths = ", ".join(str(project.adjustment_path) for project in projects)
        raise InputError(f"{paths}: no camera is calibrated there, for no object point was observed.")
    files = {name: folder / f"{own[0].camera.path.stem}.toml" for name, own in found.items()}
    repeated = [path.name for path in files.values() if list(files.values()).count(path) > 1]
    if repeated:
        raise InputError(f"several cameras have a file {repeated[0]}. Give their camera files names of their own.")
    for path in files.values():
        if path.exists() and not path.read_bytes().startswith(_HEAD.encode()):
            raise InputError(
                f"{path}: exists and was not written by `reseau cameras --save`. Name another folder with --out."
            )
        earlier = _calibration_path(path)
        if not path.exists() and any(each.exists() for each in (earlier, covariance_path(earlier))):
            raise InputError(f"{earlier}: exists, but no {path.name} to go with it. Name another folder with --out.")
    return [_save(own, files[name]) for name, own in found.items()]


def _calibration_path(path: Path) -> Path:
    return path.with_name(f"{path.stem}-calibration.json")


def _calibrations(project: Project) -> list[_Calibration]:
    path = project.adjustment_path
    record = current_adjustment(project, read_comparator(project.comparator, project.list_pitch_um))
    if record is None:
        raise InputError(f"{path}: there is no adjustment that converged. Run `reseau adjust {project.path}` first.")
    covariance = read_own_covariance(path)
    values = dict(zip(covariance.parameters, covariance.values.tolist(), strict=True))
    found = []
    for camera in project.cameras.values():
        if camera.name not in record.cameras or not record.cameras[camera.name].is_calibrated:
            continue
        own = tuple(one for one in values if one.kind in _ONE_CAMERA and one.owner == camera.name)
        images = record.camera_images(camera.name)
        frames = {record.images[image].part_of or image for image in images}
        given = project.given_images.scanner if project.given_images else {}
        scanners = frozenset(given.get(image) or f"of {project.path}" for image in images)
        numbers = np.array([values[one] for one in own])
        found.append(
            _Calibration(project, camera, record, own, numbers, covariance.select_larger(own), len(frames), scanners)
        )
    return found


def _save(calibrations: Sequence[_Calibration], path: Path) -> SavedCamera:
    first = calibrations[0]
    values, covariance, spread = _combine(calibrations)
    record = _replace_quantities(first, dict(zip(first.parameters, values.tolist(), strict=True)), covariance)
    frames = sum(one.frames for one in calibrations)
    scanners = len(frozenset[str]().union(*(one.scanners for one in calibrations)))
    archives = listed([one.project.title for one in calibrations])
    text = f"adjusted from {counted(frames, 'frame')} of {counted(scanners, 'scanner')} in {archives}"
    labels = {one.label_in_camera: value for one, value in spread.items()}
    source = Source(text=text, frames=frames, scanners=scanners, archives=len(calibrations), spread_mm=labels)
    earlier = _calibration_path(path)
    write_with_covariance(earlier, record, ParameterCovariance(first.parameters, values, covariance).arrays)
    camera = _adjusted_camera(first, record.cameras[first.camera.name], earlier, path, source)
    body = camera_text(camera, picture_writer(path.parent, f"{path.stem}-"))
    write_atomically(path, f"{_HEAD}: values, and in {earlier.name} their covariance.\n{body}")
    read_camera(path)  # raises if later projects could not read it
    return SavedCamera(first.camera.name, path, source)


def _combine(calibrations: Sequence[_Calibration]) -> tuple[Array, Array, Mapping[Parameter, float]]:
    """Weighted mean: values and covariance of the first one's parameters; by free parameter, sigma between archives."""
    first = calibrations[0]
    if len(calibrations) == 1:
        return first.values, first.covariance, {}
    orders = [_order(first, one) for one in calibrations]
    is_free = np.diag(first.covariance) > 0.0
    at = [order[is_free] for order in orders]
    own = [one.values[rows] for one, rows in zip(calibrations, at, strict=True)]
    cofactors = [one.covariance[np.ix_(rows, rows)] for one, rows in zip(calibrations, at, strict=True)]
    variances = _archive_variances(np.array(own), np.array([np.diag(matrix) for matrix in cofactors]))
    cofactors = [matrix + np.diag(variances) for matrix in cofactors]
    scale = np.sqrt(np.diag(cofactors[0]))
    normals = [np.linalg.inv(matrix / np.outer(scale, scale)) for matrix in cofactors]
    joint = np.linalg.inv(np.sum(normals, axis=0))
    means = scale * (joint @ np.sum([n @ (x / scale) for n, x in zip(normals, own, strict=True)], axis=0))
    values, covariance = first.values.copy(), first.covariance.copy()
    values[is_free] = means
    covariance[np.ix_(is_free, is_free)] = joint * np.outer(scale, scale)
    free = [one for one, free in zip(first.parameters, is_free.tolist(), strict=True) if free]
    return values, covariance, dict(zip(free, np.sqrt(variances).tolist(), strict=True))


def _archive_variances(values: Array, variances: Array) -> Array:
    """(n,) variances between archives, by the method of moments (DerSimonian and Laird), from (archives, n)."""
    weights = 1.0 / variances
    total = weights.sum(axis=0)
    mean = (weights * values).sum(axis=0) / total
    excess = (weights * (values - mean) ** 2).sum(axis=0) - (len(values) - 1)
    return np.asarray(np.maximum(excess / (total - (weights**2).sum(axis=0) / total), 0.0))


def _order(first: _Calibration, other: _Calibration) -> Array:
    """Indices of one calibration's parameters in another of the same camera. Raises InputError where they differ."""
    name = first.camera.name
    ours, theirs = first.record.cameras[name].distortion, other.record.cameras[name].distortion
    where = {one: at for at, one in enumerate(other.parameters)}
    alike = ours.settings() == theirs.settings() and where.keys() == set(first.parameters)
    order = np.array([where.get(one, 0) for one in first.parameters], dtype=int)
    fixed = [np.diag(one.covariance) > 0.0 for one in (first, other)]
    held = ~fixed[0] if alike else np.zeros(0, bool)
    if (
        not alike
        or (fixed[0] != fixed[1][order]).any()
        or not np.allclose(first.values[held], other.values[order][held], rtol=1e-9, atol=0.0)
    ):
        raise InputError(
            f"{other.project.adjustment_path}: the camera {name} has another lens model, other fiducials or other "
            f"fixed values than in {first.project.adjustment_path}. Adjust both with the same camera file."
        )
    return order


def _replace_quantities(one: _Calibration, values: Mapping[Parameter, float], covariance: Array) -> AdjustmentRecord:
    """The adjustment record with these values and covariances for its camera, without images, points and residuals."""
    name, record = one.camera.name, one.record
    sigmas = dict(zip(one.parameters, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))

    def changed(parameter: Parameter, quantity: Quantity) -> Quantity:
        return replace(quantity, value=values[parameter], sigma=sigmas[parameter]) if parameter in values else quantity

    camera = record.cameras[name]
    interior = {key: changed(Parameter.interior(name, key), each) for key, each in camera.interior.items()}
    point = replace(camera.principal_point_mm, x=interior["x0"], y=interior["y0"])
    lens = {key: interior[key] for key in camera.distortion.parameters}
    fiducials: dict[str, FiducialRecord] = {}
    for id, mark in camera.fiducials.items():
        x, y = (Parameter.fiducial(name, id, axis) for axis in "xy")
        rho = mark.rho
        if x in one.parameters and y in one.parameters:
            i, j = one.parameters.index(x), one.parameters.index(y)
            scale = math.sqrt(covariance[i, i] * covariance[j, j])
            rho = float(covariance[i, j] / scale) if scale else 0.0
        fiducials[id] = replace(mark, x_mm=changed(x, mark.x_mm), y_mm=changed(y, mark.y_mm), rho=rho)
    camera = replace(
        camera,
        principal_distance_mm=interior["c"],
        principal_point_mm=point,
        distortion=replace(camera.distortion, parameters=lens),
        fiducials=fiducials,
    )
    return replace(
        record, cameras={name: camera}, images={}, frames={}, points={}, residuals=(), suspects=(), correlations=()
    )


def _adjusted_camera(one: _Calibration, record: CameraRecord, earlier: Path, path: Path, source: Source) -> CameraFile:
    """The project's camera file with adjusted values; the calibration replaces their standard deviations."""
    camera, point = one.camera, record.principal_point_mm
    parameters = {
        name: Prior(record.distortion.parameters[name].value, prior.sigma)
        if name in record.distortion.parameters
        else prior
        for name, prior in camera.distortion.parameters.items()
    }
    fiducials = tuple(
        replace(each, xy_mm=record.fiducials[each.id].xy_mm) if each.id in record.fiducials else each
        for each in camera.fiducials
    )
    calibration = EarlierCalibration(earlier, one.parameters, one.values, one.covariance, {})
    return replace(
        camera,
        path=path,
        principal_distance_mm=record.principal_distance_mm.value,
        principal_point_mm=(point.x.value, point.y.value),
        distortion=replace(camera.distortion, parameters=parameters),
        fiducials=fiducials,
        calibration=calibration,
        clicks=None,
        source=source,
    )
