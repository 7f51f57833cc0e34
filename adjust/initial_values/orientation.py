"""Initial exterior orientations and object points: given, from known points, or from the images alone."""

from collections.abc import Mapping, Sequence

import numpy as np

from adjust.array_types import Array
from adjust.errors import AdjustmentError, UnorientedError
from adjust.functional_model.rotation import rotation_from_angles
from adjust.initial_values.model_formation import (
    Block,
    extend,
    intersected,
    known_field,
    orient_free_model,
)
from adjust.initial_values.pose import Pose, Sight, image_distances
from adjust.initial_values.resection import resect_images
from adjust.problem.network import Exterior, Network
from adjust.problem.observations import Distance

CLEARLY_WORSE = 5.0  # ratio of the median residuals above which a resection replaces a given orientation


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
    block = Block(sights, firm, rough, dict(resected))
    for image in network.images:
        if image.exterior is not None and image.name in sights:
            block.poses[image.name] = _given_or_resected(image.exterior, block, image.name)
    extend(block)
    if sights and not block.poses:
        block.poses.update(orient_free_model(sights, block.firm))
        extend(block)
        if all(np.isnan(xyz).all() for xyz in block.rough.values()):
            _scale_by_distances(block, network.distances)
    missing = sorted(name for name in sights if name not in block.poses)
    if missing:
        raise UnorientedError({name: _why_not_oriented(block, name) for name in missing})
    return block.poses, _all_points(block)


def _given_or_resected(exterior: Exterior, block: Block, image: str) -> Pose:
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


def _scale_by_distances(block: Block, distances: Sequence[Distance]) -> None:
    """Scale a model of arbitrary base by the median ratio of the measured distances to those in the model."""
    places = {image: pose.center for image, pose in block.poses.items()} | block.points
    ratios = [
        each.value / np.linalg.norm(places[each.end] - places[each.start])
        for each in distances
        if each.start in places and each.end in places
    ]
    if ratios:
        scale = float(np.median(ratios))
        block.poses = {image: Pose(pose.rotation, scale * pose.center) for image, pose in block.poses.items()}
        block.points = {point: scale * xyz for point, xyz in block.points.items()}


def _all_points(block: Block) -> dict[str, Array]:
    """Coordinates of every point: known, else intersected, else the given approximation."""
    points = {**block.rough, **intersected(block, 0.0)}
    nowhere = np.isnan(np.array(list(points.values())).reshape(-1, 3)).any(axis=1)
    unknown = {name for name, is_nowhere in zip(points, nowhere, strict=True) if is_nowhere}
    for name in sorted(unknown):
        showing = [image for image in sorted(block.sights) if name in block.sights[image].points]
        if showing:
            raise AdjustmentError(_why_not_intersected(name, showing))
    return {name: xyz for name, xyz in points.items() if name not in unknown}


def _why_not_intersected(point: str, images: Sequence[str]) -> str:
    if len(images) == 1:
        return (
            f"point {point} is unknown and measured in image {images[0]} only; two images are needed to find it. "
            "Measure it in another image, give its coordinates, or leave it out."
        )
    return (
        f"point {point} is unknown, and its rays from images {', '.join(images)} do not meet in front of the cameras. "
        "Check its number in these images, or give approximate coordinates."
    )


def _why_not_oriented(block: Block, image: str) -> str:
    sight = block.sights[image]
    xyz = known_field(sight, {**block.rough, **block.points}).xyz
    remedy = f"measure more known points, or give the orientation of image {image}."
    if not block.poses and len(xyz) < 3:
        return (
            f"image {image} sees {len(xyz)} known points, no other image sees enough either, and the images alone make "
            "no model that could be placed: that takes 8 common points of two images, and 7 known coordinates (X and Y "
            f"of two points and three heights, say). Either add these, {remedy}"
        )
    if len(xyz) < 3:
        return f"image {image} sees {len(xyz)} known points; resection needs 3, and 4 to be unique. Either {remedy}"
    if len(xyz) == 3:
        return f"image {image} sees 3 known points, which leave several orientations or none. Either {remedy}"
    which = " (four points do not tell which of them is wrong)" if len(xyz) == 4 else ""
    return (
        f"image {image} sees {len(xyz)} known points, but no orientation brings them where they were measured, or they "
        f"lie on one line. Check the point numbers and coordinates{which}, the principal distance and the sign of y, "
        f"or {remedy}"
    )
