"""Bends of a scanner that the observations do not tell from what the films and the fiducial marks do, in words."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.scanner import degree_of
from adjust.least_squares.factor import Factor
from adjust.problem import Problem, State
from adjust.undetermined.directions import Lead

SCANNER_RANK = -2
ALIKE_DEG = 20.0  # two frames whose turns in the scanner differ by less lie alike in it
HARDLY = 20.0  # times as uncertain as with all else known: from there on the observations hardly tell a term

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Pose = tuple[int, bool]  # how a frame is turned in its scan, degrees, and whether it is mirrored


GIVEN = "x' and y' of the fiducial marks (F5, F6), or to the term itself"


def hardly_told(problem: Problem, state: State, free: Indices, factor: Factor, variances: Array) -> Iterator[str]:
    """Sentences on the terms that a regular network hardly tells from what films and fiducial marks do.

    Frames never lie quite alike, and given fiducial marks have some standard deviation: a bend is then determined, but
    by next to nothing. variances (n,) of all unknowns, factor: of these.
    """
    places = {int(position): i for i, position in enumerate(free)}
    for name, positions in problem.unknowns.scanner.items():
        terms = [
            problem.unknowns.names[position].rsplit(".", 1)[1]
            for position in map(int, positions)
            if position in places and np.sqrt(variances[position]) * factor.scale[places[position]] > HARDLY
        ]
        yield from untold_sentences(name, terms, _poses(problem, state, name))


def untold_sentences(scanner: str, terms: Sequence[str], poses: Sequence[Pose]) -> Iterator[str]:
    """Sentences on some terms of a scanner's bend that are not, or hardly, told from the fiducial marks' places."""
    told: dict[tuple[str, str], list[str]] = {}
    for term in terms:
        told.setdefault((_because(term, poses), _otherwise(term, poses)), []).append(term)
    for (because, otherwise), alike in told.items():
        yield (
            f"The bend of scanner {scanner} is hardly told from the fiducial marks and the other unknowns in its "
            f"term{'s' * (len(alike) > 1)} {', '.join(alike)}: {because}. Give a standard deviation to {GIVEN}, "
            f"or {otherwise}."
        )


def scanner_leads(problem: Problem, state: State) -> list[Lead]:
    """The terms of every scanner's bend."""
    return [
        _lead(problem, name, int(position), poses)
        for name, positions in problem.unknowns.scanner.items()
        for poses in [_poses(problem, state, name)]
        for position in positions
    ]


def _lead(problem: Problem, scanner: str, position: int, poses: Sequence[Pose]) -> Lead:
    term = problem.unknowns.names[position].rsplit(".", 1)[1]
    functional = np.zeros(len(problem.unknowns))
    functional[position] = 1.0
    motion = f"The term {term} of the bend of scanner {scanner} can change"
    return Lead(SCANNER_RANK, functional, motion, GIVEN, _because(term, poses), None, _otherwise(term, poses))


def _because(term: str, poses: Sequence[Pose]) -> str:
    if len(poses) == 1:
        return "all frames lie alike in the scanner: its bend and the fiducial marks' own places are one and the same"
    if _are_half_turns(poses) and degree_of(term) % 2:
        return "frames turned by 180 degrees tell terms of even degree from the fiducial marks, and this is an odd one"
    listed = ", ".join(f"{turn}{' mirrored' if mirrored else ''}" for turn, mirrored in poses)
    return f"it, or its sum with others, looks the same in all poses in which the frames lie ({listed} degrees)"


def _otherwise(term: str, poses: Sequence[Pose]) -> str:
    if _are_half_turns(poses):
        even = degree_of(term) % 2 == 0 and len(poses) == 1
        return f"scan some of the frames turned by {'180' if even else '90'} degrees"
    return "leave it out"


def _are_half_turns(poses: Sequence[Pose]) -> bool:
    """Whether no frame is turned by anything but half a turn against the first, nor mirrored against it."""
    first, mirrored = poses[0]
    return all(abs((turn - first + 90) % 180 - 90) < ALIKE_DEG and m == mirrored for turn, m in poses)


def _poses(problem: Problem, state: State, scanner: str) -> list[Pose]:
    gradients = []
    for films in problem.films:
        of_films = films.kind.gradient(state.values[films.positions], films.center_mm)
        own = [problem.network.images[i].scanner == scanner for i in films.images]
        gradients += [gradient for gradient, is_own in zip(of_films, own, strict=True) if is_own]
    return poses_of(gradients)


def poses_of(gradients: Iterable[Array]) -> list[Pose]:
    """The ways in which frames lie in their scans, from the derivatives (2, 2) of camera by comparator coordinates."""
    poses: list[Pose] = []
    for gradient in gradients:
        mirrored = bool(np.linalg.det(gradient) < 0.0)
        upright = gradient * [1.0, -1.0] if mirrored else gradient
        turn = np.degrees(np.arctan2(upright[1, 0] - upright[0, 1], upright[0, 0] + upright[1, 1]))
        pose = round(float(turn)) % 360, mirrored
        if not any(mirrored == m and abs((pose[0] - t + 180) % 360 - 180) < ALIKE_DEG for t, m in poses):
            poses.append(pose)
    return sorted(poses)
