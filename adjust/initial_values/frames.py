"""Image coordinates in the fiducial system, of frames in one scan or in overlapping parts.

The film transformation of one image is fitted to its fiducial marks, robustly. The parts of a frame are transformed one
after the other into the comparator system of the first, by a similarity fitted to the points in common with the parts
placed so far. All fiducial marks of the frame then determine its film transformation, as if it had been scanned at
once. The film transformation of each part follows from it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from adjust.array_types import Array, Indices
from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Lens
from adjust.functional_model.transformation import (
    Congruent,
    FilmKind,
    Identity,
    Projective,
    film_kind,
    least_marks,
    marks_needed,
    simpler,
)
from adjust.initial_values.pose import Sight
from adjust.linear_algebra.small_matrices import applied
from adjust.problem.network import Image, Network, Transformation
from adjust.problem.observations import Observations

MOST_SUBSETS = 100
GROSS = 13.8  # squared distance, in variances of a coordinate, above which a mark is an outlier (0.1 % point)
PLAINLY = 0.01  # ratio of the squared residuals, mirrored over upright, below which a scan is mirrored
LEAST_VARIANCE_MM2 = 1e-4  # of a coordinate: film deformation and scanner errors reach this
LATTICE = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 8)]), axis=-1).reshape(-1, 2)
FEWEST_COMMON = 3  # common points of two parts: a mirrored similarity fits two points as well


def fit_transformation(transformation: Transformation, comparator_mm: Array, camera_mm: Array) -> tuple[Array, bool]:
    """Fit a film transformation to fiducial marks, robustly against gross errors.

    Parameters
    ----------
    comparator_mm, camera_mm : (n, 2) measured and calibrated coordinates of the same marks, at least `fewest_marks`.

    Returns
    -------
    Parameters in the order of `film_parameter_names`, and whether the scan is mirrored.

    Notes
    -----
    Least squares on all marks if they agree; otherwise on the inliers of a least-trimmed-squares estimate over minimal
    subsets. A projective transformation is fitted to its equations multiplied by the denominator. With too few marks
    for the transformation, the simpler one of its family that they determine is fitted instead. A scan is mirrored if a
    mirrored similarity has far smaller residuals; two marks, or marks on a line, do not decide this and count as
    upright.
    """
    if transformation == "none":
        return np.zeros(0), False
    mirrored = _is_mirrored(comparator_mm, camera_mm)
    kind = film_kind(transformation, mirrored)
    if marks_needed(transformation) > len(comparator_mm) and (lower := simpler(transformation)):
        parameters, _ = fit_transformation(lower, comparator_mm, camera_mm)
        lattice = comparator_mm.mean(axis=0) + _half(comparator_mm) * LATTICE
        return _fit(kind, lattice, film_kind(lower, mirrored).apply(parameters, lattice)), mirrored
    return _robust_fit(kind, comparator_mm, camera_mm)[0], mirrored


def _is_mirrored(comparator_mm: Array, camera_mm: Array) -> bool:
    """Decide whether a scan is mirrored: quickly if all marks agree, else by robust fits, upright and mirrored."""
    if len(comparator_mm) < 3:
        return False
    kinds = [film_kind("similarity", mirrored) for mirrored in (False, True)]
    if _agree(_squared(kinds[0], _fit(kinds[0], comparator_mm, camera_mm), comparator_mm, camera_mm)):
        return False
    upright, mirrored = (_robust_fit(kind, comparator_mm, camera_mm)[1] for kind in kinds)
    return mirrored < PLAINLY * upright


def _robust_fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> tuple[Array, float]:
    """Fit by least trimmed squares; returns the parameters and the trimmed sum of squared distances."""
    n, fewest = len(comparator_mm), least_marks(kind)
    half = (n + fewest + 1) // 2
    best = _fit(kind, comparator_mm, camera_mm)
    squared = _squared(kind, best, comparator_mm, camera_mm)
    best_cost = float(np.sort(squared)[:half].sum())
    if half == n or _agree(squared):
        return best, best_cost
    kept = _subsets(n, fewest)
    for _ in range(3):
        candidates = _fit(kind, comparator_mm[kept], camera_mm[kept])
        squared = _squared(kind, candidates[:, None], comparator_mm, camera_mm)
        kept = np.argsort(squared, axis=1, kind="stable")[:, :half]
    costs = np.take_along_axis(squared, kept, axis=1).sum(axis=1)
    if costs.min() < best_cost:
        best, best_cost = candidates[costs.argmin()], float(costs.min())
    variance = best_cost / (2 * half - len(kind.names))
    agree = _squared(kind, best, comparator_mm, camera_mm) < GROSS * max(variance, LEAST_VARIANCE_MM2)
    return _fit(kind, comparator_mm[agree], camera_mm[agree]), best_cost


def _agree(squared: Array) -> bool:
    """Whether all residuals are within what film deformation and scanner errors explain."""
    return bool((squared < GROSS * LEAST_VARIANCE_MM2).all())


def _subsets(n: int, size: int) -> Indices:
    """(subsets, size): all subsets of n marks, or MOST_SUBSETS random ones if there are more."""
    if comb(n, size) <= MOST_SUBSETS:
        return np.array(list(combinations(range(n), size)))
    generator = np.random.default_rng(0)
    return np.array([generator.permutation(n)[:size] for _ in range(MOST_SUBSETS)])


def _squared(kind: FilmKind, parameters: Array, comparator_mm: Array, camera_mm: Array) -> Array:
    with np.errstate(all="ignore"):  # a subset of poor geometry may map other marks to infinity
        squared = ((kind.apply(parameters, comparator_mm) - camera_mm) ** 2).sum(axis=-1)
    return np.where(np.isfinite(squared), squared, np.inf)


def _fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> Array:
    """Least-squares parameters (..., u) of centred marks (..., n, 2); of minimum norm where they are rank-deficient."""
    center, half = comparator_mm.mean(axis=-2, keepdims=True), _half(comparator_mm)
    target = camera_mm.mean(axis=-2, keepdims=True)
    moved, count = camera_mm - target, len(kind.names)
    match kind:
        case Identity():
            return np.zeros((*half.shape, 0))
        case Congruent():
            return _congruent(kind, comparator_mm - center, moved, center[..., 0, :], target[..., 0, :])
        case Projective():
            return _projective((comparator_mm - center) / half[..., None, None], moved, center, half, target)
    nothing = np.zeros(count)
    design = kind.design(nothing, comparator_mm, center, half[..., None])
    centred = _solved(design, moved)
    parameters = applied(kind.centred_jacobian(nothing, center[..., 0, :], half), centred)
    parameters[..., [kind.names.index("a1"), kind.names.index("b1")]] += target[..., 0, :]
    return parameters


def _solved(design: Array, values: Array) -> Array:
    """Minimum-norm least-squares solution (..., u); design (..., n, 2, u), values (..., n, 2)."""
    rows = design.reshape(*design.shape[:-3], -1, design.shape[-1])
    smallest = max(rows.shape[-2:]) * float(np.finfo(np.float64).eps)  # relative to the largest one, as lstsq
    inverse: Array = np.linalg.pinv(rows, rcond=smallest).astype(np.float64)
    return applied(inverse, values.reshape(*values.shape[:-2], -1))


def _half(xy_mm: Array) -> Array:
    """(...) half the longer side of the bounding box of marks (..., n, 2); 1 where it is 0."""
    half = np.ptp(xy_mm, axis=-2).max(axis=-1) / 2.0
    return np.where(half > 0.0, half, 1.0)


def _congruent(kind: Congruent, xy: Array, moved: Array, center: Array, target: Array) -> Array:
    m = -1.0 if kind.mirrored else 1.0
    (x, y), (u, v) = np.moveaxis(xy, -1, 0), np.moveaxis(moved, -1, 0)
    turn = np.zeros((*center.shape[:-1], 3))
    turn[..., 2] = np.arctan2((x * v - m * y * u).sum(axis=-1), (x * u + m * y * v).sum(axis=-1))
    turn[..., :2] = target - kind.apply(turn, center)
    return turn


def _projective(xy: Array, moved: Array, center: Array, half: Array, target: Array) -> Array:
    """Solve x' (1 + c1 x + c2 y) = a1 + a2 x + a3 y, and likewise for y', after Hartley's normalisation."""
    size = _half(moved)[..., None, None]
    rows = np.zeros((*xy.shape, 8))
    for row in (0, 1):
        rows[..., row, 3 * row] = 1.0
        rows[..., row, 3 * row + 1 : 3 * row + 3] = xy
        rows[..., row, 6:] = -xy * moved[..., row, None] / size
    solved = _solved(rows, moved / size)
    unit = np.concatenate([solved, np.ones_like(solved[..., :1])], axis=-1)[..., [1, 2, 0, 4, 5, 3, 6, 7, 8]]
    matrix = _scaled(size[..., 0, 0], target[..., 0, :]) @ unit.reshape(*half.shape, 3, 3)
    matrix = matrix @ np.linalg.inv(_scaled(half, center[..., 0, :]))
    flat = (matrix / matrix[..., 2:, 2:]).reshape(*half.shape, 9)
    return np.asarray(flat[..., [2, 0, 1, 5, 3, 4, 6, 7]])


