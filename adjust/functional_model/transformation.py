"""Film transformations T: comparator (x, y) to camera (x', y'), each explicit in the comparator coordinates.

    none           x' = x                     y' = y
    congruent      x' = a1 + cos(t) x - m sin(t) y,   y' = b1 + sin(t) x + m cos(t) y,   t the `angle` in rad
    similarity     x' = a1 + p x - m q y      y' = b1 + q x + m p y
    affine         x' = a1 + a2 x + a3 y      y' = b1 + b2 x + b3 y
    projective     x' = (a1 + a2 x + a3 y) / d,       y' = (b1 + b2 x + b3 y) / d,       d = 1 + c1 x + c2 y
    bilinear       x' = a1 + a2 x + a3 y + a4 xy      y' = b1 + b2 x + b3 y + b4 xy
    conformal(n)   x' + i y' = (a1 + i b1) + (a2 + i b2) z + ... + (a[n+1] + i b[n+1]) z^n,   z = x + i m y
    polynomial(n)  x' = a1 + a2 x + a3 y + a4 x² + a5 xy + a6 y² + a7 x³ + a8 x²y + ... of total degree n; y' with b

x, y are observed comparator coordinates in mm, neither centred nor scaled. m is -1 where the scan is mirrored, else 1.
Congruent, similarity and conformal transformations need m as an input; the parameters of the others include mirroring.
conformal(1) is a similarity, polynomial(1) an affine transformation.
"""

import re
from dataclasses import dataclass, replace
from functools import lru_cache

from adjust.array_types import Array, Mask
from adjust.functional_model.film_kinds import (
    Congruent,
    FilmKind,
    Identity,
    Projective,
    conformal,
    least_marks,
    polynomial,
    whole_polynomial,
)

HIGHEST_ORDER = 5
POSSIBLE = (
    "none, congruent, similarity, affine, projective, bilinear, conformal(n) and polynomial(n) with the order n from 1 "
    f"to {HIGHEST_ORDER}"
)


@lru_cache
def film_kind(spelling: str, mirrored: bool = False) -> FilmKind:
    """Return the formula of a transformation by its name. Raises ValueError, listing the names, for any other."""
    match spelling:
        case "none":
            return Identity()
        case "congruent":
            return Congruent(mirrored)
        case "similarity":
            return conformal(1, mirrored, ("a1", "b1", "p", "q"))
        case "affine":
            return whole_polynomial(1)
        case "projective":
            return Projective()
        case "bilinear":
            return polynomial(((0, 0), (1, 0), (0, 1), (1, 1)))
    name, order = _name_and_order(spelling)
    if name == "polynomial":
        return whole_polynomial(order)
    return conformal(order, mirrored, tuple(f"{axis}{k}" for k in range(1, order + 2) for axis in "ab"))


def _name_and_order(spelling: str) -> tuple[str, int]:
    form = re.fullmatch(r"(conformal|polynomial)\((\d+)\)", spelling)
    if form and 1 <= int(form[2]) <= HIGHEST_ORDER:
        return form[1], int(form[2])
    why = ""
    if form:
        why = f" its order must be from 1 to {HIGHEST_ORDER};"
    elif spelling in ("conformal", "polynomial"):
        why = f' it lacks its order, as in "{spelling}(2)";'
    raise ValueError(f'there is no transformation "{spelling}":{why} possible are {POSSIBLE}')


def film_parameter_names(spelling: str) -> tuple[str, ...]:
    """Names of a transformation's parameters in order."""
    return film_kind(spelling).names


def marks_needed(spelling: str) -> int:
    """Number of fiducial marks that determine a transformation without redundancy."""
    return least_marks(film_kind(spelling))


@lru_cache
def fewest_marks(spelling: str) -> int:
    """Number of fiducial marks that initial values need: those of the simplest transformation of the family."""
    lower = simpler(spelling)
    return fewest_marks(lower) if lower else marks_needed(spelling)


def simpler(spelling: str) -> str | None:
    """Return the transformation of the same family that needs fewer marks, or None."""
    if spelling in ("projective", "bilinear", "polynomial(2)"):
        return "affine"
    if spelling == "conformal(2)":
        return "similarity"
    if spelling.startswith(("conformal", "polynomial")):
        name, order = _name_and_order(spelling)
        return f"{name}({order - 1})" if order > 1 else None
    return None


def polynomial_order(spelling: str) -> int:
    """Order of a conformal or general polynomial; 1 for all other transformations."""
    return _name_and_order(spelling)[1] if spelling.startswith(("conformal", "polynomial")) else 1


def follows_tilts(spelling: str) -> bool:
    """Whether a transformation can absorb the effect of a small camera tilt: x' + t x'², y' + t x'y'.

    A projective transformation absorbs it exactly, a polynomial as long as it is nearly affine, a conformal one
    together with decentering distortion.
    """
    return spelling == "projective" or (simpler(spelling) is not None and spelling != "bilinear")


@dataclass(frozen=True)
class Film:
    """Film transformation of one image.

    Attributes
    ----------
    transformation : name of the transformation.
    parameters : (k,) in the order of `film_parameter_names`.
    center_mm : (2,) comparator coordinates of a place in the middle of the image.
    mirrored : whether the scan is mirrored.
    """

    transformation: str
    parameters: Array
    center_mm: Array
    mirrored: bool = False

    def camera_from_comparator(self, xy_mm: Array) -> Array:
        """Compute camera coordinates (n, 2) from comparator coordinates (n, 2), mm."""
        return self._kind.apply(self.parameters, xy_mm)

    def gradient(self, xy_mm: Array) -> Array:
        """Derivatives (n, 2, 2) of the camera coordinates with respect to the comparator coordinates."""
        return self._kind.gradient(self.parameters, xy_mm)

    def comparator_from_camera(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Compute comparator coordinates (n, 2) from camera coordinates (n, 2), mm, and the mask of those found."""
        return self._kind.inverse(self.parameters, xy_mm, self.center_mm)

    def changed(self, parameter: int, by: float) -> "Film":
        """Return a copy with one parameter changed; parameter: its number."""
        parameters = self.parameters.copy()
        parameters[parameter] += by
        return replace(self, parameters=parameters)

    @property
    def _kind(self) -> FilmKind:
        return film_kind(self.transformation, self.mirrored)
