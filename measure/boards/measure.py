"""Measure the points of a calibration board in a scan: corners by least-squares matching, dots as disks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from measure.array_types import Array
from measure.boards.corner_fit import Corner, CornerStart, Surface, crossing, fit_corners, quarter
from measure.boards.find import find_board
from measure.boards.lattice import Place, find_grid, grid_of_any_count, grid_size, homography_steps
from measure.boards.markers import fitting_side
from measure.boards.specs import (
    AprilGridSpec,
    ArucoSpec,
    BoardSpec,
    CharucoSpec,
    ChessboardSpec,
    CircleGridSpec,
    FoundCorner,
    Point3,
    SquareGridSpec,
)
from measure.flags import NO_REASON, Cause, Code, Reason, Status
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.matching.window import ScanWindow, clipped_ends
from measure.noise.robust_estimation import robust_scale
from measure.results import Covariance, MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.block_search import Patches, TargetCandidate
from measure.targets.detection import DiskSearch, disk_candidates
from measure.targets.disks import FittedDisk, fit_plain_disks
from measure.targets.sheets import fit_view_robustly

_MIRROR = np.array([-1.0, 1.0])  # of column and row
_SMALLEST_DOT_PX = 5.0  # px, diameter
_LARGEST_DOT, _FEWEST_DOTS = 1 / 6, 12  # of a grid of any count: fraction of the picture's longer side; dots
_LEAST_DOTS = 1 / 4  # fraction of all spots
_FEWEST_WIDTHS = 8  # dots: four determine how the board lies
_LARGEST_RATIO = 1.25  # of a dot's width to the given one: tone curve and ink change small ones by a tenth
# Deviation of the side of separate markers and squares from the given one, as a fraction and in px: tone curve and ink
# move each edge by half a pixel.
_WRONG_SIDE, _WRONG_SIDE_PX = 0.03, 1.5
_NEAREST_DOTS = 8  # neighbours whose places and shapes predict a missing dot
# Reach of the window along the edges, as fractions of a square's side unless in px:
_REACH = 0.3  # illumination, distortion and flatness change little over it
_SHORTEST_REACH_PX = 5.0  # px; less shows too little of the edges...
_FARTHEST_REACH = 0.6  # ...but beyond this fraction the neighbouring crossing becomes visible
_LONGEST_REACH_PX = 10.0  # px, enough for 0.01 px...
_LARGE_REACH, _LARGEST_REACH_PX = 0.1, 15.0  # ...but squares this large may be blurred by several pixels
_HALF_SIDE, _FREE_GAP = 0.5, 0.8  # fractions of an isolated square's side, and of the gap around it
_MARKER_REACH = 0.8  # fraction of a marker's black border, or of the gap around it
_SHIFT_PRIOR = 0.3  # standard deviation of the shift of edges, in blurs: a gamma of 2.2 shifts by 0.4 to the light
_FEWEST_SHIFTED = 16  # corners, of four squares: those of fewer are as well explained by another view
_SHIFT_ROUNDS = 4  # views and shifts in turn; a view takes up less than a fifth of a shift
_NEIGHBOURS = 4  # nearest crossings along the rows and columns
_FEWEST_CROSSINGS = 30  # needed to distinguish coma from noise
_WEAK_DAMAGE = 0.25  # fraction of the pixels around a corner: if more are rejected the corner is weak
_DOUBTFUL_MISFIT = 0.03  # median of a board's markers above which their corners may be touched by squares, or not
_WEAK_MISFIT = 0.075  # misfit: up to 0.062 on real boards; from 0.09 where the edges of shadows or lines moved corners


@dataclass(frozen=True)
class BoardMeasurement:
    """Measurement of a board in a scan.

    Attributes
    ----------
    marks : one for each point of the board, found or not.
    reason : why the board was not found.
    notes : messages to the user.
    refused : markers that were read but are not used, one sentence each.
    ambiguous : further boards that look the same, so that no point is an observation.
    is_mirrored : whether the image shows the board mirrored.
    contradiction : how the board differs from its description; "" if it does not.
    """

    marks: tuple[MarkMeasurement, ...]
    reason: Reason = NO_REASON
    notes: tuple[str, ...] = ()
    refused: tuple[Reason, ...] = ()
    ambiguous: Reason = NO_REASON
    is_mirrored: bool = False
    contradiction: str = ""


def _measure_circle_grid(scan: Scan, spec: CircleGridSpec) -> BoardMeasurement:
    """Measure the dots of a grid. Undetected dots are fitted at the places predicted from the others."""
    diameter_px = spec.diameter_mm / spec.spacing_mm * max(scan.width_px, scan.height_px) / min(spec.columns, spec.rows)
    patches = disk_candidates(scan, DiskSearch((_SMALLEST_DOT_PX, max(2 * _SMALLEST_DOT_PX, diameter_px))))
    centers = np.array([patch.center_px for patch in patches]).reshape(-1, 2)
    grid, is_mirrored = find_grid(centers, _appearances(patches), spec, "dots"), False
    if grid.reason and spec.asymmetric:  # with even columns and rows it differs from its mirror image
        mirrored = find_grid(centers * _MIRROR, _appearances(patches), spec, "dots")
        if not mirrored.reason:
            others_px = tuple(center_px * _MIRROR for center_px in mirrored.others_px)
            grid, is_mirrored = replace(mirrored, others_px=others_px), True
    names = {place: f"r{place[0]}c{place[1]}" for place in spec.places()}
    if grid.reason:
        absent = (MarkMeasurement(name, "target", None, None, Status.ABSENT, grid.reason) for name in names.values())
        return BoardMeasurement(tuple(absent), grid.reason)
    detected = {place: patches[index] for place, index in grid.assignment.items()}
    starts = {place: detected.get(place) or _predicted(place, detected) for place in names}
    starts = {place: start for place, start in starts.items() if _is_whole(scan, start)}
    gap = 1 - spec.diameter_mm / spec.shortest_distance_mm
    shorter_px = [float(np.linalg.svd(start.pixel_from_disk, compute_uv=False)[1]) for start in starts.values()]
    fits = fit_plain_disks(scan, list(starts.values()), [2 * gap / (1 - gap) * axis_px for axis_px in shorter_px])
    disks = {place: fit for place, fit in zip(starts, fits, strict=True) if fit.reason or _is_whole(scan, fit)}
    marks = [_dot_mark(name, disks.get(place), place in detected) for place, name in names.items()]
    wrong_width = _width_contradiction({names[place]: fit for place, fit in disks.items() if not fit.reason}, spec)
    measured = BoardMeasurement(tuple(marks), notes=grid.notes, is_mirrored=is_mirrored, contradiction=wrong_width)
    return _unless_alone(scan, measured, f"grids of {grid_size(spec, 'dots')}", grid.others_px)


def recognise_dots(scan: Scan) -> str:
    """Options of `reseau calibrate` for the grid of dots that a scan shows; "" if it shows none."""
    longest_px = _LARGEST_DOT * max(scan.width_px, scan.height_px)
    patches = disk_candidates(scan, DiskSearch((_SMALLEST_DOT_PX, max(2 * _SMALLEST_DOT_PX, longest_px))))
    if len(patches) < _FEWEST_DOTS:
        return ""
    grid = grid_of_any_count(np.array([patch.center_px for patch in patches]), _appearances(patches))
    if grid is None or grid[0] * grid[1] < max(_FEWEST_DOTS, _LEAST_DOTS * len(patches)) * (1 + grid[2]):
        return ""  # a few of many spots lie on some grid
    columns, rows, is_staggered = grid
    kind, per_row = ("asymmetric-circle-grid", columns / 2) if is_staggered else ("circle-grid", columns)
    return f"--kind {kind} --board {per_row:g}x{rows} --marker DIAMETER"


def _width_contradiction(disks: Mapping[str, FittedDisk], spec: CircleGridSpec) -> str:
    """Sentence where the dots, compared with their distances, are much wider or narrower than given; else empty."""
    if len(disks) < _FEWEST_WIDTHS:
        return ""
    points = spec.object_points()
    places_mm = np.array([points[name][:2] for name in disks]).reshape(-1, 2)
    homography, _ = cv2.findHomography(places_mm, np.array([fit.center_px for fit in disks.values()]).reshape(-1, 2))
    steps_px = np.array([homography_steps(np.asarray(homography, float), place)[1] for place in places_mm])
    shapes_px = np.array([fit.pixel_from_disk for fit in disks.values()])
    width_mm = 2.0 * float(np.median(np.sqrt(np.abs(np.linalg.det(shapes_px) / np.linalg.det(steps_px)))))
    if 1.0 / _LARGEST_RATIO < width_mm / spec.diameter_mm < _LARGEST_RATIO:
        return ""
    return (
        f"The board's dots are {width_mm:.2g} mm wide at a spacing of {spec.spacing_mm:g} mm, but {spec.diameter_mm:g} "
        "mm are given: their width or the spacing is wrong. Measure both on the board."
    )


def _appearances(patches: list[TargetCandidate]) -> Array:
    """(n, 3) logarithms of size and contrast, and sign of the contrast."""
    return np.array(
        [(np.log(patch.radius_px), np.log(abs(patch.contrast_dn)), np.sign(patch.contrast_dn)) for patch in patches]
    )


def _predicted(place: Place, detected: Mapping[Place, TargetCandidate]) -> TargetCandidate:
    """Predict a dot by a homography of its nearest neighbours, with their mean shape and contrast."""
    others = sorted(detected, key=lambda other: np.hypot(other[0] - place[0], other[1] - place[1]))
    nearest = others[: max(_NEAREST_DOTS, len(others) // 3)]
    homography, _ = cv2.findHomography(
        np.array(nearest, float), np.array([detected[each].center_px for each in nearest])
    )
    center_px, _ = homography_steps(np.asarray(homography, float), place)
    alike = Patches.collect([detected[each] for each in nearest[:_NEAREST_DOTS]])
    shape = np.linalg.cholesky((alike.shapes @ alike.shapes.swapaxes(1, 2)).mean(axis=0))
    return TargetCandidate(center_px, shape, float(alike.contrasts.mean()))


def _is_whole(scan: Scan, disk: TargetCandidate | FittedDisk) -> bool:
    """Whether a dot lies in the scan with all of its edge: lens and drawing put others up to 7 sigmas off."""
    reach_px, size_px = np.linalg.norm(disk.pixel_from_disk, axis=1), np.array([scan.width_px, scan.height_px])
    return bool(np.all(np.abs(2 * disk.center_px + 1 - size_px) + 2 * reach_px <= size_px))


def _dot_mark(name: str, disk: FittedDisk | None, is_detected: bool) -> MarkMeasurement:
    """Measurement record of a dot."""
    if disk is None:
        outside = Reason("outside of the picture, or cut by its edge", Code.OUTSIDE)
        return MarkMeasurement(name, "target", None, None, Status.ABSENT, outside)
    if disk.reason:
        status = Status.REJECTED if is_detected else Status.PREDICTED
        reason = disk.reason.reword(f"not fitted: {disk.reason}")
        return MarkMeasurement(name, "target", disk.center_px, None, status, reason)
    weakness = disk.weakness or disk.dust_reason
    status = Status.WEAK if weakness else Status.MEASURED
    return MarkMeasurement(name, "target", disk.center_px, disk.place_covariance, status, weakness, disk.quality)


def measure_board(scan: Scan, spec: BoardSpec) -> BoardMeasurement:
    """Measure a chessboard, a grid of dots or squares, an ArUco or a ChArUco board.

    Returns
    -------
    One mark for each point of the board, found or not. If the board is not found the result has a reason; no error is
    raised.
    """
    if isinstance(spec, CircleGridSpec):
        return _measure_circle_grid(scan, spec)
    board = find_board(scan, spec)
    size_px = scan.width_px, scan.height_px
    fitted, stand_alone = _fit_found(scan, board.corners, spec)
    contradiction = _side_contradiction(fitted, spec, size_px)
    if stand_alone:
        fitted = _correct_edge_shift(fitted, board.corners, spec.object_points(), size_px)
    notes = board.notes
    if isinstance(spec, ChessboardSpec) and len(fitted) == spec.columns * spec.rows:
        fitted, notes = _named_by_colour(fitted, board.corners, spec)
    hidden = "not found: its markers were not read"
    if isinstance(spec, ChessboardSpec):
        hidden = "covered, or outside of the picture"
    elif isinstance(spec, SquareGridSpec):
        hidden = "its square was not found"
    unseen = board.reason or Reason(hidden, Code.UNNAMED)
    marks = []
    for name in spec.object_points():
        refusal = board.off_corners.get(name, NO_REASON)
        if isinstance(spec, ArucoSpec):
            refusal = board.refused.get(int(name.split(".")[0]), NO_REASON)
        marks.append(_corner_mark(name, fitted.get(name), refusal or unseen))
    measured = BoardMeasurement(
        tuple(marks),
        board.reason,
        notes,
        tuple(board.refused.values()),
        is_mirrored=board.is_mirrored,
        contradiction=contradiction,
    )
    what = "squares" if isinstance(spec, SquareGridSpec) else "inner corners"
    return _unless_alone(scan, measured, f"boards of {spec.columns} x {spec.rows} {what}", board.others_px)


def _side_contradiction(fitted: Mapping[str, Corner], spec: BoardSpec, size_px: tuple[int, int]) -> str:
    """Sentence where separate markers or squares have another side, compared with their distances, than given."""
    if not isinstance(spec, ArucoSpec | SquareGridSpec):
        return ""
    what, given_mm = ("squares", spec.square_mm) if isinstance(spec, SquareGridSpec) else ("markers", spec.marker_mm)
    points, corners = spec.object_points(), {name: each for name, each in fitted.items() if not each.reason}
    outlines = [[f"{name}.{k}" for k in range(4)] for name in dict.fromkeys(each.split(".")[0] for each in corners)]
    whole = [names for names in outlines if corners.keys() >= set(names)]
    sides_mm = {number: np.array([points[name][:2] for name in names]) for number, names in enumerate(whole)}
    places_px = {number: [np.array([corners[name].center_px for name in names])] for number, names in enumerate(whole)}
    side_mm = fitting_side(places_px, sides_mm, size_px)
    if side_mm is None:
        return ""
    side_px = float(np.median([np.hypot(*(place[1] - place[0])) for (place,) in places_px.values()]))
    if abs(side_mm / given_mm - 1.0) < max(_WRONG_SIDE, _WRONG_SIDE_PX / side_px):
        return ""
    return (
        f"The board's {what} have a side of {side_mm:.3g} mm at distances of {given_mm + spec.gap_mm:g} mm, but "
        f"{given_mm:g} mm are given: the side or the gap is wrong. Measure both on the board."
    )


def _unless_alone(scan: Scan, measured: BoardMeasurement, kind: str, others_px: Sequence[Array]) -> BoardMeasurement:
    """Reject the points of a board if the scan shows others that look the same: their identity is ambiguous."""
    if not others_px:
        return measured
    middle = np.mean([mark.center_px for mark in measured.marks if mark.center_px is not None], axis=0)
    in_file = (np.add(place, scan.origin_px) for place in (middle, *others_px))
    places = " and ".join(f"({column:.0f}, {row:.0f})" for column, row in in_file)
    message = f"the scan shows {1 + len(others_px)} {kind}, about the pixels {places}, and nothing shows which is meant"
    why = Reason(f"{message}: cover the others, or cut pictures that two cameras share", Code.AMBIGUOUS)
    return replace(measured, marks=tuple(mark.reject(why) for mark in measured.marks), ambiguous=why)


def _fit_found(scan: Scan, found: Mapping[str, FoundCorner], spec: BoardSpec) -> tuple[dict[str, Corner], bool]:
    """Fit the detected corners by least-squares matching; and whether they are corners of separate squares."""
    points, starts, board_reach_px = spec.object_points(), list[CornerStart](), 0.0
    if found:
        # The effect of a camera's sharpening depends on the window: equal ones make it the same for all corners.
        side_px = float(np.median([np.hypot(*corner.steps_px).min() for corner in found.values()]))
        longest_px = np.clip(_LARGE_REACH * side_px, _LONGEST_REACH_PX, _LARGEST_REACH_PX)
        board_reach_px = float(np.clip(_REACH * side_px, _SHORTEST_REACH_PX, longest_px))
    for name, each in found.items():
        reach_px = _reach_px(np.hypot(*each.steps_px), spec, board_reach_px)
        starts.append(CornerStart(each.center_px, each.steps_px, reach_px, np.array(points[name][:2])))

    def fits(stands_alone: bool) -> list[Corner]:
        def read(col: int, row: int, side: int) -> ScanWindow:
            place_px = col, row, side, side
            # The place of a crossing does not depend on clipping.
            sides = clipped_ends(scan.samples(*place_px), scan.full_scale_dn) if stands_alone else None
            return ScanWindow(scan.window(*place_px), (col, row), scan.inside(*place_px, is_read=True), sides)

        surface: Surface = quarter if stands_alone else crossing
        return fit_corners(read, starts, surface, scan.quantisation_step_dn, scan.first_block_px)

    stands_alone = isinstance(spec, ArucoSpec | SquareGridSpec) and not isinstance(spec, AprilGridSpec)
    corners = fits(stands_alone)
    if isinstance(spec, ArucoSpec) and _median_misfit(corners) > _DOUBTFUL_MISFIT:
        # Boards of either kind are printed with and without the squares that touch the corners of the markers.
        others = fits(not stands_alone)
        if _median_misfit(others) < _median_misfit(corners):
            stands_alone, corners = not stands_alone, others
    return dict(zip(found, corners, strict=True)), stands_alone


def _median_misfit(corners: Sequence[Corner]) -> float:
    """Median misfit of corners, inf for those that could not be fitted; 0 for none."""
    return float(np.median([np.inf if each.reason else each.misfit for each in corners])) if corners else 0.0


# Shift of the edges of separate markers and squares by the tone curve and by ink, estimated from the board's geometry.
#
# Edges are matched in stored grey values. Under a tone curve, such as the gamma of most cameras, the middle grey value
# of a blurred edge is not the middle of its light, so that all edges shift towards the same side by the same share of
# their blur. A crossing stays, since its edges shift symmetrically; the corners of a separate square move along its
# diagonals. Ink that has spread does the same. The distances between squares do not change, and show it.


def _correct_edge_shift(
    fitted: Mapping[str, Corner],
    found: Mapping[str, FoundCorner],
    points: Mapping[str, Point3],
    size_px: tuple[int, int],
) -> dict[str, Corner]:
    """Move the corners of separate squares back by the shift of their edges, and add its uncertainty to them. fitted,
    found: corners by id, and the sides of their squares; points: object points by id; size_px: of the scan."""
    names = [name for name, corner in fitted.items() if not corner.reason]
    if not names:
        return dict(fitted)
    blurs_px = [np.sqrt(fitted[name].blur_px ** 2 + PIXEL_VARIANCE_PX2) for name in names]
    moves_px = np.array([blur * _outward(found[name].steps_px) for blur, name in zip(blurs_px, names, strict=True)])
    places_px = np.array([fitted[name].center_px for name in names])
    board = np.array([points[name][:2] for name in names])
    shift, variance = 0.0, _SHIFT_PRIOR**2
    for _ in range(_SHIFT_ROUNDS if len(names) >= _FEWEST_SHIFTED else 0):
        view = fit_view_robustly(board, places_px - shift * moves_px, size_px)
        if view is None:
            break
        off_px = np.nan_to_num(places_px - view.places_px(board))
        noise_px2 = robust_scale((off_px - shift * moves_px).ravel()) ** 2 + 1e-9
        variance = 1 / (1 / _SHIFT_PRIOR**2 + (moves_px**2).sum() / noise_px2)
        shift = variance * float((moves_px * off_px).sum()) / noise_px2
    moved = dict(fitted)
    for name, move_px in zip(names, moves_px, strict=True):
        covariance = fitted[name].covariance.plus(Cause.TONE, variance * np.outer(move_px, move_px))
        moved[name] = replace(fitted[name], center_px=fitted[name].center_px - shift * move_px, covariance=covariance)
    return moved


def _outward(sides_px: Array) -> Array:
    """(2,) how a corner with the given sides (columns) moves where its edges move outwards by 1."""
    along = sides_px / np.hypot(*sides_px)
    return np.asarray(-along.sum(axis=1) / max(abs(float(np.linalg.det(along))), 1e-3))


def _reach_px(sides_px: Array, spec: BoardSpec, board_reach_px: float) -> Array:
    """(2,) px, reach of the window along the sides (2,) of a square or marker."""
    if isinstance(spec, ArucoSpec):
        free = min(spec.border_modules / spec.modules, spec.gap_mm / spec.marker_mm)
        return np.asarray(np.minimum(_MARKER_REACH * free * sides_px, _LARGEST_REACH_PX))
    if isinstance(spec, SquareGridSpec):  # exclude its next corner and the next square
        free = min(_HALF_SIDE, _FREE_GAP * spec.gap_mm / spec.square_mm)
        return np.asarray(np.minimum(free * sides_px, _LARGEST_REACH_PX))
    farthest = _FARTHEST_REACH
    if isinstance(spec, CharucoSpec):  # exclude the marker in one of the squares
        farthest = (spec.square_mm - spec.marker_mm) / (2 * spec.square_mm)
    return np.full(2, min(board_reach_px, farthest * float(sides_px.min())))


def _named_by_colour(
    fitted: dict[str, Corner], found: dict[str, FoundCorner], spec: ChessboardSpec
) -> tuple[dict[str, Corner], tuple[str, ...]]:
    """Rename the corners so that the square r0c0, r0c1, r1c1, r1c0 is dark. A board symmetric under a half turn is
    assumed to be upright in the scan. Boards with equal numbers of columns and rows are turned by quarters."""
    names = np.array([[f"r{row}c{column}" for column in range(spec.columns)] for row in range(spec.rows)])
    contrasts = np.array([[fitted[name].contrast_dn for name in line] for line in names])
    columns_px = np.array([[found[name].center_px[0] for name in line] for line in names])

    def fits(quarter_turns: int) -> tuple[bool, float]:
        """Whether the first square is dark, by the median over the board; and the extent to the right of the first
        row."""
        contrast, (first, *_, last) = np.rot90(contrasts, quarter_turns), np.rot90(columns_px, quarter_turns)[0]
        lighter = np.where(np.indices(contrast.shape).sum(axis=0) % 2 == 0, contrast, -contrast)
        # After a quarter turn the square between a corner's steps is its neighbour of the opposite colour.
        return bool((-1) ** quarter_turns * np.nanmedian(lighter) < 0), float(last - first)

    ranks = {turns: fits(turns) for turns in (range(4) if spec.columns == spec.rows else (0, 2))}
    old_names = np.rot90(names, max(ranks, key=ranks.__getitem__))
    is_unsure = sum(is_dark for is_dark, _ in ranks.values()) > 1
    notes = ("the board looks the same after a half turn: it was taken as upright in the scan",) if is_unsure else ()
    return {str(new): fitted[str(old)] for new, old in zip(names.ravel(), old_names.ravel(), strict=True)}, notes


def _corner_mark(name: str, corner: Corner | None, missing: Reason) -> MarkMeasurement:
    """Measurement record of a point."""
    if corner is None:
        return MarkMeasurement(name, "target", None, None, Status.ABSENT, missing)
    if corner.reason:
        reason = corner.reason.reword(f"not fitted: {corner.reason}")
        return MarkMeasurement(name, "target", corner.center_px, None, Status.PREDICTED, reason)
    quality = {
        "snr": abs(corner.contrast_dn) / max(corner.noise_dn, 1e-9),
        "contrast_dn": corner.contrast_dn,
        "noise_dn": corner.noise_dn,
        "blur_px": corner.blur_px,
        "damaged_fraction": corner.damaged_fraction,
        "moved_px": corner.moved_px,
    }
    if corner.junction_px is not None:
        quality |= {"junction_col_px": corner.junction_px[0], "junction_row_px": corner.junction_px[1]}
    reason = NO_REASON
    if corner.damaged_fraction > _WEAK_DAMAGE:
        reason = Reason(f"{100 * corner.damaged_fraction:.0f} % of the pixels about it do not fit", Code.COVERED)
    elif corner.misfit > _WEAK_MISFIT:
        share = f"{100 * corner.misfit:.0f} % of its contrast"
        reason = Reason(f"a shadow, dirt or other edges around it: the residuals are {share}", Code.COVERED)
    status = Status.WEAK if reason else Status.MEASURED
    return MarkMeasurement(name, "target", corner.center_px, corner.covariance, status, reason, quality)


def one_definition(pictures: Sequence[Sequence[MarkMeasurement]]) -> tuple[tuple[MarkMeasurement, ...], ...]:
    """Use one definition of crossings for all images of a camera: the matched places, or the junctions under coma.

    Parameters
    ----------
    pictures : the marks of each image of one camera.

    Returns
    -------
    The same marks. If the lens has coma, those with a junction are moved there and get its covariance.

    Notes
    -----
    If a symmetric blur describes the edges, match and junction differ by noise only, and the match has less of it. Coma
    blurs edges to one side, increasingly with the distance from the axis. It separates match and junction by the same
    amount in neighbouring crossings, so the mean product of neighbours' differences is its share of their mean square.
    Above one half, coma exceeds the noise added by the junction. The junctions are then used, as in most published
    calibrations. Their error comes from the lens, not from noise. All get the standard deviation of a place known to
    within the rms distance of match and junction, divided by the root of three (JCGM 100:2008, Guide to the expression
    of uncertainty in measurement, 4.3.7).
    """
    unmoved = tuple(tuple(marks) for marks in pictures)
    apart, alike = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for marks in pictures:
        crossings = [mark for mark in marks if _has_junction(mark)]
        if len(crossings) > _NEIGHBOURS:
            centers = np.array([mark.center_px for mark in crossings])
            differences = np.array([_junction_px(mark) for mark in crossings]) - centers
            near = np.asarray(KDTree(centers).query(centers, _NEIGHBOURS + 1)[1])[:, 1:]
            apart.append(differences)
            alike.append((differences[:, None, :] * differences[near]).mean(axis=1))
    squares_px2 = np.concatenate(apart) ** 2
    if len(squares_px2) < _FEWEST_CROSSINGS or np.concatenate(alike).mean() <= squares_px2.mean() / 2:
        return unmoved
    covariance = Covariance.from_noise(squares_px2.mean() / 3 * np.eye(2))
    return tuple(
        tuple(
            replace(mark, center_px=_junction_px(mark), covariance=covariance) if _has_junction(mark) else mark
            for mark in marks
        )
        for marks in pictures
    )


def _has_junction(mark: MarkMeasurement) -> bool:
    return mark.status.is_observation and "junction_col_px" in mark.quality


def _junction_px(mark: MarkMeasurement) -> Array:
    return np.array([mark.quality["junction_col_px"], mark.quality["junction_row_px"]])
