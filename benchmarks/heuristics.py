"""What each heuristic brings: the same pictures measured with it, and with it switched off.

python -m benchmarks heuristics [--only NAME] [--count 24]

Each row is one heuristic: the figure that it is there for, with it and without.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from true_marks import KIND

import measure.fiducials.measure_frame as frame_measurement
import measure.targets.identification as targets
from adjust.linear_algebra import fronts
from adjust.solution.adjustment import adjust
from benchmarks.dusty_marks import frame_of_disks
from benchmarks.faint_marks import drawn_frame, measured_faint
from benchmarks.large_networks import strip
from measure.flags import NO_REASON

Array = NDArray[np.float64]

SEED, SNR, LARGE_PX = 5, 20.0, 0.5


def faint(count: int) -> str:
    """Marks of a frame at twice the noise, three of eight: how many are found, and their rms error."""
    rng, errors, of = np.random.default_rng(SEED), [], 0
    for _number in range(max(count // 6, 1)):
        frame = drawn_frame(KIND["ring-cross"], 1.6, rng)
        for mark, found, _noise in measured_faint(frame, 2.0, rng):
            of += 1
            errors += [] if found is None else [found.center_px - mark.place[:, 2]]
    return f"{len(errors)} of {of} found, {_rms(errors)} px"


def dusty_disks(count: int) -> str:
    """Small disks among dust: those called measured that lie more than half a pixel off, and good ones doubted."""
    rng, wrong, doubted, of = np.random.default_rng(SEED), 0, 0, 0
    for _number in range(max(count // 3, 1)):
        found, dusts = frame_of_disks((0.0, 0.05), (1.8, 3.5), (10.0, 30.0), (0.8, 1.3), rng)
        for each, dust in zip(found, dusts, strict=True):
            of += 1
            wrong += not each.flagged and float(np.hypot(*each.error_px)) > LARGE_PX
            doubted += each.flagged and dust == 0.0
    return f"{wrong} of {of} wrong and called measured, {doubted} clean ones doubted"


def one_front(count: int) -> str:
    """A strip of images: CPU seconds of its adjustment."""
    scene = strip(8 * count)
    start = time.process_time()
    adjust(scene.network, scene.start)
    return f"{time.process_time() - start:.2f} s for {8 * count} images"


def _rms(errors: Sequence[Array]) -> str:
    return f"{np.sqrt(np.nanmean(np.square(errors))):.4f}" if len(errors) else "-"


@contextmanager
def put(where: Any, name: str, instead: Any) -> Iterator[None]:
    """Another value in the place of one, for a while."""
    before = getattr(where, name)
    setattr(where, name, instead)
    try:
        yield
    finally:
        setattr(where, name, before)


def _lone(disks: Sequence[Any], _predicted: Sequence[Array]) -> list[Any]:
    return [NO_REASON for _ in disks]


Study = Callable[[int], str]
SWITCHED: dict[str, tuple[Study, Any, str, Any]] = {
    "faint marks": (faint, frame_measurement, "detect_faint_marks", lambda frame, _reach_px: frame),
    "dusty disks": (dusty_disks, targets, "doubts", _lone),
    "fronts": (one_front, fronts, "FRONT_COST", 1e30),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", choices=SWITCHED)
    parser.add_argument("--count", type=int, default=24)
    given = parser.parse_args()
    for name, (study, where, what, instead) in SWITCHED.items():
        if given.only in (None, name):
            run = partial(study, given.count)
            kept = run()
            with put(where, what, instead):
                print(f"| {name} | {kept} | {run()} |", flush=True)


if __name__ == "__main__":
    main()
