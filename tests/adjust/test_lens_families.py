"""Distortion families against OpenCV and published formulas, and lenses in the parameters of another family."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import networks as nets
import numpy as np
import pytest
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust import Adjustment, AdjustmentError, Calibration, Camera, Network, Parameter, adjust, approximate
from adjust.errors import UnorientedError
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.lens_conversion import convert_lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.transformation import Film
from adjust.problem.network import Approximations, Transformation
from adjust.quality.lens_comparison import CameraCalibration, compare
from adjust.quality.significance import CalibrationTest

Array = NDArray[np.float64]

PIXEL_MM = 0.005
SIZE_PX = np.array([4000.0, 3000.0])
FX, FY, CX, CY = 4810.0, 4800.0, 2010.0, 1490.0
MATRIX = np.array([[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
INTERIOR = np.array([FY, CX, -CY]) * PIXEL_MM
NO_FILM = Film("none", np.empty(0), np.zeros(2))
SKEW = 7.0
FISHEYE = np.array([0.03, -0.02, 0.004, -0.001])
LENS = [-0.12, 0.09, 0.0012, -0.0008, -0.03, 0.02, -0.01, 0.004, 0.0011, -0.0007, 0.0005, 0.0009]
TILT = [0.02, -0.015]
DISTORTION = np.array([*LENS, *TILT])
FLIP = np.diag([1.0, -1.0, -1.0])  # from the camera's axes, y up and z backward, to OpenCV's


def mm(pixels: Array) -> Array:
    """Comparator coordinates: x right, y up, origin at the centre of the top-left pixel."""
    return np.asarray(pixels * np.array([PIXEL_MM, -PIXEL_MM]))


def numbered(xyz: Array) -> dict[str, Array]:
    return {str(j): each for j, each in enumerate(xyz)}


def skewed(rays: Array) -> Array:
    """Pixels (n, 2) of rays in the camera's axes, y up, by OpenCV's distortion and a matrix with skew, as Zhang's."""
    directions = np.column_stack([rays * [1.0, -1.0], np.ones(len(rays))])
    distorted, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), np.eye(3), DISTORTION)
    return np.asarray(np.reshape(distorted, (-1, 2)) @ np.array([[FX, SKEW], [0.0, FY]]).T + [CX, CY])


def fisheye(rays: Array) -> Array:
    """The same by OpenCV's fisheye, whose skew is alpha fx."""
    directions = np.column_stack([rays * [1.0, -1.0], np.ones(len(rays))])[:, None]
    pixels, _ = cv2.fisheye.projectPoints(directions, np.zeros(3), np.zeros(3), MATRIX, FISHEYE, alpha=SKEW / FX)
    return np.asarray(np.reshape(pixels, (-1, 2)))


@pytest.mark.parametrize(
    ("family", "lens", "pixels", "largest"),
    [("opencv", DISTORTION, skewed, 0.5), ("opencv_fisheye", FISHEYE, fisheye, 3.0)],
)
def test_skew_and_fisheye_of_opencv(family: str, lens: Array, pixels: Callable[[Array], Array], largest: float) -> None:
    """Up to 72 degrees off the axis for the fisheye; the middle too; and back again."""
    rays = np.vstack([np.random.default_rng(3).uniform(-largest, largest, (60, 2)) / np.sqrt(2.0), np.zeros(2)])
    model = Lens(Distortion(family), INTERIOR, np.array([*lens, FX / FY - 1.0, SKEW / FY]))
    projected, found = model.camera_from_ray(rays)
    assert found.all()
    np.testing.assert_allclose(projected, mm(pixels(rays)), atol=1e-11)
    ideal, found = model.ideal_from_observed(projected)
    assert found.all()
    np.testing.assert_allclose((ideal - INTERIOR[1:]) / INTERIOR[0], rays, atol=1e-12)


def test_torlegard_is_inverted() -> None:
    truth = nets.Truth()
    xyz = nets.field_points(np.random.default_rng(1), 30)
    angles, station = np.array(truth.attitudes[1]), np.array(truth.stations[1])
    parameters = np.array([truth.distortion.get(name, 0.0) for name in parameter_names("torlegard")])
    lens = Lens(Distortion("torlegard"), np.array([truth.c, truth.x0, truth.y0]), parameters)
    model = ImageModel(lens, rotation_from_angles(angles), station, NO_FILM)
    observed, visible = model.camera_from_object(xyz)
    assert visible.all()
    expected = nets.camera_point(truth, 1, xyz)
    np.testing.assert_allclose(observed, expected, atol=1e-10)
    ideal, found = model.lens.ideal_from_observed(observed)
    u, v, w = model.rotation @ (xyz - station).T
    assert found.all()
    expected = np.stack([truth.x0 - truth.c * u / w, truth.y0 - truth.c * v / w], axis=1)
    np.testing.assert_allclose(ideal, expected, atol=1e-10)


