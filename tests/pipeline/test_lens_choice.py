"""The lens model of a digital camera by cross-validation over its pictures."""

import numpy as np
import pytest
from networks import board_network

from adjust.solution.adjustment import adjust
from pipeline.calibration import lens_choice
from pipeline.calibration.lens_choice import LensChoice, LensModel, choose_lens

PIXEL_MM = 0.005
ERROR_PX = 0.1  # in x and y


@pytest.fixture(scope="module")
def choices() -> dict[float, LensChoice]:
    """By the third radial term that the lens has."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(lens_choice.PARAMETERS, "opencv8")  # as slow as both others together
        return {
            k3: choose_lens(
                board_network(np.random.default_rng(4), 6, ERROR_PX * PIXEL_MM, k3=k3), True, PIXEL_MM, adjust
            )
            for k3 in (0.0, -1.5)
        }


@pytest.mark.parametrize(("k3", "wanted"), [(0.0, "opencv4"), (-1.5, "opencv5")])
def test_a_richer_lens_is_taken_where_it_predicts_other_pictures_better(
    k3: float, wanted: LensModel, choices: dict[float, LensChoice]
) -> None:
    assert choices[k3].model == wanted
    rms_px = {score.model: score.rms_px for score in choices[k3].scores}
    assert set(rms_px) == {"opencv4", "opencv5"}
    assert rms_px[wanted] == pytest.approx(np.sqrt(2.0) * ERROR_PX, rel=0.15)


def test_a_fisheye_is_tried_where_the_field_is_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the diagonal of these pictures is 0.74 of the principal distance."""
    monkeypatch.delitem(lens_choice.PARAMETERS, "opencv5")
    monkeypatch.delitem(lens_choice.PARAMETERS, "opencv8")
    network = board_network(np.random.default_rng(4), 6, ERROR_PX * PIXEL_MM)
    for limit, tried in ((1.0, {"opencv4"}), (0.7, {"opencv4", "fisheye"})):
        monkeypatch.setattr(lens_choice, "WIDE", limit)
        choice = choose_lens(network, True, PIXEL_MM, adjust)
        assert {score.model for score in choice.scores} == tried


@pytest.mark.parametrize("model", ["opencv4", "opencv5", "opencv8", "fisheye"])
def test_focal_lengths_are_apart_unless_pixels_are_square(model: LensModel) -> None:
    assert lens_choice.free_lens(model, square_pixels=False).parameters.keys() - lens_choice.free_lens(
        model, square_pixels=True
    ).parameters.keys() == {"b1"}
