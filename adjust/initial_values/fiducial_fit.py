"""The film transformation of one image from its fiducial marks, gross errors tolerated."""

from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.film_kinds import Congruent, FilmKind, Identity, Projective, marks_of
from adjust.functional_model.transformation import film_kind, marks_needed, simpler
from adjust.problem.network import Transformation

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MOST_SUBSETS = 100
GROSS = 13.8  # squared distance, in variances of a coordinate, beyond which a mark is left out (0.1 % point)
PLAINLY = 0.01  # of the squared distances left upright, below which those left mirrored tell that a scan is so
LEAST_VARIANCE_MM2 = 1e-4  # of a coordinate: film and scanner may well do that
LEAST_ASPECT = 0.1  # of marks, across their longest extent: nearer to a line, their errors may pass for a mirror
LATTICE = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 8)]), axis=-1).reshape(-1, 2)


def fit_transformation(transformation: Transformation, comparator_mm: Array, camera_mm: Array) -> tuple[Array, bool]:
    """Parameters in the order of `film_parameter_names`; whether the scan is mirrored.

    comparator_mm, camera_mm (n, 2): the same marks, at least `fewest_marks`. Fitted by least
    squares, a projective one to its equations without fractions, to all marks where these agree, and otherwise to those
    that the least trimmed squares over the smallest subsets find in agreement. With fewer marks than a transformation
    takes, it is the simpler one of its family that they determine. A scan is mirrored where a mirrored similarity
    leaves far less; two marks, and marks on one line, cannot tell, and are taken as not mirrored.
    """
    if transformation == "none":
        return np.zeros(0), False
    mirrored = _is_mirrored(comparator_mm, camera_mm)
    kind = film_kind(transformation, mirrored)
    if marks_needed(transformation) > len(comparator_mm) and (lower := simpler(transformation)):
        parameters, _ = fit_transformation(lower, comparator_mm, camera_mm)
        lattice = comparator_mm.mean(axis=0) + _half(comparator_mm) * LATTICE
        return _fit(kind, lattice, film_kind(lower, mirrored).apply(parameters, lattice)), mirrored
    return _robust_fit(kind, comparator_mm, camera_mm)[0], mirrored


def _is_mirrored(comparator_mm: Array, camera_mm: Array) -> bool:
    """At once where all marks agree, as in most scans: else all subsets of them are tried, upright and mirrored."""
    if len(comparator_mm) < 3:
        return False
    kinds = [film_kind("similarity", mirrored) for mirrored in (False, True)]
    if _agree(_squared(kinds[0], _fit(kinds[0], comparator_mm, camera_mm), comparator_mm, camera_mm)):
        return False
    determinant = _determinant_where_marks_agree(comparator_mm, camera_mm)
    if determinant is not None:
        return determinant < 0
    upright, mirrored = (_robust_fit(kind, comparator_mm, camera_mm)[1] for kind in kinds)
    return mirrored < PLAINLY * upright


