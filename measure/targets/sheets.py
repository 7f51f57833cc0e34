"""Flat sheets of dots: the homography and radial distortion of a picture of one, and which dot is which point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from measure.noise.robust_estimation import robust_scale

Array = NDArray[np.float64]

_RADIAL_FROM, _SECOND_RADIAL_FROM = 10, 30  # points, from which on the lens's radial distortion is estimated too
_LARGEST_RADIAL = 0.6  # at the picture's corner, relative
_SETTLING = 5  # rounds, in which a view takes in what the lens moved
_FAR = 4.0  # medians of the distances, beyond which a point does not tell where the sheet lies
_LEAST_FAR_PX = 1.0  # no point nearer than it is far
_USUAL_FOCAL = 2.0  # half diagonals, where no view is oblique enough to tell it
Indices = NDArray[np.int64]

_NEIGHBOURS = 8  # of a named point on the sheet, that are looked for next
_NEAR = 0.3  # of the distance to the next point in the picture, between where a dot is expected and where it is
_IDLE_ROUNDS = 3  # after which names that come and go are not followed any further
_MOST_PAIRS = 150  # of coded dots
_GROWN = 8  # suggestions, the best ones, that are followed to their end
_LEAST_NAMED = 8  # dots: a homography goes through any four
_LEAST_SHARE = 0.5  # of the sheet's points in the picture
_GATE_SIGMAS, _LEAST_GATE_PX = 6.0, 3.0  # of the dots' scatter about their places, how far off one may lie
_SHAPE = 1.35  # radii of a dot's ellipse over those expected, in any direction, or the reverse


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
        steps = radius * np.eye(2)
        return np.stack([self.places_px(sheet + step) - self.places_px(sheet - step) for step in steps], axis=-1) / 2.0

    def pixel_from_space(self, sheet: Array, focal: float, step: float) -> Array:
        """(n, 2, 3) how far a unit along the sheet, both ways, and one above it move its points, px; focal: the lens's
        focal length in half diagonals; step: a small length on the sheet."""
        along = self.pixel_from_disks(sheet, step) / step
        to_camera = np.diag([1.0, 1.0, focal])
        column, row = (to_camera @ self.homography[:, :2]).T
        length = np.sqrt(np.linalg.norm(column) * np.linalg.norm(row))
        above = np.linalg.solve(to_camera, np.cross(column, row)) / length
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


def fitted_view(view: SheetView, points: Array, observed_px: Array) -> SheetView | None:
    """The view, near one given, that explains best where points (n, 2) of the sheet are observed (n, 2), single
    wrong ones tolerated; None where no camera sees them so."""
    homography = homography_through(points, view.undistorted(observed_px))
    if homography is None:
        return None
    start = SheetView(homography, view.radial, view.size_px)
    terms = 0 if len(points) < _RADIAL_FROM else 1 if len(points) < _SECOND_RADIAL_FROM else 2
    scale = np.abs(homography).max(axis=0)

    def view_from_parameters(values: Array) -> SheetView:
        matrix = np.append(values[:8], homography[2, 2] / scale[2]).reshape(3, 3) * scale
        return SheetView(matrix, np.append(values[8:], np.zeros(2 - terms)), view.size_px)

    def residuals(values: Array) -> Array:
        candidate = view_from_parameters(values)
        difference = candidate.undistorted(observed_px) - candidate.ideal(points)
        return np.nan_to_num(difference, nan=1.0).ravel()

    values = np.append((start.homography / scale).ravel()[:8], view.radial[:terms])
    width = max(robust_scale(residuals(values)), 1e-4)
    solution = least_squares(residuals, values, loss="soft_l1", f_scale=width, max_nfev=30)
    found = view_from_parameters(solution.x)
    return found if np.abs(found.radial).max() < _LARGEST_RADIAL else start


def robust_view(points: Array, observed_px: Array, size_px: tuple[int, int]) -> SheetView | None:
    """The view that more than half of the points (n, 2), observed at (n, 2) px, agree with, wherever the others are;
    None where no camera sees them so.

    Least median of squares (Rousseeuw 1984) without a lens, then the lens as well, by those that do not lie far off.
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
        fitted = fitted_view(view, points[near], observed_px[near])
        if fitted is None:
            return None
        view = fitted
        off = np.nan_to_num(np.hypot(*(view.places_px(points) - observed_px).T), nan=np.inf)
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


