"""Resampled frames as images of cameras without film: a pinhole with OpenCV's distortion, which is the camera's own or
fitted to it over the frame, and an exterior orientation.

Written as Ames Stereo Pipeline's .tsai file per image, OpenCV's YAML, and COLMAP's reconstructions with points and
their tracks.
"""

import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.lens_conversion import convert_lens, frame_grid_mm
from adjust.functional_model.projection import STRAIGHT
from measure.errors import MeasurementError
from pipeline.errors import InputError, missing_extra
from pipeline.exchange import incoming
from pipeline.exchange.block import ImageBlock, OutFrame, WholeFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.files.camera_file import CameraFile
from pipeline.files.opencv_file import FISHEYE_MODEL, read_matrix, read_pixel_camera, yaml_text
from pipeline.opencv_check.opencv_calibration import (
    FISHEYE,
    INTERIOR,
    NAMES,
    fixed_distortion,
    model_names,
    opencv_values,
)
from pipeline.resampling.canvas import Canvas, outline_canvas
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.text.files import image_name
from pipeline.text.wording import listed
from pipeline.types import Array

ASP = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; R is camera to world",
    "ASP, docs/pinholemodels.rst (the file, its R, TSAI and FISHEYE as OpenCV's); src/asp/Camera/CsmModel.cc, "
    "toCsmPixel: ASP's pixel (0, 0) is CSM's (0.5, 0.5), the centre of the first one",
)
BROWN = ("k1", "k2", "p1", "p2", "k3")
RATIONAL = (*BROWN, "k4", "k5", "k6")
PRISMS = (*BROWN, "s1", "s2", "s3", "s4")
_AFFINE = ("b1", "b2")
_ONE_SCALE = ("none", "torlegard")  # families without affinity and shear

OPENCV = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "OpenCV, calib3d: projectPoints, and undistort, whose maps count from the first pixel's centre",
)

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


@dataclass(frozen=True)
class FittedLens:
    """A lens of the family of one of OpenCV's models. largest_mm: largest error of a point in the frame."""

    lens: Lens
    largest_mm: float

    def coefficients(self, names: Sequence[str]) -> Array:
        """OpenCV's parameters by their names, in mm with y up; 0 for those of the other model."""
        known = dict(zip(model_names(self.lens.distortion.family), opencv_values(self.lens)[0], strict=True))
        return np.array([known.get(name, 0.0) for name in names])

    @property
    def fisheye(self) -> list[float]:
        """k1 to k4 of OpenCV's fisheye; empty for its other model."""
        return self.lens.parameters[:4].tolist() if self.lens.distortion.family == FISHEYE else []

    @property
    def shear(self) -> float:
        """b2 of the family, for programs that have it."""
        return float(self.lens.parameters[-1])


def nearest_lens(
    block: ImageBlock, frame: OutFrame, models: Sequence[Sequence[str]], options: ExportOptions
) -> FittedLens:
    """Fit the lens of an image's camera in one of several models, each given by names of OpenCV's parameters.

    The first model that is identical is taken; else the first that is close enough; else the closest. If the lens
    distortion is removed from the frames, the result is a lens without distortion. OpenCV's fisheye stays as it is; its
    shear, which programs leave out, becomes the misfit.
    """
    lens = frame.lens
    if options.with_lens or lens.distortion.family == "none":
        return FittedLens(_remove_distortion(lens), 0.0)
    if lens.distortion.family == FISHEYE:
        farthest_mm = float(np.abs(frame_corners_mm(block, frame)[:, 1] - lens.interior[2]).max())
        return FittedLens(lens, abs(float(lens.parameters[-1])) * farthest_mm)
    for names in models:
        if _has_only(lens, (*names, "b1")):
            return FittedLens(lens, 0.0)
    own = (each.known_pitch_um for each in (*block.frames, frame) if each.camera == frame.camera and each.pitch_um)
    pitch_um = options.pitch_um or min(float(np.sqrt(np.prod(pitch))) for pitch in own)  # the finest of its pictures
    fits, limit_mm = list[FittedLens](), options.largest_misfit_px * pitch_um / 1000.0
    for names in models:
        fits.append(_fit_opencv(block, frame, names))
        if fits[-1].largest_mm <= limit_mm:
            return fits[-1]
    return min(fits, key=lambda each: each.largest_mm)


