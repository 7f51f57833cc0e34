"""Networks that cannot be adjusted, or hardly: one for every row of the catalogue of null directions, and others.

Each is simulated without errors, with its truth as approximations and, unless it says otherwise, with no prior on any
fiducial, on c, x0', y0' (F5 to F9 dropped).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import pi

import numpy as np
from numpy.typing import NDArray
from simulated import STATIONS, Truth, field_points, simulated

from adjust.adjustment import Options
from adjust.correlation import correlations
from adjust.network import (
    Approximations,
    Camera,
    Fiducial,
    Network,
    ObjectPoint,
    Observations,
    Prior,
    Transformation,
)
from adjust.result import Adjustment

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

FREE = np.inf
HEIGHT = 1500.0
LEVEL_STATIONS = ((0.0, 0.0, HEIGHT), (500.0, 100.0, HEIGHT), (-480.0, 80.0, HEIGHT), (60.0, 520.0, HEIGHT))
CONVERGENT = ((0.01, -0.02, 0.1), (-0.08, 0.36, 1.6), (-0.05, -0.29, 3.0), (-0.35, 0.03, -1.5))
TILTED = (0.2, 0.1, 0.3)
KNOWN, UNKNOWN, HEIGHTS = (0.0, 0.0, 0.0), (FREE, FREE, FREE), (FREE, FREE, 0.0)
AXES = ("Shift x", "Shift y", "Rotation", "Scale")
DEFORMATIONS = ("Affinity", "Shear")
POINT = ("principal point's x0'", "principal point's y0'")
DISTANCE = ("principal distance of camera K can change",)


@dataclass(frozen=True)
class Setup:
    """What a network is made of. sigma: of X, Y, Z of every point; prior: of c, x0', y0' and of all fiducials."""

    attitudes: tuple[Triple, ...]
    stations: tuple[Triple, ...] = STATIONS
    relief: float = 200.0
    sigma: Triple = KNOWN
    prior: float = FREE
    kind: Transformation = "affine"
    points: Array | None = None
    distortion: Mapping[str, float] = field(default_factory=dict)  # standard deviations; all values are 0
    noise: bool = False

    def network(self) -> tuple[Network, Approximations]:
        """The network, and the truth as its approximations."""
        parameters = dict.fromkeys(self.distortion, 0.0)
        truth = Truth(
            stations=self.stations,
            attitudes=self.attitudes,
            mirrored=(False,) * len(self.stations),
            distortion=parameters,
        )
        points = self.points
        if points is None:
            points = field_points(np.random.default_rng(1), 14, relief=1.0) * [1.0, 1.0, self.relief]
        rng = np.random.default_rng(0)
        network, start = simulated(rng, truth, self.kind, points, 0.0, dict(self.distortion), self.noise)
        exact = {
            f"f{i}": np.array([*station, *attitude])
            for i, (station, attitude) in enumerate(zip(self.stations, self.attitudes, strict=True))
        }
        network = replace(network, points=tuple(with_sigma(point, self.sigma) for point in network.points))
        return with_prior(network, self.prior), replace(start, exterior=exact)


def with_sigma(point: ObjectPoint, sigma: Triple) -> ObjectPoint:
    x, y, z = (
        None if prior is None else replace(prior, sigma=s)
        for prior, s in zip((point.X, point.Y, point.Z), sigma, strict=True)
    )
    return replace(point, X=x, Y=y, Z=z)


def with_prior(network: Network, sigma: float) -> Network:
    """All of F5 to F9 with one standard deviation."""
    return given(network, dict.fromkeys(("x", "y", "c", "x0", "y0"), sigma))


def given(network: Network, sigmas: Mapping[str, float], marks: int | None = None) -> Network:
    """Standard deviations for c, x0, y0 and for x and y of the first (None: all) fiducials, the others as they are."""
    camera = network.cameras[0]
    fiducials = {
        id_: Fiducial(
            replace(mark.x_mm, sigma=sigmas.get("x", mark.x_mm.sigma)),
            replace(mark.y_mm, sigma=sigmas.get("y", mark.y_mm.sigma)),
        )
        for id_, mark in list(camera.fiducials.items())[:marks]
    }
    changed = Camera(
        camera.name,
        _given(camera.principal_distance_mm, sigmas.get("c")),
        _given(camera.x0_mm, sigmas.get("x0")),
        _given(camera.y0_mm, sigmas.get("y0")),
        camera.distortion,
        {**camera.fiducials, **fiducials},
    )
    return replace(network, cameras=(changed,))


def _given(prior: Prior | None, sigma: float | None) -> Prior | None:
    return prior if prior is None or sigma is None else replace(prior, sigma=sigma)


def vertical(*kappas: float) -> tuple[Triple, ...]:
    return tuple((0.0, 0.0, kappa) for kappa in kappas)


def quarters(omega: float = 0.0, phi: float = 0.0, kappa: float = 0.0) -> tuple[Triple, ...]:
    """Four images turned by 0, 90, 180 and 270 degrees about their common axis."""
    return tuple((omega, phi, kappa + turn) for turn in (0.0, pi / 2, pi, -pi / 2))


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


def sentences(result: Adjustment) -> list[str]:
    """All that a result says: null directions, warnings, correlations, each with its cause and its remedy."""
    return [
        *(f"{each.cause} {each.remedy}" for each in result.singular),
        *result.warnings,
        *(f"{each.cause} {each.remedy}" for each in correlations(result)),
    ]


@dataclass(frozen=True)
class Mishap:
    """A network with another fault, and the words of what the program says of it, in order, correlations last."""

    title: str
    network: Callable[[], tuple[Network, Approximations]]
    words: tuple[str, ...]
    options: Options = field(default_factory=Options)


_good = Setup(CONVERGENT, prior=1.0, noise=True)
_near = Setup(
    ((0.0, 0.0, 0.0), (1e-5, 0.0, 1.5), (0.0, 1e-5, 3.1), (0.0, 0.0, -1.5)), LEVEL_STATIONS, relief=0.02, noise=True
)
_all_unknown = replace(_good, sigma=UNKNOWN)
_line = np.stack([np.linspace(-700.0, 700.0, 9), np.linspace(-300.0, 300.0, 9), np.zeros(9)], axis=1)
_deformed = Setup(
    vertical(0.1, 1.6, 3.0, -1.5), relief=20.0, prior=1.0, distortion={"k3": FREE, "k5": FREE}, noise=True
)


_narrow = Setup(
    vertical(0.0, 0.0, 0.0, 0.0),
    ((0.0, 0.0, HEIGHT), (100.0, 20.0, HEIGHT), (-100.0, 0.0, 1400.0), (20.0, -80.0, 1450.0)),
    prior=10.0,
    points=np.random.default_rng(4).uniform(-1.0, 1.0, (20, 3)) * [150.0, 150.0, 300.0],
    distortion={"k3": FREE, "p1": FREE, "p2": FREE},
    noise=True,
)


def _on_a_line() -> tuple[Network, Approximations]:
    """All targets of image f3 on a line, those of the others not."""
    points = np.vstack([field_points(np.random.default_rng(1), 9), _line])
    network, start = replace(_good, points=points).network()
    return _kept(network, lambda image, point, kind: not (image == "f3" and kind == "target" and int(point) < 9)), start


def _one_ray() -> tuple[Network, Approximations]:
    network, start = _all_unknown.network()
    return _kept(network, lambda image, point, kind: point != "3" or kind == "fiducial" or image == "f1"), start


def _in_line() -> tuple[Network, Approximations]:
    """Point 0 in line with the two stations that show it."""
    points = field_points(np.random.default_rng(1), 14)
    first, second = np.array(STATIONS[0]), np.array([120.0, 40.0, 500.0])
    points[0] = first + (second - first) * (first[2] - 30.0) / (first[2] - second[2])
    setup = replace(_all_unknown, points=points, stations=(STATIONS[0], tuple(second), *STATIONS[2:]), noise=False)
    setup = replace(setup, attitudes=((0.0, 0.0, 0.1), (0.0, 0.0, 1.6), *CONVERGENT[2:]))
    network, start = setup.network()
    return _kept(network, lambda image, point, kind: point != "0" or kind == "fiducial" or image < "f2"), start


def _three_targets() -> tuple[Network, Approximations]:
    network, start = _good.network()
    return _kept(
        network, lambda image, point, kind: not (image == "f3" and kind == "target" and point not in ("0", "1", "2"))
    ), start


def _swapped() -> tuple[Network, Approximations]:
    network, start = _good.network()
    rows = network.observations
    other = {"3": "7", "7": "3"}
    points = tuple(
        other.get(point, point) if image == "f1" and kind == "target" else point
        for image, point, kind in zip(rows.image, rows.point, rows.kind, strict=True)
    )
    return replace(network, observations=replace(rows, point=points)), start


def _kept(network: Network, keep: Callable[[str, str, str], bool]) -> Network:
    """The network with some of its observations."""
    rows = network.observations
    kept = [i for i, row in enumerate(zip(rows.image, rows.point, rows.kind, strict=True)) if keep(*row)]
    shorter = Observations(
        tuple(rows.image[i] for i in kept),
        tuple(rows.point[i] for i in kept),
        tuple(rows.kind[i] for i in kept),
        rows.xy_mm[kept],
        rows.covariance_mm2[kept],
    )
    return replace(network, observations=shorter)


MISHAPS: dict[str, Mishap] = {
    "no-datum": Mishap(
        "All points unknown, and nothing that fixes the object space",
        _all_unknown.network,
        tuple(
            f"The object space can {motion}"
            for motion in (
                "shift in X",
                "shift in Y",
                "shift in Z",
                "turn about X",
                "turn about Y",
                "turn about Z",
                "grow",
            )
        ),
    ),
    "congruent": Mishap(
        "Congruent transformations: one direction less, for the scale is the comparator's",
        Setup(CONVERGENT, kind="congruent").network,
        ("Shift x", "Shift y", "Rotation"),
    ),
    "projective": Mishap(
        "Projective transformations: the tilts too",
        Setup(CONVERGENT, kind="projective").network,
        ("Shift x", "Shift y", "Rotation", "Scale", "Tilt x", "Tilt y"),
    ),
    "targets-on-a-line": Mishap(
        "One image whose targets all lie on a line", _on_a_line, ("all its targets lie on one line",)
    ),
    "one-ray": Mishap(
        "An unknown point in one image only", _one_ray, ("Only image f1 shows point 3",), Options(datum="minimal")
    ),
    "in-line": Mishap(
        "An unknown point in line with its stations",
        _in_line,
        ("lies in line with the stations",),
        Options(datum="minimal"),
    ),
    "one-station": Mishap(
        "Unknown points, two images from one station",
        Setup(((0.0, 0.1, 0.0), (0.1, -0.2, 1.0)), ((0.0, 0.0, HEIGHT),) * 2, sigma=UNKNOWN, prior=1.0).network,
        ("were taken from one station",) * 11 + ("The exterior orientation of image",) * 2,
        Options(datum="minimal"),
    ),
    "single-flat": Mishap(
        "One vertical image of a flat field, priors of 1 mm",
        Setup(vertical(0.1), STATIONS[:1], relief=0.0, prior=1.0, noise=True).network,
        ("The observations say nothing about IO.K.c, IO.K.x0, IO.K.y0", "", "", ""),
    ),
    "nearly-flat": Mishap(
        "Relief of 2 cm under 1500 m, vertical to 0.00001 rad, c and principal point without priors",
        lambda: (given(_near.network()[0], {"x": 1.0, "y": 1.0}), _near.network()[1]),
        ("did not stand still", "principal point's x0'", "principal point's y0'", "principal distance of camera K can"),
        Options(iteration_limit=5),
    ),
    "low-relief": Mishap(
        "Relief of 20 m under 1500 m, vertical images: regular, and highly correlated",
        _deformed.network,
        ("c of camera K and Z0 of all images", "", ""),
    ),
    "narrow-field": Mishap(
        "A narrow field of view, with decentering: 20 points within 6 degrees, priors of 10 mm",
        _narrow.network,
        (
            "x0' of camera K and phi",
            "y0' of camera K and omega",
            "c of camera K",
            "p1 of camera K and phi",
            "x0' and p1",
        ),
    ),
    "three-targets": Mishap(
        "An image with three targets", _three_targets, ("Nothing checks the orientation of image f3", "c of camera K")
    ),
    "swapped": Mishap(
        "Two point numbers swapped in one image",
        _swapped,
        ("The points 3 and 7 of image f1", "c of camera K"),
    ),
}
