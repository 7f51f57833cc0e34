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
from projects import write_network_project

from adjust import Parameter, adjust, approximate
from adjust.functional_model.lens import Lens
from adjust.quality.image_clusters import larger_covariance
from adjust.quality.lens_reach import distortion_curves
from measure.flags import NO_REASON, Status
from pipeline import build_network, read_comparator, read_project
from pipeline.cli import run
from pipeline.drawing.svg import Axes, round_step, ticks
from pipeline.report import Thumbnail
from pipeline.report.data import Frame, Mark, natural
from pipeline.report.fiducials import Figure, figure_of_films, figure_plot
from pipeline.report.frame_views import SIZE_PX, arrow_scale, mark_picture
from pipeline.report.lens import curves_plot, largest_effects_um, lens, lens_map
from pipeline.report.load import report_data
from pipeline.report.numbers import fixed, significant, value_and_sigma
from pipeline.report.parameters import high_correlations, parameter_rows
from pipeline.report.plots import calibrated_cameras
from pipeline.report.vectors import (
    CELLS,
    Plane,
    VectorField,
    all_images_plot,
    contour_plot,
    coverage_counts,
    coverage_plot,
    plane,
)
from pipeline.results.adjustment_record import (
    CameraRecord,
    DistortionRecord,
    FiducialRecord,
    GivenQuantity,
    PrincipalPointRecord,
    Quantity,
)
from pipeline.results.assessment_record import ResidualRecord
from pipeline.results.covariance_file import Covariance

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
def test_a_value_is_printed_to_what_its_sigma_supports(
    value: float | None, sigma: float | None, printed: tuple[str, str]
) -> None:
    assert value_and_sigma(value, sigma) == printed


def test_plain_numbers() -> None:
    assert fixed(-0.5, 1) == "−0.5"
    assert fixed(0.5, 1, sign=True) == "+0.5"
    assert fixed(-0.04, 1, sign=True) == "+0.0"
    assert fixed(float("nan")) == "–"
    assert significant(4.1e6, 3) == "4100000"
    assert significant(2.5e-9, 2) == "2.5 × 10⁻⁹"


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0.0, 1.0, 6) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert ticks(-3.0, 17.0, 5) == pytest.approx([0.0, 5.0, 10.0, 15.0])
    assert [round_step(size) for size in (1.0, 1.99, 2.0, 4.9, 0.051, 70.0)] == pytest.approx([1, 1, 2, 2, 0.05, 50])


def test_a_logarithmic_axis_has_its_powers_at_equal_distances() -> None:
    axes = Axes((1.0, 100.0), (0.1, 10.0), width=400.0, left=0.0, right=0.0, x_is_log=True, y_is_log=True)
    assert axes.x([1.0, 10.0, 100.0]) == pytest.approx([0.0, 200.0, 400.0])
    drawn = axes.grid("x", "y")
    assert all(f">{tick}</text>" in drawn for tick in ("0.1", "0.2", "0.5", "1", "2", "5", "10"))
    assert ">3</text>" not in drawn


def test_names_sort_by_their_numbers() -> None:
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
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
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


def test_a_large_picture_is_stored_small_and_a_flat_one_is_no_error() -> None:
    svg = mark_picture(mark((50.0, 50.0)), Thumbnail(np.full((300, 200), 7, np.uint16), (0.0, 0.0)), 1.0, 92.0)
    assert take_picture(svg).shape == (92, 61)


def test_the_residual_points_up_where_y_grows() -> None:
    """The comparator's y points up, the page's down."""
    residual = replace(RESIDUAL, vx_um=3.0, vy_um=4.0)
    thumbnail = Thumbnail(np.eye(41), (0.0, 0.0))
    svg = mark_picture(mark((20.0, 20.0), residual), thumbnail, 2.0, SIZE_PX)
    x0, y0, x1, y1 = np.array(
        re.findall(r"-?\d+\.?\d*", re.findall(r'<path d="([^"]+)" class="arrow"', svg)[0]), dtype=float
    )
    assert (x1 - x0, y1 - y0) == pytest.approx((6.0, -8.0), abs=0.11)


