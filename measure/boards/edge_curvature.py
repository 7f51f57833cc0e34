"""Curvature of a board's straight edges in an image: what a lens's distortion does to them, taken from the corners."""

import numpy as np
from scipy.spatial import KDTree

from measure.array_types import Array

_POINTS = 6  # nearest points of a line of the board, through which a cubic is fitted
_FEWEST = 4  # points; a parabola through three has no residuals, which would show a gross error
_SAME_LINE = 1e-6  # of the board's extent: points closer to a line than this lie on it
_LARGEST_RESIDUAL_PX = 0.5  # rms from the curve, beyond which a point is not where its name says


def edge_curvatures(centers_px: Array, board: Array, normals: Array) -> Array:
    """Curvature of the two edges at each corner of a board.

    An edge lies on a line of the board, as the next corners do. Every perspective keeps lines straight, so the
    curve that the corners of a line show comes from the lens.

    Parameters
    ----------
    centers_px : (n, 2) corners in the image, to about a tenth of a pixel; nan where not known.
    board : (n, 2) their places on the board, whose edges are parallel to its axes.
    normals : (n, 2, 2) unit normals of the two edges (rows) at each corner in the image.

    Returns
    -------
    (n, 2) curvatures, 1/px, positive where the edge bends towards its normal; 0 where a line shows fewer than four
    corners, or where these do not lie on a smooth curve.
    """
    curvatures = np.zeros((len(board), 2))
    known = np.flatnonzero(np.isfinite(centers_px).all(axis=1))
    if len(known) < _FEWEST:
        return curvatures
    rows, centers = np.arange(len(known)), centers_px[known]
    for axis in range(2):
        apart = board[known] / float(np.ptp(board, axis=0).max())
        apart[:, 1 - axis] /= _SAME_LINE
        distances, near = KDTree(apart).query(apart, range(1, _POINTS + 1), distance_upper_bound=2.0)
        on_line = np.isfinite(distances)
        offsets = (centers[np.where(on_line, near, 0)] - centers[:, None]) * on_line[..., None]
        farthest = offsets[rows, np.argmax(np.abs(offsets).sum(axis=2), axis=1)]
        across = np.einsum("nei,ni->ne", normals[known], farthest)
        edge = np.argmin(np.abs(across), axis=1)
        normal = normals[known, edge]
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        along, height = (np.einsum("npi,ni->np", offsets, direction) for direction in (tangent, normal))
        length = np.abs(along).max(axis=1, keepdims=True) + 1e-9
        along /= length
        count = on_line.sum(axis=1)
        is_cubic = count > _FEWEST
        design = np.stack([on_line, along, along**2 / 2, along**3 * is_cubic[:, None]], axis=-1)
        terms = np.linalg.pinv(design) @ height[..., None]
        spare = count - np.where(is_cubic, 4, 3)
        squares_px2 = ((height - (design @ terms)[..., 0]) ** 2).sum(axis=1)
        lies_on_it = (spare > 0) & (squares_px2 <= _LARGEST_RESIDUAL_PX**2 * spare)
        # A corner alone on its line does not show which edge that is: the other edge's curvature stays.
        curved = terms[:, 2, 0] / length[:, 0] ** 2
        curvatures[known, edge] = np.where(lies_on_it, curved, curvatures[known, edge])
    return curvatures
