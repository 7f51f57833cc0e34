"""Data of the report: the stages' results; of many frames only those that need a look, and totals of the others."""

import os
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from heapq import nsmallest
from operator import itemgetter
from pathlib import Path

import numpy as np

from measure.flags import Status
from measure.scans.remote import whole_file
from pipeline.archive import made_from as provenance
from pipeline.archive.checked_results import CheckRun, measured_scans, stored_check_run, written_check_run
from pipeline.archive.review_decisions import inapplicable
from pipeline.archive.verdicts import Verdict
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.provenance import hash_file
from pipeline.publishing import outside_note
from pipeline.report import frame_problems
from pipeline.report.data import FrameTotals, ReportData, ReportedFrame, ReportedProblem, frames
from pipeline.report.frame_problems import centers_px
from pipeline.report.verdict import suspect_rows
from pipeline.results.adjustment_file import read_adjustment, read_covariance
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.comparator_file import (
    ComparatorPoint,
    describe_decisions,
    has_pixels_alone,
    read_comparator,
    read_decision_counts,
    read_measurement_hash,
    read_pitches,
)
from pipeline.results.measured_record import FailureCode, MeasuredScan
from pipeline.results.stage_files import read_check
from pipeline.text.wording import counted, did_you_mean, listed

MOST_FRAMES = 200  # largest number of frames shown with their marks
_MOST_PROBLEMS = 50  # largest number of different problems listed
BEST_FIRST = (Verdict.GOOD, Verdict.DECIDED, Verdict.LOOK, Verdict.POOR, Verdict.FAILED)
_OBSERVED = {str(status) for status in Status if status.is_observation}


