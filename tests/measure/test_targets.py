"""Disks found and fitted, and targets by prediction: names, statuses and reasons."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from drawn import center, chi_square, draw, ellipse, make_scan, transformed, whitened
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import MarkMeasurement, Scan, Status, TargetOptions, TargetPrediction, measure_crosses, measure_disks
from measure.flags import NO_REASON, Cause, Code
from measure.results import Covariance, SecondPlace
from measure.targets.block_search import TargetCandidate
from measure.targets.consistency import SheetImage, TargetPlaces, compare_targets, predict_sheet_points
from measure.targets.detection import CrossSearch, DiskSearch, cross_candidates, disk_candidates
from measure.targets.disks import FittedDisk, _assess, dust_reasons, fit_disk, fit_plain_disks
from measure.targets.ring_codes import RingCode, read_code
from measure.targets.sheets import Dots, Naming, SheetView, name_dots

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


def test_two_disks_at_one_place_are_refused() -> None:
    field = Field(3, np.zeros(2), count=14)
    place, shape = field.places["t10"], field.predictions[10].pixel_from_disk
    field.hide("t10")
    across = np.array([0.9 * shape[0, 0] + 5.0, 0.0])
    field.draw(place - across, shape)
    field.draw(place + across, shape)
    mark = field.measure_picture(TargetOptions(least_gate_px=14.0))["t10"]
    assert mark.status is Status.REJECTED
    assert "2 disks lie within" in mark.reason


def test_every_prediction_has_a_row_with_its_reason() -> None:
    field = Field(4, np.zeros(2), count=7)
    field.predictions += [
        TargetPrediction("outside", np.array([-9.0, 50.0]), np.eye(2) * 5, 20.0),
        TargetPrediction("tiny", np.array([200.0, 100.0]), np.eye(2) * 0.8, 20.0),
        TargetPrediction("nothing", np.array([115.0, 105.0]), np.eye(2) * 4, 8.0),
    ]
    marks = field.measure_picture()
    assert len(marks) == 10
    assert marks["outside"].status is Status.ABSENT
    assert "outside of the scan" in marks["outside"].reason
    assert "too small" in marks["tiny"].reason
    assert marks["nothing"].status is Status.PREDICTED
    assert "within 8 px" in marks["nothing"].reason


def test_a_disk_of_another_size_or_polarity_is_no_target() -> None:
    field = Field(5, np.zeros(2), count=14)
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
    field = Field(6, np.zeros(2), count=14)
    field.add("small", np.array([115.0, 105.0]), 2.3, np.zeros(2), 10.0)
    assert field.measure_picture()["small"].status is Status.MEASURED
    field.predictions = field.predictions[-5:]
    mark = field.measure_picture()["small"]
    assert mark.status is Status.WEAK
    assert "dust" in mark.reason


def test_the_order_of_predictions_does_not_matter() -> None:
    """Every disk lies near several places, so that another one is the first to have it fitted."""
    field = Field(7, np.array([5.0, 3.0]), search_px=110.0, count=8)
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
    for _ in range(5):
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
    assert 0.82 < np.sqrt(np.mean(np.square(errors))) < 1.18  # 60 numbers: 9 % standard deviation
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.01


def test_many_disks_at_once_are_placed_as_their_sigmas_say(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, alone = np.random.default_rng(3), list[Array]()

    def fit_alone(scan: Scan, center_px: Array, *others: Any) -> FittedDisk:
        alone.append(center_px)
        return fit_disk(scan, center_px, *others)

    monkeypatch.setattr("measure.targets.disks.fit_disk", fit_alone)
    picture, starts, true = np.full((144, 640), GROUND), [], []
    for number in range(24):
        corner = np.array([80 * (number % 8) + 8, 48 * (number // 8)])
        place, shape = corner + rng.uniform(23.5, 24.5, 2), some_ellipse(rng, 9.0, 0.8)
        window = picture[corner[1] : corner[1] + 48, corner[0] : corner[0] + 64]
        window += CONTRAST * draw(ellipse(place - corner, shape), 64, 48, 0.9)
        starts.append(TargetCandidate(place + rng.normal(0, 0.2, 2), shape * rng.uniform(0.95, 1.05), CONTRAST))
        true.append(place)
    covered = true[0] - 9.0
    picture[max(round(covered[1]), 0) : round(covered[1]) + 10, round(covered[0]) : round(covered[0]) + 18] = GROUND
    disks = fit_plain_disks(make_scan(picture + rng.normal(0, NOISE, picture.shape)), starts, [10.0] * len(starts))
    errors = [whitened(disk.center_px - place, disk.covariance_px2) for disk, place in zip(disks, true, strict=True)]
    assert 0.8 < np.sqrt(np.mean(np.square(errors[1:]))) < 1.2  # 46 numbers: 10 % standard deviation
    assert all(not disk.reason and not disk.weakness for disk in disks[1:])
    assert len(alone) == 1
    assert disks[0].reason or disks[0].weakness
    for disk in disks[1:]:
        np.testing.assert_allclose(disk.half_axes_px, (9.0, 7.2), atol=0.2)
        assert abs(disk.blur_px - 0.9) < 0.15


def field(rng: np.random.Generator, count: int) -> tuple[Array, list[Array]]:
    """A textured ground with light disks of many sizes, some dark ones, and streaks that are no disks."""
    height, width = 230, 900
    picture = (
        GROUND + 9000 * gaussian_filter(rng.normal(size=(height, width)), 4) + rng.normal(0, NOISE, (height, width))
    )
    centers = []
    for number in range(count):
        place = np.array([60 + 105 * (number % 8), 60 + 90 * (number // 8)]) + rng.uniform(-9, 9, 2)
        corner = np.round(place).astype(int) - 24
        shape = some_ellipse(rng, rng.uniform(3, 12), rng.uniform(0.6, 1.0))
        window = picture[corner[1] : corner[1] + 49, corner[0] : corner[0] + 49]
        window += CONTRAST * draw(ellipse(place - corner, shape), 49, 49, 0.9)
        centers.append(place)
    for row in range(20, 220, 60):
        picture[row : row + 3, 10:400] += 0.6 * CONTRAST
    return picture, centers


def fitted_disks(scan: Scan, search: DiskSearch) -> list[FittedDisk]:
    """What is found in the whole frame, fitted, less what the fit refuses and soft spots."""
    found = disk_candidates(scan, search)
    fitted = (fit_disk(scan, candidate.center_px, candidate.pixel_from_disk) for candidate in found)
    return [disk for disk in fitted if not (disk.reason or disk.is_soft)]


def test_all_disks_of_a_frame_and_nothing_else() -> None:
    picture, centers = field(np.random.default_rng(4), 16)
    found = fitted_disks(make_scan(picture), DiskSearch((5.0, 30.0), "light"))
    nearest = [min(float(np.hypot(*(disk.center_px - center))) for center in centers) for disk in found]
    hit = {int(np.argmin([np.hypot(*(disk.center_px - center)) for center in centers])) for disk in found}
    assert max(nearest) < 0.5
    assert len(found) == len(hit)
    assert len(hit) >= 15


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


SIZE_PX, NOISE_PX = (4000, 3000), 0.05
UNIT_DISK_PX = 3 * np.eye(2)


def target_places(rng: np.random.Generator, count: int, sigma_px: Array) -> tuple[TargetPlaces, Array]:
    """Targets and where they are seen: shifted, turned, by parallax, by 2 % of radial distortion, and by noise."""
    places = rng.uniform(0.0, SIZE_PX, (count, 2))
    depth = rng.uniform(-1.0, 1.0, count)
    about = (places - (2010.0, 1480.0)) / 5000.0
    parallax = np.stack([100.0 * depth, np.zeros(count)], axis=1)[..., None]
    bent = 0.08 * 5000.0 * about * (about**2).sum(axis=1, keepdims=True)
    view = places + (12.0, -7.0) + 20.0 * about[:, ::-1] * (1.0, -1.0) + 0.3 * parallax[..., 0] + bent
    view += rng.normal(0.0, 1.0, view.shape) * np.hypot(NOISE_PX, sigma_px)[:, None]
    covariances = sigma_px[:, None, None] ** 2 * np.eye(2)
    return TargetPlaces(places, parallax, covariances, np.zeros(count, bool)), view


@parametrize_with_studies("count", [40, 80, 200], quick=(2,))
def test_wrong_ones_are_reported_and_right_ones_as_seldom_as_stated(count: int) -> None:
    rng = np.random.default_rng(count)
    chances, wrong_chances = [], []
    for _ in range(480 // count):
        targets, view = target_places(rng, count, np.zeros(count))
        wrong = rng.choice(count, count // 10, replace=False)
        angle = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
        view[wrong] += rng.uniform(1.0, 4.0, (len(wrong), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        chance = compare_targets(targets, view, np.tile(1e-6 * np.eye(2), (count, 1, 1)), SIZE_PX).p_values
        wrong_chances.append(chance[wrong])
        chances.append(np.delete(chance, wrong))
    right = np.concatenate(chances)
    assert np.concatenate(wrong_chances).max() < 1e-3
    assert right.min() > 1e-4
    assert 0.01 < (right < 0.1).mean() < 0.12  # neighbours that scatter more make it less than said


def test_a_target_without_others_is_not_doubted() -> None:
    targets, view = target_places(np.random.default_rng(1), 1, np.zeros(1))
    compared = compare_targets(targets, view + 50.0, 1e-6 * np.eye(2)[None], SIZE_PX)
    assert compared.p_values.tolist() == [1.0]
    assert compared.off_px.shape == (1, 2)


def test_points_known_less_well_may_lie_farther_off() -> None:
    rng = np.random.default_rng(5)
    sigma = np.where(np.arange(200) < 20, 1.0, 0.02)
    targets, view = target_places(rng, 200, sigma)
    chance = compare_targets(targets, view, np.tile(1e-6 * np.eye(2), (200, 1, 1)), SIZE_PX).p_values
    assert chance.min() > 1e-4
    targets.covariance_px2[:20] = 4e-4 * np.eye(2)
    compared = compare_targets(targets, view, np.tile(1e-6 * np.eye(2), (200, 1, 1)), SIZE_PX)
    assert np.median(compared.p_values[:20]) < 1e-6


def test_how_far_off_right_ones_lie_is_as_well_known_as_stated() -> None:
    """The squares of what they are off, in the covariances said of that, have the mean 2 of two coordinates: what the
    others say is uncertain, too, and makes 2.15 of it where that is left out."""
    rng, squares = np.random.default_rng(6), []
    for _ in range(8):
        targets, view = target_places(rng, 80, np.zeros(80))
        result = compare_targets(targets, view, np.tile(NOISE_PX**2 * np.eye(2), (80, 1, 1)), SIZE_PX)
        squares.append(np.einsum("ni,nij,nj->n", result.off_px, np.linalg.inv(result.covariance_px2), result.off_px))
    assert 1.6 < np.mean(squares) < 2.0


SIZE = 121
CENTER = np.array([60.3, 59.6])
SHAPE = np.array([[11.0, 2.5], [-1.0, 7.0]])
EIGHT = RingCode(8, (2.6, 4.1))
TWELVE = RingCode()


def ringed(number: int, code: RingCode, turn: float, light: bool = False, tilt: Array | None = None) -> Scan:
    """A dot with the code's segments about it, the first one at an angle `turn`, clockwise as seen; tilt (2,): how fast
    the scale changes over the picture, per px."""
    inverse = np.linalg.inv(SHAPE)
    bits = np.array([number >> bit & 1 for bit in range(code.bits)[::-1]], bool)

    def inside(col: Array, row: Array) -> Array:
        right, down = col - CENTER[0], row - CENTER[1]
        nearer = 1.0 if tilt is None else 1.0 + tilt[0] * right + tilt[1] * down
        x, y = transformed(inverse, right / nearer, down / nearer)
        radius, angle = np.hypot(x, y), np.arctan2(y, x)
        segment = (np.floor((angle - turn) / (2 * np.pi) * code.bits)).astype(int) % code.bits
        ring = (radius > code.ring[0]) & (radius < code.ring[1]) & bits[segment]
        return np.asarray((radius < 1) | ring)

    picture = draw(inside, SIZE, SIZE, 0.9, fineness=4)
    noise = np.random.default_rng(number).normal(0, 600, picture.shape)
    return make_scan((12000 + 30000 * picture if light else 45000 - 30000 * picture) + noise)


def dot(light: bool = False, spin: float = 0.0) -> TargetCandidate:
    """The dot as a search finds it: an ellipse, whose axes say nothing of its circle's turn."""
    turn = np.array([[np.cos(spin), -np.sin(spin)], [np.sin(spin), np.cos(spin)]])
    return TargetCandidate(CENTER + np.array([0.2, -0.1]), 1.03 * SHAPE @ turn, 30000.0 if light else -30000.0)


