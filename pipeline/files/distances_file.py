"""distances.csv: measured distances and scale bars between points or stations."""

from dataclasses import dataclass
from pathlib import Path

from adjust.problem.observations import Distance
from pipeline.errors import InputError
from pipeline.text.csv_table import Row, read_csv

COLUMNS = ("from", "to", "distance", "sigma")


@dataclass(frozen=True)
class GivenDistance:
    """A distance and its line in the file, for messages."""

    distance: Distance
    row: Row


def read_distances(path: Path) -> tuple[GivenDistance, ...]:
    """Read distances.csv, in the unit of the object coordinates. Raises InputError naming line and column."""
    distances = tuple(GivenDistance(_distance(row), row) for row in read_csv(path, COLUMNS))
    if not distances:
        raise InputError(f"{path}: holds no distance, only a header.")
    return distances


def _distance(row: Row) -> Distance:
    start, end = row.name("from"), row.name("to")
    if start == end:
        raise row.error("to", f"{end!r} stands at both ends. Give two points, or two images for their stations.")
    value, sigma = _positive(row, "distance"), row.sigma("sigma")
    if sigma is None:
        raise row.error("sigma", "is blank: every distance needs its standard deviation.")
    if sigma == 0.0:
        raise row.error(
            "sigma",
            "is 0, but an exact distance is not offered. Give it a hundredth of the standard deviations of its ends.",
        )
    return Distance(start, end, value, sigma)


def _positive(row: Row, column: str) -> float:
    value = row.number(column)
    if value is None or value <= 0.0:
        raise row.error(column, f"must be a positive length, not {row.text(column)!r}.")
    return value
