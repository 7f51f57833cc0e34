"""Selection of a digital camera's lens model by cross-validation: the simplest that predicts images left out as well as
any."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment
from pipeline.types import Array

LensModel = Literal["opencv4", "opencv5", "opencv8", "fisheye"]
LensSetting = LensModel | Literal["auto"]
Adjust = Callable[[Network], Adjustment]

PARAMETERS: dict[LensModel, tuple[str, ...]] = {
    "opencv4": ("k1", "k2", "p1", "p2"),
    "opencv5": ("k1", "k2", "p1", "p2", "k3"),
    "opencv8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}  # from the simplest; each but the last extends the one before
FOLDS = 5
FEWEST_PICTURES = 6  # images needed for the cross-validation
WIDE = 1.0  # half the image's diagonal over the principal distance, above which a fisheye is tried: 45 degrees


@dataclass(frozen=True)
class LensChoice:
    """Selected lens model. rms_px: by model, prediction error of a point in images left out; None without a
    solution."""

    model: LensModel
    rms_px: Mapping[LensModel, float | None]


def free_lens(model: LensModel, square_pixels: bool) -> Distortion:
    """Distortion of a model with all parameters free, including b1 (fx differs from fy) unless the pixels are
    square."""
    family = "opencv_fisheye" if model == "fisheye" else "opencv"
    names = PARAMETERS[model] if square_pixels else (*PARAMETERS[model], "b1")
    return Distortion(family, {name: Prior(0.0, np.inf) for name in names})


def choose_lens(network: Network, square_pixels: bool, pixel_mm: float, adjusted: Adjust) -> LensChoice:
    """Select the lens model of a camera by cross-validation over its images.

    One fifth of the images is left out in turn. Their points are predicted with the camera of the others, after a space
    resection of each, using the normal equations of all images. A model with more parameters is taken where its
    predictions are better by more than the standard error of the difference over the images.

    Parameters
    ----------
    network : of one camera and its images, with equal standard deviations of all marks
    square_pixels : whether fx and fy are equal
    pixel_mm : side of a pixel
    adjusted : adjusts a network
    """
    if len(network.images) < FEWEST_PICTURES:
        return LensChoice("opencv4", {})
    squares: dict[LensModel, Array | None] = {}
    best: LensModel = "opencv4"
    (camera,), is_wide = network.cameras, False
    for model in PARAMETERS:
        if model == "fisheye" and not is_wide:
            continue
        free = replace(camera, distortion=free_lens(model, square_pixels))
        fitted = _try_adjustment(replace(network, cameras=(free,)), adjusted)
        squares[model] = None if fitted is None else fitted.prediction_errors(FOLDS)
        if model == "opencv4":
            c_mm = 0.0 if fitted is None else fitted.value(Parameter.interior(camera.name, "c"))
            is_wide = float(np.hypot(*camera.frame_mm)) / 2.0 > WIDE * c_mm
        elif _is_better(squares[model], squares[best]):
            best = model
    sigma_px = np.sqrt(network.observations.covariance_mm2[0, 0, 0]) / pixel_mm
    rms_px = {
        model: None if each is None else float(np.sqrt(each.mean()) * sigma_px) for model, each in squares.items()
    }
    return LensChoice(best, rms_px)


def _is_better(squares: Array | None, than: Array | None) -> bool:
    if squares is None or than is None:
        return squares is not None
    gain = than - squares
    return bool(gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain)))


def _try_adjustment(network: Network, adjusted: Adjust) -> Adjustment | None:
    """Adjust a network; None without a solution."""
    try:
        result = adjusted(network)
    except AdjustmentError:
        return None
    return result if result.converged else None
