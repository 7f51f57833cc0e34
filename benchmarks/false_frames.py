"""How often a scan without the camera's marks is taken for one of its frames.

python -m benchmarks false_frames [--frames 60] [--first 0] [--seed 11]

The frames of `search.py`, every other one painted without its marks and searched for its own camera, and the rest with
their marks, but searched for a camera with marks of another kind. Whatever is found is false. The pitch is given, right
by 1 %: as the frame is not there, a search goes on to other pitches and to the closer look.
"""

import argparse
import time
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np

from benchmarks.search_frames import PITCH_UM, Case, draw_case
from measure.fiducials.measurement import measure_fiducials
from measure.flags import Status
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan


@dataclass(frozen=True)
class Alarm:
    """measured, weak: how many marks of a frame have the status."""

    measured: int
    weak: int


def main() -> None:
    """Tell the false frames, and count."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=11)
    given = parser.parse_args()
    alarms: list[Alarm] = []
    begin = time.process_time()
    for index in range(given.first, given.first + given.frames):
        case = bare(given.seed, index) if index % 2 == 0 else strange(given.seed, index)
        alarms.append(searched(case))
        if alarms[-1].measured or alarms[-1].weak:
            print(f"frame {index} ({case.kind}, {case.picture}): {alarms[-1]}", flush=True)
        if len(alarms) % 10 == 0:
            print(summary(alarms), f"{time.process_time() - begin:.0f} s", flush=True)
    print(summary(alarms))


def bare(seed: int, index: int) -> Case:
    """A frame painted without its marks."""
    case = draw_case(seed, index)
    grey = np.round(case.without_marks()).astype(np.uint16)
    return replace(case, scan=Scan(Path(f"{index}.tif"), WholePicture(grey[..., None]), NO_TAGS))


def strange(seed: int, index: int) -> Case:
    """A frame that is searched for the camera of the next one whose marks are of another kind."""
    case = draw_case(seed, index)
    others = (draw_case(seed, other) for other in count(index + 1))
    return replace(case, layout=next(other.layout for other in others if other.kind != case.kind))


def searched(case: Case) -> Alarm:
    found = measure_fiducials(case.scan, case.layout, (PITCH_UM, PITCH_UM))
    statuses = [mark.status for mark in found.marks]
    return Alarm(statuses.count(Status.MEASURED), statuses.count(Status.WEAK))


def summary(alarms: list[Alarm]) -> str:
    return (
        f"{len(alarms)} frames; with measured marks {sum(a.measured > 0 for a in alarms)}, "
        f"with weak marks alone {sum(a.weak > 0 and not a.measured for a in alarms)}"
    )


if __name__ == "__main__":
    main()
