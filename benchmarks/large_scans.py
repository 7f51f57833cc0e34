"""Time and memory of reading large scans, beside one decode by tifffile.

python -m benchmarks large_scans [--size 11500]

One frame with eight fiducials and 210 disks is rendered, stored in every way, and read by turns, in one process:
whole by tifffile, in eight windows about the marks, reduced to a quarter of its side or 3000 px, searched for disks,
and measured as `reseau measure` does; figures are medians over the rounds. Memory is the peak of a process of its own.
Seconds are of the clock, and in brackets of the processor: on a busy machine only those compare.
"""

import argparse
import json
import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import tifffile
from numpy.typing import NDArray

from measure.fiducials.measurement import measure_fiducials
from measure.marks.shapes import FiducialLayout
from measure.scans.opening import open_scan
from measure.scans.parallel import map_in_threads
from measure.targets.disk_detection import DiskSearch, disk_candidates
from measure.targets.disks import fit_disk
from pipeline.files.project_file import read_project
from pipeline.rendered.scene_file import render_project

FRAME_MM = 230.0
WINDOW_MM = 6.4  # about a mark: what the search at full resolution reads
REDUCED_PX = 3000  # of a scan that is searched whole
DISK_MM = (0.36, 0.9)
SCENE = """
name = "large"
seed = 5
camera = "{camera}"
[field]
unit = "m"
diameter_mm = 1800.0
surround = 2.2
[[field.grid]]
first = 101
columns = 15
rows = 14
right = [42.0, 0.0, 0.0]
up = [0.0, 45.0, 0.0]
jitter = 0.25
[picture]
background = "terrain"
pad_mm = 3.6
[film]
grain = 0.02
grain_px = 0.8
dust = 250
scratches = 4
hairs = 6
[scan]
pitch_um = {pitch_um}
margin_mm = 1.0
turn_sigma_deg = 0.3
offset_sigma_mm = 0.4
blur_px = 0.7
noise = 0.006
compression = "none"
[[image]]
name = "frame"
position = [4.0, -7.0, 465.0]
angles_deg = [0.0, 0.0, 2.5]
"""
CAMERA = Path(__file__).parents[1] / "synthetic_images" / "scenes" / "aerial_camera.toml"
COMPRESSIONS = {"none": None, "lzw": "lzw", "deflate": "zlib", "zstd": "zstd", "jpeg": "jpeg"}

Grey = NDArray[np.uint8] | NDArray[np.uint16]


class Frame(NamedTuple):
    """The rendered frame: its grey values, its camera's marks, and where they and the disks are, px."""

    grey: Grey
    layout: FiducialLayout
    marks_px: NDArray[np.float64]
    disks_px: NDArray[np.float64]


class Storage(NamedTuple):
    bits: int
    compression: str
    segments: str

    @classmethod
    def all(cls) -> Iterator["Storage"]:
        for bits in (16, 8):
            for compression in COMPRESSIONS:
                for segments in ("tiles", "strips", "one strip"):
                    raw_strip = compression == "none" and segments == "one strip"  # is read by rows as any strips
                    if not raw_strip and (bits, compression) != (16, "jpeg"):
                        yield cls(bits, compression, segments)

    def write(self, grey: Grey, path: Path) -> None:
        tifffile.imwrite(
            path,
            grey if self.bits == 16 else np.round(grey / 257).astype(np.uint8),
            compression=COMPRESSIONS[self.compression],
            tile=(256, 256) if self.segments == "tiles" else None,
            rowsperstrip={"strips": 16, "one strip": len(grey)}.get(self.segments),
            resolution=(1e4 * len(grey) / FRAME_MM / 1e3,) * 2,
            resolutionunit="CENTIMETER",
            photometric="minisblack",
            metadata=None,
        )


class Spent(NamedTuple):
    clock_s: float
    processor_s: float
    result: object


def rendered(folder: Path, size: int) -> Frame:
    """The frame, of so many pixels a side."""
    scene, project = folder / "scene.toml", folder / "frame"
    scene.write_text(SCENE.format(camera=CAMERA, pitch_um=1000 * FRAME_MM / size), encoding="utf-8")
    render_project(scene, project)
    truth = json.loads((project / "truth.json").read_text(encoding="utf-8"))["images"]["frame"]
    grey = tifffile.imread(project / "scans" / "frame.tif")
    layout = read_project(project / "project.toml").camera_of("frame").layout()
    marks = {mark.id: truth["fiducials"][mark.id] for mark in layout.marks}
    return Frame(grey, layout, places_px(marks), places_px(truth["targets"]))


def places_px(marks: dict[str, dict[str, float]]) -> NDArray[np.float64]:
    """(n, 2) of those that can be seen."""
    return np.array([(mark["col_px"], mark["row_px"]) for mark in marks.values() if mark["visible"]])


def timed(function: Callable[[], object]) -> Spent:
    clock, processor = time.perf_counter(), time.process_time()
    result = function()
    return Spent(time.perf_counter() - clock, time.process_time() - processor, result)


def windows(path: Path, marks_px: NDArray[np.float64]) -> None:
    with open_scan(path) as scan:
        side = round(WINDOW_MM / FRAME_MM * scan.width_px)
        corners = np.round(marks_px - side / 2).astype(int).tolist()
        map_in_threads(lambda corner: scan.window(corner[0], corner[1], side, side), corners)


