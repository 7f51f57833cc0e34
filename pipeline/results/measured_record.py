"""Measurement of one scan: its record, the JSON and rows stored in the results database, and frames.csv: writing read
around each frame, by line, with the fields recognised in it."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import TypeAdapter

from measure.annotations.lines import Line, TextField, find_fields
from measure.flags import Cause, MeaningfulWord, Reason, Status
from measure.results import Covariance, FrameMeasurement, Kind, MarkMeasurement, ScanOrientation
from measure.tone.curve import power, srgb
from measure.tone.estimate import FrameTone
from pipeline.text.csv_table import csv_line
from pipeline.text.files import write_atomically
from pipeline.types import Array

_SRGB = "srgb"
Record = TypeVar("Record")
MARK_COLUMNS = (
    "point", "kind", "col_px", "row_px", "var_col", "var_row", "cov", "causes", "status", "reason_code", "reason",
    "quality",
)  # fmt: skip
_KINDS: Mapping[str, Kind] = {kind: kind for kind in get_args(Kind)}
_CAUSES: Mapping[str, Cause] = {str(cause): cause for cause in Cause}
_POSE, _LINES = TypeAdapter(ScanOrientation), TypeAdapter(tuple[Line, ...])


class FailureCode(MeaningfulWord):
    """Reason code of a scan that could not be measured."""

    MISSING = "missing", "There is no such file."
    UNREACHABLE = "unreachable", "A server did not deliver it, after some tries. It may be whole: `--retry`."
    UNREADABLE = "unreadable", "The file is damaged, or no picture that is read, or the system refused it."
    TOO_LARGE = "too-large", "The file claims more pixels than are read without `--max-pixels`."
    PITCH = "pitch", "Neither the project nor the file says what a pixel measures, and no marks tell it."
    MEMORY = "memory", "The memory was full."
    ENDED = "ended", "The process that measured it was ended, most likely because the memory was full."
    DAMAGED = "damaged", "Its stored result is damaged (digest differs) and is not used: `--retry`."
    FAULT = "fault", "A fault of the program itself."


@dataclass(frozen=True)
class Failure:
    """Failure to measure a scan. sentence: what happened, and the remedy."""

    code: FailureCode
    sentence: str


@dataclass(frozen=True)
class MeasuredScan:
    """Scan with its measured marks.

    Attributes
    ----------
    scan : path or address of the file.
    pitch_um : pixel pitch across and down.
    notes : remarks on the file that need no action.
    failure : why nothing was measured; all marks are then absent, size and pitch are 0 and NaN, and the sentence is a
        problem of the frame. None if the scan was measured.
    seconds : computing time; neither compared nor stored.
    reviewers : number of review decisions by reviewer.
    """

    scan: str
    width_px: int
    height_px: int
    pitch_um: tuple[float, float]
    frame: FrameMeasurement
    notes: tuple[str, ...] = ()
    failure: Failure | None = None
    seconds: float = field(default=0.0, compare=False)
    reviewers: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def failed(cls, scan: str, frame: FrameMeasurement, failure: Failure) -> "MeasuredScan":
        """Scan that could not be measured. frame: its marks, all absent."""
        return cls(scan, 0, 0, (math.nan, math.nan), frame, failure=failure)

    def changed(
        self, marks: Sequence[MarkMeasurement] | None = None, problems: Sequence[Reason] = (), notes: Sequence[str] = ()
    ) -> "MeasuredScan":
        """Copy with other marks, if given, and further problems and notes."""
        frame = self.frame
        marks = frame.marks if marks is None else tuple(marks)
        frame = replace(frame, marks=marks, problems=(*frame.problems, *problems))
        return replace(self, frame=frame, notes=(*self.notes, *notes))

    def change_status(self, kind: Kind | None, status: Status, reason: Reason) -> "MeasuredScan":
        """Copy in which the observed marks of a kind, or all, have another status."""
        return self.changed(
            [
                replace(mark, status=status, reason=reason)
                if kind in (mark.kind, None) and mark.status.is_observation
                else mark
                for mark in self.frame.marks
            ]
        )


# JSON has no non-finite numbers: they are written as strings that `float` reads.


def scan_detail(measured: MeasuredScan, uri: str) -> dict[str, object]:
    """Measurement of a scan without its marks, as JSON values. uri: of the file, as stored in the database."""
    frame = measured.frame
    detail: dict[str, object] = {
        "scan": uri,
        "width_px": measured.width_px,
        "height_px": measured.height_px,
        "pitch_um": _numbers(measured.pitch_um),
        "failure": measured.failure and {"code": str(measured.failure.code), "sentence": measured.failure.sentence},
        "pose": frame.pose and plain_json(frame.pose),
        # The text is the chosen reading, for other readers of the database.
        "writing": None if frame.writing is None else [{"text": one.text, **plain_json(one)} for one in frame.writing],
        "pixel_from_camera": _numbers(frame.pixel_from_camera),
        "weights": _numbers(frame.weights),
        "tone": frame.tone and _tone_json(frame.tone),
        "problems": list(frame.problems),
        "problem_codes": [problem.code for problem in frame.problems],
        "notes": list(measured.notes),
        "frame_notes": list(frame.notes),
    }
    return detail | ({"decided_by": dict(measured.reviewers)} if measured.reviewers else {})


def read_scan(image: str, detail: Mapping[str, Any], rows: Iterable[Sequence[Any]], scan: str) -> MeasuredScan:
    """Read the output of `scan_detail`, and rows of its marks. image: name; scan: path or address of the file.

    Raises KeyError, TypeError or ValueError for invalid content.
    """
    across, down = detail["pitch_um"]
    frame = FrameMeasurement(
        image=image,
        marks=tuple(map(_read_mark, rows)),
        pose=detail["pose"] and _POSE.validate_python(detail["pose"]),
        pixel_from_camera=None if detail["pixel_from_camera"] is None else _array(detail["pixel_from_camera"]),
        problems=tuple(map(Reason.read, detail["problems"], detail["problem_codes"])),
        weights=None if detail["weights"] is None else tuple(map(float, detail["weights"])),
        tone=detail["tone"] and _read_tone(detail["tone"]),
        writing=None if detail["writing"] is None else _LINES.validate_python(detail["writing"]),
        notes=tuple(detail.get("frame_notes", ())),
    )
    failure = detail["failure"] and Failure(FailureCode(detail["failure"]["code"]), detail["failure"]["sentence"])
    size = (int(detail["width_px"]), int(detail["height_px"]))
    pitch_um, notes = (float(across), float(down)), tuple(detail["notes"])
    return MeasuredScan(scan, *size, pitch_um, frame, notes, failure, reviewers=detail.get("decided_by", {}))


def scan_location(uri: str, folder: Path) -> str:
    """Path of a scan's file from its uri relative to the folder; addresses and "" are returned unchanged."""
    return uri if "://" in uri or not uri else str(folder / uri)


