"""Least-squares matching of round targets: a blurred ellipse is fitted to the scan, singly or many at once.

Many image patches are tested for disks by a few Gauss-Newton steps of `gain * Phi(distance / blur) + offset + slopes`.
The outline of a patch is right to a few per cent; four steps from there localise a disk to a tenth of a pixel, and the
residuals tell disks from image content. The model takes the edge as straight within the blur, which changes the size by
a few hundredths of a pixel and not the centre.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtr

from measure.array_types import Array, Indices, Mask, Single
from measure.flags import DISK_UNLIKE_THE_OTHERS, LARGE_ERROR, NO_REASON, Cause, Code, Reason
from measure.geometry import linear_scale
from measure.marks.rendering import mark_window
from measure.marks.shapes import Disk, MarkShape
from measure.matching.gauss_newton import FitModel, gauss_newton
from measure.matching.match import match
from measure.matching.models import GREY, PIXEL_VARIANCE_PX2, MatchOptions
from measure.matching.window import read_window
from measure.noise.noise_model import BESIDE_PX, influence_covariances, may_be_noise
from measure.noise.robust_estimation import (
    MEDIAN_EFFICIENCY,
    SIGMA_OF_DEVIATION,
    gauss_newton_step,
    place_influences,
    tukey_weights,
)
from measure.results import Covariance, MarkFit, largest_sigma_px
from measure.scans.jpeg import covariance_of_compression
from measure.scans.scan import Scan
from measure.targets.block_search import Patches, ScanBlock, TargetCandidate, concatenate

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
LEAST_SNR = 4.0  # of a disk that is measured
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
_GROUP_PIXELS = 1 << 16  # pixels of the windows that are fitted together: 10 MiB with their derivatives
_FIRST_BLUR_PX, _BLUR_PX = 1.0, (0.5, 8.0)  # initial value and limits, standard deviations, pixel width included
_HOPELESS = 1.5  # times the allowed misfit: patches above it are dropped before the first step
_LONGEST_STEP = 0.3  # in radii: the limit of linearisation
_PLAIN_STEPS, _MOST_STEPS, _SETTLED_PX = 2, 30, 1e-3  # first ones, and all of a fit to convergence
_UNDAMAGED = 0.05  # robust weight below which a pixel shows something else
_DAMPING = 1e-4  # the unknowns of a faint disk are nearly dependent
_UNKNOWNS = 10  # place (2), size, stretch, shear, blur, gain, offset, slopes (2)
_NO_DISK = Reason("no disk explains the picture there", Code.LIKENESS)
_SCALE_FLOOR = 0.015  # of the contrast, under Tukey's scale
WORST_MISFIT, WORST_SMOOTH_MISFIT = 0.23, 0.08  # residuals over contrast; above: texture or a stain
SMOOTH = 0.5  # correlation of neighbouring residuals above which they are not noise
MARGIN, LEAST_MARGIN_PX = 0.3, 2.5  # background, in radii and px: a target's pad may end soon
_COARSE_PX = 3.0  # sampled pixels per radius that suffice
_EDGE_SAMPLES = 16  # sampled pixels on the edge, four pixels wide, that suffice
_FARTHEST, _MOST_GROWN = 0.5, float(np.log(1.5))  # change of centre in radii, of log size; beyond: another object


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


def fit_disks(block: ScanBlock, patches: Patches) -> Patches:
    """Patches that are disks, fitted, the strongest first; centres are right to a tenth of a pixel or so."""
    radius = patches.radii
    first = np.full(len(radius), _FIRST_BLUR_PX)
    of_edge = np.sqrt(8 * np.pi * radius / _EDGE_SAMPLES)
    strides = np.maximum(np.minimum(radius / _COARSE_PX, of_edge), 1.0).astype(np.intp)
    promising, blurs = _fit_patches(block, patches, first, strides, _PLAIN_STEPS, (_HOPELESS, _HOPELESS))
    whole = np.ones(len(blurs), np.intp)
    return _fit_patches(block, promising, blurs, whole, 0, (np.inf, 1.0))[0].strongest_first()


def _fit_patches(
    block: ScanBlock,
    patches: Patches,
    blurs: Array,
    strides: Indices,
    plain_steps: int,
    most_misfits: tuple[float, float],
) -> tuple[Patches, Array]:
    """Fitted disks among the patches and their blurs (n,), by some plain steps and a robust one. strides (n,): spacing
    of the sampled columns and rows, since large disks need only part of their pixels; most_misfits: allowed before and
    after the steps."""
    found, blurs_found = [Patches.collect(())], [np.zeros(0)]
    margins_px = np.maximum(MARGIN * patches.radii, LEAST_MARGIN_PX)
    for group in _groups(patches, strides, margins_px):
        own, fit = group, _DiskFit(block, patches.part(group), blurs[group], strides[group], margins_px[group])
        is_promising = fit.misfit() < most_misfits[0]
        if not is_promising.all():  # the outline alone rules most patches out
            own = group[is_promising]
            if not len(own):
                continue
            fit = _DiskFit(block, patches.part(own), blurs[own], strides[own], margins_px[own])
        fit.plain_steps = plain_steps
        gauss_newton(fit, fit.every, 0.0, plain_steps + 1)
        is_disk = fit.is_disk(patches.part(own), most_misfits[1])
        found.append(fit.patches().part(is_disk))
        blurs_found.append(fit.blur[is_disk])
    return concatenate(*found), np.concatenate(blurs_found)


def place_disks(block: ScanBlock, patches: Patches, margins_px: Array) -> list[MarkFit]:
    """Fit many disks at once to convergence, each with margins_px (n,) of background."""
    strides, blurs = np.ones(len(patches.radii), np.intp), np.full(len(patches.radii), _FIRST_BLUR_PX)
    placed: dict[int, MarkFit] = {}
    for group in _groups(patches, strides, margins_px):
        own = patches.part(group)
        fit = _DiskFit(block, own, blurs[group], strides[group], margins_px[group], is_censored=True)
        gauss_newton(fit, fit.every, _SETTLED_PX, _MOST_STEPS)
        fit.refuse(np.flatnonzero(~fit.is_disk(own, 1.0)), _NO_DISK)
        placed |= zip(group.tolist(), fit.placed(), strict=True)
    return [placed[number] for number in range(len(blurs))]


def _groups(patches: Patches, strides: Indices, margins_px: Array) -> Iterator[Indices]:
    """Indices of patches with windows of similar size, in groups of limited pixel count."""
    sides = 2 * _half_sides(patches, strides, margins_px) + 1
    rest = np.argsort(-sides, kind="stable")
    while len(rest):
        own = rest[: max(_GROUP_PIXELS // int(sides[rest[0]]) ** 2, 1)]
        own = own[2 * sides[own] >= sides[rest[0]]]
        yield own
        rest = rest[len(own) :]


def _half_sides(patches: Patches, strides: Indices, margins_px: Array) -> Indices:
    """(n,) sampled pixels on either side of the window's centre."""
    longest = np.linalg.norm(patches.shapes, 2, axis=(1, 2))
    return np.asarray(np.ceil((longest + margins_px + 0.5) / strides), np.intp)


