"""Detection: correlation maps and their cache, faint marks on texture, marks that touch stronger edges."""

import gc
import weakref

import numpy as np
import pytest
from drawn import Array, brute_picture, center, chi_square, make_scan, placed
from scipy import ndimage
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies
from true_marks import KIND, some_mark

from measure import FiducialOptions, MatchOptions
from measure.detection.correlation import (
    CLOSE,
    GRAINY,
    Map,
    Surroundings,
    chance_of_marks,
    correlation,
    expected_peaks,
    share_of_places,
)
from measure.detection.localisation import MarkPrediction, localise
from measure.detection.responses import ByteCache, MarkView, Responses, correlate_scan
from measure.fiducials.faint_marks import FaintMark, detect_faint
from measure.fiducials.mark_fit import detect_mark
from measure.flags import Cause
from measure.marks.shapes import Bar, MarkShape, cross, dot, polygon
from measure.tone.curve import Tone, power

CROSS = MarkShape(cross(0.5, 0.05), "dark")
LINEAR = 36.0 * np.diag([1.0, -1.0])
SIDE_PX, STEP_PX = 5, 110


def textured(seed: int) -> Array:
    """Ground of brightness 20000 with a texture of 2000, correlated over two to three pixels."""
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.normal(0, 1, (SIDE_PX * STEP_PX,) * 2), 1.0)
    return np.asarray(20000 + 2000 * field / field.std())


def places(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*(np.arange(SIDE_PX) * STEP_PX + STEP_PX / 2,) * 2), axis=-1).reshape(-1, 2)
    return np.asarray(grid + rng.uniform(-0.5, 0.5, grid.shape))


def detect_marks(grey: Array, predicted: Array) -> list[FaintMark | None]:
    scan = make_scan(grey)
    return [detect_faint(scan, MarkPrediction(CROSS, np.column_stack([LINEAR, xy]), 3, -1), 0, 0.7) for xy in predicted]


def test_a_cross_of_the_grounds_own_contrast_is_measured_with_an_honest_sigma() -> None:
    squares = []
    grey, true = textured(0), places(0)
    for place in true:
        col0, row0 = np.rint(place).astype(int) - 25
        shown = brute_picture(CROSS, np.column_stack([LINEAR, place - (col0, row0)]), 51, 51, 0.7, 16)
        grey[row0 : row0 + 51, col0 : col0 + 51] -= 5000 * shown
    for found, place in zip(detect_marks(grey, np.rint(true)), true, strict=True):
        assert found is not None
        assert found.false_alarms < 1e-4
        squares.append(chi_square(found.fit, place) / 2)
    assert 0.7 < float(np.sqrt(np.mean(squares))) < 1.4


@pytest.mark.parametrize("radius_px", [1.0, 6.0, 25.0])
def test_a_gaussian_field_has_as_many_peaks_as_are_expected(radius_px: float) -> None:
    """White noise under a Gaussian of s pixels has slopes of variance 1 / (2 s²)."""
    blur_px, rng, highest = 3.0, np.random.default_rng(8), []
    rows, cols = np.indices((60, 60)) - 30
    near = np.hypot(cols, rows) <= radius_px
    for _ in range(40):
        field = gaussian_filter(rng.normal(size=(420, 420)), blur_px, mode="wrap")
        blocks = (field / field.std()).reshape(7, 60, 7, 60).swapaxes(1, 2)[..., near]
        highest += blocks.max(axis=-1).ravel().tolist()
    for p_value in (0.2, 0.05):
        levels = np.linspace(1.0, 5.0, 401)
        expected = np.array([expected_peaks(level, np.eye(2) / (2 * blur_px**2), radius_px) for level in levels])
        level = levels[np.argmax(expected <= p_value)]
        assert np.mean(np.array(highest) > level) == pytest.approx(p_value, rel=0.25)


def test_marks_respond_by_chance_as_often_as_a_binomial_says() -> None:
    """Of four marks with a share of 0.1, three or more in 4 * 0.001 * 0.9 + 0.0001 of cases."""
    np.testing.assert_allclose(chance_of_marks(np.array([3, 4]), 4, np.array([0.1, 0.1])), [0.0037, 0.0001])
    assert share_of_places(0, 60) == pytest.approx(1 / 62)


