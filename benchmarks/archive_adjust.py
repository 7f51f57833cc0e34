"""Many frames of eight fiducials alone, adjusted by `reseau adjust` and reported: time and memory on one core.

    python -m benchmarks archive_adjust [FRAMES] [SEED]

The fiducials lie up to 10 um beside their given places; every frame has an affine film and scan of its own, and marks
that scatter by 2 um. Each command runs in a process of its own.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.archive_scale import told_of
from benchmarks.archive_stand_ins import CAMERA, FIDUCIALS

_OFF_MM, _SCATTER_MM, _STRETCH = 0.01, 0.002, 3e-4
_A_FOLDER = 500


def main(frames: int, seed: int) -> None:
    with tempfile.TemporaryDirectory() as place:
        project = write_project(Path(place), frames, np.random.default_rng(seed))
        print(f"{frames} frames of {len(FIDUCIALS)} fiducials, seed {seed}")
        print(f"{'command':<12}{'clock s':>9}{'CPU s':>9}{'MB at most':>12}")
        for command in ("adjust", "report"):
            start_s = time.monotonic()
            cpu_s, peak_mb = told_of([command, str(project)])
            print(f"{command:<12}{time.monotonic() - start_s:9.1f}{cpu_s:9.1f}{peak_mb:12.0f}", flush=True)
        for file in ("adjustment.json", "adjustment.npz", "report.html"):
            print(f"{file}: {(Path(place) / 'out' / file).stat().st_size / 1e6:.1f} MB")


def write_project(folder: Path, frames: int, rng: np.random.Generator) -> Path:
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    (folder / "project.toml").write_text('camera = "camera.toml"\n', encoding="utf-8")
    true_mm = np.array(FIDUCIALS) + rng.uniform(-_OFF_MM, _OFF_MM, (len(FIDUCIALS), 2))
    with (folder / "comparator.csv").open("w", encoding="utf-8") as file:
        file.write("image,point,kind,x_mm,y_mm,sx_mm,sy_mm\n")
        for number in range(frames):
            film = np.eye(2) + rng.normal(0, _STRETCH, (2, 2))
            seen_mm = true_mm @ film.T + rng.uniform(100, 120, 2) + rng.normal(0, _SCATTER_MM, true_mm.shape)
            image = f"box{number // _A_FOLDER:02d}/{number % _A_FOLDER:04d}"
            file.writelines(
                f"{image},{point},fiducial,{x:.7f},{y:.7f},{_SCATTER_MM},{_SCATTER_MM}\n"
                for point, (x, y) in enumerate(seen_mm, 1)
            )
    return folder / "project.toml"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000, int(sys.argv[2]) if len(sys.argv) > 2 else 1)
