"""The one Gauss-Newton driver: a model is stepped until it stands still, runs away or its steps are used up."""

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from measure.flags import Code, Reason

Array = NDArray[np.float64]

UNSETTLED = Reason("the adjustment did not converge", Code.NO_FIT)
UNDETERMINED = Reason("the picture does not determine the mark's place", Code.NO_FIT)


class Model(Protocol):
    """What is fitted to a picture: residuals, derivatives, weights and priors are its own."""

    def solve(self) -> Array | None:
        """The step (unknowns,) by the normal equations of the present state, None where they are singular."""

    def step(self, step: Array) -> float:
        """Take a step and linearise there; how far the mark moved, px."""

    def failure(self) -> Reason:
        """Why the present state is no solution, empty where it may be one."""


class ReversibleModel(Model, Protocol):
    """One whose steps may be taken back. state: what a step replaces."""

    state: Any

    def cost(self) -> float:
        """What the steps make small."""


class Outcome(NamedTuple):
    """reason: why the model did not come to rest, empty where it did; moved_px: the length of the last step."""

    reason: Reason
    moved_px: float


def gauss_newton(model: Model, tolerance_px: float, iterations: int) -> Outcome:
    """Step the model until it moves less than a tolerance.

    Parameters
    ----------
    model : Model
        Is left at its last state.
    tolerance_px : float
        A step shorter than it is the last.
    iterations : int
        Steps at most.

    Returns
    -------
    Outcome
    """
    outcome = Outcome(UNSETTLED, np.inf)
    for _ in range(iterations):
        step = model.solve()
        if step is None:
            return Outcome(UNDETERMINED, outcome.moved_px)
        outcome = Outcome(UNSETTLED, model.step(step))
        reason = model.failure()
        if reason or outcome.moved_px < tolerance_px:
            return Outcome(reason, outcome.moved_px)
    return outcome


class Halving:
    """A model whose steps are halved as long as they do not lessen its cost."""

    def __init__(self, model: ReversibleModel, tolerance_px: float, halvings: int) -> None:
        self._model, self._tolerance_px, self._halvings = model, tolerance_px, halvings
        self._cost = model.cost()
        self.solve, self.failure = model.solve, model.failure

    def step(self, step: Array) -> float:
        """Take a step, or a part of it; none where no part lessens the cost and the last was short."""
        model, before, cost_before = self._model, self._model.state, self._cost
        moved_px = model.step(step)
        if moved_px < self._tolerance_px:
            return moved_px
        self._cost = model.cost()
        for _ in range(self._halvings):
            if self._cost <= cost_before:
                break
            step, model.state = step / 2, before
            moved_px = model.step(step)
            self._cost = model.cost()
        if self._cost > cost_before and float(np.hypot(*step[:2])) < self._tolerance_px:
            # Where size, blur and contrast hang together the cost ends flat.
            model.state = before
            return model.step(np.zeros_like(step))
        return moved_px


def gauss_newton_halving(model: ReversibleModel, tolerance_px: float, iterations: int, halvings: int) -> Outcome:
    """As `gauss_newton`, a step that does not lessen the cost being halved, so many times at most."""
    return gauss_newton(Halving(model, tolerance_px, halvings), tolerance_px, iterations)
