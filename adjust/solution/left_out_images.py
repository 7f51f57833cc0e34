"""Images that are left out, without an orientation or with wrong point numbers, and tried again afterwards.

The projective transformation of the given points to an image tells wrong numbers without a camera: with right ones it
fits but for the distortion, which all images share. Images that it fits worse by far are tried with other numbers.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter, shortened
from adjust.solution.result import Adjustment

FITTING = 3.0  # in sigma0 of the others: largest rms standardised residual of an image that agrees with them
CONTRADICTING = 0.5  # share of v'Pv above which one image explains why the iteration does not converge
FEWEST_RAYS = 2  # rays needed for a point without priors
FEWEST = 8  # points of an image that tell by a linear transformation what is wrong with it
FEWEST_IMAGES = 3  # images needed for a median misfit
FLAT_FIELD = 0.05  # relative thickness of a field below which a linear transformation does not tell its depth
WORSE, LARGE = 4.0, 0.01  # times the median misfit of the images, and misfit above which other numbers are tried
BETTER, MUCH_BETTER = 3.0, 10.0  # ratio by which right numbers lower the misfit of an image worse than most, or alike
NAMED = 5  # images named in a message
MOST_OFF = 30  # largest shift of numbers tried
LEAST_DEPTH = 1e-12  # of points in a field of size 1: nearer ones are imaged as far off as that


def leave_out(network: Network, frames: Collection[str]) -> Network | None:
    """Remove some frames and what only they show from a network; None where no more than half of it would remain."""
    left = {image.frame for image in network.images if image.frame not in frames}
    if len(left) <= len(frames):
        return None
    images, observations = tuple(image for image in network.images if image.frame in left), network.observations
    names = {image.name for image in images}
    shown = np.isin(observations.image, list(names))
    frames_of = defaultdict[str, set[str]](set)
    for row in np.flatnonzero(shown & ~observations.is_fiducial):
        frames_of[observations.point[row]].add(network.image_by_name[observations.image[row]].frame)
    located = {
        point.id
        for point in network.points
        if len(frames_of[point.id]) >= (FEWEST_RAYS if point.X is point.Y is point.Z is None else 1)
    }
    kept = shown & (observations.is_fiducial | np.isin(observations.point, list(located)))
    return replace(
        network,
        images=images,
        points=tuple(
            point for point in network.points if point.id in located or point.id not in network.observed_points
        ),
        observations=observations.only(np.flatnonzero(kept)),
        distances=tuple(each for each in network.distances if {each.start, each.end} <= located | names),
    )


def adopt_lens(network: Network, result: Adjustment) -> Network:
    """Replace the cameras of a network by those adjusted from a part of it."""
    used = {image.camera for image in result.network.images} - result.network.idle_cameras
    cameras = (_adopt_camera(camera, result) if camera.name in used else camera for camera in network.cameras)
    return replace(network, cameras=tuple(cameras))


def fitting(result: Adjustment, frames: Collection[str], sigma0: float) -> set[str]:
    """Select the frames whose residuals agree with sigma0 of the others."""
    of_mark = np.array([image.frame for image in result.network.images])[result.network.image_numbers]
    excess = (np.nan_to_num(result.residuals.w) ** 2).sum(axis=1) - 2.0 * (FITTING * sigma0) ** 2
    return {frame for frame in frames if (result.weights * excess)[of_mark == frame].sum() <= 0.0}


def contradicting_image(result: Adjustment) -> dict[str, str]:
    """The frame that causes most of v'Pv in an adjustment without a solution, with the reason; empty if none does."""
    image_numbers = result.network.image_numbers
    frames = np.array([image.frame for image in result.network.images])[image_numbers]
    # Without a solution there are no standardised residuals.
    variances = np.diagonal(result.network.observations.covariance_mm2, axis1=1, axis2=2)
    share = (result.residuals.v_mm**2 / variances).sum(axis=1)
    names, of_frame = np.unique(frames, return_inverse=True)
    sums = np.bincount(of_frame, share)
    worst = int(np.argmax(sums))
    if len(names) < 2 or sums[worst] <= CONTRADICTING * sums.sum():
        return {}
    point = result.network.observations.point[int(np.argmax(np.where(of_frame == worst, share, -1.0)))]
    return {
        str(
            names[worst]
        ): f"with image {names[worst]} the iteration does not converge, without it it does. Its largest "
        f"residual is that of {point}. Check the point numbers of this image."
    }


def _adopt_camera(camera: Camera, result: Adjustment) -> Camera:
    def adopted(name: str, given: Prior | None) -> Prior:
        return Prior(result.value(Parameter.interior(camera.name, name)), np.inf if given is None else given.sigma)

    of = camera.distortion
    parameters = {
        name: adopted(name, of.parameters[name]) for name in parameter_names(of.family) if name in of.parameters
    }
    return replace(
        camera,
        principal_distance_mm=adopted("c", camera.principal_distance_mm),
        x0_mm=adopted("x0", camera.x0_mm),
        y0_mm=adopted("y0", camera.y0_mm),
        distortion=replace(of, parameters=parameters),
    )