@dataclass(frozen=True, eq=False)
class Dots:
    """Dots found in a picture: centers_px (m, 2), pixel_from_disk (m, 2, 2), and the points of the sheet (by index)
    that codes say some of them are."""

    centers_px: Array
    pixel_from_disk: Array
    coded: Mapping[int, int]


@dataclass(frozen=True, eq=False)
class Naming:
    """places_px (n, 2), pixel_from_disk (n, 2, 2): where and how the points of the sheet should be seen, nan where they
    cannot; named: the dot of each point; gate_px: how far a dot may lie from its place; misread: coded dots (index)
    that are not the point that their code says."""

    places_px: Array
    pixel_from_disk: Array
    named: Mapping[int, int]
    gate_px: float
    misread: tuple[int, ...]


def name_dots(sheet: Array, dots: Dots, size_px: tuple[int, int]) -> Naming | str:
    """Name the dots that are points of a sheet.

    Parameters
    ----------
    sheet : (n, 2) the points' places on it, in any unit and of either hand.
    dots : as found. Coded dots are as large as one another.
    size_px : width and height of the picture.

    Returns
    -------
    The names, of a suggestion that explains most of the points that it puts into the picture; or why there are none.
    """
    if len(dots.coded) < 2:
        return f"{len(dots.coded)} coded targets of the sheet were recognised, and two are needed"
    views = _suggestions(sheet, dots, size_px)
    if not views:
        return "no two of the coded targets recognised can both be what their codes say"
    near_codes = _neighbourhood(sheet, list(dots.coded.values()))
    support = [len(_pairs(view, sheet, dots.centers_px, near_codes)) for view in views]
    best: Naming | None = None
    for index in np.argsort(-np.array(support), kind="stable")[:_GROWN]:
        naming = _grown(views[index], sheet, dots)
        if naming is not None and (best is None or len(naming.named) > len(best.named)):
            best = naming
        if best is not None and not best.misread:
            break
    if best is None:
        return f"the {len(dots.coded)} coded targets recognised do not put the other points of the sheet where dots are"
    return best


def _suggestions(sheet: Array, dots: Dots, size_px: tuple[int, int]) -> list[SheetView]:
    """A view for each two coded dots, for the sheet's front and for its back, whose coordinates are left-handed."""
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
    """Places on the sheet (10, 2) and in the picture (10, 2) that two dots give: centres and ends of radius vectors.

    Their ellipses are turned so that the line through both is that of the sheet. On this line, a projective map u(t)
    has u'(0) u'(T) = (u(T) / T)²: that gives the radius on the sheet.
    """
    steps = np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)], np.float64)
    along_px, observed_px = [], []
    for own, other in ((first, second), (second, first)):
        axes = _right_handed(dots.pixel_from_disk[own])
        line_px = dots.centers_px[other] - dots.centers_px[own]
        on_disk = np.linalg.solve(axes, line_px)
        turned = axes @ _turn(hand @ (sheet[dots.coded[other]] - sheet[dots.coded[own]]), on_disk) @ hand
        along_px.append(np.hypot(*line_px) / np.hypot(*on_disk))
        observed_px.append(dots.centers_px[own] + steps @ turned.T)
    apart = np.hypot(*(sheet[dots.coded[second]] - sheet[dots.coded[first]]))
    radius = apart * np.sqrt(along_px[0] * along_px[1]) / np.hypot(*line_px)
    points = [sheet[dots.coded[own]] + radius * steps for own in (first, second)]
    return np.concatenate(points), np.concatenate(observed_px)


def _right_handed(axes: Array) -> Array:
    return np.asarray(axes * np.array([1.0, np.sign(np.linalg.det(axes))]))


def _turn(start: Array, end: Array) -> Array:
    """The rotation (2, 2) from one direction to another."""
    angle = np.arctan2(end[1], end[0]) - np.arctan2(start[1], start[0])
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _neighbourhood(sheet: Array, points: list[int]) -> Indices:
    """Indices of points of the sheet and of those next to them."""
    count = min(_NEIGHBOURS + 1, len(sheet))
    _, near = cKDTree(sheet).query(sheet[points], k=np.arange(1, count + 1))
    return np.unique(near)