def sheared_lens(block: ImageBlock, frame: OutFrame, at_ideal: bool) -> FittedLens:
    """The lens of an image's camera with k1, k2, k3, p1, p2, affinity and shear.

    Parameters
    ----------
    at_ideal : affinity and shear apply to the ideal point, as in MicMac, and not to the distorted one, as in Metashape.
    """
    lens = frame.lens
    family = lens.distortion.family
    if family == "none":
        return FittedLens(_remove_distortion(lens), 0.0)
    if _has_only(lens, BROWN if at_ideal else (*BROWN, *_AFFINE)):
        return FittedLens(lens, 0.0)
    if family in _ONE_SCALE or not at_ideal:
        return _fit_opencv(block, frame, (*BROWN, *_AFFINE))
    grid_mm = frame_grid_mm(frame_corners_mm(block, frame))
    rays, found = lens.ray_from_observed(grid_mm)
    rays, observed_mm = rays[found], grid_mm[found]
    fitted = _sheared_fit(rays, observed_mm)
    # Affinity and shear of the ideal point: OpenCV's model without them, and then their terms in the ray.
    parameters, (b1, b2) = fitted.parameters.copy(), fitted.parameters[-2:]
    parameters[-2:] = 0.0
    bent, _ = replace(fitted, interior=np.array([1.0, 0.0, 0.0]), parameters=parameters).camera_from_ray(rays)
    bent[:, 0] += b1 * rays[:, 0] - b2 * rays[:, 1]
    left_mm = fitted.interior[0] * bent + fitted.interior[1:] - observed_mm
    return FittedLens(fitted, float(np.linalg.norm(left_mm, axis=1).max()))


def frame_corners_mm(block: ImageBlock, frame: OutFrame) -> Array:
    """(2, 2) opposite corners of the exposed frame or the picture, camera mm: from the camera file, or the extent of
    the observations."""
    camera = block.camera_file(frame.camera)
    if camera.frame_mm is not None:
        size = np.array(camera.frame_mm)
        if camera.fiducials:
            return np.array([-size, size]) / 2.0
        left, top = np.array(frame.known_pitch_um) / 2000.0 * (-1.0, 1.0)  # the edge of the first pixel
        return np.array([[left, top - size[1]], [left + size[0], top]])
    places = [
        each.camera_mm(each.marks)
        for each in block.frames
        if each.camera == frame.camera and each.model is not None and each.marks
    ]
    observed = np.concatenate(places)
    return np.array([observed.min(axis=0), observed.max(axis=0)])


def _remove_distortion(lens: Lens) -> Lens:
    return Lens(Distortion("opencv"), lens.interior, np.zeros(len(parameter_names("opencv"))))


def _has_only(lens: Lens, names: Sequence[str]) -> bool:
    """Whether a lens is of OpenCV's family and has no other parameters than these."""
    family = lens.distortion.family
    known = zip(parameter_names(family), lens.parameters, strict=True)
    return family == "opencv" and not any(value for name, value in known if name not in names)


def _fit_opencv(block: ImageBlock, frame: OutFrame, names: Sequence[str]) -> FittedLens:
    """Fit parameters of these names in OpenCV's model."""
    lens = frame.lens
    family = lens.distortion.family
    estimated = [name for name in names if name not in _AFFINE] if family in _ONE_SCALE else [*names, "b1"]
    own = zip(parameter_names(family), lens.parameters.tolist(), strict=True)
    into = fixed_distortion({name: value for name, value in own if name in estimated} if family == "opencv" else {})
    corners_mm = frame_corners_mm(block, frame)
    try:
        found = convert_lens(lens, into, corners_mm, estimated)
    except AdjustmentError:  # treat it as a model that does not fit
        return FittedLens(_remove_distortion(lens), np.inf)
    return FittedLens(found.lens, found.largest_mm)


def _sheared_fit(rays: Array, observed_mm: Array) -> Lens:
    """Lens with affinity and shear of the ideal point: linear in c, c times the other parameters, principal point."""
    a, b = (rays * (1.0, -1.0)).T  # OpenCV's axes
    r2, none, one = a * a + b * b, np.zeros_like(a), np.ones_like(a)
    across = [a, a * r2, a * r2**2, 2 * a * b, r2 + 2 * a * a, a * r2**3, a, b, one, none]
    down = [b, b * r2, b * r2**2, r2 + 2 * b * b, 2 * a * b, b * r2**3, none, none, none, -one]
    design = np.concatenate([np.stack(across, axis=1), np.stack(down, axis=1)])
    scale = np.linalg.norm(design, axis=0)
    observed = np.concatenate([observed_mm[:, 0], -observed_mm[:, 1]])
    c, *terms, x0, y0 = (np.linalg.lstsq(design / scale, observed)[0] / scale).tolist()
    fitted = dict(zip((*BROWN, *_AFFINE), terms, strict=True))
    parameters = np.array([fitted.get(name, 0.0) / c for name in parameter_names("opencv")])
    return Lens(Distortion("opencv"), np.array([c, x0, y0]), parameters)


