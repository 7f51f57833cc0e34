"""Scans made of a scan: a window of it, and the whole of it made small."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.scans.cache import LostPart, OpenedPicture, Place, WholePicture
from measure.scans.metadata import Pitch, Samples
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan
from measure.scans.scan_part import Window

_BAND_PX = 1 << 18  # of the window that are read at a time
_FULL_SCALE_DN = 65535.0
_GREY_BAND_PX = 1 << 20  # of the scan that is held in grey at a time, about


def crop_scan(scan: Scan, window: Window) -> Scan:
    """A window of a scan as a scan of its own, whose pixels count from the window's first one.

    Parameters
    ----------
    scan : stays open as long as the window is read.

    Raises
    ------
    ValueError
        For a window that does not lie in the scan.
    """
    col, row, width, height = window
    if min(width, height) < 1 or min(col, row) < 0 or col + width > scan.width_px or row + height > scan.height_px:
        raise ValueError(
            f"the window {col} {row} {width} {height} does not lie in {scan.width_px} x {scan.height_px} px"
        )
    pitch, segments = Pitch(scan.pitch_um, scan.pitch_note), WindowSegments(scan, window)
    opened = OpenedPicture(segments, pitch, scan.notes, scan.problems, orientation=scan.orientation)
    view = Scan(scan.path, segments, pitch, opened).replace_name(scan.name)
    return view.replace_tone(scan.tone)


class WindowSegments:
    """A window of a scan in bands of rows, as `Segments` has it."""

    def __init__(self, scan: Scan, window: Window) -> None:
        self._scan = scan
        self._col0, self._row0, self.width_px, self.height_px = window
        self.segment_width_px = self.width_px
        self.segment_height_px = min(max(_BAND_PX // self.width_px, 1), self.height_px)
        self.channels = scan.channels
        self.full_scale_dn = scan.full_scale_dn
        self.sample_bytes = scan.samples_dtype().itemsize
        self.rounding_step_dn = scan.rounding_step_dn

    @property
    def lost(self) -> Sequence[LostPart]:
        return tuple(
            LostPart(part.col0 - self._col0, part.row0 - self._row0, part.width, part.height, part.why)
            for part in self._scan.lost
        )

    def fetch(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        return {}

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """A band of rows."""
        first = row * self.segment_height_px
        height = min(self.segment_height_px, self.height_px - first)
        return self._scan.samples(self._col0, self._row0 + first, self.width_px, height)

    def close(self) -> None:
        """The scan is another's to close."""


def thumbnail(scan: Scan, largest_px: int) -> Scan:
    """The scan's grey values at 16 bits, area-averaged until no side is longer than largest_px. Its pitch is the
    file's, times as much as a pixel has become longer."""
    shrunk = max(max(scan.width_px, scan.height_px) / largest_px, 1.0)
    grey, unit = _reduced(scan, int(shrunk)), _FULL_SCALE_DN / scan.full_scale_dn
    size = round(scan.width_px / shrunk), round(scan.height_px / shrunk)
    same = size == grey.shape[::-1]
    samples = grey if same else np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint16)
    pitch = Pitch(None if scan.pitch_um is None else (shrunk * scan.pitch_um[0], shrunk * scan.pitch_um[1]))
    picture = WholePicture(samples[:, :, None], scan.rounding_step_dn * unit / shrunk)
    return Scan(scan.path, picture, pitch)


def _reduced(scan: Scan, factor: int) -> NDArray[np.uint16]:
    """Grey values at 16 bits, averaged by a whole factor: band by band, so that colours are never held of all of it."""
    unit = np.float32(_FULL_SCALE_DN / scan.full_scale_dn)
    grey = np.empty((scan.height_px // factor, scan.width_px // factor), np.uint16)
    rows = max(_GREY_BAND_PX // scan.width_px // factor, 1)

    def fill(row: int) -> None:
        band = grey[row : row + rows]
        band[:] = np.rint(unit * scan.reduced_window(factor, 0, row, grey.shape[1], len(band)))

    map_in_threads(fill, range(0, len(grey), rows))
    return grey