def mark_row(mark: MarkMeasurement) -> tuple[object, ...]:
    """Convert a mark to a row of MARK_COLUMNS. The sum of the covariances is for other readers of the database."""
    col, row = (None, None) if mark.center_px is None else mark.center_px.tolist()
    causes, variances = None, list[float | None]([None] * 3)
    if mark.covariance is not None:
        px2 = mark.covariance.px2
        variances = [finite_or_none(value) for value in (px2[0, 0], px2[1, 1], px2[0, 1])]
        parts = {str(cause): _numbers(part) for cause, part in mark.covariance.parts.items()}
        causes = json.dumps({"sum": _numbers(px2), "of": parts})
    quality = json.dumps({name: _numbers(value) for name, value in mark.quality.items()})
    reason = mark.reason
    return (mark.point, mark.kind, col, row, *variances, causes, str(mark.status), reason.code, str(reason), quality)


def _read_mark(row: Sequence[Any]) -> MarkMeasurement:
    """Read a mark from a row of MARK_COLUMNS."""
    point, kind, col, row_px, _, _, _, causes, status, code, reason, quality = row
    parts = json.loads(causes)["of"] if causes else None
    return MarkMeasurement(
        point=point,
        kind=_KINDS[kind],
        center_px=None if col is None else _array([col, row_px]),
        covariance=None if parts is None else _read_covariance(parts),
        status=Status(status),
        reason=Reason.read(reason, code),
        quality={name: float(value) for name, value in json.loads(quality).items()},
    )


