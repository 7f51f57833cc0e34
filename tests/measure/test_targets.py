"""Disks found and fitted, and targets by prediction: names, statuses and reasons."""

from typing import Any

import numpy as np
import pytest
from drawn import center, chi_square, draw, ellipse, make_scan, transformed, whitened
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import MarkMeasurement, Scan, Status, TargetOptions, TargetPrediction, measure_crosses, measure_disks
from measure.targets.block_search import Candidate
from measure.targets.detection import CrossSearch, DiskSearch, cross_candidates, disk_candidates
from measure.targets.disks import FittedDisk, fit_disk, fit_plain_disks

Array = NDArray[np.float64]
CONTRAST, NOISE, GROUND = 20000.0, 600.0, 12000.0
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
        errors.append(chi_square(mark, place) / 2)
    assert 0.75 < np.sqrt(np.mean(errors)) < 1.25  # three standard deviations of 70 numbers


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
            assert np.hypot(*(center(mark) - place)) < 0.2


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
        assert np.abs(center(mark) - places[mark.point]).max() < 0.04


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
        return float(np.abs(center(mark) - place).max())

    assert error(np.zeros(2)) > 0.02
    assert error(nearer @ np.linalg.inv(upright)) < 0.001


def test_two_blobs_on_a_faint_line_are_no_cross() -> None:
    picture = np.full((90, 90), GROUND)
    picture[43:47, 20:70] += 0.2 * CONTRAST
    picture[40:50, 20:27] += CONTRAST
    picture[40:50, 63:70] += CONTRAST
    assert cross_candidates(make_scan(picture), CrossSearch((12.0, 25.0), 0.25)) == []


def test_two_predictions_of_a_name_are_refused() -> None:
    twice = [TargetPrediction("a", np.zeros(2), np.eye(2), 5.0)] * 2
    with pytest.raises(ValueError, match="predicted twice: a"):
        measure_disks(make_scan(np.zeros((9, 9))), twice)


def some_ellipse(rng: np.random.Generator, radius_px: float, flatness: float) -> Array:
    turn = rng.uniform(0, np.pi)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return axes @ np.diag([radius_px, radius_px * flatness])


@parametrize_with_studies(("radius_px", "flatness"), [(3.0, 1.0), (5.0, 0.6), (9.0, 0.8)])
def test_errors_are_as_large_as_their_sigmas_say(radius_px: float, flatness: float) -> None:
    rng = np.random.default_rng(1)
    size = int(2 * radius_px + 31) | 1
    errors, offsets = [], []
    for _ in range(8):
        center, shape = size // 2 + rng.uniform(-0.5, 0.5, 2), some_ellipse(rng, radius_px, flatness)
        clean = GROUND + CONTRAST * draw(ellipse(center, shape), size, size, 0.9)
        for _ in range(6):
            scan = make_scan(clean + rng.normal(0, NOISE, clean.shape))
            disk = fit_disk(scan, center + rng.normal(0, 0.4, 2), shape * rng.uniform(0.9, 1.1))
            assert not disk.reason
            offsets.append(disk.center_px - center)
            errors.append(whitened(offsets[-1], disk.covariance_px2))
            assert disk.contrast_dn == pytest.approx(CONTRAST, rel=0.1)
            np.testing.assert_allclose(np.sort(disk.half_axes_px), [radius_px * flatness, radius_px], atol=0.25)
    assert 0.85 < np.sqrt(np.mean(np.square(errors))) < 1.15  # 96 numbers: 7.2 % standard deviation
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.01


