"""Natural points on rendered terrain, blocks through COLMAP, and frames scanned in overlapping halves."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import projects
import pytest
import tifffile
from networks import FIDUCIALS, affine, rotation
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from adjust import ObjectPoint
from adjust.functional_model.lens import Distortion as OtherDistortion
from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import Film as OtherFilm
from measure import MarkMeasurement, Status
from measure.flags import Code, Reason
from measure.results import Covariance, FrameMeasurement
from measure.tie_points.find_points import TieOptions, measure_ties
from measure.tie_points.joins import measure_joins
from measure.tie_points.tracks import TieFrame
from pipeline import InputError, build_network, read_images, read_measurement, read_project
from pipeline.archive.verdicts import Verdict, scan_verdict
from pipeline.blocks import block_stage
from pipeline.exchange.incoming import fiducial_camera
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.tie_stage import _check_fiducials_by_joins, add_joins, check_tie_names
from pipeline.resampling.canvas import FrameChain
from pipeline.resampling.resample_stage import FAST, FrameScan, Resampled, ResampleTask, resample_frame
from pipeline.results.comparator_file import ComparatorPoint, read_comparator, write_comparator
from pipeline.results.measured_record import MeasuredScan
from synthetic_images.render import render_scene
from synthetic_images.scene import DiskField, Scene, SceneCamera, SceneDistortion, SceneFilm, SceneImage, SceneScanner
from synthetic_images.terrain import transferred

SCENE = Scene(
    name="crosswise",
    seed=3,
    camera=SceneCamera("c", (38.0, 38.0), 35.0, (0.02, -0.03), SceneDistortion("torlegard", {"k3": 3e-6})),
    field=DiskField((), 1.0),
    images=(
        SceneImage("a", (-130.0, 3.0, 600.0, 0.004, -0.005, 0.007)),
        SceneImage("b", (130.0, -5.0, 605.0, -0.005, 0.002, -0.01), pose="180"),
        SceneImage("c", (-65.0, 6.0, 595.0, 0.002, 0.007, 1.58), pose="90m"),
    ),
    scanner=SceneScanner((80.0, 80.0), margin_mm=1.0, noise=0.004),
    film=SceneFilm(grain=0.008, grain_px=0.6, deformation_um=5.0),
    background="terrain",
    relief=2.3,
)


@pytest.mark.study
def test_natural_points_are_where_the_scene_says(tmp_path: Path) -> None:
    truth = render_scene(SCENE, tmp_path)
    geometry = {frame.geometry.image.name: frame.geometry for frame in truth.frames}
    frames = []
    for name, each in geometry.items():
        matrix = np.linalg.inv(each.camera_from_pixel)[:2].astype(np.float64)
        frames.append(TieFrame(name, tmp_path / "scans" / f"{name}.tif", matrix, (38.0, 38.0), np.zeros((0, 3))))
    ties = measure_ties(frames, TieOptions(wanted=24))
    assert not ties.problems
    marks = {image: {mark.point: mark for mark in own} for image, own in ties.marks.items()}
    errors, claimed = [], []
    for image, own in marks.items():
        for name, mark in own.items():
            if mark.status is not Status.MEASURED or mark.quality["reference"]:
                continue
            start = next(i for i in marks if name in marks[i] and marks[i][name].quality.get("reference"))
            place = projects.present(marks[start][name].center_px)
            errors.append(np.asarray(mark.center_px) - transferred(place[None], geometry[start], geometry[image])[0])
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


PROJECT = """camera = "camera.toml"
object = {points = "points.csv"}
ties = {height = 42.0, height_sigma = 0.05}
"""
CAMERA = 'name = "c"\nprincipal_distance_mm = 100.0\nprincipal_point_mm = [0.0, 0.0]\n'
NATURAL_POINTS = ("tie0001", "tie0002", "7", "8")
ROWS = "image,point,kind,x_mm,y_mm\n" + "".join(
    f"{image},{point},tie,{k}.5,{k * k}.25\n" for image in "ab" for k, point in enumerate(NATURAL_POINTS)
)


def written(folder: Path, project: str = PROJECT) -> Path:
    points = ["point,X,Y,Z,sX,sY,sZ", "7,1.0,2.0,3.0,,,0.01", "8,5.0,2.0,3.0,,,0.01"]
    return projects.write_tables(folder, project, camera=CAMERA, points=points, comparator=ROWS)


def test_natural_points_have_the_ground_s_height_and_names_of_their_own(tmp_path: Path) -> None:
    project = read_project(written(tmp_path))
    network, _ = build_network(project, read_comparator(project.comparator))
    tie = network.point_by_id["tie0001"]
    assert (None, Prior(42.0, 0.05), Prior(3.0, 0.01)) == (tie.X, tie.Z, network.point_by_id["7"].Z)
    path = written(tmp_path)
    (tmp_path / "points.csv").write_text("point,X,Y,Z\ntie7,1,2,3\n")
    with pytest.raises(InputError, match="'tie7'"):
        check_tie_names(read_project(path))


Array = NDArray[np.float64]

BLOCK_CAMERA: CameraFile = replace(
    fiducial_camera("K", {id: np.array(xy) for id, xy in FIDUCIALS.items()}),
    frame_mm=(228.0, 228.0),
    principal_distance_mm=projects.TRUTH.c,
    principal_point_mm=(projects.TRUTH.x0, projects.TRUTH.y0),
    distortion=OtherDistortion(),
)
LATTICE = block_stage.camera_lattice(BLOCK_CAMERA, projects.PITCH_MM)
PITCH_UM = (1000.0 * projects.PITCH_MM, 1000.0 * projects.PITCH_MM)


def chain(image: int) -> FrameChain:
    return FrameChain(
        PITCH_UM, OtherFilm("affine", affine(projects.TRUTH, image, "affine"), np.array(projects.TRUTH.middle_mm))
    )


PICTURES = tuple(
    block_stage.BlockPicture(
        f"f{i}", "K", f"K/f{i}.png", LATTICE, (block_stage.BlockScan(f"f{i}", chain(i), 2500, 2500),)
    )
    for i in projects.IMAGES
)
SCALE, SHIFT = 0.01, np.array([3.0, -2.0, 5.0])
TURN = rotation(0.4, -0.9, 2.0)


def lattice_px(places_mm: Array) -> Array:
    """Column and row of camera places in the pictures, counted from the frame's upper left pixel."""
    return (places_mm - (-114.0, 114.0)) * (1.0, -1.0) / projects.PITCH_MM


