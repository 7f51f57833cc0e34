"""Every fiducial of the real film at hand, mark by mark: the ground on which a change of `measure` is judged.

    python -m benchmarks real_film DATA [--keep FILE.json] [--against FILE.json] [--frame NAME] [--tone linear]

DATA is the folder of real scans: film_scans/aerial, reseau, reseau_sharpened, coarse, and film_rendered. Each scan is
measured alone, with its orientation open, and checked as a camera of one frame. A row a scan: marks found, `measured`,
their mean standard deviation, CPU seconds. --keep writes every mark to a file; --against compares with such a file and
prints each mark whose status differs, or whose place differs by more than 0.005 px.
"""

import argparse
import json
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.reencoded_scans import CAMERAS
from measure.fiducials.across_frames import check_frames
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross
from measure.results import Covariance
from measure.scans.opening import open_scan
from measure.tone.curve import LINEAR, Tone
from pipeline.files.camera_file import read_camera
from pipeline.files.library import camera_path

MOVED_PX = 0.005


class Task(NamedTuple):
    """A scan, the camera whose marks it shows, and its pixel pitch; None takes the file's."""

    name: str
    scan: Path
    layout: FiducialLayout
    pitch_um: tuple[float, float] | None


def tasks(data: Path) -> Iterator[Task]:
    film = data / "film_scans"
    for name, camera in CAMERAS.items():
        yield Task(name, film / "aerial" / f"{name}.jpeg", layout(f"library:{camera}", Path()), None)
    for number in (11, 14, 15, 16, 17):
        yield Task(f"apollo-{number}", film / "reseau" / f"apollo-{number}.jpg", reseau(), (27.4, 27.4))
    for name in ("apollo15-HFE", "apollo17-HFE"):
        yield Task(name, film / "reseau_sharpened" / f"{name}.jpg", reseau(), (22.0, 22.0))
    coarse = layout("library:fairchild-t12-notch-152", Path())
    yield Task("coarse", film / "coarse" / "tma2161_0293.png", coarse, (313.0, 313.0))
    for folder in sorted((data / "film_rendered").iterdir()):
        pitch_um = float(tomllib.loads((folder / "project.toml").read_text())["pitch_um"])
        yield Task(folder.name, folder / "s.tif", layout("camera.toml", folder), (pitch_um, pitch_um))


def layout(camera: str, folder: Path) -> FiducialLayout:
    return read_camera(camera_path(camera, folder)).layout()


def reseau() -> FiducialLayout:
    """Five by five crosses, 10 mm apart, on 70 mm film."""
    shape, index = MarkShape(cross(0.97, 0.05), "dark"), range(-2, 3)
    marks = [LayoutMark(f"{i},{j}", (10.0 * i, 10.0 * j), (0.005, 0.005), shape) for j in index for i in index]
    return FiducialLayout(tuple(marks), (53.0, 53.0))


def measure_scan(task: Task, tone: Tone) -> dict[str, Any]:
    begun = time.process_time()
    with open_scan(task.scan) as scan:
        pitch_um = task.pitch_um or scan.pitch_um
        frame = measure_fiducials(scan.replace_tone(tone), task.layout, pitch_um, FiducialOptions())
    frame = check_frames([frame], task.layout, [pitch_um or (1.0, 1.0)]).frames[0]
    marks = {
        mark.point: {
            "status": str(mark.status),
            "place_px": None if mark.center_px is None else np.round(mark.center_px, 4).tolist(),
            "sigma_px": None
            if mark.covariance is None
            else round(float(np.sqrt(np.trace(mark.covariance.px2) / 2)), 4),
            "reason": str(mark.reason),
        }
        for mark in frame.marks
    }
    problems = [str(problem) for problem in frame.problems]
    return {"marks": marks, "problems": problems, "seconds": round(time.process_time() - begun, 1)}


def sigma_px(covariance: Covariance) -> float:
    return round(float(np.sqrt(np.trace(covariance.px2) / 2)), 4)


def print_row(name: str, result: dict[str, Any]) -> None:
    marks = result["marks"].values()
    observed = [mark for mark in marks if mark["status"] in ("measured", "weak")]
    plain = [mark["sigma_px"] for mark in observed if mark["status"] == "measured"]
    mean = f"{np.mean(plain):.4f}" if plain else "-"
    print(
        f"{name:16} {len(observed):3} of {len(marks):3} {len(plain):9} {mean:>9} {result['seconds']:8.1f}", flush=True
    )


def print_changes(name: str, before: dict[str, Any], after: dict[str, Any]) -> None:
    for point, new in after["marks"].items():
        old = before["marks"].get(point, {"status": "none", "place_px": None, "sigma_px": None})
        places = old["place_px"], new["place_px"]
        moved = float(np.hypot(*np.subtract(*places))) if all(places) else np.nan
        if old["status"] != new["status"] or moved > MOVED_PX:
            sigmas = f"{old['sigma_px']} -> {new['sigma_px']} px"
            print(f"    {name} {point}: {old['status']} -> {new['status']}, moved {moved:.3f} px, sigma {sigmas}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--frame", default="")
    parser.add_argument("--tone", choices=("auto", "linear"), default="auto")
    options = parser.parse_args()
    tone = LINEAR if options.tone == "linear" else Tone.unknown()
    before = json.loads(options.against.read_text()) if options.against else {}
    results = {}
    print(f"{'scan':16} {'found':>10} {'measured':>9} {'sigma px':>9} {'CPU s':>8}")
    for task in tasks(options.data):
        if options.frame in task.name:
            results[task.name] = measure_scan(task, tone)
            print_row(task.name, results[task.name])
            if task.name in before:
                print_changes(task.name, before[task.name], results[task.name])
            if options.keep:
                options.keep.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
