"""Scenes of a single frame, for the studies of search, tones, writing and unequal pixels."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measure.marks.shapes import LayoutMark
from pipeline.rendered.scene_file import scene_mark
from synthetic_images.background import scene_background
from synthetic_images.frame import make_frame
from synthetic_images.paint import Paint
from synthetic_images.render import grey_strips
from synthetic_images.scene import DiskField, FilmTransformation, Scene, SceneCamera, SceneFiducial, SceneImage


def lone_frame(
    name: str,
    seed: int,
    frame_mm: float,
    fiducials: tuple[SceneFiducial, ...],
    image: SceneImage,
    principal_distance_mm: float = 25.0,
    **parts: Any,
) -> Scene:
    """Scene of a square frame without targets. parts: scanner, film, tones and background."""
    camera = SceneCamera(name, (frame_mm, frame_mm), principal_distance_mm, fiducials=fiducials)
    return Scene(name=name, seed=seed, camera=camera, field=DiskField((), 1.0), images=(image,), **parts)


def make_image(
    pose: str, turn_deg: float, scale: Iterable[float], shear: float, height_mm: float = 100.0, **parts: Any
) -> SceneImage:
    """Vertical image of the frame. scale: of the film along both axes; parts: further fields of `SceneImage`."""
    x, y = scale
    return SceneImage(
        name="frame",
        exterior=(0.0, 0.0, height_mm, 0.0, 0.0, 0.0),
        pose=pose,
        turn_rad=float(np.radians(turn_deg)),
        film=FilmTransformation((float(x), float(y)), shear),
        **parts,
    )


def painted(scene: Scene, *more: Paint) -> NDArray[np.uint16]:
    """(height, width) grey values of the scan. more: further paints on top."""
    frame = make_frame(scene, 0)
    frame = replace(frame, paints=(*frame.paints, *more))
    return np.concatenate(list(grey_strips(frame, 0, scene_background(scene))))


def make_fiducials(marks: Iterable[LayoutMark]) -> tuple[SceneFiducial, ...]:
    """Marks of a layout as scene fiducials at their given places."""
    return tuple(SceneFiducial(mark.id, mark.xy_mm, scene_mark(mark.mark)) for mark in marks)
