"""Significance level and power of the drift test `adjust.quality.lens_comparison`: equal calibrations, and ones that
differ by 2, 3, 5 sigmas.

    python -m benchmarks compare_power [pairs] [--series | --adjustment]

--series: four calibrations with a linear change of c. --adjustment: the test of an adjustment against an earlier
calibration as observations, with `pairs` of simulated networks each.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Lens
from adjust.quality.lens_comparison import CameraCalibration, compare

Array = NDArray[np.float64]

HALF = (110.0, 110.0)
MARKS = np.array([(-106.0, -106.0), (106.0, -106.0), (106.0, 106.0), (-106.0, 106.0)])
NAMES = ("c", "x0", "y0", "k3", "k5", "p1", "p2")
AT = np.array([0, 1, 2, 3, 4, 6, 7])  # positions in c, x0, y0, k3, k5, k7, p1, p2, p3, p4
TRUE = np.array([153.0, 0.010, -0.006, -6e-8, 1e-12, 2e-7, -1e-7])
SIGMAS = np.array([0.004, 0.003, 0.003, 8e-9, 4e-13, 6e-8, 6e-8])
MARK_SIGMA_MM = 0.002
TIED = {(3, 4): -0.9, (1, 5): 0.6}  # correlations of k3 and k5, x0 and p1, as in most calibrations
LEVEL = 0.05
YEARS = np.array([1952.0, 1958.0, 1961.0, 1970.0])


def covariance() -> Array:
    correlation = np.eye(len(NAMES))
    for (i, j), rho in TIED.items():
        correlation[i, j] = correlation[j, i] = rho
    whole = np.zeros((18, 18))
    whole[np.ix_(AT, AT)] = correlation * np.outer(SIGMAS, SIGMAS)
    whole[10:, 10:] = MARK_SIGMA_MM**2 * np.eye(8)
    return whole


def draw_camera(rng: np.random.Generator, change: Array) -> CameraCalibration:
    error = rng.multivariate_normal(np.zeros(18), covariance())
    values = error[:10]
    values[AT] += TRUE + change
    marks = {str(i): xy for i, xy in enumerate(MARKS + error[10:].reshape(-1, 2))}
    return CameraCalibration("K", Lens(Distortion("torlegard"), values[:3], values[3:]), marks, covariance(), 5000)


def share(rng: np.random.Generator, change: Array, pairs: int) -> float:
    same = (
        compare([draw_camera(rng, 0 * change), draw_camera(rng, change)], HALF).same.probability for _ in range(pairs)
    )
    return float(np.mean([probability < LEVEL for probability in same]))


def main(pairs: int = 300) -> None:
    rng = np.random.default_rng(9)
    print(f"{pairs} pairs each, at a level of {LEVEL:.0%}")
    print(f"alike: {share(rng, np.zeros(len(NAMES)), pairs):.3f}")
    print("changed by | c | k5, beyond what k3 takes up")
    alone = np.sqrt(1 - TIED[3, 4] ** 2)
    for sigmas in (2.0, 3.0, 5.0):
        c, k5 = np.zeros(len(NAMES)), np.zeros(len(NAMES))
        c[0], k5[4] = sigmas * np.sqrt(2) * SIGMAS[0], sigmas * np.sqrt(2) * alone * SIGMAS[4]
        print(f"{sigmas:g} joint sigmas | {share(rng, c, pairs):.2f} | {share(rng, k5, pairs):.2f}")


def print_series(count: int = 300) -> None:
    """Print the rates of drift and of a significant trend; changes are from the first calibration to the last."""
    rng = np.random.default_rng(10)
    for sigmas in (0.0, 2.0, 3.0, 5.0):
        change = np.zeros(len(NAMES))
        change[0] = sigmas * np.sqrt(2) * SIGMAS[0] / np.ptp(YEARS)
        series = [
            compare([draw_camera(rng, change * (year - YEARS[0])) for year in YEARS], HALF, YEARS) for _ in range(count)
        ]
        result = np.mean([each.probability < LEVEL for each in series])
        trends = np.mean([each.trend is not None and each.trend.probability < LEVEL for each in series])
        print(f"c changes by {sigmas:g} joint sigmas: drift {result:.3f}, trend {trends:.3f}", flush=True)


def print_adjustments(pairs: int = 200) -> None:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "adjust"))
    from test_lens_comparison import contradicted

    for sigmas in (0.0, 2.0, 3.0, 5.0):
        print(f"c changed by {sigmas:g} joint sigmas: {contradicted(sigmas, pairs, LEVEL):.3f}", flush=True)


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:] if word.isdigit()]
    if "--adjustment" in sys.argv:
        print_adjustments(*given)
    elif "--series" in sys.argv:
        print_series(*given)
    else:
        main(*given)
