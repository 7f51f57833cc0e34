"""Writing as areas: letters of Matplotlib's fonts by their outlines, those of OpenCV's fonts by what it draws."""

from functools import lru_cache
from importlib.util import find_spec

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area
from synthetic_images.checks import one_of

Array = NDArray[np.float64]

# As OpenCV names them, which draws them with outlines of its own since version 5.
HERSHEY = {
    "hershey-simplex": cv2.FONT_HERSHEY_SIMPLEX,
    "hershey-duplex": cv2.FONT_HERSHEY_DUPLEX,
    "hershey-italic": cv2.FONT_HERSHEY_SIMPLEX | cv2.FONT_ITALIC,
}
OUTLINED = ("DejaVu Sans", "DejaVu Sans Mono", "DejaVu Serif", "STIXGeneral", "cmr10")  # Matplotlib's own, an extra
HANDWRITING = "handwriting"  # hershey-italic, no letter like the next
FONTS = (*HERSHEY, *OUTLINED, HANDWRITING)
_CAPITAL_PX = 120  # of a letter that OpenCV draws, before its outlines are taken
_STROKE_PX = 12
_BLANK = 0.5  # of a capital's height
_UNEVEN_RAD, _UNEVEN = 0.08, 0.07  # of handwriting: a letter's turn, and its size and place in capitals' heights


def check_font(what: str, font: str) -> None:
    """Raises ValueError for a font that there is not, or not in this installation."""
    one_of(what, font, FONTS)
    if font in OUTLINED and find_spec("matplotlib") is None:
        raise ValueError(
            f"{what}: {font!r} comes with Matplotlib, which is not installed. Install it: pip install "
            f"'reseau[fonts]', or take one of {', '.join((*HERSHEY, HANDWRITING))}"
        )


@lru_cache(maxsize=256)
def written_area(text: str, font: str) -> Area:
    """A line of text, x right and y up, about its middle; its capitals are 1 high."""
    if font == HANDWRITING:
        outlines = _by_hand(text)
    elif font in HERSHEY:
        outlines = _drawn(text, HERSHEY[font])
    else:
        outlines = _outlined(text, font)
    vertices = np.concatenate(outlines)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return tuple(outline - middle for outline in outlines)


def _by_hand(text: str) -> list[Array]:
    """Letter by letter; the same text is written the same way."""
    rng = np.random.default_rng(list(text.encode()))
    outlines, end = list[Array](), 0.0
    for letter in text:
        if letter == " ":
            end += _BLANK
            continue
        turn, size = rng.normal(0.0, _UNEVEN_RAD), 1.0 + rng.normal(0.0, _UNEVEN)
        linear = size * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        own = [outline @ linear.T for outline in _drawn(letter, HERSHEY["hershey-italic"])]
        vertices = np.concatenate(own)
        start = np.array([end - vertices[:, 0].min() + 0.1, rng.normal(0.0, _UNEVEN)])
        outlines += [outline + start for outline in own]
        end += float(np.ptp(vertices[:, 0])) + 0.1
    return outlines


def _drawn(text: str, font: int) -> list[Array]:
    """What OpenCV draws, from the beginning of its base line; an outline within another one runs the other way."""
    scale = float(cv2.getFontScaleFromHeight(font, _CAPITAL_PX, _STROKE_PX))
    (width, height), below = cv2.getTextSize(text, font, scale, _STROKE_PX)
    spare = _CAPITAL_PX
    sheet = np.zeros((height + below + 2 * spare, width + 2 * spare), np.uint8)
    cv2.putText(sheet, text, (spare, height + spare), font, scale, 255, _STROKE_PX, cv2.LINE_8)
    contours, _ = cv2.findContours(sheet, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
    outlines = [np.asarray(contour, dtype=float).reshape(-1, 2) for contour in contours if len(contour) > 2]
    return [(outline - (spare, height + spare)) * (1.0, -1.0) / _CAPITAL_PX for outline in outlines]


def _outlined(text: str, font: str) -> list[Array]:
    # Half a second of imports that scenes without writing do not need.
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    properties = FontProperties(family=font)
    capital = float(np.ptp(np.asarray(TextPath((0.0, 0.0), "H", prop=properties).vertices)[:, 1]))
    polygons = map(np.asarray, TextPath((0.0, 0.0), text, prop=properties).to_polygons())
    return [polygon[:-1] / capital for polygon in polygons if len(polygon) > 3]
