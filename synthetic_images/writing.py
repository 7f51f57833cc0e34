"""Writing as areas: outlines of Matplotlib's fonts, contours of text drawn by OpenCV."""

from functools import lru_cache
from importlib.util import find_spec

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area
from synthetic_images.checks import one_of

Array = NDArray[np.float64]

# Names as in OpenCV; since version 5 it draws them with its own outline fonts.
HERSHEY = {
    "hershey-simplex": cv2.FONT_HERSHEY_SIMPLEX,
    "hershey-duplex": cv2.FONT_HERSHEY_DUPLEX,
    "hershey-italic": cv2.FONT_HERSHEY_SIMPLEX | cv2.FONT_ITALIC,
}
OUTLINED = ("DejaVu Sans", "DejaVu Sans Mono", "DejaVu Serif", "STIXGeneral", "cmr10")  # from Matplotlib, an extra
HANDWRITING = "handwriting"  # hershey-italic with random variation of each letter
FONTS = (*HERSHEY, *OUTLINED, HANDWRITING)
_CAPITAL_PX = 120  # px, height of capitals drawn by OpenCV before their contours are extracted
_STROKE_PX = 12
_BLANK = 0.5  # width of a blank in heights of a capital
_UNEVEN_RAD, _UNEVEN = 0.08, 0.07  # handwriting: sigma of a letter's rotation; of its size and position, in capitals


def check_font(what: str, font: str) -> None:
    """Raises ValueError for an unknown font, or one that is not installed."""
    one_of(what, font, FONTS)
    if font in OUTLINED and find_spec("matplotlib") is None:
        raise ValueError(
            f"{what}: {font!r} comes with Matplotlib, which is not installed. Install it: pip install "
            f"'reseau[fonts]', or take one of {', '.join((*HERSHEY, HANDWRITING))}"
        )


@lru_cache(maxsize=256)
def written_area(text: str, font: str) -> Area:
    """Area of a line of text, x right and y up, centred on the origin; capitals have height 1."""
    if font == HANDWRITING:
        outlines = _handwriting(text)
    elif font in HERSHEY:
        outlines = _letter_outlines(text, HERSHEY[font])
    else:
        outlines = _outlined(text, font)
    vertices = np.concatenate(outlines)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return tuple(outline - middle for outline in outlines)


def _handwriting(text: str) -> list[Array]:
    """Outlines of handwriting, letter by letter; reproducible for the same text."""
    rng = np.random.default_rng(list(text.encode()))
    outlines, end = list[Array](), 0.0
    for letter in text:
        if letter == " ":
            end += _BLANK
            continue
        turn, size = rng.normal(0.0, _UNEVEN_RAD), 1.0 + rng.normal(0.0, _UNEVEN)
        linear = size * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        own = [outline @ linear.T for outline in _letter_outlines(letter, HERSHEY["hershey-italic"])]
        vertices = np.concatenate(own)
        start = np.array([end - vertices[:, 0].min() + 0.1, rng.normal(0.0, _UNEVEN)])
        outlines += [outline + start for outline in own]
        end += float(np.ptp(vertices[:, 0])) + 0.1
    return outlines


def _letter_outlines(text: str, font: int) -> list[Array]:
    """Contours of text drawn by OpenCV, from the start of its baseline; inner contours have the opposite
    orientation."""
    scale = float(cv2.getFontScaleFromHeight(font, _CAPITAL_PX, _STROKE_PX))
    (width, height), below = cv2.getTextSize(text, font, scale, _STROKE_PX)
    spare = _CAPITAL_PX
    sheet = np.zeros((height + below + 2 * spare, width + 2 * spare), np.uint8)
    cv2.putText(sheet, text, (spare, height + spare), font, scale, 255, _STROKE_PX, cv2.LINE_8)
    contours, _ = cv2.findContours(sheet, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_TC89_L1)
    outlines = [np.asarray(contour, dtype=float).reshape(-1, 2) for contour in contours if len(contour) > 2]
    return [(outline - (spare, height + spare)) * (1.0, -1.0) / _CAPITAL_PX for outline in outlines]


def _outlined(text: str, font: str) -> list[Array]:
    # Imported here, since it takes half a second that scenes without writing do not need.
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    properties = FontProperties(family=font)
    capital = float(np.ptp(np.asarray(TextPath((0.0, 0.0), "H", prop=properties).vertices)[:, 1]))
    polygons = map(np.asarray, TextPath((0.0, 0.0), text, prop=properties).to_polygons())
    return [polygon[:-1] / capital for polygon in polygons if len(polygon) > 3]
