"""What goes out to other programs, read by readers of their own formulas and held against the truth."""

import csv
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, Mock
from xml.etree import ElementTree

import cv2
import numpy as np
import pyarrow.parquet
import pycolmap
import pytest
import tifffile
from foreign_readers import asp_px, colmap_px, metashape_mm, micmac_affine, micmac_px, opencv_px, values
from networks import affine, camera_point, comparator_point, halves, simulated
from numpy.typing import NDArray
from projects import (
    IMAGES,
    LENS,
    MIRRORED,
    PITCH_MM,
    POINTS,
    SIZE_PX,
    TRUTH,
    Capture,
    Refusal,
    adjusted_project,
    camera_mm,
    command,
    copied,
    frame_px,
    ideal_mm,
    make_project,
    present,
    replace_text,
    result_file,
    scan_px,
    stated_misfit_px,
)
from studies import parametrize_with_studies

from adjust import LineOfSight
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.transformation import Film
from measure.scans.remote import scan_path
from pipeline import InputError, read_project
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.exchange import exchange_stage, micmac_format, pinhole
from pipeline.exchange.block import OutFrame, read_block
from pipeline.exchange.formats import FORMATS, IMPORTED, ExportOptions
from pipeline.exchange.geojson_format import lon_lat
from pipeline.exchange.pinhole import FittedLens, frame_corners_mm, nearest_lens
from pipeline.exchange.tables import _check_words
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.results import adjustment_content
from pipeline.text.files import file_word, path_below
from synthetic_images.projection import camera_from_object, object_rotation
from synthetic_images.scene import Family, SceneCamera
from synthetic_images.scene import SceneDistortion as SceneDistortion

Array = NDArray[np.float64]

SAME_PX = 1e-6
PINHOLES: dict[str, Callable[[Path, str, Array], Array]] = {"opencv": opencv_px, "colmap": colmap_px, "asp": asp_px}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return adjusted_project(tmp_path_factory.mktemp("exported"))


def exported(project: Path, format: str, folder: Path, *options: str, code: int = DONE) -> Path:
    assert command("export", project, format, folder / format, *options) == code
    return folder / format


