"""out/measurement.db: the raw result of every scan by its key, and the results of the cross-scan checks.

One process writes, each scan in its own transaction; other processes may read meanwhile. A result has the same key on
every machine, so databases of shards can be merged.
"""

import json
import os
import platform
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from measure.results import MEASURE_REVISION
from pipeline.archive.schema import (
    COLUMNS,
    MARKS,
    DamagedError,
    Database,
    damaged_result,
    forget,
    is_result_sound,
    is_sound,
    measured_marks_digest,
    row_digest,
)
from pipeline.archive.verdicts import Verdict, scan_doubt, scan_verdict
from pipeline.errors import InputError
from pipeline.provenance import FileState, Identity, hash_text, result_key
from pipeline.results.measured_record import (
    MeasuredScan,
    finite_or_none,
    mark_row,
    read_mark_row,
    read_scan,
    scan_detail,
    scan_location,
)

_SCAN = [name for name in COLUMNS["scan"][2:] if name not in ("result", "is_current", "duplicate_of", "asked")]
_RESULT = COLUMNS["result"][5:-1]
_MARK = f"number, {MARKS}"
_SOUND = is_result_sound("r", "other.mark")
_PLACE = "project folder"
_LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "tifffile", "imagecodecs")


@dataclass(frozen=True)
class Kept:
    """Result to be stored.

    camera: name of the camera's file.
    """

    identity: Identity
    options_json: str
    scan: MeasuredScan
    bytes_read: int = 0
    camera: str = ""

    @property
    def fingerprint(self) -> str:
        return result_key(self.identity, hash_text(self.options_json))


