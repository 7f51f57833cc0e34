"""What a network must have before it can be adjusted, told with the name of the culprit."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from adjust.array_types import Indices
from adjust.errors import AdjustmentError
from adjust.functional_model.families import family
from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import fewest_marks, marks_needed
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network
from adjust.problem.observations import Observations
from adjust.problem.parameter import Parameter, description

TARGETS_NEEDED = 3
SHOWN_AS = {"fiducial": 1, "join": 2}  # all others are object points
DEFINITE = 1e-13  # least eigenvalue of an earlier calibration's correlation matrix


def validate(network: Network) -> None:
    """Raise AdjustmentError where a network is empty, contradictory or lacks what an image needs."""
    validate_plan(network)
    _check_places(network)


def validate_plan(network: Network) -> None:
    """As `validate`, of a network that is only planned: nothing is measured in it yet, whatever the places say."""
    _check_not_empty(network)
    _check_unique("camera", (camera.name for camera in network.cameras))
    _check_unique("image", (image.name for image in network.images))
    _check_unique("scanner", (scanner.name for scanner in network.scanners))
    _check_unique("object point", (point.id for point in network.points))
    _check_cameras(network)
    _check_scanners(network)
    _check_boards(network)
    _check_shapes(network.observations)
    _check_names(network)
    _check_distances(network)
    _check_calibrations(network)
    _check_antennas(network)
    _check_duplicate_observations(network)
    _check_values(network.observations)
    _check_parts(network)
    frames = {image.frame: image for image in network.images}
    for (frame, image), shown in zip(frames.items(), _mark_counts(network).tolist()[: len(frames)], strict=True):
        _check_image(replace(image, name=frame), *shown)


def _check_not_empty(network: Network) -> None:
    if not network.images:
        raise AdjustmentError("There is nothing to adjust: the network has no image.")
    if not len(network.observations):
        raise AdjustmentError(
            "There is nothing to adjust: no mark was observed. Look at the statuses and reasons of the measurement."
        )


def _check_unique(what: str, names: Iterable[str]) -> None:
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise AdjustmentError(
            f"{what} {twice[0]} is given {_times(names=twice)}. Every {what} needs a name of its own."
        )


def _times(names: list[str]) -> str:
    return "more than once" if len(names) == 1 else f"more than once, and so are {', '.join(names[1:6])}"


def _check_cameras(network: Network) -> None:
    for image in network.images:
        if image.camera not in network.camera_by_name:
            known = ", ".join(sorted(network.camera_by_name)) or "none"
            raise AdjustmentError(
                f"image {image.name} is of the camera {image.camera}, which is not given; given: {known}."
            )
    for camera in network.cameras:
        c = camera.principal_distance_mm
        if c is not None and c.value <= 0.0:
            raise AdjustmentError(f"camera {camera.name}: the principal distance must be positive, not {c.value} mm.")
        needed = family(camera.distortion.family).needs
        if needed == "r0_mm" and camera.distortion.r0_mm <= 0.0:
            raise AdjustmentError(f"camera {camera.name}: the distortion family juhl needs r0 > 0, Juhl's is 1.35 dm.")
        if needed == "half_mm" and min(camera.distortion.half_mm) <= 0.0:
            raise AdjustmentError(
                f"camera {camera.name}: the distortion family {camera.distortion.family} counts in halves of the "
                f"frame. Give half_mm, two positive lengths, such as (115.0, 115.0) for an aerial camera."
            )


def _check_scanners(network: Network) -> None:
    for image in network.images:
        if image.scanner and image.scanner not in network.scanner_by_name:
            known = ", ".join(sorted(network.scanner_by_name)) or "none"
            raise AdjustmentError(
                f"image {image.name} is of the scanner {image.scanner}, which is not given; given: {known}."
            )


def _check_boards(network: Network) -> None:
    _check_unique("board", (board.name for board in network.boards))
    board_by_point: dict[str, str] = {}
    for board in network.boards:
        for id_ in board.places:
            if board_by_point.setdefault(id_, board.name) != board.name:
                raise AdjustmentError(
                    f"point {id_} is on the boards {board_by_point[id_]} and {board.name}; it can be on one."
                )
            point = network.point_by_id.get(id_)
            known = point is not None and all(
                p is not None and np.isfinite(p.sigma) for p in (point.X, point.Y, point.Z)
            )
            if point is not None and not known:
                raise AdjustmentError(
                    f"point {id_} of board {board.name} is not known: a bend is told from flat coordinates. Give X, Y "
                    "and Z with standard deviations (0 fixes them), or leave the bend out."
                )


def _check_distances(network: Network) -> None:
    for each in network.distances:
        what = f"the distance from {each.start} to {each.end}"
        for end in (each.start, each.end):
            if end not in network.point_by_id and end not in network.image_by_name:
                raise AdjustmentError(f"{what}: {end} is neither an object point nor an image. Correct the name.")
            if end in network.point_by_id and end not in network.observed_points:
                raise AdjustmentError(f"{what}: no image shows the point {end}. Measure it, or leave the distance out.")
        if each.start == each.end:
            raise AdjustmentError(f"{what} has the same point at both ends. Correct one of them.")
        if not 0.0 < each.value < np.inf:
            raise AdjustmentError(f"{what} must be a positive number, not {each.value:g}.")
        if not 0.0 < each.sigma < np.inf:
            raise AdjustmentError(
                f"{what} needs a positive standard deviation, not {each.sigma:g}. An exact distance is not offered: "
                f"give a standard deviation of a hundredth of what its ends have, or leave it out."
            )


def _check_antennas(network: Network) -> None:
    for image in network.images:
        exterior = image.exterior
        if exterior is not None and exterior.has_antenna and (exterior.sigmas[:3] == 0.0).any():
            raise AdjustmentError(
                f"image {image.name}: the station is fixed by a standard deviation of 0, but it is an antenna's, which "
                f"can be observed only. Give it a positive standard deviation, or no offset."
            )


def _check_calibrations(network: Network) -> None:
    sigmas = {parameter: sigma for camera in network.cameras for parameter, sigma in _camera_sigmas(camera)}
    given: set[Parameter] = set()
    for each in network.calibrations:
        for key in each.parameters:
            if key not in sigmas:
                raise AdjustmentError(
                    f"an earlier calibration gives {key.label}, but no camera has that quantity. Leave it out."
                )
            if key in given or np.isfinite(sigmas[key]):
                other = "another calibration" if key in given else f"a standard deviation of its own ({sigmas[key]:g})"
                raise AdjustmentError(
                    f"{key.label} has an earlier calibration and {other}: the same knowledge would count twice. "
                    f"Keep one."
                )
            given.add(key)
        count = len(each.parameters)
        if each.values.shape != (count,) or each.covariance.shape != (count, count):
            raise AdjustmentError(
                f"an earlier calibration of {count} quantities has {each.values.shape} values and a covariance of the "
                f"shape {each.covariance.shape}."
            )
        scale = np.sqrt(np.diag(each.covariance).clip(1e-300))
        if not np.linalg.eigvalsh(each.covariance / np.outer(scale, scale)).min(initial=1.0) > DEFINITE:
            raise AdjustmentError(
                f"the covariance of an earlier calibration of {description(each.parameters[:3])} and more is not "
                f"positive definite: some of these quantities were fixed, or no observation told them apart. Fix them "
                f"here too."
            )


def _camera_sigmas(camera: Camera) -> Iterator[tuple[Parameter, float]]:
    """The camera's quantities, and the standard deviations that they have of their own."""
    interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
    named: dict[str, Prior | None] = {**interior, **camera.distortion.parameters}
    priors = {Parameter.interior(camera.name, name): prior for name, prior in named.items()}
    for id_, mark in camera.fiducials.items():
        priors |= {Parameter.fiducial(camera.name, id_, axis): getattr(mark, f"{axis}_mm") for axis in "xy"}
    for parameter, prior in priors.items():
        yield parameter, np.inf if prior is None else prior.sigma


