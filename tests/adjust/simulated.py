"""Networks simulated with formulas of their own, term by term: nothing of them comes from the code under test."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Decentering, Distortion, Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Approximations, Image, Network, ObjectPoint, Transformation
from adjust.problem.observations import ObservationKind, Observations

Array = NDArray[np.float64]

KINDS = (
    "none", "congruent", "similarity", "affine", "projective", "bilinear",
    "conformal(1)", "conformal(2)", "conformal(3)", "polynomial(1)", "polynomial(2)", "polynomial(3)",
)  # fmt: skip
FIDUCIALS = {"1": (106.0, -106.0), "2": (-106.0, -106.0), "3": (-106.0, 106.0), "4": (106.0, 106.0), "5": (0.0, -113.0)}
HALF_MM = 114.0
STATIONS = ((0.0, 0.0, 1500.0), (500.0, 100.0, 1400.0), (-480.0, 80.0, 1600.0), (60.0, 520.0, 1480.0))
ATTITUDES = ((0.01, -0.02, 0.1), (-0.08, 0.36, 1.6), (-0.05, -0.29, 3.0), (-0.35, 0.03, -1.5))


@dataclass(frozen=True)
class Truth:
    """What a network is simulated from. middle_mm: of the images, in the comparator."""

    c: float = 153.0
    x0: float = 0.4
    y0: float = -0.3
    family: str = "torlegard"
    decentering: Decentering = "reduced"
    distortion: dict[str, float] = field(default_factory=lambda: {"k3": 1.5e-7, "k5": -4e-12, "p1": 8e-7, "p2": -6e-7})
    stations: tuple[tuple[float, float, float], ...] = STATIONS
    attitudes: tuple[tuple[float, float, float], ...] = ATTITUDES
    mirrored: tuple[bool, ...] = (False, False, False, False)
    middle_mm: tuple[float, float] = (0.0, 0.0)


def rotation(omega: float, phi: float, kappa: float) -> Array:
    """R3(kappa) R2(phi) R1(omega) as a product of three."""
    so, co, sp, cp, sk, ck = (f(a) for a in (omega, phi, kappa) for f in (np.sin, np.cos))
    r1 = np.array([[1, 0, 0], [0, co, so], [0, -so, co]])
    r2 = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    r3 = np.array([[ck, sk, 0], [-sk, ck, 0], [0, 0, 1]])
    return np.asarray(r3 @ r2 @ r1)


def torlegard(truth: Truth, x: Any, y: Any) -> tuple[Any, Any]:
    """dx, dy at an observed camera point, with r0 = 0."""
    p = dict.fromkeys(("k3", "k5", "k7", "p1", "p2", "p3", "p4"), 0.0) | truth.distortion
    xr, yr = x - truth.x0, y - truth.y0
    r2 = xr * xr + yr * yr
    ex, ey = (x, y) if truth.decentering == "paper" else (xr, yr)
    rad = p["k3"] * r2 + p["k5"] * r2 * r2 + p["k7"] * r2**3
    dec = 1 + p["p3"] * r2 + p["p4"] * r2 * r2
    dx = xr * rad + (p["p1"] * (r2 + 2 * ex * ex) + 2 * p["p2"] * ex * ey) * dec
    dy = yr * rad + (2 * p["p1"] * ex * ey + p["p2"] * (r2 + 2 * ey * ey)) * dec
    return dx, dy


def ebner(truth: Truth, x: Any, y: Any) -> tuple[Any, Any]:
    """dx, dy at an observed camera point by Ebner's twelve parameters in mm, the half frame the unit of length."""
    b = [0.0] + [truth.distortion.get(f"b{i}", 0.0) for i in range(1, 13)]
    u, v = (x - truth.x0) / HALF_MM, (y - truth.y0) / HALF_MM
    k, m = u * u - 2 / 3, v * v - 2 / 3
    dx = b[1] * u + b[2] * v - 2 * b[3] * k + b[4] * u * v + b[5] * m + b[7] * u * m + b[9] * k * v + b[11] * k * m
    dy = -b[1] * v + b[2] * u + b[3] * u * v - 2 * b[4] * m + b[6] * k + b[8] * k * v + b[10] * u * m + b[12] * k * m
    return dx, dy


def camera_point(truth: Truth, image: int, xyz: Array) -> Array:
    """Where object points (..., 3) are observed in the camera frame: the ideal point plus the correction there."""
    u, v, w = rotation(*truth.attitudes[image]) @ np.transpose(xyz - np.array(truth.stations[image]))
    correction = ebner if truth.family == "ebner" else torlegard
    ideal = np.array([truth.x0 - truth.c * u / w, truth.y0 - truth.c * v / w])

    xy = ideal
    for _ in range(12):  # the corrections contract: each turn leaves about a hundredth of the error
        xy = ideal + np.array(correction(truth, xy[0], xy[1]))
    return xy.T


