"""Whether the tests notice: forty lines of core logic broken on purpose, one at a time, then the tests of it run.

    python -m benchmarks broken_lines [word]

word: only lines whose file's path holds it. Each is broken in a copy of the project, so nothing here is touched. Tests
that fail without it, too, have caught nothing.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("measure", "adjust", "pipeline", "synthetic_images", "tests", "pyproject.toml", "docs")
LONGEST_S = 900


class Broken(NamedTuple):
    """A line's words in a file of the project, what takes their place, and the tests that are to fail."""

    file: str
    words: str
    instead: str
    tests: str


LINES = (
    Broken("measure/fiducials/mark_comparison.py", " - (len(values) - 1)", "", "measure/test_mark_comparison.py"),
    Broken(
        "measure/fiducials/mark_comparison.py",
        "(weights.sum() - (weights**2).sum() / weights.sum())",
        "weights.sum()",
        "measure/test_mark_comparison.py",
    ),
    Broken(
        "measure/fiducials/measure_frame.py",
        "place_covariance.plus(cause, px2)",
        "place_covariance",
        "measure/test_frame_settling.py",
    ),
    Broken(
        "measure/matching/covariance.py",
        " * (2 * np.pi * _ALIKE_PX**2)",
        "",
        "measure/test_unlike_drawing.py",
    ),
    Broken("measure/noise/noise_model.py", " - unknowns, 1)", ", 1)", "measure/test_noise.py"),
    Broken(
        "measure/noise/robust_estimation.py",
        ", 0.0, 1.0) ** 2) ** 2)",
        ", 0.0, 1.0) ** 2))",
        "measure/test_least_squares.py",
    ),
    Broken("measure/noise/grain.py", "-squared / (4.0 *", "-squared / (2.0 *", "measure/test_grain.py"),
    Broken("measure/matching/covariance.py", " @ turning) / 2", " @ turning)", "measure/test_second_order.py"),
    Broken("measure/matching/saturation.py", "sides * sigma_dn * size", "sides * size", "measure/test_clipping.py"),
    Broken(
        "measure/matching/covariance.py",
        "2 * slopes[0] * slopes[1]",
        "slopes[0] * slopes[1]",
        "measure/test_second_place.py",
    ),
    Broken("measure/marks/coverage.py", "* part.line_mm / 2\n", "* part.line_mm / 1.9\n", "measure/test_coverage.py"),
    Broken(
        "measure/scans/metadata.py",
        " if self.inverted else samples",
        " if False else samples",
        "measure/test_scan_formats.py",
    ),
    Broken("measure/tone/curve.py", "** 2.4)", "** 2.2)", "measure/test_tone.py"),
    Broken(
        "measure/scans/compression.py",
        "/ max(abs(contrast_dn), 1e-9)) ** 2",
        "/ max(abs(contrast_dn), 1e-9))",
        "measure/test_quantisation.py",
    ),
    Broken(
        "measure/fiducials/consistency.py",
        "(left * np.linalg.solve(spread, left)).sum() / 2",
        "(left * np.linalg.solve(spread, left)).sum()",
        "measure/test_judgement.py",
    ),
    Broken(
        "measure/fiducials/interior_orientation.py",
        "prior[0, 4] = prior[1, 5] = 1 / AFFINITY_SIGMA",
        "prior[0, 4] = prior[1, 5] = 0.1 / AFFINITY_SIGMA",
        "measure/test_frame_fit.py",
    ),
    Broken("measure/targets/consistency.py", "own + best.predicted_px2", "own", "measure/test_shared_offsets.py"),
    Broken(
        "pipeline/measuring/target_field.py",
        "c[:, 2] ** 2 - radius**2 * tilt",
        "c[:, 2] ** 2 + radius**2 * tilt",
        "pipeline/test_perspective_disks.py",
    ),
    Broken(
        "pipeline/results/comparator_file.py",
        "np.array([pitch_um[0], -pitch_um[1]]) / 1000.0)\n\n\ndef pixel",
        "np.array([pitch_um[0], pitch_um[1]]) / 1000.0)\n\n\ndef pixel",
        "pipeline/test_files.py",
    ),
    Broken(
        "pipeline/adjusting/network.py",
        "+ np.eye(2) * (settings.film_sigma_um / 1000.0) ** 2",
        "",
        "pipeline/test_weights.py",
    ),
    Broken(
        "pipeline/resampling/canvas.py",
        "self.y_mm - self.pitch_mm * row",
        "self.y_mm - self.pitch_mm * (row + 0.5)",
        "pipeline/test_resampling.py",
    ),
    Broken(
        "pipeline/opencv_check/opencv_model.py",
        'by_values[..., NAMES.index("cy")] *= -1.0',
        "pass",
        "pipeline/test_check_opencv_model.py",
    ),
    Broken("adjust/functional_model/rotation.py", "second = 0.5 *", "second = 0.49 *", "adjust/test_derivatives.py"),
    Broken(
        "adjust/functional_model/physical.py", "k3 * (r2 - r02)", "k3 * (r2 + r02)", "adjust/test_adjust_reference.py"
    ),
    Broken(
        "adjust/functional_model/physical.py",
        "by_p2 = vectors(2 * x * y, r2 + 2 * y**2)",
        "by_p2 = vectors(2 * x * y, r2 + 3 * y**2)",
        "adjust/test_adjust_reference.py",
    ),
    Broken(
        "adjust/functional_model/juhl.py", "radius**3 - r0**2 * radius", "radius**3", "adjust/test_adjust_reference.py"
    ),
    Broken(
        "adjust/functional_model/opencv_family.py",
        "p2 * (r2 + 2 * x**2)",
        "p2 * (r2 + x**2)",
        "adjust/test_opencv_family.py",
    ),
    Broken(
        "adjust/functional_model/line_of_sight.py",
        "np.sin(angle / 2.0) ** 2",
        "np.sin(angle / 2.1) ** 2",
        "adjust/test_line_of_sight.py",
    ),
    Broken(
        "adjust/functional_model/atmosphere.py",
        "above_m / (GAS_CONSTANT",
        "above_m / (1.1 * GAS_CONSTANT",
        "adjust/test_line_of_sight.py",
    ),
    Broken(
        "adjust/functional_model/scanner.py",
        "return scan_mm - self.displacement",
        "return scan_mm + self.displacement",
        "adjust/test_scanner.py",
    ),
    Broken(
        "adjust/quality/reliability.py",
        "smallest, 0.0) * np.sqrt(hidden)",
        "smallest, 0.0) * hidden",
        "adjust/test_reliability.py",
    ),
    Broken(
        "adjust/quality/variance_components.py",
        "np.sqrt(2.0 * variance)",
        "np.sqrt(variance)",
        "adjust/test_variance_components.py",
    ),
    Broken(
        "adjust/quality/reweighting.py",
        "(LOST - STANDARD), 0.0, 1.0) ** 2",
        "(LOST - STANDARD), 0.0, 1.0)",
        "adjust/test_statistics.py",
    ),
    Broken(
        "adjust/quality/significance.py", "2.0 * float(one_sided)", "float(one_sided)", "adjust/test_significance.py"
    ),
    Broken(
        "adjust/quality/snooping.py",
        "limits = scale**2 * search.critical",
        "limits = scale * search.critical",
        "adjust/test_snooping.py",
    ),
    Broken("adjust/least_squares/iteration.py", "(normalised**2).sum()", "0.0", "adjust/test_adjust_reference.py"),
    Broken(
        "adjust/problem/result.py",
        "self.vpv / self.redundancy",
        "self.vpv / self.conditions",
        "adjust/test_adjust_reference.py",
    ),
    Broken("adjust/quality/lens_comparison.py", "chi / freedom)) if", "chi)) if", "adjust/test_comparison.py"),
    Broken(
        "adjust/rank_defect/datum.py",
        "sum(axis=1).mean())) or 1.0",
        "sum(axis=1).max())) or 1.0",
        "adjust/test_datum.py",
    ),
)


