"""Frames measured with their pose left open and with it set: whatever is found with the true pose set must be found
with `pose = "auto"`, of every kind of mark.

python benchmarks/pose_left_open.py OUT.jsonl [--frames 300] [--first 0] [--seed 1]

One line a frame is added to OUT.jsonl, and frames that stand there already are left out. Then the table of all its
lines is printed: how many marks are found with the true pose set, with the pose that auto took set, and with auto.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from search import lines
from search_frames import FRAME_MM, GIVEN_SIGMA_MM, Case, case_of, draw_case

from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, polygon, turned
from measure.results import FrameMeasurement
from synthetic_images.scene import Tones

Json = dict[str, Any]
Outline = tuple[tuple[float, float], ...]

SAME_PX = 0.5  # two places of one mark
EDGE_MM = FRAME_MM / 2
# Outlines with the point at (0, 0), x outwards: of what casts a shadow, up to the frame's edge; of what lets light
# through beside the frame, beyond it.
SOLID: dict[str, Outline] = {
    "half-wedge": ((0.0, 0.0), (1.8, 0.0), (1.8, 1.0)),
    "wedge": ((0.0, 0.0), (1.8, -0.8), (1.8, 0.8)),
    "slim half-wedge": ((0.0, 0.0), (2.4, 0.0), (2.4, 0.8)),
    "notch": ((0.0, 0.0), (-1.2, 0.9), (-1.2, -0.9)),
}
OVERLAP_MM = 0.2
SOLID_TONES = Tones(border=0.06, background=0.4, contrast=0.06, mark=0.5, dark_mark=0.06)
DRAWN = 4  # of eight frames: of the kinds, disturbances and symmetries of the study of the search


def main() -> None:
    """Measure the frames that are missing, and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    done = {line["frame"] for line in lines(given.out)}
    for index in range(given.first, given.first + given.frames):
        if index not in done:
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"frame": index, **compared(some_case(given.seed, index))}) + "\n")
    print_table(lines(given.out))


def some_case(seed: int, index: int) -> Case:
    """Half of the frames as the study of the search draws them, half with solid marks at the frame's border."""
    if index % (2 * DRAWN) < DRAWN:
        return draw_case(seed, index)
    rng = np.random.default_rng([seed, index])
    kind = tuple(SOLID)[index % DRAWN]
    return case_of(rng, kind, "alike", solid_layout(rng, SOLID[kind]), f"{index}.tif", SOLID_TONES)


def solid_layout(rng: np.random.Generator, outline: Outline) -> FiducialLayout:
    """Four marks at the middles of the sides, each turned by a quarter, or also mirrored about its axis."""
    beyond = max(x for x, _ in outline) == 0.0
    at = EDGE_MM - (min(x for x, _ in outline) + OVERLAP_MM if beyond else max(x for x, _ in outline))
    mirrored = bool(rng.random() < 0.3)
    marks = []
    for number in range(4):
        sign = -1.0 if mirrored and number % 2 else 1.0
        drawn = MarkShape(polygon(tuple((x, sign * y) for x, y in outline)), polarity="light" if beyond else "dark")
        shape = turned(drawn, 90.0 * number)
        place = np.round(at * np.array([np.cos(number * np.pi / 2), np.sin(number * np.pi / 2)]), 6)
        marks.append(LayoutMark(str(number + 1), (float(place[0]), float(place[1])), (GIVEN_SIGMA_MM,) * 2, shape))
    return FiducialLayout(tuple(marks), (FRAME_MM, FRAME_MM))


def compared(case: Case) -> Json:
    """How many marks are found with the pose left open, with the true one and with the one that auto took set."""
    auto = measured(case, "auto")
    taken = auto.pose.name if auto.pose else case.pose
    true = measured(case, case.pose)
    same = true if taken == case.pose else measured(case, taken)
    return {
        "kind": case.kind,
        "symmetry": case.symmetry,
        "pose": [case.pose, taken, bool(auto.pose and auto.pose.decided)],
        "visible": len(case.centers_px) - len(case.hidden),
        "true": len(right(case, true)),
        "taken": len(right(case, same)),
        "auto": len(right(case, auto)),
        "lost": lost(right(case, true), auto),
        "lost of taken": lost(right(case, same), auto),
        "weaker": sum(a > b for a, b in zip(measured_well(auto), measured_well(true), strict=True)),
    }


def measured(case: Case, pose: str) -> FrameMeasurement:
    """As a user would draw the marks: neither light nor dark."""
    pitch = None if case.pitch_um is None else (case.pitch_um, case.pitch_um)
    marks = tuple(replace(mark, mark=replace(mark.mark, polarity="auto")) for mark in case.layout.marks)
    layout = replace(case.layout, marks=marks)
    return measure_fiducials(case.scan, layout, pitch, FiducialOptions(pose=pose))


def measured_well(frame: FrameMeasurement) -> list[int]:
    return [sum(mark.status == status for mark in frame.marks) for status in ("weak",)]


def right(case: Case, frame: FrameMeasurement) -> list[np.ndarray]:
    """Places of the marks found that are those of marks of the camera, whatever their names."""
    truth = np.array(list(case.centers_px.values()))
    seen = [mark.center_px for mark in frame.marks if mark.status.is_observation and mark.center_px is not None]
    return [place for place in seen if np.hypot(*(truth - place).T).min() < SAME_PX]


def lost(found: list[np.ndarray], auto: FrameMeasurement) -> int:
    """How many of the places found are none of those that are found with the pose left open."""
    seen = [mark.center_px for mark in auto.marks if mark.status.is_observation and mark.center_px is not None]
    return sum(not any(np.hypot(*(place - other)) < SAME_PX for other in seen) for place in found)


def print_table(rows: list[Json]) -> None:
    """A line a kind."""
    print(f"{'kind':>16} frames visible  true taken  auto  lost of taken  frames that lost")
    for kind in (*sorted({row["kind"] for row in rows}), "all"):
        own = [row for row in rows if kind in (row["kind"], "all")]
        sums = [sum(row[name] for row in own) for name in ("visible", "true", "taken", "auto", "lost", "lost of taken")]
        losing = [row["frame"] for row in own if row["lost"] or row["lost of taken"]]
        print(
            f"{kind:>16} {len(own):6} {sums[0]:7} {sums[1]:5} {sums[2]:5} {sums[3]:5} {sums[4]:5} {sums[5]:5}    ",
            losing,
        )


if __name__ == "__main__":
    main()
