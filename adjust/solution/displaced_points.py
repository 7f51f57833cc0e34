"""Given points that lie elsewhere: single ones, lines of a regular field, or all points beyond one of its lines.

With all unknowns eliminated, displacements d of the given points lower v'Pv to first order by 2 g'd - d'S d. Points
that move together by one shift have the sums of their rows and columns of S.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import csr_array
from scipy.special import chdtri, gammaln

from adjust.array_types import Array, Mask
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import linearise
from adjust.problem.problem import Problem
from adjust.quality.run import Run
from adjust.solution.image_groups import FLAT, quadratic

FEWEST_IMAGES = 2  # images of a point that tell it from its mark
FEWEST = 5  # given points that tell a wrong one
MOST = 400  # given points: S is dense
MOST_WRONG = 1 / 3  # fraction of the points
SAME_LINE = 1e-3  # fraction of the field's extent by which the points of a line lie off it
REGULAR = 2.0  # points per line of a regular field, on average, at least
LEVEL = 0.001  # probability of a point that is not wrong beside those that are


@dataclass(frozen=True)
class PointGroup:
    """Points that lie elsewhere than given, each by its own shift, or all by the same.

    names: of the points; words: of a group with one shift, else empty; choices: natural logarithm of the number of
    groups that it was selected from; contrasts: number of unknowns that all of these would have together.
    """

    names: tuple[str, ...]
    words: str = ""
    choices: float = 0.0
    contrasts: int = 0


def displaced_points(run: Run, axes: Array, freed: Problem, names: tuple[str, ...], most: int) -> Iterator[PointGroup]:
    """Select the best single points and the best group with one shift among points.

    axes (m, 3): of the field, along which points form lines; freed: the problem in which the points `names` are free;
    most: single points at most.
    """
    if not FEWEST <= len(names) <= MOST or freed.further:
        return
    system = _reduced(run, freed, names)
    if system is None:
        return
    normal, right = system
    vpv, redundancy = run.group_sums(run.weighting.used)
    single = _single_points(normal, right, vpv, redundancy)[:most]
    if len(single):
        count = len(names)
        choices = gammaln(count + 1) - gammaln(len(single) + 1) - gammaln(count - len(single) + 1)
        yield PointGroup(tuple(names[k] for k in single), "", float(choices), 3 * (count - 1))
    groups = list(_lines(np.array([run.problem.network.known_places[name] for name in names]), axes))
    if groups:
        members = np.array([mask for _, mask in groups], dtype=float)
        of_group = np.einsum("li,iajb,lj->lab", members, normal, members, optimize=True), members @ right
        best = int(np.argmax(quadratic(*of_group)))
        words, mask = groups[best]
        some = tuple(name for name, is_in in zip(names, mask, strict=True) if is_in)
        yield PointGroup(some, words, float(np.log(len(groups))))


def _reduced(run: Run, freed: Problem, names: tuple[str, ...]) -> tuple[Array, Array] | None:
    """S (p, 3, p, 3) and g (p, 3) of the points, all other unknowns eliminated."""
    weighted, covariance = run.weighting.applied(freed)
    numbering = Numbering(weighted)
    if (at := linearise(numbering, covariance, weighted.start())) is None:
        return None
    positions = weighted.columns
    of_unknown = np.append(numbering.numbers, -1)[positions]  # ABSENT is the last
    rows, columns = np.nonzero(of_unknown >= 0)
    matrix = at.rows.matrix[rows, :, columns]
    entries = np.concatenate([matrix[:, 0], matrix[:, 1]])
    places = np.concatenate([2 * rows, 2 * rows + 1]), np.tile(of_unknown[rows, columns], 2)
    design = csr_array((entries, places), shape=(2 * len(positions), len(numbering.free)))
    of_points = numbering.numbers[np.concatenate([weighted.unknowns.point[name] for name in names])]
    others = np.setdiff1d(np.arange(len(numbering.free)), of_points)
    own, rest = design[:, of_points], design[:, others]
    weights = 1.0 / weighted.prior_sigma[numbering.free[others]] ** 2
    across = (rest.T @ own).toarray()
    inner = (rest.T @ rest).toarray() + np.diag(weights)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    solved = scale[:, None] * np.linalg.lstsq(inner * np.outer(scale, scale), scale[:, None] * across, rcond=1e-12)[0]
    normal = (own.T @ own).toarray() - across.T @ solved
    right = own.T @ at.rows.right.ravel() - solved.T @ (rest.T @ at.rows.right.ravel())
    count = len(names)
    return normal.reshape(count, 3, count, 3), right.reshape(count, 3)


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
        inverse = np.linalg.pinv(flat[own, own], rcond=FLAT, hermitian=True)
        through = flat[:, own] @ inverse
        g, flat = g - through @ g[own], flat - through @ flat[own]
        chosen.append(best)
        left.append(left[-1] - float(falls[best]))
    variance = max(1.0, left[-1] / (redundancy - 3.0 * len(chosen))) if chosen else 1.0
    costs = np.array(left) / variance + chdtri(3, LEVEL / count) * np.arange(len(left))
    return chosen[: int(np.argmin(costs))]


def _lines(xyz: Array, axes: Array) -> Iterator[tuple[str, Mask]]:
    """Masks of the lines of a regular field along its axes, and of all points beyond each, with words."""
    along = (xyz - xyz.mean(axis=0)) @ axes.T
    extent = float(np.ptp(along, axis=0).max())
    for axis, what in product(range(len(axes)), ("line", "beyond")):
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
