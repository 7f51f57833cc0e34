"""Review in a real browser: response time to the next mark, memory of the server, keys and time per decision.

    python -m benchmarks review_load [FRAMES] [SIDE_PX]
    python -m benchmarks review_load --archive [SCANS] [DECIDED]

Renders FRAMES (20) tiled scans of SIDE_PX (11500) with four ring-crosses each, one of them scratched, measures them,
and reviews all of them with one key per mark. With --archive: a results database of SCANS (50000) stand-ins, each with
a weak mark and all linked to one large file, and a decisions file on DECIDED (25000) of them; fifty more are decided.
Requires Chromium.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from imagecodecs import zlib_encode
from numpy.typing import NDArray
from playwright.sync_api import Page, sync_playwright

from benchmarks.archive_stand_ins import write_project

TILE_PX = 256
PITCH_UM = 20.0
SEED = 7
GRAIN_DN, GROUND_DN, CONTRAST_DN = 3.0, 60.0, 120.0
DECIDED_HERE = 50  # decisions in an archive
LOOKED_MS = 400  # ms, shortest time that a person looks at a mark; the next one is fetched meanwhile
OTHER_TILES = 64  # different tiles of grain
START = "from pipeline.main import main; main()"
Tile = NDArray[np.uint8]


@dataclass(frozen=True)
class Reviewed:
    """Times of a review: until the page was open, from each key until the next mark was shown, and in total."""

    opened_s: float
    next_s: list[float]
    clock_s: float


def main(frames: int, side_px: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        project = written(Path(name), frames, side_px)
        subprocess.run([sys.executable, "-c", START, "measure", str(project)], check=False, capture_output=True)
        print(f"{frames} frames of {side_px} px, seed {SEED}")
        review(project, frames)


def archive(scans: int, decided: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        project = write_project(folder, scans)
        own = "import sys; sys.path.insert(0, sys.argv.pop(1)); import archive_stand_ins; archive_stand_ins.use(); "
        command = [sys.executable, "-c", own + START, str(Path(__file__).parent), "measure", str(project)]
        environment = {**os.environ, "RESEAU_STAND_IN_WEAK": "1"}
        done = subprocess.run(command, check=False, capture_output=True, env=environment)
        if done.returncode not in (0, 1):
            raise SystemExit(done.stderr.decode())
        (folder / "one").mkdir()
        written(folder / "one", 1, 11500)
        files = sorted((folder / "scans").rglob("*.tif"))
        for file in files:
            file.unlink()
            file.symlink_to(folder / "one" / "0000.tif")
        images = [file.relative_to(folder / "scans").with_suffix("").as_posix() for file in files]
        with (folder / "decisions.jsonl").open("w") as result:
            for image in images[:decided]:
                line = {"image": image, "decision": "accept", "point": "1", "kind": "fiducial", "who": "ann"}
                result.write(json.dumps(line) + "\n")
        print(f"{scans} stand-ins, {decided} of them decided before")
        review(project, DECIDED_HERE)


def review(project: Path, most: int) -> None:
    command = [sys.executable, "-c", START, "review", str(project), "--no-browser", "--who", "ann"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        began = time.monotonic()
        address = server.stdout.readline().strip()
        ready_s = time.monotonic() - began
        try:
            done = reviewed(address, most)
            memory_mb = peak_mb(server.pid)
        finally:
            server.kill()
    next_ms = 1000 * np.array(done.next_s)
    print(
        f"server ready after {ready_s:.1f} s, page open after {done.opened_s:.2f} s, server's memory {memory_mb:.0f} MB"
    )
    print(
        f"marks decided: {len(next_ms) + 1}, one key each, {done.clock_s:.1f} s, of which {LOOKED_MS} ms a mark to look"
    )
    median, most_ms = np.median(next_ms), next_ms.max()
    print(f"next mark, ms: median {median:.0f}, 90 % {np.quantile(next_ms, 0.9):.0f}, most {most_ms:.0f}")


def written(folder: Path, frames: int, side_px: int) -> Path:
    """Write the project: marks in the corners of a uniform frame with grain, the third one scratched."""
    mm = side_px * PITCH_UM / 1000.0
    at_mm = mm / 2 - 8.0
    corners = [(at_mm, -at_mm), (-at_mm, -at_mm), (-at_mm, at_mm), (at_mm, at_mm)]
    text = f'name = "K"\nframe_mm = [{mm - 12}, {mm - 12}]\nprincipal_distance_mm = 150.0\n'
    for number, (x, y) in enumerate(corners, 1):
        text += f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.01\nmark = "m"\n'
    text += '[mark.m]\nkind = "ring-cross"\nring_mm = 0.5\nring_line_mm = 0.1\narm_mm = 0.8\nline_mm = 0.1\n'
    (folder / "camera.toml").write_text(text, encoding="utf-8")
    rng = np.random.default_rng(SEED)
    grain = [grain_tile(rng) for _ in range(OTHER_TILES)]
    encoded = [bytes(zlib_encode(tile.tobytes())) for tile in grain]
    side = -(-side_px // TILE_PX)
    for number in range(frames):
        chosen = rng.integers(OTHER_TILES, size=(side, side))
        own = dict[tuple[int, int], Tile]()
        for index, (x, y) in enumerate(corners):
            col, row = (side_px - 1) / 2 + x / PITCH_UM * 1000, (side_px - 1) / 2 - y / PITCH_UM * 1000
            draw(own, grain, chosen, col, row + 0.3 * number / frames, index == 2)
        tifffile.imwrite(
            folder / f"{number:04}.tif",
            tiles(own, encoded, chosen),
            shape=(side_px, side_px),
            dtype=np.uint8,
            tile=(TILE_PX, TILE_PX),
            compression="zlib",
            photometric="minisblack",
        )
    project = folder / "project.toml"
    project.write_text(f'camera = "camera.toml"\nscans = ["*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n')
    return project


def grain_tile(rng: np.random.Generator) -> Tile:
    return np.clip(rng.normal(GROUND_DN, GRAIN_DN, (TILE_PX, TILE_PX)), 0, 255).astype(np.uint8)


def tiles(own: dict[tuple[int, int], Tile], encoded: list[bytes], chosen: NDArray[np.int64]) -> Iterator[bytes]:
    """Yield compressed tiles row by row, so that no scan is in memory."""
    for place in np.ndindex(chosen.shape):
        mark = own.get((place[0], place[1]))
        yield encoded[chosen[place]] if mark is None else bytes(zlib_encode(mark.tobytes()))


def draw(
    own: dict[tuple[int, int], Tile],
    grain: list[Tile],
    chosen: NDArray[np.int64],
    col: float,
    row: float,
    is_scratched: bool,
) -> None:
    """Draw a ring-cross into the tiles that it touches; edges are smoothed over one pixel by the distance from the
    lines."""
    half, scale = 60, 1000.0 / PITCH_UM
    first_col, first_row = round(col) - half, round(row) - half
    rows, cols = np.mgrid[first_row : first_row + 2 * half, first_col : first_col + 2 * half]
    u, v = (cols - col) / scale, (rows - row) / scale
    ring = np.abs(np.hypot(u, v) - 0.5) - 0.05
    bars = [np.maximum(np.abs(a) - 0.8, np.abs(b) - 0.05) for a, b in ((u, v), (v, u))]
    light = CONTRAST_DN * np.clip(0.5 - np.minimum(ring, np.minimum(*bars)) * scale, 0.0, 1.0)
    if is_scratched:
        light[:, half + 2 : half + 18] = 255.0 - GROUND_DN
    for place in {(int(r), int(c)) for r, c in zip(rows.ravel() // TILE_PX, cols.ravel() // TILE_PX, strict=True)}:
        tile = own.setdefault(place, grain[chosen[place]].copy())
        inside = (rows // TILE_PX == place[0]) & (cols // TILE_PX == place[1])
        at = rows[inside] % TILE_PX, cols[inside] % TILE_PX
        tile[at] = np.clip(tile[at] + light[inside], 0, 255).astype(np.uint8)


def reviewed(address: str, most: int) -> Reviewed:
    """Accept `most` marks one after another."""
    with sync_playwright() as playwright:
        found = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_context(viewport={"width": 1300, "height": 900}, bypass_csp=True).new_page()
        began = time.monotonic()
        page.goto(address)
        page.wait_for_selector("#mark-view:not([hidden])")
        opened_s = time.monotonic() - began
        next_s = [decide_next(page) for _ in range(most - 1)]
        page.keyboard.press("a")
        page.wait_for_timeout(1000)
        clock_s = time.monotonic() - began - 1.0
        browser.close()
    return Reviewed(opened_s, next_s, clock_s)


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


def peak_mb(process: int) -> float:
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    given = sys.argv[1:]
    if given[:1] == ["--archive"]:
        numbers = [int(argument) for argument in given[1:]]
        archive(*(numbers + [50_000, 25_000][len(numbers) :]))
    else:
        numbers = [int(argument) for argument in given]
        main(*(numbers + [20, 11500][len(numbers) :]))
