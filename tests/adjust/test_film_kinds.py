"""The film transformations: formulas, derivatives, inverses, fits from marks, and networks of every kind."""

from dataclasses import replace
from itertools import combinations

import networks as nets
import numpy as np
import pytest
from dense_adjustment import DenseResult, solve_densely
from networks import halves, simulated
from numpy.typing import NDArray

from adjust import Adjustment, AdjustmentError, Fiducial, Network, Options, Parameter, Prior, adjust, approximate
from adjust.functional_model.transformation import Film, film_kind, fit_transformation
from adjust.problem.camera import FiducialDistance
from adjust.problem.network import Image, Transformation
from adjust.solution.adjustment import _reason
from adjust.solution.planning import plan

Array = NDArray[np.float64]

STEP = 1e-30
MIDDLE_MM = np.array([120.0, -110.0])
PLACES_MM = MIDDLE_MM + np.random.default_rng(1).uniform(-110.0, 110.0, (6, 2))


def make_parameters(kind: Transformation, mirrored: bool) -> Array:
    return nets.film_parameters(nets.Truth(middle_mm=(120.0, -110.0), mirrored=4 * (mirrored,)), 1, kind)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("kind", nets.KINDS)
def test_formulas_derivatives_by_complex_steps_and_inverses(kind: Transformation, mirrored: bool) -> None:
    formula, parameters = film_kind(kind, mirrored), make_parameters(kind, mirrored)
    expected = np.stack(nets.camera_of_film(kind, parameters, mirrored, *PLACES_MM.T), axis=1)
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
def test_no_folds(kind: Transformation, parameters: list[float], camera: list[list[float]], found: list[bool]) -> None:
    film = Film(kind, np.array(parameters, dtype=float), np.zeros(2))
    xy, regular = film.comparator_from_camera(np.array(camera, dtype=float))
    assert regular.tolist() == found
    np.testing.assert_allclose(film.camera_from_comparator(xy)[regular], np.array(camera)[regular], atol=1e-9)


