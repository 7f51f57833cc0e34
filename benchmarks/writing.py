"""Scan orientation (pose) from the writing in rendered frames, against the true pose.

Frames with four equal marks, in all poses, with all backgrounds, negatives included, blurred, grainy, compressed.
Titles of 6 to 40 characters are at one side, some with words that read the same upside down or mirrored; some frames
have a data plate at the opposite side, or a handwritten number anywhere. Three of four cameras specify where they
write. The frames without writing are of such cameras, too.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from benchmarks.harness import Row, table
from benchmarks.lone_frames import lone_frame, make_fiducials, make_image, painted
from benchmarks.search_frames import SIDES
from benchmarks.writing_lines import ALIKE, line_text
from measure.annotations.lines import Line, Reading, is_plate
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.geometry import POSES
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, Side, WrittenPlace, ring_cross
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from synthetic_images.scene import (
    Background,
    Scene,
    SceneFilm,
    SceneScanner,
    Tones,
    Writing,
)
from synthetic_images.writing import FONTS, HANDWRITING

Generator = np.random.Generator

SEED = 63
FRAME_MM, PITCH_UM, MARGIN_MM, AT_MM = 24.0, 40.0, 4.2, 10.6
READABLE = 12  # characters drawn, or read with confidence, that make a frame readable
BINS = (0.0, 1.0, 2.0, 4.0, 6.0, 7.0, 8.5)
OPPOSITE: Mapping[Side, Side] = {"left": "right", "right": "left", "top": "bottom", "bottom": "top"}
TURNED: Mapping[str, str] = {"0": "180", "180": "0", "90": "270", "270": "90"}


def cells(frames: int = 500, without: int = 200) -> Iterator[Row]:
    """Frames, those without writing spread over the run."""
    total = frames + without
    for index in range(total):
        yield {"index": index, "written": (index + 1) * without // total == index * without // total}


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Outcomes of the poses, and the rate of correct ones by log-odds."""
    known = [row for row in rows if row["places"] and row["letters"] >= READABLE]
    classes = {
        f"places known, {READABLE} and more characters": known,
        f"of these with {READABLE} and more legible ones": [row for row in known if legible(row) >= READABLE],
        f"places known, fewer than {READABLE}": [r for r in rows if r["places"] and 0 < r["letters"] < READABLE],
        "places not known": [r for r in rows if not r["places"] and r["letters"]],
        "nothing written": [r for r in rows if not r["letters"]],
    }
    for name, own in classes.items():
        outcomes = sorted(Counter(outcome(row) for row in own).items())
        yield f"{name}: {len(own)} frames: {', '.join(f'{count} {result}' for result, count in outcomes)}"
    yield from (str(row) for row in rows if "WRONG" in outcome(row))
    read = [row for row in rows if row["letters"] and row["likelihoods"]]
    leads = {"mirrored or not": [mirror_lead(row) for row in read]}
    leads["turn among the four, places known"] = [turn_lead(row) for row in read if row["places"]]
    yield from table({"log-odds of": "", "from": ".1f", "to": ".1f", "frames": "d", "right": "d"}, _by_lead(leads))


def legible(row: Row) -> float:
    """Number of legible characters, weighted by confidence."""
    return float(sum(max(each["ways"].values()) for each in row["read"]))


def outcome(row: Row) -> str:
    """Outcome of one frame, in words."""
    if row["found"] is None:
        return "not found"
    right = row["found"] == row["true"]
    if row["decided"]:
        return "decided right" if right else "decided WRONG"
    mirrored = row["found"].endswith("m") == row["true"].endswith("m")
    sure = abs(mirror_lead(row)[0]) >= 7.0 if row["likelihoods"] else False
    return f"assumed, mirror {'told' if sure else 'assumed'} {'right' if mirrored else 'WRONG' if sure else 'wrong'}"


def mirror_lead(row: Row) -> tuple[float, bool]:
    """Log-odds of the better of mirrored and not mirrored, and whether it is correct."""
    plain, mirrored = (
        max(value for pose, value in row["likelihoods"].items() if pose.endswith("m") == face) for face in (False, True)
    )
    return abs(plain - mirrored), (mirrored > plain) == row["true"].endswith("m")


def turn_lead(row: Row) -> tuple[float, bool]:
    """Log-odds of the best of the four quarter turns against the next, with the true mirroring, and whether it is
    correct."""
    own = {p: v for p, v in row["likelihoods"].items() if p.endswith("m") == row["true"].endswith("m")}
    best, second, *_ = sorted(own, key=lambda pose: -own[pose])
    return own[best] - own[second], best == row["true"]


def _by_lead(leads: Mapping[str, Iterable[tuple[float, bool]]]) -> Iterator[Row]:
    for name, result in leads.items():
        for low, high in pairwise(BINS):
            inside = [right for lead, right in result if low <= lead < high]
            if inside:
                yield {"log-odds of": name, "from": low, "to": high, "frames": len(inside), "right": sum(inside)}


