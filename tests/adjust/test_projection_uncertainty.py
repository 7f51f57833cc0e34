"""The covariance of projected points, image clusters and unmodelled errors, against simulated calibrations."""

import re
from collections.abc import Callable
from dataclasses import replace

import networks as nets
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from adjust import Adjustment, AdjustmentError, Distortion, Options, Parameter, Prior, adjust, approximate
from adjust.functional_model.rotation import rotation_from_vector
from adjust.problem.estimates import adjusted_image, adjusted_lens
from adjust.problem.network import Approximations, Board, Network
from adjust.quality.lens_uncertainty import projection_uncertainty
from adjust.solution.adjustment import adjust_unmodelled

Array = NDArray[np.float64]

PIXEL_MM = 0.005
FREE = Prior(0.0, np.inf)
MRCAL_PX = np.array([(-20.0, -20.0), (0, 0), (320, 240), (100, 100), (600, 50), (639, 479), (300, 420), (50, 240)])
MRCAL_SIGMA_PX = {  # mrcal 2.5.2, "cross-reprojection-rrp-Jfp", LENSMODEL_OPENCV4 and a bent board, the same pictures
    np.inf: (3.7571, 2.3593, 0.0590, 0.3118, 0.5585, 1.8466, 0.1919, 0.3391),
    350.0: (3.6885, 2.2856, 0.0081, 0.1025, 0.4495, 1.7881, 0.0281, 0.1398),
    100.0: (3.8035, 2.4542, 0.1481, 0.7051, 0.8537, 1.9850, 0.4989, 0.7488),
}
BOARD_MM = np.array([(1.6, -1.2), (0.3, -0.4), (2.8, -2.0), (1.6, -0.3), (0.6, -1.8)])
FILM_MM = np.array([(0.0, 0.0), (70.0, 60.0), (-80.0, 40.0), (20.0, -90.0), (-60.0, -60.0)])


def test_it_is_what_mrcal_says_of_the_same_pictures() -> None:
    network = nets.board_network(np.random.default_rng(3), 12, 5e-4)
    lens = Distortion("opencv", dict.fromkeys(("k1", "k2", "p1", "p2", "b1"), FREE))
    places = {each.id: np.array([each.X.value, each.Y.value, 0.0]) for each in network.points if each.X and each.Y}
    result = adjust(replace(nets.set_camera(network, distortion=lens), boards=(Board("b", places),)))
    for distance, sigma_px in MRCAL_SIGMA_PX.items():
        found = result.projection_uncertainty("desk", distance, MRCAL_PX * PIXEL_MM * [1.0, -1.0])
        np.testing.assert_allclose(found.sigma_model_mm / PIXEL_MM, sigma_px, rtol=2e-3, atol=6e-5)


Projection = Callable[[Array], Array]


def places_after_alignment(projected: Projection, in_camera: Array, fitted: Array, fixed: Array) -> Array:
    """Where fixed points (n, 3) in the true camera's axes are projected, for the turn and shift of the camera by which
    the points in_camera (m, 3) come nearest to where they were fitted (m, 2)."""

    scale = float(np.abs(in_camera).max())

    def shift(vector: Array, points: Array) -> Array:
        return projected(points @ rotation_from_vector(vector[:3]).T + scale * vector[3:])

    def misses(vector: Array) -> Array:
        return (shift(vector, in_camera) - fitted).ravel()

    return shift(np.asarray(least_squares(misses, np.zeros(6), method="lm").x), fixed)


def board_sample(
    rng: np.random.Generator, true: Adjustment, start: Approximations, distance: float
) -> tuple[Array, Array, Array]:
    """Claimed covariances of places on the board's pictures, where these are projected, and where they are."""
    network = true.network
    noise = 5e-4 * rng.normal(size=network.observations.xy_mm.shape)
    result = adjust(nets.set_observations(network, xy_mm=network.observations.xy_mm + noise), start)
    xyz = np.array([[getattr(each, axis).value for axis in "XYZ"] for each in network.points])
    models = [(adjusted_image(true, each.name), adjusted_image(result, each.name)) for each in network.images]
    in_camera = np.concatenate([(xyz - model.station) @ model.rotation.T for model, _ in models])
    fitted = np.concatenate([model.camera_from_object(xyz)[0] for _, model in models])
    ray, _ = adjusted_lens(true, "desk").ray_from_observed(BOARD_MM)
    where = places_after_alignment(projection(result, "desk"), in_camera, fitted, points_along(ray, distance))
    return result.projection_uncertainty("desk", distance, BOARD_MM).covariance_mm2, where, BOARD_MM


