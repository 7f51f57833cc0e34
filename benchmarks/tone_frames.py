"""Frames whose light was stored by a tone curve: every kind of mark under every difficulty, each drawn by chance from a
seed of its own, with its truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.lone_frames import fiducials_of, image_of, lone_frame, painted
from measure.marks.shapes import (
    FiducialLayout,
    LayoutMark,
    MarkShape,
    Part,
    cross,
    dot,
    polygon,
    ring_cross,
    turned_part,
)
from measure.scans.cache import WholePicture
from measure.scans.jpeg import rounding_step_dn
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from synthetic_images.frame import frame_truth
from synthetic_images.scene import (
    Background,
    Film,
    Scanner,
    Scene,
    SceneFiducial,
    Tones,
)
from synthetic_images.tone_curve import coded

Array = NDArray[np.float64]
Picture = NDArray[np.float32]
Generator = np.random.Generator

KINDS = ("wedge", "notch", "wing", "cross", "ring mark", "dot", "disk")
TIPS = ("wedge", "notch", "wing")
CURVES: tuple[float | str, ...] = (1.0, 1.8, 2.2, "srgb", "s-curve")
STORED = ("16 bit", "8 bit", "JPEG")
DIFFICULTIES = ("plain", "uneven focus", "vignetting", "stamp", "missing", "neighbour")
FRAME_MM, MARGIN_MM, PITCH_UM = 24.0, 2.5, 28.0
GIVEN_MM = 0.002
FILM_MM = 0.001
_GAP_MM = 1.0  # between two frames on the film
_FULL = 65535.0


@dataclass(frozen=True, eq=False)
class Case:
    """A frame and its truth. centers_px: (2,) of each mark by id; inward: (2,) of the scan, into the frame, by id;
    hidden: ids of marks that cannot be seen well: missing ones, and those under a stamp."""

    kind: str
    curve: float | str
    stored: str
    difficulty: str
    snr: float
    layout: FiducialLayout
    pose: str
    scan: Scan
    centers_px: dict[str, Array]
    inward: dict[str, Array]
    hidden: frozenset[str]


def draw_case(seed: int, index: int, scans: int = 1, kinds: Sequence[str] = KINDS) -> Case:
    """The index-th frame of the study of that seed: kinds, curves and ways to store take turns. scans: so many frames
    in a row are scans of one camera by one scanner, with the same marks, curve and way to store."""
    rng, group = np.random.default_rng([seed, index]), index // scans
    of_scanner = rng if scans == 1 else np.random.default_rng([seed, scans, group])
    kind = kinds[group % len(kinds)]
    curve = CURVES[group // len(kinds) % len(CURVES)]
    stored, difficulty = str(of_scanner.choice(STORED)), str(rng.choice(DIFFICULTIES))
    snr = float(np.exp(rng.uniform(np.log(8), np.log(100))))
    layout, tones = _layout(of_scanner, kind), _tones(rng, kind)
    scene, missing = _scene(rng, layout, tones, difficulty)
    light: Picture = painted(scene).astype(np.float32) / np.float32(_FULL)
    whole = replace(scene, camera=replace(scene.camera, fiducials=fiducials_of(layout.marks)))
    truth = frame_truth(whole, 0)
    centers = {id: position.center_px for id, position in truth.fiducials.items()}
    hidden = set(missing)
    if difficulty == "stamp":
        covered = str(rng.choice([mark.id for mark in layout.marks]))
        light, hidden = _stamped(rng, light, centers[covered], tones), hidden | {covered}
    if difficulty == "vignetting":
        light = light * _falloff(rng, light.shape)
    light = _blurred(rng, light, difficulty == "uneven focus")
    contrast = abs((tones.mark if _is_light(kind) else tones.dark_mark) - _ground(kind, tones))
    light = light + np.float32(contrast / snr) * _noise(rng, light.shape)
    middle = truth.geometry.pixel_from_camera(np.zeros((1, 2)))[0]
    return Case(
        kind,
        curve,
        stored,
        difficulty,
        snr,
        layout,
        scene.images[0].pose,
        _scan(rng, coded(np.clip(light, 0.0, 1.0), curve), stored, f"{index}"),
        centers,
        {id: (middle - center) / np.hypot(*(middle - center)) for id, center in centers.items()},
        frozenset(hidden),
    )


def _layout(rng: Generator, kind: str) -> FiducialLayout:
    """At the sides, or near the corners too; solid marks on the frame's edge."""
    half = FRAME_MM / 2
    at = {"wedge": half - 0.9, "wing": half - 0.9, "notch": half + 0.7}.get(kind, float(rng.uniform(10.0, 10.8)))
    sides = [(at, 0.0), (0.0, at), (-at, 0.0), (0.0, -at)]
    if kind in TIPS:
        along = float(rng.uniform(5.0, 8.0))
        more = [(at, along), (-along, at), (-at, -along), (along, -at)]
    else:
        more = [(at, at), (-at, at), (-at, -at), (at, -at)]
    places = sides + (more if rng.random() < 0.5 else [])
    polarity: Literal["light", "dark"] = "light" if _is_light(kind) else "dark"
    marks = []
    for number, (x, y) in enumerate(places):
        outward = 90.0 * (number % 4) if kind in TIPS else 0.0
        parts = tuple(turned_part(part, outward) for part in _drawing(kind))
        given = (GIVEN_MM, GIVEN_MM)
        marks.append(LayoutMark(str(number + 1), (x, y), given, MarkShape(parts, polarity=polarity)))
    return FiducialLayout(tuple(marks), (FRAME_MM, FRAME_MM))


