"""The refit of the adjustment's distortion in OpenCV's model, against independent figures and OpenCV itself."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from adjust.functional_model.families import parameter_names
from adjust.problem.network import Distortion
from pipeline.opencv_check.opencv_model import NAMES, Freedom, image_grid, project, refit, refit_jacobian

Array = NDArray[np.float64]

FRAME_MM = np.array([[-10.0, -7.5], [10.0, 7.5]])
C_MM = 24.0
INTERIOR = np.array([C_MM, 0.05, -0.03])
MODERATE = {"k3": 1.2e-4, "k5": -2e-7, "p1": 3e-6, "p2": -2e-6}  # 170 um at the corner
RADIAL_TANGENTIAL = Freedom(("fx", "cx", "cy", "k1", "k2", "p1", "p2", "k3"))


def torlegard(**values: float) -> Array:
    return np.array([values.get(name, 0.0) for name in parameter_names("torlegard")])


def started(c_mm: float = C_MM) -> Array:
    return np.array([c_mm, c_mm, *np.zeros(len(NAMES) - 2)])


@pytest.mark.parametrize(("strength", "at_most_um"), [(1.0, 0.06), (4.0, 0.4)])
def test_refit_leaves_what_an_independent_calculation_found(strength: float, at_most_um: float) -> None:
    """0.06 um at the corner for 170 um of distortion, 0.4 um for 670 um."""
    lens = torlegard(**{name: strength * value for name, value in MODERATE.items()})
    found = refit(Distortion("torlegard"), INTERIOR, lens, image_grid(FRAME_MM), RADIAL_TANGENTIAL, started())
    assert 1e3 * found.residual_mm < at_most_um


def test_series_holds_for_a_weak_lens() -> None:
    """k1 = k3 c², k2 = (3 k3² + k5) c⁴, p1cv = -p2 c, p2cv = p1 c: exact in the limit of a weak lens."""
    k3, k5, p1, p2 = 1e-6, -2e-10, 3e-7, -2e-7
    lens = torlegard(k3=k3, k5=k5, p1=p1, p2=p2)
    found = refit(Distortion("torlegard"), INTERIOR, lens, image_grid(FRAME_MM), RADIAL_TANGENTIAL, started())
    values = dict(zip(NAMES, found.parameters, strict=True))
    assert values["fx"] == pytest.approx(C_MM, rel=1e-7)
    assert values["k1"] == pytest.approx(k3 * C_MM**2, rel=1e-2)
    assert values["k2"] == pytest.approx((3 * k3**2 + k5) * C_MM**4, rel=5e-2)
    assert values["p1"] == pytest.approx(-p2 * C_MM, rel=1e-2)
    assert values["p2"] == pytest.approx(p1 * C_MM, rel=1e-2)


def test_opencv_family_is_given_back_as_it_is() -> None:
    names = parameter_names("opencv")
    values = {"k1": -0.26, "k2": 0.13, "p1": -2e-4, "p2": 4e-5, "k3": 0.01, "b1": 6e-4}
    free = Freedom(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"))
    lens = np.array([values.get(name, 0.0) for name in names])
    found = refit(Distortion("opencv"), INTERIOR, lens, image_grid(FRAME_MM), free, started())
    expected = {**values, "fx": C_MM * (1 + values["b1"]), "fy": C_MM, "cx": INTERIOR[1], "cy": INTERIOR[2]}
    assert found.residual_mm < 1e-10
    for name in free.names:
        assert found.parameters[NAMES.index(name)] == pytest.approx(expected[name], rel=1e-7, abs=1e-10)


def test_r0_is_no_parameter_of_its_own() -> None:
    """r0 is r0 = 0 with c, k and p divided by 1 + k3 r0² + k5 r0⁴ (+ k7 r0⁶)."""
    r0 = 8.0
    with_r0 = refit(
        Distortion("torlegard", r0_mm=r0),
        INTERIOR,
        torlegard(**MODERATE),
        image_grid(FRAME_MM),
        RADIAL_TANGENTIAL,
        started(),
    )
    ratio = 1 + MODERATE["k3"] * r0**2 + MODERATE["k5"] * r0**4
    scaled = torlegard(**{name: value / ratio for name, value in MODERATE.items()})
    interior = np.array([C_MM / ratio, *INTERIOR[1:]])
    without = refit(Distortion("torlegard"), interior, scaled, image_grid(FRAME_MM), RADIAL_TANGENTIAL, started())
    np.testing.assert_allclose(with_r0.parameters, without.parameters, rtol=1e-9, atol=1e-12)


def test_one_focal_length_keeps_the_ratio() -> None:
    start = started()
    start[0] *= 1.01
    found = refit(Distortion("none"), INTERIOR, np.zeros(0), image_grid(FRAME_MM), Freedom(("fx", "cx", "cy")), start)
    assert found.parameters[0] / found.parameters[1] == pytest.approx(1.01, rel=1e-12)


def test_projection_and_derivatives_are_opencvs_with_y_up() -> None:
    values = np.array([24.0, 24.1, 0.05, -0.03, -0.2, 0.05, 1e-3, -5e-4, 0.01, *np.zeros(9)])
    rays = np.array([[0.3, 0.2], [-0.1, 0.25]])
    xy, by_values = project(values, rays)
    x, y = rays[0, 0], -rays[0, 1]
    down, _ = cv2.projectPoints(
        np.array([[x, y, 1.0]]),
        np.zeros(3),
        np.zeros(3),
        np.array([[24.0, 0, 0.05], [0, 24.1, 0.03], [0, 0, 1]]),
        values[4:9],
    )
    np.testing.assert_allclose(xy[0], down.ravel() * [1.0, -1.0], atol=1e-12)
    for column in range(9):
        step = np.zeros(len(NAMES))
        step[column] = 1e-6
        numeric = (project(values + step, rays)[0] - project(values - step, rays)[0]) / 2e-6
        np.testing.assert_allclose(by_values[..., column], numeric, atol=1e-6)


def test_jacobian_of_the_refit_is_the_series_derivative_for_a_weak_lens() -> None:
    lens = torlegard(k3=1e-6)
    steps = [0.0, 0.0, 0.0, 1e-8, 0, 0, 0, 1e-8, 0, 0]
    jacobian = refit_jacobian(
        Distortion("torlegard"), INTERIOR, lens, steps[:10], image_grid(FRAME_MM), RADIAL_TANGENTIAL, started()
    )
    assert jacobian[NAMES.index("k1"), 3] == pytest.approx(C_MM**2, rel=1e-2)
    assert jacobian[NAMES.index("p2"), 6] == 0.0
    assert jacobian[NAMES.index("p1"), 7] == pytest.approx(-C_MM, rel=1e-2)
    assert (jacobian[:, :3] == 0.0).all()
