"""The check against OpenCV: its calibration of the same points, and lenses brought to its models."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from networks import (
    CONVERGENT_STATIONS,
    LENSES,
    PROJECTED_C_MM,
    PROJECTED_SIGMA_MM,
    SIX_MARKS_MM,
    X0_MM,
    Y0_MM,
    given_interior,
    given_marks,
    lens_network,
    project_field,
    relief_field,
)
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust import Camera, Network, ObjectPoint, Options, adjust, approximate
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.lens_conversion import convert_lens
from adjust.problem.network import Transformation
from adjust.problem.observations import Observations
from pipeline.opencv_check.check import check_against_opencv
from pipeline.opencv_check.opencv_calibration import (
    FISHEYE,
    NAMES,
    Freedom,
    OpenCvCalibration,
    calibrate,
    camera_matrix,
    fixed,
    model_names,
    opencv_values,
    to_opencv_model,
)
from pipeline.results.record_json import plain_json
from pipeline.results.stage_files import CameraCheck, Check

Array = NDArray[np.float64]

MODERATE = (-0.002, 0.001, 5e-5, -3e-5, 0.0)  # 150 um in the frame's corner
VERTICAL = [(0.0, 0.0, 1530.0, 0.0, 0.0, 0.3)]
STRONG = (-0.06, 0.02, 1e-4, -5e-5, 0.0)  # 4 mm in the frame's corner
FREE = np.inf
TILT = ("tau_x", "tau_y")
NO_DISTORTION = Distortion()


def simulated(
    stations: Sequence[tuple[float, float, float, float, float, float]],
    *,
    relief_m: float = 300.0,
    film: bool = True,
    lens: Sequence[float] = MODERATE,
    aspect: float = 1.0,
    noise_mm: float = PROJECTED_SIGMA_MM,
    distortion: Distortion = NO_DISTORTION,
) -> Network:
    """Frames of a test field through a known lens, with priors of 1 mm on the interior; marks all but fixed."""
    kind: Transformation = "affine" if film else "none"
    network = project_field(
        relief_field(relief_m, n=60), stations, kind=kind, noise_mm=noise_mm, distortion=lens, aspect=aspect
    ).network
    marks = given_marks(SIX_MARKS_MM, 0.001) if film else {}
    camera = Camera("rc20", *given_interior((PROJECTED_C_MM + 0.3, 0.0, 0.0)), distortion, marks)
    return replace(network, cameras=(camera,))


def free(family: str, *names: str) -> Distortion:
    return Distortion(family, {name: Prior(0.0, FREE) for name in names})


FREE_LENS = free("torlegard", "k3", "k5", "k7", "p1", "p2")


def check_network(network: Network) -> CameraCheck:
    return check_against_opencv(adjust(network, approximate(network))).cameras["rc20"]


@pytest.mark.parametrize(
    ("distortion", "aspect"),
    [
        (FREE_LENS, 1.0),
        (free("brown", "k1", "k2", "k3", "p1", "p2", "b1"), 1.0003),
        (free("opencv", "k1", "k2", "p1", "p2", "k3"), 1.0),
        (free("opencv", "k1", "k2", "p1", "p2", "b1"), 1.0003),
    ],
    ids=["torlegard", "brown", "opencv", "opencv two focal lengths"],
)
@pytest.mark.parametrize("film", [True, False], ids=["film", "digital"])
def test_a_moderate_lens_agrees_to_a_tenth_of_a_sigma(distortion: Distortion, aspect: float, film: bool) -> None:
    check = check_network(simulated(CONVERGENT_STATIONS, film=film, distortion=distortion, aspect=aspect))
    assert check.verdict == "agrees", check.reason
    assert check.images == 5
    assert check.refit_residual_um < 0.02
    assert check.rms_opencv_um == pytest.approx(check.rms_reseau_um, rel=1e-3)
    for row in check.rows:
        assert row.difference_sigmas < 0.1
        assert row.reseau.sigma == pytest.approx(row.opencv.sigma, rel=0.03)
    assert {row.name for row in check.rows} >= {"fx", "cx", "cy", "k1", "k2", "p1", "p2"}
    assert ("fy" in {row.name for row in check.rows}) == (aspect != 1.0)


@pytest.mark.parametrize("unit", [1e-6, 1e3])
def test_the_unit_of_the_object_costs_opencv_no_digits(unit: float) -> None:
    """Objects of half a millimetre made its standard deviations wrong by factors of thousands."""
    network = simulated(CONVERGENT_STATIONS, film=False, distortion=free("opencv", "k1", "k2", "p1", "p2", "k3"))
    network = replace(network, cameras=tuple(replace(each, fiducials={}) for each in network.cameras))
    points = tuple(
        ObjectPoint(each.id, *(prior and Prior(unit * prior.value, prior.sigma) for prior in (each.X, each.Y, each.Z)))
        for each in network.points
    )
    scaled, plain = check_network(replace(network, points=points)), check_network(network)
    assert (scaled.verdict, plain.verdict) == ("agrees", "agrees")
    for row, same in zip(scaled.rows, plain.rows, strict=True):
        assert row.opencv.sigma == pytest.approx(same.opencv.sigma, rel=1e-3)
        assert row.opencv.sigma == pytest.approx(row.reseau.sigma, rel=0.05)


def test_parameters_found_are_those_simulated() -> None:
    rows = {row.name: row for row in check_network(simulated(CONVERGENT_STATIONS, distortion=FREE_LENS)).rows}
    truth = (PROJECTED_C_MM, X0_MM, Y0_MM, *MODERATE[:4])
    for name, value in zip(("fx", "cx", "cy", "k1", "k2", "p1", "p2"), truth, strict=True):
        # the marks carry a part of the uncertainty that both programs take as known
        assert abs(rows[name].reseau.value - value) < 5 * rows[name].reseau.sigma
        assert abs(rows[name].opencv.value - value) < 5 * rows[name].opencv.sigma


def test_fixed_distortion_stays_fixed() -> None:
    fixed = Distortion("opencv", {name: Prior(v) for name, v in zip(("k1", "k2", "p1", "p2"), MODERATE, strict=False)})
    check = check_network(simulated(CONVERGENT_STATIONS, distortion=fixed))
    assert check.verdict == "agrees", check.reason
    assert [row.name for row in check.rows] == ["fx", "cx", "cy"]
    assert max(row.difference_sigmas for row in check.rows) < 0.1


@pytest.mark.parametrize("known", [False, True])
def test_a_tilted_sensor_agrees(known: bool) -> None:
    tilt = (0.03, -0.02)
    lens = (*MODERATE, *[0.0] * (12 - len(MODERATE)), *tilt)
    priors = {
        name: Prior(value if known else 0.0, 0.0 if known else FREE) for name, value in zip(TILT, tilt, strict=True)
    }
    given = free("opencv", "k1", "k2")
    distortion = replace(given, parameters={**given.parameters, **priors})
    network = simulated(CONVERGENT_STATIONS, lens=lens, distortion=distortion)
    # A tilted sensor is all but another principal point.
    held = replace(network.cameras[0], x0_mm=Prior(X0_MM), y0_mm=Prior(Y0_MM))
    check = check_network(replace(network, cameras=(held,)))
    assert check.verdict == "agrees", check.reason
    assert [row.name for row in check.rows] == ["fx", "k1", "k2", *(() if known else TILT)]
    assert max(row.difference_sigmas for row in check.rows) < 0.1


def test_exact_observations_agree_as_far_as_single_precision_goes() -> None:
    distortion = free("opencv", "k1", "k2", "p1", "p2")
    check = check_network(simulated(CONVERGENT_STATIONS, noise_mm=0.0, distortion=distortion))
    assert check.verdict == "agrees", check.reason
    assert check.rms_opencv_um < 0.02


def test_one_flat_vertical_frame_is_not_possible_and_the_reason_is_reported() -> None:
    check = check_network(simulated(VERTICAL, relief_m=0.0, lens=[0.0] * 5))
    assert check.verdict == "not possible"
    assert check.reason.startswith("Priors carried the solution")
    assert not check.rows


def test_unknown_points_are_reported() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=FREE_LENS)
    points = tuple(
        ObjectPoint(p.id, None, None, None) if int(p.id[1:]) >= 30 and count_rays(network, p.id) > 1 else p
        for p in network.points
    )
    check = check_network(replace(network, points=points))
    unknown = sum(point.X is None for point in points)
    assert unknown > 5
    assert check.verdict == "agrees", check.reason
    assert f"{unknown} points have standard deviations" in check.reason
    assert max(row.difference_sigmas for row in check.rows) < 0.1


def count_rays(network: Network, point: str) -> int:
    return network.observations.point.count(point)


def test_different_standard_deviations_are_reported() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=FREE_LENS)
    covariance = network.observations.covariance_mm2.copy()
    covariance[::2] *= 9.0
    check = check_network(replace(network, observations=replace(network.observations, covariance_mm2=covariance)))
    assert "differ up to 3" in check.reason


def test_a_prior_that_contradicts_the_observations_differs() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=FREE_LENS)
    camera = replace(network.cameras[0], principal_distance_mm=Prior(PROJECTED_C_MM + 0.2, 0.002))
    check = check_network(replace(network, cameras=(camera,)))
    assert check.verdict == "differs"
    assert "Priors or weights move c" in check.reason


def test_wrong_values_in_an_adjustment_differ() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=FREE_LENS)
    adjustment = adjust(network, approximate(network))
    values = adjustment.values.copy()
    values[adjustment.index("IO.rc20.c")] += 0.5
    assert check_against_opencv(replace(adjustment, values=values)).verdict == "differs"


@pytest.mark.parametrize("family", ["torlegard", "brown"])
def test_a_strong_lens_agrees_by_way_of_the_same_model(family: str) -> None:
    names = {"torlegard": ("k3", "k5", "k7", "p1", "p2"), "brown": ("k1", "k2", "k3", "p1", "p2")}[family]
    stations, lens = CONVERGENT_STATIONS * 4, free(family, *names)
    check = check_network(simulated(stations, film=False, lens=STRONG, noise_mm=0.002, distortion=lens))
    assert check.verdict == "agrees", check.reason
    assert check.reason.startswith("Given the very same model both programs agree.")
    assert max(row.difference_sigmas for row in check.rows) > 1.0


@parametrize_with_studies("skew", [True, False], ids=["skew", "no skew"])
def test_a_fisheye_agrees_with_opencvs_fisheye(skew: bool) -> None:
    """Which estimates both focal lengths or none: one of them free here is two for the comparison."""
    network = lens_network("opencv_fisheye", np.random.default_rng(2))
    if not skew:
        camera = network.cameras[0]
        lens = {"k1": Prior(0.0, FREE), "k2": Prior(0.0, FREE), "b2": Prior(LENSES["opencv_fisheye"][1]["b2"], 0.0)}
        network = replace(network, cameras=(replace(camera, distortion=Distortion("opencv_fisheye", lens)),))
    check = check_against_opencv(adjust(network)).cameras["L"]
    names = ["fx", "fy", "cx", "cy", "k1", "k2", *(["alpha"] if skew else [])]
    assert [row.name for row in check.rows] == names
    if skew:
        assert check.verdict == "agrees", check.reason
        assert max(row.difference_sigmas for row in check.rows) < 1e-4
        assert max(abs(row.reseau.sigma / row.opencv.sigma - 1.0) for row in check.rows) < 1e-4
        values = adjust(network).values.copy()
        values[adjust(network).index("IO.L.c")] += 0.05
        assert check_against_opencv(replace(adjust(network), values=values)).verdict == "differs"
    else:  # b1 was held at 0 and is 4e-4
        assert check.verdict == "differs"
        assert "Priors or weights move b1" in check.reason


@pytest.mark.parametrize("what", ["parameters", "sigmas"])
def test_another_solution_of_opencv_differs(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    def shifted(*arguments: Any, **options: Any) -> OpenCvCalibration:
        found = calibrate(*arguments, **options)
        if what == "sigmas":
            return replace(found, sigmas=1.4 * found.sigmas)
        return replace(found, parameters=found.parameters + 1.5 * found.sigmas)

    monkeypatch.setattr("pipeline.opencv_check.check.calibrate", shifted)
    check = check_network(simulated(CONVERGENT_STATIONS, distortion=FREE_LENS))
    assert check.verdict == "differs"
    assert ("factor of 1.4" if what == "sigmas" else "by 1.5") in check.reason


def test_every_run_gets_the_same_digits_of_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV's threads add up the images in the order in which they end, and the last digits go by it."""
    given, threads = list[Callable[[], OpenCvCalibration]](), []
    plain = cv2.calibrateCameraExtended

    def keep(*arguments: Any, **options: Any) -> OpenCvCalibration:
        given.append(partial(calibrate, *arguments, **options))
        return calibrate(*arguments, **options)

    def watched(*arguments: Any, **options: Any) -> Any:
        threads.append(cv2.getNumThreads())
        return plain(*arguments, **options)

    monkeypatch.setattr("pipeline.opencv_check.check.calibrate", keep)
    monkeypatch.setattr(cv2, "calibrateCameraExtended", watched)
    before = cv2.getNumThreads()
    cv2.setNumThreads(4)
    try:
        check_network(simulated(CONVERGENT_STATIONS, distortion=FREE_LENS))
        found = [given[0]() for _ in range(40)]
        assert cv2.getNumThreads() == 4
    finally:
        cv2.setNumThreads(before)
    assert set(threads) == {1}
    digits = {(each.parameters.tobytes(), each.sigmas.tobytes(), each.rms_um) for each in found}
    assert len(digits) == 1


