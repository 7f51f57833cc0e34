"""A resampled frame as programs know cameras that have no film: a pinhole with OpenCV's distortion, and a pose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.line_of_sight import STRAIGHT
from measure.errors import MeasurementError
from pipeline.errors import InputError
from pipeline.exchange.block import Block, Frame, WholeFrame
from pipeline.exchange.fitted_lens import FittedLens, fisheye_lens, nearest_lens
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.opencv_check.opencv_model import INTERIOR
from pipeline.resampling.canvas import Canvas, outline_canvas
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.types import Array

Y_DOWN_Z_FORWARD = np.diag([1.0, -1.0, -1.0])  # from the camera's axes (y up, looking along -z) to these programs'


@dataclass(frozen=True)
class PinholeFrame:
    """One image in its resampled frame: pixel (0, 0) is the centre of the first one, the camera's axes are x right, y
    down, z forward. misfit_px: the largest in its frame."""

    frame: WholeFrame
    canvas: Canvas
    lens: FittedLens
    misfit_px: float
    with_lens: bool

    @property
    def picture(self) -> str:
        """The file that `reseau resample` writes."""
        return f"{self.frame.image}.tif"

    def interior_px(self, convention: Convention) -> Array:
        """fx, fy, cx, cy (4,)."""
        interior = self.lens.named(INTERIOR)
        point = self.canvas.pixel_from_camera(interior[2:]) + convention.first_pixel_px
        return np.concatenate([interior[:2] / self.canvas.pitch_mm, point])

    @property
    def rotation(self) -> Array:
        """(3, 3) from the object to the camera's axes."""
        assert self.frame.model is not None
        return np.asarray(Y_DOWN_Z_FORWARD @ self.frame.model.rotation)

    @property
    def station(self) -> Array:
        assert self.frame.model is not None
        return self.frame.model.station

    @property
    def translation(self) -> Array:
        """(3,) of `camera = rotation X + translation`."""
        return np.asarray(-self.rotation @ self.station)

    def pixels(self, marks: tuple[ComparatorPoint, ...]) -> Array:
        """Column and row (n, 2) of the marks in the resampled frame."""
        return self.canvas.pixel_from_camera(self.frame.frame_mm(marks, self.with_lens))


def pinhole_frames(
    block: Block, options: ExportOptions, models: Sequence[Sequence[str]], format: str
) -> tuple[list[PinholeFrame], list[str]]:
    """Every oriented image with its lens in the first of the models, each given by its parameters' names, that is near
    enough, or as OpenCV's fisheye; and why the other images are not among them.

    Raises InputError where no image is oriented, or where the last model, too, is off by more than the options allow.
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
    """The largest misfit, px, of a camera's images by a lens. Raises InputError as `pinhole_frames` does."""
    misfits = {each.image: (lens.largest_mm + sight_misfit_mm(block, each)) / box.pitch_mm for each in frames}
    _check_misfit(misfits, options, format)
    return max(misfits.values())


def _check_misfit(misfit_px: dict[str, float], options: ExportOptions, format: str) -> None:
    """Raises InputError where the worst image is off by more than the options allow."""
    worst = max(misfit_px, key=lambda image: misfit_px[image], default=None)
    if worst is not None and not misfit_px[worst] <= options.largest_misfit_px:
        raise InputError(
            f"{format} has no model that takes this camera: the nearest one is off by up to {misfit_px[worst]:.3g} px "
            f"in image {worst!r}, and {options.largest_misfit_px:g} px are allowed. Export with --lens, for frames "
            "that were resampled with --lens, or allow more with --misfit-px."
        )


def sight_misfit_mm(block: Block, frame: Frame) -> float:
    """How far refraction and the earth's curvature, which other programs do not know, move an image's points."""
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
    """Raises MeasurementError where the lens folds within the scan."""
    pitch_um = options.pitch_um or float(np.sqrt(np.prod(frame.known_pitch_um)))
    scans = [(scan.chain(options.with_lens), *block.size_px(scan)) for scan in frame.scans]
    canvas = outline_canvas(scans, pitch_um / 1000.0)
    misfit_mm = lens.largest_mm + sight_misfit_mm(block, frame)
    return PinholeFrame(frame, canvas, lens, misfit_mm / canvas.pitch_mm, options.with_lens)


def pinholes_written(
    files: Mapping[str, str | bytes], frames: Sequence[PinholeFrame], left_out: Sequence[str], *notes: str, lost: str
) -> Written:
    """What a format of pinholes has written, with how well the cameras could be handed on. lost: of the marks."""
    worst = max((frame.misfit_px for frame in frames), default=-1.0)
    if worst == 0.0:
        notes = ("The camera's model is the very same: nothing was fitted.", *notes)
    elif worst > 0.0:
        notes = (f"The camera's model was fitted over the frame: it is off by {worst:.2g} px at most.", *notes)
    film = "the film transformation (it is that of the resampled frames)"
    return Written(files, (film, "all standard deviations", lost), notes, tuple(left_out))
