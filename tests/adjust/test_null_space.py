"""Null vectors of large factors: found by iteration with the triangle, as by a full decomposition."""

import numpy as np
import pytest
from null_directions import AXES, DEFORMATIONS, DISTANCE, POINT
from setups import UNKNOWN, Array, Setup, vertical
from simulated import field_points

from adjust.linear_algebra.factor import BlockFactors, DenseBlocks, Factor
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.sparse_factor import Triangle
from adjust.rank_defect import null_space
from adjust.solution.adjustment import Options, adjust


def triangle(rng: np.random.Generator, singular: Array) -> Array:
    """A triangle with some singular values."""
    count = len(singular)
    left, right = (np.linalg.qr(rng.normal(size=(count, count)))[0] for _ in range(2))
    return np.asarray(np.linalg.qr(left @ np.diag(singular) @ right, mode="r"))


def factorise(shared: Array, *blocks: BlockFactors) -> Factor:
    count = len(shared) + sum(block.own.size for block in blocks)
    dense = Triangle(Fronts.single(len(shared)), (shared,), (np.zeros((len(shared), 0)),))
    return Factor(DenseBlocks(blocks), dense, np.zeros(len(shared)), np.ones(count))


@pytest.mark.parametrize("below", [null_space.SINGULAR, 1e-4])
@pytest.mark.parametrize(
    "small", [(), (1e-16,) * 9, (1e-17, 1e-16, 1e-6, 3e-5, 9e-5), tuple(np.geomspace(1e-6, 1e-3, 60))]
)
def test_small_singular_values_are_found_one_and_all(small: tuple[float, ...], below: float) -> None:
    """Also more of them than are iterated at first, and next to others that are hardly larger."""
    rng = np.random.default_rng(1)
    count = 2 * null_space.DENSE
    singular = np.array([*small, *np.geomspace(2e-3, 1.0, count - len(small))])
    shared = triangle(rng, singular)
    vectors, view = null_space.null_space(factorise(shared), [], below)
    expected = np.sort(singular[singular <= below])
    assert len(view) == len(expected)
    np.testing.assert_allclose(np.sort(view), expected, rtol=0.02, atol=1e-14)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(view)), atol=1e-12)
    assert np.linalg.norm(shared @ vectors, axis=0).max(initial=0.0) <= below


def test_a_block_without_its_own_determination_lends_its_rows_to_the_shared() -> None:
    """One unknown of the block is seen by no row; the row it leaves over then determines the first shared unknown."""
    shared = np.diag([0.0, 1.0])
    own = np.array([[1.0, 0.0], [0.0, 0.0]])
    border = np.array([[0.0, 0.5], [0.7, 0.0]])
    block = BlockFactors(np.array([[2, 3]]), np.array([[0, 1]]), own[None], border[None], np.zeros((1, 2)))
    found = null_space.null_vectors(factorise(shared, block))
    np.testing.assert_allclose(np.abs(found), [[0.0], [0.0], [0.0], [1.0]], atol=1e-12)


def test_a_network_of_many_images_is_named_like_a_small_one() -> None:
    """Sixteen parallel images of a hundred unknown points: 205 shared unknowns, nine null directions as with four."""
    rng = np.random.default_rng(2)
    stations = tuple((300.0 * (i % 4) - 450.0, 300.0 * (i // 4) - 450.0, 1500.0 + 10.0 * i) for i in range(16))
    setup = Setup(vertical(*[0.0] * 16), stations, points=field_points(rng, 100), sigma=UNKNOWN)
    result = adjust(*setup.network(), Options(datum="minimal"))
    words = (*AXES, *DEFORMATIONS, *POINT, *DISTANCE)
    assert len(result.singular) == len(words)
    assert all(word in each.cause for word, each in zip(words, result.singular, strict=True))
