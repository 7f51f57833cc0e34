"""Residuals, tests and reliability in `adjustment.json`: one class per table of the file."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import AfterValidator, Field

from pipeline.results.record_json import Flag, Number, NumberOrNone, Whole, read_parameter

ParameterText = Annotated[str, AfterValidator(lambda text: read_parameter(text).text)]  # as `Parameter.text`


@dataclass(frozen=True, slots=True)
class ResidualRecord:
    """Residual of an image observation, with its tests.

    Attributes
    ----------
    w_x, w_y, w : standardised residuals by axis, and that of larger absolute value.
    weight : weight factor of the robust estimation, 1 if it was not used.
    camera_x_mm, camera_y_mm, camera_vx_um, camera_vy_um : camera coordinates and the residual in them.
    tau_x, tau_y, statistic, smallest_error_x_um, smallest_error_y_um, effect_sigmas : see `Reliability`; effect_sigmas
        is the larger of both axes. None if the reliability was not computed.
    """

    image: str
    point: str
    kind: str
    vx_um: Number
    vy_um: Number
    redundancy_x: Number
    redundancy_y: Number
    w: Number
    w_x: Number
    w_y: Number
    weight: Number
    sx_um: Number
    sy_um: Number
    x_mm: Number
    y_mm: Number
    camera_x_mm: Number
    camera_y_mm: Number
    camera_vx_um: Number
    camera_vy_um: Number
    tau_x: NumberOrNone = None
    tau_y: NumberOrNone = None
    statistic: NumberOrNone = None
    smallest_error_x_um: NumberOrNone = None
    smallest_error_y_um: NumberOrNone = None
    effect_sigmas: NumberOrNone = None

    @property
    def v_um(self) -> tuple[float, float]:
        return self.vx_um, self.vy_um


@dataclass(frozen=True, slots=True)
class DistanceRecord:
    """Residual of a given distance, object units; see `FurtherResidual`."""

    start: Annotated[str, Field(alias="from")]
    end: Annotated[str, Field(alias="to")]
    distance: Number
    sigma: Number
    v: Number
    redundancy: Number
    w: Number
    detectable: Number

    @property
    def name(self) -> str:
        return f"{self.start} to {self.end}"


@dataclass(frozen=True, slots=True)
class FiducialDistanceRecord:
    """Residual of a given distance between two fiducials of a camera, mm; residual and detectable error in µm."""

    camera: str
    start: Annotated[str, Field(alias="from")]
    end: Annotated[str, Field(alias="to")]
    mm: Number
    sigma_mm: Number
    v_um: Number
    redundancy: Number
    w: Number
    detectable_um: Number

    @property
    def name(self) -> str:
        return f"{self.start} to {self.end} of {self.camera}"

    @property
    def v(self) -> float:
        return self.v_um


@dataclass(frozen=True, slots=True)
class ObservedQuantity:
    """Residual of a quantity of an earlier calibration, mm."""

    name: str
    value: Number
    sigma: Number
    v: Number
    redundancy: Number
    w: Number
    detectable: Number


@dataclass(frozen=True, slots=True)
class ContradictionDirection:
    """Value from the images minus observed value of a quantity, and its standard deviation."""

    name: ParameterText
    difference: Number
    sigma: Number


@dataclass(frozen=True, slots=True)
class ContradictionRecord:
    """Compatibility (F) test of the images with an earlier calibration.

    freedom: degrees of freedom of the numerator; direction: the quantities in contradiction, the most significant
    first.
    """

    F: Number
    freedom: Whole
    p: Number
    direction: tuple[ContradictionDirection, ...]


@dataclass(frozen=True, slots=True)
class SuspectRecord:
    """Suspected gross error (see `Suspect`); error in mm, object units or degrees."""

    name: str
    group: str
    owner: str
    point: str
    coordinates: tuple[str, ...]
    statistic: Number
    size: Whole
    critical: Number
    w: Number
    tau: Number
    critical_tau: Number
    error: tuple[Number, ...]
    alike: tuple[str, ...]
    removed: Flag


@dataclass(frozen=True, slots=True)
class OuterRecord:
    """Outer reliability of a camera parameter: the effect of the worst undetected error, absolute and in sigmas."""

    parameter: ParameterText
    effect: Number
    sigmas: Number
    cause: str


@dataclass(frozen=True, slots=True)
class TestedGiven:
    """Test of a given coordinate, in mm, object units or degrees; see `Reliability`."""

    name: str
    group: str
    v: Number
    sigma: Number
    redundancy: Number
    w: Number
    tau: Number
    smallest_error: Number
    effect_sigmas: Number


@dataclass(frozen=True, slots=True)
class ReliabilityRecord:
    """Inner and outer reliability (see `Reliability`).

    alpha, power, family: significance level and power of a single test, and family-wise level; outer: by camera
    parameter; unchecked: coordinates without redundancy; given: tests of given coordinates.
    """

    alpha: Number
    power: Number
    family: Number
    critical_tau: Number
    outer: tuple[OuterRecord, ...]
    unchecked: tuple[str, ...]
    given: tuple[TestedGiven, ...]
