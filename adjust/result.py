"""What an adjustment hands on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from adjust.network import Network

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

Termination = Literal["converged", "singular", "iteration limit", "diverged"]


@dataclass(frozen=True)
class NullDirection:
    """A change of the unknowns that the observations cannot see: what moves together, why, and what would remove it."""

    parameters: tuple[str, ...]
    cause: str
    remedy: str


@dataclass(frozen=True)
class Residuals:
    """One row an observation of the network, in its order.

    v_mm (n, 2): adjusted less observed comparator coordinates; redundancy (n, 2): redundancy numbers of x and y;
    w (n, 2): standardised residuals v / sigma_v.
    """

    v_mm: Array
    redundancy: Array
    w: Array


@dataclass(frozen=True)
class FurtherResidual:
    """One observation beside image points and single unknowns, a distance say, in the unit of what is observed.

    group and name as in `FurtherObservation`; v: adjusted less observed; sigma: its a-priori standard deviation;
    redundancy number; w: v / sigma_v.
    """

    group: str
    name: str
    observed: float
    v: float
    sigma: float
    redundancy: float
    w: float


@dataclass(frozen=True)
class Group:
    """A kind of observation: its share of v'Pv over its redundancy (sigma0), rms in um per axis, redundancy.

    sigma0 is 0 and means nothing where the redundancy is 0: there is no check. `target`, `fiducial`: in the comparator;
    `control`: given object coordinates, rms in millionths of the object unit; `datum`: given places of fiducials (F5,
    F6); `interior`, `exterior`: given values of mixed units, rms 0; `distance`: distances, rms 0. The first three are
    always there.
    """

    sigma0: float
    rms_x_um: float
    rms_y_um: float
    redundancy: float


class Cofactor(Protocol):
    """The a-priori covariance (sigma0 = 1) of n quantities: their variances (n,) and, as asked for, any part of it."""

    @property
    def variances(self) -> Array: ...

    def of(self, at: Indices) -> Array:
        """The matrix (k, k) of some quantities, by their positions."""
        ...


@dataclass(frozen=True)
class Adjustment:
    """The result: values, covariance, residuals, and how it came about.

    names: the unknowns, in the order of values and covariance: `T.<image>.a1`, `EO.<image>.X0` (omega, phi, kappa in
    rad), `IO.<camera>.c` / `.x0` / `.y0` / `.k3`, `FID.<camera>.<id>.x`, `PT.<id>.X`; fixed quantities included, with
    zero rows. cofactor: a-priori covariance (sigma0 = 1), computed where it is asked for; covariance is sigma0² times
    that. Without a solution (termination "singular", "diverged") it is zero and means nothing.
    mirrored: the images whose scan is mirrored, as in `Approximations`.
    weights (n,): the factors that robust estimation left on the weights of the observations, 1 without it.
    variance_factors: the factors found for the variances of the groups "target" and "fiducial", where asked for.
    further: the residuals of distances and the like.
    """

    network: Network
    termination: Termination
    iterations: int
    conditions: int
    unknowns: int
    redundancy: int
    vpv: float
    names: tuple[str, ...]
    values: Array
    cofactor: Cofactor
    residuals: Residuals
    groups: Mapping[str, Group]
    singular: tuple[NullDirection, ...]
    warnings: tuple[str, ...]
    history: tuple[tuple[float, float], ...]  # (v'Pv, largest step in sigmas) per iteration
    mirrored: frozenset[str] = frozenset()
    weights: Array = field(default_factory=lambda: np.empty(0))
    variance_factors: Mapping[str, float] = field(default_factory=dict)
    further: tuple[FurtherResidual, ...] = ()

    @property
    def converged(self) -> bool:
        return self.termination == "converged"

    @property
    def sigma0(self) -> float:
        """Square root of the a-posteriori variance of unit weight; 1 where there is no redundancy."""
        return float(np.sqrt(self.vpv / self.redundancy)) if self.redundancy > 0 else 1.0

    def index(self, name: str) -> int:
        return self._positions[name]

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def value(self, name: str) -> float:
        return float(self.values[self.index(name)])

    def cofactor_of(self, names: Sequence[str]) -> Array:
        """The cofactor matrix (k, k) of some unknowns."""
        return self.cofactor.of(np.array([self.index(name) for name in names], dtype=np.intp))

    def sigma(self, name: str) -> float:
        """A-posteriori standard deviation."""
        return self.sigma0 * float(np.sqrt(self.cofactor.variances[self.index(name)]))
