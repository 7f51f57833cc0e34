"""The scanner apart from the film: derivatives, recovered truth, the terms chosen, a camera's lens as scanner."""

from dataclasses import replace
from typing import Literal

import cv2
import networks as nets
import numpy as np
import pytest

from adjust import Adjustment, AdjustmentError, Options, adjust, approximate
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.scanner import Bend, smooth_terms
from adjust.model_selection.scanner_choice import bent_network, choose_bends, network_with_terms
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Approximations, Network, Scanner, Transformation

QUARTERS = [0.0, 90.0, 180.0, 270.0]
FREE = Prior(0.0, np.inf)
EVEN = ("a20", "a11", "a02", "b20", "b11", "b02")
ODD = ("a30", "a21", "a12", "a03")  # with b03, b12, b21, b30 they make what is the same in all four quarters
BEND_MM = {
    "a20": 0.02, "a11": -0.015, "a02": 0.01, "b20": -0.012, "b11": 0.008, "b02": -0.02,
    "a30": 0.006, "a21": -0.004, "a12": 0.005, "a03": 0.003, "b30": -0.005, "b21": 0.004, "b12": -0.006, "b03": 0.007,
}  # fmt: skip
PLACES_MM = np.random.default_rng(3).uniform([10.0, -240.0], [240.0, -5.0], (7, 2))


def solved(network: Network, options: Options | None = None) -> Adjustment:
    return adjust(network, approximate(network), options)


def free(*names: str) -> dict[str, Prior]:
    return dict.fromkeys(names, FREE)


@pytest.mark.parametrize(
    ("kind", "left"),
    [
        ("affine", tuple(BEND_MM)),
        ("similarity", ("stretch", "shear", *BEND_MM)),
        ("congruent", ("stretch", "shear", *BEND_MM)),
        ("projective", ("tilt_x", "tilt_y", "a02", "b20", *list(BEND_MM)[6:])),
        ("bilinear", ("a20", "a02", "b20", "b02", *list(BEND_MM)[6:])),
        ("polynomial(2)", tuple(list(BEND_MM)[6:])),
        ("conformal(2)", ("stretch", "shear", *list(BEND_MM)[6:])),
        ("polynomial(3)", ()),
    ],
)
def test_only_terms_that_no_film_transformation_takes(kind: Transformation, left: tuple[str, ...]) -> None:
    assert set(smooth_terms([kind])) == set(left)
    assert set(smooth_terms([kind, "affine"])) <= set(left)


@pytest.mark.parametrize("method", ["combined", "elements"])
def test_perfect_data_give_the_bend_back(method: Literal["combined", "elements"]) -> None:
    """Targets and fiducials in four convergent frames, one of them mirrored: nothing is left, the truth comes out."""
    truth = nets.Truth(mirrored=(False, True, False, False), middle_mm=nets.SCAN_MIDDLE_MM)
    points = nets.field_points(np.random.default_rng(5), 40)
    straight, _ = nets.simulated(np.random.default_rng(4), truth, points=points, noise=False)
    network = nets.bend_in_scanner(straight, BEND_MM, free(*BEND_MM))
    result = solved(network, Options(method=method))
    assert result.converged
    assert np.abs(result.residuals.v_mm).max() < 1e-9
    for name, value in BEND_MM.items():
        assert result.value(f"SC.S.{name}") == pytest.approx(value, abs=1e-8)
    image = adjusted_image(result, "f1")
    shown = [i for i, name in enumerate(network.observations.image) if name == "f1" and i % 2]
    camera_mm = image.camera_from_comparator(network.observations.xy_mm[shown])
    back, found = image.comparator_from_camera(camera_mm)
    assert found.all()
    np.testing.assert_allclose(back, network.observations.xy_mm[shown], atol=1e-9)
    plain = adjusted_image(solved(straight), "f1")
    np.testing.assert_allclose(camera_mm, plain.camera_from_comparator(straight.observations.xy_mm[shown]), atol=1e-7)


