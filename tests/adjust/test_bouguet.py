"""The published calibration of Bouguet's chessboard: his own corners, no approximations, his values and sigmas.

J.-Y. Bouguet, Camera Calibration Toolbox for Matlab, first calibration example. His uncertainties are three standard
deviations, his pixel origin is the centre of the top left pixel, his distortion model is OpenCV's.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from real_data import DATA, needs
from scipy.io import loadmat

from adjust.functional_model.lens import Distortion, Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

FILE = DATA / "chessboards" / "bouguet" / "Calib_Results.mat"
pytestmark = needs("chessboards", "bouguet", "Calib_Results.mat")

PITCH_MM = 0.01
IMAGES = tuple(str(i) for i in range(1, 21))
CORNERS = 156


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    return dict(loadmat(FILE))


@pytest.fixture(scope="module")
def adjustment(published: dict[str, Any]) -> Adjustment:
    network = make_network(published)
    return adjust(network, approximate(network))


def make_network(published: dict[str, Any]) -> Network:
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "p1", "p2", "b1")}
    camera = Camera("camera", None, None, None, Distortion("opencv", free), center_mm=(3.195, -2.395))
    corners_px = np.concatenate([published[f"x_{image}"].T for image in IMAGES])
    board = published["X_1"].T
    kinds: list[ObservationKind] = ["target"] * (CORNERS * len(IMAGES))
    assert all((board == published[f"X_{image}"].T).all() for image in IMAGES)
    return Network(
        (camera,),
        tuple(Image(image, "camera", "none") for image in IMAGES),
        tuple(ObjectPoint(str(k), *(Prior(float(v)) for v in xyz)) for k, xyz in enumerate(board)),
        Observations(
            tuple(image for image in IMAGES for _ in range(CORNERS)),
            tuple(str(k) for _ in IMAGES for k in range(CORNERS)),
            tuple(kinds),
            corners_px * [PITCH_MM, -PITCH_MM],
            np.tile((0.15 * PITCH_MM) ** 2 * np.eye(2), (CORNERS * len(IMAGES), 1, 1)),
        ),
    )


def pixel_intrinsics(adjustment: Adjustment) -> tuple[Array, Array]:
    """fx, fy, cx, cy, k1, k2, p1, p2 and their standard deviations."""
    names = [f"IO.camera.{name}" for name in ("c", "b1", "x0", "y0", "k1", "k2", "p1", "p2")]
    rows = [adjustment.index(name) for name in names]
    c, b1, x0, y0, *distortion = adjustment.values[rows]
    by_own = np.eye(8)
    by_own[:4, :4] = 0.0
    by_own[0, :2], by_own[1, 0], by_own[2, 2], by_own[3, 3] = (1 + b1, c), 1.0, 1.0, -1.0
    by_own[:4] /= PITCH_MM
    covariance = by_own @ (adjustment.sigma0**2 * adjustment.cofactor_of(names)) @ by_own.T
    values = np.array([c * (1 + b1) / PITCH_MM, c / PITCH_MM, x0 / PITCH_MM, -y0 / PITCH_MM, *distortion])
    return values, np.sqrt(np.diag(covariance))


def test_published_values_within_a_tenth_of_the_published_sigmas(
    published: dict[str, Any], adjustment: Adjustment
) -> None:
    values, _ = pixel_intrinsics(adjustment)
    expected = np.concatenate([published[name].ravel() for name in ("fc", "cc", "kc")])[:8]
    assert (np.abs(values - expected) < 0.1 * published_sigmas(published)).all()


def test_standard_deviations_are_the_published_ones(published: dict[str, Any], adjustment: Adjustment) -> None:
    _, sigmas = pixel_intrinsics(adjustment)
    np.testing.assert_allclose(sigmas, published_sigmas(published), rtol=0.02)


def published_sigmas(published: dict[str, Any]) -> Array:
    return np.concatenate([published[f"{name}_error"].ravel() for name in ("fc", "cc", "kc")])[:8] / 3.0


def test_residuals_are_the_published_ones(published: dict[str, Any], adjustment: Adjustment) -> None:
    rms_px = np.sqrt((adjustment.residuals.v_mm**2).mean(axis=0)) / PITCH_MM
    np.testing.assert_allclose(rms_px, published["err_std"].ravel(), rtol=1e-3)
