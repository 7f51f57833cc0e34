"""`reseau resample`: all measured scans, and the TIFF file of a frame, written tile by tile.

Tiles are interpolated by splines from windows of a scan, whatever the layout of its file; of a frame in several partial
scans, each pixel from the scan whose inner edges are farthest from it.
"""

import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from math import ceil
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, spline_filter
from skimage.measure import find_contours
from tifffile import TiffFile, TiffFileError, TiffWriter

import compiled
from adjust.functional_model.lens import Lens
from measure.errors import MeasurementError
from measure.scans.opening import open_scan
from measure.scans.remote import scan_path
from measure.scans.scan import Scan
from pipeline.adjusting.picture_turn import picture_turn
from pipeline.archive.checked_results import read_measurement
from pipeline.archive.made_from import changed_scans, current_adjustment
from pipeline.archive.verdicts import Verdict, has_problem, scan_doubt, scan_verdict
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.provenance import file_state, fingerprint
from pipeline.resampling import canvas as frame_canvas
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.comparator_file import read_comparator
from pipeline.results.measured_record import MeasuredScan
from pipeline.terminal import Reporter
from pipeline.text.files import atomic_path, check_writable, path_below
from pipeline.types import Array, Mask, Samples
from pipeline.workers import WorkerKilled, worker_pool

_BAND_PX = 256  # rows decoded at a time into the scratch file
Degree = Literal[3, 5]
MARGIN_PX = 16  # around a tile: there the prefilter of a spline of degree 5, with pole 0.43, has decayed to 1e-6
_TRUNCATED = 3.0  # standard deviations of the smoothing
_COARSER = 1.25  # px of the scan, step from which on it is smoothed
_NODES = 129  # along the longer side of the frame; the seam is straight between them
_SHOWN = 33  # points of a seam in the description
TILE_PX = 512
_REDUCTION = 4  # factor between a page and the next smaller one
_SMALLEST_PX = 512
_LARGEST_REDUCED_BYTES = 32 << 20  # largest size of the first reduced page, which is held in memory
_MOST_LARGER = 100  # pixels of a frame over those of its scans: more hold nothing, and fill a disk
_CLASSIC_BYTES = 3_900_000_000  # above it BigTIFF is written: classic TIFF has 32-bit offsets
_REDUCED, _MASK = 1, 4  # TIFF 6.0, NewSubfileType
BEST: Degree = 5  # of the spline
FAST: Degree = 3


class SampleSource:
    """A scan whose file allows windows (height, width, channels) to be read without decoding the rest. Outside of the
    scan its edge is repeated."""

    is_decoded = False

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.width_px, self.height_px, self.channels = scan.width_px, scan.height_px, scan.channels
        self.dtype = scan.samples_dtype

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples:
        return self.scan.samples(col0, row0, width, height)

    def valid_mask(self, col0: int, row0: int, width: int, height: int) -> Mask:
        """Mask (height, width) of the pixels that are not lost; True outside of the scan."""
        inside = self.scan.inside(col0, row0, width, height, is_read=self.is_decoded)
        cols, rows = np.arange(col0, col0 + width), np.arange(row0, row0 + height)
        in_rows = (rows >= 0) & (rows < self.height_px)
        return np.asarray(inside | ~(in_rows[:, None] & (cols >= 0) & (cols < self.width_px)))