@pytest.mark.parametrize(
    ("code", "number"), [*((EIGHT, number) for number in (1, 7, 31, 37, 85, 127, 200)), (TWELVE, 0b000001011011)]
)
def test_a_code_is_the_least_of_its_rotations(code: RingCode, number: int) -> None:
    """In every rotation, light and dark, whatever axes its ellipse has, and under a perspective by which the scale
    changes by a fifth over the ring."""
    least = min((number << turn | number >> (code.bits - turn)) & (2**code.bits - 1) for turn in range(code.bits))
    assert code.least_turn(number) == least
    for light, turn in ((False, 0.0), (True, 2.3), (False, 5.5)):
        scan, found = ringed(number, code, turn, light), dot(light, spin=1.7 * turn)
        other_hand = replace(found, pixel_from_disk=found.pixel_from_disk * (1.0, -1.0))
        assert [read_code(scan, each, code) for each in (found, other_hand)] == [least, least]
    assert read_code(ringed(number, code, 0.7, tilt=np.array([0.0012, -0.0016])), dot(), code) == least


def test_what_is_no_code() -> None:
    assert read_code(ringed(0, EIGHT, 0.0), dot(), EIGHT) is None  # a plain dot
    assert read_code(ringed(255, EIGHT, 0.0), dot(), EIGHT) is None  # a plain ring
    assert read_code(ringed(37, EIGHT, 0.0), dot(light=True), EIGHT) is None  # of the other polarity
    assert read_code(ringed(37, EIGHT, 0.0), dot(), RingCode(9, (2.6, 4.1))) is None  # of other segments


