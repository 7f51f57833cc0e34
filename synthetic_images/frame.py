"""Content of one frame: exposed parts, target field, fiducials and damage, and the true positions of its marks."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area, bounds, centroid, disk, polygon, rounded_rectangle, subdivided
from synthetic_images.damage import damage
from synthetic_images.film import FrameGeometry, frame_geometry, turn
from synthetic_images.paint import AreaPaint, ChipPaint, Paint, chip_paint
from synthetic_images.scene import (
    BoardField,
    ChipMark,
    CrossFigure,
    DiskField,
    DrawnMark,
    Scene,
    SceneFiducial,
    Writing,
)
from synthetic_images.targets import (
    Target,
    board_sheet,
    chessboard_squares,
    disk_outline,
    field_targets,
    figure_outlines,
    figure_reach,
)
from synthetic_images.truth import FrameTruth, Position
from synthetic_images.writing import written_area

Array = NDArray[np.float64]

EDGE_PIECES = 64  # pieces of each frame edge, which the film deformation bends
TAPE_MM = 3.0  # mm, half the side of the tape over a covered fiducial
BOARD_WHITE, BOARD_BLACK = 0.8, 0.1


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """Frame to be painted. exposed: exposed parts of the scan; paints: objects on top of them, in painting order."""

    truth: FrameTruth
    exposed: tuple[AreaPaint, ...]
    paints: tuple[Paint, ...]


def make_frame(scene: Scene, index: int) -> RenderedFrame:
    """Make the content of one frame, ready to be painted."""
    truth = frame_truth(scene, index)
    geometry = truth.geometry
    exposed = tuple(AreaPaint((geometry.pixel_area(area),), 1.0) for area in _exposed_areas(geometry))
    generator = np.random.default_rng([scene.seed, index, 2])
    defects = damage(scene.film, geometry.width_px, geometry.height_px, generator)
    paints = [*_field_paints(geometry, truth.targets), *_fiducial_paints(geometry)]
    paints += [_written(writing, geometry) for writing in geometry.image.writing]
    paints += [AreaPaint((area,), tone) for area, tone in defects]
    return RenderedFrame(truth, exposed, tuple(paints))


def frame_truth(scene: Scene, index: int) -> FrameTruth:
    """True positions of the marks of one frame, and why some of them are not visible."""
    geometry = frame_geometry(scene, index)
    fiducials = {fiducial.id: _fiducial_position(fiducial, geometry) for fiducial in scene.camera.fiducials}
    return FrameTruth(geometry, fiducials, _target_positions(geometry))


def _exposed_areas(geometry: FrameGeometry) -> list[Area]:
    """Exposed areas of this and the neighbouring frame, with the pockets of their fiducials, camera mm."""
    half = np.asarray(geometry.scene.camera.frame_mm) / 2
    outline = subdivided(rounded_rectangle(half, geometry.scene.corner_radius_mm), EDGE_PIECES)
    outlines = [outline]
    if side := geometry.scene.pocket_mm:
        square = rounded_rectangle(np.array([side, side]), 0.0)
        outlines += [square + fiducial.xy_mm for fiducial in geometry.scene.camera.fiducials]
    return [(part + shift,) for shift in _advances(geometry) for part in outlines]


def _advances(geometry: FrameGeometry) -> list[Array]:
    """Offsets of this frame (zero) and its neighbour on the film, mm."""
    image, frame_mm = geometry.image, np.asarray(geometry.scene.camera.frame_mm)
    shifts = [np.zeros(2)]
    if image.neighbour is not None:
        side = {"left": (-1, 0), "right": (1, 0), "bottom": (0, -1), "top": (0, 1)}[image.neighbour]
        shifts.append(np.array(side) * (frame_mm + image.neighbour_gap_mm))
    return shifts


def _fiducial_position(fiducial: SceneFiducial, geometry: FrameGeometry) -> Position:
    center = geometry.pixel_from_camera(np.array([fiducial.xy_mm]))[0]
    hidden = _hidden_by_edge(geometry, _mark_extent(fiducial, geometry))
    if fiducial.id in geometry.image.covered:
        hidden = "covered"
    return Position(center, center, hidden)


def _mark_extent(fiducial: SceneFiducial, geometry: FrameGeometry) -> tuple[int, int, int, int]:
    """Window of the whole mark; of its point alone if it has no drawing."""
    paint = next(_mark_paints(fiducial, np.zeros(2), geometry), None)
    if isinstance(paint, AreaPaint):
        return bounds(paint.areas)
    if isinstance(paint, ChipPaint):
        return paint.col0, paint.row0, paint.cover.shape[1], paint.cover.shape[0]
    return bounds(((geometry.pixel_from_camera(np.array([fiducial.xy_mm])),),))


def _hidden_by_edge(geometry: FrameGeometry, window: tuple[int, int, int, int]) -> str:
    col0, row0, width, height = window
    if col0 >= geometry.width_px or row0 >= geometry.height_px or col0 + width <= 0 or row0 + height <= 0:
        return "off the scan"
    if col0 < 0 or row0 < 0 or col0 + width > geometry.width_px or row0 + height > geometry.height_px:
        return "cut off by the scan's edge"
    return ""


def _target_positions(geometry: FrameGeometry) -> dict[str, Position]:
    """Positions of all targets that are imaged, in the order of the field."""
    field = geometry.scene.field
    surround = max(field.surround, 1.0) if isinstance(field, DiskField) else 1.0
    positions: dict[str, Position] = {}
    centers, reaches = np.empty((0, 2)), np.empty(0)  # of nearer targets, surrounds included
    for target in reversed(_far_to_near(geometry)):
        outline = target.center[None] if target.radius == 0.0 else disk_outline(target, figure_reach(field, target))
        pixels = geometry.pixel_from_object(np.vstack([target.center, outline]))
        if not np.isfinite(pixels).all():
            continue
        center, outline_px = pixels[0], pixels[1:]
        figure = _figure_center(geometry, target, center)
        reach = float(np.linalg.norm(outline_px - center, axis=1).max())
        hidden = _hidden(geometry, target, outline_px)
        if not hidden and (np.linalg.norm(centers - center, axis=1) < reaches + reach).any():
            hidden = "behind another target"
        if isinstance(field, DiskField) and hidden != "faces away":
            centers, reaches = np.vstack([centers, center]), np.append(reaches, reach * surround)
        positions[target.id] = Position(center, figure, hidden)
    return {target.id: positions[target.id] for target in field_targets(field) if target.id in positions}


def _figure_center(geometry: FrameGeometry, target: Target, center: Array) -> Array:
    """(2,) centre of the measured figure: for a disk that of its ellipse, which is not the image of its centre."""
    field = geometry.scene.field
    if target.radius == 0.0 or (isinstance(field, DiskField) and isinstance(field.figure, CrossFigure)):
        return center
    return centroid((geometry.pixel_from_object(disk_outline(target, target.radius)),))


def _hidden(geometry: FrameGeometry, target: Target, outline_px: Array) -> str:
    """Why a target is not wholly visible, other targets aside; "" if it is."""
    if target.normal @ (np.asarray(geometry.image.exterior[:3]) - target.center) <= 0.0:
        return "faces away"
    beyond = _hidden_by_edge(geometry, bounds(((outline_px,),)))
    if beyond:
        return beyond
    if not _inside_frame(geometry, outline_px):
        return "not wholly inside of the exposed frame"
    return "behind a fiducial" if _behind_a_fiducial(geometry, outline_px) else ""


def _inside_frame(geometry: FrameGeometry, pixels: Array) -> bool:
    camera = geometry.straight_camera_from_scan(pixels)
    return bool((np.abs(camera) < np.asarray(geometry.scene.camera.frame_mm) / 2).all())


def _behind_a_fiducial(geometry: FrameGeometry, pixels: Array) -> bool:
    camera = geometry.straight_camera_from_scan(pixels)
    return any(
        bool((np.linalg.norm(camera - fiducial.xy_mm, axis=1) < _reach_mm(fiducial, geometry)).any())
        for fiducial in geometry.scene.camera.fiducials
    )


def _reach_mm(fiducial: SceneFiducial, geometry: FrameGeometry) -> float:
    """Radius around a fiducial within which it, its pad or its tape hides the image."""
    reach = geometry.scene.pad_mm
    if fiducial.id in geometry.image.covered:
        reach = max(reach, TAPE_MM * np.sqrt(2))
    if isinstance(fiducial.mark, ChipMark):
        return max(reach, float(np.hypot(*fiducial.mark.image.shape)) * fiducial.mark.pitch_um / 1000)
    if isinstance(fiducial.mark, DrawnMark):
        outlines = [outline for area in fiducial.mark.areas for outline in area]
        return max(reach, max(float(np.hypot(*outline.T).max()) for outline in outlines))
    return reach


def _field_paints(geometry: FrameGeometry, positions: Mapping[str, Position]) -> Iterator[Paint]:
    """Yield the paints of the target field, from far to near."""
    field, tones = geometry.scene.field, geometry.scene.tones
    if isinstance(field, BoardField):
        yield from _board_paints(geometry, field)
        return
    for target in _far_to_near(geometry):
        # Targets hidden in part by the frame's edge, a pad or a nearer target are painted too.
        if target.id not in positions or positions[target.id].hidden in ("faces away", "off the scan"):
            continue
        if field.surround:
            around = disk_outline(target, figure_reach(field, target) * field.surround)
            yield from _object_paint(geometry, ((around,),), tones.surround)
        yield from _object_paint(geometry, figure_outlines(field, target), tones.target)


def _far_to_near(geometry: FrameGeometry) -> list[Target]:
    station = np.asarray(geometry.image.exterior[:3])
    return sorted(field_targets(geometry.scene.field), key=lambda t: (-float(np.linalg.norm(t.center - station)), t.id))


def _board_paints(geometry: FrameGeometry, field: BoardField) -> Iterator[Paint]:
    yield from _object_paint(geometry, ((board_sheet(field),),), BOARD_WHITE)
    if field.kind == "chessboard":
        yield from _object_paint(geometry, (chessboard_squares(field),), BOARD_BLACK)
        return
    for target in field_targets(field):
        yield from _object_paint(geometry, ((disk_outline(target, target.radius),),), BOARD_BLACK)


def _object_paint(geometry: FrameGeometry, areas: tuple[tuple[Array, ...], ...], tone: float) -> Iterator[Paint]:
    """Yield one paint for areas of outlines (n, 3) in object space; outlines that reach behind the camera are
    dropped."""
    pixels = [[geometry.pixel_from_object(outline) for outline in area] for area in areas]
    shown = [tuple(outline for outline in area if np.isfinite(outline).all()) for area in pixels]
    if any(shown):
        yield AreaPaint(tuple(area for area in shown if area), tone, inside_frame=True)


def _fiducial_paints(geometry: FrameGeometry) -> Iterator[Paint]:
    """Yield the paints of pads and marks, also of the neighbouring frame, and of tape."""
    scene = geometry.scene
    for advance in _advances(geometry):
        for fiducial in scene.camera.fiducials:
            if scene.pad_mm:
                x, y = np.asarray(fiducial.xy_mm) + advance
                pad = geometry.pixel_area(disk((x, y), scene.pad_mm))
                yield AreaPaint((pad,), scene.tones.border)
            yield from _mark_paints(fiducial, advance, geometry)
    square = polygon(((-TAPE_MM, -TAPE_MM), (TAPE_MM, -TAPE_MM), (TAPE_MM, TAPE_MM), (-TAPE_MM, TAPE_MM)))
    for fiducial in scene.camera.fiducials:
        if fiducial.id in geometry.image.covered:
            tape = geometry.pixel_area(tuple(outline + fiducial.xy_mm for outline in square))
            yield AreaPaint((tape,), scene.tones.surround)


def _written(writing: Writing, geometry: FrameGeometry) -> AreaPaint:
    linear = writing.height_mm * turn(np.deg2rad(writing.turn_deg)) @ np.diag([-1.0 if writing.mirrored else 1.0, 1.0])
    letters = written_area(writing.text, writing.font)
    area = geometry.pixel_area(tuple(outline @ linear.T + writing.xy_mm for outline in letters))
    return AreaPaint((area,), geometry.scene.tones.mark)


def _mark_paints(fiducial: SceneFiducial, advance: Array, geometry: FrameGeometry) -> Iterator[Paint]:
    mark, place = fiducial.mark, np.asarray(fiducial.xy_mm) + advance
    if mark is None:
        return
    tone = geometry.scene.tones.mark if mark.light else geometry.scene.tones.dark_mark
    if isinstance(mark, ChipMark):
        yield chip_paint(mark, place, geometry, tone)
    else:
        shifted = tuple(tuple(outline + place for outline in area) for area in mark.areas)
        yield AreaPaint(tuple(geometry.pixel_area(area) for area in shifted), tone)
