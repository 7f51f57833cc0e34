"""The adjustment against reference cases, a dense implementation by complex steps, and published calibrations."""

import random
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

import networks as nets
import numpy as np
import pytest
from dense_adjustment import solve_densely
from numpy.typing import NDArray
from real_data import DATA, needs
from reference_cases import CAMERA, Case, case_approximations, case_network, load, own_name
from scipy.io import loadmat
from studies import parametrize_with_studies

from adjust import Adjustment, Camera, Distortion, Fiducial, Network, ObjectPoint, Options, Prior, adjust, approximate
from adjust.least_squares import iteration
from adjust.linear_algebra.factor import Factor
from adjust.problem.network import Approximations, Exterior, LineOfSight
from adjust.problem.unknowns import Reduction
from adjust.solution.adjustment import Datum

CASES = (
    "i_five_images_affine_reduced",
    "i_five_images_affine_paper_noisefree",
    "i_five_images_similarity_reduced",
    "ii_juhl_3photos",
    "iii_selfcal_mixed",
    "iii_selfcal_all_unknown_datum_A",
    "iv_planar_board",
)


def adjust_network(case: Case, network: Network | None = None) -> Adjustment:
    network = network or case_network(case)
    return adjust(network, case_approximations(case, case["input"]["initial_approximations"]), Options())


def differences(case: Case, result: Adjustment) -> np.ndarray:
    """Estimates less the reference's, in the reference's a-priori standard deviations."""
    parameters = case["result"]["parameters"]
    return np.array([(result.value(own_name(key)) - p["value"]) / p["std_apriori"] for key, p in parameters.items()])


@pytest.mark.parametrize("name", CASES)
def test_reference_case(name: str) -> None:
    case = load(name)
    reference = case["result"]
    result = adjust_network(case)

    assert result.converged
    counts = (result.conditions, result.unknowns, result.redundancy)
    assert counts == (reference["conditions"], reference["unknowns"], reference["redundancy"])
    assert np.abs(differences(case, result)).max() < 1e-8
    sigmas = np.sqrt([result.cofactor.variances[result.index(own_name(each))] for each in reference["parameters"]])
    expected = np.array([row["std_apriori"] for row in reference["parameters"].values()])
    np.testing.assert_allclose(sigmas, expected, rtol=1e-9)
    if reference["vpv"] > 1e-12:
        posterior = [row["std_aposteriori"] for row in reference["parameters"].values()]
        np.testing.assert_allclose([result.sigma(own_name(n)) for n in reference["parameters"]], posterior, rtol=1e-9)
    assert result.vpv == pytest.approx(reference["vpv"], rel=1e-8, abs=1e-15)
    assert result.history[-1][0] == pytest.approx(result.vpv)
    v = np.array(reference["residuals_obs"] + reference["residuals_fobs"])
    np.testing.assert_allclose(result.residuals.v_mm, v, rtol=0, atol=1e-11)
    redundancy = reference["redundancy_numbers"][: v.size]
    np.testing.assert_allclose(result.residuals.redundancy.ravel(), redundancy, rtol=0, atol=1e-9)
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(result.redundancy)


@pytest.mark.parametrize("name", ["i_five_images_affine_reduced", "iii_selfcal_mixed"])
def test_the_order_of_inputs_does_not_matter(name: str) -> None:
    case = load(name)
    network = case_network(case)
    order = list(range(len(network.observations)))
    random.Random(7).shuffle(order)
    shuffled = Network(
        network.cameras,
        network.images[::-1],
        tuple(sorted(network.points, key=lambda point: point.id[::-1])),
        network.observations.only(np.array(order)),
    )
    plain, other = adjust_network(case), adjust_network(case, shuffled)
    for i, unknown in enumerate(plain.names):
        sigma = max(np.sqrt(plain.cofactor.variances[i]), 1e-30)
        assert abs(plain.values[i] - other.value(unknown)) <= 1e-9 * sigma
    np.testing.assert_allclose(other.residuals.w, plain.residuals.w[order], atol=1e-8)


def test_an_iteration_limit_is_reported() -> None:
    case = load("i_five_images_affine_reduced")
    start = case_approximations(case, case["input"]["initial_approximations"])
    network = case_network(case)
    result = adjust(network, start, Options(iteration_limit=2))
    assert result.termination == "iteration limit"
    assert not result.converged
    assert "not final" in " ".join(result.warnings)
    assert "largest residuals" not in " ".join(result.warnings)


