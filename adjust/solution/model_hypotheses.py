"""What a network's model may lack, each as the same problem with more unknowns: lens terms, square pixels, one interior
orientation for all images, a flat board.

Every one starts where the adjustment without its unknowns ended, so that one linearised step tells what it explains.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.added_terms import DECENTERING, RADIAL
from adjust.functional_model.families import EXTENDED, family
from adjust.functional_model.lens import Prior
from adjust.functional_model.scanner import is_left
from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Board, Image, Network, Scanner
from adjust.problem.problem import Problem, State, number
from adjust.solution.image_groups import two_groups
from adjust.solution.reweighting import Run

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

FREE = Prior(0.0, np.inf)
TERMS_TOGETHER = 2  # radial terms that are tested as one
OTHERS = " (other images)"  # behind a camera's name: the part of its images that may have another interior orientation
SCANNER = "scanner"
BOARD = "board"
INTERIOR = ("c", "x0", "y0")


@dataclass(frozen=True)
class ModelHypothesis:
    """A model with added unknowns.

    camera: of which it is, empty of a board. problem: it starts where the simpler model ended. added (k,): positions of
    the added unknowns. choices: natural logarithm of how many such models it was chosen from; contrasts: the unknowns
    that all of these together would have. images: the smaller of two groups.
    """

    camera: str
    problem: Problem
    added: Indices
    choices: float = 0.0
    contrasts: int = 0
    images: tuple[str, ...] = ()


def radial_terms(run: Run) -> Iterator[ModelHypothesis]:
    """The next radial terms that a camera's own do not have."""
    for camera in _cameras(run):
        count = sum(name in _free_terms(camera) for name in (*_own_terms(camera, "radial"), *RADIAL))
        first = min(count, len(RADIAL) - TERMS_TOGETHER)
        yield _extended_lens(run, camera, RADIAL[first : first + TERMS_TOGETHER])


def decentering_terms(run: Run) -> Iterator[ModelHypothesis]:
    """Decentering, or the next terms of it."""
    for camera in _cameras(run):
        free = _free_terms(camera)
        has_decentering = any(name in free for name in (*_own_terms(camera, "decentering"), *DECENTERING[0]))
        if not free.intersection(DECENTERING[1]):
            yield _extended_lens(run, camera, DECENTERING[int(has_decentering)])


def unequal_pixels(run: Run) -> Iterator[ModelHypothesis]:
    """A digital camera's, or those of a scanner that stretches one axis where film transformations do not take that."""
    network = run.problem.network
    for camera in _cameras(run):
        digital = all(image.transformation == "none" for image in network.images if image.camera == camera.name)
        if digital and not _free_terms(camera).intersection({*_own_terms(camera, "affinity")[:1], "+b1"}):
            yield _extended_lens(run, camera, ("+b1",))
    films = [image for image in network.images if image.transformation != "none"]
    if not films or network.scanners or not all(is_left(image.transformation, "stretch") for image in films):
        return
    extents = [network.extent_by_image[image.name] for image in films]
    middle = np.mean([extent.center_mm for extent in extents], axis=0)
    half_mm = max(extent.half_mm for extent in extents)
    scanner = Scanner(SCANNER, {"stretch": FREE}, (float(middle[0]), float(middle[1])), (half_mm, half_mm))
    images = tuple(replace(image, scanner=SCANNER) if image in films else image for image in network.images)
    problem = continued(run, replace(network, images=images, scanners=(scanner,)))
    yield ModelHypothesis(films[0].camera, problem, problem.unknowns.scanner[SCANNER])


def second_interior_orientation(run: Run) -> Iterator[ModelHypothesis]:
    """Some of a camera's images with another principal distance and principal point."""
    network = run.problem.network
    if any(each.name.endswith(OTHERS) for each in network.cameras):
        return
    for camera in _cameras(run):
        groups = two_groups(run, camera.name)
        if groups is None:
            continue
        others, own = camera.name + OTHERS, groups.images
        images = tuple(replace(image, camera=others) if image.name in own else image for image in network.images)
        cameras = (*network.cameras, replace(camera, name=others))
        problem = continued(run, replace(network, images=images, cameras=cameras), {others: camera.name})
        added = problem.unknowns.camera[others][: len(INTERIOR)]
        contrasts = len(INTERIOR) * (groups.count - 1)
        yield ModelHypothesis(camera.name, problem, added, groups.choices, contrasts, own)


def bent_board(run: Run) -> Iterator[ModelHypothesis]:
    """All given points as a board that is bent, where they are a flat one."""
    network = run.problem.network
    places = network.known_places
    if network.boards or not places or len(places) < len(network.observed_points):
        return
    try:
        board = Board(BOARD, places, (FREE, FREE))
    except ValueError:
        return
    problem = continued(run, replace(network, boards=(board,)))
    yield ModelHypothesis("", problem, problem.unknowns.board[BOARD])


