"""Explanations of a large sigma0: effects planted into networks of a digital camera, and whether they are named.

python -m benchmarks large_sigma0 [NETWORKS] [TIMES] [KIND...]

NETWORKS (20) of each kind, with new seeds, flat boards and deep fields; the effect is TIMES (3) the size that its test
at a significance level of 0.001 detects with a power of 0.80; five times as many networks without an effect. named:
only the effect is named; unnamed: nothing is named; misleading: anything else is named.
"""

import sys
import time
from collections import Counter

from faults import MANY, MISFITS, NOTHING, draw_network, misfit_outcome, misfit_sentences

SOUND = 5  # factor of the number of networks without an effect


def main() -> None:
    """Print the table."""
    networks = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    many = float(sys.argv[2]) if len(sys.argv) > 2 else MANY
    print(f"{'planted':28} {'named':>6} {'unnamed':>8} {'misleading':>11} {'sigma0':>18} {'CPU s each':>11}")
    for name in sys.argv[3:] or MISFITS:
        count, sizes, spent = Counter[str](), [], 0.0
        for seed in range(networks * (SOUND if name == NOTHING else 1)):
            network = draw_network(name, seed, many)
            begun = time.process_time()
            sentences, sigma0 = misfit_sentences(network)
            spent += time.process_time() - begun
            found = misfit_outcome(name, sentences)
            count[found] += 1
            sizes.append(sigma0)
            if found != "named":
                print(f"  {name}, seed {seed}: {found}: {sentences}", file=sys.stderr, flush=True)
        print(
            f"{name:28} {count['named']:6d} {count['unnamed']:8d} {count['misleading']:11d} "
            f"{min(sizes):6.2f} to {max(sizes):8.2f} {spent / len(sizes):11.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
