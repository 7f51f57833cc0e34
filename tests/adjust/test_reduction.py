"""Coordinates of seven digits: the same network far from the origin gives the same result in as many steps."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import Truth, field_points, simulated
from studies import parametrize_with_studies

from adjust.functional_model.lens import Prior
from adjust.problem.network import Approximations, LineOfSight, Network, ObjectPoint
from adjust.problem.reduction import Reduction
from adjust.solution.adjustment import Datum, Options, adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

FAR = np.array([500_000.0, 5_400_000.0, 300.0])
GRID = 2.0**-20  # coordinates that are a multiple of it lose no digit beside FAR


def small_network(sigma: float = 0.0) -> tuple[Network, Approximations]:
    """A field of 1.6 m at 1.5 m, whose stations are known to some hundredths of a millimetre."""
    stations = tuple((0.001 * x, 0.001 * y, 0.001 * z) for x, y, z in Truth().stations)
    points = GRID * np.round(field_points(np.random.default_rng(2), 20) * 0.001 / GRID)
    free = {"k3": np.inf, "k5": np.inf}
    return simulated(np.random.default_rng(3), Truth(stations=stations), points=points, point_sigma=sigma, free=free)


def round_network(network: Network) -> Network:
    return replace(network, points=tuple(shifted_point(point, np.zeros(3)) for point in network.points))


def shifted_point(point: ObjectPoint, shift: Array) -> ObjectPoint:
    priors = zip((point.X, point.Y, point.Z), shift, strict=True)
    return ObjectPoint(
        point.id,
        *(each and Prior(GRID * round(each.value / GRID) + float(off), each.sigma) for each, off in priors),
    )


def shifted(network: Network, shift: Array) -> Network:
    return replace(network, points=tuple(shifted_point(point, shift) for point in network.points))


def sigmas_apart(here: Adjustment, there: Adjustment) -> float:
    """The largest difference of what does not move with the object, in standard deviations."""
    sigma = np.sqrt(here.cofactor.variances)
    still = [i for i, name in enumerate(here.names) if name.rsplit(".", 1)[1] not in ("X", "Y", "Z", "X0", "Y0", "Z0")]
    free = [i for i in still if sigma[i] > 0.0]
    assert np.sqrt(there.cofactor.variances[free]) == pytest.approx(sigma[free], rel=1e-6)
    return float(np.abs((there.values - here.values)[free] / sigma[free]).max())


@parametrize_with_studies(("sigma", "datum"), [(0.0, "control"), (0.0005, "control"), (np.inf, "free")])
def test_a_network_with_seven_digits_comes_to_the_same_result(sigma: float, datum: Datum) -> None:
    network = round_network(small_network(sigma)[0])
    here = adjust(network, options=Options(datum=datum))
    there = adjust(shifted(network, FAR), options=Options(datum=datum))
    assert here.converged
    assert (there.termination, there.iterations) == ("converged", here.iterations)
    assert sigmas_apart(here, there) < 1e-6
    for name in ("PT.3.X", "EO.f1.X0", "EO.f2.Y0"):
        axis = "XYZ".index(name.rsplit(".", 1)[1][0])
        assert there.value(name) - FAR[axis] == pytest.approx(here.value(name), abs=2e-9)


def test_given_approximations_are_reduced_too() -> None:
    network, start = small_network()
    network, start = round_network(network), raised(start)
    here = adjust(network, start)
    there = adjust(shifted(network, FAR), Reduction(-FAR).approximations(start))
    assert here.converged
    assert (there.termination, there.iterations) == ("converged", here.iterations)


def raised(start: Approximations) -> Approximations:
    """With stations some centimetres off."""
    exterior = {name: values + np.array([0.02, 0.0, 1.5, 0.0, 0.0, 0.0]) for name, values in start.exterior.items()}
    return replace(start, exterior=exterior)


def test_fixed_coordinates_come_back_as_they_were_given() -> None:
    network = shifted(small_network()[0], FAR + np.array([0.1, 0.2, 0.3]))
    there = adjust(network)
    given = [prior.value for point in network.points for prior in (point.X, point.Y, point.Z) if prior]
    assert [there.value(f"PT.{point.id}.{axis}") for point in network.points for axis in "XYZ"] == given
    assert there.network is network


def test_a_field_about_the_origin_is_left_as_it_is() -> None:
    network = small_network()[0]
    assert Reduction.to_centroid(network).is_none
    assert Reduction.to_centroid(network).network(network) is network


def test_heights_stay_where_the_line_of_sight_depends_on_them() -> None:
    network = shifted(small_network()[0], np.array([5e5, 5.4e6, 2500.0]))
    assert Reduction.to_centroid(network).origin[2] != 0.0
    bent = replace(network, line_of_sight=LineOfSight(curvature=True))
    assert Reduction.to_centroid(bent).origin[2] == 0.0
    assert (Reduction.to_centroid(bent).origin[:2] != 0.0).all()
