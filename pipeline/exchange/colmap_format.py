"""COLMAP: cameras, orientations, points and their tracks as a reconstruction of resampled frames."""

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import InputError, missing_extra
from pipeline.exchange.block import Block
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.incoming import ImportOptions, Incoming, foreign_pose, opencv_camera
from pipeline.exchange.pinhole import BROWN, RATIONAL, PinholeFrame, pinhole_frames, pinholes_written
from pipeline.opencv_check.opencv_calibration import INTERIOR
from pipeline.text.files import image_name

CONVENTION = Convention(
    (0.5, 0.5),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "colmap.github.io/format.html and cameras.html: the upper left corner of the image is (0, 0)",
)
_OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_FULL = ("k3", "k4", "k5", "k6")
_FISHEYE = "OPENCV_FISHEYE"
_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {  # focal lengths, and the distortion's parameters
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, ("k1",)),
    "RADIAL": (1, ("k1", "k2")),
    "OPENCV": (2, _OPENCV[4:]),
    "FULL_OPENCV": (2, (*_OPENCV[4:], *_FULL)),
    _FISHEYE: (2, ("k1", "k2", "k3", "k4")),
}


def write(block: Block, options: ExportOptions) -> Written:
    """Write sparse/*.bin with one camera per image, since every resampled frame has its own origin."""
    pycolmap = import_pycolmap("the format colmap")
    frames, left_out = pinhole_frames(block, options, (BROWN, RATIONAL), "colmap")
    with tempfile.TemporaryDirectory() as folder:
        _reconstruction(pycolmap, block, frames).write_binary(folder)
        files = {f"sparse/{path.name}": path.read_bytes() for path in sorted(Path(folder).iterdir())}
    return pinholes_written(files, frames, left_out, lost="fiducial marks")


def import_pycolmap(user: str) -> Any:
    """Import pycolmap. Raises InputError, with the name of its user, where it is not installed."""
    try:
        import pycolmap
    except ImportError:
        raise missing_extra(user, "pycolmap", "blocks") from None
    return pycolmap


def _reconstruction(pycolmap: Any, block: Block, frames: list[PinholeFrame]) -> Any:
    """Reconstruction of the frames with the marks of adjusted points, and of these points with their tracks."""
    made, tracks = pycolmap.Reconstruction(), defaultdict(list)
    for number, frame in enumerate(frames, 1):
        camera = _colmap_camera(pycolmap, frame, number)
        made.add_camera_with_trivial_rig(camera)
        marks = tuple(mark for mark in frame.frame.observed(fiducials=False) if mark.point in block.points)
        places = frame.pixels(marks) + CONVENTION.first_pixel_px
        image = pycolmap.Image(frame.picture, places, number, number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(frame.rotation), frame.translation)
        made.add_image_with_trivial_frame(image, pose)
        for index, mark in enumerate(marks):
            tracks[mark.point].append((number, index))
    for point, places_of_it in sorted(tracks.items()):
        track = pycolmap.Track()
        for number, index in places_of_it:
            track.add_element(number, index)
        made.add_point3D(block.points[point], track)
    return made


def _colmap_camera(pycolmap: Any, frame: PinholeFrame, number: int) -> Any:
    """Camera of the model OPENCV, FULL_OPENCV if the lens has a third radial term, or OPENCV_FISHEYE."""
    interior = frame.interior_px(CONVENTION)
    rest = frame.lens.named(_FULL)
    model = "FULL_OPENCV" if rest.any() else "OPENCV"
    params = [*interior, *frame.lens.named(_OPENCV[len(INTERIOR) :]), *(rest if model == "FULL_OPENCV" else ())]
    if frame.lens.fisheye:
        model, params = _FISHEYE, [*interior, *frame.lens.fisheye]
    return pycolmap.Camera(
        camera_id=number, model=model, width=frame.canvas.width_px, height=frame.canvas.height_px, params=params
    )


def read(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Read folders of reconstructions (.bin or .txt): orientations as approximations, and cameras of the models that
    OpenCV has."""
    pycolmap = import_pycolmap("the format colmap")
    cameras, poses, notes = [], [], []
    for path in paths:
        folder = path if path.is_dir() else path.parent
        try:
            made = pycolmap.Reconstruction(str(folder))
        except Exception as error:  # pycolmap raises various types for a broken or missing file
            message = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
            raise InputError(
                f"{folder}: is no reconstruction of COLMAP ({message}). Name its folder, as sparse/0."
            ) from None
        for number, camera in sorted(made.cameras.items()):
            known = _parameters(camera)
            if known is None:
                notes.append(f"Camera {number} is of the model {camera.model_name}, which is not read.")
                continue
            interior, lens = known
            size = (camera.width, camera.height)
            family = "opencv_fisheye" if camera.model_name == _FISHEYE else "opencv"
            name = f"camera{number}"
            cameras.append(opencv_camera(folder, name, interior, lens, size, options, CONVENTION, family))
        for image in made.images.values():
            if image.has_pose:
                pose = image.cam_from_world()
                poses.append(foreign_pose(image_name(image.name), pose.rotation.matrix(), pose.translation))
    poses.sort(key=lambda pose: pose.image)
    notes.append("The poses are approximations, in the coordinates of that reconstruction.")
    return Incoming(cameras=tuple(cameras), poses=tuple(poses), notes=tuple(notes))


def _parameters(camera: Any) -> tuple[list[float], dict[str, float]] | None:
    """fx, fy, cx, cy in px and the distortion by OpenCV's names; None for other camera models."""
    values = [float(value) for value in camera.params]
    if camera.model_name not in _MODELS:
        return None
    focals, lens = _MODELS[camera.model_name]
    fx, fy = values[0], values[focals - 1]
    return [fx, fy, *values[focals : focals + 2]], dict(zip(lens, values[focals + 2 :], strict=True))
