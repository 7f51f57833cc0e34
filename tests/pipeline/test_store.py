"""The store gives back what was kept, takes it whole or not at all, and other programs can read it."""

import os
import sqlite3
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest
from projects import FOLDER, changed, comparator_points, content, failed, kept_result, made_record, present, stored

from measure import Code, Reason, Status
from measure.results import Kind
from pipeline import InputError
from pipeline.archive.checked_results import (
    CheckedResult,
    CheckRun,
    Lot,
    find_check_run,
    latest,
    store_checks,
    store_lots,
)
from pipeline.archive.results_database import ResultsDatabase, check_mergeable
from pipeline.archive.schema import MEASUREMENTS, open_database
from pipeline.archive.thumbnails import ThumbnailDatabase
from pipeline.archive.verdicts import NEXT_STEP, Verdict, scan_verdict
from pipeline.provenance import content_hash, file_state, hash_text, parts_hash, result_key, shard_number
from pipeline.report.data import ReportData, frames
from pipeline.report.frame_problems import single_frame_problems
from pipeline.results.comparator_file import comparator_lines
from pipeline.results.measured_record import MeasuredScan

LOOK = Reason("look", Code.PITCH)
LOOKED_AT = made_record(problems=(LOOK,))


def contents(check_run: CheckRun) -> list[tuple[object, ...]]:
    """Of every scan after the checks."""
    check_run.database.set_project_folder(FOLDER)
    return [content(replace(scan, scan=os.path.normpath(scan.scan))) for scan in check_run.scans()]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "out" / "measurement.db"


def test_a_record_comes_back_without_loss_and_once(path: Path) -> None:
    with ResultsDatabase(path) as database:
        row = database.keep(kept_result(3), "box/3")
        other = database.keep(kept_result(4))
    with ResultsDatabase(path) as database:
        assert stored(database, row, "3") == content(made_record(3))
        assert stored(database, other, "4") == content(made_record(4))
        assert database.fingerprints() == {kept_result(3).fingerprint: row, kept_result(4).fingerprint: other}
        assert database.identities() == {"scans/3.tif": kept_result(3).identity, "scans/4.tif": kept_result(4).identity}
        assert database.keep(kept_result(3)) == row != database.keep(kept_result(3, options='{"pose": "90"}'))
        assert len(database.fingerprints()) == 3


def test_a_judging_changes_what_is_visible_and_not_what_was_measured(path: Path) -> None:
    with ResultsDatabase(path) as database:
        rows = [database.keep(kept_result(seed), str(seed)) for seed in (1, 2)]
        doubted = changed(made_record(1), [2], Status.WEAK, Reason("the others say otherwise", Code.OFF_GIVEN))
        now = [doubted, made_record(2, problems=(Reason("it is the frame of 1.", Code.COPY),))]
        frames = [CheckedResult(row, scan) for row, scan in zip(rows, now, strict=True)]
        check_run = present(find_check_run(database, store_checks(database, {"settings": "a"}, "input", frames).digest))
        assert check_run.made_from == {"settings": "a"}
        assert contents(check_run) == [content(scan) for scan in now]
        assert [stored(database, row, name) for row, name in zip(rows, "12", strict=True)] == [
            content(made_record(1)),
            content(made_record(2)),
        ]
        measured_marks = database.connection.execute(
            "select image, status from mark_view where status = 'weak'"
        ).fetchall()
        assert measured_marks == [("1", "weak")]
        assert database.connection.execute("select count(*) from judged").fetchone() == (8,)  # of the first alone


def test_a_lot_whose_input_was_tested_is_not_tested_again(path: Path) -> None:
    requests = list[str]()

    def lot(input_hash: str, *seeds: int) -> Lot:
        def frames() -> Iterator[CheckedResult]:
            requests.append(input_hash)
            for seed in seeds:
                now = changed(made_record(seed), [seed], Status.WEAK, Reason(f"by {input_hash}", Code.OFF_GIVEN))
                yield CheckedResult(database.keep(kept_result(seed), str(seed)), now)

        return Lot(input_hash, frames)

    with ResultsDatabase(path) as database:
        first = store_lots(database, {}, "1", [lot("a", 1, 2), lot("b", 3)])
        second = store_lots(database, {}, "2", [lot("a", 1, 2), lot("c", 3, 4)])
        assert requests == ["a", "b", "c"]
        assert first.digest != second.digest
        second.drop_others()
        assert (find_check_run(database, first.digest), latest(database)) == (None, second)
        scans = list(second.scans())
        reasons = {scan.frame.image: [str(mark.reason) for mark in scan.frame.marks if mark.reason] for scan in scans}
        assert reasons == {"1": ["by a"], "2": ["by a"], "3": ["by c"], "4": ["by c"]}
    other = path.parent / "other.db"
    with ResultsDatabase(other) as database:  # the same, all of it judged anew
        again = store_lots(database, {}, "2", [lot("a", 1, 2), lot("c", 3, 4)])
        assert again.digest == second.digest
        anew = contents(again)
        rows = list(comparator_lines(again.points(), {}))
    with ResultsDatabase(path) as database:
        check_run = present(find_check_run(database, second.digest))
        assert contents(check_run) == anew
        assert list(comparator_lines(check_run.points(), {})) == rows
        points = comparator_points([scan.frame for scan in check_run.scans()], check_run.pitches_um())
        assert list(comparator_lines(points, {})) == rows


