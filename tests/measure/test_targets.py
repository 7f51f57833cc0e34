"""Targets by prediction: names, statuses and reasons."""

import numpy as np
import pytest
from drawn import draw, ellipse, make_scan, transformed, whitened
from numpy.typing import NDArray
from studies import parametrize_with_studies

from measure import MarkMeasurement, Scan, Status, TargetOptions, TargetPrediction, measure_crosses, measure_disks
from measure.targets.detection import CrossSearch, cross_candidates

Array = NDArray[np.float64]
CONTRAST, NOISE, GROUND = 20000.0, 500.0, 12000.0
WIDTH, HEIGHT = 700, 500


class Field:
    """A picture with disks at known places, and predictions of them that are off by a common shift and a little."""

    def __init__(self, seed: int, shift_px: Array, search_px: float = 25.0, sign: float = 1.0, count: int = 35) -> None:
        self.rng = np.random.default_rng(seed)
        self.picture = 40000 * (sign < 0) + sign * GROUND + self.rng.normal(0, NOISE, (HEIGHT, WIDTH))
        self.sign = sign
        self.places: dict[str, Array] = {}
        self.predictions: list[TargetPrediction] = []
        for number in range(count):
            place = np.array([70 + 90 * (number % 7), 60 + 90 * (number // 7)]) + self.rng.uniform(-12, 12, 2)
            radius = self.rng.uniform(3.0, 7.0)
            self.add(f"t{number}", place, radius, shift_px, search_px)

    def add(self, name: str, place: Array, radius_px: float, shift_px: Array, search_px: float) -> None:
        self.places[name] = place
        shape = np.diag([radius_px, 0.8 * radius_px])
        self.draw(place, shape)
        off = shift_px + 0.003 * (place - (350, 250)) + self.rng.normal(0, 0.3, 2)
        self.predictions.append(TargetPrediction(name, place + off, shape * self.rng.uniform(0.9, 1.1), search_px))

    def draw(self, place: Array, shape: Array) -> None:
        corner = np.round(place).astype(int) - 16
        window = self.picture[corner[1] : corner[1] + 33, corner[0] : corner[0] + 33]
        window += self.sign * CONTRAST * draw(ellipse(place - corner, shape), 33, 33, 0.9, fineness=10)

    def hide(self, name: str) -> None:
        col, row = np.round(self.places[name]).astype(int)
        patch = self.picture[row - 14 : row + 15, col - 14 : col + 15]
        patch[:] = self.sign * GROUND + 40000 * (self.sign < 0) + self.rng.normal(0, NOISE, patch.shape)

    def scan(self) -> Scan:
        return make_scan(self.picture)

    def measure_picture(self, options: TargetOptions | None = None) -> dict[str, MarkMeasurement]:
        return {mark.point: mark for mark in measure_disks(self.scan(), self.predictions, options)}


@parametrize_with_studies("sign", [1.0, -1.0])
def test_all_targets_with_their_names_and_honest_sigmas(sign: float) -> None:
    field = Field(2, np.array([9.0, -7.0]), sign=sign)
    marks = field.measure_picture()
    errors = []
    for name, place in field.places.items():
        mark = marks[name]
        assert mark.status is Status.MEASURED, mark.reason
        assert mark.center_px is not None
        assert mark.covariance_px2 is not None
        errors.append(whitened(mark.center_px - place, mark.covariance_px2))
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25  # three standard deviations of 70 numbers


@pytest.mark.study
def test_a_hidden_target_is_not_taken_for_its_neighbour() -> None:
    field = Field(2, np.array([20.0, 15.0]), search_px=110.0)
    hidden = ("t0", "t10", "t24")
    for name in hidden:
        field.hide(name)
    marks = field.measure_picture()
    for name, place in field.places.items():
        mark = marks[name]
        if name in hidden:
            assert mark.status in (Status.PREDICTED, Status.REJECTED)
            assert mark.reason
        else:
            assert mark.status is Status.MEASURED, mark.reason
            assert mark.center_px is not None
            assert np.hypot(*(mark.center_px - place)) < 0.2


def test_two_disks_at_one_place_are_refused() -> None:
    field = Field(3, np.zeros(2))
    place, shape = field.places["t17"], field.predictions[17].pixel_from_disk
    field.hide("t17")
    across = np.array([0.9 * shape[0, 0] + 5.0, 0.0])
    field.draw(place - across, shape)
    field.draw(place + across, shape)
    mark = field.measure_picture(TargetOptions(least_gate_px=14.0))["t17"]
    assert mark.status is Status.REJECTED
    assert "2 disks lie within" in mark.reason


def test_every_prediction_has_a_row_with_its_reason() -> None:
    field = Field(4, np.zeros(2))
    field.predictions += [
        TargetPrediction("outside", np.array([-9.0, 50.0]), np.eye(2) * 5, 20.0),
        TargetPrediction("tiny", np.array([200.0, 100.0]), np.eye(2) * 0.8, 20.0),
        TargetPrediction("nothing", np.array([115.0, 105.0]), np.eye(2) * 4, 8.0),
    ]
    marks = field.measure_picture()
    assert len(marks) == 38
    assert marks["outside"].status is Status.ABSENT
    assert "outside of the scan" in marks["outside"].reason
    assert "too small" in marks["tiny"].reason
    assert marks["nothing"].status is Status.PREDICTED
    assert "within 8 px" in marks["nothing"].reason


def test_a_disk_of_another_size_or_polarity_is_no_target() -> None:
    field = Field(5, np.zeros(2))
    field.hide("t3")
    field.draw(field.places["t3"], 2.2 * field.predictions[3].pixel_from_disk)
    field.hide("t8")
    field.sign = -1.0
    field.picture[:] += 25000
    field.draw(field.places["t8"], field.predictions[8].pixel_from_disk)
    marks = field.measure_picture()
    assert not marks["t3"].status.is_observation
    assert not marks["t8"].status.is_observation
    assert "not light" in marks["t8"].reason


def test_small_disks_are_flagged_where_too_few_others_tell_what_they_appear_like() -> None:
    field = Field(6, np.zeros(2))
    field.add("small", np.array([115.0, 105.0]), 2.3, np.zeros(2), 10.0)
    assert field.measure_picture()["small"].status is Status.MEASURED
    field.predictions = field.predictions[-5:]
    mark = field.measure_picture()["small"]
    assert mark.status is Status.WEAK
    assert "dust" in mark.reason


def test_the_order_of_predictions_does_not_matter() -> None:
    """Every disk lies near several places, so that another one is the first to have it fitted."""
    field = Field(7, np.array([5.0, 3.0]), search_px=110.0, count=14)
    marks = field.measure_picture()
    field.predictions.reverse()
    for name, mark in field.measure_picture().items():
        assert (mark.status, mark.reason, mark.quality) == (marks[name].status, marks[name].reason, marks[name].quality)
        np.testing.assert_array_equal(np.array(mark.center_px), np.array(marks[name].center_px))
        np.testing.assert_array_equal(mark.covariance_px2, marks[name].covariance_px2)


def test_a_blank_scan_gives_rows_and_reasons() -> None:
    field = Field(8, np.zeros(2))
    field.picture[:] = 0
    assert all(mark.status is Status.PREDICTED and mark.reason for mark in field.measure_picture().values())


def test_crosses() -> None:
    rng = np.random.default_rng(9)
    picture = GROUND + rng.normal(0, NOISE, (200, 300))
    predictions, places = [], {}
    for number in range(6):
        place = np.array([60 + 85 * (number % 3), 55 + 85 * (number // 3)]) + rng.uniform(-5, 5, 2)
        corner = np.round(place).astype(int) - 24

        def arms(col: Array, row: Array, middle: Array = place - corner) -> Array:
            x, y = np.abs(col - middle[0]), np.abs(row - middle[1])
            return np.asarray(((x < 12) & (y < 1.5)) | ((y < 12) & (x < 1.5)))

        picture[corner[1] : corner[1] + 49, corner[0] : corner[0] + 49] += CONTRAST * draw(arms, 49, 49, 0.9)
        places[f"x{number}"] = place
        predictions.append(TargetPrediction(f"x{number}", place + np.array([4, -3]), np.diag([12.0, 12.0]), 15.0))
    for mark in measure_crosses(make_scan(picture), predictions, 3 / 12):
        assert mark.status is Status.MEASURED, mark.reason
        assert mark.center_px is not None
        assert np.abs(mark.center_px - places[mark.point]).max() < 0.04


def test_a_cross_viewed_obliquely() -> None:
    """Its near arm is longer and wider than its far one: 0.04 px, were it fitted as two plain bars."""
    upright = np.array([[9.0, 4.0], [-6.0, 12.0]])  # px
    nearer = np.array([0.05, -0.03])  # per half length
    place = np.array([24.3, 23.8])

    def inside(col: Array, row: Array) -> Array:
        flat = np.array(transformed(np.linalg.inv(upright), col - place[0], row - place[1]))
        x, y = np.abs(flat / (1 - np.tensordot(nearer, flat, axes=1)))
        return np.asarray(((x < 1) & (y < 0.125)) | ((y < 1) & (x < 0.125)))

    scan = make_scan(GROUND + CONTRAST * draw(inside, 49, 49, 0.9))

    def error(perspective: Array) -> float:
        prediction = TargetPrediction("x", place + np.array([0.7, -0.5]), upright, 5.0, perspective)
        (mark,) = measure_crosses(scan, [prediction], 0.25)
        assert mark.center_px is not None
        return float(np.abs(mark.center_px - place).max())

    assert error(np.zeros(2)) > 0.02
    assert error(nearer @ np.linalg.inv(upright)) < 0.001


def test_two_blobs_on_a_faint_line_are_no_cross() -> None:
    picture = np.full((90, 90), GROUND)
    picture[43:47, 20:70] += 0.2 * CONTRAST
    picture[40:50, 20:27] += CONTRAST
    picture[40:50, 63:70] += CONTRAST
    assert cross_candidates(make_scan(picture), CrossSearch((12.0, 25.0), 0.25)) == []


def test_bad_predictions_are_refused() -> None:
    with pytest.raises(ValueError, match="a positive number is right"):
        TargetPrediction("a", np.zeros(2), np.eye(2), 0.0)
    with pytest.raises(ValueError, match=r"pixel_from_disk \(2, 2\)"):
        TargetPrediction("a", np.zeros(2), np.zeros((2, 3)), 5.0)
    twice = [TargetPrediction("a", np.zeros(2), np.eye(2), 5.0)] * 2
    with pytest.raises(ValueError, match="predicted twice: a"):
        measure_disks(make_scan(np.zeros((9, 9))), twice)
