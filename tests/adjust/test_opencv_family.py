"""The `opencv` family against OpenCV itself, and the corrections inverted."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import Truth, camera_point, digital_network, field_points, simulated

from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.transformation import Film
from adjust.initial_values.approximations import approximate
from adjust.problem.camera import Camera
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Approximations, Network
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

PIXEL_MM = 0.005
SIZE_PX = np.array([4000.0, 3000.0])
FX, FY, CX, CY = 4810.0, 4800.0, 2010.0, 1490.0
SKEW = 7.0
FISHEYE = np.array([0.03, -0.02, 0.004, -0.001])
LENS = [-0.12, 0.09, 0.0012, -0.0008, -0.03, 0.02, -0.01, 0.004, 0.0011, -0.0007, 0.0005, 0.0009]
TILT = [0.02, -0.015]
DISTORTION = np.array([*LENS, *TILT])
NAMES = parameter_names("opencv")[:14]
FLIP = np.diag([1.0, -1.0, -1.0])  # from the camera's axes, y up and z backward, to OpenCV's


def opencv_pixels(angles: Array, station: Array, xyz: Array) -> Array:
    """Pixels (n, 2) by OpenCV."""
    rotation = FLIP @ rotation_from_angles(angles)
    rvec, _ = cv2.Rodrigues(rotation)
    matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(xyz, rvec, -rotation @ station, matrix, DISTORTION)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def mm(pixels: Array) -> Array:
    """Comparator coordinates: x right, y up, origin at the centre of the top-left pixel."""
    return np.asarray(pixels * np.array([PIXEL_MM, -PIXEL_MM]))


def camera(free: bool) -> Camera:
    """The camera; its denominator is fixed, from which a numerator in the same powers can hardly be told."""
    sigma = np.inf if free else 0.0
    values = [*DISTORTION, FX / FY - 1.0, 0.0]
    parameters = {
        name: Prior(value, 0.0 if name in ("k4", "k5", "k6") else sigma)
        for name, value in zip(parameter_names("opencv"), values, strict=True)
    }
    c, x0, y0 = FY * PIXEL_MM, CX * PIXEL_MM, -CY * PIXEL_MM
    return Camera("D", Prior(c, sigma), Prior(x0, sigma), Prior(y0, sigma), Distortion("opencv", parameters))


def numbered(xyz: Array) -> dict[str, Array]:
    return {str(j): each for j, each in enumerate(xyz)}


def board() -> Array:
    x, y = np.meshgrid(np.arange(-6.0, 7.0), np.arange(-5.0, 6.0))
    return np.stack([x.ravel() * 100, y.ravel() * 100, np.zeros(x.size)], axis=1)


def test_projection_is_opencvs() -> None:
    angles, station = np.array([0.2, -0.3, 0.5]), np.array([300.0, -200.0, 1500.0])
    xyz = np.random.default_rng(2).uniform(-400, 400, (50, 3))
    interior = np.array([FY * PIXEL_MM, CX * PIXEL_MM, -CY * PIXEL_MM])
    lens = Lens(camera(False).distortion, interior, camera(False).distortion.values)
    image = ImageModel(lens, rotation_from_angles(angles), station, Film("none", np.empty(0), np.zeros(2)))
    projected, visible = image.comparator_from_object(xyz)
    assert visible.all()
    np.testing.assert_allclose(projected, mm(opencv_pixels(angles, station, xyz)), atol=1e-11)


def skewed(rays: Array) -> Array:
    """Pixels (n, 2) of rays in the camera's axes, y up, by OpenCV's distortion and a matrix with skew, as Zhang's."""
    directions = np.column_stack([rays * [1.0, -1.0], np.ones(len(rays))])
    distorted, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), np.eye(3), DISTORTION)
    return np.asarray(np.reshape(distorted, (-1, 2)) @ np.array([[FX, SKEW], [0.0, FY]]).T + [CX, CY])


