"""The search for the frame's place, on responses made up point by point."""

import numpy as np
from numpy.typing import NDArray

from measure.detection.correlation import local_maxima
from measure.detection.responses import ByteCache, Responses
from measure.fiducials.constellation import Bounds, Placement, PlacementSearch, same_picture
from measure.geometry import POSES, up_from_camera
from measure.marks.shapes import LayoutMark, MarkShape, dot

DOT = MarkShape(dot(0.3), "light")
PLACES = ((100.0, -100.0), (-100.0, -100.0), (-100.0, 100.0), (100.0, 100.0), (0.0, -103.0), (0.0, 95.0))
MARKS = [LayoutMark(str(index), place, (0.01, 0.01), DOT) for index, place in enumerate(PLACES)]
BOUNDS = Bounds(0.04, 0.1, 0.6)
NEAR_MM = 0.06
PITCH_MM = 0.5


def responses(places_px: NDArray[np.float64], heights: NDArray[np.float64], seed: int = 1) -> Responses:
    """A faint noisy map with peaks two pixels wide."""
    rng = np.random.default_rng(seed)
    light = rng.normal(0, 0.06, (520, 540)).astype(np.float32)
    for (col, row), height in zip(np.rint(places_px).astype(int), heights, strict=True):
        light[row - 1 : row + 2, col - 1 : col + 2] = 0.6 * height
        light[row, col] = height
    return Responses({(0, 1): light}, (0,), 1, ByteCache(1 << 30))


def placements(pose: str, answers: Responses) -> list[Placement]:
    return PlacementSearch(MARKS, answers, (PITCH_MM, PITCH_MM), BOUNDS).find_placements(pose, [0] * 6)


def view_marks(pose: str, scale: float = 1.015, angle: float = 0.03) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    up = np.array(PLACES) @ (scale * np.array([[c, -s], [s, c]]) @ up_from_camera(pose)).T
    return np.asarray(up * (1, -1) / PITCH_MM + (265.0, 255.0))


def predicted(placement: Placement) -> NDArray[np.float64]:
    return np.asarray(np.array(PLACES) @ placement.pixel_from_camera[:, :2].T + placement.pixel_from_camera[:, 2])


def test_the_place_is_found_among_brighter_false_answers() -> None:
    """Text, dials and trees answer more strongly than the marks; only the marks answer together."""
    rng = np.random.default_rng(3)
    for pose in POSES:
        true = view_marks(pose)
        false = rng.uniform(20, 500, (40, 2))
        places = np.concatenate([true, false])
        heights = np.concatenate([np.full(6, 0.6), rng.uniform(0.5, 0.9, 40)])
        found = placements(pose, responses(places, heights))
        assert np.abs(predicted(found[0]) - true).max() < 1.5
        assert found[0].supported == 6


def test_missing_marks_do_not_hinder() -> None:
    true = view_marks("0")
    found = placements("0", responses(true[:4], np.full(4, 0.5)))
    assert np.abs(predicted(found[0]) - true).max() < 2.0


def test_a_lattice_of_more_marks_than_candidates_is_not_a_step_off() -> None:
    """The hundred strongest answers, all in one corner, tell how it lies and not where it begins."""
    steps = 9.0 * (np.arange(23) - 11)
    lattice = [LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), DOT) for x in steps for y in steps]
    camera = np.array([mark.xy_mm for mark in lattice])
    true = camera @ np.array([[1.01, 0.02], [0.02, -1.01]]) / PITCH_MM + (268.0, 257.0)
    heights = np.interp(camera.min(axis=1), [-99.0, 99.0], [0.4, 0.7])
    answers = responses(true, heights)
    search = PlacementSearch(lattice, answers, (PITCH_MM, PITCH_MM), BOUNDS)
    best = search.find_placements("0", [0] * len(lattice))[0]
    found = camera @ best.pixel_from_camera[:, :2].T + best.pixel_from_camera[:, 2]
    assert np.abs(found - true).max() < 1.5


def test_nothing_that_answers_gives_no_placement() -> None:
    assert placements("0", Responses({(0, 1): np.zeros((300, 300), np.float32)}, (0,), 1, ByteCache(0))) == []


def test_peaks_come_in_order_and_apart() -> None:
    map_ = np.zeros((50, 60), np.float32)
    for col, row, height in ((10, 20, 0.5), (40, 30, 0.9), (12, 20, 0.4)):
        map_[row, col] = height
    map_[30:32, 40:42] = 0.9  # as high in four pixels: one peak
    places, heights = local_maxima(map_, 10, 0.1)
    assert places.tolist() == [[40, 30], [10, 20]]
    np.testing.assert_allclose(heights, [0.9, 0.5], rtol=1e-6)


def test_a_square_is_alike_in_all_poses_and_six_marks_do_not() -> None:
    first = ("0", [0] * 4)
    assert all(same_picture(MARKS[:4], first, (pose, [0] * 4), NEAR_MM) for pose in POSES)
    others = [pose for pose in POSES if not same_picture(MARKS, ("0", [0] * 6), (pose, [0] * 6), NEAR_MM)]
    assert set(others) == set(POSES) - {"0", "0m"}


def test_a_posed_placement_keeps_its_place() -> None:
    placement = Placement("0", np.array([[2.0, 0.1, 50.0], [0.1, -2.0, 60.0]]), 1.0, 4, 1, 1, (0.5, 0.5))
    turned = placement.posed("90m", np.array([mark.xy_mm for mark in MARKS[:4]]))
    assert turned.same_place(placement)
    center = turned.pixel_from_camera @ (10.0, 0.0, 1.0)
    np.testing.assert_allclose(center, placement.pixel_from_camera @ (*(up_from_camera("90m") @ (10.0, 0.0)), 1.0))


def test_a_posed_placement_is_moved_by_what_the_coordinates_differ() -> None:
    """Marks opposite each other whose coordinates are not: shifted, turned and larger, as the names are changed."""
    camera_mm = np.array([(-109.0, 0.3), (109.4, 0.0), (0.0, 109.2), (0.2, -109.0)])
    placement = Placement("0", np.array([[16.0, 0.3, 2350.0], [0.3, -16.0, 2340.0]]), 1.0, 4, 1, 4, (0.0625, 0.0625))
    turned = placement.posed("180", camera_mm)
    opposite = [1, 0, 3, 2]
    before, after = placement.places_px(camera_mm), turned.places_px(camera_mm)[opposite]
    assert turned.names(before, camera_mm).tolist() == opposite
    plain = camera_mm[opposite] @ (-placement.pixel_from_camera[:, :2]).T + placement.pixel_from_camera[:, 2]
    assert np.hypot(*(plain - before).T).min() > 3.0
    # What no similarity takes up is left: the sides' lengths differ by 0.2 mm.
    assert np.hypot(*(after - before).T).max() < 2.5
    np.testing.assert_allclose((after - before).mean(axis=0), 0.0, atol=1e-9)
