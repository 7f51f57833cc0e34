"""What writing beside the frame tells of the pose, in rendered frames, against their truth.

python benchmarks/data_strip.py [FRAMES] [FIRST]

The frames are those of the study of search and pose, with marks alike: a strip of text and dials is written on one side
of them, over whatever stands there, and the camera says on which. Each is also measured without the strip, though the
camera has one: then whatever else stands beside the frame must not be taken for it.
"""

import sys
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from search_frames import FRAME_MM, SIDES, Case, draw_case

from measure.fiducials import measure_fiducials
from measure.marks.shapes import Side
from measure.pose.data_strip import DIRECTIONS, side_in_scan
from measure.results import FrameMeasurement
from measure.scans.picture_scan import WholePicture
from measure.scans.resolution import NO_TAGS
from measure.scans.scan import Scan

Array = NDArray[np.float64]

SEED = 77
SHEET_PX = (52, 860)  # of the strip, as long as the frame
GAP_MM = 0.25  # between frame and strip
LETTERS = list("ABCEFHKLMNTXYZ0123456789.-")


def main() -> None:
    """Print what became of the poses."""
    frames, first = (int(text) for text in (*sys.argv[1:], "150", "0")[:2])
    tally: dict[str, Counter[str]] = {"written": Counter(), "not written": Counter()}
    for index in range(first, first + frames):
        case, rng = draw_case(SEED, index), np.random.default_rng([SEED, index])
        strip = SIDES[rng.integers(len(SIDES))]
        scans = {"written": written_on(case, strip, rng), "not written": case.scan}
        for name, scan in scans.items():
            result = measure_fiducials(scan, replace(case.layout, data_strip=strip), given_pitch(case))
            told = outcome(result, strip, case.pose)
            tally[name][told] += 1
            if "WRONG" in told or "wrong" in told:
                print(f"frame {index}, {name}: {told}; {case.symmetry}, {case.picture}; {result.pose}")
    for name, counts in tally.items():
        print(f"{name}: {', '.join(f'{told} {count}' for told, count in sorted(counts.items()))}")


def given_pitch(case: Case) -> tuple[float, float] | None:
    return None if case.pitch_um is None else (case.pitch_um, case.pitch_um)


def outcome(result: FrameMeasurement, strip: Side, true: str) -> str:
    """Whether the pose is right, and what the strip said."""
    if result.pose is None:
        return "refused"
    decided = "assumed" if not result.pose.decided else "right" if result.pose.name == true else "WRONG"
    if not any("data strip" in sentence for sentence in result.pose.evidence):
        return f"{decided}, strip silent"
    right = side_in_scan(strip, result.pose.name) == side_in_scan(strip, true)
    speaks_for = any("speaks for the pose" in sentence for sentence in result.pose.evidence)
    return f"{decided}, strip {'right' if right == speaks_for else 'wrong'}"


def written_on(case: Case, strip: Side, rng: np.random.Generator) -> Scan:
    """The frame with text and dials beside a side of the drawing, by 0.3 of full scale and more from the film."""
    grey = case.scan.window(0, 0, case.scan.width_px, case.scan.height_px)
    places = np.array([(*mark.xy_mm, 1.0) for mark in case.layout.marks])
    centers = np.array([case.centers_px[mark.id] for mark in case.layout.marks])
    pixel_from_camera = np.linalg.lstsq(places, centers, rcond=None)[0].T
    out = np.array(DIRECTIONS[strip], dtype=float)
    along = np.array([-out[1], out[0]])
    rows, cols = SHEET_PX
    mm = FRAME_MM / cols
    begin = out * (FRAME_MM / 2 + GAP_MM + rows * mm) - along * FRAME_MM / 2
    pixel_from_sheet = pixel_from_camera[:, :2] @ np.column_stack([along * mm, -out * mm, begin])
    pixel_from_sheet[:, 2] += pixel_from_camera[:, 2]
    cover = cv2.warpAffine(sheet(rng), pixel_from_sheet, grey.shape[::-1])
    border = float(np.median(grey[:5]))  # of the film, about
    full = case.scan.full_scale_dn
    tone = rng.uniform(border + 0.3 * full, full) if border < 0.5 * full else rng.uniform(0.0, border - 0.3 * full)
    stored = np.rint(grey * (1 - cover) + cover * tone).astype(np.uint16)
    return Scan(case.scan.path, WholePicture(stored[..., None]), NO_TAGS)


def sheet(rng: np.random.Generator) -> NDArray[np.float32]:
    """Words in one or two lines, dials, and empty film, mirrored or not."""
    letters = np.zeros(SHEET_PX, np.uint8)
    col = 10
    while col < SHEET_PX[1] - 120:
        kind, size = rng.random(), float(rng.uniform(0.35, 0.6))
        if kind < 0.6:
            word = "".join(rng.choice(LETTERS, int(rng.integers(3, 9))))
            for line in range(int(rng.integers(1, 3))):
                cv2.putText(letters, word, (col, 20 + 18 * line), 0, size, 255, 1, cv2.LINE_AA)
            col += int(len(word) * 20 * size)
        elif kind < 0.8:
            cv2.circle(letters, (col + 20, 26), 18, 255, -1, cv2.LINE_AA)
            cv2.line(letters, (col + 20, 26), (col + 32, 16), 0, 2)
            col += 50
        col += int(rng.integers(10, 120))
    mirrored = letters[:, ::-1] if rng.random() < 0.5 else letters
    return (mirrored / 255).astype(np.float32)


if __name__ == "__main__":
    main()
