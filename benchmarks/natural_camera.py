"""Cameras calibrated by natural points alone, against the truth: are their standard deviations honest?

python -m benchmarks natural_camera [SEEDS] [PITCH_UM]

The scene juhl_natural with other ground, other grain and other errors of what is given in every seed. The lens is
judged: of the principal distance and the principal point, frames with parallel axes over flat ground say nothing, or
little. Six seeds of 200 um, the default, take some ten minutes.
"""

import re
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

import synthetic_images
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.files.project_file import read_project
from pipeline.progress import Reporter
from pipeline.rendered.scene_file import read_scene, render_project
from pipeline.results.comparator_file import read_comparator
from pipeline.stages import run_measure

SCENES = Path(synthetic_images.__file__).parent / "scenes"
LENS = ("k3", "k5", "p1", "p2")


def main() -> None:
    """Print errors in units of their standard deviations, a row a seed."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    pitch_um = float(sys.argv[2]) if len(sys.argv) > 2 else 200.0
    print(f"pitch {pitch_um:g} um; errors of the lens in units of their standard deviations")
    print("seed  points  sigma0  " + "".join(f"{name:>7}" for name in LENS) + "  beyond chance", flush=True)
    rows = []
    for seed in range(1, seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(lens_errors(seed, pitch_um, Path(folder)))
    print(f"rms of all: {np.sqrt(np.mean(np.square(rows))):.2f}, largest {np.abs(rows).max():.2f}")


def lens_errors(seed: int, pitch_um: float, folder: Path) -> list[float]:
    """Render, measure and adjust one scene; print its row."""
    shutil.copy(SCENES / "aerial_camera.toml", folder)
    text = (SCENES / "juhl_natural.toml").read_text(encoding="utf-8")
    text = re.sub(r"^seed = .*$", f"seed = {seed}", text, flags=re.MULTILINE)
    text = re.sub(r"^pitch_um = .*$", f"pitch_um = {pitch_um}", text, flags=re.MULTILINE)
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    render_project(folder / "scene.toml", folder / "project")
    project = read_project(folder / "project" / "project.toml")
    run_measure(project, Reporter())
    adjustment = adjust_marks(project, read_comparator(project.comparator))
    camera = read_scene(folder / "scene.toml").scene.camera
    names = {name: f"IO.{camera.name}.{name}" for name in LENS}
    truth = camera.distortion.parameters
    errors = [(adjustment.value(key) - truth[name]) / adjustment.sigma(key) for name, key in names.items()]
    suspects = ", ".join(suspect.tested.name for suspect in adjustment.suspects) or "nothing"
    points = len(adjustment.network.points)
    values = "".join(f"{error:7.2f}" for error in errors)
    print(f"{seed:4d} {points:7d} {adjustment.sigma0:7.3f}  {values}  {suspects}", flush=True)
    return errors


if __name__ == "__main__":
    main()
