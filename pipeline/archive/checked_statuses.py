"""Statuses after the cross-scan checks: stored beside the raw results; they can be rebuilt.

The results of one run of the checks (a judging) are stored completely under a digest, which comparator.csv also names:
database and file can be matched even if the process was ended in between. The earlier judging is dropped once the files
that name the new one are in place.
"""

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from measure.flags import Code, Reason
from measure.results import FrameMeasurement
from pipeline.archive.results_database import Store, places
from pipeline.archive.schema import (
    FRAMES_DIGEST,
    MARKS,
    check_judging,
    check_judgings,
    checked_marks_digest,
    damaged_judging,
    damaged_result,
    is_sound,
    row_digest,
)
from pipeline.archive.verdicts import scan_verdict
from pipeline.provenance import hash_file
from pipeline.results.comparator_file import MarkRow
from pipeline.results.measured_record import (
    Failure,
    FailureCode,
    MeasuredScan,
    mark_row,
    read_mark_row,
    read_scan,
    scan_detail,
    scan_location,
)

_AT_A_TIME = 500  # frames per transaction
_WRITTEN = "comparator.csv"
_UNFINISHED = "digest like 'unfinished%'"  # its process was ended before the judging was complete


@dataclass(frozen=True)
class Judging:
    """One run of the cross-scan checks.

    Attributes
    ----------
    digest : SHA-256 of its whole content.
    made_from : {name: fingerprint} of its inputs, as from `made_from`.
    input : SHA-256 of the results that were checked.
    """

    row: int
    digest: str
    made_from: Mapping[str, str]
    input: str


