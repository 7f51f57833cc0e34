"""The datum of the object space: minimal, free, observed stations and attitudes."""

from dataclasses import replace

import numpy as np
import pytest
from networks import Truth, simulated
from numpy.typing import NDArray
from reference_cases import case_approximations, case_network, load

from adjust import Adjustment, AdjustmentError
from adjust.problem.problem import number
from adjust.rank_defect.datum import object_datum
from adjust.solution.adjustment import Options, adjust

Array = NDArray[np.float64]


def camera_part(result: Adjustment) -> tuple[Array, Array]:
    """Values and sigmas of everything that does not depend on the object datum."""
    names = [name for name in result.names if name.split(".")[0] in ("IO", "FID", "T")]
    values = np.array([result.value(name) for name in names])
    return values, np.array([result.cofactor.variances[result.index(name)] ** 0.5 for name in names])


CHOICES = (
    Options(datum="minimal"),
    Options(datum="minimal", datum_coordinates=("0.X", "0.Y", "0.Z", "1.X", "1.Y", "1.Z", "2.Z")),
    Options(datum="minimal", datum_coordinates=("3.X", "4.Y", "5.Z", "6.X", "7.Y", "8.Z", "9.X")),
    Options(datum="free"),
    Options(datum="free", datum_points=("1", "5", "7")),
)
HEIGHTS_CHOICES = (
    Options(datum="minimal"),
    Options(datum="minimal", datum_coordinates=("3.X", "4.Y", "5.X")),
    Options(datum="free"),
    Options(datum="free", datum_points=("1", "5")),
)


@pytest.mark.parametrize(("heights", "choices"), [(np.inf, CHOICES), (0.0, HEIGHTS_CHOICES), (0.02, HEIGHTS_CHOICES)])
def test_every_choice_of_the_datum_gives_the_same_calibration(heights: float, choices: tuple[Options, ...]) -> None:
    """To 1e-9 of the standard deviations, in self-calibration and with known heights only (Juhl)."""
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf, "p1": np.inf})
    points = tuple(replace(p, Z=replace(p.Z, sigma=heights)) for p in network.points if p.Z is not None)
    network = replace(network, points=points)
    results = [adjust(network, start, options) for options in choices]
    values, sigmas = camera_part(results[0])
    for result in results:
        assert result.converged
        assert result.redundancy == results[0].redundancy
        other_values, other_sigmas = camera_part(result)
        np.testing.assert_allclose((other_values - values) / np.where(sigmas > 0, sigmas, 1.0), 0.0, atol=1e-9)
        np.testing.assert_allclose(other_sigmas, sigmas, rtol=1e-9)


def test_chosen_coordinates_are_held_where_they_are_given() -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    moved = replace(start, points={name: xyz + 0.3 for name, xyz in start.points.items()})
    result = adjust(network, moved, CHOICES[2])
    for name in CHOICES[2].datum_coordinates:
        point, axis = name.split(".")
        given = getattr(network.point_by_id[point], axis).value
        assert (result.value(f"PT.{name}"), result.sigma(f"PT.{name}")) == (given, 0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (Options("minimal", ("0.X", "0.Y", "0.Z", "1.X", "1.Y", "1.Z")), ("can turn about", "leave the choice")),
        (Options("minimal", ("0.X", "0.Y", "0.Z")), ("can turn about X", "can turn about Y", "can grow or shrink")),
        (Options("minimal", (*CHOICES[1].datum_coordinates, "3.Z")), ("over-constrained", "3.Z", "7 values", "strain")),
        (Options("minimal", ("0.X", "0.Y", "0.X")), ("over-constrained", "hold 0.X already")),
        (Options("minimal", ("0.W",)), ("0.W", "12.X")),
        (Options("minimal", ("99.X",)), ("Point 99", "not among the object points")),
        (Options("free", (), ("0", "1")), ("datum points 0, 1", "can turn about")),
        (Options("free", (), ("0", "no")), ("Point no",)),
    ],
)
def test_a_datum_that_cannot_be_is_refused(options: Options, words: tuple[str, ...]) -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    with pytest.raises(AdjustmentError) as error:
        adjust(network, start, options)
    for word in words:
        assert word in str(error.value)


