"""Merge the results databases of shards: a result has the same key on every machine."""

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.archive.results_database import Store
from pipeline.archive.results_integrity import COLUMNS, MARKS, is_result_sound, is_sound, measured_marks_digest
from pipeline.errors import InputError

_SCAN = [name for name in COLUMNS["scan"][2:] if name not in ("result", "is_current", "duplicate_of", "asked")]
_RESULT = COLUMNS["result"][5:-1]
_MARK = f"number, {MARKS}"
_SOUND = is_result_sound("r", "other.mark")


@dataclass(frozen=True)
class Merged:
    """Outcome of merging one store: number of its results, of those new here, and of damaged ones, which were not
    taken."""

    path: Path
    results: int
    new: int
    damaged: int = 0


def merge(store: Store, others: Sequence[Path]) -> list[Merged]:
    """Import the results that other stores hold and this one lacks.

    Each store is imported completely or not at all. The others are not changed, except for migration to this version.
    Raises InputError for a file that is no store, before anything is imported.
    """
    for path in others:
        if not path.is_file():
            raise InputError(
                f"{path}: there is no such results database. Name the out/measurement.K-of-N.db of each part."
            )
        if path.resolve() == store.path.resolve():
            raise InputError(f"{path}: is the results database that the others are joined into. Name the others only.")
        Store(path).close()
    return [_merge_store(store, path) for path in others]


def _merge_store(store: Store, path: Path) -> Merged:
    db = store.connection
    db.execute("attach ? as other", (str(path),))
    try:
        results, sound = db.execute(f"select count(*), total({_SOUND}) from other.result r").fetchone()
        with store.writing():
            new = _insert(db)
    finally:
        db.execute("detach other")
    return Merged(path, results, new, results - int(sound))


def _insert(db: sqlite3.Connection) -> int:
    """Insert the rows of all tables in the order of their references; existing rows stay."""
    before = db.execute("select coalesce(max(id), 0) from main.result").fetchone()[0]
    columns = ", ".join(_SCAN)
    db.execute(
        f"insert into main.scan ({columns}, name) select {columns}, null from other.scan where {is_sound('scan')} "
        "on conflict (uri) do update set bytes = excluded.bytes, mtime_ns = excluded.mtime_ns, etag = excluded.etag, "
        "identity_hash = excluded.identity_hash, content_hash = excluded.content_hash "
        "where excluded.mtime_ns > mtime_ns"  # a file that was changed in between
    )
    for table, columns in (("program", "version, measure_revision, python, libraries"), ("options", "hash, json")):
        db.execute(f"insert or ignore into main.{table} ({columns}) select {columns} from other.{table}")
    db.execute(
        f"insert or ignore into main.result (scan, fingerprint, program, options, {', '.join(_RESULT)}) "
        f"select scan.id, r.fingerprint, program.id, options.id, {', '.join(f'r.{name}' for name in _RESULT)} "
        "from other.result r join other.scan s on s.id = r.scan join main.scan scan on scan.uri = s.uri "
        "join other.program p on p.id = r.program join main.program program on (program.version, "
        "program.measure_revision, program.python, program.libraries) = "
        "(p.version, p.measure_revision, p.python, p.libraries) "
        "join other.options o on o.id = r.options join main.options options on options.hash = o.hash "
        f"where {_SOUND} and {is_sound('scan', 's')} order by r.id"
    )
    db.execute(
        f"insert into main.mark (result, {_MARK}) select result.id, {_MARK} from main.result result "
        "join other.result r on r.fingerprint = result.fingerprint join other.mark m on m.result = r.id "
        "where result.id > ?",
        (before,),
    )
    new = f"update main.result set marks_digest = {measured_marks_digest(marks='main.mark')} where id > ?"
    sound = f"from other.kept where {is_sound('kept')}"
    db.execute(f"insert or ignore into main.kept (key, value) select key, value {sound}")
    return db.execute(new, (before,)).rowcount