def mapped(noise_px: float = 0.0) -> block_stage.Reconstruction:
    """What COLMAP would say of a perfect block, in a frame that is turned, shifted and of another scale."""
    rng = np.random.default_rng(5)
    poses = {}
    for i in projects.IMAGES:
        turn = np.diag([1.0, -1.0, -1.0]) @ rotation(*projects.TRUTH.attitudes[i]) @ TURN.T
        station = SCALE * TURN @ np.array(projects.TRUTH.stations[i]) + SHIFT
        poses[f"f{i}"] = (turn, -turn @ station)
    view = [lattice_px(projects.camera_mm(i)) + rng.normal(0.0, noise_px, (100, 2)) for i in projects.IMAGES]
    off = float(noise_px * np.sqrt(2.0 * (8 - 3) / 8))  # of eight coordinates three went into the point
    tracks = {
        j: [
            block_stage.TrackObservation(f"f{i}", float(view[i][j, 0]), float(view[i][j, 1]), 4.0, off)
            for i in projects.IMAGES
        ]
        for j in range(100)
    }
    return block_stage.Reconstruction(poses, tracks)


def disagree(block: block_stage.Reconstruction, off_px: float) -> block_stage.Reconstruction:
    """The same places, but points that do not quite agree with them."""
    tracks = {j: [replace(sight, off_px=off_px) for sight in track] for j, track in block.tracks.items()}
    return replace(block, tracks=tracks)


def place_mm(point: ComparatorPoint) -> NDArray[np.float64]:
    return np.asarray(point.xy_mm)


