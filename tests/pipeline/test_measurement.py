"""Scans are measured one by one, each by its own task, and their records are written and read back."""

import glob
import json
import os
import pickle
import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import MISSING, fields, is_dataclass, replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import tifffile
from drawn import pixel_from_camera
from in_process import Here, Loses
from loaded_script import script
from moto.server import ThreadedMotoServer
from projects import CAMERA, PLACES, PROJECT, Capture, Refusal, command, present, write_project, write_tables
from range_server import range_server

from measure.annotations.lines import Line, Reading
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from measure.scans import remote
from measure.tone.curve import Tone, ToneInformation, power, sampled_curve, srgb
from measure.tone.estimate import FrameTone
from measure.tone.sharpening import Sharpening
from pipeline import InputError, read_comparator, read_project
from pipeline.archive.scan_groups import Catalogue, catalogue
from pipeline.cli import LOOK
from pipeline.files.scan_files import find_scans, found_names
from pipeline.measuring import scan_measurement
from pipeline.measuring.scan_measurement import ended_scan, measured_scan
from pipeline.measuring.scan_task import ScanTask, sample_names, scan_tasks
from pipeline.provenance import file_state, parts_hash
from pipeline.results import measured_record
from pipeline.text.toml_tables import Table
from pipeline.workers import iterate_results

BOARD = '[targets]\nkind = "chessboard"\ncolumns = 5\nrows = 4\nsquare_mm = 10.0\n'
TARGETS = '[targets]\nkind = "disk"\ndiameter_mm = 30.0\n[object]\npoints = "points.csv"\nimages = "images.csv"\n'
POINTS = "point,X,Y,Z\n" + "".join(f"{k},{k % 3},{k // 3},{k % 2}\n" for k in range(9))
IMAGES = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg\na,0,0,9,0,0,0\nb,1,0,9,0,0,0\n"


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_project(tmp_path_factory.mktemp("two"), ["a", "b"])


