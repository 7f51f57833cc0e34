"""What of a project needs a person's eye, from the store: the worst first, each question once.

How a camera's marks look comes first, where nothing tells it, for without them nothing is found. Then a pose, for all
names of its frame hang on it, and once where it is the same question for the frames of a roll; then frames in which
nothing was found; then marks, those of frames with few others before those with many, for there a decision changes
more.
"""

import json
import sqlite3
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

from measure.flags import Code, Status
from pipeline.archive.results_integrity import check_judging, damaged_frames, damaged_sentence
from pipeline.archive.verdicts import Verdict
from pipeline.files.project_file import Project


class Question(StrEnum):
    """What is asked, in the order in which it is."""

    CAMERA = "camera"
    POSE = "pose"
    FRAME = "frame"
    MARK = "mark"


_UNKNOWN = "how its marks look is not known: click each of them in one scan that shows them well."
_COMMON = (
    "its marks were learned from what its scans have in common. Click them in one scan to learn them again from it."
)
_WORST = (Status.REJECTED, Status.WEAK, Status.PREDICTED, Status.ABSENT)


@dataclass(frozen=True, slots=True)
class Entry:
    """A question. images: of a camera all its scans, of a pose all frames that it is the same for, else one.
    fingerprints: of the results that are looked at, in the order of the images; none of a camera. marks: how many were
    found in the frame, or in one of the camera's. point, kind, status: of a mark; pose: in which it has that name.
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
        """By which a page asks for it."""
        return json.dumps([self.question, self.images[0], self.point, self.kind], ensure_ascii=False)

    @property
    def is_left(self) -> bool:
        """Whether it needs an answer. Marks that are found by what their scans have in common need not be shown."""
        return self.question is not Question.CAMERA or self.marks == 0

    @property
    def folder(self) -> str:
        return self.images[0].rpartition("/")[0]


def build_queue(project: Project, db: sqlite3.Connection | None, judging: int) -> tuple[Entry, ...]:
    """Every question of a judging, the worst first. db: None where nothing is judged yet."""
    if db:
        check_judging(db, judging, project.measurement_path)
    damaged = damaged_frames(db, judging) if db else {}
    frames = {frame.result: frame for frame in _frames(db, judging) if frame.result not in damaged} if db else {}
    marks = sorted(_marks(db, judging, frames), key=_badness) if db else []
    bare = [
        Entry(
            Question.FRAME,
            (image,),
            ("",),
            "",
            str(Verdict.FAILED),
            0,
            damaged_sentence(image, project.measurement_path.name),
        )
        for image in sorted(damaged.values())
    ]
    bare += [
        Entry(Question.FRAME, (f.image,), (f.key,), f.camera, f.verdict, 0, f.problem or "no mark was found in it")
        for f in sorted(frames.values(), key=lambda frame: frame.image)
        if f.marks == 0
    ]
    with_marks = {frame.image for frame in frames.values() if frame.marks}
    return (*_cameras(project, with_marks), *_poses(list(frames.values())), *bare, *marks)


@dataclass(frozen=True, slots=True)
class _Frame:
    image: str
    result: int
    key: str
    camera: str
    verdict: str
    marks: int
    pose: str
    is_certain: bool
    evidence: str
    roll: str
    problem: str


_FRAMES = """
select f.name, f.result, r.fingerprint, coalesce(s.camera, ''), f.verdict,
    coalesce(json_extract(f.detail, '$.pose'), json_extract(r.detail, '$.pose')),
    coalesce(json_extract(f.detail, '$.problems[0]'), json_extract(r.detail, '$.problems[0]'), '')
from judged_frame f join result r on r.id = f.result join scan s on s.id = f.scan
where f.judging = ? and f.verdict <> 'failed' and s.duplicate_of is null
"""

_MARKS = f"""
select result, point, kind, status, reason_code, reason from checked_mark
where judging = ? and status <> 'measured' and reason_code not like '{Code.DECIDED}%'
    and reason_code not like '{Code.CLICKED}%' order by result, number
"""

_FOUND = """
select result, count(*) from checked_mark where judging = ? and status in ('measured', 'weak') group by result
"""


def _frames(db: sqlite3.Connection, judging: int) -> Iterator[_Frame]:
    found: dict[int, int] = dict(db.execute(_FOUND, (judging,)).fetchall())
    for image, result, key, camera, verdict, pose_json, problem in db.execute(_FRAMES, (judging,)):
        pose = json.loads(pose_json) if pose_json else None
        name, is_certain = ("", True) if pose is None else (pose["name"], bool(pose["decided"]))
        evidence = "" if pose is None else " ".join(pose["evidence"])
        roll = "" if pose is None else pose["roll"]
        count = found.get(result, 0)
        yield _Frame(image, result, key, camera, verdict, count, name, is_certain, evidence, roll, problem)


def _cameras(project: Project, with_marks: Collection[str]) -> Iterator[Entry]:
    """One for each camera whose marks are learned from its scans. with_marks: images in which some were found."""
    for camera in project.cameras.values():
        images = (
            tuple(image for image in project.scans if project.image_camera(image) is camera)
            if camera.needs_clicks
            else ()
        )
        if images:
            found = sum(image in with_marks for image in images)
            yield Entry(Question.CAMERA, images, (), camera.path.name, "", found, _COMMON if found else _UNKNOWN)


def _poses(frames: Sequence[_Frame]) -> Iterator[Entry]:
    """One for each roll's question, and for each frame that is asked about by itself: those first that concern many."""
    groups = defaultdict[tuple[str, str], list[_Frame]](list)
    for frame in sorted(frames, key=lambda frame: frame.image):
        if not frame.is_certain and frame.marks:
            groups[frame.camera, frame.roll or frame.image].append(frame)
    for group in sorted(groups.values(), key=lambda group: (-len(group), group[0].image)):
        first = group[0]
        images, keys = tuple(frame.image for frame in group), tuple(frame.key for frame in group)
        reason = first.roll or first.evidence
        yield Entry(Question.POSE, images, keys, first.camera, first.verdict, first.marks, reason)


def _marks(db: sqlite3.Connection, judging: int, frames: dict[int, _Frame]) -> Iterator[Entry]:
    for result, point, kind, status, code, reason in db.execute(_MARKS, (judging,)):
        frame = frames.get(result)
        if frame is not None and frame.marks:
            where = ((frame.image,), (frame.key,), frame.camera, frame.verdict, frame.marks)
            yield Entry(Question.MARK, *where, reason, code, point, kind, status, frame.pose)


def _badness(entry: Entry) -> tuple[int, bool, int, str]:
    is_target = entry.kind != "fiducial"  # of which there are many, and of which few change anything
    return (entry.marks if not is_target else 0, is_target, _WORST.index(Status(entry.status)), entry.images[0])
