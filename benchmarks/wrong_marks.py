"""Four marks on deformed film, one with an error of 1 mm or none: rates of detection and coverage, by simulation.

Each film has a random affinity of the given standard deviation, and a deformation of random size within the range:
quadratic (opposite corners move in opposite directions) or independent by mark. In one frame of a folder one mark is
wrong.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from test_across_frames import FOUR, PX_PER_MM, make_layout

from benchmarks.harness import Row
from measure.fiducials.across_frames import check_frames
from measure.flags import Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation

Array = NDArray[np.float64]
SIGMA_PX, OFF_MM = 0.03, 1.0
CLAIMED = 3.0  # standard deviations within which an error is covered


SHARES = ("named", "another named", "flagged", "covered")
COLUMNS = {"bend": "", "least_mm": "g", "most_mm": "g", "affinity": "g", "count": "d", "off_mm": "g"}
COLUMNS |= dict.fromkeys(SHARES, ".1%")


def cells(frames: int = 200) -> Iterator[Row]:
    """Kinds of folders: range of the deformation, standard deviation of the affinity, number of frames, and error of
    the mark. frames: folders of each kind."""
    for bend, count in product(("quadratic", "mark by mark"), (1, 3, 10, 20)):
        for least, most, affinity, off_mm in (
            (0.02, 0.1, 2e-4, OFF_MM), (0.02, 0.1, 4e-4, OFF_MM), (0.15, 0.15, 2e-4, 0.0), (0.0, 0.005, 2e-4, 0.0),
        ):  # fmt: skip
            yield {
                "bend": bend, "least_mm": least, "most_mm": most, "affinity": affinity, "count": count,
                "off_mm": off_mm, "frames": frames,
            }  # fmt: skip


def case(
    bend: str, least_mm: float, most_mm: float, affinity: float, count: int, off_mm: float, frames: int, seed: int
) -> Row:
    rng = np.random.default_rng(seed)
    outcomes = [outcome(rng, bend, (least_mm, most_mm), affinity, count, off_mm) for _ in range(frames)]
    return dict(zip(SHARES, np.mean(outcomes, axis=0), strict=True))


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
    return FrameMeasurement(name, marks, ScanOrientation("0", True), matrix)
