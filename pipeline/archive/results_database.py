"""out/measurement.db: the raw result of every scan by its key, and the results of the cross-scan checks.

One process writes, each scan in its own transaction; other processes may read meanwhile. A result has the same key on
every machine, so databases of shards can be merged.
"""

import json
import os
import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from measure.results import MEASURE_REVISION
from pipeline.archive.schema import (
    APPLICATION,
    COLUMNS,
    MARKS,
    THUMBNAILS,
    DamagedError,
    Database,
    application_id,
    damaged_result,
    is_result_sound,
    is_sound,
    measured_marks_digest,
)
from pipeline.archive.verdicts import Verdict, scan_doubt, scan_verdict
from pipeline.errors import InputError
from pipeline.provenance import FileIdentity, FileState, hash_text, result_key
from pipeline.results.measured_record import (
    MeasuredScan,
    finite_or_none,
    mark_row,
    read_scan,
    scan_detail,
    scan_location,
)

_PLACE = "project folder"
_MOVED = "moved-result"
_LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "tifffile", "imagecodecs")
_PROGRAM = "version, measure_revision, python, libraries"


@dataclass(frozen=True)
class Kept:
    """Result to be stored.

    camera: name of the camera's file.
    """

    identity: FileIdentity
    options_json: str
    scan: MeasuredScan
    bytes_read: int = 0
    camera: str = ""

    @property
    def fingerprint(self) -> str:
        return result_key(self.identity, hash_text(self.options_json))