@pytest.fixture(scope="module")
def in_parts(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """Frames in two scans each, and their adjusted project."""
    made = halves(np.random.default_rng(3), join_count=25)
    return made, make_project(made.network, tmp_path_factory.mktemp("parts"))


@pytest.mark.parametrize("format", ["colmap", "asp"])
def test_a_frame_in_parts_is_one_picture(format: str, in_parts: tuple[Any, Path], tmp_path: Path) -> None:
    """Points lie in it as the camera images them, but for where the picture begins."""
    made, project = in_parts
    folder = exported(project, format, tmp_path)
    xyz = np.array([[getattr(point, axis).value for axis in "XYZ"] for point in made.network.points])
    for i in range(4):
        ideal_px = camera_point(made.truth, i, xyz) * (1.0, -1.0) / PITCH_MM
        off_px = PINHOLES[format](folder, f"f{i}", xyz) - ideal_px
        assert np.ptp(off_px, axis=0).max() < 0.2
    if format == "colmap":
        model = pycolmap.Reconstruction(str(folder / "sparse"))
        assert sorted(image.name for image in model.images.values()) == [f"f{i}.tif" for i in range(4)]
        assert {len(image.points2D) for image in model.images.values()} == {len(xyz)}


@pytest.mark.parametrize("affordable", [3000, 10])
def test_covariances_of_scans_in_parts_and_of_large_networks_are_exported(
    affordable: int, in_parts: tuple[Any, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both scans of a frame have its orientation; beyond some quantities those of an image stand by themselves."""
    monkeypatch.setattr(adjustment_content, "AFFORDABLE", affordable)
    project = in_parts[1] if affordable > 10 else make_project(in_parts[0].network, tmp_path)
    text = (exported(project, "csv", tmp_path) / "covariances.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()[1:]))
    images = result_file(project.parent)["images"]
    for name, image in images.items():
        frame, own = name.split(".")[0], [row for row in rows if row["image"] == name]
        (variance,) = (float(row["covariance"]) for row in own if row["first"] == row["second"] == f"EO.{frame}.Z0")
        assert variance == pytest.approx(image["exterior"]["Z0"]["sigma"] ** 2, rel=1e-9)
        (variance,) = (float(row["covariance"]) for row in own if row["first"] == row["second"] == f"T.{name}.a1")
        assert variance == pytest.approx(image["transformation"]["a1"]["sigma"] ** 2, rel=1e-9)
    assert len(images) == 8


@pytest.mark.parametrize("format", PINHOLES)
def test_frames_with_and_without_their_lens_are_as_reported(format: str, project: Path, tmp_path: Path) -> None:
    reader = PINHOLES[format]
    folder = exported(project, format, tmp_path, "--lens")
    for i in IMAGES:
        there = frame_px(i, ideal_mm(i), ideal=True)
        np.testing.assert_allclose(reader(folder, f"f{i}", POINTS), there, atol=SAME_PX, rtol=0)
    folder = exported(project, format, tmp_path)
    stated_px = stated_misfit_px(folder)
    assert 0.0 < stated_px < 0.05
    for i in IMAGES:
        off = np.linalg.norm(reader(folder, f"f{i}", POINTS) - frame_px(i, camera_mm(i)), axis=1)
        assert off.max() < 1.05 * stated_px + SAME_PX  # the told one is of a grid


def test_colmap_has_the_tracks_of_the_marks_and_opencv_the_pitch_that_was_set(project: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(exported(project, "colmap", tmp_path) / "sparse"))
    assert (model.num_points3D(), model.num_images(), model.compute_num_observations()) == (100, 4, 400)
    image = next(each for each in model.images.values() if each.name == "f0.tif")
    marks = [point.xy - 0.5 for point in image.points2D]
    np.testing.assert_allclose(marks, frame_px(0, camera_mm(0)), atol=SAME_PX)
    assert model.compute_mean_track_length() == 4.0
    assert model.compute_mean_reprojection_error() < 0.01
    fine = exported(project, "opencv", tmp_path, "--lens", "--pitch-um", "50")
    coarse = exported(project, "opencv", tmp_path / "b", "--lens", "--pitch-um", "100")
    apart = [np.diff(opencv_px(folder, "f1", POINTS), axis=0) for folder in (fine, coarse)]
    np.testing.assert_allclose(apart[0], 2.0 * apart[1], atol=1e-5)


def test_micmac_makes_the_frames_that_its_camera_is_for(project: Path, tmp_path: Path) -> None:
    """From the scan's pixels through MicMac's own fit and ReSampFid's box to the pixels of camera and pose."""
    folder = exported(project, "micmac", tmp_path)
    stated_px = stated_misfit_px(folder)
    text = (folder / "README.txt").read_text()
    box = [float(value) for value in text[text.index("BoxCh=[") + 7 :].split("]")[0].split(",")]
    assert box == [-114.0, -114.0, 114.0, 114.0]
    for i in IMAGES:
        matrix, shift = micmac_affine(folder, f"f{i}")
        made = (scan_px(i, camera_mm(i)) @ matrix.T + shift - box[:2]) / PITCH_MM
        np.testing.assert_allclose(made, (camera_mm(i) * (1, -1) - box[:2]) / PITCH_MM, atol=1e-5)
        off = np.linalg.norm(micmac_px(folder, f"f{i}", POINTS) - made, axis=1)
        assert off.max() < 1.05 * stated_px + 1e-5


def test_mmvii_has_the_whole_covariance(project: Path, tmp_path: Path) -> None:
    comparator = project.parent / "comparator.csv"
    rows = list(csv.DictReader(comparator.read_text().splitlines()[1:]))
    folder = exported(project, "mmvii", tmp_path) / "MMVII-PhgrProj" / "PointsMeasure"
    root = ElementTree.parse(folder / "Targets" / "MesIm-f1.tif.xml").getroot()
    elements = root.findall("Data/SetMesIm/Measures/el")
    assert [element.findtext("Name") for element in elements] == [f'"{j}"' for j in range(100)]
    np.testing.assert_allclose([values(e, "Pt") for e in elements], scan_px(1, camera_mm(1)), atol=SAME_PX)
    mark = next(row for row in rows if row["image"] == "f1" and row["kind"] == "target")
    sx, sy = (float(mark[name]) / PITCH_MM for name in ("sx_mm", "sy_mm"))
    np.testing.assert_allclose(values(elements[0], "Sigma2"), [sx**2, 0.0, sy**2], rtol=1e-9)
    assert len(list((folder / "Fiducials").iterdir())) == 4


def test_covariances_and_bent_sights_follow_the_axes(project: Path) -> None:
    block = read_block(read_project(project))
    frame = block.frames[0]
    mark = replace(frame.marks[0], rho=0.3, sigma_mm=np.array([0.002, 0.004]))
    text = micmac_format._mmvii_measures(replace(frame, pitch_um=(20.0, 20.0)), (mark,))
    xx, xy, yy = map(float, present(re.search(r"<Sigma2>(.*)</Sigma2>", text))[1].split())
    assert (xx, yy) == pytest.approx((0.01, 0.04))
    assert xy == pytest.approx(-0.3 * 0.1 * 0.2)
    # The earth's curvature lowers a point at 700 m by 4 cm: some 3 um in the picture.
    assert pinhole.sight_misfit_mm(block, frame) == 0.0
    bent = replace(frame, model=replace(present(frame.model), line_of_sight=LineOfSight(curvature=True)))
    reach = np.hypot(*(POINTS - TRUTH.stations[0]).T[:2])
    lowered_mm = TRUTH.c * reach**3 / (2 * 6.37e6) / (TRUTH.stations[0][2] - POINTS[:, 2]) ** 2
    assert pinhole.sight_misfit_mm(block, bent) == pytest.approx(lowered_mm.max(), rel=0.2)


def test_metashape_script_makes_film_cameras(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script against a stub of Metashape's module."""
    folder = exported(project, "metashape", tmp_path, code=LOOK)
    chunk, markers = MagicMock(), list[Any]()

    def add_photos(paths: list[str]) -> None:
        chunk.cameras = [MagicMock(label=Path(path).stem) for path in paths]

    def add_marker() -> Any:
        markers.append(MagicMock(projections={}))
        return markers[-1]

    chunk.addPhotos, chunk.addMarker, chunk.markers = add_photos, add_marker, markers
    stub = MagicMock(app=MagicMock(document=MagicMock(addChunk=lambda: chunk)))
    stub.Vector = list
    stub.Marker.Projection = lambda place, pinned: (place, pinned)
    monkeypatch.setitem(sys.modules, "Metashape", stub)
    script = folder / "reseau_to_metashape.py"
    exec(compile(script.read_text(), str(script), "exec"), {"__file__": str(script)})
    sensor = chunk.addSensor()
    assert sensor.film_camera is True
    sensor.calibrateFiducials.assert_called_once_with(PITCH_MM)
    by_label = {marker.label: marker for marker in markers}
    assert by_label["1"].reference.location == pytest.approx(POINTS[1], abs=1e-6)  # a point, and no fiducial
    pixels = {camera.label: place for camera, (place, _) in by_label["17"].projections.items()}
    assert sorted(pixels) == ["f0", "f1", "f3"]
    np.testing.assert_allclose(pixels["f1"], scan_px(1, camera_mm(1))[17] + 0.5, atol=1e-5)
    assert "f2: its scan is mirrored" in (folder / "README.txt").read_text()


def test_bingo_is_free_of_film_and_lens(project: Path, tmp_path: Path) -> None:
    text = (exported(project, "bingo", tmp_path) / "bingo.txt").read_text()
    blocks = text.strip().split("\n\n")
    assert [block.splitlines()[0] for block in blocks] == ["f0 K", "f1 K", "f2 K", "f3 K"]
    for i, block in enumerate(blocks):
        rows = [line.split() for line in block.splitlines()[1:]]
        assert [row[0] for row in rows] == [str(j) for j in range(100)]
        np.testing.assert_allclose([[float(x), float(y)] for _, x, y in rows], ideal_mm(i), atol=2e-6)


def test_footprints_hold_what_the_frames_show(tmp_path: Path) -> None:
    """In degrees as object coordinates the outline is seen by the camera at its frame's border."""
    upright = replace(TRUTH, attitudes=((0.0, 0.0, 0.1), (-0.08, 0.06, 1.6), (-0.05, -0.09, 3.0), (-0.05, 0.03, -1.5)))
    project = adjusted_project(tmp_path, upright, "EPSG:4326")
    content = json.loads((exported(project, "geojson", tmp_path) / "footprints.geojson").read_text())
    assert [feature["properties"]["image"] for feature in content["features"]] == ["f0", "f1", "f2", "f3"]
    for i, feature in enumerate(content["features"]):
        ring = np.array(feature["geometry"]["coordinates"][0])
        assert ring[0].tolist() == ring[-1].tolist()
        x, y = ring[:-1].T
        assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() > 0.0
        ground = np.column_stack([ring[:-1], np.full(len(x), feature["properties"]["ground"])])
        projected = camera_point(upright, i, ground)
        np.testing.assert_allclose(np.abs(projected).max(axis=1), 114.0, atol=1e-4)


def test_utm_is_the_conformal_map_of_its_meridian() -> None:
    """On the central meridian the northing is the arc's length, integrated here; beside it the map is conformal."""
    e2 = (2.0 - 1.0 / 298.257222101) / 298.257222101
    lat = np.radians(48.5)
    steps = (np.arange(200_000) + 0.5) / 200_000 * lat
    arc_m = 6378137.0 * (1 - e2) * ((1 - e2 * np.sin(steps) ** 2) ** -1.5).mean() * lat
    on_it = lon_lat(np.array([[500_000.0, 0.9996 * arc_m]]), "EPSG:25832")
    np.testing.assert_allclose(on_it, [[9.0, 48.5]], atol=1e-9)
    at, h = np.array([[650_000.0, 5_300_000.0]]), 50.0
    d = [(lon_lat(at + step, "EPSG:32632") - lon_lat(at - step, "EPSG:32632"))[0] for step in ((h, 0.0), (0.0, h))]
    phi = np.radians(lon_lat(at, "EPSG:32632")[0, 1])
    isometric = (1 - e2) / (1 - e2 * np.sin(phi) ** 2) / np.cos(phi)  # of a step in latitude
    (lon_e, lat_e), (lon_n, lat_n) = ((lon, lat * isometric) for lon, lat in d)
    assert lon_e == pytest.approx(lat_n, rel=1e-7)
    assert lon_n == pytest.approx(-lat_e, rel=1e-6)
    south = lon_lat(np.array([[500_000.0, 10_000_000.0 - 0.9996 * arc_m]]), "EPSG:32733")
    np.testing.assert_allclose(south, [[15.0, -48.5]], atol=1e-9)


def test_tables_tell_what_the_adjustment_says(project: Path, tmp_path: Path) -> None:
    adjustment = result_file(project.parent)
    texts, binary = exported(project, "csv", tmp_path), exported(project, "parquet", tmp_path)
    for path in sorted(texts.glob("*.csv")):
        rows = list(csv.DictReader(path.read_text().splitlines()[1:]))
        table = pyarrow.parquet.read_table(binary / f"{path.stem}.parquet").to_pylist()
        assert len(rows) == len(table) > 0
        for row, other in zip(rows, table, strict=True):
            assert row.keys() == other.keys()
            assert [float(v) for k, v in row.items() if isinstance(other[k], float)] == [
                v for v in other.values() if isinstance(v, float)
            ]
    images = {row["image"]: row for row in pyarrow.parquet.read_table(binary / "images.parquet").to_pylist()}
    exterior = adjustment["images"]["f2"]["exterior"]
    assert images["f2"]["kappa_deg"] == exterior["kappa_deg"]["value"]
    assert images["f2"]["sZ0"] == exterior["Z0"]["sigma"]
    covariances = pyarrow.parquet.read_table(binary / "covariances.parquet").to_pylist()
    own = [row for row in covariances if row["first"] == row["second"] == "EO.f2.Z0"]
    assert own[0]["covariance"] == pytest.approx(exterior["Z0"]["sigma"] ** 2, rel=1e-9)
    marks = [row for row in pyarrow.parquet.read_table(binary / "marks.parquet").to_pylist() if row["image"] == "f1"]
    view = [[row["camera_x_mm"], row["camera_y_mm"]] for row in marks if row["kind"] == "target"]
    np.testing.assert_allclose(view, camera_mm(1), atol=1e-7)


def test_only_observations_go_out_and_without_an_adjustment_the_marks(tmp_path: Path, refusal: Refusal) -> None:
    project = adjusted_project(tmp_path)
    comparator = tmp_path / "comparator.csv"
    first, head, *rows = comparator.read_text().splitlines()
    states = ["predicted", "rejected", "weak", *["measured"] * (len(rows) - 3)]
    rows = [f"{row},{state}" for row, state in zip(rows, states, strict=True)]
    comparator.write_text("\n".join([first, f"{head},status", *rows]) + "\n")
    refusal("export", project, "mmvii", tmp_path / "o")  # the adjustment is of other marks
    assert command("adjust", project) in (DONE, LOOK)
    marks = exported(project, "micmac", tmp_path) / "Ori-InterneScan"
    assert (marks / "MeasuresIm-f0.tif.xml").read_text().count("<OneMesureAF1I>") == 3  # of five
    (tmp_path / "out" / "adjustment.json").unlink()
    folder = exported(project, "micmac", tmp_path)
    assert not (folder / "Ori-Reseau").exists()
    assert len(list((folder / "Ori-InterneScan").iterdir())) == 5
    assert "0.1 BoxCh=[-114,-114,114,114]" in (folder / "README.txt").read_text()
    assert sorted(path.name for path in exported(project, "csv", tmp_path).iterdir()) == ["README.txt", "marks.csv"]
    assert "Run `reseau adjust` first" in refusal("export", project, "colmap", tmp_path / "c")


def test_what_cannot_go_out_is_refused_with_its_reason(project: Path, tmp_path: Path, refusal: Refusal) -> None:
    for format, options, words in (
        ("orima", (), f"possible are {', '.join(FORMATS)}"),
        ("geojson", (), "Give crs in [object]"),
        ("opencv", ("--misfit-px", "0"), "no model that takes this camera"),
    ):
        assert words in refusal("export", project, format, tmp_path / "a", *options)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine.txt").write_text("mine")
    assert "holds something that is no export" in refusal("export", project, "csv", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(InputError, match=r"'a b' and 'a_b' would both be 'a_b'"):
        _check_words(["a b", "c", "a b", "a_b"])


def test_an_altered_or_stale_adjustment_is_refused_for_exports_and_rectified_scans(
    project: Path, tmp_path: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.resampling.resample_stage.read_measurement", lambda path: [])
    moved = copied(project.parent, tmp_path / "moved")
    adjusted = tmp_path / "moved" / "out" / "adjustment.json"
    content = json.loads(adjusted.read_text())
    content["cameras"]["K"]["principal_distance_mm"]["value"] += 1.0
    adjusted.write_text(json.dumps(content))
    assert "is of another adjustment than" in refusal("export", moved, "opencv", tmp_path / "a")
    assert "is of another adjustment than" in refusal("resample", moved, tmp_path / "a")
    stale = copied(project.parent, tmp_path / "stale")
    points = tmp_path / "stale" / "points.csv"
    points.write_text(re.sub(r"(\d)\n", r"\g<1>1\n", points.read_text()))
    for command_words in (("export", stale, "opencv"), ("resample", stale)):
        assert "Run `reseau adjust` again" in refusal(*command_words, tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_a_strong_lens_is_refused_unless_requested(tmp_path: Path, refusal: Refusal) -> None:
    strong = replace(TRUTH, distortion={**LENS, "k3": 4e-6, "k5": -2e-10})
    project = adjusted_project(tmp_path, strong)
    assert "allow more with --misfit-px" in refusal("export", project, "asp", tmp_path / "a")
    folder = exported(project, "asp", tmp_path, "--misfit-px", "100")
    stated_px = stated_misfit_px(folder)
    assert stated_px > 0.05
    off = np.linalg.norm(asp_px(folder, "f0", POINTS) - frame_px(0, camera_mm(0, strong), truth=strong), axis=1)
    assert off.max() < 1.05 * stated_px


def test_the_nearest_of_several_models_is_named(tmp_path: Path, refusal: Refusal) -> None:
    """The last of OpenCV's models cannot be fitted to this lens."""
    project = adjusted_project(
        tmp_path, replace(TRUTH, family="ebner", distortion={"b1": 0.01, "b3": 0.005, "b7": 0.004})
    )
    message = refusal("export", project, "opencv", tmp_path / "a")
    assert float(message.split("off by up to ")[1].split()[0]) < 0.1
    exported(project, "opencv", tmp_path, "--misfit-px", "0.1")


def test_a_model_is_chosen_in_pixels_of_the_frames_written(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lens 3 µm off fits in pixels of 100 µm, and not in those of 20 µm, of --pitch-um or of another picture."""
    block = read_block(read_project(project))
    frame = next(iter(block.oriented_frames()))
    fits = {1: 0.003, 2: 0.0}
    monkeypatch.setattr(
        "pipeline.exchange.pinhole._fit_opencv", lambda block, frame, names: FittedLens(frame.lens, fits[len(names)])
    )
    models, allowed = (("k1",), ("k1", "k2")), ExportOptions(largest_misfit_px=0.05)
    assert nearest_lens(block, frame, models, allowed).largest_mm == 0.003
    assert nearest_lens(block, frame, models, replace(allowed, pitch_um=20.0)).largest_mm == 0.0
    finer = replace(block, frames=(*block.frames[:-1], replace(block.frames[-1], pitch_um=(20.0, 20.0))))
    assert nearest_lens(finer, frame, models, allowed).largest_mm == 0.0


def test_an_export_is_replaced_whole(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = exported(project, "opencv", tmp_path)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    full = Mock(side_effect=[None, None, OSError(28, "No space left on device")])
    with monkeypatch.context() as broken:
        broken.setattr("pipeline.exchange.exchange_stage.write_atomically", full)
        assert command("export", project, "opencv", folder) == WRONG_INPUT
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["opencv"]
    assert command("export", project, "opencv", folder, "--lens") == DONE
    assert (folder / "f2.yml").read_bytes() != before["f2.yml"]


def test_a_digital_camera_goes_out_as_its_pictures_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without fiducials and film the frame is the picture: comparator coordinates are the camera's."""
    monkeypatch.setattr("networks.FIDUCIALS", {})
    here = replace(TRUTH, x0=125.4, y0=-125.3, mirrored=(False,) * 4)
    project = adjusted_project(tmp_path, here, kind="none")
    pixels = {i: camera_mm(i, here) * (1, -1) / PITCH_MM for i in IMAGES}
    for format, reader in PINHOLES.items():
        folder = exported(project, format, tmp_path)
        off = np.linalg.norm(reader(folder, "f1", POINTS) - pixels[1], axis=1)
        assert off.max() < 1.05 * stated_misfit_px(folder) + SAME_PX
    folder = exported(project, "bingo", tmp_path)
    rows = [line.split() for line in (folder / "bingo.txt").read_text().splitlines()[1:101]]
    ideal = ideal_mm(0, here) - (here.x0, here.y0)
    np.testing.assert_allclose([[float(x), float(y)] for _, x, y in rows], ideal, atol=2e-6)
    assert "principal point 0.00000, 0.00000" in (folder / "README.txt").read_text()
    folder = exported(project, "micmac", tmp_path)
    assert not (folder / "Ori-InterneScan").exists()
    off = np.linalg.norm(micmac_px(folder, "f3", POINTS, "") - pixels[3], axis=1)
    assert off.max() < 1.05 * stated_misfit_px(folder) + SAME_PX


def out_frame(image: str, scan: str, camera: str = "K") -> OutFrame:
    return OutFrame(image, camera, scan_path(scan), (20.0, 20.0), (), None, is_oriented=False)


def test_a_window_goes_out_as_its_file() -> None:
    frame = out_frame("a", "scans/roll.tif#window=5,0,9,9")
    assert (frame.file_name, frame.scan_file, present(frame.scan).suffix) == (
        "roll.tif",
        Path("scans/roll.tif"),
        ".tif",
    )


@pytest.mark.parametrize(
    ("format", "frames", "words"),
    [
        ("micmac", [("a", "r.tif#window=0,0,9,9"), ("b", "r.tif#window=9,0,9,9")], "files of the same name 'r.tif'"),
        ("mmvii", [("a", "r.tif#page=2")], "is page 2 of r.tif, and mmvii reads the first alone"),
        ("metashape", [("x/a", "x/a.tif"), ("y/a", "y/a.jpg")], "files of the same name 'a'"),
        ("micmac", [("a", "a.tif", "C 1"), ("b", "b.tif", "C-1")], "cameras 'C 1' and 'C-1' would have the same files"),
    ],
)
def test_what_would_share_a_file_is_refused(
    format: str, frames: list[tuple[str, ...]], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    block = Mock(frames=[out_frame(*each) for each in frames])
    monkeypatch.setattr(exchange_stage, "read_block", lambda _: block)
    with pytest.raises(InputError, match=re.escape(words)):
        exchange_stage.run_export(Mock(), format, tmp_path / "out", ExportOptions())


def test_a_turned_picture_goes_out_turned_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its file went out with the sensor's principal point and the turned picture's size."""
    monkeypatch.setattr("networks.FIDUCIALS", {})
    here = replace(TRUTH, x0=125.4, y0=-125.3, mirrored=(False,) * 4)
    project = adjusted_project(tmp_path, here, kind="none")
    pixels = camera_mm(1, here) * (1, -1) / PITCH_MM
    width_px, height_px = SIZE_PX, SIZE_PX - 100
    lines = (tmp_path / "comparator.csv").read_text().splitlines()
    for at, line in enumerate(lines):
        cells = line.split(",")
        if cells[0] == "f1":  # counter-clockwise: (column, row) becomes (row, width - 1 - column)
            col, row = pixels[int(cells[1])]
            cells[3:5] = repr(float(PITCH_MM * row)), repr(float(-PITCH_MM * (width_px - 1 - col)))
            lines[at] = ",".join(cells)
    (tmp_path / "comparator.csv").write_text("\n".join(lines) + "\n")
    for i in IMAGES:
        shape = (width_px, height_px) if i == 1 else (height_px, width_px)
        tifffile.imwrite(tmp_path / "scans" / f"f{i}.tif", np.zeros(shape, np.uint8), compression="deflate")
    (tmp_path / "images.csv").write_text("image,turned_deg\nf1,90\n")
    replace_text(project, "[object]\n", '[object]\nimages = "images.csv"\n')
    size_mm = f"frame_mm = [{width_px * PITCH_MM}, {height_px * PITCH_MM}]\n"
    camera = next(tmp_path.glob("camera*.toml"))
    camera.write_text(re.sub("frame_mm = .*\n", size_mm, camera.read_text()))
    assert command("adjust", project) in (DONE, LOOK)
    block = read_block(read_project(project))
    corners_mm = frame_corners_mm(block, block.frames[1])  # of the picture, not of the marks in it
    np.testing.assert_allclose(corners_mm, [[-0.05, -239.95], [249.95, 0.05]], atol=1e-9)
    for format, reader in PINHOLES.items():
        folder = exported(project, format, tmp_path)
        off = np.linalg.norm(reader(folder, "f1", POINTS) - pixels, axis=1)
        assert off.max() < 1.05 * stated_misfit_px(folder) + SAME_PX
    storage: Any = cv2.FileStorage(str(tmp_path / "opencv" / "f1.yml"), cv2.FILE_STORAGE_READ)
    assert [storage.getNode(f"image_{side}").real() for side in ("width", "height")] == [width_px, height_px]
    folder = exported(project, "micmac", tmp_path, code=LOOK)
    assert "f1: its picture is turned" in (folder / "README.txt").read_text()
    table = (exported(project, "csv", tmp_path) / "marks.csv").read_text().splitlines()[1:]
    mark = next(row for row in csv.DictReader(table) if row["image"] == "f1" and row["point"] == "7")
    stored_px = [pixels[7, 1], width_px - 1 - pixels[7, 0]]
    assert [float(mark["col_px"]), float(mark["row_px"])] == pytest.approx(stored_px)
    place_mm = float(mark["camera_x_mm"]), float(mark["camera_y_mm"])
    assert place_mm == pytest.approx(camera_mm(1, here)[7])
    xml = ElementTree.parse(exported(project, "metashape", tmp_path) / "K.xml").getroot()
    assert [values(xml, name)[0] for name in ("width", "height")] == [width_px, height_px]
    assert values(xml, "cx")[0] == pytest.approx(here.x0 / PITCH_MM + 0.5 - width_px / 2, abs=0.01)


def test_how_far_out_an_estimated_lens_is_known_goes_out(tmp_path: Path) -> None:
    """In every README, and in OpenCV's files as a comment that its reader passes over."""
    network, _ = simulated(np.random.default_rng(1), TRUTH, points=POINTS, noise=False, free={"k3": np.inf})
    project = make_project(network, tmp_path)
    known = result_file(tmp_path)["cameras"]["K"]["lens_known"]
    words = f"The distortion of K is known up to {known['radius_mm']:.3g} mm from the principal point"
    for format in ("opencv", "asp", "micmac", "bingo"):
        folder = exported(project, format, tmp_path)
        readme = (folder / "README.txt").read_text()
        assert words in readme
        assert f"{100.0 * known['share']:.0f} % of the way to the corner of the picture; beyond it" in readme
    block = read_block(read_project(project))
    plain = Film("none", np.empty(0), np.zeros(2))
    digital = tuple(replace(each, model=replace(present(each.model), film=plain)) for each in block.frames)
    in_px = f"known up to {known['radius_mm'] / PITCH_MM:.3g} px from the principal point"
    assert in_px in replace(block, frames=digital).lens_reach["K"]
    text = (tmp_path / "opencv" / "f1.yml").read_text()
    assert f"# {words}" in text
    storage: Any = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert storage.getNode("distortion_coefficients").mat().size == 5


R0_MM = 80.0
LENS_POINTS = np.random.default_rng(8).uniform((-650.0, -650.0, -150.0), (650.0, 650.0, 150.0), (100, 3))
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
    network, _ = simulated(np.random.default_rng(1), truth, "affine", points=LENS_POINTS, noise=False)
    family, parameters, _ = LENSES[lens]
    places = network.observations.xy_mm.copy()
    for i in IMAGES:
        own = [n for n, image in enumerate(network.observations.image) if image == f"f{i}"]
        targets = [n for n in own if network.observations.kind[n] == "target"]
        places[targets] = comparator_point("affine", affine(truth, i, "affine"), i == MIRRORED, lens_camera_mm(lens, i))
    given = {name: Prior(value, 0.0) for name, value in parameters.items()}
    camera = replace(network.cameras[0], distortion=Distortion(family, given, r0_mm=R0_MM))
    observations = replace(network.observations, xy_mm=places)
    return make_project(replace(network, cameras=(camera,), observations=observations), folder)


def lens_camera_mm(lens: str, image: int) -> Array:
    family, parameters, _ = LENSES[lens]
    camera = SceneCamera("K", (228.0, 228.0), TRUTH.c, (TRUTH.x0, TRUTH.y0), SceneDistortion(family, parameters, R0_MM))
    return camera_from_object(camera, (*TRUTH.stations[image], *TRUTH.attitudes[image]), LENS_POINTS)


def read_px(format: str, folder: Path, image: int) -> Array:
    """Where another program sees the points in its picture, in pixels of the camera's frame from its middle, y down."""
    if format == "micmac":
        return micmac_px(folder, f"f{image}", LENS_POINTS) - 1140.0
    if format == "metashape":
        turn = np.diag([1.0, -1.0, -1.0]) @ object_rotation(*TRUTH.attitudes[image])
        in_camera = (LENS_POINTS - np.array(TRUTH.stations[image])) @ turn.T
        return metashape_mm(folder / "K.xml", PITCH_MM, in_camera) * [1.0, -1.0] / PITCH_MM
    reader = {"opencv": opencv_px, "colmap": colmap_px, "asp": asp_px}[format]
    middle = frame_px(image, np.zeros((1, 2)))
    return reader(folder, f"f{image}", LENS_POINTS) - middle


@parametrize_with_studies("lens", LENSES, quick=(5,))
def test_a_lens_in_a_format_is_as_reported_or_refused(lens: str, tmp_path: Path, capsys: Capture) -> None:
    project = lens_project(tmp_path, lens)
    places = {i: lens_camera_mm(lens, i) for i in IMAGES}
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
        is_fitted = "nothing was fitted" not in (folder / "README.txt").read_text()
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
            u, v, w = object_rotation(*TRUTH.attitudes[0]) @ (LENS_POINTS - np.array(TRUTH.stations[0])).T
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
    (tmp_path / "m.xml").write_text(f"<calibration><projection>frame</projection>{xml}</calibration>")
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
    table.write_text(table.read_text().replace("f1", "../../x"))
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
