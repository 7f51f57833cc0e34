"""A fisheye out to OpenCV and COLMAP and back, by their own projections; skews of other programs in."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from lens_networks import LENSES, network_of
from numpy.typing import NDArray
from simulated_project import write_project

from adjust.functional_model.families import parameter_names
from adjust.functional_model.projection import camera_from_ray
from adjust.problem.network import Prior
from pipeline.cli import DONE, WRONG_INPUT, run
from pipeline.files.camera_file import CameraFile, read_camera

Array = NDArray[np.float64]

PITCH_MM = 0.1
POINTS = np.random.default_rng(2).uniform(-1.0, 1.0, (60, 3)) * [2.0, 2.0, 0.3]


def fisheye_project(folder: Path, skew: bool) -> Path:
    """Digital, 36 mm x 24 mm, exact images; its comparator begins at the first pixel."""
    network = network_of("opencv_fisheye")
    shift = np.array([18.0, -12.0])
    observations = replace(network.observations, xy_mm=network.observations.xy_mm + shift)
    given = network.cameras[0].distortion.parameters
    free = given if skew else {name: prior for name, prior in given.items() if name != "b2"}
    middle = {"x0_mm": Prior(18.0, np.inf), "y0_mm": Prior(-12.0, np.inf)}
    distortion = replace(network.cameras[0].distortion, parameters=free)
    camera = replace(network.cameras[0], distortion=distortion, **middle)  # type: ignore[arg-type]
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


def places_px(project: Path) -> Array:
    """(n, 2) the points as the adjustment's own lens shows them in image i0, in the pixels of its resampled frame."""
    stored = json.loads((project.parent / "out" / "adjustment.json").read_text(encoding="utf-8"))
    camera, exterior = stored["cameras"]["L"], stored["images"]["i0"]["exterior"]
    omega, phi, kappa = (np.radians(exterior[f"{name}_deg"]["value"]) for name in ("omega", "phi", "kappa"))
    so, co, sp, cp, sk, ck = (f(a) for a in (omega, phi, kappa) for f in (np.sin, np.cos))
    r1, r2, r3 = ([[1, 0, 0], [0, co, so], [0, -so, co]], [[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]],
                  [[ck, sk, 0], [-sk, ck, 0], [0, 0, 1]])  # fmt: skip
    u, v, w = np.array(r3) @ r2 @ r1 @ (POINTS - [exterior[name]["value"] for name in ("X0", "Y0", "Z0")]).T
    k = [camera["distortion"][name]["value"] for name in ("k1", "k2", "k3", "k4")]
    b1, b2 = (camera["distortion"][name]["value"] for name in ("b1", "b2"))
    theta, radius = np.arctan(np.hypot(u, v) / -w), np.hypot(u, v)
    bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8) / radius
    c, point = camera["principal_distance_mm"]["value"], camera["principal_point_mm"]
    x = point["x"]["value"] + c * bent * ((1 + b1) * u - b2 * v)
    y = point["y"]["value"] + c * bent * v
    return np.stack([x, -y], axis=1) / PITCH_MM


def test_a_fisheye_goes_out_as_it_is_and_comes_back(tmp_path: Path) -> None:
    project = fisheye_project(tmp_path, skew=False)
    expected = places_px(project)
    out = tmp_path / "opencv"
    assert run(["export", str(project), "opencv", str(out)]) == DONE
    storage = cv2.FileStorage(str(out / "i0.yml"), cv2.FILE_STORAGE_READ)
    matrix, lens, turn, shift = (
        storage.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients", "R", "t")
    )
    seen, _ = cv2.fisheye.projectPoints(POINTS[:, None], cv2.Rodrigues(turn)[0], shift, matrix, lens)
    first = expected - np.reshape(seen, (-1, 2))
    assert np.abs(first - first.mean(axis=0)).max() < 1e-6  # the canvas begins at a whole pixel
    assert np.abs(first[0] - np.round(first[0])).max() < 1e-6
    assert run(["import", "opencv", str(out / "i0.yml"), str(tmp_path / "back"), "--pitch-um", "100"]) == DONE
    camera = read_camera(tmp_path / "back" / "camera.toml")
    assert camera.distortion.family == "opencv_fisheye"
    k1, k2 = (camera.distortion.parameters[name].value for name in ("k1", "k2"))
    assert (k1, k2) == pytest.approx((LENSES["opencv_fisheye"][1]["k1"], LENSES["opencv_fisheye"][1]["k2"]), rel=1e-2)


def test_colmap_has_the_fisheye_too(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    project = fisheye_project(tmp_path, skew=False)
    out = tmp_path / "colmap"
    assert run(["export", str(project), "colmap", str(out)]) == DONE
    model = pycolmap.Reconstruction(str(out / "sparse"))
    found = next(each for each in model.images.values() if each.name == "i0.tif")
    assert found.camera.model_name == "OPENCV_FISHEYE"
    in_camera = np.array([found.cam_from_world() * point for point in POINTS])
    first = places_px(project) - (np.asarray(found.camera.img_from_cam(in_camera)) - 0.5)
    assert np.abs(first - first.mean(axis=0)).max() < 1e-6
    assert run(["import", "colmap", str(out / "sparse"), str(tmp_path / "back"), "--pitch-um", "100"]) == DONE
    families = {read_camera(file).distortion.family for file in (tmp_path / "back").glob("*.toml")}
    assert families == {"opencv_fisheye"}


def test_a_skew_that_no_program_takes_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """b2 = -3e-4 on 12 mm is 0.036 px of 0.1 mm: allowed; not at 0.01 px."""
    project = fisheye_project(tmp_path, skew=True)
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
    places, found = camera_from_ray(camera.distortion, interior, values, rays_down * [1.0, -1.0])
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
    seen = seen_px(read_camera(tmp_path / "m" / "camera.toml"), rays)
    np.testing.assert_allclose(seen, np.stack([u, v], axis=1) - 0.5, atol=1e-9)
