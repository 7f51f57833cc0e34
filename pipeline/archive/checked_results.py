"""Results after the cross-scan checks: stored beside the raw ones, and read by later stages; they can be rebuilt.

The results of one run of the checks (a judging) are stored completely under a digest, which comparator.csv also names:
database and file can be matched even if the process was ended in between. The earlier judging is dropped once the files
that name the new one are in place.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from measure.flags import Code, Reason, Status
from measure.results import FrameMeasurement
from pipeline.archive import schema
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.verdicts import Verdict, scan_doubt, scan_verdict
from pipeline.errors import InputError
from pipeline.provenance import fingerprint, hash_file
from pipeline.results.comparator_file import KINDS, CameraPerson, ComparatorPoint, read_measurement_hash
from pipeline.results.measured_record import (
    Failure,
    FailureCode,
    MeasuredScan,
    mark_row,
    read_scan,
    scan_detail,
    scan_location,
)
from pipeline.text.files import FilePath

_AT_A_TIME = 500  # frames per transaction
_WRITTEN = "comparator.csv"
_UNFINISHED = "digest like 'unfinished%'"  # its process was ended before the check run was complete


@dataclass(frozen=True)
class CheckRun:
    """One run of the cross-scan checks, in an open results database.

    Attributes
    ----------
    digest : SHA-256 of its whole content.
    made_from : {name: fingerprint} of its inputs, as from `measured_from`.
    input : SHA-256 of the results that were checked.
    """

    database: ResultsDatabase
    row: int
    digest: str
    made_from: Mapping[str, str]
    input: str

    def check(self) -> None:
        """Raise DamagedError where the list of frames is damaged."""
        schema.verify_check_run(self.database.connection, self.row, self.database.path)

    def values(self, columns: str) -> list[tuple[Any, ...]]:
        """Columns of checked_frame, for all frames."""
        query = f"select {columns} from checked_frame where judging = ?"
        return self.database.connection.execute(query, (self.row,)).fetchall()

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of all frames."""
        return frozenset(name for (name,) in self.values("name"))

    def pitches_um(self) -> dict[str, tuple[float, float]]:
        """{image: pixel pitch across and down}; NaN where it is unknown."""
        unknown = (math.nan, math.nan)
        rows = self.values("name, pitch_x_um, pitch_y_um")
        return {name: unknown if across is None else (across, down) for name, across, down in rows}

    def sizes_mm(self) -> dict[str, tuple[float, float]]:
        """{image: width and height of the scan}; scans of unknown pitch are left out."""
        rows = self.values("name, width_px * pitch_x_um / 1000.0, height_px * pitch_y_um / 1000.0")
        return {name: (width, height) for name, width, height in rows if width and height}

    def decisions(self) -> dict[CameraPerson, int]:
        """Number of decisions, by camera and person."""
        counts = Counter[CameraPerson]()
        for camera, counts_json in self.values("camera, changed ->> '$.decided_by'"):
            counts.update({(camera, who): count for who, count in json.loads(counts_json or "{}").items()})
        return dict(sorted(counts.items()))

    def fingerprints(self, images: Collection[str]) -> dict[str, str]:
        """{image: fingerprint of its result}, for those of some images that it holds."""
        return {name: key for name, key in self.values("name, fingerprint") if name in images}

    def written_scans(self) -> Iterator[MeasuredScan]:
        """Scans on which writing was found."""
        written = self.database.results_with_writing()
        return self.scans({name for name, result in self.values("name, result") if result in written})

    def scans(self, images: Collection[str] | None = None) -> Iterator[MeasuredScan]:
        """Yield every scan after the checks, sorted by name; a damaged one as a failure.

        images: only these; None for all. Raises DamagedError where the list of frames is damaged.
        """
        folder = self.database.project_folder
        for name, (uri, measured, changed), rows in self._frames("uri, measured, changed", images):
            try:
                if rows is None:
                    raise ValueError
                detail = json.loads(measured) | json.loads(changed or "{}")
                yield read_scan(name, detail, rows, scan_location(uri, folder))
            except (ValueError, TypeError, KeyError):
                sentence = str(schema.damaged_result(name, self.database.path))
                frame = FrameMeasurement(name, (), problems=(Reason(sentence, Code.FAILED_SCAN),))
                yield MeasuredScan.failed("", frame, Failure(FailureCode.DAMAGED, sentence))

    def points(self, images: Collection[str] | None = None) -> Iterator[ComparatorPoint]:
        """Yield the marks of every frame after the checks as in comparator.csv, sorted by frame name.

        images: only these; None for all. Raises DamagedError where a frame is damaged.
        """
        for name, (across_um, down_um), rows in self._frames("pitch_x_um, pitch_y_um", images):
            if rows is None:
                raise schema.damaged_result(name, self.database.path)
            for point, kind, col, row, *spread, causes, status, _, reason, _ in rows:
                xy_mm = sigma_mm = None
                rho = 0.0
                if col is not None:
                    xy_mm = np.array([col * across_um, -row * down_um]) / 1000.0
                if (px2 := _covariance(spread, causes)) is not None:
                    sigma_mm = np.sqrt(px2[:2]) * (across_um, down_um) / 1000.0
                    rho = -px2[2] / math.sqrt(px2[0] * px2[1])
                yield ComparatorPoint(name, point, KINDS[kind], xy_mm, sigma_mm, rho, Status(status), reason)

    def _frames(
        self, columns: str, images: Collection[str] | None
    ) -> Iterator[tuple[str, Sequence[Any], list[Sequence[Any]] | None]]:
        """Yield name, columns of checked_frame and marks, None where these or the frame are damaged."""
        if images is None:
            self.check()
        names = self.names if images is None else self.names.intersection(images)
        connection, own = self.database.connection, "where judging = ? and scan = ?"
        frames = connection.execute("select name, scan from judged_frame where judging = ? order by name", (self.row,))
        for name, scan in [frame for frame in frames if frame[0] in names]:
            query = f"select is_whole, {columns} from checked_frame {own}"
            is_whole, *values = connection.execute(query, (self.row, scan)).fetchone()
            marks = connection.execute(
                f"select {schema.MARKS} from checked_mark {own} order by number", (self.row, scan)
            )
            yield name, values, [row[1:] for row in marks] if is_whole else None

    @cached_property
    def plain(self) -> tuple[tuple[str, str, int], ...]:
        """Image, scan's file and row of the result of the frames that are reported only in totals: good ones in which,
        of their targets, tie points and joins, at least one each is observed."""
        rows = self.database.connection.execute(_PLAIN, (self.row, str(Verdict.GOOD)))
        return tuple((name, uri, result) for name, uri, result in rows)

    def plain_marks(self) -> Iterator[tuple[int, str, str, float | None, float | None]]:
        """Row of the result, kind, status, column and row of each mark of the plain frames."""
        plain = {result for _, _, result in self.plain}
        query = "select result, kind, status, col_px, row_px from checked_mark where judging = ? and verdict = ?"
        marks = self.database.connection.execute(query, (self.row, str(Verdict.GOOD)))
        return (mark for mark in marks if mark[0] in plain)

    def remember_written(self, comparator: Path) -> None:
        """Record that the file now holds the marks."""
        self.database.remember(_WRITTEN, self._file_state(comparator))

    def is_written(self, comparator: Path) -> bool:
        """Whether the file holds the marks and has not been changed since."""
        return self.database.recall(_WRITTEN) == self._file_state(comparator)

    def _file_state(self, comparator: Path) -> dict[str, str]:
        return {"digest": self.digest, "file": hash_file(comparator) if comparator.exists() else ""}

    def drop_others(self) -> None:
        """Delete all other check runs."""
        with self.database.writing():
            self.database.connection.execute("delete from judging where digest <> ?", (self.digest,))

    def store_second_pass(self, scans: Sequence[MeasuredScan], settings: object) -> "CheckRun":
        """Store a check run of the same results after a second pass, which a later `measure` keeps. settings: of the
        adjustment."""
        self.check()
        rows = {name: known for name, *known in self.values("name, result, decisions")}
        frames = (
            CheckedResult(result, scan, decisions)
            for scan in sorted(scans, key=lambda scan: scan.frame.image)
            for result, decisions in [rows[scan.frame.image]]
        )
        _, _, first = self.input.rpartition(" ")
        return store_checks(self.database, self.made_from, second_pass_input(first, settings), frames)


