"""What one scan gave is written as JSON and read back, every field of it, to the last bit."""

import json
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_project import PROJECT, write_project
from single_scans import measure_scan

from measure.annotations.fields import Line, Reading
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose
from measure.tone.curve import Tone, ToneInformation, power, sampled_curve, srgb
from measure.tone.estimate import FrameTone
from measure.tone.sharpening import Sharpening
from pipeline.files.project_file import read_project
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

RNG = np.random.default_rng(5)
SHARPENED = Sharpening(1 / 3, 0.7, RNG.normal(size=(2, 2)))
SAID = ToneInformation(RNG.normal(size=(5, 5)), RNG.normal(size=5), 3.3, 17, 0.2, SHARPENED)
CURVE = sampled_curve(np.linspace(0.0, 1.0, 50) ** 1.7 + 0.01 * np.linspace(0.0, 1.0, 50))
TONE = FrameTone(
    Tone(CURVE, RNG.normal(size=5), RNG.normal(size=(5, 5)), "its profile", True, sharpening=SHARPENED),
    SAID,
    0.1,
    0.7,
    1.9,
    0.4,
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
    ),
    ("a note",),
    Failure(FailureCode.ENDED, "it was ended"),
)


def again(scan: MeasuredScan, folder: Path = Path("/out")) -> MeasuredScan:
    text = json.dumps(scan_detail(scan, "../scans/roll 7/a.tif"), allow_nan=False)
    marks = [read_mark_row(mark_row(mark)) for mark in scan.frame.marks]
    detail = json.loads(text)
    return read_scan(scan.frame.image, detail, marks, scan_location(detail["scan"], folder))


def same(one: Any, other: Any, where: str = "scan") -> None:
    """Of one type and equal in every field, numbers to the last bit."""
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray), where
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, where)
    elif isinstance(one, Reason):
        assert isinstance(other, Reason), where
        assert (one, one.codes) == (other, other.codes), where
    elif is_dataclass(one):
        assert type(one) is type(other), where
        for each in fields(one):
            if each.compare or is_dataclass(getattr(one, each.name)):
                same(getattr(one, each.name), getattr(other, each.name), f"{where}.{each.name}")
    elif isinstance(one, Mapping):
        assert list(one) == list(other), where
        for key in one:
            same(one[key], other[key], f"{where}[{key}]")
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            same(a, b, f"{where}[{index}]")
    else:
        assert isinstance(other, type(one)) or isinstance(one, type(other)), where
        assert one == other or (one != one and other != other), where


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
    same(relative, again(RICH))


def test_what_was_measured_in_drawn_frames_comes_back(tmp_path: Path) -> None:
    project = read_project(write_project(tmp_path, ["a"], PROJECT.replace('pose = "0"', 'pose = "auto"')))
    scan = measure_scan(project, "a")
    assert scan.frame.tone is not None
    assert any(mark.covariance for mark in scan.frame.marks)
    same(scan, replace(again(scan), scan=scan.scan))
    assert len(json.dumps(scan_detail(scan, ""))) + sum(len(str(mark_row(mark))) for mark in scan.frame.marks) < 12000


@pytest.mark.parametrize("base", [power(1.0), power(1.6), power(1 / 2.2), srgb(), CURVE])
def test_a_curve_comes_back_by_its_name_or_its_numbers(base: np.ndarray) -> None:
    frame = replace(RICH.frame, tone=FrameTone(Tone(base)))
    same(frame.tone, again(replace(RICH, frame=frame)).frame.tone)


@pytest.mark.parametrize("scan", ["s3://prints/1952/0001.tif", "https://example.org/a.tif", ""])
def test_addresses_stay_as_they_are(scan: str) -> None:
    assert scan_location(scan, Path("/out")) == scan


def test_what_has_nothing_of_it_comes_back_too() -> None:
    empty = MeasuredScan("/scans/a.tif", 1, 1, (1.0, 2.0), FrameMeasurement("a", ()))
    same(empty, replace(again(empty), scan=empty.scan))