@pytest.mark.study
def test_what_robust_estimation_set_aside_is_left_out() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=FREE_LENS)
    xy_mm = network.observations.xy_mm.copy()
    targets = [row for row, kind in enumerate(network.observations.kind) if kind == "target"]
    xy_mm[targets[::40]] += 0.5
    spoiled = replace(network, observations=replace(network.observations, xy_mm=xy_mm))
    adjustment = adjust(spoiled, approximate(spoiled), Options(robust=True))
    check = check_against_opencv(adjustment).cameras["rc20"]
    assert check.verdict == "agrees", check.reason
    assert f"{len(targets[::40])} observations that robust estimation set aside" in check.reason
    assert check.rms_opencv_um < 10.0


def test_images_with_too_few_points_are_left_out() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=free("opencv", "k1", "k2"))
    few = replace(network, observations=keeping(network.observations, {"f2": 5}))
    check = check_network(few)
    assert check.images == 4
    assert "left out, for too few points: f2" in check.reason
    none = replace(network, observations=keeping(network.observations, {f"f{n}": 5 for n in range(1, 6)}))
    check = check_network(replace(none, cameras=(replace(none.cameras[0], distortion=NO_DISTORTION),)))
    assert check.verdict == "not possible"
    assert "No image shows enough points" in check.reason


