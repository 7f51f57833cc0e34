"""docs/how-to/python.md: its example runs as it stands, in a folder with the demonstration in it."""

import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

import adjust
import measure
import pipeline

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "python.md"


@pytest.fixture
def names(project: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the example has made, by its own names."""
    mpl.use("Agg")
    project.rename(project.with_name("demo"))
    monkeypatch.chdir(project.parent)
    _, code = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    made: dict[str, Any] = {}
    exec(compile(code, PAGE.name, "exec"), made)
    return made


@pytest.mark.study
def test_the_example_measures_adjusts_and_plots(names: dict[str, Any], tmp_path: Path) -> None:
    frame, result = names["frame"], names["result"]
    truth = pipeline.read_adjustment(tmp_path / "demo" / "out" / "adjustment.json")
    assert sum(mark.status is measure.Status.MEASURED for mark in frame.marks) >= 6
    assert result.converged
    assert result.value("IO.metric 6 x 6.c") == pytest.approx(
        truth.cameras["metric 6 x 6"].principal_distance_mm.value, abs=0.05
    )
    assert (tmp_path / "residuals.png").stat().st_size > 5000
    for each in (
        frame,
        frame.marks[0],
        result,
        names["network"],
        result.network.observations,
        result.residuals,
        result.reliability,
    ):
        assert "\n" not in repr(each)
        assert len(repr(each)) < 200
    assert result._repr_html_().count("<tr>") == sum(name.startswith("IO.") for name in result.names) + 1
    assert frame._repr_html_().count("<tr>") == len(frame.marks) + 1


@pytest.mark.parametrize("package", [adjust, measure, pipeline])
def test_every_name_of_a_face_can_be_had(package: Any) -> None:
    assert len(package.__all__) > 9
    for name in package.__all__:
        assert getattr(package, name).__doc__
