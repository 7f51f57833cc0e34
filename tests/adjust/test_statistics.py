"""Standard deviations, redundancy numbers, robust weights and variance components against simulation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from simulated import Truth, field_points, row_of, simulated, with_covariance, with_errors

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import EXTERIOR_NAMES, Exterior
from adjust.quality.weighting import robust_weights
from adjust.solution.adjustment import Options, adjust

Array = NDArray[np.float64]

ROBUST = Options(robust=True)


def monte_carlo(runs: int) -> tuple[Array, Array]:
    """Normalised errors (runs, unknowns) of c, x0', y0', fiducials, k3 and exteriors, and v'Pv of every run."""
    truth = Truth()
    points = field_points(np.random.default_rng(0), 12)
    exact, _ = simulated(np.random.default_rng(0), truth, points=points, noise=False)
    camera = exact.cameras[0]
    expected = {"IO.K.c": truth.c, "IO.K.x0": truth.x0, "IO.K.y0": truth.y0, "IO.K.k3": truth.distortion["k3"]}
    expected |= {f"FID.K.{id_}.x": mark.x_mm.value for id_, mark in camera.fiducials.items()}
    expected |= {
        f"EO.f{i}.{name}": value
        for i in range(4)
        for name, value in zip(EXTERIOR_NAMES, (*truth.stations[i], *truth.attitudes[i]), strict=True)
    }
    errors, vpv = [], []
    for run in range(runs):
        network, start = simulated(np.random.default_rng(100 + run), truth, points=points, free={"k3": np.inf})
        result = adjust(network, start)
        assert result.converged
        sigmas = np.sqrt(result.cofactor.variances)
        errors.append([(result.value(n) - value) / sigmas[result.index(n)] for n, value in expected.items()])
        vpv.append(result.vpv / result.redundancy)
    return np.array(errors), np.array(vpv)


def check_monte_carlo(runs: int) -> None:
    errors, variance = monte_carlo(runs)
    low, high = np.sqrt(chi2.ppf([1e-5, 1 - 1e-5], runs) / runs)
    rms = np.sqrt((errors**2).mean(axis=0))
    assert (rms > low).all()
    assert (rms < high).all()
    assert np.abs(errors.mean(axis=0)).max() < 4.5 / np.sqrt(runs)
    assert variance.mean() == pytest.approx(1.0, abs=6.0 * variance.std() / np.sqrt(runs))


@pytest.mark.study
def test_claimed_standard_deviations_are_realised() -> None:
    check_monte_carlo(40)


@pytest.mark.study
def test_claimed_standard_deviations_are_realised_closely() -> None:
    check_monte_carlo(3000)


def test_a_point_covariance_is_not_conditional_on_everything_else() -> None:
    """With everything else held fixed, an intersected point looks far better than it is."""
    network, start = simulated(np.random.default_rng(1), point_sigma=np.inf)
    result = adjust(network, start, Options(datum="minimal"))
    is_point = np.char.startswith(result.names, "PT.")
    points = np.flatnonzero(is_point & (result.cofactor.variances > 0.0))
    weight = np.linalg.inv(result.cofactor.part(points))
    conditional = 1.0 / np.diag(weight)
    claimed = result.cofactor.variances[points]
    assert (claimed > conditional).all()
    assert np.median(claimed / conditional) > 4.0


def test_a_weight_is_the_inverse_of_a_variance() -> None:
    """Halving a mark's sigma lowers its share of a contradiction; a covariance taken for a weight raises it."""
    network, start = simulated(np.random.default_rng(2), noise=False)
    row = row_of(network, "target", "f1", "4")
    network = with_errors(network, {row: np.array([0.02, 0.0])})
    covariance = network.observations.covariance_mm2.copy()
    covariance[row] /= 4.0
    plain, halved = adjust(network, start), adjust(with_covariance(network, covariance), start)
    assert abs(halved.residuals.v_mm[row, 0]) < 0.95 * abs(plain.residuals.v_mm[row, 0])
    assert halved.residuals.redundancy[row, 0] < plain.residuals.redundancy[row, 0]


def test_redundancy_is_what_a_residual_shows_of_an_error() -> None:
    """An error in one coordinate appears in its residual times minus the redundancy number, correlations included."""
    network, start = simulated(np.random.default_rng(3), noise=False)
    row = row_of(network, "target", "f2", "7")
    covariance = network.observations.covariance_mm2.copy()
    covariance[row] = 0.004**2 * np.array([[1.0, 0.6], [0.6, 2.0]])
    for axis in (0, 1):
        spoilt = with_errors(with_covariance(network, covariance), {row: 1e-4 * np.eye(2)[axis]})
        result = adjust(spoilt, start)
        shown = -result.residuals.v_mm[row, axis] / 1e-4
        assert shown == pytest.approx(result.residuals.redundancy[row, axis], rel=1e-4)


def test_standardised_residuals_are_standard() -> None:
    runs = [simulated(np.random.default_rng(50 + seed)) for seed in range(8)]
    w = np.concatenate([adjust(*each).residuals.w.ravel() for each in runs])
    assert np.sqrt((w**2).mean()) == pytest.approx(1.0, abs=0.06)
    assert abs(w.mean()) < 0.1


def test_rms_is_per_axis() -> None:
    """Per point it would be larger by the root of two."""
    network, start = simulated(np.random.default_rng(4))
    result = adjust(network, start)
    targets = np.array([kind == "target" for kind in network.observations.kind])
    v_um = 1000.0 * result.residuals.v_mm[targets]
    group = result.groups["target"]
    assert group.rms_x_um == pytest.approx(np.sqrt((v_um[:, 0] ** 2).mean()))
    per_point = np.sqrt((v_um**2).sum(axis=1).mean())
    assert np.hypot(group.rms_x_um, group.rms_y_um) == pytest.approx(per_point)


