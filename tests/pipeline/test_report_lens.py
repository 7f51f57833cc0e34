"""Distortion curves and their sigmas against closed forms and OpenCV; fiducial figures against their invariances."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from adjust.problem.parameter import Parameter
from adjust.quality.lens_reach import distortion_curves
from pipeline.report.fiducials import Figure, figure_of_films, figure_plot
from pipeline.report.lens import curves_plot, largest_effects_um, lens, lens_map
from pipeline.report.parameters import high_correlations, parameter_rows
from pipeline.report.vectors import Plane
from pipeline.results.adjustment_record import (
    CameraRecord,
    DistortionRecord,
    FiducialRecord,
    GivenQuantity,
    PrincipalPointRecord,
    Quantity,
)
from pipeline.results.covariance_file import Covariance

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


def test_the_map_shows_the_longest_vector_with_its_sigma() -> None:
    """k3 r³ with r to the outermost of 15 x 15 squares over a frame of 150 mm: 70 mm in x and y, less x0', y0'."""
    of = lens("A", camera("torlegard", k3=1e-7), covariance("A", ("k3",), np.array([[1e-18]])))
    drawn = lens_map(of, Plane(np.array([[-75.0, -75.0], [75.0, 75.0]]), 500.0))
    r = np.hypot(70.3, 70.2)
    assert drawn.largest_um == pytest.approx((1e3 * 1e-7 * r**3, 1e3 * 1e-9 * r**3))
    assert drawn.plot.count("M") == 2 * 15**2 + drawn.plot.count('class="bar"')


def test_the_map_shows_what_lies_beyond_the_outermost_target() -> None:
    """Of 15 x 15 squares of 10 mm about (0.3, -0.2) the middles of 37 lie within 35 mm."""
    of = lens("A", camera("torlegard", k3=1e-7), covariance("A", ("k3",), np.array([[1e-18]])))
    plane = Plane(np.array([[-75.0, -75.0], [75.0, 75.0]]), 500.0)
    drawn = lens_map(of, plane, 35.0)
    dots = {kind: re.search(f'd="([^"]*)" class="dot {kind}"', drawn.plot) for kind in ("target", "extrapolated")}
    counts = {kind: found[1].count("M") for kind, found in dots.items() if found}
    assert counts == {"target": 37, "extrapolated": 15**2 - 37}
    assert drawn.extrapolated
    assert not lens_map(of, plane, 110.0).extrapolated


def test_of_a_set_over_the_frame_the_effect_is_the_largest_within_it() -> None:
    """2 (ξ² - 2/3) is largest in the middle, 4/3 mm, where ξη is 0."""
    entry = camera("ebner", b3=0.01)
    entry = replace(entry, distortion=replace(entry.distortion, half_mm=(114.0, 90.0)))
    assert largest_effects_um(lens("A", entry), RADIUS_MM)["b3"] > 1e3 * 4 / 3 * np.sqrt(90 / 114)


def test_the_curve_shows_where_no_target_was() -> None:
    drawn = distortion_curves(
        lens("A", camera("torlegard", k3=1e-7), covariance("A", ("k3",), np.array([[1e-18]]))), RADIUS_MM
    )
    assert "no targets here" in curves_plot(drawn, 100.0)
    assert "no targets here" not in curves_plot(drawn, RADIUS_MM)


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
    assert "drawn" in figure_plot(form)


def test_two_marks_have_no_form() -> None:
    few = dict(list(fiducials(GIVEN).items())[:2])
    assert figure_of_films("A", few, Covariance((), np.empty(0), np.empty((0, 0))), {}) is None
