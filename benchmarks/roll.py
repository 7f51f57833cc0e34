"""What reading costs on the frames of a roll: a few of them as wholes, on the others the line that shows how they lie.

python -m benchmarks roll [FRAMES] [TURNED]

FRAMES frames of one camera whose four marks are alike, with the titles of the roll, a number of their own, and other
grain and dust; TURNED of them were laid on the scanner otherwise. Each is measured with nothing read, with the known
lines of the roll, and read as a whole.
"""

import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.writing import AT_MM, FRAME_MM, PITCH_UM, line, scene, stored
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, WrittenPlace, ring_cross
from measure.results import FrameMeasurement
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from pipeline.measuring.roll import known_lines
from synthetic_images.background import scene_background
from synthetic_images.frame import make_frame
from synthetic_images.render import grey_strips

SEED = 71
READ_FIRST = 4
CORNERS = ((AT_MM, -AT_MM), (-AT_MM, -AT_MM), (-AT_MM, AT_MM), (AT_MM, AT_MM))
MARK = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1))
MARKS = tuple(LayoutMark(str(number), xy, (0.005, 0.005), MARK) for number, xy in enumerate(CORNERS, 1))
PLACES = (WrittenPlace("left", "90"), WrittenPlace("right", "270", plate=True))
LAYOUT = FiducialLayout(MARKS, (FRAME_MM, FRAME_MM), PLACES)


def main() -> None:
    """Print the table."""
    frames, turned = (int(text) for text in (*sys.argv[1:3], "40", "4")[:2])
    rng = np.random.default_rng(SEED)
    odd = set(rng.permutation(np.arange(READ_FIRST, frames))[:turned].tolist())
    scans = [rolled(index, "90" if index not in odd else str(rng.choice(POSES))) for index in range(frames)]
    first = [measured(scan, FiducialOptions(writing="pose"))[0] for scan, _ in scans[:READ_FIRST]]
    known = known_lines(first)
    print(f"known lines: {[(each.text, each.pose, each.side) for each in known]}")
    silent = np.array([measured(scan, FiducialOptions(writing="none"))[1] for scan, _ in scans[READ_FIRST:]])
    for name, lines in (("known lines", known), ("whole", ())):
        results = [measured(scan, FiducialOptions(writing="pose", known_lines=lines)) for scan, _ in scans[READ_FIRST:]]
        cost = np.array([seconds for _, seconds in results]) - silent
        outcomes = Counter(
            outcome(frame, true) for (frame, _), (_, true) in zip(results, scans[READ_FIRST:], strict=True)
        )
        print(f"{name}: CPU of reading a frame {cost.mean():.2f} s, median {np.median(cost):.2f}: {dict(outcomes)}")


def rolled(index: int, pose: str) -> tuple[Scan, str]:
    """A frame's scan and its pose."""
    titles = np.random.default_rng(SEED)
    texts = ("DEVELOPMENT RECORD", "RUN 20", "7/7/89", f"8{index:03d}")
    lines = [line(titles, text, "left", "90", slot) for slot, text in enumerate(texts)]
    lines.append(line(titles, "Nr 13043 152.75", "right", "270", 0))
    rng = np.random.default_rng([SEED, index])
    made = scene(rng, MARKS, tuple(lines))
    made = replace(made, images=(replace(made.images[0], pose=pose),), scanner=replace(made.scanner, negative=False))
    grey = np.concatenate(list(grey_strips(make_frame(made, 0), 0, scene_background(made))))
    return Scan(Path(f"{index}.tif"), WholePicture(stored(rng, grey)[..., None]), NO_TAGS), pose


def measured(scan: Scan, options: FiducialOptions) -> tuple[FrameMeasurement, float]:
    """The frame, and the CPU seconds that it took."""
    start = time.process_time()
    frame = measure_fiducials(scan, LAYOUT, (PITCH_UM, PITCH_UM), options)
    return frame, time.process_time() - start


def outcome(frame: FrameMeasurement, true: str) -> str:
    """Of one frame."""
    if frame.pose is None:
        return "not found"
    right = "right" if frame.pose.name == true else "WRONG"
    return f"{'decided' if frame.pose.decided else 'assumed'} {right}"


if __name__ == "__main__":
    main()