def keeping(observations: Observations, targets: dict[str, int]) -> Observations:
    """The given number of targets only, of the images named."""
    left = dict(targets)
    rows = []
    for row, (image, kind) in enumerate(zip(observations.image, observations.kind, strict=True)):
        if image in left and kind == "target":
            left[image] -= 1
            if left[image] < 0:
                continue
        rows.append(row)
    return observations.only(np.array(rows))


def test_what_opencv_has_no_model_for() -> None:
    network = simulated(VERTICAL, distortion=Distortion("juhl", {"t1": Prior(0.0)}, r0_mm=135.0))
    assert "no counterpart of the distortion family juhl" in check_network(network).reason
    gruen = Distortion("gruen", {"a12": Prior(0.0)}, half_mm=(115.0, 115.0))
    polynomials = replace(network, cameras=(replace(network.cameras[0], distortion=gruen),))
    assert check_network(polynomials).verdict == "not possible"
    assert "no counterpart of the distortion family gruen" in check_network(polynomials).reason
    one_fixed = replace(network.cameras[0], distortion=Distortion(), x0_mm=Prior(0.0))
    assert "both coordinates of the principal point" in check_network(replace(network, cameras=(one_fixed,))).reason


def test_verdict_on_the_whole() -> None:
    good, bad = CameraCheck("agrees", "a."), CameraCheck("differs", "d.")
    impossible = CameraCheck("not possible", "n.")
    assert Check.from_cameras({"1": good, "2": good}).verdict == "agrees"
    assert Check.from_cameras({"1": good, "2": impossible}).verdict == "not possible"
    assert Check.from_cameras({"1": bad, "2": impossible}).verdict == "differs"
    assert Check.from_cameras({"1": bad, "2": impossible}).reason == "Camera 1: d."
    assert Check.from_cameras({"1": good}).reason == "a."


