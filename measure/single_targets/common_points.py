"""Points that several images show, and that are not quite where their coordinates say: what the other images tell of
each.

A dot that was printed off its place, or lies on a buckle of its sheet, is seen off in all images; a false reading, dirt
or glare in one alone. So the targets of each image are compared (`shared_offsets`) with the points as all other images
show them: of each point, how far it is off in space, by least squares over its images, in which wrong readings count
little, and a prior whose spread all points tell (variance components, expectation and maximisation).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from measure.noise.robust_estimation import STUDENT_FREEDOM, student_weights
from measure.single_targets.shared_offsets import Comparison, TargetPlaces, compared

Array = NDArray[np.float64]

_ROUNDS = 3  # of comparing the images and gathering what they say of the points
_SPREADS, _STEPS = 10, 8  # of the points' spread anew, and of weights in each
_SPREAD = 0.01  # of the points' extent: what it is taken for at first
_LEAST = 1e-6  # of the extent: no spread is smaller


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """What an image shows: index (n,), of the points; targets: where it should show them by their coordinates; by_point
    (n, 2, 3): how far the unit of each coordinate moves them, px; seen_px (n, 2), covariance_px2 (n, 2, 2): where they
    were seen; size_px of the image."""

    index: NDArray[np.intp]
    targets: TargetPlaces
    by_point: Array
    seen_px: Array
    covariance_px2: Array
    size_px: tuple[int, int]

    def compared(self, off: Array, covariance: Array) -> Comparison:
        """With the points this far (n, 3) off their coordinates, known so well (n, 3, 3)."""
        moved = np.einsum("nij,nj->ni", self.by_point, off)
        known = self.by_point @ covariance @ self.by_point.swapaxes(1, 2)
        places = self.targets.places_px + moved
        targets = replace(self.targets, places_px=places, covariance_px2=known, is_claim=False)
        return compared(targets, self.seen_px, self.covariance_px2, self.size_px)


def compared_together(images: Sequence[ImagePoints], xyz: Array) -> list[Comparison]:
    """Each image's targets against its others and the other images; xyz (m, 3): the points, along a plane and above it
    if they lie on one: each coordinate has a spread of its own."""
    known = _Known.at_first(len(images), xyz)
    for _ in range(_ROUNDS - 1):
        known = _gathered(_Readings.of(images, known), known)
    return _comparisons(images, known)


@dataclass(frozen=True, eq=False)
class _Known:
    """For each of i images, what the others say of m points: off (i, m, 3) their coordinates, covariance (i, m, 3, 3);
    spread (3,): standard deviation of the points about their coordinates; extent of the field."""

    off: Array
    covariance: Array
    spread: Array
    extent: float

    @classmethod
    def at_first(cls, images: int, xyz: Array) -> "_Known":
        extent = float(np.ptp(xyz, axis=0).max())
        none = np.zeros((images, *xyz.shape))
        return cls(none, np.zeros((*none.shape, 3)), np.full(3, _SPREAD * extent), extent)


def _comparisons(images: Sequence[ImagePoints], known: _Known) -> list[Comparison]:
    return [
        image.compared(off[image.index], covariance[image.index])
        for image, off, covariance in zip(images, known.off, known.covariance, strict=True)
    ]


def _gathered(readings: "_Readings", known: _Known) -> _Known:
    """What the images say of the points, each by its others; nothing new where they share none."""
    is_shared = (readings.squares > 0.0).sum(axis=0) > 1
    if not is_shared.any():
        return known
    spread = known.spread
    for _ in range(_SPREADS):
        weights, of_prior = readings.weights(spread)
        off, covariance = readings.solved(weights, of_prior, spread)
        moments = of_prior[:, None] * (off**2 + np.einsum("nii->ni", covariance))
        spread = np.maximum(np.sqrt(moments[is_shared].mean(axis=0)), _LEAST * known.extent)
    others = [
        readings.without(i).solved(np.delete(weights, i, axis=0), of_prior, spread) for i in range(len(weights))
    ]  # fmt: skip
    offs, covariances = (np.stack(parts) for parts in zip(*others, strict=True))
    return replace(known, off=offs, covariance=covariances, spread=spread)


def _noises(comparisons: Sequence[Comparison]) -> list[Array]:
    """(n, 2, 2) px² of each image's readings: as those of most images at least, for an image that the points were moved
    to would seem to be without any."""
    levels = np.array([np.median(np.einsum("nii->n", one.covariance_px2)) for one in comparisons])
    factors = np.maximum(np.median(levels) / levels, 1.0)
    return [factor * one.covariance_px2 for factor, one in zip(factors, comparisons, strict=True)]


@dataclass(frozen=True, eq=False)
class _Readings:
    """Of i images of m points the normal equations for how far the points are off: normal (i, m, 3, 3), right (i, m, 3)
    and squares (i, m), 0 where an image does not show a point."""

    normal: Array
    right: Array
    squares: Array

    @classmethod
    def of(cls, images: Sequence[ImagePoints], known: _Known) -> "_Readings":
        """What each image shows of the points, compared with what is known of them."""
        count = known.off.shape[:2]
        normal, right, squares = np.zeros((*count, 3, 3)), np.zeros((*count, 3)), np.zeros(count)
        comparisons = _comparisons(images, known)
        for i, (image, one, noise) in enumerate(zip(images, comparisons, _noises(comparisons), strict=True)):
            seen = one.off_px + np.einsum("nij,nj->ni", image.by_point, known.off[i, image.index])
            weighted = np.linalg.solve(noise, np.dstack([image.by_point, seen]))
            normal[i, image.index] = image.by_point.swapaxes(1, 2) @ weighted[..., :3]
            right[i, image.index] = np.einsum("nij,ni->nj", image.by_point, weighted[..., 3])
            squares[i, image.index] = np.einsum("ni,ni->n", seen, weighted[..., 3])
        return cls(normal, right, squares)

    def without(self, image: int) -> "_Readings":
        return _Readings(*(np.delete(part, image, axis=0) for part in (self.normal, self.right, self.squares)))

    def solved(self, weights: Array, of_prior: Array, spread: Array) -> tuple[Array, Array]:
        """off (m, 3) and its covariance (m, 3, 3), readings weighted (i, m) and the prior (m,)."""
        prior = of_prior[:, None, None] * np.diag(1.0 / spread**2)
        covariance = np.linalg.inv(np.einsum("im,imab->mab", weights, self.normal) + prior)
        return np.einsum("mab,im,imb->ma", covariance, weights, self.right), covariance

    def weights(self, spread: Array) -> tuple[Array, Array]:
        """(i, m) of the readings, (m,) of the prior, in Student's t distribution: from the points as they are given, or
        from where all readings together have them, whichever is likelier in the end."""
        ones = np.ones_like(self.squares)
        starts = [(ones * 1e-6, ones[0]), (ones, ones[0] * 1e-6)]
        ends = [self._settled(*start, spread) for start in starts]
        likely = np.array([self._log_likelihood(*end) for end in ends])
        best = likely.argmax(axis=0)
        readings, priors = (np.stack([student_weights(end[k], 2.0 + k) for end in ends]) for k in (0, 1))
        which = np.arange(len(best))
        return readings[best, :, which].T, priors[best, which]

    def _settled(self, weights: Array, of_prior: Array, spread: Array) -> tuple[Array, Array]:
        """(i, m) squares of the readings' distances, (m,) of the prior's, after some steps of weighting."""
        for _ in range(_STEPS):
            off, _ = self.solved(weights, of_prior, spread)
            far = self.squares - 2.0 * np.einsum("ma,ima->im", off, self.right)
            far = np.maximum(far + np.einsum("ma,imab,mb->im", off, self.normal, off), 0.0)
            of_off = ((off / spread) ** 2).sum(axis=1)
            weights, of_prior = student_weights(far, 2.0), student_weights(of_off, 3.0)
        return far, of_off

    def _log_likelihood(self, far: Array, of_off: Array) -> Array:
        """(m,) but for a constant."""
        readings = np.where(self.squares > 0.0, -(STUDENT_FREEDOM + 2.0) / 2.0 * np.log1p(far / STUDENT_FREEDOM), 0.0)
        return np.asarray(readings.sum(axis=0) - (STUDENT_FREEDOM + 3.0) / 2.0 * np.log1p(of_off / STUDENT_FREEDOM))
