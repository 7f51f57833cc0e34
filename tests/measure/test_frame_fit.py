"""The frame through its marks, and the pose: against closed forms and by simulation."""

import numpy as np
import pytest
from brute_marks import Array

from measure.fiducials.consistency import FrameMarks, Scatter, gross_errors
from measure.fiducials.constellation import Placement
from measure.fiducials.interior_orientation import fit_frame
from measure.fiducials.options import AFFINITY_SIGMA
from measure.geometry import POSES, up_from_camera

SQUARE = np.array([(100.0, -100.0), (-100.0, -100.0), (-100.0, 100.0), (100.0, 100.0)])
EIGHT = np.array([*SQUARE, (100.0, 0.0), (-100.0, 0.0), (0.0, 100.0), (0.0, -100.0)])


def view_marks(camera: Array, turn: Array, scale: float = 1.01, angle: float = 0.02) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(camera @ (scale * np.array([[c, -s], [s, c]]) @ turn).T + (12.0, -34.0))


@pytest.mark.parametrize("pose", POSES)
def test_a_similarity_is_found_without_residuals_in_every_pose(pose: str) -> None:
    turn = up_from_camera(pose)
    fit = fit_frame(EIGHT, view_marks(EIGHT, turn), np.full(8, 0.005), turn)
    np.testing.assert_allclose(fit.residuals_mm, 0.0, atol=1e-9)
    assert fit.chi_square == pytest.approx(0.0, abs=1e-9)
    assert fit.redundancy == 12
    assert np.sign(np.linalg.det(fit.up_from_camera[:, :2])) == (-1 if pose.endswith("m") else 1)


def test_a_pose_mirrors_first_and_then_turns() -> None:
    np.testing.assert_allclose(up_from_camera("90m") @ (1.0, 0.0), (0.0, -1.0))
    np.testing.assert_allclose(up_from_camera("90m") @ (0.0, 1.0), (-1.0, 0.0))
    np.testing.assert_allclose(up_from_camera("90") @ (1.0, 0.0), (0.0, 1.0))


def test_halving_a_marks_sigma_changes_its_share_of_the_residual() -> None:
    """Trap: a weight matrix that is the covariance instead of its inverse."""
    turn, disturbed = up_from_camera("0"), view_marks(EIGHT, up_from_camera("0"))
    disturbed[0] += (0.05, 0.0)
    sizes = []
    for sigma in (0.02, 0.01, 0.005):
        sigmas = np.full(8, 0.01)
        sigmas[0] = sigma
        sizes.append(np.hypot(*fit_frame(EIGHT, disturbed, sigmas, turn).residuals_mm[0]))
    assert sizes[0] > 1.1 * sizes[1] > 1.2 * sizes[2]


def test_chi_square_is_that_of_its_redundancy() -> None:
    rng, turn = np.random.default_rng(2), up_from_camera("0")
    values = [
        fit_frame(EIGHT, view_marks(EIGHT, turn) + rng.normal(0, 0.004, (8, 2)), np.full(8, 0.004), turn)
        for _ in range(300)
    ]
    # Two of the twelve are the affinity's pseudo-observations, here exactly at their expectation.
    assert np.mean([fit.chi_square for fit in values]) == pytest.approx(10.3, abs=1.2)


def test_one_mark_does_not_determine_a_frame() -> None:
    with pytest.raises(ValueError, match="two or more"):
        fit_frame(EIGHT[:1], EIGHT[:1], np.ones(1), np.eye(2))


def outlying(camera: Array, up: Array) -> list[int]:
    marks = FrameMarks.from_places(camera, up, np.tile(1e-6 * np.eye(2), (len(camera), 1, 1)))
    return np.flatnonzero(gross_errors(marks, Scatter(0.005, 4.0), 0.3)).tolist()


def test_gross_errors_are_found_and_no_others() -> None:
    rng, turn = np.random.default_rng(4), up_from_camera("180")
    up = view_marks(EIGHT, turn) + rng.normal(0, 0.005, (8, 2))
    assert outlying(EIGHT, up) == []
    up[2] += (0.9, -0.4)
    up[5] += (0.0, 0.6)
    assert outlying(EIGHT, up) == [2, 5]


def test_of_four_marks_on_one_frame_none_is_called_wrong_where_film_may_be_bent() -> None:
    """A mark 1 mm off, or film bent by 0.15 mm: either moves all four alike beside an affine transformation."""
    four = view_marks(SQUARE, up_from_camera("0"))
    assert outlying(SQUARE, four + 0.15 * np.outer((1.0, -1.0, 1.0, -1.0), (0.6, 0.8))) == []
    four[1] += (1.0, 0.0)
    assert outlying(SQUARE, four) == []


