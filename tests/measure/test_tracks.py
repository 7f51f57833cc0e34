"""Tracks from the features that pairs of frames share."""

from pathlib import Path

import numpy as np

from measure.tie_points.features import Features, TieFrame
from measure.tie_points.tracks import find_candidates, tracks_of_pairs, verify_pairs


def pairs(*rows: tuple[int, int]) -> np.ndarray:
    return np.array(rows, np.intp).reshape(-1, 2)


def test_a_point_that_all_pairs_share_is_a_track() -> None:
    shared = {(0, 1): pairs((4, 5)), (0, 2): pairs((4, 6)), (1, 2): pairs((5, 6))}
    assert tracks_of_pairs(shared) == [{0: 4, 1: 5, 2: 6}]


def test_a_frame_that_one_pair_alone_shows_is_left_out() -> None:
    shared = {(0, 1): pairs((4, 5)), (0, 2): pairs((4, 6)), (1, 2): pairs((5, 6)), (2, 3): pairs((6, 7))}
    assert tracks_of_pairs(shared) == [{0: 4, 1: 5, 2: 6}]
    chain = {(0, 1): pairs((4, 5)), (1, 2): pairs((5, 6))}
    assert tracks_of_pairs(chain) == []


def test_what_one_pair_alone_has_is_a_track_of_two() -> None:
    assert tracks_of_pairs({(0, 1): pairs((4, 5)), (1, 2): pairs((7, 8))}) == [{0: 4, 1: 5}, {1: 7, 2: 8}]


def test_two_features_in_one_frame_are_no_track() -> None:
    shared = {(0, 1): pairs((4, 5), (8, 9)), (0, 2): pairs((4, 6), (8, 6)), (1, 2): pairs((5, 6), (9, 6))}
    assert tracks_of_pairs(shared) == []


def test_scans_of_one_exposed_frame_are_one_sight_of_a_point() -> None:
    """Frame a in two scans that overlap, b whole, and c that shows a part of the ground: every candidate is in one scan
    of a, in b and in c. The scans of a are no pair, and a point of theirs that b alone shows has two sights only."""
    rng = np.random.default_rng(4)
    ground = rng.uniform([-300.0, -300.0, 0.0], [300.0, 300.0, 120.0], (400, 3))
    observations = rng.normal(0.0, 1.0, (400, 128))
    frames, features = [], []
    for image, part_of, station, first, end, lower in (
        ("a0", "a", (-60.0, 0.0, 900.0), 0, 700, 0),
        ("a1", "a", (-60.0, 0.0, 900.0), 500, 1200, 0),
        ("b", "", (60.0, 10.0, 920.0), 0, 1200, 0),
        ("c", "", (0.0, 80.0, 890.0), 0, 1200, 500),
    ):
        rays = ground - station
        places = 600.0 + 1300.0 * np.column_stack([rays[:, 0], -rays[:, 1]]) / -rays[:, 2:]
        shown = (places[:, 0] > first) & (places[:, 0] < end) & (places[:, 1] > lower) & (places[:, 1] < 1200)
        places = places[shown] - (first, 0)
        pixel_from_camera = np.array([[100.0, 0.0, 600.0 - first], [0.0, -100.0, 600.0]])
        view = (observations[shown] + rng.normal(0.0, 0.05, (shown.sum(), 128))).astype(np.float32)
        features.append(Features(places, view, np.ones(len(places)), np.ones(len(places)), (end - first, 1200)))
        none = np.zeros((0, 3))
        frames.append(TieFrame(image, Path(f"{image}.tif"), pixel_from_camera, None, none, part_of=part_of))
    shared = verify_pairs(frames, features, None)
    assert set(shared) == {(0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}
    assert min(len(pairs) for pairs in shared.values()) > 40
    found = find_candidates(frames, features, shared, 3)
    sights = [set(candidate.maps) for candidate in found]
    assert all(sight in ({0, 2, 3}, {1, 2, 3}) for sight in sights)
    assert min(sum(k in sight for sight in sights) for k in (0, 1)) > 40
    for candidate in found:  # the scan that shows the place farther inside, unless the other one defines it
        if candidate.reference > 1:
            col = candidate.maps[min(candidate.maps)][0, 2] + 500 * (1 in candidate.maps)
            assert (1 in candidate.maps) == (col > 600) or abs(col - 600) < 5
