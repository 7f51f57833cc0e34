"""Distortion models by physical cause: radial, decentering, affine and tangential, in the forms of several programs.

Torlegård's and Brown's corrections are subtracted from the observed point, Fraser's are added to it, Luhmann's are
added to the ideal point.
"""

from dataclasses import replace

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.correction import Correction, Settings
from adjust.linear_algebra.small_matrices import matrices, vectors

TORLEGARD_NAMES = ("k3", "k5", "k7", "p1", "p2", "p3", "p4")
BROWN_NAMES = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
AICON_NAMES = ("a1", "a2", "a3", "b1", "b2", "c1", "c2")
TORLEGARD_UNITS = ("mm⁻²", "mm⁻⁴", "mm⁻⁶", "mm⁻¹", "mm⁻¹", "mm⁻²", "mm⁻⁴")
BROWN_UNITS = (*TORLEGARD_UNITS[:5], "–", "–")
TORLEGARD_GROUPS = (("radial", TORLEGARD_NAMES[:3]), ("decentering", TORLEGARD_NAMES[3:5]))
BROWN_GROUPS = (("radial", BROWN_NAMES[:3]), ("decentering", BROWN_NAMES[3:5]), ("affinity", BROWN_NAMES[5:]))
AICON_GROUPS = (("radial", AICON_NAMES[:3]), ("decentering", AICON_NAMES[3:5]), ("affinity", AICON_NAMES[5:]))


