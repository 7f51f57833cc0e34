"""Derivatives against complex steps; refraction and earth curvature against ray tracing and published formulas."""

from dataclasses import replace
from itertools import product

import cv2
import networks as nets
import numpy as np
import pytest
from dense_adjustment import distances_by_names, length, solve_densely
from faults import center_of_gravity
from numpy.typing import NDArray
from reference_cases import CAMERA, case_approximations, case_network, load, own_name
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from studies import parametrize_with_studies

from adjust import Adjustment, AdjustmentError, Camera, Distortion, Options, Prior, adjust, approximate
from adjust.functional_model.board import disk_directions
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Decentering, Lens
from adjust.functional_model.projection import EARTH_RADIUS_M, sight_vectors
from adjust.functional_model.rotation import rotation_from_vector
from adjust.problem.condition_equations import compute, computed_observations, derivatives
from adjust.problem.estimates import adjusted_image, adjusted_places
from adjust.problem.network import Board, Exterior, LineOfSight, Network, ObjectPoint, Transformation
from adjust.problem.observations import Distance
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


@parametrize_with_studies(("kind", "by_elements"), list(product(nets.KINDS, (False, True))), quick=(0, 5, 8, 10, 14))
def test_functions_by_differences_of_computed_observations(kind: Transformation, by_elements: bool) -> None:
    """F(l(x), x) = 0 defines l(x), so that dl/dx = -A^-1 B: by central differences of l for every unknown, of an image
    without a scanner and of three of one that bends, with displacements of points and of images."""
    rng = np.random.default_rng(11)
    middle_mm = nets.SCAN_MIDDLE_MM if kind != "none" else (0.0, 0.0)
    truth = nets.Truth(mirrored=(False, kind != "none", False, False), middle_mm=middle_mm)
    network, start = nets.simulated(rng, truth, kind, point_sigma=np.inf, free={"k3": np.inf, "k5": np.inf})
    network = nets.bend_in_scanner(network, {}, BEND)
    network = replace(network, images=(replace(network.images[0], scanner=""), *network.images[1:]))
    fields = [rng.normal(size=(len(network.observations), 2, axes)) for axes in (3, 2)]
    boards = (Board(name, {}, (Prior(0.2, np.inf),) * 2, each) for name, each in zip("ab", fields, strict=True))
    network = replace(network, boards=tuple(boards))
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
            np.testing.assert_allclose(analytic[own], numeric[own], 0, 3e-6 * scale + 1e-30, err_msg=names[position])


def apart(problem: Problem) -> list[list[int]]:
    """The unknowns by what they are, of all images and points: no observation depends on two of one kind."""
    groups: dict[tuple[str, str], list[int]] = {}
    for position, name in enumerate(each.text for each in problem.unknowns.parameters):
        kind = name.split(".")[0]
        groups.setdefault((name if kind == "BD" else kind, name.rsplit(".", 1)[1]), []).append(position)
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


def bent_network() -> tuple[Network, nets.Truth]:
    """High stations over wide terrain, simulated by ray tracing: the film sees points where their rays come from."""
    truth = nets.Truth(
        distortion={},
        stations=((0.0, 0.0, 5000.0), (2500.0, 300.0, 5200.0), (-2400.0, 200.0, 4900.0), (100.0, 2600.0, 5100.0)),
        attitudes=((0.01, -0.02, 0.1), (-0.08, 0.3, 1.6), (-0.05, -0.29, 3.0), (-0.3, 0.03, -1.5)),
    )
    points = nets.field_points(np.random.default_rng(3), 14, relief=1.5) * [3.0, 3.0, 150.0] + [0.0, 0.0, 400.0]
    network, _ = nets.simulated(np.random.default_rng(3), truth, "none", points, noise=False)
    rows = network.observations
    xy = []
    for image, point in zip(rows.image, rows.point, strict=True):
        number = int(image[1:])
        xy.append(nets.camera_point(truth, number, apparent(truth.stations[number], points[int(point)])))
    return replace(nets.set_observations(network, xy_mm=np.array(xy)), line_of_sight=BENT), truth


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
    start = nets.rough_start(truth, "none", points)
    network = nets.set_camera(network, principal_distance_mm=None, x0_mm=None, y0_mm=None, fiducials={})
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
    unknown = tuple(nets.set_sigma(point, nets.UNKNOWN) for point in network.points)
    network = nets.set_camera(replace(network, points=unknown), fiducials={})
    start = nets.rough_start(truth, "none", points)
    lacking = adjust(network, start)
    assert len(lacking.singular) == 7
    assert lacking.network.line_of_sight == BENT
    assert len(plan(network, start).singular) == 7
    minimal, free = adjust(network, start, Options("minimal")), adjust(network, start, Options("free"))
    sigma = np.sqrt(minimal.cofactor_of(["IO.K.c"])[0, 0])
    assert abs(free.value("IO.K.c") - minimal.value("IO.K.c")) < 0.01 * sigma
    assert minimal.vpv < 0.01


