"""Calibrations compared, and earlier calibrations as observations."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from networks import field_points, join_networks, map_priors, rename_network, set_observations, simulated
from numpy.typing import NDArray

from adjust import Adjustment, AdjustmentError, Calibration, Parameter, adjust
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.problem.network import Approximations, Network, Transformation
from adjust.quality.lens_comparison import CameraCalibration, compare
from adjust.quality.significance import CalibrationTest

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


def test_a_trend_is_found() -> None:
    rng = np.random.default_rng(2)
    years, drift = np.array([1952.0, 1955.0, 1961.0, 1970.0]), np.zeros(7)
    drift[3] = 4e-9  # k3 a year
    moving = compare([draw_calibration(rng, drift * (year - years[0])) for year in years], HALF, years)
    assert moving.trend is not None
    assert moving.trend.freedom == moving.same.freedom / 3
    assert moving.probability < 1e-3
    still = compare([calibration(TRUE + drift * (year - years[0])) for year in years], HALF, years)
    ends = compare([calibration(TRUE), calibration(TRUE + drift * 18.0)], HALF)
    assert still.trend_um == pytest.approx(ends.field_um[0], abs=0.05)


def test_over_flat_ground_another_principal_distance_is_another_height() -> None:
    change = np.array([0.05, 0.04, 0.0, 0.0, 0.0, 0.0, 0.0])
    pair = [calibration(TRUE), calibration(TRUE + change)]
    assert compare(pair, HALF).same.probability < 1e-6
    assert np.abs(compare(pair, HALF, use="flat").field_um).max() < 1.0  # what the lens shifts with its point
    assert np.abs(compare(pair, HALF).field_um).max() > 3.0


@pytest.mark.parametrize(
    ("count", "times", "words"), [(1, None, "two calibrations or more"), (2, (1960.0, 1950.0), "in rising order")]
)
def test_what_cannot_be_compared_is_refused(count: int, times: tuple[float, ...] | None, words: str) -> None:
    with pytest.raises(AdjustmentError, match=words):
        compare([calibration(TRUE)] * count, HALF, times)


def two_networks(kind: Transformation, noise: float) -> tuple[tuple[Network, Approximations], ...]:
    """Two data sets of one camera, their names with an A and a B, and both together; errors as small as one likes."""
    networks = []
    for prefix, seed in (("A{}", 1), ("B{}", 2)):
        rng = np.random.default_rng(seed)
        free = {"k3": np.inf, "p1": np.inf}
        network, start = simulated(rng, None, kind, field_points(rng, 14), 0.0, free, False, 0.002 * noise)
        network = noisy(network, rng, noise)
        networks.append(rename_network(network, start, "K", str, prefix.format, prefix.format))
    a, b = networks
    return a, b, join_networks(a, b)


def make_calibration(result: Adjustment, fiducials: bool) -> Calibration:
    kinds = ("interior", "fiducial") if fiducials else ("interior",)
    taken = [each for each in result.parameters if each.kind in kinds and result.cofactor_of([each])[0, 0] > 0.0]
    return Calibration(tuple(taken), result.values_of(taken), result.cofactor_of(taken))


def set_calibration(network: Network, calibration: Calibration) -> Network:
    """The network with that calibration in the place of the camera's priors."""
    value = dict(zip((each.text for each in calibration.parameters), calibration.values.tolist(), strict=True))
    free = map_priors(network, lambda name, prior: Prior(value[name], np.inf) if name in value else prior)
    return replace(free, calibrations=(calibration,))