def _drawing(kind: str) -> tuple[Part, ...]:
    """Outwards is along x."""
    return {
        "wedge": polygon(((0.0, 0.0), (1.4, 0.7), (1.4, -0.7))),
        "wing": polygon(((0.0, 0.0), (1.4, 0.0), (1.4, -0.9))),
        "notch": polygon(((0.0, 0.0), (-1.4, 0.7), (-1.4, -0.7))),
        "cross": cross(0.5, 0.1),
        "ring mark": ring_cross(0.5, 0.1, 0.8, 0.1),
        "dot": dot(0.15),
        "disk": dot(0.45),
    }[kind]


def _is_light(kind: str) -> bool:
    return kind not in ("wedge", "wing")


def _ground(kind: str, tones: Tones) -> float:
    return tones.border if kind == "notch" else tones.background


def _tones(rng: Generator, kind: str) -> Tones:
    background, border = float(rng.uniform(0.2, 0.6)), float(rng.uniform(0.02, 0.1))
    mark = background if kind == "notch" else float(rng.uniform(background + 0.25, 0.95))
    contrast = float(rng.uniform(0.0, 0.06)) * background
    return Tones(border=border, background=background, contrast=contrast, mark=mark, dark_mark=border)


def _scene(rng: Generator, layout: FiducialLayout, tones: Tones, difficulty: str) -> tuple[Scene, tuple[str, ...]]:
    """And which marks are not painted."""
    missing = (str(rng.choice([mark.id for mark in layout.marks])),) if difficulty == "missing" else ()
    shown = tuple(fiducial for fiducial in fiducials_of(layout.marks) if fiducial.id not in missing)
    if difficulty == "neighbour":
        shift = FRAME_MM + _GAP_MM
        beside = [
            SceneFiducial(f"n{one.id}", (one.xy_mm[0] + shift, one.xy_mm[1]), one.mark)
            for one in shown
            if one.xy_mm[0] < 0 and abs(one.xy_mm[0]) > abs(one.xy_mm[1])
        ]
        shown = (*shown, *beside)
    scale = 1.0 + rng.normal(0.0, 0.0005, 2)
    backgrounds: tuple[Background, ...] = ("wall", "terrain", "plain")
    image = image_of(
        str(rng.choice(("0", "90", "180m"))),
        float(rng.uniform(-3.0, 3.0)),
        offset_mm=(float(rng.normal(0.0, 0.2)), float(rng.normal(0.0, 0.2))),
        scale=scale,
        shear=float(rng.normal(0.0, 2e-4)),
        neighbour="right" if difficulty == "neighbour" else None,
        neighbour_gap_mm=_GAP_MM,
    )
    scene = lone_frame(
        "tone",
        int(rng.integers(2**31)),
        FRAME_MM,
        shown,
        image,
        scanner=Scanner((PITCH_UM, PITCH_UM), margin_mm=MARGIN_MM, blur_px=0.5),
        film=Film(deformation_um=1000 * FILM_MM),
        tones=tones,
        background=backgrounds[rng.integers(3)],
    )
    return scene, missing