@pytest.mark.study
def test_a_mark_many_pixels_wide_is_sought_in_a_reduced_picture_with_an_honest_sigma() -> None:
    """A disk of 116 pixels, of half of the texture's contrast; at full size too little texture lies about it."""
    wide, side_px, errors, squares = MarkShape(dot(1.6), "dark"), 801, [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        place, texture = 400 + rng.uniform(-3.0, 3.0, 2), gaussian_filter(rng.normal(0.0, 1.0, (side_px,) * 2), 1.0)
        grey = 20000 + 2000 * texture / texture.std()
        grey -= 1000 * brute_picture(wide, np.column_stack([LINEAR, place]), side_px, side_px, 0.7)
        expected = MarkPrediction(wide, np.column_stack([LINEAR, [400.0, 400.0]]), 8.0, -1)
        scan = make_scan(grey)
        found = detect_faint(scan, expected, 0.0, 0.7)
        assert found is not None
        errors.append(found.fit.center_px - place)
        squares.append(chi_square(found.fit, place) / 2)
    assert 0.5 < float(np.sqrt(np.mean(squares))) < 1.5
    assert np.abs(np.mean(errors, axis=0)).max() < 3.0 * np.std(errors) / np.sqrt(len(errors))


def test_a_sharp_mark_to_one_side_of_its_point_may_be_turned_otherwise_than_the_frame() -> None:
    """Lines finer than the pixels are far apart are placed between them; and what a turn of its own by a hundredth, as
    real register glasses have it, moves is in the covariance."""
    side = MarkShape((Bar((-1.5, 0.0), (0.3, 0.0), 0.02), Bar((0.0, -0.3), (0.0, 0.3), 0.02)), "dark")
    turns = (0.0, 0.012, -0.012)
    errors, sigmas = [], []
    for seed, turn in enumerate(turns):
        grey, place = textured(seed), places(seed)[12]
        turned = LINEAR @ np.array([[1.0, -turn], [turn, 1.0]])
        grey -= 15000 * brute_picture(side, np.column_stack([turned, place]), grey.shape[1], grey.shape[0], 0.3)
        expected = MarkPrediction(side, np.column_stack([LINEAR, place + np.array([0.45, -0.4])]), 3.0, -1)
        scan = make_scan(grey)
        found = detect_faint(scan, expected, 0.0, 0.3)
        assert found is not None
        assert Cause.ROTATION in found.fit.place_covariance.parts
        errors.append(found.fit.center_px - place)
        sigmas.append(np.sqrt(np.diag(found.fit.covariance_px2)))
    errors_px, sigmas_px = np.array(errors), np.array(sigmas)
    assert np.abs(errors_px[0]).max() < 0.15  # as drawn: far nearer than it was predicted
    assert (np.abs(errors_px) < 3.0 * sigmas_px).all()
    assert sigmas_px[:, 1].min() > 0.1
    assert sigmas_px[:, 1].max() < 0.6


def test_a_mark_painted_over_with_one_grey_value_is_not_found() -> None:
    grey, place = textured(0), places(0)[12]
    col, row = np.rint(place).astype(int)
    grey[row - 50 : row + 51, col - 50 : col + 51] = 20480.0
    assert detect_marks(grey, place[None]) == [None]


def test_where_the_ground_is_black_nothing_is_visible() -> None:
    black = np.zeros((SIDE_PX * STEP_PX,) * 2)
    assert all(found is None for found in detect_marks(black, places(1)[:3]))


def test_what_the_tone_curve_moves_a_faint_mark_by_is_in_its_covariance() -> None:
    """A cross on ground that is darker to one side: how much each of its lines counts depends on the curve."""
    grey = textured(5) * np.linspace(0.5, 1.6, SIDE_PX * STEP_PX)
    place = places(5)[12]
    grey -= 6000 * brute_picture(CROSS, np.column_stack([LINEAR, place]), grey.shape[1], grey.shape[0], 0.7)
    expected = MarkPrediction(CROSS, np.column_stack([LINEAR, place]), 3.0, -1)
    scan = make_scan(grey)
    prior = Tone.unknown()
    detection = detect_faint(scan.replace_tone(prior), expected, 0.0, 0.7)
    ends = [detect_faint(scan.replace_tone(Tone(power(value))), expected, 0.0, 0.7) for value in (1.0, 2.2)]
    assert detection is not None
    assert ends[0] is not None
    assert ends[1] is not None
    half = (ends[1].fit.center_px - ends[0].fit.center_px) / 2
    assert np.hypot(*half) > 1e-4
    np.testing.assert_allclose(detection.fit.place_covariance.parts[Cause.TONE], np.outer(half, half), 0.25, 2e-7)
    np.testing.assert_allclose(detection.fit.center_px, ends[0].fit.center_px + half, atol=0.002)
    assert Cause.TONE not in ends[0].fit.place_covariance.parts


GROUND, CONTRAST = 25000.0, 15000.0


@parametrize_with_studies("texture_px", [0.0, 1.0, 3.0], quick=(0, 2))
def test_noise_is_rarely_worth_a_fit_however_coarse_it_is(texture_px: float) -> None:
    rng = np.random.default_rng(1)
    marks = [some_mark(KIND[name], 1.0, rng) for name in ("cross", "ring-dot", "dot")]
    tries, answers = 20, 0
    for mark in marks * tries:
        noise = rng.standard_normal((mark.size, mark.size))
        if texture_px:
            noise = gaussian_filter(noise, texture_px) * texture_px * 3
        expected = MarkPrediction(mark.kind.shape, mark.place, 3.0, 1)
        answers += localise(make_scan(GROUND + 3000 * noise), expected) is not None
    assert answers <= 7  # of sixty at a twentieth, by both templates together: more in one run of a hundred


def test_a_soft_mark_that_hardly_stands_out_of_the_noise_is_measured() -> None:
    rng = np.random.default_rng(2)
    mark = some_mark(KIND["gap cross"], 2.5, rng)
    grey = GROUND + CONTRAST * (mark.picture + rng.standard_normal((mark.size, mark.size)) / 5)
    start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + rng.uniform(-1, 1, 2)])
    fit = detect_mark(make_scan(grey), MarkPrediction(mark.kind.shape, start, 3.0, 1), FiducialOptions().match).fit
    assert chi_square(fit, mark.place[:, 2]) < 13.8
    assert fit is not None
    assert np.trace(fit.covariance_px2) < 1.5**2 * np.trace(mark.bound(0.2))


