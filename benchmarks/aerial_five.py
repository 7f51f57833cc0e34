"""Five rendered aerial frames, measured and adjusted, against their truth.

python -m benchmarks aerial_five [FOLDER] [SCENE.toml]
"""

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import synthetic_images
from pipeline.files.project_file import read_project
from pipeline.progress import Reporter
from pipeline.rendered.against_truth import Comparison, compare_with_truth
from pipeline.rendered.scene_file import render_project
from pipeline.stages import run_all
from pipeline.summary import Summary


def main() -> None:
    """Render, run and compare."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp())
    scenes = Path(synthetic_images.__file__).parent / "scenes"
    scene = Path(sys.argv[2]) if len(sys.argv) > 2 else scenes / "aerial_five.toml"
    reporter = Reporter()
    begin = time.perf_counter()
    with reporter.stage("rendering") as count:
        render_project(scene, folder, count)
    rendered = time.perf_counter()
    project = read_project(folder / "project.toml")
    summary = run_all(project, reporter)
    done = time.perf_counter()
    comparison = compare_with_truth(folder / "truth.json", project.measurement_path, project.adjustment_path)
    print_table(comparison, summary)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"rendering {rendered - begin:.1f} s, run {done - rendered:.1f} s, peak {peak:.0f} MiB; in {folder}")


def print_table(comparison: Comparison, summary: Summary) -> None:
    """The figures of one run."""
    print(f"{'frame':12} {'pose':>11} {'fiducials':>10} {'targets':>9} {'wrong':>6} {'rms px':>8} {'error/sigma':>12}")
    for frame in comparison.frames:
        counts = [f"{frame.observed[kind]}/{frame.visible[kind]}" for kind in ("fiducial", "target")]
        rms, ratio = (float(np.sqrt(np.mean(values**2))) for values in (frame.errors_px, frame.normalised))
        pose = f"{frame.pose} ({frame.true_pose})"
        print(
            f"{frame.image:12} {pose:>11} {counts[0]:>10} {counts[1]:>9} {len(frame.wrong):6d} {rms:8.4f} {ratio:12.3f}"
        )
    print(f"rms(error / sigma) of all marks: {comparison.rms_error_over_sigma:.3f}")
    print(f"\n{'quantity':34} {'value':>16} {'sigma':>12} {'truth':>16} {'in sigmas':>10}")
    for name, (value, sigma, truth) in comparison.camera.items():
        off = f"{(value - truth) / sigma:10.2f}" if sigma > 0.0 else f"{'fixed':>10}"
        print(f"{name:34} {value:16.8g} {sigma:12.3g} {truth:16.8g} {off}")
    if summary.adjustment:
        print(f"sigma0 {summary.adjustment.sigma0:.4f}, redundancy {summary.adjustment.redundancy}")
    print(summary.verdict.sentence)


if __name__ == "__main__":
    main()
