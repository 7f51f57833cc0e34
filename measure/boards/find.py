"""Detection of calibration boards in a reduced scan, to a pixel: chessboards here, other boards in their own
modules."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import cv2
import numpy as np
from scipy.special import comb

from measure.array_types import Array, Bytes, Integers
from measure.boards.lattice import find_squares
from measure.boards.markers import are_diagonal, find_aruco, find_charuco, read_any_markers, read_board
from measure.boards.specs import (
    AprilGridSpec,
    ArucoSpec,
    BoardSpec,
    CharucoSpec,
    ChessboardSpec,
    FoundBoard,
    FoundCorner,
    SquareGridSpec,
)
from measure.flags import NO_REASON, Code, Reason
from measure.geometry import reduced_px, scan_px
from measure.scans.scan import Scan
from measure.targets.sheets import fit_view_robustly

_UNEVEN = 0.25  # in squares, largest median deviation of a line from a regular grid; next to a skipped line it is 0.5
_SMOOTH = 4  # corners of a line through which the cubic is laid that predicts another
_TRUSTED = 0.1  # in squares, largest deviation of any corner accepted from OpenCV's older detector
_REFINED, _REFINING_END = 0.3, (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)  # in squares; px
_INTO_SQUARE = 0.3  # in squares from the corner, where a square's grey value is sampled
_NEAR, _LEAST_NEAR = 0.1, 0.05  # there a crossing keeps a ninth of the contrast under any blur, the gap of dots none
_CROSSING = 0.25  # fraction of the board's contrast required between all neighbours of the four squares
_SMOOTHED_PX = 10.0  # px, side from which on squares are sampled as means of 3 x 3 pixels
_COVERED = 0.3  # fraction of a further line, at least one corner, that may be covered: a clipboard's clip resembles 2/3
_MOST_LINES = 500  # limit of the lines of a board along a side
_THOROUGHLY = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
_DRAWINGS = 3  # random seeds tried for a second board: one in twenty missed one at the edge
_INTO_BORDER = 1.4  # in squares beyond the last crossings, where the light border is sampled
_LIGHT_BORDER = 0.4  # fraction of the contrast by which the border may be darker than the light squares
_ACROSS_END, _END_TOLERANCE = np.linspace(0.5, 1.5, 41), 0.12  # in squares: a cover's edge is no end of the squares
_MOST = 0.85  # fraction of the places along a line
_PLAIN_CORNERS = 8  # corners of a board of markers: two markers, which are never false alarms
_LEAST = 3  # smallest number of lines of a chessboard in either direction
_FEWEST_MARKERS = 6  # markers that exclude false alarms
_FIRST_SIZE_PX, _LAST_SIZE_PX = 1500, 4000  # px, longer side of the reduced images searched
_QUICK_SIZE_PX = 640  # px, longer side at which most boards are found in a quarter of the time
_ENOUGH_PIXELS = 100_000  # sample for the range of grey values
_AROUND, _FAINTEST = 40, 1e-3  # of flattening: longer side over the local blur's, and the least local contrast
_LEAST_CONTRAST = 0.01  # fraction of full scale; below it nothing is visible, and the search takes long


@dataclass(frozen=True, eq=False)
class WholePattern:
    """Complete pattern around a grid.

    grid: (rows, columns, 2), grown to the ends of the pattern; has_ended: whether the image shows the end before the
    first row, after the last column, after the last row, and before the first column.
    """

    grid: Array
    has_ended: tuple[bool, ...]

    @property
    def is_bounded(self) -> bool:
        return all(self.has_ended)


def is_even(grid: Array, size_px: tuple[int, int], farthest: float = np.inf) -> bool:
    """Whether corners (rows, columns, 2) form a regular grid under one homography and radial distortion; or, since a
    fisheye shows boards up to and beyond 90 degrees from its axis, by their neighbours.

    The lines are tested by their medians, so single misplaced corners are tolerated. farthest: largest deviation of any
    corner, in steps.
    """
    rows, columns = grid.shape[:2]
    places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    steps, plane = _shorter_steps(grid), cv2.findHomography(places, grid.reshape(-1, 2))[0]
    if plane is not None:  # most lenses distort by little of a square
        off = cv2.perspectiveTransform(places[:, None], plane).reshape(grid.shape) - grid
        if (np.linalg.norm(off, axis=2) < _TRUSTED * steps).all():
            return True
    offs, view = [], fit_view_robustly(places, grid.reshape(-1, 2), size_px)
    if view is not None:
        off = np.hypot(*(view.places_px(places) - grid.reshape(-1, 2)).T).reshape(rows, columns) / steps
        offs.append((off, farthest))
    if min(rows, columns) > _SMOOTH:  # the errors of five corners add up to twice that of one
        off = np.maximum(_from_neighbours(grid), _from_neighbours(grid.swapaxes(0, 1)).T) / steps
        offs.append((off, 2.0 * farthest))
    return any(off.max() < most and all(np.median(line) < _UNEVEN for line in (*off, *off.T)) for off, most in offs)


def _from_neighbours(grid: Array) -> Array:
    """(rows, columns) distance of each corner from the cubic through the four nearest others of its column, px."""
    differences = np.linalg.norm(np.diff(grid, _SMOOTH, axis=0), axis=2)
    row = np.arange(len(grid))
    first = np.clip(row - _SMOOTH // 2, 0, len(differences) - 1)
    return np.asarray(differences[first] / comb(_SMOOTH, row - first)[:, None])


def whole_pattern(picture: Bytes, grid: Array) -> WholePattern | None:
    """Grow a grid to the complete pattern. None if a line of the grid is not mostly crossings, or if its squares do not
    touch, as dots do not."""
    near, far = (abs(float(np.median(_crossing_contrast(picture, grid, into)))) for into in (_NEAR, _INTO_SQUARE))
    if _shorter_steps(grid).min() > _SMOOTHED_PX:
        picture = np.asarray(cv2.blur(picture, (3, 3)), np.uint8)
    crossings = _crossing_contrast(picture, grid)
    contrast = float(np.median(crossings))
    if contrast < 0:
        crossings, contrast = -crossings, -contrast
    is_crossing = crossings > _CROSSING * contrast
    if not (
        contrast > 0
        and near >= _LEAST_NEAR * far
        and all(2 * line.sum() >= len(line) for line in (*is_crossing, *is_crossing.T))
    ):
        return None
    has_ended = []
    for _ in range(4):
        grid, ended = _grown(picture, grid, contrast)
        has_ended.append(ended)
        grid = np.rot90(grid)
    return WholePattern(grid, tuple(has_ended))


def _grown(picture: Bytes, grid: Array, contrast: float) -> tuple[Array, bool]:
    """Extend the grid by lines of crossings before its first row. Returns also whether the image shows the end."""
    parity = np.sign(np.median(_crossing_contrast(picture, grid)))
    while True:
        line = 3 * grid[0] - 3 * grid[1] + grid[2]
        further = np.concatenate([line[None], grid])
        height, width = picture.shape
        inside = np.all((line > 0) & (line < (width - 1, height - 1)), axis=1)
        if 2 * inside.sum() < len(inside):
            return grid, False
        parity = -parity
        crossings = parity * _crossing_contrast(picture, further[:3])[0]
        covered = np.sum(crossings[inside] <= _CROSSING * contrast)
        if covered > max(_COVERED * inside.sum(), 1) or len(further) > _MOST_LINES:
            return grid, True
        further[0] = _refined(picture, further[:2])[0]
        grid = further


def _crossing_contrast(picture: Bytes, grid: Array, into: float = _INTO_SQUARE) -> Array:
    """(rows, columns) smallest difference in grey value between neighbours of the four squares around each corner, so
    far into them, with the sign relative to the first corner's parity; 0 where light and dark do not alternate."""
    right, down = np.moveaxis(_grid_steps(grid), -1, 0)
    corners = [grid + into * (x * right + y * down) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    columns_rows = np.concatenate(corners).astype(np.float32)
    columns, rows = columns_rows[..., 0], columns_rows[..., 1]
    grey = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    a, b, c, d = np.split(grey, 4)
    between = np.stack([a - b, c - b, c - d, a - d])
    alternating = np.maximum(between.min(axis=0), 0.0) + np.minimum(between.max(axis=0), 0.0)
    return np.asarray(alternating * np.where(np.indices(grid.shape[:2]).sum(axis=0) % 2, -1.0, 1.0))


def _refined(picture: Bytes, grid: Array) -> Array:
    """Refine the corners of a grid to the nearest junctions, where there are any."""
    half = max(round(_REFINED * float(_shorter_steps(grid).min())), 2)
    height, width = picture.shape
    inside = np.all((grid > 2 * half + 5) & (grid < (width - 2 * half - 6, height - 2 * half - 6)), axis=-1)
    refined = grid.copy()
    if inside.any():
        places = np.array(grid[inside][:, None], np.float32, order="C")
        cv2.cornerSubPix(picture, places, (half, half), (-1, -1), _REFINING_END)
        near = np.hypot(*(places[:, 0] - grid[inside]).T) < half
        refined[inside] = np.where(near[:, None], places[:, 0], grid[inside])
    return refined


def _grid_steps(grid: Array) -> Array:
    """(rows, columns, 2, 2) steps from each place of a grid (rows, columns, 2); the columns of a matrix are those to
    the next column and the next row."""
    return np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=-1)


