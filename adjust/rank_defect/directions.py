"""The directions in which a network's unknowns are known to move together, and what to say of them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.families import family
from adjust.functional_model.transformation import follows_tilts
from adjust.problem.parameter import Kind, Parameter
from adjust.problem.problem import Problem, State

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

FLAT = 0.01  # least over largest extent of the field, below which there is no relief to speak of
PARALLEL_RAD = np.radians(1.0)  # axes within this of each other are parallel
FIELD = 4  # points from which something is known of the field, and not just of its datum
LEAST_BEND = 1e-6  # of squares of the fiducials' places beyond affinities: three marks have none


@dataclass(frozen=True)
class Lead:
    """What a null direction is called after: a functional (n,) of the unknowns that it changes, and the words for it.

    rank: of several leads that would do, that of the lowest rank gives the name. motion: what moves; because: why
    nothing hinders it, where that is more than what follows it. given: what a prior would end it, partner: another
    unknown (its key, and in words) that would, where it moves too; otherwise: what else to do.
    """

    rank: int
    functional: Array
    motion: str
    given: str
    because: str = ""
    partner: tuple[Parameter, str] | None = None
    otherwise: str = ""

    def sentence(self, moved: Iterable[Parameter]) -> tuple[str, str]:
        """Cause and remedy of a direction that moves some unknowns."""
        moved = set(moved)
        cause = f"{self.motion}{following(moved, self.motion)}{self.because and f': {self.because}'}."
        given = [self.given] + ([self.partner[1]] if self.partner and self.partner[0] in moved else [])
        remedy = f"Give a standard deviation to {', or to '.join(given)}{self.otherwise and f', or {self.otherwise}'}."
        return cause, remedy


FOLLOWERS: tuple[
    tuple[Kind, tuple[str, ...], str, str], ...
] = (  # what follows a motion: the unknowns' kind, quantities (all where empty), words, a word that told it
    ("fiducial", (), "the fiducial marks", "fiducial mark"),
    ("film", (), "the film transformations", ""),
    ("join", (), "what joins scans of a frame", ""),
    ("interior", ("x0", "y0"), "the principal point", "principal point's"),
    ("interior", ("c",), "the principal distance", "principal distance"),
    ("exterior", ("X0", "Y0", "Z0"), "the stations", ""),
    ("exterior", ("omega", "phi"), "the tilts", ""),
    ("exterior", ("kappa",), "kappa", ""),
    ("point", ("X", "Y"), "the object points in plan", ""),
    ("point", ("Z",), "the heights", ""),
)


def following(moved: Iterable[Parameter], motion: str = "") -> str:
    """What moves along, in words."""
    kinds = {(each.kind, each.quantity) for each in moved}
    words = [
        word
        for kind, quantities, word, told in FOLLOWERS
        if not (told and told in motion) and any(k == kind and (not quantities or q in quantities) for k, q in kinds)
    ]
    if not words:
        return ""
    listed = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f", followed by {listed}"


DATUM_LEADS = (
    ("can shift in X", "X of one point"),
    ("can shift in Y", "Y of one point"),
    ("can shift in Z", "Z of one point"),
    ("can turn about X", "Z of three points that are not in line"),
    ("can turn about Y", "Z of three points that are not in line"),
    ("can turn about Z", "X and Y of two points"),
    ("can grow or shrink", "X and Y of two points, or a distance"),
)


def datum_sentence(number: int) -> tuple[str, str]:
    """Cause and remedy of one of the seven free directions of the object space."""
    motion, known = DATUM_LEADS[number]
    return (
        f"The object space {motion} with all stations and points: nothing that is given fixes it.",
        f'Give {known} with a standard deviation in points.csv, or choose the datum "minimal" or "free".',
    )


def camera_leads(problem: Problem, state: State) -> list[Lead]:
    """What a null direction is called after.

    Ranks: -1 a tilt, which moves much else along, 0 what is a change of the camera's own axes, 1 other changes of its
    fiducials, 2 interior orientation, 3 distortion; -2 of a scanner's bend, which moves still more (see
    `scanner_directions`).
    """
    leads = []
    for name, positions in problem.unknowns.camera.items():
        field = field_of(problem, state, name)
        leads += _fiducial_leads(problem, state, name)
        leads += _tilt_leads(problem, state, name)
        leads += _interior_leads(problem, name, positions, field)
        leads += _distortion_leads(problem, name, positions[3:])
    return leads


def _fiducial_leads(problem: Problem, state: State, camera: str) -> list[Lead]:
    """Shift, rotation, scale, affinity and shear of all fiducials of a camera."""
    pairs = _film_places(problem, camera)
    if not pairs:
        return []
    positions = np.array(pairs)
    x, y = (state.values[positions] - state.values[positions].mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    marks = f"all fiducial marks of camera {camera} can"
    turned = "add images turned by 90 degrees about their axes or tilted in other directions"
    x0 = (Parameter.interior(camera, "x0"), "x0' (F7)")
    y0 = (Parameter.interior(camera, "y0"), "y0' (F8)")
    c = (Parameter.interior(camera, "c"), "the principal distance (F9)")
    lever = "one coordinate of a fiducial mark that has a lever arm (F5, F6)"
    two, three = (f"x' and y' of {number} fiducial marks (F5, F6)" for number in ("two", "three"))
    leads = (  # rank, dx', dy', motion, given, partner, otherwise
        (0, one, zero, f"Shift x: {marks} shift together in x'", "x' of one fiducial mark (F5)", x0, ""),
        (0, zero, one, f"Shift y: {marks} shift together in y'", "y' of one fiducial mark (F6)", y0, ""),
        (0, -y, x, f"Rotation: {marks} turn together about the principal point", lever, None, ""),
        (0, x, y, f"Scale: {marks} grow together", two, c, ""),
        (1, x, -y, f"Affinity: {marks} stretch in x' against y'", three, None, turned),
        (1, y, x, f"Shear: {marks} shear", three, None, turned),
    )
    listed = []
    for rank, dx, dy, motion, given, partner, otherwise in leads:
        functional = np.zeros(len(problem.unknowns))
        functional[positions] = np.stack([dx, dy], axis=1)
        listed.append(Lead(rank, functional, motion, given, "", partner, otherwise))
    return listed


def _film_places(problem: Problem, camera: str) -> list[Indices]:
    """Positions (2,) of all fiducials of a camera, and of what joins the scans of its frames, which moves with them."""
    frames = {image.frame for image in problem.network.images if image.camera == camera}
    unknowns = problem.unknowns
    marks = [positions for (owner, _), positions in unknowns.fiducial.items() if owner == camera]
    joins = [positions for (frame, _), positions in unknowns.join.items() if frame in frames]
    return marks + joins if marks else []


def _tilt_leads(problem: Problem, state: State, camera: str) -> list[Lead]:
    """A tilt of all cameras about x' or y', where every film transformation of a camera can undo it.

    It moves the fiducials by t (x'², x'y'), of which the functional takes what no affinity of theirs can be.
    """
    kinds = [image.transformation for image in problem.network.images if image.camera == camera]
    pairs = _film_places(problem, camera)
    if not pairs or not all(follows_tilts(kind) for kind in kinds):
        return []
    positions = np.array(pairs)
    centred = state.values[positions] - state.values[positions].mean(axis=0)
    affine = np.column_stack([np.ones(len(centred)), centred])
    leads = []
    for axis, other in ((0, 1), (1, 0)):
        bend = centred[:, [axis]] * centred
        bend -= affine @ np.linalg.lstsq(affine, bend)[0]
        if np.abs(bend).max() < LEAST_BEND * np.abs(centred).max() ** 2:
            continue
        functional = np.zeros(len(problem.unknowns))
        functional[positions] = bend
        motion = (
            f"Tilt {'xy'[axis]}: all fiducial marks of camera {camera} can move by {'xy'[axis]}' times x' and y', as "
            f"with one tilt of all cameras about {'xy'[other]}'"
        )
        given = "x' and y' of four fiducial marks (F5, F6), or to the attitude of an image"
        leads.append(Lead(-1, functional, motion, given, "", None, "choose an affine transformation"))
    return leads


@dataclass(frozen=True)
class Field:
    """What decides whether images tell the interior orientation from the exterior.

    known: coordinates of object points that are known beforehand, and not just as a datum.
    """

    flat: bool
    parallel: bool
    known: str  # "points", "heights", "nothing"

    @property
    def because(self) -> str:
        if self.flat:
            axes = "the camera axes are parallel" if self.parallel else "too few images are tilted in other directions"
            return f"the field is flat and {axes}"
        known = {"points": "", "heights": ", and only heights are known", "nothing": ", and no object point is known"}
        if self.parallel:
            return f"the camera axes are parallel{known[self.known]}"
        return "these stations and points do not tell them apart"

    @property
    def remedy(self) -> str:
        """What tells a principal distance from the stations' distance in any field."""
        relief = "points at other heights" if self.known == "points" else "known points (X, Y, Z) at different heights"
        return f"add images tilted in different directions, or {relief}"


def field_of(problem: Problem, state: State, camera: str) -> Field:
    """The field that the observed points make, and the axes of a camera's images."""
    positions = np.array(list(problem.unknowns.point.values()), dtype=np.intp).reshape(-1, 3)
    xyz = state.values[positions]
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False) if len(xyz) > 2 else np.zeros(3)
    axes = state.rotations[[image.camera == camera for image in problem.network.images], 2]
    mean = axes.mean(axis=0)
    off = np.linalg.norm(np.cross(axes, mean / (np.linalg.norm(mean) or 1.0)), axis=1)
    given = problem.network.points
    heights = sum(point.Z is not None and np.isfinite(point.Z.sigma) for point in given)
    whole = sum(all(q is not None and np.isfinite(q.sigma) for q in (point.X, point.Y, point.Z)) for point in given)
    known = "points" if whole >= FIELD else "heights" if heights >= FIELD else "nothing"
    return Field(bool(extents[-1] <= FLAT * extents[0]), bool(off.max() < PARALLEL_RAD), known)


