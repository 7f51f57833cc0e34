"""Tracks: the same natural point in several frames, joined from what pairs of frames share."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

Place = tuple[int, int]  # a frame, and a feature of it
Track = dict[int, int]  # the feature in every frame


def join_tracks(shared: Mapping[tuple[int, int], NDArray[np.intp]]) -> list[Track]:
    """Tracks in the order of their features.

    shared: by pair of frames, (n, 2) features that they share. A track that has two features in a frame is none; and a
    feature stays in one of three frames or more only where two others share it. What one pair alone has is a track of
    two.
    """
    links = [((i, int(a)), (j, int(b))) for (i, j), pairs in sorted(shared.items()) for a, b in pairs]
    parent: dict[Place, Place] = {}
    for link in links:
        parent[_root(parent, link[0])] = _root(parent, link[1])
    groups: dict[Place, list[tuple[Place, Place]]] = defaultdict(list)
    for link in links:
        groups[_root(parent, link[0])].append(link)
    tracks = [_proven(group) for group in groups.values()]
    return sorted((track for track in tracks if track), key=lambda track: sorted(track.items()))


def _root(parent: dict[Place, Place], place: Place) -> Place:
    parent.setdefault(place, place)
    while parent[place] != place:
        parent[place] = parent[parent[place]]
        place = parent[place]
    return place


def _proven(links: Iterable[tuple[Place, Place]]) -> Track:
    """The features of one group that two others hold, or its only pair; none where a frame has two."""
    kept = list(links)
    if len(kept) == 1:
        return dict(kept[0])
    while True:
        count = Counter(place for link in kept for place in link)
        left = [link for link in kept if min(count[link[0]], count[link[1]]) >= 2]
        if len(left) == len(kept):
            break
        kept = left
    track = dict(count.keys())
    return track if len(track) == len(count) else {}
