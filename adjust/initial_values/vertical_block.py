"""A block of near-vertical frames from their common points alone: a chain of plane similarities."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from adjust.array_types import Array, Complex
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.sight import Sight
from adjust.initial_values.pose import Pose

FEWEST_SHARED = 2
REWEIGHTINGS = 6
HEIGHTS = np.geomspace(1.5, 300.0, 25)  # flying heights tried, in ranges of the relief


def orient_vertical_block(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> dict[str, Pose]:
    """Poses of the frames that hang together, as if all looked straight down.

    known: coordinates (3,) by point, nan where unknown. Every frame is a similarity of the ground: all similarities
    and unknown ground points are found in one linear adjustment of the sum of distances (complex numbers for the
    plane), repeated with the relief displacement taken off. The scale gives the flying height above the mean of the
    known heights. With no planimetry known the first frame's axes are kept, and the scale is that at which the relief
    displacements fit; over a flat field, where there are none, it is arbitrary. Empty where one point alone is known
    in planimetry, or where fewer than half of the points have a height and nothing else: that is the field such frames
    are flown over. A start within a few degrees of the vertical.
    """
    images = _connected(sights, known)
    if not images or not _heights_only(sights, images, known):
        return {}
    rows = [
        _Row(i, name, complex(*xy), sights[image].principal_distance_mm)
        for i, image in enumerate(images)
        for name, xy in zip(sights[image].points, sights[image].xy_mm, strict=True)
    ]
    planimetry = {row.point: complex(*known[row.point][:2]) for row in rows if not np.isnan(known[row.point][:2]).any()}
    if len(planimetry) == 1:
        return {}
    mean, relief = _relief(rows, known)
    plane, _ = _similarities(rows, planimetry, len(images), np.ones(len(rows)))
    scale = 1.0 if planimetry else _scale_of_relief(rows, plane, relief)
    flattened = _flattening(rows, scale * plane, relief)
    plane, _ = _similarities(rows, planimetry, len(images), flattened)
    return {
        image: _pose(scale * plane[2 * i], scale * plane[2 * i + 1], sights[image].principal_distance_mm, mean)
        for i, image in enumerate(images)
        if abs(plane[2 * i]) > 0
    }


@dataclass(frozen=True)
class _Row:
    """A point seen in a frame, by the frame's number: where (mm, complex), and the frame's principal distance."""

    image: int
    point: str
    z: complex
    c: float


def _connected(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> list[str]:
    """The group of frames, each sharing points with another, that sees most points of known X and Y; of alike, the
    largest.
    """
    planimetric = {name for name, xyz in known.items() if not np.isnan(xyz[:2]).any()}
    left, groups = set(sights), []
    while left:
        group = {min(left)}
        while grown := {i for i in left - group if any(_common_points(sights, i, j) >= FEWEST_SHARED for j in group)}:
            group |= grown
        left -= group
        controlled = min(len(planimetric & {name for i in group for name in sights[i].points}), 2)
        groups.append((controlled, len(group), sorted(group)))
    return max(groups, key=lambda each: each[:2])[2] if groups else []


def _heights_only(sights: Mapping[str, Sight], images: list[str], known: Mapping[str, Array]) -> bool:
    names = sorted({name for image in images for name in sights[image].points})
    nan = np.isnan([known[name] for name in names])
    return bool((nan[:, 0] & nan[:, 1] & ~nan[:, 2]).mean() >= 0.5)


def _common_points(sights: Mapping[str, Sight], first: str, second: str) -> int:
    return len(set(sights[first].points) & set(sights[second].points))


def _relief(rows: list[_Row], known: Mapping[str, Array]) -> tuple[float, Array]:
    """The mean of the known heights, and every row's height above it, 0 where unknown."""
    heights = np.array([known[row.point][2] for row in rows])
    mean = float(np.nanmean(heights))
    return mean, np.nan_to_num(heights - mean, nan=0.0)


def _scale_of_relief(rows: list[_Row], plane: Complex, relief: Array) -> float:
    """Object units a unit of the plane at which the relief displacements leave least."""
    if np.ptp(relief) == 0.0:
        return 1.0
    lowest = np.ptp(relief) / min(abs(plane[2 * row.image]) * row.c for row in rows)
    scales = lowest * HEIGHTS
    left = [_similarities(rows, {}, len(plane) // 2, _flattening(rows, s * plane, relief))[1] for s in scales]
    return float(scales[int(np.argmin(left))])


def _flattening(rows: list[_Row], similarities: Complex, relief: Array) -> Array:
    """What an image coordinate is multiplied by to be that of the point's foot at the mean height: 1 - dZ / H."""
    height = np.array([abs(similarities[2 * row.image]) * row.c for row in rows])
    return np.asarray(1.0 - relief / height)


def _similarities(
    rows: list[_Row], planimetry: Mapping[str, complex], images: int, flattening: Array
) -> tuple[Complex, float]:
    """Scale-and-turn and shift of every image in turn (2 images,): ground = a z + b; the median distance left.

    Where no planimetry is known, the first image keeps its own coordinates: held by two of its points alone, all others
    would shrink to one place, where their distances are none.
    """
    design = np.zeros((len(rows), 2 * images), dtype=np.complex128)
    for i, row in enumerate(rows):
        design[i, 2 * row.image : 2 * row.image + 2] = row.z * flattening[i], 1.0
    point = np.unique([row.point for row in rows], return_inverse=True)[1]
    given = np.array([planimetry.get(row.point, np.nan) for row in rows], complex)
    weights = np.ones(len(rows))
    for _ in range(REWEIGHTINGS):
        # An unknown ground point is eliminated: it is the weighted mean of what its frames say.
        share = weights / np.bincount(point, weights)[point]
        mean = np.asarray(sparse.csr_array((share, (point, np.arange(len(rows))))) @ design)
        reduced = design - np.where(np.isnan(given)[:, None], mean[point], 0.0)
        right = np.nan_to_num(given, nan=0.0)
        held = 0 if planimetry else 2
        solution = np.concatenate([np.array([1.0, 0.0], complex)[:held], np.zeros(2 * images - held, complex)])
        right -= reduced @ solution
        root, unknown = np.sqrt(weights), reduced[:, held:]
        scale = np.where((size := np.abs(unknown).max(axis=0)) > 0, size, 1.0)
        solution[held:] = np.linalg.lstsq(root[:, None] * unknown / scale, root * right)[0] / scale
        distance = np.abs(unknown @ solution[held:] - right)
        weights = 1.0 / np.maximum(distance, 0.1 * np.median(distance) + np.finfo(float).tiny)
        weights /= weights.max()
    return solution, float(np.median(distance))


def _pose(turn: complex, shift: complex, principal_distance_mm: float, height: float) -> Pose:
    rotation = rotation_from_angles(np.array([0.0, 0.0, np.angle(turn)]))
    return Pose(rotation, np.array([shift.real, shift.imag, height + abs(turn) * principal_distance_mm]))
