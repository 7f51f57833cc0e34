"""Expected number of false alarms: of placements, of frames whose marks were measured, and of a frame in doubt.

A dot on a rough background resembles many specks, a cross in a ring nothing else: no single threshold fits both. The
false-alarm rate of one mark is therefore the share of other places that correlate at least as strongly as the weakest
mark found: all places of the reduced scan, or places beside the marks at full resolution.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.special import bdtrc, comb

from measure.array_types import Array
from measure.detection.localisation import highest_peak
from measure.fiducials.constellation import NARROW, Placement
from measure.fiducials.frame import REDUCED_PX, Frame
from measure.fiducials.search import SearchResult
from measure.flags import FRAME_DOUBT_P, FRAME_REJECTED_P, NO_REASON, Code, Reason

_CRITERIA = 3  # by which a false frame may be as good: response heights, misfit, and misfit under a stretch
_STRETCHES = np.linspace(-0.03, 0.03, 13)  # relative, of non-square pixels; a step moves marks within narrow bounds
_PLACES = 64  # compared beside the marks: enough to test three marks found of four
_SELDOM, _HOPELESS = 1e-3, 1e6  # expected false frames between which full resolution may change the decision
_COUNTED = 3  # marks at most to whose false-alarm rates the share at full resolution applies
_APART = 2.0  # in search radii: beyond the response of a mark itself
_OFFSETS = (2.5, 4.5)  # in search radii: beyond the response of the mark itself
_FREE = 2  # marks that a similarity fits wherever they lie
_SURE = 12  # inliers from which the frame is no false alarm: specks do not agree so often
_FITTED_PX = 3.0  # px, largest distance between the fitted place and the correlation peak


def false_placements(result: SearchResult, placement: Placement) -> float:
    """Expected number of placements as good in a similar scan without any frame, under this pitch hypothesis alone."""
    search = result.searches[placement.pitch_mm]
    places = placement.places_px(search.camera_mm)
    inside = np.all((places >= 0) & (places < result.size_px), axis=1)
    found = {index: places[index] for index in np.flatnonzero(inside).tolist()}
    return _false_alarms(result, placement, found, len(found), search.tolerance_px)


def false_frames(result: SearchResult, frame: Frame, indices: Iterable[int]) -> float:
    """Expected number of false frames as good in the scan as one with marks, by index, found where they were fitted.

    Null hypothesis: detections are uniform within the search tolerance. A good fit of many marks by a similarity, with
    or without a stretch, is then improbable. Many places respond as strongly at reduced resolution, but few of them at
    full resolution: the number is multiplied by their share to the power of at most `_COUNTED` marks.
    """
    placement, found_px = frame.placement, {index: frame.inlier_fits[index].center_px for index in indices}
    widest_px, expected = result.searches[placement.pitch_mm].tolerance_px, list[float]()
    for stretches in (np.zeros(1), _STRETCHES):
        misfit_px = _misfit_px(frame, found_px, stretches)
        tolerance_px = min(max(misfit_px, NARROW * widest_px), widest_px)
        expected.append(len(stretches) * _false_alarms(result, placement, found_px, frame.inside, tolerance_px))
    reduced = _CRITERIA * min(expected)
    if placement.reduction == 1 or not _SELDOM < reduced < _HOPELESS:
        return reduced
    return reduced * _share_at_full_resolution(result, frame, found_px) ** min(_COUNTED, len(found_px))


def _share_at_full_resolution(result: SearchResult, frame: Frame, found_px: Mapping[int, Array]) -> float:
    """Share of the places with responses as strong at reduced resolution that also have them at full resolution."""
    marks_px, apart_px = np.array([*found_px.values()]), _APART * frame.first_search_px
    others = [
        (index, place)
        for index, own in found_px.items()
        for place in _places_as_good(result, frame.placement, index, own)[: _PLACES // len(found_px)]
        if np.hypot(*(marks_px - place).T).min() > apart_px
    ]
    weakest = min(_response(frame, index, place, _FITTED_PX) for index, place in found_px.items())
    radius_px = REDUCED_PX * frame.placement.reduction
    return _share(sum(_response(frame, index, place, radius_px) >= weakest for index, place in others), len(others))


def _places_as_good(result: SearchResult, placement: Placement, index: int, found_px: Array) -> Array:
    """(n, 2) candidates of a mark that respond at least as strongly, at reduced resolution, as found_px (2,)."""
    search = result.searches[placement.pitch_mm]
    responses, key = search.responses, search.key(placement, index)
    height = responses.dilated(key, search.tolerance_px).height(responses.reduced_px(found_px))
    candidates = responses.candidates(key)
    return responses.scan_px(candidates[responses.highest_about(key, candidates, 0.0)[1] >= height])


def _share(hits: int, places: int) -> float:
    """Share by Laplace's rule of succession: no hit among sixty places does not mean a rate of zero."""
    return (hits + 1) / (places + 2)


def _misfit_px(frame: Frame, found_px: Mapping[int, Array], stretches: Array) -> float:
    """Largest residual, px of the reduced scan, of the marks found after a similarity with the best stretch."""
    if not found_px:
        return 0.0
    placement, pitch = frame.placement, frame.pitch_mm
    given = frame.camera_mm[list(found_px)] @ placement.pixel_from_camera[:, :2].T
    found = np.array([*found_px.values()])
    found = found if placement.lens is None else placement.lens.ideal_px(found)
    given, found = ((each - each.mean(axis=0)) * pitch for each in (given, found))
    longer = np.stack([1 + stretches / 2, 1 - stretches / 2], axis=-1)
    given, found = (given * longer[:, None]) @ (1, 1j), found @ (1, 1j)
    turns = (given.conj() @ found) / np.maximum((np.abs(given) ** 2).sum(axis=1), 1e-12)
    off = np.abs(found - turns[:, None] * given).max(axis=1)
    return float(off.min() / pitch.mean() / placement.reduction)