class _DiskFit(FitModel):
    """State of the fit of n disks. centers (n, 2) relative to the window centres, px; shapes (n, 2, 2); blur (n,), px;
    greys (n, 4): gain, offset, slopes. Windows of side * side pixels: col, row (n, pixels) relative to their centres,
    grey (n, pixels), used (n, pixels): inside the ellipse and its margin, informative (n, pixels): and not clipped;
    scale (n,): robust one of the residuals; plain_steps: left before robust ones. is_censored: whether grey values at
    the ends of the range may stand for any beyond."""

    damping = _DAMPING

    def __init__(
        self,
        block: ScanBlock,
        patches: Patches,
        blurs: Array,
        strides: Indices,
        margins_px: Array,
        is_censored: bool = False,
    ) -> None:
        super().__init__(len(blurs))
        half, stride = int(_half_sides(patches, strides, margins_px).max()), strides[:, None]
        middles = np.rint(patches.centers).astype(np.intp)
        corners, self.side = middles - half * stride, 2 * half + 1
        along = stride * np.arange(self.side)
        col, row = np.tile(along, self.side), np.repeat(along, self.side, axis=1)
        inside = block.holds(corners[..., None] + along[:, None])
        self.grey = block.grey_values(corners, col, row)
        self.ends = block.clipped_ends(corners, col, row) if is_censored else np.zeros((len(blurs), 1), np.int8)
        self.col, self.row = (np.asarray(one - half * stride, np.float32) for one in (col, row))
        self.middles, self.radius = middles, patches.radii
        self.centers, self.shapes, self.blur = patches.centers - middles, patches.shapes.copy(), blurs.copy()
        edges = _Edges(self, self.every)
        near = edges.distance >= -margins_px[:, None]
        self.used = near & (inside[:, 0, None] & inside[:, 1, :, None]).reshape(near.shape)
        self.design = edges.design(self)
        greys = gauss_newton_step(self.design[:, 6:], self.grey, self.used.astype(np.float32), _DAMPING)
        self.greys = np.nan_to_num(greys)  # without pixels
        self.residuals, self.informative = np.empty_like(self.grey), np.empty_like(self.used)
        self.scale, self.plain_steps = np.empty(len(blurs)), _PLAIN_STEPS
        self.linearise(self.every, self.design)

    def linearise(self, fits: Indices, design: Single) -> None:
        """Set the design matrix of m fits from that by unit gain, their residuals, and the robust scale of these."""
        greys, used = self.greys[fits].astype(np.float32), self.used[fits]
        residuals = self.grey[fits] - (greys[:, None] @ design[:, 6:])[:, 0]
        design[:, :6] *= greys[:, :1, None]
        # A clipped grey value says nothing where the model lies beyond the end of the range as well.
        informative = used & (self.ends[fits] * residuals >= 0)
        middle, count = informative.shape[1] // 2, informative.sum(axis=1)
        # Other pixels are put below and above all of these in equal numbers, so that the median stays the median.
        beyond = np.where(np.cumsum(~informative, axis=1) % 2, np.float32(np.inf), np.float32(-1))
        off = np.where(informative, np.abs(residuals), beyond)
        off.partition(middle, axis=1)
        unbiased = np.sqrt(count / np.maximum(count - _UNKNOWNS, 1))
        self.scale[fits] = SIGMA_OF_DEVIATION * np.where(count > 0, off[:, middle], np.inf) * unbiased
        self.design[fits], self.residuals[fits], self.informative[fits] = design, residuals, informative

    def step(self, fits: Indices, steps: Array) -> Array:
        """Apply steps, shortened to the range of the linearisation. Returns (m,) movements of the centres in px."""
        form = steps[:, :5] / np.maximum(np.abs(steps[:, :5]).max(axis=1, keepdims=True) / _LONGEST_STEP, 1.0)
        moves = (self.shapes[fits] @ form[:, :2, None])[..., 0]
        size, stretch, shear = form[:, 2:].T
        forms = np.array([[1 + size + stretch, shear], [shear, 1 + size - stretch]]).transpose(2, 0, 1)
        self.centers[fits] += moves
        self.shapes[fits] = self.shapes[fits] @ forms
        blur = self.blur[fits]
        self.blur[fits] = np.clip(blur + np.clip(steps[:, 5], -0.5 * blur, blur), *_BLUR_PX)
        self.greys[fits] += steps[:, 6:]
        self.linearise(fits, _Edges(self, fits).design(self))
        self.plain_steps -= 1
        return np.where(self.plain_steps < 0, np.linalg.norm(moves, axis=1), np.inf)

    def pixel_weights(self, fits: Indices) -> Single:
        """(m, pixels), Tukey's against dust and neighbours after plain steps."""
        informative: Mask = np.asarray(self.informative[fits])
        if self.plain_steps > 0:
            return informative.astype(np.float32)
        scale = np.maximum(self.scale[fits], _SCALE_FLOOR * np.abs(self.greys[fits, 0]) + 1e-6)
        return np.asarray(informative * tukey_weights(self.residuals[fits] / scale[:, None].astype(np.float32), 1.0))

    def placed(self) -> Iterator[MarkFit]:
        """The disks in scan pixels, with covariances."""
        weights, found = self.pixel_weights(self.every), self.patches()
        counted = weights > _UNDAMAGED
        influence = self.shapes.astype(np.float32) @ place_influences(self.design, weights)
        size = len(weights), -1, self.side, self.side
        covariances, variances = influence_covariances(
            influence.reshape(size), self.residuals.reshape(size)[:, 0], counted.reshape(size)[:, 0], _UNKNOWNS
        )
        blurs_px = np.sqrt(np.maximum(self.blur**2 - PIXEL_VARIANCE_PX2, 0.0))
        damaged = 1 - weights.sum(axis=1) / np.maximum(self.informative.sum(axis=1), 1)
        for number, (center_px, shape) in enumerate(zip(found.centers, found.shapes, strict=True)):
            yield MarkFit(
                converged=not self.reasons[number],
                reason=self.reasons[number],
                center_px=center_px,
                place_covariance=Covariance.from_noise(covariances[number]),
                pixel_from_mark=np.column_stack([shape, center_px]),
                contrast_dn=float(found.contrasts[number]),
                noise_dn=float(np.sqrt(variances[number])),
                blur_px=float(blurs_px[number]),
                damaged_fraction=float(damaged[number]),
            )

    def misfit(self) -> Array:
        """(n,) residual scale over its limit, which is lower where neighbouring residuals are correlated."""
        left = (self.residuals * self.informative).reshape(-1, self.side, self.side)
        neighbours = (left[:, :, 1:] * left[:, :, :-1]).sum(axis=(1, 2))
        neighbours += (left[:, 1:] * left[:, :-1]).sum(axis=(1, 2))
        correlation = neighbours / np.maximum(2 * (left * left).sum(axis=(1, 2)), 1e-6)
        allowed = np.where(correlation > SMOOTH, WORST_SMOOTH_MISFIT, WORST_MISFIT)
        return np.asarray(self.scale / np.maximum(allowed * np.abs(self.greys[:, 0]), 1e-6), float)

    def patches(self) -> Patches:
        """Fitted disks as patches, in pixels of the scan."""
        return Patches(self.middles + self.centers, self.shapes, self.greys[:, 0])

    def is_disk(self, starts: Patches, most_misfit: float) -> Mask:
        """(n,) whether the misfit is small and the disk is still the object that the fit started from."""
        found = self.patches()
        moved = np.hypot(*(found.centers - starts.centers).T) / starts.radii
        grown = np.abs(np.log(np.maximum(found.radii, 1e-6) / starts.radii))
        same = found.contrasts * starts.contrasts > 0
        return np.asarray((self.misfit() < most_misfit) & (moved < _FARTHEST) & (grown < _MOST_GROWN) & same)


