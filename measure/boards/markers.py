"""Detection of a board's markers. A marker read at several places is resolved by the layout of the board."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Any, TypeVar, cast

import cv2
import numpy as np
from scipy.spatial import cKDTree

from measure.array_types import Array, Bytes
from measure.boards.lattice import homography_steps
from measure.boards.specs import (
    AprilGridSpec,
    ArucoSpec,
    CharucoSpec,
    FoundBoard,
    FoundCorner,
    aruco_dictionary,
    corners_of_square,
)
from measure.flags import NO_REASON, Code, Reason
from measure.targets.sheets import SheetView, fit_view_robustly

Markers = Mapping[int, Array]  # the corners (4, 2) of each on its board, by number
Changes = dict[str, Any]
Layout = TypeVar("Layout", ArucoSpec, CharucoSpec)
_OFF_SQUARES = 0.25  # in squares, largest distance of a corner from the place given by the adjacent markers
_COMMON_DICTIONARIES = ("4X4_250", "5X5_250", "6X6_250", "7X7_250", "ARUCO_ORIGINAL", "APRILTAG_36h11")
_FEWEST_TWICE = 2  # markers read at several places, from which on these are another board, no false readings
_FEWEST_CORNERS = 4  # points needed for a homography
_MOST_COLUMNS = 40  # limit of the columns tried for a board of another count
_ALIKE, _MOST_ALIKE = 0.03, 0.8  # in sides, outlines of one size; fraction of the markers that agree on it


@dataclass(frozen=True, eq=False)
class MarkerReadings:
    """All markers of a dictionary read in an image.

    outlines_px: by number, list of outlines (4, 2); size_px: width and height of the image; border: width of the border
    around the code, fraction of the marker's side.
    """

    outlines_px: Mapping[int, list[Array]]
    size_px: tuple[int, int]
    border: float

    def turn_corners(self, turns: int) -> "MarkerReadings":
        """Renumber the corners of all markers by quarter turns."""
        turned = {
            number: [np.roll(outline, turns, axis=0) for outline in places]
            for number, places in self.outlines_px.items()
        }
        return replace(self, outlines_px=turned)


@dataclass(frozen=True, eq=False)
class ReadMarkers:
    """Markers of a board.

    corners_px: (4, 2) by number; refused: by number, markers that contradict the board's layout or are ambiguous, with
    the reason; agreeing: number of markers consistent with the layout.
    """

    corners_px: Mapping[int, Array]
    refused: Mapping[int, Reason]
    agreeing: int


def read_markers(
    picture: Bytes, dictionary: cv2.aruco.Dictionary, border_modules: int = 1, touched: bool = False
) -> MarkerReadings:
    """Read all markers of a dictionary, of any board. border_modules: around the code; touched: whether squares touch
    the markers' corners, so that the corners must be refined."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_modules
    if touched:
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    outlines, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(picture)
    readings: dict[int, list[Array]] = {}
    for outline, number in zip(
        outlines, [] if numbers is None else np.asarray(numbers, int).ravel().tolist(), strict=True
    ):
        readings.setdefault(number, []).append(np.asarray(outline, float).reshape(4, 2))
    border = border_modules / (dictionary.markerSize + 2 * border_modules)
    return MarkerReadings(readings, (picture.shape[1], picture.shape[0]), border)


def read_any_markers(picture: Bytes) -> tuple[str, int, Array]:
    """Common dictionary of which most markers are read in an image, the width of their border in modules, and outlines
    (n, 4, 2) of the different markers."""
    kinds = [*((name, 1) for name in _COMMON_DICTIONARIES), (_COMMON_DICTIONARIES[-1], AprilGridSpec.border_modules)]
    outlines = {kind: read_markers(picture, aruco_dictionary(kind[0]), kind[1]).outlines_px for kind in kinds}
    name, border = max(outlines, key=lambda each: len(outlines[each]))
    return name, border, np.array([places[0] for places in outlines[name, border].values()]).reshape(-1, 4, 2)