def second_pass_input(input_hash: str, settings: object) -> str:
    """Input of a check run after a second pass. input_hash: before it."""
    return f"second pass {fingerprint(settings)} {input_hash}"


_PLAIN = """
select name, uri, result from checked_frame where judging = ?1 and verdict = ?2 and result not in (
    select result from checked_mark where judging = ?1 and kind <> 'fiducial'
    group by result, kind having not sum(status in ('measured', 'weak'))
) order by name
"""


def _covariance(spread: Sequence[float | None], causes: str | None) -> Sequence[float] | None:
    """(col², row², col·row) elements of the covariance."""
    # Values that are not finite are stored only in the JSON of the causes.
    finite = [value for value in spread if value is not None]
    if len(finite) == len(spread) or causes is None:
        return finite or None
    (first, second), (_, third) = json.loads(causes)["sum"]
    return float(first), float(third), float(second)


@dataclass(frozen=True)
class CheckedResult:
    """A scan after the cross-scan checks.

    result: row of the raw result; decisions: hash of the review decisions about the image that were considered.
    """

    result: int
    scan: MeasuredScan
    decisions: str = ""


@dataclass(frozen=True)
class Lot:
    """Frames that are checked against each other and no others.

    Attributes
    ----------
    input : SHA-256 of all inputs of the checks; "" if unknown.
    frames : function that runs the checks when their result is needed.
    """

    input: str
    frames: Callable[[], Iterable[CheckedResult]]


