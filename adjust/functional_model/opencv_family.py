"""OpenCV's distortion models, which distort the ideal ray.

Sources: OpenCV's documentation of camera calibration ("detailed description") and of its namespace fisheye. OpenCV's
axes are x right and y DOWN, those of the camera here have y up. The parameters keep OpenCV's values, in its axes.
"""

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.correction import DistortedRay, complex_steps, straight
from adjust.linear_algebra.small_matrices import applied, matrices, product, vectors

OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y", "b1", "b2")
OPENCV_DENOMINATOR = ("k4", "k5", "k6")  # at 0 their derivatives are those of k1, k2, k3 with opposite sign
FISHEYE_NAMES = ("k1", "k2", "k3", "k4", "b1", "b2")
DOWN = np.array([1.0, -1.0])  # from axes with y up to OpenCV's, and back
CENTRAL = 1e-4  # tangent below which an angle is expanded in a series: the next term is below 1e-16


def opencv(ray: Array, parameters: Array) -> DistortedRay:
    """Distort rays (n, 2) given in the camera's axes, y up; the parameters are in OpenCV's axes, y down.

    tau_x, tau_y, the tilt of the sensor, in rad. b1 scales x and b2 shears it, as the camera matrix does: OpenCV's fx
    is c (1 + b1), its fy is c, the skew of Zhang's matrix is c b2, all over the pitch.
    """
    angles, (b1, b2) = parameters[12:14], parameters[14:]
    straight_lens = _lens(ray * DOWN, parameters[:12])
    is_tilted = bool(angles.any())
    tilted = _tilt(straight_lens.value, angles) if is_tilted else straight(straight_lens.value)

    def parameter_derivative(k: int) -> Array:
        if OPENCV_NAMES[k] in ("tau_x", "tau_y"):
            return _tilt(straight_lens.value, angles).parameter_derivative(k - OPENCV_NAMES.index("tau_x"))
        column = straight_lens.parameter_derivative(k)
        return applied(tilted.ray_jacobian, column) if is_tilted else column

    ray_jacobian = product(tilted.ray_jacobian, straight_lens.ray_jacobian) if is_tilted else straight_lens.ray_jacobian
    return _camera_axes(
        DistortedRay(tilted.value, ray_jacobian, parameter_derivative), b1, b2, OPENCV_NAMES.index("b1")
    )


def opencv_fisheye(ray: Array, parameters: Array) -> DistortedRay:
    """Distort rays (n, 2) by OpenCV's fisheye model: theta (1 + k1 theta² + ... + k4 theta⁸), theta in rad.

    The model is equidistant where k1 to k4 are 0. As with every family, an image ends below 90 degrees off the axis. b1
    and b2 as in `opencv`: OpenCV's alpha is b2 / (1 + b1).
    """
    *k, b1, b2 = parameters
    x, y = (ray * DOWN).T
    r2 = x**2 + y**2
    central = r2.real < CENTRAL**2
    outer2 = np.where(central, 1.0, r2)
    tangent = np.sqrt(outer2)
    theta2 = np.where(central, r2 * (1.0 - 2.0 / 3.0 * r2), np.arctan(tangent) ** 2)
    bent = np.where(central, 1.0 - r2 / 3.0, np.arctan(tangent) / tangent)  # theta over its tangent
    bent_by_r2 = np.where(
        central, -1.0 / 3.0 + 0.4 * r2, (1.0 / (1.0 + r2) - bent) / (2.0 * np.where(central, 1.0, r2))
    )
    theta2_by_r2 = bent / (1.0 + r2)
    series = 1.0 + theta2 * (k[0] + theta2 * (k[1] + theta2 * (k[2] + theta2 * k[3])))
    series_by_theta2 = k[0] + theta2 * (2 * k[1] + theta2 * (3 * k[2] + theta2 * 4 * k[3]))
    radial = bent * series
    radial_by_r2 = bent_by_r2 * series + bent * series_by_theta2 * theta2_by_r2
    ray_jacobian = matrices(
        (radial + 2 * x * x * radial_by_r2, 2 * x * y * radial_by_r2),
        (2 * x * y * radial_by_r2, radial + 2 * y * y * radial_by_r2),
    )

    def parameter_derivative(number: int) -> Array:
        factor = bent * theta2 ** (number + 1)
        return vectors(x * factor, y * factor)

    lens = DistortedRay(vectors(x * radial, y * radial), ray_jacobian, parameter_derivative)
    return _camera_axes(lens, b1, b2, FISHEYE_NAMES.index("b1"))


