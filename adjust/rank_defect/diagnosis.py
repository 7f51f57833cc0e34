"""Rank defects: the null space of a factor, and null directions of the observation equations with cause and remedy.

Inseparable distortion parameters are a flat valley of v'Pv, held by weak pseudo-observations: numerator and denominator
of a rational lens are correlated where targets cover only the centre of the image. The distortion is determined there,
its parameters are not, and no datum would change that. Each free parameter of such a lens gets a pseudo-observation
whose standard deviation alone moves the edge of the observed field by a fraction of its radius (REACHES). That is
hundreds of times the precision of marks: negligible where the observations determine a combination, while along the
valley it leads to the smallest parameters (Tikhonov regularisation). If the observations contradict it, a weaker one is
used (Morozov's discrepancy principle), and none where they separate the parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.families import family
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import Linearised
from adjust.linear_algebra.factor import Factor
from adjust.linear_algebra.sparse_factor import Triangle, append_rows
from adjust.problem.condition_equations import observed_in_camera
from adjust.problem.estimates import NullDirection
from adjust.problem.parameter import Parameter, description, enumeration
from adjust.problem.problem import Problem, State
from adjust.rank_defect import directions
from adjust.rank_defect.datum import free_coordinates, object_datum

REACHES = (0.3, 1.0, 3.0, 10.0)  # in radii; the first one that the observations do not contradict is used
CONTRADICTED = 0.01  # p-value of the parameters' size below which the pseudo-observations are contradicted
UNRESOLVED = 0.3  # ratio to the pseudo-observation's standard deviation above which a parameter is not separable
SINGULAR = 1e-8  # relative singular value of the scaled rows below which the system is singular
DENSE = 100  # shared unknowns up to which a dense SVD is used
FIRST_COUNT = 24  # vectors of the first inverse iteration where there are more
ITERATIONS = 50
STANDSTILL = 1e-3  # change of small singular values at convergence, relative to the limit
ROUNDING = 1e-14  # rounding error of a singular value, relative to the largest
WEAK = 1e-4  # relative singular value of the scaled rows below which a direction is weak
INVOLVED = 0.01  # components of a null vector that are named, relative to the largest
PURE = 1e-5  # least share of a named direction in an exact null direction, beyond the names before it
MIXED = 0.05  # the same in a weak direction, where everything has a small share
SETTLED = 3.0  # ratio of the weights of priors and observations above which the priors settle a weak direction
INSIDE = 1e-6  # tolerance for a known direction to lie in the null space: rounding
NAMES_SHOWN = 3  # more names of one kind are collapsed to one with a star
LOOSE = 0.05  # relative standard deviation of a principal distance above which a warning says so
UNDETERMINED = 0.99  # ratio of posterior and prior standard deviation above which a quantity is undetermined


@dataclass(frozen=True)
class BlindBlock:
    """Block with null vectors within its own unknowns, independent of the shared ones.

    own (o,), shared (s,), triangle (o, o), border (o, s): as in the factor. left, right (o, d): null vectors of the
    triangle.
    """

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    left: Array
    right: Array


def blind_blocks(factor: Factor) -> list[BlindBlock]:
    """Find the blocks with a singular triangle, sorted by their unknowns."""
    found = []
    for blocks in factor.blocks:
        singular = np.linalg.svd(blocks.triangle, compute_uv=False)
        null = singular <= SINGULAR * singular.max(axis=1, initial=0.0, keepdims=True)
        for i in np.flatnonzero(null.any(axis=1)):
            left, _, right = np.linalg.svd(blocks.triangle[i])
            of_null = left[:, null[i]], right[null[i]].T
            found.append(BlindBlock(blocks.own[i], blocks.shared[i], blocks.triangle[i], blocks.border[i], *of_null))
    return sorted(found, key=lambda block: int(block.own[0]))


def null_vectors(factor: Factor) -> Array:
    """Orthonormal null vectors (n, d) of the scaled unknowns."""
    blind = blind_blocks(factor)
    within = []
    for block in blind:
        vectors = np.zeros((len(factor.scale), block.right.shape[1]))
        vectors[block.own] = block.right
        within.append(vectors)
    return np.linalg.qr(np.hstack([*within, null_space(factor, blind, SINGULAR)[0]]))[0]


def null_space(factor: Factor, blind: Sequence[BlindBlock], below: float) -> tuple[Array, Array]:
    """Orthonormal vectors (n, d) of the scaled unknowns with small singular values, and these values (d,).

    below: limit relative to the largest singular value. The vectors involve the shared unknowns and the unknowns of
    blocks that follow them; null vectors within blocks are not included.
    """
    count = factor.shared_count
    if count == 0:
        return np.zeros((len(factor.scale), 0)), np.zeros(0)
    # Blocks with null vectors of their own leave rows for the shared unknowns.
    rows = [(block.shared, block.left.T @ block.border) for block in blind]
    singular, shared = _smallest(append_rows(factor.triangle, rows) if rows else factor.triangle, below)
    vectors = np.zeros((len(factor.scale), len(singular)))
    vectors[:count] = shared
    first_of_blind = [block.own[0] for block in blind]
    for blocks in factor.blocks:
        seeing = ~np.isin(blocks.own[:, :1], first_of_blind).any(axis=1)
        moved = blocks.border[seeing] @ shared[blocks.shared[seeing]]
        vectors[blocks.own[seeing]] = -np.linalg.solve(blocks.triangle[seeing], moved)
    for block in blind:
        vectors[block.own] = -np.linalg.pinv(block.triangle, rcond=SINGULAR) @ block.border @ shared[block.shared]
    return np.linalg.qr(vectors)[0], singular / np.linalg.norm(vectors, axis=0)


def _smallest(triangle: Triangle, below: float) -> tuple[Array, Array]:
    """Small singular values (d,) of a triangle, relative to the largest, and their right vectors (s, d)."""
    if len(triangle) <= DENSE:
        _, singular, right = np.linalg.svd(triangle.toarray())
        hardly = singular <= max(below * singular[0], ROUNDING)  # the largest is at least 1: columns have length 1
        return singular[hardly], right[hardly].T
    largest = triangle.largest_singular
    count = FIRST_COUNT
    while True:
        singular, vectors = _inverse_iteration(triangle.lifted(ROUNDING * largest), count, below * largest)
        hardly = singular <= below * largest
        if not hardly.all() or count == len(triangle):
            return singular[hardly], vectors[:, hardly]
        count = min(2 * count, len(triangle))


def _inverse_iteration(triangle: Triangle, count: int, limit: float) -> tuple[Array, Array]:
    """Smallest singular values (count,) and right vectors (s, count) by inverse orthogonal iteration."""
    # Values above the limit need not have converged, and none if all are below it, since more vectors are then needed.
    # Source: Golub and Van Loan, Matrix Computations, section 8.2.
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(len(triangle), count)))[0]
    before = np.full(count, np.inf)
    for _ in range(ITERATIONS):
        half = np.linalg.qr(triangle.solve_transposed(vectors))[0]
        vectors = np.linalg.qr(triangle.solve(half))[0]
        _, singular, right = np.linalg.svd(triangle.times(vectors), full_matrices=False)
        vectors, singular = vectors @ right[::-1].T, singular[::-1]
        small = singular <= limit  # Ritz values are upper bounds of the singular values
        if small.all() or (np.abs(before - singular)[small] <= STANDSTILL * limit).all():
            break
        before = singular
    return singular, vectors


OBJECT_AXES = ("X", "Y", "Z", "X0", "Y0", "Z0")  # positions of points and stations


def singular_directions(numbering: Numbering, state: State, factor: Factor) -> tuple[NullDirection, ...]:
    """Null directions of the factor at a state; none where it is regular."""
    if factor.is_steady:
        return ()
    blind, parameters = blind_blocks(factor), numbering.problem.unknowns.parameters
    null, _ = null_space(factor, blind, SINGULAR)
    named, left = _named_directions(numbering, state, factor, blind, null, PURE)
    within_blocks = []  # within the unknowns of one image or point
    for block in blind:
        for vector in block.right.T:
            moved = tuple(parameters[numbering.free[block.own[i]]] for i in _largest(vector))
            within_blocks.append(NullDirection(moved, *directions.own_sentence(numbering.problem, state, moved[0])))
    return (*within_blocks, *named, *left)


def weak_directions(
    numbering: Numbering, state: State, factor: Factor, singular: Sequence[NullDirection] = ()
) -> tuple[NullDirection, ...]:
    """Weak directions: hardly determined by the observations and not settled by priors, so that noise decides.

    Reported are the directions below WEAK in which the priors of cameras and scanners weigh less than SETTLED times the
    observations. Directions of fiducials with priors are left out, since these priors are meant to place them, and so
    are those of lenses with inseparable parameters, which have notes of their own. Many unnamed directions are
    collapsed to one: a long strip can bend in many ways.

    Parameters
    ----------
    factor : without the priors of cameras and scanners.
    singular : null directions, which are not repeated.
    """
    problem, free = numbering.problem, numbering.free
    blind = blind_blocks(factor)
    hardly, visibility = null_space(factor, blind, WEAK)
    if singular and (visibility <= SINGULAR).all():
        return ()
    unknowns, calibrated = problem.unknowns, [each.positions for each in problem.further if each.group == "calibration"]

    def is_among(*positions: Iterable[Indices | Sequence[int]]) -> Mask:
        """Mask of the free unknowns at some positions."""
        return np.isin(free, np.concatenate([[], *chain(*positions)]))

    placed = is_among(unknowns.fiducial.values()) & (np.isfinite(unknowns.sigma[free]) | is_among(calibrated))
    kept = _complement(hardly[placed | is_among(trading_off(problem).values())], MIXED)
    of_unit_weight = (
        hardly @ kept @ np.linalg.inv(np.linalg.qr(np.maximum(visibility, SINGULAR)[:, None] * kept, mode="r"))
    )
    cameras_and_scanners = is_among(unknowns.camera.values(), unknowns.scanner.values())
    sigma = np.where(cameras_and_scanners, unknowns.sigma[free], np.inf)
    _, weight, right = np.linalg.svd(of_unit_weight / (factor.scale * sigma)[:, None], full_matrices=False)
    unsettled = of_unit_weight @ right[weight < SETTLED].T
    found = _named_directions(numbering, state, factor, blind, np.linalg.qr(unsettled)[0], MIXED)
    again = {_motion(each) for each in singular}
    named, left = ([each for each in some if _motion(each) not in again] for some in found)
    if len(left) > NAMES_SHOWN:  # many directions that have no name, as one
        moved = tuple(dict.fromkeys(moved for each in left for moved in each.parameters))
        left = [NullDirection(_collapse(moved), *directions.many_sentence(len(left), directions.followers(moved)))]
    return (*named, *left)


def _motion(direction: NullDirection) -> str:
    """The leading motion of a direction, without its followers."""
    return direction.cause.split(", followed by")[0]


def undetermined(problem: Problem, state: State, variances: Array) -> str:
    """Sentence on quantities of cameras and images that the observations do not determine; empty if there are none.

    Only their priors place them: their posterior variances, of variances (n,), equal the prior ones. Fiducials that no
    image shows are left out.
    """
    unknowns = problem.unknowns
    observed = np.zeros(len(unknowns), dtype=bool)
    observed[np.unique(problem.columns[problem.columns >= 0])] = True
    observed[problem.point_positions] = False
    prior = np.where(unknowns.has_prior & observed, unknowns.sigma, np.inf)
    unobserved = np.flatnonzero(np.sqrt(variances) > UNDETERMINED * prior)
    if not len(unobserved):
        return ""
    shown = description(_collapse([unknowns.parameters[i] for i in unobserved]))
    statement = f"The observations say nothing about {shown}: their standard deviations stay as given"
    cameras = [name for name, positions in unknowns.camera.items() if np.isin(positions[:3], unobserved).any()]
    if not cameras:
        return (
            f"{statement}. Only the given values determine them: give these with realistic standard deviations, or "
            "fix what you do not need."
        )
    field = directions.field_geometry(problem, state, cameras[0])
    return f"{statement}, for {field.because}. To determine them, {field.remedy}."


def loose_principal_distances(problem: Problem, state: State, variances: Array) -> dict[str, str]:
    """Sentences on principal distances without a prior that the observations hardly determine, by camera."""
    unknowns, found = problem.unknowns, dict[str, str]()
    for name, positions in unknowns.camera.items():
        at = positions[0]
        share = float(np.sqrt(variances[at]) / state.values[at])
        if np.isinf(unknowns.sigma[at]) and share > LOOSE:
            field = directions.field_geometry(problem, state, name)
            found[name] = (
                f"The principal distance of camera {name} is determined to {100.0 * share:.0f} % only, for "
                f"{field.because}. To determine it better, {field.remedy}; or give it with its standard deviation."
            )
    return found


def _collapse(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Collapse unknowns of one kind to one where there are many."""
    kinds: dict[Parameter, list[Parameter]] = {}
    for each in parameters:
        kinds.setdefault(each.any_owner, []).append(each)
    shown = []
    for kind, members in kinds.items():
        shown += [kind] if len(members) > NAMES_SHOWN or kind in members else members
    return tuple(shown)


