"""What was measured of a project, and judged, as others read it from out/measurement.db."""

import os
from collections.abc import Iterator
from pathlib import Path

from pipeline.archive.judging import judged_records, judging_of, latest
from pipeline.archive.store import Json, Store
from pipeline.errors import InputError
from pipeline.results.measured_record import scan_of
from pipeline.results.measured_scan import MeasuredScan

_PLACE = "project folder"


def read_measurement(path: Path, digest: str = "") -> tuple[MeasuredScan, ...]:
    """Every scan of a store, by name, as all of them together show it. digest: of the judging, if not the latest.

    Raises InputError where there is no such store, or nothing in it is judged.
    """
    return tuple(_scans(path, digest))


def measurement_json(path: Path, digest: str) -> Json | None:
    """The same as JSON: `made_from`, and by image the record of its scan; None where that judging is not there."""
    if not path.exists():
        return None
    with Store(path) as store:
        judging = judging_of(store, digest)
        if judging is None:
            return None
        return {"made_from": dict(judging.made_from), "images": dict(judged_records(store, judging))}


def tell_place(store: Store, project_folder: Path) -> None:
    """Let the store know where the paths of its scans begin, seen from itself: so a whole project can be moved."""
    told = os.path.relpath(project_folder.resolve(), store.path.resolve().parent)
    if store.told(_PLACE) != {"path": told}:
        store.tell(_PLACE, {"path": told})


def _scans(path: Path, digest: str) -> Iterator[MeasuredScan]:
    if not path.exists():
        raise InputError(f"{path}: there is no such file. Run `reseau measure` first.")
    with Store(path) as store:
        judging = judging_of(store, digest) if digest else latest(store)
        if judging is None:
            raise InputError(f"{path}: its scans are not judged yet. Run `reseau measure`, which goes on with them.")
        folder = path.parent / (store.told(_PLACE) or {"path": ".."})["path"]
        for name, record in judged_records(store, judging):
            yield scan_of(name, record, folder)
