"""Rational lenses over ordinary boards: the parameters trade off, the distortion is known, and the result says so."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import Observations
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

EIGHT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
TWELVE = (*EIGHT, "s1", "s2", "s3", "s4")
FOURTEEN = (*TWELVE, "tau_x", "tau_y")
SIGMA_MM = 0.001
FRAME_MM = np.array([12.8, 9.6])
C, CX, CY = 10.0, 6.41, 4.77
LENS = np.array([-0.25, 0.08, 4e-4, -3e-4, 0.01])


def board_network(seed: int, free: tuple[str, ...], noise: bool = True, images: int = 8) -> Network:
    """A board of 54 corners in the middle of pictures of 1280 x 960 pixels of 0.01 mm, noise of a tenth of one."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    board = 25.0 * np.stack([x.ravel() - 4.0, y.ravel() - 2.5, np.zeros(54)], axis=1)
    matrix = np.array([[C, 0.0, CX], [0.0, C, CY], [0.0, 0.0, 1.0]])
    view = []
    for i in range(images):
        azimuth, tilt = 2.0 * np.pi * i / images, np.radians(rng.uniform(20.0, 40.0))
        turn = np.array([np.cos(azimuth) * tilt, np.sin(azimuth) * tilt, 0.2 * rng.normal()])
        shift = np.array([*rng.uniform(-60.0, 60.0, 2), rng.uniform(550.0, 800.0)])
        view.append(cv2.projectPoints(board, turn, shift, matrix, LENS)[0].reshape(-1, 2) * [1.0, -1.0])
    places = np.concatenate(view)
    count = len(places)
    camera = Camera(
        "cam",
        Prior(1.02 * C, np.inf),
        Prior(FRAME_MM[0] / 2.0, np.inf),
        Prior(-FRAME_MM[1] / 2.0, np.inf),
        Distortion("opencv", {name: Prior(0.0, np.inf) for name in free}),
    )
    return Network(
        (camera,),
        tuple(Image(f"i{i}", "cam", "none") for i in range(images)),
        tuple(ObjectPoint(f"c{k}", *(Prior(float(each)) for each in xyz)) for k, xyz in enumerate(board)),
        Observations(
            tuple(f"i{i}" for i in range(images) for _ in range(54)),
            tuple(f"c{k}" for _ in range(images) for k in range(54)),
            tuple("target" for _ in range(count)),
            places + noise * rng.normal(0.0, SIGMA_MM, places.shape),
            np.tile(SIGMA_MM**2 * np.eye(2), (count, 1, 1)),
        ),
    )


