"""Frames of marks, and of disks with specks of dust, measured as by `reseau measure`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from drawn import make_scan
from numpy.typing import NDArray
from true_marks import KIND, Kind, TrueMark, some_mark

from benchmarks.measured_marks import CONTRAST, GROUND, Found
from measure.fiducials.constellation import Placement
from measure.flags import Status
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.targets.identification import TargetPrediction, measure_disks
from synthetic_images.optics import blurred_coverage, reach_px

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Range = tuple[float, float]

DUST_SNR = 20.0
BLUR_SPREAD = 0.05  # sigma of the logarithms of the blurs of a frame's marks
FRAME_MM, AT_MM, PX_PER_MM, GIVEN_MM = 230.0, 106.0, 10.0, 0.005
PLACED_PX, PLACED = 1.0, 1e-3  # standard deviations of a frame's placement: centre, px; rotation and scale
DISKS_A_SIDE = 5
FORM_SPREAD, CONTRAST_SPREAD, DISK_BLUR_SPREAD, DISK_OFF_PX = 0.02, 0.05, 0.1, 0.4  # deviations from the prediction


@dataclass(frozen=True, eq=False)
class DustyMark:
    """Mark with dust. grey: (size, size) window; visible: pixels without specks; found: None if not measured."""

    mark: TrueMark
    grey: Array
    visible: Mask
    found: Found | None

    @property
    def flagged(self) -> bool:
        return self.found is None or bool(self.found.flagged)

    @property
    def error_px(self) -> Array:
        """(2,) error, nan if not measured."""
        return np.full(2, np.nan) if self.found is None else self.found.center_px - self.mark.place[:, 2]


def dusty(mark: TrueMark, grey: Array, share: float, rng: np.random.Generator) -> tuple[Array, Mask]:
    """Add dark specks that cover a fraction of the pixels near the mark; returns the image and the mask of clean
    pixels."""
    speckled, view = grey.copy(), np.ones(grey.shape, dtype=bool)
    rows, cols = np.nonzero(mark.near)
    while (mark.near & ~view).sum() < share * mark.near.sum():
        radius = min(float(rng.lognormal(0.3, 0.5)), 4.0) * rng.uniform(0.7, 1.3, 12)
        angle = np.arange(12) * (2 * np.pi / 12)
        pixel = rng.integers(len(rows))
        outline = np.array([cols[pixel], rows[pixel]]) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        reach = 6 + reach_px(mark.blur_px)
        col0, row0 = max(cols[pixel] - reach, 0), max(rows[pixel] - reach, 0)
        near = np.s_[row0 : rows[pixel] + reach, col0 : cols[pixel] + reach]
        height, width = speckled[near].shape
        cover = blurred_coverage(((outline,),), int(col0), int(row0), width, height, mark.blur_px)
        speckled[near] = speckled[near] * (1 - cover) + (GROUND - CONTRAST) * cover
        view[near] &= cover < 0.5 / DUST_SNR
    return speckled, view


def frame_layout(kind: Kind, count: int, at: float = AT_MM) -> FiducialLayout:
    """Layout of the first count of four corner and four side marks of one kind, `at` mm from the centre along the
    axes."""
    places = [(at, -at), (-at, -at), (-at, at), (at, at), (0.0, -at), (-at, 0.0), (0.0, at), (at, 0.0)]
    marks = [LayoutMark(str(n), place, (GIVEN_MM, GIVEN_MM), kind.shape) for n, place in enumerate(places[:count])]
    return FiducialLayout(tuple(marks), (FRAME_MM, FRAME_MM))


def start_placement(linear: Array, middle: Array, sign: int, count: int, rng: np.random.Generator) -> Placement:
    """Placement of a frame as found by a search. linear: (2, 2) px per mm; middle: (2,) centre; sign: polarity of the
    marks."""
    scale, turn = rng.normal(0, PLACED, 2)
    about = np.array([[1 + scale, -turn], [turn, 1 + scale]]) @ linear
    pixel_from_camera = np.column_stack([about, middle + rng.normal(0, PLACED_PX, 2)])
    return Placement(POSES[0], pixel_from_camera, float(count), count, sign, 1, (1 / PX_PER_MM, 1 / PX_PER_MM))


def frame_of_disks(
    shares: Sequence[float], half_axes_px: Range, snrs: Range, blurs_px: Range, rng: np.random.Generator
) -> tuple[list[DustyMark], Array]:
    """Measure a frame of 25 disks, all light or all dark, with contrasts equal to 5 %, blurs to 10 %, and shapes
    predicted to 2 % except for a common scale; returns them and the fraction of dust on each (25,)."""
    tile = 81 + 2 * int(max(half_axes_px) - 4)
    snr, sign, scale = rng.uniform(*snrs), rng.choice((-1, 1)), rng.uniform(0.9, 1.1)
    blur = rng.uniform(*blurs_px)
    ground = GROUND + (1 - sign) / 2 * CONTRAST
    frame, parts, predictions = np.empty((DISKS_A_SIDE * tile, DISKS_A_SIDE * tile)), [], []
    dusts = rng.choice(shares, DISKS_A_SIDE**2)
    for number, share in enumerate(dusts):
        own_blur = blur * float(np.exp(rng.normal(0, DISK_BLUR_SPREAD)))
        mark = some_mark(KIND["ellipse"], own_blur, rng, tile, 10 * rng.uniform(*half_axes_px) / 6)
        contrast = CONTRAST * np.exp(rng.normal(0, CONTRAST_SPREAD))
        grey = ground + sign * contrast * mark.picture + CONTRAST / snr * rng.standard_normal((tile, tile))
        corner = tile * np.array(divmod(number, DISKS_A_SIDE)[::-1])
        speckled, view = dusty(mark, grey, float(share), rng)
        frame[corner[1] :, corner[0] :][:tile, :tile] = speckled
        form = scale * (np.eye(2) + rng.normal(0, FORM_SPREAD, (2, 2))) @ mark.place[:, :2]
        about = corner + mark.place[:, 2] + rng.normal(0, DISK_OFF_PX, 2)
        predictions.append(TargetPrediction(str(number), about, form, 3.0))
        parts.append((mark, speckled, view, corner))
    found = []
    for each, (*_, corner) in zip(measure_disks(make_scan(frame), predictions), parts, strict=True):
        place, flagged = each.center_px, "" if each.status is Status.MEASURED else each.reason
        given = each.status.is_observation and place is not None and each.covariance_px2 is not None
        found.append(Found(np.asarray(place) - corner, np.asarray(each.covariance_px2), flagged) if given else None)
    return [DustyMark(*part[:3], each) for part, each in zip(parts, found, strict=True)], dusts
