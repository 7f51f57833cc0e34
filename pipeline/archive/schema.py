"""Tables of the project's SQLite files, digests of their rows, and migrations from earlier versions: forward only.

The file holds its version number (`pragma user_version`). A change of the tables is appended to the migrations;
existing entries are never changed. Each row has a digest, and a row that does not match it is not used. Triggers set
the digests. They are temporary, so that a change by any other program is noticed."""

import hashlib
import json
import math
import os
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pipeline.errors import InputError, what_to_do_about_database
from pipeline.results.measured_record import MARK_COLUMNS

# Of damaged files: even SQLite's message may be undecodable, which sqlite3 may also tell by a SystemError.
DATABASE_ERRORS = (sqlite3.Error, UnicodeDecodeError, SystemError)
APPLICATION, THUMBNAILS = 0x52455345, 0x52455354  # "RESE", "REST": identify the files for `file` and this program
_SQLITE = b"SQLite format 3"  # its files begin with it
MARKS = ", ".join(("number", *MARK_COLUMNS))

_CHECKED_MARKS = """
select f.judging, f.name as image, f.scan, f.verdict, m.* from judged_frame f
join mark m on m.result = f.result where not f.own_marks
union all
select f.judging, f.name, f.scan, f.verdict, m.result, m.number, m.point, m.kind, m.col_px, m.row_px, m.var_col,
    m.var_row, m.cov, m.causes, m.status, m.reason_code, m.reason, m.quality from judged_frame f
join judged m on m.judging = f.judging and m.result = f.result where f.own_marks
"""

_FIRST = f"""
create table scan (
    id integer primary key,
    name text unique,                        -- the image's; null: no scan of the project any more
    uri text not null unique,                -- its path relative to the project's folder, or its address
    bytes integer not null, mtime_ns integer not null, etag text not null,
    identity_hash text not null,             -- SHA-256 of the telling parts of its file
    content_hash text not null default '',   -- SHA-256 of the whole file, where it was needed
    width_px integer, height_px integer, bits integer, pitch_x_um real, pitch_y_um real, camera text,
    result integer,                          -- of the last time that it was measured as a scan of the project
    is_current integer not null default 0,   -- whether that is by today's file and options
    duplicate_of integer references scan,
    asked text,                              -- hash of the project's request when that was last determined
    digest text                              -- here and below: BLAKE2b of the row
);
create table program (
    id integer primary key, version text not null, measure_revision integer not null, python text not null,
    libraries text not null, unique (version, measure_revision, python, libraries)
);
create table options (id integer primary key, hash text not null unique, json text not null);
create table result (
    id integer primary key,
    scan integer not null references scan,
    fingerprint text not null unique,        -- SHA-256 of the scan's identity, the options and the revision of measure
    program integer not null references program,
    options integer not null references options,
    pose text, pose_decided integer,
    a real, b real, c real, d real, e real, f real,   -- pixel_from_camera: col = a x' + b y' + c, row = d x' + e y' + f
    pitch_x_um real, pitch_y_um real,
    verdict text not null, why text not null, -- why it needs a look
    seconds real not null, bytes_read integer not null, finished text not null,
    detail text not null,                    -- JSON: all else that the scan gave
    marks_digest text, digest text
);
create index result_of_scan on result (scan);
create table mark (
    result integer not null references result, number integer not null,
    point text not null, kind text not null, col_px real, row_px real,
    var_col real, var_row real, cov real, causes text,
    status text not null, reason_code text not null, reason text not null, quality text not null,
    primary key (result, number)
) without rowid;
create table judging (
    id integer primary key,
    digest text not null unique,             -- of all that it says: comparator.csv names it
    made_from text not null,                 -- JSON: fingerprints of what it was made from
    input text not null,                     -- SHA-256 of the results that were judged, and by what
    frames_digest text, seal text            -- seal: of the row
);
create table judged_frame (
    judging integer not null references judging on delete cascade,
    scan integer not null references scan, result integer not null references result,
    name text not null, verdict text not null, why text not null, own_marks integer not null,
    detail text,                             -- JSON: what of the result is another now; null: nothing
    lot integer not null default 0,
    decisions text,                          -- hash of the decisions about the image that were considered
    marks_digest text, digest text,
    primary key (judging, scan)
) without rowid;
create table judged (
    judging integer not null references judging on delete cascade,
    result integer not null references result, number integer not null,
    point text not null, kind text not null, col_px real, row_px real,
    var_col real, var_row real, cov real, causes text,
    status text not null, reason_code text not null, reason text not null, quality text not null,
    primary key (judging, result, number)
) without rowid;
create table judged_lot (
    judging integer not null references judging on delete cascade, lot integer not null,
    input text not null,                     -- SHA-256 of all that judging these frames starts from
    output text not null,                    -- SHA-256 of what it says of them
    primary key (judging, lot)
) without rowid;
create index judged_lot_by_input on judged_lot (input);
create table kept (key text primary key, value text not null, digest text);   -- what scans of a project tell all others
create view checked_mark as                  -- after the checks: of the raw result where these changed none
{_CHECKED_MARKS};
create view mark_view as
with pitch as (select id, pitch_x_um / 1000.0 as px_mm, pitch_y_um / 1000.0 as py_mm from result)
select image, point, kind, col_px * px_mm as x_mm, -row_px * py_mm as y_mm,
    sqrt(var_col) * px_mm as sx_mm, sqrt(var_row) * py_mm as sy_mm,
    case when var_col > 0 and var_row > 0 then -cov / sqrt(var_col) / sqrt(var_row) end as rho,
    col_px, row_px, status, reason
from checked_mark join pitch on pitch.id = result
where judging = (select max(id) from judging where digest not like 'unfinished%') order by image, number;
"""