def true_ideal(from_principal_point: Array) -> Array:
    """The true lens's rays (n, 2) times c, of places about the principal point: OpenCV's formula, inverted."""
    k1, k2, p1, p2, k3 = LENS
    places = from_principal_point * [1.0, -1.0] / C
    ray = places
    for _ in range(50):
        x, y = ray.T
        r2 = x * x + y * y
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))[:, None]
        tangential = [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        ray = (places - np.transpose(tangential)) / radial
    return np.asarray(C * ray * [1.0, -1.0])


def distortion_errors(result: Adjustment, radius_mm: float) -> tuple[Array, Array]:
    """Errors (n,) of the distortion along the radius in mm, in six directions, and their standard deviations."""
    of = result.network.cameras[0].distortion
    names = [f"IO.cam.{name}" for name in ("c", *parameter_names("opencv"))]
    angles = np.arange(6) * np.pi / 3.0
    outward = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = radius_mm * outward

    def ideal(values: Array) -> Array:
        interior = np.array([values[0], 0.0, 0.0])
        return Lens(of, interior, values[1:]).ideal_from_observed(places)[0]

    values = np.array([result.value(name) for name in names])
    steps = 1e-3 * np.array([result.sigma(name) for name in names])
    by = np.stack(
        [
            (ideal(values + step) - ideal(values - step)) / (2.0 * max(size, 1e-30))
            for size, step in zip(steps, np.diag(steps), strict=True)
        ],
        axis=2,
    )
    along = np.einsum("nik,ni->nk", by, outward)
    cofactor = result.sigma0**2 * result.cofactor_of(names)
    sigma = np.sqrt(np.einsum("nk,kl,nl->n", along, cofactor, along))
    return ((ideal(values) - true_ideal(places)) * outward).sum(axis=1), sigma


@parametrize_with_studies("free", [EIGHT, TWELVE, FOURTEEN], quick=(0, 1))
@parametrize_with_studies("seed", [0, 1])
def test_an_ordinary_board_gives_a_rational_lens(seed: int, free: tuple[str, ...]) -> None:
    result = adjust(board_network(seed, free))
    assert result.converged
    assert result.iterations < 60
    assert not result.warnings
    (note,) = result.notes
    assert "k4" in note
    assert "of camera cam cannot be separated" in note
    assert abs(result.sigma0 - 1.0) < 0.1
    assert abs(result.value("IO.cam.c") - C) < 4.0 * result.sigma("IO.cam.c")
    assert result.sigma("IO.cam.k4") > 0.3


@pytest.mark.parametrize("seed", [0, 1])
def test_the_distortion_itself_is_known(seed: int) -> None:
    """To a fifth of a pixel, though no parameter is known to a tenth of what it could be."""
    result = adjust(board_network(seed, EIGHT))
    for radius_mm in (1.0, 2.0):
        errors, sigma = distortion_errors(result, radius_mm)
        assert (np.abs(errors) < 4.0 * sigma).all()
        assert sigma.max() < 0.002


def test_redundancy_counts_what_pseudo_observations_determine() -> None:
    """Two directions or more of the eight parameters are none that the observations determine."""
    result = adjust(board_network(0, EIGHT))
    observed = 2 * len(result.network.observations)
    assert observed - result.unknowns < result.redundancy <= observed - result.unknowns + 4
    assert result.redundancy == pytest.approx(result.residuals.redundancy.sum(), abs=1.0)


def test_the_other_lenses_have_no_pseudo_observations() -> None:
    network = board_network(0, ("k1", "k2", "p1", "p2", "k3"))
    result = adjust(network)
    assert not result.notes
    assert result.redundancy == 2 * len(network.observations) - result.unknowns


@pytest.mark.study
def test_the_distortion_is_as_uncertain_as_it_claims() -> None:
    """Monte Carlo: realised over claimed at three radii, 100 trials; each within what chance allows at 99 %."""
    exact = board_network(0, EIGHT, noise=False)
    rng = np.random.default_rng(5)
    squares: dict[float, list[tuple[float, float]]] = {0.8: [], 1.6: [], 2.2: []}
    for _ in range(100):
        noise = rng.normal(0.0, SIGMA_MM, exact.observations.xy_mm.shape)
        observations = replace(exact.observations, xy_mm=exact.observations.xy_mm + noise)
        result = adjust(replace(exact, observations=observations))
        assert result.converged
        for radius_mm, pairs in squares.items():
            errors, sigma = distortion_errors(result, radius_mm)
            pairs.append((float(errors @ errors), float(sigma @ sigma)))
    for pairs in squares.values():
        realised, claimed = np.sqrt(np.mean(pairs, axis=0))
        assert 0.82 < realised / claimed < 1.18


def test_how_far_out_the_lens_is_known() -> None:
    """The outermost corner of the board against the picture's, and a standard deviation that grows beyond."""
    result = adjust(board_network(0, EIGHT))
    camera = result.network.cameras[0]
    reach = result.lens_reach(camera, (float(FRAME_MM[0]), float(FRAME_MM[1])))
    assert reach is not None
    x0, y0 = result.value("IO.cam.x0"), result.value("IO.cam.y0")
    offsets = result.network.observations.xy_mm - (x0, y0)
    assert reach.radius_mm == pytest.approx(np.hypot(*offsets.T).max())
    assert reach.corner_mm == pytest.approx(max(np.hypot(x - x0, y - y0) for x in (0.0, 12.8) for y in (0.0, -9.6)))
    assert reach.share == pytest.approx(reach.radius_mm / reach.corner_mm)
    assert reach.sigma_um < 3.0
    assert not reach.corner_sigma_um < 20.0
    unknown = result.lens_reach(camera)
    assert unknown is not None
    assert np.isnan(unknown.corner_mm)
