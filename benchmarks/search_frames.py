"""Random small frames for the study of search and pose: all kinds of marks, in all poses, among clutter similar to
marks. Each frame has its own seed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.lone_frames import lone_frame, make_image, painted
from measure.marks.shapes import (
    Disk,
    FiducialLayout,
    LayoutMark,
    MarkShape,
    Part,
    cross,
    dot,
    polygon,
    ring_cross,
    rotate_mark,
    rotate_part,
)
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from pipeline.rendered.scene_file import scene_mark
from synthetic_images.film import FrameGeometry
from synthetic_images.frame import frame_truth
from synthetic_images.paint import AreaPaint, ChipPaint, Paint
from synthetic_images.scene import (
    POSES,
    Background,
    DrawnMark,
    Scene,
    SceneFiducial,
    SceneFilm,
    SceneScanner,
    Side,
    Tones,
)

Array = NDArray[np.float64]
Sheet = NDArray[np.uint8]
Generator = np.random.Generator

KINDS = ("cross", "ring-cross", "dot", "wing")
SYMMETRIES = ("alike", "uneven", "numbered", "unlike")
FRAME_MM = 24.0
PITCH_UM = 28.0
MARGIN_MM = 4.0
GIVEN_SIGMA_MM = 0.005
FILM_UM = 3.0
APART_MM = 2.0  # mm, distance of clutter from the marks; damaged marks are another study
SIDES: tuple[Side, ...] = ("left", "right", "top", "bottom")


@dataclass(frozen=True, eq=False)
class SearchCase:
    """Frame with its true values.

    Attributes
    ----------
    picture : kind of exposure, in words.
    pitch_um : given pixel pitch, None if it is not given.
    centers_px : (2,) true centre of each mark by id.
    hidden : ids of the marks that are not visible.
    without_marks : paints the same image (rows, columns) without its marks.
    """

    kind: str
    symmetry: str
    picture: str
    layout: FiducialLayout
    pose: str
    pitch_um: float | None
    scan: Scan
    centers_px: dict[str, Array]
    hidden: frozenset[str]
    without_marks: Callable[[], Array]


def draw_case(seed: int, index: int, pitch_um: float = PITCH_UM) -> SearchCase:
    """Frame number index of the study with that seed."""
    rng = np.random.default_rng([seed, index])
    kind, symmetry = str(rng.choice(KINDS)), str(rng.choice(SYMMETRIES))
    return make_case(rng, kind, symmetry, draw_layout(rng, kind, symmetry), f"{index}.tif", pitch_um=pitch_um)


def make_case(
    rng: Generator,
    kind: str,
    symmetry: str,
    layout: FiducialLayout,
    name: str,
    tones: Tones | None = None,
    gamma: float | str = 1.0,
    pitch_um: float = PITCH_UM,
) -> SearchCase:
    """Make a frame with the marks of the layout, everything else random. tones: of marks that are connected to the
    frame's border, without pads behind them; None: random. gamma: tone curve of the scanner."""
    of_border, (tones, picture) = tones is not None, (tones, "solid marks") if tones else _tones(rng)
    scene = _scene(rng, layout, tones)
    scene = replace(scene, scanner=replace(scene.scanner, tone=gamma, pitch_um=(pitch_um, pitch_um)))
    scene = replace(scene, pad_mm=0.0) if of_border else scene
    truth = frame_truth(scene, 0)
    clutter = _clutter(rng, layout, truth.geometry, tones)
    uncovered = tuple(replace(image, covered=()) for image in scene.images)
    bare = replace(scene, camera=replace(scene.camera, fiducials=()), images=uncovered)
    grey, positions = painted(scene, *clutter), truth.fiducials
    return SearchCase(
        kind=kind,
        symmetry=symmetry,
        picture=picture + (", negative" if scene.scanner.negative else ""),
        layout=layout,
        pose=scene.images[0].pose,
        pitch_um=pitch_um * float(rng.uniform(0.99, 1.01)) if rng.random() < 0.9 else None,
        scan=Scan(Path(name), WholePicture(grey[..., None]), NO_TAGS),
        centers_px={id: position.center_px for id, position in positions.items()},
        hidden=frozenset(id for id, position in positions.items() if position.hidden),
        without_marks=lambda: painted(bare, *clutter).astype(float),
    )