def row_digest(*values: Any) -> str:
    """BLAKE2b (hexadecimal) of a row's values as JSON, numbers with all their digits."""
    text = json.dumps(values, separators=(",", ":"), default=lambda data: {"bytes": data.hex()})
    return hashlib.blake2b(text.encode("ascii"), digest_size=16).hexdigest()


class _RowsDigest:
    """SQL aggregate: digest of rows in their order."""

    def __init__(self) -> None:
        self._rows: list[tuple[Any, ...]] = []

    def step(self, *row: Any) -> None:
        self._rows.append(row)

    def finalize(self) -> Any:  # typeshed expects a number
        return row_digest(*self._rows)


def _digested_columns() -> dict[str, tuple[str, ...]]:
    """Columns of the rows that have a digest, by table; of checked frames without the check run, so that they can be
    copied to another."""
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(_FIRST)
        tables = [name for (name,) in db.execute("select name from sqlite_master where type = 'table'")]
        columns = {table: [row[1] for row in db.execute(f"pragma table_info({table})")] for table in tables}
    return {
        table: tuple(name for name in own[:-1] if name != "judging")
        for table, own in columns.items()
        if own[-1] in ("digest", "seal")
    }


COLUMNS = _digested_columns()


# The following return SQL expressions; their arguments are tables or aliases of them in the query.


def _rows_digest(columns: str, source: str, order: str) -> str:
    rows = f"select {columns} from {source} order by {order}"
    return f"(select coalesce(rows_digest({columns}), '{row_digest()}') from ({rows}))"


def measured_marks_digest(result: str = "result", marks: str = "mark") -> str:
    """Digest of the marks of a result."""
    return _rows_digest(MARKS, f"{marks} m where m.result = {result}.id", "number")


def checked_marks_digest(frame: str = "judged_frame") -> str:
    """Digest of the marks that the checks of a frame have stored."""
    own = f"m.judging = {frame}.judging and m.result = {frame}.result"
    return _rows_digest(MARKS, f"judged m where {own}", "number")


FRAMES_DIGEST = _rows_digest("scan, result, digest", "judged_frame f where f.judging = judging.id", "scan")


def is_sound(table: str, alias: str = "") -> str:
    """Whether a row matches its digest."""
    return f"({alias or table}.{_digest_column(table)} is {_digest(table, alias or table)})"


def is_result_sound(result: str = "result", marks: str = "mark") -> str:
    """Whether a result and its marks match their digests."""
    return f"({is_sound('result', result)} and {result}.marks_digest is {measured_marks_digest(result, marks)})"


def _digest_column(table: str) -> str:
    return "seal" if table == "judging" else "digest"


def _digest(table: str, name: str) -> str:
    return f"row_digest({', '.join(f'{name}.{column}' for column in COLUMNS[table])})"


# Frames of every check run with their scan and raw result. is_sound: whether the rows match their digests; is_whole:
# whether their marks do, too.
_CHECKED_FRAMES = f"""
create temp view checked_frame as
select f.judging, judging.digest, f.lot, f.name, f.verdict, f.decisions, f.detail as changed, f.scan, scan.uri,
    scan.width_px, scan.height_px, scan.camera, scan.duplicate_of, f.result, result.fingerprint, result.pitch_x_um,
    result.pitch_y_um, result.detail as measured,
    {is_sound("judged_frame", "f")} and {is_sound("result")} and {is_sound("scan")} as is_sound,
    {is_sound("judged_frame", "f")} and {is_result_sound()} and {is_sound("scan")}
        and f.marks_digest is {checked_marks_digest("f")} as is_whole
from judged_frame f join judging on judging.id = f.judging
left join result on result.id = f.result left join scan on scan.id = f.scan
"""


