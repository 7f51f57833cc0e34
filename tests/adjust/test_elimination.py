"""The blockwise elimination against a dense solution of the same rows."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from row_roots import row_roots
from scipy.sparse import eye_array
from simulated import Truth, field_points, simulated

from adjust.least_squares.iteration import Linearised, factorise, linearise
from adjust.least_squares.numbering import Numbering
from adjust.least_squares.rows import prior_root_weights
from adjust.linear_algebra import elimination, sparse_factor
from adjust.linear_algebra.elimination import eliminate
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.problem.network import Approximations, Network
from adjust.problem.problem import number
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

SHARED, OWN, IMAGES = 7, 4, 5
COUNT = SHARED + OWN * IMAGES


def random_blocks(rng: np.random.Generator) -> list[Blocks]:
    """Blocks of columns of very different size; one sees little of what is shared, one has fewer rows than columns."""
    own = SHARED + np.arange(OWN * IMAGES).reshape(IMAGES, OWN)
    blocks = []
    for members, rows, width in (([0], 20, 2), ([1], 5, 5), ([2, 3, 4], 20, 5)):
        shared = np.array([np.sort(rng.permutation(SHARED)[:width]) for _ in members])
        matrix = rng.normal(size=(len(members), rows, OWN + width))
        matrix *= 10.0 ** rng.integers(-4, 5, (len(members), 1, OWN + width))
        blocks.append(Blocks(own[members], shared, matrix, rng.normal(size=(len(members), rows))))
    return blocks


def single(own: NDArray[np.intp], shared: NDArray[np.intp], matrix: Array, right: Array) -> Blocks:
    """One block alone."""
    return Blocks(own[None], shared[None], matrix[None], right[None])


def dense(blocks: Iterable[Blocks], weight: Array, right: Array) -> tuple[Array, Array]:
    """All rows, priors included, as one matrix."""
    rows = [np.diag(weight)]
    rights = [right]
    for block in blocks:
        for own, shared, matrix, of_block in zip(block.own, block.shared, block.matrix, block.right, strict=True):
            wide = np.zeros((len(matrix), len(weight)))
            wide[:, np.concatenate([own, shared])] = matrix
            rows.append(wide)
            rights.append(of_block)
    return np.vstack(rows), np.concatenate(rights)


def whole(factor: Factor) -> Array:
    """The cofactor matrix of all unknowns."""
    return factor.function_cofactor(eye_array(len(factor.scale), format="csr"))


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_it_is_the_dense_least_squares_solution(damping: float) -> None:
    rng = np.random.default_rng(1)
    blocks = random_blocks(rng)
    weight = np.where(np.arange(COUNT) % 3 == 0, rng.uniform(0.1, 5.0, COUNT), 0.0)
    right = weight * rng.normal(size=COUNT)
    factor = eliminate(blocks, COUNT, weight, right, damping)
    matrix, observed = dense(blocks, weight, right)
    scale = np.linalg.norm(matrix, axis=0)
    damped = np.vstack([matrix / scale, np.sqrt(damping) * np.eye(COUNT)])
    expected, *_ = np.linalg.lstsq(damped, np.concatenate([observed, np.zeros(COUNT)]))
    np.testing.assert_allclose(factor.solution * scale, expected, rtol=1e-9, atol=1e-12)

    cofactor = np.linalg.inv(damped.T @ damped)
    np.testing.assert_allclose(whole(factor) * np.outer(scale, scale), cofactor, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(factor.variances(), np.diag(whole(factor)), rtol=1e-12)
    right_sides = rng.normal(size=(COUNT, 3))
    times = factor.cofactor_times(right_sides * scale[:, None]) * scale[:, None]
    np.testing.assert_allclose(times, cofactor @ right_sides, rtol=1e-7, atol=1e-10)
    for block, roots in zip(blocks, row_roots(factor, blocks), strict=True):
        for own, shared, rows, root in zip(block.own, block.shared, block.matrix, roots, strict=True):
            columns = np.concatenate([own, shared])
            scaled = rows / scale[columns]
            expected_rows = scaled @ cofactor[np.ix_(columns, columns)] @ scaled.T
            np.testing.assert_allclose(root @ root.T, expected_rows, atol=1e-9)


def test_the_condition_is_not_squared() -> None:
    """Two shared columns alike but for 1e-10: the normal equations cannot tell them apart, the rows can."""
    rng = np.random.default_rng(2)
    column = rng.normal(size=(40, 1))
    other = rng.normal(size=(40, 1))
    matrix = np.hstack([rng.normal(size=(40, 2)), column, column + 1e-10 * other])
    truth = np.array([1.0, -2.0, 3.0, 4.0])
    block = single(np.array([2, 3]), np.array([0, 1]), matrix, matrix @ truth)
    factor = eliminate([block], 4, np.zeros(4), np.zeros(4))
    np.testing.assert_allclose(factor.solution, truth[[2, 3, 0, 1]], atol=1e-4)


def test_all_shared_unknowns_fixed() -> None:
    rng = np.random.default_rng(3)
    matrix = rng.normal(size=(10, 3))
    block = single(np.arange(3), np.empty(0, dtype=np.intp), matrix, matrix @ np.array([1.0, 2.0, 3.0]))
    factor = eliminate([block], 3, np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(factor.solution, [1.0, 2.0, 3.0], rtol=1e-12)
    np.testing.assert_allclose(whole(factor), np.linalg.inv(matrix.T @ matrix), rtol=1e-10)


@pytest.fixture
def cost(monkeypatch: pytest.MonkeyPatch) -> Callable[[Network, Approximations], float]:
    """Of an adjustment, a step: rows times columns squared of every factorisation, counted and not timed."""
    costs: list[float] = []
    original = sparse_factor.qr_triangle

    def counted(rows: Array) -> Array:
        costs.append(rows.size * rows.shape[-1])
        return original(rows)

    monkeypatch.setattr(elimination, "qr_triangle", counted)
    monkeypatch.setattr(sparse_factor, "qr_triangle", counted)

    def log_determinant(network: Network, start: Approximations) -> float:
        costs.clear()
        result = adjust(network, start)
        assert result.converged
        return sum(costs) / result.iterations

    return log_determinant


def test_the_cost_is_linear_in_the_images(cost: Callable[[Network, Approximations], float]) -> None:
    """With known points."""

    def images(count: int) -> tuple[Network, Approximations]:
        rng = np.random.default_rng(4)
        angles = np.linspace(0.0, 6.0, count)
        truth = Truth(
            stations=tuple((400 * np.cos(a), 400 * np.sin(a), 1500.0) for a in angles),
            attitudes=tuple((-0.25 * np.sin(a), 0.25 * np.cos(a), a) for a in angles),
            mirrored=(False,) * count,
        )
        return simulated(rng, truth, points=field_points(rng, 8), noise=False)

    assert cost(*images(24)) < 2.2 * cost(*images(12))


def test_the_cost_is_linear_in_unknown_points(cost: Callable[[Network, Approximations], float]) -> None:
    def points(count: int) -> tuple[Network, Approximations]:
        rng = np.random.default_rng(4)
        return simulated(rng, points=field_points(rng, count), point_sigma=0.05, noise=False)

    assert cost(*points(160)) < 2.2 * cost(*points(80))


@pytest.mark.parametrize(("count", "own"), [(18, {0, 3}), (9, {12})])
def test_points_or_images_are_eliminated_first(count: int, own: set[int]) -> None:
    """Whichever has more unknowns; either way the cofactors are the inverse of the dense normal equations."""
    rng = np.random.default_rng(12)
    network, start = simulated(rng, points=field_points(rng, count), point_sigma=0.05, free={"k3": np.inf})
    problem = number(network, start)
    numbering = Numbering(problem)
    assert {touched.own.shape[1] for touched in numbering.touched} == own
    at = linearise(numbering, network.observations.covariance_mm2, problem.start())
    assert at is not None
    weights = prior_root_weights(numbering)
    matrix, _ = dense(at.rows, weights, np.zeros(len(weights)))
    assert matrix.shape == (2 * len(network.observations) + len(weights), len(numbering.free))
    normal = matrix.T @ matrix
    scale = np.sqrt(np.diag(normal))
    expected = np.linalg.inv(normal / np.outer(scale, scale))
    cofactor = whole(factorise(numbering, at)) * np.outer(scale, scale)
    np.testing.assert_allclose(cofactor, expected, atol=1e-6 * np.abs(expected).max())


def linearised(count: int, point_sigma: float = 0.05) -> tuple[Numbering, Linearised]:
    """A network with unknown points, where it starts."""
    rng = np.random.default_rng(12)
    network, start = simulated(rng, points=field_points(rng, count), point_sigma=point_sigma, free={"k3": np.inf})
    problem = number(network, start)
    at = linearise(numbering := Numbering(problem), network.observations.covariance_mm2, problem.start())
    assert at is not None
    return numbering, at


@pytest.mark.parametrize("count", [18, 9])
def test_normal_equations_give_what_reflections_give(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the network is well conditioned; points or images eliminated first."""
    numbering, at = linearised(count)
    by_reflections = factorise(numbering, at)
    monkeypatch.setattr(elimination, "REFLECTED", 0.0)
    monkeypatch.setattr(elimination, "CHEAP", 0.0)
    reflected = []
    monkeypatch.setattr(elimination, "_eliminate_blocks", lambda *_: reflected.append(True))
    factor = factorise(numbering, at)
    assert not reflected
    sigmas = np.sqrt(by_reflections.variances())
    np.testing.assert_allclose(factor.solution / sigmas, by_reflections.solution / sigmas, atol=1e-8)
    expected = whole(by_reflections) / np.outer(sigmas, sigmas)
    np.testing.assert_allclose(whole(factor) / np.outer(sigmas, sigmas), expected, atol=1e-8)
    assert factor.length() == pytest.approx(by_reflections.length(), rel=1e-10)


