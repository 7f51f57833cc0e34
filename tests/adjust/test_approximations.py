"""Initial values without any approximation from the user, and what poor ones lead to."""

from dataclasses import replace

import numpy as np
import pytest
from networks import (
    CONVERGENT_STATIONS,
    VERTICAL_STATIONS,
    Projected,
    Truth,
    field_points,
    free_points,
    keep_rows,
    map_priors,
    project_field,
    relief_field,
    set_camera,
    set_observations,
    simulated,
)
from reference_cases import case_network, load
from scipy.spatial.transform import Rotation
from studies import parametrize_with_studies

from adjust import AdjustmentError, Options, Prior, adjust, approximate
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Network, ObjectPoint


def assert_near(found: Approximations, truth: Projected, meters: float, radians: float) -> None:
    for image, center in truth.centers.items():
        assert np.linalg.norm(found.exterior[image][:3] - center) < meters
        rotation = Rotation.from_euler("XYZ", found.exterior[image][3:]).as_matrix().T
        assert np.linalg.norm(rotation - truth.rotations[image]) < radians
    for name, xyz in truth.points.items():
        if name in found.points:
            assert np.linalg.norm(found.points[name] - xyz) < meters


@pytest.mark.parametrize("relief_m", [0.0, 30.0, 300.0], ids=["flat", "hilly", "deep"])
@pytest.mark.parametrize(
    "stations",
    [CONVERGENT_STATIONS, VERTICAL_STATIONS, VERTICAL_STATIONS[:1]],
    ids=["convergent", "vertical", "single"],
)
@pytest.mark.parametrize("mirrored", [False, True])
def test_known_points_noise_and_gross_errors(
    relief_m: float, stations: list[tuple[float, float, float, float, float, float]], mirrored: bool
) -> None:
    truth = project_field(relief_field(relief_m), stations, mirrored=mirrored, outliers=0.05)
    found = approximate(truth.network)
    assert_near(found, truth, meters=2.0, radians=2e-3)
    assert found.mirrored == (frozenset(truth.centers) if mirrored else frozenset())


def test_distortion_known_beforehand_is_taken_off() -> None:
    truth = project_field(relief_field(300.0), CONVERGENT_STATIONS, noise_mm=0.0, distortion=(-0.25, 0.13, 1e-3, -5e-4))
    assert_near(approximate(truth.network), truth, meters=1e-2, radians=1e-5)


def test_a_principal_distance_that_nothing_shows_is_requested() -> None:
    truth = project_field(relief_field(0.0), [(0.0, 0.0, 1500.0, 0.0, 0.0, 0.3)])
    with pytest.raises(AdjustmentError, match=r"distance of camera rc20 cannot be found .* give principal_distance_mm"):
        approximate(set_camera(truth.network, principal_distance_mm=None, x0_mm=None, y0_mm=None))


def test_too_few_known_points_are_named() -> None:
    truth = project_field(relief_field(300.0), CONVERGENT_STATIONS[:1])
    network = free_points(truth.network, {f"t{k}" for k in range(2, 40)})
    observed = sum(point in {"t0", "t1"} for point in network.observations.point)
    with pytest.raises(AdjustmentError, match=f"image f1 sees {observed} known points, no other image"):
        approximate(network)


def test_an_image_that_the_others_do_not_help_is_named() -> None:
    truth = project_field(relief_field(300.0), CONVERGENT_STATIONS)
    observed = keep_rows(truth.network, lambda image, _, kind: (image, kind) == ("f3", "target")).observations.point
    _, _, third, *others = sorted(observed)
    network = free_points(truth.network, {third})  # seen nowhere else, and so no help
    few = keep_rows(network, lambda image, point, _: point not in others if image == "f3" else point != third)
    with pytest.raises(AdjustmentError, match="image f3 sees 2 known points; resection needs 3"):
        approximate(few)


def test_misnumbered_points_are_not_believed() -> None:
    truth = project_field(relief_field(300.0), CONVERGENT_STATIONS[:1])
    points = truth.network.observations.point
    targets = [i for i, kind in enumerate(truth.network.observations.kind) if kind == "target"]
    mixed = list(points)
    for i, j in zip(targets, np.random.default_rng(0).permutation(targets), strict=True):
        mixed[i] = points[j]
    with pytest.raises(AdjustmentError, match=r"image f1 sees .* Check the point numbers"):
        approximate(set_observations(truth.network, point=tuple(mixed)))


def test_a_point_viewed_once_and_too_few_marks_are_named() -> None:
    truth = project_field(relief_field(300.0), CONVERGENT_STATIONS)
    network = free_points(truth.network, {"t0"})
    once = network.observations.image[network.observations.point.index("t0")]
    with pytest.raises(AdjustmentError, match=f"point t0 is unknown and measured in image {once} only"):
        approximate(keep_rows(network, lambda image, point, _: point != "t0" or image == once))
    with pytest.raises(AdjustmentError, match="image f3 shows 2 fiducial marks"):
        approximate(keep_rows(network, lambda image, point, _: image != "f3" or point not in ("1", "2", "3", "4")))