def test_equations_that_are_singular_in_digits_are_damped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The equations at the start have no solution without damping."""

    class Singular(Factor):
        @property
        def solution(self) -> NDArray[np.float64]:
            raise np.linalg.LinAlgError("singular")

    network, start = nets.simulated(np.random.default_rng(1))
    expected, factorise, begun = adjust(network, start), iteration.factorise, list[float]()

    def first_singular(*equations: Any, **options: Any) -> Factor:
        factor = factorise(*equations, **options)
        begun.append(factor.length())
        return Singular(*(getattr(factor, each.name) for each in fields(factor))) if len(begun) == 1 else factor

    monkeypatch.setattr(iteration, "factorise", first_singular)
    result = adjust(network, start)
    assert result.converged
    assert result.run.solution.history[0].damping > 0.0
    np.testing.assert_allclose(result.values, expected.values, atol=1e-9)


def test_a_mark_and_a_picture_under_two_names_are_named() -> None:
    network, start = nets.simulated(np.random.default_rng(1), nets.Truth())
    assert not any("two names" in each for each in adjust(network, start).warnings)
    rows, known = network.observations, network.point_by_id["3"]
    is_target = [kind == "target" for kind in rows.kind]
    own = [row for row, point in enumerate(rows.point) if point == "3" and is_target[row]]
    other = replace(rows.only(np.array(own)), point=("3 again",) * len(own))
    twice = replace(network, points=(*network.points, replace(known, id="3 again")))
    twice = replace(twice, observations=nets.join_observations(rows, other))
    assert any("3 again and 3: a mark under two names" in each for each in adjust(twice, start).warnings)
    copied = nets.join_networks((network, start), nets.rename_network(network, start, "K", str, "{} again".format, str))
    assert any("f0 again as f0" in each for each in adjust(*copied).warnings)


def test_a_point_with_approximations_whose_rays_do_not_meet_is_left_out() -> None:
    points = nets.field_points(np.random.default_rng(2), 14)
    network, _ = nets.simulated(np.random.default_rng(1), points=points, point_sigma=np.inf)
    known = (nets.set_sigma(each, nets.KNOWN if int(each.id) < 8 else nets.UNKNOWN) for each in network.points)
    network = nets.keep_rows(network, lambda image, point, kind: kind == "fiducial" or point != "12" or image < "f2")
    off = {nets.observation_row(network, "target", "f1", "12"): np.array([60.0, -70.0])}
    result = adjust(nets.add_errors(replace(network, points=tuple(known)), off))
    assert result.converged
    assert list(result.unmet) == ["12"]


def test_opencvs_own_calibration_of_the_planar_board() -> None:
    """The `opencv` family on OpenCV's observations: its parameters, its standard deviations, its rms per point."""
    case = load("iv_planar_board")
    opencv, pixel_mm = case["opencv"], case["pixels"]["pixel_mm"]
    names = ("k1", "k2", "p1", "p2", "k3")
    free = {name: Prior(0.0, np.inf) for name in names}
    result = adjust_network(case, nets.set_camera(case_network(case), distortion=Distortion("opencv", free)))
    assert result.converged

    half_width, half_height = (case["pixels"]["width"] - 1) / 2, (case["pixels"]["height"] - 1) / 2
    expected = {
        "c": (opencv["fx"] * pixel_mm, opencv["std"]["f"] * pixel_mm),
        "x0": ((opencv["cx"] - half_width) * pixel_mm, opencv["std"]["cx"] * pixel_mm),
        "y0": (-(opencv["cy"] - half_height) * pixel_mm, opencv["std"]["cy"] * pixel_mm),
    }
    expected |= dict(zip(names, zip(opencv["k1k2p1p2k3"], opencv["std"]["k1k2p1p2k3"], strict=True), strict=True))
    for name, (value, sigma) in expected.items():
        assert result.value(f"IO.{CAMERA}.{name}") == pytest.approx(value, abs=1e-3 * sigma)
        assert result.sigma(f"IO.{CAMERA}.{name}") == pytest.approx(sigma, rel=1e-3)
    rms_px = np.sqrt((result.residuals.v_mm**2).sum(axis=1).mean()) / pixel_mm
    assert rms_px == pytest.approx(opencv["rms_px"], rel=1e-6)


Variant = tuple[Network, Approximations]

STEEP = ((0.02, -1.55, 0.1), (-0.03, 1.53, 3.1), (-1.6, 0.05, 3.139), (0.02, -0.03, -3.141))


