"""Networks with faults: the catalogue of null directions, mishaps, blunders, and models that lack something."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import pi

import networks as nets
import numpy as np
from numpy.typing import NDArray

from adjust import Adjustment, AdjustmentError, Camera, Distortion, Options, Prior, adjust
from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles
from adjust.problem.network import Approximations, Exterior, Network, ObjectPoint
from adjust.quality.critical_values import Probabilities

AXES = ("Shift x", "Shift y", "Rotation", "Scale")
DEFORMATIONS = ("Affinity", "Shear")
POINT = ("principal point's x0'", "principal point's y0'")
DISTANCE = ("principal distance of camera K can change",)


QUARTER_TURNS = "images turned by 90 degrees about their axes"
HALF_TURNS = "images turned by 180 degrees about their axes"
OTHER_TILTS = "tilted in different directions"
KNOWN_HEIGHTS = "known points (X, Y, Z) at different heights"


@dataclass(frozen=True)
class Failure:
    """A network, what it is in words, the words of its null directions in order, and what mends which of them."""

    title: str
    setup: nets.Setup
    words: tuple[str, ...]
    mended: Mapping[str, tuple[nets.Setup, tuple[str, ...]]]
    options: Options = field(default_factory=lambda: Options(datum="minimal"))


def _more(setup: nets.Setup, *attitudes: nets.Triple) -> nets.Setup:
    """With further images, taken from stations of their own."""
    further = ((-150.0, -520.0, 1450.0), (350.0, -380.0, 1550.0))[: len(attitudes)]
    return replace(setup, stations=setup.stations + further, attitudes=setup.attitudes + attitudes)


TILTS = ((0.3, 0.0, 0.4), (0.0, 0.33, -0.2))  # images tilted in different directions

_flat = nets.Setup(nets.vertical(0.1, 1.6, 3.0, -1.5), relief=0.0)
_tilted = nets.Setup((nets.TILTED,) * 4, relief=0.0)
_two = nets.Setup(((0.1, -0.3, 0.2), (-0.05, 0.35, 0.1)), nets.STATIONS[:2], relief=0.0)
_parallel = nets.Setup(nets.vertical(0.0, 0.0, 0.0, 0.0), sigma=nets.UNKNOWN)
_half_turned = nets.Setup(nets.vertical(0.0, pi, 0.0, pi), sigma=nets.UNKNOWN)
_turned = nets.Setup(nets.quarters(), sigma=nets.UNKNOWN)
_crosswise = nets.Setup(nets.quarters(), nets.LEVEL_STATIONS, relief=0.0, sigma=nets.HEIGHTS)
_heights_parallel = nets.Setup(nets.vertical(0.0, 0.0, 0.0, 0.0), nets.LEVEL_STATIONS, relief=0.0, sigma=nets.HEIGHTS)
_heights_relief = nets.Setup(nets.quarters(), sigma=nets.HEIGHTS)
_plane = nets.Setup(nets.CONVERGENT, relief=0.0, sigma=nets.UNKNOWN)
_pair = nets.Setup(nets.CONVERGENT[:2], nets.STATIONS[:2], sigma=nets.UNKNOWN)

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
            QUARTER_TURNS: (replace(_tilted, attitudes=nets.quarters(*nets.TILTED)), DEFORMATIONS + DISTANCE),
            OTHER_TILTS: (_more(_tilted, *TILTS), DEFORMATIONS + DISTANCE),
            "points at other heights": (replace(_tilted, relief=200.0), DISTANCE),
        },
    ),
    "known-flat-two": Failure(
        "Known points, flat field, two convergent images",
        _two,
        (*AXES, "Affinity"),
        {
            QUARTER_TURNS: (_more(_two, (-0.05, 0.35, 0.1 + pi / 2)), DEFORMATIONS),
            "tilted in other directions": (_more(_two, TILTS[0]), DEFORMATIONS),
        },
    ),
    "known-relief": Failure(
        "Known points, three-dimensional field, even vertical images of one kappa",
        nets.Setup(nets.vertical(0, 0, 0, 0)),
        AXES,
        {},
    ),
    "unknown-convergent": Failure(
        "Unknown points, convergent images", nets.Setup(nets.CONVERGENT, sigma=nets.UNKNOWN), AXES, {}
    ),
    "unknown-parallel": Failure(
        "Unknown points, parallel axes, equal kappa",
        _parallel,
        (*AXES, *DEFORMATIONS, *POINT, *DISTANCE),
        {
            HALF_TURNS: (replace(_parallel, attitudes=nets.vertical(0, pi, 0, 0)), POINT),
            QUARTER_TURNS: (replace(_parallel, attitudes=nets.vertical(0, pi / 2, 0, 0)), DEFORMATIONS),
            OTHER_TILTS: (_more(_parallel, *TILTS), DEFORMATIONS + POINT + DISTANCE),
            KNOWN_HEIGHTS: (replace(_parallel, sigma=nets.KNOWN), DEFORMATIONS + POINT + DISTANCE),
        },
    ),
    "unknown-half-turned": Failure(
        "Unknown points, parallel axes, kappa 0 and 180 degrees",
        _half_turned,
        (*AXES, *DEFORMATIONS, *DISTANCE),
        {
            QUARTER_TURNS: (replace(_half_turned, attitudes=nets.vertical(0, pi, pi / 2, pi)), DEFORMATIONS),
            OTHER_TILTS: (_more(_half_turned, *TILTS), DEFORMATIONS + DISTANCE),
        },
    ),
    "unknown-turned": Failure(
        "Unknown points, vertical images, kappa spread, three-dimensional field",
        _turned,
        (*AXES, *DISTANCE),
        {
            OTHER_TILTS: (_more(_turned, *TILTS), DISTANCE),
            KNOWN_HEIGHTS: (replace(_turned, sigma=nets.KNOWN), DISTANCE),
        },
    ),
    "heights-flat-crosswise": Failure(
        "Only heights known, flat field, vertical images crosswise (Juhl)",
        _crosswise,
        (*AXES, *POINT, *DISTANCE),
        {
            OTHER_TILTS: (_more(_crosswise, *TILTS), POINT + DISTANCE),
            KNOWN_HEIGHTS: (replace(_crosswise, sigma=nets.KNOWN, relief=200.0), POINT + DISTANCE),
        },
    ),
    "heights-flat-parallel": Failure(
        "Only heights known, flat field, parallel axes, equal kappa",
        _heights_parallel,
        (*AXES, *DEFORMATIONS, *POINT, *DISTANCE),
        {
            QUARTER_TURNS: (replace(_heights_parallel, attitudes=nets.vertical(0, pi / 2, 0, 0)), DEFORMATIONS),
            OTHER_TILTS: (_more(_heights_parallel, *TILTS), POINT + DISTANCE),
        },
    ),
    "heights-relief-crosswise": Failure(
        "Only heights known, field with relief, vertical images crosswise",
        _heights_relief,
        (*AXES, *DISTANCE),
        {
            OTHER_TILTS: (_more(_heights_relief, *TILTS), DISTANCE),
            KNOWN_HEIGHTS: (replace(_heights_relief, sigma=nets.KNOWN), DISTANCE),
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
        {OTHER_TILTS: (_more(_pair, TILTS[0]), DEFORMATIONS + DISTANCE)},
    ),
}


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


_good = nets.Setup(nets.CONVERGENT, prior=1.0, noise=True)
_near = nets.Setup(
    ((0, 0, 0), (1e-5, 0, 1.5), (0, 1e-5, 3.1), (0, 0, -1.5)), nets.LEVEL_STATIONS, relief=0.02, noise=True
)
_all_unknown = replace(_good, sigma=nets.UNKNOWN)
_line = np.stack([np.linspace(-700.0, 700.0, 9), np.linspace(-300.0, 300.0, 9), np.zeros(9)], axis=1)
_deformed = nets.Setup(
    nets.vertical(0.1, 1.6, 3.0, -1.5), relief=20, prior=1.0, distortion={"k3": nets.FREE, "k5": nets.FREE}, noise=True
)


_narrow = nets.Setup(
    nets.vertical(0.0, 0.0, 0.0, 0.0),
    ((0.0, 0.0, nets.HEIGHT), (100.0, 20.0, nets.HEIGHT), (-100.0, 0.0, 1400.0), (20.0, -80.0, 1450.0)),
    prior=10.0,
    points=np.random.default_rng(4).uniform(-1.0, 1.0, (20, 3)) * [150.0, 150.0, 300.0],
    distortion={"k3": nets.FREE, "p1": nets.FREE, "p2": nets.FREE},
    noise=True,
)


def _collinear_stations() -> tuple[Network, Approximations]:
    """All targets of image f3 on a line, those of the others not."""
    points = np.vstack([nets.field_points(np.random.default_rng(1), 9), _line])
    network, start = replace(_good, points=points).network()
    return nets.keep_rows(
        network, lambda image, point, kind: image != "f3" or kind != "target" or int(point) >= 9
    ), start


def _one_ray() -> tuple[Network, Approximations]:
    network, start = _all_unknown.network()
    return nets.keep_rows(
        network, lambda image, point, kind: point != "3" or kind == "fiducial" or image == "f1"
    ), start


def _line_of_sight() -> tuple[Network, Approximations]:
    """Point 0 in line with the two stations that show it."""
    points = nets.field_points(np.random.default_rng(1), 14)
    first, second = np.array(nets.STATIONS[0]), np.array([120.0, 40.0, 500.0])
    points[0] = first + (second - first) * (first[2] - 30.0) / (first[2] - second[2])
    setup = replace(
        _all_unknown, points=points, stations=(nets.STATIONS[0], tuple(second), *nets.STATIONS[2:]), noise=False
    )
    setup = replace(setup, attitudes=((0.0, 0.0, 0.1), (0.0, 0.0, 1.6), *nets.CONVERGENT[2:]))
    network, start = setup.network()
    return nets.keep_rows(network, lambda image, point, kind: point != "0" or kind == "fiducial" or image < "f2"), start


def _three_targets() -> tuple[Network, Approximations]:
    network, start = _good.network()
    return nets.keep_rows(
        network, lambda image, point, kind: image != "f3" or kind != "target" or int(point) < 3
    ), start


def _swapped() -> tuple[Network, Approximations]:
    network, start = _good.network()
    rows = network.observations
    other = {"3": "7", "7": "3"}
    points = tuple(
        other.get(point, point) if image == "f1" and kind == "target" else point
        for image, point, kind in zip(rows.image, rows.point, rows.kind, strict=True)
    )
    return nets.set_observations(network, point=points), start


MISHAPS: dict[str, Mishap] = {
    "no-datum": Mishap(
        "All points unknown, and nothing that fixes the object space",
        _all_unknown.network,
        (
            *(f"The object space can {motion} {axis}" for motion in ("shift in", "turn about") for axis in "XYZ"),
            "The object space can grow",
        ),
    ),
    "congruent": Mishap(
        "Congruent transformations: one direction less, for the scale is the comparator's",
        nets.Setup(nets.CONVERGENT, kind="congruent").network,
        ("Shift x", "Shift y", "Rotation"),
    ),
    "projective": Mishap(
        "Projective transformations: the tilts too",
        nets.Setup(nets.CONVERGENT, kind="projective").network,
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
        nets.Setup(
            ((0.0, 0.1, 0.0), (0.1, -0.2, 1.0)), ((0.0, 0.0, nets.HEIGHT),) * 2, sigma=nets.UNKNOWN, prior=1.0
        ).network,
        ("were taken from one station",) * 11 + ("The exterior orientation of image",) * 2,
        Options(datum="minimal"),
    ),
    "single-flat": Mishap(
        "One vertical image of a flat field, priors of 1 mm",
        nets.Setup(nets.vertical(0.1), nets.STATIONS[:1], relief=0.0, prior=1.0, noise=True).network,
        ("The observations say nothing about c, x0 and y0 of camera K", "", "", ""),
    ),
    "nearly-flat": Mishap(
        "Relief of 2 cm under 1500 m, vertical to 0.00001 rad, c and principal point without priors",
        lambda: (nets.give_values(_near.network()[0], {"x": 1.0, "y": 1.0}), _near.network()[1]),
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
        "Two point numbers swapped in one image", _swapped, ("The points 3 and 7 of image f1", "c of camera K")
    ),
}


Array = NDArray[np.float64]

EXACT = np.array([0.05, 0.05, 0.05, 1e-4, 1e-4, 1e-4])  # of observed stations (m) and attitudes (rad)
APPROXIMATE = np.full(6, np.inf)
MIRRORS = "The points are mirrored: the sign of X, Y or Z of all of them is wrong, or two axes are exchanged"


def blunder_network(seed: int, oriented: Array | None = None, relief: float = 200.0) -> Network:
    """Four images of a field of 14 to 30 points known to 5 cm, taken anew for every seed; their orientations, if asked
    for, as they are observed, or roughly where no sigmas are."""
    rng = np.random.default_rng([7, seed])
    truth = nets.Truth()
    moved = tuple(tuple(each) for each in np.array(truth.stations) + rng.normal(0.0, 60.0, (4, 3)))
    turns = rng.normal(0.0, [0.05, 0.05, 1.5], (4, 3))
    tilted = tuple(tuple(each) for each in np.array(truth.attitudes) + turns)
    truth = replace(truth, stations=moved, attitudes=tilted, distortion={"k3": 2e-8, "p1": 2e-8})
    points = nets.field_points(rng, int(rng.integers(14, 31)), relief)
    made, _ = nets.simulated(rng, truth, points=points, fiducial_sigma=0.01, point_sigma=0.05)
    made = nets.set_camera(made, principal_distance_mm=Prior(truth.c, 0.0))
    if oriented is None:
        return made
    errors = np.where(np.isfinite(oriented), oriented, [20.0, 20.0, 20.0, 0.03, 0.03, 0.03])
    exteriors = [Exterior(exterior + errors * rng.normal(size=6), oriented) for exterior in truth.exteriors]
    return nets.orient(made, {f"f{i}": exterior for i, exterior in enumerate(exteriors)})


def change_points(given: Network, changed: Callable[[Array], Array], sigma: float = 1.0) -> Network:
    points = []
    for point in given.points:
        priors = [prior for prior in (point.X, point.Y, point.Z) if prior]
        xyz = changed(np.array([prior.value for prior in priors]))
        of_axes = zip(xyz, priors, strict=True)
        points.append(ObjectPoint(point.id, *(Prior(float(value), sigma * prior.sigma) for value, prior in of_axes)))
    return replace(given, points=tuple(points))


def y_down(given: Network) -> Network:
    return nets.map_priors(
        given, lambda name, prior: replace(prior, value=-prior.value) if name.endswith(".y") else prior
    )


def other_c(given: Network) -> Network:
    return shift_given(given, "IO.K.c", 10.0)


def shift_given(given: Network, name: str, off: float) -> Network:
    return nets.map_priors(
        given, lambda each, prior: replace(prior, value=prior.value + off) if each == name else prior
    )


def exchanged(given: Network, with_fiducials: bool = False, frames: str = "13") -> Network:
    """The targets of frames, or all their marks, under the next one's name, of the last under the first's."""
    other = {f"f{one}": f"f{next_one}" for one, next_one in zip(frames, frames[1:] + frames[:1], strict=True)}
    observations = given.observations
    rows = zip(observations.image, observations.kind, strict=True)
    image = tuple(other.get(name, name) if with_fiducials or kind == "target" else name for name, kind in rows)
    return nets.set_observations(given, image=image)


def reread(given: Network, read: Callable[[Array], object]) -> Network:
    """With the orientations (images, 6) of a table that is read otherwise, in place."""
    exteriors = {image.name: image.exterior for image in given.images if image.exterior is not None}
    values = np.array([each.values for each in exteriors.values()])
    read(values)
    rows = zip(exteriors.items(), values, strict=True)
    return nets.orient(given, {name: replace(each, values=row) for (name, each), row in rows})


def _scale(columns: slice, factor: float) -> Callable[[Network], Network]:
    def read(values: Array) -> None:
        values[:, columns] *= factor

    return lambda given: reread(given, read)


def _exchange(one: int, other: int) -> Callable[[Network], Network]:
    def read(values: Array) -> None:
        values[:, [one, other]] = values[:, [other, one]]

    return lambda given: reread(given, read)


def two_cameras(seed: int, apart_mm: float, sigma_mm: float) -> Network:
    """Four images each of two cameras, A and B, over one field; c and fiducials of B are apart_mm (rms) off A's."""
    rng = np.random.default_rng([11, seed])
    points, made = nets.field_points(rng, 18), []
    for name in "AB":
        c = 153.0 + apart_mm * (name == "B")
        moved = tuple(tuple(each) for each in np.array(nets.STATIONS) + rng.normal(0.0, 60.0, (4, 3)))
        tilted = tuple(tuple(each) for each in np.array(nets.ATTITUDES) + rng.normal(0.0, [0.05, 0.05, 1.5], (4, 3)))
        truth = replace(nets.Truth(), c=c, stations=moved, attitudes=tilted)
        usual = dict(nets.FIDUCIALS)
        if name == "B":
            nets.FIDUCIALS.update({id_: tuple(rng.normal(xy, apart_mm)) for id_, xy in usual.items()})
        one, start = nets.simulated(rng, truth, points=points, fiducial_sigma=sigma_mm)
        nets.FIDUCIALS.update(usual)
        one = nets.set_camera(one, principal_distance_mm=Prior(c, sigma_mm))
        made.append(nets.rename_network(one, start, name, str, lambda image, name=name: name + image[1:], str))  # type: ignore[misc]
    return nets.join_networks(*made)[0]