def _interior_leads(problem: Problem, camera: str, positions: Indices, field: Field) -> list[Lead]:
    """x0', y0' and c of a camera."""
    for_point = field.remedy
    if field.known != "points" and not field.flat:
        for_point = "add images turned by 180 degrees about their axes"
    texts = (
        (1, f"The principal point's x0' of camera {camera} can shift", "x0' (F7)", for_point),
        (2, f"The principal point's y0' of camera {camera} can shift", "y0' (F8)", for_point),
        (0, f"The principal distance of camera {camera} can change", "it (F9)", field.remedy),
    )
    return [
        Lead(2, _unit(problem, positions[number]), motion, given, field.because, None, otherwise)
        for number, motion, given, otherwise in texts
    ]


def _distortion_leads(problem: Problem, camera: str, positions: Indices) -> list[Lead]:
    """The distortion parameters of a camera."""
    of = family(problem.network.camera_by_name[camera].distortion.family)
    named = dict(zip(of.parameters, positions, strict=True))
    free = [each for each in of.alike_at_zero if np.isinf(problem.unknowns.sigma[named[each]])]
    because, remedy = "the targets do not tell it from the other unknowns", "spread the targets better over the frame"
    if free:
        because = f"with {', '.join(free)} free the radial numerator and denominator do the same over this image"
        remedy = f"fix some of {', '.join(free)} at 0"
    return [
        Lead(
            3,
            _unit(problem, position),
            f"The distortion parameter {name} of camera {camera} can change",
            name,
            because,
            None,
            f"fix it, or {remedy}",
        )
        for name, position in named.items()
    ]


def _unit(problem: Problem, position: int) -> Array:
    functional = np.zeros(len(problem.unknowns))
    functional[position] = 1.0
    return functional
