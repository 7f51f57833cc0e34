"""The coverage of drawn marks against brute force and against areas and centroids known in closed form."""

import numpy as np
import pytest
from drawn import Array, brute_picture, placed

from measure.marks.rendering import CELLS, cell_coverage, picture, render
from measure.marks.shapes import MarkShape, MarkTemplate, cross, dot, polygon, ring_cross, ring_dot

SHEARED = np.array([[8.1, 0.9, 20.3], [-0.4, -8.6, 19.7]])
MARKS = {
    "cross": cross(1.5, 0.15),
    "open diagonal cross": cross(1.5, 0.15, 0.3, 45.0),
    "dot": dot(0.6),
    "small dot": dot(0.15),
    "ring-cross": ring_cross(1.0, 0.15, 1.7, 0.1, 0.2),
    "ring-dot": ring_dot(1.0, 0.15, 0.3),
    "notch": polygon([(-1, -1), (1.2, -0.8), (0.1, 0.2), (0.3, 1.5)]),
}


def coverage(shape: MarkShape, pixel_from_mark: Array, width: int, height: int) -> Array:
    """(height, width) shares of the pixels, the means of their cells."""
    cells = cell_coverage(shape, pixel_from_mark, width, height, CELLS)
    return np.asarray(cells.reshape(height, CELLS, width, CELLS).mean(axis=(1, 3)), float)


@pytest.mark.parametrize("name", MARKS)
def test_coverage_equals_brute_force(name: str) -> None:
    mark = MarkShape(MARKS[name])
    exact, brute = coverage(mark, SHEARED, 41, 41), brute_picture(mark, SHEARED, 41, 41, 0.0)
    assert np.abs(exact - brute).max() < 0.02  # half a line of its points
    assert np.abs(_centroid(exact) - _centroid(brute)).max() < 0.002  # its points are 0.03 px apart
    assert exact.sum() == pytest.approx(brute.sum(), rel=0.01)


@pytest.mark.parametrize("blur_px", [0.4, 0.8, 1.7])
def test_the_blurred_picture_equals_brute_force(blur_px: float) -> None:
    mark = MarkShape(MARKS["ring-cross"])
    brute = brute_picture(mark, SHEARED, 41, 41, blur_px)
    np.testing.assert_allclose(picture(mark, SHEARED, 41, 41, blur_px), brute, atol=0.006)


def test_derivatives_are_those_of_the_picture() -> None:
    mark, blur_px, step = MarkShape(MARKS["ring-cross"]), 1.0, 0.02
    shown = render(mark, SHEARED, 41, 41, blur_px)
    for axis, by_place in enumerate((shown.by_col, shown.by_row)):
        ahead, behind = SHEARED.copy(), SHEARED.copy()
        ahead[axis, 2] += step
        behind[axis, 2] -= step
        change = picture(mark, ahead, 41, 41, blur_px) - picture(mark, behind, 41, 41, blur_px)
        np.testing.assert_allclose(-by_place, change / (2 * step), atol=0.02)
    wider = picture(mark, SHEARED, 41, 41, np.sqrt(blur_px**2 + 0.02))
    sharper = picture(mark, SHEARED, 41, 41, np.sqrt(blur_px**2 - 0.02))
    np.testing.assert_allclose(shown.laplacian / 2, (wider - sharper) / 0.04, atol=0.02)


@pytest.mark.parametrize("name", MARKS)
def test_a_picture_bent_by_a_series_is_that_of_the_mark_drawn_anew(name: str) -> None:
    """By a twentieth of a px at the mark's ends: to 0.2 % of its contrast, nearly all of it the drawing's."""
    mark, center, blur_px = MarkShape(MARKS[name]), np.array([20.3, 19.7]), 0.8
    for generator in ([[1, 0], [0, 1]], [[0, -1], [1, 0]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]):
        change = 0.05 / 15 * np.array(generator)
        bent = render(mark, SHEARED, 41, 41, blur_px).deform(change, center, blur_px**2 + 1 / 12)
        anew = render(mark, np.column_stack([(np.eye(2) + change) @ SHEARED[:, :2], center]), 41, 41, blur_px)
        np.testing.assert_allclose(bent.value, anew.value, atol=0.002)
        np.testing.assert_allclose(bent.by_col, anew.by_col, atol=0.01)
        np.testing.assert_allclose(bent.by_row, anew.by_row, atol=0.01)


def test_a_chip_is_shown_at_its_own_pixels_from_0_to_1() -> None:
    chip = np.random.default_rng(1).normal(100, 10, (21, 25))
    template = MarkTemplate(chip, 50.0, (12.0, 10.0))
    shown = picture(template, placed(20.0, (12.0, 10.0)), 25, 21, 0.001)
    np.testing.assert_allclose(shown, (chip - chip.min()) / np.ptp(chip), atol=1e-5)


def test_a_turned_chip_turns_counter_clockwise() -> None:
    chip = np.zeros((21, 21))
    chip[10, 16] = 1.0  # right of the origin
    shown = picture(MarkTemplate(chip, 50.0, (10.0, 10.0), turn_deg=90.0), placed(20.0, (10.0, 10.0)), 21, 21, 0.001)
    assert divmod(int(shown.argmax()), 21) == (4, 10)  # above it


def _centroid(shown: Array) -> Array:
    row, col = np.mgrid[: shown.shape[0], : shown.shape[1]]
    return np.asarray(np.array([(shown * col).sum(), (shown * row).sum()]) / shown.sum())
