"""Image points, poses and known points: P3P, refinement of many poses at once by least squares, and intersection.

Object points are centred on their mean and divided by their extent; image coordinates are divided by c (tangents).
Arrays (k, n) hold n points of k images; points that an image does not show have weight 0. The intersection gives object
points from the rays of oriented images.
"""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.rotation import rotation_from_vector

LM_ITERATIONS = 12  # most of Levenberg and Marquardt's steps for a pose
SETTLED = 1e-4  # relative change of a sum of squares at convergence
BEHIND = 1e6  # squared residual, in squared principal distances, of a point behind the camera
LARGEST_CHANGE = 0.5  # of the logarithm of the principal distance in one step
USUAL_BEND = 0.3  # prior standard deviation of third-degree radial distortion, at an angle of 45 degrees
ITERATIONS = 16  # of reweighting, half with weights of the first power
SMALLEST_ANGLE = 1e-12  # rad, rounding: keeps weights finite where all rays meet
WEAKEST = 1e-8  # least eigenvalue of the normal matrix of a usable point: rays 0.01 degrees apart


@dataclass(frozen=True)
class Sight:
    """Points of one image, in the order of their ids."""

    points: tuple[str, ...]  # (n,) ids
    xy_mm: Array  # (n, 2) ideal coordinates relative to the principal point, y up
    principal_distance_mm: float  # principal distance
    sigma_mm: float  # typical standard deviation of one coordinate

    @property
    def rays(self) -> Array:
        """(n, 3) directions to the points in the camera frame: (x', y', -c)."""
        return np.column_stack([self.xy_mm, np.full(len(self.xy_mm), -self.principal_distance_mm)])


@dataclass(frozen=True)
class Pose:
    """Exterior orientation: rotation (3, 3) from object to camera, projection centre (3,) in object units."""

    rotation: Array
    center: Array


@dataclass(frozen=True, eq=False)
class KnownField:
    """Known points in one image: xyz (n, 3); xy_mm (n, 2) relative to the principal point, and their sigma in mm."""

    xyz: Array
    xy_mm: Array
    sigma_mm: float


def image_distances(pose: Pose, xyz: Array, xy_mm: Array, principal_distance_mm: float) -> Array:
    """Distances (n,) in mm between observed and projected points; inf behind the camera."""
    shift = -pose.rotation @ pose.center
    squared = squared_residuals(pose.rotation[None], shift[None], xyz, xy_mm / principal_distance_mm)[0]
    return np.where(squared < BEHIND, principal_distance_mm * np.sqrt(squared), np.inf)


def refined_poses(
    rotations: Array, shifts: Array, points: Array, tangents: Array, weights: Array
) -> tuple[Array, Array]:
    """Refine k poses by weighted least squares (Levenberg and Marquardt).

    Parameters
    ----------
    rotations, shifts : (k, 3, 3) and (k, 3) approximations, camera = R X + t.
    points, tangents, weights : (k, n, 3), (k, n, 2), (k, n).

    Returns
    -------
    Rotations and shifts.
    """
    rotations, shifts, damping = rotations.copy(), shifts.copy(), np.full(len(rotations), 1e-4)
    cost = (weights * squared_residuals(rotations, shifts, points, tangents)).sum(axis=1)
    going = np.arange(len(rotations))
    for _ in range(LM_ITERATIONS):
        fields = points[going], tangents[going]
        normal, right = _normal_equations(rotations[going], shifts[going], *fields, weights[going])
        diagonal = np.einsum("kii->ki", normal)
        diagonal += damping[going, None] * diagonal + 1e-14  # the constant avoids singular matrices
        step = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], dtype=np.float64)
        moved = _step_poses(rotations[going], shifts[going], step)
        new_cost = (weights[going] * squared_residuals(*moved, *fields)).sum(axis=1)
        better, moves = new_cost < cost[going], np.abs(cost[going] - new_cost) > SETTLED * cost[going]
        taken = going[better]
        rotations[taken], shifts[taken] = (each[better] for each in moved)
        damping[going] *= np.where(better, 0.1, 10.0)
        cost[taken] = new_cost[better]
        going = going[moves]
        if not len(going):
            break
    return rotations, shifts


