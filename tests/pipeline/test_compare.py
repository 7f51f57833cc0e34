"""`reseau compare`, from files: a camera that has not changed, one that has, and what it refuses."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from pipeline.adjusting.compare_stage import _labels
from pipeline.cli import run
from pipeline.provenance import hash_file
from pipeline.results.comparison_file import read_comparison
from pipeline.results.record_json import plain_json

SVG = "{http://www.w3.org/2000/svg}"


def shift_parameter(project: Path, name: str, change_mm: float) -> Path:
    """A copy of the project's calibration whose principal distance is another."""
    copy = project.parent / name / "adjustment.json"
    copy.parent.mkdir()
    content = json.loads((project / "out" / "adjustment.json").read_text(encoding="utf-8"))
    (camera,) = content["cameras"].values()
    camera["principal_distance_mm"]["value"] += change_mm
    copy.write_text(json.dumps(content), encoding="utf-8")
    with np.load(project / "out" / "adjustment.npz") as arrays:
        whole = dict(arrays)
    whole["fingerprint"] = np.array(hash_file(copy))
    whole["values"] = whole["values"] + change_mm * np.char.endswith(whole["names"], ".c")
    np.savez(copy.with_suffix(".npz"), **whole)
    return copy


def test_an_unchanged_camera_and_a_changed_one(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = project / "out" / "adjustment.json"
    assert run(["compare", str(first), str(shift_parameter(project, "same", 0.0))]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert output.startswith("no drift ")
    assert "same less out" in output
    assert "were adjusted from the same measured marks: they are not independent" in output
    out = project / "compared"
    assert run(["compare", str(first), str(shift_parameter(project, "later", 0.5)), "--out", str(out)]) == 1
    output = capsys.readouterr().out
    assert output.startswith("drift\n")
    (largest,) = re.findall(r"Fiducial marks after a similarity: at most ([\d.]+) µm", output)
    assert float(largest) < 0.2  # of their 0.3 um: c and the marks are hardly tied
    drawn = ElementTree.parse(out / "compare.svg").getroot()
    assert len(drawn.findall(f".//{SVG}ellipse")) == 49  # one a place of the field
    content = json.loads((out / "compare.json").read_text(encoding="utf-8"))
    assert plain_json(read_comparison(out / "compare.json")) == content
    (difference,) = content["differences"]
    corner = np.array(difference["field_um"])[np.abs(content["places_mm"]).sum(axis=1).argmax()]
    assert content["verdict"] == "drift"
    # A ray at 25 mm of 60 moves by 0.5 / 60 of that, less what a change of the point or the lens would not take up.
    assert np.hypot(*corner) == pytest.approx(np.hypot(25.0, 25.0) * 0.5 / 60.3 * 1e3, rel=0.1)


def test_a_series_has_a_trend(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(shift_parameter(project, f"y{year}", 0.02 * (year - 1950))) for year in (1952, 1958, 1961, 1970)]
    assert run(["compare", *paths, "--times", "1952,1958,1961,1970", "--json"]) == 1
    content = json.loads(capsys.readouterr().out)
    assert content["trend"]["probability"] < 1e-6
    assert content["probability"] <= 2 * content["trend"]["probability"]
    corner = np.array(content["trend_um"])[np.abs(content["places_mm"]).sum(axis=1).argmax()]
    assert np.hypot(*corner) == pytest.approx(np.hypot(25.0, 25.0) * 0.36 / 60.3 * 1e3, rel=0.1)  # over 18 years
    assert [each["time"] for each in content["calibrations"]] == [1952.0, 1958.0, 1961.0, 1970.0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--camera", "metric 6 x 7"], "holds no camera 'metric 6 x 7'"),
        (["--times", "1952;1958"], "are not numbers with commas"),
        (["--times", "1958,1952"], "in rising order"),
    ],
)
def test_what_it_refuses(arguments: list[str], words: str, project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(project / "out" / "adjustment.json"), str(shift_parameter(project, "same", 0.0))]
    assert run(["compare", *paths, *arguments]) == 2
    assert words in capsys.readouterr().err.replace("\n", " ")


def test_the_covariance_of_another_adjustment_is_refused(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = shift_parameter(project, "other", 0.1)
    other.with_suffix(".npz").write_bytes((project / "out" / "adjustment.npz").read_bytes())
    assert run(["compare", str(project / "out" / "adjustment.json"), str(other)]) == 2
    assert "is of another adjustment than" in capsys.readouterr().err.replace("\n", " ")


def test_a_file_named_twice_is_refused(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(project / "out" / "adjustment.json")
    assert run(["compare", path, path]) == 2
    assert "is named twice" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("files", "labels"),
    [
        (("a/out/adjustment.json", "b/out/adjustment.json"), ["a", "b"]),
        (("1952/adjustment.json", "1959/adjustment.json"), ["1952", "1959"]),
        (("a/x/adjustment.json", "b/x/adjustment.json", "b/y/adjustment.json"), ["a/x", "b/x", "b/y"]),
        (("out/1952.json", "out/1959.json"), ["1952", "1959"]),
    ],
)
def test_calibrations_are_named_by_what_differs_in_their_paths(files: tuple[str, ...], labels: list[str]) -> None:
    assert _labels([Path(file) for file in files]) == labels
