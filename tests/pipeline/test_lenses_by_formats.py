"""Every distortion family out to every format: written exactly, fitted with the misfit that is told, or refused.

The places come from the renderer's formulas and OpenCV's own; the files are read by readers of each program's.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exported_project import IMAGES, MIRRORED, PITCH_MM, TRUTH, frame_px, make_project
from foreign_readers import asp_px, colmap_px, metashape_mm, micmac_px, opencv_px
from networks import affine, comparator_point, simulated
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.exchange.formats import IMPORTED
from pipeline.files.camera_file import CameraFile, read_camera
from synthetic_images.projection import camera_from_object, object_rotation
from synthetic_images.scene import Distortion as SceneDistortion
from synthetic_images.scene import Family, SceneCamera

Array = NDArray[np.float64]

R0_MM = 80.0
POINTS = np.random.default_rng(8).uniform((-650.0, -650.0, -150.0), (650.0, 650.0, 150.0), (100, 3))
BROWN = {"k1": 4e-8, "k2": -1e-12, "p1": 8e-8, "p2": -6e-8}
OPENCV = {"k1": -9e-4, "k2": 6e-4, "p1": 1e-5, "p2": -1.2e-5}
AFFINE = {"b1": 2e-4, "b2": -1.5e-4}
AICON = {"a1": -4e-8, "a2": 1e-12, "b1": 8e-8, "b2": -6e-8, "c1": 2e-4, "c2": -1.5e-4}
RATIONAL = {"k4": 0.02, "k5": 0.01, "k6": -0.004}
PRISMS = {"s1": 2e-3, "s2": -2e-4, "s3": -1e-3, "s4": 2e-4}
FORMATS = ("opencv", "colmap", "asp", "micmac", "metashape")
EXACT, FITTED, REFUSED = "exact", "fitted", "refused"
LENSES: dict[str, tuple[Family, dict[str, float], tuple[str, ...]]] = {  # and what becomes of it in each format
    "brown": ("brown", BROWN | AFFINE, (REFUSED, REFUSED, REFUSED, FITTED, FITTED)),
    "australis": ("australis", BROWN | {"b1": 2e-4}, (FITTED,) * 5),
    "aicon": ("aicon", AICON, (REFUSED, REFUSED, REFUSED, FITTED, FITTED)),
    "juhl": ("juhl", {"t1": 3.0, "t3": -2.0, "r1": 4.0, "r2": 2.0, "af": 5.0, "sh": 3.0}, (REFUSED,) * 5),
    "opencv, skew": ("opencv", OPENCV | AFFINE, (REFUSED, REFUSED, REFUSED, FITTED, EXACT)),
    "opencv, rational": ("opencv", OPENCV | RATIONAL, (EXACT, EXACT, FITTED, FITTED, FITTED)),
    "opencv, prisms": ("opencv", OPENCV | PRISMS, (EXACT, REFUSED, REFUSED, REFUSED, REFUSED)),
    "opencv_fisheye": ("opencv_fisheye", {"k1": 0.03, "k2": -0.01}, (EXACT, EXACT, EXACT, REFUSED, REFUSED)),
}


def lens_project(folder: Path, lens: str) -> Path:
    """The four images of `exported_project` through another lens, which is given and held."""
    truth = replace(TRUTH, distortion={})
    network, _ = simulated(np.random.default_rng(1), truth, "affine", points=POINTS, noise=False)
    family, parameters, _ = LENSES[lens]
    places = network.observations.xy_mm.copy()
    for i in IMAGES:
        own = [n for n, image in enumerate(network.observations.image) if image == f"f{i}"]
        targets = [n for n in own if network.observations.kind[n] == "target"]
        places[targets] = comparator_point("affine", affine(truth, i, "affine"), i == MIRRORED, camera_mm(lens, i))
    given = {name: Prior(value, 0.0) for name, value in parameters.items()}
    camera = replace(network.cameras[0], distortion=Distortion(family, given, r0_mm=R0_MM))
    observations = replace(network.observations, xy_mm=places)
    return make_project(replace(network, cameras=(camera,), observations=observations), folder)


def camera_mm(lens: str, image: int) -> Array:
    family, parameters, _ = LENSES[lens]
    camera = SceneCamera("K", (228.0, 228.0), TRUTH.c, (TRUTH.x0, TRUTH.y0), SceneDistortion(family, parameters, R0_MM))
    return camera_from_object(camera, (*TRUTH.stations[image], *TRUTH.attitudes[image]), POINTS)


def read_px(format: str, folder: Path, image: int) -> Array:
    """Where another program sees the points in its picture, in pixels of the camera's frame from its middle, y down."""
    if format == "micmac":
        return micmac_px(folder, f"f{image}", POINTS) - 1140.0
    if format == "metashape":
        turn = np.diag([1.0, -1.0, -1.0]) @ object_rotation(*TRUTH.attitudes[image])
        in_camera = (POINTS - np.array(TRUTH.stations[image])) @ turn.T
        return metashape_mm(folder / "K.xml", PITCH_MM, in_camera) * [1.0, -1.0] / PITCH_MM
    reader = {"opencv": opencv_px, "colmap": colmap_px, "asp": asp_px}[format]
    middle = frame_px(image, np.zeros((1, 2)))
    return reader(folder, f"f{image}", POINTS) - middle