def store_checks(
    database: ResultsDatabase, made_from: Mapping[str, str], input_hash: str, frames: Iterable[CheckedResult]
) -> CheckRun:
    """Store a check run of a single lot, without reuse of earlier check runs; see `store_lots`."""
    return store_lots(database, made_from, input_hash, [Lot("", lambda: frames)])


def store_lots(
    database: ResultsDatabase, made_from: Mapping[str, str], input_hash: str, lots: Iterable[Lot]
) -> CheckRun:
    """Store a check run of all frames, completely or not at all, and return it.

    A lot whose input is unchanged is copied from an earlier check run. Of each frame only differences from the raw
    result are stored.
    """
    made = dict(made_from)
    hasher = hashlib.sha256(json.dumps([made, input_hash], sort_keys=True).encode())
    begun = {"digest": f"unfinished {input_hash}", "made_from": json.dumps(made), "input": input_hash}
    with database.writing():
        database.connection.execute(f"delete from judging where {_UNFINISHED}")
        row = database.insert("judging", begun)
    for number, lot in enumerate(lots):
        output = _copy_lot(database, row, number, lot) or _write_lot(database, row, number, lot.frames())
        hasher.update(output.encode())
        with database.writing():
            database.insert("judged_lot", {"judging": row, "lot": number, "input": lot.input, "output": output})
    digest = hasher.hexdigest()
    with database.writing():
        database.connection.execute("delete from judging where digest = ?", (digest,))
        update = f"update judging set digest = ?, frames_digest = {schema.FRAMES_DIGEST} where id = ?"
        database.connection.execute(update, (digest, row))
    return CheckRun(database, row, digest, made, input_hash)


def _copy_lot(database: ResultsDatabase, check_run: int, number: int, lot: Lot) -> str:
    """Copy a sound lot from a check run with the same input and return the hash of its content; "" if there is none."""
    own = "from judged_frame where judging = ? and lot = ?"
    found = database.connection.execute(
        "select judging, lot, output from judged_lot join judging on judging.id = judging "
        f"where judged_lot.input = ? and not {_UNFINISHED} order by judging desc limit 1",
        (lot.input,),
    ).fetchone()
    if not lot.input or found is None:
        return ""
    before, old, output = found
    is_whole = (
        f"{schema.is_sound('judged_frame')} and (not own_marks or marks_digest is {schema.checked_marks_digest()})"
    )
    if database.first(f"select exists (select 1 {own} and not ({is_whole}))", before, old):
        return ""
    frame = "scan, result, name, verdict, why, own_marks, detail, decisions, marks_digest"
    with database.writing():
        database.connection.execute(
            f"insert into judged_frame (judging, lot, {frame}) select ?, ?, {frame} {own}",
            (check_run, number, before, old),
        )
        database.connection.execute(
            f"insert into judged (judging, result, {schema.MARKS}) select ?, result, {schema.MARKS} "
            f"from judged where judging = ? and result in (select result {own} and own_marks)",
            (check_run, before, before, old),
        )
    return str(output)


def _write_lot(database: ResultsDatabase, check_run: int, number: int, frames: Iterable[CheckedResult]) -> str:
    """Check the frames of a lot, store them, and return the hash of the content."""
    hasher, left = hashlib.sha256(), iter(frames)
    while some := list(islice(left, _AT_A_TIME)):  # no open transaction here: the checks may measure and store scans
        with database.writing():
            for frame in some:
                hasher.update(_write_frame(database, check_run, number, frame))
    return hasher.hexdigest()


