"""Ablation of heuristics: the same images measured with each heuristic and without it.

Each row is one heuristic: its figure of merit with and without it.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from true_marks import KIND

import measure.fiducials.measure_frame as frame_measurement
import measure.targets.identification as targets
from adjust.linear_algebra import sparse_factor
from adjust.solution.adjustment import adjust
from benchmarks.dusty_marks import frame_of_disks
from benchmarks.faint_marks import drawn_frame, measured_faint
from benchmarks.harness import Row, replaced, rms
from benchmarks.large_networks import strip
from measure.flags import NO_REASON

Array = NDArray[np.float64]

SEED, LARGE_PX = 5, 0.5


def faint(count: int) -> str:
    """Marks at SNR 2, three of eight in a frame: number found, and RMS error."""
    rng, errors, of = np.random.default_rng(SEED), [], 0
    for _number in range(max(count // 6, 1)):
        frame = drawn_frame(KIND["ring-cross"], 1.6, rng)
        for mark, found, _noise in measured_faint(frame, 2.0, rng):
            of += 1
            errors += [] if found is None else [found.center_px - mark.place[:, 2]]
    return f"{len(errors)} of {of} found, {rms(errors):.4f} px"


def dusty_disks(count: int) -> str:
    """Small disks with dust: number measured with errors above half a pixel, and clean ones flagged."""
    rng, wrong, doubted, of = np.random.default_rng(SEED), 0, 0, 0
    for _number in range(max(count // 3, 1)):
        found, dusts = frame_of_disks((0.0, 0.05), (1.8, 3.5), (10.0, 30.0), (0.8, 1.3), rng)
        for each, dust in zip(found, dusts, strict=True):
            of += 1
            wrong += not each.flagged and float(np.hypot(*each.error_px)) > LARGE_PX
            doubted += each.flagged and dust == 0.0
    return f"{wrong} of {of} wrong and called measured, {doubted} clean ones doubted"


def one_front(count: int) -> str:
    """CPU time of the adjustment of a strip of images."""
    scene = strip(8 * count)
    start = time.process_time()
    adjust(scene.network, scene.start)
    return f"{time.process_time() - start:.2f} s for {8 * count} images"


def _lone(disks: Sequence[Any], _predicted: Sequence[Array]) -> list[Any]:
    return [NO_REASON for _ in disks]


Study = Callable[[int], str]
SWITCHED: dict[str, tuple[Study, Any, str, Any]] = {
    "faint marks": (faint, frame_measurement, "detect_faint_marks", lambda frame, _reach_px: frame),
    "dusty disks": (dusty_disks, targets, "dust_reasons", _lone),
    "fronts": (one_front, sparse_factor, "FRONT_COST", 1e30),
}


COLUMNS = {"heuristic": "", "with it": "", "without it": ""}


def cells(count: int = 24) -> Iterator[Row]:
    yield from ({"heuristic": name, "count": count} for name in SWITCHED)


def case(heuristic: str, count: int) -> Row:
    study, where, name, instead = SWITCHED[heuristic]
    kept = study(count)
    with replaced(where, name, instead):
        return {"with it": kept, "without it": study(count)}
