"""Review queue: questions of a project for the user, from the results database.

The order is: first cameras whose marks have no drawing or template, since nothing is found without them. Then scan
orientations (poses), on which the names of all marks of a frame depend; asked once for all frames of a roll. Then
frames without any mark found. Then marks, those of frames with few others first, since a decision changes more there.
Natural points are no questions: hundreds are found, and a doubtful one is left out at no cost.
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
    """Kind of question, in the order of the queue."""

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
        """Whether an answer is needed. It is optional for a camera whose marks were learned from its scans."""
        return self.question is not Question.CAMERA or self.marks == 0

    @property
    def folder(self) -> str:
        return self.images[0].rpartition("/")[0]


def build_queue(project: Project, db: sqlite3.Connection | None, judging: int) -> tuple[Entry, ...]:
    """Build the queue of one run of the cross-scan checks, the worst first. db: None before the first run."""
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
select name, result, fingerprint, coalesce(camera, ''), verdict, coalesce(changed -> '$.pose', measured -> '$.pose'),
    coalesce(changed ->> '$.problems[0]', measured ->> '$.problems[0]', '')
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
    """Yield a question for each camera whose marks are learned from its scans. with_marks: images with marks found."""
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


def _marks(db: sqlite3.Connection, judging: int, frames: dict[int, _Frame]) -> Iterator[Entry]:
    for result, point, kind, status, code, reason in db.execute(_MARKS, (judging,)):
        frame = frames.get(result)
        if frame is not None and frame.marks:
            where = ((frame.image,), (frame.key,), frame.camera, frame.verdict, frame.marks)
            yield Entry(Question.MARK, *where, reason, code, point, kind, status, frame.pose)


def _badness(entry: Entry) -> tuple[int, bool, int, str]:
    is_target = entry.kind != "fiducial"  # targets come last: they are many, and each matters little
    return (entry.marks if not is_target else 0, is_target, _WORST.index(Status(entry.status)), entry.images[0])
