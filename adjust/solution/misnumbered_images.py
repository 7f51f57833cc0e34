"""Images whose point numbers are off: the projective transformation of the given points tells it without a camera.

Direct linear transformation of the points to an image, a homography where they are flat: with right numbers it fits but
for the distortion, which all images share. Images that it fits worse by far are tried with other numbers.
"""

import re
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from adjust.array_types import Array, Indices
from adjust.problem.network import Network
from adjust.problem.parameter import shortened

FEWEST = 8  # points of an image that tell by a linear transformation what is wrong with it
FEWEST_IMAGES = 3
FLAT_FIELD = 0.05  # relative thickness of a field below which a linear transformation does not tell its depth
WORSE, LARGE = 4.0, 0.01  # times the median misfit of the images, and misfit above which other numbers are tried
BETTER, MUCH_BETTER = 3.0, 10.0  # ratio by which right numbers lower the misfit of an image worse than most, or alike
NAMED = 5  # images named in a message
MOST_OFF = 30  # largest shift of numbers tried
SAME_LINE = 1e-3  # fraction of the field's extent


def misnumbered_images(network: Network) -> dict[str, str]:
    """Find the frames whose point numbers are off, with the reasons; empty where all may be right."""
    places, observations = network.known_places, network.observations
    is_known = np.array([name in places for name in observations.point], dtype=bool) & ~observations.is_fiducial
    numbers_of = network.image_numbers[is_known]
    rows_of = np.split(
        np.flatnonzero(is_known)[np.argsort(numbers_of, kind="stable")], np.cumsum(np.bincount(numbers_of))
    )
    rows_of = [rows for rows in rows_of if len(rows) >= FEWEST]
    if len(rows_of) < FEWEST_IMAGES:
        return {}
    names = sorted(places, key=_natural)
    of_name, xyz = {name: k for k, name in enumerate(names)}, np.array([places[name] for name in names])

    def misfit(rows: Indices, order: Indices) -> float:
        numbers = [of_name[observations.point[row]] for row in rows]
        return linear_transformation(xyz[order[numbers]], observations.xy_mm[rows])[1]

    as_given = np.array([misfit(rows, np.arange(len(names))) for rows in rows_of])
    orders, frames = list(_orders(xyz)), defaultdict[str, list[str]](list)
    for rows, own in zip(rows_of, as_given, strict=True):
        is_worse = own > WORSE * np.median(as_given)
        if is_worse or own > LARGE:
            least, words = min((misfit(rows, order), words) for words, order in orders)
            if (BETTER if is_worse else MUCH_BETTER) * least < own:
                frames[words].append(network.image_by_name[observations.image[rows[0]]].frame)
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


def linear_transformation(xyz: Array, xy_mm: Array) -> tuple[float, float]:
    """Handedness and misfit of the direct linear transformation of points (n, 3) to an image (n, 2).

    Handedness: positive for a mirrored image, 0 for a flat field, whose mirror images are images. The misfit is the
    median residual in units of the image's extent.
    """
    (points, extents), (xy, _) = (_normalised(each) for each in (xyz, xy_mm))
    is_flat = extents[-1] < FLAT_FIELD * extents[0]
    axes = np.linalg.svd(points, full_matrices=False)[2][: 2 if is_flat else 3]
    at = np.column_stack([points @ axes.T if is_flat else points, np.ones(len(points))])
    none = np.zeros_like(at)
    rows = np.vstack([np.hstack([at, none, -xy[:, :1] * at]), np.hstack([none, at, -xy[:, 1:] * at])])
    projection = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, -1)
    projected = at @ projection.T
    depths = projected[:, 2]
    off = projected[:, :2] / np.where(depths == 0.0, 1e-300, depths)[:, None] - xy
    misfit = float(np.median(np.linalg.norm(off, axis=1)))
    return 0.0 if is_flat else float(np.linalg.det(projection[:, :3]) * np.median(depths)), misfit


def _normalised(places: Array) -> tuple[Array, Array]:
    """Places about their centroid, of size 1, and their singular values."""
    centred = places - places.mean(axis=0)
    extents = np.linalg.svd(centred, compute_uv=False)
    return centred / max(extents[0], 1e-300), extents
