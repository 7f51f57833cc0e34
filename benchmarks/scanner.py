"""Separation of scanner errors from film deformations and fiducials: claimed against realised standard deviations.

Simulated networks, each adjusted with the terms of the scanner error in addition to all other unknowns: frames in two
scan orientations, in four, and convergent photographs of targets. For each setup: RMS error over the RMS claimed
standard deviation, over all terms and the extremes over terms; then how often frames in equal orientation are reported,
and which terms the tests select, of a tenth of the networks.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial

import numpy as np
from networks import SCAN_MIDDLE_MM, Truth, bend_in_scanner, bent_films, field_points, simulated
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import approximate
from adjust.model_selection.scanner_choice import choose_bends
from adjust.problem.network import Approximations, Network
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from benchmarks.harness import Row, table

Array = NDArray[np.float64]
Made = Callable[[np.random.Generator, Mapping[str, Prior]], tuple[Network, Approximations]]

FREE = Prior(0.0, np.inf)
BEND_MM = {
    "a20": 0.02, "a11": -0.015, "a02": 0.01, "b20": -0.012, "b11": 0.008, "b02": -0.02,
    "a30": 0.006, "a21": -0.004, "a12": 0.005, "a03": 0.003, "b30": -0.005, "b21": 0.004, "b12": -0.006, "b03": 0.007,
}  # fmt: skip
EVEN = ("a20", "a11", "a02", "b20", "b11", "b02")
TOLD_BY_QUARTERS = (*EVEN, "a30", "a21", "a12", "a03")
HALVES, QUARTERS = (0.0, 180.0), (0.0, 90.0, 180.0, 270.0)
CHOSEN = {"a20": 0.02, "b11": -0.015, "b02": 0.01}


def cells(networks: int = 200) -> Iterator[Row]:
    yield from ({"study": setup, "networks": networks} for setup in SETUPS)
    few = max(networks // 10, 5)
    yield from ({"study": study, "networks": few} for study in ("all alike, 6 terms", *CHOICES))


def case(study: str, networks: int) -> Row:
    if study in SETUPS:
        return _ratios(networks, *SETUPS[study])
    if study in CHOICES:
        return {"chosen": dict(Counter(", ".join(_chosen(CHOICES[study], seed)) or "none" for seed in range(networks)))}
    free = dict.fromkeys(EVEN, FREE)
    alike = (laid((0.0,) * 8, EVEN, np.random.default_rng(seed), free) for seed in range(networks))
    return {"chosen": {"told": sum(_names_bend(adjust(*network)) for network in alike)}}


def report(rows: Sequence[Row]) -> Iterator[str]:
    figures = dict.fromkeys(("ratio", "least", "largest", "claimed_um", "to_um", "sigma0"), ".3f")
    yield from table({"study": "", "terms": "d", "networks": "d", **figures}, [row for row in rows if "terms" in row])
    yield from (f"{row['study']}, of {row['networks']}: {row['chosen']}" for row in rows if "chosen" in row)


def laid(
    turns: tuple[float, ...], terms: Sequence[str], rng: np.random.Generator, free: Mapping[str, Prior]
) -> tuple[Network, Approximations]:
    return bent_films(turns, {name: BEND_MM[name] for name in terms}, free, rng), _start(turns)


@cache
def _start(turns: tuple[float, ...]) -> Approximations:
    """Approximate values from error-free marks; finding them with the errors of the network takes longest."""
    return approximate(bent_films(turns, {}, {}))


def photographs(rng: np.random.Generator, free: Mapping[str, Prior]) -> tuple[Network, Approximations]:
    points = field_points(np.random.default_rng(5), 40)
    network, start = simulated(rng, Truth(middle_mm=SCAN_MIDDLE_MM), points=points)
    return bend_in_scanner(network, BEND_MM, free), start


SETUPS: dict[str, tuple[Sequence[str], Made]] = {
    "8 frames, 8 marks each, turned by 0 and 180 degrees": (EVEN, partial(laid, HALVES * 4, EVEN)),
    "8 frames, 8 marks each, in all four quarters": (TOLD_BY_QUARTERS, partial(laid, QUARTERS * 2, TOLD_BY_QUARTERS)),
    "4 convergent photographs of 40 known targets, 5 marks each": (tuple(BEND_MM), photographs),
}
CHOICES: dict[str, Mapping[str, float]] = {f"chosen for {', '.join(CHOSEN)}": CHOSEN, "chosen for none": {}}


def _ratios(count: int, terms: Sequence[str], made: Made) -> Row:
    errors, sigmas, sigma0 = np.empty((count, len(terms))), np.empty((count, len(terms))), np.empty(count)
    for seed in range(count):
        result = adjust(*made(np.random.default_rng(seed), dict.fromkeys(terms, FREE)))
        if not result.converged:
            raise RuntimeError(f"network {seed} ended with {result.termination}")
        errors[seed] = [result.value(f"SC.S.{name}") - BEND_MM[name] for name in terms]
        sigmas[seed] = [result.sigma(f"SC.S.{name}") for name in terms]
        sigma0[seed] = result.sigma0
    each = np.sqrt((errors**2).mean(axis=0) / (sigmas**2).mean(axis=0))
    together = np.sqrt((errors**2 / (sigmas**2).mean(axis=0)).mean())
    um = 1e3 * np.sqrt((sigmas**2).mean(axis=0))
    spread = {"least": each.min(), "largest": each.max(), "claimed_um": um.min(), "to_um": um.max()}
    return {"terms": len(terms), "ratio": together, **spread, "sigma0": sigma0.mean()}


def _names_bend(result: Adjustment) -> bool:
    return any("lie alike in the scanner" in text for text in result.warnings)


def _chosen(truth: Mapping[str, float], seed: int) -> tuple[str, ...]:
    turns = QUARTERS * 2
    network = bent_films(turns, truth, {}, np.random.default_rng(seed))
    bent, _ = choose_bends(network, partial(adjust, approximations=_start(turns)))
    return tuple(bent.scanners[0].terms)