def case(index: int, written: bool) -> Row:
    """Render and measure one frame."""
    rng = np.random.default_rng([SEED, index])
    side = SIDES[rng.integers(4)]
    way = str(rng.choice(("0", "180") if side in ("top", "bottom") else ("90", "270")))
    plate_way = TURNED[way] if rng.random() < 0.7 else way
    lines = titles(rng, side, way)
    lines += plate(rng, OPPOSITE[side], plate_way) if rng.random() < 0.4 else []
    lines += draw_handwriting(rng) if rng.random() < 0.4 else []
    known = (WrittenPlace(side, way), WrittenPlace(OPPOSITE[side], plate_way, plate=True))
    places = known if rng.random() < 0.75 else ()
    mark = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1))
    corners = [(AT_MM, -AT_MM), (-AT_MM, -AT_MM), (-AT_MM, AT_MM), (AT_MM, AT_MM)]
    marks = tuple(LayoutMark(str(number), xy, (0.005, 0.005), mark) for number, xy in enumerate(corners, 1))
    made = scene(rng, marks, tuple(lines) if written else ())
    grey = painted(made)
    scan = Scan(Path(f"{index}.tif"), WholePicture(stored(rng, grey)[..., None]), NO_TAGS)
    layout = FiducialLayout(marks, (FRAME_MM, FRAME_MM), places)
    found = measure_fiducials(scan, layout, (PITCH_UM, PITCH_UM), FiducialOptions(writing="pose"))
    return {
        "true": made.images[0].pose,
        "places": [(place.side, place.pose, place.plate) for place in places],
        "letters": sum(len(line.text.replace(" ", "")) for line in lines) if written else 0,
        "texts": [line.text for line in lines],
        "found": None if found.pose is None else found.pose.name,
        "decided": found.pose is not None and found.pose.decided,
        "likelihoods": {} if found.pose is None else dict(found.pose.written),
        "read": [
            {"text": each.text, "side": each.side, "ways": {way: read.legible for way, read in each.ways.items()}}
            for each in found.writing or ()
        ],
        "evidence": [] if found.pose is None else list(found.pose.evidence),
    }


def titles(rng: Generator, side: Side, way: str) -> list[Writing]:
    """Random titles: 6 to 40 characters in one to four lines."""
    requests, lines, letters = int(rng.integers(6, 41)), list[Writing](), 0
    while letters < requests and len(lines) < 4:
        text = str(rng.choice(ALIKE)) if rng.random() < 0.2 else line_text(rng)
        if len(text) > requests - letters + 3 or is_plate(
            Line({"0": Reading(text, 1.0, 1.0)}, "0", ((0, 0),) * 4, side)
        ):
            continue
        lines.append(line(rng, text, side, way, len(lines)))
        letters += len(text.replace(" ", ""))
    return lines


def plate(rng: Generator, side: Side, way: str) -> list[Writing]:
    number = f"Nr {int(rng.integers(100, 20000))} {float(rng.uniform(151, 155)):.2f}"
    texts = ["WILD 15/4 UAG", number] if rng.random() < 0.5 else [number]
    return [line(rng, text, side, way, index) for index, text in enumerate(texts)]


def draw_handwriting(rng: Generator) -> list[Writing]:
    side = SIDES[rng.integers(4)]
    way = str(rng.choice(("0", "180") if side in ("top", "bottom") else ("90", "270")))
    return [line(rng, str(int(rng.integers(1, 9999))), side, way, 4, HANDWRITING)]


def line(rng: Generator, text: str, side: Side, way: str, slot: int, font: str | None = None) -> Writing:
    """Line of text at one of five places along a side: two rows of two, and one at the end."""
    height = float(rng.uniform(0.45, 0.75))
    height = min(height, 9.5 / (0.8 * len(text)))
    along = (-5.2, 5.2, -5.2, 5.2, 11.3)[slot]
    away = FRAME_MM / 2 + (1.0, 1.0, 2.6, 2.6, 1.8)[slot]
    xy = {"left": (-away, along), "right": (away, along), "top": (along, away), "bottom": (along, -away)}[side]
    return Writing(text, xy, height, float(way), False, font or str(rng.choice(FONTS)))


def scene(rng: Generator, marks: tuple[LayoutMark, ...], lines: tuple[Writing, ...]) -> Scene:
    scale = 1.0 + rng.normal(0.0, 0.001, 2)
    image = make_image(
        str(rng.choice(POSES)),
        float(rng.normal(0.0, 0.8)),
        scale,
        float(rng.normal(0.0, 3e-4)),
        neighbour=SIDES[rng.integers(4)] if not lines and rng.random() < 0.5 else None,
        writing=lines,
    )
    scanner = SceneScanner(
        (PITCH_UM, PITCH_UM),
        margin_mm=MARGIN_MM,
        blur_px=float(rng.uniform(0.5, 1.2)),
        noise=0.01,
        negative=bool(rng.random() < 0.3),
    )
    return lone_frame(
        "written",
        int(rng.integers(2**31)),
        FRAME_MM,
        make_fiducials(marks),
        image,
        scanner=scanner,
        film=SceneFilm(
            deformation_um=3.0, grain=float(rng.uniform(0.0, 0.03)), grain_px=1.0, dust=30, scratches=3, hairs=3
        ),
        tones=Tones(background=float(rng.uniform(0.25, 0.5)), contrast=float(rng.uniform(0.04, 0.12))),
        background=get_args(Background)[rng.integers(3)],
        pad_mm=1.4,
    )


def stored(rng: Generator, grey: np.ndarray[Any, np.dtype[np.uint16]]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Convert to 8 bits, half of the images with JPEG compression."""
    picture = (grey >> 8).astype(np.uint8)
    if rng.random() < 0.5:
        _, packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(40, 95))])
        picture = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)
    return picture
