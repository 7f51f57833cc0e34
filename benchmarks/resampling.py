"""Effects of resampling on an image, compared with other programs: shifts of marks, loss of noise and contrast.

The image is synthetic, rotated by 0.37 degrees at a scale of 0.9985, and resampled to the result and back (`_back`).
--large: time and peak memory for a scan of that side (11500 px; 23000 take about five minutes), 16 bit, LZW in
strips, rotated by 90 degrees. libvips and GDAL are included if pyvips and rasterio are installed, which the project
does not require.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from adjust.functional_model.transformation import Film
from benchmarks.harness import Row, rms
from pipeline.resampling.canvas import FrameChain
from pipeline.resampling.resample_stage import BEST, FAST, Degree, FrameScan, ResampleTask, resample_frame

Array = NDArray[np.float64]
Method = Callable[[Array, Array, Array], Array]

TURN, SCALE = np.radians(0.37), 0.9985
BLUR_PX, PEAK = 1.4, 20000.0
SPACING_PX, WINDOW_PX = 40, 8
HALF_NYQUIST = 0.25  # cycles per pixel


def opencv_method(kind: int) -> Method:
    def method(picture: Array, cols: Array, rows: Array) -> Array:
        maps = cols.astype(np.float32), rows.astype(np.float32)
        return np.asarray(cv2.remap(picture.astype(np.float32), *maps, kind, borderMode=cv2.BORDER_REFLECT), float)

    return method


def spline_method(degree: Degree) -> Method:
    return lambda picture, cols, rows: np.asarray(map_coordinates(picture, [rows, cols], order=degree, mode="mirror"))


def vips_method(kind: str) -> Method:
    """Interpolation by libvips' mapim, with coordinates from the centre of the first pixel."""

    def method(picture: Array, cols: Array, rows: Array) -> Array:
        import pyvips

        image = pyvips.Image.new_from_array(picture.astype(np.float32))
        places = pyvips.Image.new_from_array(np.stack([cols, rows], axis=-1).astype(np.float32))
        moved = image.mapim(places, interpolate=pyvips.Interpolate.new(kind), extend="mirror")
        return np.asarray(moved.numpy(), float)

    return method


def gdal_method(kind: str) -> Method:
    """Interpolation by GDAL's warp between two affine frames, without its approximation."""

    def method(picture: Array, cols: Array, rows: Array) -> Array:
        from rasterio.transform import Affine
        from rasterio.warp import Resampling, reproject

        a, b, c = cols[0, 1] - cols[0, 0], cols[1, 0] - cols[0, 0], cols[0, 0]
        d, e, f = rows[0, 1] - rows[0, 0], rows[1, 0] - rows[0, 0], rows[0, 0]
        corner = Affine.translation(0.5, 0.5)  # GDAL counts from the corner of the first pixel
        frame = corner * Affine(a, b, c, d, e, f) * ~corner
        result = np.zeros_like(picture)
        given = {"src_crs": "EPSG:3857", "dst_crs": "EPSG:3857", "tolerance": 0.0, "resampling": Resampling[kind]}
        reproject(picture, result, src_transform=Affine.identity(), dst_transform=frame, **given)
        return result

    return method


METHODS: dict[str, Method] = {
    "reseau (spline 5)": spline_method(5),
    "reseau --fast (spline 3)": spline_method(3),
    "OpenCV linear": opencv_method(cv2.INTER_LINEAR),
    "OpenCV cubic": opencv_method(cv2.INTER_CUBIC),
    "OpenCV Lanczos4": opencv_method(cv2.INTER_LANCZOS4),
    "libvips bicubic": vips_method("bicubic"),
    "libvips nohalo": vips_method("nohalo"),
    "GDAL cubic": gdal_method("cubic"),
    "GDAL Lanczos": gdal_method("lanczos"),
}


