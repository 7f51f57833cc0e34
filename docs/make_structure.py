"""Draw the structure of A, B and the normal equations as Torlegård's figures 1 to 3 do, from the real matrices.

python docs/make_structure.py [FOLDER]: five images of ten known points by a camera with eight fiducial marks, affine
film transformations, interior orientation and distortion. The pictures go to the folder of this file or to another.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.condition_equations import compute, derivatives
from adjust.problem.network import Approximations, Exterior, Image, Network, ObjectPoint
from adjust.problem.observations import Observations
from adjust.problem.problem import ABSENT, Problem, number

Array = NDArray[np.float64]

STATIONS = ((0, 0, 1500), (700, 0, 1450), (-700, 100, 1550), (50, 720, 1500), (0, -700, 1480))
ANGLES = ((0.01, -0.02, 0.1), (-0.02, 0.4, 1.6), (-0.05, -0.4, 3.0), (-0.42, 0.03, -1.5), (0.4, -0.01, 0.8))
MARKS = [(x, y) for x in (-106, 0, 106) for y in (-106, 0, 106) if (x, y) != (0, 0)]
PARAMETERS = {"k3": 1.5e-7, "k5": -4e-12, "p1": 8e-7, "p2": -6e-7}
STRETCH, SHEAR = 1.0003, 0.0002  # of the films
DISTORTION_SIGMA = 1e-3  # priors on the distortion, as the paper's fictitious observations
COLOURS = ("#1f5a93", "#c9482b", "#5b8c3a", "#8a5a9e")
ROUNDING = 1e-14  # of the largest element that could stand there
DOTS_PER_INCH = 110


def main() -> None:
    """Draw all three."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    matrices = structure()
    draw(folder, matrices)
    print(", ".join(f"{name} {matrix.shape}" for name, matrix in matrices.matrices.items()))


class Structure:
    """A, B and N with the names and sizes of the groups of their rows and columns, in the paper's order."""

    def __init__(self, a: Array, b: Array, n: Array, rows: dict[str, int], unknowns: dict[str, int]) -> None:
        self.matrices = {"A": a, "B": b, "N": n}
        self.rows, self.unknowns = rows, unknowns


def structure() -> Structure:
    """The matrices of the network at computed observations."""
    problem = number(*network())
    state = problem.start()
    computed = compute(problem, state)
    if computed is None:
        raise ValueError("a point of the network has no image")
    at, count = derivatives(problem, state, computed), len(computed.xy_mm)
    order, unknowns = ordered_unknowns(problem)
    observed = np.argsort(problem.is_fiducial, kind="stable")  # targets first, then fiducials, each image by image
    b = dense(problem, at.by_unknowns)[observed].reshape(2 * count, -1)[:, order]
    prior = np.flatnonzero(problem.unknowns.has_prior[order])
    b = np.vstack([b, -np.eye(len(order))[prior]])  # F5 to F9: given less unknown
    a = np.eye(len(b))
    for row, each in enumerate(observed):
        a[2 * row : 2 * row + 2, 2 * row : 2 * row + 2] = at.by_observation[each]
    variances = np.concatenate([np.full(2 * count, 0.005**2), problem.unknowns.sigma[order][prior] ** 2])
    n = b.T @ np.linalg.solve(a @ np.diag(variances) @ a.T, b)
    targets = 2 * int((~problem.is_fiducial).sum())
    rows = {
        "F1, F2: object points": targets,
        "F3, F4: fiducials": 2 * count - targets,
        "F5, F6": 2 * len(MARKS),
        "F7 to F9, distortion": len(prior) - 2 * len(MARKS),
    }
    return Structure(a, b, n, rows, unknowns)


