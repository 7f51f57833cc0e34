"""Hypotheses on errors of a network's model, each as the same problem with additional unknowns.

Lens terms, non-square pixels, different interior orientations of images, a bent or stretched board, wrong coordinates
of a given point. Each problem starts where the adjustment without its unknowns ended, so that one linearised step
estimates the fall of v'Pv.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from scipy.spatial import KDTree

from adjust.array_types import Array, Indices
from adjust.functional_model.board import BoardForm, board_form, disk_directions, strain_directions
from adjust.functional_model.correction import AFFINITY_TERMS, ZERO, PolynomialTerms, Term, decentering, radial
from adjust.functional_model.lens import INTERIOR_NAMES, Prior
from adjust.functional_model.scanner import is_left
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import linearise
from adjust.problem.camera import Camera
from adjust.problem.condition_equations import computed_observations, in_camera, object_displacements
from adjust.problem.network import Approximations, Board, Network, Scanner
from adjust.problem.problem import Problem, State, number
from adjust.quality.cofactor import free_cofactor
from adjust.quality.run import Run
from adjust.solution.displaced_points import displaced_points
from adjust.solution.hypothesis_words import (
    bend_words,
    bow_words,
    disk_words,
    drift_words,
    free_terms,
    group_words,
    interior_words,
    lens_words,
    moved_words,
    own_terms,
    pixel_words,
    point_words,
    shear_words,
    strain_words,
    twist_words,
)
from adjust.solution.image_groups import two_groups

FREE = Prior(0.0, np.inf)
RADIAL_DEGREES = (3, 5, 7, 9, 11, 13)
# Of the six terms of degree 2 two are decentering, and the tilts of the images take two.
BOW: tuple[Term, Term] = (({(0, 2): 1.0}, ZERO), (ZERO, {(2, 0): 1.0}))
TERMS_TOGETHER = 2  # radial terms tested jointly
FEWEST_DRIFTING = 4  # images that tell a drift from their scatter
LEAST_CHANGE = 0.05  # of the distance
OTHERS = " (other images)"  # suffix of a camera's name for the images with a different interior orientation
FEWEST_GIVEN, FEWEST_IMAGES = 5, 2  # given points, and images of one, that tell a wrong one
MISMEASURED = 0.1  # relative error of the given diameter of disks whose effect is reported
CLEAR = 3.0  # standard deviations above which one of two changes of a board is told

# Of `adjust.solution.hypothesis_words`, with all arguments that belong to the hypothesis given.
Words = Callable[[Run, Indices, float], tuple[str, str]]


@dataclass(frozen=True)
class ModelHypothesis:
    """Model with additional unknowns."""

    kind: str  # of what is wrong: "radial", "pixels", "groups", "drift", "interior", "board", "disks", "point", ...
    words: Words  # returns cause (with figures) and remedy
    problem: Problem  # problem that starts where the simpler model ended
    added: Indices  # (k,) positions of the additional unknowns
    name: str = ""  # of the displacement that is added
    limits: tuple[float, float] = (-np.inf, np.inf)  # possible values of the unknowns
    choices: float = 0.0  # natural logarithm of the number of models it was selected from
    contrasts: int = 0  # number of unknowns that all of these models would have together
    p_scatter: Callable[[], float] = float  # of groups of images, see `ImageGroups`; 0 for other hypotheses


def model_hypotheses(run: Run, most_points: int) -> Iterator[ModelHypothesis]:
    """Generate all hypotheses on what the model of an adjustment may lack; most_points: that may be wrong together."""
    network = run.problem.network
    used = run.problem.unknowns.camera.keys() - network.idle_cameras
    cameras = [camera for camera in network.cameras if camera.name in used]
    is_grouped = any(each.name.endswith(OTHERS) for each in network.cameras)
    always = _lens_terms, _drift, _wrong_interior_orientation
    tested = {board.name for board in network.boards}
    for hypotheses in always if is_grouped else (*always, _second_interior_orientation):
        for camera in cameras:
            yield from (each for each in hypotheses(run, camera) if each.name not in tested)
    yield from _scanner_pixels(run)
    yield from (each for each in _deformations(run) if each.name not in tested)
    if most_points:
        yield from (each for each in _wrong_points(run, most_points) if each.name not in tested)


def diameter_notes(run: Run) -> Iterator[str]:
    """Note where a wrong diameter of the disks, or one that is not given, changes c by more than its deviation."""
    for each in _disks(run) if run.converged else ():
        unknowns, (radius_squared,) = each.problem.unknowns, each.added
        weighted, covariance = run.weighting.applied(each.problem)
        numbering = Numbering(weighted)
        if (at := linearise(numbering, covariance, weighted.start())) is None:
            return
        cofactor = free_cofactor(numbering, at.state, at.factor)
        given = run.problem.network.disk_radius
        for camera, (c, *_) in unknowns.camera.items():
            (own, common), (_, square) = cofactor.part(np.array([c, radius_squared]))
            squared = _possible_radius(run) ** 2 if given is None else ((1.0 + MISMEASURED) ** 2 - 1.0) * given**2
            change = squared * common / square
            if abs(change) <= np.sqrt(own - common**2 / square):
                continue
            if given is not None:
                yield (
                    f"The diameter of the disks is taken as exact: if it is {100.0 * MISMEASURED:.0f} % larger, c of "
                    f"camera {camera} changes by {change:+.2g} mm."
                )
            elif squared - at.factor.solution[numbering.numbers[radius_squared]] < CLEAR * np.sqrt(square):
                yield (
                    "Nothing says whether the points are corners or the centres of dots: if they are dots of a "
                    f"diameter of {2.0 * np.sqrt(squared):.2g} (points' unit), whose perspective is not corrected, c "
                    f"of camera {camera} changes by {change:+.2g} mm. Give their diameter_mm under [targets], kind = "
                    '"disk".'
                )


def _lens_terms(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """The lowest radial terms that a camera lacks, its next decentering terms, a bow, and affinity of the pixels.

    Polynomials of the observed point in units of half the frame, so that their parameters are in mm at its edge.
    """
    free, own = free_terms(camera), partial(own_terms, camera)
    half_mm = _lens_half_mm(run.problem.network, camera)
    places = _from_principal_point(run, camera)

    def lacking(name: str, words: Words, terms: Sequence[Term]) -> ModelHypothesis:
        fields = PolynomialTerms.from_terms(terms).correction(places, np.zeros(2), np.zeros(len(terms)), half_mm)
        return _displaced_images(run, name, camera, words, fields.parameter_jacobian.swapaxes(1, 2))

    freed = {3 + 2 * k for k, name in enumerate(own("radial")) if name in free}
    degrees = [degree for degree in RADIAL_DEGREES if degree not in freed] or RADIAL_DEGREES[-TERMS_TOGETHER:]
    degrees = degrees[:TERMS_TOGETHER]
    pattern = f"a radial pattern, of the degrees {', '.join(map(str, degrees))} in r"
    words = partial(lens_words, camera, "radial", pattern)
    yield lacking("radial", words, [radial((degree - 1) // 2) for degree in degrees])
    if not free.intersection(own("decentering")[2:]):
        words = partial(lens_words, camera, "decentering", "a tangential pattern (decentering)")
        yield lacking("decentering", words, decentering(int(bool(free.intersection(own("decentering"))))))
    yield lacking("bow", partial(bow_words, camera.name), BOW)
    images = run.problem.network.images
    digital = all(image.transformation == "none" for image in images if image.camera == camera.name)
    for k, (name, described) in enumerate((("pixels", pixel_words), ("shear", shear_words)) if digital else ()):
        if not free.intersection(own("affinity")[k : k + 1]):
            yield lacking(name, partial(described, camera.name, 1.0 / half_mm), AFFINITY_TERMS[k : k + 1])


def _drift(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """A principal distance that changes with the number of the image, or with the distance of the object."""
    problem, state = run.problem, run.end.state
    rows = problem.targets_by_camera[camera.name]
    shown, of_row, counts = np.unique(problem.image_numbers[rows], return_inverse=True, return_counts=True)
    if len(shown) < FEWEST_DRIFTING:
        return
    outward = _from_principal_point(run, camera) / state.values[problem.unknowns.camera[camera.name][0]]
    points = state.values[problem.places[rows]]
    middle = np.stack([np.bincount(of_row, points[:, k]) for k in range(3)], axis=1) / counts[:, None]
    nearness = 1.0 / np.linalg.norm(middle - state.values[problem.exterior[shown, :3]], axis=1)
    for name, by in (("order", np.arange(len(shown), dtype=float)), ("nearness", nearness)):
        if np.ptp(by) > LEAST_CHANGE * by.max():
            share = np.zeros(len(outward))
            share[rows] = ((by - by.mean()) / np.ptp(by))[of_row]
            words = partial(drift_words, camera.name, name)
            yield _displaced_images(run, name, camera, words, (outward * share[:, None])[:, None], "drift")


def _from_principal_point(run: Run, camera: Camera) -> Array:
    """(n, 2) mm, adjusted image points of a camera relative to its principal point; 0 for other marks."""
    problem, xy_mm = run.problem, np.zeros_like(run.end.v_mm)
    rows = problem.targets_by_camera[camera.name]
    principal_point = run.end.state.values[problem.unknowns.camera[camera.name][1:3]]
    xy_mm[rows] = in_camera(problem, run.end.state, run.end.computed_mm)[rows] - principal_point
    return xy_mm


def _displaced_images(
    run: Run, name: str, camera: Camera, words: Words, fields_mm: Array, kind: str = ""
) -> ModelHypothesis:
    """Add displacements (n, k, 2) of the camera's images in mm as unknowns."""
    camera_xy = in_camera(run.problem, run.end.state, run.end.computed_mm)  # observed places have the residuals' errors
    directions = object_displacements(run.problem, run.end.state, camera_xy, fields_mm)
    return _displaced(run, f"{name} of {camera.name}", kind or name, words, directions)


