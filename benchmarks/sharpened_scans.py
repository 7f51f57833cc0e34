"""Frames sharpened by the scanner: amounts 0 to 2, radii 0.5 to 3 px, various tone curves, half of them JPEG.

Eight marks of one kind on uniform film with grain, SNR 20 to 80, are coded with a gamma of 1 to 2.4, sharpened by an
unsharp mask, clipped and quantised to 8 bits. Results by amount: rate of `measured` marks, RMS of their whitened errors
(error / claimed sigma), and number of frames identified as sharpened.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from true_marks import KIND, some_mark

from benchmarks.harness import Row, table
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.scans.opening import open_scan
from measure.tone.curve import Tone
from synthetic_images.tone_curve import coded

COLUMNS = {"frame": "d", "kind": "", "amount": ".2f", "radius_px": ".2f", "power": ".2f", "jpeg": "d", "snr": ".0f",
           "measured": "d", "wrong": "d", "whitened": ".2f", "found": ".2f", "found_px": ".2f"}  # fmt: skip
SEED = 1
KINDS = "cross", "gap cross", "réseau cross", "ring-cross", "wedge"
PX_PER_MM, SIDE_PX, AT_MM = 10.0, 460, 15.0
PLACES = [(x, y) for y in (-AT_MM, 0.0, AT_MM) for x in (-AT_MM, 0.0, AT_MM) if x or y]
GROUPS = (0.0, 1e-6, 0.5, 1.0, 2.01)  # bounds of the groups of amounts; the first group is not sharpened


def cells(frames: int = 300) -> Iterator[Row]:
    for frame in range(frames):
        rng = np.random.default_rng([frame, 7])
        amount = 0.0 if frame % 6 == 0 else float(rng.uniform(0.0, 2.0))
        yield {
            "frame": frame,
            "kind": KINDS[frame % len(KINDS)],
            "amount": amount,
            "radius_px": float(np.exp(rng.uniform(np.log(0.5), np.log(3.0)))),
            "power": float(rng.uniform(1.0, 2.4)),
            "jpeg": int(rng.integers(90, 99)) if rng.random() < 0.5 else 0,
            "snr": float(np.exp(rng.uniform(np.log(20), np.log(80)))),
        }


def case(frame: int, kind: str, amount: float, radius_px: float, power: float, jpeg: int, snr: float, seed: int) -> Row:
    rng = np.random.default_rng([frame, seed])
    layout, light, true_px = draw(kind, snr, float(rng.uniform(0.5, 1.2)), rng)
    code = coded(np.clip(light, 0.0, 1.0).astype(np.float32), power).astype(float)
    code += amount * (code - gaussian_filter(code, radius_px, mode="nearest"))
    stored = np.rint(255 * np.clip(code, 0.0, 1.0)).astype(np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("frame.jpg" if jpeg else "frame.png")
        cv2.imwrite(str(path), stored, [cv2.IMWRITE_JPEG_QUALITY, jpeg] if jpeg else [])
        with open_scan(path) as scan:
            pitch_um = 1000 / PX_PER_MM
            shown = scan.replace_tone(Tone.unknown())
            result = measure_fiducials(shown, layout, (pitch_um, pitch_um), FiducialOptions(pose="0"))
    sums, observed, wrong = 0.0, 0, 0
    for mark, place in zip(result.marks, true_px, strict=True):
        if mark.status is Status.MEASURED and mark.center_px is not None and mark.covariance_px2 is not None:
            error = mark.center_px - place
            square = float(error @ np.linalg.solve(mark.covariance_px2, error))
            sums, observed, wrong = sums + square, observed + 1, wrong + (square > 25.0)
    sharpening = result.tone.tone.sharpening if result.tone else None
    return {
        "measured": observed,
        "wrong": wrong,
        "whitened": float(np.sqrt(sums / (2 * observed))) if observed else None,
        "found": sharpening.amount if sharpening else 0.0,
        "found_px": sharpening.radius_px if sharpening else None,
    }


def draw(
    name: str, snr: float, blur_px: float, rng: np.random.Generator
) -> tuple[FiducialLayout, np.ndarray, list[np.ndarray]]:
    """Render a frame; returns its layout, its light, and the true places of the marks."""
    kind, middle = KIND[name], SIDE_PX / 2 + rng.uniform(-0.5, 0.5, 2)
    layout = tuple(LayoutMark(str(n), place, (0.005, 0.005), kind.shape) for n, place in enumerate(PLACES))
    linear, ground = PX_PER_MM * np.diag([1.0, -1.0]), float(rng.uniform(0.25, 0.6))
    contrast = ground * float(rng.uniform(0.4, 0.8)) * rng.choice([-1.0, 0.6])
    grain = gaussian_filter(rng.standard_normal((SIDE_PX, SIDE_PX)), 0.7)
    light, true_px = ground + abs(contrast) / snr * grain / grain.std(), []
    for place in PLACES:
        some = some_mark(kind, blur_px, rng)
        corner = np.rint(linear @ place + middle).astype(int) - some.size // 2
        mark = replace(some, place=np.column_stack([linear, linear @ place + middle - corner]))
        light[corner[1] :, corner[0] :][: mark.size, : mark.size] += contrast * mark.picture
        true_px.append(linear @ place + middle)
    return FiducialLayout(layout, (36.0, 36.0)), light, true_px


def report(rows: Sequence[Row]) -> Iterator[str]:
    lines = []
    for low, high in pairwise(GROUPS):
        group = [row for row in rows if low <= row["amount"] < high]
        count = sum(row["measured"] for row in group)
        squares = sum(row["measured"] * row["whitened"] ** 2 for row in group if row["measured"])
        lines.append({
            "amount": low, "to": high, "frames": len(group), "measured": count / max(len(PLACES) * len(group), 1),
            "whitened": np.sqrt(squares / max(count, 1)), "beyond 5 sigmas": sum(row["wrong"] for row in group),
            "taken for sharpened": sum(row["found"] > 0 for row in group),
        })  # fmt: skip
    specs = {"measured": ".1%", "whitened": ".2f", "amount": "g", "to": "g"}
    return table({name: specs.get(name, "d") for name in lines[0]}, lines)
