"""Which camera a scan is of: every camera of the library whose marks are drawn is tried on it."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.transformation import film_kind
from adjust.initial_values.fiducial_fit import fit_transformation
from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.film import SCATTER_MM
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.results import FrameMeasurement
from measure.scans.scan import Scan, open_scan
from measure.search.frame_search import expected_alike
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.camera_answer import Identification, Trial
from pipeline.progress import Count, Reporter

Array = NDArray[np.float64]

_ALIKE_MM = 0.1  # two cameras whose marks lie so near to one another look alike in a scan
_STRETCH = (1.08, 0.93)  # of the layout that only chance can find: no film is so deformed
_CERTAIN = 0.01  # constellations expected by chance: no mark need be matched in wrong places to know better
_BY_CHANCE = 1.0  # constellation expected: chance may have made it
_ODDS = 1000.0  # times what chance makes of another camera's marks: that one is seen, and not this
_AFFINE = 6  # parameters


def identify(
    path: Path,
    cameras: Mapping[str, CameraFile],
    pitch_um: float | None,
    reporter: Reporter,
    max_pixels: int | None = None,
) -> Identification:
    """Try every camera with drawn marks on the scan, those with the same marks once.

    Raises MeasurementError for a scan that cannot be read.
    """
    with open_scan(path, max_pixels) as scan, reporter.stage("trying") as count:
        pitch = scan.pitch_um if pitch_um is None else (pitch_um, pitch_um)
        trials = _trials(scan, cameras, pitch, FiducialOptions(pitch_is_right=True), count)
        if pitch is not None and not any(trial.stands_out for trial in trials):
            trials = _trials(scan, cameras, pitch, FiducialOptions(), count)
    sources = {name: camera.source for name, camera in cameras.items()}
    unreported = {name: source.text for name, source in sources.items() if source and not source.reports}
    ranked = tuple(sorted(trials, key=lambda trial: (-trial.score, trial.expected)))
    return Identification(path, ranked, unreported, pitch)


def _trials(
    scan: Scan,
    cameras: Mapping[str, CameraFile],
    pitch_um: tuple[float, float] | None,
    options: FiducialOptions,
    count: Count,
) -> list[Trial]:
    """Of every layout, those first that answer better than chance. Once one of these stands out, another is measured
    only where it answers better than chance too, and may be more than a part of what was found."""
    expected: dict[tuple[str, ...], float] = {}
    groups = _alike(cameras)
    for done, names in enumerate(groups):
        count(f"the marks of {', '.join(names)}", done, 2 * len(groups))
        expected[names] = expected_alike(scan, cameras[names[0]].layout(), pitch_um, options)
    trials: list[Trial] = []
    for done, names in enumerate(sorted(groups, key=lambda names: expected[names]), len(groups)):
        layout = cameras[names[0]].layout()
        limits = [_expected_at_most(trial, len(layout.marks)) for trial in trials if trial.stands_out]
        if limits and expected[names] > min(limits):
            trials.append(_not_measured(names, len(layout.marks), expected[names]))
        else:
            count(", ".join(names), done, 2 * len(groups))
            trials.append(_trial(scan, names, layout, pitch_um, options, expected[names]))
    return trials


def _expected_at_most(seen: Trial, marks: int) -> float:
    """How many constellations chance may make of a layout of so many marks for it to be measured after a trial that
    stands out. Where that has more marks, nine crosses of a lattice, say, answer to a lattice of nine; but chance makes
    nine so much more easily than twenty-five."""
    return min(_BY_CHANCE, _ODDS * seen.expected) if seen.found > marks else _BY_CHANCE


def _not_measured(names: tuple[str, ...], drawn: int, expected: float) -> Trial:
    if np.isfinite(expected):
        reason = f"not measured: chance makes {expected:.1g} constellations in such a scan that answer as well"
    else:
        reason = "not measured: nowhere in the scan do its marks answer together"
    return Trial(names, 0, drawn, 0.0, 0.0, 0.0, None, None, None, reason, 0.0, expected)


def _alike(cameras: Mapping[str, CameraFile]) -> list[tuple[str, ...]]:
    """The names of cameras with drawn marks, those together whose marks a scan cannot tell apart."""
    groups: list[list[str]] = []
    for name, camera in cameras.items():
        own = next((group for group in groups if _same(cameras[group[0]].drawn, camera.drawn)), None)
        if own is not None:
            own.append(name)
        elif camera.drawn:
            groups.append([name])
    return [tuple(group) for group in groups]


def _same(first: Sequence[LayoutMark], second: Sequence[LayoutMark]) -> bool:
    return len(first) == len(second) and all(
        _kind(a) == _kind(b) and np.hypot(a.xy_mm[0] - b.xy_mm[0], a.xy_mm[1] - b.xy_mm[1]) < _ALIKE_MM
        for a, b in zip(first, second, strict=True)
    )


def _kind(mark: LayoutMark) -> str:
    return repr(mark.mark)


def _trial(
    scan: Scan,
    names: tuple[str, ...],
    layout: FiducialLayout,
    pitch_um: tuple[float, float] | None,
    options: FiducialOptions,
    expected: float,
) -> Trial:
    start = time.perf_counter()
    frame = measure_fiducials(scan, layout, pitch_um, options)
    seen = [mark for mark in frame.marks if mark.status.is_observation]
    score = _score(frame)
    doubtful = score > 0.0 and expected > _CERTAIN
    chance = _score(measure_fiducials(scan, _stretched(layout), pitch_um, options)) if doubtful else None
    residual = _residual(frame, layout)
    return Trial(
        cameras=names,
        found=len(seen),
        drawn=len(layout.marks),
        likeness=float(np.mean([mark.quality["likeness"] for mark in seen])) if seen else 0.0,
        snr=float(np.median([mark.quality["snr"] for mark in seen])) if seen else 0.0,
        score=score,
        chance=chance,
        residual_sigmas=None if residual is None else residual[0],
        residual_mm=None if residual is None else residual[1],
        reason="" if seen else frame.marks[0].reason,
        seconds=time.perf_counter() - start,
        expected=expected,
        pixel_um=None if frame.px_per_mm is None else 1000 / frame.px_per_mm,
    )


def _score(frame: FrameMeasurement) -> float:
    """The mean, over all marks, of likeness times the share of the mark that is undamaged. What belongs to another
    mark, the ring about a cross that is drawn without one, counts as damage; a mark that is not found counts 0."""
    return float(
        np.mean(
            [
                mark.quality["likeness"] * (1.0 - mark.quality["damaged_fraction"])
                if mark.status.is_observation
                else 0.0
                for mark in frame.marks
            ]
        )
    )


def _stretched(layout: FiducialLayout) -> FiducialLayout:
    x, y = _STRETCH
    return replace(
        layout, marks=tuple(replace(mark, xy_mm=(x * mark.xy_mm[0], y * mark.xy_mm[1])) for mark in layout.marks)
    )


def _residual(frame: FrameMeasurement, layout: FiducialLayout) -> tuple[float, float] | None:
    """Per axis, in standard deviations and in mm, what an affine transformation of the marks leaves."""
    pairs = [(m, given) for m, given in zip(frame.marks, layout.marks, strict=True) if m.status.is_observation]
    redundancy = 2 * len(pairs) - _AFFINE
    px_per_mm = frame.px_per_mm
    if redundancy <= 0 or px_per_mm is None:
        return None
    given_mm = np.array([given.xy_mm for _, given in pairs])
    comparator_mm = np.array([mark.center_px for mark, _ in pairs]) * (1.0, -1.0) / px_per_mm
    parameters, mirrored = fit_transformation("affine", comparator_mm, given_mm)
    residuals_mm = film_kind("affine", mirrored).apply(parameters, comparator_mm) - given_mm
    sigma_mm = np.array([_sigma_mm(mark.covariance_px2, given, px_per_mm) for mark, given in pairs])
    return (
        float(np.sqrt(((residuals_mm / sigma_mm) ** 2).sum() / redundancy)),
        float(np.sqrt((residuals_mm**2).sum() / redundancy)),
    )


def _sigma_mm(covariance_px2: Array | None, given: LayoutMark, px_per_mm: float) -> Array:
    """Of mark, given place and film in x' and y'; the mark's own is small and nearly round, so its turn is left out."""
    own = 0.0 if covariance_px2 is None else float(np.trace(covariance_px2)) / 2 / px_per_mm**2
    return np.asarray(np.sqrt(np.square(given.sigma_mm) + own + SCATTER_MM**2))
