"""Derivatives against complex steps; refraction and earth curvature against ray tracing and published formulas."""

from dataclasses import replace

import numpy as np
import pytest
from networks import (
    KINDS,
    SCAN_MIDDLE_MM,
    UNKNOWN,
    Truth,
    bend_in_scanner,
    camera_point,
    field_points,
    rough_start,
    set_camera,
    set_observations,
    set_sigma,
    simulated,
)
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from studies import parametrize_with_studies

from adjust import Options, adjust
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Decentering, Distortion, Lens, Prior
from adjust.functional_model.projection import EARTH_RADIUS_M, sight_vectors
from adjust.functional_model.rotation import (
    rotation_from_vector,
)
from adjust.problem.condition_equations import (
    compute,
    computed_observations,
    derivatives,
)
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import LineOfSight, Network, Transformation
from adjust.problem.problem import Problem, number
from adjust.solution.planning import plan

Array = NDArray[np.float64]

STEP = 1e-30
BEND = {"a20": Prior(0.9, np.inf), "b11": Prior(-0.7, np.inf), "a03": Prior(0.5, np.inf), "b60": Prior(0.0, np.inf)}

PARAMETER_VALUES: dict[str, list[float]] = {
    "none": [],
    "torlegard": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-5, 3e-9],
    "brown": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-4, -3e-4],
    "opencv": [0.1, -0.05, 0.01, -0.02, 0.03, 0.04, -0.03, 0.02, 0.01, 0.02, -0.01, 0.03, 0.2, -0.15, 0.002, 0.003],
    "opencv_fisheye": [0.1, -0.05, 0.03, 0.02, 0.002, -0.003],
    "australis": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-4, -3e-4],
    "aicon": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-4, -3e-4],
    "juhl": [6.0, -4.0, 3.0, -2.0, 5.0, -4.0, 2.0, -7.0, 3.0],
    **{
        name: (0.05 * np.cos(np.arange(len(parameter_names(name))))).tolist()
        for name in ("ebner", "gruen", "legendre(2)", "legendre(5)", "fourier(1)", "fourier(3)")
    },
}


@pytest.mark.parametrize("decentering", ["reduced", "paper"])
@pytest.mark.parametrize("family", list(PARAMETER_VALUES))
def test_image_equations_by_complex_steps(family: str, decentering: Decentering) -> None:
    rng = np.random.default_rng(3)
    distortion = Distortion(family, decentering=decentering, r0_mm=135.0, half_mm=(115.0, 90.0))
    parts = [
        np.array([153.0, 0.8, -0.5, *PARAMETER_VALUES[family]]),
        rng.uniform(-100, 100, (6, 2)),
        rng.uniform(-0.7, 0.7, (6, 2)),
    ]
    lens = Lens(distortion, np.zeros(3), np.empty(0))
    at = lens.replaced_values(parts[0]).equations(*parts[1:])
    for part_number, derivative in enumerate((at.quantity_jacobian, at.xy_jacobian, at.ray_jacobian)):
        for column in range(derivative.shape[2]):
            moved = [part.astype(complex) for part in parts]
            moved[part_number][..., column] += 1j * STEP
            numeric = lens.replaced_values(moved[0]).equations(*moved[1:]).value.imag / STEP
            scale = np.abs(numeric).max() or 1.0
            np.testing.assert_allclose(derivative[..., column], numeric, rtol=0, atol=2e-14 * scale)


@pytest.mark.parametrize("length", [1e-9, 0.3, 1.4, 3.1])
def test_a_rotation_vector_is_the_rotation_of_other_programs(length: float) -> None:
    vector = length * np.array([2.0, -3.0, 6.0]) / 7.0
    np.testing.assert_allclose(rotation_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)


@pytest.mark.parametrize("by_elements", [False, True])
@parametrize_with_studies("kind", KINDS, quick=(0, 2, 4, 5, 7))
def test_functions_by_differences_of_computed_observations(kind: Transformation, by_elements: bool) -> None:
    """F(l(x), x) = 0 defines l(x), so that dl/dx = -A^-1 B: by central differences of l for every unknown, of an image
    without a scanner and of three of one that bends."""
    rng = np.random.default_rng(11)
    middle_mm = SCAN_MIDDLE_MM if kind != "none" else (0.0, 0.0)
    truth = Truth(mirrored=(False, kind != "none", False, False), middle_mm=middle_mm)
    network, start = simulated(rng, truth, kind, point_sigma=np.inf, free={"k3": np.inf, "k5": np.inf})
    network = bend_in_scanner(network, {}, BEND)
    network = replace(network, images=(replace(network.images[0], scanner=""), *network.images[1:]))
    problem = number(network, start, by_elements)
    every = np.where(problem.unknowns.sigma > 0.0, problem.unknowns.sigma, np.inf)
    problem = replace(problem, unknowns=replace(problem.unknowns, sigma=every))
    state = problem.start()
    computed = compute(problem, state)
    assert computed is not None
    at = derivatives(problem, state, computed)
    by_unknowns = -np.linalg.solve(at.by_observation, at.by_unknowns)
    names, columns = [each.text for each in problem.unknowns.parameters], problem.columns
    for alike in apart(problem):
        sizes = np.array([choose_step(names[position]) for position in alike])
        numeric = (shift_unknowns(problem, alike, sizes) - shift_unknowns(problem, alike, -sizes)) / (2 * sizes[0])
        is_moved = np.isin(columns, alike)
        analytic = (by_unknowns * is_moved[:, None, :]).sum(axis=2)
        assert is_moved.sum(axis=1).max() <= 1
        assert not numeric[~is_moved.any(axis=1)].any()
        for position in alike:
            own = (columns == position).any(axis=1)
            scale = np.abs(numeric[own]).max(initial=0.0)
            np.testing.assert_allclose(
                analytic[own], numeric[own], rtol=0, atol=3e-6 * scale + 1e-30, err_msg=names[position]
            )