def make_tasks(folder: Path, project: str = PROJECT, camera: str = CAMERA) -> tuple[ScanTask, ...]:
    """Of a project of two scans with these files; nothing is measured."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("a.tif", "b.tif"):
        (folder / name).touch()
    path = write_tables(folder, project, camera=camera, points=POINTS, images=IMAGES)
    return scan_tasks(read_project(path), ["a", "b"])


def test_scans_have_equal_options_unless_targets_are_sought(tmp_path: Path) -> None:
    a, b = make_tasks(tmp_path / "here")
    there, _ = make_tasks(tmp_path / "there")
    assert a.options.json == b.options.json == there.options.json
    assert pickle.loads(pickle.dumps(a)).options.json == a.options.json
    assert json.loads(a.options.json)
    assert (a.name, Path(a.scan).name) == ("a", "a.tif")
    a, b = make_tasks(tmp_path, PROJECT + TARGETS)
    longer, _ = make_tasks(tmp_path, PROJECT + TARGETS, CAMERA.replace("distance_mm = 30.0", "distance_mm = 31.0"))
    larger, _ = make_tasks(tmp_path, PROJECT + TARGETS.replace("30.0", "31.0"))
    assert len({task.options.json for task in (a, b, longer, larger)}) == 4
    assert b"points.csv" not in pickle.dumps(a)  # the project does not travel with it


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("camera", "ring_line_mm = 0.1", "ring_line_mm = 0.11"),
        ("camera", "xy_mm = [7.0,", "xy_mm = [7.001,"),
        ("camera", "sigma_mm = 0.01", "sigma_mm = 0.02"),
        ("camera", "[17.0, 17.0]", "[17.0, 17.5]"),
        ("camera", 'name = "K"', 'writing = ["left"]\nname = "K"'),
        ("project", "pitch_um = 50.0", "pitch_um = 50.1"),
        ("project", 'pose = "0"', 'pose = "90"'),
        ("project", 'tone = "linear"', "tone = 2.2"),
        ("project", 'pose = "0"', 'pose = "0"\nwriting = "all"'),
        ("project", 'tone = "linear"\n', 'tone = "linear"\n[adjust]\nfilm_sigma_um = 9.0\n'),
        ("project", 'tone = "linear"\n', f'tone = "linear"\n{BOARD}'),
    ],
)
def test_what_may_change_the_result_changes_the_options(file: str, old: str, new: str, tmp_path: Path) -> None:
    texts = {"project": PROJECT, "camera": CAMERA}
    before, after = make_tasks(tmp_path), make_tasks(tmp_path, **texts | {file: texts[file].replace(old, new)})
    assert before[0].options.json != after[0].options.json


def test_the_marks_of_another_camera_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "cameras.csv").write_text("image,camera\na,\nb,other.toml\n")
    tasks = []
    for line_mm in ("0.1", "0.12"):
        other = CAMERA.replace('"K"', '"L"').replace("line_mm = 0.1", f"line_mm = {line_mm}")
        (tmp_path / "other.toml").write_text(other)
        tasks.append(make_tasks(tmp_path, f'{PROJECT}[object]\nimages = "cameras.csv"\n'))
    before, after = tasks
    assert before[0].options.json == after[0].options.json
    assert before[1].options.json != after[1].options.json


def test_few_of_many_scans_are_the_same_when_another_one_comes() -> None:
    names = [f"roll/{number}" for number in range(60)]
    few = [sample_names(names[:count], 4) for count in range(10, 60)]
    assert all(len(each) == 4 and each == sorted(each, key=names.index) for each in few)
    assert sum(before != after for before, after in pairwise(few)) < 15  # 4 in so many, of each: 7 are to be expected
    assert sample_names(names[::-1], 4) == sample_names(names, 4)[::-1]
    assert sample_names(names[:3], 4) == names[:3]


def measure_tasks(
    tasks: Iterable[ScanTask], executor: Executor, in_flight: int = 4
) -> Iterator[measured_record.MeasuredScan]:
    for task, result in iterate_results(measured_scan, tasks, executor, in_flight):
        yield ended_scan(task, result) if isinstance(result, Exception) else result


def test_results_come_one_by_one_and_few_tasks_are_handed_out_at_a_time(two: Path) -> None:
    a, _ = scan_tasks(read_project(two), ["a", "b"])
    lost = replace(a, scan="nowhere.tif")
    requests: list[int] = []

    def tasks() -> Iterator[ScanTask]:
        for number in range(20):
            requests.append(number)
            yield replace(lost, name=str(number))

    results = measure_tasks(tasks(), Here(), in_flight=3)
    first = next(results)
    assert first.failure is not None
    assert len(requests) == 3
    four = [first, *(next(results) for _ in range(3))]
    assert len(requests) == 6
    assert {scan.frame.image for scan in (*four, *results)} == {str(number) for number in range(20)}


def test_a_scan_whose_process_ends_is_a_result(two: Path) -> None:
    project = read_project(two)
    tasks = scan_tasks(project, ["a", "b"])
    results = {scan.frame.image: scan for scan in measure_tasks(tasks, Loses(lambda _, given: given[0].name == "b"))}
    assert results["a"].failure is None
    assert present(results["b"].failure).code is measured_record.FailureCode.ENDED
    assert "was ended, most likely because the memory was full" in present(results["b"].failure).sentence


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), "memory", "the memory was full"),
        (ZeroDivisionError("by nothing"), "fault", "ZeroDivisionError: by nothing"),
    ],
)
def test_failed_scans(two: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: str, words: str) -> None:
    monkeypatch.setattr(scan_measurement, "measure_fiducials", Mock(side_effect=error))
    scan = measured_scan(scan_tasks(read_project(two), ["a"])[0])
    assert present(scan.failure).code == code
    assert words in present(scan.failure).sentence
    assert [(mark.point, mark.status) for mark in scan.frame.marks] == [(id, Status.ABSENT) for id in "1234"]


def test_a_failed_scan_has_a_row_for_each_target(tmp_path: Path) -> None:
    a, _ = make_tasks(tmp_path, PROJECT + BOARD)
    scan = measured_scan(a)  # an empty file
    assert present(scan.failure).code is measured_record.FailureCode.UNREADABLE
    kinds = [mark.kind for mark in scan.frame.marks]
    assert (kinds.count("fiducial"), kinds.count("target")) == (4, 20)


def test_a_scan_refused_for_its_size_says_how_to_allow_it(tmp_path: Path, refusal: Refusal) -> None:
    project = write_project(tmp_path, ["a", "b"])
    shutil.copy(tmp_path / "a.tif", tmp_path / "c.tif")
    assert "--max-pixels" in refusal("measure", project, "--max-pixels", "1000")
    (task,) = scan_tasks(replace(read_project(project), max_pixels=1000), ["a"])
    failed: measured_record.MeasuredScan = measured_scan(task)
    assert present(failed.failure).code is measured_record.FailureCode.TOO_LARGE
    assert task.options.json == scan_tasks(read_project(project), ["a"])[0].options.json
    assert os.path.samefile(failed.scan, tmp_path / "a.tif")


def test_no_module_is_entered_again_from_one_that_it_has_called() -> None:
    calls = script(Path(__file__).parents[2] / "benchmarks" / "trip.py").followed()
    assert {"measure.fiducials.measurement", "pipeline.measuring.roll"} <= set(calls.order)
    assert not calls.again


RNG = np.random.default_rng(5)
SHARPENED = Sharpening(1 / 3, 0.7, RNG.normal(size=(2, 2)))
RECORD_SAID = ToneInformation(RNG.normal(size=(5, 5)), RNG.normal(size=5), 3.3, 17, 0.2, SHARPENED)
CURVE = sampled_curve(np.linspace(0.0, 1.0, 50) ** 1.7 + 0.01 * np.linspace(0.0, 1.0, 50))
TONE = FrameTone(
    Tone(CURVE, RNG.normal(size=5), RNG.normal(size=(5, 5)), "its profile", True, sharpening=SHARPENED),
    RECORD_SAID,
    0.1,
    0.7,
    1.9,
    0.4,
    is_determined=True,
)
LINE = Line(
    {"90m": Reading("RUN 7", 0.93, 4.6), "270m": Reading("L NNꓤ", 1 / 3, 1.1)},
    "90m",
    ((10.0, 20.5), (50.0, 20.25), (50.0, 30.0), (10.1, 30.0)),
    "left",
)
MARK = MarkMeasurement(
    "7a",
    "target",
    np.array([1234.5678901234567, 1 / 3]),
    Covariance({Cause.NOISE: RNG.normal(size=(2, 2)), Cause.TONE: np.array([[np.inf, 0.0], [0.0, 1e-300]])}),
    Status.WEAK,
    Reason("dusty; large", Code.DUST, Code.SIZE),
    {"snr": np.inf, "drift": -np.inf, "likeness": np.nan, "blur_px": 0.1 + 0.2},
)
RICH = measured_record.MeasuredScan(
    "/scans/roll 7/a.tif",
    4001,
    3002,
    (20.1, 1 / 7),
    FrameMeasurement(
        "roll 7/a",
        (MARK, MarkMeasurement("8", "fiducial", None, None, Status.ABSENT, Reason("not found", Code.NOT_FOUND))),
        ScanOrientation(
            "90m", True, ("this", "and that"), {"0": -3.25, "90m": 1 / 3}, "180", "one question", ("0", "90")
        ),
        RNG.normal(size=(2, 3)),
        (Reason("look here", Code.PITCH),),
        (0.25, 1 / 3, -0.1),
        TONE,
        (LINE,),
        ("a note on the frame",),
    ),
    ("a note",),
    measured_record.Failure(measured_record.FailureCode.ENDED, "it was ended"),
)


def again(scan: measured_record.MeasuredScan, folder: Path = Path("/out")) -> measured_record.MeasuredScan:
    text = json.dumps(measured_record.scan_detail(scan, "../scans/roll 7/a.tif"), allow_nan=False)
    marks = [measured_record.mark_row(mark) for mark in scan.frame.marks]
    detail = json.loads(text)
    return measured_record.read_scan(
        scan.frame.image, detail, marks, measured_record.scan_location(detail["scan"], folder)
    )


def test_causes_that_only_earlier_versions_know_count_as_noise() -> None:
    """They stand in their databases, which are read until the scans are measured again."""
    mark = RICH.frame.marks[0]
    assert mark.covariance is not None
    row = list(measured_record.mark_row(mark))
    causes = json.loads(str(row[7]))
    causes["of"] |= {"rounding": [[1.0, 0.0], [0.0, 2.0]], "second order": [[0.5, 0.0], [0.0, 0.5]]}
    row[7] = json.dumps(causes)
    covariance = present(measured_record._read_mark(row).covariance)
    np.testing.assert_allclose(covariance.px2, mark.covariance.px2 + np.diag([1.5, 2.5]))
    assert {str(cause) for cause in covariance.parts} <= {"noise", *map(str, mark.covariance.parts)}


def leaves(value: Any, where: str = "scan") -> Iterator[tuple[str, object]]:
    """Every value in it, with its place and type; numbers to the last bit."""
    if isinstance(value, np.ndarray):
        yield where, (str(value.dtype), value.tolist().__repr__())
    elif isinstance(value, Reason):
        yield where, (str(value), value.codes)
    elif is_dataclass(value):
        yield where, type(value)
        for each in fields(value):
            if each.compare or is_dataclass(getattr(value, each.name)):
                yield from leaves(getattr(value, each.name), f"{where}.{each.name}")
    elif isinstance(value, Mapping):
        for key in value:
            yield from leaves(value[key], f"{where}[{key}]")
    elif isinstance(value, tuple):
        yield where, len(value)
        for index, each in enumerate(value):
            yield from leaves(each, f"{where}[{index}]")
    else:
        yield where, repr(value)


def left_out(value: Any, where: str = "scan") -> list[str]:
    """The fields of the value that have their default, as one would that nobody thought of."""
    if isinstance(value, tuple):
        return [name for each in value[:1] for name in left_out(each, where)]
    if not is_dataclass(value) or isinstance(value, type):
        return []
    found = []
    for each in fields(value):
        given, default = getattr(value, each.name), each.default
        if each.compare and default is not MISSING and not isinstance(given, np.ndarray) and given == default:
            found.append(f"{where}.{each.name}")
        found += left_out(given, f"{where}.{each.name}")
    return found


def test_every_field_comes_back() -> None:
    assert not left_out(RICH)
    relative = replace(RICH, scan="/out/../scans/roll 7/a.tif")
    assert list(leaves(again(RICH))) == list(leaves(relative))
    empty = measured_record.MeasuredScan("/scans/a.tif", 1, 1, (1.0, 2.0), FrameMeasurement("a", ()))
    assert list(leaves(replace(again(empty), scan=empty.scan))) == list(leaves(empty))


@pytest.mark.parametrize("base", [power(1.0), power(1.6), power(1 / 2.2), srgb(), CURVE])
def test_a_curve_comes_back_by_its_name_or_its_numbers(base: np.ndarray) -> None:
    frame = replace(RICH.frame, tone=FrameTone(Tone(base)))
    assert list(leaves(again(replace(RICH, frame=frame)).frame.tone)) == list(leaves(frame.tone))


FILES = ("1.tif", "a/2.tif", "a/b/3.tif", ".hidden/4.tif", ".5.tif")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in FILES:
        path = tmp_path / "scans" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


def find_scans_case(folder: Path, *patterns: str, exclude: tuple[str, ...] = ()) -> list[str]:
    files = find_scans(Table({}, folder / "project.toml", ""), patterns, exclude)[0].values()
    return sorted(os.path.relpath(file, folder) for file in files)


@pytest.mark.parametrize(
    "pattern",
    ["scans/**", "scans/**/*.tif", "**/*.tif", "**/a/**/*.tif", "scans/**/b/*", "scans/**/", "./scans/**/3.tif"],
)
def test_any_number_of_folders_is_as_in_glob(folder: Path, pattern: str) -> None:
    def files(names: set[str]) -> set[str]:
        return {os.path.normpath(name) for name in names if (folder / name).is_file()}

    assert files(found_names(pattern, folder)) == files(set(glob.glob(pattern, root_dir=folder, recursive=True)))


def test_links_to_parents_bring_nothing_twice(folder: Path) -> None:
    """Two links up make glob follow 2^40 paths; here the folder beside the scans is not theirs either."""
    (folder / "others").mkdir()
    (folder / "others" / "6.tif").touch()
    for name, target in {"up": "..", "a/again": "../a", "a/b/top": str(folder / "scans")}.items():
        (folder / "scans" / name).symlink_to(target)
    assert find_scans_case(folder, "scans/**/*.tif") == ["scans/1.tif", "scans/a/2.tif", "scans/a/b/3.tif"]
    files = catalogue([folder / "scans"], lambda *_: None).unread
    assert len(files) == 3  # empty files, which no scan is


def test_a_file_is_one_scan_however_many_links_lead_to_it(folder: Path) -> None:
    (folder / "others").mkdir()
    (folder / "others" / "6.tif").touch()
    scans = folder / "scans"
    (scans / "elsewhere").symlink_to(folder / "others")
    (scans / "0.tif").symlink_to("1.tif")
    (scans / "twin").symlink_to("a")
    there = ["scans/1.tif", "scans/a/2.tif", "scans/a/b/3.tif", "scans/elsewhere/6.tif"]
    assert find_scans_case(folder, "scans/**/*.tif", "scans/twin/*.tif", "scans/*.tif") == there
    assert find_scans_case(folder, "scans/**/*.tif", exclude=("scans/twin/2.tif",)) == [there[0], *there[2:]]
    assert find_scans_case(folder, "scans/0.tif") == ["scans/0.tif"]  # named as it is
    (folder / "scans" / "7.tif").symlink_to("nowhere.tif")
    assert "scans/7.tif" in find_scans_case(folder, "scans/**/*.tif")


@pytest.fixture(scope="module")
def roll(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of one TIFF: its first page shows frames a and b side by side, its second one b alone."""
    folder = tmp_path_factory.mktemp("roll")
    write_project(folder, ["a", "b"], PROJECT.replace('tone = "linear"', 'writing = "none"'))
    one, two = (tifffile.imread(folder / f"{name}.tif") for name in "ab")
    for file in folder.glob("*.tif"):
        file.unlink()
    with tifffile.TiffWriter(folder / "roll.tif") as writer:
        writer.write(np.hstack([one, two]), metadata=None)
        writer.write(two, metadata=None)
    return folder


