"""Data for the export: the observed marks of every image and the results of the adjustment."""

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ImageModel, LineOfSight
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.scanner import NO_BEND
from measure.scans.remote import ScanPart
from pipeline.adjusting.picture_turn import NOT_TURNED, Turn, picture_turn, turned_back
from pipeline.archive.made_from import changed_scans, current_adjustment
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.files.project_tables import UNITS_MM
from pipeline.resampling.canvas import FrameChain, image_chain
from pipeline.results.adjustment_file import ParameterCovariance, read_own_covariance
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.comparator_file import (
    ComparatorPoint,
    has_pixels_alone,
    pixel_from_comparator,
    read_comparator,
    read_measurement_hash,
    read_pitches,
)
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.text.wording import listed
from pipeline.types import Array

if TYPE_CHECKING:
    from measure.scans.scan import Scan

NO_PITCH = (1000.0, 1000.0)  # µm, where pixel coordinates are not needed


@dataclass(frozen=True)
class OutFrame:
    """One image to be exported.

    Attributes
    ----------
    scan, pitch_um : path and pixel pitch; None if unknown.
    model : adjusted; None for images without a part in the adjustment.
    is_oriented : whether the exterior orientation was adjusted, too.
    turn : of a digital picture, from its sensor.
    """

    image: str
    camera: str
    scan: Path | None
    pitch_um: tuple[float, float] | None
    marks: tuple[ComparatorPoint, ...]
    model: ImageModel | None
    is_oriented: bool
    turn: Turn = NOT_TURNED

    def observed_marks(self, fiducials: bool) -> tuple[ComparatorPoint, ...]:
        """Its fiducials, or its object points."""
        return tuple(mark for mark in self.marks if mark.kind != "join" and (mark.kind == "fiducial") == fiducials)

    def pixels(self, marks: tuple[ComparatorPoint, ...]) -> Array:
        """Column and row (n, 2) of marks in the scan. Raises InputError where the pitch is unknown."""
        return pixel_from_comparator(_places_mm(marks), self.known_pitch_um)

    def camera_mm(self, marks: tuple[ComparatorPoint, ...]) -> Array:
        """Observed places (n, 2) of marks in the camera's frame, mm."""
        assert self.model is not None  # only called for frames with a part in the adjustment
        return self.model.camera_from_comparator(turned_back(_places_mm(marks), *self.turn))

    def frame_mm(self, marks: tuple[ComparatorPoint, ...], with_lens: bool) -> Array:
        """Observed places (n, 2) in the resampled frame, mm. with_lens: its distortion is removed."""
        return self.chain(with_lens).frame_from_scan(self.pixels(marks))[0]

    @property
    def lens(self) -> Lens:
        """Adjusted lens, of images with a part in the adjustment."""
        assert self.model is not None
        return self.model.lens

    @property
    def known_pitch_um(self) -> tuple[float, float]:
        """The pixel pitch. Raises InputError where it is unknown."""
        if self.pitch_um is None:
            raise InputError(
                f"the pitch of image {self.image!r} is not known, and this format counts in pixels. Give pitch_um in "
                "the project."
            )
        return self.pitch_um

    @property
    def is_as_taken(self) -> bool:
        """Whether the comparator is the camera's frame: a digital camera's picture that was not turned."""
        model = self.model
        is_plain = model is not None and model.film.transformation == "none" and model.bend is NO_BEND
        return is_plain and self.turn == NOT_TURNED

    @property
    def is_mirrored(self) -> bool:
        """Whether the scan is mirrored with respect to the camera's frame."""
        if self.model is None:
            return False
        return bool(np.linalg.det(self.model.camera_by_comparator(self.model.film.center_mm[None])[0]) < 0.0)

    def chain(self, with_lens: bool) -> FrameChain:
        """Transformations from the scan to the camera's frame."""
        model = self.model
        assert model is not None
        lens = model.lens if with_lens else None
        return FrameChain(self.known_pitch_um, model.film, model.bend, model.bend_parameters, lens, self.turn)

    @property
    def file_name(self) -> str:
        """File name of the scan; the image's name with .tif where there is none."""
        return self.scan_file.name if self.scan_file else f"{self.image}.tif"

    @property
    def scan_file(self) -> Path | None:
        """File of the scan, which may be one page or a window of it."""
        return Path(os.fspath(self.scan)) if isinstance(self.scan, ScanPart) else self.scan


