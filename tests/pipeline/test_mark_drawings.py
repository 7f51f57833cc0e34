"""The library's drawings against pictures of real marks, and drawn cameras found among all others."""

from functools import partial
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from real_data import DATA, needs
from studies import parametrize_with_studies

from measure.marks.rendering import known_picture
from measure.marks.shapes import Mark, MarkShape, Polygon
from pipeline.archive.scan_groups import catalogue, identify_sample, name_cameras
from pipeline.files.library import read_library
from pipeline.measuring.camera_trials import _alike, identify
from pipeline.progress import Reporter
from pipeline.rendered.scene_file import render_project

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

LIBRARY = read_library()
SCENE = resources.files("pipeline").joinpath("templates", "scene.toml").read_text(encoding="utf-8")
GALLERY = DATA / "mark_gallery"
MM_A_PIXEL = 0.0320
HALF_PX, SEARCH_PX, RIM_PX = 140, 9, 8
DOTS = {"1": (304, 1606), "2": (1617, 301), "3": (304, 301), "4": (1617, 1606)} | {
    "5": (304, 953),
    "6": (1617, 953),
    "7": (960, 301),
    "8": (960, 1606),
}
SEEN = [
    ("small_flat_wing", "fairchild-k17-small-flat-153", "5678", 0.75),
    ("tall_flat_wing", "fairchild-k17-tall-flat-153", "5678", 0.7),
    ("curved_flat_wing", "fairchild-k17-curved-flat-153", "5678", 0.7),
    ("large_flat_wing", "wing-large-flat-153", "5678", 0.75),
    ("curved_wing", "wing-curved-153", "5678", 0.6),
    ("hollow_wing", "wing-hollow-153", "678", 0.5),
    ("fairchild_t11_notch", "fairchild-t11-notch-153", "678", 0.65),
    ("fairchild_t12_notch", "fairchild-t12-notch-152", "5678", 0.65),
    ("fairchild_t11_check", "fairchild-t11-check-153", "567", 0.85),
    ("fairchild_t12_cross", "fairchild-t12-cross-152", "56", 0.4),
    ("kc6a", "fairchild-kc6a-152", "5678", 0.7),
    ("t5_notch", "fairchild-t5-153", "5678", 0.65),
    ("arrow", "arrow-153", "5678", 0.65),
    ("park_crosshair", "park-153", "12345678", 0.65),
    ("wild_all_cross", "wild-rc8-eight-153", "12345678", 0.65),
    ("wild_mid_crosshair", "wild-rc10-eight-153", "12345678", 0.65),
    ("zeiss_corner", "zeiss-rmk-a-eight-153", "1234", 0.6),
]


def place_of_dot(picture: Picture, near: tuple[int, int]) -> Array:
    """(column, row) of the middle of the red dot about there."""
    col, row = near
    part = picture[row - 25 : row + 26, col - 25 : col + 26].astype(float)
    rows, cols = np.nonzero((part[..., 2] > 180) & (part[..., :2].max(axis=2) < 90))
    return np.array([col - 25 + cols.mean(), row - 25 + rows.mean()])


def likeness(picture: Picture, mark: Mark, dot: Array) -> float:
    """The largest correlation with the drawing within a third of a millimetre of the dot, about what is drawn; what is
    red is not asked."""
    first = np.rint(dot).astype(int) - HALF_PX - SEARCH_PX
    size = 2 * HALF_PX + 1
    matrix = np.column_stack([np.diag([1.0, -1.0]) / MM_A_PIXEL, dot - first - SEARCH_PX])
    drawn = known_picture(mark, matrix, size, size, 1.5)
    rows, cols = np.nonzero(np.nan_to_num(drawn) > 0.05)
    box = np.s_[max(rows.min() - RIM_PX, 0) : rows.max() + RIM_PX, max(cols.min() - RIM_PX, 0) : cols.max() + RIM_PX]
    beyond = HALF_PX + SEARCH_PX
    padded = cv2.copyMakeBorder(picture, beyond, beyond, beyond, beyond, cv2.BORDER_CONSTANT)
    best = 0.0
    for down in range(0, 2 * SEARCH_PX + 1, 3):
        for right in range(0, 2 * SEARCH_PX + 1, 3):
            row, col = first[1] + beyond + down, first[0] + beyond + right
            window = padded[row : row + size, col : col + size][box].astype(float)
            red = (window[..., 2] > 1.5 * window[..., 1] + 30).astype(np.uint8)
            known = ~np.isnan(drawn[box]) & (cv2.dilate(red, np.ones((5, 5), np.uint8)) == 0)
            best = max(best, abs(float(np.corrcoef(drawn[box][known], window.min(axis=2)[known])[0, 1])))
    return best


