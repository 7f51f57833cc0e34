"""Every derivative against complex steps, or against differences of the functions it belongs to."""

from dataclasses import replace

import numpy as np
import pytest
from bent_scans import MIDDLE_MM, bend_in_scanner
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from simulated import KINDS, Truth, simulated
from studies import parametrize_with_studies

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Decentering, Distortion, Lens, Prior
from adjust.functional_model.projection import rays
from adjust.functional_model.rotation import (
    angles_from_rotation,
    rotation_from_angles,
    rotation_from_vector,
    vector_by_angles,
)
from adjust.problem.condition_equations import compute, computed_observations, derivatives
from adjust.problem.network import Transformation
from adjust.problem.problem import Problem, number

Array = NDArray[np.float64]

STEP = 1e-30
BEND = {"a20": Prior(0.9, np.inf), "b11": Prior(-0.7, np.inf), "a03": Prior(0.5, np.inf), "b60": Prior(0.0, np.inf)}

PARAMETER_VALUES: dict[str, list[float]] = {
    "none": [],
    "torlegard": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-5, 3e-9],
    "brown": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-4, -3e-4],
    "opencv": [0.1, -0.05, 0.01, -0.02, 0.03, 0.04, -0.03, 0.02, 0.01, 0.02, -0.01, 0.03, 0.2, -0.15, 0.002, 0.003],
    "opencv_fisheye": [0.1, -0.05, 0.03, 0.02, 0.002, -0.003],
    "australis": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-4, -3e-4],
    "aicon": [1e-7, -2e-12, 3e-17, 1e-6, -2e-6, 1e-4, -3e-4],
    "juhl": [6.0, -4.0, 3.0, -2.0, 5.0, -4.0, 2.0, -7.0, 3.0],
    **{
        name: (0.05 * np.cos(np.arange(len(parameter_names(name))))).tolist()
        for name in ("ebner", "gruen", "legendre(2)", "legendre(5)", "fourier(1)", "fourier(3)")
    },
}


@pytest.mark.parametrize("decentering", ["reduced", "paper"])
@pytest.mark.parametrize("family", list(PARAMETER_VALUES))
def test_image_equations_by_complex_steps(family: str, decentering: Decentering) -> None:
    rng = np.random.default_rng(3)
    distortion = Distortion(family, decentering=decentering, r0_mm=135.0, half_mm=(115.0, 90.0))
    parts = [
        np.array([153.0, 0.8, -0.5]),
        np.array(PARAMETER_VALUES[family]),
        rng.uniform(-100, 100, (6, 2)),
        rng.uniform(-0.7, 0.7, (6, 2)),
    ]
    at = Lens(distortion, *parts[:2]).equations(*parts[2:])
    for part_number, derivative in enumerate(
        (at.interior_jacobian, at.parameter_jacobian, at.xy_jacobian, at.ray_jacobian)
    ):
        for column in range(derivative.shape[2]):
            moved = [part.astype(complex) for part in parts]
            moved[part_number][..., column] += 1j * STEP
            numeric = Lens(distortion, *moved[:2]).equations(*moved[2:]).value.imag / STEP
            scale = np.abs(numeric).max() or 1.0
            np.testing.assert_allclose(derivative[..., column], numeric, rtol=0, atol=2e-14 * scale)


def test_rotation_is_the_product_of_three() -> None:
    omega, phi, kappa = 0.3, -0.7, 2.1
    so, co, sp, cp, sk, ck = (f(a) for a in (omega, phi, kappa) for f in (np.sin, np.cos))
    r1 = [[1, 0, 0], [0, co, so], [0, -so, co]]
    r2 = [[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]]
    r3 = [[ck, sk, 0], [-sk, ck, 0], [0, 0, 1]]
    product = np.array(r3) @ np.array(r2) @ np.array(r1)
    np.testing.assert_allclose(rotation_from_angles(np.array([omega, phi, kappa])), product, atol=1e-15)


def test_rotation_vector_by_angles() -> None:
    """M(angles + d) is, to first order, the rotation by J d on top of M(angles)."""
    angles = np.array([0.3, -0.7, 2.1])
    jacobian = vector_by_angles(angles)
    step = 1e-7 * np.array([0.4, -1.0, 0.7])
    moved = rotation_from_vector(jacobian @ step) @ rotation_from_angles(angles)
    np.testing.assert_allclose(moved, rotation_from_angles(angles + step), atol=1e-13)