def _named_directions(
    numbering: Numbering, state: State, factor: Factor, blind: Sequence[BlindBlock], null: Array, part: float
) -> tuple[list[NullDirection], list[NullDirection]]:
    """Describe the vectors (n, d) of a null space: named directions, the object datum first, and unnamed ones."""
    if null.shape[1] == 0:
        return [], []
    problem, free = numbering.problem, numbering.free
    parameters = [problem.unknowns.parameters[i] for i in free]
    datum, numbers, rest = _datum_part(numbering, state, factor, blind, null)
    named = [
        NullDirection(_collapse([parameters[i] for i in _largest(vector)]), *directions.datum_sentence(number))
        for vector, number in zip(datum.T, numbers, strict=True)
    ]
    # Add as much of the free datum as keeps the object points in place.
    points = np.isin(free, free_coordinates(problem))
    still = np.asarray(rest - datum @ np.linalg.lstsq(datum[points], rest[points])[0])
    leads = directions.named_directions(problem, state)
    functionals = np.array([lead.functional[free] for lead in leads]).reshape(len(leads), len(free)) / factor.scale
    lengths = np.linalg.norm(functionals, axis=1, keepdims=True)
    visibility = (functionals / np.where(lengths > 0.0, lengths, 1.0)) @ rest
    ranks = np.array([lead.rank for lead in leads], dtype=np.intp)
    axes = (functionals[ranks == 0] * factor.scale**2).T  # as motions of the scaled unknowns
    chosen = _independent_rows(visibility, part, ranks, _axes_projector(axes, rest, part))
    vectors = _object_fixed(parameters, still @ np.linalg.pinv(visibility[chosen]), ranks[chosen])
    for vector, i in zip(vectors.T, chosen, strict=True):
        # Always list the unknowns that give the name, however small.
        moved = [parameters[k] for k in dict.fromkeys([*_largest(vector), *np.flatnonzero(functionals[i]).tolist()])]
        named.append(NullDirection(_collapse(moved), *leads[i].sentence(moved)))
    unnamed = []
    for vector in (still @ _complement(visibility[chosen], PURE)).T:
        # By the unknown that moves most: of one point or image, or of many.
        most, moved = parameters[int(np.argmax(np.abs(vector)))], [parameters[i] for i in _largest(vector)]
        if len({(each.owner, each.id) for each in moved}) == 1 and most.kind in ("point", "exterior", "film"):
            sentence = directions.own_sentence(problem, state, most)
        else:
            sentence = directions.unnamed_sentence(most, directions.followers(set(moved) - {most}))
        unnamed.append(NullDirection(_collapse(moved), *sentence))
    return named, unnamed


