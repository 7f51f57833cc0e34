"""Targets against where the others put them, ring codes, sheets, dusty disks."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from drawn import draw, ellipse, make_scan, transformed
from numpy.typing import NDArray
from studies import parametrize_with_studies

from measure import Scan, Status, TargetPrediction, measure_disks
from measure.flags import NO_REASON, Cause
from measure.results import Covariance, SecondPlace
from measure.targets.block_search import Candidate
from measure.targets.consistency import TargetPlaces, compare_targets
from measure.targets.disks import FittedDisk, dust_reasons
from measure.targets.ring_codes import RingCode, read_code
from measure.targets.sheets import Dots, Naming, name_dots

Array = NDArray[np.float64]
SIZE_PX, NOISE_PX = (4000, 3000), 0.05
UNIT_DISK_PX = 3 * np.eye(2)


def field(rng: np.random.Generator, count: int, sigma_px: Array) -> tuple[TargetPlaces, Array]:
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
        targets, view = field(rng, count, np.zeros(count))
        wrong = rng.choice(count, count // 10, replace=False)
        angle = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
        view[wrong] += rng.uniform(1.0, 4.0, (len(wrong), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        chance = compare_targets(targets, view, np.tile(1e-6 * np.eye(2), (count, 1, 1)), SIZE_PX).chance
        wrong_chances.append(chance[wrong])
        chances.append(np.delete(chance, wrong))
    right = np.concatenate(chances)
    assert np.concatenate(wrong_chances).max() < 1e-3
    assert right.min() > 1e-4
    assert 0.01 < (right < 0.1).mean() < 0.12  # neighbours that scatter more make it less than said


def test_points_known_less_well_may_lie_farther_off() -> None:
    rng = np.random.default_rng(5)
    sigma = np.where(np.arange(200) < 20, 1.0, 0.02)
    targets, view = field(rng, 200, sigma)
    chance = compare_targets(targets, view, np.tile(1e-6 * np.eye(2), (200, 1, 1)), SIZE_PX).chance
    assert chance.min() > 1e-4
    targets.covariance_px2[:20] = 4e-4 * np.eye(2)
    assert np.median(compare_targets(targets, view, np.tile(1e-6 * np.eye(2), (200, 1, 1)), SIZE_PX).chance[:20]) < 1e-6


def test_how_far_off_right_ones_lie_is_as_well_known_as_stated() -> None:
    """The squares of what they are off, in the covariances said of that, have the mean 2 of two coordinates: what the
    others say is uncertain, too, and makes 2.15 of it where that is left out."""
    rng, squares = np.random.default_rng(6), []
    for _ in range(14):
        targets, view = field(rng, 80, np.zeros(80))
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


def dot(light: bool = False, spin: float = 0.0) -> Candidate:
    """The dot as a search finds it: an ellipse, whose axes say nothing of its circle's turn."""
    turn = np.array([[np.cos(spin), -np.sin(spin)], [np.sin(spin), np.cos(spin)]])
    return Candidate(CENTER + np.array([0.2, -0.1]), 1.03 * SHAPE @ turn, 30000.0 if light else -30000.0)


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
    assert code.mirrored(code.number(segments[::-1])) == code.number(segments)
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
    for _ in range(5):
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


CONTRAST, GROUND = 15000.0, 25000.0


def test_a_speck_that_passes_for_the_disk_is_known_by_the_other_disks() -> None:
    """A dark speck on a dark disk looks like another dark disk: only its contrast and its form are not the others'."""
    rng = np.random.default_rng(1)
    picture = GROUND + rng.normal(0, 500, (60, 40 * 12))
    predictions = []
    for number in range(12):
        place = np.array([20 + 40 * number, 30]) + rng.uniform(-0.5, 0.5, 2)
        shape = 2.6 * np.diag([1.0, rng.uniform(0.85, 0.95)])
        window = picture[:, 40 * number : 40 * number + 40]
        at = place - (40 * number, 0)
        window -= rng.normal(1.0, 0.04) * CONTRAST * draw(ellipse(at, shape), 40, 60, 1.0)
        if number == 7:
            speck = draw(ellipse(at + np.array([0.6, 0.5]), 2.9 * np.eye(2)), 40, 60, 1.0)
            window += (GROUND - 1.6 * CONTRAST - window) * speck
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
            contrast = float(np.exp(observation[3])) * CONTRAST
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
    misfit = Covariance({Cause.NOISE: 0.018**2 * np.eye(2), Cause.UNLIKE_DRAWING: 0.65**2 * np.eye(2)})
    *reasons, weak = dust_reasons([*[make_disk()] * 8, make_disk(place_covariance=misfit)], [3 * np.eye(2)] * 9)
    assert weak == "its standard deviation is 0.65 px, the largest part from model misfit"
    assert not any(reasons)


def make_disk(shape: Array = UNIT_DISK_PX, **figures: Any) -> FittedDisk:
    """A fitted disk, precise unless figures say otherwise."""
    known: dict[str, Any] = {
        "place_covariance": Covariance.from_noise(0.001 * np.eye(2)),
        "contrast_dn": CONTRAST,
        "noise_dn": 100.0,
        "blur_px": 1.2,
        "covariance": 1e-4 * np.eye(10),
    }
    matrix = np.column_stack([shape, np.zeros(2)])
    return FittedDisk(
        converged=True, reason=NO_REASON, center_px=np.zeros(2), pixel_from_mark=matrix, **(known | figures)
    )
