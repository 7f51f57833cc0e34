"""Approximate principal distance from images of known points, for cameras without a given one.

A single image of a plane may not determine the principal distance of a pinhole camera. It does determine that of a
fisheye, whose projection differs from a pinhole even with all distortion parameters 0.
"""

from collections.abc import Sequence

import numpy as np

from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.projection import rays
from adjust.initial_values.pose import KnownField, Pose
from adjust.initial_values.resection import IMPLAUSIBLE, distance_together, resections, trial_misfits

GRID = np.geomspace(0.35, 16.0, 9)  # principal distances tried, in radii of the imaged field: 140 to 7 degrees
FEWEST = 4  # known points of an image
COARSE_IMAGES, COARSE_POINTS = 4, 15
FINE_IMAGES = 50
LARGEST_RELATIVE_SIGMA, CLEAR_SIGMA = 0.15, 0.05
ANGLES_DEG = np.arange(88.0, 8.0, -4.0)  # trial angles between the axis and the outermost point of all images
WIDE_IMAGES = 5
FEWEST_WIDE = 6  # known points of an image
HALVES = 4  # halvings of the step between trial angles in the fine search


def find_principal_distance(fields: Sequence[KnownField]) -> tuple[float | None, dict[KnownField, Pose]]:
    """Estimate the principal distance of a pinhole camera, in mm, together with poses of its images.

    Returns
    -------
    Principal distance, None if it is not determined; plausible poses of the images used.

    Notes
    -----
    A few images are resected with principal distances on a logarithmic grid. The best one starts a least-squares
    estimate over many images. A standard deviation above 15 % counts as not determined: on a flat field parallel to the
    image, a change of the principal distance cannot be separated from a change of the height.
    """
    fields = _largest_fields(fields, FEWEST, FINE_IMAGES)
    if not fields:
        return None, {}
    tried = GRID * _radius_mm(fields)
    misfits = trial_misfits([_thin_field(each) for each in fields[:COARSE_IMAGES]], tried)
    c, sigma = float(tried[int(np.argmin(misfits))]), np.inf
    found = resections(fields, [c] * len(fields))
    for _ in range(2):
        together = distance_together(fields, found, c)
        if together is None:
            return None, {}
        c, sigma, refined = together
        found = resections(fields, [c] * len(fields), refined)
        if sigma < CLEAR_SIGMA and all(each is other for each, other in zip(found, refined, strict=True)):
            break  # all images agree
    resected = [(field, each) for field, each in zip(fields, found, strict=True) if each is not None]
    poses = {field: each.pose for field, each in resected if each.sigma_mm <= IMPLAUSIBLE * c}
    return c if sigma < LARGEST_RELATIVE_SIGMA else None, poses


def find_wide_distance(fields: Sequence[KnownField], distortion: Distortion) -> float | None:
    """Estimate the principal distance of a wide-angle or fisheye lens, in mm; None if no image determines it.

    It minimises the residuals of the resections. fields: image coordinates relative to the principal point; distortion:
    as given.
    """
    fields = _largest_fields(fields, FEWEST_WIDE, WIDE_IMAGES)
    if not fields:
        return None
    radius_mm = _radius_mm(fields)

    def misfit(angle_deg: float) -> float:
        lens = Lens(distortion, np.array([radius_mm / np.radians(angle_deg), 0.0, 0.0]), distortion.values)
        return _misfit_mm2(fields, lens)

    left = [misfit(angle) for angle in ANGLES_DEG]
    best, step, least = float(ANGLES_DEG[int(np.argmin(left))]), float(ANGLES_DEG[0] - ANGLES_DEG[1]), min(left)
    for _ in range(HALVES):
        step /= 2.0
        least, best = min((least, best), *((misfit(angle), angle) for angle in (best - step, best + step)))
    return radius_mm / float(np.radians(best)) if np.isfinite(least) else None


def _thin_field(field: KnownField) -> KnownField:
    """Thin out the points of an image evenly, for the coarse search."""
    step = -(-len(field.xyz) // COARSE_POINTS)
    return KnownField(field.xyz[::step], field.xy_mm[::step], field.sigma_mm)


def _largest_fields(fields: Sequence[KnownField], fewest: int, most: int) -> list[KnownField]:
    """The images with most points, at most `most`; none with fewer points than `fewest`."""
    return sorted((each for each in fields if len(each.xyz) >= fewest), key=lambda each: -len(each.xyz))[:most]


def _radius_mm(fields: Sequence[KnownField]) -> float:
    x, y = np.concatenate([each.xy_mm for each in fields]).T
    return float(np.hypot(x, y).max())


def _misfit_mm2(fields: Sequence[KnownField], lens: Lens) -> float:
    """Sum over the images of the median squared residual, mm²; inf if an image has no pose."""
    ideal_mm, found = zip(*(lens.ideal_from_observed(each.xy_mm) for each in fields), strict=True)
    if not all(each.all() for each in found):
        return np.inf
    ideal = [KnownField(each.xyz, xy, each.sigma_mm) for each, xy in zip(fields, ideal_mm, strict=True)]
    total = 0.0
    for field, resection in zip(fields, resections(ideal, len(fields) * [float(lens.interior[0])]), strict=True):
        if resection is None:
            return np.inf
        ray, _ = rays(resection.pose.rotation, field.xyz - resection.pose.center)
        imaged_mm, imaged = lens.camera_from_ray(ray)
        total += float(np.median(np.where(imaged, ((imaged_mm - field.xy_mm) ** 2).sum(axis=1), np.inf)))
    return total
