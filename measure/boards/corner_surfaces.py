"""The pictures of two edges that meet, under a Gaussian blur: bivariate normal integrals and their derivatives.

u, v (n, pixels): the distances of pixels from two edges, over the blur's standard deviation; correlation (n, 1): the
cosine of the angle between the edges' normals.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from measure.array_types import Single

Surface = Callable[[Single, Single, Single], tuple[Single, Single, Single, Single]]

_NODES, _MOST_NODES = ((0.3, 2), (0.55, 3), (0.8, 5)), 10  # by the correlation: to single precision
_ERF_SCALE = 0.3275911
_ERF_FACTORS = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)


def crossing(u: Single, v: Single, correlation: Single) -> tuple[Single, Single, Single, Single]:
    """The mean of sign(u + z1) sign(v + z2) over standard normal z1, z2 of the given correlation, and its derivatives
    by u, v and the correlation. Single precision, as exact as that.

    Its derivative by the correlation is four times the normal density (Plackett 1954), which Gauss's rule integrates
    over the arc sine of the correlation (Genz 2004, Numerical computation of rectangular bivariate and trivariate
    normal and t probabilities, Statistics and Computing 14).
    """
    root = _single(np.sqrt(np.maximum(1 - correlation**2, np.float32(1e-6))))
    (erf_u, density_u), (erf_v, density_v) = _erf_and_density(u), _erf_and_density(v)
    across_u, density_across_u = _erf_and_density(_single((v - correlation * u) / root))
    across_v, _ = _erf_and_density(_single((u - correlation * v) / root))
    squares, product, value = u * u + v * v, u * v, erf_u * erf_v
    angle = np.arcsin(np.clip(correlation, -1, 1))
    largest = float(np.abs(correlation).max(initial=0.0))
    nodes = next((count for limit, count in _NODES if largest < limit), _MOST_NODES)
    for place, weight in zip(*np.polynomial.legendre.leggauss(nodes), strict=True):
        sine = np.sin(angle * np.float32((1 + place) / 2))
        inverse = 1 / (sine * sine - 1)
        exponent = squares * (inverse / 2)
        exponent -= product * (sine * inverse)
        np.exp(exponent, out=exponent)
        exponent *= angle * np.float32(weight / np.pi)
        value += exponent
    by_u, by_v = 2 * density_u * across_u, 2 * density_v * across_v
    return value, _single(by_u), _single(by_v), _single(4 * density_u * density_across_u / root)


def quarter(u: Single, v: Single, correlation: Single) -> tuple[Single, Single, Single, Single]:
    """Twice the probability that u + z1 and v + z2 are both positive, less one, and its derivatives: as `crossing`, for
    a corner that is alone."""
    value, by_u, by_v, by_correlation = crossing(u, v, correlation)
    (erf_u, density_u), (erf_v, density_v) = _erf_and_density(u), _erf_and_density(v)
    parts = (value - 1 + erf_u + erf_v) / 2, by_u / 2 + density_u, by_v / 2 + density_v, by_correlation / 2
    value, by_u, by_v, by_correlation = map(_single, parts)
    return value, by_u, by_v, by_correlation


def _erf_and_density(place: Single) -> tuple[Single, Single]:
    """erf(place / sqrt(2)) to 2e-7 (Abramowitz and Stegun 1964, 7.1.26), and the normal density."""
    bell = np.exp(np.float32(-0.5) * place * place)
    t = 1 / (1 + np.float32(_ERF_SCALE / np.sqrt(2)) * np.abs(place))
    tail = np.zeros_like(t)
    for factor in _ERF_FACTORS:
        tail += np.float32(factor)
        tail *= t
    return _single(np.copysign(1 - tail * bell, place)), _single(bell / np.sqrt(2 * np.pi))


def _single(values: NDArray[np.floating]) -> Single:
    return np.asarray(values, np.float32)
