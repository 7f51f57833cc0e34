"""A block of images being oriented: resection, intersection, and again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.sight import Sight
from adjust.initial_values.dlt import KnownField, orient_together
from adjust.initial_values.intersection import intersect
from adjust.initial_values.resection import Pose, resect, three_point_poses

Array = NDArray[np.float64]

SURE_RESECTION = 6  # points that make a resection trustworthy; with fewer it waits until nothing better comes
IMPLAUSIBLE = 0.05  # residuals, in principal distances, of a resection whose points cannot be what they are said to be
WELL_DETERMINED = 1e-3  # determination (see intersect) from which an intersected point may orient further images


@dataclass
class Block:
    """What is known and what is oriented so far, by image and point name."""

    sights: Mapping[str, Sight]
    firm: Mapping[str, Array]  # coordinates (3,) with a standard deviation, nan where there is none
    rough: Mapping[str, Array]  # the same with mere approximations filled in
    poses: dict[str, Pose] = field(default_factory=dict)
    points: dict[str, Array] = field(default_factory=dict)  # intersected


def extend(block: Block) -> None:
    """Orient and intersect in turn until nothing more comes; the images with the surest points first."""
    while True:
        block.points = intersected(block, WELL_DETERMINED)
        waiting = [name for name in sorted(block.sights) if name not in block.poses]
        for fewest in (SURE_RESECTION, 4, 3):
            new = resected_together(block, waiting) if fewest == SURE_RESECTION else {}
            others = (name for name in waiting if name not in new)
            new |= {name: pose for name in others if (pose := _pose_of(block, name, fewest)) is not None}
            if new:
                break
        if not new:
            return
        block.poses.update(new)


def _pose_of(block: Block, image: str, fewest: int) -> Pose | None:
    """Resection from firm points where there are enough, else from all that have coordinates by now."""
    sight = block.sights[image]
    for coordinates in (block.firm, {**block.rough, **block.points}):
        xyz, xy_mm = known_field(sight, coordinates)
        if len(xyz) >= fewest and (pose := resected(sight, xyz, xy_mm)) is not None:
            return pose
    return None


def resected(sight: Sight, xyz: Array, xy_mm: Array) -> Pose | None:
    """The pose by resection, seeded alike for every image so that the order of things does not matter."""
    c = sight.principal_distance_mm
    if len(xyz) == 3:
        poses = three_point_poses(xyz, xy_mm, c)
        return poses[0] if len(poses) == 1 else None
    resection = resect(xyz, xy_mm, c, np.random.default_rng(0), sight.sigma_mm)
    return None if resection is None or resection.sigma_mm > IMPLAUSIBLE * c else resection.pose


def resected_together(block: Block, images: Sequence[str]) -> dict[str, Pose]:
    """The poses of those images whose points agree on one: the firm ones where these are enough."""
    fields = {}
    coordinates = {**block.rough, **block.points}
    for name in images:
        sight = block.sights[name]
        xyz, xy_mm = known_field(sight, block.firm)
        if len(xyz) < SURE_RESECTION:
            xyz, xy_mm = known_field(sight, coordinates)
        if len(xyz) >= SURE_RESECTION:
            fields[name] = KnownField(xyz, xy_mm, sight.sigma_mm)
    together = orient_together(list(fields.values()), [block.sights[name].principal_distance_mm for name in fields])
    return {name: pose for name, pose in zip(fields, together, strict=True) if pose is not None}


def known_field(sight: Sight, coordinates: Mapping[str, Array]) -> tuple[Array, Array]:
    """The points (n, 3) of an image whose three coordinates are known, and where it sees them (n, 2)."""
    xyz = np.array([coordinates[name] for name in sight.points]).reshape(-1, 3)
    usable = ~np.isnan(xyz).any(axis=1)
    return xyz[usable], sight.xy_mm[usable]


def intersected(block: Block, weakest: float) -> dict[str, Array]:
    """Coordinates (3,) of the points that the oriented images determine, given coordinates kept."""
    names = [name for name in sorted(block.firm) if np.isnan(block.firm[name]).any()]
    position = {name: i for i, name in enumerate(names)}
    rows = [
        (image, k, position[name])
        for image in sorted(block.poses)
        for k, name in enumerate(block.sights[image].points)
        if name in position
    ]
    if not rows:
        return {}
    directions = {image: block.sights[image].rays @ pose.rotation for image, pose in block.poses.items()}
    points, determination = intersect(
        np.array([block.poses[image].center for image, _, _ in rows]),
        np.array([directions[image][k] for image, k, _ in rows]),
        np.array([point for _, _, point in rows], dtype=np.intp),
        np.array([block.firm[name] for name in names]),
    )
    return {names[i]: points[i] for i in np.flatnonzero(determination > weakest)}
