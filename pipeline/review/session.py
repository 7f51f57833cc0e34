"""The state of a review: the queue as the store and the decisions have it now, whoever changed them."""

import threading
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from measure.marks.poses import POSES
from pipeline.archive.store import Store
from pipeline.errors import InputError
from pipeline.files.decisions_file import About, Choice, Decision, append_decisions, read_decisions, standing
from pipeline.files.project_file import Project
from pipeline.review.looked_at import Looking
from pipeline.review.queue import Entry, Question, queue_of

Json = dict[str, Any]

PAGE = 100  # entries that a page gets at a time


@dataclass(frozen=True)
class Filters:
    """Which questions are shown; "" is all of them. search: a part of an image's name."""

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
    """A review of a project. Threads may call any of it."""

    def __init__(self, project: Project, who: str) -> None:
        self.project, self.who = project, who
        folder = project.path.resolve().parent
        self.looking = Looking(project.measurement_path, folder, project.camera_of)
        self._lock = threading.RLock()
        self._judging = -1
        self._file_state: tuple[int, int] | None = None
        self._queue: tuple[Entry, ...] = ()
        self._by_key: Mapping[str, Entry] = {}
        self._of_image: Mapping[str, Sequence[Entry]] = {}
        self._standing: Mapping[About, Decision] = {}
        self._answers: dict[str, Decision] = {}
        self._totals: Counter[Question] = Counter()
        self._shown: tuple[Filters, tuple[Entry, ...]] | None = None
        self.refresh()

    def refresh(self) -> None:
        """Know what another process measured, or another window decided."""
        with self._lock:
            judging = self.looking.judging()
            if judging is None:
                raise InputError(
                    f"{self.project.measurement_path}: nothing in it is judged. Run `reseau measure` first."
                )
            state = _state(self.project.decisions_path)
            if (judging.row, state) == (self._judging, self._file_state):
                return
            if judging.row != self._judging:
                self._take_queue(judging.row)
            if state != self._file_state:
                self._standing = standing(read_decisions(self.project.decisions_path))
                self._file_state = state
            self._answers = dict(self._all_answers())

    def decide(self, decisions: Sequence[Decision]) -> None:
        """Write decisions down, all of them or none. Raises InputError for what cannot be decided."""
        when = datetime.now(UTC).isoformat(timespec="seconds")
        with self._lock:
            for one in decisions:
                self._check(one)
            append_decisions(self.project.decisions_path, [replace(one, who=self.who, when=when) for one in decisions])
            self.refresh()

    def page(self, filters: Filters, start: int = 0) -> Json:
        """Counts of what is left, and some of the questions that filters let through, from one on."""
        self.refresh()
        with self._lock:
            answered = Counter(self._by_key[key].question for key in self._answers)
            left = {str(question): self._totals[question] - answered[question] for question in Question}
            if self._shown is None or self._shown[0] != filters:
                self._shown = (filters, tuple(entry for entry in self._queue if filters.lets_through(entry)))
            shown = self._shown[1]
        return {
            "judging": self._judging,
            "total": len(self._queue),
            "left": {"all": sum(left.values()), **left},
            "shown": len(shown),
            "shown_left": len(shown) - sum(filters.lets_through(self._by_key[key]) for key in self._answers),
            "start": start,
            "entries": [self.entry_json(entry) for entry in shown[start : start + PAGE]],
        }

    def choices(self) -> Json:
        """What filters can be set to."""
        return {
            "questions": [str(question) for question in Question],
            "verdicts": sorted({entry.verdict for entry in self._queue}),
            "statuses": sorted({entry.status for entry in self._queue if entry.status}),
            "codes": sorted({code for entry in self._queue for code in entry.code.split()}),
            "cameras": sorted({entry.camera for entry in self._queue}),
            "folders": sorted({entry.folder for entry in self._queue if entry.folder}),
        }

    def entry(self, key: str) -> Entry:
        """Raises KeyError for a question that is none, or none any more."""
        return self._by_key[key]

    def entry_json(self, entry: Entry) -> Json:
        answer = self.answer(entry)
        return {
            "key": entry.key,
            "question": str(entry.question),
            "images": entry.images,
            "fingerprints": entry.fingerprints,
            "count": len(entry.images),
            "point": entry.point,
            "kind": entry.kind,
            "status": entry.status,
            "code": entry.code,
            "reason": entry.reason,
            "camera": entry.camera,
            "verdict": entry.verdict,
            "marks": entry.marks,
            "answer": None if answer is None else _answer_json(answer),
            "old": self._old_json(entry),
        }

    def answer(self, entry: Entry) -> Decision | None:
        """The decision that answers a question; of a frame without marks: one about any of its marks, or its pose."""
        return self._answers.get(entry.key)

    def _take_queue(self, judging: int) -> None:
        with Store(self.project.measurement_path) as store:
            self._queue = queue_of(store.connection, judging)
        self._by_key = {entry.key: entry for entry in self._queue}
        self._totals = Counter(entry.question for entry in self._queue)
        of_image = defaultdict[str, list[Entry]](list)
        for entry in self._queue:
            for image in entry.images:
                of_image[image].append(entry)
        self._of_image, self._judging, self._shown = of_image, judging, None

    def _all_answers(self) -> Iterator[tuple[str, Decision]]:
        for about, one in self._standing.items():
            for entry in self._of_image.get(about[0], ()):
                asked = entry.question is Question.FRAME or about in entry.abouts
                if asked and _is_about(one, entry) and all(self._is_answered(about, entry) for about in entry.abouts):
                    yield entry.key, one

    def _is_answered(self, about: About, entry: Entry) -> bool:
        """A question about several frames is answered when all of them are."""
        one = self._standing.get(about)
        return entry.question is Question.FRAME or (one is not None and _is_about(one, entry))

    def decided_in(self, image: str) -> list[Json]:
        """All that stands decided in a frame."""
        return [_answer_json(one) for about, one in self._standing.items() if about[0] == image]

    def _old_json(self, entry: Entry) -> Json | None:
        """A decision about another result than the one that is there now."""
        if entry.question is Question.FRAME:
            return None
        one = self._standing.get(entry.abouts[0])
        return None if one is None or _is_about(one, entry) else _answer_json(one)

    def _check(self, one: Decision) -> None:
        """Images and points are those of the store, and never paths."""
        try:
            seen = self.looking.at(one.image)
            mark = seen.mark(one.point, one.about[2]) if one.point else None
        except KeyError as error:
            raise InputError(f"there is no image or mark {error.args[0]!r}.") from None
        if one.decision in (Choice.ACCEPT, Choice.REJECT) and (mark is None or mark.covariance is None):
            raise InputError(
                f"{one.image}, {one.point}: nothing was measured that could be {one.decision}ed. Place it with a click."
            )
        if one.decision is Choice.POSE and one.pose not in POSES:
            raise InputError(f"{one.pose!r} is no pose; {', '.join(POSES)} are.")


def _is_about(one: Decision, entry: Entry) -> bool:
    """Whether a decision is about the result that is there now."""
    return not one.fingerprint or one.fingerprint in entry.fingerprints


def _answer_json(one: Decision) -> Json:
    told = {"decision": str(one.decision), "point": one.point, "kind": one.about[2], "who": one.who, "when": one.when}
    return {**told, "pose": one.pose, "note": one.note, "col_px": one.col_px, "row_px": one.row_px}


def _state(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns
