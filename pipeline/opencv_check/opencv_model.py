"""OpenCV's camera models and the adjustment's: parameters, and conversion of lenses.

Parameters are those of cv2.calibrateCamera, or of cv2.fisheye.calibrate, in the unit of the camera frame: fx, fy, cx,
cy in mm, where cx and cy are the principal point x0', y0' (y up); k1 to s4 and the fisheye's alpha without unit; the
sensor's tilt tau_x, tau_y in rad, with OpenCV's signs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.lens_conversion import ConvertedLens, convert_lens
from pipeline.types import Array

INTERIOR = ("fx", "fy", "cx", "cy")
NAMES = (
    *INTERIOR, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y",
)  # fmt: skip
OPENCV_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")  # numerator and denominator
FISHEYE = "opencv_fisheye"  # name of this model's family in the adjustment
FISHEYE_NAMES = (*INTERIOR, "k1", "k2", "k3", "k4", "alpha")
Y_UP = np.array([1.0, -1.0])


@dataclass(frozen=True)
class Freedom:
    """Parameters of a model that are estimated. "fx" without "fy": one focal length, the ratio fx/fy is held."""

    names: tuple[str, ...]

    @property
    def held_interior(self) -> tuple[str, ...]:
        """Those of c, x0 and y0 that are held."""
        return tuple(own for own, name in (("c", "fx"), ("x0", "cx"), ("y0", "cy")) if name not in self.names)

    @property
    def distortion(self) -> tuple[str, ...]:
        """Estimated distortion parameters, by the names of the adjustment's family."""
        affinity = [own for own, name in (("b1", "fy"), ("b2", "alpha")) if name in self.names]
        return (*(name for name in self.names if name not in (*INTERIOR, "alpha")), *affinity)


def model_names(family: str) -> tuple[str, ...]:
    """Parameters of OpenCV's model for a distortion family."""
    return FISHEYE_NAMES if family == FISHEYE else NAMES


def to_opencv_model(lens: Lens, corners_mm: Array, estimated: Sequence[str]) -> ConvertedLens:
    """Convert a lens to the adjustment's family of OpenCV's model, over the rectangle between two corners (2, 2).

    Parameters
    ----------
    estimated : parameters that are fitted. If the lens has such a family already, its other parameters keep their
        values, except the shear b2, which cv2.calibrateCamera does not model.

    Raises
    ------
    AdjustmentError : the fit does not converge.
    """
    family = lens.distortion.family
    own = dict(zip(parameter_names(family), lens.parameters.tolist(), strict=True))
    begun = own if family in ("opencv", FISHEYE) else {}
    if family == "opencv":
        begun = own | {"b2": 0.0}
    model = FISHEYE if family == FISHEYE else "opencv"
    return convert_lens(lens, fixed(model, begun), corners_mm, estimated)


def fixed(family: str, values: Mapping[str, float]) -> Distortion:
    return Distortion(family, {name: Prior(value, 0.0) for name, value in values.items()})


def opencv_values(lens: Lens) -> tuple[Array, Array]:
    """OpenCV's parameters (n,) of a lens in the family of its model, and their derivatives (n, 3 + k) with respect to
    c, x0', y0' and the family's parameters."""
    (c, x0, y0), (*others, b1, b2) = lens.interior, lens.parameters
    values = [c * (1.0 + b1), c, x0, y0, *others]
    by_lens = np.zeros((len(values) + 1, 3 + len(lens.parameters)))
    by_lens[0, [0, -2]], by_lens[1, 0] = (1.0 + b1, c), 1.0
    by_lens[2 : len(values), 1:-2] = np.eye(len(values) - 2)
    by_lens[-1, -2:] = -b2 / (1.0 + b1) ** 2, 1.0 / (1.0 + b1)
    if lens.distortion.family == FISHEYE:
        return np.array([*values, b2 / (1.0 + b1)]), by_lens
    return np.array(values), by_lens[:-1]


def camera_matrix(values: Array) -> Array:
    """OpenCV's camera matrix (3, 3), in mm with y down."""
    fx, fy, cx, cy = values[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, -cy], [0.0, 0.0, 1.0]])
