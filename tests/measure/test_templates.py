"""Marks that nobody has drawn: learned, symmetric, of own figures."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from drawn import brute_picture, chi_square, frame_picture, lay_out, measure_grey, pixel_from_camera
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from measure import ScanWindow
from measure.detection.localisation import recurrence
from measure.fiducials.across_frames import check_frames
from measure.fiducials.mark_comparison import check_own_figures, unlike_blur, unlike_others
from measure.flags import Cause, Reason, Status
from measure.geometry import POSES, UP_FROM_CAMERA
from measure.marks.shapes import Bar, MarkShape, MarkTemplate, cross, polygon
from measure.marks.templates import Chip, learn_template, share_origins
from measure.matching.covariance import honest_covariance
from measure.matching.match import match
from measure.matching.models import MatchOptions
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation

Array = NDArray[np.float64]

WEDGE = MarkShape(polygon([(0.0, 0.0), (0.9, 1.2), (0.9, -1.2)]))
PX_PER_MM, SIDE, NOISE_DN, SIZE_MM = 12.0, 61, 20.0, 2.8
SHIFT = MatchOptions(freedom="shift", estimate_blur=False)


def pictures(count: int, seed: int, dust: bool = False) -> tuple[list[Chip], Array]:
    """Chips of the wedge, each with a gain of its own and placed half a pixel wrong, and the true places (n, 2)."""
    rng = np.random.default_rng(seed)
    true, linear = 30 + rng.uniform(-0.5, 0.5, (count, 2)), PX_PER_MM * np.array([[1.0, 0.004], [0.003, -1.0]])
    chips = []
    for index, place in enumerate(true):
        shown = brute_picture(WEDGE, np.column_stack([linear, place]), SIDE, SIDE, 0.8)
        grey = rng.uniform(1500, 2500) + rng.uniform(700, 1300) * shown + rng.normal(0, NOISE_DN, shown.shape)
        if dust and index == 0:
            grey[26:32, 34:40] += 4000.0
        chips.append(Chip(f"frame{index}", grey, (0, 0), np.column_stack([linear, place + rng.normal(0, 0.4, 2)])))
    return chips, true


def measure_picture(chips: list[Chip]) -> tuple[Array, Array]:
    """Places (n, 2) and standard deviations (n, 2) with the template that the chips give."""
    template = learn_template(chips, SIZE_MM)
    fits = [match(ScanWindow(chip.grey), template, chip.pixel_from_mark, SHIFT) for chip in chips]
    covariances = [honest_covariance(template, chip.scan, fit).px2 for chip, fit in zip(chips, fits, strict=True)]
    return np.array([fit.center_px for fit in fits]), np.sqrt(np.array(covariances)[:, [0, 1], [0, 1]])


def test_a_learned_template_measures_as_its_standard_deviations_say() -> None:
    """Places differ from the true ones by one common offset, and by no more than is claimed: 2 x 6 x 2 coordinates."""
    scores = []
    for seed in (1, 2):
        chips, true = pictures(6, seed)
        places, sigma = measure_picture(chips)
        off = places - true
        scores.append((off - off.mean(axis=0)) / sigma / np.sqrt(1 - 1 / 6))
        assert sigma.max() < 0.04
    assert 0.7 < float(np.sqrt(np.mean(np.square(scores)))) < 1.35


def test_dust_on_one_picture_stays_out_of_the_template() -> None:
    clean, _ = pictures(5, 3)
    dusty, _ = pictures(5, 3, dust=True)
    with_dust, without = (learn_template(chips, SIZE_MM).image.ravel() for chips in (dusty, clean))
    gain, offset = np.polyfit(with_dust, without, 1)  # of a template they do not matter
    assert np.abs(gain * with_dust + offset - without).max() < 4 * NOISE_DN


def test_one_picture_alone_is_its_own_template_and_keeps_an_honest_sigma() -> None:
    chips, _ = pictures(1, 4)
    template = learn_template(chips, SIZE_MM)
    assert dict(template.shares) == {"frame0": 1.0}
    fit = match(ScanWindow(chips[0].grey), template, chips[0].pixel_from_mark, SHIFT)
    np.testing.assert_allclose(fit.center_px, chips[0].pixel_from_mark[:, 2], atol=0.02)
    sigma = np.sqrt(np.diag(honest_covariance(template, "frame0", fit).px2))
    assert 0.005 < sigma.min() < sigma.max() < 0.2  # the residuals, which are nothing, would say nothing


def test_what_recurs_is_found_among_what_changes() -> None:
    rng = np.random.default_rng(5)
    mark = np.zeros((24, 24), np.float32)
    mark[8:16, 11:13] = mark[11:13, 8:16] = 4.0
    windows = []
    for right, down in ((0, 0), (3, -2), (-2, 4), (1, 1)):
        window = rng.normal(0, 1, (73, 73)).astype(np.float32)
        window[18 + down : 42 + down, 30 + right : 54 + right] += mark
        windows.append(window)
    found = recurrence(windows[0], windows[1:], size_mm=2.4)
    assert found.excess > 0.3
    np.testing.assert_allclose(found.offset_mm, (0.55, 0.65), atol=0.11)  # its middle, (41.5, 29.5), from (36, 36)
    assert recurrence(windows[0], [rng.normal(0, 1, (73, 73)).astype(np.float32)] * 3, 2.4).excess < 0.15


def test_a_corner_of_the_border_next_to_a_lighter_landscape_is_known_less_surely() -> None:
    """Learned beside a landscape of 150, seen beside one of 230, each rough in its own way, whose glow on the border
    does not grow with it: both edges seem to lie elsewhere, as the standard deviations have to say."""
    rng = np.random.default_rng(6)
    template = learn_template([corner(rng, 150.0, 30 + rng.uniform(-0.5, 0.5, 2)) for _ in range(3)], SIZE_MM)
    errors = []
    for place in 30 + rng.uniform(-0.5, 0.5, (4, 2)):
        view = corner(rng, 230.0, place)
        start = np.column_stack([view.pixel_from_mark[:, :2], np.rint(place)])
        fit = match(ScanWindow(view.grey), template, start, MatchOptions(freedom="shift"))
        assert fit.converged
        errors.append(fit.center_px - place)
        assert chi_square(fit, place) < 3.0**2
    assert float(np.sqrt(np.mean(np.square(errors)))) < 0.5


def corner(rng: np.random.Generator, level_dn: float, place: Array) -> Chip:
    """A landscape's corner, right of and below a place, in a border on which it glows."""
    right, below = np.arange(SIDE) - place[0], (np.arange(SIDE) - place[1])[:, None]
    share, glow = (ndtr(right / blur_px) * ndtr(below / blur_px) for blur_px in (0.8, 3.0))
    landscape = level_dn + 13.0 * gaussian_filter(rng.normal(0, 6.0, share.shape), 1.7)
    grey = (1 - share) * (30.0 + 80.0 * glow) + share * landscape + rng.normal(0, 1.5, share.shape)
    return Chip("frame", grey, (0, 0), np.column_stack([PX_PER_MM * np.diag([1.0, -1.0]), place]))


