"""Plots of a camera and tables: what they show, in which unit, and what is said where their packages are missing."""

import sys
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import matplotlib.figure
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.quiver import Quiver
from networks import HALF_MM, Truth, board_network, field_points, simulated

from adjust import Adjustment, AdjustmentError, Parameter, adjust
from adjust.display import contour_levels, distance_text

PIXEL_MM = 0.005


@pytest.fixture(scope="module")
def board() -> Adjustment:
    mpl.use("Agg")
    return adjust(board_network(np.random.default_rng(3), 6, 5e-4))


@pytest.fixture(scope="module")
def film() -> Adjustment:
    mpl.use("Agg")
    rng, truth = np.random.default_rng(2), Truth()
    network, start = simulated(rng, truth, points=field_points(rng, 40), free=dict.fromkeys(truth.distortion, np.inf))
    return adjust(replace(network, cameras=(replace(network.cameras[0], frame_mm=(2 * HALF_MM, 2 * HALF_MM)),)), start)


def vectors(axes: Axes) -> list[Any]:
    return [each for each in axes.collections if isinstance(each, Quiver)]


def test_residuals_are_vectors_along_the_axes_of_the_picture(board: Adjustment) -> None:
    axes = board.plots(pixel_mm=PIXEL_MM).plot_residuals()
    (quiver,) = vectors(axes)
    v_px = board.residuals.v_mm / PIXEL_MM * [1.0, -1.0]
    np.testing.assert_allclose(np.column_stack([quiver.U, quiver.V]), v_px)
    np.testing.assert_allclose(quiver.XY, board.network.observations.xy_mm / PIXEL_MM * [1.0, -1.0])
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # rows count downwards
    assert "px a point" in axes.get_title(loc="left")


def test_of_film_both_kinds_of_marks_are_shown_in_the_camera_frame(film: Adjustment) -> None:
    axes = film.plot_residuals()
    kinds = vectors(axes)
    assert [len(each.U) for each in kinds] == [160, 20]
    assert np.abs(kinds[1].XY).max() == pytest.approx(113.0, abs=2.0)
    assert "µm a point" in axes.get_title(loc="left")
    assert axes.get_xlabel() == "x' (mm)"


def test_the_distortion_is_the_polynomial_of_the_parameters(film: Adjustment) -> None:
    axes = film.plot_distortion()
    radius, um = np.array(axes.lines[0].get_data())
    k3, k5 = (film.value(Parameter.interior("K", name)) for name in ("k3", "k5"))
    np.testing.assert_allclose(um, 1e3 * (k3 * radius**3 + k5 * radius**5), atol=0.05)
    assert axes.get_legend_handles_labels()[1][-1] == "no targets"


def test_the_map_of_uncertainty_is_in_pixels_for_a_digital_camera(board: Adjustment) -> None:
    axes = board.plots(pixel_mm=PIXEL_MM).plot_uncertainty(350.0)
    assert axes.get_title(loc="left") == "desk: projected points at a distance of 350"
    sigma_px = board.projection_uncertainty(distance=350.0).sigma_mm / PIXEL_MM
    assert axes.collections[0].get_clim()[0] >= sigma_px.min()
    assert axes.collections[0].get_clim()[1] <= sigma_px.max()


def test_coverage_counts_targets_alone(film: Adjustment) -> None:
    axes = film.plot_coverage()
    assert axes.get_title(loc="left").startswith("K: 160 targets in 4 images")
    assert np.ma.sum(np.ma.asarray(axes.collections[0].get_array())) == 160


def test_plots_go_into_axes_that_are_given(board: Adjustment) -> None:
    axes = mpl.figure.Figure().subplots()
    assert board.plot_coverage(axes=axes) is axes


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        ([0.012, 3.0], [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0]),
        ([0.06, 0.4], [0.07, 0.1, 0.15, 0.2, 0.3]),
        ([1.02, 1.49], [1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.35, 1.4, 1.45]),
    ],
)
def test_contours_have_round_levels(values: list[float], levels: list[float]) -> None:
    assert contour_levels(np.array([*values, np.nan])) == levels


def test_a_camera_of_which_nothing_was_estimated_has_no_contours_and_a_distance_no_exponent() -> None:
    with pytest.raises(AdjustmentError, match="nothing was estimated"):
        contour_levels(np.zeros((3, 3)))
    assert [distance_text(each) for each in (1500.0, 0.3456789, 12345.6)] == ["1500", "0.3457", "12350"]


@pytest.mark.parametrize(
    ("missing", "method", "words"),
    [
        *(
            ("matplotlib.pyplot", f"plot_{kind}", r'"reseau\[plots\]"\.')
            for kind in ("residuals", "distortion", "uncertainty", "coverage")
        ),
        ("pandas", "to_pandas", "pandas"),
    ],
)
def test_without_a_package_one_message_says_what_to_install(
    board: Adjustment, missing: str, method: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=f"Install: pip install {words}"):
        getattr(board, method)()


def test_tables_have_every_quantity_and_every_observation(board: Adjustment) -> None:
    pytest.importorskip("pandas", reason="pandas is missing: make test installs it")
    parameters = board.to_pandas()
    row = parameters[(parameters.kind == "interior") & (parameters.quantity == "c")].iloc[0]
    assert row.value == board.value("IO.desk.c")
    assert row.sigma == pytest.approx(board.sigma("IO.desk.c"))
    residuals = board.to_pandas("residuals")
    assert len(residuals) == len(board.network.observations)
    np.testing.assert_allclose(residuals[["vx_um", "vy_um"]], 1e3 * board.residuals.v_mm)
