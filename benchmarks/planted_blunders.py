"""Gross mistakes in whole networks (mirrored points, wrong unit, y down, wrong c, exchanged frames): how they are
diagnosed.

Networks of four images and 14 to 30 control points of 5 cm, different for each seed; one row per kind of mistake.
named: only the mistake is named; unnamed: nothing is named; misleading: something else is named.
"""

import time
from collections import Counter
from collections.abc import Iterator

from faults import BLUNDERS, blunder_network, blunder_outcome, blunder_sentences

from benchmarks.harness import Row

COLUMNS = {"blunder": "", "named": "d", "unnamed": "d", "misleading": "d", "cpu_s": ".1f"}


def cells() -> Iterator[Row]:
    yield from ({"blunder": name} for name in BLUNDERS)


def case(blunder: str, networks: int = 20) -> Row:
    kind, begun, count = BLUNDERS[blunder], time.process_time(), Counter[str]()
    for number in range(networks):
        spoilt = kind.spoil(blunder_network(number, kind.oriented))
        count[blunder_outcome(kind, blunder_sentences(spoilt))] += 1
    outcomes = {each: count[each] for each in ("named", "unnamed", "misleading")}
    return {**outcomes, "cpu_s": (time.process_time() - begun) / networks}
