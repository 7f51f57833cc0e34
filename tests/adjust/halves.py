"""Frames scanned in two overlapping halves, simulated with formulas of their own."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from simulated import (
    FIDUCIALS,
    Truth,
    camera_point,
    comparator_point,
    field_points,
    film_parameters,
)

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations

Array = NDArray[np.float64]

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
    known_fiducials: bool = True,
    join_sigma: float = JOIN_SIGMA,
) -> Halves:
    """Four frames of known points, each in a left and a right half with an affine film of its own.

    turned: the right halves lay turned by half a turn. known_fiducials: given to 1 um, else to 1 mm.
    join_sigma: of the joins' errors, mm.
    """
    truth = Truth()
    points = field_points(rng, targets)
    rows: list[tuple[str, str, ObservationKind, Array, float]] = []
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
                rows.append((name, id_, kind, xy + rng.normal(0.0, sigma, 2), sigma))
    sigma = 0.001 if known_fiducials else 1.0
    camera = Camera(
        "K",
        Prior(truth.c + rng.normal(), 1.0),
        Prior(truth.x0 + rng.normal(), 1.0),
        Prior(truth.y0 + rng.normal(), 1.0),
        Distortion(truth.family, {name: Prior(value) for name, value in truth.distortion.items()}),
        {
            id_: Fiducial(*(Prior(value + rng.normal(0.0, sigma), sigma) for value in xy))
            for id_, xy in FIDUCIALS.items()
        },
    )
    network = Network(
        (camera,),
        tuple(Image(name, "K", "affine", part_of=name.split(".")[0]) for name in films),
        tuple(ObjectPoint(str(j), *(Prior(float(value)) for value in xyz)) for j, xyz in enumerate(points)),
        Observations(
            tuple(row[0] for row in rows),
            tuple(row[1] for row in rows),
            tuple(row[2] for row in rows),
            np.array([row[3] for row in rows]),
            np.array([max(row[4], 1e-4) ** 2 * np.eye(2) for row in rows]),
        ),
    )
    return Halves(network, films, joins, truth)


def drop_images(network: Network, drop: str) -> Network:
    """The network without the observations of a kind."""
    kept = np.flatnonzero([kind != drop for kind in network.observations.kind])
    return replace(network, observations=network.observations.only(kept))
