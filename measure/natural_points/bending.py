"""The bending of patches of ground: what relief does inside a patch, beyond the plane that its matching takes it for.

Where the ground curves, a patch of one scan lies on that of another with second-order terms. They move the place that
an affine matching finds, for a mean over the patch is not its middle. In one patch noise nearly hides these terms; what
all patches show of them together is their variance (estimated by scoring, as variance components are). With that as
prior knowledge each patch's terms are estimated, the place is freed of them, and what stays uncertain of them goes into
its covariance (least-squares collocation).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of the coefficients of u², uv and v² of a surface whose curvature has no preferred direction, but for their scale.
_ISOTROPIC = np.array([[0.75, 0.0, 0.25], [0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])
_DIRECTIONS = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])
_ROUNDS = 8  # of scoring
_LEAST_EIGENVALUE = 1e-9  # of a covariance, over its largest
_FEWEST = 20  # patches whose bendings have a variance worth the name


@dataclass(frozen=True, eq=False)
class Bending:
    """What a piece shows of its bending q (6,) against the reference's: coefficients of u², uv and v² in units of the
    usual patch's radius, whatever the size of this one, of the columns' shift and then of the rows', px of the patch.

    seen (6,) is response (6, 6) @ q and noise of covariance noise (6, 6); on_place (2, 6) @ q is what it does to the
    place, px of the patch.
    """

    seen: Array
    response: Array
    noise: Array
    on_place: Array

    @property
    def has_noise(self) -> bool:
        """Whether the noise is a covariance that can be weighed by: pictures copied from one another have none."""
        values = np.linalg.eigvalsh(self.noise)
        return bool(values[0] > _LEAST_EIGENVALUE * values[-1])

    def estimated(self, variance: Array) -> tuple[Array, Array]:
        """The shift (2,) of the place, px of the patch, and the covariance (2, 2) that stays, where bendings have that
        covariance (6, 6)."""
        gain = variance @ self.response.T @ np.linalg.inv(self.response @ variance @ self.response.T + self.noise)
        left = variance - gain @ self.response @ variance
        return self.on_place @ gain @ self.seen, self.on_place @ left @ self.on_place.T


def bending_variance(bendings: Sequence[Bending]) -> Array:
    """The covariance (6, 6) of the bendings of one scan's patches against another's; zero where too few are known.

    Relief bends along the epipolar lines, and curves in all directions alike: unknown are the variances of a shift's
    two components and their covariance.
    """
    if len(bendings) < _FEWEST:
        return np.zeros((6, 6))
    seen, noise = np.array([each.seen for each in bendings]), np.array([each.noise for each in bendings])
    response = np.array([each.response for each in bendings])
    shapes = np.array([np.kron(direction, _ISOTROPIC) for direction in _DIRECTIONS])
    parts = np.einsum("nij,kjl,nml->knim", response, shapes, response)
    components = np.zeros(3)
    for _ in range(_ROUNDS):
        inverse = np.linalg.inv(noise + np.tensordot(components, parts, 1))
        weighted = np.einsum("nij,knjl->knil", inverse, parts)
        free = np.einsum("nij,nj->ni", inverse, seen)
        normal = np.einsum("knij,lnji->kl", weighted, weighted)
        squares = np.einsum("ni,knij,nj->k", free, parts, free)
        expected = np.einsum("knij,nji->k", weighted, np.einsum("nij,njl->nil", inverse, noise))
        components = _valid(np.linalg.solve(normal, squares - expected))
    return np.asarray(np.tensordot(components, shapes, 1))


def _valid(components: Array) -> Array:
    """The nearest components that some shift can have."""
    values, vectors = np.linalg.eigh(np.tensordot(components, _DIRECTIONS, 1))
    matrix = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.array([matrix[0, 0], matrix[0, 1], matrix[1, 1]])