def apart(problem: Problem) -> list[list[int]]:
    """The unknowns by what they are, of all images and points: no observation depends on two of one kind."""
    groups: dict[tuple[str, str], list[int]] = {}
    for position, name in enumerate(each.text for each in problem.unknowns.parameters):
        groups.setdefault((name.split(".")[0], name.rsplit(".", 1)[1]), []).append(position)
    return list(groups.values())


def choose_step(name: str) -> float:
    """A step that moves the image by some micrometres."""
    owner, quantity = name.split(".")[0], name.rsplit(".", 1)[1]
    if owner in ("EO", "PT"):
        return 1e-5 if quantity in ("omega", "phi", "kappa") else 0.01
    if owner == "T":
        return {"angle": 1e-5, "c1": 3e-4, "c2": 3e-4}.get(quantity, 1e-3)
    powers = {"k3": 1e-10, "k5": 1e-14, "k7": 1e-18, "p1": 1e-8, "p2": 1e-8, "p3": 1e-7, "p4": 1e-11}
    return powers.get(quantity, 1e-3)


def shift_unknowns(problem: Problem, positions: list[int], sizes: Array) -> Array:
    step = np.zeros(len(problem.unknowns))
    step[positions] = sizes
    computed = computed_observations(problem, problem.step_state(problem.start(), step))
    assert computed is not None
    return computed


BENT = LineOfSight(curvature=True, refraction=True)


def air_by_integration() -> tuple[Array, Array]:
    """Heights and n - 1 of the standard atmosphere: hydrostatic equilibrium integrated step by step."""

    def kelvin(z: float) -> float:
        return max(288.15 - 0.0065 * z, 216.65)

    z = np.linspace(-100.0, 14000.0, 28201)  # steps of half a metre, 11 km among them
    kelvins = np.array([kelvin(each) for each in z])
    fall = np.append(0.0, np.cumsum(0.5 * np.diff(z) * 9.80665 / 287.05287 * (1 / kelvins[1:] + 1 / kelvins[:-1])))
    pressure = 1013.25 * np.exp(np.interp(0.0, z, fall) - fall)
    return z, 2.7782e-4 * pressure / 1013.25 * 288.15 / kelvins


AIR_M, AIR = air_by_integration()


def traced_arc(nadir_rad: float, station_m: float, point_m: float) -> float:
    """The arc at height 0 of a ray that reaches the station at this angle: n r sin(nadir angle) is constant."""

    def radius_index(z: float) -> float:
        return (EARTH_RADIUS_M + z) * (1.0 + float(np.interp(z, AIR_M, AIR)))

    constant = radius_index(station_m) * np.sin(nadir_rad)

    def turn(z: float) -> float:
        return float(constant / ((EARTH_RADIUS_M + z) * np.sqrt(radius_index(z) ** 2 - constant**2)))

    return EARTH_RADIUS_M * quad(turn, point_m, station_m, epsabs=1e-14, epsrel=1e-11, limit=400)[0]


@pytest.mark.parametrize(("station_m", "point_m"), [(600.0, 0.0), (3000.0, 700.0), (9000.0, -30.0), (13000.0, 400.0)])
@pytest.mark.parametrize("degrees", [10.0, 45.0, 65.0])
def test_ray_tracing_through_spherical_layers(degrees: float, station_m: float, point_m: float) -> None:
    """The apparent nadir angle to 0.02 um in an image of c = 153 mm up to 45 degrees, and to 0.25 um at 65 degrees."""
    nadir = np.radians(degrees)
    arc = traced_arc(nadir, station_m, point_m)
    vector = sight_vectors(BENT, np.array([0.0, 0.0, station_m]), np.array([[0.6 * arc, 0.8 * arc, point_m]])).vector[0]
    assert vector[1] / vector[0] == pytest.approx(0.8 / 0.6)
    tangent = np.hypot(vector[0], vector[1]) / -vector[2]
    assert 153e3 * abs(tangent - np.tan(nadir)) < (0.02 if degrees < 60.0 else 0.25)


