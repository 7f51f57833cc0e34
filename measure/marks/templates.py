"""Templates of marks without a drawing, learned from the images of the mark in all frames of a camera.

All images are fitted to their common template (shift, blur, gain and offset), which is then recomputed from them, until
convergence. The template is as sharp as the sharpest image. The noise of its coarser detail falls with the square root
of their number. The template's origin on the mark is a convention, common to all frames: a shift of the fiducial's
coordinates.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from measure.array_types import Array, Mask, Single
from measure.geometry import POSES, linear_scale, turn_by_quarters, up_from_camera
from measure.marks.shapes import MarkTemplate
from measure.marks.shared_picture import NOISE_FLOOR, SharedPicture, adjust_picture, first_picture
from measure.noise.robust_estimation import robust_scale
from measure.scans.scan import Scan

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
    return MarkTemplate(
        image,
        pitch_um,
        (side // 2, side // 2),
        polarity="light",  # as the chip shows it
        detail_mm=_detail_px(image) * pitch_um / 1000,
        noise_dn=float(np.median([_noise_dn(chip.grey) for chip in chips])),
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
        return np.stack([_resampled(*pair, side, pitch_um) for pair in zip(chips, places, strict=True)])

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


def _resampled(chip: Chip, pixel_from_mark: Array, side: int, pitch_um: float) -> Array:
    """Resample a chip to the mark's axes, x right and y up, with its origin in the centre pixel."""
    step = (np.arange(side) - side // 2) * (pitch_um / 1000)
    mark_mm = np.stack(np.meshgrid(step, -step))
    col, row = np.tensordot(pixel_from_mark[:, :2], mark_mm, axes=1) + (
        pixel_from_mark[:, 2] - np.array(chip.origin_px)
    ).reshape(2, 1, 1)
    return np.asarray(ndimage.map_coordinates(chip.grey, [row, col], order=3, mode="nearest"))


def _steadiness(residuals: Array, image: Array, steady: Mask) -> Array:
    """(side, side) standard deviation of the noise, estimated as the median over steady pixels, over that of the
    residuals (n, side, side) of the images."""
    squares = (residuals**2).mean(axis=0)
    about = np.sqrt(cv2.GaussianBlur(squares, (0, 0), _SPREAD_PX))
    noise = max(float(np.median(about[steady])) if steady.any() else 0.0, NOISE_FLOOR * float(np.ptp(image)), 1e-9)
    return np.asarray(noise / np.maximum(about, noise))


def _noise_dn(grey: Array) -> float:
    """Standard deviation of one pixel's noise, from high-pass filtered grey values; thin lines pass the filter, too,
    but are few."""
    return robust_scale(grey - cv2.GaussianBlur(grey, (0, 0), 2 * GRAIN_PX))


def _detail_px(image: Array) -> float:
    """Width (px) of the finest detail: twice the blur that halves the image's variance, the width of a single line."""
    blurs = np.arange(1.0, max(image.shape[0] / 4, 2.0), 0.5)
    left = [cv2.GaussianBlur(image, (0, 0), blur).var() / max(image.var(), 1e-12) for blur in blurs]
    return 2 * float(np.interp(-0.5, -np.array(left), blurs))


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
    for pose in (pose for pose in POSES[1:] if pose in poses):
        turn = up_from_camera(pose)
        to = _partners(places_mm, turn, max(template.learned_mm for template in templates))
        pairs = [] if to is None else [_aligned_origin(templates[k], templates[to[k]], turn) for k in range(count)]
        found = [pair for pair in pairs if pair is not None]
        if to is None or len(found) < count:
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
    moved = [_move_origin(template, move, tuple(alike)) for template, move in zip(templates, moves, strict=True)]
    return moved, moves


def _partners(places_mm: Array, turn: Array, near_mm: float) -> list[int] | None:
    """Index of the mark to whose place a turn takes each mark; None if any has no partner."""
    apart = np.hypot(*np.moveaxis((places_mm @ turn.T)[:, None] - places_mm[None], -1, 0))
    to = apart.argmin(axis=1)
    return to.tolist() if apart.min(axis=1).max() < near_mm and len(set(to.tolist())) == len(to) else None


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


def _move_origin(template: MarkTemplate, move_mm: Array, alike: tuple[str, ...]) -> MarkTemplate:
    col, row = np.array(template.origin_px) + _FLIP @ move_mm * 1000 / template.pitch_um
    return replace(template, origin_px=(float(col), float(row)), alike=alike)
