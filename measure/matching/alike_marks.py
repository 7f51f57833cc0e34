"""What fitting a mark takes out of the noise about it: computed once for all marks that are drawn alike."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from measure.marks.rendering import extent_px
from measure.marks.shapes import MarkShape
from measure.match_options import Freedom, MatchOptions
from measure.matching.fit import PictureFit
from measure.matching.models import GREY, PictureModel, State
from measure.matching.window import Coding
from measure.noise.grain import taken_out

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PIXELS = 0.05  # of those of the drawing: so many more or fewer, and something is cut off or cut out
_SCALES, _BLURS = 50.0, 10.0  # steps in a change by e: within one of 2 % of size or 10 % of blur marks are alike
_MARGINS = 2.0  # steps in a pixel
_MOST = 256  # drawings that are remembered, of a kilobyte


def taken_out_of(fit: PictureFit, used: Mask) -> Array:
    """As `taken_out` gives it, for the pixels used (height, width) of a fit: where these are about those of the mark's
    drawing, those that any mark drawn alike has, whichever way it lies."""
    model, options = fit.model, fit.options
    if type(model) is PictureModel and isinstance(model.mark, MarkShape) and model.background_px is None:
        px_per_mm = float(np.sqrt(abs(np.linalg.det(model.state.pixel_from_mark[:, :2]))))
        alike = _alike(
            model.mark,
            _rounded(px_per_mm, _SCALES),
            _rounded(model.blur_px, _BLURS),
            round(options.margin_px * _MARGINS) / _MARGINS,
            options.freedom,
            options.estimate_blur,
        )
        if abs(float(used.sum()) / alike.pixels - 1) < _PIXELS:
            return alike.taken
    return taken_out(used, model.design)


class _Alike(NamedTuple):
    """Of a mark's drawing: how many pixels a fit uses, and what it takes out of the noise."""

    pixels: int
    taken: Array


@lru_cache(maxsize=_MOST)
def _alike(
    mark: MarkShape, px_per_mm: float, blur_px: float, margin_px: float, freedom: Freedom, estimate_blur: bool
) -> _Alike:
    place = px_per_mm * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    least, greatest = extent_px(mark, place)
    low = np.floor(least - margin_px)
    width, height = (np.ceil(greatest + margin_px) - low + 1).astype(int).tolist()
    place[:, 2] = -low
    options = MatchOptions(freedom=freedom, estimate_blur=estimate_blur, blur_px=blur_px, margin_px=margin_px)
    even = np.zeros((height, width))
    model = PictureModel(even, even.astype(np.int8), mark, place, options)
    model.state = State(place, model.state.variance_px2, np.eye(GREY)[0])
    fit = PictureFit(model, even == 0, False, Coding(None))
    fit.choose_area()
    model.linearise(fit.area)
    return _Alike(max(int(fit.area.sum()), 1), taken_out(fit.area, model.design))


def _rounded(size: float, steps: float) -> float:
    return float(np.exp(round(np.log(size) * steps) / steps))
