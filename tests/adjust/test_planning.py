"""Expected precision: that of the reference adjustments, of measurements simulated many times, of closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from reference_cases import CAMERA, case_approximations, case_network, load, own_name
from simulated import simulated

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Approximations, Exterior, Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import Datum, Options, adjust
from adjust.solution.planning import plan

TARGETS: tuple[ObservationKind, ...] = ("target",) * 5
FIDUCIALS: tuple[ObservationKind, ...] = ("fiducial",) * 3
DRAWS = 60


@pytest.mark.parametrize("name", ["i_five_images_affine_paper_noisefree", "ii_juhl_3photos"])
def test_a_priori_sigmas_of_the_reference(name: str) -> None:
    """At the true values: those of a case with noise were computed a little beside them."""
    case = load(name)
    expected = plan(case_network(case), case_approximations(case, case["truth"]))
    sigmas = {own_name(key): row["std_apriori"] for key, row in case["result"]["parameters"].items()}
    planned = [expected.sigma(key) for key in sigmas]
    tolerance = 1e-7 if case["result"]["vpv"] < 1e-12 else 2e-3
    np.testing.assert_allclose(planned, list(sigmas.values()), rtol=tolerance)
    redundancy = expected.adjustment.residuals.redundancy.ravel()
    np.testing.assert_allclose(redundancy, case["result"]["redundancy_numbers"][: len(redundancy)], atol=tolerance)


def test_what_was_measured_does_not_matter() -> None:
    network, values = simulated(np.random.default_rng(3))
    moved = replace(network, observations=replace(network.observations, xy_mm=network.observations.xy_mm + 1.0))
    one, other = plan(network, values), plan(moved, values)
    assert one.adjustment.iterations == 1
    for name in ("IO.K.c", "FID.K.1.x", "EO.f0.Z0"):
        assert other.sigma(name) == pytest.approx(one.sigma(name), rel=1e-12)


@pytest.mark.study
def test_simulated_measurements_scatter_as_planned() -> None:
    network, values = simulated(np.random.default_rng(0), noise=False, free={"k3": np.inf})
    network = set_interior(network, np.inf)
    names = ["IO.K.c", "IO.K.x0", "IO.K.k3", "FID.K.1.x", "FID.K.4.y", "EO.f1.Z0", "EO.f2.kappa"]
    expected = plan(network, values)
    rng = np.random.default_rng(11)
    found = []
    for _ in range(DRAWS):
        result = adjust(measure_picture(network, rng), values)
        found.append([result.value(name) for name in names])
    ratio = np.std(found, axis=0) / [expected.sigma(name) for name in names]
    assert np.abs(ratio - 1.0).max() < 4.0 / np.sqrt(2 * DRAWS)


def test_twice_as_large_errors_give_twice_as_large_sigmas() -> None:
    """Of what observations alone determine: no prior has a say."""
    network, values = simulated(np.random.default_rng(5), noise=False, fiducial_sigma=0.0)
    network = set_interior(network, np.inf)
    rows = network.observations
    coarse = replace(network, observations=replace(rows, covariance_mm2=4.0 * rows.covariance_mm2))
    fine, doubled, factor = plan(network, values), plan(coarse, values), plan(network, values, sigma0=2.0)
    for name in fine.adjustment.names:
        assert doubled.sigma(name) == pytest.approx(2.0 * fine.sigma(name), rel=1e-9)
        assert factor.sigma(name) == pytest.approx(2.0 * fine.sigma(name), rel=1e-9)
    assert factor.adjustment.sigma0 == pytest.approx(2.0)


def test_a_singular_network_still_determines_the_rest() -> None:
    """Juhl's field of known heights: not c, x0', y0', but all nine deformations as if these were known."""
    case = load("ii_juhl_3photos")
    network, values = case_network(case), case_approximations(case, case["truth"])
    regular, singular = plan(network, values), plan(set_interior(network, np.inf), values)
    assert regular.singular == ()
    assert len(singular.singular) == 3
    for name in (f"IO.{CAMERA}.c", f"IO.{CAMERA}.x0", f"IO.{CAMERA}.y0", "EO.1.Z0"):
        assert singular.sigma(name) == np.inf
    for name in case["nine_parameters"]:
        expected = regular.sigma(f"IO.{CAMERA}.{name}")
        assert singular.sigma(f"IO.{CAMERA}.{name}") == pytest.approx(expected, rel=1e-6)
    # How high the stations are is not known, but by how much one is above the other.
    names, difference = ["EO.1.Z0", "EO.2.Z0"], np.array([[1.0, -1.0]])
    assert singular.sigmas(names, difference) == pytest.approx(regular.sigmas(names, difference), rel=1e-6)