def network() -> tuple[Network, Approximations]:
    """The network, with observations yet to be computed, and its values."""
    rng = np.random.default_rng(1)
    points = rng.uniform([-600, -600, -150], [600, 600, 150], (10, 3))
    fiducials = {str(i): Fiducial(Prior(x, 1.0), Prior(y, 1.0)) for i, (x, y) in enumerate(MARKS, 1)}
    free = {name: Prior(value, DISTORTION_SIGMA) for name, value in PARAMETERS.items()}
    camera = Camera("K", Prior(153.0, 1.0), Prior(0.2, 1.0), Prior(-0.1, 1.0), Distortion("torlegard", free), fiducials)
    images = tuple(
        Image(str(i), "K", "affine", Exterior(np.array([*station, *angles], dtype=float)))
        for i, (station, angles) in enumerate(zip(STATIONS, ANGLES, strict=True), 1)
    )
    rows = [(image.name, str(i), "target") for image in images for i in range(len(points))]
    rows += [(image.name, mark, "fiducial") for image in images for mark in fiducials]
    observations = Observations(
        tuple(row[0] for row in rows),
        tuple(row[1] for row in rows),
        tuple("fiducial" if row[2] == "fiducial" else "target" for row in rows),
        np.zeros((len(rows), 2)),
        np.tile(0.005**2 * np.eye(2), (len(rows), 1, 1)),
    )
    object_points = tuple(ObjectPoint(str(i), *(Prior(float(x)) for x in xyz)) for i, xyz in enumerate(points))
    values = Approximations(
        interior={"K": np.array([153.0, 0.2, -0.1])},
        exterior={},
        transformation={image.name: film(a) for image, a in zip(images, (0.02, 1.6, 3.1, -1.5, 0.3), strict=True)},
        points={},
    )
    return Network((camera,), images, object_points, observations), values


def film(turn: float) -> Array:
    """A shift, a turn, and a slight affinity and shear."""
    across = turn + SHEAR
    return np.array([2.0, STRETCH * np.cos(turn), -STRETCH * np.sin(turn), -1.0, np.sin(across), np.cos(across)])


def ordered_unknowns(problem: Problem) -> tuple[list[int], dict[str, int]]:
    """Positions of the free unknowns in the paper's order, and how many there are of each kind."""
    of = problem.unknowns
    kinds = {
        "transformations": [i for positions in of.transformation.values() for i in positions],
        "exterior orientations": [i for positions in of.exterior.values() for i in positions],
        "fiducials": [i for positions in of.fiducial.values() for i in positions],
        "interior, distortion": [int(i) for i in of.camera["K"][[1, 2, 0, *range(3, len(of.camera["K"]))]]],
    }
    free = {kind: [int(i) for i in positions if of.sigma[i] > 0.0] for kind, positions in kinds.items()}
    return [i for positions in free.values() for i in positions], {kind: len(free[kind]) for kind in free}


def dense(problem: Problem, by_unknowns: Array) -> Array:
    """Derivatives (m, 2, n) by all unknowns."""
    matrix = np.zeros((len(by_unknowns), 2, len(problem.unknowns)))
    for row, columns in enumerate(problem.columns):
        used = columns != ABSENT
        matrix[row][:, columns[used]] = by_unknowns[row][:, used]
    return matrix


def draw(folder: Path, found: Structure) -> None:
    """figure-1-A.png, figure-2-B.png and figure-3-N.png."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import ListedColormap

    for figure, (name, matrix) in enumerate(found.matrices.items(), 1):
        rows = found.unknowns if name == "N" else found.rows
        columns = found.rows if name == "A" else found.unknowns
        height = 7.5 if name != "N" else 5.5
        plot, axes = pyplot.subplots(figsize=(7.5 if name == "A" else 5.5, height), layout="constrained")
        size = np.sqrt(np.diag(matrix)) if name == "N" else np.abs(matrix).max(axis=0)
        filled = np.abs(matrix) > ROUNDING * (np.outer(size, size) if name == "N" else size)
        group = np.repeat(np.arange(len(rows)), list(rows.values()))[:, None]
        axes.imshow(np.where(filled, group + 1, 0), cmap=ListedColormap(["white", *COLOURS]), vmin=0, vmax=4,
                    interpolation="nearest")  # fmt: skip
        for sizes, ticks, labels, line in (
            (rows, axes.set_yticks, axes.set_yticklabels, axes.axhline),
            (columns, axes.set_xticks, axes.set_xticklabels, axes.axvline),
        ):
            ends = np.cumsum(list(sizes.values()))
            ticks(ends - np.array(list(sizes.values())) / 2 - 0.5)
            labels(list(sizes))
            for end in ends[:-1]:
                line(end - 0.5, color="0.6", linewidth=0.6)
        axes.tick_params(length=0)
        pyplot.setp(axes.get_xticklabels(), rotation=45, ha="right", rotation_mode="anchor")
        axes.set_title(f"{name}, {matrix.shape[0]} × {matrix.shape[1]}, {filled.sum()} elements", fontsize=10)
        plot.savefig(folder / f"figure-{figure}-{name}.png", dpi=DOTS_PER_INCH)
        pyplot.close(plot)


if __name__ == "__main__":
    main()