def test_json_has_the_documented_keys_and_no_nan() -> None:
    network = simulated(CONVERGENT_STATIONS, distortion=free("opencv", "k1", "k2", "p1", "p2"))
    check = check_against_opencv(adjust(network, approximate(network)))
    written = plain_json(check)
    assert set(written) == {"reseau", "made_from", "verdict", "reason", "cameras"}
    camera = written["cameras"]["rc20"]
    assert set(camera) == {
        "verdict", "reason", "images", "points", "rms_opencv_um", "rms_reseau_um", "refit_residual_um", "rows",
        "corners_px",
    }  # fmt: skip
    assert set(camera["rows"][0]) == {"name", "unit", "reseau", "opencv", "difference_sigmas"}
    assert set(camera["rows"][0]["reseau"]) == {"value", "sigma"}


def test_parameters_that_cannot_be_separated_are_not_compared_one_by_one() -> None:
    """A lens without a denominator, which is free: both programs have the same images, and other k1 to k6."""
    network = lens_network("opencv", np.random.default_rng(3))
    middle = np.flatnonzero(np.linalg.norm(network.observations.xy_mm, axis=1) < 9.0)
    network = replace(network, observations=network.observations.only(middle))
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    free = Distortion("opencv", {name: Prior(0.0, np.inf) for name in names})
    network = replace(network, cameras=(replace(network.cameras[0], distortion=free),))
    check = check_against_opencv(adjust(network)).cameras["L"]
    assert check.verdict == "agrees"
    assert {row.name for row in check.rows} == {"fx", "cx", "cy", "p1", "p2"}
    assert "cannot be separated: the radial terms are not compared one by one" in check.reason