def mirrored() -> Variant:
    truth = nets.Truth(mirrored=(False, True, True, False))
    return nets.simulated(np.random.default_rng(3), truth, "congruent", free={"p1": np.inf, "p2": np.inf})


def steep_angles() -> Variant:
    """A level camera that looks along +-X (phi near +-90), one upside down (omega beyond 90), kappa past 180."""
    stations = ((-1500.0, 20.0, 30.0), (1500.0, -30.0, 10.0), (40.0, 1500.0, 60.0), (10.0, -20.0, 1500.0))
    truth, points = (
        nets.Truth(stations=stations, attitudes=STEEP),
        nets.field_points(np.random.default_rng(4), 12, 700.0),
    )
    return nets.simulated(np.random.default_rng(4), truth, "affine", points=points)


def observed_orientations() -> Variant:
    """Every element observed, one image's angles fixed, one with a free element; unknown points."""
    network, start = nets.simulated(np.random.default_rng(5), point_sigma=np.inf, free={"k3": np.inf})
    rng = np.random.default_rng(50)
    exteriors = {}
    for i, values in enumerate(map(np.copy, start.exterior.values())):
        sigmas = np.array([2.0, 2.0, 2.0, 0.01, 0.01, 0.01])
        if i == 1:
            sigmas[3:] = 0.0
            values[3:] = nets.Truth().attitudes[1]
        if i == 2:
            sigmas[[2, 5]] = np.inf
        values[:3] = nets.Truth().stations[i] + rng.normal(0, 2.0, 3)
        values[5] += 2 * np.pi * (i == 3)  # a whole turn more is the same angle
        exteriors[f"f{i}"] = Exterior(values, sigmas)
    return nets.orient(network, exteriors), start


def heights_and_mixtures() -> Variant:
    """Points known, known in height, known in plan, roughly known, unknown."""
    network, start = nets.simulated(np.random.default_rng(6), free={"k3": np.inf})
    rng = np.random.default_rng(60)
    kinds = [(0, 0, 0), (None, None, 0.01), (0.01, 0.01, None), (0.05, 0.02, 0.1), (None,) * 3]
    points = []
    for i, point in enumerate(network.points):
        sigmas = kinds[i % 5] if i > 2 else (0, 0, 0)
        given = [
            None if sigma is None else Prior(value + rng.normal(0, sigma or 1e-12), float(sigma))
            for sigma, value in zip(sigmas, start.points[point.id], strict=True)
        ]
        points.append(ObjectPoint(point.id, *given))
    return replace(network, points=tuple(points)), start


def fiducials_fixed_free_and_given() -> Variant:
    """Two marks fixed, one free, the others with priors of their own; a mark that one image shows alone."""
    network, start = nets.simulated(np.random.default_rng(8), free={"k3": np.inf}, fiducial_sigma=0.002)
    marks = dict(network.cameras[0].fiducials)
    for id_, sigma in {"1": 0.0, "2": 0.0, "3": np.inf, "5": 0.01}.items():
        marks[id_] = Fiducial(Prior(marks[id_].x_mm.value, sigma), Prior(marks[id_].y_mm.value, 2 * sigma))
    return nets.set_camera(network, fiducials=marks), start


@pytest.mark.parametrize(
    "case", [mirrored, steep_angles, observed_orientations, heights_and_mixtures, fiducials_fixed_free_and_given]
)
def test_variant(case: Callable[[], Variant]) -> None:
    network, start = case()
    result = adjust(network, start)
    assert result.converged
    dense = solve_densely(network, result)
    assert result.redundancy == dense.redundancy
    assert result.vpv == pytest.approx(dense.vpv, rel=1e-8)
    cofactor = result.cofactor_of(list(dense.sigmas)).diagonal()
    for (name, sigma), variance in zip(dense.sigmas.items(), cofactor, strict=True):
        assert abs(result.value(name) - dense.values[name]) < 1e-6 * sigma, name
        assert np.sqrt(variance) == pytest.approx(sigma, rel=1e-6), name


Array = NDArray[np.float64]

FAR = np.array([500_000.0, 5_400_000.0, 300.0])
GRID = 2.0**-20  # coordinates that are a multiple of it lose no digit beside FAR


