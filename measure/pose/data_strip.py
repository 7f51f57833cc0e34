"""On which side of the frame the film is written on: the camera's data strip, with its dials and text, lies there.

Film beside the frame is even but for edges along it (the film's own, or the neighbouring frame's), which change across
the side and not along it. Writing changes along it, sharply, on an even ground; a landscape changes everywhere. So each
side is divided into pieces, and those that hold such changes are counted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln

from measure.marks.poses import up_from_camera
from measure.marks.shapes import FiducialLayout, Side
from measure.noise.noise import robust_scale
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DIRECTIONS: Mapping[Side, tuple[int, int]] = {"left": (-1, 0), "right": (1, 0), "top": (0, 1), "bottom": (0, -1)}
# Shares of the frame's shorter side, 2.3 mm being 1 % of an aerial camera's:
_BEGINS, _ENDS = 0.01, 0.06  # how far beyond the frame the strip is looked for
_PIECE = 0.025  # length of a piece
_REACHED = 0.012  # how far beyond the strip's beginning the scan has to reach for a piece to count
_STEP = 0.0005  # between the places that are looked at: letters are some 20 steps tall
_STROKE = 4  # steps over which a letter's edge rises
_SHARP = 12.0  # times the changes of the ground, a standard deviation: of landscapes, one piece in thirty has them
_FAINT = 0.05  # of full scale: changes below are compression's
_WRITTEN = 0.01  # of its area: the share of changes that makes a piece a written one
_ON_STRIP = (1.0, 1.0)  # beta law of the share of written pieces on the strip's side: nobody knows it
_ELSEWHERE = (1.0, 9.0)  # on other sides: a tenth, for numbers, handwriting, film names and the next frame


@dataclass(frozen=True)
class Beside:
    """The pieces beside a side of the frame that the scan shows, and how many of them are written on."""

    written: int
    seen: int

    @property
    def log_odds(self) -> float:
        """Of lying on the strip's side, against any other."""
        counted = np.array([self.written, self.seen - self.written])
        on, off = (float(betaln(*(counted + law)) - betaln(*law)) for law in (_ON_STRIP, _ELSEWHERE))
        return on - off


def beside_frame(scan: Scan, layout: FiducialLayout, pixel_from_camera: Array, pose: str) -> dict[Side, Beside]:
    """What stands beside the four sides, as the scan has them, of a frame that lies in it by pixel_from_camera (2, 3),
    in that pose."""
    return {side: _counted(*_band(scan, layout, pixel_from_camera, pose, side)) for side in DIRECTIONS}


def side_in_scan(side: Side, pose: str) -> Side:
    """Where a side of the camera's drawing lies in a scan of that pose."""
    direction = up_from_camera(pose) @ DIRECTIONS[side]
    return next(name for name, other in DIRECTIONS.items() if np.allclose(direction, other))


def strip_likelihoods(beside: Mapping[Side, Beside], strip: Side, poses: Sequence[str], spoilt: float) -> Array:
    """(n,) log-likelihoods of the poses of a camera whose strip is given: 0 for the best, and no less than the
    probability (spoilt) that something else stands there."""
    log_odds = np.array([beside[side_in_scan(strip, pose)].log_odds for pose in poses])
    return np.asarray(np.log((1 - spoilt) * np.exp(log_odds - log_odds.max()) + spoilt))


def _band(
    scan: Scan, layout: FiducialLayout, pixel_from_camera: Array, pose: str, side: Side
) -> tuple[Array, Mask, float]:
    """Grey values (across, along) beside a side, which of them the scan shows, and the changes that are too faint."""
    out = up_from_camera(pose).T @ DIRECTIONS[side]
    along = np.array([-out[1], out[0]])
    frame, unit = np.asarray(layout.frame_mm), min(layout.frame_mm)
    half_out, half_along = (float(np.abs(axis) @ frame / 2) for axis in (out, along))
    beyond = half_out + unit * np.arange(_BEGINS, _ENDS, _STEP)
    camera = beyond[:, None, None] * out + np.arange(-half_along, half_along, unit * _STEP)[None, :, None] * along
    places = camera @ pixel_from_camera[:, :2].T + pixel_from_camera[:, 2]
    inside = np.all((places >= 0) & (places <= (scan.width_px - 1, scan.height_px - 1)), axis=-1)
    if not inside.any():
        return np.zeros(inside.shape), inside, 0.0
    step_px = unit * _STEP * float(np.sqrt(abs(np.linalg.det(pixel_from_camera[:, :2]))))
    factor = max(int(step_px), 1)
    reduced = (places - (factor - 1) / 2) / factor
    col0, row0 = np.floor(reduced[inside].min(axis=0)).astype(int).tolist()
    width, height = (np.ceil(reduced[inside].max(axis=0)).astype(int) - (col0, row0) + 1).tolist()
    grey = scan.reduced_window(factor, col0, row0, width, height)
    maps = (reduced - (col0, row0)).astype(np.float32)
    band = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(band, dtype=float), inside, _FAINT * scan.full_scale_dn


def _counted(band: Array, inside: Mask, faint_dn: float) -> Beside:
    smooth = np.asarray(cv2.GaussianBlur(band, (0, 0), _STROKE / 3), dtype=float)
    half = _STROKE // 2
    changes = np.zeros_like(smooth)
    changes[:, half:-half] = smooth[:, 2 * half :] - smooth[:, : -2 * half]
    # The scan's own edge is no writing.
    known = cv2.erode(inside.astype(np.uint8), np.ones((2 * _STROKE + 1,) * 2, np.uint8), borderValue=0) > 0
    pieces = [
        changes[:, part][known[:, part]]
        for part in np.array_split(np.arange(band.shape[1]), round(band.shape[1] * _STEP / _PIECE))
    ]
    shown = [piece for piece in pieces if piece.size * _STEP**2 >= _REACHED * _PIECE]
    written = [np.mean(np.abs(piece) > max(_SHARP * robust_scale(piece), faint_dn)) > _WRITTEN for piece in shown]
    return Beside(int(np.sum(written)), len(shown))
