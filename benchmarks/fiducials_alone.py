"""Claimed against realised standard deviations of frames that show fiducials alone, for every film transformation.

In every trial the true places of the marks, the films and the noise are drawn anew; the given coordinates stay. Figures
are the rms error over the rms claim of all quantities of a kind, and how far that is from 1 in standard deviations
(from the scatter between trials); of sigma0 it is the root of the mean square. Of given coordinates that are better
than their standard deviations only what is free of the datum is compared.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from networks import FILM_CAMERA, DrawnFrames, draw_frames, unknown_errors
from scipy.stats import norm

from adjust import Adjustment, adjust
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Transformation
from adjust.quality.fiducial_corrections import corrections_to_given
from benchmarks.harness import Row, table

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
FREE_OF_DATUM = ("corrections", "distances", "sigma0")
LEVEL = 0.01  # probability that chance puts any figure of the whole table beyond the limit
Figure = tuple[str, float, float]  # kind of quantity, error, claim


def cells(trials: int = 400) -> Iterator[Row]:
    """Films, numbers of frames, and given coordinates. trials: of each."""
    for given in GIVEN:
        for frames in FRAMES:
            yield from (
                {"given": given, "kind": kind, "marks": marks, "frames": frames, "trials": trials}
                for kind, marks in KINDS
            )


def case(given: str, kind: Transformation, marks: int, frames: int, trials: int, seed: int) -> Row:
    stated_mm, true_mm = GIVEN[given]
    number = (list(GIVEN).index(given) * len(FRAMES) + FRAMES.index(frames)) * len(KINDS) + KINDS.index((kind, marks))
    squares: dict[str, list[tuple[list[float], list[float]]]] = defaultdict(list)
    for trial in range(trials):
        rng = np.random.default_rng([seed, number, trial])
        truth = draw_frames(kind, frames, marks, stated_mm, true_mm, rng)
        result = adjust(truth.network, truth.start)
        own: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
        for name, error, claim in (*unknown_errors(result, truth), *_derived(result, truth)):
            if true_mm == stated_mm or name in FREE_OF_DATUM:
                own[name][0].append(error)
                own[name][1].append(claim)
        for name, pair in own.items():
            squares[name].append(pair)
    whole = {name: pairs for name, pairs in squares.items() if len(pairs) == trials}
    return {"figures": {name: _compared(pairs) for name, pairs in whole.items()}}


def _derived(result: Adjustment, truth: DrawnFrames) -> Iterator[Figure]:
    """Corrections to the given coordinates, distances where films keep them, and sigma0."""
    fiducials = result.network.cameras[0].fiducials
    names = [f"FID.{FILM_CAMERA}.{id_}.{axis}" for id_ in fiducials for axis in "xy"]
    places = np.array([result.value(name) for name in names]).reshape(-1, 2)
    given = np.array([(mark.x_mm.value, mark.y_mm.value) for mark in fiducials.values()])
    own = adjusted_image(result, result.network.images[0].name).film
    found, true = corrections_to_given(own, places, given), corrections_to_given(truth.films[0], truth.places_mm, given)
    if found is not None and true is not None:
        of_film = (f"T.{result.network.images[0].name}.{name}" for name in film_parameter_names(own.transformation))
        cofactor = result.cofactor_of([*names, *of_film])
        covariance = found.by_unknowns @ (result.sigma0**2 * cofactor) @ found.by_unknowns.T
        claims = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        for error, claim in zip((found.corrections_mm - true.corrections_mm).ravel(), claims, strict=True):
            yield "corrections", float(error), float(claim)
    if own.transformation == "congruent":
        covariance = result.sigma0**2 * result.cofactor_of(names)
        for i, j in combinations(range(len(places)), 2):
            vector, row = places[i] - places[j], np.zeros(len(names))
            row[2 * i : 2 * i + 2] = vector / np.linalg.norm(vector)
            row[2 * j : 2 * j + 2] = -row[2 * i : 2 * i + 2]
            length_mm = float(np.linalg.norm(truth.places_mm[i] - truth.places_mm[j]))
            yield "distances", float(np.linalg.norm(vector)) - length_mm, float(np.sqrt(row @ covariance @ row))
    if not result.variance.is_a_priori:
        yield "sigma0", result.sigma0, 1.0


def _compared(pairs: Sequence[tuple[list[float], list[float]]]) -> tuple[float, float]:
    errors, claims = (np.array(each) ** 2 for each in zip(*pairs, strict=True))
    scale = claims.mean(axis=0)
    uncertain = scale > 0.0
    realised, claimed = errors[:, uncertain] / scale[uncertain], claims[:, uncertain] / scale[uncertain]
    apart = (realised - claimed).mean(axis=1)
    off = apart.mean() / (apart.std(ddof=1) / np.sqrt(len(apart)))
    return float(np.sqrt(realised.mean())), float(off)


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Table with one line for each kind of quantity, and the limit for all figures together."""
    figures: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        for name, figure in row["figures"].items():
            figures[row["given"], name].append(figure)
    lines = []
    for (given, name), own in figures.items():
        ratios, offs = np.array(own).T
        sizes = {"rms": np.sqrt((ratios**2).mean()), "least": ratios.min(), "most": ratios.max()}
        lines.append({"given": given, "quantity": name, "cells": len(own), **sizes, "farthest": np.abs(offs).max()})
    yield from table(
        {"given": "", "quantity": "", "cells": "d"} | dict.fromkeys(("rms", "least", "most", "farthest"), ".3f"), lines
    )
    offs = np.array([off for own in figures.values() for _, off in own])
    limit = norm.isf(LEVEL / 2 / len(offs))
    yield (
        f"\n{len(offs)} figures, mean square of how far off {np.mean(offs**2):.3f}, largest {np.abs(offs).max():.2f}; "
        f"limit at {100 - 100 * LEVEL:g} % for all together {limit:.2f}, beyond it {int((np.abs(offs) > limit).sum())}"
    )