def draw_layout(rng: Generator, kind: str, symmetry: str) -> FiducialLayout:
    """Random layout of marks in the corners, or corners and sides; alike, or different by a few µm, by dots next to the
    marks, or by kind."""
    at = float(rng.uniform(10.0, 11.2))
    places = [(at, -at), (-at, -at), (-at, at), (at, at)]
    if rng.random() < 0.6:
        places += [(0.0, -at), (-at, 0.0), (0.0, at), (at, 0.0)]
    drawings = [_drawing(kind)] * len(places)
    if symmetry == "numbered":
        drawings = [(*parts, *_dots(number)) for number, parts in enumerate(drawings)]
    if symmetry == "unlike":
        odd = _drawing(KINDS[(KINDS.index(kind) + 1) % len(KINDS)])
        drawings[0] = odd
        drawings[1] = odd if rng.random() < 0.3 else drawings[1]
    offsets = np.zeros((len(places), 2))
    if symmetry == "uneven":
        offsets = rng.normal(0.0, rng.choice([0.005, 0.02, 0.1]), offsets.shape)
    marks = []
    for number, ((x, y), (dx, dy), parts) in enumerate(zip(places, offsets.tolist(), drawings, strict=True)):
        shape = MarkShape(parts)
        if kind == "wing":
            shape = MarkShape(tuple(rotate_part(part, float(np.degrees(np.arctan2(y, x)))) for part in parts))
        marks.append(LayoutMark(str(number + 1), (x + dx, y + dy), (GIVEN_SIGMA_MM, GIVEN_SIGMA_MM), shape))
    return FiducialLayout(tuple(marks), (FRAME_MM, FRAME_MM))


def _drawing(kind: str) -> tuple[Part, ...]:
    if kind == "cross":
        return cross(0.5, 0.1)
    if kind == "ring-cross":
        return ring_cross(0.5, 0.1, 0.8, 0.1)
    if kind == "dot":
        return dot(0.15)
    return polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35)))


def _dots(number: int) -> tuple[Part, ...]:
    return tuple(Disk((1.05, 0.35 * k - 0.35), 0.1) for k in range(number % 4))


def _tones(rng: Generator) -> tuple[Tones, str]:
    choice = rng.random()
    if choice < 0.1:
        return Tones(background=0.88, contrast=0.05, mark=0.97, dark_mark=0.6), "overexposed"
    if choice < 0.2:
        return Tones(border=0.02, background=0.06, contrast=0.02, mark=0.3, dark_mark=0.0), "dark"
    return Tones(background=float(rng.uniform(0.25, 0.5)), contrast=float(rng.uniform(0.04, 0.12))), "normal"