def test_tracks_come_back_into_turned_mirrored_and_cut_scans() -> None:
    marks = block_stage.tie_marks(disagree(mapped(), 0.4), PICTURES)
    assert {mark.image for mark in marks} == {"f0", "f1", "f2", "f3"}
    for mark in marks:
        col, row = projects.scan_px(int(mark.image[1:]), projects.camera_mm(int(mark.image[1:])))[
            int(mark.point.removeprefix("tie-"))
        ]
        np.testing.assert_allclose(place_mm(mark), [col * projects.PITCH_MM, -row * projects.PITCH_MM], atol=1e-9)
        assert mark.kind == "tie"
    block = disagree(mapped(), 0.4)
    marks = block_stage.tie_marks(block, [half_picture(i) for i in projects.IMAGES])
    whole = {(mark.image, mark.point): mark for mark in block_stage.tie_marks(block, PICTURES)}
    assert len(marks) == len(whole)
    assert {mark.image for mark in marks} == {f"f{i}{half}" for i in projects.IMAGES for half in "lr"}
    for mark in marks:
        place = place_mm(whole[mark.image[:2], mark.point])
        begin_mm = RIGHT_PX * projects.PITCH_MM if mark.image.endswith("r") else 0.0
        np.testing.assert_allclose(place_mm(mark), place - np.array([begin_mm, 0.0]), atol=1e-9)
        col = place[0] / projects.PITCH_MM
        assert col < LEFT_PX if mark.image.endswith("l") else col > RIGHT_PX


LEFT_PX, RIGHT_PX = 1500, 1000  # the left scan of a frame ends at the one column, the right one begins at the other


def half_picture(i: int) -> block_stage.BlockPicture:
    """A frame whose scan was cut into two that overlap."""
    a1, a2, a3, b1, b2, b3 = affine(projects.TRUTH, i, "affine")
    begin_mm = RIGHT_PX * projects.PITCH_MM
    moved = np.array([a1 + a2 * begin_mm, a2, a3, b1 + b2 * begin_mm, b2, b3])
    right = FrameChain(PITCH_UM, OtherFilm("affine", moved, np.array(projects.TRUTH.middle_mm) - (begin_mm, 0.0)))
    scans = (
        block_stage.BlockScan(f"f{i}l", chain(i), LEFT_PX, 2500),
        block_stage.BlockScan(f"f{i}r", right, 2500 - RIGHT_PX, 2500),
    )
    return replace(PICTURES[i], scans=scans)


def test_their_standard_deviation_is_that_of_features_of_their_size() -> None:
    """Simulated: residuals of a fit with three unknowns to 3, 4 and 7 sights, one track in thirty false."""
    rng = np.random.default_rng(8)
    tracks = {}
    for number in range(4000):
        sights = int(rng.choice([3, 4, 7]))
        sizes = rng.uniform(3.0, 12.0, sights)
        sigmas = np.repeat(np.hypot(0.5, 0.12 * sizes), 2)
        design = np.linalg.qr(rng.normal(size=(2 * sights, 3)))[0]
        noise = sigmas * rng.normal(size=2 * sights) * (30.0 if number % 30 == 0 else 1.0)
        left = noise - design @ (design.T @ noise)
        offs = np.hypot(*left.reshape(-1, 2).T)
        tracks[number] = [
            block_stage.TrackObservation(f"f{i}", 1.0, 1.0, float(sizes[i]), float(offs[i])) for i in range(sights)
        ]
    precision = block_stage.feature_precision(replace(mapped(), tracks=tracks))
    for size_px in (4.0, 7.0, 11.0):
        assert precision.sigma_px(size_px) == pytest.approx(np.hypot(0.5, 0.12 * size_px), rel=0.04)
    with pytest.raises(InputError, match="more overlap"):
        block_stage.feature_precision(replace(mapped(), tracks={1: tracks[1][:2]}))


