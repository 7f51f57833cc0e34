"""The table [adjust] of project.toml: the model of the film, the datum, the weights, the tests."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast, get_args

from adjust.functional_model.scanner import is_term
from adjust.functional_model.transformation import film_kind
from adjust.problem.network import Transformation
from adjust.problem.tested import PRIOR_GROUPS
from adjust.quality.reweighting import WeightFunction
from adjust.solution.options import MEASURED_KINDS
from pipeline.text.tables import Table

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]
ScannerSetting = Literal["none", "auto", "bend"] | tuple[str, ...]
SCANNER_WORDS = ("none", "auto", "bend")


@dataclass(frozen=True)
class AdjustSettings:
    """The table [adjust]: a-priori standard deviations in um at the film.

    transformation None: affine for a camera with fiducials, none for one without. scanner: the terms of the scanners'
    bends, "bend" for all of degree 2 and 3 that the films leave, "auto" for those that tests choose; scanner_sigma_um:
    of every term, which is given as 0, inf free.
    """

    transformation: Transformation | None
    datum: Datum
    datum_coordinates: tuple[str, ...]
    datum_points: tuple[str, ...]
    sigma_target_um: float
    sigma_fiducial_um: float
    film_sigma_um: float
    scanner: ScannerSetting
    scanner_sigma_um: float
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
        scanner=read_scanner(table, SCANNER_WORDS),
        scanner_sigma_um=read_scanner_sigma(table),
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


def read_scanner(table: Table, words: Sequence[str]) -> ScannerSetting:
    """The key `scanner`: one of some words, or a list of terms. Raises InputError."""
    if not table.is_list("scanner"):
        return cast(ScannerSetting, table.text("scanner", "none", words))
    terms = table.texts("scanner")
    for term in terms:
        if not is_term(term):
            raise table.error(
                "scanner",
                f"names {term!r}; a bend has the terms a20, b11 and the like, with the degrees in x and y, together "
                f"2 to 6, and stretch, shear, tilt_x, tilt_y.",
            )
    if len(set(terms)) < max(len(terms), 1):
        raise table.error("scanner", 'is empty or names a term twice. Where there is to be no bend, write "none".')
    return terms


def read_scanner_sigma(table: Table) -> float:
    """The key `scanner_sigma_um`, inf where it is absent. Raises InputError."""
    sigma_um = table.sigma("scanner_sigma_um", math.inf)
    if sigma_um == 0.0:
        raise table.error("scanner_sigma_um", 'is 0, which would fix every term at 0: write scanner = "none" for that.')
    return sigma_um


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
    unknown = [name for name in names if name not in known]
    if unknown:
        raise table.error("variance_components", f"names {unknown[0]!r}; possible are {', '.join(known)}.")
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
