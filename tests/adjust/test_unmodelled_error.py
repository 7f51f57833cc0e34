"""The standard deviation of what is not modelled, as a variance component of each camera."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from board_pictures import FRAME_MM, board_network

from adjust.errors import AdjustmentError
from adjust.solution.adjustment import adjust
from adjust.solution.unmodelled_error import adjust_unmodelled


def test_it_is_what_the_marks_err_by_beyond_what_is_given() -> None:
    """Errors of 0.5 µm, of which 0.1 µm is given: 0.49 µm is left, known to 3 % from 550 redundant coordinates."""
    network = board_network(np.random.default_rng(5), 6, 5e-4, given_mm=1e-4)
    result = adjust_unmodelled(network, adjust)
    assert result.unmodelled_mm == {"desk": pytest.approx(4.9e-4, rel=0.09)}
    assert result.sigma0 == pytest.approx(1.0, abs=0.01)


def test_there_is_none_where_the_given_standard_deviations_explain_the_residuals() -> None:
    network = board_network(np.random.default_rng(6), 6, 5e-4, given_mm=6e-4)
    result = adjust_unmodelled(network, partial(adjust))
    assert result.unmodelled_mm == {"desk": 0.0}
    assert result.sigma0 == pytest.approx(5 / 6, rel=0.09)


def test_what_is_wrong_with_a_picture_is_no_unmodelled_error_that_passes() -> None:
    """One of eight pictures is mirrored: that is refused, or said, and not taken for a lens that is a little poor."""
    network = board_network(np.random.default_rng(7), 8, 5e-4, given_mm=1e-4)
    xy_mm = network.observations.xy_mm.copy()
    rows = [row for row, image in enumerate(network.observations.image) if image == "p3"]
    xy_mm[rows, 0] = FRAME_MM[0] - xy_mm[rows, 0]
    mirrored = replace(network, observations=replace(network.observations, xy_mm=xy_mm))
    try:
        text = " ".join(adjust_unmodelled(mirrored, adjust).warnings)
    except AdjustmentError as error:
        text = str(error)
    assert "p3" in text
    assert "mirrored" in text


def test_an_implausible_one_is_a_warning() -> None:
    """Errors of 5 µm, a part in 800 of the diagonal of 4 mm: no lens leaves so much."""
    result = adjust_unmodelled(board_network(np.random.default_rng(9), 6, 5e-3, given_mm=1e-4), adjust)
    assert any(re.search(r"are not modelled, one part in [78]\d\d of", warning) for warning in result.warnings)
