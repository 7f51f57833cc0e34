"""Robust space resection: poses of many images at once from their known points.

Candidates are the P3P poses of triples of points; the field may be flat or deep. The best ones by least trimmed squares
(Rousseeuw and Van Driessen 2006) are refined on the half of the points with the smallest residuals, and the best of
these on all inliers. A few triples suffice where most points agree on a pose; otherwise many are tried.

An approximate principal distance follows from images of known points. A single image of a plane may not determine that
of a pinhole camera. It does determine that of a fisheye, whose projection differs from a pinhole even with all
distortion parameters 0.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.projection import rays
from adjust.initial_values.dlt import closed_form, interior_orientation, linear_transformations
from adjust.initial_values.pose import (
    KnownField,
    Pose,
    refined_distance,
    refined_poses,
    squared_residuals,
    triple_poses,
)

MAX_TRIPLES = 120  # enough for one without gross errors if every third point is wrong
FEWEST_QUICK = 16  # points of an image, half of which suffice to test whether they agree
WORSE = 3.0  # ratio of the residuals to their usual standard deviation up to which points agree
TYPICAL = 10  # images needed to estimate the residuals due to a still unknown lens by their median
LARGEST_TYPICAL = 0.01  # in principal distances: a larger median may mean that all resections are wrong
REJECTION = 13.8  # 0.1 % point of the squared residual's chi-square (2) distribution, in sigma²
IMPLAUSIBLE = 0.05  # in principal distances: larger residuals mean misidentified points
LINE = 1e-5  # width over length of collinear points: the camera may rotate around their line
POINTS_AT_ONCE = 20_000
SOUND = 0.95  # least share of inliers without gross errors
REWEIGHTINGS = 2  # largest number of estimates of a principal distance, each from the inliers of the one before
GRID = np.geomspace(0.35, 16.0, 9)  # principal distances tried, in radii of the imaged field: 140 to 7 degrees
FEWEST = 4  # known points of an image
FEWEST_LINEAR = 6  # known points of an image that determine its linear transformation
FEWEST_DIRECT = 3  # images that determine a principal distance by linear transformations
COARSE_IMAGES, COARSE_POINTS = 4, 15  # images and points of each that choose a principal distance
FINE_IMAGES = 50  # images that refine it
LARGEST_RELATIVE_SIGMA, CLEAR_SIGMA = 0.15, 0.05  # of a principal distance that is used, and that ends the search
ANGLES_DEG = np.arange(88.0, 8.0, -4.0)  # trial angles between the axis and the outermost point of all images
WIDE_IMAGES = 5  # images that choose a wide field's
FEWEST_WIDE = 6  # known points of an image
HALVES = 4  # halvings of the step between trial angles in the fine search


class Effort(NamedTuple):
    """Effort of a resection."""

    triples: int  # triples of points per image
    points: int  # largest number of points on which poses are tested
    refined: int  # poses refined per image; must include both minima of a flat field
    rounds: int  # number of refinements


TRIAL, QUICK, THOROUGH = Effort(5, 30, 1, 0), Effort(5, 30, 2, 1), Effort(MAX_TRIPLES, 200, 16, 2)


@dataclass(frozen=True)
class Resection:
    """Result of a space resection: pose, inlier mask (n,), robust standard deviation of an image coordinate in mm."""

    pose: Pose
    inliers: Mask
    sigma_mm: float


def resect_images(fields: Sequence[KnownField], principal_distances_mm: Sequence[float]) -> list[Pose | None]:
    """Determine the poses of images from their known points.

    Parameters
    ----------
    fields : at least four points per image.
    principal_distances_mm : one per image.

    Returns
    -------
    Poses; None for an image without a plausible one.
    """
    found = zip(resections(fields, principal_distances_mm), principal_distances_mm, strict=True)
    return [None if each is None or each.sigma_mm > IMPLAUSIBLE * c else each.pose for each, c in found]


def resect(xyz: Array, xy_mm: Array, principal_distance_mm: float, floor_mm: float = 1e-4) -> Resection | None:
    """Resect one image robustly.

    Parameters
    ----------
    xyz : (n, 3) object points, flat or not, n >= 4.
    xy_mm : (n, 2) distortion-free image coordinates relative to the principal point, y up.
    floor_mm : lower bound of the standard deviation of image coordinates: limits the rejection of outliers.

    Returns
    -------
    The pose that fits most points; None where the points do not determine one (collinear, for example).
    """
    return _resect_fields([KnownField(xyz, xy_mm, floor_mm)], np.array([principal_distance_mm]), THOROUGH)[0]


def resections(
    fields: Sequence[KnownField],
    principal_distances_mm: Sequence[float],
    found: Sequence[Resection | None] | None = None,
) -> list[Resection | None]:
    """Resect images with at least four known points.

    Parameters
    ----------
    found : optional; earlier resections, of which only those are repeated whose points do not agree.

    Returns
    -------
    Resections; None for images with fewer points, or points that do not determine a pose.

    Notes
    -----
    Points agree if the residuals match their standard deviations, or those of most images: a still unknown lens causes
    residuals everywhere. Where they do not, the resection is repeated with more effort.
    """
    c = np.array(principal_distances_mm, dtype=np.float64)
    if found is None:
        quick = [i for i, field in enumerate(fields) if len(field.xyz) >= FEWEST_QUICK]
        of_quick = dict(zip(quick, _resect_fields([fields[i] for i in quick], c[quick], QUICK), strict=True))
        found = [of_quick.get(i) for i in range(len(fields))]
    result, again = list(found), _disagreeing(fields, c, found)
    for i, each in zip(again, _resect_fields([fields[i] for i in again], c[again], THOROUGH), strict=True):
        result[i] = each
    return result


def _disagreeing(fields: Sequence[KnownField], c: Array, found: Sequence[Resection | None]) -> list[int]:
    """Images, of at least four points, whose points do not agree on a pose."""
    sigmas = [each.sigma_mm / c[i] for i, each in enumerate(found) if each is not None]
    typical = float(np.median(sigmas)) if len(sigmas) >= TYPICAL else 0.0
    typical = typical if typical < LARGEST_TYPICAL else 0.0
    return [
        i
        for i, (field, each) in enumerate(zip(fields, found, strict=True))
        if len(field.xyz) >= 4 and (each is None or each.sigma_mm > WORSE * max(field.sigma_mm, typical * c[i]))
    ]


def trial_misfits(fields: Sequence[KnownField], principal_distances_mm: Array) -> Array:
    """Misfits (m,) in mm² of images, at least four points each, with trial principal distances (m,).

    Each is the geometric mean over the images of the robust variance of a coordinate, for the best pose from a few
    triples: the likelihood where each image has its own variance, so that misidentified points of one image do not
    decide. The points are thinned out evenly.
    """
    steps = [-(-len(each.xyz) // COARSE_POINTS) for each in fields]
    thin = [
        KnownField(each.xyz[::step], each.xy_mm[::step], each.sigma_mm)
        for each, step in zip(fields, steps, strict=True)
    ]
    c = np.repeat(principal_distances_mm, len(thin))
    variances = c**2  # of images without a pose
    for some, batch, rotations, shifts, image in _best_poses(len(principal_distances_mm) * thin, c, TRIAL):
        sigma = _robust_sigmas(batch.squared(rotations, shifts, image), batch.counts[image])
        variances[some[image]] = (sigma * batch.c[image]) ** 2
    floor = np.array([field.sigma_mm for field in thin]) ** 2
    return np.asarray(np.exp(np.log(variances.reshape(-1, len(thin)) + floor).mean(axis=1)))


def distance_together(
    fields: Sequence[KnownField], found: Sequence[Resection | None], principal_distance_mm: float
) -> tuple[float, float, list[Resection | None]] | None:
    """Estimate a principal distance by least squares over all images resected with an approximate one.

    The inliers are chosen again by their residuals, free of the distortion that is estimated with it. Images without a
    plausible pose count only if there are no others. Returns the principal distance in mm, the standard deviation of
    its logarithm, and the resections; None if no image was resected or the estimate fails.
    """
    most_mm = IMPLAUSIBLE * principal_distance_mm
    resected = [i for i, each in enumerate(found) if each is not None and each.sigma_mm <= most_mm]
    resected = resected or [i for i, each in enumerate(found) if each is not None]
    known = [each for i in resected if (each := found[i]) is not None]
    if not known:
        return None
    batch = _Fields.from_fields([fields[i] for i in resected], np.full(len(known), principal_distance_mm))
    rotations = np.array([each.pose.rotation for each in known])
    centers = (np.array([each.pose.center for each in known]) - batch.origin) / batch.size[:, None]
    shifts = -np.einsum("kij,kj->ki", rotations, centers)
    inliers = np.zeros_like(batch.present)
    inliers[batch.present] = np.concatenate([each.inliers for each in known])
    together = _refine_jointly(batch, rotations, shifts, inliers)
    if together is None:
        return None
    c, spread, refined = together
    of_image = dict(zip(resected, refined, strict=True))
    return c, spread, [of_image.get(i) for i in range(len(fields))]


def distance_directly(fields: Sequence[KnownField]) -> tuple[float, float, list[Resection]] | None:
    """Estimate a principal distance as `distance_together`, from linear transformations of all points.

    Returns None where the linear transformations do not determine it, or not nearly all points agree: gross errors take
    a search.
    """
    if len(fields) < FEWEST_DIRECT or min(len(field.xyz) for field in fields) < FEWEST_QUICK:
        return None
    batch = _Fields.from_fields(fields, np.ones(len(fields)))
    start = closed_form(linear_transformations(batch.points, batch.tangents, batch.present))
    if start is None or not GRID[0] < start[0] / _radius_mm(fields) < GRID[-1]:
        return None
    c, rotations, shifts = start
    batch = replace(batch, tangents=batch.tangents / c, c=np.full(len(fields), c), floor=batch.floor / c)
    together = _refine_jointly(batch, rotations, shifts, batch.present)
    if together is None or _disagreeing(fields, np.full(len(fields), together[0]), together[2]):
        return None
    inlier_share = np.concatenate([each.inliers for each in together[2]]).mean()
    return together if inlier_share > SOUND and together[1] < CLEAR_SIGMA else None


def _refine_jointly(
    batch: "_Fields", rotations: Array, shifts: Array, inliers: Mask
) -> tuple[float, float, list[Resection]] | None:
    """Principal distance, standard deviation of its logarithm and resections by least squares; None without them."""
    c, floor_mm, every = float(batch.c[0]), batch.floor * batch.c, np.arange(len(rotations))
    xy_mm = batch.tangents * c
    for _ in range(REWEIGHTINGS):
        try:
            c, spread, rotations, shifts, tangents = refined_distance(
                rotations, shifts, batch.points, xy_mm, inliers.astype(np.float64), c, float(floor_mm.max())
            )
        except np.linalg.LinAlgError:
            return None
        batch = replace(batch, tangents=tangents, c=np.full(len(rotations), c), floor=floor_mm / c)
        before = inliers
        sigma, inliers = batch.inliers(rotations, shifts, every)
        if (inliers == before).all():
            break
    return c, spread, batch.resections(rotations, shifts, every, sigma, inliers)


@dataclass(frozen=True, eq=False)
class _Fields:
    """Padded arrays of the known points in k images."""

    points: Array  # (k, n, 3), reduced to their mean and divided by their extent
    tangents: Array  # (k, n, 2) image coordinates over c
    present: Mask  # (k, n) mask of the points that exist, the padding last
    # origin, size: (k, 3) mean and (k,) extent of the points
    origin: Array
    size: Array
    c: Array  # (k,) principal distances, mm
    floor: Array  # (k,) lower bounds of the standard deviation of a tangent

    @classmethod
    def from_fields(cls, fields: Sequence[KnownField], c: Array) -> "_Fields":
        counts = np.array([len(field.xyz) for field in fields])
        present = np.arange(counts.max()) < counts[:, None]
        points, tangents = np.zeros((*present.shape, 3)), np.zeros((*present.shape, 2))
        points[present] = np.concatenate([field.xyz for field in fields])
        tangents[present] = np.concatenate([field.xy_mm for field in fields])
        origin = points.sum(axis=1) / counts[:, None]
        points = np.where(present[..., None], points - origin[:, None], 0.0)
        extents = np.ptp(points.swapaxes(1, 2).copy(), axis=2)  # along contiguous coordinates, nine times as quick
        size = np.maximum(np.linalg.norm(extents, axis=1), np.finfo(float).tiny)
        floor = np.array([field.sigma_mm for field in fields]) / c
        return cls(points / size[:, None, None], tangents / c[:, None, None], present, origin, size, c, floor)

    @property
    def counts(self) -> Indices:
        """(k,) numbers of points."""
        return np.asarray(self.present.sum(axis=1))

    def poses(self, rotations: Array, shifts: Array, image: Indices) -> list[Pose]:
        """Poses of the given images in object units."""
        centers = self.origin[image] - self.size[image, None] * (shifts[:, None] @ rotations)[:, 0]
        return [Pose(rotation, center) for rotation, center in zip(rotations, centers, strict=True)]

    def resections(
        self, rotations: Array, shifts: Array, image: Indices, sigma: Array, inliers: Mask
    ) -> list[Resection]:
        """Resections of the given images, from their poses, standard deviations of a tangent and inliers."""
        poses, counts, sigmas_mm = self.poses(rotations, shifts, image), self.counts[image], sigma * self.c[image]
        rows = zip(poses, inliers, counts, sigmas_mm.tolist(), strict=True)
        return [Resection(pose, mask[:count], sigma_mm) for pose, mask, count, sigma_mm in rows]

    def sample(self, most: int) -> "_Fields":
        """Draw `most` points per image at random, if some image has more."""
        if self.present.shape[1] <= most:
            return self
        drawn = (np.random.default_rng(0).random(most) * self.counts[:, None]).astype(np.intp)
        at = np.arange(len(drawn))[:, None], drawn
        present = np.ones(drawn.shape, dtype=bool)
        return _Fields(self.points[at], self.tangents[at], present, self.origin, self.size, self.c, self.floor)

    def squared(self, rotations: Array, shifts: Array, image: Indices) -> Array:
        """Squared residuals (c, n) of c poses, each of one image (c,); inf for the padding."""
        squared = squared_residuals(rotations, shifts, self.points[image], self.tangents[image])
        return np.where(self.present[image], squared, np.inf)

    def inliers(self, rotations: Array, shifts: Array, image: Indices) -> tuple[Array, Mask]:
        """Robust standard deviations (c,) of the tangents of c poses, and their inliers (c, n)."""
        squared = self.squared(rotations, shifts, image)
        sigma = np.maximum(_robust_sigmas(squared, self.counts[image]), self.floor[image])
        return sigma, squared < REJECTION * sigma[:, None] ** 2

    def candidates(self, effort: Effort) -> tuple[Array, Array, Indices]:
        """Best P3P poses: rotations (c, 3, 3), shifts (c, 3), and the image (c,) of each, image by image.

        From all triples of points, or random ones without slender triangles, which give poor poses.
        """
        counts, most = self.counts, effort.triples
        if comb(int(counts.max()), 3) <= MAX_TRIPLES:
            every = np.array(list(combinations(range(int(counts[0])), 3)), dtype=np.intp)
            triples = np.broadcast_to(every, (len(counts), *every.shape))
        else:
            drawn = (np.random.default_rng(0).random((4 * most, 3)) * counts[:, None, None]).astype(np.intp)
            a, b, c = np.moveaxis(self.tangents[np.arange(len(counts))[:, None, None], drawn], 2, 0)
            area = np.abs((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])
            slender = (area == 0.0) | (area < 0.5 * np.median(area, axis=1, keepdims=True))
            triples = np.take_along_axis(drawn, np.argsort(slender, axis=1, kind="stable")[:, :most, None], axis=1)
        image = np.repeat(np.arange(len(triples)), triples.shape[1])
        at = image[:, None], triples.reshape(-1, 3)
        rotations, shifts, triple = triple_poses(self.points[at], self.tangents[at])
        best = self.best(rotations, shifts, image[triple], effort.refined)
        return rotations[best], shifts[best], image[triple][best]

    def best(self, rotations: Array, shifts: Array, image: Indices, most: int) -> Indices:
        """Indices of each image's poses with the least trimmed squares, at most `most`."""
        cost = np.sort(self.squared(rotations, shifts, image), axis=1).cumsum(axis=1)
        half = _trimmed_counts(self.counts[image])
        order = np.lexsort((cost[np.arange(len(cost)), half - 1], image))
        return order[np.arange(len(order)) - np.searchsorted(image[order], image[order]) < most]


