"""Marks that nobody has drawn, from rendered scans to comparator coordinates: shown by clicks, or by what recurs."""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from shutil import copy, copytree
from unittest.mock import Mock

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from projects import fiducial_tables, measure_scan, present, write_tables
from rich.console import Console

from measure import FrameMeasurement, MarkTemplate
from pipeline import InputError, read_camera
from pipeline.files.project_file import Project, read_project
from pipeline.measuring import learn_stage
from pipeline.measuring.learn_stage import learn_marks
from pipeline.measuring.scan_measurement import measured_scan
from pipeline.measuring.scan_task import scan_tasks
from pipeline.terminal import Reporter
from synthetic_images import areas, scene
from synthetic_images.render import render_scene

Array = NDArray[np.float64]

CORNERS = {"1": (6.0, -6.0), "2": (-6.0, -6.0), "3": (-6.0, 6.0), "4": (6.0, 6.0)}
ARROW = areas.polygon(((0.0, 0.0), (1.1, 0.2), (0.5, 0.5), (0.3, 0.7)))  # lopsided: a mirror shows
LEARNED = 'name = "small"\nframe_mm = [16.0, 16.0]\n[mark.m]\nkind = "learned"\nsize_mm = 2.4\n'


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a landscape with an arrow at each corner of a dark pad."""
    folder = tmp_path_factory.mktemp("learned")
    images = tuple(
        scene.SceneImage(f"f{k}", (40.0 * k, 10.0 * k, 100.0, 0.0, 0.0, 0.5 * k), turn_rad=0.004 * k) for k in range(3)
    )
    mark = scene.DrawnMark((ARROW,))
    fiducials = tuple(scene.SceneFiducial(id, place, mark) for id, place in CORNERS.items())
    camera = scene.SceneCamera("small", (16.0, 16.0), 30.0, fiducials=fiducials)
    scanner = scene.SceneScanner((50.0, 50.0), margin_mm=1.0, noise=0.004)
    field = scene.DiskField((), 1.0)
    made = scene.Scene("learned", 3, camera, field, images, scanner, background="terrain", pad_mm=1.6)
    render_scene(made, folder)
    return folder


def make_project(folder: Path, camera: str, scans: str = '"scans/*.tif"', pose: str = "0") -> Project:
    given = fiducial_tables({id: (x + 0.2, y - 0.3) for id, (x, y) in CORNERS.items()}, 'mark = "m"\n')
    text = f'camera = "camera.toml"\nscans = [{scans}]\npitch_um = 50.0\n[measure]\npose = "{pose}"\ntone = "linear"'
    return read_project(write_tables(folder, text, camera=camera + given))


def truth(folder: Path) -> dict[str, Array]:
    images = json.loads((folder / "truth.json").read_text())["images"]
    return {
        name: np.array([[image["fiducials"][id]["col_px"], image["fiducials"][id]["row_px"]] for id in CORNERS])
        for name, image in images.items()
    }


def clicked(places: Iterable[Sequence[float]], scan: str = "f1.tif") -> str:
    """The camera file's table of clicks at these places."""
    lines = "".join(f"{id} = [{col:.0f}, {row:.0f}]\n" for id, (col, row) in zip(CORNERS, places, strict=True))
    return f'[clicks]\nscan = "{scan}"\n[clicks.px]\n{lines}'


def clicks(folder: Path) -> str:
    return clicked((truth(folder)["f1"] + (1.7, -2.2)).tolist())


def learned(project: Project) -> Project:
    """Without a memory of earlier runs."""
    reporter, memory = Reporter(Console(quiet=True)), Mock(recall=lambda _: None)
    folder = project.output / "learned"
    return learn_marks(project, reporter, lambda tasks: map(measured_scan, tasks), None, folder, memory)


def assert_measured_alike(project: Project, first: FrameMeasurement) -> None:
    """The camera file that learning left gives the same marks as the run that learned them."""
    text = project.path.read_text().replace('"camera.toml"', '"out/learned/camera.toml"')
    (project.path.parent / "again.toml").write_text(text)
    second = measure_scan(learned(read_project(project.path.parent / "again.toml")), first.image).frame
    assert first.pose == second.pose
    for one, other in zip(first.marks, second.marks, strict=True):
        assert (one.point, one.status, one.reason) == (other.point, other.status, other.reason)
        np.testing.assert_allclose(np.array(one.center_px), np.array(other.center_px), atol=1e-6)
        np.testing.assert_allclose(np.array(one.covariance_px2), np.array(other.covariance_px2), rtol=1e-6)


@pytest.fixture(scope="module")
def clicked_projects(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Project, Project]:
    """The project whose marks were clicked in one of its scans, before and after these were learned."""
    folder = tmp_path_factory.mktemp("shown")
    project = make_project(folder, LEARNED + clicks(rendered), f'"{rendered}/scans/*.tif"')
    return project, learned(project)