def test_the_derivatives_of_an_image_through_scanner_and_film() -> None:
    network = nets.bent_films(QUARTERS, BEND_MM, free(*EVEN, *ODD))
    image = adjusted_image(solved(network), "f1")
    for axis in (0, 1):
        step = 1e-3 * np.eye(2)[axis]
        there, here = (image.camera_from_comparator(PLACES_MM + sign * step) for sign in (1.0, -1.0))
        by_axis = image.camera_by_comparator(PLACES_MM)[..., axis]
        np.testing.assert_allclose(by_axis, (there - here) / 2e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("turns", "terms", "lost"),
    [
        ([0.0] * 4, EVEN, EVEN),
        ([0.0, 180.0] * 2, EVEN, ()),
        ([0.0, 180.0] * 2, (*EVEN, *ODD), ODD),
        (QUARTERS, (*EVEN, *ODD), ()),
    ],
)
def test_two_poses_tell_a_bend_from_marks(turns: list[float], terms: tuple[str, ...], lost: tuple[str, ...]) -> None:
    result = solved(nets.bent_films(turns, {}, free(*terms), sigma_given_mm=np.inf, scatter=0.0))
    scanner = [each for each in result.singular if "bend of scanner S" in each.cause]
    assert {each.cause.split()[2] for each in scanner} == set(lost)
    others = [moved.kind for each in result.singular if each not in scanner for moved in each.parameters]
    assert "scanner" not in others


def test_frames_that_lie_alike_are_reported() -> None:
    result = solved(nets.bent_films([0.0] * 4, BEND_MM, free("a20")))
    (warning,) = [text for text in result.warnings if "bend of scanner S" in text]
    assert "in its term a20: " in warning
    assert "all frames lie alike in the scanner" in warning
    assert "turned by 180 degrees" in warning
    halves = solved(nets.bent_films([0.0, 180.0] * 2, BEND_MM, free("a20", "a21")))
    (warning,) = [text for text in halves.warnings if "bend of scanner S" in text]
    assert "in its term a21: " in warning
    assert "turned by 90 degrees" in warning


def test_the_bend_is_tested_for_significance() -> None:
    network = nets.bent_films(QUARTERS, {"a20": 0.02}, free("a20", "b02"), np.random.default_rng(2))
    result = solved(network)
    tests = {test.name: test for test in result.significance["scanner", network.scanners[0].name]}
    assert tests["a20"].p < 1e-6
    assert tests["b02"].p > 0.01
    without = solved(replace(network, scanners=(Scanner("S"),)))
    f = (without.vpv - result.vpv) / 2 / result.sigma0**2
    assert tests["all"].statistic == pytest.approx(f, rel=1e-3)
    assert tests["all"].p < 1e-6


def test_a_scanner_that_is_not_given_is_stated() -> None:
    network = nets.bent_films([0.0], {}, free("a20"))
    with pytest.raises(AdjustmentError, match="scanner S, which is not given"):
        solved(Network(network.cameras, network.images, (), network.observations))


def test_a_bend_that_a_lens_makes_too_is_laid_to_the_lens() -> None:
    """Radial distortion of the third degree and the bend (r² x, r² y) look alike however the frames lie."""
    points = nets.field_points(np.random.default_rng(5), 40)
    attitudes = tuple((0.0, 0.0, np.radians(90.0 * i)) for i in range(4))
    truth = nets.Truth(attitudes=attitudes, distortion={"k3": 0.0}, middle_mm=nets.SCAN_MIDDLE_MM, x0=0.0, y0=0.0)
    network, start = nets.simulated(np.random.default_rng(4), truth, points=points, free={"k3": np.inf})
    radial = ("a30", "a12", "b21", "b03")
    result = adjust(nets.bend_in_scanner(network, {}, free(*radial)), start)
    (warning,) = [text for text in result.warnings if "bend of scanner S" in text]
    assert ": the distortion of a lens does the same however the frames lie" in warning
    assert "a30" in warning
    fixed, _ = nets.simulated(np.random.default_rng(4), truth, points=points)
    known = adjust(nets.bend_in_scanner(fixed, {}, free(*radial)), start)
    assert not any("bend of scanner S" in text for text in known.warnings)


