"""Round targets measured to the noise of the film: a blurred ellipse fitted by least-squares matching."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from measure.flags import LARGE_ERROR, MUCH_DUST, NO_REASON, Cause, Code, Reason
from measure.marks.shapes import Disk, MarkShape
from measure.matching.match import MatchOptions, mark_window, match
from measure.matching.models import GREY
from measure.matching.window import read_window
from measure.noise.grain import BESIDE_PX
from measure.noise.noise_model import may_be_noise
from measure.noise.robust_estimation import SIGMA_OF_DEVIATION
from measure.results import Covariance, MarkFit, SecondPlace
from measure.scans.compression import covariance_of_compression
from measure.scans.scan import Scan
from measure.targets.disk_detection import LEAST_SNR
from measure.targets.disk_fit_batch import LEAST_MARGIN_PX, MARGIN, SMOOTH, WORST_MISFIT, WORST_SMOOTH_MISFIT

Array = NDArray[np.float64]

UNIT_DISK = MarkShape((Disk((0.0, 0.0), 1.0),))
_LONGEST_MARGIN_PX = 10.0
_NARROWEST_MARGIN_PX = 1.5  # however near a neighbour is: with less, no pixel is ground
_LEAST_SHIFT_PX = 2.0  # from the start: a small disk may have been found so far off
_FORM_SIGMA = 0.2  # of size and shear: as well as the start is known
PLAIN_MARGIN_PX = 7.0  # where it is plain, for a tenth less noise than with the shortest margin
_MARGIN_BLURS = 4.0  # in a soft scan so many standard deviations of its blur, as other marks get
_LEAST_REACH_PX = 5.5  # from the centre: in less, the size of a small disk and the blur are one
SMALLEST_RADIUS_PX = 1.2  # of the shorter half axis: below it blur and size cannot be told apart
_SMALL_RADIUS_PX = 2.0  # below it dust cannot be told from a lone disk
_WEAK_DAMAGE, _MOST_DAMAGE = 0.2, 0.35
_MOST_BLUR = 0.7  # of the shorter half axis
_SURE, _MOST_FAINTER = 3.0, 0.5  # standard deviations by which a contrast may be greater, and what that may add to it
_LARGE_PX = 0.3  # the error that a small target must not have
# What dust that moves a disk by more does to it, rms of 148 rendered disks: to size, stretch, shear, px of the radius
# (one edge is moved by twice as much as the disk), the contrast's logarithm, and the blur's variance, px².
# Then to the place with sloping paint against the matched one, px, which less dust does not move.
_DUST_APPEARANCE, _DUST_SLOPING_PX = (0.2, 0.2, 0.2, 0.3, 0.4), 0.5
_DUST = (0.0, 1 / 3, 1.5, 6.0)  # times that: none, some, and what moves a disk by 0.3 px, or is something else
# Each of these a coordinate. A few disks of each kind are moved by far more and make the rms 0.16, 0.5 and 0.6: with
# those the errors of all, and which are large, are far less likely (docs/precision.md).
_DUST_MOVES_PX = np.array([0.0, 0.08, 0.3, 0.6])
# The shares of these, as if of so many disks they had been seen before; most dust beside a disk is cut out.
_BEFORE, _WHOLE, _DAMAGED = 20.0, (0.9, 0.085, 0.0125, 0.0025), (0.56, 0.36, 0.07, 0.01)
_MUCH = slice(2, None)
_FEWEST = 8  # that tell how much targets differ
_DUST_PX = 4.0  # the shorter half axis up to which dust may pass for a disk or hide its edge: it is seldom larger
_FORM = slice(0, 3)  # size, stretch and shear among the figures of an appearance
_ROUNDS, _SETTLED = 60, 1e-4
_LEAST_SPREAD = 1e-4  # no frame's targets are alike to better than 1 %, nor is the linearisation of their noise


@dataclass(frozen=True, eq=False)
class FittedDisk:
    """An ellipse as fitted. center_px (2,) with its covariance; pixel_from_disk (2, 2): the unit disk's image, its
    columns two radius vectors, px; contrast_dn: positive for a light disk; appearance_covariance (5, 5): of the
    relative changes of its size, its stretch along the columns, its shear and its contrast, and of its blur's variance,
    px². sloping: where it lies if its paint may slope, None where that is not told. weakness: why it is doubtful;
    reason: why it is no disk, and then the numbers are the fit's last."""

    center_px: Array
    covariance: Covariance
    pixel_from_disk: Array
    contrast_dn: float
    noise_dn: float
    blur_px: float
    damaged_fraction: float
    appearance_covariance: Array
    sloping: SecondPlace | None = None
    weakness: Reason = NO_REASON
    reason: Reason = NO_REASON

    @property
    def covariance_px2(self) -> Array:
        """(2, 2) of the centre, all causes together."""
        return self.covariance.px2

    @property
    def half_axes_px(self) -> Array:
        """(2,) the longer and the shorter."""
        return np.asarray(np.linalg.svd(self.pixel_from_disk, compute_uv=False))

    @property
    def is_fitted(self) -> bool:
        """Whether the fit came to an end, whatever was fitted."""
        return bool(np.all(np.isfinite(self.covariance_px2)))

    @property
    def is_soft(self) -> bool:
        """Whether it was fitted, and its edge is as soft as that of a spot, which has none."""
        return bool(self.is_fitted and self.blur_px > _MOST_BLUR * self.half_axes_px[1])

    @property
    def is_spoilt(self) -> bool:
        """Whether it was fitted, and too little about it fits a disk."""
        return bool(self.is_fitted and self.damaged_fraction > _MOST_DAMAGE)

    @property
    def contrast_sigma(self) -> float:
        """Standard deviation of its contrast, as a share of it."""
        return float(np.sqrt(self.appearance_covariance[3, 3]))

    @property
    def lone_doubt(self) -> Reason:
        """Why a disk that cannot be compared with others is doubtful: dust and spots look like it; empty otherwise."""
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
        """Named figures for the mark's row."""
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
    """Fit an ellipse near center_px (2,), which pixel_from_disk (2, 2) describes to some 20 %.

    longest_margin_px: how far about it grey values may be used; less where a neighbour is near. shape: another drawing
    of radius 1 that is fitted in the disk's place, with a rotation too.
    Never raises for what the picture holds: a fit that fails, or shows that there is no disk, has a reason.
    """
    start = np.column_stack([pixel_from_disk, center_px])
    radius = _mean_radius_px(pixel_from_disk)
    sure = max(MARGIN * radius, LEAST_MARGIN_PX, _LEAST_REACH_PX - radius)
    sure = max(min(sure, longest_margin_px, _LONGEST_MARGIN_PX), _NARROWEST_MARGIN_PX)
    wide = max(sure, min(PLAIN_MARGIN_PX, longest_margin_px))
    fit_with_ground = _fit_by_margin(scan, start, shape, sure, wide)
    disk = fit_with_ground(wide)
    soft = min(_MARGIN_BLURS * disk.blur_px, longest_margin_px)
    # In less ground than its blur reaches, a disk's blur, size and contrast may run away together.
    if soft > wide and not (disk.reason and disk.is_fitted):
        softer = fit_with_ground(soft)
        disk = disk if softer.reason else softer
    if not disk.reason:
        return disk
    # A narrow pad or a ring about the disk is no damage of the disk. Dust is, and the wider ground shows it better, as
    # it does how soft an edge is: what passes with less of it, at another place, may be the dust itself.
    if disk.is_soft or not sure < wide:
        return disk
    narrow = fit_with_ground(sure)
    if narrow.reason or not disk.is_spoilt:
        return narrow
    agree = may_be_noise(narrow.center_px - disk.center_px, narrow.covariance_px2 + disk.covariance_px2)
    return narrow if agree else replace(narrow, weakness=disk.reason.reword(f"with more ground: {disk.reason}"))


