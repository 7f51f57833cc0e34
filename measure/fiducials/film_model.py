"""Film deformation models: the terms of each in addition to an affine transformation, as columns of a design matrix."""

import numpy as np

from measure.array_types import Array


def interleaved(*columns: tuple[Array, Array]) -> Array:
    """(2n, k) design matrix from k columns, each given as (n,) in x and (n,) in y; rows x1, y1, x2, ..."""
    return np.stack([np.stack(each, axis=1).ravel() for each in columns], axis=1)


def film_terms(model: str, places: Array, measured: Array | None = None) -> Array:
    """Terms of a film model in addition to an affine transformation.

    Parameters
    ----------
    model : projective, bilinear, conformal(n) or polynomial(n); any other has no further terms.
    places : (n, 2) given places.
    measured : (n, 2) measured places, with which the equations of a projective transformation are linear (DLT). None:
        it is linearised.

    Returns
    -------
    (2n, k) columns of the design matrix.
    """
    x, y = places.T
    u, v = places.T if measured is None else measured.T
    none = np.zeros_like(x)
    name, _, order = model.rstrip(")").partition("(")
    powers = range(2, int(order) + 1) if order.isdigit() else range(0)
    if name == "projective":
        return interleaved((u * x, v * x), (u * y, v * y))
    if name == "bilinear":
        return interleaved((x * y, none), (none, x * y))
    if name == "conformal" and powers:
        z = [(x + 1j * y) ** power for power in powers]
        return interleaved(*[(each.real, each.imag) for each in z], *[(-each.imag, each.real) for each in z])
    if name == "polynomial" and powers:
        terms = [x ** (degree - q) * y**q for degree in powers for q in range(degree + 1)]
        return interleaved(*[(each, none) for each in terms], *[(none, each) for each in terms])
    return np.zeros((2 * len(places), 0))