def test_a_step_to_a_later_version_is_made_whole_or_not_at_all(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ResultsDatabase(path) as database:
        row = database.keep(kept_result(1), "1")
    step = "alter table scan add column box text; update scan set box = 'a'"
    broken = f"{step}; insert into nowhere values (1)"
    monkeypatch.setattr(ResultsDatabase, "schema", replace(MEASUREMENTS, migrations=(*MEASUREMENTS.migrations, broken)))
    with pytest.raises(InputError, match="nowhere"):
        ResultsDatabase(path)
    monkeypatch.setattr(ResultsDatabase, "schema", replace(MEASUREMENTS, migrations=(*MEASUREMENTS.migrations, step)))
    with ResultsDatabase(path) as database:
        assert database.connection.execute("select name, box from scan").fetchall() == [("1", "a")]
        assert database.connection.execute("pragma user_version").fetchone() == (MEASUREMENTS.version + 1,)
        assert stored(database, row) == content(made_record())


def test_what_is_no_store_is_refused(path: Path, tmp_path: Path) -> None:
    path.parent.mkdir()
    path.write_text("measured: nothing")
    with pytest.raises(InputError, match="cannot be used as a database of measurements"):
        ResultsDatabase(path)
    path.unlink()
    with sqlite3.connect(path) as db:
        db.execute("create table a (b)")
    with pytest.raises(InputError, match="not written by reseau"):
        ResultsDatabase(path)
    path.unlink()
    open_database(path).close()
    for version, words in ((MEASUREMENTS.version + 1, "a later reseau"), (MEASUREMENTS.first - 1, "before the first")):
        with sqlite3.connect(path) as db:
            db.execute(f"pragma user_version = {version}")
        with pytest.raises(InputError, match=words):
            ResultsDatabase(path)
    ResultsDatabase(tmp_path / "a.db").close()
    (tmp_path / "camera.toml").write_text("name = 1")
    ThumbnailDatabase(tmp_path / "measurement.db").close()
    with sqlite3.connect(tmp_path / "of-others.db") as db:
        db.execute("create table a (b)")
    others = {"b.db": "there is no such results", "camera.toml": "is no results", "a.db": "joined into"}
    others |= {"of-others.db": "is no results", "thumbnails.db": "holds thumbnails and is no results"}
    for name, words in others.items():
        with pytest.raises(InputError, match=words):
            check_mergeable(tmp_path / "a.db", [tmp_path / name])


def keep_many(path: Path, told: int) -> None:
    """Keep results, and tell a pipe of each that is kept, until the process is ended."""
    with ResultsDatabase(path) as database:
        for seed in range(100_000):
            database.keep(kept_result(seed), str(seed))
            os.write(told, b".")


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")  # of fork, from Python 3.12 on
def test_what_was_kept_survives_a_kill_and_nothing_is_half(path: Path) -> None:
    reading, writing = os.pipe()
    writer = get_context("fork").Process(target=keep_many, args=(path, writing))
    writer.start()
    os.close(writing)
    complete = sum(len(os.read(reading, 1)) for _ in range(50))
    time.sleep(0.05)
    writer.kill()
    while written := os.read(reading, 1000):
        complete += len(written)
    writer.join()
    os.close(reading)
    with ResultsDatabase(path) as database:
        found = database.fingerprints()
        assert 50 <= complete <= len(found) <= complete + 1
        assert all(database.scan(row, "", FOLDER).frame.marks for row in found.values())
        assert database.connection.execute("pragma integrity_check").fetchone() == ("ok",)


def test_verdicts_of_scans() -> None:
    good, counts = made_record(), {"ann": 1}
    answered = changed(good, [0], Status.REJECTED, Reason("rejected by ann", Code.DECIDED))
    verdicts: list[tuple[MeasuredScan, Verdict]] = [
        (good, Verdict.GOOD),
        (made_record(status=Status.WEAK), Verdict.LOOK),
        (made_record(problems=(LOOK,)), Verdict.LOOK),
        (made_record(pose=replace(present(good.frame.pose), decided=False)), Verdict.LOOK),
        (made_record(status=Status.ABSENT), Verdict.POOR),
        (made_record(pixel_from_camera=None), Verdict.POOR),
        (changed(good, range(2, 8), Status.REJECTED, LOOK), Verdict.POOR),
        (failed(), Verdict.FAILED),
        (replace(answered, reviewers=counts), Verdict.DECIDED),
        (replace(answered, frame=replace(answered.frame, problems=(LOOK,)), reviewers=counts), Verdict.LOOK),
        (replace(good, reviewers=counts), Verdict.DECIDED),
        (replace(made_record(status=Status.WEAK), reviewers=counts), Verdict.LOOK),
    ]
    target = replace(good.frame.marks[0], kind="target", point="t", status=Status.REJECTED, reason=LOOK)
    for status, verdict in ((Status.WEAK, Verdict.GOOD), (Status.REJECTED, Verdict.LOOK)):
        targets = (target, replace(target, point="u", status=status))
        verdicts.append((replace(good, frame=replace(good.frame, marks=(*good.frame.marks, *targets))), verdict))
    kinds: list[tuple[Kind, Verdict]] = [("tie", Verdict.LOOK), ("join", Verdict.LOOK), ("target", Verdict.GOOD)]
    for kind, verdict in kinds:
        points = (target, replace(target, kind=kind, point="u", status=Status.MEASURED))
        verdicts.append((good.changed([*good.frame.marks, *points]), verdict))
    elsewhere = replace(target, kind="fiducial", status=Status.ABSENT, reason=Reason("it lies in f1b", Code.OTHER_PART))
    verdicts.append((good.changed([*good.frame.marks, elsewhere]), Verdict.GOOD))
    assert [scan_verdict(scan) for scan, _ in verdicts] == [verdict for _, verdict in verdicts]
    assert set(NEXT_STEP) == set(Verdict)
    for scan, verdict in verdicts:  # the summary, and so the exit code, say the same
        (frame,) = frames(ReportData("", measurement={scan.frame.image: scan}))
        assert any(single_frame_problems(frame)) is verdict.needs_review, verdict


def test_keys_and_shards_depend_on_all_that_they_name() -> None:
    base = kept_result(1)
    others = [kept_result(1, options="[1]"), kept_result(1, mtime_ns=2), kept_result(2)]
    keys = {base.fingerprint, *(other.fingerprint for other in others)}
    keys.add(result_key(base.identity, hash_text("{}"), revision=-1))
    assert len(keys) == 5
    assert base.fingerprint == kept_result(1, scan=failed()).fingerprint
    # By SHA-256 of the name: another Python, or another start of it, gives the same.
    assert [shard_number(name, 8) for name in ("0001", "box1/0001", "Übersicht")] == [4, 7, 2]  # sha256sum's 8th byte
    counts = [sum(shard_number(str(n), 4) == k for n in range(4000)) for k in (1, 2, 3, 4)]
    assert min(counts) > 900


def test_the_identity_of_what_is_no_scan(tmp_path: Path) -> None:
    (tmp_path / "empty.tif").touch()
    (tmp_path / "text.tif").write_text("no picture")
    assert parts_hash(tmp_path / "none.tif") == content_hash(tmp_path / "none.tif") == ""
    assert parts_hash(tmp_path / "empty.tif") != parts_hash(tmp_path / "text.tif") != ""
    assert file_state(tmp_path / "none.tif", tmp_path).bytes == -1
    state = file_state(tmp_path / "text.tif", tmp_path / "project")
    assert (state.uri, state.bytes) == ("../text.tif", 10)


def test_a_store_in_a_folder_that_cannot_be_written_is_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ResultsDatabase(path) as database:
        row = database.keep(kept_result(3), "box/3")
    monkeypatch.setattr("pipeline.archive.schema.os.access", lambda *_: False)
    with ResultsDatabase(path) as database:
        assert database.scan(row, "box/3", FOLDER).frame.marks
        assert [file.name for file in path.parent.iterdir()] == [path.name]  # SQLite would put two files beside it
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            database.keep(kept_result(4), "box/4")


@pytest.mark.parametrize(
    "change", ["delete from judging", "update judging set digest = 'unfinished'", "update judging set id = 9"]
)
def test_a_judging_that_is_lost_is_not_taken_for_none(change: str, path: Path) -> None:
    """Else what each scan gave would stand for what all together say of it."""
    with ResultsDatabase(path) as database:
        row = database.keep(kept_result(1), "1")
        store_checks(database, {}, "a", [CheckedResult(row, LOOKED_AT)])
    with sqlite3.connect(path) as db:
        db.execute(change)
    with ResultsDatabase(path) as database:
        with pytest.raises(InputError, match=r"list of checked images is damaged.*measure --retry"):
            latest(database)
        database.forget_damaged()
        assert latest(database) is None
        assert stored(database, row) == content(made_record())