def test_a_bend_that_no_mark_shows_is_laid_to_the_marks() -> None:
    """Four marks on the corners of a square: all six terms of degree 2 but two sums are constant or linear there."""
    corners = {str(i): (106.0 * x, 106.0 * y) for i, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1)))}
    result = solved(nets.bent_films([0.0, 180.0], {}, free("a20"), sigma_given_mm=0.0, marks_mm=corners, scatter=0.0))
    (direction,) = result.singular
    assert "too few, or lie too much alike" in direction.cause


def test_a_bend_that_the_films_make_too_is_laid_to_the_films() -> None:
    network = nets.bent_films([0.0, 90.0], {}, free("a11"), kind="polynomial(2)", sigma_given_mm=0.0, scatter=0.0)
    (direction,) = solved(network).singular
    assert "the polynomial(2) transformation of its films does the same" in direction.cause
    assert direction.remedy.endswith("or leave it out.")


def chosen(network: Network, start: Approximations | None = None) -> set[str]:
    bent, _ = choose_bends(network, lambda network: adjust(network, start or approximate(network)))
    return set(bent.scanners[0].terms)


def test_the_terms_that_are_there_are_chosen() -> None:
    truth = {"a20": 0.02, "b11": -0.015, "b02": 0.01}
    network = nets.bent_films(QUARTERS * 2, truth, {}, np.random.default_rng(1))
    bent, _ = choose_bends(network, solved)
    # over the extent of the marks, which is not that of the truth, products of degree 2 take parts of degree 1 and 0
    assert set(bent.scanners[0].terms) == set(truth)
    result = solved(bent)
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    assert result.value("SC.S.a20") == pytest.approx(0.02, rel=0.15)


def test_a_carriage_that_wavers_is_found_by_a_reseau() -> None:
    truth = {"a04": 0.02, "b05": -0.02}
    rng = np.random.default_rng(2)
    found = chosen(nets.bent_films([0.0, 90.0], truth, {}, rng, sigma_given_mm=1e-3, marks_mm=nets.RESEAU_MM))
    assert {"a04", "b05"} <= found
    assert all(term[1] == "0" or term[2] == "0" for term in found)


def test_where_nothing_bends_nothing_is_chosen() -> None:
    """At one percent for all candidates together: none in 5 networks. They start from marks without errors: to find
    those of films among marks a millimetre off takes longest."""
    start = approximate(nets.bent_films(QUARTERS, {}, {}))
    networks = [nets.bent_films(QUARTERS, {}, {}, np.random.default_rng(seed)) for seed in range(5)]
    assert not any(chosen(network, start) for network in networks)


def test_frames_that_lie_alike_get_no_bend_and_a_sentence() -> None:
    bent, (even, odd) = choose_bends(nets.bent_films([0.0] * 4, {"a20": 0.05}, {}, np.random.default_rng(3)), solved)
    assert not bent.scanners[0].terms
    assert "a20, a11, a02, b20, b11, b02: all frames lie alike in the scanner" in even
    assert even.endswith("turned by 180 degrees.")
    assert odd.endswith("turned by 90 degrees.")


def test_two_photographs_are_enough_for_terms_that_they_tell() -> None:
    """Their trial has far more terms than they tell, which are held by no more than its prior."""
    truth = nets.Truth(
        stations=nets.STATIONS[:2], attitudes=((0.0, 0.0, 0.0), (-0.05, 0.36, 1.6)), middle_mm=nets.SCAN_MIDDLE_MM
    )
    points = nets.field_points(np.random.default_rng(5), 30)
    network, _ = nets.simulated(np.random.default_rng(4), truth, points=points, free={"k3": np.inf, "k5": np.inf})
    bent, remarks = choose_bends(nets.bend_in_scanner(network, {"a20": 0.04, "b11": -0.03}, {}), solved)
    assert {"a20", "b11"} <= set(bent.scanners[0].terms)
    assert not any("No bend of the scanner was estimated" in text for text in remarks)