FRAME_MM = np.array([[-10.0, -7.5], [10.0, 7.5]])
MODEL_C_MM = 24.0
INTERIOR = np.array([MODEL_C_MM, 0.05, -0.03])
MODERATE_LENS = {"k3": 1.2e-4, "k5": -2e-7, "p1": 3e-6, "p2": -2e-6}  # 170 um at the corner
RADIAL_TANGENTIAL = ("k1", "k2", "p1", "p2", "k3")
VALUES = {
    "opencv": {"k1": -0.26, "k2": 0.13, "p1": -2e-4, "p2": 4e-5, "k3": 0.01, "b1": 6e-4},
    FISHEYE: {"k1": 0.03, "k2": -0.01, "b1": 4e-4, "b2": -3e-4},
}
RAYS = np.array([[0.3, 0.2], [-0.1, 0.25], [0.0, -0.4]])


def make_lens(family: str, **values: float) -> Array:
    return np.array([values.get(name, 0.0) for name in parameter_names(family)])


def convert_torlegard(
    values: dict[str, float], interior: Array = INTERIOR, r0_mm: float = 0.0
) -> tuple[dict[str, float], float]:
    """OpenCV's values, and what is left, rms in mm."""
    lens = Lens(Distortion("torlegard", r0_mm=r0_mm), interior, make_lens("torlegard", **values))
    found = to_opencv_model(lens, FRAME_MM, RADIAL_TANGENTIAL)
    return dict(zip(NAMES, opencv_values(found.lens)[0].tolist(), strict=True)), found.rms_mm


@pytest.mark.parametrize(("strength", "at_most_um"), [(1.0, 0.06), (4.0, 0.4)])
def test_what_is_left_is_what_an_independent_calculation_found(strength: float, at_most_um: float) -> None:
    """0.06 um at the corner for 170 um of distortion, 0.4 um for 670 um."""
    _, rms_mm = convert_torlegard({name: strength * value for name, value in MODERATE_LENS.items()})
    assert 1e3 * rms_mm < at_most_um


def test_series_holds_for_a_weak_lens() -> None:
    """k1 = k3 c², k2 = (3 k3² + k5) c⁴, p1cv = -p2 c, p2cv = p1 c: exact in the limit of a weak lens."""
    k3, k5, p1, p2 = 1e-6, -2e-10, 3e-7, -2e-7
    values, _ = convert_torlegard({"k3": k3, "k5": k5, "p1": p1, "p2": p2})
    assert values["fx"] == pytest.approx(MODEL_C_MM, rel=1e-7)
    assert values["k1"] == pytest.approx(k3 * MODEL_C_MM**2, rel=1e-2)
    assert values["k2"] == pytest.approx((3 * k3**2 + k5) * MODEL_C_MM**4, rel=5e-2)
    assert values["p1"] == pytest.approx(-p2 * MODEL_C_MM, rel=1e-2)
    assert values["p2"] == pytest.approx(p1 * MODEL_C_MM, rel=1e-2)


