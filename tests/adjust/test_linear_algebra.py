"""The elimination, by blocks and by fronts, against dense solutions of the same rows."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from dense_adjustment import row_roots
from faults import AXES
from networks import Truth, field_points, keep_rows, set_prior, simulated
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, eye_array, vstack
from scipy.sparse.linalg import splu

from adjust import Approximations, Network, adjust
from adjust.least_squares.equations import Numbering, WhitenedRows, prior_root_weights
from adjust.least_squares.iteration import Linearised, factorise, linearise
from adjust.linear_algebra import elimination, sparse_factor
from adjust.linear_algebra.elimination import eliminate
from adjust.linear_algebra.factor import Blocks, Factor
from adjust.linear_algebra.sparse_factor import make_fronts
from adjust.problem.problem import number

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
    monkeypatch.setattr(elimination, "reflect_fronts", lambda *_: reflected.append(True))
    factor = factorise(numbering, at)
    assert not reflected
    sigmas = np.sqrt(by_reflections.variances())
    np.testing.assert_allclose(factor.solution / sigmas, by_reflections.solution / sigmas, atol=1e-8)
    expected = whole(by_reflections) / np.outer(sigmas, sigmas)
    np.testing.assert_allclose(whole(factor) / np.outer(sigmas, sigmas), expected, atol=1e-8)
    assert factor.length() == pytest.approx(by_reflections.length(), rel=1e-10)


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
    other = adjust(
        replace(network, images=network.images[::-1], points=network.points[::-1], observations=rows.only(order)), start
    )
    sigmas = np.sqrt(first.cofactor.variances)
    for i, name in enumerate(first.names):
        assert abs(other.value(name) - first.values[i]) <= 1e-7 * sigmas[i]
        assert other.sigma(name) / other.sigma0 == pytest.approx(sigmas[i], rel=1e-7)
    np.testing.assert_allclose(other.residuals.w, first.residuals.w[order], atol=1e-6)


LENGTH = 14


@pytest.fixture
def finely(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many fronts as an image each, however small the network."""
    monkeypatch.setattr(sparse_factor, "FRONT_COST", 0.0)


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

    def is_near(image: str, point: str, kind: str) -> bool:
        return kind == "fiducial" or abs(points[int(point), 0] - 500.0 * int(image[1:])) < 600.0

    return keep_rows(network, is_near), start


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
def test_a_strip_in_fronts_has_its_sparse_inverse(summed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.usefixtures("finely")
def test_null_directions_of_a_strip_in_fronts_are_named() -> None:
    """No datum in object space, none for the fiducials, four points in one image each: all are told, one by one."""
    network, start = strip(np.inf)
    result = adjust(set_prior(network, np.inf), start)
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
def test_variances_along_a_line_by_its_differences(weight: float, wide: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """However weak its datum, which makes the heights uncertain by a million, and not what is observed."""
    monkeypatch.setattr(sparse_factor, "WIDE", wide)
    count = 400
    factor, blocks = levelled(count, weight)
    assert len(factor.triangle.fronts) == count - 1
    np.testing.assert_allclose(factor.variances(), weight**-2 + 0.5 * np.arange(count), rtol=1e-9)
    (roots,) = row_roots(factor, blocks)
    np.testing.assert_allclose(roots @ roots.swapaxes(1, 2), np.full((count - 1, 2, 2), 0.5), atol=1e-9)


def test_derivatives_before_a_negligible_last_step_give_the_standard_deviations() -> None:
    network, start = simulated(np.random.default_rng(0), free={"k3": np.inf})
    run = adjust(network, start).run
    end, covariance = run.end, network.observations.covariance_mm2
    assert end.factor_nearby is not None
    fresh = linearise(run.numbering, covariance, end.state)
    assert fresh is not None
    np.testing.assert_allclose(end.v_mm, fresh.v_mm, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(end.factor.variances(), fresh.factor.variances(), rtol=1e-9)
    assert fresh.factor.length() < 1e-9  # of the next step, in standard deviations
    assert abs(end.vpv / fresh.vpv - 1.0) < 1e-9