def test_what_has_no_image_is_reported() -> None:
    """Behind the camera, and beyond the radius where a polynomial folds the image over."""
    fold = Distortion("torlegard")
    parameters = np.array([4e-5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # x - k3 x³ turns back at 91 mm
    _, found = Lens(fold, np.array([100.0, 0.0, 0.0]), parameters).camera_from_ray(np.array([[0.3, 0.0], [2.0, 0.0]]))
    assert list(found) == [True, False]
    barrel = np.array([-0.3] + [0.0] * 15)  # OpenCV's k1: the image of a ray turns back at a slope of 1.05
    _, found = Lens(Distortion("opencv"), np.array([1e2, 0, 0]), barrel).camera_from_ray(np.array([[0.9, 0], [1.2, 0]]))
    assert list(found) == [True, False]
    model = ImageModel(Lens(Distortion(), np.array([100.0, 0.0, 0.0]), np.empty(0)), np.eye(3), np.zeros(3), NO_FILM)
    _, visible = model.comparator_from_object(np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 5.0], [1.0, 0.0, 0.0]]))
    assert list(visible) == [True, False, False]


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
    interior = nets.given_interior(PIXEL_MM * np.array([WIDE_FX, CX, -CY]), np.inf)
    wide = Camera("D", *interior, Distortion("opencv", {name: Prior(0.0, np.inf) for name in RATIONAL}))
    found = {row[1] for row in rows}
    return nets.digital_network(wide, rows, {k: v for k, v in numbered(xyz).items() if k in found}, noise_mm)


@parametrize_with_studies("seed", [0, 2])
def test_a_rational_distortion_begins_at_zero(seed: int) -> None:
    """Where its numerator and its denominator do the same: the solution is regular, and it is found."""
    network = wide_network(seed)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.sigma0 == pytest.approx(1.0, abs=0.05)
    for name, true in zip(("c", "x0", "y0"), (WIDE_FX, CX, -CY), strict=True):
        assert abs(result.value(f"IO.D.{name}") - true * PIXEL_MM) < 4.0 * result.sigma(f"IO.D.{name}")


@pytest.mark.parametrize(
    ("family", "parameters", "words"),
    [
        ("torlegard", {"k3": 1e-4}, r"begin with 0\.$"),
        ("opencv", {"k1": -4.0}, r"begin with 0\.$"),
        ("opencv_fisheye", {"k1": -4.0}, r"begin with 0\.$"),
    ],
)
def test_a_distortion_that_folds_the_image_over_is_named(family: str, parameters: dict[str, float], words: str) -> None:
    network, _ = nets.simulated(np.random.default_rng(5), points=nets.field_points(np.random.default_rng(6), 15))
    folding = Distortion(family, {name: Prior(value, np.inf) for name, value in parameters.items()})
    folded = replace(network, cameras=(replace(network.cameras[0], distortion=folding),))
    sentence = rf"camera K: the distortion that is given \(k. = \S+\) folds the image.*{words}"
    with pytest.raises(AdjustmentError, match=sentence):
        approximate(folded)


def test_a_picture_with_points_beyond_90_degrees_is_named_with_their_number() -> None:
    """An equidistant lens; in two of six pictures points lie up to 107 degrees off the axis."""
    with pytest.raises(UnorientedError) as raised:
        approximate(nets.equidistant_network(np.random.default_rng(3), 1.2, 90.0, 6))
    assert raised.value.reasons.keys() <= {"i2", "i5"}
    assert all("of its 30 points 90 degrees and more off the axis" in why for why in raised.value.reasons.values())


B = 90.0
C = 152.0


def columns(family: str, xy_mm: Array, half_mm: tuple[float, float] = (B, B)) -> Array:
    """(n, 2, k): what a unit of every parameter takes off observed points, the principal point at (0.3, -0.2)."""
    names = parameter_names(family)
    interior = np.array([C, 0.3, -0.2])
    observed = xy_mm + interior[1:]
    at = Lens(Distortion(family, half_mm=half_mm), interior, np.zeros(len(names))).equations(observed, xy_mm / C)
    return -at.quantity_jacobian[..., 3:]


def grid(points: Array, half_mm: tuple[float, float] = (B, B)) -> Array:
    x, y = np.meshgrid(points * half_mm[0], points * half_mm[1])
    return np.stack([x.ravel(), y.ravel()], axis=1)


