"""Frames scanned in halves: claimed against realised standard deviations, by many adjustments.

Four frames of known points, each in two halves with separate film transformations, with new errors in each run (seeds
from 0). --pictures: errors of measured tie points between the halves of rendered frames, relative to their sigmas.
"""

import json
from collections import Counter
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from networks import Halves, halves
from numpy.typing import NDArray

from adjust import Adjustment, adjust
from benchmarks.harness import Row, rms
from measure.tie_points.joins import measure_joins
from measure.tie_points.tracks import TieFrame
from pipeline.cli import run

Array = NDArray[np.float64]

CASES = (  # number of tie points, overlap in mm of 228, whether the right halves are rotated by 180 degrees
    (6, 40.0, False),
    (12, 40.0, False),
    (40, 40.0, False),
    (40, 40.0, True),
    (12, 15.0, False),
    (40, 15.0, True),
    (40, 5.0, False),
)
CORNERS = np.array([[-110.0, -110.0], [-110.0, 110.0], [110.0, -110.0], [110.0, 110.0]])
ELEMENTS = ("X0", "Y0", "Z0", "omega", "phi", "kappa")


COLUMNS = {"count": "d", "grain": "g", "overlap_mm": ".0f", "turned": "d"}
COLUMNS |= dict.fromkeys(("joins", "films", "orientations", "c", "corner_um", "sigma0"), ".3f")
COLUMNS |= {"measured": "d", "weak": "d", "off_px": ".4f", "of_sigma": ".3f"}


def cells(pictures: bool = False) -> Iterator[Row]:
    if pictures:
        for grain, share, turned in product((0.0, 0.01, 0.03), (0.6, 0.54), (False, True)):
            yield {"grain": grain, "overlap_mm": (2 * share - 1) * 65.0, "turned": turned}
    else:
        yield from ({"count": count, "overlap_mm": overlap, "turned": turned} for count, overlap, turned in CASES)


def case(overlap_mm: float, turned: bool, count: int = 0, grain: float | None = None, runs: int = 200) -> Row:
    """RMS errors over standard deviations of `runs` networks; if a grain is given, of measured tie points."""
    if grain is not None:
        return _pictured(grain, (overlap_mm / 65.0 + 1) / 2, turned)
    found = [_errors(count, overlap_mm, turned, seed) for seed in range(runs)]
    return {name: rms([each[name] for each in found]) for name in found[0]}


def _errors(count: int, overlap_mm: float, turned: bool, seed: int) -> dict[str, Array]:
    simulated = halves(np.random.default_rng(seed), count, overlap_mm, turned=turned)
    adjustment = adjust(simulated.network)
    joins = [
        _error_sigmas(adjustment, f"JOIN.{frame}.{point}.{axis}", true)
        for (frame, point), xy in simulated.joins.items()
        for axis, true in zip("xy", xy, strict=True)
    ]
    films = [
        _error_sigmas(adjustment, f"T.{name}.{parameter}", true)
        for name, film in simulated.films.items()
        for parameter, true in zip(("a1", "a2", "a3", "b1", "b2", "b3"), film, strict=True)
    ]
    orientations = [
        _error_sigmas(adjustment, f"EO.f{i}.{element}", true)
        for i in range(4)
        for element, true in zip(ELEMENTS, [*simulated.truth.stations[i], *simulated.truth.attitudes[i]], strict=True)
    ]
    return {
        "joins": np.array(joins),
        "films": np.array(films),
        "orientations": np.array(orientations),
        "c": np.array([_error_sigmas(adjustment, "IO.K.c", simulated.truth.c)]),
        "corner_um": _corner_errors_um(simulated, adjustment),
        "sigma0": np.array([adjustment.sigma0]),
    }


def _error_sigmas(adjustment: Adjustment, name: str, true: float) -> float:
    return (adjustment.value(name) - true) / adjustment.sigma(name)


