"""Disks seen in perspective: how one looks in a scan, and by how much its image's centre is not its centre's image."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.projection import ImageModel
from pipeline.results.comparator_file import pixel_from_comparator

Array = NDArray[np.float64]

_ANGLES = np.arange(8) * np.pi / 4.0
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)  # enough for what a lens does within a target
_FLAT = 1e-6  # of the field's size: points this near a plane lie on a board


def eccentricity_mm(model: ImageModel, centers: Array, normals: Array, radius: float) -> Array:
    """The centre of each disk's image less the image of its centre, in the comparator, (n, 2) mm.

    centers (n, 3) and radius in object units, normals (n, 3) of unit length. With c the centre and n the normal in the
    camera frame, z forward, the centre of the perspective ellipse is off by
    `f r² [n_xy n_z + (c_xy / c_z) (1 - n_z²)] / (c_z² - r² (1 - n_z²))`: the pole of the disk's plane section, as from
    the dual conic of its circle. The lens bends this ellipse; its centre of gravity, which a fitted ellipse finds, is
    that of its outline as distortion and film image it.
    """
    model, centers = model.reduced_to(centers)
    forward = np.array([1.0, 1.0, -1.0])
    c = ((centers - model.station) @ model.rotation.T) * forward
    n = (normals @ model.rotation.T) * forward
    tilt = 1.0 - n[:, 2] ** 2
    reach = c[:, 2] ** 2 - radius**2 * tilt
    off_axis = n[:, :2] * n[:, 2:] + c[:, :2] / c[:, 2:] * tilt[:, None]
    middle = c[:, :2] / c[:, 2:] + radius**2 * off_axis / reach[:, None]
    axes = np.stack(
        [radius * (v[:, :2] - c[:, :2] / c[:, 2:] * v[:, 2:]) / c[:, 2:] for v in across(n)], axis=-1
    )  # fmt: skip

    def imaged(places: Array) -> Array:
        rays = np.column_stack([places, np.ones(len(places))]) * c[:, 2:]
        image, _ = model.comparator_from_object((rays * forward) @ model.rotation + model.station)
        return image

    outline = np.stack([imaged(middle + axes @ u) for u in _CIRCLE], axis=1)
    return _centre_of_gravity(outline) - imaged(c[:, :2] / c[:, 2:])


def _centre_of_gravity(outline: Array) -> Array:
    """(n, 2) of the areas within outlines (n, k, 2) that are, but for a little, affine images of _CIRCLE.

    In the affine frame, a displacement of the unit circle moves its centre of gravity by twice the mean of its part
    along the radius, times the radius vector.
    """
    mean = outline.mean(axis=1)
    linear = 2.0 * np.einsum("nki,kj->nij", outline - mean[:, None], _CIRCLE) / len(_CIRCLE)
    flat = np.einsum("nij,nkj->nki", np.linalg.inv(linear), outline - mean[:, None])
    outward = np.einsum("nki,ki->nk", flat, _CIRCLE) - 1.0
    shift = 2.0 * np.einsum("nk,ki->ni", outward, _CIRCLE) / len(_CIRCLE)
    return np.asarray(mean + np.einsum("nij,nj->ni", linear, shift))


def disk_images(
    model: ImageModel, pitch_um: tuple[float, float], centers: Array, normals: Array, radius: float
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Predicted centres (n, 2) px, maps (n, 2, 2) from each disk's two radius vectors to pixels, perspective (n, 2) per
    px, by which what is nearer to the camera is larger, and what is visible."""
    first, second = across(normals)
    place, visible = model.comparator_from_object(centers)
    columns = []
    for direction in (first, second):
        ahead, seen_ahead = model.comparator_from_object(centers + radius * direction)
        behind, seen_behind = model.comparator_from_object(centers - radius * direction)
        columns.append(pixel_from_comparator((ahead - behind) / 2.0, pitch_um))
        visible = visible & seen_ahead & seen_behind
    maps = np.stack(columns, axis=-1)
    depth = (model.station - centers) @ model.rotation[2]
    deeper = -np.stack([first, second], axis=1) @ model.rotation[2] * radius / depth[:, None]
    perspective = np.einsum("ni,nij->nj", deeper, np.linalg.inv(maps))
    return pixel_from_comparator(place, pitch_um), maps, perspective, visible


def disk_normals(
    ids: Sequence[str], coordinates: Array, given: Mapping[str, Array], plane: Array | None, station: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Unit normals (n, 3) of disks at coordinates (n, 3), and which of them are known.

    Known are those that are given, and all of a flat field: its plane's normal. Others are taken to face the station.
    """
    towards = station - coordinates
    normals = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    if plane is not None:
        normals = np.where((towards @ plane)[:, None] < 0.0, -plane, plane)
    known = np.array([plane is not None or id in given for id in ids], dtype=bool)
    for i, id in enumerate(ids):
        if id in given:
            normals[i] = given[id]
    return normals, known


def plane_normal(coordinates: Array) -> Array | None:
    """The normal of the plane that holds all points (n, 3); None where they are not flat, or too few to say."""
    if len(coordinates) < 4:
        return None
    spread = np.linalg.svd(coordinates - coordinates.mean(axis=0), full_matrices=False)
    flat = spread.S[2] <= _FLAT * spread.S[0] < spread.S[1]
    return np.asarray(spread.Vh[2], dtype=np.float64) if flat else None


def across(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors at right angles to each of the unit vectors (n, 3) and to one another."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)
