"""Identification of the points of a printed grid: assignment of detected points to the places of the grid."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from measure.array_types import Array, Bytes, Integers
from measure.boards.specs import CircleGridSpec, FoundBoard, FoundCorner, SquareGridSpec, corners_of_square
from measure.flags import NO_REASON, Code, Reason

Place = tuple[int, int]

_NEIGHBOURS = 8  # of a point: those that touch its square
_STEP_TOLERANCE = 0.3  # in steps, between expected and actual place of a neighbour
_SEEDS = 12  # start points, spread over all points
_LIKENESS = 0.4  # largest difference of neighbours in log size and log contrast
_LEAST_SHARE = 0.8  # fraction of the grid's places that must be detected
_LINE_SHARE = 0.5  # fraction of a line's places from which on the line is one of the grid
_BLOCKS = (1 / 4, 1 / 8, 1 / 16)  # fractions of the image's shorter side: windows of the adaptive threshold
_DARKER = 12  # grey values of 255 by which a square is darker than the mean around it
_SMALLEST_SIDE_PX = 6.0  # px; the corners of smaller squares cannot be resolved
_LARGEST = 0.2  # fraction of the image's area, limit of a square
_STRAIGHT = 0.06  # fraction of the perimeter, tolerance of the quadrangle's sides
_FILLED = 0.8  # fraction of the quadrangle's area enclosed by the outline


def grid_places(points_px: Array, appearances: Array, places: list[Place]) -> list[dict[Place, int]]:
    """Assign points to the places (row, column) of a grid.

    The grid's outline must be visible; a fifth of its places may be missing. The grid is never mirrored.

    Parameters
    ----------
    points_px : (n, 2) detected points, which may include others.
    appearances : (n, k) logarithms of size and contrast, in which neighbours differ little.

    Returns
    -------
    Assignments {place: index of the point}, empty if no outline fits. The first one explains most points. Further ones
    are turned grids, or other positions on a larger lattice, that explain as many up to half a line of the grid. A
    lattice as large as the grid has priority over a larger one.
    """
    return _best_outlines(_lattices(points_px, appearances), places)


def _best_outlines(lattices: list[dict[Place, int]], places: list[Place]) -> list[dict[Place, int]]:
    best: list[dict[Place, int]] = []
    for lattice in lattices:
        found = _outlines(lattice, places)
        best = max(best, found, key=lambda ways: (is_whole(ways), len(ways[0]) if ways else 0))
        if is_whole(best) and len(best[0]) > 0.98 * len(places):
            break
    return best


def is_whole(assignments: list[dict[Place, int]]) -> bool:
    """Whether all assignments use the same points, so that the grid is not part of a larger lattice."""
    return len({frozenset(assignment.values()) for assignment in assignments}) == 1


def _lattices(points_px: Array, appearances: Array) -> list[dict[Place, int]]:
    """Lattices {(i, j): index} formed by the points, the largest first; i and j have the handedness of column and
    row."""
    if len(points_px) < 4:
        return []
    tree = cKDTree(points_px)
    seeds = np.linspace(0, len(points_px) - 1, _SEEDS).astype(int).tolist()
    found = [_grown(points_px, appearances, tree, seed) for seed in seeds]
    return [lattice for lattice in sorted(found, key=len, reverse=True)[:3] if lattice]


def _grown(points_px: Array, appearances: Array, tree: cKDTree, seed: int) -> dict[Place, int]:
    """Grow a lattice around a point from neighbour to neighbour, predicting each step from the last."""
    basis = _seed_basis(points_px, tree, seed)
    if basis is None:
        return {}
    lattice: dict[Place, int] = {(0, 0): seed}
    steps = {(0, 0): basis}
    waiting: deque[Place] = deque([(0, 0)])
    taken = {seed}
    while waiting:
        i, j = waiting.popleft()
        here, step = points_px[lattice[i, j]], steps[i, j]
        for along, sign in product((0, 1), (1, -1)):
            place = (i + sign, j) if along == 0 else (i, j + sign)
            if place in lattice:
                continue
            distance, index = tree.query(here + sign * step[along])
            unlike = np.abs(appearances[index] - appearances[lattice[i, j]]).max() > _LIKENESS
            if unlike or distance > _STEP_TOLERANCE * np.hypot(*step[along]) or int(index) in taken:
                continue
            lattice[place] = int(index)
            taken.add(int(index))
            refined = step.copy()
            refined[along] = sign * (points_px[index] - here)
            steps[place] = 0.5 * (step + refined)
            waiting.append(place)
    return lattice


def _seed_basis(points_px: Array, tree: cKDTree, seed: int) -> Array | None:
    """(2, 2) rows: the two shortest steps from a point to neighbours with a counterpart on the opposite side."""
    _, near = tree.query(points_px[seed], k=np.arange(2, min(_NEIGHBOURS + 1, len(points_px)) + 1))
    steps = points_px[near] - points_px[seed]
    paired = [step for step in steps if tree.query(points_px[seed] - step)[0] < _STEP_TOLERANCE * np.hypot(*step)]
    for second in paired[1:]:
        turn = np.linalg.det(np.stack([paired[0], second]))
        if abs(turn) > 0.3 * np.hypot(*paired[0]) * np.hypot(*second):
            return np.stack([paired[0], second if turn > 0 else -second])
    return None


def _outlines(lattice: dict[Place, int], places: list[Place]) -> list[dict[Place, int]]:
    """Assignments of the grid's outline to a lattice, most points first; those that lack more than half a line are
    dropped."""
    wanted = set(places)
    nodes = np.array(list(lattice)).reshape(-1, 2)
    indices = list(lattice.values())
    found: list[dict[Place, int]] = []
    for matrix in _unit_steps(places):
        columns_rows = nodes @ matrix
        for shift in _outline_shifts(columns_rows, places):
            moved = columns_rows + shift
            assignment = {
                (int(row), int(column)): index
                for (column, row), index in zip(moved, indices, strict=True)
                if (int(row), int(column)) in wanted
            }
            if len(assignment) >= _LEAST_SHARE * len(places) and assignment not in found:
                found.append(assignment)
    found.sort(key=len, reverse=True)
    half_line = 0.5 * min(len({row for row, _ in places}), len({column for _, column in places}))
    return [assignment for assignment in found if len(assignment) > len(found[0]) - half_line]


def _unit_steps(places: list[Place]) -> list[Integers]:
    """(2, 2) matrices whose rows are the lattice's two steps in (column, row): all right-handed pairs of short steps
    that reach every place of the grid."""
    staggered = len({(row + column) % 2 for row, column in places}) == 1
    short = [np.array(step) for step in product((-2, -1, 0, 1, 2), repeat=2)]
    if staggered:
        short = [step for step in short if step.sum() % 2 == 0 and 0 < np.abs(step).sum() <= 2]
    else:
        short = [step for step in short if 0 < np.abs(step).max() <= 1]
    area = 2 if staggered else 1
    pairs = (np.stack(pair) for pair in product(short, repeat=2))
    return [pair for pair in pairs if round(np.linalg.det(pair)) == area]


def _outline_shifts(columns_rows: Integers, places: list[Place]) -> list[Integers]:
    """Shifts that place the grid's outline on a lattice's nodes. Points outside the grid may enlarge the lattice by a
    line or two."""
    grid = np.array([(column, row) for row, column in places])
    size = grid.max(axis=0) + 1
    least, greatest = columns_rows.min(axis=0), columns_rows.max(axis=0)
    extra = greatest - least + 1 - size
    if np.any(extra < 0) or np.any(extra > 2):
        return []
    return [-least - np.array(spare) for spare in product(range(int(extra[0]) + 1), range(int(extra[1]) + 1))]


def _count_scores(lattice: dict[Place, int], is_staggered: bool) -> dict[tuple[int, int], float]:
    """How well a lattice fills grids of (columns, rows), in points, without sparse lines at its sides. Empty if most of
    the lattice fills none: the picture then shows a part of the grid."""
    nodes, scores = np.array(list(lattice)).reshape(-1, 2), dict[tuple[int, int], float]()
    for matrix in _unit_steps([(0, 0), (1, 1)] if is_staggered else [(0, 0), (0, 1)]):
        at, is_sparse = nodes @ matrix, True
        while len(at) and is_sparse:
            low, high = at.min(axis=0), at.max(axis=0)
            per_line = (high - low + 1)[::-1] / (2 if is_staggered else 1)
            ends = [(axis, end[axis]) for end in (low, high) for axis in (0, 1)]
            sparse = [(axis, end) for axis, end in ends if (at[:, axis] == end).sum() < _LINE_SHARE * per_line[axis]]
            is_sparse = bool(sparse)
            for axis, end in sparse[:1]:
                at = at[at[:, axis] != end]
        if not len(at):
            continue
        columns, rows = (high - low + 1).tolist()
        begins = not is_staggered or (at - low).sum(axis=1)[0] % 2 == 0  # with a dot
        places = (columns * rows + 1) // 2 if is_staggered else columns * rows
        if begins and len(at) > _LEAST_SHARE * max(places, len(lattice)):
            scores[columns, rows] = len(at) ** 2 / places
    return scores


def grid_of_any_count(points_px: Array, appearances: Array) -> tuple[int, int, bool] | None:
    """(columns, rows, whether it is staggered) of the grid that points form, in places as a `CircleGridSpec` counts
    them, wider than high; staggered ones with whole numbers of dots in a row, where they have any."""
    found = dict[tuple[int, int, bool], float]()
    for lattice, is_staggered in product(_lattices(points_px, appearances)[:1], (False, True)):
        scores = _count_scores(lattice, is_staggered)
        found |= {
            (*count, is_staggered): score for count, score in scores.items() if min(count) >= CircleGridSpec.fewest
        }
    best = [grid for grid, score in found.items() if score == max(found.values())]
    return max(best, key=lambda grid: (grid[2] and grid[0] % 2 == 0, grid), default=None)


@dataclass(frozen=True, eq=False)
class FoundGrid:
    """Grid found in a scan.

    assignment: index of the point at each place, empty if no grid was found; others_px: centres of further grids;
    notes: messages to the user; reason: why no grid was found; is_larger: since the scan shows one of a larger count.
    """

    assignment: dict[Place, int]
    others_px: tuple[Array, ...] = ()
    notes: tuple[str, ...] = ()
    reason: Reason = NO_REASON
    is_larger: bool = False


def find_grid(points_px: Array, appearances: Array, spec: CircleGridSpec | SquareGridSpec, what: str) -> FoundGrid:
    """Find the grid formed by points. Of several orientations the most upright one in the scan is returned.
    points_px, appearances: as in `grid_places`; what: word for the points in messages."""
    size, places = grid_size(spec, what), spec.places()
    lattices = _lattices(points_px, appearances)
    assignments = _best_outlines(lattices, places)
    is_staggered = isinstance(spec, CircleGridSpec) and spec.asymmetric
    scores = _count_scores(lattices[0], is_staggered) if lattices else {}
    best = max(scores.values(), default=0)
    counts = [count for count, score in scores.items() if score == best and min(count) >= spec.fewest]
    is_larger = any(columns * rows > spec.columns * spec.rows for columns, rows in counts)
    if is_larger or not is_whole(assignments):
        message = f"no grid of {size} is whole in the scan; {len(points_px)} spots are candidates for {what}"
        if counts and (spec.columns, spec.rows) not in counts:
            off = [abs(columns - spec.columns) + abs(rows - spec.rows) for columns, rows in counts]
            columns, rows = counts[int(np.argmin(off))]
            other = grid_size(replace(spec, columns=columns, rows=rows), what)
            message = f"no grid of {size} is whole in the scan; one of {other} is. Correct the count"
            if not is_larger:
                message += ", or show the whole grid, with all of its lines"
        elif assignments:
            message = f"the grid is larger than {size}, or one of its lines is hidden"
        return FoundGrid({}, reason=Reason(message, Code.NO_BOARD), is_larger=is_larger)

    def uprightness(assignment: dict[Place, int]) -> float:
        """Covariance of the grid's columns with the column in the scan: largest for the upright grid."""
        columns = [column for _, column in assignment]
        return float(np.cov(columns, points_px[list(assignment.values()), 0])[0, 1])

    assignment = max(assignments, key=uprightness)
    notes = ("the grid looks the same when turned: it was taken as upright in the scan",)
    others, left, found = list[Array](), np.arange(len(points_px)), list(assignment.values())
    while True:
        left = np.delete(left, found)
        further = grid_places(points_px[left], appearances[left], places)
        if not is_whole(further):
            return FoundGrid(assignment, tuple(others), notes[: len(assignments) - 1])
        found = list(further[0].values())
        others.append(points_px[left[found]].mean(axis=0))


