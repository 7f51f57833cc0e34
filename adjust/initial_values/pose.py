"""Poses from known points: what an image shows of them, how well a pose explains it, and robust statistics of that."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from adjust.array_types import Array, Indices
from adjust.initial_values.pose_refinement import BEHIND, squared_residuals

Count = TypeVar("Count", int, Indices)

REJECTION = 13.8  # 0.1 % point of the squared residual's chi-square (2) distribution, in sigma²


@dataclass(frozen=True)
class Pose:
    """Where a camera stood: rotation (3, 3) object to camera, center (3,) in object units."""

    rotation: Array
    center: Array


@dataclass(frozen=True, eq=False)
class KnownField:
    """What one image shows of known points: xyz (n, 3), xy_mm (n, 2) about the principal point, their sigma in mm."""

    xyz: Array
    xy_mm: Array
    sigma_mm: float


def image_distances(pose: Pose, xyz: Array, xy_mm: Array, principal_distance_mm: float) -> Array:
    """Distances (n,) in mm from observed to projected points; inf behind the camera."""
    shift = -pose.rotation @ pose.center
    squared = squared_residuals(pose.rotation[None], shift[None], xyz, xy_mm / principal_distance_mm)[0]
    return residual_distances(squared, principal_distance_mm)


def residual_distances(squared: Array, principal_distance_mm: float) -> Array:
    return np.where(squared < BEHIND, principal_distance_mm * np.sqrt(squared), np.inf)


def trimmed_count(n: Count) -> Count:
    """The number of residuals that least trimmed squares keeps, for poses of three points."""
    return (n + 4) // 2


def robust_sigmas(squared: Array, counts: Indices) -> Array:
    """Standard deviations (k,) of a coordinate from the smallest half of chi-square (2) distributed squares (k, n).

    Of these, counts (k,) are there, the others are infinite.
    """
    half = trimmed_count(counts)
    left_out = 1 - half / counts
    with np.errstate(divide="ignore", invalid="ignore"):
        truncation = 1 + np.where(left_out > 0, left_out * np.log(left_out) / (1 - left_out), 0.0)
    sums = np.take_along_axis(np.cumsum(np.sort(squared, axis=1), axis=1), half[:, None] - 1, axis=1)[:, 0]
    return np.asarray(np.sqrt(sums / np.maximum(2 * half - 6, 1) / truncation))