def test_heights_alone_and_two_points_orient_vertical_frames() -> None:
    truth = project_field(relief_field(20.0, n=60), VERTICAL_STATIONS)
    network = free_points(truth.network, truth.points.keys() - {"t3", "t7"}, "XY")
    assert_near(approximate(network), truth, meters=120.0, radians=0.08)


@pytest.mark.parametrize(
    ("case_name", "meters", "radians"),
    [
        ("i_five_images_affine_reduced", 60.0, 0.03),
        ("i_five_images_similarity_reduced", 60.0, 0.03),
        ("i_five_images_affine_paper_noisefree", 1e-3, 1e-6),
        ("ii_juhl_3photos", 0.5, 1e-3),
        ("iii_selfcal_mixed", 60.0, 0.03),
        ("iii_selfcal_all_unknown_datum_A", 150.0, 0.1),
        ("iv_planar_board", 0.3, 3e-4),
        ("v_singular_K2D_vert0_affine", 1e-3, 1e-6),
        ("v_singular_K3D_conv_affine", 1e-3, 1e-6),
    ],
)
def test_reference_cases_from_their_observations_alone(case_name: str, meters: float, radians: float) -> None:
    case = load(case_name)
    network = from_observations_alone(case_network(case))
    found = approximate(network)
    truth = case["truth"] if "truth" in case else case["state"]
    for image in found.exterior:
        expected = np.array([truth[f"EO{image}.{name}"] for name in EXTERIOR_NAMES])
        assert np.linalg.norm(found.exterior[image][:3] - expected[:3]) < meters
        turn = (found.exterior[image][3:] - expected[3:] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(turn).max() < radians
    for name, xyz in found.points.items():
        expected = np.array([truth.get(f"PT{name}.{axis}", np.nan) for axis in "XYZ"])
        assert np.nanmax(np.abs(xyz - expected), initial=0.0) < meters
    if "result" in case:
        assert adjust(network, found).vpv == pytest.approx(case["result"]["vpv"], rel=1e-8, abs=1e-12)


def from_observations_alone(network: Network) -> Network:
    """Without the values of coordinates that are free."""
    points = (
        ObjectPoint(p.id, *(None if prior is None or np.isinf(prior.sigma) else prior for prior in (p.X, p.Y, p.Z)))
        for p in network.points
    )
    return replace(network, points=tuple(points))


TILT = 0.14  # rad
AROUND = [2 * np.pi * i / 8 for i in range(8)]
TILTED = Truth(
    stations=tuple((200 * np.cos(a), 200 * np.sin(a), 1500.0 if i % 2 else 1125.0) for i, a in enumerate(AROUND)),
    attitudes=tuple((-TILT * np.sin(a), TILT * np.cos(a), i * np.pi / 2) for i, a in enumerate(AROUND)),
    mirrored=8 * (False,),
)


def make_heights_network(seed: int) -> Network:
    """100 points of a field with 8 m of relief, their heights known to 2 cm, and a camera of which little is known."""
    rng = np.random.default_rng(seed)
    free = dict.fromkeys(TILTED.distortion, np.inf)
    network, _ = simulated(rng, TILTED, points=field_points(rng, 100, relief=8.0), free=free)
    network = map_priors(network, lambda name, prior: replace(prior, sigma=0.02) if name.endswith(".Z") else prior)
    network = free_points(network, network.point_by_id, "XY")
    unknown = Prior(0.0, np.inf)
    distortion = replace(network.cameras[0].distortion, parameters=dict.fromkeys(TILTED.distortion, unknown))
    interior = {"principal_distance_mm": Prior(152.6, np.inf), "x0_mm": unknown, "y0_mm": unknown}
    return set_camera(network, **interior, distortion=distortion)


@pytest.mark.study
@pytest.mark.parametrize("seed", [1, 2])
def test_tilted_frames_are_oriented_and_calibrate_the_camera(seed: int) -> None:
    """They start as if they looked straight down, where heights do not tell the principal distance."""
    network = make_heights_network(seed)
    result = adjust(network, approximate(network), Options(datum="minimal"))
    assert result.converged
    assert result.sigma0 < 1.1
    c, sigma = result.value("IO.K.c"), result.sigma("IO.K.c")
    assert abs(c - TILTED.c) < 4 * sigma < 4.0


@parametrize_with_studies("sigma", [2.0, np.inf], quick=(1,))
def test_a_principal_distance_that_is_a_guess_is_found_from_the_images(sigma: float) -> None:
    """Twice the true one, and known no better than that: it is sought where the iteration does not come to rest."""
    rng = np.random.default_rng(1)
    network, _ = simulated(rng, points=field_points(rng, 40))
    camera = network.cameras[0]
    assert camera.principal_distance_mm is not None
    guess = 2.0 * camera.principal_distance_mm.value
    for known, converges in ((sigma * guess, True), (0.05 * guess, False)):
        guessed = set_camera(network, principal_distance_mm=Prior(guess, known))
        result = adjust(guessed, options=Options(iteration_limit=7))
        assert result.converged == converges
        assert any("repeated with approximations" in remark for remark in result.remarks) == converges
