"""Claimed against realised standard deviations: Monte Carlo simulation of reference cases.

For each kind of parameter: RMS error over the RMS a-posteriori standard deviation, averaged over the parameters of the
kind, and its smallest and largest value. v'Pv against chi-square (Kolmogorov-Smirnov), and coverage of the true radial
distortion curve by its confidence bands.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from reference_cases import CAMERA, Exact, exact, load, realisation
from scipy import stats

from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from benchmarks.harness import Row, rms, table

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


def cells() -> Iterator[Row]:
    yield from ({"network": name} for name in CASES)


def case(network: str, runs: int = 400) -> Row:
    loaded = load(network)
    return {"runs": runs, **figures(many(exact(loaded), loaded["r0"], runs))}


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


def figures(runs: Runs) -> Row:
    """Figures of one case: a line per kind of parameter, and sentences."""
    ratio = np.sqrt((runs.errors**2).mean(axis=0) / (runs.sigmas**2).mean(axis=0))
    mean = np.abs(runs.errors.mean(axis=0) / np.sqrt((runs.sigmas**2).mean(axis=0) / len(runs.errors)))
    kinds = np.array([parameter_kind(name) for name in runs.names])
    lines = []
    for kind in (*dict.fromkeys(kinds), "all"):
        own = ratio[(kinds == kind) | (kind == "all")]
        spread = {"average": rms(own), "least": own.min(), "most": own.max()}
        lines.append({"kind": kind, "number": len(own), **spread, "mean error": mean[kinds == kind].max(initial=0.0)})
    test = stats.kstest(runs.vpv, stats.chi2(runs.redundancy).cdf)
    sentences = [
        f"{100 * ((ratio > 0.9) & (ratio < 1.1)).mean():.0f} % of the parameters within 0.9 to 1.1",
        f"v'Pv: mean {runs.vpv.mean():.1f}, chi-square {runs.redundancy}; Kolmogorov-Smirnov p = {test.pvalue:.3f}",
    ]
    for band, factor in BANDS.items():
        held = 100 * (np.abs(runs.curves) < factor).mean(axis=0)
        by_radius = f"by radius {held.min():.1f} to {held.max():.1f} %"
        sentences.append(f"band of {band}: holds the curve in {held.mean():.1f} % ({by_radius})")
    return {"lines": lines, "sentences": sentences}


def report(rows: Sequence[Row]) -> Iterator[str]:
    columns = {"kind": "", "number": "d", **dict.fromkeys(("average", "least", "most"), ".3f"), "mean error": ".2f"}
    for row in rows:
        yield f"\n{CASES[row['network']]}: {row['runs']} runs; realised over claimed standard deviations"
        yield from table(columns, row["lines"])
        yield from row["sentences"]