def test_what_a_scan_shows_next_to_the_frame_that_was_measured_needs_attention(roll: Path) -> None:
    scan = measured_scan(scan_tasks(read_project(roll / "project.toml"), ["roll"])[0])
    finding = " ".join(scan.frame.problems)
    assert "2 pictures of full size (pages 1, 2), and page 1 was measured" in finding
    assert "shows a second frame" in finding or "shows another frame" in finding
    assert "in images.csv" in finding
    assert any("estimated from the edges of marks" in note for note in scan.notes)  # the tone curve, not given here


def test_pages_and_windows_are_images_of_their_own(roll: Path, capsys: Capture, refusal: Refusal) -> None:
    """Their neighbours are in no rectified scan: the second page shows the second frame alone."""
    height, width = tifffile.imread(roll / "roll.tif", key=1).shape
    whole = roll / "whole.toml"
    whole.write_text((roll / "project.toml").read_text() + '[object]\nimages = "images.csv"\n')
    lines = [f"roll-a,1,0 0 {width} {height}", f"roll-b,1,{width} 0 {width} {height}", "roll-c,2,"]
    (roll / "images.csv").write_text("\n".join(["image,page,window", *lines]) + "\n")
    assert command("measure", whole) in (0, LOOK)
    rows = {(row.image, row.point): row for row in read_comparator(roll / "comparator.csv")}
    assert len(rows) == 3 * 4
    for image, number, shift_px in (("roll-a", 1, 0), ("roll-b", 2, width), ("roll-c", 2, 0)):
        for id, place in PLACES.items():
            row = rows[image, id]
            assert row.status is Status.MEASURED
            drawn = pixel_from_camera("0", 0.004 * number) @ (*place, 1.0) + (shift_px, 0.0)
            np.testing.assert_allclose(np.asarray(row.xy_mm) / 0.05 * (1, -1), drawn, atol=0.1)
    output = capsys.readouterr().out
    assert "second frame" not in output
    assert "pictures of full size" not in output
    assert command("resample", whole, roll / "frames", "--pitch-um", "50") in (0, LOOK)
    first, second, alone = (tifffile.imread(roll / "frames" / f"roll-{name}.tif") for name in "abc")
    assert second.shape == alone.shape
    middle = np.s_[10:-10, 10:-10]
    assert np.abs(second[middle].astype(float) - alone[middle]).max() < 0.02 * np.ptp(alone)
    assert max(np.subtract(first.shape, alone.shape)) < 8
    (roll / "images.csv").write_text("image,window\nother,0 0 10 10\n")
    assert "no scan is called as it begins" in refusal("measure", whole)
    (roll / "images.csv").write_text("image,window\nroll,0 0 0 10\n")
    assert '"col row width height" in px' in refusal("measure", whole)


