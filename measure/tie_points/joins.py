"""Joins between overlapping scans of one frame: the same places of the film measured in two scans.

Both scans show the same photograph: one similarity maps the overlap, up to film and scanner deformation. It is found by
features; places with good texture, spread over the overlap, are then matched at full resolution. There is no parallax:
what moves unlike its neighbours is dust on the scanner's glass or a false match.
"""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import combinations, compress

import cv2
import numpy as np

from measure.array_types import Array
from measure.errors import MeasurementError
from measure.flags import NO_REASON, POINT_REFUSED, Cause, Code, Reason, Status
from measure.results import Covariance, MarkMeasurement
from measure.scans.parallel import map_or_replace
from measure.tie_points.find_points import Ties
from measure.tie_points.multi_image import RADIUS_PX, Matched, match_pieces
from measure.tie_points.tracks import (
    Features,
    TieFrame,
    find_all_features,
    interleave_groups,
    neighbour_outliers,
    read_pieces,
    shared_features,
)

WANTED = 60  # joins per pair of scans
_FEW = 12  # fewer joins are reported as a problem
_FEATURES = 6000  # per scan: the overlap may be a tenth of it
_TRIED = 3  # places tried per join wanted
_AGREE_PX = 3.0  # tolerance in the reduced scan, for localisation, film and scanner
_FEWEST = 12  # inliers of the similarity: three or four of some hundreds occur by chance
_TRIALS, _CONFIDENCE = 5000, 0.9999  # of RANSAC
_APART_PX = 2 * RADIUS_PX + 2  # between joins: overlapping patches have correlated errors
_SHARP_PX = 0.5  # rms position error above which a join is weak
_INTERPOLATION_PX = 0.01  # interpolation error of sharp images without noise; aerial images have at most this
_CHUNK = 16  # places per task of a worker
_UNEVEN = Reason("parts of the picture about the place move differently", Code.OTHER_SCANS)
_LOST = Reason("the process that matched it was ended", Code.UNREACHABLE)
_UNLIKE = Reason(
    "the places about it map elsewhere from scan to scan: dust on the glass, or a false match", Code.OTHER_SCANS
)
_UNJOINED = "It is not joined to the other scans of its frame"

_MatchedPair = tuple[Matched, ...]


def measure_joins(parts: Sequence[TieFrame], wanted: int = WANTED, workers: Executor | None = None) -> Ties:
    """Measure the joins of one frame's scans.

    An unreadable scan has no joins and a problem that says why; image content never raises an error. The result does
    not depend on the number of workers.

    Parameters
    ----------
    wanted : joins per pair of overlapping scans.
    """
    found = list(find_all_features(parts, _FEATURES, True, _UNJOINED, workers))
    readable = [(part, each) for part, each in zip(parts, found, strict=True) if isinstance(each, Features)]
    marks: dict[str, list[MarkMeasurement]] = {part.image: [] for part, _ in readable}
    agreements: dict[str, list[str]] = {part.image: [] for part, _ in readable}
    problems, number = dict[str, tuple[Reason, ...]](), 0
    for (first, first_features), (second, second_features) in combinations(readable, 2):
        both = first, second
        second_from_first, agreement = _match_features(first_features, second_features)
        for part, other in (both, both[::-1]):
            agreements[part.image].append(f"with {other.image} {agreement}")
        if second_from_first is None:
            continue
        places = _patch_maps(second, first_features, second_features, second_from_first, wanted)
        pairs, refused = _measure_pair(both, places, wanted, workers)
        for pair in pairs:
            number += 1
            for part, matched in zip(both, pair, strict=True):
                marks[part.image].append(_mark(f"join{number:04d}", matched))
        if len(pairs) < _FEW:
            problems |= {part.image: (_few_joins_problem(both, len(pairs), refused),) for part in both}
    for image, own in marks.items():
        if not any(mark.status.is_observation for mark in own):
            unjoined = Reason(
                f"Nothing joins it to the other scans of its frame: {'; '.join(agreements[image])}; at least {_FEWEST} "
                "are needed. Check whether it is a scan of that frame, and whether the scans overlap.",
                Code.FEW_TIES,
            )
            problems[image] = (unjoined,)
    problems |= {part.image: (each,) for part, each in zip(parts, found, strict=True) if isinstance(each, Reason)}
    return Ties({image: tuple(own) for image, own in marks.items()}, problems)


def _match_features(first: Features, second: Features) -> tuple[Array | None, str]:
    """(2, 3) affine map of pixels from the first scan to the second, fitted to the inliers of one similarity, or None;
    and the number of inliers as a part of a sentence."""
    pairs = shared_features((first, second))
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


def _patch_maps(
    other: TieFrame, first: Features, second: Features, second_from_first: Array, wanted: int
) -> list[tuple[Array, Array]]:
    """Maps (2, 3) from patches to both scans, the best textured of each part of the overlap first, without overlap."""
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
    """Matched pairs, at most as many as wanted, and the counted reasons of the refused ones."""
    try:
        read = (read_pieces(part, [(maps[k], RADIUS_PX) for maps in places]) for k, part in enumerate(both))
        pieces = list(zip(*read, strict=True))
    except MeasurementError as error:
        return [], Counter([str(error)])
    matched = list(map_or_replace(workers, partial(match_pieces, reference=0), pieces, lambda *_: (), _CHUNK))
    reasons = [_refusal(pair) for pair in matched]
    good = [pair for pair, reason in zip(matched, reasons, strict=True) if not reason]
    if good:
        is_unlike = neighbour_outliers(*(np.array([pair[k].center_px for pair in good]) for k in (0, 1)))
        good = list(compress(good, ~is_unlike))
        reasons += [_UNLIKE] * int(is_unlike.sum())
    return good[:wanted], Counter(str(reason) for reason in reasons if reason)


def _refusal(pair: _MatchedPair) -> Reason:
    """Reason why a matched pair is not a join; empty where it is."""
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


def _few_joins_problem(both: tuple[TieFrame, TieFrame], found: int, refused: Counter[str]) -> Reason:
    most = refused.most_common(1)
    why = f", most of the others because {most[0][0]}" if most else ""
    return Reason(
        f"Only {found} of {found + refused.total()} places join {both[0].image} and {both[1].image}{why}. Scans that "
        "overlap by more, of ground with texture, would have some tens; their standard deviations show how much "
        "these determine.",
        Code.FEW_TIES,
    )
