"""What measuring the fiducials of one scan takes of the processor.

    python -m benchmarks fiducial_times [--size 11500] [--rounds 5]

A large scan with eight marks, 16 bit in LZW tiles, as `large_scans` renders it; one of an archive, 2400 px, as
`archive_real` draws it, in light and with its tone curve not known; and a small frame of four marks in a pose that is
not known. Each is measured in a process of its own with one thread, which has imported everything: for the first time,
and then again, the least of the rounds; of the large one also what every stage takes of the quickest of these. Beside
them one decode of the large scan, and `reseau measure` on it, targets and writing included.
"""

import argparse
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import tifffile

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "measure"))

import numpy as np
from drawn_frames import NUMBERED, PITCH_UM, frame_picture, pixel_from_camera

import measure.fiducials.mark_fit
import measure.fiducials.measurement
import measure.fiducials.stages
import measure.matching.match
from benchmarks.archive_real import draw
from benchmarks.large_scans import FRAME_MM, Storage, rendered
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.fiducials.search import FrameSearch
from measure.marks.shapes import FiducialLayout
from measure.matching.gauss_newton import PictureFit
from measure.scans.opening import open_scan
from measure.scans.tiff_segments import TiffSegments
from measure.tone.curve import LINEAR, Tone
from pipeline.files.camera_file import read_camera

STAGES: dict[str, list[tuple[Any, str]]] = {
    "decoding tiles": [(TiffSegments, "read")],
    "search: correlations": [(FrameSearch, "_middle_responses")],
    "search: constellation": [(FrameSearch, "_placements")],
    "localisation": [(measure.fiducials.mark_fit, "localise")],
    "picture fits": [(measure.matching.match, "_fit_part")],
    "weights of grain": [(PictureFit, "weigh")],
    "other causes, second places, checks of a mark": [(measure.matching.match, "_result")],
    "pose": [(measure.fiducials.stages, "named"), (measure.fiducials.measurement, "named")],
}
_COMMAND = "from pipeline.main import main; main()"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=11500, help="of the large scan, px")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        large = rendered(folder, options.size)
        path = folder / "frame" / "scans" / "frame.tif"
        Storage(16, "lzw", "tiles").write(large.grey, path)
        draw(folder / "archive", 1, 2400)
        archive, small = folder / "archive" / "scans" / "box00" / "0000.tif", folder / "small.tif"
        grey = frame_picture(NUMBERED, pixel_from_camera("90m"))
        tifffile.imwrite(small, np.clip(np.rint(grey), 0, 65535).astype(np.uint16))
        layout, pitch_um = read_camera(folder / "archive" / "camera.toml").layout(), 1000 * FRAME_MM / options.size
        print("scan | measured for the first time, s | again, s")
        for name, given in {
            f"{options.size} px, eight marks": (path, large.layout, pitch_um, "auto", LINEAR),
            "2400 px, eight marks": (archive, layout, 20.0, "0", LINEAR),
            "the same, its curve not known": (archive, layout, 20.0, "0", Tone.unknown()),
            "400 px, four marks": (small, NUMBERED, PITCH_UM, "auto", LINEAR),
        }.items():
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
                first, *again = process.submit(_spent_s, options.rounds, *given).result()
            print(f"{name} | {first:.3f} | {min(again):.3f}", flush=True)
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            spent = process.submit(_by_stage_s, options.rounds, path, large.layout, pitch_um).result()
        for stage, spent_s in spent.items():
            print(f"of these: {stage} | | {spent_s:.3f}")
        decode_s = min(_processor_s(lambda: tifffile.imread(path)) for _ in range(options.rounds))
        print(f"decoded whole | | {decode_s:.2f}", flush=True)
        print(f"reseau measure | {_command_s(folder / 'frame' / 'project.toml'):.2f} |")


def _spent_s(
    rounds: int, path: Path, layout: FiducialLayout, pitch_um: float, pose: str, tone: Tone
) -> tuple[float, ...]:
    cv2.setNumThreads(1)
    measured = partial(_measured, path, layout, pitch_um, pose, tone)
    return tuple(_processor_s(measured) for _ in range(1 + rounds))


def _measured(path: Path, layout: FiducialLayout, pitch_um: float, pose: str, tone: Tone) -> None:
    with open_scan(path) as scan:
        measure_fiducials(scan.replace_tone(tone), layout, (pitch_um, pitch_um), FiducialOptions(pose=pose))


def _by_stage_s(rounds: int, path: Path, layout: FiducialLayout, pitch_um: float) -> dict[str, float]:
    """Of the quickest of the rounds, what each stage takes without those that it calls."""
    cv2.setNumThreads(1)
    spent, within_s, every = defaultdict[str, float](float), [0.0], list[dict[str, float]]()

    def counted(stage: str, function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: Any, **named: Any) -> object:
            start_s = time.process_time()
            within_s.append(0.0)
            result = function(*arguments, **named)
            whole_s = time.process_time() - start_s
            spent[stage] += whole_s - within_s.pop()
            within_s[-1] += whole_s
            return result

        return call

    measured = counted("all else", _measured)
    with ExitStack() as patched:
        for stage, places in STAGES.items():
            for owner, name in places:
                patched.enter_context(patch.object(owner, name, counted(stage, getattr(owner, name))))
        for _ in range(1 + rounds):
            spent.clear()
            measured(path, layout, pitch_um, "auto", LINEAR)
            every.append(dict(spent))
    return min(every, key=lambda stages: sum(stages.values()))


def _processor_s(function: Callable[[], object]) -> float:
    start_s = time.process_time()
    function()
    return time.process_time() - start_s


def _command_s(project: Path) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-c", _COMMAND, "measure", str(project), "--workers", "1"]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
