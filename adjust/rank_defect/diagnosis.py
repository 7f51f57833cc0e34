"""What the observations do not determine: null directions of the equations, named with cause and remedy."""

from collections.abc import Iterable, Sequence

import numpy as np

from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import Factor
from adjust.problem.estimates import NullDirection
from adjust.problem.parameter import Parameter, description
from adjust.problem.problem import Problem, State
from adjust.rank_defect.datum import free_coordinates, object_datum
from adjust.rank_defect.flat_valleys import trading_off
from adjust.rank_defect.named_directions import camera_directions, datum_sentence, field_geometry, followers
from adjust.rank_defect.null_space import SINGULAR, BlindBlock, blind_blocks, null_space
from adjust.rank_defect.scanner_directions import scanner_directions
from adjust.rank_defect.unnamed_directions import many_sentence, own_sentence, unnamed_sentence

WEAK = 1e-4  # singular values of the scaled rows, over the largest, below which noise makes the solution
INVOLVED = 0.01  # part of a null vector's largest component that is worth a name
PURE = 1e-5  # part that a name must have in an exact null direction, beyond what earlier names took
MIXED = 0.05  # the same in a direction that is seen just a little, where everything plays a small part
SETTLED = 3.0  # how much more than observations priors must weigh to make a weak direction theirs
INSIDE = 1e-6  # what a known direction may stick out of the null space: rounding
OBJECT_AXES = ("X", "Y", "Z", "X0", "Y0", "Z0")  # quantities that place points and stations
NAMES_SHOWN = 3  # more names of one kind than this are shown as one, with a star
UNDETERMINED = 0.99  # posterior over prior standard deviation above which the observations say nothing


def singular_directions(problem: Problem, state: State, free: Indices, factor: Factor) -> tuple[NullDirection, ...]:
    """The null directions of the factor of a state, at its computed observations; none where it is regular."""
    if factor.steady:
        return ()
    blind = blind_blocks(factor)
    null, _ = null_space(factor, blind, SINGULAR)
    named, left = _named_directions(problem, state, free, factor, blind, null, PURE)
    return (*_block_directions(problem, state, free, blind), *named, *left)


def weak_directions(
    problem: Problem, state: State, free: Indices, factor: Factor, singular: Sequence[NullDirection] = ()
) -> tuple[NullDirection, ...]:
    """What the observations hardly see, and priors do not settle: there the solution is made by noise.

    The factor is to be that without the priors of cameras and scanners. Of all directions below WEAK those are given
    in which these priors weigh less than SETTLED times what the observations do. Directions that move fiducials with
    priors are no cause for alarm: their priors are meant to place them; nor are those of lenses whose parameters trade
    off, which notes are about. singular: the null directions, which are left out. Many directions without a name are
    given as one: the longer a strip is, the more ways there are in which it can bend.
    """
    blind = blind_blocks(factor)
    hardly, visibility = null_space(factor, blind, WEAK)
    if singular and (visibility <= SINGULAR).all():
        return ()
    marks = np.isin(free, [i for pair in problem.unknowns.fiducial.values() for i in pair])
    cameras_and_scanners = np.isin(
        free, [i for some in (problem.unknowns.camera, problem.unknowns.scanner) for own in some.values() for i in own]
    )
    sigma = np.where(cameras_and_scanners, problem.unknowns.sigma[free], np.inf)
    calibrated = [each.positions for each in problem.further if each.group == "calibration"]
    placed = marks & (np.isfinite(problem.unknowns.sigma[free]) | np.isin(free, np.concatenate([[], *calibrated])))
    placed |= np.isin(free, np.concatenate([[], *trading_off(problem).values()]))
    kept = _complement(hardly[placed], MIXED)
    weights = np.maximum(visibility, SINGULAR)[:, None] * kept
    of_unit_weight = hardly @ kept @ np.linalg.inv(np.linalg.qr(weights, mode="r"))
    _, weight, right = np.linalg.svd(of_unit_weight / (factor.scale * sigma)[:, None], full_matrices=False)
    unsettled = of_unit_weight @ right[weight < SETTLED].T
    found = _named_directions(problem, state, free, factor, blind, np.linalg.qr(unsettled)[0], MIXED)
    again = {_motion(each) for each in singular}
    named, left = (tuple(each for each in some if _motion(each) not in again) for some in found)
    if len(left) > NAMES_SHOWN:  # many directions that have no name, as one
        moved = tuple(dict.fromkeys(moved for each in left for moved in each.parameters))
        left = (NullDirection(_collapsed(moved), *many_sentence(len(left), followers(moved))),)
    return (*named, *left)


