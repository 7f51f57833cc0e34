"""`reseau report --plots`: the plots of every camera as files, from what is stored of it."""

import sys
from pathlib import Path

import numpy as np
import pytest
from networks import Truth, field_points, simulated
from simulated_project import write_project

from adjust.initial_values.approximations import approximate
from adjust.solution.adjustment import adjust
from pipeline.adjusting.network import build_network
from pipeline.cli import run
from pipeline.files.project_file import read_project
from pipeline.report.load import report_data
from pipeline.report.plots import calibrated_cameras
from pipeline.results.comparator_file import read_comparator

NAMES = ("residuals", "coverage", "distortion", "uncertainty-infinity", "uncertainty-near")


@pytest.fixture(scope="module")
def adjusted_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of a simulated camera, adjusted."""
    rng, truth = np.random.default_rng(4), Truth()
    network, _ = simulated(rng, truth, points=field_points(rng, 20), free=dict.fromkeys(truth.distortion, np.inf))
    project = write_project(network, tmp_path_factory.mktemp("simulated"))
    assert run(["adjust", str(project)]) in (0, 1)
    return project


def test_they_show_what_the_adjustment_shows(adjusted_folder: Path) -> None:
    project = read_project(adjusted_folder)
    ((plots, record),) = calibrated_cameras(report_data(project, lambda path: path))
    network, _ = build_network(project, read_comparator(project.comparator))
    of_result = adjust(network, approximate(network)).plots()
    order = [np.lexsort(each.places_mm.T) for each in (plots, of_result)]
    np.testing.assert_allclose(plots.places_mm[order[0]], of_result.places_mm[order[1]], atol=1e-4)
    np.testing.assert_allclose(plots.vectors_mm[order[0]], of_result.vectors_mm[order[1]], atol=2e-5)
    assert np.count_nonzero(plots.is_fiducial) == np.count_nonzero(of_result.is_fiducial) == 20
    np.testing.assert_allclose(plots.lens.covariance, of_result.lens.covariance, rtol=1e-3, atol=1e-18)
    near = next(each.distance for each in record.projection if np.isfinite(each.distance))
    for distance in (np.inf, near):
        (there_mm, stored_mm), (places_mm, sigma_mm) = plots.uncertainty(distance), of_result.uncertainty(distance)
        np.testing.assert_allclose(np.sort(stored_mm, axis=None), np.sort(sigma_mm, axis=None), rtol=2e-3)
        assert there_mm.shape == places_mm.shape


@pytest.mark.study
def test_every_plot_is_written_as_png_and_pdf(adjusted_folder: Path, tmp_path: Path) -> None:
    assert run(["report", str(adjusted_folder), "--plots", str(tmp_path / "plots")]) in (0, 1)
    files = {path.name: path.read_bytes() for path in (tmp_path / "plots").iterdir()}
    assert files.keys() == {f"K-{name}.{ending}" for name in NAMES for ending in ("png", "pdf")}
    for name, content in files.items():
        assert content.startswith(b"%PDF" if name.endswith("pdf") else b"\x89PNG")
    assert (adjusted_folder.parent / "out" / "report.html").exists()


def test_without_matplotlib_one_message_says_what_to_install(
    adjusted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert run(["report", str(adjusted_folder), "--plots", str(tmp_path)]) == 2
    assert "--plots needs Matplotlib" in capsys.readouterr().err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_without_an_adjustment_there_is_nothing_to_plot(
    adjusted_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("camera.toml", "points.csv", "comparator.csv", "project.toml"):
        (tmp_path / name).write_bytes((adjusted_folder.parent / name).read_bytes())
    assert run(["report", str(tmp_path / "project.toml"), "--plots", str(tmp_path / "plots")]) == 2
    assert "There is no calibrated camera to plot." in capsys.readouterr().err.replace("\n", " ")