def _add_triggers(db: sqlite3.Connection) -> None:
    """Let this connection set the digest of every row that it writes."""
    for table, columns in COLUMNS.items():
        for name, event in (("new", "insert"), ("changed", f"update of {', '.join(columns)}")):
            update = f"update {table} set {_digest_column(table)} = {_digest(table, table)}"
            row = {"judged_frame": "(judging, scan) = (new.judging, new.scan)", "kept": "key = new.key"}
            where = row.get(table, "id = new.id")
            db.execute(
                f"create temp trigger seal_{name}_{table} after {event} on {table} begin {update} where {where}; end"
            )


class DamagedError(InputError):
    """Stored content does not match its digest."""


def damaged_result(image: str, path: object) -> DamagedError:
    return DamagedError(
        f"{path}: stored result of image {image!r} damaged (digest differs). It is not used. Run `reseau measure "
        "--retry`, which measures the image again."
    )


def damaged_check_run(path: object) -> DamagedError:
    return DamagedError(
        f"{path}: the list of checked images is damaged (digest differs). "
        "Run `reseau measure --retry`, which checks all images again."
    )


def verify_check_run(db: sqlite3.Connection, check_run: int, path: object) -> None:
    """Raise DamagedError where a check run is damaged or lacks frames."""
    query = f"select 1 from judging where id = ? and {is_sound('judging')} and frames_digest is {FRAMES_DIGEST}"
    if db.execute(query, (check_run,)).fetchone() is None:
        raise damaged_check_run(path)


def damaged_frames(db: sqlite3.Connection, check_run: int) -> dict[int, str]:
    """{result: image} of the frames of a check run whose raw result, scan or checked marks are damaged."""
    return dict(db.execute("select result, name from checked_frame where judging = ? and not is_whole", (check_run,)))


@dataclass(frozen=True)
class Schema:
    """Schema of a kind of file. application: SQLite's application id; first: the first version that was released;
    migrations: scripts, one for each version from the first; what: its content, for messages."""

    application: int
    first: int
    migrations: tuple[str, ...]
    what: str

    @property
    def version(self) -> int:
        return self.first + len(self.migrations) - 1


MEASUREMENTS = Schema(APPLICATION, 6, (_FIRST,), "measurements")


class Database:
    """Open SQLite file of a project; closed at the end of the `with` block."""

    schema = MEASUREMENTS

    def __init__(self, path: Path) -> None:
        """Open or create a file. Raises InputError for a file that is no such database."""
        self.path = path
        self.connection = open_database(path, self.schema)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Close the file. Raises InputError for errors of SQLite in the block, since any read of a damaged file may
        cause one."""
        self.close()
        if isinstance(error, DATABASE_ERRORS):
            raise _database_error(self.path, self.schema, error) from error

    def close(self) -> None:
        self.connection.close()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Transaction: all of the block is written, or nothing."""
        self.connection.execute("begin immediate")
        try:
            yield
            self.connection.execute("commit")
        except BaseException:
            if self.connection.in_transaction:  # on a full disk SQLite itself has rolled back
                self.connection.execute("rollback")
            raise

    def first(self, query: str, *values: object) -> Any:
        """First column of the first row; None where there is none."""
        row = self.connection.execute(query, values).fetchone()
        return None if row is None else row[0]

    def column(self, query: str, *values: object) -> list[Any]:
        """First column of all rows."""
        return [row[0] for row in self.connection.execute(query, values)]

    def insert(self, table: str, row: Mapping[str, object], end: str = "") -> int:
        """Insert a row, given by columns, and return its number. end: of the statement."""
        places = ", ".join("?" * len(row))
        statement = f"insert into {table} ({', '.join(row)}) values ({places}) {end}"
        return self.connection.execute(statement, tuple(row.values())).lastrowid or 0

    def insert_marks(self, table: str, keys: Mapping[str, int], rows: Iterable[Sequence[object]]) -> None:
        """Insert marks of MARK_COLUMNS, in their order. keys: their other columns."""
        places = ", ".join("?" * (len(keys) + 1 + len(MARK_COLUMNS)))
        self.connection.executemany(
            f"insert into {table} ({', '.join(keys)}, {MARKS}) values ({places})",
            ((*keys.values(), number, *row) for number, row in enumerate(rows)),
        )


