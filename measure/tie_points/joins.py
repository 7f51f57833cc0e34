"""What joins the scans of one frame that overlap: the same places of the film in two of them.

Both scans show the same photograph, so that one similarity puts all of the overlap from scan to scan but for what film
and scanner bend. It is found by features; then places with good texture, spread over the overlap, are matched at full
resolution. No relief is between them, and what moves unlike its neighbours is dust on the scanner's glass, or chance.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
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
    find_frame_features,
    interleave_groups,
    read_pieces,
    shared_features,
)
from measure.tie_points.multi_image import RADIUS_PX, Matched, Piece, match_pieces
from measure.tie_points.verification import neighbour_outliers

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WANTED = 60  # joins of two scans
_FEW = 12  # joins: fewer are a problem
_FEATURES = 6000  # of a scan: the overlap may be a tenth of it
_TRIED = 3  # places, for every join that is wanted
_AGREE_PX = 3.0  # in the reduced scan: what a feature's place, film and scanner leave
_FEWEST = 12  # features that one similarity explains: chance makes three or four of some hundreds
_TRIALS, _CONFIDENCE = 5000, 0.9999  # of RANSAC
_APART_PX = 2 * RADIUS_PX + 2  # of joins: patches that overlap have correlated errors
_SHARP_PX = 0.5  # rms length of an error: with less texture a join is weak
_INTERPOLATION_PX = (
    0.01  # that sharp pictures without noise are off by, between pixels; in aerial photographs 0.01 at most
)
_CHUNK = 16  # places that a worker gets at a time
_UNEVEN = Reason("parts of the picture about the place move unlike each other", Code.OTHER_SCANS)
_LOST = Reason("the process that matched it was ended", Code.UNREACHABLE)
_UNLIKE = Reason("the places about it map elsewhere from scan to scan: dust on the glass, or chance", Code.OTHER_SCANS)

_Pair = tuple[Piece, Piece]
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
    found_or_not = list(map_or_replace(workers, _features, parts, lambda _, why: _out_of_reach(why)))
    unreadable = {part.image: each for part, each in zip(parts, found_or_not, strict=True) if isinstance(each, Reason)}
    readable = [(part, each) for part, each in zip(parts, found_or_not, strict=True) if isinstance(each, Features)]
    parts, features = [part for part, _ in readable], [each for _, each in readable]
    marks: dict[str, list[MarkMeasurement]] = {part.image: [] for part in parts}
    shared: dict[tuple[int, int], _SharedFeatures] = {}
    number, problems = 0, dict[str, Reason]()
    for i, j in combinations(range(len(parts)), 2):
        shared[i, j] = _match_features(features[i], features[j])
        second_from_first = shared[i, j].second_from_first
        if second_from_first is None:
            continue
        both = features[i], features[j]
        found, refused = _measure_pair((parts[i], parts[j]), both, second_from_first, wanted, workers)
        for pair in found:
            number += 1
            for part, matched in zip((parts[i], parts[j]), pair, strict=True):
                marks[part.image].append(_mark(f"join{number:04d}", matched))
        if len(found) < _FEW:
            problems |= {part.image: _few(parts[i], parts[j], len(found), refused) for part in (parts[i], parts[j])}
    unjoined = dict(_unjoined(parts, shared, marks))
    return Joins({image: tuple(own) for image, own in marks.items()}, problems | unjoined | unreadable)


def _features(part: TieFrame) -> Features | Reason:
    try:
        return find_frame_features(part, False, _FEATURES)
    except MeasurementError as error:
        return _out_of_reach(str(error))


def _out_of_reach(why: str) -> Reason:
    return Reason(f"It is not joined to the other scans of its frame: {why}", Code.UNREACHABLE)


@dataclass(frozen=True, eq=False)
class _SharedFeatures:
    """alike: how many features two scans share; agree: how many of them one similarity explains. second_from_first:
    (2, 3) affine map of pixels through these; None where too few agree."""

    alike: int
    agree: int
    second_from_first: Array | None


def _match_features(first: Features, second: Features) -> _SharedFeatures:
    pairs = shared_features(first, second)
    if len(pairs) < _FEWEST:
        return _SharedFeatures(len(pairs), 0, None)
    here, there = first.places_px[pairs[:, 0]], second.places_px[pairs[:, 1]]
    within_px = _AGREE_PX * max(first.reduction, second.reduction)
    cv2.setRNGSeed(0)
    _, inside = cv2.estimateAffinePartial2D(
        here, there, method=cv2.RANSAC, ransacReprojThreshold=within_px, maxIters=_TRIALS, confidence=_CONFIDENCE
    )
    agree = np.zeros(len(pairs), dtype=bool) if inside is None else inside.ravel() > 0
    if agree.sum() < _FEWEST:
        return _SharedFeatures(len(pairs), int(agree.sum()), None)
    return _SharedFeatures(len(pairs), int(agree.sum()), _affine(here[agree], there[agree]))


def _affine(here: Array, there: Array) -> Array:
    """(2, 3) of places (n, 2) to places, by least squares."""
    design = np.column_stack([here, np.ones(len(here))])
    return np.asarray(np.linalg.lstsq(design, there, rcond=None)[0].T)


def _measure_pair(
    both: tuple[TieFrame, TieFrame],
    features: tuple[Features, Features],
    second_from_first: Array,
    wanted: int,
    workers: Executor | None,
) -> tuple[list[_MatchedPair], Counter[str]]:
    """Both places of every join, so many at most, and why other places are none."""
    places = _places(both[1], features, second_from_first, wanted)
    try:
        pieces = list(zip(*(read_pieces(part, own) for part, own in zip(both, places, strict=True)), strict=True))
    except MeasurementError as error:
        return [], Counter([str(error)])
    matched = list(map_or_replace(workers, _match, pieces, lambda *_: (), _CHUNK))
    refused = Counter(str(_refused(pair)) for pair in matched if _refused(pair))
    good = [pair for pair in matched if not _refused(pair)]
    if good:
        unlike = neighbour_outliers(*(np.array([pair[of].center_px for pair in good]) for of in (0, 1)))
        refused[_UNLIKE] += int(unlike.sum())
        good = list(compress(good, ~unlike))
    return good[:wanted], refused


def _places(
    other: TieFrame, features: tuple[Features, Features], second_from_first: Array, wanted: int
) -> tuple[list[tuple[Array, int]], ...]:
    """Maps (2, 3) from patches to both scans, and radii: the best textured of every part of the overlap first, none
    touching another."""
    first, second = features
    there = first.places_px @ second_from_first[:, :2].T + second_from_first[:, 2]
    common = np.flatnonzero(other.usable(there, second.size_px))
    if not len(common):
        return [], []
    here = first.places_px[common]
    cell_px = max(float(np.sqrt(np.prod(np.ptp(here, axis=0) + 1.0) / wanted)), float(_APART_PX))
    cell = np.floor((here - here.min(axis=0)) / cell_px).astype(np.intp) @ np.array([1, 10000])
    chosen = list[int]()
    for k in interleave_groups(cell, first.textures[common]).tolist():
        if all(np.hypot(*(here[k] - here[other_k])) >= _APART_PX for other_k in chosen):
            chosen.append(k)
        if len(chosen) == _TRIED * wanted:
            break
    linear = second_from_first[:, :2]
    return (
        [(np.column_stack([np.eye(2), here[k]]), RADIUS_PX) for k in chosen],
        [(np.column_stack([linear, there[common[k]]]), RADIUS_PX) for k in chosen],
    )


def _match(pieces: _Pair) -> _MatchedPair:
    return match_pieces(pieces, 0)


def _refused(pair: _MatchedPair) -> Reason:
    """Why its own pictures are no join; empty where they are."""
    if not pair:
        return _LOST
    for matched in pair:
        if matched.reason:
            return matched.reason
    return _UNEVEN if pair[1].unevenness < POINT_REFUSED else NO_REASON


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


def _few(one: TieFrame, other: TieFrame, found: int, refused: Counter[str]) -> Reason:
    most = refused.most_common(1)
    why = f", most of the others because {most[0][0]}" if most else ""
    return Reason(
        f"Only {found} of {found + refused.total()} places join {one.image} and {other.image}{why}. Scans that overlap "
        "by more, of ground with texture, would have some tens; the standard deviations say what these are worth.",
        Code.FEW_TIES,
    )


def _unjoined(
    parts: Sequence[TieFrame],
    shared: Mapping[tuple[int, int], _SharedFeatures],
    marks: Mapping[str, Sequence[MarkMeasurement]],
) -> Iterator[tuple[str, Reason]]:
    """Every scan that nothing joins to the others, and why."""
    for number, part in enumerate(parts):
        if any(mark.status.is_observation for mark in marks[part.image]):
            continue
        pairs_message = "; ".join(
            f"with {parts[i].image if j == number else parts[j].image} {each.agree} of {each.alike} similar features "
            "agree on one similarity"
            for (i, j), each in shared.items()
            if number in (i, j)
        )
        yield (
            part.image,
            Reason(
                f"Nothing joins it to the other scans of its frame: {pairs_message}; at least {_FEWEST} are needed. "
                "Check whether it is a scan of that frame, and whether the scans overlap.",
                Code.FEW_TIES,
            ),
        )