def _datum_part(
    numbering: Numbering, state: State, factor: Factor, blind: Sequence[BlindBlock], null: Array
) -> tuple[Array, list[int], Array]:
    """Split off the object datum: its vectors (n, k) in a null space, their numbers, and the rest (n, d - k)."""
    # All vectors are free of the blocks' own null directions.
    datum = object_datum(numbering.problem, state)
    motion = datum.motions(numbering.free) * factor.scale[:, None]
    for block in blind:
        motion[block.own] -= block.right @ (block.right.T @ motion[block.own])
    left, cosines, _ = np.linalg.svd(null.T @ np.linalg.qr(motion)[0])
    count = int((cosines > 1.0 - INSIDE).sum())
    if count < datum.free.shape[1]:
        return np.zeros((len(motion), 0)), [], null
    chosen = _independent_rows(datum.free, PURE, np.zeros(7, dtype=np.intp))
    return motion @ np.linalg.pinv(datum.free[chosen]), chosen, null @ left[:, count:]


def _object_fixed(parameters: Sequence[Parameter], vectors: Array, ranks: Indices) -> Array:
    """Combine vectors (n, d) of rank 0 with the others such that stations and points stay in place."""
    # A common shift of fiducials and principal point, which does not involve the object, is then reported as such.
    placed = np.array([each.quantity in OBJECT_AXES for each in parameters], dtype=bool)
    first, others = vectors[:, ranks == 0], vectors[:, ranks > 0]
    result = vectors.copy()
    result[:, ranks == 0] -= others @ np.linalg.lstsq(others[placed], first[placed])[0]
    return result


