"""A fisheye whose skew no program takes; skews of other programs in, by their own projections."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from networks import lens_network
from numpy.typing import NDArray
from simulated_project import write_project

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Lens, Prior
from pipeline.cli import DONE, WRONG_INPUT, run
from pipeline.files.camera_file import CameraFile, read_camera

Array = NDArray[np.float64]

PITCH_MM = 0.1
POINTS = np.random.default_rng(2).uniform(-1.0, 1.0, (60, 3)) * [2.0, 2.0, 0.3]


def fisheye_project(folder: Path) -> Path:
    """Digital, 36 mm x 24 mm, exact images; its comparator begins at the first pixel."""
    network = lens_network("opencv_fisheye")
    shift = np.array([18.0, -12.0])
    observations = replace(network.observations, xy_mm=network.observations.xy_mm + shift)
    middle = {"x0_mm": Prior(18.0, np.inf), "y0_mm": Prior(-12.0, np.inf)}
    camera = replace(network.cameras[0], **middle)  # type: ignore[arg-type]
    path = write_project(replace(network, cameras=(camera,), observations=observations), folder)
    text = path.read_text(encoding="utf-8")
    path.write_text(f'scans = ["scans/*.tif"]\npitch_um = {1e3 * PITCH_MM}\n{text}', encoding="utf-8")
    comparator = folder / "comparator.csv"
    comparator.write_text(
        f"# comparator coordinates, reseau\n{comparator.read_text(encoding='utf-8')}", encoding="utf-8"
    )
    (folder / "scans").mkdir()
    for image in network.images:
        tifffile.imwrite(folder / "scans" / f"{image.name}.tif", np.zeros((240, 360), np.uint8))
    run(["adjust", str(path)])
    return path


def test_a_skew_that_no_program_takes_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """b2 = -3e-4 on 12 mm is 0.036 px of 0.1 mm: allowed; not at 0.01 px."""
    project = fisheye_project(tmp_path)
    assert run(["export", str(project), "opencv", str(tmp_path / "o")]) == DONE
    assert run(["export", str(project), "opencv", str(tmp_path / "p"), "--misfit-px", "0.01"]) == WRONG_INPUT
    assert "no model that takes this camera" in capsys.readouterr().err


def seen_px(camera: CameraFile, rays_down: Array) -> Array:
    """Pixels (n, 2) of rays (x right, y down) by an imported camera, its first pixel's centre at (0, 0)."""
    given = camera.distortion.parameters
    names = parameter_names(camera.distortion.family)
    values = np.array([given[name].value if name in given else 0.0 for name in names])
    assert camera.principal_distance_mm is not None
    assert camera.principal_point_mm is not None
    interior = np.array([camera.principal_distance_mm, *camera.principal_point_mm])
    places, found = Lens(camera.distortion, interior, values).camera_from_ray(rays_down * [1.0, -1.0])
    assert found.all()
    return np.asarray(places * [1.0, -1.0] / PITCH_MM)


def test_skews_of_other_programs_come_in(tmp_path: Path) -> None:
    """Zhang's matrix, a fisheye with alpha, and Metashape's b2 in its own formula."""
    rays = np.random.default_rng(3).uniform(-0.5, 0.5, (30, 2))
    directions = np.column_stack([rays, np.ones(30)])
    matrix, lens = (
        np.array([[410.0, 3.0, 180.0], [0.0, 400.0, 120.0], [0.0, 0.0, 1.0]]),
        np.array([-0.1, 0.03, 1e-3, 2e-3]),
    )
    expected: dict[str, Any] = {}
    straight, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), np.eye(3), lens)
    expected["plain"] = np.reshape(straight, (-1, 2)) @ matrix[:2, :2].T + matrix[:2, 2]
    wide, _ = cv2.fisheye.projectPoints(directions[:, None], np.zeros(3), np.zeros(3), matrix, lens, alpha=3.0 / 410.0)
    expected["fisheye"] = np.reshape(wide, (-1, 2))
    for name, places in expected.items():
        storage = cv2.FileStorage(str(tmp_path / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", lens[None])
        if name == "fisheye":
            storage.write("distortion_model", "equidistant")
        storage.release()
        assert (
            run(["import", "opencv", str(tmp_path / f"{name}.yml"), str(tmp_path / name), "--pitch-um", "100"]) == DONE
        )
        camera = read_camera(tmp_path / name / "camera.toml")
        np.testing.assert_allclose(seen_px(camera, rays), places, atol=1e-9)
    given = {"width": 360, "height": 240, "f": 400, "b1": 10, "b2": 3, "k1": -0.1}
    xml = "".join(f"<{name}>{value}</{name}>" for name, value in given.items())
    text = f"<calibration><projection>frame</projection>{xml}</calibration>"
    (tmp_path / "m.xml").write_text(text, encoding="utf-8")
    assert run(["import", "metashape", str(tmp_path / "m.xml"), str(tmp_path / "m"), "--pitch-um", "100"]) == DONE
    radial = rays * (1.0 - 0.1 * (rays**2).sum(axis=1))[:, None]
    u = 180.0 + 400.0 * radial[:, 0] + 10.0 * radial[:, 0] + 3.0 * radial[:, 1]
    v = 120.0 + 400.0 * radial[:, 1]
    view = seen_px(read_camera(tmp_path / "m" / "camera.toml"), rays)
    np.testing.assert_allclose(view, np.stack([u, v], axis=1) - 0.5, atol=1e-9)
