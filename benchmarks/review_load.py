"""Review in a real browser: response time to the next mark, memory of the server, keys and time per decision.

Tiled scans with eight ring-crosses each, one of them scratched, are measured, and all are reviewed with one key per
mark. With --scans: a results database of so many stand-ins (50,000, say), each with a weak mark and all linked to one
large file, and a decisions file on --decided of them; fifty more are decided. Requires Chromium.
"""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from browser import started_browser
from playwright.sync_api import Page

from benchmarks.archive_stand_ins import USE, write_project
from benchmarks.harness import START, Row, reseau
from benchmarks.object_measuring import PITCH_UM, camera_text, drawn_frame
from pipeline.files.camera_file import read_camera

DECIDED_HERE = 50  # decisions in an archive
LOOKED_MS = 400  # ms, shortest time that a person looks at a mark; the next one is fetched meanwhile
BEYOND_MM = 8.0  # mm, distance of the marks from the scan's edge
SCRATCH_PX = (-20, 30)  # px, columns of a scratch, from the mark's centre
COLUMNS = {
    "decided": "d", "ready_s": ".1f", "opened_s": ".2f", "mb": ".0f", "clock_s": ".1f", "median_ms": ".0f",
    "most_of_ms": ".0f", "longest_ms": ".0f",
}  # fmt: skip


def case(seed: int, frames: int = 20, side: int = 11_500, scans: int = 0, decided: int = 0) -> Row:
    with TemporaryDirectory() as name:
        folder = Path(name)
        if scans:
            return review(archive(folder, scans, decided, side, seed), DECIDED_HERE)
        project = written(folder, frames, side, seed)
        reseau("measure", project)
        return review(project, frames)


def archive(folder: Path, scans: int, decided: int, side: int, seed: int) -> Path:
    """Project of stand-ins, linked to one scan."""
    project = write_project(folder, scans)
    reseau("measure", project, before=USE, environment={"RESEAU_STAND_IN_WEAK": "1"})
    (folder / "one").mkdir()
    written(folder / "one", 1, side, seed)
    files = sorted((folder / "scans").rglob("*.tif"))
    for file in files:
        file.unlink()
        file.symlink_to(folder / "one" / "0000.tif")
    with (folder / "decisions.jsonl").open("w") as result:
        for file in files[:decided]:
            image = file.relative_to(folder / "scans").with_suffix("").as_posix()
            line = {"image": image, "decision": "accept", "point": "1", "kind": "fiducial", "who": "ann"}
            result.write(json.dumps(line) + "\n")
    return project


def written(folder: Path, frames: int, side: int, seed: int) -> Path:
    """Write the project: frames of grainy film with a scratch across the first mark."""
    edge_mm = side * PITCH_UM / 2000 - BEYOND_MM
    (folder / "camera.toml").write_text(camera_text(edge_mm), encoding="utf-8")
    layout = read_camera(folder / "camera.toml").layout()
    col, row = (
        round(side / 2 + sign * layout.marks[0].xy_mm[axis] / PITCH_UM * 1000) for axis, sign in ((0, 1), (1, -1))
    )
    for number in range(frames):
        grey = drawn_frame(layout, side, np.random.default_rng([seed, number]))
        grey[row - 60 : row + 60, col + SCRATCH_PX[0] : col + SCRATCH_PX[1]] = 255
        tifffile.imwrite(folder / f"{number:04}.tif", grey, tile=(256, 256), compression="zlib")
    project = folder / "project.toml"
    project.write_text(f'camera = "camera.toml"\nscans = ["*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n')
    return project


def review(project: Path, most: int) -> Row:
    """Accept `most` marks one after another."""
    began = time.monotonic()
    with served_page(project) as (page, address, server):
        ready_s, began = time.monotonic() - began, time.monotonic()
        page.goto(address)
        page.wait_for_selector("#mark-view:not([hidden])")
        opened_s = time.monotonic() - began
        next_ms = [1000 * decide_next(page) for _ in range(most - 1)]
        page.keyboard.press("a")
        clock_s = time.monotonic() - began
        page.wait_for_timeout(1000)
        status = Path(f"/proc/{server}/status").read_text(encoding="ascii")
    return {
        "decided": most, "ready_s": ready_s, "opened_s": opened_s, "clock_s": clock_s,
        "mb": int(status.split("VmHWM:")[1].split()[0]) / 1024, "median_ms": np.median(next_ms),
        "most_of_ms": np.quantile(next_ms, 0.9), "longest_ms": max(next_ms),
    }  # fmt: skip


@contextmanager
def served_page(project: Path) -> Iterator[tuple[Page, str, int]]:
    """Serve the review of a project; yields an empty page, the address, and the server's process id."""
    command = [sys.executable, "-c", START, "review", str(project), "--no-browser", "--who", "ann"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, started_browser() as browser:
        assert server.stdout is not None
        try:
            page = browser.new_context(viewport={"width": 1300, "height": 900}, bypass_csp=True).new_page()
            yield page, server.stdout.readline().strip(), server.pid
        finally:
            server.kill()


def decide_next(page: Page) -> float:
    """Press a key; returns the seconds until the next mark is shown."""
    page.wait_for_timeout(LOOKED_MS)
    title = page.inner_text("#title")
    began = time.monotonic()
    page.keyboard.press("a")
    page.wait_for_function(
        "title => document.getElementById('title').textContent !== title"
        " && !document.getElementById('mark-view').hidden && document.activeElement.id === 'mark'",
        arg=title,
        polling=5,
    )
    return time.monotonic() - began