@dataclass(frozen=True)
class PinholeFrame:
    """One image in its resampled frame.

    Pixel (0, 0) is the centre of the first pixel; the camera's axes are x right, y down, z forward.

    Attributes
    ----------
    misfit_px : largest error of a point in the frame.
    is_as_taken : whether the frame is a digital camera's picture, pixel by pixel.
    """

    frame: WholeFrame
    canvas: Canvas
    lens: FittedLens
    misfit_px: float
    with_lens: bool
    is_as_taken: bool

    @property
    def picture(self) -> str:
        """Name of the file that `reseau resample` writes, or of the picture itself where the frame is just that."""
        suffix = self.frame.scan.suffix if self.is_as_taken and self.frame.scan else ".tif"
        return f"{self.frame.image}{suffix}"

    def interior_px(self, convention: Convention) -> Array:
        """fx, fy, cx, cy (4,) in px."""
        interior = self.lens.coefficients(INTERIOR)
        point = self.canvas.pixel_from_camera(interior[2:]) + convention.first_pixel_px
        return np.concatenate([interior[:2] / self.canvas.pitch_mm, point])

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) from the object's to the camera's axes."""
        assert self.frame.model is not None
        return np.asarray(incoming.Y_DOWN_Z_FORWARD @ self.frame.model.rotation)

    @property
    def station(self) -> Array:
        assert self.frame.model is not None
        return self.frame.model.station

    @property
    def translation(self) -> Array:
        """Translation (3,) of `camera = rotation X + translation`."""
        return np.asarray(-self.rotation @ self.station)

    def pixels(self, marks: tuple[ComparatorPoint, ...]) -> Array:
        """Column and row (n, 2) of the marks in the resampled frame."""
        return self.canvas.pixel_from_camera(self.frame.frame_mm(marks, self.with_lens))


def pinhole_frames(
    block: ImageBlock, options: ExportOptions, models: Sequence[Sequence[str]], format: str
) -> tuple[list[PinholeFrame], list[str]]:
    """Pinhole frames of every oriented image.

    Parameters
    ----------
    models : each given by its parameters' names; the first that is close enough is used, or OpenCV's fisheye.

    Returns
    -------
    The frames, and the reasons why other images are left out.

    Raises
    ------
    InputError : no image is oriented, or even the last model has a larger misfit than the options allow.
    """
    block.needs_orientation(format)
    lenses: dict[str, FittedLens] = {}
    frames, left_out = [], list(block.unoriented_note())
    for frame in block.whole(block.oriented_frames()):
        if frame.camera not in lenses:
            lenses[frame.camera] = nearest_lens(block, frame, models, options)
        try:
            frames.append(_pinhole(block, frame, lenses[frame.camera], options))
        except MeasurementError as error:
            left_out.append(f"{frame.image}: {error}")
    _check_misfit({frame.frame.image: frame.misfit_px for frame in frames}, options, format)
    return frames, left_out


def checked_misfits(
    block: ImageBlock, frames: Sequence[OutFrame], lens: FittedLens, box: Canvas, options: ExportOptions, format: str
) -> float:
    """Largest misfit, px, of a lens over a camera's images. Raises InputError where it is larger than the options
    allow."""
    misfits = {each.image: (lens.largest_mm + sight_misfit_mm(block, each)) / box.pitch_mm for each in frames}
    _check_misfit(misfits, options, format)
    return max(misfits.values())


def _check_misfit(misfit_px: dict[str, float], options: ExportOptions, format: str) -> None:
    """Raise InputError where the misfit of the worst image is larger than the options allow."""
    worst = max(misfit_px, key=lambda image: misfit_px[image], default=None)
    if worst is not None and not misfit_px[worst] <= options.largest_misfit_px:
        raise InputError(
            f"{format} has no model that takes this camera: the nearest one is off by up to {misfit_px[worst]:.3g} px "
            f"in image {worst!r}, and {options.largest_misfit_px:g} px are allowed. Export with --lens, for frames "
            "that were resampled with --lens, or allow more with --misfit-px."
        )


def sight_misfit_mm(block: ImageBlock, frame: OutFrame) -> float:
    """Largest shift of an image's points by refraction and earth curvature, which other programs do not model."""
    model = frame.model
    assert model is not None
    points = [block.points[mark.point] for mark in frame.observed_marks(fiducials=False) if mark.point in block.points]
    if model.line_of_sight.is_straight or not points:
        return 0.0
    bent, straight = (
        each.camera_from_object(np.array(points))[0] for each in (model, replace(model, line_of_sight=STRAIGHT))
    )
    return float(np.linalg.norm(bent - straight, axis=1).max())


