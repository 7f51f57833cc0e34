"""Significance level and power of the drift test `adjust.quality.lens_comparison`: equal calibrations, and ones that
differ by 2, 3, 5 joint sigmas.

Rates of drift in pairs of calibrations; with --series, of drift and of a significant trend in four calibrations with a
linear change of c; with --adjustment, of an adjustment contradicted by an earlier calibration as observations. The
change of k5 is beyond what k3 takes up.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from test_lens_families import make_calibration, noisy, set_calibration, two_networks

from adjust import Parameter, adjust
from adjust.functional_model.lens import Distortion, Lens
from adjust.quality.lens_comparison import CameraCalibration, compare
from benchmarks.harness import Row

Array = NDArray[np.float64]

CORNERS = np.array([(-110.0, -110.0), (110.0, 110.0)])
MARKS = np.array([(-106.0, -106.0), (106.0, -106.0), (106.0, 106.0), (-106.0, 106.0)])
NAMES = ("c", "x0", "y0", "k3", "k5", "p1", "p2")
AT = np.array([0, 1, 2, 3, 4, 6, 7])  # positions in c, x0, y0, k3, k5, k7, p1, p2, p3, p4
TRUE = np.array([153.0, 0.010, -0.006, -6e-8, 1e-12, 2e-7, -1e-7])
SIGMAS = np.array([0.004, 0.003, 0.003, 8e-9, 4e-13, 6e-8, 6e-8])
MARK_SIGMA_MM = 0.002
TIED = {(3, 4): -0.9, (1, 5): 0.6}  # correlations of k3 and k5, x0 and p1, as in most calibrations
LEVEL = 0.05
YEARS = np.array([1952.0, 1958.0, 1961.0, 1970.0])


def contradicted(sigmas: float, draws: int, level: float = 0.05) -> float:
    """The share of calibrations that are told to be contradicted, of cameras whose c has changed by so many sigmas."""
    (a, start_a), (b, start_b), _ = two_networks("none", 1e-6)
    rng = np.random.default_rng(4)
    result = []
    for _ in range(draws):
        calibration = make_calibration(adjust(noisy(a, rng, 1e6), start_a), False)
        c = calibration.parameters.index(Parameter.interior("K", "c"))
        values = calibration.values.copy()
        values[c] += sigmas * np.sqrt(2.0 * calibration.covariance[c, c])
        network = set_calibration(noisy(b, rng, 1e6), replace(calibration, values=values))
        (found,) = adjust(network, start_b).contradictions
        result.append(found.probability < level)
    return float(np.mean(result))


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


COLUMNS = {"quantity": "", "sigmas": "g", "drift": ".3f", "trend": ".3f"}
SEED = 9


def cells() -> Iterator[Row]:
    yield {"quantity": "none", "sigmas": 0.0}
    yield from ({"quantity": name, "sigmas": sigmas} for sigmas in (2.0, 3.0, 5.0) for name in ("c", "x0", "k5"))


def case(
    quantity: str, sigmas: float, seed: int, pairs: int = 300, series: bool = False, adjustment: bool = False
) -> Row:
    if adjustment:
        return {"drift": contradicted(sigmas, pairs, LEVEL)} if quantity in ("none", "c") else {}
    rng, change = np.random.default_rng(seed), np.zeros(len(NAMES))
    at = NAMES.index(quantity) if sigmas else 0
    given_k3 = np.sqrt(1 - TIED[3, 4] ** 2) if quantity == "k5" else 1.0
    change[at] = sigmas * np.sqrt(2) * given_k3 * SIGMAS[at]
    years = YEARS if series else YEARS[[0, -1]]
    of_year = (years - years[0]) / np.ptp(years)
    found = [
        compare([draw_camera(rng, change * part) for part in of_year], CORNERS, years if series else None)
        for _ in range(pairs)
    ]
    drift = np.mean([(each if series else each.same).probability < LEVEL for each in found])
    return {"drift": drift} | (
        {"trend": np.mean([each.trend is not None and each.trend.probability < LEVEL for each in found])}
        if series
        else {}
    )
