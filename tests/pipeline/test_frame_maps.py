"""Maps over a camera's frame: cells and contours lie where the observations and the field put them."""

import re

import numpy as np
import pytest

from pipeline.report.vectors import CELLS, Plane, contour_plot, coverage_counts, coverage_plot

FRAME = Plane(np.array([[-60.0, -30.0], [60.0, 30.0]]), 652.0)  # 5 px per mm


def test_coverage_is_counted_in_the_cell_that_an_observation_lies_in() -> None:
    places_mm = np.array([[-59.0, -29.0], [-58.0, -21.0], [59.0, 29.0]])
    counts, _, _ = coverage_counts(FRAME, places_mm)
    assert counts.shape == (CELLS // 2, CELLS)
    assert (counts[0, 0], counts[-1, -1], counts.sum()) == (2.0, 1.0, 3.0)
    drawn = [
        {name: float(value) for name, value in re.findall(r'([\w-]+)="([\d.]+)"', tag)}
        for tag in re.findall(r'<rect [^>]*class="covered"[^>]*>', coverage_plot(FRAME, places_mm))
    ]
    lower_left, upper_right = sorted(drawn, key=lambda cell: cell["x"])
    assert (lower_left["x"], lower_left["y"]) == (26.0, 276.0)  # the page's y points down
    assert (upper_right["x"], upper_right["y"]) == (576.0, 26.0)
    assert {cell["width"] for cell in drawn} == {50.0}
    assert lower_left["fill-opacity"] == pytest.approx(0.9)
    assert upper_right["fill-opacity"] == pytest.approx(0.15 + 0.75 / np.sqrt(2.0), abs=1e-3)


def test_contours_of_a_field_that_grows_to_the_right_are_upright_lines_at_their_values() -> None:
    x_mm, y_mm = np.linspace(-60.0, 60.0, 25), np.linspace(-30.0, 30.0, 13)
    sigma_um = np.broadcast_to((x_mm + 60.0) / 12.0, (13, 25))  # 0 at the left edge, 10 at the right
    plot = contour_plot(FRAME, x_mm, y_mm, sigma_um, "field")
    assert plot is not None
    lines = re.findall(r'<path d="([^"]+)" class="contour"', plot)
    places = sorted(round(np.median([float(v) for v in re.findall(r"[\d.]+", line)[::2]]), 1) for line in lines)
    labels = sorted(float(text) for text in re.findall(r'class="contour-label"[^>]*>([\d.]+)<', plot))
    assert labels[-3:] == [1.0, 2.0, 5.0]
    assert [26.0 + 5.0 * 12.0 * value for value in labels] == pytest.approx(places, abs=0.2)


def test_a_field_without_uncertainty_has_no_contours() -> None:
    grid = np.linspace(-30.0, 30.0, 5)
    assert contour_plot(FRAME, grid, grid, np.zeros((5, 5)), "field") is None
