"""CPU time of measuring the eight fiducials of a frame, relative to decoding its file, and the largest error.

A frame of 11,500 px in 16-bit LZW tiles with marks of 105 px, and one of 2400 px, 8 bit, with ring-crosses of 138 px,
stored with a gamma of 2.2 that is given to the measurement, or not. A first measurement, which includes initialisation,
is not counted; the smallest time of several rounds is given.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import tifffile
from drawn import paint
from scipy.ndimage import gaussian_filter

from benchmarks.harness import Row
from measure.array_types import Array
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross, ring_cross
from measure.results import FrameMeasurement
from measure.scans.opening import open_scan
from measure.tone.curve import LINEAR, Tone, power
from synthetic_images.tone_curve import coded

COLUMNS = {"frame": "", "decode_s": ".2f", "fiducials_s": ".2f", "of_decode": ".2f", "measured": "d", "worst_px": ".3f"}
FRAMES = {"11500": (11_500, 50.0, MarkShape(cross(1.05, 0.1), "light"), "known"),
          "2400 known": (2400, 50.0, MarkShape(ring_cross(0.9, 0.14, 1.38, 0.14), "light"), "known"),
          "2400 unknown": (2400, 50.0, MarkShape(ring_cross(0.9, 0.14, 1.38, 0.14), "light"), "unknown")}  # fmt: skip
OWN_PROCESS = True


def cells() -> Iterator[Row]:
    yield from ({"frame": frame} for frame in FRAMES)


def case(frame: str, seed: int, rounds: int = 3) -> Row:
    side_px, px_per_mm, mark, tone = FRAMES[frame]
    layout, light, true_px = draw(side_px, px_per_mm, mark, np.random.default_rng(seed))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.tif"
        if side_px > 5000:
            tifffile.imwrite(path, np.rint(65535 * light).astype(np.uint16), tile=(256, 256), compression="lzw")
            curve = LINEAR
        else:
            tifffile.imwrite(
                path, np.rint(255 * coded(light.astype(np.float32), 2.2)).astype(np.uint8), tile=(256, 256)
            )
            curve = Tone(power(2.2)) if tone == "known" else Tone.unknown()

        def measure() -> FrameMeasurement:
            with open_scan(path) as scan:
                pitch_um = 1000 / px_per_mm
                return measure_fiducials(scan.replace_tone(curve), layout, (pitch_um, pitch_um), FiducialOptions())

        result = measure()
        fiducials_s, decode_s = (_least_s(each, rounds) for each in (measure, lambda: tifffile.imread(path)))
    centers = [mark.center_px for mark in result.marks if mark.center_px is not None]
    errors = [np.hypot(*(true_px - center).T).min() for center in centers]
    return {
        "decode_s": decode_s,
        "fiducials_s": fiducials_s,
        "of_decode": fiducials_s / decode_s,
        "measured": sum(mark.status == "measured" for mark in result.marks),
        "worst_px": max(errors, default=np.nan),
    }


def draw(
    side_px: int, px_per_mm: float, mark: MarkShape, rng: np.random.Generator
) -> tuple[FiducialLayout, Array, Array]:
    """Render a frame of clouds and grain, rotated by half a degree, with marks on black pads; returns its layout, its
    light from 0 to 1, and the true places of the marks."""
    half_mm = 0.44 * side_px / px_per_mm
    places = [(x * half_mm, y * half_mm) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    marks = [LayoutMark(str(number), xy, (0.005, 0.005), mark) for number, xy in enumerate(places)]
    turn = px_per_mm * np.array([[np.cos(0.008), np.sin(0.008)], [np.sin(0.008), -np.cos(0.008)]])
    matrix = np.column_stack([turn, np.array([side_px / 2 + 3.3, side_px / 2 - 2.7])])
    clouds = cv2.resize(
        rng.normal(0, 1, (60, 60)).astype(np.float32), (side_px, side_px), interpolation=cv2.INTER_CUBIC
    )
    light = 0.35 + 0.06 * clouds.astype(np.float64)
    size = int(2.2 * px_per_mm)
    for xy in places:
        col, row = np.rint(matrix @ (*xy, 1.0)).astype(int)
        light[max(row - size, 0) : row + size, max(col - size, 0) : col + size] = 0.1
        paint(light, mark, xy, matrix, 0.4, half=int(1.6 * px_per_mm), blur_px=1.0)
    light += 0.012 * gaussian_filter(rng.normal(0, 1, light.shape).astype(np.float32), 0.6) / 0.45
    true_px = np.array([matrix @ (*xy, 1.0) for xy in places])
    camera = FiducialLayout(tuple(marks), (side_px / px_per_mm * 0.98,) * 2)
    return camera, np.clip(light, 0.0, 1.0).astype(np.float32), true_px


def _least_s(function: Callable[[], object], rounds: int) -> float:
    times = []
    for _ in range(rounds):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)
