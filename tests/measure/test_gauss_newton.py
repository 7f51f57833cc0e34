"""The Gauss-Newton driver on curves whose solutions are known."""

import numpy as np
import pytest

from measure.flags import NO_REASON, Code, Reason
from measure.matching.gauss_newton import UNDETERMINED, UNSETTLED, gauss_newton

FAR = Reason("too far", Code.NO_FIT)


class Arctangent:
    """atan(x) is to be 0: full steps from |x| > 1.39 grow for ever."""

    def __init__(self, start: float) -> None:
        self.state = start

    def solve(self) -> np.ndarray | None:
        slope = 1 / (1 + self.state**2)
        return np.array([-np.arctan(self.state) / slope, 0.0]) if slope > 1e-12 else None

    def step(self, step: np.ndarray) -> float:
        self.state += float(step[0])
        return abs(float(step[0]))

    def failure(self) -> Reason:
        return FAR if abs(self.state) > 1e3 else NO_REASON

    def cost(self) -> float:
        return float(np.arctan(self.state) ** 2)


def test_a_model_is_stepped_until_it_stands_still() -> None:
    model = Arctangent(1.0)
    outcome = gauss_newton(model, 1e-6, 10)
    assert not outcome.reason
    assert outcome.moved_px < 1e-6
    assert model.state == pytest.approx(0.0, abs=1e-12)


def test_steps_that_do_not_lessen_the_cost_are_halved() -> None:
    assert gauss_newton(Arctangent(3.0), 1e-6, 30).reason == FAR
    model = Arctangent(3.0)
    assert not gauss_newton(model, 1e-6, 30, 4).reason
    assert model.state == pytest.approx(0.0, abs=1e-12)


def test_a_model_that_is_not_determined_or_not_at_rest_says_so() -> None:
    assert gauss_newton(Arctangent(1e7), 1e-6, 10).reason == UNDETERMINED
    assert gauss_newton(Arctangent(1.0), 1e-6, 2).reason == UNSETTLED