def small_network(sigma: float = 0.0) -> tuple[Network, Approximations]:
    """A field of 1.6 m at 1.5 m, whose stations are known to some hundredths of a millimetre."""
    stations = tuple((0.001 * x, 0.001 * y, 0.001 * z) for x, y, z in nets.Truth().stations)
    points = GRID * np.round(nets.field_points(np.random.default_rng(2), 20) * 0.001 / GRID)
    free = {"k3": np.inf, "k5": np.inf}
    return nets.simulated(
        np.random.default_rng(3), nets.Truth(stations=stations), points=points, point_sigma=sigma, free=free
    )


def shifted(network: Network, shift: Array) -> Network:
    """With points rounded to the grid and shifted."""

    def moved(name: str, prior: Prior) -> Prior:
        if not name.startswith("PT."):
            return prior
        return replace(prior, value=GRID * round(prior.value / GRID) + float(shift["XYZ".index(name[-1])]))

    return nets.map_priors(network, moved)


def sigmas_apart(here: Adjustment, there: Adjustment) -> float:
    """The largest difference of what does not move with the object, in standard deviations."""
    sigma = np.sqrt(here.cofactor.variances)
    still = [i for i, name in enumerate(here.names) if name.rsplit(".", 1)[1] not in ("X", "Y", "Z", "X0", "Y0", "Z0")]
    free = [i for i in still if sigma[i] > 0.0]
    assert np.sqrt(there.cofactor.variances[free]) == pytest.approx(sigma[free], rel=1e-6)
    return float(np.abs((there.values - here.values)[free] / sigma[free]).max())


@parametrize_with_studies(("sigma", "datum"), [(0.0, "control"), (0.0005, "control"), (np.inf, "free")])
def test_a_network_with_seven_digits_comes_to_the_same_result(sigma: float, datum: Datum) -> None:
    network = shifted(small_network(sigma)[0], np.zeros(3))
    here = adjust(network, options=Options(datum=datum))
    there = adjust(shifted(network, FAR), options=Options(datum=datum))
    assert here.converged
    assert (there.termination, there.iterations) == ("converged", here.iterations)
    assert sigmas_apart(here, there) < 1e-6
    for name in ("PT.3.X", "EO.f1.X0", "EO.f2.Y0"):
        axis = "XYZ".index(name.rsplit(".", 1)[1][0])
        assert there.value(name) - FAR[axis] == pytest.approx(here.value(name), abs=2e-9)


def test_fixed_coordinates_come_back_as_they_were_given() -> None:
    network = shifted(small_network()[0], FAR + np.array([0.1, 0.2, 0.3]))
    there = adjust(network)
    given = [prior.value for point in network.points for prior in (point.X, point.Y, point.Z) if prior]
    assert [there.value(f"PT.{point.id}.{axis}") for point in network.points for axis in "XYZ"] == given
    assert there.network is network


def test_heights_stay_where_the_line_of_sight_depends_on_them() -> None:
    network = shifted(small_network()[0], np.array([5e5, 5.4e6, 2500.0]))
    assert Reduction.to_centroid(network).origin[2] != 0.0
    bent = replace(network, line_of_sight=LineOfSight(curvature=True))
    assert Reduction.to_centroid(bent).origin[2] == 0.0
    assert (Reduction.to_centroid(bent).origin[:2] != 0.0).all()


FILE = DATA / "chessboards" / "bouguet" / "Calib_Results.mat"

PITCH_MM = 0.01
IMAGES = tuple(str(i) for i in range(1, 21))


def make_network(published: dict[str, Any]) -> Network:
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "p1", "p2", "b1")}
    camera = Camera("camera", None, None, None, Distortion("opencv", free), center_mm=(3.195, -2.395))
    board = published["X_1"].T
    assert all((board == published[f"X_{image}"].T).all() for image in IMAGES)
    rows = [(i, str(k), xy * [PITCH_MM, -PITCH_MM]) for i in IMAGES for k, xy in enumerate(published[f"x_{i}"].T)]
    return nets.digital_network(camera, rows, {str(k): xyz for k, xyz in enumerate(board)}, 0.15 * PITCH_MM)


def pixel_intrinsics(adjustment: Adjustment) -> tuple[Array, Array]:
    """fx, fy, cx, cy, k1, k2, p1, p2 and their standard deviations."""
    names = [f"IO.camera.{name}" for name in ("c", "b1", "x0", "y0", "k1", "k2", "p1", "p2")]
    rows = [adjustment.index(name) for name in names]
    c, b1, x0, y0, *distortion = adjustment.values[rows]
    by_own = np.eye(8)
    by_own[:4, :4] = 0.0
    by_own[0, :2], by_own[1, 0], by_own[2, 2], by_own[3, 3] = (1 + b1, c), 1.0, 1.0, -1.0
    by_own[:4] /= PITCH_MM
    covariance = by_own @ (adjustment.sigma0**2 * adjustment.cofactor_of(names)) @ by_own.T
    values = np.array([c * (1 + b1) / PITCH_MM, c / PITCH_MM, x0 / PITCH_MM, -y0 / PITCH_MM, *distortion])
    return values, np.sqrt(np.diag(covariance))


