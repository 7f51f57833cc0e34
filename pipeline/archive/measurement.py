"""What was measured of a project, and judged, as others read it from out/measurement.db."""

import json
import math
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from measure.flags import Code, Reason
from measure.results import FrameMeasurement
from pipeline.archive.digests import DamagedError
from pipeline.archive.judging import judged_records, judging_of, latest
from pipeline.archive.store import Store
from pipeline.errors import InputError
from pipeline.results.comparator_file import DecidedBy
from pipeline.results.measured_record import scan_of
from pipeline.results.measured_scan import Failure, FailureCode, MeasuredScan

_PLACE = "project folder"


def read_measurement(path: Path, digest: str = "") -> tuple[MeasuredScan, ...]:
    """Every scan of a store, by name, as all of them together show it. digest: of the judging, if not the latest.

    Raises InputError where there is no such store, or nothing in it is judged.
    """
    return tuple(measured_scans(path, digest))


def made_from_of(path: Path, digest: str) -> Mapping[str, str] | None:
    """What a judging was made from; None where the store has not that one."""
    with Store(path) as store:
        judging = judging_of(store, digest)
    return None if judging is None else judging.made_from


def pitches(store: Store, digest: str) -> dict[str, tuple[float, float]]:
    """By image what a pixel measures, um; NaN of scans of which nobody knows."""
    rows = store.connection.execute(
        "select judged_frame.name, pitch_x_um, pitch_y_um from judged_frame join result on result.id = result "
        "join judging on judging.id = judging where judging.digest = ?",
        (digest,),
    )
    unknown = (math.nan, math.nan)
    return {name: unknown if across is None else (across, down) for name, across, down in rows}


def picture_sizes_mm(path: Path, digest: str) -> dict[str, tuple[float, float]]:
    """By image width and height of its scan; without those of which nobody knows a pitch."""
    if not digest or not path.exists():
        return {}
    query = (
        "select judged_frame.name, width_px * result.pitch_x_um / 1000.0, height_px * result.pitch_y_um / 1000.0 "
        "from judged_frame join scan on scan.id = judged_frame.scan join result on result.id = judged_frame.result "
        "join judging on judging.id = judging where judging.digest = ?"
    )
    with Store(path) as store:
        rows = store.connection.execute(query, (digest,)).fetchall()
    return {name: (width, height) for name, width, height in rows if width and height}


def decisions_by(store: Store, digest: str) -> dict[DecidedBy, int]:
    """How many decisions of whom stand behind a judging, by camera."""
    counts = Counter[DecidedBy]()
    rows = store.connection.execute(
        "select camera, judged_frame.detail ->> '$.decided_by' as told from judged_frame join scan on scan.id = scan "
        "join judging on judging.id = judging where judging.digest = ? and told is not null",
        (digest,),
    )
    for camera, told in rows:
        counts.update({(camera, who): count for who, count in json.loads(told).items()})
    return dict(sorted(counts.items()))


def written_scans(store: Store, digest: str) -> Iterator[MeasuredScan]:
    """Those scans of a judging on which something is written, by name."""
    rows = store.connection.execute(
        "select judged_frame.name, result from judged_frame join judging on judging.id = judging "
        "where judging.digest = ?",
        (digest,),
    ).fetchall()
    written = store.written()
    return measured_scans(store.path, digest, {name for name, result in rows if result in written})


def fingerprints_of(path: Path, digest: str, images: Collection[str]) -> dict[str, str]:
    """Of some images of a judging the fingerprints of their results; of none where there is no such judging."""
    if not digest or not path.exists():
        return {}
    query = (
        "select fingerprint from judged_frame join result on result.id = result join judging on judging.id = judging "
        "where judging.digest = ? and judged_frame.name = ?"
    )
    with Store(path) as store:
        found = {image: store.connection.execute(query, (digest, image)).fetchone() for image in images}
    return {image: row[0] for image, row in found.items() if row is not None}


def tell_place(store: Store, project_folder: Path) -> None:
    """Let the store know where the paths of its scans begin, seen from itself: so a whole project can be moved."""
    told = os.path.relpath(project_folder.resolve(), store.path.resolve().parent)
    if store.told(_PLACE) != {"path": told}:
        store.tell(_PLACE, {"path": told})


def measured_scans(path: Path, digest: str = "", images: Collection[str] | None = None) -> Iterator[MeasuredScan]:
    """The same one after the other. images: of these alone."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file. Run `reseau measure` first.")
    with Store(path) as store:
        judging = judging_of(store, digest) if digest else latest(store)
        if judging is None:
            raise InputError(f"{path}: its scans are not judged yet. Run `reseau measure`, which goes on with them.")
        folder = path.parent / (store.told(_PLACE) or {"path": ".."})["path"]
        for name, record in judged_records(store, judging, images):
            yield _damaged(name, record) if isinstance(record, DamagedError) else scan_of(name, record, folder)


def _damaged(image: str, error: DamagedError) -> MeasuredScan:
    """A scan of which nothing stored is used."""
    frame = FrameMeasurement(image, (), problems=(Reason(str(error), Code.FAILED_SCAN),))
    return MeasuredScan.failed("", frame, Failure(FailureCode.DAMAGED, str(error)))
