"""Pictures of a board to a calibrated camera: a project is written, measured, adjusted and checked."""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from adjust.problem.network import Network
from adjust.solution.adjustment import adjust
from adjust.solution.unmodelled_error import adjust_unmodelled
from pipeline.adjusting.adjust_stage import adjust_marks, adjustment_options
from pipeline.adjusting.network import build_network
from pipeline.calibration.board_options import BoardOptions
from pipeline.calibration.intrinsics import CameraIntrinsics, camera_intrinsics, print_intrinsics, write_camera_files
from pipeline.calibration.lens_choice import PARAMETERS, LensChoice, LensModel, choose_lens
from pipeline.calibration.pictures import BoardPictureFiles, CameraPictures, find_pictures
from pipeline.errors import InputError
from pipeline.files.project_file import Project, read_project
from pipeline.progress import Reporter
from pipeline.results.check_file import read_check
from pipeline.results.comparator_file import ComparatorPoint, read_comparator
from pipeline.stages import run_all, run_measure
from pipeline.summary import Summary
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import csv_line
from pipeline.text.wording import counted, listed
from pipeline.workers import WorkOptions

ASSUMED_PITCH_UM = 5.0  # where nobody says it: results are in pixels, and it cancels
GENEROUS = 2.0  # of the unmodelled standard deviation, for lens models that are poorer than the first
FEWEST_POINTS = 4  # of a picture whose space resection is over-determined


@dataclass(frozen=True)
class CalibrationOptions:
    """pitch_um: of a pixel, None where it is not known."""

    board: BoardOptions
    lens: LensModel | Literal["auto"] = "auto"
    square_pixels: bool = False
    pitch_um: float | None = None
    ros: bool = False


@dataclass(frozen=True)
class Calibration:
    """unreadable: by picture, why. not_calibrated: by camera, why each of its pictures is left out."""

    cameras: tuple[CameraIntrinsics, ...]
    unreadable: Mapping[str, str]
    not_calibrated: Mapping[str, Mapping[str, str]]
    files: tuple[Path, ...]
    summary: Summary

    @property
    def needs_look(self) -> bool:
        """Whether pictures were left out, or the standard deviations of OpenCV's check do not agree."""
        return bool(self.unreadable or self.not_calibrated) or any(
            camera.left_out or (camera.check is not None and camera.check.verdict == "differs")
            for camera in self.cameras
        )

    def print(self, console: Console) -> None:
        """The cameras first, then the files and what can be done next."""
        for calibrated in self.cameras:
            print_intrinsics(calibrated, console)
        for name, reason in self.unreadable.items():
            console.print(f"{name} cannot be read: {reason}", markup=False, highlight=False, soft_wrap=True)
        for camera, reasons in self.not_calibrated.items():
            why = f"{camera} is not calibrated: {listed([f'{name} ({reason})' for name, reason in reasons.items()])}."
            console.print(why, markup=False, highlight=False, soft_wrap=True)
        project = self.files[-1]
        for line in (
            *map(str, self.files),
            f"Next: open {self.files[-2]}",
            f"Next: reseau export {project} opencv DIR, or colmap, micmac, metashape, asp",
        ):
            console.print(line, markup=False, highlight=False, soft_wrap=True)

    def as_json(self) -> dict[str, Any]:
        return {
            "cameras": [camera.as_json() for camera in self.cameras],
            "unreadable": dict(self.unreadable),
            "not_calibrated": dict(self.not_calibrated),
        }


def calibrate(
    given: Sequence[Path], out: Path, options: CalibrationOptions, reporter: Reporter, workers: int | None = None
) -> Calibration:
    """Calibrate the cameras that took some pictures of a board; what is written stands in `out`.

    Raises InputError where there is no picture, or where too few show the board.
    """
    pictures = find_pictures(given, out)
    lenses = {camera.name: "opencv4" if options.lens == "auto" else options.lens for camera in pictures.cameras}
    project = _write_project(out, pictures, options, lenses)
    work = WorkOptions(workers=workers)
    run_measure(project, reporter, work)
    marks = read_comparator(project.comparator)
    used, left_out = _usable(pictures, marks)
    choices = dict[str, LensChoice]()
    if options.lens == "auto":
        with reporter.stage("choosing the lens") as count:
            for done, camera in enumerate(used):
                count(camera.name, done, len(used))
                choices[camera.name] = _choice(project, marks, camera, options)
        lenses |= {name: choice.model for name, choice in choices.items()}
    cameras = tuple(replace(camera, images=tuple(set(camera.images) - set(left_out))) for camera in used)
    project = _write_project(out, pictures, options, lenses)
    summary = run_all(project, reporter, work)
    adjustment = adjust_marks(project, marks)
    if not adjustment.converged:
        raise InputError(
            f"{out}: the calibration has no solution ({adjustment.termination}). {' '.join(adjustment.warnings[:1])} "
            "Take pictures with the board tilted by 20 degrees and more in different directions, all over the picture."
        )
    checks = read_check(project.check_path).cameras if project.check_path.exists() else {}
    pixel_mm = _pitch_um(options) / 1000.0
    reasons = {**left_out, **adjustment.left_out}
    found = [
        camera_intrinsics(
            adjustment,
            camera,
            pixel_mm,
            {name: why for name, why in reasons.items() if name in by_name(pictures, camera.name).images},
            choices.get(camera.name),
            checks.get(camera.name),
            options.pitch_um,
        )
        for camera in cameras
    ]
    files = dict(write_camera_files(found, out, options.ros))
    for path, text in files.items():
        write_atomically(path, text)
    calibrated = {camera.name for camera in cameras}
    others = {
        camera.name: {name: left_out[name] for name in camera.images}
        for camera in pictures.cameras
        if camera.name not in calibrated
    }
    return Calibration(tuple(found), pictures.unreadable, others, (*files, project.report_path, project.path), summary)


