"""What a person decided, as input of measuring: which decisions count for a scan, and what they change.

A decision counts for the result that was looked at, which its fingerprint names: after the scan's file, the options or
the way of measuring changed, somebody has to look again. Places and poses change what is measured; results that follow
from decisions by those before them are the same scan still.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.fiducials.options import CLICK_SIGMA_PX, Click
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, MarkMeasurement
from pipeline.archive.digests import row_digest
from pipeline.files.decisions_file import LEARNED, About, Choice, Decision, standing
from pipeline.measuring.scan_task import ScanTask
from pipeline.results.measured_scan import MeasuredScan

KeyOf = Callable[[ScanTask], str]
PoseOf = Callable[[str], str | None]


@dataclass(frozen=True)
class Decided:
    """A scan's task as decisions leave it, and those that count, by what they are about."""

    task: ScanTask
    counting: Mapping[About, Decision]


def by_image(decisions: Sequence[Decision]) -> Mapping[str, Sequence[Decision]]:
    """The decisions about each scan, the oldest first; those about a camera's marks left out."""
    told = defaultdict[str, list[Decision]](list)
    for one in decisions:
        if one.about[2] != LEARNED:
            told[one.image].append(one)
    return told


def decisions_hash(decisions: Sequence[Decision]) -> str:
    """Of all decisions about an image; "" where there are none."""
    if not decisions:
        return ""
    told = [
        (str(one.decision), *one.about, one.col_px, one.row_px, one.pose, one.note, one.who, one.fingerprint)
        for one in decisions
    ]
    return row_digest(*told)


def decided(task: ScanTask, decisions: Sequence[Decision], key_of: KeyOf, pose_of: PoseOf) -> Decided:
    """decisions: about this scan, the oldest first. key_of: the fingerprint of a task's result; pose_of: the pose in
    which the result of a fingerprint names its marks, None where it is not known."""
    if not decisions:
        return Decided(task, {})
    counted, now, key = list[Decision](), task, key_of(task)
    seen = {key}  # of the results that a decision may have been made about
    ever = set(seen)
    for one in decisions:
        known = ever if one.decision is Choice.POSE else seen
        if one.decision is not Choice.UNDO and one.fingerprint and one.fingerprint not in known:
            continue
        before, old_key, counted = now, key, [*counted, one]
        now = _with(task, standing(counted).values())
        key = key_of(now)
        seen = seen | {key} if _names_alike(before, now, pose_of(old_key)) else {key}
        ever |= seen
    return Decided(now, standing(counted))


def _names_alike(before: ScanTask, now: ScanTask, pose: str | None) -> bool:
    """Whether marks keep their names: they have others in another pose than that in which they were found."""
    was, will = before.options.fiducials.pose, now.options.fiducials.pose
    return was == will or (will == pose and was == "auto")


def before_checks(scan: MeasuredScan, counting: Mapping[About, Decision]) -> MeasuredScan:
    """The scan without the marks that are none, by which no other is judged then."""
    return _changed(scan, {about: one for about, one in counting.items() if one.decision is not Choice.ACCEPT})


def after_checks(scan: MeasuredScan, counting: Mapping[About, Decision]) -> MeasuredScan:
    """The scan as decisions have it, whatever the checks say, and who made how many of them."""
    marks = {(scan.frame.image, mark.point, mark.kind) for mark in scan.frame.marks}
    applied = [one for about, one in counting.items() if not about[1] or about in marks]
    people = Counter(one.who or "somebody" for one in applied)
    return replace(_changed(scan, counting), decided_by=dict(sorted(people.items())))


def _with(task: ScanTask, decisions: Iterable[Decision]) -> ScanTask:
    clicks, fiducials = list[Click](), task.options.fiducials
    for one in sorted(decisions, key=lambda one: one.about):
        if one.decision is Choice.POSE:
            fiducials = replace(fiducials, pose=one.pose)
        elif one.decision is Choice.PLACE and one.about[2] == "fiducial":
            assert one.col_px is not None
            assert one.row_px is not None
            clicks.append(Click(one.point, one.col_px, one.row_px))
    return replace(task, options=replace(task.options, fiducials=replace(fiducials, clicks=tuple(clicks))))


def _changed(scan: MeasuredScan, counting: Mapping[About, Decision]) -> MeasuredScan:
    marks = [_decided(mark, counting.get((scan.frame.image, mark.point, mark.kind))) for mark in scan.frame.marks]
    return replace(scan, frame=replace(scan.frame, marks=tuple(marks)))


def _decided(mark: MarkMeasurement, decision: Decision | None) -> MarkMeasurement:
    if decision is None:
        return mark
    by = f"by {decision.who or 'somebody'}{f' ({decision.note})' if decision.note else ''}"
    match decision.decision:
        case Choice.ACCEPT if mark.covariance is not None and mark.center_px is not None:
            told = Reason(f"accepted {by}{f': {mark.reason}' if mark.reason else ''}", Code.DECIDED, *mark.reason.codes)
            return replace(mark, status=Status.MEASURED, reason=told)
        case Choice.REJECT:
            return replace(mark, status=Status.REJECTED, reason=Reason(f"rejected {by}", Code.DECIDED))
        case Choice.ABSENT:
            told = Reason(f"absent, {by}", Code.DECIDED)
            return replace(mark, status=Status.ABSENT, center_px=None, covariance=None, reason=told)
        case Choice.PLACE if mark.kind != "fiducial":  # fiducials are matched from there
            place = np.array([decision.col_px, decision.row_px], dtype=np.float64)
            covariance = Covariance({Cause.CLICK: CLICK_SIGMA_PX**2 * np.eye(2)})
            told = Reason(f"placed {by}", Code.DECIDED)
            return replace(mark, status=Status.WEAK, center_px=place, covariance=covariance, reason=told)
    return mark
