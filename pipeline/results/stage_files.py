"""Results of single stages. `check.json`: comparison of the adjustment with OpenCV's calibration, by camera a verdict,
its reason and a table. `choose.json`: the models compared, their tests, the chosen model and the reasons.
`compare.json`: comparison of calibrations of a camera with the first one, over the frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import numpy as np

from adjust.model_selection.model_choice import Candidate, Choice, Model
from adjust.quality.lens_comparison import Comparison, Test, sigmas
from pipeline.results.adjustment_record import Quantity
from pipeline.results.record_json import Finite, Number, Whole, read_record
from pipeline.types import Array

Verdict = Literal["agrees", "differs", "not possible"]


@dataclass(frozen=True)
class ComparedParameter:
    """Parameter of OpenCV's model from both programs. difference_sigmas: absolute difference in standard deviations of
    the adjustment."""

    name: str
    unit: str
    reseau: Quantity
    opencv: Quantity
    difference_sigmas: Number

    @classmethod
    def from_numbers(cls, name: str, unit: str, reseau: Quantity, opencv: Quantity) -> "ComparedParameter":
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
    rows: tuple[ComparedParameter, ...] = ()
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


def choice_content(choice: Choice, made_from: Mapping[str, str]) -> dict[str, object]:
    """Content of `choose.json`. given: the model in the project; made_from: fingerprints of the input."""
    return {
        "reseau": version("reseau"),
        "made_from": made_from,
        "chosen": _model(choice.chosen.model) if choice.chosen else None,
        "given": _model(choice.given),
        "verdict": choice.verdict,
        "reasons": choice.reasons,
        "candidates": [_candidate(each) for each in choice.candidates],
        "tests": [
            {"simpler": t.simpler.name, "richer": t.richer.name, "F": t.f, "degrees": t.degrees, "p": t.p}
            for t in choice.tests
        ],
    }


def _model(model: Model) -> dict[str, object]:
    return {**vars(model), "bends": dict(model.bends)}


def _candidate(candidate: Candidate) -> dict[str, object]:
    """Adjusted model; without statistics where it has no solution."""
    content = {"name": candidate.model.name, **_model(candidate.model), "problem": candidate.problem}
    if candidate.problem:
        return content | {"cross_validation": None}
    names = ("observations", "unknowns", "redundancy", "vpv", "sigma0", "aic", "aicc", "cross_validation")
    correlated = [{"parameters": (a, b), "correlation": rho} for a, b, rho in candidate.correlated]
    own = {name: getattr(candidate, name) for name in names}
    return content | own | {"correlated": correlated, "warnings": candidate.warnings}


DRIFT, NO_DRIFT = "drift", "no drift"


@dataclass(frozen=True)
class ParameterDifference:
    """Difference of a parameter between two calibrations.

    first, other, difference: values and other minus first, mm or powers of mm; sigma: standard deviation of the
    difference; sigmas: difference / sigma, NaN if both are fixed.
    """

    name: str
    first: float
    other: float
    difference: float
    sigma: float
    sigmas: float


@dataclass(frozen=True)
class CalibrationDifference:
    """Differences of a calibration from the first one: parameters, image displacements at places_mm with their standard
    deviations, and fiducial marks by name after a similarity."""

    parameters: Sequence[ParameterDifference]
    field_um: Array
    field_sigma_um: Array
    fiducials: Mapping[str, Mapping[str, Array]]


@dataclass(frozen=True)
class ComparisonRecord:
    """Content of `compare.json`; see `Comparison`.

    Attributes
    ----------
    verdict, probability, level : drift if probability, a p-value, is below the significance level.
    calibrations : name, time in the user's unit or number of the calibration, and distortion family.
    places_mm : places of the displacements in `CalibrationDifference` and of the trend.
    trend_um, trend_sigma_um : linear change from the first time to the last, by place; None without a trend.
    """

    verdict: str
    probability: float
    level: float
    use: str
    same: Test
    trend: Test | None
    calibrations: Sequence[Mapping[str, object]]
    places_mm: Array
    differences: Sequence[CalibrationDifference]
    trend_um: Array | None
    trend_sigma_um: Array | None
    remarks: Sequence[str]


def comparison_record(comparison: Comparison, remarks: Sequence[str], level: float) -> ComparisonRecord:
    """Convert a comparison to its record. level: significance level of the test for drift."""
    trend = comparison.trend
    return ComparisonRecord(
        verdict=DRIFT if comparison.probability < level else NO_DRIFT,
        probability=comparison.probability,
        level=level,
        use=comparison.use,
        same=comparison.same,
        trend=trend,
        calibrations=[
            {"name": each.name, "time": time, "family": each.lens.distortion.family}
            for each, time in zip(comparison.calibrations, comparison.times.tolist(), strict=True)
        ],
        places_mm=comparison.places_mm,
        differences=[_difference(comparison, k) for k in range(len(comparison.calibrations) - 1)],
        trend_um=comparison.trend_um if trend else None,
        trend_sigma_um=sigmas(comparison.trend_covariance_um2) if trend else None,
        remarks=remarks,
    )


def _difference(comparison: Comparison, number: int) -> CalibrationDifference:
    """Differences of a calibration, those of the parameters that it shares with the first one."""
    first, other = comparison.calibrations[0], comparison.calibrations[number + 1]
    alike = first.lens.distortion.family == other.lens.distortion.family
    values = [each.lens.values for each in (first, other)]
    deviations = [np.sqrt(np.diag(each.covariance)) for each in (first, other)]
    rows = []
    for k, name in enumerate(first.lens.quantities if alike else first.lens.quantities[:3]):
        joint = float(np.hypot(deviations[0][k], deviations[1][k]))
        before, after = float(values[0][k]), float(values[1][k])
        size = (after - before) / joint if joint > 0 else np.nan
        rows.append(ParameterDifference(name, before, after, after - before, joint, size))
    marks_sigma_um = sigmas(comparison.fiducials_covariance_um2[number])
    marks = zip(comparison.fiducials, comparison.fiducials_um[number], marks_sigma_um, strict=True)
    return CalibrationDifference(
        parameters=rows,
        field_um=comparison.field_um[number],
        field_sigma_um=sigmas(comparison.field_covariance_um2[number]),
        fiducials={id: {"um": um, "sigma_um": sigma_um} for id, um, sigma_um in marks},
    )
