"""Unidentified marks of an image, and the growth of a pose from a few identified ones over the whole image."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.projection import ray_by_orientation
from adjust.functional_model.rotation import rotation_from_vector

_CELLS = 600  # cells of the look-up table along each side of the frame
_COARSE_CELLS = 60  # cells of the density table along each side
_CROWD = 6  # nearest marks from which the local density is estimated
_ROUNDS = 25  # of assignment and adjustment in turns
_GATE_SIGMAS = 3.5  # distance of a mark from a prediction, above which it is another's
_MOST_CHANCE = 0.1  # largest probability of a random mark in a point's gate; otherwise not identified yet
_PRIOR_RADIAL = 0.1  # standard deviation of k1: 10 % of the radius for rays at 45 degrees
_ROBUST = 2.0  # in standard deviations, limit of Huber's weight function
_BEFORE = -1e-6  # z of a point before the camera, in units of its distance
OF_POSE = 3  # points that agree with some pose whatever they are


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of an image, at least one; all lengths in principal distances."""

    places: Array  # (m, 2) ideal image coordinates relative to the principal point, y up
    # least, greatest: (2,) corners of the searched area
    least: Array
    greatest: Array
    sigma: float  # standard deviation of one coordinate
    c: float  # principal distance, mm
    c_sigma: float  # its relative standard deviation

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.places)

    @cached_property
    def _nearest_of_cell(self) -> Indices:
        """Look-up table of the nearest mark."""
        return np.asarray(self.tree.query(self._centres(_CELLS))[1], dtype=np.intp)

    @cached_property
    def _density_of_cell(self) -> Array:
        """Look-up table of the density of marks."""
        mean = len(self.places) / float(np.prod(self.greatest - self.least))
        return np.maximum(mark_density(self.tree, self._centres(_COARSE_CELLS)), mean)

    def _centres(self, cells: int) -> Array:
        """(cells², 2) centres of the cells, row by row."""
        share = (np.arange(cells) + 0.5) / cells
        x, y = (self.least + share[:, None] * (self.greatest - self.least)).T
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def inside(self, places: Array) -> Mask:
        """Mask of places (..., 2) inside the searched area."""
        return np.asarray(((places >= self.least) & (places <= self.greatest)).all(axis=-1))

    def nearest(self, places: Array) -> Indices:
        """Nearest mark of each place (..., 2), to the resolution of the look-up table."""
        return self._nearest_of_cell[self._cell(places, _CELLS)]

    def chance(self, places: Array, reach: Array) -> Array:
        """Probability of a mark within reach (...) of places (..., 2), for random marks of the local density."""
        return chance_of_a_mark(self._density_of_cell[self._cell(places, _COARSE_CELLS)], reach)

    def _cell(self, places: Array, cells: int) -> Indices:
        share = (places - self.least) / (self.greatest - self.least)
        with np.errstate(invalid="ignore"):
            cell = np.clip(np.nan_to_num(share * cells), 0, cells - 1).astype(np.intp)
        return np.asarray(cell[..., 1] * cells + cell[..., 0], dtype=np.intp)


def mark_density(tree: cKDTree, places: Array) -> Array:
    """(n,) local density of marks at places (n, 2), from the distance of the k-th nearest mark."""
    crowd = min(_CROWD, tree.n)
    reach = np.asarray(tree.query(places, k=[crowd])[0])[:, 0]
    return np.asarray(crowd / (np.pi * np.maximum(reach, 1e-12) ** 2))


def chance_of_a_mark(density: Array, reach: Array | float) -> Array:
    """Probability of a mark within reach of a place, for randomly distributed marks of a density (Poisson)."""
    return np.asarray(-np.expm1(-density * np.pi * np.square(reach)))


def log10_of_agreement(agreeing: int, of: int, chance: float) -> float:
    """log10 of the binomial probability that at least `agreeing` of `of` points agree by chance."""
    with np.errstate(divide="ignore"):  # underflow gives -inf
        return float(np.log10(bdtrc(agreeing - 1, of, chance)))


