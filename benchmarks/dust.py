"""Marks and disks among dust: against those whose dust is known, alone and in frames, and small ones.

python -m benchmarks dust [MARKS] [STUDY ...] [--kind KIND ...] [--seed SEED] [--keep FILE]

MARKS: of every cell, of small disks frames of 25; 160 where none is given. STUDY: one or more of the names below; all
where none is given. --keep: rows of the tables are written there, and those that stand in it are not made anew.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from true_marks import KIND, KINDS, Kind, some_mark

from benchmarks.dusty_marks import BLUR_PX, DUST_SNR, DustyMark, frame_of_disks, frame_of_marks, lone_mark
from benchmarks.kept_rows import KeptRows
from benchmarks.measured_marks import Cell, drawn

DUST = (0.01, 0.03, 0.05)
SEED = 20
POOL = 50  # different lone marks in a cell
DISK_PX = 6.0
LARGE_PX = 0.3


@dataclass
class DustyCell(Cell):
    """Errors beside those of the same match with the dust known, `lost` being those flagged; large: of the errors above
    LARGE_PX those not flagged, px, and how many there are in all."""

    large: list[float] = field(default_factory=list)
    all_large: int = 0

    def put(self, dusty: DustyMark) -> None:
        size = float(np.hypot(*dusty.error_px))
        if size > LARGE_PX:
            self.all_large += 1
            self.large += [] if dusty.flagged else [size]
        if dusty.told is not None:
            best = dusty.told.center_px - dusty.mark.place[:, 2]
            self.add(dusty.mark, dusty.found, best, dusty.told.covariance_px2)

    def words(self) -> str:
        large = f" {len(self.large)}/{self.all_large} {max(self.large, default=0.0):.2f}" if self.all_large else ""
        return super().words() + large


def alone(kind: Kind, share: float, count: int, rng: np.random.Generator) -> Iterator[DustyMark]:
    """Marks with a gradient, light and dark, that no frame knows."""
    marks = [some_mark(kind, BLUR_PX, rng) for _ in range(min(POOL, count))]
    for number in range(count):
        mark = marks[number % len(marks)]
        yield lone_mark(mark, drawn(mark, rng)[0], share, rng)


def in_frames(kind: Kind, share: float, count: int, rng: np.random.Generator, of: int = 8) -> Iterator[DustyMark]:
    """Marks in frames of eight, disks in frames of 25."""
    made = 0
    while made < count:
        if kind.name == "ellipse":
            frame, _ = frame_of_disks([share], (DISK_PX, DISK_PX), (DUST_SNR, DUST_SNR), (BLUR_PX, BLUR_PX), rng)
        else:
            frame = frame_of_marks(kind, share, of, rng)
        made += len(frame)
        yield from frame


STUDIES: dict[str, Callable[[Kind, float, int, np.random.Generator], Iterable[DustyMark]]] = {
    "alone": alone,
    "frames": in_frames,
    "frames_of_four": partial(in_frames, of=4),
}


def table(name: str, kinds: Sequence[Kind], count: int, seed: int, rows: KeptRows) -> None:
    """One study of STUDIES."""
    print(
        f"\n{name}, SNR {DUST_SNR:g}, blur {BLUR_PX:g}: rms / that with the dust known, realised / claimed; -n: flagged"
    )
    print(f"then, of errors above {LARGE_PX:g} px, those not flagged / all, and the worst of the former in px")
    print(f"{'':14}" + "".join(f"{f'{100 * share:g} %':>26}" for share in DUST))

    def row(kind: Kind) -> str:
        rng = np.random.default_rng([seed, KINDS.index(kind)])
        cells = []
        for share in DUST:
            cells.append(DustyCell())
            for dusty in STUDIES[name](kind, share, count, rng):
                cells[-1].put(dusty)
        return f"{kind.name:14}" + "".join(f"{cell.words():>26}" for cell in cells)

    for kind in kinds:
        rows.print(f"{name} {seed} {count} {kind.name}", partial(row, kind))


def small_disks(count: int, seed: int) -> None:
    """Disks of 2 to 4 px among dust, in frames: are large errors flagged?"""
    print(f"\nsmall disks with dust on 0 to 5 % of their windows, SNR 10 to 50: errors above {LARGE_PX:g} px")
    generators = (np.random.default_rng([seed, number]) for number in range(count))
    frames = [frame_of_disks((0.0, *DUST), (2.0, 4.0), (10.0, 50.0), (0.6, 1.4), rng) for rng in generators]
    errors = np.array([np.hypot(*dusty.error_px) for disks, _ in frames for dusty in disks])
    flagged = np.array([dusty.flagged for disks, _ in frames for dusty in disks])
    clean = np.concatenate([dusts for _, dusts in frames]) == 0
    seen, large = np.isfinite(errors), np.nan_to_num(errors) > LARGE_PX
    missed = errors[large & ~flagged]
    print(
        f"{len(errors)} disks, {(~seen).sum()} refused, {(seen & flagged).sum()} weak; of {clean.sum()} without dust "
        f"{(~seen & clean).sum()} and {(seen & flagged & clean).sum()}; {large.sum()} with large errors, {len(missed)} "
        f"of them not flagged, the worst {missed.max(initial=0.0):.2f} px"
    )


def main() -> None:
    """Print the studies asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("marks", type=int, nargs="?", default=160)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, "small_disks", []])
    parser.add_argument("--kind", action="append", choices=list(KIND))
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    rows = KeptRows(arguments.keep)
    for name in arguments.studies or [*STUDIES, "small_disks"]:
        if name == "small_disks":
            small_disks(arguments.marks, arguments.seed)
        else:
            table(name, [KIND[each] for each in arguments.kind or KIND], arguments.marks, arguments.seed, rows)


if __name__ == "__main__":
    main()
