"""Results of single stages. `check.json`: comparison of the adjustment with OpenCV's calibration, by camera a verdict,
its reason and a table. `choose.json`: the models compared, their tests, the chosen model and the reasons.
`compare.json`: comparison of calibrations of a camera with the first one, over the frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from adjust.model_selection.candidates import Candidate, CrossValidation, Model
from adjust.model_selection.model_choice import Choice
from adjust.quality.lens_comparison import CameraCalibration, Comparison, Test, sigmas
from pipeline.results.record_json import FOREIGN, Finite, Number, NumberOrNone, Sigma, Whole, read_record, record_from
from pipeline.types import Array

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


@dataclass(frozen=True)
class ModelRecord:
    """Film transformation, distortion family with its estimated parameters, and terms of scanner errors by scanner."""

    transformation: str
    family: str
    parameters: tuple[str, ...]
    bends: Mapping[str, tuple[str, ...]]

    @classmethod
    def from_model(cls, model: Model) -> "ModelRecord":
        return record_from(cls, model, bends=dict(model.bends))


@dataclass(frozen=True)
class ParameterCorrelation:
    """Two highly correlated parameters."""

    parameters: tuple[str, str]
    correlation: Number


@dataclass(frozen=True, kw_only=True)
class CandidateRecord:
    """Adjusted model. problem: why it has no solution; the statistics are then None."""

    name: str
    transformation: str
    family: str
    parameters: tuple[str, ...]
    bends: Mapping[str, tuple[str, ...]]
    problem: str = ""
    observations: Whole | None = None
    unknowns: Whole | None = None
    redundancy: Whole | None = None
    vpv: NumberOrNone = None
    sigma0: NumberOrNone = None
    aic: NumberOrNone = None
    aicc: NumberOrNone = None
    cross_validation: Annotated[CrossValidation, FOREIGN] | None = field(default_factory=lambda: None)
    correlated: tuple[ParameterCorrelation, ...] | None = None
    warnings: tuple[str, ...] | None = None

    @classmethod
    def from_candidate(cls, candidate: Candidate) -> "CandidateRecord":
        model = {"name": candidate.model.name, **vars(ModelRecord.from_model(candidate.model))}
        if candidate.problem:
            return cls(**model, problem=candidate.problem)
        correlated = tuple(ParameterCorrelation((a, b), rho) for a, b, rho in candidate.correlated)
        return record_from(cls, candidate, **model, correlated=correlated)


@dataclass(frozen=True)
class ModelTest:
    """F-test of a model against one with more parameters. degrees: of freedom, numerator and denominator."""

    simpler: str
    richer: str
    F: Number
    degrees: tuple[Whole, Whole]
    p: Number


@dataclass(frozen=True, kw_only=True)
class ChoiceRecord:
    """Model choice as stored. given: the model in the project; made_from: fingerprints of the input."""

    reseau: str = ""
    made_from: Mapping[str, str] = field(default_factory=dict)
    chosen: ModelRecord | None
    given: ModelRecord
    verdict: str
    reasons: tuple[str, ...]
    candidates: tuple[CandidateRecord, ...]
    tests: tuple[ModelTest, ...]


def choice_record(choice: Choice, made_from: Mapping[str, str]) -> ChoiceRecord:
    """Convert a choice to its record."""
    return ChoiceRecord(
        reseau=version("reseau"),
        made_from=made_from,
        chosen=ModelRecord.from_model(choice.chosen.model) if choice.chosen else None,
        given=ModelRecord.from_model(choice.given),
        verdict=choice.verdict,
        reasons=choice.reasons,
        candidates=tuple(map(CandidateRecord.from_candidate, choice.candidates)),
        tests=tuple(ModelTest(t.simpler.name, t.richer.name, t.f, t.degrees, t.p) for t in choice.tests),
    )


def read_choice(path: Path) -> ChoiceRecord:
    """Read `choose.json`. Raises FileNotFoundError, and InputError for invalid content."""
    return read_record(ChoiceRecord, path, "Run `reseau choose` again; it writes this file.")


Pair = tuple[Number, Number]

DRIFT, NO_DRIFT = "drift", "no drift"


@dataclass(frozen=True)
class ComparedCalibration:
    """Calibration in a comparison. time: in the user's unit, or the number of the calibration."""

    name: str
    time: Number
    family: str