@dataclass(frozen=True, eq=False)
class View:
    """Projection: camera = R X + t; images are (1 + scale) p (1 + radial p²), p in principal distances."""

    rotation: Array
    shift: Array
    scale: float = 0.0
    radial: float = 0.0

    def images(self, xyz: Array) -> Array:
        """(n, 2) images of points (n, 3); nan behind the camera."""
        p = self._ideal(xyz)
        return np.asarray((1.0 + self.scale) * p * (1.0 + self.radial * (p**2).sum(axis=1, keepdims=True)))

    def facing(self, xyz: Array, normals: Array) -> Mask:
        """Mask of points that face the camera; True where their direction is unknown."""
        station = -self.rotation.T @ self.shift
        return np.asarray(~(np.einsum("ni,ni->n", normals, station - xyz) <= 0.0))

    def derivatives(self, xyz: Array) -> Array:
        """(n, 2, 8) derivatives with respect to a small rotation, a shift in the camera frame, scale and radial."""
        p = self._ideal(xyz)
        r2 = (p**2).sum(axis=1)
        by_ideal = (1.0 + self.radial * r2)[:, None, None] * np.eye(2) + 2 * self.radial * p[:, :, None] * p[:, None]
        by_pose = (1.0 + self.scale) * by_ideal @ ray_by_orientation(p, -1.0 / self._camera(xyz)[:, 2])
        by_scale = p * (1.0 + self.radial * r2)[:, None]
        by_radial = (1.0 + self.scale) * p * r2[:, None]
        return np.concatenate([by_pose, by_scale[:, :, None], by_radial[:, :, None]], axis=2)

    def stepped(self, step: Array) -> "View":
        turn = rotation_from_vector(step[:3])
        return View(turn @ self.rotation, turn @ self.shift + step[3:6], self.scale + step[6], self.radial + step[7])

    def _camera(self, xyz: Array) -> Array:
        camera = xyz @ self.rotation.T + self.shift
        camera[:, 2] = np.where(camera[:, 2] < _BEFORE, camera[:, 2], np.nan)
        return np.asarray(camera)

    def _ideal(self, xyz: Array) -> Array:
        camera = self._camera(xyz)
        return np.asarray(camera[:, :2] / -camera[:, 2:])


@dataclass(frozen=True, eq=False)
class Grown:
    """Result of growing a pose."""

    view: View  # fitted projection
    mark: dict[int, int] = field(default_factory=dict)  # mark of each identified point
    gate: float = 0.0  # largest distance of a mark from the predicted place of its point, in principal distances
    expected: int = 0  # number of points that the frame should show
    log10_chance: float = 0.0  # log10 of the expected number of false alarms over all possible hypotheses


def grow(view: View, points: Indices, named: Indices, xyz: Array, normals: Array, marks: Marks) -> Grown:
    """Fit and identify alternately until nothing changes, from points (k,) identified as marks named (k,).

    The gates follow from the covariance of the last fit.
    """
    sigma = marks.sigma
    for _ in range(_ROUNDS):
        if len(points) <= OF_POSE:
            return Grown(view)
        view, sigma, covariance = _fit_view(view, xyz[points], marks.places[named], marks)
        before = points, named
        points, named = _near(view, xyz, normals, marks, sigma, covariance)
        if np.array_equal(points, before[0]) and np.array_equal(named, before[1]):
            break
    return _significance(view, xyz, normals, marks, sigma, dict(zip(points.tolist(), named.tolist(), strict=True)))


