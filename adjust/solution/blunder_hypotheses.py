"""Slips that spoil a whole network, each tried as a hypothesis: mirrored points or exchanged axes, another unit, y that
points down, another principal distance, exchanged frames.

What is wrong with everything leaves residuals everywhere, and the tests of single observations blame innocent ones.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array, Mask
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import EXTERIOR_NAMES, Exterior, Network, ObjectPoint
from adjust.problem.parameter import Parameter
from adjust.solution.left_out_images import leave_out
from adjust.solution.result import Adjustment

TOLERATED = 2.0  # times the standard deviations that were given, and residuals still need no other explanation
CLEARLY = 3.0  # times smaller than as it is given a network's sigma0 is with what explains it
CHECKED = 10  # redundancy from which on an explanation is one
FEWEST_IMAGES = 3  # of which one that is mirrored is told from the others
MOST_MIRRORED = 6  # images that are left out in turn, the worst first
MOST_PAIRS = 15  # of frames that are tried exchanged, the worst first
UNITS = (1000.0, 100.0, 10.0, 0.3048)  # of one length in another: m, dm, cm, mm, feet
NEAR = 0.3  # of its distance from the field's middle that a station may lie off where it is given
PITCHES = (10.0, 25.4, 100.0, 1000.0, 2.0)  # of one principal distance in another unit, or with another pixel pitch
ROUND = 0.05  # that a found ratio may be off one of these
FLAT = 1e-3  # thickness of a field, in its extents, whose mirror image is that of the stations

AXES = {  # the slips that mirror the points, and what takes them back
    **{f"the sign of {'XYZ'[i]} of all points is wrong": np.diag(1.0 - 2.0 * np.eye(3)[i]) for i in range(3)},
    **{
        f"{axes} of all points are exchanged": np.eye(3)[order]
        for axes, order in (("X and Y", [1, 0, 2]), ("X and Z", [2, 1, 0]), ("Y and Z", [0, 2, 1]))
    },
}
MIRRORED = "the points are mirrored: the sign of X, Y or Z of all of them is wrong, or two axes are exchanged"

Tried = Callable[[Network], Adjustment | None]


@dataclass(frozen=True)
class Hypothesis:
    """A slip in words, what to do about it, and the network without it.

    moved (3, 3): what takes the points as they are given to where they are without it. distance: the camera
    whose principal distance is not what is given, and that in mm.
    """

    words: str
    remedy: str
    network: Network
    moved: Array = field(default_factory=lambda: np.eye(3))
    distance: tuple[str, float] = ("", 0.0)


def blunder_sentence(network: Network, given: Adjustment | None, tried: Tried, family: float) -> str:
    """The slip of a whole network without which all observations agree, and with which they do not; empty where there
    is none.

    given: the network adjusted as it is, None where that cannot begin. tried: adjusts another. An adjustment explains
    all where v'Pv is within chance, at the probability `family`, for standard deviations TOLERATED times as large; its
    sigma0 must be CLEARLY smaller, too. Hypotheses that leave the same residuals are tried once, without what is given
    of orientations, by which they are then told apart.
    """
    if given is None:  # the approximations that were given may be all that is wrong
        given = tried(network)
    if given is not None and explains(given, family):
        return ""
    bare = replace(network, images=tuple(replace(image, exterior=None) for image in network.images))
    if _given_stations(network):
        alone = tried(bare)
        if alone is not None and explains(alone, family):
            return stations_elsewhere(network, alone)
    for alike in _hypotheses(network, bare, given, tried, family):
        found = tried(alike[0].network)
        better = found is not None and (given is None or CLEARLY * found.sigma0 < given.sigma0 or not given.converged)
        if found is not None and better and explains(found, family):
            return _sentence(_as_stations_are_given(network, alike, found), found, given, family)
    return ""


def explains(result: Adjustment, family: float) -> bool:
    """Whether v'Pv is within chance for standard deviations TOLERATED times as large, and checked at all."""
    checked = result.termination != "singular" and result.redundancy >= CHECKED
    return checked and bool(chdtrc(result.redundancy, result.vpv / TOLERATED**2) > family)


def _sentence(slips: Sequence[Hypothesis], found: Adjustment, given: Adjustment | None, family: float) -> str:
    words = [each.words for each in slips]
    if len(words) >= len(AXES):  # nothing tells which of the mirrors it is
        words = [MIRRORED, *words[len(AXES) :]]
    what = "; or ".join(words)
    if given is None:
        stands = "nothing can be adjusted"
    elif not given.converged:
        stands = "the iteration does not come to rest"
    else:
        stands = f"σ₀ is {given.sigma0:.3g}, which chance makes it with a probability below {100.0 * family:g} %"
    camera, given_mm = slips[0].distance
    if camera:
        what += _found_distance(camera, given_mm, found)
    return (
        f"{what[0].upper()}{what[1:]}. Without this all {len(found.network.observations)} observations agree "
        f"(σ₀ = {found.sigma0:.2f}); as it stands, {stands}. {slips[0].remedy}"
    )