def _shorter_steps(grid: Array) -> Array:
    """(rows, columns) shorter one of the steps to the next column and the next row, px."""
    lengths = np.linalg.norm(_grid_steps(grid), axis=2)
    return np.asarray(np.maximum(lengths.min(axis=-1), 1e-9))  # a detector may give a corner twice


def find_chessboard(picture: Bytes, spec: ChessboardSpec, is_quick: bool = False) -> FoundBoard:
    """Find the inner corners of a chessboard.

    A board of a different count is refused, with its count, since its corners would get wrong names. A part of a board
    is refused if its position on the board is ambiguous. is_quick: use only the fastest detector, for a whole board.
    """
    size_px = (picture.shape[1], picture.shape[0])
    other_size: WholePattern | None = None
    for grid, farthest in islice(_grids(picture, spec), 1 if is_quick else None):
        pattern = whole_pattern(picture, grid) if is_even(grid, size_px, farthest) else None
        if pattern is None:
            continue
        if pattern.grid.shape == grid.shape == (spec.rows, spec.columns, 2):
            steps = _grid_steps(grid)
            places = np.ndindex(*grid.shape[:2])
            corners = {f"r{row}c{column}": FoundCorner(grid[row, column], steps[row, column]) for row, column in places}
            return FoundBoard(corners)
        other_size = pattern
    if other_size is not None and not is_quick:
        return _part_of_chessboard(picture, other_size, spec)
    return FoundBoard({}, Reason(_refusal(spec, other_size), Code.NO_BOARD))


