"""Orientation of a near-vertical block from its common points: plane similarities, adjusted together."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from adjust.array_types import Array, Complex, Indices
from adjust.functional_model.rotation import rotation_from_angles
from adjust.initial_values.pose import Pose, Sight

FEWEST_SHARED = 2
REWEIGHTINGS = 6
HEIGHTS = np.geomspace(1.5, 300.0, 25)  # trial flying heights, in units of the range of the relief


def orient_vertical_block(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> dict[str, Pose]:
    """Orient a connected block as if all images were vertical.

    Parameters
    ----------
    known : coordinates (3,) by point, nan where unknown.

    Returns
    -------
    Poses by image name, good to a few degrees of tilt. Empty if only one point has planimetric control, or if fewer
    than half of the points have a known height and unknown X and Y: the method is meant for such points.

    Notes
    -----
    Each image is a plane similarity of the ground. One linear adjustment in complex numbers, which minimises the sum of
    distances, determines all similarities and unknown ground points; it is repeated with the image coordinates
    corrected for relief displacement. The scale gives the flying height above the mean of the known heights. Without
    planimetric control the axes of the first image are kept, and the scale is chosen to fit the relief displacements;
    over flat ground it is arbitrary.
    """
    images = _connected(sights, known)
    if not images:
        return {}
    rays = _Rays.from_images([sights[image] for image in images], known)
    nan = np.isnan(rays.known)
    planimetric = int((~nan[:, :2].any(axis=1)).sum())
    if (nan[:, 0] & nan[:, 1] & ~nan[:, 2]).mean() < 0.5 or planimetric == 1:
        return {}
    plane, _ = rays.similarities(np.ones(len(rays.z)))
    scale = 1.0 if planimetric else rays.scale_of_relief(plane)
    plane, _ = rays.similarities(rays.flattening(scale * plane))
    mean = float(np.nanmean(rays.known[rays.point, 2]))
    return {
        image: _pose(scale * turn, scale * shift, sights[image].principal_distance_mm, mean)
        for image, turn, shift in zip(images, plane[::2].tolist(), plane[1::2].tolist(), strict=True)
        if abs(turn) > 0
    }


def _connected(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> list[str]:
    """Select the connected group of images with most planimetric control (counted up to 2); of equals, the largest."""
    planimetric = {name for name, xyz in known.items() if not np.isnan(xyz[:2]).any()}
    points = {image: set(sight.points) for image, sight in sights.items()}
    left, groups = set(sights), []
    while left:
        group = {min(left)}
        while grown := {i for i in left - group if any(len(points[i] & points[j]) >= FEWEST_SHARED for j in group)}:
            group |= grown
        left -= group
        controlled = min(len(planimetric & set().union(*(points[i] for i in group))), 2)
        groups.append((controlled, len(group), sorted(group)))
    return max(groups, key=lambda each: each[:2])[2] if groups else []


@dataclass(frozen=True, eq=False)
class _Rays:
    """Image points of a block.

    Attributes
    ----------
    image, point : (n,) numbers of the image and of the object point.
    z : (n,) image coordinates x + iy, mm.
    c : (n,) principal distances, mm.
    known : (p, 3) coordinates of the object points, nan where unknown.
    """

    image: Indices
    point: Indices
    z: Complex
    c: Array
    known: Array

    @classmethod
    def from_images(cls, sights: list[Sight], known: Mapping[str, Array]) -> "_Rays":
        image = np.repeat(np.arange(len(sights)), [len(sight.points) for sight in sights])
        names, point = np.unique([name for sight in sights for name in sight.points], return_inverse=True)
        xy = np.concatenate([sight.xy_mm for sight in sights])
        c = np.array([sight.principal_distance_mm for sight in sights])[image]
        return cls(image, point, xy[:, 0] + 1j * xy[:, 1], c, np.array([known[name] for name in names]))

    @property
    def relief(self) -> Array:
        """(n,) heights of the points above the mean, 0 where unknown."""
        heights = self.known[self.point, 2]
        return np.asarray(np.nan_to_num(heights - np.nanmean(heights), nan=0.0))

    def scale_of_relief(self, plane: Complex) -> float:
        """Scale of the plane, in object units per unit, with the smallest residuals after relief displacement."""
        if np.ptp(self.relief) == 0.0:
            return 1.0
        scales = np.ptp(self.relief) / (np.abs(plane[2 * self.image]) * self.c).min() * HEIGHTS
        left = [self.similarities(self.flattening(s * plane))[1] for s in scales]
        return float(scales[int(np.argmin(left))])

    def flattening(self, plane: Complex) -> Array:
        """(n,) factors 1 - dZ / H that correct image coordinates for relief displacement."""
        return np.asarray(1.0 - self.relief / (np.abs(plane[2 * self.image]) * self.c))

    def similarities(self, flattening: Array) -> tuple[Complex, float]:
        """Adjust the similarities ground = a z + b of all images, minimising the sum of distances by reweighting.

        Returns a and b of each image in turn (2 images,), and the median residual. Without planimetric control the
        similarity of the first image is fixed: a datum of only two of its points would let all others shrink to a
        single point, where all distances vanish.
        """
        rows = np.arange(len(self.z))
        design = np.zeros((len(rows), 2 * int(self.image[-1]) + 2), dtype=np.complex128)
        design[rows, 2 * self.image], design[rows, 2 * self.image + 1] = self.z * flattening, 1.0
        given = (self.known[:, 0] + 1j * self.known[:, 1])[self.point]
        given[np.isnan(given)] = np.nan
        held = 0 if np.isfinite(given).any() else 2
        weights = np.ones(len(rows))
        for _ in range(REWEIGHTINGS):
            # Eliminate unknown ground points: each is the weighted mean of its images' transformed coordinates.
            share = weights / np.bincount(self.point, weights)[self.point]
            mean = np.asarray(sparse.csr_array((share, (self.point, rows))) @ design)
            reduced = design - np.where(np.isnan(given)[:, None], mean[self.point], 0.0)
            solution = np.zeros(design.shape[1], dtype=np.complex128)
            solution[:held] = np.array([1.0, 0.0])[:held]
            right = np.nan_to_num(given, nan=0.0) - reduced @ solution
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