def test_ties_are_spread_and_wrong_ones_left_out() -> None:
    block = mapped(0.5)
    crowded = {j: [replace(sight, col=1000.0 + j, row=1000.0) for sight in track] for j, track in block.tracks.items()}
    assert len(block_stage.tie_marks(replace(block, tracks=crowded), PICTURES)) == 4 * block_stage.A_CELL
    assert LATTICE.width_px / block_stage.CELLS > 100
    twice = {**block.tracks, 100: [block.tracks[7][0], *(replace(sight, col=9.0) for sight in block.tracks[7][1:])]}
    assert len(block_stage.tie_marks(replace(block, tracks=twice), PICTURES)) == len(
        block_stage.tie_marks(block, PICTURES)
    )
    wrong = {**block.tracks, 7: [replace(sight, off_px=4.0) for sight in block.tracks[7]]}
    assert "tie-7" not in {mark.point for mark in block_stage.tie_marks(replace(block, tracks=wrong), PICTURES)}
    twice = {**block.tracks, 8: [*block.tracks[8], block_stage.TrackObservation("f0", 5.0, 5.0, 4.0, 0.5)]}
    assert "tie-8" not in {mark.point for mark in block_stage.tie_marks(replace(block, tracks=twice), PICTURES)}


def control(count: int) -> tuple[list[ComparatorPoint], dict[str, ObjectPoint]]:
    """Control points marked in two images each, free of distortion: COLMAP's camera knows none here."""
    marks, points = [], {}
    for j in range(count):
        points[str(j)] = ObjectPoint(str(j), *(Prior(float(value)) for value in projects.POINTS[j]))
        for i in (0, 2):
            px = projects.scan_px(i, projects.ideal_mm(i))[j] * (projects.PITCH_MM, -projects.PITCH_MM)
            marks.append(ComparatorPoint(f"f{i}", str(j), "target", px, np.ones(2), 0.0, Status.MEASURED, ""))
    return marks, points


def test_poses_come_into_the_frame_of_the_control() -> None:
    rays = {f"f{i}": np.array([projects.TRUTH.c, projects.TRUTH.x0, projects.TRUTH.y0]) for i in projects.IMAGES}
    placed = block_stage.orient_by_control(mapped(), PICTURES, *control(4), rays)
    for i in projects.IMAGES:
        turn, station = placed[f"f{i}"]
        np.testing.assert_allclose(turn, rotation(*projects.TRUTH.attitudes[i]), atol=1e-9)
        np.testing.assert_allclose(station, projects.TRUTH.stations[i], atol=1e-6)
    with pytest.raises(InputError, match="2 points with coordinates"):
        block_stage.orient_by_control(mapped(), PICTURES, *control(2), rays)


