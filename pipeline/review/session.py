"""State of a review: the queue and its answers, kept up to date with the results database and the decisions file.

The order is: first cameras whose marks have no drawing or template, since nothing is found without them. Then scan
orientations (poses), on which the names of all marks of a frame depend; asked once for all frames of a roll. Then
frames without any mark found. Then marks, those of frames with few others first, since a decision changes more there.
"""

import json
import sqlite3
import threading
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from itertools import islice
from typing import Any, NamedTuple

from measure.flags import Code, Status
from measure.scans.remote import fetch_location
from pipeline.archive.checked_results import CheckRun, latest
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.schema import DamagedError, damaged_frames, damaged_result, verify_check_run
from pipeline.archive.verdicts import Verdict
from pipeline.errors import InputError
from pipeline.files import decisions_file
from pipeline.files.project_file import Project, reload_decisions
from pipeline.measuring.learn_stage import add_learned_marks
from pipeline.provenance import FileState, content_hash, file_state
from pipeline.results.measured_record import FailureCode
from pipeline.review.frame_view import ReviewFrame

Json = dict[str, Any]

_NONE = -1  # no cross-scan checks yet
PAGE = 100  # entries sent at a time
_NEAR = 100  # scans before and after, among which frames for comparison are sought
_OTHERS = 6  # largest number of frames for comparison
_UNKNOWN = "how its marks look is not known: click each of them in one scan that shows them well."
_COMMON = (
    "its marks were learned from what its scans have in common. Click them in one scan to learn them again from it."
)
_WORST = (Status.REJECTED, Status.WEAK, Status.PREDICTED, Status.ABSENT)
_SHOWN = (
    "key", "question", "point", "kind", "status", "code", "reason", "camera", "verdict", "marks", "is_left",
)  # fmt: skip


class Question(StrEnum):
    """Kind of question, in the order of the queue."""

    CAMERA = "camera"
    POSE = "pose"
    FRAME = "frame"
    MARK = "mark"


@dataclass(frozen=True, slots=True)
class Entry:
    """Question of the review queue.

    Attributes
    ----------
    images : all scans of a camera, all frames with the same question about the pose, otherwise one frame.
    fingerprints : of the results concerned, in the order of images; empty for a camera.
    marks : number of marks found in the frame; for a camera, number of its frames with marks.
    reason, code : why it is asked.
    point, kind, status : of a mark.
    pose : scan orientation in which the mark has that name.
    """

    question: Question
    images: tuple[str, ...]
    fingerprints: tuple[str, ...]
    camera: str
    verdict: str
    marks: int
    reason: str
    code: str = ""
    point: str = ""
    kind: str = ""
    status: str = ""
    pose: str = ""

    @property
    def key(self) -> str:
        """Identifier of the question in requests."""
        return json.dumps([self.question, self.images[0], self.point, self.kind], ensure_ascii=False)

    @property
    def is_left(self) -> bool:
        """Whether an answer is needed. It is optional for a camera whose marks were learned from its scans, and for
        marks of a scan whose verdict needs no review."""
        return self.marks == 0 if self.question is Question.CAMERA else Verdict(self.verdict).needs_review

    @property
    def folder(self) -> str:
        return self.images[0].rpartition("/")[0]


def build_queue(project: Project, db: sqlite3.Connection | None, check_run: int) -> tuple[Entry, ...]:
    """Build the queue of one run of the cross-scan checks, the worst first. db: None before the first run."""
    if db:
        verify_check_run(db, check_run, project.measurement_path)
    damaged = damaged_frames(db, check_run) if db else {}
    frames = {frame.result: frame for frame in _frames(db, check_run, damaged)} if db else {}
    marks = sorted(_marks(db, check_run, frames), key=_badness) if db else []
    bare = [
        Entry(Question.FRAME, (image,), ("",), "", str(Verdict.FAILED), 0, str(damaged_result(image, name)))
        for name in [project.measurement_path.name]
        for image in sorted(damaged.values())
    ]
    bare += [
        Entry(Question.FRAME, (f.image,), (f.key,), f.camera, f.verdict, 0, f.problem or "no mark was found in it")
        for f in sorted(frames.values(), key=lambda frame: frame.image)
        if f.marks == 0
    ]
    with_marks = {frame.image for frame in frames.values() if frame.marks}
    return (*_cameras(project, with_marks), *_poses(list(frames.values())), *bare, *marks)


