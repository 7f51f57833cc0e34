"""`reseau resample`: resample every scan of a project into its camera's frame, as files that hold the position of their
pixels."""

import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adjust.functional_model.lens import Lens
from measure.errors import MeasurementError
from measure.scans.opening import open_scan
from measure.scans.remote import scan_path
from pipeline.archive.measurement import read_measurement
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.provenance import file_state
from pipeline.resampling.canvas import FrameChain, adjusted_chain, measured_chain, outline_canvas
from pipeline.resampling.frame_file import TILE_PX, read_description, write_frame
from pipeline.resampling.interpolation import (
    MARGIN_PX,
    Degree,
    Part,
    Tile,
    find_inner_edges,
    joined_tile,
    open_source,
    seams_mm,
)
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.files import check_writable, path_below
from pipeline.workers import worker_pool

BEST: Degree = 5
FAST: Degree = 3


@dataclass(frozen=True)
class FrameScan:
    """Scan of a frame, whole or a part of it, by the name of its image."""

    image: str
    scan: Path
    chain: FrameChain


@dataclass(frozen=True)
class ResampleTask:
    """All that the resampling of one frame depends on.

    Attributes
    ----------
    scans : one, named as the frame, or several partial ones.
    """

    image: str
    camera: str
    pose: str
    pitch_mm: float
    degree: Degree
    max_pixels: int | None
    target: Path
    scans: tuple[FrameScan, ...]

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the scans' files and everything else that the result depends on; a frame with an equal one is
        up to date."""
        first, *others = (self._scan_fingerprint(each.scan, each.chain) for each in self.scans)
        return hashlib.sha256("".join([first, *others]).encode()).hexdigest() if others else first

    def _scan_fingerprint(self, scan: Path, chain: FrameChain) -> str:
        numbers = [*chain.film.parameters, *chain.bend_parameters, *chain.pitch_um, self.pitch_mm, float(self.degree)]
        words: list[Any] = [self.image, self.camera, self.pose, chain.film.transformation, chain.film.mirrored]
        words += [chain.bend.terms, chain.bend.center_mm, chain.bend.half_mm]
        for lens in (chain.lens, chain.bend.lens):
            if lens is not None:
                numbers += [*lens.interior, *lens.parameters]
                words += [lens.distortion.family, lens.distortion.decentering, lens.distortion.r0_mm]
        file = file_state(scan, Path())
        words += [file.bytes, file.mtime_ns, file.etag, [float(number).hex() for number in numbers]]
        return hashlib.sha256(json.dumps(words).encode()).hexdigest()


@dataclass(frozen=True)
class Resampled:
    """Result of one scan.

    Attributes
    ----------
    clamped : number of samples clamped to the range of the type.
    kept : whether an existing file was up to date.
    problem : reason why there is no frame; otherwise empty.
    """

    image: str
    path: Path | None
    width_px: int = 0
    height_px: int = 0
    clamped: int = 0
    kept: bool = False
    problem: str = ""


def resample(
    project: Project, folder: Path, pitch_um: float | None, with_lens: bool, fast: bool, reporter: Reporter
) -> tuple[Resampled, ...]:
    """Resample every measured scan of the project, in the order of the names; a failure is a result, too.

    A frame in the folder that was made from the same scan in the same way is kept.

    Parameters
    ----------
    pitch_um : of the result; None: that of each scan, the mean of both directions.

    Raises
    ------
    InputError : nothing was measured, or the lens was not adjusted.
    """
    check_writable(folder)
    tasks, results = resample_tasks(project, folder, pitch_um, with_lens, BEST if not fast else FAST)
    with reporter.stage("resampled") as count, worker_pool(max(len(tasks), 1)) as workers:
        futures = {workers.submit(resampled, task): task for task in tasks}
        for done, future in enumerate(as_completed(futures), 1):
            results.append(future.result())
            count(futures[future].image, done, len(futures))
    return tuple(sorted(results, key=lambda result: result.image))


def resample_tasks(
    project: Project, folder: Path, pitch_um: float | None, with_lens: bool, degree: Degree
) -> tuple[list[ResampleTask], list[Resampled]]:
    """Tasks of a project, and the failures of scans that cannot be resampled."""
    adjustment = read_adjustment(project.adjustment_path) if project.adjustment_path.exists() else None
    if with_lens and (adjustment is None or not adjustment.converged):
        raise InputError("--lens needs an adjusted lens. Run `reseau adjust` first, or resample without it.")
    tasks: dict[str, ResampleTask] = {}
    failed = []
    for measured in read_measurement(project.measurement_path):
        image = measured.frame.image
        frame = project.image_frame(image)
        taking_lens = None if project.lens is None else project.lens.lens
        chain = _chain(measured, adjustment, with_lens, frame != image, taking_lens)
        if isinstance(chain, str):
            failed.append(Resampled(image, None, problem=chain))
            continue
        scan = FrameScan(image, scan_path(measured.scan), chain)
        if frame in tasks:
            tasks[frame] = replace(tasks[frame], scans=(*tasks[frame].scans, scan))
            continue
        pitch_mm = (pitch_um or float(np.sqrt(np.prod(measured.pitch_um)))) / 1000.0
        tasks[frame] = ResampleTask(
            image=frame,
            camera=project.image_camera(image).name,
            pose=measured.frame.pose.name if measured.frame.pose else "0",
            pitch_mm=pitch_mm,
            degree=degree,
            max_pixels=project.max_pixels,
            target=path_below(folder, frame, ".tif"),
            scans=(scan,),
        )
    return list(tasks.values()), failed


def _chain(
    measured: MeasuredScan,
    adjustment: AdjustmentRecord | None,
    with_lens: bool,
    is_part: bool,
    taking_lens: Lens | None = None,
) -> FrameChain | str:
    """Adjusted chain of an image, or the chain from its fiducials, or the reason why there is none."""
    if adjustment is not None and adjustment.converged and measured.frame.image in adjustment.images:
        return adjusted_chain(measured, adjustment, with_lens)
    if with_lens:
        return "it has no part in the adjustment, so its lens is not known: resample it without --lens"
    if is_part:
        return (
            "it is a part of a frame, and no adjustment says how it lies to the other scans: run `reseau adjust`, and "
            "see what it says of this one"
        )
    why_not = "too few of its fiducial marks were found to say where its frame lies"
    return measured_chain(measured, taking_lens) or why_not


def resampled(task: ResampleTask) -> Resampled:
    """Resample one scan into its file; a failure is a result, too."""
    try:
        return _resampled(task)
    except (MeasurementError, InputError, OSError) as error:
        return Resampled(task.image, None, problem=str(error))


def _resampled(task: ResampleTask) -> Resampled:
    before = read_description(task.target)
    with ExitStack() as opened:
        scans = [(opened.enter_context(open_scan(each.scan, task.max_pixels)), each.chain) for each in task.scans]
        canvas = outline_canvas([(chain, scan.part_px) for scan, chain in scans], task.pitch_mm)
        done = Resampled(task.image, task.target, canvas.width_px, canvas.height_px)
        fingerprint = task.fingerprint
        if before is not None and before.get("fingerprint") == fingerprint:
            return replace(done, kept=True)
        task.target.parent.mkdir(parents=True, exist_ok=True)
        parts = []
        for scan, chain in scans:
            rows = _rows_at_a_time(chain, task.pitch_mm, canvas.width_px)
            parts.append(Part(opened.enter_context(open_source(scan, rows, task.target.parent)), chain))
        parts = find_inner_edges(parts)
        described: dict[str, object] = {"image": task.image, "camera": task.camera, "pose": task.pose}
        described |= {"lens": task.scans[0].chain.lens is not None, "fingerprint": fingerprint}
        if names := [each.image for each in task.scans if each.image != task.image]:
            described |= {"parts": names, "seams_mm": seams_mm(parts, canvas)}

        def make_tile(col0: int, row0: int) -> Tile:
            return joined_tile(parts, canvas, col0, row0, TILE_PX, task.degree)

        source = parts[0].source
        clamped = write_frame(task.target, canvas, described, source.channels, source.dtype, make_tile)
    return replace(done, clamped=clamped)


def _rows_at_a_time(chain: FrameChain, pitch_mm: float, width_px: int) -> int:
    """Number of rows of a scan that a row of tiles covers."""
    ends = np.array([(0.0, 0.0), (width_px, 0.0), (0.0, -TILE_PX), (width_px, -TILE_PX)]) * pitch_mm
    pixels, _ = chain.scan_from_frame(ends)
    return int(np.ptp(pixels[:, 1])) + 2 * MARGIN_PX


def resampled_json(results: Sequence[Resampled]) -> list[dict[str, object]]:
    """The results for `--json`."""
    return [asdict(result) | {"path": result.path and str(result.path)} for result in results]
