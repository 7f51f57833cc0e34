"""A lens: its distortion family with settings and parameters, each as it is known beforehand.

Lengths in mm. A standard deviation of 0 fixes a quantity, inf frees it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.families import parameter_names

Array = NDArray[np.float64]
Decentering = Literal["reduced", "paper"]


@dataclass(frozen=True)
class Prior:
    """A quantity as it is known beforehand: its value and the value's standard deviation (0 fixed, inf free)."""

    value: float
    sigma: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.value):
            raise ValueError(f"a value must be a finite number, not {self.value}")
        if not self.sigma >= 0.0:
            raise ValueError(f"a standard deviation must be 0 (fixed), positive or inf (free), not {self.sigma}")


@dataclass(frozen=True)
class Distortion:
    """A distortion family, a name in `functional_model.families`, and its parameters; one not named is fixed at 0.

    decentering "paper": Torlegård's decentering terms with x', y' as printed and not reduced to the principal point.
    r0_mm: radius of zero radial distortion of `torlegard`, of a period of `juhl`.
    half_mm: half the frame in x' and y', the length 1 of `ebner`, `gruen`, `legendre(n)` and `fourier(n)`; 0 not given.
    """

    family: str = "none"
    parameters: Mapping[str, Prior] = field(default_factory=dict)
    decentering: Decentering = "reduced"
    r0_mm: float = 0.0
    half_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        parameter_names(self.family)  # refuses a family that there is not
        if self.decentering not in get_args(Decentering):
            raise ValueError(f'the decentering must be "reduced" or "paper", not {self.decentering}')
        if not 0.0 <= self.r0_mm < np.inf:
            raise ValueError(f"r0 must be 0 or a positive length in mm, not {self.r0_mm}")
        if not all(0.0 <= half < np.inf for half in self.half_mm):
            raise ValueError(f"half the frame must be two lengths in mm, not {self.half_mm}")

    @property
    def values(self) -> Array:
        """(k,) what is given of the family's parameters, 0 where nothing is."""
        given = self.parameters
        return np.array([given[name].value if name in given else 0.0 for name in parameter_names(self.family)])
