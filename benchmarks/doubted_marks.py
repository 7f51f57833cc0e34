"""Good marks that are called `weak`: on clean frames, those whose error is below three of their standard deviations.

Each row is two frames of eight marks, on film that moves them by 3 µm, of a camera whose marks are given to 5 µm.
Printed by pitch, radius, contrast (in standard deviations of the noise) and kind of mark, then the reasons.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from drawn import make_scan
from numpy.typing import NDArray
from true_marks import Kind, TrueMark

from benchmarks.harness import Row, table
from measure.fiducials.across_frames import check_frames
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, Part, cross, dot, polygon, ring_cross, ring_dot
from measure.results import FrameMeasurement

KINDS = ("cross", "gap cross", "ring-cross", "ring-dot", "dot", "wedge", "wing")
RADII_PX, SNRS, PITCHES_UM = (5.0, 15.0, 50.0), (10.0, 30.0, 100.0, 500.0), (7.0, 20.0, 60.0)
PLACES = [np.array((x, y)) for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0) if x or y]
FILM_MM, GIVEN_MM = 0.003, 0.005
GROUND_DN, CONTRAST_DN = 20000.0, 15000.0
GOOD_SIGMAS = 3.0


def cells() -> Iterator[Row]:
    for radius_px, kind, snr, pitch_um in product(RADII_PX, KINDS, SNRS, PITCHES_UM):
        yield {"radius_px": radius_px, "kind": kind, "snr": snr, "pitch_um": pitch_um}


def case(radius_px: float, kind: str, snr: float, pitch_um: float, seed: int) -> Row:
    rng = np.random.default_rng([seed, int(radius_px), KINDS.index(kind), int(snr), int(pitch_um)])
    pixel_mm, apart_px = pitch_um / 1000, max(5.0 * radius_px, 100.0)
    shape, given = MarkShape(parts(kind, radius_px, pixel_mm)), [apart_px * pixel_mm * place for place in PLACES]
    marks = [LayoutMark(str(n), (float(x), float(y)), (GIVEN_MM, GIVEN_MM), shape) for n, (x, y) in enumerate(given)]
    layout = FiducialLayout(tuple(marks), (4 * apart_px * pixel_mm,) * 2)
    made = [place + rng.normal(0, GIVEN_MM, 2) for place in given]
    frames, true_px = zip(*(measure_frame(rng, layout, made, snr, pixel_mm, apart_px) for _ in range(2)), strict=True)
    checked = check_frames(frames, layout, [(pitch_um, pitch_um)] * 2).frames
    good, lost, reasons = 0, 0, Counter[str]()
    for frame, places in zip(checked, true_px, strict=True):
        for mark, place in zip(frame.marks, places, strict=True):
            if not mark.status.is_observation or mark.center_px is None or mark.covariance_px2 is None:
                lost += 1
                continue
            error = mark.center_px - place
            if error @ np.linalg.solve(mark.covariance_px2, error) < GOOD_SIGMAS**2:
                good += 1
                reasons[str(mark.reason)[:70]] += mark.status is Status.WEAK
    return {"good": good, "lost": lost, "doubted": {reason: count for reason, count in reasons.items() if count}}


def parts(kind: str, radius_px: float, pixel_mm: float) -> tuple[Part, ...]:
    """Drawing of a mark whose lines are an eighth of its radius wide, at least 1.2 px."""
    radius, line = radius_px * pixel_mm, max(radius_px / 8, 1.2) * pixel_mm
    left = {"wedge": -0.9, "wing": 0.0}.get(kind, 0.0)
    return {
        "cross": lambda: cross(radius, line),
        "gap cross": lambda: cross(radius, line, radius / 4),
        "ring-cross": lambda: ring_cross(radius, line, 1.3 * radius, line, angle_deg=45.0),
        "ring-dot": lambda: ring_dot(radius, line, radius / 3),
        "dot": lambda: dot(radius),
    }.get(kind, lambda: polygon(((0.0, 0.0), (left * radius, 2 * radius), (radius, 2 * radius))))()


def measure_frame(
    rng: np.random.Generator, layout: FiducialLayout, made: list[NDArray[np.float64]], snr: float, pixel_mm: float,
    apart_px: float,
) -> tuple[FrameMeasurement, list[NDArray[np.float64]]]:  # fmt: skip
    """A rendered frame, and the true places of its marks, px."""
    half = int(apart_px / 2) + 8
    side, turn, stretch = int(2 * apart_px) + 2 * half + 30, rng.normal(0, 0.005), rng.normal(0, 5e-4, 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    linear = rotation @ np.diag((1 + stretch) * (1.0, -1.0)) / pixel_mm
    middle, blur_px = side / 2 + rng.uniform(-0.5, 0.5, 2), rng.uniform(0.6, 1.6)
    grey, true_px = GROUND_DN + rng.normal(0, CONTRAST_DN / snr, (side, side)), []
    for mark, place in zip(layout.marks, made, strict=True):
        center_px = linear @ (place + rng.normal(0, FILM_MM, 2)) + middle
        corner = np.rint(center_px).astype(int) - half
        assert isinstance(mark.mark, MarkShape)
        drawn = TrueMark(
            Kind("", mark.mark), np.column_stack([linear, center_px - corner]), 2 * half + 1,
            blur_px * float(np.exp(rng.normal(0, 0.03))),
        )  # fmt: skip
        grey[corner[1] :, corner[0] :][: drawn.size, : drawn.size] += CONTRAST_DN * drawn.picture
        true_px.append(center_px)
    pitch_um = 1000 * pixel_mm
    return measure_fiducials(make_scan(grey), layout, (pitch_um, pitch_um), FiducialOptions(pose="0")), true_px


def report(rows: Sequence[Row]) -> Iterator[str]:
    for name in ("pitch_um", "radius_px", "snr", "kind"):
        lines = []
        for value in sorted({row[name] for row in rows}):
            own = [row for row in rows if row[name] == value]
            doubted = sum(sum(row["doubted"].values()) for row in own)
            sums = {key: sum(row[key] for row in own) for key in ("good", "lost")}
            lines.append({name: value, **sums, "doubted": doubted, "share": doubted / max(sums["good"], 1)})
        yield ""
        yield from table({name: "", "good": "d", "lost": "d", "doubted": "d", "share": ".2%"}, lines)
    reasons = sum((Counter(row["doubted"]) for row in rows), Counter[str]())
    yield from (f"{count:5}  {reason}" for reason, count in reasons.most_common())
