"""Scans in their camera's frame: a picture of known formula through every pose, through a lens, and as a file."""

import json
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from projects import made_record, write_tables

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.transformation import Film
from measure import MeasurementError, ScanOrientation, open_scan
from measure.flags import Code, Reason
from pipeline.files.project_file import read_project
from pipeline.resampling.canvas import Canvas, FrameChain, outline_canvas, scan_places
from pipeline.resampling.resample_stage import (
    BEST,
    FAST,
    TILE_PX,
    FrameScan,
    Resampled,
    ResampleTask,
    _tile_row_height_px,
    open_source,
    resample,
    resample_frame,
    resample_tasks,
)
from pipeline.terminal import Reporter
from pipeline.workers import WorkerKilled

Array = NDArray[np.float64]

PITCH_UM = (21.0, 20.0)
WIDTH, HEIGHT = 620, 540
BUMPS = 40
BLUR_PX = 1.6


def light(col: Array, row: Array) -> Array:
    """The picture's formula: Gaussians of 1.6 px, on a slope."""
    rng = np.random.default_rng(3)
    middles = rng.uniform((40, 40), (WIDTH - 40, HEIGHT - 40), (BUMPS, 2))
    value = 9000.0 + 4.0 * col - 3.0 * row
    for x, y in middles:
        value = value + 20000.0 * np.exp(-((col - x) ** 2 + (row - y) ** 2) / (2 * BLUR_PX**2))
    return np.asarray(value)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "a.tif"
    col, row = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    tifffile.imwrite(path, np.rint(light(col, row)).astype(np.uint16), compression="lzw", rowsperstrip=32)
    return path


def film(turn_deg: float, mirrored: bool) -> tuple[Film, Array, Array]:
    """A film transformation, and its matrix and shift: a turn, 0.2 % of affinity, the camera's origin in the middle."""
    turn = np.radians(turn_deg)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag(
        [-1.001 if mirrored else 1.001, 0.999]
    )
    middle = np.array([WIDTH * PITCH_UM[0], -HEIGHT * PITCH_UM[1]]) / 2000.0
    shift = np.array([0.3, -0.2]) - matrix @ middle
    a, b = ([shift[i], *matrix[i]] for i in (0, 1))
    return Film("affine", np.array([*a, *b]), middle), matrix, shift


@lru_cache
def marked() -> tuple[Array, Array]:
    """The middles (n, 2) of Gaussian marks, apart from one another, and their picture."""
    grid = np.stack(np.meshgrid(np.arange(60.0, WIDTH - 60, 45), np.arange(60.0, HEIGHT - 60, 45)), -1).reshape(-1, 2)
    middles = grid + np.random.default_rng(7).uniform(0.0, 1.0, grid.shape)
    col, row = np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float)
    x, y = (
        np.exp(-((at - place[:, None]) ** 2) / (2 * BLUR_PX**2))
        for at, place in zip((col, row), middles.T, strict=True)
    )
    return middles, 8000.0 + 20000.0 * y.T @ x


def task(scan: Path, folder: Path, chain: FrameChain, degree: int = BEST) -> ResampleTask:
    scans = (FrameScan("a", scan, chain),)
    return ResampleTask("a", "K", "0", 0.02, BEST if degree == BEST else FAST, None, folder / "a.tif", scans)


