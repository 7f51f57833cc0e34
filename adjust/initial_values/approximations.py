"""Initial values of an adjustment, computed from the network: the user need not supply approximations.

Exterior orientations are given, or follow from known points, or from the images alone. The parts of a frame are
transformed one after the other into the comparator system of the first, by a similarity fitted to the points in common
with the parts placed so far. All fiducial marks of the frame then determine its film transformation, as if it had been
scanned at once; that of each part follows from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from adjust.array_types import Array, Indices
from adjust.errors import AdjustmentError, UnorientedError
from adjust.functional_model.families import family
from adjust.functional_model.lens import Lens
from adjust.functional_model.rotation import angles_from_rotation, angles_near, rotation_from_angles
from adjust.functional_model.transformation import LATTICE, film_kind, fit_transformation
from adjust.initial_values.model_formation import BlockState, extend, intersect_points, known_field, orient_free_model
from adjust.initial_values.pose import KnownField, Pose, Sight, image_distances
from adjust.initial_values.resection import (
    FEWEST,
    find_interior_orientation,
    find_principal_distance,
    find_wide_distance,
    resect_images,
)
from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Exterior, Image, Network
from adjust.problem.observations import Observations
from adjust.problem.unknowns import Reduction
from adjust.validation import validate

ON_A_LINE = 1e-6  # second extent of the known points over the first below which they lie on a line
FAR_APART = 20.0  # gap between two groups of points, in the extent of the larger one, by which they are far apart
MOST_FOLDED = 0.05  # largest fraction of points outside the invertible range of the distortion (gross errors)
CLEARLY_WORSE = 5.0  # ratio of the median residuals above which a resection replaces a given orientation
MOST_UNMET = 0.25  # share of points whose rays may not meet: more have another cause than mismatches
FEWEST_COMMON = 3  # common points of two parts: a mirrored similarity fits two points as well

FilmFit = tuple[Array, bool]  # parameters, and whether the scan is mirrored
Mark = tuple[str, str]  # kind and point


@dataclass(frozen=True, eq=False)
class Frames:
    """Object points of all images in the fiducial system, image by image, sorted by point name within each."""

    network: Network
    rows: Indices  # (n,) numbers of the observations
    xy_mm: Array  # (n, 2) image coordinates
    starts: Indices  # (images + 1,) index of the first point of each image; the last is n
    sigma_mm: Array  # (images,) median standard deviation of an image coordinate; 0 for an image without points

    def part(self, image: int) -> slice:
        return slice(int(self.starts[image]), int(self.starts[image + 1]))

    def camera_images(self, camera: str) -> list[int]:
        """Numbers of the camera's images that show object points."""
        images = enumerate(self.network.images)
        return [i for i, image in images if image.camera == camera and self.starts[i] < self.starts[i + 1]]

    def places(self, images: list[int]) -> Indices:
        """Indices of the points of the given images, one image after the other."""
        return np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in images])

    def sights(self, camera: str, lens: Lens) -> dict[str, Sight]:
        """Reduce the images of a camera to the principal point and correct them for distortion; by image name.

        Coordinates outside the invertible range of the distortion are not corrected for it.
        """
        images, names = self.camera_images(camera), self.network.observations.point
        if not images:
            return {}
        at = self.places(images)
        ideal, found = lens.ideal_from_observed(self.xy_mm[at])
        freed_mm = np.empty_like(self.xy_mm)
        freed_mm[at] = np.where(found[:, None], ideal, self.xy_mm[at]) - lens.interior[1:]
        return {
            self.network.images[i].name: Sight(
                tuple([names[row] for row in self.rows[self.part(i)].tolist()]),
                freed_mm[self.part(i)],
                float(lens.interior[0]),
                float(self.sigma_mm[i]),
            )
            for i in images
        }


