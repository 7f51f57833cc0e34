"""Exterior orientations and unknown points, image after image: resection, intersection, and again."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adjust.errors import AdjustmentError
from adjust.intersection import intersect
from adjust.network import Exterior, Network, Prior
from adjust.resection import Pose, image_distances, resect, three_point_poses
from adjust.rotation import rotation_from_angles
from adjust.sight import Sight
from adjust.vertical_block import orient_vertical_block

Array = NDArray[np.float64]

SURE_RESECTION = 6  # points that make a resection trustworthy; with fewer it waits until nothing better comes
IMPLAUSIBLE = 0.05  # residuals, in principal distances, of a resection whose points cannot be what they are said to be
CLEARLY_WORSE = 5.0  # a given orientation whose residuals are this many times a resection's is set aside
WELL_DETERMINED = 1e-3  # determination (see intersect) from which an intersected point may orient further images


@dataclass
class _State:
    """What is oriented so far."""

    sights: Mapping[str, Sight]
    firm: Mapping[str, Array]  # coordinates (3,) with a standard deviation, nan where there is none
    rough: Mapping[str, Array]  # the same with mere approximations filled in
    poses: dict[str, Pose] = field(default_factory=dict)
    points: dict[str, Array] = field(default_factory=dict)  # intersected


def orient(network: Network, sights: Mapping[str, Sight]) -> tuple[dict[str, Pose], dict[str, Array]]:
    """Poses of all images and coordinates (3,) of all points that are seen or wholly known.

    Raises AdjustmentError for the image or point that cannot be found.
    """
    state = _State(sights, _coordinates(network, firm=True), _coordinates(network, firm=False))
    for image in network.images:
        if image.exterior is not None:
            state.poses[image.name] = _checked(image.exterior, state, image.name)
    _extend(state)
    if not state.poses:
        state.poses.update(orient_vertical_block(sights, state.firm))
        _extend(state)
    missing = sorted(name for name in sights if name not in state.poses)
    if missing:
        raise AdjustmentError(_why_not_oriented(state, missing[0]))
    return state.poses, _all_points(state)


def _coordinates(network: Network, firm: bool) -> dict[str, Array]:
    """What is known of every point (3,), nan where nothing is."""
    return {
        point.id: np.array([_value(prior, firm) for prior in (point.X, point.Y, point.Z)]) for point in network.points
    }


def _value(prior: Prior | None, firm: bool) -> float:
    return np.nan if prior is None or (firm and np.isinf(prior.sigma)) else prior.value


def _checked(exterior: Exterior, state: _State, image: str) -> Pose:
    """The given orientation, or a resection where known points contradict it and it is not held fixed."""
    given = Pose(rotation_from_angles(exterior.values[3:]), exterior.values[:3])
    xyz, xy_mm = _field(state.sights[image], state.firm)
    if (exterior.sigmas == 0).any() or len(xyz) < 4:
        return given
    found = _resected(state.sights[image], xyz, xy_mm)
    if found is None:
        return given
    c = state.sights[image].principal_distance_mm
    left_given = np.median(image_distances(given, xyz, xy_mm, c))
    left_found = np.median(image_distances(found, xyz, xy_mm, c))
    return found if left_given > CLEARLY_WORSE * max(left_found, state.sights[image].sigma_mm) else given


def _field(sight: Sight, coordinates: Mapping[str, Array]) -> tuple[Array, Array]:
    """The points (n, 3) of an image whose three coordinates are known, and where it sees them (n, 2)."""
    xyz = np.array([coordinates[name] for name in sight.points]).reshape(-1, 3)
    usable = ~np.isnan(xyz).any(axis=1)
    return xyz[usable], sight.xy_mm[usable]


def _resected(sight: Sight, xyz: Array, xy_mm: Array) -> Pose | None:
    """The pose by resection, seeded alike for every image so that the order of things does not matter."""
    c = sight.principal_distance_mm
    if len(xyz) == 3:
        poses = three_point_poses(xyz, xy_mm, c)
        return poses[0] if len(poses) == 1 else None
    resection = resect(xyz, xy_mm, c, np.random.default_rng(0), sight.sigma_mm)
    return None if resection is None or resection.sigma_mm > IMPLAUSIBLE * c else resection.pose


def _extend(state: _State) -> None:
    """Orient and intersect in turn until nothing more comes; the images with the surest points first."""
    while True:
        state.points = _intersected(state, WELL_DETERMINED)
        waiting = [name for name in sorted(state.sights) if name not in state.poses]
        for fewest in (SURE_RESECTION, 4, 3):
            new = {name: pose for name in waiting if (pose := _pose_of(state, name, fewest)) is not None}
            if new:
                break
        if not new:
            return
        state.poses.update(new)


def _pose_of(state: _State, image: str, fewest: int) -> Pose | None:
    """Resection from firm points where there are enough, else from all that have coordinates by now."""
    sight = state.sights[image]
    for coordinates in (state.firm, {**state.rough, **state.points}):
        xyz, xy_mm = _field(sight, coordinates)
        if len(xyz) >= fewest and (pose := _resected(sight, xyz, xy_mm)) is not None:
            return pose
    return None


def _intersected(state: _State, weakest: float) -> dict[str, Array]:
    """Coordinates (3,) of the points that the oriented images determine, given coordinates kept."""
    names = [name for name in sorted(state.firm) if np.isnan(state.firm[name]).any()]
    position = {name: i for i, name in enumerate(names)}
    rows = [
        (image, k, position[name])
        for image in sorted(state.poses)
        for k, name in enumerate(state.sights[image].points)
        if name in position
    ]
    if not rows:
        return {}
    directions = {image: state.sights[image].rays @ pose.rotation for image, pose in state.poses.items()}
    points, determination = intersect(
        np.array([state.poses[image].center for image, _, _ in rows]),
        np.array([directions[image][k] for image, k, _ in rows]),
        np.array([point for _, _, point in rows], dtype=np.intp),
        np.array([state.firm[name] for name in names]),
    )
    return {names[i]: points[i] for i in np.flatnonzero(determination > weakest)}


def _all_points(state: _State) -> dict[str, Array]:
    """Every point's coordinates: as known, else intersected, else as roughly given."""
    points = {**state.rough, **_intersected(state, 0.0)}
    seen_in = defaultdict(list)
    for image in sorted(state.sights):
        for name in state.sights[image].points:
            seen_in[name].append(image)
    for name in sorted(seen_in):
        if np.isnan(points[name]).any():
            raise AdjustmentError(_why_not_intersected(name, seen_in[name]))
    return {name: xyz for name, xyz in points.items() if not np.isnan(xyz).any()}


def _why_not_intersected(point: str, images: Sequence[str]) -> str:
    if len(images) == 1:
        return (
            f"point {point} is unknown and seen in image {images[0]} only; two images are needed to find it: "
            "measure it in another image, give its coordinates, or leave it out"
        )
    return (
        f"point {point} is unknown, and its rays from images {', '.join(images)} do not meet in front of the cameras: "
        "check its number in these images, or give approximate coordinates"
    )


def _why_not_oriented(state: _State, image: str) -> str:
    sight = state.sights[image]
    xyz, _ = _field(sight, {**state.rough, **state.points})
    remedy = f"measure more known points, or give the orientation of {image} (images.csv)"
    if len(xyz) < 3:
        return f"image {image} sees {len(xyz)} known points; resection needs 3, and 4 to be unique: {remedy}"
    if len(xyz) == 3:
        return (
            f"image {image} sees 3 known points, which leave several orientations or none; a fourth decides: {remedy}"
        )
    return (
        f"image {image} sees {len(xyz)} known points, but no orientation brings them where they were measured (or they "
        f"lie on one line): check the point numbers, the principal distance and the sign of y, or {remedy}"
    )
