"""Targets on rendered frames: identified, in perspective, with no orientation, by several pictures."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from projects import measure_scan, present, replace_text, write_tables
from real_data import DATA, needs

from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.transformation import Film
from measure import Status, open_scan
from measure.results import Covariance, FrameMeasurement, MarkMeasurement
from measure.targets.detection import DiskSearch, disk_candidates
from measure.targets.ring_codes import RingCode, read_code
from measure.targets.sheets import Dots, Naming, name_dots
from pipeline import InputError
from pipeline.files.project_file import Project, read_project
from pipeline.measuring.coded_targets import check_sheet
from pipeline.measuring.scan_task import scan_tasks
from pipeline.measuring.target_field import across, disk_images, disk_normals, eccentricity_mm, plane_normal, recognise
from pipeline.rendered.scene_file import render_project
from pipeline.results.comparator_file import pixel_from_comparator
from pipeline.results.measured_record import MeasuredScan

Array = NDArray[np.float64]


def test_pattern_is_named_right_with_targets_missing_and_marks_that_are_none() -> None:
    rng = np.random.default_rng(1)
    for _ in range(12):
        n, size = int(rng.integers(8, 60)), 3000.0
        predicted = rng.uniform(0.0, size, (n, 2))
        angle, scale = rng.normal(0.0, 0.03), 1.0 + rng.normal(0.0, 0.03)
        turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        true = predicted @ turn.T + rng.normal(0.0, 200.0, 2)
        tilt = (true - size / 2) / size
        true += 0.01 * size * tilt * tilt[:, :1] * rng.normal() + rng.normal(0.0, 3.0, true.shape)
        kept = np.flatnonzero(rng.random(n) > 0.2)
        found = np.concatenate([true[kept], rng.uniform(0.0, size, (int(0.3 * n), 2))])
        order = rng.permutation(len(found))
        named = recognise(predicted, found[order], 1500.0)
        right = sum(order[mark] < len(kept) and kept[order[mark]] == target for mark, target in named.items())
        assert right >= 0.8 * len(kept)


def test_a_regular_grid_is_laid_next_to_its_prediction() -> None:
    """Moved on by a step, as many of its targets would lie on candidates."""
    grid = 100.0 * np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=-1).reshape(-1, 2)
    predicted = grid[(grid >= 300.0).all(axis=1) & (grid <= 800.0).all(axis=1)] + (30.0, -20.0)
    named = recognise(predicted, grid, 600.0)
    assert len(named) == len(predicted)
    for mark, target in named.items():
        np.testing.assert_allclose(predicted[target] - grid[mark], (30.0, -20.0))


PINHOLE = ImageModel(
    Lens(Distortion("none", {}), np.array([100.0, 0.0, 0.0]), np.empty(0)),
    np.eye(3),
    np.zeros(3),
    Film("none", np.empty(0), np.zeros(2), False),
)


def test_eccentricities_are_those_of_the_outline_also_at_seven_digits() -> None:
    """Through a pinhole, of a disk a third as far off as it is wide: the centre of gravity of 4000 points' polygon."""
    radius, c = 0.9, PINHOLE.lens.interior[0]
    centers, normals = np.array([[0.8, -0.5, -3.0], [-1.0, 0.6, -2.7]]), np.array([[0.6, 0.0, 0.8], [0.36, -0.48, 0.8]])
    found = eccentricity_mm(PINHOLE, centers, normals, radius)
    angles = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    for center, normal, off in zip(centers, normals, found, strict=True):
        first = np.cross(normal, [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        outline = center + radius * (
            np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(normal, first))
        )
        x, y = -c * outline[:, 0] / outline[:, 2], -c * outline[:, 1] / outline[:, 2]
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        middle = np.array([((x + np.roll(x, -1)) * cross).sum(), ((y + np.roll(y, -1)) * cross).sum()])
        middle /= 3.0 * cross.sum()
        np.testing.assert_allclose(off, middle + c * center[:2] / center[2], atol=1e-3)
    # To a picometre and less: what coordinates of seven digits lose by rounding would be 10 pm here.
    centers = np.array([[0.75, -0.5, -3.0], [-1.0, 0.625, -2.75]])
    normals = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    far = np.array([500_000.0, 5_400_000.0, 300.0])
    there = eccentricity_mm(replace(PINHOLE, station=far), centers + far, normals, 0.013)
    np.testing.assert_allclose(there, eccentricity_mm(PINHOLE, centers, normals, 0.013), rtol=0.0, atol=1e-12)


def test_places_in_the_plane_of_a_disk_follow_from_its_perspective() -> None:
    """Ten radii off, moved by it by 10 px."""
    centers, normals = np.array([[0.8, -0.5, -3.0], [-1.0, 0.6, -2.7]]), np.array([[0.6, 0.0, 0.8], [0.36, -0.48, 0.8]])
    radius, pitch = 0.01, (20.0, 20.0)
    place_px, maps, perspective, _ = disk_images(PINHOLE, pitch, centers, normals, radius)
    first, second = across(normals)
    far, _ = PINHOLE.comparator_from_object(centers + radius * (6.0 * first + 8.0 * second))
    off_px = maps @ (6.0, 8.0)
    projected_px = place_px + off_px / (1.0 + np.sum(perspective * off_px, axis=1))[:, None]
    np.testing.assert_allclose(pixel_from_comparator(far, pitch), projected_px, atol=0.05)


SCENE = """seed = 3
camera = {{name = "c", frame_mm = [24.0, 16.0], principal_distance_mm = 20.0}}
scan = {{pitch_um = 20.0, margin_mm = 0.1, noise = 0.01}}
image = [{{name = "a", position = [0.9, -0.4, 2.3], angles_deg = [10.0, 22.0, 130.0]}}]
[field]
surround = 1.5
scatter = [{{first = 5001, points = 20, right = [2.2, 0.0, 0.0], up = [0.0, 1.5, 0.0], relief = 0.35}}]
{field}
"""
CROSSES = 'kind = "crosses"\narm_mm = 45.0\nline_mm = 12.0'
RINGS = 'kind = "coded-rings"\ndiameter_mm = 36.0\nevery = 2'


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folder of each field's picture. Tests copy it before they change anything."""
    folders = {field: tmp_path_factory.mktemp("scene") for field in (CROSSES, RINGS)}
    for field, folder in folders.items():
        (folder / "scene.toml").write_text(SCENE.format(field=field))
        render_project(folder / "scene.toml", folder)
    return folders


def rendered(scene: Path, folder: Path) -> tuple[Path, dict[str, Array]]:
    """The project without its orientations, and the true places of the figures that are wholly seen."""
    shutil.copytree(scene, folder, dirs_exist_ok=True)
    project = folder / "project.toml"
    lines = project.read_text().splitlines()
    project.write_text("\n".join(line for line in lines if not line.startswith("images")))
    truth = json.loads((folder / "truth.json").read_text())["images"]["a"]["targets"]
    places = {id: np.array([t["ellipse_col_px"], t["ellipse_row_px"]]) for id, t in truth.items() if t["visible"]}
    return project, places


def errors(scan: MeasuredScan, places: dict[str, Array]) -> dict[str, Array]:
    marks = {mark.point: mark for mark in scan.frame.marks if mark.status.is_observation}
    return {id: np.asarray(marks[id].center_px) - place for id, place in places.items() if id in marks}


@pytest.mark.study
def test_crosses_in_space_with_no_principal_distance(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, places = rendered(scenes[CROSSES], tmp_path)
    camera = tmp_path / "camera.toml"
    lines = camera.read_text().splitlines()
    camera.write_text("\n".join(line for line in lines if "principal_distance" not in line))
    scan = measure_scan(read_project(project), "a")
    off = errors(scan, places)
    assert len(off) == len(places) > 12
    assert max(np.abs(one).max() for one in off.values()) < 0.03


@pytest.mark.study
def test_an_orientation_that_does_not_fit_is_not_used(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, places = rendered(scenes[CROSSES], tmp_path)
    turned = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg\na,-1.2,0.9,2.0,-25.0,-30.0,-90.0\n"
    (tmp_path / "images.csv").write_text(turned)
    text = project.read_text()
    project.write_text(text.replace("[object]", '[object]\nimages = "images.csv"'))
    scan = measure_scan(read_project(project), "a")
    assert len(errors(scan, places)) == len(places)
    assert any("orientation in images.csv was not used" in problem for problem in scan.frame.problems)


@pytest.mark.study
def test_ring_codes_in_space_and_two_that_are_confused(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, places = rendered(scenes[RINGS], tmp_path)
    off = errors(measure_scan(read_project(project), "a"), places)
    assert len(off) == len(places) > 12
    assert max(np.abs(one).max() for one in off.values()) < 0.08
    first, second = [id for id in places if int(id) < 4096][:2]
    points = tmp_path / "points.csv"
    swap = {first: second, second: first}
    rows = [row.split(",", 1) for row in points.read_text().splitlines()]
    points.write_text("\n".join(f"{swap.get(id, id)},{rest}" for id, rest in rows))
    scan = measure_scan(read_project(project), "a")
    assert any("lie where the field has another point" in problem for problem in scan.frame.problems)
    confused = errors(scan, places)
    assert set(confused) & {first, second} == set()
    assert len(confused) >= len(places) - 4


def test_a_ring_read_twice_is_the_one_at_its_place(scenes: dict[str, Path], tmp_path: Path) -> None:
    """A ring copied over another one: that dot has the place of one point, the code of the other, the name of none."""
    project, places = rendered(scenes[RINGS], tmp_path)
    first, second = [id for id in places if int(id) < 4096][:2]
    scan_file = read_project(project).scans["a"]
    picture = tifffile.imread(scan_file)
    (from_col, from_row), (col, row) = (np.round(places[id]).astype(int) for id in (first, second))
    half = 30
    chip = picture[from_row - half : from_row + half, from_col - half : from_col + half].copy()
    picture[row - half : row + half, col - half : col + half] = chip
    tifffile.imwrite(scan_file, picture)
    scan = measure_scan(read_project(project), "a")
    marks = {mark.point: mark for mark in scan.frame.marks}
    assert set(errors(scan, places)) == set(places) - {second}
    assert marks[second].status is Status.REJECTED
    assert marks[second].reason == f"the ring at its place reads as {first}"


def test_normals_of_a_flat_field_are_its_planes_and_face_the_camera() -> None:
    rng = np.random.default_rng(1)
    coordinates = np.column_stack([rng.uniform(-1.0, 1.0, (6, 2)), np.zeros(6)])
    plane = plane_normal(coordinates)
    ids = [str(i) for i in range(6)]
    below = np.array([0.0, 0.0, -5.0])
    normals, known = disk_normals(ids, coordinates, {"2": np.array([1.0, 0.0, 0.0])}, plane, below)
    assert known.all()
    np.testing.assert_allclose(normals[0], (0.0, 0.0, -1.0), atol=1e-12)
    np.testing.assert_allclose(normals[2], (1.0, 0.0, 0.0))
    _, known = disk_normals(ids, coordinates, {}, None, below)
    assert not known.any()
    assert plane_normal(rng.uniform(-1.0, 1.0, (6, 3))) is None


def test_a_code_of_no_point_of_the_sheet(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, _ = rendered(scenes[RINGS], tmp_path)
    replace_text(project, "[targets]\n", "[targets]\ncodes = {u3 = 5}\n")
    with pytest.raises(InputError, match=r"\[targets.codes\] u3: points.csv has no coordinates of such a point"):
        scan_tasks(read_project(project), ["a"])


def test_coordinates_in_another_unit_than_the_project_says(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, _ = rendered(scenes[CROSSES], tmp_path)
    text = project.read_text()
    project.write_text(text.replace('unit = "m"', 'unit = "mm"'))
    with pytest.raises(InputError, match=r"nine of ten points .* if their coordinates are in mm"):
        scan_tasks(read_project(project), ["a"])
    project.write_text(text)
    points = tmp_path / "points.csv"
    header, *rows = (row.split(",") for row in points.read_text().splitlines())
    in_mm = [[row[0], *(f"{1000.0 * float(value):.3f}" for value in row[1:4]), *row[4:]] for row in rows]
    points.write_text("\n".join(",".join(row) for row in (header, *in_mm)))
    scan = measure_scan(read_project(project), "a")
    assert any("unit the one of the coordinates?" in problem for problem in scan.frame.problems)


COLUMNS, ROWS, WIDTH, HEIGHT, NOISE_PX = 9, 8, 2200, 1700, 0.05
BUCKLED, MISPRINTED, PATCHED = "r2c3", "r5c6", "r6c2"


def board(folder: Path) -> Project:
    sheet = f'[targets]\nkind = "chessboard"\ncolumns = {COLUMNS}\nrows = {ROWS}\nsquare_mm = 20.0'
    project = f'camera = "camera.toml"\n{sheet}\n[object]\npoints = "points.csv"'
    camera, points = 'name = "c"\nframe_mm = [11.0, 8.5]', "point,X,Y,Z\nr0c0,,,"  # a board has places without any
    return read_project(write_tables(folder, project, camera=camera, points=points, comparator=""))


def rotation(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.roll(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), axis, (0, 1))


def view_points(rng: np.random.Generator, xyz: Array) -> Array:
    """(n, 2) px: up to 40 degrees oblique, rolled, with 8 % of barrel distortion, not about the picture's middle."""
    turned = rotation(2, rng.uniform(0.0, 6.28)) @ rotation(0, np.pi - rng.uniform(0.3, 0.7))
    camera = (xyz - xyz.mean(axis=0)) @ (turned @ rotation(2, rng.uniform(0.0, 6.28))).T + (0.0, 0.0, 260.0)
    ideal = camera[:, :2] / camera[:, 2:]
    bent = ideal * (1.0 - 0.3 * ((ideal - (0.02, -0.01)) ** 2).sum(axis=1, keepdims=True))
    return np.asarray(bent * 2000.0 + (WIDTH / 2, HEIGHT / 2) + rng.normal(0.0, NOISE_PX, ideal.shape))


def measure_picture(
    rng: np.random.Generator, project: Project, name: str, wrong: dict[str, float], patched_mm: float = 0.0
) -> MeasuredScan:
    """One picture, some of its points so many px off in some direction; one crossing of another place on the board."""
    targets = present(project.targets)
    assert targets.board is not None
    xyz = {id: np.array(place) for id, place in targets.board.object_points().items()}
    xyz[BUCKLED] = xyz[BUCKLED] + (0.0, 0.0, 1.0)
    xyz[MISPRINTED] = xyz[MISPRINTED] + (0.4, -0.3, 0.0)
    xyz[PATCHED] = xyz[PATCHED] + (0.6 * patched_mm, 0.8 * patched_mm, 0.0)
    marks = []
    for id, place in zip(xyz, view_points(rng, np.array(list(xyz.values()))), strict=True):
        angle = rng.uniform(0.0, 6.28)
        off = wrong.get(id, 0.0) * np.array([np.cos(angle), np.sin(angle)])
        marks.append(
            MarkMeasurement(id, "target", place + off, Covariance.from_noise(NOISE_PX**2 * np.eye(2)), Status.MEASURED)
        )
    fiducial = MarkMeasurement("r4c4", "fiducial", np.zeros(2), Covariance.from_noise(np.eye(2)), Status.MEASURED)
    return MeasuredScan(name, WIDTH, HEIGHT, (5.0, 5.0), FrameMeasurement(name, (fiducial, *marks)))


def status(scans: tuple[MeasuredScan, ...], wanted: Status) -> set[tuple[str, str]]:
    return {(scan.frame.image, mark.point) for scan in scans for mark in scan.frame.marks if mark.status is wanted}


def test_what_one_picture_alone_shows_off_its_place_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    project = board(tmp_path)
    wrong = {"p0": {"r0c0": 1.5, "r3c4": 0.8}, "p2": {"r7c8": 2.0, BUCKLED: 1.0}, "p4": {"r4c4": 40.0, "r6c1": 0.6}}
    names = [f"p{number}" for number in range(5)]
    checked = check_sheet(project, [measure_picture(rng, project, name, wrong.get(name, {})) for name in names])
    assert all(scan.frame.marks[0].status is Status.MEASURED for scan in checked)  # a fiducial of a point's name
    assert status(checked, Status.REJECTED) == {(name, id) for name, ids in wrong.items() for id in ids}
    assert not status(checked, Status.WEAK)
    assert check_sheet(project, []) == ()
    alone = check_sheet(project, [measure_picture(rng, project, "p0", {"r3c4": 3.0, "r1c1": 400.0})])
    doubted = status(alone, Status.WEAK)
    assert status(alone, Status.REJECTED) == {("p0", "r1c1")}
    assert ("p0", "r3c4") in doubted
    assert {id for _, id in doubted} <= {"r3c4", BUCKLED, MISPRINTED}
    reason = next(mark.reason for mark in alone[0].frame.marks if mark.point == "r3c4")
    assert "no other picture tells" in reason


def test_a_crossing_that_is_elsewhere_on_the_board_in_all_pictures_is_refused(tmp_path: Path) -> None:
    rng, project = np.random.default_rng(6), board(tmp_path)
    checked = check_sheet(project, [measure_picture(rng, project, f"p{k}", {}, patched_mm=4.0) for k in range(4)])
    assert status(checked, Status.REJECTED) == {(f"p{k}", PATCHED) for k in range(4)}
    assert not status(checked, Status.WEAK)
    reason = next(mark.reason for mark in checked[0].frame.marks if mark.point == PATCHED)
    assert "the board is damaged" in reason
    assert "in all pictures" in reason


@pytest.mark.parametrize("drawn_before", [12, 19, 120])
def test_a_scan_of_two_like_boards_says_so(tmp_path: Path, drawn_before: int) -> None:
    """And none of their points is an observation. OpenCV's detector draws random numbers: going on from these, it
    misses the second board."""
    cv2.setRNGSeed(drawn_before)
    table = '[targets]\nkind = "chessboard"\ncolumns = 4\nrows = 3\nsquare_mm = 25.0'
    project = f'camera = "camera.toml"\nscans = ["two.png"]\npitch_um = 10.0\n{table}'
    write_tables(tmp_path, project, camera='name = "c"\nframe_mm = [4.2, 1.8]')
    board = np.kron(np.indices((4, 5)).sum(axis=0) % 2, np.ones((32, 32)))
    sheet = np.pad(255 * board, 24, constant_values=255)
    two = cv2.GaussianBlur(np.hstack([sheet, sheet]), (0, 0), 0.8)
    cv2.imwrite(str(tmp_path / "two.png"), (20 + 0.8 * two).astype(np.uint8))
    frame = measure_scan(read_project(tmp_path / "project.toml"), "two").frame
    assert {mark.status for mark in frame.marks} == {Status.REJECTED}
    words = "No point of the board is used: the scan shows 2 boards of 4 x 3 inner corners"
    assert frame.problems[-1].startswith(words)


CAMCAL = DATA / "coded" / "camcal"
REAL_ROWS = """
90 92 94 95 97 96 93 91 89 88
81 1003 83 84 85 87 86 82 1004 80
71 73 75 77 78 79 76 74 72 70
61 62 64 65 67 69 68 66 63 60
50 51 54 55 56 59 58 57 53 52
42 45 40 41 43 49 47 44 46 48
30 31 32 33 34 36 37 35 38 39
25 23 21 20 22 24 26 27 28 29
17 1001 14 12 13 15 16 18 1002 19
8 6 4 2 3 5 7 9 10 11
"""  # the real sheet by the names in its list of marks, rows from the bottom, 1/7 m apart


@needs("coded", "camcal", "images")
@pytest.mark.parametrize(("picture", "count"), [(21, 100), (26, 93)])
def test_a_real_sheet(picture: int, count: int) -> None:
    """Every mark that was given for the picture gets its name, and its place to what a search without a fit can do."""
    lines = (CAMCAL / "camcaldemo" / "measurements" / "markpts.txt").read_text().splitlines()
    cells = [line.split(",") for line in lines if line.strip() and not line.startswith("#")]
    own = [row for row in cells if int(row[0]) == picture - 20]
    given = {int(row[1]): np.array([float(row[2]), float(row[3])]) - 0.5 for row in own}
    assert len(given) == count
    sheet = np.array(list(real_sheet().values()))
    numbers = {31: 1001, 51: 1002, 37: 1003, 85: 1004}
    row = {point: i for i, point in enumerate(real_sheet())}
    with open_scan(CAMCAL / "images" / f"P82500{picture}.JPG") as scan:
        found = disk_candidates(scan, DiskSearch((16.0, 60.0), "dark", 0.2))
        read = {i: read_code(scan, dot, RingCode(8, (2.6, 4.1))) for i, dot in enumerate(found)}
        coded = {i: row[numbers[number]] for i, number in read.items() if number in numbers}
        dots = Dots(
            np.array([dot.center_px for dot in found]), np.array([dot.pixel_from_disk for dot in found]), coded
        )  # fmt: skip
        naming = name_dots(sheet, dots, (scan.width_px, scan.height_px))
    assert isinstance(naming, Naming), naming
    named = {point: naming.named[row[point]] for point in given if row[point] in naming.named}
    off = {point: dots.centers_px[dot] - given[point] for point, dot in named.items()}
    assert len(off) >= len(given) - 2
    assert max(np.hypot(*step) for step in off.values()) < 2.5


def real_sheet() -> dict[int, Array]:
    rows = [line.split() for line in REAL_ROWS.strip().splitlines()]
    return {
        int(name): np.array([column - 1.0, row - 1.0]) / 7.0
        for row, names in enumerate(rows)
        for column, name in enumerate(names)
    }
