"""What the check against OpenCV hands on: per camera a verdict, its reason and a table; written as check.json."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.results.json_form import NUMBER, Each, check_form
from pipeline.text.text_file import read_json

Verdict = Literal["agrees", "differs", "not possible"]


@dataclass(frozen=True)
class Row:
    """One parameter of OpenCV's model by both programs: values and a-posteriori standard deviations."""

    name: str
    unit: str
    value: float
    sigma: float
    opencv_value: float
    opencv_sigma: float

    @property
    def difference_sigmas(self) -> float:
        return abs(self.value - self.opencv_value) / self.sigma if self.sigma > 0 else 0.0

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "unit": self.unit,
            "reseau": {"value": self.value, "sigma": self.sigma},
            "opencv": {"value": self.opencv_value, "sigma": self.opencv_sigma},
            "difference_sigmas": self.difference_sigmas,
        }


@dataclass(frozen=True)
class PixelCalibration:
    """Camera matrix and rms a point of OpenCV's calibration, in pixels from the centre of the first one, y down."""

    fx: float
    fy: float
    cx: float
    cy: float
    rms: float


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
    rms_opencv_um: float | None = None
    rms_reseau_um: float | None = None
    refit_residual_um: float | None = None
    rows: tuple[Row, ...] = ()
    corners_px: CornersCheck | None = None

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "rows": [row.to_json() for row in self.rows]}


@dataclass(frozen=True)
class Check:
    """The comparison of every camera, and the verdict on the whole."""

    cameras: Mapping[str, CameraCheck] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        verdicts = {check.verdict for check in self.cameras.values()}
        if "differs" in verdicts:
            return "differs"
        return "agrees" if verdicts == {"agrees"} else "not possible"

    @property
    def reason(self) -> str:
        decisive = {name: check for name, check in self.cameras.items() if check.verdict == self.verdict}
        if len(self.cameras) == 1:
            return next(iter(decisive.values())).reason
        return " ".join(f"Camera {name}: {check.reason}" for name, check in decisive.items())

    def to_json(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "cameras": {name: check.to_json() for name, check in self.cameras.items()},
        }


def read_check(path: Path) -> dict[str, Any]:
    """The contents of `check.json`. Raises FileNotFoundError, and InputError for what is no such file."""
    content: dict[str, Any] = read_json(path)
    check_form(content, _CHECK, path, _AGAIN)
    absent = CameraCheck("not possible", "").to_json()  # in files of earlier versions
    cameras = {name: absent | camera for name, camera in content["cameras"].items()}
    for name, camera in cameras.items():
        place = f"cameras[{name!r}]"
        check_form(camera, _CAMERA, path, _AGAIN, place)
        if camera["corners_px"] is not None:
            check_form(camera["corners_px"], _CORNERS, path, _AGAIN, f"{place}.corners_px")
    return {**content, "cameras": cameras}


_AGAIN = "Run `reseau check` again; it writes this file."
_ESTIMATE = {"value": NUMBER, "sigma": NUMBER}
_ROW = {"name": str, "unit": str, "reseau": _ESTIMATE, "opencv": _ESTIMATE, "difference_sigmas": NUMBER}
_CAMERA = {
    **dict.fromkeys(("images", "points", "rms_opencv_um", "rms_reseau_um", "refit_residual_um"), NUMBER),
    "rows": Each(list, _ROW),
}
_PIXELS = dict.fromkeys(("fx", "fy", "cx", "cy", "rms"), (float, int))
_CORNERS = {
    "detector": str,
    "images": int,
    "points": int,
    "not_found": Each(list, str),
    "reseau": _PIXELS,
    "opencv": _PIXELS,
}
_CHECK = {"verdict": str, "reason": str, "cameras": Each(dict, {"verdict": str, "reason": str})}
