"""Orientation of single lines of writing: rate at which the best reading is correct, by its lead over the others.

Four lines per scan, one at each side, as on films: titles, dates, heights, numbers, data plates, names, words that read
the same upside down or mirrored; in all fonts, 8 to 30 px high, blurred, grainy, faint, compressed, light or dark, the
scan in any pose. The log-odds of readings in the program are taken from this table.
"""

import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Row, table
from measure.annotations.text import MISSING, networks, read_writing
from measure.geometry import POSES, pose_in_camera
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from synthetic_images.areas import coverage
from synthetic_images.writing import FONTS, written_area

Array = NDArray[np.float64]
Generator = np.random.Generator

SEED = 61
SIZE_PX = 700
BINS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 40.0)
ALIKE = (
    *("NON", "808", "1001", "1961", "6009", "SOS", "NOON", "OXO", "1881", "WOW", "MOM", "8118", "609", "906", "66"),
    *("99", "TOT", "AHA", "11", "818", "ATTA", "HIOIH", "0880"),
)
NAMES = (
    *("CANBERRA", "ADASTRAPHOTO", "SURVEY", "DEVELOPMENT", "RECORD", "MAPPING", "OFFICE", "AERIAL", "CIVIL"),
    *("TERRITORY", "CAPITAL", "ZAGREB"),
)


def cells(scans: int = 250, first: int = 0) -> Iterator[Row]:
    yield from ({"scan": index} for index in range(first, first + scans))


def case(scan: int) -> Row:
    """Leads of the lines found: legible characters of the true orientation minus those of the other."""
    mirror, turn = np.reshape(count_turns(scan), (-1, 2)).T
    return {"mirrored": mirror, "upside down": turn}


def report(rows: Sequence[Row]) -> Iterator[str]:
    columns = {"question": "", "lead": "", "lines": "d", "wrong": "d", "log-odds": ".1f", "a character": ".2f"}
    leads = {name: np.concatenate([row[name] for row in rows]) for name in ("mirrored", "upside down")}
    for name, lead in leads.items():
        yield f"{name} or not: {len(lead)} lines, log-odds a character by maximum likelihood {slope(lead):.2f}"
    yield from table(columns, (line for name, lead in leads.items() for line in _by_lead(name, lead)))


def _by_lead(name: str, lead: Array) -> Iterator[Row]:
    for low, high in itertools.pairwise(BINS):
        inside = lead[(np.abs(lead) >= low) & (np.abs(lead) < high)]
        wrong = int((inside < 0).sum())
        odds = np.log((len(inside) - wrong + 0.5) / (wrong + 0.5))
        mean = float(np.abs(inside).mean()) if len(inside) else np.nan
        figures = {"lines": len(inside), "wrong": wrong, "log-odds": odds, "a character": odds / mean}
        yield {"question": name, "lead": f"{low} to {high}", **figures}


def slope(lead: Array) -> float:
    """Maximum-likelihood estimate of the log-odds per character."""
    trials = np.linspace(0.02, 4.0, 400)
    return float(trials[np.argmin([np.logaddexp(0.0, -each * lead).sum() for each in trials])])


def count_turns(index: int) -> list[tuple[float, float]]:
    """For each line found: lead of the true orientation, in characters, for mirroring and for rotation."""
    rng = np.random.default_rng([SEED, index])
    pose = str(rng.choice(POSES))
    grey = picture(rng)
    grey = np.rot90(grey[:, ::-1] if pose.endswith("m") else grey, int(pose.rstrip("m")) // 90)
    nets = networks()
    if nets is None:
        sys.exit(MISSING)
    scan = Scan(Path(f"{index}.tif"), WholePicture(np.ascontiguousarray(grey)[..., None]), NO_TAGS)
    found = []
    for line in read_writing(scan, nets):
        legible = {pose_in_camera(each, pose): reading.legible for each, reading in line.ways.items()}
        right, down, *mirrored = (legible.get(each, -1.0) for each in _possible_turns(legible))
        found.append((max(right, down) - max(mirrored), right - down))
    return found


def _possible_turns(legible: dict[str, float]) -> Sequence[str]:
    """Orientations: the true one, upside down, and both mirrored. Lines above and below read to the right, those at the
    sides upward."""
    return ("0", "180", "0m", "180m") if "0" in legible else ("90", "270", "90m", "270m")


def picture(rng: Generator) -> NDArray[np.uint8]:
    """Upright scan: lines above and below read to the right, those at the sides upward."""
    grey = np.zeros((SIZE_PX, SIZE_PX))
    for side in range(4):
        strip = line_picture(rng)
        place = int(rng.integers(40, SIZE_PX - strip.shape[1] - 40))
        away = int(rng.integers(6, 30))
        part = grey if side < 2 else np.rot90(grey, -1)  # a view: its rows run along the scan's columns
        row = away if side % 2 == 0 else SIZE_PX - away - strip.shape[0]
        part[row : row + strip.shape[0], place : place + strip.shape[1]] += strip
    contrast = float(rng.uniform(0.15, 0.9))
    dark = float(rng.uniform(0.0, 1.0 - contrast))
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), float(rng.uniform(0.4, 1.6))), float)
    grey = np.asarray(dark + contrast * (grey if rng.random() < 0.7 else 1.0 - grey), float)
    grain = np.asarray(cv2.GaussianBlur(rng.normal(0.0, 1.0, grey.shape), (0, 0), 0.8), float) / 0.35
    grey += contrast * float(rng.uniform(0.0, 0.15)) * grain
    stored = np.asarray(np.rint(255 * grey.clip(0, 1)), np.uint8)
    if rng.random() < 0.5:
        _, packed = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90))])
        stored = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)
    return stored


def line_picture(rng: Generator) -> Array:
    """Image of a line, light on dark, in a minimal frame."""
    text, font, height = line_text(rng), str(rng.choice(FONTS)), float(rng.uniform(8.0, 30.0))
    area = written_area(text, font)
    width = min(float(np.ptp(np.concatenate(area)[:, 0])), 0.75 * SIZE_PX / height)
    pixels = np.array([width * height + 8, 1.6 * height + 8]).astype(int)
    tilt = float(rng.normal(0.0, 0.015))
    turn = height * np.array([[np.cos(tilt), np.sin(tilt)], [np.sin(tilt), -np.cos(tilt)]])
    outlines = tuple(outline @ turn.T + pixels / 2 for outline in area)
    return np.asarray(coverage((outlines,), 0, 0, int(pixels[0]), int(pixels[1])), float)


def line_text(rng: Generator) -> str:
    """Random line of text as on films."""
    number = int(rng.integers(1, 10 ** int(rng.integers(1, 6))))
    day, month, year = int(rng.integers(1, 32)), int(rng.integers(1, 13)), int(rng.integers(1940, 2000))
    choices = (
        f"RUN {number}",
        f"{number}",
        f"{number:04d}-{number + 20:04d}",
        f"{day}.{month}.{year}",
        f"{day}/{month}/{year % 100}",
        f"{100 * int(rng.integers(10, 200))}' ASL",
        f"1:{1000 * int(rng.integers(5, 60))}",
        f"Nr {number} {float(rng.uniform(150, 155)):.2f}",
        "WILD 15/4 UAG",
        str(rng.choice(ALIKE)),
        " ".join(rng.choice(ALIKE, 2)),
        str(rng.choice(NAMES)),
        " ".join(rng.choice(NAMES, 2)).title(),
        "".join(rng.choice(list("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-/"), int(rng.integers(1, 14)))),
    )
    return choices[int(rng.integers(len(choices)))]
