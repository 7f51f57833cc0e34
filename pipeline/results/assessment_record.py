"""Residuals, tests and reliability in `adjustment.json`: one class per table of the file."""

from dataclasses import dataclass, field
from typing import Annotated

from adjust.problem.parameter import parameter_from_text
from pipeline.results.record_json import KEY

ParameterText = Annotated[str, parameter_from_text]  # as `Parameter.text`


@dataclass(frozen=True, slots=True)
class ResidualRecord:
    """Residual of an image observation, with its tests.

    Attributes
    ----------
    vx_um, vy_um : residual in comparator coordinates.
    redundancy_x, redundancy_y : redundancy numbers.
    w_x, w_y, w : standardised residuals by axis, and that of larger absolute value.
    weight : weight factor of the robust estimation, 1 if it was not used.
    sx_um, sy_um : a-priori standard deviations.
    x_mm, y_mm : comparator coordinates.
    camera_x_mm, camera_y_mm, camera_vx_um, camera_vy_um : camera coordinates and the residual in them.
    tau_x, tau_y, statistic, smallest_error_x_um, smallest_error_y_um, effect_sigmas : see `Reliability`; effect_sigmas
        is the larger of both axes. None if the reliability was not computed.
    """

    image: str
    point: str
    kind: str
    vx_um: float
    vy_um: float
    redundancy_x: float
    redundancy_y: float
    w: float
    w_x: float
    w_y: float
    weight: float
    sx_um: float
    sy_um: float
    x_mm: float
    y_mm: float
    camera_x_mm: float
    camera_y_mm: float
    camera_vx_um: float
    camera_vy_um: float
    tau_x: float | None = None
    tau_y: float | None = None
    statistic: float | None = None
    smallest_error_x_um: float | None = None
    smallest_error_y_um: float | None = None
    effect_sigmas: float | None = None

    @property
    def v_um(self) -> tuple[float, float]:
        return self.vx_um, self.vy_um


@dataclass(frozen=True, slots=True)
class DistanceRecord:
    """Residual of a given distance, object units; see `FurtherResidual`."""

    start: str = field(metadata={KEY: "from"})
    end: str = field(metadata={KEY: "to"})
    distance: float
    sigma: float
    v: float
    redundancy: float
    w: float
    detectable: float

    @property
    def name(self) -> str:
        return f"{self.start} to {self.end}"


@dataclass(frozen=True, slots=True)
class FiducialDistanceRecord:
    """Residual of a given distance between two fiducials of a camera, mm; residual and detectable error in µm."""

    camera: str
    start: str = field(metadata={KEY: "from"})
    end: str = field(metadata={KEY: "to"})
    mm: float
    sigma_mm: float
    v_um: float
    redundancy: float
    w: float
    detectable_um: float

    @property
    def name(self) -> str:
        return f"{self.start} to {self.end} of {self.camera}"

    @property
    def v(self) -> float:
        return self.v_um


@dataclass(frozen=True, slots=True)
class ObservedQuantity:
    """Residual of a quantity of an earlier calibration (mm) or of an antenna coordinate (object units)."""

    name: str
    value: float
    sigma: float
    v: float
    redundancy: float
    w: float
    detectable: float


@dataclass(frozen=True, slots=True)
class ContradictionDirection:
    """Value from the images minus observed value of a quantity, and its standard deviation."""

    name: ParameterText
    difference: float
    sigma: float


@dataclass(frozen=True, slots=True)
class ContradictionRecord:
    """Compatibility (F) test of the images with an earlier calibration.

    freedom: degrees of freedom of the numerator; direction: the quantities in contradiction, the most significant
    first.
    """

    F: float
    freedom: int
    p: float
    direction: tuple[ContradictionDirection, ...]


@dataclass(frozen=True, slots=True)
class NullDirectionRecord:
    """Null direction of a singular network: its parameters, cause and remedy."""

    parameters: tuple[ParameterText, ...]
    cause: str
    remedy: str


@dataclass(frozen=True, slots=True)
class CorrelationRecord:
    """Highly correlated quantities. rho: correlation."""

    parameters: tuple[ParameterText, ...]
    rho: float
    cause: str
    remedy: str


@dataclass(frozen=True, slots=True)
class SuspectRecord:
    """Suspected gross error (see `Suspect`); error in mm, object units or degrees."""

    name: str
    group: str
    owner: str
    point: str
    coordinates: tuple[str, ...]
    statistic: float
    size: int
    critical: float
    w: float
    tau: float
    critical_tau: float
    error: tuple[float, ...]
    alike: tuple[str, ...]
    removed: bool


@dataclass(frozen=True, slots=True)
class OuterRecord:
    """Outer reliability of a camera parameter: the effect of the worst undetected error, absolute and in sigmas."""

    parameter: ParameterText
    effect: float
    sigmas: float
    cause: str


@dataclass(frozen=True, slots=True)
class TestedGiven:
    """Test of a given coordinate, in mm, object units or degrees; see `Reliability`."""

    name: str
    group: str
    v: float
    sigma: float
    redundancy: float
    w: float
    tau: float
    smallest_error: float
    effect_sigmas: float


@dataclass(frozen=True, slots=True)
class ReliabilityRecord:
    """Inner and outer reliability (see `Reliability`).

    alpha, power, family: significance level and power of a single test, and family-wise level; outer: by camera
    parameter; unchecked: coordinates without redundancy; given: tests of given coordinates.
    """

    alpha: float
    power: float
    family: float
    critical_tau: float
    outer: tuple[OuterRecord, ...]
    unchecked: tuple[str, ...]
    given: tuple[TestedGiven, ...]
