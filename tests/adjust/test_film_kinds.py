"""The film transformations: formulas, derivatives, inverses, fits from marks, and networks of every kind."""

from dataclasses import replace

import numpy as np
import pytest
from networks import (
    KINDS,
    Truth,
    camera_of_film,
    field_points,
    film_parameters,
    keep_rows,
    simulated,
)
from numpy.typing import NDArray

from adjust import AdjustmentError, adjust, approximate
from adjust.functional_model.transformation import (
    Film,
    film_kind,
    fit_transformation,
)
from adjust.problem.network import Image, Network, Transformation

Array = NDArray[np.float64]

STEP = 1e-30
MIDDLE_MM = np.array([120.0, -110.0])
PLACES_MM = MIDDLE_MM + np.random.default_rng(1).uniform(-110.0, 110.0, (6, 2))


def make_parameters(kind: Transformation, mirrored: bool) -> Array:
    return film_parameters(Truth(middle_mm=(120.0, -110.0), mirrored=4 * (mirrored,)), 1, kind)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_formulas_derivatives_by_complex_steps_and_inverses(kind: Transformation, mirrored: bool) -> None:
    formula, parameters = film_kind(kind, mirrored), make_parameters(kind, mirrored)
    expected = np.stack(camera_of_film(kind, parameters, mirrored, *PLACES_MM.T), axis=1)
    np.testing.assert_allclose(formula.apply(parameters, PLACES_MM), expected, rtol=1e-13)
    film = Film(kind, parameters, MIDDLE_MM, mirrored)
    gradient, design = formula.gradient(parameters, PLACES_MM), film.design(PLACES_MM)
    for axis in (0, 1):
        stepped = formula.apply(parameters, PLACES_MM + 1j * STEP * np.eye(2)[axis]).imag / STEP
        np.testing.assert_allclose(gradient[..., axis], stepped, rtol=0, atol=1e-13)
    for k in range(len(parameters)):
        stepped = formula.apply(parameters + 1j * STEP * np.eye(len(parameters))[k], PLACES_MM).imag / STEP
        np.testing.assert_allclose(design[..., k], stepped, rtol=0, atol=1e-13 * np.abs(stepped).max())
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


MARKS_MM = 106.0 * np.array([(1, -1), (-1, -1), (-1, 1), (1, 1), (0, -1), (-1, 0), (0, 1), (1, 0)])
RESEAU_MM = 50.0 * np.array([(x, y) for x in range(-2, 3) for y in range(-2, 3)])


def view_marks(kind: Transformation, mirrored: bool, marks_mm: Array) -> tuple[Array, Array, Array]:
    """The transformation's parameters, marks in a scan about (120, -110) mm, and where they are in the camera."""
    parameters = make_parameters(kind, mirrored)
    comparator = MIDDLE_MM + marks_mm[:, ::-1] + np.random.default_rng(1).uniform(-1.0, 1.0, marks_mm.shape)
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


BENT = ["projective", "bilinear", "conformal(2)", "conformal(3)", "polynomial(2)", "polynomial(3)"]
SCANS = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


def exact_network(kind: Transformation, points: int, truth: Truth | None = None) -> Network:
    rng = np.random.default_rng(4)
    return simulated(rng, truth, kind, field_points(np.random.default_rng(5), points), noise=False)[0]


@pytest.mark.parametrize("kind", BENT)
def test_perfect_data_leave_nothing_and_give_the_truth_back(kind: Transformation) -> None:
    """Comparator coordinates from 5 to 235 mm, one scan mirrored; three marks more make eight."""
    network = exact_network(kind, 25, SCANS)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert np.abs(result.residuals.v_mm).max() < 1e-9
    for i in range(4):
        expected = film_parameters(SCANS, i, kind)
        names = [name for name in result.names if name.startswith(f"T.f{i}.")]
        off = [abs(result.value(name) - value) for name, value in zip(names, expected, strict=True)]
        assert np.all(off <= np.array([1e-5 * result.sigma(name) / result.sigma0 for name in names]))
    assert result.mirrored == {"f1"}


@pytest.mark.parametrize("kind", [pytest.param("polynomial(3)", marks=pytest.mark.study), "polynomial(5)"])
def test_the_origin_of_the_comparator_does_not_matter(kind: Transformation) -> None:
    """A metre and a half off, as on a film strip; with exact observations, which are moved without a rounding."""
    network, _ = simulated(
        np.random.default_rng(4), Truth(), "polynomial(3)", field_points(np.random.default_rng(5), 40), noise=False
    )
    network = replace(network, images=tuple(replace(image, transformation=kind) for image in network.images))
    observations = network.observations
    moved = replace(network, observations=replace(observations, xy_mm=observations.xy_mm + 1500.0))
    results = [adjust(each, approximate(each)) for each in (network, moved)]
    for result in results:
        assert result.converged
        assert np.abs(result.residuals.v_mm).max() < 1e-10
    for name in ("IO.K.c", "IO.K.x0", "FID.K.3.y", "EO.f2.omega"):
        near, far = (result.sigma(name) / result.sigma0 for result in results)
        assert far == pytest.approx(near, rel=1e-9)


@pytest.mark.parametrize(("kind", "marks"), [("projective", 3), ("bilinear", 3), ("conformal(3)", 2)])
def test_targets_determine_what_too_few_marks_leave_open(kind: Transformation, marks: int) -> None:
    network = add_marks(exact_network(kind, 25), marks)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert result.warnings == (
        f"Image f0 shows {marks} fiducial marks, and its {kind} transformation takes 4 of its own: the targets "
        f"determine the rest of it. 3 more images are alike.",
    )


def add_marks(network: Network, count: int, images_of_marks_alone: tuple[str, ...] = ()) -> Network:
    """The network with the first marks only, and some images without targets."""

    def is_kept(image: str, point: str, kind: str) -> bool:
        return int(point) <= count if kind == "fiducial" else image not in images_of_marks_alone

    return keep_rows(network, is_kept)


def test_an_image_without_targets_needs_all_marks_of_its_own() -> None:
    network, _ = simulated(np.random.default_rng(4), Truth(), "projective", noise=False)
    with pytest.raises(AdjustmentError, match=r"image f2 shows 3 fiducial marks; its projective .* needs 4\. Measure"):
        approximate(add_marks(network, 3, ("f2",)))
    result = adjust(enough := add_marks(network, 4, ("f2",)), approximate(enough))
    assert result.converged


def test_a_film_that_folds_over_is_reported() -> None:
    network, start = simulated(np.random.default_rng(4), Truth(), "polynomial(2)", noise=False)
    folded = start.transformation["f1"].copy()
    folded[3] = 0.02  # x' turns back at some 15 mm from the middle
    with pytest.raises(
        AdjustmentError, match=r"cannot start: .* polynomial\(2\) transformation of image f1 folds over"
    ):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": folded}))