def _check_shapes(observations: Observations) -> None:
    count = len(observations)
    shapes = (
        len(observations.point),
        len(observations.kind),
        observations.xy_mm.shape,
        observations.covariance_mm2.shape,
    )
    if shapes != (count, count, (count, 2), (count, 2, 2)):
        raise AdjustmentError(
            f"The observations do not go together: {count} images, {shapes[0]} points, {shapes[1]} kinds, coordinates "
            f"of shape {shapes[2]} and covariances of shape {shapes[3]}; each needs one row an observation."
        )


def _check_names(network: Network) -> None:
    observations = network.observations
    image, point, kind = observations.image, observations.point, observations.kind
    unknown = set(image) - network.image_by_name.keys()
    if unknown:
        row = next(i for i, name in enumerate(image) if name in unknown)
        raise AdjustmentError(
            f"{kind[row]} {point[row]} is observed in image {image[row]}, which is not in the network. Add the image."
        )
    for camera, id_ in sorted(network.observed_fiducials):
        if id_ not in network.camera_by_name[camera].fiducials:
            rows = (i for i, name in enumerate(point) if name == id_ and kind[i] == "fiducial")
            shown = next(image[i] for i in rows if network.image_by_name[image[i]].camera == camera)
            raise AdjustmentError(
                f"fiducial {id_} is observed in image {shown}, but camera {camera} has no such mark. Give its "
                f"coordinates in the camera file, or correct its id."
            )
    for id_ in sorted(network.observed_points - network.point_by_id.keys()):
        row = next(i for i, name in enumerate(point) if name == id_ and kind[i] != "fiducial")
        raise AdjustmentError(
            f"{kind[row]} {id_} is observed in image {image[row]}, but there is no such object point. Add it to the "
            f"points (coordinates may be left blank), or correct its id."
        )


