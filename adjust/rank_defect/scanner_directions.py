"""Bends of a scanner that the observations do not tell from what the films and the fiducial marks do, in words."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.scanner import degree_of, is_left
from adjust.linear_algebra.factor import Factor
from adjust.problem.estimates import Cofactor
from adjust.problem.parameter import Parameter
from adjust.problem.problem import Problem, State
from adjust.rank_defect.directions import Lead

SCANNER_RANK = -2
INTERIOR = ("c", "x0", "y0")
ALIKE_DEG = 20.0  # two frames whose turns in the scanner differ by less lie alike in it
HARDLY = 20.0  # times as uncertain as with all else known: from there on the observations hardly tell a term

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Pose = tuple[int, bool]  # how a frame is turned in its scan, degrees, and whether it is mirrored


GIVEN = "x' and y' of the fiducial marks (F5, F6), or to the term itself"
GIVEN_LENS = "the distortion, from an earlier calibration say, or to the term itself"


@dataclass(frozen=True)
class ScannerLead(Lead):
    """Of a term of a scanner's bend. poses: in which the scanner's frames lie; taken_by_film: the transformation that
    does the same, empty where none does."""

    poses: Sequence[Pose] = ()
    taken_by_film: str = ""

    def sentence(self, moved: Iterable[Parameter]) -> tuple[str, str]:
        """Cause and remedy by what moves along: the lens, the fiducial marks, or nothing that could."""
        moved = list(moved)
        if self.taken_by_film:
            because = f"the {self.taken_by_film} transformation of its films does the same"
            return replace(self, because=because, given="the term itself", otherwise="leave it out")._told(moved)
        by_lens = any(each.kind == "interior" and each.quantity not in INTERIOR for each in moved)
        seen = by_lens or any(each.kind == "fiducial" for each in moved)
        why = _Why(self.motion.split()[2], self.poses, "lens" if by_lens else "marks" if seen else "")
        return replace(self, because=why.cause, given=why.given, otherwise=why.otherwise)._told(moved)

    def _told(self, moved: Iterable[Parameter]) -> tuple[str, str]:
        return super().sentence(moved)


@dataclass(frozen=True)
class _Why:
    """Why a term is not told. taken_by: what does the same, "lens" or "marks"; empty where the term is not seen."""

    term: str
    poses: Sequence[Pose]
    taken_by: str

    @property
    def cause(self) -> str:
        if not self.taken_by:
            return "the marks in its scans are too few, or lie too much alike, to show it"
        if self.taken_by == "lens":
            as_they_lie = "in frames that all lie alike" if self._even_alike else "however the frames lie"
            return f"the distortion of a lens does the same {as_they_lie}"
        if len(self.poses) == 1:
            return "all frames lie alike in the scanner: its bend and the fiducial marks' places are one and the same"
        if _are_half_turns(self.poses) and degree_of(self.term) % 2:
            return (
                "frames turned by 180 degrees tell terms of even degree from the fiducial marks, and none of odd degree"
            )
        listed = ", ".join(f"{turn}{' mirrored' if mirrored else ''}" for turn, mirrored in self.poses)
        return f"it, or its sum with others, looks the same in all poses in which the frames lie ({listed} degrees)"

    @property
    def given(self) -> str:
        return GIVEN_LENS if self.taken_by == "lens" else GIVEN

    @property
    def otherwise(self) -> str:
        if self._even_alike:
            return "scan some of the frames turned by 180 degrees"
        if self.taken_by == "marks" and _are_half_turns(self.poses):
            return "scan some of the frames turned by 90 degrees"
        return "leave it out"

    @property
    def _even_alike(self) -> bool:
        return bool(self.taken_by) and len(self.poses) == 1 and degree_of(self.term) % 2 == 0


def hardly_told(problem: Problem, state: State, free: Indices, factor: Factor, cofactor: Cofactor) -> Iterator[str]:
    """Sentences on the terms that a regular network hardly tells from what films, marks and lenses do.

    Frames never lie quite alike, and given fiducial marks have some standard deviation: a bend is then determined, but
    by next to nothing. factor, cofactor: of the free unknowns, and of all.
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
        held = held_variances(cofactor.of(np.array([*hardly, *lens])), len(hardly))
        scale = factor.scale[[places[position] for position in hardly]]
        names = [unknowns.parameters[position].quantity for position in hardly]
        by_lens = [term for term, ratio in zip(names, np.sqrt(held) * scale, strict=True) if ratio <= HARDLY]
        yield from untold_sentences(name, names, by_lens, _poses(problem, state, name))


def held_variances(cofactor: Array, count: int) -> Array:
    """The variances of the first quantities of a cofactor matrix (n, n), with all others known."""
    own, by_others, others = cofactor[:count, :count], cofactor[:count, count:], cofactor[count:, count:]
    scale = np.sqrt(np.diag(others))
    reduced = by_others / scale
    taken = (reduced @ np.linalg.pinv(others / np.outer(scale, scale), hermitian=True) * reduced).sum(axis=1)
    return np.asarray(np.maximum(np.diag(own) - taken, 0.0))


def untold_sentences(
    scanner: str, terms: Sequence[str], by_lens: Collection[str], poses: Sequence[Pose]
) -> Iterator[str]:
    """Sentences on some terms of a scanner's bend that are not, or hardly, told from other unknowns.

    by_lens: those that would be told if the lenses' distortion were known.
    """
    told: dict[tuple[str, str, str], list[str]] = {}
    for term in terms:
        why = _Why(term, poses, "lens" if term in by_lens else "marks")
        told.setdefault((why.cause, why.given, why.otherwise), []).append(term)
    for (cause, given, otherwise), alike in told.items():
        yield (
            f"The bend of scanner {scanner} is hardly told from the other unknowns in its "
            f"term{'s' * (len(alike) > 1)} {', '.join(alike)}: {cause}. Give a standard deviation to {given}, "
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
    term = problem.unknowns.parameters[position].quantity
    functional = np.zeros(len(problem.unknowns))
    functional[position] = 1.0
    motion = f"The term {term} of the bend of scanner {scanner} can change"
    kinds = (image.transformation for image in problem.network.images if image.scanner == scanner)
    film = next((kind for kind in kinds if not is_left(kind, term)), "")
    return ScannerLead(SCANNER_RANK, functional, motion, GIVEN, poses=poses, taken_by_film=film)


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
