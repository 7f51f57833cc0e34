"""The directions in which a network's unknowns are known to move together: a table with the words for each."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.families import family
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.functional_model.transformation import follows_tilts
from adjust.problem.parameter import Kind, Parameter, enumeration
from adjust.problem.problem import Problem, State

FLAT = 0.01  # least over largest extent of the field, below which there is no relief to speak of
PARALLEL_RAD = np.radians(1.0)  # axes within this of each other are parallel
FIELD = 4  # points from which something is known of the field, and not just of its datum
LEAST_BEND = 1e-6  # of squares of the fiducials' places beyond affinities: three marks have none


class Reason(NamedTuple):
    """Why nothing hinders a motion, where that is more than what follows it; what given prior would end it; what else
    to do."""

    because: str
    given: str
    otherwise: str


@dataclass(frozen=True)
class NamedDirection:
    """What a null direction is called after: a functional (n,) of the unknowns that it changes, and the words for it.

    rank: of several that would do, that of the lowest rank gives the name. motion: what moves. reason: why, and
    by_companion, where a lens or fiducial marks move along ("lens", "marks"). partner: another unknown (its key, and in
    words) whose prior would end it, where it moves too.
    """

    rank: int
    functional: Array
    motion: str
    reason: Reason
    partner: tuple[Parameter, str] | None = None
    by_companion: Mapping[str, Reason] = field(default_factory=dict)

    def sentence(self, moved: Iterable[Parameter]) -> tuple[str, str]:
        """Cause and remedy of a direction that moves some unknowns."""
        moved = set(moved)
        lens = any(each.kind == "interior" and each.quantity not in INTERIOR_NAMES for each in moved)
        companion = "lens" if lens else "marks" if any(each.kind == "fiducial" for each in moved) else ""
        because, given, otherwise = self.by_companion.get(companion, self.reason)
        if self.partner and self.partner[0] in moved:
            given = f"{given}, or to {self.partner[1]}"
        cause = f"{self.motion}{followers(moved, self.motion)}{because and f': {because}'}."
        return cause, f"Give a standard deviation to {given}{otherwise and f', or {otherwise}'}."


# What follows a motion: the unknowns' kind, quantities (all where empty), words, a word of motions that name it.
FOLLOWERS: tuple[tuple[Kind, tuple[str, ...], str, str], ...] = (
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


def followers(moved: Iterable[Parameter], motion: str = "") -> str:
    """What moves along, in words."""
    kinds = {(each.kind, each.quantity) for each in moved}
    words = [
        word
        for kind, quantities, word, own in FOLLOWERS
        if not (own and own in motion) and any(k == kind and (not quantities or q in quantities) for k, q in kinds)
    ]
    return f", followed by {enumeration(words)}" if words else ""


# The free directions of the object space: motion, and what known coordinates end it.
DATUM_DIRECTIONS = (
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
    motion, known = DATUM_DIRECTIONS[number]
    return (
        f"The object space {motion} with all stations and points: nothing that is given fixes it.",
        f'Give {known} with a standard deviation in points.csv, or choose the datum "minimal" or "free".',
    )


_X0, _Y0, _C = ("x0", "x0' (F7)"), ("y0", "y0' (F8)"), ("c", "the principal distance (F9)")
_LEVER = "one coordinate of a fiducial mark that has a lever arm (F5, F6)"
_TWO, _THREE = (f"x' and y' of {number} fiducial marks (F5, F6)" for number in ("two", "three"))
_TURNED = "add images turned by 90 degrees about their axes or tilted in other directions"
# Common motions of all fiducial marks of a camera: rank, dx' and dy' by 1, x and y about the marks' mean, motion, what
# given prior ends it, the interior quantity that would, too, where it moves along, what else to do.
FIDUCIAL_MOTIONS = (
    (0, (1, 0, 0), (0, 0, 0), "Shift x: {} shift together in x'", "x' of one fiducial mark (F5)", _X0, ""),
    (0, (0, 0, 0), (1, 0, 0), "Shift y: {} shift together in y'", "y' of one fiducial mark (F6)", _Y0, ""),
    (0, (0, 0, -1), (0, 1, 0), "Rotation: {} turn together about the principal point", _LEVER, None, ""),
    (0, (0, 1, 0), (0, 0, 1), "Scale: {} grow together", _TWO, _C, ""),
    (1, (0, 1, 0), (0, 0, -1), "Affinity: {} stretch in x' against y'", _THREE, None, _TURNED),
    (1, (0, 0, 1), (0, 1, 0), "Shear: {} shear", _THREE, None, _TURNED),
)


def camera_directions(problem: Problem, state: State) -> list[NamedDirection]:
    """The named directions of all cameras.

    Ranks: -1 a tilt, which moves much else along, 0 what is a change of the camera's own axes, 1 other changes of its
    fiducials, 2 interior orientation, 3 distortion; -2 of a scanner's bend, which moves still more (see
    `scanner_directions`).
    """
    directions: list[NamedDirection] = []
    for name, positions in problem.unknowns.camera.items():
        directions += _fiducial_directions(problem, state, name)
        geometry = field_geometry(problem, state, name)
        for_point = geometry.remedy
        if geometry.known != "points" and not geometry.flat:
            for_point = "add images turned by 180 degrees about their axes"
        for number, motion, given, otherwise in (
            (1, f"The principal point's x0' of camera {name} can shift", "x0' (F7)", for_point),
            (2, f"The principal point's y0' of camera {name} can shift", "y0' (F8)", for_point),
            (0, f"The principal distance of camera {name} can change", "it (F9)", geometry.remedy),
        ):
            functional = changed(problem, positions[number], 1.0)
            directions.append(NamedDirection(2, functional, motion, Reason(geometry.because, given, otherwise)))
        directions += _distortion_directions(problem, name, positions[3:])
    return directions


def changed(problem: Problem, positions: Indices | int, values: Array | float) -> Array:
    """The functional (n,) of some unknowns' changes."""
    functional = np.zeros(len(problem.unknowns))
    functional[positions] = values
    return functional


