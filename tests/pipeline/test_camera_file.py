"""Camera files: made from templates, saved for later projects, self-calibration sets, what they may have meant."""

import json
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from networks import LENSES, lens_network
from projects import Array, Printed, Refusal, command, present, replace_text, result_file, write_network_project
from studies import parametrize_with_studies
from test_lens_families import two_networks

from adjust.problem.parameter import Parameter
from measure import FiducialOptions, FrameMeasurement, Status, measure_fiducials, open_scan
from pipeline import InputError, read_adjustment, read_project
from pipeline.cli import DONE, LOOK
from pipeline.exchange.saved_cameras import _Calibration, _combine, save_cameras
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.library import MARK_KINDS, CameraSizes, camera_template
from pipeline.files.object_files import GivenImages
from pipeline.measuring.learn_stage import prior_tone
from pipeline.measuring.scan_measurement import misplaced_principal_point
from pipeline.rendered.scene_file import render_project
from pipeline.results.adjustment_record import Quantity
from pipeline.results.measured_record import MeasuredScan
from pipeline.review.camera_drawing import CameraDrawing, ClickedMark, place_frame
from pipeline.review.drawing_view import fit_drawing

SIZE_MM = 20.0
SCENE = """name = "one"
seed = 4
camera = "camera.toml"
field = {{kind = "natural", unit = "m"}}
picture = {{background = "plain", pad_mm = {pad_mm}, tones = {{dark_mark = 0.06, border = 0.06}}}}
film = {{transformation = "affine", dust = 0, scratches = 0, hairs = 0}}
scan = {{pitch_um = {pitch_um}, margin_mm = 1.5}}
image = [{{name = "one", position = [0.0, 0.0, 5.0], angles_deg = [0.0, 0.0, 0.0]}}]
"""
POLARITY = {"notch": "light", "wedge": "dark", "wing": "dark"}


def rendered_frame(folder: Path, kind: str) -> tuple[CameraFile, dict[str, Array], Path]:
    """The camera file of a template, a scan of its frame and where its marks are. The scene shows the marks light or
    dark, as they are on film; the file leaves that open."""
    place, size = MARK_KINDS[kind].at[-1], (SIZE_MM, SIZE_MM)
    made = CameraSizes((kind,), size if place == "square" else None, size if place == "side" else None, None, 30.0)
    text = camera_template(made)
    (folder / "open.toml").write_text(text)
    drawn = text.replace('polarity = "auto"', f'polarity = "{POLARITY.get(kind, "light")}"')
    (folder / "camera.toml").write_text(drawn)
    pad_mm = 0.0 if MARK_KINDS[kind].edge_mm is not None else 1.6
    (folder / "scene.toml").write_text(SCENE.format(pad_mm=pad_mm, pitch_um=60.0 if kind == "wing" else 50.0))
    render_project(folder / "scene.toml", folder / "out", lambda *_: None)
    truth = json.loads((folder / "out" / "truth.json").read_text())["images"]["one"]["fiducials"]
    places = {id: np.array([mark["col_px"], mark["row_px"]]) for id, mark in truth.items()}
    return read_camera(folder / "open.toml"), places, next((folder / "out" / "scans").iterdir())


@pytest.mark.parametrize("kind", [kind for kind in MARK_KINDS if kind != "learned"])
def test_a_rendered_frame_of_each_kind_is_measured_with_its_template(kind: str, tmp_path: Path) -> None:
    given, places, path = rendered_frame(tmp_path, kind)
    with open_scan(path) as opened:
        scan = opened.replace_tone(prior_tone("linear", path))
        frame = measure_fiducials(scan, given.layout(), scan.pitch_um, FiducialOptions(pose="0", writing="none"))
    for mark in frame.marks:
        assert mark.status is Status.MEASURED or kind == "frame-corner", mark  # the ground there is no even edge
        off_px = np.asarray(mark.center_px) - places[mark.point]
        assert off_px @ np.linalg.solve(present(mark.covariance_px2), off_px) < 20.0, mark  # one in 20,000


