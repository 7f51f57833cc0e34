"""Rotations from object to camera, M = R3(kappa) R2(phi) R1(omega), and small rotations applied to them.

A change of attitude is a rotation vector t in the camera frame, M_new = exp([t]x) M, which has no singularity.
"""

import numpy as np

from adjust.array_types import Array

GIMBAL_LOCK = 1e-12  # cos(phi) below which only omega + kappa or omega - kappa is defined


def rotation_from_angles(angles_rad: Array) -> Array:
    """Compute the rotation matrix, object to camera: (..., 3) omega, phi, kappa to (..., 3, 3)."""
    so, sp, sk = np.moveaxis(np.sin(angles_rad), -1, 0)
    co, cp, ck = np.moveaxis(np.cos(angles_rad), -1, 0)
    rows = (
        (cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck),
        (-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk),
        (sp, -so * cp, co * cp),
    )
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def angles_from_rotation(rotation: Array) -> Array:
    """Compute omega, phi, kappa (..., 3) from rotation matrices (..., 3, 3); omega is 0 where phi is ±90 degrees."""
    cos_phi = np.hypot(rotation[..., 2, 1], rotation[..., 2, 2])
    locked = cos_phi < GIMBAL_LOCK
    omega = np.where(locked, 0.0, np.arctan2(-rotation[..., 2, 1], rotation[..., 2, 2]))
    phi = np.arctan2(rotation[..., 2, 0], cos_phi)
    free = np.arctan2(-rotation[..., 1, 0], rotation[..., 0, 0])
    kappa = np.where(locked, np.arctan2(rotation[..., 0, 1], rotation[..., 1, 1]), free)
    return np.stack([omega, phi, kappa], axis=-1)


def angles_near(rotation: Array, reference_rad: Array) -> Array:
    """Compute omega, phi, kappa (..., 3) from rotation matrices, choosing the triple nearest the reference."""
    angles = angles_from_rotation(rotation)
    other = np.array([np.pi, np.pi, np.pi]) + angles * np.array([1.0, -1.0, 1.0])
    triples = np.stack([angles, other])
    triples += 2.0 * np.pi * np.round((reference_rad - triples) / (2.0 * np.pi))
    first, second = ((triples - reference_rad) ** 2).sum(axis=-1)
    return np.asarray(np.where((first <= second)[..., None], triples[0], triples[1]))


def rotation_from_vector(vector_rad: Array) -> Array:
    """Compute exp([t]x), the rotation by the vector t (Rodrigues): (..., 3) to (..., 3, 3)."""
    angle = np.sqrt((vector_rad**2).sum(axis=-1))[..., None, None]
    cross = cross_matrix(vector_rad)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def cross_matrix(vector: Array) -> Array:
    """Cross-product matrix [t]x, with [t]x u = t x u: (..., 3) to (..., 3, 3)."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    matrix = np.zeros((*vector.shape, 3), dtype=vector.dtype)
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = x, y, z
    matrix[..., 1, 2], matrix[..., 2, 0], matrix[..., 0, 1] = -x, -y, -z
    return matrix


def vector_by_angles(angles_rad: Array) -> Array:
    """Derivative (..., 3, 3) of the rotation vector w.r.t. omega, phi, kappa; singular at phi = ±90 degrees."""
    omega_axis = rotation_from_angles(angles_rad)[..., 0]
    kappa = angles_rad[..., 2]
    zero, one = np.zeros_like(kappa), np.ones_like(kappa)
    phi_axis = np.stack([np.sin(kappa), np.cos(kappa), zero], axis=-1)
    kappa_axis = np.stack([zero, zero, one], axis=-1)
    return -np.stack([omega_axis, phi_axis, kappa_axis], axis=-1)
