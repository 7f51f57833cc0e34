"""What became of a scan, in one table: the documentation and `reseau status` are made from it."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from measure.flags import Code, Status


class Verdict(StrEnum):
    """Of a scan: the worst of its marks and problems. From the best to what is not known yet."""

    GOOD = "good"
    DECIDED = "decided"
    LOOK = "look"
    POOR = "poor"
    FAILED = "failed"
    WAITING = "waiting"
    OLD = "old"

    @property
    def needs_look(self) -> bool:
        return self not in (Verdict.GOOD, Verdict.DECIDED)


MEANING = {
    Verdict.GOOD: "Every mark that was sought is measured, and nothing speaks against any of them.",
    Verdict.DECIDED: "Good but for what a person has decided: nothing is open.",
    Verdict.LOOK: "Usable, but a mark is weak, missing or refused, or the frame has a problem: an assumed pose, say.",
    Verdict.POOR: "Hardly usable: too few marks were found to tell where the frame is, or to check one by another.",
    Verdict.FAILED: "Nothing was measured: the file is missing, damaged or no scan, or its process was ended.",
    Verdict.WAITING: "Not measured yet.",
    Verdict.OLD: "Stale: the file, the options or the decisions about it are others than when it was measured.",
}

NEXT_STEP = {
    Verdict.GOOD: "Nothing.",
    Verdict.DECIDED: "Nothing.",
    Verdict.LOOK: "Read the reasons in the report; decide in `reseau review`, or leave as it is: sigmas tell how well.",
    Verdict.POOR: "Look at the scan: is it of this camera, whole, sharp? Scan it again, or name it in `exclude`.",
    Verdict.FAILED: "Mend or replace the file, which is noticed; `--retry` after an outage; or name it in `exclude`.",
    Verdict.WAITING: "Run `reseau measure`.",
    Verdict.OLD: "Run `reseau measure`: it measures or judges these anew, and no others.",
}

_OF_MARK = {
    Status.MEASURED: Verdict.GOOD,
    Status.WEAK: Verdict.LOOK,
    Status.PREDICTED: Verdict.LOOK,
    Status.REJECTED: Verdict.LOOK,
    Status.ABSENT: Verdict.LOOK,
}
_ANSWERED = frozenset((Code.DECIDED, Code.CLICKED))
_LEAST_FIDUCIALS = 3  # two give a frame, and nothing to check it by


def verdict_of(record: Mapping[str, Any]) -> Verdict:
    """The verdict of a scan's record, as `pipeline.results.measured_record` has it."""
    if record["failure"]:
        return Verdict.FAILED
    marks = record["marks"]
    fiducials = [mark for mark in marks if mark["kind"] == "fiducial" and not _is_elsewhere(mark)]
    observed = [mark for mark in marks if Status(mark["status"]).is_observation]
    seen = sum(mark["kind"] == "fiducial" for mark in observed)
    too_few = seen < min(_LEAST_FIDUCIALS, len(fiducials))
    if not observed or too_few or (fiducials and record["pixel_from_camera"] is None):
        return Verdict.POOR
    pose = record["pose"]
    needs_look = record["problems"] or (pose and not pose["decided"])
    of_marks = max((_of_mark(mark) for mark in marks), key=list(Verdict).index)
    if needs_look or of_marks is Verdict.LOOK:
        return Verdict.LOOK
    return Verdict.DECIDED if record.get("decided_by") else of_marks


def is_answered(reason_code: str) -> bool:
    """Whether a person has decided about the mark that has this reason."""
    return not _ANSWERED.isdisjoint(reason_code.split())


def _is_elsewhere(mark: Mapping[str, Any]) -> bool:
    """Whether another scan of the same frame shows it."""
    return Code.OTHER_PART in mark["reason_code"].split()


def _of_mark(mark: Mapping[str, Any]) -> Verdict:
    """A target that was not seen costs the others nothing; a fiducial is in every frame of its camera. What a person
    has said of a mark is not asked again."""
    if is_answered(mark["reason_code"]):
        return Verdict.DECIDED
    if _is_elsewhere(mark):
        return Verdict.GOOD
    status = Status(mark["status"])
    return Verdict.GOOD if status is Status.PREDICTED and mark["kind"] != "fiducial" else _OF_MARK[status]
