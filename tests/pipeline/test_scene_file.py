"""Scene files, and the projects that are written from them."""

import csv
import json
import tomllib
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import tifffile
from studies import parametrize_with_studies

from measure import open_scan
from measure.boards.specs import ChessboardSpec, CircleGridSpec
from measure.marks import shapes
from pipeline import InputError, read_camera, read_project
from pipeline.rendered.scene_file import read_scene, render_project
from pipeline.rendered.scene_project import write_project
from synthetic_images.frame import frame_truth
from synthetic_images.scene import ChipMark, DrawnMark
from synthetic_images.targets import field_targets

TEMPLATE = resources.files("pipeline").joinpath("templates", "scene.toml").read_text()
SCENES = Path(str(resources.files("synthetic_images").joinpath("scenes")))
READY = sorted(path for path in SCENES.glob("*.toml") if not path.name.endswith("_camera.toml"))
Rendered = tuple[Path, list[tuple[str, int, int]]]  # a folder, and the calls that told of progress
IMAGES = TEMPLATE.index("[[image]]")


def written(folder: Path, text: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def changed(old: str, new: str, text: str = TEMPLATE) -> str:
    assert old in text
    return text.replace(old, new, 1)


def rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@parametrize_with_studies("path", READY, quick=(1, 5), ids=[path.stem for path in READY])
def test_the_last_frame_of_a_ready_scene_shows_its_marks_and_enough_targets(path: Path) -> None:
    scene = read_scene(path).scene
    truth = frame_truth(scene, len(scene.images) - 1)
    assert [bool(position.hidden) for position in truth.fiducials.values()] == [False] * 8
    assert path.stem == "juhl_natural" or sum(not each.hidden for each in truth.targets.values()) >= 35


@pytest.fixture(scope="module")
def rendered_template(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    """The template's project, rendered once, and what it told of its progress."""
    calls: list[tuple[str, int, int]] = []
    folder = tmp_path_factory.mktemp("template")
    render_project(written(folder, TEMPLATE), folder / "out", lambda *call: calls.append(call))
    return folder / "out", calls


def test_the_template_becomes_a_project_and_its_truth(rendered_template: Rendered) -> None:
    folder, calls = rendered_template
    project = read_project(folder / "project.toml")
    assert list(project.scans) == ["frame1", "frame2"]
    assert project.given_points is not None
    assert len(project.given_points.points) == 30
    with open_scan(project.scans["frame2"]) as scan:
        assert scan.pitch_um == pytest.approx((45.0, 45.0))
        assert scan.width_px == 1356
    assert calls[-1] == ("frame2", 12, 12)
    assert [done for _, done, _ in calls] == list(range(1, 13))
    truth = json.loads((rendered_template[0] / "truth.json").read_text())
    camera = truth["cameras"]["small metric camera"]
    assert camera["principal_distance_mm"] == {"value": 60.0}
    assert camera["distortion"]["k3"] == {"value": -6.0e-6}
    assert camera["fiducials"]["1"] == {"x_mm": {"value": 25.0}, "y_mm": {"value": -25.0}}
    image = truth["images"]["frame2"]
    assert image["pose"] == "90m"
    assert image["exterior"]["kappa_deg"]["value"] == pytest.approx(90.0)
    t = {name: one["value"] for name, one in image["transformation"].items() if name != "kind"}
    assert set(truth["points"]["101"]) == {"X", "Y", "Z", "normal"}
    # The comparator coordinates of a mark, transformed, are its camera coordinates.
    mark = image["fiducials"]["1"]
    x, y = mark["col_px"] * 0.045, -mark["row_px"] * 0.045
    assert t["a1"] + t["a2"] * x + t["a3"] * y == pytest.approx(25.0, abs=1e-9)
    assert t["b1"] + t["b2"] * x + t["b3"] * y == pytest.approx(-25.0, abs=1e-9)


def test_what_is_given_has_the_errors_that_the_scene_asks_for(tmp_path: Path) -> None:
    text = changed("point_sigma = [0.0, 0.0]", "point_sigma = [0.002, 0.004]")
    text = changed("# bend_um = {a20", "bend_um = {a20", text)
    scene_file = read_scene(written(tmp_path, text))
    write_project(scene_file, tmp_path)
    assert 'scanner = "auto"' in (tmp_path / "project.toml").read_text()
    given = read_camera(tmp_path / "camera.toml")
    assert given.principal_distance_mm != 60.0
    assert given.principal_distance_mm == pytest.approx(60.0, abs=5 * 0.2)
    misses = np.array([one.xy_mm for one in given.fiducials]) - [one.xy_mm for one in scene_file.camera.fiducials]
    assert 0.002 < misses.std() < 0.01
    assert given.fiducials[0].sigma_mm == (0.005, 0.005)
    assert given.distortion.parameters["k3"].value == 0.0
    assert np.isinf(given.distortion.parameters["k3"].sigma)
    points = rows(tmp_path / "points.csv")
    true = {target.id: target.center for target in field_targets(scene_file.scene.field)}
    errors = np.array([[float(row[axis]) for axis in "XYZ"] - true[row["point"]] for row in points])
    assert errors[:, :2].std() == pytest.approx(0.002, rel=0.35)
    assert errors[:, 2].std() == pytest.approx(0.004, rel=0.5)
    assert {(row["sX"], row["sY"], row["sZ"]) for row in points} == {("0.002", "0.002", "0.004")}


def test_heights_only_leave_the_plane_free_but_for_the_fixed_points(tmp_path: Path) -> None:
    scene_file = read_scene(SCENES / "juhl_crosswise.toml")
    write_project(scene_file, tmp_path)
    points = {row["point"]: row for row in rows(tmp_path / "points.csv")}
    assert {(row["sX"], row["sY"]) for row in points.values()} == {("", ""), ("0", "0")}
    assert {id for id, row in points.items() if row["sX"]} == {"5", "143"}
    assert {row["sZ"] for row in points.values()} == {"0.02"}
    exact = next(target for target in field_targets(scene_file.scene.field) if target.id == "5")
    assert [float(points["5"][axis]) for axis in "XY"] == pytest.approx(list(exact.center[:2]), abs=1e-6)


def test_the_given_camera_has_marks_and_fixed_terms(tmp_path: Path) -> None:
    text = changed('k3 = "free"                             #', "k3 = 0.0  #")
    write_project(read_scene(written(tmp_path, text)), tmp_path)
    assert read_camera(tmp_path / "camera.toml").distortion.parameters["k3"].value == -6.0e-6
    scene_file = read_scene(written(tmp_path, TEMPLATE))
    write_project(scene_file, tmp_path)
    given = read_camera(tmp_path / "camera.toml")
    assert [one.mark for one in given.fiducials] == [one.mark for one in scene_file.camera.fiducials]
    assert given.frame_mm == (55.0, 55.0)
    scene_file = read_scene(written(tmp_path, changed("negative = false ", "negative = true ")))
    assert all(isinstance(one.mark, DrawnMark) and one.mark.light for one in scene_file.scene.camera.fiducials)
    write_project(scene_file, tmp_path)
    given = read_camera(tmp_path / "camera.toml")
    assert {one.mark.polarity for one in given.fiducials if isinstance(one.mark, shapes.Mark)} == {"dark"}


def test_a_mark_cut_from_a_scan_is_drawn_and_given(tmp_path: Path) -> None:
    chip = np.random.default_rng(1).integers(100, 60000, (19, 16), np.uint16)
    tifffile.imwrite(tmp_path / "chip.tif", chip)
    text = changed(
        'kind = "ring-cross"\npolarity = "light"\nring_mm = 0.5\nring_line_mm = 0.1\narm_mm = 0.36\nline_mm = 0.1\n',
        'kind = "template"\nimage = "chip.tif"\npitch_um = 45.0\norigin_px = [7.5, 9.0]\n',
    )
    scene_file = read_scene(written(tmp_path, text))
    mark = scene_file.scene.camera.fiducials[1].mark
    assert isinstance(mark, ChipMark)
    assert (mark.image.min(), mark.image.max()) == (0.0, 1.0)
    write_project(scene_file, tmp_path / "out")
    given = read_camera(tmp_path / "out" / "camera.toml").fiducials[1].mark
    assert isinstance(given, shapes.MarkTemplate)
    assert given.origin_px == (7.5, 9.0)
    assert np.abs(given.image / 65535 - mark.image).max() < 1e-4


@pytest.mark.parametrize(
    ("field", "board"),
    [
        ("square_mm = 90.0", ChessboardSpec(7, 5, 90.0)),
        ("spacing_mm = 90.0\ndiameter_mm = 40.0\nasymmetric = true", CircleGridSpec(7, 5, 90.0, 40.0, True)),
    ],
)
def test_boards_have_their_points(tmp_path: Path, field: str, board: ChessboardSpec | CircleGridSpec) -> None:
    kind = "chessboard" if isinstance(board, ChessboardSpec) else "circle-grid"
    table = f'[field]\nunit = "mm"\nkind = "{kind}"\ncolumns = 7\nrows = 5\n{field}\n[scan]\npitch_um = 45.0\n'
    scene_file = read_scene(written(tmp_path, TEMPLATE[: TEMPLATE.index("[field]\n")] + table + TEMPLATE[IMAGES:]))
    write_project(scene_file, tmp_path)
    points = {target.id: tuple(target.center) for target in field_targets(scene_file.scene.field)}
    assert points == {id: pytest.approx(place) for id, place in board.object_points().items()}
    targets = tomllib.loads((tmp_path / "project.toml").read_text())["targets"]
    assert (targets["kind"], targets["columns"]) == (kind, 7)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("grain_px", "grain_pixel", ["line", "grain_pixel", "no key", "'grain_px'"]),
        ('pose = "90m"', 'pose = "m90"', ["image[2]", "pose", "'m90'", "'90m'"]),
        ('compression = "lzw"', 'compression = "jpeg"', ["jpeg", "8 bits", "bit_depth = 8"]),
        ("bit_depth = 16", "bit_depth = 12", ["bit_depth", "12", "8, 16"]),
        ("# covered = [", "covered = [", ["frame2"]),
        ('name = "frame2"', 'name = "frame1"', ["'frame1'", "twice"]),
        ('name = "frame2"', 'name = "roll/2"', ["roll/2", "file"]),
        ("to_mm = [0.36, 0.0]", "to_mm = [-0.36, 0.0]", ["bar", "two different ends"]),
        ("tile_px = 256", "tile_px = 100", ["tile_px", "multiple of 16"]),
        ("up = [0.0, 0.58, 0.0]", "up = [0.58, 0.0, 0.0]", ["field.grid[1]", "up", "parallel"]),
    ],
)
def test_a_wrong_scene_file_says_what_is_wrong(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    text = changed(old, new).replace('covered = ["3"]', 'covered = ["9"]')
    with pytest.raises(InputError) as caught:
        read_scene(written(tmp_path, text))
    message = str(caught.value)
    assert "scene.toml" in message
    for word in words:
        assert word in message


def test_a_scene_that_cannot_be_rendered_is_refused(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text('name = "mine"')
    path = written(tmp_path, TEMPLATE)
    with pytest.raises(InputError, match=r"holds camera.toml, which would be overwritten.*Name another folder"):
        render_project(path, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"camera.toml", "scene.toml"}
    (tmp_path / "own" / "scans").mkdir(parents=True)
    with pytest.raises(InputError, match=r"holds scans, which would be overwritten"):
        render_project(path, tmp_path / "own")
    with pytest.raises(InputError, match="cannot be written"):
        render_project(path, path / "out")
    with pytest.raises(InputError, match=r"nowhere\.toml: there is no such file"):
        read_scene(tmp_path / "nowhere.toml")
    bare = TEMPLATE[: TEMPLATE.index("[[field.grid]]")] + TEMPLATE[TEMPLATE.index("[picture]") :]
    demo = (SCENES / "demo.toml").read_text()
    for text, words in (
        (TEMPLATE[:IMAGES], "at least one image"),
        (bare, "no target"),
        (changed('"metric_camera.toml"', "5", demo), "line 5: camera: must be a table, .* quotes, not 5"),
        (changed('"metric_camera.toml"', "[5]", demo), "line 5: camera: must be a table"),
    ):
        with pytest.raises(InputError, match=words):
            read_scene(written(tmp_path, text))