def test_a_wing_is_fitted_on_the_review_page_as_far_as_it_is_true(tmp_path: Path) -> None:
    """Beyond the frame's edge it merges into the border. Clicked 3 px off."""
    given, places, path = rendered_frame(tmp_path, "wing")
    marks = tuple(ClickedMark(id, (float(px[0]) + 2.0, float(px[1]) - 2.0)) for id, px in places.items())
    wing = tomllib.loads((tmp_path / "camera.toml").read_text())["mark"]["side"]
    drawn = {key: wing[key] for key in ("kind", "vertices_mm", "rotate")}
    drawing = CameraDrawing("one", drawn, marks, "5", frame_mm=given.frame_mm or (0.0, 0.0))
    with open_scan(path) as scan:
        placement = place_frame(drawing, (scan.width_px, scan.height_px), scan.pitch_um, "")
        fitted = fit_drawing(drawing, placement, scan)
    for one in fitted.marks:
        assert not one.unfitted
        assert np.hypot(*(np.array(one.px) - places[one.id])) < 0.02, one


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("croos", "212", None, None), "Did you mean 'cross'?"),
        (("cross", None, None, None), "--square 212 for four marks in the corners, --side 226"),
        (("wedge", "212", None, None), "--marks wedge goes with --side, not with --square"),
        (("cross", "212 m", None, None), "--square '212 m' is no distance in mm"),
        (("cross,dot,cross", "212", "220", None), "two are for --square and --side"),
        (("cross", "212", None, "100"), "--frame 100: smaller than the distances of the marks"),
    ],
)
def test_what_makes_no_camera_is_stated(words: tuple[str, str | None, str | None, str | None], message: str) -> None:
    marks, square, side, frame = words
    with pytest.raises(InputError) as refused:
        CameraSizes.from_words(marks, square, side, frame, None, "x")
    assert message in str(refused.value)


