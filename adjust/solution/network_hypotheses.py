"""Hypotheses on blunders of a whole network, each as the network without the blunder.

Mirrored points or exchanged axes, another unit, y pointing down, exchanged frames, mirrored images, a wrong principal
distance.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Network, ObjectPoint
from adjust.problem.parameter import Parameter
from adjust.solution.left_out_images import leave_out
from adjust.solution.result import Adjustment

TOLERATED = 2.0  # factor on the given standard deviations up to which residuals need no explanation
CHECKED = 10  # smallest redundancy for an explanation
FEWEST_IMAGES = 3  # images needed to identify a mirrored one
MOST_MIRRORED = 6  # images left out in turn, largest residuals first
MOST_PAIRS = 15  # pairs of frames tried as exchanged, largest residuals first
UNITS = (1000.0, 100.0, 10.0, 0.3048)  # ratios of length units: m, dm, cm, mm, feet
FACTORS = (*UNITS, *(1.0 / each for each in UNITS))

AXES = {  # blunders that mirror the points, and the matrices that correct them
    **{f"the sign of {'XYZ'[i]} of all points is wrong": np.diag(1.0 - 2.0 * np.eye(3)[i]) for i in range(3)},
    **{
        f"{axes} of all points are exchanged": np.eye(3)[order]
        for axes, order in (("X and Y", [1, 0, 2]), ("X and Z", [2, 1, 0]), ("Y and Z", [0, 2, 1]))
    },
}


@dataclass(frozen=True)
class Trials:
    """Adjusts trial networks (None where one cannot start) and tests the results.

    family: significance level.
    """

    adjust: Callable[[Network], Adjustment | None]
    family: float

    def explains(self, result: Adjustment | None) -> bool:
        """Whether v'Pv is not significant for standard deviations TOLERATED times as large, with enough redundancy."""
        if result is None or result.termination == "singular" or result.redundancy < CHECKED:
            return False
        return bool(chdtrc(result.redundancy, result.vpv / TOLERATED**2) > self.family)


@dataclass(frozen=True)
class NetworkHypothesis:
    """Blunder in words, remedy, and the network without the blunder.

    moved (3, 3): transformation from the given points to the corrected ones. distance: camera with a wrong principal
    distance, and the given value in mm.
    """

    words: str
    remedy: str
    network: Network
    moved: Array = field(default_factory=lambda: np.eye(3))
    distance: tuple[str, float] = ("", 0.0)


def network_hypotheses(
    network: Network, bare: Network, given: Adjustment | None, trials: Trials
) -> Iterator[list[NetworkHypothesis]]:
    """Generate blunder hypotheses; those with identical residuals form one list.

    Parameters
    ----------
    network, bare : network with and without the given orientations
    given : adjustment of the network as given, None where it cannot start
    trials : adjusts trial networks
    """
    mirrored = (NetworkHypothesis(words, "Correct it.", _move_points(bare, by), by) for words, by in AXES.items())
    yield [*mirrored, *_y_down(bare, given)]
    if network.distances:
        for factor in FACTORS:
            by = factor * np.eye(3)
            remedy = "Give both in the unit that [object] unit names."
            yield [NetworkHypothesis(unit_words(factor), remedy, _move_points(network, by), by)]
    yield from ([each] for each in _exchanged_frames(network, given))
    yield from ([each] for each in _mirrored_images(network, given, trials))
    yield from ([each] for each in _distances(network))


def unit_words(factor: float) -> str:
    """Describe points in another unit; factor: multiplies them to correct it."""
    how = "large" if factor < 1.0 else "small"
    times = max(factor, 1.0 / factor)
    return f"the coordinates of the points are {times:.4g} times too {how} for the stations or distances: another unit"


def _move_points(network: Network, by: Array) -> Network:
    """Transform all points by a matrix with one entry per row."""
    axes = np.abs(by).argmax(axis=1)
    factors = [float(row[axis]) for row, axis in zip(by, axes, strict=True)]

    def move(point: ObjectPoint) -> ObjectPoint:
        given = [(point.X, point.Y, point.Z)[axis] for axis in axes]
        priors = zip(given, factors, strict=True)
        return ObjectPoint(point.id, *(prior and Prior(f * prior.value, abs(f) * prior.sigma) for prior, f in priors))

    return replace(network, points=tuple(move(point) for point in network.points))


def _y_down(network: Network, given: Adjustment | None) -> Iterator[NetworkHypothesis]:
    """Hypothesis: y points down, in the camera frame if all films are mirrored, or in comparators of digital images."""
    films = [image for image in network.images if image.transformation != "none"]
    if films and given is not None and any(image.name not in given.mirrored for image in films):
        return
    turned = np.array([image.transformation == "none" for image in network.images])[network.image_numbers]
    xy_mm = network.observations.xy_mm * np.where(turned[:, None], [1.0, -1.0], 1.0)
    where = "the y' axis of the camera's fiducial marks" if films else "the y axis of the comparator coordinates"
    cameras = tuple(_turn_camera(camera) for camera in network.cameras)
    other = replace(network, cameras=cameras, observations=replace(network.observations, xy_mm=xy_mm))
    yield NetworkHypothesis(f"{where} points down, and it has to point up", "Correct it.", other)


def _turn_camera(camera: Camera) -> Camera:
    """Reverse y' of a camera."""
    marks = {id_: Fiducial(mark.x_mm, _opposite(mark.y_mm)) for id_, mark in camera.fiducials.items()}
    y0_mm = camera.y0_mm and _opposite(camera.y0_mm)
    return replace(camera, y0_mm=y0_mm, fiducials=marks, center_mm=(camera.center_mm[0], -camera.center_mm[1]))


def _opposite(prior: Prior) -> Prior:
    return Prior(-prior.value, prior.sigma)