def _motion(direction: NullDirection) -> str:
    """What moves first of all, without what follows it."""
    return direction.cause.split(", followed by")[0]


def undetermined(problem: Problem, state: State, variances: Array) -> str:
    """What the observations say nothing about among cameras and images, and why; empty where there is nothing.

    The priors alone place these quantities: their variances (n,) are still the given ones. A fiducial that no image
    shows is not among them: nobody expects otherwise.
    """
    unknowns = problem.unknowns
    observed = np.zeros(len(unknowns), dtype=bool)
    observed[np.unique(problem.columns[problem.columns >= 0])] = True
    observed[[i for point in unknowns.point.values() for i in point]] = False
    prior = np.where(unknowns.has_prior & observed, unknowns.sigma, np.inf)
    unobserved = np.flatnonzero(np.sqrt(variances) > UNDETERMINED * prior)
    if not len(unobserved):
        return ""
    shown = description(_collapsed([unknowns.parameters[i] for i in unobserved]))
    statement = f"The observations say nothing about {shown}: their standard deviations stay as given"
    cameras = [name for name, positions in unknowns.camera.items() if np.isin(positions[:3], unobserved).any()]
    if not cameras:
        return f"{statement}. What is given is all that places them: give it well, or fix what you do not need."
    field = field_geometry(problem, state, cameras[0])
    return f"{statement}, for {field.because}. To determine them, {field.remedy}."