NO_INTERIOR = dict.fromkeys(("c", "x0", "y0"), np.inf)
TRUTH = nets.Truth(distortion={"k3": 1.5e-7})
EO_SIGMAS = np.array([0.3, 0.3, 0.4, 2e-4, 2e-4, 3e-4])


def relative_rotation(a: Array | tuple[float, ...], b: Array | tuple[float, ...]) -> float:
    return float(np.linalg.norm(np.asarray(a) - np.asarray(b)))


def observed_network(rng: np.random.Generator) -> tuple[Network, Array]:
    """Unknown points and no film; orientations observed, distances of all three kinds; and the points' truth."""
    points = nets.field_points(rng, 6)
    network, _ = nets.simulated(rng, TRUTH, "none", points, np.inf, free={"k3": 1e-8})
    exteriors = TRUTH.exteriors + rng.normal(0.0, EO_SIGMAS, (4, 6))
    given = {
        "f0": Exterior(exteriors[0], EO_SIGMAS),
        "f1": Exterior(exteriors[1], EO_SIGMAS),
        "f2": Exterior(exteriors[2], EO_SIGMAS),
        "f3": Exterior(exteriors[3], np.where(EO_SIGMAS < 1e-3, np.inf, EO_SIGMAS)),  # by a rotation vector
    }
    distances = (
        Distance("0", "1", relative_rotation(points[0], points[1]) + 0.02, 0.02),
        Distance("2", "4", relative_rotation(points[2], points[4]) - 0.03, 0.05),
        Distance("f0", "f2", relative_rotation(nets.STATIONS[0], nets.STATIONS[2]) + 0.1, 0.1),
        Distance("5", "f3", relative_rotation(points[5], nets.STATIONS[3]), 0.1),
    )
    return replace(nets.set_camera(nets.orient(network, given), fiducials={}), distances=distances), points


def test_observed_orientations_and_distances_as_in_a_dense_adjustment() -> None:
    network, _ = observed_network(np.random.default_rng(1))
    result = adjust(network, approximate(network))
    dense = solve_densely(network, result)
    names, sigmas = list(dense.sigmas), np.array([*dense.sigmas.values()])
    expected = np.array([dense.values[name] for name in names])
    assert np.abs((result.values_of(names) - expected) / sigmas).max() < 1e-5
    assert result.vpv == pytest.approx(dense.vpv, rel=1e-9)
    unit = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(result.cofactor_of(names) / unit, dense.cofactor / unit, atol=1e-6)
    conditions = 2 * 24 + 4 + 21 + 4
    assert (result.conditions, result.redundancy) == (conditions, conditions - len(names))
    assert dense.redundancy == result.redundancy
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(result.redundancy)
    v = [length(ends, dense.values).real - value for ends, (value, _) in distances_by_names(network).items()]
    np.testing.assert_allclose([row.v for row in result.further], v, atol=1e-6)
    assert [row.name for row in result.further] == [f"{each.start} to {each.end}" for each in network.distances]
    for row in result.further:
        assert row.w == pytest.approx(row.v / (row.sigma * np.sqrt(row.redundancy)))
        assert row.detectable == pytest.approx(4.13 * row.sigma / np.sqrt(row.redundancy), rel=1e-3)
    assert result.groups["distance"].redundancy == pytest.approx(sum(row.redundancy for row in result.further))


def scaled_by_bars(count: int) -> tuple[Network, Array]:
    """A free network of many or few points, with two scale bars."""
    rng = np.random.default_rng(5)
    points = nets.field_points(rng, count)
    network, _ = nets.simulated(rng, points=points, point_sigma=np.inf)
    bars = tuple(
        Distance(a, b, relative_rotation(points[int(a)], points[int(b)]), 0.01) for a, b in (("0", "1"), ("2", "3"))
    )
    return replace(network, distances=bars), points