def _pinhole(block: ImageBlock, frame: WholeFrame, lens: FittedLens, options: ExportOptions) -> PinholeFrame:
    """Pinhole of one frame. Raises MeasurementError where the lens folds within the scan."""
    pitch_um = options.pitch_um or float(np.sqrt(np.prod(frame.known_pitch_um)))
    scans, is_as_taken = [], frame.is_as_taken and not options.with_lens and frame.pitch_um == (pitch_um, pitch_um)
    for each in frame.scans:
        with block.open_scan(each) as scan:
            scans.append((each.chain(options.with_lens), scan.part_px))
            is_as_taken &= scan.part_px == (0, 0, scan.width_px, scan.height_px)
    canvas = outline_canvas(scans, pitch_um / 1000.0)
    misfit_mm = lens.largest_mm + sight_misfit_mm(block, frame)
    return PinholeFrame(frame, canvas, lens, misfit_mm / canvas.pitch_mm, options.with_lens, is_as_taken)


def pinholes_written(
    files: Mapping[str, str | bytes], frames: Sequence[PinholeFrame], left_out: Sequence[str], *notes: str, lost: str
) -> Written:
    """Summary of an export of pinholes, with the misfit of the cameras. lost: marks that the format does not hold."""
    worst = max((frame.misfit_px for frame in frames), default=-1.0)
    if worst == 0.0:
        notes = ("The camera's model is the very same: nothing was fitted.", *notes)
    elif worst > 0.0:
        notes = (f"The camera's model was fitted over the frame: it is off by {worst:.2g} px at most.", *notes)
    film: tuple[str, ...] = ("the film transformation (it is that of the resampled frames)",)
    pictures = "The frames of these cameras: reseau resample PROJECT.toml DIR, with the options of this export."
    if any(frame.is_as_taken for frame in frames):
        film = ()
        pictures = "The frames are the pictures as taken; of turned ones, the .tif of `reseau resample`."
    return Written(files, (*film, "all standard deviations", lost), (pictures, *notes), tuple(left_out))


def write_asp(block: ImageBlock, options: ExportOptions) -> Written:
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
    model, terms = "TSAI", dict(zip(BROWN, frame.lens.coefficients(BROWN).tolist(), strict=True))
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


def write_opencv(block: ImageBlock, options: ExportOptions) -> Written:
    """Write NAME.yml for each image, for cv2.FileStorage."""
    frames, left_out = pinhole_frames(block, options, (BROWN, PRISMS, NAMES[4:]), "opencv")
    files = {f"{frame.frame.image}.yml": _yaml(frame, block.lens_reach.get(frame.frame.camera)) for frame in frames}
    return pinholes_written(files, frames, left_out, lost="the marks")


def _yaml(frame: PinholeFrame, lens_reach: str | None) -> str:
    """YAML text of one image. lens_reach: comment on the radius up to which the lens is known."""
    fx, fy, cx, cy = frame.interior_px(OPENCV)
    distortion = frame.lens.coefficients(NAMES[4:])
    used = np.flatnonzero(distortion)
    count = next(size for size in (5, 8, 12, 14) if size > (used.max() if used.size else 0))
    coefficients = np.array([frame.lens.fisheye or distortion[:count]])
    return yaml_text(
        [
            ("image", frame.picture),
            ("camera", frame.frame.camera),
            ("image_width", frame.canvas.width_px),
            ("image_height", frame.canvas.height_px),
            ("camera_matrix", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])),
            *([("", lens_reach)] if lens_reach else []),
            *([("distortion_model", FISHEYE_MODEL)] if frame.lens.fisheye else []),
            ("distortion_coefficients", coefficients),
            ("R", frame.rotation),
            ("t", frame.translation.reshape(3, 1)),
        ]
    )


