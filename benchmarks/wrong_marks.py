"""Four marks on deformed film, one with an error of 1 mm or none: rates of detection and coverage, by simulation.

python -m benchmarks wrong_marks [FRAMES] [--seed 1]

Each film has a random affinity of the given standard deviation, and a deformation of random size within the range:
quadratic (opposite corners move in opposite directions) or independent by mark. In one frame of a folder one mark is
wrong.
"""

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from test_across_frames import FOUR, PX_PER_MM, make_layout

from measure.fiducials.across_frames import check_frames
from measure.flags import Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose

Array = NDArray[np.float64]
SIGMA_PX, OFF_MM = 0.03, 1.0
CLAIMED = 3.0  # standard deviations within which an error is covered


def main() -> None:
    """Print a line for each kind of folder."""
    parser = argparse.ArgumentParser()
    parser.add_argument("frames", type=int, nargs="?", default=200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print("bend | range, mm | affinity | frames a folder | off, mm | named | another named | flagged | covered")
    for bend in ("quadratic", "mark by mark"):
        for range_mm, affinity, count, off_mm in kinds():
            rng = np.random.default_rng(given.seed)
            rows = [outcome(rng, bend, range_mm, affinity, count, off_mm) for _ in range(given.frames)]
            shares = " | ".join(f"{share:.1%}" for share in np.mean(rows, axis=0))
            print(f"{bend} | {range_mm[0]} to {range_mm[1]} | {affinity} | {count} | {off_mm} | {shares}", flush=True)


def kinds() -> list[tuple[tuple[float, float], float, int, float]]:
    """Range of the deformation, standard deviation of the affinity, number of frames, and error of the mark."""
    rows: list[tuple[tuple[float, float], float, int, float]] = []
    for count in (1, 3, 10, 20):
        rows += [((0.02, 0.1), affinity, count, OFF_MM) for affinity in (2e-4, 4e-4)]
        rows += [((0.15, 0.15), 2e-4, count, 0.0), ((0.0, 0.005), 2e-4, count, 0.0)]
    return rows


def outcome(
    rng: np.random.Generator, bend: str, range_mm: tuple[float, float], affinity: float, count: int, off_mm: float
) -> tuple[bool, bool, bool, bool]:
    """Whether the wrong mark is named, another mark is named, the frame is flagged, and the error is covered."""
    frames = [bent_frame(rng, str(number), bend, rng.uniform(*range_mm), affinity) for number in range(count)]
    wrong, angle = int(rng.integers(4)), rng.uniform(0, 2 * np.pi)
    error_px = PX_PER_MM * off_mm * np.array([np.cos(angle), np.sin(angle)])
    marks = list(frames[0].marks)
    mark = marks[wrong]
    marks[wrong] = MarkMeasurement(
        mark.point, "fiducial", np.asarray(mark.center_px) + error_px, mark.covariance, mark.status
    )
    frames[0] = replace(frames[0], marks=tuple(marks))
    checked = check_frames(frames, make_layout(FOUR), [(1000 / PX_PER_MM,) * 2] * count).frames
    named = {(f.image, m.point) for f in checked for m in f.marks if m.status is not Status.MEASURED}
    own = ("0", mark.point)
    known = checked[0].marks[wrong].covariance
    assert known is not None
    covered = bool((np.abs(error_px) <= CLAIMED * np.sqrt(np.diag(known.px2))).all())
    right = off_mm > 0 and own in named
    return right, bool(named - ({own} if off_mm > 0 else set())), right or bool(checked[0].problems), covered


def bent_frame(rng: np.random.Generator, name: str, bend: str, bend_mm: float, affinity: float) -> FrameMeasurement:
    given = np.array(FOUR)
    size, stretch, shear = rng.normal(0.0, affinity, 3)
    turn = rng.normal(0.0, 0.01)
    linear = np.array([[1 + size + stretch, shear - turn], [shear + turn, 1 + size - stretch]])
    if bend == "quadratic":
        angle = rng.uniform(0, 2 * np.pi)
        bent = bend_mm * np.outer(np.sign(given[:, 0] * given[:, 1]), (np.cos(angle), np.sin(angle)))
    else:
        bent = rng.normal(0.0, bend_mm, given.shape)
    pixel_from_film = PX_PER_MM * np.diag([1.0, -1.0])
    centers = (given @ linear.T + bent) @ pixel_from_film.T + 6000.0 + rng.normal(0.0, SIGMA_PX, given.shape)
    marks = tuple(
        MarkMeasurement(str(k), "fiducial", center, Covariance.from_noise(SIGMA_PX**2 * np.eye(2)), Status.MEASURED)
        for k, center in enumerate(centers)
    )
    matrix = np.column_stack([pixel_from_film @ linear, [6000.0, 6000.0]])
    return FrameMeasurement(name, marks, Pose("0", True), matrix)


if __name__ == "__main__":
    main()
