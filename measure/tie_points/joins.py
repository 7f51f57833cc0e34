"""What joins the scans of one frame that overlap: the same places of the film in two of them.

Both scans show the same photograph, so that one similarity puts all of the overlap from scan to scan but for what film
and scanner bend. It is found by features; then places with good texture, spread over the overlap, are matched at full
resolution. No relief is between them, and what moves unlike its neighbours is dust on the scanner's glass, or chance.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations, compress

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.flags import NO_REASON, POINT_REFUSED, Cause, Code, Reason, Status
from measure.results import Covariance, MarkMeasurement
from measure.scans.parallel import map_or_replace
from measure.tie_points.features import (
    Features,
    TieFrame,
    find_all_features,
    interleave_groups,
    read_pieces,
    shared_features,
)
from measure.tie_points.multi_image import RADIUS_PX, Matched, Piece, match_pieces
from measure.tie_points.verification import neighbour_outliers

Array = NDArray[np.float64]

WANTED = 60  # joins of two scans
_FEW = 12  # joins: fewer are a problem
_FEATURES = 6000  # of a scan: the overlap may be a tenth of it
_TRIED = 3  # places, for every join that is wanted
_AGREE_PX = 3.0  # in the reduced scan: what a feature's place, film and scanner leave
_FEWEST = 12  # features that one similarity explains: chance makes three or four of some hundreds
_TRIALS, _CONFIDENCE = 5000, 0.9999  # of RANSAC
_APART_PX = 2 * RADIUS_PX + 2  # of joins: patches that overlap have correlated errors
_SHARP_PX = 0.5  # rms length of an error: with less texture a join is weak
_INTERPOLATION_PX = 0.01  # that sharp pictures without noise are off by, between pixels; aerial ones at most
_CHUNK = 16  # places that a worker gets at a time
_UNEVEN = Reason("parts of the picture about the place move differently", Code.OTHER_SCANS)
_LOST = Reason("the process that matched it was ended", Code.UNREACHABLE)
_UNLIKE = Reason(
    "the places about it map elsewhere from scan to scan: dust on the glass, or a false match", Code.OTHER_SCANS
)
_UNJOINED = "It is not joined to the other scans of its frame"

_MatchedPair = tuple[Matched, ...]


@dataclass(frozen=True, eq=False)
class Joins:
    """The joins by image; and by image, of a scan that few or none join to the others, why."""

    marks: Mapping[str, tuple[MarkMeasurement, ...]]
    problems: Mapping[str, Reason]


def measure_joins(parts: Sequence[TieFrame], wanted: int = WANTED, workers: Executor | None = None) -> Joins:
    """The joins of one frame's scans, so many wanted of every two that overlap.

    Raises nothing for what the pictures show, nor for a scan that cannot be read: a problem says why it has none. The
    result does not depend on the number of workers.
    """
    found = list(find_all_features(parts, _FEATURES, True, _UNJOINED, workers))
    readable = [(part, each) for part, each in zip(parts, found, strict=True) if isinstance(each, Features)]
    marks: dict[str, list[MarkMeasurement]] = {part.image: [] for part, _ in readable}
    agreements: dict[str, list[str]] = {part.image: [] for part, _ in readable}
    problems, number = dict[str, Reason](), 0
    for (first, first_features), (second, second_features) in combinations(readable, 2):
        both = first, second
        second_from_first, agreement = _match_features(first_features, second_features)
        for part, other in (both, both[::-1]):
            agreements[part.image].append(f"with {other.image} {agreement}")
        if second_from_first is None:
            continue
        places = _places(second, first_features, second_features, second_from_first, wanted)
        pairs, refused = _measure_pair(both, places, wanted, workers)
        for pair in pairs:
            number += 1
            for part, matched in zip(both, pair, strict=True):
                marks[part.image].append(_mark(f"join{number:04d}", matched))
        if len(pairs) < _FEW:
            problems |= {part.image: _few(both, len(pairs), refused) for part in both}
    for image, own in marks.items():
        if not any(mark.status.is_observation for mark in own):
            problems[image] = _none(agreements[image])
    problems |= {part.image: each for part, each in zip(parts, found, strict=True) if isinstance(each, Reason)}
    return Joins({image: tuple(own) for image, own in marks.items()}, problems)


def _match_features(first: Features, second: Features) -> tuple[Array | None, str]:
    """(2, 3) affine map of pixels from the first scan to the second, through the features that one similarity explains;
    None where too few agree. And how many agree, a part of a sentence."""
    pairs = shared_features(first, second)
    here, there = first.places_px[pairs[:, 0]], second.places_px[pairs[:, 1]]
    agree = np.zeros(len(pairs), dtype=bool)
    if len(pairs) >= _FEWEST:
        within_px = _AGREE_PX * max(first.reduction, second.reduction)
        cv2.setRNGSeed(0)
        _, inside = cv2.estimateAffinePartial2D(
            here, there, method=cv2.RANSAC, ransacReprojThreshold=within_px, maxIters=_TRIALS, confidence=_CONFIDENCE
        )
        agree = agree if inside is None else inside.ravel() > 0
    agreement = f"{agree.sum()} of {len(pairs)} similar features agree on one similarity"
    if agree.sum() < _FEWEST:
        return None, agreement
    design = np.column_stack([here[agree], np.ones(agree.sum())])
    return np.asarray(np.linalg.lstsq(design, there[agree], rcond=None)[0].T), agreement


def _places(
    other: TieFrame, first: Features, second: Features, second_from_first: Array, wanted: int
) -> list[tuple[Array, Array]]:
    """Maps (2, 3) from patches to both scans: the best textured of every part of the overlap first, none touching
    another."""
    there = first.places_px @ second_from_first[:, :2].T + second_from_first[:, 2]
    common = np.flatnonzero(other.usable(there, second.size_px))
    if not len(common):
        return []
    here, there = first.places_px[common], there[common]
    cell_px = max(float(np.sqrt(np.prod(np.ptp(here, axis=0) + 1.0) / wanted)), float(_APART_PX))
    cell = np.floor((here - here.min(axis=0)) / cell_px).astype(np.intp) @ np.array([1, 10000])
    chosen = list[int]()
    for k in interleave_groups(cell, first.textures[common]).tolist():
        if np.all(np.hypot(*(here[chosen] - here[k]).T) >= _APART_PX):
            chosen.append(k)
        if len(chosen) == _TRIED * wanted:
            break
    linear = second_from_first[:, :2]
    return [(np.column_stack([np.eye(2), here[k]]), np.column_stack([linear, there[k]])) for k in chosen]


def _measure_pair(
    both: tuple[TieFrame, TieFrame], places: Sequence[tuple[Array, Array]], wanted: int, workers: Executor | None
) -> tuple[list[_MatchedPair], Counter[str]]:
    """Both places of every join, so many at most, and why other places are none."""
    try:
        read = (read_pieces(part, [(maps[k], RADIUS_PX) for maps in places]) for k, part in enumerate(both))
        pieces = list(zip(*read, strict=True))
    except MeasurementError as error:
        return [], Counter([str(error)])
    matched = list(map_or_replace(workers, _match, pieces, lambda *_: (), _CHUNK))
    reasons = [_refusal(pair) for pair in matched]
    good = [pair for pair, reason in zip(matched, reasons, strict=True) if not reason]
    if good:
        is_unlike = neighbour_outliers(*(np.array([pair[k].center_px for pair in good]) for k in (0, 1)))
        good = list(compress(good, ~is_unlike))
        reasons += [_UNLIKE] * int(is_unlike.sum())
    return good[:wanted], Counter(str(reason) for reason in reasons if reason)


def _match(pieces: tuple[Piece, Piece]) -> _MatchedPair:
    return match_pieces(pieces, 0)


def _refusal(pair: _MatchedPair) -> Reason:
    """Why its own pictures are no join; empty where they are."""
    if not pair:
        return _LOST
    uneven = _UNEVEN if pair[1].unevenness < POINT_REFUSED else NO_REASON
    return next((matched.reason for matched in pair if matched.reason), uneven)


def _mark(name: str, matched: Matched) -> MarkMeasurement:
    quality = {"correlation": matched.correlation, "gain": matched.gain, "size_px": 2.0 * RADIUS_PX + 1.0}
    error_px = float(np.sqrt(2.0 * np.trace(matched.covariance_px2)))
    status, reason = Status.MEASURED, NO_REASON
    if error_px > _SHARP_PX:
        status = Status.WEAK
        reason = Reason(f"the texture fixes it to {error_px:.2f} px only", Code.IMPRECISE)
    covariance = Covariance.from_noise(matched.covariance_px2)
    covariance = covariance.plus(Cause.INTERPOLATION, _INTERPOLATION_PX**2 * np.eye(2))
    return MarkMeasurement(name, "join", matched.center_px, covariance, status, reason, quality)


def _few(both: tuple[TieFrame, TieFrame], found: int, refused: Counter[str]) -> Reason:
    most = refused.most_common(1)
    why = f", most of the others because {most[0][0]}" if most else ""
    return Reason(
        f"Only {found} of {found + refused.total()} places join {both[0].image} and {both[1].image}{why}. Scans that "
        "overlap by more, of ground with texture, would have some tens; the standard deviations say what these are "
        "worth.",
        Code.FEW_TIES,
    )


def _none(agreements: Sequence[str]) -> Reason:
    """Of a scan that nothing joins to the others."""
    return Reason(
        f"Nothing joins it to the other scans of its frame: {'; '.join(agreements)}; at least {_FEWEST} are needed. "
        "Check whether it is a scan of that frame, and whether the scans overlap.",
        Code.FEW_TIES,
    )
