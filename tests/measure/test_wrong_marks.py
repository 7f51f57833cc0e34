"""Wrong marks, bent films and perspectives told apart by the frames of a camera, on made-up places."""

import numpy as np
import pytest
from studies import parametrize_with_studies
from test_judgement import EIGHT, FOUR, make_layout

from measure.fiducials.across_frames import CheckedFrames, check_frames
from measure.fiducials.options import BelievedFilm
from measure.flags import Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose

PX_PER_MM, SIGMA_PX = 50.0, 0.03
AFFINITY = 2e-4


def make_frame(name: str, film_mm: np.ndarray, rng: np.random.Generator) -> FrameMeasurement:
    """A frame whose marks lie at film_mm (n, 2), laid upright on the scanner."""
    up = np.diag([1.0, -1.0])
    centers = PX_PER_MM * film_mm @ up + 6000.0 + rng.normal(0.0, SIGMA_PX, film_mm.shape)
    known = Covariance.from_noise(SIGMA_PX**2 * np.eye(2))
    marks = tuple(
        MarkMeasurement(str(k), "fiducial", center, known, Status.MEASURED) for k, center in enumerate(centers)
    )
    return FrameMeasurement(name, marks, Pose("0", True), np.column_stack([PX_PER_MM * up, [6000.0, 6000.0]]))


def bent_film(rng: np.random.Generator, bend_mm: float) -> np.ndarray:
    """Four marks on film that is stretched, and bent as x y."""
    size, stretch, shear = rng.normal(0.0, AFFINITY, 3)
    angle, given = rng.uniform(0.0, 2 * np.pi), np.array(FOUR)
    bend = bend_mm * np.outer(np.sign(given[:, 0] * given[:, 1]), (np.cos(angle), np.sin(angle)))
    return np.asarray(given @ np.array([[1 + size + stretch, shear], [shear, 1 + size - stretch]]) + bend)


def check_network(frames: list[FrameMeasurement]) -> CheckedFrames:
    return check_frames(frames, make_layout(FOUR), [(1000 / PX_PER_MM,) * 2] * len(frames))


def named(result: CheckedFrames) -> set[tuple[str, str]]:
    return {(frame.image, mark.point) for frame in result.frames for mark in frame.marks if mark.reason}


def folder(rng: np.random.Generator, count: int) -> tuple[list[FrameMeasurement], int, np.ndarray]:
    """Frames on film bent by 0.02 to 0.1 mm, one mark of the first 1 mm off; which one, and its error in mm."""
    films = [bent_film(rng, rng.uniform(0.02, 0.1)) for _ in range(count)]
    wrong, angle = int(rng.integers(4)), rng.uniform(0.0, 2 * np.pi)
    error_mm = np.array([np.cos(angle), np.sin(angle)])
    films[0][wrong] += error_mm
    return [make_frame(str(k), film, rng) for k, film in enumerate(films)], wrong, error_mm


def test_a_mark_of_four_that_is_wrong_is_named_next_to_ten_frames_and_no_other_is() -> None:
    rng, right = np.random.default_rng(3), 0
    for _ in range(6):
        frames, wrong, _ = folder(rng, 10)
        found = named(check_network(frames))
        assert found <= {("0", str(wrong))}
        right += bool(found)
    assert right >= 4  # in nine of ten of 200 folders


def test_a_lone_frame_with_a_wrong_mark_is_flagged_and_its_marks_cover_the_error() -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        frames, wrong, error_mm = folder(rng, 1)
        result = check_network(frames)
        assert named(result) == {("0", str(mark)) for mark in range(4)}  # each may be the wrong one, and is weak
        assert len(result.frames[0].problems) == 1
        known = result.frames[0].marks[wrong].covariance_px2
        assert known is not None
        assert (np.abs(error_mm) <= 2 * np.sqrt(np.diag(known)) / PX_PER_MM).all()
        assert np.sqrt(known[0, 0]) < 1.5 * PX_PER_MM


@parametrize_with_studies("count", [1, 10])
def test_of_four_good_marks_on_bent_film_none_is_called_wrong(count: int) -> None:
    rng = np.random.default_rng(5)
    for _ in range(5):
        bends = [0.15] + [rng.uniform(0.0, 0.02) for _ in range(count - 1)]
        result = check_network([make_frame(str(k), bent_film(rng, bend), rng) for k, bend in enumerate(bends)])
        reasons = {str(mark.reason).split(",")[0] for frame in result.frames for mark in frame.marks if mark.reason}
        assert reasons <= {"it may be wrong"}
        assert {image for image, _ in named(result)} <= {"0"}
        assert result.frames[0].problems


@pytest.mark.parametrize("tilt_deg", [0.5, 1.0, 2.0, 5.0])
def test_a_perspective_is_named_where_affine_films_are_stated_and_free_where_projective_ones_are(
    tilt_deg: float,
) -> None:
    """Eight marks as a pinhole 600 mm away pictures them."""
    rng, tilt = np.random.default_rng(6), np.deg2rad(tilt_deg)
    x, y = np.array(EIGHT).T
    film = np.column_stack([x * np.cos(tilt), y]) / (1 + x * np.sin(tilt) / 600.0)[:, None]
    frame, pitch = make_frame("0", film, rng), [(1000 / PX_PER_MM,) * 2]
    affine = check_frames([frame], make_layout(EIGHT), pitch).frames[0]
    assert {mark.status for mark in affine.marks} == {Status.MEASURED}
    assert 'set transformation = "projective"' in affine.problems[0]
    projective = check_frames([frame], make_layout(EIGHT), pitch, BelievedFilm(model="projective")).frames[0]
    assert not projective.problems
    for mark in projective.marks:
        assert mark.covariance_px2 is not None
        np.testing.assert_allclose(np.sqrt(np.diag(mark.covariance_px2)), SIGMA_PX)
