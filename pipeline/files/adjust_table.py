"""The table [adjust] of project.toml: the model of the film, the datum, the weights, the tests."""

from dataclasses import dataclass
from typing import Literal, cast, get_args

from adjust.functional_model.transformation import film_kind
from adjust.network import Transformation
from adjust.options import MEASURED_KINDS
from adjust.quality.reweighting import WeightFunction
from adjust.quality.tested import PRIOR_GROUPS
from pipeline.files.tables import Table

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]


@dataclass(frozen=True)
class AdjustSettings:
    """The table [adjust]: a-priori standard deviations in um at the film.

    transformation None: affine for a camera with fiducials, none for one without.
    """

    transformation: Transformation | None
    datum: Datum
    datum_coordinates: tuple[str, ...]
    datum_points: tuple[str, ...]
    sigma_target_um: float
    sigma_fiducial_um: float
    film_sigma_um: float
    refraction: bool
    earth_curvature: bool
    robust: bool | WeightFunction
    variance_components: bool | tuple[str, ...]
    snooping: bool
    method: Method


def read_adjust(table: Table) -> AdjustSettings:
    """Read the table. Raises InputError naming the key that is wrong."""
    datum = cast(Datum, table.text("datum", "control", get_args(Datum)))
    settings = AdjustSettings(
        transformation=read_transformation(table),
        datum=datum,
        datum_coordinates=_datum_choice(table, "datum_coordinates", datum, "minimal"),
        datum_points=_datum_choice(table, "datum_points", datum, "free"),
        sigma_target_um=table.number("sigma_target_um", 5.0, above=0.0),
        sigma_fiducial_um=table.number("sigma_fiducial_um", 5.0, above=0.0),
        film_sigma_um=table.number("film_sigma_um", 0.0, least=0.0),
        refraction=table.flag("refraction", False),
        earth_curvature=table.flag("earth_curvature", False),
        robust=_robust(table),
        variance_components=_variance_components(table),
        snooping=table.flag("snooping", False),
        method=cast(Method, table.text("method", "combined", get_args(Method))),
    )
    table.done()
    if settings.robust and settings.snooping:
        raise table.error("snooping", "and robust both take out gross errors. Set one of the two to false.")
    return settings


def _robust(table: Table) -> bool | WeightFunction:
    """Huber's weights are those of `true`."""
    if "robust" not in table or table.is_flag("robust"):
        return table.flag("robust", False)
    name = table.text("robust")
    if name not in get_args(WeightFunction):
        raise table.error("robust", f"is {name!r}; possible are true, false, {', '.join(get_args(WeightFunction))}.")
    return cast(WeightFunction, name)


def _variance_components(table: Table) -> bool | tuple[str, ...]:
    if "variance_components" not in table or table.is_flag("variance_components"):
        return table.flag("variance_components", False)
    names = table.texts("variance_components")
    known = (*MEASURED_KINDS, *PRIOR_GROUPS)
    strangers = [name for name in names if name not in known]
    if strangers:
        raise table.error("variance_components", f"names {strangers[0]!r}; possible are {', '.join(known)}.")
    return names


def _datum_choice(table: Table, key: str, datum: Datum, wanted: Datum) -> tuple[str, ...]:
    """The coordinates or points that a datum names; none where the program is to choose."""
    if key not in table:
        return ()
    if datum != wanted:
        raise table.error(key, f'goes with datum = "{wanted}", and the datum here is "{datum}". Change one of the two.')
    names = table.texts(key)
    if not names:
        raise table.error(key, "is an empty list. Leave it out where the program is to choose.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise table.error(key, f"names {twice[0]!r} twice.")
    return names


def read_transformation(table: Table) -> Transformation | None:
    """The key `transformation`; None where it is absent. Raises InputError."""
    if "transformation" not in table:
        return None
    spelling = table.text("transformation")
    try:
        film_kind(spelling)
    except ValueError as error:
        raise table.error("transformation", f"{error}.") from None
    return spelling