def projection(result: Adjustment, camera: str) -> Projection:
    lens = adjusted_lens(result, camera)
    return lambda points: lens.camera_from_ray(-points[:, :2] / points[:, 2:])[0]


def points_along(ray: Array, distance: float) -> Array:
    """(n, 3) at a distance along rays (n, 2), or so far that a shift shows nothing."""
    direction = np.column_stack([ray, -np.ones(len(ray))])
    return np.asarray(min(distance, 1e9) * direction / np.linalg.norm(direction, axis=1)[:, None])


def spread(samples: list[tuple[Array, Array, Array]]) -> float:
    """The root mean square of errors over what is claimed of them, of all places and both coordinates."""
    ratios = [
        error @ np.linalg.solve(covariance, error)
        for claimed, where, places in samples
        for covariance, error in zip(claimed, where - places, strict=True)
    ]
    return float(np.sqrt(np.mean(ratios) / 2.0))


def true_board(images: int) -> Adjustment:
    return adjust(nets.board_network(np.random.default_rng(11), images, 0.0, given_mm=5e-4))


def test_simulated_calibrations_scatter_as_it_says() -> None:
    rng, true = np.random.default_rng(5), true_board(4)
    start = approximate(true.network)
    assert 0.7 < spread([board_sample(rng, true, start, 350.0) for _ in range(6)]) < 1.3


@pytest.mark.study
@pytest.mark.parametrize("distance", [np.inf, 350.0, 150.0])
def test_three_hundred_boards_scatter_as_it_says(distance: float) -> None:
    rng, true = np.random.default_rng(6), true_board(6)
    start = approximate(true.network)
    assert 0.95 < spread([board_sample(rng, true, start, distance) for _ in range(300)]) < 1.05


def test_the_datum_of_the_marks_has_no_part_in_it() -> None:
    rng, truth = np.random.default_rng(4), nets.Truth()
    lens = dict.fromkeys(truth.distortion, np.inf)
    result = adjust(*nets.simulated(rng, truth, points=nets.field_points(rng, 20), free=lens))
    found = projection_uncertainty(result, result.cluster_covariance_of, "K", 1500.0, FILM_MM)
    assert result.sigma(Parameter.interior("K", "x0")) > 0.3
    assert found.sigma_model_mm.max() < 0.01
    assert found.sigma_clusters_mm is not None
    assert 0.3 < np.median(found.sigma_clusters_mm / found.sigma_model_mm) < 2.0


def test_it_covers_the_picture_and_stops_where_the_lens_does() -> None:
    result = true_board(4)
    found = result.projection_uncertainty()
    assert found.places_mm.shape == (25, 33, 2)
    np.testing.assert_allclose(found.places_mm[[0, -1], [0, -1]], [(0.0, 0.0), (3.2, -2.4)])
    assert 300 < found.median_distance < 450
    assert np.isfinite(found.sigma_mm).all()
    folding = adjust(nets.set_camera(result.network, distortion=Distortion("opencv", {"k1": FREE})))
    far = folding.projection_uncertainty(places_mm=np.array([(nets.BOARD_TRUTH["x0"] + 9.0, 0.0)]))
    assert np.isnan(far.sigma_mm).all()


def test_the_larger_of_both_standard_deviations_is_shown_where_errors_are_unmodelled() -> None:
    network = nets.board_network(np.random.default_rng(3), 6, 5e-4, given_mm=1e-4)
    found = adjust_unmodelled(network).projection_uncertainty()
    assert found.sigma_clusters_mm is not None
    assert adjust(network).projection_uncertainty().sigma_clusters_mm is None
    np.testing.assert_array_equal(found.sigma_mm, np.maximum(found.sigma_model_mm, found.sigma_clusters_mm))


