"""Lens of the digital camera that photographed the film: `[scanner] lens`, a calibration in OpenCV's YAML."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from measure.scans.scan import Scan
from pipeline.errors import InputError
from pipeline.files.opencv_file import read_pixel_camera
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.types import Array


@dataclass(frozen=True, eq=False)
class CalibratedLens:
    """Lens in comparator coordinates of the scans that its camera took.

    Attributes
    ----------
    lens : interior orientation, mm at the scans' pitch, with its covariance if the calibration gives one.
    pitch_um : pixel pitch across and down.
    size_px : width and height of its images.
    """

    lens: Lens
    pitch_um: tuple[float, float]
    size_px: tuple[int, int]

    @property
    def is_covariance_known(self) -> bool:
        return self.lens.covariance.size > 0

    def ideal_px(self, scan_px: Array) -> Array:
        """Distortion-free pixel coordinates of scan pixels (..., 2); unchanged outside the lens's field of view."""
        scan_mm = comparator_from_pixel(np.reshape(scan_px, (-1, 2)), self.pitch_um)
        ideal_mm, found = self.lens.ideal_from_observed(scan_mm)
        return self._px(np.where(found[:, None], ideal_mm, scan_mm), np.shape(scan_px))

    def scan_px(self, ideal_px: Array) -> Array:
        """Inverse of `ideal_px`: scan pixels of distortion-free pixels (..., 2)."""
        ideal_mm = comparator_from_pixel(np.reshape(ideal_px, (-1, 2)), self.pitch_um)
        scan_mm, found = self.lens.camera_from_ray((ideal_mm - self.lens.interior[1:]) / self.lens.interior[0])
        return self._px(np.where(found[:, None], scan_mm, ideal_mm), np.shape(ideal_px))

    def covariance_px2(self, scan_px: Array) -> Array:
        """(2n, 2n) joint covariance of the ideal pixels of scan pixels (n, 2), propagated from the lens's covariance,
        px²; 0 where the calibration gives none."""
        if not self.is_covariance_known:
            return np.zeros((scan_px.size, scan_px.size))
        scan_mm = comparator_from_pixel(scan_px, self.pitch_um)
        c, point = self.lens.interior[0], self.lens.interior[1:]
        ray = (self.lens.ideal_from_observed(scan_mm)[0] - point) / c
        at = self.lens.equations(scan_mm, ray)
        by_lens = c * np.linalg.solve(-at.ray_jacobian, np.dstack([at.interior_jacobian, at.parameter_jacobian]))
        by_lens[:, :, 0] += ray
        by_lens[:, :, 1:3] += np.eye(2)
        by_lens = (by_lens * np.array([1000.0, -1000.0])[:, None] / np.array(self.pitch_um)[:, None]).reshape(
            scan_px.size, -1
        )
        return np.asarray(by_lens @ self.lens.covariance @ by_lens.T)

    def crop(self, col: int, row: int) -> "CalibratedLens":
        """Lens for a part of the scan whose first pixel is (col, row)."""
        interior = self.lens.interior.copy()
        interior[1:] -= comparator_from_pixel(np.array([col, row], float), self.pitch_um)
        return replace(self, lens=replace(self.lens, interior=interior))

    def misfit(self, scan: Scan) -> str:
        """Message where a scan's size differs from that of the lens's images; else ""."""
        size = scan.width_px, scan.height_px
        if size == self.size_px:
            return ""
        width, height = self.size_px
        turned = " Rotate it back to the sensor's orientation." if size == (height, width) else ""
        return (
            f"{scan.path}: has {size[0]} x {size[1]} px, and the lens under [scanner] was calibrated for {width} x "
            f"{height} px: the principal point in this image is unknown.{turned or ' Give the image uncropped.'}"
        )

    def _px(self, mm: Array, shape: tuple[int, ...]) -> Array:
        return pixel_from_comparator(mm, self.pitch_um).reshape(shape)


def read_lens(path: Path, pitch_um: float) -> CalibratedLens:
    """Read the lens of camera.yaml, as `reseau calibrate` or OpenCV writes it, for scans of a pixel pitch. Raises
    InputError."""
    camera, _ = read_pixel_camera(path)
    if camera.size_px is None:
        raise InputError(f"{path}: does not say the picture's size. Give image_width and image_height in px.")
    (fx, fy, cx, cy), pitch_mm = camera.interior_px, pitch_um / 1000.0
    names = parameter_names(camera.family)
    given = {"b1": fx / fy - 1.0, **camera.distortion}
    interior = np.array([fy, cx, -cy]) * pitch_mm
    parameters = np.array([given.get(name, 0.0) for name in names])
    covariance = np.empty((0, 0))
    if camera.covariance is not None:
        by_px = np.zeros((len(interior) + len(names), len(camera.covariance)))
        by_px[0, 1] = by_px[1, 2] = pitch_mm
        by_px[2, 3] = -pitch_mm
        count = len(camera.covariance) - 4
        by_px[3 : 3 + count, 4:] = np.eye(count)
        by_px[3 + names.index("b1"), :2] = 1.0 / fy, -fx / fy**2
        covariance = by_px @ camera.covariance @ by_px.T
    lens = Lens(Distortion(camera.family), interior, parameters, covariance)
    width, height = (round(side) for side in camera.size_px)
    return CalibratedLens(lens, (pitch_um, pitch_um), (width, height))
