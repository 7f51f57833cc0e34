"""Numbers, ticks, maps, mark pictures, distortion curves and plots of the report."""

import base64
import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from networks import Truth, field_points, simulated
from numpy.typing import NDArray
from projects import Refusal, command, present, write_network_project

from adjust import Parameter, adjust, approximate
from adjust.display import CELLS
from adjust.functional_model.lens import Lens
from adjust.quality.lens_uncertainty import Curves, distortion_curves
from measure.flags import NO_REASON, Status
from pipeline import InputError, build_network, read_comparator, read_project
from pipeline.drawing.svg import round_step, ticks
from pipeline.report import Thumbnail, vectors
from pipeline.report.data import Mark, natural
from pipeline.report.fiducials import Figure, figure_of_films, figure_plot
from pipeline.report.frame_views import SIZE_PX, mark_picture
from pipeline.report.lens import curves_plot, lens, lens_map
from pipeline.report.load import report_data
from pipeline.report.numbers import typed, value_and_sigma
from pipeline.report.parameters import parameter_rows
from pipeline.report.plots import calibrated_cameras, write_plots
from pipeline.results.adjustment_file import ParameterCovariance
from pipeline.results.adjustment_record import (
    CameraRecord,
    DistortionRecord,
    FiducialRecord,
    GivenQuantity,
    PrincipalPointRecord,
    Quantity,
)
from pipeline.results.assessment_record import ResidualRecord

RESIDUAL = ResidualRecord("f1", "7", "target", *[0.0] * 16)


@pytest.mark.parametrize(
    ("value", "sigma", "printed"),
    [
        (153.66401, 0.00412, ("153.6640", "0.0041")),
        (-1.7427e-7, 3.1e-9, ("−1.743 × 10⁻⁷", "0.031 × 10⁻⁷")),
        (1234.5, 37.0, ("1234", "37")),
        (0.0, 2e-6, ("0.0 × 10⁻⁶", "2.0 × 10⁻⁶")),
        (153.6, 0.0, ("153.6", "fixed")),
        (153.6, None, ("153.6", "–")),
        (None, None, ("–", "–")),
    ],
)
def test_digits_follow_the_sigma(value: float | None, sigma: float | None, printed: tuple[str, str]) -> None:
    assert value_and_sigma(value, sigma) == printed


def test_numbers_in_the_terminal_can_be_typed_into_a_calculator() -> None:
    assert list(map(typed, value_and_sigma(-1.7427e-7, 3.1e-9))) == ["-1.743e-7", "0.031e-7"]
    assert typed("1.5 × 10¹²") == "1.5e12"
    assert value_and_sigma(-1e-9, 2e-6, 1e-6)[0] == "0.0 × 10⁻⁶"  # no minus sign before a zero


def test_ticks_are_round_and_names_sort_by_their_numbers() -> None:
    assert ticks(0.0, 1.0, 6) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert ticks(-3.0, 17.0, 5) == pytest.approx([0.0, 5.0, 10.0, 15.0])
    assert [round_step(size) for size in (1.0, 1.99, 2.0, 4.9, 0.051, 70.0)] == pytest.approx([1, 1, 2, 2, 0.05, 50])
    assert sorted(["f10", "f2", "a", "10", "9", "x²"], key=natural) == ["9", "10", "a", "f2", "f10", "x²"]


def mark(center: tuple[float, float], residual: ResidualRecord | None = None) -> Mark:
    return Mark("f1", "7", "target", Status.MEASURED, NO_REASON, np.array(center), None, None, residual)


def spot(center: tuple[float, float], origin: tuple[int, int], size: int) -> NDArray[np.float64]:
    x, y = np.arange(size) + origin[0] - center[0], np.arange(size) + origin[1] - center[1]
    return np.exp(-(x[None, :] ** 2 + y[:, None] ** 2) / 8.0)


def crosshair(picture: str) -> NDArray[np.float64]:
    """The point that the four ticks point at, in page pixels."""
    path = re.search(r'<path d="([^"]+)" class="hair', picture)
    assert path
    ends = np.array(re.findall(r"-?\d+\.?\d*", path[1]), dtype=float).reshape(-1, 2)
    return np.asarray(ends.mean(axis=0))


def take_picture(picture: str) -> NDArray[np.float64]:
    data = re.search(r"base64,([^\"]+)", picture)
    assert data
    image = present(cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED))
    return image.astype(float)


