"""Frames measured with their pose left open and with it set: whatever is found with the true pose set must be found
with `pose = "auto"`, of every kind of mark.

python -m benchmarks pose_left_open OUT.jsonl [--frames 300] [--first 0] [--seed 1] [--pitch 28] [--auto]

One line a frame is added to OUT.jsonl, and frames that stand there already are left out. Then the table of all its
lines is printed: how many marks are found with the true pose set, with the pose that auto took set, and with auto; how
many have another status with auto than with the true pose set; and how many are weak, and how far off by their own
claims. With --auto the poses are not set: for the study of weak marks.
"""

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.search import lines
from benchmarks.search_frames import FRAME_MM, GIVEN_SIGMA_MM, PITCH_UM, Case, case_of, draw_case
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, Polarity, polygon, turned
from measure.results import FrameMeasurement, MarkMeasurement
from measure.tone.curve import Tone
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
# Shadows of what reaches into the frame from far beyond its edge, in a border with a texture of its own.
INTO_THE_FRAME: dict[str, Outline] = {
    "slanted block": ((0.0, 0.0), (2.8, 0.0), (2.8, -1.4), (0.56, -1.4)),
    "block": ((0.0, -0.7), (2.8, -0.7), (2.8, 0.7), (0.0, 0.7)),
    "wide half-wedge": ((0.0, 0.0), (2.8, 0.0), (2.8, 1.9)),
    "pointed block": ((0.0, 0.0), (0.7, -0.7), (2.8, -0.7), (2.8, 0.7), (0.7, 0.7)),
}
INSIDE_MM = 1.87  # of it
UNEVEN_MM = 0.2  # at most, by which these marks' coordinates differ from those of a symmetric frame
SOLID_TONES = Tones(border=0.06, background=0.4, contrast=0.06, mark=0.5, dark_mark=0.06)
DRAWN = 4  # of twelve frames: of the kinds, disturbances and symmetries of the study of the search
WRONG_SIGMAS = 5.0


