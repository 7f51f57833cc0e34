"""Juhl's correction of the observed point (program sANA): tangential, radial and affine deformations."""

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.correction import Correction, Settings

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
