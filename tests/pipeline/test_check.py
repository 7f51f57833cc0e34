"""The check against OpenCV: its calibration of the same points, and lenses brought to its models."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import networks as nets
import numpy as np
import pytest
from scipy.linalg import block_diag
from studies import parametrize_with_studies

from adjust import Adjustment, Camera, Network, ObjectPoint, adjust, approximate
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Transformation
from adjust.problem.observations import Observations
from pipeline.opencv_check import opencv_calibration
from pipeline.opencv_check.check import check_against_opencv
from pipeline.opencv_check.opencv_calibration import Freedom, OpenCvCalibration, calibrate
from pipeline.results.stage_files import CameraCheck, Check

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
    noise_mm: float = nets.PROJECTED_SIGMA_MM,
    distortion: Distortion = NO_DISTORTION,
) -> Network:
    """Frames of a test field through a known lens, with priors of 1 mm on the interior; marks all but fixed."""
    kind: Transformation = "affine" if film else "none"
    network = nets.project_field(
        nets.relief_field(relief_m, n=60), stations, kind=kind, noise_mm=noise_mm, distortion=lens, aspect=aspect
    ).network
    marks = nets.given_marks(nets.SIX_MARKS_MM, 0.001) if film else {}
    camera = Camera("rc20", *nets.given_interior((nets.PROJECTED_C_MM + 0.3, 0.0, 0.0)), distortion, marks)
    return replace(network, cameras=(camera,))


def free(family: str, *names: str) -> Distortion:
    return Distortion(family, {name: Prior(0.0, FREE) for name in names})


FREE_LENS = free("torlegard", "k3", "k5", "k7", "p1", "p2")


@cache
def adjusted_film() -> Adjustment:
    """Five convergent frames, the lens free."""
    network = simulated(nets.CONVERGENT_STATIONS, distortion=FREE_LENS)
    return adjust(network, approximate(network))


def check_network(network: Network) -> CameraCheck:
    return check_against_opencv(adjust(network, approximate(network))).cameras["rc20"]


@pytest.mark.parametrize(
    ("distortion", "aspect", "film"),
    [
        (FREE_LENS, 1.0, True),
        (free("brown", "k1", "k2", "k3", "p1", "p2", "b1"), 1.0003, True),
        (free("opencv", "k1", "k2", "p1", "p2", "k3"), 1.0, False),
        (free("opencv", "k1", "k2", "p1", "p2", "b1"), 1.0003, False),
    ],
    ids=["torlegard", "brown", "opencv", "opencv two focal lengths"],
)
def test_a_moderate_lens_agrees_to_a_tenth_of_a_sigma(distortion: Distortion, aspect: float, film: bool) -> None:
    check = check_network(simulated(nets.CONVERGENT_STATIONS, film=film, distortion=distortion, aspect=aspect))
    assert check.verdict == "agrees", check.reason
    assert check.images == 5
    assert check.refit_residual_um < 0.02
    assert check.rms_opencv_um == pytest.approx(check.rms_reseau_um, rel=1e-3)
    for row in check.rows:
        assert row.difference_sigmas < 0.1
        assert row.reseau.sigma == pytest.approx(row.opencv.sigma, rel=0.03)
    assert {row.name for row in check.rows} >= {"fx", "cx", "cy", "k1", "k2", "p1", "p2"}
    assert ("fy" in {row.name for row in check.rows}) == (aspect != 1.0)
    assert ("film transformations" in check.reason) == film


@pytest.mark.parametrize("unit", [1e-6, 1e3])
def test_the_unit_of_the_object_costs_opencv_no_digits(unit: float) -> None:
    """Objects of half a millimetre made its standard deviations wrong by factors of thousands."""
    network = simulated(nets.CONVERGENT_STATIONS, film=False, distortion=free("opencv", "k1", "k2", "p1", "p2", "k3"))
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


def test_a_board_that_is_hardly_tilted_agrees() -> None:
    """c goes with the distances; OpenCV's own standard deviations leave that direction out, and c seems precise."""
    stations = [(100.0 * k, 0.0, 1200.0 + 200.0 * k, 0.01 * (k % 2), 0.01 * (k % 3), 45.0 * k) for k in range(5)]
    network = simulated(stations, relief_m=0.0, film=False, distortion=free("opencv", "k1", "k2"), noise_mm=1e-4)
    (camera,) = network.cameras
    camera = replace(camera, fiducials={}, principal_distance_mm=Prior(nets.PROJECTED_C_MM, FREE))
    check = check_network(replace(network, cameras=(camera,)))
    assert check.verdict == "agrees", check.reason
    fx = check.rows[0]
    assert fx.opencv.sigma == pytest.approx(fx.reseau.sigma, rel=0.05)


