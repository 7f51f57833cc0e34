"""Film deformation models: what each adds to an affine transformation, as columns of linear equations."""

import numpy as np

from measure.array_types import Array


def interleaved(*columns: tuple[Array, Array]) -> Array:
    """(2n, k) of k columns, each of them (n,) in x and (n,) in y."""
    return np.stack([np.stack(each, axis=1).ravel() for each in columns], axis=1)


def film_terms(model: str, places: Array, measured: Array | None = None) -> Array:
    """(2n, k) what a film model adds to an affine transformation at places (n, 2).

    model: projective, bilinear, conformal(n) or polynomial(n); any other adds nothing. measured: (n, 2) where they are
    pictured, with which the equations of a projective transformation are linear (DLT); else it is taken to first order.
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