def _axes_projector(motions: Array, vectors: Array, part: float) -> Array:
    """Projector (d, d) onto combinations of orthonormal vectors (n, d) that move the unknowns of motions (n, m) only by
    these motions.

    An affinity that keeps two fiducial marks in place shifts their mean, but it is not a shift.
    """
    moved = np.any(motions != 0.0, axis=1)
    basis = np.linalg.qr(motions[moved])[0]
    kept = _complement(vectors[moved] - basis @ (basis.T @ vectors[moved]), part)
    return kept @ kept.T


def _independent_rows(rows: Array, part: float, ranks: Indices, axes: Array | None = None) -> list[int]:
    """Select up to d independent rows of (m, d): by rank, then by the size of the independent component."""
    # axes: projector (d, d) that is applied to rows of rank 0.
    chosen: list[int] = []
    rest = rows.copy()
    if axes is not None:
        rest[ranks == 0] = rest[ranks == 0] @ axes
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


def _complement(rows: Array, part: float) -> Array:
    """Orthonormal vectors (d, k) of the approximate null space of rows (m, d), with singular values up to part."""
    square = np.zeros((rows.shape[1], rows.shape[1]))
    _, visibility, right = np.linalg.svd(np.vstack([rows, square]), full_matrices=False)
    return np.asarray(right[visibility <= part].T)


