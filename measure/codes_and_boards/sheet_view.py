"""How a picture shows a flat sheet: a homography, and the radial distortion of a lens."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from measure.noise.robust_estimation import robust_scale

Array = NDArray[np.float64]

_RADIAL_FROM, _SECOND_RADIAL_FROM = 10, 30  # points, from which on the lens's radial distortion is estimated too
_LARGEST_RADIAL = 0.6  # at the picture's corner, relative
_SETTLING = 5  # rounds, in which a view takes in what the lens moved
_FAR = 4.0  # medians of the distances, beyond which a point does not tell where the sheet lies
_LEAST_FAR_PX = 1.0
_USUAL_FOCAL = 2.0  # half diagonals, where no view is oblique enough to tell it


@dataclass(frozen=True, eq=False)
class SheetView:
    """The sheet as a picture shows it: a homography and radial distortion about the picture's middle.

    homography (3, 3): sheet to undistorted px about the middle, in half diagonals; radial (2,): the undistorted place
    is (1 + k1 r² + k2 r⁴) times the distorted one.
    """

    homography: Array
    radial: Array
    size_px: tuple[int, int]

    def undistorted(self, places_px: Array) -> Array:
        """(n, 2) places in the picture as the homography gives them."""
        place = (places_px - self._middle) / self._unit
        r2 = (place**2).sum(axis=1, keepdims=True)
        return np.asarray(place * (1.0 + self.radial[0] * r2 + self.radial[1] * r2**2))

    def ideal(self, sheet: Array) -> Array:
        """(n, 2) what the homography makes of points of the sheet; nan behind the camera."""
        mapped = np.column_stack([sheet, np.ones(len(sheet))]) @ self.homography.T
        depth = np.where(mapped[:, 2:] > 1e-9, mapped[:, 2:], np.nan)
        return np.asarray(mapped[:, :2] / depth)

    def places_px(self, sheet: Array) -> Array:
        """(n, 2) where points of the sheet are in the picture; nan behind the camera, or where the lens folds."""
        ideal = self.ideal(sheet)
        place = ideal.copy()
        for _ in range(25):
            r2 = (place**2).sum(axis=1, keepdims=True)
            with np.errstate(all="ignore"):
                place = ideal / np.maximum(1.0 + self.radial[0] * r2 + self.radial[1] * r2**2, 0.3)
        places = place * self._unit + self._middle
        unsettled = np.hypot(*(self.undistorted(places) - ideal).T) > 1e-3
        return np.where(unsettled[:, None], np.nan, places)

    def pixel_from_disks(self, sheet: Array, radius: float) -> Array:
        """(n, 2, 2) the images of two radius vectors of disks about points of the sheet, px."""
        columns = [
            (self.places_px(sheet + step) - self.places_px(sheet - step)) / 2.0 for step in radius * np.eye(2)
        ]  # fmt: skip
        return np.stack(columns, axis=-1)

    def pixel_from_space(self, sheet: Array, focal: float, step: float) -> Array:
        """(n, 2, 3) how far a unit along the sheet, both ways, and one above it move its points, px; focal: the lens's
        focal length in half diagonals; step: a small length on the sheet."""
        along = self.pixel_from_disks(sheet, step) / step
        to_camera = np.diag([1.0, 1.0, focal])
        column, row = (to_camera @ self.homography[:, :2]).T
        above = np.linalg.solve(to_camera, np.cross(column, row)) / np.sqrt(
            np.linalg.norm(column) * np.linalg.norm(row)
        )
        mapped = np.column_stack([sheet, np.ones(len(sheet))]) @ self.homography.T
        # Of the homography, but for the depth by which all three are divided.
        ideal = np.column_stack([self.homography[:, :2], above])
        moved = ideal[:2] - (mapped[:, :2] / mapped[:, 2:])[:, :, None] * ideal[2]
        on_sheet = np.linalg.solve(moved[..., :2], moved[..., 2:])
        return np.concatenate([along, along @ on_sheet], axis=2)

    def focal_terms(self) -> tuple[Array, Array]:
        """(2,) a and b of a + b focal² = 0: the sheet's two directions are at right angles and of one scale (Zhang
        2000)."""
        column, row = (self.homography[:, :2] / np.linalg.norm(self.homography[:, :2])).T
        in_picture = np.array([column[:2] @ row[:2], column[:2] @ column[:2] - row[:2] @ row[:2]])
        return in_picture, np.array([column[2] * row[2], column[2] ** 2 - row[2] ** 2])

    @property
    def _middle(self) -> Array:
        return (np.array(self.size_px) - 1.0) / 2.0

    @property
    def _unit(self) -> float:
        return float(np.hypot(*self.size_px)) / 2.0


def fitted_view(view: SheetView, points: Array, seen: Array) -> SheetView | None:
    """The view, near one given, that explains best where points of the sheet (n, 2) are seen (n, 2) px, single wrong
    ones tolerated; None where no camera sees them so."""
    homography = homography_through(points, view.undistorted(seen))
    if homography is None:
        return None
    start = SheetView(homography, view.radial, view.size_px)
    terms = 0 if len(points) < _RADIAL_FROM else 1 if len(points) < _SECOND_RADIAL_FROM else 2
    scale = np.abs(homography).max(axis=0)

    def with_parameters(values: Array) -> SheetView:
        matrix = np.append(values[:8], homography[2, 2] / scale[2]).reshape(3, 3) * scale
        return SheetView(matrix, np.append(values[8:], np.zeros(2 - terms)), view.size_px)

    def residuals(values: Array) -> Array:
        candidate = with_parameters(values)
        difference = candidate.undistorted(seen) - candidate.ideal(points)
        return np.nan_to_num(difference, nan=1.0).ravel()

    values = np.append((start.homography / scale).ravel()[:8], view.radial[:terms])
    width = max(robust_scale(residuals(values)), 1e-4)
    solution = least_squares(residuals, values, loss="soft_l1", f_scale=width, max_nfev=30)
    found = with_parameters(solution.x)
    return found if np.abs(found.radial).max() < _LARGEST_RADIAL else start


def robust_view(points: Array, seen: Array, size_px: tuple[int, int]) -> SheetView | None:
    """The view that more than half of the points (n, 2), seen at (n, 2) px, agree with, wherever the others are; None
    where no camera sees them so.

    Least median of squares (Rousseeuw 1984) without a lens, then the lens as well, by those that do not lie far off.
    """
    homography = cv2.findHomography(points, seen, cv2.LMEDS)[0]
    if homography is None:
        return None
    off = np.hypot(*(cv2.perspectiveTransform(points[:, None], homography)[:, 0] - seen).T)
    view = SheetView(np.eye(3), np.zeros(2), size_px)
    for _ in range(_SETTLING):
        near = off <= max(_FAR * float(np.median(off)), _LEAST_FAR_PX)
        fitted = fitted_view(view, points[near], seen[near])
        if fitted is None:
            return None
        view = fitted
        off = np.nan_to_num(np.hypot(*(view.places_px(points) - seen).T), nan=np.inf)
    return view


def focal_length(views: Sequence[SheetView]) -> float:
    """Of the camera that took the views, in half diagonals, as their perspective tells it."""
    terms = [view.focal_terms() for view in views]
    square = -sum(float(a @ b) for a, b in terms) / max(sum(float(b @ b) for _, b in terms), 1e-12)
    return float(np.sqrt(square)) if square > 0.0 else _USUAL_FOCAL


def homography_through(source: Array, target: Array) -> Array | None:
    """Least squares of the normalised linear equations (Hartley 1997), its depth positive at the source's mean; None
    where the source lies on both sides of the camera."""
    middle, spread = source.mean(axis=0), float(np.std(source)) or 1.0
    normal = (source - middle) / spread
    x, y = target.T
    ones, zeros = np.column_stack([normal, np.ones(len(normal))]), np.zeros((len(normal), 3))
    rows = np.concatenate([np.hstack([ones, zeros, -x[:, None] * ones]), np.hstack([zeros, ones, -y[:, None] * ones])])
    homography = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    depth = ones @ homography[2]
    if not (np.all(depth > 0.0) or np.all(depth < 0.0)):
        return None
    to_normal = np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1]])
    return np.asarray(homography @ to_normal / depth.mean())
