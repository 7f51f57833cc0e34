"""A scanner through files: its bend, and a camera that photographed the film."""

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from networks import bent_films
from numpy.typing import NDArray
from projects import Printed, Refusal, command, fiducial_tables, result_file, write_network_project, write_tables
from small_scene import CROSS, OBLIQUE, SCANNER, hidden_field, scene

from adjust import Network, Prior, Scanner, adjust, approximate
from measure import open_scan
from measure.flags import Cause
from pipeline import read_adjustment, read_measurement, read_project
from pipeline.cli import DONE, LOOK
from pipeline.files.opencv_file import read_lens
from pipeline.rendered.scene_project import taking_camera_yaml
from pipeline.report.camera_views import bend_field
from pipeline.results.adjustment_file import read_covariance
from synthetic_images.film import frame_geometry, scanner_bend
from synthetic_images.render import render_scene
from synthetic_images.scene import Scene, SceneCamera, SceneFiducial, SceneFilm, SceneImage, SceneTakingLens, Tones
from synthetic_images.scene import SceneScanner as SceneScanner

TEMPLATE = (files("pipeline") / "templates" / "scene.toml").read_text()
TRUTH = {"a20": 0.02, "b11": -0.015, "b02": 0.01}
QUARTERS = [0.0, 90.0, 180.0, 270.0] * 2


def project(folder: Path, network: Network, setting: str) -> Path:
    path = write_network_project(network, folder)
    text = path.read_text().replace('points = "points.csv"\n', 'images = "images.csv"\n')
    path.write_text(f"{text}scanner = {setting}\n")
    names = [image.name for image in network.images]
    rows = [f"{name},{'' if i < len(names) // 2 else 'other'}" for i, name in enumerate(names)]
    (folder / "images.csv").write_text("image,scanner\n" + "\n".join(rows) + "\n")
    return path


def test_two_scanners_of_images_csv_are_adjusted_and_shown(tmp_path: Path) -> None:
    network = bent_films(QUARTERS, TRUTH, {}, np.random.default_rng(1))
    path = project(tmp_path, network, '["a20", "b11", "b02"]\nscanner_sigma_um = 50.0')
    assert command("run", path) == DONE
    scanners = result_file(tmp_path)["scanners"]
    assert set(scanners) == {"1", "other"}
    assert [image["scanner"] for image in result_file(tmp_path)["images"].values()] == ["1"] * 4 + ["other"] * 4
    for scanner in scanners.values():
        assert set(scanner["terms"]) == set(TRUTH)
        term = scanner["terms"]["a20"]
        assert term["value"] == pytest.approx(0.02, rel=0.2)
        assert term["given"] == {"value": 0.0, "sigma": 0.05}
        assert 0.0 < term["sigma"] < 0.005
        assert term["p"] < 0.001
        assert scanner["significance"][0]["parameters"] == list(TRUTH)
    # At the corner of the extent a Legendre polynomial is 1: the field there is the sum of the terms.
    path = tmp_path / "out" / "adjustment.json"
    record, covariance = read_adjustment(path).scanners["1"], read_covariance(path)
    corner = np.array([record.center_mm]) + record.half_mm
    value_um, covariance_um2 = bend_field("1", record, covariance, corner)
    terms = [record.terms[name].value for name in TRUTH]
    assert value_um[0] == pytest.approx((1e3 * terms[0], 1e3 * (terms[1] + terms[2])))
    matrix = covariance.select([f"SC.1.{name}" for name in TRUTH])
    assert covariance_um2[0, 0, 0] == pytest.approx(1e6 * matrix[0, 0])
    assert covariance_um2[0, 1, 1] == pytest.approx(1e6 * matrix[1:, 1:].sum())
    report = (tmp_path / "out" / "report.html").read_text()
    section = report[report.index('id="scanners"') : report.index('id="notes"')]
    assert section.count("<svg") == 2
    assert section.count('class="ellipse"') >= 2 * 72
    assert "other (4 scans)" in section
    assert "significant (" in section


