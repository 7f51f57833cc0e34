"""The compiled loops against what numpy and scipy do in their place."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plain_environment import NO_COMPILER

import compiled
from pipeline.cli import DONE, run
from pipeline.resampling.interpolation import Degree, spline_samples

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
def test_a_compiled_spline_is_that_of_scipy(
    degree: Degree, dtype: type[np.uint8] | type[np.uint16], monkeypatch: pytest.MonkeyPatch
) -> None:
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


@pytest.mark.parametrize("there", [True, False])
def test_the_version_says_whether_loops_are_compiled(
    there: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(compiled, "kernels", object() if there else None)
    assert run(["--version"]) == DONE
    assert ("with compiled loops" if there else "without compiled loops") in capsys.readouterr().out
