"""sigma0 comes from observations that tell it, and multiplies nothing else; of fiducials alone, against the truth."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from film_realisations import CAMERA, NOISE_MM, Frames, errors, frames
from numpy.typing import NDArray
from realisations import exact, realisation
from reference_cases import load
from scipy.stats import norm

from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.estimates import GivenGroup, adjusted_image
from adjust.problem.network import Transformation
from adjust.quality.fiducial_corrections import common_transformation, corrections_to_given
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]


def adjust_network(truth: Frames) -> Adjustment:
    return adjust(truth.network, truth.start)


def test_a_single_frame_whose_marks_only_place_the_datum_has_a_priori_sigmas() -> None:
    """Of the shift by hand: the design matrix, and the two standard deviations of a mark."""
    truth = frames("affine", 1, 8, 1.0, 0.01, np.random.default_rng(1))
    result = adjust_network(truth)
    assert result.redundancy == 10
    assert result.variance.is_a_priori
    assert result.sigma0 == 1.0
    assert result.groups["fiducial"].sigma0 == 0.0
    design = np.column_stack([np.ones(8), truth.network.observations.xy_mm])
    cofactor = np.linalg.inv(design.T @ design) * (1.0 + NOISE_MM**2)
    sigmas = [result.sigma(f"T.f0.a{k}") for k in (1, 2, 3)]
    np.testing.assert_allclose(sigmas, np.sqrt(np.diag(cofactor)), rtol=1e-3)


@pytest.mark.parametrize("count", [2, 5])
def test_sigma0_of_affine_frames_is_what_their_figures_leave(count: int) -> None:
    """The figure of all frames together has rank 2 about its means (Tomasi and Kanade 1992): the rest is noise."""
    truth = frames("affine", count, 8, 1.0, 0.01, np.random.default_rng(2))
    result = adjust_network(truth)
    figures = truth.network.observations.xy_mm.reshape(count, 8, 2).transpose(0, 2, 1).reshape(2 * count, 8)
    left = np.linalg.svd(figures - figures.mean(axis=1, keepdims=True), compute_uv=False)[2:]
    redundancy = 10 * (count - 1)
    assert result.variance.left_out == (GivenGroup("datum", CAMERA),)
    assert result.variance.redundancy == pytest.approx(redundancy, abs=1e-3)
    assert result.sigma0 == pytest.approx(np.sqrt((left**2).sum() / redundancy) / NOISE_MM, rel=2e-3)


def test_sigma0_multiplies_the_noise_of_marks_and_not_the_datum() -> None:
    calm, loud = (
        adjust_network(frames("affine", 5, 8, 1.0, 0.01, np.random.default_rng(3), noise)) for noise in (1.0, 4.0)
    )
    assert loud.sigma0 == pytest.approx(4.0 * calm.sigma0, rel=1e-2)
    assert loud.sigma("T.f0.a1") == pytest.approx(calm.sigma("T.f0.a1"), rel=1e-3)
    assert loud.sigma("T.f0.a1") == pytest.approx(1.0 / np.sqrt(8), rel=0.01)
    of_noise = [np.sqrt(np.diag(corrections_covariance(each))) for each in (calm, loud)]
    np.testing.assert_allclose(of_noise[1], 4.0 * of_noise[0], rtol=0.02)


def corrections_covariance(result: Adjustment) -> Array:
    fiducials = result.network.cameras[0].fiducials
    names = [f"FID.{CAMERA}.{id_}.{axis}" for id_ in fiducials for axis in "xy"]
    places = np.array([result.value(name) for name in names]).reshape(-1, 2)
    given = np.array([(mark.x_mm.value, mark.y_mm.value) for mark in fiducials.values()])
    films = [adjusted_image(result, image.name).film for image in result.network.images]
    found = corrections_to_given(films, places, given)
    assert found
    names += [f"T.f0.{name}" for name in film_parameter_names(films[0].transformation)]
    return np.asarray(found.by_unknowns @ (result.sigma0**2 * result.cofactor_of(names)) @ found.by_unknowns.T)


def test_a_certificate_tells_sigma0_of_a_single_frame() -> None:
    """Marks and certificate of the same sigma: v'Pv of the affine fit over its redundancy of 10."""
    truth = frames("affine", 1, 8, NOISE_MM, NOISE_MM, np.random.default_rng(4))
    result = adjust_network(truth)
    assert not result.variance.left_out
    assert result.variance.redundancy == result.redundancy == 10
    assert result.sigma0 == pytest.approx(np.sqrt(result.vpv / 10))


