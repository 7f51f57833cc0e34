"""Marks that nobody has drawn: pictures of the same mark in all frames of a camera, aligned, and what they share.

All pictures are adjusted to the one that they share (shift, blur, gain and offset), this is made anew of them, and so
on until nothing moves. It is as sharp as the sharpest of them, and the noise of its coarser detail falls with the
square root of their number. Where its origin lies on the mark is a convention, the same one in every frame: a shift of
the fiducial's coordinates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from measure.covariance import Covariance
from measure.marks.rendering import render
from measure.marks.shapes import MarkTemplate
from measure.matching.match import Match
from measure.noise.robust_estimation import robust_scale
from measure.scans.scan import Scan
from measure.special_marks.shared_picture import NOISE_FLOOR, SMOOTHED_PX2, SharedPicture, adjusted, first_picture

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PHASES = 2  # of rounds: what differs from frame to frame is known once the pictures are aligned
_ROUNDS = 12  # of adjusting; five are enough where pictures are about as sharp as one another
_SETTLED_PX, _SETTLED_PX2 = 0.005, 0.02  # no picture moves or is blurred further
_ROOM_PX = 10  # about the chip, to move in
_SPREAD_PX = 1.0  # over which it is averaged, for a few pictures alone hardly tell it, yet it changes at the edges
_LEAST_TOLD = 0.1  # of the slopes' squares: less would tell nothing
_GRAIN_PX = 1.0  # taken where one picture cannot tell how far its grain reaches


@dataclass(frozen=True, eq=False)
class Chip:
    """A window of a scan about one mark: grey (rows, columns), its top-left pixel at origin_px (col, row) of the scan;
    pixel_from_mark: (2, 3), mark's mm to the scan's pixels, its last column where the mark is taken to be."""

    scan: str
    grey: Array
    origin_px: tuple[int, int]
    pixel_from_mark: Array

    @property
    def pitch_um(self) -> float:
        return 1000.0 / float(np.sqrt(abs(np.linalg.det(self.pixel_from_mark[:, :2]))))


def cut(scan: Scan, pixel_from_mark: Array, size_mm: float, weights: Sequence[float] | None = None) -> Chip:
    """The window of a scan that holds a square of size_mm about the mark however it is turned, and room to move.
    weights: of a colour scan's channels, those in which the mark is measured."""
    matrix = np.array(pixel_from_mark, dtype=float)
    reach = int(np.ceil(np.abs(matrix[:, :2]).sum(axis=1).max() * size_mm / 2)) + _ROOM_PX
    col0, row0 = (int(value) - reach for value in np.rint(matrix[:, 2]))
    grey = scan.window(col0, row0, 2 * reach + 1, 2 * reach + 1, weights).astype(np.float64)
    return Chip(scan.name, grey, (col0, row0), matrix)


def template_of(chips: Sequence[Chip], size_mm: float) -> MarkTemplate:
    """The template that all pictures of one mark have in common. Raises ValueError without any picture."""
    if not chips:
        raise ValueError("a template needs a picture of its mark")
    pitch_um = float(np.median([chip.pitch_um for chip in chips]))
    side = 2 * int(np.ceil(size_mm * 500 / pitch_um)) + 1  # odd: the origin is the middle pixel
    shared, steady = _aligned(chips, side, pitch_um)
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


def _aligned(chips: Sequence[Chip], side: int, pitch_um: float) -> tuple[SharedPicture, Mask]:
    """The picture (side, side) that chips share, and which of its pixels are steady."""
    places = [np.array(chip.pixel_from_mark) for chip in chips]

    def stack() -> Array:
        return np.stack([_resampled(*pair, side, pitch_um) for pair in zip(chips, places, strict=True)])

    shared, steady = first_picture(stack()), np.ones((side, side), dtype=bool)
    for _ in range(_PHASES if len(chips) > 1 else 0):
        for _ in range(_ROUNDS):
            before, shared = shared, adjusted(shared, stack(), steady)
            for place, move in zip(places, shared.moves, strict=True):
                place[:, 2] += place[:, :2] @ (move * (1.0, -1.0) * pitch_um / 1000)
            blurred = np.abs(shared.variances_px2 - before.variances_px2).max()
            if np.hypot(*shared.moves.T).max() < _SETTLED_PX and blurred < _SETTLED_PX2:
                break
        steady = shared.alike
    return shared, steady