def _false_alarms(
    result: SearchResult, placement: Placement, found_px: Mapping[int, Array], inside: int, tolerance_px: float
) -> float:
    """Expected number of false frames, from the shares of places that respond as strongly within tolerance_px.

    Of n marks in the scan k respond, the weakest at least as strongly as a share p of all places. A random frame has as
    many with a probability of about (n over k) p^k. The number of distinct frames is that of all pairs of places, for
    two marks far apart, that the bounds of rotation and scale allow.
    """
    search = result.searches[placement.pitch_mm]
    responses, shares, same_px = search.responses, [], 1
    for index, place in found_px.items():
        dilation = responses.dilated(search.key(placement, index), tolerance_px)
        shares.append(dilation.share(responses.reduced_px(place)))
        same_px = dilation.area_px
    counts = np.arange(max(min(3, inside), 1), len(shares) + 1)
    if len(counts) == 0:
        return np.inf
    likely = comb(inside, counts) * np.sort(shares)[counts - 1] ** counts
    # Number of distinct frames: same_px neighbouring places of the reduced scan have the same dilated response.
    extent_mm = float(np.hypot(*np.ptp(search.camera_mm, axis=0)))
    span_px = extent_mm / float(search.pitch.mean()) / responses.reduction
    places = next(iter(responses.maps.values())).size
    second = 2 * search.bounds.rotation_rad * 2 * search.bounds.scale_tolerance * span_px**2
    polarities = len({sign for _, sign in responses.maps})
    different = places / same_px * second / same_px * len(search.distinct) * polarities
    return float(len(counts) * likely.min() * different)


def doubt_frame(result: SearchResult, frame: Frame) -> Reason:
    """Test whether a frame may be a false alarm.

    Returns
    -------
    Reason
        Empty if the frame is significant. Contains the code no-frame if it is likely a false alarm.
    """
    if len(frame.inlier_fits) >= _SURE:
        return NO_REASON
    inside = [index for index, detection in enumerate(frame.detections) if detection.inside]
    # A mark searched only where the others predict it is no independent evidence.
    clear = [index for index in frame.clear_fits if not frame.detections[index].closer]
    if len(clear) < len(inside):
        return _doubt_by_neighbourhood(frame, inside, clear)
    if len(clear) <= _FREE or not result.is_exhaustive(frame.placement):
        return NO_REASON
    expected = false_frames(result, frame, clear)
    if expected <= FRAME_DOUBT_P:
        return NO_REASON
    return Reason(
        f"so many places of the scan match the {len(clear)} marks found that {expected:.2g} such false alarms are "
        "expected in it; the frame may lie elsewhere",
        Code.CHANCE,
    )


def _doubt_by_neighbourhood(frame: Frame, inside: Sequence[int], clear: Sequence[int]) -> Reason:
    """Test a frame of which some marks were not found, by the correlation beside the marks (binomial).

    Two marks fit any similarity: a frame in doubt needs more that no random place matches.
    """
    found = len(clear)
    matches, places = random_matches(frame, clear)
    hits = max(matches.values(), default=places)
    chance = float(bdtrc(found - _FREE - 1, len(inside) - _FREE, _share(hits, places)))
    if chance <= FRAME_DOUBT_P:
        return NO_REASON
    unmatched = sum(each == 0 for each in matches.values())
    return Reason(
        f"only {found} of {len(inside)} marks were found, and {hits} of {places} random places match "
        f"as well (p = {chance:.2f}): the frame may lie elsewhere",
        *((Code.CHANCE, Code.NO_FRAME) if chance > FRAME_REJECTED_P or unmatched < frame.least else (Code.CHANCE,)),
    )


def random_matches(frame: Frame, indices: Iterable[int]) -> tuple[dict[int, int], int]:
    """Count the random places beside the marks that match as well as each of some marks, by index, where it was fitted.

    Returns also the number of these places.
    """
    radius_px = frame.first_search_px
    inside = [index for index, detection in enumerate(frame.detections) if detection.inside]
    others = [_response(frame, *each, radius_px) for each in _neighbouring_places(frame, inside, radius_px)]
    fitted = (
        (index, _response(frame, index, fit.center_px, _FITTED_PX))
        for index in indices
        if (fit := frame.detections[index].fit)
    )
    return {index: sum(each >= own for each in others) for index, own in fitted}, len(others)


def _response(frame: Frame, index: int, place: Array, radius_px: float) -> float:
    """Highest correlation of a mark, by index, within a radius of a place in the scan."""
    return highest_peak(frame.scan, frame.prediction(index, radius_px).shift_to(place))[1]


def _neighbouring_places(frame: Frame, inside: Sequence[int], radius_px: float) -> list[tuple[int, Array]]:
    """Places around the marks, in eight directions, each with the index of the mark that is searched there."""
    angles = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    size = np.array([frame.scan.width_px, frame.scan.height_px])
    every = [
        (index, np.asarray(frame.predicted_px[index] + off * radius_px * direction))
        for off in _OFFSETS
        for direction in directions
        for index in inside
    ]
    within = [(index, place) for index, place in every if np.all(place >= 0) and np.all(place < size)]
    step = max(1, len(within) // _PLACES)
    return within[::step][:_PLACES]
