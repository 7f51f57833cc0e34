"""Zhang's five pictures with skew against his published result: 256 corners of 64 squares in each.

    python -m benchmarks zhang FOLDER           # his corners
    python -m benchmarks zhang FOLDER pictures  # corners measured in CalibIm1.png to CalibIm5.png, too

FOLDER holds Model.txt and data1.txt to data5.txt of his page (Z. Zhang, A flexible new technique for camera
calibration, PAMI 22, 2000), also in github.com/imagingbook/imagingbook-calibrate, beside his result. Nothing is
given but the corners: c, principal point, orientations and the lens are found. Takes some seconds.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import adjust
from measure.boards.measure import measure_board
from measure.boards.specs import SquareGridSpec
from measure.scans.opening import open_scan

Array = NDArray[np.float64]

PIXEL_MM = 0.01
INCH_MM = 25.4
MIDDLE_MM = (3.195, -2.395)  # of 640 x 480 pixels
PUBLISHED = {
    "alpha": 832.5,
    "beta": 832.53,
    "gamma": 0.204494,
    "u0": 303.959,
    "v0": 206.585,
    "k1": -0.228601,
    "k2": 0.190353,
}


def published(folder: Path) -> Network:
    model = np.loadtxt(folder / "Model.txt").reshape(-1, 2)
    pixels = [np.loadtxt(folder / f"data{i}.txt").reshape(-1, 2) for i in range(1, 6)]
    rows = [(f"{i}", f"{k}", place) for i, places in enumerate(pixels, 1) for k, place in enumerate(places)]
    return network_of({f"{k}": (x, y) for k, (x, y) in enumerate(model.tolist())}, rows)


def measured(folder: Path) -> Network:
    """Squares of half an inch, 8/9 of an inch apart, of which he has x to the right, y down."""
    spec = SquareGridSpec(8, 8, 0.5 * INCH_MM, (8.0 / 9.0 - 0.5) * INCH_MM)
    rows = []
    for i in range(1, 6):
        board = measure_board(open_scan(folder / f"CalibIm{i}.png"), spec)
        seen = [mark for mark in board.marks if mark.status.is_observation and mark.center_px is not None]
        rows += [(f"{i}", mark.point, np.asarray(mark.center_px)) for mark in seen]
        print(f"CalibIm{i}.png: {len(seen)} of {len(board.marks)} corners measured {board.reason}")
    return network_of({id: (x / INCH_MM, y / INCH_MM) for id, (x, y, _) in spec.object_points().items()}, rows)


def network_of(model: dict[str, tuple[float, float]], rows: list[tuple[str, str, Array]]) -> Network:
    """Rows: picture, point, column and row."""
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "b1", "b2")}
    kinds: list[ObservationKind] = ["target"] * len(rows)
    return Network(
        (Camera("Z", None, None, None, Distortion("opencv", free), center_mm=MIDDLE_MM),),
        tuple(Image(f"{i}", "Z", "none") for i in range(1, 6)),
        tuple(ObjectPoint(id, Prior(x), Prior(y), Prior(0.0)) for id, (x, y) in model.items()),
        Observations(
            tuple(image for image, _, _ in rows),
            tuple(point for _, point, _ in rows),
            tuple(kinds),
            np.array([place for _, _, place in rows]) * [PIXEL_MM, -PIXEL_MM],
            np.tile((0.25 * PIXEL_MM) ** 2 * np.eye(2), (len(kinds), 1, 1)),
        ),
    )


def main() -> None:
    folder = Path(sys.argv[1])
    compare(published(folder))
    if sys.argv[2:] == ["pictures"]:
        compare(measured(folder))


def compare(network: Network) -> None:
    found = adjust(network, approximate(network))
    names = [f"IO.Z.{name}" for name in ("c", "b1", "b2", "x0", "y0", "k1", "k2")]
    c, b1, b2, x0, y0, k1, k2 = (found.value(name) for name in names)
    values = [c * (1 + b1), c, c * b2, x0, -y0]
    by_own = np.zeros((7, 7))
    by_own[0, :2], by_own[1, 0], by_own[2, [0, 2]] = (1 + b1, c), 1.0, (b2, c)
    by_own[3, 3], by_own[4, 4] = 1.0, -1.0
    by_own[:5] /= PIXEL_MM
    by_own[5, 5] = by_own[6, 6] = 1.0
    sigmas = found.sigma0 * np.sqrt(np.diag(by_own @ found.cofactor_of(names) @ by_own.T))
    rms_px = np.sqrt((found.residuals.v_mm**2).sum(axis=1).mean()) / PIXEL_MM
    print(f"{network}: converged {found.converged}, {rms_px:.4f} px rms a point\n")
    print("| | published | here | sigma | differs by, sigmas |\n|---|---|---|---|---|")
    here = [*(np.array(values) / PIXEL_MM), k1, k2]
    for (name, his), value, sigma in zip(PUBLISHED.items(), here, sigmas, strict=True):
        print(f"| {name} | {his:.6g} | {value:.6g} | {sigma:.2g} | {(value - his) / sigma:.4f} |")


if __name__ == "__main__":
    main()