def test_what_is_cheap_to_reflect_is_squared_only_where_that_costs_no_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    numbering, at = linearised(18)
    exact = factorise(numbering, at).variances()
    monkeypatch.setattr(elimination, "CHEAP", 0.0)
    monkeypatch.setattr(elimination, "TEN_DIGITS", 1e-6)
    squared = factorise(numbering, at).variances()
    assert not np.array_equal(squared, exact)
    np.testing.assert_allclose(squared, exact, rtol=1e-6)
    monkeypatch.setattr(elimination, "TEN_DIGITS", 1.0)  # as if the condition were worse
    np.testing.assert_allclose(factorise(numbering, at).variances(), exact, rtol=1e-10)


def test_roots_of_cofactors_are_local_where_many_unknowns_are_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    numbering, at = linearised(18)
    factor = factorise(numbering, at)
    wide, variances = list(row_roots(factor, at.rows)), factor.variances()
    monkeypatch.setattr(sparse_factor, "WIDE", 0)
    np.testing.assert_allclose(factor.variances(), variances, rtol=1e-9)
    for here, there in zip(row_roots(factor, at.rows), wide, strict=True):
        np.testing.assert_allclose(here @ here.swapaxes(1, 2), there @ there.swapaxes(1, 2), atol=1e-9)


