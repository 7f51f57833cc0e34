"""Fiducials of the available real film scans, mark by mark: regression test of changes of `measure`.

Each scan is measured alone, with automatic pose, and checked as a camera of one frame. --keep writes all marks to a
file; --against names such a file, and marks whose status differs or whose place differs by more than 0.005 px are
listed, and problems that differ. --tone linear takes grey values as light. --pictures names a folder for a picture per
scan of all marks that are not `measured`, with the reason.
"""

import json
import textwrap
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.harness import DATA, Row
from measure.fiducials.across_frames import check_frames
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, cross
from measure.results import FrameMeasurement
from measure.scans.opening import open_scan
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR, Tone
from pipeline.files.camera_file import read_camera
from pipeline.files.library import camera_path

MOVED_PX = 0.005
HALF_PX, SHOWN_PX, WORDS_PX, COLUMNS_SHOWN = 40, 320, 110, 4  # of the pictures of marks: half a window, enlarged
CAMERAS = {
    "0b4cb981": "zeiss-rmk-a-153",
    "000b3b38": "wild-rc10-153",
    "08320661": "wild-rc10-153",
    "0b50b18e": "wild-rc10-153",
    "0a9a8c55": "register-glass-262",
    "0cec8b13": "wild-rc8-153",
    "d2ee9cf2": "wild-rc8-153",
}
COLUMNS = {"scan": "", "found": "d", "of": "d", "measured": "d", "sigma_px": ".4f", "cpu_s": ".1f"}


class Task(NamedTuple):
    """Scan with its camera's marks and its pixel pitch; None: pitch of the file."""

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
    """Layout of 5 x 5 crosses, 10 mm apart, on 70 mm film."""
    shape, index = MarkShape(cross(0.97, 0.05), "dark"), range(-2, 3)
    marks = [LayoutMark(f"{i},{j}", (10.0 * i, 10.0 * j), (0.005, 0.005), shape) for j in index for i in index]
    return FiducialLayout(tuple(marks), (53.0, 53.0))


def cells() -> Iterator[Row]:
    yield from ({"scan": task.name} for task in tasks(DATA))


def case(scan: str, tone: str = "auto", against: str | None = None, pictures: str | None = None) -> Row:
    task = next(task for task in tasks(DATA) if task.name == scan)
    start_s = time.process_time()
    with open_scan(task.scan) as opened:
        pitch_um = task.pitch_um or opened.pitch_um
        shown = opened.replace_tone(LINEAR if tone == "linear" else Tone.unknown())
        frame = measure_fiducials(shown, task.layout, pitch_um, FiducialOptions())
        frame = check_frames([frame], task.layout, [pitch_um or (1.0, 1.0)]).frames[0]
        cpu_s = time.process_time() - start_s
        if pictures:
            picture_marks(opened, frame, Path(pictures) / f"{scan}.png")
    marks: dict[str, Row] = {
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
    claims = [mark["sigma_px"] for mark in marks.values() if mark["status"] == "measured"]
    row = {
        "found": len(claims) + sum(mark["status"] == "weak" for mark in marks.values()),
        "of": len(marks),
        "measured": len(claims),
        "sigma_px": float(np.mean(claims)) if claims else None,
        "cpu_s": cpu_s,
        "marks": marks,
        "problems": [str(problem) for problem in frame.problems],
    }
    return {**row, "changes": changes(_kept_row(Path(against), scan), row) if against else []}


def picture_marks(scan: Scan, frame: FrameMeasurement, path: Path) -> None:
    """Write an image of the marks that are not `measured`, each about its place, with its status and reason."""
    tiles = []
    for mark in frame.marks:
        if mark.status is Status.MEASURED:
            continue
        tile = np.full((SHOWN_PX + WORDS_PX, SHOWN_PX), 255, np.uint8)
        if mark.center_px is not None:
            col0, row0 = (round(float(place)) - HALF_PX for place in mark.center_px)
            grey = scan.samples(col0, row0, 2 * HALF_PX + 1, 2 * HALF_PX + 1)[..., 0].astype(np.float32)
            shown = cv2.normalize(grey, np.empty(0), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
            tile[:SHOWN_PX] = cv2.resize(shown, (SHOWN_PX, SHOWN_PX), interpolation=cv2.INTER_NEAREST)
        for number, text in enumerate(textwrap.wrap(f"{mark.point} {mark.status}: {mark.reason}", 52)[:7]):
            cv2.putText(tile, text, (2, SHOWN_PX + 14 * (number + 1)), cv2.FONT_HERSHEY_PLAIN, 0.72, 0, 1, cv2.LINE_AA)
        tiles.append(tile)
    if tiles:
        tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS_SHOWN)
        rows = [np.hstack(tiles[first : first + COLUMNS_SHOWN]) for first in range(0, len(tiles), COLUMNS_SHOWN)]
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.vstack(rows))


def _kept_row(kept: Path, scan: str) -> Row:
    rows = (dict(json.loads(text)[1]) for text in kept.read_text(encoding="utf-8").splitlines())
    return next((row for row in rows if row["scan"] == scan), {"marks": {}, "problems": []})


def changes(before: Row, after: Row) -> list[str]:
    """Lines of the marks whose results differ, and of the frame's problems that are new or gone."""
    lines = [f"problem gone: {each}" for each in before["problems"] if each not in after["problems"]]
    lines += [f"problem new: {each}" for each in after["problems"] if each not in before["problems"]]
    for point in before["marks"].keys() & after["marks"].keys():
        old, new = before["marks"][point], after["marks"][point]
        places = old["place_px"], new["place_px"]
        moved_px = float(np.hypot(*np.subtract(*places))) if all(places) else np.nan
        if old["status"] != new["status"] or moved_px > MOVED_PX:
            sigmas = f"{old['sigma_px']} -> {new['sigma_px']} px"
            lines.append(f"{point}: {old['status']} -> {new['status']}, moved {moved_px:.3f} px, sigma {sigmas}")
    return sorted(lines)


def report(rows: Sequence[Row]) -> list[str]:
    return [f"{row['scan']} {line}" for row in rows for line in row["changes"]]
