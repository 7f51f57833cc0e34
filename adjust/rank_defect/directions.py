"""Named null directions: joint motions of a network's unknowns, with cause and remedy."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.families import family
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.functional_model.scanner import is_left, term_degree
from adjust.functional_model.transformation import follows_tilts
from adjust.least_squares.equations import Numbering
from adjust.linear_algebra.factor import Factor
from adjust.problem.estimates import Cofactor
from adjust.problem.parameter import Kind, Parameter, enumeration, shortened
from adjust.problem.problem import Problem, State

FLAT = 0.01  # ratio of smallest and largest extent below which the field is flat
PARALLEL_RAD = np.radians(1.0)  # largest angle between parallel axes
FIELD = 4  # known points needed to determine more than the datum
LEAST_BEND = 1e-6  # second-order part of a tilt, relative, below which it is an affinity (three marks)
ALIKE_DEG = 20.0  # rotations that differ by less count as equal
HARDLY = 20.0  # ratio of a term's standard deviation to that with all else known, above which it is weak
IN_LINE = 1e-3  # width over length of collinear marks, and base over distance of coincident stations
SHOWN = 3  # names listed one by one


class DefectReason(NamedTuple):
    """Why a motion is free; the prior that would fix it; other remedies."""

    because: str
    given: str
    otherwise: str


@dataclass(frozen=True)
class NamedDirection:
    """Name of a null direction."""

    rank: int  # the lowest one that applies gives the name
    functional: Array  # (n,) function of the unknowns that the direction changes
    motion: str  # what moves, in words
    reason: DefectReason  # why, and the remedy
    # another unknown, with its words, whose prior would fix the direction if it moves too
    partner: tuple[Parameter, str] | None = None
    # reasons where a lens ("lens") or fiducial marks ("marks") move along
    by_companion: Mapping[str, DefectReason] = field(default_factory=dict)

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
_FOUR = "x' and y' of four fiducial marks (F5, F6), or to the attitude of an image"
_TURNED = "add images turned by 90 degrees about their axes or tilted in other directions"
_TILT = (
    "Tilt {0}: all fiducial marks of camera {{camera}} can move by {0}' times x' and y', as with one tilt of all "
    "cameras about {1}'"
)
# Joint motions of all fiducial marks of a camera: rank; coefficients of dx' and dy' for 1, x, y, x², xy and y² about
# the mean; motion; prior that fixes it; interior quantity whose prior would fix it too, if it moves along; other
# remedies. A tilt of all images, which every film transformation of the camera can compensate, has rank -1: its
# functional takes the part that is not an affinity.
FIDUCIAL_MOTIONS = (
    (0, (1,), (), "Shift x: {marks} shift together in x'", "x' of one fiducial mark (F5)", _X0, ""),
    (0, (), (1,), "Shift y: {marks} shift together in y'", "y' of one fiducial mark (F6)", _Y0, ""),
    (0, (0, 0, -1), (0, 1), "Rotation: {marks} turn together about the principal point", _LEVER, None, ""),
    (0, (0, 1), (0, 0, 1), "Scale: {marks} grow together", _TWO, _C, ""),
    (1, (0, 1), (0, 0, -1), "Affinity: {marks} stretch in x' against y'", _THREE, None, _TURNED),
    (1, (0, 0, 1), (0, 1), "Shear: {marks} shear", _THREE, None, _TURNED),
    (-1, (0, 0, 0, 1), (0, 0, 0, 0, 1), _TILT.format("x", "y"), _FOUR, None, "choose an affine transformation"),
    (-1, (0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 1), _TILT.format("y", "x"), _FOUR, None, "choose an affine transformation"),
)
# Interior orientation: number of the quantity, motion, and the prior that fixes it.
INTERIOR_MOTIONS = (
    (1, "The principal point's x0' of camera {} can shift", "x0' (F7)"),
    (2, "The principal point's y0' of camera {} can shift", "y0' (F8)"),
    (0, "The principal distance of camera {} can change", "it (F9)"),
)


def named_directions(problem: Problem, state: State) -> list[NamedDirection]:
    """Named directions of all scanners and cameras.

    Ranks: -2 bend of a scanner, -1 tilt, 0 change of the camera's axes, 1 other changes of its fiducials, 2 interior
    orientation, 3 distortion. The more a direction moves along, the lower its rank.
    """
    scanners, cameras = problem.unknowns.scanner, problem.unknowns.camera
    found = [each for name in scanners for each in _scanner_directions(problem, state, name)]
    for name in cameras:
        found += [*_fiducial_directions(problem, state, name), *_lens_directions(problem, state, name)]
    return found


def _functional(problem: Problem, positions: Indices | int, values: Array | float = 1.0) -> Array:
    """(n,) functional with given values at some positions."""
    functional = np.zeros(len(problem.unknowns))
    functional[positions] = values
    return functional


def _fiducial_directions(problem: Problem, state: State, camera: str) -> Iterator[NamedDirection]:
    """Joint motions of all fiducials of a camera, with the joins of its frames."""
    images = [image for image in problem.network.images if image.camera == camera]
    places = [positions for (owner, _), positions in problem.unknowns.fiducial.items() if owner == camera]
    if not places:
        return
    frames = {image.frame for image in images}
    marks = np.array(places + [at for (frame, _), at in problem.unknowns.join.items() if frame in frames])
    x, y = (state.values[marks] - state.values[marks].mean(axis=0)).T
    affine, bends = np.column_stack([np.ones(len(x)), x, y]), np.column_stack([x * x, x * y, y * y])
    moves = np.hstack([affine, bends - affine @ np.linalg.lstsq(affine, bends)[0]])
    least_bend = LEAST_BEND * max(np.abs(x).max(), np.abs(y).max()) ** 2
    words = {"marks": f"all fiducial marks of camera {camera} can", "camera": camera}
    for rank, dx, dy, motion, given, partner, otherwise in FIDUCIAL_MOTIONS:
        moved = np.column_stack([moves[:, : len(each)] @ np.array(each, dtype=float) for each in (dx, dy)])
        bent = all(follows_tilts(image.transformation) for image in images) and np.abs(moved).max() >= least_bend
        if rank >= 0 or bent:
            with_partner = partner and (Parameter.interior(camera, partner[0]), partner[1])
            functional, reason = _functional(problem, marks, moved), DefectReason("", given, otherwise)
            yield NamedDirection(rank, functional, motion.format(**words), reason, with_partner)


def _lens_directions(problem: Problem, state: State, camera: str) -> Iterator[NamedDirection]:
    """Directions named after interior orientation and distortion parameters of a camera."""
    positions, field = problem.unknowns.camera[camera], field_geometry(problem, state, camera)
    turned = "add images turned by 180 degrees about their axes"
    of_point = field.remedy if field.known == "points" or field.flat else turned
    for number, motion, given in INTERIOR_MOTIONS:
        reason = DefectReason(field.because, given, of_point if number else field.remedy)
        yield NamedDirection(2, _functional(problem, positions[number]), motion.format(camera), reason)
    own_family = family(problem.network.camera_by_name[camera].distortion.family)
    named = dict(zip(own_family.parameters, positions[3:], strict=True))
    free = [each for each in own_family.alike_at_zero if np.isinf(problem.unknowns.sigma[named[each]])]
    because, remedy = "the targets do not tell it from the other unknowns", "spread the targets better over the frame"
    if free:
        because = f"with {', '.join(free)} free the radial numerator and denominator do the same over this image"
        remedy = f"fix some of {', '.join(free)} at 0"
    for name, position in named.items():
        motion = f"The distortion parameter {name} of camera {camera} can change"
        reason = DefectReason(because, name, f"fix it, or {remedy}")
        yield NamedDirection(3, _functional(problem, position), motion, reason)


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
    xyz = state.values[problem.point_positions]
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False) if len(xyz) > 2 else np.zeros(3)
    axes = state.rotations[[image.camera == camera for image in problem.network.images], 2]
    mean = axes.mean(axis=0)
    off = np.linalg.norm(np.cross(axes, mean / (np.linalg.norm(mean) or 1.0)), axis=1)
    given = [[p is not None and np.isfinite(p.sigma) for p in q.priors] for q in problem.network.points]
    whole, heights = (sum(all(point[first:]) for point in given) for first in (0, 2))
    known = "points" if whole >= FIELD else "heights" if heights >= FIELD else "nothing"
    return FieldGeometry(bool(extents[-1] <= FLAT * extents[0]), bool(off.max() < PARALLEL_RAD), known)


Pose = tuple[int, bool]  # rotation of a frame in its scan, degrees, and whether it is mirrored


def _scanner_directions(problem: Problem, state: State, scanner: str) -> Iterator[NamedDirection]:
    """Directions named after the terms of a scanner's deformation."""
    poses = scan_poses(problem, state, scanner)
    kinds = [image.transformation for image in problem.network.images if image.scanner == scanner]
    for position in problem.unknowns.scanner[scanner].tolist():
        term = problem.unknowns.parameters[position].quantity
        film = next((kind for kind in kinds if not is_left(kind, term)), "")
        reason, *others = (term_reason(term, poses, each) for each in ("", "lens", "marks"))
        by_companion = dict(zip(("lens", "marks"), others, strict=True))
        if film:
            because = f"the {film} transformation of its films does the same"
            reason, by_companion = DefectReason(because, "the term itself", "leave it out"), {}
        motion = f"The term {term} of the bend of scanner {scanner} can change"
        yield NamedDirection(-2, _functional(problem, position), motion, reason, by_companion=by_companion)


