"""What the fit of a mark takes out of the noise, told from its drawing, beside what its own derivatives say."""

import numpy as np
import pytest
from brute_marks import brute_picture
from drawn_frames import numbered

from measure.match_options import MatchOptions
from measure.matching.alike_marks import taken_out_of
from measure.matching.fit import PictureFit
from measure.matching.models import PictureModel
from measure.matching.window import Coding
from measure.noise.grain import taken_out

SIZE, BLUR_PX = 61, 0.77


@pytest.mark.parametrize(("turn_deg", "mirrored"), [(0.4, False), (90.7, True), (211.0, False)])
def test_marks_drawn_alike_take_out_the_same_whichever_way_they_lie(turn_deg: float, mirrored: bool) -> None:
    fit = fitted(turn_deg, mirrored)
    own, alike = taken_out(fit.used, fit.model.design), taken_out_of(fit, fit.used)
    assert np.abs(alike - own).max() < 0.03 * np.abs(own).max()
    assert np.abs(alike - own).max() > 0


def test_a_mark_of_which_much_is_cut_out_takes_out_what_its_own_pixels_do() -> None:
    fit = fitted(0.4, False)
    used = fit.used & (np.arange(SIZE) < SIZE // 2)
    assert np.array_equal(taken_out_of(fit, used), taken_out(used, fit.model.design))


def fitted(turn_deg: float, mirrored: bool) -> PictureFit:
    """A ring-cross with three dots, 20 px a millimetre, where it was drawn."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    linear = 20.0 * np.array([[c, -s], [s, c]]) @ np.diag([1.0, 1.0 if mirrored else -1.0])
    place = np.column_stack([linear, [SIZE / 2 - 0.3, SIZE / 2 + 0.2]])
    mark = numbered(3)
    grey = 100.0 + 50.0 * brute_picture(mark, place, SIZE, SIZE, BLUR_PX)
    model = PictureModel(grey, np.zeros(grey.shape, np.int8), mark, place, MatchOptions(blur_px=BLUR_PX))
    fit = PictureFit(model, np.ones(grey.shape, bool), False, Coding(None))
    fit.choose_area()
    model.linearise(fit.used)
    return fit
