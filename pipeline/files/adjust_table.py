"""The table [adjust] of project.toml: film deformation model, datum, weights, tests."""

import math
from typing import Annotated, Any, Literal, get_args

from adjust.functional_model.scanner import is_term
from adjust.functional_model.transformation import film_kind
from adjust.problem.network import Transformation
from adjust.problem.tested import PRIOR_GROUPS
from adjust.quality.weighting import WeightFunction
from adjust.solution.options import MEASURED_KINDS
from pipeline.text.table_models import Key, NotNegative, Positive, WrongKey, choice, sigma, table_model, text, texts

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]
ScannerSetting = Literal["none", "auto", "bend"] | tuple[str, ...]


def scanner_setting(*words: str) -> Key:
    """Type of a scanner's bend: one of some words, or a list of terms."""

    def read(value: Any) -> str | tuple[str, ...]:
        if not isinstance(value, list | tuple):
            return str(choice(*words).read(value))
        terms = texts(value)
        for term in terms:
            if not is_term(term):
                raise ValueError(
                    f"names {term!r}; a bend has the terms a20, b11 and the like, with the degrees in x and y, "
                    "together 2 to 6, and stretch, shear, tilt_x, tilt_y."
                )
        if len(set(terms)) < max(len(terms), 1):
            raise ValueError('is empty or names a term twice. Where there is to be no bend, write "none".')
        return terms

    return Key("word or list of terms", read)


def _transformation(value: Any) -> str:
    try:
        film_kind(text(value))
    except ValueError as error:
        raise ValueError(f"{error}.") from None
    return str(value)


def _robust(value: Any) -> bool | str:
    if isinstance(value, bool):
        return value
    if text(value) not in get_args(WeightFunction):
        raise ValueError(f"is {value!r}; possible are true, false, {', '.join(get_args(WeightFunction))}.")
    return str(value)


def _variance_components(value: Any) -> bool | tuple[str, ...]:
    if isinstance(value, bool):
        return value
    names, known = texts(value), (*MEASURED_KINDS, *PRIOR_GROUPS)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"names {unknown[0]!r}; possible are {', '.join(known)}.")
    return names


def _datum_names(value: Any) -> tuple[str, ...]:
    names = texts(value)
    if value == []:
        raise ValueError("is an empty list. Leave it out where the program is to choose.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"names {twice[0]!r} twice.")
    return names


def _scanner_sigma(value: Any) -> float:
    sigma_um = sigma(value)
    if sigma_um == 0.0:
        raise ValueError('is 0, which would fix every term at 0: write scanner = "none" for that.')
    return sigma_um


Film = Annotated[Transformation, Key("text", _transformation)]
ScannerSigma = Annotated[float, Key("standard deviation", _scanner_sigma)]
_Names = Annotated[tuple[str, ...], Key("list of texts", _datum_names)]


@table_model
class AdjustSettings:
    """The table [adjust]: film model, datum, weights and tests. Standard deviations in µm at the film."""

    transformation: Annotated[Film | None, "Film deformation model; absent: affine, or none without fiducials."] = None
    datum: Annotated[Datum, "What fixes the object system."] = "control"
    datum_coordinates: Annotated[
        _Names, "The coordinates that a minimal datum holds; absent: the program chooses."
    ] = ()
    datum_points: Annotated[_Names, "The points over which a free network has inner constraints; absent: all."] = ()
    sigma_target_um: Annotated[Positive, "Of a target where comparator.csv has none."] = 5.0
    sigma_fiducial_um: Annotated[Positive, "Of a fiducial where comparator.csv has none."] = 5.0
    film_sigma_um: Annotated[NotNegative, "Film and scanner: added in quadrature to every comparator sigma."] = 0.0
    unmodelled: Annotated[
        Literal["none", "estimate"], "Standard deviation of what the model lacks, one a camera, added to its targets."
    ] = "none"
    scanner: Annotated[
        ScannerSetting,
        scanner_setting("none", "auto", "bend"),
        "Bend of the scanner: none, bend (degrees 2, 3), auto (by tests), or terms.",
    ] = "none"
    scanner_sigma_um: Annotated[ScannerSigma, "Prior of every term of the bend, which is given as 0; absent: free."] = (
        math.inf
    )
    refraction: Annotated[bool, "Correct for atmospheric refraction."] = False
    earth_curvature: Annotated[bool, "Correct for the curvature of the earth."] = False
    robust: Annotated[
        bool | WeightFunction,
        Key("true, false or a weight function", _robust),
        "Reweight gross errors; true: Huber's weights.",
    ] = False
    variance_components: Annotated[
        bool | tuple[str, ...],
        Key("true, false or list of groups", _variance_components),
        "Estimate the variances of groups of observations.",
    ] = False
    snooping: Annotated[bool, "Take gross errors out one by one (data snooping)."] = False
    method: Annotated[Method, "One combined adjustment, or by observed elements."] = "combined"

    def __post_init__(self) -> None:
        """Raises WrongKey for keys that contradict each other."""
        for key, datum in (("datum_coordinates", "minimal"), ("datum_points", "free")):
            if getattr(self, key) and self.datum != datum:
                raise WrongKey(
                    key, f'goes with datum = "{datum}", and the datum here is "{self.datum}". Change one of the two.'
                )
        if self.robust and self.snooping:
            raise WrongKey("snooping", "and robust both take out gross errors. Set one of the two to false.")