def test_green_alone_is_the_grey_value_of_a_scan_requested_it() -> None:
    colours = np.random.default_rng(8).integers(0, 65535, (20, 30, 3)).astype(float)
    scan = make_scan(colours)
    before = scan.window(2, 3, 10, 8)
    np.testing.assert_array_equal(scan.green_channel().window(2, 3, 10, 8), colours[3:11, 2:12, 1])
    np.testing.assert_array_equal(scan.window(2, 3, 10, 8), before)
    grey = make_scan(colours[..., 0])
    np.testing.assert_array_equal(grey.green_channel().window(0, 0, 30, 20), colours[..., 0])


def test_the_published_choice_of_numbers() -> None:
    """As many as the published generator of the patent's codes gives: 516 of 14 bits."""
    assert len(RingCode(14).published_numbers()) == 516
    code = RingCode()
    numbers = code.published_numbers()
    assert all(code.least_turn(number) == number for number in numbers)


def test_a_ring_viewed_from_behind() -> None:
    code = RingCode()
    segments = np.array([0, 0, 0, 0, 0, 1, 0, 1, 1, 1, 0, 0], bool)
    assert code.mirror(code.number(segments[::-1])) == code.number(segments)
    assert code.number(segments[::-1]) != code.number(segments)


SHEET_NAMING_SIZE = (2200, 1700)
DIAGONAL = float(np.hypot(*SHEET_NAMING_SIZE))


