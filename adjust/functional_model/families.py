"""The table of distortion families: their parameters and what they do to a point or a ray.

A family with an order is spelled with it: "legendre(3)".
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.correction import Correction, Imaged, Settings, no_correction, undistorted
from adjust.functional_model.fourier_sets import by_order, fourier, fourier_names
from adjust.functional_model.juhl import JUHL_GROUPS, JUHL_NAMES, juhl
from adjust.functional_model.opencv_family import (
    OPENCV_DENOMINATOR,
    OPENCV_GROUPS,
    OPENCV_NAMES,
    expanded,
    opencv,
)
from adjust.functional_model.physical import (
    BROWN_GROUPS,
    BROWN_NAMES,
    TORLEGARD_GROUPS,
    TORLEGARD_NAMES,
    brown,
    torlegard,
)
from adjust.functional_model.polynomial_sets import EBNER, GRUEN, PolynomialSet, by_degree, correct, legendre

Array = NDArray[np.float64]

LEGENDRE_ORDERS = range(2, 10)  # from 2, the degree of the tilts that are left out, to one digit an index
FOURIER_ORDERS = range(1, 10)


@dataclass(frozen=True)
class Family:
    """A distortion family.

    parameters: their names. image(ray, parameters): what it does to the ray. correct(settings, xy, principal point,
    parameters): what is subtracted from the observed point. needs: the setting that it cannot do without. groups: the
    parameters that are one cause, or of one degree, by its name. alike_at_zero: parameters that do the same as others
    while they are 0; apart(parameters): others, of nearly the same distortion, with which they do not.
    """

    parameters: tuple[str, ...] = ()
    image: Callable[[Array, Array], Imaged] = undistorted
    correct: Callable[[Settings, Array, Array, Array], Correction] = no_correction
    needs: str = ""
    groups: tuple[tuple[str, tuple[str, ...]], ...] = ()
    alike_at_zero: tuple[str, ...] = ()
    apart: Callable[[Array], Array] = np.copy


def _polynomials(of: PolynomialSet) -> Family:
    return Family(of.names, correct=partial(correct, of), needs="half_mm", groups=by_degree(of))


def _legendre(order: int) -> Family:
    return _polynomials(legendre(order))


def _fourier(order: int) -> Family:
    return Family(fourier_names(order), correct=partial(fourier, order), needs="half_mm", groups=by_order(order))


_FAMILIES = {
    "none": Family(),
    "torlegard": Family(TORLEGARD_NAMES, correct=torlegard, groups=TORLEGARD_GROUPS),
    "brown": Family(BROWN_NAMES, correct=brown, groups=BROWN_GROUPS),
    "opencv": Family(
        OPENCV_NAMES, image=opencv, groups=OPENCV_GROUPS, alike_at_zero=OPENCV_DENOMINATOR, apart=expanded
    ),
    "juhl": Family(JUHL_NAMES, correct=juhl, needs="r0_mm", groups=JUHL_GROUPS),
    "ebner": _polynomials(EBNER),
    "gruen": _polynomials(GRUEN),
}
_WITH_ORDER: dict[str, tuple[range, Callable[[int], Family]]] = {
    "legendre": (LEGENDRE_ORDERS, _legendre),
    "fourier": (FOURIER_ORDERS, _fourier),
}
FAMILY_NAMES = (*_FAMILIES, *(f"{name}(n)" for name in _WITH_ORDER))


@lru_cache
def family(name: str) -> Family:
    """The family of a name. Raises ValueError for a name or an order that there is not."""
    if name in _FAMILIES:
        return _FAMILIES[name]
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