def test_a_line_far_thinner_than_a_pixel_is_not_detected_in_noise_and_warns_of_nothing() -> None:
    mark = MarkShape(cross(1.5, 0.06), "dark")
    noise = np.random.default_rng(3).standard_normal((60, 60))
    place = np.array([[1.5, 0.0, 30.0], [0.0, -1.5, 30.0]])  # 0.67 mm a pixel
    assert localise(make_scan(GROUND + 3000 * noise), MarkPrediction(mark, place, 3.0, -1)) is None


PX_PER_MM = 30.0
BEYOND_EDGE_GROUND, EDGE, NOISE = 55000.0, 5000.0, 600.0
WING = MarkShape(polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35))))


def test_a_wing_is_measured_whose_base_is_the_frames_edge() -> None:
    place = placed(PX_PER_MM, (60.3, 59.7))
    grey = BEYOND_EDGE_GROUND + 5500.0 * brute_picture(WING, place, 121, 121, 1.0)
    grey[:, 84:] = EDGE
    grey += np.random.default_rng(1).normal(0.0, NOISE, grey.shape)
    detection = detect_mark(make_scan(grey), MarkPrediction(WING, place, 4.0, 1, surroundings=CLOSE), MatchOptions())
    assert np.hypot(*(center(detection.fit) - place[:, 2])) < 0.2


def test_a_faint_light_cross_is_measured_whose_dark_pad_ends_next_to_it_in_a_light_landscape() -> None:
    mark, place = MarkShape(cross(0.5, 0.05, 0.07, 45.0), "light"), placed(PX_PER_MM, (60.3, 59.7))
    rng = np.random.default_rng(4)
    row, col = np.mgrid[:121, :121]
    landscape = 30000.0 + 6000.0 * gaussian_filter(rng.normal(size=(121, 121)), 3.0) * 10.0
    grey = np.where(np.hypot(col - 60.3, row - 59.7) < 20.0, 4000.0, landscape)
    grey += 3500.0 * brute_picture(mark, place, 121, 121, 0.7) + rng.normal(0.0, 900.0, grey.shape)
    detection = detect_mark(make_scan(grey), MarkPrediction(mark, place, 4.0, 1, surroundings=CLOSE), MatchOptions())
    assert detection.fit is not None, detection.reason
    assert np.hypot(*(detection.fit.center_px - place[:, 2])) < 0.3


