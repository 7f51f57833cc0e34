"""The compiled loops against what numpy and scipy do in their place."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import field_points, simulated
from numpy.typing import NDArray
from plain_environment import NO_COMPILER
from reference_cases import CASES, case_approximations, case_network, load

import compiled
from adjust.functional_model.projection import LineOfSight
from adjust.linear_algebra import elimination, sparse_factor
from adjust.linear_algebra.elimination import eliminate_blocks
from adjust.linear_algebra.factor import Blocks
from adjust.linear_algebra.normal_equations import SharedEquations, SparseRows, SparsityPattern
from adjust.linear_algebra.sparse_factor import Fronts, Triangle
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment
from measure.marks import rendering
from measure.marks.shapes import Disk, MarkShape, Polygon, cross, ring_cross
from pipeline.cli import DONE, run
from pipeline.resampling.resample_stage import Degree, spline_samples

WEDGE = MarkShape((Polygon(((0.0, 0.0), (0.9, 0.2), (0.8, 0.6))), Disk((-0.4, 0.1), 0.3)))
needs_kernels = pytest.mark.skipif(compiled.kernels is None, reason=NO_COMPILER)
Samples = NDArray[np.uint8 | np.uint16]


def picture(dtype: type[np.uint8] | type[np.uint16]) -> Samples:
    """Noise over the whole range: a spline throws beyond what can be stored."""
    return np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (40, 57), endpoint=True).astype(dtype)


def places() -> NDArray[np.float64]:
    """(2, n) inside, at the edges, half a pixel beyond them, and on pixels."""
    rng = np.random.default_rng(2)
    row, column = rng.uniform(-0.5, 39.5, 5000), rng.uniform(-0.5, 56.5, 5000)
    return np.stack([np.append(row, [0.0, 39.0, -0.5, 39.5, 7.0]), np.append(column, [0.0, 56.0, 56.5, -0.5, 9.0])])


@needs_kernels
@pytest.mark.parametrize("degree", [3, 5])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_splines(degree: Degree, dtype: type[np.uint8] | type[np.uint16], monkeypatch: pytest.MonkeyPatch) -> None:
    samples, clamped = spline_samples(picture(dtype), places(), degree, dtype)
    monkeypatch.setattr(compiled, "kernels", None)
    expected, by_scipy = spline_samples(picture(dtype), places(), degree, dtype)
    assert samples.dtype == expected.dtype == dtype
    assert np.abs(samples.astype(int) - expected).max() <= 1
    assert np.count_nonzero(samples != expected) <= 2  # halves that rounding errors decide
    assert clamped == by_scipy > 100


@pytest.mark.parametrize("degree", [3, 5])
def test_a_spline_goes_through_the_pixels(degree: Degree) -> None:
    given = picture(np.uint16)
    rows, columns = np.indices(given.shape, dtype=float)
    samples, _ = spline_samples(given, np.stack([rows.ravel(), columns.ravel()]), degree, np.uint16)
    np.testing.assert_array_equal(samples.reshape(given.shape), given)


@needs_kernels
def test_buffers_of_other_sizes_are_refused() -> None:
    assert compiled.kernels is not None
    coefficients, at, samples = np.zeros((9, 9)), np.zeros(4), np.zeros(4, np.uint16)
    call = compiled.kernels.spline_samples
    assert call(coefficients, 9, at, at, 5, samples) == 0
    for wrong in ((coefficients, 8, at, at, 5, samples), (coefficients, 9, at, at[1:], 5, samples)):
        with pytest.raises(ValueError, match="do not go together"):
            call(*wrong)
    for degree, out in ((4, samples), (5, np.zeros(4)), (5, np.zeros(3, np.uint16))):
        with pytest.raises(ValueError, match="do not go together"):
            call(coefficients, 9, at, at, degree, out)


@needs_kernels
@pytest.mark.parametrize("blur_px", [0.0, 0.4, 2.0])
@pytest.mark.parametrize("mark", [MarkShape(cross(0.9, 0.05)), MarkShape(ring_cross(0.4, 0.1, 0.7, 0.1)), WEDGE])
@pytest.mark.parametrize("place_px", [(40.3, 44.8), (2.1, 80.7), (-30.0, 30.0), (-300.0, 30.0)])
def test_drawings(
    mark: MarkShape, place_px: tuple[float, float], blur_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole in the window, cut off by its border, and outside of it."""
    place = np.column_stack([np.array([[40.0, 11.0], [9.0, -41.0]]), place_px])
    rendering._sharp_cells.cache_clear()
    cells, shown = (
        rendering.cell_coverage(mark, np.abs(place), 90, 85, 3),
        rendering.render(mark, place, 90, 85, blur_px),
    )
    monkeypatch.setattr(compiled, "kernels", None)
    rendering._sharp_cells.cache_clear()
    np.testing.assert_allclose(cells, rendering.cell_coverage(mark, np.abs(place), 90, 85, 3), rtol=0, atol=1e-6)
    expected = rendering.render(mark, place, 90, 85, blur_px)
    for name, image in vars(expected).items():
        np.testing.assert_allclose(getattr(shown, name), image, rtol=0, atol=2e-6 * np.abs(image).max(), err_msg=name)