def grid_size(spec: CircleGridSpec | SquareGridSpec, what: str) -> str:
    """Size of a grid for messages. what: word for its points."""
    if isinstance(spec, CircleGridSpec) and spec.asymmetric:  # its columns may be counted as dots or as places
        in_rows = f"{(spec.columns + 1) // 2}{f' and {spec.columns // 2}' if spec.columns % 2 else ''}"
        return f"{len(spec.places())} {what} in {spec.rows} rows of {in_rows}"
    return f"{spec.columns} x {spec.rows} {what}"


def find_squares(picture: Bytes, spec: SquareGridSpec) -> FoundBoard:
    """Find the corners of a grid of separate dark squares, to about a pixel. Nearly all squares must be visible. A
    corner's steps are the sides of the square that leave it."""
    reason = NO_REASON
    for share in _BLOCKS:
        quads = list(_dark_quads(picture, share))
        centers = np.array([quad.mean(axis=0) for quad in quads]).reshape(-1, 2)
        appearances = np.log([[cv2.contourArea(quad.astype(np.float32))] for quad in quads] or np.ones((0, 1)))
        grid = find_grid(centers, appearances, spec, "squares")
        reason = grid.reason
        if grid.is_larger:  # other thresholds may lose its lines
            break
        if not reason:
            grid_places_px = centers[list(grid.assignment.values())]
            columns_rows = np.array([(column, row) for row, column in grid.assignment], float)
            homography = np.asarray(cv2.findHomography(columns_rows, grid_places_px)[0], float)
            corners: dict[str, FoundCorner] = {}
            for (row, column), index in grid.assignment.items():
                quad, steps = quads[index], homography_steps(homography, np.array([column, row], float))[1]
                right, down = np.linalg.solve(steps, (quad - quad.mean(axis=0)).T)
                clockwise = np.argsort(np.arctan2(down, right))  # from the upper left one
                corners |= corners_of_square(f"r{row}c{column}", quad[clockwise])
            return FoundBoard(corners, others_px=grid.others_px, notes=grid.notes)
    return FoundBoard({}, reason)


def _dark_quads(picture: Bytes, share: float) -> Iterator[Array]:
    """Outlines (4, 2) of dark quadrangles by an adaptive threshold. share: window, fraction of the image's shorter
    side."""
    block = max(int(share * min(picture.shape)), 3) | 1
    dark = cv2.adaptiveThreshold(picture, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, _DARKER)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        area = cv2.contourArea(outline)
        if not _SMALLEST_SIDE_PX**2 <= area <= _LARGEST * picture.size:
            continue
        quad = cv2.approxPolyDP(outline, _STRAIGHT * cv2.arcLength(outline, True), True)
        if len(quad) == 4 and cv2.isContourConvex(quad) and area > _FILLED * cv2.contourArea(quad):
            yield np.asarray(quad, float).reshape(4, 2)


def homography_steps(homography: Array, place: ArrayLike) -> tuple[Array, Array]:
    """Image (2,) of a place (2,) under a homography, and its derivatives (2, 2): the steps to the next column and
    row."""
    x, y, w = homography @ np.append(place, 1.0)
    image = np.array([x, y]) / w
    return image, np.asarray((homography[:2, :2] - np.outer(image, homography[2, :2])) / w)
