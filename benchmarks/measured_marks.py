"""Synthetic marks rendered on a background and measured as by `reseau measure`; table cells of their errors."""

from dataclasses import dataclass, field

import numpy as np
from drawn import make_scan
from numpy.typing import NDArray
from true_marks import ALL_MOVES, TrueMark

from measure.detection.localisation import MarkPrediction
from measure.fiducials.mark_fit import detect_mark
from measure.fiducials.measure_frame import CLEAR_DAMAGE
from measure.fiducials.options import FiducialOptions
from measure.flags import Cause
from measure.targets.disks import fit_disk

Array = NDArray[np.float64]

GROUND, CONTRAST = 25000.0, 15000.0
SHIFT_PX, SEARCH_PX = 1.5, 3.0  # px, error of the start, and radius of the search


@dataclass(frozen=True, eq=False)
class Found:
    """Measured place with its covariance. flagged: reason if `weak` or not measured, "" otherwise; model_misfit_px2:
    covariance of the cause model misfit."""

    center_px: Array
    covariance_px2: Array
    flagged: str = ""
    model_misfit_px2: Array = field(default_factory=lambda: np.zeros((2, 2)))


@dataclass
class Cell:
    """Results of the marks of one table cell.

    errors, covariances: (2,) errors and claimed covariances; best, bounds: errors of the best linear estimate from the
    same noise, and its covariance, the bound; lost: number of marks not measured.
    """

    errors: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    best: list[Array] = field(default_factory=list)
    bounds: list[Array] = field(default_factory=list)
    lost: int = 0

    def add(self, mark: TrueMark, found: Found | None, best: Array, bound: Array) -> None:
        if found is None or found.flagged:
            self.lost += 1
            return
        self.errors.append(found.center_px - mark.place[:, 2])
        self.covariances.append(found.covariance_px2)
        self.best.append(best)
        self.bounds.append(bound)

    @property
    def to_bound(self) -> float:
        """RMS error over the bound.

        The mean square error of an unbiased estimate is the bound plus the mean square of its difference from the best
        estimate, with which that difference is uncorrelated (Gauss and Markov). With this control variate a few marks
        are as precise as hundreds.
        """
        return float(np.sqrt(1 + np.square(self._beyond).sum() / np.trace(self.bounds, axis1=1, axis2=2).sum()))

    @property
    def to_claimed(self) -> float:
        """RMS error in units of the claimed standard deviations.

        The mean square of the best estimate's errors in units of their bound is 1. It serves as a control variate: only
        the difference of both mean squares in the same noise is estimated. The claimed covariance also varies with the
        noise, and is correlated with the errors: a contrast estimated too high makes both smaller.
        """
        return float(
            np.sqrt(1 + np.mean(_squares(self.errors, self.covariances) - _squares(self.best, self.bounds)) / 2)
        )

    @property
    def _beyond(self) -> Array:
        return np.subtract(self.errors, self.best)

    def words(self) -> str:
        if not self.errors:
            return f"{'all lost':>14}"
        lost = f"-{self.lost}" if self.lost else ""
        return f"{self.to_bound:7.3f} {self.to_claimed:5.3f}{lost:<4}"


def _squares(errors: list[Array], covariances: list[Array]) -> Array:
    """(n,) squared Mahalanobis distances of errors."""
    return np.asarray(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors))


def start_off(mark: TrueMark, rng: np.random.Generator, exact: bool = False) -> Array:
    """(n,) errors of the first of `ALL_MOVES` in the start of a match: scale and rotation with sigmas of 0.3 % and
    3 mrad or, if they are given by the frame, all four with its sigma; exact: a tenth of that."""
    moves = len(mark.kind.unknown) if np.isfinite(mark.kind.known) else 2
    return np.asarray(rng.normal(0, min(mark.kind.known * (0.1 if exact else 1), 0.003), moves))


def best_errors(mark: TrueMark, noise: Array, sigma: float, off: Array, correlation: Array | None = None) -> Array:
    """(2,) errors of the best linear estimate from the same noise (size, size), contrast 1, and the frame's priors."""
    return mark.best_errors(noise, sigma, None, correlation, off if np.isfinite(mark.kind.known) else None)


def measure_mark(
    mark: TrueMark,
    grey: Array,
    rng: np.random.Generator,
    full_scale: int = 65535,
    step_dn: float = 0.0,
    off: Array | None = None,
) -> Found | None:
    """Measure a mark by the program's functions, from a start with an error of up to SHIFT_PX, and off (n,) from
    `start_off`."""
    scan = make_scan(grey, full_scale, step_dn)
    center = mark.place[:, 2] + rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
    if mark.kind.name == "ellipse":
        disk = fit_disk(scan, mark.place[:, 2] + rng.normal(0, 0.4, 2), mark.place[:, :2] * rng.uniform(0.9, 1.1))
        return None if disk.reason else Found(disk.center_px, disk.covariance_px2, disk.weakness)
    off = start_off(mark, rng) if off is None else off
    change = np.tensordot(off, np.reshape(ALL_MOVES[: len(off)], (-1, 2, 2)), 1)
    start = np.column_stack([(np.eye(2) + change) @ mark.place[:, :2], center])
    polarity = 1 if grey_is_light(mark, grey) else -1
    frame_sigma = mark.kind.known if np.isfinite(mark.kind.known) else None
    options = FiducialOptions().match
    fit = detect_mark(scan, MarkPrediction(mark.kind.shape, start, SEARCH_PX, polarity), options, frame_sigma).fit
    if fit is None:
        return None
    model_misfit_px2 = fit.place_covariance.parts.get(Cause.MODEL_MISFIT, np.zeros((2, 2)))
    flagged = "damaged" if fit.damaged_fraction > CLEAR_DAMAGE else ""
    return Found(fit.center_px, fit.covariance_px2, flagged, model_misfit_px2)


def grey_is_light(mark: TrueMark, grey: Array) -> bool:
    return float((grey * (mark.picture - mark.picture.mean())).sum()) > 0


def draw_mark(
    mark: TrueMark, rng: np.random.Generator, contrast: float = CONTRAST, ground: float = GROUND
) -> tuple[Array, int]:
    """Render a mark, light (1) or dark (-1), on a background with a gradient of up to a third of its contrast; returns
    the image and the sign."""
    sign, direction = int(rng.choice((-1, 1))), rng.uniform(0, 2 * np.pi)
    row, col = np.mgrid[: mark.size, : mark.size] / mark.size - 0.5
    slope = contrast / 3 * rng.uniform() * (np.cos(direction) * col + np.sin(direction) * row)
    return ground + (1 - sign) / 2 * contrast + slope + sign * contrast * mark.picture, sign
