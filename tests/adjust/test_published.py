"""Published calibrations: Bouguet's chessboard, and a self-calibration of a strong lens."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import digital_network
from numpy.typing import NDArray
from real_data import DATA, needs
from scipy.io import loadmat

from adjust import Adjustment, Camera, Distortion, Network, ObjectPoint, Options, Prior, adjust, approximate

Array = NDArray[np.float64]

FILE = DATA / "chessboards" / "bouguet" / "Calib_Results.mat"

PITCH_MM = 0.01
IMAGES = tuple(str(i) for i in range(1, 21))


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
    board = published["X_1"].T
    assert all((board == published[f"X_{image}"].T).all() for image in IMAGES)
    rows = [
        (image, str(k), xy * [PITCH_MM, -PITCH_MM])
        for image in IMAGES
        for k, xy in enumerate(published[f"x_{image}"].T)
    ]
    return digital_network(camera, rows, {str(k): xyz for k, xyz in enumerate(board)}, 0.15 * PITCH_MM)


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


@needs("chessboards", "bouguet", "Calib_Results.mat")
def test_published_values_within_a_tenth_of_the_published_sigmas(
    published: dict[str, Any], adjustment: Adjustment
) -> None:
    values, _ = pixel_intrinsics(adjustment)
    expected = np.concatenate([published[name].ravel() for name in ("fc", "cc", "kc")])[:8]
    assert (np.abs(values - expected) < 0.1 * published_sigmas(published)).all()


@needs("chessboards", "bouguet", "Calib_Results.mat")
def test_standard_deviations_are_the_published_ones(published: dict[str, Any], adjustment: Adjustment) -> None:
    _, sigmas = pixel_intrinsics(adjustment)
    np.testing.assert_allclose(sigmas, published_sigmas(published), rtol=0.02)


def published_sigmas(published: dict[str, Any]) -> Array:
    return np.concatenate([published[f"{name}_error"].ravel() for name in ("fc", "cc", "kc")])[:8] / 3.0


@needs("chessboards", "bouguet", "Calib_Results.mat")
def test_residuals_are_the_published_ones(published: dict[str, Any], adjustment: Adjustment) -> None:
    rms_px = np.sqrt((adjustment.residuals.v_mm**2).mean(axis=0)) / PITCH_MM
    np.testing.assert_allclose(rms_px, published["err_std"].ravel(), rtol=1e-3)


FOLDER = DATA / "coded" / "camcal" / "camcaldemo"

PIXEL_MM = np.array([5.43764 / 1704 * 1.000389598, 5.43764 / 1704])
SIGMA_PX = 0.1
PUBLISHED = {  # value and standard deviation; brown's signs are the opposite of that program's
    "c": (7.457, 0.00105),
    "x0": (3.61546 * 1.000389598, 0.00082),
    "y0": (-2.61329, 0.00098),
    "k1": (-4.58861e-3, 2.21e-5),
    "k2": (4.51351e-5, 2.65e-6),
    "k3": (2.05253e-6, 1.01e-7),
    "p1": (6.12803e-5, 3.52e-6),
    "p2": (4.41172e-5, 3.94e-6),
}


@pytest.fixture(scope="module")
def network() -> Network:
    return network_of_demo()


def network_of_demo() -> Network:
    known = {row[0]: np.array(row[2:5], float) for row in table(FOLDER / "reference" / "camcal-fixed.txt")}
    marks = table(FOLDER / "measurements" / "markpts.txt")
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "k3", "p1", "p2", "b1")}
    camera = Camera("C4040Z", None, None, None, Distortion("brown", free), center_mm=(3.6265, -2.7188))
    rows = [(row[0], row[1], np.array([float(row[2]), -float(row[3])]) * PIXEL_MM) for row in marks]
    network = digital_network(camera, rows, known, SIGMA_PX * PIXEL_MM[1])
    unknown = sorted({row[1] for row in marks} - known.keys())
    return replace(network, points=(*network.points, *(ObjectPoint(point, None, None, None) for point in unknown)))


def table(file: Path) -> list[list[str]]:
    lines = file.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.split(",")] for line in lines if line.strip() and not line.startswith("#")]


@needs("coded", "camcal", "camcaldemo")
@pytest.mark.study
def test_the_published_result_is_found_from_nothing(network: Network) -> None:
    """By elements: each parameter to a tenth of its sigma, each sigma to half a percent, sigma0 to its last digit."""
    adjustment = adjust(network, approximate(network), Options(method="elements"))
    assert adjustment.converged
    assert adjustment.redundancy == 3725
    assert adjustment.sigma0 * SIGMA_PX == pytest.approx(0.16148, abs=1e-5)
    for name, (value, sigma) in PUBLISHED.items():
        assert abs(adjustment.value(f"IO.C4040Z.{name}") - value) < 0.1 * sigma, name
        assert adjustment.sigma(f"IO.C4040Z.{name}") == pytest.approx(sigma, rel=0.005), name


@needs("coded", "camcal", "camcaldemo")
@pytest.mark.study
def test_the_strict_model_is_near_it(network: Network) -> None:
    adjustment = adjust(network, approximate(network))
    assert adjustment.converged
    assert adjustment.redundancy == 3725
    assert adjustment.sigma0 * SIGMA_PX == pytest.approx(0.1555, abs=2e-4)
    for name, (value, sigma) in PUBLISHED.items():
        assert abs(adjustment.value(f"IO.C4040Z.{name}") - value) < 0.5 * sigma, name
        assert adjustment.sigma(f"IO.C4040Z.{name}") == pytest.approx(sigma, rel=0.03), name