@needs("chessboards", "bouguet", "Calib_Results.mat")
def test_values_standard_deviations_and_residuals_are_the_published_ones() -> None:
    """Values within a tenth of the published standard deviations."""
    published = loadmat(FILE)
    network = make_network(published)
    adjustment = adjust(network, approximate(network))
    values, sigmas = pixel_intrinsics(adjustment)
    expected, three_sigmas = (
        np.concatenate([published[name + ending].ravel() for name in ("fc", "cc", "kc")])[:8]
        for ending in ("", "_error")
    )
    assert (np.abs(values - expected) < 0.1 * three_sigmas / 3.0).all()
    np.testing.assert_allclose(sigmas, three_sigmas / 3.0, rtol=0.02)
    rms_px = np.sqrt((adjustment.residuals.v_mm**2).mean(axis=0)) / PITCH_MM
    np.testing.assert_allclose(rms_px, published["err_std"].ravel(), rtol=1e-3)


FOLDER = DATA / "coded" / "camcal" / "camcaldemo"

PIXEL_MM = np.array([5.43764 / 1704 * 1.000389598, 5.43764 / 1704])
SIGMA_PX = 0.1
PUBLISHED = {  # value and standard deviation; brown's signs are the opposite of that program's
    "c": (7.457, 0.00105),
    "x0": (3.61546 * 1.000389598, 0.00082),
    "y0": (-2.61329, 0.00098),
    "k1": (-4.58861e-3, 2.21e-5),
    "k2": (4.51351e-5, 2.65e-6),
    "k3": (2.05253e-6, 1.01e-7),
    "p1": (6.12803e-5, 3.52e-6),
    "p2": (4.41172e-5, 3.94e-6),
}


def network_of_demo() -> Network:
    known = {row[0]: np.array(row[2:5], float) for row in table(FOLDER / "reference" / "camcal-fixed.txt")}
    marks = table(FOLDER / "measurements" / "markpts.txt")
    free = {name: Prior(0.0, np.inf) for name in ("k1", "k2", "k3", "p1", "p2", "b1")}
    camera = Camera("C4040Z", None, None, None, Distortion("brown", free), center_mm=(3.6265, -2.7188))
    rows = [(row[0], row[1], np.array([float(row[2]), -float(row[3])]) * PIXEL_MM) for row in marks]
    network = nets.digital_network(camera, rows, known, SIGMA_PX * PIXEL_MM[1])
    unknown = sorted({row[1] for row in marks} - known.keys())
    return replace(network, points=(*network.points, *(ObjectPoint(point, None, None, None) for point in unknown)))


def table(file: Path) -> list[list[str]]:
    lines = file.read_text().splitlines()
    return [[cell.strip() for cell in line.split(",")] for line in lines if line.strip() and not line.startswith("#")]


@needs("coded", "camcal", "camcaldemo")
@pytest.mark.study
@pytest.mark.parametrize(
    ("method", "sigma0_px", "off_px", "off_sigmas", "sigmas_off"),
    [("elements", 0.16148, 1e-5, 0.1, 0.005), ("combined", 0.1555, 2e-4, 0.5, 0.03)],
)
def test_the_published_result_is_found_from_nothing(
    method: Literal["elements", "combined"], sigma0_px: float, off_px: float, off_sigmas: float, sigmas_off: float
) -> None:
    """By elements to the last digit of sigma0; by the strict model nearly so."""
    network = network_of_demo()
    adjustment = adjust(network, approximate(network), Options(method=method))
    assert adjustment.converged
    assert adjustment.redundancy == 3725
    assert adjustment.sigma0 * SIGMA_PX == pytest.approx(sigma0_px, abs=off_px)
    for name, (value, sigma) in PUBLISHED.items():
        assert abs(adjustment.value(f"IO.C4040Z.{name}") - value) < off_sigmas * sigma, name
        assert adjustment.sigma(f"IO.C4040Z.{name}") == pytest.approx(sigma, rel=sigmas_off), name