def test_the_command_prints_a_file_that_loads(tmp_path: Path, printed: Printed, refusal: Refusal) -> None:
    (tmp_path / "camera.toml").write_text(
        printed("template", "camera", "--marks", "ring-cross", "--square", "212", "--side", "226x220")
    )
    assert [one.xy_mm for one in read_camera(tmp_path / "camera.toml").fiducials][4:6] == [(-113.0, 0.0), (113.0, 0.0)]
    assert "--c go with `reseau template camera --marks KIND`" in refusal("template", "project", "--marks", "cross")


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Projects a, b and both together, adjusted."""
    folder = tmp_path_factory.mktemp("archives")
    for name, (network, _) in zip("ab+", two_networks("affine", 1.0), strict=True):
        (folder / name).mkdir()
        assert command("adjust", write_network_project(network, folder / name)) in (0, 1)
    return folder


def quantities(folder: Path) -> dict[str, Quantity]:
    """Of the adjusted camera."""
    camera = read_adjustment(folder / "out" / "adjustment.json").cameras["K"]
    fiducials = {f"{id} {axis}": q for id, m in camera.fiducials.items() for axis, q in (("x", m.x_mm), ("y", m.y_mm))}
    return {**camera.interior, **fiducials}


def test_a_project_with_a_saved_camera_is_both_together(archives: Path, tmp_path: Path, printed_line: Printed) -> None:
    output = printed_line("cameras", "--save", archives / "a" / "project.toml", "--out", tmp_path / "saved")
    frames = len(read_adjustment(archives / "a" / "out" / "adjustment.json").images)
    assert f"adjusted from {frames} frames of 1 scanner in a" in output
    camera = read_camera(tmp_path / "saved" / "camera.toml")
    assert camera.source is not None
    assert (camera.source.frames, camera.source.scanners, camera.source.archives) == (frames, 1, 1)
    first = quantities(archives / "a")
    assert camera.principal_distance_mm == pytest.approx(first["c"].value, abs=1e-12)
    later = shutil.copytree(archives / "b", tmp_path / "later", ignore=shutil.ignore_patterns("out"))
    replace_text(later / "project.toml", "camera.toml", "../saved/camera.toml")
    assert command("adjust", later / "project.toml") in (0, 1)
    second, joint = quantities(later), quantities(archives / "+")
    for name, both in joint.items():
        if both.sigma > 0.0:
            assert second[name].value == pytest.approx(both.value, abs=0.1 * both.sigma), name
            assert second[name].sigma == pytest.approx(both.sigma, rel=0.1), name
    assert second["c"].sigma < 0.9 * first["c"].sigma


def test_two_archives_are_joined_to_what_both_together_give(archives: Path, tmp_path: Path) -> None:
    projects = [read_project(archives / name / "project.toml") for name in "ab"]
    (saved,) = save_cameras(projects, tmp_path)
    assert (saved.source.archives, saved.source.text.split(" in ")[1]) == (2, "a, b")
    joint, camera = quantities(archives / "+"), read_camera(saved.path)
    assert camera.calibration is not None
    held = dict(zip((one.quantity for one in camera.calibration.parameters), camera.calibration.values, strict=True))
    for name in ("c", "k3", "x0"):
        spread = saved.source.spread_mm[name]
        assert held[name] == pytest.approx(joint[name].value, abs=0.1 * joint[name].sigma), name
        sigma = np.sqrt(camera.calibration.covariance.diagonal())[list(held).index(name)]
        assert sigma == pytest.approx(np.hypot(joint[name].sigma, spread / np.sqrt(2)), rel=0.15), name


def test_projects_after_the_first_one_are_joined_and_not_dropped(
    archives: Path, tmp_path: Path, printed_line: Printed, refusal: Refusal
) -> None:
    first, second = (archives / name / "project.toml" for name in "ab")
    output = printed_line("cameras", "--save", first, second, "--out", tmp_path)
    assert "of 2 scanners in a, b" in output
    assert "--save goes without --scan" in refusal("cameras", "--save", first, "--scan", second)


@pytest.mark.parametrize(("sigmas", "tau"), [((0.02,) * 9 + (0.002,), 0.02), ((0.02, 0.001), 0.02), ((0.01,) * 4, 0.1)])
def test_standard_deviations_of_several_archives_hold(sigmas: tuple[float, ...], tau: float) -> None:
    """Of archives that differ, as precise as one another and not."""
    c = Parameter.interior("K", "c")
    record = SimpleNamespace(cameras={"K": SimpleNamespace(distortion=SimpleNamespace(settings=dict))})
    camera = SimpleNamespace(name="K")
    made: Any = _Calibration

    def calibration(value: float, sigma: float) -> Any:
        return made(None, camera, record, (c,), np.array([value]), np.array([[sigma**2]]), 1, frozenset())

    rng = np.random.default_rng(3)
    found = []
    for _ in range(800):
        drawn = [calibration(rng.normal(100.0, np.hypot(sigma, tau)), sigma) for sigma in sigmas]
        (value,), ((variance,),), _ = _combine(drawn)
        found.append((value - 100.0, variance))
    errors, variances = np.array(found).T
    assert np.sqrt(np.mean(errors**2) / variances.mean()) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize(("names", "count"), [(("V850", "V850"), 1), (("V850", "V800"), 2), (("", ""), 2)])
def test_a_scanner_of_two_archives_is_one(
    names: tuple[str, str], count: int, archives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = "pipeline.exchange.saved_cameras.current_adjustment"
    monkeypatch.setattr(stage, lambda project, marks: read_adjustment(project.adjustment_path))
    projects = []
    for folder, name in zip("ab", names, strict=True):
        project = read_project(archives / folder / "project.toml")
        images = read_adjustment(project.adjustment_path).images
        projects.append(replace(project, given_images=GivenImages({}, {}, dict.fromkeys(images, name))))
    (saved,) = save_cameras(projects, tmp_path / "saved")
    assert saved.source.scanners == count


def test_what_cannot_be_saved_is_refused(archives: Path, tmp_path: Path) -> None:
    project = read_project(archives / "a" / "project.toml")
    (tmp_path / "camera.toml").write_text('name = "own"\n')
    with pytest.raises(InputError, match="exists and was not written by"):
        save_cameras([project], tmp_path)
    (tmp_path / "camera.toml").unlink()
    (tmp_path / "camera-calibration.npz").write_text("mine")
    with pytest.raises(InputError, match=r"exists, but no camera\.toml to go with it"):
        save_cameras([project], tmp_path)
    for _ in range(2):  # over its own
        save_cameras([project], tmp_path / "saved")
    other = shutil.copytree(archives / "b", tmp_path / "b", ignore=shutil.ignore_patterns("out"))
    with pytest.raises(InputError, match="no adjustment that converged"):
        save_cameras([read_project(other / "project.toml")], tmp_path / "c")


@parametrize_with_studies("name", list(LENSES), quick=(2,))
def test_a_lens_from_the_camera_file_to_the_report(name: str, tmp_path: Path) -> None:
    """Noisy images, nothing known of the lens; what OpenCV can and cannot compare is said."""
    project = write_network_project(lens_network(name, np.random.default_rng(4)), tmp_path)
    assert command("run", project) in (DONE, LOOK)
    result = result_file(tmp_path)
    distortion = result["cameras"]["L"]["distortion"]
    assert (distortion["family"], distortion["r0_mm"]) == (name, 13.0)
    assert ("axes" in distortion) == name.startswith("opencv")
    assert 0.8 < result["sigma0"] < 1.2
    for each, value in LENSES[name][1].items():
        assert abs(distortion[each]["value"] - value) < 4.0 * distortion[each]["sigma"], each
    check = json.loads((tmp_path / "out" / "check.json").read_text())["cameras"]["L"]
    # A skew is none of cv2.calibrateCamera's models; cv2.fisheye has one.
    assert check["verdict"] == ("agrees" if name == "opencv_fisheye" else "not possible"), check["reason"]
    assert ("OpenCV's model cannot take this lens" in check["reason"]) == (name != "opencv_fisheye")
    page = (tmp_path / "out" / "report.html").read_text()
    assert ("refer to its axes, x right and y down" in page) == name.startswith("opencv")
    assert "Distortion over the radius with its 95 % band" in page


MEASURED = MeasuredScan("v.tif", 2001, 1801, (20.0, 20.0), FrameMeasurement("v", ()))
FIDUCIALS = '[[fiducial]]\nid = "1"\nxy_mm = [18.0, -16.0]\nmark = "dot"\n[mark.dot]\nkind = "dot"\nradius_mm = 0.2\n'


@pytest.mark.parametrize(
    ("given", "rest", "is_told"),
    [
        ("principal_point_mm = [0.0, 0.0]", "", True),
        ("principal_point_mm = [20.3, 18.1]", "", True),  # y counted downwards
        ("principal_point_mm = [20.3, -18.1]", "", False),
        ("", "", False),
        ("principal_point_mm = [0.0, 0.0]", FIDUCIALS, False),
    ],
)
def test_a_misplaced_principal_point_is_reported(given: str, rest: str, is_told: bool, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(f'name = "c"\nframe_mm = [40.0, 36.0]\nprincipal_distance_mm = 60.0\n{given}\n{rest}')
    result = misplaced_principal_point(read_camera(path), MEASURED)
    assert ("the middle of this scan is [20, -18]" in result) == is_told


def test_a_turned_picture_has_its_principal_point_in_the_sensor(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(
        'name = "c"\nframe_mm = [80.0, 20.0]\nprincipal_point_mm = [40.0, -10.0]\nprincipal_distance_mm = 60.0'
    )
    for width_px, height_px in ((4000, 1000), (1000, 4000)):
        taken = replace(MEASURED, width_px=width_px, height_px=height_px, pitch_um=(20.0, 20.0))
        assert misplaced_principal_point(read_camera(path), taken) == ""
