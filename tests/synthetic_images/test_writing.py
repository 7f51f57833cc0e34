"""Writing on rendered frames: the letters that are asked for, where and as they are asked for."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import OBLIQUE, rendered, scene

from pipeline.errors import InputError
from pipeline.rendered.scene_file import parse_scene
from pipeline.text.tables import Table
from synthetic_images.areas import coverage
from synthetic_images.scene import SceneImage, Writing
from synthetic_images.truth import truth_json
from synthetic_images.writing import FONTS, written_area

Array = NDArray[np.float64]


def draw_text(text: str, font: str, size: int = 60) -> Array:
    """A line as a picture of 20 px a capital's height, its middle in the middle."""
    pixels = tuple(outline * (20.0, -20.0) + ((size - 1) / 2, (size - 1) / 2) for outline in written_area(text, font))
    return np.asarray(coverage((pixels,), 0, 0, size, size), float)


@pytest.mark.parametrize("font", FONTS)
def test_letters_are_as_high_as_requested_and_have_their_holes(font: str) -> None:
    high = draw_text("H", font).sum(axis=1)
    rows = np.flatnonzero(high > 0.1 * high.max())
    assert np.ptp(rows) + 1 == pytest.approx(20, abs=4)
    ring = draw_text("O", font)
    assert ring[30, 30] == 0.0
    assert ring[30].max() > 0.8


def test_letters_stand_upright() -> None:
    """Most of an L is low and left, of a T high."""
    letter, top = draw_text("L", "DejaVu Sans"), draw_text("T", "DejaVu Sans")
    assert letter[30:].sum() > 1.5 * letter[:30].sum()
    assert letter[:, :30].sum() > 1.5 * letter[:, 30:].sum()
    assert top[:30].sum() > 1.5 * top[30:].sum()


def written(folder: Path, **changes: Any) -> tuple[Array, SceneImage]:
    """A scan of the plain scene, written on above its frame, less the same without writing."""
    line = replace(Writing("LENS 7", (1.0, 6.5), 0.5), **changes)
    image = replace(OBLIQUE, writing=(line,))
    grey, truth = rendered(folder / "with", scene(images=(image,)))
    bare, _ = rendered(folder / "without", scene(images=(OBLIQUE,)))
    summary = json.loads(truth_json(truth))["images"]["f"]["writing"]
    assert [each["text"] for each in summary] == ["LENS 7"]
    difference = grey - bare
    row, col = np.nonzero(difference > 0.3)
    assert (col.min() + col.max()) / 2 == pytest.approx(summary[0]["col_px"], abs=1.0)
    assert (row.min() + row.max()) / 2 == pytest.approx(summary[0]["row_px"], abs=1.0)
    return difference[row.min() - 2 : row.max() + 3, col.min() - 2 : col.max() + 3], image


def test_a_line_is_painted_where_the_truth_says_turned_and_mirrored_as_requested(tmp_path: Path) -> None:
    upright, _ = written(tmp_path / "upright")
    mirrored, _ = written(tmp_path / "mirrored", mirrored=True)
    turned, _ = written(tmp_path / "turned", turn_deg=90.0, xy_mm=(-6.5, 1.0))
    assert np.abs(np.rot90(turned, -1) - upright).max() < 0.35  # half a pixel's shift
    assert np.abs(mirrored[:, ::-1] - upright).max() < 0.35
    assert np.abs(mirrored - upright).max() > 0.6


def test_writing_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="without any text"):
        Writing(" ", (0.0, 0.0), 1.0)
    with pytest.raises(ValueError, match="font"):
        Writing("A", (0.0, 0.0), 1.0, font="Comic Sans")


def scene_table(font: str = "cmr10") -> Table:
    pose = {"position": [0.0, 0.0, 4.0], "angles_deg": [0.0, 0.0, 0.0]}
    own = [{"text": "044", "xy_mm": [5.0, 6.5], "height_mm": 0.4, "mirrored": True}]
    return Table(
        {
            "camera": {"frame_mm": [12.0, 12.0], "principal_distance_mm": 14.0},
            "field": {"target": [{"id": "1", "xyz": [0.0, 0.0, 0.0]}], "diameter_mm": 30.0, "kind": "disks"},
            "scan": {"pitch_um": 40.0},
            "writing": [{"text": "RUN 7", "xy_mm": [-6.5, 0.0], "height_mm": 0.5, "turn_deg": 90.0, "font": font}],
            "image": [{"name": "a", **pose, "writing": own}, {"name": "b", **pose}],
        },
        Path("scene.toml"),
        "",
    )


def test_a_scene_file_writes_on_all_frames_and_on_single_ones() -> None:
    first, second = parse_scene(scene_table()).scene.images
    strip = Writing("RUN 7", (-6.5, 0.0), 0.5, 90.0, font="cmr10")
    assert first.writing == (strip, Writing("044", (5.0, 6.5), 0.4, mirrored=True))
    assert second.writing == (strip,)
    with pytest.raises(InputError, match="font"):
        parse_scene(scene_table("Comic Sans"))
