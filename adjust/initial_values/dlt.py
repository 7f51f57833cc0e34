"""Orientations of many images of known points at once: in closed form, then refined, then judged.

Fields that are about flat by homographies, others by the direct linear transformation (Hartley and Zisserman 2004,
sections 4.1 and 7.1), all images in one eigenvalue problem. Images whose points do not agree are oriented once more by
those of their points that do. What does not agree then is not given, and is left to `resection`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.rotation import rotation_from_vector
from adjust.initial_values.pose import REJECTION, KnownField, Pose, robust_sigmas, trimmed_count
from adjust.initial_values.pose_refinement import refined_distance, refined_poses, squared_residuals

FEWEST = 6  # points of an image: fewer do not show whether they agree
FEWEST_TRIMMED = 16  # points of an image, half of which still show whether they agree
TRIMMINGS = 20  # at most: mostly the same half is the nearest after five
POINTS_AT_ONCE = 100_000
PLANE = 1e-3  # relief over width up to which a plane's homography tells which points disagree
SHALLOW = 0.25  # relief over width, standard deviations, up to which a homography is nearer than a transformation
LINE = 1e-4  # width over length of points about on a line
WORSE = 3.0  # times the usual standard deviation that an image's residuals may have
GROSS = 100.0  # square of a residual over the image's variance, robustly, that errors of measurement do not reach
TYPICAL = 10  # images from which on their median tells what a lens that is not known yet leaves everywhere
LARGEST_TYPICAL = 0.01  # of that, in principal distances: where most images leave more, all may be wrong
NEARLY_ALIKE = 1e3  # times the squares of a pose up to which its rival as it stands may leave less once it is refined
ANOTHER = 1e-3  # difference of rotations, in any element, from which on two poses are not one
ALIKE = 4.0  # times the squares of a pose that a rival, refined, leaves where nothing tells which of the two it is


def closed_form_poses(known_fields: Sequence[KnownField], principal_distances_mm: Sequence[float]) -> list[Pose | None]:
    """The poses of the images whose points agree on one; None for the others.

    They agree where no residual is gross and all are as large as the standard deviations say, or as those of most
    images are: a lens that is not known yet leaves some everywhere.
    """
    poses: list[Pose | None] = [None] * len(known_fields)
    c, sigmas = np.array(principal_distances_mm), np.full(len(known_fields), np.nan)
    for fewest, trimmed in ((FEWEST, False), (FEWEST_TRIMMED, True)):
        left = [i for i, pose in enumerate(poses) if pose is None and len(known_fields[i].xyz) >= fewest]
        several = [
            (some, _Fields.from_fields([known_fields[i] for i in some])) for some in _batches(known_fields, left)
        ]
        several = [(some, batch.trimmed()[0] if trimmed else batch) for some, batch in several]
        oriented = [batch.oriented(*batch.approximate(c[some]), c[some]) for some, batch in several]
        for (some, _), found in zip(several, oriented, strict=True):
            sigmas[some] = found.sigma
        typical = _typical(sigmas[~np.isnan(sigmas)])
        for (some, batch), found in zip(several, oriented, strict=True):
            for k in np.flatnonzero(found.agree(batch.sigma_mm / c[some], typical)):
                poses[some[k]] = batch.pose(int(k), found)
    return poses


def principal_distance_together(known_fields: Sequence[KnownField]) -> tuple[float, float] | None:
    """The principal distance in mm of all images together, and the standard deviation of its logarithm; None where not
    all images agree on it.

    Of flat fields from the orthogonality of their homographies' axes (Zhang 2000), with a principal point that is
    known and pixels that are square; then by least squares with all poses.
    """
    some = [field for field in known_fields if len(field.xyz) >= FEWEST]
    batch = _Fields.from_fields(some) if some else None
    together = None if batch is None else batch.distance_together()
    if batch is None or together is not None or 2 * (batch.counts >= FEWEST_TRIMMED).sum() <= len(some):
        return together
    batch, sigma_mm = batch.some(batch.counts >= FEWEST_TRIMMED).trimmed()
    agreeing = sigma_mm <= WORSE * np.maximum(batch.sigma_mm, np.median(sigma_mm))
    return batch.some(agreeing).distance_together() if 2 * agreeing.sum() > len(some) else None


def _batches(known_fields: Sequence[KnownField], images: Sequence[int]) -> Iterator[Indices]:
    """Of some images those of about as many points, some at a time."""
    counts = np.array([len(field.xyz) for field in known_fields], dtype=np.intp)
    order = np.array(sorted(images, key=lambda i: -counts[i]), dtype=np.intp)
    while len(order):
        largest = int(counts[order[0]])
        alike = counts[order[: max(1, POINTS_AT_ONCE // largest)]] > largest // 2
        yield order[: int(alike.sum())]
        order = order[int(alike.sum()) :]


def _typical(sigmas: Array) -> float:
    """What most images leave, in principal distances, 0 where that tells nothing."""
    typical = float(np.median(sigmas)) if len(sigmas) >= TYPICAL else 0.0
    return typical if typical < LARGEST_TYPICAL else 0.0


@dataclass(frozen=True, eq=False)
class _Oriented:
    """Rotations (k, 3, 3), shifts (k, 3), robust standard deviations (k,) and largest squares (k,) in squared principal
    distances; rivals (k,): whose mirror image about the line of sight leaves about as little.
    """

    rotations: Array
    shifts: Array
    sigma: Array
    largest: Array
    rivals: Mask

    def agree(self, given: Array, typical: float) -> Mask:
        """Which images agree with their standard deviations (k,) or with what is typical."""
        usual = self.sigma <= WORSE * np.maximum(given, typical)
        return np.asarray(usual & (self.largest < GROSS * np.maximum(self.sigma, given) ** 2) & ~self.rivals)


@dataclass(frozen=True, eq=False)
class _Fields:
    """Fields of k images: points (k, n, 3) in units of their extent about their mean, along the axes of their extent,
    the longest first; places xy_mm (k, n, 2) with weights (k, n), 0 behind the counts (k,) of those that have less, and
    for points that disagree.

    origin (k, 3), size (k,), axes (k, 3, 3): the way back; relief (k,): over the width; sigma_mm (k,).
    """

    points: Array
    xy_mm: Array
    weights: Array
    counts: Indices
    origin: Array
    size: Array
    axes: Array
    relief: Array
    on_a_line: Mask
    sigma_mm: Array

    @classmethod
    def from_fields(cls, fields: Sequence[KnownField]) -> "_Fields":
        counts = np.array([len(field.xyz) for field in fields], dtype=np.intp)
        xyz, xy_mm = np.zeros((len(fields), counts.max(), 3)), np.zeros((len(fields), counts.max(), 2))
        for k, field in enumerate(fields):
            xyz[k, : counts[k]], xy_mm[k, : counts[k]] = field.xyz, field.xy_mm
        weights = (np.arange(counts.max()) < counts[:, None]).astype(np.float64)
        origin = xyz.sum(axis=1) / counts[:, None]
        about = (xyz - origin[:, None]) * weights[..., None]
        variances, axes = np.linalg.eigh(about.swapaxes(1, 2) @ about / counts[:, None, None])
        axes = axes[..., ::-1]  # which may have made them left-handed
        axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
        thick, wide, long = np.sqrt(np.maximum(variances, 0.0)).T
        size = np.maximum(long, np.finfo(float).tiny)
        points = about @ axes / size[:, None, None]
        sigma_mm = np.array([field.sigma_mm for field in fields])
        relief, on_a_line = thick / np.maximum(wide, np.finfo(float).tiny), np.asarray(wide <= LINE * size)
        return cls(points, xy_mm, weights, counts, origin, size, axes, relief, on_a_line, sigma_mm)

    @property
    def flat(self) -> Mask:
        """(k,)"""
        return np.asarray(self.relief <= SHALLOW)

    def some(self, images: Mask) -> "_Fields":
        return _Fields(*(getattr(self, each.name)[images] for each in fields(self)))

    def pose(self, k: int, found: _Oriented) -> Pose:
        """Of one image, in the axes and units of the object."""
        rotation = found.rotations[k] @ self.axes[k].T
        return Pose(rotation, self.origin[k] - self.size[k] * rotation.T @ found.shifts[k])

    def trimmed(self) -> tuple["_Fields", Array]:
        """Without points that disagree with a homography, or linear transformation, of most of their image's points,
        and the robust standard deviations (k,) of these, in mm.

        Least trimmed squares by concentration (Rousseeuw and Van Driessen 2006): of half of the points, those nearest
        to what the last half gave.
        """
        here, rank = self, np.zeros_like(self.weights)
        for _ in range(TRIMMINGS):
            squared = np.where(self._present, here._squared_misfits(), np.inf)
            np.put_along_axis(
                rank, np.argsort(squared, axis=1, kind="stable"), np.arange(squared.shape[1])[None], axis=1
            )
            weights = (rank < trimmed_count(self.counts)[:, None]).astype(np.float64)
            if np.array_equal(weights, here.weights):
                break
            here = replace(self, weights=weights)
        sigma_mm = np.maximum(robust_sigmas(squared, self.counts) * self._unit_mm, self.sigma_mm)
        agreeing = squared < REJECTION * (sigma_mm[:, None] / self._unit_mm) ** 2
        return replace(self, weights=agreeing.astype(np.float64)), sigma_mm

    def _squared_misfits(self) -> Array:
        """Squared distances (k, n), in the unit, of the places from what homographies and transformations give."""
        squared = np.full(self.weights.shape, np.inf)
        is_plane = self.relief <= PLANE
        for members, columns in ((is_plane, 3), (~is_plane, 4)):
            some = members & ~self.on_a_line
            if some.any():
                uvw = self._homogeneous(some, columns) @ self._images(some, columns).swapaxes(1, 2)
                depth = uvw[..., 2] * np.sign((uvw[..., 2] * self.weights[some]).sum(axis=1))[:, None]
                with np.errstate(divide="ignore", invalid="ignore"):
                    off = uvw[..., :2] / uvw[..., 2:] + self.xy_mm[some] / self._unit_mm
                squared[some] = np.where(depth > 0.0, (off**2).sum(axis=2), np.inf)
        return squared

    def distance_together(self) -> tuple[float, float] | None:
        """See `principal_distance_together`."""
        start = self.principal_distance()
        if start is None:
            return None
        poses = self.approximate(np.full(len(self.counts), start))
        if not np.isfinite(poses[1]).all():
            return None
        fields_mm, sigma_mm = (self.points, self.xy_mm, self.weights), float(self.sigma_mm.max())
        try:
            rotations, shifts, c, sigma = refined_distance(*poses, *fields_mm, start, sigma_mm)
        except np.linalg.LinAlgError:  # points behind the camera, for gross errors
            return None
        if not np.isfinite(sigma):
            return None
        found = self.oriented(rotations, shifts, np.full(len(self.counts), c))
        return (c, sigma) if found.agree(self.sigma_mm / c, _typical(found.sigma)).all() else None

    def principal_distance(self) -> float | None:
        """In closed form, the median or mean of what all images say."""
        flat = self.flat & ~self.on_a_line
        if flat.any():
            a, b = _orthogonality(self._images(flat, 3))
            squared = -float((a * a).sum()) / min(float((a * b).sum()), -np.finfo(float).tiny)
            return float(np.sqrt(squared)) * self._unit_mm if (a * b).sum() < 0.0 else None
        deep = self._images(~self.flat, 4)[..., :3]
        squared_norms = (deep**2).sum(axis=2)
        along = (deep[:, :2] * deep[:, 2:]).sum(axis=2)
        squares = (squared_norms[:, :2] * squared_norms[:, 2:] - along**2) / squared_norms[:, 2:] ** 2
        return float(np.sqrt(np.median(squares))) * self._unit_mm if len(deep) else None

    def approximate(self, c_mm: Array) -> tuple[Array, Array]:
        """Rotations and shifts; nan where there are none."""
        rotations, shifts = np.full((len(c_mm), 3, 3), np.nan), np.full((len(c_mm), 3), np.nan)
        for members, columns, poses in ((self.flat, 3, _pose_of_plane), (~self.flat, 4, _pose_in_space)):
            some = members & ~self.on_a_line
            if some.any():
                images = self._images(some, columns)
                images[:, :2] *= self._unit_mm / c_mm[some, None, None]
                front = np.einsum("kc,knc->kn", images[:, 2], self._homogeneous(some, columns))
                behind = (front * self.weights[some]).sum(axis=1) > 0.0
                rotations[some], shifts[some] = poses(images * np.where(behind, -1.0, 1.0)[:, None, None])
        return rotations, shifts

    def oriented(self, rotations: Array, shifts: Array, c_mm: Array) -> _Oriented:
        """Refined from an approximation."""
        tangents = self.xy_mm / c_mm[:, None, None]
        known = np.asarray(np.isfinite(shifts).all(axis=1))
        rotations = np.where(known[:, None, None], rotations, np.eye(3))
        shifts = np.where(known[:, None], shifts, np.array([0.0, 0.0, -10.0]))
        rotations, shifts = refined_poses(rotations, shifts, self.points, tangents, self.weights)
        squared = squared_residuals(rotations, shifts, self.points, tangents)
        squares = (self.weights * squared).sum(axis=1)
        sigma = robust_sigmas(np.where(self._present, squared, np.inf), self.counts)
        rivals = self._has_rival(rotations, shifts, tangents, squares)
        largest = (self.weights * squared).max(axis=1)
        return _Oriented(rotations, shifts, np.where(known, sigma, np.inf), largest, rivals)

    def _has_rival(self, rotations: Array, shifts: Array, tangents: Array, squares: Array) -> Mask:
        """Where a plane that is mirrored about the line of sight to its middle leaves about as little.

        Seen from far away it looks the same (Schweighofer and Pinz 2006).
        """
        sight = shifts / np.linalg.norm(shifts, axis=1, keepdims=True)
        mirrored = rotation_from_vector(np.pi * sight) @ rotations @ np.diag([-1.0, -1.0, 1.0])
        rivals = self.flat.copy()
        for likeness, is_refined in ((NEARLY_ALIKE, False), (ALIKE, True)):
            some = np.flatnonzero(rivals)
            at, fields = (mirrored[some], shifts[some]), (self.points[some], tangents[some])
            if is_refined and len(some):
                at = refined_poses(*at, *fields, self.weights[some])
            left = (self.weights[some] * squared_residuals(*at, *fields)).sum(axis=1)
            is_another = np.abs(at[0] - rotations[some]).max(axis=(1, 2)) > ANOTHER
            rivals[some] = (left < likeness * squares[some]) & is_another
        return rivals

    @property
    def _present(self) -> Mask:
        """(k, n) the points that there are."""
        return np.asarray(np.arange(self.weights.shape[1]) < self.counts[:, None])

    @property
    def _unit_mm(self) -> float:
        """In which image coordinates are about 1."""
        return float(np.sqrt((self.xy_mm**2).sum() / self.counts.sum())) or 1.0

    def _homogeneous(self, some: Mask, columns: int) -> Array:
        """Points (k, n, columns) with a 1 behind: in the plane of the field, or in space."""
        points = self.points[some][..., : columns - 1]
        return np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)

    def _images(self, some: Mask, columns: int) -> Array:
        """The matrices (k, 3, columns) that take homogeneous points to U, V, W: image = -U/W, -V/W, in the unit.

        Of least algebraic error under the norm 1, with image coordinates about their mean and of the size 1.
        """
        weights = self.weights[some]
        counts = np.maximum(weights.sum(axis=1), 1.0)  # of none where no pose agrees with any point
        xy = self.xy_mm[some] * (weights[..., None] / self._unit_mm)
        middle = xy.sum(axis=1) / counts[:, None]
        about = xy - middle[:, None] * weights[..., None]
        size = np.sqrt((about**2).sum(axis=(1, 2)) / counts)
        size[size == 0.0] = 1.0
        x, y = np.moveaxis(about / size[:, None, None], -1, 0)
        points = self._homogeneous(some, columns)
        products = (points[..., :, None] * points[..., None, :]).reshape(*weights.shape, columns**2)
        sums = np.stack([weights, x, y, x * x + y * y], axis=1) @ products
        one, by_x, by_y, by_both = sums.reshape(-1, 4, columns, columns).swapaxes(0, 1)
        nothing = np.zeros_like(one)
        normal = np.block([[one, nothing, by_x], [nothing, one, by_y], [by_x, by_y, by_both]])
        images = np.linalg.eigh(normal)[1][..., 0].reshape(-1, 3, columns)
        images[:, :2] *= size[:, None, None]
        images[:, :2] -= middle[..., None] * images[:, 2:]
        return np.asarray(images)


def _orthogonality(images: Array) -> tuple[Array, Array]:
    """Of homographies (k, 3, 3): what a / c² + b = 0 says of the principal distance, a and b (2 k,).

    The axes of the plane, in the camera, are at right angles and of one length.
    """
    first, second = np.moveaxis(images[..., :2], -1, 0)
    norm = (first[:, :2] ** 2).sum(axis=1) + (second[:, :2] ** 2).sum(axis=1)
    products = np.stack([first * second, (first**2 - second**2) / 2.0], axis=1) / norm[:, None, None]
    return products[..., :2].sum(axis=2).ravel(), products[..., 2].ravel()


def _pose_of_plane(images: Array) -> tuple[Array, Array]:
    """Of homographies (k, 3, 3) to U, V, W."""
    axes = images[..., :2]
    scale = np.sqrt((axes**2).sum(axis=(1, 2)) / 2.0)[:, None, None]
    first, second = np.moveaxis(axes / scale, -1, 0)
    rotations = _nearest_rotations(np.stack([first, second, np.cross(first, second)], axis=2))
    return rotations, images[..., 2] / scale[..., 0]


def _pose_in_space(images: Array) -> tuple[Array, Array]:
    """Of direct linear transformations (k, 3, 4) to U, V, W; a mirrored one is none, and its residuals tell."""
    linear = images[..., :3]
    scale = np.sqrt((linear**2).sum(axis=(1, 2)) / 3.0)[:, None, None]
    return _nearest_rotations(linear / scale), images[..., 3] / scale[..., 0]


def _nearest_rotations(matrices: Array) -> Array:
    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return np.asarray(left @ right)
