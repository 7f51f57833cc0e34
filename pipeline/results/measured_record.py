"""What one scan gave: the value that measuring hands on, and that files keep."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from measure.annotations.fields import Line, Reading
from measure.flags import Cause, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose
from measure.tone.curve import Tone, ToneInformation, power, srgb
from measure.tone.estimate import FrameTone
from pipeline.types import Array

Json = dict[str, Any]

_SRGB = "srgb"


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


# What one scan gave as JSON, without loss: one writer and one reader, whatever file it stands in.
#
# Numbers that are not finite, which JSON has not, stand there by their names, as `float` reads them.


def record_of(measured: MeasuredScan, folder: Path) -> Json:
    """A scan as JSON. folder: that the paths of scans are relative to, so that a whole project can be moved."""
    frame = measured.frame
    return {
        "scan": measured.scan if _is_address(measured.scan) else _relative(Path(measured.scan), folder),
        "width_px": measured.width_px,
        "height_px": measured.height_px,
        "pitch_um": _numbers(measured.pitch_um),
        "failure": measured.failure and {"code": str(measured.failure.code), "sentence": measured.failure.sentence},
        "pose": frame.pose and pose_record(frame.pose),
        "writing": None if frame.writing is None else [_line(line) for line in frame.writing],
        "pixel_from_camera": _numbers(frame.pixel_from_camera),
        "weights": _numbers(frame.weights),
        "tone": frame.tone and _frame_tone(frame.tone),
        "problems": list(frame.problems),
        "problem_codes": [problem.code for problem in frame.problems],
        "notes": list(measured.notes),
        **({"decided_by": dict(measured.decided_by)} if measured.decided_by else {}),
        "marks": [_mark(mark) for mark in frame.marks],
    }


def scan_of(image: str, record: Mapping[str, Any], folder: Path) -> MeasuredScan:
    """The scan of a record; image: its name. Raises KeyError, TypeError or ValueError for what is no such record."""
    across, down = record["pitch_um"]
    frame = FrameMeasurement(
        image=image,
        marks=tuple(_read_mark(mark) for mark in record["marks"]),
        pose=record["pose"] and _read_pose(record["pose"]),
        pixel_from_camera=_array(record["pixel_from_camera"]),
        problems=tuple(map(Reason.read, record["problems"], record["problem_codes"])),
        weights=None if record["weights"] is None else tuple(map(float, record["weights"])),
        tone=record["tone"] and _read_frame_tone(record["tone"]),
        writing=None if record["writing"] is None else tuple(_read_line(line) for line in record["writing"]),
    )
    failure = record["failure"] and Failure(FailureCode(record["failure"]["code"]), record["failure"]["sentence"])
    scan = record["scan"] if _is_address(record["scan"]) else str(folder / record["scan"])
    size = (int(record["width_px"]), int(record["height_px"]))
    pitch_um, notes = (float(across), float(down)), tuple(record["notes"])
    return MeasuredScan(scan, *size, pitch_um, frame, notes, failure, decided_by=record.get("decided_by", {}))


def _is_address(scan: str) -> bool:
    """Of an object in a store or on a server; "" names none at all."""
    return "://" in scan or not scan


def _relative(scan: Path, folder: Path) -> str:
    return Path(os.path.relpath(scan.resolve(), folder.resolve())).as_posix()


def _numbers(values: Any) -> Any:
    """Of a number, or of arrays of them."""
    if values is None:
        return None
    if np.ndim(values) > 0:
        return [_numbers(value) for value in values]
    number = float(values)
    return number if np.isfinite(number) else repr(number)


def _array(values: Any) -> Array | None:
    return None if values is None else np.array(values, dtype=np.float64)


def _some(values: Any) -> Array:
    return np.array(values, dtype=np.float64)


def _mark(mark: MarkMeasurement) -> Json:
    col, row = (None, None) if mark.center_px is None else _numbers(mark.center_px)
    causes = mark.covariance and {str(cause): _numbers(part) for cause, part in mark.covariance.parts.items()}
    return {
        "point": mark.point,
        "kind": mark.kind,
        "col_px": col,
        "row_px": row,
        "covariance_px2": _numbers(mark.covariance_px2),
        "causes_px2": causes,
        "status": str(mark.status),
        "reason": mark.reason,
        "reason_code": mark.reason.code,
        "quality": {name: _numbers(value) for name, value in mark.quality.items()},
    }


def _read_mark(mark: Mapping[str, Any]) -> MarkMeasurement:
    """The sum of the causes is written for others than this reader."""
    causes = mark["causes_px2"]
    return MarkMeasurement(
        point=mark["point"],
        kind=mark["kind"],
        center_px=None if mark["col_px"] is None else _some([mark["col_px"], mark["row_px"]]),
        covariance=None if causes is None else Covariance({Cause(name): _some(px2) for name, px2 in causes.items()}),
        status=Status(mark["status"]),
        reason=Reason.read(mark["reason"], mark["reason_code"]),
        quality={name: float(value) for name, value in mark["quality"].items()},
    )


def pose_record(pose: Pose) -> Json:
    """A pose with its evidence as JSON."""
    return {
        "name": pose.name,
        "decided": pose.decided,
        "evidence": list(pose.evidence),
        "written": {name: _numbers(value) for name, value in pose.written.items()},
        "writing": pose.writing,
        "roll": pose.roll,
        "rivals": list(pose.rivals),
    }


def _read_pose(pose: Mapping[str, Any]) -> Pose:
    written = {name: float(value) for name, value in pose["written"].items()}
    evidence, rivals = tuple(pose["evidence"]), tuple(pose["rivals"])
    return Pose(pose["name"], pose["decided"], evidence, written, pose["writing"], pose["roll"], rivals)


def _line(line: Line) -> Json:
    """The text of the way that is taken for the right one is written for others than this reader."""
    ways = {pose: {"text": one.text, "confidence": _numbers(one.confidence), "legible": _numbers(one.legible)}
            for pose, one in line.ways.items()}  # fmt: skip
    outline = [_numbers(corner) for corner in line.outline_px]
    return {"text": line.text, "pose": line.pose, "side": line.side, "outline_px": outline, "ways": ways}


def _read_line(line: Mapping[str, Any]) -> Line:
    ways = {
        pose: Reading(one["text"], float(one["confidence"]), float(one["legible"]))
        for pose, one in line["ways"].items()
    }
    outline = tuple((float(col), float(row)) for col, row in line["outline_px"])
    return Line(ways, line["pose"], outline, line["side"])


def _frame_tone(tone: FrameTone) -> Json:
    believed = tone.tone
    return {
        "base": _base(believed.base),
        "mean": _numbers(believed.mean),
        "covariance": _numbers(believed.covariance),
        "source": believed.source,
        "is_declared": believed.is_declared,
        "said": tone.information and tone_information_record(tone.information),
        "least": _numbers(tone.least),
        "greatest": _numbers(tone.greatest),
        "scatter": _numbers(tone.scatter),
        "apart": _numbers(tone.apart),
    }


def _read_frame_tone(tone: Mapping[str, Any]) -> FrameTone:
    mean, covariance = _some(tone["mean"]), _some(tone["covariance"])
    believed = Tone(_read_base(tone["base"]), mean, covariance, tone["source"], tone["is_declared"])
    said = tone["said"] and read_tone_information(tone["said"])
    numbers = (float(tone[name]) for name in ("least", "greatest", "scatter", "apart"))
    return FrameTone(believed, said, *numbers)


def _base(base: Array) -> Any:
    """The exponent of a power, the name of sRGB's curve, or a thousand numbers."""
    middle = len(base) // 2
    exponent = round(float(np.log(base[middle]) / np.log(middle / (len(base) - 1))), 9)
    if np.array_equal(base, power(exponent)):
        return exponent
    return _SRGB if np.array_equal(base, srgb()) else _numbers(base)


def _read_base(base: Any) -> Array:
    if base == _SRGB:
        return srgb()
    return _some(base) if isinstance(base, list) else power(float(base))


def tone_information_record(said: ToneInformation) -> Json:
    return {
        "information": _numbers(said.matrix),
        "right": _numbers(said.right_side),
        "square": _numbers(said.sum_of_squares),
        "count": said.count,
        "alike": _numbers(said.common_variance),
    }


def read_tone_information(said: Mapping[str, Any]) -> ToneInformation:
    information, right = _some(said["information"]), _some(said["right"])
    return ToneInformation(information, right, float(said["square"]), int(said["count"]), float(said["alike"]))
