"""Fourier self-calibration: double trigonometric polynomials over the frame.

With u = π xr / bx, v = π yr / by, xr and yr reduced to the principal point and bx, by half the frame (`half_mm`):

    dx = Σ a_mn cos(m u + n v) + b_mn sin(m u + n v)        dy = Σ c_mn cos(m u + n v) + d_mn sin(m u + n v)

over m = 0, n = 1..N and m = 1..N, n = -N..N: 16 parameters of the first order, 48 of the second, in mm. The constant,
a shift, is left out; all others are orthogonal over the frame. They are periodic with the frame, so that opposite edges
get the same correction. A larger `half_mm` avoids this.

Source: R. Tang, D. Fritsch, M. Cramer, New rigorous and flexible Fourier self-calibration models for airborne camera
calibration, ISPRS Journal of Photogrammetry and Remote Sensing 71 (2012), 76-85.
"""

import numpy as np
from numpy.typing import NDArray

from adjust.array_types import Array
from adjust.functional_model.correction import Correction, Settings


def fourier_names(order: int) -> tuple[str, ...]:
    """Names of a, b, c, d with m and n. A negative n is written with an m before it: a1m2 for m = 1, n = -2."""
    indices = [f"{m}{f'm{-n}' if n < 0 else n}" for m, n in _frequencies(order).tolist()]
    return tuple(f"{letter}{index}" for letter in "abcd" for index in indices)


def order_groups(order: int) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Group the parameters by order, the larger of m and |n|."""
    orders = np.tile(np.abs(_frequencies(order)).max(axis=1), 4)
    names = np.array(fourier_names(order))
    return tuple((f"order {n}", tuple(names[orders == n].tolist())) for n in range(1, order + 1))


def fourier(order: int, settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Compute the Fourier correction up to an order. It is subtracted from the observed point."""
    waves = np.pi * _frequencies(order) / np.array(settings.half_mm)  # (frequencies, 2), in rad per mm
    angle = (xy - principal_point) @ waves.T
    cos, sin = np.cos(angle), np.sin(angle)
    basis = np.concatenate([cos, sin], axis=1)
    slope = np.concatenate([-sin[..., None] * waves, cos[..., None] * waves], axis=1)  # (n, terms, 2)
    pair = parameters.reshape(2, -1)
    xy_jacobian = np.einsum("ak,nkj->naj", pair, slope)
    zero = np.zeros_like(basis)
    parameter_jacobian = np.stack([np.hstack([basis, zero]), np.hstack([zero, basis])], axis=1)
    return Correction(basis @ pair.T, xy_jacobian, -xy_jacobian, parameter_jacobian)


def _frequencies(order: int) -> NDArray[np.int_]:
    """(k, 2) m, n of every term, low frequencies first."""
    pairs = [(m, n) for m in range(order + 1) for n in range(-order, order + 1) if m > 0 or n > 0]
    return np.array(sorted(pairs, key=lambda mn: (max(mn[0], abs(mn[1])), mn)))
