"""An approximate principal distance from images of known points, where the camera brings none.

Of a pinhole a single image of a plane may leave it open; of a lens that is none while its parameters are 0, a fisheye,
not even a single image of a plane fits with a wrong one.
"""

from collections.abc import Sequence

import numpy as np

from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.projection import rays
from adjust.initial_values.dlt import LINE, PLANE, principal_distance_together
from adjust.initial_values.pose import KnownField
from adjust.initial_values.resection import Resection, refine, resect

GRID = np.geomspace(0.35, 16.0, 14)  # principal distances tried, in radii of the imaged field: 140 to 7 degrees
FEWEST = 4  # points of an image
COARSE_IMAGES = 5
FINE_IMAGES = 12
LARGEST_RELATIVE_SIGMA = 0.15
ANGLES_DEG = np.arange(88.0, 8.0, -4.0)  # off the axis at which the outermost point of all images is tried
WIDE_IMAGES = 5
FEWEST_WIDE = 6  # points of an image
HALVES = 4  # of the step between angles, for the last search


def find_principal_distance(fields: Sequence[KnownField]) -> float | None:
    """The principal distance in mm with which resections of all images leave the least; None where they do not tell.

    In closed form, where all points agree. Otherwise every image is resected with principal distances on a logarithmic
    grid, and the sum of the squared residuals is then minimised about the best. They do not tell when the minimum is so
    flat that the principal distance has a standard deviation above 15 %: a flat field parallel to the image, where a
    change of it is a change of the height.
    """
    fields = _largest_fields(fields, FEWEST, FINE_IMAGES)
    if not fields:
        return None
    together = principal_distance_together(fields)
    if together is not None and together[1] < LARGEST_RELATIVE_SIGMA:
        return together[0]
    radius = max(float(np.linalg.norm(f.xy_mm, axis=1).max()) for f in fields)
    costs = [_trimmed_cost(fields[:COARSE_IMAGES], c) for c in GRID * radius]
    found = float(GRID[int(np.argmin(costs))] * radius)
    step = GRID[1] / GRID[0]
    for width in (step**2, step):
        resections = _resections(fields, found)
        if not resections:
            return None
        found = _minimum(fields, resections, found, width)
    return found if _relative_sigma(fields, _resections(fields, found), found) < LARGEST_RELATIVE_SIGMA else None


def _largest_fields(fields: Sequence[KnownField], fewest: int, most: int) -> list[KnownField]:
    """Those with most points, up to a number of them; none with too few points."""
    return sorted((each for each in fields if len(each.xyz) >= fewest), key=lambda each: -len(each.xyz))[:most]


def _resections(fields: Sequence[KnownField], c: float) -> dict[int, Resection]:
    """The resections, by the number of the image, that succeed; a fixed seed keeps results repeatable."""
    attempts = {i: resect(f.xyz, f.xy_mm, c, np.random.default_rng(i), f.sigma_mm) for i, f in enumerate(fields)}
    return {i: resection for i, resection in attempts.items() if resection is not None}


def _trimmed_cost(fields: Sequence[KnownField], c: float) -> float:
    resections = _resections(fields, c)
    return sum(len(fields[i].xyz) * r.sigma_mm**2 for i, r in resections.items()) if resections else np.inf


def _minimum(fields: Sequence[KnownField], resections: dict[int, Resection], c: float, width: float) -> float:
    from scipy.optimize import minimize_scalar  # takes longer to import than most adjustments

    logarithm = minimize_scalar(
        lambda s: _cost(fields, resections, float(np.exp(s))),
        bounds=(np.log(c / width), np.log(c * width)),
        method="bounded",
        options={"xatol": 1e-4},
    ).x
    return float(np.exp(logarithm))


def _cost(fields: Sequence[KnownField], resections: dict[int, Resection], c: float) -> float:
    """Sum of squared residuals in mm² of the points that agreed."""
    total = 0.0
    for i, resection in resections.items():
        moved = refine(resection, fields[i].xyz, fields[i].xy_mm, c)
        total += float((moved.distances_mm[moved.inliers] ** 2).sum())
    return total


def _relative_sigma(fields: Sequence[KnownField], resections: dict[int, Resection], c: float) -> float:
    """Standard deviation of ln c from the curvature of the sum of squares."""
    delta = 0.03
    lower, middle, upper = (_cost(fields, resections, c * float(np.exp(s))) for s in (-delta, 0.0, delta))
    curvature = (lower - 2 * middle + upper) / delta**2
    redundancy = sum(2 * int(r.inliers.sum()) - 6 for r in resections.values()) - 1
    noise = max(middle / max(redundancy, 1), max(f.sigma_mm for f in fields) ** 2)
    return float(np.sqrt(2 * noise / curvature)) if curvature > 0 else np.inf


def taper(field: KnownField) -> float | None:
    """By what part the scale changes across the image of a flat field, by its homography; None where it is not flat."""
    centred = field.xyz - field.xyz.mean(axis=0)
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    if extents[1] <= LINE * extents[0] or extents[2] > PLANE * extents[0]:
        return None
    places = np.column_stack([centred @ axes[:2].T / extents[0], np.ones(len(centred))])
    xy = field.xy_mm / np.abs(field.xy_mm).max()
    nothing = np.zeros_like(places)
    rows = [np.hstack([places, nothing, -xy[:, :1] * places]), np.hstack([nothing, places, -xy[:, 1:] * places])]
    depth = places @ np.linalg.svd(np.vstack(rows))[2][-1][6:]
    return float(np.ptp(depth) / abs(depth.mean()))


def find_wide_distance(fields: Sequence[KnownField], distortion: Distortion) -> float | None:
    """The principal distance in mm with which resections leave the least; None where no image tells it.

    fields: places about the principal point; distortion: as it is given.
    """
    fields = _largest_fields(fields, FEWEST_WIDE, WIDE_IMAGES)
    if not fields:
        return None
    radius_mm = max(float(np.linalg.norm(each.xy_mm, axis=1).max()) for each in fields)

    def misfit(angle_deg: float) -> float:
        lens = Lens(distortion, np.array([radius_mm / np.radians(angle_deg), 0.0, 0.0]), distortion.values)
        return sum(_misfit_mm2(each, i, lens) for i, each in enumerate(fields))

    left = [misfit(angle) for angle in ANGLES_DEG]
    best, step = float(ANGLES_DEG[int(np.argmin(left))]), float(ANGLES_DEG[0] - ANGLES_DEG[1])
    least = min(left)
    for _ in range(HALVES):
        step /= 2.0
        for angle in (best - step, best + step):
            here = misfit(angle)
            if here < least:
                best, least = angle, here
    return radius_mm / float(np.radians(best)) if np.isfinite(least) else None


def _misfit_mm2(field: KnownField, number: int, lens: Lens) -> float:
    """The median square by which an image's points miss where they were observed; inf where no pose is found."""
    ideal_mm, found = lens.ideal_from_observed(field.xy_mm)
    if found.sum() < FEWEST_WIDE or not found.all():
        return np.inf
    resection = resect(field.xyz, ideal_mm, float(lens.interior[0]), np.random.default_rng(number), field.sigma_mm)
    if resection is None:
        return np.inf
    ray, _ = rays(resection.pose.rotation, field.xyz - resection.pose.center)
    imaged_mm, imaged = lens.camera_from_ray(ray)
    squares = np.where(imaged, ((imaged_mm - field.xy_mm) ** 2).sum(axis=1), np.inf)
    return float(np.median(squares))
