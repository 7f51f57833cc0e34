"""Published results that come with their numbers, through the user's files; skipped where the data are not at hand."""

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_data import DATA, needs

from pipeline.cli import run

FILM = DATA / "film_numbers"
pytestmark = needs("film_numbers")

Json = dict[str, Any]


def adjust_network(folder: Path, camera: str, project: str, rows: Iterable[Sequence[object]], points: str = "") -> Json:
    """The result of `reseau adjust` on files; rows of comparator.csv in its own order."""
    (folder / "camera.toml").write_text(camera, encoding="utf-8")
    (folder / "points.csv").write_text("point,X,Y,Z,sX,sY,sZ\n" + points, encoding="utf-8")
    given = '[object]\npoints = "points.csv"\n' if points else ""
    (folder / "project.toml").write_text(f'camera = "camera.toml"\n{given}{project}', encoding="utf-8")
    lines = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm", *(",".join(map(str, row)) for row in rows)]
    (folder / "comparator.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(["adjust", str(folder / "project.toml")]) in (0, 1)
    result: Json = json.loads((folder / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert result["converged"]
    return result


def table(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def fiducials(rows: list[dict[str, str]], sigma: float) -> str:
    return "".join(
        f'[[fiducial]]\nid = "{row["id"]}"\nxy_mm = [{float(row["cal_x_mm"])}, {float(row["cal_y_mm"])}]\n'
        f"sigma_mm = {sigma}\n"
        for row in rows
    )


def test_interior_orientation_of_eight_fiducials(tmp_path: Path) -> None:
    """An affine transformation published with its rms, all errors in the given coordinates: they are given 1 mm."""
    pitch_mm = 0.042
    marks = table(FILM / "sju_8fid" / "fiducials.csv")
    rows = [
        ("left", m["id"], "fiducial", float(m["x_px"]) * pitch_mm, -float(m["y_px"]) * pitch_mm, 1e-4, 1e-4)
        for m in marks
    ]
    result = adjust_network(tmp_path, 'name = "SJU"\n' + fiducials(marks, 1.0), "", rows)
    found = {key: part["value"] for key, part in result["images"]["left"]["transformation"].items() if key[0] in "ab"}
    per_px = [pitch_mm * found["a2"], -pitch_mm * found["a3"], pitch_mm * found["b2"], -pitch_mm * found["b3"]]
    assert per_px == pytest.approx([0.041989, 0.000144, 0.000147, -0.041985], abs=6e-7)
    assert (found["a1"], found["b1"]) == pytest.approx(
        (-120.259262, 116.872551), abs=1e-5
    )  # computed in single precision
    datum = result["groups"]["datum"]
    assert (datum["rms_x_um"], datum["rms_y_um"]) == pytest.approx((18.612, 10.329), abs=1e-3)
    assert result["redundancy"] == 10


@pytest.mark.parametrize(
    ("kind", "rms_um"), [("affine", ((5.7, 5.1), (5.7, 4.3))), ("similarity", ((6.8, 6.2), (6.5, 5.3)))]
)
def test_fiducials_of_a_film_pair(kind: str, rms_um: Sequence[tuple[float, float]], tmp_path: Path) -> None:
    """A Wild RC30 pair, the calibrated fiducials held fixed."""
    result = adjust_network(tmp_path, *rc30(kind))
    for image, expected in zip(("3574", "3575"), rms_um, strict=True):
        v = [(row["vx_um"], row["vy_um"]) for row in result["residuals"] if row["image"] == image]
        assert np.sqrt((np.array(v) ** 2).mean(axis=0)) == pytest.approx(expected, abs=0.06)
    assert result["redundancy"] == 2 * (16 - {"affine": 6, "similarity": 4}[kind])


def test_a_film_pair_on_its_ground_points(tmp_path: Path) -> None:
    """Oriented from nine ground points of half a metre, most of them in one corner, and four tie points.

    Nothing is published of it but the numbers: rays meet to 2 um (an eighth of a pixel), the ground fits to 0.1 m.
    """
    camera, project, marks = rc30("affine")
    folder = FILM / "rc30_AR112_3574_3575"
    rows = [
        (row["image"], row["name"], "target", 0.016 * float(row["x_px"]), 0.016 * float(row["y_px"]), 0.005, 0.005)
        for row in table(folder / "image_measurements.csv")
    ]
    points = "".join(
        f"{row['name']},{row['X_m']},{row['Y_m']},{row['Z_m']},{'0.5,0.5,0.5' if row['X_m'] else ',,'}\n"
        for row in table(folder / "points.csv")
    )
    result = adjust_network(tmp_path, camera, project, [*marks, *rows], points)
    assert result["redundancy"] == 42
    groups = result["groups"]
    assert max(groups["target"]["rms_x_um"], groups["target"]["rms_y_um"]) < 2.1
    assert max(groups["control"]["rms_x_um"], groups["control"]["rms_y_um"]) < 0.07e6
    heights = [result["images"][image]["exterior"]["Z0"]["value"] for image in ("3574", "3575")]
    assert heights == pytest.approx([925.9, 925.4], abs=0.5)


def rc30(kind: str) -> tuple[str, str, list[tuple[object, ...]]]:
    """Camera, project and fiducial rows of the pair: the readings' origin is at the lower left, y up."""
    marks = table(FILM / "rc30_AR112_3574_3575" / "fiducials.csv")
    rows: list[tuple[object, ...]] = [
        (image, m["id"], "fiducial", *(0.016 * float(m[f"img{image}_{axis}_px"]) for axis in "xy"), 0.005, 0.005)
        for image in ("3574", "3575")
        for m in marks
    ]
    camera = (
        'name = "RC30"\nprincipal_distance_mm = 153.324\nprincipal_point_mm = [-0.002, 0.004]\n'
        "[sigma]\nprincipal_distance_mm = 0\nprincipal_point_mm = 0\n"
    )
    return camera + fiducials(marks, 0.0), f'[adjust]\ntransformation = "{kind}"\n', rows


@pytest.mark.study
@needs("coded", "camcal", "camcaldemo")
def test_a_self_calibration_of_2074_marks(tmp_path: Path) -> None:
    """DBAT's camera calibration demo, as in tests/adjust/test_camcal.py, from files and without any approximation."""
    folder = DATA / "coded" / "camcal" / "camcaldemo"
    aspect = 1.000389598
    pixel_mm = np.array([aspect, 1.0]) * 5.43764 / 1704
    known = {row[0]: row[2:5] for row in plain_table(folder / "reference" / "camcal-fixed.txt")}
    rows = []
    for image, point, col, row, sigma_px in plain_table(folder / "measurements" / "markpts.txt"):
        xy = pixel_mm * [float(col), -float(row)]
        rows.append((image, point, "target", *xy.tolist(), *[float(sigma_px) * pixel_mm[1]] * 2))
    points = "".join(
        f"{point},{','.join(known[point])},0,0,0\n" if point in known else f"{point},,,,,,\n"
        for point in sorted({str(row[1]) for row in rows})
    )
    free = "".join(f'{name} = "free"\n' for name in ("k1", "k2", "k3", "p1", "p2", "b1"))
    camera = f'name = "C4040Z"\n[distortion]\nfamily = "brown"\n[distortion.sigma]\n{free}'
    result = adjust_network(tmp_path, camera, '[adjust]\ntransformation = "none"\nmethod = "elements"\n', rows, points)
    assert result["redundancy"] == 3725
    assert 0.1 * result["sigma0"] == pytest.approx(0.16148, rel=1e-4)
    found = result["cameras"]["C4040Z"]
    point = found["principal_point_mm"]
    quantities = {"c": found["principal_distance_mm"], "px": point["x"], "py": point["y"], **found["distortion"]}
    published = {
        "c": (7.457, 0.00105),
        "px": (3.61546 * aspect, 0.00082),
        "py": (-2.61329, 0.00098),
        "k1": (-4.58861e-3, 2.21e-5),
        "k2": (4.51351e-5, 2.65e-6),
        "k3": (2.05253e-6, 1.01e-7),
        "p1": (6.12803e-5, 3.52e-6),
        "p2": (4.41172e-5, 3.94e-6),
    }
    for name, (value, sigma) in published.items():
        assert abs(quantities[name]["value"] - value) < 0.1 * sigma, name
        assert quantities[name]["sigma"] == pytest.approx(sigma, rel=0.005), name


def plain_table(file: Path) -> list[list[str]]:
    lines = file.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.split(",")] for line in lines if line.strip() and not line.startswith("#")]