def _fit_by_margin(
    scan: Scan, start: Array, shape: MarkShape, sure_px: float, wide_px: float
) -> Callable[[float], FittedDisk]:
    """The fit from start (2, 3), pixels from the shape, by how much ground about it is used; its window holds wide_px
    of ground, of which what is within sure_px is the disk's for sure."""
    options = MatchOptions(
        freedom="ellipse" if shape is UNIT_DISK else "affine",
        margin_px=wide_px,
        margin_blurs=0.0,
        plain_px=sure_px,
        max_shift_px=max(_mean_radius_px(start[:, :2]), _LEAST_SHIFT_PX),
        linear_sigma=_FORM_SIGMA,
        strain_sigma=_FORM_SIGMA,
    )
    window = read_window(scan, mark_window(shape, start, wide_px + BESIDE_PX))

    def fit_with_ground(margin_px: float) -> FittedDisk:
        fit = match(window, shape, start, replace(options, margin_px=margin_px))
        loss = covariance_of_compression(scan.rounding_step_dn, fit.stored_contrast_dn)
        disk = FittedDisk(
            center_px=fit.center_px,
            covariance=fit.place_covariance.plus(Cause.COMPRESSION, loss),
            pixel_from_disk=fit.pixel_from_mark[:, :2],
            contrast_dn=fit.contrast_dn,
            noise_dn=fit.noise_dn,
            blur_px=fit.blur_px,
            damaged_fraction=fit.damaged_fraction,
            appearance_covariance=_appearance_covariance(fit),
            sloping=fit.sloping,
            reason=NO_REASON if fit.converged else fit.reason,
        )
        return _assess(disk, fit)

    return fit_with_ground


