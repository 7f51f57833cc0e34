"""Verdicts on scans, in one table: source of the documentation and of `reseau status`."""

from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING

from measure.flags import Code, MeaningfulWord, Status
from pipeline.text.wording import count_sentence

if TYPE_CHECKING:
    from pipeline.results.measured_record import MeasuredScan  # with numpy, for which `reseau --help` would wait

_LEAST_FIDUCIALS = 3  # two determine an interior orientation without any check


class Verdict(MeaningfulWord):
    """Verdict on a scan: the worst of its marks and problems, ordered from the best to not yet known."""

    GOOD = "good", "All fiducials are measured and passed their checks; targets are tested by the adjustment."
    DECIDED = "decided", "Good after review decisions: nothing is open."
    LOOK = (
        "look",
        "Usable, but a fiducial is weak, missing or rejected, no target is measured, or the frame has a problem "
        "(assumed scan orientation, ...).",
    )
    POOR = "poor", "Hardly usable: too few marks for an interior orientation, or for a check of it."
    FAILED = "failed", "Nothing was measured: the file is missing, damaged or not a scan, or its process was killed."
    WAITING = "waiting", "Not measured yet."
    OLD = "old", "Stale: the file, the options or the review decisions have changed since it was measured."

    @property
    def needs_review(self) -> bool:
        return self not in (Verdict.GOOD, Verdict.DECIDED)


NEXT_STEP = {
    Verdict.GOOD: "Nothing.",
    Verdict.DECIDED: "Nothing.",
    Verdict.LOOK: "Read the reasons in the report; decide in `reseau review`, or leave it: its sigmas allow for it.",
    Verdict.POOR: (
        "Is the scan of this camera (`reseau cameras --scan FILE`), complete and sharp? Scan it again, or name it in "
        "`exclude`."
    ),
    Verdict.FAILED: "Repair or replace the file; `--retry` after an outage; or name it in `exclude`.",
    Verdict.WAITING: "Run `reseau measure`.",
    Verdict.OLD: "Run `reseau measure`: it measures or checks only these again.",
}

_COUNTED = {each: str(each) for each in Verdict} | {Verdict.LOOK: "to look at", Verdict.OLD: "stale"}  # after a number
_MARK_VERDICTS = {status: Verdict.GOOD if status is Status.MEASURED else Verdict.LOOK for status in Status}
_MEASURED = (Verdict.GOOD, Verdict.DECIDED, Verdict.LOOK, Verdict.POOR)
_ANSWERED = frozenset((Code.DECIDED, Code.CLICKED))
MarkState = tuple[str, Status, Collection[str]]  # kind, status, codes of the reason


def scan_counts(counts: Mapping[Verdict, int]) -> str:
    """Sentence with the number of measured scans and of scans of each verdict."""
    measured = sum(counts.get(verdict, 0) for verdict in _MEASURED)
    return count_sentence(
        "measured", measured, sum(counts.values()), {words: counts.get(each, 0) for each, words in _COUNTED.items()}
    )


def scan_verdict(scan: "MeasuredScan", marks: Sequence[MarkState] | None = None) -> Verdict:
    """Verdict on a scan. marks: to judge instead of its own."""
    if scan.failure:
        return Verdict.FAILED
    if marks is None:
        marks = [(mark.kind, mark.status, mark.reason.codes) for mark in scan.frame.marks]
    has_frame = scan.frame.pixel_from_camera is not None
    return frame_verdict(marks, has_frame, has_problem(scan), bool(scan.reviewers))


def scan_doubt(scan: "MeasuredScan") -> str:
    """First reason why a scan needs a look; "" if it needs none."""
    frame, pose = scan.frame, scan.frame.pose
    if not scan_verdict(scan).needs_review:
        return ""
    of_pose = [f"scan orientation {pose.name} is assumed"] if pose is not None and not pose.decided else []
    marks = (mark for mark in frame.marks if mark.reason and not is_answered(mark.reason.codes))
    return next(chain(frame.problems, of_pose, (f"{mark.point}: {mark.reason}" for mark in marks)), "")


def has_problem(scan: "MeasuredScan") -> bool:
    """Whether the frame as a whole needs a look, for example because its scan orientation is assumed."""
    frame = scan.frame
    return bool(frame.problems) or (frame.pose is not None and not frame.pose.decided)


def frame_verdict(marks: Sequence[MarkState], has_frame: bool, is_doubtful: bool, has_decisions: bool) -> Verdict:
    """Verdict on a measured frame. has_frame: its interior orientation is known; is_doubtful: result of
    `has_problem`."""
    fiducials = [mark for mark in marks if mark[0] == "fiducial" and Code.OTHER_PART not in mark[2]]
    observed = [kind for kind, status, _ in marks if status.is_observation]
    too_few = observed.count("fiducial") < min(_LEAST_FIDUCIALS, len(fiducials))
    if not observed or too_few or (fiducials and not has_frame):
        return Verdict.POOR
    worst = max((mark_verdict(*mark) for mark in marks), key=list(Verdict).index)
    misses_points = not {kind for kind, *_ in marks if kind != "fiducial"} <= set(observed)  # all of a kind
    if is_doubtful or misses_points or worst is Verdict.LOOK:
        return Verdict.LOOK
    return Verdict.DECIDED if has_decisions else worst


def is_answered(codes: Collection[str]) -> bool:
    """Whether a person has decided about the mark whose reason has these codes."""
    return not _ANSWERED.isdisjoint(codes)


def mark_verdict(kind: str, status: Status, codes: Collection[str]) -> Verdict:
    """Verdict on one mark."""
    # Targets are many, and the adjustment tests each; a fiducial must be found, unless it lies on another part.
    if is_answered(codes):
        return Verdict.DECIDED
    if Code.OTHER_PART in codes or kind != "fiducial":
        return Verdict.GOOD
    return _MARK_VERDICTS[status]