def refined_distance(
    rotations: Array, shifts: Array, points: Array, xy_mm: Array, weights: Array, distance_mm: float, sigma_mm: float
) -> tuple[float, float, Array, Array, Array]:
    """Estimate one principal distance from all images together.

    Parameters
    ----------
    rotations, shifts : (k, 3, 3) and (k, 3) approximate poses, camera = R X + t.
    points, xy_mm, weights : (k, n, 3), (k, n, 2), (k, n).
    distance_mm : approximate principal distance.
    sigma_mm : lower bound of the standard deviation of image coordinates.

    Returns
    -------
    Principal distance in mm, and the standard deviation of its logarithm: infinite if the points do not determine it,
    or the iteration does not converge;
    rotations, shifts, and image coordinates over c without distortion (k, n, 2).

    Raises
    ------
    numpy.linalg.LinAlgError
        If gross errors bring points behind the camera.

    Notes
    -----
    Gauss-Newton steps with the poses eliminated. Radial distortion of the third degree, with prior 0, is estimated as a
    nuisance parameter: otherwise it would bias the principal distance.
    """
    c, bend, noise = distance_mm, 0.0, sigma_mm / distance_mm
    by_bend_mm = xy_mm * ((xy_mm / c) ** 2).sum(axis=2, keepdims=True)
    prior = np.array([1e-14, (noise / USUAL_BEND) ** 2])
    for _ in range(LM_ITERATIONS):
        lens = xy_mm / c, by_bend_mm / c
        normal, right = _normal_equations(rotations, shifts, points, lens[0] - bend * lens[1], weights, lens[1])
        both = np.concatenate([normal[:, :6, 6:], right[:, :6, None]], axis=2)
        through = np.linalg.solve(normal[:, :6, :6] + 1e-14 * np.eye(6), both)
        left = (normal[:, 6:, :] @ np.concatenate([through, np.zeros((len(normal), 2, 3))], axis=1)).sum(axis=0)
        reduced = normal[:, 6:, 6:].sum(axis=0) - left[:, :2] + np.diag(prior)
        change = np.linalg.solve(reduced, right[:, 6:].sum(axis=0) - left[:, 2] - prior * [0.0, bend])
        change = np.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE)
        rotations, shifts = _step_poses(rotations, shifts, through[..., 2] - through[..., :2] @ change)
        c, bend = c * float(np.exp(change[0])), bend + float(change[1])
        if is_settled := bool(abs(change[0]) < np.sqrt(SETTLED)):
            break
    tangents = (xy_mm - bend * by_bend_mm) / c
    squares = float((weights * squared_residuals(rotations, shifts, points, tangents)).sum())
    variance = max(squares / max(2.0 * float(weights.sum()) - 6 * len(points) - 2, 1.0), noise**2)
    cofactor = float(np.linalg.inv(reduced)[0, 0])
    spread = float(np.sqrt(variance * cofactor)) if cofactor > 0 and is_settled else np.inf
    return c, spread, rotations, shifts, tangents


def squared_residuals(rotations: Array, shifts: Array, points: Array, tangents: Array) -> Array:
    """Squared residuals (k, n), in squared principal distances, of points (n, 3) or (k, n, 3); BEHIND at most."""
    u, v, w = _camera_coordinates(rotations, shifts, points)
    in_front = w < 0.0
    depth = np.where(in_front, w, -1.0)
    squared = (u / depth + tangents[..., 0]) ** 2 + (v / depth + tangents[..., 1]) ** 2
    return np.asarray(np.where(in_front & (squared < BEHIND), squared, BEHIND))


def _step_poses(rotations: Array, shifts: Array, step: Array) -> tuple[Array, Array]:
    turn = rotation_from_vector(step[:, :3])
    return turn @ rotations, np.einsum("kij,kj->ki", turn, shifts) + step[:, 3:]


def _camera_coordinates(rotations: Array, shifts: Array, points: Array) -> Array:
    """U, V, W (3, k, n) of points (n, 3) or (k, n, 3) in the axes of k cameras."""
    return np.asarray((rotations @ points.swapaxes(-1, -2) + shifts[..., None]).swapaxes(0, 1))


