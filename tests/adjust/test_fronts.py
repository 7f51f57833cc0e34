"""Large sparse networks, eliminated front by front: as the dense solution, and as what is known of chains."""

from dataclasses import replace

import numpy as np
import pytest
from null_directions import AXES
from numpy.typing import NDArray
from row_roots import row_roots
from scipy.sparse import csc_array, csr_array, eye_array, vstack
from scipy.sparse.linalg import splu
from simulated import Truth, simulated

from adjust.functional_model.lens import Prior
from adjust.least_squares.iteration import factorise, linearise
from adjust.least_squares.numbering import Numbering
from adjust.least_squares.rows import WhitenedRows, prior_root_weights
from adjust.linear_algebra import elimination, fronts, sparse_factor
from adjust.linear_algebra.elimination import eliminate
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.linear_algebra.fronts import Fronts, make_fronts
from adjust.problem.camera import Fiducial
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.problem import number
from adjust.rank_defect import diagnosis
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

LENGTH = 14


@pytest.fixture
def finely(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many fronts as an image each, however small the network."""
    monkeypatch.setattr(fronts, "FRONT_COST", 0.0)


def strip(sigma: float) -> tuple[Network, Approximations]:
    """Vertical images one after the other, of points that two or three of them show."""
    rng = np.random.default_rng(5)
    truth = Truth(
        distortion={"k3": 1e-7},
        stations=tuple((500.0 * i, 20.0 * (i % 3), 1500.0 + 15.0 * (i % 4)) for i in range(LENGTH)),
        attitudes=tuple((0.03 * (i % 3 - 1), 0.05 * (i % 2), 1.5 * (i % 2)) for i in range(LENGTH)),
        mirrored=(False,) * LENGTH,
    )
    count = 6 * LENGTH
    along = np.linspace(-200.0, 500.0 * LENGTH - 300.0, count)
    points = np.column_stack([along, rng.uniform(-600.0, 600.0, count), rng.uniform(-150.0, 150.0, count)])
    network, start = simulated(rng, truth, points=points, point_sigma=sigma, free={"k3": np.inf})
    observed = network.observations
    stations = {f"f{i}": 500.0 * i for i in range(LENGTH)}
    near = [
        kind == "fiducial" or abs(points[int(point), 0] - stations[image]) < 600.0
        for image, point, kind in zip(observed.image, observed.point, observed.kind, strict=True)
    ]
    return replace(network, observations=observed.only(np.flatnonzero(near))), start


def sparse_rows(rows: WhitenedRows, weights: Array) -> csc_array:
    """All rows, priors behind, as one sparse matrix."""
    parts = []
    for blocks in rows:
        columns = np.concatenate([blocks.own, blocks.shared], axis=1)
        for at, matrix in zip(columns, blocks.matrix, strict=True):
            where = np.repeat(np.arange(len(matrix)), len(at)), np.tile(at, len(matrix))
            parts.append(csr_array((matrix.ravel(), where), shape=(len(matrix), len(weights))))
    return csc_array(vstack([*parts, csr_array(np.diag(weights))]))


@pytest.mark.usefixtures("finely")
@pytest.mark.parametrize("summed", [False, True])
def test_a_strip_in_fronts_has_the_inverse_of_its_sparse_normal_equations(
    summed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against SuperLU: solution, variances, covariances of every image, hat matrices of every block."""
    if summed:
        monkeypatch.setattr(elimination, "REFLECTED", 0.0)
        monkeypatch.setattr(elimination, "CHEAP", 0.0)
        monkeypatch.setattr(elimination, "SAFE", 0.0)
    network, start = strip(0.05)
    problem = number(network, start)
    numbering = Numbering(problem)
    assert len(numbering.fronts) > LENGTH / 2
    assert max(front.width for front in numbering.fronts) < numbering.fronts.count / 2
    at = linearise(numbering, network.observations.covariance_mm2, problem.start())
    assert at is not None
    factor = factorise(numbering, at)

    weights = prior_root_weights(numbering)
    rows = sparse_rows(at.rows, weights)
    scale = np.sqrt(np.asarray((rows**2).sum(axis=0)).ravel())
    scaled = csc_array(rows / scale)
    inverse = splu(csc_array(scaled.T @ scaled)).solve(np.eye(len(scale)))
    sigma = np.sqrt(np.diag(inverse))
    tolerance = 1e-6 if summed else 1e-8  # of SuperLU's, whose condition is squared too
    np.testing.assert_allclose(np.sqrt(factor.variances()) * scale, sigma, rtol=tolerance)
    every = factor.function_cofactor(eye_array(len(scale), format="csr"))
    np.testing.assert_allclose(
        every * np.outer(scale, scale) / np.outer(sigma, sigma), inverse / np.outer(sigma, sigma), atol=tolerance
    )
    images = numbering.numbers[[problem.unknowns.exterior[f"f{i}"] for i in range(LENGTH)]]
    expected = inverse[images[:, :, None], images[:, None, :]]
    found = factor.cofactors(images) * scale[images][:, :, None] * scale[images][:, None, :]
    unit = sigma[images][:, :, None] * sigma[images][:, None, :]
    np.testing.assert_allclose(found / unit, expected / unit, atol=tolerance)
    for block, roots in zip(at.rows, row_roots(factor, at.rows), strict=True):
        columns = np.concatenate([block.own, block.shared], axis=1)
        matrix = block.matrix / scale[columns][:, None, :]
        expected = matrix @ inverse[columns[:, :, None], columns[:, None, :]] @ matrix.swapaxes(1, 2)
        np.testing.assert_allclose(roots @ roots.swapaxes(1, 2), expected, atol=tolerance)


def test_a_strip_is_adjusted_alike_in_many_fronts_and_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    network, start = strip(0.05)
    results = []
    for cost in (0.0, np.inf):
        monkeypatch.setattr(fronts, "FRONT_COST", cost)
        results.append(adjust(network, start))
    many, one = results
    assert many.converged
    sigmas = np.sqrt(one.cofactor.variances)
    assert (np.abs(many.values - one.values) <= 1e-7 * sigmas).all()
    np.testing.assert_allclose(np.sqrt(many.cofactor.variances), sigmas, rtol=1e-9)
    np.testing.assert_allclose(many.residuals.redundancy, one.residuals.redundancy, atol=1e-9)
    assert many.reliability is not None
    assert one.reliability is not None
    for here, there in zip(many.reliability.outer, one.reliability.outer, strict=True):
        assert here.cause == there.cause
        assert here.in_sigmas == pytest.approx(there.in_sigmas, rel=1e-7)


@pytest.mark.usefixtures("finely")
def test_null_directions_of_a_strip_in_fronts_are_named() -> None:
    """No datum in object space, none for the fiducials, four points in one image each: all are told, one by one."""
    network, start = strip(np.inf)
    free = {
        id_: Fiducial(*(Prior(prior.value, np.inf) for prior in (mark.x_mm, mark.y_mm)))
        for id_, mark in network.cameras[0].fiducials.items()
    }
    camera = replace(network.cameras[0], principal_distance_mm=None, x0_mm=None, y0_mm=None, fiducials=free)
    result = adjust(replace(network, cameras=(camera,)), start)
    of_points, motions, axes = np.split(np.array(result.singular, dtype=object), [4, 11])
    assert all("one ray" in each.cause for each in of_points)
    assert all("object space" in each.cause for each in motions)
    assert all(word in each.cause for word, each in zip(AXES, axes, strict=True))


def levelled(count: int, weight: float) -> tuple[Factor, list[Blocks]]:
    """A levelling line: differences of neighbouring heights, observed twice with unit weight, the first one given."""
    pairs = np.arange(count - 1)[:, None] + np.arange(2)
    rows = np.tile([[-1.0, 1.0]], (count - 1, 2, 1))
    blocks = [Blocks(np.empty((count - 1, 0), dtype=np.intp), pairs, rows, np.zeros((count - 1, 2)))]
    met = csr_array((np.ones(2 * (count - 1)), (np.repeat(pairs[:, 0], 2), pairs.ravel())))
    weights = np.zeros(count)
    weights[0] = weight
    of_line = make_fronts(csr_array(met.T @ met), np.ones(count, dtype=np.intp), 0)
    return eliminate(blocks, count, weights, np.zeros(count), fronts=of_line), blocks


@pytest.mark.usefixtures("finely")
@pytest.mark.parametrize("wide", [0, 500])
@pytest.mark.parametrize("weight", [1.0, 1e-6])
def test_variances_along_a_line_are_those_of_its_differences(
    weight: float, wide: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However weak its datum, which makes the heights uncertain by a million, and not what is observed."""
    monkeypatch.setattr(sparse_factor, "WIDE", wide)
    count = 400
    factor, blocks = levelled(count, weight)
    assert len(factor.triangle.fronts) == count - 1
    np.testing.assert_allclose(factor.variances(), weight**-2 + 0.5 * np.arange(count), rtol=1e-9)
    (roots,) = row_roots(factor, blocks)
    np.testing.assert_allclose(roots @ roots.swapaxes(1, 2), np.full((count - 1, 2, 2), 0.5), atol=1e-9)


def test_fronts_hold_all_that_is_met_in_elimination() -> None:
    """A ring of ten: the first and the last meet, so that the last stays in all fronts."""
    pairs = np.stack([np.arange(10), (np.arange(10) + 1) % 10], axis=1)
    met = csr_array((np.ones(20), (np.repeat(np.arange(10), 2), pairs.ravel())))
    of_ring = make_fronts(csr_array(met.T @ met), np.full(10, 50, dtype=np.intp), 3)
    assert isinstance(of_ring, Fronts)
    assert of_ring.count == 503
    for front in of_ring:
        assert 499 in front.columns
        assert 502 in front.columns


@pytest.mark.parametrize("cost", [0.0, 30.0, 300.0, 3000.0])
def test_what_a_front_leaves_is_held_by_the_next_one_that_it_meets(
    cost: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where neighbours in the order that do not meet are put together."""
    monkeypatch.setattr(fronts, "FRONT_COST", cost)
    rng = np.random.default_rng(3)
    for _ in range(20):
        met = csr_array((rng.random((60, 25)) < 0.12).astype(float))
        meeting = csr_array(met.T @ met)
        order = fronts.band_order(meeting)
        of_network = make_fronts(meeting[order][:, order], rng.integers(1, 4, 25), 2)
        for front in of_network:
            if len(front.after):
                next_one = of_network[int(of_network.home(front.after))]
                assert np.isin(front.after, next_one.columns).all()


@pytest.mark.usefixtures("finely")
def test_the_many_ways_in_which_a_strip_can_bend_are_reported_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known well stands at one end: the other end is weak in as many ways as one cares to count."""
    monkeypatch.setattr(diagnosis, "WEAK", 0.02)
    network, start = strip(50.0)
    points = [
        ObjectPoint(each.id, *(Prior(float(x)) for x in start.points[each.id])) if int(each.id) < 10 else each
        for each in network.points
    ]
    result = adjust(replace(network, points=tuple(points)), start)
    assert result.converged
    (warning,) = [text for text in result.warnings if "bend" in text]
    assert "ways" in warning
    assert "Z0" in warning