@pytest.fixture(scope="module")
def store() -> Iterator[Any]:
    """A client of a store that runs here, with empty buckets."""
    boto3, fsspec = import_module("boto3"), import_module("fsspec")
    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        for name, value in {"ACCESS_KEY_ID": "t", "SECRET_ACCESS_KEY": "t", "DEFAULT_REGION": "us-east-1"}.items():
            patch.setenv(f"AWS_{name}", value)
        fsspec.get_filesystem_class("s3").clear_instance_cache()
        client = boto3.client("s3")
        for bucket in ("prints", "boxes"):
            client.create_bucket(Bucket=bucket)
        yield client
    server.stop()


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_project(tmp_path_factory.mktemp("local"), ["a", "b"]).parent


def write_scan_project(folder: Path, scans: str) -> Path:
    write_project(folder, [], PROJECT.replace('"*.tif"', scans))
    return folder


def test_names_are_paths_and_contents_tell_copies(store: Any, local: Path, tmp_path: Path) -> None:
    for key, name in (("box/1/a.tif", "a"), ("box/2/a.tif", "b"), ("box/2/copy.tif", "b"), ("box/2/a.txt", "a")):
        store.upload_file(str(local / f"{name}.tif"), "prints", key)
    scans = read_project(write_scan_project(tmp_path, '"s3://prints/box/**/*.tif"') / "project.toml").scans
    assert {name: str(path) for name, path in scans.items()} == {
        "1/a": "s3://prints/box/1/a.tif",
        "2/a": "s3://prints/box/2/a.tif",
        "2/copy": "s3://prints/box/2/copy.tif",
    }
    states = {name: file_state(path, tmp_path) for name, path in scans.items()}
    assert states["2/a"].uri == "s3://prints/box/2/a.tif"
    assert states["2/a"].bytes == (local / "b.tif").stat().st_size
    assert states["2/a"].etag
    hashes = {name: parts_hash(path) for name, path in scans.items()}
    assert hashes["2/a"] == hashes["2/copy"] != hashes["1/a"]


