"""The responses to one look of a mark, and what a constellation asks of them: their highest places, and how strongly
they answer about any place."""

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.detection.candidates import Responses
from measure.detection.correlation import Map
from measure.detection.scan_maps import Held

Array = NDArray[np.float64]

_LEAST_RESPONSE = 0.2  # of a candidate
_CANDIDATES = 100  # of each look
_NARROWED = 0.7  # of the tolerance, once a placement is refined
LEAST_TOLERANCE_PX = 1.5  # of the reduced scan: where a response is highest is known no better
_CHANCE_PERCENT = 95  # of places that stay below what chance is said to answer
_SAMPLED = slice(None, None, 3)  # rows and columns from which that is told: neighbours answer alike


def narrowed(tolerance_px: float) -> float:
    """The tolerance of a refined placement."""
    return max(_NARROWED * tolerance_px, LEAST_TOLERANCE_PX)


def layers_of(responses: Responses, held: "Held[Reach]") -> "dict[tuple[int, int], Layer]":
    """The layers of all looks, by kind and sign. held: what there is of their reaches, and of others of the scan."""
    return {key: Layer(responses, key, held) for key in responses.maps}


class Layer:
    """The responses to one look, and what is asked of them in every pose and by every hypothesis that shares them."""

    def __init__(self, responses: Responses, key: tuple[int, int], held: "Held[Reach]") -> None:
        self._responses, self._key, self._held = responses, key, held
        self._own = object()  # stands for this layer in what is held, which would else hold the layer that holds it
        self.origin = responses.origin(key[0])

    @property
    def map(self) -> Map:
        return self._responses.maps[self._key]

    @cached_property
    def candidates(self) -> Array:
        """(n, 2) px of the reduced scan."""
        return peaks(self.map, _CANDIDATES, _LEAST_RESPONSE)[0] + self.origin

    def within(self, radius_px: float) -> "Reach":
        """What is asked of the responses within a radius, to whole pixels."""
        key = self._own, round(radius_px)
        reach = self._held.find(key)
        if reach is None:
            reach = Reach(self.map, self.origin, radius_px)
            self._held.keep(key, reach, reach.map.nbytes)
        return reach

    def highest(self, places: Array, radius_px: float) -> tuple[Array, Array]:
        """The highest responses about places (n, 2) of the reduced scan, and (n,) how high; 0 outside of the map."""
        tops, heights = highest(self.map, places - self.origin, radius_px)
        return tops + self.origin, heights


class Reach:
    """The highest response within a radius of every place, area_px large, and what chance places answer: nineteen in
    twenty of them stay below it."""

    def __init__(self, map_: Map, origin: NDArray[np.int_], radius_px: float) -> None:
        about = _about(radius_px)
        self.map, self.origin, self.area_px = np.asarray(cv2.dilate(map_, about)), origin, int(about.sum())
        self.chance = max(float(np.percentile(self.map[_SAMPLED, _SAMPLED], _CHANCE_PERCENT)), 0.0)

    def share(self, place: Array) -> float:
        """Of all places, those that answer as strongly as the one (2,) of the reduced scan."""
        col, row = np.clip(np.rint(place).astype(int) - self.origin, 0, np.array(self.map.shape[::-1]) - 1)
        return float(np.mean(self.map >= self.map[row, col]))

    def height(self, place: Array) -> float:
        """The highest response within the radius of a place (2,) of the reduced scan."""
        col, row = np.clip(np.rint(place).astype(int) - self.origin, 0, np.array(self.map.shape[::-1]) - 1)
        return float(self.map[row, col])

    def strength(self, places: NDArray[np.int_]) -> tuple[Array, NDArray[np.bool_]]:
        """How much the places (n, 2) of the reduced scan answer beyond chance, and which of them lie in the map; those
        that do not have no answer."""
        rows, cols = self.map.shape
        col, row = (places - self.origin).T
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        response = np.where(inside, self.map[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)], 0.0).astype(float)
        return np.maximum(np.maximum(response, 0.0) ** 2 - self.chance**2, 0.0), inside


def _about(radius_px: float) -> NDArray[np.uint8]:
    """1 within the radius."""
    size = 2 * round(radius_px) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def peaks(response: Map, count: int, least: float, apart_px: int = 3) -> tuple[Array, Array]:
    """(n, 2) places (col, row) and (n,) heights of the highest local maxima above least, in order of height."""
    highest = cv2.dilate(response, np.ones((2 * apart_px + 1, 2 * apart_px + 1), np.uint8))
    rows, cols = np.nonzero((response == highest) & (response > least))
    order = np.argsort(-response[rows, cols], kind="stable")[:count]
    places = np.column_stack([cols, rows])[order].astype(float)
    return places, response[rows, cols][order].astype(float)


def highest(map_: Map, places: Array, radius_px: float) -> tuple[Array, Array]:
    """The highest responses within a square about places (n, 2), refined by parabolas, and (n,) how high; 0 outside of
    the map."""
    size = np.array(map_.shape[::-1])
    low = np.clip(np.floor(places - radius_px).astype(int), 0, None)
    high = np.clip(np.ceil(places + radius_px).astype(int) + 1, None, size)
    within = (low < high).all(axis=1)
    tops, heights = places.astype(float), np.zeros(len(places))
    if not within.any():
        return tops, heights
    low, high = low[within], high[within]
    col, row = (low[:, axis, None] + np.arange((high - low)[:, axis].max()) for axis in (0, 1))
    part = map_[np.minimum(row, size[1] - 1)[:, :, None], np.minimum(col, size[0] - 1)[:, None, :]]
    part = np.where((row < high[:, 1, None])[:, :, None] & (col < high[:, 0, None])[:, None, :], part, -np.inf)
    best_row, best_col = np.divmod(part.reshape(len(part), -1).argmax(axis=1), part.shape[2])
    top = low + np.column_stack([best_col, best_row])
    heights[within] = map_[top[:, 1], top[:, 0]]
    inner = ((top > 0) & (top < size - 1)).all(axis=1)
    col, row = top[inner].T
    off = np.zeros(top.shape)
    off[inner, 0] = _vertex(map_[row, col - 1], map_[row, col], map_[row, col + 1])
    off[inner, 1] = _vertex(map_[row - 1, col], map_[row, col], map_[row + 1, col])
    tops[within] = top + off
    return tops, heights


def _vertex(before: Map, middle: Map, after: Map) -> Array:
    """Where parabolas through three values each, the middle one the highest, have their tops: -0.5 to 0.5."""
    bend = before - 2 * middle + after
    at = np.divide(before - after, 2 * bend, out=np.zeros(len(bend)), where=bend < 0)
    return np.asarray(np.clip(at, -0.5, 0.5))
