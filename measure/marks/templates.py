"""Templates of marks without a drawing, learned from the images of the mark in all frames of a camera.

The images are fitted to their common template, the shared image, by least squares. Scans of one camera differ in
sharpness. More blur displaces the edges of an asymmetric mark, so a mean of images of different blur gives a biased
place. Each image is therefore modelled as the shared one under its own Gaussian blur, shift, gain and offset. The
shared image is as sharp as the sharpest of them. It is adjusted simultaneously with the shifts and blurs: in an
alternating adjustment the sharpest image would be compared mostly with itself, and hardly move. The noise of coarser
detail falls with the square root of their number. The template's origin on the mark is a convention, common to all
frames: a shift of the fiducial's coordinates.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from scipy import ndimage
from scipy.fft import dctn, idctn
from scipy.sparse.linalg import LinearOperator, lsmr

from measure.array_types import Array, Mask, Single
from measure.geometry import POSES, UP_FROM_CAMERA, linear_scale, turn_by_quarters
from measure.marks.shapes import MarkTemplate
from measure.noise.robust_estimation import robust_scale, tukey_weights
from measure.scans.scan import Scan

_GAIN, _OFFSET, _COL, _ROW, _BLUR = range(5)  # unknowns of each image
_REWEIGHTINGS = 5  # iterations of Tukey's reweighting
NOISE_FLOOR = 0.002  # fraction of the image's range, floor of the noise, which is zero in clean images
_LEAST_WEIGHT = 1e-6  # floor of Tukey's weight, for pixels that are outliers in all images
_LEAST_REDUNDANCY = 0.1  # floor of 1 - share; with less redundancy residuals do not estimate an image's noise
_ALIKE_PX = 0.7  # px, smoothing of the weights that decide whether a pixel is steady
_LEAST_GAIN = 0.01  # floor of the gain, for an image that hardly shows the mark
SMOOTHED_PX2 = 0.7**2  # px², smoothing of all compared images: edges as sharp as a pixel are undersampled
_CORRELATED = 4 * np.pi * SMOOTHED_PX2  # pixels per independent observation after smoothing
_LONGEST_PX = 1.0  # px, longest shift for which the linearisation holds
_MOST_BLURRED = 2.0  # largest factor of the blur, likewise
_SEEN_PX2 = 1.0  # px², variance of a sharp scan's total blur, pixel and smoothing included
_SURELY = 3.0  # standard deviations: the shared image is only as sharp as the sharpest image certainly is
_HELD = 0.1  # in weights of one image: regularises components of the shared image that no image determines
_ITERATIONS, _TOLERANCE = 12, 1e-3  # of LSMR in one adjustment; the next round continues
_PHASES = 2  # unsteady pixels are known only after the images have been aligned once
_ROUNDS = 12  # iterations per phase; five suffice for images of similar sharpness
_SETTLED_PX, _SETTLED_PX2 = 0.005, 0.02  # px and px², convergence limits of shifts and blur variances
_ROOM_PX = 10  # px around the chip, so that the mark can move
_SPREAD_PX = 1.0  # px, smoothing of the steadiness: few images estimate it poorly, but it varies at the edges
GRAIN_PX = 1.0  # px, correlation length of grain assumed where a single image does not determine it
_ALIKE = 0.8  # smallest NCC of two images of one mark, including the background around it
_CORE = 0.15  # fraction of the image's side: largest difference of two origins in each coordinate
_SMOOTH_PX = 5  # px, smoothing of the images to be aligned, against noise
_STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-5)
_FLIP = np.diag([1.0, -1.0])  # from right and up to columns and rows


@dataclass(frozen=True, eq=False)
class SharedPicture:
    """Shared image of n images.

    Attributes
    ----------
    image : (side, side) shared image.
    variances_px2 : (n,) variance of each image's additional blur.
    weights : (n, side, side) weights of the images' pixels.
    residuals : (n, side, side) residuals in units of the shared image.
    moves : (n, 2) px, shifts of the images by column and row, with zero sum.
    alike : (side, side) mask of the pixels in which most images agree.
    """

    image: Array
    variances_px2: Array
    weights: Array
    residuals: Array
    moves: Array
    alike: Mask

    @property
    def shares(self) -> Array:
        """(n,) share of each image in the shared one, averaged over the frequencies that a fit uses."""
        side = len(self.image)
        information = self.weights.mean(axis=(1, 2))[:, None, None] * _transfers(side, 2 * self.variances_px2)
        visible = _transfers(side, np.array([2 * SMOOTHED_PX2]))
        return np.asarray((visible * information / information.sum(axis=0)).sum(axis=(1, 2)) / visible.sum())

    @property
    def slope_noise(self) -> float:
        """Standard deviation of the noise in the image's gradient, per pixel, after the smoothing of a fit. Estimated
        from the residuals, corrected for each image's share."""
        shares = self.shares
        noise = np.array([robust_scale(np.diff(residuals)) for residuals in self.residuals])
        return float(np.sqrt(np.sum(shares**2 * noise**2 / np.maximum(1 - shares, _LEAST_REDUNDANCY))))


