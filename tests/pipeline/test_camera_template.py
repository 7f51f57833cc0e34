"""Camera files made from a kind of marks and their distances: accepted, and good for scans of such a camera."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.scans.opening import open_scan
from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.camera_template import MARK_KINDS, CameraSizes, camera_template
from pipeline.rendered.scene_file import render_project
from pipeline.review.camera_drawing import CameraDrawing, ClickedMark, place_frame
from pipeline.review.drawing_view import fit_drawing

SIZE_MM = 20.0
SCENE = """name = "one"
seed = 4
camera = "camera.toml"
[field]
kind = "natural"
unit = "m"
[picture]
background = "plain"
pad_mm = {pad_mm}
[picture.tones]
dark_mark = 0.06
border = 0.06
[film]
transformation = "affine"
dust = 0
scratches = 0
hairs = 0
[scan]
pitch_um = 40.0
margin_mm = 1.5
[[image]]
name = "one"
position = [0.0, 0.0, 5.0]
angles_deg = [0.0, 0.0, 0.0]
"""
POLARITY = {"notch": "light", "wedge": "dark", "wing": "dark"}


def sizes(kind: str, place: str) -> CameraSizes:
    size = (SIZE_MM, SIZE_MM)
    return CameraSizes((kind,), size if place == "square" else None, size if place == "side" else None, None, 30.0)


def image_camera(folder: Path, made: CameraSizes) -> CameraFile:
    (folder / "camera.toml").write_text(camera_template(made), encoding="utf-8")
    return read_camera(folder / "camera.toml")


@pytest.mark.parametrize("kind", [kind for kind in MARK_KINDS if kind != "learned"])
def test_a_rendered_frame_of_each_kind_is_measured_with_its_template(kind: str, tmp_path: Path) -> None:
    """The scene shows the marks light or dark, as they are on film; the file that measures them leaves that open."""
    place = MARK_KINDS[kind].at[-1]
    given = image_camera(tmp_path, sizes(kind, place))
    text = (tmp_path / "camera.toml").read_text(encoding="utf-8")
    (tmp_path / "camera.toml").write_text(
        text.replace('polarity = "auto"', f'polarity = "{POLARITY.get(kind, "light")}"'), encoding="utf-8"
    )
    pad_mm = 0.0 if MARK_KINDS[kind].edge_mm is not None else 1.6
    (tmp_path / "scene.toml").write_text(SCENE.format(pad_mm=pad_mm), encoding="utf-8")
    render_project(tmp_path / "scene.toml", tmp_path / "out", lambda *_: None)
    truth = json.loads((tmp_path / "out" / "truth.json").read_text(encoding="utf-8"))["images"]["one"]["fiducials"]
    with open_scan(next((tmp_path / "out" / "scans").iterdir())) as scan:
        frame = measure_fiducials(scan, given.layout(), scan.pitch_um, FiducialOptions(pose="0", writing="none"))
    for mark in frame.marks:
        true = np.array([truth[mark.point]["col_px"], truth[mark.point]["row_px"]])
        assert mark.status is Status.MEASURED or kind == "frame-corner", mark  # the ground there is no even edge
        assert mark.covariance_px2 is not None
        off_px = np.asarray(mark.center_px) - true
        assert off_px @ np.linalg.solve(mark.covariance_px2, off_px) < 20.0, (mark, true)  # one in 20,000


def test_a_wing_is_fitted_on_the_review_page_as_far_as_it_is_true(tmp_path: Path) -> None:
    """Beyond the frame's edge it merges into the border. Clicked 3 px off."""
    given = image_camera(tmp_path, sizes("wing", "side"))
    text = (tmp_path / "camera.toml").read_text(encoding="utf-8").replace('"auto"', '"dark"')
    (tmp_path / "camera.toml").write_text(text, encoding="utf-8")
    (tmp_path / "scene.toml").write_text(SCENE.format(pad_mm=0.0), encoding="utf-8")
    render_project(tmp_path / "scene.toml", tmp_path / "out", lambda *_: None)
    truth = json.loads((tmp_path / "out" / "truth.json").read_text(encoding="utf-8"))["images"]["one"]["fiducials"]
    true = {one.id: np.array([truth[one.id]["col_px"], truth[one.id]["row_px"]]) for one in given.fiducials}
    marks = tuple(ClickedMark(id, (float(px[0]) + 2.0, float(px[1]) - 2.0)) for id, px in true.items())
    wing = tomllib.loads(text)["mark"]["side"]
    drawn = {key: wing[key] for key in ("kind", "vertices_mm", "rotate")}
    drawing = CameraDrawing("one", drawn, marks, "5", frame_mm=given.frame_mm or (0.0, 0.0))
    with open_scan(next((tmp_path / "out" / "scans").iterdir())) as scan:
        placement = place_frame(drawing, (scan.width_px, scan.height_px), scan.pitch_um, "")
        fitted = fit_drawing(drawing, placement, scan)
    for one in fitted.marks:
        assert not one.unfitted
        assert np.hypot(*(np.array(one.px) - true[one.id])) < 0.02, one


def test_eight_marks_of_an_aerial_camera_have_the_places_and_names_of_calibration_reports() -> None:
    text = camera_template(CameraSizes(("cross", "ring-cross"), (212.0, 212.0), (220.0, 220.0)))
    assert len(text.splitlines()) < 40
    for line in (
        "frame_mm = [228, 228]",
        '{id = "1", xy_mm = [-106, -106], sigma_mm = 1.0, mark = "corner"}',
        '{id = "2", xy_mm = [106, 106], sigma_mm = 1.0, mark = "corner"}',
        '{id = "6", xy_mm = [110, 0], sigma_mm = 1.0, mark = "side"}',
        '{id = "8", xy_mm = [0, -110], sigma_mm = 1.0, mark = "side"}',
    ):
        assert line in text


def test_marks_to_be_learned_ask_for_clicks(tmp_path: Path) -> None:
    camera = image_camera(tmp_path, sizes("learned", "square"))
    assert len(camera.learned) == 4
    assert camera.needs_clicks


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


def test_the_command_prints_a_file_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["template", "camera", "--marks", "ring-cross", "--square", "212", "--side", "226x220"]) == 0
    (tmp_path / "camera.toml").write_text(capsys.readouterr().out, encoding="utf-8")
    assert [one.xy_mm for one in read_camera(tmp_path / "camera.toml").fiducials][4:6] == [(-113.0, 0.0), (113.0, 0.0)]
    assert run(["template", "project", "--marks", "cross"]) == 2
    assert "--c go with `reseau template camera --marks KIND`" in capsys.readouterr().err