def described(path: Path) -> dict[str, Any]:
    with tifffile.TiffFile(path) as file:
        content: dict[str, Any] = json.loads(file.pages.first.description)
    return content


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turn_deg", [0.4, 90.4, 180.3, 269.7])
def test_marks_lie_where_the_transformation_puts_them(turn_deg: float, mirrored: bool, tmp_path: Path) -> None:
    """Gaussian marks, by least squares with their own form as the transformation turns it: within 0.002 px rms."""
    middles, picture = marked()
    tifffile.imwrite(tmp_path / "scan.tif", np.rint(picture).astype(np.uint16))
    transformation, matrix, shift = film(turn_deg, mirrored)
    assert resample_frame(task(tmp_path / "scan.tif", tmp_path, FrameChain(PITCH_UM, transformation))).problem == ""
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        frame = file.pages[0].asarray().astype(float)
    description = described(tmp_path / "a.tif")
    to_mm, to_px = np.diag([PITCH_UM[0], -PITCH_UM[1]]) / 1000.0, np.diag([1.0, -1.0]) / description["pitch_mm"]
    there = ((middles @ to_mm) @ matrix.T + shift - (description["x_mm"], description["y_mm"])) @ to_px
    off = mark_shifts(frame, there, to_px @ matrix @ to_mm)
    assert len(off) > 80
    assert np.sqrt(np.mean(np.square(off))) < 0.002


def mark_shifts(frame: Array, there: Array, form: Array) -> Array:
    """How far (n, 2) Gaussian marks of a scan lie from given places of its resampled frame; form (2, 2): from a scan's
    pixel to a frame's."""
    inverse = np.linalg.inv(BLUR_PX**2 * form @ form.T)
    at = np.arange(-9, 10)
    off = []
    for x, y in there:
        left, top = round(x), round(y)
        d = np.stack(np.meshgrid(at + left - x, at + top - y), axis=-1)
        view = frame[top - 9 : top + 10, left - 9 : left + 10]
        mark = np.exp(-np.einsum("ijk,kl,ijl->ij", d, inverse, d) / 2.0)
        slopes = 20000.0 * mark[..., None] * (d @ inverse)
        design = np.concatenate([np.stack([mark, np.ones_like(mark)], axis=-1), slopes], axis=-1).reshape(-1, 4)
        off.append(np.linalg.lstsq(design, view.ravel())[0][2:])
    return np.array(off)


def test_marks_of_both_scans_of_a_frame_lie_where_their_transformations_put_them(tmp_path: Path) -> None:
    """Each scan shows marks of its own; the second lies beside the first, turned by half a turn and mirrored. The seam
    is in the middle of what both show."""
    middles, picture = marked()
    tifffile.imwrite(tmp_path / "scan.tif", np.rint(picture).astype(np.uint16))
    to_mm = np.diag([PITCH_UM[0], -PITCH_UM[1]]) / 1000.0
    overlap_mm = 3.0
    ways = []
    for turn_deg, mirrored, side in ((0.4, False, -1.0), (180.3, True, 1.0)):
        transformation, matrix, shift = film(turn_deg, mirrored)
        neighbour = side * (WIDTH * PITCH_UM[0] / 1000.0 - overlap_mm) / 2.0
        parameters = transformation.parameters + np.array([neighbour, 0.0, 0.0, 0.0, 0.0, 0.0])
        ways.append((replace(transformation, parameters=parameters), matrix, shift + np.array([neighbour, 0.0]), side))
    one, two = (FrameChain(PITCH_UM, way[0]) for way in ways)
    scans = tuple(FrameScan(name, tmp_path / "scan.tif", chain) for name, chain in (("l", one), ("r", two)))
    both = replace(task(tmp_path / "scan.tif", tmp_path, one), scans=scans)
    assert resample_frame(both).problem == ""
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        frame = file.pages[0].asarray().astype(float)
    description = described(tmp_path / "a.tif")
    ((seam_x, _), *_) = description["seams_mm"][0]
    assert abs(seam_x - 0.3) < 0.3
    to_px = np.diag([1.0, -1.0]) / description["pitch_mm"]
    for _, matrix, shift, side in ways:
        places_mm = (middles @ to_mm) @ matrix.T + shift
        own = side * (places_mm[:, 0] - seam_x) > 0.4
        there = (places_mm[own] - (description["x_mm"], description["y_mm"])) @ to_px
        off = mark_shifts(frame, there, to_px @ matrix @ to_mm)
        assert len(off) > 60
        assert np.sqrt(np.mean(np.square(off))) < 0.002