def _normal_equations(
    rotations: Array, shifts: Array, points: Array, tangents: Array, weights: Array, by_bend: Array | None = None
) -> tuple[Array, Array]:
    """Normal equations J'WJ (k, 6, 6) and J'Wr (k, 6) for a small rotation of the camera and a shift in its axes."""
    # by_bend (k, n, 2): derivatives of the tangents with respect to distortion; adds two unknowns, the logarithm of the
    # principal distance and the distortion parameter.
    u, v, w = _camera_coordinates(rotations, shifts, points)
    inverse = -1.0 / np.minimum(w, -1e-9)
    p, q = u * inverse, v * inverse
    x, y, n = tangents[..., 0], tangents[..., 1], w.shape[1]
    columns = [(p * q, 1 + q * q), (-1 - p * p, -p * q), (-q, p), (inverse, 0.0), (0.0, inverse)]
    columns.append((p * inverse, q * inverse))
    if by_bend is not None:
        columns += [(p, q), (by_bend[..., 0], by_bend[..., 1])]
    jacobian = np.zeros((len(w), len(columns), 2 * n))  # first all x, then all y
    for k, (by_p, by_q) in enumerate(columns):
        jacobian[:, k, :n], jacobian[:, k, n:] = by_p, by_q
    residual = np.concatenate([x - p, y - q], axis=1)[..., None]
    weighted = jacobian * np.concatenate([weights, weights], axis=1)[:, None]
    return weighted @ jacobian.swapaxes(1, 2), (weighted @ residual)[..., 0]


