"""frames.csv: what is written about each frame, line by line, with the fields that are understood."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from measure.results import FrameMeasurement
from measure.writing.fields import Field, fields_of
from pipeline.results.measured_scan import MeasuredScan
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import csv_line

COLUMNS = ("image", "field", "text", "value", "confidence", "place", "col_px", "row_px")
HEAD = """# written about the frames, reseau {version}: as far as it was read. place: the side of the scan; col_px,
# row_px: of the line's middle, the centre of the top-left pixel being (0, 0). An ambiguous text has no value; a line
# that says no field is a text.
"""
_SAME = ("run", "frames", "date")  # that name a frame together with its number


def write_frames(path: Path, scans: Sequence[MeasuredScan]) -> bool:
    """Write frames.csv, and say so, where anything was read. Raises InputError where it cannot be written."""
    rows = [csv_line(row) for scan in scans for row in _rows(scan.frame)]
    if rows:
        write_atomically(path, HEAD.format(version=version("reseau")) + "\n".join([csv_line(COLUMNS), *rows]) + "\n")
    return bool(rows)


def with_same_frames(scans: Sequence[MeasuredScan]) -> list[MeasuredScan]:
    """The scans, with a problem where another one says that it is the same frame."""
    named: dict[tuple[tuple[str, str], ...], list[str]] = {}
    names = {scan.frame.image: _name(scan.frame) for scan in scans}
    for image, name in names.items():
        if name:
            named.setdefault(name, []).append(image)
    return [_told(scan, names[scan.frame.image], named) for scan in scans]


def for_images(scans: Sequence[MeasuredScan], names: Sequence[str]) -> Mapping[str, Mapping[str, str]]:
    """By image the fields of these names, as far as one line says them, or several alike."""
    return {scan.frame.image: _values(fields_of(scan.frame.writing or ()), names) for scan in scans}


def _rows(frame: FrameMeasurement) -> list[tuple[str, ...]]:
    rows = list[tuple[str, ...]]()
    lines = frame.writing or ()
    fields = fields_of(lines)
    for line in lines:
        own = [field for field in fields if field.line is line] or [Field("text", line.text, "", line)]
        col, row = line.center_px
        place = (f"{line.confidence:.2f}", line.side, f"{col:.0f}", f"{row:.0f}")
        rows += [(frame.image, field.name, field.text, field.value, *place) for field in own]
    return rows


def _name(frame: FrameMeasurement) -> tuple[tuple[str, str], ...]:
    """What names the frame: its number, and the run, its frames or the date, as far as they are known."""
    values = _values(fields_of(frame.writing or ()), ("frame", *_SAME))
    return tuple(values.items()) if "frame" in values and len(values) > 1 else ()


def _values(fields: Sequence[Field], names: Sequence[str]) -> dict[str, str]:
    """The fields of these names that have one value."""
    values = {name: {field.value for field in fields if field.name == name} for name in names}
    return {name: next(iter(own)) for name, own in values.items() if len(own) == 1 and "" not in own}


def _told(
    scan: MeasuredScan, name: tuple[tuple[str, str], ...], named: Mapping[tuple[tuple[str, str], ...], list[str]]
) -> MeasuredScan:
    others = [image for image in named.get(name, ()) if image != scan.frame.image]
    if not name or not others:
        return scan
    told = ", ".join(f"{field} {value}" for field, value in name)
    problem = (
        f"its writing says {told}, and so does that of {' and '.join(others)}: these are scans of one frame, or a line "
        "is misread. Leave one of them out, or look at frames.csv."
    )
    return replace(scan, frame=replace(scan.frame, problems=(*scan.frame.problems, problem)))
