"""Significance of a frame of which only some marks are found, from the correlation at places beside the marks.

A dot on a rough background resembles many specks, a cross in a ring nothing else: no single threshold fits both. The
marks are therefore searched in the same way where they are not. The share of those places that correlate at least as
strongly as the weakest mark found is the false-alarm rate of one mark.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import bdtrc

from measure.array_types import Array
from measure.detection.localisation import highest_peak
from measure.fiducials.frame import Frame
from measure.fiducials.search import FrameSearch
from measure.flags import FRAME_BY_CHANCE, NO_FRAME, NO_REASON, Code, Reason
from measure.scans.scan import Scan

_SELDOM, _HOPELESS = 1e-3, 1e6  # expected false frames between which full resolution may change the decision
_COUNTED = 3  # marks at most to whose false-alarm rates the share at full resolution applies
_PLACES = 64  # compared beside the marks: enough to test three marks found of four
_OFFSETS = (2.5, 4.5)  # in search radii: beyond the response of the mark itself
_FREE = 2  # marks that a similarity fits wherever they lie
_SURE = 12  # inliers from which the frame is no false alarm: specks do not agree so often
_FITTED_PX = 3.0  # px, largest distance between the fitted place and the correlation peak
_REDUCED_PX = 1.5  # px of the reduced scan: largest distance between the peaks at reduced and full resolution
_APART = 2.0  # in search radii: beyond the response of a mark itself


def doubt_frame(search: FrameSearch, frame: Frame) -> Reason:
    """Test whether a frame may be a false alarm.

    Returns
    -------
    Reason
        Empty if the frame is significant. Contains the code no-frame if it is more likely a false alarm than not.

    Notes
    -----
    Frames found by the search for faint marks are not tested again: they were accepted only if significant, although
    none of their marks may be clear.
    """
    if frame.placement.surroundings.robust:
        return NO_REASON
    inside = [index for index, detection in enumerate(frame.detections) if detection.inside]
    # A mark searched only where the others predict it is no independent evidence.
    clear = [index for index in frame.clear_fits if not frame.detections[index].closer]
    if len(frame.inlier_fits) >= _SURE:
        return NO_REASON
    if len(clear) == len(inside):
        return _doubt_by_scan(search, frame, clear)
    return _doubt_by_neighbourhood(search, frame, inside, clear)


def false_frames(search: FrameSearch, frame: Frame, found: Iterable[int]) -> float:
    """Expected number of false frames as good in the scan.

    found: indices of the marks that count. Many places respond as strongly at reduced resolution, but
    few of them at full resolution: the number is multiplied by their share to the power of at most `_COUNTED` marks.
    """
    found_px = {index: frame.inlier_fits[index].center_px for index in found}
    expected = search.false_frames(frame.placement, frame.inside, found_px)
    if frame.placement.reduction == 1 or not _SELDOM < expected < _HOPELESS:
        return expected
    return expected * _share_at_full_resolution(search, frame, found_px) ** min(_COUNTED, len(found_px))


def _doubt_by_scan(search: FrameSearch, frame: Frame, clear: Sequence[int]) -> Reason:
    """Test a frame of which every mark was found, by the false frames expected in a scan that was searched whole."""
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
    """Share of the places with responses as strong at reduced resolution that also have them at full resolution."""
    marks_px, apart_px = np.array([*found_px.values()]), _APART * frame.first_search_px()
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


def _doubt_by_neighbourhood(search: FrameSearch, frame: Frame, inside: Sequence[int], clear: Sequence[int]) -> Reason:
    """Test a frame of which some marks were not found, by the correlation beside the marks (binomial)."""
    found, radius = len(clear), frame.first_search_px()
    places = _neighbouring_places(search.scan, frame, inside, radius)
    fitted = ((index, frame.inlier_fits[index].center_px) for index in clear)
    weakest = min((_response(search, frame, *each, _FITTED_PX) for each in fitted), default=0.0)
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
    """Highest correlation of a mark, by index, within a radius of a place in the scan."""
    return highest_peak(search.scan, frame.prediction(index, radius_px).moved(place))[1]


def _share(hits: int, places: int) -> float:
    """Share by Laplace's rule of succession: no hit among sixty places does not mean a rate of zero."""
    return (hits + 1) / (places + 2)


def _neighbouring_places(scan: Scan, frame: Frame, inside: Sequence[int], radius_px: float) -> list[tuple[int, Array]]:
    """Places around the marks, in eight directions, each with the index of the mark that is searched there."""
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
