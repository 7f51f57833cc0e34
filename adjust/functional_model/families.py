"""The table of distortion families: their parameters and what they do to a point or a ray.

A family with an order is spelled with it: "legendre(3)". Whatever works with distortion asks this table: a new family
is a formula with its derivatives and an entry here.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.added_terms import ADDED_NAMES, correction_with_terms, image_without_terms
from adjust.functional_model.correction import (
    Correct,
    Image,
    ideal_point_family,
    no_correction,
    ray_family,
    undistorted,
)
from adjust.functional_model.fourier_sets import fourier, fourier_names, order_groups
from adjust.functional_model.juhl import JUHL_GROUPS, JUHL_NAMES, JUHL_UNITS, juhl
from adjust.functional_model.opencv_family import (
    FISHEYE_GROUPS,
    FISHEYE_NAMES,
    OPENCV_DENOMINATOR,
    OPENCV_GROUPS,
    OPENCV_NAMES,
    OPENCV_UNITS,
    OPENCV_Y_DOWN,
    expanded,
    opencv,
    opencv_fisheye,
)
from adjust.functional_model.physical import (
    AICON_GROUPS,
    AICON_NAMES,
    AUSTRALIS_NAMES,
    BROWN_GROUPS,
    BROWN_NAMES,
    BROWN_UNITS,
    TORLEGARD_GROUPS,
    TORLEGARD_NAMES,
    TORLEGARD_UNITS,
    aicon,
    australis,
    brown,
    torlegard,
)
from adjust.functional_model.polynomial_sets import EBNER, GRUEN, PolynomialSet, correct, degree_groups, legendre

LEGENDRE_ORDERS = range(2, 10)  # from 2, the degree of the tilts that are left out, to one digit an index
FOURIER_ORDERS = range(1, 10)


@dataclass(frozen=True)
class Family:
    """A distortion family.

    parameters: their names; units: theirs, mm where none is said. image, of the object side: what it makes of a ray.
    correct, of the image side: what is subtracted from the observed point. needs: the setting that it cannot do
    without. y_down: parameters of a family whose axes are x right, y down, that would have the other sign with y up.
    groups: the parameters that are one cause, or of one degree, by its name. ladder: what a choice of a model tries of
    it, simplest first. alike_at_zero: parameters that do the same as others while they are 0; apart(parameters):
    others, of nearly the same distortion, with which they do not. is_pinhole_at_zero: whether it leaves every point
    where it is while all parameters are 0.
    """

    parameters: tuple[str, ...] = ()
    image: Image = undistorted
    correct: Correct = no_correction
    units: tuple[str, ...] = ()
    needs: str = ""
    y_down: tuple[str, ...] = ()
    groups: tuple[tuple[str, tuple[str, ...]], ...] = ()
    ladder: tuple[str, ...] = ()
    alike_at_zero: tuple[str, ...] = ()
    apart: Callable[[Array], Array] = np.copy
    is_pinhole_at_zero: bool = True

    def unit(self, parameter: str) -> str:
        return self.units[self.parameters.index(parameter)] if self.units else "mm"


def _polynomials(of: PolynomialSet) -> Family:
    return Family(of.names, correct=partial(correct, of), needs="half_mm", groups=degree_groups(of))


def _legendre(order: int) -> Family:
    return _polynomials(legendre(order))


def _fourier(order: int) -> Family:
    return Family(fourier_names(order), correct=partial(fourier, order), needs="half_mm", groups=order_groups(order))


_BROWN_LADDER = ("k1", "k1 k2", "k1 p1 p2", "k1 k2 p1 p2", "k1 k2 k3 p1 p2")
_FAMILIES = {
    "none": Family(),
    "torlegard": Family(
        TORLEGARD_NAMES,
        correct=torlegard,
        units=TORLEGARD_UNITS,
        groups=TORLEGARD_GROUPS,
        ladder=("k3", "k3 k5", "k3 p1 p2", "k3 k5 p1 p2", "k3 k5 k7 p1 p2"),
    ),
    "brown": Family(BROWN_NAMES, correct=brown, units=BROWN_UNITS, groups=BROWN_GROUPS, ladder=_BROWN_LADDER),
    "australis": Family(
        AUSTRALIS_NAMES, correct=australis, units=BROWN_UNITS, groups=BROWN_GROUPS, ladder=_BROWN_LADDER
    ),
    "aicon": Family(
        AICON_NAMES,
        image=ideal_point_family(aicon),
        units=BROWN_UNITS,
        groups=AICON_GROUPS,
        ladder=("a1", "a1 a2", "a1 b1 b2", "a1 a2 b1 b2", "a1 a2 a3 b1 b2"),
    ),
    "opencv": Family(
        OPENCV_NAMES,
        image=ray_family(opencv),
        units=OPENCV_UNITS,
        y_down=OPENCV_Y_DOWN,
        groups=OPENCV_GROUPS,
        ladder=("k1", "k1 k2", "k1 p1 p2", "k1 k2 p1 p2", "k1 k2 p1 p2 k3"),
        alike_at_zero=OPENCV_DENOMINATOR,
        apart=expanded,
    ),
    "opencv_fisheye": Family(
        FISHEYE_NAMES,
        image=ray_family(opencv_fisheye),
        units=("–",) * len(FISHEYE_NAMES),
        y_down=("b2",),
        groups=FISHEYE_GROUPS,
        ladder=("k1", "k1 k2", "k1 k2 k3", "k1 k2 k3 k4"),
        is_pinhole_at_zero=False,
    ),
    "juhl": Family(JUHL_NAMES, correct=juhl, units=JUHL_UNITS, needs="r0_mm", groups=JUHL_GROUPS),
    "ebner": _polynomials(EBNER),
    "gruen": _polynomials(GRUEN),
}
_WITH_ORDER: dict[str, tuple[range, Callable[[int], Family]]] = {
    "legendre": (LEGENDRE_ORDERS, _legendre),
    "fourier": (FOURIER_ORDERS, _fourier),
}
EXTENDED = "+"  # behind a family's name: with the added terms, by which an adjustment tests what the family lacks
FAMILY_NAMES = (*_FAMILIES, *(f"{name}(n)" for name in _WITH_ORDER))


def _extended(of: Family) -> Family:
    """A family with the added terms behind its own parameters."""
    count = len(of.parameters)
    units = of.units or ("mm",) * count
    return replace(
        of,
        parameters=(*of.parameters, *ADDED_NAMES),
        units=(*units, *("mm",) * len(ADDED_NAMES)),
        image=image_without_terms(of.image, count),
        correct=correction_with_terms(of.correct, count),
        needs="half_mm" if not of.needs else of.needs,
        apart=lambda parameters: np.concatenate([of.apart(parameters[:count]), parameters[count:]]),
    )


@lru_cache
def family(name: str) -> Family:
    """The family of a name. Raises ValueError for a name or an order that there is not."""
    if name in _FAMILIES:
        return _FAMILIES[name]
    if name.endswith(EXTENDED):
        return _extended(family(name.removesuffix(EXTENDED)))
    spelled = re.fullmatch(r"(\w+)\((\d+)\)", name)
    if spelled is None or spelled[1] not in _WITH_ORDER:
        raise ValueError(f"a distortion family must be one of {', '.join(FAMILY_NAMES)}, not {name}")
    orders, made = _WITH_ORDER[spelled[1]]
    order = int(spelled[2])
    if order not in orders:
        raise ValueError(f"the order of {spelled[1]} must be {orders[0]} to {orders[-1]}, not {order}")
    return made(order)


def parameter_names(name: str) -> tuple[str, ...]:
    """The parameters of a family, in their order. Raises ValueError for a name that there is not."""
    return family(name).parameters
