"""Problems of the measurement of frames that need a look before any adjustment, and the test for pixel locking."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtrik, chdtrc

from measure.flags import Code, Status
from pipeline.archive.verdicts import NEXT_STEP
from pipeline.drawing import svg
from pipeline.report.data import Mark, ReportedFrame, ReportedProblem
from pipeline.report.numbers import fixed
from pipeline.text.wording import LISTED, capitalised, counted, drop_file_name, listed
from pipeline.types import Array

BINS = 10
LEAST_MARKS = 50  # five per bin; with fewer the chi-square test is invalid
LEAST_PROBABILITY = 1e-4  # significance level; low, as target grids nearly parallel to the pixels are uneven
LEAST_BIAS_PX = 0.01  # px; with very many marks even a negligible bias is significant
SAME_PLACE_PX = 0.5  # px; randomly placed marks rarely share a column or row this closely

_POINTS = {"target": "targets", "tie": "tie points", "join": "joins with other parts"}
_NUMBER = re.compile(r"\d+(\.\d+)?")

_ONE_ANSWER = (
    "One line in the camera file settles all: at which side of the frame the camera writes, as "
    'writing = ["left: reads upward"].'
)


@dataclass
class AlikeProblems:
    """Problems that differ only in numbers: the first, the images of all, and whether the numbers differ."""

    first: ReportedProblem
    images: list[str]
    differ: bool = False

    def merged_problem(self) -> ReportedProblem:
        """The first problem, with the names of all images."""
        numbers = f" (numbers of {self.images[0]})" if self.differ else ""
        return replace(self.first, what=f"{listed(self.images)}{numbers}: {self.first.what}", images=tuple(self.images))


Gathered = dict[tuple[str, str], AlikeProblems]  # by masked text and remedy


@dataclass(frozen=True)
class FractionTest:
    """Chi-square test for uniform fractional parts.

    Attributes
    ----------
    counts : (BINS,) of the fractional parts over [-0.5, 0.5) px around the pixel centre.
    probability : p-value; None if there are too few marks.
    bias_px : amplitude of a sinusoidal bias that would cause the counts. Positions f shifted to f + b sin(2 pi f) have,
        to first order, the density 1 - 2 pi b cos(2 pi f), so that b follows from the first harmonic.
    """

    counts: NDArray[np.int64]
    probability: float | None
    bias_px: float

    @property
    def is_locked(self) -> bool:
        """Whether pixel locking is significant and not negligible."""
        return self.probability is not None and self.probability < LEAST_PROBABILITY and self.bias_px > LEAST_BIAS_PX


def places_px(shots: Iterable[ReportedFrame]) -> dict[str, Array]:
    """Distinct columns and rows (n,) of the observed marks.

    Equal positions count once: a mark that recurs in every frame, or a grid line parallel to the pixels, has only one
    independent fractional part.
    """
    return places_apart([center for frame in shots for center in centers_px(frame)])


def centers_px(frame: ReportedFrame) -> Iterator[Array]:
    """Yield the centres (2,) of the observed marks of a frame."""
    for mark in frame.marks:
        if mark.status.is_observation and mark.center_px is not None:
            yield mark.center_px


def places_apart(centers: ArrayLike) -> dict[str, Array]:
    """Distinct columns and rows of centres (n, 2); see `places_px`."""
    columns, rows = np.asarray(centers, dtype=np.float64).reshape(-1, 2).T
    return {"column": _distinct_positions(columns), "row": _distinct_positions(rows)}


def _distinct_positions(positions_px: Array) -> Array:
    """Positions, sorted, without those within SAME_PLACE_PX of the last one kept."""
    kept: list[float] = []
    for position in np.sort(positions_px).tolist():
        if not kept or position - kept[-1] > SAME_PLACE_PX:
            kept.append(position)
    return np.array(kept)


def fraction_test(position_px: Array) -> FractionTest:
    """Test one coordinate (n,) of measured positions for uniform fractional parts."""
    fractions = position_px - np.floor(position_px + 0.5)
    counts, _ = np.histogram(fractions, bins=BINS, range=(-0.5, 0.5))
    if len(position_px) < LEAST_MARKS:
        return FractionTest(counts, None, 0.0)
    harmonic = 2.0 * np.abs(np.mean(np.exp(2j * np.pi * fractions)))
    chi_square = np.sum((counts - counts.mean()) ** 2) / counts.mean()
    return FractionTest(counts, float(chdtrc(BINS - 1, chi_square)), float(harmonic / (2.0 * np.pi)))


def fraction_plot(axis: str, test: FractionTest) -> Markup:
    """Plot the histogram over the pixel with the 99 % interval of the counts without pixel locking (binomial
    distribution)."""
    total = int(test.counts.sum())
    low, high = np.ceil(bdtrik((0.005, 0.995), total, 1.0 / BINS)).tolist() if total else (0.0, 0.0)
    axes = svg.Axes((-0.5, 0.5), (0.0, 1.15 * max(float(test.counts.max()), high, 1.0)), width=330.0, height=220.0)
    edges = np.linspace(-0.5, 0.5, BINS + 1)
    bars = [
        svg.tag(
            "rect",
            svg.tag("title", f"{count} of {total}"),
            x=float(axes.x(left)) + 1.0,
            y=float(axes.y(count)),
            width=float(axes.x(right) - axes.x(left)) - 2.0,
            height=float(axes.y(0.0) - axes.y(count)),
            class_="column",
        )
        for left, right, count in zip(edges[:-1], edges[1:], test.counts.tolist(), strict=True)
    ]
    band = svg.tag(
        "rect",
        x=axes.left,
        y=float(axes.y(high)),
        width=axes.width - axes.left - axes.right,
        height=float(axes.y(low) - axes.y(high)),
        class_="expected",
    )
    label = f"{axis} position less the pixel's centre (px)"
    title = f"Histogram of the fractional parts of the {axis} positions"
    return svg.picture(axes.width, axes.height, title, *bars, band, axes.grid(label, "marks"))


def single_frame_problems(frame: ReportedFrame) -> Iterator[ReportedProblem]:
    """Yield the problems of one frame, an undetermined scan orientation (pose) first."""
    yield from _assumed_pose(frame)
    yield from _other_problems(frame)


def masked_text(sentence: str) -> str:
    """Mask the numbers of a sentence, to group sentences that differ only in numbers."""
    return _NUMBER.sub("#", sentence)


def frame_problems(shots: list[ReportedFrame]) -> Iterator[ReportedProblem]:
    """Yield the problems of all frames, scan orientations (poses) first. Problems that differ only in numbers are
    merged."""
    for evidence in (_assumed_pose, _other_problems):
        gathered: Gathered = {}
        for frame in shots:
            gather(gathered, frame.image, evidence(frame))
        yield from (each.merged_problem() for each in gathered.values())


def gather(gathered: Gathered, image: str, problems: Iterable[ReportedProblem]) -> None:
    """Add the problems of an image, grouped with those that differ only in numbers."""
    for problem in problems:
        alike = masked_text(problem.what), problem.next_step
        known = gathered.setdefault(alike, AlikeProblems(problem, []))
        known.images.append(image)
        known.differ |= problem.what != known.first.what


def _assumed_pose(frame: ReportedFrame) -> Iterator[ReportedProblem]:
    pose = frame.scan.frame.pose if frame.scan else None
    if not pose or pose.decided:
        return
    if pose.roll:
        yield ReportedProblem(f"pose assumed: {pose.roll}.", _ONE_ANSWER)
    else:
        yield ReportedProblem(
            f"pose assumed ({pose.name}). {' '.join(map(capitalised, pose.evidence))}",
            'If the scan was laid on the scanner otherwise, set scan_orientation = "90", "180", "270" or with "m" '
            "under [measure].",
        )


def _other_problems(frame: ReportedFrame) -> Iterator[ReportedProblem]:
    """Yield problems but for an assumed pose: at least one where the verdict on the scan asks for a look."""
    problems = list(_measurement_problems(frame))
    if problems or any(_assumed_pose(frame)) or frame.scan is None or not frame.verdict.needs_review:
        yield from problems
    else:
        yield ReportedProblem(frame.verdict.meaning, NEXT_STEP[frame.verdict])


def _measurement_problems(frame: ReportedFrame) -> Iterator[ReportedProblem]:
    pose, problems = (frame.scan.frame.pose, frame.scan.frame.problems) if frame.scan else (None, ())
    evidence = pose.evidence if pose and not pose.decided else ()
    for problem in problems:
        if problem not in evidence:
            yield ReportedProblem(drop_file_name(problem, frame.scan.scan) if frame.scan else problem)
    doubtful = [mark for mark in frame.marks if mark.needs_review]
    lost, weak = ([mark for mark in doubtful if mark.status.is_observation is is_used] for is_used in (False, True))
    statuses = Counter(mark.status for mark in frame.marks if mark.is_fiducial)
    found = ", ".join(f"{statuses[each]} {each}" for each in (Status.MEASURED, Status.WEAK) if statuses[each])
    if lost and (found or pose):  # otherwise the frame was not found, which is a problem of its own
        yield ReportedProblem(
            f"{counted(len(lost), 'fiducial mark')} not measured, {found or 'none measured'}. "
            f"Reasons: {_reasons(lost)}.",
            "Settle them with `reseau review`."
            + (" The frame is used; its film transformation is less precise." if found else ""),
            marks=tuple((frame.image, mark.kind, mark.point) for mark in lost),
        )
    if weak:
        yield ReportedProblem(
            f"{counted(len(weak), 'weak fiducial mark')}. Reasons: {_reasons(weak)}.",
            "Settle them with `reseau review`, or leave them: they count with the larger standard deviations given.",
            marks=tuple((frame.image, mark.kind, mark.point) for mark in weak),
        )
    is_lost = frame.scan is not None and frame.scan.failure is not None
    is_explained = any({Code.COPY, Code.NO_BOARD} & {*problem.codes} for problem in problems)
    for kind, words in _POINTS.items():
        points = [mark for mark in frame.marks if mark.kind == kind]
        if points and not is_lost and not is_explained and not any(mark.status.is_observation for mark in points):
            yield ReportedProblem(
                f"none of its {len(points)} {words} was measured.",
                "Look at their reasons in comparator.csv: a wrong orientation, scan orientation or diameter misses "
                "all.",
            )


def _reasons(lost: list[Mark]) -> str:
    """Statuses and reasons of marks; reasons that differ only in numbers are merged, with the numbers of the first."""
    alike: dict[str, list[Mark]] = {}
    for mark in lost:
        alike.setdefault(f"{mark.status}: {masked_text(mark.reason)}", []).append(mark)
    sentences = []
    for first, *others in list(alike.values())[:LISTED]:
        like = f", such as {first.point}" if any(mark.reason != first.reason for mark in others) else ""
        names = listed([mark.point for mark in (first, *others)])
        sentences.append(f"{names} {first.status}{like}: {first.reason.rstrip('.')}")
    return "; ".join(sentences)


def pixel_locking(places_px: Mapping[str, Array]) -> Iterator[ReportedProblem]:
    """Yield problems of pixel locking. places_px: distinct positions of the marks by axis, see
    `frame_problems.places_px`."""
    for axis, positions in places_px.items():
        test = fraction_test(positions)
        if test.is_locked:
            yield ReportedProblem(
                f"The {axis} positions of the marks prefer parts of a pixel (pixel locking): they are biased by up to "
                f"{fixed(test.bias_px)} px.",
                "Scan with a finer pitch or in 16 bit.",
                section="fractions",
            )
