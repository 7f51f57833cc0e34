"""What one scan gave: the value that measuring hands on, and that files keep."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from measure.results import FrameMeasurement


class FailureCode(StrEnum):
    """Why a scan could not be measured at all, in a word that one can filter by."""

    MISSING = "missing"
    UNREACHABLE = "unreachable"
    UNREADABLE = "unreadable"
    TOO_LARGE = "too-large"
    PITCH = "pitch"
    MEMORY = "memory"
    ENDED = "ended"
    DAMAGED = "damaged"
    FAULT = "fault"


MEANING = {
    FailureCode.MISSING: "There is no such file.",
    FailureCode.UNREACHABLE: "A store or a server did not give it, after some tries. It may be whole: `--retry`.",
    FailureCode.UNREADABLE: "The file is damaged, or no picture that is read, or the system refused it.",
    FailureCode.TOO_LARGE: "The file claims more pixels than are read without `--max-pixels`.",
    FailureCode.PITCH: "Neither the project nor the file says what a pixel measures, and no marks tell it.",
    FailureCode.MEMORY: "The memory was full.",
    FailureCode.ENDED: "The process that measured it was ended, most likely because the memory was full.",
    FailureCode.DAMAGED: "What is stored of it was changed or is damaged, and is not used: `--retry`.",
    FailureCode.FAULT: "A fault of the program itself.",
}


@dataclass(frozen=True)
class Failure:
    """code: from the table above; sentence: what happened, and what to do."""

    code: FailureCode
    sentence: str


@dataclass(frozen=True)
class MeasuredScan:
    """A scan and what was measured in it.

    scan: the path or the address of its file. pitch_um: what a pixel measures, across and down. notes: what is worth
    knowing of the file, and needs no action. failure: why nothing was measured; then every mark of the frame is absent,
    size and pitch are not known (0 and NaN), and the sentence is the frame's problem. seconds: that measuring took; no
    part of what was measured, and of no record. decided_by: how many decisions of whom stand behind it.
    """

    scan: str
    width_px: int
    height_px: int
    pitch_um: tuple[float, float]
    frame: FrameMeasurement
    notes: tuple[str, ...] = ()
    failure: Failure | None = None
    seconds: float = field(default=0.0, compare=False)
    decided_by: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def failed(cls, scan: str, frame: FrameMeasurement, failure: Failure) -> "MeasuredScan":
        """frame: its marks, none of them measured."""
        return cls(scan, 0, 0, (math.nan, math.nan), frame, failure=failure)