@dataclass(frozen=True, eq=False)
class View:
    """A sheet (n, 2), its dots and others; origin (m,): the point that each dot is, -1 for none."""

    sheet: Array
    dots: Dots
    origin: NDArray[np.int64]
    visible: int

    def wrong(self, naming: Naming) -> int:
        return sum(self.origin[dot] != point for point, dot in naming.named.items())


def view_sheet(rng: np.random.Generator, columns: int, rows: int, codes: int, uneven: float = 0.0) -> View:
    """A sheet under a pinhole camera with a lens of up to 15 % distortion, rolled anyhow; a fifth of its dots missing,
    a fifth as many false ones."""
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    middle = grid.mean(axis=0)
    height = uneven * np.sin(grid[:, 0] / 2.5) * np.cos(grid[:, 1] / 3.5)
    board = np.column_stack([grid - middle, height])
    tilt, around, roll = np.radians(rng.uniform(0, 50)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    turn = rotation_matrix(2, roll) @ rotation_matrix(0, np.pi + tilt) @ rotation_matrix(2, around)
    distance = 1.25 * max(columns, rows)
    bend = rng.uniform(-0.15, 0.1)

    def project(points: Array) -> Array:
        camera = points @ turn.T + np.array([0.0, 0.0, distance])
        ideal = camera[:, :2] / camera[:, 2:]
        r2 = (ideal**2).sum(axis=1, keepdims=True) / 0.5
        place = ideal * (1 + bend * r2)
        return np.asarray(place * DIAGONAL / 1.4 + (np.array(SHEET_NAMING_SIZE) - 1) / 2 + (30.0, -20.0))

    places, radius = project(board), 0.15
    across, up = (project(board + radius * axis) for axis in np.eye(3)[:2])
    spin = np.einsum("nik,nkj->nij", np.stack([across - places, up - places], axis=-1), spins(rng, len(grid)))
    inside = np.all((places > 5) & (places < np.array(SHEET_NAMING_SIZE) - 6), axis=1)
    found = np.flatnonzero(inside & (rng.random(len(grid)) < 0.8))
    false = int(0.2 * len(grid))
    centers = np.concatenate(
        [places[found] + rng.normal(0, 0.3, (len(found), 2)), rng.uniform(0, 1, (false, 2)) * SHEET_NAMING_SIZE]
    )
    shapes = np.concatenate(
        [spin[found] * rng.uniform(0.95, 1.05, (len(found), 1, 1)), np.tile(9 * np.eye(2), (false, 1, 1))]
    )
    origin = np.concatenate([found, np.full(false, -1)])
    coded = {int(dot): int(found[dot]) for dot in rng.choice(len(found), codes, replace=False)}
    return View(grid, Dots(centers, shapes, coded), origin, int(inside.sum()))


def rotation_matrix(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.roll(np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]), axis, axis=(0, 1))
    return np.asarray(turn)