def responses_to(
    surroundings: Surroundings, grey: np.ndarray, template: np.ndarray, detail_px: float, faint_dn: float
) -> Map:
    """The correlation of a picture, freed of its ground, with a template."""
    flat = surroundings.flatten(grey.astype(np.float32), detail_px, faint_dn)
    mask = surroundings.mask(template, detail_px)
    return correlation(flat, surroundings.pattern(template, detail_px, mask, flat), mask)


MAP = np.random.default_rng(5).normal(size=(40, 50)).astype(np.float32)


def test_responses_are_freed_with_the_search_and_not_by_the_next_garbage_collection() -> None:
    responses = Responses({(0, 1): MAP}, (0,), 1, ByteCache(1 << 30))
    assert responses.dilated((0, 1), 2.0).map.shape == MAP.shape
    alive = weakref.ref(responses)
    gc.disable()
    try:
        del responses
        assert alive() is None
    finally:
        gc.enable()


def test_unlike_dark_marks_of_a_colour_scan_keep_one_map_each() -> None:
    """Marks that only blue shows. A lighter mark is not asked for, and the marks share no mask."""
    marks = [MarkShape(cross(1.0, 0.2), "dark"), MarkShape(polygon([(0.0, 0.0), (1.6, 0.5), (1.6, -0.5)]), "dark")]
    linear, places = np.diag([10.0, -10.0]), [(40.0, 60.0), (90.0, 50.0)]
    grey = np.random.default_rng(3).normal(30000.0, 500.0, (110, 130, 3))
    for mark, place in zip(marks, places, strict=True):
        grey[..., 2] -= 20000.0 * brute_picture(mark, np.column_stack([linear, place]), 130, 110, 0.6)
    cache = ByteCache(1 << 30)
    views = [MarkView(mark, linear) for mark in marks]
    responses = correlate_scan(make_scan(grey), views, {-1}, CLOSE, cache, 1000, 4)
    for kind, place in zip(responses.kinds, places, strict=True):
        map_ = responses.maps[kind, -1]
        assert np.array_equal(np.unravel_index(map_.argmax(), map_.shape)[::-1], place)
        assert map_.max() > 0.6
    assert sum(each.nbytes for each in cache._entries.values()) == 2 * 4 * 110 * 130


def test_dilated_maps_take_two_bytes_a_pixel_and_keep_their_heights() -> None:
    """In large scans they are most of the memory; heights are correlations, rounded far below what noise does."""
    map_ = (MAP / 4).clip(-1.0, 1.0)
    dilated = Responses({(0, 1): map_}, (0,), 1, ByteCache(1 << 30)).dilated((0, 1), 2.0)
    assert dilated.nbytes == 2 * map_.size
    rows, cols = np.indices(map_.shape)
    for col, row in ((20, 10), (7, 33), (0, 0)):
        within = np.hypot(cols - col, rows - row) <= 2
        assert dilated.height(np.array([col, row])) == pytest.approx(map_[within].max(), abs=5e-5)


def test_lines_as_fine_as_the_grain_answer_at_closer_matching_by_what_the_grain_hides_least() -> None:
    """Pixels are alike about the crosses, which hides what is coarse of them."""
    rng = np.random.default_rng(2)
    mark, linear = MarkShape(cross(1.75, 0.12, 0.25, 45.0), "light"), np.diag([7.8, -7.8])
    places = np.array([[60.3, 60.0], [60.1, 240.4], [239.8, 60.2], [240.0, 239.7]])
    grain = ndimage.gaussian_filter(rng.standard_normal((300, 300)), 1.0)
    grey = 20000.0 + 1300.0 * grain / grain.std() + rng.normal(0.0, 300.0, grain.shape)
    for place in places:
        grey += 3100.0 * brute_picture(mark, np.column_stack([linear, place]), 300, 300, 0.6)
    template = brute_picture(mark, np.column_stack([linear, [16.0, 16.0]]), 33, 33, 0.6)

    def stronger_elsewhere(surroundings: Surroundings) -> int:
        response = responses_to(surroundings, grey, template, 1.0, 130.0)
        near = [np.s_[round(y) - 18 : round(y) - 13, round(x) - 18 : round(x) - 13] for x, y in places]
        weakest = min(response[each].max() for each in near)
        for each in near:
            response[each] = 0.0
        return int((response > weakest).sum())

    assert stronger_elsewhere(GRAINY) <= 2
    assert stronger_elsewhere(CLOSE) > 50
