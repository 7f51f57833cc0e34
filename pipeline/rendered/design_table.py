"""The tables [design] of a scene: planned precision of the measurements, and quantities to be varied."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, get_args

from pydantic import Field
from pydantic.dataclasses import dataclass

from adjust.problem.network import Transformation
from pipeline.files.adjust_table import Datum, ScannerSetting, read_scanner, read_scanner_sigma, read_transformation
from pipeline.text.table_models import (
    NOT_NEGATIVE,
    POSITIVE,
    SIGMA,
    TABLE,
    TEXT,
    TEXTS,
    TRIPLE,
    Key,
    choice,
    read_model,
    whole,
)
from pipeline.text.tables import Table

Values = tuple[float, ...] | tuple[str, ...]
Triple = tuple[float, float, float]
UNOBSERVED: Triple = (math.inf,) * 3


def _quantity(table: Table, key: str) -> str:
    quantity = table.text(key)
    if not quantity or not all(quantity.split(".")):
        raise table.error(key, f'is {quantity!r}; write a dotted name, such as "design.sigma_height".')
    return quantity


def _values(table: Table, key: str) -> Values:
    listed = table.values.get(key)
    is_text = isinstance(listed, list) and bool(listed) and all(isinstance(value, str) for value in listed)
    values = table.texts(key) if is_text else table.numbers(key)
    if len(set(values)) < 2:
        raise table.error(key, "needs two different values at least.")
    return values


def _three_sigmas(table: Table, key: str) -> Triple:
    """Three standard deviations, or one for all."""
    sigmas = table.triple(key) if table.is_list(key) else (table.number(key),) * 3
    if min(sigmas) <= 0.0:
        raise table.error(key, "holds standard deviations, which must be positive.")
    return sigmas


def _radii(table: Table, key: str) -> tuple[float, ...]:
    radii = table.numbers(key)
    if min(radii) <= 0.0:
        raise table.error(key, "must be positive: at radius 0 there is no distortion.")
    return tuple(sorted(radii))


@dataclass(frozen=True, config=TABLE)
class Sweep:
    """A quantity of the scene, by its dotted name, and its values."""

    quantity: Annotated[str, Key("dotted name", _quantity)]
    values: Annotated[Values, Key("list of values", _values)]


@dataclass(frozen=True, config=TABLE)
class Photo:
    """A photograph that could be added: X0, Y0, Z0 in object units, omega, phi, kappa in degrees."""

    name: Annotated[str, TEXT]
    position: Annotated[Triple, TRIPLE]
    angles_deg: Annotated[Triple, TRIPLE]


@dataclass(frozen=True, config=TABLE)
class PlannedDistance:
    """A planned distance between two targets, two stations (by the images' names) or one of each; its standard
    deviation in object units."""

    start: str
    end: str
    sigma: float

    @staticmethod
    def read(table: Table) -> "PlannedDistance":
        """Read the keys `from`, `to` and `sigma`."""
        distance = PlannedDistance(table.text("from"), table.text("to"), table.number("sigma", above=0.0))
        table.done()
        if distance.start == distance.end:
            raise table.error("to", "is the same as from: a distance has two ends.")
        return distance


@dataclass(frozen=True, config=TABLE)
class PlannedOrientation:
    """Planned observations of exterior orientations.

    Attributes
    ----------
    image : name; "": all images without an entry of their own.
    position_sigma : standard deviations of X0, Y0, Z0 in object units; inf: not observed.
    angles_sigma_deg : standard deviations of omega, phi, kappa in degrees; inf: not observed.
    """

    image: Annotated[str, TEXT] = ""
    position_sigma: Annotated[Triple, Key("[sx, sy, sz]", _three_sigmas)] = UNOBSERVED
    angles_sigma_deg: Annotated[Triple, Key("[sx, sy, sz]", _three_sigmas)] = UNOBSERVED

    @staticmethod
    def read(table: Table) -> "PlannedOrientation":
        """Read a table. Raises InputError where nothing is observed."""
        orientation = read_model(table, PlannedOrientation)
        if all(math.isinf(sigma) for sigma in (*orientation.position_sigma, *orientation.angles_sigma_deg)):
            raise table.error("position_sigma", "or angles_sigma_deg must be given: else nothing is observed.")
        return orientation


def _orientations(table: Table, key: str) -> tuple[PlannedOrientation, ...]:
    entries = table.tables(key)
    orientations = tuple(map(PlannedOrientation.read, entries))
    for number, (entry, each) in enumerate(zip(entries, orientations, strict=True)):
        if any(other.image == each.image for other in orientations[:number]):
            whose = f"image {each.image!r}" if each.image else "all images"
            raise entry.error("image", f"an orientation of {whose} is given already. Remove one of both.")
    return orientations


def _tables(read: Callable[[Table], Any]) -> Key:
    return Key("tables", lambda table, key: tuple(map(read, table.tables(key))))


@dataclass(frozen=True, kw_only=True, config=TABLE)
class DesignSettings:
    """Settings of a design in addition to the scene, with the names of project.toml."""

    transformation: Annotated[Transformation | None, Key("text", lambda table, _: read_transformation(table))] = Field(
        default=None, description="Film deformation model; absent: the scene's, none for a camera without fiducials."
    )
    datum: Annotated[Datum, choice(*get_args(Datum))] = "control"
    sigma_target_um: Annotated[float, POSITIVE] = 5.0
    sigma_fiducial_um: Annotated[float, POSITIVE] = 5.0
    film_sigma_um: Annotated[float, NOT_NEGATIVE] = 0.0
    scanner: Annotated[
        ScannerSetting, Key("word or list of terms", lambda table, _: read_scanner(table, ("none", "bend")))
    ] = "none"
    scanner_sigma_um: Annotated[float, Key("standard deviation", lambda table, _: read_scanner_sigma(table))] = math.inf
    sigma0: Annotated[float, POSITIVE] = Field(
        default=1.0, description="What the a-priori standard deviations are to be multiplied by."
    )
    sigma_planimetry: Annotated[float, SIGMA] = Field(
        default=math.inf, description="Of the test field's X and Y, object units; absent: as in [given]."
    )
    sigma_height: Annotated[float, SIGMA] = Field(default=math.inf, description="Of its Z; absent: as in [given].")
    control_points: Annotated[tuple[str, ...], TEXTS] = Field(
        default=(), description="The only points of which these are known; absent: all."
    )
    radii_mm: Annotated[tuple[float, ...], Key("list of numbers", _radii)] = Field(
        default=(), description="Where the distortion's precision is given; absent: quarters of the half diagonal."
    )
    layouts: Annotated[int, whole(least=1)] = Field(
        default=1, description="Random layouts of the test field that the standard deviations are averaged over."
    )
    alternatives: Annotated[bool, Key("true or false", lambda table, key: table.flag(key, True))] = True
    photo: Annotated[tuple[Photo, ...], _tables(lambda table: read_model(table, Photo))] = ()
    sweep: Annotated[tuple[Sweep, ...], _tables(lambda table: read_model(table, Sweep))] = ()
    distance: Annotated[tuple[PlannedDistance, ...], _tables(PlannedDistance.read)] = ()
    orientation: Annotated[tuple[PlannedOrientation, ...], Key("tables", _orientations)] = ()

    def planned_orientation(self, image: str) -> PlannedOrientation | None:
        """Planned observation of an image's exterior orientation; None where it is not observed."""
        named = {each.image: each for each in self.orientation}
        return named.get(image) or named.get("")


def read_design(table: Table, sigma_planimetry: float, sigma_height: float) -> DesignSettings:
    """Read the table [design]. Raises InputError.

    Parameters
    ----------
    sigma_planimetry, sigma_height : defaults from the table [given].
    """
    settings = read_model(table, DesignSettings)
    return replace(
        settings,
        sigma_planimetry=settings.sigma_planimetry if "sigma_planimetry" in table else sigma_planimetry,
        sigma_height=settings.sigma_height if "sigma_height" in table else sigma_height,
    )
