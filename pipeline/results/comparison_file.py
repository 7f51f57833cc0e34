"""`compare.json`: comparison of calibrations of a camera with the first one, over the frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from adjust.quality.lens_comparison import CameraCalibration, Comparison, Test, sigmas
from pipeline.results.record_json import FOREIGN, Number, read_record
from pipeline.types import Array

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
        parameters=tuple(_parameters(first, others[number])),
        field_um=_pairs(comparison.field_um[number]),
        field_sigma_um=_pairs(sigmas(comparison.field_covariance_um2[number])),
        fiducials={id: MarkDifference(*each) for id, each in zip(comparison.fiducials, marks, strict=True)},
    )


def _parameters(first: CameraCalibration, other: CameraCalibration) -> list[ParameterDifference]:
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
