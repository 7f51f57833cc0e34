"""What `adjustment.json` holds of residuals, tests and reliability: one class a table of the file."""

from dataclasses import dataclass, field
from typing import Annotated

from adjust.problem.parameter import parameter_from_text
from pipeline.results.record_json import KEY

ParameterText = Annotated[str, parameter_from_text]  # as `Parameter.text`


@dataclass(frozen=True, slots=True)
class ResidualRecord:
    """An observation: its residual in the scan and in the camera, and what tests it. w: of the axis that fits worse."""

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
    """A given distance, in the unit of the object coordinates; see `FurtherResidual`."""

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
    """A given distance between two fiducials of a camera, mm; its residual and detectable error in µm."""

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
    """A quantity of an earlier calibration (mm) or a coordinate of an antenna (object unit), as observed."""

    name: str
    value: float
    sigma: float
    v: float
    redundancy: float
    w: float
    detectable: float


@dataclass(frozen=True, slots=True)
class ContradictionDirection:
    """Where the images put a quantity less where it was observed, with the standard deviation of that."""

    name: ParameterText
    difference: float
    sigma: float


@dataclass(frozen=True, slots=True)
class ContradictionRecord:
    """An earlier calibration as a whole: whether the images contradict it, and in what, the most telling first."""

    F: float
    freedom: int
    p: float
    direction: tuple[ContradictionDirection, ...]


@dataclass(frozen=True, slots=True)
class NullDirectionRecord:
    """What the observations cannot see: what moves together, why, and what would remove it."""

    parameters: tuple[ParameterText, ...]
    cause: str
    remedy: str


@dataclass(frozen=True, slots=True)
class CorrelationRecord:
    """Quantities that the observations hardly separate."""

    parameters: tuple[ParameterText, ...]
    rho: float
    cause: str
    remedy: str


@dataclass(frozen=True, slots=True)
class SuspectRecord:
    """A suspect observation (see `Suspect`); its error in mm, object units or degrees."""

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
    """What the worst undetected error does to a camera parameter."""

    parameter: ParameterText
    effect: float
    sigmas: float
    cause: str


@dataclass(frozen=True, slots=True)
class TestedGiven:
    """A given coordinate, tested, in mm, object units or degrees."""

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
    """What the observations check, and what an undetected error would do (see `Reliability`)."""

    alpha: float
    power: float
    family: float
    critical_tau: float
    outer: tuple[OuterRecord, ...]
    unchecked: tuple[str, ...]
    given: tuple[TestedGiven, ...]