@dataclass
class _FrameCounts:
    """Counts of frames for their `FrameTotals`. centers_px: columns and rows of the observed marks."""

    marks: dict[str, Counter[str]] = field(default_factory=dict)
    of_targets: Counter[tuple[str, str]] = field(default_factory=Counter)
    verdicts: dict[tuple[str, str], Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    gathered: frame_problems.Gathered = field(default_factory=dict)
    centers_px: "array[float]" = field(default_factory=lambda: array("d"))

    @property
    def totals(self) -> FrameTotals:
        ordered = sorted(self.gathered.values(), key=lambda each: -len(each.images))
        problems = [each.merged_problem() for each in ordered[:_MOST_PROBLEMS]]
        if rest := sum(len(each.images) for each in ordered[_MOST_PROBLEMS:]):
            what = f"{counted(rest, 'more problem')} of frames, all different."
            problems.append(ReportedProblem(what, "`reseau status --csv` has them."))
        places = frame_problems.places_apart(np.array(self.centers_px))
        return FrameTotals(self.marks, self.of_targets, self.verdicts, tuple(problems), places)

    def add(
        self, frame: ReportedFrame, kind: tuple[str, str], verdict: Verdict, problems: Iterable[ReportedProblem]
    ) -> None:
        self.verdicts[kind][verdict] += 1
        self.marks[frame.image] = Counter(str(mark.status) for mark in frame.marks)
        self.of_targets.update((mark.kind, mark.status) for mark in frame.marks if not mark.is_fiducial)
        frame_problems.gather(self.gathered, frame.image, problems)
        for center in centers_px(frame):
            self.centers_px.extend(center.tolist())

    def add_plain(self, stored: CheckRun, image_camera: Callable[[str], str]) -> None:
        """Add the stored frames without problems."""
        counts = {result: Counter[str]() for _, _, result in stored.plain}
        for result, kind, status, col_px, row_px in stored.plain_marks():
            counts[result][status] += 1
            if kind != "fiducial":
                self.of_targets[kind, status] += 1
            if status in _OBSERVED and col_px is not None and row_px is not None:
                self.centers_px.extend((col_px, row_px))
        alike = dict[frozenset[tuple[str, int]], Counter[str]]()  # one object for all frames with equal counts
        for image, uri, result in stored.plain:
            self.verdicts[image_camera(image), _ending(uri)][Verdict.GOOD] += 1
            count = counts[result]
            self.marks[image] = alike.setdefault(frozenset(count.items()), count)


def reduce_data(
    data: ReportData, scans: Iterable[MeasuredScan], image_camera: Callable[[str], str], stored: CheckRun | None = None
) -> ReportData:
    """Reduce the data to the totals of all frames and the worst of the frames that need a look.

    Parameters
    ----------
    scans : of the images in data.comparator, iterated once.
    stored : stored marks, of whose frames without problems only columns are read; data.comparator then holds all other
        frames.
    """
    counts = _FrameCounts()
    if stored is not None:
        counts.add_plain(stored, image_camera)
    suspect = {row.image for row in suspect_rows(data.adjustment)} if data.adjustment else set[str]()

    def frames_to_show() -> Iterator[tuple[tuple[float, float], ReportData]]:
        """Count all frames; yield those that need a look with a sort key, the worst first."""
        for one in _one_by_one(data, scans):
            (frame,) = frames(one)
            verdict, problems = frame.verdict, list(frame_problems.single_frame_problems(frame))
            kind = image_camera(frame.image), _ending(frame.scan.scan) if frame.scan else "given"
            counts.add(frame, kind, verdict, problems)
            if problems or verdict.needs_review or frame.image in suspect:
                largest_w = max((abs(mark.w or 0.0) for mark in frame.marks), default=0.0)
                yield (-BEST_FIRST.index(verdict), -largest_w), one

    shown = [one for _, one in nsmallest(MOST_FRAMES, frames_to_show(), key=itemgetter(0))]
    return replace(
        data,
        comparator=[row for one in shown for row in one.comparator],
        measurement={name: scan for one in shown for name, scan in (one.measurement or {}).items()},
        totals=counts.totals,
    )


def _ending(scan: str) -> str:
    return os.path.splitext(whole_file(scan))[1][1:].lower() or "none"


def _one_by_one(data: ReportData, scans: Iterable[MeasuredScan]) -> Iterator[ReportData]:
    """Yield the data of each frame separately: its rows, scan and residuals."""
    rows: dict[str, list[ComparatorPoint]] = defaultdict(list)
    for row in data.comparator:
        rows[row.image].append(row)
    others = data.adjustment.images if data.adjustment else {}
    shown = set[str]()

    def frame_data(image: str, scan: MeasuredScan | None) -> ReportData:
        images = {image: others[image]} if image in others else {}
        rows_of = tuple(data.residuals_by_image.get(image, ()))
        own = replace(data.adjustment, images=images, residuals=rows_of) if data.adjustment else None
        return replace(
            data, comparator=rows.get(image, []), measurement={image: scan} if scan else {}, adjustment=own, totals=None
        )

    for scan in scans:
        if scan.frame.image in rows or not scan.frame.marks:  # others were removed from comparator.csv
            shown.add(scan.frame.image)
            yield frame_data(scan.frame.image, scan)
    for image in sorted({*rows, *others} - shown):
        yield frame_data(image, None)


def frame_counts(data: ReportData, shots: Sequence[ReportedFrame]) -> Counter[Verdict]:
    """Numbers of all frames by verdict, for the report and the terminal. shots: the frames shown."""
    total = Counter[Verdict]()
    for row in verdict_counts(data, shots).values():
        total.update({Verdict(verdict): count for verdict, count in row.items()})
    return total


def verdict_counts(data: ReportData, shots: Sequence[ReportedFrame]) -> Mapping[tuple[str, str], Mapping[str, int]]:
    """Numbers of frames by (camera, kind of file) and verdict."""
    if data.totals is not None:
        return data.totals.verdicts
    counts = defaultdict[tuple[str, str], Counter[str]](Counter)
    for frame in shots:
        kind = data.image_cameras.get(frame.image, "none"), _ending(frame.scan.scan) if frame.scan else "given"
        counts[kind][frame.verdict] += 1
    return counts


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
        image_cameras={mark.image: project.image_camera(mark.image).name for mark in marks},
        part_of=project.given_images.part_of if project.given_images else {},
        given_by={camera.name: _coordinates_source(camera) for camera in project.cameras.values()},
        notes=tuple(filter(None, [outside_note(project), describe_decisions(read_decision_counts(comparator))])),
        made_from={project.comparator.name: hash_file(comparator)},
    )
    digest, path = read_measurement_hash(comparator), project.measurement_path
    if not path.exists():
        return data
    with stored_check_run(path, digest) as check_run:
        made, lines = None if check_run is None else check_run.made_from, inapplicable(check_run)
    if made is None and not digest:
        return replace(data, notes=(*data.notes, f"{comparator.name} was given: {path.name} says nothing of it."))
    if made is None:
        what = f"{path.name} is of other marks than {project.comparator.name}: it is not shown."
        return _add_problems(data, ReportedProblem(what, "Run `reseau measure`."))
    many = rows is not None or (most_frames is not None and _frame_count(data) > most_frames)
    scans = {} if many else {scan.frame.image: scan for scan in measured_scans(path, digest)}
    data = replace(data, measurement=scans, made_from={**data.made_from, path.name: digest})
    unlike: list[ReportedProblem] = []
    if project.scans:
        now = provenance.measured_from(project)
        unlike = list(_unlike(made, now))
        if made.get(provenance.PLACES) != now[provenance.PLACES]:
            places = provenance.PLACES
            note = f"The marks were looked for with other {places} than there are now; `reseau measure` looks again."
            data = replace(data, notes=(*data.notes, note))
    damaged = [
        ReportedProblem(scan.failure.sentence, "Nothing else of this image is shown as measured until then.")
        for scan in scans.values()
        if scan.failure is not None and scan.failure.code is FailureCode.DAMAGED
    ]
    idle = [ReportedProblem(f"{project.decisions_path.name}, {line}", "It does not count.") for line in lines]
    return _add_problems(data, *damaged, *idle, *unlike)


