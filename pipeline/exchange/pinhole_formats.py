"""Formats of resampled frames, which have OpenCV's distortion: Ames Stereo Pipeline's .tsai file per image, OpenCV's
YAML, and COLMAP's reconstructions with points and their tracks."""

import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.errors import InputError, missing_extra
from pipeline.exchange.block import Block
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.incoming import ForeignPose, ImportOptions, Incoming, foreign_pose, opencv_camera
from pipeline.exchange.pinhole import BROWN, PRISMS, RATIONAL, PinholeFrame, pinhole_frames, pinholes_written
from pipeline.files.camera_file import CameraFile
from pipeline.files.opencv_file import FISHEYE, read_pixel_camera
from pipeline.opencv_check.opencv_calibration import INTERIOR, NAMES
from pipeline.text.files import image_name

ASP = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; R is camera to world",
    "ASP, docs/pinholemodels.rst (the file, its R, TSAI and FISHEYE as OpenCV's); src/asp/Camera/CsmModel.cc, "
    "toCsmPixel: ASP's pixel (0, 0) is CSM's (0.5, 0.5), the centre of the first one",
)


def write_asp(block: Block, options: ExportOptions) -> Written:
    """Write NAME.tsai for each image; c and principal point in mm, with the pitch in mm."""
    frames, left_out = pinhole_frames(block, options, (BROWN,), "asp")
    return pinholes_written(
        {f"{frame.frame.image}.tsai": _tsai(frame) for frame in frames},
        frames,
        left_out,
        "C and R are in the project's object coordinates. ASP's tools expect earth-centred ones: give it cameras "
        "of a project in such coordinates, or transform them (convert_pinhole_model, bundle_adjust with control).",
        lost="the marks",
    )


def _tsai(frame: PinholeFrame) -> str:
    pitch = frame.canvas.pitch_mm
    model, terms = "TSAI", dict(zip(BROWN, frame.lens.named(BROWN).tolist(), strict=True))
    if frame.lens.fisheye:
        model, terms = "FISHEYE", dict(zip(("k1", "k2", "k3", "k4"), frame.lens.fisheye, strict=True))
    interior = zip(("fu", "fv", "cu", "cv"), (frame.interior_px(ASP) * pitch).tolist(), strict=True)
    lines = [
        "VERSION_4",
        "PINHOLE",
        *(f"{name} = {value!r}" for name, value in interior),
        "u_direction = 1 0 0",
        "v_direction = 0 1 0",
        "w_direction = 0 0 1",
        f"C = {' '.join(map(repr, frame.station.tolist()))}",
        f"R = {' '.join(map(repr, frame.rotation.T.ravel().tolist()))}",
        f"pitch = {pitch!r}",
        model,
        *(f"{term} = {value!r}" for term, value in terms.items()),
    ]
    return "\n".join(lines) + "\n"


OPENCV = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "OpenCV, calib3d: projectPoints, and undistort, whose maps count from the first pixel's centre",
)


def write_opencv(block: Block, options: ExportOptions) -> Written:
    """Write NAME.yml for each image, for cv2.FileStorage."""
    frames, left_out = pinhole_frames(block, options, (BROWN, PRISMS, NAMES[4:]), "opencv")
    files = {f"{frame.frame.image}.yml": _yaml(frame, block.lens_reach.get(frame.frame.camera)) for frame in frames}
    return pinholes_written(files, frames, left_out, lost="the marks")


def _yaml(frame: PinholeFrame, lens_reach: str | None) -> str:
    """YAML text of one image. lens_reach: comment on the radius up to which the lens is known."""
    fx, fy, cx, cy = frame.interior_px(OPENCV)
    distortion = frame.lens.named(NAMES[4:])
    used = np.flatnonzero(distortion)
    count = next(size for size in (5, 8, 12, 14) if size > (used.max() if used.size else 0))
    storage = cv2.FileStorage("", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    storage.write("image", frame.picture)
    storage.write("camera", frame.frame.camera)
    storage.write("image_width", frame.canvas.width_px)
    storage.write("image_height", frame.canvas.height_px)
    storage.write("camera_matrix", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    if lens_reach:
        storage.writeComment(lens_reach)
    if frame.lens.fisheye:
        storage.write("distortion_model", FISHEYE)
        storage.write("distortion_coefficients", np.array([frame.lens.fisheye]))
    else:
        storage.write("distortion_coefficients", distortion[:count].reshape(1, -1))
    storage.write("R", frame.rotation)
    storage.write("t", frame.translation.reshape(3, 1))
    return str(storage.releaseAndGetString())


def import_opencv(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Read files of cv2.FileStorage: matrix, distortion and size as camera files; R and t, if given, as
    orientations."""
    found = [_camera_and_pose(path, options) for path in paths]
    poses = tuple(pose for _, pose in found if pose is not None)
    return Incoming(cameras=tuple(camera for camera, _ in found), poses=poses)


def _camera_and_pose(path: Path, options: ImportOptions) -> tuple[CameraFile, ForeignPose | None]:
    found, storage = read_pixel_camera(path)
    name = storage.getNode("camera").string() or path.stem
    picture = image_name(storage.getNode("image").string() or path.stem)
    camera = opencv_camera(
        path, name, found.interior_px, found.distortion, found.size_px, options, OPENCV, found.family
    )
    turn, shift = storage.getNode("R").mat(), storage.getNode("t").mat()
    if turn is None or shift is None:
        return camera, None
    return camera, foreign_pose(picture, np.array(turn, dtype=float), np.ravel(shift).astype(float))


COLMAP = Convention(
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


def write_colmap(block: Block, options: ExportOptions) -> Written:
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
        places = frame.pixels(marks) + COLMAP.first_pixel_px
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
    interior = frame.interior_px(COLMAP)
    rest = frame.lens.named(_FULL)
    model = "FULL_OPENCV" if rest.any() else "OPENCV"
    params = [*interior, *frame.lens.named(_OPENCV[len(INTERIOR) :]), *(rest if model == "FULL_OPENCV" else ())]
    if frame.lens.fisheye:
        model, params = _FISHEYE, [*interior, *frame.lens.fisheye]
    return pycolmap.Camera(
        camera_id=number, model=model, width=frame.canvas.width_px, height=frame.canvas.height_px, params=params
    )


def import_colmap(paths: Sequence[Path], options: ImportOptions) -> Incoming:
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
            cameras.append(opencv_camera(folder, name, interior, lens, size, options, COLMAP, family))
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