def affine(truth: Truth, image: int, kind: Transformation) -> Array:
    """The film and scanner of an image: a turn, a shift, and what its kind allows beyond them."""
    turn = 0.05 + 1.3 * image
    c, s = np.cos(turn), np.sin(turn)
    m = -1.0 if truth.mirrored[image] else 1.0
    scale = 1.0 if kind == "congruent" else 1.001
    stretch = 1.0 if kind in ("congruent", "similarity") or kind.startswith("conformal") else 1.0003
    linear = scale * np.array([[stretch * c, -m * s], [s, m * c]])
    a1, b1 = np.array([3.0 - image, 1.0 + image]) - linear @ truth.middle_mm
    return np.array([a1, *linear[0], b1, *linear[1]])


def field_points(rng: np.random.Generator, count: int, relief: float = 200.0) -> Array:
    return rng.uniform([-800.0, -800.0, -relief], [800.0, 800.0, relief], (count, 3))


def simulated(
    rng: np.random.Generator,
    truth: Truth | None = None,
    kind: Transformation = "affine",
    points: Array | None = None,
    point_sigma: float = 0.0,
    free: dict[str, float] | None = None,
    noise: bool = True,
    fiducial_sigma: float = 1.0,
) -> tuple[Network, Approximations]:
    """A network of one camera K, with 4 um noise on targets and 3 um on fiducials, and its rounded truth as a start.

    point_sigma: of all object coordinates, 0 known, inf unknown. free: the distortion parameters that are unknown, with
    a prior's standard deviation.
    """
    truth = truth or Truth()
    points = field_points(rng, 12) if points is None else points
    rows: list[tuple[str, str, str, Array, float]] = []
    for i in range(len(truth.stations)):
        film = film_parameters(truth, i, kind)
        marks = [(id_, "fiducial", np.array(xy), 0.003) for id_, xy in FIDUCIALS.items()] if kind != "none" else []
        marks += [(str(j), "target", xy, 0.004) for j, xy in enumerate(camera_point(truth, i, points))]
        observed = comparator_point(kind, film, truth.mirrored[i], np.array([xy for _, _, xy, _ in marks]))
        for (id_, what, _, sigma), xy in zip(marks, observed, strict=True):
            rows.append((f"f{i}", id_, what, xy + noise * rng.normal(0.0, sigma, 2), sigma))
    given = {name: Prior(value, (free or {}).get(name, 0.0)) for name, value in truth.distortion.items()}
    spread = fiducial_sigma * noise
    camera = Camera(
        "K",
        Prior(truth.c + noise * rng.normal(0.0, 1.0), 1.0),
        Prior(truth.x0 + noise * rng.normal(0.0, 1.0), 1.0),
        Prior(truth.y0 + noise * rng.normal(0.0, 1.0), 1.0),
        Distortion(truth.family, given, truth.decentering, half_mm=(HALF_MM, HALF_MM)),
        {
            id_: Fiducial(*(Prior(value + spread * rng.normal(), fiducial_sigma) for value in xy))
            for id_, xy in FIDUCIALS.items()
        },
    )
    offset = noise * point_sigma if np.isfinite(point_sigma) else 0.0
    object_points = tuple(
        ObjectPoint(str(j), *(Prior(float(value + offset * rng.normal()), point_sigma) for value in xyz))
        for j, xyz in enumerate(points)
    )
    observations = Observations(
        tuple(row[0] for row in rows),
        tuple(row[1] for row in rows),
        tuple("fiducial" if row[2] == "fiducial" else "target" for row in rows),
        np.array([row[3] for row in rows]),
        np.array([row[4] ** 2 * np.eye(2) for row in rows]),
    )
    images = tuple(Image(f"f{i}", "K", kind) for i in range(len(truth.stations)))
    return Network((camera,), images, object_points, observations), start_of(truth, kind, points)


def row_of(network: Network, kind: ObservationKind, image: str, point: str) -> int:
    """Where an observation stands."""
    rows = network.observations
    return list(zip(rows.kind, rows.image, rows.point, strict=True)).index((kind, image, point))


def with_errors(network: Network, errors: dict[int, Array]) -> Network:
    """With errors in mm in the observations of some rows."""
    xy_mm = network.observations.xy_mm.copy()
    for row, error in errors.items():
        xy_mm[row] += error
    return replace(network, observations=replace(network.observations, xy_mm=xy_mm))


def with_covariance(network: Network, covariance_mm2: Array) -> Network:
    return replace(network, observations=replace(network.observations, covariance_mm2=covariance_mm2))


def without_rows(network: Network, rows: list[int]) -> Network:
    kept = np.setdiff1d(np.arange(len(network.observations)), rows)
    return replace(network, observations=network.observations.only(kept))


def digital_network(
    camera: Camera, rows: Sequence[tuple[str, str, Array]], xyz: dict[str, Array], sigma: float
) -> Network:
    """Known points in images of a digital camera; rows: image, point and comparator coordinates of its marks."""
    images, points, xy_mm = zip(*rows, strict=True)
    kinds: tuple[ObservationKind, ...] = tuple("target" for _ in rows)
    return Network(
        (camera,),
        tuple(Image(name, camera.name, "none") for name in dict.fromkeys(images)),
        tuple(ObjectPoint(id_, *(Prior(float(value)) for value in place)) for id_, place in xyz.items()),
        Observations(images, points, kinds, np.array(xy_mm), np.tile(sigma**2 * np.eye(2), (len(rows), 1, 1))),
    )


