"""Scans that nobody has measured, and stores of them."""

import hashlib
import random
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose
from pipeline.archive.results_database import Kept, Store
from pipeline.provenance import FileState, Identity
from pipeline.results.measured_record import Failure, FailureCode, MeasuredScan, mark_row, scan_detail

FOLDER = Path("/project")


def measured_scan(seed: int = 1, marks: int = 8, status: Status = Status.MEASURED, **changes: Any) -> MeasuredScan:
    """A frame of so many fiducials. changes: of the frame."""
    rng = random.Random(seed)
    matrix = np.array([[rng.uniform(40, 60), rng.gauss(0, 1), 2500.0], [rng.gauss(0, 1), -50.0, 2000.0]])
    own = tuple(mark(rng, str(number), status) for number in range(1, marks + 1))
    frame = FrameMeasurement(str(seed), own, Pose("90m", True, ("its number says so.",)), matrix)
    path, notes = str(FOLDER / f"scans/{seed}.tif"), ("Light was taken to grow as the grey value.",)
    return MeasuredScan(path, 5000, 4000, (20.0, 20.5), replace(frame, **changes), notes, seconds=0.5)


def mark(rng: random.Random, point: str, status: Status = Status.MEASURED) -> MarkMeasurement:
    noise = np.array([[rng.uniform(1e-4, 2e-4), 1e-5], [1e-5, rng.uniform(1e-4, 2e-4)]])
    film = np.array([[rng.uniform(1e-3, 2e-3), 0.0], [0.0, 1e-3]])
    place = np.array([rng.uniform(0, 5000), rng.uniform(0, 4000)])
    quality = {"snr": rng.uniform(5, 50), "contrast_dn": np.nan, "blur_px": rng.uniform(1, 2)}
    reason = Reason() if status is Status.MEASURED else Reason("it is faint", Code.CONTRAST)
    return MarkMeasurement(
        point, "fiducial", place, Covariance({Cause.NOISE: noise, Cause.FILM: film}), status, reason, quality
    )


def changed(scan: MeasuredScan, numbers: Iterable[int], status: Status, reason: Reason) -> MeasuredScan:
    """The scan with another status of some marks."""
    marks = list(scan.frame.marks)
    for number in numbers:
        marks[number] = replace(marks[number], status=status, reason=reason)
    return replace(scan, frame=replace(scan.frame, marks=tuple(marks)))


def failed(seed: int = 1) -> MeasuredScan:
    sentence = f"scans/{seed}.tif is damaged or truncated"
    frame = measured_scan(seed, 2, Status.ABSENT, pose=None, pixel_from_camera=None).frame
    frame = replace(frame, problems=(Reason(sentence, Code.FAILED_SCAN),))
    return MeasuredScan.failed(str(FOLDER / f"scans/{seed}.tif"), frame, Failure(FailureCode.UNREADABLE, sentence))


def kept_result(seed: int = 1, options: str = "{}", mtime_ns: int = 1, scan: MeasuredScan | None = None) -> Kept:
    """A result of a scan of its own."""
    state = FileState(f"scans/{seed}.tif", 1000 + seed, mtime_ns)
    parts = hashlib.sha256(str(seed).encode()).hexdigest()
    return Kept(Identity(state, parts), options, scan or measured_scan(seed), camera="camera.toml")


def content(scan: MeasuredScan) -> tuple[object, ...]:
    """All of a scan, by which it can be compared."""
    codes = [problem.code for problem in scan.frame.problems]
    return (scan.frame.image, scan_detail(scan, scan.scan), codes, *map(mark_row, scan.frame.marks))


def stored(store: Store, row: int, image: str = "1") -> tuple[object, ...]:
    """The content of a result of a store."""
    return content(store.scan(row, image, FOLDER))


def dump(path: Path) -> list[str]:
    """All that a store holds, but times, and which rows came first."""
    with Store(path) as store:
        db = store.connection
        results = db.execute(
            "select fingerprint, uri, bytes, mtime_ns, identity_hash, hash, result.id from result "
            "join scan on scan.id = result.scan join options on options.id = result.options order by fingerprint"
        ).fetchall()
        return [f"{row[:-1]} {stored(store, row[-1])}" for row in results]
