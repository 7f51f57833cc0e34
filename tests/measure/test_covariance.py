from dataclasses import replace

import numpy as np
import pytest

from measure.flags import Cause, Status
from measure.results import Covariance, MarkMeasurement


def test_the_covariance_of_a_mark_is_the_sum_of_its_causes() -> None:
    noise = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    tone = np.array([[1e-4, 0.0], [0.0, 0.0]])
    known = Covariance.from_noise(noise).plus(Cause.TONE, tone).plus(Cause.TONE, tone)
    mark = MarkMeasurement("1", "fiducial", np.zeros(2), known, Status.MEASURED)
    np.testing.assert_allclose(np.asarray(mark.covariance_px2), noise + 2 * tone)
    film = replace(mark, covariance=known.plus(Cause.FILM, 0.01 * np.eye(2)))
    np.testing.assert_allclose(np.asarray(film.covariance_px2), noise + 2 * tone + 0.01 * np.eye(2))


def test_causes_are_reported_in_their_order_and_those_that_add_nothing_are_not() -> None:
    known = Covariance({Cause.TONE: 4e-4 * np.eye(2), Cause.NOISE: 1e-4 * np.eye(2)})
    known = known.plus(Cause.COMPRESSION, np.zeros((2, 2)))
    assert known.sigmas_px == pytest.approx({Cause.NOISE: 0.01, Cause.TONE: 0.02})
    assert list(known.sigmas_px) == [Cause.NOISE, Cause.TONE]
    assert repr(known) == "Covariance(noise 0.01 px, tone 0.02 px)"


def test_a_stretched_place_stretches_every_cause() -> None:
    stretch = np.array([[2.0, 1.0], [0.0, 1.0]])
    known = Covariance.from_noise(np.diag([1.0, 2.0])).plus(Cause.TONE, np.diag([0.0, 1.0]))
    moved = known.through(stretch)
    np.testing.assert_allclose(moved.px2, stretch @ known.px2 @ stretch.T)
    np.testing.assert_allclose(moved.parts[Cause.TONE], [[1.0, 1.0], [1.0, 1.0]])


def test_every_cause_is_explained() -> None:
    assert all(cause.meaning.endswith(".") for cause in Cause)
