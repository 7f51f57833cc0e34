"""Film transformations from marks, against the transformations that were applied."""

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import Truth, camera_of_film, film_parameters

from adjust.functional_model.transformation import film_kind
from adjust.initial_values.fiducial_fit import fit_transformation
from adjust.problem.network import Transformation

Array = NDArray[np.float64]

MARKS_MM = 106.0 * np.array([(1, -1), (-1, -1), (-1, 1), (1, 1), (0, -1), (-1, 0), (0, 1), (1, 0)])
RESEAU_MM = 50.0 * np.array([(x, y) for x in range(-2, 3) for y in range(-2, 3)])


def view_marks(kind: Transformation, mirrored: bool, marks_mm: Array) -> tuple[Array, Array, Array]:
    """The transformation's parameters, marks in a scan about (120, -110) mm, and where they are in the camera."""
    parameters = film_parameters(Truth(middle_mm=(120.0, -110.0), mirrored=4 * (mirrored,)), 1, kind)
    comparator = [120.0, -110.0] + marks_mm[:, ::-1] + np.random.default_rng(1).uniform(-1.0, 1.0, marks_mm.shape)
    return parameters, comparator, np.stack(camera_of_film(kind, parameters, mirrored, *comparator.T), axis=1)


@pytest.mark.parametrize(
    "kind",
    ["congruent", "similarity", "affine", "projective", "bilinear", "conformal(2)", "conformal(3)", "polynomial(2)"],
)
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("wrong", [(), (2,), (1, 6)], ids=["clean", "one gross error", "two exchanged"])
def test_the_applied_transformation_is_found(kind: Transformation, mirrored: bool, wrong: tuple[int, ...]) -> None:
    """Eight marks can tell two wrong ones from eight parameters; twenty-five from twelve."""
    parameters, comparator, camera = view_marks(kind, mirrored, RESEAU_MM if kind == "polynomial(2)" else MARKS_MM)
    if wrong:
        camera[list(wrong)] = camera[list(reversed(wrong))] if len(wrong) > 1 else camera[list(wrong)] + 20.0
    found, is_mirrored = fit_transformation(kind, comparator, camera)
    np.testing.assert_allclose(found, parameters, rtol=1e-9, atol=1e-7)
    fitted = film_kind(kind, is_mirrored).apply(found, comparator)
    right = [i for i in range(len(comparator)) if i not in wrong]
    np.testing.assert_allclose(fitted[right], camera[right], atol=1e-9)
    assert is_mirrored == mirrored


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(
    ("kind", "simpler", "count"),
    [
        ("projective", "affine", 3),
        ("bilinear", "affine", 3),
        ("conformal(3)", "conformal(2)", 3),
        ("polynomial(3)", "polynomial(2)", 8),
        ("polynomial(3)", "affine", 4),
    ],
)
def test_few_marks_give_the_simpler_transformation(
    kind: Transformation, simpler: Transformation, count: int, mirrored: bool
) -> None:
    """In the parameters of the one that was asked for."""
    _, comparator, camera = view_marks(simpler, mirrored, MARKS_MM[:count])
    found, is_mirrored = fit_transformation(kind, comparator, camera)
    np.testing.assert_allclose(film_kind(kind, is_mirrored).apply(found, comparator), camera, atol=1e-9)
    plain, _ = fit_transformation(simpler, comparator, camera)
    far = comparator + 200.0
    expected = film_kind(simpler, mirrored).apply(plain, far)
    np.testing.assert_allclose(film_kind(kind, is_mirrored).apply(found, far), expected, atol=1e-8)
    assert is_mirrored == mirrored


def test_marks_in_bad_places_give_a_tame_transformation() -> None:
    """Four marks on the axes tell nothing of the bilinear term in xy."""
    comparator = 113.0 * np.array([(0.0, -1.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0)])
    found, _ = fit_transformation("bilinear", comparator, comparator + 5.0)
    np.testing.assert_allclose(found, [5, 1, 0, 0, 5, 0, 1, 0], atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_marks_on_a_line_do_not_tell_a_mirror(seed: int) -> None:
    comparator = np.array([(-106.0, 0.0), (0.0, 0.0), (106.0, 0.0)])
    camera = comparator + 5.0 + np.random.default_rng(seed).normal(0.0, 0.004, (3, 2))
    found, mirrored = fit_transformation("similarity", comparator, camera)
    assert not mirrored
    np.testing.assert_allclose(found, [5.0, 5.0, 1.0, 0.0], atol=0.02)


@pytest.mark.parametrize("mirrored", [False, True])
def test_film_that_shrank_unevenly_is_distinguished_from_a_mirror(mirrored: bool) -> None:
    """By three tenths of a per cent, as no similarity fits, upright or mirrored, and with a mark 0.08 mm off."""
    camera = MARKS_MM @ [[1.003, 0.0], [0.0, 1.0]] + np.random.default_rng(3).normal(0.0, 0.005, MARKS_MM.shape)
    camera[4, 0] += 0.08
    comparator = [120.0, -110.0] + MARKS_MM * ((-1.0, 1.0) if mirrored else (1.0, 1.0))
    assert fit_transformation("affine", comparator, camera)[1] == mirrored


@pytest.mark.parametrize("seed", range(6))
def test_a_bent_line_of_marks_does_not_tell_a_mirror(seed: int) -> None:
    """Along it film differs from a similarity by more than marks do, across it there is but noise."""
    generator = np.random.default_rng(seed)
    along = np.linspace(-100.0, 100.0, 8)
    comparator = np.stack([along, generator.normal(0.0, 0.01, 8)], axis=1)
    camera = np.stack([along + 0.1 * (along / 100.0) ** 3, generator.normal(0.0, 0.01, 8)], axis=1)
    assert not fit_transformation("affine", comparator, camera)[1]


def test_small_residuals_are_no_gross_errors() -> None:
    rng = np.random.default_rng(2)
    comparator = MARKS_MM + rng.normal(0.0, 0.005, MARKS_MM.shape)
    found, _ = fit_transformation("affine", comparator, MARKS_MM)
    design = np.column_stack([np.ones(8), comparator])
    least_squares = np.linalg.lstsq(design, MARKS_MM)[0]
    np.testing.assert_allclose(found, [*least_squares[:, 0], *least_squares[:, 1]], atol=1e-9)


def test_none_has_no_parameters() -> None:
    found, mirrored = fit_transformation("none", np.zeros((0, 2)), np.zeros((0, 2)))
    assert found.shape == (0,)
    assert not mirrored
