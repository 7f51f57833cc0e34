"""Flat sheets of dots: homography and radial distortion of an image of a sheet, and identification of its dots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from measure.array_types import Array, Integers
from measure.noise.robust_estimation import robust_scale

_RADIAL_FROM, _SECOND_RADIAL_FROM = 10, 30  # points needed to estimate k1, and k2
_LARGEST_RADIAL = 3.0  # at the image corner, relative; a fisheye has up to 1.5
_INVERTING = 25  # rounds that invert the distortion
_SETTLING = 5  # rounds of outlier rejection and refit
_FAR = 4.0  # in median distances: a point farther off is an outlier
_LEAST_FAR_PX = 1.0  # lower bound of that distance
_USUAL_FOCAL = 2.0  # half diagonals; used where no view is oblique enough to determine it
_NEIGHBOURS = 8  # of a named point on the sheet, searched next
_NEAR = 0.3  # in spacings of the points: largest distance of a dot from its predicted place
_IDLE_ROUNDS = 3  # rounds without a gain after which growing ends
_MOST_PAIRS = 150  # of coded dots that are tried
_GROWN = 8  # best hypotheses that are grown
_LEAST_NAMED = 8  # dots: a homography fits any four
_LEAST_SHARE = 0.5  # of the sheet's points within the image
_GATE_SIGMAS, _LEAST_GATE_PX = 6.0, 3.0  # largest distance of a dot from its place, in robust standard deviations
_SHAPE = 1.35  # largest ratio of measured and predicted radius, in any direction, either way


@dataclass(frozen=True, eq=False)
class SheetView:
    """View of a sheet: a homography and radial distortion about the image centre.

    homography (3, 3): sheet to undistorted image coordinates about the centre, in half diagonals; radial (2,): k1 and
    k2 of undistorted = (1 + k1 r² + k2 r⁴) * distorted.
    """

    homography: Array
    radial: Array
    size_px: tuple[int, int]

    def undistorted(self, places_px: Array) -> Array:
        """(n, 2) undistorted image coordinates, in half diagonals, of pixels (n, 2)."""
        place = (places_px - self._middle) / self._unit
        r2 = (place**2).sum(axis=1, keepdims=True)
        return np.asarray(place * (1.0 + self.radial[0] * r2 + self.radial[1] * r2**2))

    def ideal(self, sheet: Array) -> Array:
        """(n, 2) undistorted image coordinates, in half diagonals, of points of the sheet; nan behind the camera."""
        mapped = np.column_stack([sheet, np.ones(len(sheet))]) @ self.homography.T
        depth = np.where(mapped[:, 2:] > 1e-9, mapped[:, 2:], np.nan)
        return np.asarray(mapped[:, :2] / depth)

    def places_px(self, sheet: Array) -> Array:
        """(n, 2) pixels of points of the sheet; nan behind the camera, or where the distortion is not invertible."""
        ideal = self.ideal(sheet)
        radius = np.hypot(*ideal.T)
        distorted = radius.copy()
        for _ in range(_INVERTING):  # Newton: iterated division diverges in a fisheye, whose radii grow as r³ and more
            with np.errstate(all="ignore"):
                r2 = distorted**2
                off = distorted * (1.0 + self.radial[0] * r2 + self.radial[1] * r2**2) - radius
                distorted -= off / np.maximum(1.0 + 3.0 * self.radial[0] * r2 + 5.0 * self.radial[1] * r2**2, 0.1)
        place = ideal * (distorted / np.maximum(radius, 1e-12))[:, None]
        places = place * self._unit + self._middle
        with np.errstate(all="ignore"):
            is_settled = np.hypot(*(self.undistorted(places) - ideal).T) <= 1e-3
        return np.where(is_settled[:, None], places, np.nan)

    def pixel_from_disks(self, sheet: Array, radius: float) -> Array:
        """(n, 2, 2) images of two orthogonal radius vectors of disks centred on points of the sheet, px."""
        steps = radius * np.eye(2)
        return np.stack([self.places_px(sheet + step) - self.places_px(sheet - step) for step in steps], axis=-1) / 2.0

    def pixel_from_space(self, sheet: Array, focal: float, step: float) -> Array:
        """(n, 2, 3) derivatives of the pixels by two coordinates in the sheet and one normal to it. focal: focal length
        in half diagonals; step: of the numerical derivatives, in units of the sheet."""
        along = self.pixel_from_disks(sheet, step) / step
        to_camera = np.diag([1.0, 1.0, focal])
        column, row = (to_camera @ self.homography[:, :2]).T
        length = np.sqrt(np.linalg.norm(column) * np.linalg.norm(row))
        above = np.linalg.solve(to_camera, np.cross(column, row)) / length
        mapped = np.column_stack([sheet, np.ones(len(sheet))]) @ self.homography.T
        # Up to the common factor 1 / depth, which cancels in on_sheet.
        ideal = np.column_stack([self.homography[:, :2], above])
        moved = ideal[:2] - (mapped[:, :2] / mapped[:, 2:])[:, :, None] * ideal[2]
        on_sheet = np.linalg.solve(moved[..., :2], moved[..., 2:])
        return np.concatenate([along, along @ on_sheet], axis=2)

    @property
    def _middle(self) -> Array:
        return (np.array(self.size_px) - 1.0) / 2.0

    @property
    def _unit(self) -> float:
        return float(np.hypot(*self.size_px)) / 2.0


def fit_view(view: SheetView, points: Array, observed_px: Array) -> SheetView | None:
    """Robust fit of a view to observations (n, 2) px of points (n, 2) of the sheet, starting with the distortion of an
    earlier view; None where some points would lie behind the camera."""
    homography = homography_through(points, view.undistorted(observed_px))
    if homography is None:
        return None
    start = SheetView(homography, view.radial, view.size_px)
    terms = 0 if len(points) < _RADIAL_FROM else 1 if len(points) < _SECOND_RADIAL_FROM else 2
    # Two terms of a board that covers a part of the picture may both be large, and one of them not.
    fits = (_fit_terms(start, points, observed_px, count) for count in range(terms, max(terms - 2, -1), -1))
    return next((found for found in fits if np.abs(found.radial).max() < _LARGEST_RADIAL), start)


def _fit_terms(start: SheetView, points: Array, observed_px: Array, terms: int) -> SheetView:
    """Fit a view with some radial terms, 0 to 2."""
    scale = np.abs(start.homography).max(axis=0)

    def view_from_parameters(values: Array) -> SheetView:
        matrix = np.append(values[:8], start.homography[2, 2] / scale[2]).reshape(3, 3) * scale
        return SheetView(matrix, np.append(values[8:], np.zeros(2 - terms)), start.size_px)

    def residuals(values: Array) -> Array:
        candidate = view_from_parameters(values)
        difference = candidate.undistorted(observed_px) - candidate.ideal(points)
        return np.nan_to_num(difference, nan=1.0).ravel()

    values = np.append((start.homography / scale).ravel()[:8], start.radial[:terms])
    width = max(robust_scale(residuals(values)), 1e-4)
    solution = least_squares(residuals, values, loss="soft_l1", f_scale=width, max_nfev=30)
    return view_from_parameters(solution.x)


def fit_view_robustly(points: Array, observed_px: Array, size_px: tuple[int, int]) -> SheetView | None:
    """Fit a view to points of which up to half may be gross errors.

    Least median of squares for the homography (Rousseeuw 1984), then homography and distortion from the inliers.

    Parameters
    ----------
    points, observed_px : (n, 2) on the sheet and in the image.

    Returns
    -------
    None where some inliers would lie behind the camera.
    """
    homography = cv2.findHomography(points, observed_px, cv2.LMEDS)[0]
    if homography is None:
        return None
    off = np.hypot(*(cv2.perspectiveTransform(points[:, None], homography)[:, 0] - observed_px).T)
    view, before = SheetView(np.eye(3), np.zeros(2), size_px), np.zeros(len(points), bool)
    for _ in range(_SETTLING):
        near = off <= max(_FAR * float(np.median(off)), _LEAST_FAR_PX)
        if np.array_equal(near, before):
            break
        before = near
        fitted = fit_view(view, points[near], observed_px[near])
        if fitted is None:
            return None
        view = fitted
        off = np.nan_to_num(np.hypot(*(view.places_px(points) - observed_px).T), nan=np.inf)
    return view


def focal_length(views: Sequence[SheetView]) -> float:
    """Focal length common to the views, in half diagonals, by least squares: the two axes of the sheet are orthogonal
    and of equal scale, a + b focal² = 0 (Zhang 2000)."""
    mixed, square = 0.0, 0.0
    for view in views:
        column, row = (view.homography[:, :2] / np.linalg.norm(view.homography[:, :2])).T
        a = np.array([column[:2] @ row[:2], column[:2] @ column[:2] - row[:2] @ row[:2]])
        b = np.array([column[2] * row[2], column[2] ** 2 - row[2] ** 2])
        mixed += float(a @ b)
        square += float(b @ b)
    focal_square = -mixed / max(square, 1e-12)
    return float(np.sqrt(focal_square)) if focal_square > 0.0 else _USUAL_FOCAL


def homography_through(source: Array, target: Array) -> Array | None:
    """Homography from (n, 2) to (n, 2) by the DLT with normalised coordinates (Hartley 1997), with positive depth at
    the mean of the source; None where the source points would lie on both sides of the camera."""
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


@dataclass(frozen=True, eq=False)
class Dots:
    """Dots detected in an image: centers_px (m, 2), pixel_from_disk (m, 2, 2); coded: point of the sheet (index) of
    each dot whose code was read."""

    centers_px: Array
    pixel_from_disk: Array
    coded: Mapping[int, int]


@dataclass(frozen=True, eq=False)
class Naming:
    """Identification of a sheet's dots. places_px (n, 2), pixel_from_disk (n, 2, 2): predicted place and form of each
    point, nan where it is not visible; named: dot of each point; gate_px: largest distance of a dot from its place;
    misread: coded dots (index) whose code was refuted."""

    places_px: Array
    pixel_from_disk: Array
    named: Mapping[int, int]
    gate_px: float
    misread: tuple[int, ...]


def name_dots(sheet: Array, dots: Dots, size_px: tuple[int, int]) -> Naming | str:
    """Identify the dots of a sheet from its coded dots.

    Parameters
    ----------
    sheet : (n, 2) coordinates of the points, in any unit, right- or left-handed.
    dots : detected dots. All coded dots have one size.
    size_px : width and height of the image.

    Returns
    -------
    The identification that explains most points, or the reason why there is none.
    """
    if len(dots.coded) < 2:
        return f"{len(dots.coded)} coded targets of the sheet were recognised, and two are needed"
    views = _view_hypotheses(sheet, dots, size_px)
    if not views:
        return "no two of the coded targets recognised can both be what their codes say"
    near_codes = _neighbourhood(sheet, list(dots.coded.values()))
    support = [len(_pair_dots(view, sheet, dots.centers_px, near_codes)) for view in views]
    best: Naming | None = None
    for index in np.argsort(-np.array(support), kind="stable")[:_GROWN]:
        naming = _grow(views[index], sheet, dots)
        if naming is not None and (best is None or len(naming.named) > len(best.named)):
            best = naming
        if best is not None and not best.misread:
            break
    if best is None:
        return f"the {len(dots.coded)} coded targets recognised do not put the other points of the sheet where dots are"
    return best


def _view_hypotheses(sheet: Array, dots: Dots, size_px: tuple[int, int]) -> list[SheetView]:
    """View hypotheses, one for each pair of coded dots and each handedness of the sheet's coordinates."""
    pairs = [(a, b) for a, b in combinations(dots.coded, 2) if dots.coded[a] != dots.coded[b]]
    tried = pairs[:: len(pairs) // _MOST_PAIRS + 1]
    views = []
    for hand, (first, second) in product((np.diag([1.0, -1.0]), np.eye(2)), tried):
        points, observed_px = _two_dot_points(sheet, dots, first, second, hand)
        empty = SheetView(np.eye(3), np.zeros(2), size_px)
        homography = homography_through(points, empty.undistorted(observed_px))
        if homography is not None:
            views.append(replace(empty, homography=homography))
    return views


def _two_dot_points(sheet: Array, dots: Dots, first: int, second: int, hand: Array) -> tuple[Array, Array]:
    """Corresponding places on the sheet (10, 2) and in the image (10, 2) from two dots: centres and ends of radii.

    The ellipses are rotated so that the line through both dots corresponds to that on the sheet. On this line, a
    projective map u(t) satisfies u'(0) u'(T) = (u(T) / T)², which gives the radius on the sheet.
    """
    steps = np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float64)
    along_px, observed_px = [], []
    for own, other in ((first, second), (second, first)):
        shape = dots.pixel_from_disk[own]
        axes = shape * np.array([1.0, np.sign(np.linalg.det(shape))])  # right-handed
        line_px = dots.centers_px[other] - dots.centers_px[own]
        on_disk = np.linalg.solve(axes, line_px)
        on_sheet = hand @ (sheet[dots.coded[other]] - sheet[dots.coded[own]])
        angle = np.arctan2(on_disk[1], on_disk[0]) - np.arctan2(on_sheet[1], on_sheet[0])
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        along_px.append(np.hypot(*line_px) / np.hypot(*on_disk))
        observed_px.append(dots.centers_px[own] + steps @ (axes @ rotation @ hand).T)
    apart = np.hypot(*(sheet[dots.coded[second]] - sheet[dots.coded[first]]))
    radius = apart * np.sqrt(along_px[0] * along_px[1]) / np.hypot(*line_px)
    points = [sheet[dots.coded[own]] + radius * steps for own in (first, second)]
    return np.concatenate(points), np.concatenate(observed_px)


