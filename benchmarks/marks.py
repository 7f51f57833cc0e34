"""Marks measured against their truth: the Cramér-Rao bound, honesty of the standard deviations.

python -m benchmarks marks [MARKS] [STUDY ...] [--kind KIND ...] [--keep FILE]

MARKS: of every cell; 100 where none is given, 2000 for a full run. STUDY: one or more of the names below; all where
none is given. --keep: rows of the tables are written there, and those that stand in it are not made anew, so that a
run may be stopped and go on, or be shared out by --kind among processes.

The pictures are drawn by `synthetic_images` (exact areas, blurred before they are averaged over pixels); the bounds are
from differences of the same pictures. What is measured with is what `reseau measure` calls:
`measure.fiducials.mark_fit.detect_mark`, and `measure.targets.disks.fit_disk` for the ellipse.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from true_marks import (
    KIND,
    KINDS,
    Kind,
    TrueMark,
    grain_correlation,
    grainy,
    some_mark,
    whitened_rms,
)

from benchmarks.kept_rows import KeptRows
from benchmarks.measured_marks import CONTRAST, GROUND, Cell, best_errors, drawn, measured, start_off
from measure.scans.jpeg import rounding_step_dn

Array = NDArray[np.float64]

SNRS, BLURS_PX = (5.0, 10.0, 20.0, 50.0, 100.0), (0.6, 1.0, 1.6, 2.5)
SEED = 20
POOL, FEW = 50, 3  # different marks in a cell; where the bound of each takes seconds
GRAINS_PX, GRAIN_SNR = (0.7, 1.0, 1.5), 20.0
CLEAN_SNRS, FRAMES_KNOWN = (50.0, 200.0, 500.0), (1e-4, 5e-4, 2e-3)
BEYOND, CLIPPED_SNR = (0.0, 0.3), 20.0
ROWS = KeptRows(None)
QUALITIES, JPEG_CONTRASTS, JPEG_SNR = (50, 75, 90), (40.0, 120.0), 100.0


def accuracy(kinds: Sequence[Kind], count: int) -> None:
    """White noise: every kind, blur and SNR."""
    print("\nwhite noise: rms / bound, realised / claimed; -n: lost")
    print(f"{'':14}{'blur':>5}" + "".join(f"{f'SNR {snr:g}':>17}" for snr in SNRS))

    def row(kind: Kind, blur: float) -> str:
        rng = np.random.default_rng([SEED, KINDS.index(kind), int(10 * blur)])
        marks = [some_mark(kind, blur, rng) for _ in range(min(POOL, count))]
        cells = [Cell() for _ in SNRS]
        for snr, cell in zip(SNRS, cells, strict=True):
            for number in range(count):
                mark = marks[number % len(marks)]
                noise = rng.standard_normal((mark.size, mark.size)) / snr
                grey, sign = drawn(mark, rng)
                off = start_off(mark, rng)
                found = measured(mark, grey + CONTRAST * noise, rng, off=off)
                cell.add(mark, found, best_errors(mark, sign * noise, 1 / snr, off), mark.bound(1 / snr))
        return f"{kind.name:14}{blur:5.1f}" + "".join(f"{cell.words():>17}" for cell in cells)

    for kind in kinds:
        for blur in BLURS_PX:
            ROWS.print(f"accuracy {count} {kind.name} {blur}", partial(row, kind, blur))


def grain(kinds: Sequence[Kind], count: int) -> None:
    """Grain with a tenth of white noise in its variance: the bound is that of noise so correlated."""
    print(f"\ngrain at SNR {GRAIN_SNR:g}, blur 1: rms / coloured bound, realised / claimed")
    print(f"{'':14}" + "".join(f"{f'grain {grain_px:g} px':>17}" for grain_px in GRAINS_PX))

    def row(kind: Kind) -> str:
        rng = np.random.default_rng([SEED, KINDS.index(kind)])
        marks = [some_mark(kind, 1.0, rng) for _ in range(FEW)]
        words = []
        for grain_px in GRAINS_PX:
            cell, correlation = Cell(), grain_correlation(grain_px)
            for number in range(count):
                mark = marks[number % len(marks)]
                noise = grainy(mark.size, grain_px, rng) / GRAIN_SNR
                grey, sign = drawn(mark, rng)
                off = start_off(mark, rng)
                best = best_errors(mark, sign * noise, 1 / GRAIN_SNR, off, correlation)
                bound = mark.bound(1 / GRAIN_SNR, None, correlation)
                cell.add(mark, measured(mark, grey + CONTRAST * noise, rng, off=off), best, bound)
            words.append(cell.words())
        return f"{kind.name:14}" + "".join(f"{each:>17}" for each in words)

    for kind in kinds:
        ROWS.print(f"grain {count} {kind.name}", partial(row, kind))


def clean(kinds: Sequence[Kind], count: int) -> None:
    """Marks that lean on their frame, the better or worse this knows rotation, scale, stretch and shear."""
    print("\nclean scans, blur 1: rms / bound, realised / claimed, by the frame's standard deviation")
    print(f"{'':14}{'SNR':>5}" + "".join(f"{f'{known:g}':>17}" for known in FRAMES_KNOWN))

    def row(kind: Kind, snr: float) -> str:
        words = []
        for known in FRAMES_KNOWN:
            rng, cell = np.random.default_rng([SEED, KINDS.index(kind), int(snr)]), Cell()
            marks = [some_mark(replace(kind, known=known), 1.0, rng) for _ in range(min(POOL, count))]
            for number in range(count):
                mark = marks[number % len(marks)]
                noise, off = rng.standard_normal((mark.size, mark.size)) / snr, start_off(mark, rng)
                grey, sign = drawn(mark, rng)
                found = measured(mark, grey + CONTRAST * noise, rng, off=off)
                cell.add(mark, found, best_errors(mark, sign * noise, 1 / snr, off), mark.bound(1 / snr))
            words.append(cell.words())
        return f"{kind.name:14}{snr:5g}" + "".join(f"{each:>17}" for each in words)

    for kind in kinds:
        for snr in CLEAN_SNRS if np.isfinite(kind.known) else ():
            ROWS.print(f"clean {count} {kind.name} {snr}", partial(row, kind, snr))


def bias(kinds: Sequence[Kind], count: int) -> None:
    """Pictures without noise: what is left is the program's own error, and rounding."""
    print("\nno noise; largest error of a coordinate in px (phase, rotation, scale, gradient, polarity at random)")
    print(f"{'':14}" + "".join(f"{f'16 bit, {blur:g}':>12}" for blur in BLURS_PX) + f"{'8 bit, 1':>12}{'rms':>9}")

    def row(kind: Kind) -> str:
        words = []
        for blur in BLURS_PX:
            rng = np.random.default_rng([SEED, KINDS.index(kind), int(10 * blur)])
            marks = [some_mark(kind, blur, rng) for _ in range(max(count // 2, 10))]
            words.append(f"{np.abs([clean_error(mark, rng, 65535) for mark in marks]).max():12.4f}")
            if blur == 1.0:
                eight = [clean_error(mark, rng, 255) for mark in marks]
        words.append(f"{np.abs(eight).max():12.4f}{np.sqrt(np.mean(np.square(eight))):9.4f}")
        return f"{kind.name:14}" + "".join(words)

    for kind in kinds:
        ROWS.print(f"bias {count} {kind.name}", partial(row, kind))


def clean_error(mark: TrueMark, rng: np.random.Generator, full_scale: int) -> Array:
    """The error without noise, with rotation and scale known exactly where they come from the frame."""
    contrast, ground = (CONTRAST, GROUND) if full_scale > 255 else (120.0, 60.0)
    found = measured(mark, drawn(mark, rng, contrast, ground)[0], rng, full_scale, off=start_off(mark, rng, exact=True))
    if found is None:
        return np.full(2, np.inf)
    return np.asarray(found.center_px - mark.place[:, 2])


def clipping(kinds: Sequence[Kind], count: int) -> None:
    """Dark marks on a ground beyond the scanner's range, and light marks that are beyond it themselves."""
    print("\nclipped beyond so much of the contrast, blur 1: largest error without noise, px; then")
    print(f"at SNR {CLIPPED_SNR:g} rms / bound of the same mark whole, realised / claimed; -n: lost")
    names = [f"{'ground' if sign < 0 else 'mark'} {beyond:g}" for sign in (-1, 1) for beyond in BEYOND]
    print(f"{'':14}" + "".join(f"{name:>24}" for name in names))

    def row(kind: Kind) -> str:
        rng = np.random.default_rng([SEED, KINDS.index(kind), 7])
        marks = [some_mark(kind, 1.0, rng) for _ in range(min(POOL, count))]
        words = []
        for sign in (-1, 1):
            for beyond in BEYOND:
                cell, clean_off = Cell(), []
                for number in range(count):
                    mark = marks[number % len(marks)]
                    grey = 65535 + CONTRAST * (beyond + sign * mark.picture - (sign + 1) / 2)
                    noise = rng.standard_normal((mark.size, mark.size)) / CLIPPED_SNR
                    if number < len(marks):
                        clean = measured(mark, grey, rng, off=start_off(mark, rng, exact=True))
                        clean_off.append(np.inf if clean is None else np.abs(clean.center_px - mark.place[:, 2]).max())
                    off = start_off(mark, rng)
                    best = best_errors(mark, sign * noise, 1 / CLIPPED_SNR, off)
                    found = measured(mark, grey + CONTRAST * noise, rng, off=off)
                    cell.add(mark, found, best, mark.bound(1 / CLIPPED_SNR))
                words.append(f"{max(clean_off):8.4f} {cell.words()}")
        return f"{kind.name:14}" + "".join(f"{each:>24}" for each in words)

    for kind in kinds:
        ROWS.print(f"clipping {count} {kind.name}", partial(row, kind))


def jpeg(kinds: Sequence[Kind], count: int) -> None:
    """JPEG of several qualities, 8 bit."""
    print(f"\nJPEG, SNR {JPEG_SNR:g}, blur 1: rms in px, and realised / claimed; contrast in grey values")
    cells = [(contrast, quality) for contrast in JPEG_CONTRASTS for quality in QUALITIES]
    print(f"{'':14}" + "".join(f"{f'{contrast:g}, quality {quality}':>20}" for contrast, quality in cells))

    def row(kind: Kind) -> str:
        words = []
        for contrast, quality in cells:
            rng = np.random.default_rng([SEED, KINDS.index(kind), quality])
            marks = [some_mark(kind, 1.0, rng) for _ in range(min(POOL, count))]
            errors, covariances = [], []
            for number in range(count):
                mark = marks[number % len(marks)]
                noise = rng.standard_normal((mark.size, mark.size)) / JPEG_SNR
                grey = drawn(mark, rng, contrast, 60.0)[0] + contrast * noise
                shown, step_dn = compressed(grey, quality, rng)
                found = measured(mark, shown, rng, 255, step_dn=step_dn)
                if found is not None and not found.flagged:
                    errors.append(found.center_px - mark.place[:, 2])
                    covariances.append(found.covariance_px2)
            rms = np.sqrt(np.mean(np.square(errors)))
            words.append(f"{rms:8.4f} {whitened_rms(errors, covariances):6.2f}")
        return f"{kind.name:14}" + "".join(f"{each:>20}" for each in words)

    for kind in kinds:
        ROWS.print(f"jpeg {count} {kind.name}", partial(row, kind))


def compressed(grey: Array, quality: int, rng: np.random.Generator) -> tuple[Array, float]:
    """What JPEG makes of a picture, its blocks beginning anywhere, and the step to which the file rounds."""
    top, left = rng.integers(0, 8, 2)
    stored = np.pad(np.clip(np.rint(grey), 0, 255).astype(np.uint8), ((top, 8), (left, 8)), mode="edge")
    data = cv2.imencode(".jpg", stored, (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    whole = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), float)
    return whole[top : top + grey.shape[0], left : left + grey.shape[1]], rounding_step_dn(data.tobytes())


def unlike_drawing(kinds: Sequence[Kind], count: int) -> None:
    """By how much the cause `unlike drawing` makes claims larger under noise alone, where there is none."""
    print(
        f"\nclaims with `unlike drawing` over those without; error over claim without, and with it; SNR {GRAIN_SNR:g}"
    )
    ways = ("white", *(f"grain {grain_px:g} px" for grain_px in GRAINS_PX), f"JPEG {QUALITIES[1]}")
    print(f"{'':14}" + "".join(f"{way:>20}" for way in ways))

    def row(kind: Kind) -> str:
        rng = np.random.default_rng([SEED, KINDS.index(kind), 3])
        marks = [some_mark(kind, 1.0, rng) for _ in range(min(POOL, count))]
        words = []
        for grain_px in (0.0, *GRAINS_PX, None):
            larger, errors, known, with_it = [], [], [], []
            for number in range(count):
                mark = marks[number % len(marks)]
                noise = grainy(mark.size, grain_px, rng) if grain_px else rng.standard_normal((mark.size, mark.size))
                if grain_px is None:
                    grey = drawn(mark, rng, JPEG_CONTRASTS[0], 60.0)[0] + JPEG_CONTRASTS[0] * noise / JPEG_SNR
                    shown, step_dn = compressed(grey, QUALITIES[1], rng)
                    found = measured(mark, shown, rng, 255, step_dn=step_dn)
                else:
                    found = measured(mark, drawn(mark, rng)[0] + CONTRAST * noise / GRAIN_SNR, rng)
                if found is not None and not found.flagged:
                    errors.append(found.center_px - mark.place[:, 2])
                    with_it.append(found.covariance_px2)
                    known.append(found.covariance_px2 - found.unlike_drawing_px2)
                    larger.append(np.sqrt(np.trace(with_it[-1]) / np.trace(known[-1])))
            words.append(f"{np.mean(larger):.3f} {whitened_rms(errors, known):.2f} {whitened_rms(errors, with_it):.2f}")
        return f"{kind.name:14}" + "".join(f"{each:>20}" for each in words)

    for kind in kinds:
        ROWS.print(f"unlike {count} {kind.name}", partial(row, kind))


STUDIES: dict[str, Callable[[Sequence[Kind], int], None]] = {
    "accuracy": accuracy,
    "clean": clean,
    "bias": bias,
    "grain": grain,
    "clipping": clipping,
    "jpeg": jpeg,
    "unlike": unlike_drawing,
}


def main() -> None:
    """Print the studies asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("marks", type=int, nargs="?", default=100)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []])
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--kind", action="append", choices=list(KIND))
    arguments = parser.parse_args()
    global ROWS
    ROWS = KeptRows(arguments.keep)
    kinds = [KIND[name] for name in arguments.kind] if arguments.kind else KINDS
    print(f"{arguments.marks} marks a cell, seed {SEED}")
    for name in arguments.studies or STUDIES:
        begin = time.perf_counter()
        STUDIES[name](kinds, arguments.marks)
        print(f"({name}: {time.perf_counter() - begin:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
