"""Reports of many frames: totals of all, and the frames that need a look."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import nsmallest
from operator import itemgetter

import numpy as np

from measure.flags import Status
from pipeline.archive.measurement import StoredMarks
from pipeline.archive.verdicts import Verdict, frame_verdict, has_problem, scan_counts
from pipeline.report.data import Frame, FrameTotals, Problem, ReportData, frames
from pipeline.report.frame_problems import (
    Gathered,
    centers_px,
    gather,
    places_apart,
    single_frame_problems,
)
from pipeline.report.frame_views import residuals_by_image
from pipeline.report.verdict import suspect_rows
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.wording import counted

MOST_FRAMES = 200  # largest number of frames shown with their marks
_MOST_PROBLEMS = 50  # largest number of different problems listed
_ROWS = 200  # largest number of rows (camera and kind of file)
_BEST_FIRST = (Verdict.GOOD, Verdict.DECIDED, Verdict.LOOK, Verdict.POOR, Verdict.FAILED)
_OBSERVED = {str(status) for status in Status if status.is_observation}


@dataclass
class _Totals:
    """Accumulator of `FrameTotals`."""

    marks: dict[str, Counter[str]] = field(default_factory=dict)
    of_targets: Counter[tuple[str, str]] = field(default_factory=Counter)
    verdicts: dict[tuple[str, str], Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    problems: Gathered = field(default_factory=dict)
    centers_px: "array[float]" = field(default_factory=lambda: array("d"))

    def add(self, frame: Frame, kind: tuple[str, str], verdict: Verdict, problems: Iterable[Problem]) -> None:
        self.verdicts[kind][verdict] += 1
        self.marks[frame.image] = Counter(str(mark.status) for mark in frame.marks)
        self.of_targets.update((mark.kind, mark.status) for mark in frame.marks if not mark.is_fiducial)
        gather(self.problems, frame.image, problems)
        for center in centers_px(frame):
            self.centers_px.extend(center.tolist())

    def add_plain(self, stored: StoredMarks, camera_of: Callable[[str], str]) -> None:
        """Add the stored frames without problems."""
        counts = {frame.result: Counter[str]() for frame in stored.plain}
        for result, kind, status, col_px, row_px in stored.plain_marks():
            counts[result][status] += 1
            if kind != "fiducial":
                self.of_targets[kind, status] += 1
            if status in _OBSERVED and col_px is not None and row_px is not None:
                self.centers_px.extend((col_px, row_px))
        alike = dict[frozenset[tuple[str, int]], Counter[str]]()  # one object for all frames with equal counts
        for frame in stored.plain:
            self.verdicts[camera_of(frame.image), _ending(frame.scan)][Verdict.GOOD] += 1
            count = counts[frame.result]
            self.marks[frame.image] = alike.setdefault(frozenset(count.items()), count)

    def result(self) -> FrameTotals:
        return FrameTotals(
            marks=self.marks,
            of_targets=self.of_targets,
            verdicts={kind: {v: counts[v] for v in _BEST_FIRST} for kind, counts in sorted(self.verdicts.items())},
            problems=tuple(_listed(self.problems)),
            places_px=places_apart(np.array(self.centers_px)),
        )


def reduced(
    data: ReportData,
    scans: Iterable[MeasuredScan],
    camera_of: Callable[[str], str],
    stored: StoredMarks | None = None,
) -> ReportData:
    """Reduce the data to the totals of all frames and the worst of the frames that need a look.

    Parameters
    ----------
    scans : of the images in data.comparator, iterated once.
    stored : stored marks, of whose frames without problems only columns are read; data.comparator then holds all other
        frames.
    """
    totals = _Totals()
    if stored is not None:
        totals.add_plain(stored, camera_of)
    suspect = {row.image for row in suspect_rows(data.adjustment)} if data.adjustment else set[str]()

    def frames_to_show() -> Iterator[tuple[tuple[float, float], ReportData]]:
        """Count all frames; yield those that need a look with a sort key, the worst first."""
        for one in _one_by_one(data, scans):
            (frame,) = frames(one)
            verdict, problems = _verdict(frame), list(single_frame_problems(frame))
            kind = camera_of(frame.image), _ending(frame.scan.scan) if frame.scan else "given"
            totals.add(frame, kind, verdict, problems)
            if problems or verdict.needs_look or frame.image in suspect:
                largest_w = max((abs(mark.w or 0.0) for mark in frame.marks), default=0.0)
                yield (-_BEST_FIRST.index(verdict), -largest_w), one

    shown = [one for _, one in nsmallest(MOST_FRAMES, frames_to_show(), key=itemgetter(0))]
    return replace(
        data,
        comparator=[row for one in shown for row in one.comparator],
        measurement={name: scan for one in shown for name, scan in (one.measurement or {}).items()},
        totals=totals.result(),
    )


def _ending(scan: str) -> str:
    return scan.rpartition(".")[2].lower()


def _one_by_one(data: ReportData, scans: Iterable[MeasuredScan]) -> Iterator[ReportData]:
    """Yield the data of each frame separately: its rows, scan and residuals."""
    rows: dict[str, list[ComparatorPoint]] = defaultdict(list)
    for row in data.comparator:
        rows[row.image].append(row)
    residuals, others = residuals_by_image(data), data.adjustment.images if data.adjustment else {}
    shown = set[str]()

    def frame_data(image: str, scan: MeasuredScan | None) -> ReportData:
        images = {name: known for name, known in [(image, others.get(image))] if known is not None}
        rows_of = tuple(residuals.get(image, ()))
        own = replace(data.adjustment, images=images, residuals=rows_of) if data.adjustment else None
        return replace(
            data, comparator=rows.get(image, []), measurement={image: scan} if scan else {}, adjustment=own, totals=None
        )

    for scan in scans:
        if scan.frame.image in rows or not scan.frame.marks:  # others were removed from comparator.csv
            shown.add(scan.frame.image)
            yield frame_data(scan.frame.image, scan)
    for image in sorted({*rows, *others} - shown):
        yield frame_data(image, None)


def _verdict(frame: Frame) -> Verdict:
    """Verdict as in `reseau status`, for the marks currently in comparator.csv."""
    scan, marks = frame.scan, [(mark.kind, mark.status, mark.codes) for mark in frame.marks]
    if scan is None:
        return frame_verdict(marks, True, False, False)
    if scan.failure:
        return Verdict.FAILED
    return frame_verdict(marks, scan.frame.pixel_from_camera is not None, has_problem(scan), bool(scan.decided_by))


def _listed(problems: Gathered) -> Iterator[Problem]:
    """Yield problems, those of most frames first."""
    ordered = sorted(problems.values(), key=lambda each: -len(each.images))
    yield from (each.together() for each in ordered[:_MOST_PROBLEMS])
    rest = sum(len(each.images) for each in ordered[_MOST_PROBLEMS:])
    if rest:
        yield Problem(f"{counted(rest, 'more problem')} of frames, all different.", "`reseau status --csv` has them.")


def totals_view(data: ReportData, shots: Sequence[Frame]) -> Mapping[str, object] | None:
    """Totals for the template, if the report does not show all frames or only fiducials were adjusted; else None."""
    if data.totals is None and not data.is_film_alone:
        return None
    counts, total = verdict_counts(data, shots), frame_counts(data, shots)
    return {
        "sentence": f"{scan_counts(total)}.",
        "shown": len({*(data.measurement or {}), *(row.image for row in data.comparator)}) if data.totals else None,
        "verdicts": [each for each in _BEST_FIRST if total[each]],
        "rows": sorted(counts.items())[:_ROWS],
        "left_out": max(len(counts) - _ROWS, 0),
        "all": total,
    }


def frame_counts(data: ReportData, shots: Sequence[Frame]) -> Counter[Verdict]:
    """Numbers of all frames by verdict, for the report and the terminal. shots: the frames shown."""
    total = Counter[Verdict]()
    for row in verdict_counts(data, shots).values():
        total.update({Verdict(verdict): count for verdict, count in row.items()})
    return total


def verdict_counts(data: ReportData, shots: Sequence[Frame]) -> Mapping[tuple[str, str], Mapping[str, int]]:
    """Numbers of frames by (camera, kind of file) and verdict."""
    if data.totals is not None:
        return data.totals.verdicts
    stored, counts = data.adjustment, defaultdict[tuple[str, str], Counter[str]](Counter)
    for frame in shots:
        camera = stored.image_camera(frame.image) if stored and frame.image in stored.images else "none"
        kind = camera, _ending(frame.scan.scan) if frame.scan else "given"
        counts[kind][_verdict(frame)] += 1
    return counts
