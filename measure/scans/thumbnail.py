"""A scan in grey and small, held in memory: as much of it as tells which camera it is of."""

import cv2
import numpy as np

from measure.scans.picture_scan import WholePicture
from measure.scans.resolution import Pitch
from measure.scans.scan import Scan

_FULL_SCALE_DN = 65535.0


def thumbnail(scan: Scan, largest_px: int) -> Scan:
    """The scan's grey values at 16 bits, area-averaged until no side is longer than largest_px. Its pitch is the
    file's, times as much as a pixel has become longer."""
    shrunk = max(max(scan.width_px, scan.height_px) / largest_px, 1.0)
    grey, unit = scan.reduced(int(shrunk)), _FULL_SCALE_DN / scan.full_scale_dn
    size = round(scan.width_px / shrunk), round(scan.height_px / shrunk)
    grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)) if size != grey.shape[::-1] else grey
    samples = np.rint(grey * np.float32(unit)).astype(np.uint16)[:, :, None]
    pitch = Pitch(None if scan.pitch_um is None else (shrunk * scan.pitch_um[0], shrunk * scan.pitch_um[1]))
    return Scan(scan.path, WholePicture(samples, scan.rounding_step_dn * unit / shrunk), pitch)