def _scene(rng: Generator, layout: FiducialLayout, tones: Tones) -> Scene:
    fiducials = tuple(SceneFiducial(mark.id, _draw_place(rng, mark), scene_mark(mark.mark)) for mark in layout.marks)
    ids = [mark.id for mark in layout.marks]
    covered = rng.choice(ids, int(rng.integers(1, len(ids) // 2)), replace=False) if rng.random() < 0.2 else ()
    scale = 1.0 + rng.normal(0.0, 0.001, 2)
    image = make_image(
        str(rng.choice(POSES)),
        float(rng.normal(0.0, 1.0)),
        offset_mm=(float(rng.normal(0.0, 0.4)), float(rng.normal(0.0, 0.4))),
        scale=scale,
        shear=float(rng.normal(0.0, 3e-4)),
        covered=tuple(str(id) for id in covered),
        neighbour=SIDES[rng.integers(4)] if rng.random() < 0.5 else None,
        neighbour_gap_mm=float(rng.uniform(0.8, 2.5)),
    )
    backgrounds: tuple[Background, ...] = ("wall", "wall", "terrain", "plain")
    return lone_frame(
        "search",
        int(rng.integers(2**31)),
        FRAME_MM,
        fiducials,
        image,
        scanner=SceneScanner(
            (PITCH_UM, PITCH_UM),
            margin_mm=MARGIN_MM,
            blur_px=float(rng.uniform(0.6, 1.4)),
            noise=0.01,
            negative=bool(rng.random() < 0.3),
        ),
        film=SceneFilm(
            deformation_um=FILM_UM, grain=float(rng.uniform(0.0, 0.02)), grain_px=1.0, dust=30, scratches=3, hairs=3
        ),
        tones=tones,
        background=backgrounds[rng.integers(4)],
        pad_mm=float(rng.choice([0.0, 1.4])),
    )


def _draw_place(rng: Generator, mark: LayoutMark) -> tuple[float, float]:
    """True place of a mark: normally distributed around the given one."""
    x, y = rng.normal(mark.xy_mm, mark.sigma_mm)
    return float(x), float(y)


def _clutter(rng: Generator, layout: FiducialLayout, geometry: FrameGeometry, tones: Tones) -> list[Paint]:
    """Random writing, stamps, and figures like the camera's own and other marks, anywhere on the film except on the
    marks."""
    if rng.random() < 0.15:
        return []
    draw: Sequence[Callable[[], Paint]] = (
        lambda: _writing(rng, layout, geometry, tones),
        lambda: _stamp(rng, layout, geometry, tones),
        lambda: _figure(rng, layout, geometry, tones),
        lambda: _figure(rng, layout, geometry, tones),
    )
    return [draw[int(rng.integers(len(draw)))]() for _ in range(rng.integers(2, 12))]


def _free_place(rng: Generator, layout: FiducialLayout) -> Array:
    """(2,) random place in camera mm, within the frame or its margin, away from the marks."""
    marks = np.array([mark.xy_mm for mark in layout.marks])
    while True:
        place = rng.uniform(-1.0, 1.0, 2) * (FRAME_MM / 2 + MARGIN_MM - 1.0)
        if np.hypot(*(marks - place).T).min() > APART_MM:
            return np.asarray(place)


def _figure(rng: Generator, layout: FiducialLayout, geometry: FrameGeometry, tones: Tones) -> Paint:
    kind = str(rng.choice(KINDS))
    drawn = layout.marks[0].mark if rng.random() < 0.4 else MarkShape(_drawing(kind))
    assert isinstance(drawn, MarkShape)
    shown = rotate_mark(drawn, float(rng.uniform(0.0, 360.0)) if rng.random() < 0.3 else 0.0)
    place, size = _free_place(rng, layout), 1.0 if rng.random() < 0.5 else float(rng.uniform(0.5, 2.0))
    mark = scene_mark(shown)
    assert isinstance(mark, DrawnMark)
    areas = tuple(tuple(size * outline + place for outline in area) for area in mark.areas)
    tone = tones.mark if rng.random() < 0.7 else tones.dark_mark
    return AreaPaint(tuple(geometry.pixel_area(area) for area in areas), tone)


def _writing(rng: Generator, layout: FiducialLayout, geometry: FrameGeometry, tones: Tones) -> Paint:
    letters = "".join(rng.choice(list("ABCEFHKLMNTXYZ0123456789+xo.-"), int(rng.integers(2, 9))))
    return _chip(rng, layout, geometry, tones, lambda cover: _write(cover, letters, float(rng.uniform(0.5, 1.2))))


def _stamp(rng: Generator, layout: FiducialLayout, geometry: FrameGeometry, tones: Tones) -> Paint:
    def draw(cover: Sheet) -> None:
        cv2.circle(cover, (cover.shape[1] // 2, cover.shape[0] // 2), cover.shape[0] // 2 - 3, 255, 3, cv2.LINE_AA)
        _write(cover, "No 7", 0.5)

    return _chip(rng, layout, geometry, tones, draw)


def _write(cover: Sheet, letters: str, size: float) -> None:
    cv2.putText(cover, letters, (6, cover.shape[0] * 2 // 3), cv2.FONT_HERSHEY_SIMPLEX, size, 255, 2, cv2.LINE_AA)


def _chip(
    rng: Generator, layout: FiducialLayout, geometry: FrameGeometry, tones: Tones, draw: Callable[[Sheet], None]
) -> ChipPaint:
    """Paint of a small drawing, in a random quarter turn, that covers no mark."""
    sheet = np.zeros((44, 120), np.uint8)
    draw(sheet)
    cover = np.asarray(np.rot90(sheet / 255.0, int(rng.integers(4))), np.float32)
    reach_mm = float(np.hypot(*cover.shape)) / 2 * PITCH_UM / 1000
    marks = np.array([mark.xy_mm for mark in layout.marks])
    place = _free_place(rng, layout)
    while np.hypot(*(marks - place).T).min() < reach_mm + 1.0:
        place = _free_place(rng, layout)
    center = geometry.pixel_from_camera(place[None])[0]
    col0, row0 = (round(c - n / 2) for c, n in zip(center, cover.shape[::-1], strict=True))
    return ChipPaint(cover, col0, row0, tones.mark if rng.random() < 0.6 else tones.dark_mark)
