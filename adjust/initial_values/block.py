"""A block of images being oriented: resection, intersection, and again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.sight import Sight
from adjust.initial_values.intersection import intersect
from adjust.initial_values.pose import KnownField, Pose
from adjust.initial_values.resection import resect_images

SURE_RESECTION = 6  # points that make a resection trustworthy; with fewer it waits until nothing better comes
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
        new: dict[str, Pose] = {}
        for fewest in (SURE_RESECTION, 4, 3):
            new = new or _resected(block, waiting, fewest)
        if not new:
            return
        block.poses.update(new)


def _resected(block: Block, images: Sequence[str], fewest: int) -> dict[str, Pose]:
    """The poses of those images whose points give one: of firm points where there are enough, else of all that have
    coordinates by now."""
    poses: dict[str, Pose] = {}
    for coordinates in (block.firm, {**block.rough, **block.points}):
        fields = {name: known_field(block.sights[name], coordinates) for name in images if name not in poses}
        enough = {name: field for name, field in fields.items() if len(field.xyz) >= fewest}
        found = resect_images(list(enough.values()), [block.sights[name].principal_distance_mm for name in enough])
        poses |= {name: pose for name, pose in zip(enough, found, strict=True) if pose is not None}
    return poses


def known_field(sight: Sight, coordinates: Mapping[str, Array]) -> KnownField:
    """The points of an image whose three coordinates are known."""
    xyz = np.array([coordinates[name] for name in sight.points]).reshape(-1, 3)
    usable = ~np.isnan(xyz).any(axis=1)
    return KnownField(xyz[usable], sight.xy_mm[usable], sight.sigma_mm)


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
