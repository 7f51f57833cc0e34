"""Lens families and bent boards: claimed against realised standard deviations.

RMS errors over standard deviations by parameter, and chi-square per degree of freedom with its two-sided 1 % limits.
Image coordinates are computed by the renderer, which has its own formulas, or by OpenCV; boards bend as in mrcal.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.rotation import rotation_from_angles
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera
from adjust.problem.network import Board, Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import adjust
from benchmarks.harness import Row
from synthetic_images.projection import camera_from_object
from synthetic_images.scene import Family, SceneCamera
from synthetic_images.scene import SceneDistortion as SceneDistortion

Array = NDArray[np.float64]
Drawn = Callable[[np.random.Generator | None], Network]

SEED = 20
SIGMA_MM = 0.0004
R0_MM = 13.0
POINT_MM = (0.12, -0.07)
LENSES: dict[Family, tuple[float, dict[str, float]]] = {
    "aicon": (28.8, {"a1": -1.1e-4, "a2": 1.5e-7, "b1": 5.8e-6, "b2": -8.6e-6, "c1": -7e-5, "c2": -3.1e-5}),
    "australis": (28.8, {"k1": 1.1e-4, "k2": -1.2e-7, "p1": 5.8e-6, "p2": -8.6e-6, "b1": -7e-5, "b2": -3.1e-5}),
    "opencv": (28.8, {"k1": -0.09, "k2": 0.1, "p1": 2e-4, "p2": -1e-4, "b1": 4e-4, "b2": -3e-4}),
    "opencv_fisheye": (11.0, {"k1": 0.03, "k2": -0.01, "k3": 0.002, "b1": 4e-4, "b2": -3e-4}),
}
ATTITUDES = [(0.0, 0.0, 0.1), (0.5, 0.1, 1.6), (-0.5, 0.2, 3.1), (0.1, 0.5, -1.5), (-0.1, -0.5, 0.8), (0.3, -0.3, 2.3)]
ACROSS, DOWN, SPACING_MM = 10, 7, 30.0
BENDS_MM = (0.9, -0.5)
TURNS = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.3), (-0.5, 0.1, 1.2), (0.1, 0.55, -0.7), (0.0, -0.5, 2.0), (0.4, -0.4, -2.1)]


COLUMNS = {"lens": "", "parameters": "d", **dict.fromkeys(("least", "largest", "chi-square", "from", "to"), ".3f")}


def cells() -> Iterator[Row]:
    yield from ({"lens": lens} for lens in (*LENSES, "bent board"))


def case(lens: str, seed: int, sets: int = 200) -> Row:
    """Adjust `sets` of random errors from one start. sets: about a minute for 40."""
    if lens == "bent board":
        true = dict(zip(("BD.board.bend_x", "BD.board.bend_y"), BENDS_MM, strict=True)) | {"IO.C.k1": -0.08}
        return simulate(board_network, true | {"IO.C.c": 20.0}, sets, seed)
    family = cast(Family, lens)
    c, values = LENSES[family]
    true = {f"IO.C.{name}": value for name, value in {**values, "x0": POINT_MM[0], "y0": POINT_MM[1], "c": c}.items()}
    return simulate(partial(lens_network, family), true, sets, seed)


def simulate(drawn: Drawn, true: dict[str, float], sets: int, seed: int) -> Row:
    rng = np.random.default_rng(seed)
    start = approximate(drawn(None))
    errors, total = [], 0.0
    for _ in range(sets):
        found = adjust(drawn(rng), start)
        error = np.array([found.value(each) for each in true]) - list(true.values())
        cofactor = found.cofactor_of(list(true))
        errors.append(error / np.sqrt(np.diag(cofactor)))
        total += float(error @ np.linalg.solve(cofactor, error))
    ratios, freedom = np.sqrt(np.mean(np.square(errors), axis=0)), sets * len(true)
    low, high = (float(chi2.ppf(share, freedom)) / freedom for share in (0.005, 0.995))
    spread = {"least": ratios.min(), "largest": ratios.max(), "chi-square": total / freedom, "from": low, "to": high}
    return {"parameters": len(true), **spread}


def lens_network(name: Family, rng: np.random.Generator | None) -> Network:
    """Six views of a deep field of known points, 36 mm x 24 mm; c given approximately, the distortion unknown."""
    c, values = LENSES[name]
    camera = SceneCamera("C", (80.0, 80.0), c, POINT_MM, SceneDistortion(name, values, R0_MM))
    half = np.array([18.0, 12.0])
    reach = 4.0 if name == "opencv_fisheye" else half.max() / c
    field = np.random.default_rng(1).uniform(-1.0, 1.0, (120, 3)) * [reach, reach, 0.4]
    rows: list[tuple[int, int, Array]] = []
    for i, angles in enumerate(ATTITUDES):
        station = rotation_from_angles(np.array(angles)).T @ np.array([0.0, 0.0, 1.3])
        projected = camera_from_object(camera, (*station, *angles), field)
        rows += [(i, int(k), projected[k]) for k in np.flatnonzero((np.abs(projected) < half).all(axis=1))]
    free = dict.fromkeys(values, Prior(0.0, np.inf))
    return make_network(
        Camera("C", Prior(c * 1.03, np.inf), None, None, Distortion(name, free, r0_mm=R0_MM)), field, rows, rng
    )


def board_network(rng: np.random.Generator | None) -> Network:
    """Six views of a bent board by OpenCV."""
    t, u = np.meshgrid(np.linspace(0.0, 1.0, ACROSS), np.linspace(0.0, 1.0, DOWN))
    flat = np.stack([t.ravel() * (ACROSS - 1), u.ravel() * (DOWN - 1), 0.0 * t.ravel()], axis=1) * SPACING_MM
    real = flat.copy()
    real[:, 2] = (4.0 * (t - t**2) * BENDS_MM[0] + 4.0 * (u - u**2) * BENDS_MM[1]).ravel()
    rows: list[tuple[int, int, Array]] = []
    for i, angles in enumerate(TURNS):
        rotation = Rotation.from_euler("xyz", angles)
        shift = np.array([0.0, 0.0, 420.0]) - rotation.as_matrix() @ flat.mean(axis=0)
        matrix, lens = (
            np.array([[20.0, 0.0, 0.1], [0.0, 20.0, 0.05], [0.0, 0.0, 1.0]]),
            np.array([-0.08, 0.0, 0.0, 0.0]),
        )
        projected, _ = cv2.projectPoints(real, rotation.as_rotvec(), shift, matrix, lens)
        rows += [(i, k, place) for k, place in enumerate(np.reshape(projected, (-1, 2)) * [1.0, -1.0])]
    camera = Camera("C", None, None, None, Distortion("opencv", {"k1": Prior(0.0, np.inf)}))
    board = Board("board", {f"t{k}": place for k, place in enumerate(flat)})
    return make_network(camera, flat, rows, rng, (board,))


def make_network(
    camera: Camera,
    points: Array,
    rows: list[tuple[int, int, Array]],
    rng: np.random.Generator | None,
    boards: tuple[Board, ...] = (),
) -> Network:
    """Make a network. rows: image, point, place."""
    places = np.array([row[2] for row in rows])
    kinds: list[ObservationKind] = ["target"] * len(rows)
    return Network(
        (camera,),
        tuple(Image(f"i{i}", "C", "none") for i in sorted({row[0] for row in rows})),
        tuple(ObjectPoint(f"t{k}", *(Prior(float(v)) for v in xyz)) for k, xyz in enumerate(points)),
        Observations(
            tuple(f"i{row[0]}" for row in rows),
            tuple(f"t{row[1]}" for row in rows),
            tuple(kinds),
            places if rng is None else places + rng.normal(0.0, SIGMA_MM, places.shape),
            np.tile(SIGMA_MM**2 * np.eye(2), (len(rows), 1, 1)),
        ),
        boards=boards,
    )