def spins(rng: np.random.Generator, count: int) -> Array:
    """An ellipse says nothing of the turn of its circle."""
    return np.stack([rotation_matrix(2, angle)[:2, :2] for angle in rng.uniform(0, 2 * np.pi, count)])


@parametrize_with_studies(
    ("columns", "rows", "codes", "views"), [(10, 10, 4, 8), (10, 10, 2, 8), (23, 21, 6, 2)], quick=(2,)
)
def test_a_fifth_missing_and_a_fifth_false(columns: int, rows: int, codes: int, views: int) -> None:
    rng = np.random.default_rng(columns + codes)
    for _ in range(views):
        view = view_sheet(rng, columns, rows, codes)
        naming = name_dots(view.sheet, view.dots, SHEET_NAMING_SIZE)
        assert isinstance(naming, Naming), naming
        assert view.wrong(naming) == 0
        assert len(naming.named) >= 0.93 * np.sum(view.origin >= 0)
        assert not naming.misread


@pytest.mark.study
def test_codes_misread_are_outvoted_or_nothing_is_named() -> None:
    rng = np.random.default_rng(3)
    for _ in range(2):
        view = view_sheet(rng, 8, 8, 5)
        points = dict(view.dots.coded)
        one_wrong = {**points, next(iter(points)): int(rng.integers(0, 64))}
        naming = name_dots(view.sheet, replace(view.dots, coded=one_wrong), SHEET_NAMING_SIZE)
        assert isinstance(naming, Naming)
        assert view.wrong(naming) == 0
        all_wrong = {dot: int(point) for dot, point in zip(points, rng.integers(0, 64, 5), strict=True)}
        naming = name_dots(view.sheet, replace(view.dots, coded=all_wrong), SHEET_NAMING_SIZE)
        assert isinstance(naming, str)
        assert "do not put the other points" in naming or "no two" in naming


