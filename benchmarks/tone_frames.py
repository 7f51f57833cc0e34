"""Frames stored through a tone curve that the program does not know, in 16 or 8 bits or as JPEG.

The frames of `search` (marks, poses, exposure, clutter), with a gamma of 1, 1.8 or 2.2, the curve of sRGB or an
S-shaped one. Printed by curve and by storage: marks `measured`, RMS of their whitened errors, and observations off by
more than five of their claims.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from benchmarks.harness import Row, table
from benchmarks.search import WRONG_SIGMAS
from benchmarks.search_frames import KINDS, PITCH_UM, SYMMETRIES, draw_layout, make_case
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.scans.cache import WholePicture
from measure.scans.jpeg import quantisation_step_dn
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from measure.tone.curve import Tone

CURVES: tuple[float | str, ...] = (1.0, 1.8, 2.2, "srgb", "s-curve")
STORED = ("16 bits", "8 bits", "JPEG")
QUALITY = (60, 96)  # of JPEG, from and below


def cells(frames: int = 1000, first: int = 0) -> Iterator[Row]:
    yield from ({"frame": index} for index in range(first, first + frames))


def case(frame: int, seed: int) -> Row:
    rng = np.random.default_rng([seed, frame, 1])
    kind, symmetry = str(rng.choice(KINDS)), str(rng.choice(SYMMETRIES))
    curve, stored = CURVES[frame % len(CURVES)], str(rng.choice(STORED))
    shown = make_case(rng, kind, symmetry, draw_layout(rng, kind, symmetry), f"{frame}.tif", gamma=curve)
    shown = replace(shown, scan=store(shown.scan, stored, rng).replace_tone(Tone.unknown()))
    squares, wrong, observed, measured = [], [], 0, 0
    pitch_um = (PITCH_UM, PITCH_UM)
    for mark in measure_fiducials(shown.scan, shown.layout, pitch_um, FiducialOptions(pose=shown.pose)).marks:
        if not mark.status.is_observation or mark.center_px is None or mark.covariance_px2 is None:
            continue
        error = np.asarray(mark.center_px) - shown.centers_px[mark.point]
        square = float(error @ np.linalg.solve(mark.covariance_px2, error))
        observed += 1
        if mark.status is Status.MEASURED:
            measured += 1
            squares.append(square)
        if square > WRONG_SIGMAS**2 or mark.point in shown.hidden:
            wrong.append(f"{mark.point} {mark.status}: {np.sqrt(square):.1f}")
    return {
        "kind": kind, "curve": str(curve), "stored": stored, "visible": len(shown.centers_px) - len(shown.hidden),
        "observed": observed, "measured": measured, "squares": sum(squares), "wrong": wrong,
    }  # fmt: skip


def store(scan: Scan, stored: str, rng: np.random.Generator) -> Scan:
    """The scan with its samples as the file would have them."""
    if stored == "16 bits":
        return scan
    grey = np.rint(scan.samples(0, 0, scan.width_px, scan.height_px) / 257.0).astype(np.uint8)
    if stored == "8 bits":
        return Scan(scan.path, WholePicture(grey), NO_TAGS)
    data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(*QUALITY))])[1]
    grey = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    return Scan(scan.path, WholePicture(grey[..., None], quantisation_step_dn(data.tobytes())), NO_TAGS)


def report(rows: Sequence[Row]) -> Iterator[str]:
    for name in ("curve", "stored", "kind"):
        lines = []
        for value in sorted({row[name] for row in rows}):
            own = [row for row in rows if row[name] == value]
            sums = {key: sum(row[key] for row in own) for key in ("visible", "observed", "measured", "squares")}
            lines.append({
                name: value, "frames": len(own), **sums,
                "error/claim": float(np.sqrt(sums["squares"] / max(2 * sums["measured"], 1))),
                "beyond 5": sum(len(row["wrong"]) for row in own),
            })  # fmt: skip
        counts = dict.fromkeys(("frames", "visible", "observed", "measured"), "d")
        yield ""
        yield from table({name: "", **counts, "error/claim": ".2f", "beyond 5": "d"}, lines)
    yield f"beyond 5 claims: {[(row['frame'], row['wrong']) for row in rows if row['wrong']]}"
