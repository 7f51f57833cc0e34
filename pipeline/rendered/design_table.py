"""The tables [design] of a scene: how well everything is to be measured, and what is to be varied."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast, get_args

from adjust.problem.network import Transformation
from pipeline.files.adjust_table import Datum, ScannerSetting, read_scanner, read_scanner_sigma, read_transformation
from pipeline.text.tables import Table

Values = tuple[float, ...] | tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """A quantity of the scene, by its dotted name, and the values it is to take."""

    quantity: str
    values: Values


@dataclass(frozen=True)
class Photo:
    """A photograph that might be taken as well: X0, Y0, Z0 in object units, omega, phi, kappa in degrees."""

    name: str
    position: tuple[float, float, float]
    angles_deg: tuple[float, float, float]


@dataclass(frozen=True)
class PlannedDistance:
    """A distance that is to be measured, between two targets, two stations (by the images' names) or one of each; its
    standard deviation in object units."""

    start: str
    end: str
    sigma: float


@dataclass(frozen=True)
class PlannedOrientation:
    """How well exterior orientations are to be observed: the standard deviations of X0, Y0, Z0 in object units and of
    omega, phi, kappa in degrees; inf: not at all. image: of which; "": of all that are not named."""

    image: str
    position: tuple[float, float, float]
    angles_deg: tuple[float, float, float]


@dataclass(frozen=True)
class DesignSettings:
    """What a plan needs beyond the scene, in the words of project.toml.

    transformation None: the film's of the scene, none for a camera without fiducials. scanner: as in `AdjustSettings`,
    but for "auto". sigma_planimetry, sigma_height:
    of the test field's coordinates in object units, 0 known, inf unknown. control_points: the only points of which
    these are known; empty: all. sigma0: by what the a-priori standard deviations are to be multiplied. radii_mm: where
    the distortion's precision is told; empty: quarters of the frame's half diagonal. layouts: how many random layouts
    of the test field the standard deviations are averaged over.
    """

    transformation: Transformation | None
    datum: Datum
    sigma_target_um: float
    sigma_fiducial_um: float
    film_sigma_um: float
    scanner: ScannerSetting
    scanner_sigma_um: float
    sigma0: float
    sigma_planimetry: float
    sigma_height: float
    control_points: tuple[str, ...]
    radii_mm: tuple[float, ...]
    layouts: int
    alternatives: bool
    photos: tuple[Photo, ...]
    sweeps: tuple[Sweep, ...]
    distances: tuple[PlannedDistance, ...] = ()
    orientations: tuple[PlannedOrientation, ...] = ()

    def orientation_of(self, image: str) -> PlannedOrientation | None:
        """How well that of an image is to be observed; None where it is not."""
        named = {each.image: each for each in self.orientations}
        return named.get(image) or named.get("")


def read_design(table: Table, sigma_planimetry: float, sigma_height: float) -> DesignSettings:
    """The table [design] with its [[design.photo]], [[design.sweep]], [[design.distance]] and [[design.orientation]].
    Raises InputError.

    sigma_planimetry, sigma_height: what the table [given] says, where this one is silent.
    """
    settings = DesignSettings(
        transformation=read_transformation(table),
        datum=cast(Datum, table.text("datum", "control", get_args(Datum))),
        sigma_target_um=table.number("sigma_target_um", 5.0, above=0.0),
        sigma_fiducial_um=table.number("sigma_fiducial_um", 5.0, above=0.0),
        film_sigma_um=table.number("film_sigma_um", 0.0, least=0.0),
        scanner=read_scanner(table, ("none", "bend")),
        scanner_sigma_um=read_scanner_sigma(table),
        sigma0=table.number("sigma0", 1.0, above=0.0),
        sigma_planimetry=table.sigma("sigma_planimetry", sigma_planimetry),
        sigma_height=table.sigma("sigma_height", sigma_height),
        control_points=table.texts("control_points") if "control_points" in table else (),
        radii_mm=_radii(table),
        layouts=table.whole("layouts", 1, least=1),
        alternatives=table.flag("alternatives", True),
        photos=tuple(_photo(entry) for entry in table.tables("photo")),
        sweeps=tuple(_sweep(entry) for entry in table.tables("sweep")),
        distances=tuple(_distance(entry) for entry in table.tables("distance")),
        orientations=_orientations(table.tables("orientation")),
    )
    table.done()
    return settings


def _radii(table: Table) -> tuple[float, ...]:
    if "radii_mm" not in table:
        return ()
    radii = table.numbers("radii_mm")
    if min(radii) <= 0.0:
        raise table.error("radii_mm", "must be positive: at radius 0 there is no distortion.")
    return tuple(sorted(radii))


def _photo(table: Table) -> Photo:
    photo = Photo(table.text("name"), table.triple("position"), table.triple("angles_deg"))
    table.done()
    return photo


def _sweep(table: Table) -> Sweep:
    quantity = table.text("quantity")
    if not quantity or not all(quantity.split(".")):
        raise table.error("quantity", f'is {quantity!r}; write a dotted name, such as "design.sigma_height".')
    values = table.texts("values") if _is_text(table.values) else table.numbers("values")
    table.done()
    if len(set(values)) < 2:
        raise table.error("values", "needs two different values at least.")
    return Sweep(quantity, values)


def _distance(table: Table) -> PlannedDistance:
    distance = PlannedDistance(table.text("from"), table.text("to"), table.number("sigma", above=0.0))
    table.done()
    if distance.start == distance.end:
        raise table.error("to", "is the same as from: a distance has two ends.")
    return distance


def _orientations(tables: Sequence[Table]) -> tuple[PlannedOrientation, ...]:
    orientations: dict[str, PlannedOrientation] = {}
    for table in tables:
        image = table.text("image", "")
        if image in orientations:
            whose = f"image {image!r}" if image else "all images"
            raise table.error("image", f"an orientation of {whose} is given already. Remove one of both.")
        position, angles = (_free_sigmas(table, key) for key in ("position_sigma", "angles_sigma_deg"))
        if all(math.isinf(sigma) for sigma in (*position, *angles)):
            raise table.error("position_sigma", "or angles_sigma_deg must be given: else nothing is observed.")
        orientations[image] = PlannedOrientation(image, position, angles)
        table.done()
    return tuple(orientations.values())


def _free_sigmas(table: Table, key: str) -> tuple[float, float, float]:
    """Three standard deviations, or one for all; not observed where the key is absent."""
    if key not in table:
        return (math.inf,) * 3
    sigmas = table.triple(key) if isinstance(table.values[key], list) else (table.number(key),) * 3
    if min(sigmas) <= 0.0:
        raise table.error(key, "holds standard deviations, which must be positive.")
    return sigmas


def _is_text(values: Mapping[str, object]) -> bool:
    listed = values.get("values")
    return isinstance(listed, list) and bool(listed) and all(isinstance(value, str) for value in listed)
