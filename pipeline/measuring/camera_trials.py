"""Identification of the camera of a scan: every camera with drawn marks is tried, at reduced size."""

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from adjust.functional_model.transformation import film_kind, fit_transformation
from measure.annotations.text import networks, read_writing
from measure.fiducials.camera_recognition import LayoutSearch, Tried, boldest, likeness, same_marks
from measure.fiducials.measure_frame import Frame
from measure.fiducials.measurement import coarseness
from measure.fiducials.options import FiducialOptions
from measure.fiducials.search import is_lattice
from measure.flags import MAX_FALSE_CAMERAS
from measure.geometry import linear_scale
from measure.marks.shapes import FiducialLayout, finest_detail_mm, is_made_of_areas, limit_to_frame
from measure.scans.opening import open_scan, thumbnail
from measure.scans.parallel import one_opencv_thread
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.camera_identification import (
    CLOSE,
    Identification,
    Trial,
    contradictions,
    drawn_alike,
    is_whole_plate,
    parse_plate,
)
from pipeline.terminal import Count, Reporter
from pipeline.types import Array

_LEAST_DETAIL_PX = 0.25  # width of the finest detail of marks below which nothing in a picture is one of them
_STRETCHES = (-0.025, 0.025)  # affinity of the pixels; each covers 1.1 to 3.9 % for an aerial camera
_SAME_FIGURE = 0.06  # fraction of the rms distance of the marks from their centroid
Names = tuple[str, ...]

_PICTURE_PX = 2400  # px, size of the measured image: for aerial film 0.1 mm per pixel, enough to read plates
_FEW = 3  # best results of the search without a pitch, to be refined at the pitch that each found
_BY_CHANCE = 1.0  # expected false alarms: the constellation may be one
_MOST_FOUND = 0.5  # fraction of a lattice's marks: with more of them found, other layouts need not be tried
_HOPELESS = 100.0  # expected false alarms: above it, the marks are not measured
_ODDS = 1000.0  # ratio of the expected false alarms of two layouts: the rarer one is present, the other is not
_AFFINE = 6  # parameters of an affine transformation


@one_opencv_thread()  # a second one takes 45 MiB
def identify(
    path: Path,
    cameras: Mapping[str, CameraFile],
    pitch_um: float | None,
    reporter: Reporter,
    max_pixels: int | None = None,
    likely: Collection[str] = (),
) -> Identification:
    """Try every camera with drawn marks on the scan; cameras with the same marks are tried once.

    Parameters
    ----------
    likely : names of cameras found in similar scans. If one of them stands out significantly, only cameras with marks
        at the same places are tried in addition to it.

    Raises
    ------
    MeasurementError : the scan cannot be read.
    """
    with open_scan(path, max_pixels) as whole:
        picture = thumbnail(whole, _PICTURE_PX)
        size_px, its_pitch_um = (whole.width_px, whole.height_px), whole.pitch_um
    del whole  # frees the decoded picture
    given, search = its_pitch_um if pitch_um is None else (pitch_um, pitch_um), LayoutSearch(picture)
    layouts = {names: _limit_drawings(cameras[names[0]].layout()) for names in _alike(cameras)}
    times = size_px[0] / picture.width_px
    pitch = None if given is None else (times * given[0], times * given[1])
    with reporter.stage("trying layout") as count:
        trials, tries, is_negative = list[Trial](), dict[Names, Tried](), False
        for attempt in _attempts(search, layouts, _layouts_like(layouts, likely), pitch, count):
            tried = _trials(search, attempt.tries, attempt.most, count)
            ends = attempt.is_last(tried)
            if ends or not attempt.is_negative:
                trials, tries, is_negative = tried, attempt.tries, attempt.is_negative
            if ends:
                break
    alike = _alike_in_scan(search, trials, tries, drawn_alike(layouts))
    del search, tries  # frees the correlation images
    sources = {name: camera.source for name, camera in cameras.items()}
    unreported = {name: source.text for name, source in sources.items() if source and not source.reports}
    reports = {name: source.reports for name, source in sources.items() if source}
    trials = [replace(trial, pixel_um=trial.pixel_um and trial.pixel_um / times) for trial in trials]
    ranked = tuple(sorted(trials, key=lambda trial: (-trial.score, trial.expected)))
    reader = networks() if any(trial.stands_out for trial in trials) else None
    plate = {} if reader is None else parse_plate(read_writing(picture, reader, enough=is_whole_plate))
    against_plate = {name: contradictions(camera, plate) for name, camera in cameras.items()}
    contradicted = {name: against for name, against in against_plate.items() if against}
    solid = {name for names, layout in layouts.items() if all(map(is_made_of_areas, layout.marks)) for name in names}
    coarse = tuple(coarseness(layout, size_px, given) for layout in layouts.values())
    return Identification(
        path,
        ranked,
        unreported,
        given,
        plate,
        contradicted,
        alike,
        reports,
        is_negative=is_negative,
        solid=solid,
        layouts_coarseness=coarse,
    )