def _found_distance(camera: str, given_mm: float, found: Adjustment) -> str:
    """What a principal distance is found to be, and whether it is the given one in another unit or pixel pitch."""
    c = found.value(Parameter.interior(camera, "c"))
    times = max(c / given_mm, given_mm / c)
    how = "long" if c < given_mm else "short"
    is_unit = any(abs(times / each - 1.0) < ROUND for each in PITCHES)
    why = f", so that it is given {times:.3g} times too {how}: another unit, or a wrong pitch_um" if is_unit else ""
    return f": it is found as {c:.6g} mm{why}"


def _hypotheses(
    network: Network, bare: Network, given: Adjustment | None, tried: Tried, family: float
) -> Iterator[list[Hypothesis]]:
    """Those that leave the same residuals together. bare: the network without orientations."""
    yield [*_mirrored(bare), *_y_down(bare, given)]
    if network.distances:
        yield from ([each] for each in _other_unit(network))
    yield from ([each] for each in _exchanged_frames(network, given))
    yield from ([each] for each in _mirrored_images(network, given, tried, family))
    yield from ([each] for each in _other_principal_distance(network))


def _mirrored(network: Network) -> Iterator[Hypothesis]:
    for words, moved in AXES.items():
        yield Hypothesis(words, "Correct it.", _move_points(network, moved), moved)


def _other_unit(network: Network) -> Iterator[Hypothesis]:
    for factor in (*UNITS, *(1.0 / each for each in UNITS)):
        moved = factor * np.eye(3)
        yield Hypothesis(_unit_words(factor), _UNIT_REMEDY, _move_points(network, moved), moved)


_UNIT_REMEDY = "Give both in the unit that [object] unit names."


def _unit_words(factor: float) -> str:
    larger, times = factor < 1.0, max(factor, 1.0 / factor)
    how = "large" if larger else "small"
    return f"the coordinates of the points are {times:.4g} times too {how} beside stations or distances: another unit"


def _move_points(network: Network, moved: Array) -> Network:
    """With all points moved by a matrix that has one entry a row."""
    return replace(network, points=tuple(_move_point(point, moved) for point in network.points))


def _move_point(point: ObjectPoint, moved: Array) -> ObjectPoint:
    given = (point.X, point.Y, point.Z)
    priors: list[Prior | None] = []
    for row in moved:
        axis = int(np.argmax(np.abs(row)))
        prior, factor = given[axis], float(row[axis])
        priors.append(prior and Prior(factor * prior.value, abs(factor) * prior.sigma))
    return ObjectPoint(point.id, *priors)


def _y_down(network: Network, given: Adjustment | None) -> Iterator[Hypothesis]:
    """y' of the cameras, where films that are all mirrored speak for it, and y of comparators without fiducials."""
    films = [image for image in network.images if image.transformation != "none"]
    if films and given is not None and any(image.name not in given.mirrored for image in films):
        return
    turned = np.array([image.transformation == "none" for image in network.images])[network.image_numbers]
    xy_mm = network.observations.xy_mm * np.where(turned[:, None], [1.0, -1.0], 1.0)
    where = "the y' axis of the camera's fiducial marks" if films else "the y axis of the comparator coordinates"
    cameras = tuple(_turn_camera(camera) for camera in network.cameras)
    observations = replace(network.observations, xy_mm=xy_mm)
    yield Hypothesis(
        f"{where} points down, and it has to point up",
        "Correct it.",
        replace(network, cameras=cameras, observations=observations),
    )


def y_downward(network: Network) -> Network | None:
    """A network of images without fiducials with y of its comparator coordinates pointing the other way; None where
    there are films."""
    if any(image.transformation != "none" for image in network.images):
        return None
    cameras = tuple(
        replace(each, center_mm=(each.center_mm[0], -each.center_mm[1])) if each.y0_mm is None else each
        for each in network.cameras
    )
    xy_mm = network.observations.xy_mm * [1.0, -1.0]
    return replace(network, cameras=cameras, observations=replace(network.observations, xy_mm=xy_mm))