def test_the_longest_arrow_fits() -> None:
    rows = [replace(RESIDUAL, vx_um=v) for v in (1.0, -13.0)]
    scale = arrow_scale([Frame("a", tuple(mark((0.0, 0.0), row) for row in rows))])
    assert 13.0 <= 13.0 * scale <= 34.0
    assert arrow_scale([Frame("a", (mark((0.0, 0.0)),))]) == 1.0


def test_vectors_over_the_camera_are_to_scale() -> None:
    """A point at (50, 20) mm of a frame of 200 x 100 mm, moved by (10, -5) µm."""
    row = replace(RESIDUAL, camera_x_mm=50.0, camera_y_mm=20.0, camera_vx_um=10.0, camera_vy_um=-5.0)
    field = VectorField.from_residuals([row])
    on = plane(field.places_mm, (200.0, 100.0), 560.0)
    assert on.height_px < on.width_px
    (x, y), (right, top) = on.page(np.array([(50.0, 20.0), (60.0, 30.0)]))
    assert (right - x, y - top) == pytest.approx((10.0 * on.px_per_mm, 10.0 * on.px_per_mm))
    picture = all_images_plot(field, on, 4.0)
    stroke = re.search(r'<path d="([^"]+)" class="vector target"', picture)
    assert stroke
    x0, y0, x1, y1 = np.array(re.findall(r"-?\d+\.?\d*", stroke[1]), dtype=float)
    assert (x1 - x0, y1 - y0) == pytest.approx((40.0, 20.0), abs=0.11)
    assert field.scale(60.0) == 5.0


def test_the_vectors_of_a_digital_camera_stand_in_what_was_observed() -> None:
    """Its coordinates begin at the picture's corner, so that a frame about the origin would be half empty."""
    places_mm = np.array([(1.0, -20.0), (31.0, -2.0)])
    (left, low), (right, high) = plane(places_mm, (36.0, 24.0), 560.0).corners_mm
    assert (left, right, low, high) == pytest.approx((1.0, 31.0, -20.0, -2.0), abs=0.7)


def test_a_thumbnail_refuses_what_is_no_picture() -> None:
    with pytest.raises(ValueError, match="rows and columns"):
        Thumbnail(np.zeros((0, 5)), (0.0, 0.0))
    with pytest.raises(ValueError, match="step_px must be positive"):
        Thumbnail(np.zeros((5, 5)), (0.0, 0.0), 0.0)


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
    assert contour_plot(FRAME, x_mm, y_mm, np.zeros((13, 25)), "field") is None


Array = NDArray[np.float64]
RADIUS_MM = 150.0


def camera(family: str, c_mm: float = 153.0, **parameters: float) -> CameraRecord:
    return CameraRecord(
        principal_distance_mm=Quantity(c_mm, 0.004),
        principal_point_mm=PrincipalPointRecord(Quantity(0.3, 0.0), Quantity(-0.2, 0.0)),
        distortion=DistortionRecord(family=family, parameters={n: Quantity(v, 1.0) for n, v in parameters.items()}),
        fiducials={},
    )


def covariance(name: str, parameters: tuple[str, ...], matrix: Array) -> Covariance:
    return Covariance(tuple(Parameter.interior(name, each) for each in parameters), np.zeros(len(parameters)), matrix)