@dataclass(frozen=True)
class CheckedResult:
    """A scan after the cross-scan checks.

    Attributes
    ----------
    result : row of the raw result.
    decisions : hash of the review decisions about the image that were considered.
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


def judge(store: Store, made_from: Mapping[str, str], input_hash: str, frames: Iterable[CheckedResult]) -> str:
    """Store a judging of a single lot, without reuse of earlier judgings; see `judge_lots`."""
    return judge_lots(store, made_from, input_hash, [Lot("", lambda: frames)])


def judge_lots(store: Store, made_from: Mapping[str, str], input_hash: str, lots: Iterable[Lot]) -> str:
    """Store a judging of all frames, completely or not at all, and return its digest.

    A lot whose input is unchanged is copied from an earlier judging. Of each frame only differences from the raw result
    are stored.
    """
    hasher = hashlib.sha256(json.dumps([dict(made_from), input_hash], sort_keys=True).encode())
    db = store.connection
    with store.writing():
        db.execute(f"delete from judging where {_UNFINISHED}")
        values = (f"unfinished {input_hash}", json.dumps(dict(made_from)), input_hash)
        row = db.execute("insert into judging (digest, made_from, input) values (?, ?, ?)", values).lastrowid
        assert row is not None
    for number, lot in enumerate(lots):
        output = _copy_lot(store, row, number, lot) or _write_lot(store, row, number, lot.frames())
        hasher.update(output.encode())
        with store.writing():
            db.execute("insert into judged_lot values (?, ?, ?, ?)", (row, number, lot.input, output))
    digest = hasher.hexdigest()
    with store.writing():
        db.execute("delete from judging where digest = ?", (digest,))
        db.execute(f"update judging set digest = ?, frames_digest = {FRAMES_DIGEST} where id = ?", (digest, row))
    return digest


def _copy_lot(store: Store, judging: int, number: int, lot: Lot) -> str:
    """Copy a sound lot from a judging with the same input and return the hash of its content; "" if there is none."""
    db, of_lot = store.connection, "from judged_frame where judging = ? and lot = ?"
    found = db.execute(
        "select judging, lot, output from judged_lot join judging on judging.id = judging "
        f"where judged_lot.input = ? and not {_UNFINISHED} order by judging desc limit 1",
        (lot.input,),
    ).fetchone()
    if not lot.input or found is None:
        return ""
    before, old, output = found
    is_whole = f"{is_sound('judged_frame')} and (not own_marks or marks_digest is {checked_marks_digest()})"
    if db.execute(f"select exists (select 1 {of_lot} and not ({is_whole}))", (before, old)).fetchone()[0]:
        return ""
    frame = "scan, result, name, verdict, own_marks, detail, decisions, marks_digest"
    with store.writing():
        db.execute(
            f"insert into judged_frame (judging, lot, {frame}) select ?, ?, {frame} {of_lot}",
            (judging, number, before, old),
        )
        db.execute(
            f"insert into judged (judging, result, number, {MARKS}) select ?, result, number, {MARKS} "
            f"from judged where judging = ? and result in (select result {of_lot} and own_marks)",
            (judging, before, before, old),
        )
    return str(output)


def _write_lot(store: Store, judging: int, number: int, frames: Iterable[CheckedResult]) -> str:
    """Check the frames of a lot, store them, and return the hash of the content."""
    hasher, left = hashlib.sha256(), iter(frames)
    while some := list(islice(left, _AT_A_TIME)):  # no open transaction here: the checks may measure and store scans
        with store.writing():
            for frame in some:
                hasher.update(_write_frame(store, judging, number, frame))
    return hasher.hexdigest()


def drop_all_but(store: Store, digest: str) -> None:
    """Delete all judgings except one."""
    with store.writing():
        store.connection.execute("delete from judging where digest <> ?", (digest,))


def find_judging(store: Store, digest: str) -> Judging | None:
    """Judging with that digest, None if there is none. Raises DamagedError where its row is damaged."""
    query = f"select {is_sound('judging')}, id, digest, made_from, input from judging where digest = ?"
    found = store.connection.execute(query, (digest,)).fetchone()
    if found is None:
        return None
    is_whole, row, digest, made_from, input_hash = found
    if not is_whole:
        raise damaged_judging(store.path)
    return Judging(row, digest, json.loads(made_from), input_hash)


def rejudge(store: Store, before: Judging, scans: Sequence[MeasuredScan]) -> str:
    """Store a judging of the same results after a second pass, which a later `measure` does not repeat; return its
    digest."""
    check_judging(store.connection, before.row, store.path)
    query = "select name, result, decisions from judged_frame where judging = ?"
    rows = {name: known for name, *known in store.connection.execute(query, (before.row,))}
    frames = (
        CheckedResult(result, scan, decisions)
        for scan in sorted(scans, key=lambda scan: scan.frame.image)
        for result, decisions in [rows[scan.frame.image]]
    )
    return judge(store, before.made_from, f"second pass {before.input}", frames)


def latest(store: Store) -> Judging | None:
    """Latest judging, None if there is none. Raises DamagedError where one is missing or damaged."""
    check_judgings(store.connection, store.path)
    found = store.connection.execute(
        f"select digest from judging where not {_UNFINISHED} order by id desc limit 1"
    ).fetchone()
    if found is None:
        return None
    judging = find_judging(store, found[0])
    if judging is None:  # the row exists, but the index of digests used for the lookup lacks it
        raise damaged_judging(store.path)
    return judging


def _frames(
    store: Store, judging: Judging, images: Collection[str] | None
) -> Iterator[tuple[str, tuple[str, str, str | None], list[Sequence[Any]] | None]]:
    """Yield name, (uri, JSON of the raw result and of what the checks changed) and marks after the checks, which are
    None where anything is damaged. images: only these; None for all, after a check that none is missing."""
    db = store.connection
    if images is None:
        check_judging(db, judging.row, store.path)
    wanted = "" if images is None else "and name in (select value from json_each(?))"
    found = db.execute(
        f"select scan from judged_frame where judging = ? {wanted} order by name",
        (judging.row, *([] if images is None else [json.dumps(sorted(images))])),
    ).fetchall()
    columns = "name, uri, measured, changed, marks_digest, is_sound"
    frame = f"select {columns} from checked_frame where judging = ? and scan = ?"
    marks = f"select number, {MARKS} from checked_mark where judging = ? and scan = ? order by number"
    for (scan,) in found:
        rows = db.execute(marks, (judging.row, scan)).fetchall()
        name, *result, digest, is_whole = db.execute(frame, (judging.row, scan)).fetchone()
        is_whole = is_whole and row_digest(*rows) == digest
        yield name, tuple(result), [row[1:] for row in rows] if is_whole else None


def checked_scans(
    store: Store, judging: Judging, folder: Path, images: Collection[str] | None = None
) -> Iterator[MeasuredScan]:
    """Yield every scan after the cross-scan checks, sorted by name; a damaged one as a failure.

    Parameters
    ----------
    folder : base folder of relative scan paths.
    images : only these images; None for all.

    Raises
    ------
    DamagedError
        The list of frames is damaged.
    """
    for name, (uri, measured, changed), rows in _frames(store, judging, images):
        try:
            if rows is None:
                raise ValueError
            detail = json.loads(measured) | json.loads(changed or "{}")
            yield read_scan(name, detail, list(map(read_mark_row, rows)), scan_location(uri, folder))
        except (ValueError, TypeError, KeyError):
            sentence = str(damaged_result(name, store.path))
            frame = FrameMeasurement(name, (), problems=(Reason(sentence, Code.FAILED_SCAN),))
            yield MeasuredScan.failed("", frame, Failure(FailureCode.DAMAGED, sentence))


def remember_written(store: Store, digest: str, comparator: Path) -> None:
    """Record that the file now holds the marks of that judging."""
    store.remember(_WRITTEN, _written(digest, comparator))


def marks_as_written(store: Store, digest: str, comparator: Path) -> bool:
    """Whether the file holds the marks of that judging and has not been changed since."""
    return store.recall(_WRITTEN) == _written(digest, comparator)


def _written(digest: str, comparator: Path) -> dict[str, str]:
    return {"digest": digest, "file": hash_file(comparator) if comparator.exists() else ""}


def checked_marks(store: Store, judging: Judging, images: Collection[str] | None = None) -> Iterator[MarkRow]:
    """Yield the marks of every frame after the cross-scan checks, sorted by frame name.

    images: only these; None for all. Raises DamagedError where a frame is damaged.
    """
    for name, _, rows in _frames(store, judging, images):
        if rows is None:
            raise damaged_result(name, store.path)
        for point, kind, col, row, *spread, causes, status, _, reason, _ in rows:
            center = None if col is None else (col, row)
            yield MarkRow(name, point, kind, center, _covariance(spread, causes), status, reason)


def _covariance(spread: Sequence[float | None], causes: str | None) -> tuple[float, float, float] | None:
    """(col², row², col·row) elements of the covariance."""
    # Values that are not finite are stored only in the JSON of the causes.
    of_col, of_row, both = spread
    if of_col is not None and of_row is not None and both is not None:
        return of_col, of_row, both
    if causes is None:
        return None
    (first, second), (_, third) = json.loads(causes)["sum"]
    return float(first), float(third), float(second)


def _write_frame(store: Store, judging: int, lot: int, frame: CheckedResult) -> bytes:
    """Store the differences of a checked frame from its raw result, and return the stored content for hashing."""
    db, measured = store.connection, json.loads(store.detail(frame.result))
    now = scan_detail(frame.scan, measured["scan"])
    changed = {key: value for key, value in now.items() if value != measured.get(key)}
    detail = json.dumps(changed, ensure_ascii=False) if changed else None
    rows = [mark_row(mark) for mark in frame.scan.frame.marks]
    own_marks = rows != store.mark_rows(frame.result)
    rows = rows if own_marks else []
    scan, key = db.execute("select scan, fingerprint from result where id = ?", (frame.result,)).fetchone()
    name, verdict = frame.scan.frame.image, str(scan_verdict(frame.scan))
    db.execute(
        "insert into judged_frame (judging, lot, scan, result, name, verdict, own_marks, detail, decisions) "
        f"values ({places(9)})",
        (judging, lot, scan, frame.result, name, verdict, own_marks, detail, frame.decisions),
    )
    db.executemany(
        f"insert into judged (judging, result, number, {MARKS}) values ({places(15)})",
        ((judging, frame.result, number, *row) for number, row in enumerate(rows)),
    )
    db.execute(
        f"update judged_frame set marks_digest = {checked_marks_digest()} where judging = ? and scan = ?",
        (judging, scan),
    )
    return json.dumps([name, key, detail, rows]).encode()
