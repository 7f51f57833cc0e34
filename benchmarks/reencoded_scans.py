"""Real scans stored anew by other tone curves: their marks have to stay where they are.

    python benchmarks/reencoded_scans.py FOLDER [--linear]

FOLDER holds the frames of aerial film (film_scans/aerial of the test data). Each is decoded and coded anew, in 16 bits,
by light = code ** 2.2 and by its inverse, so that what the scanner coded with one curve now has three. Every copy is
measured by itself, with nothing said of its curve; --linear takes grey values as light, as a comparison. Told are the
differences of places between the copies in their own standard deviations: those without what the copies share, film
and grain, which moves no copy against another.
"""

import argparse
from itertools import combinations
from pathlib import Path

import numpy as np

from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.results import FrameMeasurement
from measure.scans.picture_scan import WholePicture
from measure.scans.resolution import NO_TAGS
from measure.scans.scan import Scan, open_scan
from measure.scans.tone import LINEAR, Tone
from pipeline.files.camera_file import read_camera
from pipeline.files.library import camera_path

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


def copies(scan: Scan) -> dict[str, Scan]:
    """The scan coded anew by each power, in 16 bits."""
    samples = scan.samples(0, 0, scan.width_px, scan.height_px) / scan.full_scale_dn
    return {
        name: Scan(scan.path, WholePicture(np.rint(65535 * samples**power).astype(np.uint16)), NO_TAGS)
        for name, power in POWERS.items()
    }


def measured(scan: Scan, camera: str, tone: Tone) -> FrameMeasurement:
    layout = read_camera(camera_path(f"library:{camera}", Path())).layout()
    return measure_fiducials(scan.seen_through(tone), layout, None, FiducialOptions(pose="0"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--linear", action="store_true")
    parser.add_argument("--frame", default="")
    options = parser.parse_args()
    tone = LINEAR if options.linear else Tone.unknown()
    for frame, camera in CAMERAS.items():
        if options.frame not in frame:
            continue
        with open_scan(options.folder / f"{frame}.jpeg") as scan:
            results = {name: measured(copy, camera, tone) for name, copy in copies(scan).items()}
        for name, result in results.items():
            curve = result.tone.tone if result.tone else "no frame"
            statuses = ", ".join(f"{mark.point} {mark.status}" for mark in result.marks if mark.center_px is not None)
            print(f"{frame} {name:>8}: {curve}; {statuses}", flush=True)
        for one, other in combinations(results, 2):
            for a, b in zip(results[one].marks, results[other].marks, strict=True):
                if not (a.status.is_observation and b.status.is_observation):
                    continue
                off = np.asarray(a.center_px) - np.asarray(b.center_px)
                known = [np.asarray(mark.covariance_px2) for mark in (a, b)]
                sigmas = [float(np.sqrt(off @ np.linalg.solve(each, off))) for each in known]
                print(
                    f"  {one:>8} - {other:<5} mark {a.point}: {off[0]:+.3f} {off[1]:+.3f} px, "
                    f"{sigmas[0]:.1f} and {sigmas[1]:.1f} of their sigmas {a.covariance} {b.covariance}"
                )


if __name__ == "__main__":
    main()
