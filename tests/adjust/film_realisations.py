"""Frames of fiducials alone with every film transformation: truth, given coordinates and noise drawn anew each time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Approximations, Image, Network, Transformation
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

CAMERA = "K"
NOMINAL_MM = np.array(
    [(-106, 106), (106, 106), (106, -106), (-106, -106), (0, 112), (112, 0), (0, -112), (-112, 0)], dtype=np.float64
)
NOISE_MM = 0.005
BEND = 1e-2  # mm at 100 mm from the middle: what films of higher order bend


@dataclass(frozen=True)
class Frames:
    """A network, and the truth: places (m, 2), films, values by the unknowns' names."""

    network: Network
    places_mm: Array
    films: tuple[Film, ...]
    values: Mapping[str, float]

    @property
    def start(self) -> Approximations:
        """The true films: where the iteration starts matters to no result, and to time."""
        names = (image.name for image in self.network.images)
        return Approximations({}, {}, {n: film.parameters for n, film in zip(names, self.films, strict=True)}, {})


def frames(
    kind: Transformation, count: int, marks: int, stated_mm: float, true_mm: float, rng: Generator, noise: float = 1.0
) -> Frames:
    """Frames of one camera whose marks are given with a standard deviation; true_mm: that of the given coordinates in
    truth, noise: that of the comparator over the stated one."""
    given = NOMINAL_MM[:marks]
    places = given + true_mm * rng.standard_normal(given.shape)
    ids = tuple(str(i + 1) for i in range(marks))
    films = tuple(drawn_film(kind, rng) for _ in range(count))
    rows, values = [], dict[str, float]()
    for name, film in zip(make_names(count), films, strict=True):
        source, regular = film.comparator_from_camera(places)
        assert regular.all()
        rows.append(source + noise * NOISE_MM * rng.standard_normal(places.shape))
        values |= {f"T.{name}.{p}": float(v) for p, v in zip(film_parameter_names(kind), film.parameters, strict=True)}
    for id_, place in zip(ids, places, strict=True):
        values |= {f"FID.{CAMERA}.{id_}.{axis}": float(v) for axis, v in zip("xy", place, strict=True)}
    return Frames(make_network(kind, given, stated_mm, np.array(rows)), places, films, values)


def make_network(kind: Transformation, given_mm: Array, stated_mm: float, comparator_mm: Array) -> Network:
    """Of marks (m, 2) as given, and as measured in n frames (n, m, 2)."""
    count, marks = comparator_mm.shape[:2]
    ids, images = tuple(str(i + 1) for i in range(marks)), make_names(count)
    fiducials = {i: Fiducial(Prior(x, stated_mm), Prior(y, stated_mm)) for i, (x, y) in zip(ids, given_mm, strict=True)}
    kinds: tuple[ObservationKind, ...] = tuple("fiducial" for _ in range(count * marks))
    return Network(
        (Camera(CAMERA, None, None, None, fiducials=fiducials),),
        tuple(Image(name, CAMERA, kind) for name in images),
        (),
        Observations(
            tuple(np.repeat(images, marks).tolist()),
            ids * count,
            kinds,
            comparator_mm.reshape(-1, 2),
            np.tile(NOISE_MM**2 * np.eye(2), (len(kinds), 1, 1)),
        ),
    )


def make_names(count: int) -> tuple[str, ...]:
    return tuple(f"f{i}" for i in range(count))


def drawn_film(kind: Transformation, rng: Generator) -> Film:
    """One that turns, shifts, and does a little of all that its kind can."""
    turn, shift = rng.uniform(-0.03, 0.03), rng.normal(0.0, 3.0, 2)
    scale = 1.0 if kind == "congruent" else 1.0 + 1e-3 * rng.standard_normal()
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    shear = 1e-3 * rng.standard_normal((2, 2))
    known = {"angle": turn, "p": c, "q": s, "a1": shift[0], "b1": shift[1]}
    if kind.startswith("conformal"):
        known |= {"a2": c, "b2": s}
    else:
        known |= {"a2": c + shear[0, 0], "a3": -s + shear[0, 1], "b2": s + shear[1, 0], "b3": c + shear[1, 1]}
    names = film_parameter_names(kind)
    parameters = [
        known[name] if name in known else BEND * rng.standard_normal() * 100.0 ** -_degree(kind, name) for name in names
    ]
    return Film(kind, np.array(parameters), np.zeros(2))


def _degree(kind: str, name: str) -> int:
    """The power of mm by which a parameter's unit is below the mm."""
    number = int(name[1:])
    if kind.startswith("conformal"):
        return number - 1
    if kind == "projective":
        return 2  # c1 and c2 divide coordinates of 100 mm
    return next(degree for degree in range(6) if (degree + 1) * (degree + 2) // 2 >= number)


def errors(result: Adjustment, truth: Frames) -> Iterator[tuple[str, float, float]]:
    """Kind of quantity, error and standard deviation of every unknown."""
    for name in result.names:
        if name in truth.values:
            kind = "fiducials" if name.startswith("FID.") else _film_kind(name)
            yield kind, result.value(name) - truth.values[name], result.sigma(name)


def _film_kind(name: str) -> str:
    return "shifts" if name.endswith((".a1", ".b1")) else "other film parameters"
