"""Table of the distortion families: parameters and formulas.

The name of a family with an order includes the order: "legendre(3)". All code that handles distortion uses this table.
A new family needs a formula with derivatives and an entry here.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from adjust.array_types import Array
from adjust.functional_model import correction, distortion_models, opencv_family

LEGENDRE_ORDERS = range(2, 10)  # from 2, the degree of the omitted tilts, to 9, so that an index has one digit
FOURIER_ORDERS = range(1, 10)


@dataclass(frozen=True)
class Family:
    """Distortion family."""

    parameters: tuple[str, ...] = ()  # names of the parameters
    image: correction.Image = correction.undistorted  # image of a ray (object-side families)
    correct: correction.Correct = (
        correction.no_correction
    )  # correction subtracted from the observed point (image-side families)
    units: tuple[str, ...] = ()  # units of the parameters; empty: mm
    needs: str = ""  # name of a required setting of `Distortion`
    y_down: tuple[str, ...] = ()  # parameters defined with y down that would change sign with y up
    groups: tuple[tuple[str, tuple[str, ...]], ...] = ()  # (name, parameters) of one physical cause or one degree
    ladder: tuple[str, ...] = ()  # parameter sets for model selection, simplest first
    alike_at_zero: tuple[str, ...] = ()  # parameters whose derivatives equal those of others while they are 0
    # returns parameters of nearly the same distortion at which those derivatives differ
    apart: Callable[[Array], Array] = np.copy
    is_pinhole_at_zero: bool = True  # whether there is no distortion while all parameters are 0

    def unit(self, parameter: str) -> str:
        return self.units[self.parameters.index(parameter)] if self.units else "mm"


def _polynomials(terms: distortion_models.PolynomialSet) -> Family:
    correct, groups = partial(distortion_models.correct, terms), distortion_models.degree_groups(terms)
    return Family(terms.names, correct=correct, needs="half_mm", groups=groups)


def _fourier(order: int) -> Family:
    names, groups = distortion_models.fourier_names(order), distortion_models.order_groups(order)
    return Family(names, correct=partial(distortion_models.fourier, order), needs="half_mm", groups=groups)


_UNITS = ("mm⁻²", "mm⁻⁴", "mm⁻⁶", "mm⁻¹", "mm⁻¹")  # of three radial and two decentering terms
_BROWN = Family(
    ("k1", "k2", "k3", "p1", "p2", "b1", "b2"),
    correct=distortion_models.brown,
    units=(*_UNITS, "–", "–"),
    groups=(("radial", ("k1", "k2", "k3")), ("decentering", ("p1", "p2")), ("affinity", ("b1", "b2"))),
    ladder=("k1", "k1 k2", "k1 p1 p2", "k1 k2 p1 p2", "k1 k2 k3 p1 p2"),
)
_FAMILIES = {
    "none": Family(),
    "torlegard": Family(
        distortion_models.TORLEGARD_NAMES,
        correct=distortion_models.torlegard,
        units=(*_UNITS, "mm⁻²", "mm⁻⁴"),
        groups=(("radial", ("k3", "k5", "k7")), ("decentering", ("p1", "p2"))),
        ladder=("k3", "k3 k5", "k3 p1 p2", "k3 k5 p1 p2", "k3 k5 k7 p1 p2"),
    ),
    "brown": _BROWN,
    "australis": replace(_BROWN, correct=distortion_models.australis),
    "aicon": Family(
        ("a1", "a2", "a3", "b1", "b2", "c1", "c2"),
        image=correction.ideal_point_family(distortion_models.aicon),
        units=(*_UNITS, "–", "–"),
        groups=(("radial", ("a1", "a2", "a3")), ("decentering", ("b1", "b2")), ("affinity", ("c1", "c2"))),
        ladder=("a1", "a1 a2", "a1 b1 b2", "a1 a2 b1 b2", "a1 a2 a3 b1 b2"),
    ),
    "opencv": Family(
        opencv_family.OPENCV_NAMES,
        image=correction.ray_family(opencv_family.opencv),
        units=(*["–"] * 12, "rad", "rad", "–", "–"),
        y_down=("p1", "s3", "s4", "tau_x", "b2"),
        groups=(
            ("radial", ("k1", "k2", "k3", "k4", "k5", "k6")),
            ("radial, denominator", opencv_family.OPENCV_DENOMINATOR),
            ("decentering", ("p1", "p2")),
            ("thin prism", ("s1", "s2", "s3", "s4")),
            ("tilt", ("tau_x", "tau_y")),
            ("affinity", ("b1", "b2")),
        ),
        ladder=("k1", "k1 k2", "k1 p1 p2", "k1 k2 p1 p2", "k1 k2 p1 p2 k3"),
        alike_at_zero=opencv_family.OPENCV_DENOMINATOR,
        apart=opencv_family.expand_parameters,
    ),
    "opencv_fisheye": Family(
        opencv_family.FISHEYE_NAMES,
        image=correction.ray_family(opencv_family.opencv_fisheye),
        units=("–",) * len(opencv_family.FISHEYE_NAMES),
        y_down=("b2",),
        groups=(("radial", ("k1", "k2", "k3", "k4")), ("affinity", ("b1", "b2"))),
        ladder=("k1", "k1 k2", "k1 k2 k3", "k1 k2 k3 k4"),
        is_pinhole_at_zero=False,
    ),
    "juhl": Family(
        ("t1", "t2", "t3", "t4", "r1", "r2", "r3", "af", "sh"),
        correct=distortion_models.juhl,
        units=("µm at 1 dm",) * 9,
        needs="r0_mm",
        groups=(("tangential", ("t1", "t2", "t3", "t4")), ("radial", ("r1", "r2", "r3")), ("affinity", ("af", "sh"))),
    ),
    "ebner": _polynomials(distortion_models.EBNER),
    "gruen": _polynomials(distortion_models.GRUEN),
}
_WITH_ORDER: dict[str, tuple[range, Callable[[int], Family]]] = {
    "legendre": (LEGENDRE_ORDERS, lambda order: _polynomials(distortion_models.legendre(order))),
    "fourier": (FOURIER_ORDERS, _fourier),
}
FAMILY_NAMES = (*_FAMILIES, *(f"{name}(n)" for name in _WITH_ORDER))


@lru_cache
def family(name: str) -> Family:
    """Return a family by name. Raises ValueError for an unknown name or order."""
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
    """Parameter names of a family in order. Raises ValueError for an unknown family."""
    return family(name).parameters
