"""Central projection and distortion, from object to camera coordinates: Torlegård's functions F1, F2."""

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetic_images.distortion import correction
from synthetic_images.scene import SceneCamera, SceneDistortion

Array = NDArray[np.float64]

OF_THE_RAY = {  # OpenCV's families, with their coefficients in its order
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "opencv_fisheye": ("k1", "k2", "k3", "k4"),
}
INVERSION_MM = 1e-13
INVERSION_STEPS = 50


def camera_from_object(camera: SceneCamera, exterior: tuple[float, ...], points: Array) -> Array:
    """Project object points (n, 3) to observed camera coordinates x', y' (n, 2), mm.

    nan for points behind the camera, and far outside the frame, where the distortion has no inverse.
    """
    u, v, w = ((points - np.asarray(exterior[:3])) @ object_rotation(*exterior[3:]).T).T
    depth = np.where(w < 0.0, -w, np.nan)
    reach = np.hypot(u, v) / depth * camera.principal_distance_mm
    tangents = np.stack([u / depth, v / depth], axis=1)
    tangents[~(reach < np.hypot(*camera.frame_mm))] = np.nan
    return _distorted(camera, tangents)


def object_rotation(omega: float, phi: float, kappa: float) -> Array:
    """M = R3(kappa) R2(phi) R1(omega), object to camera; its third axis points away from the object."""
    so, co, sp, cp, sk, ck = (
        np.sin(omega),
        np.cos(omega),
        np.sin(phi),
        np.cos(phi),
        np.sin(kappa),
        np.cos(kappa),
    )
    r1 = np.array([[1, 0, 0], [0, co, so], [0, -so, co]])
    r2 = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    r3 = np.array([[ck, sk, 0], [-sk, ck, 0], [0, 0, 1]])
    return np.asarray(r3 @ r2 @ r1)


def _distorted(camera: SceneCamera, tangents: Array) -> Array:
    """(n, 2) observed camera coordinates, mm, of directions (U, V) / -W (n, 2)."""
    c, point = camera.principal_distance_mm, np.asarray(camera.principal_point_mm)
    ideal = c * tangents
    family = camera.distortion.family
    if family == "none":
        return np.asarray(ideal + point)
    if family in OF_THE_RAY:
        return np.asarray(c * _opencv_distorted(camera.distortion, tangents) + point)
    if family == "aicon":
        return np.asarray(ideal - correction(camera.distortion, ideal.astype(np.complex128), point).real + point)
    return np.asarray(_inverted(camera.distortion, ideal, point) + point)


def ray_from_camera(camera: SceneCamera, exterior: tuple[float, ...], camera_mm: Array) -> Array:
    """(n, 3) directions of rays in the object frame from camera coordinates (n, 2), mm; inverse of
    `camera_from_object`."""
    c, point = camera.principal_distance_mm, np.asarray(camera.principal_point_mm)
    reduced = camera_mm - point
    family = camera.distortion.family
    if family in OF_THE_RAY:
        tangents = _opencv_ideal(camera.distortion, reduced / c)
    elif family == "none":
        tangents = reduced / c
    elif family == "aicon":
        tangents = _inverted(camera.distortion, reduced, point) / c
    else:
        tangents = (reduced - correction(camera.distortion, reduced.astype(np.complex128), point).real) / c
    rays = np.column_stack([tangents, np.full(len(tangents), -1.0)])
    return np.asarray(rays @ object_rotation(*exterior[3:]))


def _opencv_ideal(distortion: SceneDistortion, tangents: Array) -> Array:
    """Inverse of `_opencv_distorted`, by OpenCV's iteration."""
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 4 * INVERSION_STEPS, 1e-14)
    distorted = np.linalg.solve(_axes(distortion), tangents.T).T.reshape(-1, 1, 2)
    if distortion.family == "opencv_fisheye":
        ideal = cv2.fisheye.undistortPoints(distorted, np.eye(3), _coefficients(distortion), criteria=until)
    else:
        ideal = cv2.undistortPoints(distorted, np.eye(3), _coefficients(distortion), criteria=until)
    return np.asarray(np.reshape(ideal, (-1, 2)) * [1.0, -1.0], np.float64)


def _opencv_distorted(distortion: SceneDistortion, tangents: Array) -> Array:
    """Distort by OpenCV's models, whose y axis points down."""
    is_visible = np.isfinite(tangents).all(axis=1)
    result = np.full_like(tangents, np.nan)
    if is_visible.any():
        directions = np.column_stack([tangents[is_visible] * [1.0, -1.0], np.ones(is_visible.sum())])
        whole = (np.zeros(3), np.zeros(3), np.eye(3), _coefficients(distortion))
        if distortion.family == "opencv_fisheye":
            projected, _ = cv2.fisheye.projectPoints(directions[:, None], *whole)
        else:
            projected, _ = cv2.projectPoints(directions, *whole)
        result[is_visible] = np.asarray(projected).reshape(-1, 2) @ _axes(distortion).T
    return result


def _coefficients(distortion: SceneDistortion) -> Array:
    return np.array([distortion.parameters.get(name, 0.0) for name in OF_THE_RAY[distortion.family]])


def _axes(distortion: SceneDistortion) -> Array:
    """(2, 2) matrix from OpenCV's axes to x right, y up, with fx = c (1 + b1) and skew c b2."""
    b1, b2 = (distortion.parameters.get(name, 0.0) for name in ("b1", "b2"))
    return np.array([[1.0 + b1, b2], [0.0, -1.0]])


def _inverted(distortion: SceneDistortion, ideal: Array, point: Array) -> Array:
    """Solve x - correction(x) = ideal for points x, reduced to the principal point, by Newton's method.

    Corrections are defined at the observed point, those of aicon at the ideal one: one direction needs inversion.
    """
    observed = ideal.copy()
    open_ = np.asarray(np.isfinite(ideal).all(axis=1))
    for _ in range(INVERSION_STEPS):
        if not open_.any():
            return observed
        start = observed[open_]
        ideal_of, by_x, by_y = _corrected(distortion, start, point)
        miss = ideal_of - ideal[open_]
        # Cramer's rule, one point per row.
        determinant = by_x[:, 0] * by_y[:, 1] - by_y[:, 0] * by_x[:, 1]
        along_x = (miss[:, 0] * by_y[:, 1] - by_y[:, 0] * miss[:, 1]) / determinant
        along_y = (by_x[:, 0] * miss[:, 1] - miss[:, 0] * by_x[:, 1]) / determinant
        observed[open_] = start - np.column_stack([along_x, along_y])
        open_[open_] = np.hypot(along_x, along_y) > INVERSION_MM * (1 + np.hypot(start[:, 0], start[:, 1]))
    observed[open_] = np.nan
    return observed


def _corrected(distortion: SceneDistortion, observed: Array, point: Array) -> tuple[Array, Array, Array]:
    """Points (n, 2) minus their correction, and its complex-step derivatives with respect to x and y, (n, 2) each."""
    steps = np.concatenate([observed + step for step in 1e-30j * np.eye(2)])
    by_x, by_y = np.split(steps - correction(distortion, steps, point), 2)
    return by_x.real, by_x.imag / 1e-30, by_y.imag / 1e-30