def _stamped(rng: Generator, light: Picture, center: Array, tones: Tones) -> Picture:
    """Ink over a mark, anywhere about it."""
    cover = np.zeros(light.shape, np.uint8)
    place = np.rint(center + rng.normal(0.0, 12.0, 2)).astype(int)
    cv2.putText(cover, "N7", (int(place[0]) - 20, int(place[1]) + 10), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 255, 3)
    share = cover / np.float32(255.0)
    return np.asarray(light + share * (np.float32(tones.border) - light), np.float32)


def _falloff(rng: Generator, shape: tuple[int, ...]) -> Picture:
    """To 60 to 85 % in the corners, by the fourth power of a cosine."""
    row, col = np.mgrid[: shape[0], : shape[1]]
    r2 = ((col - shape[1] / 2) ** 2 + (row - shape[0] / 2) ** 2) / (shape[0] ** 2 + shape[1] ** 2) * 4
    corner = rng.uniform(0.6, 0.85)
    return np.asarray(1 / (1 + r2 * (corner**-0.5 - 1)) ** 2, np.float32)


def _blurred(rng: Generator, light: Picture, uneven: bool) -> Picture:
    """A blur of 0.7 to 1.4 px in all; uneven: by up to so much more to one side of the frame."""
    seen = rng.uniform(0.7, 1.4)
    if not uneven:
        return np.asarray(cv2.GaussianBlur(light, (0, 0), np.sqrt(seen**2 - 0.25)), np.float32)
    levels = [cv2.GaussianBlur(light, (0, 0), np.sqrt(seen**2 - 0.25 + more)) for more in np.linspace(0.0, 1.0, 9)]
    turn = rng.uniform(0, 2 * np.pi)
    row, col = np.mgrid[: light.shape[0], : light.shape[1]]
    along = (np.cos(turn) * (col / light.shape[1] - 0.5) + np.sin(turn) * (row / light.shape[0] - 0.5)) / 1.42 + 0.5
    share = np.clip(along, 0.0, 1.0) * (len(levels) - 1)
    return np.asarray(sum(np.clip(1 - abs(share - k), 0, 1) * level for k, level in enumerate(levels)), np.float32)


def _noise(rng: Generator, shape: tuple[int, ...]) -> Picture:
    """Of unit variance: the scanner's, and grain."""
    grain_px = rng.uniform(0.6, 1.0)
    grain = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), grain_px)
    share = rng.uniform(0.0, 0.8)
    white = rng.standard_normal(shape).astype(np.float32)
    return np.asarray(np.sqrt(share) * grain / grain.std() + np.sqrt(1 - share) * white, np.float32)


def _scan(rng: Generator, code: Picture, stored: str, name: str) -> Scan:
    path, step_dn = Path(f"{name}.tif"), 0.0
    if stored == "16 bit":
        return Scan(path, WholePicture(np.rint(code * 65535).astype(np.uint16)[..., None]), NO_TAGS)
    grey = np.rint(code * 255).astype(np.uint8)
    if stored == "JPEG":
        quality = int(rng.integers(60, 96))
        data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        step_dn = rounding_step_dn(data)
        grey = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)
    return Scan(path, WholePicture(grey[..., None], step_dn), NO_TAGS)
