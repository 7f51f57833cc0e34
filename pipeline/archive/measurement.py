"""What later stages ask of out/measurement.db: its scans and marks, raw and checked, and whether results are of other
inputs than there are now."""

import json
import math
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.archive.checked_statuses import (
    Judging,
    checked_marks,
    checked_scans,
    find_judging,
    latest,
    marks_as_written,
)
from pipeline.archive.results_database import Store
from pipeline.archive.schema import check_judging, damaged_frames
from pipeline.archive.verdicts import Verdict
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.provenance import FileStates, Identity, fingerprint, hash_text, parts_hash
from pipeline.results.comparator_file import CameraPerson, ComparatorPoint, comparator_points, read_measurement_hash
from pipeline.results.measured_record import MeasuredScan

_PLACE = "project folder"


def read_inputs(path: Path, digest: str) -> Mapping[str, str] | None:
    """{name: fingerprint} of the inputs of a judging; None where the store lacks it."""
    with Store(path) as store:
        judging = find_judging(store, digest)
    return None if judging is None else judging.made_from


def _frame_values(store: Store, digest: str, columns: str) -> list[tuple[Any, ...]]:
    """Columns of checked_frame, for all frames of a judging."""
    return store.connection.execute(f"select {columns} from checked_frame where digest = ?", (digest,)).fetchall()


def pitches(store: Store, digest: str) -> dict[str, tuple[float, float]]:
    """{image: pixel pitch across and down, µm}; NaN where it is unknown."""
    rows = _frame_values(store, digest, "name, pitch_x_um, pitch_y_um")
    unknown = (math.nan, math.nan)
    return {name: unknown if across is None else (across, down) for name, across, down in rows}


def picture_sizes_mm(path: Path, digest: str) -> dict[str, tuple[float, float]]:
    """{image: width and height of the scan, mm}; scans of unknown pitch are left out."""
    if not digest or not path.exists():
        return {}
    with Store(path) as store:
        rows = _frame_values(store, digest, "name, width_px * pitch_x_um / 1000.0, height_px * pitch_y_um / 1000.0")
    return {name: (width, height) for name, width, height in rows if width and height}


def count_decisions(store: Store, digest: str) -> dict[CameraPerson, int]:
    """Number of decisions in a judging, by camera and person."""
    counts = Counter[CameraPerson]()
    for camera, counts_json in _frame_values(store, digest, "camera, changed ->> '$.decided_by'"):
        counts.update({(camera, who): count for who, count in json.loads(counts_json or "{}").items()})
    return dict(sorted(counts.items()))


def written_scans(store: Store, digest: str) -> Iterator[MeasuredScan]:
    """Scans of a judging on which writing was found."""
    written = store.written()
    names = {name for name, result in _frame_values(store, digest, "name, result") if result in written}
    return measured_scans(store.path, digest, names)


def read_fingerprints(path: Path, digest: str, images: Collection[str]) -> dict[str, str]:
    """{image: fingerprint of its result} for some images of a judging; empty where there is no such judging."""
    if not digest or not path.exists():
        return {}
    with Store(path) as store:
        found = dict(_frame_values(store, digest, "name, fingerprint"))
    return {image: found[image] for image in images if image in found}


def remember_place(store: Store, project_folder: Path) -> None:
    """Store the project folder relative to the store, so that a project can be moved as a whole."""
    relative = os.path.relpath(project_folder.resolve(), store.path.resolve().parent)
    if store.recall(_PLACE) != {"path": relative}:
        store.remember(_PLACE, {"path": relative})


def read_measurement(path: Path, digest: str = "") -> tuple[MeasuredScan, ...]:
    """Scans of a store after the cross-scan checks, sorted by name. digest: of the judging; "" for the latest.

    Raises InputError where there is no such store, or no judging in it.
    """
    return tuple(measured_scans(path, digest))


def measured_scans(path: Path, digest: str = "", images: Collection[str] | None = None) -> Iterator[MeasuredScan]:
    """Yield the scans of a store one by one; see `read_measurement`. images: only these; None for all."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file. Run `reseau measure` first.")
    with Store(path) as store:
        judging = find_judging(store, digest) if digest else latest(store)
        if judging is None:
            raise InputError(
                f"{path}: its scans have not passed the cross-scan checks. Run `reseau measure`, which continues."
            )
        folder = path.parent / (store.recall(_PLACE) or {"path": ".."})["path"]
        yield from checked_scans(store, judging, folder, images)


class StoredFrame(NamedTuple):
    """Frame that needs no look: its name, its scan's file and the row of its result."""

    image: str
    scan: str
    result: int