def test_a_flat_field_of_heights_needs_a_fourth_chosen_coordinate() -> None:
    """With noisy heights three would do formally, and noise would make the scale."""
    case = load("v_singular_H2D_vertcross_affine")
    rng = np.random.default_rng(1)
    for row, sigma in zip(case["input"]["pts_obs"], case["input"]["pts_sigma"], strict=True):
        row[2] += rng.normal(0.0, 0.02)
        sigma[2] = 0.02
    network, start = case_network(case), case_approximations(case, case["state"])
    first, last = network.points[0].id, network.points[-1].id
    with pytest.raises(AdjustmentError, match="leave datum defects of the object space"):
        adjust(network, start, Options("minimal", (f"{first}.X", f"{first}.Y", f"{last}.X")))
    four = Options("minimal", (f"{first}.X", f"{first}.Y", f"{last}.X", f"{last}.Y"))
    assert adjust(network, start, four).unknowns == adjust(network, start, Options("minimal")).unknowns


def test_a_coordinate_that_is_given_needs_no_holding() -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=0.05)
    with pytest.raises(AdjustmentError, match="X is given with the standard deviation"):
        adjust(network, start, Options("minimal", ("0.X",)))


def test_a_generator_moves_a_point_at_the_fields_root_mean_square_distance_by_one_unit() -> None:
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf)
    problem = number(network, start)
    datum = object_datum(problem, problem.start())
    points = np.array(list(start.points.values()))
    spread = np.sqrt(((points - points.mean(axis=0)) ** 2).sum() / len(points))
    assert datum.extent == pytest.approx(spread, rel=1e-9)
    positions = np.array([problem.unknowns.point[name] for name in start.points])
    motions = datum.generators[positions, 6]
    np.testing.assert_allclose(motions, (points - points.mean(axis=0)) / spread, atol=1e-9)


@pytest.mark.parametrize("carrying", [(), ("1", "5", "7")], ids=["all", "some"])
def test_inner_constraints_have_the_least_trace_and_leave_centre_turn_and_size(carrying: tuple[str, ...]) -> None:
    """The pseudo-inverse of the points' normal equations: no datum gives a smaller trace of their cofactors."""
    network, start = simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf})
    free = adjust(network, start, Options("free", datum_points=carrying))
    others = [adjust(network, start, each) for each in (CHOICES[0], CHOICES[4], CHOICES[3])]
    names = [
        f"PT.{point.id}.{axis}" for point in network.points if point.id in carrying or not carrying for axis in "XYZ"
    ]
    part = free.cofactor_of(names)
    assert all(np.trace(part) <= (1.0 + 1e-9) * np.trace(each.cofactor_of(names)) for each in others)
    assert np.trace(part) < 0.99 * np.trace(others[0].cofactor_of(names))
    values = free.values_of(names).reshape(-1, 3)
    given = np.array([start.points[name.split(".")[1]] for name in names[::3]])
    centred, change = values - values.mean(axis=0), values - given
    np.testing.assert_allclose(change.mean(axis=0), 0.0, atol=1e-8)
    np.testing.assert_allclose(np.cross(centred, change).sum(axis=0), 0.0, atol=1e-5 * np.abs(centred).max())
    assert abs((centred * change).sum()) < 1e-5 * np.abs(centred).max()
    # The seven similarity directions are exactly those that the cofactor matrix does not contain.
    directions = [np.tile(axis, len(values)) for axis in np.eye(3)]
    directions += [np.cross(axis, centred).ravel() for axis in np.eye(3)] + [centred.ravel()]
    for direction in directions:
        assert np.linalg.norm(part @ direction) < 1e-9 * np.linalg.norm(part) * np.linalg.norm(direction)
    eigenvalues = np.linalg.eigvalsh(part)
    assert eigenvalues[6] < 1e-9 * eigenvalues[7]


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
    assert np.isfinite(result.cofactor_of(result.names)).all()
    assert result.value("EO.f0.phi") == pytest.approx(half, abs=1e-6)