def test_one_code_is_not_enough() -> None:
    view = view_sheet(np.random.default_rng(4), 10, 10, 1)
    naming = name_dots(view.sheet, view.dots, SHEET_NAMING_SIZE)
    assert naming == "1 coded targets of the sheet were recognised, and two are needed"


def test_a_sheet_that_is_not_quite_flat() -> None:
    """Bumps of 6 % of a step, three times what the sheet of a camera calibration was found to have."""
    rng = np.random.default_rng(5)
    for _ in range(2):
        view = view_sheet(rng, 10, 10, 4, uneven=0.06)
        naming = name_dots(view.sheet, view.dots, SHEET_NAMING_SIZE)
        assert isinstance(naming, Naming), naming
        assert view.wrong(naming) == 0
        assert len(naming.named) >= 0.9 * np.sum(view.origin >= 0)


def test_two_codes_of_different_sheets_name_nothing() -> None:
    """Of one sheet the upper half is seen, of another one like it the lower half; a view through a dot of each may turn
    its back on the sheet."""
    sheet = np.array([(48.0 * column, 48.0 * row) for row in range(6) for column in range(7)])
    moved = np.where(sheet[:, 1:] < 120.0, (0.0, 0.0), (227.66576879, -132.54003258))
    centers = sheet * (1.0, -1.0) + (100.0, 400.0) + moved
    shapes = np.repeat(np.diag([7.3, -7.3])[None], 42, axis=0)
    shapes[0] = shapes[0] @ np.array([[1.0, -0.5948923], [0.0, 1.07725307]])
    named = name_dots(sheet, Dots(centers, shapes, {21: 21, 0: 0}), (1300, 950))
    assert isinstance(named, str)
    assert "do not put the other points of the sheet where dots are" in named


DUSTY_CONTRAST, DUSTY_GROUND = 15000.0, 25000.0


