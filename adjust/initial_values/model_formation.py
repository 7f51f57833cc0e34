"""Model formation: relative orientation of two images, extension by resection and intersection, absolute orientation.

The known coordinates are needed for the absolute orientation only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from adjust.array_types import Array, Mask
from adjust.functional_model.rotation import rotation_from_vector
from adjust.initial_values.pose import KnownField, Pose, Sight, image_distances, intersect
from adjust.initial_values.resection import FEWEST, resect_images

SAMPLES = 150
CANDIDATES = 4  # poses returned: must include both interpretations of a flat scene
REAL = 1e-6  # largest relative imaginary part of a real root

# The monomials in x, y, z of Stewénius's elimination: ten cubic ones, then the basis of the quotient ring.
CUBIC = ((3, 0, 0), (2, 1, 0), (1, 2, 0), (0, 3, 0), (2, 0, 1), (1, 1, 1), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3))
BASIS = ((2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
POWERS = np.array([*CUBIC, *BASIS])
CUBIC_TIMES_X = (0, 1, 2, 4, 5, 7)  # cubic monomials that equal x times the first six of the basis
BASIS_TIMES_X = (0, 1, 3, 6)  # members of the basis that equal x times x, y, z, 1
STARTS = 400  # trial attitudes, some 25 degrees apart
REFINED = 12
AS_GOOD = 1e-5  # excess sum of squares, relative to that of the coordinates, of a solution as good as the best
REWEIGHTINGS = 6  # for the least sum of distances
SINGULAR = 1e-6  # smallest singular value of the derivatives by the rotation, relative to the norm of the coordinates
SURE_RESECTION = 6  # points of a trustworthy resection; one with fewer is postponed
WELL_DETERMINED = 1e-3  # determination (see intersect) from which an intersected point may orient further images
FEWEST_SHARED = 8  # common points from which the relative orientation of two images has some redundancy
PAIRS = 3  # pairs of images tried as the start of a model


def relative_poses(first: Array, second: Array, rng: np.random.Generator) -> list[Pose]:
    """Determine the relative orientation of two images robustly.

    Parameters
    ----------
    first, second : (n, 3) rays to the same points in the two camera frames, n >= 5.

    Returns
    -------
    Poses of the second image, the best first, with the first image at the origin with rotation I and a base of 1.

    Notes
    -----
    Essential matrices of random samples of five points (Stewénius, Engels and Nistér 2006) are ranked by the smaller
    half of the coplanarity errors. Of the four poses of each, the one with most points in front of both cameras is
    taken.
    """
    first, second = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (first, second))
    samples = np.array([rng.choice(len(first), 5, replace=False) for _ in range(SAMPLES)])
    essential = _essential_matrices(first[samples], second[samples])
    if not len(essential):
        return []
    half = (len(first) + 6) // 2
    cost = np.sort(_coplanarity(essential, first, second), axis=1)[:, :half].sum(axis=1)
    poses: list[Pose] = []
    for number in np.argsort(cost, kind="stable"):
        pose = _pose(essential[number], first, second)
        if all(_angle(pose, other) > 0.05 for other in poses):
            poses.append(pose)
        if len(poses) == CANDIDATES:
            break
    return poses


def _essential_matrices(first: Array, second: Array) -> Array:
    """All real essential matrices (k, 3, 3) of samples (m, 5, 3): second' E first = 0."""
    coplanarity = np.einsum("msi,msj->msij", second, first).reshape(len(first), 5, 9)
    null = np.linalg.svd(coplanarity)[2][:, 5:].reshape(-1, 4, 3, 3)
    coefficients = _constraint_coefficients(null)
    regular = np.abs(np.linalg.det(coefficients[:, :, :10])) > np.finfo(float).tiny
    null, coefficients = null[regular], coefficients[regular]
    reduced = np.linalg.solve(coefficients[:, :, :10], coefficients[:, :, 10:])
    action = np.zeros((len(null), 10, 10))
    action[:, :6] = -reduced[:, CUBIC_TIMES_X]
    action[:, [6, 7, 8, 9], BASIS_TIMES_X] = 1.0
    vectors = np.asarray(np.linalg.eig(action)[1], dtype=np.complex128)  # (m, 10, 10), a column a solution
    with np.errstate(divide="ignore", invalid="ignore"):
        unknowns = vectors[:, 6:9] / vectors[:, 9:]
    real = np.logical_and.reduce(np.abs(unknowns.imag) <= REAL * (1.0 + np.abs(unknowns.real)), axis=1)
    weights = np.concatenate([unknowns.real, np.ones((len(null), 1, 10))], axis=1)
    matrices = np.einsum("mws,mwij->msij", np.where(real[:, np.newaxis], weights, 0.0), null)[real]
    return np.asarray(matrices / np.linalg.norm(matrices, axis=(1, 2), keepdims=True))