def test_a_covariance_is_enlarged_in_the_directions_in_which_leaving_out_images_scatters_more() -> None:
    keys = tuple(Parameter.interior("K", each) for each in ("c", "x0"))
    model, along = np.array([[4.0, 1.0], [1.0, 1.0]]), np.array([[1.0, -1.0]])
    clusters = Covariance(keys, np.zeros(2), 25.0 * along.T @ along)
    known = Covariance(keys, np.zeros(2), model, clusters=clusters)
    larger = known.select_larger((*keys, Parameter.interior("K", "k1")))
    assert np.linalg.eigvalsh(larger[:2, :2] - model).min() > -1e-9
    assert np.linalg.eigvalsh(larger[:2, :2] - clusters.matrix).min() > -1e-9
    assert not larger[2].any()
    assert Covariance(keys, np.zeros(2), model).select_larger(keys).tolist() == model.tolist()
    fixed = np.array([[4.0, 2.0], [2.0, 1.0]])  # of one direction: a converted lens with more parameters than before
    np.testing.assert_allclose(larger_covariance(fixed, 9.0 * fixed), 9.0 * fixed, atol=1e-12)
    np.testing.assert_allclose(larger_covariance(fixed, 0.0 * fixed), fixed, atol=1e-12)


def test_the_radial_curve_of_torlegard_is_its_polynomial_and_its_sigma_follows() -> None:
    """dr = k3 r³ + k5 r⁵; with the correlation of k3 and k5 its variance is a quadratic form in (r³, r⁵)."""
    k3, k5, s3, s5, rho = 1.7e-7, -5.4e-12, 3e-9, 2e-13, -0.97
    matrix = np.array([[s3**2, rho * s3 * s5], [rho * s3 * s5, s5**2]])
    drawn = distortion_curves(
        lens("A", camera("torlegard", k3=k3, k5=k5), covariance("A", ("k3", "k5"), matrix)), RADIUS_MM
    )  # fmt: skip
    r = drawn.radius_mm
    np.testing.assert_allclose(drawn.radial_um, 1e3 * (k3 * r**3 + k5 * r**5), rtol=1e-10)
    variance = (s3 * r**3) ** 2 + (s5 * r**5) ** 2 + 2.0 * rho * s3 * s5 * r**8
    np.testing.assert_allclose(drawn.radial_sigma_um, 1e3 * np.sqrt(variance), rtol=1e-8)
    np.testing.assert_allclose(drawn.asymmetric_um, 0.0, atol=1e-9)


def test_decentering_moves_a_point_by_three_times_its_profile_at_most() -> None:
    """Along the direction of (p1, p2) the decentering displacement is 3 sqrt(p1² + p2²) r², all of it radial."""
    p1, sigma = 8e-7, 9e-8
    drawn = distortion_curves(
        lens("A", camera("torlegard", p1=p1), covariance("A", ("p1",), np.array([[sigma**2]]))), RADIUS_MM
    )  # fmt: skip
    np.testing.assert_allclose(drawn.asymmetric_um, 3e3 * p1 * drawn.radius_mm**2, rtol=1e-10)
    np.testing.assert_allclose(drawn.asymmetric_sigma_um, 3e3 * sigma * drawn.radius_mm**2, rtol=1e-8)
    np.testing.assert_allclose(drawn.radial_um, 0.0, atol=1e-9)


