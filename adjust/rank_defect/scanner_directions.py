"""Scanner deformations that are not separable from film, fiducial marks or lens, in words."""

from collections.abc import Collection, Iterable, Iterator, Sequence

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.scanner import is_left, term_degree
from adjust.linear_algebra.factor import Factor
from adjust.problem.estimates import Cofactor
from adjust.problem.problem import Problem, State
from adjust.rank_defect.named_directions import NamedDirection, Reason, changed

Pose = tuple[int, bool]  # rotation of a frame in its scan, degrees, and whether it is mirrored

SCANNER_RANK = -2
ALIKE_DEG = 20.0  # rotations that differ by less count as equal
HARDLY = 20.0  # ratio of a term's standard deviation to that with all else known, above which it is weak


def scanner_directions(problem: Problem, state: State) -> list[NamedDirection]:
    """Directions named after the terms of every scanner's deformation."""
    directions = []
    for name, positions in problem.unknowns.scanner.items():
        poses = _scanner_poses(problem, state, name)
        kinds = [image.transformation for image in problem.network.images if image.scanner == name]
        for position in positions:
            term = problem.unknowns.parameters[position].quantity
            film = next((kind for kind in kinds if not is_left(kind, term)), "")
            reason = term_reason(term, poses, "")
            by_companion = {each: term_reason(term, poses, each) for each in ("lens", "marks")}
            if film:
                because = f"the {film} transformation of its films does the same"
                reason, by_companion = Reason(because, "the term itself", "leave it out"), {}
            motion = f"The term {term} of the bend of scanner {name} can change"
            functional = changed(problem, int(position), 1.0)
            directions.append(NamedDirection(SCANNER_RANK, functional, motion, reason, by_companion=by_companion))
    return directions


def term_reason(term: str, poses: Sequence[Pose], confused_with: str) -> Reason:
    """Why a term of the deformation is not determined, and the remedies.

    poses: of the scanner's frames. confused_with: what it is not separable from, "lens" or "marks"; empty where the
    marks do not show the term at all.
    """
    is_odd, one_pose = term_degree(term) % 2 == 1, len(poses) == 1
    given = "x' and y' of the fiducial marks (F5, F6), or to the term itself"
    otherwise = "leave it out"
    if confused_with and one_pose and not is_odd:
        otherwise = "scan some of the frames turned by 180 degrees"
    elif confused_with == "marks" and _are_half_turns(poses):
        otherwise = "scan some of the frames turned by 90 degrees"
    if not confused_with:
        return Reason("the marks in its scans are too few, or lie too much alike, to show it", given, otherwise)
    if confused_with == "lens":
        as_they_lie = "however the frames lie" if is_odd or not one_pose else "in frames that all lie alike"
        given = "the distortion, from an earlier calibration say, or to the term itself"
        return Reason(f"the distortion of a lens does the same {as_they_lie}", given, otherwise)
    if one_pose:
        because = "all frames lie alike in the scanner: its bend and the fiducial marks' places are one and the same"
    elif is_odd and _are_half_turns(poses):
        because = (
            "frames turned by 180 degrees tell terms of even degree from the fiducial marks, and none of odd degree"
        )
    else:
        listed = ", ".join(f"{turn}{' mirrored' if mirrored else ''}" for turn, mirrored in poses)
        because = f"it, or its sum with others, looks the same in all poses in which the frames lie ({listed} degrees)"
    return Reason(because, given, otherwise)


def weak_term_sentences(
    problem: Problem, state: State, free: Indices, factor: Factor, cofactor: Cofactor
) -> Iterator[str]:
    """Sentences on terms that a regular network hardly separates from films, marks and lenses.

    Frames never lie exactly alike, and given fiducial marks have a standard deviation: a deformation is then
    determined, but weakly. factor: of the free unknowns; cofactor: of all.
    """
    unknowns = problem.unknowns
    places = {int(position): i for i, position in enumerate(free)}
    for name, positions in unknowns.scanner.items():
        open_ = [int(position) for position in positions if int(position) in places]
        ratios = np.sqrt(cofactor.variances[open_]) * factor.scale[[places[position] for position in open_]]
        hardly = [position for position, ratio in zip(open_, ratios, strict=True) if ratio > HARDLY]
        if not hardly:
            continue
        lens = [int(i) for camera in unknowns.camera.values() for i in camera[3:] if int(i) in places]
        held = held_variances(cofactor.part(np.array([*hardly, *lens])), len(hardly))
        scale = factor.scale[[places[position] for position in hardly]]
        names = [unknowns.parameters[position].quantity for position in hardly]
        by_lens = [term for term, ratio in zip(names, np.sqrt(held) * scale, strict=True) if ratio <= HARDLY]
        yield from undetermined_term_sentences(name, names, by_lens, _scanner_poses(problem, state, name))


def held_variances(cofactor: Array, count: int) -> Array:
    """Conditional variances of the first quantities of a cofactor matrix (n, n), given all others."""
    own, by_others, others = cofactor[:count, :count], cofactor[:count, count:], cofactor[count:, count:]
    scale = np.sqrt(np.diag(others))
    reduced = by_others / scale
    taken = (reduced @ np.linalg.pinv(others / np.outer(scale, scale), hermitian=True) * reduced).sum(axis=1)
    return np.asarray(np.maximum(np.diag(own) - taken, 0.0))


def undetermined_term_sentences(
    scanner: str, terms: Sequence[str], by_lens: Collection[str], poses: Sequence[Pose]
) -> Iterator[str]:
    """Sentences on terms of a scanner's deformation that are not, or hardly, separable from other unknowns.

    by_lens: terms that would be determined if the distortion were known.
    """
    by_reason: dict[Reason, list[str]] = {}
    for term in terms:
        by_reason.setdefault(term_reason(term, poses, "lens" if term in by_lens else "marks"), []).append(term)
    for (cause, given, otherwise), alike in by_reason.items():
        yield (
            f"The bend of scanner {scanner} is correlated with the other unknowns in its "
            f"term{'s' * (len(alike) > 1)} {', '.join(alike)}: {cause}. Give a standard deviation to {given}, "
            f"or {otherwise}."
        )


def _are_half_turns(poses: Sequence[Pose]) -> bool:
    """Whether all frames are equal to the first up to half turns."""
    first, mirrored = poses[0]
    return all(abs((turn - first + 90) % 180 - 90) < ALIKE_DEG and m == mirrored for turn, m in poses)


def _scanner_poses(problem: Problem, state: State, scanner: str) -> list[Pose]:
    gradients = []
    for films in problem.films:
        of_films = films.kind.gradient(state.values[films.positions], films.center_mm)
        own = [problem.network.images[i].scanner == scanner for i in films.images]
        gradients += [gradient for gradient, is_own in zip(of_films, own, strict=True) if is_own]
    return scan_poses(gradients)


def scan_poses(gradients: Iterable[Array]) -> list[Pose]:
    """Distinct poses of frames in their scans, from derivatives (2, 2) of camera by comparator coordinates."""
    poses: list[Pose] = []
    for gradient in gradients:
        mirrored = bool(np.linalg.det(gradient) < 0.0)
        upright = gradient * [1.0, -1.0] if mirrored else gradient
        turn = np.degrees(np.arctan2(upright[1, 0] - upright[0, 1], upright[0, 0] + upright[1, 1]))
        pose = round(float(turn)) % 360, mirrored
        if not any(mirrored == m and abs((pose[0] - t + 180) % 360 - 180) < ALIKE_DEG for t, m in poses):
            poses.append(pose)
    return sorted(poses)
