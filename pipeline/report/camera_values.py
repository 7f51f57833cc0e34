"""Calibration values of a camera to cite: in mm for a film camera, in px for a digital camera."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from adjust.functional_model.families import family as family_of
from adjust.problem.parameter import Parameter
from pipeline.report.data import ReportData
from pipeline.results.adjustment_record import CameraRecord, Quantity
from pipeline.results.covariance_file import Covariance
from pipeline.results.image_unit import ImageUnit
from pipeline.results.pixel_intrinsics import pixel_intrinsics
from pipeline.types import Array

INTERIOR_MEANING = {
    "c": "principal distance",
    "x0": "principal point",
    "y0": "principal point",
    "fx": "focal length, columns",
    "fy": "focal length, rows",
    "cx": "principal point, column",
    "cy": "principal point, row",
}
SYMBOLS = {"x0": "x₀′", "y0": "y₀′"}
LARGER = 1.5  # ratio of standard deviations that a dozen images rarely exceed by chance


@dataclass(frozen=True)
class CameraValue:
    """Calibration value. name: as in adjustment.json or OpenCV; sigma: standard deviation to use, 0 if fixed."""

    name: str
    value: float
    sigma: float
    unit: str

    @property
    def symbol(self) -> str:
        return SYMBOLS.get(self.name, self.name)

    @property
    def meaning(self) -> str:
        """Name in words; "" for distortion parameters."""
        return INTERIOR_MEANING.get(self.name, "")

    @property
    def is_focal(self) -> bool:
        return self.name in ("c", "fx", "fy")


def camera_values(data: ReportData, name: str) -> list[CameraValue]:
    """Interior orientation and distortion of a calibrated camera, without distortion parameters fixed at 0.

    The standard deviation is the larger of that of the adjustment and that by leaving out images, if computed.
    """
    assert data.adjustment is not None
    camera, unit = data.adjustment.cameras[name], data.unit_of_camera(name)
    known = {key: each for key, each in camera.interior.items() if each.value != 0.0 or each.sigma != 0.0}
    known = {key: camera.interior[key] for key in ("c", "x0", "y0")} | known
    keys = [Parameter.interior(name, key) for key in known]
    sigmas = np.array([each.sigma for each in known.values()])
    model = np.diag(sigmas**2) if data.covariance is None else data.covariance.select(keys)
    values, by_mm = _stated(camera, known, unit)
    sigma = _sigmas(by_mm, model) if np.isfinite(sigmas).all() else np.abs(by_mm) @ sigmas
    if data.covariance is not None and data.covariance.clusters is not None:
        sigma = np.maximum(sigma, _sigmas(by_mm, data.covariance.clusters.select(keys)))
    return list(map(CameraValue, values, values.values(), sigma.tolist(), _units(camera, values, unit)))


def _stated(camera: CameraRecord, known: Mapping[str, Quantity], unit: ImageUnit) -> tuple[dict[str, float], Array]:
    """Values by name in this unit, and their derivatives with respect to the values in mm."""
    mm = {key: each.value for key, each in known.items()}
    if unit.is_pixel and family_of(camera.distortion.family).y_down:
        return pixel_intrinsics(mm, 1.0 / unit.per_mm)
    scale = np.array([unit.per_mm if key in ("c", "x0", "y0") else 1.0 for key in mm])
    return dict(zip(mm, (scale * list(mm.values())).tolist(), strict=True)), np.diag(scale)


def _units(camera: CameraRecord, values: Mapping[str, float], unit: ImageUnit) -> Iterator[str]:
    family = family_of(camera.distortion.family)
    for name in values:
        yield unit.long_name if name in INTERIOR_MEANING else family.unit(name)


def _sigmas(by_mm: Array, covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diagonal(by_mm @ covariance @ by_mm.T), 0.0)))


def cluster_ratio(name: str, camera: CameraRecord, covariance: Covariance | None) -> float:
    """Largest ratio of the standard deviations by leaving out images to those of the adjustment; 0 if unknown."""
    keys = [key for key, each in camera.interior.items() if each.sigma > 0.0]
    if covariance is None or covariance.clusters is None or not keys:
        return 0.0
    scatter = np.diagonal(covariance.clusters.select(Parameter.interior(name, key) for key in keys))
    return float((np.sqrt(scatter) / [camera.interior[key].sigma for key in keys]).max())
