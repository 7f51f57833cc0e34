"""Images and given points that differ from the others, selected by what their changes lower v'Pv to first order.

With all other unknowns eliminated, changes d lower v'Pv by 2 g'd - d'N d, at most by g' N⁻¹ g. Images: the change of
c, x0' and y0' of each image alone, its own orientation and film eliminated; the best partition is found by weighted
two-means, started from the best thresholds of these changes in some directions. Points: displacements of single ones,
or one shift of a line of a regular field or of all points beyond it, with the sums of their rows and columns of N.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.sparse import diags_array
from scipy.special import chdtrc, chdtri, fdtrc, gammaln

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.problem.problem import Problem
from adjust.quality.cofactor import image_equations
from adjust.quality.run import Run, linear_derivatives

FLAT = 1e-9  # fraction of the largest eigenvalue below which a direction is undetermined
MOST_TURNS = 20  # iterations of two-means
SCATTER_SHARE = 0.8  # of v'Pv: two groups of images whose interior orientations scatter explain less
BINS = 100  # parts of the images at whose borders jumps are sought
FEWEST, MOST = 5, 400  # given points: so many tell a wrong one; N is dense
MOST_WRONG = 1 / 3  # fraction of the points
SAME_LINE = 1e-3  # fraction of the field's extent by which the points of a line lie off it
REGULAR = 2.0  # points per line of a regular field, on average, at least
LEVEL = 0.001  # probability of a point that is not wrong beside those that are


@dataclass(frozen=True)
class Selection:
    """Images or points that a hypothesis was selected for.

    words: of points with one shift, else empty. choices: natural logarithm of the number of selections that it is the
    best of. contrasts: number of unknowns that all of these would have together. share: of v'Pv that the hypothesis
    explains at least, where errors are correlated within images; p_scatter: p-value for images whose principal points
    scatter as well.
    """

    names: tuple[str, ...] = ()
    words: str = ""
    choices: float = 0.0
    contrasts: int = 0
    share: float = 0.0
    p_scatter: float = 0.0


class InteriorEquations(NamedTuple):
    """Names of a camera's frames with targets, and normal equations (m, 3, 3), (m, 3) of c, x0' and y0' of each."""

    names: tuple[str, ...]
    normal: Array
    right: Array


def own_interiors(run: Run, equations: InteriorEquations) -> Iterator[tuple[slice, Selection]]:
    """Select all frames of a camera but the first for principal distances (INTERIOR_NAMES[:1]), or for principal points
    ([1:]), of their own, where they need them."""
    names, normal, right = equations
    count = len(names) - 1
    if count < 1:
        return
    vpv, redundancy = run.group_sums(run.weighting.used)
    variance = max(1.0, vpv / redundancy)

    def fall(part: slice) -> float:
        """Decrease of v'Pv by changes of each image's own in place of common ones: Cochran's Q."""
        n, g = normal[:, part, part], right[:, part]
        return float(quadratic(n, g).sum() - quadratic(n.sum(axis=0), g.sum(axis=0)))

    distances, points = slice(0, 1), slice(1, 3)
    # Errors that are correlated within images make principal points scatter as well.
    of_points = max((fall(slice(0, 3)) - fall(distances)) / (2.0 * count), variance)
    p = float(fdtrc(count, 2.0 * count, fall(distances) / count / of_points))
    for part, size, p_scatter in ((distances, 1, p), (points, 2, 1.0)):
        if chdtrc(size * count, fall(part) / variance) <= LEVEL:
            yield part, Selection(names[1:], p_scatter=p_scatter)


def two_groups(run: Run, camera: str, equations: InteriorEquations) -> Selection | None:
    """Select the smaller part of the best partition of a camera's frames; None with fewer than three frames."""
    names, normal, right = equations
    if len(names) < 3:
        return None
    interior = run.end.state.values[run.problem.unknowns.camera[camera][: len(INTERIOR_NAMES)]]
    along = np.vstack([np.eye(3), interior / np.linalg.norm(interior)])  # c, x0', y0', scale of the whole image
    single = (right @ along.T) / np.maximum(np.einsum("di,mij,dj->md", along, normal, along), 1e-300)
    starts = [_threshold(normal, right, change) for change in np.hstack([_pseudo_solve(normal, right), single]).T]

    def fall(mask: Mask) -> float:
        return float(sum(quadratic(normal[some].sum(axis=0), right[some].sum(axis=0)) for some in (mask, ~mask)))

    mask = max((_two_means(normal, right, start) for start in starts), key=fall)
    smaller = mask if 2 * mask.sum() <= len(names) else ~mask
    contrasts, choices = len(names) - 1, (len(names) - 1) * float(np.log(2.0)) + float(np.log(len(along)))
    return Selection(_some(names, smaller), "", choices, len(INTERIOR_NAMES) * contrasts, SCATTER_SHARE)


