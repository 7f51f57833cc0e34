"""Validation of a network before its adjustment; messages name the faulty item."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from adjust.errors import AdjustmentError
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import fewest_marks, marks_needed
from adjust.problem.network import Image, Network
from adjust.problem.parameter import Parameter, description

TARGETS_NEEDED = 3
LEAST_SIGMA, LARGEST_SIGMA = (
    1e-7,
    0.02,
)  # standard deviation of most marks, relative to half the extent of an image's marks
LARGEST_SPREAD = 20.0  # extent of an image's marks over the longer side of the frame
DEFINITE = 1e-13  # smallest eigenvalue of an earlier calibration's correlation matrix

Faults = Iterator[str]  # sentences; the first one is raised


def validate(network: Network) -> None:
    """Raise AdjustmentError where a network is empty, contradictory or lacks what an image needs."""
    validate_plan(network)
    _raise_first(_place_faults(network))
    _raise_first(_extent_faults(network))
    _raise_first(_sigma_faults(network))


def validate_plan(network: Network) -> None:
    """Validate a planned network, whose image coordinates are not measured yet and are not checked."""
    for faults in (
        _name_faults,
        _camera_faults,
        _board_faults,
        _observation_faults,
        _distance_faults,
        _calibration_faults,
        _value_faults,
        _part_faults,
        _image_faults,
    ):
        _raise_first(faults(network))


def _raise_first(faults: Faults) -> None:
    for fault in faults:
        raise AdjustmentError(fault)


def _name_faults(network: Network) -> Faults:
    if not network.images:
        yield "There is nothing to adjust: the network has no image."
    if not len(network.observations):
        yield "There is nothing to adjust: no mark was observed. Look at the statuses and reasons of the measurement."
    for what, names in (
        ("camera", [camera.name for camera in network.cameras]),
        ("image", [image.name for image in network.images]),
        ("scanner", [scanner.name for scanner in network.scanners]),
        ("object point", [point.id for point in network.points]),
        ("board", [board.name for board in network.boards]),
    ):
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        if twice:
            others = f", and so are {', '.join(twice[1:6])}" if len(twice) > 1 else ""
            yield f"{what} {twice[0]} is given more than once{others}. Every {what} needs a name of its own."


def _camera_faults(network: Network) -> Faults:
    """Faults of cameras, and of images with an unknown camera or scanner."""
    for image in network.images:
        references: tuple[tuple[str, str, list[str]], ...] = (("camera", image.camera, list(network.camera_by_name)),)
        if image.scanner:
            references += (("scanner", image.scanner, list(network.scanner_by_name)),)
        for what, name, given in references:
            if name not in given:
                known = ", ".join(sorted(given)) or "none"
                yield f"image {image.name} is of the {what} {name}, which is not given; given: {known}."
    for camera in network.cameras:
        c, distortion = camera.principal_distance_mm, camera.distortion
        if c is not None and c.value <= 0.0:
            yield f"camera {camera.name}: the principal distance must be positive, not {c.value} mm."
        names, needed = parameter_names(distortion.family), family(distortion.family).needs
        if unknown := sorted(set(distortion.parameters) - set(names)):
            yield (
                f"camera {camera.name}: the distortion family {distortion.family} has no parameter "
                f"{', '.join(unknown)}; it has {', '.join(names) or 'none at all'}."
            )
        if needed == "r0_mm" and distortion.r0_mm <= 0.0:
            yield f"camera {camera.name}: the distortion family juhl needs r0 > 0, Juhl's is 1.35 dm."
        if needed == "half_mm" and min(distortion.half_mm) <= 0.0:
            yield (
                f"camera {camera.name}: the distortion family {distortion.family} counts in halves of the frame. Give "
                f"half_mm, two positive lengths, such as (115.0, 115.0) for an aerial camera."
            )


def _board_faults(network: Network) -> Faults:
    board_by_point: dict[str, str] = {}
    for board in network.boards:
        for id_ in board.places:
            if board_by_point.setdefault(id_, board.name) != board.name:
                yield f"point {id_} is on the boards {board_by_point[id_]} and {board.name}; it can be on one."
            if id_ in network.point_by_id and id_ not in network.known_places:
                yield (
                    f"point {id_} of board {board.name} is not known: a bend counts from flat coordinates. Give X, Y "
                    "and Z with standard deviations (0 fixes them), or leave the bend out."
                )


def _observation_faults(network: Network) -> Faults:
    """Faults of observations: inconsistent numbers of rows, unknown names."""
    observations = network.observations
    image, point, kind, count = observations.image, observations.point, observations.kind, len(observations)
    shapes = len(point), len(kind), observations.xy_mm.shape, observations.covariance_mm2.shape
    if shapes != (count, count, (count, 2), (count, 2, 2)):
        yield (
            f"The observations do not go together: {count} images, {shapes[0]} points, {shapes[1]} kinds, coordinates "
            f"of shape {shapes[2]} and covariances of shape {shapes[3]}; each needs one row an observation."
        )
    if unknown := set(image) - network.image_by_name.keys():
        row = next(i for i, name in enumerate(image) if name in unknown)
        yield f"{kind[row]} {point[row]} is observed in image {image[row]}, which is not in the network. Add the image."
    for camera, id_ in sorted(network.observed_fiducials):
        if id_ not in network.camera_by_name[camera].fiducials:
            rows = (i for i, name in enumerate(point) if name == id_ and kind[i] == "fiducial")
            shown = next(image[i] for i in rows if network.image_by_name[image[i]].camera == camera)
            yield (
                f"fiducial {id_} is observed in image {shown}, but camera {camera} has no such mark. Give its "
                f"coordinates in the camera file, or correct its id."
            )
    for id_ in sorted(network.observed_points - network.point_by_id.keys()):
        row = next(i for i, name in enumerate(point) if name == id_ and kind[i] != "fiducial")
        yield (
            f"{kind[row]} {id_} is observed in image {image[row]}, but there is no such object point. Add it to the "
            f"points (coordinates may be left blank), or correct its id."
        )


def _distance_faults(network: Network) -> Faults:
    for each in network.distances:
        what = f"the distance from {each.start} to {each.end}"
        for end in (each.start, each.end):
            if end not in network.point_by_id and end not in network.image_by_name:
                yield f"{what}: {end} is neither an object point nor an image. Correct the name."
            if end in network.point_by_id and end not in network.observed_points:
                yield f"{what}: no image shows the point {end}. Measure it, or leave the distance out."
        yield from _length_faults(what, each.start == each.end, each.value, each.sigma)
    for camera in network.cameras:
        for measured in camera.distances:
            what = f"the distance from fiducial {measured.start} to {measured.end} of camera {camera.name}"
            for end in (measured.start, measured.end):
                if end not in camera.fiducials:
                    yield f"{what}: the camera has no fiducial {end}. Correct the name."
            yield from _length_faults(what, measured.start == measured.end, measured.value_mm, measured.sigma_mm)


def _length_faults(what: str, is_closed: bool, value: float, sigma: float) -> Faults:
    if is_closed:
        yield f"{what} has the same point at both ends. Correct one of them."
    if not 0.0 < value < np.inf:
        yield f"{what} must be a positive number, not {value:g}."
    if not 0.0 < sigma < np.inf:
        yield (
            f"{what} needs a positive standard deviation, not {sigma:g}. An exact distance is not offered: "
            f"give a standard deviation of a hundredth of what its ends have, or leave it out."
        )


def _calibration_faults(network: Network) -> Faults:
    priors, given = dict[Parameter, Prior | None](), set[Parameter]()
    for camera in network.cameras:
        interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
        named: dict[str, Prior | None] = {**interior, **camera.distortion.parameters}
        priors |= {Parameter.interior(camera.name, name): prior for name, prior in named.items()}
        for id_, mark in camera.fiducials.items():
            priors |= {Parameter.fiducial(camera.name, id_, axis): getattr(mark, f"{axis}_mm") for axis in "xy"}
    sigmas = {parameter: np.inf if prior is None else prior.sigma for parameter, prior in priors.items()}
    for each in network.calibrations:
        for key in each.parameters:
            if key not in sigmas:
                yield f"an earlier calibration gives {key.label}, but no camera has that quantity. Leave it out."
            if key in given or np.isfinite(sigmas[key]):
                other = "another calibration" if key in given else f"a standard deviation of its own ({sigmas[key]:g})"
                yield (
                    f"{key.label} has an earlier calibration and {other}: the same knowledge would count twice. "
                    f"Keep one."
                )
            given.add(key)
        count = len(each.parameters)
        if each.values.shape != (count,) or each.covariance.shape != (count, count):
            yield (
                f"an earlier calibration of {count} quantities has {each.values.shape} values and a covariance of the "
                f"shape {each.covariance.shape}."
            )
        scale = np.sqrt(np.diag(each.covariance).clip(1e-300))
        if not np.linalg.eigvalsh(each.covariance / np.outer(scale, scale)).min(initial=1.0) > DEFINITE:
            yield (
                f"the covariance of an earlier calibration of {description(each.parameters[:3])} and more is not "
                f"positive definite: some of these quantities were fixed, or are not separately estimable. Fix them "
                f"here too."
            )


def _value_faults(network: Network) -> Faults:
    """Faults of values: marks observed twice in an image, invalid coordinates and covariances."""
    observations, covariance = network.observations, network.observations.covariance_mm2
    names, of_name = observations.numbered_points
    mark = (2 * network.image_numbers + observations.is_fiducial) * len(names) + of_name
    marks = np.sort(mark)
    if (marks[1:] == marks[:-1]).any():
        _, first, counts = np.unique(mark, return_index=True, return_counts=True)
        row, count = first[counts > 1][0], counts[counts > 1][0]
        what = "fiducial" if observations.is_fiducial[row] else "point"
        yield (
            f"{what} {observations.point[row]} is observed {count} times in image {observations.image[row]}. Keep one "
            f"of the rows."
        )
    finite = np.isfinite(observations.xy_mm).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = covariance[:, 0, 0] * covariance[:, 1, 1] - covariance[:, 0, 1] * covariance[:, 1, 0]
        symmetric = np.abs(covariance[:, 0, 1] - covariance[:, 1, 0]) <= 1e-9 * np.abs(covariance[:, 1, 0])
    definite = (np.einsum("nii->ni", covariance) > 0.0).all(axis=1) & (determinant > 0.0) & symmetric
    for good, what in (
        (finite, "has a coordinate or covariance that is not a finite number"),
        (
            definite,
            "has a covariance matrix that is not positive definite: its standard deviations must be positive, "
            "its correlation between -1 and 1",
        ),
    ):
        for row in np.flatnonzero(~good):
            yield f"{observations.kind[row]} {observations.point[row]} in image {observations.image[row]} {what}."


def _place_faults(network: Network) -> Faults:
    """Images whose fiducials, or object points, all lie at one place."""
    observations, numbers = network.observations, network.image_numbers
    for kind, rows in (("fiducials", observations.is_fiducial), ("targets", ~observations.is_fiducial)):
        chosen = np.flatnonzero(rows)
        if not chosen.size:
            continue
        order = chosen[np.argsort(numbers[chosen], kind="stable")]
        starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
        xy, counts = observations.xy_mm[order], np.diff([*starts, len(order)])
        is_one = (np.maximum.reduceat(xy, starts) == np.minimum.reduceat(xy, starts)).all(axis=1) & (counts > 1)
        for start, count in zip(starts[is_one], counts[is_one], strict=True):
            x, y = xy[start]
            yield (
                f"image {observations.image[order[start]]}: all its {count} {kind} are at one place, ({x:g}, {y:g}) "
                "mm. Correct them, or leave the image out."
            )


def _extent_faults(network: Network) -> Faults:
    """Marks that spread over a multiple of their frame: another unit."""
    for camera in network.cameras:
        extents = [network.extent_by_image[each.name].half_mm for each in network.images if each.camera == camera.name]
        spread_mm = 2.0 * float(np.median(extents)) if extents else 0.0
        if spread_mm > LARGEST_SPREAD * max(camera.frame_mm) > 0.0:
            width, height = camera.frame_mm
            yield (
                f"The marks of camera {camera.name} spread over {spread_mm:.4g} mm in an image, but its frame_mm is "
                f"[{width:g}, {height:g}]: one of them is in another unit. Give both in mm; pixels as col_px, row_px."
            )


def largest_sigma_mm(network: Network) -> float:
    """Largest standard deviation that may be added to those of marks: `_sigma_faults` accepts little more in all."""
    by_image = np.array([network.extent_by_image[image.name].half_mm for image in network.images])
    return 0.99 * LARGEST_SIGMA / float(np.median(1.0 / by_image[network.image_numbers]))


def _sigma_faults(network: Network) -> Faults:
    """Standard deviations of most marks that are a large part of the images, or none: another unit."""
    sigma_mm = np.sqrt(np.trace(network.observations.covariance_mm2, axis1=1, axis2=2) / 2.0)
    by_image = np.array([network.extent_by_image[image.name].half_mm for image in network.images])
    half_mm = by_image[network.image_numbers]
    if not LEAST_SIGMA <= np.median(sigma_mm / half_mm) <= LARGEST_SIGMA:
        yield (
            f"The standard deviations of the marks, {np.median(sigma_mm):.3g} mm in the middle, are "
            f"{100.0 * np.median(sigma_mm / half_mm):.2g} % of half the extent of the marks in an image: they are in "
            "another unit, or of another picture. Give them in mm (sx_mm, sy_mm) or µm (sigma_target_um)."
        )


def _part_faults(network: Network) -> Faults:
    """Faults of frames in several scans: different cameras, transformations or orientations; joins in one scan only."""
    first: dict[str, Image] = {}
    for image in network.images:
        other = first.setdefault(image.frame, image)
        exteriors = [each.exterior for each in (image, other)]
        same = exteriors[0] is exteriors[1] or (
            None not in exteriors and all(str(vars(each)) == str(vars(exteriors[0])) for each in exteriors)
        )
        alike = image.camera == other.camera and image.transformation == other.transformation and same
        if not alike or bool(image.part_of) != bool(other.part_of):
            yield (
                f"frame {image.frame}: its scans {other.name} and {image.name} differ in camera, transformation or "
                "given orientation. Parts of one frame have the same."
            )
    for (frame, point), rows in sorted(network.joins.items()):
        if len(rows) < 2:
            yield (
                f"join {point} is observed in one scan of frame {frame} only, and joins nothing. Leave it out, or "
                "measure it in another part of the frame."
            )


def _image_faults(network: Network) -> Faults:
    """Frames with too few object points or fiducials; those in several parts of a frame count once."""
    observations, of_mark = network.observations, network.observed_frames
    names, points = observations.numbered_points
    kinds = observations.has_kind("fiducial") + 2 * observations.has_kind("join")  # all others are object points
    marks = np.sort((of_mark * 3 + kinds) * len(names) + points)
    marks = marks[np.diff(marks, prepend=-1) > 0] // len(names)
    counts = np.bincount(marks, minlength=3 * len(network.images)).reshape(-1, 3).tolist()
    frames = {image.frame: image for image in network.images}
    for (frame, image), (targets, fiducials, _) in zip(frames.items(), counts[: len(frames)], strict=True):
        needed = marks_needed(image.transformation)
        fewest = fewest_marks(image.transformation) if targets else needed
        if fiducials < fewest:
            alone = f", {needed} where its targets tell nothing of it" if needed > fewest else ""
            yield (
                f"image {frame} shows {fiducials} fiducial marks; its {image.transformation} transformation needs "
                f"{fewest}{alone}. Measure more of them, choose a transformation that needs fewer, or leave the image "
                "out."
            )
        if not targets and not fiducials:
            yield f"image {frame} shows neither fiducial marks nor object points. Leave the image out."
        if 0 < targets < TARGETS_NEEDED and not image.is_observed:
            yield (
                f"image {frame} shows {targets} object points; its exterior orientation needs {TARGETS_NEEDED}. "
                "Measure more targets in it, give its orientation with standard deviations, or leave its targets out: "
                "its fiducial marks alone give its film transformation."
            )
