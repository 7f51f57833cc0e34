"""Integrity of a store: each row has a digest, and a row that does not match it is not used."""

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Sequence
from typing import Any

from pipeline.errors import InputError
from pipeline.results.measured_record import MARK_COLUMNS

_BYTES = 16
_MARK_ROW = ", ".join(("number", *MARK_COLUMNS))
_SCAN = (
    "id", "name", "uri", "bytes", "mtime_ns", "etag", "identity_hash", "content_hash", "width_px", "height_px", "bits",
    "pitch_x_um", "pitch_y_um", "camera", "result", "is_current", "duplicate_of", "asked",
)  # fmt: skip
_RESULT = (
    "id", "scan", "fingerprint", "program", "options", "pose", "pose_decided", "a", "b", "c", "d", "e", "f",
    "pitch_x_um", "pitch_y_um", "verdict", "seconds", "bytes_read", "finished", "detail", "marks_digest",
)  # fmt: skip
_FRAME = ("scan", "result", "name", "verdict", "own_marks", "detail", "lot", "decisions", "marks_digest")
_KEPT = ("key", "value")


def row_digest_sql(table: str, columns: Sequence[str]) -> str:
    """SQL expression for the digest of a row. table: name or alias."""
    return f"row_digest({', '.join(f'{table}.{column}' for column in columns)})"


def is_sound(table: str, alias: str = "") -> str:
    """SQL expression: whether a row matches its digest. alias: of the table in the query."""
    name = alias or table
    return f"({name}.digest is {row_digest_sql(name, _COLUMNS[table])})"


def seal(table: str) -> str:
    """SQL statement that sets the digests of rows just written; a `where` clause may follow."""
    return f"update {table} set digest = {row_digest_sql(table, _COLUMNS[table])}"


_COLUMNS = {"scan": _SCAN, "result": _RESULT, "judged_frame": _FRAME, "kept": _KEPT}


class DamagedError(InputError):
    """Stored content does not match its digest."""

    @classmethod
    def from_image(cls, image: str, path: object) -> "DamagedError":
        return cls(damaged_sentence(image, path))


def damaged_sentence(image: str, path: object) -> str:
    """Message about a scan whose stored result is damaged."""
    return (
        f"{path}: what is stored of image {image!r} is not what was measured: the file was changed or is damaged. "
        "This result is not used. Run `reseau measure --retry`, which measures the image again."
    )


def row_digest(*values: Any) -> str:
    """BLAKE2b (hexadecimal) of a row's values as JSON, numbers with all their digits."""
    text = json.dumps(values, separators=(",", ":"), default=lambda data: {"bytes": data.hex()})
    return hashlib.blake2b(text.encode("ascii"), digest_size=_BYTES).hexdigest()


def marks_digest(rows: Iterable[Sequence[Any]]) -> str:
    """Digest of all marks of a result in their order, each with its number and MARK_COLUMNS."""
    return row_digest(*map(tuple, rows))


def add_digests(db: sqlite3.Connection) -> None:
    """Set the digests of all rows of a store from a version without digests."""
    for table, key in (("mark", "result"), ("judged", "judging, result")):
        parent = "result" if table == "mark" else "judged_frame"
        rows = db.execute(f"select {key}, {_MARK_ROW} from {table} order by {key}, number")
        marks = dict[tuple[int, ...], list[Sequence[Any]]]()
        keys = len(key.split(","))
        for row in rows:
            marks.setdefault(row[:keys], []).append(row[keys:])
        where = "id = ?" if table == "mark" else "judging = ? and result = ?"
        db.execute(f"update {parent} set marks_digest = ?", (marks_digest(()),))
        db.executemany(
            f"update {parent} set marks_digest = ? where {where}",
            ((marks_digest(own), *of) for of, own in marks.items()),
        )
    for table in _COLUMNS:
        db.execute(seal(table))
    for (judging,) in db.execute("select id from judging").fetchall():
        seal_judging(db, judging)


def seal_judging(db: sqlite3.Connection, judging: int) -> None:
    """Set the digest of a judging and the common digest of its frames."""
    frames = _frames_digest(db, judging)
    db.execute("update judging set frames_digest = ? where id = ?", (frames, judging))
    db.execute(f"update judging set seal = {_JUDGING} where id = ?", (judging,))


def check_judging(db: sqlite3.Connection, judging: int, path: object) -> None:
    """Raise DamagedError where a judging is damaged or lacks frames."""
    query = f"select frames_digest from judging where id = ? and {IS_JUDGING_SOUND}"
    found = db.execute(query, (judging,)).fetchone()
    if found is None or found[0] != _frames_digest(db, judging):
        raise damaged_judging(path)


def check_judgings(db: sqlite3.Connection, path: object) -> None:
    """Raise DamagedError where any finished judging is damaged or missing."""
    lost = db.execute(
        f"select exists (select 1 from judging where seal is not null and not {IS_JUDGING_SOUND}) or "
        "exists (select 1 from judged_frame where judging not in (select id from judging))"
    ).fetchone()[0]
    if lost:
        raise damaged_judging(path)


def damaged_judging(path: object) -> DamagedError:
    return DamagedError(
        f"{path}: the list of checked images is not as it was written: the file was changed or is damaged. "
        "Run `reseau measure --retry`, which checks all images again."
    )


def _frames_digest(db: sqlite3.Connection, judging: int) -> str:
    query = "select scan, result, digest from judged_frame where judging = ? order by scan"
    return row_digest(*db.execute(query, (judging,)))


_JUDGING = "row_digest(judging.id, judging.digest, made_from, judging.input, frames_digest)"
IS_JUDGING_SOUND = f"(seal is {_JUDGING})"


def damaged_results(db: sqlite3.Connection) -> set[int]:
    """Rows of all damaged results; their marks are checked as well."""
    return {row for row, is_whole in _results(db).items() if not is_whole}


def damaged_frames(db: sqlite3.Connection, judging: int) -> dict[int, str]:
    """{result: image} of the frames of a judging whose raw result, scan or checked marks are damaged."""
    results, own = _results(db), dict(_digests(db, "judged", f"judging = {judging:d}"))
    rows = db.execute(
        f"select f.result, f.name, f.marks_digest, {is_sound('judged_frame', 'f')} and {is_sound('scan')} "
        "from judged_frame f left join scan on scan.id = f.scan where f.judging = ?",
        (judging,),
    )
    return {
        result: str(name)
        for result, name, digest, is_whole in rows
        if not (is_whole and results.get(result) and own.get(result, _NO_MARKS) == digest)
    }


def _results(db: sqlite3.Connection) -> dict[int, bool]:
    """{row: whether the result and its marks match their digests}."""
    marks = dict(_digests(db, "mark", "true"))
    rows = db.execute(f"select id, marks_digest, {is_sound('result')} from result not indexed")
    return {row: bool(is_whole) and marks.get(row, _NO_MARKS) == digest for row, digest, is_whole in rows}


def _digests(db: sqlite3.Connection, table: str, where: str) -> Iterable[tuple[int, str]]:
    """Yield (result, digest of its marks) for every result that has marks."""
    query = f"select result, {_MARK_ROW} from {table} where {where} order by result, number"
    result, marks = None, list[Sequence[Any]]()
    for of, *row in db.execute(query):
        if of != result:
            if result is not None:
                yield result, marks_digest(marks)
            result, marks = of, []
        marks.append(row)
    if result is not None:
        yield result, marks_digest(marks)


_NO_MARKS = marks_digest(())
