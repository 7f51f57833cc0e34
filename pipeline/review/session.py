"""State of a review: the queue and its answers, kept up to date with the results database and the decisions file."""

import threading
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

from measure.geometry import POSES
from measure.scans.remote import fetch_location
from pipeline.archive.results_database import Store
from pipeline.errors import InputError
from pipeline.files.decision import LEARNED, About, Choice, Decision
from pipeline.files.decisions_file import (
    append_decisions,
    decisions_bytes,
    learned_from,
    parse_decisions,
    push_decision,
)
from pipeline.files.project_file import Project, reload_decisions
from pipeline.measuring.first_pictures import digest
from pipeline.measuring.learn_stage import add_learned_marks
from pipeline.review.frame_view import Looking
from pipeline.review.queue import Entry, Question, build_queue

_COMPARED = 4096  # bytes before the new part, compared to recognise a file that was only appended to
Json = dict[str, Any]

_NONE = -1  # no cross-scan checks yet
PAGE = 100  # entries sent at a time


class Ledger:
    """Decisions in force. Only new lines are read from a decisions file that was appended to."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, int, int] | None = None  # inode, size and modification time
        self._forget()

    def update(self) -> frozenset[str] | None:
        """Read new decisions. Returns the images concerned; None if the file was replaced and read again."""
        before, self._seen = self._seen, _state(self._path)
        if self._seen == before:
            return frozenset()
        more = self._more() if before and self._seen and before[0] == self._seen[0] else None
        if more is None:
            self._forget()
            self._take(decisions_bytes(self._path))
            return None
        return self._take(more)

    def get(self, about: About) -> Decision | None:
        stack = self._stacks.get(about)
        return stack[-1] if stack else None

    def image_decisions(self, image: str) -> Iterable[Decision]:
        """Decisions in force on the marks and the pose of an image, in the order of the first decision on each."""
        return (one for about in self._abouts.get(image, ()) if (one := self.get(about)) and about[2] != LEARNED)

    def learned(self, images: Collection[str]) -> Decision | None:
        """Decision from which the marks of the camera of these images are learned."""
        return learned_from(self._learned, images)

    def _forget(self) -> None:
        self._stacks: dict[About, list[Decision]] = {}
        self._abouts: dict[str, dict[About, None]] = defaultdict(dict)
        self._learned: list[Decision] = []
        self._end, self._lines, self._tail = 0, 0, b""

    def _more(self) -> bytes | None:
        """Bytes appended to the file; None if the part already read has changed."""
        if not self._tail.endswith(b"\n"):
            return None
        data = decisions_bytes(self._path, self._end - len(self._tail))
        return data[len(self._tail) :] if data.startswith(self._tail) else None

    def _take(self, data: bytes) -> frozenset[str]:
        new = parse_decisions(self._path, data, self._lines + 1)
        for one in new:
            push_decision(self._stacks, one)
            self._abouts[one.image][one.subject] = None
        self._learned += [one for one in new if one.subject[2] == LEARNED]
        self._end, self._lines = self._end + len(data), self._lines + data.count(b"\n")
        self._tail = (self._tail + data)[-_COMPARED:]
        return frozenset(one.image for one in new)


def _state(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


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


@dataclass(frozen=True)
class _Shown:
    """Questions that pass the filters, their keys, and the keys of those that need an answer."""

    filters: Filters
    entries: tuple[Entry, ...]
    keys: tuple[str, ...]
    open_keys: frozenset[str]

    @classmethod
    def from_queue(cls, filters: Filters, queue: Sequence[Entry]) -> "_Shown":
        entries = tuple(filter(filters.lets_through, queue))
        keys = tuple(entry.key for entry in entries)
        open_keys = (key for key, entry in zip(keys, entries, strict=True) if entry.is_left)
        return cls(filters, entries, keys, frozenset(open_keys))


class Session:
    """Review of a project. Thread-safe."""

    def __init__(self, project: Project, who: str) -> None:
        """Raises InputError if there are no checked results and no scans."""
        self.project, self.who = project, who
        self.folder = project.path.resolve().parent
        self.looking = Looking(project.measurement_path, self.folder, lambda image: self.learned.image_camera(image))
        self._lock = threading.RLock()
        self._judging: int | None = None
        self._ledger = Ledger(project.decisions_path)
        self._answers: dict[str, Decision] = {}
        self._shown: _Shown | None = None
        self.refresh()
        if self._judging == _NONE and not self._queue and not project.scans:
            raise InputError(
                f"{project.measurement_path}: no scan in it passed the cross-scan checks. Run `reseau measure` first."
            )

    def refresh(self) -> None:
        """Update the queue and its answers from the results database and the decisions file."""
        with self._lock:
            judging = self.looking.judging()
            row = _NONE if judging is None else judging.row
            changed = self._ledger.update()
            if row != self._judging:
                self._take_queue(row)
                changed = None
            if changed is None:
                self._answers, self._left = {}, Counter(entry.question for entry in self._queue if entry.is_left)
                self._total = self._left.total()
            for entry in self._queue if changed is None else self._image_entries(changed):
                before, now = self._answers.pop(entry.key, None), self._find_answer(entry)
                if now is not None:
                    self._answers[entry.key] = now
                if entry.is_left:
                    self._left[entry.question] += (before is not None) - (now is not None)

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
            if self._shown is None or self._shown.filters != filters:
                self._shown = _Shown.from_queue(filters, self._queue)
            shown = self._shown
            order = chain(range(start, len(shown.keys)), range(min(start, len(shown.keys))))
            return {
                "judging": self._judging,
                "total": self._total,
                "left": {"all": self._left.total(), **{str(question): self._left[question] for question in Question}},
                "shown": len(shown.entries),
                "shown_left": len(shown.open_keys - self._answers.keys()),
                "next_left": next((at for at in order if self._asks(shown, at)), -1),
                "start": start,
                "entries": [self.entry_json(entry) for entry in shown.entries[start : start + PAGE]],
            }

    def _asks(self, shown: _Shown, at: int) -> bool:
        key = shown.keys[at]
        return key in shown.open_keys and key not in self._answers

    def choices(self) -> Json:
        """Possible values of the filters."""
        return {
            "questions": [str(question) for question in Question],
            "verdicts": sorted({entry.verdict for entry in self._queue if entry.verdict}),
            "statuses": sorted({entry.status for entry in self._queue if entry.status}),
            "codes": sorted({code for entry in self._queue for code in entry.code.split()}),
            "cameras": sorted({entry.camera for entry in self._queue}),
            "folders": sorted({entry.folder for entry in self._queue if entry.folder}),
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
            return [_answer_json(one) for one in self._ledger.image_decisions(image)]

    def _take_queue(self, judging: int) -> None:
        self.project = self.learned = reload_decisions(self.project)
        if judging == _NONE:
            self._queue = build_queue(self.project, None, judging)
        else:
            with Store(self.project.measurement_path) as store:
                self.learned = add_learned_marks(self.project, store)
                self._queue = build_queue(self.project, store.connection, judging)
        self._by_key = {entry.key: entry for entry in self._queue}
        of_image = defaultdict[str, list[Entry]](list)
        for entry in self._queue:
            for image in entry.images:
                of_image[image].append(entry)
        self._of_image, self._judging, self._shown = of_image, judging, None

    def _image_entries(self, images: Collection[str]) -> Collection[Entry]:
        return {entry.key: entry for image in images for entry in self._of_image.get(image, ())}.values()

    def _find_answer(self, entry: Entry) -> Decision | None:
        """Decision that answers a question; None if it is open.

        A question about several frames needs decisions on all of them. Any decision on a frame answers the question
        about a frame without marks. A changed pose answers the questions about marks, since it renames them.
        """
        match entry.question:
            case Question.CAMERA:
                return self._ledger.learned(frozenset(entry.images))
            case Question.FRAME:
                made = [
                    one
                    for one in self._ledger.image_decisions(entry.images[0])
                    if _names_result(one, entry.fingerprints[0])
                ]
                return made[-1] if made else None
        if entry.question is Question.MARK:
            pose = self._ledger.get((entry.images[0], "", ""))
            if pose is not None and _names_result(pose, entry.fingerprints[0]) and pose.pose != entry.pose:
                return pose  # the mark will have another name
        first = None
        for image, fingerprint in zip(entry.images, entry.fingerprints, strict=True):
            one = self._ledger.get((image, entry.point, entry.kind))
            if one is None or not _names_result(one, fingerprint):
                return None
            first = first or one
        return first

    def _old_json(self, entry: Entry) -> Json | None:
        """JSON of a decision on an earlier result; None if there is none."""
        if entry.question in (Question.CAMERA, Question.FRAME):
            return None
        one = self._ledger.get((entry.images[0], entry.point, entry.kind))
        return None if one is None or _names_result(one, entry.fingerprints[0]) else _answer_json(one)

    def _add_fingerprint(self, one: Decision) -> Decision:
        """Add the fingerprint of the scan to a decision to learn marks, so that it applies to this file only."""
        is_learned = one.decision is Choice.LEARN
        return replace(one, fingerprint=digest(self.project.scans[one.image])) if is_learned else one

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
        if one.decision is Choice.POSE and one.pose not in POSES:
            raise InputError(f"{one.pose!r} is no pose; {', '.join(POSES)} are.")

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
