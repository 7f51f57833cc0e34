"""Which camera a scan is of: every camera of the library whose marks are drawn is tried on it."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.padding import Padding

from adjust.functional_model.transformation import film_kind
from adjust.initial_values.fiducial_fit import fit_transformation
from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.results import FrameMeasurement
from measure.scans.scan import Scan, open_scan
from measure.search.frame_search import expected_alike
from pipeline.files.camera_file import CameraFile
from pipeline.progress import Count, Reporter

Array = NDArray[np.float64]
Json = dict[str, Any]

_ALIKE_MM = 0.1  # two cameras whose marks lie so near to one another look alike in a scan
_STRETCH = (1.08, 0.93)  # of the layout that only chance can find: no film is so deformed
_OUTSTANDING = 2.0  # times what chance finds
_CERTAIN = 0.01  # constellations expected by chance: no mark need be matched in wrong places to know better
_BY_CHANCE = 1.0  # constellation expected: chance may have made it
_ODDS = 1000.0  # times what chance makes of another camera's marks: that one is seen, and not this
_CLOSE = 0.85  # of the best score: a camera that comes so near is not told from it
_AFFINE = 6  # parameters


@dataclass(frozen=True)
class Trial:
    """What became of the cameras that share a layout of marks.

    found: marks that are observations, of drawn ones. likeness: their mean correlation with the drawing; snr: the
    median of contrast over noise. score: 0 to 1, as `_score` has it. chance: the score of the same marks in wrong
    places, the layout stretched; None where no such comparison is needed. residual_sigmas, residual_mm: what an affine
    transformation leaves, per axis, in standard deviations of marks and given places; None where it leaves nothing
    over. expected: how many constellations that answer as well at reduced size chance makes in such a scan.
    """

    cameras: tuple[str, ...]
    found: int
    drawn: int
    likeness: float
    snr: float
    score: float
    chance: float | None
    residual_sigmas: float | None
    residual_mm: float | None
    reason: str
    seconds: float
    expected: float

    @property
    def against_chance(self) -> str:
        if self.chance is None:
            return f"chance makes {self.expected:.1g} constellations that answer as well in such a scan"
        return f"the same marks in wrong places score {self.chance:.2f}"

    @property
    def stands_out(self) -> bool:
        return self.score > 0.0 and (self.chance is None or self.score >= _OUTSTANDING * self.chance)


@dataclass(frozen=True)
class Identification:
    """The trials, best first, and what follows from them. unreported: by name, what cameras without any calibration
    report rest on."""

    scan: Path
    trials: tuple[Trial, ...]
    unreported: Mapping[str, str] = field(default_factory=dict)

    @property
    def best(self) -> tuple[Trial, ...]:
        """The trial that stands out, and those that come too near to be told from it."""
        standing = [trial for trial in self.trials if trial.stands_out]
        return tuple(trial for trial in standing if trial.score >= _CLOSE * standing[0].score)

    def sentence(self) -> str:
        if not self.best:
            return (
                f"{self.scan.name}: no camera of the library stands out. Its marks may be none of those drawn, or too "
                "faint; --pitch helps where the scan's file does not say it."
            )
        first = self.best[0]
        told = (
            f"{self.scan.name}: {' or '.join(first.cameras)}, score {first.score:.2f}: {first.found} of {first.drawn} "
            f"marks, likeness {first.likeness:.2f}, signal-to-noise {first.snr:.1f}; {first.against_chance}."
        )
        if len(self.best) > 1:
            told += f" {' or '.join(self.best[1].cameras)} comes close with {self.best[1].score:.2f}."
        elif len(first.cameras) > 1:
            told += " Their marks are alike; the data strip or the focal length must decide."
        named = [name for trial in self.best for name in trial.cameras if name in self.unreported]
        return told + "".join(f" {name} rests on no calibration report: {self.unreported[name]}." for name in named)

    def as_json(self) -> Json:
        trials = [{**asdict(trial), "stands_out": trial.stands_out} for trial in self.trials]
        best = [name for trial in self.best for name in trial.cameras]
        return {"scan": str(self.scan), "best": best, "sentence": self.sentence(), "trials": trials}


def identify(
    path: Path, cameras: Mapping[str, CameraFile], pitch_um: float | None, reporter: Reporter
) -> Identification:
    """Try every camera with drawn marks on the scan, those with the same marks once.

    Raises MeasurementError for a scan that cannot be read.
    """
    with open_scan(path) as scan, reporter.stage("trying") as count:
        pitch = scan.pitch_um if pitch_um is None else (pitch_um, pitch_um)
        trials = _trials(scan, cameras, pitch, FiducialOptions(pitch_is_right=True), count)
        if pitch is not None and not any(trial.stands_out for trial in trials):
            trials = _trials(scan, cameras, pitch, FiducialOptions(), count)
    sources = {name: camera.source for name, camera in cameras.items()}
    unreported = {name: source.text for name, source in sources.items() if source and not source.reports}
    return Identification(path, tuple(sorted(trials, key=lambda trial: (-trial.score, trial.expected))), unreported)


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


def print_identification(identification: Identification, console: Console) -> None:
    for trial in identification.trials:
        console.print(", ".join(trial.cameras), style="bold", highlight=False)
        console.print(Padding(_figures(trial), (0, 0, 0, 4)), highlight=False)
    console.print(identification.sentence(), highlight=False, soft_wrap=True)


def _figures(trial: Trial) -> str:
    if not trial.found:
        return f"{trial.score:.2f}: {trial.reason}"
    words = [f"{trial.score:.2f}: {trial.found} of {trial.drawn} marks, likeness {trial.likeness:.2f}"]
    words.append(f"signal-to-noise {trial.snr:.1f}")
    if trial.residual_mm is not None:
        words.append(f"affine residual {trial.residual_mm:.3f} mm ({trial.residual_sigmas:.0f} sigma)")
    words.append(f"by chance {trial.expected:.1g}")
    if trial.chance is not None:
        words.append(f"in wrong places {trial.chance:.2f}")
    return f"{', '.join(words)}; {trial.seconds:.0f} s"


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
    film = FiducialOptions().film_sigma_mm
    return np.asarray(np.sqrt(np.square(given.sigma_mm) + own + film**2))
