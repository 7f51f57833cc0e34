"""What is observed: marks in images, distances between points, cameras by earlier adjustments."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adjust.array_types import Array, Indices, Mask
from adjust.problem.parameter import Parameter

ObservationKind = Literal["target", "fiducial", "tie", "join"]


@dataclass(frozen=True, repr=False)
class Observations:
    """Measured comparator coordinates, one row a mark in an image.

    image, point, kind: (n,) names; a fiducial's point is its id in the image's camera. A "join" is a point of the film
    that is common to several scans of one frame: what it is in the object need not be known.
    xy_mm (n, 2) in the comparator frame (y up); covariance_mm2 (n, 2, 2).
    """

    image: tuple[str, ...]
    point: tuple[str, ...]
    kind: tuple[ObservationKind, ...]
    xy_mm: Array
    covariance_mm2: Array

    def __len__(self) -> int:
        return len(self.image)

    def __repr__(self) -> str:
        return f"Observations({len(self)} of {len(set(self.point))} marks in {len(set(self.image))} images)"

    @cached_property
    def is_fiducial(self) -> Mask:
        """(n,) whether it is a place in the camera frame that is observed, fiducial or join, and no object point."""
        return np.asarray(self.has_kind("fiducial") | self.has_kind("join"))

    def has_kind(self, kind: ObservationKind) -> Mask:
        """(n,) whether it is of a kind."""
        return np.asarray(self._kinds == kind)

    @cached_property
    def _kinds(self) -> NDArray[np.str_]:
        return np.array(self.kind, dtype=np.str_)

    @cached_property
    def numbered_points(self) -> tuple[tuple[str, ...], Indices]:
        """The names of all points and fiducials, each once, and every observation's (n,) by its number among them."""
        number = {name: i for i, name in enumerate(dict.fromkeys(self.point))}
        return tuple(number), np.array([number[name] for name in self.point], dtype=np.intp)

    def only(self, rows: Indices) -> "Observations":
        """Some of the rows."""
        return Observations(
            tuple(self.image[row] for row in rows),
            tuple(self.point[row] for row in rows),
            tuple(self.kind[row] for row in rows),
            self.xy_mm[rows],
            self.covariance_mm2[rows],
        )


@dataclass(frozen=True)
class Distance:
    """A measured distance between two object points, two stations or one of each.

    start, end: a point's name; where no point has it, that of the image whose station it is. value and its standard
    deviation in object units.
    """

    start: str
    end: str
    value: float
    sigma: float


@dataclass(frozen=True)
class Calibration:
    """What an earlier adjustment found of a camera, "equal to image observations" (Juhl).

    parameters (m,): the keys of the camera's quantities; values (m,), covariance (m, m). What was given beforehand in
    that adjustment is in it already: these quantities must be free of priors here.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
