"""A solution of the bare problem in OpenCV's model, with standard deviations."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens_conversion import convert_lens
from adjust.problem.images import adjusted_lens
from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment
from pipeline.opencv_check.bare_problem import COUNTERPARTS, BareProblem
from pipeline.opencv_check.opencv_model import FISHEYE, fixed, opencv_values, to_opencv_model

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Converted:
    """A solution in OpenCV's model: parameters (n,) and a-priori standard deviations (n,) in the order of
    `opencv_model.model_names`; residual_mm: what is left between the two lenses over the image, rms a point."""

    parameters: Array
    sigmas: Array
    residual_mm: float


def converted(problem: BareProblem, solved: Adjustment) -> Converted:
    """Raises AdjustmentError where the lens cannot be brought to OpenCV's model."""
    camera = problem.network.cameras[0]
    family = camera.distortion.family
    lens = adjusted_lens(solved, camera.name)
    own = [Parameter.interior(camera.name, each) for each in lens.quantities]
    observed = problem.network.observations.xy_mm
    corners_mm = np.array([observed.min(axis=0), observed.max(axis=0)])
    whole = to_opencv_model(lens, corners_mm, _whole(family))
    # What OpenCV does not estimate it holds at these values, and so they are for its standard deviations.
    held = dict(zip(whole.lens.quantities[3:], whole.lens.parameters.tolist(), strict=True))
    model = fixed(whole.lens.distortion.family, held)
    known = replace(lens, covariance=solved.cofactor_of(own))
    free = convert_lens(known, model, corners_mm, problem.freedom.distortion, held=problem.freedom.held)
    parameters, _ = opencv_values(whole.lens)
    _, by_lens = opencv_values(free.lens)
    covariance = by_lens @ free.lens.covariance @ by_lens.T
    return Converted(parameters, np.sqrt(np.maximum(np.diag(covariance), 0.0)), whole.rms_mm)


def _whole(family: str) -> tuple[str, ...]:
    """All parameters that a family can need in OpenCV's model."""
    if family in ("opencv", FISHEYE):
        return ("b1",)
    return ("k1", "k2", "p1", "p2", "k3", *(["b1"] if "fy" in COUNTERPARTS[family].values() else []))