def test_with_many_marks_their_own_scatter_is_the_gate() -> None:
    grid = np.array([(10.0 * i, 10.0 * j) for i in range(-2, 3) for j in range(-2, 3)])
    rng, turn = np.random.default_rng(6), up_from_camera("0")
    up = view_marks(grid, turn) + rng.normal(0, 0.005, grid.shape)
    up[7] += (0.1, 0.0)  # well inside of the gate, far outside of the others' scatter
    assert outlying(grid, up) == [7]


def test_two_gross_errors_do_not_hide_each_other() -> None:
    grid = np.array([(10.0 * i, 10.0 * j) for i in range(-2, 3) for j in range(-2, 2)])
    rng, turn = np.random.default_rng(7), up_from_camera("0")
    up = view_marks(grid, turn) + rng.normal(0, 0.005, grid.shape)
    up[3] += (0.28, 0.0)
    up[16] += (-0.25, 0.05)
    assert outlying(grid, up) == [3, 16]


@pytest.mark.parametrize("pose", POSES)
def test_a_perspective_is_fitted_without_residuals(pose: str) -> None:
    """By the closed form of a pinhole 600 mm away, tilted by 5 degrees, in every scan orientation."""
    turn, tilt = up_from_camera(pose), np.deg2rad(5.0)
    x, y = EIGHT.T
    pictured = np.column_stack([x * np.cos(tilt), y]) / (1 + x * np.sin(tilt) / 600.0)[:, None]
    up = view_marks(pictured, turn)
    fit = fit_frame(EIGHT, up, np.full(8, 0.005), turn, "projective")
    assert np.abs(fit.residuals_mm).max() < 0.002  # what is believed of tilts beforehand takes the rest
    assert fit.film is not None
    step = 1e-3
    around = np.array([(50.0 + step, 30.0), (50.0 - step, 30.0)])
    x, y = around.T
    moved = view_marks(np.column_stack([x * np.cos(tilt), y]) / (1 + x * np.sin(tilt) / 600.0)[:, None], turn)
    np.testing.assert_allclose(fit.film.places_mm(around), moved, atol=5e-4)
    placement = Placement(pose, np.eye(2, 3), 1.0, 8, 1, 1, (0.05, 0.05), film=fit.film)
    linear = np.diag([0.05, -0.05]) @ placement.linear(np.array([50.0, 30.0]))
    np.testing.assert_allclose(linear[:, 0], (moved[0] - moved[1]) / (2 * step), atol=1e-4)
    marks = FrameMarks.from_places(EIGHT, up, np.tile(1e-6 * np.eye(2), (8, 1, 1)), "projective")
    assert not gross_errors(marks, Scatter(0.005, 4.0), 0.3).any()
    assert np.sqrt(marks.film_variance_mm2()) < 1e-4


@pytest.mark.parametrize("stretch", [0.0008, 0.003])
def test_the_affinity_is_estimated_with_the_standard_deviation_that_film_has(stretch: float) -> None:
    """Bayes for one number: marks that tell the stretch to s give it the share S² / (S² + s²), S being the film's. On
    the square x² sums to y², so that stretch and scale are not correlated, and its s is sigma / sqrt(sum r²)."""
    camera, sigma = 0.01 * SQUARE, 0.006  # as small as leaves the affinity open
    up = camera * (1 + stretch, 1 - stretch)
    fit = fit_frame(camera, up, np.full(4, sigma), np.eye(2))
    result = sigma / np.sqrt((camera**2).sum())
    expected = stretch * AFFINITY_SIGMA**2 / (AFFINITY_SIGMA**2 + result**2)
    found = (fit.up_from_camera[0, 0] - fit.up_from_camera[1, 1]) / 2
    assert 0.2 * stretch < expected < 0.95 * stretch  # or nothing would be tested
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("camera", [SQUARE[[0, 2]], SQUARE[:3], EIGHT])
def test_the_frame_says_how_well_it_knows_rotation_scale_stretch_and_shear(camera: Array) -> None:
    """Two marks tell them one way only: across it stretch stays as uncertain as film and scanner make it."""
    rng, turn, sigma = np.random.default_rng(6), up_from_camera("90m"), np.full(len(camera), 0.02)
    off, claimed = [], []
    for _ in range(200):
        stretch, shear = rng.normal(0.0, AFFINITY_SIGMA, 2)
        true = np.array([[1.01 + stretch, shear], [shear, 1.01 - stretch]]) @ turn
        fit = fit_frame(camera, camera @ true.T + rng.normal(0.0, sigma[0], camera.shape), sigma, turn)
        change = fit.up_from_camera[:, :2] @ np.linalg.inv(true) - np.eye(2)
        off.append(np.sum(change**2) / 2)  # of the four parameters, each of which has two ones
        claimed.append(fit.linear_sigma**2)
    assert np.sqrt(np.mean(off) / 4 / np.mean(claimed)) == pytest.approx(1.0, abs=0.1)
