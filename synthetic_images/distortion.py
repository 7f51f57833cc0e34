"""Distortion corrections of the observed or the ideal image point, as the papers define them.

OpenCV's models, which distort the ray itself, are in `projection`.
"""

import numpy as np
from numpy.typing import NDArray

from synthetic_images.scene import PARAMETERS, SceneDistortion

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MM_PER_DM = 100.0
JUHL_UNIT = 1e-5  # dm, 1 µm


def correction(distortion: SceneDistortion, reduced: ComplexArray, point: Array) -> ComplexArray:
    """(n, 2) correction, mm: ideal = observed - correction, evaluated at the observed point; for aicon at the ideal
    one.

    reduced: (n, 2) camera coordinates minus the principal point (2,). Complex, for complex-step derivatives.
    """
    value = dict.fromkeys(PARAMETERS[distortion.family], 0.0) | dict(distortion.parameters)
    families = {"torlegard": _torlegard, "brown": _brown, "australis": _australis, "aicon": _aicon, "juhl": _juhl}
    return families[distortion.family](distortion, value, reduced, point)


def _torlegard(
    distortion: SceneDistortion, value: dict[str, float], reduced: ComplexArray, point: Array
) -> ComplexArray:
    x, y = reduced.T
    r2, zero2 = x * x + y * y, distortion.r0_mm**2
    radial = value["k3"] * (r2 - zero2) + value["k5"] * (r2**2 - zero2**2) + value["k7"] * (r2**3 - zero2**3)
    dec = 1 + value["p3"] * r2 + value["p4"] * r2**2
    # The paper prints the decentring terms with coordinates that are not reduced to the principal point.
    px, py = (x, y) if distortion.decentering == "reduced" else (x + point[0], y + point[1])
    dx = x * radial + (value["p1"] * (r2 + 2 * px * px) + 2 * value["p2"] * px * py) * dec
    dy = y * radial + (2 * value["p1"] * px * py + value["p2"] * (r2 + 2 * py * py)) * dec
    return np.stack([dx, dy], axis=1)


def _brown(_: SceneDistortion, value: dict[str, float], reduced: ComplexArray, __: Array) -> ComplexArray:
    x, y = reduced.T
    r2 = x * x + y * y
    radial = r2 * (value["k1"] + r2 * (value["k2"] + r2 * value["k3"]))
    dx = x * radial + value["p1"] * (r2 + 2 * x * x) + 2 * value["p2"] * x * y + value["b1"] * x + value["b2"] * y
    dy = y * radial + 2 * value["p1"] * x * y + value["p2"] * (r2 + 2 * y * y)
    return np.stack([dx, dy], axis=1)


def _australis(_: SceneDistortion, value: dict[str, float], reduced: ComplexArray, __: Array) -> ComplexArray:
    """The published terms are added to the observed point, hence the sign."""
    x, y = reduced.T
    r2 = x * x + y * y
    radial = value["k1"] * r2 + value["k2"] * r2**2 + value["k3"] * r2**3
    dx = x * radial + value["p1"] * (r2 + 2 * x * x) + 2 * value["p2"] * x * y + value["b1"] * x + value["b2"] * y
    dy = y * radial + 2 * value["p1"] * x * y + value["p2"] * (r2 + 2 * y * y)
    return np.stack([-dx, -dy], axis=1)


def _aicon(distortion: SceneDistortion, value: dict[str, float], reduced: ComplexArray, _: Array) -> ComplexArray:
    """The published terms are added to the ideal point, which `reduced` is here."""
    x, y = reduced.T
    r2, zero2 = x * x + y * y, distortion.r0_mm**2
    radial = sum(value[f"a{n}"] * (r2**n - zero2**n) for n in (1, 2, 3))
    dx = x * radial + value["b1"] * (r2 + 2 * x * x) + 2 * value["b2"] * x * y + value["c1"] * x + value["c2"] * y
    dy = y * radial + value["b2"] * (r2 + 2 * y * y) + 2 * value["b1"] * x * y
    return np.stack([-dx, -dy], axis=1)


def _juhl(distortion: SceneDistortion, value: dict[str, float], reduced: ComplexArray, point: Array) -> ComplexArray:
    """Program sANA: relative to the camera's origin, in dm; terms added to the observed point."""
    x, y = np.asarray((reduced + point).T / MM_PER_DM, np.complex128)
    r0 = distortion.r0_mm / MM_PER_DM
    r = np.sqrt(x * x + y * y + 1e-40)  # avoids 0 / 0 at the origin
    cos, sin = x / r, y / r
    cos2, sin2 = cos * cos - sin * sin, 2 * sin * cos
    tangential = r**1.85 * (value["t1"] * cos + value["t2"] * sin + value["t3"] * cos2 + value["t4"] * sin2)
    radial = value["r1"] * (r**3 - r0**2 * r)
    if r0 > 0.0:
        radial = radial + value["r2"] * r * np.sin(np.pi * r / r0) ** 2 + value["r3"] * np.sin(2 * np.pi * r / r0)
    added_x = tangential * sin + radial * cos
    added_y = -tangential * cos + radial * sin - (value["af"] * y + value["sh"] * x)
    return np.asarray(np.stack([added_x, added_y], axis=1) * (-JUHL_UNIT * MM_PER_DM), np.complex128)
