"""Requests and bytes read from a tiled TIFF file on a server to measure a scan, with and without overviews.

The frame has the eight ring-crosses of an aerial camera on grainy film, at the scan's centre or so far off that a mark
must be searched first; the server counts requests and bytes.
"""

import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from range_server import range_server

from benchmarks.harness import Row
from measure.marks.rendering import extent_px, picture
from measure.marks.shapes import FiducialLayout
from pipeline.files.camera_file import read_camera
from pipeline.files.project_file import read_project
from pipeline.measuring.scan_measurement import MeasuredFile, measure_file
from pipeline.measuring.scan_task import scan_tasks

PITCH_UM, _EDGE_MM = 20.0, 106.0
_GROUND_DN, _GRAIN_DN, _MARK_DN = 110.0, 5.0, 90.0
_ROWS = 500  # rows of grain made at a time


def camera_text(edge_mm: float) -> str:
    """Camera file with eight ring-crosses, edge_mm from the centre along the axes, and a slightly larger frame."""
    edges = (-edge_mm, 0.0, edge_mm)
    places = [(x, y) for x in edges for y in edges if (x, y) != (0.0, 0.0)]
    size = 2 * edge_mm + 16.0
    return (
        f'name = "K"\nframe_mm = [{size}, {size}]\nprincipal_distance_mm = {size}\n'
        + "".join(
            f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.01\nmark = "m"\n'
            for number, (x, y) in enumerate(places, 1)
        )
        + '[mark.m]\nkind = "ring-cross"\nring_mm = 0.8\nring_line_mm = 0.1\narm_mm = 1.2\nline_mm = 0.1\n'
    )


COLUMNS = {
    "tile_px": "d", "overviews": "d", "off_px": "d", "measured": "d", "marks": "d", "requests": "d", "bytes": ",d",
    "of_file": ".1%", "cpu_s": ".1f",
}  # fmt: skip


def cells() -> Iterator[Row]:
    for overviews, off_px, tile_px in product((True, False), (0, 350), (256, 512)):
        yield {"tile_px": tile_px, "overviews": overviews, "off_px": off_px}


def case(tile_px: int, overviews: bool, off_px: int, seed: int, side: int = 11_500) -> Row:
    with tempfile.TemporaryDirectory() as place:
        folder, file = Path(place), Path(place) / "scan.tif"
        (folder / "camera.toml").write_text(camera_text(_EDGE_MM), encoding="utf-8")
        layout = read_camera(folder / "camera.toml").layout()
        _write(file, drawn_frame(layout, side, np.random.default_rng(seed), off_px), tile_px, overviews)
        with range_server(folder) as server:
            start_s = time.process_time()
            marks = _measure(folder, f"{server.url}/{file.name}").scan.frame.marks
            cpu_s = time.process_time() - start_s
        return {
            "measured": sum(mark.status == "measured" for mark in marks), "marks": len(marks), "cpu_s": cpu_s,
            "requests": server.gets, "bytes": server.sent_bytes, "of_file": server.sent_bytes / file.stat().st_size,
        }  # fmt: skip


def _measure(folder: Path, address: str) -> MeasuredFile:
    """Measure as `reseau measure` does."""
    text = f'camera = "camera.toml"\nscans = ["{address}"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n'
    (folder / "project.toml").write_text(text, encoding="utf-8")
    project = read_project(folder / "project.toml")
    (task,) = scan_tasks(project, tuple(project.scans))
    return measure_file(task)


def drawn_frame(layout: FiducialLayout, side: int, rng: np.random.Generator, off_px: int = 0) -> NDArray[np.uint8]:
    """Square scan of grainy film with a camera's marks; the frame's centre is off the scan's by off_px and up to 20 px
    more."""
    grey = np.full((side, side), _GROUND_DN, np.float32)
    scale, middle = 1000.0 / PITCH_UM, side / 2 + off_px + rng.uniform(-20, 20, 2)
    for mark in layout.marks:
        x, y = mark.xy_mm
        linear = scale * np.array([[1.0, 0.0], [0.0, -1.0]])
        center = middle + scale * np.array([x, -y])
        least, greatest = extent_px(mark.mark, np.column_stack([linear, center]))
        low = np.floor(least).astype(int) - 4
        width, height = (np.ceil(greatest - least).astype(int) + 8).tolist()
        drawn = picture(mark.mark, np.column_stack([linear, center - low]), width, height, 1.0)
        grey[low[1] : low[1] + height, low[0] : low[0] + width] += _MARK_DN * drawn
    for row in range(0, side, _ROWS):
        rows = grey[row : row + _ROWS]
        grain = rng.standard_normal(rows.shape, np.float32)
        rows += cv2.GaussianBlur(2 * _GRAIN_DN * grain, (0, 0), 0.6)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _write(path: Path, grey: NDArray[np.uint8], tile_px: int, overviews: bool) -> None:
    """Write a tiled TIFF file with overviews reduced by factors of two, as in a cloud-optimised file."""
    smaller = [grey]
    while overviews and max(smaller[-1].shape) > tile_px:
        size = [-(-side // 2) for side in smaller[-1].shape[::-1]]
        smaller.append(np.asarray(cv2.resize(smaller[-1], size, interpolation=cv2.INTER_AREA), np.uint8))
    with tifffile.TiffWriter(path) as file:
        for number, one in enumerate(smaller):
            file.write(one, tile=(tile_px, tile_px), compression="zlib", subfiletype=int(number > 0), metadata=None)