@contextmanager
def single_writer(path: Path) -> Iterator[None]:
    """Lock a database, for commands that measure into it; the lock ends with the process, however that ends.

    Raises InputError where another process has the lock.
    """
    lock = path.with_name(f".{path.stem}.lock")
    with closing(sqlite3.connect(lock, timeout=0.0, isolation_level=None)) as connection:
        try:
            connection.execute("begin exclusive")
            is_ours = lock.exists()  # else the other process has ended just now
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise _database_error(lock, MEASUREMENTS, error) from error
            is_ours = False
        if not is_ours:
            raise InputError(
                f"{path}: another `reseau measure` or `reseau run` is running on this project. Wait until it has "
                "ended, then run this command again; what it measures is kept."
            )
        try:
            yield
        finally:
            with suppress(OSError):
                lock.unlink(missing_ok=True)


def open_database(path: Path, schema: Schema = MEASUREMENTS) -> sqlite3.Connection:
    """Open a file and migrate it to this version, each step completely or not at all; create it where there is none.

    Raises InputError for a file of another kind or of a later version.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    connection = _connection(path)
    try:
        _check(connection, path, schema)
        connection.create_function("sqrt", 1, _sqrt, deterministic=True)  # not every SQLite is built with it
        connection.create_function("row_digest", -1, row_digest, deterministic=True)
        connection.create_aggregate("rows_digest", -1, _RowsDigest)
        for pragma in ("journal_mode = wal", "synchronous = normal", "foreign_keys = on"):
            connection.execute(f"pragma {pragma}")
        version = connection.execute("pragma user_version").fetchone()[0]
        for number, script in enumerate(schema.migrations, schema.first):
            marks = f"pragma application_id = {schema.application}; pragma user_version = {number}"
            if number > version:
                connection.executescript(f"begin immediate; {script}; {marks}; commit;")
        if schema.application == APPLICATION:
            _add_triggers(connection)
            connection.execute(_CHECKED_FRAMES)
            # The file's own text of this view may be damaged, and has no digest.
            connection.execute(f"create temp view checked_mark as {_CHECKED_MARKS}")
    except BaseException as error:
        connection.close()  # which rolls back an unfinished step
        if isinstance(error, DATABASE_ERRORS):
            raise _database_error(path, schema, error) from error
        raise
    return connection


def application_id(path: Path) -> int:
    """SQLite's application id of a file; 0 where there is none, or no such file."""
    if not path.is_file():
        return 0
    with path.open("rb") as file:
        if file.read(len(_SQLITE)) != _SQLITE:
            return 0
    with closing(_connection(path)) as connection, suppress(*DATABASE_ERRORS):
        return int(connection.execute("pragma application_id").fetchone()[0])
    return 0


def _connection(path: Path) -> sqlite3.Connection:
    """Open for reading and writing; read-only where the folder is not writable: SQLite creates files in it."""
    name, is_address = str(path), path.exists() and not all(os.access(one, os.W_OK) for one in (path.parent, path))
    if is_address:
        log = path.with_name(f"{path.name}-wal")  # exists while another process has the file open
        is_open = log.exists() and log.stat().st_size > 0
        name = f"{path.absolute().as_uri()}?mode=ro{'' if is_open else '&immutable=1'}"
    return sqlite3.connect(name, timeout=60.0, isolation_level=None, uri=is_address)


def _database_error(path: Path, schema: Schema, error: Exception) -> InputError:
    next_step = what_to_do_about_database(error) or (_RETRY if isinstance(error, sqlite3.IntegrityError) else _MOVE)
    return InputError(f"{path}: cannot be used as a database of {schema.what} ({error}). {next_step}")


_MOVE = "Move it away, and run `reseau measure` again."
_RETRY = "Run `reseau measure --retry`, which measures again what is damaged."


def _check(connection: sqlite3.Connection, path: Path, schema: Schema) -> None:
    """Raise InputError for a file that this version cannot read."""
    version, owner = (connection.execute(f"pragma {key}").fetchone()[0] for key in ("user_version", "application_id"))
    has_tables = connection.execute("select count(*) from sqlite_master").fetchone()[0] > 0
    if has_tables and owner != schema.application:
        raise InputError(f"{path}: is an SQLite file that was not written by reseau for {schema.what}. {_MOVE}")
    if version > schema.version:
        raise InputError(
            f"{path}: is of version {version}, written by a later reseau than this one, which knows up to "
            f"{schema.version}. Install that, or move the file away."
        )
    if 0 < version < schema.first:
        raise InputError(
            f"{path}: is of version {version}, from before the first release, which this one cannot read: measure once "
            f"more. {_MOVE}"
        )


def _sqrt(value: float | None) -> float | None:
    return None if value is None or value < 0 else math.sqrt(value)