def term_reason(term: str, poses: Sequence[Pose], confused_with: str) -> DefectReason:
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
        return DefectReason("the marks in its scans are too few, or lie too much alike, to show it", given, otherwise)
    if confused_with == "lens":
        as_they_lie = "however the frames lie" if is_odd or not one_pose else "in frames that all lie alike"
        given = "the distortion, from an earlier calibration say, or to the term itself"
        return DefectReason(f"the distortion of a lens does the same {as_they_lie}", given, otherwise)
    if one_pose:
        because = "all frames lie alike in the scanner: its bend and the fiducial marks' places are one and the same"
    elif is_odd and _are_half_turns(poses):
        because = (
            "frames turned by 180 degrees tell terms of even degree from the fiducial marks, and none of odd degree"
        )
    else:
        listed = ", ".join(f"{turn}{' mirrored' if mirrored else ''}" for turn, mirrored in poses)
        because = f"it, or its sum with others, is the same in all orientations of the scans ({listed} degrees)"
    return DefectReason(because, given, otherwise)


def weak_term_sentences(numbering: Numbering, state: State, factor: Factor, cofactor: Cofactor) -> Iterator[str]:
    """Sentences on terms that a regular network hardly separates from films, marks and lenses.

    Frames never lie exactly alike, and given fiducial marks have a standard deviation: a deformation is then
    determined, but weakly. factor: of the free unknowns; cofactor: of all.
    """
    problem, unknowns = numbering.problem, numbering.problem.unknowns
    alone = np.zeros(len(unknowns))  # inverse of the standard deviation with all else known; 0 where fixed
    alone[numbering.free] = factor.scale
    lens = np.concatenate([positions[3:] for positions in unknowns.camera.values()])
    for name, terms in unknowns.scanner.items():
        hardly = terms[np.sqrt(cofactor.variances[terms]) * alone[terms] > HARDLY]
        if not len(hardly):
            continue
        # Conditional variances of the terms, given the distortion.
        together, count = cofactor.part(np.array([*hardly, *lens[alone[lens] > 0.0]])), len(hardly)
        own, by_lens, of_lens = together[:count, :count], together[:count, count:], together[count:, count:]
        scale = np.sqrt(np.diag(of_lens))
        reduced = by_lens / scale
        taken = (reduced @ np.linalg.pinv(of_lens / np.outer(scale, scale), hermitian=True) * reduced).sum(axis=1)
        ratios = np.sqrt(np.maximum(np.diag(own) - taken, 0.0)) * alone[hardly]
        names = [unknowns.parameters[position].quantity for position in hardly]
        known_lens = [term for term, ratio in zip(names, ratios, strict=True) if ratio <= HARDLY]
        yield from undetermined_term_sentences(name, names, known_lens, scan_poses(problem, state, name))


