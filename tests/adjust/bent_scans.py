"""Films in a scanner that bends its scans, simulated with formulas of their own, term by term."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Image, Network, Scanner, Transformation
from adjust.problem.observations import Observations

Array = NDArray[np.float64]

MIDDLE_MM, HALF_MM = (125.0, -120.0), (118.0, 122.0)  # of the scan, which is longer than it is wide
MARKS_MM = {
    "1": (106.0, -106.0), "2": (-106.0, -106.0), "3": (-106.0, 106.0), "4": (106.0, 106.0),
    "5": (-112.0, 1.0), "6": (112.0, -2.0), "7": (3.0, 112.0), "8": (-1.0, -112.0),
}  # fmt: skip
RESEAU_MM = {f"r{i}{j}": (-105.0 + 35.0 * i, -105.0 + 35.0 * j) for i in range(7) for j in range(7)}
SIGMA_MM = 0.003


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
    x, y = ((scan_mm - MIDDLE_MM) / HALF_MM).T
    root = np.sqrt(HALF_MM[1] / HALF_MM[0])
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
    observations = replace(network.observations, xy_mm=bent(truth, network.observations.xy_mm))
    images = tuple(replace(image, scanner="S") for image in network.images)
    scanner = Scanner("S", terms, MIDDLE_MM, HALF_MM)
    return replace(network, observations=observations, images=images, scanners=(scanner,))


def films(
    turns_deg: Sequence[float],
    truth: Mapping[str, float],
    terms: Mapping[str, Prior],
    rng: np.random.Generator | None = None,
    kind: Transformation = "affine",
    sigma_given_mm: float = 1.0,
    marks_mm: Mapping[str, tuple[float, float]] = MARKS_MM,
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
        rows.append(places @ linear.T + MIDDLE_MM + scatter * chance.uniform(-1.5, 1.5, 2))
    straight_mm = np.concatenate(rows)
    names = [(frame, mark) for frame in frames for mark in marks_mm]
    given = places + (0.0 if rng is None else sigma_given_mm * rng.normal(size=places.shape))
    network = Network(
        cameras=(
            Camera(
                "K",
                Prior(153.0),
                Prior(0.0),
                Prior(0.0),
                fiducials={
                    mark: Fiducial(Prior(float(x), sigma_given_mm), Prior(float(y), sigma_given_mm))
                    for mark, (x, y) in zip(marks_mm, given, strict=True)
                },
            ),
        ),
        images=tuple(Image(frame, "K", kind) for frame in frames),
        points=(),
        observations=Observations(
            tuple(frame for frame, _ in names),
            tuple(mark for _, mark in names),
            tuple("fiducial" for _ in names),
            straight_mm,
            np.broadcast_to(SIGMA_MM**2 * np.eye(2), (len(names), 2, 2)),
        ),
    )
    network = bend_in_scanner(network, truth, terms)
    if rng is None:
        return network
    noise = rng.normal(0.0, SIGMA_MM, straight_mm.shape)
    return replace(network, observations=replace(network.observations, xy_mm=network.observations.xy_mm + noise))
