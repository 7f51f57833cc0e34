"""The marks of a judging read by parts: those of a few frames whole, of all others only what totals are made of."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.archive.digests import check_judging, damaged_frames
from pipeline.archive.judging import Judging, judged_marks, judging_of, marks_as_written
from pipeline.archive.measurement import measured_scans, pitches
from pipeline.archive.store import Store
from pipeline.archive.verdicts import Verdict
from pipeline.results.comparator_file import ComparatorPoint, comparator_points, measurement_of
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]

_AT_A_TIME = 50_000  # rows


@dataclass(frozen=True, eq=False)
class MarkColumns:
    """Marks of frames, one a row: frame, the place of its frame among so many; kind and status as numbers of the names
    that there are of each; center_px (n, 2), sigma_um (n, 2), NaN where there is none."""

    frame: NDArray[np.int64]
    kind: NDArray[np.int64]
    status: NDArray[np.int64]
    center_px: Array
    sigma_um: Array
    kinds: tuple[str, ...]
    statuses: tuple[str, ...]


@dataclass(frozen=True)
class StoredFrame:
    """A frame that needs no look: its name, and its scan's file."""

    image: str
    scan: str
    result: int


class StoredMarks:
    """The marks of comparator.csv, which stands as it was written from the store."""

    def __init__(self, path: Path, judging: Judging) -> None:
        self._path, self._judging = path, judging

    @classmethod
    def of(cls, path: Path, comparator: Path) -> "StoredMarks | None":
        """path: of the store. None where the file has other marks than the store, or somebody has changed either."""
        if not path.exists() or not comparator.exists() or not (digest := measurement_of(comparator)):
            return None
        with Store(path) as store:
            judging = judging_of(store, digest)
            is_written = judging is not None and marks_as_written(store, digest, comparator)
            if judging is not None and is_written:
                check_judging(store.connection, judging.row, path)
                is_written = not damaged_frames(store.connection, judging.row)
        return cls(path, judging) if judging is not None and is_written else None

    @cached_property
    def names(self) -> frozenset[str]:
        """Of all frames."""
        with Store(self._path) as store:
            query = "select name from judged_frame where judging = ?"
            return frozenset(name for (name,) in store.connection.execute(query, (self._judging.row,)))

    def rows(self, images: Collection[str]) -> list[ComparatorPoint]:
        """The marks of some images as comparator.csv has them."""
        with Store(self._path) as store:
            marks = judged_marks(store, self._judging, images)
            return list(comparator_points(marks, pitches(store, self._judging.digest)))

    def scans(self, images: Collection[str]) -> Iterator[MeasuredScan]:
        return measured_scans(self._path, self._judging.digest, images)

    @cached_property
    def plain(self) -> tuple[StoredFrame, ...]:
        """The frames of which nothing but totals is told: good ones, of whose targets, if any, one was measured."""
        with Store(self._path) as store:
            rows = store.connection.execute(_PLAIN, (self._judging.row, str(Verdict.GOOD)))
            return tuple(StoredFrame(*row) for row in rows)

    def columns(self) -> MarkColumns:
        """Of the marks of the plain frames."""
        place = {frame.result: number for number, frame in enumerate(self.plain)}
        kinds, statuses = dict[str, int](), dict[str, int]()
        parts: list[Array] = [np.empty((0, 7))]
        with Store(self._path) as store:
            found = store.connection.execute(_MARKS, {"judging": self._judging.row, "good": str(Verdict.GOOD)})
            while rows := found.fetchmany(_AT_A_TIME):
                numbers = [
                    (place[result], kinds.setdefault(kind, len(kinds)), statuses.setdefault(status, len(statuses)), *px)
                    for result, kind, status, *px in rows
                    if result in place
                ]
                parts.append(np.array(numbers, dtype=np.float64).reshape(-1, 7))
        every = np.concatenate(parts)
        frame, kind, status = every[:, :3].T.astype(np.int64)
        return MarkColumns(frame, kind, status, every[:, 3:5], every[:, 5:7], tuple(kinds), tuple(statuses))


_PLAIN = """
with lost as (
    select f.result from judged_frame f join mark m on m.result = f.result
    where f.judging = ?1 and not f.own_marks and m.kind <> 'fiducial'
    group by f.result having not sum(m.status in ('measured', 'weak'))
    union all
    select f.result from judged_frame f join judged m on m.judging = f.judging and m.result = f.result
    where f.judging = ?1 and f.own_marks and m.kind <> 'fiducial'
    group by f.result having not sum(m.status in ('measured', 'weak'))
)
select f.name, scan.uri, f.result from judged_frame f join scan on scan.id = f.scan
where f.judging = ?1 and f.verdict = ?2 and f.result not in (select result from lost) order by f.name
"""
_MARKS = """
with frame as (
    select f.result, f.judging, f.own_marks, r.pitch_x_um as px, r.pitch_y_um as py
    from judged_frame f join result r on r.id = f.result where f.judging = :judging and f.verdict = :good
)
select m.result, kind, status, col_px, row_px, sqrt(var_col) * px, sqrt(var_row) * py
from frame join mark m on m.result = frame.result where not own_marks
union all
select m.result, kind, status, col_px, row_px, sqrt(var_col) * px, sqrt(var_row) * py
from frame join judged m on m.judging = frame.judging and m.result = frame.result where own_marks
"""
