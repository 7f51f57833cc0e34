"""The table [adjust] of project.toml: film deformation model, datum, weights, tests."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal, cast, get_args

from pydantic import Field
from pydantic.dataclasses import dataclass

from adjust.functional_model.scanner import is_term
from adjust.functional_model.transformation import film_kind
from adjust.problem.network import Transformation
from adjust.problem.tested import PRIOR_GROUPS
from adjust.quality.weighting import WeightFunction
from adjust.solution.options import MEASURED_KINDS
from pipeline.text.table_models import FLAG, NOT_NEGATIVE, POSITIVE, TABLE, Key, choice, read_model
from pipeline.text.tables import Table

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]
ScannerSetting = Literal["none", "auto", "bend"] | tuple[str, ...]
SCANNER_WORDS = ("none", "auto", "bend")


def _datum_choice(wanted: Datum) -> Key:
    """Key for the coordinates or points that a datum names; absent: the program chooses."""

    def read(table: Table, key: str) -> tuple[str, ...]:
        datum = table.text("datum", "control")
        if datum != wanted:
            raise table.error(
                key, f'goes with datum = "{wanted}", and the datum here is "{datum}". Change one of the two.'
            )
        names = table.texts(key)
        if not names:
            raise table.error(key, "is an empty list. Leave it out where the program is to choose.")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise table.error(key, f"names {twice[0]!r} twice.")
        return names

    return Key("list of texts", read)


@dataclass(frozen=True, kw_only=True, config=TABLE)
class AdjustSettings:
    """The table [adjust]: film model, datum, weights and tests. Standard deviations in µm at the film."""

    transformation: Annotated[Transformation | None, Key("text", lambda table, key: read_transformation(table))] = (
        Field(
            default=None,
            description="Film deformation model; absent: affine, or none without fiducials.",
        )
    )
    datum: Annotated[Datum, choice(*get_args(Datum))] = Field(
        default="control", description="What fixes the object system."
    )
    datum_coordinates: Annotated[tuple[str, ...], _datum_choice("minimal")] = Field(
        default=(), description="The coordinates that a minimal datum holds; absent: the program chooses."
    )
    datum_points: Annotated[tuple[str, ...], _datum_choice("free")] = Field(
        default=(), description="The points over which a free network has inner constraints; absent: all."
    )
    sigma_target_um: Annotated[float, POSITIVE] = Field(
        default=5.0, description="Of a target where comparator.csv has none."
    )
    sigma_fiducial_um: Annotated[float, POSITIVE] = Field(
        default=5.0, description="Of a fiducial where comparator.csv has none."
    )
    film_sigma_um: Annotated[float, NOT_NEGATIVE] = Field(
        default=0.0, description="Film and scanner: added in quadrature to every comparator sigma."
    )
    unmodelled: Annotated[Literal["none", "estimate"], choice("none", "estimate")] = Field(
        default="none",
        description="Standard deviation of what the model lacks, one a camera, added to its targets.",
    )
    scanner: Annotated[
        ScannerSetting, Key("word or list of terms", lambda table, key: read_scanner(table, SCANNER_WORDS))
    ] = Field(default="none", description="Bend of the scanner: none, bend (degrees 2, 3), auto (by tests), or terms.")
    scanner_sigma_um: Annotated[float, Key("standard deviation", lambda table, key: read_scanner_sigma(table))] = Field(
        default=math.inf, description="Prior of every term of the bend, which is given as 0; absent: free."
    )
    refraction: Annotated[bool, FLAG] = Field(default=False, description="Correct for atmospheric refraction.")
    earth_curvature: Annotated[bool, FLAG] = Field(default=False, description="Correct for the curvature of the earth.")
    robust: Annotated[
        bool | WeightFunction, Key("true, false or a weight function", lambda table, key: _robust(table))
    ] = Field(default=False, description="Reweight gross errors; true: Huber's weights.")
    variance_components: Annotated[
        bool | tuple[str, ...], Key("true, false or list of groups", lambda table, key: _variance_components(table))
    ] = Field(default=False, description="Estimate the variances of groups of observations.")
    snooping: Annotated[bool, FLAG] = Field(
        default=False, description="Take gross errors out one by one (data snooping)."
    )
    method: Annotated[Method, choice(*get_args(Method))] = Field(
        default="combined", description="One combined adjustment, or by observed elements."
    )


def read_adjust(table: Table) -> AdjustSettings:
    """Read the table. Raises InputError with the key that is wrong."""
    settings = read_model(table, AdjustSettings)
    if settings.robust and settings.snooping:
        raise table.error("snooping", "and robust both take out gross errors. Set one of the two to false.")
    return settings


def read_scanner(table: Table, words: Sequence[str]) -> ScannerSetting:
    """Value of the key `scanner`: one of some words, or a list of terms. Raises InputError."""
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
    """Value of the key `scanner_sigma_um`, inf where it is absent. Raises InputError."""
    sigma_um = table.sigma("scanner_sigma_um", math.inf)
    if sigma_um == 0.0:
        raise table.error("scanner_sigma_um", 'is 0, which would fix every term at 0: write scanner = "none" for that.')
    return sigma_um


def _robust(table: Table) -> bool | WeightFunction:
    """Value of the key `robust`; `true` stands for Huber's weights."""
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


def read_transformation(table: Table) -> Transformation | None:
    """Value of the key `transformation`; None where it is absent. Raises InputError."""
    if "transformation" not in table:
        return None
    spelling = table.text("transformation")
    try:
        film_kind(spelling)
    except ValueError as error:
        raise table.error("transformation", f"{error}.") from None
    return spelling
