"""Load the stages' results for the report. Stale results are listed, not shown."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.archive.made_from import (
    CAMERA,
    DECISIONS,
    PLACES,
    SCAN,
    SETTINGS,
    adjusted_from,
    differing,
    measured_from,
)
from pipeline.archive.measurement import StoredMarks, measured_scans, read_inputs
from pipeline.archive.results_database import Store
from pipeline.archive.review_decisions import inapplicable
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.provenance import hash_file
from pipeline.publishing import outside_note
from pipeline.report.data import Problem, ReportData
from pipeline.report.many_frames import MOST_FRAMES, reduced
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.check_file import read_check
from pipeline.results.comparator_file import (
    ComparatorPoint,
    describe_decisions,
    has_pixels_alone,
    read_comparator,
    read_decision_counts,
    read_measurement_hash,
    read_pitches,
)
from pipeline.results.covariance_file import read_covariance
from pipeline.results.measured_record import FailureCode, MeasuredScan
from pipeline.text.wording import did_you_mean, listed

At = Callable[[Path], Path]


def measured_data(
    project: Project, at: At, most_frames: int | None = None, rows: Sequence[ComparatorPoint] | None = None
) -> ReportData:
    """Load the marks, with the scans of measurement.db if these belong to them.

    Parameters
    ----------
    at : returns the current path of a result file.
    most_frames : with more frames the scans are not loaded; `unread_scans` yields them one by one.
    rows : marks to use instead of reading comparator.csv; no scans are loaded then.
    """
    comparator = at(project.comparator)
    marks = read_comparator(comparator, project.list_pitch_um) if rows is None else rows
    pitch_um = read_pitches(comparator)
    if project.list_pitch_um is not None and has_pixels_alone(comparator):
        pitch_um = dict.fromkeys((mark.image for mark in marks), project.list_pitch_um)
    data = ReportData(
        project=project.title,
        comparator=marks,
        pitch_um=pitch_um,
        frame_mm={camera.name: camera.frame_mm for camera in project.cameras.values() if camera.frame_mm is not None},
        unit=project.unit,
        given_by={camera.name: _coordinates_source(camera) for camera in project.cameras.values()},
        notes=tuple(filter(None, [outside_note(project), describe_decisions(read_decision_counts(comparator))])),
        made_from={project.comparator.name: hash_file(comparator)},
    )
    digest, path = read_measurement_hash(comparator), project.measurement_path
    if not path.exists():
        return data
    made = read_inputs(path, digest)
    if made is None and not digest:
        return replace(data, notes=(*data.notes, f"{comparator.name} was given: {path.name} says nothing of it."))
    if made is None:
        what = f"{path.name} is of other marks than {project.comparator.name}: it is not shown."
        return _add_problems(data, Problem(what, "Run `reseau measure`."))
    many = rows is not None or (most_frames is not None and _frame_count(data) > most_frames)
    scans = {} if many else {scan.frame.image: scan for scan in measured_scans(path, digest)}
    data = replace(data, measurement=scans, made_from={**data.made_from, path.name: digest})
    unlike: list[Problem] = []
    if project.scans:
        now = measured_from(project)
        unlike = list(_unlike(made, now))
        if made.get(PLACES) != now[PLACES]:
            note = f"The marks were looked for with other {PLACES} than there are now; `reseau measure` looks again."
            data = replace(data, notes=(*data.notes, note))
    damaged = [
        Problem(scan.failure.sentence, "Nothing else of this image is shown as measured until then.")
        for scan in scans.values()
        if scan.failure is not None and scan.failure.code is FailureCode.DAMAGED
    ]
    with Store(path) as store:
        lines = inapplicable(store, digest)
    idle = [Problem(f"{project.decisions_path.name}, {line}", "It does not count.") for line in lines]
    return _add_problems(data, *damaged, *idle, *unlike)


def _coordinates_source(camera: CameraFile) -> str:
    """Source of the given fiducial coordinates, from the camera file."""
    if camera.source is None:
        return "the certificate"
    return "the camera file" if camera.source.frames else "the library's typical coordinates"


def _frame_count(data: ReportData) -> int:
    return len({row.image for row in data.comparator})


def unread_scans(data: ReportData, project: Project, images: Collection[str] | None = None) -> Iterator[MeasuredScan]:
    """Yield the scans of all or some images from measurement.db; none if it belongs to other marks."""
    digest = data.made_from.get(project.measurement_path.name)
    return iter(()) if digest is None else measured_scans(project.measurement_path, digest, images)


def report_data(project: Project, at: At, most_frames: int = MOST_FRAMES) -> ReportData:
    """Load all data of a report. With more than most_frames frames: totals, and the frames that need a look."""

    def camera_of(image: str) -> str:
        return project.image_camera(image).name

    stored = _stored(project, at)
    if stored is not None and len(stored.names) > most_frames:
        needed = stored.names - {frame.image for frame in stored.plain}
        return reduced(measured_data(project, at, rows=stored.rows(needed)), stored.scans(needed), camera_of, stored)
    data = adjusted_data(project, at, most_frames)
    return data if _frame_count(data) <= most_frames else reduced(data, unread_scans(data, project), camera_of)


def frame_data(project: Project, at: At, images: Collection[str]) -> ReportData:
    """Load all data of some images. Raises InputError for an unknown image."""
    stored = _stored(project, at)
    data = adjusted_data(project, at, 0) if stored is None else measured_data(project, at, rows=stored.rows(images))
    known = {row.image for row in data.comparator} if stored is None else stored.names
    for image in images:
        if image not in known:
            raise InputError(f"{project.comparator}: has no image {image!r}.{did_you_mean(image, known)}")
    scans = {scan.frame.image: scan for scan in unread_scans(data, project, images)}
    return replace(data, comparator=[row for row in data.comparator if row.image in images], measurement=scans)


def _stored(project: Project, at: At) -> StoredMarks | None:
    """Stored marks, not all of which need be read, if comparator.csv is unchanged and nothing is adjusted."""
    if not project.scans or at(project.adjustment_path).exists():
        return None
    return StoredMarks.open(project.measurement_path, at(project.comparator))


def adjusted_data(project: Project, at: At, most_frames: int | None = None) -> ReportData:
    """Load as `measured_data` does, with the adjustment and its check unless they are stale."""
    data, path = measured_data(project, at, most_frames), at(project.adjustment_path)
    if not path.exists():
        return data
    adjustment, covariance, fingerprint = read_adjustment(path), read_covariance(path), hash_file(path)
    made, not_shown = adjustment.made_from, ""
    if others := differing(made, adjusted_from(project, data.comparator)):
        what = f"of other {' and '.join(others)} than there are now" if made else "of what it does not say"
        not_shown = f"{path.name} is {what}: it is not shown."
    elif covariance.adjustment != fingerprint:
        not_shown = f"adjustment.npz goes with another {path.name}: both are not shown."
    if not_shown:
        return _add_problems(data, Problem(not_shown, "Run `reseau adjust`."))
    made_from = {**data.made_from, path.name: fingerprint}
    data = replace(data, adjustment=adjustment, covariance=covariance, made_from=made_from)
    check_path = at(project.check_path)
    try:
        check = read_check(check_path)
    except FileNotFoundError:
        return data
    if check.made_from != {path.name: fingerprint}:
        what = f"{check_path.name} is of another adjustment: it is not shown."
        return _add_problems(data, Problem(what, "Run `reseau check`."))
    return replace(data, check=check, made_from={**data.made_from, check_path.name: hash_file(check_path)})


def _unlike(made: Mapping[str, str], now: Mapping[str, str]) -> Iterator[Problem]:
    """Yield problems of measurements that do not match the current scans, decisions or settings."""
    others = differing(made, now)
    scans = [name.removeprefix(SCAN) for name in others if name.startswith(SCAN)]
    kinds = {
        "Not measured yet": [name for name in scans if SCAN + name not in made],
        "Changed since it was measured": [name for name in scans if SCAN + name in made and SCAN + name in now],
        "Measured, but no scan of the project any more": [name for name in scans if SCAN + name not in now],
    }
    for what, names in kinds.items():
        if names:
            yield Problem(f"{what}: {listed(names)}.", "Run `reseau measure`; what is shown is of the earlier scans.")
    if DECISIONS in others:
        yield Problem(
            "Decisions were made, or taken back, since the cross-scan checks.",
            "Run `reseau measure`, which takes them in; what is shown is without them.",
        )
    changed = ["project" if name == SETTINGS else name for name in others if name in made and name in now]
    changed = [name for name in changed if name == "project" or name.startswith(CAMERA)]
    if changed:
        yield Problem(
            f"The marks were measured with other settings than there are now of {listed(changed)}.",
            "Run `reseau measure`; what is shown was measured with the earlier ones.",
        )


def _add_problems(data: ReportData, *problems: Problem) -> ReportData:
    return replace(data, problems=(*data.problems, *problems))