def _layouts_like(layouts: Mapping[Names, FiducialLayout], likely: Collection[str]) -> dict[Names, FiducialLayout]:
    """Layouts whose boldest marks form the same figure, up to scale, as a layout with a likely name."""

    def is_same(figure: Array, other: Array) -> bool:
        return len(figure) == len(other) and bool(cdist(figure, other).min(axis=1).max() < _SAME_FIGURE)

    figures = {names: _figure(layout) for names, layout in layouts.items()}
    known = [figure for names, figure in figures.items() if not {*likely}.isdisjoint(names)]
    return {names: layout for names, layout in layouts.items() if any(is_same(figures[names], each) for each in known)}


def _figure(layout: FiducialLayout) -> Array:
    """(n, 2) places of the boldest marks, centred and scaled to an rms distance of 1."""
    places = np.array([mark.xy_mm for mark in boldest(layout).marks])
    places = places - places.mean(axis=0)
    return np.asarray(places / np.sqrt((places**2).sum(axis=1).mean()))


def _limit_drawings(layout: FiducialLayout) -> FiducialLayout:
    """Limit the drawings of marks within the frame (wings) to the frame."""
    # Of marks beyond its edge little more than a corner would remain, which correlates with many structures.
    half_mm = np.array(layout.frame_mm) / 2
    pairs = zip(layout.marks, limit_to_frame(layout).marks, strict=True)
    marks = tuple(limited if (np.abs(given.xy_mm) < half_mm).all() else given for given, limited in pairs)
    return replace(layout, marks=marks)


def _alike_in_scan(
    search: LayoutSearch, trials: Sequence[Trial], tries: Mapping[Names, Tried], drawn: Mapping[str, Names]
) -> dict[str, Names]:
    """For each camera that stands out: cameras with similar drawings that score nearly as well at its placement."""
    # Wings that differ little in the drawing may differ clearly in the scan.
    own = {name: names for names in tries for name in names}
    found = dict[str, Names]()
    for trial in trials:
        alike = drawn.get(trial.cameras[0], ()) if trial.stands_out else ()
        others = dict.fromkeys(own[name] for name in alike if name in own)
        if not others:
            continue
        best = tries[trial.cameras]
        frames = {names: search.recognise(replace(best, layout=tries[names].layout)) for names in others}
        near = [names for names, frame in frames.items() if frame and likeness(frame) >= CLOSE * trial.score]
        found |= dict.fromkeys(trial.cameras, tuple(names[0] for names in near)) if near else {}
    return found


@dataclass(frozen=True)
class _Attempt:
    """Tries of some layouts; the largest expected number of false alarms and the least fraction of marks found for
    which one of them ends the search."""

    tries: dict[Names, Tried]
    most: float = np.inf
    least_found: float = 0.0
    is_negative: bool = False

    def is_last(self, trials: Iterable[Trial]) -> bool:
        standing = [trial for trial in trials if trial.stands_out and trial.expected <= self.most]
        return any(trial.found >= self.least_found * trial.drawn for trial in standing)