def test_a_bend_of_given_terms_over_the_extent_of_the_scans() -> None:
    network = nets.bent_films(QUARTERS, {}, {})
    (scanner,) = bent_network(network, ("a20", "b02"), 0.01).scanners
    assert {name: prior.sigma for name, prior in scanner.terms.items()} == {"a20": 0.01, "b02": 0.01}
    xy_mm = network.observations.xy_mm
    np.testing.assert_allclose(np.array(scanner.center_mm) - scanner.half_mm, xy_mm.min(axis=0))
    assert len(smooth_terms({image.transformation for image in network.images})) == 14


MM = 0.05
F, CX, CY = 3000.0, 1010.0, 760.0
COEFFICIENTS = (-0.12, 0.05, 1e-3, -5e-4, 0.0)
LENS = Lens(Distortion("opencv"), np.array([F * MM, CX * MM, -CY * MM]), np.array([*COEFFICIENTS, *np.zeros(11)]))
PX = np.random.default_rng(3).uniform((0.0, 0.0), (2000.0, 1500.0), (40, 2))
MATRIX = np.array([[F, 0.0, CX], [0.0, F, CY], [0.0, 0.0, 1.0]])


def test_a_bend_takes_the_taking_lens_out_as_opencv_does_and_then_bends() -> None:
    scan_mm = PX * (MM, -MM)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-14)
    ideal = cv2.undistortPoints(PX[:, None], MATRIX, np.array(COEFFICIENTS), R=np.eye(3), P=MATRIX, criteria=stop)[:, 0]
    lens = Bend(lens=LENS)
    np.testing.assert_allclose(lens.apply(np.empty(0), scan_mm), ideal * (MM, -MM), atol=1e-7)
    bend = Bend(("a20", "b11"), (50.0, -37.0), (50.0, 38.0))
    both, values = replace(bend, lens=LENS), np.array([0.02, -0.03])
    np.testing.assert_allclose(
        both.apply(values, scan_mm), bend.apply(values, lens.apply(np.empty(0), scan_mm)), atol=1e-10
    )
    back, found = both.inverse(values, both.apply(values, scan_mm))
    assert found.all()
    np.testing.assert_allclose(back, scan_mm, atol=1e-9)
    step = 1e-4
    for axis, shift in enumerate(step * np.eye(2)):
        slope = (both.apply(values, scan_mm + shift) - both.apply(values, scan_mm - shift)) / (2 * step)
        np.testing.assert_allclose(both.gradient(values, scan_mm)[:, :, axis], slope, atol=1e-6)


def test_scans_through_a_lens_adjust_as_plain_ones() -> None:
    network, start = nets.simulated(np.random.default_rng(5))
    straight = network.observations.xy_mm
    lens = replace(LENS, interior=np.array([600.0, 3.0, -5.0]))
    rays = np.column_stack([(straight - lens.interior[1:]) * (1.0, -1.0) / 600.0, np.ones(len(straight))])
    ideal = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(COEFFICIENTS))[0][:, 0]
    pictured = ideal * (600.0, -600.0) + lens.interior[1:]
    assert np.abs(pictured - straight).max() > 0.2
    through = nets.set_images(nets.set_observations(network, xy_mm=pictured), scanner="photo")
    through = replace(through, scanners=(Scanner("photo", lens=lens),))
    without, with_lens = adjust(network, start), adjust(through, start)
    assert with_lens.converged
    assert abs(with_lens.sigma0 / without.sigma0 - 1.0) < 0.01  # standard deviations are those in the picture
    for name in ("IO.K.c", "IO.K.x0", "IO.K.y0"):
        assert abs(with_lens.value(name) - without.value(name)) < 0.02 * without.sigma(name)
    model = adjusted_image(with_lens, "f0")
    np.testing.assert_allclose(
        model.camera_from_comparator(pictured[:5]),
        adjusted_image(without, "f0").camera_from_comparator(straight[:5]),
        atol=2e-4,
    )
    (bent,) = network_with_terms(through, {"photo": ("a30",)}).scanners
    assert bent.lens is lens
