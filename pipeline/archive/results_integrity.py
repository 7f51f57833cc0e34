"""Integrity of a results database: each row has a digest, and a row that does not match it is not used.

Triggers set the digests. They are temporary, so that a change by any other program is noticed.
"""

import hashlib
import json
import sqlite3
from typing import Any

from pipeline.errors import InputError
from pipeline.results.measured_record import MARK_COLUMNS

_BYTES = 16
MARKS = ", ".join(MARK_COLUMNS)
COLUMNS = {
    "scan": (
        "id", "name", "uri", "bytes", "mtime_ns", "etag", "identity_hash", "content_hash", "width_px", "height_px",
        "bits", "pitch_x_um", "pitch_y_um", "camera", "result", "is_current", "duplicate_of", "asked",
    ),
    "result": (
        "id", "scan", "fingerprint", "program", "options", "pose", "pose_decided", "a", "b", "c", "d", "e", "f",
        "pitch_x_um", "pitch_y_um", "verdict", "seconds", "bytes_read", "finished", "detail", "marks_digest",
    ),
    "judged_frame": ("scan", "result", "name", "verdict", "own_marks", "detail", "lot", "decisions", "marks_digest"),
    "judging": ("id", "digest", "made_from", "input", "frames_digest"),
    "kept": ("key", "value"),
}  # fmt: skip
_KEYS = {"judged_frame": ("judging", "scan"), "kept": ("key",)}  # primary keys other than id


def row_digest(*values: Any) -> str:
    """BLAKE2b (hexadecimal) of a row's values as JSON, numbers with all their digits."""
    text = json.dumps(values, separators=(",", ":"), default=lambda data: {"bytes": data.hex()})
    return hashlib.blake2b(text.encode("ascii"), digest_size=_BYTES).hexdigest()


class _RowsDigest:
    """SQL aggregate: digest of rows in their order."""

    def __init__(self) -> None:
        self._rows: list[tuple[Any, ...]] = []

    def step(self, *row: Any) -> None:
        self._rows.append(row)

    def finalize(self) -> Any:  # typeshed expects a number
        return row_digest(*self._rows)


def _rows_digest(columns: str, source: str, order: str) -> str:
    """SQL expression for the digest of rows."""
    rows = f"select {columns} from {source} order by {order}"
    return f"(select coalesce(rows_digest({columns}), '{row_digest()}') from ({rows}))"


def measured_marks_digest(result: str = "result", marks: str = "mark") -> str:
    """SQL expression for the digest of the marks of a result. result, marks: names or aliases."""
    return _rows_digest(f"number, {MARKS}", f"{marks} m where m.result = {result}.id", "number")


def checked_marks_digest(frame: str = "judged_frame") -> str:
    """SQL expression for the digest of the marks that the checks of a frame have stored. frame: name or alias."""
    own = f"m.judging = {frame}.judging and m.result = {frame}.result"
    return _rows_digest(f"number, {MARKS}", f"judged m where {own}", "number")


FRAMES_DIGEST = _rows_digest("scan, result, digest", "judged_frame f where f.judging = judging.id", "scan")


def is_sound(table: str, alias: str = "") -> str:
    """SQL expression: whether a row matches its digest. alias: of the table in the query."""
    name = alias or table
    return f"({name}.{_digest_column(table)} is {_digest(table, name)})"


def _digest_column(table: str) -> str:
    return "seal" if table == "judging" else "digest"


def _digest(table: str, name: str) -> str:
    return f"row_digest({', '.join(f'{name}.{column}' for column in COLUMNS[table])})"


def _seal(table: str) -> str:
    return f"update {table} set {_digest_column(table)} = {_digest(table, table)}"


def add_functions(db: sqlite3.Connection) -> None:
    """Add the digests as SQL functions."""
    db.create_function("row_digest", -1, row_digest, deterministic=True)
    db.create_aggregate("rows_digest", -1, _RowsDigest)


def add_triggers(db: sqlite3.Connection) -> None:
    """Let this connection set the digest of every row that it writes."""
    for table, columns in COLUMNS.items():
        row = " and ".join(f"{key} = new.{key}" for key in _KEYS.get(table, ("id",)))
        for name, event in (("new", "insert"), ("changed", f"update of {', '.join(columns)}")):
            sealed = f"begin {_seal(table)} where {row}; end"
            db.execute(f"create temp trigger seal_{name}_{table} after {event} on {table} {sealed}")


def add_digests(db: sqlite3.Connection) -> None:
    """Set the digests of all rows of a store from a version without digests."""
    db.execute(f"update result set marks_digest = {measured_marks_digest()}")
    db.execute(f"update judged_frame set marks_digest = {checked_marks_digest()}")
    for table in ("scan", "result", "kept", "judged_frame"):
        db.execute(_seal(table))
    db.execute(f"update judging set frames_digest = {FRAMES_DIGEST}")
    db.execute(_seal("judging"))


class DamagedError(InputError):
    """Stored content does not match its digest."""


def damaged_result(image: str, path: object) -> DamagedError:
    return DamagedError(
        f"{path}: what is stored of image {image!r} is not what was measured: the file was changed or is damaged. "
        "This result is not used. Run `reseau measure --retry`, which measures the image again."
    )


def damaged_judging(path: object) -> DamagedError:
    return DamagedError(
        f"{path}: the list of checked images is not as it was written: the file was changed or is damaged. "
        "Run `reseau measure --retry`, which checks all images again."
    )


def check_judging(db: sqlite3.Connection, judging: int, path: object) -> None:
    """Raise DamagedError where a judging is damaged or lacks frames."""
    query = f"select 1 from judging where id = ? and {is_sound('judging')} and frames_digest is {FRAMES_DIGEST}"
    if db.execute(query, (judging,)).fetchone() is None:
        raise damaged_judging(path)


def check_judgings(db: sqlite3.Connection, path: object) -> None:
    """Raise DamagedError where any finished judging is damaged or missing."""
    lost = db.execute(
        f"select exists (select 1 from judging where seal is not null and not {is_sound('judging')}) or "
        "exists (select 1 from judged_frame where judging not in (select id from judging))"
    ).fetchone()[0]
    if lost:
        raise damaged_judging(path)


def is_result_sound(result: str = "result", marks: str = "mark") -> str:
    """SQL expression: whether a result and its marks match their digests. result, marks: names or aliases."""
    return f"({is_sound('result', result)} and {result}.marks_digest is {measured_marks_digest(result, marks)})"


def damaged_frames(db: sqlite3.Connection, judging: int) -> dict[int, str]:
    """{result: image} of the frames of a judging whose raw result, scan or checked marks are damaged."""
    query = (
        "select f.result, f.name from judged_frame f left join scan on scan.id = f.scan "
        f"left join result on result.id = f.result where f.judging = ? and not ({is_sound('judged_frame', 'f')} and "
        f"{is_sound('scan')} and {is_result_sound()} and f.marks_digest is {checked_marks_digest('f')})"
    )
    return {result: str(name) for result, name in db.execute(query, (judging,))}