def _mean_radius_px(pixel_from_disk: Array) -> float:
    """Of the circle of an ellipse's area."""
    return float(np.sqrt(abs(np.linalg.det(pixel_from_disk))))


def _appearance_covariance(fit: MarkFit) -> Array:
    """(5, 5) as a fitted disk has it."""
    assert fit.covariance is not None
    gain = len(fit.covariance) - GREY
    figures = [2, 3, 4, gain, gain - 1]
    per = np.array([1.0, 1.0, 1.0, fit.contrast_dn or 1.0, 1.0])
    return np.asarray(fit.covariance[np.ix_(figures, figures)] / np.outer(per, per))


def _assess(disk: FittedDisk, fit: MarkFit) -> FittedDisk:
    """The disk with its reason or weakness, where the fit's figures give one; residuals of a picture of something else
    are alike in neighbouring pixels."""
    if disk.reason:
        return disk
    reason = weakness = NO_REASON
    contrast, (_, shorter) = abs(disk.contrast_dn), disk.half_axes_px
    # White residuals are noise, which also moves a contrast: as strong as it may be, the disk counts.
    most = contrast * (1 + min(_SURE * disk.contrast_sigma, _MOST_FAINTER)) if fit.covariance_is_white else contrast
    worst = WORST_SMOOTH_MISFIT if fit.neighbour_correlation > SMOOTH else WORST_MISFIT
    if not disk.is_fitted or most < LEAST_SNR * disk.noise_dn:
        message = f"no disk stands out: contrast {contrast:.0f}, noise {disk.noise_dn:.0f} grey values"
        reason = Reason(message, Code.CONTRAST)
    elif disk.noise_dn > worst * contrast and not fit.covariance_is_white:
        message = f"no disk: what a disk leaves unexplained is {100 * disk.noise_dn / contrast:.0f} % of its contrast"
        reason = Reason(message, Code.LIKENESS)
    elif disk.is_spoilt:
        message = f"{100 * disk.damaged_fraction:.0f} % of the pixels about it do not fit a disk"
        reason = Reason(message, Code.COVERED)
    elif shorter < SMALLEST_RADIUS_PX:
        reason = Reason(f"too small: half axis {shorter:.1f} px", Code.SMALL)
    elif disk.damaged_fraction > _WEAK_DAMAGE:
        message = f"{100 * disk.damaged_fraction:.0f} % of the pixels about it are damaged"
        weakness = Reason(message, Code.COVERED)
    return replace(disk, reason=reason, weakness=weakness)


