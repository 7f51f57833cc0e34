"""Calibrations of one camera compared: false alarms and power by simulation, and what a user of a camera cannot see."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Lens
from adjust.quality.lens_comparison import CameraCalibration, compare, sigmas

Array = NDArray[np.float64]

HALF = (110.0, 110.0)
MARKS = {
    str(i): np.array(xy) for i, xy in enumerate([(-106.0, -106.0), (106.0, -106.0), (106.0, 106.0), (-106.0, 106.0)])
}
TRUE = np.array([153.0, 0.010, -0.006, -6e-8, 1e-12, 2e-7, -1e-7])  # c, x0, y0, k3, k5, p1, p2
SIGMAS = np.array([0.004, 0.003, 0.003, 8e-9, 4e-13, 6e-8, 6e-8])


def covariance() -> Array:
    """Of c, principal point, k3, k5, k7, p1..p4 and the marks: k3 and k5, x0 and p1 as closely tied as in practice."""
    mixing = np.eye(7)
    mixing[3, 4] = mixing[4, 3] = -0.9
    mixing[1, 5] = mixing[5, 1] = 0.6
    seven = mixing * np.outer(SIGMAS, SIGMAS)
    whole = np.zeros((18, 18))
    at = np.ix_(AT, AT)
    whole[at] = seven
    whole[10:, 10:] = 0.002**2 * np.eye(8)
    return whole


AT = np.array([0, 1, 2, 3, 4, 6, 7])  # in c, x0, y0, k3, k5, k7, p1, p2, p3, p4


def calibration(values: Array, marks: dict[str, Array] | None = None) -> CameraCalibration:
    whole = np.zeros(10)
    whole[AT] = values
    return CameraCalibration(
        "K", Lens(Distortion("torlegard"), whole[:3], whole[3:]), dict(marks or MARKS), covariance(), redundancy=5000
    )


def draw_calibration(rng: np.random.Generator, change: Array | float = 0.0) -> CameraCalibration:
    error = rng.multivariate_normal(np.zeros(18), covariance())
    marks = {id: xy + error[10 + 2 * i : 12 + 2 * i] for i, (id, xy) in enumerate(MARKS.items())}
    return calibration(TRUE + change + error[AT], marks)


def test_false_alarms_come_as_often_as_stated() -> None:
    rng = np.random.default_rng(1)
    probabilities = np.array(
        [compare([draw_calibration(rng), draw_calibration(rng)], HALF).same.probability for _ in range(160)]
    )
    for level in (0.05, 0.5):
        expected = 160 * level
        assert abs(int((probabilities < level).sum()) - expected) < 3.5 * np.sqrt(expected * (1 - level))


@pytest.mark.study
def test_a_trend_is_tested_at_its_level_and_found() -> None:
    rng = np.random.default_rng(2)
    years, drift = np.array([1952.0, 1955.0, 1961.0, 1970.0]), np.zeros(7)
    series = [compare([draw_calibration(rng) for _ in years], HALF, years) for _ in range(100)]
    for alarms in (
        sum(each.trend is not None and each.trend.probability < 0.05 for each in series),
        sum(each.probability < 0.05 for each in series),
    ):
        assert abs(alarms - 5) < 3.5 * np.sqrt(5 * 0.95)
    assert sum(each.probability < 0.8 for each in series) < 80  # the lesser of both tests at its own level: 89
    corners = [0, 6, 42, 48]
    roots = np.linalg.cholesky(series[0].trend_covariance_um2[corners])
    standardised = np.linalg.solve(roots, np.array([each.trend_um[corners] for each in series])[..., None])
    assert np.sqrt(np.mean(standardised**2)) == pytest.approx(1.0, abs=0.15)
    drift[3] = 4e-9  # k3 a year
    moving = compare([draw_calibration(rng, drift * (year - years[0])) for year in years], HALF, years)
    assert moving.trend is not None
    assert moving.trend.freedom == moving.same.freedom / 3
    assert moving.probability < 1e-3
    still = compare([calibration(TRUE + drift * (year - years[0])) for year in years], HALF, years)
    ends = compare([calibration(TRUE), calibration(TRUE + drift * 18.0)], HALF)
    assert still.trend_um == pytest.approx(ends.field_um[0], abs=0.05)


@pytest.mark.study
def test_the_sigmas_of_the_field_hold() -> None:
    rng = np.random.default_rng(3)
    compared = [compare([draw_calibration(rng), draw_calibration(rng)], HALF) for _ in range(200)]
    claimed = sigmas(compared[0].field_covariance_um2[0])
    realised = np.std([each.field_um[0] for each in compared], axis=0)
    view = claimed > 0.1
    assert view.sum() > 60
    assert np.median(realised[view] / claimed[view]) == pytest.approx(1.0, abs=0.06)
    of_marks = np.std([each.fiducials_um[0] for each in compared], axis=0)
    assert np.median(of_marks / sigmas(compared[0].fiducials_covariance_um2[0])) == pytest.approx(1.0, abs=0.08)


@parametrize_with_studies(("sigmas", "least"), [(3.0, 0.1), (8.0, 0.9)], quick=(1,))
def test_a_change_is_found_the_oftener_the_larger_it_is(sigmas: float, least: float) -> None:
    rng = np.random.default_rng(4)
    change = np.zeros(7)
    change[4] = sigmas * np.sqrt(2 * (1 - 0.81)) * SIGMAS[4]  # of k5, of which k3 can take up most
    found = [
        compare([draw_calibration(rng), draw_calibration(rng, change)], HALF).same.probability < 0.05 for _ in range(60)
    ]
    assert np.mean(found) >= least


def test_another_fiducial_frame_is_no_change() -> None:
    """Turned by 0.3 degrees, a permille larger, shifted by half a millimetre: all of it shows in no photograph."""
    size, turn, shift = 1.001, np.radians(0.3), np.array([0.5, -0.4])
    matrix = size * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    c, x0, y0, k3, k5, p1, p2 = TRUE
    point = matrix @ [x0, y0] + shift
    p = matrix @ [p1, p2] / size**2
    values = np.array([size * c, *point, k3 / size**2, k5 / size**4, *p])
    moved = calibration(values, {id: matrix @ xy + shift for id, xy in MARKS.items()})
    compared = compare([calibration(TRUE), moved], HALF)
    assert np.abs(compared.field_um).max() < 0.02
    assert np.abs(compared.fiducials_um).max() < 1e-6
    assert compared.same.probability > 0.999


def test_over_flat_ground_another_principal_distance_is_another_height() -> None:
    change = np.array([0.05, 0.04, 0.0, 0.0, 0.0, 0.0, 0.0])
    pair = [calibration(TRUE), calibration(TRUE + change)]
    assert compare(pair, HALF).same.probability < 1e-6
    assert np.abs(compare(pair, HALF, use="flat").field_um).max() < 1.0  # what the lens shifts with its point
    assert np.abs(compare(pair, HALF).field_um).max() > 3.0


def test_families_that_mean_the_same_agree() -> None:
    brown = replace(
        calibration(TRUE),
        lens=Lens(Distortion("brown"), TRUE[:3], np.array([TRUE[3], TRUE[4], 0.0, TRUE[5], TRUE[6], 0.0, 0.0])),
        covariance=np.zeros((18, 18)),
    )
    compared = compare([calibration(TRUE), brown], HALF)
    assert np.abs(compared.field_um).max() < 1e-6


@pytest.mark.parametrize(
    ("count", "times", "words"), [(1, None, "two calibrations or more"), (2, (1960.0, 1950.0), "in rising order")]
)
def test_what_cannot_be_compared_is_refused(count: int, times: tuple[float, ...] | None, words: str) -> None:
    with pytest.raises(AdjustmentError, match=words):
        compare([calibration(TRUE)] * count, HALF, times)
