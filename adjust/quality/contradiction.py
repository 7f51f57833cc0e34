"""Whether the images contradict what was observed together beside them, an earlier calibration say, and in what.

Its quantities are correlated, and each by itself may pass where all together do not. With C = L L' their covariance,
v their residuals and S = I - H (see `adjust.quality.residuals`), the others put them at observed + d, d = L S^+ L^-1 v,
with the covariance L S^+ L'; and u' S^+ u, u = L^-1 v, is chi-square with as many degrees of freedom as S has rank:
the test of a block of errors (Baarda 1968; Förstner and Wrobel, Photogrammetric Computer Vision, 4.6.4).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from adjust.array_types import Array, Mask
from adjust.problem.further_observations import ObservedCalibration
from adjust.problem.parameter import Parameter
from adjust.quality.residuals import surplus
from adjust.quality.run import Run

UNSEEN = 1e-6  # part of a direction's variance: where the others say so little, they say nothing


@dataclass(frozen=True, eq=False)
class CalibrationTest:
    """What the images say against observations that are correlated, as an earlier calibration's quantities are.

    parameters (m,); difference (m,): where the images put each less where it was observed, with the a-posteriori sigma
    (m,) of that; nan and inf where the images do not tell it. statistic: of all together, F with freedom and the other
    observations' redundancy; probability: of as much where they do not contradict each other.
    """

    group: str
    parameters: tuple[Parameter, ...]
    difference: Array
    sigma: Array
    statistic: float
    freedom: int
    probability: float

    @property
    def direction(self) -> tuple[int, ...]:
        """The quantities by number, those first in which both differ most in standard deviations of their own."""
        size = np.where(np.isfinite(self.difference), np.abs(self.difference) / self.sigma, 0.0)
        return tuple(np.argsort(-size, kind="stable").tolist())


def calibration_tests(run: Run, sigma0: float, redundancy: float) -> Iterator[CalibrationTest]:
    """Of every earlier calibration of several quantities; sigma0, redundancy: of the whole adjustment."""
    vpv = sigma0**2 * redundancy
    for each, block in zip(run.problem.further, run.end.rows.further, strict=True):
        if not isinstance(each, ObservedCalibration) or len(each.observed) < 2:
            continue
        root = np.linalg.cholesky(each.covariance)
        free, directions = np.linalg.eigh(surplus(block, run.factor))
        visible = free > UNSEEN
        freedom = int(visible.sum())
        if not freedom:
            continue
        u = directions.T @ np.linalg.solve(root, each.computed(run.end.state.values) - each.observed)
        chi_square = float((u[visible] ** 2 / free[visible]).sum())
        left = round(redundancy) - freedom
        variance = (vpv - chi_square) / left if left > 0 and vpv > chi_square else 1.0
        along = _as_marks_show(root @ directions, ~visible, each.parameters)
        difference = along[:, visible] @ (u[visible] / free[visible])
        sigma = np.sqrt(variance * (along[:, visible] ** 2 / free[visible]).sum(axis=1))
        hidden = (along[:, ~visible] ** 2).sum(axis=1) > UNSEEN * np.diag(each.covariance)
        test = chi_square / freedom / variance
        yield CalibrationTest(
            group=each.group,
            parameters=each.parameters,
            difference=np.where(hidden, np.nan, difference),
            sigma=np.where(hidden, np.inf, sigma),
            statistic=test,
            freedom=freedom,
            probability=float(fdtrc(freedom, left, test) if left > 0 else chdtrc(freedom, chi_square)),
        )


def _as_marks_show(along: Array, unseen: Mask, parameters: Sequence[Parameter]) -> Array:
    """Changes (n, m) of the quantities, each with so much of the unseen ones that the fiducial marks move least.

    The frame of the marks can shift, turn and grow, and the camera with it: as where two calibrations are compared,
    what is told of c is then what changes beside the marks. What marks do not show of the unseen changes stays.
    """
    is_mark = np.array([each.kind == "fiducial" for each in parameters])
    by_marks = np.linalg.pinv(along[:, unseen] * is_mark[:, None], rcond=UNSEEN)
    return np.asarray(along - along[:, unseen] @ (by_marks @ along))