@pytest.mark.parametrize(
    ("spelling", "words"),
    [
        ("helmert", ["no transformation 'helmert'"]),
        ("conformal", ["lacks its order", '"conformal(2)"']),
        ("polynomial(6)", ["order must be from 1 to 5"]),
        ("polynomial(0)", ["order must be from 1 to 5"]),
        ("bilinear(2)", ["no transformation 'bilinear(2)'"]),
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
    return parameters, comparator, np.stack(nets.camera_of_film(kind, parameters, mirrored, *comparator.T), axis=1)


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
def test_few_marks_give_a_similarity(kind: Transformation, simpler: Transformation, count: int, mirrored: bool) -> None:
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
SCANS = nets.Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


def exact_network(kind: Transformation, points: int, truth: nets.Truth | None = None) -> Network:
    rng = np.random.default_rng(4)
    return simulated(rng, truth, kind, nets.field_points(np.random.default_rng(5), points), noise=False)[0]


@pytest.mark.parametrize("kind", BENT)
def test_perfect_data_leave_nothing_and_give_the_truth_back(kind: Transformation) -> None:
    """Comparator coordinates from 5 to 235 mm, one scan mirrored; three marks more make eight."""
    network = exact_network(kind, 25, SCANS)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert np.abs(result.residuals.v_mm).max() < 1e-9
    for i in range(4):
        expected = nets.film_parameters(SCANS, i, kind)
        names = [name for name in result.names if name.startswith(f"T.f{i}.")]
        off = [abs(result.value(name) - value) for name, value in zip(names, expected, strict=True)]
        assert np.all(off <= np.array([1e-5 * result.sigma(name) / result.sigma0 for name in names]))
    assert result.mirrored == {"f1"}


@pytest.mark.parametrize("kind", [pytest.param("polynomial(3)", marks=pytest.mark.study), "polynomial(5)"])
def test_the_origin_of_the_comparator_does_not_matter(kind: Transformation) -> None:
    """A metre and a half off, as on a film strip; with exact observations, which are moved without a rounding."""
    network, _ = simulated(
        np.random.default_rng(4),
        nets.Truth(),
        "polynomial(3)",
        nets.field_points(np.random.default_rng(5), 40),
        noise=False,
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

    return nets.keep_rows(network, is_kept)


def test_an_image_without_targets_needs_all_marks_of_its_own() -> None:
    network, _ = simulated(np.random.default_rng(4), nets.Truth(), "projective", noise=False)
    with pytest.raises(AdjustmentError, match=r"image f2 shows 3 fiducial marks; its projective .* needs 4\. Measure"):
        approximate(add_marks(network, 3, ("f2",)))
    result = adjust(enough := add_marks(network, 4, ("f2",)), approximate(enough))
    assert result.converged


def test_a_film_that_folds_over_is_reported() -> None:
    network, start = simulated(np.random.default_rng(4), nets.Truth(), "polynomial(2)", noise=False)
    folded = start.transformation["f1"].copy()
    folded[3] = 0.02  # x' turns back at some 15 mm from the middle
    with pytest.raises(
        AdjustmentError, match=r"cannot start: .* polynomial\(2\) transformation of image f1 folds over"
    ):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": folded}))


SIGMA_MM = 0.004


def observe_distances(
    drawn: nets.DrawnFrames, rng: np.random.Generator, noise: float = 1.0, sigma_mm: float = np.inf
) -> nets.DrawnFrames:
    """Frames whose marks are given with a standard deviation, and all distances between them."""
    pairs = combinations(range(len(drawn.places_mm)), 2)
    distances = tuple(
        FiducialDistance(
            str(i + 1),
            str(j + 1),
            float(np.linalg.norm(drawn.places_mm[j] - drawn.places_mm[i]) + noise * SIGMA_MM * rng.standard_normal()),
            SIGMA_MM,
        )
        for i, j in pairs
    )
    network = nets.give_values(drawn.network, {"x": sigma_mm, "y": sigma_mm})
    return replace(drawn, network=nets.set_camera(network, distances=distances))


def solve_with_held_marks(network: Network, result: Adjustment) -> DenseResult:
    """The adjustment written out, with those coordinates held that the result holds."""
    fiducials = {}
    for id_, mark in network.cameras[0].fiducials.items():
        held = (result.sigma(Parameter.fiducial(nets.FILM_CAMERA, id_, axis)) == 0.0 for axis in "xy")
        x, y = (0.0 if is_held else np.inf for is_held in held)
        fiducials[id_] = Fiducial(Prior(mark.x_mm.value, x), Prior(mark.y_mm.value, y))
    return solve_densely(nets.set_camera(network, fiducials=fiducials), result)


@pytest.mark.parametrize(("marks", "kind"), [(4, "affine"), (8, "affine"), (4, "similarity"), (8, "similarity")])
def test_places_by_distances_are_those_of_the_adjustment_written_out(marks: int, kind: str) -> None:
    rng = np.random.default_rng(marks)
    drawn = observe_distances(nets.draw_frames(kind, 3, marks, 1.0, 0.05, rng), rng)
    result = adjust(drawn.network, drawn.start)
    assert result.converged
    dense = solve_with_held_marks(drawn.network, result)
    for name, sigma in dense.sigmas.items():
        assert result.value(name) == pytest.approx(dense.values[name], abs=1e-4 * sigma)
        assert result.sigma(name) == pytest.approx(result.sigma0 * sigma, rel=1e-4)
    unknowns = 2 * marks - 3 + 3 * (4 if kind == "similarity" else 6)
    redundancy = 3 * 2 * marks + marks * (marks - 1) // 2 - unknowns
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(redundancy, abs=1e-6)
    assert result.sigma0**2 * redundancy == pytest.approx(dense.vpv, rel=1e-5)
    assert result.groups["fiducial distance"].redundancy == pytest.approx(
        sum(row.redundancy for row in result.further if row.group == "fiducial distance")
    )


def test_a_plan_expects_the_form_of_the_distances_and_the_datum_of_the_coordinates() -> None:
    rng = np.random.default_rng(10)
    drawn = observe_distances(nets.draw_frames("affine", 3, 4, 1.0, 0.0, rng, 0.0), rng, 0.0, sigma_mm=1.0)
    planned, result = plan(drawn.network, drawn.start), adjust(drawn.network, drawn.start)
    parameters = [Parameter.fiducial(nets.FILM_CAMERA, str(i + 1), axis) for i in range(4) for axis in "xy"]
    form = np.array([[1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])  # x of the first less that of the second
    assert planned.sigmas(parameters, form)[0] == pytest.approx(SIGMA_MM * np.sqrt(3.0 / 4.0), rel=0.35)
    datum = np.sqrt(3.0 / 8.0)  # mm: two shifts and a turn of eight coordinates known to 1 mm
    np.testing.assert_allclose([planned.sigma(each) for each in parameters], datum, rtol=1e-3)
    redundancy = {row.name: row.redundancy for row in planned.adjustment.further}
    np.testing.assert_allclose(list(redundancy.values()), [row.redundancy for row in result.further], atol=1e-4)


def errors(halves: nets.Halves, adjustment: Adjustment) -> dict[str, np.ndarray]:
    """Errors over standard deviations of the joins, the films at their fiducials, and the orientations."""
    found: dict[str, list[float]] = {"joins": [], "orientations": []}
    for (frame, point), xy in halves.joins.items():
        for axis, true in zip("xy", xy, strict=True):
            name = f"JOIN.{frame}.{point}.{axis}"
            found["joins"].append((adjustment.value(name) - true) / adjustment.sigma(name))
    if adjustment.network.observed_points:
        for i in range(4):
            true = [*halves.truth.stations[i], *halves.truth.attitudes[i]]
            for element, value in zip(("X0", "Y0", "Z0", "omega", "phi", "kappa"), true, strict=True):
                name = f"EO.f{i}.{element}"
                found["orientations"].append((adjustment.value(name) - value) / adjustment.sigma(name))
    return {name: np.array(each) for name, each in found.items() if each}


def drop_targets(network: Network) -> Network:
    return nets.keep_rows(network, lambda image, point, kind: kind != "target")


def test_frames_without_any_target_are_joined_too() -> None:
    simulated = halves(np.random.default_rng(4))
    adjustment = adjust(replace(drop_targets(simulated.network), points=()))
    assert adjustment.converged
    assert adjustment.groups["join"].redundancy > 50.0
    assert 0.8 < np.sqrt(np.mean(errors(simulated, adjustment)["joins"] ** 2)) < 1.2


def test_points_as_blocks_give_what_frames_as_blocks_give() -> None:
    """With many unknown points these are eliminated first, and the frames' unknowns are what they share."""
    simulated = halves(np.random.default_rng(5), join_count=5, targets=120)
    points = tuple(
        point if int(point.id) < 6 else nets.set_sigma(point, nets.UNKNOWN) for point in simulated.network.points
    )
    adjustment = adjust(replace(simulated.network, points=points))
    assert 0.9 < np.sqrt(np.mean(errors(simulated, adjustment)["joins"] ** 2)) < 1.25
    assert 0.9 < adjustment.sigma0 < 1.1


def test_a_gross_error_of_a_join_is_found_and_named() -> None:
    network = halves(np.random.default_rng(7)).network
    error = {nets.observation_row(network, "join", "f1.right", "j4"): np.full(2, 20.0 * nets.JOIN_SIGMA)}
    (found,) = adjust(nets.add_errors(network, error), options=Options(snooping=True)).suspects
    assert found.tested.name in ("join j4 in image f1.right", "join j4 in image f1.left")


def test_scans_that_cannot_be_joined_are_refused() -> None:
    network = halves(np.random.default_rng(10)).network
    with pytest.raises(AdjustmentError, match=r"frame f0: its scan f0.right has 0 points in common with f0.left"):
        adjust(
            nets.keep_rows(network, lambda _, point, kind: kind == "fiducial" and point != "5")
        )  # which both halves show
    with pytest.raises(AdjustmentError, match=r"join j3 is observed in one scan of frame f0 only"):
        adjust(nets.keep_rows(network, lambda image, point, _: (image, point) != ("f0.left", "j3")))
    images = (replace(network.images[0], transformation="projective"), *network.images[1:])
    with pytest.raises(AdjustmentError, match=r"frame f0: its scans f0.left and f0.right differ"):
        adjust(replace(network, images=images))


def test_a_film_that_nothing_determines_is_named_with_its_frame() -> None:
    """All joins on one line, no mark in the right half: it can stretch across the line."""
    simulated = halves(np.random.default_rng(13), join_count=8, overlap_mm=1e-12, join_sigma=1e-12)
    network = replace(drop_targets(simulated.network), points=())
    adjustment = adjust(nets.keep_rows(network, lambda image, _, kind: (image, kind) != ("f0.right", "fiducial")))
    assert not adjustment.converged
    assert any("f0" in each.cause and "scans" in each.cause for each in adjustment.singular), adjustment.singular


def test_the_mark_that_a_diverging_frame_in_parts_is_named_with_is_the_largest_of_its_scans() -> None:
    network = nets.halves(np.random.default_rng(3), join_count=25).network
    stopped = replace(adjust(network), termination="diverged")
    lengths = np.linalg.norm(stopped.residuals.v_mm, axis=1)
    observations = stopped.network.observations
    lengths[[not image.startswith("f2.") for image in observations.image]] = 0.0
    row = int(lengths.argmax())
    sentence = _reason(stopped, stopped, ["f2"])
    assert f"The largest residual there is that of {observations.point[row]} in {observations.image[row]}." in sentence