def _largest(vector: Array) -> list[int]:
    """Indices of the components that are named."""
    size = np.abs(vector)
    return [int(i) for i in np.flatnonzero(size > INVOLVED * size.max())]


def trading_off(problem: Problem) -> dict[str, list[int]]:
    """Positions of the free distortion parameters of each camera with a free numerator and denominator."""
    unknowns, found = problem.unknowns, {}
    for name in unknowns.camera:
        alike = family(problem.network.camera_by_name[name].distortion.family).alike_at_zero
        free = {each: i for each, i in problem.lens_positions(name).items() if np.isinf(unknowns.sigma[i])}
        if not free.keys().isdisjoint(alike) and len(problem.targets_by_camera[name]):
            found[name] = list(free.values())
    return found


def edge_motions(problem: Problem, at: Linearised) -> dict[int, float]:
    """Change of each correlated parameter, by position, that alone moves the edge of the observed field by its
    radius."""
    found: dict[int, float] = {}
    for name, free in trading_off(problem).items():
        rows, radius_mm = problem.targets_by_camera[name], observed_radius_mm(problem, at.state, name)
        for position in free:
            change = at.rows.change_mm(at.by_observation, np.arange(len(problem.unknowns)) == position)[rows]
            if moved := float(np.linalg.norm(change, axis=1).max()):
                found[position] = radius_mm / moved
    return found


def is_contradicted(problem: Problem, state: State) -> bool:
    """Whether the observations contradict the pseudo-observations (chi-square test)."""
    return bool(chdtrc(len(problem.pseudo_observed), pseudo_square_sum(problem, state)) < CONTRADICTED)


def observed_radius_mm(problem: Problem, state: State, camera: str) -> float:
    """Distance from the principal point to the outermost observed target."""
    xy_mm = observed_in_camera(problem, state)[problem.targets_by_camera[camera]]
    principal_point = state.values[problem.unknowns.camera[camera][1:3]]
    return float(np.linalg.norm(xy_mm - principal_point, axis=1).max())


def unresolved_motions(pseudo_observed: Mapping[int, float], variances: Array) -> list[int]:
    """Positions of the pseudo-observed parameters that the observations do not separate. variances (n,): a priori."""
    return [i for i, sigma in pseudo_observed.items() if np.sqrt(variances[i]) > UNRESOLVED * sigma]


def pseudo_square_sum(problem: Problem, state: State) -> float:
    """Contribution of the pseudo-observations to v'Pv."""
    unknowns = problem.unknowns
    return sum(
        float((state.values[i] - unknowns.given[i]) / sigma) ** 2 for i, sigma in problem.pseudo_observed.items()
    )


def held_directions(problem: Problem, variances: Array) -> int:
    """Number of directions that the pseudo-observations determine: the sum of 1 - r over them."""
    return round(sum(float(variances[i]) / sigma**2 for i, sigma in problem.pseudo_observed.items()))


def inseparable(problem: Problem, state: State, variances: Array) -> dict[str, tuple[list[str], str]]:
    """Inseparable parameters of each camera that has some, and a sentence on them."""
    inseparable_positions = set(unresolved_motions(problem.pseudo_observed, variances))
    found = {}
    for name in problem.unknowns.camera:
        names = [each for each, i in problem.lens_positions(name).items() if i in inseparable_positions]
        if names:
            per_mm, unit = problem.network.camera_by_name[name].image_unit()
            radius = per_mm[0] * observed_radius_mm(problem, state, name)
            sentence = (
                f"{enumeration(names)} of camera {name} cannot be separated: up to {radius:.3g} {unit} from the "
                "principal point, as far as targets were observed, they do the same. The distortion itself is known "
                "there. Use its parameters together, not one by one, or estimate fewer of them."
            )
            found[name] = names, sentence
    return found
