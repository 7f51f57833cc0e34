"""One quantity of the scene through its values: how the camera's precision follows."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.design.expected import Expected, expect
from pipeline.design.variations import Variations
from pipeline.rendered.design_table import Sweep

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Layouts:
    """Standard deviations of the camera over random layouts of the test field: mean and spread of each, by name.

    spread: the standard deviation over the layouts; 0 of a single one.
    """

    count: int
    mean: Mapping[str, float]
    spread: Mapping[str, float]


@dataclass(frozen=True)
class Step:
    """A value of the quantity and what it gives: redundancy and null directions are those of the first layout."""

    value: float | str
    points: int
    redundancy: int
    singular: int
    sigmas: Layouts


@dataclass(frozen=True)
class Swept:
    """A sweep that was carried out."""

    quantity: str
    steps: tuple[Step, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Everything that some step has a standard deviation of."""
        return tuple(dict.fromkeys(name for step in self.steps for name in step.sigmas.mean))

    @property
    def numeric(self) -> bool:
        return all(not isinstance(step.value, str) for step in self.steps)

    def slope(self, name: str) -> float:
        """That of the logarithm of sigma over the logarithm of the value; nan where one of these does not exist."""
        values = [step.value for step in self.steps]
        sigmas = [step.sigmas.mean.get(name, math.nan) for step in self.steps]
        if not all(isinstance(value, int | float) and value > 0.0 for value in values):
            return math.nan
        if not all(0.0 < sigma < math.inf for sigma in sigmas):
            return math.nan
        x, y = np.log(np.array(values, dtype=float)), np.log(np.array(sigmas))
        return float(np.polyfit(x, y, 1)[0])


def sweep(scene: Variations, number: int, asked: Sweep, progress: Progress | None = None) -> Swept:
    """Carry out a sweep, the one of that number in the scene. Raises InputError for a quantity that there is not."""
    varied = [scene.varied(number, asked, value) for value in asked.values]
    steps = []
    for i, variation in enumerate(varied):
        value: float | str = asked.values[i]
        if progress is not None:
            progress(f"{asked.quantity} = {value}", i, len(varied))
        first = expect(variation.setup())
        adjustment = first.plan.adjustment
        sigmas = over_layouts(variation, first)
        steps.append(Step(value, len(first.network.points), adjustment.redundancy, len(first.plan.singular), sigmas))
    return Swept(asked.quantity, tuple(steps))


def over_layouts(scene: Variations, first: Expected) -> Layouts:
    """The camera's standard deviations over as many layouts as the scene asks for, the first of which is done."""
    count = first.setup.settings.layouts
    found = [first.camera_sigmas, *(expect(scene.setup(layout)).camera_sigmas for layout in range(1, count))]
    mean = {name: float(np.mean([sigmas[name] for sigmas in found])) for name in first.camera_sigmas}
    with np.errstate(invalid="ignore"):
        spread = {name: float(np.std([sigmas[name] for sigmas in found])) for name in mean}
    return Layouts(count, mean, {name: 0.0 if math.isinf(mean[name]) else spread[name] for name in spread})