@dataclass(frozen=True)
class WholeFrame(OutFrame):
    """An exposed frame, by its name: as its first scan, with further scans of the same exterior orientation."""

    scans: tuple[OutFrame, ...] = ()

    def observed_marks(self, fiducials: bool) -> tuple[ComparatorPoint, ...]:
        """Its fiducials, or its object points; the most precise mark of those observed in several scans."""
        best: dict[str, ComparatorPoint] = {}
        for mark in (mark for scan in self.scans for mark in scan.observed_marks(fiducials)):
            best[mark.point] = min(best.get(mark.point, mark), mark, key=_variance)
        return tuple(best.values())

    def camera_mm(self, marks: tuple[ComparatorPoint, ...]) -> Array:
        """Observed places (n, 2) of marks in the camera's frame, mm."""
        return self._collect(marks, OutFrame.camera_mm)

    def frame_mm(self, marks: tuple[ComparatorPoint, ...], with_lens: bool) -> Array:
        """Observed places (n, 2) in the resampled frame, mm. with_lens: its distortion is removed."""
        return self._collect(marks, lambda scan, own: scan.frame_mm(own, with_lens))

    def _collect(
        self, marks: tuple[ComparatorPoint, ...], places: Callable[[OutFrame, tuple[ComparatorPoint, ...]], Array]
    ) -> Array:
        images, found = np.array([mark.image for mark in marks]), np.zeros((len(marks), 2))
        for scan in self.scans:
            found[images == scan.image] = places(scan, tuple(mark for mark in marks if mark.image == scan.image))
        return found


@dataclass(frozen=True)
class ImageBlock:
    """The images of a project, sorted by name. adjustment: None where none is valid."""

    project: Project
    frames: tuple[OutFrame, ...]
    adjustment: AdjustmentRecord | None

    @cached_property
    def covariance(self) -> ParameterCovariance:
        return read_own_covariance(self.project.adjustment_path)

    @cached_property
    def points(self) -> dict[str, Array]:
        """Adjusted coordinates (3,) of the object points, in the project's unit."""
        return {id: point.xyz for id, point in self.adjustment.points.items()} if self.adjustment else {}

    @cached_property
    def lens_reach(self) -> dict[str, str]:
        """By camera, a sentence on the radius up to which its lens is known: beyond it, the exported lens is
        extrapolated."""
        # In pixels of a digital camera, whose pixel size may be no figure of its own.
        digital = (each for each in self.frames if each.model and each.model.film.transformation == "none")
        units = {each.camera: ImageUnit(min(each.pitch_um)) for each in reversed(list(digital)) if each.pitch_um}
        lenses = self.adjustment.estimated_lenses() if self.adjustment else ()
        return {name: known.sentence(name, units.get(name, FILM_UNIT)) for name, known in lenses if known.share < 1.0}

    def camera_file(self, name: str) -> CameraFile:
        """Camera file by the camera's name."""
        return next(camera for camera in self.project.cameras.values() if camera.name == name)

    def fiducials_mm(self, camera: str) -> dict[str, tuple[float, float]]:
        """Fiducial coordinates of a camera: adjusted, or as given where there is no adjustment."""
        adjusted = self.adjustment.cameras.get(camera) if self.adjustment else None
        if adjusted is not None:
            return {id: mark.xy_mm for id, mark in adjusted.fiducials.items()}
        return {fiducial.id: fiducial.xy_mm for fiducial in self.camera_file(camera).fiducials}

    def open_scan(self, frame: OutFrame) -> "Scan":
        """Open the scan of an image. Raises InputError where there is none."""
        if frame.scan is None:
            raise InputError(
                f"the scan of image {frame.image!r} is not known, and this format needs its size. Name the scans in "
                "the project."
            )
        return self.project.open_scan(frame.image)

    def oriented_frames(self) -> Iterator[OutFrame]:
        return (frame for frame in self.frames if frame.is_oriented)

    def whole(self, scans: Iterable[OutFrame]) -> list[WholeFrame]:
        """Group scans into exposed frames (column part_of)."""
        parts: dict[str, list[OutFrame]] = {}
        for scan in scans:
            parts.setdefault(self.project.image_frame(scan.image), []).append(scan)
        return [WholeFrame(**{**vars(own[0]), "image": name}, scans=tuple(own)) for name, own in parts.items()]

    def unoriented_note(self) -> tuple[str, ...]:
        """One sentence per image without exterior orientation."""
        return tuple(
            f"{frame.image}: it has no adjusted orientation." for frame in self.frames if not frame.is_oriented
        )

    def needs_orientation(self, format: str) -> None:
        """Raise InputError where no image is oriented."""
        if not any(self.oriented_frames()):
            path = self.project.adjustment_path
            has = f"{path} has none" if path.exists() else f"there is no {path}"
            raise InputError(
                f"{format} is for oriented images, and {has}. Run `reseau adjust` first, with object points that the "
                "images show, or `reseau block`."
            )