def _pairs(view: SheetView, sheet: Array, centers_px: Array, among: Indices) -> dict[int, int]:
    """The dot of each of the points `among`: nearest to one another and nearer than any other point's place."""
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


def _grown(view: SheetView, sheet: Array, dots: Dots) -> Naming | None:
    """Names from the coded dots outward, the view fitted anew in every round; None where it explains too little."""
    among = _neighbourhood(sheet, list(dots.coded.values()))
    pairs = _pairs(view, sheet, dots.centers_px, among)
    idle, most = 0, 0
    while idle < _IDLE_ROUNDS:
        if len(pairs) < _LEAST_NAMED // 2:
            return None
        fitted = fitted_view(view, sheet[list(pairs)], dots.centers_px[list(pairs.values())])
        if fitted is None:
            return None
        view = fitted
        new = _pairs(view, sheet, dots.centers_px, _neighbourhood(sheet, list(pairs)))
        if new == pairs:
            break
        pairs = new
        idle, most = (0, len(pairs)) if len(pairs) > most else (idle + 1, most)
    return _tested(view, sheet, dots, pairs)


def _tested(view: SheetView, sheet: Array, dots: Dots, pairs: Mapping[int, int]) -> Naming | None:
    """The names that lie where the view and their neighbours put them, each dot alone at its place; None where they are
    too few."""
    points = np.array(list(pairs))
    observed_px = dots.centers_px[list(pairs.values())]
    places = view.places_px(sheet)
    places += _unevenness(sheet, points, observed_px - places[points])
    off = observed_px - places[points]
    gate_px = max(_GATE_SIGMAS * robust_scale(off.ravel()), _LEAST_GATE_PX)
    tree = cKDTree(dots.centers_px)

    def is_alone(point: int) -> bool:
        return len(tree.query_ball_point(places[point], gate_px)) == 1

    shapes = _shapes(view, sheet, dots, pairs)
    if shapes is None:
        return None
    like = _alike(dots.pixel_from_disk[list(pairs.values())], shapes[points])
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


def _unevenness(sheet: Array, points: Indices, residuals: Array) -> Array:
    """(n, 2) px by which dots next to each point of the sheet lie off, the point itself not asked: a sheet that is not
    quite flat takes its dots along."""
    count = min(_NEIGHBOURS + 1, len(points))
    _, near = cKDTree(sheet[points]).query(sheet, k=np.arange(1, count + 1))
    others = np.where(points[near] == np.arange(len(sheet))[:, None], -1, near)
    of_neighbours = np.where((others < 0)[..., None], np.nan, residuals[near])
    return np.asarray(np.nanmedian(of_neighbours, axis=1))


def _shapes(view: SheetView, sheet: Array, dots: Dots, pairs: Mapping[int, int]) -> Array | None:
    """(n, 2, 2) how the dots of all points should look, of the radius on the sheet that most have; None where the view
    shows no surroundings of any of them."""
    step = 0.01 * float(np.ptp(sheet, axis=0).max())
    unit = view.pixel_from_disks(sheet, step) / step
    areas = _areas(dots.pixel_from_disk[list(pairs.values())]) / _areas(unit[list(pairs)])
    if not np.isfinite(areas).any():
        return None
    return np.asarray(unit * np.sqrt(np.nanmedian(areas)))


def _areas(shapes: Array) -> Array:
    """(n,) of the parallelograms of (n, 2, 2); nan where a shape is nan."""
    return np.asarray(np.abs(shapes[:, 0, 0] * shapes[:, 1, 1] - shapes[:, 0, 1] * shapes[:, 1, 0]))


def _alike(shapes: Array, expected: Array) -> NDArray[np.bool_]:
    """(n,) whether ellipses (n, 2, 2) are of the size and the shape expected."""
    known = _areas(expected) > 0.0
    radii = np.linalg.svd(np.linalg.solve(expected[known], shapes[known]), compute_uv=False)
    known[known] = np.all((radii < _SHAPE) & (radii > 1.0 / _SHAPE), axis=1)
    return known