def undetermined_term_sentences(
    scanner: str, terms: Sequence[str], by_lens: Collection[str], poses: Sequence[Pose]
) -> Iterator[str]:
    """Sentences on terms of a scanner's deformation that are not, or hardly, separable from other unknowns.

    by_lens: terms that would be determined if the distortion were known.
    """
    by_reason: dict[DefectReason, list[str]] = {}
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


def scan_poses(problem: Problem, state: State, scanner: str) -> list[Pose]:
    """Distinct poses of frames in their scans, from the gradients of their film transformations."""
    poses: list[Pose] = []
    for films in problem.films:
        gradients = films.kind.gradient(state.values[films.positions], films.center_mm)
        for i, gradient in zip(films.images, gradients, strict=True):
            mirrored = bool(np.linalg.det(gradient) < 0.0)
            upright = gradient * [1.0, -1.0] if mirrored else gradient
            turn = round(np.degrees(np.arctan2(upright[1, 0] - upright[0, 1], upright[0, 0] + upright[1, 1]))) % 360
            known = (mirrored == m and abs((turn - t + 180) % 360 - 180) < ALIKE_DEG for t, m in poses)
            if problem.network.images[i].scanner == scanner and not any(known):
                poses.append((turn, mirrored))
    return sorted(poses)


# Cause and remedy by the kind of the unknown that moves most.
UNNAMED: Mapping[str, tuple[str, str]] = {
    "exterior": (
        "The exterior orientation of image {owner} can change ({quantity} most){followers}: too few known points, or "
        "rays from other stations, hold it.",
        "Measure known points in it, add images from other stations, or give its orientation with standard deviations "
        "in images.csv.",
    ),
    "point": (
        "The object point {id} can move ({quantity} most){followers}.",
        "Measure it in more images, give its coordinates with standard deviations, or leave it out.",
    ),
    "fiducial": (
        "The fiducial mark {id} of camera {owner} can move ({quantity} most){followers}.",
        "Give it a standard deviation (F5, F6), or measure it in more images.",
    ),
    "film": (
        "The film transformation of image {owner} can change ({quantity} most){followers}.",
        "Measure more fiducial marks in this image, or choose a transformation with fewer parameters.",
    ),
    "join": (
        "Point {id}, which joins the scans of frame {owner}, can move ({quantity} most){followers}.",
        "Measure more points that both scans show, spread over their overlap.",
    ),
    "scanner": (
        "The term {quantity} of the bend of scanner {owner} can change{followers}.",
        "Give {quantity} a standard deviation, or leave it out.",
    ),
    "board": (
        "The {quantity} of board {owner} can change{followers}: no image sees the board at a slant.",
        "Take images that are tilted against the board, or give its bend a standard deviation.",
    ),
    "interior": (
        "The quantity {quantity} of camera {owner} can change{followers}.",
        "Give {quantity} a standard deviation, or fix it.",
    ),
}


