"""Test whether a blunder of the whole network explains its contradictions.

Mirrored points or exchanged axes, another unit, y pointing down, exchanged frames, mirrored images, a wrong principal
distance. Such a blunder leaves residuals everywhere, and tests of single observations would reject good ones.

Of one frame that contradicts the others as a whole the names of its fiducials, its film and its camera are tested, each
in the adjustment of all frames. Of those with which all observations agree, the one with the smallest v'Pv plus twice
the unknowns is told (Akaike).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, combinations, product

import numpy as np
from scipy.special import chdtrc

from adjust.array_types import Array
from adjust.functional_model.families import family
from adjust.functional_model.lens import INTERIOR_NAMES, Distortion, Prior
from adjust.functional_model.opencv_family import FISHEYE_NAMES
from adjust.problem.network import Network, ObjectPoint
from adjust.problem.parameter import Parameter, shortened
from adjust.solution.explanations import CHECKED
from adjust.solution.given_orientations import (
    AXES,
    CLEARLY,
    FACTORS,
    TOLERATED,
    UNIT,
    adjusted_stations,
    given_stations,
    is_near,
    orientations_elsewhere,
    times_too,
    wrong_orientations,
)
from adjust.solution.model_hypotheses import OTHERS, RICHER, Estimate, group_words
from adjust.solution.result import Adjustment
from adjust.solution.wrong_names import (
    LARGE,
    NAMED,
    points_with_scaled_heights,
    renamed_words,
    transformed_fields,
    turned_layouts,
)

WORST, RARE = 3, 1e-3  # frames of a camera tried with another one; ratio of likelihoods to be exceeded by one trial
MOST_PAIRS = 15  # pairs of frames tried as exchanged, largest residuals first
ONE_AXIS = 10.0  # sigma0 that one axis in another unit leaves at least
PITCHES = (10.0, 25.4, 100.0, 1000.0, 2.0)  # ratios of principal distances by another unit or pixel pitch
ROUND = 0.05  # relative tolerance of these ratios
SMALL_DEG = 0.5  # extent of a field that is flat enough for geographic coordinates times two factors
EQUATORIAL_M, ECCENTRICITY = 6_378_137.0, 0.0818191908426  # of the ellipsoid WGS 84
MIRRORED = "the points are mirrored: the sign of X, Y or Z of all of them is wrong, or two axes are exchanged"


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

    def agrees(self, result: Adjustment) -> bool:
        """Whether v'Pv is not significant."""
        return result.redundancy < 1 or bool(chdtrc(result.redundancy, result.vpv) > self.family)


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
        yield [NetworkHypothesis(UNIT.format(times_too(factor)), _move_points(network, by), remedy, by)]
    is_far = given is None or not given.converged or given.sigma0 > ONE_AXIS
    exchanged, mirrored_images = _exchanged_frames(network, given), _mirrored_images(network)
    # Before distances, of which one may do the same.
    heights = chain(_one_axis(network, (2,)), _some_heights(network)) if is_far else ()
    # With any units of the axes linear transformations of the given points fit all images, but the adjustment does not.
    large_mm = LARGE * np.ptp(network.observations.xy_mm)
    misses = given is None or not given.converged or np.sqrt(np.mean(given.residuals.v_mm**2)) > large_mm
    is_stretched = is_far and misses and all(each.misfit < LARGE for each in transformed_fields(network))
    plane = _one_axis(network, (0, 1)) if is_stretched else ()
    lenses = _fisheyes(network) if given is None or not given.converged else ()
    degrees = _degrees(bare) if is_far else ()
    further = chain(degrees, exchanged, heights, mirrored_images, _distances(network), plane, lenses)
    yield from ([each] for each in further)


def _one_axis(network: Network, axes: Sequence[int]) -> Iterator[NetworkHypothesis]:
    """Hypothesis: one of some axes is in another unit than the others."""
    extents = np.ptp(list(network.known_places.values()) or np.zeros((1, 3)), axis=0)
    for axis, factor in product((axis for axis in axes if extents[axis]), FACTORS):
        name, others = "XYZ"[axis], " and ".join("XYZ".replace("XYZ"[axis], ""))
        by = np.diag(np.where(np.arange(3) == axis, factor, 1.0))
        words = f"{name} of all points is {times_too(factor)} for {others}: another unit"
        yield NetworkHypothesis(words, _move_points(network, by), moved=by)