def test_frames_that_lie_alike_end_in_a_question(tmp_path: Path, printed_line: Printed) -> None:
    network = bent_films([0.0] * 4, TRUTH, {}, np.random.default_rng(1))
    assert "frames lie alike in the scanner" in printed_line("adjust", project(tmp_path, network, '"auto"'), code=LOOK)
    assert not any(scanner["terms"] for scanner in result_file(tmp_path)["scanners"].values())


def test_a_rendered_scanner_is_the_one_that_is_adjusted() -> None:
    """Where the renderer puts the marks of frames in four poses, one of them mirrored: its bend to a nanometre."""
    bend_um = {"a20": 20.0, "b11": -15.0, "a02": 8.0, "b30": 5.0, "a04": -3.0}
    poses = ("0", "90", "180", "270m")
    images = tuple(replace(OBLIQUE, name=f"f{pose}", pose=pose) for pose in poses)
    made = scene(images=images, scanner=replace(SCANNER, bend_um=bend_um))
    geometries = [frame_geometry(made, i) for i in range(len(poses))]
    marks_mm = {f"{i}{j}": (-5.0 + 2.0 * i, -5.0 + 2.0 * j) for i in range(6) for j in range(6)}
    pixels = np.concatenate([geometry.pixel_from_camera(np.array(list(marks_mm.values()))) for geometry in geometries])
    bend = scanner_bend(made)
    scanner = Scanner("S", dict.fromkeys(bend_um, Prior(0.0, np.inf)), bend.center_mm, (bend.size_mm / 2,) * 2)
    network = bent_films([0.0] * len(poses), {}, {}, marks_mm=marks_mm, sigma_given_mm=0.0)
    observations = replace(network.observations, xy_mm=pixels * [0.04, -0.04])
    network = replace(network, scanners=(scanner,), observations=observations)
    result = adjust(network, approximate(network))
    assert result.converged
    for name, value in bend_um.items():
        assert result.value(f"SC.S.{name}") == pytest.approx(value / 1000.0, abs=1e-6)


def test_a_design_tries_scans_turned_by_180_degrees(tmp_path: Path) -> None:
    text = TEMPLATE.replace('scanner = "none"  ', 'scanner = ["a20", "b11"]  ').replace('pose = "90m"', 'pose = "0"')
    (tmp_path / "scene.toml").write_text(text)
    command("design", tmp_path / "scene.toml", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "design.json").read_text())
    (turned,) = [one for one in found["what_would_help"] if one["change"] == "every second scan turned by 180 degrees"]
    rms_um = 1e3 * np.sqrt(np.mean([term["sigma"] ** 2 for term in found["scanners"]["1"].values()]))
    assert turned["sigmas"]["scanner"] < 0.99 * rms_um
    assert turned["gain_percent"]["scanner"] == pytest.approx(100.0 * (1.0 - turned["sigmas"]["scanner"] / rms_um))


Array = NDArray[np.float64]

PITCH_UM = 30.0
PLACES = {str(3 * i + j): (18.0 * (i - 1), 18.0 * (j - 1)) for i in range(3) for j in range(3) if (i, j) != (1, 1)}
LENS = SceneTakingLens(1900.0, (770.0, 760.0), k1=-0.12, k2=0.04, p1=5e-4)
MATRIX = np.array([[1900.0, 0.0, 770.0], [0.0, 1900.0, 760.0], [0.0, 0.0, 1.0]])
COEFFICIENTS = np.array([-0.12, 0.04, 5e-4, 0.0, 0.0])
CAMERA = """name = "K"
frame_mm = [40.0, 40.0]
[mark]
cross = {kind = "ring-cross", ring_mm = 0.5, ring_line_mm = 0.1, arm_mm = 0.4, line_mm = 0.1, polarity = "light"}
""" + fiducial_tables(PLACES, 'sigma_mm = 0.002\nmark = "cross"\n')
Photograph = tuple[Path, dict[str, Array]]  # a folder, and where the marks of its scan are
PX = np.random.default_rng(2).uniform(0.0, 1530.0, (30, 2))