class Store(Database):
    """Open results database of a project; closed at the end of the `with` block."""

    # --- scans

    def identities(self) -> dict[str, Identity]:
        """{uri: identity at its last measurement} of every scan ever measured."""
        rows = self.connection.execute(
            f"select uri, bytes, mtime_ns, etag, identity_hash from scan where {is_sound('scan')}"
        )
        return {uri: Identity(FileState(uri, *state), parts) for uri, *state, parts in rows}

    def fingerprints(self) -> dict[str, int]:
        """{fingerprint: row} of every sound result, read from the table itself and not from an index, which may be
        damaged."""
        return dict(
            self.connection.execute(f"select fingerprint, id from result not indexed where {is_sound('result')}")
        )

    def set_project(self, names: Mapping[str, str]) -> None:
        """Set the project's current images. names: {uri: image}. No scan counts as current until `set_current`."""
        with self.writing():
            self.connection.execute("update scan set name = null, is_current = 0")
            self.connection.executemany(
                "update scan set name = ? where uri = ?", ((n, uri) for uri, n in names.items())
            )

    def set_current(self, results: Mapping[int, str]) -> None:
        """Mark results as current: they match their scans' present file and options. results: {row: hash of the
        request}."""
        with self.writing():
            self.connection.executemany(
                "update scan set result = ?1, is_current = 1, asked = ?2 "
                "where id = (select scan from result where id = ?1)",
                results.items(),
            )

    # --- results

    def keep(self, kept: Kept, name: str | None = None, asked: str | None = None) -> int:
        """Store a result, completely or not at all, and return its row.

        Parameters
        ----------
        name : image of the project whose own result this is, by its present file and options; None for an auxiliary
            result for other scans.
        asked : hash of the request.
        """
        with self.writing():
            scan = self._scan(kept, name)
            result = self._result(kept, scan)
            if name is not None:
                values = (result, asked, scan)
                self.connection.execute("update scan set result = ?, is_current = 1, asked = ? where id = ?", values)
            return result

    def scan(self, result: int, image: str, folder: Path, with_marks: bool = True) -> MeasuredScan:
        """Raw result of a scan. folder: base of its relative path. Raises DamagedError where stored content is
        damaged."""
        rows = self.mark_rows(result) if with_marks else []
        try:
            detail = json.loads(self.detail(result))
            return read_scan(image, detail, list(map(read_mark_row, rows)), scan_location(detail["scan"], folder))
        except (ValueError, TypeError, KeyError):  # damaged before its rows had digests
            raise self._damaged(result) from None

    def mark_rows(self, result: int) -> list[tuple[Any, ...]]:
        """Rows of the marks of a result. Raises DamagedError where they are damaged."""
        rows = self.connection.execute(f"select number, {MARKS} from mark where result = ? order by number", (result,))
        numbered = rows.fetchall()
        digest = self.connection.execute(
            f"select marks_digest from result where id = ? and {is_sound('result')}", (result,)
        ).fetchone()
        if digest is None or row_digest(*numbered) != digest[0]:
            raise self._damaged(result)
        return [tuple(row) for _, *row in numbered]

    def detail(self, result: int) -> str:
        """JSON of the remaining content of a result. Raises DamagedError where it is damaged."""
        query = f"select detail from result where id = ? and {is_sound('result')}"
        found = self.connection.execute(query, (result,)).fetchone()
        if found is None:
            raise self._damaged(result)
        return str(found[0])

    def _damaged(self, result: int) -> DamagedError:
        found = self.connection.execute(
            "select coalesce(name, uri) from scan where result = ?1 or id = (select scan from result where id = ?1)",
            (result,),
        ).fetchone()
        return damaged_result(str(found[0]) if found else "(unknown)", self.path)

    def has_damaged_rows(self) -> bool:
        """Whether a row of a scan, result, judging or value kept for other scans is damaged; marks are not checked."""
        tables = ("scan", "result", "kept", "judging")
        found = [f"exists (select 1 from {table} not indexed where not {is_sound(table)})" for table in tables]
        found[-1] = found[-1].replace("where", "where digest not like 'unfinished%' and")
        return bool(self.connection.execute(f"select {' or '.join(found)}").fetchone()[0])

    def forget_damaged(self) -> int:
        """Delete damaged results and scans and everything derived from them, so that they are measured again; return
        their number. Raises sqlite3.Error where the file itself is damaged."""
        with self.writing():
            self.connection.execute(f"delete from kept where not {is_sound('kept')}")
            results = self._rows(f"select id from result not indexed where not {is_result_sound()}")
            return forget(self.connection, results, self._rows(f"select id from scan where not {is_sound('scan')}"))

    def written(self) -> set[int]:
        """Rows of results of scans on which writing was found."""
        return {*self._rows("select id from result where coalesce(detail ->> '$.writing', '[]') <> '[]'")}

    def forget_failed(self) -> int:
        """Delete failed results, so that the scans are measured again; return their number."""
        with self.writing():
            failed = self._rows("select id from result where verdict = ?", str(Verdict.FAILED))
            return forget(self.connection, failed)

    def failures(self) -> list[tuple[str, str, str]] | None:
        """(name, file, reason) of every scan of the project if all failed; None where one was measured."""
        rows = self.connection.execute(
            "select verdict, name, detail from scan join result on result.id = scan.result where is_current "
            f"order by verdict = '{Verdict.FAILED}', name"
        )
        failures = []
        for verdict, name, detail in rows:
            if verdict != Verdict.FAILED:
                return None
            failure = json.loads(detail)
            failures.append((str(name), str(failure["scan"]), str(failure["failure"]["sentence"])))
        return failures

    # --- the content of whole files

    def content_hashes(self) -> dict[str, str]:
        """{uri: SHA-256 of the whole file} where it is known."""
        return dict(self.connection.execute("select uri, content_hash from scan where content_hash <> ''"))

    def set_content_hashes(self, hashes: Mapping[str, str]) -> None:
        with self.writing():
            self.connection.executemany(
                "update scan set content_hash = ? where uri = ?", ((hash, uri) for uri, hash in hashes.items())
            )

    def set_copies(self, copies: Mapping[str, str]) -> None:
        """Set which scans are copies. copies: {uri: image whose file it is a copy of}; no other scan is a copy."""
        with self.writing():
            self.connection.execute("update scan set duplicate_of = null where duplicate_of is not null")
            self.connection.executemany(
                "update scan set duplicate_of = (select id from scan where name = ?) where uri = ?",
                ((name, uri) for uri, name in copies.items()),
            )

    def move(self, uri: str, identity: Identity) -> dict[str, str]:
        """Re-key the results of a scan whose file was moved or touched with unchanged content; return {old fingerprint:
        new}."""
        state = identity.state
        with self.writing():
            if uri != state.uri:  # the earlier scan at that place is gone, and its results cannot be requested any more
                forget(self.connection, (), self._rows("select id from scan where uri = ?", state.uri))
            self.connection.execute(
                "update scan set uri = ?, bytes = ?, mtime_ns = ?, etag = ?, identity_hash = ? where uri = ?",
                (state.uri, state.bytes, state.mtime_ns, state.etag, identity.parts_hash, uri),
            )
            results = self.connection.execute(
                "select result.fingerprint, hash, measure_revision from result join scan on scan.id = result.scan "
                "join options on options.id = result.options join program on program.id = result.program "
                "where uri = ?",
                (state.uri,),
            ).fetchall()
            keys = {before: result_key(identity, hashed, revision) for before, hashed, revision in results}
            self.connection.executemany(
                "update result set fingerprint = ? where fingerprint = ?",
                ((now, before) for before, now in keys.items()),
            )
        return keys

    # --- what scans of a project contribute to others

    def recall(self, key: str) -> Mapping[str, Any] | None:
        """Value stored by `remember`, None if there is none. Raises DamagedError where it is damaged."""
        row = self.connection.execute(f"select value, {is_sound('kept')} from kept where key = ?", (key,)).fetchone()
        if row is not None and not row[1]:
            raise DamagedError(
                f"{self.path}: what is stored of {key.partition(' ')[0]} is not as it was written: the file was "
                "changed or is damaged. Run `reseau measure --retry`, which makes it again."
            )
        return None if row is None else json.loads(row[0])

    def remember(self, key: str, value: Mapping[str, object]) -> None:
        """Store what scans of the project contribute to others."""
        with self.writing():
            self.connection.execute("insert or replace into kept (key, value) values (?, ?)", (key, json.dumps(value)))

    @property
    def project_folder(self) -> Path:
        """Folder of the project, to which paths of scans are relative."""
        return self.path.parent / str((self.recall(_PLACE) or {"path": ".."})["path"])

    def set_project_folder(self, folder: Path) -> None:
        """Store the project's folder relative to the store, so that a project can be moved as a whole."""
        relative = os.path.relpath(folder.resolve(), self.path.resolve().parent)
        if self.recall(_PLACE) != {"path": relative}:
            self.remember(_PLACE, {"path": relative})

    def pose_name(self, result: int) -> str | None:
        """Name of the pose under which the marks of a result are named."""
        found = self.connection.execute("select pose from result where id = ?", (result,)).fetchone()
        return None if found is None else found[0]

    # --- implementation

    def _rows(self, query: str, *parameters: object) -> list[int]:
        return [row for (row,) in self.connection.execute(query, parameters)]

    def _scan(self, kept: Kept, name: str | None) -> int:
        state, scan = kept.identity.state, kept.scan
        if name is not None:  # another scan may have had the name
            self.connection.execute("update scan set name = null where name = ? and uri <> ?", (name, state.uri))
        values = (
            name, state.uri, state.bytes, state.mtime_ns, state.etag, kept.identity.parts_hash,
            scan.width_px, scan.height_px, *map(finite_or_none, scan.pitch_um), kept.camera,
        )  # fmt: skip
        columns = (
            "bytes", "mtime_ns", "etag", "identity_hash", "width_px", "height_px", "pitch_x_um", "pitch_y_um", "camera",
        )  # fmt: skip
        names = ", ".join(columns)
        updates = ", ".join(f"{column} = excluded.{column}" for column in columns)
        row = self.connection.execute(
            f"insert into scan (name, uri, {names}) values ({places(len(values))}) on conflict (uri) do update set "
            "name = coalesce(excluded.name, name), content_hash = case when (bytes, mtime_ns, etag, identity_hash) = "
            "(excluded.bytes, excluded.mtime_ns, excluded.etag, excluded.identity_hash) then content_hash else '' end, "
            f"{updates} returning id",
            values,
        ).fetchone()
        return int(row[0])

    def _result(self, kept: Kept, scan: int) -> int:
        known = self.connection.execute("select id from result where fingerprint = ?", (kept.fingerprint,)).fetchone()
        if known is not None:
            return int(known[0])
        measured, pose = kept.scan, kept.scan.frame.pose
        matrix = measured.frame.pixel_from_camera
        uri = kept.identity.state.uri if measured.scan else ""
        values = (
            scan, kept.fingerprint, self._program, self._options(kept.options_json),
            pose and pose.name, pose and pose.decided,
            *([None] * 6 if matrix is None else map(finite_or_none, matrix.ravel().tolist())),
            *map(finite_or_none, measured.pitch_um), str(scan_verdict(measured)), scan_doubt(measured),
            measured.seconds, kept.bytes_read, datetime.now(UTC).isoformat(timespec="seconds"),
            json.dumps(scan_detail(measured, uri), ensure_ascii=False),
        )  # fmt: skip
        result = self.connection.execute(
            "insert into result (scan, fingerprint, program, options, pose, pose_decided, a, b, c, d, e, f, "
            f"pitch_x_um, pitch_y_um, verdict, why, seconds, bytes_read, finished, detail) values ({places(20)})",
            values,
        ).lastrowid
        assert result is not None
        rows = ((result, number, *mark_row(mark)) for number, mark in enumerate(measured.frame.marks))
        self.connection.executemany(f"insert into mark (result, number, {MARKS}) values ({places(14)})", rows)
        self.connection.execute(f"update result set marks_digest = {measured_marks_digest()} where id = ?", (result,))
        return result

    def _options(self, options_json: str) -> int:
        hashed = hash_text(options_json)
        self.connection.execute("insert or ignore into options (hash, json) values (?, ?)", (hashed, options_json))
        return int(self.connection.execute("select id from options where hash = ?", (hashed,)).fetchone()[0])

    @cached_property
    def _program(self) -> int:
        libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
        versions = (version("reseau"), MEASURE_REVISION, platform.python_version(), libraries)
        columns = "version, measure_revision, python, libraries"
        self.connection.execute(f"insert or ignore into program ({columns}) values (?, ?, ?, ?)", versions)
        query = f"select id from program where ({columns}) = (?, ?, ?, ?)"
        return int(self.connection.execute(query, versions).fetchone()[0])


def places(count: int) -> str:
    return ", ".join("?" * count)


class Merged(NamedTuple):
    """Outcome of merging one store: number of its results, of those new here, and of damaged ones, which were not
    taken."""

    path: Path
    results: int
    new: int
    damaged: int


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
    db, merged = store.connection, []
    for path in others:
        db.execute("attach ? as other", (str(path),))
        try:
            results, sound = db.execute(f"select count(*), total({_SOUND}) from other.result r").fetchone()
            with store.writing():
                merged.append(Merged(path, results, _insert(db), results - int(sound)))
        finally:
            db.execute("detach other")
    return merged


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
