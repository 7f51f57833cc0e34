"""`check.json`, the adjustment against OpenCV's calibration: per camera a verdict, its reason and a table."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pipeline.results.record_json import Finite, read_record

Verdict = Literal["agrees", "differs", "not possible"]


@dataclass(frozen=True)
class Estimate:
    """A value with its a-posteriori standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Row:
    """One parameter of OpenCV's model by both programs; difference_sigmas: in those of the adjustment."""

    name: str
    unit: str
    reseau: Estimate
    opencv: Estimate
    difference_sigmas: float

    @classmethod
    def from_numbers(cls, name: str, unit: str, reseau: Estimate, opencv: Estimate) -> "Row":
        apart = abs(reseau.value - opencv.value)
        return cls(name, unit, reseau, opencv, apart / reseau.sigma if reseau.sigma > 0 else 0.0)


@dataclass(frozen=True)
class PixelCalibration:
    """Camera matrix and rms a point of OpenCV's calibration, in pixels from the centre of the first one, y down."""

    fx: Finite
    fy: Finite
    cx: Finite
    cy: Finite
    rms: Finite


@dataclass(frozen=True)
class CornersCheck:
    """OpenCV's calibration of a board's points as measured here (reseau) and as OpenCV itself finds them (opencv), in
    the images and points that both have; detector: OpenCV's functions; not_found: images where these find no board."""

    detector: str
    images: int
    points: int
    not_found: tuple[str, ...]
    reseau: PixelCalibration
    opencv: PixelCalibration


@dataclass(frozen=True)
class CameraCheck:
    """The comparison of one camera. rms in um a point (not an axis); the refit's residual in um, rms over the image;
    corners_px: of a digital camera's board, where its pictures are at hand."""

    verdict: Verdict
    reason: str
    images: int = 0
    points: int = 0
    rms_opencv_um: float = float("nan")
    rms_reseau_um: float = float("nan")
    refit_residual_um: float = float("nan")
    rows: tuple[Row, ...] = ()
    corners_px: CornersCheck | None = field(default_factory=lambda: None)  # null in the file where there is none


@dataclass(frozen=True, kw_only=True)
class Check:
    """The comparison of every camera, and the verdict on the whole; made_from: the adjustment's fingerprint."""

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
    """Read `check.json`. Raises FileNotFoundError, and InputError for what is no such file."""
    return read_record(Check, path, "Run `reseau check` again; it writes this file.")
