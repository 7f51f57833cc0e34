"""Resampled frames as images of cameras without film: a pinhole with OpenCV's distortion, which is the camera's own or
fitted to it over the frame, and an exterior orientation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.lens_conversion import convert_lens, frame_grid_mm
from adjust.functional_model.projection import STRAIGHT
from measure.errors import MeasurementError
from pipeline.errors import InputError
from pipeline.exchange.block import Block, OutFrame, WholeFrame
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.opencv_check.opencv_calibration import FISHEYE, INTERIOR, fixed, model_names, opencv_values
from pipeline.resampling.canvas import Canvas, outline_canvas
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.types import Array

BROWN = ("k1", "k2", "p1", "p2", "k3")
RATIONAL = (*BROWN, "k4", "k5", "k6")
PRISMS = (*BROWN, "s1", "s2", "s3", "s4")
_AFFINE = ("b1", "b2")
_ONE_SCALE = ("none", "torlegard")  # families without affinity and shear

Y_DOWN_Z_FORWARD = np.diag([1.0, -1.0, -1.0])  # from the camera's axes (y up, looking along -z) to these programs' axes


@dataclass(frozen=True)
class FittedLens:
    """A lens of the family of one of OpenCV's models. largest_mm: largest error of a point in the frame."""

    lens: Lens
    largest_mm: float

    def named(self, names: Sequence[str]) -> Array:
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


def nearest_lens(block: Block, frame: OutFrame, models: Sequence[Sequence[str]], options: ExportOptions) -> FittedLens:
    """Fit the lens of an image's camera in one of several models, each given by names of OpenCV's parameters.

    The first model that is identical is taken; else the first that is close enough; else the last. If the lens
    distortion is removed from the frames, the result is a lens without distortion.
    """
    lens = frame.lens
    if options.with_lens or lens.distortion.family == "none":
        return FittedLens(_undistorted(lens), 0.0)
    for names in models:
        if _has_only(lens, (*names, "b1")):
            return FittedLens(lens, 0.0)
    for names in models:
        fitted = _fit_opencv(block, frame, names)
        if fitted.largest_mm <= options.largest_misfit_px * min(frame.known_pitch_um) / 1000.0:
            break
    return fitted


def fisheye_lens(block: Block, frame: OutFrame, options: ExportOptions) -> FittedLens | None:
    """The lens of an image's camera if it is OpenCV's fisheye. Its shear, which programs leave out, becomes the
    misfit."""
    lens = frame.lens
    if lens.distortion.family != FISHEYE or options.with_lens:
        return None
    farthest_mm = float(np.abs(frame_corners_mm(block, frame)[:, 1] - lens.interior[2]).max())
    return FittedLens(lens, abs(float(lens.parameters[-1])) * farthest_mm)


def sheared_lens(block: Block, frame: OutFrame, at_ideal: bool) -> FittedLens:
    """The lens of an image's camera with k1, k2, k3, p1, p2, affinity and shear.

    Parameters
    ----------
    at_ideal : affinity and shear apply to the ideal point, as in MicMac, and not to the distorted one, as in Metashape.
    """
    lens = frame.lens
    family = lens.distortion.family
    if family == "none":
        return FittedLens(_undistorted(lens), 0.0)
    if _has_only(lens, BROWN if at_ideal else (*BROWN, *_AFFINE)):
        return FittedLens(lens, 0.0)
    if family in _ONE_SCALE or not at_ideal:
        return _fit_opencv(block, frame, (*BROWN, *_AFFINE))
    grid_mm = frame_grid_mm(frame_corners_mm(block, frame))
    rays, found = lens.ray_from_observed(grid_mm)
    rays, observed_mm = rays[found], grid_mm[found]
    fitted = _sheared_fit(rays, observed_mm)
    return FittedLens(fitted, float(np.linalg.norm(_sheared(fitted, rays) - observed_mm, axis=1).max()))


def frame_corners_mm(block: Block, frame: OutFrame) -> Array:
    """(2, 2) opposite corners of the exposed frame, camera mm: from the camera file, or the extent of the
    observations."""
    camera = block.camera_file(frame.camera)
    if camera.fiducials and camera.frame_mm is not None:
        half = np.array(camera.frame_mm) / 2.0
        return np.array([-half, half])
    places = [
        each.model.camera_from_comparator(np.array([mark.xy_mm for mark in each.marks]))
        for each in block.frames
        if each.camera == frame.camera and each.model is not None and each.marks
    ]
    observed = np.concatenate(places)
    return np.array([observed.min(axis=0), observed.max(axis=0)])


def _undistorted(lens: Lens) -> Lens:
    return Lens(Distortion("opencv"), lens.interior, np.zeros(len(parameter_names("opencv"))))


def _has_only(lens: Lens, names: Sequence[str]) -> bool:
    """Whether a lens is of OpenCV's family and has no other parameters than these."""
    family = lens.distortion.family
    known = zip(parameter_names(family), lens.parameters, strict=True)
    return family == "opencv" and not any(value for name, value in known if name not in names)