def photographed_scene(tilt_deg: float, lens: SceneTakingLens) -> Scene:
    fiducials = tuple(SceneFiducial(id, xy, CROSS) for id, xy in PLACES.items())
    camera = SceneCamera("K", (40.0, 40.0), 60.0, fiducials=fiducials)
    film = SceneFilm("projective", tilt_deg=tilt_deg, tilt_direction_deg=25.0, photographed_from_mm=110.0)
    scanner = SceneScanner((PITCH_UM, PITCH_UM), margin_mm=3.0, noise=0.01, lens=lens)
    image = SceneImage("a", (0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    return Scene("photo", 3, camera, hidden_field(), (image,), scanner, film, Tones(contrast=0.0))


def photographed_project(folder: Path, model: str, scanner: str = '[scanner]\nlens = "lens.yaml"\n') -> Path:
    scans = f'camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = {PITCH_UM}\n'
    settings = f'[measure]\npose = "0"\ntone = "linear"\n{scanner}[adjust]\ntransformation = "{model}"'
    return write_tables(folder, scans + settings, camera=CAMERA)


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Photograph:
    """A film tilted by 4 degrees and seen through a lens; where its marks are."""
    folder = tmp_path_factory.mktemp("photographed")
    made = photographed_scene(4.0, LENS)
    (frame,) = render_scene(made, folder).frames
    (folder / "lens.yaml").write_text(taking_camera_yaml(made, LENS))
    return folder, {id: position.center_px for id, position in frame.fiducials.items()}


def test_the_film_is_adjusted_free_of_the_lens(photograph: Photograph) -> None:
    folder, truth = photograph
    path = photographed_project(folder, "projective")
    assert command("measure", path) == 0
    assert command("adjust", path) == 0
    (measured,) = read_measurement(read_project(path).measurement_path)
    assert any("gives no covariance" in note for note in measured.notes)
    for mark in measured.frame.marks:
        assert mark.status == "measured"
        assert np.abs(np.asarray(mark.center_px) - truth[mark.point]).max() < 0.05
    record = read_adjustment(folder / "out" / "adjustment.json")
    assert 0.4 < record.sigma0 < 1.6
    bend, values = record.scanners["1"].bend()
    scan_mm = np.array(list(truth.values())) * PITCH_UM / 1000 * (1.0, -1.0)
    film = record.images["a"].transformation.film(np.zeros(2))
    place = film.camera_from_comparator(bend.apply(values, scan_mm))
    assert np.abs(place - [PLACES[id] for id in truth]).max() < 0.003


def test_a_lens_is_that_of_opencv_both_ways(photograph: Photograph) -> None:
    lens = read_lens(photograph[0] / "lens.yaml", PITCH_UM)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-14)
    ideal = np.asarray(
        cv2.undistortPoints(PX[:, None], MATRIX, COEFFICIENTS, R=np.eye(3), P=MATRIX, criteria=stop), np.float64
    )[:, 0]
    np.testing.assert_allclose(lens.ideal_px(PX), ideal, atol=1e-6)
    np.testing.assert_allclose(lens.scan_px(ideal), PX, atol=1e-6)
    part = lens.crop(100, 40)
    np.testing.assert_allclose(part.ideal_px(PX - (100, 40)), ideal - (100, 40), atol=1e-6)
    assert lens.covariance_px2(PX).shape == (60, 60)
    assert not lens.covariance_px2(PX).any()


def test_the_covariance_of_a_calibration_is_that_of_ideal_places(tmp_path: Path) -> None:
    """By finite differences of OpenCV's own model."""
    rng = np.random.default_rng(8)
    root = np.diag([4.0, 4.0, 2.0, 2.0, 3e-3, 3e-3, 3e-4, 3e-4, 0.0]) @ rng.normal(size=(9, 9))
    covariance = root @ root.T
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (
        ("image_width", 1534), ("image_height", 1534), ("camera_matrix", MATRIX),
        ("distortion_coefficients", COEFFICIENTS[None]), ("intrinsics_covariance", covariance),
    ):  # fmt: skip
        storage.write(name, value)
    storage.release()
    lens = read_lens(tmp_path / "camera.yaml", PITCH_UM)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-14)

    def ideal(change: Array) -> Array:
        """In pixels of fy, both ways, about the axis."""
        fx, fy, cx, cy = np.array([1900.0, 1900.0, 770.0, 760.0]) + change[:4]
        own = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        square = np.array([[fy, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return np.asarray(
            cv2.undistortPoints(PX[:, None], own, COEFFICIENTS + change[4:], R=np.eye(3), P=square, criteria=stop),
            np.float64,
        ).ravel()

    steps = np.diag([1e-2, 1e-2, 1e-2, 1e-2, 1e-5, 1e-5, 1e-6, 1e-6, 1e-5])
    by_values = np.stack([(ideal(step) - ideal(-step)) / (2 * step.sum()) for step in steps], axis=1)
    expected = by_values @ covariance @ by_values.T
    np.testing.assert_allclose(lens.covariance_px2(PX), expected, atol=2e-3 * np.abs(expected).max())
    assert lens.is_covariance_known


def test_an_unsure_lens_is_a_cause_of_covariances(photograph: Photograph) -> None:
    """Less what the film model takes: a shift and a scale of all marks are nobody's error."""
    folder, _ = photograph
    text = (folder / "lens.yaml").read_text()
    storage = cv2.FileStorage(str(folder / "unsure.yaml"), cv2.FILE_STORAGE_WRITE)
    known = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    for name in ("image_width", "image_height"):
        storage.write(name, int(known.getNode(name).real()))
    for name in ("camera_matrix", "distortion_coefficients"):
        storage.write(name, known.getNode(name).mat())
    storage.write("intrinsics_covariance", np.diag([0.0, 0.0, 0.0, 0.0, 0.002**2, 0.0, 0.0, 0.0, 0.0]))
    storage.release()
    path = photographed_project(folder, "projective", '[scanner]\nlens = "unsure.yaml"\n')
    assert command("measure", path) == 0
    (measured,) = read_measurement(read_project(path).measurement_path)
    marks = [mark.covariance for mark in measured.frame.marks if mark.covariance]
    sigmas = [covariance.sigmas_px.get(Cause.LENS, 0.0) for covariance in marks]
    # k1 moves a mark by f k1 r^3: 600 px off the axis by 0.12 px, 850 px by 0.34, of which a scale takes most.
    assert 0.02 < min(sigmas) < max(sigmas) < 0.12


def test_a_scan_of_another_size_is_refused(photograph: Photograph, refusal: Refusal) -> None:
    folder, _ = photograph
    lens = read_lens(folder / "lens.yaml", PITCH_UM)
    with open_scan(folder / "scans" / "a.tif") as scan:
        assert not lens.misfit(scan)
        assert "Give the image uncropped" in replace(lens, size_px=(1000, 900)).misfit(scan)
    path = photographed_project(folder, "projective", '[scanner]\nlens = "small.yaml"\n')
    text = (folder / "lens.yaml").read_text()
    (folder / "small.yaml").write_text(text.replace("image_width: 1534", "image_width: 1500"))
    assert "calibrated for 1500 x 1534 px" in refusal("measure", path)


def test_a_scene_with_a_taking_lens_gives_a_project_with_it(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text(f"principal_distance_mm = 60.0\n{CAMERA}")
    (tmp_path / "scene.toml").write_text(
        'camera = "camera.toml"\n[field]\nkind = "natural"\n[scan]\npitch_um = 100.0\nmargin_mm = 3.0\n'
        "[scan.lens]\nfocal_px = 600.0\nk1 = -0.1\n[[image]]\nname = 'a'\nposition = [0, 0, 3]\n"
        "angles_deg = [0, 0, 0]\n"
    )
    assert command("render", tmp_path / "scene.toml", tmp_path / "out") == 0
    made = read_project(tmp_path / "out" / "project.toml")
    assert made.lens is not None
    assert made.lens.size_px == (460, 460)
    np.testing.assert_allclose(made.lens.lens.interior, [60.0, 22.95, -22.95])
    assert made.lens.lens.parameters[0] == -0.1
