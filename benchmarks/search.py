"""Search of marks and scan orientation (pose) in rendered frames, against the true values.

Tables of outcomes by kind of mark, exposure and symmetry of the marks, and the numbers of frames that went wrong.
"""

import time
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.harness import Row, table
from benchmarks.search_frames import KINDS, SYMMETRIES, SearchCase, draw_case
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.results import FrameMeasurement, MarkMeasurement

WRONG_SIGMAS = 5.0
WRONG_PX = 0.5  # px; a mark is wrong if its error exceeds this and WRONG_SIGMAS
OUTCOMES = ("all marks", "some marks", "refused", "wrong, weak", "WRONG")
POSE_OUTCOMES = ("right", "assumed", "WRONG", "none")


def cells(frames: int = 600, first: int = 0) -> Iterator[Row]:
    yield from ({"frame": index} for index in range(first, first + frames))


def case(frame: int, seed: int) -> Row:
    return judge_case(draw_case(seed, frame))


def judge_case(case: SearchCase) -> Row:
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
        "seconds": seconds,
    }


def measure_case(case: SearchCase) -> FrameMeasurement:
    pitch = None if case.pitch_um is None else (case.pitch_um, case.pitch_um)
    return measure_fiducials(case.scan, case.layout, pitch, FiducialOptions())


def is_wrong(case: SearchCase, mark: MarkMeasurement, result: FrameMeasurement) -> bool:
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


def outcome(case: SearchCase, marks: dict[str, MarkMeasurement], observed: set[str], wrong: Sequence[str]) -> str:
    if any(marks[id].status is Status.MEASURED for id in wrong):
        return "WRONG"
    if wrong:
        return "wrong, weak"
    if not observed:
        return "refused"
    return "all marks" if len(observed) == len(marks) - len(case.hidden) else "some marks"


def pose_outcome(case: SearchCase, result: FrameMeasurement) -> str:
    if result.pose is None or not result.pose.decided:
        return "assumed"
    return "right" if result.pose.name == case.pose else "WRONG"


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Outcomes by kind of mark and exposure, and poses by the symmetry of the marks."""
    yield f"{len(rows)} frames, median {np.median([row['seconds'] for row in rows]):.2f} s a frame"
    yield from counts("kind", KINDS, "outcome", OUTCOMES, rows)
    yield from counts("picture", sorted({row["picture"] for row in rows}), "outcome", OUTCOMES, rows)
    yield from counts("symmetry", SYMMETRIES, "pose", POSE_OUTCOMES, rows)
    yield f"frames with a wrong mark: {[row['frame'] for row in rows if row['wrong']]}"
    yield f"frames with a wrong pose: {[row['frame'] for row in rows if row['pose'] == 'WRONG']}"
    yield f"frames refused: {[row['frame'] for row in rows if row['outcome'] == 'refused']}"


def counts(key: str, groups: Sequence[str], column: str, columns: Sequence[str], rows: Sequence[Row]) -> Iterator[str]:
    """Yield a table of the number of frames by group and outcome."""
    lines = []
    for group in groups:
        own = [row[column] for row in rows if row[key] == group]
        lines.append({key: group, **{each: own.count(each) for each in columns}, "frames": len(own)})
    yield ""
    yield from table({key: "", **dict.fromkeys(columns, "d"), "frames": "d"}, lines)
