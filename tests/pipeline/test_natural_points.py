"""Natural points on rendered terrain, whose places in all frames the scene itself says."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import Loses
from scipy.spatial.distance import pdist

from adjust.functional_model.lens import Prior
from measure.flags import Code, Status
from measure.tie_points.features import TieFrame
from measure.tie_points.find_points import TieOptions, measure_ties
from measure.tie_points.tracks import TieCandidate
from pipeline.adjusting.network import build_network
from pipeline.errors import InputError
from pipeline.files.project_file import read_project
from pipeline.measuring.tie_stage import check_tie_names
from pipeline.results.comparator_file import read_comparator
from synthetic_images.film import FrameGeometry
from synthetic_images.render import render_scene
from synthetic_images.scene import DiskField, Distortion, Film, Scanner, Scene, SceneCamera, SceneImage
from synthetic_images.terrain import transferred

SCENE = Scene(
    name="crosswise",
    seed=3,
    camera=SceneCamera("c", (38.0, 38.0), 35.0, (0.02, -0.03), Distortion("torlegard", {"k3": 3e-6})),
    field=DiskField((), 1.0),
    images=(
        SceneImage("a", (-130.0, 3.0, 600.0, 0.004, -0.005, 0.007)),
        SceneImage("b", (130.0, -5.0, 605.0, -0.005, 0.002, -0.01), pose="180"),
        SceneImage("c", (-65.0, 6.0, 595.0, 0.002, 0.007, 1.58), pose="90m"),
    ),
    scanner=Scanner((80.0, 80.0), margin_mm=1.0, noise=0.004),
    film=Film(grain=0.008, grain_px=0.6, deformation_um=5.0),
    background="terrain",
    relief=2.3,
)


def tie_frame(geometry: FrameGeometry, folder: Path) -> TieFrame:
    name = geometry.image.name
    pixel_from_camera = np.linalg.inv(geometry.camera_from_pixel)[:2].astype(np.float64)
    return TieFrame(name, folder / "scans" / f"{name}.tif", pixel_from_camera, (38.0, 38.0), np.zeros((0, 3)))


@pytest.mark.study
def test_natural_points_are_where_the_scene_says(tmp_path: Path) -> None:
    truth = render_scene(SCENE, tmp_path)
    geometry = {frame.geometry.image.name: frame.geometry for frame in truth.frames}
    frames = [tie_frame(each, tmp_path) for each in geometry.values()]
    ties = measure_ties(frames, TieOptions(wanted=24))
    assert not ties.problems
    marks = {image: {mark.point: mark for mark in own} for image, own in ties.marks.items()}
    errors, claimed = [], []
    for image, own in marks.items():
        for name, mark in own.items():
            if mark.status is not Status.MEASURED or mark.quality["reference"]:
                continue
            start = next(i for i in marks if name in marks[i] and marks[i][name].quality.get("reference"))
            place = marks[start][name].center_px
            assert place is not None
            assert mark.center_px is not None
            errors.append(mark.center_px - transferred(place[None], geometry[start], geometry[image])[0])
            claimed.append(mark.quality["sigma_to_reference_px"])
    assert len(errors) > 41
    assert np.sqrt(np.mean(np.square(errors))) < 0.1
    assert np.linalg.norm(errors, axis=1).max() < 0.5
    assert np.sqrt(np.mean(np.square(errors))) < 1.3 * np.median(claimed)
    places = np.array([mark.center_px for mark in marks["a"].values()])
    assert np.ptp(places, axis=0).min() > 185.0
    for own in marks.values():
        observed = [mark.center_px for mark in own.values() if mark.status in (Status.MEASURED, Status.WEAK)]
        assert pdist(np.array(observed)).min() > 26.0, "patches of 31 px overlap"


@pytest.mark.study
def test_a_worker_that_is_ended_costs_its_scan_or_its_point_and_none_else(tmp_path: Path) -> None:
    """One process is ended over scan d, another one over a point; and scan e is gone."""
    images = (*SCENE.images, replace(SCENE.images[0], name="d"), replace(SCENE.images[0], name="e"))
    truth = render_scene(replace(SCENE, images=images), tmp_path)
    frames = [tie_frame(frame.geometry, tmp_path) for frame in truth.frames]
    frames[4].scan.unlink()
    points = list[TieCandidate]()

    def is_deadly(_: object, args: tuple[Any, ...]) -> bool:
        """Of a scan and of a point that begins a chunk."""
        item = args[1][0]
        if isinstance(item, TieFrame):
            return item.image == "d"
        if isinstance(item, tuple) and isinstance(item[0], TieCandidate):
            points.append(item[0])
            return np.array_equal(item[0].maps[item[0].reference], points[0].maps[points[0].reference])
        return False

    ties = measure_ties(frames, TieOptions(wanted=6), workers=Loses(is_deadly))
    assert {image: [reason.code for reason in own] for image, own in ties.problems.items()} == {
        "d": [Code.UNREACHABLE],
        "e": [Code.UNREACHABLE],
    }
    assert "its process was ended" in str(ties.problems["d"][0])
    assert "e.tif" in str(ties.problems["e"][0])
    marks = [mark for image in "abc" for mark in ties.marks[image]]
    lost = [mark for mark in marks if Code.UNREACHABLE in mark.reason.codes]
    assert len(lost) == 3
    assert {mark.status for mark in lost} == {Status.REJECTED}
    assert sum(mark.status is Status.MEASURED for mark in marks) >= 15


PROJECT = """camera = "camera.toml"
[object]
points = "points.csv"
[ties]
height = 42.0
height_sigma = 0.05
"""
CAMERA = 'name = "c"\nprincipal_distance_mm = 100.0\nprincipal_point_mm = [0.0, 0.0]\n'
POINTS = ("tie0001", "tie0002", "7", "8")
ROWS = "image,point,kind,x_mm,y_mm\n" + "".join(
    f"{image},{point},tie,{k}.5,{k * k}.25\n" for image in "ab" for k, point in enumerate(POINTS)
)


def written(folder: Path, project: str = PROJECT) -> Path:
    (folder / "camera.toml").write_text(CAMERA)
    (folder / "points.csv").write_text("point,X,Y,Z,sX,sY,sZ\n7,1.0,2.0,3.0,,,0.01\n8,5.0,2.0,3.0,,,0.01\n")
    (folder / "comparator.csv").write_text(ROWS)
    (folder / "project.toml").write_text(project)
    return folder / "project.toml"


def test_of_natural_points_the_height_of_the_ground_is_known(tmp_path: Path) -> None:
    project = read_project(written(tmp_path))
    network, _ = build_network(project, read_comparator(project.comparator))
    assert Prior(42.0, 0.05) == network.point_by_id["tie0001"].Z
    assert network.point_by_id["tie0001"].X is None
    assert Prior(3.0, 0.01) == network.point_by_id["7"].Z


@pytest.mark.parametrize(
    ("ties", "words"),
    [
        ("images = 2", "two prove nothing"),
        ("wanted = 0", "at least 1"),
        ("height = 3.0", "height_sigma"),
        ("hight = 3.0", "hight"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path: Path, ties: str, words: str) -> None:
    path = written(tmp_path, f'camera = "camera.toml"\n[ties]\n{ties}\n')
    with pytest.raises(InputError, match=words):
        read_project(path)


def test_given_points_do_not_take_the_names_of_natural_points(tmp_path: Path) -> None:
    path = written(tmp_path)
    (tmp_path / "points.csv").write_text("point,X,Y,Z\ntie7,1,2,3\n")
    with pytest.raises(InputError, match="'tie7'"):
        check_tie_names(read_project(path))