def orientation(xy_mm: Array) -> Array:
    """(n, 2, 6): shifts, rotation, scale and tilts of an image of a plane, by what they are in a picture."""
    x, y = xy_mm.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    pairs = [(one, zero), (zero, one), (-y, x), (x, y), (C + x**2 / C, x * y / C), (x * y / C, C + y**2 / C)]
    return np.stack([np.stack(pair, axis=1) for pair in pairs], axis=2)


def largest_cosine(first: Array, second: Array) -> float:
    """Between columns (n, 2, k) and (n, 2, l)."""
    a, b = (each.reshape(-1, each.shape[2]) / np.linalg.norm(each, axis=(0, 1)) for each in (first, second))
    return float(np.abs(a.T @ b).max())


def are_orthogonal(each: Array) -> bool:
    flat = each.reshape(-1, each.shape[2]) / np.linalg.norm(each, axis=(0, 1))
    return bool(np.allclose(flat.T @ flat, np.eye(flat.shape[1]), atol=1e-12))


def test_ebners_formula_as_published() -> None:
    """In mm and in b: his coefficient of a product of degree m is ours over b to that power."""
    xy = np.random.default_rng(1).uniform(-100, 100, (9, 2))
    x, y = xy.T
    u, v = x**2 - 2 * B**2 / 3, y**2 - 2 * B**2 / 3
    zero = np.zeros_like(x)
    dx = [x, y, -2 * u, x * y, v, zero, x * v, zero, u * y, zero, u * v, zero]
    dy = [-y, x, x * y, -2 * v, zero, u, zero, u * y, zero, x * v, zero, u * v]
    degrees = np.array([1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4])
    expected = np.stack([np.stack(dx, axis=1), np.stack(dy, axis=1)], axis=1) / B**degrees
    assert parameter_names("ebner") == tuple(f"b{i}" for i in range(1, 13))
    np.testing.assert_allclose(columns("ebner", xy), expected, atol=1e-13)


def test_gruens_formula_as_published() -> None:
    """With b = 1: k, l of degree 2, x p, y q of degree 3, r, s of degree 4, as his table has them."""
    xy = np.random.default_rng(2).uniform(-1, 1, (9, 2))
    x, y = xy.T
    k, l_ = x**2 - 1 / 2, y**2 - 1 / 2
    p, q = x**2 - 17 / 20, y**2 - 17 / 20
    r, s = x**2 * (x**2 - 31 / 28) + 9 / 70, y**2 * (y**2 - 31 / 28) + 9 / 70
    by_x, by_y = [np.ones_like(x), x, k, x * p, r], [np.ones_like(x), y, l_, y * q, s]
    zero = np.zeros_like(x)
    expected = {"a12": (x, -y), "a21": (y, x), "a22": (x * y, -10 / 7 * l_), "b22": (-10 / 7 * k, x * y)}
    for i in range(1, 6):
        for j in range(1, 6):
            product = by_y[i - 1] * by_x[j - 1]
            if (i, j) not in {(1, 1), (1, 2), (2, 1), (2, 2), (1, 3)}:
                expected[f"a{i}{j}"] = (product, zero)
            if (i, j) not in {(1, 1), (1, 2), (2, 1), (2, 2), (3, 1)}:
                expected[f"b{i}{j}"] = (zero, product)
    found = dict(zip(parameter_names("gruen"), np.moveaxis(columns("gruen", xy, (1.0, 1.0)), 2, 0), strict=True))
    assert found.keys() == expected.keys()
    assert len(found) == 44
    for name, pair in expected.items():
        np.testing.assert_allclose(found[name], np.stack(pair, axis=1), atol=1e-14, err_msg=name)


SIZES = {"legendre(2)": 12, "legendre(3)": 26, "legendre(5)": 66, "fourier(1)": 16, "fourier(2)": 48, "fourier(3)": 96}


@pytest.mark.parametrize("family", SIZES)
def test_sets_are_orthogonal_over_the_frame_and_free_of_the_orientation(family: str) -> None:
    """Fourier's, to a shift alone."""
    half_mm, is_legendre = (115.0, 80.0), family.startswith("legendre")
    points, weights = np.polynomial.legendre.leggauss(8)
    if not is_legendre:
        points, weights = -1 + 2 * np.arange(12) / 12, np.ones(12)
    xy = grid(points, half_mm)
    root = np.sqrt(np.outer(weights, weights).ravel())[:, None, None]
    found = columns(family, xy, half_mm)
    assert found.shape[2] == SIZES[family]
    assert are_orthogonal(root * found)
    assert largest_cosine(root * found, root * orientation(xy)[..., : 6 if is_legendre else 2]) < 1e-12