def first_picture(stack: Array) -> SharedPicture:
    """Initial shared image of images (n, side, side), under the assumption that they are alike."""
    like, levelled = stack[0], []
    for picture in stack:  # gain and offset by linear regression
        off = picture - picture.mean()
        gain = float((off * like).sum()) / max(float((off**2).sum()), 1e-12)
        levelled.append(like.mean() + gain * off)
    return SharedPicture(
        np.median(levelled, axis=0),
        np.zeros(len(stack)),
        np.ones_like(stack),
        np.zeros_like(stack),
        np.zeros((len(stack), 2)),
        np.ones(stack[0].shape, dtype=bool),
    )


def adjust_picture(shared: SharedPicture, stack: Array, steady: Mask) -> SharedPicture:
    """Adjust the shared image once more to images (n, side, side). Shifts and blurs are estimated from the steady
    pixels."""
    smoothed = _blur_images(stack, np.full(len(stack), SMOOTHED_PX2))
    designs = _designs(shared.image, shared.variances_px2, steady)
    fits = [_fit(*each) for each in zip(smoothed, designs, shared.weights, strict=True)]
    alike = np.array([fit.alike for fit in fits])
    # The share of an image in the shared one lowers its residuals. With at least the median noise no image dominates.
    noise = np.array([fit.scale for fit in fits]) / np.sqrt(np.maximum(1 - shared.shares, _LEAST_REDUNDANCY))
    weights = (alike + _LEAST_WEIGHT) / np.maximum(noise, np.median(noise))[:, None, None] ** 2
    # Blurs are relative to that of the sharpest image; images not significantly less sharp have none.
    found = _bounded(shared.variances_px2, np.array([fit.blur_px2 for fit in fits]))
    sharpest = float((found + _SURELY * np.array([fit.blur_sigma_px2 for fit in fits])).min())
    variances = np.maximum(found - sharpest, 0.0)
    together = _JointAdjustment(shared.image, variances, weights, steady)
    image, more = together.solve(np.array([fit.levelled for fit in fits]))
    moves = np.clip(-more[:, [_COL, _ROW]], -_LONGEST_PX, _LONGEST_PX)
    return SharedPicture(
        image,
        np.maximum(_bounded(variances, more[:, _BLUR]), 0.0),
        weights,
        np.array([fit.residuals for fit in fits]),
        moves - moves.mean(axis=0),
        cv2.GaussianBlur(alike.mean(axis=0), (0, 0), _ALIKE_PX) > 0.5,
    )


def _squares(side: int) -> Array:
    """(side, side) squared frequencies of the cosine transform."""
    square = (np.pi * np.arange(side) / side) ** 2
    return np.asarray(square[:, None] + square)


def _transfers(side: int, variances_px2: Array) -> Array:
    """(n, side, side) transfer functions of Gaussian blurs in the cosine transform."""
    return np.asarray(np.exp(-0.5 * variances_px2[:, None, None] * _squares(side)))


