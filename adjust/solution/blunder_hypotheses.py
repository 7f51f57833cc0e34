"""Test whether a blunder of the whole network explains its contradictions.

Mirrored points or exchanged axes, another unit, y pointing down, exchanged frames, mirrored images, a wrong principal
distance.

Such a blunder leaves residuals everywhere, and tests of single observations would reject good ones.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, combinations, product

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array, Mask
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.estimates import adjusted_image, adjusted_places
from adjust.problem.network import Network, ObjectPoint
from adjust.problem.parameter import Parameter, shortened
from adjust.solution.left_out_images import FEWEST, LARGE, linear_transformations
from adjust.solution.result import Adjustment

TOLERATED = 2.0  # factor on the given standard deviations up to which residuals need no explanation
CHECKED = 10  # smallest redundancy for an explanation
NAMED = 5  # images named in a message
MOST_PAIRS = 15  # pairs of frames tried as exchanged, largest residuals first
ONE_AXIS = 10.0  # sigma0 that one axis in another unit leaves at least
UNITS = (1000.0, 100.0, 10.0, 0.3048, 25.4)  # ratios of length units: m, dm, cm, mm, feet, inches
FACTORS = (*UNITS, *(1.0 / each for each in UNITS))

AXES = {  # blunders that mirror the points, and the matrices that correct them
    **{f"the sign of {'XYZ'[i]} of all points is wrong": np.diag(1.0 - 2.0 * np.eye(3)[i]) for i in range(3)},
    **{
        f"{axes} of all points are exchanged": np.eye(3)[order]
        for axes, order in (("X and Y", [1, 0, 2]), ("X and Z", [2, 1, 0]), ("Y and Z", [0, 2, 1]))
    },
}
CLEARLY = 3.0  # factor by which an explanation must reduce sigma0
NEAR = 0.3  # fraction of its distance from the field's centre that a station may lie off its given place
PITCHES = (10.0, 25.4, 100.0, 1000.0, 2.0)  # ratios of principal distances by another unit or pixel pitch
ROUND = 0.05  # relative tolerance of these ratios
FLAT = 1e-3  # relative thickness of a flat field, which is mirrored by mirroring the stations


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

    moved (3, 3): transformation from the given points to the corrected ones. figures: of the adjustment without it.
    """

    words: str
    network: Network
    remedy: str = "Correct it."
    moved: Array = field(default_factory=lambda: np.eye(3))
    figures: Callable[[Adjustment], str] = lambda _: ""


def network_hypotheses(network: Network, bare: Network, given: Adjustment | None) -> Iterator[list[NetworkHypothesis]]:
    """Generate blunder hypotheses; those with identical residuals form one list.

    network, bare: with and without the given orientations; given: its adjustment, None where that cannot start.
    """
    mirrored = [NetworkHypothesis(words, _move_points(bare, by), moved=by) for words, by in AXES.items()]
    films = [image for image in network.images if image.transformation != "none"]
    if not films or given is None or all(image.name in given.mirrored for image in films):
        where = "the y' axis of the camera's fiducial marks" if films else "the y axis of the comparator coordinates"
        mirrored.append(NetworkHypothesis(f"{where} points down, and it has to point up", reversed_y(bare)))
    yield mirrored
    for factor in FACTORS if network.distances else ():
        by = factor * np.eye(3)
        remedy = "Give both in the unit that [object] unit names."
        yield [NetworkHypothesis(unit_words(factor), _move_points(network, by), remedy, by)]
    is_far = given is None or not given.converged or given.sigma0 > ONE_AXIS
    exchanged, mirrored_images = _exchanged_frames(network, given), _mirrored_images(network)
    heights = _one_axis(network, (2,)) if is_far else ()  # before distances, of which one may do the same
    plane = _one_axis(network, (0, 1)) if is_far and _may_be_stretched(network, given) else ()
    yield from ([each] for each in chain(exchanged, heights, mirrored_images, _distances(network), plane))


