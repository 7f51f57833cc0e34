"""Reading of the text on a scan: beside its exposed frame, and along the inside of the frame's edges.

Each of the four sides is taken as a strip from left to right. Lines are detected in it at two scales, cut out of a
finer image, and read in their four possible orientations, which decides the orientation. Light text on dark film and
dark text on light film are read alike.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.annotations.detect_text import HEIGHT_PX, WAYS, Networks, Picture, Place, find_writing, read_ways
from measure.annotations.fields import Line, read_from_one_face
from measure.marks.shapes import Side
from measure.scans.scan import Scan

Array = NDArray[np.float64]

# In longer sides of the frame; 1 % is 2.3 mm for an aerial camera.
_BEYOND = 0.13  # searched outside of the frame: its data strip and half of the gap
_WITHIN = 0.045  # searched inside of the frame, where plates and counters reach into it
_ABOUT = 0.02  # search distance around the known place of a line: titles are set by hand
_FINE_PX = 2400  # least longer side of the frame in the image that lines are cut out of
_FOUND_PX = (1800, 900)  # the same for detection: plates of 1.5 mm, then handwriting
_LEAST_PX = 12  # least side of a strip
_LONGEST_PX = 1600  # largest length of a line at reading height
_BLACK, _WHITE = 0.5, 99.5  # percentiles of a strip's grey values mapped to black and white
_LEAST_LEGIBLE = 1.5  # characters; less is a speck that resembles a letter
_READ_WELL = 0.6  # mean confidence above which a line is not read again at a coarser scale


def read_writing(
    scan: Scan,
    networks: Networks,
    frame_px: Array | None = None,
    about: tuple[Side, Array] | None = None,
    enough: Callable[[Sequence[Line]], bool] = lambda _: False,
) -> tuple[Line, ...]:
    """Read the lines of text on a scan, from the side of the film with more legible text, the longest first.

    Parameters
    ----------
    frame_px : (n, 2) column and row of the corners of the exposed frame. None: the edges of the scan are read instead.
    about : side and outline (n, 2), px, of a known line; only its surroundings are read.
    enough : returns whether the lines read so far suffice; the remaining sides are then skipped.
    """
    places = [(side, None) for side in get_args(Side)] if about is None else [about]
    lines = list[Line]()
    for side, outline_px in places:
        strip = _strip(scan, side, frame_px, outline_px)
        lines += [] if strip is None else strip.lines(networks)
        if enough(read_from_one_face(lines)):
            break
    return read_from_one_face(lines)


@dataclass(frozen=True, eq=False)
class _Strip:
    """A side of the scan as an image from left to right. scan_from_strip (2, 3): pixels; poses: orientation in the scan
    by orientation in the strip; found: reduction factors of the images for detection."""

    picture: Picture
    side: Side
    scan_from_strip: Array
    poses: Mapping[str, str]
    found: tuple[float, ...]

    def lines(self, networks: Networks) -> list[Line]:
        lines, known = list[Line](), list[Place]()
        for reduction in self.found:
            size = [max(round(side / reduction), 1) for side in self.picture.shape[::-1]]
            small = cv2.resize(self.picture, size, interpolation=cv2.INTER_AREA) if reduction > 1 else self.picture
            for place in (each.scaled(reduction) for each in find_writing(np.asarray(small, np.uint8), networks)):
                if any(other.covers(place) or place.covers(other) for other in known):
                    continue
                line = self._line(place, networks)
                if line.legible >= _LEAST_LEGIBLE:
                    lines.append(line)
                    known += [place] if line.confidence >= _READ_WELL else []
        return lines

    def _line(self, place: Place, networks: Networks) -> Line:
        ways = {self.poses[way]: reading for way, reading in read_ways(self._cut(place), networks).items()}
        outline = place.outline_px() @ self.scan_from_strip[:, :2].T + self.scan_from_strip[:, 2]
        return Line(
            ways=ways,
            pose=max(ways, key=lambda pose: ways[pose].legible),
            outline_px=tuple((float(col), float(row)) for col, row in outline),
            side=self.side,
        )

    def _cut(self, place: Place) -> Picture:
        """Rectified image of a line (HEIGHT_PX, width)."""
        scale = place.height_px / HEIGHT_PX
        width = int(np.clip(round(place.length_px / scale), HEIGHT_PX // 2, _LONGEST_PX))
        angle = np.deg2rad(place.tilt_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        linear = turn * (place.length_px / width, scale)
        start = place.center_px - linear @ np.array([(width - 1) / 2, (HEIGHT_PX - 1) / 2])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        matrix = np.column_stack([linear, start])
        cut = cv2.warpAffine(self.picture, matrix, (width, HEIGHT_PX), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cut, np.uint8)


def _strip(scan: Scan, side: Side, frame_px: Array | None, outline_px: Array | None) -> _Strip | None:
    """Strip at a side of the frame, or around a known line; None if it is empty."""
    low, high, longer_px = _side_range(scan, side, frame_px)
    if outline_px is not None:
        low = np.maximum(low, outline_px.min(axis=0) - _ABOUT * longer_px)
        high = np.minimum(high, outline_px.max(axis=0) + _ABOUT * longer_px)
    factor = max(int(longer_px / _FINE_PX), 1)
    first = np.floor(low / factor).astype(int)
    last = np.minimum(np.ceil(high / factor).astype(int), (scan.width_px // factor, scan.height_px // factor))
    width, height = (last - first).tolist()
    if min(width, height) < _LEAST_PX:
        return None
    grey = _to_8_bits(scan.reduced_window(factor, int(first[0]), int(first[1]), width, height))
    turn = side in ("left", "right")  # rotated clockwise by a quarter turn: its columns run upward in the scan
    linear = factor * (np.array([[0.0, 1.0], [-1.0, 0.0]]) if turn else np.eye(2))
    start = factor * (first + ((0, height - 1) if turn else (0, 0))) + (factor - 1) / 2
    return _Strip(
        picture=np.ascontiguousarray(np.rot90(grey, -1) if turn else grey),
        side=side,
        scan_from_strip=np.column_stack([linear, start]),
        poses=dict(zip(WAYS, ("90", "270", "90m", "270m") if turn else WAYS, strict=True)),
        found=tuple(max(longer_px / factor / pixels, 1.0) for pixels in _FOUND_PX),
    )


def _side_range(scan: Scan, side: Side, frame_px: Array | None) -> tuple[Array, Array, float]:
    """Start and end (column, row), px, of the area read at a side, and the frame's longer side."""
    low, high = np.zeros(2), np.array([scan.width_px, scan.height_px], dtype=float)
    longer_px = float(high.max())
    inner_low, inner_high = low + _BEYOND * longer_px, high - _BEYOND * longer_px
    if frame_px is not None:
        longer_px = float(np.ptp(frame_px, axis=0).max())
        corners = np.sort(frame_px, axis=0)  # a frame may be turned a little
        half = len(corners) // 2
        low = np.maximum(low, corners[0] - _BEYOND * longer_px)
        high = np.minimum(high, corners[-1] + _BEYOND * longer_px)
        inner_low, inner_high = corners[half - 1] + _WITHIN * longer_px, corners[half] - _WITHIN * longer_px
    axis = 0 if side in ("left", "right") else 1
    if side in ("left", "top"):
        high[axis] = inner_low[axis]
    else:
        low[axis] = inner_high[axis]
    return low, high, longer_px


def _to_8_bits(grey: NDArray[np.float32]) -> Picture:
    black, white = np.percentile(grey[::2, ::2], (_BLACK, _WHITE))
    return np.ascontiguousarray((255 * (grey - black) / max(white - black, 1e-9)).clip(0, 255), np.uint8)