class StoredMarks:
    """Marks of comparator.csv, unchanged since it was written from the store."""

    def __init__(self, path: Path, judging: Judging) -> None:
        self._path, self._judging = path, judging

    @classmethod
    def open(cls, path: Path, comparator: Path) -> "StoredMarks | None":
        """Marks of a store. None where the file holds other marks, or either was changed since."""
        if not path.exists() or not comparator.exists() or not (digest := read_measurement_hash(comparator)):
            return None
        with Store(path) as store:
            judging = find_judging(store, digest)
            is_written = judging is not None and marks_as_written(store, digest, comparator)
            if judging is not None and is_written:
                check_judging(store.connection, judging.row, path)
                is_written = not damaged_frames(store.connection, judging.row)
        return cls(path, judging) if judging is not None and is_written else None

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of all frames."""
        with Store(self._path) as store:
            return frozenset(name for (name,) in _frame_values(store, self._judging.digest, "name"))

    def rows(self, images: Collection[str]) -> list[ComparatorPoint]:
        """Marks of some images, as in comparator.csv."""
        with Store(self._path) as store:
            marks = checked_marks(store, self._judging, images)
            return list(comparator_points(marks, pitches(store, self._judging.digest)))

    def scans(self, images: Collection[str]) -> Iterator[MeasuredScan]:
        return measured_scans(self._path, self._judging.digest, images)

    @cached_property
    def plain(self) -> tuple[StoredFrame, ...]:
        """Frames that are reported only in totals: good ones in which, if they have targets, at least one is
        observed."""
        with Store(self._path) as store:
            rows = store.connection.execute(_PLAIN, (self._judging.row, str(Verdict.GOOD)))
            return tuple(StoredFrame(*row) for row in rows)

    def plain_marks(self) -> Iterator[tuple[int, str, str, float | None, float | None]]:
        """Row of the result, kind, status, column and row of each mark of the plain frames."""
        plain = {frame.result for frame in self.plain}
        with Store(self._path) as store:
            marks = store.connection.execute(_MARKS, (self._judging.row, str(Verdict.GOOD)))
            yield from (mark for mark in marks if mark[0] in plain)


_PLAIN = """
select name, uri, result from checked_frame where judging = ?1 and verdict = ?2 and result not in (
    select result from checked_mark where judging = ?1 and kind <> 'fiducial'
    group by result having not sum(status in ('measured', 'weak'))
) order by name
"""
_MARKS = """
select result, kind, status, col_px, row_px from checked_mark where judging = ? and verdict = ?
"""


MadeFrom = dict[str, str]

# The names are used in messages: "is of other ... than there are now".
CAMERAS, SETTINGS, SCAN, CAMERA = "cameras", "settings", "scan ", "camera "
MARKS, POINTS, IMAGES, DISTANCES = "marks", "points", "images", "distances"
DECISIONS = "decisions"
PLACES = "points, orientations or lenses"

# Fields of a project that are not settings; all others, including future ones, are.
_FILES = {
    "path", "cameras", "scans", "comparator", "output", "given_points", "given_images", "given_distances",
    "images_path", "decisions", "decisions_cut_short",
}  # fmt: skip
_NO_MATTER = {"max_pixels", "crs"}
# Fields of a camera that determine where its targets are expected, not what its marks look like.
_LENS = {
    "principal_distance_mm", "principal_point_mm", "principal_distance_sigma_mm", "principal_point_sigma_mm",
    "distortion", "calibration",
}  # fmt: skip
_ORIGIN = {"path", "source"}


def measured_from(project: Project) -> MadeFrom:
    """Inputs of a measurement: every scan, what is sought in it, and the approximate values used to predict targets.
    The latter do not change a measured mark, but determine which ones are found and how they are named."""
    known, files = dict[str, Identity](), FileStates(project.path.resolve().parent)
    if project.measurement_path.exists():
        with Store(project.measurement_path) as store:
            known = store.identities()
    coordinates = {id: [prior and prior.value for prior in (p.X, p.Y, p.Z)] for id, p in project.object_points.items()}
    places = [
        coordinates,
        project.given_points and project.given_points.normals,
        project.given_images and project.given_images.exterior,
        {camera.name: {name: getattr(camera, name) for name in _LENS} for camera in project.cameras.values()},
        project.film,
        *([project.given_images.part_of] if project.given_images and project.has_parts else []),
    ]

    return {
        SETTINGS: fingerprint({name: value for name, value in _settings(project).items() if name != "adjust"}),
        PLACES: fingerprint(places),
        **({DECISIONS: project.decisions_hash} if project.decisions else {}),
        **{
            f"{CAMERA}{camera.name}": fingerprint(_fields_except(camera, _LENS | _ORIGIN))
            for camera in project.cameras.values()
        },
        **{
            f"{SCAN}{image}": hash_text(f"{_parts(path, known, files)} {project.image_camera(image).name}")
            for image, path in project.scans.items()
        },
    }


def adjusted_from(project: Project, marks: Sequence[ComparatorPoint]) -> MadeFrom:
    """Inputs of an adjustment: the marks that are observations, the given values, and the settings."""
    observations = sorted(
        (mark.image, mark.kind, mark.point, *_numbers(mark)) for mark in marks if mark.status.is_observation
    )
    cameras = {name: [camera.camera(), camera.calibration, camera.frame_mm] for name, camera in project.cameras.items()}
    return {
        MARKS: fingerprint(observations),
        CAMERAS: fingerprint(cameras),
        POINTS: fingerprint([project.object_points, project.given_points and project.given_points.normals]),
        IMAGES: fingerprint(project.given_images),
        DISTANCES: fingerprint({fingerprint(given.distance) for given in project.given_distances}),
        SETTINGS: fingerprint(_settings(project)),
    }


def _parts(path: Path, known: Mapping[str, Identity], files: FileStates) -> tuple[int, str]:
    """Size of a scan's file and hash of its parts, read only where its state differs from that in the store."""
    state = files.get(path)
    found = known.get(state.uri)
    is_known = found is not None and found.state == state
    return state.bytes, found.parts_hash if found and is_known else parts_hash(path)


def differing(made: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of the inputs that differ, or exist only in one of the two."""
    return sorted(name for name in made.keys() | now.keys() if made.get(name) != now.get(name))


def _numbers(mark: ComparatorPoint) -> tuple[Any, ...]:
    assert mark.xy_mm is not None  # an observation has coordinates
    return (*mark.xy_mm.tolist(), *(() if mark.sigma_mm is None else mark.sigma_mm.tolist()), mark.rho)


def _settings(project: Project) -> dict[str, object]:
    return _fields_except(project, _FILES | _NO_MATTER)


def _fields_except(value: Any, names: Set[str]) -> dict[str, object]:
    return {field.name: getattr(value, field.name) for field in fields(value) if field.name not in names}
