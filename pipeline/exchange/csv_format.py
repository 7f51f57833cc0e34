"""CSV: the tables of this program as text."""

from pipeline.exchange.block import Block
from pipeline.exchange.convention import ExportOptions, Written
from pipeline.exchange.tables import CONVENTION as CONVENTION
from pipeline.exchange.tables import Table, tables
from pipeline.text.csv_table import csv_line


def write(block: Block, options: ExportOptions) -> Written:
    """A file a table; numbers with all their digits."""
    return Written({f"{name}.csv": _text(table) for name, table in tables(block).items()})


def _text(table: Table) -> str:
    head = f"# {CONVENTION.axes}; the CENTRE of the top-left pixel is (0, 0)"
    rows = zip(*table.values(), strict=True)
    return "\n".join([head, csv_line(list(table)), *(csv_line([_cell(value) for value in row]) for row in rows)]) + "\n"


def _cell(value: object) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)