def test_a_fourier_term_by_its_name() -> None:
    xy = np.array([[20.0, -35.0]])
    named = dict(zip(parameter_names("fourier(2)"), columns("fourier(2)", xy)[0].T, strict=True))
    angle = np.pi / B * (1 * 20.0 - 2 * -35.0)
    np.testing.assert_allclose(named["a1m2"], [np.cos(angle), 0.0], atol=1e-14)
    np.testing.assert_allclose(named["d1m2"], [0.0, np.sin(angle)], atol=1e-14)


CORNERS_MM = np.array([[-17.0, -12.0], [18.0, 12.0]])
GIVEN_MM = np.array([28.8, 0.05, -0.03])


def values(family: str, **given: float) -> Array:
    return np.array([given.get(name, 0.0) for name in parameter_names(family)])


def test_another_r0_is_another_principal_distance() -> None:
    """c, k and p are divided by 1 + k3 r0² + k5 r0⁴: exact, and the derivative by k3 is that of the quotient."""
    r0, k3, k5, p1 = 9.0, 1.1e-4, -2e-7, 4e-6
    lens = values("torlegard", k3=k3, k5=k5, p1=p1)
    found = convert_lens(Lens(Distortion("torlegard", r0_mm=r0), GIVEN_MM, lens), Distortion("brown"), CORNERS_MM)
    s = 1 + k3 * r0**2 + k5 * r0**4
    assert found.is_same
    assert found.estimated == ("k1", "k2", "p1")
    np.testing.assert_allclose(found.lens.interior, [GIVEN_MM[0] / s, *GIVEN_MM[1:]], rtol=1e-12)
    np.testing.assert_allclose(found.lens.parameters, values("brown", k1=k3 / s, k2=k5 / s, p1=p1 / s), rtol=1e-8)
    c_by_k3 = -GIVEN_MM[0] * r0**2 / s**2
    assert found.by_source[0, 3] == pytest.approx(c_by_k3, rel=1e-7)
    assert found.by_source[3, 3] == pytest.approx(1 / s - k3 * r0**2 / s**2, rel=1e-6)


def test_covariance_is_that_of_the_same_data_adjusted_in_the_other_family() -> None:
    """Values to a millionth of their sigmas, the covariance to a millionth: aicon with r0 as OpenCV's."""
    rng = np.random.default_rng(2)
    first = adjust_network(nets.lens_network("aicon", rng), ("a1", "a2", "b1", "b2"))
    network = first.network
    other = nets.set_camera(network, distortion=Distortion("opencv"))
    second = adjust_network(other, ("k1", "k2", "p1", "p2"))
    source, names = quantities("aicon"), quantities("opencv")
    values = np.array([first.value(name) for name in source])
    lens = Lens(network.cameras[0].distortion, values[:3], values[3:], first.cofactor_of(source))
    found = convert_lens(lens, Distortion("opencv"), CORNERS_MM)
    assert found.is_same
    covariance, expected = found.lens.covariance, second.cofactor_of(names)
    sigmas = np.sqrt(np.diag(expected))
    free = sigmas > 0.0
    assert (np.abs(found.lens.values - [second.value(n) for n in names])[free]
            < 1e-4 * sigmas[free]).all()  # fmt: skip
    scale = np.outer(sigmas, sigmas)[np.ix_(free, free)]
    np.testing.assert_allclose(covariance[np.ix_(free, free)] / scale, expected[np.ix_(free, free)] / scale, atol=1e-5)
    assert not covariance[~free].any()


def quantities(family: str) -> list[str]:
    return [f"IO.L.{name}" for name in ("c", "x0", "y0", *parameter_names(family))]


def adjust_network(network: Network, free: tuple[str, ...]) -> Adjustment:
    unknown = dict.fromkeys(free, Prior(0.0, np.inf))
    network = nets.set_camera(network, distortion=replace(network.cameras[0].distortion, parameters=unknown))
    return adjust(network, approximate(network))


def test_what_no_family_takes_is_known_by_its_residual() -> None:
    """A correction of the observed point as one of the ideal point: 0.7 um are left."""
    lens = values("torlegard", k3=1e-4, k5=-1e-7, p1=5e-6, p2=-8e-6)
    found = convert_lens(Lens(Distortion("torlegard"), GIVEN_MM, lens), Distortion("opencv"), CORNERS_MM)
    assert not found.is_same
    assert 1e-4 < found.largest_mm < 1e-3
    assert found.rms_mm < found.largest_mm