def approximate(network: Network) -> Approximations:
    """Compute the initial values of an adjustment.

    Returns
    -------
    Film transformations, interior and exterior orientations, and unknown object points.

    Raises
    ------
    AdjustmentError
        If a value cannot be determined. The message names the image, camera or point, and the remedy.

    Notes
    -----
    Film transformations are fitted to the fiducial marks. An unknown principal distance follows from space resections
    on the known points. Exterior orientations are taken as given, or follow from robust space resection, image after
    image, in turn with the intersection of points from the oriented images. Where there is too little control for the
    first resection, a model is formed from the images alone. The result does not depend on the order of images, points
    and observations. An image that shows only fiducials gets its film transformation and nothing else. A frame that was
    scanned in parts is treated as one image.
    """
    validate(network)
    return initial_values(network)


def initial_values(network: Network) -> Approximations:
    """Compute the initial values of a validated network; see `approximate`."""
    reduction = Reduction.to_centroid(network)
    return reduction.inverse.approximations(_initial_values(reduction.network(network)))


def _initial_values(network: Network) -> Approximations:
    if any(image.part_of for image in network.images):
        return _joined_values(network)
    films = _film_transformations(network)
    transformation, mirrored = _film_parameters(films)
    frames = camera_frames(network, transformation, mirrored)
    used = [camera for camera in network.cameras if camera.name not in network.idle_cameras]
    resected = dict[str, Pose]()
    interior = {camera.name: _interior(camera, frames, resected) for camera in used}
    sights = {name: sight for camera in used for name, sight in _sights(camera, frames, interior[camera.name]).items()}
    poses, points = orient(network, sights, resected)
    images = [image for image in network.images if image.name in poses]
    rotations = np.array([poses[image.name].rotation for image in images]).reshape(-1, 3, 3)
    nearby = angles_from_rotation(rotations)
    for angles, image in zip(nearby, images, strict=True):
        if image.exterior is not None:  # of equivalent angles those nearest to the given ones
            angles[:] = image.exterior.values[3:]
    own_angles = zip(images, angles_near(rotations, nearby), strict=True)
    return Approximations(
        interior=interior,
        exterior={image.name: np.concatenate([poses[image.name].center, angles]) for image, angles in own_angles},
        transformation=transformation,
        points=points,
        mirrored=mirrored,
    )


def _joined_values(network: Network) -> Approximations:
    """Initial values of a network with frames scanned in parts: whole frames first, then their parts."""
    films, joins = dict[str, FilmFit](), dict[tuple[str, str], Array]()
    by_name = sorted(
        (image for image in network.images if image.part_of), key=lambda image: (image.part_of, image.name)
    )
    for frame, parts in groupby(by_name, key=lambda image: image.part_of):
        of_parts, in_camera = joined_frame(network, list(parts))
        films |= of_parts
        joins |= {(frame, point): xy for point, xy in in_camera.items()}
    films |= _film_transformations(network)
    whole = whole_frames(network, films)
    found = _initial_values(whole) if whole.images else Approximations({}, {}, {}, {})
    transformation, mirrored = _film_parameters(films)
    return replace(
        found,
        exterior={image.name: found.exterior[image.frame] for image in network.images if image.frame in found.exterior},
        transformation=transformation,
        mirrored=mirrored,
        joins=joins,
    )


def _film_parameters(films: Mapping[str, FilmFit]) -> tuple[dict[str, Array], frozenset[str]]:
    """Parameters by image, and the names of the mirrored scans."""
    mirrored = frozenset(name for name, (_, is_mirrored) in films.items() if is_mirrored)
    return {name: parameters for name, (parameters, _) in films.items()}, mirrored