def _scaled(size: Array, origin: Array) -> Array:
    """Homogeneous matrices (..., 3, 3) that scale by size (...) and then shift to origin (..., 2)."""
    matrix = np.zeros((*size.shape, 3, 3))
    matrix[..., [0, 1], [0, 1]], matrix[..., :2, 2], matrix[..., 2, 2] = size[..., None], origin, 1.0
    return matrix


@dataclass(frozen=True, eq=False)
class Frames:
    """Object points of all images in the fiducial system, image by image, sorted by point name within each."""

    network: Network
    rows: Indices  # (n,) numbers of the observations
    xy_mm: Array  # (n, 2) image coordinates
    starts: Indices  # (images + 1,) index of the first point of each image; the last is n
    sigma_mm: Array  # (images,) median standard deviation of an image coordinate; 0 for an image without points

    def part(self, image: int) -> slice:
        return slice(int(self.starts[image]), int(self.starts[image + 1]))

    def camera_images(self, camera: str) -> list[int]:
        """Numbers of the camera's images that show object points."""
        images = enumerate(self.network.images)
        return [i for i, image in images if image.camera == camera and self.starts[i] < self.starts[i + 1]]

    def places(self, images: list[int]) -> Indices:
        """Indices of the points of the given images, one image after the other."""
        return np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in images])

    def sights(self, camera: str, lens: Lens) -> dict[str, Sight]:
        """Reduce the images of a camera to the principal point and correct them for distortion; by image name.

        Coordinates outside the invertible range of the distortion are not corrected for it.
        """
        images, names = self.camera_images(camera), self.network.observations.point
        if not images:
            return {}
        at = self.places(images)
        ideal, found = lens.ideal_from_observed(self.xy_mm[at])
        freed_mm = np.empty_like(self.xy_mm)
        freed_mm[at] = np.where(found[:, None], ideal, self.xy_mm[at]) - lens.interior[1:]
        return {
            self.network.images[i].name: Sight(
                tuple([names[row] for row in self.rows[self.part(i)].tolist()]),
                freed_mm[self.part(i)],
                float(lens.interior[0]),
                float(self.sigma_mm[i]),
            )
            for i in images
        }


