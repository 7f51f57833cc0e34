"""Least-squares matching of round targets: a blurred ellipse is fitted to the scan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, fdtrc

from measure.array_types import Array
from measure.flags import DISK_UNLIKE_THE_OTHERS, LARGE_ERROR, NO_REASON, Cause, Code, Reason
from measure.geometry import linear_scale
from measure.marks.rendering import mark_window
from measure.marks.shapes import Disk, MarkShape
from measure.matching.match import match
from measure.matching.models import GREY, MatchOptions
from measure.matching.window import read_window
from measure.noise.grain import BESIDE_PX
from measure.noise.noise_model import may_be_noise
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY, SIGMA_OF_DEVIATION
from measure.results import MarkFit, largest_sigma_px
from measure.scans.jpeg import covariance_of_compression
from measure.scans.scan import Scan
from measure.targets.block_search import Patches, ScanBlock, TargetCandidate
from measure.targets.detection import LEAST_SNR
from measure.targets.disk_fit_batch import (
    LEAST_MARGIN_PX,
    MARGIN,
    SMOOTH,
    WORST_MISFIT,
    WORST_SMOOTH_MISFIT,
    place_disks,
)

UNIT_DISK = MarkShape((Disk((0.0, 0.0), 1.0),))
# Background used around a disk.
_LONGEST_MARGIN_PX = 10.0  # a wider one only adds disturbances
_NARROWEST_MARGIN_PX = 1.5  # even beside a close neighbour: a narrower one holds no background pixel
PLAIN_MARGIN_PX = 7.0  # on a plain background: a tenth less noise than with the narrow margin
_MARGIN_BLURS = 4.0  # in a soft scan, standard deviations of the blur, as for other marks
_LEAST_REACH_PX = 5.5  # from the centre: within less, the size and the blur of a small disk are not separable
# Starting values and their uncertainty.
_LEAST_SHIFT_PX = 2.0  # a small disk may have been detected this far off
_FORM_SIGMA = 0.2  # standard deviation of the initial size and shear
# Decisions.
_PLAIN_SNR = 10.0  # contrast over noise of a disk that needs no closer look
SMALLEST_RADIUS_PX = 1.2  # shorter half axis below which blur and size are not separable
_SMALL_RADIUS_PX = 2.0  # shorter half axis below which a lone disk cannot be told from dust
_WEAK_DAMAGE, _MOST_DAMAGE = 0.2, 0.35  # fraction of pixels that do not fit a disk
_MOST_BLUR = 0.7  # in shorter half axes
_SURE, _MOST_FAINTER = 3.0, 0.5  # upper bound of the contrast: standard deviations added, at most this share of it
_LARGE_PX = 0.3  # a small target with a larger error must not pass
_FEWEST = 8  # targets needed to estimate how much they differ
_DUST_PX = 4.0  # shorter half axis up to which dust can pass for a disk or hide its edge: dust is seldom larger
_SPREADS = 2.0  # degrees of freedom per disk of the pooled spread of five figures; from rendered disks without dust
_OUTLYING = 3.0  # standard deviations from the median beyond which a disk is left out of the mean appearance
_LEAST_SPREAD = 1e-4  # variance of 1 %: no frame's targets are more alike, nor is the linearisation more exact


@dataclass(frozen=True, eq=False)
class FittedDisk(MarkFit):
    """A fitted ellipse: the fit of a unit disk. reason: why it is no disk; weakness: why it is doubtful."""

    weakness: Reason = NO_REASON

    @property
    def pixel_from_disk(self) -> Array:
        """(2, 2) image of the unit disk; the columns are two radius vectors, px."""
        return self.pixel_from_mark[:, :2]

    @property
    def appearance_covariance(self) -> Array:
        """(5, 5) of the relative changes in size, stretch along the columns, shear and contrast, and of the blur's
        variance, px²; unknown of disks fitted in batches."""
        assert self.covariance is not None
        gain = len(self.covariance) - GREY
        figures = [2, 3, 4, gain, gain - 1]
        per = np.array([1.0, 1.0, 1.0, self.contrast_dn or 1.0, 1.0])
        return np.asarray(self.covariance[np.ix_(figures, figures)] / np.outer(per, per))

    @property
    def half_axes_px(self) -> Array:
        """(2,) longer and shorter half axis."""
        return np.asarray(np.linalg.svd(self.pixel_from_disk, compute_uv=False))

    @property
    def is_fitted(self) -> bool:
        """Whether the fit ended with a covariance, disk or not."""
        return bool(np.all(np.isfinite(self.covariance_px2)))

    @property
    def is_soft(self) -> bool:
        """Whether the fitted edge is as soft as that of a spot without an edge."""
        return bool(self.is_fitted and self.blur_px > _MOST_BLUR * self.half_axes_px[1])

    @property
    def is_mostly_damaged(self) -> bool:
        """Whether too few of the pixels around it fit a disk."""
        return bool(self.is_fitted and self.damaged_fraction > _MOST_DAMAGE)

    @property
    def dust_reason(self) -> Reason:
        """Why a disk that cannot be compared with others may be dust or a spot; empty if it is neither small nor
        soft."""
        shorter = self.half_axes_px[1]
        if shorter < _SMALL_RADIUS_PX:
            message = f"small: half axis {shorter:.1f} px, dust of its size would look the same"
            return Reason(message, Code.SMALL, Code.DUST)
        if not self.is_soft:
            return NO_REASON
        message = f"its edge is as soft as a spot's: blur {self.blur_px:.1f} px, half axis {shorter:.1f} px"
        return Reason(message, Code.BLUR, Code.DUST)

    @property
    def quality(self) -> dict[str, float]:
        """Quality figures by column name of comparator.csv."""
        longer, shorter = self.half_axes_px
        return {
            "snr": abs(self.contrast_dn) / max(self.noise_dn, 1e-9),
            "contrast_dn": self.contrast_dn,
            "noise_dn": self.noise_dn,
            "blur_px": self.blur_px,
            "damaged_fraction": self.damaged_fraction,
            "longer_half_axis_px": float(longer),
            "shorter_half_axis_px": float(shorter),
        }


def fit_disk(
    scan: Scan,
    center_px: Array,
    pixel_from_disk: Array,
    longest_margin_px: float = _LONGEST_MARGIN_PX,
    shape: MarkShape = UNIT_DISK,
) -> FittedDisk:
    """Fit a blurred ellipse.

    Parameters
    ----------
    center_px : (2,) approximate centre.
    pixel_from_disk : (2, 2) approximate form, right to 20 % or so.
    longest_margin_px : width of the background that may be used, less where a neighbour is near.
    shape : another drawing of radius 1 to fit in place of the disk, with its rotation.

    Returns
    -------
    The fit. Where it fails, or shows that there is no disk, it has a reason; the image content never raises an error.
    """
    start = np.column_stack([pixel_from_disk, center_px])
    radius = linear_scale(pixel_from_disk)
    sure = max(MARGIN * radius, LEAST_MARGIN_PX, _LEAST_REACH_PX - radius)
    sure = max(min(sure, longest_margin_px, _LONGEST_MARGIN_PX), _NARROWEST_MARGIN_PX)
    wide = max(sure, min(PLAIN_MARGIN_PX, longest_margin_px))
    options = MatchOptions(
        freedom="ellipse" if shape is UNIT_DISK else "affine",
        margin_px=wide,
        margin_blurs=0.0,
        plain_px=sure,
        max_shift_px=max(radius, _LEAST_SHIFT_PX),
        linear_sigma=_FORM_SIGMA,
        strain_sigma=_FORM_SIGMA,
    )
    window = read_window(scan, mark_window(shape, start, wide + BESIDE_PX))

    def fit_with_margin(margin_px: float) -> FittedDisk:
        fit = match(window, shape, start, replace(options, margin_px=margin_px))
        return _assess(fit, covariance_of_compression(scan.quantisation_step_dn, fit.stored_contrast_dn))

    disk = fit_with_margin(wide)
    soft = min(_MARGIN_BLURS * disk.blur_px, longest_margin_px)
    # With less background than the blur reaches, blur, size and contrast may diverge together.
    if soft > wide and not (disk.reason and disk.is_fitted):
        softer = fit_with_margin(soft)
        disk = disk if softer.reason else softer
    # A narrow pad or a ring around the disk is not damage; dust is. The wider margin shows dust and soft edges better:
    # a disk that passes only with the narrow margin, and at another place, may be the dust itself.
    if not disk.reason or disk.is_soft or not sure < wide:
        return disk
    narrow = fit_with_margin(sure)
    if narrow.reason or not disk.is_mostly_damaged:
        return narrow
    agree = may_be_noise(narrow.center_px - disk.center_px, narrow.covariance_px2 + disk.covariance_px2)
    return narrow if agree else replace(narrow, weakness=disk.reason.reword(f"with more ground: {disk.reason}"))


def fit_plain_disks(
    scan: Scan, candidates: Sequence[TargetCandidate], longest_margins_px: Sequence[float]
) -> list[FittedDisk]:
    """Fit disks all at once, ten times as fast as `fit_disk`; doubtful ones are fitted again by that.

    longest_margins_px : see `fit_disk`, of each.
    """
    patches = Patches.collect(candidates)
    margins_px = np.clip(longest_margins_px, _NARROWEST_MARGIN_PX, PLAIN_MARGIN_PX)
    reach_px = int(np.ceil(np.linalg.norm(patches.shapes, 2, axis=(1, 2)).max(initial=0) + PLAIN_MARGIN_PX)) + 1
    col0, row0 = np.floor(patches.centers.min(axis=0)).astype(int) - reach_px
    width, height = np.ceil(patches.centers.max(axis=0)).astype(int) + reach_px - (col0, row0)
    block = ScanBlock(scan, (int(col0), int(row0)), 0, scan.samples(int(col0), int(row0), int(width), int(height)))
    placed, disks = place_disks(block, patches, margins_px), []
    for fit, start, margin_px in zip(placed, candidates, longest_margins_px, strict=True):
        disk = _assess(fit, covariance_of_compression(scan.quantisation_step_dn, fit.contrast_dn))
        stands_out = abs(disk.contrast_dn) > _PLAIN_SNR * disk.noise_dn
        if not stands_out or disk.reason or disk.weakness or disk.dust_reason:
            disk = fit_disk(scan, start.center_px, start.pixel_from_disk, margin_px)
        disks.append(disk)
    return disks


def _assess(fit: MarkFit, compression_px2: Array) -> FittedDisk:
    """Convert a fit to a disk, with a reason or weakness where its figures give one. Correlated residuals show that the
    window holds something else."""
    covariance = fit.place_covariance.plus(Cause.COMPRESSION, compression_px2)
    disk = FittedDisk(**{**vars(fit), "place_covariance": covariance})
    if disk.reason:
        return disk
    reason = weakness = NO_REASON
    contrast, (_, shorter) = abs(disk.contrast_dn), disk.half_axes_px
    most = contrast
    if fit.covariance_is_white:  # pure noise, which also disturbs the contrast: its upper bound decides
        most *= 1 + min(_SURE * float(np.sqrt(disk.appearance_covariance[3, 3])), _MOST_FAINTER)
    worst = WORST_SMOOTH_MISFIT if fit.neighbour_correlation > SMOOTH else WORST_MISFIT
    if not disk.is_fitted or most < LEAST_SNR * disk.noise_dn:
        message = f"no disk stands out: contrast {contrast:.0f}, noise {disk.noise_dn:.0f} grey values"
        reason = Reason(message, Code.CONTRAST)
    elif disk.noise_dn > worst * contrast and not fit.covariance_is_white:
        message = f"no disk: the residuals of a fitted disk are {100 * disk.noise_dn / contrast:.0f} % of its contrast"
        reason = Reason(message, Code.LIKENESS)
    elif disk.is_mostly_damaged:
        message = f"{100 * disk.damaged_fraction:.0f} % of the pixels about it do not fit a disk"
        reason = Reason(message, Code.COVERED)
    elif shorter < SMALLEST_RADIUS_PX:
        reason = Reason(f"too small: half axis {shorter:.1f} px", Code.SMALL)
    elif disk.damaged_fraction > _WEAK_DAMAGE:
        message = f"{100 * disk.damaged_fraction:.0f} % of the pixels about it are damaged"
        weakness = Reason(message, Code.COVERED)
    return replace(disk, reason=reason, weakness=weakness)


def dust_reasons(disks: Sequence[FittedDisk], predicted: Sequence[Array]) -> list[Reason]:
    """Test each disk of a scan for dust, by comparison with the others.

    Parameters
    ----------
    disks : fitted disks. Fewer than eight do not show how much targets differ: each is then judged alone.
    predicted : (2, 2) predicted pixel_from_disk of each, right up to a common factor.

    Returns
    -------
    Reason why each disk may be dust or disturbed by it. Empty for a disk that is too large for dust and not soft, or
    that is precise and resembles the others.

    Notes
    -----
    Dust on a small disk may leave no visible residual: it changes the fitted size, form, contrast, blur or grey-value
    slope instead. Each disk's appearance is therefore tested against the others' mean, with the covariance of its fit
    and the robustly estimated spread of the targets themselves.
    """
    if len(disks) < _FEWEST:
        return [disk.dust_reason for disk in disks]
    appearances = np.array([_appearance(disk, shape) for disk, shape in zip(disks, predicted, strict=True)])
    noise = np.array([disk.appearance_covariance for disk in disks])
    variances = np.einsum("nii->ni", noise)
    off = appearances - np.median(appearances, axis=0)
    between = (SIGMA_OF_DEVIATION * np.median(np.abs(off), axis=0)) ** 2 - np.median(variances, axis=0)
    spread = np.maximum(between, _LEAST_SPREAD)
    spread[1:3] = spread[1:3].mean()  # stretch and shear have one
    weights = (np.abs(off) < _OUTLYING * np.sqrt(spread + variances)) / (spread + variances)
    off -= (weights * off).sum(axis=0) / weights.sum(axis=0)
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(noise + np.diag(spread)), off)
    return [
        _dust_reason(disk, own, float(square), len(disks))
        if disk.is_soft or disk.half_axes_px[1] < _DUST_PX
        else NO_REASON
        for disk, own, square in zip(disks, off, squares, strict=True)
    ]


def _dust_reason(disk: FittedDisk, off: Array, squares: float, count: int) -> Reason:
    """Test one small or soft disk. off (5,): its appearance minus the mean; squares: Mahalanobis distance of off,
    squared; count: number of disks. The slope of its grey values adds two independent degrees of freedom."""
    slopes = 0.0 if disk.sloping is None else disk.sloping.sigmas**2
    figures = len(off) + (0 if disk.sloping is None else 2)
    if fdtrc(figures, _SPREADS * MEDIAN_EFFICIENCY * count, (squares + slopes) / figures) < DISK_UNLIKE_THE_OTHERS:
        size, *form, contrast, variance = off
        return Reason(
            f"not like the other targets: {np.exp(size):.2f} times their size, {np.exp(contrast):.2f} times their "
            f"contrast, its form {100 * np.hypot(*form):.0f} % off, its blur by {variance:.1f} px²; dust may hide in "
            "it",
            Code.DUST,
        )
    sigma = largest_sigma_px(disk.covariance_px2)
    if chdtrc(2, (_LARGE_PX / sigma) ** 2) > LARGE_ERROR:
        message = (
            f"its standard deviation is {sigma:.2f} px, the largest part from {disk.place_covariance.largest.shown}"
        )
        return Reason(message, Code.IMPRECISE)
    return NO_REASON


def _appearance(disk: FittedDisk, predicted: Array) -> Array:
    """(5,) logarithms of size, stretch, shear and contrast, and the blur's variance, px². The first three are those of
    the symmetric matrix that maps the predicted ellipse to the fitted one."""
    root = _root(predicted @ predicted.T)
    inverse = np.linalg.inv(root)
    change = inverse @ _root(root @ disk.pixel_from_disk @ disk.pixel_from_disk.T @ root) @ inverse
    values, vectors = np.linalg.eigh(change)
    log = (vectors * np.log(values)) @ vectors.T
    size, stretch, shear = (log[0, 0] + log[1, 1]) / 2, (log[0, 0] - log[1, 1]) / 2, log[0, 1]
    return np.array([size, stretch, shear, np.log(abs(disk.contrast_dn)), disk.blur_px**2])


def _root(matrix: Array) -> Array:
    """Square root of a symmetric positive-definite matrix (2, 2)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(values)) @ vectors.T)
