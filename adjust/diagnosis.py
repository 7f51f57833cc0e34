"""What the observations do not determine: null directions of the equations, named with cause and remedy."""

import re

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrcon

from adjust.datum import free_coordinates, object_datum
from adjust.directions import camera_leads, datum_sentence
from adjust.elimination import Factor
from adjust.problem import Problem, State
from adjust.result import NullDirection

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

SINGULAR = 1e-8  # singular values of the scaled rows, over the largest, below which there is no solution
WEAK = 1e-4  # below which noise makes the solution
INVOLVED = 0.01  # part of a null vector's largest component that is worth a name
PURE = 1e-5  # part that a name must have in an exact null direction, beyond what earlier names took
MIXED = 0.05  # the same in a direction that is seen just a little, where everything plays a small part
SETTLED = 3.0  # how much more than observations priors must weigh to make a weak direction theirs
INSIDE = 1e-6  # what a known direction may stick out of the null space: rounding
NAMES_SHOWN = 3  # more names of one kind than this are shown as one, with a star
UNDETERMINED = 0.99  # posterior over prior standard deviation above which the observations say nothing


def singular_directions(problem: Problem, state: State, free: Indices, factor: Factor) -> tuple[NullDirection, ...]:
    """The null directions of the factor of a state, at its computed observations; none where it is regular."""
    within = _within_blocks(problem, free, factor)
    return within or _named(problem, state, free, factor, _null_space(factor, SINGULAR)[0], PURE)


def weak_directions(problem: Problem, state: State, free: Indices, factor: Factor) -> tuple[NullDirection, ...]:
    """What the observations hardly see, and priors do not settle: there the solution is made by noise.

    The factor is to be that without the cameras' priors. Of all directions below WEAK those are told in which these
    priors weigh less than SETTLED times what the observations do. Directions that move fiducials with priors are no
    cause for alarm: their priors are meant to place them.
    """
    if _within_blocks(problem, free, factor):
        return ()
    hardly, told = _null_space(factor, WEAK)
    marks = np.isin(free, [i for pair in problem.unknowns.fiducial.values() for i in pair])
    sigma = np.where(
        np.char.startswith(np.array(problem.unknowns.names)[free], "IO."), problem.unknowns.sigma[free], np.inf
    )
    placed = marks & np.isfinite(problem.unknowns.sigma[free])
    kept = _unseen_by(hardly[placed], MIXED)
    of_unit_weight = hardly @ kept @ np.linalg.inv(np.linalg.qr(np.maximum(told, SINGULAR)[:, None] * kept, mode="r"))
    _, weight, right = np.linalg.svd(of_unit_weight / (factor.scale * sigma)[:, None], full_matrices=False)
    unsettled = of_unit_weight @ right[weight < SETTLED].T
    return _named(problem, state, free, factor, np.linalg.qr(unsettled)[0], MIXED)


def null_vectors(factor: Factor) -> Array:
    """Orthonormal vectors (n, d) of the scaled unknowns that no row sees.

    Where blocks do not determine their own unknowns, these vectors alone: the others cannot be told before.
    """
    within = []
    for own, vector in _own_null_vectors(factor):
        within.append(np.zeros(len(factor.scale)))
        within[-1][own] = vector
    return np.array(within).T if within else _null_space(factor, SINGULAR)[0]


def undetermined(problem: Problem, variances: Array) -> tuple[str, ...]:
    """Cameras' and images' quantities that the observations say nothing about: their priors alone place them.

    A fiducial that no image shows is not among them: nobody expects otherwise.
    """
    unknowns = problem.unknowns
    told = np.zeros(len(unknowns), dtype=bool)
    told[np.unique(problem.columns[problem.columns >= 0])] = True
    told[[i for point in unknowns.point.values() for i in point]] = False
    prior = np.where(unknowns.has_prior & told, unknowns.sigma, np.inf)
    blind = np.sqrt(variances) > UNDETERMINED * prior
    return collapsed([unknowns.names[i] for i in np.flatnonzero(blind)])


