"""Whether a frame that shows only some of its marks may be chance: how often places beside the marks look like marks.

A dot on a rough ground is like many a speck, a ring-cross like nothing else; no threshold holds for both. So the marks
are sought, in the same way, where they are not, and the share of those places that answer as strongly as the weakest of
the marks found says what these are worth.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import bdtrc

from measure.array_types import Array
from measure.detection.localisation import highest_peak
from measure.fiducials.frame import CLEAR_LIKENESS, Frame
from measure.fiducials.search import FrameSearch
from measure.flags import FRAME_BY_CHANCE, NO_FRAME, NO_REASON, Code, Reason
from measure.scans.scan import Scan

_SELDOM, _HOPELESS = 1e-3, 1e6  # expected frames: fewer are no question, and of more nothing becomes a frame
_COUNTED = 3  # marks that at least are no chance
_PLACES = 64  # that are looked at beside the marks: enough to tell three marks of four from chance
_OFFSETS = (2.5, 4.5)  # search radii off: beyond what the mark itself answers
_FREE = 2  # marks that a similarity goes through wherever they lie
_SURE = 12  # marks that agree: no speck feigns so many
_FITTED_PX = 3.0  # the fitted place is no farther from the one that answers
_REDUCED_PX = 1.5  # of the reduced scan: so near to where it answers there a mark answers in the scan
_APART = 2.0  # search radii off: beyond what a mark itself answers


def doubt_frame(search: FrameSearch, frame: Frame) -> Reason:
    """A sentence where chance may have made the frame, with the code no-frame where it is likelier to than not; empty
    where it is unlikely to. One that was found at a closer look is taken only where chance hardly makes it, though none
    of its marks may be clear."""
    if frame.placement.surroundings.robust:
        return NO_REASON
    inside = [index for index, detection in enumerate(frame.detections) if detection.inside]
    clear = {
        index: fit.center_px
        for index, fit in enumerate(frame.fits)
        if fit
        and fit.likeness >= CLEAR_LIKENESS
        and not frame.detections[index].closer  # those were seen for the others
    }
    if frame.inliers.sum() >= _SURE:
        return NO_REASON
    if len(clear) == len(inside):
        return _doubt_by_scan(search, frame, clear)
    return _doubt_by_neighbourhood(search, frame, inside, clear)


def false_frames(search: FrameSearch, frame: Frame, found_px: dict[int, Array]) -> float:
    """The expected number of false frames as good in the scan; found_px: of the marks that count, by index. Places that
    answer as strongly at reduced size are many; few of them look so in the scan itself."""
    expected = search.false_frames(frame.placement, frame.inside, found_px)
    if frame.placement.reduction == 1 or not _SELDOM < expected < _HOPELESS:
        return expected
    return expected * _share_at_full_resolution(search, frame, found_px) ** min(_COUNTED, len(found_px))


def _doubt_by_scan(search: FrameSearch, frame: Frame, clear: dict[int, Array]) -> Reason:
    """Where every mark was found: whether the scan has many places that answer as strongly. A frame that was looked for
    in the middle of its scan is not doubted: the windows about its marks tell of no other places."""
    if len(clear) <= _FREE or not search.is_exhaustive(frame.placement):
        return NO_REASON
    expected = false_frames(search, frame, clear)
    if expected <= FRAME_BY_CHANCE:
        return NO_REASON
    return Reason(
        f"so many places of the scan match the {len(clear)} marks found that {expected:.2g} such false alarms are "
        "expected in it; the frame may lie elsewhere",
        Code.CHANCE,
    )


def _share_at_full_resolution(search: FrameSearch, frame: Frame, found_px: dict[int, Array]) -> float:
    """Of the places that answer as strongly as the marks at reduced size, the share that does so in the scan itself."""
    marks_px, apart_px = np.array([*found_px.values()]), _APART * frame.first_search_px
    others = [
        (index, place)
        for index, own in found_px.items()
        for place in search.places_as_good(frame.placement, index, own)[: _PLACES // len(found_px)]
        if np.hypot(*(marks_px - place).T).min() > apart_px
    ]
    weakest = min(_response(search, frame, index, place, _FITTED_PX) for index, place in found_px.items())
    radius = _REDUCED_PX * frame.placement.reduction
    hits = sum(_response(search, frame, index, place, radius) >= weakest for index, place in others)
    return _share(hits, len(others))


def _doubt_by_neighbourhood(
    search: FrameSearch, frame: Frame, inside: Sequence[int], clear: dict[int, Array]
) -> Reason:
    """Where some marks were not found: whether places beside them look as much like marks as those that were."""
    found, radius = len(clear), frame.first_search_px
    places = _neighbouring_places(search.scan, frame, inside, radius)
    weakest = min((_response(search, frame, index, place, _FITTED_PX) for index, place in clear.items()), default=0.0)
    hits = sum(_response(search, frame, index, place, radius) >= weakest for index, place in places)
    chance = float(bdtrc(found - _FREE - 1, len(inside) - _FREE, _share(hits, len(places))))
    if chance <= FRAME_BY_CHANCE:
        return NO_REASON
    return Reason(
        f"only {found} of {len(inside)} marks were found, and {hits} of {len(places)} random places match "
        f"as well (p = {chance:.2f}): the frame may lie elsewhere",
        *((Code.CHANCE, Code.NO_FRAME) if chance > NO_FRAME else (Code.CHANCE,)),
    )


def _response(search: FrameSearch, frame: Frame, index: int, place: Array, radius_px: float) -> float:
    """How strongly a mark, by index, answers at most within a radius of a place in the scan."""
    return highest_peak(search.scan, frame.prediction(index, radius_px).moved(place))[1]


def _share(hits: int, places: int) -> float:
    """Laplace: none of sixty does not mean never."""
    return (hits + 1) / (places + 2)


def _neighbouring_places(scan: Scan, frame: Frame, inside: Sequence[int], radius_px: float) -> list[tuple[int, Array]]:
    """Places about the marks in the scan, in eight directions, each with the mark that is sought there."""
    angles = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    size = np.array([scan.width_px, scan.height_px])
    every = [
        (index, np.asarray(frame.predicted_px[index] + off * radius_px * direction))
        for off in _OFFSETS
        for direction in directions
        for index in inside
    ]
    within = [(index, place) for index, place in every if np.all(place >= 0) and np.all(place < size)]
    step = max(1, len(within) // _PLACES)
    return within[::step][:_PLACES]