@pytest.mark.parametrize(
    ("camera", "distance", "message"),
    [("desks", 1.0, "There is no calibrated camera 'desks'. Name one of: desk"), ("", 0.0, "must be positive")],
)
def test_what_cannot_be_projected_is_stated(camera: str, distance: float, message: str) -> None:
    with pytest.raises(AdjustmentError, match=message):
        true_board(4).projection_uncertainty(camera, distance)


def test_the_frame_of_film_lies_about_its_middle() -> None:
    rng = np.random.default_rng(2)
    network, start = nets.simulated(rng)
    found = adjust(
        nets.set_camera(network, frame_mm=(2 * nets.HALF_MM, 2 * nets.HALF_MM)), start
    ).projection_uncertainty()
    np.testing.assert_allclose(found.places_mm[0, 0], (-nets.HALF_MM, nets.HALF_MM))


QUANTITIES = ("c", "x0", "y0", "k1", "k2")


def scatter(result: Adjustment) -> np.ndarray:
    covariance = result.cluster_covariance_of([Parameter.interior("desk", each) for each in (*QUANTITIES, "p1")])
    assert covariance is not None
    assert not covariance[-1].any()  # what is fixed
    return np.asarray(np.sqrt(np.diagonal(covariance)))[:-1]


def drop_image(network: Network, image: str) -> Network:
    left = nets.keep_rows(network, lambda name, *_: name != image)
    return replace(left, images=tuple(each for each in network.images if each.name != image))


def values(result: Adjustment) -> list[float]:
    return [result.value(Parameter.interior("desk", each)) for each in QUANTITIES]


def test_it_is_the_jackknife_of_adjustments_without_one_picture_each() -> None:
    """Drawn towards the common ratio to the model's variances, by 4 degrees of freedom against 5."""
    network = nets.board_network(np.random.default_rng(3), 6, 5e-4)
    left = np.array([values(adjust(drop_image(network, image.name))) for image in network.images])
    variances = 5 / 6 * ((left - left.mean(axis=0)) ** 2).sum(axis=0)
    result = adjust(network)
    model = np.array([result.sigma(Parameter.interior("desk", each)) ** 2 for each in QUANTITIES])
    common = model * np.exp(np.log(np.maximum(variances / model, 1.0)).mean())
    np.testing.assert_allclose(scatter(result), np.sqrt((5 * variances + 4 * common) / 9), rtol=0.03)


def test_standard_deviations_from_four_pictures_cover_errors_of_each_picture() -> None:
    """A smooth error of its own in each picture, up to some µm: by the model alone claims are 4 times too small."""
    keys = [Parameter.interior("desk", each) for each in ("c", "x0", "y0")]
    errors = list[np.ndarray]()
    for seed in range(8):
        rng = np.random.default_rng(seed)
        network = nets.board_network(rng, 4, 1e-4)
        xy_mm, width_mm = network.observations.xy_mm.copy(), nets.BOARD_FRAME_MM[0]
        for image in network.images:
            rows = np.array(network.observations.image) == image.name
            place = xy_mm[rows] * (2.0 / width_mm) - [1.0, -nets.BOARD_FRAME_MM[1] / width_mm]
            terms = np.column_stack([place**2, place[:, 0] * place[:, 1], place**3])
            xy_mm[rows] += 2e-3 * terms @ rng.normal(size=(5, 2))
        result = adjust_unmodelled(nets.set_observations(network, xy_mm=xy_mm))
        claims = np.sqrt(np.diagonal(result.larger_covariance_of(keys)))
        errors.append((result.values_of(keys) - [nets.BOARD_TRUTH[each.quantity] for each in keys]) / claims)
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.4


