"""Mismatches: rays of unknown points that do not meet the others, found before the adjustment.

One name given to two object points, or exchanged in an image, spoils an adjustment beyond what its residuals tell. The
orientations at the start do not depend on it: they follow from known points, or from most of the others.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.lens import Lens
from adjust.initial_values.approximations import camera_frames
from adjust.initial_values.pose import intersect
from adjust.problem.problem import Problem

APART = 5.0  # times the usual miss from which a ray is doubted
GROSS = 20.0  # standard deviations below which residuals tell what is wrong
MOST_PAIRS = 100  # pairs of rays of a point whose intersections are tried
FEWEST = 2  # rays that meet
USUAL = 0.75  # share of points of which the largest miss is usual


@dataclass(frozen=True)
class Mismatches:
    """Doubted rays of unknown points.

    doubted: rows of observations with those that could be wrong in their place. places (3,): of the points missed.
    unmet: rows of the points no two of whose rays meet.
    """

    doubted: Mapping[int, tuple[int, ...]]
    places: Mapping[str, Array]
    unmet: Mapping[str, Indices]

    def agrees(self, other: "Mismatches") -> bool:
        """Whether the same rays are doubted."""
        return self.doubted == other.doubted and self.unmet.keys() == other.unmet.keys()


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of all image points of a network: centers, directions (n, 3) in the object system; scale_mm (n,) principal
    distances, 0 for other observations; sigma_mm: typical standard deviation."""

    centers: Array
    directions: Array
    scale_mm: Array
    sigma_mm: float

    def misses_mm(self, rows: Indices, places: Array) -> Array:
        """Distances (..., n) of places (..., n, 3) from rays, in the images; inf behind the camera."""
        directions = self.directions[rows] / np.linalg.norm(self.directions[rows], axis=1, keepdims=True)
        offsets = places - self.centers[rows]
        depth = (offsets * directions).sum(axis=-1)
        across = np.linalg.norm(offsets - depth[..., None] * directions, axis=-1)
        return np.where(depth > 0.0, self.scale_mm[rows] * across / np.where(depth > 0.0, depth, 1.0), np.inf)


def started_rays(problem: Problem) -> Rays:
    """Rays of all image points at the start of an adjustment, corrected for the distortion known beforehand."""
    network, unknowns, start = problem.network, problem.unknowns, problem.start()
    transformation = {name: unknowns.start[at] for name, at in unknowns.transformation.items()}
    frames = camera_frames(network, transformation, problem.mirrored)
    centers, directions, scale_mm = np.split(np.zeros((len(network.observations), 7)), [3, 6], axis=1)
    for name, at in unknowns.camera.items():
        interior, known = np.split(unknowns.start[at], [3])
        sights = frames.sights(name, Lens(network.camera_by_name[name].distortion, interior, known))
        for i in frames.camera_images(name):
            rows, image = frames.rows[frames.part(i)], network.images[i].name
            centers[rows] = start.values[unknowns.exterior[image][:3]]
            directions[rows] = sights[image].rays @ start.rotations[i]
            scale_mm[rows] = interior[0]
    sigmas_mm = frames.sigma_mm[frames.sigma_mm > 0.0]
    return Rays(centers, directions, scale_mm[:, 0], float(np.median(sigmas_mm)) if len(sigmas_mm) else 0.0)


def find_mismatches(problem: Problem) -> Mismatches:
    """Find rays of unknown points that miss the intersection of most others by far.

    Of all intersections of two rays of a point that is missed, the one that most rays meet is taken (consensus). Rays
    are doubted here, not rejected: the adjustment without them decides.
    """
    unknowns, is_unknown = problem.unknowns, np.zeros(len(problem.is_fiducial), dtype=bool)
    has_place = ~problem.is_fiducial & (problem.places[:, 2] >= 0)
    is_unknown[has_place] = ~np.isfinite(unknowns.sigma[problem.places[has_place]]).all(axis=1)
    rows = np.flatnonzero(is_unknown)
    doubted, places, unmet = dict[int, tuple[int, ...]](), dict[str, Array](), dict[str, Indices]()
    if not len(rows):
        return Mismatches(doubted, places, unmet)
    rays = started_rays(problem)
    missed = rays.misses_mm(rows, unknowns.start[problem.places[rows]])
    _, of_point = np.unique(problem.places[rows, 0], return_inverse=True)
    largest = _largest(missed, of_point)
    usual = max(float(np.quantile(largest, USUAL)), GROSS / APART * rays.sigma_mm)
    for number in np.flatnonzero(largest > APART * usual):
        own = rows[of_point == number]
        # Intersections of pairs of the point's rays, and its start; known coordinates are kept.
        at = problem.places[own[0]]
        known = np.where(np.isfinite(unknowns.sigma[at]), unknowns.given[at], np.nan)
        pairs = np.array(list(islice(combinations(own.tolist(), 2), MOST_PAIRS)), dtype=np.intp).reshape(-1, 2)
        both, of_pair = pairs.ravel(), np.repeat(np.arange(len(pairs)), 2)
        met, _ = intersect(rays.centers[both], rays.directions[both], of_pair, np.tile(known, (len(pairs), 1)))
        met = np.concatenate([unknowns.start[at][None], met[~np.isnan(met).any(axis=1)]])
        meets = (missed := rays.misses_mm(own, met[:, None])) <= APART * usual
        best = int(np.lexsort((np.where(meets, missed, 0.0).sum(axis=1), -meets.sum(axis=1)))[0])
        name = problem.network.observations.point[own[0]]
        places[name] = met[best]
        if meets[best].sum() < FEWEST:
            unmet[name] = own
            continue
        # Rays that another consensus of as many leaves out could be wrong instead.
        others: Mask = ~meets[meets.sum(axis=1) == meets[best].sum()].all(axis=0) & meets[best]
        doubted |= {int(row): tuple(own[others].tolist()) for row in own[~meets[best]]}
    return Mismatches(doubted, places, unmet)


def _largest(values: Array, group: Indices) -> Array:
    """Largest of values (n,) by group."""
    largest = np.zeros(group.max() + 1)
    np.maximum.at(largest, group, values)
    return largest
