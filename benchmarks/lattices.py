"""Time of measuring a réseau.

python -m benchmarks lattices [SIDE ...] [--seed 3]

A lattice of SIDE x SIDE dark crosses (5, 13 and 33 where none is given), 32 px wide and 100 px apart, blurred, each off
by 0.1 px, is drawn on an uneven ground with white noise (a fifteenth of a cross's contrast) and measured as `reseau
measure` does, nothing known but the pitch. Seconds are of the processor.
"""

import argparse
import time

import cv2
import numpy as np
from drawn import scan_of
from numpy.typing import NDArray
from true_marks import areas_of

from measure.fiducials.measurement import measure_fiducials
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross
from measure.scans.scan import Scan
from synthetic_images import areas
from synthetic_images.optics import reach_px, seen_coverage

Array = NDArray[np.float64]

SPACING_MM, PITCH_MM, BLUR_PX = 5.0, 0.05, 0.8
CROSS = MarkShape(cross(0.8, 0.12), "dark")
GROUND, UNEVEN, CONTRAST, NOISE = 28000.0, 3000.0, 9000.0, 600.0
TURN_RAD, OFF_CENTRE_PX, OFF_PX = 0.005, (7.3, -4.6), 0.1


def drawn(side: int, rng: np.random.Generator) -> tuple[Scan, FiducialLayout, Array]:
    """The scan, its layout, and where the crosses are (n, 2) px."""
    steps = SPACING_MM * (np.arange(side) - (side - 1) / 2)
    camera = [(float(x), float(y)) for y in steps for x in steps]
    size = int((2 * steps[-1] + 12.0) / PITCH_MM)
    cos, sin = np.cos(TURN_RAD) / PITCH_MM, np.sin(TURN_RAD) / PITCH_MM
    linear = np.array([[cos, -sin], [-sin, -cos]])
    places = np.array(camera) @ linear.T + size / 2 + OFF_CENTRE_PX + rng.normal(0.0, OFF_PX, (len(camera), 2))
    hills = cv2.resize(rng.standard_normal((size // 40 + 2,) * 2), (size, size), interpolation=cv2.INTER_CUBIC)
    grey = GROUND + UNEVEN * hills + NOISE * rng.standard_normal((size, size))
    reach = reach_px(BLUR_PX)
    for place in places:
        outlines = areas_of(CROSS, np.column_stack([linear, place]))
        col, row, width, height = areas.bounds(outlines)
        col, row, width, height = col - reach, row - reach, width + 2 * reach, height + 2 * reach
        shown = seen_coverage(outlines, col, row, width, height, BLUR_PX)
        grey[row : row + height, col : col + width] -= CONTRAST * shown
    marks = tuple(LayoutMark(f"{x:g}, {y:g}", (x, y), (0.005, 0.005), CROSS) for x, y in camera)
    return scan_of(grey), FiducialLayout(marks, (2 * steps[-1] + 8.0,) * 2), places


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sides", type=int, nargs="*", default=[5, 13, 33])
    parser.add_argument("--seed", type=int, default=3)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print("crosses | px a side | measured | rms, px | processor, s | a cross, ms")
    for side in arguments.sides:
        scan, layout, places = drawn(side, np.random.default_rng([arguments.seed, side]))
        before = time.process_time()
        result = measure_fiducials(scan, layout, (1000 * PITCH_MM,) * 2)
        spent = time.process_time() - before
        errors = [
            mark.center_px - place
            for mark, place in zip(result.marks, places, strict=True)
            if mark.status is Status.MEASURED and mark.center_px is not None
        ]
        rms = float(np.sqrt(np.mean(np.square(errors)))) if errors else np.nan
        each_ms = 1000 * spent / len(places)
        print(f"{len(places)} | {scan.width_px} | {len(errors)} | {rms:.3f} | {spent:.1f} | {each_ms:.0f}", flush=True)


if __name__ == "__main__":
    main()