def _blur_images(images: Array, variances_px2: Array) -> Array:
    """(n, side, side) one image, or n, under blurs (n,); mirrored at the borders, so that the blur is self-adjoint."""
    cosines = _transfers(images.shape[-1], variances_px2) * _cosines(images)
    return np.asarray(idctn(cosines, axes=(1, 2), norm="ortho"))


def _cosines(images: Array) -> Array:
    return np.asarray(dctn(images, axes=(-2, -1), norm="ortho"))


def _designs(image: Array, variances_px2: Array, steady: Mask) -> Array:
    """(n, 5, side, side) design matrices of the images: the blurred shared image, 1, and its derivatives by column, row
    and variance of the blur, the latter in steady pixels only."""
    views = _blur_images(image, variances_px2 + SMOOTHED_PX2)
    by_row, by_col = np.gradient(views, axis=(1, 2))
    by_variance = idctn(-0.5 * _squares(len(image)) * _cosines(views), axes=(1, 2), norm="ortho")
    return np.stack([views, np.ones_like(views), *(part * steady for part in (by_col, by_row, by_variance))], axis=1)


@dataclass(frozen=True, eq=False)
class _TemplateFit:
    """Fit of one image to the shared one, in its grey values. levelled, residuals, alike (side, side): image, residuals
    and Tukey's weights; scale: standard deviation of the residuals; blur_px2: correction of the blur's variance."""

    levelled: Array
    residuals: Array
    alike: Array
    scale: float
    blur_px2: float
    blur_sigma_px2: float


def _fit(picture: Array, design: Array, weights: Array) -> _TemplateFit:
    """Fit an image to the shared one, robustly against dust and background. Residuals as large as the changes by shift
    and blur are not yet treated as damage; the next round decides."""
    columns, grey = design.reshape(len(design), -1), picture.ravel()
    floor = NOISE_FLOOR * float(np.ptp(design[_GAIN]))
    weights = weights.ravel()
    for _ in range(_REWEIGHTINGS):
        weighed = columns * weights
        inverse = np.linalg.pinv(weighed @ columns.T, hermitian=True)
        factors = inverse @ (weighed @ grey)
        gain = max(float(factors[_GAIN]), _LEAST_GAIN)
        residuals = (grey - factors @ columns) / gain
        scale = max(robust_scale(residuals), floor)
        changes = factors[_COL:] @ columns[_COL:] / gain
        alike = tukey_weights(residuals / np.hypot(scale, changes), 1.0)
        weights = (alike + _LEAST_WEIGHT) / scale**2
    return _TemplateFit(
        (picture - factors[_OFFSET]) / gain,
        residuals.reshape(picture.shape),
        alike.reshape(picture.shape),
        scale,
        float(factors[_BLUR]) / gain,
        float(np.sqrt(_CORRELATED * inverse[_BLUR, _BLUR])),
    )


def _bounded(variances_px2: Array, change_px2: Array) -> Array:
    """Apply a change of variances, limited to the range of the linearisation."""
    total = variances_px2 + _SEEN_PX2
    return np.clip(total + change_px2, total / _MOST_BLURRED**2, total * _MOST_BLURRED**2) - _SEEN_PX2