def _collapsed(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Unknowns, those of one kind shown as one where they are many."""
    kinds: dict[Parameter, list[Parameter]] = {}
    for each in parameters:
        kinds.setdefault(each.any_owner, []).append(each)
    shown = []
    for kind, members in kinds.items():
        shown += [kind] if len(members) > NAMES_SHOWN or kind in members else members
    return tuple(shown)


def _block_directions(
    problem: Problem, state: State, free: Indices, blind: Sequence[BlindBlock]
) -> Iterable[NullDirection]:
    """Null directions of an image's or a point's own unknowns, which the shared ones have no part in."""
    for block in blind:
        for vector in block.right.T:
            moved = tuple(problem.unknowns.parameters[free[block.own[i]]] for i in _largest(vector))
            yield NullDirection(moved, *own_sentence(problem, state, moved[0]))


def _named_directions(
    problem: Problem,
    state: State,
    free: Indices,
    factor: Factor,
    blind: Sequence[BlindBlock],
    null: Array,
    part: float,
) -> tuple[Sequence[NullDirection], Sequence[NullDirection]]:
    """The vectors (n, d) of a null space as directions: those with a name, the object datum first, then the camera's;
    and those that are described by what moves most in them."""
    if null.shape[1] == 0:
        return (), ()
    parameters = [problem.unknowns.parameters[i] for i in free]
    datum, sentences, rest = _datum_part(problem, state, free, factor, blind, null)
    # As much of the free datum added to the rest as leaves the object points where they are.
    points = np.isin(free, free_coordinates(problem))
    still = np.asarray(rest - datum @ np.linalg.lstsq(datum[points], rest[points])[0])
    leads = [*scanner_directions(problem, state), *camera_directions(problem, state)]
    functionals = np.array([lead.functional[free] for lead in leads]).reshape(len(leads), len(free)) / factor.scale
    lengths = np.linalg.norm(functionals, axis=1, keepdims=True)
    visibility = (functionals / np.where(lengths > 0.0, lengths, 1.0)) @ rest
    ranks = np.array([lead.rank for lead in leads], dtype=np.intp)
    axes = (functionals[ranks == 0] * factor.scale**2).T  # as motions of the scaled unknowns
    chosen = _independent_rows(visibility, part, ranks, _axes_projector(axes, rest, part))
    vectors = _object_fixed(parameters, still @ np.linalg.pinv(visibility[chosen]), ranks[chosen])
    left = still @ _complement(visibility[chosen], PURE)
    moved = [[parameters[i] for i in _largest(vector)] for vector in np.hstack([datum, vectors, left]).T]
    of_leads = moved[datum.shape[1] : len(moved) - left.shape[1]]
    for own, i in zip(of_leads, chosen, strict=True):  # small as they may be, what it is named after moves
        own += [parameters[k] for k in np.flatnonzero(functionals[i]) if parameters[k] not in own]
    sentences += [leads[i].sentence(own) for i, own in zip(chosen, of_leads, strict=True)]
    for vector, own in zip(left.T, moved[len(moved) - left.shape[1] :], strict=True):
        sentences.append(_sentence_without_name(problem, state, parameters[int(np.argmax(np.abs(vector)))], own))
    named = zip(moved, sentences, strict=True)
    directions = [NullDirection(_collapsed(own), *sentence) for own, sentence in named]
    count = len(directions) - left.shape[1]
    return directions[:count], directions[count:]


def _sentence_without_name(
    problem: Problem, state: State, most: Parameter, moved: Sequence[Parameter]
) -> tuple[str, str]:
    """Cause and remedy of a direction without a lead, of what moves most in it: of one point or image, or of many."""
    owners = {(each.owner, each.id) for each in moved}
    if len(owners) == 1 and most.kind in ("point", "exterior", "film"):
        return own_sentence(problem, state, most)
    return unnamed_sentence(most, followers(set(moved) - {most}))


def _datum_part(
    problem: Problem, state: State, free: Indices, factor: Factor, blind: Sequence[BlindBlock], null: Array
) -> tuple[Array, list[tuple[str, str]], Array]:
    """The vectors (n, k) of the object datum in a null space, their sentences, and the rest (n, d - k) of the space.

    Without what a block moves in its own null directions, as in all these vectors.
    """
    datum = object_datum(problem, state)
    motion = (datum.generators @ datum.free)[free] * factor.scale[:, None]
    for block in blind:
        motion[block.own] -= block.right @ (block.right.T @ motion[block.own])
    orthonormal = np.linalg.qr(motion)[0]
    left, cosines, _ = np.linalg.svd(null.T @ orthonormal)
    count = int((cosines > 1.0 - INSIDE).sum())
    if count < datum.free.shape[1]:
        return np.zeros((len(free), 0)), [], null
    chosen = _independent_rows(datum.free, PURE, np.zeros(7, dtype=np.intp))
    vectors = motion @ np.linalg.pinv(datum.free[chosen])
    return vectors, [datum_sentence(i) for i in chosen], null @ left[:, count:]


def _object_fixed(parameters: Sequence[Parameter], vectors: Array, ranks: Indices) -> Array:
    """Vectors (n, d) with as much of the others added to those of rank 0 as leaves stations and points where they are.

    A common shift of fiducials and principal point, which no object takes part in, is then told as just that.
    """
    placed = np.array([each.quantity in OBJECT_AXES for each in parameters], dtype=bool)
    first, others = vectors[:, ranks == 0], vectors[:, ranks > 0]
    result = vectors.copy()
    result[:, ranks == 0] -= others @ np.linalg.lstsq(others[placed], first[placed])[0]
    return result


def _axes_projector(motions: Array, vectors: Array, part: float) -> Array:
    """A projector (d, d) on what of orthonormal vectors (n, d) moves the unknowns of motions (n, m) by these alone.

    An affinity that leaves two fiducial marks in their places shifts their mean, and yet it is no shift.
    """
    moved = np.any(motions != 0.0, axis=1)
    basis = np.linalg.qr(motions[moved])[0]
    kept = _complement(vectors[moved] - basis @ (basis.T @ vectors[moved]), part)
    return kept @ kept.T


def _independent_rows(rows: Array, part: float, ranks: Indices, axes: Array | None = None) -> list[int]:
    """Independent rows (m, d), up to d: those of the lowest rank first, of equals that which sticks out most.

    axes: a projector (d, d) that rows of rank 0 have to pass.
    """
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
    """Orthonormal vectors (d, k) of which rows (m, d) see no more than a part."""
    square = np.zeros((rows.shape[1], rows.shape[1]))
    _, visibility, right = np.linalg.svd(np.vstack([rows, square]), full_matrices=False)
    return np.asarray(right[visibility <= part].T)


def _largest(vector: Array) -> list[int]:
    """The components that matter, in order."""
    size = np.abs(vector)
    return [int(i) for i in np.flatnonzero(size > INVOLVED * size.max())]