def assert_off_alike(frames: list[FrameMeasurement], true: dict[str, Array]) -> None:
    off = np.array(
        [np.array([mark.center_px for mark in frame.marks]) - true[frame.image] for frame in frames], dtype=float
    )
    assert all(mark.status.is_observation for frame in frames for mark in frame.marks)
    scatter = off - off.mean(axis=0)  # the offset turns with the frames by 0.008 rad at most
    assert np.abs(scatter).max() < 0.026 + 0.008 * np.abs(off).max()
    assert np.abs(off).max() < 24.0  # half of size_mm


@pytest.mark.study
def test_marks_learned_from_clicks_lie_off_alike(rendered: Path, clicked_projects: tuple[Project, Project]) -> None:
    """In the scan that was clicked in, and in another one."""
    assert_off_alike([measure_scan(clicked_projects[1], name).frame for name in ("f0", "f1")], truth(rendered))


@pytest.mark.study
def test_marks_that_recur_lie_off_alike(rendered: Path) -> None:
    project = make_project(rendered, LEARNED)
    known = learned(project)
    frames = [measure_scan(known, name).frame for name in ("f0", "f2")]
    assert_off_alike(frames, truth(rendered))
    assert_measured_alike(project, frames[0])


@pytest.mark.study
def test_a_scan_that_lies_otherwise_is_known_by_its_pictures(rendered: Path, tmp_path: Path) -> None:
    """Turned by a quarter: the arrows point elsewhere."""
    for folder in ("scans", "turned"):
        (tmp_path / folder).mkdir()
    copy(rendered / "scans" / "f1.tif", tmp_path / "scans")
    copy(rendered / "truth.json", tmp_path)
    upright = tifffile.imread(rendered / "scans" / "f2.tif")
    tifffile.imwrite(tmp_path / "scans" / "f2.tif", np.rot90(upright))  # counter-clockwise
    project = make_project(tmp_path, LEARNED + clicks(rendered), pose="auto")
    known = learned(project)
    assert scan_tasks(known, ["f1"])[0].options.fiducials.pose == "0"
    turned = measure_scan(known, "f2").frame
    assert turned.pose is not None
    assert (turned.pose.name, turned.pose.decided) == ("90", True), turned.pose.evidence
    for mark, (col, row) in zip(turned.marks, truth(rendered)["f2"].tolist(), strict=True):
        np.testing.assert_allclose(np.asarray(mark.center_px), (row, upright.shape[1] - 1 - col), atol=5.0)
    assert_measured_alike(project, turned)


@pytest.mark.study
def test_one_scan_must_be_clicked_and_says_what_it_can_tell(rendered: Path) -> None:
    project = make_project(rendered, LEARNED, '"scans/f1.tif"')
    with pytest.raises(InputError, match="with one scan nothing says what is a mark"):
        learned(project)
    frame = measure_scan(learned(make_project(rendered, LEARNED + clicks(rendered), '"scans/f1.tif"')), "f1").frame
    assert {str(mark.status) for mark in frame.marks} == {"weak"}
    assert "its template is its own picture" in frame.marks[0].reason
    assert all(0 < np.trace(np.asarray(mark.covariance_px2)) < 0.01 for mark in frame.marks)


