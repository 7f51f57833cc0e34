"""How well real marks repeat: chips re-sampled by known shifts, and the colour channels of scans against one another.

python -m benchmarks real_marks MARKS_FOLDER [SCANS_FOLDER]

Every picture below MARKS_FOLDER is a mark at full resolution. Means over FOLD x FOLD of its pixels, begun at each of
them in turn, are pictures of the same mark shifted by known parts of a pixel; the first is the template of the others.
So they are again under a Gaussian blur, as soft as the sharpest scans of film. Besides, the pixels are dealt out to
four pictures that share none, so that the scanner's noise of one is not the other's. The ring-crosses of three frames
in SCANS_FOLDER are matched in red, green and blue alone: for each pair of channels the shift that the frame's marks
have in common is the scanner's, what is left is the measurement's.
"""

import sys
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.fiducials.measurement import measure_fiducials
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, MarkTemplate, ring_cross
from measure.matching.match import MatchOptions, mark_window, match
from measure.matching.window import ScanWindow
from measure.results import MarkFit
from measure.scans.opening import open_scan
from measure.scans.scan import Scan

Array = NDArray[np.float64]

FOLD = 4
BLUR_PX = 0.5  # of the softer pictures
SPARE_PX = 8  # of a chip's edge that the template leaves out: room to be shifted
OPTIONS = MatchOptions(freedom="shift", estimate_blur=False)
PX_FROM_MM = np.diag([1.0, -1.0])  # of a template whose pixel is a millimetre

WILD = MarkShape(ring_cross(0.80, 0.17, 1.75, 0.10, 0.08, 45.0), "light")
WILD_FRAMES = ("000b3b38", "08320661", "0b50b18e")
CORNERS_MM = ((106.0, -106.0), (-106.0, -106.0), (-106.0, 106.0), (106.0, 106.0))
CHANNELS = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0)}


def main() -> None:
    """Print both tables."""
    marks = Path(sys.argv[1])
    print(f"{'chip':24} {'pictures':>9} {'rms error px':>13} {'claimed px':>11} {'ratio':>6}")
    for way, resampled in (("phases", phases), ("phases, softer", soft_phases), ("shared pixels: none", dealt)):
        everything: list[Array] = []
        for path in sorted(marks.rglob("*.*")):
            fine = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if fine is not None:
                errors, sigmas = self_consistency(list(resampled(fine.astype(float))))
                print_row("/".join(path.parts[-3:]), errors, sigmas)
                everything.append(np.concatenate([errors, sigmas], axis=1))
        errors, sigmas = np.split(np.concatenate(everything), 2, axis=1)
        print_row(f"all, {way}", errors, sigmas)
        print()
    if len(sys.argv) > 2:
        print(
            f"{'frame':12} {'channels':12} {'common shift px':>18} {'rms left px':>12} {'claimed px':>11} {'ratio':>6}"
        )
        for name in WILD_FRAMES:
            print_channels(Path(sys.argv[2]) / f"{name}.jpeg")


def print_row(name: str, errors: Array, sigmas: Array) -> None:
    if not len(errors):
        print(f"{name:24} {'too small':>9}")
        return
    rms, claimed = (float(np.sqrt((each**2).mean())) for each in (errors, sigmas))
    ratio = float(np.sqrt(((errors / sigmas) ** 2).mean()))
    print(f"{name:24} {len(errors):9d} {rms:13.4f} {claimed:11.4f} {ratio:6.2f}")