def _cameras(run: Run) -> list[Camera]:
    """Those whose images show object points."""
    network = run.problem.network
    used = run.problem.unknowns.camera.keys() - network.idle_cameras
    return [camera for camera in network.cameras if camera.name in used]


def _free_terms(camera: Camera) -> set[str]:
    return {name for name, prior in camera.distortion.parameters.items() if prior.sigma > 0.0}


def _own_terms(camera: Camera, group: str) -> tuple[str, ...]:
    """The terms of a group of the camera's own family."""
    return tuple(dict(family(camera.distortion.family.removesuffix(EXTENDED)).groups).get(group, ()))


def _extended_lens(run: Run, camera: Camera, terms: Sequence[str]) -> ModelHypothesis:
    distortion = camera.distortion
    extended = distortion.family if distortion.family.endswith(EXTENDED) else distortion.family + EXTENDED
    half_mm = distortion.half_mm if min(distortion.half_mm) > 0.0 else (_reach(run.problem.network, camera.name),) * 2
    parameters = dict(distortion.parameters) | dict.fromkeys(terms, FREE)
    changed = replace(camera, distortion=replace(distortion, family=extended, parameters=parameters, half_mm=half_mm))
    cameras = tuple(changed if each is camera else each for each in run.problem.network.cameras)
    problem = continued(run, replace(run.problem.network, cameras=cameras))
    names = family(extended).parameters
    added = problem.unknowns.camera[camera.name][[3 + names.index(term) for term in terms]]
    return ModelHypothesis(camera.name, problem, added)


def _reach(network: Network, camera: str) -> float:
    """Half the extent of the camera's images in mm, by their marks."""
    return max(network.extent_by_image[image.name].half_mm for image in network.images if image.camera == camera)


def separate_lenses(run: Run) -> Problem | None:
    """The problem of an adjustment with two groups of images, whose lenses share nothing; None where marks do."""
    network = run.problem.network
    if any(camera.fiducials for camera in network.cameras):
        return None
    problem = continued(run, network)
    unknowns, old = problem.unknowns, run.problem.unknowns
    sigma, start = unknowns.sigma.copy(), unknowns.start.copy()
    for name, at in old.camera.items():
        sigma[unknowns.camera[name]], start[unknowns.camera[name]] = old.sigma[at], run.end.state.values[at]
    return replace(problem, unknowns=replace(unknowns, sigma=sigma, start=start))


def continued(run: Run, network: Network, like: dict[str, str] | None = None) -> Problem:
    """A network with more unknowns as a problem that starts where an adjustment ended, in the datum of that.

    like: cameras that share the distortion and the fiducial marks of another one, and start with its interior
    orientation.
    """
    old, state, like = run.problem.unknowns, run.end.state, like or {}
    problem = number(network, _approximations(run.problem, network, state, like), run.problem.by_elements)
    unknowns = problem.unknowns
    position = {parameter: i for i, parameter in enumerate(old.parameters)}
    new = np.array([i for i, parameter in enumerate(unknowns.parameters) if parameter in position], dtype=np.intp)
    at = np.array([position[unknowns.parameters[i]] for i in new], dtype=np.intp)
    given, sigma, start = unknowns.given.copy(), unknowns.sigma.copy(), unknowns.start.copy()
    given[new], sigma[new], start[new] = old.given[at], old.sigma[at], state.values[at]
    camera, fiducial = dict(unknowns.camera), dict(unknowns.fiducial)
    for name, of in like.items():
        apart, own = camera[name][: len(INTERIOR)], camera[of]
        given[apart], sigma[apart], start[apart] = np.nan, np.inf, start[own[: len(INTERIOR)]]
        sigma[camera[name][len(INTERIOR) :]] = 0.0
        camera[name] = np.concatenate([apart, own[len(INTERIOR) :]])
        for (owner, id_), pair in unknowns.fiducial.items():
            if owner == name:
                sigma[pair] = 0.0
                fiducial[name, id_] = fiducial[of, id_]
    shared = replace(unknowns, given=given, sigma=sigma, start=start, camera=camera, fiducial=fiducial)
    return replace(problem, unknowns=shared)


def _approximations(problem: Problem, network: Network, state: State, like: dict[str, str]) -> Approximations:
    """The state of a problem, for a network of the same images."""
    unknowns, values = problem.unknowns, state.values
    interior = {name: values[at[: len(INTERIOR)]] for name, at in unknowns.camera.items()}
    images: Sequence[Image] = network.images
    return Approximations(
        interior=interior | {name: interior[of] for name, of in like.items()},
        exterior={image.name: values[unknowns.exterior[image.name]] for image in images},
        transformation={image.name: values[unknowns.transformation[image.name]] for image in images},
        points={id_: values[at] for id_, at in unknowns.point.items()},
        mirrored=problem.mirrored,
        joins={key: values[at] for key, at in unknowns.join.items()},
    )
