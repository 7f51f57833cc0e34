"""What the search for a board in a picture gives: its corners, to a pixel."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from measure.reason import NO_REASON, Reason

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FoundCorner:
    """A corner to a pixel. center_px (2,) in the scan; steps_px (2, 2): its columns are the sides of the square that
    begins here (its right and its lower neighbour), or of the marker: the edges leaving the corner."""

    center_px: Array
    steps_px: Array


@dataclass(frozen=True)
class FoundBoard:
    """The corners found, by id; none, and the reason why; refused: the markers that were read and are not used, by
    number, and why; off_corners: the corners that do not lie where the markers beside them put them, and why;
    others_px: the middles of further boards that look the same; notes: what the user should know."""

    corners: dict[str, FoundCorner]
    reason: Reason = NO_REASON
    refused: Mapping[int, Reason] = field(default_factory=dict)
    off_corners: Mapping[str, Reason] = field(default_factory=dict)
    others_px: tuple[Array, ...] = ()
    notes: tuple[str, ...] = ()


def corners_of_square(name: str, corners: Array) -> dict[str, FoundCorner]:
    """The four corners (4, 2) of a square or marker, with its sides that leave them."""
    found = {}
    for index, corner in enumerate(corners):
        sides = np.stack([corners[(index + 1) % 4] - corner, corners[(index - 1) % 4] - corner], axis=-1)
        found[f"{name}.{index}"] = FoundCorner(corner, sides)
    return found