def _coordinates_source(camera: CameraFile) -> str:
    """Source of the given fiducial coordinates, from the camera file."""
    if camera.source is None:
        return "the certificate"
    return "the camera file" if camera.source.frames else "the library's typical coordinates"


def _frame_count(data: ReportData) -> int:
    return len({row.image for row in data.comparator})


def unread_scans(data: ReportData, path: Path, images: Collection[str] | None = None) -> Iterator[MeasuredScan]:
    """Yield the scans of all or some images from measurement.db; none if it belongs to other marks."""
    digest = data.made_from.get(path.name)
    return iter(()) if digest is None else measured_scans(path, digest, images)


def report_data(project: Project, at: At) -> ReportData:
    """Load all data of a report. With more than MOST_FRAMES frames: totals, and the frames that need a look."""

    def image_camera(image: str) -> str:
        return project.image_camera(image).name

    with _stored_checks(project, at) as stored:
        if stored is not None and len(stored.names) > MOST_FRAMES:
            needed = stored.names - {image for image, _, _ in stored.plain}
            data = measured_data(project, at, rows=list(stored.points(needed)))
            return reduce_data(data, stored.scans(needed), image_camera, stored)
    data = adjusted_data(project, at, MOST_FRAMES)
    return (
        data
        if _frame_count(data) <= MOST_FRAMES
        else reduce_data(data, unread_scans(data, project.measurement_path), image_camera)
    )


def frame_data(project: Project, at: At, images: Collection[str]) -> ReportData:
    """Load all data of some images. Raises InputError for an unknown image."""
    with _stored_checks(project, at) as stored:
        if stored is None:
            data = adjusted_data(project, at, 0)
        else:
            data = measured_data(project, at, rows=list(stored.points(images)))
        known = {row.image for row in data.comparator} if stored is None else stored.names
    for image in images:
        if image not in known:
            raise InputError(f"{project.comparator}: has no image {image!r}.{did_you_mean(image, known)}")
    scans = {scan.frame.image: scan for scan in unread_scans(data, project.measurement_path, images)}
    return replace(data, comparator=[row for row in data.comparator if row.image in images], measurement=scans)


def _stored_checks(project: Project, at: At) -> AbstractContextManager[CheckRun | None]:
    """Stored marks, not all of which need be read, if comparator.csv is unchanged and nothing is adjusted."""
    if not project.scans or at(project.adjustment_path).exists():
        return nullcontext()
    return written_check_run(project.measurement_path, at(project.comparator))


