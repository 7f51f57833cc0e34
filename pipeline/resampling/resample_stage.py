"""`reseau resample`: every scan of a project in its camera's frame, as files that say where their pixels lie."""

import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from measure.errors import MeasurementError
from measure.scans.addresses import scan_path
from measure.scans.scan import open_scan
from pipeline.archive.file_state import file_state
from pipeline.archive.measurement import read_measurement
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.resampling.canvas import canvas_of, scan_places
from pipeline.resampling.frame_chain import FrameChain, adjusted_chain, measured_chain
from pipeline.resampling.frame_file import TILE_PX, Description, read_description, write_frame
from pipeline.resampling.interpolation import MARGIN_PX, Degree, Tile, interpolated
from pipeline.resampling.source import source_of
from pipeline.results.adjustment_reader import read_adjustment
from pipeline.results.measured_scan import MeasuredScan
from pipeline.text.atomic import check_writable
from pipeline.workers import worker_pool

BEST: Degree = 5
FAST: Degree = 3


@dataclass(frozen=True)
class ResampleTask:
    """All that the resampling of one scan depends on. pitch_mm: of the result; max_pixels: as `open_scan` takes it."""

    image: str
    camera: str
    scan: Path
    chain: FrameChain
    pose: str
    pitch_mm: float
    degree: Degree
    max_pixels: int | None
    target: Path

    @property
    def fingerprint(self) -> str:
        """Of the scan's file and everything that the result depends on: what has it need not be made again."""
        chain = self.chain
        numbers = [*chain.film.parameters, *chain.bend_parameters, *chain.pitch_um, self.pitch_mm, float(self.degree)]
        words: list[Any] = [self.image, self.camera, self.pose, chain.film.transformation, chain.film.mirrored]
        words += [chain.bend.terms, chain.bend.center_mm, chain.bend.half_mm]
        if chain.lens is not None:
            numbers += [*chain.lens.interior, *chain.lens.parameters]
            words += [chain.lens.distortion.family, chain.lens.distortion.decentering, chain.lens.distortion.r0_mm]
        file = file_state(self.scan, Path())
        words += [file.bytes, file.mtime_ns, file.etag, [float(number).hex() for number in numbers]]
        return hashlib.sha256(json.dumps(words).encode()).hexdigest()


@dataclass(frozen=True)
class Resampled:
    """What became of one scan. clamped: samples that had to be brought back to what can be stored; problem: why there
    is no frame, empty where there is one; kept: it was there already."""

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
    """Resample every scan of the project that was measured, in the order of the names; one that fails is a result.

    pitch_um: of the result; None: that of each scan, the mean of both directions. A frame in the folder that was made
    of the same scan in the same way is kept. Raises InputError where nothing was measured, or for a lens that nobody
    has adjusted.
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
    """What is to be done, and what cannot be."""
    adjustment = read_adjustment(project.adjustment_path) if project.adjustment_path.exists() else None
    if with_lens and (adjustment is None or not adjustment["converged"]):
        raise InputError("--lens needs an adjusted lens. Run `reseau adjust` first, or resample without it.")
    tasks, failed = [], []
    for measured in read_measurement(project.measurement_path):
        image = measured.frame.image
        chain = _chain(measured, adjustment, with_lens)
        if isinstance(chain, str):
            failed.append(Resampled(image, None, problem=chain))
            continue
        pitch_mm = (pitch_um or float(np.sqrt(np.prod(measured.pitch_um)))) / 1000.0
        tasks.append(
            ResampleTask(
                image=image,
                camera=project.camera_of(image).name,
                scan=scan_path(measured.scan),
                chain=chain,
                pose=measured.frame.pose.name if measured.frame.pose else "0",
                pitch_mm=pitch_mm,
                degree=degree,
                max_pixels=project.max_pixels,
                target=folder / f"{image}.tif",
            )
        )
    return tasks, failed


def _chain(measured: MeasuredScan, adjustment: dict[str, Any] | None, with_lens: bool) -> FrameChain | str:
    """The adjusted chain of an image, or that of its fiducials; else why there is none."""
    if adjustment is not None and adjustment["converged"] and measured.frame.image in adjustment["images"]:
        return adjusted_chain(measured, adjustment, with_lens)
    if with_lens:
        return "it has no part in the adjustment, so its lens is not known: resample it without --lens"
    return measured_chain(measured) or "too few of its fiducial marks were found to say where its frame lies"


def resampled(task: ResampleTask) -> Resampled:
    """One scan resampled into its file, or why not."""
    try:
        return _resampled(task)
    except (MeasurementError, InputError, OSError) as error:
        return Resampled(task.image, None, problem=str(error))


def _resampled(task: ResampleTask) -> Resampled:
    before = read_description(task.target)
    with open_scan(task.scan, task.max_pixels) as scan:
        canvas = canvas_of(task.chain, scan.width_px, scan.height_px, task.pitch_mm)
        done = Resampled(task.image, task.target, canvas.width_px, canvas.height_px)
        fingerprint = task.fingerprint
        if before is not None and before.get("fingerprint") == fingerprint:
            return replace(done, kept=True)
        task.target.parent.mkdir(parents=True, exist_ok=True)
        with source_of(scan, _rows_at_a_time(task, canvas.width_px), task.target.parent) as source:

            def tile_at(col0: int, row0: int) -> Tile:
                places = scan_places(task.chain, canvas, col0, row0, TILE_PX)
                return interpolated(source, *places, task.degree)

            described = Description(
                task.image, task.camera, canvas, task.pose, task.chain.lens is not None, fingerprint
            )
            clamped = write_frame(task.target, described, source.channels, source.dtype, tile_at)
    return replace(done, clamped=clamped)


def _rows_at_a_time(task: ResampleTask, width_px: int) -> int:
    """How many rows of the scan a row of tiles runs through."""
    ends = np.array([(0.0, 0.0), (width_px, 0.0), (0.0, -TILE_PX), (width_px, -TILE_PX)]) * task.pitch_mm
    pixels, _ = task.chain.scan_from_frame(ends)
    return int(np.ptp(pixels[:, 1])) + 2 * MARGIN_PX


def resampled_json(results: Sequence[Resampled]) -> list[dict[str, Any]]:
    """The results for a script."""
    return [asdict(result) | {"path": result.path and str(result.path)} for result in results]