@pytest.mark.parametrize("length", [1e-9, 0.3, 1.4, 3.1])
def test_a_rotation_vector_is_the_rotation_of_other_programs(length: float) -> None:
    vector = length * np.array([2.0, -3.0, 6.0]) / 7.0
    np.testing.assert_allclose(rotation_from_vector(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)


def test_angles_of_any_rotation() -> None:
    for matrix in Rotation.random(50, rng=np.random.default_rng(8)).as_matrix():
        np.testing.assert_allclose(rotation_from_angles(angles_from_rotation(matrix)), matrix, atol=1e-12)
    locked = rotation_from_angles(np.array([0.4, np.pi / 2, 0.3]))
    np.testing.assert_allclose(rotation_from_angles(angles_from_rotation(locked)), locked, atol=1e-12)


def test_rays_accept_complex_steps() -> None:
    rng = np.random.default_rng(5)
    rotation = rotation_from_angles(np.array([0.1, 0.2, 0.3]))
    xyz = rng.uniform(-1, 1, (4, 3)).astype(complex)
    xyz[:, 2] += -10 + 1j * STEP
    ray, in_camera = rays(rotation, xyz)
    u, v, w = in_camera.real.T
    m = rotation[:, 2]
    expected = np.stack([-m[0] / w + u * m[2] / w**2, -m[1] / w + v * m[2] / w**2], axis=1)
    np.testing.assert_allclose(ray.imag / STEP, expected, rtol=1e-13)


@pytest.mark.parametrize("by_elements", [False, True])
@parametrize_with_studies("kind", KINDS, quick=(0, 2, 4, 5, 7))
def test_functions_by_differences_of_computed_observations(kind: Transformation, by_elements: bool) -> None:
    """F(l(x), x) = 0 defines l(x), so that dl/dx = -A^-1 B: by central differences of l for every unknown, of an image
    without a scanner and of three of one that bends."""
    rng = np.random.default_rng(11)
    middle_mm = MIDDLE_MM if kind != "none" else (0.0, 0.0)
    truth = Truth(mirrored=(False, kind != "none", False, False), middle_mm=middle_mm)
    network, start = simulated(rng, truth, kind, point_sigma=np.inf, free={"k3": np.inf, "k5": np.inf})
    network = bend_in_scanner(network, {}, BEND)
    network = replace(network, images=(replace(network.images[0], scanner=""), *network.images[1:]))
    problem = number(network, start, by_elements)
    every = np.where(problem.unknowns.sigma > 0.0, problem.unknowns.sigma, np.inf)
    problem = replace(problem, unknowns=replace(problem.unknowns, sigma=every))
    state = problem.start()
    computed = compute(problem, state)
    assert computed is not None
    at = derivatives(problem, state, computed)
    by_unknowns = -np.linalg.solve(at.by_observation, at.by_unknowns)
    names, columns = [each.text for each in problem.unknowns.parameters], problem.columns
    for alike in apart(problem):
        sizes = np.array([choose_step(names[position]) for position in alike])
        numeric = (shift_unknowns(problem, alike, sizes) - shift_unknowns(problem, alike, -sizes)) / (2 * sizes[0])
        is_moved = np.isin(columns, alike)
        analytic = (by_unknowns * is_moved[:, None, :]).sum(axis=2)
        assert is_moved.sum(axis=1).max() <= 1
        assert not numeric[~is_moved.any(axis=1)].any()
        for position in alike:
            own = (columns == position).any(axis=1)
            scale = np.abs(numeric[own]).max(initial=0.0)
            np.testing.assert_allclose(
                analytic[own], numeric[own], rtol=0, atol=3e-6 * scale + 1e-30, err_msg=names[position]
            )


def apart(problem: Problem) -> list[list[int]]:
    """The unknowns by what they are, of all images and points: no observation depends on two of one kind."""
    groups: dict[tuple[str, str], list[int]] = {}
    for position, name in enumerate(each.text for each in problem.unknowns.parameters):
        groups.setdefault((name.split(".")[0], name.rsplit(".", 1)[1]), []).append(position)
    return list(groups.values())


def choose_step(name: str) -> float:
    """A step that moves the image by some micrometres."""
    owner, quantity = name.split(".")[0], name.rsplit(".", 1)[1]
    if owner in ("EO", "PT"):
        return 1e-5 if quantity in ("omega", "phi", "kappa") else 0.01
    if owner == "T":
        return {"angle": 1e-5, "c1": 3e-4, "c2": 3e-4}.get(quantity, 1e-3)
    powers = {"k3": 1e-10, "k5": 1e-14, "k7": 1e-18, "p1": 1e-8, "p2": 1e-8, "p3": 1e-7, "p4": 1e-11}
    return powers.get(quantity, 1e-3)


def shift_unknowns(problem: Problem, positions: list[int], sizes: Array) -> Array:
    step = np.zeros(len(problem.unknowns))
    step[positions] = sizes
    computed = computed_observations(problem, problem.step_state(problem.start(), step))
    assert computed is not None
    return computed