def _near(
    view: View, xyz: Array, normals: Array, marks: Marks, sigma: float, covariance: Array
) -> tuple[Indices, Indices]:
    """Points and their marks: nearest neighbours within gates that rarely contain a mark by chance."""
    shown = np.flatnonzero(_shown_points(view, xyz, normals, marks))
    places, by = view.images(xyz[shown]), view.derivatives(xyz[shown])
    predicted = np.einsum("nij,jk,nik->ni", by, covariance, by).sum(axis=1)
    gate = _GATE_SIGMAS * np.sqrt(sigma**2 + predicted)
    plain = marks.chance(places, gate) < _MOST_CHANCE
    shown, places, gate = shown[plain], places[plain], gate[plain]
    if not len(shown):
        return shown, shown
    distance, nearest = (np.asarray(found) for found in marks.tree.query(places))
    order = np.argsort(distance, kind="stable")
    _, firsts = np.unique(nearest[order], return_index=True)
    kept = np.zeros(len(shown), bool)
    kept[order[firsts]] = True
    kept &= distance <= gate
    return shown[kept], nearest[kept].astype(np.intp)


def _shown_points(view: View, xyz: Array, normals: Array, marks: Marks) -> Mask:
    return np.asarray(marks.inside(view.images(xyz)) & view.facing(xyz, normals))


def _fit_view(view: View, xyz: Array, places: Array, marks: Marks) -> tuple[View, float, Array]:
    """Fit a view by robust least squares."""
    # Returns the view, the standard deviation of the marks and the covariance of the parameters.
    priors = np.diag([0.0] * 6 + [marks.c_sigma**-2, _PRIOR_RADIAL**-2])
    sigma = marks.sigma
    normal = np.eye(8)
    for _ in range(5):
        residuals = places - view.images(xyz)
        off = np.linalg.norm(np.nan_to_num(residuals, nan=1.0), axis=1)
        redundancy = max(2 * len(xyz) - 6, 1) / (2 * len(xyz))
        # The median of lengths of two normal coordinates is 1.18 of their standard deviation.
        sigma = max(float(np.median(off)) / 1.1774 / np.sqrt(redundancy), marks.sigma)
        weights = np.minimum(1.0, _ROBUST * sigma / np.maximum(off, 1e-300)) / sigma**2
        by = np.nan_to_num(view.derivatives(xyz))
        weighted = by * weights[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, by) + priors
        right = np.einsum("nij,ni->j", weighted, np.nan_to_num(residuals))
        right -= priors @ np.array([0.0] * 6 + [view.scale, view.radial])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
        step = scale * np.linalg.lstsq(normal * np.outer(scale, scale), scale * right, rcond=1e-13)[0]
        view = view.stepped(step)
        if np.abs(by @ step).max() < 0.01 * sigma:
            break
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
    covariance = np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-13) * np.outer(scale, scale)
    return view, sigma, covariance


def _significance(view: View, xyz: Array, normals: Array, marks: Marks, sigma: float, mark: dict[int, int]) -> Grown:
    """Compute the expected number of false alarms of an identification."""
    # Any three points matched to any three marks give a pose. The others must agree, each with the probability that its
    # gate contains a mark by chance.
    gate = _GATE_SIGMAS * sigma
    shown = np.flatnonzero(_shown_points(view, xyz, normals, marks))
    expected = len(shown)
    agreeing = min(len(mark), expected)
    if agreeing <= OF_POSE:
        return Grown(view)
    # A pose fitted to all points may differ by the gate from that of three points: twice the gate.
    chance = float(marks.chance(view.images(xyz[shown]), np.full(expected, 2.0 * gate)).mean())
    tests = (float(len(xyz)) * len(marks.places)) ** OF_POSE
    return Grown(view, mark, gate, expected, log10_of_chance(agreeing, expected, chance, tests))


def log10_of_chance(agreeing: int, expected: int, chance: float, tests: float) -> float:
    """log10 of the expected number of poses with so many agreeing points under the null hypothesis.

    Three of the points always agree, with up to four poses for each of the possible tests.
    """
    return log10_of_agreement(agreeing - OF_POSE, expected - OF_POSE, chance) + float(np.log10(4.0 * tests))
