"""Networks simulated with formulas of their own or projected by OpenCV: nothing comes from the code under test."""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from math import pi
from typing import Any, cast

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adjust import Adjustment, Camera, Fiducial
from adjust.functional_model.lens import Decentering, Distortion, Prior
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.network import Approximations, Exterior, Image, Network, ObjectPoint, Scanner, Transformation
from adjust.problem.observations import ObservationKind, Observations
from synthetic_images.projection import camera_from_object
from synthetic_images.scene import Family, SceneCamera
from synthetic_images.scene import SceneDistortion as SceneDistortion

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

    @property
    def exteriors(self) -> Array:
        """(images, 6): stations and attitudes."""
        return np.hstack([self.stations, self.attitudes])


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
    rows: list[ObservedRow] = []
    for i in range(len(truth.stations)):
        film = film_parameters(truth, i, kind)
        marks: list[tuple[str, ObservationKind, Array, float]] = []
        if kind != "none":
            marks = [(id_, "fiducial", np.array(xy), 0.003) for id_, xy in FIDUCIALS.items()]
        marks += [(str(j), "target", xy, 0.004) for j, xy in enumerate(camera_point(truth, i, points))]
        observed = comparator_point(kind, film, truth.mirrored[i], np.array([xy for _, _, xy, _ in marks]))
        for (id_, what, _, sigma), xy in zip(marks, observed, strict=True):
            rows.append((f"f{i}", id_, what, xy + noise * rng.normal(0.0, sigma, 2), sigma))
    given = {name: Prior(value, (free or {}).get(name, 0.0)) for name, value in truth.distortion.items()}
    spread = fiducial_sigma * noise
    camera = Camera(
        "K",
        *given_interior(np.array([truth.c, truth.x0, truth.y0]) + noise * rng.normal(0.0, 1.0, 3)),
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
    images = tuple(Image(f"f{i}", "K", kind) for i in range(len(truth.stations)))
    return Network((camera,), images, object_points, make_observations(rows)), rough_start(truth, kind, points)


ObservedRow = tuple[
    str, str, ObservationKind, Array, float
]  # image, point, kind, comparator coordinates, standard deviation


def make_observations(rows: Sequence[ObservedRow]) -> Observations:
    images, points, kinds, xy_mm, sigmas = zip(*rows, strict=True)
    return Observations(images, points, kinds, np.array(xy_mm), np.array([sigma**2 * np.eye(2) for sigma in sigmas]))


def known_points(xyz: Mapping[str, Array]) -> tuple[ObjectPoint, ...]:
    return tuple(ObjectPoint(id_, *(Prior(float(value)) for value in place)) for id_, place in xyz.items())


def given_interior(values_mm: Sequence[float] | Array, sigma: float = 1.0) -> tuple[Prior, Prior, Prior]:
    """c, x0' and y0' with one standard deviation."""
    c, x0, y0 = (Prior(float(value), sigma) for value in values_mm)
    return c, x0, y0


def given_marks(places_mm: Mapping[str, Sequence[float] | Array], sigma: float) -> dict[str, Fiducial]:
    """Fiducials given with one standard deviation."""
    return {id_: Fiducial(*(Prior(float(value), sigma) for value in place)) for id_, place in places_mm.items()}


def observation_row(network: Network, kind: ObservationKind, image: str, point: str) -> int:
    """Where an observation stands."""
    rows = network.observations
    return list(zip(rows.kind, rows.image, rows.point, strict=True)).index((kind, image, point))


def add_errors(network: Network, errors: dict[int, Array]) -> Network:
    """With errors in mm in the observations of some rows."""
    xy_mm = network.observations.xy_mm.copy()
    for row, error in errors.items():
        xy_mm[row] += error
    return set_observations(network, xy_mm=xy_mm)


def set_observations(network: Network, **changes: Any) -> Network:
    """With other coordinates, covariances, images or points of its observations."""
    return replace(network, observations=replace(network.observations, **changes))


def drop_rows(network: Network, rows: list[int]) -> Network:
    kept = np.setdiff1d(np.arange(len(network.observations)), rows)
    return replace(network, observations=network.observations.only(kept))


def keep_rows(network: Network, keep: Callable[[str, str, str], bool]) -> Network:
    """With those of its observations that are wanted by image, point and kind."""
    rows = network.observations
    kept = [i for i, row in enumerate(zip(rows.image, rows.point, rows.kind, strict=True)) if keep(*row)]
    return replace(network, observations=rows.only(np.array(kept, dtype=np.intp)))


def set_camera(network: Network, **changes: Any) -> Network:
    """With other values of its first camera."""
    return replace(network, cameras=(replace(network.cameras[0], **changes), *network.cameras[1:]))


def set_images(network: Network, **changes: Any) -> Network:
    return replace(network, images=tuple(replace(image, **changes) for image in network.images))


def orient(network: Network, exteriors: Mapping[str, Exterior]) -> Network:
    """With exterior orientations of some images."""
    images = (replace(image, exterior=exteriors.get(image.name, image.exterior)) for image in network.images)
    return replace(network, images=tuple(images))


def free_points(network: Network, names: Container[str], axes: str = "XYZ") -> Network:
    """With some points unknown, and without approximations, along some axes."""
    unknown: dict[str, Any] = dict.fromkeys(axes)
    points = (replace(point, **unknown) if point.id in names else point for point in network.points)
    return replace(network, points=tuple(points))


def digital_network(
    camera: Camera, rows: Sequence[tuple[str, str, Array]], xyz: dict[str, Array], sigma: float
) -> Network:
    """Known points in images of a digital camera; rows: image, point and comparator coordinates of its marks."""
    images = tuple(Image(name, camera.name, "none") for name in dict.fromkeys(row[0] for row in rows))
    observations = make_observations([(image, point, "target", xy, sigma) for image, point, xy in rows])
    return Network((camera,), images, known_points(xyz), observations)


def view_rows(views: Iterable[Array], names: Sequence[str]) -> list[tuple[str, str, Array]]:
    """Rows of a digital network that shows the same points in every picture, which are called i0, i1 and so on."""
    return [(f"i{i}", name, xy) for i, view in enumerate(views) for name, xy in zip(names, view, strict=True)]


def join_observations(*parts: Observations) -> Observations:
    """Observations behind one another."""
    return Observations(
        tuple(chain.from_iterable(each.image for each in parts)),
        tuple(chain.from_iterable(each.point for each in parts)),
        tuple(chain.from_iterable(each.kind for each in parts)),
        np.concatenate([each.xy_mm for each in parts]),
        np.concatenate([each.covariance_mm2 for each in parts]),
    )


def rough_start(truth: Truth, kind: Transformation, points: Array) -> Approximations:
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


Triple = tuple[float, float, float]

FREE = np.inf
HEIGHT = 1500.0
LEVEL_STATIONS = ((0.0, 0.0, HEIGHT), (500.0, 100.0, HEIGHT), (-480.0, 80.0, HEIGHT), (60.0, 520.0, HEIGHT))
CONVERGENT = ((0.01, -0.02, 0.1), (-0.08, 0.36, 1.6), (-0.05, -0.29, 3.0), (-0.35, 0.03, -1.5))
TILTED = (0.2, 0.1, 0.3)
KNOWN, UNKNOWN, HEIGHTS = (0.0, 0.0, 0.0), (FREE, FREE, FREE), (FREE, FREE, 0.0)


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
        mirrored = (False,) * len(self.stations)
        truth = Truth(stations=self.stations, attitudes=self.attitudes, mirrored=mirrored, distortion=parameters)
        points = self.points
        if points is None:
            points = field_points(np.random.default_rng(1), 14, relief=1.0) * [1.0, 1.0, self.relief]
        rng = np.random.default_rng(0)
        network, start = simulated(rng, truth, self.kind, points, 0.0, dict(self.distortion), self.noise)
        exact = {f"f{i}": exterior for i, exterior in enumerate(truth.exteriors)}
        network = replace(network, points=tuple(set_sigma(point, self.sigma) for point in network.points))
        return set_prior(network, self.prior), replace(start, exterior=exact)


def set_sigma(point: ObjectPoint, sigma: Triple) -> ObjectPoint:
    x, y, z = (prior and replace(prior, sigma=s) for prior, s in zip((point.X, point.Y, point.Z), sigma, strict=True))
    return replace(point, X=x, Y=y, Z=z)


def set_prior(network: Network, sigma: float) -> Network:
    """All of F5 to F9 with one standard deviation."""
    return give_values(network, dict.fromkeys(("x", "y", "c", "x0", "y0"), sigma))


def give_values(network: Network, sigmas: Mapping[str, float], marks: int | None = None) -> Network:
    """Standard deviations for c, x0, y0 and for x and y of the first (None: all) fiducials, the others as they are."""
    first = list(network.cameras[0].fiducials)[:marks]

    def give(name: str, prior: Prior) -> Prior:
        *owner, quantity = name.split(".")
        is_given = quantity in sigmas and (owner[0] == "IO" or owner[-1] in first)
        return replace(prior, sigma=sigmas[quantity]) if is_given else prior

    return map_priors(network, give)


def map_priors(network: Network, change: Callable[[str, Prior], Prior]) -> Network:
    """With every given value of cameras and points changed, by the name of its unknown."""

    def mapped(name: str, prior: Prior | None) -> Prior | None:
        return prior and change(name, prior)

    cameras = []
    for camera in network.cameras:
        own, mark_name = f"IO.{camera.name}.", f"FID.{camera.name}.{{}}.{{}}".format
        lens = {name: change(own + name, prior) for name, prior in camera.distortion.parameters.items()}
        changed = replace(
            camera,
            principal_distance_mm=mapped(f"{own}c", camera.principal_distance_mm),
            x0_mm=mapped(f"{own}x0", camera.x0_mm),
            y0_mm=mapped(f"{own}y0", camera.y0_mm),
            distortion=replace(camera.distortion, parameters=lens),
            fiducials={
                id_: Fiducial(change(mark_name(id_, "x"), mark.x_mm), change(mark_name(id_, "y"), mark.y_mm))
                for id_, mark in camera.fiducials.items()
            },
        )
        cameras.append(changed)
    points = (
        ObjectPoint(each.id, *(mapped(f"PT.{each.id}.{axis}", getattr(each, axis)) for axis in "XYZ"))
        for each in network.points
    )
    return replace(network, cameras=tuple(cameras), points=tuple(points))


def vertical(*kappas: float) -> tuple[Triple, ...]:
    return tuple((0.0, 0.0, kappa) for kappa in kappas)


def quarters(omega: float = 0.0, phi: float = 0.0, kappa: float = 0.0) -> tuple[Triple, ...]:
    """Four images turned by 0, 90, 180 and 270 degrees about their common axis."""
    return tuple((omega, phi, kappa + turn) for turn in (0.0, pi / 2, pi, -pi / 2))


Name = Callable[[str], str]


def join_networks(
    one: tuple[Network, Approximations], other: tuple[Network, Approximations]
) -> tuple[Network, Approximations]:
    """Both together; what has one name is one thing."""
    (a, start_a), (b, start_b) = one, other
    network = Network(
        tuple({each.name: each for each in (*b.cameras, *a.cameras)}.values())[::-1],
        a.images + b.images,
        tuple({each.id: each for each in (*a.points, *b.points)}.values()),
        join_observations(a.observations, b.observations),
    )
    start = Approximations(
        {**start_a.interior, **start_b.interior},
        {**start_a.exterior, **start_b.exterior},
        {**start_a.transformation, **start_b.transformation},
        {**start_a.points, **start_b.points},
        start_a.mirrored | start_b.mirrored,
    )
    return network, start


def rename_network(
    network: Network, start: Approximations, camera: str, mark: Name, image: Name, point: Name
) -> tuple[Network, Approximations]:
    new = {each.name: image(each.name) for each in network.images}
    rows = network.observations
    view = (mark(name) if kind == "fiducial" else point(name) for name, kind in zip(rows.point, rows.kind, strict=True))
    return (
        replace(
            network,
            cameras=(_rename_camera(network.cameras[0], camera, mark),),
            images=tuple(replace(each, name=new[each.name], camera=camera) for each in network.images),
            points=tuple(replace(each, id=point(each.id)) for each in network.points),
            observations=replace(rows, image=tuple(new[name] for name in rows.image), point=tuple(view)),
        ),
        replace(
            start,
            interior=dict.fromkeys([camera], start.interior[network.cameras[0].name]),
            exterior={new[name]: value for name, value in start.exterior.items()},
            transformation={new[name]: value for name, value in start.transformation.items()},
            points={point(name): value for name, value in start.points.items()},
        ),
    )


def _rename_camera(camera: Camera, name: str, mark: Name) -> Camera:
    return replace(camera, name=name, fiducials={mark(id): place for id, place in camera.fiducials.items()})


FIDUCIAL_SIGMA, TARGET_SIGMA, JOIN_SIGMA = 0.003, 0.004, 0.002  # mm


@dataclass(frozen=True)
class Halves:
    """A network, and the truth: films by image name, joins' camera coordinates by frame and point."""

    network: Network
    films: dict[str, Array]
    joins: dict[tuple[str, str], Array]
    truth: Truth


def halves(
    rng: np.random.Generator,
    join_count: int = 20,
    overlap_mm: float = 40.0,
    targets: int = 12,
    turned: bool = False,
    join_sigma: float = JOIN_SIGMA,
) -> Halves:
    """Four frames of known points, each in a left and a right half with an affine film of its own.

    turned: the right halves lay turned by half a turn. join_sigma: of the joins' errors, mm.
    """
    truth = Truth()
    points = field_points(rng, targets)
    rows: list[ObservedRow] = []
    films: dict[str, Array] = {}
    joins: dict[tuple[str, str], Array] = {}
    for i in range(len(truth.stations)):
        view: list[tuple[ObservationKind, str, Array, float]] = [
            ("fiducial", id_, np.array(xy), FIDUCIAL_SIGMA) for id_, xy in FIDUCIALS.items()
        ]
        view += [("target", str(j), xy, TARGET_SIGMA) for j, xy in enumerate(camera_point(truth, i, points))]
        common = rng.uniform([-overlap_mm / 2, -100.0], [overlap_mm / 2, 100.0], (join_count, 2))
        view += [("join", f"j{j}", xy, join_sigma) for j, xy in enumerate(common)]
        joins |= {(f"f{i}", f"j{j}"): xy for j, xy in enumerate(common)}
        for half, side in (("left", -1.0), ("right", 1.0)):
            name = f"f{i}.{half}"
            film = film_parameters(truth, i, "affine").copy()
            if half == "right":  # another shift, turn, scale and shear of its own
                film = film * np.array([1.0, 1.0003, 0.9998, 1.0, 1.0001, 1.0002]) + [17.0, 0, 0, -9.0, 0, 0]
                film = film * (-1.0 if turned else 1.0)
                film[[0, 3]] *= -1.0 if turned else 1.0
            films[name] = film
            own = [mark for mark in view if side * mark[2][0] > -overlap_mm / 2]
            observed = comparator_point("affine", film, False, np.array([mark[2] for mark in own]))
            for (kind, id_, _, sigma), xy in zip(own, observed, strict=True):
                rows.append((name, id_, kind, xy + rng.normal(0.0, sigma, 2), max(sigma, 1e-4)))
    camera = Camera(
        "K",
        *given_interior(np.array([truth.c, truth.x0, truth.y0]) + rng.normal(size=3)),
        Distortion(truth.family, {name: Prior(value) for name, value in truth.distortion.items()}),
        given_marks({id_: xy + rng.normal(0.0, 0.001, 2) for id_, xy in FIDUCIALS.items()}, 0.001),
    )
    images = tuple(Image(name, "K", "affine", part_of=name.split(".")[0]) for name in films)
    targets_xyz = known_points({str(j): xyz for j, xyz in enumerate(points)})
    return Halves(Network((camera,), images, targets_xyz, make_observations(rows)), films, joins, truth)


SCAN_MIDDLE_MM, SCAN_HALF_MM = (125.0, -120.0), (118.0, 122.0)  # of the scan, which is longer than it is wide
EIGHT_MARKS_MM = {
    "1": (106.0, -106.0), "2": (-106.0, -106.0), "3": (-106.0, 106.0), "4": (106.0, 106.0),
    "5": (-112.0, 1.0), "6": (112.0, -2.0), "7": (3.0, 112.0), "8": (-1.0, -112.0),
}  # fmt: skip
RESEAU_MM = {f"r{i}{j}": (-105.0 + 35.0 * i, -105.0 + 35.0 * j) for i in range(7) for j in range(7)}
FILM_SIGMA_MM = 0.003


def legendre(degree: int, t: Array) -> Array:
    """The first polynomials as they are printed everywhere."""
    return np.asarray(
        (
            np.ones_like(t),
            t,
            (3 * t**2 - 1) / 2,
            (5 * t**3 - 3 * t) / 2,
            (35 * t**4 - 30 * t**2 + 3) / 8,
            (63 * t**5 - 70 * t**3 + 15 * t) / 8,
            (231 * t**6 - 315 * t**4 + 105 * t**2 - 5) / 16,
        )[degree]
    )


def displacement(terms: Mapping[str, float], scan_mm: Array) -> Array:
    """How far the scanner puts points beside their places, at the coordinates (n, 2) that it gives them."""
    x, y = ((scan_mm - SCAN_MIDDLE_MM) / SCAN_HALF_MM).T
    root = np.sqrt(SCAN_HALF_MM[1] / SCAN_HALF_MM[0])
    off = np.zeros_like(scan_mm)
    for name, value in terms.items():
        match name:
            case "stretch":
                off += value * np.stack([root * x, -y / root], axis=1)
            case "shear":
                off += value * np.stack([y / root, root * x], axis=1)
            case "tilt_x":
                off += value * np.stack([-5 / 6 * root * legendre(2, x), x * y / root], axis=1)
            case "tilt_y":
                off += value * np.stack([root * x * y, -5 / 6 / root * legendre(2, y)], axis=1)
            case _:
                off[:, "ab".index(name[0])] += value * legendre(int(name[1]), x) * legendre(int(name[2]), y)
    return off


def bent(terms: Mapping[str, float], xy_mm: Array) -> Array:
    """The coordinates that the scanner gives to places (n, 2)."""
    scan_mm = xy_mm
    for _ in range(20):
        scan_mm = xy_mm + displacement(terms, scan_mm)
    return scan_mm


def bend_in_scanner(network: Network, truth: Mapping[str, float], terms: Mapping[str, Prior]) -> Network:
    """A network of straight scans as a scanner S that bends them would have it, which is to find some terms."""
    scanned = set_images(set_observations(network, xy_mm=bent(truth, network.observations.xy_mm)), scanner="S")
    return replace(scanned, scanners=(Scanner("S", terms, SCAN_MIDDLE_MM, SCAN_HALF_MM),))


def bent_films(
    turns_deg: Sequence[float],
    truth: Mapping[str, float],
    terms: Mapping[str, Prior],
    rng: np.random.Generator | None = None,
    kind: Transformation = "affine",
    sigma_given_mm: float = 1.0,
    marks_mm: Mapping[str, tuple[float, float]] = EIGHT_MARKS_MM,
    scatter: float = 1.0,
) -> Network:
    """Fiducial marks alone: a frame for every turn, its film stretched and sheared by chance where it is affine.

    rng: of the observations' errors and of those of the given marks; None: none of either. scatter: 0 for films that
    are laid exactly as their turns say and have not moved.
    """
    places = np.array(list(marks_mm.values()))
    chance = np.random.default_rng(1)
    rows, frames = [], []
    for i, turn in enumerate(turns_deg):
        angle = np.radians(turn) + scatter * chance.uniform(-0.02, 0.02)
        film = np.eye(2) + (scatter * chance.uniform(-4e-4, 4e-4, (2, 2)) if kind == "affine" else 0.0)
        linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ film
        frames.append(f"f{i}")
        rows.append(places @ linear.T + SCAN_MIDDLE_MM + scatter * chance.uniform(-1.5, 1.5, 2))
    given = places + (0.0 if rng is None else sigma_given_mm * rng.normal(size=places.shape))
    fiducials = given_marks(dict(zip(marks_mm, given, strict=True)), sigma_given_mm)
    camera = Camera("K", Prior(153.0), Prior(0.0), Prior(0.0), fiducials=fiducials)
    network = bend_in_scanner(film_network(camera, kind, frames, np.array(rows), FILM_SIGMA_MM), truth, terms)
    if rng is None:
        return network
    straight_mm = network.observations.xy_mm
    return set_observations(network, xy_mm=straight_mm + rng.normal(0.0, FILM_SIGMA_MM, straight_mm.shape))


def film_network(
    camera: Camera, kind: Transformation, frames: Sequence[str], comparator_mm: Array, sigma: float
) -> Network:
    """Frames that show all m fiducials of a camera and no more; comparator_mm (n, m, 2)."""
    rows: list[ObservedRow] = [
        (frame, id_, "fiducial", xy, sigma)
        for frame, own in zip(frames, comparator_mm, strict=True)
        for id_, xy in zip(camera.fiducials, own, strict=True)
    ]
    images = tuple(Image(frame, camera.name, kind) for frame in frames)
    return Network((camera,), images, (), make_observations(rows))


FILM_CAMERA = "K"
NOMINAL_MM = np.array(
    [(-106, 106), (106, 106), (106, -106), (-106, -106), (0, 112), (112, 0), (0, -112), (-112, 0)], float
)
FRAME_NOISE_MM = 0.005
BEND = 1e-2  # mm at 100 mm from the middle: what films of higher order bend


@dataclass(frozen=True)
class DrawnFrames:
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


def draw_frames(
    kind: Transformation, count: int, marks: int, stated_mm: float, true_mm: float, rng: Generator, noise: float = 1.0
) -> DrawnFrames:
    """Frames of one camera whose marks are given with a standard deviation; true_mm: that of the given coordinates in
    truth, noise: that of the comparator over the stated one."""
    given = NOMINAL_MM[:marks]
    places = given + true_mm * rng.standard_normal(given.shape)
    ids = tuple(str(i + 1) for i in range(marks))
    films = tuple(drawn_film(kind, rng) for _ in range(count))
    rows, values = [], dict[str, float]()
    for name, film in zip(frame_names(count), films, strict=True):
        source, regular = film.comparator_from_camera(places)
        assert regular.all()
        rows.append(source + noise * FRAME_NOISE_MM * rng.standard_normal(places.shape))
        values |= {f"T.{name}.{p}": float(v) for p, v in zip(film_parameter_names(kind), film.parameters, strict=True)}
    for id_, place in zip(ids, places, strict=True):
        values |= {f"FID.{FILM_CAMERA}.{id_}.{axis}": float(v) for axis, v in zip("xy", place, strict=True)}
    return DrawnFrames(fiducial_network(kind, given, stated_mm, np.array(rows)), places, films, values)


def fiducial_network(kind: Transformation, given_mm: Array, stated_mm: float, comparator_mm: Array) -> Network:
    """Of marks (m, 2) as given, and as measured in n frames (n, m, 2)."""
    fiducials = given_marks({str(i): xy for i, xy in enumerate(given_mm, 1)}, stated_mm)
    camera = Camera(FILM_CAMERA, None, None, None, fiducials=fiducials)
    return film_network(camera, kind, frame_names(len(comparator_mm)), comparator_mm, FRAME_NOISE_MM)


def frame_names(count: int) -> tuple[str, ...]:
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


def unknown_errors(result: Adjustment, truth: DrawnFrames) -> Iterator[tuple[str, float, float]]:
    """Kind of quantity, error and standard deviation of every unknown."""
    for name in result.names:
        if name in truth.values:
            kind = "fiducials" if name.startswith("FID.") else _film_kind(name)
            yield kind, result.value(name) - truth.values[name], result.sigma(name)


def _film_kind(name: str) -> str:
    return "shifts" if name.endswith((".a1", ".b1")) else "other film parameters"


PROJECTED_C_MM, X0_MM, Y0_MM = 152.0, 0.05, -0.03
PROJECTED_SIGMA_MM = 0.005
SIX_MARKS_MM = {
    str(i): 106.0 * np.array(xy) for i, xy in enumerate([(1, -1), (-1, -1), (-1, 1), (1, 1), (-1, 0), (1, 0)], 1)
}


@dataclass(frozen=True)
class Projected:
    network: Network
    rotations: dict[str, Array]
    centers: dict[str, Array]
    points: dict[str, Array]


def project_field(
    xyz: Array,
    stations: Sequence[tuple[float, float, float, float, float, float]],
    *,
    kind: Transformation = "affine",
    mirrored: bool = False,
    noise_mm: float = PROJECTED_SIGMA_MM,
    outliers: float = 0.0,
    distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    aspect: float = 1.0,
) -> Projected:
    """A network of known points as OpenCV projects them, scanned with any turn; all points within 115 mm are seen."""
    rng = np.random.default_rng(1)
    rows: list[ObservedRow] = []
    rotations, centers = {}, {}
    for number, station in enumerate(stations):
        image = f"f{number + 1}"
        rotation = Rotation.from_euler("XYZ", station[3:]).as_matrix().T
        rotations[image], centers[image] = rotation, np.array(station[:3])
        projected = camera_coordinates(xyz, rotation, centers[image], distortion, aspect)
        marks = np.array(list(SIX_MARKS_MM.values()))
        scan = scan_from_camera(kind, mirrored, rng)
        inside = np.flatnonzero((np.abs(projected) < 115.0).all(axis=1))
        targets = projected[inside] @ scan[0].T + scan[1] + rng.normal(0.0, noise_mm, (len(inside), 2))
        wrong = rng.random(len(inside)) < outliers
        targets[wrong] += rng.uniform(-40.0, 40.0, (int(wrong.sum()), 2))
        fiducials = marks @ scan[0].T + scan[1] + rng.normal(0.0, noise_mm, marks.shape)
        rows += [(image, f"t{k}", "target", xy, PROJECTED_SIGMA_MM) for k, xy in zip(inside, targets, strict=True)]
        if kind != "none":
            marks_of_image = zip(SIX_MARKS_MM, fiducials, strict=True)
            rows += [(image, name, "fiducial", xy, PROJECTED_SIGMA_MM) for name, xy in marks_of_image]
    lens = zip(("k1", "k2", "p1", "p2"), distortion, strict=False)
    camera = Camera(
        "rc20",
        *given_interior((PROJECTED_C_MM, X0_MM, Y0_MM)),
        Distortion("opencv", {name: Prior(value) for name, value in lens}),
        given_marks(SIX_MARKS_MM, 1.0) if kind != "none" else {},
    )
    points = {f"t{k}": place for k, place in enumerate(xyz)}
    images = tuple(Image(name, "rc20", kind) for name in rotations)
    network = Network((camera,), images, known_points(points), make_observations(rows))
    return Projected(network, rotations, centers, points)


def camera_coordinates(
    xyz: Array, rotation: Array, center: Array, distortion: Sequence[float], aspect: float = 1.0
) -> Array:
    """Camera coordinates (n, 2), y up, by cv2.projectPoints; far outside the frame what is behind the camera."""
    downward = np.diag([1.0, -1.0, -1.0]) @ rotation
    matrix = np.array([[aspect * PROJECTED_C_MM, 0.0, X0_MM], [0.0, PROJECTED_C_MM, -Y0_MM], [0.0, 0.0, 1.0]])
    projected, _ = cv2.projectPoints(
        xyz, cv2.Rodrigues(downward)[0], -downward @ center, matrix, np.array(distortion, dtype=np.float64)
    )
    in_front = ((xyz - center) @ downward.T)[:, 2] > 0
    return np.where(in_front[:, None], projected.reshape(-1, 2) * [1.0, -1.0], 1e6)


def scan_from_camera(kind: Transformation, mirrored: bool, rng: np.random.Generator) -> tuple[Array, Array]:
    """A scan turned anyhow on the bed (2, 2), (2,): stretched by some per mille if affine, mirrored if asked."""
    if kind == "none":
        return np.eye(2), np.zeros(2)
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    stretch = np.eye(2) + (rng.normal(0.0, 2e-3, (2, 2)) if kind == "affine" else np.zeros((2, 2)))
    return turn @ stretch @ np.diag([-1.0 if mirrored else 1.0, 1.0]), rng.uniform(50.0, 150.0, 2)


def relief_field(relief_m: float, n: int = 40) -> Array:
    return np.random.default_rng(5).uniform(-1.0, 1.0, (n, 3)) * [900.0, 900.0, relief_m]


CONVERGENT_STATIONS = [
    (0.0, 0.0, 1530.0, 0.0, 0.0, 0.0),
    (700.0, 100.0, 1400.0, -0.07, 0.45, 1.6),
    (-600.0, 80.0, 1600.0, -0.05, -0.4, 3.1),
    (50.0, 700.0, 1480.0, -0.45, 0.03, -1.6),
    (-80.0, -650.0, 1650.0, 0.4, -0.05, 0.4),
]
VERTICAL_STATIONS = [
    (-300.0, 0.0, 1530.0, 0.02, -0.03, 0.1),
    (300.0, 20.0, 1500.0, -0.03, 0.01, 2.9),
    (0.0, 200.0, 1550.0, 0.0, 0.03, -1.5),
]


BOARD_FRAME_MM = (3.2, 2.4)
BOARD_TRUTH = {"c": 2.7, "x0": 1.65, "y0": -1.18, "k1": -0.28, "k2": 0.09}


def board_network(
    rng: np.random.Generator, images: int, sigma_mm: float, given_mm: float | None = None, k3: float = 0.0
) -> Network:
    """Marks with errors of sigma_mm, to which given_mm is given; of each picture its own tilt and shift."""
    points = np.array([[25.0 * column, 25.0 * row, 0.0] for row in range(6) for column in range(9)])
    matrix = np.array([[BOARD_TRUTH["c"], 0, BOARD_TRUTH["x0"]], [0, BOARD_TRUTH["c"], -BOARD_TRUTH["y0"]], [0, 0, 1]])
    places = []
    for _ in range(images):
        turn = rng.uniform(-0.5, 0.5, 3)
        rotation = np.asarray(cv2.Rodrigues(turn)[0]) @ np.diag([1.0, -1.0, -1.0])
        shift = np.array([*rng.uniform(-40, 40, 2), rng.uniform(300, 420)]) - rotation @ points.mean(axis=0)
        lens = np.array([BOARD_TRUTH["k1"], BOARD_TRUTH["k2"], 0.0, 0.0, k3])
        projected = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], shift, matrix, lens)[0]
        places.append(np.asarray(projected, float).reshape(-1, 2) * [1.0, -1.0])
    views = np.array(places) + sigma_mm * rng.normal(size=(images, len(points), 2))
    xyz = {f"b{number}": place for number, place in enumerate(points)}
    free = Prior(0.0, np.inf)
    distortion = Distortion("opencv", {"k1": free, "k2": free})
    middle = (BOARD_FRAME_MM[0] / 2, -BOARD_FRAME_MM[1] / 2)
    camera = Camera("desk", None, None, None, distortion, center_mm=middle, frame_mm=BOARD_FRAME_MM)
    return digital_network(camera, view_rows(views, list(xyz)), xyz, given_mm or sigma_mm)