class _JointAdjustment:
    """Linearised simultaneous adjustment of the shared image and the unknowns of all images, solved by LSMR.

    Datum: the blur of the sharpest images is held fixed, and the sums of the other unknowns are zero, since a common
    shift would be one of the shared image. Components that no image determines are held by a weak prior. Unknowns and
    equations are scaled to a weight of about one.
    """

    def __init__(self, image: Array, variances_px2: Array, weights: Array, steady: Mask) -> None:
        self.image, self.roots = image, np.sqrt(weights)
        self.designs = _designs(image, variances_px2, steady)
        self.transfers = _transfers(len(image), variances_px2 + SMOOTHED_PX2)
        weighted = self.roots[:, None] * self.designs
        weighted[variances_px2 == 0, _BLUR] = 0.0
        self.lengths = np.sqrt((weighted**2).sum(axis=(2, 3)))
        self.lengths[self.lengths == 0] = np.inf
        self.columns = weighted / self.lengths[:, :, None, None]
        self.held = float(np.sqrt(_HELD * np.median(weights.mean(axis=(1, 2)))))
        self.scale = 1 / np.sqrt(weights.sum(axis=0) + self.held**2)

    def solve(self, levelled: Array) -> tuple[Array, Array]:
        """Solve for the shared image and the corrections (n, 5) of the images' unknowns. levelled: (n, side, side)."""
        wanted = (self.roots * (levelled - self.designs[:, _GAIN])).ravel()
        rest = self.image.size + _BLUR
        shape = (wanted.size + rest, self.image.size + self.lengths.size)
        operator = LinearOperator(shape, matvec=self._forward, rmatvec=self._adjoint, dtype=float)
        wanted = np.concatenate([wanted, np.zeros(rest)])
        found = lsmr(operator, wanted, atol=_TOLERANCE, btol=_TOLERANCE, maxiter=_ITERATIONS)[0]
        image, factors = self._split(found)
        return self.image + self.scale * image, factors / self.lengths

    def _split(self, unknowns: Array) -> tuple[Array, Array]:
        return unknowns[: self.image.size].reshape(self.image.shape), unknowns[self.image.size :].reshape(-1, _BLUR + 1)

    def _forward(self, unknowns: Array) -> Array:
        """Product of the design matrix with the unknowns: images, prior of the shared image, and sums."""
        image, factors = self._split(unknowns)
        change = self.scale * image
        pictures = idctn(self.transfers * _cosines(change), axes=(1, 2), norm="ortho")
        pictures = self.roots * pictures + np.einsum("nk,nkij->nij", factors, self.columns)
        return np.concatenate([pictures.ravel(), self.held * change.ravel(), factors[:, :_BLUR].sum(axis=0)])

    def _adjoint(self, rows: Array) -> Array:
        """Product of the transposed design matrix with the equations."""
        pictures, change, sums = np.split(rows, [self.roots.size, self.roots.size + self.image.size])
        pictures = pictures.reshape(self.roots.shape)
        back = idctn((self.transfers * _cosines(self.roots * pictures)).sum(axis=0), norm="ortho")
        image = self.scale * (back + self.held * change.reshape(self.image.shape))
        factors = np.einsum("nkij,nij->nk", self.columns, pictures)
        factors[:, :_BLUR] += sums
        return np.concatenate([image.ravel(), factors.ravel()])


@dataclass(frozen=True, eq=False)
class Chip:
    """Window of a scan around one mark.

    scan: name of the scan; grey: (rows, columns) grey values; origin_px: (col, row) of the top-left pixel in the scan;
    pixel_from_mark: (2, 3) from mm of the mark to pixels of the scan, the last column being the mark's assumed place.
    """

    scan: str
    grey: Array
    origin_px: tuple[int, int]
    pixel_from_mark: Array

    @property
    def pitch_um(self) -> float:
        return 1000.0 / linear_scale(self.pixel_from_mark)


def cut(scan: Scan, pixel_from_mark: Array, size_mm: float, weights: Sequence[float] | None = None) -> Chip:
    """Cut out the window of a scan that holds a square of size_mm around the mark at any rotation, plus a margin.
    weights: channel weights of a colour scan, as used for measuring the mark."""
    matrix = np.array(pixel_from_mark, dtype=float)
    reach = int(np.ceil(np.abs(matrix[:, :2]).sum(axis=1).max() * size_mm / 2)) + _ROOM_PX
    col0, row0 = (int(value) - reach for value in np.rint(matrix[:, 2]))
    grey = scan.window(col0, row0, 2 * reach + 1, 2 * reach + 1, weights).astype(np.float64)
    return Chip(scan.name, grey, (col0, row0), matrix)