def test_many_disks_at_once_are_placed_as_well_as_their_sigmas_say_and_odd_ones_looked_at_closer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng, alone = np.random.default_rng(3), list[Array]()

    def fit_alone(scan: Scan, center_px: Array, *others: Any) -> FittedDisk:
        alone.append(center_px)
        return fit_disk(scan, center_px, *others)

    monkeypatch.setattr("measure.targets.disks.fit_disk", fit_alone)
    picture, starts, true = np.full((240, 640), GROUND), [], []
    for number in range(40):
        corner = np.array([80 * (number % 8) + 8, 48 * (number // 8)])
        place, shape = corner + rng.uniform(23.5, 24.5, 2), some_ellipse(rng, 9.0, 0.8)
        window = picture[corner[1] : corner[1] + 48, corner[0] : corner[0] + 64]
        window += CONTRAST * draw(ellipse(place - corner, shape), 64, 48, 0.9)
        starts.append(Candidate(place + rng.normal(0, 0.2, 2), shape * rng.uniform(0.95, 1.05), CONTRAST))
        true.append(place)
    covered = true[0] - 9.0
    picture[max(round(covered[1]), 0) : round(covered[1]) + 9, round(covered[0]) : round(covered[0]) + 18] = GROUND
    disks = fit_plain_disks(make_scan(picture + rng.normal(0, NOISE, picture.shape)), starts, [10.0] * len(starts))
    errors = [whitened(disk.center_px - place, disk.covariance_px2) for disk, place in zip(disks, true, strict=True)]
    assert 0.85 < np.sqrt(np.mean(np.square(errors[1:]))) < 1.15  # 78 numbers: 8 % standard deviation
    assert all(not disk.reason and not disk.weakness for disk in disks[1:])
    assert len(alone) == 1
    assert disks[0].reason or disks[0].weakness
    for disk in disks[1:]:
        np.testing.assert_allclose(disk.half_axes_px, (9.0, 7.2), atol=0.2)
        assert abs(disk.blur_px - 0.9) < 0.15


def field(rng: np.random.Generator, count: int) -> tuple[Array, list[Array]]:
    """A textured ground with light disks of many sizes, some dark ones, and streaks that are no disks."""
    height, width = 500, 1800
    picture = (
        GROUND + 9000 * gaussian_filter(rng.normal(size=(height, width)), 4) + rng.normal(0, NOISE, (height, width))
    )
    centers = []
    for number in range(count):
        place = np.array([60 + 105 * (number % 16), 60 + 90 * (number // 16)]) + rng.uniform(-9, 9, 2)
        corner = np.round(place).astype(int) - 24
        shape = some_ellipse(rng, rng.uniform(3, 12), rng.uniform(0.6, 1.0))
        window = picture[corner[1] : corner[1] + 49, corner[0] : corner[0] + 49]
        window += CONTRAST * draw(ellipse(place - corner, shape), 49, 49, 0.9)
        centers.append(place)
    for row in range(20, 490, 60):
        picture[row : row + 3, 10:400] += 0.6 * CONTRAST
    return picture, centers


def fitted_disks(scan: Scan, search: DiskSearch) -> list[FittedDisk]:
    """What is found in the whole frame, fitted, less what the fit refuses and soft spots."""
    found = disk_candidates(scan, search)
    fitted = (fit_disk(scan, candidate.center_px, candidate.pixel_from_disk) for candidate in found)
    return [disk for disk in fitted if not (disk.reason or disk.is_soft)]


def test_all_disks_of_a_frame_and_nothing_else() -> None:
    picture, centers = field(np.random.default_rng(3), 32)
    found = fitted_disks(make_scan(picture), DiskSearch((5.0, 30.0), "light"))
    nearest = [min(float(np.hypot(*(disk.center_px - center))) for center in centers) for disk in found]
    hit = {int(np.argmin([np.hypot(*(disk.center_px - center)) for center in centers])) for disk in found}
    assert max(nearest) < 0.5
    assert len(found) == len(hit)
    assert len(hit) >= 31


@pytest.mark.parametrize(("snr", "blur_px"), [(10.0, 0.7), (50.0, 1.5)])
def test_disks_of_all_sizes_are_found_nearly_where_they_are(snr: float, blur_px: float) -> None:
    """From every reduction of the scan, also beside its edge; 0.15 px, or three times the best there is."""
    rng = np.random.default_rng(6)
    picture, true = GROUND + rng.normal(0, CONTRAST / snr, (300, 700)), []
    for number, radius in enumerate([2.6, 4.0, 6.0, 9.0, 14.0, 21.0, 30.0]):
        for row in (60, 220):
            place = np.array([30 + 100 * number - (number == 0) * 22, row]) + rng.uniform(-0.5, 0.5, 2)
            shape = some_ellipse(rng, radius, rng.uniform(0.6, 1.0) if radius > 3 else 1.0)
            corner = np.maximum(np.round(place).astype(int) - 48, 0)
            window = picture[corner[1] : corner[1] + 97, corner[0] : corner[0] + 97]
            window += CONTRAST * draw(ellipse(place - corner, shape), window.shape[1], window.shape[0], blur_px, 5)
            true.append(place)
    found = disk_candidates(make_scan(picture), DiskSearch((5.0, 70.0), "light"))
    assert len(found) == len(true)
    for place in true:
        nearest = min(found, key=lambda disk: float(np.hypot(*(disk.center_px - place))))
        best = 1.5 / snr / np.sqrt(nearest.radius_px)  # of a circle: an edge of 2 pi r pixels, about a pixel wide
        assert np.abs(nearest.center_px - place).max() < max(0.15, 3 * best)
