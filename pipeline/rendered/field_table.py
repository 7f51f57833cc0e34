"""The table [field] of a scene: disks, crosses or ring-coded disks, on grids in space or one by one, or a planar
board."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np

from measure.targets.ring_codes import RingCode
from pipeline.files.project_tables import UNITS_MM
from pipeline.text.table_models import NotNegative, Positive, WrongKey, choice, read_kind, table_model, whole
from pipeline.text.tables import Table
from pipeline.types import Array
from synthetic_images.scene import BoardField, CrossFigure, DiskField, DiskTarget, RingFigure

_Triple = tuple[float, float, float]
_Count = Annotated[int, whole(least=1)]
_BoardCount = Annotated[int, whole(least=2)]


@table_model
class _Plane(ABC):
    """Targets from a number on: a centre, steps right and up, and a relief: the largest distance from the plane."""

    first: int
    center: _Triple = (0.0, 0.0, 0.0)
    right: _Triple
    up: _Triple
    relief: NotNegative = 0.0

    def __post_init__(self) -> None:
        if not np.linalg.norm(np.cross(self.right, self.up)) > 0.0:
            raise WrongKey("up", "must not be parallel to right: the two steps span the plane of the targets.")

    @abstractmethod
    def draw_targets(self, generator: np.random.Generator) -> list[DiskTarget]:
        """Targets, with the random numbers of a generator."""

    def targets(self, across: Array, along: Array, height: Array) -> list[DiskTarget]:
        """Targets at across, along (n,) in steps and height (n,) in units of the relief."""
        normal = np.cross(self.right, self.up)
        normal /= np.linalg.norm(normal)
        out = self.relief * height[:, None] * normal
        places = np.array(self.center) + across[:, None] * self.right + along[:, None] * self.up + out
        # Rounded to 1e-6 units, so that written coordinates are exact.
        return [
            DiskTarget(str(self.first + i), tuple(place), tuple(normal.tolist()))
            for i, place in enumerate(np.round(places, 6).tolist())
        ]


@table_model
class _Grid(_Plane):
    """Targets on a grid around a centre, row by row from the bottom, with random shifts in the plane and out of it."""

    columns: _Count
    rows: _Count
    jitter: NotNegative = 0.0

    def draw_targets(self, generator: np.random.Generator) -> list[DiskTarget]:
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        across = column - (self.columns - 1) / 2 + generator.uniform(-self.jitter, self.jitter, len(row))
        along = row - (self.rows - 1) / 2 + generator.uniform(-self.jitter, self.jitter, len(row))
        return self.targets(across, along, generator.uniform(-1.0, 1.0, len(row)))


@table_model
class _Scatter(_Plane):
    """Random targets over a parallelogram, and out of its plane. A smaller number gives the first of a larger one."""

    points: _Count

    def draw_targets(self, generator: np.random.Generator) -> list[DiskTarget]:
        across, along, height = generator.uniform(-0.5, 0.5, (self.points, 3)).T
        return self.targets(across, along, 2.0 * height)


@table_model
class _Target:
    id: str
    xyz: _Triple
    normal: _Triple = (0.0, 0.0, 1.0)


@table_model
class FieldTable(ABC):
    """Keys of every table [field]."""

    kind: str = "disks"
    unit: Annotated[str, choice(*UNITS_MM)] = "m"

    @abstractmethod
    def field(self, mm: float, seed: int) -> DiskField | BoardField:
        """Test field. mm: millimetre in object units. Raises ValueError where it is impossible."""


@table_model
class _Natural(FieldTable):
    def field(self, mm: float, seed: int) -> DiskField:
        return DiskField((), 1.0)


@table_model
class _Chessboard(FieldTable):
    columns: _BoardCount
    rows: _BoardCount
    square_mm: Positive

    def field(self, mm: float, seed: int) -> BoardField:
        return BoardField("chessboard", self.columns, self.rows, self.square_mm * mm)


@table_model
class _CircleGrid(FieldTable):
    columns: _BoardCount
    rows: _BoardCount
    spacing_mm: Positive
    diameter_mm: Positive
    asymmetric: bool = False

    def field(self, mm: float, seed: int) -> BoardField:
        sizes = self.spacing_mm * mm, self.diameter_mm * mm
        return BoardField("circle-grid", self.columns, self.rows, *sizes, self.asymmetric)


@table_model
class _Figures(FieldTable):
    grid: tuple[_Grid, ...] = ()
    scatter: tuple[_Scatter, ...] = ()
    target: tuple[_Target, ...] = ()
    surround: NotNegative = 2.0

    def figures(self, seed: int, diameter: float, figure: CrossFigure | None = None) -> DiskField:
        generator = np.random.default_rng([seed, 10])
        targets = [target for part in (*self.grid, *self.scatter) for target in part.draw_targets(generator)]
        targets += [DiskTarget(each.id, each.xyz, each.normal) for each in self.target]
        return DiskField(tuple(targets), diameter, self.surround, figure)

    def __post_init__(self) -> None:
        if not (self.grid or self.scatter or self.target):
            raise WrongKey(
                "grid", "the field has no target. Add [[field.grid]], [[field.scatter]] or [[field.target]]."
            )


@table_model
class _Disks(_Figures):
    diameter_mm: Positive

    def field(self, mm: float, seed: int) -> DiskField:
        return self.figures(seed, self.diameter_mm * mm)


@table_model
class _Crosses(_Figures):
    arm_mm: Positive
    line_mm: Positive

    def field(self, mm: float, seed: int) -> DiskField:
        return self.figures(seed, 2.0 * self.arm_mm * mm, CrossFigure(self.line_mm / self.arm_mm))


@table_model
class _CodedRings(_Disks):
    """Every n-th disk has a ring code, and its number as its name."""

    bits: int = RingCode().bits
    ring: tuple[float, float] = RingCode().ring
    every: _Count = 1

    def field(self, mm: float, seed: int) -> DiskField:
        code = RingCode(self.bits, self.ring)
        field, numbers = super().field(mm, seed), code.published_numbers()
        coded = range(0, len(field.targets), self.every)
        if len(coded) > len(numbers):
            raise WrongKey("bits", f"{code.bits} bits have {len(numbers)} codes, and {len(coded)} targets need one.")
        name = {index: str(number) for index, number in zip(coded, numbers, strict=False)}
        targets = tuple(replace(target, id=name.get(index, target.id)) for index, target in enumerate(field.targets))
        figure = RingFigure(code.bits, *code.ring, {id: int(id) for id in name.values()})
        return replace(field, targets=targets, figure=figure)


_FIELDS: Mapping[str, type[FieldTable]] = {
    "disks": _Disks,
    "crosses": _Crosses,
    "coded-rings": _CodedRings,
    "chessboard": _Chessboard,
    "circle-grid": _CircleGrid,
    "natural": _Natural,
}


def read_field(table: Table, seed: int) -> tuple[DiskField | BoardField, str]:
    """Read the test field and the unit of its coordinates; a field of kind natural has no targets. Raises InputError,
    or ValueError for a field that is impossible."""
    given = read_kind(table, _FIELDS, usual="disks")
    try:
        return given.field(1.0 / UNITS_MM[given.unit], seed), given.unit
    except WrongKey as error:
        raise table.error(error.key, str(error)) from None
