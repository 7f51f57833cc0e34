"""Project files of `reseau calibrate`, which `reseau run` can continue."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.calibration.board_options import BoardOptions
from pipeline.calibration.lens_choice import LensModel, LensSetting, free_lens
from pipeline.calibration.pictures import BoardPictureFiles, CameraPictures
from pipeline.files.project_file import ASSUMED_PITCH_UM, Project, read_project
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import csv_line
from pipeline.text.wording import quoted


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a calibration. pitch_um: pixel pitch, None if unknown; ros: whether ROS's camera info is written,
    too."""

    board: BoardOptions
    lens: LensSetting = "auto"
    square_pixels: bool = False
    pitch_um: float | None = None
    ros: bool = False

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel in the project; assumed if unknown."""
        return (self.pitch_um or ASSUMED_PITCH_UM) / 1000.0


def write_project(
    out: Path, pictures: BoardPictureFiles, options: CalibrationOptions, lenses: Mapping[str, LensModel]
) -> Project:
    """Write project.toml, a camera file for each camera, and images.csv where images differ; then read the project."""
    out.mkdir(parents=True, exist_ok=True)
    for camera in pictures.cameras:
        write_atomically(out / f"{camera.name}.toml", _camera_text(camera, options, lenses[camera.name]))
    has_lines = len(pictures.cameras) > 1 or any(camera.turned_deg for camera in pictures.cameras)
    if has_lines:
        lines = ["image,camera,turned_deg"]
        for each in pictures.cameras:
            cells = ((name, f"{each.name}.toml", each.turned_deg.get(name) or "") for name in each.images)
            lines += [csv_line([name, file, str(turned)]) for name, file, turned in cells]
        write_atomically(out / "images.csv", "\n".join([*lines, ""]))
    write_atomically(out / "project.toml", _project_text(out, pictures, options, has_lines))
    return read_project(out / "project.toml")


def _project_text(out: Path, pictures: BoardPictureFiles, options: CalibrationOptions, has_lines: bool) -> str:
    files = (pictures.files[name] for camera in pictures.cameras for name in camera.images)
    scans = ", ".join(quoted(os.path.relpath(path, out)) for path in files)
    unknown = "" if options.pitch_um else "# The pixel size is not given: of all in mm only ratios count.\n"
    images = 'images = "images.csv"\n' if has_lines else ""
    return f"""# Written by `reseau calibrate`; `reseau run` goes on with it.
camera = "{pictures.cameras[0].name}.toml"
scans = [{scans}]
{unknown}pitch_um = {1000.0 * options.pixel_mm!r}

{options.board.table}
[object]
unit = "mm"
{images}
[adjust]
transformation = "none"
unmodelled = "estimate"
"""


def _camera_text(camera: CameraPictures, options: CalibrationOptions, lens: LensModel) -> str:
    distortion = free_lens(lens, options.square_pixels)
    free = "".join(f'{name} = "free"\n' for name in distortion.parameters)
    width_mm, height_mm = (size * options.pixel_mm for size in (camera.width_px, camera.height_px))
    return f"""name = {quoted(camera.name)}
frame_mm = [{width_mm!r}, {height_mm!r}]
principal_distance_mm = {width_mm!r}

[sigma]
principal_distance_mm = "free"
principal_point_mm = "free"

[distortion]
family = "{distortion.family}"
[distortion.sigma]
{free}"""