PLACES = np.array([(6.0, -6.0), (-6.0, -6.0), (-6.0, 6.0), (6.0, 6.0)])
SYMMETRY_SIDE, SYMMETRY_PX_PER_MM = 61, 20.0


def clicked(shape: MarkShape, off_mm: np.ndarray, rng: np.random.Generator) -> MarkTemplate:
    """A picture of the mark whose origin, in its middle, lies beside the mark's own by off_mm."""
    middle = np.full(2, SYMMETRY_SIDE // 2)
    place = np.column_stack(
        [SYMMETRY_PX_PER_MM * np.diag([1.0, -1.0]), middle - SYMMETRY_PX_PER_MM * np.array([1.0, -1.0]) * off_mm]
    )
    grey = 100.0 * brute_picture(shape, place, SYMMETRY_SIDE, SYMMETRY_SIDE, 1.0) + rng.normal(
        0, 4.0, (SYMMETRY_SIDE, SYMMETRY_SIDE)
    )
    return MarkTemplate(grey, 1000 / SYMMETRY_PX_PER_MM, (SYMMETRY_SIDE // 2, SYMMETRY_SIDE // 2), learned_mm=3.0)


def test_origins_of_crosses_are_laid_in_their_middles() -> None:
    rng = np.random.default_rng(1)
    off = rng.normal(0, 0.1, (4, 2))
    templates, moves = share_origins([clicked(MarkShape(cross(1.0, 0.2)), each, rng) for each in off], PLACES, POSES)
    assert templates[0].alike == POSES[1:]
    np.testing.assert_allclose(moves, -off, atol=0.05 / SYMMETRY_PX_PER_MM)
    for template, move in zip(templates, moves, strict=True):
        shift = (np.array(template.origin_px) - SYMMETRY_SIDE // 2) / SYMMETRY_PX_PER_MM * (1.0, -1.0)
        np.testing.assert_allclose(shift, move, atol=1e-9)


def test_marks_that_are_each_turned_with_their_place_keep_what_nothing_tells() -> None:
    """Half-wedges of a frame that looks alike turned by quarters: their origins come to lie alike, at no tips."""
    rng = np.random.default_rng(2)
    outline = np.array([(0.0, 0.0), (1.0, 0.1), (1.0, 0.9)])
    quarters = [UP_FROM_CAMERA[pose] for pose in ("0", "270", "180", "90")]  # from one corner to the next
    off = rng.normal(0, 0.1, (4, 2))
    shapes = [MarkShape(polygon(tuple(map(tuple, (outline @ turn.T).tolist())))) for turn in quarters]
    templates, moves = share_origins([clicked(*each, rng) for each in zip(shapes, off, strict=True)], PLACES, POSES)
    assert templates[0].alike == ("90", "180", "270")
    left = off + moves  # of the origins from the tips: alike once each is turned back
    turned = np.array([turn.T @ each for turn, each in zip(quarters, left, strict=True)])
    np.testing.assert_allclose(turned, turned.mean(axis=0) + np.zeros((4, 2)), atol=0.15 / SYMMETRY_PX_PER_MM)


@pytest.mark.parametrize("places", [PLACES, PLACES * (1.0, 0.5)])
def test_marks_that_differ_stay_as_they_were(places: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    shapes = [MarkShape(cross(1.0, 0.2)), *(MarkShape(polygon(((0.0, 0.0), (1.1, 0.2), (0.4, 0.8)))) for _ in range(3))]
    marks = [clicked(shape, np.zeros(2), rng) for shape in shapes]
    templates, moves = share_origins(marks, places, POSES)
    assert templates == marks
    assert not moves.any()


GIVEN = MarkShape(cross(0.8, 0.1))
SHORT = MarkShape((Bar((-0.7, 0.0), (0.7, 0.0), 0.1), Bar((0.0, -0.8), (0.0, 0.7), 0.1)))
COVERED = MarkShape((Bar((-0.8, 0.0), (0.8, 0.0), 0.1), Bar((0.0, -0.8), (0.0, 0.5), 0.1)))
OWN_PLACES = tuple((7.0 * x, 7.0 * y) for y in (1, 0, -1) for x in (-1, 0, 1))
LAYOUT, PITCH = lay_out([GIVEN] * 9, OWN_PLACES), (50.0, 50.0)


def plate_frame(number: int) -> FrameMeasurement:
    """A frame of a plate whose third cross has three short arms; an arm of the sixth one is covered in frame 3."""
    plate = lay_out([SHORT if k == 2 else COVERED if (k, number) == (5, 3) else GIVEN for k in range(9)], OWN_PLACES)
    matrix = pixel_from_camera("0", 0.008 + 0.001 * number, (202.3 + 0.3 * number, 197.6 - 0.4 * number))
    return replace(measure_grey(frame_picture(plate, matrix, seed=number), LAYOUT), image=str(number))


def test_what_is_alike_in_all_frames_is_the_plates() -> None:
    frames = [plate_frame(number) for number in range(1, 4)]
    assert any("times as large as the other marks" in frame.marks[2].reason for frame in frames)
    checked = check_frames(frames, LAYOUT, [PITCH] * 3).frames
    assert {mark.status for frame in checked for mark in frame.marks} == {Status.MEASURED}
    pair = check_frames(frames[:2], LAYOUT, [PITCH] * 2).frames
    assert [frame.marks[2].status for frame in pair] == [frame.marks[2].status for frame in frames[:2]]


def test_a_cross_without_an_arm_is_where_it_is_claimed() -> None:
    """The other three give its place, and nothing tells of the fourth."""
    matrix = pixel_from_camera("0", 0.011, (203.2, 196.4))
    halved = MarkShape((Bar((-0.8, 0.0), (0.8, 0.0), 0.1), Bar((0.0, -0.8), (0.0, 0.0), 0.1)))
    grey = frame_picture(lay_out([halved if k == 5 else GIVEN for k in range(9)], OWN_PLACES), matrix, seed=3)
    mark = measure_grey(grey, LAYOUT).marks[5]
    assert mark.center_px is not None
    off_px = mark.center_px - matrix[:, :2] @ OWN_PLACES[5] - matrix[:, 2]
    assert np.hypot(*off_px) < 0.03
    assert off_px @ np.linalg.solve(np.asarray(mark.covariance_px2), off_px) < 9.2  # chi-square at 1 %


@pytest.mark.parametrize(("poses", "agree"), [(("0", "0", "0m"), True), (("0", "0", "0"), False)])
def test_a_turn_is_compared_as_the_camera_has_it(poses: tuple[str, ...], agree: bool) -> None:
    """Two frames have the mark turned by 3 degrees to the left, one to the right: the same turn if that is mirrored."""
    frames = []
    for pose, turn_rad in zip(poses, (0.051, 0.054, -0.054), strict=True):
        quality = {"size_ratio": 1.0, "size_sigma": 0.002, "turn_rad": turn_rad, "turn_sigma": 0.002}
        place = Covariance({Cause.NOISE: 0.01 * np.eye(2)})
        mark = MarkMeasurement("1", "fiducial", np.zeros(2), place, Status.MEASURED, quality=quality)
        frames.append(FrameMeasurement(pose, (mark,), ScanOrientation(pose, True)))
    assert [frame.marks[0].status is Status.MEASURED for frame in check_own_figures(frames)] == [True, True, agree]


def make_frames(figures: Sequence[Mapping[str, float]], doubt: Reason) -> list[FrameMeasurement]:
    """A frame for each of these figures of a mark, weak for that doubt, beside two crosses as drawn."""
    place, others = Covariance({Cause.NOISE: 0.01 * np.eye(2)}), {"size_ratio": 1.0, "blur_ratio": 1.0}
    doubted = place.plus(Cause.SMEAR, np.eye(2))
    sigmas = {"size_sigma": 0.01, "blur_sigma": 0.01}
    frames = []
    for number, own in enumerate(figures):
        marks = [
            MarkMeasurement("1", "fiducial", np.zeros(2), doubted, Status.WEAK, doubt, {**others, **own, **sigmas}),
            *(
                MarkMeasurement(name, "fiducial", np.ones(2), place, Status.MEASURED, quality={**others, **sigmas})
                for name in "23"
            ),
        ]
        frames.append(FrameMeasurement(str(number), tuple(marks), ScanOrientation("0", True)))
    return frames


def test_a_target_with_a_fiducials_name_has_no_part_in_its_comparison() -> None:
    target = MarkMeasurement("1", "target", np.ones(2), Covariance({Cause.NOISE: np.eye(2)}), Status.MEASURED)
    weak = replace(target, status=Status.WEAK, reason=unlike_blur(1.6), quality={"blur_ratio": 1.0, "blur_sigma": 0.01})
    plain = make_frames([{"blur_ratio": 1.6}, {"size_ratio": 1.3}, {}, {}], unlike_blur(1.6))
    for own in (target, weak):
        frames = check_own_figures([replace(frame, marks=(*frame.marks, own)) for frame in plain])
        assert [frame.marks[-1] for frame in frames] == [own] * len(frames)
        statuses = [[mark.status for mark in frame.marks] for frame in check_own_figures(plain)]
        assert [[mark.status for mark in frame.marks[:-1]] for frame in frames] == statuses


@pytest.mark.parametrize(
    ("figures", "doubt", "status"),
    [
        ([{"size_ratio": 0.9}] * 3, unlike_others(0.9, None), Status.MEASURED),
        ([{"size_ratio": 0.9}, {}, {}], unlike_others(0.9, None), Status.WEAK),
        ([{"blur_ratio": 1.6}] * 3, unlike_blur(1.6), Status.MEASURED),
        ([{"blur_ratio": 1.6}, {}, {}], unlike_blur(1.6), Status.WEAK),
    ],
)
def test_a_plate_explains_a_doubt_away(figures: Sequence[Mapping[str, float]], doubt: Reason, status: Status) -> None:
    mark = check_own_figures(make_frames(figures, doubt))[0].marks[0]
    assert mark.covariance is not None
    assert mark.status is status
    assert (Cause.SMEAR in mark.covariance.parts) is (status is Status.WEAK)