def told_px(folder: Path) -> float:
    """The misfit that the README tells."""
    text = (folder / "README.txt").read_text(encoding="utf-8")
    return 0.0 if "nothing was fitted" in text else float(text[text.index("off by ") + 7 :].split()[0])


@parametrize_with_studies("lens", LENSES, quick=(3, 4))
def test_a_lens_is_the_same_in_a_format_or_off_by_what_is_reported_or_refused(
    lens: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = lens_project(tmp_path, lens)
    places = {i: camera_mm(lens, i) for i in IMAGES}
    for format, expected in zip(FORMATS, LENSES[lens][2], strict=True):
        folder = tmp_path / format
        capsys.readouterr()
        code = run(["export", str(project), format, str(folder)])
        if expected == REFUSED:
            assert code == WRONG_INPUT
            assert "has no model that takes this camera: the nearest one is off by up to" in capsys.readouterr().err
            assert not folder.exists()
            continue
        assert code == (LOOK if format == "metashape" else DONE)  # which takes no mirrored scan
        stated_px = told_px(folder)
        assert (stated_px == 0.0) == (expected == EXACT)
        assert stated_px <= 0.05
        for i in set(IMAGES) - ({MIRRORED} if format == "metashape" else set()):
            off = np.linalg.norm(read_px(format, folder, i) - places[i] * [1.0, -1.0] / PITCH_MM, axis=1)
            assert (
                off[(np.abs(places[i]) < 114.0).all(axis=1)].max() < 1.05 * stated_px + 1e-6
            )  # the told one is of a grid
        if format in IMPORTED and format != "micmac":
            back = imported(format, folder, tmp_path / f"{format}-back")
            np.testing.assert_allclose(seen_px(back, format), read_px(format, folder, 0), atol=1e-6, rtol=0)


def imported(format: str, folder: Path, back: Path) -> CameraFile:
    files = {"opencv": folder / "f0.yml", "colmap": folder / "sparse", "metashape": folder / "K.xml"}
    middle = ["--from-middle"] if format == "metashape" else []
    assert run(["import", format, str(files[format]), str(back), "--pitch-um", "100", *middle]) == DONE
    return read_camera(back / ("camera1.toml" if format == "colmap" else "camera.toml"))


def seen_px(camera: CameraFile, format: str) -> Array:
    """Where an imported camera shows the points in image 0, as `read_px`."""
    u, v, w = object_rotation(*TRUTH.attitudes[0]) @ (POINTS - np.array(TRUTH.stations[0])).T
    given = camera.distortion.parameters
    names = parameter_names(camera.distortion.family)
    values = np.array([given[name].value if name in given else 0.0 for name in names])
    interior = np.array([camera.principal_distance_mm, *(camera.principal_point_mm or ())])
    places, found = Lens(camera.distortion, interior, values).camera_from_ray(np.column_stack([-u / w, -v / w]))
    assert found.all()
    middle = 0.0 if format == "metashape" else frame_px(0, np.zeros((1, 2)))
    return np.asarray(places * [1.0, -1.0] / PITCH_MM - middle)
