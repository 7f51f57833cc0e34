"""Sums over images and over their pixels: what `numpy.tensordot` gives, at a fraction of its price for small images."""

from math import prod

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def combined(factors: Array, images: Array) -> Array:
    """Images (n, height, width) times factors (n,), summed to one image, or (m, n), to m images."""
    sums = factors @ images.reshape(len(images), prod(images.shape[1:]))
    return np.asarray(sums.reshape(*factors.shape[:-1], *images.shape[1:]))


def products(first: Array, second: Array) -> Array:
    """(n, m) the sums over all pixels of the products of images (n, height, width) and (m, height, width)."""
    return np.asarray(first.reshape(len(first), -1) @ second.reshape(len(second), -1).T)


def factors(images: Array, image: Array) -> Array:
    """(n,) the factors by which images (n, height, width), 0 where they do not count, come closest to an image in least
    squares."""
    inverse = np.linalg.pinv(products(images, images), hermitian=True)
    return np.asarray(inverse @ products(images, image[None])[:, 0])