def test_a_speck_that_passes_for_the_disk_is_known_by_the_other_disks() -> None:
    """A dark speck on a dark disk looks like another dark disk: only its contrast and its form are not the others'."""
    rng = np.random.default_rng(1)
    picture = DUSTY_GROUND + rng.normal(0, 500, (60, 40 * 12))
    predictions = []
    for number in range(12):
        place = np.array([20 + 40 * number, 30]) + rng.uniform(-0.5, 0.5, 2)
        shape = 2.6 * np.diag([1.0, rng.uniform(0.85, 0.95)])
        window = picture[:, 40 * number : 40 * number + 40]
        at = place - (40 * number, 0)
        window -= rng.normal(1.0, 0.04) * DUSTY_CONTRAST * draw(ellipse(at, shape), 40, 60, 1.0)
        if number == 7:
            speck = draw(ellipse(at + np.array([0.6, 0.5]), 2.9 * np.eye(2)), 40, 60, 1.0)
            window += (DUSTY_GROUND - 1.6 * DUSTY_CONTRAST - window) * speck
        predictions.append(TargetPrediction(str(number), place + 0.3, 1.05 * shape, 4.0))
    marks = measure_disks(make_scan(picture), predictions)
    assert [mark.point for mark in marks if mark.status is Status.WEAK] == ["7"]
    assert "not like the other targets" in marks[7].reason
    assert all(mark.status is Status.MEASURED for mark in marks if mark.point != "7")


@pytest.mark.parametrize(("share", "doubted"), [(0.0, 0.04), (0.2, 0.15)])
def test_targets_are_odd_by_more_than_noise_and_common_differences(share: float, doubted: float) -> None:
    """Looks drawn as the comparison takes them to be, 5 % in contrast and 2 % in form, in noise of half to five times
    that variance; a share of them changed by 20 standard deviations; their paint slopes by no more than
    noise of 0.1 px."""
    rng, of_slope = np.random.default_rng(3), np.random.default_rng(4)
    spread = np.array([0.014, 0.014, 0.014, 0.05, 0.1])
    weak, odd = [], []
    for _ in range(15):
        disks, is_odd = [], rng.uniform(size=25) < share
        for change in 20.0 * is_odd * rng.choice((-1, 1), 25):
            mixing = (np.eye(5) + rng.normal(0, 0.3, (5, 5))) * spread
            noise = rng.uniform(0.5, 5) * mixing @ mixing.T
            observation = rng.normal(0, spread) + rng.multivariate_normal(np.zeros(5), noise)
            observation[3] += change * np.hypot(spread[3], np.sqrt(noise[3, 3]))
            values, vectors = np.linalg.eigh(
                [[observation[0] + observation[1], observation[2]], [observation[2], observation[0] - observation[1]]]
            )
            shape, blur = 3 * (vectors * np.exp(values)) @ vectors.T, float(np.sqrt(max(1.5 + observation[4], 0.1)))
            contrast = float(np.exp(observation[3])) * DUSTY_CONTRAST
            sloping = SecondPlace(of_slope.normal(0, 0.1, 2), 0.01 * np.eye(2))
            unknowns, figures = np.zeros((10, 10)), np.array([2, 3, 4, 6, 5])
            unknowns[np.ix_(figures, figures)] = noise * np.outer(per := np.array([1, 1, 1, contrast, 1]), per)
            disks.append(make_disk(shape, contrast_dn=contrast, blur_px=blur, sloping=sloping, covariance=unknowns))
        weak += [bool(reason) for reason in dust_reasons(disks, [3 * np.eye(2)] * 25)]
        odd += is_odd.tolist()
    assert np.mean(np.array(weak)[~np.array(odd)]) < doubted
    assert np.all(np.array(weak)[odd])


def test_a_weak_disk_names_the_cause_of_its_standard_deviation() -> None:
    """Noise of 0.018 px, misfit of 0.65 px: no faint disk."""
    misfit = Covariance({Cause.NOISE: 0.018**2 * np.eye(2), Cause.MODEL_MISFIT: 0.65**2 * np.eye(2)})
    *reasons, weak = dust_reasons([*[make_disk()] * 8, make_disk(place_covariance=misfit)], [3 * np.eye(2)] * 9)
    assert weak == "its standard deviation is 0.65 px, the largest part from model misfit"
    assert not any(reasons)


