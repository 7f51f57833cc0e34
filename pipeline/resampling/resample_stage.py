"""`reseau resample`: all measured scans, and the TIFF file of a frame, written tile by tile."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tifffile import TiffFile, TiffFileError, TiffWriter

from adjust.functional_model.lens import Lens
from measure.errors import MeasurementError
from measure.scans.opening import open_scan
from measure.scans.remote import scan_path
from pipeline.archive.checked_results import read_measurement
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.provenance import file_state, fingerprint
from pipeline.resampling.canvas import Canvas, FrameChain, image_chain, measured_chain, middle_mm, outline_canvas
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
from pipeline.text.files import atomic_path, check_writable, path_below
from pipeline.types import Mask, Samples
from pipeline.workers import worker_pool

TILE_PX = 512
_REDUCTION = 4  # factor between a page and the next smaller one
_SMALLEST_PX = 512
_LARGEST_REDUCED_BYTES = 32 << 20  # largest size of the first reduced page, which is held in memory
_CLASSIC_BYTES = 3_900_000_000  # above it BigTIFF is written: classic TIFF has 32-bit offsets
_REDUCED, _MASK = 1, 4  # TIFF 6.0, NewSubfileType
BEST: Degree = 5  # of the spline
FAST: Degree = 3


def read_description(path: Path) -> dict[str, Any] | None:
    """Read the description of a resampled frame; None for any other or missing file."""
    try:
        with TiffFile(path) as file:
            content = json.loads(file.pages.first.description)
    except (OSError, ValueError, TiffFileError, IndexError):
        return None
    return content if isinstance(content, dict) and {"reseau", "x_mm", "y_mm", "pitch_mm"} <= content.keys() else None


def write_frame(
    path: Path,
    canvas: Canvas,
    description: Mapping[str, object],
    channels: int,
    dtype: type,
    make_tile: Callable[[int, int], Tile],
) -> int:
    """Write the frame, tile by tile.

    Memory holds one tile, the first reduced page, and the masks of tiles at the scan's edge.

    Parameters
    ----------
    description : stored in the file as JSON, with the canvas: x_mm, y_mm are of the centre of the first pixel.
    make_tile : returns the tile at (col0, row0).

    Returns
    -------
    The number of clamped samples.

    Raises
    ------
    InputError : the file cannot be written.
    """
    reduced = _Reduced(canvas, channels, dtype)
    masks: dict[tuple[int, int], NDArray[np.uint8] | bool] = {}  # most tiles are entirely inside or outside
    clamped = 0

    def tiles() -> Iterator[Samples]:
        nonlocal clamped
        for row0 in range(0, canvas.height_px, TILE_PX):
            for col0 in range(0, canvas.width_px, TILE_PX):
                tile = make_tile(col0, row0)
                clamped += tile.clamped
                reduced.take(tile.samples, col0, row0)
                inside = bool(tile.is_inside.flat[0])
                is_even = bool((tile.is_inside == inside).all())
                masks[row0, col0] = inside if is_even else np.packbits(tile.is_inside, axis=1)
                yield tile.samples if channels > 1 else tile.samples[..., 0]

    def masked() -> Iterator[Mask]:
        for (row0, col0), mask in masks.items():  # in the order of the tiles
            tile = np.unpackbits(mask, axis=1) if isinstance(mask, np.ndarray) else np.full((TILE_PX,) * 2, mask)
            part = tile[: canvas.height_px - row0, : canvas.width_px - col0].astype(bool)
            yield np.pad(part, ((0, TILE_PX - part.shape[0]), (0, TILE_PX - part.shape[1])))

    pages = reduced.count
    size = canvas.width_px * canvas.height_px * channels * np.dtype(dtype).itemsize
    shape = (canvas.height_px, canvas.width_px, *([channels] if channels > 1 else []))
    per_cm = 10.0 / canvas.pitch_mm
    place = {"x_mm": canvas.x_mm, "y_mm": canvas.y_mm, "pitch_mm": canvas.pitch_mm}
    options: dict[str, Any] = {"compression": "zlib", "photometric": "rgb" if channels > 1 else "minisblack"}
    options |= {"tile": (TILE_PX, TILE_PX), "metadata": None, "resolutionunit": "CENTIMETER"}
    with atomic_path(path) as temporary, TiffWriter(temporary, bigtiff=size > _CLASSIC_BYTES) as file:
        file.write(
            tiles(),
            shape=shape,
            dtype=dtype,
            predictor=True,
            subifds=pages,
            resolution=(per_cm, per_cm),
            description=json.dumps({"reseau": version("reseau"), **place, **description}),
            **options,
        )
        for factor, page in reduced.pages():
            scale = (per_cm / factor, per_cm / factor)
            file.write(page, predictor=True, subfiletype=_REDUCED, resolution=scale, **options)
        options["photometric"] = "minisblack"
        file.write(masked(), shape=shape[:2], dtype=bool, subfiletype=_MASK, resolution=(per_cm, per_cm), **options)
    return clamped


class _Reduced:
    """Reduced pages by area averaging: the first one from the tiles, each other one from the page before it."""

    def __init__(self, canvas: Canvas, channels: int, dtype: type) -> None:
        self.factor = _REDUCTION
        pixel_bytes = channels * np.dtype(dtype).itemsize
        while canvas.width_px * canvas.height_px * pixel_bytes / self.factor**2 > _LARGEST_REDUCED_BYTES:
            self.factor *= 2
        shape = (-(-canvas.height_px // self.factor), -(-canvas.width_px // self.factor), channels)
        self.first: Samples = np.zeros(shape, dtype)
        larger = max(canvas.width_px, canvas.height_px)
        self.count = 0
        while larger / (self.factor * _REDUCTION**self.count) >= _SMALLEST_PX or self.count == 0:
            self.count += 1

    def take(self, samples: Samples, col0: int, row0: int) -> None:
        small = _averaged(samples, self.factor)
        part = self.first[row0 // self.factor :, col0 // self.factor :][: small.shape[0], : small.shape[1]]
        part[:] = small[: part.shape[0], : part.shape[1]]

    def pages(self) -> Iterator[tuple[int, Samples]]:
        page: Samples = self.first
        for level in range(self.count):
            yield self.factor * _REDUCTION**level, page if page.shape[2] > 1 else page[..., 0]
            page = _averaged(page, _REDUCTION)


def _averaged(samples: Samples, factor: int) -> Samples:
    height, width = (-(-side // factor) * factor for side in samples.shape[:2])
    whole = np.pad(samples, ((0, height - samples.shape[0]), (0, width - samples.shape[1]), (0, 0)), mode="edge")
    means = whole.reshape(height // factor, factor, width // factor, factor, -1).mean(axis=(1, 3))
    return np.asarray(np.rint(means).astype(samples.dtype))


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
        states = [file_state(each.scan, Path())[1:] for each in self.scans]
        frame = [self.image, self.camera, self.pose, self.pitch_mm, self.degree]
        return fingerprint([*frame, [each.chain for each in self.scans], states])


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
    image = measured.frame.image
    if adjustment is not None and adjustment.converged and image in adjustment.images:
        return image_chain(image, adjustment, measured.pitch_um, middle_mm(measured), with_lens)
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
        if before is not None and before.get("fingerprint") == task.fingerprint:
            return replace(done, kept=True)
        task.target.parent.mkdir(parents=True, exist_ok=True)
        parts = []
        for scan, chain in scans:
            rows = _rows_at_a_time(chain, task.pitch_mm, canvas.width_px)
            parts.append(Part(opened.enter_context(open_source(scan, rows, task.target.parent)), chain))
        parts = find_inner_edges(parts)
        described: dict[str, object] = {"image": task.image, "camera": task.camera, "pose": task.pose}
        described |= {"lens": task.scans[0].chain.lens is not None, "fingerprint": task.fingerprint}
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
