"""What all scans of a project together make of what each gave: kept beside it, made anew and dropped at will.

A judging is written whole and named by its digest, which comparator.csv names too: so both belong together whenever a
process is ended. The one before is dropped when the files that name this one are in their places.
"""

import hashlib
import json
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from pipeline.archive.store import MARK_COLUMNS, Json, Store, mark_of, places, row_of
from pipeline.archive.verdicts import Verdict, verdict_of

_AT_A_TIME = 500  # frames in a transaction
_UNFINISHED = "digest like 'unfinished%'"  # the process that made it was ended


@dataclass(frozen=True)
class Judging:
    """digest: of all that it says. made_from: fingerprints by name, as `made_from` has them. input: what was judged."""

    row: int
    digest: str
    made_from: Mapping[str, str]
    input: str


@dataclass(frozen=True)
class JudgedScan:
    """name: of the image. result: the row of what was measured. record: as it is now, beside all others."""

    name: str
    result: int
    record: Json


def judge(store: Store, made_from: Mapping[str, str], input_hash: str, frames: Iterable[JudgedScan]) -> str:
    """Keep a judging of all frames, whole or not at all, and give its digest. Of a frame only what is another than it
    was measured takes room."""
    told = hashlib.sha256(json.dumps([dict(made_from), input_hash], sort_keys=True).encode())
    db = store.connection
    with store.writing():
        db.execute(f"delete from judging where {_UNFINISHED}")
        values = (f"unfinished {input_hash}", json.dumps(dict(made_from)), input_hash)
        row = db.execute("insert into judging (digest, made_from, input) values (?, ?, ?)", values).lastrowid
        assert row is not None
    left = iter(frames)
    while some := list(islice(left, _AT_A_TIME)):  # what makes them may have to measure, and write, meanwhile
        with store.writing():
            for frame in some:
                told.update(_write(db, row, frame, store.record(frame.result)))
    digest = told.hexdigest()
    with store.writing():
        db.execute("delete from judging where digest = ?", (digest,))
        db.execute("update judging set digest = ? where id = ?", (digest, row))
    return digest


def drop_all_but(store: Store, digest: str) -> None:
    """Drop every other judging."""
    with store.writing():
        store.connection.execute("delete from judging where digest <> ?", (digest,))


def judging_of(store: Store, digest: str) -> Judging | None:
    """The judging of that digest."""
    query = "select id, digest, made_from, input from judging where digest = ?"
    found = store.connection.execute(query, (digest,)).fetchone()
    return None if found is None else Judging(found[0], found[1], json.loads(found[2]), found[3])


def rejudge(store: Store, before: Judging, records: Mapping[str, Json]) -> str:
    """Keep another judging of the same results, after a look that a later `measure` does not take; give its digest."""
    query = "select name, result from judged_frame where judging = ? order by name"
    rows = store.connection.execute(query, (before.row,)).fetchall()
    frames = [JudgedScan(name, result, records[name]) for name, result in rows]
    return judge(store, before.made_from, f"looked again {before.input}", frames)


def latest(store: Store) -> Judging | None:
    """The one that was made last."""
    found = store.connection.execute(
        f"select digest from judging where not {_UNFINISHED} order by id desc limit 1"
    ).fetchone()
    return None if found is None else judging_of(store, found[0])


def judged_records(store: Store, judging: Judging, images: Collection[str] | None = None) -> Iterator[tuple[str, Json]]:
    """Name and record of every frame, by name: where its file is now, and as all scans together show it. images: of
    these alone."""
    db = store.connection
    frames = db.execute(
        "select judged_frame.name, judged_frame.result, own_marks, judged_frame.detail, uri from judged_frame "
        "join scan on scan.id = judged_frame.scan where judging = ? order by judged_frame.name",
        (judging.row,),
    )
    for name, result, own_marks, detail, uri in frames:
        if images is not None and name not in images:
            continue
        record = store.record(result)
        if own_marks:
            query = f"select {MARK_COLUMNS} from judged where judging = ? and result = ? order by number"
            record["marks"] = [mark_of(row) for row in db.execute(query, (judging.row, result))]
        record.update(json.loads(detail) if detail else {})
        yield name, {**record, "scan": uri}


def _write(db: sqlite3.Connection, judging: int, frame: JudgedScan, measured: Json) -> bytes:
    """Write what of a frame is another than it was measured, and give all that was written."""
    now = frame.record
    changed = {k: v for k, v in now.items() if k not in ("marks", "scan") and v != measured.get(k)}
    own_marks = now["marks"] != measured["marks"]
    detail = json.dumps(changed, ensure_ascii=False) if changed else None
    verdict: Verdict = verdict_of(now)
    scan, key = db.execute("select scan, fingerprint from result where id = ?", (frame.result,)).fetchone()
    db.execute(
        f"insert into judged_frame (judging, scan, result, name, verdict, own_marks, detail) values ({places(7)})",
        (judging, scan, frame.result, frame.name, str(verdict), own_marks, detail),
    )
    rows: list[tuple[Any, ...]] = [row_of(mark) for mark in now["marks"]] if own_marks else []
    db.executemany(
        f"insert into judged (judging, result, number, {MARK_COLUMNS}) values ({places(15)})",
        ((judging, frame.result, number, *row) for number, row in enumerate(rows)),
    )
    return json.dumps([frame.name, key, detail, rows]).encode()
