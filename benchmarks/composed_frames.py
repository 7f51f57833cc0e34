"""Notches, blocks, curves and triangles of real cameras: learned, found in any pose and measured.

PYTHONPATH=. python benchmarks/composed_frames.py MARKS_FOLDER

A folder of four crops (L, T, R, B) is one camera. Frames are put together from them: each crop at its side of a
textured square, its own landscape (what is lighter than Otsu's threshold) exchanged for another, averaged over a few
pixels that begin at other ones in every frame, so that the marks move by known parts of a pixel. Templates are learned
from three frames; the fourth is turned by a quarter, mirrored, and measured as of unknown pose.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.fiducials import measure_fiducials
from measure.learned import cut, template_of
from measure.picture_scan import WholePicture
from measure.resolution import NO_TAGS
from measure.results import FrameMeasurement
from measure.scan import Scan
from measure.shapes import FiducialLayout, LayoutMark

Array = NDArray[np.float64]

SIDES = {"L": (-1, 0), "T": (0, 1), "R": (1, 0), "B": (0, -1)}
SIZE_PX, REACH_PX, PITCH_MM = 1200, 450, 0.1
REDUCED_PX = 160  # of a crop's longer side
NOISE_DN = 1.5
TRUE = np.array([[1 / PITCH_MM, 0.0], [0.0, -1 / PITCH_MM]])


def main() -> None:
    """Print what became of each camera's marks."""
    for folder in sorted({path.parent for path in Path(sys.argv[1]).rglob("*.*")}):
        crops = {path.stem: np.asarray(cv2.imread(str(path), 0), np.uint8) for path in folder.iterdir()}
        if set(SIDES) <= set(crops):
            print(f"{folder.parent.name + '/' + folder.name:16}", told(*measured(crops)))


def measured(crops: dict[str, NDArray[np.uint8]]) -> tuple[FrameMeasurement, dict[str, Array]]:
    """The fourth frame, and the true places of its marks, px."""
    learned = [composed(crops, seed) for seed in (1, 2, 3)]
    size_mm = {side: PITCH_MM * (min(crops[side].shape) / fold(crops[side]) - 8) for side in SIDES}
    marks = []
    for side, (x, y) in SIDES.items():
        chips = [cut(scan, np.column_stack([TRUE, places[side]]), size_mm[side]) for scan, places in learned]
        template = template_of(chips, size_mm[side])
        marks.append(LayoutMark(side, (REACH_PX * PITCH_MM * x, REACH_PX * PITCH_MM * y), (0.05, 0.05), template))
    scan, places = composed(crops, 4)
    grey = scan.window(0, 0, SIZE_PX, SIZE_PX).astype(np.uint8)
    turned = Scan(Path("turned"), WholePicture(np.rot90(grey)[:, ::-1, None]), NO_TAGS)
    layout = FiducialLayout(tuple(marks), (SIZE_PX * PITCH_MM,) * 2)
    # Turned counter-clockwise (col, row) goes to (row, side - col); mirrored, to (side - row, side - col).
    true = {side: SIZE_PX - 1 - place[::-1] for side, place in places.items()}
    return measure_fiducials(turned, layout, (1000 * PITCH_MM,) * 2), true


def composed(crops: dict[str, NDArray[np.uint8]], seed: int) -> tuple[Scan, dict[str, Array]]:
    rng = np.random.default_rng(seed)
    grey, places = landscape(rng, (SIZE_PX, SIZE_PX)), {}
    for side, (x, y) in SIDES.items():
        fine, step = crops[side], fold(crops[side])
        first = rng.integers(step, size=2)  # row and column of the fine pixels that the means begin with
        rows, cols = ((np.array(fine.shape) - first) // step).tolist()
        part = relandscaped(fine, rng)[first[0] : first[0] + rows * step, first[1] : first[1] + cols * step]
        part = part.reshape(rows, step, cols, step).mean(axis=(1, 3))
        top, left = (SIZE_PX // 2 + REACH_PX * np.array([-y, x]) - np.array(fine.shape) // step // 2).tolist()
        grey[top : top + rows, left : left + cols] = part
        middle = np.array(fine.shape) // 2
        places[side] = np.array([left, top]) + ((middle - first + 0.5) / step - 0.5)[::-1]
    grey += rng.normal(0.0, NOISE_DN, grey.shape)
    picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return Scan(Path(f"frame {seed}"), WholePicture(picture[..., None]), NO_TAGS), places


def relandscaped(fine: NDArray[np.uint8], rng: np.random.Generator) -> Array:
    """The crop with another landscape where it is light, through a soft edge."""
    _, light = cv2.threshold(fine, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    share = cv2.GaussianBlur(light.astype(np.float64), (0, 0), 1.5)
    return np.asarray(
        share * landscape(rng, fine.shape) + (1 - share) * np.where(light > 0, np.median(fine[light == 0]), fine)
    )


def landscape(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    coarse, medium = (cv2.GaussianBlur(rng.normal(0.0, 1.0, shape), (0, 0), blur) * blur for blur in (12.0, 3.0))
    return np.asarray(150.0 + 40.0 * coarse + 25.0 * medium)


def fold(fine: NDArray[np.uint8]) -> int:
    return max(1, int(max(fine.shape)) // REDUCED_PX)


def told(frame: FrameMeasurement, true: dict[str, Array]) -> str:
    words = [frame.pose.name + (" decided" if frame.pose.decided else " assumed") if frame.pose else "no frame"]
    for mark in frame.marks:
        off = "" if mark.center_px is None else f" {np.hypot(*(mark.center_px - true[mark.point])):.2f} px"
        words.append(f"{mark.point} {mark.status.value}{off}")
    return ", ".join(words)


if __name__ == "__main__":
    main()
