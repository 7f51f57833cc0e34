"""Which of the marks found in a scan is which target: a pattern is recognised, then each mark takes its nearest name.

An approximate orientation predicts the targets with errors far larger than their distances: a degree of tilt shifts
them all by hundreds of pixels, together. So first the pattern as a whole is laid on the marks found (pairs of targets
suggest a similarity, all others test it), then the fit is tightened, and only then are names given, one to one. What an
orientation by these names explains is believed if marks that lie where they like would hardly agree as well (a
contrario: Desolneux, Moisan and Morel 2008).
"""

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from adjust.initial_values.resection import MAX_TRIPLES
from adjust.target_identification.unnamed_marks import chance_of_a_mark, density_about, log10_of_agreement

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_PAIRS = 60  # long pairs of targets that suggest where the pattern lies
_TESTED = 400  # suggestions that are tested on all targets
_OF_POSE = 3  # targets that can always be brought onto marks...
_POSES = 4  # ...by so many poses


@dataclass(frozen=True)
class PatternOptions:
    """How far the prediction may be off: a shift in px, a relative change of scale, a turn in rad; and, after these are
    removed, what is left of tilt and relief as a share of the pattern's size."""

    shift_px: float = 1500.0
    scale: float = 0.15
    turn_rad: float = 0.15
    distortion: float = 0.03

    def __post_init__(self) -> None:
        for name in ("shift_px", "scale", "turn_rad", "distortion"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; a positive number is right")


@dataclass(frozen=True, eq=False)
class Placement:
    """matrix (2, 3): an affine map that takes predicted places onto marks; tried: of how many placements it is the one
    that explains most."""

    matrix: Array
    tried: int

    def places(self, predicted_px: Array) -> Array:
        """(n, 2) px."""
        return _mapped(self.matrix, predicted_px)


def recognise(predicted_px: Array, found_px: Array, options: PatternOptions | None = None) -> Placement | None:
    """The placement that brings most of the predicted places (n, 2) onto marks found (m, 2), be it by chance; None
    where there are too few of either, or all are too far off."""
    options = options or PatternOptions()
    if len(predicted_px) < 3 or len(found_px) < 3:
        return None
    size = float(np.linalg.norm(np.ptp(predicted_px, axis=0)))
    tree = cKDTree(found_px)
    suggestions = _suggestions(predicted_px, found_px, options)
    if not len(suggestions):
        return None
    counts = np.array([_support(s, predicted_px, tree, options.distortion * size).sum() for s in suggestions])
    best = suggestions[np.argsort(-counts, kind="stable")[:8]]
    return Placement(_tightened(best, predicted_px, found_px, tree, size, options), len(suggestions))


def log10_of_chance(places_px: Array, found_px: Array, gate_px: float, tried: int) -> float:
    """The logarithm of the expected number of orientations by which so many marks (m, 2) would lie within the gate of
    the places (n, 2) of targets by chance, marks being as dense as they are about these places; tried: placements, each
    of which any three of its targets could orient."""
    n = len(places_px)
    if n <= _OF_POSE or not len(found_px):
        return 0.0
    chance = chance_of_a_mark(density_about(cKDTree(found_px), places_px), gate_px).mean()
    agreeing = len(assign(places_px, found_px, gate_px))
    tests = tried * _POSES * min(comb(agreeing, _OF_POSE), MAX_TRIPLES)
    return log10_of_agreement(agreeing - _OF_POSE, n - _OF_POSE, float(chance)) + float(np.log10(max(tests, 1)))


def assign(predicted_px: Array, found_px: Array, gate_px: float) -> list[tuple[int, int]]:
    """Pairs (target, mark), one to one, of least total distance, none farther apart than gate_px."""
    if not len(predicted_px) or not len(found_px):
        return []
    distances = cdist(predicted_px, found_px)
    capped = np.minimum(distances, 2.0 * gate_px)
    rows, columns = linear_sum_assignment(capped)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if distances[i, j] <= gate_px]


def _suggestions(predicted: Array, found: Array, options: PatternOptions) -> Array:
    """Similarities (k, 2, 3) that bring a long pair of targets onto a pair of marks and stay near the prediction."""
    first, second = _long_pairs(predicted)
    across = predicted[second] - predicted[first]
    a, b = (grid.ravel() for grid in np.meshgrid(np.arange(len(found)), np.arange(len(found)), indexing="ij"))
    a, b = a[a != b], b[a != b]
    pairs = cKDTree(found[b] - found[a])
    lengths = np.linalg.norm(across, axis=1)
    near = pairs.query_ball_point(across, lengths * np.hypot(options.scale, options.turn_rad))
    matrices = [
        _similarities(predicted[first[k]], across[k], found[a[at]], found[b[at]] - found[a[at]])
        for k, at in enumerate(near)
        if len(at)
    ]
    if not matrices:
        return np.zeros((0, 2, 3))
    similarities = np.concatenate(matrices)
    middle = predicted.mean(axis=0)
    shift = np.linalg.norm(similarities[:, :, :2] @ middle + similarities[:, :, 2] - middle, axis=1)
    allowed = similarities[shift <= options.shift_px]
    return _most_agreed(allowed, predicted, found)