def _film_transformations(network: Network) -> dict[str, FilmFit]:
    """Fit the film transformations of frames in a single scan: {image name: (parameters, mirrored)}."""
    observations = network.observations
    rows = np.flatnonzero(observations.is_fiducial)
    rows = rows[np.lexsort((np.array([observations.point[row] for row in rows]), network.image_numbers[rows]))]
    starts = np.searchsorted(network.image_numbers[rows], np.arange(len(network.images) + 1))
    films = {}
    for image, start, stop in zip(network.images, starts[:-1], starts[1:], strict=True):
        if image.part_of:
            continue
        given = network.camera_by_name[image.camera].fiducials
        marks = [given[observations.point[row]] for row in rows[start:stop]]
        camera_mm = np.array([[mark.x_mm.value, mark.y_mm.value] for mark in marks]).reshape(-1, 2)
        comparator_mm = network.straight_xy_mm[rows[start:stop]]
        films[image.name] = fit_transformation(image.transformation, comparator_mm, camera_mm)
    return films


def _interior(camera: Camera, frames: Frames, resected: dict[str, Pose]) -> Array:
    """c, x0', y0' (3,) in mm; adds the poses found together with the principal distance, by image."""
    x0, y0 = (
        center if prior is None else prior.value
        for prior, center in zip((camera.x0_mm, camera.y0_mm), camera.center_mm, strict=True)
    )
    given, is_pinhole = camera.principal_distance_mm, family(camera.distortion.family).is_pinhole_at_zero
    # One without weight is an approximation: far off, it may lead to a wrong minimum, with images tilted the other way.
    if given is not None and (np.isfinite(given.sigma) or not is_pinhole):
        return np.array([given.value, x0, y0])
    of_images = _known_fields(camera, frames, np.array([x0, y0]))
    fields = list(of_images.values())
    if is_pinhole:
        found, poses = find_principal_distance(fields)
        values, sigmas = frames.network.point_priors
        has_approximate_points = bool((np.isinf(sigmas) & ~np.isnan(values)).any())  # which the adjustment does not use
        if found is not None and not camera.distortion.values.any() and not has_approximate_points:
            resected |= {name: poses[field] for name, field in of_images.items() if field in poses}
    else:
        found = find_wide_distance(fields, camera.distortion)
    if found is None and given is not None:
        found = given.value
    if found is None and all(prior is None or np.isinf(prior.sigma) for prior in (camera.x0_mm, camera.y0_mm)):
        # Far off the middle of the picture, the principal point has to be found together with it.
        together = find_interior_orientation(fields) if is_pinhole else None
        if together is not None:
            return np.array([0.0, x0, y0]) + together
    if found is None:
        why = _why_no_distance(fields)
        raise AdjustmentError(f"the principal distance of camera {camera.name} cannot be found from its images: {why}")
    return np.array([found, x0, y0])


def _why_no_distance(fields: Sequence[KnownField]) -> str:
    """Explain why images of known points do not determine the principal distance, and name the remedy."""
    if not any(len(field.xyz) >= FEWEST for field in fields):
        return (
            f"none shows {FEWEST} points whose X, Y and Z are known. Give an approximate principal_distance_mm, or the "
            "coordinates of more points."
        )
    if where := _collinearity_words(np.concatenate([field.xyz for field in fields])):
        return f"all known points that they show lie {where}. Correct their coordinates."
    if groups := _far_groups_words(np.concatenate([field.xyz for field in fields])):
        return f"{groups}: those of one may be in another coordinate system. Correct their coordinates."
    return (
        "they see too few known points, or look straight at a flat field, where a longer principal distance is a "
        "larger distance from the field. Take images tilted by 20 to 40 degrees in different directions, or give "
        "principal_distance_mm with its standard deviation (0 fixes it)."
    )


def _far_groups_words(xyz: Array) -> str:
    """Whether points (n, 3) lie in two groups far apart for their extents, in words; "" if not."""
    for axis, name in enumerate("XYZ"):
        values = np.unique(xyz[:, axis])
        gap = int(np.argmax(np.diff(values))) if len(values) > 1 else 0
        below, above = values[: gap + 1], values[gap + 1 :]
        if len(above) and above[0] - below[-1] > FAR_APART * max(np.ptp(below), np.ptp(above)) > 0.0:
            return (
                f"their known points lie in two groups, with {name} from {below[0]:.10g} to {below[-1]:.10g} and from "
                f"{above[0]:.10g} to {above[-1]:.10g}"
            )
    return ""