def misnumbered_images(network: Network) -> dict[str, str]:
    """Find the frames whose point numbers are off, with the reasons; empty where all may be right."""
    places, observations = network.known_places, network.observations
    names, number = observations.numbered_points
    known = np.flatnonzero(np.array([name in places for name in names])[number] & ~observations.is_fiducial)
    known = known[np.argsort(network.image_numbers[known], kind="stable")]
    counts = np.bincount(network.image_numbers[known], minlength=len(network.images))
    rows_of = [rows for rows in np.split(known, np.cumsum(counts)[:-1]) if len(rows) >= FEWEST]
    if len(rows_of) < FEWEST_IMAGES:
        return {}
    nowhere = np.full(3, np.nan)
    given = np.array([places.get(name, nowhere) for name in names])[number]
    as_given = np.empty(len(rows_of))
    sizes = np.array([len(rows) for rows in rows_of])
    for size in np.unique(sizes):
        rows = np.array([each for each in rows_of if len(each) == size])
        as_given[sizes == size] = linear_transformations(given[rows], observations.xy_mm[rows])[1]
    is_worse = as_given > WORSE * np.median(as_given)
    doubted = np.flatnonzero(is_worse | (as_given > LARGE))
    if not len(doubted):
        return {}
    in_order = sorted(places, key=_natural)
    place_of, xyz = {name: k for k, name in enumerate(in_order)}, np.array([places[name] for name in in_order])
    orders, frames = list(_orders(xyz)), defaultdict[str, list[str]](list)
    for image in doubted:
        rows = rows_of[image]
        numbers = [place_of[observations.point[row]] for row in rows]
        reordered = np.array([xyz[order[numbers]] for _, order in orders])
        xy_mm = np.broadcast_to(observations.xy_mm[rows], (*reordered.shape[:2], 2))
        misfits = linear_transformations(reordered, xy_mm)[1]
        best = int(np.argmin(misfits))
        if (BETTER if is_worse[image] else MUCH_BETTER) * misfits[best] < as_given[image]:
            frames[orders[best][0]].append(network.image_by_name[observations.image[rows[0]]].frame)
    return {
        frame: f"the points of {shortened(some, NAMED)} are not numbered as they are given: {words}. Correct them."
        for words, some in frames.items()
        for frame in some
    }


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which p10 follows p9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _orders(xyz: Array) -> Iterator[tuple[str, Indices]]:
    """Other orders of numbered points (p, 3): the point at each number, with words."""
    count = len(xyz)
    for off in range(1, min(MOST_OFF, count // 2) + 1):
        for sign, how in ((1, "high"), (-1, "low")):
            yield f"their numbers are {off} too {how}", (np.arange(count) - sign * off) % count
    steps = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    ends = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1  # of the lines of a field that is numbered by lines
    if len(ends) and len(set(np.diff([0, *ends, count]).tolist())) == 1:
        lines = np.arange(count).reshape(len(ends) + 1, -1)
        yield "these are numbered by columns, not by rows, or the reverse", lines.T.ravel()
        turned = lines.copy()
        turned[1::2] = lines[1::2, ::-1]
        yield "these are numbered to and fro, or only here not", turned.ravel()


def linear_transformations(xyz: Array, xy_mm: Array) -> tuple[Array, Array]:
    """Handedness (m,) and misfit (m,) of direct linear transformations of points (m, n, 3) to images (m, n, 2).

    Handedness: positive for a mirrored image, 0 for a flat field, whose mirror images are images. The misfit is the
    median residual in units of the image's extent.
    """
    (points, extents, axes), (xy, _, _) = _normalised(xyz), _normalised(xy_mm)
    is_flat = extents[:, -1] < FLAT_FIELD * extents[:, 0]
    handedness, misfits = np.zeros(len(xyz)), np.zeros(len(xyz))
    for flat in np.unique(is_flat):
        own = is_flat == flat
        of, to = points[own], xy[own]
        at = of @ axes[own, :, :2] if flat else of
        at = np.concatenate([at, np.ones((*at.shape[:2], 1))], axis=2)
        none = np.zeros_like(at)
        along = np.concatenate([at, none, -to[..., :1] * at], axis=2)
        rows = np.concatenate([along, np.concatenate([none, at, -to[..., 1:] * at], axis=2)], axis=1)
        normal = rows.swapaxes(1, 2) @ rows
        projection = np.linalg.eigh(normal)[1][:, :, 0].reshape(len(at), 3, -1)
        projected = at @ projection.swapaxes(1, 2)
        depths = projected[..., 2]
        off = projected[..., :2] / np.where(np.abs(depths) < LEAST_DEPTH, LEAST_DEPTH, depths)[..., None] - to
        misfits[own] = np.median(np.linalg.norm(off, axis=2), axis=1)
        if not flat:
            handedness[own] = np.linalg.det(projection[..., :3]) * np.median(depths, axis=1)
    return handedness, misfits


def _normalised(places: Array) -> tuple[Array, Array, Array]:
    """Places (m, n, k) about their centroid, of size 1, their extents (m, k) along their axes, and these (m, k, k)."""
    centred = places - places.mean(axis=1, keepdims=True)
    centred /= np.maximum(np.abs(centred).max(axis=(1, 2), keepdims=True), 1e-300)  # for the squares
    squares, axes = np.linalg.eigh(centred.swapaxes(1, 2) @ centred)
    extents = np.sqrt(np.maximum(squares[:, ::-1], 0.0))
    return centred / np.maximum(extents[:, :1, None], 1e-300), extents, axes[..., ::-1]
