"""A scan in grey and small, held in memory: as much of it as tells which camera it is of."""

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.scans.parallel import side_by_side
from measure.scans.picture_scan import WholePicture
from measure.scans.resolution import Pitch
from measure.scans.scan import Scan

_FULL_SCALE_DN = 65535.0
_BAND_PX = 1 << 20  # of the scan that is held in grey at a time, about


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
    rows = max(_BAND_PX // scan.width_px // factor, 1)

    def fill(row: int) -> None:
        band = grey[row : row + rows]
        band[:] = np.rint(unit * scan.reduced_window(factor, 0, row, grey.shape[1], len(band)))

    side_by_side(fill, range(0, len(grey), rows))
    return grey
