"""Initial values for an adjustment, from the network alone: nobody has to supply approximations."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.projection import folded_over
from adjust.functional_model.rotation import angles_from_rotation, angles_near
from adjust.functional_model.sight import Sight, freed_sight
from adjust.functional_model.transformation import film_kind
from adjust.initial_values.fiducial_fit import fit_transformation
from adjust.initial_values.orientation import orient
from adjust.initial_values.principal_distance import KnownField, find_principal_distance
from adjust.initial_values.resection import Pose
from adjust.problem.network import Approximations, Camera, Image, Network
from adjust.validation import validate

Array = NDArray[np.float64]

MOST_FOLDED = 0.05  # part of an image's points that gross errors may put where the distortion has no image


def approximate(network: Network) -> Approximations:
    """Where the adjustment starts: film transformations, interior and exterior orientations, unknown object points.

    Film transformations from the fiducial marks; a principal distance nobody knows from resections of the known
    points; exterior orientations as given, or by resection (gross errors tolerated), image after image, with points
    intersected from the images already oriented; where too little is known to begin with, from a model of the images
    themselves. Independent of the order of images, points and observations. An image that shows fiducials alone gets
    its film transformation and nothing else.
    Raises AdjustmentError, naming the image, camera or point, where something cannot be found, and what would help.
    """
    validate(network)
    rows = _rows_by_image(network)
    fits = {image.name: _film_transformation(network, image, rows[image.name]) for image in network.images}
    frames = {image.name: _frame(network, image, rows[image.name], fits[image.name]) for image in network.images}
    interior = {
        camera.name: _interior(network, camera, frames)
        for camera in network.cameras
        if camera.name not in network.idle_cameras
    }
    sights = {
        image.name: _sight(network.camera_by_name[image.camera], frames[image.name], interior[image.camera])
        for image in network.images
        if image.name not in network.without_object
    }
    poses, points = orient(network, sights)
    return Approximations(
        interior=interior,
        exterior={image.name: _exterior(image, poses[image.name]) for image in network.images if image.name in poses},
        transformation={name: parameters for name, (parameters, _) in fits.items()},
        points=points,
        mirrored=frozenset(name for name, (_, mirrored) in fits.items() if mirrored),
    )


@dataclass(frozen=True)
class _Frame:
    """The object points of one image in the camera frame: ids in order, xy_mm (n, 2), their typical sigma."""

    points: tuple[str, ...]
    xy_mm: Array
    sigma_mm: float


def _rows_by_image(network: Network) -> dict[str, list[int]]:
    """The rows of each image's observations in the order of kind and point."""
    rows: dict[str, list[int]] = {image.name: [] for image in network.images}
    observations = network.observations
    for row, image in enumerate(observations.image):
        rows[image].append(row)
    for image in rows:
        rows[image].sort(key=lambda row: (observations.kind[row], observations.point[row]))
    return rows


def _film_transformation(network: Network, image: Image, rows: list[int]) -> tuple[Array, bool]:
    """Parameters and whether mirrored."""
    observations, given = network.observations, network.camera_by_name[image.camera].fiducials
    marks = [row for row in rows if observations.kind[row] == "fiducial"]
    camera_mm = np.array(
        [[mark.x_mm.value, mark.y_mm.value] for mark in (given[observations.point[row]] for row in marks)]
    )
    return fit_transformation(image.transformation, network.straight_xy_mm[marks], camera_mm.reshape(-1, 2))


def _frame(network: Network, image: Image, rows: list[int], fit: tuple[Array, bool]) -> _Frame:
    observations = network.observations
    parameters, mirrored = fit
    targets = [row for row in rows if observations.kind[row] != "fiducial"]
    variances = np.trace(observations.covariance_mm2[targets], axis1=1, axis2=2) / 2
    return _Frame(
        tuple(observations.point[row] for row in targets),
        film_kind(image.transformation, mirrored).apply(parameters, network.straight_xy_mm[targets]),
        float(np.sqrt(np.median(variances))) if targets else 0.0,
    )


def _interior(network: Network, camera: Camera, frames: Mapping[str, _Frame]) -> Array:
    """c, x0', y0' (3,) in mm."""
    x0, y0 = (
        center if prior is None else prior.value
        for prior, center in zip((camera.x0_mm, camera.y0_mm), camera.center_mm, strict=True)
    )
    if camera.principal_distance_mm is not None:
        return np.array([camera.principal_distance_mm.value, x0, y0])
    fields = [
        _known_field(network, frames[image.name], x0, y0)
        for image in sorted(network.images, key=lambda i: i.name)
        if image.camera == camera.name
    ]
    found = find_principal_distance(fields)
    if found is None:
        raise AdjustmentError(
            f"the principal distance of camera {camera.name} cannot be found from its images: they see too few known "
            "points, or only a plane parallel to the image. Give an approximate principal_distance_mm."
        )
    return np.array([found, x0, y0])


def _known_field(network: Network, frame: _Frame, x0: float, y0: float) -> KnownField:
    """The points of one image whose coordinates are all known."""
    known = [
        (i, [point.X.value, point.Y.value, point.Z.value])
        for i, point in enumerate(network.point_by_id[name] for name in frame.points)
        if point.X is not None and point.Y is not None and point.Z is not None
    ]
    xyz = np.array([coordinates for _, coordinates in known]).reshape(-1, 3)
    return KnownField(xyz, frame.xy_mm[[i for i, _ in known]] - [x0, y0], frame.sigma_mm)


def _sight(camera: Camera, frame: _Frame, interior: Array) -> Sight:
    """Freed of the distortion as it is known beforehand. Raises AdjustmentError where that folds the image over."""
    known = camera.distortion.parameters
    names = parameter_names(camera.distortion.family)
    parameters = np.array([known[name].value if name in known else 0.0 for name in names])
    folded = folded_over(camera.distortion, interior, parameters, frame.xy_mm)
    if folded.mean() > MOST_FOLDED:
        radius_mm = float(np.linalg.norm(frame.xy_mm[folded] - interior[1:], axis=1).min())
        values = ", ".join(f"{name} = {known[name].value:g}" for name in names if name in known and known[name].value)
        raise AdjustmentError(
            f"camera {camera.name}: the distortion that is given ({values}) folds the image over: from {radius_mm:.3g} "
            f"mm off the principal point on, what lies farther out would appear farther in, and {folded.sum()} of the "
            f"{len(folded)} points of an image were measured there. Correct the signs, the units or the family of "
            "these values, or begin with 0."
        )
    return freed_sight(frame.points, frame.xy_mm, frame.sigma_mm, interior, camera.distortion, parameters)


def _exterior(image: Image, pose: Pose) -> Array:
    """X0, Y0, Z0, omega, phi, kappa (6,); the angles as near as can be to those given."""
    if image.exterior is None:
        return np.concatenate([pose.center, angles_from_rotation(pose.rotation)])
    return np.concatenate([pose.center, angles_near(pose.rotation, image.exterior.values[3:])])