def collapsed(names: list[str]) -> tuple[str, ...]:
    """Names of unknowns, those of one kind shown as one with a star where they are many."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kind = name if name.startswith("IO.") else re.sub(r"^(FID\.[^.]*|[A-Z]+)\..*\.", r"\1.*.", name)
        kinds.setdefault(kind, []).append(name)
    shown = []
    for kind, members in kinds.items():
        shown += members if len(members) <= NAMES_SHOWN else [kind]
    return tuple(shown)


def _within_blocks(problem: Problem, free: Indices, factor: Factor) -> tuple[NullDirection, ...]:
    """Null directions of an image's or a point's own unknowns, which the shared ones have no part in."""
    directions = []
    for own, vector in _own_null_vectors(factor):
        names = [problem.unknowns.names[free[own[i]]] for i in _largest(vector)]
        directions.append(NullDirection(tuple(names), *_own_sentence(names[0])))
    return tuple(directions)


def _own_null_vectors(factor: Factor) -> list[tuple[Indices, Array]]:
    """Numbers (o,) of blocks' own unknowns, and vectors (o,) of these that the block's rows do not see."""
    found = []
    for block in factor.blocks:
        if block.own.shape[1] == 0:
            continue
        _, singular, right = np.linalg.svd(block.triangle)
        null = singular <= SINGULAR * singular[:, :1]
        found += [(block.own[i], right[i, j]) for i, j in np.argwhere(null)]
    return sorted(found, key=lambda each: int(each[0][0]))


def _own_sentence(name: str) -> tuple[str, str]:
    """Cause and remedy where the observations do not determine the owner of an unknown."""
    kind, owner = name.rsplit(".", 1)[0].split(".", 1)
    if kind == "PT":
        return (
            f"The rays to point {owner} do not determine where it lies.",
            "Measure it in more images, from stations further apart, give its coordinates, or leave it out.",
        )
    return (
        f"The marks of image {owner} do not determine its own orientation and transformation.",
        "Measure more marks in this image, not all on one line, or leave the image out.",
    )


def _null_space(factor: Factor, below: float) -> tuple[Array, Array]:
    """Orthonormal vectors (n, d) of all scaled unknowns that are hardly seen, and how much they are seen (d,).

    These are the vectors whose singular values are below a part of the largest of all.
    """
    count = factor.shared_count
    if count == 0 or _surely_above(factor.triangle, below):
        return np.zeros((len(factor.scale), 0)), np.zeros(0)
    _, singular, right = np.linalg.svd(factor.triangle)
    hardly = singular <= below * singular[0]
    vectors = np.zeros((len(factor.scale), int(hardly.sum())))
    vectors[:count] = right[hardly].T
    for block in factor.blocks:
        vectors[block.own] = -np.linalg.solve(block.triangle, block.border @ vectors[block.shared])
    lengths = np.linalg.norm(vectors, axis=0)
    return np.linalg.qr(vectors)[0], singular[hardly] / lengths


def _surely_above(triangle: Array, ratio: float) -> bool:
    """Whether an estimate of the condition already tells that all singular values lie above a ratio of the largest."""
    reciprocal, _ = dtrcon(triangle)
    return bool(reciprocal > ratio * len(triangle))


def _named(
    problem: Problem, state: State, free: Indices, factor: Factor, null: Array, part: float
) -> tuple[NullDirection, ...]:
    """Sentences for the vectors (n, d) of a null space: the object datum first, then the camera, then what is left."""
    if null.shape[1] == 0:
        return ()
    names = [problem.unknowns.names[i] for i in free]
    datum, sentences, rest = _datum_part(problem, state, free, factor, null)
    still = _with_points_still(problem, free, datum, rest)
    leads = camera_leads(problem, state)
    functionals = np.array([lead.functional[free] for lead in leads]).reshape(len(leads), len(free)) / factor.scale
    lengths = np.linalg.norm(functionals, axis=1, keepdims=True)
    seen = (functionals / np.where(lengths > 0.0, lengths, 1.0)) @ rest
    chosen = _independent_rows(seen, part, np.array([lead.rank for lead in leads], dtype=np.intp))
    vectors = still @ np.linalg.pinv(seen[chosen])
    left = still @ _unseen_by(seen[chosen], PURE)
    sentences += [(leads[i].cause, leads[i].remedy) for i in chosen]
    sentences += [_unknown_direction(names, vector) for vector in left.T]
    return tuple(
        NullDirection(collapsed([names[i] for i in _largest(vector)]), cause, remedy)
        for vector, (cause, remedy) in zip(np.hstack([datum, vectors, left]).T, sentences, strict=True)
    )


def _datum_part(
    problem: Problem, state: State, free: Indices, factor: Factor, null: Array
) -> tuple[Array, list[tuple[str, str]], Array]:
    """The vectors (n, k) of the object datum in a null space, their sentences, and the rest (n, d - k) of the space."""
    datum = object_datum(problem, state)
    motion = (datum.generators @ datum.free)[free] * factor.scale[:, None]
    orthonormal = np.linalg.qr(motion)[0]
    left, cosines, _ = np.linalg.svd(null.T @ orthonormal)
    count = int((cosines > 1.0 - INSIDE).sum())
    if count < datum.free.shape[1]:
        return np.zeros((len(free), 0)), [], null
    chosen = _independent_rows(datum.free, PURE, np.arange(7))
    vectors = motion @ np.linalg.pinv(datum.free[chosen])
    return vectors, [datum_sentence(i) for i in chosen], null @ left[:, count:]


def _with_points_still(problem: Problem, free: Indices, datum: Array, vectors: Array) -> Array:
    """Null vectors (n, d) with as much of the free datum (n, k) added as leaves the object points where they are."""
    points = np.isin(free, free_coordinates(problem))
    amounts = np.linalg.lstsq(datum[points], vectors[points])[0]
    return np.asarray(vectors - datum @ amounts)


def _independent_rows(rows: Array, part: float, ranks: Indices) -> list[int]:
    """Independent rows (m, d), up to d: those of the lowest rank first, of equals that which sticks out most."""
    chosen: list[int] = []
    rest = rows.copy()
    for rank in np.unique(ranks):
        while len(chosen) < rows.shape[1]:
            lengths = np.where(ranks == rank, np.linalg.norm(rest, axis=1), 0.0)
            first = int(np.argmax(lengths))
            if lengths[first] <= part:
                break
            chosen.append(first)
            unit = rest[first] / lengths[first]
            rest = rest - np.outer(rest @ unit, unit)
            rest[first] = 0.0
    return sorted(chosen)


def _unseen_by(rows: Array, part: float) -> Array:
    """Orthonormal vectors (d, k) of which rows (m, d) see no more than a part."""
    square = np.zeros((rows.shape[1], rows.shape[1]))
    _, seen, right = np.linalg.svd(np.vstack([rows, square]), full_matrices=False)
    return np.asarray(right[seen <= part].T)


def _largest(vector: Array) -> list[int]:
    """The components that matter, in order."""
    size = np.abs(vector)
    return [int(i) for i in np.flatnonzero(size > INVOLVED * size.max())]


def _unknown_direction(names: list[str], vector: Array) -> tuple[str, str]:
    largest = names[int(np.argmax(np.abs(vector)))]
    return (
        f"These unknowns can move together, {largest} most, without changing any observation.",
        f"Give {largest} or another of them a standard deviation, or add observations that see it.",
    )
