"""Lenses brought to OpenCV's models, against independent figures and OpenCV itself."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.lens_conversion import convert_lens
from pipeline.opencv_check.opencv_calibration import (
    FISHEYE,
    NAMES,
    Freedom,
    camera_matrix,
    fixed,
    model_names,
    opencv_values,
    to_opencv_model,
)

Array = NDArray[np.float64]

FRAME_MM = np.array([[-10.0, -7.5], [10.0, 7.5]])
C_MM = 24.0
INTERIOR = np.array([C_MM, 0.05, -0.03])
MODERATE = {"k3": 1.2e-4, "k5": -2e-7, "p1": 3e-6, "p2": -2e-6}  # 170 um at the corner
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3")
VALUES = {
    "opencv": {"k1": -0.26, "k2": 0.13, "p1": -2e-4, "p2": 4e-5, "k3": 0.01, "b1": 6e-4},
    FISHEYE: {"k1": 0.03, "k2": -0.01, "b1": 4e-4, "b2": -3e-4},
}
RAYS = np.array([[0.3, 0.2], [-0.1, 0.25], [0.0, -0.4]])


def make_lens(family: str, **values: float) -> Array:
    return np.array([values.get(name, 0.0) for name in parameter_names(family)])


def convert_torlegard(
    values: dict[str, float], interior: Array = INTERIOR, r0_mm: float = 0.0
) -> tuple[dict[str, float], float]:
    """OpenCV's values, and what is left, rms in mm."""
    lens = Lens(Distortion("torlegard", r0_mm=r0_mm), interior, make_lens("torlegard", **values))
    found = to_opencv_model(lens, FRAME_MM, RADIAL_TANGENTIAL)
    return dict(zip(NAMES, opencv_values(found.lens)[0].tolist(), strict=True)), found.rms_mm


@pytest.mark.parametrize(("strength", "at_most_um"), [(1.0, 0.06), (4.0, 0.4)])
def test_what_is_left_is_what_an_independent_calculation_found(strength: float, at_most_um: float) -> None:
    """0.06 um at the corner for 170 um of distortion, 0.4 um for 670 um."""
    _, rms_mm = convert_torlegard({name: strength * value for name, value in MODERATE.items()})
    assert 1e3 * rms_mm < at_most_um


def test_series_holds_for_a_weak_lens() -> None:
    """k1 = k3 c², k2 = (3 k3² + k5) c⁴, p1cv = -p2 c, p2cv = p1 c: exact in the limit of a weak lens."""
    k3, k5, p1, p2 = 1e-6, -2e-10, 3e-7, -2e-7
    values, _ = convert_torlegard({"k3": k3, "k5": k5, "p1": p1, "p2": p2})
    assert values["fx"] == pytest.approx(C_MM, rel=1e-7)
    assert values["k1"] == pytest.approx(k3 * C_MM**2, rel=1e-2)
    assert values["k2"] == pytest.approx((3 * k3**2 + k5) * C_MM**4, rel=5e-2)
    assert values["p1"] == pytest.approx(-p2 * C_MM, rel=1e-2)
    assert values["p2"] == pytest.approx(p1 * C_MM, rel=1e-2)


def test_r0_is_no_parameter_of_its_own() -> None:
    """r0 is r0 = 0 with c, k and p divided by 1 + k3 r0² + k5 r0⁴ (+ k7 r0⁶)."""
    r0 = 8.0
    with_r0, _ = convert_torlegard(MODERATE, r0_mm=r0)
    ratio = 1 + MODERATE["k3"] * r0**2 + MODERATE["k5"] * r0**4
    scaled = {name: value / ratio for name, value in MODERATE.items()}
    without, _ = convert_torlegard(scaled, np.array([C_MM / ratio, *INTERIOR[1:]]))
    assert list(with_r0.values()) == pytest.approx(list(without.values()), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("family", list(VALUES))
def test_opencvs_own_families_keep_their_values_and_project_as_opencv_does(family: str) -> None:
    lens = Lens(Distortion(family), INTERIOR, make_lens(family, **VALUES[family]))
    found = to_opencv_model(lens, FRAME_MM, ())
    values, _ = opencv_values(found.lens)
    assert found.is_same
    named = dict(zip(model_names(family), values, strict=True))
    b1 = VALUES[family]["b1"]
    of_interior = {"fx": C_MM * (1.0 + b1), "fy": C_MM, "cx": 0.05, "cy": -0.03}
    own = {name: value for name, value in VALUES[family].items() if name not in ("b1", "b2")}
    for name, value in {**of_interior, **own}.items():
        assert named[name] == pytest.approx(value, rel=1e-12)
    points, matrix = np.column_stack([RAYS * (1.0, -1.0), np.ones(len(RAYS))]), camera_matrix(values)
    if family == FISHEYE:
        projected, _ = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), matrix, values[4:8], alpha=named["alpha"]
        )
    else:
        projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, values[4:])
    ours, _ = lens.camera_from_ray(RAYS)
    np.testing.assert_allclose(ours, np.reshape(projected, (-1, 2)) * (1.0, -1.0), atol=1e-12)


@pytest.mark.parametrize("family", list(VALUES))
def test_derivatives_of_opencvs_values(family: str) -> None:
    start = np.concatenate([INTERIOR, make_lens(family, **VALUES[family])])

    def values(at: Array) -> Array:
        return opencv_values(Lens(Distortion(family), at[:3], at[3:]))[0]

    _, by_lens = opencv_values(Lens(Distortion(family), start[:3], start[3:]))
    for k, step in enumerate(1e-6 * np.eye(len(start))):
        numeric = (values(start + step) - values(start - step)) / 2e-6
        np.testing.assert_allclose(by_lens[:, k], numeric, atol=1e-7)


def test_what_is_held_stays_and_its_share_is_not_taken_by_others() -> None:
    """By k3 alone, c and the principal point held: OpenCV's k1 changes as the series says, and nothing else does."""
    freedom = Freedom(("k1",))
    lens = Lens(Distortion("torlegard"), INTERIOR, make_lens("torlegard", k3=1e-6))
    whole = to_opencv_model(lens, FRAME_MM, RADIAL_TANGENTIAL)
    held = fixed("opencv", dict(zip(parameter_names("opencv"), whole.lens.parameters.tolist(), strict=True)))
    found = convert_lens(lens, held, FRAME_MM, freedom.distortion, held=freedom.held_interior)
    np.testing.assert_allclose(found.lens.parameters[1:], whole.lens.parameters[1:], atol=1e-15)
    assert (found.lens.interior == INTERIOR).all()
    changed = found.by_source[:, 3]
    assert changed[3] == pytest.approx(C_MM**2, rel=1e-2)
    assert np.flatnonzero(changed).tolist() == [3]


def test_one_focal_length_keeps_the_ratio() -> None:
    assert Freedom(("fx", "cx", "cy")).distortion == ()
    assert Freedom(("fx", "fy", "cx", "cy", "alpha")).distortion == ("b1", "b2")
    assert Freedom(("fx", "fy")).held_interior == ("x0", "y0")