def _neighbourhood(sheet: Array, points: list[int]) -> Integers:
    """Integers of points of the sheet and of their neighbours."""
    count = min(_NEIGHBOURS + 1, len(sheet))
    _, near = cKDTree(sheet).query(sheet[points], k=np.arange(1, count + 1))
    return np.unique(near)


def _pair_dots(view: SheetView, sheet: Array, centers_px: Array, among: Integers) -> dict[int, int]:
    """Dot of each of the points `among`: mutual nearest neighbours, much closer than the next point."""
    places = view.places_px(sheet)
    visible = among[np.isfinite(places[among]).all(axis=1)]
    if len(visible) < 2 or not len(centers_px):
        return {}
    tree = cKDTree(places[np.isfinite(places).all(axis=1)])
    spacing = np.asarray(tree.query(places[visible], k=[2])[0])[:, 0]
    distance, dot = (np.asarray(found) for found in cKDTree(centers_px).query(places[visible]))
    back = np.asarray(cKDTree(places[visible]).query(centers_px)[1])
    mutual = (back[dot] == np.arange(len(visible))) & (distance < _NEAR * spacing)
    return {int(point): int(one) for point, one in zip(visible[mutual], dot[mutual], strict=True)}


def _grow(view: SheetView, sheet: Array, dots: Dots) -> Naming | None:
    """Grow the identification outward from the coded dots, refitting the view in each round; None if it fails."""
    among = _neighbourhood(sheet, list(dots.coded.values()))
    pairs = _pair_dots(view, sheet, dots.centers_px, among)
    idle, most = 0, 0
    while idle < _IDLE_ROUNDS:
        if len(pairs) < _LEAST_NAMED // 2:
            return None
        fitted = fit_view(view, sheet[list(pairs)], dots.centers_px[list(pairs.values())])
        if fitted is None:
            return None
        view = fitted
        new = _pair_dots(view, sheet, dots.centers_px, _neighbourhood(sheet, list(pairs)))
        if new == pairs:
            break
        pairs = new
        idle, most = (0, len(pairs)) if len(pairs) > most else (idle + 1, most)
    return _verify(view, sheet, dots, pairs)