@pytest.mark.parametrize("known", [False, True])
def test_a_tilted_sensor_agrees(known: bool) -> None:
    tilt = (0.03, -0.02)
    lens = (*MODERATE, *[0.0] * (12 - len(MODERATE)), *tilt)
    priors = {name: Prior(value * known, 0.0 if known else FREE) for name, value in zip(TILT, tilt, strict=True)}
    given = free("opencv", "k1", "k2")
    distortion = replace(given, parameters={**given.parameters, **priors})
    network = simulated(nets.CONVERGENT_STATIONS, lens=lens, distortion=distortion)
    # A tilted sensor is all but another principal point.
    held = replace(network.cameras[0], x0_mm=Prior(nets.X0_MM), y0_mm=Prior(nets.Y0_MM))
    check = check_network(replace(network, cameras=(held,)))
    assert check.verdict == "agrees", check.reason
    assert [row.name for row in check.rows] == ["fx", "k1", "k2", *(() if known else TILT)]
    assert max(row.difference_sigmas for row in check.rows) < 0.1


def test_what_cannot_be_checked_is_reported_with_its_reason() -> None:
    check = check_network(simulated(VERTICAL, relief_m=0.0, lens=[0.0] * 5))
    assert check.verdict == "not possible"
    assert check.reason.startswith("Priors carried the solution")
    assert not check.rows
    network = simulated(VERTICAL, distortion=Distortion("juhl", {"t1": Prior(0.0)}, r0_mm=135.0))
    assert "no counterpart of the distortion family juhl" in check_network(network).reason
    gruen = Distortion("gruen", {"a12": Prior(0.0)}, half_mm=(115.0, 115.0))
    polynomials = replace(network, cameras=(replace(network.cameras[0], distortion=gruen),))
    assert check_network(polynomials).verdict == "not possible"
    assert "no counterpart of the distortion family gruen" in check_network(polynomials).reason
    one_fixed = replace(network.cameras[0], distortion=Distortion(), x0_mm=Prior(0.0))
    assert "both coordinates of the principal point" in check_network(replace(network, cameras=(one_fixed,))).reason
    network = simulated(nets.CONVERGENT_STATIONS, distortion=free("opencv", "k1", "k2"))
    few = replace(network, observations=keeping(network.observations, {"f2": 5}))
    check = check_network(few)
    assert check.images == 4
    assert "left out, for too few points: f2" in check.reason
    none = replace(network, observations=keeping(network.observations, {f"f{n}": 5 for n in range(1, 6)}))
    check = check_network(replace(none, cameras=(replace(none.cameras[0], distortion=NO_DISTORTION),)))
    assert check.verdict == "not possible"
    assert "No image shows enough points" in check.reason


@pytest.mark.parametrize(("points", "share"), [(4, None), (5, 20 / 4)])
def test_without_redundancy_there_are_no_standard_deviations(points: int, share: float | None) -> None:
    """Two images of four points: 16 coordinates, and as many unknowns of orientations and camera.

    OpenCV 5 refuses so few before; with five points a variance is 20 / 4 times the mean square.
    """
    rng = np.random.default_rng(1)
    by_image = [(rng.normal(size=(2 * points, 6)), rng.normal(size=(2 * points, 4))) for _ in range(2)]
    if share is None:
        with pytest.raises(opencv_calibration.NoRedundancyError, match="16 coordinates leave no redundancy"):
            opencv_calibration.parameter_sigmas(by_image, range(4), 1.0, 1.0)
        return
    sigmas = opencv_calibration.parameter_sigmas(by_image, range(4), 1.0, 1.0)
    by_all = np.hstack([block_diag(*(pose for pose, _ in by_image)), np.vstack([camera for _, camera in by_image])])
    np.testing.assert_allclose(sigmas**2, share / 2.0 * np.diag(np.linalg.inv(by_all.T @ by_all))[-4:])