def adjusted_data(project: Project, at: At, most_frames: int | None = None) -> ReportData:
    """Load as `measured_data` does, with the adjustment and its check unless they are stale."""
    data, path = measured_data(project, at, most_frames), at(project.adjustment_path)
    if not path.exists():
        return data
    adjustment, covariance, fingerprint = read_adjustment(path), read_covariance(path), hash_file(path)
    not_shown = ""
    if others := _other_inputs(project, adjustment, data.comparator):
        not_shown = f"{path.name} is of {others}: it is not shown."
    elif covariance.adjustment != fingerprint:
        not_shown = f"adjustment.npz goes with another {path.name}: both are not shown."
    if not_shown:
        stale = replace(data, stored_adjustment="stale")
        return _add_problems(stale, ReportedProblem(not_shown, "Run `reseau adjust`."))
    made_from = {**data.made_from, path.name: fingerprint}
    data = replace(data, adjustment=adjustment, covariance=covariance, made_from=made_from)
    check_path = at(project.check_path)
    try:
        check = read_check(check_path)
    except FileNotFoundError:
        return data
    if check.made_from != {path.name: fingerprint}:
        what = f"{check_path.name} is of another adjustment: it is not shown."
        return _add_problems(data, ReportedProblem(what, "Run `reseau check`."))
    return replace(data, check=check, made_from={**data.made_from, check_path.name: hash_file(check_path)})


def note_stored_adjustment(data: ReportData, project: Project) -> ReportData:
    """Note whether adjustment.json, which the marks are shown without, is of them; nothing where there is none."""
    path = project.adjustment_path
    if not path.exists():
        return data
    note = ""
    try:
        if others := _other_inputs(project, read_adjustment(path), data.comparator):
            note = f"{path.name} is of {others}: `reseau run` adjusts again, as `reseau adjust` does."
    except InputError as error:  # marks that were measured are not lost for it
        note = str(error)
    current = f"{path.name} is of these marks and of the present settings."
    return replace(data, stored_adjustment="stale" if note else "current", notes=(note or current, *data.notes))


def _other_inputs(project: Project, adjustment: AdjustmentRecord, marks: Sequence[ComparatorPoint]) -> str:
    """Inputs in which an adjustment differs from the present ones, in words; "" where it is of these."""
    if not adjustment.made_from:
        return "what it does not say"
    others = provenance.differing(adjustment.made_from, provenance.adjusted_from(project, marks))
    return f"other {' and '.join(others)} than there are now" if others else ""


def _unlike(made: Mapping[str, str], now: Mapping[str, str]) -> Iterator[ReportedProblem]:
    """Yield problems of measurements that do not match the current scans, decisions or settings."""
    others = provenance.differing(made, now)
    scans = [name.removeprefix(provenance.SCAN) for name in others if name.startswith(provenance.SCAN)]
    kinds = {
        "Not measured yet": [name for name in scans if provenance.SCAN + name not in made],
        "Changed since it was measured": [
            name for name in scans if provenance.SCAN + name in made and provenance.SCAN + name in now
        ],
        "Measured, but no scan of the project any more": [name for name in scans if provenance.SCAN + name not in now],
    }
    for what, names in kinds.items():
        if names:
            yield ReportedProblem(
                f"{what}: {listed(names)}.", "Run `reseau measure`; what is shown is of the earlier scans."
            )
    if provenance.DECISIONS in others:
        yield ReportedProblem(
            "Decisions were made, or taken back, since the cross-scan checks.",
            "Run `reseau measure`, which takes them in; what is shown is without them.",
        )
    changed = ["project" if name == provenance.SETTINGS else name for name in others if name in made and name in now]
    changed = [name for name in changed if name == "project" or name.startswith(provenance.CAMERA)]
    if changed:
        yield ReportedProblem(
            f"The marks were measured with other settings than there are now of {listed(changed)}.",
            "Run `reseau measure`; what is shown was measured with the earlier ones.",
        )


def _add_problems(data: ReportData, *problems: ReportedProblem) -> ReportData:
    return replace(data, problems=(*data.problems, *problems))
