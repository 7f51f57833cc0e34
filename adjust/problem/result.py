"""What an adjustment hands on."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from adjust.problem.network import Network
from adjust.problem.parameter import Parameter, parameter_of
from adjust.problem.probabilities import Probabilities
from adjust.problem.tested import Tested

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

Termination = Literal["converged", "singular", "iteration limit", "diverged"]


class Iteration(NamedTuple):
    """A step of the iteration: v'Pv after it, how far it moves what moves most, its damping, the attempts.

    A step that would have increased v'Pv, or after which some point would have had no image, was tried again with more
    damping (0: an undamped Gauss-Newton step).
    """

    vpv: float
    largest_step_sigmas: float
    damping: float
    attempts: int


@dataclass(frozen=True)
class NullDirection:
    """A change of the unknowns that the observations cannot see: what moves together, why, and what would remove it."""

    parameters: tuple[Parameter, ...]
    cause: str
    remedy: str


@dataclass(frozen=True, repr=False)
class Residuals:
    """One row an observation of the network, in its order.

    v_mm (n, 2): adjusted less observed comparator coordinates; redundancy (n, 2): redundancy numbers of x and y;
    w (n, 2): standardised residuals, v / sigma_v where the two coordinates are not correlated (see `Reliability`).
    """

    v_mm: Array
    redundancy: Array
    w: Array

    def __repr__(self) -> str:
        rms_um = 1000.0 * np.sqrt(np.mean(np.square(self.v_mm), axis=0)) if len(self.v_mm) else np.zeros(2)
        return f"Residuals({len(self.v_mm)} of rms {rms_um[0]:.3g}, {rms_um[1]:.3g} um)"


@dataclass(frozen=True)
class FurtherResidual:
    """One observation beside image points and single unknowns, a distance say, in the unit of what is observed.

    group and name as in `FurtherObservation`; v: adjusted less observed; sigma: its a-priori standard deviation;
    redundancy number; w: v / sigma_v; detectable: the smallest error that its own test finds (Baarda), inf unchecked.
    """

    group: str
    name: str
    observed: float
    v: float
    sigma: float
    redundancy: float
    w: float
    detectable: float


@dataclass(frozen=True)
class Group:
    """A kind of observation: its share of v'Pv over its redundancy (sigma0), rms in um per axis, redundancy.

    sigma0 is 0 and means nothing where the redundancy is below 1: there is no check. `target`, `fiducial`: in the
    comparator; `control`: given object coordinates, rms in millionths of the object unit; `datum`: given places of
    fiducials (F5, F6); `interior`, `exterior`: given values of mixed units, rms 0; `distance`: rms 0. The first three
    are always there.
    """

    sigma0: float
    rms_x_um: float
    rms_y_um: float
    redundancy: float


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

    def of(self, at: Indices) -> Array:
        """The matrix (k, k) of some quantities, by their positions."""
        ...

    def of_each(self, groups: Indices) -> Array:
        """The matrices (g, k, k) of groups of quantities (g, k), each of one point's or of one image's."""
        ...


@dataclass(frozen=True)
class OuterEffect:
    """What the worst undetected error does to a camera parameter.

    effect: in the parameter's unit, of an error of the smallest detectable size in `cause`; in_sigmas: over the
    parameter's a-priori standard deviation.
    """

    parameter: Parameter
    effect: float
    in_sigmas: float
    cause: str


@dataclass(frozen=True, repr=False)
class Reliability:
    """How well the observations check each other: one row for everything that is tested.

    All (N, 2) by coordinate; a quantity of one coordinate has zeros in the place of a second, and inf for errors. With
    C the covariance given, Q_v the cofactor matrix of v, P the inverse of C, h one coordinate:
    v: adjusted less given, sigma: the a-priori standard deviation, in mm, object units or rad. redundancy: diagonal of
    Q_v P, with the weights that were used. w: h'P v / root(h'P Q_v P h), v / sigma_v where P is diagonal; 0 where
    nothing checks the coordinate. tau: w / sigma0. smallest: the gross error that the test of the coordinate detects
    with the probability `power`, delta0 / root(h'P Q_v P h); inf where nothing checks it. effect: how far an undetected
    one moves any function of the unknowns at most, in its standard deviations. (Baarda's inner and outer reliability.)
    statistic (N,): v'P (P Q_v P)^- P v of all coordinates together, chi-square of `sizes` (N,); smallest_together (N,):
    the gross error of a pair in its least favourable direction.
    An observation that has lost weight is tested as it was given, against all the others with the weights that these
    have left.
    outer: one entry a free camera parameter; unchecked: what no other observation checks, left out there.
    """

    probabilities: Probabilities
    tested: tuple[Tested, ...]
    v: Array
    sigma: Array
    redundancy: Array
    w: Array
    tau: Array
    critical_tau: float
    smallest: Array
    effect: Array
    statistic: Array
    sizes: NDArray[np.intp]
    smallest_together: Array
    outer: tuple[OuterEffect, ...]
    unchecked: tuple[str, ...]

    def __repr__(self) -> str:
        worst = np.abs(self.w).max(initial=0.0)
        return f"Reliability({len(self.tested)} tested, largest w {worst:.3g}, {len(self.unchecked)} unchecked)"


@dataclass(frozen=True)
class Suspect:
    """An observation or given quantity that contradicts the others beyond chance, given the other suspects left out.

    size: its coordinates that were tested together; statistic: chi-square with so many degrees of freedom; critical:
    what chance reaches in 1 of 100 adjustments (`Probabilities.family`). w, tau: of its worst coordinate in the
    adjustment as it stands; critical_tau: of tau. error: the gross error as the others see it, by coordinate, in mm,
    object units or rad. alike: what could as well be wrong in its place. removed: the adjustment does without it.
    """

    tested: Tested
    size: int
    statistic: float
    critical: float
    w: float
    tau: float
    critical_tau: float
    error: tuple[float, ...]
    alike: tuple[str, ...]
    removed: bool


@dataclass(frozen=True, eq=False)
class Contradiction:
    """What the images say against observations that are correlated, as an earlier calibration's quantities are.

    parameters (m,); difference (m,): where the images put each less where it was observed, with the a-posteriori sigma
    (m,) of that; nan and inf where the images do not tell it. statistic: of all together, F with freedom and the other
    observations' redundancy; probability: of as much where they do not contradict each other.
    """

    group: str
    parameters: tuple[Parameter, ...]
    difference: Array
    sigma: Array
    statistic: float
    freedom: int
    probability: float

    @property
    def direction(self) -> tuple[int, ...]:
        """The quantities by number, those first in which both differ most in standard deviations of their own."""
        size = np.where(np.isfinite(self.difference), np.abs(self.difference) / self.sigma, 0.0)
        return tuple(np.argsort(-size, kind="stable").tolist())


@dataclass(frozen=True)
class Explanation:
    """What makes residuals larger than the standard deviations given, beyond chance.

    cause: in words with figures; remedy: what to do. kind: "radial", "decentering", "pixels", "groups", "board" or
    "noise". p: probability of so much by chance; sigma0: without and with it in the model.
    """

    kind: str
    cause: str
    remedy: str
    p: float
    sigma0: tuple[float, float]


class Assessment(Protocol):
    """What an adjustment tells of its observations, each part computed where it is asked for (see `Adjustment`)."""

    @property
    def residuals(self) -> Residuals: ...

    @property
    def groups(self) -> Mapping[str, Group]: ...

    @property
    def further(self) -> tuple[FurtherResidual, ...]: ...

    @property
    def contradictions(self) -> tuple[Contradiction, ...]: ...

    @property
    def variance_sigmas(self) -> Mapping[str, float]: ...

    @property
    def reliability(self) -> Reliability | None: ...

    @property
    def suspects(self) -> tuple[Suspect, ...]: ...

    @property
    def explanations(self) -> tuple[Explanation, ...]: ...

    @property
    def warnings(self) -> tuple[str, ...]: ...

    @property
    def notes(self) -> tuple[str, ...]: ...


@dataclass(frozen=True, repr=False)
class Adjustment:
    """The result: values, covariance, residuals, and how it came about.

    parameters: the keys of all quantities, in the order of values and covariance (omega, phi, kappa in rad); fixed ones
    included, with zero rows. `value`, `sigma` and the like take a key, or its text in the files. variance: sigma0, and
    what it comes from. cofactor: computed where it is asked for; covariance is sigma0² times that. It is the a-priori
    covariance (sigma0 = 1) where sigma0 multiplies all that was given; of the values that `variance` leaves out it has
    the given variances over sigma0². Without a solution (termination "singular", "diverged") it is zero and means
    nothing.
    assessment: what is told of the observations, computed where it is asked for: `residuals`, `groups`, `reliability`,
    `suspects`, `warnings` and more.
    mirrored: the images whose scan is mirrored, as in `Approximations`.
    weights (n,): the factors that robust estimation left on the weights of the observations, 1 without it.
    variance_factors: the factors found for the variances of groups, where asked for.
    remarks: on how the adjustment came about, the first of the warnings.
    slips: sentences on given points so far off that the observations do not agree, or have no solution, for them.
    left_out: by name, the images for which no orientation was found, and why; the network is that of the others.
    misread: sentences on images that are mirrored; what else there seems to be is theirs.
    unused: notes on what was given and has no part, the first of the notes.
    """

    network: Network
    termination: Termination
    iterations: int
    conditions: int
    unknowns: int
    redundancy: int
    vpv: float
    variance: VarianceFactor
    parameters: tuple[Parameter, ...]
    values: Array
    cofactor: Cofactor
    assessment: Assessment
    singular: tuple[NullDirection, ...]
    history: tuple[Iteration, ...]
    mirrored: frozenset[str] = frozenset()
    weights: Array = field(default_factory=lambda: np.empty(0))
    variance_factors: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    slips: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    misread: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()

    @property
    def residuals(self) -> Residuals:
        return self.assessment.residuals

    @property
    def groups(self) -> Mapping[str, Group]:
        return self.assessment.groups

    @property
    def further(self) -> tuple[FurtherResidual, ...]:
        """The residuals of distances and the like."""
        return self.assessment.further

    @property
    def contradictions(self) -> tuple[Contradiction, ...]:
        """What the images say against earlier calibrations as wholes."""
        return self.assessment.contradictions

    @property
    def variance_sigmas(self) -> Mapping[str, float]:
        """The standard deviations of the variance factors."""
        return self.assessment.variance_sigmas

    @property
    def reliability(self) -> Reliability | None:
        """None where there is no solution."""
        return self.assessment.reliability

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """The worst first."""
        return () if self.misread else self.assessment.suspects

    @property
    def explanations(self) -> tuple[Explanation, ...]:
        """Of a sigma0 that is too large; suspects are then those of an adjustment with them in the model."""
        return () if self.misread else self.assessment.explanations

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should look at; where slips kept it from a solution, all else there seems to be is theirs."""
        spoilt = self.slips and not self.converged
        left_out = (f"Left out of the adjustment: {reason}" for reason in self.left_out.values())
        return (*self.misread, *self.slips, *left_out, *self.remarks, *(() if spoilt else self.assessment.warnings))

    @property
    def notes(self) -> tuple[str, ...]:
        """What is worth knowing and needs no action."""
        return (*self.unused, *self.assessment.notes)

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
        return parameter_of(parameter) in self._positions

    def index(self, parameter: Parameter | str) -> int:
        return self._positions[parameter_of(parameter)]

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
        return self.cofactor.of(np.array([self.index(each) for each in parameters], dtype=np.intp))

    def sigma(self, parameter: Parameter | str) -> float:
        """A-posteriori standard deviation."""
        return self.sigma0 * float(np.sqrt(self.cofactor.variances[self.index(parameter)]))

    def __repr__(self) -> str:
        return (
            f"Adjustment({self.termination} after {self.iterations} iterations: {self.conditions} conditions, "
            f"{self.unknowns} unknowns, redundancy {self.redundancy}, sigma0 {self.sigma0:.3f})"
        )

    def _repr_html_(self) -> str:
        """The cameras' parameters, as a notebook shows them."""
        rows = "".join(
            f"<tr><td>{escape(each.label)}</td><td>{self.value(each):.7g}</td><td>{self.sigma(each):.2g}</td></tr>"
            for each in self.parameters
            if each.kind == "interior"
        )
        head = "<tr><th>parameter</th><th>value</th><th>sigma</th></tr>"
        return f"<p>{escape(repr(self))}</p><table>{head}{rows}</table>"