def test_what_is_badly_conditioned_is_reflected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a datum the normal equations of the images are singular: the factor is that of the rows themselves."""
    numbering, at = linearised(18, np.inf)
    expected = factorise(numbering, at)
    monkeypatch.setattr(elimination, "REFLECTED", 0.0)
    monkeypatch.setattr(elimination, "CHEAP", 0.0)
    rows, reflected = expected.triangle.toarray(), factorise(numbering, at).triangle.toarray()
    np.testing.assert_allclose(reflected.T @ reflected, rows.T @ rows, atol=1e-14)
    assert np.linalg.svd(reflected)[1][-1] < 1e-14
    rough = factorise(numbering, at, camera_priors=False)
    assert np.linalg.svd(rough.triangle.toarray())[1][-7:] == pytest.approx(np.full(7, 1e-6), rel=0.01)


def test_large_networks_are_adjusted_alike_whatever_the_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """By normal equations: the same bits again, and the same to rounding from observations in another order."""
    monkeypatch.setattr(elimination, "REFLECTED", 0.0)
    monkeypatch.setattr(elimination, "CHEAP", 0.0)
    monkeypatch.setattr(sparse_factor, "WIDE", 0)
    rng = np.random.default_rng(12)
    network, start = simulated(rng, points=field_points(rng, 18), point_sigma=0.05, free={"k3": np.inf})
    first, again = adjust(network, start), adjust(network, start)
    np.testing.assert_array_equal(again.values, first.values)
    np.testing.assert_array_equal(again.cofactor.variances, first.cofactor.variances)
    np.testing.assert_array_equal(again.residuals.w, first.residuals.w)

    rows = network.observations
    order = rng.permutation(len(rows))
    other = adjust(replace(network, images=network.images[::-1], observations=rows.only(order)), start)
    sigmas = np.sqrt(first.cofactor.variances)
    for i, name in enumerate(first.names):
        assert abs(other.value(name) - first.values[i]) <= 1e-7 * sigmas[i]
        assert other.sigma(name) / other.sigma0 == pytest.approx(sigmas[i], rel=1e-7)
    np.testing.assert_allclose(other.residuals.w, first.residuals.w[order], atol=1e-6)
