"""The film transformations by themselves: formulas, derivatives, inverses, spelling."""

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import KINDS, Truth, camera_of_film, film_parameters

from adjust.functional_model.transformation import (
    HIGHEST_ORDER,
    Film,
    fewest_marks,
    film_kind,
    film_parameter_names,
    marks_needed,
)
from adjust.problem.network import Image, Transformation

Array = NDArray[np.float64]

STEP = 1e-30
ONE = np.ones(())
MIDDLE_MM = np.array([120.0, -110.0])
PLACES_MM = MIDDLE_MM + np.random.default_rng(1).uniform(-110.0, 110.0, (6, 2))
mirrors = pytest.mark.parametrize("mirrored", [False, True])
all_kinds = pytest.mark.parametrize("kind", KINDS)


def make_parameters(kind: Transformation, mirrored: bool) -> Array:
    return film_parameters(Truth(middle_mm=(120.0, -110.0), mirrored=4 * (mirrored,)), 1, kind)


@mirrors
@all_kinds
def test_the_formulas(kind: Transformation, mirrored: bool) -> None:
    parameters = make_parameters(kind, mirrored)
    expected = np.stack(camera_of_film(kind, parameters, mirrored, *PLACES_MM.T), axis=1)
    np.testing.assert_allclose(film_kind(kind, mirrored).apply(parameters, PLACES_MM), expected, rtol=1e-13)


@mirrors
@all_kinds
def test_derivatives_by_complex_steps(kind: Transformation, mirrored: bool) -> None:
    formula, parameters = film_kind(kind, mirrored), make_parameters(kind, mirrored)
    gradient = formula.gradient(parameters, PLACES_MM)
    design = formula.design(parameters, PLACES_MM, np.zeros(2), ONE)
    for axis in (0, 1):
        stepped = formula.apply(parameters, PLACES_MM + 1j * STEP * np.eye(2)[axis]).imag / STEP
        np.testing.assert_allclose(gradient[..., axis], stepped, rtol=0, atol=1e-13)
    for k in range(len(parameters)):
        stepped = formula.apply(parameters + 1j * STEP * np.eye(len(parameters))[k], PLACES_MM).imag / STEP
        np.testing.assert_allclose(design[..., k], stepped, rtol=0, atol=1e-13 * np.abs(stepped).max())


@mirrors
@pytest.mark.parametrize("kind", [*KINDS, f"conformal({HIGHEST_ORDER})", f"polynomial({HIGHEST_ORDER})"])
def test_centred_parameters_are_those_of_the_formula_about_the_middle(kind: Transformation, mirrored: bool) -> None:
    """What they move, through the parameters as reported, is their own design; and that design is well conditioned."""
    formula = film_kind(kind, mirrored)
    rng = np.random.default_rng(2)
    parameters = rng.uniform(-1.0, 1.0, len(formula.names)) * 1e-3
    half = np.asarray(110.0)
    places = MIDDLE_MM + rng.uniform(-110.0, 110.0, (60, 2))
    centred = formula.design(parameters, places, MIDDLE_MM, half)
    back = formula.centred_jacobian(parameters, MIDDLE_MM, half)
    raw = formula.design(parameters, places, np.zeros(2), ONE)
    np.testing.assert_allclose(raw @ back, centred, rtol=0, atol=1e-10)
    if parameters.size and kind != "projective":
        flat = centred.reshape(-1, len(parameters))
        assert np.linalg.cond(flat / np.linalg.norm(flat, axis=0)) < 100.0


@mirrors
@all_kinds
def test_the_inverse_leads_back(kind: Transformation, mirrored: bool) -> None:
    film = Film(kind, make_parameters(kind, mirrored), MIDDLE_MM, mirrored)
    back, found = film.comparator_from_camera(film.camera_from_comparator(PLACES_MM))
    assert found.all()
    np.testing.assert_allclose(back, PLACES_MM, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("kind", "parameters", "camera", "found"),
    [
        ("projective", [0, 1, 0, 0, 0, 1, 1e-3, 0], [[500, 0], [1500, 0]], [True, False]),  # x' nears 1000 mm, no more
        ("bilinear", [0, 1, 0, 0, 0, 0, 1, 5e-3], [[-50, 1], [-300, 1]], [True, False]),  # y' = y (1 + x / 200)
        ("polynomial(2)", [0, 1, 0, -2e-3, 0, 0, 0, 0, 1, 0, 0, 0], [[100, 5], [130, 5]], [True, False]),  # x' < 125
        ("conformal(2)", [0, 0, 1, 0, -2e-3, 0], [[100, 0], [-100, 0]], [True, True]),
        ("affine", [0, 1, 2, 0, 2, 4], [[1, 2]], [False]),
    ],
)
def test_what_folds_over_is_not_found(
    kind: Transformation, parameters: list[float], camera: list[list[float]], found: list[bool]
) -> None:
    film = Film(kind, np.array(parameters, dtype=float), np.zeros(2))
    xy, regular = film.comparator_from_camera(np.array(camera, dtype=float))
    assert regular.tolist() == found
    np.testing.assert_allclose(film.camera_from_comparator(xy)[regular], np.array(camera)[regular], atol=1e-9)


def test_numbers_of_parameters_and_marks() -> None:
    counts = {kind: (len(film_parameter_names(kind)), marks_needed(kind), fewest_marks(kind)) for kind in KINDS}
    assert counts == {
        "none": (0, 0, 0),
        "congruent": (3, 2, 2),
        "similarity": (4, 2, 2),
        "affine": (6, 3, 3),
        "projective": (8, 4, 3),
        "bilinear": (8, 4, 3),
        "conformal(1)": (4, 2, 2),
        "conformal(2)": (6, 3, 2),
        "conformal(3)": (8, 4, 2),
        "polynomial(1)": (6, 3, 3),
        "polynomial(2)": (12, 6, 3),
        "polynomial(3)": (20, 10, 3),
    }
    assert film_parameter_names("projective") == ("a1", "a2", "a3", "b1", "b2", "b3", "c1", "c2")


@pytest.mark.parametrize(
    ("spelling", "words"),
    [
        ("helmert", ['no transformation "helmert"']),
        ("conformal", ["lacks its order", '"conformal(2)"']),
        ("polynomial(6)", ["order must be from 1 to 5"]),
        ("polynomial(0)", ["order must be from 1 to 5"]),
        ("bilinear(2)", ['no transformation "bilinear(2)"']),
    ],
)
def test_a_wrong_spelling_is_reported_what_is_possible(spelling: str, words: list[str]) -> None:
    with pytest.raises(ValueError, match=r"possible are none, congruent, .* projective, bilinear, conformal") as caught:
        Image("f1", "K", spelling)
    assert all(word in str(caught.value) for word in words)