def source_places(side: int) -> tuple[Array, Array]:
    """Columns and rows in the image of the pixels of the result."""
    col, row = np.meshgrid(np.arange(side, dtype=float), np.arange(side, dtype=float))
    u, v = col - side / 2, row - side / 2
    return (
        SCALE * (np.cos(TURN) * u - np.sin(TURN) * v) + side / 2,
        SCALE * (np.sin(TURN) * u + np.cos(TURN) * v) + side / 2,
    )


def marks(side: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Image of Gaussian marks, and their centres (n, 2)."""
    grid = np.arange(SPACING_PX, side - SPACING_PX, SPACING_PX, dtype=float)
    middles = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2) + rng.uniform(0, 1, (grid.size**2, 2))
    picture = np.full((side, side), 8000.0)
    at = np.arange(-WINDOW_PX, WINDOW_PX + 1)
    for x, y in middles:
        col, row = int(x), int(y)
        gx, gy = (np.exp(-((at + i - z) ** 2) / (2 * BLUR_PX**2)) for i, z in ((col, x), (row, y)))
        picture[row - WINDOW_PX : row + WINDOW_PX + 1, col - WINDOW_PX : col + WINDOW_PX + 1] += PEAK * np.outer(gy, gx)
    return picture, middles


def shift_middles(middles: Array, side: int) -> Array:
    """Transform places (n, 2) from the image to the result."""
    u, v = (middles - side / 2).T / SCALE
    return np.stack([np.cos(TURN) * u + np.sin(TURN) * v, -np.sin(TURN) * u + np.cos(TURN) * v], axis=1) + side / 2


def target_places(side: int) -> Array:
    """Inverse of `source_places`: columns and rows in the result of the pixels of the image."""
    pixels = np.stack(np.meshgrid(*2 * [np.arange(side, dtype=float)]), axis=-1)
    return shift_middles(pixels.reshape(-1, 2), side).T.reshape(2, side, side)


def shift_rms_px(picture: Array, places: Array, blur_px: float) -> float:
    """RMS shift of marks from their true places, by least-squares matching with their true shape."""
    side, at, off = len(picture), np.arange(-WINDOW_PX, WINDOW_PX + 1), []
    for x, y in places[((places > side // 16) & (places < side - side // 16)).all(axis=1)]:
        col, row = round(x), round(y)
        dx, dy = at + col - x, at + row - y
        form = np.outer(np.exp(-(dy**2) / (2 * blur_px**2)), np.exp(-(dx**2) / (2 * blur_px**2)))
        slopes = [form * dx / blur_px**2, form * dy[:, None] / blur_px**2]
        design = np.stack([form, np.ones_like(form), *(PEAK * slope for slope in slopes)], axis=-1).reshape(-1, 4)
        view = picture[row - WINDOW_PX : row + WINDOW_PX + 1, col - WINDOW_PX : col + WINDOW_PX + 1]
        off.append(np.linalg.lstsq(design, view.ravel())[0][2:])
    return rms(off)


OWN_PROCESS = True
FIGURES = ("marks_px", "noise", "contrast")
COLUMNS = {"program": "", **dict.fromkeys((*FIGURES, *(f"{name}_back" for name in FIGURES)), ".4f")}
COLUMNS |= {"result": "", "cpu_seconds": ".2f", "seconds": ".2f", "mib": ".0f", "says": ""}


def cells(large: int = 0) -> Iterator[Row]:
    yield from ({"program": name, "large": large} for name in (PROGRAMS if large else METHODS))


def case(program: str, large: int = 0, side: int = 1600) -> Row:
    try:
        return resampled_scan(program, large) if large else compare(METHODS[program], side)
    except ImportError as error:
        return {"says": str(error)}


def compare(method: Method, side: int) -> Row:
    """Effects of one interpolation."""
    rng = np.random.default_rng(5)
    there, back = source_places(side), target_places(side)
    inner = slice(side // 8, -side // 8)
    picture, middles = marks(side, rng)
    noise = rng.normal(0, 100.0, (side, side))
    wave = 1000.0 * np.cos(2 * np.pi * HALF_NYQUIST * np.arange(side))[None, :] * np.ones((side, 1))
    start = time.process_time()
    once = [method(each, *there) for each in (picture, noise, wave)]
    row = {"cpu_seconds": (time.process_time() - start) / 3.0}
    for end, views, places, blur_px in (
        ("", once, shift_middles(middles, side), BLUR_PX / SCALE),
        ("_back", [method(each, *back) for each in once], middles, BLUR_PX),
    ):
        view, grain, waves = views
        row[f"marks_px{end}"] = shift_rms_px(view, places, blur_px)
        row[f"noise{end}"] = grain[inner, inner].std() / 100.0
        row[f"contrast{end}"] = waves[inner, inner].std() / (1000.0 / np.sqrt(2))
    return row


STRIP_PX = 64
TURNED = np.array([1.0, 0.002, -1.0, -1.0, 1.0, 0.002])  # film transformation of a scan rotated by 90 degrees
PITCH_MM = 0.02


def make_scan(path: Path, side: int) -> None:
    """Make a scan of noise on long waves, strip by strip in a memory-mapped file, to limit memory."""
    rng = np.random.default_rng(5)
    wave = 14000.0 + 4000.0 * np.sin(np.arange(side) / 90.0)
    raw = np.memmap(path.with_suffix(".raw"), np.uint16, "w+", shape=(side, side))
    for row0 in range(0, side, STRIP_PX):
        noise = rng.integers(-400, 400, raw[row0 : row0 + STRIP_PX].shape, dtype=np.int16)
        raw[row0 : row0 + STRIP_PX] = wave + 2000.0 * np.cos(row0 / 500.0) + noise
    tifffile.imwrite(path, raw, rowsperstrip=STRIP_PX, compression="lzw")
    path.with_suffix(".raw").unlink()


def resample_reseau(folder: Path, degree: Degree) -> str:
    chain = FrameChain((1000.0 * PITCH_MM,) * 2, Film("affine", TURNED, np.zeros(2)))
    scans = (FrameScan("a", folder / "scan.tif", chain),)
    task = ResampleTask("a", "K", "90", PITCH_MM, degree, None, folder / "a.tif", scans)
    done = resample_frame(task)
    return done.problem or f"{done.width_px} x {done.height_px}"


def resample_vips(folder: Path, _: Degree) -> str:
    """Resample by libvips' affine with the same storage: tiles, deflate, predictor."""
    import pyvips

    image = pyvips.Image.new_from_file(str(folder / "scan.tif"))
    turn = [TURNED[1], -TURNED[2], -TURNED[4], TURNED[5]]  # of pixels, whose rows count downwards
    turned = image.affine(turn, interpolate=pyvips.Interpolate.new("bicubic"))
    stored = {"tile": True, "tile_width": 512, "tile_height": 512, "compression": "deflate", "predictor": "horizontal"}
    turned.tiffsave(str(folder / "v.tif"), bigtiff=True, **stored)
    return f"{turned.width} x {turned.height}"


PROGRAMS: dict[str, tuple[Callable[[Path, Degree], str], Degree]] = {
    "reseau (spline 5)": (resample_reseau, BEST),
    "reseau --fast (spline 3)": (resample_reseau, FAST),
    "libvips bicubic": (resample_vips, FAST),
}


def resampled_scan(program: str, side: int) -> Row:
    """Size of the result of one program, its time and, with that of making the scan, its peak memory."""
    function, degree = PROGRAMS[program]
    with tempfile.TemporaryDirectory() as name:
        make_scan(Path(name) / "scan.tif", side)
        start_s, before_s = time.perf_counter(), time.process_time()
        result = function(Path(name), degree)
        return {
            "result": result, "cpu_seconds": time.process_time() - before_s, "seconds": time.perf_counter() - start_s
        }  # fmt: skip