def read_block(project: Project) -> ImageBlock:
    """Read the measurements and the adjustment of a project.

    Raises
    ------
    InputError : nothing was measured, or the marks or the adjustment are stale.
    """
    if not project.comparator.exists():
        raise InputError(f"{project.comparator}: there is no such file. Run `reseau measure` first.")
    marks = read_comparator(project.comparator, project.list_pitch_um)
    digest = read_measurement_hash(project.comparator)
    if digest and (changed := changed_scans(project, digest)):
        raise InputError(
            f"{project.comparator}: is of other scans than there are now: {listed(changed)}. Run `reseau measure`."
        )
    adjustment = current_adjustment(project, marks)
    pitches = read_pitches(project.comparator)
    if project.list_pitch_um is not None and has_pixels_alone(project.comparator):
        pitches = dict.fromkeys((mark.image for mark in marks), project.list_pitch_um)
    by_image: dict[str, list[ComparatorPoint]] = {mark.image: [] for mark in marks}
    for mark in marks:
        if mark.status.is_observation:
            by_image[mark.image].append(mark)
    frames = [
        _frame(project, adjustment, image, tuple(own), pitches.get(image, project.pitch_um))
        for image, own in sorted(by_image.items())
    ]
    return ImageBlock(project, tuple(frames), adjustment)


def _frame(
    project: Project,
    adjustment: AdjustmentRecord | None,
    image: str,
    marks: tuple[ComparatorPoint, ...],
    pitch_um: tuple[float, float] | None,
) -> OutFrame:
    known = adjustment.images.get(image) if adjustment else None
    camera, scan = project.image_camera(image).name, project.scans.get(image)
    if adjustment is None or known is None:
        return OutFrame(image, camera, scan, pitch_um, marks, None, False)
    lens = adjustment.cameras[adjustment.image_camera(image)].lens()
    turn = picture_turn(project, image)
    places = turned_back(_places_mm(marks), *turn)
    middle_mm = (places.min(axis=0) + places.max(axis=0)) / 2.0 if len(places) else np.zeros(2)
    chain = image_chain(image, adjustment, NO_PITCH, middle_mm, False)
    exterior = np.array([element.value for element in known.exterior.elements.values()])
    unit_m = project.unit_mm / UNITS_MM["m"]
    model = ImageModel(
        lens,
        rotation_from_angles(np.radians(exterior[3:])),
        exterior[:3],
        chain.film,
        LineOfSight(adjustment.earth_curvature, adjustment.refraction, unit_m),
        chain.bend,
        chain.bend_parameters,
    )
    return OutFrame(image, camera, scan, pitch_um, marks, model, known.exterior.is_oriented, turn)


def _variance(mark: ComparatorPoint) -> float:
    return np.inf if mark.sigma_mm is None else float((mark.sigma_mm**2).sum())


def _places_mm(marks: tuple[ComparatorPoint, ...]) -> Array:
    return np.array([mark.xy_mm for mark in marks], dtype=float).reshape(-1, 2)
