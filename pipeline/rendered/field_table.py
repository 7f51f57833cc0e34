"""The table [field] of a scene: disks, crosses or ring-coded disks, on grids in space or one by one, or a planar
board."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from measure.targets.ring_codes import RingCode
from pipeline.files.project_tables import UNITS_MM
from pipeline.text.tables import Table
from synthetic_images.scene import BoardField, CrossFigure, DiskField, DiskTarget, RingFigure

Array = NDArray[np.float64]

KINDS = ("disks", "crosses", "coded-rings", "chessboard", "circle-grid", "natural")


def read_field(table: Table, unit: str, seed: int) -> DiskField | BoardField:
    """Read the test field; a field of kind natural has no targets.

    Sizes of targets and boards are in mm, coordinates in the unit. Raises InputError.
    """
    mm = 1.0 / UNITS_MM[unit]
    kind = table.text("kind", "disks", KINDS)
    if kind == "natural":
        return DiskField((), 1.0)
    if kind == "chessboard":
        square = table.number("square_mm", above=0.0) * mm
        return BoardField("chessboard", table.whole("columns", least=2), table.whole("rows", least=2), square)
    if kind == "crosses":
        arm, line = table.number("arm_mm", above=0.0), table.number("line_mm", above=0.0)
        return _field(table, seed, 2.0 * arm * mm, CrossFigure(line / arm))
    diameter = table.number("diameter_mm", above=0.0) * mm
    if kind == "coded-rings":
        return _coded_field(table, seed, diameter)
    if kind == "circle-grid":
        return BoardField(
            "circle-grid",
            table.whole("columns", least=2),
            table.whole("rows", least=2),
            table.number("spacing_mm", above=0.0) * mm,
            diameter,
            table.flag("asymmetric", False),
        )
    return _field(table, seed, diameter)


def _field(table: Table, seed: int, diameter: float, figure: CrossFigure | None = None) -> DiskField:
    generator = np.random.default_rng([seed, 10])
    targets = [target for grid in table.tables("grid") for target in _grid_targets(grid, generator)]
    targets += [target for scatter in table.tables("scatter") for target in _scattered_targets(scatter, generator)]
    targets += [_target(entry) for entry in table.tables("target")]
    if not targets:
        raise table.error("grid", "the field has no target. Add [[field.grid]], [[field.scatter]] or [[field.target]].")
    return DiskField(tuple(targets), diameter, table.number("surround", 2.0, least=0.0), figure)


def _coded_field(table: Table, seed: int, diameter: float) -> DiskField:
    """Every n-th disk has a ring code, and its number as its name."""
    default = RingCode()
    code = RingCode(table.whole("bits", default.bits), table.pair("ring", default.ring))
    every = table.whole("every", 1, least=1)
    field = _field(table, seed, diameter)
    numbers = code.published_numbers()
    coded = range(0, len(field.targets), every)
    if len(coded) > len(numbers):
        raise table.error("bits", f"{code.bits} bits have {len(numbers)} codes, and {len(coded)} targets need one.")
    name = {index: str(number) for index, number in zip(coded, numbers, strict=False)}
    targets = tuple(replace(target, id=name.get(index, target.id)) for index, target in enumerate(field.targets))
    figure = RingFigure(code.bits, *code.ring, {id: int(id) for id in name.values()})
    return replace(field, targets=targets, figure=figure)


def _grid_targets(table: Table, generator: np.random.Generator) -> list[DiskTarget]:
    """Targets on a grid around a centre, row by row from the bottom, with random shifts within the cells and out of the
    plane."""
    first = table.whole("first")
    columns, rows = table.whole("columns", least=1), table.whole("rows", least=1)
    plane = _Plane.read(table)
    jitter = table.number("jitter", 0.0, least=0.0)
    table.done()
    row, column = np.divmod(np.arange(rows * columns), columns)
    across = column - (columns - 1) / 2 + generator.uniform(-jitter, jitter, len(row))
    along = row - (rows - 1) / 2 + generator.uniform(-jitter, jitter, len(row))
    return plane.targets(first, across, along, generator.uniform(-1.0, 1.0, len(row)))


def _scattered_targets(table: Table, generator: np.random.Generator) -> list[DiskTarget]:
    """Random targets over a parallelogram, and out of its plane. A smaller number gives the first of a larger one."""
    first, count = table.whole("first"), table.whole("points", least=1)
    plane = _Plane.read(table)
    table.done()
    across, along, height = generator.uniform(-0.5, 0.5, (count, 3)).T
    return plane.targets(first, across, along, 2.0 * height)


@dataclass(frozen=True, eq=False)
class _Plane:
    """Plane of targets: a centre, steps right and up, and a relief: the largest distance from the plane."""

    center: Array
    right: Array
    up: Array
    relief: float

    @staticmethod
    def read(table: Table) -> "_Plane":
        plane = _Plane(
            np.array(table.triple("center", (0.0, 0.0, 0.0))),
            np.array(table.triple("right")),
            np.array(table.triple("up")),
            table.number("relief", 0.0, least=0.0),
        )
        if not np.linalg.norm(np.cross(plane.right, plane.up)) > 0.0:
            raise table.error("up", "must not be parallel to right: the two steps span the plane of the targets.")
        return plane

    def targets(self, first: int, across: Array, along: Array, height: Array) -> list[DiskTarget]:
        """Targets at across, along (n,) in steps and height (n,) in units of the relief."""
        normal = np.cross(self.right, self.up)
        normal /= np.linalg.norm(normal)
        out = self.relief * height[:, None] * normal
        places: Array = self.center + across[:, None] * self.right + along[:, None] * self.up + out
        # Rounded to 1e-6 units, so that written coordinates are exact.
        places = np.round(places, 6)
        return [DiskTarget(str(first + i), _triple(place), _triple(normal)) for i, place in enumerate(places)]


def _target(table: Table) -> DiskTarget:
    target = DiskTarget(table.text("id"), table.triple("xyz"), table.triple("normal", (0.0, 0.0, 1.0)))
    table.done()
    return target


def _triple(vector: Array) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
