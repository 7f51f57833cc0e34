"""What `adjustment.npz` holds: the covariance of all quantities, or, of a large network, its parts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.solution.result import Adjustment

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

AFFORDABLE = 3000  # quantities whose covariance is written as one matrix


def covariance_arrays(adjustment: Adjustment) -> dict[str, NDArray[np.generic]]:
    """The a-posteriori covariance by the names of the file's arrays; mm, object units, rad.

    names (n), values (n), matrix (n, n): of all quantities, or, where these are more than AFFORDABLE, of cameras and
    images, and where these are more, of cameras. The points, and then the images, stand each by itself, without their
    covariances with others: point_names (p, 3), point_values (p, 3), point_matrices (p, 3, 3), image_names (i, k) and
    so on, with empty names and zeros behind an image that has less than k quantities.
    """
    parts = _parts(adjustment)
    whole = _named(adjustment, parts.whole)
    arrays = whole | {"matrix": adjustment.sigma0**2 * adjustment.cofactor.of(parts.whole)}
    for kind, groups in parts.groups.items():
        padded = np.full((len(groups), max(map(len, groups))), -1, dtype=np.intp)
        for row, group in zip(padded, groups, strict=True):
            row[: len(group)] = group
        matrices = np.zeros((*padded.shape, padded.shape[1]))
        lengths = (padded >= 0).sum(axis=1)
        for length in np.unique(lengths):
            cofactors = adjustment.cofactor.of_each(padded[lengths == length, :length])
            matrices[lengths == length, :length, :length] = adjustment.sigma0**2 * cofactors
        named = _named(adjustment, padded) | {"matrices": matrices}
        arrays |= {f"{kind}_{name}": array for name, array in named.items()}
    return arrays


def covariance_note(adjustment: Adjustment) -> str:
    """What of the covariance is in the file, in words."""
    count, alone = len(adjustment.parameters), " and every ".join(_parts(adjustment).groups)
    if not alone:
        return "adjustment.npz holds the covariance of all quantities."
    whole = "cameras" if "image" in alone else "cameras and images"
    return (
        f"adjustment.npz holds the covariance of the {whole} together and of every {alone} by itself: the matrix of "
        f"all {count} quantities would be too large."
    )


@dataclass(frozen=True)
class _Parts:
    """Positions of the quantities: those of the whole matrix, and by kind the groups of those that are not in it."""

    whole: Indices
    groups: dict[str, list[Indices]]


def _parts(adjustment: Adjustment) -> _Parts:
    parameters = adjustment.parameters
    whole = np.arange(len(parameters))
    groups: dict[str, list[Indices]] = {}
    # The quantities of a point or an image stand together, and begin with X or X0.
    for kind, kinds, first in (("point", ("point",), "X"), ("image", ("exterior", "film"), "X0")):
        members = np.array([parameters[i].kind in kinds for i in whole], dtype=bool)
        if len(whole) <= AFFORDABLE or not members.any():
            continue
        positions = whole[members]
        begins = [j for j, i in enumerate(positions) if parameters[i].quantity == first]
        groups[kind] = np.split(positions, begins[1:])
        whole = whole[~members]
    return _Parts(whole, groups)


def _named(adjustment: Adjustment, positions: Indices) -> dict[str, NDArray[np.generic]]:
    """Names and values at some positions; empty and zero at -1."""
    names = np.array([*adjustment.names, ""], dtype=np.str_)
    return {"names": names[positions], "values": np.append(adjustment.values, 0.0)[positions]}