@dataclass(frozen=True)
class ParameterDifference:
    """Difference of a parameter between two calibrations.

    first, other, difference: values and other minus first, mm or powers of mm; sigma: standard deviation of the
    difference; sigmas: difference / sigma, NaN if both are fixed.
    """

    name: str
    first: Number
    other: Number
    difference: Number
    sigma: Number
    sigmas: Number


@dataclass(frozen=True)
class MarkDifference:
    """Difference of a fiducial mark from the first calibration after a similarity, and its standard deviation."""

    um: Pair
    sigma_um: Pair


@dataclass(frozen=True)
class CalibrationDifference:
    """Differences of a calibration from the first one: parameters, image displacements at places_mm with their standard
    deviations, and fiducial marks by name."""

    parameters: tuple[ParameterDifference, ...]
    field_um: tuple[Pair, ...]
    field_sigma_um: tuple[Pair, ...]
    fiducials: Mapping[str, MarkDifference]


@dataclass(frozen=True)
class ComparisonRecord:
    """Comparison as stored; see `Comparison`.

    Attributes
    ----------
    verdict, probability, level : drift if probability, a p-value, is below the significance level.
    same : test of the hypothesis that all calibrations are equal.
    trend : test of a linear change with time; None for two calibrations.
    places_mm : places of the displacements in `CalibrationDifference` and of the trend.
    trend_um, trend_sigma_um : linear change from the first time to the last, by place; None without a trend.
    """

    verdict: str
    probability: Number
    level: Number
    use: str
    same: Annotated[Test, FOREIGN]
    trend: Annotated[Test, FOREIGN] | None
    calibrations: tuple[ComparedCalibration, ...]
    places_mm: tuple[Pair, ...]
    differences: tuple[CalibrationDifference, ...]
    trend_um: tuple[Pair, ...] | None
    trend_sigma_um: tuple[Pair, ...] | None
    remarks: tuple[str, ...]


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
        calibrations=tuple(
            ComparedCalibration(each.name, time, each.lens.distortion.family)
            for each, time in zip(comparison.calibrations, comparison.times.tolist(), strict=True)
        ),
        places_mm=_pairs(comparison.places_mm),
        differences=tuple(_difference(comparison, k) for k in range(len(comparison.calibrations) - 1)),
        trend_um=_pairs(comparison.trend_um) if trend else None,
        trend_sigma_um=_pairs(sigmas(comparison.trend_covariance_um2)) if trend else None,
        remarks=tuple(remarks),
    )


def read_comparison(path: Path) -> ComparisonRecord:
    """Read `compare.json`. Raises FileNotFoundError, and InputError for invalid content."""
    return read_record(ComparisonRecord, path, "Run `reseau compare` again; it writes this file.")


def _difference(comparison: Comparison, number: int) -> CalibrationDifference:
    first, *others = comparison.calibrations
    marks = zip(
        _pairs(comparison.fiducials_um[number]),
        _pairs(sigmas(comparison.fiducials_covariance_um2[number])),
        strict=True,
    )
    return CalibrationDifference(
        parameters=tuple(_parameter_differences(first, others[number])),
        field_um=_pairs(comparison.field_um[number]),
        field_sigma_um=_pairs(sigmas(comparison.field_covariance_um2[number])),
        fiducials={id: MarkDifference(*each) for id, each in zip(comparison.fiducials, marks, strict=True)},
    )


def _parameter_differences(first: CameraCalibration, other: CameraCalibration) -> list[ParameterDifference]:
    """Differences of the parameters that both calibrations have."""
    alike = first.lens.distortion.family == other.lens.distortion.family
    values = [each.lens.values for each in (first, other)]
    deviations = [np.sqrt(np.diag(each.covariance)) for each in (first, other)]
    rows = []
    for k, name in enumerate(first.lens.quantities if alike else first.lens.quantities[:3]):
        joint = float(np.hypot(deviations[0][k], deviations[1][k]))
        before, after = float(values[0][k]), float(values[1][k])
        size = (after - before) / joint if joint > 0 else np.nan
        rows.append(ParameterDifference(name, before, after, after - before, joint, size))
    return rows


def _pairs(values: Array) -> tuple[Pair, ...]:
    return tuple((x, y) for x, y in np.reshape(values, (-1, 2)).tolist())