# Disks that may have dust on them, which may put them far off: on a small disk it may leave no residual that shows it,
# and be taken for another size, form, contrast or blur of the disk.
#
# How the targets of a frame differ by themselves, in their paint, their light and what is known of their form, is told
# by all of them; the rest is noise, whose covariance each fit gives. Which of them have dust on them, how many, the
# frame tells too: a mixture of normal distributions, of disks without dust, with some and with so much that their
# places are wrong, fitted by expectation and maximisation (Dempster, Laird and Rubin, 1977).


def doubts(disks: Sequence[FittedDisk], predicted: Sequence[Array]) -> list[Reason]:
    """Why each disk may be as far off as only dust is, or more or less than its target, empty where it is too large for
    dust and not soft, or well determined and like the others; predicted: pixel_from_disk (2, 2) of each, right but for
    a factor common to all. Fewer than _FEWEST tell nothing: then every one that dust may look like is doubted."""
    if len(disks) < _FEWEST:
        return [disk.lone_doubt for disk in disks]
    appearances = np.array([_appearance(disk, shape) for disk, shape in zip(disks, predicted, strict=True)])
    common = _common(appearances, disks)
    return [
        _doubt(disk, appearance - common.appearance, kinds)
        if disk.is_soft or disk.half_axes_px[1] < _DUST_PX
        else NO_REASON
        for disk, appearance, kinds in zip(disks, appearances, common.kinds, strict=True)
    ]


def _doubt(disk: FittedDisk, off: Array, kinds: Array) -> Reason:
    """Of one that dust may look like; off (5,): how far its appearance is from that of the others; kinds (kinds,): the
    probability of each kind of dust."""
    if kinds[_MUCH].sum() < MUCH_DUST:
        sigma = float(np.sqrt(np.linalg.eigvalsh(disk.covariance_px2)[-1]))
        chances = chdtrc(2, _LARGE_PX**2 / (sigma**2 + _DUST_MOVES_PX**2))
        if chances[0] > LARGE_ERROR:
            return Reason(f"faint: good to {sigma:.2f} px only", Code.IMPRECISE)
        hidden = Reason(f"dust that puts it {_LARGE_PX} px off may hide in it", Code.DUST)
        return hidden if chances @ kinds > LARGE_ERROR else NO_REASON
    size, *form, contrast, variance = off
    return Reason(
        f"unlike the other targets: {np.exp(size):.2f} times their size, {np.exp(contrast):.2f} times their "
        f"contrast, its form {100 * np.hypot(*form):.0f} % off, its blur by {variance:.1f} px²; dust may hide in it",
        Code.DUST,
    )


def _appearance(disk: FittedDisk, predicted: Array) -> Array:
    """(5,) logarithm of size, stretch and shear against the predicted ellipse, those of the symmetric change that makes
    the one ellipse the other, and of contrast; the blur's variance, px²."""
    root = _power(predicted @ predicted.T, 0.5)
    fitted = disk.pixel_from_disk @ disk.pixel_from_disk.T
    inverse = np.linalg.inv(root)
    change = inverse @ _power(root @ fitted @ root, 0.5) @ inverse
    values, vectors = np.linalg.eigh(change)
    log = (vectors * np.log(values)) @ vectors.T
    size, stretch, shear = (log[0, 0] + log[1, 1]) / 2, (log[0, 0] - log[1, 1]) / 2, log[0, 1]
    return np.array([size, stretch, shear, np.log(abs(disk.contrast_dn)), disk.blur_px**2])