def test_r0_is_no_parameter_of_its_own() -> None:
    """r0 is r0 = 0 with c, k and p divided by 1 + k3 r0² + k5 r0⁴ (+ k7 r0⁶)."""
    r0 = 8.0
    with_r0, _ = convert_torlegard(MODERATE_LENS, r0_mm=r0)
    ratio = 1 + MODERATE_LENS["k3"] * r0**2 + MODERATE_LENS["k5"] * r0**4
    scaled = {name: value / ratio for name, value in MODERATE_LENS.items()}
    without, _ = convert_torlegard(scaled, np.array([MODEL_C_MM / ratio, *INTERIOR[1:]]))
    assert list(with_r0.values()) == pytest.approx(list(without.values()), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("family", list(VALUES))
def test_opencvs_own_families_keep_their_values_and_project_as_opencv_does(family: str) -> None:
    lens = Lens(Distortion(family), INTERIOR, make_lens(family, **VALUES[family]))
    found = to_opencv_model(lens, FRAME_MM, ())
    values, _ = opencv_values(found.lens)
    assert found.is_same
    named = dict(zip(model_names(family), values, strict=True))
    b1 = VALUES[family]["b1"]
    of_interior = {"fx": MODEL_C_MM * (1.0 + b1), "fy": MODEL_C_MM, "cx": 0.05, "cy": -0.03}
    own = {name: value for name, value in VALUES[family].items() if name not in ("b1", "b2")}
    for name, value in {**of_interior, **own}.items():
        assert named[name] == pytest.approx(value, rel=1e-12)
    points, matrix = np.column_stack([RAYS * (1.0, -1.0), np.ones(len(RAYS))]), camera_matrix(values)
    if family == FISHEYE:
        projected, _ = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), matrix, values[4:8], alpha=named["alpha"]
        )
    else:
        projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, values[4:])
    ours, _ = lens.camera_from_ray(RAYS)
    np.testing.assert_allclose(ours, np.reshape(projected, (-1, 2)) * (1.0, -1.0), atol=1e-12)


@pytest.mark.parametrize("family", list(VALUES))
def test_derivatives_of_opencvs_values(family: str) -> None:
    start = np.concatenate([INTERIOR, make_lens(family, **VALUES[family])])

    def values(at: Array) -> Array:
        return opencv_values(Lens(Distortion(family), at[:3], at[3:]))[0]

    _, by_lens = opencv_values(Lens(Distortion(family), start[:3], start[3:]))
    for k, step in enumerate(1e-6 * np.eye(len(start))):
        numeric = (values(start + step) - values(start - step)) / 2e-6
        np.testing.assert_allclose(by_lens[:, k], numeric, atol=1e-7)


def test_what_is_held_stays_and_its_share_is_not_taken_by_others() -> None:
    """By k3 alone, c and the principal point held: OpenCV's k1 changes as the series says, and nothing else does."""
    freedom = Freedom(("k1",))
    lens = Lens(Distortion("torlegard"), INTERIOR, make_lens("torlegard", k3=1e-6))
    whole = to_opencv_model(lens, FRAME_MM, RADIAL_TANGENTIAL)
    held = fixed("opencv", dict(zip(parameter_names("opencv"), whole.lens.parameters.tolist(), strict=True)))
    found = convert_lens(lens, held, FRAME_MM, freedom.distortion, held=freedom.held_interior)
    np.testing.assert_allclose(found.lens.parameters[1:], whole.lens.parameters[1:], atol=1e-15)
    assert (found.lens.interior == INTERIOR).all()
    changed = found.by_source[:, 3]
    assert changed[3] == pytest.approx(MODEL_C_MM**2, rel=1e-2)
    assert np.flatnonzero(changed).tolist() == [3]


def test_one_focal_length_keeps_the_ratio() -> None:
    assert Freedom(("fx", "cx", "cy")).distortion == ()
    assert Freedom(("fx", "fy", "cx", "cy", "alpha")).distortion == ("b1", "b2")
    assert Freedom(("fx", "fy")).held_interior == ("x0", "y0")
