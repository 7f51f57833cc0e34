"""Pictures of a flat board by a digital camera, projected by OpenCV."""

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import Observations

Array = NDArray[np.float64]

FRAME_MM = (3.2, 2.4)
TRUTH = {"c": 2.7, "x0": 1.65, "y0": -1.18, "k1": -0.28, "k2": 0.09}


def board_network(
    rng: np.random.Generator, images: int, sigma_mm: float, given_mm: float | None = None, k3: float = 0.0
) -> Network:
    """Marks with errors of sigma_mm, to which given_mm is given; of each picture its own tilt and shift."""
    points = np.array([[25.0 * column, 25.0 * row, 0.0] for row in range(6) for column in range(9)])
    matrix = np.array([[TRUTH["c"], 0, TRUTH["x0"]], [0, TRUTH["c"], -TRUTH["y0"]], [0, 0, 1]])
    names, places = [f"p{number}" for number in range(images)], []
    for _ in names:
        turn = rng.uniform(-0.5, 0.5, 3)
        rotation = np.asarray(cv2.Rodrigues(turn)[0]) @ np.diag([1.0, -1.0, -1.0])
        shift = np.array([*rng.uniform(-40, 40, 2), rng.uniform(300, 420)]) - rotation @ points.mean(axis=0)
        lens = np.array([TRUTH["k1"], TRUTH["k2"], 0.0, 0.0, k3])
        projected = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], shift, matrix, lens)[0]
        places.append(np.asarray(projected, float).reshape(-1, 2) * [1.0, -1.0])
    count = len(points)
    xy_mm = np.concatenate(places) + sigma_mm * rng.normal(size=(images * count, 2))
    covariance = np.broadcast_to(np.eye(2) * (given_mm or sigma_mm) ** 2, (images * count, 2, 2)).copy()
    ids = [f"b{number}" for number in range(count)]
    free = Prior(0.0, np.inf)
    distortion = Distortion("opencv", {"k1": free, "k2": free})
    middle = (FRAME_MM[0] / 2, -FRAME_MM[1] / 2)
    camera = Camera("desk", None, None, None, distortion, center_mm=middle, frame_mm=FRAME_MM)
    return Network(
        cameras=(camera,),
        images=tuple(Image(name, "desk", "none") for name in names),
        points=tuple(
            ObjectPoint(id, *(Prior(float(value), 0.0) for value in xyz)) for id, xyz in zip(ids, points, strict=True)
        ),
        observations=Observations(
            image=tuple(name for name in names for _ in ids),
            point=tuple(ids) * images,
            kind=tuple("target" for _ in range(images * count)),
            xy_mm=xy_mm,
            covariance_mm2=covariance,
        ),
    )