def unnamed_sentence(most: Parameter, followers: str) -> tuple[str, str]:
    """Cause and remedy of an unnamed direction, by the unknown that moves most."""
    cause, remedy = (text.format(**most._asdict(), followers=followers) for text in UNNAMED[most.kind])
    return cause, remedy


def many_sentence(count: int, followers: str) -> tuple[str, str]:
    """Cause and remedy of many unnamed directions."""
    return (
        f"The network can drift and bend in {count} ways{followers}: what is known of the object is too little for it, "
        "or too far apart.",
        "Measure known points all over it (of a long strip every few images), or give stations with standard "
        "deviations in images.csv.",
    )


def own_sentence(problem: Problem, state: State, parameter: Parameter) -> tuple[str, str]:
    """Cause and remedy of an undetermined image or point; parameter: one of its unknowns."""
    if parameter.kind == "point":
        return _point_sentence(problem, state, parameter.id)
    network, name = problem.network, parameter.owner
    frame = network.image_by_name[name].part_of if name in network.image_by_name else name
    parts = [image.name for image in network.images if frame and image.part_of == frame]
    if not parts:
        return _image_sentence(problem, name)
    common = sum(joined == frame for joined, _ in network.joins)
    return (
        f"The marks of frame {frame} do not determine its orientation and the transformations of its scans "
        f"{shortened(parts, SHOWN)}, which {common} points join.",
        "Measure more fiducial marks and more common points, spread over what the scans have in common, choose a "
        "transformation with fewer parameters, or leave the frame out.",
    )


def _point_sentence(problem: Problem, state: State, point: str) -> tuple[str, str]:
    position = problem.unknowns.point[point]
    numbers = problem.image_numbers[(problem.places[:, 0] == position[0]) & ~problem.is_fiducial]
    images = shortened([problem.network.images[i].name for i in numbers], SHOWN)
    stations = state.values[problem.exterior[numbers, :3]]
    distances = np.linalg.norm(stations - state.values[position], axis=1)
    where = "from another station"
    if len(numbers) == 1:
        cause = f"Only image {images} shows point {point}: one ray does not tell where on it the point lies."
    elif np.linalg.norm(stations - stations[0], axis=1).max() <= IN_LINE * distances.max():
        cause = f"The images that show point {point} ({images}) were taken from one station: their rays are one ray."
    else:
        where = "from a station off that line"
        cause = (
            f"Point {point} lies in line with the stations of the images that show it ({images}): their rays are one "
            "ray."
        )
    return cause, f"Measure it in an image {where}, give its coordinates, or leave it out."


def _image_sentence(problem: Problem, image: str) -> tuple[str, str]:
    xy_mm, why = problem.network.observations.xy_mm, []
    own = np.array(problem.network.observations.image) == image
    for what, rows in (("targets", own & ~problem.is_fiducial), ("fiducial marks", own & problem.is_fiducial)):
        if rows.any():
            extents = np.linalg.svd(xy_mm[rows] - xy_mm[rows].mean(axis=0), compute_uv=False)
            if len(extents) < 2 or extents[-1] <= IN_LINE * extents[0]:
                why.append(f"all its {what} lie on one line")
    cause = f"The marks of image {image} do not determine its own orientation and transformation"
    where = "off that line" if why else "spread over the frame"
    return (
        f"{cause}{': ' if why else ''}{' and '.join(why)}.",
        f"Measure more marks in this image, {where}, give its orientation in images.csv, or leave the image out.",
    )
