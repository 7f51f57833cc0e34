"""The catalogue of null directions: a network that cannot be adjusted for every row, and what mends it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import pi

from setups import (
    CONVERGENT,
    HEIGHTS,
    KNOWN,
    LEVEL_STATIONS,
    TILTED,
    UNKNOWN,
    Setup,
    Triple,
    quarters,
    vertical,
)
from simulated import STATIONS

from adjust.solution.adjustment import Options

AXES = ("Shift x", "Shift y", "Rotation", "Scale")
DEFORMATIONS = ("Affinity", "Shear")
POINT = ("principal point's x0'", "principal point's y0'")
DISTANCE = ("principal distance of camera K can change",)


@dataclass(frozen=True)
class Failure:
    """A network, what it is in words, the words of its null directions in order, and what mends which of them."""

    title: str
    setup: Setup
    words: tuple[str, ...]
    mended: Mapping[str, tuple[Setup, tuple[str, ...]]]
    datum: str = "minimal"

    @property
    def options(self) -> Options:
        return Options(datum="minimal" if self.datum == "minimal" else "control")


def _more(setup: Setup, *attitudes: Triple) -> Setup:
    """With further images, taken from stations of their own."""
    further = ((-150.0, -520.0, 1450.0), (350.0, -380.0, 1550.0))[: len(attitudes)]
    return replace(setup, stations=setup.stations + further, attitudes=setup.attitudes + attitudes)


TILTS = ((0.3, 0.0, 0.4), (0.0, 0.33, -0.2))  # images tilted in different directions

_flat = Setup(vertical(0.1, 1.6, 3.0, -1.5), relief=0.0)
_tilted = Setup((TILTED,) * 4, relief=0.0)
_two = Setup(((0.1, -0.3, 0.2), (-0.05, 0.35, 0.1)), STATIONS[:2], relief=0.0)
_parallel = Setup(vertical(0.0, 0.0, 0.0, 0.0), sigma=UNKNOWN)
_half_turned = Setup(vertical(0.0, pi, 0.0, pi), sigma=UNKNOWN)
_turned = Setup(quarters(), sigma=UNKNOWN)
_crosswise = Setup(quarters(), LEVEL_STATIONS, relief=0.0, sigma=HEIGHTS)
_heights_parallel = Setup(vertical(0.0, 0.0, 0.0, 0.0), LEVEL_STATIONS, relief=0.0, sigma=HEIGHTS)
_heights_relief = Setup(quarters(), sigma=HEIGHTS)
_plane = Setup(CONVERGENT, relief=0.0, sigma=UNKNOWN)
_pair = Setup(CONVERGENT[:2], STATIONS[:2], sigma=UNKNOWN)

CATALOGUE: dict[str, Failure] = {
    "known-flat-vertical": Failure(
        "Known points, flat field, vertical images, any kappa",
        _flat,
        (*AXES, *POINT, *DISTANCE),
        {
            "add images tilted in different directions": (_more(_flat, *TILTS), POINT + DISTANCE),
            "points at other heights": (replace(_flat, relief=200.0), POINT + DISTANCE),
        },
    ),
    "known-flat-tilted": Failure(
        "Known points, flat field, one tilted attitude for all images",
        _tilted,
        (*AXES, *DEFORMATIONS, *DISTANCE),
        {
            "images turned by 90 degrees about their axes": (
                replace(_tilted, attitudes=quarters(*TILTED)),
                DEFORMATIONS + DISTANCE,
            ),
            "tilted in different directions": (_more(_tilted, *TILTS), DEFORMATIONS + DISTANCE),
            "points at other heights": (replace(_tilted, relief=200.0), DISTANCE),
        },
    ),
    "known-flat-two": Failure(
        "Known points, flat field, two convergent images",
        _two,
        (*AXES, "Affinity"),
        {
            "images turned by 90 degrees about their axes": (_more(_two, (-0.05, 0.35, 0.1 + pi / 2)), DEFORMATIONS),
            "tilted in other directions": (_more(_two, TILTS[0]), DEFORMATIONS),
        },
    ),
    "known-relief": Failure(
        "Known points, three-dimensional field, even vertical images of one kappa",
        Setup(vertical(0, 0, 0, 0)),
        AXES,
        {},
    ),
    "unknown-convergent": Failure("Unknown points, convergent images", Setup(CONVERGENT, sigma=UNKNOWN), AXES, {}),
    "unknown-parallel": Failure(
        "Unknown points, parallel axes, equal kappa",
        _parallel,
        (*AXES, *DEFORMATIONS, *POINT, *DISTANCE),
        {
            "images turned by 180 degrees about their axes": (
                replace(_parallel, attitudes=vertical(0, pi, 0, 0)),
                POINT,
            ),
            "images turned by 90 degrees about their axes": (
                replace(_parallel, attitudes=vertical(0, pi / 2, 0, 0)),
                DEFORMATIONS,
            ),
            "tilted in different directions": (_more(_parallel, *TILTS), DEFORMATIONS + POINT + DISTANCE),
            "known points (X, Y, Z) at different heights": (
                replace(_parallel, sigma=KNOWN),
                DEFORMATIONS + POINT + DISTANCE,
            ),
        },
    ),
    "unknown-half-turned": Failure(
        "Unknown points, parallel axes, kappa 0 and 180 degrees",
        _half_turned,
        (*AXES, *DEFORMATIONS, *DISTANCE),
        {
            "images turned by 90 degrees about their axes": (
                replace(_half_turned, attitudes=vertical(0, pi, pi / 2, pi)),
                DEFORMATIONS,
            ),
            "tilted in different directions": (_more(_half_turned, *TILTS), DEFORMATIONS + DISTANCE),
        },
    ),
    "unknown-turned": Failure(
        "Unknown points, vertical images, kappa spread, three-dimensional field",
        _turned,
        (*AXES, *DISTANCE),
        {
            "tilted in different directions": (_more(_turned, *TILTS), DISTANCE),
            "known points (X, Y, Z) at different heights": (replace(_turned, sigma=KNOWN), DISTANCE),
        },
    ),
    "heights-flat-crosswise": Failure(
        "Only heights known, flat field, vertical images crosswise (Juhl)",
        _crosswise,
        (*AXES, *POINT, *DISTANCE),
        {
            "tilted in different directions": (_more(_crosswise, *TILTS), POINT + DISTANCE),
            "known points (X, Y, Z) at different heights": (
                replace(_crosswise, sigma=KNOWN, relief=200.0),
                POINT + DISTANCE,
            ),
        },
    ),
    "heights-flat-parallel": Failure(
        "Only heights known, flat field, parallel axes, equal kappa",
        _heights_parallel,
        (*AXES, *DEFORMATIONS, *POINT, *DISTANCE),
        {
            "images turned by 90 degrees about their axes": (
                replace(_heights_parallel, attitudes=vertical(0, pi / 2, 0, 0)),
                DEFORMATIONS,
            ),
            "tilted in different directions": (_more(_heights_parallel, *TILTS), POINT + DISTANCE),
        },
    ),
    "heights-relief-crosswise": Failure(
        "Only heights known, field with relief, vertical images crosswise",
        _heights_relief,
        (*AXES, *DISTANCE),
        {
            "tilted in different directions": (_more(_heights_relief, *TILTS), DISTANCE),
            "known points (X, Y, Z) at different heights": (replace(_heights_relief, sigma=KNOWN), DISTANCE),
        },
    ),
    "unknown-plane": Failure(
        "Unknown points of a plane, four convergent images",
        _plane,
        (*AXES, "Affinity"),
        {"tilted in other directions": (_more(_plane, (0.33, -0.2, 0.8)), DEFORMATIONS)},
    ),
    "unknown-pair": Failure(
        "Unknown points, one convergent pair",
        _pair,
        (*AXES, *DEFORMATIONS, *DISTANCE),
        {"tilted in different directions": (_more(_pair, TILTS[0]), DEFORMATIONS + DISTANCE)},
    ),
}
