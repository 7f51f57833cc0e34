"""Sums over images and over their pixels: what `numpy.tensordot` gives, at a fraction of its price for small images."""

from math import prod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ALIKE = 1e-10  # of the largest eigenvalue: what images differ by in less is no direction of its own


def combined(factors: Array, images: Array) -> Array:
    """Images (n, height, width) times factors (n,), summed to one image, or (m, n), to m images."""
    sums = factors @ images.reshape(len(images), prod(images.shape[1:]))
    return np.asarray(sums.reshape(*factors.shape[:-1], *images.shape[1:]))


def products(first: Array, second: Array) -> Array:
    """(n, m) the sums over all pixels of the products of images (n, height, width) and (m, height, width)."""
    return np.asarray(first.reshape(len(first), -1) @ second.reshape(len(second), -1).T)


def to_orthonormal(normal: Array) -> Array:
    """(k, n) the factors by which images become an orthonormal base of the space they span, of k dimensions; normal
    (n, n): the sums of their products."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    told = values > _ALIKE * values[-1]
    return np.asarray((vectors[:, told] / np.sqrt(values[told])).T / size)


def factors(images: Array, image: Array) -> Array:
    """(n,) the factors by which images (n, height, width), 0 where they do not count, come closest to an image in least
    squares."""
    inverse = np.linalg.pinv(products(images, images), hermitian=True)
    return np.asarray(inverse @ products(images, image[None])[:, 0])