def _best_poses(
    fields: Sequence[KnownField], c: Array, effort: Effort
) -> Iterator[tuple[Indices, "_Fields", Array, Array, Indices]]:
    """Yield batches of fields with the best pose of each: numbers of the fields, batch, rotations, shifts, image.

    The images of a batch have similar numbers of points; equal ones where all triples are used.
    """
    counts = np.array([len(field.xyz) for field in fields], dtype=np.intp)
    order = np.argsort(-counts, kind="stable")
    while len(order):
        largest = int(counts[order[0]])
        fewest = largest if comb(largest, 3) <= MAX_TRIPLES else max(largest // 2, 11)
        alike = int((counts[order[: max(1, POINTS_AT_ONCE // largest)]] >= fewest).sum())
        some, order = order[:alike], order[alike:]
        batch = _Fields.from_fields([fields[i] for i in some], c[some])
        sample = batch.sample(effort.points)
        rotations, shifts, image = sample.candidates(effort)
        for _ in range(effort.rounds):
            squared = sample.squared(rotations, shifts, image)
            rank = np.argsort(np.argsort(squared, axis=1, kind="stable"), axis=1, kind="stable")
            kept = (rank < _trimmed_counts(sample.counts[image])[:, None]).astype(np.float64)
            rotations, shifts = refined_poses(rotations, shifts, sample.points[image], sample.tangents[image], kept)
        best = sample.best(rotations, shifts, image, 1)
        yield some, batch, rotations[best], shifts[best], image[best]


def _resect_fields(fields: Sequence[KnownField], c: Array, effort: Effort) -> list[Resection | None]:
    """Resect all fields, of at least four points each, with the same effort."""
    found: list[Resection | None] = [None] * len(fields)
    for some, batch, rotations, shifts, image in _best_poses(fields, c, effort):
        sigma, inliers = batch.inliers(rotations, shifts, image)
        points, weights = batch.points[image], inliers.astype(np.float64)
        rotations, shifts = refined_poses(rotations, shifts, points, batch.tangents[image], weights)
        middle = weights[:, None] @ points / weights.sum(axis=1)[:, None, None]
        extents = np.linalg.svd(weights[..., None] * (points - middle), compute_uv=False)
        resected = batch.resections(rotations, shifts, image, sigma, inliers)
        for row in np.flatnonzero(extents[:, 1] >= LINE * extents[:, 0]):
            found[some[image[row]]] = resected[row]
    return found


def _trimmed_counts(counts: Indices) -> Indices:
    """Numbers of residuals kept by least trimmed squares, for poses from three points."""
    return (counts + 4) // 2


def _robust_sigmas(squared: Array, counts: Indices) -> Array:
    """Standard deviations (k,) of a coordinate from the smaller half of chi-square (2) distributed squares (k, n)."""
    # counts (k,): numbers of existing points; the squares of the padding are infinite.
    half = _trimmed_counts(counts)
    left_out = 1 - half / counts
    with np.errstate(divide="ignore", invalid="ignore"):
        truncation = 1 + np.where(left_out > 0, left_out * np.log(left_out) / (1 - left_out), 0.0)
    sums = np.take_along_axis(np.cumsum(np.sort(squared, axis=1), axis=1), half[:, None] - 1, axis=1)[:, 0]
    return np.asarray(np.sqrt(sums / np.maximum(2 * half - 6, 1) / truncation))


def find_principal_distance(fields: Sequence[KnownField]) -> tuple[float | None, dict[KnownField, Pose]]:
    """Estimate the principal distance of a pinhole camera, in mm, together with poses of its images.

    Returns
    -------
    Principal distance, None if it is not determined; plausible poses of the images used.

    Notes
    -----
    Without gross errors linear transformations start a least-squares estimate over many images. Otherwise a
    few images are resected with principal distances on a logarithmic grid. The best one starts a least-squares
    estimate over many images. A standard deviation above 15 % counts as not determined: on a flat field parallel to the
    image, a change of the principal distance cannot be separated from a change of the height.
    """
    fields = _largest_fields(fields, FEWEST, FINE_IMAGES)
    if not fields:
        return None, {}
    if (directly := distance_directly(fields)) is not None:
        return directly[0], {field: each.pose for field, each in zip(fields, directly[2], strict=True)}
    tried = GRID * _radius_mm(fields)
    misfits = trial_misfits(fields[:COARSE_IMAGES], tried)
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


def find_interior_orientation(fields: Sequence[KnownField]) -> Array | None:
    """Estimate principal distance and principal point (3,) of a pinhole camera, in mm, from linear transformations."""
    fields = _largest_fields(fields, FEWEST_LINEAR, FINE_IMAGES)
    if not fields:
        return None
    batch = _Fields.from_fields(fields, np.ones(len(fields)))
    return interior_orientation(linear_transformations(batch.points, batch.tangents, batch.present))


def find_wide_distance(fields: Sequence[KnownField], distortion: Distortion) -> float | None:
    """Estimate the principal distance of a wide-angle or fisheye lens, in mm; None if no image determines it.

    It minimises the residuals of the resections. fields: image coordinates relative to the principal point; distortion:
    as given.
    """
    fields = _largest_fields(fields, FEWEST_WIDE, WIDE_IMAGES)
    if not fields:
        return None
    radius_mm = _radius_mm(fields)

    def misfit_mm2(angle_deg: float) -> float:
        """Sum over the images of the median squared residual; inf if an image has no pose."""
        c, total = radius_mm / np.radians(angle_deg), 0.0
        lens = Lens(distortion, np.array([c, 0.0, 0.0]), distortion.values)
        ideal_mm, found = zip(*(lens.ideal_from_observed(each.xy_mm) for each in fields), strict=True)
        if not all(each.all() for each in found):
            return np.inf
        ideal = [KnownField(each.xyz, xy, each.sigma_mm) for each, xy in zip(fields, ideal_mm, strict=True)]
        for field, resection in zip(fields, resections(ideal, len(fields) * [float(c)]), strict=True):
            if resection is None:
                return np.inf
            ray, _ = rays(resection.pose.rotation, field.xyz - resection.pose.center)
            imaged_mm, imaged = lens.camera_from_ray(ray)
            total += float(np.median(np.where(imaged, ((imaged_mm - field.xy_mm) ** 2).sum(axis=1), np.inf)))
        return total

    left = [misfit_mm2(angle) for angle in ANGLES_DEG]
    best, step, least = float(ANGLES_DEG[int(np.argmin(left))]), float(ANGLES_DEG[0] - ANGLES_DEG[1]), min(left)
    for _ in range(HALVES):
        step /= 2.0
        least, best = min((least, best), *((misfit_mm2(angle), angle) for angle in (best - step, best + step)))
    return radius_mm / float(np.radians(best)) if np.isfinite(least) else None


def _largest_fields(fields: Sequence[KnownField], fewest: int, most: int) -> list[KnownField]:
    """The images with most points, at most `most`; none with fewer points than `fewest`."""
    return sorted((each for each in fields if len(each.xyz) >= fewest), key=lambda each: -len(each.xyz))[:most]


def _radius_mm(fields: Sequence[KnownField]) -> float:
    x, y = np.concatenate([each.xy_mm for each in fields]).T
    return float(np.hypot(x, y).max())
