"""Other ways to measure a mark: what `reseau` is compared with.

Every method takes grey values (height, width) with a light mark, a start (col, row) near it, and a template with the
place of the mark in it; it returns the centre, or None.
"""

import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.measure import find_contours

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Template:
    """A picture of the mark, center_px (2,) in it."""

    image: Array
    center_px: Array


_RIM_PX = 4  # of the ground about a mark, in a template of hipp; its speed depends on it, its errors do not

Method = Callable[[Array, Array, Template], Array | None]


def corner_sub_pix(grey: Array, start: Array, template: Template) -> Array | None:
    """`cv2.cornerSubPix` with a window of 11 x 11."""
    place = np.asarray(start, np.float32).reshape(1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    return np.asarray(cv2.cornerSubPix(_bytes(grey), place, (5, 5), (-1, -1), criteria), float).ravel()


def correlation(grey: Array, start: Array, template: Template) -> Array | None:
    """Normalised correlation, and a parabola through its highest value and the neighbours, along columns and rows."""
    response = cv2.matchTemplate(grey.astype(np.float32), template.image.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    row, col = np.unravel_index(int(response.argmax()), response.shape)
    if not (0 < row < response.shape[0] - 1 and 0 < col < response.shape[1] - 1):
        return None
    across, down = response[row, col - 1 : col + 2], response[row - 1 : row + 2, col]
    top = [(three[0] - three[2]) / (2 * (three[0] - 2 * three[1] + three[2])) for three in (across, down)]
    return np.asarray(np.add((col, row), top) + template.center_px, float)


def ecc(grey: Array, start: Array, template: Template) -> Array | None:
    """`cv2.findTransformECC` with rotation and shift."""
    warp = np.eye(2, 3, dtype=np.float32)
    warp[:, 2] = start - template.center_px
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    images = template.image.astype(np.float32), grey.astype(np.float32)
    try:
        _, found = cv2.findTransformECC(*images, warp, cv2.MOTION_EUCLIDEAN, criteria)
    except cv2.error:
        return None
    return np.asarray(found[:, :2] @ template.center_px + found[:, 2], float)


def centroid(grey: Array, start: Array, template: Template) -> Array | None:
    """The centre of gravity of what Otsu's threshold leaves of the mark's window."""
    part, origin = _about(grey, start, template)
    above = cv2.threshold(_bytes(part), 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1]
    row, col = np.nonzero(above)
    return np.array([col.mean(), row.mean()]) + origin


def contour_ellipse(grey: Array, start: Array, template: Template) -> Array | None:
    """A direct ellipse on the sub-pixel contour at half the contrast."""
    part, origin = _about(grey, start, template)
    smooth = cv2.GaussianBlur(part, (0, 0), 1.0)
    contours = find_contours(smooth, (np.percentile(smooth, 2) + np.percentile(smooth, 98)) / 2)
    if not contours or len(longest := max(contours, key=len)) < 6:
        return None
    (col, row), _, _ = cv2.fitEllipseDirect(longest[:, ::-1].astype(np.float32))
    return np.array([col, row]) + origin


METHODS: dict[str, Method] = {
    "cornerSubPix": corner_sub_pix,
    "NCC": correlation,
    "ECC": ecc,
    "centroid": centroid,
    "ellipse": contour_ellipse,
}

_HIPP = """
import sys
import numpy as np
from hipp.aerial.core import detect_fiducial
from hipp.image import resize_img
data = np.load(sys.argv[1])
rim, factor, places = int(sys.argv[3]), 8, []
for cut, center, pictures in zip(data["cuts"], data["centers"], data["pictures"]):
    fine, half = resize_img(cut, factor=factor), factor * (cut.shape[0] // 2 - rim)
    col, row = np.rint((center + 0.5) * factor - 0.5).astype(int)
    fine = fine[row - half : row + half, col - half : col + half]
    places.append([detect_fiducial(picture, cut, fine, factor)[0] for picture in pictures])
np.save(sys.argv[2], np.array(places, dtype=float) - 0.5)
"""


def hipp(python: str, templates: Sequence[Template], pictures: Array, reach_px: int) -> Array:
    """(cameras, n, 2) places by hipp in pictures (cameras, n, height, width), run in its own environment.

    templates: one scan of each camera, with the place of its mark. As in `create_fiducial_templates`, the template is
    cut about the pixel nearest to that place, and the fine one about the nearest pixel of the cut enlarged eight times;
    here reach_px, what the mark takes of the picture, and _RIM_PX about. Its places count from the pixel's corner; half
    a pixel is taken off.
    """
    scans = np.stack([template.image for template in templates])
    to_bytes = 255 / max(float(scans.max()), float(pictures.max()))
    half = reach_px + 2 * _RIM_PX
    first = [np.rint(template.center_px).astype(int) - half for template in templates]
    cuts = [scan[row : row + 2 * half, col : col + 2 * half] for scan, (col, row) in zip(scans, first, strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "marks.npz", Path(folder) / "places.npy"
        np.savez(
            given,
            cuts=np.clip(np.rint(np.stack(cuts) * to_bytes), 0, 255).astype(np.uint8),
            centers=np.stack([template.center_px for template in templates]) - first,
            pictures=np.clip(np.rint(pictures * to_bytes), 0, 255).astype(np.uint8),
        )
        command = [python, "-c", _HIPP, str(given), str(found), str(_RIM_PX)]
        subprocess.run(command, check=True, capture_output=True)
        return np.asarray(np.load(found), float)


def _about(grey: Array, start: Array, template: Template) -> tuple[Array, Array]:
    """The part of the picture as large as the template, and its first pixel's place."""
    first = np.rint(start - template.center_px).astype(int)
    height, width = template.image.shape
    return grey[first[1] : first[1] + height, first[0] : first[0] + width], first


def _bytes(grey: Array) -> NDArray[np.uint8]:
    low, high = float(grey.min()), float(grey.max())
    return np.rint((grey - low) / max(high - low, 1e-9) * 255).astype(np.uint8)
