"""frames.csv: writing read around each frame, by line, with the fields recognised in it."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from measure.annotations.fields import Field, Line, find_fields
from measure.results import FrameMeasurement
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.atomic import write_atomically
from pipeline.text.csv_table import csv_line

COLUMNS = ("image", "field", "text", "value", "confidence", "place", "col_px", "row_px")
HEAD = """# written about the frames, reseau {version}: as far as it was read. place: the side of the scan; col_px,
# row_px: of the line's middle, the centre of the top-left pixel being (0, 0). An ambiguous text has no value; a line
# that says no field is a text.
"""


def write_frames(path: Path, scans: Iterable[MeasuredScan]) -> bool:
    """Write frames.csv if any writing was read; returns whether it was. Raises InputError if writing fails."""
    rows = [csv_line(row) for scan in scans for row in _rows(scan.frame)]
    if rows:
        write_atomically(path, HEAD.format(version=version("reseau")) + "\n".join([csv_line(COLUMNS), *rows]) + "\n")
    return bool(rows)


def for_images(scans: Iterable[MeasuredScan], names: Sequence[str]) -> Mapping[str, Mapping[str, str]]:
    """Values of the named fields by image."""
    return {scan.frame.image: unique_fields(scan.frame.writing or (), names) for scan in scans}


def _rows(frame: FrameMeasurement) -> list[tuple[str, ...]]:
    rows = list[tuple[str, ...]]()
    lines = frame.writing or ()
    fields = find_fields(lines)
    for line in lines:
        own = [field for field in fields if field.line is line] or [Field("text", line.text, "", line)]
        col, row = line.center_px
        place = (f"{line.confidence:.2f}", line.side, f"{col:.0f}", f"{row:.0f}")
        rows += [(frame.image, field.name, field.text, field.value, *place) for field in own]
    return rows


def unique_fields(lines: Sequence[Line], names: Sequence[str]) -> dict[str, str]:
    """Values of the named fields that are unambiguous: read from one line, or alike from several."""
    fields = find_fields(lines)
    values = {name: {field.value for field in fields if field.name == name} for name in names}
    return {name: next(iter(own)) for name, own in values.items() if len(own) == 1 and "" not in own}