def camera_frames(network: Network, transformation: Mapping[str, Array], mirrored: frozenset[str]) -> Frames:
    """Transform the object points of all images into the fiducial system.

    transformation: parameters of the film transformation by image name; mirrored: names of the mirrored scans.
    """
    observations, count = network.observations, len(network.images)
    names, number = observations.numbered_points
    rank = np.empty(len(names), dtype=np.intp)
    rank[np.argsort(np.array(names), kind="stable")] = np.arange(len(names))
    rows = np.flatnonzero(~observations.is_fiducial)
    rows = rows[np.lexsort((rank[number[rows]], network.image_numbers[rows]))]
    images = network.image_numbers[rows]
    starts = np.searchsorted(images, np.arange(count + 1))
    variances = np.trace(observations.covariance_mm2[rows], axis1=1, axis2=2) / 2.0
    xy_mm = network.straight_xy_mm[rows]
    for i, image in enumerate(network.images):
        if image.transformation != "none":
            part, kind = slice(starts[i], starts[i + 1]), film_kind(image.transformation, image.name in mirrored)
            xy_mm[part] = kind.apply(transformation[image.name], xy_mm[part])
    return Frames(network, rows, xy_mm, starts, np.sqrt(_medians(variances, images, starts)))


def _medians(values: Array, group: Indices, starts: Indices) -> Array:
    """Medians (g,) of values (n,) by group, the groups one after the other; 0 for an empty group."""
    if not len(values):
        return np.zeros(len(starts) - 1)
    ordered = values[np.lexsort((values, group))]
    counts = np.diff(starts)
    middle = np.minimum([starts[:-1] + (counts - 1) // 2, starts[:-1] + counts // 2], len(values) - 1)
    return np.asarray(np.where(counts > 0, ordered[middle].mean(axis=0), 0.0))


Film = tuple[Array, bool]  # parameters, and whether the scan is mirrored
Mark = tuple[str, str]  # kind and point


def joined_frame(network: Network, parts: Sequence[Image]) -> tuple[dict[str, Film], dict[str, Array]]:
    """Film transformations of the parts of one frame by name, and its joins (2,) in the fiducial system, mm, by point.

    Raises AdjustmentError if the parts have too few points in common, or the frame has too few fiducial marks.
    """
    marks_by_part = {part.name: _marks(network, part) for part in parts}
    first_from, place = _placed(parts[0].part_of, marks_by_part)
    given = network.camera_by_name[parts[0].camera].fiducials
    marks = sorted(point for kind, point in place if kind == "fiducial")
    camera_mm = np.array([[given[mark].x_mm.value, given[mark].y_mm.value] for mark in marks]).reshape(-1, 2)
    first_mm = np.array([place["fiducial", mark] for mark in marks]).reshape(-1, 2)
    kind = parts[0].transformation
    parameters, mirrored = fit_transformation(kind, first_mm, camera_mm)
    whole = film_kind(kind, mirrored)
    films = {}
    for part in parts:
        xy_mm = np.array(list(marks_by_part[part.name].values()))
        lattice = (xy_mm.min(axis=0) + xy_mm.max(axis=0)) / 2 + np.ptp(xy_mm, axis=0) / 2 * LATTICE
        turned, is_mirrored = first_from[part.name]
        in_first = film_kind("similarity", is_mirrored).apply(turned, lattice)
        films[part.name] = fit_transformation(kind, lattice, whole.apply(parameters, in_first))
    joins = [(point, xy) for (what, point), xy in place.items() if what == "join"]
    in_camera = whole.apply(parameters, np.array([xy for _, xy in joins]).reshape(-1, 2))
    return films, {point: xy for (point, _), xy in zip(joins, in_camera, strict=True)}


def _marks(network: Network, part: Image) -> dict[Mark, Array]:
    """Comparator coordinates of all marks of a part, sorted by kind and name."""
    rows = np.flatnonzero(network.image_numbers == network.images.index(part))
    observations = network.observations
    return {
        (observations.kind[row], observations.point[row]): network.straight_xy_mm[row]
        for row in sorted(rows, key=lambda row: (observations.kind[row], observations.point[row]))
    }


def _placed(frame: str, marks_by_part: Mapping[str, Mapping[Mark, Array]]) -> tuple[dict[str, Film], dict[Mark, Array]]:
    """Place the parts in the comparator system of the first; the part with most common points comes next."""
    # Returns the similarity of each part, and the coordinates (2,) of all marks in the system of the first.
    left = list(marks_by_part)
    films: dict[str, Film] = {left[0]: (np.array([0.0, 0.0, 1.0, 0.0]), False)}
    place = dict(marks_by_part[left.pop(0)])
    while left:
        name = max(left, key=lambda name: len(place.keys() & marks_by_part[name].keys()))
        own, common = marks_by_part[name], sorted(place.keys() & marks_by_part[name].keys())
        if len(common) < FEWEST_COMMON:
            raise AdjustmentError(
                f"frame {frame}: its scan {name} has {len(common)} points in common with {', '.join(films)}; joining "
                f"them takes {FEWEST_COMMON}, and more to be checked. Scan the frame in parts that overlap, measure "
                "crosses that both show, or leave the scan out."
            )
        in_part, in_first = (np.array([where[mark] for mark in common]) for where in (own, place))
        films[name] = fit_transformation("similarity", in_part, in_first)
        moved = film_kind("similarity", films[name][1]).apply(films[name][0], np.array(list(own.values())))
        place |= {mark: xy for mark, xy in zip(own, moved, strict=True) if mark not in place}
        left.remove(name)
    return films, place


def whole_frames(network: Network, films: Mapping[str, Film]) -> Network:
    """Reduce a network to whole frames, with each point measured once and in the fiducial system.

    The result holds the frames that show object points, without film transformations, join points and fiducial marks.
    """
    first: dict[str, Image] = {}
    for image in network.images:
        if image.name not in network.objectless_images:
            first.setdefault(image.frame, image)
    observations, xy_mm = network.observations, network.straight_xy_mm.copy()
    for i, image in enumerate(network.images):
        rows = network.image_numbers == i
        parameters, mirrored = films[image.name]
        xy_mm[rows] = film_kind(image.transformation, mirrored).apply(parameters, xy_mm[rows])
    frame_of = {image.name: image.frame for image in network.images}
    kept: dict[tuple[str, str], int] = {}
    for row in np.flatnonzero(~observations.is_fiducial):
        kept.setdefault((frame_of[observations.image[row]], observations.point[row]), int(row))
    rows = np.array(list(kept.values()), dtype=np.intp)
    return replace(
        network,
        images=tuple(Image(frame, image.camera, "none", image.exterior) for frame, image in first.items()),
        observations=Observations(
            tuple(frame for frame, _ in kept),
            tuple(point for _, point in kept),
            tuple(observations.kind[row] for row in rows),
            xy_mm[rows],
            observations.covariance_mm2[rows],
        ),
        distances=tuple(
            replace(each, start=frame_of.get(each.start, each.start), end=frame_of.get(each.end, each.end))
            for each in network.distances
        ),
        calibrations=(),
        scanners=(),
    )
