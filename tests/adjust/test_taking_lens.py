"""The lens of a camera that photographed film as a part of the scanner: against OpenCV, and in an adjustment."""

from dataclasses import replace

import cv2
import numpy as np
from simulated import simulated

from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.scanner import Bend
from adjust.model_selection.scanner_choice import network_with_terms
from adjust.problem.estimates import adjusted_image
from adjust.problem.network import Scanner
from adjust.solution.adjustment import adjust

MM = 0.05
F, CX, CY = 3000.0, 1010.0, 760.0
COEFFICIENTS = (-0.12, 0.05, 1e-3, -5e-4, 0.0)
LENS = Lens(
    Distortion("opencv"),
    np.array([F * MM, CX * MM, -CY * MM]),
    np.array([*COEFFICIENTS, *np.zeros(11)]),
)
PX = np.random.default_rng(3).uniform((0.0, 0.0), (2000.0, 1500.0), (40, 2))
MATRIX = np.array([[F, 0.0, CX], [0.0, F, CY], [0.0, 0.0, 1.0]])


def test_a_bend_takes_the_taking_lens_out_as_opencv_does_and_then_bends() -> None:
    scan_mm = PX * (MM, -MM)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-14)
    ideal = cv2.undistortPoints(PX[:, None], MATRIX, np.array(COEFFICIENTS), R=np.eye(3), P=MATRIX, criteria=stop)[:, 0]
    lens = Bend(lens=LENS)
    np.testing.assert_allclose(lens.apply(np.empty(0), scan_mm), ideal * (MM, -MM), atol=1e-7)
    bend = Bend(("a20", "b11"), (50.0, -37.0), (50.0, 38.0))
    both, values = replace(bend, lens=LENS), np.array([0.02, -0.03])
    np.testing.assert_allclose(
        both.apply(values, scan_mm), bend.apply(values, lens.apply(np.empty(0), scan_mm)), atol=1e-10
    )
    back, found = both.inverse(values, both.apply(values, scan_mm))
    assert found.all()
    np.testing.assert_allclose(back, scan_mm, atol=1e-9)
    step = 1e-4
    for axis, shift in enumerate(step * np.eye(2)):
        slope = (both.apply(values, scan_mm + shift) - both.apply(values, scan_mm - shift)) / (2 * step)
        np.testing.assert_allclose(both.gradient(values, scan_mm)[:, :, axis], slope, atol=1e-6)


def test_scans_through_a_lens_adjust_as_those_without() -> None:
    network, start = simulated(np.random.default_rng(5))
    straight = network.observations.xy_mm
    lens = replace(LENS, interior=np.array([600.0, 3.0, -5.0]))
    rays = np.column_stack([(straight - lens.interior[1:]) * (1.0, -1.0) / 600.0, np.ones(len(straight))])
    ideal = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(COEFFICIENTS))[0][:, 0]
    pictured = ideal * (600.0, -600.0) + lens.interior[1:]
    assert np.abs(pictured - straight).max() > 0.2
    through = replace(
        network,
        observations=replace(network.observations, xy_mm=pictured),
        images=tuple(replace(image, scanner="photo") for image in network.images),
        scanners=(Scanner("photo", lens=lens),),
    )
    without, with_lens = adjust(network, start), adjust(through, start)
    assert with_lens.converged
    assert abs(with_lens.sigma0 / without.sigma0 - 1.0) < 0.01  # standard deviations are those in the picture
    for name in ("IO.K.c", "IO.K.x0", "IO.K.y0"):
        assert abs(with_lens.value(name) - without.value(name)) < 0.02 * without.sigma(name)
    model = adjusted_image(with_lens, "f0")
    np.testing.assert_allclose(
        model.camera_from_comparator(pictured[:5]),
        adjusted_image(without, "f0").camera_from_comparator(straight[:5]),
        atol=2e-4,
    )
    (bent,) = network_with_terms(through, {"photo": ("a30",)}).scanners
    assert bent.lens is lens
