"""The adjusted quantities of a network, with their covariance."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np

from adjust.array_types import Array, Indices
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter, as_parameter

Termination = Literal["converged", "singular", "iteration limit", "diverged"]


@dataclass(frozen=True)
class NullDirection:
    """A change of the unknowns that the observations cannot see: what moves together, why, and what would remove it."""

    parameters: tuple[Parameter, ...]
    cause: str
    remedy: str


class GivenGroup(NamedTuple):
    """Values that a file gives of one owner, by their group: `datum` of a camera, `interior` of a camera and so on."""

    group: str
    owner: str


@dataclass(frozen=True, eq=False)
class VarianceFactor:
    """sigma0, the root of the variance factor, and what it was estimated from.

    redundancy: of the observations that it comes from, 0 where none have enough: sigma0 is then 1, and standard
    deviations are a priori ones. left_out: given values that only place the datum or agree better than their standard
    deviations allow, at `positions` (k,) of the unknowns: they take no part in sigma0, and it does not multiply them.
    """

    sigma0: float
    redundancy: float
    left_out: tuple[GivenGroup, ...] = ()
    positions: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    @property
    def is_a_priori(self) -> bool:
        return self.redundancy == 0.0


class Cofactor(Protocol):
    """The a-priori covariance (sigma0 = 1) of n quantities: their variances (n,) and, as asked for, any part of it."""

    @property
    def variances(self) -> Array: ...

    def part(self, at: Indices) -> Array:
        """The matrix (k, k) of some quantities, by their positions."""
        ...

    def parts(self, groups: Indices) -> Array:
        """The matrices (g, k, k) of groups of quantities (g, k), each of one point's or of one image's."""
        ...


@dataclass(frozen=True, repr=False)
class Estimates:
    """Values of all quantities of a network and their covariance.

    parameters: the keys of all quantities, in the order of values and covariance (omega, phi, kappa in rad); fixed ones
    included, with zero rows. `value`, `sigma` and the like take a key, or its text in the files. variance: sigma0, and
    what it comes from. cofactor: computed where it is asked for; covariance is sigma0² times that. It is the a-priori
    covariance (sigma0 = 1) where sigma0 multiplies all that was given; of the values that `variance` leaves out it has
    the given variances over sigma0². Without a solution (termination "singular", "diverged") it is zero and means
    nothing. mirrored: the images whose scan is mirrored, as in `Approximations`.
    """

    network: Network
    termination: Termination
    variance: VarianceFactor
    parameters: tuple[Parameter, ...]
    values: Array
    cofactor: Cofactor
    mirrored: frozenset[str]

    @property
    def converged(self) -> bool:
        return self.termination == "converged"

    @property
    def sigma0(self) -> float:
        """Square root of the a-posteriori variance of unit weight; 1 where standard deviations are a priori ones."""
        return self.variance.sigma0

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The quantities' texts in the files: `IO.<camera>.k3`, `FID.<camera>.<id>.x`, `EO.<image>.X0`, `PT.<id>.X`."""
        return tuple(each.text for each in self.parameters)

    def has(self, parameter: Parameter | str) -> bool:
        return as_parameter(parameter) in self._positions

    def index(self, parameter: Parameter | str) -> int:
        return self._positions[as_parameter(parameter)]

    @cached_property
    def _positions(self) -> dict[Parameter, int]:
        return {each: i for i, each in enumerate(self.parameters)}

    def value(self, parameter: Parameter | str) -> float:
        return float(self.values[self.index(parameter)])

    def values_of(self, parameters: Iterable[Parameter | str]) -> Array:
        """(k,) the values of some quantities."""
        return self.values[[self.index(each) for each in parameters]]

    def cofactor_of(self, parameters: Sequence[Parameter | str]) -> Array:
        """The cofactor matrix (k, k) of some quantities."""
        return self.cofactor.part(np.array([self.index(each) for each in parameters], dtype=np.intp))

    def sigma(self, parameter: Parameter | str) -> float:
        """A-posteriori standard deviation."""
        return self.sigma0 * float(np.sqrt(self.cofactor.variances[self.index(parameter)]))