def _may_be_stretched(network: Network, given: Adjustment | None) -> bool:
    """Whether linear transformations of the given points fit all images, as with any units of the axes, and the
    adjustment as given misses the marks by as much as a wrong one makes it."""
    places, observations, fits = network.known_places, network.observations, list[bool]()
    if given is not None and given.converged:
        miss_mm = np.sqrt(np.mean(given.residuals.v_mm**2))
        fits.append(bool(miss_mm > LARGE * np.ptp(observations.xy_mm)))
    for number in range(len(network.images)):
        own = np.flatnonzero((network.image_numbers == number) & ~observations.is_fiducial)
        rows = [row for row in own if observations.point[row] in places]
        if len(rows) >= FEWEST:
            xyz = np.array([[places[observations.point[row]] for row in rows]])
            (misfit,) = linear_transformations(xyz, observations.xy_mm[rows][None])[1]
            fits.append(bool(misfit < LARGE))
    return all(fits)


def _one_axis(network: Network, axes: Sequence[int]) -> Iterator[NetworkHypothesis]:
    """Hypothesis: one of some axes is in another unit than the others."""
    extents = np.ptp(list(network.known_places.values()) or np.zeros((1, 3)), axis=0)
    for axis, factor in product((axis for axis in axes if extents[axis]), FACTORS):
        name, others = "XYZ"[axis], " and ".join("XYZ".replace("XYZ"[axis], ""))
        times, how = max(factor, 1.0 / factor), "large" if factor < 1.0 else "small"
        by = np.diag(np.where(np.arange(3) == axis, factor, 1.0))
        words = f"{name} of all points is {times:.4g} times too {how} for {others}: another unit"
        yield NetworkHypothesis(words, _move_points(network, by), moved=by)


def unit_words(factor: float) -> str:
    """Describe points in another unit; factor: multiplies them to correct it."""
    how = "large" if factor < 1.0 else "small"
    times = max(factor, 1.0 / factor)
    return f"the coordinates of the points are {times:.4g} times too {how} for the stations or distances: another unit"


def _scaled(prior: Prior | None, factor: float) -> Prior | None:
    return prior and Prior(factor * prior.value, abs(factor) * prior.sigma)


def _move_points(network: Network, by: Array) -> Network:
    """Transform all points by a matrix with one entry per row."""
    axes = np.abs(by).argmax(axis=1).tolist()
    factors = by[range(3), axes].tolist()
    points = []
    for point in network.points:
        given = point.priors
        moved = (_scaled(given[axis], factor) for axis, factor in zip(axes, factors, strict=True))
        points.append(ObjectPoint(point.id, *moved))
    return replace(network, points=tuple(points))


def reversed_y(network: Network, keeps_given: bool = False) -> Network:
    """Reverse y of the comparator coordinates of digital images, and y' of the cameras.

    keeps_given: whether given principal points stay.
    """
    digital = np.array([image.transformation == "none" for image in network.images])[network.image_numbers]
    xy_mm = network.observations.xy_mm * np.where(digital[:, None], [1.0, -1.0], 1.0)
    cameras = []
    for camera in network.cameras:
        marks = {
            id_: replace(mark, y_mm=Prior(-mark.y_mm.value, mark.y_mm.sigma)) for id_, mark in camera.fiducials.items()
        }
        center_mm, y0_mm = (camera.center_mm[0], -camera.center_mm[1]), _scaled(camera.y0_mm, -1.0)
        turned = replace(camera, y0_mm=y0_mm, fiducials=marks, center_mm=center_mm)
        cameras.append(camera if keeps_given and camera.y0_mm else turned)
    return replace(network, cameras=tuple(cameras), observations=replace(network.observations, xy_mm=xy_mm))


