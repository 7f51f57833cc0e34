"""Frames measured with automatic and with given scan orientation (pose): marks found with the true pose must also be
found with `pose = "auto"`, for all kinds of marks.

The tables give the numbers of marks found with the true pose, with the pose chosen by auto given, and with auto; of
marks with another status under auto than under the true pose; and of weak marks, with their errors relative to the
claimed sigmas. With --auto the poses are not given: for the study of weak marks.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.harness import Row, table
from benchmarks.search_frames import FRAME_MM, GIVEN_SIGMA_MM, PITCH_UM, SearchCase, draw_case, make_case
from measure.fiducials.across_frames import check_frames
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, Polarity, polygon, rotate_mark
from measure.results import FrameMeasurement, MarkMeasurement
from measure.tone.curve import Tone
from synthetic_images.scene import Tones

Outline = tuple[tuple[float, float], ...]

SAME_PX = 0.5  # px, largest distance between two places of one mark
EDGE_MM = FRAME_MM / 2
# Outlines with the point at (0, 0), x outwards: dark shapes that end at the frame's edge; light notches beyond it.
SOLID: dict[str, Outline] = {
    "half-wedge": ((0.0, 0.0), (1.8, 0.0), (1.8, 1.0)),
    "wedge": ((0.0, 0.0), (1.8, -0.8), (1.8, 0.8)),
    "slim half-wedge": ((0.0, 0.0), (2.4, 0.0), (2.4, 0.8)),
    "notch": ((0.0, 0.0), (-1.2, 0.9), (-1.2, -0.9)),
}
OVERLAP_MM = 0.2
# Dark shapes that reach into the frame from far beyond its edge, in a border with its own texture.
INTO_THE_FRAME: dict[str, Outline] = {
    "slanted block": ((0.0, 0.0), (2.8, 0.0), (2.8, -1.4), (0.56, -1.4)),
    "block": ((0.0, -0.7), (2.8, -0.7), (2.8, 0.7), (0.0, 0.7)),
    "wide half-wedge": ((0.0, 0.0), (2.8, 0.0), (2.8, 1.9)),
    "pointed block": ((0.0, 0.0), (0.7, -0.7), (2.8, -0.7), (2.8, 0.7), (0.7, 0.7)),
}
INSIDE_MM = 1.87  # mm, distance of their point from the frame's edge
UNEVEN_MM = 0.2  # mm, largest difference of their coordinates from those of a symmetric frame
SOLID_TONES = Tones(border=0.06, background=0.4, contrast=0.06, mark=0.5, dark_mark=0.06)
DRAWN = 4  # of twelve frames, those drawn as in the study of the search
WRONG_SIGMAS = 5.0


SUMS = ("visible", "true", "taken", "auto", "lost", "lost of taken", "other status")


def cells(frames: int = 300, first: int = 0) -> Iterator[Row]:
    yield from ({"frame": index} for index in range(first, first + frames))


def case(frame: int, seed: int, pitch_um: float = PITCH_UM, auto: bool = False) -> Row:
    return compared(some_case(seed, frame, pitch_um), auto)


def some_case(seed: int, index: int, pitch_um: float) -> SearchCase:
    """Draw a frame: a third as in the study of the search, a third with solid marks at the frame's border, and a third
    with marks that reach into it."""
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
        return make_case(rng, kind, "alike", layout, f"{index}.tif", SOLID_TONES, pitch_um=pitch_um)
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
    return make_case(rng, kind, "uneven", layout, f"{index}.tif", tones, gamma, pitch_um)


def solid_layout(rng: np.random.Generator, outline: Outline, at_mm: float, uneven_mm: float = 0.0) -> FiducialLayout:
    """Four marks at the middles of the sides, each rotated by a quarter turn, in some layouts every other one mirrored.
    at_mm: distance from the centre; uneven_mm: largest random offset of their coordinates."""
    mirrored = bool(rng.random() < 0.3)
    polarity: Polarity = "light" if max(x for x, _ in outline) == 0.0 else "dark"
    marks = []
    for number in range(4):
        sign = -1.0 if mirrored and number % 2 else 1.0
        drawn = MarkShape(polygon(tuple((x, sign * y) for x, y in outline)), polarity=polarity)
        shape = rotate_mark(drawn, 90.0 * number)
        place = at_mm * np.array([np.cos(number * np.pi / 2), np.sin(number * np.pi / 2)])
        place = np.round(place + (rng.uniform(-uneven_mm, uneven_mm, 2) if uneven_mm else 0.0), 6)
        marks.append(LayoutMark(str(number + 1), (float(place[0]), float(place[1])), (GIVEN_SIGMA_MM,) * 2, shape))
    return FiducialLayout(tuple(marks), (FRAME_MM, FRAME_MM))


def compared(case: SearchCase, only_auto: bool) -> Row:
    """Compare the marks found with automatic pose, with the true pose, and with the pose chosen by auto given."""
    auto = measure_frame(case, "auto")
    taken = auto.pose.name if auto.pose else case.pose
    true = auto if only_auto else measure_frame(case, case.pose)
    same = true if only_auto or taken == case.pose else measure_frame(case, taken)
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


def measure_frame(case: SearchCase, pose: str) -> FrameMeasurement:
    """Measure a frame as `reseau measure` does the only frame of a camera, with marks of unspecified polarity, as drawn
    by a user."""
    pitch = None if case.pitch_um is None else (case.pitch_um, case.pitch_um)
    marks = tuple(replace(mark, mark=replace(mark.mark, polarity="auto")) for mark in case.layout.marks)
    layout = replace(case.layout, marks=marks)
    frame = measure_fiducials(case.scan.replace_tone(Tone.unknown()), layout, pitch, FiducialOptions(pose=pose))
    found_um = 1000 / (frame.px_per_mm or 1.0)
    return check_frames([frame], layout, [pitch or (found_um, found_um)]).frames[0]


def sigmas_off(case: SearchCase, frame: FrameMeasurement, status: str) -> list[float]:
    """Errors, in claimed sigmas, of the marks of a status, each from the nearest true place."""
    truth = np.array(list(case.centers_px.values()))
    return [sigmas(mark, truth) for mark in frame.marks if mark.status == status]


def sigmas(mark: MarkMeasurement, truth: np.ndarray) -> float:
    """Mahalanobis distance of a mark from the nearest of places (n, 2)."""
    off = truth - mark.center_px
    inverse = np.linalg.inv(np.asarray(mark.covariance_px2))
    return round(float(np.sqrt(np.einsum("ni,ij,nj->n", off, inverse, off).min())), 2)


def other_statuses(one: FrameMeasurement, other: FrameMeasurement) -> int:
    """Difference of the numbers of marks with one status between two results, whatever their names."""
    counts = [Counter(str(mark.status) for mark in frame.marks) for frame in (one, other)]
    return max(abs(counts[0][status] - counts[1][status]) for status in ("measured", "weak"))


def right(case: SearchCase, frame: FrameMeasurement) -> list[np.ndarray]:
    """Places of the marks found that coincide with true marks, whatever their names."""
    truth = np.array(list(case.centers_px.values()))
    return [place for place in observed_places(frame) if np.hypot(*(truth - place).T).min() < SAME_PX]


def lost(found: list[np.ndarray], auto: FrameMeasurement) -> int:
    """Number of places found that were not found with automatic pose."""
    places = observed_places(auto)
    return sum(not any(np.hypot(*(place - other)) < SAME_PX for other in places) for place in found)


def observed_places(frame: FrameMeasurement) -> list[np.ndarray]:
    return [mark.center_px for mark in frame.marks if mark.status.is_observation and mark.center_px is not None]


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Table with one line for each kind of mark."""
    columns = {"kind": "", "frames": "d", **dict.fromkeys(SUMS, "d")}
    counts = {f"{status}{off}": "d" for status in ("weak", "measured") for off in ("", f" > {WRONG_SIGMAS:g}")}
    lines = []
    for kind in (*sorted({row["kind"] for row in rows}), "all"):
        own = [row for row in rows if kind in (row["kind"], "all")]
        line = {"kind": kind, "frames": len(own), **{name: sum(row[name] for row in own) for name in SUMS}}
        for status in ("weak", "measured"):
            sigmas = [value for row in own for value in row[f"{status} sigmas"]]
            line |= {status: len(sigmas), f"{status} > {WRONG_SIGMAS:g}": sum(each > WRONG_SIGMAS for each in sigmas)}
        lost = [row["frame"] for row in own if row["lost"] or row["lost of taken"]]
        lines.append(line | {"frames that lost": " ".join(map(str, lost))})
    return table(columns | counts | {"frames that lost": ""}, lines)