def _verify(view: SheetView, sheet: Array, dots: Dots, pairs: Mapping[int, int]) -> Naming | None:
    """Keep dots that agree with the view and their neighbours, in place and form, and are alone; None if too few do."""
    points = np.array(list(pairs))
    observed_px = dots.centers_px[list(pairs.values())]
    places = view.places_px(sheet)
    places += _neighbour_residuals(sheet, points, observed_px - places[points])
    off = observed_px - places[points]
    gate_px = max(_GATE_SIGMAS * robust_scale(off.ravel()), _LEAST_GATE_PX)
    tree = cKDTree(dots.centers_px)

    def is_alone(point: int) -> bool:
        return len(tree.query_ball_point(places[point], gate_px)) == 1

    measured = dots.pixel_from_disk[list(pairs.values())]
    shapes = _predict_forms(view, sheet, points, measured)
    if shapes is None:
        return None
    like = _areas(shapes[points]) > 0.0
    ratios = np.linalg.svd(np.linalg.solve(shapes[points][like], measured[like]), compute_uv=False)
    like[like] = np.all((ratios < _SHAPE) & (ratios > 1.0 / _SHAPE), axis=1)
    named = {
        point: dot
        for (point, dot), distance, fits in zip(pairs.items(), np.hypot(*off.T), like, strict=True)
        if fits and distance <= gate_px and (dots.coded.get(dot) == point or is_alone(point))
    }
    expected = int(np.sum(np.all((places >= 0.0) & (places <= np.array(view.size_px) - 1.0), axis=1)))
    right = sum(named.get(point) == dot for dot, point in dots.coded.items())
    misread = tuple(dot for dot, point in dots.coded.items() if named.get(point) != dot)
    if len(named) < max(min(_LEAST_NAMED, len(sheet)), _LEAST_SHARE * expected) or right < 2 or right <= len(misread):
        return None
    return Naming(places, shapes, named, gate_px, misread)