def _mirrored_images(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: those digital images are mirrored that a linear transformation of the given points shows so."""
    rows = ~network.observations.is_fiducial
    names = []
    for number, image in enumerate(network.images):
        own = np.flatnonzero(rows & (network.image_numbers == number))
        known = [row for row in own if network.observations.point[row] in network.known_places]
        places = np.array([network.known_places[network.observations.point[row]] for row in known]).reshape(-1, 3)
        if image.transformation == "none" and len(known) >= FEWEST:
            (handedness,), _ = linear_transformations(places[None], network.observations.xy_mm[known][None])
            names += [image.name] if handedness > 0.0 else []
    if 0 < len(names) < len(network.images):
        who = f"image {names[0]} is" if len(names) == 1 else f"the images {shortened(names, NAMED)} are"
        remedy = "Mirror these pictures and measure them again, or their coordinates in comparator.csv."
        turned = mirrored_images(network, names)
        # Where the image centre is unknown, mirrored images get a principal point of their own.
        other = {
            each.name: each if each.frame_mm[0] else replace(each, name=f"{each.name}~") for each in turned.cameras
        }
        images = tuple(
            replace(image, camera=other[image.camera].name) if image.name in names else image for image in turned.images
        )
        cameras = (*turned.cameras, *(each for name, each in other.items() if each.name != name))
        yield NetworkHypothesis(f"{who} mirrored", replace(turned, images=images, cameras=cameras), remedy)


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
    own = [image.camera == camera.name for image in network.images]
    x_mm = network.observations.xy_mm[np.array(own)[network.image_numbers], 0]
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
                replace(network, cameras=tuple(free if each is camera else each for each in network.cameras)),
                "Correct it, or give it with the standard deviation that it has.",
                figures=partial(_found_distance, camera.name, given.value),
            )


def _exchanged_frames(network: Network, given: Adjustment | None) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the targets of two frames of a camera are exchanged; largest residuals first."""
    observations = network.observations
    squares = np.zeros(len(observations)) if given is None else (given.residuals.v_mm**2).sum(axis=1)
    sums = np.bincount(network.image_numbers, squares, len(network.images)).tolist()
    films = {
        image.name: (size, image.camera)
        for image, size in zip(network.images, sums, strict=True)
        if image.transformation != "none" and image.name not in network.objectless_images
    }
    worst = sorted(films, key=lambda name: (-films[name][0], name))
    pairs = [pair for pair in combinations(worst, 2) if films[pair[0]][1] == films[pair[1]][1]]
    for first, second in sorted(pairs, key=lambda pair: -films[pair[0]][0] - films[pair[1]][0])[:MOST_PAIRS]:
        other = {first: second, second: first}
        rows = zip(observations.image, observations.is_fiducial, strict=True)
        image = tuple(name if is_fiducial else other.get(name, name) for name, is_fiducial in rows)
        yield NetworkHypothesis(
            f"the targets of the frames {min(first, second)} and {max(first, second)} are exchanged",
            replace(network, observations=replace(observations, image=image)),
            "Exchange them, or the frames' fiducial marks.",
        )


MIRRORED = "the points are mirrored: the sign of X, Y or Z of all of them is wrong, or two axes are exchanged"


def blunder_sentence(network: Network, given: Adjustment | None, trials: Trials) -> str:
    """Describe the blunder of a whole network without which all observations agree; empty where there is none.

    given: adjustment of the network as given, None where it cannot start. A hypothesis explains the contradictions
    where v'Pv without the blunder is not significant (`Trials.explains`) and sigma0 is CLEARLY smaller. Hypotheses with
    identical residuals are tried once, without the given orientations, which then distinguish them.
    """
    if given is None:  # perhaps only the given approximations are wrong
        given = trials.adjust(network)
    if trials.explains(given):
        return ""
    bare = replace(network, images=tuple(replace(image, exterior=None) for image in network.images))
    if _given_stations(network):
        alone = trials.adjust(bare)
        if alone is not None and trials.explains(alone):
            return stations_elsewhere(network, alone)
    for alike in network_hypotheses(network, bare, given):
        found = trials.adjust(alike[0].network)
        better = found is not None and (given is None or CLEARLY * found.sigma0 < given.sigma0 or not given.converged)
        if found is not None and better and trials.explains(found):
            return _sentence(_as_stations_are_given(network, alike, found), found, given, trials.family)
    return ""


def _sentence(slips: Sequence[NetworkHypothesis], found: Adjustment, given: Adjustment | None, family: float) -> str:
    words = [each.words for each in slips]
    if len(words) >= len(AXES):  # the mirrored axis cannot be identified
        words = [MIRRORED, *words[len(AXES) :]]
    what = "; or ".join(words) + slips[0].figures(found)
    if given is None:
        stands = "nothing can be adjusted"
    elif not given.converged:
        stands = "the iteration does not come to rest"
    else:
        stands = f"σ₀ is {given.sigma0:.3g} (p < {family:g})"
    return (
        f"{what[0].upper()}{what[1:]}. Without this all {len(found.network.observations)} observations agree "
        f"(σ₀ = {found.sigma0:.2f}); as it stands, {stands}. {slips[0].remedy}"
    )


def _found_distance(camera: str, given_mm: float, found: Adjustment) -> str:
    """Describe the estimated principal distance, and whether it is the given one in another unit or pixel pitch."""
    c = found.value(Parameter.interior(camera, "c"))
    times = max(c / given_mm, given_mm / c)
    how = "long" if c < given_mm else "short"
    is_unit = any(abs(times / each - 1.0) < ROUND for each in PITCHES)
    why = f", so that it is given {times:.3g} times too {how}: another unit, or a wrong pitch_um" if is_unit else ""
    return f": it is found as {c:.6g} mm{why}"


def _as_stations_are_given(
    network: Network, alike: Sequence[NetworkHypothesis], found: Adjustment
) -> Sequence[NetworkHypothesis]:
    """Keep the hypotheses with identical residuals whose stations lie near the given ones; all if none does."""
    given = _given_stations(network)
    if len(alike) == 1 or not given:
        return alike
    stations, depths, places = _stations(found, given)
    unmoved = stations @ np.linalg.inv(alike[0].moved).T
    return [each for each in alike if _near(unmoved @ each.moved.T, places, depths).all()] or alike


def _given_stations(network: Network) -> dict[str, Array]:
    images = (image for image in network.images if image.name not in network.unoriented)
    return {image.name: image.exterior.center for image in images if image.exterior is not None}


def _stations(result: Adjustment, given: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """Adjusted stations (n, 3), their distances (n,) from the centre of the points, and the given stations (n, 3)."""
    stations = np.array([adjusted_image(result, name).station for name in given])
    depths = np.linalg.norm(stations - _points(result).mean(axis=0), axis=1)
    return stations, depths, np.array([*given.values()])


def _points(result: Adjustment) -> Array:
    shown = result.network.observed_points
    return adjusted_places(result, [each.id for each in result.network.points if each.id in shown])


def _near(stations: Array, given: Array, depths: Array) -> Mask:
    return np.asarray(np.linalg.norm(stations - given, axis=1) < NEAR * depths)


def stations_elsewhere(network: Network, result: Adjustment) -> str:
    """Explain stations that lie far from where they are given; empty where nothing does.

    Possible causes: another unit, exchanged frames, or mirrored points of a flat field.
    """
    given = _given_stations(network)
    if result.termination == "singular" or len(given) < 2 or not network.observed_points:
        return ""
    names, (stations, depths, places) = list(given), _stations(result, given)
    off = np.flatnonzero(~_near(stations, places, depths))
    if len(off) == 2 and _near(stations[off], places[off[::-1]], depths[off]).all():
        one, other = (names[i] for i in off)
        return (
            f"The frames {one} and {other} lie each where the other's orientation is given: their names "
            f"are exchanged, in the scans or in images.csv."
        )
    if 2 * len(off) <= len(names):
        return ""
    moved = [(unit_words(factor), factor * stations, factor) for factor in FACTORS]
    points = _points(result)
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extents[-1] <= FLAT * extents[0]:
        reflected = stations - 2.0 * np.outer((stations - middle) @ axes[-1], axes[-1])
        moved += [(words, reflected @ by.T, 1.0) for words, by in AXES.items()]
    for words, candidate, scale in moved:
        if _near(candidate, places, scale * depths).all():
            return (
                f"By the points the stations lie nowhere near where they are given, but all {len(names)} would with "
                f"another reading of the points: {words}. Correct the points, or the stations."
            )
    return ""
