"""Faint marks in frames whose other marks are clear: accuracy against the Cramér-Rao bound.

--frames: number per cell, each with three faint marks. A frame of 60 mm (10 px per mm) has eight marks of one kind with
blurs equal to 5 %: five at SNR 20, three at the SNR of the cell. A value is RMS / bound and realised / claimed; -n: not
found. The images and bounds are those of `marks`; the measuring function is that of `reseau measure`,
`measure.fiducials.measure_frame.measure_frame`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from true_marks import KIND, KINDS, Kind, TrueMark, some_mark

from benchmarks.dusty_marks import BLUR_SPREAD, PX_PER_MM, frame_layout, start_placement
from benchmarks.harness import Row
from benchmarks.measured_marks import CONTRAST, GROUND, Cell, Found, best_errors
from measure.fiducials.measure_frame import measure_frame
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

Array = NDArray[np.float64]

PLAIN_SNR, MARKS, FAINT, AT_MM = 20.0, 8, (2, 5, 7), 30.0
SNRS, BLURS_PX = (3.0, 5.0, 10.0), (1.0, 1.6, 2.5)
POOL = 6  # different frames per cell, each rendered once and measured with new noise
BESIDE_PX = 40  # px, noise around a mark's window, from which blank film is sampled
SEED = 20
FRAMED = [kind for kind in KINDS if kind.name != "ellipse"]


@dataclass(frozen=True, eq=False)
class DrawnFrame:
    """Marks of a frame in their windows. corners: first pixels of the windows in a scan of side x side px; linear:
    (2, 2) px per mm; middle: (2,) centre of the frame, px."""

    layout: FiducialLayout
    marks: list[TrueMark]
    corners: list[Array]
    side: int
    linear: Array
    middle: Array


def drawn_frame(kind: Kind, blur_px: float, rng: np.random.Generator) -> DrawnFrame:
    """Draw a frame with random sub-pixel place, rotation and scale."""
    layout, side = frame_layout(kind, MARKS, AT_MM), int(PX_PER_MM * AT_MM * 3) + 300
    linear = some_mark(kind, blur_px, rng, px_per_mm=PX_PER_MM).place[:, :2]
    middle = side / 2 + rng.uniform(-0.5, 0.5, 2)
    marks, corners = [], []
    for center in np.array([mark.xy_mm for mark in layout.marks]) @ linear.T + middle:
        some = some_mark(kind, blur_px * float(np.exp(rng.normal(0, BLUR_SPREAD))), rng, px_per_mm=PX_PER_MM)
        corners.append(np.rint(center).astype(int) - some.size // 2)
        marks.append(replace(some, place=np.column_stack([linear, center - corners[-1]])))
    return DrawnFrame(layout, marks, corners, side, linear, middle)


def measured_faint(
    frame: DrawnFrame, snr: float, rng: np.random.Generator
) -> Iterator[tuple[TrueMark, Found | None, Array]]:
    """Measure a frame; yield each faint mark, its result, None if not found, and the noise in its window in units of
    its contrast."""
    sign = int(rng.choice((-1, 1)))
    ground = GROUND + (1 - sign) / 2 * CONTRAST
    picture = np.full((frame.side, frame.side, 1), ground, np.uint16)
    noises = []
    for number, (mark, corner) in enumerate(zip(frame.marks, frame.corners, strict=True)):
        noise = rng.standard_normal((mark.size + 2 * BESIDE_PX,) * 2) / PLAIN_SNR
        share = snr / PLAIN_SNR if number in FAINT else 1.0
        grey = ground + CONTRAST * noise
        inner = np.s_[BESIDE_PX:-BESIDE_PX, BESIDE_PX:-BESIDE_PX]
        grey[inner] += sign * share * CONTRAST * mark.picture
        col, row = corner - BESIDE_PX
        picture[row:, col:, 0][: len(grey), : len(grey)] = np.rint(grey)
        noises.append(sign * noise[inner] / share)
    placement = start_placement(frame.linear, frame.middle, sign, MARKS, rng)
    scan = Scan(Path("faint.tif"), WholePicture(picture), NO_TAGS)
    result = measure_frame(scan, frame.layout, placement, FiducialOptions())
    for number in FAINT:
        fit = result.inlier_fits.get(number)
        found = None if fit is None else Found(fit.center_px - frame.corners[number], fit.covariance_px2)
        yield frame.marks[number], found, noises[number]


COLUMNS = {"kind": "", "blur_px": "g", **{f"SNR {snr:g}": "" for snr in SNRS}}


def cells(frames: int = 40) -> Iterator[Row]:
    for kind in FRAMED:
        yield from ({"kind": kind.name, "blur_px": blur_px, "frames": frames} for blur_px in BLURS_PX)


def case(kind: str, blur_px: float, frames: int, seed: int) -> Row:
    rng = np.random.default_rng([seed, KINDS.index(KIND[kind]), int(10 * blur_px)])
    pool = [drawn_frame(KIND[kind], blur_px, rng) for _ in range(min(POOL, frames))]
    row = {}
    for snr in SNRS:
        cell = Cell()
        for number in range(frames):
            for mark, found, noise in measured_faint(pool[number % len(pool)], snr, rng):
                best = best_errors(mark, noise, 1 / snr, np.zeros(len(mark.kind.unknown)))
                cell.add(mark, found, best, mark.bound(1 / snr))
        row[f"SNR {snr:g}"] = cell.words()
    return row
