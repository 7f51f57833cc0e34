"""Grey-value surfaces of two intersecting edges under a Gaussian blur: bivariate normal integrals and derivatives.

u, v (n, pixels): distances of pixels from two edges, in standard deviations of the blur; correlation (n, 1): cosine of
the angle between the edges' normals.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from measure.array_types import Single

Surface = Callable[[Single, Single, Single], tuple[Single, Single, Single, Single]]

_FAR = np.float32(9.0)  # standard deviations beyond which nothing changes; denormal numbers would be slow
_NODES, _MOST_NODES = ((0.3, 2), (0.55, 3), (0.8, 5)), 10  # nodes of the quadrature by correlation, single precision
_ERF_SCALE = 0.3275911
_ERF_FACTORS = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)


def crossing(u: Single, v: Single, correlation: Single) -> tuple[Single, Single, Single, Single]:
    """Mean of sign(u + z1) sign(v + z2) over standard normal z1, z2 of the given correlation, and its derivatives with
    respect to u, v and the correlation. Exact to single precision.

    Notes
    -----
    The derivative with respect to the correlation is four times the normal density (Plackett 1954). It is integrated
    over the arc sine of the correlation by Gauss's rule (Genz 2004, Numerical computation of rectangular bivariate and
    trivariate normal and t probabilities, Statistics and Computing 14).
    """
    u, v = np.clip(u, -_FAR, _FAR), np.clip(v, -_FAR, _FAR)
    inverse_root = np.asarray(1 / np.sqrt(np.maximum(1 - correlation**2, np.float32(1e-6))), np.float32)
    density_u, across_u = _density(u), np.clip((v - correlation * u) * inverse_root, -_FAR, _FAR)
    density_v, across_v = _density(v), np.clip((u - correlation * v) * inverse_root, -_FAR, _FAR)
    density_across_u = _density(across_u)
    value = _erf(u, density_u) * _erf(v, density_v)
    by_u = 2 * density_u * _erf(across_u, density_across_u)
    by_v = 2 * density_v * _erf(across_v, _density(across_v))
    by_correlation = (4 * inverse_root) * (density_u * density_across_u)
    squares, product, angle = u * u + v * v, u * v, np.arcsin(np.clip(correlation, -1, 1))
    largest = float(np.abs(correlation).max(initial=0.0))
    nodes = next((count for limit, count in _NODES if largest < limit), _MOST_NODES)
    for place, weight in _gauss_legendre(nodes):
        sine = np.sin(angle * np.float32((1 + place) / 2))
        inverse = 1 / (sine * sine - 1)
        exponent = squares * (inverse / 2)
        exponent -= product * (sine * inverse)
        np.maximum(exponent, -_FAR * _FAR, out=exponent)
        np.exp(exponent, out=exponent)
        exponent *= angle * np.float32(weight / np.pi)
        value += exponent
    return value, by_u, by_v, by_correlation


def quarter(u: Single, v: Single, correlation: Single) -> tuple[Single, Single, Single, Single]:
    """Twice the probability that u + z1 and v + z2 are both positive, minus one, and its derivatives: the counterpart
    of `crossing` for a single corner."""
    value, by_u, by_v, by_correlation = crossing(u, v, correlation)
    u, v = np.clip(u, -_FAR, _FAR), np.clip(v, -_FAR, _FAR)
    density_u, density_v, half = _density(u), _density(v), np.float32(0.5)
    value = half * (value - 1 + _erf(u, density_u) + _erf(v, density_v))
    return value, half * by_u + density_u, half * by_v + density_v, half * by_correlation


def _erf(place: Single, density: Single) -> Single:
    """erf(place / sqrt(2)) to 2e-7 (Abramowitz and Stegun 1964, 7.1.26), with the normal density there."""
    t = 1 / (1 + np.float32(_ERF_SCALE / np.sqrt(2)) * np.abs(place))
    tail = np.zeros_like(t)
    for factor in _ERF_FACTORS:
        tail += np.float32(factor)
        tail *= t
    tail *= density
    return np.asarray(np.copysign(1 - np.float32(np.sqrt(2 * np.pi)) * tail, place), np.float32)


def _density(place: Single) -> Single:
    density = place * place
    density *= np.float32(-0.5)
    np.exp(density, out=density)
    density *= np.float32(1 / np.sqrt(2 * np.pi))
    return density


@cache
def _gauss_legendre(nodes: int) -> list[tuple[float, float]]:
    """Nodes and weights of Gauss-Legendre quadrature."""
    return list(zip(*(each.tolist() for each in np.polynomial.legendre.leggauss(nodes)), strict=True))
