"""Distortion curves of a lens over the radius, with standard deviations from the full covariance."""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.families import family
from adjust.functional_model.lens import Lens

RADII = 80
DIRECTIONS = 36


@dataclass(frozen=True)
class Curves:
    """Distortion, in µm, over the radius (n,), in mm.

    radial: outward displacement, mean over all directions; asymmetric: largest displacement over all directions after
    removal of the radial part (decentering and affinity); each with its standard deviation.
    """

    radius_mm: Array
    radial_um: Array
    radial_sigma_um: Array
    asymmetric_um: Array
    asymmetric_sigma_um: Array


def is_defined_over_frame(lens: Lens) -> bool:
    """Whether the family is defined over the frame instead of the radius."""
    return family(lens.distortion.family).needs == "half_mm"


def distortion_curves(lens: Lens, largest_radius_mm: float) -> Curves:
    """Compute the curves from the principal point to a radius, or as far as the lens forms an image."""
    radius = np.linspace(0.0, largest_radius_mm, RADII)[1:]
    outward = directions()
    imaged = lens.displacement((radius[:, None, None] * outward).reshape(-1, 2)).imaged.reshape(len(radius), -1)
    radius = radius[np.logical_and.accumulate(imaged.all(axis=1))]
    radial, radial_by, rest, rest_by = radial_part(lens, radius)
    size = np.hypot(rest[..., 0], rest[..., 1])
    worst = size.argmax(axis=1)
    at = np.arange(len(radius))
    largest = size[at, worst]
    unit = rest[at, worst] / np.maximum(largest, 1e-12)[:, None]
    by_largest = np.einsum("rik,ri->rk", rest_by[at, worst], unit)
    return Curves(radius, radial, function_sigmas(lens, radial_by), largest, function_sigmas(lens, by_largest))


def radial_part(lens: Lens, radius_mm: Array) -> tuple[Array, Array, Array, Array]:
    """Mean outward displacement (r,), µm, at radii and its derivatives (r, 1 + k) by c and the parameters; remaining
    displacement (r, DIRECTIONS, 2) and its derivatives."""
    outward = directions()
    moved = lens.displacement((radius_mm[:, None, None] * outward).reshape(-1, 2))
    value = moved.value_um.reshape(len(radius_mm), DIRECTIONS, 2)
    by = moved.by_unknowns_um.reshape(len(radius_mm), DIRECTIONS, 2, -1)
    radial = np.einsum("rdi,di->r", value, outward) / DIRECTIONS
    radial_by = np.einsum("rdik,di->rk", by, outward) / DIRECTIONS
    rest = value - radial[:, None, None] * outward
    return radial, radial_by, rest, by - radial_by[:, None, None, :] * outward[:, :, None]


def displacement_cofactor(lens: Lens) -> Array:
    """(1 + k, 1 + k) covariance of c and the parameters, on which a displacement about the principal point depends."""
    return np.delete(np.delete(lens.covariance, [1, 2], axis=0), [1, 2], axis=1)


def function_sigmas(lens: Lens, by: Array) -> Array:
    """(n,) standard deviations of functions with derivatives (n, 1 + k)."""
    variance: Array = np.einsum("rk,kl,rl->r", by, displacement_cofactor(lens), by)
    return np.sqrt(np.maximum(variance, 0.0))


def directions() -> Array:
    angles = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)