def _some(names: tuple[str, ...], mask: Mask) -> tuple[str, ...]:
    return tuple(name for name, is_in in zip(names, mask, strict=True) if is_in)


def interior_equations(run: Run, camera: str) -> InteriorEquations:
    """Equations of the interior orientations of a camera's frames, the exterior ones eliminated."""
    network, positions = run.problem.network, run.problem.unknowns.camera[camera][: len(INTERIOR_NAMES)]
    at = run.linearised(run.problem, run.end.state, positions)
    frames = tuple(dict.fromkeys(image.frame for image in network.images))
    shown = {
        each.frame for each in network.images if each.camera == camera and each.name not in network.objectless_images
    }
    names, normal, right = list[str](), list[Array](), list[Array]()
    for frame, by_interior, discrepancies in image_equations(at, positions) if at is not None else ():
        if frames[frame] in shown:
            names.append(frames[frame])
            normal.append(by_interior.T @ by_interior)
            right.append(by_interior.T @ discrepancies)
    return InteriorEquations(tuple(names), np.array(normal).reshape(-1, 3, 3), np.array(right).reshape(-1, 3))


def _threshold(normal: Array, right: Array, change: Array) -> Mask:
    """Mask of images whose change (m,) lies above the best threshold."""
    order = np.argsort(change, kind="stable")
    below = np.cumsum(normal[order], axis=0)[:-1], np.cumsum(right[order], axis=0)[:-1]
    above = normal.sum(axis=0) - below[0], right.sum(axis=0) - below[1]
    mask = np.ones(len(order), dtype=bool)
    mask[order[: np.argmax(quadratic(*below) + quadratic(*above)) + 1]] = False
    return mask


def _two_means(normal: Array, right: Array, mask: Mask) -> Mask:
    for _ in range(MOST_TURNS):
        changes = [_pseudo_solve(normal[some].sum(axis=0), right[some].sum(axis=0)) for some in (mask, ~mask)]
        own, other = (right @ change - 0.5 * ((normal @ change) @ change) for change in changes)
        moved = own > other
        if (moved == mask).all() or moved.all() or not moved.any():
            return mask
        mask = moved
    return mask


class Jump(NamedTuple):
    """Mask of the marks beyond a row (axis 1) or column (0), in the comparator, of one image, or of all ("")."""

    image: str
    axis: int
    cut_mm: float
    beyond: Mask


def jumps(run: Run, rows: Indices) -> Iterator[Jump]:
    """Select the row or column beyond which the targets (n,) of one image, and of all, are displaced most clearly."""
    problem, places = run.problem, run.end.computed_mm
    transform, residual = run.misfits.transform[rows], run.misfits.residual[rows, :, None]
    own_normal, own_right = transform.swapaxes(1, 2) @ transform, (transform.swapaxes(1, 2) @ residual)[..., 0]
    images, own = np.unique(problem.image_numbers[rows], return_inverse=True)
    for of_image in (own, np.zeros_like(own)):
        found = []
        for axis in range(2):
            along = places[rows, axis]
            cuts = np.quantile(along, np.linspace(0.0, 1.0, BINS + 1)[1:-1])
            # (m, c) decreases of v'Pv by displacements of each image's marks beyond each cut, all other unknowns held.
            count, part = int(of_image.max()) + 1, of_image * BINS + np.searchsorted(cuts, along)
            normal, right = np.zeros((count * BINS, 2, 2)), np.zeros((count * BINS, 2))
            np.add.at(normal, part, own_normal)
            np.add.at(right, part, own_right)
            parts = normal.reshape(count, BINS, 2, 2), right.reshape(count, BINS, 2)
            falls = quadratic(*(np.cumsum(each[:, :0:-1], axis=1)[:, ::-1] for each in parts))
            image, at = (int(k) for k in np.unravel_index(np.argmax(falls), falls.shape))
            found.append((float(falls[image, at]), float(cuts[at]), axis, image))
        _, cut_mm, axis, image = max(found)
        cut_mm = _exact_cut(
            places[rows, axis][of_image == image], own_normal[of_image == image], own_right[of_image == image]
        )
        beyond = np.zeros(len(places), dtype=bool)
        beyond[rows] = (of_image == image) & (places[rows, axis] > cut_mm)
        name = problem.network.images[images[image]].name if of_image is own else ""
        yield Jump(name, axis, cut_mm, beyond)


def _exact_cut(along: Array, normal: Array, right: Array) -> float:
    """Place beyond which a displacement of the marks (n,) lowers v'Pv most, halfway between two of them."""
    order = np.argsort(-along, kind="stable")
    falls = quadratic(np.cumsum(normal[order], axis=0), np.cumsum(right[order], axis=0))
    best = int(np.argmax(falls[:-1]))
    return float(along[order[best : best + 2]].mean())