def one_point(given: Network) -> Network:
    return shift_given(given, f"PT.{given.points[0].id}.X", 200.0)


def inaccurate_points(given: Network, sigma: float) -> Network:
    """With further errors of the given points' coordinates."""
    rng = np.random.default_rng(len(given.points))
    moved = {f"PT.{point.id}.{axis}": float(rng.normal(0.0, sigma)) for point in given.points for axis in "XYZ"}
    return nets.map_priors(given, lambda name, prior: replace(prior, value=prior.value + moved.get(name, 0.0)))


@dataclass(frozen=True)
class Blunder:
    """A blunder: how the network is otherwise given, how it is spoilt, and what has to be said of it."""

    oriented: Array | None
    spoil: Callable[[Network], Network]
    words: tuple[str, ...]


BLUNDERS = {
    "sign of X": Blunder(None, lambda n: change_points(n, lambda p: p * [-1, 1, 1]), (MIRRORS,)),
    "sign of Z": Blunder(None, lambda n: change_points(n, lambda p: p * [1, 1, -1]), (MIRRORS,)),
    "X and Y exchanged": Blunder(None, lambda n: change_points(n, lambda p: p[[1, 0, 2]]), (MIRRORS,)),
    "sign of X, approximate orientations": Blunder(
        APPROXIMATE, lambda n: change_points(n, lambda p: p * [-1, 1, 1]), ("The sign of X of all points is wrong. ",)
    ),
    "X and Y exchanged, approximate orientations": Blunder(
        APPROXIMATE, lambda n: change_points(n, lambda p: p[[1, 0, 2]]), ("X and Y of all points are exchanged. ",)
    ),
    "sign of Z, observed orientations": Blunder(
        EXACT, lambda n: change_points(n, lambda p: p * [1, 1, -1]), ("The sign of Z of all points is wrong. ",)
    ),
    "y of the camera down": Blunder(None, y_down, ("y' axis of the camera's fiducial marks points down",)),
    "y of the camera down, approximate orientations": Blunder(
        APPROXIMATE, y_down, ("The y' axis of the camera's fiducial marks points down",)
    ),
    "c 10 mm too long": Blunder(None, other_c, ("principal distance of camera K is not the 163 mm",)),
    "targets of two frames exchanged": Blunder(None, exchanged, ("targets of the frames f1 and f3 are exchanged",)),
    "mm for m, approximate orientations": Blunder(
        APPROXIMATE, lambda n: change_points(n, lambda p: 1000.0 * p, 1000.0), ("points are 1000 times too large",)
    ),
    "mm for m, observed orientations": Blunder(
        EXACT, lambda n: change_points(n, lambda p: 1000.0 * p, 1000.0), ("points are 1000 times too large",)
    ),
    "names of two frames exchanged, approximate orientations": Blunder(
        APPROXIMATE, lambda n: exchanged(n, with_fiducials=True), ("their names are exchanged",)
    ),
    "names shifted by a line, approximate orientations": Blunder(
        APPROXIMATE, lambda n: exchanged(n, True, "".join(each.name[1:] for each in n.images)), ("where another's",)
    ),
    "sign of X0, approximate orientations": Blunder(APPROXIMATE, _scale(slice(0, 1), -1.0), ("X0 with the other",)),
    "sign of Y0, observed orientations": Blunder(EXACT, _scale(slice(1, 2), -1.0), ("Y0 with the other sign",)),
    "X0 and Y0 exchanged, approximate orientations": Blunder(APPROXIMATE, _exchange(0, 1), ("X0 and Y0 exchanged",)),
    "sign of kappa, approximate orientations": Blunder(APPROXIMATE, _scale(slice(5, 6), -1.0), ("kappa with the",)),
    "omega and phi exchanged, observed orientations": Blunder(EXACT, _exchange(3, 4), ("omega and phi exchanged",)),
    "gon for degrees, observed orientations": Blunder(EXACT, _scale(slice(3, 6), 10.0 / 9.0), ("angles in gon",)),
    "sign of all angles, observed orientations": Blunder(EXACT, _scale(slice(3, 6), -1.0), ("all angles with the",)),
    "Z0 in feet, approximate orientations": Blunder(APPROXIMATE, _scale(slice(2, 3), 3.2808), ("Z0 0.3048 times",)),
    "stations in feet, observed orientations": Blunder(EXACT, _scale(slice(0, 3), 3.2808), ("3.281 times too small",)),
    "sheared films held rigid": Blunder(
        None,
        lambda n: nets.set_images(n, transformation="similarity"),
        ("film deformation model, similarity, is too simple",),
    ),
    "standard deviations of the points ten times too small": Blunder(
        None, lambda n: inaccurate_points(n, 0.5), ("given to the object points are too small everywhere",)
    ),
    "one point": Blunder(None, one_point, ("Control point 0 is not where it is given",)),
    "nothing": Blunder(None, lambda n: n, ()),
    "nothing, approximate orientations": Blunder(APPROXIMATE, lambda n: n, ()),
}  # fmt: skip