def test_frames_of_a_block_that_were_not_resampled_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame in parts has no film transformation before an adjustment; the others make a block without it."""
    results = [Resampled("a", tmp_path), Resampled("b", tmp_path), Resampled("c", None, problem="it is not adjusted")]
    replaced = {
        "resample": results,
        "resample_tasks": ([Mock(image=each.image, camera="K") for each in results[:2]], []),
        "run_colmap": block_stage.Reconstruction({}, {}),
        "write_block": Mock(given_images=None),
        "coarse_pitch_um": None,
    }
    for name in ("quiet_colmap", "check_folder", "read_comparator", "write_pictures", "tie_marks", "orient_by_control"):
        monkeypatch.setattr(block_stage, name, Mock(return_value=()))
    for name, result in replaced.items():
        monkeypatch.setattr(block_stage, name, Mock(return_value=result))
    _, left_out, lines = block_stage.run_block(Mock(cameras={}), tmp_path, None, Mock())
    assert left_out == ("c",)
    assert "not resampled: c (it is not adjusted)" in lines


def test_control_in_either_scan_of_a_frame_places_the_block(tmp_path: Path) -> None:
    """And what is written names the parts, so that the adjustment takes them for one frame."""
    rays = {f"f{i}": np.array([projects.TRUTH.c, projects.TRUTH.x0, projects.TRUTH.y0]) for i in projects.IMAGES}
    marks, points = control(8)
    cut = []
    for mark in marks:
        is_right = projects.present(mark.xy_mm)[0] > 0.5 * (LEFT_PX + RIGHT_PX) * projects.PITCH_MM
        shift = np.array([RIGHT_PX * projects.PITCH_MM, 0.0]) if is_right else np.zeros(2)
        cut.append(
            replace(mark, image=f"{mark.image}{'r' if is_right else 'l'}", xy_mm=projects.present(mark.xy_mm) - shift)
        )
    placed = block_stage.orient_by_control(mapped(), [half_picture(i) for i in projects.IMAGES], cut, points, rays)
    for i in projects.IMAGES:
        np.testing.assert_allclose(placed[f"f{i}"][1], projects.TRUTH.stations[i], atol=1e-6)
    images = ["image,part_of", *(f"f{i}{half},f{i}" for i in projects.IMAGES for half in "lr")]
    cut += [replace(cut[0], image=f"f{i}{half}", point="1", kind="fiducial") for i in projects.IMAGES for half in "lr"]
    text = 'camera = "camera.toml"\n[object]\nimages = "images.csv"'
    path = projects.write_tables(tmp_path, text, camera='name = "K"', images=images)
    write_comparator(path.with_name("comparator.csv"), cut, {})
    own = block_stage.write_block(read_project(path), tmp_path / "block", cut, {"f1": placed["f1"]})
    again = read_images(tmp_path / "block" / "images.csv")
    assert again.part_of == {f"f{i}{half}": f"f{i}" for i in projects.IMAGES for half in "lr"}
    assert own.scanned_frame("f2l") == "f2"
    for half in "lr":
        exterior = projects.present(again.exterior[f"f1{half}"])
        np.testing.assert_allclose(exterior.values[:3], projects.TRUTH.stations[1], atol=1e-6)
        assert again.exterior[f"f0{half}"] is None
    assert {mark.image for mark in read_comparator(own.comparator) if mark.kind == "target"} <= {"f1l", "f1r"}


def test_observed_orientations_of_a_block_stay_observations(tmp_path: Path) -> None:
    """Their standard deviations had been dropped; the others' elements, and single ones, are COLMAP's."""
    sigmas = ",".join(f"s{each}" for each in ("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg"))
    images = [
        f"image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,{sigmas}",
        "f0,10,20,30,1,2,3,0.1,0.1,0.2,,,0.01",
        "f1,1,2,3,4,5,6,0.5,0.5,0.5,0.1,0.1,0.1",
        "f2,7,8,9,1,2,3,,,,,,",
    ]
    path = projects.write_tables(
        tmp_path, 'camera = "camera.toml"\n[object]\nimages = "images.csv"', camera='name = "K"', images=images
    )
    marks = [replace(mark, image=f"f{i}") for mark in control(1)[0][:1] for i in range(3)]
    write_comparator(path.with_name("comparator.csv"), marks, {})
    pose = rotation(0.1, -0.2, 0.3), np.array([100.0, 200.0, 300.0])
    own = block_stage.write_block(read_project(path), tmp_path / "block", marks, {"f0": pose, "f2": pose})
    again = read_images(tmp_path / "block" / "images.csv")
    for exteriors in (again.exterior, projects.present(own.given_images).exterior):
        first, second, third = (projects.present(exteriors[f"f{i}"]) for i in range(3))
        np.testing.assert_allclose(first.values, [10, 20, 30, 0.1, -0.2, np.radians(3.0)], rtol=1e-9)
        np.testing.assert_allclose(first.sigmas, [0.1, 0.1, 0.2, np.inf, np.inf, np.radians(0.01)], rtol=1e-9)
        np.testing.assert_allclose(second.values[:3], [1, 2, 3])
        assert np.isfinite(second.sigmas).all()
        np.testing.assert_allclose(third.values, [100, 200, 300, 0.1, -0.2, 0.3], rtol=1e-9)
        assert np.isinf(third.sigmas).all()
    assert {mark.image for mark in read_comparator(own.comparator)} == {"f0", "f1", "f2"}


@pytest.mark.study
def test_pictures_lie_where_the_lattice_says(tmp_path: Path) -> None:
    """A spot of light at a known place of the camera, in a mirrored scan, through resampling into the picture."""
    place = np.array([[31.37, -22.81]])
    col, row = projects.scan_px(2, place)[0]
    cols, rows = np.meshgrid(np.arange(2500.0), np.arange(2500.0))
    spot = 9000.0 * np.exp(-((cols - col) ** 2 + (rows - row) ** 2) / (2 * 2.5**2))
    tifffile.imwrite(tmp_path / "f2.tif", np.rint(4000.0 + 14.0 * cols + spot).astype(np.uint16), compression="deflate")
    scans = (FrameScan("f2", tmp_path / "f2.tif", chain(2)),)
    task = ResampleTask("f2", "K", "0m", projects.PITCH_MM, FAST, None, tmp_path / "frame.tif", scans)
    assert resample_frame(task).problem == ""
    with pytest.raises(InputError, match="'a/b' and 'a_b' would share"):
        block_stage.write_pictures(
            [replace(task, image=name) for name in ("a/b", "a_b")], {"K": BLOCK_CAMERA}, tmp_path
        )
    (picture,) = block_stage.write_pictures([task], {"K": BLOCK_CAMERA}, tmp_path)
    image = np.asarray(cv2.imread(str(tmp_path / "pictures" / picture.name), cv2.IMREAD_UNCHANGED), dtype=float)
    mask = np.asarray(cv2.imread(str(tmp_path / "masks" / f"{picture.name}.png"), cv2.IMREAD_UNCHANGED))
    assert image.shape == mask.shape == (LATTICE.height_px, LATTICE.width_px)
    there = lattice_px(place)[0]
    left, top = (round(value) - 12 for value in there.tolist())
    window = image[top : top + 25, left : left + 25]
    y, x = np.mgrid[:25, :25]
    plane = np.stack([x, y, np.ones_like(x)], axis=-1)
    edge = (np.abs(x - 12) > 10) | (np.abs(y - 12) > 10)
    window = window - plane @ np.linalg.lstsq(plane[edge], window[edge])[0]
    found = [left + (window * x).sum() / window.sum(), top + (window * y).sum() / window.sum()]
    np.testing.assert_allclose(found, there, atol=0.1)
    for xy in FIDUCIALS.values():
        x, y = (round(value) for value in lattice_px(np.array(xy)).tolist())
        assert mask[y, x] == 0
    assert mask[1140, 1140] == 255


def test_the_camera_that_colmap_is_given_counts_from_the_corner() -> None:
    fx, fy, cx, cy, *rest = block_stage.camera_params(BLOCK_CAMERA, LATTICE)
    assert fx == fy == pytest.approx(projects.TRUTH.c / projects.PITCH_MM)
    assert (cx, cy) == pytest.approx(lattice_px(np.array([projects.TRUTH.x0, projects.TRUTH.y0])) + 0.5)
    assert rest == [0.0] * 4


MARKS = """
[camera]
name = "K"
frame_mm = [44.0, 44.0]
principal_distance_mm = 60.0
sigma = {principal_distance_mm = 0.1, principal_point_mm = 0.1}
[camera.mark]
m = {kind = "ring-cross", polarity = "light", ring_mm = 0.7, ring_line_mm = 0.14, arm_mm = 0.5, line_mm = 0.14}
""" + projects.fiducial_tables(
    {"1": (19, -19), "2": (-19, -19), "3": (-19, 19), "4": (19, 19)},
    'sigma_mm = 0.003\nmark = "m"\n',
    "camera.fiducial",
)
HALVES_SCENE = f"""
name = "halves"
seed = 4
film = {{scale_sigma_ppm = 300.0, shear_sigma_urad = 100.0, grain = 0.01}}
scan = {{pitch_um = 60.0, margin_mm = 3.0, turn_sigma_deg = 0.3, offset_sigma_mm = 0.2, noise = 0.005}}
given = {{fiducial_error_mm = 0.003}}
picture = {{background = "wall", pad_mm = 1.9, tones = {{contrast = 0.1}}}}
{MARKS}
[field]
kind = "disks"
unit = "m"
diameter_mm = 40.0
surround = 2.0
[[field.grid]]
first = 101
columns = 5
rows = 5
center = [0.0, 0.0, 0.0]
right = [0.5, 0.0, 0.0]
up = [0.0, 0.5, 0.0]
jitter = 0.1
relief = 0.4
""" + "".join(
    f'[[image]]\nname = "f{half}"\nposition = [0.1, -0.1, 4.0]\nangles_deg = [1.0, -2.0, 3.0]\n'
    f'part_of = "f"\npart = [{first}, {end}]\n'
    for half, first, end in (("a", 0.0, 0.6), ("b", 0.4, 1.0))
)


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the project, measured and adjusted."""
    folder = tmp_path_factory.mktemp("halves")
    (folder / "scene.toml").write_text(HALVES_SCENE)
    assert projects.command("render", folder / "scene.toml", folder) == 0
    for name in ("measure", "adjust", "report"):
        assert projects.command(name, folder / "project.toml") in (0, 1)
    return folder