def _determinant_where_marks_agree(comparator_mm: Array, camera_mm: Array) -> float | None:
    """Of the affine transformation that they agree on, negative in a mirrored scan; None where they agree on none, are
    too few to show it, or lie about on one line."""
    affine = film_kind("affine", False)
    if len(comparator_mm) <= marks_of(affine) or _about_on_a_line(comparator_mm) or _about_on_a_line(camera_mm):
        return None
    parameters = _fit(affine, comparator_mm, camera_mm)
    if not _agree(_squared(affine, parameters, comparator_mm, camera_mm)):
        return None
    origin, *along = affine.apply(parameters, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(np.linalg.det(np.array(along) - origin))


def _about_on_a_line(xy_mm: Array) -> bool:
    most, least = np.linalg.svd(xy_mm - xy_mm.mean(axis=0), compute_uv=False)
    return bool(least < LEAST_ASPECT * most)


def _robust_fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> tuple[Array, float]:
    """Parameters, and the trimmed sum of squared distances that chose them."""
    n, fewest = len(comparator_mm), marks_of(kind)
    half = (n + fewest + 1) // 2
    best = _fit(kind, comparator_mm, camera_mm)
    squared = _squared(kind, best, comparator_mm, camera_mm)
    best_cost = float(np.sort(squared)[:half].sum())
    if half == n or _agree(squared):
        return best, best_cost
    for subset in _subsets(n, fewest):
        candidate = _fit(kind, comparator_mm[subset], camera_mm[subset])
        for _ in range(2):
            kept = np.argsort(_squared(kind, candidate, comparator_mm, camera_mm), kind="stable")[:half]
            candidate = _fit(kind, comparator_mm[kept], camera_mm[kept])
        cost = float(np.sort(_squared(kind, candidate, comparator_mm, camera_mm))[:half].sum())
        if cost < best_cost:
            best, best_cost = candidate, cost
    variance = best_cost / (2 * half - len(kind.names))
    agree = _squared(kind, best, comparator_mm, camera_mm) < GROSS * max(variance, LEAST_VARIANCE_MM2)
    return _fit(kind, comparator_mm[agree], camera_mm[agree]), best_cost


def _agree(squared: Array) -> bool:
    """Whether marks are no farther off than film and scanner may well put them."""
    return bool((squared < GROSS * LEAST_VARIANCE_MM2).all())


def _subsets(n: int, size: int) -> list[Indices]:
    """All subsets of some of n marks, or as many at random as are enough."""
    if comb(n, size) <= MOST_SUBSETS:
        return [np.array(subset) for subset in combinations(range(n), size)]
    generator = np.random.default_rng(0)
    return [generator.permutation(n)[:size] for _ in range(MOST_SUBSETS)]


def _squared(kind: FilmKind, parameters: Array, comparator_mm: Array, camera_mm: Array) -> Array:
    with np.errstate(all="ignore"):  # a subset of bad geometry may send other marks to infinity
        squared = ((kind.apply(parameters, comparator_mm) - camera_mm) ** 2).sum(axis=1)
    return np.where(np.isfinite(squared), squared, np.inf)


def _fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> Array:
    """Least squares about the marks' means; what they do not determine, on a line say, has the least norm."""
    center, half, target = comparator_mm.mean(axis=0), _half(comparator_mm), camera_mm.mean(axis=0)
    xy, moved = (comparator_mm - center) / half, camera_mm - target
    match kind:
        case Identity():
            return np.zeros(0)
        case Congruent():
            return _congruent(kind, xy, moved, center, target)
        case Projective():
            return _projective(xy, moved, center, half, target)
    nothing = np.zeros(len(kind.names))
    design = kind.design(nothing, comparator_mm, center, np.asarray(half))
    centred = np.linalg.lstsq(design.reshape(-1, len(nothing)), moved.reshape(-1))[0]
    parameters = kind.by_centred(nothing, center, np.asarray(half)) @ centred
    parameters[[kind.names.index("a1"), kind.names.index("b1")]] += target
    return np.asarray(parameters)


def _half(xy_mm: Array) -> float:
    """Half the larger side of what the marks enclose."""
    return float(np.ptp(xy_mm, axis=0).max()) / 2.0 or 1.0


def _congruent(kind: Congruent, xy: Array, moved: Array, center: Array, target: Array) -> Array:
    m = -1.0 if kind.mirrored else 1.0
    (x, y), (u, v) = xy.T, moved.T
    turn = np.array([0.0, 0.0, np.arctan2((x * v - m * y * u).sum(), (x * u + m * y * v).sum())])
    shift = target - kind.apply(turn, center)
    return np.array([*shift, turn[2]])


def _projective(xy: Array, moved: Array, center: Array, half: float, target: Array) -> Array:
    """From x' (1 + c1 x + c2 y) = a1 + a2 x + a3 y and the like for y', about the means (Hartley's normalisation)."""
    size = _half(moved)
    rows = np.zeros((len(xy), 2, 8))
    for row in (0, 1):
        rows[:, row, 3 * row : 3 * row + 3] = np.column_stack([np.ones(len(xy)), xy])
        rows[:, row, 6:] = -xy * moved[:, row, None] / size
    a1, a2, a3, b1, b2, b3, c1, c2 = np.linalg.lstsq(rows.reshape(-1, 8), moved.reshape(-1) / size)[0]
    to_unit = np.array([[1.0, 0.0, -center[0]], [0.0, 1.0, -center[1]], [0.0, 0.0, half]])
    from_unit = np.array([[size, 0.0, target[0]], [0.0, size, target[1]], [0.0, 0.0, 1.0]])
    matrix = from_unit @ np.array([[a2, a3, a1], [b2, b3, b1], [c1, c2, 1.0]]) @ to_unit
    (a2, a3, a1), (b2, b3, b1), (c1, c2, _) = matrix / matrix[2, 2]
    return np.array([a1, a2, a3, b1, b2, b3, c1, c2])
