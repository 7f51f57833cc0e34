"""The datum of the object space: minimal, free, observed stations and attitudes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from reference_cases import approximations_of, load, network_of
from simulated import Truth, simulated

from adjust.adjustment import Datum, Options, adjust
from adjust.network import EXTERIOR_NAMES, Exterior, Fiducial, Image, Network, Prior
from adjust.network import ObjectPoint as Point
from adjust.result import Adjustment
from adjust.transformation import NAMES

Array = NDArray[np.float64]


def camera_part(result: Adjustment) -> tuple[Array, Array]:
    """Values and sigmas of everything that does not depend on the object datum."""
    names = [name for name in result.names if name.split(".")[0] in ("IO", "FID", "T")]
    values = np.array([result.value(name) for name in names])
    return values, np.array([result.cofactor.variances[result.index(name)] ** 0.5 for name in names])


def whole(result: Adjustment) -> Array:
    """The cofactor matrix of all unknowns."""
    return result.cofactor_of(result.names)


def free_network() -> tuple[Network, Adjustment, Adjustment]:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf})
    return network, adjust(network, start, Options(datum="minimal")), adjust(network, start, Options(datum="free"))


def test_the_calibration_does_not_depend_on_the_minimal_constraints() -> None:
    """Two planimetric and three height values, chosen automatically and chosen by hand; inner constraints as well."""
    network, minimal, free = free_network()
    known = {"0": (True, True, True), "1": (True, True, True), "2": (False, False, True)}
    by_hand = tuple(
        Point(
            point.id,
            *(
                Prior(prior.value, 0.0 if held else np.inf)
                for prior, held in zip((point.X, point.Y, point.Z), known.get(point.id, (False,) * 3), strict=True)
                if prior is not None
            ),
        )
        for point in network.points
    )
    _, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf})
    manual = adjust(Network(network.cameras, network.images, by_hand, network.observations), start)
    values, sigmas = camera_part(minimal)
    for other in (manual, free):
        assert other.converged
        assert other.vpv == pytest.approx(minimal.vpv, rel=1e-9)
        assert other.redundancy == minimal.redundancy
        other_values, other_sigmas = camera_part(other)
        np.testing.assert_allclose((other_values - values) / np.where(sigmas > 0, sigmas, 1.0), 0.0, atol=1e-6)
        np.testing.assert_allclose(other_sigmas, sigmas, rtol=1e-7)


def test_seven_values_are_fixed() -> None:
    _, minimal, free = free_network()
    fixed = [name for name in minimal.names if name.startswith("PT.") and minimal.sigma(name) == 0.0]
    assert sorted(name[-1] for name in fixed) == ["X", "X", "Y", "Y", "Z", "Z", "Z"]
    assert all(free.sigma(name) > 0.0 for name in free.names if name.startswith("PT."))


def test_inner_constraints_have_the_least_trace_and_leave_the_centre() -> None:
    """The pseudo-inverse of the points' normal equations: no datum gives a smaller trace of their cofactors."""
    network, minimal, free = free_network()
    points = np.array([i for i, name in enumerate(free.names) if name.startswith("PT.")])
    part = free.cofactor.of(points)
    assert np.trace(part) < np.trace(minimal.cofactor.of(points))
    given = np.array([[p.value for p in (point.X, point.Y, point.Z) if p is not None] for point in network.points])
    values = free.values[points].reshape(-1, 3)
    np.testing.assert_allclose(values.mean(axis=0), given.mean(axis=0), atol=1e-8)
    # The seven similarity directions are exactly those that the cofactor matrix does not contain.
    centred = values - values.mean(axis=0)
    directions = [np.tile(axis, len(values)) for axis in np.eye(3)]
    directions += [np.cross(axis, centred).ravel() for axis in np.eye(3)] + [centred.ravel()]
    for direction in directions:
        unit = direction / np.linalg.norm(direction)
        assert np.linalg.norm(part @ unit) < 1e-9 * np.linalg.norm(part)
    eigenvalues = np.linalg.eigvalsh(part)
    assert eigenvalues[6] < 1e-9 * eigenvalues[7]


def test_minimal_datum_of_the_reference_case() -> None:
    """The reference's network with nothing fixed by hand gives the reference's camera."""
    case = load("iii_selfcal_all_unknown_datum_A")
    start = approximations_of(case, case["input"]["initial_approximations"])
    case["input"]["pts_sigma"] = [[None] * 3 for _ in case["input"]["pts_sigma"]]
    result = adjust(network_of(case), start, Options(datum="minimal"))
    assert result.vpv == pytest.approx(case["result"]["vpv"], rel=1e-8)
    reference = case["result"]["parameters"]["IO.c"]
    assert result.value("IO.K.c") == pytest.approx(reference["value"], abs=1e-6 * reference["std_apriori"])
    assert result.sigma("IO.K.c") == pytest.approx(reference["std_aposteriori"], rel=1e-7)


def with_exteriors(network: Network, sigmas: Array, truth: Truth) -> Network:
    """The network with observed exterior orientations."""
    values = np.hstack([np.array(truth.stations), np.array(truth.attitudes)])
    images = tuple(
        Image(image.name, image.camera, image.transformation, Exterior(row, sigmas))
        for image, row in zip(network.images, values, strict=True)
    )
    return Network(network.cameras, images, network.points, network.observations)


