"""Options of an adjustment."""

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from adjust.quality.critical_values import PRIOR_GROUPS, Probabilities, WeightFunction

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]

MEASURED_KINDS = ("target", "tie", "fiducial", "join")


@dataclass(frozen=True)
class Options:
    """Options of an adjustment.

    Attributes
    ----------
    datum : "control": the priors of points and stations define the datum. "minimal": as many coordinates are fixed as
        the priors leave free. "free": inner constraints over points without priors.
    datum_coordinates : coordinates that "minimal" fixes at their given values: "12.X" and so on; default: chosen
        automatically.
    datum_points : points with the inner constraints of "free"; default: all.
    robust : robust estimation. "huber" (or True) reduces the weights of outliers; "igg3" finally gives them no weight;
        see `robust_weights`.
    snooping : remove outliers by data snooping; see `adjust.quality.reliability`.
    variance_components : estimate variance factors of groups. True: targets, tie points, fiducials and joins in the
        images; or names of groups (see `Group`).
    iteration_limit : largest number of iterations.
    method : "combined": the strict combined model (Gauss-Helmert). "elements": Torlegård's adjustment by elements, with
        the distortion at the observed point. Both agree as long as distortion changes little over a residual; programs
        that correct the measured points first use the latter.
    probabilities : probabilities of the tests.
    """

    datum: Datum = "control"
    datum_coordinates: tuple[str, ...] = ()
    datum_points: tuple[str, ...] = ()
    robust: bool | WeightFunction = False
    variance_components: bool | tuple[str, ...] = False
    iteration_limit: int = 100
    snooping: bool = False
    method: Method = "combined"
    probabilities: Probabilities = field(default_factory=Probabilities)

    def __post_init__(self) -> None:
        if self.datum not in get_args(Datum):
            raise ValueError(f"the datum must be one of {', '.join(get_args(Datum))}, not {self.datum}")
        if self.method not in get_args(Method):
            raise ValueError(f"the method must be one of {', '.join(get_args(Method))}, not {self.method}")
        for key, datum in (("datum_coordinates", "minimal"), ("datum_points", "free")):
            if getattr(self, key) and self.datum != datum:
                raise ValueError(f'{key} is for the datum "{datum}", not for "{self.datum}"')
        if self.iteration_limit < 1:
            raise ValueError(f"the iteration limit must be at least 1, not {self.iteration_limit}")
        if self.robust not in (True, False, *get_args(WeightFunction)):
            raise ValueError(
                f"robust must be True, False or one of {', '.join(get_args(WeightFunction))}, not {self.robust}"
            )
        if self.robust and self.snooping:
            raise ValueError("robust estimation and data snooping both take out gross errors: choose one of them")
        unknown = sorted(set(self.groups) - {*MEASURED_KINDS, *PRIOR_GROUPS})
        if unknown:
            raise ValueError(
                f"there is no group {', '.join(unknown)}: variance components are those of "
                f"{', '.join((*MEASURED_KINDS, *PRIOR_GROUPS))}"
            )

    @property
    def plain(self) -> "Options":
        """Copy of the options with all weights as given."""
        return replace(self, robust=False, snooping=False, variance_components=False)

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups whose variance components are estimated."""
        if isinstance(self.variance_components, bool):
            return MEASURED_KINDS if self.variance_components else ()
        return self.variance_components

    @property
    def weight_functions(self) -> tuple[WeightFunction, ...]:
        """Weight functions of robust estimation in order; the redescending one starts where the convex one ends."""
        if not self.robust:
            return ()
        return ("huber", "igg3") if self.robust == "igg3" else ("huber",)