class _Frame(NamedTuple):
    image: str
    result: int
    key: str
    camera: str
    verdict: str
    problem: str
    marks: int
    pose: str
    is_certain: bool
    evidence: str
    roll: str


_FRAMES = """
select name, result, fingerprint, coalesce(camera, ''), verdict,
    coalesce(changed ->> '$.problems[0]', measured ->> '$.problems[0]', ''),
    coalesce(changed -> '$.pose', measured -> '$.pose')
from checked_frame where judging = ? and verdict <> 'failed' and duplicate_of is null
"""

_MARKS = f"""
select result, point, kind, status, reason_code, reason from checked_mark
where judging = ? and status <> 'measured' and kind <> 'tie' and reason_code not like '{Code.DECIDED}%'
    and reason_code not like '{Code.CLICKED}%' order by result, number
"""

_FOUND = """
select result, count(*) from checked_mark where judging = ? and status in ('measured', 'weak') group by result
"""


_CHECKED = "select verdict, fingerprint from checked_frame where name = ? and judging = ?"

_NEARBY = """
with own as (
    select judging, scan, camera from checked_frame
    where name = ?1 and judging = (select max(id) from judging where digest not like 'unfinished%')
)
select f.name from own join checked_frame f
on f.judging = own.judging and f.scan between own.scan - ?2 and own.scan + ?2
join mark m on m.result = f.result
where f.camera = own.camera and f.name <> ?1 and m.point = ?3 and m.kind = ?4 and m.status = 'measured'
order by abs(f.scan - own.scan) limit ?5
"""


def _frames(db: sqlite3.Connection, check_run: int, damaged: Collection[int]) -> Iterator[_Frame]:
    """Yield the frames whose stored results can be read. damaged: results that cannot."""
    found: dict[int, int] = dict(db.execute(_FOUND, (check_run,)).fetchall())
    for *frame, pose_json in db.execute(_FRAMES, (check_run,)):
        if frame[1] in damaged:
            continue
        pose = json.loads(pose_json or "null") or {"name": "", "decided": True, "evidence": [], "roll": ""}
        orientation = pose["name"], bool(pose["decided"]), " ".join(pose["evidence"]), pose["roll"]
        yield _Frame._make((*frame, found.get(frame[1], 0), *orientation))


def _cameras(project: Project, with_marks: Collection[str]) -> Iterator[Entry]:
    """Yield a question for each camera whose marks are learned from its scans. with_marks: images with marks found."""
    for camera in project.cameras.values():
        images = tuple(image for image in project.scans if project.image_camera(image) is camera)
        if camera.needs_clicks and images:
            found = sum(image in with_marks for image in images)
            yield Entry(Question.CAMERA, images, (), camera.path.name, "", found, _COMMON if found else _UNKNOWN)


def _poses(frames: Sequence[_Frame]) -> Iterator[Entry]:
    """Yield a question for each undetermined pose of a roll or frame, those that concern most frames first."""
    groups = defaultdict[tuple[str, str], list[_Frame]](list)
    for frame in sorted(frames, key=lambda frame: frame.image):
        if not frame.is_certain and frame.marks:
            groups[frame.camera, frame.roll or frame.image].append(frame)
    for group in sorted(groups.values(), key=lambda group: (-len(group), group[0].image)):
        first = group[0]
        images, keys = tuple(frame.image for frame in group), tuple(frame.key for frame in group)
        reason = first.roll or first.evidence
        yield Entry(Question.POSE, images, keys, first.camera, first.verdict, first.marks, reason)


def _marks(db: sqlite3.Connection, check_run: int, frames: dict[int, _Frame]) -> Iterator[Entry]:
    for result, point, kind, status, code, reason in db.execute(_MARKS, (check_run,)):
        frame = frames.get(result)
        if frame is not None and frame.marks:
            where = ((frame.image,), (frame.key,), frame.camera, frame.verdict, frame.marks)
            yield Entry(Question.MARK, *where, reason, code, point, kind, status, frame.pose)