def _fiducial_directions(problem: Problem, state: State, camera: str) -> Iterator[NamedDirection]:
    """Shift, rotation, scale, affinity and shear of all fiducials of a camera and of what joins the scans of its
    frames, which moves with them; and a tilt of all cameras about x' or y', where every film transformation of the
    camera can undo it.

    A tilt moves the fiducials by t (x'², x'y'), of which the functional takes what no affinity of theirs can be.
    """
    images = [image for image in problem.network.images if image.camera == camera]
    places = [positions for (owner, _), positions in problem.unknowns.fiducial.items() if owner == camera]
    if not places:
        return
    frames = {image.frame for image in images}
    marks = np.array(places + [at for (frame, _), at in problem.unknowns.join.items() if frame in frames])
    centred = state.values[marks] - state.values[marks].mean(axis=0)
    affine = np.column_stack([np.ones(len(centred)), centred])
    for rank, dx, dy, motion, given, partner, otherwise in FIDUCIAL_MOTIONS:
        functional = changed(problem, marks, affine @ np.array([dx, dy]).T)
        words = motion.format(f"all fiducial marks of camera {camera} can")
        with_partner = partner and (Parameter.interior(camera, partner[0]), partner[1])
        yield NamedDirection(rank, functional, words, Reason("", given, otherwise), with_partner)
    if not all(follows_tilts(image.transformation) for image in images):
        return
    given = "x' and y' of four fiducial marks (F5, F6), or to the attitude of an image"
    for axis, other in ("xy", "yx"):
        bend = centred[:, ["xy".index(axis)]] * centred
        bend -= affine @ np.linalg.lstsq(affine, bend)[0]
        if np.abs(bend).max() >= LEAST_BEND * np.abs(centred).max() ** 2:
            motion = (
                f"Tilt {axis}: all fiducial marks of camera {camera} can move by {axis}' times x' and y', as with one "
                f"tilt of all cameras about {other}'"
            )
            reason = Reason("", given, "choose an affine transformation")
            yield NamedDirection(-1, changed(problem, marks, bend), motion, reason)


def _distortion_directions(problem: Problem, camera: str, positions: Indices) -> Iterator[NamedDirection]:
    """The distortion parameters of a camera."""
    own_family = family(problem.network.camera_by_name[camera].distortion.family)
    named = dict(zip(own_family.parameters, positions, strict=True))
    free = [each for each in own_family.alike_at_zero if np.isinf(problem.unknowns.sigma[named[each]])]
    because, remedy = "the targets do not tell it from the other unknowns", "spread the targets better over the frame"
    if free:
        because = f"with {', '.join(free)} free the radial numerator and denominator do the same over this image"
        remedy = f"fix some of {', '.join(free)} at 0"
    for name, position in named.items():
        motion = f"The distortion parameter {name} of camera {camera} can change"
        reason = Reason(because, name, f"fix it, or {remedy}")
        yield NamedDirection(3, changed(problem, position, 1.0), motion, reason)


@dataclass(frozen=True)
class FieldGeometry:
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


def field_geometry(problem: Problem, state: State, camera: str) -> FieldGeometry:
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
    return FieldGeometry(bool(extents[-1] <= FLAT * extents[0]), bool(off.max() < PARALLEL_RAD), known)