def blunder_sentences(spoilt: Network) -> list[str]:
    """What a user is told: the message, or the warnings and what is called suspect."""
    try:
        result = adjust(spoilt)
    except AdjustmentError as error:
        return [str(error)]
    causes = (each.cause for each in result.explanations)
    return [*causes, *result.warnings, *(f"{each.tested.name} is suspect" for each in result.suspects)]


WHOLE = ("exchanged", "another reading", "wrong", "points down", "times too", "principal distance of camera")
SINGLE = ("is suspect", "is not where", "swapped")


def blunder_outcome(kind: Blunder, sentences: list[str]) -> str:
    """named: what is to be said, and nothing that blames anything else; misleading: something else is blamed.

    Beside a point that is named, tests of single observations may tell of its neighbours; no other blunder's blame may
    stand there.
    """
    is_single = any(words in named for words in SINGLE for named in kind.words)
    others = WHOLE if is_single else WHOLE + SINGLE
    named = [each for each in sentences if any(words in each for words in kind.words)]
    if any(words in each for words in others for each in sentences if each not in named):
        return "misleading"
    return "named" if named or not kind.words else "unnamed"


C_MM, HALF_MM, SIGMA_MM = 10.0, np.array([6.4, 4.8]), 0.001
MIDDLE_MM = np.array([6.4, -4.8])  # of the picture, in the comparator
NOTHING, NOISE = "nothing", "noise too small"
MANY = 3.0  # times what a test detects
LENS = {"k1": -0.22, "k2": 0.11, "p1": 4e-4, "p2": -3e-4, "k3": -0.02}