def main(word: str = "") -> None:
    chosen = [line for line in LINES if word in line.file]
    caught, whole = 0, dict[str, bool]()  # whether tests pass as all is
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / "reseau"
        for part in COPIED:
            source = ROOT / part
            (shutil.copytree if source.is_dir() else shutil.copy2)(source, _made(copy) / part)
        for line in chosen:
            start = time.monotonic()
            if line.tests not in whole:
                whole[line.tests] = _run(copy, line.tests) == 0
            found = whole[line.tests] and is_caught(copy, line)
            caught += found
            told = "caught" if found else "NOT CAUGHT" if whole[line.tests] else "FAILS ANYWAY"
            print(f"| {line.file} | `{_short(line.words)}` | {told} | {time.monotonic() - start:.0f} s |", flush=True)
    print(f"{caught} of {len(chosen)} caught")


def _made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder


def _short(words: str) -> str:
    return " ".join(words.split())[:60]


def is_caught(copy: Path, line: Broken) -> bool:
    """Whether a test fails with the line broken. Raises ValueError where the line is not there any more."""
    path = copy / line.file
    text = path.read_text(encoding="utf-8")
    if line.words not in text:
        raise ValueError(f"{line.file} has no line with {line.words!r}: bring this script up to date")
    path.write_text(text.replace(line.words, line.instead, 1), encoding="utf-8")
    try:
        return _run(copy, line.tests) == 1
    finally:
        path.write_text(text, encoding="utf-8")


def _run(copy: Path, tests: str) -> int:
    """Pytest's exit code."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", f"tests/{tests}"]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, timeout=LONGEST_S, check=False
    ).returncode


if __name__ == "__main__":
    main(*sys.argv[1:])
