"""Gross mistakes in whole networks (mirrored points, wrong unit, y down, wrong c, exchanged frames): how they are
diagnosed.

python -m benchmarks planted_slips [NETWORKS]

Networks of four images and 14 to 30 control points of 5 cm, different for each seed; one row per kind of mistake.
named: only the mistake is named; unnamed: nothing is named; misleading: something else is named.
"""

import sys
import time
from collections import Counter

from faults import BLUNDERS, blunder_network, blunder_outcome, blunder_sentences


def main() -> None:
    """Print the table."""
    networks = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    print(f"{'slip':58} {'named':>6} {'unnamed':>8} {'misleading':>11} {'CPU s each':>11}")
    for name, kind in BLUNDERS.items():
        begun, count = time.process_time(), Counter[str]()
        for seed in range(networks):
            count[blunder_outcome(kind, blunder_sentences(kind.spoil(blunder_network(seed, kind.oriented))))] += 1
        spent = (time.process_time() - begun) / networks
        print(
            f"{name:58} {count['named']:6d} {count['unnamed']:8d} {count['misleading']:11d} {spent:11.1f}", flush=True
        )


if __name__ == "__main__":
    main()
