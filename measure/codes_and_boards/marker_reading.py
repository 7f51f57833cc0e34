"""The markers of a board read in a picture, each at one place: where one is read at several, its board says which."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.reason import Code, Reason
from measure.targets.sheets import SheetView, robust_view

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Markers = Mapping[int, Array]  # the corners (4, 2) of each on its board, by number
Key = TypeVar("Key")


@dataclass(frozen=True, eq=False)
class MarkerReadings:
    """All markers of a dictionary that a picture shows: outlines_px (4, 2) by number; module: the share of their sides
    that one of their cells has."""

    outlines_px: Mapping[int, list[Array]]
    size_px: tuple[int, int]
    module: float


@dataclass(frozen=True, eq=False)
class ReadMarkers:
    """corners_px: (4, 2) of each marker, by number; refused: those that were read, but not where the board has them or
    at places that nothing tells apart, and why; agreeing: how many lie where the board has them."""

    corners_px: Mapping[int, Array]
    refused: Mapping[int, Reason]
    agreeing: int


def read_markers(picture: Bytes, dictionary: cv2.aruco.Dictionary) -> MarkerReadings:
    """Read all markers of a dictionary, of whatever board."""
    outlines, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
    readings: dict[int, list[Array]] = {}
    for outline, number in zip(outlines, _integers(numbers), strict=True):
        readings.setdefault(number, []).append(np.asarray(outline, float).reshape(4, 2))
    return MarkerReadings(readings, (picture.shape[1], picture.shape[0]), 1 / (dictionary.markerSize + 2))


def placed_markers(read: MarkerReadings, board: Markers) -> ReadMarkers:
    """The markers of a board, in the order in which they are read."""
    readings = {number: places for number, places in read.outlines_px.items() if number in board}
    view = _view(readings, board, read.size_px, read.module / 2)
    corners: dict[int, Array] = {}
    refused: dict[int, Reason] = {}
    agreeing = 0
    for number, places in readings.items():
        off = [_off(view, board[number], place) for place in places]
        best = int(np.argmin(np.nan_to_num(off, nan=np.inf)))
        agreeing += off[best] < 1.0
        if off[best] < 1.0 or (len(readings) == len(places) == 1):
            corners[number] = places[best]
        elif len(places) > 1:
            refused[number] = Reason(
                f"marker {number} was read at {len(places)} places, and nothing tells which is the board's: "
                "there may be another such board",
                Code.AMBIGUOUS,
            )
        elif view is None:
            refused[number] = Reason(
                f"marker {number} was read, but the board's markers do not agree on where the board lies: "
                "there may be another such board",
                Code.AMBIGUOUS,
            )
        else:
            told = f"marker {number} was read where the board's other markers do not have it"
            refused[number] = Reason(told, Code.OFF_PLACE)
    return ReadMarkers(corners, refused, agreeing)


def better_layout(
    read: MarkerReadings, given: ReadMarkers, others: Iterable[tuple[Key, Markers]]
) -> tuple[Key, ReadMarkers] | None:
    """The layout under which more of the markers that were read lie where their board has them than under the given
    one; None where none is better."""
    best: tuple[Key, ReadMarkers] | None = None
    most = given.agreeing
    for key, board in others if given.agreeing < len(read.outlines_px) else ():
        placed = placed_markers(read, board)
        if placed.agreeing > most:
            best, most = (key, placed), placed.agreeing
    return best


def other_first_numbers(read: MarkerReadings, first: int, count: int) -> list[int]:
    """The numbers that a board of so many markers may begin at to have all that were read, where it has not."""
    numbers = sorted(read.outlines_px)
    if not numbers or (first <= numbers[0] and numbers[-1] < first + count):
        return []
    return list(range(max(numbers[-1] - count + 1, 0), numbers[0] + 1))


def _integers(numbers: object) -> list[int]:
    """OpenCV's column of numbers, None where there are none."""
    return [] if numbers is None else [int(number) for number in np.ravel(np.asarray(numbers))]


def _view(
    readings: Mapping[int, list[Array]], board: Mapping[int, Array], size_px: tuple[int, int], half_module: float
) -> SheetView | None:
    """Where the board lies by the markers that were read once; None where not most of all that were read agree, or
    where they are not as large as they would be there: markers of two boards may lie as those of a squeezed one."""
    single = {number: places[0] for number, places in readings.items() if len(places) == 1}
    if len(single) < 2:
        return None
    points = np.concatenate([board[number] for number in single])
    view = robust_view(points, np.concatenate(list(single.values())), size_px)
    if view is None:
        return None
    misfits = [_misfit(view, board[number], place) for number, place in single.items()]
    agreeing = sum(
        min(_off(view, board[number], place) for place in places) < 1.0 for number, places in readings.items()
    )
    return view if 2 * agreeing > len(readings) and np.median(misfits) < half_module else None


def _misfit(view: SheetView, corners: Array, seen_px: Array) -> float:
    """How far a marker's corners lie from where the board has them, rms in its sides."""
    return float(np.sqrt(np.mean(np.sum((view.places_px(corners) - seen_px) ** 2, axis=1)))) / _side_px(seen_px)


def _off(view: SheetView | None, corners: Array, seen_px: Array) -> float:
    """How far a marker lies from where the board has it, in its sides: another one cannot be nearer than one. nan where
    that is not known."""
    if view is None:
        return np.nan
    return float(np.hypot(*(view.places_px(corners) - seen_px).mean(axis=0))) / _side_px(seen_px)


def _side_px(seen_px: Array) -> float:
    """The longest side of a marker (4, 2) as it is seen."""
    return float(np.hypot(*(np.roll(seen_px, 1, axis=0) - seen_px).T).max())
