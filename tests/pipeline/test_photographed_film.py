"""Film photographed by a digital camera: `[scanner] lens` from the calibration to the film transformation."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import CROSS, hidden_field

from measure.flags import Cause
from measure.results import MarkMeasurement
from measure.scans.opening import open_scan
from pipeline.archive.measurement import read_measurement
from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.opencv_file import read_lens
from pipeline.files.project_file import read_project
from pipeline.rendered.scene_project import taking_camera_yaml
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.measured_record import MeasuredScan
from synthetic_images.render import render_scene
from synthetic_images.scene import (
    Film,
    Scanner,
    Scene,
    SceneCamera,
    SceneFiducial,
    SceneImage,
    TakingLens,
    Tones,
)

Array = NDArray[np.float64]

PITCH_UM = 30.0
PLACES = {str(3 * i + j): (18.0 * (i - 1), 18.0 * (j - 1)) for i in range(3) for j in range(3) if (i, j) != (1, 1)}
LENS = TakingLens(1900.0, (770.0, 760.0), k1=-0.12, k2=0.04, p1=5e-4)
MATRIX = np.array([[1900.0, 0.0, 770.0], [0.0, 1900.0, 760.0], [0.0, 0.0, 1.0]])
COEFFICIENTS = np.array([-0.12, 0.04, 5e-4, 0.0, 0.0])
CAMERA = "\n".join(
    [
        'name = "K"', "frame_mm = [40.0, 40.0]", '[mark.cross]\nkind = "ring-cross"\nring_mm = 0.5\nring_line_mm = 0.1',
        'arm_mm = 0.4\nline_mm = 0.1\npolarity = "light"',
        *(
          f'[[fiducial]]\nid = "{id}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.002\nmark = "cross"'
          for id, (x, y) in PLACES.items()
        ),
    ]
)  # fmt: skip
PX = np.random.default_rng(2).uniform(0.0, 1530.0, (30, 2))


def scene(tilt_deg: float, lens: TakingLens | None) -> Scene:
    camera = SceneCamera(
        "K", (40.0, 40.0), 60.0, fiducials=tuple(SceneFiducial(id, xy, CROSS) for id, xy in PLACES.items())
    )
    film = Film("projective", tilt_deg=tilt_deg, tilt_direction_deg=25.0, photographed_from_mm=110.0)
    images = tuple(SceneImage(name, (0.0, 0.0, 3.0, 0.0, 0.0, 0.0), turn_rad=turn) for name, turn in (("a", 0.0),))
    scanner = Scanner((PITCH_UM, PITCH_UM), margin_mm=3.0, noise=0.01, lens=lens)
    return Scene("photo", 3, camera, hidden_field(), images, scanner, film, Tones(contrast=0.0))


def project(folder: Path, model: str, scanner: str = '[scanner]\nlens = "lens.yaml"\n') -> Path:
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    path = folder / "project.toml"
    path.write_text(
        f'camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = {PITCH_UM}\n'
        f'[measure]\npose = "0"\ntone = "linear"\n'
        f'{scanner}[adjust]\ntransformation = "{model}"\n',
        encoding="utf-8",
    )
    return path


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Array]]:
    """A film tilted by 4 degrees and seen through a lens; where its marks are."""
    folder = tmp_path_factory.mktemp("photographed")
    made = scene(4.0, LENS)
    (frame,) = render_scene(made, folder).frames
    (folder / "lens.yaml").write_text(taking_camera_yaml(made, LENS), encoding="utf-8")
    return folder, {id: position.center_px for id, position in frame.fiducials.items()}


def measured_scan(path: Path) -> MeasuredScan:
    (measured,) = read_measurement(read_project(path).measurement_path)
    return measured


def mark_rows(path: Path) -> tuple[MarkMeasurement, ...]:
    return measured_scan(path).frame.marks


def test_marks_are_measured_in_the_picture_and_the_film_is_adjusted_free_of_the_lens(
    photograph: tuple[Path, dict[str, Array]],
) -> None:
    folder, truth = photograph
    path = project(folder, "projective")
    assert run(["measure", str(path)]) == 0
    assert run(["adjust", str(path)]) == 0
    assert any("gives no covariance" in note for note in measured_scan(path).notes)
    for mark in mark_rows(path):
        assert mark.status == "measured"
        assert mark.center_px is not None
        assert np.abs(mark.center_px - truth[mark.point]).max() < 0.05
    record = read_adjustment(folder / "out" / "adjustment.json")
    assert 0.4 < record.sigma0 < 1.6
    bend, values = record.scanners["1"].bend()
    scan_mm = np.array(list(truth.values())) * PITCH_UM / 1000 * (1.0, -1.0)
    film = record.images["a"].transformation.film(np.zeros(2))
    place = film.camera_from_comparator(bend.apply(values, scan_mm))
    assert np.abs(place - [PLACES[id] for id in truth]).max() < 0.003


def test_a_lens_is_that_of_opencv_both_ways_and_in_a_part_of_the_scan(
    photograph: tuple[Path, dict[str, Array]],
) -> None:
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


def test_what_is_not_known_of_the_lens_is_a_cause_of_each_marks_covariance(
    photograph: tuple[Path, dict[str, Array]],
) -> None:
    """Less what the film model takes: a shift and a scale of all marks are nobody's error."""
    folder, _ = photograph
    text = (folder / "lens.yaml").read_text(encoding="utf-8")
    storage = cv2.FileStorage(str(folder / "unsure.yaml"), cv2.FILE_STORAGE_WRITE)
    known = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    for name in ("image_width", "image_height"):
        storage.write(name, int(known.getNode(name).real()))
    for name in ("camera_matrix", "distortion_coefficients"):
        storage.write(name, known.getNode(name).mat())
    storage.write("intrinsics_covariance", np.diag([0.0, 0.0, 0.0, 0.0, 0.002**2, 0.0, 0.0, 0.0, 0.0]))
    storage.release()
    path = project(folder, "projective", '[scanner]\nlens = "unsure.yaml"\n')
    assert run(["measure", str(path)]) == 0
    sigmas = [mark.covariance.sigmas_px.get(Cause.LENS, 0.0) for mark in mark_rows(path) if mark.covariance]
    # k1 moves a mark by f k1 r^3: 600 px off the axis by 0.12 px, 850 px by 0.34, of which a scale takes most.
    assert 0.02 < min(sigmas) < max(sigmas) < 0.12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("pitch_um = 30.0\n", ""), "goes with pitch_um, one number"),
        (('transformation = "projective"', 'transformation = "none"'), "there is no film"),
        (("lens.yaml", "nothing.yaml"), "there is no such file"),
        (('lens = "lens', 'lense = "lens'), "lens"),
    ],
)
def test_a_lens_that_cannot_be_is_named(
    photograph: tuple[Path, dict[str, Array]], change: tuple[str, str], message: str
) -> None:
    path = project(photograph[0], "projective")
    path.write_text(path.read_text(encoding="utf-8").replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_project(path)


def test_a_scan_of_another_size_is_no_picture_of_the_lens(
    photograph: tuple[Path, dict[str, Array]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = photograph
    lens = read_lens(folder / "lens.yaml", PITCH_UM)
    with open_scan(folder / "scans" / "a.tif") as scan:
        assert not lens.misfit(scan)
        assert "Give the image uncropped" in replace(lens, size_px=(1000, 900)).misfit(scan)
    path = project(folder, "projective", '[scanner]\nlens = "small.yaml"\n')
    text = (folder / "lens.yaml").read_text(encoding="utf-8")
    (folder / "small.yaml").write_text(text.replace("image_width: 1534", "image_width: 1500"), encoding="utf-8")
    assert run(["measure", str(path)]) == 2
    assert "calibrated for 1500 x 1534 px" in " ".join(capsys.readouterr().err.split())


def test_a_perspective_is_found_where_an_affine_film_is_stated(photograph: tuple[Path, dict[str, Array]]) -> None:
    folder, truth = photograph
    path = project(folder, "affine")
    assert run(["measure", str(path)]) == 1
    marks = mark_rows(path)
    assert all(mark.status == "measured" for mark in marks)
    assert all(np.abs(mark.center_px - truth[mark.point]).max() < 0.05 for mark in marks if mark.center_px is not None)
    said = [str(problem) for problem in measured_scan(path).frame.problems if "perspective" in problem.codes]
    assert len(said) == 1
    assert 'transformation = "projective"' in said[0]


def test_a_scene_with_a_taking_lens_gives_a_project_with_it(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text(f"principal_distance_mm = 60.0\n{CAMERA}", encoding="utf-8")
    (tmp_path / "scene.toml").write_text(
        'camera = "camera.toml"\n[field]\nkind = "natural"\n[scan]\npitch_um = 100.0\nmargin_mm = 3.0\n'
        "[scan.lens]\nfocal_px = 600.0\nk1 = -0.1\n[[image]]\nname = 'a'\nposition = [0, 0, 3]\n"
        "angles_deg = [0, 0, 0]\n",
        encoding="utf-8",
    )
    assert run(["render", str(tmp_path / "scene.toml"), str(tmp_path / "out")]) == 0
    made = read_project(tmp_path / "out" / "project.toml")
    assert made.lens is not None
    assert made.lens.size_px == (460, 460)
    np.testing.assert_allclose(made.lens.lens.interior, [60.0, 22.95, -22.95])
    assert made.lens.lens.parameters[0] == -0.1