def test_a_lens_is_taken_out_as_opencv_has_it(scan: Path, tmp_path: Path) -> None:
    transformation, matrix, shift = film(0.4, False)
    c, x0, y0, k1 = 12.0, 0.05, -0.04, -0.06
    lens = Lens(
        Distortion("opencv"),
        np.array([c, x0, y0]),
        np.array([k1 * (name == "k1") for name in parameter_names("opencv")]),
    )
    done = resample_frame(task(scan, tmp_path, FrameChain(PITCH_UM, transformation, lens=lens)))
    assert done.problem == ""
    pixels = tifffile.imread(tmp_path / "a.tif", key=0)
    description = described(tmp_path / "a.tif")
    assert description["lens"] is True
    col, row = np.meshgrid(np.arange(pixels.shape[1], dtype=float), np.arange(pixels.shape[0], dtype=float))
    corner, pitch_mm = (description["x_mm"], description["y_mm"]), description["pitch_mm"]
    ray = (corner + np.stack([pitch_mm * col, -pitch_mm * row], axis=-1) - (x0, y0)) / c
    rays = np.concatenate([ray.reshape(-1, 2) * (1, -1), np.ones((ray.size // 2, 1))], axis=1)
    projected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.diag([c, c, 1.0]), np.array([k1, 0.0, 0.0, 0.0]))[
        0
    ]
    observed = projected.reshape(ray.shape) * (1, -1) + (x0, y0)
    comparator = (observed - shift) @ np.linalg.inv(matrix).T
    col, row = comparator[..., 0] * 1000 / PITCH_UM[0], -comparator[..., 1] * 1000 / PITCH_UM[1]
    inside = (col > 8) & (col < WIDTH - 8) & (row > 8) & (row < HEIGHT - 8)
    assert inside.sum() > 0.8 * WIDTH * HEIGHT
    assert np.abs(pixels[inside] - light(col[inside], row[inside])).max() < 20.0


def test_the_rows_that_a_row_of_tiles_needs_are_those_of_its_own_place() -> None:
    """A barrel lens stretches what lies far from its axis; the ideal picture begins at its upper left corner."""
    lens = Lens(Distortion("torlegard"), np.array([60.0, 0.0, 0.0]), np.array([4e-5, *[0.0] * 6]))
    chain = FrameChain((10.0, 10.0), Film("none", np.empty(0), np.zeros(2)), lens=lens)
    canvas = Canvas(-25.0, 25.0, 0.01, 5001, 5001)
    corners_mm = np.array([(x, y) for x in (-25.0, 25.01) for y in (25.0, 25.0 - 0.01 * TILE_PX)])
    observed_mm, _ = lens.camera_from_ray(corners_mm / 60.0)
    expected = np.ptp(observed_mm[:, 1]) / 0.01
    assert abs(_tile_row_height_px(chain, canvas, 10000) - expected) < 1.0
    assert _tile_row_height_px(chain, canvas, 100) == 100
    beyond = replace(canvas, x_mm=-1e9)
    assert _tile_row_height_px(replace(chain, lens=replace(lens, parameters=-lens.parameters)), beyond, 777) == 777


def test_a_missing_value_of_the_film_is_named() -> None:
    chain = FrameChain((10.0, 10.0), Film("affine", np.array([1.0, 0.0, np.nan, 0.0, 1.0, 0.0]), np.zeros(2)))
    with pytest.raises(MeasurementError, match=r"is missing in adjustment\.json"):
        outline_canvas([(chain, (0, 0, 1600, 1600))], 0.01)


def test_a_fisheyes_ideal_picture_ends_where_it_would_be_stretched_without_end() -> None:
    """A picture of 180 degrees: two principal distances to either side, and pixels where OpenCV's fisheye has them."""
    c, k = 5.0, np.array([0.02, -0.005, 0.0, 0.0])
    lens = Lens(Distortion("opencv_fisheye"), np.array([c, 8.0, -8.0]), np.array([*k, 0.0, 0.0]))
    chain = FrameChain((10.0, 10.0), Film("none", np.empty(0), np.zeros(2)), lens=lens)
    canvas = outline_canvas([(chain, (0, 0, 1600, 1600))], 0.01)
    assert (canvas.width_px, canvas.height_px) == (2001, 2001)
    assert (canvas.x_mm, canvas.y_mm) == pytest.approx((8.0 - 2 * c, -8.0 + 2 * c))
    columns, rows = scan_places(chain, canvas, 1000, 1000, 64)
    at = np.arange(1000, 1064, dtype=np.float64)
    ideal = canvas.camera_mm(at, at) - lens.interior[1:]
    rays = np.concatenate([ideal / c * [1.0, -1.0], np.ones((64, 64, 1))], axis=2).reshape(-1, 1, 3)
    matrix = np.array([[500.0, 0.0, 800.0], [0.0, 500.0, 800.0], [0.0, 0.0, 1.0]])
    expected, _ = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, k)
    np.testing.assert_allclose(np.stack([columns, rows], axis=2).reshape(-1, 2), expected.reshape(-1, 2), atol=1e-4)


def test_a_frame_is_kept_until_something_changes_and_is_no_scan(scan: Path, tmp_path: Path) -> None:
    chain = FrameChain(PITCH_UM, film(0.4, False)[0])
    assert not resample_frame(task(scan, tmp_path, chain)).kept
    assert resample_frame(task(scan, tmp_path, chain)).kept
    assert not resample_frame(task(scan, tmp_path, chain, FAST)).kept
    moved = replace(chain, film=replace(chain.film, parameters=1.000000001 * chain.film.parameters))
    assert not resample_frame(task(scan, tmp_path, moved, FAST)).kept
    resample_frame(task(scan, tmp_path, FrameChain(PITCH_UM, film(0.4, False)[0])))
    with pytest.raises(MeasurementError, match="has resampled, and no scan"):
        open_scan(tmp_path / "a.tif")


def test_a_scan_in_strips_that_lies_across_is_decoded_once_and_its_losses_are_known(scan: Path, tmp_path: Path) -> None:
    with open_scan(scan) as opened, open_source(opened, 10**9, tmp_path) as decoded:
        for place in ((-20, -30, 100, 90), (WIDTH - 50, 100, 90, 60), (100, HEIGHT - 5, 40, 30), (300, 200, 50, 40)):
            assert (decoded.window(*place) == opened.samples(*place)).all()
    assert not list(tmp_path.iterdir())
    # A strip that is damaged is decoded once, and is no part of any tile.
    content = bytearray(scan.read_bytes())
    with tifffile.TiffFile(scan) as file:
        page = file.pages.first
        begin, count = page.dataoffsets[4], page.databytecounts[4]
    content[begin : begin + count] = b"\xff" * count
    (tmp_path / "damaged.tif").write_bytes(content)
    with open_scan(tmp_path / "damaged.tif") as opened, open_source(opened, 10**9, tmp_path) as decoded:
        known = decoded.valid_mask(-10, 100, 60, 80)
    rows = np.arange(100, 180)
    is_lost = (rows >= 4 * 32) & (rows < 5 * 32)
    np.testing.assert_array_equal(known[:, 10:], np.repeat(~is_lost[:, None], 50, axis=1))
    assert known[:, :10].all()  # beyond the edge nothing is lost


def test_detail_finer_than_a_coarse_pitch_does_not_appear_as_coarse_one(tmp_path: Path) -> None:
    """An eighth of lines 3.1 px apart is left at a pitch of 3 px, at which they would be 93 px apart; of lines
    40 px apart nearly all is."""
    col = np.arange(WIDTH, dtype=float)
    for period_px, least, most in ((3.1, 0.0, 0.15), (40.0, 0.9, 1.0)):
        lines = 30000.0 + 20000.0 * np.sin(2 * np.pi * col / period_px)
        tifffile.imwrite(tmp_path / "s.tif", np.tile(np.rint(lines).astype(np.uint16), (HEIGHT, 1)))
        coarse = replace(task(tmp_path / "s.tif", tmp_path, FrameChain(PITCH_UM, film(0.0, False)[0])), pitch_mm=0.063)
        resample_frame(coarse)
        inner = tifffile.imread(tmp_path / "a.tif", key=0)[20:-20, 20:-20].astype(float)
        assert least < np.ptp(inner) / 40000.0 < most


def test_a_frame_of_far_more_pixels_than_its_scan_is_refused(scan: Path, tmp_path: Path) -> None:
    """As of a pitch in mm for one in µm, before a disk is full."""
    fine = replace(task(scan, tmp_path, FrameChain(PITCH_UM, film(0.4, False)[0])), pitch_mm=0.0001)
    done = resample_frame(fine)
    assert done.path is None
    assert "at a pitch of 0.1 µm, more than 100 times its scan's" in done.problem
    assert not list(tmp_path.glob("*.tif"))


def test_a_frame_whose_place_in_the_scan_is_in_doubt_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless an adjustment has oriented it: one of fiducials alone fits any pose."""
    false_alarm = (Reason("chance finds as many with a probability of 1.00", Code.CHANCE),)
    scans = [made_record(1), made_record(2, pose=ScanOrientation("90", False)), made_record(3, problems=false_alarm)]
    monkeypatch.setattr("pipeline.resampling.resample_stage.read_measurement", lambda path: scans)
    project = 'camera = "camera.toml"'
    write_tables(tmp_path, project, camera='name = "K"\nframe_mm = [80.0, 80.0]', comparator="image,point\n")
    written = read_project(tmp_path / "project.toml")
    stage = "pipeline.resampling.resample_stage"
    monkeypatch.setattr(f"{stage}.read_comparator", lambda *given: ())
    chain = FrameChain(PITCH_UM, film(0.4, False)[0])
    monkeypatch.setattr("pipeline.resampling.canvas.image_chain", lambda *given: chain)
    assumed = "scan orientation 90 is assumed"
    for is_oriented, doubt in ((None, assumed), (False, assumed), (True, "")):
        record = SimpleNamespace(exterior=SimpleNamespace(is_oriented=is_oriented))
        adjustment = None if is_oriented is None else SimpleNamespace(images={"2": record})
        monkeypatch.setattr(f"{stage}.current_adjustment", lambda *given, adjustment=adjustment: adjustment)
        tasks, _ = resample_tasks(written, tmp_path, None, False, BEST)
        assert [task.doubt for task in tasks] == ["", doubt, false_alarm[0]]


def test_a_killed_process_costs_its_own_frame_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    errors = {"1": WorkerKilled(), "2": MemoryError(), "3": None}

    def submit(_: object, one: ResampleTask) -> Future[Resampled]:
        future, error = Future[Resampled](), errors[one.image]
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(Resampled(one.image, one.target))
        return future

    stage = "pipeline.resampling.resample_stage"
    chain = FrameChain(PITCH_UM, film(0.4, False)[0])
    tasks = [replace(task(tmp_path / "a.tif", tmp_path, chain), image=image) for image in errors]
    monkeypatch.setattr(f"{stage}.resample_tasks", lambda *given: (tasks, []))
    monkeypatch.setattr(f"{stage}.worker_pool", lambda count: nullcontext(SimpleNamespace(submit=submit)))
    done = resample(Mock(), tmp_path, None, False, False, Reporter(quiet=True))
    problems = ["its process was ended, most likely because the memory was full", "MemoryError", ""]
    assert [one.problem for one in done] == problems


def test_a_scan_that_is_gone_is_a_result(tmp_path: Path) -> None:
    done = resample_frame(task(tmp_path / "gone.tif", tmp_path, FrameChain(PITCH_UM, film(0.4, False)[0])))
    assert done.path is None
    assert "gone.tif" in done.problem
    assert not list(tmp_path.glob("*.tif"))
