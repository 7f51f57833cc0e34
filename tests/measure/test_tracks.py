"""Tracks from the features that pairs of frames share."""

import numpy as np

from measure.natural_points.tie_candidates import join_tracks


def pairs(*rows: tuple[int, int]) -> np.ndarray:
    return np.array(rows, np.intp).reshape(-1, 2)


def test_a_point_that_all_pairs_share_is_a_track() -> None:
    shared = {(0, 1): pairs((4, 5)), (0, 2): pairs((4, 6)), (1, 2): pairs((5, 6))}
    assert join_tracks(shared) == [{0: 4, 1: 5, 2: 6}]


def test_a_frame_that_one_pair_alone_shows_is_left_out() -> None:
    shared = {(0, 1): pairs((4, 5)), (0, 2): pairs((4, 6)), (1, 2): pairs((5, 6)), (2, 3): pairs((6, 7))}
    assert join_tracks(shared) == [{0: 4, 1: 5, 2: 6}]
    chain = {(0, 1): pairs((4, 5)), (1, 2): pairs((5, 6))}
    assert join_tracks(chain) == []


def test_what_one_pair_alone_has_is_a_track_of_two() -> None:
    assert join_tracks({(0, 1): pairs((4, 5)), (1, 2): pairs((7, 8))}) == [{0: 4, 1: 5}, {1: 7, 2: 8}]


def test_two_features_in_one_frame_are_no_track() -> None:
    shared = {(0, 1): pairs((4, 5), (8, 9)), (0, 2): pairs((4, 6), (8, 6)), (1, 2): pairs((5, 6), (9, 6))}
    assert join_tracks(shared) == []