@needs_kernels
def test_drawings_of_other_sizes_are_refused() -> None:
    assert compiled.kernels is not None
    line, first, cells = np.zeros((4, 2)), np.array([0, 4]), np.zeros((6, 8), np.float32)
    taps, images = np.zeros((2, 3, 5), np.float32), np.zeros((6, 3, 4), np.float32)
    for lines in ((line, line[1:], first, cells, 8), (line, line, first[:1], cells, 8), (line, line, first, cells, 9)):
        with pytest.raises(ValueError, match="do not go together"):
            compiled.kernels.cover_cells(*lines)
    compiled.kernels.blurred_images(cells, 8, taps, 3, (0, 0), 2, images, 4)
    for columns, orders, width in ((9, 3, 4), (8, 2, 4), (8, 3, 5)):
        with pytest.raises(ValueError, match="do not go together"):
            compiled.kernels.blurred_images(cells, columns, taps, orders, (0, 0), 2, images, width)


@pytest.mark.parametrize("there", [True, False])
def test_the_version(there: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(compiled, "kernels", object() if there else None)
    assert run(["--version"]) == DONE
    assert ("with compiled loops" if there else "without compiled loops") in capsys.readouterr().out


def sparse_rows(seed: int) -> SparseRows:
    """Pairs of rows of blocks of three own unknowns, some of them fixed, in groups of which two share their unknowns,
    as scans of one frame do; some rows of no block, of no group, and single unknowns."""
    rng = np.random.default_rng(seed)
    count, blocks, groups = 400, 40, 9
    members = np.arange(4, 4 + 4 * groups).reshape(groups, 4)
    members[1, :2] = members[0, :2]
    members[3, 3] = -1
    own = 40 + np.arange(3 * blocks).reshape(blocks, 3)
    own[5, 2] = own[7, 0] = -1
    single = np.where(rng.random((count, 2)) < 0.9, rng.integers(0, 4, (count, 2)) // 2 * 2 + [0, 1], -1)
    columns = np.arange(3), np.arange(3, 7), np.arange(7, 9)
    pattern = SparsityPattern(
        columns,
        rng.integers(0, blocks + 1, count),
        rng.integers(0, groups + 1, count),
        np.concatenate([own, [[-1] * 3]]),
        np.concatenate([members, [[-1] * 4]]),
        single,
        40,
    )
    further = Blocks(np.empty((1, 0), np.intp), np.array([[2, 5, 11]]), rng.normal(size=(1, 2, 3)), np.ones((1, 2)))
    matrix = rng.normal(size=(9, count, 2)).transpose(1, 2, 0)
    return SparseRows(pattern, matrix, rng.normal(size=(count, 2)), (further,), lambda: [])


@needs_kernels
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_compiled_elimination_is_that_of_dense_normal_equations(seed: int) -> None:
    rows, rng, shared = sparse_rows(seed), np.random.default_rng(5), 40
    pattern, matrix = rows.pattern, np.zeros((2 * len(rows.right), 160 + 1))
    numbers = np.hstack([pattern.own[pattern.block], pattern.members[pattern.group], pattern.single])
    for axis in (0, 1):
        np.put_along_axis(matrix[axis::2], numbers, np.asarray(rows.matrix[:, axis]), axis=1)
    weight, prior = rng.uniform(0.1, 1.0, 160), rng.normal(size=160)
    (further,) = rows.further
    beyond = np.zeros((2, 160))
    beyond[:, further.shared[0]] = further.matrix[0]
    whole = np.vstack([matrix[:, :-1], beyond, np.diag(np.where(np.arange(160) < shared, 0.0, weight))])
    right = np.concatenate([rows.right.ravel(), np.ones(2), np.where(np.arange(160) < shared, 0.0, prior)])
    normal, by_right = whole.T @ whole, whole.T @ right
    through = normal[:shared, shared:] @ np.linalg.inv(normal[shared:, shared:])
    reduced = normal[:shared, :shared] - through @ normal[shared:, :shared]
    equations = rows.equations(Fronts.single(shared))
    blocks = eliminate_blocks(rows, weight, prior, np.ones(160), equations)
    np.testing.assert_allclose(np.tril(equations.squares[0]), np.tril(reduced), atol=1e-10)
    np.testing.assert_allclose(equations.right, by_right[:shared] - through @ by_right[shared:], atol=1e-10)

    root = np.linalg.cholesky(reduced + np.eye(shared)).T
    normal[range(shared), range(shared)] += 1.0
    cofactor = np.linalg.inv(normal)
    for own, found in blocks.own_cofactors(Triangle(Fronts.single(shared), (root,), (np.empty((shared, 0)),))):
        for numbers, each in zip(own, found, strict=True):
            there = np.flatnonzero(numbers >= 0)
            expected = cofactor[np.ix_(numbers[there], numbers[there])]
            np.testing.assert_allclose(each[np.ix_(there, there)], expected, atol=1e-10)


@needs_kernels
def test_own_columns_are_orthonormal_even_if_nearly_parallel() -> None:
    rows = sparse_rows(1)
    rows.matrix[..., 1] = rows.matrix[..., 0] + 1e-7 * rows.matrix[..., 1]
    nothing, equations = np.zeros(160), SharedEquations.zeros(Fronts.single(40))
    blocks = eliminate_blocks(rows, nothing, nothing, np.ones(160), equations)
    first, stop = rows.pattern.first[10:12]
    columns = blocks.orthonormal[..., first:stop].reshape(3, -1)
    np.testing.assert_allclose(columns @ columns.T, np.eye(3), atol=1e-14)


def assert_alike(found: Adjustment, expected: Adjustment) -> None:
    """Values to 1e-6 of a standard deviation, and cofactors and v'Pv to nine digits."""
    assert found.termination == expected.termination
    if not expected.converged:
        return
    sigma = np.sqrt(expected.cofactor.variances)
    assert (np.abs(found.values - expected.values) <= 1e-6 * sigma).all()
    np.testing.assert_allclose(found.cofactor.variances, expected.cofactor.variances, rtol=1e-8)
    assert found.vpv == pytest.approx(expected.vpv, rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(found.residuals.redundancy, expected.residuals.redundancy, atol=1e-8)


@needs_kernels
@pytest.mark.parametrize("path", sorted(CASES.glob("*.json")), ids=lambda path: path.stem)
def test_reference_cases_are_the_same_by_both(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where normal equations take the place of reflections, as they do in large networks."""
    case = load(path.stem)
    network, start = (
        case_network(case),
        case_approximations(case, case["input"].get("initial_approximations", case.get("state"))),
    )
    found = adjust(network, start)
    monkeypatch.setattr(elimination, "CHEAP", 0.0)
    by_normal_equations = adjust(network, start)
    monkeypatch.setattr(compiled, "kernels", None)
    assert_alike(by_normal_equations, adjust(network, start))
    monkeypatch.undo()
    monkeypatch.setattr(compiled, "kernels", None)
    assert_alike(found, adjust(network, start))


@needs_kernels
@pytest.mark.parametrize("count", [40, 9])
@pytest.mark.parametrize("bent", [False, True])
def test_networks_are_the_same_by_both(count: int, bent: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points or images eliminated first, several fronts; straight and bent lines of sight."""
    rng = np.random.default_rng(12)
    network, start = simulated(rng, points=field_points(rng, count), point_sigma=0.05, free={"k3": np.inf})
    if bent:
        network = replace(network, line_of_sight=LineOfSight(curvature=True))
    monkeypatch.setattr(elimination, "CHEAP", 0.0)
    monkeypatch.setattr(sparse_factor, "FRONT_COST", 1e3)
    found = adjust(network, start)
    monkeypatch.setattr(compiled, "kernels", None)
    assert_alike(found, adjust(network, start))