def _write_frame(database: ResultsDatabase, check_run: int, lot: int, frame: CheckedResult) -> bytes:
    """Store the differences of a checked frame from its raw result, and return the stored content for hashing."""
    measured = json.loads(database.detail(frame.result))
    now = scan_detail(frame.scan, measured["scan"])
    changed = {key: value for key, value in now.items() if value != measured.get(key)}
    detail = json.dumps(changed, ensure_ascii=False) if changed else None
    rows = [mark_row(mark) for mark in frame.scan.frame.marks]
    own_marks = rows != database.mark_rows(frame.result)
    rows = rows if own_marks else []
    scan, key = database.connection.execute(
        "select scan, fingerprint from result where id = ?", (frame.result,)
    ).fetchone()
    keys = {"judging": check_run, "result": frame.result}
    checked = {"lot": lot, "scan": scan, "name": frame.scan.frame.image, "decisions": frame.decisions}
    checked |= {"verdict": str(scan_verdict(frame.scan)), "why": scan_doubt(frame.scan)}
    database.insert("judged_frame", keys | checked | {"own_marks": own_marks, "detail": detail})
    database.insert_marks("judged", keys, rows)
    database.connection.execute(
        f"update judged_frame set marks_digest = {schema.checked_marks_digest()} where judging = ? and scan = ?",
        (check_run, scan),
    )
    return json.dumps([frame.scan.frame.image, key, detail, rows]).encode()


def find_check_run(database: ResultsDatabase, digest: str) -> CheckRun | None:
    """Check run with that digest, None if there is none. Raises DamagedError where its row is damaged."""
    query = f"select {schema.is_sound('judging')}, id, digest, made_from, input from judging where digest = ?"
    found = database.connection.execute(query, (digest,)).fetchone()
    if found is None:
        return None
    is_whole, row, digest, made_from, input_hash = found
    if not is_whole:
        raise schema.damaged_check_run(database.path)
    return CheckRun(database, row, digest, json.loads(made_from), input_hash)


def latest(database: ResultsDatabase) -> CheckRun | None:
    """Latest check run, None if there is none. Raises DamagedError where one is missing or damaged."""
    is_lost = database.first(
        f"select exists (select 1 from judging where seal is not null and not {schema.is_sound('judging')}) or "
        "exists (select 1 from judged_frame where judging not in (select id from judging))"
    )
    digest = database.first(f"select digest from judging where not {_UNFINISHED} order by id desc limit 1")
    check_run = None if is_lost or digest is None else find_check_run(database, digest)
    if is_lost or (check_run is None and digest is not None):  # the index of digests used for the lookup lacks the row
        raise schema.damaged_check_run(database.path)
    return check_run


@contextmanager
def stored_check_run(path: Path, digest: str) -> Iterator[CheckRun | None]:
    """Check run with that digest in a database; None where there is no such database or check run."""
    if not digest or not path.exists():
        yield None
        return
    with ResultsDatabase(path) as database:
        yield find_check_run(database, digest)


@contextmanager
def written_check_run(path: Path, comparator: Path) -> Iterator[CheckRun | None]:
    """Check run from which comparator.csv was written; None where the file holds other marks, or either was changed
    since."""
    with stored_check_run(path, read_measurement_hash(comparator) if comparator.exists() else "") as check_run:
        if check_run is None or not check_run.is_written(comparator):
            yield None
            return
        check_run.check()
        yield None if schema.damaged_frames(check_run.database.connection, check_run.row) else check_run


def read_measurement(path: FilePath, digest: str = "") -> tuple[MeasuredScan, ...]:
    """Scans of a database after the cross-scan checks, sorted by name. digest: of the check run; "" for the latest.

    Raises InputError where there is no such database, or no check run in it.
    """
    return tuple(measured_scans(Path(path), digest))


def measured_scans(path: Path, digest: str = "", images: Collection[str] | None = None) -> Iterator[MeasuredScan]:
    """Yield the scans of a database one by one; see `read_measurement`. images: only these; None for all."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file. Run `reseau measure` first.")
    with ResultsDatabase(path) as database:
        check_run = find_check_run(database, digest) if digest else latest(database)
        if check_run is None:
            raise InputError(
                f"{path}: its scans have not passed the cross-scan checks. Run `reseau measure`, which continues."
            )
        yield from check_run.scans(images)