def _long_pairs(points: Array) -> tuple[Indices, Indices]:
    """The longest pairs, none of whose points takes part in too many."""
    first, second = np.triu_indices(len(points), 1)
    order = np.argsort(-np.linalg.norm(points[second] - points[first], axis=1), kind="stable")
    uses = np.zeros(len(points), dtype=int)
    chosen = []
    for k in order:
        if uses[first[k]] < 6 and uses[second[k]] < 6:
            uses[[first[k], second[k]]] += 1
            chosen.append(k)
        if len(chosen) == _PAIRS:
            break
    return first[chosen], second[chosen]


def _similarities(start: Array, across: Array, found_start: Array, found_across: Array) -> Array:
    ratio = (found_across[:, 0] + 1j * found_across[:, 1]) / (across[0] + 1j * across[1])
    linear = np.stack([np.stack([ratio.real, -ratio.imag], -1), np.stack([ratio.imag, ratio.real], -1)], axis=1)
    return np.concatenate([linear, (found_start - linear @ start)[:, :, None]], axis=2)


def _most_agreed(similarities: Array, predicted: Array, found: Array) -> Array:
    """The suggestions that most others repeat: near each other in where they put the pattern's ends."""
    if len(similarities) <= _TESTED:
        return similarities
    corners = np.array([predicted.min(axis=0), predicted.max(axis=0)])
    places = np.einsum("kij,cj->kci", similarities[:, :, :2], corners) + similarities[:, None, :, 2]
    tolerance = 0.02 * float(np.linalg.norm(np.ptp(found, axis=0)))
    votes = cKDTree(places.reshape(-1, 4)).query_ball_point(places.reshape(-1, 4), tolerance, return_length=True)
    chosen: Array = similarities[np.argsort(-votes, kind="stable")[:_TESTED]]
    return chosen


def _support(matrix: Array, predicted: Array, tree: cKDTree, tolerance_px: float) -> NDArray[np.bool_]:
    """Which targets have a mark within the tolerance, a mark counting once."""
    distances, nearest = _nearest(tree, _mapped(matrix, predicted))
    supported: NDArray[np.bool_] = distances <= tolerance_px
    order = np.argsort(distances, kind="stable")
    _, firsts = np.unique(nearest[order], return_index=True)
    once = np.zeros(len(predicted), dtype=bool)
    once[order[firsts]] = True
    return supported & once


def _tightened(
    candidates: Array, predicted: Array, found: Array, tree: cKDTree, size: float, options: PatternOptions
) -> Array:
    """The best candidate after affine refits with a shrinking tolerance."""
    refined: list[Array] = []
    for matrix in candidates:
        for share in (1.0, 0.7, 0.5, 0.35, 0.35):
            pairs = _support(matrix, predicted, tree, share * options.distortion * size)
            if pairs.sum() < 3:
                break
            _, nearest = _nearest(tree, _mapped(matrix, predicted[pairs]))
            matrix = _affine(predicted[pairs], found[nearest])
        refined.append(matrix)
    scores = [_score(matrix, predicted, tree, options.distortion * size) for matrix in refined]
    return refined[int(np.argmax(scores))]


def _score(matrix: Array, predicted: Array, tree: cKDTree, tolerance_px: float) -> float:
    """Targets explained, each counting less the farther off it is."""
    supported = _support(matrix, predicted, tree, tolerance_px)
    distances, _ = _nearest(tree, _mapped(matrix, predicted[supported]))
    return float(np.sum(1.0 - (distances / tolerance_px) ** 2))


def _nearest(tree: cKDTree, points: Array) -> tuple[Array, Indices]:
    """Distance and index of the mark nearest to each place."""
    distances, nearest = tree.query(points)
    return np.asarray(distances, dtype=np.float64), np.asarray(nearest, dtype=np.intp)


def _affine(source: Array, target: Array) -> Array:
    """Least squares; a similarity where three points would leave no check."""
    if len(source) < 4:
        return _similarity(source, target)
    design = np.column_stack([source, np.ones(len(source))])
    return np.asarray(np.linalg.lstsq(design, target, rcond=None)[0].T, dtype=np.float64)


def _similarity(source: Array, target: Array) -> Array:
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    ratio = np.vdot(a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]) / np.vdot(a, a)
    linear = np.array([[ratio.real, -ratio.imag], [ratio.imag, ratio.real]])
    return np.column_stack([linear, target.mean(axis=0) - linear @ source.mean(axis=0)])


def _mapped(matrix: Array, points: Array) -> Array:
    mapped: Array = points @ matrix[:, :2].T + matrix[:, 2]
    return mapped
