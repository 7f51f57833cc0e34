"""Slips planted into whole networks, and what is said of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from simulated import Truth, field_points, simulated

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Fiducial
from adjust.problem.network import Exterior, Network, ObjectPoint
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

EXACT = np.array([0.05, 0.05, 0.05, 1e-4, 1e-4, 1e-4])  # of observed stations (m) and attitudes (rad)
APPROXIMATE = np.full(6, np.inf)
MIRRORS = "The points are mirrored: the sign of X, Y or Z of all of them is wrong, or two axes are exchanged"


def network(seed: int, oriented: Array | None = None, relief: float = 200.0) -> Network:
    """Four images of a field of 14 to 30 points known to 5 cm, taken anew for every seed; their orientations, if asked
    for, as they are observed, or roughly where no sigmas are."""
    rng = np.random.default_rng([7, seed])
    truth = Truth()
    moved = tuple(tuple(each) for each in np.array(truth.stations) + rng.normal(0.0, 60.0, (4, 3)))
    turns = rng.normal(0.0, [0.05, 0.05, 1.5], (4, 3))
    tilted = tuple(tuple(each) for each in np.array(truth.attitudes) + turns)
    truth = replace(truth, stations=moved, attitudes=tilted, distortion={"k3": 2e-8, "p1": 2e-8})
    points = field_points(rng, int(rng.integers(14, 31)), relief)
    made, _ = simulated(rng, truth, points=points, fiducial_sigma=0.01, point_sigma=0.05)
    camera = replace(made.cameras[0], principal_distance_mm=Prior(truth.c, 0.0))
    made = replace(made, cameras=(camera,))
    if oriented is None:
        return made
    errors = np.where(np.isfinite(oriented), oriented, [20.0, 20.0, 20.0, 0.03, 0.03, 0.03])
    exteriors = [
        Exterior(np.array([*station, *attitude]) + errors * rng.normal(size=6), oriented)
        for station, attitude in zip(truth.stations, truth.attitudes, strict=True)
    ]
    images = zip(made.images, exteriors, strict=True)
    return replace(made, images=tuple(replace(image, exterior=each) for image, each in images))


def change_points(given: Network, changed: Callable[[Array], Array], sigma: float = 1.0) -> Network:
    points = []
    for point in given.points:
        priors = [prior for prior in (point.X, point.Y, point.Z) if prior]
        xyz = changed(np.array([prior.value for prior in priors]))
        of_axes = zip(xyz, priors, strict=True)
        points.append(ObjectPoint(point.id, *(Prior(float(value), sigma * prior.sigma) for value, prior in of_axes)))
    return replace(given, points=tuple(points))


def y_down(given: Network) -> Network:
    camera = given.cameras[0]
    marks = {id: Fiducial(mark.x_mm, Prior(-mark.y_mm.value, mark.y_mm.sigma)) for id, mark in camera.fiducials.items()}
    return replace(given, cameras=(replace(camera, fiducials=marks),))


def other_c(given: Network, off_mm: float = 10.0) -> Network:
    camera = given.cameras[0]
    assert camera.principal_distance_mm is not None
    c = Prior(camera.principal_distance_mm.value + off_mm, camera.principal_distance_mm.sigma)
    return replace(given, cameras=(replace(camera, principal_distance_mm=c),))


def exchanged(given: Network, with_fiducials: bool = False) -> Network:
    """The targets of f1 and f3, or all their marks, under each other's name."""
    other = {"f1": "f3", "f3": "f1"}
    observations = given.observations
    rows = zip(observations.image, observations.kind, strict=True)
    image = tuple(other.get(name, name) if with_fiducials or kind == "target" else name for name, kind in rows)
    return replace(given, observations=replace(observations, image=image))


def one_point(given: Network) -> Network:
    first, *others = given.points
    assert first.X is not None
    return replace(given, points=(replace(first, X=Prior(first.X.value + 200.0, first.X.sigma)), *others))


@dataclass(frozen=True)
class Kind:
    """A slip: how the network is otherwise given, how it is spoilt, and what has to be said of it."""

    oriented: Array | None
    spoil: Callable[[Network], Network]
    words: tuple[str, ...]


KINDS = {
    "sign of X": Kind(None, lambda n: change_points(n, lambda p: p * [-1, 1, 1]), (MIRRORS,)),
    "sign of Z": Kind(None, lambda n: change_points(n, lambda p: p * [1, 1, -1]), (MIRRORS,)),
    "X and Y exchanged": Kind(None, lambda n: change_points(n, lambda p: p[[1, 0, 2]]), (MIRRORS,)),
    "sign of X, approximate orientations": Kind(
        APPROXIMATE, lambda n: change_points(n, lambda p: p * [-1, 1, 1]), ("The sign of X of all points is wrong. ",)
    ),
    "X and Y exchanged, approximate orientations": Kind(
        APPROXIMATE, lambda n: change_points(n, lambda p: p[[1, 0, 2]]), ("X and Y of all points are exchanged. ",)
    ),
    "sign of Z, observed orientations": Kind(
        EXACT, lambda n: change_points(n, lambda p: p * [1, 1, -1]), ("The sign of Z of all points is wrong. ",)
    ),
    "y of the camera down": Kind(None, y_down, ("y' axis of the camera's fiducial marks points down",)),
    "y of the camera down, approximate orientations": Kind(
        APPROXIMATE, y_down, ("The y' axis of the camera's fiducial marks points down",)
    ),
    "c 10 mm too long": Kind(None, other_c, ("principal distance of camera K is not the 163 mm",)),
    "targets of two frames exchanged": Kind(None, exchanged, ("targets of the frames f1 and f3 are exchanged",)),
    "mm for m, approximate orientations": Kind(
        APPROXIMATE, lambda n: change_points(n, lambda p: 1000.0 * p, 1000.0), ("points are 1000 times too large",)
    ),
    "mm for m, observed orientations": Kind(
        EXACT, lambda n: change_points(n, lambda p: 1000.0 * p, 1000.0), ("points are 1000 times too large",)
    ),
    "names of two frames exchanged, approximate orientations": Kind(
        APPROXIMATE, lambda n: exchanged(n, with_fiducials=True), ("their names are exchanged",)
    ),
    "one point": Kind(None, one_point, ("Control point 0 is not where it is given",)),
    "nothing": Kind(None, lambda n: n, ()),
    "nothing, approximate orientations": Kind(APPROXIMATE, lambda n: n, ()),
}  # fmt: skip


def describe(spoilt: Network) -> list[str]:
    """What a user is told: the message, or the warnings and what is called suspect."""
    try:
        result = adjust(spoilt)
    except AdjustmentError as error:
        return [str(error)]
    return [*result.warnings, *(f"{each.tested.name} is suspect" for each in result.suspects)]


WHOLE = ("exchanged", "wrong", "points down", "times too", "principal distance of camera")
SINGLE = ("is suspect", "is not where", "swapped")


def outcome(kind: Kind, sentences: list[str]) -> str:
    """named: what is to be said, and nothing that blames anything else; misleading: something else is blamed.

    Beside a point that is named, tests of single observations may tell of its neighbours; no other slip's blame may
    stand there.
    """
    is_single = any(words in named for words in SINGLE for named in kind.words)
    others = WHOLE if is_single else WHOLE + SINGLE
    named = [each for each in sentences if any(words in each for words in kind.words)]
    if any(words in each for words in others for each in sentences if each not in named):
        return "misleading"
    return "named" if named or not kind.words else "unnamed"