def are_diagonal(outlines_px: Array) -> bool:
    """Whether most of several markers (n, 4, 2) have the nearest other one along a diagonal, as on a ChArUco board."""
    middles = outlines_px.mean(axis=1)
    nearest = np.asarray(cKDTree(middles).query(middles, [2])[1])[:, 0]
    sides = np.stack([outlines_px[:, 1] - outlines_px[:, 0], outlines_px[:, 3] - outlines_px[:, 0]], axis=-1)
    across = np.abs(np.linalg.solve(sides, (middles[nearest] - middles)[..., None])[..., 0])
    return bool(np.median(across.min(axis=1) / across.max(axis=1)) > 0.5)


def placed_markers(read: MarkerReadings, board: Markers) -> ReadMarkers:
    """Select the markers consistent with a board, in the order in which they were read."""
    readings = {number: places for number, places in read.outlines_px.items() if number in board}
    view = _view(readings, board, read.size_px, read.border / 2)
    own_side = fitting_side(readings, board, read.size_px) if view is None else None
    corners: dict[int, Array] = {}
    several = {number: len(places) for number, places in readings.items() if len(places) > 1}
    refused: dict[int, Reason] = {}
    if len(several) >= _FEWEST_TWICE:
        message = "marker {} was read at {} places, of which one lies on the board: there may be another such board"
        refused = {number: Reason(message.format(number, count), Code.AMBIGUOUS) for number, count in several.items()}
    agreeing = 0
    for number, places in readings.items():
        off = [_off(view, board[number], place) for place in places]
        best = int(np.argmin(np.nan_to_num(off, nan=np.inf)))
        agreeing += off[best] < 1.0
        if off[best] < 1.0 or (len(readings) == len(places) == 1):
            corners[number] = places[best]
        elif len(places) > 1:
            refused[number] = Reason(
                f"marker {number} was read at {len(places)} places, and nothing shows which is the board's: "
                "there may be another such board",
                Code.AMBIGUOUS,
            )
        elif view is None and own_side is not None:
            side = float(np.hypot(*(board[number][1] - board[number][0])))
            message = f"marker {number} was read, but its side is about {own_side:.3g} mm against the distances, "
            message += f"{side:.3g} mm being described: measure both on the board"
            refused[number] = Reason(message, Code.SIZE)
        elif view is None:
            refused[number] = Reason(
                f"marker {number} was read, but the board's markers do not agree on where the board lies: "
                "columns, rows or kind may be wrong, or there may be another such board",
                Code.AMBIGUOUS,
            )
        else:
            message = f"marker {number} was read where the board's other markers do not have it"
            refused[number] = Reason(message, Code.OFF_PLACE)
    return ReadMarkers(corners, refused, agreeing)


def other_first_numbers(read: MarkerReadings, first: int, count: int) -> list[int]:
    """Alternative first numbers with which a board of count markers contains all that were read; empty if it already
    does."""
    numbers = sorted(read.outlines_px)
    if not numbers or (first <= numbers[0] and numbers[-1] < first + count):
        return []
    return list(range(max(numbers[-1] - count + 1, 0), numbers[0] + 1))


def _view(
    readings: Mapping[int, list[Array]], board: Mapping[int, Array], size_px: tuple[int, int], half_border: float
) -> SheetView | None:
    """Fit the view of the board to the markers read once.

    Returns None unless most markers agree with it and their corners fit: the markers of two boards may be arranged like
    those of one compressed board.
    """
    single = {number: places[0] for number, places in readings.items() if len(places) == 1}
    if len(single) < 2:
        return None
    points = np.concatenate([board[number] for number in single])
    view = fit_view_robustly(points, np.concatenate(list(single.values())), size_px)
    if view is None:
        return None
    misfits = [_misfit(view, board[number], place) for number, place in single.items()]
    agreeing = sum(
        min(_off(view, board[number], place) for place in places) < 1.0 for number, places in readings.items()
    )
    return view if 2 * agreeing > len(readings) and np.median(misfits) < half_border else None