def test_the_opencv_family_is_drawn_as_opencv_undistorts() -> None:
    c, pitch = 20.0, 0.005
    k = (-0.12, 0.08, 0.0, 0.0, -0.01)
    of = lens("A", camera("opencv", c, k1=k[0], k2=k[1], k3=k[4]))
    angles = np.linspace(0.0, 2.0 * np.pi, 13)
    observed = np.concatenate(
        [radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) for radius in (2.0, 6.0, 9.0)]
    )
    matrix = np.array([[c / pitch, 0.0, 0.0], [0.0, c / pitch, 0.0], [0.0, 0.0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    pixels = (observed * (1.0, -1.0) / pitch)[:, None, :]
    rays = cv2.undistortPoints(pixels, matrix, np.array(k), criteria=criteria)
    ideal = c * rays.reshape(-1, 2) * (1.0, -1.0)
    np.testing.assert_allclose(of.displacement(observed).value_um, 1e3 * (observed - ideal), atol=1e-6)


def test_the_band_of_the_opencv_family_knows_that_c_and_k1_move_together() -> None:
    """The displacement of an observed point over c and k1 with a correlation of -0.9, by Gauss-Hermite quadrature."""
    c, k1, sigma_c, sigma_k = 20.0, -0.12, 0.02, 2e-3
    off = -0.9 * sigma_c * sigma_k
    matrix = np.array([[sigma_c**2, off], [off, sigma_k**2]])
    drawn = distortion_curves(lens("A", camera("opencv", c, k1=k1), covariance("A", ("c", "k1"), matrix)), 9.0)
    r = drawn.radius_mm[-1]
    nodes, weights = np.polynomial.hermite_e.hermegauss(5)
    pairs = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) @ np.linalg.cholesky(matrix).T + (c, k1)
    share = np.outer(weights, weights).ravel() / weights.sum() ** 2
    moved = np.array(
        [lens("A", camera("opencv", a, k1=b)).displacement(np.array([[r, 0.0]])).value_um[0, 0] for a, b in pairs]
    )
    assert drawn.radial_sigma_um[-1] == pytest.approx(np.sqrt(share @ (moved - share @ moved) ** 2), rel=0.01)


def test_the_effect_of_a_parameter_is_the_displacement_it_makes() -> None:
    effects = largest_effects_um(lens("A", camera("torlegard")), RADIUS_MM)
    assert effects["k3"] == pytest.approx(1e3 * RADIUS_MM**3)
    assert effects["p2"] == pytest.approx(3e3 * RADIUS_MM**2)


WIDE_FRAME = Plane(np.array([[-75.0, -75.0], [75.0, 75.0]]), 500.0)


def of_k3() -> Lens:
    return lens("A", camera("torlegard", k3=1e-7), covariance("A", ("k3",), np.array([[1e-18]])))


def test_the_map_shows_the_longest_vector_with_its_sigma() -> None:
    """k3 r³ with r to the outermost of 15 x 15 squares over a frame of 150 mm: 70 mm in x and y, less x0', y0'."""
    drawn = lens_map(of_k3(), WIDE_FRAME)
    r = np.hypot(70.3, 70.2)
    assert drawn.largest_um == pytest.approx((1e3 * 1e-7 * r**3, 1e3 * 1e-9 * r**3))
    assert drawn.plot.count("M") == 2 * 15**2 + drawn.plot.count('class="bar"')


def test_the_map_shows_what_lies_beyond_the_outermost_target() -> None:
    """Of 15 x 15 squares of 10 mm about (0.3, -0.2) the middles of 37 lie within 35 mm."""
    drawn = lens_map(of_k3(), WIDE_FRAME, 35.0)
    dots = {kind: re.search(f'd="([^"]*)" class="dot {kind}"', drawn.plot) for kind in ("target", "extrapolated")}
    counts = {kind: found[1].count("M") for kind, found in dots.items() if found}
    assert counts == {"target": 37, "extrapolated": 15**2 - 37}
    assert drawn.extrapolated
    assert not lens_map(of_k3(), WIDE_FRAME, 110.0).extrapolated
    curves = distortion_curves(of_k3(), RADIUS_MM)
    assert "no targets here" in curves_plot(curves, 100.0)
    assert "no targets here" not in curves_plot(curves, RADIUS_MM)


def test_of_a_set_over_the_frame_the_effect_is_the_largest_within_it() -> None:
    """2 (ξ² - 2/3) is largest in the middle, 4/3 mm, where ξη is 0."""
    entry = camera("ebner", b3=0.01)
    entry = replace(entry, distortion=replace(entry.distortion, half_mm=(114.0, 90.0)))
    assert largest_effects_um(lens("A", entry), RADIUS_MM)["b3"] > 1e3 * 4 / 3 * np.sqrt(90 / 114)


def test_parameters_say_what_is_significant_and_what_the_prior_carried() -> None:
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


def test_high_correlations_are_listed_by_name() -> None:
    matrix = np.array([[4.0, 0.0, -1.9], [0.0, 1.0, 0.1], [-1.9, 0.1, 1.0]])
    pairs = high_correlations("A", camera("torlegard", k3=1.0), covariance("A", ("c", "x0", "k3"), matrix))
    assert [(first, second) for first, second, _ in pairs] == [("c", "k3")]
    assert pairs[0][2] == pytest.approx(-0.95)


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
    form = figure_of_films("A", fiducials(estimated), Covariance(places, estimated.ravel(), matrix), {})
    assert form is not None
    return form


def test_a_shift_a_turn_and_a_scale_change_no_form() -> None:
    angle = 0.02
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    form = changed(1.0002 * GIVEN @ turn.T + (0.3, -0.4), np.eye(10))
    np.testing.assert_allclose(form.change_um, 0.0, atol=1e-9)


def test_an_uncertain_datum_leaves_the_ellipses_as_they_are() -> None:
    """1 mm of common shift, and of rotation at the marks, added to 2 µm of each coordinate."""
    rng = np.random.default_rng(5)
    local = np.diag(rng.uniform(1e-6, 9e-6, 10))
    shift = np.tile(np.eye(2), (5, 1))
    centred = GIVEN - GIVEN.mean(axis=0)
    rotation = (centred @ np.array([[0.0, 1.0], [-1.0, 0.0]])).reshape(-1, 1) / 100.0
    datum = shift @ shift.T + rotation @ rotation.T
    free, bound = changed(GIVEN, local + datum), changed(GIVEN, local)
    np.testing.assert_allclose(free.covariance_um2, bound.covariance_um2, atol=1e-6)
    assert np.all(np.sqrt(np.linalg.eigvalsh(free.mark_covariances_um2)) < 3.1)


def test_one_displaced_mark_is_the_one_that_changed_most() -> None:
    estimated = GIVEN.copy()
    estimated[3] += (0.05, 0.0)
    form = changed(estimated, 4e-6 * np.eye(10))
    assert int(np.hypot(*form.change_um.T).argmax()) == 3
    assert "enlarged" in figure_plot(form)
    two = dict(list(fiducials(GIVEN).items())[:2])
    assert figure_of_films("A", two, Covariance((), np.empty(0), np.empty((0, 0))), {}) is None


NAMES = ("residuals", "coverage", "distortion", "uncertainty-infinity", "uncertainty-near")


@pytest.fixture(scope="module")
def adjusted_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of a simulated camera, adjusted."""
    rng, truth = np.random.default_rng(4), Truth()
    network, _ = simulated(rng, truth, points=field_points(rng, 20), free=dict.fromkeys(truth.distortion, np.inf))
    project = write_network_project(network, tmp_path_factory.mktemp("simulated"))
    assert run(["adjust", str(project)]) in (0, 1)
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


@pytest.mark.study
def test_every_plot_is_written_as_png_and_pdf(adjusted_folder: Path, tmp_path: Path) -> None:
    assert run(["report", str(adjusted_folder), "--plots", str(tmp_path / "plots")]) in (0, 1)
    files = {path.name: path.read_bytes() for path in (tmp_path / "plots").iterdir()}
    assert files.keys() == {f"K-{name}.{ending}" for name in NAMES for ending in ("png", "pdf")}
    for name, content in files.items():
        assert content.startswith(b"%PDF" if name.endswith("pdf") else b"\x89PNG")
    assert (adjusted_folder.parent / "out" / "report.html").exists()


def test_without_matplotlib_one_message_says_what_to_install(
    adjusted_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert run(["report", str(adjusted_folder), "--plots", str(tmp_path)]) == 2
    assert "--plots needs Matplotlib" in capsys.readouterr().err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_without_an_adjustment_there_is_nothing_to_plot(
    adjusted_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("camera.toml", "points.csv", "comparator.csv", "project.toml"):
        (tmp_path / name).write_bytes((adjusted_folder.parent / name).read_bytes())
    assert run(["report", str(tmp_path / "project.toml"), "--plots", str(tmp_path / "plots")]) == 2
    assert "There is no calibrated camera to plot." in capsys.readouterr().err.replace("\n", " ")
