"""Observations: marks in images, distances between points, earlier calibrations."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adjust.array_types import Array, Indices, Mask
from adjust.problem.parameter import Parameter

ObservationKind = Literal["target", "fiducial", "tie", "join"]


@dataclass(frozen=True, repr=False)
class Observations:
    """Measured comparator coordinates, one row per mark and image.

    Attributes
    ----------
    image, point, kind : (n,) names; a fiducial's point is its id in the image's camera. A "join" is a film point common
        to several scans of one frame, whose object point need not be known.
    xy_mm : (n, 2) in the comparator frame (y up).
    covariance_mm2 : (n, 2, 2).
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
        """(n,) mask of observations of a place in the camera frame (fiducial or join) instead of an object point."""
        return np.asarray(self.has_kind("fiducial") | self.has_kind("join"))

    def has_kind(self, kind: ObservationKind) -> Mask:
        """(n,) mask of observations of a kind."""
        return np.asarray(self._kinds == kind)

    @cached_property
    def _kinds(self) -> NDArray[np.str_]:
        return np.array(self.kind, dtype=np.str_)

    @cached_property
    def numbered_points(self) -> tuple[tuple[str, ...], Indices]:
        """Unique names of all points and fiducials, and the number (n,) of each observation's point among them."""
        number = {name: i for i, name in enumerate(dict.fromkeys(self.point))}
        return tuple(number), np.array([number[name] for name in self.point], dtype=np.intp)

    def mirror(self, signs: Array, shifts_mm: Array | float = 0.0) -> "Observations":
        """Multiply x and y of each row by signs (n, 2), 1 or -1, with the covariances, then add shifts (n, 2)."""
        covariance_mm2 = self.covariance_mm2 * signs[:, :, None] * signs[:, None, :]
        return replace(self, xy_mm=self.xy_mm * signs + shifts_mm, covariance_mm2=covariance_mm2)

    def only(self, rows: Indices) -> "Observations":
        """Select rows."""
        return Observations(
            tuple(self.image[row] for row in rows),
            tuple(self.point[row] for row in rows),
            tuple(self.kind[row] for row in rows),
            self.xy_mm[rows],
            self.covariance_mm2[rows],
        )


@dataclass(frozen=True)
class Distance:
    """Measured distance between two object points, two stations, or a point and a station.

    start, end: name of a point, or of the image if no point has this name. value, sigma: distance and its standard
    deviation in object units.
    """

    start: str
    end: str
    value: float
    sigma: float


@dataclass(frozen=True)
class Calibration:
    """Earlier calibration of a camera, "equal to image observations" (Juhl).

    parameters (m,): keys of the camera's quantities; values (m,), covariance (m, m). They include the priors of that
    adjustment: these quantities must have no priors here.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
