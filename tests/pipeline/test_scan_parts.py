"""Pages and windows of a scan's file that images.csv names: each an image of its own, in pixels of the whole page."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from measure.flags import Status
from pipeline.cli import LOOK, WRONG_INPUT, run
from pipeline.files.project_file import read_project
from pipeline.measuring.scan_measurement import measured_scan
from pipeline.measuring.scan_task import scan_tasks
from pipeline.results.comparator_file import read_comparator
from pipeline.results.measured_record import MeasuredScan
from synthetic_images import areas, scene
from synthetic_images.render import render_scene

Array = NDArray[np.float64]

CORNERS = {"1": (-7.0, -7.0), "2": (7.0, -7.0), "3": (7.0, 7.0), "4": (-7.0, 7.0)}
CROSS = (areas.bar((-0.9, 0.0), (0.9, 0.0), 0.15), areas.bar((0.0, -0.9), (0.0, 0.9), 0.15))


@pytest.fixture(scope="module")
def roll(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of one TIFF: its first page shows frames f1 and f2 side by side, its second one f2 alone."""
    folder = tmp_path_factory.mktemp("roll")
    fiducials = tuple(scene.SceneFiducial(id, place, scene.DrawnMark(CROSS)) for id, place in CORNERS.items())
    camera = scene.SceneCamera("small", (16.0, 16.0), 30.0, fiducials=fiducials)
    images = tuple(scene.SceneImage(f"f{k}", (40.0 * k, 0.0, 100.0, 0.0, 0.0, 0.5 * k), pose="0") for k in (1, 2))
    scanner = scene.Scanner((50.0, 50.0), margin_mm=1.0, noise=0.004)
    made = scene.Scene("roll", 5, camera, scene.DiskField((), 1.0), images, scanner, background="terrain", pad_mm=1.6)
    render_scene(made, folder)
    one, two = (tifffile.imread(folder / "scans" / f"f{k}.tif") for k in (1, 2))
    for file in (folder / "scans").iterdir():
        file.unlink()
    with tifffile.TiffWriter(folder / "scans" / "roll.tif") as writer:
        writer.write(np.hstack([one, two]), metadata=None)
        writer.write(two, metadata=None)
    given = "".join(f'[[fiducial]]\nid = "{id}"\nxy_mm = [{x}, {y}]\nmark = "m"\n' for id, (x, y) in CORNERS.items())
    (folder / "camera.toml").write_text(
        f'name = "small"\nframe_mm = [16.0, 16.0]\nprincipal_distance_mm = 30.0\n{given}'
        '[mark.m]\nkind = "cross"\narm_mm = 0.9\nline_mm = 0.15\n'
    )
    (folder / "project.toml").write_text(
        'camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = 50.0\n[measure]\npose = "0"\nwriting = "none"\n'
    )
    return folder


def truth(folder: Path, image: str) -> Array:
    places = json.loads((folder / "truth.json").read_text())["images"][image]["fiducials"]
    return np.array([[places[id]["col_px"], places[id]["row_px"]] for id in CORNERS])


def measure_picture(folder: Path, image: str) -> MeasuredScan:
    (task,) = scan_tasks(read_project(folder / "project.toml"), [image])
    return measured_scan(task)


def test_what_a_scan_shows_next_to_the_frame_that_was_measured_needs_attention(roll: Path) -> None:
    scan = measure_picture(roll, "roll")
    finding = " ".join(scan.frame.problems)
    assert "2 pictures of full size (pages 1, 2), and page 1 was measured" in finding
    assert "shows a second frame" in finding or "shows another frame" in finding
    assert "in images.csv" in finding


def test_pages_and_windows_are_images_of_their_own(roll: Path, capsys: pytest.CaptureFixture[str]) -> None:
    width = tifffile.imread(roll / "scans" / "roll.tif", key=1).shape[1]
    whole = roll / "whole.toml"
    whole.write_text((roll / "project.toml").read_text() + '[object]\nimages = "images.csv"\n')
    height = tifffile.imread(roll / "scans" / "roll.tif", key=1).shape[0]
    lines = [f"roll-a,1,0 0 {width} {height}", f"roll-b,1,{width} 0 {width} {height}", "roll-c,2,"]
    (roll / "images.csv").write_text("\n".join(["image,page,window", *lines]) + "\n")
    assert run(["measure", str(whole)]) in (0, LOOK)
    rows = {(row.image, row.point): row for row in read_comparator(roll / "comparator.csv")}
    assert {image for image, _ in rows} == {"roll-a", "roll-b", "roll-c"}
    first, second = truth(roll, "f1"), truth(roll, "f2")
    for image, places in (("roll-a", first), ("roll-b", second + np.array([width, 0])), ("roll-c", second)):
        for id, place in zip(CORNERS, places, strict=True):
            row = rows[image, id]
            assert row.status is Status.MEASURED
            assert row.xy_mm is not None
            np.testing.assert_allclose(row.xy_mm / 0.05 * (1, -1), place, atol=0.1)
    output = capsys.readouterr().out
    assert "second frame" not in output
    assert "pictures of full size" not in output
    (roll / "images.csv").write_text("image,window\nother,0 0 10 10\n")
    assert run(["measure", str(whole)]) == WRONG_INPUT
    assert "no scan is called as it begins" in capsys.readouterr().err
    (roll / "images.csv").write_text("image,window\nroll,0 0 0 10\n")
    assert run(["measure", str(whole)]) == WRONG_INPUT
    assert '"col row width height" in px' in " ".join(capsys.readouterr().err.split())


def test_a_window_is_resampled_and_its_neighbour_is_not(roll: Path, tmp_path: Path) -> None:
    """Both frames stood in each rectified scan; the second page shows the second frame alone."""
    height, width = tifffile.imread(roll / "scans" / "roll.tif", key=1).shape
    project = roll / "windows.toml"
    text = (
        (roll / "project.toml")
        .read_text()
        .replace("[measure]", 'output = "windows"\ncomparator = "windows.csv"\n[measure]')
    )
    project.write_text(text + '[object]\nimages = "windows_images.csv"\n')
    (roll / "windows_images.csv").write_text(
        f"image,page,window\nroll-a,1,0 0 {width} {height}\nroll-b,1,{width} 0 {width} {height}\nroll-c,2,\n"
    )
    assert run(["measure", str(project)]) in (0, LOOK)
    assert run(["resample", str(project), str(tmp_path), "--pitch-um", "50"]) in (0, LOOK)
    first, second, alone = (tifffile.imread(tmp_path / f"roll-{name}.tif") for name in "abc")
    assert second.shape == alone.shape
    middle = np.s_[10:-10, 10:-10]
    assert np.abs(second[middle].astype(float) - alone[middle]).max() < 0.02 * np.ptp(alone)
    assert max(np.subtract(first.shape, alone.shape)) < 8