def _collinearity_words(xyz: Array) -> str:
    """Whether points (n, 3) lie on one line or at one place, in words; "" if neither."""
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[1] > ON_A_LINE * extents[0]:
        return ""
    return "on one line" if extents[0] > 0.0 else "at one place"


def _known_fields(camera: Camera, frames: Frames, principal_point_mm: Array) -> dict[str, KnownField]:
    """For each image of a camera, sorted by name, the points of which X, Y and Z are known."""
    network = frames.network
    names, number = network.observations.numbered_points
    given, nowhere = network.coordinates(firm=False), np.full(3, np.nan)
    xyz = np.array([given.get(name, nowhere) for name in names])[number[frames.rows]]
    is_known = ~np.isnan(xyz).any(axis=1)
    fields = {}
    for i in sorted(frames.camera_images(camera.name), key=lambda i: network.images[i].name):
        part, known = frames.part(i), is_known[frames.part(i)]
        xy_mm = frames.xy_mm[part][known] - principal_point_mm
        fields[network.images[i].name] = KnownField(xyz[part][known], xy_mm, frames.sigma_mm[i])
    return fields


def _sights(camera: Camera, frames: Frames, interior: Array) -> dict[str, Sight]:
    """Correct the image coordinates of a camera for its prior distortion."""
    # Raises AdjustmentError where this distortion is not invertible within an image (it folds the image over), and
    # UnorientedError with the images that show what lies too far off the axis of a fisheye.
    known = camera.distortion.parameters
    lens = Lens(camera.distortion, interior, camera.distortion.values)
    images = frames.camera_images(camera.name)
    folds = lens.folded_over(frames.xy_mm[frames.places(images)])
    first, too_wide = np.cumsum([0, *np.diff(frames.starts)[images]]), dict[str, str]()
    for i, start, stop in zip(images, first[:-1], first[1:], strict=True) if folds.any() else ():
        folded = folds[start:stop]
        if folded.mean() > MOST_FOLDED:
            radius_mm = float(np.linalg.norm(frames.xy_mm[frames.part(i)][folded] - interior[1:], axis=1).min())
            given = [name for name in lens.quantities if name in known and known[name].value]
            values = ", ".join(f"{name} = {known[name].value:g}" for name in given)
            if camera.distortion.family == "opencv_fisheye" and not given:
                name = frames.network.images[i].name
                too_wide[name] = (
                    f"image {name} shows {folded.sum()} of its {len(folded)} points 90 degrees and more off the axis, "
                    "where the model of a fisheye has no image. Leave these points out."
                )
                continue
            raise AdjustmentError(
                f"camera {camera.name}: the distortion that is given ({values or 'all 0'}) folds the image over: from "
                f"{radius_mm:.3g} mm off the principal point on, what lies farther out would appear farther in, and "
                f"{folded.sum()} of the {len(folded)} points of an image were measured there. Correct the signs, the "
                "units or the family of these values, the principal point or c, or begin with 0."
            )
    if too_wide:
        raise UnorientedError(too_wide)
    return frames.sights(camera.name, lens)