def _degrees(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: X and Y are geographic coordinates in degrees, those of a small field; heights are in m."""
    plan = np.array(list(network.known_places.values())).reshape(-1, 3)[:, :2]
    if not len(plan) or np.ptp(plan, axis=0).max() > SMALL_DEG or np.abs(plan).max(axis=0).min() < SMALL_DEG:
        return
    for words, axes in (("longitude and latitude", (0, 1)), ("latitude and longitude", (1, 0))):
        latitude = np.radians(plan[:, axes[1]].mean())
        if abs(latitude) < np.pi / 2.0:
            flattened = 1.0 - ECCENTRICITY**2 * np.sin(latitude) ** 2
            north = EQUATORIAL_M * (1.0 - ECCENTRICITY**2) / flattened**1.5
            by = np.zeros((3, 3))
            by[0, axes[0]], by[1, axes[1]], by[2, 2] = EQUATORIAL_M / np.sqrt(flattened) * np.cos(latitude), north, 1.0
            by[:2] *= np.pi / 180.0
            remedy = "Convert them to a map projection, UTM say, in the unit of Z."
            yield NetworkHypothesis(
                f"X and Y of all points are {words} in degrees", _move_points(network, by), remedy, by
            )


def _some_heights(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the heights of some points are in another unit than those of the others."""
    for factor in FACTORS:
        names, doubtful = points_with_scaled_heights(network, factor)
        if not names:
            continue
        points = (replace(each, Z=_scaled(each.Z, factor)) if each.id in names else each for each in network.points)
        points = (
            replace(each, Z=each.Z and Prior(each.Z.value, np.inf)) if each.id in doubtful else each for each in points
        )
        who = f"{len(names)} of {len(network.known_places)} points ({shortened(sorted(names), NAMED)})"
        yield NetworkHypothesis(
            f"Z of {who} is {times_too(factor)} for the others: another unit",
            replace(network, points=tuple(points)),
        )


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
    observations = network.observations.mirror(np.where(digital[:, None], [1.0, -1.0], 1.0))
    cameras = []
    for camera in network.cameras:
        marks = {
            id_: replace(mark, y_mm=Prior(-mark.y_mm.value, mark.y_mm.sigma)) for id_, mark in camera.fiducials.items()
        }
        center_mm, y0_mm = (camera.center_mm[0], -camera.center_mm[1]), _scaled(camera.y0_mm, -1.0)
        turned = replace(camera, y0_mm=y0_mm, fiducials=marks, center_mm=center_mm)
        cameras.append(camera if keeps_given and camera.y0_mm else turned)
    return replace(network, cameras=tuple(cameras), observations=observations)


def _mirrored_images(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: those digital images are mirrored that a linear transformation of the given points shows so."""
    fields = transformed_fields(network)
    names = [each.image.name for each in fields if each.handedness > 0.0 and each.image.transformation == "none"]
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
    middle, of_image = dict[str, float](), np.array([image.camera for image in network.images])
    for camera in network.cameras:
        x_mm = network.observations.xy_mm[(of_image == camera.name)[network.image_numbers], 0]
        own = float(x_mm.min() + x_mm.max()) / 2.0 if len(x_mm) else 0.0
        if len(x_mm) and camera.frame_mm[0]:
            half = camera.frame_mm[0] / 2.0
            own = half if abs(own - half) < abs(own) else 0.0
        elif len(x_mm) and camera.x0_mm is not None:
            own = camera.x0_mm.value
        middle[camera.name] = own
    turned = np.array([image.name in names and image.transformation == "none" for image in network.images])
    centers = np.array([middle[image.camera] for image in network.images])[network.image_numbers]
    is_turned = turned[network.image_numbers, None]
    shifts_mm = np.where(is_turned, np.outer(centers, [2.0, 0.0]), 0.0)
    return replace(network, observations=network.observations.mirror(np.where(is_turned, [-1.0, 1.0], 1.0), shifts_mm))


def _distances(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the principal distance of a camera without an earlier calibration is wrong."""
    calibrated = {(known.owner, known.quantity) for each in network.calibrations for known in each.parameters}
    for camera in network.cameras:
        given = camera.principal_distance_mm
        if given is not None and np.isfinite(given.sigma) and (camera.name, "c") not in calibrated:
            free = replace(camera, principal_distance_mm=None)
            yield NetworkHypothesis(
                f"the principal distance of camera {camera.name} is not the {given.value:g} mm that are given",
                replace(network, cameras=tuple(free if each is camera else each for each in network.cameras)),
                "Correct it, or give it with the standard deviation that it has.",
                figures=partial(_found_distance, camera.name, given.value),
            )


def _fisheyes(network: Network) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the lens of a camera, whose distortion is free in another family, is a fisheye."""
    for camera in network.cameras:
        distortion = camera.distortion
        is_free = any(prior.sigma > 0.0 for prior in distortion.parameters.values())
        if is_free and family(distortion.family).is_pinhole_at_zero:
            fisheye = Distortion("opencv_fisheye", {name: Prior(0.0, np.inf) for name in FISHEYE_NAMES[:4]})
            changed = replace(camera, distortion=fisheye)
            yield NetworkHypothesis(
                f"the lens of camera {camera.name} is a fisheye, which the family {distortion.family} is not for",
                replace(network, cameras=tuple(changed if each is camera else each for each in network.cameras)),
                'Give family = "opencv_fisheye" under [distortion], and k1 to k4 under [distortion.sigma].',
            )


def _exchanged_frames(network: Network, given: Adjustment | None) -> Iterator[NetworkHypothesis]:
    """Hypothesis: the targets of two frames of a camera are exchanged; largest residuals first."""
    observations = network.observations
    sums = dict[str, float]()
    if given is not None:  # whose network may lack points and images that were left out
        squares, names = (given.residuals.v_mm**2).sum(axis=1), [image.name for image in given.network.images]
        by_image = np.bincount(given.network.image_numbers, squares, len(names))
        sums = dict(zip(names, by_image.tolist(), strict=True))
    films = {
        image.name: (sums.get(image.name, 0.0), image.camera)
        for image in network.images
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


def exchanged_cameras(network: Network, given: Adjustment, trials: Trials) -> str:
    """Describe frames that fit another camera than that which they name; empty where none does.

    All trials have as many unknowns, so that the fall of v'Pv is twice the logarithm of the likelihood ratio.
    """
    if not given.converged or len({image.camera for image in network.images}) < 2 or trials.agrees(given):
        return ""
    camera_of = {image.frame: image.camera for image in network.images}
    numbers = network.frame_numbers[network.image_numbers]
    variances = np.diagonal(network.observations.covariance_mm2, axis1=1, axis2=2)
    squares = np.bincount(numbers, (given.residuals.v_mm**2 / variances).sum(axis=1), len(camera_of)).tolist()
    size = dict(zip(dict.fromkeys(image.frame for image in network.images), squares, strict=True))
    frames = {
        camera: sorted((each for each in camera_of if camera_of[each] == camera), key=lambda each: -size[each])
        for camera in sorted(set(camera_of.values()))
    }
    moves = list[dict[str, str]]()
    for one, other in combinations(frames, 2):
        if network.camera_by_name[one].fiducials.keys() != network.camera_by_name[other].fiducials.keys():
            continue
        worst = frames[one][:WORST], frames[other][:WORST]
        moves += [{each: other} for each in worst[0]] + [{each: one} for each in worst[1]]
        moves += [{first: other, second: one} for first, second in product(*worst)]
        moves.append(dict.fromkeys(frames[one], other) | dict.fromkeys(frames[other], one))
    found = dict[int, Adjustment]()
    for number, move in enumerate(moves):
        images = tuple(replace(each, camera=move.get(each.frame, each.camera)) for each in network.images)
        result = trials.adjust(replace(network, images=images))
        if result is not None and result.converged and trials.explains(result):
            found[number] = result
    if not found:
        return ""
    best = min(found, key=lambda number: found[number].vpv)
    result, move = found[best], moves[best]
    fall = (given.vpv - result.vpv) / max(1.0, result.vpv / result.redundancy)
    if fall < 2.0 * np.log(len(moves) / RARE) or given.vpv - result.vpv < 0.5 * (given.vpv - given.redundancy):
        return ""
    if len(move) == len(camera_of):
        words = f"The cameras {' and '.join(sorted(set(move.values())))} are exchanged for all images"
    else:
        each = "; ".join(f"{frame} fits camera {move[frame]}, not {camera_of[frame]}" for frame in sorted(move))
        words = f"A wrong camera is given for {len(move)} image{'s' * (len(move) > 1)}: {each}"
    return (
        f"{words}. Without this σ₀ is {result.sigma0:.2f}; as it stands it is {given.sigma0:.3g}. Correct the column "
        "camera of images.csv, or what sorts the images by camera."
    )


def blunder_sentence(network: Network, given: Adjustment | None, trials: Trials) -> str:
    """Describe the blunder of a whole network without which all observations agree; empty where there is none.

    given: adjustment of the network as given, None where it cannot start. A hypothesis explains the contradictions
    where v'Pv without the blunder is not significant (`Trials.explains`) and sigma0 is CLEARLY smaller. Hypotheses with
    identical residuals are tried once, without the given orientations, which then distinguish them.
    """
    if given is None:  # perhaps only the given approximations are wrong
        given = trials.adjust(network)
        # Images that look straight at a flat field fit with any principal distance, and a stretched field by tilts.
        if given is None:
            held = Prior(1.5 * float(np.ptp(network.observations.xy_mm)), 0.0)
            of_held = tuple(replace(each, principal_distance_mm=held) for each in network.cameras)
            if trials.explains(trials.adjust(replace(network, cameras=of_held))):
                return ""
    if given is not None and (cameras := exchanged_cameras(network, given, trials)):
        return cameras
    if trials.explains(given):
        return ""
    bare = replace(network, images=tuple(replace(image, exterior=None) for image in network.images))
    stations = given_stations(network)
    if stations:
        alone = trials.adjust(bare)
        if alone is not None and trials.explains(alone):
            if elsewhere := orientations_elsewhere(network, alone, is_observed=True):
                return elsewhere
            what, without = wrong_orientations(network, alone, trials.family) or ("", bare)
            found = trials.adjust(without) if what else None
            if found is None or not trials.explains(found):
                return ""
            rows = NetworkHypothesis(what, without, "Correct these rows of images.csv, or leave them out.")
            return _sentence([rows], found, given, trials.family)
    for alike in network_hypotheses(network, bare, given):
        found = trials.adjust(alike[0].network)
        better = found is not None and (given is None or CLEARLY * found.sigma0 < given.sigma0 or not given.converged)
        if found is not None and better and trials.explains(found):
            if len(alike) > 1 and stations:  # those whose stations lie near the given ones; all if none does
                adjusted, depths, places = adjusted_stations(found, stations)
                unmoved = adjusted @ np.linalg.inv(alike[0].moved).T
                alike = [each for each in alike if is_near(unmoved @ each.moved.T, places, depths).all()] or alike
            return _sentence(alike, found, given, trials.family)
    return ""


def _sentence(
    hypotheses: Sequence[NetworkHypothesis], found: Adjustment, given: Adjustment | None, family: float
) -> str:
    words = [each.words for each in hypotheses]
    if len(words) >= len(AXES):  # the mirrored axis cannot be identified
        words = [MIRRORED, *words[len(AXES) :]]
    what = "; or ".join(words) + hypotheses[0].figures(found)
    if given is None:
        stands = "nothing can be adjusted"
    elif not given.converged:
        stands = "the iteration does not converge"
    else:
        stands = f"σ₀ is {given.sigma0:.3g} (p < {family:g})"
    return (
        f"{what[0].upper()}{what[1:]}. Without this all {len(found.network.observations)} observations agree "
        f"(σ₀ = {found.sigma0:.2f}); as it stands, {stands}. {hypotheses[0].remedy}"
    )


def _found_distance(camera: str, given_mm: float, found: Adjustment) -> str:
    """Describe the estimated principal distance, and whether it is the given one in another unit or pixel pitch."""
    c = float(found.values[found.run.problem.unknowns.camera[camera][0]])
    times = max(c / given_mm, given_mm / c)
    how = "long" if c < given_mm else "short"
    is_unit = any(abs(times / each - 1.0) < ROUND for each in PITCHES)
    why = f", so that it is given {times:.3g} times too {how}: another unit, or a wrong pitch_um" if is_unit else ""
    return f": it is found as {c:.6g} mm{why}"


def frame_cause(network: Network, frame: str, rest: Adjustment, trials: Trials) -> str:
    """Describe what is wrong with a frame by the best hypothesis with which all agree; empty where there is none.

    rest: adjustment without it.
    """
    found = list[tuple[float, str]]()
    for words, changed in _frame_hypotheses(network, frame, rest):
        result = trials.adjust(changed)
        if result is not None and result.converged and trials.explains(result):
            criterion = result.vpv + 2.0 * result.unknowns
            found.append((criterion, words or _interior_words(result, frame)))
    return min(found, default=(0.0, ""))[1]


def _frame_hypotheses(network: Network, frame: str, rest: Adjustment) -> Iterator[tuple[str, Network]]:
    """Generate words and networks; a frame with an interior orientation of its own has its words from the adjustment.

    A frame that was scanned in parts has none.
    """
    (image, *parts) = (each for each in network.images if each.frame == frame)
    if parts:
        return
    camera, observations = network.camera_by_name[image.camera], network.observations
    own = (np.array(observations.image) == image.name) & observations.is_fiducial
    shown = sorted({observations.point[row] for row in np.flatnonzero(own)})
    for renamed in turned_layouts({name: camera.fiducials[name] for name in shown}):
        rows = zip(observations.point, own, strict=True)
        point = tuple(renamed.get(name, name) if is_own else name for name, is_own in rows)
        yield (
            f"the fiducials of image {frame} have each other's names: {renamed_words(renamed)}. Correct the names.",
            replace(network, observations=replace(observations, point=point)),
        )
    for kind in RICHER.get(image.transformation, ()):
        images = tuple(replace(each, transformation=kind) if each is image else each for each in network.images)
        yield (
            f"the film of image {frame} is deformed by more than its transformation ({image.transformation}) models; "
            f"with {kind} all agree. Look for stretched or torn film, and scan it again.",
            replace(network, images=images),
        )

    def estimated(quantity: str, sigma: float = 0.0) -> Prior:
        return Prior(rest.value(Parameter.interior(camera.name, quantity)), sigma)

    lens = replace(camera.distortion, parameters={name: estimated(name) for name in camera.distortion.parameters})
    other = replace(
        camera,
        name=f"{camera.name}{OTHERS}",
        principal_distance_mm=estimated("c", np.inf),
        x0_mm=None,
        y0_mm=None,
        distortion=lens,
    )
    images = tuple(replace(each, camera=other.name) if each is image else each for each in network.images)
    yield "", replace(network, images=images, cameras=(*network.cameras, other))


def _interior_words(result: Adjustment, frame: str) -> str:
    """Describe a frame by an interior orientation of its own."""
    other = next(image.camera for image in result.network.images if image.frame == frame)
    cameras = (other, other.removesuffix(OTHERS))
    names = [Parameter.interior(name, quantity) for name in cameras for quantity in INTERIOR_NAMES]
    covariance = result.sigma0**2 * result.cofactor_of(names)
    estimate = Estimate(result.values_of(names), np.sqrt(np.diag(covariance)), covariance)
    cause, remedy = group_words(f"the marks of image {frame}", estimate)
    return f"{cause[0].lower()}{cause[1:]}. {remedy}"
