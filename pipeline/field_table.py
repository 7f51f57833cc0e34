"""The table [field] of a scene file: disks on grids anywhere in space, disks one by one, or a planar board."""

import numpy as np
from numpy.typing import NDArray

from pipeline.tables import Table
from synthetic_images.scene import BoardField, DiskField, DiskTarget

Array = NDArray[np.float64]

UNITS_MM = {"m": 1000.0, "dm": 100.0, "cm": 10.0, "mm": 1.0}
KINDS = ("disks", "chessboard", "circle-grid")


def read_field(table: Table, unit: str, seed: int) -> DiskField | BoardField:
    """The test field. Sizes of targets and boards are mm, all coordinates in the unit. Raises InputError."""
    mm = 1.0 / UNITS_MM[unit]
    kind = table.text("kind", "disks", KINDS)
    if kind == "chessboard":
        square = table.number("square_mm", above=0.0) * mm
        return BoardField("chessboard", table.whole("columns", least=2), table.whole("rows", least=2), square)
    diameter = table.number("diameter_mm", above=0.0) * mm
    if kind == "circle-grid":
        return BoardField(
            "circle-grid",
            table.whole("columns", least=2),
            table.whole("rows", least=2),
            table.number("spacing_mm", above=0.0) * mm,
            diameter,
            table.flag("asymmetric", False),
        )
    generator = np.random.default_rng([seed, 10])
    targets = [target for grid in table.tables("grid") for target in _grid_targets(grid, generator)]
    targets += [_target(entry) for entry in table.tables("target")]
    if not targets:
        raise table.error("grid", "the field has no target. Add [[field.grid]] or [[field.target]].")
    return DiskField(tuple(targets), diameter, table.number("surround", 2.0, least=0.0))


def _grid_targets(table: Table, generator: np.random.Generator) -> list[DiskTarget]:
    """Targets about a centre, row by row from the bottom, each moved at random within its cell and out of the plane."""
    first = table.whole("first")
    columns, rows = table.whole("columns", least=1), table.whole("rows", least=1)
    center = np.array(table.triple("center", (0.0, 0.0, 0.0)))
    right, up = np.array(table.triple("right")), np.array(table.triple("up"))
    jitter, relief = table.number("jitter", 0.0, least=0.0), table.number("relief", 0.0, least=0.0)
    normal = np.cross(right, up)
    if not np.linalg.norm(normal) > 0.0:
        raise table.error("up", "must not be parallel to right: the two steps span the grid's plane.")
    normal /= np.linalg.norm(normal)
    table.done()
    row, column = np.divmod(np.arange(rows * columns), columns)
    across = column - (columns - 1) / 2 + generator.uniform(-jitter, jitter, len(row))
    along = row - (rows - 1) / 2 + generator.uniform(-jitter, jitter, len(row))
    height = generator.uniform(-relief, relief, len(row))
    places: Array = center + across[:, None] * right + along[:, None] * up + height[:, None] * normal
    # Whole micro-units: a field that is surveyed has coordinates that can be written down.
    return [DiskTarget(str(first + i), _triple(np.round(place, 6)), _triple(normal)) for i, place in enumerate(places)]


def _target(table: Table) -> DiskTarget:
    target = DiskTarget(table.text("id"), table.triple("xyz"), table.triple("normal", (0.0, 0.0, 1.0)))
    table.done()
    return target


def _triple(vector: Array) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