def honest_covariance(template: MarkTemplate, scan: str, fit: Match) -> Covariance:
    """Of a mark measured in a scan that has a share in its template.

    The scan's noise is in the template too and so is missing from the residuals, in which only the rest, one less its
    share, is left. Where the template is that scan's picture alone nothing is left: then noise from the picture itself.
    Slopes of the template that are noise tell nothing of the place, but the fit took them for slopes of the mark.
    """
    share = template.shares.get(scan, 0.0)
    if share == 1.0:
        return Covariance.of_noise(_covariance_of_noise(template, fit))
    widened = _without_slope_noise(template, fit)
    return fit.place_covariance.through(widened / np.sqrt(1.0 - share))


def _without_slope_noise(template: MarkTemplate, fit: Match) -> Array:
    """(2, 2) what an error of the place is to be multiplied by: the squares of all slopes that the fit saw over those
    of the mark's."""
    linear, blur_px2 = fit.pixel_from_mark[:, :2], SMOOTHED_PX2 + fit.blur_px**2
    px_per_sample = float(np.sqrt(abs(np.linalg.det(linear)))) * template.pitch_um / 1000
    side = int(np.ceil(len(template.image) * px_per_sample))
    place = np.column_stack([linear, np.full(2, (side - 1) / 2)])
    shown = render(template, place, side, side, float(np.sqrt(blur_px2)))
    slopes = np.stack([shown.by_col.ravel(), shown.by_row.ravel()]).astype(float)
    noise = template.slope_noise_dn / max(float(np.ptp(template.image)), 1e-9) / px_per_sample
    noise *= SMOOTHED_PX2 / blur_px2  # more blur takes as much of the slopes of white noise
    told, axes = np.linalg.eigh(slopes @ slopes.T)
    marks = np.maximum(told - noise**2 * side**2, _LEAST_TOLD * told)
    return np.asarray(axes * (told / marks) @ axes.T)


def _resampled(chip: Chip, pixel_from_mark: Array, side: int, pitch_um: float) -> Array:
    """The chip in the mark's own axes, x right and y up, its origin in the middle pixel."""
    step = (np.arange(side) - side // 2) * (pitch_um / 1000)
    mark_mm = np.stack(np.meshgrid(step, -step))
    col, row = np.tensordot(pixel_from_mark[:, :2], mark_mm, axes=1) + (
        pixel_from_mark[:, 2] - np.array(chip.origin_px)
    ).reshape(2, 1, 1)
    return np.asarray(ndimage.map_coordinates(chip.grey, [row, col], order=3, mode="nearest"))


def _steadiness(residuals: Array, image: Array, steady: Mask) -> Array:
    """(side, side) standard deviation of noise, which is what most of the steady pixels have, over that of the
    differences between the pictures (n, side, side) and their mean."""
    squares = (residuals**2).mean(axis=0)
    about = np.sqrt(cv2.GaussianBlur(squares, (0, 0), _SPREAD_PX))
    noise = max(float(np.median(about[steady])) if steady.any() else 0.0, NOISE_FLOOR * float(np.ptp(image)), 1e-9)
    return np.asarray(noise / np.maximum(about, noise))


def _noise_dn(grey: Array) -> float:
    """Of one pixel: what is finer than grain gets; lines are finer too, but few."""
    return robust_scale(grey - cv2.GaussianBlur(grey, (0, 0), 2 * _GRAIN_PX))


def _detail_px(image: Array) -> float:
    """The finest detail: twice the blur that takes half of the picture's variance away, the width of a lone line."""
    blurs = np.arange(1.0, max(image.shape[0] / 4, 2.0), 0.5)
    left = [cv2.GaussianBlur(image, (0, 0), blur).var() / max(image.var(), 1e-12) for blur in blurs]
    return 2 * float(np.interp(-0.5, -np.array(left), blurs))


def _covariance_of_noise(template: MarkTemplate, fit: Match) -> Array:
    """Of a shift, gain and offset, from the picture's slopes and its noise, as grain of _GRAIN_PX correlates it."""
    side = template.image.shape[0]
    linear = fit.pixel_from_mark[:, :2]
    shown = render(template, np.column_stack([linear, np.full(2, side / 2)]), side, side, 0.0)
    columns = [fit.contrast_dn * shown.by_col, fit.contrast_dn * shown.by_row, shown.value, np.ones_like(shown.value)]
    design = np.stack([column.ravel() for column in columns], axis=1)
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv((design / size).T @ (design / size)) / np.outer(size, size)
    # As many pixels as such grain is wide are one observation: the sum of its correlations.
    return np.asarray(4 * np.pi * _GRAIN_PX**2 * max(template.noise_dn, 1e-3) ** 2 * inverse[:2, :2])