def image_camera(image: dict[str, Any], pixels: np.ndarray) -> np.ndarray:
    """Camera mm of pixels (n, 2), by the truth."""
    x, y = (pixels * [0.06, -0.06]).T
    t = {name: value["value"] for name, value in image["transformation"].items() if name != "kind"}
    return np.stack([t["a1"] + t["a2"] * x + t["a3"] * y, t["b1"] + t["b2"] * x + t["b3"] * y], axis=1)


@pytest.mark.study
def test_one_adjustment_knows_both_films_one_orientation_and_all_marks_in_one_frame(halves: Path) -> None:
    truth = json.loads((halves / "truth.json").read_text())["images"]
    result = projects.result_file(halves)
    assert result["converged"]
    assert result["images"]["fa"]["exterior"] == result["images"]["fb"]["exterior"]
    assert result["groups"]["join"]["redundancy"] > 60.0
    frame = result["frames"]["f"]
    assert set(frame["parts"]) == {"fa", "fb"}
    assert len(frame["joins"]) >= 40
    for name, part in frame["parts"].items():
        corners = np.array([[0.0, 0.0], [0.0, 832.0], [499.0, 0.0], [499.0, 832.0]])
        own = {key: value for key, value in result["images"][name]["transformation"].items() if key != "mirrored"}
        adjusted = image_camera({"transformation": own}, corners)
        off_um = 1000.0 * np.hypot(*(adjusted - image_camera(truth[name], corners)).T)
        assert off_um.max() < 5.0 * part["corner_sigma_um"]
    errors = []
    for mark in frame["marks"]:
        if mark["kind"] == "target":
            true = truth[mark["image"]]["targets"][mark["point"]]
            place = image_camera(truth[mark["image"]], np.array([[true["ellipse_col_px"], true["ellipse_row_px"]]]))[0]
            errors += [(mark["x_mm"] - place[0]) / mark["sx_mm"], (mark["y_mm"] - place[1]) / mark["sy_mm"]]
    assert len(errors) > 40
    assert np.sqrt(np.mean(np.square(errors))) < 2.0