def equidistant_network(rng: np.random.Generator, steepest: float, distance_mm: float, count: int) -> Network:
    """Board of 6 x 5 corners under a lens r = c θ, its middle `steepest` rad off the axis in every third picture; marks
    with errors of 0.1 µm."""
    grid = np.array([[20.0 * column, 20.0 * row, 0.0] for row in range(5) for column in range(6)])
    views = []
    for number in range(count):
        polar, azimuth = steepest * (number % 3) / 2.0, 0.7 * number
        rotation = np.asarray(cv2.Rodrigues(polar * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]))[0])
        tilted = rotation @ cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
        x, y, z = ((grid - grid.mean(axis=0)) @ tilted.T + rotation @ [0.0, 0.0, distance_mm]).T
        radius = np.hypot(x, y)
        views.append(np.stack([x, -y], axis=1) * (1.3 * np.arctan2(radius, z) / radius)[:, None])
    places = np.array(views) + rng.normal(0.0, 1e-4, (count, len(grid), 2))
    xyz = {f"b{number}": place for number, place in enumerate(grid * [1.0, -1.0, 1.0])}
    distortion = Distortion("opencv_fisheye", {f"k{k}": Prior(0.0, np.inf) for k in range(1, 5)})
    camera = Camera("wide", None, None, None, distortion, frame_mm=(4.8, 4.8))
    return digital_network(camera, view_rows(places, list(xyz)), xyz, 1e-4)