class _Decoded(SampleSource):
    """A scan decoded into an uncompressed file that is read row by row; mapping the file would count as used memory."""

    is_decoded = True

    def __init__(self, scan: Scan, file: int) -> None:
        super().__init__(scan)
        self.file, self.row_bytes = file, scan.width_px * scan.channels * np.dtype(self.dtype).itemsize
        for row in range(0, scan.height_px, _BAND_PX):
            height = min(_BAND_PX, scan.height_px - row)
            os.write(file, scan.samples(0, row, scan.width_px, height).tobytes())

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples:
        rows = np.clip(np.arange(row0, row0 + height), 0, self.height_px - 1)
        left, right = (min(max(col, 0), self.width_px - 1) for col in (col0, col0 + width - 1))
        pixel_bytes = self.row_bytes // self.width_px
        read = {
            row: os.pread(self.file, (right + 1 - left) * pixel_bytes, row * self.row_bytes + left * pixel_bytes)
            for row in np.unique(rows).tolist()
        }
        inside = np.array([np.frombuffer(read[row], self.dtype).reshape(-1, self.channels) for row in rows.tolist()])
        return inside[:, np.clip(np.arange(col0, col0 + width), left, right) - left]


class Tile(NamedTuple):
    """Interpolated tile.

    Attributes
    ----------
    samples : (side, side, channels), with the type of the scan.
    is_inside : (side, side) mask of the pixels within the scan.
    clamped : number of samples that the spline put beyond the range of the type.
    """

    samples: NDArray[np.uint8 | np.uint16]
    is_inside: Mask
    clamped: int


@dataclass(frozen=True, eq=False)
class OpenPart:
    """An open partial scan, with its chain to the frame. inner: which of its edges (left, right, top, bottom) lie in
    another scan; smoothing_px: see `interpolate`."""

    source: SampleSource
    chain: frame_canvas.FrameChain
    smoothing_px: float = 0.0
    inner: tuple[bool, ...] = (False,) * 4


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
    canvas: frame_canvas.Canvas,
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
    frame = _FrameTiles(canvas, channels, dtype, make_tile)
    size = canvas.width_px * canvas.height_px * channels * np.dtype(dtype).itemsize
    with atomic_path(path) as temporary, TiffWriter(temporary, bigtiff=size > _CLASSIC_BYTES) as file:
        _write_pages(file, frame, description)
    return frame.clamped


def _write_pages(file: TiffWriter, frame: "_FrameTiles", description: Mapping[str, object]) -> None:
    """Write the page of a frame, its reduced pages, and the mask of what the scan shows."""
    canvas, is_color = frame.canvas, frame.channels > 1
    shape = (canvas.height_px, canvas.width_px, *([frame.channels] if is_color else []))
    per_cm = 10.0 / canvas.pitch_mm
    place = {"x_mm": canvas.x_mm, "y_mm": canvas.y_mm, "pitch_mm": canvas.pitch_mm}
    options: dict[str, Any] = {"compression": "zlib", "photometric": "rgb" if is_color else "minisblack"}
    options |= {"tile": (TILE_PX, TILE_PX), "metadata": None, "resolutionunit": "CENTIMETER"}
    file.write(
        frame.tiles(),
        shape=shape,
        dtype=frame.dtype,
        predictor=True,
        subifds=frame.pages,
        resolution=(per_cm, per_cm),
        description=json.dumps({"reseau": version("reseau"), **place, **description}),
        **options,
    )
    for factor, page in frame.reduced_pages():
        scale = (per_cm / factor, per_cm / factor)
        file.write(page, predictor=True, subfiletype=_REDUCED, resolution=scale, **options)
    options["photometric"] = "minisblack"
    file.write(frame.masks(), shape=shape[:2], dtype=bool, subfiletype=_MASK, resolution=(per_cm, per_cm), **options)