def test_scans_that_have_nothing_in_common_are_reported(tmp_path: Path) -> None:
    parts = []
    for seed, name in enumerate(("a", "b")):
        noise = np.random.default_rng(seed).normal(30000.0, 3000.0, (300, 300))
        tifffile.imwrite(tmp_path / f"{name}.tif", noise.astype(np.uint16))
        parts.append(TieFrame(name, tmp_path / f"{name}.tif", np.eye(2, 3), None, np.zeros((0, 3))))
    joins = measure_joins(parts)
    assert not joins.marks["a"]
    assert not joins.marks["b"]
    assert "Nothing joins it to the other scans of its frame: with b" in joins.problems["a"][0]


@pytest.mark.study
def test_fiducials_that_contradict_the_joins_are_rejected(halves: Path) -> None:
    """As if the frame of the right half had been found one mark too far to the right."""
    project = read_project(halves / "project.toml")
    scans = []
    for scan, shift_px in zip(read_measurement(halves / "out" / "measurement.db"), (0.0, 50.0), strict=True):
        marks = tuple(mark for mark in scan.frame.marks if mark.kind != "join")
        place = np.array(scan.frame.pixel_from_camera) + np.array([[0.0, 0.0, shift_px], [0.0, 0.0, 0.0]])
        scans.append(replace(scan, frame=replace(scan.frame, marks=marks, problems=(), pixel_from_camera=place)))
    result = add_joins(project, scans, lambda *_: None, None)
    assert all("contradict those of" in " ".join(scan.frame.problems) for scan in result)
    assert not any(mark.kind == "fiducial" and mark.status.is_observation for mark in result[1].frame.marks)


