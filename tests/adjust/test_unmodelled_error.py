"""The standard deviation of what is not modelled, as a variance component of each camera."""

from functools import partial

import numpy as np
import pytest
from board_pictures import board_network

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