def _constraint_coefficients(null: Array) -> Array:
    """Coefficients (m, 10, 20) of det E = 0 and 2 E E' E - tr(E E') E = 0, E = x N1 + y N2 + z N3 + N4."""
    # By interpolation: the constraints are evaluated at twenty points and the system of monomials is solved.
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))
    monomials = (places[:, None, :] ** POWERS).prod(axis=2)
    weights = np.column_stack([places, np.ones(20)])
    essential = np.einsum("pw,mwij->mpij", weights, null)
    product = essential @ np.swapaxes(essential, 2, 3)
    trace = np.trace(product, axis1=2, axis2=3)[..., None, None]
    cubic = (2.0 * product @ essential - trace * essential).reshape(len(null), 20, 9)
    values = np.concatenate([cubic, np.linalg.det(essential)[..., None]], axis=2)
    return np.asarray(np.swapaxes(np.linalg.solve(monomials, values), 1, 2))


def _coplanarity(essential: Array, first: Array, second: Array) -> Array:
    """Approximate squared angles (k, n) between rays and epipolar planes (Sampson's distance on the sphere)."""
    right, left = first @ np.swapaxes(essential, 1, 2), second @ essential
    error = (second * right).sum(axis=2)
    slope = ((right - error[..., None] * second) ** 2).sum(axis=2) + ((left - error[..., None] * first) ** 2).sum(
        axis=2
    )
    return np.asarray(error**2 / np.maximum(slope, np.finfo(float).tiny))


def _pose(essential: Array, first: Array, second: Array) -> Pose:
    """The one of the four poses of an essential matrix with most points in front of both cameras."""
    u, _, vt = np.linalg.svd(essential)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotations = [u @ w @ vt * np.sign(np.linalg.det(u @ vt)) for w in (turn, turn.T)]
    poses = [Pose(rotation, sign * rotation.T @ u[:, 2]) for rotation in rotations for sign in (1.0, -1.0)]
    in_front = []
    for pose in poses:
        # Least squares of s first - t turned = center, times the positive determinant 1 - cosine².
        turned = second @ pose.rotation
        cosine = (first * turned).sum(axis=1)
        along_first, along_second = first @ pose.center, turned @ pose.center
        s, t = along_first - cosine * along_second, cosine * along_first - along_second
        in_front.append(int(((s > 0) & (t > 0)).sum()))
    return poses[int(np.argmax(in_front))]


def _angle(pose: Pose, other: Pose) -> float:
    """Difference of two poses: angle of the relative rotation plus angle between the bases, in rad."""
    turn = np.arccos(np.clip((np.trace(pose.rotation @ other.rotation.T) - 1) / 2, -1.0, 1.0))
    return float(turn + np.arccos(np.clip(pose.center @ other.center, -1.0, 1.0)))


@dataclass(frozen=True)
class Similarity:
    """object = scale rotation model + shift."""

    scale: float
    rotation: Array
    shift: Array

    def apply(self, xyz: Array) -> Array:
        return np.asarray(self.scale * xyz @ self.rotation.T + self.shift)