def learn_template(chips: Sequence[Chip], size_mm: float) -> MarkTemplate:
    """Learn the common template of all images of one mark. Raises ValueError if there is no image."""
    if not chips:
        raise ValueError("a template needs a picture of its mark")
    pitch_um = float(np.median([chip.pitch_um for chip in chips]))
    side = 2 * int(np.ceil(size_mm * 500 / pitch_um)) + 1  # odd: the origin is the middle pixel
    shared, steady = _align_chips(chips, side, pitch_um)
    image = shared.image
    # The finest detail: twice the blur that halves the image's variance, the width of a single line.
    blurs = np.arange(1.0, max(side / 4, 2.0), 0.5)
    left = [cv2.GaussianBlur(image, (0, 0), blur).var() / max(image.var(), 1e-12) for blur in blurs]
    detail_px = 2 * float(np.interp(-0.5, -np.array(left), blurs))
    # Thin lines pass the high-pass filter, too, but are few.
    noise_dn = [robust_scale(chip.grey - cv2.GaussianBlur(chip.grey, (0, 0), 2 * GRAIN_PX)) for chip in chips]
    return MarkTemplate(
        image,
        pitch_um,
        (side // 2, side // 2),
        polarity="light",  # as the chip shows it
        detail_mm=detail_px * pitch_um / 1000,
        noise_dn=float(np.median(noise_dn)),
        slope_noise_dn=shared.slope_noise,
        shares={chip.scan: float(share) for chip, share in zip(chips, shared.shares, strict=True)},
        steady=steady,
        steadiness=_steadiness(shared.residuals, image, steady) if len(chips) > 1 else None,
        learned_mm=size_mm,
    )


def _align_chips(chips: Sequence[Chip], side: int, pitch_um: float) -> tuple[SharedPicture, Mask]:
    """Align chips. Returns their shared image (side, side) and the mask of its steady pixels."""
    places = [np.array(chip.pixel_from_mark) for chip in chips]

    def stack() -> Array:
        return np.stack([resample_chip(*pair, side, pitch_um) for pair in zip(chips, places, strict=True)])

    shared, steady = first_picture(stack()), np.ones((side, side), dtype=bool)
    for _ in range(_PHASES if len(chips) > 1 else 0):
        for _ in range(_ROUNDS):
            before, shared = shared, adjust_picture(shared, stack(), steady)
            for place, move in zip(places, shared.moves, strict=True):
                place[:, 2] += place[:, :2] @ (move * (1.0, -1.0) * pitch_um / 1000)
            blurred = np.abs(shared.variances_px2 - before.variances_px2).max()
            if np.hypot(*shared.moves.T).max() < _SETTLED_PX and blurred < _SETTLED_PX2:
                break
        steady = shared.alike
    return shared, steady


def resample_chip(chip: Chip, pixel_from_mark: Array, side: int, pitch_um: float, order: Literal[1, 3] = 3) -> Array:
    """Resample a chip to the mark's axes, x right and y up, with its origin in the centre pixel, by splines of an
    order. side: of the resampled image, odd."""
    step = (np.arange(side) - side // 2) * (pitch_um / 1000)
    mark_mm = np.stack(np.meshgrid(step, -step))
    col, row = np.tensordot(pixel_from_mark[:, :2], mark_mm, axes=1) + (
        pixel_from_mark[:, 2] - np.array(chip.origin_px)
    ).reshape(2, 1, 1)
    return np.asarray(ndimage.map_coordinates(chip.grey, [row, col], order=order, mode="nearest"))


def _steadiness(residuals: Array, image: Array, steady: Mask) -> Array:
    """(side, side) standard deviation of the noise, estimated as the median over steady pixels, over that of the
    residuals (n, side, side) of the images."""
    squares = (residuals**2).mean(axis=0)
    about = np.sqrt(cv2.GaussianBlur(squares, (0, 0), _SPREAD_PX))
    noise = max(float(np.median(about[steady])) if steady.any() else 0.0, NOISE_FLOOR * float(np.ptp(image)), 1e-9)
    return np.asarray(noise / np.maximum(about, noise))


# Consistent origins of learned marks that look alike in several scan orientations.
#
# The origin of a learned mark is a convention. In another scan orientation a mark may be confused with one that looks
# alike there, and its origin would be at a different place. This does no harm if every such orientation maps the
# origins onto one another, as it does for the centres of crosses.


def share_origins(
    templates: Sequence[MarkTemplate], places_mm: Array, poses: Collection[str]
) -> tuple[list[MarkTemplate], Array]:
    """Make the origins of a camera's learned marks consistent under indistinguishable scan orientations.

    Parameters
    ----------
    templates, places_mm : templates of the n marks and their coordinates (n, 2).
    poses : scan orientations that the frames do not distinguish.

    Returns
    -------
    The templates with the orientations under which all of them look alike, and with origins that these map onto one
    another; the shifts of the origins, mm (n, 2), in the camera's axes.
    """
    count, rows, shifts, alike = len(templates), list[Array](), list[Array](), list[str]()
    near_mm = max(template.learned_mm for template in templates)
    for pose in (pose for pose in POSES[1:] if pose in poses):
        turn = UP_FROM_CAMERA[pose]
        apart = np.hypot(*np.moveaxis((places_mm @ turn.T)[:, None] - places_mm[None], -1, 0))
        to = apart.argmin(axis=1).tolist()  # mark to whose place the turn takes each mark
        if apart.min(axis=1).max() >= near_mm or len(set(to)) < count:
            continue
        pairs = (_aligned_origin(templates[k], templates[to[k]], turn) for k in range(count))
        found = [pair for pair in pairs if pair is not None]
        if len(found) < count:
            continue
        alike.append(pose)
        for k, shift in enumerate(found):
            row = np.zeros((2, count, 2))
            row[:, to[k]] += np.eye(2)
            row[:, k] -= turn
            rows.append(row.reshape(2, -1))
            shifts.append(shift)
    if not alike:
        return list(templates), np.zeros((count, 2))
    moves = np.linalg.lstsq(np.concatenate(rows), np.concatenate(shifts), rcond=None)[0].reshape(count, 2)
    moved = []
    for template, move in zip(templates, moves, strict=True):
        col, row = np.array(template.origin_px) + _FLIP @ move * 1000 / template.pitch_um
        moved.append(replace(template, origin_px=(float(col), float(row)), alike=tuple(alike)))
    return moved, moves


def _aligned_origin(one: MarkTemplate, other: MarkTemplate, turn: Array) -> Array | None:
    """Shift (2,) mm from another mark's origin to that of a turned mark, aligned by ECC. None if they are not alike."""
    image, shown = _centre_origin(other), turn_by_quarters(_centre_origin(one), _FLIP @ turn @ _FLIP)
    side = min(len(image), len(shown))
    margin = int(np.ceil(_CORE * side))
    within, core = _middle(image, side), _middle(shown, side - 2 * margin)
    answers = cv2.matchTemplate(within, core, cv2.TM_CCOEFF_NORMED)
    row, col = np.unravel_index(int(answers.argmax()), answers.shape)
    warp = np.array([[1, 0, col], [0, 1, row]], np.float32)
    try:
        everywhere = np.ones_like(within, np.uint8)
        likeness, moved = cv2.findTransformECC(
            core, within, warp, cv2.MOTION_TRANSLATION, _STEPS, everywhere, _SMOOTH_PX
        )
    except cv2.error:  # no convergence: the two are not alike
        return None
    shift_px = np.asarray(moved, float)[:, 2] - margin
    return np.asarray(_FLIP @ shift_px * other.pitch_um / 1000) if likeness >= _ALIKE else None


def _centre_origin(template: MarkTemplate) -> Array:
    """Resample to the largest square image whose centre is exactly the origin."""
    size = np.array(template.image.shape[::-1])
    origin = np.array(template.origin_px)
    half = int(np.floor(min(np.min(origin), np.min(size - 1 - origin))))
    place = np.array([[1, 0, origin[0] - half], [0, 1, origin[1] - half]], np.float32)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(template.image, place, (2 * half + 1,) * 2, flags=flags), np.float64)


def _middle(picture: Array, side: int) -> Single:
    spare = (len(picture) - side) // 2
    return np.ascontiguousarray(picture[spare : spare + side, spare : spare + side], np.float32)
