"""`compare.json`: calibrations of a camera compared with the first of them, over the frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adjust.quality.lens_comparison import CameraCalibration, Comparison, Test, sigmas
from pipeline.results.record_json import read_record
from pipeline.types import Array

Pair = tuple[float, float]

DRIFT, NO_DRIFT = "drift", "no drift"


@dataclass(frozen=True)
class ChiSquareTest:
    """probability: of as much by chance."""

    chi_square: float
    freedom: int
    probability: float

    @classmethod
    def from_test(cls, test: Test) -> "ChiSquareTest":
        return cls(test.chi_square, test.freedom, test.probability)


@dataclass(frozen=True)
class ComparedCalibration:
    """time: in the user's unit, or the number of the calibration."""

    name: str
    time: float
    family: str


@dataclass(frozen=True)
class ParameterDifference:
    """A parameter of two calibrations: values, difference and its standard deviation, in mm and powers of it; sigmas:
    the difference in these, NaN where both are fixed."""

    name: str
    first: float
    other: float
    difference: float
    sigma: float
    sigmas: float


@dataclass(frozen=True)
class MarkDifference:
    """How far a fiducial mark stands off that of the first calibration, after a similarity."""

    um: Pair
    sigma_um: Pair


@dataclass(frozen=True)
class CalibrationDifference:
    """A calibration less the first one: its parameters, the field at the places, its fiducial marks."""

    parameters: tuple[ParameterDifference, ...]
    field_um: tuple[Pair, ...]
    field_sigma_um: tuple[Pair, ...]
    fiducials: Mapping[str, MarkDifference]


@dataclass(frozen=True)
class ComparisonRecord:
    """The comparison as it is kept. level: the probability below which there is drift; same, trend: whether all
    calibrations are one, and whether there is no steady change; places_mm: of the field."""

    verdict: str
    probability: float
    level: float
    use: str
    same: ChiSquareTest
    trend: ChiSquareTest | None
    calibrations: tuple[ComparedCalibration, ...]
    places_mm: tuple[Pair, ...]
    differences: tuple[CalibrationDifference, ...]
    trend_um: tuple[Pair, ...] | None
    trend_sigma_um: tuple[Pair, ...] | None
    remarks: tuple[str, ...]


def comparison_record(comparison: Comparison, remarks: Sequence[str], level: float) -> ComparisonRecord:
    """The record of a comparison: drift where calibrations that are the same would differ as much in fewer than
    `level` of all cases."""
    trend = comparison.trend
    return ComparisonRecord(
        verdict=DRIFT if comparison.probability < level else NO_DRIFT,
        probability=comparison.probability,
        level=level,
        use=comparison.use,
        same=ChiSquareTest.from_test(comparison.same),
        trend=ChiSquareTest.from_test(trend) if trend else None,
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
    """Read `compare.json`. Raises FileNotFoundError, and InputError for what is no such file."""
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
    """Of the parameters that both have."""
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