@pytest.mark.parametrize("source", list(nets.LENSES))
@pytest.mark.parametrize("target", ["torlegard", "brown", "australis", "aicon", "opencv", "opencv_fisheye"])
def test_every_lens_comes_near_every_other(source: str, target: str) -> None:
    c, given = nets.LENSES[source]
    lens = values(source, **given), np.array([c, 0.12, -0.07])
    into = Distortion(target, r0_mm=10.0 if target in ("torlegard", "aicon") else 0.0)
    found = convert_lens(Lens(Distortion(source, r0_mm=13.0), lens[1], lens[0]), into, CORNERS_MM / 2.0)
    assert found.largest_mm < 0.03


def test_a_frame_without_an_image_is_refused() -> None:
    with pytest.raises(AdjustmentError, match="makes no image at"):
        convert_lens(
            Lens(Distortion("opencv_fisheye"), np.array([5.0, 0.0, 0.0]), np.zeros(6)), Distortion("opencv"), CORNERS_MM
        )
    with pytest.raises(ValueError, match="brown has no parameter a1"):
        convert_lens(Lens(Distortion("opencv"), GIVEN_MM, np.zeros(16)), Distortion("brown"), CORNERS_MM, ("a1",))


@parametrize_with_studies("name", list(nets.LENSES))
def test_nothing_but_the_points_has_to_be_known(name: str) -> None:
    """Neither c nor the principal point; of the fisheye points up to 80 degrees off the axis."""
    network = nets.lens_network(name, np.random.default_rng(1))
    network = nets.set_camera(network, principal_distance_mm=None, x0_mm=None, y0_mm=None)
    start = approximate(network)
    assert start.interior["L"][0] == pytest.approx(nets.LENSES[name][0], rel=0.1)
    found = adjust(network, start)
    assert found.converged
    assert 0.9 < found.sigma0 < 1.1
    assert abs(found.value("IO.L.c") - nets.LENSES[name][0]) < 4.0 * found.sigma("IO.L.c")


def test_every_parameter_has_its_unit_and_a_ladder_names_only_parameters() -> None:
    for name in ("torlegard", "brown", "australis", "aicon", "opencv", "opencv_fisheye", "juhl", "ebner"):
        of = family(name)
        assert all(of.unit(each) for each in of.parameters)
        assert {each for rung in of.ladder for each in rung.split()} <= set(of.parameters)


CORNERS = np.array([(-110.0, -110.0), (110.0, 110.0)])
MARKS = {str(i): np.array(xy, float) for i, xy in enumerate([(-106, -106), (106, -106), (106, 106), (-106, 106)])}
TRUE = np.array([153.0, 0.010, -0.006, -6e-8, 1e-12, 2e-7, -1e-7])  # c, x0, y0, k3, k5, p1, p2
SIGMAS = np.array([0.004, 0.003, 0.003, 8e-9, 4e-13, 6e-8, 6e-8])


def covariance() -> Array:
    """Of c, principal point, k3, k5, k7, p1..p4 and the marks: k3 and k5, x0 and p1 as closely tied as in practice."""
    mixing = np.eye(7)
    mixing[3, 4] = mixing[4, 3] = -0.9
    mixing[1, 5] = mixing[5, 1] = 0.6
    seven = mixing * np.outer(SIGMAS, SIGMAS)
    whole = np.zeros((18, 18))
    at = np.ix_(AT, AT)
    whole[at] = seven
    whole[10:, 10:] = 0.002**2 * np.eye(8)
    return whole


AT = np.array([0, 1, 2, 3, 4, 6, 7])  # in c, x0, y0, k3, k5, k7, p1, p2, p3, p4


def calibration(values: Array, marks: dict[str, Array] | None = None) -> CameraCalibration:
    whole = np.zeros(10)
    whole[AT] = values
    return CameraCalibration(
        "K", Lens(Distortion("torlegard"), whole[:3], whole[3:]), dict(marks or MARKS), covariance(), redundancy=5000
    )


def draw_calibration(rng: np.random.Generator, change: Array | float = 0.0) -> CameraCalibration:
    error = rng.multivariate_normal(np.zeros(18), covariance())
    marks = {id: xy + error[10 + 2 * i : 12 + 2 * i] for i, (id, xy) in enumerate(MARKS.items())}
    return calibration(TRUE + change + error[AT], marks)


def test_false_alarms_come_as_often_as_stated() -> None:
    rng = np.random.default_rng(1)
    probabilities = np.array(
        [compare([draw_calibration(rng), draw_calibration(rng)], CORNERS).same.probability for _ in range(80)]
    )
    for level in (0.05, 0.5):
        expected = 80 * level
        assert abs(int((probabilities < level).sum()) - expected) < 3.5 * np.sqrt(expected * (1 - level))


