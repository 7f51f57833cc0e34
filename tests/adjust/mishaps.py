"""Networks with other faults than those of the catalogue of null directions, and what the program says of them."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from setups import CONVERGENT, FREE, HEIGHT, LEVEL_STATIONS, UNKNOWN, Setup, give_values, vertical
from simulated import STATIONS, field_points

from adjust.problem.network import Approximations, Network
from adjust.solution.adjustment import Options
from adjust.solution.result import Adjustment


def sentences(result: Adjustment) -> list[str]:
    """All that a result says: null directions, warnings, correlations, each with its cause and its remedy."""
    return [
        *(f"{each.cause} {each.remedy}" for each in result.singular),
        *result.warnings,
        *(f"{each.cause} {each.remedy}" for each in result.correlations),
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


def _collinear_stations() -> tuple[Network, Approximations]:
    """All targets of image f3 on a line, those of the others not."""
    points = np.vstack([field_points(np.random.default_rng(1), 9), _line])
    network, start = replace(_good, points=points).network()
    return _keep(network, lambda image, point, kind: not (image == "f3" and kind == "target" and int(point) < 9)), start


def _one_ray() -> tuple[Network, Approximations]:
    network, start = _all_unknown.network()
    return _keep(network, lambda image, point, kind: point != "3" or kind == "fiducial" or image == "f1"), start


def _line_of_sight() -> tuple[Network, Approximations]:
    """Point 0 in line with the two stations that show it."""
    points = field_points(np.random.default_rng(1), 14)
    first, second = np.array(STATIONS[0]), np.array([120.0, 40.0, 500.0])
    points[0] = first + (second - first) * (first[2] - 30.0) / (first[2] - second[2])
    setup = replace(_all_unknown, points=points, stations=(STATIONS[0], tuple(second), *STATIONS[2:]), noise=False)
    setup = replace(setup, attitudes=((0.0, 0.0, 0.1), (0.0, 0.0, 1.6), *CONVERGENT[2:]))
    network, start = setup.network()
    return _keep(network, lambda image, point, kind: point != "0" or kind == "fiducial" or image < "f2"), start


def _three_targets() -> tuple[Network, Approximations]:
    network, start = _good.network()
    return _keep(
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


def _keep(network: Network, keep: Callable[[str, str, str], bool]) -> Network:
    """The network with some of its observations."""
    rows = network.observations
    kept = [i for i, row in enumerate(zip(rows.image, rows.point, rows.kind, strict=True)) if keep(*row)]
    return replace(network, observations=rows.only(np.array(kept)))


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
        "One image whose targets all lie on a line", _collinear_stations, ("all its targets lie on one line",)
    ),
    "one-ray": Mishap(
        "An unknown point in one image only", _one_ray, ("Only image f1 shows point 3",), Options(datum="minimal")
    ),
    "in-line": Mishap(
        "An unknown point in line with its stations",
        _line_of_sight,
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
        ("The observations say nothing about c, x0 and y0 of camera K", "", "", ""),
    ),
    "nearly-flat": Mishap(
        "Relief of 2 cm under 1500 m, vertical to 0.00001 rad, c and principal point without priors",
        lambda: (give_values(_near.network()[0], {"x": 1.0, "y": 1.0}), _near.network()[1]),
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
