"""Relative orientation of two images from five and more common points (the essential matrix)."""

import numpy as np

from adjust.array_types import Array
from adjust.initial_values.pose import Pose

SAMPLES = 150
CANDIDATES = 4  # poses handed on: the two interpretations of a flat scene must both be among them
REAL = 1e-6  # imaginary part, relative, of a root that is real

# The monomials in x, y, z of Stewénius's elimination: ten cubic ones, then the basis of the quotient ring.
CUBIC = ((3, 0, 0), (2, 1, 0), (1, 2, 0), (0, 3, 0), (2, 0, 1), (1, 1, 1), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3))
BASIS = ((2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
POWERS = np.array([*CUBIC, *BASIS])
CUBIC_TIMES_X = (0, 1, 2, 4, 5, 7)  # x times the first six of the basis: which cubic monomial it is
BASIS_TIMES_X = (0, 1, 3, 6)  # x times x, y, z, 1: which of the basis it is


def relative_poses(first: Array, second: Array, rng: np.random.Generator) -> list[Pose]:
    """Poses of the second image, the first one at the origin with rotation I and a base of length 1, the best first.

    first, second (n, 3): rays to the same points in the two camera frames, n >= 5. Essential matrices of samples of
    five (Stewénius, Engels and Nistér 2006) ranked by the smaller half of the coplanarity errors, so that gross errors
    do no harm; of the four poses of each, the one with most points in front of both cameras.
    """
    first, second = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (first, second))
    samples = np.array([rng.choice(len(first), 5, replace=False) for _ in range(SAMPLES)])
    essential = _essential_matrices(first[samples], second[samples])
    if not len(essential):
        return []
    half = (len(first) + 6) // 2
    cost = np.sort(_coplanarity(essential, first, second), axis=1)[:, :half].sum(axis=1)
    poses: list[Pose] = []
    for number in np.argsort(cost, kind="stable"):
        pose = _pose(essential[number], first, second)
        if all(_angle(pose, other) > 0.05 for other in poses):
            poses.append(pose)
        if len(poses) == CANDIDATES:
            break
    return poses


def _essential_matrices(first: Array, second: Array) -> Array:
    """All real solutions (k, 3, 3) of samples (m, 5, 3): second' E first = 0."""
    coplanarity = np.einsum("msi,msj->msij", second, first).reshape(len(first), 5, 9)
    null = np.linalg.svd(coplanarity)[2][:, 5:].reshape(-1, 4, 3, 3)
    coefficients = _constraint_coefficients(null)
    regular = np.abs(np.linalg.det(coefficients[:, :, :10])) > np.finfo(float).tiny
    null, coefficients = null[regular], coefficients[regular]
    reduced = np.linalg.solve(coefficients[:, :, :10], coefficients[:, :, 10:])
    action = np.zeros((len(null), 10, 10))
    action[:, :6] = -reduced[:, CUBIC_TIMES_X]
    action[:, [6, 7, 8, 9], BASIS_TIMES_X] = 1.0
    vectors = np.asarray(np.linalg.eig(action)[1], dtype=np.complex128)  # (m, 10, 10), a column a solution
    with np.errstate(divide="ignore", invalid="ignore"):
        unknowns = vectors[:, 6:9] / vectors[:, 9:]
    real = np.logical_and.reduce(np.abs(unknowns.imag) <= REAL * (1.0 + np.abs(unknowns.real)), axis=1)
    weights = np.concatenate([unknowns.real, np.ones((len(null), 1, 10))], axis=1)
    matrices = np.einsum("mws,mwij->msij", np.where(real[:, np.newaxis], weights, 0.0), null)[real]
    return np.asarray(matrices / np.linalg.norm(matrices, axis=(1, 2), keepdims=True))


def _constraint_coefficients(null: Array) -> Array:
    """Coefficients (m, 10, 20) of det E = 0 and 2 E E' E - tr(E E') E = 0, E = x N1 + y N2 + z N3 + N4.

    Found by interpolation: the constraints are evaluated at twenty places and the monomials' matrix is inverted.
    """
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))
    monomials = (places[:, None, :] ** POWERS).prod(axis=2)
    weights = np.column_stack([places, np.ones(20)])
    essential = np.einsum("pw,mwij->mpij", weights, null)
    product = essential @ np.swapaxes(essential, 2, 3)
    trace = np.trace(product, axis1=2, axis2=3)[..., None, None]
    cubic = (2.0 * product @ essential - trace * essential).reshape(len(null), 20, 9)
    values = np.concatenate([cubic, np.linalg.det(essential)[..., None]], axis=2)
    return np.asarray(np.swapaxes(np.linalg.solve(monomials, values), 1, 2))


def _coplanarity(essential: Array, first: Array, second: Array) -> Array:
    """Squared angles (k, n), nearly, by which rays miss the epipolar planes (Sampson's distance on the sphere)."""
    right, left = first @ np.swapaxes(essential, 1, 2), second @ essential
    error = (second * right).sum(axis=2)
    slope = ((right - error[..., None] * second) ** 2).sum(axis=2) + ((left - error[..., None] * first) ** 2).sum(
        axis=2
    )
    return np.asarray(error**2 / np.maximum(slope, np.finfo(float).tiny))


def _pose(essential: Array, first: Array, second: Array) -> Pose:
    """Of the four poses of an essential matrix, that with most points in front of both cameras."""
    u, _, vt = np.linalg.svd(essential)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotations = [u @ w @ vt * np.sign(np.linalg.det(u @ vt)) for w in (turn, turn.T)]
    poses = [Pose(rotation, sign * rotation.T @ u[:, 2]) for rotation in rotations for sign in (1.0, -1.0)]
    return max(poses, key=lambda pose: _pairs_in_front(pose, first, second))


def _pairs_in_front(pose: Pose, first: Array, second: Array) -> int:
    """How many pairs of rays meet at positive distances from both cameras."""
    turned = second @ pose.rotation
    cosine = (first * turned).sum(axis=1)
    along_first, along_second = first @ pose.center, turned @ pose.center
    # least squares of s first - t turned = center, times the positive determinant 1 - cosine²
    s = along_first - cosine * along_second
    t = cosine * along_first - along_second
    return int(((s > 0) & (t > 0)).sum())


def _angle(pose: Pose, other: Pose) -> float:
    """How different two poses are: the turn between them and the angle between their bases, in rad."""
    turn = np.arccos(np.clip((np.trace(pose.rotation @ other.rotation.T) - 1) / 2, -1.0, 1.0))
    return float(turn + np.arccos(np.clip(pose.center @ other.center, -1.0, 1.0)))