class ResultsDatabase(Database):
    """Open results database of a project; closed at the end of the `with` block."""

    # --- scans

    def identities(self) -> dict[str, FileIdentity]:
        """{uri: identity at its last measurement} of every scan ever measured."""
        query = f"select uri, bytes, mtime_ns, etag, identity_hash from scan where {is_sound('scan')}"
        return {
            uri: FileIdentity(FileState(uri, *state), parts) for uri, *state, parts in self.connection.execute(query)
        }

    def fingerprints(self) -> dict[str, int]:
        """{fingerprint: row} of every sound result, read from the table itself and not from an index, which may be
        damaged."""
        query = f"select fingerprint, id from result not indexed where {is_sound('result')}"
        return dict(self.connection.execute(query))

    def set_project(self, names: Mapping[str, str]) -> None:
        """Set the project's current images. names: {uri: image}. No scan counts as current until `set_current`."""
        with self.writing():
            self.connection.execute("update scan set name = null, is_current = 0")
            self.connection.executemany("update scan set name = ?2 where uri = ?1", names.items())

    def set_current(self, results: Mapping[int, str]) -> None:
        """Mark results as current: they match their scans' present file and options. results: {row: hash of the
        request}."""
        with self.writing():
            self._set_current(results)

    def _set_current(self, results: Mapping[int, str | None]) -> None:
        own = "id = (select scan from result where id = ?1)"
        update = f"update scan set result = ?1, is_current = 1, asked = ?2 where {own}"
        self.connection.executemany(update, results.items())

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
            known = self.first("select id from result where fingerprint = ?", kept.fingerprint)
            result = self._result(kept, scan) if known is None else int(known)
            if name is not None:
                self._set_current({result: asked})
            return result

    def scan(self, result: int, image: str, folder: Path, with_marks: bool = True) -> MeasuredScan:
        """Raw result of a scan. folder: base of its relative path. Raises DamagedError where stored content is
        damaged."""
        rows = self.mark_rows(result) if with_marks else []
        try:
            detail = json.loads(self.detail(result))
            return read_scan(image, detail, rows, scan_location(detail["scan"], folder))
        except (ValueError, TypeError, KeyError):  # damaged before its rows had digests
            raise self._damage_error(result) from None

    def mark_rows(self, result: int) -> list[tuple[Any, ...]]:
        """Rows of the marks of a result. Raises DamagedError where they are damaged."""
        if not self.first(f"select {is_result_sound()} from result where id = ?", result):
            raise self._damage_error(result)
        rows = self.connection.execute(f"select {MARKS} from mark where result = ? order by number", (result,))
        return [tuple(row) for _, *row in rows]

    def detail(self, result: int) -> str:
        """JSON of the remaining content of a result. Raises DamagedError where it is damaged."""
        found = self.first(f"select detail from result where id = ? and {is_sound('result')}", result)
        if found is None:
            raise self._damage_error(result)
        return str(found)

    def _damage_error(self, result: int) -> DamagedError:
        own = "result = ?1 or id = (select scan from result where id = ?1)"
        image = self.first(f"select coalesce(name, uri) from scan where {own}", result)
        return damaged_result(image or "(unknown)", self.path)

    def has_damaged_rows(self) -> bool:
        """Whether a row of a scan, result or check run, or a kept value, is damaged; marks are not checked."""
        tables = {"scan": "", "result": "", "kept": "", "judging": "and digest not like 'unfinished%'"}
        query = "select exists (select 1 from {0} not indexed where not {1} {2})"
        return any(self.first(query.format(table, is_sound(table), end)) for table, end in tables.items())

    def forget_damaged(self) -> int:
        """Delete damaged results and scans and everything derived from them, so that they are measured again; return
        their number. Raises sqlite3.Error where the file itself is damaged."""
        with self.writing():
            self.connection.execute(f"delete from kept where not {is_sound('kept')}")
            results = self.column(f"select id from result not indexed where not {is_result_sound()}")
            return self._forget(results, self.column(f"select id from scan where not {is_sound('scan')}"))

    def forget_failed(self) -> int:
        """Delete failed results, so that the scans are measured again; return their number."""
        with self.writing():
            return self._forget(self.column("select id from result where verdict = ?", str(Verdict.FAILED)))

    def _forget(self, results: Collection[int], scans: Collection[int] = ()) -> int:
        """Delete results, scans with all of theirs, and all check runs; return the number of results."""
        listed, own = "in (select value from json_each(?))", json.dumps(list(scans))
        lost = {*results, *self.column(f"select id from result where scan {listed}", own)}
        rows, delete = json.dumps(list(lost)), self.connection.execute
        for table in ("judged", "judged_frame", "judged_lot", "judging"):  # including those of a missing check run
            delete(f"delete from {table}")
        delete(f"delete from mark where result {listed}", (rows,))
        delete(f"update scan set result = null, is_current = 0 where result {listed}", (rows,))
        delete(f"delete from result where id {listed}", (rows,))
        delete(f"update scan set duplicate_of = null where duplicate_of {listed}", (own,))
        delete(f"delete from scan where id {listed}", (own,))
        return len(lost)

    def results_with_writing(self) -> set[int]:
        """Rows of results of scans on which writing was found."""
        return {*self.column("select id from result where coalesce(detail ->> '$.writing', '[]') <> '[]'")}

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
            self.connection.executemany("update scan set content_hash = ?2 where uri = ?1", hashes.items())

    def set_copies(self, copies: Mapping[str, str]) -> None:
        """Set which scans are copies. copies: {uri: image whose file it is a copy of}; no other scan is a copy."""
        with self.writing():
            self.connection.execute("update scan set duplicate_of = null where duplicate_of is not null")
            original = "(select id from scan where name = ?2)"
            self.connection.executemany(f"update scan set duplicate_of = {original} where uri = ?1", copies.items())

    def move(self, uri: str, identity: FileIdentity, is_reviewed: bool = False) -> dict[str, str]:
        """Re-key the results of a scan whose file was moved or touched with unchanged content; return {old fingerprint:
        new}. is_reviewed: whether to remember these for `later_keys`."""
        state = identity.state
        with self.writing():
            if uri != state.uri:  # the earlier scan at that place is gone, and its results cannot be requested any more
                self._forget((), self.column("select id from scan where uri = ?", state.uri))
            self.connection.execute(
                "update scan set uri = ?, bytes = ?, mtime_ns = ?, etag = ?, identity_hash = ? where uri = ?",
                (*state, identity.parts_hash, uri),
            )
            results = self.connection.execute(
                "select result.fingerprint, hash, measure_revision from result join scan on scan.id = result.scan "
                "join options on options.id = result.options join program on program.id = result.program "
                "where uri = ?",
                (state.uri,),
            ).fetchall()
            keys = {before: result_key(identity, hashed, revision) for before, hashed, revision in results}
            self.connection.executemany("update result set fingerprint = ?2 where fingerprint = ?1", keys.items())
            if is_reviewed:
                rows = [(f"{_MOVED} {before}", json.dumps({"fingerprint": now})) for before, now in keys.items()]
                self.connection.executemany("insert or replace into kept (key, value) values (?, ?)", rows)
        return keys

    def later_keys(self, key: str) -> set[str]:
        """The fingerprint of a reviewed result, and those that it has had since its file was moved or touched."""
        keys = set[str]()
        moved: Mapping[str, Any] | None = {"fingerprint": key}
        while moved and (key := moved["fingerprint"]) not in keys:
            keys.add(key)
            moved = self.recall(f"{_MOVED} {key}")
        return keys

    # --- what scans of a project contribute to others

    def recall(self, key: str) -> Mapping[str, Any] | None:
        """Value stored by `remember`, None if there is none. Raises DamagedError where it is damaged."""
        row = self.connection.execute(f"select value, {is_sound('kept')} from kept where key = ?", (key,)).fetchone()
        if row is not None and not row[1]:
            raise DamagedError(
                f"{self.path}: stored result of {key.partition(' ')[0]} damaged (digest differs). Run `reseau measure "
                "--retry`, which makes it again."
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
        """Store the project's folder relative to the database, so that a project can be moved as a whole."""
        relative = os.path.relpath(folder.resolve(), self.path.resolve().parent)
        if self.recall(_PLACE) != {"path": relative}:
            self.remember(_PLACE, {"path": relative})

    def pose_name(self, result: int) -> str | None:
        """Name of the pose under which the marks of a result are named."""
        found: str | None = self.first("select pose from result where id = ?", result)
        return found

    # --- implementation

    def _scan(self, kept: Kept, name: str | None) -> int:
        """Insert or update the row of a scan, and return its number."""
        state, pitch_um = kept.identity.state, tuple(map(finite_or_none, kept.scan.pitch_um))
        if name is not None:  # another scan may have had the name
            self.connection.execute("update scan set name = null where name = ? and uri <> ?", (name, state.uri))
        own = {"mtime_ns": state.mtime_ns, "etag": state.etag, "identity_hash": kept.identity.parts_hash}
        own |= {"bytes": state.bytes, "width_px": kept.scan.width_px, "height_px": kept.scan.height_px}
        own |= {"pitch_x_um": pitch_um[0], "pitch_y_um": pitch_um[1], "camera": kept.camera}
        updates = ", ".join(f"{column} = excluded.{column}" for column in own)
        self.insert(
            "scan",
            {"name": name, "uri": state.uri, **own},
            "on conflict (uri) do update set name = coalesce(excluded.name, name), content_hash = case when "
            "(bytes, mtime_ns, etag, identity_hash) = (excluded.bytes, excluded.mtime_ns, excluded.etag, "
            f"excluded.identity_hash) then content_hash else '' end, {updates}",
        )
        return int(self.first("select id from scan where uri = ?", state.uri))

    def _result(self, kept: Kept, scan: int) -> int:
        measured, pose, matrix = kept.scan, kept.scan.frame.pose, kept.scan.frame.pixel_from_camera
        uri, pitch_um = kept.identity.state.uri if measured.scan else "", map(finite_or_none, measured.pitch_um)
        elements = [None] * 6 if matrix is None else map(finite_or_none, matrix.ravel().tolist())
        row: dict[str, object] = {
            "scan": scan,
            "fingerprint": kept.fingerprint,
            "program": self._program,
            "options": self._number("options", "hash, json", hash_text(kept.options_json), kept.options_json),
            "pose": pose and pose.name,
            "pose_decided": pose and pose.decided,
            **dict(zip("abcdef", elements, strict=True)),
            **dict(zip(("pitch_x_um", "pitch_y_um"), pitch_um, strict=True)),
            "verdict": str(scan_verdict(measured)),
            "why": scan_doubt(measured),
            "seconds": measured.seconds,
            "bytes_read": kept.bytes_read,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "detail": json.dumps(scan_detail(measured, uri), ensure_ascii=False),
        }
        result = self.insert("result", row)
        self.insert_marks("mark", {"result": result}, map(mark_row, measured.frame.marks))
        self.connection.execute(f"update result set marks_digest = {measured_marks_digest()} where id = ?", (result,))
        return result

    def _number(self, table: str, columns: str, *values: object) -> int:
        """Number of a row, inserted where there is none."""
        row = f"({', '.join('?' * len(values))})"
        self.connection.execute(f"insert or ignore into {table} ({columns}) values {row}", values)
        return int(self.first(f"select id from {table} where ({columns}) = {row}", *values))

    @cached_property
    def _program(self) -> int:
        libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
        python = platform.python_version()
        return self._number("program", _PROGRAM, version("reseau"), MEASURE_REVISION, python, libraries)


class Merged(NamedTuple):
    """Outcome of merging one database: number of its results, of those new here, and of damaged ones, which were not
    taken."""

    path: Path
    results: int
    new: int
    damaged: int


def check_mergeable(path: Path, others: Sequence[Path]) -> None:
    """Raise InputError for files that are no results databases, or the one at `path`, before anything is written."""
    for other in others:
        owner = application_id(other)
        if owner != APPLICATION:
            what = "is no" if other.exists() else "there is no such"
            what = "holds thumbnails and is no" if owner == THUMBNAILS else what
            raise InputError(f"{other}: {what} results database. Name the out/measurement.K-of-N.db of each part.")
        if other.resolve() == path.resolve():
            raise InputError(f"{other}: is the results database that the others are joined into. Name the others only.")
        ResultsDatabase(other).close()


def merge(database: ResultsDatabase, others: Sequence[Path]) -> list[Merged]:
    """Import the results that other databases hold and this one lacks, after `check_mergeable`.

    Each is imported completely or not at all. The others are not changed, except for migration to this version.
    """
    merged = []
    for path in others:
        database.connection.execute("attach ? as other", (str(path),))
        try:
            results = int(database.first("select count(*) from other.result"))
            sound = database.first(f"select total({is_result_sound('r', 'other.mark')}) from other.result r")
            with database.writing():
                merged.append(Merged(path, results, _insert(database), results - int(sound)))
        finally:
            database.connection.execute("detach other")
    return merged


def _insert(database: ResultsDatabase) -> int:
    """Insert the rows of all tables in the order of their references; existing rows stay."""
    insert = database.connection.execute
    before = database.first("select coalesce(max(id), 0) from main.result")
    columns = ", ".join(COLUMNS["scan"][2:14])  # of the file and its content
    insert(
        f"insert into main.scan ({columns}, name) select {columns}, null from other.scan where {is_sound('scan')} "
        "on conflict (uri) do update set bytes = excluded.bytes, mtime_ns = excluded.mtime_ns, etag = excluded.etag, "
        "identity_hash = excluded.identity_hash, content_hash = excluded.content_hash "
        "where excluded.mtime_ns > mtime_ns"  # a file that was changed in between
    )
    for table, columns in (("program", _PROGRAM), ("options", "hash, json")):
        insert(f"insert or ignore into main.{table} ({columns}) select {columns} from other.{table}")
    own = COLUMNS["result"][5:-1]
    insert(
        f"insert or ignore into main.result (scan, fingerprint, program, options, {', '.join(own)}) "
        f"select scan.id, r.fingerprint, program.id, options.id, {', '.join(f'r.{name}' for name in own)} "
        "from other.result r join other.scan s on s.id = r.scan join main.scan scan on scan.uri = s.uri "
        "join other.program p on p.id = r.program join main.program program on (program.version, "
        "program.measure_revision, program.python, program.libraries) = "
        "(p.version, p.measure_revision, p.python, p.libraries) "
        "join other.options o on o.id = r.options join main.options options on options.hash = o.hash "
        f"where {is_result_sound('r', 'other.mark')} and {is_sound('scan', 's')} order by r.id"
    )
    insert(
        f"insert into main.mark (result, {MARKS}) select result.id, {MARKS} from main.result result "
        "join other.result r on r.fingerprint = result.fingerprint join other.mark m on m.result = r.id "
        "where result.id > ?",
        (before,),
    )
    insert(f"insert or ignore into main.kept (key, value) select key, value from other.kept where {is_sound('kept')}")
    digest = measured_marks_digest(marks="main.mark")
    return insert(f"update main.result set marks_digest = {digest} where id > ?", (before,)).rowcount
