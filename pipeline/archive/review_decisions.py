"""Review decisions as input of the measurement: which ones apply to a scan, what they change, which lines have no
effect."""

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from measure.fiducials.options import CLICK_SIGMA_PX, Click
from measure.flags import Cause, Code, Reason, Status
from measure.results import MEASURE_REVISION, Covariance, MarkMeasurement
from pipeline.archive.checked_results import CheckRun
from pipeline.archive.schema import row_digest
from pipeline.files.decisions_file import LEARNED, About, Decision, DecisionKind, push_decision, standing
from pipeline.files.project_file import Project
from pipeline.measuring.scan_task import ScanTask, image_options
from pipeline.provenance import fingerprint, hash_text
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.wording import did_you_mean

_MEASURED = (DecisionKind.PLACE, DecisionKind.POSE, DecisionKind.UNDO)  # decisions that change the measurement
_INAPPLICABLE = "decisions that do not apply"
_NAMED = 10

Marks = Mapping[tuple[str, str], bool]  # by point and kind: whether something was measured


def request_hasher(project: Project) -> Callable[[str], str]:
    """Function from an image's name to the hash of its request: options, revision of measuring and decisions that
    change the measurement. Raises InputError for marks that cannot be sought."""
    options, hashes = image_options(project, {}), dict[int, str]()
    decisions_of = {
        image: [one for one in decisions if one.decision in _MEASURED]
        for image, decisions in group_decisions(project.decisions).items()
    }

    def request_hash(image: str) -> str:
        own = options(image)
        if id(own) not in hashes:
            hashes[id(own)] = hash_text(f"{own.json} {MEASURE_REVISION}")
        own_decisions = decisions_of.get(image)
        return fingerprint([hashes[id(own)], own_decisions]) if own_decisions else hashes[id(own)]

    return request_hash


# A decision applies to the result that was reviewed, which its fingerprint identifies: after a change of the scan's
# file, the options or the revision of measuring, the scan has to be reviewed again. Places and poses change the
# measurement; results that follow from earlier decisions still belong to the same scan.


def group_decisions(decisions: Sequence[Decision]) -> Mapping[str, Sequence[Decision]]:
    """Decisions about each scan, the oldest first, without those about a camera's marks."""
    grouped = defaultdict[str, list[Decision]](list)
    for one in decisions:
        if one.subject[2] != LEARNED:
            grouped[one.image].append(one)
    return grouped


def decisions_hash(decisions: Sequence[Decision]) -> str:
    """Hash of all decisions about an image; "" where there are none."""
    if not decisions:
        return ""
    values = [
        (str(one.decision), *one.subject, one.col_px, one.row_px, one.pose, one.note, one.who, one.fingerprint)
        for one in decisions
    ]
    return row_digest(*values)


def apply_decisions(
    task: ScanTask,
    decisions: Sequence[Decision],
    key_of: Callable[[ScanTask], str],
    pose_of: Callable[[str], str | None],
    later_keys: Callable[[str], Set[str]] = lambda key: {key},
) -> tuple[ScanTask, Mapping[About, Decision]]:
    """Apply decisions to the task of their scan; return it, and the decisions that apply, by subject.

    Parameters
    ----------
    task : of the scan, before decisions.
    decisions : about this scan, the oldest first.
    key_of : fingerprint of a task's result.
    pose_of : from the fingerprint of a result, the pose under which its marks are named; None where it is unknown.
    later_keys : from the fingerprint of a result, all that it has had since then.
    """
    counted, now, key = list[Decision](), task, key_of(task)
    current_keys = {key}  # of the results that a decision may refer to
    ever = set(current_keys)
    for one in decisions:
        known = ever if one.decision is DecisionKind.POSE else current_keys
        if one.decision is not DecisionKind.UNDO and one.fingerprint and not later_keys(one.fingerprint) & known:
            continue
        before, old_key, counted = now, key, [*counted, one]
        now = _apply_to_task(task, standing(counted).values())
        key = key_of(now)
        was, will = before.options.fiducials.pose, now.options.fiducials.pose  # on which the names of marks depend
        keeps_names = was == will or (was == "auto" and will == pose_of(old_key))
        current_keys = current_keys | {key} if keeps_names else {key}
        ever |= current_keys
    return now, standing(counted)


def before_checks(scan: MeasuredScan, counting: Mapping[About, Decision]) -> MeasuredScan:
    """The scan with all decisions except acceptance, so that rejected and absent marks do not affect the checks of
    other scans."""
    return _apply_decisions(
        scan, {about: one for about, one in counting.items() if one.decision is not DecisionKind.ACCEPT}
    )


def after_checks(scan: MeasuredScan, counting: Mapping[About, Decision]) -> MeasuredScan:
    """The scan with all decisions, which override the checks, and the number of decisions by person."""
    marks = {(scan.frame.image, mark.point, mark.kind) for mark in scan.frame.marks}
    applied = [one for about, one in counting.items() if not about[1] or about in marks]
    people = Counter(one.who or "somebody" for one in applied)
    return replace(_apply_decisions(scan, counting), reviewers=dict(sorted(people.items())))


def _apply_to_task(task: ScanTask, decisions: Iterable[Decision]) -> ScanTask:
    clicks = list[Click]()
    for one in sorted(decisions, key=lambda one: one.subject):
        if one.decision is DecisionKind.POSE:
            task = task.change_options(pose=one.pose)
        elif one.decision is DecisionKind.PLACE and one.subject[2] == "fiducial":
            assert one.col_px is not None
            assert one.row_px is not None
            clicks.append(Click(one.point, one.col_px, one.row_px))
    return task.change_options(clicks=tuple(clicks))


