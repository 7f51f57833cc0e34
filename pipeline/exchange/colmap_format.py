"""COLMAP: cameras, poses, points and their tracks as a reconstruction of resampled frames."""

import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import InputError
from pipeline.exchange.block import Block
from pipeline.exchange.convention import Convention, ExportOptions, Written
from pipeline.exchange.pinhole import BROWN, INTERIOR, RATIONAL, PinholeFrame, misfit_note, pinhole_frames

CONVENTION = Convention(
    (0.5, 0.5),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "colmap.github.io/format.html and cameras.html: the upper left corner of the image is (0, 0)",
)
_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_FULL = ("k3", "k4", "k5", "k6")


def write(block: Block, options: ExportOptions) -> Written:
    """sparse/*.bin; a camera an image, for every resampled frame has its own first pixel."""
    pycolmap = imported()
    frames, left_out = pinhole_frames(block, options, (BROWN, RATIONAL), "colmap")
    made = reconstruction(pycolmap, block, frames)
    with tempfile.TemporaryDirectory() as folder:
        made.write_binary(folder)
        files = {f"sparse/{path.name}": path.read_bytes() for path in sorted(Path(folder).iterdir())}
    return Written(
        files,
        ("the film transformation (it is that of the resampled frames)", "all standard deviations", "fiducial marks"),
        (misfit_note(frames),) if frames else (),
        tuple(left_out),
    )


def imported() -> Any:
    """Raises InputError where pycolmap is not installed."""
    try:
        import pycolmap
    except ImportError:
        raise InputError("colmap needs pycolmap. Install it with: pip install reseau[blocks]") from None
    return pycolmap


def reconstruction(pycolmap: Any, block: Block, frames: list[PinholeFrame]) -> Any:
    """The frames with the marks of adjusted points, and these points with their tracks."""
    made, seen = pycolmap.Reconstruction(), defaultdict(list)
    for number, frame in enumerate(frames, 1):
        camera = colmap_camera(pycolmap, frame, number)
        made.add_camera_with_trivial_rig(camera)
        marks = tuple(mark for mark in frame.frame.observed(fiducials=False) if mark.point in block.points)
        places = frame.pixels(marks) + CONVENTION.first_pixel_px
        image = pycolmap.Image(frame.picture, places, number, number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(frame.rotation), frame.translation)
        made.add_image_with_trivial_frame(image, pose)
        for index, mark in enumerate(marks):
            seen[mark.point].append((number, index))
    for point, places_of_it in sorted(seen.items()):
        track = pycolmap.Track()
        for number, index in places_of_it:
            track.add_element(number, index)
        made.add_point3D(block.points[point], track)
    return made


def colmap_camera(pycolmap: Any, frame: PinholeFrame, number: int) -> Any:
    """OPENCV, or FULL_OPENCV where the lens has a third radial term."""
    interior = frame.interior_px + np.array([0.0, 0.0, *CONVENTION.first_pixel_px])
    rest = frame.lens.named(_FULL)
    model = "FULL_OPENCV" if rest.any() else "OPENCV"
    params = [*interior, *frame.lens.named(_OPENCV[len(INTERIOR) :]), *(rest if model == "FULL_OPENCV" else ())]
    return pycolmap.Camera(
        camera_id=number, model=model, width=frame.canvas.width_px, height=frame.canvas.height_px, params=params
    )
