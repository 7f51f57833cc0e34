"""Real scans stored anew by other tone curves: their marks have to stay where they are.

    python -m benchmarks reencoded_scans FOLDER [--linear] [--frame NAME]

FOLDER holds the frames of aerial film (film_scans/aerial of the test data). Each is decoded and coded anew, in 16 bits,
by light = code ** 2.2 and by its inverse, so that what the scanner coded with one curve now has three. Every copy is
measured and judged by itself, with nothing said of its curve; --linear takes grey values as light, as a comparison.
Told is how far each mark lies elsewhere in one copy than in another, in px and in the standard deviations of both
claims together, but for the film, which is the same in all copies; with its statuses. Then the largest of each frame,
of marks `measured` in both copies and of all.
"""

import argparse
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from measure.fiducials.across_frames import check_frames
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Cause, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.opening import open_scan
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR, Tone
from pipeline.files.camera_file import read_camera
from pipeline.files.library import camera_path

Array = NDArray[np.float64]

CAMERAS = {
    "0b4cb981": "zeiss-rmk-a-153",
    "000b3b38": "wild-rc10-153",
    "08320661": "wild-rc10-153",
    "0b50b18e": "wild-rc10-153",
    "0a9a8c55": "register-glass-262",
    "0cec8b13": "wild-rc8-153",
    "d2ee9cf2": "wild-rc8-153",
}
POWERS = {"as it is": 1.0, "2.2": 2.2, "1/2.2": 1 / 2.2}


class Row(NamedTuple):
    """A mark in two copies: how far apart, and that in the standard deviations of both claims together."""

    frame: str
    copies: str
    point: str
    statuses: tuple[Status, Status]
    px: float
    sigmas: float


def copies(scan: Scan) -> dict[str, Scan]:
    """The scan coded anew by each power, in 16 bits."""
    samples = scan.samples(0, 0, scan.width_px, scan.height_px) / scan.full_scale_dn
    return {
        name: Scan(scan.path, WholePicture(np.rint(65535 * samples**power).astype(np.uint16)), NO_TAGS)
        for name, power in POWERS.items()
    }


def measured(scan: Scan, camera: str, tone: Tone, pitch_um: tuple[float, float] | None) -> FrameMeasurement:
    layout = read_camera(camera_path(f"library:{camera}", Path())).layout()
    frame = measure_fiducials(scan.replace_tone(tone), layout, pitch_um, FiducialOptions(pose="0"))
    return check_frames([frame], layout, [pitch_um or (1.0, 1.0)]).frames[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--linear", action="store_true")
    parser.add_argument("--frame", default="")
    options = parser.parse_args()
    tone = LINEAR if options.linear else Tone.unknown()
    rows: list[Row] = []
    for frame, camera in CAMERAS.items():
        if options.frame not in frame:
            continue
        with open_scan(options.folder / f"{frame}.jpeg") as scan:
            results = {name: measured(copy, camera, tone, scan.pitch_um) for name, copy in copies(scan).items()}
        for name, result in results.items():
            curve = result.tone.tone if result.tone else "no frame"
            statuses = ", ".join(f"{mark.point} {mark.status}" for mark in result.marks if mark.center_px is not None)
            print(f"{frame} {name:>8}: {curve}; {statuses}", flush=True)
        rows += differences(frame, results)
    print_table(rows)


def differences(frame: str, results: Mapping[str, FrameMeasurement]) -> list[Row]:
    """One for each mark that two copies have."""
    return [
        _row(frame, f"{one} - {other}", a, b)
        for one, other in combinations(results, 2)
        for a, b in zip(results[one].marks, results[other].marks, strict=True)
        if a.status.is_observation and b.status.is_observation
    ]


def _row(frame: str, copies: str, a: MarkMeasurement, b: MarkMeasurement) -> Row:
    assert a.center_px is not None
    assert b.center_px is not None
    off = np.asarray(a.center_px) - np.asarray(b.center_px)
    sigmas = float(np.sqrt(off @ np.linalg.solve(_of_copy(a) + _of_copy(b), off)))
    return Row(frame, copies, a.point, (a.status, b.status), float(np.hypot(*off)), sigmas)


def _of_copy(mark: MarkMeasurement) -> Array:
    """(2, 2) px2, without what all copies share."""
    assert mark.covariance is not None
    return Covariance({cause: part for cause, part in mark.covariance.parts.items() if cause is not Cause.FILM}).px2


def print_table(rows: Sequence[Row]) -> None:
    print(f"\n{'frame':10}{'copies':18}{'mark':6}{'statuses':22}{'px':>7}{'sigmas':>8}")
    for row in rows:
        statuses = ", ".join(row.statuses)
        print(f"{row.frame:10}{row.copies:18}{row.point:6}{statuses:22}{row.px:7.3f}{row.sigmas:8.1f}")
    print(f"\n{'largest differences':36}{'pairs':>6}{'px':>8}{'sigmas':>8}")
    for frame in dict.fromkeys(row.frame for row in rows):
        for least in (2, 0):
            some = [row for row in rows if row.frame == frame and row.statuses.count(Status.MEASURED) >= least]
            name = f"{frame}, {'measured in both' if least else 'all'}"
            worst = (max((row.px for row in some), default=0.0), max((row.sigmas for row in some), default=0.0))
            print(f"{name:36}{len(some):6}{worst[0]:8.3f}{worst[1]:8.1f}")


if __name__ == "__main__":
    main()