def _attempts(
    search: LayoutSearch,
    layouts: Mapping[Names, FiducialLayout],
    likely: Mapping[Names, FiducialLayout],
    pitch_um: tuple[float, float] | None,
    count: Count,
) -> Iterator[_Attempt]:
    """Yield tries of likely layouts, then of all at the given pitch, with non-square pixels, at any pitch and as a
    negative shows them. At any pitch lattices come first: no other layout is in a scan that shows most of one."""
    lattices = {names: layout for names, layout in layouts.items() if is_lattice(layout)}
    negatives = {names: layout.negative for names, layout in layouts.items()}
    if pitch_um is None:
        if likely:
            yield _Attempt(_any_pitch_tries(search, likely, count), MAX_FALSE_CAMERAS)
        yield from _lattice_attempts(_any_pitch_tries(search, lattices, count))
        yield _Attempt(_any_pitch_tries(search, layouts, count))
        yield _Attempt(_any_pitch_tries(search, negatives, count), MAX_FALSE_CAMERAS, is_negative=True)
        return
    at_given = partial(search.try_pitch, pitch_um=pitch_um)
    for some, most in ((likely, MAX_FALSE_CAMERAS), (layouts, np.inf)):
        given = _each(some, at_given, count)
        if any(each.answer.expected <= MAX_FALSE_CAMERAS for each in given.values()):
            yield _Attempt(given, most)
    yield from _lattice_attempts(_any_pitch_tries(search, lattices, count))
    stretched = _each(layouts, partial(at_given, stretches=_STRETCHES), count)
    pairs = {names: (each, stretched[names]) for names, each in given.items()}
    yield _Attempt({names: min(pair, key=lambda each: each.answer.expected) for names, pair in pairs.items()})
    yield _Attempt(_any_pitch_tries(search, layouts, count))
    yield _Attempt(_each(negatives, at_given, count), MAX_FALSE_CAMERAS, is_negative=True)


def _lattice_attempts(tries: dict[Names, Tried]) -> Iterator[_Attempt]:
    """Yield tries of lattices at any pitch if one of them is significant."""
    if any(each.answer.expected <= MAX_FALSE_CAMERAS for each in tries.values()):
        yield _Attempt(tries, MAX_FALSE_CAMERAS, least_found=_MOST_FOUND)


def _each(
    layouts: Mapping[Names, FiducialLayout], tried: Callable[[FiducialLayout], Tried], count: Count
) -> dict[Names, Tried]:
    tries = dict[Names, Tried]()
    for done, (names, layout) in enumerate(layouts.items(), 1):
        count(", ".join(names), done, len(layouts))
        tries[names] = tried(layout)
    return tries


def _any_pitch_tries(search: LayoutSearch, layouts: Mapping[Names, FiducialLayout], count: Count) -> dict[Names, Tried]:
    """Tries without a pitch: each layout determines its own, and the best ones are refined at it."""
    tries = _each(layouts, search.try_any_pitch, count)
    least = sorted({each.answer.expected for each in tries.values()})[:_FEW]
    best = {names: search.refine(each) for names, each in tries.items() if each.answer.expected in least}
    return tries | best


def _trials(search: LayoutSearch, tries: Mapping[Names, Tried], most: float, count: Count) -> list[Trial]:
    """Try the layouts in order of their expected false alarms. most: as of `_Attempt`, which no other one ends."""
    # Once a layout stands out, others are measured only if they are significant and may hold more marks.
    trials: list[Trial] = []
    # By two digits of these; among equals (layouts with the same corners) the fewest marks first.
    keys = {names: (float(f"{each.answer.expected:.2g}"), len(each.layout.marks)) for names, each in tries.items()}
    ranked = sorted(tries, key=keys.__getitem__)
    for done, names in enumerate(ranked, 1):
        each, standing = tries[names], [trial for trial in trials if trial.stands_out]
        drawn, expected = len(each.layout.marks), each.answer.expected
        limit = min(most, _HOPELESS)
        for trial in standing:
            least = MAX_FALSE_CAMERAS if trial.expected <= MAX_FALSE_CAMERAS else _BY_CHANCE
            # Fewer marks may be a part of those found: nine crosses of a larger réseau match a layout of nine.
            limit = min(limit, least, _ODDS * trial.expected if trial.found > drawn else least)
        if expected > limit:
            why = "no constellation of its marks correlates anywhere in the scan"
            if np.isfinite(expected):
                why = f"{expected:.1g} false alarms expected in such a scan"
            none = Trial(names, 0, drawn, 0.0, 0.0, 0.0, None, None, None, f"not measured: {why}", 0.0, expected)
            trials.append(none)
        else:
            count(", ".join(names), done, len(ranked))
            trials.append(_trial(search, names, each, CLOSE * max((trial.score for trial in standing), default=0.0)))
    return trials


