"""Distortion families: what stands between the ideal ray and the observed camera point.

Every family is one pair of equations between the observed point (x', y') and the ideal ray (u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - c h(u, v) - d(x', y') = 0

`torlegard`, `brown` and `juhl` correct the observed point by d (h is the ray itself), `opencv` distorts the ray by h
(d is 0). All arrays may be complex: the derivatives are tested by complex steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from adjust.network import Distortion, Family

Array = NDArray[np.float64]

PARAMETERS = MappingProxyType[Family, tuple[str, ...]](
    {
        "none": (),
        "torlegard": ("k3", "k5", "k7", "p1", "p2", "p3", "p4"),
        "brown": ("k1", "k2", "k3", "p1", "p2", "b1", "b2"),
        "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "b1"),
        "juhl": ("t1", "t2", "t3", "t4", "r1", "r2", "r3", "af", "sh"),
    }
)

MM_PER_DM = 100.0
UM_PER_MM = 1000.0
TANGENTIAL_POWER = 1.85  # Juhl: the tangential deformation grows with r to this power


@dataclass(frozen=True)
class ImageEquations:
    """F (n, 2) in mm and its derivatives, by the observed point xy (n, 2, 2), the ray (n, 2, 2), the interior
    orientation c, x0', y0' (n, 2, 3) and the family's parameters (n, 2, k).
    """

    value: Array
    by_xy: Array
    by_ray: Array
    by_interior: Array
    by_parameters: Array


def image_equations(
    distortion: Distortion, interior: Array, parameters: Array, xy_mm: Array, ray: Array
) -> ImageEquations:
    """The pair of equations of n points of one camera.

    interior (3,): c, x0', y0' in mm. parameters (k,): in the order of `PARAMETERS`. xy_mm (n, 2): observed camera
    coordinates. ray (n, 2): -U/W, -V/W.
    """
    c, principal_point = interior[0], interior[1:]
    imaged = _image(distortion, ray, parameters)
    correction = _correct(distortion, xy_mm, principal_point, parameters)
    by_interior = np.concatenate([-imaged.value[..., None], -np.eye(2) - correction.by_principal_point], axis=2)
    return ImageEquations(
        value=xy_mm - principal_point - c * imaged.value - correction.value,
        by_xy=np.eye(2) - correction.by_xy,
        by_ray=-c * imaged.by_ray,
        by_interior=by_interior,
        by_parameters=-c * imaged.by_parameters - correction.by_parameters,
    )


@dataclass(frozen=True)
class _Imaged:
    """h (n, 2), the image of the ray at c = 1, and its derivatives."""

    value: Array
    by_ray: Array
    by_parameters: Array


def _image(distortion: Distortion, ray: Array, parameters: Array) -> _Imaged:
    if distortion.family == "opencv":
        return _opencv(ray, parameters)
    count = len(ray)
    by_ray = np.broadcast_to(np.eye(2), (count, 2, 2))
    return _Imaged(ray, by_ray, np.zeros((count, 2, len(parameters))))


def _opencv(ray: Array, parameters: Array) -> _Imaged:
    """OpenCV's model in OpenCV's axes, y down: its documentation of camera calibration, "detailed description".

    b1 scales x: OpenCV's fx is c (1 + b1), its fy is c, both over the pitch.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, b1 = parameters
    x, y = ray[:, 0], -ray[:, 1]
    r2 = x**2 + y**2
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    above_by_r2 = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    radial_by_r2 = (above_by_r2 - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / below

    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
    xd_by_r2 = x * radial_by_r2 + p2 + s1 + 2 * s2 * r2
    yd_by_r2 = y * radial_by_r2 + p1 + s3 + 2 * s4 * r2
    by_point = _matrices(
        radial + 2 * p1 * y + 4 * p2 * x + 2 * x * xd_by_r2,
        2 * p1 * x + 2 * y * xd_by_r2,
        2 * p2 * y + 2 * x * yd_by_r2,
        radial + 4 * p1 * y + 2 * p2 * x + 2 * y * yd_by_r2,
    )
    by_radial = np.stack([x, y], axis=1) / below[:, None]
    zero = np.zeros_like(x)
    columns = [
        by_radial * r2[:, None],
        by_radial * r2[:, None] ** 2,
        np.stack([2 * x * y, r2 + 2 * y**2], axis=1),
        np.stack([r2 + 2 * x**2, 2 * x * y], axis=1),
        by_radial * r2[:, None] ** 3,
        *[-by_radial * (radial * r2**power)[:, None] for power in (1, 2, 3)],
        *[np.stack(pair, axis=1) for pair in ((r2, zero), (r2**2, zero), (zero, r2), (zero, r2**2))],
    ]
    # From OpenCV's axes to the camera's: the image's y, and the ray's, turn their signs.
    scale = np.array([1 + b1, -1.0])
    by_b1 = np.stack([xd, zero], axis=1)
    by_parameters = np.concatenate([np.stack(columns, axis=2) * scale[:, None], by_b1[..., None]], axis=2)
    by_ray = by_point * scale[:, None] * np.array([1.0, -1.0])
    return _Imaged(np.stack([xd, yd], axis=1) * scale, by_ray, by_parameters)


@dataclass(frozen=True)
class _Correction:
    """d (n, 2), which is subtracted from the observed point, and its derivatives."""

    value: Array
    by_xy: Array
    by_principal_point: Array
    by_parameters: Array


def _correct(distortion: Distortion, xy: Array, principal_point: Array, parameters: Array) -> _Correction:
    return _CORRECTIONS[distortion.family](distortion, xy, principal_point, parameters)


def _no_correction(_: Distortion, xy: Array, __: Array, parameters: Array) -> _Correction:
    count = len(xy)
    zeros = np.zeros((count, 2, 2))
    return _Correction(np.zeros((count, 2)), zeros, zeros, np.zeros((count, 2, len(parameters))))


def _torlegard(distortion: Distortion, xy: Array, principal_point: Array, parameters: Array) -> _Correction:
    """Torlegård's radial and decentering terms; `paper`: the decentering terms with x', y' as printed."""
    k3, k5, k7, p1, p2, p3, p4 = parameters
    reduced = xy - principal_point
    literal = distortion.decentering == "paper"
    x, y = (xy if literal else reduced).T
    r2 = (reduced**2).sum(axis=1)
    r02 = distortion.r0_mm**2
    rad = k3 * (r2 - r02) + k5 * (r2**2 - r02**2) + k7 * (r2**3 - r02**3)
    rad_by_r2 = k3 + r2 * (2 * k5 + 3 * r2 * k7)
    dec = 1 + r2 * (p3 + r2 * p4)
    dec_by_r2 = p3 + 2 * r2 * p4
    by_p1 = np.stack([r2 + 2 * x**2, 2 * x * y], axis=1)
    by_p2 = np.stack([2 * x * y, r2 + 2 * y**2], axis=1)
    plain = p1 * by_p1 + p2 * by_p2  # the decentering terms before dec

    direction = np.array([p1, p2])
    by_r2 = reduced * rad_by_r2[:, None] + direction * dec[:, None] + plain * dec_by_r2[:, None]
    by_reduced = rad[:, None, None] * np.eye(2) + by_r2[:, :, None] * 2 * reduced[:, None, :]
    by_decentering = dec[:, None, None] * _matrices(
        4 * p1 * x + 2 * p2 * y, 2 * p2 * x, 2 * p1 * y, 2 * p1 * x + 4 * p2 * y
    )
    radial = [reduced * (r2**power - r02**power)[:, None] for power in (1, 2, 3)]
    decentering = [by_p1 * dec[:, None], by_p2 * dec[:, None], plain * r2[:, None], plain * r2[:, None] ** 2]
    return _Correction(
        value=reduced * rad[:, None] + plain * dec[:, None],
        by_xy=by_reduced + by_decentering,
        by_principal_point=-by_reduced if literal else -by_reduced - by_decentering,
        by_parameters=np.stack([*radial, *decentering], axis=2),
    )


def _brown(_: Distortion, xy: Array, principal_point: Array, parameters: Array) -> _Correction:
    """Brown's terms of the observed point: Torlegård's with r0 = 0, and an affinity b1, b2 of x'."""
    b1, b2 = parameters[5:]
    torlegard = np.concatenate([parameters[:5], np.zeros(2)])
    common = _torlegard(Distortion("torlegard"), xy, principal_point, torlegard)
    reduced = xy - principal_point
    zero = np.zeros(len(xy))
    by_affinity = np.stack([np.stack([reduced[:, 0], zero], axis=1), np.stack([reduced[:, 1], zero], axis=1)], axis=2)
    affinity = np.array([[b1, b2], [0.0, 0.0]])
    return _Correction(
        value=common.value + reduced @ affinity.T,
        by_xy=common.by_xy + affinity,
        by_principal_point=common.by_principal_point - affinity,
        by_parameters=np.concatenate([common.by_parameters[..., :5], by_affinity], axis=2),
    )


def _juhl(distortion: Distortion, xy: Array, _: Array, parameters: Array) -> _Correction:
    """Juhl's tangential, radial and affine deformations about the camera's origin, in um at 1 dm."""
    t, (r1, r2, r3), (af, sh) = parameters[:4], parameters[4:7], parameters[7:]
    x, y = xy.T / MM_PER_DM
    radius = np.sqrt(x**2 + y**2 + np.finfo(float).tiny)  # the deformations and their derivatives vanish at 0
    r0 = distortion.r0_mm / MM_PER_DM
    cos, sin = x / radius, y / radius
    harmonics = np.stack([cos, sin, cos**2 - sin**2, 2 * cos * sin], axis=1)
    harmonics_by_angle = np.stack([-sin, cos, -4 * cos * sin, 2 * (cos**2 - sin**2)], axis=1)
    power = radius**TANGENTIAL_POWER
    across, along = np.stack([sin, -cos], axis=1), np.stack([cos, sin], axis=1)
    tangential = power * (harmonics @ t)
    tangential_by_radius = TANGENTIAL_POWER * power / radius * (harmonics @ t)
    tangential_over_radius_by_angle = power / radius * (harmonics_by_angle @ t)

    phase = np.pi * radius / r0
    radial_terms = np.stack([radius**3 - r0**2 * radius, radius * np.sin(phase) ** 2, np.sin(2 * phase)], axis=1)
    radial = radial_terms @ np.array([r1, r2, r3])
    radial_by_radius = (
        r1 * (3 * radius**2 - r0**2)
        + r2 * (np.sin(phase) ** 2 + phase * np.sin(2 * phase))
        + r3 * 2 * np.pi / r0 * np.cos(2 * phase)
    )
    # In polar coordinates: d/dxy = d/dradius along' - d/dangle across' / radius; the angle turns along to -across.
    gradient = tangential_by_radius[:, None] * along - tangential_over_radius_by_angle[:, None] * across
    by_xy = (
        across[:, :, None] * gradient[:, None, :]
        - (tangential / radius)[:, None, None] * along[:, :, None] * across[:, None, :]
        + radial_by_radius[:, None, None] * along[:, :, None] * along[:, None, :]
        + (radial / radius)[:, None, None] * across[:, :, None] * across[:, None, :]
    )
    affine = np.array([[0.0, 0.0], [-sh, -af]])
    zero = np.zeros_like(x)
    by_parameters = np.concatenate(
        [
            across[:, :, None] * (power[:, None] * harmonics)[:, None, :],
            along[:, :, None] * radial_terms[:, None, :],
            np.stack([np.stack([zero, -y], axis=1), np.stack([zero, -x], axis=1)], axis=2),
        ],
        axis=2,
    )
    added = across * tangential[:, None] + along * radial[:, None] + np.stack([x, y], axis=1) @ affine.T
    count = len(xy)
    return _Correction(
        value=-added / UM_PER_MM,
        by_xy=-(by_xy + affine) / (UM_PER_MM * MM_PER_DM),
        by_principal_point=np.zeros((count, 2, 2)),
        by_parameters=-by_parameters / UM_PER_MM,
    )


_CORRECTIONS: dict[Family, Callable[[Distortion, Array, Array, Array], _Correction]] = {
    "none": _no_correction,
    "torlegard": _torlegard,
    "brown": _brown,
    "opencv": _no_correction,
    "juhl": _juhl,
}


def _matrices(a11: Array, a12: Array, a21: Array, a22: Array) -> Array:
    """2x2 matrices (n, 2, 2) of their elements (n,)."""
    return np.stack([np.stack([a11, a12], axis=-1), np.stack([a21, a22], axis=-1)], axis=-2)