@needs("mark_gallery")
@parametrize_with_studies(("name", "camera", "marks", "least"), SEEN, quick=(6, 9, 11, 12))
def test_a_drawing_resembles_the_real_mark(name: str, camera: str, marks: str, least: float) -> None:
    picture = np.asarray(cv2.imread(str(GALLERY / f"{name}.png")))
    given = {mark.id: mark.mark for mark in LIBRARY[camera].layout().marks}
    like = {id: round(likeness(picture, given[id], place_of_dot(picture, DOTS[id])), 2) for id in marks}
    assert min(like.values()) > least, like


DRAWN = [names[0] for names in _alike(LIBRARY) if names[0] != "hasselblad-reseau-60"]


def scene_text(name: str) -> str:
    """One frame, in a scan that holds the marks beyond its edge. Light lines stand on pads; what is solid or dark has
    none, for it could not be seen there; what is dark beside the frame stands in exposed pockets."""
    layout = LIBRARY[name].layout()
    marks = [each.mark for each in layout.marks]
    solid = any(isinstance(part, Polygon) for mark in marks if isinstance(mark, MarkShape) for part in mark.parts)
    pad_mm = 0.0 if solid or any(mark.polarity == "dark" for mark in marks) else 3.0
    start, end = SCENE.index("[camera]\n"), SCENE.index("[field]\n")
    scene = SCENE[:start] + f'camera = "library:{name}"\n' + SCENE[end:]
    changes = {"pitch_um = 45.0": "pitch_um = 125.0", "margin_mm = 3.0": "margin_mm = 9.0"}
    neighbour = min(max(map(abs, each.xy_mm)) for each in layout.marks) > max(layout.frame_mm) / 2
    pocket_mm = 6.0 if neighbour and all(mark.polarity == "dark" for mark in marks) else 0.0
    behind = {"pad_mm = 1.9": f"pad_mm = {pad_mm}", "pocket_mm = 0.0": f"pocket_mm = {pocket_mm}"}
    for old, new in (changes | behind).items():
        assert old in scene
        scene = scene.replace(old, new)
    return scene[: scene.rindex("[[image]]")]


@pytest.mark.study
def test_scans_of_wings_are_named_where_the_scan_tells_their_form(tmp_path: Path) -> None:
    """Of three forms that are drawn much alike."""
    name = "fairchild-k17-tall-flat-153"
    (tmp_path / "scene.toml").write_text(scene_text(name), encoding="utf-8")
    render_project(tmp_path / "scene.toml", tmp_path)
    forms = {each: camera for each, camera in LIBRARY.items() if "k17" in each or each == "zeiss-rmk-a-153"}
    grouped = catalogue([tmp_path / "scans"], lambda *_: None)
    (group,) = name_cameras(
        grouped, partial(identify_sample, cameras=forms, pitch_um=None, max_pixels=None), Reporter(), None
    ).groups
    assert group.camera == name, group.sentence()


@pytest.mark.study
@pytest.mark.parametrize("name", DRAWN)
def test_a_drawn_camera_is_found_among_all(name: str, tmp_path: Path) -> None:
    """Rendered with another code, turned by half a degree, at 125 um."""
    (tmp_path / "scene.toml").write_text(scene_text(name), encoding="utf-8")
    render_project(tmp_path / "scene.toml", tmp_path)
    (scan,) = (tmp_path / "scans").glob("*.tif")
    found = identify(scan, LIBRARY, None, Reporter())
    assert name in [each for trial in found.best for each in trial.cameras], found.sentence()
