"""`check.json`: comparison of the adjustment with OpenCV's calibration, by camera a verdict, its reason and a table."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pipeline.results.record_json import Finite, Number, Sigma, Whole, read_record

Verdict = Literal["agrees", "differs", "not possible"]


@dataclass(frozen=True)
class Estimate:
    """Value with its a-posteriori standard deviation."""

    value: Number
    sigma: Sigma


@dataclass(frozen=True)
class Row:
    """Parameter of OpenCV's model from both programs. difference_sigmas: absolute difference in standard deviations of
    the adjustment."""

    name: str
    unit: str
    reseau: Estimate
    opencv: Estimate
    difference_sigmas: Number

    @classmethod
    def from_numbers(cls, name: str, unit: str, reseau: Estimate, opencv: Estimate) -> "Row":
        apart = abs(reseau.value - opencv.value)
        return cls(name, unit, reseau, opencv, apart / reseau.sigma if reseau.sigma > 0 else 0.0)


@dataclass(frozen=True)
class PixelCalibration:
    """Camera matrix and RMS per point of OpenCV's calibration, in pixels; origin at the centre of the first pixel, y
    down."""

    fx: Finite
    fy: Finite
    cx: Finite
    cy: Finite
    rms: Finite


@dataclass(frozen=True)
class CornersCheck:
    """OpenCV's calibration from board corners measured by reseau and by OpenCV, with the images and points that both
    found. detector: OpenCV's functions; not_found: images in which these found no board."""

    detector: str
    images: Whole
    points: Whole
    not_found: tuple[str, ...]
    reseau: PixelCalibration
    opencv: PixelCalibration


@dataclass(frozen=True)
class CameraCheck:
    """Comparison of one camera.

    Attributes
    ----------
    rms_opencv_um, rms_reseau_um : RMS residual per point, not per axis.
    refit_residual_um : RMS over the image of the residual of the refit.
    corners_px : check of the board corners of a digital camera; None if its images are not available.
    """

    verdict: Verdict
    reason: str
    images: Whole = 0
    points: Whole = 0
    rms_opencv_um: Number = float("nan")
    rms_reseau_um: Number = float("nan")
    refit_residual_um: Number = float("nan")
    rows: tuple[Row, ...] = ()
    corners_px: CornersCheck | None = field(default_factory=lambda: None)  # null in the file where there is none


@dataclass(frozen=True, kw_only=True)
class Check:
    """Comparison of all cameras with the overall verdict. made_from: fingerprint of the adjustment."""

    reseau: str = ""
    made_from: Mapping[str, str] = field(default_factory=dict)
    verdict: Verdict
    reason: str
    cameras: Mapping[str, CameraCheck]

    @classmethod
    def from_cameras(cls, cameras: Mapping[str, CameraCheck]) -> "Check":
        verdicts = {check.verdict for check in cameras.values()}
        verdict: Verdict = "agrees" if verdicts == {"agrees"} else "not possible"
        verdict = "differs" if "differs" in verdicts else verdict
        decisive = {name: check.reason for name, check in cameras.items() if check.verdict == verdict}
        reasons = decisive.values() if len(cameras) == 1 else (f"Camera {n}: {each}" for n, each in decisive.items())
        return cls(verdict=verdict, reason=" ".join(reasons), cameras=cameras)


def read_check(path: Path) -> Check:
    """Read `check.json`. Raises FileNotFoundError, and InputError for invalid content."""
    return read_record(Check, path, "Run `reseau check` again; it writes this file.")
