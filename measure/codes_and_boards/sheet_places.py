"""Where pictures of a flat sheet or board show its points, of a camera of which nothing need be known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.targets.consistency import ImagePoints, TargetPlaces
from measure.targets.sheets import SheetView, focal_length, robust_view

Array = NDArray[np.float64]

_LEAST_POINTS = 8  # fewer say nothing of one another: eight numbers tell where a sheet lies
# How wrong they may be where most points are right, of the picture's size: perspective, and what the lens does where
# its middle is not the picture's.
_PERSPECTIVE, _DECENTRED = 0.1, 0.003
_STEP = 1e-3  # of the sheet's size, for derivatives
FLAT = 0.01  # of the points' extent: a sheet may be as uneven as this


@dataclass(frozen=True, eq=False)
class SeenSheet:
    """What a picture shows of a sheet: index (n,), of the points; seen_px (n, 2), covariance_px2 (n, 2, 2): where they
    were seen; size_px of the picture."""

    index: NDArray[np.intp]
    seen_px: Array
    covariance_px2: Array
    size_px: tuple[int, int]


def along_plane(xyz: Array) -> Array:
    """(n, 3) points (n, 3) along the plane that holds them best, and above it."""
    about = xyz - xyz.mean(axis=0)
    return np.asarray(about @ np.linalg.svd(about, full_matrices=False).Vh.T)


def is_flat(along: Array) -> bool:
    """Whether points (n, 3) along a plane and above it are those of a sheet."""
    extent = np.ptp(along, axis=0)
    return bool(extent[2] <= FLAT * extent[0])


def sheet_points(pictures: Sequence[SeenSheet], sheet: Array) -> list[ImagePoints | None]:
    """Where one camera's pictures should show the points of a sheet, (m, 3) along its plane and above it; None for
    those that show too few, or that no camera sees so."""
    views = [_view(picture, sheet) for picture in pictures]
    focal = focal_length([view for view in views if view is not None])
    return [
        None if view is None else _image_points(picture, view, focal, sheet)
        for picture, view in zip(pictures, views, strict=True)
    ]


def _view(picture: SeenSheet, sheet: Array) -> SheetView | None:
    if len(picture.index) < _LEAST_POINTS:
        return None
    return robust_view(sheet[picture.index, :2], picture.seen_px, picture.size_px)


def _image_points(picture: SeenSheet, view: SheetView, focal: float, sheet: Array) -> ImagePoints | None:
    """Where the view folds or the sheet lies behind the camera, nothing is said of a point."""
    places = view.places_px(sheet[picture.index, :2])
    known = np.isfinite(places).all(axis=1)
    if known.sum() < _LEAST_POINTS:
        return None
    index, places = picture.index[known], places[known]
    by_point = view.pixel_from_space(sheet[index, :2], focal, _STEP * float(np.ptp(sheet[:, :2])))
    places = places + by_point[..., 2] * sheet[index, 2:]
    targets = TargetPlaces(
        places, _by_view(places, picture.size_px), np.zeros((len(index), 2, 2)), np.zeros(len(index), bool)
    )
    return ImagePoints(
        index, targets, by_point, picture.seen_px[known], picture.covariance_px2[known], picture.size_px
    )  # fmt: skip


def _by_view(places: Array, size_px: tuple[int, int]) -> Array:
    """(n, 2, 4) how far perspective and the lens's middle move places (n, 2), each by its standard deviation."""
    size = float(np.hypot(*size_px))
    about = (2.0 * places - (np.array(size_px) - 1.0)) / size
    products = about[:, :, None] * about[:, None, :]
    decentred = np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 2.0 * products
    return np.asarray(size * np.concatenate([_PERSPECTIVE * products, _DECENTRED * decentred], axis=2))
