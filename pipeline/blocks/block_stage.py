"""`reseau block`: orient and calibrate a block from a folder of overlapping frames without known orientation.

Scans are resampled into the fiducial system of their camera. COLMAP extracts and matches features and estimates poses
with the given camera. Its poses serve as initial values, its tracks as observations in the scans. One adjustment
combines them with film deformations, fiducials, lens and control.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adjust.functional_model.rotation import angles_from_rotation
from adjust.problem.network import Exterior
from pipeline.blocks.mapping import given_interior, mapped, quiet_colmap
from pipeline.blocks.pictures import write_pictures
from pipeline.blocks.ties import oriented_by_control, tie_marks
from pipeline.errors import InputError
from pipeline.files.images_file import ELEMENTS, GivenImages
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.resampling.resample_stage import FAST, Resampled, resample, resample_tasks
from pipeline.results.comparator_file import ComparatorPoint, points_text, read_comparator, read_pitches
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import csv_line
from pipeline.text.wording import counted
from pipeline.types import Array

MOST_PX = 3000  # pixels along the longer side of a frame, unless the user gives a pitch


@dataclass(frozen=True)
class OrientedBlock:
    """Result of the orientation of a block.

    Attributes
    ----------
    project : project with the block's own comparator.csv, images.csv and output.
    oriented : number of images that COLMAP oriented.
    seconds : duration of each step.
    left_out : images that COLMAP did not orient.
    ties, tracks : number of tie marks and of tie points.
    """

    project: Project
    oriented: int
    seconds: dict[str, float]
    left_out: tuple[str, ...]
    ties: int
    tracks: int


def run_block(project: Project, folder: Path, pitch_um: float | None, reporter: Reporter) -> OrientedBlock:
    """Orient a block by COLMAP; its adjustment is then run as for any project.

    pitch_um: of the resampled frames; None: chosen. Raises InputError where COLMAP is not installed, fiducials are not
    measured, COLMAP orients nothing, or control is missing.
    """
    quiet_colmap()  # fails before the resampling, which takes far longer
    if not project.comparator.exists():
        raise InputError(f"{project.comparator}: there is no such file. Run `reseau measure` first: films come by it.")
    marks = read_comparator(project.comparator, project.list_pitch_um)
    pitch_um = pitch_um or coarse_pitch_um(project)
    clock = _Clock()
    with clock.step("resampling"):
        frames = folder / "frames"
        results = resample(project, frames, pitch_um, False, True, reporter)
        made = {result.image for result in results if not result.problem}
        tasks = [task for task in resample_tasks(project, frames, pitch_um, False, FAST)[0] if task.image in made]
    if len(tasks) < 2:
        raise InputError(f"a block needs two frames, and {len(tasks)} could be resampled. {_problems(results)}")
    cameras = {camera.name: camera for camera in project.cameras.values()}
    with clock.step("pictures"):
        pictures = write_pictures(tasks, cameras, folder)
    with clock.step("features, matches and mapping"):
        found = mapped(pictures, cameras, folder)
    with clock.step("tracks and poses back"):
        ties = tie_marks(found, pictures)
        interior = {picture.image: given_interior(cameras[picture.camera]) for picture in pictures}
        poses = oriented_by_control(found, pictures, marks, project.object_points, interior)
        own = written_block(project, folder, (*marks, *ties), poses)
    left_out = tuple(sorted({project.scanned_frame(mark.image) or mark.image for mark in marks} - set(poses)))
    return OrientedBlock(own, len(found.poses), clock.seconds, left_out, len(ties), len({tie.point for tie in ties}))


def coarse_pitch_um(project: Project) -> float | None:
    """Pixel pitch that reduces the frames to MOST_PX, so that feature extraction takes minutes; None where the scans
    are already that coarse."""
    pitches = read_pitches(project.comparator)
    sides = [max(camera.frame_mm) for camera in project.cameras.values() if camera.frame_mm is not None]
    enough = 1000.0 * max(sides, default=0.0) / MOST_PX
    finest = min((min(pitch) for pitch in pitches.values()), default=0.0)
    return enough if enough > finest else None


def block_lines(block: OrientedBlock) -> list[str]:
    """Lines for the user about a block."""
    lines = [
        f"COLMAP oriented {counted(block.oriented, 'image')}; {counted(block.ties, 'tie mark')} of "
        f"{counted(block.tracks, 'point')} are observations now."
    ]
    lines += [f"not oriented: {', '.join(block.left_out)}"] if block.left_out else []
    return [*lines, *(f"{step}: {seconds:.0f} s" for step, seconds in block.seconds.items())]


def written_block(
    project: Project,
    folder: Path,
    marks: Sequence[ComparatorPoint],
    poses: dict[str, tuple[Array, Array]],
) -> Project:
    """Write comparator.csv and images.csv of a block, and return the project that uses them."""
    pitches, given = read_pitches(project.comparator), project.given_images or GivenImages({}, {})
    frames = {mark.image: project.scanned_frame(mark.image) or mark.image for mark in marks}
    kept = [mark for mark in marks if mark.kind != "target" or frames[mark.image] in poses]
    write_atomically(folder / "comparator.csv", points_text(kept, pitches))
    exterior: dict[str, Exterior | None] = {}
    lines = [
        "# orientations by COLMAP, as approximations",
        ",".join(("image", *ELEMENTS, "camera", "scanner", "part_of")),
    ]
    for image, frame in sorted(frames.items()):
        if frame not in poses and not given.part_of.get(image):
            continue
        elements = [""] * len(ELEMENTS)
        if frame in poses:
            rotation, station = poses[frame]
            values = np.concatenate([station, angles_from_rotation(rotation)])
            exterior[image] = Exterior(values)
            elements = [repr(float(value)) for value in [*values[:3], *np.degrees(values[3:])]]
        columns = (given.camera, given.scanner, given.part_of)
        lines.append(csv_line([image, *elements, *(column.get(image, "") for column in columns)]))
    write_atomically(folder / "images.csv", "\n".join(lines) + "\n")
    return replace(
        project,
        scans={},
        comparator=folder / "comparator.csv",
        output=folder / "out",
        given_images=replace(given, exterior=exterior),
        images_path=folder / "images.csv",
    )


def _problems(results: Sequence[Resampled]) -> str:
    return " ".join(f"{result.image}: {result.problem}." for result in results if result.problem)


class _Clock:
    """Duration of each step, s."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.seconds[name] = time.monotonic() - start
