"""Named null directions: known joint motions of a network's unknowns, with cause and remedy."""

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

FLAT = 0.01  # ratio of smallest and largest extent below which the field is flat
PARALLEL_RAD = np.radians(1.0)  # largest angle between parallel axes
FIELD = 4  # known points needed to determine more than the datum
LEAST_BEND = 1e-6  # second-order part of a tilt, relative, below which it is an affinity (three marks)


class Reason(NamedTuple):
    """Why a motion is free; the prior that would fix it; other remedies."""

    because: str
    given: str
    otherwise: str


@dataclass(frozen=True)
class NamedDirection:
    """Name of a null direction.

    Attributes
    ----------
    rank : the lowest one that applies gives the name.
    functional : (n,) function of the unknowns that the direction changes.
    motion : what moves, in words.
    reason : why, and the remedy.
    partner : another unknown, with its words, whose prior would fix the direction if it moves too.
    by_companion : reasons where a lens ("lens") or fiducial marks ("marks") move along.
    """

    rank: int
    functional: Array
    motion: str
    reason: Reason
    partner: tuple[Parameter, str] | None = None
    by_companion: Mapping[str, Reason] = field(default_factory=dict)

    def sentence(self, moved: Iterable[Parameter]) -> tuple[str, str]:
        """Cause and remedy, given the unknowns that move."""
        moved = set(moved)
        lens = any(each.kind == "interior" and each.quantity not in INTERIOR_NAMES for each in moved)
        companion = "lens" if lens else "marks" if any(each.kind == "fiducial" for each in moved) else ""
        because, given, otherwise = self.by_companion.get(companion, self.reason)
        if self.partner and self.partner[0] in moved:
            given = f"{given}, or to {self.partner[1]}"
        cause = f"{self.motion}{followers(moved, self.motion)}{because and f': {because}'}."
        return cause, f"Give a standard deviation to {given}{otherwise and f', or {otherwise}'}."


# Followers of a motion: kind, quantities (empty: all), words; not mentioned if the motion contains the last text.
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
    """Words for the unknowns that move along."""
    kinds = {(each.kind, each.quantity) for each in moved}
    words = [
        word
        for kind, quantities, word, own in FOLLOWERS
        if not (own and own in motion) and any(k == kind and (not quantities or q in quantities) for k, q in kinds)
    ]
    return f", followed by {enumeration(words)}" if words else ""


# Free directions of the object space: motion, and the known coordinates that would fix it.
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
# Joint motions of all fiducial marks of a camera: rank; coefficients of dx' and dy' for 1, x and y about the mean;
# motion; prior that fixes it; interior quantity whose prior would fix it too, if it moves along; other remedies.
FIDUCIAL_MOTIONS = (
    (0, (1, 0, 0), (0, 0, 0), "Shift x: {} shift together in x'", "x' of one fiducial mark (F5)", _X0, ""),
    (0, (0, 0, 0), (1, 0, 0), "Shift y: {} shift together in y'", "y' of one fiducial mark (F6)", _Y0, ""),
    (0, (0, 0, -1), (0, 1, 0), "Rotation: {} turn together about the principal point", _LEVER, None, ""),
    (0, (0, 1, 0), (0, 0, 1), "Scale: {} grow together", _TWO, _C, ""),
    (1, (0, 1, 0), (0, 0, -1), "Affinity: {} stretch in x' against y'", _THREE, None, _TURNED),
    (1, (0, 0, 1), (0, 1, 0), "Shear: {} shear", _THREE, None, _TURNED),
)


def camera_directions(problem: Problem, state: State) -> list[NamedDirection]:
    """Named directions of all cameras.

    Ranks: -2 bend of a scanner (see `scanner_directions`), -1 tilt, 0 change of the camera's axes, 1 other changes of
    its fiducials, 2 interior orientation, 3 distortion. The more a direction moves along, the lower its rank.
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
    """(n,) functional with given values at some positions."""
    functional = np.zeros(len(problem.unknowns))
    functional[positions] = values
    return functional


def _fiducial_directions(problem: Problem, state: State, camera: str) -> Iterator[NamedDirection]:
    """Shift, rotation, scale, affinity and shear of all fiducials of a camera, with the joins of its frames; and a tilt
    of all images about x' or y', where every film transformation of the camera can compensate it.

    A tilt moves the fiducials by t (x'², x'y'); the functional takes the part that is not an affinity.
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
    """Directions named after the distortion parameters of a camera."""
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
    """Geometry that decides whether interior and exterior orientation are separable.

    known: object coordinates with priors, beyond a datum.
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
        """Remedy that separates the principal distance from the object distance in any field."""
        relief = "points at other heights" if self.known == "points" else "known points (X, Y, Z) at different heights"
        return f"add images tilted in different directions, or {relief}"


def field_geometry(problem: Problem, state: State, camera: str) -> FieldGeometry:
    """Geometry of the observed points and of the axes of a camera's images."""
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
