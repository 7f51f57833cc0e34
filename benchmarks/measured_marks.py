"""True marks drawn on a ground, spoilt, and measured as `reseau measure` does; cells of a table of their errors."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from true_marks import KIND, TrueMark, scan_of, some_mark

from measure.disks import PLAIN_MARGIN_PX, fit_disk
from measure.fiducial_options import FiducialOptions
from measure.frame import CLEAR_DAMAGE
from measure.matching import match
from measure.prediction import MarkPrediction
from measure.refinement import sight
from measure.status import Status
from measure.targets import TargetPrediction, measure_disks
from synthetic_images.optics import reach_px, seen_coverage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GROUND, CONTRAST = 25000.0, 15000.0
SHIFT_PX, SEARCH_PX = 1.5, 3.0  # of the start, and the radius of the search
DUST_SNR = 20.0


@dataclass(frozen=True, eq=False)
class Found:
    """A place with its covariance; flagged: `weak`, or not measured at all."""

    center_px: Array
    covariance_px2: Array
    flagged: str = ""


@dataclass
class Cell:
    """What became of the marks of one cell: errors (2,) with the covariances claimed, and beside each the error of the
    best linear estimate in the very same noise with its bound."""

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
        """rms over the bound.

        The mean square of an unbiased estimate's errors is the bound, and that of their difference to the best
        estimate's, with which it does not correlate (Gauss and Markov): a few marks so show what hundreds would.
        """
        return float(np.sqrt(1 + np.square(self._beyond).sum() / np.trace(self.bounds, axis1=1, axis2=2).sum()))

    @property
    def to_claimed(self) -> float:
        """rms in units of the standard deviations claimed, likewise."""
        weights = np.linalg.inv(self.covariances)
        squares = np.einsum("nij,nij->n", weights, self.bounds)
        squares += np.einsum("ni,nij,nj->n", self._beyond, weights, self._beyond)
        return float(np.sqrt(np.mean(squares) / 2))

    @property
    def _beyond(self) -> Array:
        return np.subtract(self.errors, self.best)

    def words(self) -> str:
        if not self.errors:
            return f"{'all lost':>14}"
        lost = f"-{self.lost}" if self.lost else ""
        return f"{self.to_bound:7.3f} {self.to_claimed:5.3f}{lost:<4}"


def measured(
    mark: TrueMark,
    grey: Array,
    rng: np.random.Generator,
    full_scale: int = 65535,
    exact: bool = False,
    step_dn: float = 0.0,
) -> Found | None:
    """The mark as the program measures it, from a start off by some px, and by 0.3 % and 3 mrad or, exact, no more than
    0.001 % where the frame gives these."""
    scan = scan_of(grey, full_scale, step_dn)
    center = mark.place[:, 2] + rng.uniform(-SHIFT_PX, SHIFT_PX, 2)
    if mark.kind.name == "ellipse":
        disk = fit_disk(scan, mark.place[:, 2] + rng.normal(0, 0.4, 2), mark.place[:, :2] * rng.uniform(0.9, 1.1))
        return None if disk.reason else Found(disk.center_px, disk.covariance_px2, disk.weakness)
    scale, turn = rng.normal(0, min(mark.kind.known * (0.1 if exact else 1), 0.003), 2)
    start = np.column_stack([np.array([[1 + scale, -turn], [turn, 1 + scale]]) @ mark.place[:, :2], center])
    polarity = 1 if grey_is_light(mark, grey) else -1
    frame_sigma = mark.kind.known if np.isfinite(mark.kind.known) else None
    options = FiducialOptions().match
    fit = sight(scan, MarkPrediction(mark.kind.shape, start, SEARCH_PX, polarity), options, frame_sigma).fit
    if fit is None:
        return None
    return Found(fit.center_px, fit.covariance_px2, "damaged" if fit.damaged_fraction > CLEAR_DAMAGE else "")


def grey_is_light(mark: TrueMark, grey: Array) -> bool:
    return float((grey * (mark.picture - mark.picture.mean())).sum()) > 0


def drawn(
    mark: TrueMark, rng: np.random.Generator, contrast: float = CONTRAST, ground: float = GROUND
) -> tuple[Array, int]:
    """The mark, light (1) or dark (-1), on a ground with a gradient of up to a third of its contrast."""
    sign, direction = int(rng.choice((-1, 1))), rng.uniform(0, 2 * np.pi)
    row, col = np.mgrid[: mark.size, : mark.size] / mark.size - 0.5
    slope = contrast / 3 * rng.uniform() * (np.cos(direction) * col + np.sin(direction) * row)
    return ground + (1 - sign) / 2 * contrast + slope + sign * contrast * mark.picture, sign


def told(mark: TrueMark, grey: Array, seen: Mask) -> Found | None:
    """The mark matched where it is seen, the dust being known."""
    options = FiducialOptions().match
    if mark.kind.name == "ellipse":
        options = replace(options, freedom="ellipse", margin_px=PLAIN_MARGIN_PX, margin_blurs=0.0)
    elif np.isfinite(mark.kind.known):
        options = replace(options, linear_sigma=mark.kind.known)
    fit = match(np.rint(grey), (0.0, 0.0), mark.kind.shape, mark.place, options, seen)
    return Found(fit.center_px, fit.covariance_px2) if fit.converged else None


def dusty(mark: TrueMark, grey: Array, share: float, rng: np.random.Generator) -> tuple[Array, Mask]:
    """The picture with dark specks on so much of the pixels near the mark, and which pixels they leave."""
    speckled, seen = grey.copy(), np.ones(grey.shape, dtype=bool)
    rows, cols = np.nonzero(mark.near)
    while (mark.near & ~seen).sum() < share * mark.near.sum():
        radius = min(float(rng.lognormal(0.3, 0.5)), 4.0) * rng.uniform(0.7, 1.3, 12)
        angle = np.arange(12) * (2 * np.pi / 12)
        pixel = rng.integers(len(rows))
        outline = np.array([cols[pixel], rows[pixel]]) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        reach = 6 + reach_px(mark.blur_px)
        col0, row0 = max(cols[pixel] - reach, 0), max(rows[pixel] - reach, 0)
        near = np.s_[row0 : rows[pixel] + reach, col0 : cols[pixel] + reach]
        height, width = speckled[near].shape
        cover = seen_coverage(((outline,),), int(col0), int(row0), width, height, mark.blur_px)
        speckled[near] = speckled[near] * (1 - cover) + (GROUND - CONTRAST) * cover
        seen[near] &= cover < 0.5 / DUST_SNR
    return speckled, seen


def dusty_frame(rng: np.random.Generator) -> tuple[Array, Mask, Array]:
    """A frame of 25 disks, all light or all dark, their contrasts alike to 5 %, their blur, of 0.6 to 1.4 px, to 10 %,
    and their forms predicted to 2 % but for a common scale: errors in px, nan where one was refused, which are flagged,
    and how much dust is on each."""
    tile, snr, sign, scale = 81, rng.uniform(10, 50), rng.choice((-1, 1)), rng.uniform(0.9, 1.1)
    blur = rng.uniform(0.6, 1.4)
    ground = GROUND + (1 - sign) / 2 * CONTRAST
    frame, places, predictions = np.empty((5 * tile, 5 * tile)), [], []
    dusts = rng.choice((0.0, 0.01, 0.03, 0.05), 25)
    for number, share in enumerate(dusts):
        mark = some_mark(KIND["ellipse"], blur * np.exp(rng.normal(0, 0.1)), rng, tile, 10 * rng.uniform(2.0, 4.0) / 6)
        contrast = CONTRAST * np.exp(rng.normal(0, 0.05))
        grey = ground + sign * contrast * mark.picture + CONTRAST / snr * rng.standard_normal((tile, tile))
        corner = tile * np.array(divmod(number, 5)[::-1])
        frame[corner[1] :, corner[0] :][:tile, :tile] = dusty(mark, grey, float(share), rng)[0]
        form = scale * (np.eye(2) + rng.normal(0, 0.02, (2, 2))) @ mark.place[:, :2]
        places.append(corner + mark.place[:, 2])
        predictions.append(TargetPrediction(str(number), places[-1] + rng.normal(0, 0.4, 2), form, 3.0))
    marks = measure_disks(scan_of(frame), predictions)
    offs = [
        np.hypot(*(np.asarray(mark.center_px) - place)) if mark.status.is_observation else np.nan
        for mark, place in zip(marks, places, strict=True)
    ]
    return np.array(offs), np.array([mark.status is not Status.MEASURED for mark in marks]), dusts
