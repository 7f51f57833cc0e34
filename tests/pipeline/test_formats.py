"""Distortion families in and out by every format, and names that are no paths."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foreign_readers import asp_px, colmap_px, metashape_mm, micmac_px, opencv_px
from networks import affine, comparator_point, simulated
from numpy.typing import NDArray
from projects import (
    IMAGES,
    MIRRORED,
    PITCH_MM,
    TRUTH,
    Capture,
    Refusal,
    adjusted_project,
    command,
    frame_px,
    make_project,
    replace_text,
    stated_misfit_px,
)
from studies import parametrize_with_studies

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from pipeline import InputError
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.exchange.formats import IMPORTED
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.text.files import file_word, path_below
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
LENS_FORMATS = ("opencv", "colmap", "asp", "micmac", "metashape")
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


@parametrize_with_studies("lens", LENSES, quick=(3, 5))
def test_a_lens_in_a_format_is_as_reported_or_refused(lens: str, tmp_path: Path, capsys: Capture) -> None:
    project = lens_project(tmp_path, lens)
    places = {i: camera_mm(lens, i) for i in IMAGES}
    for format, expected in zip(LENS_FORMATS, LENSES[lens][2], strict=True):
        folder = tmp_path / format
        capsys.readouterr()
        code = command("export", project, format, folder)
        if expected == REFUSED:
            assert code == WRONG_INPUT
            assert "has no model that takes this camera: the nearest one is off by up to" in capsys.readouterr().err
            assert not folder.exists()
            continue
        assert code == (LOOK if format == "metashape" else DONE)  # which takes no mirrored scan
        is_fitted = "nothing was fitted" not in (folder / "README.txt").read_text(encoding="utf-8")
        stated_px = stated_misfit_px(folder) if is_fitted else 0.0
        assert (stated_px == 0.0) == (expected == EXACT)
        assert stated_px <= 0.05
        for i in set(IMAGES) - ({MIRRORED} if format == "metashape" else set()):
            off = np.linalg.norm(read_px(format, folder, i) - places[i] * [1.0, -1.0] / PITCH_MM, axis=1)
            assert (
                off[(np.abs(places[i]) < 114.0).all(axis=1)].max() < 1.05 * stated_px + 1e-6
            )  # the told one is of a grid
        if format in IMPORTED and format != "micmac":
            back = imported(format, folder, tmp_path / f"{format}-back")
            u, v, w = object_rotation(*TRUTH.attitudes[0]) @ (POINTS - np.array(TRUTH.stations[0])).T
            middle = 0.0 if format == "metashape" else frame_px(0, np.zeros((1, 2)))
            places_px = projected_px(back, np.column_stack([-u / w, -v / w])) - middle
            np.testing.assert_allclose(places_px, read_px(format, folder, 0), atol=1e-6, rtol=0)


def imported(format: str, folder: Path, back: Path) -> CameraFile:
    files = {"opencv": folder / "f0.yml", "colmap": folder / "sparse", "metashape": folder / "K.xml"}
    middle = ["--from-middle"] if format == "metashape" else []
    assert command("import", format, files[format], back, "--pitch-um", "100", *middle) == DONE
    return read_camera(back / ("camera1.toml" if format == "colmap" else "camera.toml"))


def projected_px(camera: CameraFile, rays: Array) -> Array:
    """Columns and rows where an imported camera shows rays (x right, y up), the first pixel's centre being (0, 0)."""
    given, names = camera.distortion.parameters, parameter_names(camera.distortion.family)
    values = np.array([given[name].value if name in given else 0.0 for name in names])
    interior = np.array([camera.principal_distance_mm, *(camera.principal_point_mm or ())])
    places, found = Lens(camera.distortion, interior, values).camera_from_ray(rays)
    assert found.all()
    return np.asarray(places * [1.0, -1.0] / PITCH_MM)