def orient(
    network: Network, sights: Mapping[str, Sight], resected: Mapping[str, Pose]
) -> tuple[dict[str, Pose], dict[str, Array]]:
    """Determine the poses of all images, and the coordinates (3,) of all points that are observed or fully known.

    resected: poses of images that are known already; a given orientation comes first.

    Raises
    ------
    UnorientedError
        If images cannot be oriented.
    AdjustmentError
        If a point cannot be intersected.
    """
    firm, rough = (network.coordinates(firm) for firm in (True, False))
    block = BlockState(sights, firm, rough, dict(resected))
    for image in network.images:
        if image.exterior is not None and image.name in sights:
            block.poses[image.name] = _given_or_resected(image.exterior, block, image.name)
    extend(block)
    if sights and not block.poses:
        block.poses.update(orient_free_model(sights, block.firm))
        extend(block)
        if all(np.isnan(xyz).all() for xyz in block.rough.values()):  # the base of the model is arbitrary
            places = {image: pose.center for image, pose in block.poses.items()} | block.points
            measured = [each for each in network.distances if each.start in places and each.end in places]
            if measured:
                lengths = [np.linalg.norm(places[each.end] - places[each.start]) for each in measured]
                ratios = [each.value / length for each, length in zip(measured, lengths, strict=True)]
                scale = float(np.median(ratios))
                block.poses = {image: Pose(pose.rotation, scale * pose.center) for image, pose in block.poses.items()}
                block.points = {point: scale * xyz for point, xyz in block.points.items()}
    missing = sorted(name for name in sights if name not in block.poses)
    if missing:
        known = {**block.rough, **block.points}
        few = [name for name in missing if len(known_field(block.sights[name], known).xyz) < FEWEST]
        raise UnorientedError({name: _why_not_oriented(block, name) for name in missing}, few)
    return block.poses, _all_points(block)


def _given_or_resected(exterior: Exterior, block: BlockState, image: str) -> Pose:
    """The given orientation; a resection instead if known points contradict it and it is not fixed."""
    given = Pose(rotation_from_angles(exterior.values[3:]), exterior.center)
    field, c = known_field(block.sights[image], block.firm), block.sights[image].principal_distance_mm
    if (exterior.sigmas == 0).any() or len(field.xyz) < 4:
        return given
    found = resect_images([field], [c])[0]
    if found is None:
        return given
    left_given, left_found = (np.median(image_distances(pose, field.xyz, field.xy_mm, c)) for pose in (given, found))
    return found if left_given > CLEARLY_WORSE * max(left_found, block.sights[image].sigma_mm) else given


def _all_points(block: BlockState) -> dict[str, Array]:
    """Coordinates of every point: known, else intersected, else the given approximation.

    A few whose rays do not meet are placed on a ray, as far away as points are: the mismatches are found later.
    """
    points = {**block.rough, **intersect_points(block, 0.0)}
    nowhere = np.isnan(np.array(list(points.values())).reshape(-1, 3)).any(axis=1)
    unknown = {name for name, is_nowhere in zip(points, nowhere, strict=True) if is_nowhere}
    found = {name: xyz for name, xyz in points.items() if name not in unknown}
    for name in sorted(unknown):
        showing = [image for image in sorted(block.sights) if name in block.sights[image].points]
        if len(showing) == 1:
            raise AdjustmentError(
                f"point {name} is unknown and measured in image {showing[0]} only; two images are needed to find it. "
                "Measure it in another image, give its coordinates, or leave it out."
            )
        if showing and len(unknown) > MOST_UNMET * len(points):
            raise AdjustmentError(
                f"point {name} is unknown, and its rays from images {', '.join(showing)} do not meet in front of the "
                "cameras. Check its number in these images, or give approximate coordinates."
            )
        if showing:
            sight, pose = block.sights[showing[0]], block.poses[showing[0]]
            ray = sight.rays[sight.points.index(name)] @ pose.rotation
            met = np.array([points[other] for other in sight.points if other not in unknown]).reshape(-1, 3)
            away = float(np.median(np.linalg.norm(met - pose.center, axis=1))) if len(met) else 1.0
            found[name] = pose.center + away * ray / np.linalg.norm(ray)
    return found