def absolute_orientation(model: Array, known: Array, stations: Array) -> Similarity | None:
    """Determine the similarity from the model to the object system.

    Parameters
    ----------
    model : (n, 3) points in the model.
    known : (n, 3) their object coordinates, nan where unknown.
    stations : (k, 3) projection centres in the model.

    Returns
    -------
    The similarity; None where the known coordinates do not determine it.

    Notes
    -----
    Where points are known whole, the rotation has a closed form (W. Kabsch 1976). Otherwise scale and shift are linear
    for a given rotation; so the rotation is optimised from starts all over the rotation group. A minimal datum, for
    example two points and the height of a third, has two solutions, rotated around the line through the two points. The
    one with the cameras higher above the points is taken.
    """
    from scipy.optimize import least_squares  # takes longer to import than most adjustments

    given = ~np.isnan(known)
    if given.sum() < 7 or not given.any(axis=0).all():
        return None
    target = _centre_model(known, given)
    if (given.all(axis=1) == given.any(axis=1)).all():
        u, strength, vt = np.linalg.svd(target.T @ _centre_model(model, given))
        proper = np.array([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
        is_determined = proper[1:] @ strength[1:] > SINGULAR**2 * strength[0]  # False for points on a line
        return _similarity((u * proper) @ vt, model, known, given) if is_determined else None
    starts = Rotation.from_quat(np.random.default_rng(0).normal(size=(STARTS, 4))).as_matrix()  # uniform over SO(3)
    costs = np.array([(_misfit(start, model, target, given) ** 2).sum() for start in starts])
    found: list[tuple[float, bool, Array]] = []

    def misfit(turn: Array, start: Array) -> Array:
        return _misfit(rotation_from_vector(turn) @ start, model, target, given)

    for start in starts[np.argsort(costs, kind="stable")[:REFINED]]:
        near = least_squares(misfit, np.zeros(3), args=(start,))
        strength = np.linalg.svd(np.asarray(near.jac), compute_uv=False)
        is_determined = bool(strength[2] > SINGULAR * np.linalg.norm(target))
        found.append((2.0 * float(near.cost), is_determined, rotation_from_vector(near.x) @ start))
    most = min(cost for cost, _, _ in found) + AS_GOOD * (target**2).sum()
    candidates = [
        _similarity(rotation, model, known, given)
        for cost, is_determined, rotation in found
        if cost <= most and is_determined
    ]
    return max(
        candidates, key=lambda s: float(s.apply(stations)[:, 2].mean() - s.apply(model)[:, 2].mean()), default=None
    )


def level_model(model: Array, heights: Array, stations: Array, principal_distance_mm: float) -> Similarity | None:
    """Level and scale a model by heights alone, robustly; origin and azimuth of X and Y are arbitrary.

    Parameters
    ----------
    model : (n, 3) points in the model.
    heights : (n,) their heights.
    stations : (k, 3) projection centres in the model, above the points.
    principal_distance_mm : height of the stations in object units where equal heights leave the scale open.

    Returns
    -------
    The similarity; None where the heights decrease where the model rises (poor model).
    """
    weights = np.ones(len(model))
    for _ in range(REWEIGHTINGS):
        middle, height = np.average(model, axis=0, weights=weights), float(np.average(heights, weights=weights))
        offsets, relief = model - middle, heights - height
        squares = float((weights * relief**2).sum())
        rise = (weights * relief) @ offsets / squares if squares else np.zeros(3)
        left = offsets - np.outer(relief, rise)
        up = np.linalg.svd(np.sqrt(weights)[:, np.newaxis] * left, full_matrices=False)[2][2]
        distance = np.abs(left @ up)
        weights = 1.0 / np.maximum(distance, 0.1 * np.median(distance) + np.finfo(float).tiny)
    above = float(np.mean((stations - middle) @ up))
    up = up if above > 0.0 else -up
    upward = (
        float(rise @ up) if squares else abs(above) / principal_distance_mm
    )  # height in the model of an object unit
    if upward <= 0.0:
        return None
    right = np.cross(np.eye(3)[np.argmin(np.abs(up))], up)
    right /= np.linalg.norm(right)
    scale, rotation = 1.0 / upward, np.stack([right, np.cross(up, right), up])
    return Similarity(scale, rotation, np.array([0.0, 0.0, height]) - scale * rotation @ middle)


def _centre_model(xyz: Array, given: Mask) -> Array:
    """Coordinates reduced by the mean of the given ones, axis by axis; 0 where not given."""
    mean = np.where(given, xyz, 0.0).sum(axis=0) / given.sum(axis=0)
    return np.where(given, xyz - mean, 0.0)


def _misfit(rotation: Array, model: Array, target: Array, given: Mask) -> Array:
    """Residuals of the given coordinates with this rotation and the best scale and shift."""
    turned = _centre_model(model @ rotation.T, given)
    return np.asarray((_scale(turned, target) * turned - target)[given])


def _scale(turned: Array, target: Array) -> float:
    """Least-squares scale; 0 instead of a negative one, which is no solution."""
    return max(float((turned * target).sum() / (turned**2).sum()), 0.0)


def _similarity(rotation: Array, model: Array, known: Array, given: Mask) -> Similarity:
    turned = model @ rotation.T
    scale = _scale(_centre_model(turned, given), _centre_model(known, given))
    return Similarity(scale, rotation, np.nanmean(np.where(given, known - scale * turned, np.nan), axis=0))


@dataclass
class BlockState:
    """Images, known coordinates, and the poses and points determined so far, by image and point name."""

    sights: Mapping[str, Sight]
    firm: Mapping[str, Array]  # coordinates (3,) with a finite standard deviation, nan for the others
    rough: Mapping[str, Array]  # these, and mere approximations
    poses: dict[str, Pose] = field(default_factory=dict)
    points: dict[str, Array] = field(default_factory=dict)  # intersected


def extend(block: BlockState) -> None:
    """Resect images and intersect points in turn until no more can be oriented; images with most control first."""
    while True:
        block.points = intersect_points(block, WELL_DETERMINED)
        waiting = [name for name in sorted(block.sights) if name not in block.poses]
        new: dict[str, Pose] = {}
        for fewest in (SURE_RESECTION, FEWEST) if waiting else ():
            new = new or _resect_stations(block, waiting, fewest)
        if not new:
            return
        block.poses.update(new)


def _resect_stations(block: BlockState, images: Sequence[str], fewest: int) -> dict[str, Pose]:
    """Resect the images that have enough points: from firm points, else from all points with coordinates so far."""
    poses: dict[str, Pose] = {}
    for coordinates in (block.firm, {**block.rough, **block.points}):
        fields = {name: known_field(block.sights[name], coordinates) for name in images if name not in poses}
        enough = {name: field for name, field in fields.items() if len(field.xyz) >= fewest}
        found = resect_images(list(enough.values()), [block.sights[name].principal_distance_mm for name in enough])
        poses |= {name: pose for name, pose in zip(enough, found, strict=True) if pose is not None}
    return poses


def known_field(sight: Sight, coordinates: Mapping[str, Array]) -> KnownField:
    """Points of an image of which all three coordinates are known."""
    xyz = np.array([coordinates[name] for name in sight.points]).reshape(-1, 3)
    usable = ~np.isnan(xyz).any(axis=1)
    return KnownField(xyz[usable], sight.xy_mm[usable], sight.sigma_mm)


def intersect_points(block: BlockState, weakest: float) -> dict[str, Array]:
    """Intersect the points that are not fully known, with given coordinates fixed.

    Returns coordinates (3,) by point, of those with a determination above `weakest`.
    """
    is_sought = np.isnan(np.array(list(block.firm.values())).reshape(-1, 3)).any(axis=1)
    names = sorted(name for name, is_unknown in zip(block.firm, is_sought, strict=True) if is_unknown)
    position = {name: i for i, name in enumerate(names)}
    rows = [
        (image, k, position[name])
        for image in (sorted(block.poses) if names else ())
        for k, name in enumerate(block.sights[image].points)
        if name in position
    ]
    if not rows:
        return {}
    directions = {image: block.sights[image].rays @ pose.rotation for image, pose in block.poses.items()}
    points, determination = intersect(
        np.array([block.poses[image].center for image, _, _ in rows]),
        np.array([directions[image][k] for image, k, _ in rows]),
        np.array([point for _, _, point in rows], dtype=np.intp),
        np.array([block.firm[name] for name in names]),
    )
    return {names[i]: points[i] for i in np.flatnonzero(determination > weakest)}


def orient_free_model(sights: Mapping[str, Sight], known: Mapping[str, Array]) -> dict[str, Pose]:
    """Orient images by model formation and absolute orientation.

    Parameters
    ----------
    known : coordinates (3,) by point, nan where unknown.

    Returns
    -------
    Poses of the images in the model; empty if no model can be formed, or if it cannot be oriented absolutely.

    Notes
    -----
    Several pairs of images are oriented relatively, each with several solutions, and extended by resection and
    intersection. The model with most images is taken; of equals, the one with the smallest residuals. It is oriented
    absolutely, by heights alone if nothing else is known. Without any known coordinate it keeps the axes of its first
    image and a base of 1.
    """
    models = _models(sights)
    if not models:
        return {}
    best = min(models, key=lambda model: (-len(model.poses), typical_residual(model)))
    if all(np.isnan(xyz).all() for xyz in known.values()):
        return best.poses
    names = sorted(best.points)
    model, xyz = (np.array([each[name] for name in names]) for each in (best.points, known))
    stations = np.array([best.poses[image].center for image in sorted(best.poses)])
    with_height = ~np.isnan(xyz[:, 2])
    if np.isnan(xyz[:, :2]).all() and with_height.sum() > FEWEST_SHARED:
        distance = min(sight.principal_distance_mm for sight in sights.values())
        similarity = level_model(model[with_height], xyz[with_height, 2], stations, distance)
    else:
        similarity = absolute_orientation(model, xyz, stations)
    if similarity is None:
        return {}
    return {
        image: Pose(pose.rotation @ similarity.rotation.T, similarity.apply(pose.center[None])[0])
        for image, pose in best.poses.items()
    }


def _models(sights: Mapping[str, Sight]) -> list[BlockState]:
    """Models of the pairs of images with most common points, one for each relative orientation, extended by all images
    that can be joined."""
    shown = {image: set(sights[image].points) for image in sorted(sights)}
    counts = {pair: len(shown[pair[0]] & shown[pair[1]]) for pair in combinations(shown, 2)}
    enough = [pair for pair, count in counts.items() if count >= FEWEST_SHARED]
    nothing = {name: np.full(3, np.nan) for sight in sights.values() for name in sight.points}
    models = []
    for first, second in sorted(enough, key=lambda pair: (-counts[pair], pair))[:PAIRS]:
        common, rays = sorted(shown[first] & shown[second]), list[Array]()
        for sight in (sights[first], sights[second]):
            row = {name: i for i, name in enumerate(sight.points)}
            rays.append(sight.rays[[row[name] for name in common]])
        for pose in relative_poses(rays[0], rays[1], np.random.default_rng(0)):
            model = BlockState(sights, nothing, nothing, {first: Pose(np.eye(3), np.zeros(3)), second: pose})
            extend(model)
            models.append(model)
    return models


def typical_residual(model: BlockState) -> float:
    """Median distance in mm between projected and observed points; a point not intersected counts as infinite."""
    distances = []
    for image, pose in model.poses.items():
        sight = model.sights[image]
        held = [i for i, name in enumerate(sight.points) if name in model.points]
        xyz = np.array([model.points[sight.points[i]] for i in held]).reshape(-1, 3)
        distances.append(image_distances(pose, xyz, sight.xy_mm[held], sight.principal_distance_mm))
        distances.append(np.full(len(sight.points) - len(held), np.inf))
    return float(np.median(np.concatenate(distances)))