def _power(matrix: Array, exponent: float) -> Array:
    """Of a symmetric, positive matrix (2, 2)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * values**exponent) @ vectors.T)


class _Common(NamedTuple):
    """appearance (figures,): targets without dust; kinds (n, kinds): the probabilities of dust on each."""

    appearance: Array
    kinds: Array


def _common(appearances: Array, disks: Sequence[FittedDisk]) -> _Common:
    """Of appearances (n, figures).

    Those without dust are normal about one appearance, with a spread of their own beside their noise. Form has no
    direction: stretch and shear spread alike. Damage that was seen makes more of it likely.
    """
    noise = np.array([disk.appearance_covariance for disk in disks])
    dust, slope_logs = _dust_variances(disks), _slope_log_densities(disks)
    damaged = np.array([disk.damaged_fraction > 0 for disk in disks])
    before = np.array([_WHOLE, _DAMAGED])
    shares = before
    appearance = np.median(appearances, axis=0)
    spread = np.maximum((SIGMA_OF_DEVIATION * np.median(np.abs(appearances - appearance), axis=0)) ** 2, _LEAST_SPREAD)
    kinds = np.zeros((len(_DUST), len(disks)))
    for _ in range(_ROUNDS):
        weights = np.linalg.inv(noise + np.diag(spread) + dust)
        last, off = kinds, appearances - appearance
        logs = np.log(shares[damaged.astype(int)].T) + slope_logs + _log_density(off, weights)
        kinds = np.exp(logs - logs.max(axis=0))
        kinds /= kinds.sum(axis=0)
        counts = np.array([kinds[:, ~damaged].sum(axis=1), kinds[:, damaged].sum(axis=1)])
        shares = (counts + _BEFORE * before) / (counts.sum(axis=1, keepdims=True) + _BEFORE)
        clean, weights = kinds[0], weights[0]
        weighed = clean[:, None, None] * weights
        appearance = np.linalg.solve(weighed.sum(axis=0), np.einsum("nij,nj->i", weighed, appearances))
        # What of each difference is the target's own, and the variance with which noise leaves that open.
        own = spread * np.einsum("nij,nj->ni", weights, appearances - appearance)
        unknown = spread - spread**2 * np.einsum("nii->ni", weights)
        spread = np.average(own**2 + unknown, axis=0, weights=clean)
        spread[1:3] = spread[1:3].mean()
        spread = np.maximum(spread, _LEAST_SPREAD)
        if np.abs(kinds - last).max() < _SETTLED:
            break
    return _Common(appearance, kinds.T)


def _dust_variances(disks: Sequence[FittedDisk]) -> Array:
    """(kinds, n, figures, figures): what each kind of dust adds to the variances of the appearances."""
    radius = np.array([np.sqrt(np.prod(disk.half_axes_px)) for disk in disks])
    appearance = np.tile(_DUST_APPEARANCE, (len(disks), 1))
    appearance[:, _FORM] /= radius[:, None]
    return np.asarray(np.multiply.outer(np.square(_DUST), appearance[..., None] ** 2 * np.eye(len(_DUST_APPEARANCE))))


def _slope_log_densities(disks: Sequence[FittedDisk]) -> Array:
    """(kinds, n) the logarithms of the probability densities of the places with sloping paint: these are independent of
    the appearances, for they are told by residuals. 0 where a disk has none."""
    logs = np.zeros((len(_DUST), len(disks)))
    for index, disk in enumerate(disks):
        if disk.sloping is not None:
            moved = np.tile(disk.sloping.covariance_px2, (len(_DUST), 1, 1, 1))
            moved[_MUCH] += _DUST_SLOPING_PX**2 * np.eye(2)
            logs[:, index] = _log_density(disk.sloping.offset_px[None], np.asarray(np.linalg.inv(moved), float))[:, 0]
    return logs


def _log_density(off: Array, weights: Array) -> Array:
    """(kinds, n) of normal distributions, but for a constant, for off (n, figures) and the inverses of the covariances
    (kinds, n, figures, figures)."""
    squares = np.einsum("ni,knij,nj->kn", off, weights, off)
    return np.asarray((np.linalg.slogdet(weights)[1] - squares) / 2)