def test_given_values_that_are_too_good_are_left_out_of_a_whole_network_too() -> None:
    """Five images with targets: given fiducials right to a hundredth of their sigma; drawn from it, they take part."""
    case = exact(load("i_five_images_affine_reduced"))
    drawn = realisation(case.network, np.random.default_rng(0))
    fiducials = case.network.cameras[0].fiducials
    right = replace(drawn, cameras=(replace(drawn.cameras[0], fiducials=fiducials),))
    whole, without = adjust(drawn, case.start), adjust(right, case.start)
    assert not whole.variance.left_out
    assert whole.sigma0 == np.sqrt(whole.vpv / whole.redundancy)
    assert without.variance.left_out == (GivenGroup("datum", CAMERA),)
    assert without.variance.redundancy == pytest.approx(without.redundancy - without.groups["datum"].redundancy)
    assert without.sigma("FID.K.1.x") == pytest.approx(whole.sigma("FID.K.1.x") / whole.sigma0, rel=1e-3)


@pytest.mark.parametrize(
    ("kinds", "common"),
    [
        (["affine", "affine"], "affine"),
        (["affine", "congruent"], "congruent"),
        (["affine", "none"], "none"),
        (["conformal(3)", "conformal(2)"], "conformal(2)"),
        (["conformal(3)", "similarity"], "similarity"),
        (["conformal(3)", "projective"], "similarity"),
        (["projective", "bilinear"], "affine"),
        (["polynomial(3)", "polynomial(2)"], "polynomial(2)"),
    ],
)
def test_what_films_of_several_kinds_take_up(kinds: list[str], common: str) -> None:
    assert common_transformation(kinds) == common


def test_corrections_are_the_residuals_of_a_least_squares_fit() -> None:
    """By hand, of places that an affine film has moved by a tenth of a degree and 1 mm, mirrored film or not."""
    rng = np.random.default_rng(5)
    given = frames("affine", 1, 8, 1.0, 1.0, rng).places_mm
    true = given + rng.normal(0.0, 0.01, given.shape)
    design = np.column_stack([np.ones(8), true])
    left = design @ np.linalg.lstsq(design, given)[0] - given
    moved = true @ np.array([[1.001, 0.02], [-0.03, 0.999]]) + 1.0
    for film in (Film("affine", np.array([3.0, -1.0, 0.01, 2.0, 0.02, 1.0]), np.zeros(2)),):
        found = corrections_to_given([film], moved, given)
        assert found
        np.testing.assert_allclose(found.corrections_mm, left, atol=1e-9)
    assert corrections_to_given([film], moved[:3], given[:3]) is None


@pytest.mark.study
@pytest.mark.parametrize(
    ("kind", "marks", "count"),
    [
        ("affine", 4, 1),
        ("affine", 4, 2),
        ("projective", 8, 2),
        ("bilinear", 8, 2),
        ("congruent", 4, 2),
        ("conformal(2)", 8, 5),
        ("polynomial(2)", 8, 5),
    ],
)
def test_every_sigma_holds_against_realisations(kind: Transformation, marks: int, count: int) -> None:
    """Given coordinates wrong by their 1 mm, drawn anew each time: the whole standard deviation, datum and all."""
    squares: dict[str, list[float]] = defaultdict(list)
    for seed in range(30):
        truth = frames(kind, count, marks, 1.0, 1.0, np.random.default_rng(seed))
        trial: dict[str, list[float]] = defaultdict(list)
        for name, error, sigma in errors(adjust_network(truth), truth):
            trial[name].append((error / sigma) ** 2)
        for name, normalised in trial.items():
            squares[name].append(float(np.mean(normalised)) - 1.0)
    off = [np.mean(each) / (np.std(each, ddof=1) / np.sqrt(len(each))) for each in squares.values()]
    assert np.abs(off).max() < norm.isf(1e-3 / len(off))