def strip(name: str, own: str, joins: str) -> MeasuredScan:
    """One of several scans of a frame, with some of the fiducials 1 to 4, its frame if it has any, and joins."""
    lost = Reason("not found", Code.OUTSIDE if own else Code.NO_FRAME)
    noise = Covariance.from_noise(np.eye(2))
    shown = (MarkMeasurement(id, "fiducial", np.full(2, 9.0), noise, Status.MEASURED) for id in own)
    absent = (MarkMeasurement(id, "fiducial", None, None, Status.ABSENT, lost) for id in sorted(set("1234") - set(own)))
    places = (MarkMeasurement(id, "join", np.full(2, 5.0), noise, Status.MEASURED) for id in joins)
    problems = () if own else (Reason("no fiducial was measured", Code.NO_FRAME),)
    frame = FrameMeasurement(name, (*shown, *absent, *places), None, np.eye(2, 3) if own else None, problems)
    return MeasuredScan(f"{name}.tif", 100, 100, (20.0, 20.0), frame)


def test_a_middle_scan_misses_no_fiducials_that_the_others_show() -> None:
    _, middle, _ = _check_fiducials_by_joins([strip("a", "12", "p"), strip("b", "", "pq"), strip("c", "34", "q")])
    assert not middle.frame.problems
    assert all(mark.reason.codes == (Code.OTHER_PART,) for mark in middle.frame.marks if mark.kind == "fiducial")
    assert scan_verdict(middle) is Verdict.GOOD
    for left, own in ((strip("a", "1", "p"), "pq"), (strip("a", "12", "p"), "")):  # a mark in none, or nothing joined
        _, middle, _ = _check_fiducials_by_joins([left, strip("b", "", own), strip("c", "34", "q")])
        assert [each.codes for each in middle.frame.problems] == [(Code.NO_FRAME,)]
        assert scan_verdict(middle) is Verdict.POOR


@pytest.mark.parametrize("off_mm", [0.0, 5.0])
def test_scans_that_a_third_one_joins_check_one_another(off_mm: float) -> None:
    """The last of three lies upside down; its frame was found where it is, or elsewhere."""
    rng, scans = np.random.default_rng(1), []
    places_mm = {str(i): rng.uniform(-40.0, 40.0, 2) for i in range(1, 5)} | {
        f"j{i}": rng.uniform(-40, 40, 2) for i in range(8)
    }
    for name, turn, own in (
        ("a", 0.01, "1 2 j0 j1 j2 j3"),
        ("b", -0.02, "j0 j1 j2 j3 j4 j5 j6 j7"),
        ("c", np.pi, "3 4 j4 j5 j6 j7"),
    ):
        scan, c, s = strip(name, "1", ""), 20.0 * np.cos(turn), 20.0 * np.sin(turn)
        place = np.array([[c, s, 900.0 + 300.0 * turn], [s, -c, 800.0]])
        marks = [
            MarkMeasurement(
                point,
                "join" if point.startswith("j") else "fiducial",
                place[:, :2] @ places_mm[point] + place[:, 2],
                Covariance.from_noise(np.eye(2)),
                Status.MEASURED,
            )
            for point in own.split()
        ]
        found = place + (name == "c") * off_mm * np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 0.0]])
        problems = (Reason("no check", Code.NO_CHECK),) if name != "b" else ()
        scans.append(
            replace(scan, frame=FrameMeasurement(name, tuple(marks), None, None if name == "b" else found, problems))
        )
    first, middle, last = _check_fiducials_by_joins(scans)
    assert not middle.frame.problems
    for scan in (first, last):
        codes = [each.codes for each in scan.frame.problems]
        assert codes == ([(Code.NO_CHECK,), (Code.AMBIGUOUS,)] if off_mm else [])
        status = Status.REJECTED if off_mm else Status.MEASURED
        assert all(mark.status is status for mark in scan.frame.marks if mark.kind == "fiducial")


def test_one_part_tells_the_orientation_of_all(tmp_path: Path) -> None:
    path = tmp_path / "images.csv"
    path.write_text("image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,part_of\na,,,,,,,f\nb,1,0,9,0,0,0,f\n")
    given = read_images(path)
    assert given.part_of == {"a": "f", "b": "f"}
    assert given.exterior["a"] is given.exterior["b"] is not None