def join_observations(*parts: Observations) -> Observations:
    """Observations behind one another."""
    return Observations(
        tuple(chain.from_iterable(each.image for each in parts)),
        tuple(chain.from_iterable(each.point for each in parts)),
        tuple(chain.from_iterable(each.kind for each in parts)),
        np.concatenate([each.xy_mm for each in parts]),
        np.concatenate([each.covariance_mm2 for each in parts]),
    )


def start_of(truth: Truth, kind: Transformation, points: Array) -> Approximations:
    """The truth, coarsely rounded."""
    films = [film_parameters(truth, i, kind) for i in range(len(truth.stations))]
    return Approximations(
        interior={"K": np.array([truth.c, truth.x0, truth.y0])},
        exterior={
            f"f{i}": np.concatenate([np.round(station, -1), np.round(attitude, 2)])
            for i, (station, attitude) in enumerate(zip(truth.stations, truth.attitudes, strict=True))
        },
        transformation={f"f{i}": np.round(film, 3) for i, film in enumerate(films)},
        points={str(j): xyz for j, xyz in enumerate(points)},
        mirrored=frozenset(f"f{i}" for i, mirrored in enumerate(truth.mirrored) if mirrored),
    )


def film_parameters(truth: Truth, image: int, kind: Transformation) -> Array:
    """The parameters of an image's film: `affine`, and a bend of some hundredths of a millimetre."""
    film = affine(truth, image, kind)
    bend = np.random.default_rng(100 + image).uniform(-1.0, 1.0, 42)
    match kind:
        case "none":
            return np.empty(0)
        case "congruent":
            return np.array([film[0], film[3], np.arctan2(film[4], film[1])])
        case "similarity":
            return np.asarray(film[[0, 3, 1, 4]])
        case "affine":
            return film
        case "projective":
            return np.append(film, 1e-4 * bend[:2])
        case "bilinear":
            return np.array([*film[:3], 5e-6 * bend[0], *film[3:], 5e-6 * bend[1]])
    order = int(kind[-2])
    if kind.startswith("conformal"):
        powers = np.repeat(np.arange(2, order + 1), 2)
        return np.array([film[0], film[3], film[1], film[4], *(0.05 / 100.0**powers * bend[: len(powers)])])
    degrees = np.array([degree for degree in range(2, order + 1) for _ in range(degree + 1)])
    terms = 0.05 / 100.0**degrees * bend[: 2 * len(degrees)].reshape(2, -1)
    return np.array([*film[:3], *terms[0], *film[3:], *terms[1]])


def camera_of_film(kind: Transformation, p: Array, mirrored: bool, x: Any, y: Any) -> tuple[Any, Any]:
    """The formulas of the film transformations, term by term."""
    m = -1.0 if mirrored else 1.0
    match kind:
        case "none":
            return x, y
        case "congruent":
            return p[0] + np.cos(p[2]) * x - m * np.sin(p[2]) * y, p[1] + np.sin(p[2]) * x + m * np.cos(p[2]) * y
        case "similarity":
            return p[0] + p[2] * x - m * p[3] * y, p[1] + p[3] * x + m * p[2] * y
        case "affine":
            return p[0] + p[1] * x + p[2] * y, p[3] + p[4] * x + p[5] * y
        case "projective":
            d = 1.0 + p[6] * x + p[7] * y
            return (p[0] + p[1] * x + p[2] * y) / d, (p[3] + p[4] * x + p[5] * y) / d
        case "bilinear":
            return p[0] + p[1] * x + p[2] * y + p[3] * x * y, p[4] + p[5] * x + p[6] * y + p[7] * x * y
    if kind.startswith("conformal"):
        y = m * y
        real = (1.0, x, x**2 - y**2, x**3 - 3 * x * y**2)
        imaginary = (0.0, y, 2 * x * y, 3 * x**2 * y - y**3)
        a, b = p[0::2], p[1::2]
        return (
            sum(a[k] * real[k] - b[k] * imaginary[k] for k in range(len(a))),
            sum(a[k] * imaginary[k] + b[k] * real[k] for k in range(len(a))),
        )
    half = len(p) // 2
    terms = (1.0, x, y, x**2, x * y, y**2, x**3, x**2 * y, x * y**2, y**3)[:half]
    return sum(p[k] * term for k, term in enumerate(terms)), sum(p[half + k] * term for k, term in enumerate(terms))


def comparator_point(kind: Transformation, p: Array, mirrored: bool, camera_xy: Array) -> Array:
    """Where camera points (n, 2) lie in the comparator, by the chord of the film over its first 100 mm."""

    def image(x: Any, y: Any) -> Array:
        return np.array(camera_of_film(kind, p, mirrored, x, y))

    chord = np.linalg.inv(np.stack([image(100.0, 0.0) - image(0.0, 0.0), image(0.0, 100.0) - image(0.0, 0.0)], axis=1))
    xy = np.zeros(camera_xy.T.shape)
    for _ in range(20):
        xy = xy + 100.0 * chord @ (camera_xy.T - image(*xy))
    return xy.T