def _apply_decisions(scan: MeasuredScan, counting: Mapping[About, Decision]) -> MeasuredScan:
    image, marks = scan.frame.image, scan.frame.marks
    return scan.changed([_apply_to_mark(mark, counting.get((image, mark.point, mark.kind))) for mark in marks])


def _apply_to_mark(mark: MarkMeasurement, decision: Decision | None) -> MarkMeasurement:
    if decision is None:
        return mark
    by = f"by {decision.who or 'somebody'}{f' ({decision.note})' if decision.note else ''}"
    match decision.decision:
        case DecisionKind.ACCEPT if mark.covariance is not None and mark.center_px is not None:
            reason = Reason(
                f"accepted {by}{f': {mark.reason}' if mark.reason else ''}", Code.DECIDED, *mark.reason.codes
            )
            return replace(mark, status=Status.MEASURED, reason=reason)
        case DecisionKind.REJECT:
            return replace(mark, status=Status.REJECTED, reason=Reason(f"rejected {by}", Code.DECIDED))
        case DecisionKind.ABSENT:
            reason = Reason(f"absent, {by}", Code.DECIDED)
            return replace(mark, status=Status.ABSENT, center_px=None, covariance=None, reason=reason)
        case DecisionKind.PLACE if mark.kind != "fiducial":  # fiducials are matched from the clicked place
            place = np.array([decision.col_px, decision.row_px], dtype=np.float64)
            covariance = Covariance({Cause.CLICK: CLICK_SIGMA_PX**2 * np.eye(2)})
            reason = Reason(f"placed {by}", Code.DECIDED)
            return replace(mark, status=Status.WEAK, center_px=place, covariance=covariance, reason=reason)
    return mark


def tell_inapplicable(
    project: Project,
    check_run: CheckRun,
    decisions: Mapping[str, Sequence[Decision]],
    counting: Mapping[str, Mapping[About, Decision]],
) -> None:
    """Store messages about the decisions that a check run could not apply. decisions, counting: by image, all, and
    those in force."""
    lines = sorted([*unknown_images(project), *_known_images(project, check_run, decisions, counting)])
    messages = [f"line {number}: {why}" for number, why in lines]
    check_run.database.remember(_INAPPLICABLE, {"digest": check_run.digest, "lines": messages})


def inapplicable(check_run: CheckRun | None) -> tuple[str, ...]:
    """Messages about the decisions that a check run could not apply, shortened."""
    kept = (check_run and check_run.database.recall(_INAPPLICABLE)) or {}
    return shortened(kept["lines"]) if check_run and kept.get("digest") == check_run.digest else ()


def shortened(lines: Sequence[str]) -> tuple[str, ...]:
    """The first of many lines, and the number of the others."""
    left = len(lines) - _NAMED
    return (*lines[:_NAMED], *([f"and {left} lines more"] if left > 0 else []))


def unknown_images(project: Project) -> Iterator[tuple[int, str]]:
    """Yield (line, message) for decisions about images that the project lacks, and for a last line that is cut
    short."""
    if project.decisions_cut_short:
        yield project.decisions_cut_short, "is cut short, or has a typing error. Mend the line, or take it out."
    unknown = {one.image for one in project.decisions} - project.scans.keys() if project.scans else set()
    hints = {image: did_you_mean(image, project.scans) for image in sorted(unknown)[:_NAMED]}
    for one in project.decisions if unknown else ():
        if one.image in unknown:
            yield one.line, f"the project has no image {one.image!r}.{hints.get(one.image, '')}"


def _known_images(
    project: Project,
    check_run: CheckRun,
    every: Mapping[str, Sequence[Decision]],
    counting: Mapping[str, Mapping[About, Decision]],
) -> Iterator[tuple[int, str]]:
    """Yield (line, message) for decisions about images of the project that have no effect."""
    decisions = {image: own for image, own in every.items() if image in project.scans}
    marks = defaultdict[str, dict[tuple[str, str], bool]](dict)
    query = (
        "select image, point, kind, causes is not null from checked_mark "
        "where judging = ? and image in (select value from json_each(?))"
    )
    rows = check_run.database.connection.execute(query, (check_run.row, json.dumps(list(decisions))))
    for image, *mark, is_measured in rows:
        marks[image][mark[0], mark[1]] = bool(is_measured)
    for image, own in decisions.items():
        stacks = dict[About, list[Decision]]()
        for one in own:
            if one.decision is DecisionKind.UNDO and not stacks.get(one.subject):
                yield one.line, f"there is nothing to undo about {_decision_subject(one)}."
            push_decision(stacks, one)
        for about, stack in stacks.items():
            if stack and (why := _why(stack[-1], counting[image].get(about), marks[image])):
                yield stack[-1].line, why


def _why(one: Decision, counted: Decision | None, marks: Marks) -> str:
    """Why a standing decision does not apply; "" if it does."""
    _, point, kind = one.subject
    if point and (point, kind) not in marks:
        hint = did_you_mean(point, [name for name, of_kind in marks if of_kind == kind])
        return f"image {one.image!r} has no {kind} {point!r}.{hint}"
    if counted != one:
        subject = _decision_subject(one)
        return f"what was decided about {subject} is of an earlier result. Look again in `reseau review`."
    if one.decision is DecisionKind.ACCEPT and not marks[point, kind]:
        return f"nothing was measured of {_decision_subject(one)} that could be accepted. Place it in `reseau review`."
    return ""


def _decision_subject(one: Decision) -> str:
    return f"{one.subject[2]} {one.point!r} of image {one.image!r}" if one.point else f"image {one.image!r}"