def test_a_shift_of_the_principal_point_is_no_attitude() -> None:
    """Its chi-square is that of the parameters, of which a shift has no effect only together with that of the marks."""
    change, common = np.zeros((2, 18))
    change[1] = 0.02
    common[1] = common[10::2] = 1.0
    is_free = np.diag(covariance()) > 0.0
    change, common, weight = (
        change[is_free],
        common[is_free],
        np.linalg.inv(2.0 * covariance()[np.ix_(is_free, is_free)]),
    )
    change = change - common * (common @ weight @ change) / (common @ weight @ common)
    found = compare([calibration(TRUE), calibration(TRUE + 0.02 * np.eye(7)[1])], CORNERS).same
    assert found.chi_square == pytest.approx(change @ weight @ change, rel=0.02)
    assert found.freedom == 7 + 8 - 4


def test_no_change_of_a_digital_camera_is_one_of_its_pixels() -> None:
    """Without fiducials all parameters are compared: chi-square is their own."""
    known = covariance()[:10, :10]
    first = replace(calibration(TRUE), fiducials={}, covariance=known)
    for k, change in enumerate(10.0 * SIGMAS[:4]):
        found = compare(
            [first, replace(calibration(TRUE + change * np.eye(7)[k]), fiducials={}, covariance=known)], CORNERS
        )
        weight = np.linalg.inv(2.0 * known[np.ix_(AT, AT)])
        assert found.same.chi_square == pytest.approx(weight[k, k] * change**2, rel=1e-3)
        assert found.same.freedom == 7
        assert found.probability < 0.01


def test_a_trend_is_found() -> None:
    rng = np.random.default_rng(2)
    years, drift = np.array([1952.0, 1955.0, 1961.0, 1970.0]), np.zeros(7)
    drift[3] = 4e-9  # k3 a year
    moving = compare([draw_calibration(rng, drift * (year - years[0])) for year in years], CORNERS, years)
    assert moving.trend is not None
    assert moving.trend.freedom == moving.same.freedom / 3
    assert moving.probability < 1e-3
    still = compare([calibration(TRUE + drift * (year - years[0])) for year in years], CORNERS, years)
    ends = compare([calibration(TRUE), calibration(TRUE + drift * 18.0)], CORNERS)
    assert still.trend_um == pytest.approx(ends.field_um[0], abs=0.05)


def test_without_redundancy_the_standard_deviations_are_taken_as_they_are() -> None:
    """A change of c by ten standard deviations: chi-square, in place of F, with sigma0 given beforehand."""
    change = 10.0 * SIGMAS * np.eye(7)[0]
    assert change[0] == 0.04

    def p(change: Array, *redundancies: float) -> float:
        pair = [calibration(TRUE), calibration(TRUE + change)]
        given = [replace(each, redundancy=r) for each, r in zip(pair, redundancies, strict=True)]
        return compare(given, CORNERS).same.probability

    assert p(change, 0.0, 0.0) == pytest.approx(p(change, 1e9, 1e9), rel=1e-3)
    assert p(change, 0.0, 0.0) < 1e-5
    assert p(change, 0.0, 10.0) == p(change, 10.0, 10.0) > p(change, 0.0, 0.0)
    assert p(0.0 * change, 0.0, 0.0) == 1.0


def test_the_field_is_that_of_the_area_given() -> None:
    """A digital camera's pixels lie to the right of its origin and below: none is at negative x or positive y."""
    corners = np.array([(0.0, -24.0), (36.0, 0.0)])
    found = compare([calibration(TRUE), calibration(TRUE)], corners)
    np.testing.assert_allclose([found.places_mm.min(axis=0), found.places_mm.max(axis=0)], corners)


def test_over_flat_ground_another_principal_distance_is_another_height() -> None:
    change = np.array([0.05, 0.04, 0.0, 0.0, 0.0, 0.0, 0.0])
    pair = [calibration(TRUE), calibration(TRUE + change)]
    assert compare(pair, CORNERS).same.probability < 1e-6
    assert np.abs(compare(pair, CORNERS, use="flat").field_um).max() < 1.0  # what the lens shifts with its point
    assert np.abs(compare(pair, CORNERS).field_um).max() > 3.0


@pytest.mark.parametrize(
    ("count", "times", "words"), [(1, None, "two calibrations or more"), (2, (1960.0, 1950.0), "in rising order")]
)
def test_what_cannot_be_compared_is_refused(count: int, times: tuple[float, ...] | None, words: str) -> None:
    with pytest.raises(AdjustmentError, match=words):
        compare([calibration(TRUE)] * count, CORNERS, times)