def fitting_side(readings: Mapping[int, list[Array]], board: Markers, size_px: tuple[int, int]) -> float | None:
    """Side of the markers that fits the distances of their middles; None unless most of those read once agree on it."""
    single = {number: places[0] for number, places in readings.items() if len(places) == 1}
    if len(single) < _FEWEST_CORNERS:
        return None
    middles, middles_px = (
        np.array([corners.mean(axis=0) for corners in each])
        for each in ([board[number] for number in single], list(single.values()))
    )
    view = fit_view_robustly(middles, middles_px, size_px)
    if view is None:
        return None
    ratios, alike = list[float](), 0
    for number, place in single.items():
        predicted = view.places_px(board[number])
        ratios.append(float(np.sqrt(_area(place) / max(_area(predicted), 1e-9))))  # 0 where the view has no image
        scaled = ratios[-1] * (predicted - predicted.mean(axis=0))
        off = (scaled - (place - place.mean(axis=0))) / _side_px(place)
        alike += _off(view, board[number], place) < _OFF_SQUARES and np.sqrt((off**2).sum(axis=1).mean()) < _ALIKE
    ratio, first = float(np.median(ratios)), next(iter(single))
    spread = np.abs(np.array(ratios) / ratio - 1)
    if min(alike, (spread < _ALIKE).sum()) < _MOST_ALIKE * len(single):
        return None
    return ratio * float(np.hypot(*(board[first][1] - board[first][0])))


def _area(outline: Array) -> float:
    return float(cv2.contourArea(np.asarray(outline, np.float32)))


def _misfit(view: SheetView, corners: Array, image_px: Array) -> float:
    """RMS distance of a marker's corners from their predicted places, in sides of the marker, both about their middle:
    a fisheye displaces whole markers against a view."""
    off_px = view.places_px(corners) - image_px
    return float(np.sqrt(np.mean(np.sum((off_px - off_px.mean(axis=0)) ** 2, axis=1)))) / _side_px(image_px)


def _off(view: SheetView | None, corners: Array, image_px: Array) -> float:
    """Distance of a marker from its predicted place, in sides of the marker; nan without a view. A different marker is
    at least one side away."""
    if view is None:
        return np.nan
    return float(np.hypot(*(view.places_px(corners) - image_px).mean(axis=0))) / _side_px(image_px)


def _side_px(image_px: Array) -> float:
    """Longest side of a marker (4, 2) in the image."""
    return float(np.hypot(*(np.roll(image_px, 1, axis=0) - image_px).T).max())


def find_aruco(picture: Bytes, spec: ArucoSpec) -> FoundBoard:
    """Find the corners of a board's ArUco markers. A corner's steps are the sides of the marker that leave it."""
    read, layout = read_board(picture, spec)
    if layout != spec:
        return _other_layout_board(spec, layout)
    found: dict[str, FoundCorner] = {}
    for number, corners in read.corners_px.items():
        found |= corners_of_square(f"{number}", corners)
    return FoundBoard(found, NO_REASON if found else _too_few(spec, read), read.refused)


