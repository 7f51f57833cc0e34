"""Absolute orientation: a model of images and points turned, scaled and shifted into the object space."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from adjust.array_types import Array, Mask
from adjust.functional_model.rotation import rotation_from_vector

STARTS = 400  # attitudes tried, some 25 degrees apart
REFINED = 12
AS_GOOD = 1e-5  # sum of squares, relative to that of the coordinates: a solution as good as the best
REWEIGHTINGS = 6  # of least distances
SINGULAR = 1e-6  # smallest over largest singular value of the derivatives by a turn


@dataclass(frozen=True)
class Similarity:
    """object = scale rotation model + shift."""

    scale: float
    rotation: Array
    shift: Array

    def apply(self, xyz: Array) -> Array:
        return np.asarray(self.scale * xyz @ self.rotation.T + self.shift)


def absolute_orientation(model: Array, known: Array, stations: Array) -> Similarity | None:
    """The similarity that brings model points (n, 3) to their known coordinates (n, 3), nan where one is not known.

    stations (k, 3): the cameras in the model. A minimal datum, two points and the height of a third say, has two
    solutions, mirrored about the line of the two: that with the cameras higher above the points is taken. None where
    the known coordinates do not determine the similarity. Once the attitude is given, scale and shift are linear; so
    the attitude is sought from starts all over.
    """
    from scipy.optimize import least_squares  # takes longer to import than most adjustments

    given = ~np.isnan(known)
    if given.sum() < 7 or not given.any(axis=0).all():
        return None
    target = _centred(known, given)
    starts = Rotation.from_quat(np.random.default_rng(0).normal(size=(STARTS, 4))).as_matrix()  # even over all turns
    costs = np.array([(_misfit(start, model, target, given) ** 2).sum() for start in starts])
    found = []
    for start in starts[np.argsort(costs, kind="stable")[:REFINED]]:
        near = least_squares(
            lambda turn, start=start: _misfit(rotation_from_vector(turn) @ start, model, target, given), np.zeros(3)
        )
        is_determined = np.linalg.svd(near.jac, compute_uv=False)[2] > SINGULAR * np.linalg.norm(target)
        found.append((2.0 * float(near.cost), is_determined, rotation_from_vector(near.x) @ start))
    most = min(cost for cost, _, _ in found) + AS_GOOD * (target**2).sum()
    candidates = [
        _similarity(rotation, model, known, given)
        for cost, is_determined, rotation in found
        if cost <= most and is_determined
    ]
    return max(
        candidates, key=lambda s: float(s.apply(stations)[:, 2].mean() - s.apply(model)[:, 2].mean()), default=None
    )


def levelled(model: Array, heights: Array, stations: Array) -> Similarity | None:
    """The similarity that brings model points (n, 3) to their heights (n,), gross errors tolerated; X and Y are level
    axes through the model's middle, whichever.

    stations (k, 3): the cameras in the model, which stand above the points. None where heights do not tell the scale:
    over a flat field they are alike, and in a model of poor images they may fall where it rises.
    """
    weights = np.ones(len(model))
    for _ in range(REWEIGHTINGS):
        middle, height = np.average(model, axis=0, weights=weights), float(np.average(heights, weights=weights))
        offsets, relief = model - middle, heights - height
        squares = float((weights * relief**2).sum())
        if squares == 0.0:
            return None
        rise = (weights * relief) @ offsets / squares
        left = offsets - np.outer(relief, rise)
        up = np.linalg.svd(np.sqrt(weights)[:, np.newaxis] * left, full_matrices=False)[2][2]
        distance = np.abs(left @ up)
        weights = 1.0 / np.maximum(distance, 0.1 * np.median(distance) + np.finfo(float).tiny)
    up = up if np.mean((stations - middle) @ up) > 0 else -up
    if rise @ up <= 0.0:
        return None
    right = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    right /= np.linalg.norm(right)
    scale, rotation = 1.0 / float(rise @ up), np.stack([right, np.cross(up, right), up])
    return Similarity(scale, rotation, np.array([0.0, 0.0, height]) - scale * rotation @ middle)


def _centred(xyz: Array, given: Mask) -> Array:
    """Each axis less its mean over the given coordinates; 0 where not given."""
    mean = np.where(given, xyz, 0.0).sum(axis=0) / given.sum(axis=0)
    return np.where(given, xyz - mean, 0.0)


def _misfit(rotation: Array, model: Array, target: Array, given: Mask) -> Array:
    """What the best scale and shift leave of the coordinates with this attitude."""
    turned = _centred(model @ rotation.T, given)
    return np.asarray((_scale(turned, target) * turned - target)[given])


def _scale(turned: Array, target: Array) -> float:
    """A negative one is no solution."""
    return max(float((turned * target).sum() / (turned**2).sum()), 0.0)


def _similarity(rotation: Array, model: Array, known: Array, given: Mask) -> Similarity:
    turned = model @ rotation.T
    scale = _scale(_centred(turned, given), _centred(known, given))
    return Similarity(scale, rotation, np.nanmean(np.where(given, known - scale * turned, np.nan), axis=0))