def test_cameras_named_alike_are_stored_apart(rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second in another folder, beside a third that has the name which the second would get. What is stored of each
    is its first pictures: it has no second scan to seek them in."""
    monkeypatch.setattr(learn_stage, "_chips", lambda *_: ({}, set()))
    files = {"f0": "a/camera.toml", "f1": "b/camera.toml", "f2": "b/camera-2.toml"}
    make_project(tmp_path, LEARNED, f'"{rendered}/scans/*.tif"')
    given = (tmp_path / "camera.toml").read_text()
    for name, places in truth(rendered).items():
        (tmp_path / files[name]).parent.mkdir(exist_ok=True)
        (tmp_path / files[name]).write_text(given.replace("small", name) + clicked(places.tolist(), f"{name}.tif"))
    rows = "".join(f"{image},{file}\n" for image, file in files.items())
    (tmp_path / "images.csv").write_text(f"image,camera\n{rows}")
    text = (tmp_path / "project.toml").read_text()
    (tmp_path / "project.toml").write_text(text.replace('"c', '"a/c') + '[object]\nimages = "images.csv"\n')
    known = learned(read_project(tmp_path / "project.toml"))
    for image, file in {"f0": "camera.toml", "f1": "camera-3.toml", "f2": "camera-2.toml"}.items():
        for camera in (known.image_camera(image), read_camera(tmp_path / "out" / "learned" / file)):
            assert present(camera.learned_from).scan == image


def test_marks_are_of_one_project(clicked_projects: tuple[Project, Project], rendered: Path, tmp_path: Path) -> None:
    """There f1 is another scan than the one that they were clicked in."""
    for name, other in (("f1", "f0"), ("f2", "f2")):
        copy(rendered / "scans" / f"{other}.tif", tmp_path / f"{name}.tif")
    stored = clicked_projects[0].output / "learned"
    copytree(stored, tmp_path / "cameras")
    make_project(tmp_path, LEARNED, '"*.tif"')
    text = (tmp_path / "project.toml").read_text().replace('"camera.toml"', '"cameras/camera.toml"')
    (tmp_path / "project.toml").write_text(text)
    known = learned(read_project(tmp_path / "project.toml"))
    marks = [fiducial.mark for camera in known.cameras.values() for fiducial in camera.fiducials]
    for mark in marks:
        assert isinstance(mark, MarkTemplate)
        assert mark.shares.keys().isdisjoint(known.scans)


def test_what_was_learned_is_stored_whole_and_read_without_it_too(clicked_projects: tuple[Project, Project]) -> None:
    """A file of before has none of what a template's pixels tell, and is read as then. Another scan of the name of the
    one clicked in says nothing of the pose."""
    project, camera = clicked_projects[0], clicked_projects[1].default_camera
    folder = project.output / "learned"
    stored = (folder / "camera.toml").read_text()
    again = read_camera(folder / "camera.toml")
    assert again.learned_from == camera.learned_from
    assert [(one.xy_mm, one.prior_sigma_mm) for one in again.fiducials] == [
        (one.xy_mm, one.prior_sigma_mm) for one in project.default_camera.fiducials
    ]
    for one, other in zip(camera.fiducials, again.fiducials, strict=True):
        assert isinstance(one.mark, MarkTemplate)
        assert isinstance(other.mark, MarkTemplate)
        np.testing.assert_array_equal(one.mark.steadiness, present(other.mark.steadiness))
        assert other.mark.shares.keys() == {"f0", "f1", "f2"}
    tables = [table for table in re.split(r"(?m)^(?=\[)", stored) if "learned" not in table.splitlines()[0]]
    before = re.sub(r"seen_mm.*\n", "", "".join(tables))
    (folder / "before.toml").write_text(before)
    old = read_camera(folder / "before.toml").fiducials[0].mark
    assert isinstance(old, MarkTemplate)
    assert old.steadiness is None
    second = replace(project, cameras={"camera.toml": again}, pose="auto")
    third = replace(second, scans={**project.scans, "f1": project.scans["f2"]})
    for each, pose in ((second, "0"), (third, "auto")):
        known = learned(each)
        assert scan_tasks(known, ["f1"])[0].options.fiducials.pose == pose


def test_clicks_that_cannot_be_are_refused(rendered: Path) -> None:
    with pytest.raises(InputError, match="says nothing of 4"):
        make_project(rendered, LEARNED + clicks(rendered).rsplit("4 =", 1)[0])
    project = make_project(rendered, LEARNED + clicks(rendered).replace("f1.tif", "g1.tif"))
    with pytest.raises(InputError, match="'g1', which is none of this camera's scans"):
        learned(project)
    camera = project.default_camera
    clicked_in = present(camera.clicks)
    outside = replace(camera, clicks=replace(clicked_in, scan="f1", px={**clicked_in.px, "2": (9999.0, 3.0)}))
    with pytest.raises(InputError, match=r"click of fiducial '2', \[9999.0, 3.0\], lies outside"):
        learned(replace(project, cameras={"camera.toml": outside}))


SHOWN: dict[int, tuple[str, Callable[..., tuple[float, float]]]] = {
    2: ("0m", lambda col, row, last_col, _: (last_col - col, row)),
    3: ("180", lambda col, row, last_col, last_row: (last_col - col, last_row - row)),
    4: ("180m", lambda col, row, _, last_row: (col, last_row - row)),
    5: ("90m", lambda col, row, *_: (row, col)),
    6: ("270", lambda col, row, _, last_row: (last_row - row, col)),
    7: ("270m", lambda col, row, last_col, last_row: (last_row - row, last_col - col)),
    8: ("90", lambda col, row, last_col, _: (row, last_col - col)),
}  # how a viewer shows a frame of pose 0, by the tag's own definition (TIFF 6.0, page 36)


@pytest.mark.parametrize(("tag", "pose"), [*((tag, "0") for tag in SHOWN), (3, "auto")])
def test_clicks_in_a_picture_turned_by_a_tag_are_doubted(tag: int, pose: str, rendered: Path, tmp_path: Path) -> None:
    picture = tifffile.imread(rendered / "scans" / "f1.tif")
    (tmp_path / "scans").mkdir()
    tifffile.imwrite(tmp_path / "scans" / "f1.tif", picture, extratags=[(274, 3, 1, tag, True)])
    last_row, last_col = (size - 1 for size in picture.shape[:2])
    places = [SHOWN[tag][1](col, row, last_col, last_row) for col, row in truth(rendered)["f1"].tolist()]
    does = "sets 0" if pose == "0" else "sets none"
    words = f"in the scan orientation {SHOWN[tag][0]}, and the project {does}.*orientation tag .{tag}. asks viewers"
    with pytest.raises(InputError, match=words):
        learned(make_project(tmp_path, LEARNED + clicked(places), pose=pose))