def _part_of_chessboard(picture: Bytes, pattern: WholePattern, spec: ChessboardSpec) -> FoundBoard:
    """Name the corners of a partly covered or cropped board, if its visible ends and the colours of its squares leave
    one position on the board, up to a turn that maps the board onto itself. A pattern of the board's count that ends on
    all sides needs no border."""
    borders = tuple(
        ended and _has_border(picture, np.rot90(pattern.grid, side)) for side, ended in enumerate(pattern.has_ended)
    )
    has_count = pattern.grid.shape[:2] in ((spec.rows, spec.columns), (spec.columns, spec.rows))
    has_borders = (has_count and pattern.is_bounded) or ((borders[0] or borders[2]) and (borders[1] or borders[3]))
    namings = list(_namings(picture, pattern.grid, borders, spec)) if has_borders else []
    if not namings or any(not _are_alike(namings[0], naming, spec) for naming in namings):
        is_resolved = bool(_shorter_steps(pattern.grid).min() > _SMOOTHED_PX)  # else it may go on at a finer reduction
        is_other = pattern.is_bounded and is_resolved and not has_count
        return FoundBoard({}, Reason(_refusal(spec, pattern), Code.NO_BOARD), is_of_other_count=is_other)

    def uprightness(naming: Integers) -> float:
        """Covariance of the board's columns with the column in the image: largest for the upright naming."""
        return float(np.cov(naming.ravel() % spec.columns, pattern.grid[..., 0].ravel())[0, 1])

    naming = max(namings, key=uprightness)
    grid, height, width = _refined(picture, pattern.grid), *picture.shape
    contrasts = np.abs(_crossing_contrast(picture, grid))
    inside = np.all((grid > 1) & (grid < (width - 2, height - 2)), axis=-1)
    shown = inside & (contrasts > _CROSSING * np.median(contrasts[inside]))
    # The sides of a square along the board's rows and columns, whatever the orientation of the grid.
    board = np.stack([naming % spec.columns, naming // spec.columns], axis=-1).astype(float)
    steps = _grid_steps(grid) @ np.linalg.inv(_grid_steps(board)[0, 0])
    corners = {
        f"r{naming[place] // spec.columns}c{naming[place] % spec.columns}": FoundCorner(grid[place], steps[place])
        for place in np.ndindex(naming.shape[0], naming.shape[1])
        if shown[place]
    }
    return FoundBoard(corners)


def _namings(picture: Bytes, grid: Array, borders: tuple[bool, ...], spec: ChessboardSpec) -> Iterator[Integers]:
    """Possible numbers (rows, columns) of the board's corners, row by row, for the corners of a grid, consistent with
    its borders and the colours of its squares."""
    board = np.arange(spec.rows * spec.columns).reshape(spec.rows, spec.columns)
    for turns in range(4):
        turned = np.rot90(grid, turns)
        rows, columns = turned.shape[:2]
        top, right, bottom, left = np.roll(borders, -turns)
        is_dark = bool(np.median(_crossing_contrast(picture, turned)) < 0)
        for row, column in np.ndindex(max(spec.rows - rows + 1, 0), max(spec.columns - columns + 1, 0)):
            last_row, last_column = row + rows == spec.rows, column + columns == spec.columns
            ends = (row == 0 or not top) and (column == 0 or not left)
            ends = ends and (last_row or not bottom) and (last_column or not right)
            if ends and is_dark == ((row + column) % 2 == 0):
                yield np.rot90(board[row : row + rows, column : column + columns], -turns)


def _are_alike(naming: Integers, other: Integers, spec: ChessboardSpec) -> bool:
    """Whether two namings differ only by a turn that maps the board onto itself."""
    board = np.arange(spec.rows * spec.columns).reshape(spec.rows, spec.columns)
    step = 1 if spec.rows == spec.columns and spec.rows % 2 else 4 if (spec.rows + spec.columns) % 2 else 2
    return any(np.array_equal(np.rot90(board, turns).ravel()[naming], other) for turns in range(0, 4, step))


def _has_border(picture: Bytes, grid: Array) -> bool:
    """Whether a light border without squares begins where the whole squares before a grid's first row end."""
    middles, outward = (grid[0, 1:] + grid[0, :-1]) / 2, grid[0] - grid[1]
    step = (outward[1:] + outward[:-1]) / 2

    def grey(places: Array) -> Array:
        columns, rows = np.moveaxis(places.astype(np.float32), -1, 0)
        values = cv2.remap(picture, columns[None], rows[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
        inside = (columns >= 0) & (rows >= 0) & (columns < picture.shape[1]) & (rows < picture.shape[0])
        return np.where(inside, values.astype(float), np.nan)

    squares, border = grey(middles + 0.5 * step), grey(middles + _INTO_BORDER * step)
    known = np.isfinite(squares) & np.isfinite(border)
    pairs = known[1:] & known[:-1]
    if 2 * known.sum() < len(known) or not pairs.any():
        return False
    alternation = np.diff(squares)[pairs] * np.where(np.arange(len(pairs)) % 2, -1.0, 1.0)[pairs]
    contrast = float(np.median(alternation))
    light = float(np.max(squares[known]))
    alternate = np.sign(contrast) * alternation > _CROSSING * abs(contrast)
    is_light = border[known] > light - _LIGHT_BORDER * abs(contrast)
    if not (contrast and alternate.mean() >= _MOST and is_light.mean() >= _MOST):
        return False
    is_dark = known & (squares < light - abs(contrast) / 2)
    is_darker = np.stack([grey(middles + beyond * step) for beyond in _ACROSS_END]) < (squares + border) / 2
    lengths = _ACROSS_END[0] + is_darker.mean(axis=0) * np.ptp(_ACROSS_END)
    return bool(np.mean(np.abs(lengths[is_dark] - 1.0) < _END_TOLERANCE) >= _MOST)


def _refusal(spec: ChessboardSpec, pattern: WholePattern | None) -> str:
    """Message why no board of the specified count was found, with the count that fits, if any."""
    message = f"no chessboard of {spec.columns} x {spec.rows} inner corners is whole in the scan"
    if pattern is None:
        return message
    rows, columns = pattern.grid.shape[:2]
    both = ((columns, rows), (rows, columns))  # rows and columns cannot be distinguished
    columns, rows = min(both, key=lambda one: ((one[0] - spec.columns) ** 2 + (one[1] - spec.rows) ** 2, -one[0]))
    if (columns, rows) == (spec.columns, spec.rows):
        return (
            f"{message}: some of its corners, or of the light border around them, lie outside or are covered. Show the "
            "whole board with its border"
        )
    message += f"; one of {columns} x {rows} is"
    if pattern.is_bounded and (columns, rows) == (spec.columns - 1, spec.rows - 1):
        return f"{message}: squares may have been counted in place of inner corners"
    if columns > spec.columns or rows > spec.rows or pattern.is_bounded:
        return f"{message}. Correct the count of the board's inner corners"
    return (
        f"{message}, and the rest may lie outside of the scan or be covered; nothing shows which part it is. Show the "
        "board's light border on two adjacent sides, and more of its longer side than the shorter one has"
    )


def _grids(picture: Bytes, spec: ChessboardSpec) -> Iterator[tuple[Array, float]]:
    """Candidate grids of corners (rows, columns, 2), the fastest detector first, each with the largest deviation of a
    corner from a regular grid, in steps. The last candidate is of any count."""
    # The older detector takes a tenth of the time. Its fast check rejects oblique boards in uneven light.
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(picture, (spec.columns, spec.rows), flags=flags)
    if found:
        grid = np.asarray(corners, float).reshape(spec.rows, spec.columns, 2)
        half = max(round(_REFINED * float(_shorter_steps(grid).min())), 2)  # its places are often wrong by some pixels
        cv2.cornerSubPix(picture, corners, (half, half), (-1, -1), _REFINING_END)
        yield _right_handed(np.asarray(corners, float).reshape(grid.shape)), _TRUSTED
    for flags in (_THOROUGHLY, 0):
        drawn = _drawn_chessboard_grid(picture, spec, flags, drawings=1)
        if drawn is not None:
            yield _right_handed(drawn), np.inf
    largest = _chessboard_of_any_count(picture)
    if largest is not None:
        is_turned = largest.shape[:2] == (spec.columns, spec.rows)
        yield _right_handed(largest.transpose(1, 0, 2) if is_turned else largest), np.inf


def _chessboard_of_any_count(picture: Bytes) -> Array | None:
    """(rows, columns, 2) largest chessboard found by OpenCV's newer detector from two sizes on, since a start may lie
    off the board. A grid that passes over corners has others in its cells, not the colours of squares."""
    grids: list[Array] = []
    for least in (_LEAST, _LEAST + 1):
        cv2.setRNGSeed(1)
        flags = _THOROUGHLY | cv2.CALIB_CB_LARGER
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(picture, (least, least), flags)
        grids += [np.asarray(corners, float).reshape(*meta.shape, 2)] if found else []
    squares = [grid for grid in grids if has_squares(picture, grid)]
    return max(squares, key=np.size, default=None)


def has_squares(picture: Bytes, grid: Array) -> bool:
    """Whether the middles of a grid's cells have the colours seen beside its corners."""
    beside, middle = (float(np.median(_crossing_contrast(picture, grid, into))) for into in (_INTO_SQUARE, 0.5))
    return bool(middle * np.sign(beside) > _CROSSING * abs(beside))


def _drawn_chessboard_grid(picture: Bytes, spec: ChessboardSpec, flags: int, drawings: int) -> Array | None:
    """(rows, columns, 2) corners by OpenCV's newer detector. Its random numbers are seeded, so that the result does not
    depend on earlier searches."""
    for seed in range(1, drawings + 1):
        cv2.setRNGSeed(seed)
        found, corners = cv2.findChessboardCornersSB(picture, (spec.columns, spec.rows), flags=flags)
        if found:
            return np.asarray(corners, float).reshape(spec.rows, spec.columns, 2)
    return None


def _other_chessboards(scan: Scan, found: FoundBoard, spec: ChessboardSpec, factor: int) -> tuple[Array, ...]:
    """Centres of further chessboards in the scan reduced by a factor, in which a smaller one shows; each is painted
    over before the next one is searched."""
    picture = _searchable(scan, factor)[0].copy()
    background = int(np.median(picture[::4, ::4]))
    corners = np.array([corner.center_px for corner in found.corners.values()])
    steps = np.array([corner.steps_px for corner in found.corners.values()])
    centers, steps, others = reduced_px(corners, factor), steps / factor, list[Array]()
    while True:
        around = centers[:, None] + np.einsum("nij,kj->nki", steps, [(-1, -1), (1, -1), (1, 1), (-1, 1)])
        hull = cv2.convexHull(around.reshape(-1, 2).astype(np.float32))
        cv2.fillConvexPoly(picture, np.round(hull).astype(np.int32), background)
        if not cv2.checkChessboard(picture, (spec.columns, spec.rows)):  # searching in vain takes long
            return tuple(others)
        grid = _drawn_chessboard_grid(picture, spec, _THOROUGHLY, _DRAWINGS)
        if grid is None:
            return tuple(others)
        others.append(scan_px(grid.mean(axis=(0, 1)), factor))
        centers = grid.reshape(-1, 2)
        steps = _grid_steps(grid).reshape(-1, 2, 2)


def _right_handed(grid: Array) -> Array:
    """Mirror a grid (rows, columns, 2) if needed, so that its axes have the handedness of the scan's column and row."""
    across, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    turn = np.linalg.det(np.stack([across.mean(axis=0), down.mean(axis=0)]))
    return grid if turn > 0 else grid[:, ::-1]


def find_board(scan: Scan, spec: ChessboardSpec | ArucoSpec | CharucoSpec | SquareGridSpec) -> FoundBoard:
    """Find a board in a reduced scan, then at a finer reduction, which small boards in large scans need: the older
    detector takes 10 s there where the count is wrong. A whole chessboard is first searched in a coarse image."""
    longest = max(scan.width_px, scan.height_px)
    *sizes, quick = (max(round(longest / size), 1) for size in (_FIRST_SIZE_PX, _LAST_SIZE_PX, _QUICK_SIZE_PX))
    if isinstance(spec, ChessboardSpec) and quick > max(sizes):
        found = _find_reduced(scan, spec, quick, is_quick=True)
        if found.corners:
            return replace(found, others_px=_other_chessboards(scan, found, spec, max(sizes)))
    for factor in sorted(set(sizes), reverse=True):
        found = _find_reduced(scan, spec, factor)
        if found.corners or found.is_of_other_count or found.reason.code == Code.CONTRAST:
            break
    if not isinstance(spec, ChessboardSpec):
        return found
    if found.corners:
        return replace(found, others_px=_other_chessboards(scan, found, spec, factor))
    if found.is_of_other_count or found.reason.code == Code.CONTRAST:
        return found
    flattened = _find_reduced(scan, spec, max(sizes), is_flattened=True)
    return flattened if flattened.corners else found


def _find_reduced(
    scan: Scan,
    spec: ChessboardSpec | ArucoSpec | CharucoSpec | SquareGridSpec,
    factor: int,
    is_quick: bool = False,
    is_flattened: bool = False,
) -> FoundBoard:
    """Find a board in the scan reduced by a factor. Returns coordinates of the full scan."""
    picture, reason = _searchable(scan, factor, is_flattened)
    if reason:
        return FoundBoard({}, reason)
    if isinstance(spec, ChessboardSpec):
        found = find_chessboard(picture, spec, is_quick)
    else:
        found = find_squares(picture, spec) if isinstance(spec, SquareGridSpec) else _find_markers(picture, spec)
    corners = {
        name: FoundCorner(scan_px(corner.center_px, factor), corner.steps_px * factor)
        for name, corner in found.corners.items()
    }
    return replace(found, corners=corners, others_px=tuple(scan_px(one, factor) for one in found.others_px))


def _find_markers(picture: Bytes, spec: ArucoSpec | CharucoSpec) -> FoundBoard:
    """Find a board of markers as printed, or in the mirrored image, since mirrored markers cannot be read."""

    def find(shown: Bytes) -> FoundBoard:
        return find_charuco(shown, spec) if isinstance(spec, CharucoSpec) else find_aruco(shown, spec)

    upright = find(picture)
    if len(upright.corners) >= _PLAIN_CORNERS:
        return upright
    mirrored = find(np.ascontiguousarray(picture[:, ::-1]))
    is_mirrored = len(mirrored.corners) >= max(_PLAIN_CORNERS, len(upright.corners) + 1)
    return mirrored.mirror(picture.shape[1]) if is_mirrored else upright


def fitting_board(scan: Scan, spec: BoardSpec) -> ArucoSpec | CharucoSpec | None:
    """Return the variant of a board of markers, or the board itself, with which most markers of a scan agree."""
    picture, reason = _searchable(scan, _first_factor(scan))
    if isinstance(spec, ArucoSpec):
        return None if reason else read_board(picture, spec)[1]
    return read_board(picture, spec)[1] if isinstance(spec, CharucoSpec) and not reason else None


def recognise_board(scan: Scan) -> str:
    """Options of `reseau calibrate` for the board that a scan shows: "--board 9x6" for a chessboard, kind and
    dictionary for markers; "" if no board is found."""
    picture, reason = _searchable(scan, _first_factor(scan))
    if reason:
        return ""
    dictionary, border, markers = read_any_markers(picture)
    if len(markers) >= _FEWEST_MARKERS:
        if border == AprilGridSpec.border_modules:
            return "--kind aprilgrid --board COLUMNSxROWS"
        kind = "charuco" if are_diagonal(markers) else "aruco"
        return f"--kind {kind} --dictionary {dictionary} --board COLUMNSxROWS --marker SIZE"
    grid = _chessboard_of_any_count(picture)
    pattern = whole_pattern(picture, _right_handed(grid)) if grid is not None else None
    if pattern is None or not is_even(pattern.grid, (picture.shape[1], picture.shape[0])):
        return ""
    rows, columns = sorted(pattern.grid.shape[:2])
    return f"--board {columns}x{rows}"


def _first_factor(scan: Scan) -> int:
    """Factor that reduces a scan for a first look."""
    return max(round(max(scan.width_px, scan.height_px) / _FIRST_SIZE_PX), 1)


def _searchable(scan: Scan, factor: int, is_flattened: bool = False) -> tuple[Bytes, Reason]:
    """Reduced scan stretched to 8 bits, and the reason if it has no contrast to search in. is_flattened: less its local
    mean, over its local standard deviation, in which a faint board on a warm or shaded sheet stands out."""
    grey = scan.reduced(factor) if factor > 1 else scan.window(0, 0, scan.width_px, scan.height_px)
    if is_flattened:
        around_px = max(grey.shape) / _AROUND
        grey = grey - cv2.GaussianBlur(grey, (0, 0), around_px)
        grey /= np.sqrt(cv2.GaussianBlur(grey * grey, (0, 0), around_px)) + _FAINTEST * scan.full_scale_dn
    every = max(round(np.sqrt(grey.size / _ENOUGH_PIXELS)), 1)
    shown = np.sort(grey[::every, ::every], axis=None)  # several times as fast as np.percentile
    low, high = shown[len(shown) // 100], shown[-1 - len(shown) // 100]
    if not is_flattened and high - low < _LEAST_CONTRAST * scan.full_scale_dn:
        share = 100 * (high - low) / scan.full_scale_dn
        message = f"the scan has no contrast: its grey values span {share:.1f} % of the scale"
        return np.zeros((1, 1), np.uint8), Reason(message, Code.CONTRAST)
    grey -= low
    grey *= 255 / (high - low)
    return np.clip(grey, 0, 255, out=grey).astype(np.uint8), NO_REASON
