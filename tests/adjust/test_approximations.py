"""Initial values without any approximation from the user: against OpenCV's projections and the reference cases."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from projected import C_MM, CONVERGENT, MARKS_MM, VERTICAL, Truth, field, simulated
from reference_cases import case_network, load
from scipy.spatial.transform import Rotation

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Exterior, Network, ObjectPoint, Transformation
from adjust.problem.observations import Observations
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]


def assert_near(found: Approximations, truth: Truth, meters: float, radians: float) -> None:
    for image, center in truth.centers.items():
        assert np.linalg.norm(found.exterior[image][:3] - center) < meters
        rotation = Rotation.from_euler("XYZ", found.exterior[image][3:]).as_matrix().T
        assert np.linalg.norm(rotation - truth.rotations[image]) < radians
    for name, xyz in truth.points.items():
        if name in found.points:
            assert np.linalg.norm(found.points[name] - xyz) < meters


@pytest.mark.parametrize("relief_m", [0.0, 30.0, 300.0], ids=["flat", "hilly", "deep"])
@pytest.mark.parametrize("stations", [CONVERGENT, VERTICAL, VERTICAL[:1]], ids=["convergent", "vertical", "single"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_known_points_noise_and_gross_errors(
    relief_m: float, stations: list[tuple[float, float, float, float, float, float]], mirrored: bool
) -> None:
    truth = simulated(field(relief_m), stations, mirrored=mirrored, outliers=0.05)
    found = approximate(truth.network)
    assert_near(found, truth, meters=2.0, radians=2e-3)
    assert found.mirrored == (frozenset(truth.centers) if mirrored else frozenset())


@pytest.mark.parametrize("kind", ["none", "congruent", "similarity", "affine"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_every_film_transformation(kind: Transformation, mirrored: bool) -> None:
    truth = simulated(field(300.0), CONVERGENT, kind=kind, mirrored=mirrored, noise_mm=0.0)
    found = approximate(truth.network)
    assert_near(found, truth, meters=1e-2, radians=1e-5)
    assert found.mirrored == (frozenset(truth.centers) if mirrored and kind != "none" else frozenset())


def test_distortion_known_beforehand_is_taken_off() -> None:
    truth = simulated(field(300.0), CONVERGENT, noise_mm=0.0, distortion=(-0.25, 0.13, 1e-3, -5e-4))
    assert_near(approximate(truth.network), truth, meters=1e-2, radians=1e-5)


def test_unknown_distortion_leaves_a_usable_start() -> None:
    truth = simulated(field(300.0), CONVERGENT, distortion=(-0.2, 0.05, 0.0, 0.0))
    camera = replace(truth.network.cameras[0], distortion=Distortion("opencv", {"k1": Prior(0.0, np.inf)}))
    assert_near(approximate(replace(truth.network, cameras=(camera,))), truth, meters=100.0, radians=0.05)


def test_unknown_principal_distance_from_a_deep_field() -> None:
    truth = simulated(field(300.0), CONVERGENT, outliers=0.05)
    found = approximate(drop_interior(truth.network))
    assert abs(found.interior["rc20"][0] - C_MM) < 0.3
    assert_near(found, truth, meters=5.0, radians=5e-3)


def test_unknown_principal_distance_from_twenty_boards() -> None:
    board = np.array([[x, y, 0.0] for x in range(-4, 5) for y in range(-3, 4)]) * 100.0
    rng = np.random.default_rng(8)
    stations = []
    for _ in range(20):
        direction = Rotation.from_euler("XYZ", [*rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3)])
        center = direction.apply([0.0, 0.0, rng.uniform(900.0, 1300.0)])
        stations.append((*center, *direction.as_euler("XYZ")))
    truth = simulated(board, stations, kind="none", outliers=0.05, distortion=(-0.05, 0.01, 0.0, 0.0))
    camera = replace(truth.network.cameras[0], distortion=Distortion("opencv", {"k1": Prior(0.0, np.inf)}))
    found = approximate(replace(drop_interior(truth.network), cameras=(replace(camera, principal_distance_mm=None),)))
    assert abs(found.interior["rc20"][0] / C_MM - 1) < 0.05
    assert_near(found, truth, meters=80.0, radians=0.05)


def test_a_principal_distance_that_nothing_shows_is_requested() -> None:
    station = [(0.0, 0.0, 1500.0, 0.0, 0.0, 0.3)]
    truth = simulated(field(0.0), station)
    with pytest.raises(
        AdjustmentError, match=r"principal distance of camera rc20 cannot be found .* give principal_distance_mm"
    ):
        approximate(drop_interior(truth.network))


def drop_interior(network: Network) -> Network:
    camera = replace(network.cameras[0], principal_distance_mm=None, x0_mm=None, y0_mm=None)
    return replace(network, cameras=(camera,))


def test_unknown_points_and_images_that_see_few_known_ones() -> None:
    truth = simulated(field(300.0, n=60), CONVERGENT)
    known_by_first_two = {f"t{k}" for k in range(8)}
    network = free_points(truth.network, {p for p in truth.points if p not in known_by_first_two})
    rows = [
        i
        for i, (image, point) in enumerate(zip(network.observations.image, network.observations.point, strict=True))
        if not (image in {"f4", "f5"} and point in known_by_first_two)
    ]
    found = approximate(replace(network, observations=subset(network.observations, rows)))
    assert_near(found, truth, meters=3.0, radians=3e-3)
    assert set(found.points) >= set(truth.network.observations.point) - set(MARKS_MM)


def test_given_orientations_are_kept_where_points_do_not_contradict_them() -> None:
    truth = simulated(field(300.0), CONVERGENT)
    wrong = np.array([50.0, 50.0, 50.0, 0.1, 0.1, 0.1])
    exact = {name: true_exterior(truth, name) for name in truth.centers}
    images = tuple(
        replace(image, exterior=Exterior(exact[image.name] + (wrong if image.name == "f2" else 1e-9)))
        for image in truth.network.images
    )
    found = approximate(replace(truth.network, images=images))
    np.testing.assert_allclose(found.exterior["f1"], exact["f1"] + 1e-9, rtol=0, atol=1e-10)
    assert np.linalg.norm(found.exterior["f2"][:3] - truth.centers["f2"]) < 2.0
    held = tuple(replace(image, exterior=Exterior(exact[image.name] + wrong, np.zeros(6))) for image in images)
    found = approximate(replace(truth.network, images=held))
    np.testing.assert_allclose(found.exterior["f2"], exact["f2"] + wrong, rtol=0, atol=1e-9)


def true_exterior(truth: Truth, image: str) -> Array:
    angles = Rotation.from_matrix(truth.rotations[image].T).as_euler("XYZ")
    return np.concatenate([truth.centers[image], angles])


@pytest.mark.study
def test_the_order_of_things_does_not_matter() -> None:
    truth = simulated(field(30.0), CONVERGENT[:3], outliers=0.05)
    network = drop_interior(truth.network)
    rng = np.random.default_rng(0)
    shuffled = replace(
        network,
        images=network.images[::-1],
        points=network.points[::-1],
        observations=subset(network.observations, rng.permutation(len(network.observations)).tolist()),
    )
    first, second = approximate(network), approximate(shuffled)
    for image in truth.centers:
        np.testing.assert_allclose(first.exterior[image], second.exterior[image], rtol=1e-12)


def test_too_few_known_points_are_named() -> None:
    truth = simulated(field(300.0), CONVERGENT[:1])
    network = free_points(truth.network, {f"t{k}" for k in range(2, 40)})
    observed = sum(point in {"t0", "t1"} for point in network.observations.point)
    with pytest.raises(AdjustmentError, match=f"image f1 sees {observed} known points, no other image"):
        approximate(network)


def test_an_image_that_the_others_do_not_help_is_named() -> None:
    truth = simulated(field(300.0), CONVERGENT)
    observations = truth.network.observations
    observed = zip(observations.image, observations.point, observations.kind, strict=True)
    of_f3 = sorted(point for image, point, kind in observed if image == "f3" and kind == "target")
    network = free_points(truth.network, {of_f3[2]})  # seen nowhere else, and so no help
    rows = [
        row
        for row, (image, point) in enumerate(zip(observations.image, observations.point, strict=True))
        if (point not in of_f3[3:] if image == "f3" else point != of_f3[2])
    ]
    with pytest.raises(AdjustmentError, match="image f3 sees 2 known points; resection needs 3"):
        approximate(replace(network, observations=subset(network.observations, rows)))


def test_misnumbered_points_are_not_believed() -> None:
    truth = simulated(field(300.0), CONVERGENT[:1])
    points = truth.network.observations.point
    targets = [i for i, kind in enumerate(truth.network.observations.kind) if kind == "target"]
    mixed = list(points)
    for i, j in zip(targets, np.random.default_rng(0).permutation(targets), strict=True):
        mixed[i] = points[j]
    network = replace(truth.network, observations=replace(truth.network.observations, point=tuple(mixed)))
    with pytest.raises(AdjustmentError, match=r"image f1 sees .* Check the point numbers"):
        approximate(network)


def test_a_point_viewed_once_and_too_few_marks_are_named() -> None:
    truth = simulated(field(300.0), CONVERGENT)
    network = free_points(truth.network, {"t0"})
    rows = [i for i, point in enumerate(network.observations.point) if point != "t0"]
    once = network.observations.point.index("t0")
    with pytest.raises(AdjustmentError, match=r"point t0 is unknown and measured in image f. only"):
        approximate(replace(network, observations=subset(network.observations, [*rows, once])))
    rows = [
        i
        for i, (image, kind, point) in enumerate(
            zip(network.observations.image, network.observations.kind, network.observations.point, strict=True)
        )
        if not (image == "f3" and kind == "fiducial" and point in "1234")
    ]
    with pytest.raises(AdjustmentError, match="image f3 shows 2 fiducial marks"):
        approximate(replace(network, observations=subset(network.observations, rows)))


def free_points(network: Network, names: set[str]) -> Network:
    points = (ObjectPoint(p.id, None, None, None) if p.id in names else p for p in network.points)
    return replace(network, points=tuple(points))


def subset(observations: Observations, rows: Sequence[int]) -> Observations:
    return observations.only(np.array(rows))


def test_heights_alone_and_two_points_orient_vertical_frames() -> None:
    truth = simulated(field(20.0, n=60), VERTICAL)
    found = approximate(heights_only(truth.network, planimetry={"t3", "t7"}))
    assert_near(found, truth, meters=120.0, radians=0.08)


def test_heights_alone_orient_vertical_frames_to_a_scale() -> None:
    truth = simulated(field(0.0, n=60), VERTICAL)
    found = approximate(heights_only(truth.network, planimetry=set()))
    stations = np.array([found.exterior[image][:3] for image in truth.centers])
    expected = np.array(list(truth.centers.values()))
    scale = stations[:, 2].mean() / expected[:, 2].mean()
    bases, expected_bases = (np.linalg.norm(each[1:] - each[0], axis=1) for each in (stations, expected))
    np.testing.assert_allclose(bases / scale, expected_bases, atol=120.0)
    np.testing.assert_allclose(stations[:, 2] / scale, expected[:, 2], atol=120.0)


def heights_only(network: Network, planimetry: set[str]) -> Network:
    """Every point with its height alone, known to 2 cm, but for the points named."""
    points = (
        p if p.id in planimetry or p.Z is None else ObjectPoint(p.id, None, None, Prior(p.Z.value, 0.02))
        for p in network.points
    )
    return replace(network, points=tuple(points))


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