def two_networks(kind: Transformation, noise: float) -> tuple[tuple[Network, Approximations], ...]:
    """Two data sets of one camera, their names with an A and a B, and both together; errors as small as one likes."""
    networks = []
    for prefix, seed in (("A{}", 1), ("B{}", 2)):
        rng = np.random.default_rng(seed)
        free = {"k3": np.inf, "p1": np.inf}
        network, start = nets.simulated(rng, None, kind, nets.field_points(rng, 14), 0.0, free, False, 0.002 * noise)
        network = noisy(network, rng, noise)
        networks.append(nets.rename_network(network, start, "K", str, prefix.format, prefix.format))
    a, b = networks
    return a, b, nets.join_networks(a, b)


def make_calibration(result: Adjustment, fiducials: bool) -> Calibration:
    kinds = ("interior", "fiducial") if fiducials else ("interior",)
    taken = [each for each in result.parameters if each.kind in kinds and result.cofactor_of([each])[0, 0] > 0.0]
    return Calibration(tuple(taken), result.values_of(taken), result.cofactor_of(taken))


def set_calibration(network: Network, calibration: Calibration) -> Network:
    """The network with that calibration in the place of the camera's priors."""
    value = dict(zip((each.text for each in calibration.parameters), calibration.values.tolist(), strict=True))
    free = nets.map_priors(network, lambda name, prior: Prior(value[name], np.inf) if name in value else prior)
    return replace(free, calibrations=(calibration,))


@pytest.mark.parametrize("kind", [pytest.param("none", marks=pytest.mark.study), "affine"])
def test_an_earlier_calibration_stands_for_its_observations(kind: Transformation) -> None:
    """A, then B with A's calibration, is A and B together: values, sigmas, v'Pv and redundancy.

    The calibration is A made linear, so that with real errors the difference is of second order, some 5e-4 of the
    standard deviations; with errors of a hundredth it must be a hundred times less.
    """
    differences = []
    for noise in (1.0, 1e-2):
        (a, start_a), (b, start_b), (joint, start_joint) = two_networks(kind, noise)
        first, both = adjust(a, start_a), adjust(joint, start_joint)
        second = adjust(set_calibration(b, make_calibration(first, kind != "none")), start_b)
        assert second.converged
        names = [name for name in second.names if both.cofactor_of([name])[0, 0] > 0.0]
        sigmas = np.sqrt([both.cofactor_of([name])[0, 0] for name in names])
        change = np.array([second.value(name) - both.value(name) for name in names]) / sigmas
        differences.append(float(np.abs(change).max()))
        np.testing.assert_allclose(np.sqrt([second.cofactor_of([n])[0, 0] for n in names]), sigmas, rtol=1e-4 * noise)
        assert first.vpv + second.vpv == pytest.approx(both.vpv, abs=1e-3 * noise)
        assert first.redundancy + second.redundancy == both.redundancy
        assert sum(group.redundancy for group in second.groups.values()) == pytest.approx(second.redundancy)
        assert second.warnings == ()
    assert differences[0] < 1e-3
    assert differences[1] < 1e-5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda n, c: set_calibration(n, replace(c, parameters=(Parameter.interior("K", "q"), *c.parameters[1:]))),
            ["q of camera K", "no camera has"],
        ),
        (lambda n, c: replace(n, calibrations=(c,)), ["c of camera K", "standard deviation of its own (1)", "twice"]),
        (lambda n, c: replace(set_calibration(n, c), calibrations=(c, c)), ["c of camera K", "another calibration"]),
        (
            lambda n, c: set_calibration(n, replace(c, covariance=np.ones_like(c.covariance))),
            ["not positive definite", "c, x0 and y0 of camera K"],
        ),
        (lambda n, c: set_calibration(n, replace(c, covariance=c.covariance[:2])), ["shape (2, 5)"]),
    ],
)
def test_no_such_calibration_is_refused(change: Callable[[Network, Calibration], Network], words: list[str]) -> None:
    network, start = nets.simulated(np.random.default_rng(5), kind="none", free={"k3": np.inf, "p1": np.inf})
    own = tuple(Parameter.interior("K", name) for name in ("c", "x0", "y0", "k3", "p1"))
    calibration = Calibration(own, np.array([153.0, 0.0, 0.0, 1.5e-7, 0.0]), np.diag([1.0, 1.0, 1.0, 1e-18, 1e-16]))
    with pytest.raises(AdjustmentError) as error:
        adjust(change(network, calibration), start)
    for word in words:
        assert word in str(error.value)


