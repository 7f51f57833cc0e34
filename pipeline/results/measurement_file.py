"""measurement.json: what comparator.csv has no room for: poses and their evidence, covariances, qualities, problems."""

import json
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from measure.covariance import Cause, Covariance
from measure.results import FrameMeasurement, MarkMeasurement, Pose
from measure.status import Status
from measure.writing.line import Line, Reading
from pipeline.errors import InputError
from pipeline.results.measured_scan import MeasuredScan
from pipeline.text.atomic import write_atomically
from pipeline.text.text_file import read_json


def write_measurement(
    path: Path, scans: Sequence[MeasuredScan], folder: Path | None = None, made_from: Mapping[str, str] | None = None
) -> None:
    """Write measurement.json. Raises InputError where it cannot be written.

    folder: where it is to stand, if not at `path`. made_from: fingerprints of what was measured and how.
    """
    images = {scan.frame.image: _image(scan, folder or path.parent) for scan in scans}
    content = {"reseau": version("reseau"), "made_from": dict(made_from or {}), "images": images}
    write_atomically(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_measurement(path: Path, folder: Path | None = None) -> tuple[MeasuredScan, ...]:
    """Read it back. Raises InputError for a file that is broken. folder: as above."""
    try:
        images = read_json(path)["images"]
        return tuple(_measured(name, image, folder or path.parent) for name, image in images.items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read as a measurement ({error}). Run `reseau measure` again.") from error


def read_covariance(mark: Mapping[str, Any]) -> Covariance | None:
    """The covariance of an entry of `marks`, by its causes; None where nothing was fitted."""
    causes = mark.get("causes_px2")
    return None if causes is None else Covariance({Cause(name): np.array(px2) for name, px2 in causes.items()})


def _image(measured: MeasuredScan, folder: Path) -> dict[str, Any]:
    frame = measured.frame
    matrix = frame.pixel_from_camera
    return {
        "scan": _relative(measured.scan, folder),
        "width_px": measured.width_px,
        "height_px": measured.height_px,
        "pitch_um": list(measured.pitch_um),
        "pose": None if frame.pose is None else _pose(frame.pose),
        "writing": None if frame.writing is None else [_line(line) for line in frame.writing],
        "pixel_from_camera": None if matrix is None else matrix.tolist(),
        "problems": list(frame.problems),
        "notes": list(measured.notes),
        "marks": [_mark(mark) for mark in frame.marks],
    }


def _relative(scan: Path, folder: Path) -> str:
    """Relative to the output folder, so that a whole project can be moved."""
    return Path(os.path.relpath(scan.resolve(), folder.resolve())).as_posix()


def _line(line: Line) -> dict[str, Any]:
    ways = {pose: vars(reading) for pose, reading in line.ways.items()}
    return {"text": line.text, "pose": line.pose, "side": line.side, "outline_px": line.outline_px, "ways": ways}


def _pose(pose: Pose) -> dict[str, Any]:
    return {"name": pose.name, "decided": pose.decided, "evidence": list(pose.evidence), "roll": pose.roll}


def _mark(mark: MarkMeasurement) -> dict[str, Any]:
    col, row = (None, None) if mark.center_px is None else (float(value) for value in mark.center_px)
    return {
        "point": mark.point,
        "kind": mark.kind,
        "col_px": col,
        "row_px": row,
        "covariance_px2": None if mark.covariance_px2 is None else mark.covariance_px2.tolist(),
        "causes_px2": None if mark.covariance is None else _causes(mark.covariance),
        "status": str(mark.status),
        "reason": mark.reason,
        "quality": {name: float(value) for name, value in mark.quality.items() if np.isfinite(value)},
    }


def _causes(covariance: Covariance) -> dict[str, Any]:
    return {str(cause): part.tolist() for cause, part in covariance.parts.items()}


def _measured(name: str, image: Mapping[str, Any], folder: Path) -> MeasuredScan:
    pose, matrix = image["pose"], image["pixel_from_camera"]
    frame = FrameMeasurement(
        image=name,
        marks=tuple(_read_mark(mark) for mark in image["marks"]),
        pose=None if pose is None else _read_pose(pose),
        pixel_from_camera=None if matrix is None else np.array(matrix, dtype=np.float64),
        problems=tuple(image["problems"]),
        writing=None if image.get("writing") is None else tuple(_read_line(line) for line in image["writing"]),
    )
    pitch = image["pitch_um"]
    size = (image["width_px"], image["height_px"])
    return MeasuredScan(folder / image["scan"], *size, (pitch[0], pitch[1]), frame, tuple(image.get("notes", ())))


def _read_pose(pose: Mapping[str, Any]) -> Pose:
    return Pose(pose["name"], pose["decided"], tuple(pose["evidence"]), roll=pose.get("roll", ""))


def _read_line(line: Mapping[str, Any]) -> Line:
    ways = {pose: Reading(**reading) for pose, reading in line["ways"].items()}
    return Line(ways, line["pose"], tuple((col, row) for col, row in line["outline_px"]), line["side"])


def _read_mark(mark: Mapping[str, Any]) -> MarkMeasurement:
    return MarkMeasurement(
        point=mark["point"],
        kind=mark["kind"],
        center_px=None if mark["col_px"] is None else np.array([mark["col_px"], mark["row_px"]]),
        covariance=read_covariance(mark),
        status=Status(mark["status"]),
        reason=mark["reason"],
        quality=mark["quality"],
    )