def main() -> None:
    """Measure the frames that are missing, and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pitch", type=float, default=PITCH_UM)
    parser.add_argument("--auto", action="store_true")
    given = parser.parse_args()
    done = {line["frame"] for line in lines(given.out)}
    for index in range(given.first, given.first + given.frames):
        if index not in done:
            with given.out.open("a", encoding="utf-8") as file:
                case = some_case(given.seed, index, given.pitch)
                file.write(json.dumps({"frame": index, **compared(case, given.auto)}) + "\n")
    print_table(lines(given.out))


def some_case(seed: int, index: int, pitch_um: float) -> Case:
    """A third of the frames as the study of the search draws them, a third with solid marks at the frame's border, and
    a third with marks that reach into it."""
    group = index // DRAWN % 3
    if group == 0:
        return draw_case(seed, index, pitch_um)
    rng = np.random.default_rng([seed, index])
    outlines = (SOLID, INTO_THE_FRAME)[group - 1]
    kind = tuple(outlines)[index % DRAWN]
    outline = outlines[kind]
    if group == 1:
        beyond = max(x for x, _ in outline) == 0.0
        at = EDGE_MM - (min(x for x, _ in outline) + OVERLAP_MM if beyond else max(x for x, _ in outline))
        layout = solid_layout(rng, outline, at)
        return case_of(rng, kind, "alike", layout, f"{index}.tif", SOLID_TONES, pitch_um=pitch_um)
    layout = solid_layout(rng, outline, EDGE_MM - INSIDE_MM, UNEVEN_MM)
    border = float(rng.uniform(0.04, 0.25))
    tones = Tones(
        border=border,
        border_contrast=float(rng.uniform(0.0, 0.05)),
        background=border + float(rng.uniform(0.15, 0.5)),
        contrast=float(rng.uniform(0.01, 0.06)),
        mark=0.9,
        dark_mark=border,
    )
    gamma = float(rng.choice([0.8, 1.0, 1.6, 2.2]))
    return case_of(rng, kind, "uneven", layout, f"{index}.tif", tones, gamma, pitch_um)


def solid_layout(rng: np.random.Generator, outline: Outline, at_mm: float, uneven_mm: float = 0.0) -> FiducialLayout:
    """Four marks at the middles of the sides, so far from the frame's, each turned by a quarter, or also mirrored about
    its axis. uneven_mm: by which their coordinates differ at most from such a figure."""
    mirrored = bool(rng.random() < 0.3)
    polarity: Polarity = "light" if max(x for x, _ in outline) == 0.0 else "dark"
    marks = []
    for number in range(4):
        sign = -1.0 if mirrored and number % 2 else 1.0
        drawn = MarkShape(polygon(tuple((x, sign * y) for x, y in outline)), polarity=polarity)
        shape = turned(drawn, 90.0 * number)
        place = at_mm * np.array([np.cos(number * np.pi / 2), np.sin(number * np.pi / 2)])
        place = np.round(place + (rng.uniform(-uneven_mm, uneven_mm, 2) if uneven_mm else 0.0), 6)
        marks.append(LayoutMark(str(number + 1), (float(place[0]), float(place[1])), (GIVEN_SIGMA_MM,) * 2, shape))
    return FiducialLayout(tuple(marks), (FRAME_MM, FRAME_MM))


def compared(case: Case, only_auto: bool) -> Json:
    """How many marks are found with the pose left open, with the true one and with the one that auto took set."""
    auto = measured(case, "auto")
    taken = auto.pose.name if auto.pose else case.pose
    true = auto if only_auto else measured(case, case.pose)
    same = true if only_auto or taken == case.pose else measured(case, taken)
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
        "other status": other_statuses(auto, true),
        **{f"{status} sigmas": sigmas_off(case, auto, status) for status in ("weak", "measured")},
    }


def measured(case: Case, pose: str) -> FrameMeasurement:
    """As a user would draw the marks: neither light nor dark."""
    pitch = None if case.pitch_um is None else (case.pitch_um, case.pitch_um)
    marks = tuple(replace(mark, mark=replace(mark.mark, polarity="auto")) for mark in case.layout.marks)
    layout = replace(case.layout, marks=marks)
    return measure_fiducials(case.scan.replace_tone(Tone.unknown()), layout, pitch, FiducialOptions(pose=pose))


def sigmas_off(case: Case, frame: FrameMeasurement, status: str) -> list[float]:
    """How far each mark of a status lies from the nearest mark of the camera, by its own claim."""
    truth = np.array(list(case.centers_px.values()))
    return [sigmas(mark, truth) for mark in frame.marks if mark.status == status]


def sigmas(mark: MarkMeasurement, truth: np.ndarray) -> float:
    """How far a mark lies from the nearest of places (n, 2), in its standard deviations."""
    off = truth - mark.center_px
    inverse = np.linalg.inv(np.asarray(mark.covariance_px2))
    return round(float(np.sqrt(np.einsum("ni,ij,nj->n", off, inverse, off).min())), 2)


def other_statuses(one: FrameMeasurement, other: FrameMeasurement) -> int:
    """How many marks, whatever their names, are measured in one and weak or not found in the other."""
    counts = [Counter(str(mark.status) for mark in frame.marks) for frame in (one, other)]
    return max(abs(counts[0][status] - counts[1][status]) for status in ("measured", "weak"))


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
    print(
        f"{'kind':>16} frames visible  true taken  auto  lost of taken   other"
        f" weak >{WRONG_SIGMAS:.0f} measured >{WRONG_SIGMAS:.0f} frames that lost"
    )
    for kind in (*sorted({row["kind"] for row in rows}), "all"):
        own = [row for row in rows if kind in (row["kind"], "all")]
        sums = [sum(row[name] for row in own) for name in ("visible", "true", "taken", "auto", "lost", "lost of taken")]
        losing = [row["frame"] for row in own if row["lost"] or row["lost of taken"]]
        other = sum(row["other status"] for row in own)
        claims = [
            part
            for off in ([x for row in own for x in row[f"{status} sigmas"]] for status in ("weak", "measured"))
            for part in (len(off), sum(value > WRONG_SIGMAS for value in off))
        ]
        print(
            f"{kind:>16} {len(own):6} {sums[0]:7} {sums[1]:5} {sums[2]:5} {sums[3]:5} {sums[4]:5} {sums[5]:5}",
            f"   {other:6} {claims[0]:4} {claims[1]:2} {claims[2]:9} {claims[3]:2}",
            losing,
        )


if __name__ == "__main__":
    main()