def test_init_of_a_bucket(store: Any, local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, key in (("a", "1952/a.tif"), ("b", "1952/sub/b.tif"), ("b", "1952/sub/copy.tif")):
        store.put_object(Bucket="boxes", Key=key, Body=(local / f"{name}.tif").read_bytes())
    store.put_object(Bucket="boxes", Key="1952/broken.tif", Body=b"no scan")
    store.put_object(Bucket="boxes", Key="1952/notes.txt", Body=b"by hand")

    def unnamed(grouped: Catalogue, *_: Any) -> Catalogue:
        return grouped

    monkeypatch.setattr("pipeline.archive.scan_groups.name_cameras", unnamed)
    assert command("init", "s3://boxes/1952/", "--out", tmp_path) == 1
    text = (tmp_path / "project.toml").read_text()
    assert 'scans = ["s3://boxes/1952/**/*.tif"]' in text
    assert '# camera = "camera.toml"' in text  # which there is not yet
    (tmp_path / "project.toml").write_text(text.replace('# camera = "camera.toml"', 'camera = "camera.toml"'))
    (tmp_path / "camera.toml").write_text((local / "camera.toml").read_text())
    scans = read_project(tmp_path / "project.toml").scans
    assert {name: str(path) for name, path in scans.items()} == {
        "a": "s3://boxes/1952/a.tif",
        "sub/b": "s3://boxes/1952/sub/b.tif",
    }
    assert command("init", "s3://nowhere/", "--out", tmp_path / "q") == 2


def test_a_bucket_without_scans_and_one_that_is_not_there(store: Any, tmp_path: Path) -> None:
    for pattern in ("s3://prints/nowhere/*.tif", "s3://no-such-bucket/*.tif"):
        with pytest.raises(InputError, match=r"scans.*finds no object.*Check the bucket|there is no s3://no-such"):
            read_project(write_scan_project(tmp_path, f'"{pattern}"') / "project.toml")


def test_a_closed_address(local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(remote, "_WAITS_S", (0.01,))
    with range_server(local) as server:
        folder = write_scan_project(tmp_path, f'"{server.url}/a.tif", "{server.url}/closed/b.tif"')
        assert command("measure", folder / "project.toml", "--workers", "1") == 1
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        query = "select scan.name, detail ->> '$.failure.code' from result join scan on scan.id = result.scan"
        codes = dict(db.execute(query))
    assert codes == {"a": None, "closed/b": "unreachable"}
    assert "forbids to read it (403)" in capsys.readouterr().err


@pytest.mark.study
def test_credentials_stay_secret(local: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """By two processes, which are given them. Another signature is the same scan; a wrong one is told without it."""
    monkeypatch.setattr(remote, "_WAITS_S", (0.01,))
    with range_server(local) as server:
        for signature, left in (("s3cr3t1", ": 2 of 2"), ("s3cr3t2", " (2 stored already)"), ("s3cr3t3", "")):
            server.signature = "s3cr3t2" if signature == "s3cr3t3" else signature
            url, query = server.url.replace("://", "://ann:hunter2@"), f"X-Amz-Date=1&X-Amz-Signature={signature}"
            folder = write_scan_project(tmp_path / "p", f'"{url}/a.tif?{query}", "{url}/b.tif?{query}"')
            code = command("measure", folder / "project.toml", "--workers", "2")
            captured = capsys.readouterr()
            assert f"scans measured{left}" in captured.err or not left
            assert code == (0 if left else 2)  # where no scan can be read
            command("report", folder / "project.toml")
            command("status", folder / "project.toml", "--csv")
            after = capsys.readouterr()
            result = [captured.out, captured.err, after.out, after.err]
            result += [path.read_bytes().decode("latin-1") for path in folder.rglob("*") if path.is_file()]
            result = [text for text in result if "scans = [" not in text]  # the user's own file
            for secret in ("s3cr3t", "hunter2", "ann:"):
                assert not [text for text in result if secret in text], secret
    assert {mark.image for mark in read_comparator(folder / "comparator.csv")} == {"a", "b"}


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("https://ann:pw@h.org/a.tif", "https://h.org/a.tif"),
        ("https://h.org/a.tif?X-Amz-Signature=1/2&X-Amz-Date=3", "https://h.org/a.tif"),
        ("https://h.org/a.tif?sv=1&sig=a%2Fb", "https://h.org/a.tif"),
        ("s3://key:secret@prints/a.tif", "s3://prints/a.tif"),
        ("HTTPS://h.org/a.tif#x", "https://h.org/a.tif"),
        ("scans/a@b?c.tif", "scans/a@b?c.tif"),
    ],
)
def test_what_is_shown_of_an_address(address: str, shown: str) -> None:
    assert remote.public_address(address) == shown
    assert remote.fetch_location(remote.scan_path(address)) == (address if "://" in address else shown)


def test_queries_that_tell_scans_apart_are_kept_and_no_text_shows_a_secret() -> None:
    one, two, again = (f"https://h.org/get?id={k}&token={token}" for k, token in ((1, "a"), (2, "a"), (1, "b")))
    assert remote.public_address(one) == remote.public_address(again) != remote.public_address(two)
    result = "'htps://ann:pw@h.org/a.tif?token=1' finds no file: /x/htps:/ann:pw@h.org/a.tif, tcp://host:8786"
    assert remote.public_text(result) == "'htps://h.org/a.tif' finds no file: /x/htps:/h.org/a.tif, tcp://host:8786"
