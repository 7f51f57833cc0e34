"""Resampled frames as images of cameras without film: a pinhole with OpenCV's distortion, and an exterior
orientation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.projection import STRAIGHT
from measure.errors import MeasurementError
from pipeline.errors import InputError
from pipeline.exchange.block import Block, Frame, WholeFrame
from pipeline.exchange.fitted_lens import FittedLens, fisheye_lens, nearest_lens
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.opencv_check.opencv_calibration import INTERIOR
from pipeline.resampling.canvas import Canvas, outline_canvas
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.types import Array

Y_DOWN_Z_FORWARD = np.diag([1.0, -1.0, -1.0])  # from the camera's axes (y up, looking along -z) to these programs' axes


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
    block: Block, frames: Sequence[Frame], lens: FittedLens, box: Canvas, options: ExportOptions, format: str
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


def sight_misfit_mm(block: Block, frame: Frame) -> float:
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
    scans = [(scan.chain(options.with_lens), block.part_px(scan)) for scan in frame.scans]
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
