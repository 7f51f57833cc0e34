"""OpenCV's model, which distorts the ideal ray: its documentation of camera calibration, "detailed description"."""

import numpy as np
from numpy.typing import NDArray

from adjust.correction import Imaged, matrices

Array = NDArray[np.float64]

OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y", "b1")
OPENCV_GROUPS = (
    ("radial", ("k1", "k2", "k3", "k4", "k5", "k6")),
    ("radial, denominator", ("k4", "k5", "k6")),
    ("decentering", ("p1", "p2")),
    ("thin prism", ("s1", "s2", "s3", "s4")),
    ("tilt", ("tau_x", "tau_y")),
)


def opencv(ray: Array, parameters: Array) -> Imaged:
    """The image of rays (n, 2) in the camera's axes, y up; the parameters are those of OpenCV's axes, y down.

    tau_x, tau_y, the tilt of the sensor, in rad. b1 scales x: OpenCV's fx is c (1 + b1), its fy is c, both over the
    pitch.
    """
    tau_x, tau_y, b1 = parameters[12:]
    straight = _lens(ray * np.array([1.0, -1.0]), parameters[:12])
    tilted = _tilt(straight.value, tau_x, tau_y)
    # From OpenCV's axes to the camera's: the image's y, and the ray's, turn their signs.
    scale = np.array([1 + b1, -1.0])
    by_b1 = tilted.value * np.array([1.0, 0.0])
    columns = np.concatenate([tilted.by_ray @ straight.by_parameters, tilted.by_parameters], axis=2)
    return Imaged(
        value=tilted.value * scale,
        by_ray=tilted.by_ray @ straight.by_ray * scale[:, None] * np.array([1.0, -1.0]),
        by_parameters=np.concatenate([columns * scale[:, None], by_b1[..., None]], axis=2),
    )


def _lens(ray: Array, parameters: Array) -> Imaged:
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
    by_ray = matrices(
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
    return Imaged(np.stack([xd, yd], axis=1), by_ray, np.stack(columns, axis=2))


def _tilt(point: Array, tau_x: float, tau_y: float) -> Imaged:
    """The point on a sensor that is tilted about its axes: R33 (r1 p / r3 p, r2 p / r3 p) - (R13, R23).

    r1, r2, r3 are the rows of R = Ry(tau_y) Rx(tau_x), p = (x, y, 1).
    """
    rx, rx_by_angle = _turn(tau_x)
    ry, ry_by_angle = _turn(tau_y)
    about_x, about_y = [0, 1, 2], [1, 2, 0]  # the axis of the turn first
    rotation = _placed(ry, about_y) @ _placed(rx, about_x)
    moved = (
        _placed(ry, about_y) @ _placed(rx_by_angle, about_x, 0.0),
        _placed(ry_by_angle, about_y, 0.0) @ _placed(rx, about_x),
    )
    p = np.concatenate([point, np.ones((len(point), 1))], axis=1)
    q = p @ rotation.T
    depth = q[:, 2:]
    over_depth = q[:, :2] / depth
    by_point = rotation[2, 2] * (rotation[:2, :2] - over_depth[..., None] * rotation[2, :2]) / depth[..., None]
    columns = []
    for change in moved:
        q_change = p @ change.T
        over_depth_change = (q_change[:, :2] - over_depth * q_change[:, 2:]) / depth
        columns.append(rotation[2, 2] * over_depth_change + change[2, 2] * over_depth - change[:2, 2])
    return Imaged(rotation[2, 2] * over_depth - rotation[:2, 2], by_point, np.stack(columns, axis=2))


def _turn(angle: float) -> tuple[Array, Array]:
    """The 2x2 matrix of OpenCV's turn by an angle, and its derivative."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]]), np.array([[-s, c], [-c, -s]])


def _placed(turn: Array, axes: list[int], along: float = 1.0) -> Array:
    """The turn (2, 2) as a matrix (3, 3) in the plane of the last two axes; along: what stands on the first."""
    matrix = np.zeros((3, 3), dtype=turn.dtype)
    matrix[axes[0], axes[0]] = along
    matrix[np.ix_(axes[1:], axes[1:])] = turn
    return matrix