class _Edges:
    """Position of pixels (n, pixels) relative to their ellipse. radius: normalised, 1 on the ellipse; col, row:
    direction in the unit disk; px: length of a radius across the edge; distance: to the edge, px, positive inside."""

    def __init__(self, fit: _DiskFit, fits: Indices) -> None:
        inverse, self.fits = np.linalg.inv(fit.shapes[fits]).astype(np.float32), fits
        center = fit.centers[fits].astype(np.float32)
        unit = inverse @ np.stack([fit.col[fits] - center[:, :1], fit.row[fits] - center[:, 1:]], axis=1)
        self.radius: Single = np.maximum(np.sqrt(unit[:, 0] ** 2 + unit[:, 1] ** 2), np.float32(1e-6))
        direction = unit / self.radius[:, None]
        self.col, self.row = direction[:, 0], direction[:, 1]
        across = inverse.swapaxes(1, 2) @ direction
        self.px: Single = 1 / np.maximum(np.sqrt(across[:, 0] ** 2 + across[:, 1] ** 2), np.float32(1e-6))
        self.distance = (1 - self.radius) * self.px

    def design(self, fit: _DiskFit) -> Single:
        """(n, unknowns, pixels) derivatives with respect to centre, size, stretch and shear (in units of the ellipse)
        and blur (px), all divided by the gain; then with respect to gain, offset and slopes."""
        blur, size = (one[self.fits, None].astype(np.float32) for one in (fit.blur, fit.radius))
        place = self.distance / blur
        density = np.exp(-place * place / 2) / (np.float32(np.sqrt(2 * np.pi)) * blur)
        moved = density * self.px
        grown = moved * self.radius
        ellipse = [moved * self.col, moved * self.row, grown, grown * (self.col**2 - self.row**2)]
        ellipse.append(2 * grown * self.col * self.row)
        greys = [-density * place, ndtr(place), np.ones_like(place), fit.col[self.fits] / size]
        greys.append(fit.row[self.fits] / size)
        return np.stack([*ellipse, *greys], axis=1).astype(np.float32, copy=False)
