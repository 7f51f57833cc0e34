"""Problems of the measurement of frames that need a look before any adjustment."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace

from measure.flags import Code
from pipeline.report.data import Frame, Mark, Problem
from pipeline.report.fractions import fraction_test
from pipeline.report.numbers import fixed
from pipeline.text.wording import LISTED, capitalised, counted, drop_file_name, listed
from pipeline.types import Array

_NUMBER = re.compile(r"\d+(\.\d+)?")

_ONE_ANSWER = (
    "One answer holds for all of them: say in the camera file at which side of the frame it writes, and how, as "
    'writing = ["left: reads upward"].'
)

Gathered = dict[tuple[str, str], tuple[Problem, list[str]]]  # by masked text: the first problem and the images of all


def single_frame_problems(frame: Frame) -> Iterator[Problem]:
    """Yield the problems of one frame, an undetermined scan orientation (pose) first."""
    yield from _assumed_pose(frame)
    yield from _measurement_problems(frame)


def masked_text(sentence: str) -> str:
    """Mask the numbers of a sentence, to group sentences that differ only in numbers."""
    return _NUMBER.sub("#", sentence)


def frame_problems(shots: list[Frame]) -> Iterator[Problem]:
    """Yield the problems of all frames, scan orientations (poses) first. Problems that differ only in numbers are
    merged."""
    for evidence in (_assumed_pose, _measurement_problems):
        gathered: Gathered = {}
        for frame in shots:
            gather(gathered, frame.image, evidence(frame))
        yield from (named_problem(*each) for each in gathered.values())


def gather(gathered: Gathered, image: str, problems: Iterable[Problem]) -> None:
    """Add the problems of an image, grouped with those that differ only in numbers."""
    for problem in problems:
        alike = masked_text(problem.what), problem.next_step
        gathered.setdefault(alike, (problem, []))[1].append(image)


def named_problem(problem: Problem, images: list[str]) -> Problem:
    """Problem of the first image, with the names of all."""
    has_numbers = len(images) > 1 and masked_text(problem.what) != problem.what
    of_first = " The numbers are those of the first." if has_numbers else ""
    return replace(problem, what=f"{listed(images)}: {problem.what}{of_first}", images=tuple(images))


def images_by_sentence(shots: list[Frame], evidence: Callable[[Frame], Iterable[str]]) -> dict[str, list[str]]:
    """Names of frames by the sentences of evidence."""
    images: dict[str, list[str]] = {}
    for frame in shots:
        for sentence in evidence(frame):
            images.setdefault(sentence, []).append(frame.image)
    return images


def _assumed_pose(frame: Frame) -> Iterator[Problem]:
    pose = frame.scan.frame.pose if frame.scan else None
    if not pose or pose.decided:
        return
    if pose.roll:
        yield Problem(f"pose assumed: {pose.roll}.", _ONE_ANSWER)
    else:
        yield Problem(
            f"pose assumed ({pose.name}). {capitalised(' '.join(pose.evidence))}",
            'If the scan was laid on the scanner otherwise, set pose = "90", "180", "270" or with "m" under [measure].',
        )


def _measurement_problems(frame: Frame) -> Iterator[Problem]:
    measured = frame.scan.frame if frame.scan else None
    pose = measured.pose if measured else None
    evidence = pose.evidence if pose and not pose.decided else ()
    for problem in measured.problems if measured else ():
        if problem not in evidence:
            yield Problem(drop_file_name(problem, frame.scan.scan) if frame.scan else problem)
    lost = [mark for mark in frame.marks if mark.is_fiducial and mark.is_open]
    found = sum(mark.is_fiducial and mark.status.is_observation for mark in frame.marks)
    if lost and (found or pose):  # otherwise the frame was not found, which is a problem of its own
        yield Problem(
            f"{counted(len(lost), 'fiducial mark')} not measured, {found} measured. Reasons: {_reasons(lost)}.",
            "Settle them with `reseau review`."
            + (" The frame is used; its film transformation is less precise." if found else ""),
            marks=tuple((frame.image, mark.kind, mark.point) for mark in lost),
        )
    targets = [mark for mark in frame.marks if not mark.is_fiducial]
    is_lost = frame.scan is not None and frame.scan.failure is not None
    is_copy = measured is not None and any(Code.COPY in problem.codes for problem in measured.problems)
    if targets and not is_lost and not is_copy and not any(mark.status.is_observation for mark in targets):
        yield Problem(
            f"none of its {len(targets)} targets was measured.",
            "Look at their reasons in comparator.csv: a wrong pose, diameter or orientation misses them all.",
        )


def _reasons(lost: list[Mark]) -> str:
    """Statuses and reasons of marks; reasons that differ only in numbers are merged, with the numbers of the first."""
    alike: dict[str, list[Mark]] = {}
    for mark in lost:
        alike.setdefault(f"{mark.status}: {masked_text(mark.reason)}", []).append(mark)
    return "; ".join(_lost_marks(marks) for marks in list(alike.values())[:LISTED])


def _lost_marks(marks: list[Mark]) -> str:
    first, names = marks[0], listed([mark.point for mark in marks])
    like = f", such as {first.point}" if len({mark.reason for mark in marks}) > 1 else ""
    return f"{names} {first.status}{like}: {first.reason.rstrip('.')}"


def pixel_locking(places_px: Mapping[str, Array]) -> Iterator[Problem]:
    """Yield problems of pixel locking. places_px: distinct positions of the marks by axis, see
    `fractions.places_px`."""
    for axis, positions in places_px.items():
        test = fraction_test(positions)
        if test.is_locked:
            yield Problem(
                f"The {axis} positions of the marks prefer parts of a pixel (pixel locking): they are biased by up to "
                f"{fixed(test.bias_px)} px.",
                "Scan with a finer pitch or in 16 bit.",
                section="fractions",
            )
