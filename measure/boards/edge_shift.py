"""Shift of the edges of separate markers and squares by the tone curve and by ink, estimated from the board's geometry.

Edges are matched in stored grey values. Under a tone curve, such as the gamma of most cameras, the middle grey value of
a blurred edge is not the middle of its light, so that all edges shift towards the same side by the same share of their
blur. A crossing stays, since its edges shift symmetrically; the corners of a separate square move along its diagonals.
Ink that has spread does the same. The distances between squares do not change, and show it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.boards.corner_fit import Corner
from measure.boards.specs import FoundCorner, Point3
from measure.flags import Cause
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.noise.robust_estimation import robust_scale
from measure.targets.sheets import fit_view_robustly

_PRIOR = 0.3  # standard deviation of the shift, in blurs: a gamma of 2.2 shifts by 0.4 from dark to light
_FEWEST = 16  # corners, of four squares: those of fewer are as well explained by another view
_ROUNDS = 4  # views and shifts in turn; a view takes up less than a fifth of a shift


def without_edge_shift(
    fitted: Mapping[str, Corner],
    found: Mapping[str, FoundCorner],
    points: Mapping[str, Point3],
    size_px: tuple[int, int],
) -> dict[str, Corner]:
    """Move the corners of separate squares back by the shift of their edges, and add its uncertainty to them.

    Parameters
    ----------
    fitted, found : corners by id, and the sides of their squares.
    points : object points by id.
    size_px : of the scan.
    """
    names = [name for name, corner in fitted.items() if not corner.reason]
    if not names:
        return dict(fitted)
    blurs_px = [np.sqrt(fitted[name].blur_px ** 2 + PIXEL_VARIANCE_PX2) for name in names]
    moves_px = np.array([blur * _outward(found[name].steps_px) for blur, name in zip(blurs_px, names, strict=True)])
    places_px = np.array([fitted[name].center_px for name in names])
    board = np.array([points[name][:2] for name in names])
    shift, variance = 0.0, _PRIOR**2
    for _ in range(_ROUNDS if len(names) >= _FEWEST else 0):
        view = fit_view_robustly(board, places_px - shift * moves_px, size_px)
        if view is None:
            break
        off_px = np.nan_to_num(places_px - view.places_px(board))
        noise_px2 = robust_scale((off_px - shift * moves_px).ravel()) ** 2 + 1e-9
        variance = 1 / (1 / _PRIOR**2 + (moves_px**2).sum() / noise_px2)
        shift = variance * float((moves_px * off_px).sum()) / noise_px2
    moved = dict(fitted)
    for name, move_px in zip(names, moves_px, strict=True):
        covariance = fitted[name].covariance.plus(Cause.TONE, variance * np.outer(move_px, move_px))
        moved[name] = replace(fitted[name], center_px=fitted[name].center_px - shift * move_px, covariance=covariance)
    return moved


def _outward(sides_px: Array) -> Array:
    """(2,) how a corner with the given sides (columns) moves where its edges move outwards by 1."""
    along = sides_px / np.hypot(*sides_px)
    return np.asarray(-along.sum(axis=1) / max(abs(float(np.linalg.det(along))), 1e-3))