def import_opencv(paths: Sequence[Path], options: incoming.ImportOptions) -> incoming.Incoming:
    """Read files of cv2.FileStorage: matrix, distortion and size as camera files; R and t, if given, as orientations.

    Cameras of one name that differ, as those of rectified frames of different sizes do, get their pictures' names too.
    """
    read, turns = list[tuple[str, CameraFile]](), dict[str, tuple[Array, Array]]()
    pictures = set[str]()
    for path in paths:
        found, storage = read_pixel_camera(path)
        name = storage.getNode("camera").string() or path.stem
        picture = image_name(storage.getNode("image").string() or path.stem)
        camera = incoming.opencv_camera(
            path, name, found.interior_px, found.distortion, found.size_px, options, OPENCV, found.family
        )
        if picture in pictures:
            raise InputError(f"{path}: image {picture!r} is given twice in the files. Name one of them.")
        pictures.add(picture)
        read.append((picture, camera))
        if not (storage.getNode("R").empty() or storage.getNode("t").empty()):
            turn, shift = (read_matrix(path, storage.getNode(key)) for key in ("R", "t"))
            if turn.shape != (3, 3) or shift.size != 3:
                raise InputError(f"{path}: R is to be a 3 x 3 rotation matrix, and t three numbers. Correct them.")
            turns[picture] = turn, shift.ravel()
    first: dict[str, CameraFile] = {}
    differing = {one.name for _, one in read if replace(first.setdefault(one.name, one), path=one.path) != one}
    cameras = {
        picture: replace(one, name=f"{one.name} {picture}") if one.name in differing else one for picture, one in read
    }
    poses = (incoming.foreign_pose(picture, *turn, cameras[picture].name) for picture, turn in turns.items())
    return incoming.Incoming(cameras=tuple(cameras.values()), poses=tuple(poses))


def write_colmap(block: ImageBlock, options: ExportOptions) -> Written:
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


def _reconstruction(pycolmap: Any, block: ImageBlock, frames: list[PinholeFrame]) -> Any:
    """Reconstruction of the frames with the marks of adjusted points, and of these points with their tracks.

    Cameras are of the model OPENCV, FULL_OPENCV if the lens has a third radial term, or OPENCV_FISHEYE.
    """
    made, tracks = pycolmap.Reconstruction(), defaultdict(list)
    for number, frame in enumerate(frames, 1):
        model, terms, rest = "OPENCV", frame.lens.coefficients(_OPENCV[len(INTERIOR) :]), frame.lens.coefficients(_FULL)
        if rest.any():
            model, terms = "FULL_OPENCV", np.concatenate([terms, rest])
        if frame.lens.fisheye:
            model, terms = _FISHEYE, np.array(frame.lens.fisheye)
        params = [*frame.interior_px(COLMAP), *terms]
        width, height = frame.canvas.width_px, frame.canvas.height_px
        made.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=model, width=width, height=height, params=params)
        )
        marks = tuple(mark for mark in frame.frame.observed_marks(fiducials=False) if mark.point in block.points)
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


def import_colmap(paths: Sequence[Path], options: incoming.ImportOptions) -> incoming.Incoming:
    """Read folders of reconstructions (.bin or .txt): orientations as approximations, and cameras of the models that
    OpenCV has."""
    pycolmap = import_pycolmap("the format colmap")
    cameras, poses, notes, left_out = [], [], [], list[str]()
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
                own = sorted(image_name(image.name) for image in made.images.values() if image.camera_id == number)
                without = f" Images without a camera: {listed(own)}." if own else ""
                left_out.append(f"Camera {number} is of the model {camera.model_name}, which is not read.{without}")
                continue
            interior, lens = known
            size = (camera.width, camera.height)
            family = "opencv_fisheye" if camera.model_name == _FISHEYE else "opencv"
            name = f"camera{number}"
            cameras.append(incoming.opencv_camera(folder, name, interior, lens, size, options, COLMAP, family))
        for image in made.images.values():
            if image.has_pose:
                pose = image.cam_from_world()
                camera_name = f"camera{image.camera_id}"
                poses.append(
                    incoming.foreign_pose(image_name(image.name), pose.rotation.matrix(), pose.translation, camera_name)
                )
    poses.sort(key=lambda pose: pose.image)
    notes.append("The exterior orientations are approximations, in the coordinates of that reconstruction.")
    return incoming.Incoming(cameras=tuple(cameras), poses=tuple(poses), notes=tuple(notes), left_out=tuple(left_out))


def _parameters(camera: Any) -> tuple[list[float], dict[str, float]] | None:
    """fx, fy, cx, cy in px and the distortion by OpenCV's names; None for other camera models."""
    values = [float(value) for value in camera.params]
    if camera.model_name not in _MODELS:
        return None
    focals, lens = _MODELS[camera.model_name]
    fx, fy = values[0], values[focals - 1]
    return [fx, fy, *values[focals : focals + 2]], dict(zip(lens, values[focals + 2 :], strict=True))