def _why_not_oriented(block: BlockState, image: str) -> str:
    sight = block.sights[image]
    xyz = known_field(sight, {**block.rough, **block.points}).xyz
    remedy = f"measure more known points, or give the orientation of image {image}."
    if not block.poses and len(xyz) < FEWEST:
        return (
            f"image {image} sees {len(xyz)} known points, no other image sees enough either, and the images alone make "
            "no model that could be placed: that takes 8 common points of two images, and 7 known coordinates (X and Y "
            f"of two points and three heights, say). Either add these, {remedy}"
        )
    if len(xyz) < FEWEST:
        return f"image {image} sees {len(xyz)} known points, and resection needs {FEWEST} to be unique. Either {remedy}"
    if where := _collinearity_words(xyz):
        return (
            f"image {image} sees {len(xyz)} known points, and all lie {where}. Correct their coordinates, or {remedy}"
        )
    which = " (four points do not tell which of them is wrong)" if len(xyz) == 4 else ""
    return (
        f"image {image} sees {len(xyz)} known points, but no orientation brings them where they were measured. "
        f"Check the point numbers and coordinates{which}, the principal distance and the sign of y, "
        f"or {remedy}"
    )


def camera_frames(network: Network, transformation: Mapping[str, Array], mirrored: frozenset[str]) -> Frames:
    """Transform the object points of all images into the fiducial system.

    transformation: parameters of the film transformation by image name; mirrored: names of the mirrored scans.
    """
    observations, count = network.observations, len(network.images)
    names, number = observations.numbered_points
    rank = np.empty(len(names), dtype=np.intp)
    rank[np.argsort(np.array(names), kind="stable")] = np.arange(len(names))
    rows = np.flatnonzero(~observations.is_fiducial)
    rows = rows[np.lexsort((rank[number[rows]], network.image_numbers[rows]))]
    images = network.image_numbers[rows]
    starts = np.searchsorted(images, np.arange(count + 1))
    xy_mm = network.straight_xy_mm[rows]
    for i, image in enumerate(network.images):
        if image.transformation != "none":
            part, kind = slice(starts[i], starts[i + 1]), film_kind(image.transformation, image.name in mirrored)
            xy_mm[part] = kind.apply(transformation[image.name], xy_mm[part])
    variances = np.zeros(count)
    if len(rows):  # medians by image
        ordered = np.trace(observations.covariance_mm2[rows], axis1=1, axis2=2) / 2.0
        ordered, counts = ordered[np.lexsort((ordered, images))], np.diff(starts)
        middle = np.minimum([starts[:-1] + (counts - 1) // 2, starts[:-1] + counts // 2], len(rows) - 1)
        variances = np.where(counts > 0, ordered[middle].mean(axis=0), 0.0)
    return Frames(network, rows, xy_mm, starts, np.sqrt(variances))


def joined_frame(network: Network, parts: Sequence[Image]) -> tuple[dict[str, FilmFit], dict[str, Array]]:
    """Film transformations of the parts of one frame by name, and its joins (2,) in the fiducial system, mm, by point.

    Raises AdjustmentError if the parts have too few points in common, or the frame has too few fiducial marks.
    """
    observations, marks_by_part = network.observations, dict[str, dict[Mark, Array]]()
    for part in parts:
        rows = np.flatnonzero(network.image_numbers == network.images.index(part))
        by_mark = {(observations.kind[row], observations.point[row]): network.straight_xy_mm[row] for row in rows}
        marks_by_part[part.name] = {mark: by_mark[mark] for mark in sorted(by_mark)}
    first_from, place = _placed_points(parts[0].part_of, marks_by_part)
    given = network.camera_by_name[parts[0].camera].fiducials
    marks = sorted(point for kind, point in place if kind == "fiducial")
    camera_mm = np.array([[given[mark].x_mm.value, given[mark].y_mm.value] for mark in marks]).reshape(-1, 2)
    first_mm = np.array([place["fiducial", mark] for mark in marks]).reshape(-1, 2)
    kind = parts[0].transformation
    parameters, mirrored = fit_transformation(kind, first_mm, camera_mm)
    whole = film_kind(kind, mirrored)
    films = {}
    for part in parts:
        xy_mm = np.array(list(marks_by_part[part.name].values()))
        lattice = (xy_mm.min(axis=0) + xy_mm.max(axis=0)) / 2 + np.ptp(xy_mm, axis=0) / 2 * LATTICE
        turned, is_mirrored = first_from[part.name]
        in_first = film_kind("similarity", is_mirrored).apply(turned, lattice)
        films[part.name] = fit_transformation(kind, lattice, whole.apply(parameters, in_first))
    joins = [(point, xy) for (what, point), xy in place.items() if what == "join"]
    in_camera = whole.apply(parameters, np.array([xy for _, xy in joins]).reshape(-1, 2))
    return films, {point: xy for (point, _), xy in zip(joins, in_camera, strict=True)}


def _placed_points(
    frame: str, marks_by_part: Mapping[str, Mapping[Mark, Array]]
) -> tuple[dict[str, FilmFit], dict[Mark, Array]]:
    """Place the parts in the comparator system of the first; the part with most common points comes next."""
    # Returns the similarity of each part, and the coordinates (2,) of all marks in the system of the first.
    left = list(marks_by_part)
    films: dict[str, FilmFit] = {left[0]: (np.array([0.0, 0.0, 1.0, 0.0]), False)}
    place = dict(marks_by_part[left.pop(0)])
    while left:
        name = max(left, key=lambda name: len(place.keys() & marks_by_part[name].keys()))
        own, common = marks_by_part[name], sorted(place.keys() & marks_by_part[name].keys())
        if len(common) < FEWEST_COMMON:
            raise AdjustmentError(
                f"frame {frame}: its scan {name} has {len(common)} points in common with {', '.join(films)}; joining "
                f"them takes {FEWEST_COMMON}, and more to be checked. Scan the frame in parts that overlap, measure "
                "crosses that both show, or leave the scan out."
            )
        in_part, in_first = (np.array([where[mark] for mark in common]) for where in (own, place))
        films[name] = fit_transformation("similarity", in_part, in_first)
        moved = film_kind("similarity", films[name][1]).apply(films[name][0], np.array(list(own.values())))
        place |= {mark: xy for mark, xy in zip(own, moved, strict=True) if mark not in place}
        left.remove(name)
    return films, place


def whole_frames(network: Network, films: Mapping[str, FilmFit]) -> Network:
    """Reduce a network to whole frames, with each point measured once and in the fiducial system.

    The result holds the frames that show object points, without film transformations, join points and fiducial marks.
    """
    first: dict[str, Image] = {}
    for image in network.images:
        if image.name not in network.objectless_images:
            first.setdefault(image.frame, image)
    frames, observations = camera_frames(network, *_film_parameters(films)), network.observations
    xy_mm = network.straight_xy_mm.copy()
    xy_mm[frames.rows] = frames.xy_mm
    frame_of = {image.name: image.frame for image in network.images}
    kept: dict[tuple[str, str], int] = {}
    for row in np.flatnonzero(~observations.is_fiducial):
        kept.setdefault((frame_of[observations.image[row]], observations.point[row]), int(row))
    rows = np.array(list(kept.values()), dtype=np.intp)
    return replace(
        network,
        images=tuple(Image(frame, image.camera, "none", image.exterior) for frame, image in first.items()),
        observations=Observations(
            tuple(frame for frame, _ in kept),
            tuple(point for _, point in kept),
            tuple(observations.kind[row] for row in rows),
            xy_mm[rows],
            observations.covariance_mm2[rows],
        ),
        distances=tuple(
            replace(each, start=frame_of.get(each.start, each.start), end=frame_of.get(each.end, each.end))
            for each in network.distances
        ),
        calibrations=(),
        scanners=(),
    )