def triple_poses(points: Array, tangents: Array) -> tuple[Array, Array, Indices]:
    """Solve P3P for many triples of points.

    Parameters
    ----------
    points : (m, 3, 3) object coordinates.
    tangents : (m, 3, 2) image coordinates over c.

    Returns
    -------
    rotations (k, 3, 3) and shifts (k, 3), camera = R X + t, and the number (k,) of the triple of each.

    Notes
    -----
    Grunert's solution (Haralick et al. 1994, eqs. 7-9): a quartic in the ratio of two of the three distances.
    """
    rays = np.concatenate([tangents, np.full((*tangents.shape[:2], 1), -1.0)], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    first, second = [1, 0, 0], [2, 2, 1]  # of the sides a, b, c
    a2, b2, c2 = ((points[:, first] - points[:, second]) ** 2).sum(axis=2).T
    cos_a, cos_b, cos_g = (rays[:, first] * rays[:, second]).sum(axis=2).T
    with np.errstate(all="ignore"):  # degenerate triples give nan or inf and are dropped below
        ratio_v = _quartic_roots(_grunert_quartic(a2 / b2, c2 / b2, cos_a, cos_b, cos_g))
        d = ((a2 - c2) / b2)[:, None]
        numerator = (d - 1) * ratio_v**2 - 2 * d * cos_b[:, None] * ratio_v + 1 + d
        ratio_u = numerator / (2 * (cos_g[:, None] - ratio_v * cos_a[:, None]))
        distance = np.sqrt(b2[:, None] / (1 + ratio_v**2 - 2 * ratio_v * cos_b[:, None]))
        distances = np.stack([distance, ratio_u * distance, ratio_v * distance], axis=2)  # (m, 4, 3)
        in_camera = distances[..., None] * rays[:, None]
        rotations = _triad(in_camera) @ np.swapaxes(_triad(points), 1, 2)[:, None]
        shifts = in_camera.mean(axis=2) - np.einsum("mkij,mj->mki", rotations, points.mean(axis=1))
    usable = (distances > 0).all(axis=2) & np.isfinite(rotations).all(axis=(2, 3)) & np.isfinite(shifts).all(axis=2)
    return rotations[usable], shifts[usable], np.nonzero(usable)[0]


def _grunert_quartic(a: Array, c: Array, cos_a: Array, cos_b: Array, cos_g: Array) -> Array:
    """Coefficients (m, 5) of the quartic, highest degree first; a, c: squared sides over b²."""
    d, s = a - c, a + c
    return np.stack(
        [
            (d - 1) ** 2 - 4 * c * cos_a**2,
            4 * (d * (1 - d) * cos_b - (1 - s) * cos_a * cos_g + 2 * c * cos_a**2 * cos_b),
            2 * (d**2 - 1 + 2 * d**2 * cos_b**2 + 2 * (1 - c) * cos_a**2 - 4 * s * cos_a * cos_b * cos_g)
            + 4 * (1 - a) * cos_g**2,
            4 * (-d * (1 + d) * cos_b + 2 * a * cos_g**2 * cos_b - (1 - s) * cos_a * cos_g),
            (1 + d) ** 2 - 4 * a * cos_g**2,
        ],
        axis=1,
    )


def _quartic_roots(coefficients: Array) -> Array:
    """Real parts (m, 4) of the roots: noise turns the double root of a camera above its points into a complex pair."""
    # Ferrari: a root m of the resolvent cubic, the largest of three, splits the quartic into two quadratic equations.
    b, c, d, e = (coefficients[:, 1:] / coefficients[:, :1]).astype(np.complex128).T
    p, q, r = c - 3 * b**2 / 8, d - b * c / 2 + b**3 / 8, e - b * d / 4 + b**2 * c / 16 - 3 * b**4 / 256
    linear, constant = -(p**2) / 12 - r, -(p**3) / 108 + p * r / 3 - q**2 / 8
    root = np.sqrt(constant**2 / 4 + linear**3 / 27)
    cube = -constant / 2 + np.where((constant.conj() * root).real > 0, -root, root)
    each = cube ** (1 / 3) * np.exp(2j * np.pi / 3 * np.arange(3))[:, None]
    m = each - linear / (3 * each) - p / 3
    s = np.sqrt(2 * m[np.abs(m).argmax(axis=0), np.arange(len(p))])
    first, second = (np.sqrt(-2 * p - s**2 - 2 * sign * q / s) for sign in (1, -1))
    return np.asarray(np.stack([s + first, s - first, second - s, -second - s], axis=1).real / 2 - b.real[:, None] / 4)


def _triad(points: Array) -> Array:
    """Orthonormal axes (..., 3, 3), in columns, attached to three points (..., 3, 3)."""
    x = points[..., 1, :] - points[..., 0, :]
    z = np.cross(x, points[..., 2, :] - points[..., 0, :])
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def intersect(centers: Array, directions: Array, point: Indices, known: Array) -> tuple[Array, Array]:
    """Intersect rays robustly, minimising angles; one gross error among several rays does no harm.

    Parameters
    ----------
    centers, directions : (m, 3) rays; directions of any length, pointing away from the camera.
    point : (m,) number of the point of each ray.
    known : (p, 3) given coordinates, nan where they are to be determined.

    Returns
    -------
    points : (p, 3), nan where the rays do not determine a point.
    determination : (p,) smallest eigenvalue of the normal matrix of unit rays, about half the squared angle between two
        rays; 0 where there is no point.
    """
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    sought: Mask = np.isnan(known)
    normal = np.where(sought[:, :, None] & sought[:, None, :], _sums(across, point, len(known)), 0.0)
    normal += np.where(sought, 0.0, 1e6)[:, :, None] * np.eye(3)  # a given coordinate is no unknown
    determination = np.linalg.eigvalsh(normal)[:, 0]
    usable: Mask = determination > WEAKEST
    weights = np.ones(len(point))
    for iteration in range(ITERATIONS):
        points = _nearest(across * weights[:, None, None], centers, point, known, usable)
        offset = points[point] - centers
        distance = np.linalg.norm(offset, axis=1)
        angle = np.linalg.norm(np.einsum("mij,mj->mi", across, offset), axis=1) / distance
        scale = 2.0 * (np.nanmedian(angle) if usable.any() else 1.0) + SMALLEST_ANGLE
        # First the sum of angles, which has a single minimum; then the Cauchy function, which rejects gross errors.
        power = 1.0 if iteration < ITERATIONS // 2 else 2.0
        weights = np.nan_to_num(1.0 / (distance**2 * (angle**power + scale**power)), nan=0.0)
        weights /= np.max(weights, initial=np.finfo(float).tiny)
    in_front = np.einsum("mi,mi->m", points[point] - centers, directions) > 0
    majority = np.bincount(point, np.where(in_front, 1.0, -1.0), len(known)) > 0
    good = np.logical_and(usable, majority)
    return np.where(good[:, None], points, np.nan), np.where(good, determination, 0.0)


def _sums(values: Array, point: Indices, count: int) -> Array:
    """Sums (p, ...) over each point's values (m, ...)."""
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, point, values)
    return sums


def _nearest(across: Array, centers: Array, point: Indices, known: Array, usable: Mask) -> Array:
    """Weighted least-squares points (p, 3) with given coordinates fixed; nan where not usable."""
    normal = _sums(across, point, len(known))
    right = _sums(np.einsum("mij,mj->mi", across, centers), point, len(known))
    given = ~np.isnan(known)
    values = np.where(given, known, 0.0)
    right = np.where(given, values, right - np.einsum("pij,pj->pi", normal, values))
    normal = np.where(given[:, :, None] | given[:, None, :], np.eye(3), normal)
    points = np.full(known.shape, np.nan)
    solvable = usable & (np.linalg.det(normal) != 0.0)  # singular if all rays lost their weight
    if solvable.any():
        points[solvable] = np.linalg.solve(normal[solvable], right[solvable][..., None])[..., 0]
    return points