def _scanner_pixels(run: Run) -> Iterator[ModelHypothesis]:
    """A scanner that stretches one axis, where film transformations do not absorb that."""
    network = run.problem.network
    films = [image for image in network.images if image.transformation != "none"]
    if not films or network.scanners or not all(is_left(image.transformation, "stretch") for image in films):
        return
    extents = [network.extent_by_image[image.name] for image in films]
    x, y = np.mean([extent.center_mm for extent in extents], axis=0).tolist()
    half_mm = max(extent.half_mm for extent in extents)
    scanner = Scanner("scanner", {"stretch": FREE}, (x, y), (half_mm, half_mm))
    images = tuple(replace(image, scanner=scanner.name) if image in films else image for image in network.images)
    problem = _continued(run, replace(network, images=images, scanners=(scanner,)))
    words = partial(pixel_words, films[0].camera, 2.0 / half_mm)
    yield ModelHypothesis("pixels", words, problem, problem.unknowns.scanner[scanner.name])


def _second_interior_orientation(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """A different principal distance and principal point for some of the camera's images."""
    network, groups = run.problem.network, two_groups(run, camera.name)
    if groups is None:
        return
    others = replace(camera, name=camera.name + OTHERS)
    images = tuple(replace(each, camera=others.name) if each.name in groups.images else each for each in network.images)
    apart = replace(network, images=images, cameras=(*network.cameras, others))
    problem = _continued(run, apart, {others.name: camera.name})
    added = problem.unknowns.camera[others.name][: len(INTERIOR_NAMES)]
    words, contrasts = partial(group_words, camera.name, groups), len(INTERIOR_NAMES) * (groups.count - 1)
    own = ModelHypothesis("groups", words, problem, added)
    yield replace(own, choices=groups.choices, contrasts=contrasts, p_scatter=groups.p_scatter)


def _deformations(run: Run) -> Iterator[ModelHypothesis]:
    """A strain of the object of all given points; a bend or a twist of a flat one, or another diameter of its disks."""
    network = run.problem.network
    if not _is_given(network):
        return
    xyz = np.array(list(network.known_places.values()))
    form = _flat_form(network)
    axes = np.eye(3) if form is None else form.axes
    fields: list[tuple[str, Words, Array]] = [
        ("strain", partial(strain_words, len(axes)), strain_directions(xyz, axes))
    ]
    if form is not None:
        is_bent = any(board.by_observation is None for board in network.boards)
        fields += [] if is_bent else [("bend", bend_words, form.bend_directions)]
        fields += [("twist", twist_words, form.twist_directions)]
    for name, words, directions in fields:
        by_point = dict(zip(network.known_places, directions, strict=True))
        yield _displaced(run, name, "board", words, _of_targets(run, by_point))
    yield from _disks(run)


def _is_given(network: Network) -> bool:
    """Whether all points of an object are given, and enough to test its shape."""
    return len(network.known_places) >= max(FEWEST_GIVEN, len(network.observed_points))


def _flat_form(network: Network) -> BoardForm | None:
    try:
        return board_form(np.array(list(network.known_places.values())))
    except ValueError:
        return None


def _of_targets(run: Run, by_point: Mapping[str, Array]) -> Array:
    """(n, k, 3) displacements of the points of all targets, of those (k, 3) by name; 0 for others."""
    observations, width = run.problem.network.observations, len(next(iter(by_point.values())))
    none = np.zeros((width, 3))
    return np.array([by_point.get(name, none) for name in observations.point])


def _possible_radius(run: Run) -> float:
    """Radius of disks: as given, or where it is not a quarter of the distance of neighbours."""
    network = run.problem.network
    if network.disk_radius is not None:
        return network.disk_radius
    xyz = np.array(list(network.known_places.values()))
    nearest, _ = KDTree(xyz).query(xyz, 2)
    return float(np.median(np.asarray(nearest)[:, 1])) / 4.0


def _disks(run: Run) -> Iterator[ModelHypothesis]:
    """Another squared radius of disks on a board than given, or one where nothing says that the points are disks."""
    problem, state, network = run.problem, run.end.state, run.problem.network
    form = _flat_form(network) if _is_given(network) and network.disk_radius != 0.0 else None
    if form is None:
        return
    radius, at = _possible_radius(run), dict[tuple[int, int], Array]()
    points = np.array([at for id_, at in problem.unknowns.point.items() if id_ in network.known_places])
    shown = network.observations.has_kind("target")
    for i, j in product((-1, 0, 1), repeat=2):
        values = state.values.copy()
        values[points] += radius * (np.array([i, j]) @ form.axes)
        if (computed := computed_observations(problem, State(values, state.rotations))) is None:
            return
        at[i, j] = computed[shown]
    directions = np.zeros((len(shown), 1, 3))
    directions[shown] = disk_directions(at, form.axes, radius)
    limits = (-np.inf, np.inf) if network.disk_radius is not None else (0.0, (2.0 * radius) ** 2)
    yield replace(_displaced(run, "disks", "disks", disk_words, directions), limits=limits)


def _displaced(run: Run, name: str, kind: str, words: Words, directions: Array) -> ModelHypothesis:
    """Add displacements (n, k, 3) of the targets' points as unknowns."""
    network = run.problem.network
    board = Board(name, {}, (FREE,) * directions.shape[1], directions)
    problem = _continued(run, replace(network, boards=(*network.boards, board)))
    return ModelHypothesis(kind, words, problem, problem.unknowns.board[name], name=name)


def _wrong_points(run: Run, most: int) -> Iterator[ModelHypothesis]:
    """Wrong coordinates of fixed points, each by itself, or of a line or a side of a regular field by one shift.

    Coordinates that are given with a standard deviation are observations, tested by data snooping.
    """
    network, unknowns = run.problem.network, run.problem.unknowns
    of_image = dict[str, set[str]]()
    for name, image in zip(network.observations.point, network.observations.image, strict=True):
        of_image.setdefault(name, set()).add(image)
    names = tuple(
        name
        for name, at in unknowns.point.items()
        if not unknowns.sigma[at].any() and len(of_image[name]) >= FEWEST_IMAGES and name in network.known_places
    )
    if len(names) < FEWEST_GIVEN:
        return
    form, positions = _flat_form(network), np.concatenate([unknowns.point[name] for name in names])
    axes = np.eye(3) if form is None else form.axes
    for group in displaced_points(run, axes, freed(run, positions), names, most):
        if group.words:
            moved = _of_targets(run, dict.fromkeys(group.names, np.eye(3)))
            found = _displaced(run, "group", "point", partial(moved_words, group), moved)
        else:
            added = np.concatenate([unknowns.point[name] for name in group.names])
            words = partial(point_words, group.names)
            found = ModelHypothesis("point", words, freed(run, added), added)
        yield replace(found, choices=group.choices, contrasts=group.contrasts)


def _wrong_interior_orientation(run: Run, camera: Camera) -> Iterator[ModelHypothesis]:
    """Wrong values of c, x0 and y0 that are given as exact."""
    positions = run.problem.unknowns.camera[camera.name][: len(INTERIOR_NAMES)]
    added = positions[run.problem.unknowns.sigma[positions] == 0.0]
    if len(added):
        yield ModelHypothesis("interior", partial(interior_words, camera.name), freed(run, added), added)


def freed(run: Run, positions: Indices) -> Problem:
    """Free some quantities of a problem; start where an adjustment ended."""
    problem = _continued(run, run.problem.network)
    sigma = problem.unknowns.sigma.copy()
    sigma[positions] = np.inf
    return replace(problem, unknowns=replace(problem.unknowns, sigma=sigma))


def _lens_half_mm(network: Network, camera: Camera) -> float:
    """Half the frame in mm; from the extent of the camera's marks where it is not given."""
    own = [image for image in network.images if image.camera == camera.name]
    return camera.distortion.half_mm[0] or max(network.extent_by_image[image.name].half_mm for image in own)


def separate_lenses(run: Run) -> Problem | None:
    """Give the two groups of images entirely separate lenses; None where cameras have fiducial marks."""
    network = run.problem.network
    if any(camera.fiducials for camera in network.cameras):
        return None
    problem = _continued(run, network)
    unknowns, old = problem.unknowns, run.problem.unknowns
    sigma, start = unknowns.sigma.copy(), unknowns.start.copy()
    for name, at in old.camera.items():
        sigma[unknowns.camera[name]], start[unknowns.camera[name]] = old.sigma[at], run.end.state.values[at]
    return replace(problem, unknowns=replace(unknowns, sigma=sigma, start=start))


def _continued(run: Run, network: Network, like: Mapping[str, str] | None = None) -> Problem:
    """Number a network with additional unknowns; start where an adjustment ended, in its datum."""
    # like: cameras that share distortion and fiducial marks with another one and start with its interior orientation.
    old, values, like, count = run.problem.unknowns, run.end.state.values, like or {}, len(INTERIOR_NAMES)
    interior = {name: values[at[:count]] for name, at in old.camera.items()}
    state = Approximations(
        interior=interior | {name: interior[other] for name, other in like.items()},
        exterior={image.name: values[old.exterior[image.name]] for image in network.images},
        transformation={image.name: values[old.transformation[image.name]] for image in network.images},
        points={id_: values[at] for id_, at in old.point.items()},
        mirrored=run.problem.mirrored,
        joins={key: values[at] for key, at in old.join.items()},
    )
    problem = number(network, state, run.problem.by_elements)
    unknowns = problem.unknowns
    position = {parameter: i for i, parameter in enumerate(old.parameters)}
    new = np.array([i for i, parameter in enumerate(unknowns.parameters) if parameter in position], dtype=np.intp)
    at = np.array([position[unknowns.parameters[i]] for i in new], dtype=np.intp)
    given, sigma, start = unknowns.given.copy(), unknowns.sigma.copy(), unknowns.start.copy()
    given[new], sigma[new], start[new] = old.given[at], old.sigma[at], values[at]
    camera, fiducial = dict(unknowns.camera), dict(unknowns.fiducial)
    for name, other in like.items():
        apart, own = camera[name][:count], camera[other]
        given[apart], sigma[apart], start[apart] = np.nan, np.inf, start[own[:count]]
        sigma[camera[name][count:]] = 0.0
        camera[name] = np.concatenate([apart, own[count:]])
        for (owner, id_), pair in unknowns.fiducial.items():
            if owner == name:
                sigma[pair] = 0.0
                fiducial[name, id_] = fiducial[other, id_]
    shared = replace(unknowns, given=given, sigma=sigma, start=start, camera=camera, fiducial=fiducial)
    return replace(problem, unknowns=shared)