@pytest.mark.parametrize("datum", ["free", "control"])
def test_the_camera_does_not_depend_on_the_datum(datum: Datum) -> None:
    """Where nothing is given of the object, that is singular and all the camera is determined all the same."""
    network, values = simulated(np.random.default_rng(7), point_sigma=np.inf, fiducial_sigma=0.01)
    planned, reference = plan(network, values, Options(datum)), plan(network, values, Options("minimal"))
    assert len(planned.singular) == (7 if datum == "control" else 0)
    for name in ("IO.K.c", "FID.K.2.x"):
        assert planned.sigma(name) == pytest.approx(reference.sigma(name), rel=1e-6)
    assert (planned.sigma("PT.3.X") == np.inf) == (datum == "control")


def test_a_fiducial_of_a_known_image_is_a_regression() -> None:
    """Interior and exterior orientation known: an affinity from m targets, and what it makes of a mark beside it."""
    places = np.array([[-80.0, -70.0], [90.0, -85.0], [75.0, 60.0], [-95.0, 88.0], [10.0, 5.0]])
    mark_mm, sigma_target, sigma_mark = np.array([106.0, -104.0]), 0.004, 0.003
    points = np.column_stack([places * 10.0, np.zeros(len(places))])
    exterior = np.array([0.0, 0.0, 1500.0, 0.0, 0.0, 0.0])
    free = Prior(mark_mm[0], np.inf), Prior(mark_mm[1], np.inf)
    others = {str(i): Fiducial(Prior(float(i)), Prior(1.0)) for i in range(2)}
    count = len(TARGETS + FIDUCIALS)
    network = Network(
        (Camera("K", Prior(150.0), Prior(0.0), Prior(0.0), fiducials={"m": Fiducial(*free), **others}),),
        (Image("f", "K", "affine", Exterior(exterior, np.zeros(6))),),
        tuple(ObjectPoint(str(j), *map(Prior, xyz.tolist())) for j, xyz in enumerate(points)),
        Observations(
            ("f",) * count,
            (*map(str, range(len(points))), "m", "0", "1"),
            TARGETS + FIDUCIALS,
            np.zeros((count, 2)),
            np.array([sigma_target**2 * np.eye(2)] * len(points) + [sigma_mark**2 * np.eye(2)] + [1e6 * np.eye(2)] * 2),
        ),
    )
    values = Approximations(
        {"K": np.array([150.0, 0.0, 0.0])},
        {"f": exterior},
        {"f": np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0])},
        {str(j): xyz for j, xyz in enumerate(points)},
    )
    design = np.column_stack([np.ones(len(places)), places])
    at_mark = np.array([1.0, *mark_mm])
    variance = sigma_target**2 * at_mark @ np.linalg.solve(design.T @ design, at_mark) + sigma_mark**2
    planned = plan(network, values)
    for axis in "xy":
        assert planned.sigma(f"FID.K.m.{axis}") == pytest.approx(np.sqrt(variance), rel=1e-7)


def test_a_point_behind_the_camera_is_reported() -> None:
    network, values = simulated(np.random.default_rng(1))
    away = {**values.exterior, "f2": values.exterior["f2"] + np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0])}
    with pytest.raises(AdjustmentError, match=r"cannot be planned: point \d+ lies behind the camera in image f2"):
        plan(network, replace(values, exterior=away))


def set_interior(network: Network, sigma: float) -> Network:
    """The same with one standard deviation for c, x0' and y0'."""
    camera = network.cameras[0]
    c, x0, y0 = (
        replace(prior, sigma=sigma) for prior in (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm) if prior
    )
    return replace(network, cameras=(replace(camera, principal_distance_mm=c, x0_mm=x0, y0_mm=y0),))


def measure_picture(network: Network, rng: np.random.Generator) -> Network:
    """A network without errors, its observations and given fiducials with noise."""
    rows, camera = network.observations, network.cameras[0]
    sigmas = np.sqrt(np.diagonal(rows.covariance_mm2, axis1=1, axis2=2))
    fiducials = {id_: Fiducial(_draw(mark.x_mm, rng), _draw(mark.y_mm, rng)) for id_, mark in camera.fiducials.items()}
    return replace(
        network,
        cameras=(replace(camera, fiducials=fiducials),),
        observations=replace(rows, xy_mm=rows.xy_mm + sigmas * rng.normal(size=sigmas.shape)),
    )


def _draw(prior: Prior, rng: np.random.Generator) -> Prior:
    return replace(prior, value=float(rng.normal(prior.value, prior.sigma)))
