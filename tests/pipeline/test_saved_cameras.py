"""Adjusted cameras saved for later projects: a second project with the first as prior is both together."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from simulated_project import write_project
from test_lens_comparison import two_networks

from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.exchange.saved_cameras import _archive_variances, save_cameras
from pipeline.files.camera_file import read_camera
from pipeline.files.project_file import read_project
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.adjustment_record import CameraRecord, Quantity


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Projects a, b and both together, adjusted."""
    folder = tmp_path_factory.mktemp("archives")
    for name, (network, _) in zip("ab+", two_networks("affine", 1.0), strict=True):
        (folder / name).mkdir()
        assert run(["adjust", str(write_project(network, folder / name))]) in (0, 1)
    return folder


def adjust_network(folder: Path) -> CameraRecord:
    return read_adjustment(folder / "out" / "adjustment.json").cameras["K"]


def quantities(camera: CameraRecord) -> dict[str, Quantity]:
    fiducials = {f"{id} {axis}": q for id, m in camera.fiducials.items() for axis, q in (("x", m.x_mm), ("y", m.y_mm))}
    return {**camera.interior, **fiducials}


def test_a_second_project_with_the_saved_camera_is_both_together(
    archives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["cameras", "--save", str(archives / "a" / "project.toml"), "--out", str(tmp_path / "saved")]) == 0
    output = " ".join(capsys.readouterr().out.split())
    frames = len(read_adjustment(archives / "a" / "out" / "adjustment.json").images)
    assert f"adjusted from {frames} frames of 1 scanner in a" in output
    camera = read_camera(tmp_path / "saved" / "camera.toml")
    assert camera.source is not None
    assert (camera.source.frames, camera.source.scanners, camera.source.archives) == (frames, 1, 1)
    first = quantities(adjust_network(archives / "a"))
    assert camera.principal_distance_mm == pytest.approx(first["c"].value, abs=1e-12)
    later = shutil.copytree(archives / "b", tmp_path / "later", ignore=shutil.ignore_patterns("out"))
    text = (later / "project.toml").read_text(encoding="utf-8").replace("camera.toml", "../saved/camera.toml", 1)
    (later / "project.toml").write_text(text, encoding="utf-8")
    assert run(["adjust", str(later / "project.toml")]) in (0, 1)
    second, joint = quantities(adjust_network(later)), quantities(adjust_network(archives / "+"))
    for name, both in joint.items():
        if both.sigma > 0.0:
            assert second[name].value == pytest.approx(both.value, abs=0.1 * both.sigma), name
            assert second[name].sigma == pytest.approx(both.sigma, rel=0.1), name
    assert second["c"].sigma < 0.9 * first["c"].sigma


def test_two_archives_are_joined_to_what_both_together_give(archives: Path, tmp_path: Path) -> None:
    projects = [read_project(archives / name / "project.toml") for name in "ab"]
    (saved,) = save_cameras(projects, tmp_path)
    assert (saved.source.archives, saved.source.text.split(" in ")[1]) == (2, "a, b")
    joint, camera = quantities(adjust_network(archives / "+")), read_camera(saved.path)
    assert camera.calibration is not None
    held = dict(zip((one.quantity for one in camera.calibration.parameters), camera.calibration.values, strict=True))
    for name in ("c", "k3", "x0"):
        spread = saved.source.spread_mm[name]
        assert held[name] == pytest.approx(joint[name].value, abs=0.1 * joint[name].sigma), name
        sigma = np.sqrt(camera.calibration.covariance.diagonal())[list(held).index(name)]
        assert sigma == pytest.approx(np.hypot(joint[name].sigma, spread / np.sqrt(2)), rel=0.15), name


def test_the_spread_between_archives_is_what_their_own_sigmas_do_not_explain() -> None:
    """Of 4,000 quantities in five archives, by simulation: 2 between them, 1 in each; and none."""
    rng = np.random.default_rng(5)
    for true in (2.0, 0.0):
        values = true * rng.normal(size=(5, 4000)) + rng.normal(size=(5, 4000))
        between = _archive_variances(values, np.ones((5, 4000)))
        assert float(between.mean()) == pytest.approx(true**2, rel=0.06, abs=0.3)


def test_what_cannot_be_saved_is_refused(archives: Path, tmp_path: Path) -> None:
    project = read_project(archives / "a" / "project.toml")
    (tmp_path / "camera.toml").write_text('name = "own"\n')
    with pytest.raises(InputError, match="is there already, and was not saved so"):
        save_cameras([project], tmp_path)
    other = shutil.copytree(archives / "b", tmp_path / "b", ignore=shutil.ignore_patterns("out"))
    with pytest.raises(InputError, match="no adjustment that converged"):
        save_cameras([read_project(other / "project.toml")], tmp_path / "c")