def _fit_opencv(block: Block, frame: OutFrame, names: Sequence[str]) -> FittedLens:
    """Fit parameters of these names in OpenCV's model."""
    lens = frame.lens
    family = lens.distortion.family
    estimated = [name for name in names if name not in _AFFINE] if family in _ONE_SCALE else [*names, "b1"]
    own = zip(parameter_names(family), lens.parameters.tolist(), strict=True)
    into = fixed("opencv", {name: value for name, value in own if name in estimated} if family == "opencv" else {})
    corners_mm = frame_corners_mm(block, frame)
    try:
        found = convert_lens(lens, into, corners_mm, estimated)
    except AdjustmentError:  # treat it as a model that does not fit
        return FittedLens(_undistorted(lens), np.inf)
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


def _sheared(lens: Lens, rays: Array) -> Array:
    """Camera coordinates (n, 2) in mm of rays (n, 2)."""
    parameters, (b1, b2) = lens.parameters.copy(), lens.parameters[-2:]
    parameters[-2:] = 0.0
    bent, _ = replace(lens, interior=np.array([1.0, 0.0, 0.0]), parameters=parameters).camera_from_ray(rays)
    bent[:, 0] += b1 * rays[:, 0] - b2 * rays[:, 1]
    return np.asarray(lens.interior[0] * bent + lens.interior[1:])


@dataclass(frozen=True)
class PinholeFrame:
    """One image in its resampled frame.

    Pixel (0, 0) is the centre of the first pixel; the camera's axes are x right, y down, z forward. misfit_px: largest
    error of a point in the frame.
    """

    frame: WholeFrame
    canvas: Canvas
    lens: FittedLens
    misfit_px: float
    with_lens: bool

    @property
    def picture(self) -> str:
        """Name of the file that `reseau resample` writes."""
        return f"{self.frame.image}.tif"

    def interior_px(self, convention: Convention) -> Array:
        """fx, fy, cx, cy (4,) in px."""
        interior = self.lens.named(INTERIOR)
        point = self.canvas.pixel_from_camera(interior[2:]) + convention.first_pixel_px
        return np.concatenate([interior[:2] / self.canvas.pitch_mm, point])

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) from the object's to the camera's axes."""
        assert self.frame.model is not None
        return np.asarray(Y_DOWN_Z_FORWARD @ self.frame.model.rotation)

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
    block: Block, options: ExportOptions, models: Sequence[Sequence[str]], format: str
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
    for frame in block.whole(block.oriented()):
        if frame.camera not in lenses:
            lenses[frame.camera] = fisheye_lens(block, frame, options) or nearest_lens(block, frame, models, options)
        try:
            frames.append(_pinhole(block, frame, lenses[frame.camera], options))
        except MeasurementError as error:
            left_out.append(f"{frame.image}: {error}")
    _check_misfit({frame.frame.image: frame.misfit_px for frame in frames}, options, format)
    return frames, left_out


def checked_misfits(
    block: Block, frames: Sequence[OutFrame], lens: FittedLens, box: Canvas, options: ExportOptions, format: str
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


def sight_misfit_mm(block: Block, frame: OutFrame) -> float:
    """Largest shift of an image's points by refraction and earth curvature, which other programs do not model."""
    model = frame.model
    assert model is not None
    points = [block.points[mark.point] for mark in frame.observed(fiducials=False) if mark.point in block.points]
    if model.line_of_sight.is_straight or not points:
        return 0.0
    bent, straight = (
        each.camera_from_object(np.array(points))[0] for each in (model, replace(model, line_of_sight=STRAIGHT))
    )
    return float(np.linalg.norm(bent - straight, axis=1).max())


def _pinhole(block: Block, frame: WholeFrame, lens: FittedLens, options: ExportOptions) -> PinholeFrame:
    """Pinhole of one frame. Raises MeasurementError where the lens folds within the scan."""
    pitch_um = options.pitch_um or float(np.sqrt(np.prod(frame.known_pitch_um)))
    scans = []
    for each in frame.scans:
        with block.open_scan(each) as scan:
            scans.append((each.chain(options.with_lens), scan.part_px))
    canvas = outline_canvas(scans, pitch_um / 1000.0)
    misfit_mm = lens.largest_mm + sight_misfit_mm(block, frame)
    return PinholeFrame(frame, canvas, lens, misfit_mm / canvas.pitch_mm, options.with_lens)


def pinholes_written(
    files: Mapping[str, str | bytes], frames: Sequence[PinholeFrame], left_out: Sequence[str], *notes: str, lost: str
) -> Written:
    """Summary of an export of pinholes, with the misfit of the cameras. lost: marks that the format does not hold."""
    worst = max((frame.misfit_px for frame in frames), default=-1.0)
    if worst == 0.0:
        notes = ("The camera's model is the very same: nothing was fitted.", *notes)
    elif worst > 0.0:
        notes = (f"The camera's model was fitted over the frame: it is off by {worst:.2g} px at most.", *notes)
    film = "the film transformation (it is that of the resampled frames)"
    return Written(files, (film, "all standard deviations", lost), notes, tuple(left_out))