def reduced(path: Path) -> None:
    with open_scan(path) as scan:
        scan.reduced(max(4, -(-scan.width_px // REDUCED_PX)))


class Found(NamedTuple):
    """Disks of the frame that were found within 3 px, how many other patches were, and the found ones' rms error of a
    coordinate, px."""

    seen: int
    others: int
    rms_px: float


def disk_search(width_px: int) -> DiskSearch:
    return DiskSearch((DISK_MM[0] * width_px / FRAME_MM, DISK_MM[1] * width_px / FRAME_MM), "light")


def disks_seen(path: Path, disks_px: NDArray[np.float64], frame_px: int) -> Found:
    """The disks found in the whole scan; frame_px: width of the frame that shows them."""
    with open_scan(path) as scan:
        found = disk_candidates(scan, disk_search(frame_px))
    return compared(np.array([patch.center_px for patch in found]).reshape(-1, 2), disks_px)


def compared(centers: NDArray[np.float64], disks_px: NDArray[np.float64]) -> Found:
    apart = np.hypot(*np.moveaxis(disks_px[:, None] - centers, -1, 0))
    near = apart.min(axis=1, initial=np.inf)
    seen = near < 3.0
    return Found(int(seen.sum()), int((apart.min(axis=0) >= 3.0).sum()), float(np.sqrt(np.mean(near[seen] ** 2) / 2)))


def fitted(frame: Frame, folder: Path) -> None:
    """What measuring every disk to the bound takes, after they were found."""
    path = folder / "scan.tif"
    Storage(16, "lzw", "tiles").write(frame.grey, path)
    with open_scan(path) as scan:
        patches = disk_candidates(scan, disk_search(len(frame.grey)))
        spent = timed(lambda: [fit_disk(scan, patch.center_px, patch.pixel_from_disk) for patch in patches])
    assert isinstance(spent.result, list)
    kept = np.array([disk.center_px for disk in spent.result if not disk.reason]).reshape(-1, 2)
    each = both(1e3 * np.array(spent[:2]) / max(len(patches), 1))
    print(f"{len(patches)} patches fitted: ms each {each}; {compared(kept, frame.disks_px)}", flush=True)
    path.unlink()


def marks_measured(path: Path, frame: Frame) -> int:
    """How many fiducials are measured within a tenth of a pixel."""
    with open_scan(path) as scan:
        marks = measure_fiducials(scan, frame.layout, scan.pitch_um).marks
    pairs = zip(marks, frame.marks_px, strict=True)
    return sum(mark.center_px is not None and bool(np.abs(mark.center_px - place).max() < 0.1) for mark, place in pairs)


def compare(frame: Frame, folder: Path, rounds: int) -> None:
    print(
        "storage | tifffile, s | windows, of it | reduced, of it | disks, of it | disks, s above it | fiducials, s | "
        "disks seen, others, fiducials"
    )
    for storage in Storage.all():
        path = folder / "scan.tif"
        storage.write(frame.grey, path)
        work = (
            partial(tifffile.imread, path),
            partial(windows, path, frame.marks_px),
            partial(reduced, path),
            partial(disks_seen, path, frame.disks_px, len(frame.grey)),
            partial(marks_measured, path, frame),
        )
        by_round = [[timed(function) for function in work] for _ in range(rounds)]
        spent = np.median([[each[:2] for each in one] for one in by_round], axis=0)
        decode, *others = spent
        ratios = [both(each / decode) for each in others[:3]]
        disks, marks = by_round[0][3].result, by_round[0][4].result
        assert isinstance(disks, Found)
        print(
            f"{storage.bits} bit {storage.compression}, {storage.segments} | {both(decode)} | {' | '.join(ratios)} | "
            f"{both(others[2] - decode)} | {both(others[3])} | {disks.seen}, {disks.others}, {marks}",
            flush=True,
        )
        path.unlink()


def both(spent: NDArray[np.float64]) -> str:
    return f"{spent[0]:.2f} ({spent[1]:.2f})"


def repeated(grey: Grey, size: int, path: Path) -> None:
    """A scan of so many pixels a side, tiles of the frame over and over, as it never stands in memory."""

    def tiles() -> Iterator[Grey]:
        for row in range(0, size, 256):
            for col in range(0, size, 256):
                yield grey[np.arange(row, row + 256) % len(grey)][:, np.arange(col, col + 256) % len(grey)]

    tifffile.imwrite(
        path, tiles(), shape=(size, size), dtype=grey.dtype, tile=(256, 256), photometric="minisblack", metadata=None
    )


def peak_mib(function: Callable[..., object], *given: object) -> int:
    """Of a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(_peak_mib, function, *given).result()


def _peak_mib(function: Callable[..., object], *given: object) -> int:
    function(*given)
    # Linux's resource.getrusage would tell of the parent too.
    status = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) >> 10


def memory(frame: Frame, folder: Path, sizes: list[int]) -> None:
    print("scan, 16 bit tiles | windows, MiB | reduced | disks | tifffile")
    for size in (len(frame.grey), *sizes):
        path = folder / "scan.tif"
        repeated(frame.grey, size, path)
        peaks = [
            peak_mib(windows, path, frame.marks_px * size / len(frame.grey)),
            peak_mib(reduced, path),
            peak_mib(disks_seen, path, frame.disks_px, len(frame.grey)),
            2 * size * size >> 20,
        ]
        print(f"{size} px | {' | '.join(map(str, peaks[:3]))} | more than {peaks[3]}", flush=True)
        path.unlink()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=11500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--memory", type=int, nargs="*", default=[23000, 40000], help="sizes of which memory is told")
    arguments = parser.parse_args()
    with TemporaryDirectory() as temporary:
        one = rendered(Path(temporary), arguments.size)
        compare(one, Path(temporary), arguments.rounds)
        fitted(one, Path(temporary))
        memory(one, Path(temporary), arguments.memory)
