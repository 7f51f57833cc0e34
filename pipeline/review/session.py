"""State of a review: the queue and its answers, kept up to date with the results database and the decisions file."""

import threading
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import islice
from typing import Any

from measure.scans.remote import fetch_location
from pipeline.archive.results_database import Store
from pipeline.errors import InputError
from pipeline.files.decisions_file import (
    LEARNED,
    Choice,
    Decision,
    append_decisions,
    learned_from,
    read_decisions,
    standing,
)
from pipeline.files.project_file import Project, reload_decisions
from pipeline.measuring.learn_stage import add_learned_marks
from pipeline.provenance import FileState, content_hash, file_state
from pipeline.review.frame_view import Looking
from pipeline.review.queue import Entry, Question, build_queue

Json = dict[str, Any]

_NONE = -1  # no cross-scan checks yet
PAGE = 100  # entries sent at a time


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
        return (
            self.question in ("", entry.question)
            and self.verdict in ("", entry.verdict)
            and self.status in ("", entry.status)
            and (not self.code or self.code in entry.code.split())
            and self.camera in ("", entry.camera)
            and (not self.folder or f"{entry.folder}/".startswith(f"{self.folder}/"))
            and (not self.search or any(self.search.lower() in image.lower() for image in entry.images))
        )


class Session:
    """Review of a project. Thread-safe."""

    def __init__(self, project: Project, who: str) -> None:
        """Raises InputError if there are no checked results and no scans."""
        self.project, self.who = project, who
        self.folder = project.path.resolve().parent
        self.looking = Looking(project.measurement_path, self.folder, lambda image: self.learned.image_camera(image))
        self._lock = threading.RLock()
        self._judging: int | None = None
        self._file_state: FileState | None = None  # of the decisions when they were read
        self.refresh()
        if self._judging == _NONE and not self._by_key and not project.scans:
            raise InputError(
                f"{project.measurement_path}: no scan in it passed the cross-scan checks. Run `reseau measure` first."
            )

    def refresh(self) -> None:
        """Update the queue and its answers from the results database and the decisions file."""
        with self._lock:
            judging = self.looking.judging()
            row = _NONE if judging is None else judging.row
            path = self.project.decisions_path
            before, self._file_state = self._file_state, file_state(path, self.folder)
            if row != self._judging:
                self._take_queue(row)
            elif self._file_state == before:
                return
            decisions = read_decisions(path)
            self._standing = standing(decisions)
            self._learned = [one for one in decisions if one.subject[2] == LEARNED]
            self._of_image = defaultdict[str, list[Decision]](list)
            for one in self._standing.values():
                self._of_image[one.image].append(one)
            self._answers = {
                key: answer for key, entry in self._by_key.items() if (answer := self._find_answer(entry)) is not None
            }

    def decide(self, decisions: Sequence[Decision], key: str = "") -> None:
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
            complete = [replace(self._add_fingerprint(one), who=self.who, when=when) for one in decisions]
            append_decisions(self.project.decisions_path, complete)
            self.refresh()

    def page(self, filters: Filters, start: int = 0) -> Json:
        """Numbers of open questions, and PAGE of the questions that pass the filters, from start on."""
        self.refresh()
        with self._lock:
            shown = {key: entry for key, entry in self._by_key.items() if filters.lets_through(entry)}
            open_places = [at for at, (key, entry) in enumerate(shown.items()) if self._is_open(key, entry)]
            left = Counter(entry.question for key, entry in self._by_key.items() if self._is_open(key, entry))
            return {
                "judging": self._judging,
                "total": sum(entry.is_left for entry in self._by_key.values()),
                "left": {"all": left.total(), **{str(question): left[question] for question in Question}},
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
        return {
            "questions": [str(question) for question in Question],
            "verdicts": sorted({entry.verdict for entry in self._by_key.values() if entry.verdict}),
            "statuses": sorted({entry.status for entry in self._by_key.values() if entry.status}),
            "codes": sorted({code for entry in self._by_key.values() for code in entry.code.split()}),
            "cameras": sorted({entry.camera for entry in self._by_key.values()}),
            "folders": sorted({entry.folder for entry in self._by_key.values() if entry.folder}),
        }

    @property
    def camera_name(self) -> str:
        """Default file name of a drawn camera: the camera file missing in the project, or another name."""
        return self.project.missing_camera or "drawn-camera.toml"

    def entry(self, key: str) -> Entry:
        """Question by its key. Raises KeyError for an unknown or obsolete one."""
        return self._by_key[key]

    def entry_json(self, entry: Entry) -> Json:
        answer = self._answers.get(entry.key)
        return {
            "key": entry.key,
            "question": str(entry.question),
            "image": entry.images[0],
            "count": len(entry.images),
            "fingerprint": entry.fingerprints[0] if entry.fingerprints else "",
            "point": entry.point,
            "kind": entry.kind,
            "status": entry.status,
            "code": entry.code,
            "reason": entry.reason,
            "camera": entry.camera,
            "verdict": entry.verdict,
            "marks": entry.marks,
            "is_left": entry.is_left,
            "answer": None if answer is None else _answer_json(answer),
            "old": self._old_json(entry),
        }

    def scan_location(self, image: str) -> str:
        """Path or address of an image's file. Raises KeyError for an unknown image."""
        given = self.project.scans.get(image)
        return self.looking.view(image).scan.scan if given is None else fetch_location(given)

    def image_decisions(self, image: str) -> list[Json]:
        """JSON of the decisions in force on a frame."""
        with self._lock:
            return [_answer_json(one) for one in self._scan_decisions(image)]

    def _scan_decisions(self, image: str) -> list[Decision]:
        """Decisions in force on the marks and the pose of an image."""
        return [one for one in self._of_image.get(image, ()) if one.subject[2] != LEARNED]

    def _take_queue(self, judging: int) -> None:
        self.project = self.learned = reload_decisions(self.project)
        if judging == _NONE:
            queue = build_queue(self.project, None, judging)
        else:
            with Store(self.project.measurement_path) as store:
                self.learned = add_learned_marks(self.project, store)
                queue = build_queue(self.project, store.connection, judging)
        self._by_key, self._judging = {entry.key: entry for entry in queue}, judging

    def _find_answer(self, entry: Entry) -> Decision | None:
        """Decision that answers a question; None if it is open."""
        # One about several frames needs decisions on all. A changed pose answers those about marks: it renames them.
        if entry.question is not Question.CAMERA and entry.images[0] not in self._of_image:
            return None
        match entry.question:
            case Question.CAMERA:
                return learned_from(self._learned, frozenset(entry.images))
            case Question.FRAME:
                made = self._scan_decisions(entry.images[0])
                return next((one for one in reversed(made) if _names_result(one, entry.fingerprints[0])), None)
            case Question.MARK:
                pose = self._standing.get((entry.images[0], "", ""))
                if pose is not None and _names_result(pose, entry.fingerprints[0]) and pose.pose != entry.pose:
                    return pose  # the mark will have another name
        first = None
        for image, fingerprint in zip(entry.images, entry.fingerprints, strict=True):
            one = self._standing.get((image, entry.point, entry.kind))
            if one is None or not _names_result(one, fingerprint):
                return None
            first = first or one
        return first

    def _old_json(self, entry: Entry) -> Json | None:
        """JSON of a decision on an earlier result; None if there is none."""
        if entry.question in (Question.CAMERA, Question.FRAME):
            return None
        one = self._standing.get((entry.images[0], entry.point, entry.kind))
        return None if one is None or _names_result(one, entry.fingerprints[0]) else _answer_json(one)

    def _add_fingerprint(self, one: Decision) -> Decision:
        """Add the fingerprint of the scan to a decision to learn marks, so that it applies to this file only."""
        is_learned = one.decision is Choice.LEARN
        return replace(one, fingerprint=content_hash(self.project.scans[one.image])) if is_learned else one

    def _check(self, one: Decision) -> None:
        """Check that image and mark exist and the decision is possible. Raises InputError otherwise."""
        if one.subject[2] == LEARNED:
            self._check_learned(one)
            return
        try:
            view = self.looking.view(one.image)
            mark = view.mark(one.point, one.subject[2]) if one.point else None
        except KeyError as error:
            raise InputError(f"there is no image or mark {error.args[0]!r}.") from None
        if one.decision in (Choice.ACCEPT, Choice.REJECT) and (mark is None or mark.covariance is None):
            raise InputError(
                f"{one.image}, {one.point}: nothing was measured that could be {one.decision}ed. Place it with a click."
            )

    def _check_learned(self, one: Decision) -> None:
        if one.image not in self.project.scans:
            raise InputError(f"there is no image or mark {one.image!r}.")
        wanted = {mark.id for mark in self.project.image_camera(one.image).learned}
        if one.decision is Choice.LEARN and set(one.px) != wanted:
            raise InputError(f"{one.image}: click {', '.join(sorted(wanted))}: all marks of its camera, and no others.")


def _names_result(one: Decision, fingerprint: str) -> bool:
    """Whether a decision refers to the current result."""
    return one.fingerprint in ("", fingerprint)


def _answer_json(one: Decision) -> Json:
    head = {"decision": str(one.decision), "point": one.point, "kind": one.subject[2], "who": one.who, "when": one.when}
    place = {"pose": one.pose, "note": one.note, "col_px": one.col_px, "row_px": one.row_px}
    return {**head, **place, "image": one.image, "px": one.px}