def test_unknown_points_and_different_standard_deviations_are_reported() -> None:
    network = simulated(nets.CONVERGENT_STATIONS, distortion=FREE_LENS)
    points = tuple(
        ObjectPoint(p.id, None, None, None) if int(p.id[1:]) >= 30 and network.observations.point.count(p.id) > 1 else p
        for p in network.points
    )
    check = check_network(replace(network, points=points))
    unknown = sum(point.X is None for point in points)
    assert unknown > 5
    assert check.verdict == "agrees", check.reason
    assert f"{unknown} points have standard deviations" in check.reason
    assert max(row.difference_sigmas for row in check.rows) < 0.1
    covariance = network.observations.covariance_mm2.copy()
    covariance[::2] *= 9.0
    check = check_network(replace(network, observations=replace(network.observations, covariance_mm2=covariance)))
    assert "differ up to 3" in check.reason


def test_a_prior_or_a_value_that_the_observations_contradict_differs() -> None:
    network = simulated(nets.CONVERGENT_STATIONS, distortion=FREE_LENS)
    camera = replace(network.cameras[0], principal_distance_mm=Prior(nets.PROJECTED_C_MM + 0.2, 0.002))
    check = check_network(replace(network, cameras=(camera,)))
    assert check.verdict == "differs"
    assert "Priors or weights move c" in check.reason
    adjustment = adjusted_film()
    values = adjustment.values.copy()
    values[adjustment.index("IO.rc20.c")] += 0.5
    assert check_against_opencv(replace(adjustment, values=values)).verdict == "differs"


@pytest.mark.parametrize("family", ["torlegard", "brown"])
def test_a_strong_lens_agrees_by_way_of_the_same_model(family: str) -> None:
    names = {"torlegard": ("k3", "k5", "k7", "p1", "p2"), "brown": ("k1", "k2", "k3", "p1", "p2")}[family]
    stations, lens = nets.CONVERGENT_STATIONS * 4, free(family, *names)
    check = check_network(simulated(stations, film=False, lens=STRONG, noise_mm=0.002, distortion=lens))
    assert check.verdict == "agrees", check.reason
    assert check.reason.startswith("Given the very same model both programs agree.")
    assert max(row.difference_sigmas for row in check.rows) > 1.0


@parametrize_with_studies("skew", [True, False], ids=["skew", "no skew"])
def test_a_fisheye_agrees_with_opencvs_fisheye(skew: bool) -> None:
    """Which estimates both focal lengths or none: one of them free here is two for the comparison."""
    network = nets.lens_network("opencv_fisheye", np.random.default_rng(2))
    if not skew:
        camera = network.cameras[0]
        lens = {
            "k1": Prior(0.0, FREE),
            "k2": Prior(0.0, FREE),
            "b2": Prior(nets.LENSES["opencv_fisheye"][1]["b2"], 0.0),
        }
        network = replace(network, cameras=(replace(camera, distortion=Distortion("opencv_fisheye", lens)),))
    adjustment = adjust(network)
    check = check_against_opencv(adjustment).cameras["L"]
    names = ["fx", "fy", "cx", "cy", "k1", "k2", *(["alpha"] if skew else [])]
    assert [row.name for row in check.rows] == names
    if skew:
        assert check.verdict == "agrees", check.reason
        assert max(row.difference_sigmas for row in check.rows) < 1e-4
        assert max(abs(row.reseau.sigma / row.opencv.sigma - 1.0) for row in check.rows) < 1e-4
        values = adjustment.values.copy()
        values[adjustment.index("IO.L.c")] += 0.05
        assert check_against_opencv(replace(adjustment, values=values)).verdict == "differs"
    else:  # b1 was held at 0 and is 4e-4
        assert check.verdict == "differs"
        assert "Priors or weights move b1" in check.reason


def test_the_principal_point_is_held_where_focal_lengths_alone_are_free() -> None:
    assert Freedom(("fx", "fy")).held_interior == ("x0", "y0")