def _neighbour_residuals(sheet: Array, points: Integers, residuals: Array) -> Array:
    """(n, 2) median residual of the neighbours of each point, px, without its own: a sheet that is not quite flat
    shifts neighbouring dots alike."""
    count = min(_NEIGHBOURS + 1, len(points))
    _, near = cKDTree(sheet[points]).query(sheet, k=np.arange(1, count + 1))
    others = np.where(points[near] == np.arange(len(sheet))[:, None], -1, near)
    of_neighbours = np.where((others < 0)[..., None], np.nan, residuals[near])
    return np.asarray(np.nanmedian(of_neighbours, axis=1))


def _predict_forms(view: SheetView, sheet: Array, points: Integers, measured: Array) -> Array | None:
    """(n, 2, 2) predicted form of all dots, with the median radius on the sheet of those measured at some points; None
    where the view has no derivatives at any of them."""
    step = 0.01 * float(np.ptp(sheet, axis=0).max())
    unit = view.pixel_from_disks(sheet, step) / step
    areas = _areas(measured) / _areas(unit[points])
    if not np.isfinite(areas).any():
        return None
    return np.asarray(unit * np.sqrt(np.nanmedian(areas)))


def _areas(shapes: Array) -> Array:
    """(n,) areas of parallelograms (n, 2, 2); nan where a shape is nan."""
    return np.asarray(np.abs(shapes[:, 0, 0] * shapes[:, 1, 1] - shapes[:, 0, 1] * shapes[:, 1, 0]))
