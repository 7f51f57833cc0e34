"""Direct linear transformations (DLT) of known points to images, of many images at once.

Points in a plane are imaged by a homography, others by a central projection with eleven parameters. The coefficients
are the eigenvector of the least eigenvalue of linear equations in normalised coordinates (Hartley and Zisserman,
Multiple View Geometry, algorithms 4.2 and 7.1). They tell wrong point numbers and mirrored images without a camera, and
give the principal distance and all poses without a search where there are no gross errors.

Arrays (m, n) hold n points of m images; `present` marks those that an image shows.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices, Mask

FLAT_FIELD = 0.05  # relative thickness of a field below which a linear transformation does not tell its depth
CLEAR = 5.0  # 1 / c² in its standard deviations, from which on it is determined
SINGULAR = 1e-14  # fraction of the trace that keeps equations regular
LEAST_DEPTH = 1e-12  # of points in a field of size 1: nearer ones are imaged as far off as that


@dataclass(frozen=True)
class _Normalised:
    """Places (m, n, k) about their centroid (m, k), of size (m,) 1; extents (m, k) along their axes (m, k, k)."""

    places: Array
    origin: Array
    size: Array
    extents: Array
    axes: Array

    @classmethod
    def normalise(cls, places: Array, present: Mask) -> "_Normalised":
        weights = present.astype(np.float64)
        origin = (weights[:, None] @ places)[:, 0] / weights.sum(axis=1)[:, None]
        centred = (places - origin[:, None]) * weights[..., None]
        largest = _size_or_one(np.abs(centred).max(axis=(1, 2)))  # for the squares
        centred /= largest[:, None, None]
        squares, axes = np.linalg.eigh(centred.swapaxes(1, 2) @ centred)
        extents = np.sqrt(np.maximum(squares[:, ::-1], 0.0))
        size = _size_or_one(extents[:, 0])
        return cls(centred / size[:, None, None], origin, largest * size, extents, axes[..., ::-1])


def _size_or_one(size: Array) -> Array:
    """Sizes (m,), 1 where all points lie at one place."""
    return np.where(size > 0.0, size, 1.0)


@dataclass(frozen=True)
class LinearTransformations:
    """Transformations of fields of points to images.

    field, image: normalised points and images; present: (m, n); is_flat: (m,) mask of the flat fields.
    coefficients: (m, 3, 4) homogeneous image coordinates from homogeneous object coordinates, both normalised; the
    third is positive, and 0 along the normal of a flat field.
    """

    field: _Normalised
    image: _Normalised
    present: Mask
    is_flat: Mask
    coefficients: Array

    @property
    def handedness(self) -> Array:
        """(m,) positive for a mirrored image, 0 for a flat field, whose mirror images are images."""
        return np.where(self.is_flat, 0.0, np.linalg.det(self.coefficients[..., :3]))

    @property
    def misfit(self) -> Array:
        """(m,) median residual in units of the image's extent."""
        off = self._distances(self.field.places, self.image.places)
        ordered = np.sort(np.where(self.present, off, np.inf), axis=1)
        counts = self.present.sum(axis=1)
        return np.asarray(ordered[np.arange(len(ordered)), [(counts - 1) // 2, counts // 2]].mean(axis=0))

    def residuals(self, xyz: Array, xy_mm: Array) -> Array:
        """(m, n) distances of points (m, n, 3) from their places (m, n, 2), in units of the image's extent."""
        field, image = (
            (each - own.origin[:, None]) / own.size[:, None, None]
            for each, own in ((xyz, self.field), (xy_mm, self.image))
        )
        return self._distances(field, image)

    def _distances(self, field: Array, image: Array) -> Array:
        """(m, n) distances of normalised points from their normalised places."""
        projected = field @ self.coefficients[..., :3].swapaxes(1, 2) + self.coefficients[:, None, :, 3]
        depths = projected[..., 2:]
        off = projected[..., :2] / np.where(np.abs(depths) < LEAST_DEPTH, LEAST_DEPTH, depths) - image
        return np.asarray(np.linalg.norm(off, axis=2))


def linear_transformations(xyz: Array, xy_mm: Array, present: Mask | None = None) -> LinearTransformations:
    """Transformations of points (m, n, 3) to images (m, n, 2) with the least algebraic residuals."""
    present = np.ones(xyz.shape[:2], dtype=bool) if present is None else present
    field, image = _Normalised.normalise(xyz, present), _Normalised.normalise(xy_mm, present)
    is_flat, coefficients = field.extents[:, -1] < FLAT_FIELD * field.extents[:, 0], np.zeros((len(xyz), 3, 4))
    for flat in np.unique(is_flat):
        own = is_flat == flat
        axes = field.axes[own, :, :2] if flat else np.eye(3)
        at = np.concatenate([field.places[own] @ axes, present[own, :, None]], axis=2)
        x, y = image.places[own][..., :1], image.places[own][..., 1:]
        count, _, width = at.shape
        normal = np.zeros((count, 3, width, 3, width))
        across = at.swapaxes(1, 2)
        normal[:, 0, :, 0] = normal[:, 1, :, 1] = across @ at
        for axis, by in enumerate((x, y)):
            normal[:, axis, :, 2] = normal[:, 2, :, axis] = -(across @ (by * at))
        normal[:, 2, :, 2] = across @ ((x**2 + y**2) * at)
        found = np.linalg.eigh(normal.reshape(count, 3 * width, -1))[1][:, :, 0].reshape(count, 3, width)
        coefficients[own] = np.concatenate([found[..., :-1] @ np.swapaxes(axes, -1, -2), found[..., -1:]], axis=2)
    coefficients *= np.where(coefficients[:, 2:, 3:] < 0.0, -1.0, 1.0)  # the depth of the centroid
    return LinearTransformations(field, image, present, is_flat, coefficients)


def equations_by_point(xyz: Array, xy_mm: Array, present: Mask) -> Callable[[Indices], Array]:
    """Linear equations of images (m, n, 2) as a function of the points (n,), of some (p, 3), that they show.

    These are (m, n, 2, 3 w), 0 where absent; their coefficients (3, w) are those of the transformation.
    """
    field, image = (
        _Normalised.normalise(xyz[None], np.ones((1, len(xyz)), dtype=bool)),
        _Normalised.normalise(xy_mm, present),
    )
    is_flat = field.extents[0, -1] < FLAT_FIELD * field.extents[0, 0]
    at = np.hstack([field.places[0] @ (field.axes[0, :, :2] if is_flat else np.eye(3)), np.ones((len(xyz), 1))])

    def equations(shown: Indices) -> Array:
        by = at[shown] * present[..., None]
        rows = [[by, 0.0 * by, -image.places[..., :1] * by], [0.0 * by, by, -image.places[..., 1:] * by]]
        return np.stack([np.concatenate(row, axis=2) for row in rows], axis=2)

    return equations


def residual_squares(normal: Array) -> Array:
    """(...) sums of the squared residuals of normal equations (..., 3 w, 3 w) with the depth of the centroid as unit.

    The least eigenvalue hardly grows with the number of wrong points, since coefficients without depth fit anything.
    """
    size = normal.shape[-1]
    known = normal + SINGULAR * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] * np.eye(size)
    return np.asarray(1.0 / np.linalg.solve(known, np.eye(size)[:, -1:])[..., -1, 0])


def closed_form(given: LinearTransformations) -> tuple[float, Array, Array] | None:
    """Principal distance and poses of one camera without distortion, with coordinates about its principal point.

    Returns
    -------
    Principal distance in mm, rotations (m, 3, 3) and shifts (m, 3), camera = R X + t; None where they are not
    determined, or some image is mirrored.

    Notes
    -----
    Of a flat field the images of two orthogonal axes determine the principal distance (Zhang 2000, A flexible new
    technique for camera calibration), of another one the lengths of the projection's rows.
    """
    field, image, is_deep = given.field, given.image, ~given.is_flat
    projection = given.coefficients.copy()
    projection[:, :2] = image.size[:, None, None] * projection[:, :2] + image.origin[..., None] * projection[:, 2:]
    matrix = projection[..., :3]
    u, v = np.moveaxis(matrix @ field.axes[..., :2], 2, 0)  # images of the first two axes
    products = np.stack([u * v, (u**2 - v**2) / 2.0], axis=1)  # of equal length, and at right angles
    across, ahead = products[..., :2].sum(axis=2), products[..., 2]
    lengths = (matrix**2).sum(axis=2)
    size = lengths[:, :2].mean(axis=1, keepdims=True)
    across[is_deep], ahead[is_deep] = size[is_deep] * [1.0, 0.0], -lengths[is_deep, 2:] * [1.0, 0.0]
    across, ahead = across / size, ahead / size
    weight = float((across**2).sum())
    inverse_square = -float((across * ahead).sum()) / weight  # across / c² + ahead = 0
    spread = np.sqrt(float(np.mean((across * inverse_square + ahead)[across != 0.0] ** 2)) / weight)
    if not inverse_square > CLEAR * spread:
        return None
    c = inverse_square**-0.5
    camera = projection * np.array([[1.0 / c], [1.0 / c], [-1.0]])
    left, singular, right = np.linalg.svd(camera[..., :3])
    sides = np.linalg.det(left) * np.linalg.det(right)
    if (sides[is_deep] < 0.0).any():
        return None
    left[..., 2] *= sides[:, None]
    rotations = left @ right
    shifts = camera[..., 3] * (field.size / singular[:, :2].mean(axis=1))[:, None]
    return c, rotations, shifts - (rotations @ field.origin[..., None])[..., 0]


def interior_orientation(given: LinearTransformations) -> Array | None:
    """Principal distance and principal point (3,) in mm of one camera without distortion; None if not determined.

    Notes
    -----
    Images a, b of orthogonal axes of equal length have a' W b = 0 and a' W a = b' W b, with W = (K K')⁻¹ the image of
    the absolute conic (Hartley and Zisserman, section 8.8): two axes of a flat field, three of another one.
    """
    field, image = given.field, given.image
    extent = float(image.size.mean())
    projection = given.coefficients.copy()
    projection[:, :2] *= image.size[:, None, None] / extent
    projection[:, :2] += image.origin[..., None] / extent * projection[:, 2:]
    imaged = projection[..., :3] @ field.axes
    imaged /= np.linalg.norm(imaged, axis=(1, 2), keepdims=True)

    def products(i: int, j: int) -> Array:
        """(m, 4) products of two axes' images by the elements of W: 1, -x0, -y0, c² + x0² + y0²."""
        a, b = imaged[..., i].T, imaged[..., j].T
        return np.stack(
            [a[0] * b[0] + a[1] * b[1], a[0] * b[2] + a[2] * b[0], a[1] * b[2] + a[2] * b[1], a[2] * b[2]], 1
        )

    lengths = [products(i, i) for i in range(3)]
    deep = [products(0, 2), products(1, 2), (lengths[1] - lengths[2]) / 2.0]
    equations = [products(0, 1), (lengths[0] - lengths[1]) / 2.0, *(each[~given.is_flat] for each in deep)]
    rows = np.concatenate(equations)
    if len(rows) < 4:
        return None
    _, singular, right = np.linalg.svd(rows)
    noise = singular[3] / np.sqrt(len(rows) - 3) + SINGULAR
    if not abs(right[3, 0]) > CLEAR * noise * np.linalg.norm(right[:3, 0] / (singular[:3] + SINGULAR)):
        return None
    x0, y0, square = right[3, 1:] / right[3, 0] * [-1.0, -1.0, 1.0]
    square -= x0**2 + y0**2
    return extent * np.array([np.sqrt(square), x0, y0]) if square > 0.0 else None