LENS_R0_MM = 13.0
LENS_SIGMA_MM = 0.0004
LENSES: dict[str, tuple[float, dict[str, float]]] = {  # principal distance in mm, parameters
    "aicon": (28.8, {"a1": -1.1e-4, "a2": 1.5e-7, "b1": 5.8e-6, "b2": -8.6e-6, "c1": -7e-5, "c2": -3.1e-5}),
    "australis": (28.8, {"k1": 1.1e-4, "k2": -1.2e-7, "p1": 5.8e-6, "p2": -8.6e-6, "b1": -7e-5, "b2": -3.1e-5}),
    "opencv": (28.8, {"k1": -0.09, "k2": 0.1, "p1": 2e-4, "p2": -1e-4, "b1": 4e-4, "b2": -3e-4}),
    "opencv_fisheye": (11.0, {"k1": 0.03, "k2": -0.01, "b1": 4e-4, "b2": -3e-4}),
}
POSES = [(0.0, 0.0, 0.1), (0.5, 0.1, 1.6), (-0.5, 0.2, 3.1), (0.1, 0.5, -1.5), (-0.1, -0.5, 0.8), (0.3, -0.3, 2.3)]


def scene_camera(name: str) -> SceneCamera:
    c, values = LENSES[name]
    distortion = SceneDistortion(cast(Family, name), values, LENS_R0_MM)
    return SceneCamera("L", (80.0, 80.0), c, (0.12, -0.07), distortion)


