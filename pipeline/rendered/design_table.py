"""The tables [design] of a scene: planned precision of the measurements, and quantities to be varied."""

import math
from typing import Annotated, Any

from pydantic import Field

from pipeline.files.project_tables import Datum, Film, ScannerSetting, ScannerSigma, scanner_setting
from pipeline.text.table_models import (
    Key,
    NotNegative,
    Positive,
    Sigma,
    WrongKey,
    number,
    numbers,
    table_model,
    text,
    texts,
    whole,
)

Values = tuple[float, ...] | tuple[str, ...]
Triple = tuple[float, float, float]
UNOBSERVED: Triple = (math.inf,) * 3


def _quantity(value: Any) -> str:
    if not text(value) or not all(value.split(".")):
        raise ValueError(f'is {value!r}; write a dotted name, such as "design.sigma_height".')
    return str(value)


def _values(value: Any) -> Values:
    is_text = isinstance(value, list) and bool(value) and all(isinstance(each, str) for each in value)
    values = texts(value) if is_text else numbers(value)
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


_ThreeSigmas = Annotated[Triple, Key("[sx, sy, sz]", _three_sigmas)]


@table_model
class Sweep:
    """A quantity of the scene, by its dotted name, and its values."""

    quantity: Annotated[str, Key("dotted name", _quantity)]
    values: Annotated[Values, Key("list of values", _values)]


@table_model
class Photo:
    """A photograph that could be added: X0, Y0, Z0 in object units, omega, phi, kappa in degrees."""

    name: str
    position: Triple
    angles_deg: Triple


@table_model
class PlannedDistance:
    """A planned distance between two targets, two stations (by the images' names) or one of each; its standard
    deviation in object units."""

    start: Annotated[str, Field(alias="from")]
    end: Annotated[str, Field(alias="to")]
    sigma: Positive

    def __post_init__(self) -> None:
        """Raises WrongKey for two equal ends."""
        if self.start == self.end:
            raise WrongKey("to", "is the same as from: a distance has two ends.")


@table_model
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
            raise WrongKey("position_sigma", "or angles_sigma_deg must be given: else nothing is observed.")


@table_model
class DesignSettings:
    """Settings of a design in addition to the scene, with the names of project.toml."""

    transformation: Annotated[
        Film | None, "Film deformation model; absent: the scene's, none for a camera without fiducials."
    ] = None
    datum: Datum = "control"
    sigma_target_um: Positive = 5.0
    sigma_fiducial_um: Positive = 5.0
    film_sigma_um: NotNegative = 0.0
    scanner: Annotated[ScannerSetting, scanner_setting("none", "bend")] = "none"
    scanner_sigma_um: ScannerSigma = math.inf
    sigma0: Annotated[Positive, "What the a-priori standard deviations are to be multiplied by."] = 1.0
    sigma_planimetry: Annotated[Sigma, "Of the test field's X and Y, object units; absent: as in [given]."] = math.inf
    sigma_height: Annotated[Sigma, "Of its Z; absent: as in [given]."] = math.inf
    control_points: Annotated[tuple[str, ...], "The only points of which these are known; absent: all."] = ()
    radii_mm: Annotated[
        tuple[float, ...],
        Key("list of numbers", _radii),
        "Where the distortion's precision is given; absent: quarters of the half diagonal.",
    ] = ()
    layouts: Annotated[
        int, whole(least=1), "Random layouts of the test field that the standard deviations are averaged over."
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
                raise WrongKey("orientation", f"an orientation of {whose} is given already. Remove one of both.")

    def planned_orientation(self, image: str) -> PlannedOrientation | None:
        """Planned observation of an image's exterior orientation; None where it is not observed."""
        named = {each.image: each for each in self.orientation}
        return named.get(image) or named.get("")