def _check_duplicate_observations(network: Network) -> None:
    observations = network.observations
    names, of_name = observations.numbered_points
    mark = (2 * network.image_numbers + observations.is_fiducial) * len(names) + of_name
    if len(np.unique(mark)) == len(mark):
        return
    _, first, counts = np.unique(mark, return_index=True, return_counts=True)
    for row, count in zip(first[counts > 1], counts[counts > 1], strict=True):
        what = "fiducial" if observations.is_fiducial[row] else "point"
        raise AdjustmentError(
            f"{what} {observations.point[row]} is observed {count} times in image {observations.image[row]}. Keep one "
            f"of the rows."
        )


def _check_values(observations: Observations) -> None:
    covariance = observations.covariance_mm2
    finite = np.isfinite(observations.xy_mm).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    variances = np.einsum("nii->ni", covariance)
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1] * covariance[:, 1, 0]
        symmetric = np.abs(covariance[:, 0, 1] - covariance[:, 1, 0]) <= 1e-9 * np.abs(covariance[:, 1, 0])
    definite = (variances > 0.0).all(axis=1) & (determinant > 0.0) & symmetric
    for good, what in (
        (finite, "has a coordinate or covariance that is not a finite number"),
        (
            definite,
            "has a covariance matrix that is not positive definite: its standard deviations must be positive, "
            "its correlation between -1 and 1",
        ),
    ):
        if not good.all():
            row = int(np.argmin(good))
            raise AdjustmentError(
                f"{observations.kind[row]} {observations.point[row]} in image {observations.image[row]} {what}."
            )


def _check_places(network: Network) -> None:
    """Raise where all fiducials, or all object points, of an image have one and the same place in it."""
    observations, numbers = network.observations, network.image_numbers
    for kind, rows in (("fiducials", observations.is_fiducial), ("targets", ~observations.is_fiducial)):
        chosen = np.flatnonzero(rows)
        if not chosen.size:
            continue
        order = chosen[np.argsort(numbers[chosen], kind="stable")]
        starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
        xy, counts = observations.xy_mm[order], np.diff([*starts, len(order)])
        is_one = (np.maximum.reduceat(xy, starts) == np.minimum.reduceat(xy, starts)).all(axis=1) & (counts > 1)
        if is_one.any():
            row = int(order[starts[np.argmax(is_one)]])
            raise AdjustmentError(
                f"image {observations.image[row]}: all its {counts[np.argmax(is_one)]} {kind} are at one place, "
                f"({xy[starts[np.argmax(is_one)]][0]:g}, {xy[starts[np.argmax(is_one)]][1]:g}) mm. Correct them, or "
                "leave the image out."
            )


def _check_parts(network: Network) -> None:
    """The scans of one frame are of one camera and know one orientation, and joins are common to two of them."""
    first: dict[str, Image] = {}
    for image in network.images:
        other = first.setdefault(image.frame, image)
        exteriors = [each.exterior for each in (image, other)]
        same = exteriors[0] is exteriors[1] or (
            None not in exteriors and all(str(vars(each)) == str(vars(exteriors[0])) for each in exteriors)
        )
        alike = image.camera == other.camera and image.transformation == other.transformation and same
        if not alike or bool(image.part_of) != bool(other.part_of):
            raise AdjustmentError(
                f"frame {image.frame}: its scans {other.name} and {image.name} differ in camera, transformation or "
                "given orientation. Parts of one frame have the same."
            )
    for (frame, point), rows in sorted(network.joins.items()):
        if len(rows) < 2:
            raise AdjustmentError(
                f"join {point} is observed in one scan of frame {frame} only, and joins nothing. Leave it out, or "
                "measure it in another part of the frame."
            )


def _mark_counts(network: Network) -> Indices:
    """(frames, 2) how many object points, and how many fiducials, every frame shows, those in several parts once."""
    observations, frames = network.observations, network.frame_numbers[network.image_numbers]
    names, points = observations.numbered_points
    kinds = np.array([SHOWN_AS.get(kind, 0) for kind in observations.kind], dtype=np.intp)
    marks = np.unique((frames * 3 + kinds) * len(names) + points) // len(names)
    return np.bincount(marks, minlength=3 * len(network.images)).reshape(-1, 3)[:, :2]


def _check_image(image: Image, targets: int, fiducials: int) -> None:
    needed = marks_needed(image.transformation)
    fewest = fewest_marks(image.transformation) if targets else needed
    if fiducials < fewest:
        alone = f", {needed} where its targets tell nothing of it" if needed > fewest else ""
        raise AdjustmentError(
            f"image {image.name} shows {fiducials} fiducial marks; its {image.transformation} transformation needs "
            f"{fewest}{alone}. Measure more of them, choose a transformation that needs fewer, or leave the image out."
        )
    if not targets and not fiducials:
        raise AdjustmentError(
            f"image {image.name} shows neither fiducial marks nor object points. Leave the image out."
        )
    if 0 < targets < TARGETS_NEEDED and not image.is_observed:
        raise AdjustmentError(
            f"image {image.name} shows {targets} object points; its exterior orientation needs {TARGETS_NEEDED}. "
            f"Measure more targets in it, give its orientation with standard deviations, or leave its targets out: its "
            f"fiducial marks alone give its film transformation."
        )