def mirrored_images(network: Network, names: Sequence[str]) -> Network:
    """A network with the comparator coordinates of some images mirrored left to right: about the middle of the picture,
    where its size is known, or of all marks of its camera."""
    middle = {camera.name: _middle_mm(network, camera) for camera in network.cameras}
    turned = np.array([image.name in names and image.transformation == "none" for image in network.images])
    centers = np.array([middle[image.camera] for image in network.images])[network.image_numbers]
    xy_mm = network.observations.xy_mm.copy()
    is_turned = turned[network.image_numbers]
    xy_mm[is_turned, 0] = 2.0 * centers[is_turned] - xy_mm[is_turned, 0]
    return replace(network, observations=replace(network.observations, xy_mm=xy_mm))


def _middle_mm(network: Network, camera: Camera) -> float:
    """The middle of the camera's pictures in x."""
    own = np.array([image.camera == camera.name for image in network.images])[network.image_numbers]
    x_mm = network.observations.xy_mm[own, 0]
    if not len(x_mm):
        return 0.0
    middle = float(x_mm.min() + x_mm.max()) / 2.0
    if not camera.frame_mm[0]:
        return middle if camera.x0_mm is None else camera.x0_mm.value
    half = camera.frame_mm[0] / 2.0
    return half if abs(middle - half) < abs(middle) else 0.0


def _mirrored_images(network: Network, given: Adjustment | None, tried: Tried, family: float) -> Iterator[Hypothesis]:
    """Single images of a digital camera, the worst first, without which all others agree."""
    images = [image for image in network.images if image.transformation == "none"]
    images = [image for image in images if image.name not in network.objectless_images]
    if len(images) < FEWEST_IMAGES:
        return
    worst = _squares(network, given)
    for image in sorted(images, key=lambda image: (-worst[image.name], image.name))[:MOST_MIRRORED]:
        others = leave_out(network, [image.frame])
        rest = None if others is None else tried(others)
        if rest is not None and explains(rest, family):
            yield Hypothesis(
                f"image {image.name} is mirrored",
                "Mirror its picture and measure it again, or its coordinates in comparator.csv.",
                _mirrored_image(network, image.name, rest),
            )
            return


def _mirrored_image(network: Network, name: str, rest: Adjustment) -> Network:
    """A network with one image mirrored; where the picture's middle is not known, with a principal point of its own and
    the lens that the rest of the images have.
    """
    turned = mirrored_images(network, [name])
    camera = network.camera_by_name[network.image_by_name[name].camera]
    if camera.frame_mm[0]:
        return turned
    known = {each: Prior(rest.value(Parameter.interior(camera.name, each))) for each in camera.distortion.parameters}
    own = replace(
        camera,
        name=f"{camera.name} ({name})",
        principal_distance_mm=Prior(rest.value(Parameter.interior(camera.name, "c"))),
        x0_mm=None,
        y0_mm=None,
        distortion=replace(camera.distortion, parameters=known),
    )
    images = tuple(replace(image, camera=own.name) if image.name == name else image for image in turned.images)
    return replace(turned, images=images, cameras=(*turned.cameras, own))


def _turn_camera(camera: Camera) -> Camera:
    """With y' pointing the other way."""
    marks = {id: Fiducial(mark.x_mm, _opposite(mark.y_mm)) for id, mark in camera.fiducials.items()}
    y0_mm = camera.y0_mm and _opposite(camera.y0_mm)
    return replace(camera, y0_mm=y0_mm, fiducials=marks, center_mm=(camera.center_mm[0], -camera.center_mm[1]))


def _opposite(prior: Prior) -> Prior:
    return Prior(-prior.value, prior.sigma)


def _other_principal_distance(network: Network) -> Iterator[Hypothesis]:
    calibrated = {parameter for each in network.calibrations for parameter in each.parameters}
    for camera in network.cameras:
        given = camera.principal_distance_mm
        if given is not None and np.isfinite(given.sigma) and Parameter.interior(camera.name, "c") not in calibrated:
            others = tuple(replace(each, principal_distance_mm=None) if each is camera else each
                           for each in network.cameras)  # fmt: skip
            yield Hypothesis(
                f"the principal distance of camera {camera.name} is not the {given.value:g} mm that are given",
                "Correct it, or give it with the standard deviation that it has.",
                replace(network, cameras=others),
                distance=(camera.name, given.value),
            )


def _exchanged_frames(network: Network, given: Adjustment | None) -> Iterator[Hypothesis]:
    """Targets of one frame under the name of another of the same camera."""
    observations = network.observations
    for first, second in _pairs(network, given):
        other = {first: second, second: first}
        rows = zip(observations.image, observations.is_fiducial, strict=True)
        image = tuple(name if is_fiducial else other.get(name, name) for name, is_fiducial in rows)
        yield Hypothesis(
            f"the targets of the frames {min(first, second)} and {max(first, second)} are exchanged",
            "Exchange them, or the frames' fiducial marks.",
            replace(network, observations=replace(observations, image=image)),
        )