def by_name(pictures: BoardPictureFiles, name: str) -> CameraPictures:
    return next(camera for camera in pictures.cameras if camera.name == name)


def _pitch_um(options: CalibrationOptions) -> float:
    return options.pitch_um or ASSUMED_PITCH_UM


def _usable(
    pictures: BoardPictureFiles, marks: Sequence[ComparatorPoint]
) -> tuple[tuple[CameraPictures, ...], dict[str, str]]:
    """The cameras with pictures that show the board, and why pictures are left out."""
    points = dict.fromkeys((name for camera in pictures.cameras for name in camera.images), 0)
    reasons = dict.fromkeys(points, "the board was not found")
    for mark in marks:
        points[mark.image] += mark.status.is_observation
        if not mark.status.is_observation and mark.reason:
            reasons[mark.image] = str(mark.reason)
    left_out = {
        name: reasons[name] if count == 0 else f"only {counted(count, 'corner')} found"
        for name, count in points.items()
        if count < FEWEST_POINTS
    }
    used = tuple(camera for camera in pictures.cameras if set(camera.images) - set(left_out))
    if not used:
        raise InputError(
            f"the board was found in none of {counted(len(points), 'picture')}; of most: "
            f"{Counter(reasons.values()).most_common(1)[0][0]}. Check --board (inner corners of a chessboard, not "
            "squares), --kind, and that the whole board is in the picture."
        )
    return used, left_out


def _choice(
    project: Project, marks: Sequence[ComparatorPoint], camera: CameraPictures, options: CalibrationOptions
) -> LensChoice:
    own = [mark for mark in marks if mark.image in camera.images]
    network, _ = build_network(project, own)
    adjusted = partial(adjust, options=adjustment_options(project))
    unmodelled_mm = adjust_unmodelled(network, adjusted).unmodelled_mm[camera.name]
    return choose_lens(_alike(network, unmodelled_mm), camera.name, options.square_pixels, adjusted)


def _alike(network: Network, unmodelled_mm: float) -> Network:
    """The network with one standard deviation for all marks, generous enough for a model that lacks something."""
    observations = network.observations
    variance = float(np.median(np.trace(observations.covariance_mm2, axis1=1, axis2=2)) / 2.0)
    variance += (GENEROUS * unmodelled_mm) ** 2
    covariance = np.broadcast_to(variance * np.eye(2), observations.covariance_mm2.shape).copy()
    return replace(network, observations=replace(observations, covariance_mm2=covariance))


def _write_project(
    out: Path, pictures: BoardPictureFiles, options: CalibrationOptions, lenses: Mapping[str, LensModel]
) -> Project:
    """project.toml, a camera file for each camera, and images.csv where there are several."""
    out.mkdir(parents=True, exist_ok=True)
    pixel_mm = _pitch_um(options) / 1000.0
    for camera in pictures.cameras:
        write_atomically(out / f"{camera.name}.toml", _camera_text(camera, pixel_mm, lenses[camera.name], options))
    names = [name for camera in pictures.cameras for name in camera.images]
    scans = ", ".join(_quoted(os.path.relpath(pictures.files[name], out)) for name in names)
    several = len(pictures.cameras) > 1
    text = (
        "# Written by `reseau calibrate`; `reseau run` goes on with it.\n"
        + f'camera = "{pictures.cameras[0].name}.toml"\n'
        + f"scans = [{scans}]\n"
        + ("" if options.pitch_um else "# Nobody said how large a pixel is: of all in mm only ratios count.\n")
        + f"pitch_um = {_pitch_um(options)!r}\n\n"
        + options.board.table
        + ('\n[object]\nunit = "mm"\nimages = "images.csv"\n' if several else '\n[object]\nunit = "mm"\n')
        + '\n[adjust]\ntransformation = "none"\nunmodelled = "estimate"\n'
    )
    if several:
        lines = ["image,camera"]
        lines += [csv_line([name, f"{each.name}.toml"]) for each in pictures.cameras for name in each.images]
        write_atomically(out / "images.csv", "\n".join([*lines, ""]))
    write_atomically(out / "project.toml", text)
    return read_project(out / "project.toml")


def _camera_text(camera: CameraPictures, pixel_mm: float, lens: LensModel, options: CalibrationOptions) -> str:
    free = PARAMETERS[lens] if options.square_pixels else (*PARAMETERS[lens], "b1")
    family = "opencv_fisheye" if lens == "fisheye" else "opencv"
    return (
        f"name = {_quoted(camera.name)}\n"
        f"frame_mm = [{camera.width_px * pixel_mm!r}, {camera.height_px * pixel_mm!r}]\n"
        f"principal_distance_mm = {camera.width_px * pixel_mm!r}\n\n"
        '[sigma]\nprincipal_distance_mm = "free"\nprincipal_point_mm = "free"\n\n'
        f'[distortion]\nfamily = "{family}"\n[distortion.sigma]\n' + "".join(f'{name} = "free"\n' for name in free)
    )


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