def find_charuco(picture: Bytes, spec: CharucoSpec) -> FoundBoard:
    """Find the inner corners of a ChArUco board whose adjacent markers are read. If the specification does not state
    which of OpenCV's two layouts the board has, the markers decide."""
    read, layout = read_board(picture, spec)
    if layout not in (spec, replace(spec, legacy=True) if spec.legacy is None else spec):
        return _other_layout_board(spec, layout)
    spec = layout
    outlines = [outline[None].astype(np.float32) for outline in read.corners_px.values()]
    numbers_read = np.array(list(read.corners_px), np.int32)[:, None]
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(charuco_board(spec)).detectBoard(
        picture, markerCorners=outlines, markerIds=numbers_read
    )
    if corners is None or len(corners) < _FEWEST_CORNERS:
        return FoundBoard({}, _too_few(spec, read), read.refused)
    places, ids = np.asarray(corners, float).reshape(-1, 2), np.asarray(numbers, int).ravel()
    # Sides of the squares at each corner from a homography of the board, since neighbours may be missing.
    across = spec.columns - 1
    board = np.stack([ids % across, ids // across], axis=-1).astype(float)
    if np.linalg.matrix_rank(board - board[0]) < 2:
        message = f"only {len(ids)} corners of one line were found, which do not place the board"
        return FoundBoard({}, Reason(message, Code.NO_BOARD), read.refused)
    homography = np.asarray(cv2.findHomography(board, places)[0], float)
    found = {
        f"c{number}": FoundCorner(place, homography_steps(homography, on_board)[1])
        for number, place, on_board in zip(ids, places, board, strict=True)
    }
    off = off_corners(found, spec, read)
    kept = {name: corner for name, corner in found.items() if name not in off}
    return FoundBoard(kept, refused=read.refused, off_corners=off)


def read_board(picture: Bytes, spec: Layout) -> tuple[ReadMarkers, Layout]:
    """Read a board's markers. Returns them with the layout, the specified one or a variant, with which most of them
    agree."""
    touched = isinstance(spec, AprilGridSpec)
    is_tag = spec.dictionary.upper().removeprefix("DICT_").startswith("APRILTAG")
    borders = (AprilGridSpec.border_modules, 1) if is_tag else (1,)
    dictionary = aruco_dictionary(spec.dictionary)
    readings: MarkerReadings = max(
        (read_markers(picture, dictionary, border, touched) for border in borders),
        key=lambda each: len(each.outlines_px),
    )
    best, layout = placed_markers(readings, _markers(spec)), spec
    # Programs that print AprilTags differ in which of a tag's corners is the first.
    turned = [readings.turn_corners(turns) for turns in range(4 if is_tag else 1)]
    layouts: Iterator[Layout] = chain((spec,), _other_layouts(spec, readings))
    for other, read in product(layouts, turned):
        if best.agreeing == len(readings.outlines_px):
            break
        placed = placed_markers(read, _markers(other))
        is_usual = {other.columns, other.rows} == {spec.columns, spec.rows}
        if placed.agreeing > best.agreeing + (not is_usual):  # one false reading agrees with one of many counts
            best, layout = placed, other
    return best, layout


def _other_layouts(spec: Layout, read: MarkerReadings) -> Iterator[Layout]:
    """Variants of a specification that may be confused with it: the other layout, swapped counts, other first numbers,
    and all of these at once, those with few changes first; then other counts."""
    is_aruco = isinstance(spec, ArucoSpec)
    first_key: str = "first_marker" if is_aruco else "first_id"
    firsts: list[int] = other_first_numbers(read, getattr(spec, first_key), len(_markers(spec)))
    layouts = spec, _other_layout(spec)
    swapped: Changes = {"columns": spec.rows, "rows": spec.columns}
    numbered: list[Changes] = [{first_key: first} for first in firsts]
    groups: tuple[list[Changes], ...] = [{}], [swapped], numbered, [swapped | each for each in numbered]
    for changes in groups:
        yield from (
            replace(layout, **change) for change, layout in product(changes, layouts) if change or layout != spec
        )
    for layout in layouts:
        yield from _of_other_counts(layout, read)


def _of_other_counts(spec: Layout, read: MarkerReadings) -> Iterator[Layout]:
    """The specification with the counts in whose layout most of the markers that were read lie, if it has others."""
    first: int = getattr(spec, "first_marker" if isinstance(spec, ArucoSpec) else "first_id")
    middles_px = {number: places[0].mean(axis=0) for number, places in read.outlines_px.items() if number >= first}
    if len(middles_px) < _FEWEST_CORNERS:
        return
    near_px = float(np.median([_side_px(read.outlines_px[number][0]) for number in middles_px])) / 2.0
    best, most = spec, 0
    for columns in sorted(range(spec.fewest, _MOST_COLUMNS), key=lambda each: abs(each - spec.columns)):
        of_rows = columns / (2 if isinstance(spec, CharucoSpec) else 1)
        rows = max(int(np.ceil((max(middles_px) + 1 - first) / of_rows)), spec.fewest)
        counts: Changes = {"columns": columns, "rows": rows}
        with suppress(ValueError):  # raised where the dictionary has too few markers
            other = replace(spec, **counts)
            on_board = _markers(other)
            middles = np.array([on_board[number].mean(axis=0) for number in middles_px])
            _, inside = cv2.findHomography(middles, np.array(list(middles_px.values())), cv2.RANSAC, near_px)
            if inside is not None and inside.sum() > most:
                best, most = other, int(inside.sum())
    if best != spec:
        yield best


def _other_layout(spec: Layout) -> Layout:
    """The same counts in the other of two common layouts: OpenCV's of ChArUco boards, markers counted from below."""
    if isinstance(spec, CharucoSpec):
        change: Changes = {"legacy": not spec.legacy}
        return replace(spec, **change)
    kind: type[Any] = ArucoSpec if isinstance(spec, AprilGridSpec) else AprilGridSpec
    return cast(Layout, kind(**vars(spec)))


def _other_layout_board(spec: ArucoSpec | CharucoSpec, other: ArucoSpec | CharucoSpec) -> FoundBoard:
    """Board without corners whose reason states which options of the specification contradict the markers."""
    first: str = "first_marker" if isinstance(spec, ArucoSpec) else "first_id"
    is_older, was_older = (bool(getattr(each, "legacy", False)) for each in (other, spec))
    kind = "aprilgrid" if isinstance(other, AprilGridSpec) else "aruco"
    changes = {
        f"kind {kind} and gaps of {getattr(other, 'gap_mm', 0.0):.6g} mm": type(other) is not type(spec),
        f"{other.columns} columns": other.columns != spec.columns,
        f"{other.rows} rows": other.rows != spec.rows,
        f"first marker {getattr(other, first)}": getattr(other, first) != getattr(spec, first),
        "the older layout (legacy)": is_older and not was_older,
        "the newer layout (not legacy)": was_older and not is_older,
    }
    fitting = ", ".join(change for change, differs in changes.items() if differs)
    message = f"the markers that were read do not lie as on the board that is described, but as with {fitting}"
    return FoundBoard({}, Reason(f"{message}. Set that, if it is the board's", Code.NO_BOARD))


def _too_few(spec: ArucoSpec | CharucoSpec, read: ReadMarkers) -> Reason:
    """Reason why a board was not found."""
    if read.refused:
        return next(iter(read.refused.values()))
    if isinstance(spec, CharucoSpec):
        message = f"{len(read.corners_px)} markers of {spec.dictionary} were read, too few to place the board's corners"
    else:
        last = spec.first_marker + spec.columns * spec.rows - 1
        message = f"no marker {spec.first_marker} to {last} of {spec.dictionary} was read"
    return Reason(message, Code.NO_BOARD)


def _markers(spec: ArucoSpec | CharucoSpec) -> Markers:
    """Corners of a board's markers. ChArUco boards use OpenCV's system: y down, origin at the upper left square."""
    if isinstance(spec, CharucoSpec):
        board = charuco_board(spec)
        return dict(zip(np.ravel(board.getIds()).tolist(), np.array(board.getObjPoints())[..., :2], strict=True))
    points = spec.object_points()
    numbers = range(spec.first_marker, spec.first_marker + spec.columns * spec.rows)
    return {number: np.array([points[f"{number}.{index}"][:2] for index in range(4)]) for number in numbers}


def charuco_board(spec: CharucoSpec) -> cv2.aruco.CharucoBoard:
    numbers = np.arange(spec.first_id, spec.first_id + spec.columns * spec.rows // 2)
    size = (spec.columns, spec.rows)
    dictionary = aruco_dictionary(spec.dictionary)
    board = cv2.aruco.CharucoBoard(size, spec.square_mm, spec.marker_mm, dictionary, numbers)
    board.setLegacyPattern(bool(spec.legacy))
    return board


def off_corners(found: Mapping[str, FoundCorner], spec: CharucoSpec, read: ReadMarkers) -> dict[str, Reason]:
    """Corners that contradict the homography of the adjacent markers, by id, with the reason."""
    on_board = _markers(spec)
    middles = {number: on_board[number].mean(axis=0) / spec.square_mm for number in read.corners_px}
    off = {}
    for name, corner in found.items():
        row, column = divmod(int(name[1:]), spec.columns - 1)
        place = np.array([column + 1.0, row + 1.0])
        touching = [number for number, middle in middles.items() if np.abs(middle - place).max() < 1.0]
        if not touching:
            continue
        squares = np.concatenate([on_board[number] for number in touching]) / spec.square_mm
        image_px = np.concatenate([read.corners_px[number] for number in touching])
        homography = np.asarray(cv2.findHomography(squares, image_px)[0], float)
        place_px, steps_px = homography_steps(homography, place)
        squares_off = np.linalg.solve(steps_px, corner.center_px - place_px)
        if np.hypot(*squares_off) > _OFF_SQUARES:
            message = f"it lies {np.hypot(*squares_off):.1f} squares from the place that the adjacent markers give"
            off[name] = Reason(message, Code.OFF_PLACE)
    return off