def displaced_points(
    run: Run, axes: Array, problem: Problem, fixed: Mapping[str, Mask], most: int
) -> Iterator[Selection]:
    """Select the best single points and the best group with one shift among points.

    axes (m, 3): of the field, along which points form lines; fixed: (3,) by point, its fixed coordinates; problem: the
    one in which these are free; most: single points at most.
    """
    names, count = tuple(fixed), len(fixed)
    at = run.linearised(problem) if FEWEST <= count <= MOST else None
    if at is None:
        return
    # N (p, 3, p, 3) and g (p, 3), the unknowns of the run eliminated; 0 for coordinates that are not fixed.
    positions = np.concatenate([problem.unknowns.point[name] for name in names])
    is_fixed = diags_array(np.concatenate([*fixed.values()]) * 1.0)
    by_points = linear_derivatives(problem, at.rows.matrix, positions) @ is_fixed
    across = (run.unit_functions[: by_points.shape[0]].T @ by_points).toarray()
    normal = (by_points.T @ by_points).toarray() - across.T @ run.factor.cofactor_times(across)
    normal, right = normal.reshape(count, 3, count, 3), (by_points.T @ at.rows.right.ravel()).reshape(count, 3)
    vpv, redundancy = run.group_sums(run.weighting.used)
    single = _single_points(normal, right, vpv, redundancy)[:most]
    if len(single):
        choices = gammaln(count + 1) - gammaln(len(single) + 1) - gammaln(count - len(single) + 1)
        yield Selection(tuple(names[k] for k in single), "", float(choices), 3 * (count - 1))
    places = run.problem.network.known_places
    groups = list(_lines(np.array([places[name] for name in names]), axes)) if places.keys() >= fixed.keys() else []
    if groups:
        members = np.array([mask for _, mask in groups], dtype=float)
        of_groups = np.einsum("li,iajb,lj->lab", members, normal, members, optimize=True)
        words, mask = groups[int(np.argmax(quadratic(of_groups, members @ right)))]
        yield Selection(_some(names, mask), words, float(np.log(len(groups))))


def _single_points(normal: Array, right: Array, vpv: float, redundancy: float) -> list[int]:
    """Select points by forward selection, as long as one is significant beside those before it."""
    count = len(right)
    flat, g = normal.reshape(3 * count, 3 * count).copy(), right.ravel().copy()
    chosen, left = list[int](), [vpv]
    for _ in range(min(int(MOST_WRONG * count), int(redundancy / 3.0) - 1)):
        blocks = flat.reshape(count, 3, count, 3)[range(count), :, range(count)]
        falls = quadratic(blocks, g.reshape(count, 3))
        falls[chosen] = 0.0
        best = int(np.argmax(falls))
        own = slice(3 * best, 3 * best + 3)
        through = flat[:, own] @ np.linalg.pinv(flat[own, own], rcond=FLAT, hermitian=True)
        g, flat = g - through @ g[own], flat - through @ flat[own]
        chosen.append(best)
        left.append(left[-1] - float(falls[best]))
    variance = max(1.0, left[-1] / (redundancy - 3.0 * len(chosen))) if chosen else 1.0
    costs = np.array(left) / variance + chdtri(3, LEVEL / count) * np.arange(len(left))
    return chosen[: int(np.argmin(costs))]


def _lines(xyz: Array, axes: Array) -> Iterator[tuple[str, Mask]]:
    """Masks of the lines of a regular field along its axes, and of all points beyond each or a diagonal, with words."""
    diagonals = np.array([axes[0] + axes[1], axes[0] - axes[1]])
    along = (xyz - xyz.mean(axis=0)) @ np.vstack([axes, diagonals]).T
    extent = float(np.ptp(along, axis=0).max())
    for axis, what in product(range(along.shape[1]), ("line", "beyond")):
        if what == "line" and axis >= len(axes):
            continue
        order = np.sort(along[:, axis])
        ends = np.flatnonzero(np.diff(order) > SAME_LINE * extent)
        places = [float(part.mean()) for part in np.split(order, ends + 1)]
        if len(places) < 3 or len(xyz) < REGULAR * len(places):
            continue
        halfway = (np.array(places[1:]) + places[:-1]) / 2.0
        if what == "line":
            for low, high in zip([-np.inf, *halfway], [*halfway, np.inf], strict=True):
                yield "a row", (along[:, axis] > low) & (along[:, axis] < high)
        else:
            for cut in halfway[1:-1]:
                below = along[:, axis] < cut
                yield "all on one side of a line", below if 2 * below.sum() <= len(xyz) else ~below


def quadratic(normal: Array, right: Array) -> Array:
    """g' N⁻¹ g of one system (k, k), (k,) or of many."""
    return np.asarray((right * _pseudo_solve(normal, right)).sum(axis=-1))


def _pseudo_solve(normal: Array, right: Array) -> Array:
    """N⁻¹ g of one system (k, k), (k,) or of many."""
    return np.asarray((np.linalg.pinv(normal, rcond=FLAT, hermitian=True) @ right[..., None])[..., 0])