@pytest.mark.parametrize("what", ["parameters", "sigmas"])
def test_another_solution_of_opencv_differs(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    def shifted(*arguments: Any, **options: Any) -> OpenCvCalibration:
        found = calibrate(*arguments, **options)
        if what == "sigmas":
            return replace(found, sigmas=1.4 * found.sigmas)
        return replace(found, parameters=found.parameters + 1.5 * found.sigmas)

    monkeypatch.setattr("pipeline.opencv_check.check.calibrate", shifted)
    check = check_against_opencv(adjusted_film()).cameras["rc20"]
    assert check.verdict == "differs"
    assert ("factor of 1.4" if what == "sigmas" else "by 1.5") in check.reason


def test_opencv_calibrates_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its threads add up the images in the order in which they end, and the last digits go by it."""
    threads, plain = [], cv2.calibrateCamera

    def watched(*arguments: Any, **options: Any) -> Any:
        threads.append(cv2.getNumThreads())
        return plain(*arguments, **options)

    monkeypatch.setattr(cv2, "calibrateCamera", watched)
    before = cv2.getNumThreads()
    cv2.setNumThreads(4)
    try:
        check_against_opencv(adjusted_film())
        assert (set(threads), cv2.getNumThreads()) == ({1}, 4)
    finally:
        cv2.setNumThreads(before)


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


def test_verdict_on_the_whole() -> None:
    good, bad = CameraCheck("agrees", "a."), CameraCheck("differs", "d.")
    impossible = CameraCheck("not possible", "n.")
    assert Check.from_cameras({"1": good, "2": good}).verdict == "agrees"
    assert Check.from_cameras({"1": good, "2": impossible}).verdict == "not possible"
    assert Check.from_cameras({"1": bad, "2": impossible}).verdict == "differs"
    assert Check.from_cameras({"1": bad, "2": impossible}).reason == "Camera 1: d."
    assert Check.from_cameras({"1": good}).reason == "a."


def rational_network() -> Network:
    """A lens without a denominator, which is free, in the middle of the images."""
    network = nets.lens_network("opencv", np.random.default_rng(3))
    middle = np.flatnonzero(np.linalg.norm(network.observations.xy_mm, axis=1) < 9.0)
    network = replace(network, observations=network.observations.only(middle))
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    free = Distortion("opencv", {name: Prior(0.0, np.inf) for name in names})
    return replace(network, cameras=(replace(network.cameras[0], distortion=free),))


@pytest.mark.parametrize(("better_rms", "verdict"), [(1.0, "agrees"), (0.98, "differs")])
def test_another_place_in_a_flat_valley_differs_only_where_it_is_better(
    monkeypatch: pytest.MonkeyPatch, better_rms: float, verdict: str
) -> None:
    def shifted(*arguments: Any, **options: Any) -> OpenCvCalibration:
        found = calibrate(*arguments, **options)
        return replace(found, parameters=found.parameters + 1.5 * found.sigmas, rms_um=better_rms * found.rms_um)

    monkeypatch.setattr("pipeline.opencv_check.check.calibrate", shifted)
    check = check_against_opencv(adjust(rational_network())).cameras["L"]
    assert check.verdict == verdict
    assert ("elsewhere in the flat valley" in check.reason) == (verdict == "agrees")


def test_parameters_that_cannot_be_separated_are_not_compared_one_by_one() -> None:
    """Both programs have the same images, and other k1 to k6."""
    check = check_against_opencv(adjust(rational_network())).cameras["L"]
    assert check.verdict == "agrees"
    assert {row.name for row in check.rows} == {"fx", "cx", "cy", "p1", "p2"}
    assert "cannot be separated: the radial terms are not compared one by one" in check.reason


def test_radial_terms_alone_that_cannot_be_separated_leave_nothing_to_compare(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Adjustment, "inseparable", lambda *_: ["k1", "k2"])
    network = simulated(nets.CONVERGENT_STATIONS, film=False)
    known = (Prior(nets.PROJECTED_C_MM, 0.0), Prior(0.0, 0.0), Prior(0.0, 0.0))
    camera = Camera("rc20", *known, free("opencv", "k1", "k2"))
    check = check_network(replace(network, cameras=(camera,)))
    assert check.verdict == "not possible"
    assert "k1 and k2 cannot be separated, and nothing else is free" in check.reason