def test_skews_of_other_programs_are_imported(tmp_path: Path) -> None:
    """Zhang's matrix, a fisheye with alpha, and Metashape's b2 in its own formula."""
    rays = np.random.default_rng(3).uniform(-0.5, 0.5, (30, 2))
    directions = np.column_stack([rays, np.ones(30)])
    matrix = np.array([[410.0, 3.0, 180.0], [0.0, 400.0, 120.0], [0.0, 0.0, 1.0]])
    lens, nothing = np.array([-0.1, 0.03, 1e-3, 2e-3]), np.zeros(3)
    straight, _ = cv2.projectPoints(directions, nothing, nothing, np.eye(3), lens)
    wide, _ = cv2.fisheye.projectPoints(directions[:, None], nothing, nothing, matrix, lens, alpha=3.0 / 410.0)
    expected = {"plain": np.reshape(straight, (-1, 2)) @ matrix[:2, :2].T + matrix[:2, 2]}
    expected["equidistant"] = np.reshape(wide, (-1, 2))
    for name in expected:
        storage = cv2.FileStorage(str(tmp_path / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", lens[None])
        if name != "plain":
            storage.write("distortion_model", name)
        storage.release()
    given = {"width": 360, "height": 240, "f": 400, "b1": 10, "b2": 3, "k1": -0.1}
    xml = "".join(f"<{name}>{value}</{name}>" for name, value in given.items())
    (tmp_path / "m.xml").write_text(f"<calibration><projection>frame</projection>{xml}</calibration>", encoding="utf-8")
    x, y = rays.T * (1.0 - 0.1 * (rays**2).sum(axis=1))
    expected["m"] = np.stack([180.0 + 410.0 * x + 3.0 * y, 120.0 + 400.0 * y], axis=1) - 0.5
    for name, places in expected.items():
        format, file = ("metashape", "m.xml") if name == "m" else ("opencv", f"{name}.yml")
        assert command("import", format, tmp_path / file, tmp_path / name, "--pitch-um", "100") == DONE
        camera = read_camera(tmp_path / name / "camera.toml")
        np.testing.assert_allclose(projected_px(camera, rays * [1.0, -1.0]), places, atol=1e-9)


ELSEWHERE = (
    "../../x", "..", ".", "/tmp/x", "a/../../x", "a//x", "", "a/", "..\\x", "C:x", "a\nb", "\0", " .. ", "a/./b",
)  # fmt: skip


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_name_that_leads_elsewhere_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be that of a file below"):
        path_below(tmp_path, name, ".tif")


def test_a_name_is_a_path_below_its_folder_and_a_word_is_none(tmp_path: Path) -> None:
    for name in ("f0", "box 1/0001", "..hidden", "a..b", "1952-06-01T12:30", "ü/σ"):
        assert path_below(tmp_path, name, ".tif") == tmp_path / f"{name}.tif"
    words = {"RC8 17/3": "RC8-17-3", "..": "-", "": "-", "a.b_c-d": "a.b_c-d"}
    assert {name: file_word(name) for name in words} == words


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound project, of which one image is named as a path elsewhere."""
    folder = tmp_path_factory.mktemp("deep") / "a" / "b"
    folder.mkdir(parents=True)
    project = adjusted_project(folder)
    replace_text(project, 'scans = ["scans/*.tif"]\n', "")
    table = folder / "comparator.csv"
    table.write_text(table.read_text(encoding="utf-8").replace("f1", "../../x"), encoding="utf-8")
    command("adjust", project)
    return project


@pytest.mark.parametrize("format", ["opencv", "mmvii", "micmac", "csv"])
def test_an_export_writes_nothing_outside_its_folder(format: str, strange: Path, refusal: Refusal) -> None:
    """All but the last name files after the images."""
    before, out = set(strange.parents[2].rglob("*")), strange.parent / "deep" / "out"
    arguments = ["export", str(strange), format, str(out)]
    if format != "csv":
        refusal(arguments)
    else:
        assert run(arguments) in (DONE, LOOK)
    assert all(path.is_relative_to(out.parent) for path in set(strange.parents[2].rglob("*")) - before)
    assert "cannot be that of a file" in refusal("report", strange, "--frames", "../../x")
