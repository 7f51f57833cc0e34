"""Accuracy of measured marks against the Cramér-Rao bound, and validity of their standard deviations.

--marks: number per cell; 2000 for a full run. A value is RMS / bound and realised / claimed; -n: lost.

The images are rendered by `synthetic_images` (exact areas, blurred before averaging over the pixels); the bounds are
from differences of the same images. The measuring functions are those of `reseau measure`:
`measure.fiducials.mark_fit.detect_mark`, and `measure.targets.disks.fit_disk` for the ellipse.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray
from true_marks import KIND, KINDS, Kind, TrueMark, grain_correlation, grainy, some_mark, whitened_rms

from benchmarks.harness import Row, rms, table
from benchmarks.measured_marks import CONTRAST, GROUND, Cell, Found, best_errors, draw_mark, measure_mark, start_off
from measure.scans.jpeg import quantisation_step_dn

Array = NDArray[np.float64]
Noise = Callable[[int, np.random.Generator], Array]

SEED = 20
SNRS, BLURS_PX = (5.0, 10.0, 20.0, 50.0, 100.0), (0.6, 1.0, 1.6, 2.5)
POOL, FEW = 50, 3  # different marks per cell; FEW where the bound of each takes seconds
GRAINS_PX, GRAIN_SNR = (0.7, 1.0, 1.5), 20.0
CLEAN_SNRS, FRAMES_KNOWN = (50.0, 200.0, 500.0), (1e-4, 5e-4, 2e-3)
BEYOND, CLIPPED_SNR = (0.0, 0.3), 20.0
QUALITIES, JPEG_CONTRASTS, JPEG_SNR = (50, 75, 90), (40.0, 120.0), 100.0


def cells(marks: int = 100) -> Iterator[Row]:
    for study, (_, parts) in STUDIES.items():
        for kind in KINDS:
            if study != "clean" or np.isfinite(kind.known):
                yield from ({"study": study, "kind": kind.name, "part": part, "marks": marks} for part in parts)


def case(study: str, kind: str, part: float, marks: int, seed: int) -> Row:
    return {"values": STUDIES[study][0](KIND[kind], part, marks, [seed, KINDS.index(KIND[kind])])}


def report(rows: Sequence[Row]) -> Iterator[str]:
    for study, own in groupby(rows, lambda row: str(row["study"])):
        lines = [{"kind": row["kind"], study: row["part"], **row["values"]} for row in own]
        yield f"\n{STUDIES[study][0].__doc__}"
        yield from table(dict.fromkeys(lines[0], ""), lines)


def white(size: int, rng: np.random.Generator) -> Array:
    return rng.standard_normal((size, size))


def pool(kind: Kind, blur_px: float, count: int, rng: np.random.Generator) -> list[TrueMark]:
    return [some_mark(kind, blur_px, rng) for _ in range(count)]


def cell(
    marks: Sequence[TrueMark], snr: float, count: int, rng: np.random.Generator, grain_px: float | None = None
) -> str:
    """Measure count images of the marks in turn, each with new noise."""
    found, correlation = Cell(), None if grain_px is None else grain_correlation(grain_px)
    noise_of: Noise = white if grain_px is None else partial(_grainy, grain_px)
    for number in range(count):
        mark = marks[number % len(marks)]
        noise = noise_of(mark.size, rng) / snr
        grey, sign = draw_mark(mark, rng)
        off = start_off(mark, rng)
        best = best_errors(mark, sign * noise, 1 / snr, off, correlation)
        bound = mark.bound(1 / snr, None, correlation)
        found.add(mark, measure_mark(mark, grey + CONTRAST * noise, rng, off=off), best, bound)
    return found.words()


def accuracy(kind: Kind, blur_px: float, count: int, seeds: list[int]) -> Row:
    """White noise, by blur and SNR."""
    rng = np.random.default_rng([*seeds, int(10 * blur_px)])
    marks = pool(kind, blur_px, min(POOL, count), rng)
    return {f"SNR {snr:g}": cell(marks, snr, count, rng) for snr in SNRS}


def grain(kind: Kind, _part: float, count: int, seeds: list[int]) -> Row:
    """Grain at SNR 20, blur 1, a tenth of its variance white; the bound is for noise of this correlation."""
    rng = np.random.default_rng(seeds)
    marks = pool(kind, 1.0, FEW, rng)
    return {f"grain {grain_px:g} px": cell(marks, GRAIN_SNR, count, rng, grain_px) for grain_px in GRAINS_PX}


def clean(kind: Kind, snr: float, count: int, seeds: list[int]) -> Row:
    """Marks fitted with priors from the frame, by SNR and by the sigma of rotation, scale, stretch and shear."""
    row = {}
    for known in FRAMES_KNOWN:
        rng = np.random.default_rng([*seeds, int(snr)])
        row[f"{known:g}"] = cell(pool(replace(kind, known=known), 1.0, min(POOL, count), rng), snr, count, rng)
    return row


def bias(kind: Kind, _part: float, count: int, seeds: list[int]) -> Row:
    """No noise: largest error of a coordinate, px (random phase, rotation, scale, gradient, polarity)."""
    row, eight = {}, np.zeros(0)
    for blur_px in BLURS_PX:
        rng = np.random.default_rng([*seeds, int(10 * blur_px)])
        marks = pool(kind, blur_px, max(count // 2, 10), rng)
        row[f"16 bit, blur {blur_px:g}"] = f"{np.abs([clean_error(mark, rng, 65535) for mark in marks]).max():.4f}"
        if blur_px == 1.0:
            eight = np.array([clean_error(mark, rng, 255) for mark in marks])
    return row | {"8 bit, blur 1": f"{np.abs(eight).max():.4f}", "its rms": f"{rms(eight):.4f}"}


def clean_error(mark: TrueMark, rng: np.random.Generator, full_scale: int) -> Array:
    """Error without noise, with exact rotation and scale where they come from the frame."""
    contrast, ground = (CONTRAST, GROUND) if full_scale > 255 else (120.0, 60.0)
    found = measure_mark(
        mark, draw_mark(mark, rng, contrast, ground)[0], rng, full_scale, off=start_off(mark, rng, exact=True)
    )
    if found is None:
        return np.full(2, np.inf)
    return np.asarray(found.center_px - mark.place[:, 2])


def clipping(kind: Kind, _part: float, count: int, seeds: list[int]) -> Row:
    """Clipping beyond a fraction of the contrast, blur 1, SNR 20: largest error without noise, px; bound of the
    unclipped mark."""
    rng, row = np.random.default_rng([*seeds, 7]), {}
    marks = pool(kind, 1.0, min(POOL, count), rng)
    for sign in (-1, 1):
        for beyond in BEYOND:
            found, clean_off = Cell(), []
            for number in range(count):
                mark = marks[number % len(marks)]
                grey = 65535 + CONTRAST * (beyond + sign * mark.picture - (sign + 1) / 2)
                noise = white(mark.size, rng) / CLIPPED_SNR
                if number < len(marks):
                    sharp = measure_mark(mark, grey, rng, off=start_off(mark, rng, exact=True))
                    clean_off.append(np.inf if sharp is None else np.abs(sharp.center_px - mark.place[:, 2]).max())
                off = start_off(mark, rng)
                best = best_errors(mark, sign * noise, 1 / CLIPPED_SNR, off)
                one = measure_mark(mark, grey + CONTRAST * noise, rng, off=off)
                found.add(mark, one, best, mark.bound(1 / CLIPPED_SNR))
            row[f"{'ground' if sign < 0 else 'mark'} {beyond:g}"] = f"{max(clean_off):.4f} {found.words()}"
    return row


def jpeg(kind: Kind, _part: float, count: int, seeds: list[int]) -> Row:
    """JPEG of 8 bit, SNR 100, blur 1: RMS, px, and realised / claimed, by contrast in grey values and quality."""
    row = {}
    for contrast in JPEG_CONTRASTS:
        for quality in QUALITIES:
            rng = np.random.default_rng([*seeds, quality])
            marks, errors, covariances = pool(kind, 1.0, min(POOL, count), rng), [], []
            for mark in (marks[number % len(marks)] for number in range(count)):
                found = measure_jpeg(mark, contrast, quality, rng)
                if found is not None and not found.flagged:
                    errors.append(found.center_px - mark.place[:, 2])
                    covariances.append(found.covariance_px2)
            row[f"{contrast:g}, {quality}"] = f"{rms(errors):.4f} {whitened_rms(errors, covariances):.2f}"
    return row


def measure_jpeg(mark: TrueMark, contrast: float, quality: int, rng: np.random.Generator) -> Found | None:
    noise = white(mark.size, rng) / JPEG_SNR
    shown, step_dn = compressed(draw_mark(mark, rng, contrast, 60.0)[0] + contrast * noise, quality, rng)
    return measure_mark(mark, shown, rng, 255, step_dn=step_dn)


def compressed(grey: Array, quality: int, rng: np.random.Generator) -> tuple[Array, float]:
    """Compress an image by JPEG, with a random offset of the blocks; returns it and the rounding step of the file."""
    top, left = rng.integers(0, 8, 2)
    stored = np.pad(np.clip(np.rint(grey), 0, 255).astype(np.uint8), ((top, 8), (left, 8)), mode="edge")
    data = cv2.imencode(".jpg", stored, (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    whole = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), float)
    return whole[top : top + grey.shape[0], left : left + grey.shape[1]], quantisation_step_dn(data.tobytes())


def misfit(kind: Kind, _part: float, count: int, seeds: list[int]) -> Row:
    """Claimed sigmas with the cause model misfit over those without it; realised / claimed without and with it; SNR
    20."""
    rng, row = np.random.default_rng([*seeds, 3]), {}
    marks = pool(kind, 1.0, min(POOL, count), rng)
    noises: dict[str, Noise] = {"white": white}
    noises |= {f"grain {grain_px:g} px": partial(_grainy, grain_px) for grain_px in GRAINS_PX}
    for name in (*noises, f"JPEG {QUALITIES[1]}"):
        larger, errors, without, claimed = [], [], [], []
        for mark in (marks[number % len(marks)] for number in range(count)):
            if name in noises:
                noise = noises[name](mark.size, rng)
                found = measure_mark(mark, draw_mark(mark, rng)[0] + CONTRAST * noise / GRAIN_SNR, rng)
            else:
                found = measure_jpeg(mark, JPEG_CONTRASTS[0], QUALITIES[1], rng)
            if found is not None and not found.flagged:
                errors.append(found.center_px - mark.place[:, 2])
                claimed.append(found.covariance_px2)
                without.append(found.covariance_px2 - found.model_misfit_px2)
                larger.append(np.sqrt(np.trace(claimed[-1]) / np.trace(without[-1])))
        row[name] = f"{np.mean(larger):.3f} {whitened_rms(errors, without):.2f} {whitened_rms(errors, claimed):.2f}"
    return row


def _grainy(grain_px: float, size: int, rng: np.random.Generator) -> Array:
    return grainy(size, grain_px, rng)


Study = Callable[[Kind, float, int, list[int]], Row]
STUDIES: dict[str, tuple[Study, Sequence[float]]] = {
    "accuracy": (accuracy, BLURS_PX),
    "clean": (clean, CLEAN_SNRS),
    **{study.__name__: (study, (0.0,)) for study in (bias, grain, clipping, jpeg, misfit)},
}
