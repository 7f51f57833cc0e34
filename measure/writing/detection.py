"""Where in a picture there is writing that runs about from left to right, whichever way it lies."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.writing.networks import Networks

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

_MULTIPLE_PX = 32  # that the network asks of a picture's sides
_WRITTEN = 0.3  # probability of a pixel to be writing
_SURE = 0.5  # the least mean probability of a place
_LEAST_PX = 4.0  # of what the network draws of a line's height, which is less than half of it
_UNSHRUNK = 1.6  # times area over circumference: by so much the network draws less than the line
_TILT_DEG = 30.0  # what runs more steeply belongs to another side of the frame
_LONG = 1.2  # times its height: what is shorter is no word


@dataclass(frozen=True)
class Place:
    """A rectangle about a line: centre (column, row), length and height in px; tilt_deg: from the rows, clockwise."""

    center_px: tuple[float, float]
    length_px: float
    height_px: float
    tilt_deg: float

    def outline_px(self) -> Array:
        """(4, 2) corners, clockwise from where it begins."""
        angle = np.deg2rad(self.tilt_deg)
        along, down = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2.0
        corners = half[:, :1] * self.length_px * along + half[:, 1:] * self.height_px * down
        return np.asarray(corners + self.center_px)

    def scaled(self, factor: float) -> "Place":
        """In a picture that is so many times as large."""
        col, row = ((place + 0.5) * factor - 0.5 for place in self.center_px)
        return Place((col, row), factor * self.length_px, factor * self.height_px, self.tilt_deg)

    def covers(self, other: "Place") -> bool:
        """Whether the middle of the other lies in it."""
        outline = self.outline_px().astype(np.float32)
        return cv2.pointPolygonTest(outline, other.center_px, False) >= 0


def find_writing(picture: Picture, networks: Networks) -> list[Place]:
    """The lines in a picture (rows, columns), in no order that means anything."""
    probability = _probability(picture, networks)
    written = (probability > _WRITTEN).astype(np.uint8)
    contours, _ = cv2.findContours(written, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    places = (_place(np.asarray(contour), probability) for contour in contours)
    return [place for place in places if place is not None]


def _probability(picture: Picture, networks: Networks) -> NDArray[np.float32]:
    height, width = picture.shape
    below, right = -height % _MULTIPLE_PX, -width % _MULTIPLE_PX
    padded = cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE)
    grey = np.asarray(padded, np.float32) / 127.5 - 1.0
    networks.detection.setInput(np.repeat(grey[None, None], 3, axis=1))
    return np.asarray(networks.detection.forward()[0, 0, :height, :width], np.float32)


def _place(contour: NDArray[np.int32], probability: NDArray[np.float32]) -> Place | None:
    """The network draws a line narrower than it is, so that neighbours stay apart."""
    center, (length, height), angle = cv2.minAreaRect(contour)
    if length < height:
        length, height, angle = height, length, angle + 90.0
    tilt = (angle + 90.0) % 180.0 - 90.0
    if height < _LEAST_PX or abs(tilt) > _TILT_DEG or _mean_within(contour, probability) < _SURE:
        return None
    grown = _UNSHRUNK * length * height / (length + height)
    place = Place((float(center[0]), float(center[1])), length + grown, height + grown, tilt)
    return place if place.length_px >= _LONG * place.height_px else None


def _mean_within(contour: NDArray[np.int32], probability: NDArray[np.float32]) -> float:
    col, row, width, height = cv2.boundingRect(contour)
    inside = np.zeros((height, width), np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, -1, offset=(-col, -row))
    return float(probability[row : row + height, col : col + width][inside > 0].mean())