def phases(fine: Array) -> Iterator[tuple[Array, tuple[float, float]]]:
    """Means over FOLD x FOLD pixels and the shift of the mark in them, (column, row), against the first."""
    rows, cols = (size // FOLD - 1 for size in fine.shape)
    for row in range(FOLD):
        for col in range(FOLD):
            part = fine[row : row + rows * FOLD, col : col + cols * FOLD]
            yield part.reshape(rows, FOLD, cols, FOLD).mean(axis=(1, 3)), (-col / FOLD, -row / FOLD)


def soft_phases(fine: Array) -> Iterator[tuple[Array, tuple[float, float]]]:
    """The same of a mark that is blurred before."""
    return phases(np.asarray(cv2.GaussianBlur(fine, (0, 0), FOLD * BLUR_PX), float))


def dealt(fine: Array) -> Iterator[tuple[Array, tuple[float, float]]]:
    """Four pictures, each of every second pixel along rows and columns, then means over 2 x 2 of these."""
    rows, cols = (size // 4 for size in fine.shape)
    for row in range(2):
        for col in range(2):
            part = fine[row::2, col::2][: rows * 2, : cols * 2]
            yield part.reshape(rows, 2, cols, 2).mean(axis=(1, 3)), (-col / 4, -row / 4)


def self_consistency(pictures: list[tuple[Array, tuple[float, float]]]) -> tuple[Array, Array]:
    """Errors and claimed standard deviations (n, 2) of all pictures but the first, which is the template."""
    first = pictures[0][0]
    chip = first[SPARE_PX:-SPARE_PX, SPARE_PX:-SPARE_PX]
    middle = (np.array(chip.shape[::-1]) - 1) / 2
    template = MarkTemplate(chip, 1000.0, (float(middle[0]), float(middle[1])))
    errors, sigmas = [], []
    for picture, shift in pictures[1:]:
        true = middle + SPARE_PX + shift
        fit = match(ScanWindow(picture), template, np.column_stack([PX_FROM_MM, np.rint(true)]), OPTIONS)
        if fit.converged:
            errors.append(fit.center_px - true)
            sigmas.append(np.sqrt(np.diag(fit.covariance_px2)))
    return np.array(errors).reshape(-1, 2), np.array(sigmas).reshape(-1, 2)


def print_channels(path: Path) -> None:
    """Each pair of channels: differences of the marks' places less what they have in common."""
    layout = FiducialLayout(
        tuple(LayoutMark(str(k + 1), xy, (0.02, 0.02), WILD) for k, xy in enumerate(CORNERS_MM)), (230.0, 230.0)
    )
    with open_scan(path) as scan:
        frame = measure_fiducials(scan, layout, scan.pitch_um)
        starts = [
            np.column_stack([frame.pixel_from_camera[:, :2], mark.center_px])
            for mark in frame.marks
            if mark.status.is_observation and mark.center_px is not None and frame.pixel_from_camera is not None
        ]
        fits = {name: [in_channel(scan, start, weights) for start in starts] for name, weights in CHANNELS.items()}
    for one, other in combinations(CHANNELS, 2):
        pairs = [(a, b) for a, b in zip(fits[one], fits[other], strict=True) if a.converged and b.converged]
        apart = np.array([a.center_px - b.center_px for a, b in pairs])
        variance = np.array([np.diag(a.covariance_px2 + b.covariance_px2) for a, b in pairs])
        common = (apart / variance).sum(axis=0) / (1 / variance).sum(axis=0)
        left, free = apart - common, len(pairs) - 1
        rms, claimed = np.sqrt((left**2).sum() / 2 / free), np.sqrt(variance.mean())
        ratio = np.sqrt((left**2 / variance).sum() / 2 / free)
        shift = f"{common[0]:+.3f}, {common[1]:+.3f}"
        print(f"{path.stem:12} {one + '-' + other:12} {shift:>18} {rms:12.4f} {claimed:11.4f} {ratio:6.2f}")


def in_channel(scan: Scan, start: Array, weights: tuple[float, ...]) -> MarkFit:
    col0, row0, width, height = mark_window(WILD, start, 10.0)
    grey = scan.window(col0, row0, width, height, weights)
    window = ScanWindow(grey, (col0, row0), is_lossy=scan.is_lossy)
    return match(window, WILD, start, MatchOptions(linear_sigma=0.05))


if __name__ == "__main__":
    main()
