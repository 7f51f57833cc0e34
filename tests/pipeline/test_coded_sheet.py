"""A printed sheet with ring codes from picture to names: drawn under perspective and distortion, and a real one."""

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from real_data import DATA, needs

from measure import open_scan
from measure.targets.disk_detection import DiskSearch, disk_candidates
from measure.targets.ring_codes import RingCode, read_code
from measure.targets.sheets import Dots, Naming, name_dots
from pipeline.cli import run

Array = NDArray[np.float64]
SIDE = 7  # dots a side
CODES = {8: 0b000000010111, 12: 0b000101011011, 36: 0b001001111011, 40: 0b000110011111}
FINE = 180.0  # px of the drawing a step
RADIUS = 0.1  # of a dot, in steps
WIDTH, HEIGHT, FINER = 900, 680, 2
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


@dataclass(frozen=True, eq=False)
class Shot:
    """picture (HEIGHT, WIDTH); places (49, 2): of the dots' centres in it; missing: those that are not printed."""

    picture: NDArray[np.uint8]
    places: Array
    missing: set[int]


def shot(seed: int, coded: bool = True) -> Shot:
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2).astype(float)
    missing = set(rng.choice([i for i in range(SIDE**2) if i not in CODES], SIDE**2 // 5, replace=False).tolist())
    sheet = np.full((int((SIDE + 1) * FINE),) * 2, 205, np.uint8)
    for number, place in enumerate(grid):
        if number not in missing:
            disk(sheet, place, RADIUS)
            if coded and number in CODES:
                ring(sheet, place, CODES[number], rng.uniform(0, 2 * np.pi))
    printed = list(grid)
    while len(printed) < SIDE**2 + SIDE**2 // 5:
        false = rng.uniform(-0.6, SIDE - 0.4, 2)
        if min(np.hypot(*(false - place)) for place in printed) > 0.45:
            disk(sheet, false, RADIUS * rng.uniform(0.9, 1.1))
            printed.append(false)
    return photographed(sheet, grid, missing, rng)


def draw_place(place: Array) -> Array:
    """The sheet's y is up, the drawing's rows go down."""
    return np.array([place[..., 0] + 1.0, SIDE - place[..., 1]]).T * FINE


def disk(sheet: NDArray[np.uint8], place: Array, radius: float) -> None:
    center = np.round(16 * draw_place(place)).astype(int)
    cv2.circle(sheet, (int(center[0]), int(center[1])), round(16 * radius * FINE), 25, -1, cv2.LINE_AA, 4)


def ring(sheet: NDArray[np.uint8], place: Array, code: int, turn: float) -> None:
    """Bits of the common 12-bit code, clockwise, between two and three radii of the dot."""
    for bit in range(12):
        if code >> (11 - bit) & 1:
            angles = turn + 2 * np.pi / 12 * (bit + np.linspace(-0.001, 1.001, 12))
            arc = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            outline = np.concatenate([2.0 * arc, 3.0 * arc[::-1]]) * RADIUS * FINE + draw_place(place)
            cv2.fillPoly(sheet, [np.round(16 * outline).astype(np.int32)], 25, cv2.LINE_AA, 4)


def photographed(sheet: NDArray[np.uint8], grid: Array, missing: set[int], rng: np.random.Generator) -> Shot:
    """A picture from an oblique side, the camera rolled, with 8 % of barrel distortion in its corners."""
    size = len(sheet)
    corners = np.array([(0, 0), (size, 0), (size, size), (0, size)], np.float32)
    trapezoid = np.array([(-250, -290), (250, -290), (340, 300), (-340, 300)]) * 0.95
    roll = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    homography = cv2.getPerspectiveTransform(corners, (trapezoid @ turn.T).astype(np.float32)).astype(float)
    unit, bend = np.hypot(WIDTH, HEIGHT) / 2, 0.08
    fine_cols, fine_rows = np.arange(WIDTH * FINER) / FINER - 0.25, np.arange(HEIGHT * FINER) / FINER - 0.25
    pixels = np.stack(np.meshgrid(fine_cols, fine_rows), axis=-1) - (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
    ideal = pixels * (1 + bend * (pixels**2).sum(axis=-1, keepdims=True) / unit**2)
    back = cv2.perspectiveTransform(ideal.reshape(-1, 1, 2), np.linalg.inv(homography)).reshape(pixels.shape)
    fine = cv2.remap(
        cv2.GaussianBlur(sheet, (0, 0), 1.2),
        back[..., 0].astype(np.float32),
        back[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderValue=90,
    )
    picture = cv2.GaussianBlur(cv2.resize(fine, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    noisy = np.clip(picture + rng.normal(0, 2.0, picture.shape), 0, 255).astype(np.uint8)
    target = cv2.perspectiveTransform(draw_place(grid).reshape(-1, 1, 2), homography).reshape(-1, 2)
    places, middle = target.astype(np.float64), np.array([WIDTH, HEIGHT]) / 2 - 0.5
    for _ in range(50):
        places = target / (1 + bend * (places**2).sum(axis=1, keepdims=True) / unit**2)
    return Shot(noisy, np.asarray(places + middle, np.float64), missing)


def project(folder: Path, pictures: dict[str, NDArray[np.uint8]], extra: str = "") -> Path:
    for name, picture in pictures.items():
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    rows = [f"t{i},{i % SIDE},{i // SIDE},0,0,0,0" for i in range(SIDE**2)]
    (folder / "points.csv").write_text("\n".join(["point,X,Y,Z,sX,sY,sZ", *rows]), encoding="utf-8")
    (folder / "camera.toml").write_text('name = "c"\nframe_mm = [36.0, 27.2]\n', encoding="utf-8")
    codes = "\n".join(f"t{point} = {code}" for point, code in CODES.items())
    (folder / "project.toml").write_text(
        'camera = "camera.toml"\nscans = ["*.png"]\npitch_um = 40.0\n[targets]\nkind = "coded-ring"\n'
        f'diameter_mm = 200.0\n[targets.codes]\n{codes}\n{extra}\n[object]\npoints = "points.csv"\n',
        encoding="utf-8",
    )
    return folder / "project.toml"


def table(folder: Path) -> list[dict[str, str]]:
    lines = (folder / "comparator.csv").read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


@pytest.mark.study
def test_a_drawn_sheet_with_a_fifth_missing_and_a_fifth_false(tmp_path: Path) -> None:
    shots = {"coded": shot(1), "plain": shot(3, coded=False)}
    assert run(["measure", str(project(tmp_path, {name: one.picture for name, one in shots.items()}))]) == 1
    rows = table(tmp_path)
    assert len(rows) == 2 * SIDE**2
    own = {int(row["point"][1:]): row for row in rows if row["image"] == "coded"}
    own_found = {i for i, row in own.items() if row["status"] in ("measured", "weak")}
    missing = shots["coded"].missing
    assert own_found == set(range(SIDE**2)) - missing
    for i in own_found:
        found = np.array([float(own[i]["col_px"]), float(own[i]["row_px"])])
        assert np.hypot(*(found - shots["coded"].places[i])) < 0.4, i  # eccentricity and all
    assert all(own[i]["reason"] for i in missing)
    plain = [row for row in rows if row["image"] == "plain"]
    assert {row["status"] for row in plain} == {"absent"}
    assert all("has a ring of 12 segments" in row["reason"] for row in plain)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("u3 = 5", "points.csv has no coordinates of such a point"),
        ("t3 = 4095", "is no number of 12 bits"),
        ("t3 = 46", "is, turned, the code of t8 too"),
        ("[targets.more]", "is no key of this table"),
    ],
)
def test_what_the_codes_cannot_be(tmp_path: Path, extra: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["measure", str(project(tmp_path, {"a": np.zeros((60, 80), np.uint8)}, extra))]) == 2
    assert message in capsys.readouterr().err


@needs("coded", "camcal", "images")
@pytest.mark.parametrize(("picture", "count"), [(21, 100), (26, 93)])
def test_a_real_sheet(picture: int, count: int) -> None:
    """Every mark that was given for the picture gets its name, and its place to what a search without a fit can do."""
    lines = (CAMCAL / "camcaldemo" / "measurements" / "markpts.txt").read_text(encoding="utf-8").splitlines()
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