def test_units_do_not_matter() -> None:
    """Object space in millimetres instead of metres: the same camera."""
    points = field_points(np.random.default_rng(5), 12)
    network, start = simulated(np.random.default_rng(5), points=points)
    large = Truth(stations=tuple((1000 * x, 1000 * y, 1000 * z) for x, y, z in Truth().stations))
    other, other_start = simulated(np.random.default_rng(5), large, points=1000.0 * points)
    first, second = adjust(network, start), adjust(other, other_start)
    scale = np.sqrt(first.cofactor.variances[first.index("IO.K.c")])
    assert second.value("IO.K.c") == pytest.approx(first.value("IO.K.c"), abs=1e-6 * scale)
    assert second.sigma("EO.f1.Z0") == pytest.approx(1000.0 * first.sigma("EO.f1.Z0"), rel=1e-6)


@pytest.mark.study
def test_robust_estimation_withstands_gross_errors() -> None:
    """Five gross errors of 50 to 100 um."""
    rng = np.random.default_rng(6)
    network, start = simulated(rng, points=field_points(rng, 20))
    targets = [i for i, kind in enumerate(network.observations.kind) if kind == "target"]
    wrong = [int(i) for i in rng.choice(targets, 5, replace=False)]
    errors = rng.choice([-1.0, 1.0], (5, 2)) * rng.uniform(0.05, 0.1, (5, 2))
    dirty = with_errors(network, dict(zip(wrong, errors, strict=True)))
    clean, plain, robust = (adjust(*each) for each in ((network, start), (dirty, start), (dirty, start, ROBUST)))
    names = [name for name in clean.names if name.startswith(("EO.", "IO.")) and clean.sigma(name) > 0.0]
    sigma = np.sqrt(np.diag(clean.cofactor_of(names)))
    off = [
        np.sqrt(np.mean(((each.values_of(names) - clean.values_of(names)) / sigma) ** 2)) for each in (plain, robust)
    ]
    assert robust.converged
    assert off[1] < 0.35 * off[0]
    assert (robust.weights[wrong] < 0.25).all()
    assert np.median(np.delete(robust.weights, wrong)) == 1.0
    assert set(np.argsort(-np.abs(robust.residuals.w).max(axis=1))[:5]) == set(wrong)


def test_variance_components_find_the_variances() -> None:
    """Targets twice as bad as claimed, fiducials half as bad; 1 is what a right claim gives."""
    rng = np.random.default_rng(8)
    network, start = simulated(rng, points=field_points(rng, 40))
    fiducial = np.array([kind == "fiducial" for kind in network.observations.kind])
    claimed = network.observations.covariance_mm2 * np.where(fiducial, 4.0, 0.25)[:, None, None]
    result = adjust(with_covariance(network, claimed), start, Options(variance_components=True))
    assert result.converged
    assert result.variance_factors["target"] == pytest.approx(4.0, rel=0.3)
    assert result.variance_factors["fiducial"] == pytest.approx(0.25, rel=0.6)
    assert result.groups["target"].sigma0 == pytest.approx(1.0, abs=2e-3)
    assert result.groups["fiducial"].sigma0 == pytest.approx(1.0, abs=2e-3)


def test_an_affine_on_three_marks_has_no_check() -> None:
    """Its residuals are 0 because they must be: the redundancy says so, and neither sigma0 nor w pretend otherwise."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(10), truth, points=np.zeros((0, 3)))
    camera = network.cameras[0]
    marks = {
        id_: Fiducial(Prior(m.x_mm.value), Prior(m.y_mm.value)) for id_, m in camera.fiducials.items() if id_ in "123"
    }
    known = Camera("K", Prior(truth.c), Prior(truth.x0), Prior(truth.y0), camera.distortion, marks)
    rows = network.observations
    three = rows.only(np.flatnonzero([point in marks for point in rows.point]))
    images = tuple(
        replace(image, exterior=Exterior(np.array([*station, *attitude]), np.zeros(6)))
        for image, station, attitude in zip(network.images, truth.stations, truth.attitudes, strict=True)
    )
    result = adjust(replace(network, cameras=(known,), images=images, observations=three), start)
    assert result.converged
    assert result.redundancy == 0
    assert result.sigma0 == 1.0
    group = result.groups["fiducial"]
    assert group.redundancy == pytest.approx(0.0, abs=1e-9)
    assert group.rms_x_um == pytest.approx(0.0, abs=1e-6)
    assert group.sigma0 == 0.0
    assert (result.residuals.w == 0.0).all()


def test_the_redescending_weights_are_the_published_ones() -> None:
    """Yang, Song and Xu 2002, k = 2 and K = 4.5: 1, then k / t ((K - t) / (K - k))², then none. t of an observation is
    over the scale that the median gives: of a pair of normally distributed errors that is sqrt(ln 2)."""
    t = np.array([0.5, 1.9, 2.5, 3.25, 4.4, 6.0])
    ordinary = np.full(101, np.log(2.0))
    weights = robust_weights(2.0 * np.array([*ordinary, *t**2]), np.full(107, 2), 107, "igg3")[101:]
    expected = [1.0, 1.0, 0.8 * 0.64, 2.0 / 3.25 * 0.25, 2.0 / 4.4 * 0.0016, 0.0]
    np.testing.assert_allclose(weights, expected, rtol=1e-9, atol=1e-11)
    huber = robust_weights(2.0 * np.array([*ordinary, *t**2]), np.full(107, 2), 107, "huber")[101:]
    np.testing.assert_allclose(huber, [1.0, 1.0, 0.8, 2.0 / 3.25, 2.0 / 4.4, 1.0 / 3.0], rtol=1e-9)