def lens_network(name: str, rng: np.random.Generator | None = None) -> Network:
    """Six views of a deep field, 36 mm x 24 mm, known points; the lens free and unknown, c given roughly."""
    camera, (c, values) = scene_camera(name), LENSES[name]
    half = np.array([18.0, 12.0])
    reach = half.max() / c if name != "opencv_fisheye" else 4.0
    field = np.random.default_rng(1).uniform(-1.0, 1.0, (120, 3)) * [reach, reach, 0.4]
    rows = []
    for i, angles in enumerate(POSES):
        back = rotation_from_angles(np.array(angles)).T @ np.array([0.0, 0.0, 1.3])
        projected = camera_from_object(camera, (*back, *angles), field)
        rows += [(f"i{i}", f"t{k}", projected[k]) for k in np.flatnonzero((np.abs(projected) < half).all(axis=1))]
    if rng is not None:
        noise = rng.normal(0.0, LENS_SIGMA_MM, (len(rows), 2))
        rows = [(*row[:2], row[2] + error) for row, error in zip(rows, noise, strict=True)]
    free, unknown = dict.fromkeys(values, Prior(0.0, np.inf)), Prior(0.0, np.inf)
    lens = Camera("L", Prior(c * 1.03, np.inf), unknown, unknown, Distortion(name, free, r0_mm=LENS_R0_MM))
    return digital_network(lens, rows, {f"t{k}": xyz for k, xyz in enumerate(field)}, LENS_SIGMA_MM)
