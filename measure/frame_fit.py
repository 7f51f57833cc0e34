"""The frame through its marks: by weighted least squares a similarity, with the affinity that film and scanner have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AFFINITY_SIGMA = 5e-3  # film stretches by a few parts in ten thousand, an office scanner by several thousandths


@dataclass(frozen=True, eq=False)
class FrameFit:
    """up_from_camera: (2, 3), camera mm to the scan's mm (right, up). residuals_mm: (n, 2) measured less predicted.

    chi_square holds the affinity's two pseudo-observations too; redundancy counts them: 2 n - 4.
    """

    up_from_camera: Array
    residuals_mm: Array
    chi_square: float
    redundancy: int


def fit_frame(camera_mm: Array, up_mm: Array, sigma_mm: Array, turn: Array) -> FrameFit:
    """Fit the frame to n >= 2 marks at camera_mm (n, 2) seen at up_mm (n, 2), with standard deviations sigma_mm (n,).

    turn: the pose's (2, 2), so that the similarity is a small one on top of it. Raises ValueError for fewer than two
    marks: they determine nothing.
    """
    if len(camera_mm) < 2:
        raise ValueError(f"{len(camera_mm)} marks do not determine a frame; two or more do")
    x, y = (camera_mm @ turn.T).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate([np.stack([x, -y, one, none, x, y], axis=1), np.stack([y, x, none, one, -y, x], axis=1)])
    values, weight = up_mm.T.ravel(), np.tile(1 / sigma_mm, 2)
    prior = np.zeros((2, 6))
    prior[0, 4] = prior[1, 5] = 1 / AFFINITY_SIGMA
    design = np.concatenate([rows * weight[:, None], prior])
    right = np.concatenate([values * weight, np.zeros(2)])
    size = np.linalg.norm(design, axis=0)
    solution = np.linalg.lstsq(design / size, right, rcond=None)[0] / size
    a, b, shift_x, shift_y, stretch, shear = solution
    linear = np.array([[a + stretch, -b + shear], [b + shear, a - stretch]]) @ turn
    residuals = (values - rows @ solution).reshape(2, -1).T
    chi_square = float(np.sum((design @ solution - right) ** 2))
    return FrameFit(np.column_stack([linear, [shift_x, shift_y]]), residuals, chi_square, 2 * len(camera_mm) - 4)


def strangers(camera_mm: Array, up_mm: Array, sigma_mm: Array, turn: Array, gate_mm: float) -> NDArray[np.bool_]:
    """(n,) which marks do not belong: one by one, the mark without which the others agree best is taken out, until
    none is off by more than the gate, or only three are left."""
    out = np.zeros(len(camera_mm), dtype=bool)
    while (~out).sum() > 3:
        kept = np.flatnonzero(~out)
        fit = fit_frame(camera_mm[kept], up_mm[kept], sigma_mm[kept], turn)
        size = np.hypot(*fit.residuals_mm.T)
        if size.max() <= _gate(size, gate_mm):
            break
        rest = [_misfit(np.delete(kept, index), camera_mm, up_mm, sigma_mm, turn) for index in range(len(kept))]
        out[kept[int(np.argmin(rest))]] = True
    return out


def _gate(size_mm: Array, gate_mm: float) -> float:
    """With many marks, their own scatter says more than the gate: 4.5 medians of the distances are over five standard
    deviations."""
    if len(size_mm) < 8:
        return gate_mm
    return min(gate_mm, max(4.5 * float(np.median(size_mm)), gate_mm / 10))


def _misfit(kept: NDArray[np.intp], camera_mm: Array, up_mm: Array, sigma_mm: Array, turn: Array) -> float:
    return fit_frame(camera_mm[kept], up_mm[kept], sigma_mm[kept], turn).chi_square