def _badness(entry: Entry) -> tuple[int, bool, int, str]:
    is_target = entry.kind != "fiducial"  # targets come last: they are many, and each matters little
    return (entry.marks if not is_target else 0, is_target, _WORST.index(Status(entry.status)), entry.images[0])


@dataclass(frozen=True)
class Filters:
    """Filters of the questions shown; "" for all. search: part of an image's name."""

    question: str = ""
    verdict: str = ""
    status: str = ""
    code: str = ""
    camera: str = ""
    folder: str = ""
    search: str = ""

    def lets_through(self, entry: Entry) -> bool:
        whole = ("question", "verdict", "status", "camera")
        return (
            all(getattr(self, name) in ("", getattr(entry, name)) for name in whole)
            and (not self.code or self.code in entry.code.split())
            and (not self.folder or f"{entry.folder}/".startswith(f"{self.folder}/"))
            and (not self.search or any(self.search.lower() in image.lower() for image in entry.images))
        )


class Session:
    """Review of a project. Thread-safe."""

    def __init__(self, project: Project, who: str) -> None:
        """Raises InputError if there are no checked results and no scans, or results of a camera whose file is gone."""
        self.project = self.learned = project  # learned: with the marks that its scans have in common
        self.who = who
        self.folder = project.path.resolve().parent
        if project.missing_camera and self._latest_check_run() is not None:
            raise InputError(
                f"{self.folder / project.missing_camera}: there is no such file, but its marks are in "
                f"{project.measurement_path}. Put the file back; or delete that database, and draw the camera."
            )
        self._lock = threading.RLock()
        self._check_run: int | None = None
        self._file_state: FileState | None = None  # of the decisions when they were read
        self.refresh()
        if self._check_run == _NONE and not self._by_key and not project.scans:
            raise InputError(
                f"{project.measurement_path}: no scan in it passed the cross-scan checks. Run `reseau measure` first."
            )

    def refresh(self) -> None:
        """Update the queue and its answers from the results database and the decisions file."""
        with self._lock:
            check_run = self._latest_check_run()
            row = _NONE if check_run is None else check_run.row
            path = self.project.decisions_path
            before, self._file_state = self._file_state, file_state(path, self.folder)
            if row == self._check_run and self._file_state == before:
                return
            if row != self._check_run:
                self.project = self.learned = reload_decisions(self.project)
                if row == _NONE:
                    queue = build_queue(self.project, None, row)
                else:
                    with ResultsDatabase(self.project.measurement_path) as database:
                        self.learned = add_learned_marks(self.project, database)
                        queue = build_queue(self.project, database.connection, row)
                self._by_key, self._check_run = {entry.key: entry for entry in queue}, row
            decisions = decisions_file.read_decisions(path)
            self._standing = decisions_file.standing(decisions)
            self._later_keys = dict[str, set[str]]()
            if row != _NONE:
                with ResultsDatabase(self.project.measurement_path) as database:
                    self._later_keys = {key: database.later_keys(key) for key in {one.fingerprint for one in decisions}}
            self._learned = [one for one in decisions if one.subject[2] == decisions_file.LEARNED]
            self._of_image = defaultdict[str, list[decisions_file.Decision]](list)
            for one in self._standing.values():
                self._of_image[one.image].append(one)
            self._answers = {
                key: answer for key, entry in self._by_key.items() if (answer := self._find_answer(entry)) is not None
            }

    def decide(self, decisions: Sequence[decisions_file.Decision], key: str = "") -> None:
        """Append decisions to the file, all or none. key: of a question about several frames; the decisions then apply
        to all of them. Raises InputError for an invalid decision, and KeyError for an obsolete question."""
        when = datetime.now(UTC).isoformat(timespec="seconds")
        with self._lock:
            for one in decisions:
                self._check(one)
            if key:
                entry = self._by_key[key]
                frames = tuple(zip(entry.images, entry.fingerprints, strict=True))
                decisions = [replace(one, image=image, fingerprint=own) for one in decisions for image, own in frames]
            complete = [replace(one, who=self.who, when=when) for one in decisions]
            for number, one in enumerate(complete):
                if one.decision is decisions_file.DecisionKind.LEARN:  # it applies to this file of the scan only
                    complete[number] = replace(one, fingerprint=content_hash(self.project.scans[one.image]))
            decisions_file.append_decisions(self.project.decisions_path, complete)
            self.refresh()

    def page(self, filters: Filters, start: int = 0) -> Json:
        """Numbers of open questions, and PAGE of the questions that pass the filters, from start on."""
        self.refresh()
        with self._lock:
            shown = {key: entry for key, entry in self._by_key.items() if filters.lets_through(entry)}
            open_places = [at for at, (key, entry) in enumerate(shown.items()) if self._is_open(key, entry)]
            left = Counter(entry.question for key, entry in self._by_key.items() if self._is_open(key, entry))
            return {
                "judging": self._check_run,
                "total": sum(entry.is_left for entry in self._by_key.values()),
                "left": {"all": left.total(), **{str(question): left[question] for question in Question}},
                "optional": sum(not entry.is_left for entry in self._by_key.values()),
                "shown": len(shown),
                "shown_left": len(open_places),
                "next_left": next((at for at in open_places if at >= start), next(iter(open_places), -1)),
                "start": start,
                "entries": [self.entry_json(entry) for entry in islice(shown.values(), start, start + PAGE)],
            }

    def _is_open(self, key: str, entry: Entry) -> bool:
        return entry.is_left and key not in self._answers

    def choices(self) -> Json:
        """Possible values of the filters."""
        entries = self._by_key.values()
        return {
            "questions": list(Question),
            "verdicts": sorted({entry.verdict for entry in entries} - {""}),
            "statuses": sorted({entry.status for entry in entries} - {""}),
            "codes": sorted({code for entry in entries for code in entry.code.split()}),
            "cameras": sorted({entry.camera for entry in entries}),
            "folders": sorted({entry.folder for entry in entries} - {""}),
        }

    @property
    def camera_name(self) -> str:
        """Default file name of a drawn camera: the camera file missing in the project, or another name."""
        return self.project.missing_camera or "drawn-camera.toml"

    def entry(self, key: str) -> Entry:
        """Question by its key. Raises KeyError for an unknown or obsolete one."""
        return self._by_key[key]

    def entry_json(self, entry: Entry) -> Json:
        answer, old = self._answers.get(entry.key), None
        if entry.question not in (Question.CAMERA, Question.FRAME):
            one = self._standing.get((entry.images[0], entry.point, entry.kind))
            old = None if one is None or self._names_result(one, entry.fingerprints[0]) else one  # on an earlier result
        return {
            **{name: getattr(entry, name) for name in _SHOWN},
            "image": entry.images[0],
            "count": len(entry.images),
            "fingerprint": entry.fingerprints[0] if entry.fingerprints else "",
            "answer": None if answer is None else _answer_json(answer),
            "old": None if old is None else _answer_json(old),
        }

    def view(self, image: str) -> ReviewFrame:
        """Load a frame from the results database, which another process may be writing.

        Raises KeyError for an image without checked results, DamagedError for a damaged result.
        """
        with ResultsDatabase(self.project.measurement_path) as database:
            check_run = latest(database)
            row = database.connection.execute(
                _CHECKED, (image, _NONE if check_run is None else check_run.row)
            ).fetchone()
            if row is None or check_run is None:
                raise KeyError(image)
            (scan,) = check_run.scans({image})
        if scan.failure and scan.failure.code is FailureCode.DAMAGED:
            raise DamagedError(scan.failure.sentence)
        return ReviewFrame(scan, str(row[0]), str(row[1]), self.learned.image_camera(image))

    def similar_frames(self, image: str, point: str, kind: str) -> list[str]:
        """Frames for comparison: nearby frames of the same camera in which the mark was measured."""
        with ResultsDatabase(self.project.measurement_path) as database:
            rows = database.connection.execute(_NEARBY, (image, _NEAR, point, kind, _OTHERS)).fetchall()
        return [name for (name,) in rows]

    def _latest_check_run(self) -> CheckRun | None:
        path = self.project.measurement_path
        if not path.exists():
            return None
        with ResultsDatabase(path) as database:
            return latest(database)

    def scan_location(self, image: str) -> str:
        """Path or address of an image's file. Raises KeyError for an unknown image."""
        given = self.project.scans.get(image)
        return self.view(image).scan.scan if given is None else fetch_location(given)

    def image_decisions(self, image: str) -> list[Json]:
        """JSON of the decisions in force on a frame."""
        with self._lock:
            return [_answer_json(one) for one in self._scan_decisions(image)]

    def _scan_decisions(self, image: str) -> list[decisions_file.Decision]:
        """Decisions in force on the marks and the pose of an image."""
        return [one for one in self._of_image.get(image, ()) if one.subject[2] != decisions_file.LEARNED]

    def _find_answer(self, entry: Entry) -> decisions_file.Decision | None:
        """Decision that answers a question; None if it is open."""
        # One about several frames needs decisions on all. A changed pose answers those about marks: it renames them.
        if entry.question is not Question.CAMERA and entry.images[0] not in self._of_image:
            return None
        match entry.question:
            case Question.CAMERA:
                return decisions_file.learned_from(self._learned, frozenset(entry.images))
            case Question.FRAME:
                made = self._scan_decisions(entry.images[0])
                return next((one for one in reversed(made) if self._names_result(one, entry.fingerprints[0])), None)
            case Question.MARK:
                pose = self._standing.get((entry.images[0], "", ""))
                if pose is not None and self._names_result(pose, entry.fingerprints[0]) and pose.pose != entry.pose:
                    return pose  # the mark will have another name
        first = None
        for image, fingerprint in zip(entry.images, entry.fingerprints, strict=True):
            one = self._standing.get((image, entry.point, entry.kind))
            if one is None or not self._names_result(one, fingerprint):
                return None
            first = first or one
        return first

    def _names_result(self, one: decisions_file.Decision, fingerprint: str) -> bool:
        """Whether a decision refers to the current result."""
        return not one.fingerprint or fingerprint in self._later_keys.get(one.fingerprint, {one.fingerprint})

    def _check(self, one: decisions_file.Decision) -> None:
        """Check that image and mark exist and the decision is possible. Raises InputError otherwise."""
        if one.subject[2] == decisions_file.LEARNED:
            if one.image not in self.project.scans:
                raise InputError(f"there is no image or mark {one.image!r}.")
            wanted = {mark.id for mark in self.project.image_camera(one.image).learned}
            if one.decision is decisions_file.DecisionKind.LEARN and set(one.px) != wanted:
                marks = ", ".join(sorted(wanted))
                raise InputError(f"{one.image}: click {marks}: all marks of its camera, and no others.")
            return
        try:
            view = self.view(one.image)
            mark = view.mark(one.point, one.subject[2]) if one.point else None
        except KeyError as error:
            raise InputError(f"there is no image or mark {error.args[0]!r}.") from None
        size = (view.scan.width_px, view.scan.height_px)
        if one.decision is decisions_file.DecisionKind.PLACE and not all(
            px is not None and -0.5 <= px <= side - 0.5 for px, side in zip((one.col_px, one.row_px), size, strict=True)
        ):
            raise InputError(
                f"{one.image}, {one.point}: column {one.col_px:g}, row {one.row_px:g} is outside of the scan of "
                f"{size[0]} x {size[1]} px. Click within it."
            )
        if one.decision in (decisions_file.DecisionKind.ACCEPT, decisions_file.DecisionKind.REJECT) and (
            mark is None or mark.covariance is None
        ):
            raise InputError(
                f"{one.image}, {one.point}: nothing was measured that could be {one.decision}ed. Place it with a click."
            )


def _answer_json(one: decisions_file.Decision) -> Json:
    names = ("decision", "image", "point", "pose", "note", "col_px", "row_px", "px", "who", "when")
    return {**{name: getattr(one, name) for name in names}, "kind": one.subject[2]}