@dataclass(frozen=True)
class Scene:
    """What a network is projected from: points (p, 3), stations and rotations; groups (m,): how far images differ."""

    points: Array
    rotations: Array
    stations: Array
    point_mm: Array
    groups: Array


@dataclass(frozen=True)
class Effects:
    """What the pictures have and the model does not, in the unit of each."""

    b1: float = 0.0
    b2: float = 0.0
    bow: float = 0.0
    radial: float = 0.0
    k1: float = 0.0
    c: float = 0.0
    tangential: float = 0.0
    zoom: float = 0.0
    crop: float = 0.0
    scale: float = 0.0
    bend: float = 0.0
    stretch: float = 0.0
    shear: float = 0.0
    height: float = 0.0
    disk: float = 0.0
    twist: float = 0.0
    cylinder: float = 0.0
    drift: float = 0.0
    breathing: float = 0.0
    row: float = 0.0
    side: float = 0.0
    jump: float = 0.0
    jumps: float = 0.0
    motion: float = 0.0
    third: float = 0.0
    numbers_off: int = 0
    point: float = 0.0
    noise: float = 1.0
    pitch: float = 1.0
    object_unit: float = 1.0
    mirrored: bool = False
    group_mirrored: bool = False
    y_down: bool = False


@dataclass(frozen=True)
class Misfit:
    """A misfit: its effect of size 1, the free parameters of the lens, how many unknowns its test has, the words.

    held: what is given as exact; boards, fields: which of them; sized: whether it has a size; c_given, stations_given,
    frame_given: what else the network knows.
    """

    effect: Callable[[float], Effects]
    words: tuple[str, ...]
    free: tuple[str, ...] = ("k1", "k2", "p1", "p2", "k3")
    lens: dict[str, float] = field(default_factory=lambda: LENS)
    size: int = 1
    boards: bool = True
    fields: bool = True
    sized: bool = True
    c_given: bool = False
    stations_given: bool = False
    frame_given: bool = False
    disk_radius: float | None = 0.0
    sigma: float = 1.0
    point_held: bool = False
    held: tuple[str, ...] = ()