@pytest.mark.parametrize("step", [1, 3])
def test_the_crosshair_stands_on_the_spot_in_the_picture(step: int) -> None:
    """An independent centroid of the stored picture, whose pixel (0, 0) covers the page from 0 to SIZE_PX / width."""
    center, origin, size = (1203.37, 807.81), (1183, 790), 45
    full = spot(center, origin, size)
    pixels = full.reshape(size // step, step, size // step, step).mean(axis=(1, 3))
    middle = (step - 1) / 2.0
    thumbnail = Thumbnail(1000.0 + 50.0 * pixels, (origin[0] + middle, origin[1] + middle), float(step))
    svg = mark_picture(mark(center), thumbnail, 1.0, SIZE_PX)
    stored = take_picture(svg)
    weights = stored - stored.min()
    at = np.array(
        [
            (weights.sum(axis=0) * (np.arange(stored.shape[1]) + 0.5)).sum(),
            (weights.sum(axis=1) * (np.arange(stored.shape[0]) + 0.5)).sum(),
        ]
    )
    expected = at / weights.sum() * SIZE_PX / stored.shape[1]
    np.testing.assert_allclose(crosshair(svg), expected, atol=0.15)


def test_residuals_and_vectors_are_to_scale_and_y_points_up() -> None:
    """The comparator's y points up, the page's down."""
    residual = replace(RESIDUAL, vx_um=3.0, vy_um=4.0)
    thumbnail = Thumbnail(np.eye(41), (0.0, 0.0))
    svg = mark_picture(mark((20.0, 20.0), residual), thumbnail, 2.0, SIZE_PX)
    x0, y0, x1, y1 = np.array(
        re.findall(r"-?\d+\.?\d*", re.findall(r'<path d="([^"]+)" class="arrow"', svg)[0]), dtype=float
    )
    assert (x1 - x0, y1 - y0) == pytest.approx((6.0, -8.0), abs=0.11)
    # A point at (50, 20) mm of a frame of 200 x 100 mm, moved by (10, -5) µm.
    row = replace(RESIDUAL, camera_x_mm=50.0, camera_y_mm=20.0, camera_vx_um=10.0, camera_vy_um=-5.0)
    field = vectors.VectorField.from_residuals([row])
    on = vectors.plane(field.places_mm, (200.0, 100.0), 560.0)
    assert on.height_px < on.width_px
    (x, y), (right, top) = on.page(np.array([(50.0, 20.0), (60.0, 30.0)]))
    assert (right - x, y - top) == pytest.approx((10.0 * on.px_per_mm, 10.0 * on.px_per_mm))
    picture = vectors.all_images_plot(field, on, 4.0)
    stroke = re.search(r'<path d="([^"]+)" class="vector target"', picture)
    assert stroke
    x0, y0, x1, y1 = np.array(re.findall(r"-?\d+\.?\d*", stroke[1]), dtype=float)
    assert (x1 - x0, y1 - y0) == pytest.approx((40.0, 20.0), abs=0.11)
    assert field.scale(60.0) == 5.0
    # Its coordinates begin at the picture's corner, so that a frame about the origin would be half empty.
    places_mm = np.array([(1.0, -20.0), (31.0, -2.0)])
    (left, low), (right, high) = vectors.plane(places_mm, (36.0, 24.0), 560.0).corners_mm
    assert (left, right, low, high) == pytest.approx((1.0, 31.0, -20.0, -2.0), abs=0.7)


FRAME = vectors.Plane(np.array([[-60.0, -30.0], [60.0, 30.0]]), 652.0)  # 5 px per mm


def test_coverage_is_counted_in_the_cell_of_each_observation() -> None:
    places_mm = np.array([[-59.0, -29.0], [-58.0, -21.0], [59.0, 29.0]])
    counts, _, _ = vectors.coverage_counts(FRAME, places_mm)
    assert counts.shape == (CELLS // 2, CELLS)
    assert (counts[0, 0], counts[-1, -1], counts.sum()) == (2.0, 1.0, 3.0)
    drawn = re.findall(r'<rect [^>]*class="covered"[^>]*>', vectors.coverage_plot(FRAME, places_mm))
    assert ['x="26' in drawn[0], 'y="251' in drawn[0], len(drawn)] == [True, True, 2]  # the page's y points down


def test_contours_of_a_field_that_grows_to_the_right_are_upright_lines_at_their_values() -> None:
    x_mm, y_mm = np.linspace(-60.0, 60.0, 25), np.linspace(-30.0, 30.0, 13)
    sigma_um = np.broadcast_to((x_mm + 60.0) / 12.0, (13, 25))  # 0 at the left edge, 10 at the right
    plot = present(vectors.contour_plot(FRAME, x_mm, y_mm, sigma_um, "field"))
    lines = re.findall(r'<path d="([^"]+)" class="contour"', plot)
    places = sorted(round(np.median([float(v) for v in re.findall(r"[\d.]+", line)[::2]]), 1) for line in lines)
    labels = sorted(float(text) for text in re.findall(r'class="contour-label"[^>]*>([\d.]+)<', plot))
    assert labels == [1.0, 2.0, 5.0]  # those of lines at the edge would be cut
    assert [26.0 + 5.0 * 12.0 * value for value in labels] == pytest.approx(places[-3:], abs=0.2)
    assert vectors.contour_plot(FRAME, x_mm, y_mm, np.zeros((13, 25)), "field") is None


Array = NDArray[np.float64]
RADIUS_MM = 150.0


def camera(family: str, c_mm: float = 153.0, **parameters: float) -> CameraRecord:
    return CameraRecord(
        principal_distance_mm=Quantity(c_mm, 0.004),
        principal_point_mm=PrincipalPointRecord(Quantity(0.3, 0.0), Quantity(-0.2, 0.0)),
        distortion=DistortionRecord(family=family, parameters={n: Quantity(v, 1.0) for n, v in parameters.items()}),
        fiducials={},
    )


def covariance(name: str, parameters: tuple[str, ...], matrix: Array) -> ParameterCovariance:
    return ParameterCovariance(
        tuple(Parameter.interior(name, each) for each in parameters), np.zeros(len(parameters)), matrix
    )


WIDE_FRAME = vectors.Plane(np.array([[-75.0, -75.0], [75.0, 75.0]]), 500.0)


def third_degree_lens() -> Lens:
    return lens("A", camera("torlegard", k3=1e-7), covariance("A", ("k3",), np.array([[1e-18]])))


def test_the_map_shows_the_longest_vector_and_what_lies_beyond_the_targets() -> None:
    """k3 r³ with r to the outermost of 15 x 15 squares over a frame of 150 mm: 70 mm in x and y, less x0', y0'."""
    drawn = lens_map(third_degree_lens(), WIDE_FRAME)
    r = np.hypot(70.3, 70.2)
    assert drawn.largest_um == pytest.approx((1e3 * 1e-7 * r**3, 1e3 * 1e-9 * r**3))
    assert drawn.plot.count("M") == 2 * 15**2 + drawn.plot.count('class="bar"')
    # Of 15 x 15 squares of 10 mm about (0.3, -0.2) the middles of 37 lie within 35 mm.
    drawn = lens_map(third_degree_lens(), WIDE_FRAME, 35.0)
    dots = {kind: re.search(f'd="([^"]*)" class="dot {kind}"', drawn.plot) for kind in ("target", "extrapolated")}
    counts = {kind: found[1].count("M") for kind, found in dots.items() if found}
    assert counts == {"target": 37, "extrapolated": 15**2 - 37}
    assert drawn.extrapolated
    assert not lens_map(third_degree_lens(), WIDE_FRAME, 110.0).extrapolated
    curves = distortion_curves(third_degree_lens(), RADIUS_MM)
    assert "no targets here" in curves_plot(curves, 100.0)
    assert "no targets here" not in curves_plot(curves, RADIUS_MM)


def test_what_grows_beyond_the_targets_leaves_the_observed_curve_legible() -> None:
    """Within 40 mm 8 µm and less, at the corner 1000: the axis ends at four times 8.2, the curve where it leaves it."""
    radius, none = np.linspace(1.0, 100.0, 100), np.zeros(100)
    value = np.where(radius <= 40.0, 0.2 * radius, 8.0 * np.exp((radius - 40.0) / 12.4))
    drawn = curves_plot(Curves(radius, value, 0.01 * value, none, none), 40.0)
    ticks = re.findall(r'<text x="55.00"[^>]*>([^<]*)<', drawn)
    assert ticks == ["0", "5", "10", "15", "20", "25", "30"]
    path = re.findall(r'd="M([^"]*)" class="curve first"', drawn)[0]
    assert path.count("L") == 57  # 58 radii up to 58 mm, where 8 exp(1.45) = 34


def test_parameters_say_what_is_significant_carried_by_a_prior_or_correlated() -> None:
    lens_terms = {"k1": Quantity(5e-8, 1e-9, p=1e-30), "p1": Quantity(1e-7, 1e-7, p=0.32)}
    entry = replace(
        camera("brown"),
        distortion=DistortionRecord(family="brown", parameters=lens_terms),
        principal_distance_mm=Quantity(153.0, 0.5, GivenQuantity(152.5, 1.0)),
        principal_point_mm=PrincipalPointRecord(Quantity(0.3, 0.99, GivenQuantity(0.0, 1.0)), Quantity(-0.2, 0.0)),
    )
    rows = {row.symbol: row for row in parameter_rows("A", entry, 1.0, 100.0)}
    assert rows["k1"].meaning == "significant (50.0 σ, p < 0.001)"
    assert rows["k1"].unit == "mm⁻²"
    assert rows["k1"].effect == "50.0 ± 1.0"
    assert rows["p1"].meaning == "not significant (1.0 σ, p = 0.320)"
    assert rows["c"].meaning == "moved by +500 µm; the given value's share is 25 %"
    assert "hardly from the observations" in rows["x₀′"].meaning
    assert rows["y₀′"].meaning == "held at the given value"
    assert "k2" not in rows, "a parameter that is fixed at 0 is no part of the model"


GIVEN = np.array([(100.0, 100.0), (-100.0, 100.0), (-100.0, -100.0), (100.0, -100.0), (0.0, 110.0)])


def fiducials(estimated: Array) -> dict[str, FiducialRecord]:
    return {
        f"{i}": FiducialRecord(
            Quantity(new[0], 0.002, GivenQuantity(old[0], 1.0)),
            Quantity(new[1], 0.002, GivenQuantity(old[1], 1.0)),
            0.0,
        )
        for i, (new, old) in enumerate(zip(estimated.tolist(), GIVEN.tolist(), strict=True))
    }


def changed(estimated: Array, matrix: Array) -> Figure:
    places = tuple(Parameter.fiducial("A", str(i), axis) for i in range(len(GIVEN)) for axis in "xy")
    return present(
        figure_of_films("A", fiducials(estimated), ParameterCovariance(places, estimated.ravel(), matrix), {})
    )


def test_a_similarity_changes_no_form_and_a_displaced_mark_does() -> None:
    angle = 0.02
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    form = changed(1.0002 * GIVEN @ turn.T + (0.3, -0.4), np.eye(10))
    np.testing.assert_allclose(form.change_um, 0.0, atol=1e-9)
    estimated = GIVEN.copy()
    estimated[3] += (0.05, 0.0)
    form = changed(estimated, 4e-6 * np.eye(10))
    assert int(np.hypot(*form.change_um.T).argmax()) == 3
    assert "enlarged" in figure_plot(form)
    two = dict(list(fiducials(GIVEN).items())[:2])
    assert figure_of_films("A", two, ParameterCovariance((), np.empty(0), np.empty((0, 0))), {}) is None


@pytest.fixture(scope="module")
def adjusted_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of a simulated camera, adjusted."""
    rng, truth = np.random.default_rng(4), Truth()
    network, _ = simulated(rng, truth, points=field_points(rng, 20), free=dict.fromkeys(truth.distortion, np.inf))
    project = write_network_project(network, tmp_path_factory.mktemp("simulated"))
    assert command("adjust", project) in (0, 1)
    return project


def test_they_show_what_the_adjustment_shows(adjusted_folder: Path) -> None:
    project = read_project(adjusted_folder)
    ((plots, record),) = calibrated_cameras(report_data(project, lambda path: path))
    network, _ = build_network(project, read_comparator(project.comparator))
    of_result = adjust(network, approximate(network)).plots()
    order = [np.lexsort(each.places_mm.T) for each in (plots, of_result)]
    np.testing.assert_allclose(plots.places_mm[order[0]], of_result.places_mm[order[1]], atol=1e-4)
    np.testing.assert_allclose(plots.vectors_mm[order[0]], of_result.vectors_mm[order[1]], atol=2e-5)
    assert np.count_nonzero(plots.is_fiducial) == np.count_nonzero(of_result.is_fiducial) == 20
    np.testing.assert_allclose(plots.lens.covariance, of_result.lens.covariance, rtol=1e-3, atol=1e-18)
    near = next(each.distance for each in record.projection if np.isfinite(each.distance))
    for distance in (np.inf, near):
        (there_mm, stored_mm), (places_mm, sigma_mm) = plots.uncertainty(distance), of_result.uncertainty(distance)
        np.testing.assert_allclose(np.sort(stored_mm, axis=None), np.sort(sigma_mm, axis=None), rtol=2e-3)
        assert there_mm.shape == places_mm.shape


def test_plots_replace_plots_alone(adjusted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.report.plots._draw", lambda *_: iter(["residuals"]))
    data = report_data(read_project(adjusted_folder), lambda path: path)
    for _ in range(2):
        files = write_plots(data, tmp_path)
    for path in (next(file for file in files if file.suffix == ending) for ending in (".png", ".pdf")):
        path.write_text("mine")
        with pytest.raises(InputError, match="was not written by reseau"):
            write_plots(data, tmp_path)
        path.unlink()


def test_no_plots(adjusted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Refusal) -> None:
    for name in ("camera.toml", "points.csv", "comparator.csv", "project.toml"):
        (tmp_path / name).write_bytes((adjusted_folder.parent / name).read_bytes())
    assert "no calibrated camera to plot." in refusal("report", tmp_path / "project.toml", "--plots", tmp_path / "p")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert "--plots needs Matplotlib" in refusal("report", adjusted_folder, "--plots", tmp_path / "plots")
    assert not (tmp_path / "plots").exists()
