"""Marks in colour: the channels that show them best, also where they are lighter in one and darker in another."""

from pathlib import Path

import numpy as np
from brute_marks import Array, written_scan
from drawn_frames import FRAME_PX, NUMBERED, assert_right, measured, paint, pixel_from_camera

from measure.fiducials.measure_frame import best_weights
from measure.marks.templates import cut

RED, GREEN, BLUE = np.eye(3)
AS_LIGHT = 0.299 / 0.587  # of green that is lost for a mark of more red to be as light as its ground
MATRIX = pixel_from_camera("90", center=(202.2, 197.6))


def red_on_grey() -> Array:
    rng = np.random.default_rng(9)
    planes = np.full((3, FRAME_PX, FRAME_PX), 26000.0)
    for mark in NUMBERED.marks:
        paint(planes[0], mark.mark, mark.xy_mm, MATRIX, 16000.0)
        paint(planes[1], mark.mark, mark.xy_mm, MATRIX, -16000.0 * AS_LIGHT)
    return np.moveaxis(planes + rng.normal(0.0, 200.0, planes.shape), 0, -1)


def test_red_marks_as_light_as_their_grey_ground_are_found_and_right(tmp_path: Path) -> None:
    """The search answers to the green here, in which they are dark."""
    result = measured(red_on_grey(), NUMBERED, tmp_path)
    assert result.pose is not None
    assert (result.pose.name, result.pose.decided) == ("90", True)
    assert_right(result, NUMBERED, MATRIX)
    assert result.weights is not None
    np.testing.assert_allclose(result.weights, RED, atol=0.06)


def test_channels_are_those_of_the_polarity_or_of_the_better_one(tmp_path: Path) -> None:
    places = [(mark.mark, np.column_stack([MATRIX[:, :2], MATRIX @ (*mark.xy_mm, 1.0)])) for mark in NUMBERED.marks]
    with written_scan(red_on_grey(), tmp_path) as scan:
        dark, light = ([(*place, sign) for place in places] for sign in (-1, 1))
        for marks, signs, weights, sign in (
            (dark, (1,), GREEN, 1),
            (light, (1,), RED, 1),
            (dark, (1, -1), RED, -1),
            (light, (1, -1), RED, 1),
        ):
            best = best_weights(scan, marks, signs)
            assert best is not None
            np.testing.assert_allclose(best[0], weights, atol=0.06)  # noise makes it some 0.02
            assert best[1] == sign
        assert best_weights(scan, [], (1, -1)) is None


def test_learned_marks_are_cut_in_the_channels_they_are_measured_in(tmp_path: Path) -> None:
    """Else the same mark has another contrast there, which counts as changed light."""
    place = np.column_stack([MATRIX[:, :2], MATRIX @ (*NUMBERED.marks[0].xy_mm, 1.0)])
    with written_scan(red_on_grey(), tmp_path) as scan:
        red, grey = (cut(scan, place, 2.0, weights).grey for weights in (RED.tolist(), None))
    assert np.ptp(red) > 14000.0
    assert np.ptp(grey) < 2000.0
