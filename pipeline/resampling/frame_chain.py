"""The way from a place in the camera's frame to a pixel of the scan: lens, film transformation, scanner, pitch."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Lens
from adjust.functional_model.scanner import NO_BEND, Bend
from adjust.functional_model.transformation import Film, film_parameter_names
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FrameChain:
    """What takes a scan to its camera's frame and back; lens None: to the observed points of the frame, distortion
    left in. Its transformations, in the order from the scan: pitch, bend of the scanner, film, lens."""

    pitch_um: tuple[float, float]
    film: Film
    bend: Bend = NO_BEND
    bend_parameters: Array = field(default_factory=lambda: np.empty(0))
    lens: Lens | None = None

    def scan_from_frame(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Pixels (n, 2), column and row, of camera coordinates (n, 2) in mm; which of them the scan can have."""
        observed, seen = xy_mm, np.ones(len(xy_mm), dtype=bool)
        if self.lens is not None:
            ray = (xy_mm - self.lens.interior[1:]) / self.lens.interior[0]
            observed, seen = self.lens.camera_from_ray(ray)
        comparator, on_film = self.film.comparator_from_camera(observed)
        place, on_glass = self.bend.inverse(self.bend_parameters, comparator)
        return pixel_from_comparator(place, self.pitch_um), seen & on_film & on_glass

    def frame_from_scan(self, col_row: Array) -> tuple[Array, Mask]:
        """Camera coordinates (n, 2) in mm of pixels (n, 2); which of them the camera can have."""
        comparator = self.bend.apply(self.bend_parameters, comparator_from_pixel(col_row, self.pitch_um))
        observed = self.film.camera_from_comparator(comparator)
        if self.lens is None:
            return observed, np.ones(len(observed), dtype=bool)
        return self.lens.ideal_from_observed(observed)


def adjusted_chain(measured: MeasuredScan, adjustment: AdjustmentRecord, with_lens: bool) -> FrameChain:
    """The chain of an image of adjustment.json, with the film transformation and the scanner that were adjusted."""
    return image_chain(measured.frame.image, adjustment, measured.pitch_um, _middle_mm(measured), with_lens)


def image_chain(
    name: str, adjustment: AdjustmentRecord, pitch_um: tuple[float, float], middle_mm: Array, with_lens: bool
) -> FrameChain:
    """The same. middle_mm (2,): a place about in the middle of the image, in the comparator."""
    image = adjustment.images[name]
    scanner = adjustment.scanners.get(image.scanner)
    bend = (NO_BEND, np.empty(0)) if scanner is None else scanner.bend()
    lens = adjustment.cameras[adjustment.camera_of(name)].lens() if with_lens else None
    return FrameChain(pitch_um, image.transformation.film(middle_mm), *bend, lens)


def measured_chain(measured: MeasuredScan) -> FrameChain | None:
    """The chain by the fiducials of a scan alone, None where too few were found."""
    matrix = measured.frame.pixel_from_camera
    if matrix is None:
        return None
    by_camera = comparator_from_pixel(matrix.T, measured.pitch_um)  # rows: of x', y' and 1
    inverse = np.linalg.inv(by_camera[:2].T)
    shift = -inverse @ by_camera[2]
    a, b = ([shift[axis], *inverse[axis]] for axis in (0, 1))
    order = {"a1": a[0], "a2": a[1], "a3": a[2], "b1": b[0], "b2": b[1], "b3": b[2]}
    parameters = np.array([order[name] for name in film_parameter_names("affine")])
    return FrameChain(measured.pitch_um, Film("affine", parameters, _middle_mm(measured)))


def _middle_mm(measured: MeasuredScan) -> Array:
    middle_px = np.array([measured.width_px - 1, measured.height_px - 1]) / 2.0
    return comparator_from_pixel(middle_px, measured.pitch_um)
