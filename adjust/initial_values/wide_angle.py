"""An approximate principal distance of a lens that is no pinhole while its parameters are 0, a fisheye.

Its images say more of c than a pinhole's do: with a wrong one not even a single image of a plane fits.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.projection import rays
from adjust.initial_values.dlt import KnownField
from adjust.initial_values.resection import resect

Array = NDArray[np.float64]

_ANGLES_DEG = np.arange(88.0, 8.0, -4.0)  # off the axis at which the outermost point of all images is tried
_IMAGES = 5
_FEWEST = 6  # points of an image
_HALVES = 4  # of the step between angles, for the last search


def find_wide_distance(fields: Sequence[KnownField], distortion: Distortion) -> float | None:
    """The principal distance in mm with which resections leave the least; None where no image tells it.

    fields: places about the principal point; distortion: as it is given.
    """
    fields = sorted((each for each in fields if len(each.xyz) >= _FEWEST), key=lambda each: -len(each.xyz))[:_IMAGES]
    if not fields:
        return None
    radius_mm = max(float(np.linalg.norm(each.xy_mm, axis=1).max()) for each in fields)

    def misfit(angle_deg: float) -> float:
        lens = Lens(distortion, np.array([radius_mm / np.radians(angle_deg), 0.0, 0.0]), distortion.values)
        return sum(_misfit_mm2(each, i, lens) for i, each in enumerate(fields))

    left = [misfit(angle) for angle in _ANGLES_DEG]
    best, step = float(_ANGLES_DEG[int(np.argmin(left))]), float(_ANGLES_DEG[0] - _ANGLES_DEG[1])
    least = min(left)
    for _ in range(_HALVES):
        step /= 2.0
        for angle in (best - step, best + step):
            here = misfit(angle)
            if here < least:
                best, least = angle, here
    return radius_mm / float(np.radians(best)) if np.isfinite(least) else None


def _misfit_mm2(field: KnownField, number: int, lens: Lens) -> float:
    """The median square by which an image's points miss where they were observed; inf where no pose is found."""
    ideal_mm, found = lens.ideal_from_observed(field.xy_mm)
    if found.sum() < _FEWEST or not found.all():
        return np.inf
    resection = resect(field.xyz, ideal_mm, float(lens.interior[0]), np.random.default_rng(number), field.sigma_mm)
    if resection is None:
        return np.inf
    ray, _ = rays(resection.pose.rotation, field.xyz - resection.pose.center)
    seen_mm, imaged = lens.camera_from_ray(ray)
    squares = np.where(imaged, ((seen_mm - field.xy_mm) ** 2).sum(axis=1), np.inf)
    return float(np.median(squares))
