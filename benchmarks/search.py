"""Search of marks and scan orientation (pose) in rendered frames, against the true values.

python -m benchmarks search OUT.jsonl [--frames 600] [--first 0] [--seed 1]

A line per frame is appended to OUT.jsonl, and frames already in it are skipped, so that a run can be continued; two
runs with different frames may share the file. Then the tables of all its lines are printed. With --only INDEX one frame
is printed mark by mark, and its image is written to the folder of OUT.jsonl.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.search_frames import KINDS, SYMMETRIES, Case, draw_case
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.results import FrameMeasurement, MarkMeasurement

Json = dict[str, Any]

WRONG_SIGMAS = 5.0
WRONG_PX = 0.5  # px; a mark is wrong if its error exceeds this and WRONG_SIGMAS
OUTCOMES = ("all marks", "some marks", "refused", "wrong, weak", "WRONG")
POSE_OUTCOMES = ("right", "assumed", "WRONG", "none")


def main() -> None:
    """Measure the missing frames, and print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int)
    given = parser.parse_args()
    if given.only is not None:
        tell(draw_case(given.seed, given.only), given.out.with_name(f"{given.only}.png"))
        return
    done = {line["frame"] for line in lines(given.out)}
    for index in range(given.first, given.first + given.frames):
        if index not in done:
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"frame": index, **judge_case(draw_case(given.seed, index))}) + "\n")
    print_tables(lines(given.out))


def lines(path: Path) -> list[Json]:
    """Results of the frames done."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def judge_case(case: Case) -> Json:
    """Measure a frame and compare it with the true values."""
    begin = time.perf_counter()
    result = measure_case(case)
    seconds = time.perf_counter() - begin
    marks = {mark.point: mark for mark in result.marks}
    observed = {id for id, mark in marks.items() if mark.status.is_observation}
    wrong = [id for id in observed if is_wrong(case, marks[id], result)]
    return {
        "kind": case.kind,
        "symmetry": case.symmetry,
        "picture": case.picture,
        "marks": len(marks),
        "visible": len(marks) - len(case.hidden),
        "observed": len(observed),
        "wrong": len(wrong),
        "outcome": outcome(case, marks, observed, wrong),
        "pose": pose_outcome(case, result) if observed else "none",
        "weak": sum(mark.status is Status.WEAK for mark in marks.values()),
        "seconds": round(seconds, 2),
    }


def measure_case(case: Case) -> FrameMeasurement:
    pitch = None if case.pitch_um is None else (case.pitch_um, case.pitch_um)
    return measure_fiducials(case.scan, case.layout, pitch, FiducialOptions())


def is_wrong(case: Case, mark: MarkMeasurement, result: FrameMeasurement) -> bool:
    """Whether a mark is not at the true place of its name; with an assumed pose, not at that of any mark."""
    assert mark.center_px is not None
    assert mark.covariance_px2 is not None
    counts = result.pose is not None and result.pose.decided
    names = {mark.point} if counts else set(case.centers_px)
    errors = [mark.center_px - case.centers_px[id] for id in names - case.hidden]
    if not errors:
        return True
    error = min(errors, key=lambda error: float(np.hypot(*error)))
    sigmas = float(np.sqrt(error @ np.linalg.solve(mark.covariance_px2, error)))
    return float(np.hypot(*error)) > WRONG_PX and sigmas > WRONG_SIGMAS


def outcome(case: Case, marks: dict[str, MarkMeasurement], observed: set[str], wrong: Sequence[str]) -> str:
    if any(marks[id].status is Status.MEASURED for id in wrong):
        return "WRONG"
    if wrong:
        return "wrong, weak"
    if not observed:
        return "refused"
    return "all marks" if len(observed) == len(marks) - len(case.hidden) else "some marks"


def pose_outcome(case: Case, result: FrameMeasurement) -> str:
    if result.pose is None or not result.pose.decided:
        return "assumed"
    return "right" if result.pose.name == case.pose else "WRONG"


def print_tables(done: Sequence[Json]) -> None:
    """Print outcomes by kind of mark and exposure, and poses by the symmetry of the marks."""
    print(f"{len(done)} frames, median {np.median([line['seconds'] for line in done]):.2f} s a frame\n")
    print_table("marks", "kind", KINDS, "outcome", OUTCOMES, done)
    print_table("picture", "picture", sorted({line["picture"] for line in done}), "outcome", OUTCOMES, done)
    print_table("pose", "symmetry", SYMMETRIES, "pose", POSE_OUTCOMES, done)
    for name, key in (("frames with a wrong mark", "wrong"),):
        print(f"{name}: {[line['frame'] for line in done if line[key]]}")
    print(f"frames with a wrong pose: {[line['frame'] for line in done if line['pose'] == 'WRONG']}")
    print(f"frames refused: {[line['frame'] for line in done if line['outcome'] == 'refused']}")


def print_table(
    title: str, row_key: str, rows: Sequence[str], column_key: str, columns: Sequence[str], done: Sequence[Json]
) -> None:
    """Print the number of frames by row and outcome."""
    print(f"{title:24}" + "".join(f"{column:>13}" for column in columns) + f"{'frames':>9}")
    for row in rows:
        own = [line[column_key] for line in done if line[row_key] == row]
        print(f"{row:24}" + "".join(f"{own.count(column):13d}" for column in columns) + f"{len(own):9d}")
    print()


def tell(case: Case, picture: Path) -> None:
    """Print one frame mark by mark, and write its image."""
    result = measure_case(case)
    print(f"{case.kind}, {case.symmetry}, {case.picture}; true pose {case.pose}; hidden {sorted(case.hidden)}")
    print(f"pose {result.pose}\nproblems {result.problems}")
    for mark in result.marks:
        true = case.centers_px[mark.point]
        place = "" if mark.center_px is None else f"{np.round(mark.center_px, 2)}"
        wrong = mark.status.is_observation and is_wrong(case, mark, result)
        print(
            f"{mark.point:3} true {np.round(true, 2)} {place:20} {mark.status} {'WRONG' if wrong else ''} {mark.reason}"
        )
    grey = case.scan.window(0, 0, case.scan.width_px, case.scan.height_px)
    cv2.imwrite(str(picture), (grey / case.scan.full_scale_dn * 255).astype(np.uint8))


if __name__ == "__main__":
    main()