def test_planned_distances_are_taken_to_be_true() -> None:
    """A plan has the cofactors of the adjustment at its values, and nothing to iterate, whatever the distances say."""
    network, points = observed_network(np.random.default_rng(1))
    start = approximate(network)
    exteriors = {f"f{i}": exterior for i, exterior in enumerate(TRUTH.exteriors)}
    values = replace(start, points={str(i): xyz for i, xyz in enumerate(points)}, exterior=exteriors)
    planned = plan(network, values).adjustment
    wrong = replace(network, distances=tuple(replace(each, value=each.value + 5.0) for each in network.distances))
    assert plan(wrong, values).adjustment.value("PT.0.X") == pytest.approx(points[0][0], abs=1e-9)
    assert all(abs(row.v) < 1e-9 for row in planned.further)
    sigma = np.sqrt(adjust(network, start).cofactor_of(["PT.0.X"])[0, 0])
    assert np.sqrt(planned.cofactor_of(["PT.0.X"])[0, 0]) == pytest.approx(sigma, rel=0.01)


@parametrize_with_studies("count", [9, 24])
def test_a_scale_bar_removes_the_scale_defect(count: int) -> None:
    """Whether images or points are eliminated first; the camera is that of the free network, the size that of the bars.

    One bar is no check of the network, two check each other.
    """
    network, points = scaled_by_bars(count)
    _, start = nets.simulated(np.random.default_rng(5), points=points, point_sigma=np.inf)
    causes = [null.cause for null in adjust(network, start).singular]
    assert len(causes) == 6
    assert not any("grow" in cause for cause in causes)
    free = adjust(replace(network, distances=()), start, Options("free"))
    one = adjust(replace(network, distances=network.distances[:1]), start, Options("free"))
    two = adjust(network, start, Options("free"))
    assert one.vpv == pytest.approx(free.vpv, rel=1e-9)
    assert one.redundancy == free.redundancy
    assert one.further[0].redundancy == pytest.approx(0.0, abs=1e-7)
    assert (one.further[0].w, one.further[0].detectable) == (0.0, np.inf)
    assert two.redundancy == free.redundancy + 1
    assert camera(one) == pytest.approx(camera(free), rel=1e-9)
    size = relative_rotation(*(np.array([one.value(f"PT.{id}.{axis}") for axis in "XYZ"]) for id in "01"))
    assert size == pytest.approx(network.distances[0].value, abs=1e-7)


def camera(result: Adjustment) -> list[float]:
    names = [name for name in result.names if name.startswith(("IO.", "FID."))]
    return [result.value(name) for name in names] + [result.cofactor_of([name])[0, 0] for name in names]


def test_approximations_of_a_model_have_the_size_of_the_distances() -> None:
    """Nothing known but a distance: the model's arbitrary base is scaled, and the adjustment finds the truth."""
    network, points = scaled_by_bars(24)
    network = nets.free_points(network, network.point_by_id)
    start = approximate(network)
    assert relative_rotation(start.points["4"], start.points["5"]) == pytest.approx(
        relative_rotation(points[4], points[5]), rel=0.02
    )
    result = adjust(network, start, Options("free"))
    assert result.converged
    found = relative_rotation(*(np.array([result.value(f"PT.{id}.{axis}") for axis in "XYZ"]) for id in "45"))
    assert found == pytest.approx(relative_rotation(points[4], points[5]), abs=0.1)


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


def test_a_singular_network_still_determines_the_rest() -> None:
    """Juhl's field of known heights: not c, x0', y0', but all nine deformations as if these were known."""
    case = load("ii_juhl_3photos")
    network, values = case_network(case), case_approximations(case, case["truth"])
    regular, singular = plan(network, values), plan(nets.give_values(network, NO_INTERIOR), values)
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


def test_a_point_behind_the_camera_is_reported() -> None:
    network, values = nets.simulated(np.random.default_rng(1))
    away = {**values.exterior, "f2": values.exterior["f2"] + np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0])}
    with pytest.raises(AdjustmentError, match=r"cannot be planned: point \d+ lies behind the camera in image f2"):
        plan(network, replace(values, exterior=away))


COLUMNS, ROWS, SPACING_MM = 10, 7, 30.0
BENDS_MM = np.array([0.9, -0.5])
SIGMA_MM = 0.0005
C_MM, K1 = 20.0, -0.08
TURNS = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.3), (-0.5, 0.1, 1.2), (0.1, 0.55, -0.7), (0.0, -0.5, 2.0), (0.4, -0.4, -2.1)]


def flat_board() -> Array:
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    return np.stack([SPACING_MM * x.ravel(), SPACING_MM * y.ravel(), np.zeros(x.size)], axis=1)


def bent_board() -> Array:
    """4 k (t - t²) along each axis, t from 0 to 1, as mrcal's ref_calibration_object says."""
    board = flat_board()
    t = board[:, :2] / (SPACING_MM * np.array([COLUMNS - 1, ROWS - 1]))
    board[:, 2] = 4.0 * (t - t**2) @ BENDS_MM
    return board