def test_observed_stations_fix_the_datum() -> None:
    """Observed stations add three conditions an image, and an observed element is never worse than its observation."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(6), truth, point_sigma=np.inf)
    sigmas = np.array([0.05, 0.05, 0.05, np.inf, np.inf, np.inf])
    result = adjust(with_exteriors(network, sigmas, truth), start)
    assert result.converged
    assert 0.0 < result.groups["exterior"].redundancy <= 12 - 7
    assert all(result.cofactor.variances[result.index(f"EO.f{i}.X0")] <= 0.05**2 for i in range(4))


@pytest.mark.parametrize(
    "observed", [(0.0, 0.0, 0.0), (0.001, 0.002, 0.003), (np.inf, np.inf, 0.001), (0.0, 0.0, np.inf)]
)
def test_observed_and_fixed_angles(observed: tuple[float, float, float]) -> None:
    """Each angle is observed, fixed or free by itself; the result is that of minimising over the angles directly."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(7), truth)
    result = adjust(with_exteriors(network, np.array([np.inf] * 3 + list(observed)), truth), start)
    assert result.converged
    for i, attitude in enumerate(truth.attitudes):
        for name, value, sigma in zip(EXTERIOR_NAMES[3:], attitude, observed, strict=True):
            if sigma == 0.0:
                assert result.value(f"EO.f{i}.{name}") == value
                assert result.sigma(f"EO.f{i}.{name}") == 0.0
            elif np.isfinite(sigma):
                assert result.cofactor.variances[result.index(f"EO.f{i}.{name}")] < sigma**2
    finite = sum(0.0 < sigma < np.inf for sigma in observed)
    fixed = sum(sigma == 0.0 for sigma in observed)
    free = adjust(network, start)
    assert result.conditions - free.conditions == 4 * finite
    assert free.unknowns - result.unknowns == 4 * fixed


def test_a_very_weak_prior_on_the_angles_changes_nothing() -> None:
    """The angles as parameters, and the rotation vector: two ways, one result, covariance of omega, phi, kappa too."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(8), truth)
    vector = adjust(network, start)
    angles = adjust(with_exteriors(network, np.array([np.inf] * 3 + [1e4] * 3), truth), start)
    assert angles.converged
    scale = np.sqrt(vector.cofactor.variances)
    scale[scale == 0.0] = 1.0
    np.testing.assert_allclose((angles.values - vector.values) / scale, 0.0, atol=1e-6)
    np.testing.assert_allclose(
        whole(angles) / np.outer(scale, scale), whole(vector) / np.outer(scale, scale), atol=1e-6
    )


def test_no_attitude_is_singular() -> None:
    """phi of 90 degrees: omega and kappa are not defined one by one, everything else is."""
    half = np.pi / 2
    truth = Truth(
        attitudes=((0.0, half, 0.0), (0.0, half - 0.3, 0.1), (0.0, half + 0.3, 1.5), (0.3, half, -1.5)),
        stations=((1500.0, 0.0, 0.0), (1400.0, 100.0, 500.0), (1450.0, 30.0, -480.0), (1400.0, -520.0, 60.0)),
    )
    rng = np.random.default_rng(10)
    points = rng.uniform([-200.0, -800.0, -800.0], [200.0, 800.0, 800.0], (14, 3))
    network, start = simulated(rng, truth, points=points, noise=False)
    result = adjust(network, start)
    assert result.converged
    assert result.vpv < 1e-12
    assert np.isfinite(whole(result)).all()
    assert result.value("EO.f0.phi") == pytest.approx(half, abs=1e-6)


def test_mirrored_scans_are_ordinary() -> None:
    """Every second scan mirrored: the same residuals and the same camera as from the scans laid properly."""
    straight = Truth()
    mirrored = Truth(mirrored=(False, True, False, True))
    for kind in ("congruent", "similarity", "affine"):
        network, start = simulated(np.random.default_rng(3), straight, kind, noise=False)
        turned, turned_start = simulated(np.random.default_rng(3), mirrored, kind, noise=False)
        one, other = adjust(network, start), adjust(turned, turned_start)
        assert one.converged
        assert other.converged
        assert other.vpv < 1e-12
        assert len(NAMES[kind]) * 4 == sum(name.startswith("T.") for name in other.names)
        assert other.cofactor.variances[other.index("IO.K.c")] == pytest.approx(
            one.cofactor.variances[one.index("IO.K.c")]
        )


@pytest.mark.parametrize("datum", ["minimal", "free"])
def test_a_datum_that_is_given_is_left_alone(datum: Datum) -> None:
    """Known points, and points with standard deviations: nothing is free, and nothing more is fixed."""
    for sigma in (0.0, 0.05):
        network, start = simulated(np.random.default_rng(13), point_sigma=sigma)
        plain, other = adjust(network, start), adjust(network, start, Options(datum=datum))
        assert other.unknowns == plain.unknowns
        np.testing.assert_array_equal(other.values, plain.values)
        np.testing.assert_allclose(whole(other), whole(plain), rtol=1e-9)


@pytest.mark.parametrize("held", [True, False])
def test_fiducials_alone_are_adjusted(held: bool) -> None:
    """No object point at all, orientations known: the films' transformations and the mean of the fiducials."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(14), truth, points=np.zeros((0, 3)))
    camera = network.cameras[0]
    if not held:
        free = {
            id_: Fiducial(Prior(m.x_mm.value, np.inf), Prior(m.y_mm.value, np.inf))
            for id_, m in camera.fiducials.items()
        }
        network = replace(network, cameras=(replace(camera, fiducials=free),))
    result = adjust(with_exteriors(network, np.zeros(6), truth), start)
    if held:
        assert result.converged
        assert result.groups["fiducial"].redundancy == pytest.approx(4 * 10 - 4 * 6 - 10 + 6, abs=0.1)
    else:
        assert len(result.singular) == 6
