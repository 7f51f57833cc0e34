"""A block of near-vertical frames from their common points alone: a chain of plane similarities."""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adjust.resection import Pose
from adjust.rotation import rotation_from_angles
from adjust.sight import Sight

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FEWEST_SHARED = 2
REWEIGHTINGS = 6


def orient_vertical_block(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> dict[str, Pose]:
    """Poses of the frames that hang together with two points of known X and Y, as if all looked straight down.

    known: coordinates (3,) by point, nan where unknown. Every frame is a similarity of the ground: all similarities
    and unknown ground points are found in one linear adjustment of the sum of distances (complex numbers for the
    plane), the scale gives the flying height above the mean height of the known points. Empty where the datum is
    lacking, or where fewer than half of the points have a height and nothing else: that is the field such frames are
    flown over. Good to the relief displacement and the tilts: a start within a few degrees of the vertical.
    """
    images = _connected(sights, known)
    if not images or not _heights_only(sights, images, known):
        return {}
    column = {image: i for i, image in enumerate(images)}
    rows = [
        (column[image], name, complex(*xy))
        for image in images
        for name, xy in zip(sights[image].points, sights[image].xy_mm, strict=True)
    ]
    planimetry = {name: complex(*known[name][:2]) for name in known if not np.isnan(known[name][:2]).any()}
    similarities = _similarities(rows, planimetry, len(images))
    height = _mean_height(rows, known)
    return {
        image: _pose(similarities[2 * i], similarities[2 * i + 1], sights[image].principal_distance_mm, height)
        for image, i in column.items()
        if abs(similarities[2 * i]) > 0
    }


def _connected(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> list[str]:
    """The largest group of frames, each sharing points with another, that sees two points of known X and Y."""
    planimetric = {name for name, xyz in known.items() if not np.isnan(xyz[:2]).any()}
    left, groups = set(sights), []
    while left:
        group = {min(left)}
        while grown := {i for i in left - group if any(_shared(sights, i, j) >= FEWEST_SHARED for j in group)}:
            group |= grown
        left -= group
        if len(planimetric & {name for i in group for name in sights[i].points}) >= 2:
            groups.append(sorted(group))
    return max(groups, key=len, default=[])


def _heights_only(sights: Mapping[str, Sight], images: list[str], known: Mapping[str, Array]) -> bool:
    seen = sorted({name for image in images for name in sights[image].points})
    nan = np.isnan([known[name] for name in seen])
    return bool((nan[:, 0] & nan[:, 1] & ~nan[:, 2]).mean() >= 0.5)


def _shared(sights: Mapping[str, Sight], first: str, second: str) -> int:
    return len(set(sights[first].points) & set(sights[second].points))


def _similarities(rows: list[tuple[int, str, complex]], planimetry: Mapping[str, complex], images: int) -> Complex:
    """Scale-and-turn and shift of every image in turn (2 images,): ground = a z + b."""
    by_point = defaultdict(list)
    for row, (_, name, _) in enumerate(rows):
        by_point[name].append(row)
    design = np.zeros((len(rows), 2 * images), dtype=np.complex128)
    for row, (image, _, z) in enumerate(rows):
        design[row, 2 * image : 2 * image + 2] = z, 1.0
    weights = np.ones(len(rows))
    for _ in range(REWEIGHTINGS):
        reduced, right = design.copy(), np.zeros(len(rows), dtype=np.complex128)
        for name, seen in by_point.items():
            if name in planimetry:
                right[seen] = planimetry[name]
            else:  # eliminate the unknown ground point: the weighted mean of what its frames say
                reduced[seen] -= np.average(design[seen], axis=0, weights=weights[seen])
        root = np.sqrt(weights)
        scale = np.where((size := np.abs(reduced).max(axis=0)) > 0, size, 1.0)
        solution = np.linalg.lstsq(root[:, None] * reduced / scale, root * right)[0] / scale
        distance = np.abs(reduced @ solution - right)
        weights = 1.0 / np.maximum(distance, 0.1 * np.median(distance) + np.finfo(float).tiny)
        weights /= weights.max()
    return solution


def _mean_height(rows: list[tuple[int, str, complex]], known: Mapping[str, Array]) -> float:
    heights = [known[name][2] for name in sorted({name for _, name, _ in rows}) if not np.isnan(known[name][2])]
    return float(np.mean(heights)) if heights else 0.0


def _pose(turn: complex, shift: complex, principal_distance_mm: float, height: float) -> Pose:
    rotation = rotation_from_angles(np.array([0.0, 0.0, np.angle(turn)]))
    return Pose(rotation, np.array([shift.real, shift.imag, height + abs(turn) * principal_distance_mm]))
