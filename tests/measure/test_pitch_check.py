"""The pitch that marks suggest."""

import numpy as np

from measure.fiducials.rows import pitch_problem
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, dot
from measure.results import Covariance, FrameMeasurement, MarkMeasurement


def layout(sigma_mm: float) -> FiducialLayout:
    places = [(-106.0, -106.0), (106.0, 106.0), (-106.0, 106.0), (106.0, -106.0)]
    marks = [LayoutMark(str(k), place, (sigma_mm, sigma_mm), MarkShape(dot(0.1))) for k, place in enumerate(places)]
    return FiducialLayout(tuple(marks), (228.0, 228.0))


def frame(across_um: float, down_um: float) -> FrameMeasurement:
    """A frame turned by 90 degrees."""
    matrix = np.array([[0.0, 1000.0 / across_um, 5000.0], [1000.0 / down_um, 0.0, 5000.0]])
    marks = [
        MarkMeasurement(
            mark.id, "fiducial", matrix @ (*mark.xy_mm, 1.0), Covariance.from_noise(np.eye(2)), Status.MEASURED
        )
        for mark in layout(1.0).marks
    ]
    return FrameMeasurement("a", tuple(marks), None, matrix)


def test_a_pitch_that_film_and_separations_allow_is_no_problem() -> None:
    assert pitch_problem(frame(20.1, 19.9), layout(0.01), (20.0, 20.0), "the project") is None


def test_a_wrong_pitch_is_named() -> None:
    problem = pitch_problem(frame(21.17, 20.0), layout(0.01), (20.0, 20.0), "the project")
    assert problem is not None
    assert "the project gives a pitch of 20.00 x 20.00 µm" in problem
    assert "set pitch_um = [21.17, 20.00]" in problem


def test_separations_known_to_a_few_millimetres_say_little() -> None:
    assert pitch_problem(frame(20.6, 20.6), layout(3.0), (20.0, 20.0), "the project") is None
    assert pitch_problem(frame(20.6, 20.6), layout(0.1), (20.0, 20.0), "the project") is not None


def test_right_pitches_are_called_wrong_as_rarely_as_is_stated() -> None:
    """Eight marks of a small camera whose given places are known to a millimetre: 1 of 100, and less what film does."""
    generator = np.random.default_rng(5)
    true = np.array([(x, y) for x in (-16.0, 0.0, 16.0) for y in (-11.5, 0.0, 11.5) if (x, y) != (0.0, 0.0)])
    wrong = 0
    for _ in range(700):
        given = true + generator.normal(0, 1, true.shape)
        marks = [
            LayoutMark(str(k), (place[0], place[1]), (1.0, 1.0), MarkShape(dot(0.1))) for k, place in enumerate(given)
        ]
        design = np.column_stack([given, np.ones(len(given))])
        matrix = np.asarray(np.linalg.lstsq(design, true * (50.0, -50.0), rcond=None)[0].T, float)
        view = [
            MarkMeasurement(mark.id, "fiducial", np.zeros(2), Covariance.from_noise(np.eye(2)), Status.MEASURED)
            for mark in marks
        ]
        small = FiducialLayout(tuple(marks), (33.0, 24.0))
        wrong += pitch_problem(FrameMeasurement("a", tuple(view), None, matrix), small, (20.0, 20.0), "x") is not None
    assert 1 <= wrong <= 14, wrong  # 7 are expected at most, more than 14 in one run of 170
