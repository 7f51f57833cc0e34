"""Claimed against realised standard deviations: Monte Carlo simulation of reference cases.

python -m benchmarks monte_carlo [RUNS]

For each kind of parameter: RMS error over the RMS a-posteriori standard deviation, averaged over the parameters of the
kind, and its smallest and largest value. v'Pv against chi-square (Kolmogorov-Smirnov), and coverage of the true radial
distortion curve by its confidence bands.
"""

import sys
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from reference_cases import CAMERA, Exact, exact, load, realisation
from scipy import stats

from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

CASES = {
    "i_five_images_affine_reduced": "five images, ten control points",
    "iii_selfcal_mixed": "self-calibration, known and unknown points mixed",
}
RADII_MM = np.arange(12.5, 140.0, 5.0)  # mm, avoiding the reference radius, where the distortion is zero by definition
BANDS = {"68 %": 1.0, "95 %": 1.96}


@dataclass(frozen=True)
class Runs:
    """Results of all runs. errors, sigmas: (runs, unknowns) errors and claimed standard deviations; vpv: (runs,);
    curves: (runs, radii) errors of the distortion curve over its claimed standard deviations."""

    names: tuple[str, ...]
    errors: Array
    sigmas: Array
    vpv: Array
    redundancy: int
    curves: Array


def main() -> None:
    """Print a table for each case."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    for name, words in CASES.items():
        begin = time.perf_counter()
        case = load(name)
        runs = many(exact(case), case["r0"], count)
        print(f"\n{words}: {count} runs, {time.perf_counter() - begin:.0f} s", flush=True)
        print_table(runs)


def many(case: Exact, r0_mm: float, count: int) -> Runs:
    """Adjust count realisations of a case."""
    errors, sigmas, vpv, curves = [], [], [], []
    for run in range(count):
        result = adjust(realisation(case.network, np.random.default_rng(run)), case.start)
        if not result.converged:
            raise RuntimeError(f"run {run} ended with {result.termination}")
        names = tuple(name for name in result.names if name in case.truth and result.sigma(name) > 0.0)
        errors.append([parameter_error(result.value(name) - case.truth[name], name) for name in names])
        sigmas.append([result.sigma(name) for name in names])
        vpv.append(result.vpv)
        curves.append(normalised_curve(result, case, r0_mm))
    columns = np.array(errors), np.array(sigmas), np.array(vpv)
    return Runs(names, *columns, result.redundancy, np.array(curves))


def parameter_error(difference: float, name: str) -> float:
    """Error of a parameter; angles are reduced to half a turn."""
    is_angle = name.rsplit(".", 1)[1] in ("omega", "phi", "kappa")
    return float((difference + np.pi) % (2.0 * np.pi) - np.pi) if is_angle else difference


def normalised_curve(result: Adjustment, case: Exact, r0_mm: float) -> Array:
    """Error of the radial distortion at RADII_MM over its claimed standard deviation."""
    names = [f"IO.{CAMERA}.{name}" for name in ("k3", "k5")]
    by_parameters = np.stack([RADII_MM * (RADII_MM**n - r0_mm**n) for n in (2, 4)], axis=1)
    error = by_parameters @ [result.value(name) - case.truth[name] for name in names]
    variance = ((by_parameters @ result.cofactor_of(names)) * by_parameters).sum(axis=1)
    return np.asarray(error / (result.sigma0 * np.sqrt(variance)))


def parameter_kind(name: str) -> str:
    """Kind of parameter of an unknown."""
    owner, quantity = name.split(".")[0], name.rsplit(".", 1)[1]
    match owner:
        case "IO":
            return {"c": "principal distance", "x0": "principal point", "y0": "principal point"}.get(
                quantity, "distortion"
            )
        case "FID":
            return "fiducials"
        case "T":
            return "transformation, shift" if quantity in ("a1", "b1") else "transformation, linear part"
        case "PT":
            return "object points"
        case _:
            return "stations" if quantity in ("X0", "Y0", "Z0") else "attitudes"


def print_table(runs: Runs) -> None:
    """Print the figures of one case."""
    ratio = np.sqrt((runs.errors**2).mean(axis=0) / (runs.sigmas**2).mean(axis=0))
    mean = runs.errors.mean(axis=0) / np.sqrt((runs.sigmas**2).mean(axis=0) / len(runs.errors))
    kinds = np.array([parameter_kind(name) for name in runs.names])
    print(f"{'realised over claimed':30} {'number':>7} {'average':>8} {'least':>7} {'most':>7} {'mean error':>11}")
    for kind in dict.fromkeys(kinds):
        of_kind = ratio[kinds == kind]
        bias = np.abs(mean[kinds == kind]).max()
        print(f"{kind:30} {len(of_kind):7d} {np.sqrt((of_kind**2).mean()):8.3f}", end="")
        print(f" {of_kind.min():7.3f} {of_kind.max():7.3f} {bias:11.2f}")
    inside = ((ratio > 0.9) & (ratio < 1.1)).mean()
    print(f"{'all':30} {len(ratio):7d} {np.sqrt((ratio**2).mean()):8.3f} {ratio.min():7.3f} {ratio.max():7.3f}", end="")
    print(f"   {100 * inside:.0f} % within 0.9 to 1.1")
    test = stats.kstest(runs.vpv, stats.chi2(runs.redundancy).cdf)
    print(f"v'Pv: mean {runs.vpv.mean():.1f}, chi-square {runs.redundancy}; Kolmogorov-Smirnov p = {test.pvalue:.3f}")
    for band, factor in BANDS.items():
        held = (np.abs(runs.curves) < factor).mean(axis=0)
        print(f"band of {band}: holds the curve in {100 * held.mean():.1f} % (by radius {100 * held.min():.1f}", end="")
        print(f" to {100 * held.max():.1f} %)")


if __name__ == "__main__":
    main()
