"""How many good marks are doubted: true marks on clean frames, whose error is below three of their standard deviations,
that are called `weak`, by all rules together.

python -m benchmarks doubted_marks OUT.jsonl [--rounds 1] [--seed 1] [--first 0]

Every kind of mark at pitches of 7, 20 and 60 um, with radii of 5 to 150 px and 10 to 500 times the noise: two frames of
eight marks each, on film that scatters them by 3 um, of a camera whose marks are given to 5 um. One line a pair of
frames is added to OUT.jsonl, and pairs that stand there already, or come before --first, are left out. Then the tables
of all its lines are printed: by pitch, radius and signal-to-noise, and why marks were doubted.
"""

import argparse
import json
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from true_marks import Kind, TrueMark

from benchmarks.search import lines
from measure.fiducials.across_frames import check_frames
from measure.fiducials.constellation import Placement
from measure.fiducials.measure_frame import measure_frame
from measure.fiducials.options import FiducialOptions
from measure.fiducials.rows import present_frame
from measure.flags import NO_REASON, Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross, dot, polygon, ring_cross, ring_dot
from measure.results import FrameMeasurement, Pose
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Json = dict[str, Any]

PITCHES_UM = (7.0, 20.0, 60.0)
RADII_PX = (5.0, 15.0, 50.0, 150.0)
SNRS = (10.0, 30.0, 100.0, 500.0)
KINDS = ("cross", "gap cross", "ring-cross", "ring-dot", "dot", "wedge", "wing")
PLACES = tuple((x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y)
FILM_MM, GIVEN_MM = 0.003, 0.005
GROUND_DN, CONTRAST_DN = 20000.0, 15000.0
GOOD_SIGMAS = 3.0


def main() -> None:
    """Measure the pairs of frames that are missing, and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    done = {*range(given.first), *(line["frame"] for line in lines(given.out))}
    cells = product(range(given.rounds), RADII_PX, KINDS, SNRS, PITCHES_UM)
    for number, (_, radius_px, kind, snr, pitch_um) in enumerate(cells):
        if number not in done:
            rng = np.random.default_rng([given.seed, number])
            line = {"frame": number, "kind": kind, "snr": snr, "radius": radius_px, "pitch": pitch_um}
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps({**line, **compared(rng, kind, snr, radius_px, pitch_um / 1000)}) + "\n")
    print_tables(lines(given.out))


def shape_of(kind: str, radius_px: float, mm: float) -> MarkShape:
    """A mark with that radius, mm being a pixel's size; its lines are an eighth of it wide, and 1.2 px at least."""
    radius, line = radius_px * mm, max(radius_px / 8, 1.2) * mm
    if kind == "cross":
        return MarkShape(cross(radius, line))
    if kind == "gap cross":
        return MarkShape(cross(radius, line, radius / 4))
    if kind == "ring-cross":
        return MarkShape(ring_cross(radius, line, 1.3 * radius, line, angle_deg=45.0))
    if kind == "ring-dot":
        return MarkShape(ring_dot(radius, line, radius / 3))
    if kind == "dot":
        return MarkShape(dot(radius))
    half = 0.45 if kind == "wedge" else 0.0
    corners = ((0.0, 0.0), (-half, 1.0), (0.45, 1.0)) if half else ((0.0, 0.0), (0.0, 1.0), (0.55, 1.0))
    return MarkShape(polygon(tuple((2 * radius * x, 2 * radius * y) for x, y in corners)))


def compared(rng: np.random.Generator, kind: str, snr: float, radius_px: float, mm: float) -> Json:
    """How many marks of a pair of frames are good, and why how many of these are doubted."""
    shape = shape_of(kind, radius_px, mm)
    apart_px = max(5.0 * radius_px, 100.0)
    given = [np.array(place) * apart_px * mm for place in PLACES]
    marks = tuple(
        LayoutMark(str(n), (float(x), float(y)), (GIVEN_MM, GIVEN_MM), shape) for n, (x, y) in enumerate(given)
    )
    layout = FiducialLayout(marks, (4 * apart_px * mm,) * 2)
    made = [place + rng.normal(0, GIVEN_MM, 2) for place in given]
    pairs = [drawn_and_measured(rng, layout, made, snr, mm, apart_px) for _ in range(2)]
    checked = check_frames([frame for frame, _ in pairs], layout, [(1000 * mm, 1000 * mm)] * 2).frames
    good, lost, reasons = 0, 0, Counter[str]()
    for frame, (_, truth_px) in zip(checked, pairs, strict=True):
        for mark, true in zip(frame.marks, truth_px, strict=True):
            if not mark.status.is_observation or mark.center_px is None or mark.covariance_px2 is None:
                lost += 1
                continue
            error = mark.center_px - true
            if error @ np.linalg.solve(mark.covariance_px2, error) < GOOD_SIGMAS**2:
                good += 1
                reasons[kind_of(mark.reason)] += mark.status is Status.WEAK
    return {"good": good, "lost": lost, "doubted": {name: count for name, count in reasons.items() if count}}


def kind_of(reason: str) -> str:
    """A reason without its figures."""
    return " ".join(word for word in reason.split() if not any(sign.isdigit() for sign in word))[:70]


def drawn_and_measured(
    rng: np.random.Generator, layout: FiducialLayout, made: list[Array], snr: float, mm: float, apart_px: float
) -> tuple[FrameMeasurement, list[Array]]:
    """A frame, and where its marks lie, px."""
    side = int(2 * apart_px + 2.6 * max(apart_px / 2, 60.0))
    turn, stretch = rng.normal(0, 0.005), rng.normal(0, 5e-4, 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    linear = rotation @ np.diag((1 + stretch) * (1.0, -1.0)) / mm
    middle = side / 2 + rng.uniform(-0.5, 0.5, 2)
    blur_px = rng.uniform(0.6, 1.6)
    grey = np.full((side, side), GROUND_DN)
    truth = []
    for mark, place in zip(layout.marks, made, strict=True):
        center = linear @ (place + rng.normal(0, FILM_MM, 2)) + middle
        truth.append(center)
        picture, corner = drawn(mark.mark, linear, center, blur_px * float(np.exp(rng.normal(0, 0.03))), apart_px)
        grey[corner[1] :, corner[0] :][: len(picture), : len(picture)] += CONTRAST_DN * picture
    grey += rng.normal(0, CONTRAST_DN / snr, grey.shape)
    scan = Scan(Path("clean.tif"), WholePicture(np.rint(grey).astype(np.uint16)[..., None]), NO_TAGS)
    begin = np.column_stack([rotation @ np.diag([1.0, -1.0]) / mm, middle + rng.uniform(-1, 1, 2)])
    placement = Placement("0", begin, 8.0, 8, 1, 1, (mm, mm))
    frame = measure_frame(scan, layout, placement, FiducialOptions())
    return present_frame(scan, layout, frame, Pose("0", True), (1000 * mm, 1000 * mm), (), NO_REASON), truth


def drawn(shape: Any, linear: Array, center: Array, blur_px: float, apart_px: float) -> tuple[Array, Array]:
    """The mark in a window of its own, and the window's first pixel."""
    half = int(0.5 * apart_px + 8)
    corner = np.rint(center).astype(int) - half
    place = np.column_stack([linear, center - corner])
    return TrueMark(Kind("", shape), place, 2 * half + 1, blur_px).picture, corner


def print_tables(rows: list[Json]) -> None:
    """Shares of good marks that are doubted, and the reasons."""
    for name in ("pitch", "radius", "snr", "kind"):
        for value in sorted({row[name] for row in rows}, key=str):
            own = [row for row in rows if row[name] == value]
            good, doubted = sum(row["good"] for row in own), sum(sum(row["doubted"].values()) for row in own)
            lost, share = sum(row["lost"] for row in own), doubted / max(good, 1)
            print(f"{name:>7} {value!s:>10}: {good:5} good marks, {doubted:4} doubted, {share:6.2%}; {lost} not found")
    for reason, count in sum((Counter(row["doubted"]) for row in rows), Counter[str]()).most_common():
        print(f"{count:5}  {reason}")


if __name__ == "__main__":
    main()