def noisy(network: Network, rng: np.random.Generator, scale: float) -> Network:
    """A network without errors to speak of, its observations drawn by covariances so many times as large."""
    rows = network.observations
    covariance = scale**2 * rows.covariance_mm2
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return nets.set_observations(network, xy_mm=rows.xy_mm + rng.normal(0.0, sigma), covariance_mm2=covariance)


def test_an_earlier_calibration_is_tested_as_a_whole() -> None:
    """Against the calibration of the new images alone: d' (C_old + C_new)^-1 d, their sigma0, and d itself."""
    (a, start_a), (b, start_b), _ = two_networks("none", 1.0)
    calibration = make_calibration(adjust(a, start_a), False)
    changed = replace(calibration, values=calibration.values + 2.0 * np.sqrt(np.diag(calibration.covariance)))
    network = set_calibration(b, changed)
    alone = adjust(replace(network, calibrations=()), start_b)
    (found,) = adjust(network, start_b).contradictions
    names = list(calibration.parameters)
    difference = np.array([alone.value(name) for name in names]) - changed.values
    joint = changed.covariance + alone.cofactor_of(names)
    chi_square = difference @ np.linalg.solve(joint, difference)
    assert found.parameters == calibration.parameters
    assert found.freedom == len(names)
    assert found.statistic == pytest.approx(chi_square / len(names) / alone.sigma0**2, rel=0.02)
    sigma = alone.sigma0 * np.sqrt(np.diag(joint))
    np.testing.assert_allclose(found.sigma, sigma, rtol=0.02)
    np.testing.assert_allclose(found.difference / sigma, difference / sigma, atol=0.05)
    assert found.direction[0] == np.argmax(np.abs(difference) / sigma)


def test_a_contradiction_is_reported_next_to_what_the_marks_show() -> None:
    """Fiducials, films and camera together can shift, turn and grow, of which images alone say nothing: what is told is
    what is left where the marks lie over one another."""
    (a, start_a), (b, start_b), _ = two_networks("affine", 1.0)
    calibration = make_calibration(adjust(a, start_a), True)
    c, x0 = (calibration.parameters.index(Parameter.interior("K", name)) for name in ("c", "x0"))
    along_x = np.array([each.quantity in ("x0", "x") for each in calibration.parameters])

    def find(change: NDArray[np.float64]) -> CalibrationTest:
        given = set_calibration(b, replace(calibration, values=calibration.values + change))
        (finding,) = adjust(given, start_b).contradictions
        return finding

    same, shifted = find(0.0 * along_x), find(0.05 * along_x)
    longer = find(0.3 * (np.arange(len(along_x)) == c))
    assert same.freedom == len(same.parameters) - 4
    assert same.probability > 1e-3
    assert np.isfinite(same.difference).all()
    np.testing.assert_allclose(shifted.difference / same.sigma, same.difference / same.sigma, atol=0.05)
    assert longer.direction[0] == c
    assert longer.difference[c] == pytest.approx(same.difference[c] - 0.3, abs=0.01)
    assert longer.difference[x0] == pytest.approx(same.difference[x0], abs=0.2 * same.sigma[x0])


def test_a_fisheye_is_displaced_from_the_equidistant_projection() -> None:
    """By Kannala and Brandt's polynomial of the angle, out to 85 degrees; its derivatives by differences."""
    k, c = np.array([0.05, -0.01, 0.004, -0.001]), 4.0
    angle = np.radians([1.0, 30.0, 60.0, 85.0])
    xy = np.outer(c * angle * (1.0 + np.vander(angle**2, 5, increasing=True)[:, 1:] @ k), [0.6, -0.8])
    lens = Lens(Distortion("opencv_fisheye"), np.array([c, 0.0, 0.0]), np.append(k, [0.0, 0.0]))
    found = lens.displacement(xy)
    np.testing.assert_allclose(found.value_um, xy * 1e3 - np.outer(1e3 * c * angle, [0.6, -0.8]), atol=1e-6)
    for number in range(5):
        step = 1e-6 * np.eye(7)[number]
        near = [
            Lens(lens.distortion, lens.interior + sign * step[0] * np.eye(3)[0], lens.parameters + sign * step[1:])
            for sign in (1.0, -1.0)
        ]
        by = np.subtract(*(each.displacement(xy).value_um for each in near)) / 2e-6
        np.testing.assert_allclose(found.by_unknowns_um[..., number], by, rtol=1e-5, atol=1e-4)
    pinhole_um = lens.displacement(xy, of_pinhole=True).value_um
    np.testing.assert_allclose(pinhole_um, 1e3 * (xy - np.outer(c * np.tan(angle), [0.6, -0.8])), atol=1e-6)