def torlegard(settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Torlegård's radial and decentering terms. decentering "paper": with x', y' as printed."""
    return _radial_and_decentering(xy, principal_point, parameters, settings.r0_mm, settings.decentering == "paper")


def brown(_: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Brown's correction of the observed point: Torlegård's with r0 = 0, and affinity b1 and shear b2 of x'."""
    return _affine_correction(xy, principal_point, parameters, 0.0)


def australis(_: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Fraser's correction, added to the observed point: Brown's with opposite sign.

    Source: C. S. Fraser, Digital camera self-calibration, ISPRS Journal 52 (1997), the model of Australis and iWitness.
    """
    at = _affine_correction(xy, principal_point, -parameters, 0.0)
    return replace(at, parameter_jacobian=-at.parameter_jacobian)


def aicon(settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Balanced radial distortion (second zero at r0), decentering, affinity c1 and shear c2 of x'; of the ideal point.

    Sources: T. Luhmann, S. Robson, S. Kyle, J. Boehm, Close-Range Photogrammetry and 3D Imaging, the standard
    interior orientation; AICON's .ior files (A1 to A3, R0, B1, B2, C1, C2) as JAICOV's `IORFileReader` reads them, and
    the distortion models in its `bundle.derivation`, which add all terms to x0 - c U/W.
    """
    return _affine_correction(xy, principal_point, parameters, settings.r0_mm)


def _affine_correction(xy: Array, principal_point: Array, parameters: Array, r0_mm: float) -> Correction:
    """Three radial terms, two decentering terms, affinity and shear of x'."""
    stretch, shear = parameters[5:]
    whole = np.concatenate([parameters[:5], np.zeros(2)])
    common = _radial_and_decentering(xy, principal_point, whole, r0_mm, False)
    reduced = xy - principal_point
    zero = np.zeros(len(xy))
    by_affinity = matrices((reduced[:, 0], reduced[:, 1]), (zero, zero))
    affinity = np.array([[stretch, shear], [0.0, 0.0]])
    return Correction(
        value=common.value + reduced @ affinity.T,
        xy_jacobian=common.xy_jacobian + affinity,
        by_principal_point=common.by_principal_point - affinity,
        parameter_jacobian=np.concatenate([common.parameter_jacobian[..., :5], by_affinity], axis=2),
    )


def _radial_and_decentering(
    xy: Array, principal_point: Array, parameters: Array, r0_mm: float, literal: bool
) -> Correction:
    """Radial and decentering terms. literal: decentering terms with x', y' not reduced to the principal point."""
    k3, k5, k7, p1, p2, p3, p4 = parameters
    reduced = xy - principal_point
    x, y = (xy if literal else reduced).T
    r2 = (reduced**2).sum(axis=1)
    r02 = r0_mm**2
    rad = k3 * (r2 - r02) + k5 * (r2**2 - r02**2) + k7 * (r2**3 - r02**3)
    rad_by_r2 = k3 + r2 * (2 * k5 + 3 * r2 * k7)
    dec = 1 + r2 * (p3 + r2 * p4)
    dec_by_r2 = p3 + 2 * r2 * p4
    by_p1 = vectors(r2 + 2 * x**2, 2 * x * y)
    by_p2 = vectors(2 * x * y, r2 + 2 * y**2)
    plain = p1 * by_p1 + p2 * by_p2  # the decentering terms before dec

    direction = np.array([p1, p2])
    by_r2 = reduced * rad_by_r2[:, None] + direction * dec[:, None] + plain * dec_by_r2[:, None]
    by_reduced = rad[:, None, None] * np.eye(2) + by_r2[:, :, None] * 2 * reduced[:, None, :]
    by_decentering = dec[:, None, None] * matrices(
        (4 * p1 * x + 2 * p2 * y, 2 * p2 * x), (2 * p1 * y, 2 * p1 * x + 4 * p2 * y)
    )
    radial = [reduced * (r2**power - r02**power)[:, None] for power in (1, 2, 3)]
    decentering = [by_p1 * dec[:, None], by_p2 * dec[:, None], plain * r2[:, None], plain * r2[:, None] ** 2]
    return Correction(
        value=reduced * rad[:, None] + plain * dec[:, None],
        xy_jacobian=by_reduced + by_decentering,
        by_principal_point=-by_reduced if literal else -by_reduced - by_decentering,
        parameter_jacobian=matrices(*zip(*(column.T for column in (*radial, *decentering)), strict=True)),
    )


JUHL_NAMES = ("t1", "t2", "t3", "t4", "r1", "r2", "r3", "af", "sh")
JUHL_UNITS = ("µm at 1 dm",) * len(JUHL_NAMES)
JUHL_GROUPS = (("tangential", JUHL_NAMES[:4]), ("radial", JUHL_NAMES[4:7]), ("affinity", JUHL_NAMES[7:]))
MM_PER_DM = 100.0
UM_PER_MM = 1000.0
TANGENTIAL_POWER = 1.85  # the tangential deformation grows with r to this power


def juhl(settings: Settings, xy: Array, _: Array, parameters: Array) -> Correction:
    """Juhl's tangential, radial and affine deformations around the camera's origin, in µm at 1 dm."""
    t, (r1, r2, r3), (af, sh) = parameters[:4], parameters[4:7], parameters[7:]
    x, y = xy.T / MM_PER_DM
    radius = np.sqrt(x**2 + y**2 + np.finfo(float).tiny)  # the deformations and their derivatives vanish at 0
    r0 = settings.r0_mm / MM_PER_DM
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
    # Polar coordinates: d/dxy = d/dradius along' - d/dangle across' / radius; d along / d angle = -across.
    gradient = tangential_by_radius[:, None] * along - tangential_over_radius_by_angle[:, None] * across
    xy_jacobian = (
        across[:, :, None] * gradient[:, None, :]
        - (tangential / radius)[:, None, None] * along[:, :, None] * across[:, None, :]
        + radial_by_radius[:, None, None] * along[:, :, None] * along[:, None, :]
        + (radial / radius)[:, None, None] * across[:, :, None] * across[:, None, :]
    )
    affine = np.array([[0.0, 0.0], [-sh, -af]])
    zero = np.zeros_like(x)
    parameter_jacobian = np.concatenate(
        [
            across[:, :, None] * (power[:, None] * harmonics)[:, None, :],
            along[:, :, None] * radial_terms[:, None, :],
            np.stack([np.stack([zero, -y], axis=1), np.stack([zero, -x], axis=1)], axis=2),
        ],
        axis=2,
    )
    added = across * tangential[:, None] + along * radial[:, None] + np.stack([x, y], axis=1) @ affine.T
    count = len(xy)
    return Correction(
        value=-added / UM_PER_MM,
        xy_jacobian=-(xy_jacobian + affine) / (UM_PER_MM * MM_PER_DM),
        by_principal_point=np.zeros((count, 2, 2)),
        parameter_jacobian=-parameter_jacobian / UM_PER_MM,
    )
