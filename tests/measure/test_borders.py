"""Marks over a border of their ground: dark on one side, light on the other, drawn in fine pixels by exact areas."""

import numpy as np
import pytest
from drawn import scan_of
from true_marks import KIND, Border, TrueMark, grainy, over_border, some_mark, whitened_rms

from measure.detection.prediction import MarkPrediction
from measure.fiducial_options import FiducialOptions
from measure.fiducials.mark_fit import sight
from measure.match_options import MatchOptions
from measure.matching.border_search import likely_border
from measure.matching.bordered_model import BorderedModel
from measure.matching.match import Match
from measure.matching.models import PictureModel

Array = np.ndarray
GROUND, CONTRAST, SNR, BLUR_PX = 25000.0, 15000.0, 20.0, 1.0


def sighted(mark: TrueMark, grey: Array, rng: np.random.Generator) -> Match:
    start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + rng.uniform(-1, 1, 2)])
    expected, options = MarkPrediction(mark.kind.shape, start, 3.0, 1), FiducialOptions().match
    fit = sight(scan_of(grey), expected, options).fit
    assert fit is not None
    return fit


@pytest.mark.parametrize(
    ("name", "opaque", "largest_px"), [("cross", False, 0.025), ("ring-cross", True, 0.03), ("dot", True, 0.1)]
)
def test_marks_over_a_border_are_as_far_off_as_they_say(name: str, opaque: bool, largest_px: float) -> None:
    rng = np.random.default_rng(3)
    fits, errors = [], []
    for _ in range(5):
        mark = some_mark(KIND[name], BLUR_PX, rng)
        border = Border(rng.uniform(-12, 12), rng.uniform(0, 2 * np.pi), rng.uniform(-0.01, 0.01))
        grey = GROUND + CONTRAST * over_border(mark, 0.6, border, opaque)
        fits.append(sighted(mark, grey + rng.normal(0, CONTRAST / SNR, grey.shape), rng))
        errors.append(fits[-1].center_px - mark.place[:, 2])
    assert whitened_rms(errors, [fit.covariance_px2 for fit in fits]) < 1.3
    assert np.sqrt(np.mean(np.square(errors))) < largest_px
    assert all(fit.covariance_is_white and fit.damaged_fraction < 0.05 for fit in fits)


@pytest.mark.parametrize("grain_px", [0.0, 0.7, 1.5])
def test_no_border_is_seen_where_there_is_none(grain_px: float) -> None:
    rng = np.random.default_rng(4)
    mark = some_mark(KIND["ring-dot"], BLUR_PX, rng)
    area = np.hypot(*(np.mgrid[: mark.size, : mark.size] - mark.size // 2)) < 20
    for _ in range(10):
        noise = grainy(mark.size, grain_px, rng) if grain_px else rng.standard_normal((mark.size, mark.size))
        model = plain_model(mark, GROUND + CONTRAST * (mark.picture + noise / SNR), area)
        assert likely_border(model, area, 0.0) is None
        stepped = model.grey + 0.5 * CONTRAST * (np.arange(mark.size) > mark.size // 2 + 3)
        border = likely_border(plain_model(mark, stepped, area), area, 0.0)
        assert border is not None
        assert border.off_px == pytest.approx(3.5 + mark.size // 2 - mark.place[0, 2], abs=1.0)
        assert np.cos(border.turn_rad) == pytest.approx(1.0, abs=0.01)


def plain_model(mark: TrueMark, grey: Array, area: Array) -> PictureModel:
    options = MatchOptions(blur_px=BLUR_PX)
    model = PictureModel(grey, np.zeros(grey.shape, np.int8), mark.kind.shape, mark.place, options)
    model.linearise(area)
    return model


@pytest.mark.parametrize(("name", "largest"), [("cross", 0.07), ("dot", 0.01)])
def test_the_model_is_what_is_drawn_and_its_derivatives_are_its_differences(name: str, largest: float) -> None:
    rng = np.random.default_rng(5)
    mark = some_mark(KIND[name], BLUR_PX, rng)
    middle = mark.size // 2 - mark.place[:, 2]
    turn, off, step = 0.6, 2.0, 0.8
    grey = over_border(mark, step, Border(off, turn, 0.0), opaque=True)
    model = BorderedModel(grey, np.zeros(grey.shape, np.int8), mark.kind.shape, mark.place, MatchOptions())
    off_mark = off + middle @ [np.cos(turn), np.sin(turn)]
    border = np.array([off_mark, turn, 0.0, np.log(BLUR_PX**2 + 1 / 12), step, -step])
    greys = np.array([1.0, 0.0, 0.0, 0.0])
    used = np.ones(grey.shape, bool)

    def residuals(by: int = 0, change: float = 0.0) -> Array:
        at = border.copy()
        at[by] += change
        model.state = type(model.state)(mark.place.copy(), BLUR_PX**2, greys, at)
        model.take_noise(model.noise_dn * 2)  # forgets what was linearised
        model.linearise(used)
        return np.asarray(model.residuals.copy())

    assert np.abs(residuals()).max() < largest
    border[-1] = 0.0  # one contrast on both sides: then no series is cut off
    residuals()
    design = model.design[model.border].copy()
    for by, column in enumerate(design):
        changed = (residuals(by, -1e-6) - residuals(by, 1e-6)) / 2e-6
        assert np.abs(column - changed).max() < 0.01 * np.abs(changed).max()