def make_network(rng: np.random.Generator | None, turned: Array | None = None, bent: bool = True) -> Network:
    """Six views by OpenCV of the bent board; turned (3, 3): how the board lies in the object's axes."""
    turn = np.eye(3) if turned is None else turned
    flat, real = flat_board(), bent_board()
    middle = flat.mean(axis=0)
    places = []
    for angles in TURNS:
        rotation = Rotation.from_euler("xyz", angles).as_matrix()
        shift = np.array([0.0, 0.0, 420.0]) - rotation @ middle
        matrix = np.array([[C_MM, 0.0, 0.1], [0.0, C_MM, 0.05], [0.0, 0.0, 1.0]])
        projected, _ = cv2.projectPoints(real, cv2.Rodrigues(rotation)[0], shift, matrix, np.array([K1, 0.0, 0.0, 0.0]))
        places.append(np.reshape(projected, (-1, 2)) * [1.0, -1.0])
    views = np.array(places)
    views = views if rng is None else views + rng.normal(0.0, SIGMA_MM, views.shape)
    points = {f"p{k}": turn @ place for k, place in enumerate(flat)}
    camera = Camera("C", Prior(20.5, np.inf), None, None, Distortion("opencv", {"k1": Prior(0.0, np.inf)}))
    network = nets.digital_network(camera, nets.view_rows(views, list(points)), points, SIGMA_MM)
    return replace(network, boards=(Board("board", points),) if bent else ())


def bends(found: Adjustment) -> Array:
    return np.array([found.value("BD.board.bend_x"), found.value("BD.board.bend_y")])


def test_the_bends_of_exact_views_are_found() -> None:
    network = make_network(None)
    found = adjust(network, approximate(network))
    assert found.converged
    np.testing.assert_allclose(bends(found), BENDS_MM, atol=1e-7)
    assert found.value("IO.C.c") == pytest.approx(C_MM, abs=1e-7)
    np.testing.assert_allclose(adjusted_places(found, [f"p{k}" for k in range(70)]), bent_board(), atol=1e-6)
    flat = adjust(make_network(None, bent=False), approximate(network))
    assert flat.sigma0 > 5.0  # without them the board does not fit


@pytest.mark.parametrize("turn", [(0.0, 90.0, 0.0), (40.0, -25.0, 70.0), (10.0, 20.0, -30.0)])
def test_a_board_lies_anyhow_in_the_object(turn: tuple[float, float, float]) -> None:
    """The same images, the board on another plane and turned in it: the same places but for that turn."""
    turned = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    found = adjust(make_network(None, turned), approximate(make_network(None, turned)))
    places = adjusted_places(found, [f"p{k}" for k in range(70)])
    np.testing.assert_allclose(places, bent_board() @ turned.T, atol=1e-6)
    assert found.vpv < 1e-10


def test_the_centre_of_gravity_of_an_imaged_disk() -> None:
    """By an outline of 400 points through OpenCV's strong lens."""
    rotation, shift, radius = np.array([0.5, -0.3, 0.2]), np.array([10.0, 20.0, 400.0]), 3.0
    lens, matrix = np.array([-0.3, 0.1, 2e-3, -1e-3]), np.diag([C_MM, C_MM, 1.0])
    centres, angles = flat_board() - [100.0, 60.0, 0.0], np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)

    def image(points: Array) -> Array:
        return np.reshape(
            cv2.projectPoints(points.reshape(-1, 3), rotation, shift, matrix, lens)[0], (*points.shape[:-1], 2)
        )

    circle = radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    gravity = center_of_gravity(image(centres[:, None] + circle))
    axes = np.eye(3)[:2]
    at = {(i, j): image(centres + radius * (np.array([i, j]) @ axes)) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    moved = image(centres + radius**2 * disk_directions(at, axes, radius)[:, 0])
    np.testing.assert_allclose(moved - at[0, 0], gravity - at[0, 0], atol=0.01 * np.abs(gravity - at[0, 0]).max())


def test_what_is_no_board_is_refused() -> None:
    network = make_network(None)
    unknown = replace(network, points=(ObjectPoint("p0", None, None, None), *network.points[1:]))
    with pytest.raises(AdjustmentError, match="point p0 of board board is not known"):
        adjust(unknown, approximate(network))
    twice = replace(network, boards=(*network.boards, Board("other", dict(network.boards[0].places))))
    with pytest.raises(AdjustmentError, match="is on the boards board and other"):
        adjust(twice, approximate(network))
