"""Scans are measured one by one, each by its own task, and their records are written and read back."""

import json
import os
import pickle
import shutil
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import MISSING, fields, is_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import tifffile
from in_process import Here, Loses
from loaded_script import script
from projects import CAMERA, PROJECT, Refusal, present, write_project, write_tables

from measure.annotations.lines import Line, Reading
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose
from measure.tone.curve import Tone, ToneInformation, power, sampled_curve, srgb
from measure.tone.estimate import FrameTone
from measure.tone.sharpening import Sharpening
from pipeline import read_project
from pipeline.measuring import scan_measurement
from pipeline.measuring.scan_measurement import ended_scan, measured_scan
from pipeline.measuring.scan_task import ScanTask, sample_names, scan_tasks
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
        ("project", 'pose = "0"', 'pose = "0"\ntone = 2.2'),
        ("project", 'pose = "0"', 'pose = "0"\nwriting = "all"'),
        ("project", 'pose = "0"\n', 'pose = "0"\n[adjust]\nfilm_sigma_um = 9.0\n'),
        ("project", 'pose = "0"\n', f'pose = "0"\n{BOARD}'),
    ],
)
def test_what_may_change_the_result_changes_the_options(file: str, old: str, new: str, tmp_path: Path) -> None:
    texts = {"project": PROJECT, "camera": CAMERA}
    before, after = make_tasks(tmp_path), make_tasks(tmp_path, **texts | {file: texts[file].replace(old, new)})
    assert before[0].options.json != after[0].options.json


def test_the_marks_of_another_camera_do_not_count(tmp_path: Path) -> None:
    (tmp_path / "cameras.csv").write_text("image,camera\na,\nb,other.toml\n", encoding="utf-8")
    tasks = []
    for line_mm in ("0.1", "0.12"):
        other = CAMERA.replace('"K"', '"L"').replace("line_mm = 0.1", f"line_mm = {line_mm}")
        (tmp_path / "other.toml").write_text(other, encoding="utf-8")
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


def measure_tasks(tasks: Iterable[ScanTask], executor: Executor, in_flight: int = 4) -> Iterator[MeasuredScan]:
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
    assert present(results["b"].failure).code is FailureCode.ENDED
    assert "was ended, most likely because the memory was full" in present(results["b"].failure).sentence


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), "memory", "the memory was full"),
        (ZeroDivisionError("by nothing"), "fault", "ZeroDivisionError: by nothing"),
    ],
)
def test_failures_are_results(
    two: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: str, words: str
) -> None:
    monkeypatch.setattr(scan_measurement, "measure_fiducials", Mock(side_effect=error))
    scan = measured_scan(scan_tasks(read_project(two), ["a"])[0])
    assert present(scan.failure).code == code
    assert words in present(scan.failure).sentence
    assert [(mark.point, mark.status) for mark in scan.frame.marks] == [(id, Status.ABSENT) for id in "1234"]


def test_a_thresholded_scan_is_refused(tmp_path: Path) -> None:
    project = write_project(tmp_path, ["a"])
    grey = tifffile.imread(tmp_path / "a.tif")
    tifffile.imwrite(tmp_path / "a.tif", 255 * (grey > np.median(grey)).astype(np.uint8))
    scan = measured_scan(scan_tasks(read_project(project), ["a"])[0])
    assert "has black and white pixels only" in present(scan.failure).sentence


def test_a_failed_scan_has_a_row_for_each_target(tmp_path: Path) -> None:
    a, _ = make_tasks(tmp_path, PROJECT + BOARD)
    scan = measured_scan(a)  # an empty file
    assert present(scan.failure).code is FailureCode.UNREADABLE
    kinds = [mark.kind for mark in scan.frame.marks]
    assert (kinds.count("fiducial"), kinds.count("target")) == (4, 20)


def test_a_scan_refused_for_its_size_says_how_to_allow_it(tmp_path: Path, refusal: Refusal) -> None:
    project = write_project(tmp_path, ["a", "b"])
    shutil.copy(tmp_path / "a.tif", tmp_path / "c.tif")
    assert "--max-pixels" in refusal("measure", project, "--max-pixels", "1000")
    (task,) = scan_tasks(replace(read_project(project), max_pixels=1000), ["a"])
    failed: MeasuredScan = measured_scan(task)
    assert present(failed.failure).code is FailureCode.TOO_LARGE
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
    {"snr": np.inf, "drift": -np.inf, "second_method_sigmas": np.nan, "blur_px": 0.1 + 0.2},
)
RICH = MeasuredScan(
    "/scans/roll 7/a.tif",
    4001,
    3002,
    (20.1, 1 / 7),
    FrameMeasurement(
        "roll 7/a",
        (MARK, MarkMeasurement("8", "fiducial", None, None, Status.ABSENT, Reason("not found", Code.NOT_FOUND))),
        Pose("90m", True, ("this", "and that"), {"0": -3.25, "90m": 1 / 3}, "180", "one question", ("0", "90")),
        RNG.normal(size=(2, 3)),
        (Reason("look here", Code.PITCH),),
        (0.25, 1 / 3, -0.1),
        TONE,
        (LINE,),
        ("a note on the frame",),
    ),
    ("a note",),
    Failure(FailureCode.ENDED, "it was ended"),
)


def again(scan: MeasuredScan, folder: Path = Path("/out")) -> MeasuredScan:
    text = json.dumps(scan_detail(scan, "../scans/roll 7/a.tif"), allow_nan=False)
    marks = [read_mark_row(mark_row(mark)) for mark in scan.frame.marks]
    detail = json.loads(text)
    return read_scan(scan.frame.image, detail, marks, scan_location(detail["scan"], folder))


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
    empty = MeasuredScan("/scans/a.tif", 1, 1, (1.0, 2.0), FrameMeasurement("a", ()))
    assert list(leaves(replace(again(empty), scan=empty.scan))) == list(leaves(empty))


@pytest.mark.parametrize("base", [power(1.0), power(1.6), power(1 / 2.2), srgb(), CURVE])
def test_a_curve_comes_back_by_its_name_or_its_numbers(base: np.ndarray) -> None:
    frame = replace(RICH.frame, tone=FrameTone(Tone(base)))
    assert list(leaves(again(replace(RICH, frame=frame)).frame.tone)) == list(leaves(frame.tone))
