"""Ebner's, Grün's, Legendre's and Fourier's sets: the published formulas, and what they promise to be orthogonal to."""

import numpy as np
import pytest
from numpy.typing import NDArray

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens

Array = NDArray[np.float64]

B = 90.0
C = 152.0


def columns(family: str, xy_mm: Array, half_mm: tuple[float, float] = (B, B)) -> Array:
    """(n, 2, k): what a unit of every parameter takes off observed points, the principal point at (0.3, -0.2)."""
    names = parameter_names(family)
    interior = np.array([C, 0.3, -0.2])
    observed = xy_mm + interior[1:]
    at = Lens(Distortion(family, half_mm=half_mm), interior, np.zeros(len(names))).equations(observed, xy_mm / C)
    return -at.parameter_jacobian


def grid(points: Array, half_mm: tuple[float, float] = (B, B)) -> Array:
    x, y = np.meshgrid(points * half_mm[0], points * half_mm[1])
    return np.stack([x.ravel(), y.ravel()], axis=1)


def orientation(xy_mm: Array) -> Array:
    """(n, 2, 6): shifts, rotation, scale and tilts of an image of a plane, by what they are in a picture."""
    x, y = xy_mm.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    pairs = [(one, zero), (zero, one), (-y, x), (x, y), (C + x**2 / C, x * y / C), (x * y / C, C + y**2 / C)]
    return np.stack([np.stack(pair, axis=1) for pair in pairs], axis=2)


def largest_cosine(first: Array, second: Array) -> float:
    """Between columns (n, 2, k) and (n, 2, l)."""
    a, b = (each.reshape(-1, each.shape[2]) / np.linalg.norm(each, axis=(0, 1)) for each in (first, second))
    return float(np.abs(a.T @ b).max())


def are_orthogonal(each: Array) -> bool:
    flat = each.reshape(-1, each.shape[2]) / np.linalg.norm(each, axis=(0, 1))
    return bool(np.allclose(flat.T @ flat, np.eye(flat.shape[1]), atol=1e-12))


def test_ebners_formula_as_published() -> None:
    """In mm and in b: his coefficient of a product of degree m is ours over b to that power."""
    xy = np.random.default_rng(1).uniform(-100, 100, (9, 2))
    x, y = xy.T
    u, v = x**2 - 2 * B**2 / 3, y**2 - 2 * B**2 / 3
    zero = np.zeros_like(x)
    dx = [x, y, -2 * u, x * y, v, zero, x * v, zero, u * y, zero, u * v, zero]
    dy = [-y, x, x * y, -2 * v, zero, u, zero, u * y, zero, x * v, zero, u * v]
    degrees = np.array([1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4])
    expected = np.stack([np.stack(dx, axis=1), np.stack(dy, axis=1)], axis=1) / B**degrees
    assert parameter_names("ebner") == tuple(f"b{i}" for i in range(1, 13))
    np.testing.assert_allclose(columns("ebner", xy), expected, atol=1e-13)


def test_gruens_formula_as_published() -> None:
    """With b = 1: k, l of degree 2, x p, y q of degree 3, r, s of degree 4, as his table has them."""
    xy = np.random.default_rng(2).uniform(-1, 1, (9, 2))
    x, y = xy.T
    k, l_ = x**2 - 1 / 2, y**2 - 1 / 2
    p, q = x**2 - 17 / 20, y**2 - 17 / 20
    r, s = x**2 * (x**2 - 31 / 28) + 9 / 70, y**2 * (y**2 - 31 / 28) + 9 / 70
    by_x, by_y = [np.ones_like(x), x, k, x * p, r], [np.ones_like(x), y, l_, y * q, s]
    zero = np.zeros_like(x)
    expected = {"a12": (x, -y), "a21": (y, x), "a22": (x * y, -10 / 7 * l_), "b22": (-10 / 7 * k, x * y)}
    for i in range(1, 6):
        for j in range(1, 6):
            product = by_y[i - 1] * by_x[j - 1]
            if (i, j) not in {(1, 1), (1, 2), (2, 1), (2, 2), (1, 3)}:
                expected[f"a{i}{j}"] = (product, zero)
            if (i, j) not in {(1, 1), (1, 2), (2, 1), (2, 2), (3, 1)}:
                expected[f"b{i}{j}"] = (zero, product)
    found = dict(zip(parameter_names("gruen"), np.moveaxis(columns("gruen", xy, (1.0, 1.0)), 2, 0), strict=True))
    assert found.keys() == expected.keys()
    assert len(found) == 44
    for name, pair in expected.items():
        np.testing.assert_allclose(found[name], np.stack(pair, axis=1), atol=1e-14, err_msg=name)


@pytest.mark.parametrize("half_mm", [(B, B), (115.0, 80.0)])
@pytest.mark.parametrize(
    ("family", "points"), [("ebner", np.linspace(-1, 1, 3)), ("gruen", np.linspace(-1, 1, 5))]
)  # fmt: skip
def test_on_their_grid_the_parameters_are_orthogonal_and_free_of_the_orientation(
    family: str, points: Array, half_mm: tuple[float, float]
) -> None:
    xy = grid(points, half_mm)
    found = columns(family, xy, half_mm)
    assert are_orthogonal(found)
    assert largest_cosine(found, orientation(xy)) < 1e-12


@pytest.mark.parametrize(("family", "count"), [("legendre(2)", 12), ("legendre(3)", 26), ("legendre(5)", 66)])
def test_legendres_are_orthogonal_over_the_frame_and_free_of_the_orientation(family: str, count: int) -> None:
    half_mm = (115.0, 80.0)
    points, weights = np.polynomial.legendre.leggauss(8)
    xy = grid(points, half_mm)
    root = np.sqrt(np.outer(weights, weights).ravel())[:, None, None]
    found = columns(family, xy, half_mm)
    assert found.shape[2] == count
    assert are_orthogonal(root * found)
    assert largest_cosine(root * found, root * orientation(xy)) < 1e-12


@pytest.mark.parametrize(("order", "count"), [(1, 16), (2, 48), (3, 96)])
def test_fouriers_are_orthogonal_over_the_frame_and_to_a_shift(order: int, count: int) -> None:
    half_mm = (115.0, 80.0)
    xy = grid(-1 + 2 * np.arange(12) / 12, half_mm)
    found = columns(f"fourier({order})", xy, half_mm)
    assert found.shape[2] == count
    assert are_orthogonal(found)
    assert largest_cosine(found, orientation(xy)[..., :2]) < 1e-12


def test_a_fourier_term_by_its_name() -> None:
    xy = np.array([[20.0, -35.0]])
    named = dict(zip(parameter_names("fourier(2)"), columns("fourier(2)", xy)[0].T, strict=True))
    angle = np.pi / B * (1 * 20.0 - 2 * -35.0)
    np.testing.assert_allclose(named["a1m2"], [np.cos(angle), 0.0], atol=1e-14)
    np.testing.assert_allclose(named["d1m2"], [0.0, np.sin(angle)], atol=1e-14)


@pytest.mark.parametrize(
    ("family", "words"),
    [
        ("legendre(1)", r"the order of legendre must be 2 to 9, not 1"),
        ("fourier(10)", r"the order of fourier must be 1 to 9, not 10"),
        ("legendre", r"one of none, .*legendre\(n\), fourier\(n\), not legendre"),
        ("ebner(3)", "must be one of"),
    ],
)
def test_a_wrong_order_is_refused(family: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Distortion(family)
