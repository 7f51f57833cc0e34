"""A review in a real browser: how soon the next mark is there in large scans, what the server takes, and how many keys
and seconds deciding takes.

    python benchmarks/review_load.py [FRAMES] [SIDE_PX]

Renders FRAMES (20) tiled scans of SIDE_PX (11500) with four ring-crosses each, of which one is scratched, measures
them, and goes through all of them with one key a mark. Needs Chromium.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from playwright.sync_api import sync_playwright

TILE_PX = 256
PITCH_UM = 20.0
SEED = 7


def main(frames: int, side_px: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        project = written(Path(name), frames, side_px)
        start = "from pipeline.main import main; main()"
        subprocess.run([sys.executable, "-c", start, "measure", str(project)], check=False, capture_output=True)
        command = [sys.executable, "-c", start, "review", str(project), "--no-browser", "--who", "ann"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            began = time.monotonic()
            address = server.stdout.readline().strip()
            ready_s = time.monotonic() - began
            try:
                seconds, opened_s = reviewed(address)
                memory_mb = peak_mb(server.pid)
            finally:
                server.kill()
    next_ms = 1000 * np.array(seconds)
    print(f"{frames} frames of {side_px} px, seed {SEED}")
    print(f"server ready after {ready_s:.1f} s, page open after {opened_s:.2f} s, server's memory {memory_mb:.0f} MB")
    print(f"marks decided: {len(seconds)}, one key each, {sum(seconds):.1f} s in all")
    median, most = np.median(next_ms), next_ms.max()
    print(f"next mark, ms: median {median:.0f}, 90 % {np.quantile(next_ms, 0.9):.0f}, most {most:.0f}")


def written(folder: Path, frames: int, side_px: int) -> Path:
    """The project: marks in the corners of an even frame with grain, the third one of each scratched."""
    mm = side_px * PITCH_UM / 1000.0
    at_mm = mm / 2 - 8.0
    corners = [(at_mm, -at_mm), (-at_mm, -at_mm), (-at_mm, at_mm), (at_mm, at_mm)]
    text = f'name = "K"\nframe_mm = [{mm - 12}, {mm - 12}]\nprincipal_distance_mm = 150.0\n'
    for number, (x, y) in enumerate(corners, 1):
        text += f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.01\nmark = "m"\n'
    text += '[mark.m]\nkind = "ring-cross"\nring_mm = 0.5\nring_line_mm = 0.1\narm_mm = 0.8\nline_mm = 0.1\n'
    (folder / "camera.toml").write_text(text, encoding="utf-8")
    rng = np.random.default_rng(SEED)
    grain = rng.normal(0, 4, (TILE_PX * 4, TILE_PX * 4))
    ground = np.tile(grain, (side_px // len(grain) + 1,) * 2)[:side_px, :side_px] + 60.0
    for number in range(frames):
        grey = np.roll(ground, number * 37, axis=0)
        for index, (x, y) in enumerate(corners):
            col, row = (side_px - 1) / 2 + x / PITCH_UM * 1000, (side_px - 1) / 2 - y / PITCH_UM * 1000
            draw(grey, col, row + 0.3 * number / frames, index == 2)
        tifffile.imwrite(
            folder / f"{number:04}.tif",
            np.clip(grey, 0, 255).astype(np.uint8),
            tile=(TILE_PX, TILE_PX),
            compression="lzw",
        )
    project = folder / "project.toml"
    project.write_text(f'camera = "camera.toml"\nscans = ["*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n')
    return project


def draw(grey: NDArray[np.float64], col: float, row: float, is_scratched: bool) -> None:
    """A ring-cross, each pixel its distance from the lines, softened over one."""
    half, scale = 60, 1000.0 / PITCH_UM
    first_col, first_row = round(col) - half, round(row) - half
    rows, cols = np.mgrid[first_row : first_row + 2 * half, first_col : first_col + 2 * half]
    u, v = (cols - col) / scale, (rows - row) / scale
    ring = np.abs(np.hypot(u, v) - 0.5) - 0.05
    bars = [np.maximum(np.abs(a) - 0.8, np.abs(b) - 0.05) for a, b in ((u, v), (v, u))]
    inside = np.clip(0.5 - np.minimum(ring, np.minimum(*bars)) * scale, 0.0, 1.0)
    window = grey[first_row : first_row + 2 * half, first_col : first_col + 2 * half]
    window += 120.0 * inside
    if is_scratched:
        window[:, half + 2 : half + 18] = 230.0


def reviewed(address: str) -> tuple[list[float], float]:
    """Seconds from each key until the next mark is there, and until the page was."""
    with sync_playwright() as playwright:
        found = next(path for path in ("/usr/bin/chromium", "/usr/bin/chromium-browser") if os.path.exists(path))
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        page = browser.new_context(viewport={"width": 1300, "height": 900}, bypass_csp=True).new_page()
        began = time.monotonic()
        page.goto(address)
        page.wait_for_selector("#mark-view:not([hidden])")
        opened_s = time.monotonic() - began
        seconds = []
        while "left" in page.inner_text("#left") and not page.inner_text("#left").startswith("Nothing"):
            page.wait_for_timeout(400)  # as long as a person looks at least: the next one is fetched meanwhile
            title = page.inner_text("#title")
            began = time.monotonic()
            page.keyboard.press("a")
            if page.inner_text("#left").startswith("1 left"):
                page.wait_for_function("document.getElementById('left').textContent.startsWith('Nothing')")
                break
            page.wait_for_function(
                "title => document.getElementById('title').textContent !== title"
                " && !document.getElementById('mark-view').hidden && document.activeElement.id === 'mark'",
                arg=title,
                polling=10,
            )
            seconds.append(time.monotonic() - began)
        browser.close()
    return seconds, opened_s


def peak_mb(process: int) -> float:
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    given = [int(argument) for argument in sys.argv[1:]]
    main(*(given + [20, 11500][len(given) :]))