@pytest.mark.parametrize("kind", [pytest.param("none", marks=pytest.mark.study), "affine"])
def test_an_earlier_calibration_stands_for_its_observations(kind: Transformation) -> None:
    """A, then B with A's calibration, is A and B together: values, sigmas, v'Pv and redundancy.

    The calibration is A made linear, so that with real errors the difference is of second order, some 5e-4 of the
    standard deviations; with errors of a thousandth it must be a thousand times less.
    """
    differences = []
    for noise in (1.0, 1e-3):
        (a, start_a), (b, start_b), (joint, start_joint) = two_networks(kind, noise)
        first, both = adjust(a, start_a), adjust(joint, start_joint)
        second = adjust(set_calibration(b, make_calibration(first, kind != "none")), start_b)
        assert second.converged
        names = [name for name in second.names if both.cofactor_of([name])[0, 0] > 0.0]
        sigmas = np.sqrt([both.cofactor_of([name])[0, 0] for name in names])
        change = np.array([second.value(name) - both.value(name) for name in names]) / sigmas
        differences.append(float(np.abs(change).max()))
        np.testing.assert_allclose(np.sqrt([second.cofactor_of([n])[0, 0] for n in names]), sigmas, rtol=1e-4 * noise)
        assert first.vpv + second.vpv == pytest.approx(both.vpv, abs=1e-3 * noise)
        assert first.redundancy + second.redundancy == both.redundancy
        assert sum(group.redundancy for group in second.groups.values()) == pytest.approx(second.redundancy)
        assert second.warnings == ()
    assert differences[0] < 1e-3
    assert differences[1] < 1e-6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda n, c: set_calibration(n, replace(c, parameters=(Parameter.interior("K", "q"), *c.parameters[1:]))),
            ["q of camera K", "no camera has"],
        ),
        (lambda n, c: replace(n, calibrations=(c,)), ["c of camera K", "standard deviation of its own (1)", "twice"]),
        (lambda n, c: replace(set_calibration(n, c), calibrations=(c, c)), ["c of camera K", "another calibration"]),
        (
            lambda n, c: set_calibration(n, replace(c, covariance=np.ones_like(c.covariance))),
            ["not positive definite", "c, x0 and y0 of camera K"],
        ),
        (lambda n, c: set_calibration(n, replace(c, covariance=c.covariance[:2])), ["shape (2, 5)"]),
    ],
)
def test_a_calibration_that_cannot_be_is_refused(
    change: Callable[[Network, Calibration], Network], words: list[str]
) -> None:
    network, start = simulated(np.random.default_rng(5), kind="none", free={"k3": np.inf, "p1": np.inf})
    own = tuple(Parameter.interior("K", name) for name in ("c", "x0", "y0", "k3", "p1"))
    calibration = Calibration(own, np.array([153.0, 0.0, 0.0, 1.5e-7, 0.0]), np.diag([1.0, 1.0, 1.0, 1e-18, 1e-16]))
    with pytest.raises(AdjustmentError) as error:
        adjust(change(network, calibration), start)
    for word in words:
        assert word in str(error.value)


def noisy(network: Network, rng: np.random.Generator, scale: float) -> Network:
    """A network without errors to speak of, its observations drawn by covariances so many times as large."""
    rows = network.observations
    covariance = scale**2 * rows.covariance_mm2
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return set_observations(network, xy_mm=rows.xy_mm + rng.normal(0.0, sigma), covariance_mm2=covariance)


def test_an_earlier_calibration_is_tested_as_a_whole() -> None:
    """Against the calibration of the new images alone: d' (C_old + C_new)^-1 d, their sigma0, and d itself."""
    (a, start_a), (b, start_b), _ = two_networks("none", 1.0)
    calibration = make_calibration(adjust(a, start_a), False)
    changed = replace(calibration, values=calibration.values + 2.0 * np.sqrt(np.diag(calibration.covariance)))
    network = set_calibration(b, changed)
    alone = adjust(replace(network, calibrations=()), start_b)
    (found,) = adjust(network, start_b).contradictions
    names = list(calibration.parameters)
    difference = np.array([alone.value(name) for name in names]) - changed.values
    joint = changed.covariance + alone.cofactor_of(names)
    chi_square = difference @ np.linalg.solve(joint, difference)
    assert found.parameters == calibration.parameters
    assert found.freedom == len(names)
    assert found.statistic == pytest.approx(chi_square / len(names) / alone.sigma0**2, rel=0.02)
    sigma = alone.sigma0 * np.sqrt(np.diag(joint))
    np.testing.assert_allclose(found.sigma, sigma, rtol=0.02)
    np.testing.assert_allclose(found.difference / sigma, difference / sigma, atol=0.05)
    assert found.direction[0] == np.argmax(np.abs(difference) / sigma)


def test_a_contradiction_is_reported_next_to_what_the_marks_show() -> None:
    """Fiducials, films and camera together can shift, turn and grow, of which images alone say nothing: what is told is
    what is left where the marks lie over one another."""
    (a, start_a), (b, start_b), _ = two_networks("affine", 1.0)
    calibration = make_calibration(adjust(a, start_a), True)
    c, x0 = (calibration.parameters.index(Parameter.interior("K", name)) for name in ("c", "x0"))
    along_x = np.array([each.quantity in ("x0", "x") for each in calibration.parameters])

    def find(change: NDArray[np.float64]) -> CalibrationTest:
        given = set_calibration(b, replace(calibration, values=calibration.values + change))
        (finding,) = adjust(given, start_b).contradictions
        return finding

    same, shifted = find(0.0 * along_x), find(0.05 * along_x)
    longer = find(0.3 * (np.arange(len(along_x)) == c))
    assert same.freedom == len(same.parameters) - 4
    assert same.probability > 1e-3
    assert np.isfinite(same.difference).all()
    np.testing.assert_allclose(shifted.difference / same.sigma, same.difference / same.sigma, atol=0.05)
    assert longer.direction[0] == c
    assert longer.difference[c] == pytest.approx(same.difference[c] - 0.3, abs=0.01)
    assert longer.difference[x0] == pytest.approx(same.difference[x0], abs=0.2 * same.sigma[x0])