def test_prediction_errors_are_those_of_adjustments_without_a_fold() -> None:
    """Each picture is oriented anew by the camera of the others, held fixed."""
    network = nets.board_network(np.random.default_rng(3), 6, 5e-4)
    predicted = adjust(network).prediction_errors(3)
    assert predicted is not None
    names = [image.name for image in network.images]
    for fold in (names[first::3] for first in range(3)):
        fitted = values(adjust(drop_image(drop_image(network, fold[0]), fold[1])))
        priors = {name: Prior(value, 0.0) for name, value in zip(QUANTITIES, fitted, strict=True)}
        lens = Distortion("opencv", {name: priors[name] for name in ("k1", "k2")})
        interior = {"principal_distance_mm": priors["c"], "x0_mm": priors["x0"], "y0_mm": priors["y0"]}
        for name in fold:
            one = nets.set_camera(network, **interior, distortion=lens)
            for each in one.images:
                one = one if each.name == name else drop_image(one, each.name)
            squares = (adjust(one).residuals.v_mm ** 2).sum(axis=1) / 5e-4**2
            assert predicted[names.index(name)] == pytest.approx(squares.mean(), rel=0.01)


def test_two_pictures_tell_no_scatter() -> None:
    result = adjust(nets.board_network(np.random.default_rng(1), 2, 5e-4))
    assert result.cluster_covariance_of([Parameter.interior("desk", "c")]) is None
    assert result.value(Parameter.interior("desk", "c")) == pytest.approx(2.7, abs=0.02)


@pytest.mark.parametrize(("given_mm", "unmodelled_mm", "sigma0"), [(1e-4, 4.9e-4, 1.0), (6e-4, 0.0, 5 / 6)])
def test_it_is_what_the_marks_err_by_beyond_what_is_given(given_mm: float, unmodelled_mm: float, sigma0: float) -> None:
    """Of errors of 0.5 µm: what is left is known to 3 % from 550 redundant coordinates."""
    result = adjust_unmodelled(nets.board_network(np.random.default_rng(5), 6, 5e-4, given_mm=given_mm))
    assert result.unmodelled_mm == {"desk": pytest.approx(unmodelled_mm, rel=0.09)}
    assert result.sigma0 == pytest.approx(sigma0, rel=0.09)


def test_a_board_small_in_the_picture_is_adjusted() -> None:
    """One of a fortieth of the frame had been refused: the first unmodelled error was 5 % of the board."""
    network = nets.set_camera(nets.board_network(np.random.default_rng(5), 6, 1e-4), frame_mm=(40.0, 30.0))
    result = adjust_unmodelled(network)
    assert result.value(Parameter.interior("desk", "c")) == pytest.approx(nets.BOARD_TRUTH["c"], abs=0.002)


def test_what_is_wrong_with_a_picture_is_no_unmodelled_error_that_passes() -> None:
    """One of eight pictures is mirrored: that is refused, or said, and not taken for a lens that is a little poor."""
    network = nets.board_network(np.random.default_rng(7), 8, 5e-4, given_mm=1e-4)
    xy_mm = network.observations.xy_mm.copy()
    rows = [row for row, image in enumerate(network.observations.image) if image == "i3"]
    xy_mm[rows, 0] = nets.BOARD_FRAME_MM[0] - xy_mm[rows, 0]
    try:
        text = " ".join(adjust_unmodelled(nets.set_observations(network, xy_mm=xy_mm)).warnings)
    except AdjustmentError as error:
        text = str(error)
    assert "i3" in text
    assert "mirrored" in text


def test_an_implausible_one_is_a_warning() -> None:
    """Errors of 5 µm, a part in 800 of the diagonal of 4 mm: no lens leaves so much."""
    network = nets.board_network(np.random.default_rng(9), 6, 5e-3, given_mm=1e-4)
    for pixel_mm, size in ((None, r"[45](\.\d+)? µm"), (0.01, r"0\.[45]\d* px")):
        words = rf"errors of {size} are not modelled, one part in [78]\d\d of"
        assert any(re.search(words, warning) for warning in adjust_unmodelled(network, pixel_mm=pixel_mm).warnings)


def test_without_a_solution_no_unmodelled_error_is_claimed() -> None:
    """The first value, a thousandth of the frame's diagonal, was told as one."""
    network = nets.board_network(np.random.default_rng(5), 6, 5e-4, given_mm=1e-4)
    result = adjust_unmodelled(network, Options(iteration_limit=1))
    assert not result.converged
    assert not any("not modelled" in warning for warning in result.warnings)