def scene(seed: int, flat: bool) -> Scene:
    rng = np.random.default_rng([36, seed])
    count = int(rng.integers(6, 11))
    if flat:
        columns, rows = int(rng.integers(6, 10)), int(rng.integers(5, 8))
        x, y = np.meshgrid(np.arange(columns) * 25.0, np.arange(rows) * 25.0)
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    else:
        points = rng.uniform(-1.0, 1.0, (40, 3)) * [120.0, 90.0, 80.0]
    middle = points.mean(axis=0)
    angles = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(-np.pi, np.pi, count)])
    rotations = rotation_from_angles(angles)
    extent = np.linalg.norm(np.ptp(points[:, :2], axis=0))
    distance = rng.uniform(1.0, 1.6, count) * extent * C_MM / (2.0 * HALF_MM[1])
    aim = middle + rng.uniform(-0.12, 0.12, (count, 3)) * extent
    stations = aim + distance[:, None] * np.einsum("nji,j->ni", rotations, [0.0, 0.0, 1.0])
    groups = np.zeros(count)
    groups[rng.permutation(count)[: max(2, count // 3)]] = 1.0
    return Scene(points, rotations, stations, MIDDLE_MM + rng.normal(0.0, 0.1, 2), groups)


def misfit_network(made: Scene, effects: Effects, kind: Misfit, rng: np.random.Generator | None) -> Network:
    """The network as it is given: square pixels, one c, one size, the lens of `kind.free`; rng None: no noise."""
    names, places = [], []
    for i, (rotation, station) in enumerate(zip(made.rotations, made.stations, strict=True)):
        projected = _projected(made, effects, kind, i, rotation, station)
        inside = np.flatnonzero((np.abs(projected - MIDDLE_MM) < HALF_MM).all(axis=1))
        off = effects.numbers_off if made.groups[i] else 0
        names += [(f"im{i:02d}", f"p{(k + off) % len(made.points)}") for k in inside]
        places.append(projected[inside])
    xy_mm = np.concatenate(places)
    if rng is not None:
        xy_mm = xy_mm + rng.normal(0.0, SIGMA_MM * kind.sigma * effects.noise, xy_mm.shape)
    xy_mm = effects.pitch * xy_mm * [1.0, -1.0 if effects.y_down else 1.0]
    given = {name: Prior(0.0, np.inf) for name in kind.free}
    given |= {name: Prior(kind.lens[name], 0.0) for name in kind.held if name != "c"}
    middle = effects.pitch * MIDDLE_MM * [1.0, -1.0 if effects.y_down else 1.0]
    c = Prior(C_MM, 0.0 if "c" in kind.held else 0.005) if kind.c_given or "c" in kind.held else None
    frame = (float(2.0 * HALF_MM[0]), float(2.0 * HALF_MM[1])) if kind.frame_given else (0.0, 0.0)
    x0, y0 = (Prior(float(value) + 0.3, 0.0) if kind.point_held else None for value in middle)
    camera = Camera("cam", c, x0, y0, Distortion("opencv", given), {}, (float(middle[0]), float(middle[1])), frame)
    exterior = _exteriors(made) if kind.stations_given else {}
    rows = [(*name, xy) for name, xy in zip(names, xy_mm, strict=True)]
    points = {f"p{k}": effects.object_unit * xyz for k, xyz in enumerate(made.points)}
    given_network = nets.digital_network(camera, rows, points, effects.pitch * kind.sigma * SIGMA_MM)
    return replace(nets.orient(given_network, exterior), disk_radius=kind.disk_radius)


def _exteriors(made: Scene) -> dict[str, Exterior]:
    """Stations and attitudes as they are known beforehand, roughly."""
    rows = zip(made.stations, made.rotations, strict=True)
    return {
        f"im{i:02d}": Exterior(np.concatenate([station + 10.0, angles_from_rotation(rotation) + 0.02]))
        for i, (station, rotation) in enumerate(rows)
    }


def _projected(made: Scene, effects: Effects, kind: Misfit, image: int, rotation: Array, station: Array) -> Array:
    """Comparator coordinates (p, 2) in mm, y up; the lens is OpenCV's, y down."""
    points = made.points.copy()
    low, high = points.min(axis=0), points.max(axis=0)
    relative = (2.0 * points - low - high)[:, :2] / (high - low)[:2]
    points[:, 2] += effects.bend * (1.0 - relative[:, 0] ** 2) + effects.twist * relative[:, 0] * relative[:, 1]
    points[:, 2] += effects.cylinder * (1.0 - relative.sum(axis=1) ** 2 / 2.0)
    lines = np.unique(made.points[:, 1])
    points[made.points[:, 1] == lines[1 % len(lines)], 0] -= effects.row
    points[made.points[:, 1] > lines[len(lines) // 2], 1] -= effects.side
    off = np.random.default_rng(len(points)).normal(size=points.shape) * [1.0, 1.0, 0.3]
    points[::4] += effects.third * off[::4]
    points[:, 1] *= 1.0 + effects.stretch
    points[:, 2] *= 1.0 + effects.height
    points[:, 0] += effects.shear * points[:, 1]
    points[WRONG_POINT, :2] -= effects.point

    def imaged(places: Array) -> Array:
        u, v, w = np.moveaxis((places - station) @ rotation.T, -1, 0)
        return _through_lens(effects, kind, -u / w, v / w, C_MM + effects.c + zoom_mm)

    own = float(made.groups[image])
    order = image / (len(made.stations) - 1) - 0.5
    nearness = 1.0 / np.linalg.norm(made.stations - made.points.mean(axis=0), axis=1)
    near = float((nearness[image] - nearness.mean()) / np.ptp(nearness))
    zoom_mm = own * effects.zoom + order * effects.drift + near * effects.breathing
    at = imaged(points) + made.point_mm
    if effects.disk:
        angles = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
        circle = np.sqrt(abs(effects.disk)) * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        at += np.sign(effects.disk) * (center_of_gravity(imaged(points[:, None] + circle)) - imaged(points))
    at[:, 0] += own * effects.crop + effects.bow * (at[:, 1] - MIDDLE_MM[1]) ** 2
    at[:, 1] += 0.7 * own * effects.crop
    jumped = effects.jumps + effects.jump * (image == int(np.argmax(made.groups)))
    at[:, 0] += jumped * (at[:, 1] > MIDDLE_MM[1] + 1.0)
    moved = effects.motion * np.random.default_rng([len(points), image]).normal(size=2)
    at += moved * ((at[:, 1:] - MIDDLE_MM[1]) / HALF_MM[1])
    if (effects.mirrored and image == int(np.argmax(made.groups))) or (effects.group_mirrored and own):
        at[:, 0] = 2.0 * MIDDLE_MM[0] - at[:, 0]
    return np.asarray(at * (1.0 + own * effects.scale))


def _through_lens(effects: Effects, kind: Misfit, x: Array, y: Array, c: float) -> Array:
    """Places (..., 2) of rays in mm from the principal point, y up."""
    lens = dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0) | kind.lens
    r2 = x**2 + y**2
    radial = 1.0 + (lens["k1"] + effects.k1) * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3 + effects.radial * r2**2
    p1, p2 = lens["p1"] + effects.tangential, lens["p2"] - effects.tangential
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
    yd = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
    return np.stack([c * (xd * (1.0 + effects.b1) + effects.b2 * yd), -c * yd], axis=-1)


def center_of_gravity(outline: Array) -> Array:
    """Of polygons (n, k, 2)."""
    following = np.roll(outline, -1, axis=1)
    area = outline[..., 0] * following[..., 1] - following[..., 0] * outline[..., 1]
    return np.asarray(((outline + following) * area[..., None]).sum(axis=1) / (3.0 * area.sum(axis=1))[:, None])


WRONG_POINT = 17
MISFITS = {
    NOTHING: Misfit(lambda e: Effects(), ()),
    "pixels not square": Misfit(lambda e: Effects(b1=1e-3 * e), ("pixels of camera cam are not square",)),
    "axes not perpendicular": Misfit(lambda e: Effects(b2=1e-3 * e), ("are not perpendicular",)),
    "pictures bowed": Misfit(lambda e: Effects(bow=1e-4 * e), ("are bowed",), size=2),
    "two principal distances": Misfit(lambda e: Effects(zoom=0.05 * e), ("another principal distance",)),
    "sizes: scaled": Misfit(lambda e: Effects(scale=0.01 * e), ("images of different sizes in one camera (scaled)",)),
    "sizes: cropped": Misfit(
        lambda e: Effects(crop=0.05 * e), ("images of different sizes in one camera (cropped)",), size=2
    ),
    "sizes: cropped and enlarged": Misfit(
        lambda e: Effects(crop=-0.8, scale=0.3), ("pictures cropped and enlarged",), sized=False
    ),
    "principal point held wrong": Misfit(
        lambda e: Effects(), ("camera cam as exact is not that of the images",), sized=False, point_held=True
    ),
    "c held wrong": Misfit(
        lambda e: Effects(c=0.05 * e), ("camera cam as exact is not that of the images",), held=("c",)
    ),
    "k1 held wrong": Misfit(
        lambda e: Effects(k1=0.01 * e), ("or what is given as exact, k1, is wrong",), free=("k2", "p1", "p2"),
        held=("k1",)
    ),
    "a group of images mirrored, frame_mm": Misfit(
        lambda e: Effects(group_mirrored=True), ("are mirrored",), sized=False, frame_given=True
    ),
    "Z in feet": Misfit(
        lambda e: Effects(height=1.0 / 3.2808 - 1.0), ("Z of all points is 3.281 times", "along Z than"),
        sized=False, boards=False,
    ),
    "Y in another unit": Misfit(
        lambda e: Effects(stretch=-0.9), ("Y of all points is 10 times", "X of all points is 10 times"),
        sized=False
    ),
    "lens: no radial term": Misfit(
        lambda e: Effects(radial=0.01 * e), ("have a radial pattern",), free=(), lens={}, size=2
    ),
    "lens: k1 alone": Misfit(
        lambda e: Effects(radial=0.05 * e), ("have a radial pattern",), free=("k1", "p1", "p2"),
        lens={"k1": -0.2, "p1": 4e-4}, size=2
    ),
    "lens: k2 held": Misfit(
        lambda e: Effects(radial=0.05 * e), ("have a radial pattern, of the degrees 5",),
        free=("k1", "p1", "p2", "k3"), lens={"k1": -0.2, "p1": 4e-4}, size=2
    ),
    "lens: no decentering": Misfit(
        lambda e: Effects(tangential=5e-4 * e), ("have a tangential pattern",), free=("k1", "k2"),
        lens={"k1": -0.2, "k2": 0.1}, size=2
    ),
    "board bent": Misfit(lambda e: Effects(bend=0.5 * e), ("is not flat",), size=3, fields=False),
    "board stretched": Misfit(
        lambda e: Effects(stretch=1e-3 * e), ("has another shape than given",), size=2, fields=False
    ),
    "object stretched": Misfit(
        lambda e: Effects(stretch=1e-3 * e), ("object of the given points has another shape",), size=5, boards=False
    ),
    "object: heights too large": Misfit(
        lambda e: Effects(height=1e-3 * e), ("object of the given points has another shape",), size=5, boards=False
    ),
    "object sheared": Misfit(
        lambda e: Effects(shear=1e-3 * e), ("object of the given points has another shape",), size=5, boards=False
    ),
    "disks of another diameter": Misfit(
        lambda e: Effects(disk=50.0 * e), ("disks do not have the diameter",), fields=False, disk_radius=11.0, sigma=0.1
    ),
    "dots of a diameter that nobody gave": Misfit(
        lambda e: Effects(disk=50.0 * abs(e)), ("points are centres of dots",), fields=False, disk_radius=None,
        sigma=0.1
    ),
    "board twisted": Misfit(
        lambda e: Effects(twist=0.5 * e), ("board of the given points is twisted",), size=3, fields=False
    ),
    "board bent over a diagonal": Misfit(
        lambda e: Effects(cylinder=0.5 * e), ("two opposite corners stand",), size=3, fields=False
    ),
    "focus drifts": Misfit(lambda e: Effects(drift=0.05 * e), ("from the first image to the last",)),
    "focus breathes with the distance": Misfit(
        lambda e: Effects(breathing=0.05 * e), ("from the farthest image to the nearest",)
    ),
    "a row of points shifted": Misfit(
        lambda e: Effects(row=0.1 * e), ("(a row) are not where they are given",), size=3, fields=False
    ),
    "half the board shifted": Misfit(
        lambda e: Effects(side=0.1 * e), ("all on one side of a line",), size=3, fields=False
    ),
    "rows of an image jump": Misfit(lambda e: Effects(jump=0.01 * e), ("All marks of image im",), size=2),
    "pictures moved": Misfit(
        lambda e: Effects(motion=0.01 * e),
        ("distorted each in its own way",),
        free=("k1", "k2", "p1", "p2", "b1"),
        size=16,
    ),
    "rows of all images jump": Misfit(lambda e: Effects(jumps=0.01 * e), ("All marks of the images of",), size=2),
    "a quarter of the points elsewhere": Misfit(
        lambda e: Effects(third=2.0), ("points are not where they are given",), sized=False
    ),
    "numbers of a third of the images one off": Misfit(
        lambda e: Effects(numbers_off=1), ("their numbers are 1 too high",), sized=False
    ),
    "a point is elsewhere": Misfit(
        lambda e: Effects(point=0.1 * e), (f"Point p{WRONG_POINT} is not where it is given",), size=3
    ),
    "pitch ten times too large": Misfit(
        lambda e: Effects(pitch=10.0), ("principal distance of camera cam is not the 10 mm",), sized=False, c_given=True
    ),
    "mm for m, stations in m": Misfit(
        lambda e: Effects(object_unit=1000.0), ("points are 1000 times too large",), sized=False, stations_given=True
    ),
    "one image mirrored": Misfit(lambda e: Effects(mirrored=True), ("is mirrored",), sized=False),
    "one image mirrored, frame_mm": Misfit(
        lambda e: Effects(mirrored=True), ("is mirrored",), sized=False, frame_given=True
    ),
    "y downward, frame_mm": Misfit(
        lambda e: Effects(y_down=True), ("points down",), sized=False, frame_given=True
    ),
    NOISE: Misfit(lambda e: Effects(noise=1.0 + 0.5 * e), ("too small everywhere",)),
}  # fmt: skip


def draw_network(name: str, seed: int, many: float = MANY) -> Network:
    """A network of a kind, its effect so many times what its test detects, with either sign."""
    kind = MISFITS[name]
    flat = kind.boards and (seed % 2 == 0 or not kind.fields)
    made = scene(seed, flat)
    rng = np.random.default_rng([37, seed])
    sign = 1.0 if rng.random() < 0.5 else -1.0
    return misfit_network(made, kind.effect((sign if name != NOISE else 1) * _size(name, kind, made, many)), kind, rng)


def _size(name: str, kind: Misfit, made: Scene, many: float) -> float:
    if name == NOTHING or not kind.sized:
        return 1.0
    wanted = float((many * Probabilities().noncentrality(kind.size)) ** 2)
    if name == NOISE:
        count = 2 * len(misfit_network(made, Effects(), kind, None).observations)
        return 2.0 * float(np.sqrt(1.0 + many * 4.13 * np.sqrt(2.0 / count)) - 1.0)  # of the test of v'Pv
    size = 1.0
    for _ in range(2):
        result = adjust(misfit_network(made, kind.effect(size), kind, None))
        size *= float(np.sqrt(wanted / result.vpv))
    return size


def misfit_sentences(given: Network) -> tuple[list[str], float]:
    """What a user is told to look at, and sigma0; nan where nothing is adjusted."""
    try:
        result = adjust(given)
    except AdjustmentError as error:
        return [str(error)], np.nan
    causes = [each.cause for each in result.explanations]
    suspects = [f"{each.tested.name} is suspect" for each in result.suspects]
    return [*causes, *result.warnings, *suspects], result.sigma0


def misfit_outcome(name: str, sentences: list[str]) -> str:
    """named: what is wrong, and nothing else; misleading: anything else; unnamed: nothing."""
    words = MISFITS[name].words
    wrong = [each for each in sentences if not any(word in each for word in words)]
    if wrong:
        return "misleading"
    return "named" if sentences or not words else "unnamed"
