"""What a measurement hands on: marks with covariance, status and reason, and the frame they were found in."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from measure.covariance import Covariance
from measure.status import Status

Kind = Literal["fiducial", "target", "tie"]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class MarkMeasurement:
    """One mark in one scan.

    center_px: (2,) column and row, the centre of the top-left pixel being (0, 0). With status `predicted` it is the
    predicted place, with `absent` it may be None: there is nothing to say.
    covariance: of the centre, by its causes; None where nothing was fitted.
    reason: one sentence; empty only when the status is `measured`.
    quality: named figures of the fit: snr, contrast_dn, blur_px, noise_dn, damaged_fraction, second_method_sigmas, ...
    """

    point: str
    kind: Kind
    center_px: Array | None
    covariance: Covariance | None
    status: Status
    reason: str = ""
    quality: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.status.is_observation and (self.center_px is None or self.covariance is None):
            raise ValueError(f"mark {self.point}: a {self.status} mark needs a centre and a covariance")
        if self.status is not Status.MEASURED and not self.reason:
            raise ValueError(f"mark {self.point}: the status {self.status} needs a reason")

    @property
    def covariance_px2(self) -> Array | None:
        """(2, 2) of (column, row), all causes together; None where nothing was fitted."""
        return None if self.covariance is None else self.covariance.px2


@dataclass(frozen=True)
class Pose:
    """How the scan was laid on the scanner: its counter-clockwise turn in degrees, "m" behind it if mirrored.

    A scan of pose "90m": the camera frame (x' right, y' up) is first mirrored (x' to -x'), then turned by 90 degrees
    counter-clockwise, and so seen in the scan.
    decided: whether something in the picture (or the user) decides it; otherwise it is assumed.
    evidence: what speaks for it, and by how much, one sentence each.
    """

    name: str
    decided: bool
    evidence: tuple[str, ...] = ()


@dataclass(frozen=True)
class FrameMeasurement:
    """All marks of one scan.

    pixel_from_camera: (2, 3) affine matrix, camera mm (x', y', 1) to (column, row), from the fiducials found; None
    where there are too few.
    weights: what each channel of a colour scan counts in what its fiducials were measured in; None for its grey value.
    problems: what the user should look at, one sentence each.
    """

    image: str
    marks: tuple[MarkMeasurement, ...]
    pose: Pose | None = None
    pixel_from_camera: Array | None = None
    problems: tuple[str, ...] = ()
    weights: tuple[float, ...] | None = None

    @property
    def px_per_mm(self) -> float | None:
        """The scale of pixel_from_camera, the mean of both directions; None without one."""
        matrix = self.pixel_from_camera
        return None if matrix is None else float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