def _alike(cameras: Mapping[str, CameraFile]) -> list[Names]:
    """Names of the cameras with drawn marks, grouped by marks that cannot be distinguished in a scan."""
    groups: list[list[str]] = []
    for name, camera in cameras.items():
        own = next((group for group in groups if same_marks(cameras[group[0]].layout_marks, camera.layout_marks)), None)
        if own is not None:
            own.append(name)
        elif camera.layout_marks:
            groups.append([name])
    return [tuple(group) for group in groups]


def _trial(search: LayoutSearch, names: Names, each: Tried, close: float) -> Trial:
    """Measure the marks of one layout. close: score below which the stretched layout need not be compared."""
    start, expected = time.perf_counter(), each.answer.expected
    frame, reason = search.recognise(each), "fewer than three of its marks at the best constellation"
    finest_mm = min(finest_detail_mm(mark.mark) for mark in each.layout.marks)
    if frame and (width_px := linear_scale(frame.pixel_from_camera) * finest_mm) < _LEAST_DETAIL_PX:
        frame, reason = None, f"too coarse: the finest detail of its marks would be {width_px:.2f} px wide there"
    fits = list(frame.inlier_fits.values()) if frame else []
    residual = _residual(frame, each.layout) if frame else None
    score, score_elsewhere = likeness(frame) if frame else 0.0, None
    if score > close and expected > MAX_FALSE_CAMERAS:
        score_elsewhere, wrong = 0.0, search.stretch(each)
        # Where the stretched layout correlates much less, the marks themselves must be present.
        if wrong.answer.expected <= _ODDS * expected and (elsewhere := search.recognise(wrong)):
            score_elsewhere = likeness(elsewhere)
    return Trial(
        cameras=names,
        found=len(fits),
        drawn=len(each.layout.marks),
        likeness=float(np.mean([fit.likeness for fit in fits])) if fits else 0.0,
        snr=float(np.median([fit.snr for fit in fits])) if fits else 0.0,
        score=score,
        score_elsewhere=score_elsewhere,
        residual_sigmas=None if residual is None else residual[0],
        residual_mm=None if residual is None else residual[1],
        reason="" if frame else reason,
        seconds=time.perf_counter() - start,
        expected=expected,
        pixel_um=1000 / linear_scale(frame.pixel_from_camera) if frame else None,
    )


def _residual(frame: Frame, layout: FiducialLayout) -> tuple[float, float] | None:
    """Residuals per axis of an affine transformation, in standard deviations and mm; None without redundancy."""
    pairs = [(fit, layout.marks[index]) for index, fit in frame.inlier_fits.items()]
    redundancy = 2 * len(pairs) - _AFFINE
    if redundancy <= 0:
        return None
    px_per_mm = linear_scale(frame.pixel_from_camera)
    given_mm = np.array([given.xy_mm for _, given in pairs])
    comparator_mm = np.array([fit.center_px for fit, _ in pairs]) * (1.0, -1.0) / px_per_mm
    parameters, mirrored = fit_transformation("affine", comparator_mm, given_mm)
    residuals_mm = film_kind("affine", mirrored).apply(parameters, comparator_mm) - given_mm
    # The marks' covariances are small and nearly isotropic, so their rotation is neglected.
    own_mm2 = np.array([[np.trace(fit.covariance_px2) / 2 / px_per_mm**2] for fit, _ in pairs])
    given_sigma_mm = np.array([given.sigma_mm for _, given in pairs])
    variance_mm2 = given_sigma_mm**2 + own_mm2 + FiducialOptions().film_sigma_mm ** 2
    return (
        float(np.sqrt((residuals_mm**2 / variance_mm2).sum() / redundancy)),
        float(np.sqrt((residuals_mm**2).sum() / redundancy)),
    )