def y_downward(network: Network) -> Network | None:
    """Reverse y of the comparator coordinates of a network without films; None where there are films."""
    if any(image.transformation != "none" for image in network.images):
        return None
    cameras = tuple(each if each.y0_mm else _turn_camera(each) for each in network.cameras)
    xy_mm = network.observations.xy_mm * [1.0, -1.0]
    return replace(network, cameras=cameras, observations=replace(network.observations, xy_mm=xy_mm))


def _mirrored_images(network: Network, given: Adjustment | None, trials: Trials) -> Iterator[NetworkHypothesis]:
    """Hypothesis: one image of a digital camera is mirrored, if all others agree without it; worst images first."""
    worst = list(_worst_images(network, given, films=False))
    for name in worst[:MOST_MIRRORED] if len(worst) >= FEWEST_IMAGES else ():
        others = leave_out(network, [network.image_by_name[name].frame])
        rest = None if others is None else trials.adjust(others)
        if rest is not None and trials.explains(rest):
            remedy = "Mirror its picture and measure it again, or its coordinates in comparator.csv."
            yield NetworkHypothesis(f"image {name} is mirrored", remedy, _mirrored_image(network, name, rest))
            return


def _mirrored_image(network: Network, name: str, rest: Adjustment) -> Network:
    """Mirror one image of a network.

    Where the image centre is unknown, the image gets its own principal point, with the lens of the other images.
    """
    turned = mirrored_images(network, [name])
    camera = network.camera_by_name[network.image_by_name[name].camera]
    if camera.frame_mm[0]:
        return turned
    known = {
        each: Prior(rest.value(Parameter.interior(camera.name, each))) for each in ("c", *camera.distortion.parameters)
    }
    own = replace(
        camera,
        name=f"{camera.name} ({name})",
        principal_distance_mm=known.pop("c"),
        x0_mm=None,
        y0_mm=None,
        distortion=replace(camera.distortion, parameters=known),
    )
    images = tuple(replace(image, camera=own.name) if image.name == name else image for image in turned.images)
    return replace(turned, images=images, cameras=(*turned.cameras, own))


def mirrored_images(network: Network, names: Sequence[str]) -> Network:
    """Mirror the comparator coordinates of some images left to right.

    The axis is the centre of the image where its size is known, else that of all marks of the camera.
    """
    middle = {camera.name: _middle_mm(network, camera) for camera in network.cameras}
    turned = np.array([image.name in names and image.transformation == "none" for image in network.images])
    centers = np.array([middle[image.camera] for image in network.images])[network.image_numbers]
    xy_mm = network.observations.xy_mm.copy()
    is_turned = turned[network.image_numbers]
    xy_mm[is_turned, 0] = 2.0 * centers[is_turned] - xy_mm[is_turned, 0]
    return replace(network, observations=replace(network.observations, xy_mm=xy_mm))


def _middle_mm(network: Network, camera: Camera) -> float:
    """Centre of the camera's images in x, mm."""
    own = np.array([image.camera == camera.name for image in network.images])[network.image_numbers]
    x_mm = network.observations.xy_mm[own, 0]
    if not len(x_mm):
        return 0.0
    middle = float(x_mm.min() + x_mm.max()) / 2.0
    if not camera.frame_mm[0]:
        return middle if camera.x0_mm is None else camera.x0_mm.value
    half = camera.frame_mm[0] / 2.0
    return half if abs(middle - half) < abs(middle) else 0.0


def _distances(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the principal distance of a camera without an earlier calibration is wrong."""
    calibrated = {parameter for each in network.calibrations for parameter in each.parameters}
    for camera in network.cameras:
        given = camera.principal_distance_mm
        if given is not None and np.isfinite(given.sigma) and Parameter.interior(camera.name, "c") not in calibrated:
            free = replace(camera, principal_distance_mm=None)
            yield NetworkHypothesis(
                f"the principal distance of camera {camera.name} is not the {given.value:g} mm that are given",
                "Correct it, or give it with the standard deviation that it has.",
                replace(network, cameras=tuple(free if each is camera else each for each in network.cameras)),
                distance=(camera.name, given.value),
            )


def _exchanged_frames(network: Network, given: Adjustment | None) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the targets of two frames of a camera are exchanged; largest residuals first."""
    observations, worst = network.observations, _worst_images(network, given, films=True)
    camera = {image.name: image.camera for image in network.images}
    pairs = [pair for pair in combinations(worst, 2) if camera[pair[0]] == camera[pair[1]]]
    for first, second in sorted(pairs, key=lambda pair: -worst[pair[0]] - worst[pair[1]])[:MOST_PAIRS]:
        other = {first: second, second: first}
        rows = zip(observations.image, observations.is_fiducial, strict=True)
        image = tuple(name if is_fiducial else other.get(name, name) for name, is_fiducial in rows)
        yield NetworkHypothesis(
            f"the targets of the frames {min(first, second)} and {max(first, second)} are exchanged",
            "Exchange them, or the frames' fiducial marks.",
            replace(network, observations=replace(observations, image=image)),
        )


def _worst_images(network: Network, given: Adjustment | None, films: bool) -> dict[str, float]:
    """Sums of squared residuals by image, largest first, of films or of digital images with object points.

    The sums are 0 without an adjustment.
    """
    v_mm = np.zeros((len(network.image_numbers), 2)) if given is None else given.residuals.v_mm
    sums = np.bincount(network.image_numbers, (v_mm**2).sum(axis=1), len(network.images))
    images = [
        (-float(size), image.name)
        for image, size in zip(network.images, sums, strict=True)
        if (image.transformation != "none") == films and image.name not in network.objectless_images
    ]
    return {name: -size for size, name in sorted(images)}