@pytest.mark.parametrize(("sigma", "is_white", "refused"), [(0.0, True, True), (0.2, True, False), (0.2, False, True)])
def test_the_upper_bound_of_its_contrast_decides_on_a_faint_disk(sigma: float, is_white: bool, refused: bool) -> None:
    """0.8 times the least signal-to-noise ratio of 4, by a contrast known to 20 %: 1.6 times as much in pure noise."""
    unknowns, noise_dn = np.zeros((10, 10)), DUSTY_CONTRAST / (0.8 * 4.0)
    unknowns[6, 6] = (sigma * DUSTY_CONTRAST) ** 2
    disk = make_disk(noise_dn=noise_dn, covariance=unknowns, covariance_is_white=is_white)
    assert (_assess(disk, np.zeros((2, 2))).reason.codes == (Code.CONTRAST,)) == refused


def test_soft_disks_are_fitted_with_as_much_ground_as_their_blur_reaches() -> None:
    """Radius 6 px, blur 3.5 px, noise of 4 % of the contrast. With 7 px of ground the mean error is 0.078 px."""
    rng, errors = np.random.default_rng(3), []
    for _ in range(10):
        picture, place = GROUND + rng.normal(0, 800.0, (81, 81)), 40.0 + rng.uniform(-0.5, 0.5, 2)
        shape = some_ellipse(rng, 6.0, 0.9)
        picture += CONTRAST * draw(ellipse(place, shape), 81, 81, 3.5)
        errors.append(np.hypot(*(fit_disk(make_scan(picture), place + rng.uniform(-1, 1, 2), shape).center_px - place)))
    assert np.mean(errors) < 0.062


def make_disk(shape: Array = UNIT_DISK_PX, **figures: Any) -> FittedDisk:
    """A fitted disk, precise unless figures say otherwise."""
    known: dict[str, Any] = {
        "place_covariance": Covariance.from_noise(0.001 * np.eye(2)),
        "contrast_dn": DUSTY_CONTRAST,
        "noise_dn": 100.0,
        "blur_px": 1.2,
        "covariance": 1e-4 * np.eye(10),
    }
    matrix = np.column_stack([shape, np.zeros(2)])
    return FittedDisk(
        converged=True, reason=NO_REASON, center_px=np.zeros(2), pixel_from_mark=matrix, **(known | figures)
    )


def radial_grid(largest: float, k1: float, k2: float) -> tuple[Array, Array]:
    """Places (n, 2) in an image of 800 x 600 px, out to a radius in half diagonals, and those without distortion."""
    place = np.stack(np.meshgrid(*2 * [np.linspace(-0.7, 0.7, 15)]), axis=-1).reshape(-1, 2)
    place *= largest / np.hypot(*place.T).max()
    r2 = (place**2).sum(axis=1, keepdims=True)
    return 500.0 * place + [399.5, 299.5], place * (1.0 + k1 * r2 + k2 * r2**2)


@pytest.mark.parametrize(("k1", "k2"), [(1.5, 0.5), (0.0, 2.0), (-0.3, 0.0)])
def test_a_view_inverts_the_distortion_of_a_fisheye(k1: float, k2: float) -> None:
    places_px, undistorted = radial_grid(1.0, k1, k2)
    view = SheetView(np.eye(3), np.array([k1, k2]), (800, 600))
    assert np.abs(view.places_px(undistorted) - places_px).max() < 1e-6


def test_points_where_a_view_just_ends_are_left_out() -> None:
    """The distortion turns back at a radius of 0.976: beside it a place exists, but none on its other side."""
    places_px, undistorted = radial_grid(0.9755, -0.35, 0.0)
    image = SheetImage(np.arange(225), places_px, np.tile(np.eye(2), (225, 1, 1)), (800, 600))
    (points,) = predict_sheet_points([image], np.column_stack([undistorted, np.zeros(225)]))
    assert points is not None
    assert 200 < len(points.index) < 225
    assert np.isfinite(points.by_point).all()
