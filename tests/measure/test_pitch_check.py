"""The pitch that marks suggest."""

import numpy as np

from measure.pitch_check import pitch_problem
from measure.results import FrameMeasurement, MarkMeasurement
from measure.shapes import FiducialLayout, LayoutMark, MarkShape, dot
from measure.status import Status


def layout(sigma_mm: float) -> FiducialLayout:
    places = [(-106.0, -106.0), (106.0, 106.0), (-106.0, 106.0), (106.0, -106.0)]
    marks = [LayoutMark(str(k), place, (sigma_mm, sigma_mm), MarkShape(dot(0.1))) for k, place in enumerate(places)]
    return FiducialLayout(tuple(marks), (228.0, 228.0))


def frame(across_um: float, down_um: float) -> FrameMeasurement:
    """A frame turned by 90 degrees."""
    matrix = np.array([[0.0, 1000.0 / across_um, 5000.0], [1000.0 / down_um, 0.0, 5000.0]])
    marks = [
        MarkMeasurement(mark.id, "fiducial", matrix @ (*mark.xy_mm, 1.0), np.eye(2), Status.MEASURED)
        for mark in layout(1.0).marks
    ]
    return FrameMeasurement("a", tuple(marks), None, matrix)


def test_a_pitch_that_film_and_separations_allow_is_no_problem() -> None:
    assert pitch_problem(frame(20.1, 19.9), layout(0.01), (20.0, 20.0), "the project") is None


def test_a_wrong_pitch_is_named() -> None:
    problem = pitch_problem(frame(21.17, 20.0), layout(0.01), (20.0, 20.0), "the project")
    assert problem is not None
    assert "the project gives a pitch of 20.00 x 20.00 um" in problem
    assert "set pitch_um = [21.17, 20.00]" in problem


def test_separations_known_to_a_few_millimetres_say_little() -> None:
    assert pitch_problem(frame(20.6, 20.6), layout(3.0), (20.0, 20.0), "the project") is None
    assert pitch_problem(frame(20.6, 20.6), layout(0.1), (20.0, 20.0), "the project") is not None
