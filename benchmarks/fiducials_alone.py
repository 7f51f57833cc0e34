"""Claimed against realised standard deviations of frames that show fiducials alone, for every film transformation.

PYTHONPATH=.:tests/adjust python benchmarks/fiducials_alone.py [TRIALS [SEED [GIVEN ...]]]

GIVEN: numbers of the precisions of the given coordinates; all without. In every trial the true places of the marks, the
films and the noise are drawn anew; the given coordinates stay. Each figure is the rms error over the rms claim of all
quantities of a kind, in brackets how far that is from 1 in standard deviations (from the scatter between trials). Of
sigma0 it is the root of the mean square; 1 is right.
"""

import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from film_realisations import CAMERA, Frames, errors, frames
from numpy.typing import NDArray
from scipy.stats import norm

from adjust.problem.images import adjusted_image
from adjust.problem.network import Transformation
from adjust.problem.result import Adjustment
from adjust.quality.fiducial_corrections import corrections_to_given
from adjust.solution.adjustment import adjust
from pipeline.report.fiducials import Figure, figure_of_films

Array = NDArray[np.float64]

KINDS: tuple[tuple[Transformation, int], ...] = (
    ("congruent", 4),
    ("similarity", 4),
    ("affine", 4),
    ("affine", 8),
    ("bilinear", 8),
    ("projective", 8),
    ("conformal(2)", 8),
    ("conformal(3)", 8),
    ("polynomial(2)", 8),
)
FRAMES = (1, 2, 5, 20)
GIVEN = {"drawn from 1 mm": (1.0, 1.0), "1 mm, right to 10 µm": (1.0, 0.01), "certificate, 5 µm": (0.005, 0.005)}
FREE_OF_DATUM = ("corrections", "distances", "sigma0", "sigma0 of fiducial")  # right whatever is given
LEVEL = 0.01  # probability that any figure of the whole table is called wrong by chance


@dataclass(frozen=True)
class Known:
    """The covariance of an adjustment, as the report has it from its file."""

    adjustment: Adjustment

    def of(self, names: list[str]) -> Array:
        return self.adjustment.sigma0**2 * self.adjustment.cofactor_of(list(names))


def main() -> None:
    """Print a row for every film, number of frames and precision of the given coordinates."""
    trials, seed, *some = [*map(int, sys.argv[1:]), *(400, 1)[len(sys.argv) - 1 :]]
    figures = []
    chosen = [list(GIVEN.items())[i] for i in some or range(len(GIVEN))]
    for (words, (stated, true)), count, (kind, marks) in product(chosen, FRAMES, KINDS):
        found = cell(kind, marks, count, stated, true, trials, seed)
        if true < stated:
            found = {name: figure for name, figure in found.items() if name in FREE_OF_DATUM}
        where = f"{words}, {kind}, {marks} marks, {count} frames"
        figures += [(off, f"{where}: {name}") for name, (_, off) in found.items()]
        row = "  ".join(f"{name} {ratio:.3f} ({off:+.1f})" for name, (ratio, off) in found.items())
        print(f"{where}: {row}", flush=True)
    limit = norm.isf(LEVEL / 2 / len(figures))
    beyond = [each for each in figures if abs(each[0]) > limit]
    print(f"{len(figures)} figures, limit {limit:.2f}, beyond it {len(beyond)}: {beyond}")
    print(f"mean square of all offs {np.mean([off**2 for off, _ in figures]):.3f}")


def cell(
    kind: Transformation, marks: int, count: int, stated: float, true: float, trials: int, seed: int
) -> dict[str, tuple[float, float]]:
    """By kind of quantity: rms error over rms claim, and how far that is from 1."""
    squares: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial, count, marks, len(kind)])
        truth = frames(kind, count, marks, stated, true, rng)
        by_kind: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for name, error, sigma in quantities(adjust(truth.network, truth.start), truth):
            by_kind[name].append((error, sigma))
        for name, pairs in by_kind.items():
            error, sigma = np.array(pairs).T
            squares[name].append((error**2, sigma**2))
    return {name: _compared(*map(np.array, zip(*rows, strict=True))) for name, rows in squares.items()}


def _compared(error: Array, claim: Array) -> tuple[float, float]:
    """Of squares (trials, quantities)."""
    scale = claim.mean(axis=0)
    kept = scale > 0.0
    realised, claimed = (each[:, kept] / scale[kept] for each in (error, claim))
    apart = (realised - claimed).mean(axis=1)
    return float(np.sqrt(realised.mean())), float(apart.mean() / (apart.std(ddof=1) / np.sqrt(len(apart))))


def quantities(result: Adjustment, truth: Frames) -> Iterator[tuple[str, float, float]]:
    """Kind, error and claim of all that is printed of an adjustment of fiducials alone."""
    assert result.converged
    yield from errors(result, truth)
    form = _form(result, truth)
    if form is not None:
        ids = [int(id_) - 1 for id_ in form.ids]
        true = corrections_to_given(truth.films, truth.places_mm[ids], form.given_mm)
        assert true is not None
        wrong_um = (form.change_um - 1e3 * true.corrections_mm).ravel()
        for error, variance in zip(wrong_um, np.diag(form.covariance_um2), strict=True):
            yield "corrections", float(error), float(np.sqrt(max(variance, 0.0)))
        for each in form.distances:
            ends = truth.places_mm[[int(each.start) - 1, int(each.end) - 1]]
            yield "distances", 1e3 * float(each.length_mm - np.linalg.norm(ends[1] - ends[0])), each.sigma_um
    for w in result.residuals.w[result.residuals.w != 0.0]:
        yield "w", float(w), 1.0
    if not result.variance.is_a_priori:
        yield "sigma0", result.sigma0, 1.0
    for name in ("fiducial", "datum"):
        if result.groups[name].sigma0 > 0.0 and (name == "fiducial" or not result.variance.left_out):
            yield f"sigma0 of {name}", result.groups[name].sigma0, 1.0


def _form(result: Adjustment, truth: Frames) -> Figure | None:
    """What the report prints of the marks, from what it reads."""
    given = truth.network.cameras[0].fiducials
    stored = {
        id_: {
            f"{axis}_mm": {"value": result.value(f"FID.{CAMERA}.{id_}.{axis}"), "given": {"value": prior.value}}
            for axis, prior in (("x", mark.x_mm), ("y", mark.y_mm))
        }
        for id_, mark in given.items()
    }
    films = [adjusted_image(result, image.name).film for image in truth.network.images]
    return figure_of_films(CAMERA, {"fiducials": stored}, Known(result), films)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
