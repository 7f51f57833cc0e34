"""Explanations of a large sigma0: effects planted into networks of a digital camera, and whether they are named.

New seeds, flat boards and deep fields; the effect is `times` the size that its test at a significance level of 0.001
detects with a power of 0.80; five times as many networks without an effect. named: only the effect is named; unnamed:
nothing is named; misleading: anything else is named.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator

from faults import MANY, MISFITS, NOTHING, draw_network, misfit_outcome, misfit_sentences

from benchmarks.harness import Row

SOUND = 5  # factor of the number of networks without an effect
COLUMNS = {
    "kind": "", "named": "d", "unnamed": "d", "misleading": "d", "least_sigma0": ".2f", "largest_sigma0": ".2f",
    "cpu_s": ".1f",
}  # fmt: skip


def cells(networks: int = 20) -> Iterator[Row]:
    yield from ({"kind": kind, "networks": networks * (SOUND if kind == NOTHING else 1)} for kind in MISFITS)


def case(kind: str, networks: int, times: float = MANY) -> Row:
    count, sizes, begun = Counter[str](), [], time.process_time()
    for seed in range(networks):
        sentences, sigma0 = misfit_sentences(draw_network(kind, seed, times))
        outcome = misfit_outcome(kind, sentences)
        count[outcome] += 1
        sizes.append(sigma0)
        if outcome != "named":
            print(f"  {kind}, seed {seed}: {outcome}: {sentences}", file=sys.stderr, flush=True)
    outcomes = {each: count[each] for each in ("named", "unnamed", "misleading")}
    cpu_s = (time.process_time() - begun) / networks
    return {**outcomes, "least_sigma0": min(sizes), "largest_sigma0": max(sizes), "cpu_s": cpu_s}