class _FrameTiles:
    """Tiles of a frame as they are written; afterwards its masks, reduced pages and number of clamped samples."""

    def __init__(
        self, canvas: frame_canvas.Canvas, channels: int, dtype: type, make_tile: Callable[[int, int], Tile]
    ) -> None:
        self.canvas, self.channels, self.dtype, self._make_tile = canvas, channels, dtype, make_tile
        self.clamped = 0
        self._masks: dict[tuple[int, int], NDArray[np.uint8] | bool] = {}  # most tiles are entirely inside or outside
        self._factor = _REDUCTION
        pixel_bytes = channels * np.dtype(dtype).itemsize
        while canvas.width_px * canvas.height_px * pixel_bytes / self._factor**2 > _LARGEST_REDUCED_BYTES:
            self._factor *= 2
        shape = (-(-canvas.height_px // self._factor), -(-canvas.width_px // self._factor), channels)
        self._first: Samples = np.zeros(shape, dtype)  # the first reduced page
        larger = max(canvas.width_px, canvas.height_px)
        self.pages = 1
        while larger / (self._factor * _REDUCTION**self.pages) >= _SMALLEST_PX:
            self.pages += 1

    def tiles(self) -> Iterator[Samples]:
        """Yield the tiles, row by row."""
        for row0 in range(0, self.canvas.height_px, TILE_PX):
            for col0 in range(0, self.canvas.width_px, TILE_PX):
                tile = self._make_tile(col0, row0)
                self.clamped += tile.clamped
                small = _average_area(tile.samples, self._factor)
                part = self._first[row0 // self._factor :, col0 // self._factor :][: small.shape[0], : small.shape[1]]
                part[:] = small[: part.shape[0], : part.shape[1]]
                inside = bool(tile.is_inside.flat[0])
                is_even = bool((tile.is_inside == inside).all())
                self._masks[row0, col0] = inside if is_even else np.packbits(tile.is_inside, axis=1)
                yield tile.samples if self.channels > 1 else tile.samples[..., 0]

    def reduced_pages(self) -> Iterator[tuple[int, Samples]]:
        """Yield factors and reduced pages by area averaging: of the tiles, then each of the page before it."""
        page: Samples = self._first
        for level in range(self.pages):
            yield self._factor * _REDUCTION**level, page if page.shape[2] > 1 else page[..., 0]
            page = _average_area(page, _REDUCTION)

    def masks(self) -> Iterator[Mask]:
        """Yield the masks of the tiles, in their order."""
        for (row0, col0), mask in self._masks.items():
            tile = np.unpackbits(mask, axis=1) if isinstance(mask, np.ndarray) else np.full((TILE_PX,) * 2, mask)
            part = tile[: self.canvas.height_px - row0, : self.canvas.width_px - col0].astype(bool)
            yield np.pad(part, ((0, TILE_PX - part.shape[0]), (0, TILE_PX - part.shape[1])))


def _average_area(samples: Samples, factor: int) -> Samples:
    height, width = (-(-side // factor) * factor for side in samples.shape[:2])
    whole = np.pad(samples, ((0, height - samples.shape[0]), (0, width - samples.shape[1]), (0, 0)), mode="edge")
    means = whole.reshape(height // factor, factor, width // factor, factor, -1).mean(axis=(1, 3))
    return np.asarray(np.rint(means).astype(samples.dtype))


@dataclass(frozen=True)
class FrameScan:
    """Scan of a frame, whole or a part of it, by the name of its image."""

    image: str
    scan: Path
    chain: frame_canvas.FrameChain


@dataclass(frozen=True)
class ResampleTask:
    """All that the resampling of one frame depends on.

    Attributes
    ----------
    scans : one, named as the frame, or several partial ones.
    doubt : why the transformation by its fiducials needs a look; otherwise empty.
    """

    image: str
    camera: str
    pose: str
    pitch_mm: float
    degree: Degree
    max_pixels: int | None
    target: Path
    scans: tuple[FrameScan, ...]
    doubt: str = ""

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
    doubt : why the frame needs a look; otherwise empty.
    """

    image: str
    path: Path | None
    width_px: int = 0
    height_px: int = 0
    clamped: int = 0
    kept: bool = False
    problem: str = ""
    doubt: str = ""


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
    tasks, results = resample_tasks(project, folder, pitch_um, with_lens, BEST if not fast else FAST)
    check_writable(folder)
    with reporter.stage("resampled frame") as count, worker_pool(max(len(tasks), 1)) as workers:
        futures = {workers.submit(resample_frame, task): task for task in tasks}
        for done, future in enumerate(as_completed(futures), 1):
            try:
                results.append(future.result())
            except Exception as error:  # its process was killed, or its memory full: the other frames go on
                reason = str(error) if isinstance(error, WorkerKilled) else f"{type(error).__name__} {error}".rstrip()
                results.append(Resampled(futures[future].image, None, problem=reason))
            count(futures[future].image, done, len(futures))
    return tuple(sorted(results, key=lambda result: result.image))


def resample_tasks(
    project: Project, folder: Path, pitch_um: float | None, with_lens: bool, degree: Degree
) -> tuple[list[ResampleTask], list[Resampled]]:
    """Tasks of a project, and the failures of scans that cannot be resampled."""
    scans, changed = read_measurement(project.measurement_path), changed_scans(project)
    adjustment = None
    if project.comparator.exists():
        adjustment = current_adjustment(project, read_comparator(project.comparator, project.list_pitch_um))
    if with_lens and adjustment is None:
        raise InputError("--lens needs an adjusted lens. Run `reseau adjust` first, or resample without it.")
    images = {} if adjustment is None else adjustment.images
    tasks: dict[str, ResampleTask] = {}
    failed = []
    taking_lens = None if project.lens is None else project.lens.lens
    for measured in scans:
        image = measured.frame.image
        if image in changed:
            failed.append(Resampled(image, None, problem="its file is not the one measured: run `reseau measure`"))
            continue
        frame = project.image_frame(image)
        chain = _chain(measured, adjustment, with_lens, frame != image, taking_lens)
        if isinstance(chain, str):
            failed.append(Resampled(image, None, problem=chain))
            continue
        scan = FrameScan(image, scan_path(measured.scan), replace(chain, turn=picture_turn(project, image)))
        if frame in tasks:
            tasks[frame] = replace(tasks[frame], scans=(*tasks[frame].scans, scan))
            continue
        pitch_mm = (pitch_um or float(np.sqrt(np.prod(measured.pitch_um)))) / 1000.0
        # Single doubtful marks do not count, nor does anything where the image is oriented, by more than fiducials.
        is_doubtful = has_problem(measured) or scan_verdict(measured) is Verdict.POOR
        is_oriented = image in images and images[image].exterior.is_oriented
        tasks[frame] = ResampleTask(
            image=frame,
            camera=project.image_camera(image).name,
            pose=measured.frame.pose.name if measured.frame.pose else "0",
            pitch_mm=pitch_mm,
            degree=degree,
            max_pixels=project.max_pixels,
            target=path_below(folder, frame, ".tif"),
            scans=(scan,),
            doubt=scan_doubt(measured) if is_doubtful and not is_oriented else "",
        )
    scan_files = {Path(scan_path(each.scan)).resolve() for each in scans}
    for target in (task.target for task in tasks.values()):
        if target.resolve() in scan_files or (target.exists() and read_description(target) is None):
            raise InputError(
                f"{target}: a resampled frame is to be written there, but the file that stands there is a scan, or was "
                "not written by `reseau resample`. Name another folder."
            )
    return list(tasks.values()), failed


def _chain(
    measured: MeasuredScan,
    adjustment: AdjustmentRecord | None,
    with_lens: bool,
    is_part: bool,
    taking_lens: Lens | None,
) -> frame_canvas.FrameChain | str:
    """Adjusted chain of an image, or the chain from its fiducials, or the reason why there is none."""
    image = measured.frame.image
    if adjustment is not None and image in adjustment.images:
        return frame_canvas.image_chain(
            image, adjustment, measured.pitch_um, frame_canvas.middle_mm(measured), with_lens
        )
    if with_lens:
        return "it has no part in the adjustment, so its lens is not known: resample it without --lens"
    if is_part:
        return (
            "it is a part of a frame, and no adjustment says how it lies to the other scans: run `reseau adjust`, and "
            "see what it says of this one"
        )
    why_not = "too few of its fiducial marks were found to say where its frame lies"
    return frame_canvas.measured_chain(measured, taking_lens) or why_not


def resample_frame(task: ResampleTask) -> Resampled:
    """Resample one scan into its file; a failure is a result, too."""
    try:
        return _resample_frame(task)
    except (MeasurementError, InputError, OSError) as error:
        return Resampled(task.image, None, problem=str(error))


def _resample_frame(task: ResampleTask) -> Resampled:
    before = read_description(task.target)
    with ExitStack() as opened:
        scans = [(opened.enter_context(open_scan(each.scan, task.max_pixels)), each.chain) for each in task.scans]
        canvas = frame_canvas.outline_canvas([(chain, scan.part_px) for scan, chain in scans], task.pitch_mm)
        done = Resampled(task.image, task.target, canvas.width_px, canvas.height_px, doubt=task.doubt)
        scanned = sum(scan.width_px * scan.height_px for scan, _ in scans)
        if canvas.width_px * canvas.height_px > _MOST_LARGER * scanned:
            raise MeasurementError(
                f"it would have {canvas.width_px} x {canvas.height_px} px at a pitch of {1000.0 * task.pitch_mm:g} µm, "
                f"more than {_MOST_LARGER} times its scan's: set a coarser --pitch-um, or look at its transformation"
            )
        if before is not None and before.get("fingerprint") == task.fingerprint:
            return replace(done, kept=True)
        task.target.parent.mkdir(parents=True, exist_ok=True)
        parts = []
        for scan, chain in scans:
            rows = _tile_row_height_px(chain, canvas, scan.height_px) + 2 * MARGIN_PX
            source = opened.enter_context(open_source(scan, rows, task.target.parent))
            parts.append(OpenPart(source, chain, _smoothing_px(chain, canvas)))
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


def _tile_row_height_px(chain: frame_canvas.FrameChain, canvas: frame_canvas.Canvas, height_px: int) -> int:
    """Rows of a scan that the first row of tiles needs; all `height_px` where a corner of it has no place there."""
    corners = np.array([(0, 0), (canvas.width_px, 0), (0, TILE_PX), (canvas.width_px, TILE_PX)], dtype=np.float64)
    pixels, found = chain.scan_from_frame(canvas.camera_from_pixel(corners))
    return min(int(np.ptp(pixels[:, 1])), height_px) if found.all() and np.isfinite(pixels).all() else height_px


def _smoothing_px(chain: frame_canvas.FrameChain, canvas: frame_canvas.Canvas) -> float:
    """Smoothing for a canvas: half of what a step in its middle exceeds a pixel of the scan by, as of scikit-image's
    `resize`; 0 for steps of about a pixel."""
    middle = np.array([canvas.width_px, canvas.height_px]) / 2.0
    pixels, _ = chain.scan_from_frame(canvas.camera_from_pixel(middle + np.array([[0.0, 0.0], [1.0, 0.0]])))
    step_px = float(np.hypot(*(pixels[1] - pixels[0])))
    return (step_px - 1.0) / 2.0 if step_px > _COARSER else 0.0


def resampled_json(results: Sequence[Resampled]) -> list[dict[str, object]]:
    """The results for `--json`."""
    return [asdict(result) | {"path": result.path and str(result.path)} for result in results]


@contextmanager
def open_source(scan: Scan, rows_at_a_time: int, scratch: Path) -> Iterator[SampleSource]:
    """Open a scan as a source. Where a row of tiles needs more rows at a time than stay decoded, the scan is decoded to
    a file first."""
    wide = scan.segment_px[1] >= scan.width_px
    if not wide or rows_at_a_time <= scan.rows_kept:
        yield SampleSource(scan)
        return
    with tempfile.TemporaryFile(dir=scratch, prefix=".decoded-") as file:
        yield _Decoded(scan, file.fileno())


def interpolate(source: SampleSource, columns: Array, rows: Array, degree: Degree, smoothing_px: float = 0.0) -> Tile:
    """Interpolate the scan at places (side, side) by splines of the degree; 0 outside of the scan. smoothing_px:
    standard deviation of a Gaussian filter of the scan, without which coarse steps show finer detail as coarse one."""
    shape = columns.shape
    inside = (columns >= -0.5) & (columns <= source.width_px - 0.5) & (rows >= -0.5) & (rows <= source.height_px - 0.5)
    samples = np.zeros((*shape, source.channels), source.dtype)
    if not inside.any():
        return Tile(samples, inside, 0)
    margin_px = MARGIN_PX + ceil(_TRUNCATED * smoothing_px)
    left, top = (int(np.floor(places[inside].min())) - margin_px for places in (columns, rows))
    right, bottom = (int(np.ceil(places[inside].max())) + margin_px for places in (columns, rows))
    window = source.window(left, top, right - left + 1, bottom - top + 1)
    known = source.valid_mask(left, top, right - left + 1, bottom - top + 1)
    if not known.all():  # a sample is lost if its spline involves a lost pixel
        lost = maximum_filter(~known, size=degree + 2 + 2 * ceil(_TRUNCATED * smoothing_px))
        at = np.rint([rows[inside] - top, columns[inside] - left]).astype(int)
        inside[inside] = ~lost[tuple(at)]
    is_whole, clamped = bool(inside.all()), 0
    at = np.stack([rows, columns]).reshape(2, -1) if is_whole else np.array([rows[inside], columns[inside]])
    at -= [[top], [left]]
    for channel in range(source.channels):
        picture = window[..., channel]
        if smoothing_px:
            picture = gaussian_filter(picture.astype(np.float32), smoothing_px, truncate=_TRUNCATED)
        values, beyond = spline_samples(picture, at, degree, source.dtype)
        samples[..., channel][... if is_whole else inside] = values.reshape(shape) if is_whole else values
        clamped += beyond
    return Tile(samples, inside, clamped)


def spline_samples(
    picture: Samples | NDArray[np.float32], places: Array, degree: Degree, dtype: type[np.uint8] | type[np.uint16]
) -> tuple[Samples, int]:
    """Evaluate a spline through an image (rows, columns), mirrored at its edges, at places (2, n), row and column.

    Returns
    -------
    The samples (n,), and how many were clamped to the range of the type.
    """
    coefficients = spline_filter(picture, degree, mode="mirror")
    if compiled.kernels is not None:
        samples: Samples = np.empty(places.shape[1], dtype)
        width = coefficients.shape[1]
        return samples, compiled.kernels.spline_samples(coefficients, width, places[0], places[1], degree, samples)
    values = np.rint(map_coordinates(coefficients, places, order=degree, mode="mirror", prefilter=False))
    highest = np.iinfo(dtype).max
    clamped = int(((values < 0) | (values > highest)).sum())
    return np.clip(values, 0, highest).astype(dtype), clamped


def find_inner_edges(parts: Sequence[OpenPart]) -> list[OpenPart]:
    """Determine the inner edges of the scans: those whose centre lies in another scan.

    Raises MeasurementError for scans with different pixel types.
    """
    kinds = {(part.source.channels, np.dtype(part.source.dtype).name) for part in parts}
    if len(kinds) > 1:
        kinds_text = " and ".join(f"{n} channel{'s' * (n > 1)} of {dtype}" for n, dtype in sorted(kinds))
        raise MeasurementError(f"its scans have different pixel types: {kinds_text}. Scan both alike.")
    found_parts = []
    for part in parts:
        right, bottom = part.source.width_px - 1.0, part.source.height_px - 1.0
        middles = np.array([[0.0, bottom / 2], [right, bottom / 2], [right / 2, 0.0], [right / 2, bottom]])
        places_mm, _ = part.chain.frame_from_scan(middles)
        inside = np.zeros(4, dtype=bool)
        for other in (each for each in parts if each is not part):
            pixels, found = other.chain.scan_from_frame(places_mm)
            col, row = pixels.T
            inside |= found & (col >= 0) & (col < other.source.width_px) & (row >= 0) & (row < other.source.height_px)
        found_parts.append(replace(part, inner=tuple(inside.tolist())))
    return found_parts


def joined_tile(
    parts: Sequence[OpenPart], canvas: frame_canvas.Canvas, col0: int, row0: int, side: int, degree: Degree
) -> Tile:
    """Tile of the frame. A pixel that is lost in the preferred scan comes from another one that has it."""
    places = [frame_canvas.scan_places(part.chain, canvas, col0, row0, side) for part in parts]
    if len(parts) == 1:
        return interpolate(parts[0].source, *places[0], degree, parts[0].smoothing_px)
    depths = np.stack([_depth(part, *place) for part, place in zip(parts, places, strict=True)])
    result: Tile | None = None
    for k in np.argsort(-depths.reshape(len(parts), -1).max(axis=1)).tolist():
        deepest = depths[k] >= np.delete(depths, k, axis=0).max(axis=0)
        wanted = deepest if result is None else deepest | ~result.is_inside
        columns, rows = (np.where(wanted, axis, np.nan) for axis in places[k])
        tile = interpolate(parts[k].source, columns, rows, degree, parts[k].smoothing_px)
        if result is not None:
            samples = np.where(tile.is_inside[..., None], tile.samples, result.samples)
            tile = Tile(samples, result.is_inside | tile.is_inside, result.clamped + tile.clamped)
        result = tile
    assert result is not None  # a frame has at least one scan
    return result


def _depth(part: OpenPart, columns: Array, rows: Array) -> Array:
    """Distance in px of places from the scan's inner edges; -inf outside of the scan."""
    right, bottom = part.source.width_px - 0.5, part.source.height_px - 0.5
    from_edges = np.stack([columns + 0.5, right - columns, rows + 0.5, bottom - rows])
    inner = np.array(part.inner)
    depth = from_edges[inner].min(axis=0) if inner.any() else np.full(columns.shape, np.finfo(float).max)
    with np.errstate(invalid="ignore"):
        return np.where((from_edges >= 0.0).all(axis=0), depth, -np.inf)


def seams_mm(parts: Sequence[OpenPart], canvas: frame_canvas.Canvas) -> list[list[tuple[float, float]]]:
    """Seams between the scans: polylines in mm of the camera frame."""
    step = max(canvas.width_px, canvas.height_px) / (_NODES - 1)
    col, row = (np.arange(0.0, size, step) for size in (canvas.width_px, canvas.height_px))
    nodes = canvas.camera_mm(col, row)
    depths = []
    for part in parts:
        pixels, found = part.chain.scan_from_frame(nodes.reshape(-1, 2))
        pixels[~found] = np.nan
        depths.append(_depth(part, *pixels.T).reshape(nodes.shape[:2]))
    lines = []
    for k, depth in enumerate(depths):
        for other in depths[k + 1 :]:
            both = np.isfinite(depth) & np.isfinite(other)
            between = np.where(both, np.where(both, depth, 0.0) - np.where(both, other, 0.0), np.nan)
            for line in find_contours(between, 0.0):
                shown = line[np.unique(np.linspace(0, len(line) - 1, _SHOWN).astype(int))]
                x_mm = canvas.x_mm + canvas.pitch_mm * step * shown[:, 1]
                y_mm = canvas.y_mm - canvas.pitch_mm * step * shown[:, 0]
                lines.append([(round(x, 3), round(y, 3)) for x, y in zip(x_mm.tolist(), y_mm.tolist(), strict=True)])
    return lines
