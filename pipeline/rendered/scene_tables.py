"""Tables of scene.toml on the target field and the planned design."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from adjust.solution.options import Datum
from measure.targets.ring_codes import RingCode
from pipeline.files.project_tables import UNITS_MM, Film, ScannerSetting, ScannerSigma, scanner_setting
from pipeline.text import table_models as models
from pipeline.text.table_models import number, numbers
from pipeline.text.toml_tables import Table
from pipeline.types import Array
from synthetic_images.scene import BoardField, CrossFigure, DiskField, DiskTarget, RingFigure

Values = tuple[float, ...] | tuple[str, ...]
Triple = tuple[float, float, float]
UNOBSERVED: Triple = (math.inf,) * 3


def _quantity(value: Any) -> str:
    if not models.text(value) or not all(value.split(".")):
        raise ValueError(f'is {value!r}; write a dotted name, such as "design.sigma_height".')
    return str(value)


def _values(value: Any) -> Values:
    is_text = isinstance(value, list) and bool(value) and all(isinstance(each, str) for each in value)
    values = models.texts(value) if is_text else numbers(value)
    if len(set(values)) < 2:
        raise ValueError("needs two different values at least.")
    return values


def _three_sigmas(value: Any) -> tuple[float, ...]:
    """Three standard deviations, or one for all."""
    if isinstance(value, list) and len(value) != 3:
        raise ValueError(f"must be three numbers, [x, y, z], not {value}.")
    sigmas = tuple(map(number, value if isinstance(value, list) else [value] * 3))
    if min(sigmas) <= 0.0:
        raise ValueError("holds standard deviations, which must be positive.")
    return sigmas


def _radii(value: Any) -> tuple[float, ...]:
    radii = numbers(value)
    if min(radii) <= 0.0:
        raise ValueError("must be positive: at radius 0 there is no distortion.")
    return tuple(sorted(radii))


_ThreeSigmas = Annotated[Triple, models.Key("[sx, sy, sz]", _three_sigmas)]


@models.table_model
class Sweep:
    """A quantity of the scene, by its dotted name, and its values."""

    quantity: Annotated[str, models.Key("dotted name", _quantity)]
    values: Annotated[Values, models.Key("list of values", _values)]


@models.table_model
class Photo:
    """A photograph that could be added: X0, Y0, Z0 in object units, omega, phi, kappa in degrees."""

    name: str
    position: Triple
    angles_deg: Triple


@models.table_model
class PlannedDistance:
    """A planned distance between two targets, two stations (by the images' names) or one of each; its standard
    deviation in object units."""

    start: Annotated[str, Field(alias="from")]
    end: Annotated[str, Field(alias="to")]
    sigma: models.Positive

    def __post_init__(self) -> None:
        """Raises WrongKey for two equal ends."""
        if self.start == self.end:
            raise models.WrongKey("to", "is the same as from: a distance has two ends.")


@models.table_model
class PlannedOrientation:
    """Planned observations of exterior orientations.

    Attributes
    ----------
    image : name; "": all images without an entry of their own.
    position_sigma : standard deviations of X0, Y0, Z0 in object units; inf: not observed.
    angles_sigma_deg : standard deviations of omega, phi, kappa in degrees; inf: not observed.
    """

    image: str = ""
    position_sigma: _ThreeSigmas = UNOBSERVED
    angles_sigma_deg: _ThreeSigmas = UNOBSERVED

    def __post_init__(self) -> None:
        """Raises WrongKey where nothing is observed."""
        if all(math.isinf(sigma) for sigma in (*self.position_sigma, *self.angles_sigma_deg)):
            raise models.WrongKey("position_sigma", "or angles_sigma_deg must be given: else nothing is observed.")


@models.table_model
class DesignSettings:
    """Settings of a design in addition to the scene, with the names of project.toml."""

    transformation: Annotated[
        Film | None, "Film deformation model; absent: the scene's, none for a camera without fiducials."
    ] = None
    datum: Datum = "control"
    sigma_target_um: models.Positive = 5.0
    sigma_fiducial_um: models.Positive = 5.0
    film_sigma_um: models.NotNegative = 0.0
    scanner: Annotated[ScannerSetting, scanner_setting("none", "bend")] = "none"
    scanner_sigma_um: ScannerSigma = math.inf
    sigma0: Annotated[models.Positive, "What the a-priori standard deviations are to be multiplied by."] = 1.0
    sigma_planimetry: Annotated[models.Sigma, "Of the test field's X and Y, object units; absent: as in [given]."] = (
        math.inf
    )
    sigma_height: Annotated[models.Sigma, "Of its Z; absent: as in [given]."] = math.inf
    control_points: Annotated[tuple[str, ...], "The only points of which these are known; absent: all."] = ()
    radii_mm: Annotated[
        tuple[float, ...],
        models.Key("list of numbers", _radii),
        "Where the distortion's precision is given; absent: quarters of the half diagonal.",
    ] = ()
    layouts: Annotated[
        int, models.whole(least=1), "Random layouts of the test field that the standard deviations are averaged over."
    ] = 1
    alternatives: bool = True
    photo: tuple[Photo, ...] = ()
    sweep: tuple[Sweep, ...] = ()
    distance: tuple[PlannedDistance, ...] = ()
    orientation: tuple[PlannedOrientation, ...] = ()

    def __post_init__(self) -> None:
        """Raises WrongKey for two orientations of the same images."""
        for at, each in enumerate(self.orientation):
            if any(other.image == each.image for other in self.orientation[:at]):
                whose = f"image {each.image!r}" if each.image else "all images"
                raise models.WrongKey("orientation", f"an orientation of {whose} is given already. Remove one of both.")

    def planned_orientation(self, image: str) -> PlannedOrientation | None:
        """Planned observation of an image's exterior orientation; None where it is not observed."""
        named = {each.image: each for each in self.orientation}
        return named.get(image) or named.get("")


_Count = Annotated[int, models.whole(least=1)]
_BoardCount = Annotated[int, models.whole(least=2)]


@models.table_model
class _Plane(ABC):
    """Targets from a number on: a centre, steps right and up, and a relief: the largest distance from the plane."""

    first: int
    center: Triple = (0.0, 0.0, 0.0)
    right: Triple
    up: Triple
    relief: models.NotNegative = 0.0

    def __post_init__(self) -> None:
        if not np.linalg.norm(np.cross(self.right, self.up)) > 0.0:
            raise models.WrongKey("up", "must not be parallel to right: the two steps span the plane of the targets.")

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


@models.table_model
class _Grid(_Plane):
    """Targets on a grid around a centre, row by row from the bottom, with random shifts in the plane and out of it."""

    columns: _Count
    rows: _Count
    jitter: models.NotNegative = 0.0

    def draw_targets(self, generator: np.random.Generator) -> list[DiskTarget]:
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        across = column - (self.columns - 1) / 2 + generator.uniform(-self.jitter, self.jitter, len(row))
        along = row - (self.rows - 1) / 2 + generator.uniform(-self.jitter, self.jitter, len(row))
        return self.targets(across, along, generator.uniform(-1.0, 1.0, len(row)))


@models.table_model
class _Scatter(_Plane):
    """Random targets over a parallelogram, and out of its plane. A smaller number gives the first of a larger one."""

    points: _Count

    def draw_targets(self, generator: np.random.Generator) -> list[DiskTarget]:
        across, along, height = generator.uniform(-0.5, 0.5, (self.points, 3)).T
        return self.targets(across, along, 2.0 * height)


@models.table_model
class _Target:
    id: str
    xyz: Triple
    normal: Triple = (0.0, 0.0, 1.0)


@models.table_model
class FieldTable(ABC):
    """Keys of every table [field]."""

    kind: str = "disks"
    unit: Annotated[str, models.choice(*UNITS_MM)] = "m"

    @abstractmethod
    def field(self, mm: float, seed: int) -> DiskField | BoardField:
        """Test field. mm: millimetre in object units. Raises ValueError where it is impossible."""


@models.table_model
class _Natural(FieldTable):
    def field(self, mm: float, seed: int) -> DiskField:
        return DiskField((), 1.0)


@models.table_model
class _Chessboard(FieldTable):
    columns: _BoardCount
    rows: _BoardCount
    square_mm: models.Positive

    def field(self, mm: float, seed: int) -> BoardField:
        return BoardField("chessboard", self.columns, self.rows, self.square_mm * mm)


@models.table_model
class _CircleGrid(FieldTable):
    columns: _BoardCount
    rows: _BoardCount
    spacing_mm: models.Positive
    diameter_mm: models.Positive
    asymmetric: bool = False

    def field(self, mm: float, seed: int) -> BoardField:
        sizes = self.spacing_mm * mm, self.diameter_mm * mm
        return BoardField("circle-grid", self.columns, self.rows, *sizes, self.asymmetric)


@models.table_model
class _Figures(FieldTable):
    grid: tuple[_Grid, ...] = ()
    scatter: tuple[_Scatter, ...] = ()
    target: tuple[_Target, ...] = ()
    surround: models.NotNegative = 2.0

    def figures(self, seed: int, diameter: float, figure: CrossFigure | None = None) -> DiskField:
        generator = np.random.default_rng([seed, 10])
        targets = [target for part in (*self.grid, *self.scatter) for target in part.draw_targets(generator)]
        targets += [DiskTarget(each.id, each.xyz, each.normal) for each in self.target]
        return DiskField(tuple(targets), diameter, self.surround, figure)

    def __post_init__(self) -> None:
        if not (self.grid or self.scatter or self.target):
            raise models.WrongKey(
                "grid", "the field has no target. Add [[field.grid]], [[field.scatter]] or [[field.target]]."
            )


@models.table_model
class _Disks(_Figures):
    diameter_mm: models.Positive

    def field(self, mm: float, seed: int) -> DiskField:
        return self.figures(seed, self.diameter_mm * mm)


@models.table_model
class _Crosses(_Figures):
    arm_mm: models.Positive
    line_mm: models.Positive

    def field(self, mm: float, seed: int) -> DiskField:
        return self.figures(seed, 2.0 * self.arm_mm * mm, CrossFigure(self.line_mm / self.arm_mm))


@models.table_model
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
            raise models.WrongKey(
                "bits", f"{code.bits} bits have {len(numbers)} codes, and {len(coded)} targets need one."
            )
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
    given = models.read_kind(table, _FIELDS, usual="disks")
    try:
        return given.field(1.0 / UNITS_MM[given.unit], seed), given.unit
    except models.WrongKey as error:
        raise table.error(error.key, str(error)) from None