def _read_covariance(parts: Mapping[str, Any]) -> Covariance:
    """Covariance of its parts by cause; causes that only earlier versions know count as noise."""
    covariance = Covariance({})
    for name, px2 in parts.items():
        covariance = covariance.plus(_CAUSES.get(name, Cause.NOISE), _array(px2))
    return covariance


def finite_or_none(value: float) -> float | None:
    """Replace a non-finite number by None, for columns that hold finite numbers only."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: Any) -> Any:
    """JSON of a number or nested array; non-finite numbers as strings."""
    if values is None:
        return None
    if np.ndim(values) > 0:
        return [_numbers(value) for value in values]
    number = float(values)
    return number if np.isfinite(number) else repr(number)


def plain_json(value: Any) -> Any:
    """JSON of a record with its mappings and sequences; fields that are not compared are left out."""
    if is_dataclass(value):
        return {each.name: plain_json(getattr(value, each.name)) for each in fields(value) if each.compare}
    if isinstance(value, Mapping):
        return {key: plain_json(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain_json(item) for item in value]
    return value if isinstance(value, str | int) else _numbers(value)


def read_plain(kind: type[Record], record: Mapping[str, Any]) -> Record:
    """Read the output of `plain_json`: a record of numbers, arrays, words and further records."""
    values: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        if (value := record.get(name)) is not None:
            inner: Any = next((each for each in (hint, *get_args(hint)) if is_dataclass(each)), None)
            if inner is not None:
                values[name] = read_plain(inner, value)
            else:
                values[name] = _array(value) if get_origin(hint) is np.ndarray else hint(value)
    return kind(**values)


def _array(values: Any) -> Array:
    return np.array(values, dtype=np.float64)


def _tone_json(tone: FrameTone) -> dict[str, object]:
    """JSON of a tone, its curve as its exponent, the name of sRGB, or its table of values."""
    base = tone.tone.base
    middle = len(base) // 2
    exponent = round(float(np.log(base[middle]) / np.log(middle / (len(base) - 1))), 9)
    curve = _SRGB if np.array_equal(base, srgb()) else _numbers(base)
    if np.array_equal(base, power(exponent)):
        curve = exponent
    return {**plain_json(tone), "tone": {**plain_json(tone.tone), "base": curve}}


def _read_tone(tone: Mapping[str, Any]) -> FrameTone:
    curve = tone["tone"]["base"]
    base = srgb() if curve == _SRGB else _array(curve) if isinstance(curve, list) else power(float(curve))
    return read_plain(FrameTone, {**tone, "tone": {**tone["tone"], "base": base}})


COLUMNS = ("image", "field", "text", "value", "confidence", "place", "col_px", "row_px")
HEAD = """# written about the frames, reseau {version}: as far as it was read. place: the side of the scan; col_px,
# row_px: of the line's middle, the centre of the top-left pixel being (0, 0). An ambiguous text has no value; a line
# that says no field is a text.
"""


def write_frames(path: Path, scans: Iterable[MeasuredScan]) -> bool:
    """Write frames.csv if any writing was read; returns whether it was. Raises InputError if writing fails."""
    rows = list[str]()
    for scan in scans:
        lines = scan.frame.writing or ()
        known = find_fields(lines)
        for line in lines:
            col, row = line.center_px
            place = (f"{line.confidence:.2f}", line.side, f"{col:.0f}", f"{row:.0f}")
            for each in [one for one in known if one.line is line] or [TextField("text", line.text, "", line)]:
                rows.append(csv_line((scan.frame.image, each.name, each.text, each.value, *place)))
    if rows:
        write_atomically(path, HEAD.format(version=version("reseau")) + "\n".join([csv_line(COLUMNS), *rows]) + "\n")
    return bool(rows)


def for_images(scans: Iterable[MeasuredScan], names: Sequence[str]) -> Mapping[str, Mapping[str, str]]:
    """Values of the named fields by image."""
    return {scan.frame.image: unique_fields(scan.frame.writing or (), names) for scan in scans}


def unique_fields(lines: Sequence[Line], names: Sequence[str]) -> dict[str, str]:
    """Values of the named fields that are unambiguous: read from one line, or alike from several."""
    fields = find_fields(lines)
    values = {name: {field.value for field in fields if field.name == name} for name in names}
    return {name: next(iter(own)) for name, own in values.items() if len(own) == 1 and "" not in own}