def _pairs(network: Network, given: Adjustment | None) -> list[tuple[str, str]]:
    """Frames of one camera with film transformations of their own, those with the largest residuals first."""
    images = [image for image in network.images if image.transformation != "none"]
    images = [image for image in images if image.name not in network.objectless_images]
    worst = _squares(network, given)
    ordered = sorted(images, key=lambda image: (-worst[image.name], image.name))
    pairs = [(a.name, b.name) for a, b in combinations(ordered, 2) if a.camera == b.camera]
    return sorted(pairs, key=lambda pair: -worst[pair[0]] - worst[pair[1]])[:MOST_PAIRS]


def _squares(network: Network, given: Adjustment | None) -> dict[str, float]:
    """The sum of the squared residuals of every image; 0 where there is no adjustment."""
    if given is None:
        return dict.fromkeys((image.name for image in network.images), 0.0)
    squared = (given.residuals.v_mm**2).sum(axis=1)
    sums = np.bincount(network.image_numbers, squared, len(network.images))
    return {image.name: float(size) for image, size in zip(network.images, sums, strict=True)}


def _as_stations_are_given(network: Network, alike: Sequence[Hypothesis], found: Adjustment) -> Sequence[Hypothesis]:
    """Of hypotheses with the same residuals those whose stations come near the given ones; all where none does."""
    given = _given_stations(network)
    if len(alike) == 1 or not given:
        return alike
    back = np.linalg.inv(alike[0].moved)
    stations, depths = _stations(found, given)
    near = [
        each for each in alike if _near(stations @ (each.moved @ back).T, np.array(list(given.values())), depths).all()
    ]
    return near or alike


def _given_stations(network: Network) -> dict[str, Array]:
    exteriors: dict[str, Exterior | None] = {image.name: image.exterior for image in network.images}
    return {
        name: exterior.center
        for name, exterior in exteriors.items()
        if exterior is not None and name not in network.unoriented
    }


def _stations(result: Adjustment, of: dict[str, Array]) -> tuple[Array, Array]:
    """Adjusted stations (n, 3) of some images, and their distances (n,) from the middle of the points."""
    frames = [result.network.image_by_name[name].frame for name in of]
    exterior = (Parameter.exterior(frame, element) for frame in frames for element in EXTERIOR_NAMES[:3])
    stations = result.values_of(exterior).reshape(-1, 3)
    return stations, np.linalg.norm(stations - _points(result).mean(axis=0), axis=1)


def _points(result: Adjustment) -> Array:
    ids = [point.id for point in result.network.points if point.id in result.network.observed_points]
    return result.values_of(Parameter.point(id, axis) for id in ids for axis in "XYZ").reshape(-1, 3)


def _near(stations: Array, given: Array, depths: Array) -> Mask:
    return np.asarray(np.linalg.norm(stations - given, axis=1) < NEAR * depths)


def stations_elsewhere(network: Network, result: Adjustment) -> str:
    """What would bring stations that the points alone give near those that the network gives, where they are not:
    another unit, exchanged frames, or mirrored points of a flat field; empty where nothing does.
    """
    given = _given_stations(network)
    if result.termination == "singular" or len(given) < 2 or not network.observed_points:
        return ""
    names, places = list(given), np.array(list(given.values()))
    stations, depths = _stations(result, given)
    near = _near(stations, places, depths)
    off = np.flatnonzero(~near)
    if len(off) == 2 and _near(stations[off], places[off[::-1]], depths[off]).all():
        one, other = (names[i] for i in off)
        return (
            f"The frames {one} and {other} lie each where the other's orientation is given: their names "
            f"are exchanged, in the scans or in images.csv."
        )
    if 2 * len(off) <= len(names):
        return ""
    for words, candidate, scale in _moved_stations(result, stations):
        if _near(candidate, places, scale * depths).all():
            return (
                f"By the points the stations lie nowhere near where they are given, but all {len(names)} would with "
                f"another reading of the points: {words}. Correct the points, or the stations."
            )
    return ""


def _moved_stations(result: Adjustment, stations: Array) -> Iterator[tuple[str, Array, float]]:
    for factor in (*UNITS, *(1.0 / each for each in UNITS)):
        yield _unit_words(factor), factor * stations, factor
    points = _points(result)
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extents[-1] > FLAT * extents[0]:
        return
    reflected = stations - 2.0 * np.outer((stations - middle) @ axes[-1], axes[-1])
    for words, moved in AXES.items():
        yield words, reflected @ moved.T, 1.0
