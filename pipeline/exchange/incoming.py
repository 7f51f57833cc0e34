"""What comes in from other programs, before it is written as this one's."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.files.camera_file import CameraFile

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForeignMark:
    """A mark of another program. place (2,): column and row, the first pixel's centre (0, 0). covariance_px2
    (2, 2): None where the other program has none."""

    image: str
    point: str
    kind: Literal["fiducial", "target"]
    place: Array
    covariance_px2: Array | None


@dataclass(frozen=True)
class ForeignPose:
    """An image's orientation: rotation (3, 3) from the object to axes x right, y up, looking along -z; station (3,)."""

    image: str
    rotation: Array
    station: Array


@dataclass(frozen=True)
class ImportOptions:
    """pitch_um: of the pixels of the other program's pictures; sigma_px: of marks that have none of their own;
    from_middle: the principal point counts from the picture's middle, as of a film camera; fiducials: the marks are."""

    pitch_um: float | None = None
    sigma_px: float | None = None
    from_middle: bool = False
    fiducials: bool = False


@dataclass(frozen=True)
class Incoming:
    """What files of another program hold. notes: what to know of it; tables: files that are written as they are."""

    marks: tuple[ForeignMark, ...] = ()
    cameras: tuple[CameraFile, ...] = ()
    poses: tuple[ForeignPose, ...] = ()
    notes: tuple[str, ...] = ()
    tables: dict[str, str] = field(default_factory=dict)
