"""P3P: poses of a camera from three known points by Grunert's solution, for many triples at once."""

import numpy as np

from adjust.array_types import Array, Indices


def triple_poses(points: Array, tangents: Array) -> tuple[Array, Array, Indices]:
    """Solve P3P for many triples of points.

    Parameters
    ----------
    points : (m, 3, 3) object coordinates.
    tangents : (m, 3, 2) image coordinates over c.

    Returns
    -------
    rotations (k, 3, 3) and shifts (k, 3), camera = R X + t, and the number (k,) of the triple of each.

    Notes
    -----
    Grunert's solution (Haralick et al. 1994, eqs. 7-9): a quartic in the ratio of two of the three distances.
    """
    rays = np.concatenate([tangents, np.full((*tangents.shape[:2], 1), -1.0)], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    a2, b2, c2 = (((points[:, i] - points[:, j]) ** 2).sum(axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    cos_a, cos_b, cos_g = ((rays[:, i] * rays[:, j]).sum(axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    with np.errstate(all="ignore"):  # degenerate triples give nan or inf and are dropped below
        ratio_v = _quartic_roots(_grunert_quartic(a2 / b2, c2 / b2, cos_a, cos_b, cos_g))
        d = ((a2 - c2) / b2)[:, None]
        numerator = (d - 1) * ratio_v**2 - 2 * d * cos_b[:, None] * ratio_v + 1 + d
        ratio_u = numerator / (2 * (cos_g[:, None] - ratio_v * cos_a[:, None]))
        first = np.sqrt(b2[:, None] / (1 + ratio_v**2 - 2 * ratio_v * cos_b[:, None]))
        distances = np.stack([first, ratio_u * first, ratio_v * first], axis=2)  # (m, 4, 3)
        in_camera = distances[..., None] * rays[:, None]
        rotations = _triad(in_camera) @ np.swapaxes(_triad(points), 1, 2)[:, None]
        shifts = in_camera.mean(axis=2) - np.einsum("mkij,mj->mki", rotations, points.mean(axis=1))
    usable = (distances > 0).all(axis=2) & np.isfinite(rotations).all(axis=(2, 3)) & np.isfinite(shifts).all(axis=2)
    return rotations[usable], shifts[usable], np.nonzero(usable)[0]


def _grunert_quartic(a: Array, c: Array, cos_a: Array, cos_b: Array, cos_g: Array) -> Array:
    """Coefficients (m, 5) of the quartic, highest degree first; a, c: squared sides over b²."""
    d, s = a - c, a + c
    return np.stack(
        [
            (d - 1) ** 2 - 4 * c * cos_a**2,
            4 * (d * (1 - d) * cos_b - (1 - s) * cos_a * cos_g + 2 * c * cos_a**2 * cos_b),
            2 * (d**2 - 1 + 2 * d**2 * cos_b**2 + 2 * (1 - c) * cos_a**2 - 4 * s * cos_a * cos_b * cos_g)
            + 4 * (1 - a) * cos_g**2,
            4 * (-d * (1 + d) * cos_b + 2 * a * cos_g**2 * cos_b - (1 - s) * cos_a * cos_g),
            (1 + d) ** 2 - 4 * a * cos_g**2,
        ],
        axis=1,
    )


def _quartic_roots(coefficients: Array) -> Array:
    """Real parts (m, 4) of the roots: noise turns the double root of a camera above its points into a complex pair."""
    monic = coefficients[:, 1:] / coefficients[:, :1]
    sound = np.logical_and.reduce(np.isfinite(monic), axis=1)
    companion = np.zeros((len(monic), 4, 4))
    companion[:, 0] = -np.where(sound[:, np.newaxis], monic, 0.0)
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    return np.where(sound[:, np.newaxis], np.real(np.linalg.eigvals(companion)), np.nan)


def _triad(points: Array) -> Array:
    """Orthonormal axes (..., 3, 3), in columns, attached to three points (..., 3, 3)."""
    x = points[..., 1, :] - points[..., 0, :]
    z = np.cross(x, points[..., 2, :] - points[..., 0, :])
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