@pytest.mark.parametrize("setting", [BENT, replace(BENT, curvature=False), replace(BENT, refraction=False)])
def test_derivatives(setting: LineOfSight) -> None:
    """Against differences: near the nadir, far away, above the tropopause, at the height of the station."""
    stations = np.array([[0.0, 0.0, 3000.0], [10.0, 20.0, 9000.0], [0.0, 0.0, 13000.0], [0.0, 0.0, 800.0]])
    xyz = np.array([[1.0, 2.0, 100.0], [9000.0, 7000.0, 600.0], [9e4, 1e4, 11500.0], [500.0, 0.0, 797.0]])
    view = sight_vectors(setting, stations, xyz)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 2.0
        for analytic, one, other in (
            (view.by_point, (stations, xyz + step), (stations, xyz - step)),
            (view.by_station, (stations + step, xyz), (stations - step, xyz)),
        ):
            difference = sight_vectors(setting, *one).vector - sight_vectors(setting, *other).vector
            np.testing.assert_allclose(analytic[:, :, axis], difference / 4.0, atol=2e-8)


def bent_network() -> tuple[Network, Truth]:
    """High stations over wide terrain, simulated by ray tracing: the film sees points where their rays come from."""
    truth = Truth(
        distortion={},
        stations=((0.0, 0.0, 5000.0), (2500.0, 300.0, 5200.0), (-2400.0, 200.0, 4900.0), (100.0, 2600.0, 5100.0)),
        attitudes=((0.01, -0.02, 0.1), (-0.08, 0.3, 1.6), (-0.05, -0.29, 3.0), (-0.3, 0.03, -1.5)),
    )
    points = field_points(np.random.default_rng(3), 14, relief=1.5) * [3.0, 3.0, 150.0] + [0.0, 0.0, 400.0]
    network, _ = simulated(np.random.default_rng(3), truth, "none", points, noise=False)
    rows = network.observations
    xy = []
    for image, point in zip(rows.image, rows.point, strict=True):
        number = int(image[1:])
        xy.append(camera_point(truth, number, apparent(truth.stations[number], points[int(point)])))
    return replace(set_observations(network, xy_mm=np.array(xy)), line_of_sight=BENT), truth


def apparent(station: tuple[float, float, float], xyz: Array) -> Array:
    """A point on the straight line along which the traced ray from xyz arrives at the station."""
    plan = xyz[:2] - np.array(station[:2])
    arc = float(np.hypot(*plan))
    nadir = brentq(lambda a: traced_arc(a, station[2], xyz[2]) - arc, 0.0, 1.2, xtol=1e-12)
    return np.array(station) + 4000.0 * np.array([*(np.tan(nadir) * plan / arc), -1.0])


def test_a_block_viewed_through_the_air_over_a_round_earth() -> None:
    """Exact observations: with the corrections the truth comes out, without them heights are wrong by a metre."""
    network, truth = bent_network()
    points = np.array([[p.value for p in (point.X, point.Y, point.Z) if p] for point in network.points])
    start = rough_start(truth, "none", points)
    network = set_camera(network, principal_distance_mm=None, x0_mm=None, y0_mm=None, fiducials={})
    result = adjust(network, start)
    assert result.converged
    assert result.vpv < 1e-4  # 112 observations of 4 um
    for name, value in (("IO.K.c", truth.c), ("IO.K.x0", truth.x0), ("EO.f1.Z0", 5200.0), ("EO.f2.phi", -0.29)):
        assert abs(result.value(name) - value) < 0.01 * np.sqrt(result.cofactor_of([name])[0, 0])
    straight = adjust(replace(network, line_of_sight=LineOfSight()), start)
    assert straight.vpv > 5.0
    assert abs(straight.value("EO.f0.Z0") - 5000.0) > 0.5
    projected, visible = adjusted_image(result, "f0").camera_from_object(points)
    assert visible.all()
    rows = np.array(network.observations.image) == "f0"
    np.testing.assert_allclose(projected, network.observations.xy_mm[rows], atol=1e-3)


def test_a_free_network_under_bent_lines_of_sight() -> None:
    """Its datum is chosen as if the lines were straight, and lacking as such."""
    network, truth = bent_network()
    points = np.array([[p.value for p in (point.X, point.Y, point.Z) if p] for point in network.points])
    unknown = tuple(set_sigma(point, UNKNOWN) for point in network.points)
    network = set_camera(replace(network, points=unknown), fiducials={})
    start = rough_start(truth, "none", points)
    lacking = adjust(network, start)
    assert len(lacking.singular) == 7
    assert lacking.network.line_of_sight == BENT
    assert len(plan(network, start).singular) == 7
    minimal, free = adjust(network, start, Options("minimal")), adjust(network, start, Options("free"))
    sigma = np.sqrt(minimal.cofactor_of(["IO.K.c"])[0, 0])
    assert abs(free.value("IO.K.c") - minimal.value("IO.K.c")) < 0.01 * sigma
    assert minimal.vpv < 0.01