def fisheye(rays: Array) -> Array:
    """The same by OpenCV's fisheye, whose skew is alpha fx."""
    directions = np.column_stack([rays * [1.0, -1.0], np.ones(len(rays))])[:, None]
    matrix = np.array([[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
    pixels, _ = cv2.fisheye.projectPoints(directions, np.zeros(3), np.zeros(3), matrix, FISHEYE, alpha=SKEW / FX)
    return np.asarray(np.reshape(pixels, (-1, 2)))


@pytest.mark.parametrize(
    ("family", "lens", "pixels", "largest"),
    [("opencv", DISTORTION, skewed, 0.5), ("opencv_fisheye", FISHEYE, fisheye, 3.0)],
)
def test_skew_and_fisheye_are_opencvs(
    family: str, lens: Array, pixels: Callable[[Array], Array], largest: float
) -> None:
    """Up to 72 degrees off the axis for the fisheye; the middle too; and back again."""
    rays = np.vstack([np.random.default_rng(3).uniform(-largest, largest, (60, 2)) / np.sqrt(2.0), np.zeros(2)])
    interior = np.array([FY, CX, -CY]) * PIXEL_MM
    values = np.array([*lens, FX / FY - 1.0, SKEW / FY])
    projected, found = Lens(Distortion(family), interior, values).camera_from_ray(rays)
    assert found.all()
    np.testing.assert_allclose(projected, mm(pixels(rays)), atol=1e-11)
    ideal, found = Lens(Distortion(family), interior, values).ideal_from_observed(projected)
    assert found.all()
    np.testing.assert_allclose((ideal - interior[1:]) / interior[0], rays, atol=1e-12)


def test_corrected_points_are_opencvs_undistorted_points() -> None:
    rng = np.random.default_rng(4)
    pixels = rng.uniform([0, 0], SIZE_PX, (40, 2))
    values = np.array([*DISTORTION, FX / FY - 1.0, 0.0])
    interior = np.array([FY, CX, -CY]) * PIXEL_MM
    ideal, found = Lens(Distortion("opencv"), interior, values).ideal_from_observed(mm(pixels))
    matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    normal = cv2.undistortPoints(pixels[:, None], matrix, DISTORTION, R=np.eye(3), P=np.eye(3), criteria=criteria)
    expected = np.asarray(normal).reshape(-1, 2) * [1, -1] * interior[0] + interior[1:]
    assert found.all()
    np.testing.assert_allclose(ideal, expected, atol=1e-9)


def test_adjustment_recovers_opencvs_parameters() -> None:
    """Exact images by OpenCV, its parameters and fx/fy free: estimated as they went in."""
    rng = np.random.default_rng(6)
    relief = board()
    relief[:, 2] = 150 * np.sin(relief[:, 0] / 70)
    tilts = [(0.0, 0.0, 0.0), (0.4, 0.1, 1.5), (-0.4, 0.2, 3.0), (0.1, 0.45, -1.5), (-0.1, -0.4, 0.7)]
    poses = [(np.array(tilt), np.array([1200 * tilt[1], -1200 * tilt[0], 1150.0])) for tilt in tilts]
    rows = [
        (f"i{i}", str(j), xy) for i, pose in enumerate(poses) for j, xy in enumerate(mm(opencv_pixels(*pose, relief)))
    ]
    c, x0, y0 = FY * PIXEL_MM, CX * PIXEL_MM, -CY * PIXEL_MM
    start = Approximations(
        {"D": np.array([c * 1.01, x0 + 0.1, y0 - 0.1])},
        {f"i{i}": np.concatenate([s + rng.uniform(-10, 10, 3), a + rng.uniform(-0.02, 0.02, 3)])
         for i, (a, s) in enumerate(poses)},
        {}, {},
    )  # fmt: skip
    result = adjust(digital_network(camera(True), rows, numbered(relief), 0.0005), start)
    assert result.converged
    assert result.vpv < 1e-12
    expected = dict(zip(NAMES, DISTORTION, strict=True)) | {"c": c, "x0": x0, "y0": y0, "b1": FX / FY - 1}
    for name, value in expected.items():
        i = result.index(f"IO.D.{name}")
        assert result.values[i] == pytest.approx(value, abs=1e-3 * np.sqrt(result.cofactor.variances[i]))


def test_torlegard_is_inverted() -> None:
    truth = Truth()
    xyz = field_points(np.random.default_rng(1), 30)
    angles, station = np.array(truth.attitudes[1]), np.array(truth.stations[1])
    model = ImageModel(
        Lens(
            Distortion("torlegard"),
            np.array([truth.c, truth.x0, truth.y0]),
            np.array([truth.distortion.get(name, 0.0) for name in parameter_names("torlegard")]),
        ),
        rotation_from_angles(angles),
        station,
        Film("none", np.empty(0), np.zeros(2)),
    )
    observed, visible = model.camera_from_object(xyz)
    assert visible.all()
    expected = camera_point(truth, 1, xyz)
    np.testing.assert_allclose(observed, expected, atol=1e-10)
    ideal, found = model.lens.ideal_from_observed(observed)
    u, v, w = model.rotation @ (xyz - station).T
    assert found.all()
    np.testing.assert_allclose(
        ideal, np.stack([truth.x0 - truth.c * u / w, truth.y0 - truth.c * v / w], axis=1), atol=1e-10
    )


def test_what_has_no_image_is_reported() -> None:
    """Behind the camera, and beyond the radius where a polynomial folds the image over."""
    fold = Distortion("torlegard")
    parameters = np.array([4e-5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # x - k3 x³ turns back at 91 mm
    _, found = Lens(fold, np.array([100.0, 0.0, 0.0]), parameters).camera_from_ray(np.array([[0.3, 0.0], [2.0, 0.0]]))
    assert list(found) == [True, False]
    barrel = np.array([-0.3] + [0.0] * 15)  # OpenCV's k1: the image of a ray turns back at a slope of 1.05
    _, found = Lens(Distortion("opencv"), np.array([100.0, 0.0, 0.0]), barrel).camera_from_ray(
        np.array([[0.9, 0], [1.2, 0]])
    )
    assert list(found) == [True, False]
    model = ImageModel(
        Lens(Distortion(), np.array([100.0, 0.0, 0.0]), np.empty(0)),
        np.eye(3),
        np.zeros(3),
        Film("none", np.empty(0), np.zeros(2)),
    )
    _, visible = model.comparator_from_object(np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 5.0], [1.0, 0.0, 0.0]]))
    assert list(visible) == [True, False, False]


def test_adjusted_image_predicts_its_observations() -> None:
    xyz = field_points(np.random.default_rng(1), 12)
    network, start = simulated(np.random.default_rng(9), points=xyz, noise=False)
    result = adjust(network, start)
    predicted, visible = adjusted_image(result, "f2").comparator_from_object(xyz)
    observations = network.observations
    keys = zip(observations.image, observations.kind, strict=True)
    rows = [row for row, key in enumerate(keys) if key == ("f2", "target")]
    assert visible.all()
    np.testing.assert_allclose(predicted, observations.xy_mm[rows], atol=1e-8)


RATIONAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
WIDE = np.array([8.0, 3.0, 0.0002, -0.0001, 0.1, 8.4, 5.0, 0.6])
WIDE_FX = 2500.0


def wide_network(seed: int, lens: Array = WIDE) -> Network:
    """A board in five images of a wide lens, distorted by OpenCV's rational model, all of which begins at 0."""
    noise_mm = 0.0002
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-6.0, 7.0), np.arange(-6.0, 7.0))
    xyz = np.stack([x.ravel() * 160, y.ravel() * 160, np.zeros(x.size)], axis=1)
    matrix = np.array([[WIDE_FX, 0, CX], [0, WIDE_FX, CY], [0, 0, 1]])
    rows = []
    for i in range(5):
        to_camera = rotation_from_angles(np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-3.0, 3.0)]))
        station = to_camera.T @ np.array([*rng.uniform(-150.0, 150.0, 2), rng.uniform(900.0, 1200.0)])
        rvec, _ = cv2.Rodrigues(FLIP @ to_camera)
        pixels, _ = cv2.projectPoints(xyz, rvec, -FLIP @ to_camera @ station, matrix, lens)
        pixels = pixels.reshape(-1, 2)
        shown = np.flatnonzero(((pixels > 0.0) & (pixels < SIZE_PX)).all(axis=1))
        rows += [(f"i{i}", str(j), mm(pixels[j]) + rng.normal(0.0, noise_mm, 2)) for j in shown]
    c, x0, y0 = (Prior(value * PIXEL_MM, np.inf) for value in (WIDE_FX, CX, -CY))
    wide = Camera("D", c, x0, y0, Distortion("opencv", {name: Prior(0.0, np.inf) for name in RATIONAL}))
    found = {row[1] for row in rows}
    return digital_network(wide, rows, {k: v for k, v in numbered(xyz).items() if k in found}, noise_mm)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_rational_distortion_begins_at_zero(seed: int) -> None:
    """Where its numerator and its denominator do the same: the solution is regular, and it is found."""
    network = wide_network(seed)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.sigma0 == pytest.approx(1.0, abs=0.05)
    for name, true in zip(("c", "x0", "y0"), (WIDE_FX, CX, -CY), strict=True):
        assert abs(result.value(f"IO.D.{name}") - true * PIXEL_MM) < 4.0 * result.sigma(f"IO.D.{name}")


def test_a_denominator_that_nothing_asks_for_is_a_note() -> None:
    """A lens without distortion: numerator and denominator do the same exactly, and yet there is a solution."""
    network = wide_network(0, 0.0 * WIDE)
    result = adjust(network, approximate(network))
    assert result.converged
    assert not result.warnings
    (note,) = result.notes
    assert note.startswith("k1, k2, k3, k4, k5 and k6 of camera D cannot be separated")
    c = WIDE_FX * PIXEL_MM
    assert abs(result.value("IO.D.c") - c) < 4.0 * result.sigma("IO.D.c")


@pytest.mark.parametrize(("family", "parameters"), [("torlegard", {"k3": 1e-4}), ("opencv", {"k1": -4.0})])
def test_a_distortion_that_folds_the_image_over_is_named(family: str, parameters: dict[str, float]) -> None:
    network, _ = simulated(np.random.default_rng(5), points=field_points(np.random.default_rng(6), 15))
    folding = Distortion(family, {name: Prior(value, np.inf) for name, value in parameters.items()})
    folded = replace(network, cameras=(replace(network.cameras[0], distortion=folding),))
    with pytest.raises(AdjustmentError, match=r"camera K: the distortion that is given \(k. = \S+\) folds the image"):
        approximate(folded)
