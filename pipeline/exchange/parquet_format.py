"""Parquet: the tables of this program with their types."""

import io

from pipeline.errors import missing_extra
from pipeline.exchange.block import Block
from pipeline.exchange.convention import ExportOptions, Written
from pipeline.exchange.tables import CONVENTION as CONVENTION
from pipeline.exchange.tables import Table, tables


def write(block: Block, options: ExportOptions) -> Written:
    """A file a table. Raises InputError where pyarrow is not installed."""
    return Written({f"{name}.parquet": _bytes(table) for name, table in tables(block).items()})


def _bytes(table: Table) -> bytes:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise missing_extra("the format parquet", "pyarrow", "parquet") from None
    made = pyarrow.table(table).replace_schema_metadata({"conventions": CONVENTION.axes})
    written = io.BytesIO()
    pyarrow.parquet.write_table(made, written)
    return written.getvalue()