def _camera_axes(lens: DistortedRay, b1: float, b2: float, first: int) -> DistortedRay:
    """Apply affinity and shear to distorted rays in OpenCV's axes and convert them to the camera's axes."""
    # first: index of b1 among the parameters; b2 is the next.
    scale = np.array([1.0 + b1, -1.0]) + 0.0 * b2  # complex where b1 or b2 is

    def camera_axes(straight: Array) -> Array:
        """Convert vectors (2, ...), the axes first."""
        sheared = (straight.T * scale).T
        if b2 != 0.0:
            sheared[0] += b2 * straight[1]
        return np.asarray(sheared)

    def parameter_derivative(k: int) -> Array:
        if k >= first:
            return vectors(lens.value[:, k - first], np.zeros_like(lens.value[:, 0]))
        return camera_axes(lens.parameter_derivative(k).T).T

    ray_jacobian = camera_axes(lens.ray_jacobian.transpose(1, 2, 0)).transpose(2, 0, 1)
    return DistortedRay(camera_axes(lens.value.T).T, ray_jacobian * DOWN, parameter_derivative)


def expand_parameters(parameters: Array) -> Array:
    """Multiply numerator and denominator of the radial distortion by 1 + r²; powers above the sixth are dropped."""
    k = dict(zip(OPENCV_NAMES, parameters, strict=True))
    for names in (("k1", "k2", "k3"), OPENCV_DENOMINATOR):
        lower = [1.0, *(k[name] for name in names[:-1])]
        k |= {name: k[name] + each for name, each in zip(names, lower, strict=True)}
    return np.array([k[name] for name in OPENCV_NAMES])


def _lens(ray: Array, parameters: Array) -> DistortedRay:
    """Radial, tangential and thin prism distortion."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = parameters
    x, y = ray.T
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
    ray_jacobian = matrices(
        (radial + 2 * p1 * y + 4 * p2 * x + 2 * x * xd_by_r2, 2 * p1 * x + 2 * y * xd_by_r2),
        (2 * p2 * y + 2 * x * yd_by_r2, radial + 4 * p1 * y + 2 * p2 * x + 2 * y * yd_by_r2),
    )

    def parameter_derivative(k: int) -> Array:
        zero, powers = np.zeros_like(x), (r2, r2 * r2, r2 * r2 * r2)
        match OPENCV_NAMES[k]:
            case "p1":
                return vectors(2 * x * y, r2 + 2 * y**2)
            case "p2":
                return vectors(r2 + 2 * x**2, 2 * x * y)
            case "s1" | "s2" as name:
                return vectors(powers[int(name[1]) - 1], zero)
            case "s3" | "s4" as name:
                return vectors(zero, powers[int(name[1]) - 3])
            case "k1" | "k2" | "k3" as name:
                factor = powers[int(name[1]) - 1] / below
            case name:  # k4, k5, k6
                factor = -radial * powers[int(name[1]) - 4] / below
        return vectors(x * factor, y * factor)

    return DistortedRay(vectors(xd, yd), ray_jacobian, parameter_derivative)


def _tilt(point: Array, angles: Array) -> DistortedRay:
    """Project points onto a sensor tilted by tau_x, tau_y: R33 (r1 p / r3 p, r2 p / r3 p) - (R13, R23)."""
    # r1, r2, r3 are the rows of R = Ry(tau_y) Rx(tau_x), p = (x, y, 1).

    def projected(point: Array, angles: Array) -> Array:
        (cx, cy), (sx, sy), zero = np.cos(angles), np.sin(angles), 0.0
        rotation = np.array([[cy, sy * sx, -sy * cx], [zero, cx, sx], [sy, -cy * sx, cy * cx]])
        along = point @ rotation[:, :2].T + rotation[:, 2]
        return np.asarray(rotation[2, 2] * along[:, :2] / along[:, 2:] - rotation[:2, 2])

    def angle_derivative(k: int) -> Array:
        return complex_steps(lambda moved: projected(point, moved), angles)[..., k]

    by_point = complex_steps(lambda moved: projected(moved, angles), point)
    return DistortedRay(projected(point, angles), by_point, angle_derivative)
