"""Compatibility test of the images against correlated prior observations, such as an earlier calibration.

Each quantity may pass by itself where all together do not. With C = L L' their covariance, v their residuals and
S = I - H (see `adjust.quality.residuals`), the other observations determine them as observed + d, d = L S^+ L^-1 v,
with the covariance L S^+ L'. The statistic u' S^+ u, u = L^-1 v, is chi-square with the rank of S as its degrees of
freedom: the test of a block of errors (Baarda 1968; Förstner and Wrobel, Photogrammetric Computer Vision, 4.6.4).
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

UNSEEN = 1e-6  # least redundancy of a direction that the other observations determine


@dataclass(frozen=True, eq=False)
class CalibrationTest:
    """Compatibility test of the images with correlated observations.

    Attributes
    ----------
    parameters : (m,).
    difference, sigma : (m,) value from the images minus observed value, and its a-posteriori standard deviation; nan
        and inf where the images do not determine it.
    statistic : of all together, F with `freedom` and the redundancy of the other observations.
    probability : p-value.
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
        """Indices of the quantities, sorted by the difference in standard deviations, the largest first."""
        size = np.where(np.isfinite(self.difference), np.abs(self.difference) / self.sigma, 0.0)
        return tuple(np.argsort(-size, kind="stable").tolist())


def calibration_tests(run: Run, sigma0: float, redundancy: float) -> Iterator[CalibrationTest]:
    """Test every earlier calibration of several quantities; sigma0, redundancy: of the whole adjustment."""
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
    """Combine changes (n, m) of the quantities with undetermined ones such that the fiducial marks move least.

    The frame of the marks can shift, rotate and scale together with the camera. As in a comparison of two calibrations,
    the reported change of c is then the one relative to the marks.
    """
    is_mark = np.array([each.kind == "fiducial" for each in parameters])
    by_marks = np.linalg.pinv(along[:, unseen] * is_mark[:, None], rcond=UNSEEN)
    return np.asarray(along - along[:, unseen] @ (by_marks @ along))