def _corner_errors_um(simulated: Halves, adjustment: Adjustment) -> Array:
    """Errors, µm, of the film transformation of each half at the outer corners of the frame."""
    off = []
    for name, true in simulated.films.items():
        found = np.array([adjustment.value(f"T.{name}.{each}") for each in ("a1", "a2", "a3", "b1", "b2", "b3")])
        for corner in CORNERS:
            if (corner[0] > 0.0) == name.endswith("right"):
                place = np.linalg.solve(np.array([true[1:3], true[4:]]), corner - true[[0, 3]])
                off.append(np.array([found[1:3], found[4:]]) @ place + found[[0, 3]] - corner)
    return 1000.0 * np.array(off).ravel()


SCENE = """
name = "halves"
seed = {seed}
[camera]
name = "K"
frame_mm = [55.0, 55.0]
principal_distance_mm = 60.0
[[camera.fiducial]]
id = "1"
xy_mm = [25.0, 25.0]
mark = "m"
[[camera.fiducial]]
id = "2"
xy_mm = [-25.0, -25.0]
mark = "m"
[camera.mark.m]
kind = "ring-cross"
polarity = "light"
ring_mm = 0.5
ring_line_mm = 0.1
arm_mm = 0.36
line_mm = 0.1
[field]
kind = "natural"
unit = "m"
[picture]
background = "terrain"
relief = 20.0
[picture.tones]
contrast = 0.1
[film]
scale_sigma_ppm = 300.0
shear_sigma_urad = 100.0
grain = {grain}
deformation_um = 5.0
dust = 40
[scan]
pitch_um = 20.0
turn_sigma_deg = 0.3
noise = 0.005
"""
IMAGE = """
[[image]]
name = "f{half}"
position = [0.0, 0.0, 1500.0]
angles_deg = [1.0, -1.0, 5.0]
part_of = "f"
part = [{first}, {end}]
pose = "{pose}"
"""


def _pictured(grain: float, share: float, turned: bool) -> Row:
    """Measure tie points between halves of a rendered frame."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        halves_text = IMAGE.format(half="a", first=0.0, end=share, pose="0")
        # A scan rotated by 180 degrees has the other end of the frame on its left.
        first, end = (0.0, share) if turned else (1.0 - share, 1.0)
        halves_text += IMAGE.format(half="b", first=first, end=end, pose="180" if turned else "0")
        scene = folder / "scene.toml"
        scene.write_text(SCENE.format(seed=1 + turned, grain=grain) + halves_text, encoding="utf-8")
        run(["render", str(scene), str(folder)])
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["images"]
        parts = [
            TieFrame(each, folder / "scans" / f"{each}.tif", np.eye(2, 3), None, np.zeros((0, 3))) for each in truth
        ]
        joins = measure_joins(parts)
        first_marks, second_marks = (joins.marks[part.image] for part in parts)
        places, sigmas = [], []
        for image, marks in zip(truth, (first_marks, second_marks), strict=True):
            places.append(_camera_mm(truth[image], np.array([mark.center_px for mark in marks]).reshape(-1, 2)))
            sigmas.append([np.trace(mark.covariance_px2) / 2 for mark in marks if mark.covariance_px2 is not None])
        off = (places[0] - places[1]) / 0.02
        sigma = np.sqrt(np.sum(sigmas, axis=0))[:, None]
        counts = Counter(str(mark.status) for mark in first_marks)
        return {
            "measured": counts["measured"],
            "weak": counts["weak"],
            "off_px": rms(off),
            "of_sigma": rms(off / sigma),
        }


def _camera_mm(image: dict[str, dict[str, dict[str, float]]], pixels: Array) -> Array:
    """Camera coordinates by the affine part of the true transformation; the smooth deformation is common to both
    scans."""
    x, y = (pixels * [0.02, -0.02]).T
    a1, a2, a3, b1, b2, b3 = (image["transformation"][name]["value"] for name in ("a1", "a2", "a3", "b1", "b2", "b3"))
    return np.stack([a1 + a2 * x + a3 * y, b1 + b2 * x + b3 * y], axis=1)
