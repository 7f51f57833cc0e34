"""A list of pixels in place of comparator coordinates."""

from pathlib import Path

import numpy as np
import pytest
from networks import BOARD_FRAME_MM, BOARD_TRUTH, board_network

from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.errors import InputError
from pipeline.files.project_file import read_project
from pipeline.results.comparator_file import read_comparator

DRAWN_MM = 0.005  # of a pixel, as the pictures were projected


def written(folder: Path, camera: str = "", project: str = "") -> Path:
    network = board_network(np.random.default_rng(2), 6, 1e-4)
    marks = network.observations
    pixels = marks.xy_mm / DRAWN_MM * [1.0, -1.0]
    lines = [
        f"{image},{point},{col:.5f},{row:.5f}"
        for image, point, (col, row) in zip(marks.image, marks.point, pixels, strict=True)
    ]
    (folder / "comparator.csv").write_text("\n".join(["image,point,col_px,row_px", *lines]))
    given = [f"b{number},{25 * (number % 9)},{25 * (number // 9)},0,0,0,0" for number in range(54)]
    (folder / "points.csv").write_text("\n".join(["point,X,Y,Z,sX,sY,sZ", *given]))
    lens = '[distortion]\nfamily = "opencv"\n[distortion.sigma]\nk1 = "free"\nk2 = "free"\n'
    (folder / "camera.toml").write_text(f'name = "desk"\n{camera}{lens}')
    path = folder / "project.toml"
    path.write_text(f'camera = "camera.toml"\n{project}[object]\npoints = "points.csv"\nunit = "mm"\n')
    return path


def adjust_network(path: Path) -> Adjustment:
    project = read_project(path)
    return adjust_marks(project, read_comparator(project.comparator, project.list_pitch_um))


@pytest.mark.parametrize(("line", "pitch_mm"), [("", 0.005), ("pitch_um = 8.0\n", 0.008)])
def test_a_digital_camera_comes_from_pixels_alone(tmp_path: Path, line: str, pitch_mm: float) -> None:
    result = adjust_network(written(tmp_path, project=line))
    for name in ("c", "x0", "y0"):
        key = Parameter.interior("desk", name)
        assert abs(result.value(key) / pitch_mm - BOARD_TRUTH[name] / DRAWN_MM) < 4.0 * result.sigma(key) / pitch_mm
    assert any("5 µm are assumed" in note for note in result.unused) == (not line)


def test_a_camera_file_in_mm_needs_the_size_of_a_pixel(tmp_path: Path) -> None:
    path = written(tmp_path, camera=f"frame_mm = [{BOARD_FRAME_MM[0]}, {BOARD_FRAME_MM[1]}]\n")
    with pytest.raises(InputError, match="Set pitch_um in"):
        adjust_network(path)
