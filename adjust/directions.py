"""The directions in which a network's unknowns are known to move together, and what to say of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.families import parameter_names
from adjust.problem import Problem, State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lead:
    """What a null direction is called after: a functional (n,) of the unknowns that it changes, cause and remedy.

    rank: of several leads that would do, that of the lowest rank gives the name.
    """

    rank: int
    functional: Array
    cause: str
    remedy: str


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
    """What a null direction of fiducials (rank 0), interior orientation (1) or distortion (2) is called after."""
    leads = []
    for name, positions in problem.unknowns.camera.items():
        leads += _fiducial_leads(problem, state, name)
        leads += _interior_leads(problem, name, positions[[1, 2, 0, *range(3, len(positions))]])
    return leads


def _fiducial_leads(problem: Problem, state: State, camera: str) -> list[Lead]:
    """Shift, rotation, scale, affinity and shear of all fiducials of a camera."""
    pairs = [positions for (owner, _), positions in problem.unknowns.fiducial.items() if owner == camera]
    if not pairs:
        return []
    positions = np.array(pairs)
    x, y = (state.values[positions] - state.values[positions].mean(axis=0)).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    marks = f"all fiducial marks of camera {camera}"
    follow = "and the transformation of every image follows"
    texts = (
        (
            one,
            zero,
            f"Shift x: {marks} can shift together in x', {follow}.",
            "x' of one fiducial mark (F5), or to x0' (F7) where it is named here",
        ),
        (
            zero,
            one,
            f"Shift y: {marks} can shift together in y', {follow}.",
            "y' of one fiducial mark (F6), or to y0' (F8) where it is named here",
        ),
        (
            -y,
            x,
            f"Rotation: {marks} can turn together about the principal point, {follow} with kappa.",
            "one coordinate of a fiducial mark that has a lever arm (F5, F6)",
        ),
        (
            x,
            y,
            f"Scale: {marks} can grow together, {follow} with the principal distance or the stations' distance.",
            "two fiducial marks (F5, F6), or to the principal distance (F9) where it is named here",
        ),
        (
            x,
            -y,
            f"Affinity: {marks} can stretch in x' against y', {follow} with stations and object.",
            "three fiducial marks (F5, F6), or take images that converge or are turned by 90 degrees about their axes",
        ),
        (
            y,
            x,
            f"Shear: {marks} can shear, {follow} with stations and object.",
            "three fiducial marks (F5, F6), or take images that converge or are turned by 90 degrees about their axes",
        ),
    )
    leads = []
    for dx, dy, cause, known in texts:
        functional = np.zeros(len(problem.unknowns))
        functional[positions] = np.stack([dx, dy], axis=1)
        leads.append(Lead(0, functional, cause, f"Give a standard deviation to {known}."))
    return leads


def _interior_leads(problem: Problem, camera: str, positions: NDArray[np.intp]) -> list[Lead]:
    """x0', y0', c and the distortion parameters of a camera."""
    geometry = "take convergent images, images turned by 90 degrees about their axes, or a field with more relief"
    texts = [
        (
            f"The principal point's {axis}' of camera {camera} cannot be told from a shift or tilt of the stations: "
            f"the field is flat or the axes are parallel.",
            f"Give {axis}' a standard deviation ({number}), or {geometry}.",
        )
        for axis, number in (("x0", "F7"), ("y0", "F8"))
    ]
    texts.append(
        (
            f"The principal distance of camera {camera} cannot be told from the stations' distance from the field, or "
            f"from the heights: the field is flat or the axes are parallel.",
            f"Give the principal distance a standard deviation (F9), or {geometry}.",
        )
    )
    texts += [
        (
            f"The distortion parameter {name} of camera {camera} cannot be told from the other unknowns.",
            f"Fix {name} or give it a standard deviation, or spread the targets better over the frame.",
        )
        for name in parameter_names(problem.network.camera_by_name[camera].distortion.family)
    ]
    unit = np.zeros((len(positions), len(problem.unknowns)))
    unit[np.arange(len(positions)), positions] = 1.0
    return [
        Lead(1 if number < 3 else 2, functional, cause, remedy)
        for number, (functional, (cause, remedy)) in enumerate(zip(unit, texts, strict=True))
    ]
