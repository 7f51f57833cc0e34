"""Each fiducial mark checked by what else is known of it: its place by another method, the lines of opposite marks, the
camera's other frames, and of a frame of three the form of its triangle.

Every check is a test at a stated probability of doubting any good mark of all the camera's frames (Bonferroni: divided
by the number of tests). A mark that fails one is weak: the reason says why, and its covariance is enlarged by what was
found, for it is known no better than that. What all frames have in common is the camera's, and no error.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtrc, fdtrc

from measure.checks.doubts import CHANCE, MEDIAN_EFFICIENCY, TOLD, Doubt, doubted, from_others, observed
from measure.checks.triangles import by_given_triangles, by_other_triangles
from measure.covariance import Cause
from measure.film import SCATTER_MM
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.results import FrameMeasurement

Array = NDArray[np.float64]

_OPPOSITE_MM = 0.3  # how far from being opposite about the centre two given marks may be: an affinity keeps midpoints
_ROUNDS = 10  # of fitting the frames to the median of all, which comes to rest after a few
_LEAST_MM = 1e-6  # of a standard deviation


@dataclass(frozen=True, eq=False)
class _Seen:
    """The marks of a frame that are observations: their places in the layout (n,), camera mm (n, 2) through the frame's
    own transformation, standard deviations sigma_mm (n,); mm: of a pixel."""

    index: NDArray[np.intp]
    camera_mm: Array
    sigma_mm: Array
    mm: float

    def without(self, places: Sequence[int]) -> "_Seen":
        kept = np.setdiff1d(np.arange(len(self.index)), places)
        return replace(self, index=self.index[kept], camera_mm=self.camera_mm[kept], sigma_mm=self.sigma_mm[kept])


@dataclass(frozen=True, eq=False)
class _Reference:
    """A frame's marks as the median of the other frames has them: mm (n, 2). variance (n,): the median's, in units of
    one mark's; measured_mm2 (n,): what of it the other frames' standard deviations make."""

    mm: Array
    variance: Array
    measured_mm2: Array


def cross_checked(
    frames: Sequence[FrameMeasurement],
    layout: FiducialLayout,
    pitches_um: Sequence[tuple[float, float]],
    film_sigma_mm: float = SCATTER_MM,
) -> tuple[FrameMeasurement, ...]:
    """The frames of one camera after all checks of their fiducials. pitches_um: of each scan, in x and y;
    film_sigma_mm: scatter of marks by film and scanner, where one frame has to be judged alone."""
    checked = tuple(frames)
    checked = _after(checked, _by_other_method(checked))
    checked = _after(checked, _by_other_frames(checked, layout))
    checked = _after(checked, _by_midpoints(checked, layout, film_sigma_mm))
    checked = _after(checked, by_other_triangles(checked, layout, pitches_um, film_sigma_mm))
    return _after(checked, by_given_triangles(checked, layout, pitches_um))


def _after(frames: Sequence[FrameMeasurement], doubts: Iterable[Mapping[str, Doubt]]) -> tuple[FrameMeasurement, ...]:
    return tuple(doubted(frame, own) for frame, own in zip(frames, doubts, strict=True))


def _by_other_method(frames: Sequence[FrameMeasurement]) -> Iterator[dict[str, Doubt]]:
    """The place by the mark's edges must not differ from the matched one by more than noise explains."""
    name = "second_method_sigmas"
    tests = sum(name in mark.quality for frame in frames for mark in observed(frame))
    for frame in frames:
        doubts = {}
        for mark in observed(frame):
            sigmas = mark.quality.get(name)
            if sigmas is not None and chdtrc(2, sigmas**2) * tests < CHANCE:
                off = float(np.hypot(mark.quality["second_method_col_px"], mark.quality["second_method_row_px"]))
                doubts[mark.point] = Doubt(
                    f"its edges put it {off:#.2g} px elsewhere, {sigmas:.1f} standard deviations of the difference: "
                    "it is damaged or unlike its drawing",
                    off,
                    Cause.SECOND_METHOD,
                )
        yield doubts


def _by_other_frames(frames: Sequence[FrameMeasurement], layout: FiducialLayout) -> Iterator[dict[str, Doubt]]:
    """Every frame, under an affinity, against the median of the camera's other frames: the frame that is worst off
    first, and without what is off there the others again."""
    seen = [_seen(frame, layout) for frame in frames]
    doubts: list[dict[str, Doubt]] = [{} for _ in frames]
    while True:
        others = _others(seen, layout)
        apart = {
            place: _Apart.of(each, reference)
            for place, (each, reference) in enumerate(zip(seen, others, strict=True))
            if reference is not None and len(each.index) > 3
        }
        if len(apart) < 2:
            break
        scatter = _Scatter.of(list(apart.values()))
        chances = {place: scatter.chance(each) for place, each in apart.items()}
        worst = min(chances, key=lambda place: chances[place])
        if chances[worst] * len(apart) >= CHANCE:
            break
        # Of two frames nobody knows which one is off.
        for place in apart if len(apart) == 2 else (worst,):
            alike, off_mm = _strangers(seen[place], others[place], scatter)
            names = [layout.marks[seen[place].index[number]].id for number in alike]
            for name, off in zip(names, off_mm, strict=True):
                doubts[place][name] = Doubt(from_others(off, names), off / seen[place].mm, Cause.OTHER_FRAMES)
            seen[place] = seen[place].without(alike)
    yield from doubts


def _seen(frame: FrameMeasurement, layout: FiducialLayout) -> _Seen:
    number = {mark.id: place for place, mark in enumerate(layout.marks)}
    marks = [mark for mark in observed(frame) if mark.point in number] if frame.pixel_from_camera is not None else []
    matrix = np.eye(2, 3) if frame.pixel_from_camera is None else frame.pixel_from_camera
    mm = float(1 / np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    centers = np.array([mark.center_px for mark in marks]).reshape(-1, 2)
    sigma = [np.sqrt(np.trace(mark.covariance_px2) / 2) for mark in marks if mark.covariance_px2 is not None]
    camera = (centers - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    return _Seen(np.array([number[mark.point] for mark in marks], dtype=np.intp), camera, mm * np.array(sigma), mm)


def _others(seen: Sequence[_Seen], layout: FiducialLayout) -> list[_Reference | None]:
    """For each frame its marks as the median of all other frames has them; None where one is in no other.

    The median is found in turns: frames fitted to it by affinities, then together anew; the given places hold the
    datum.
    """
    common = np.array([mark.xy_mm for mark in layout.marks])
    fitted = np.full((len(seen), *common.shape), np.nan)
    squares = np.full(fitted.shape[:2], np.nan)  # of the marks' standard deviations: frames may be unlike in noise
    for each, own in zip(seen, squares, strict=True):
        if len(each.index) > 3:
            own[each.index] = np.maximum(each.sigma_mm, _LEAST_MM) ** 2
    for _ in range(_ROUNDS):
        for each, places in zip(seen, fitted, strict=True):
            places[:] = np.nan
            if len(each.index) > 3:
                design = _affine(each.camera_mm)
                places[each.index] = design @ np.linalg.lstsq(design, common[each.index], rcond=None)[0]
        found = np.isfinite(fitted[..., 0]).any(axis=0)
        common[found] = np.nanmedian(fitted[:, found], axis=0)
    result: list[_Reference | None] = []
    for place, each in enumerate(seen):
        rest = np.delete(fitted, place, axis=0)[:, each.index]
        frames = np.isfinite(rest[..., 0]).sum(axis=0)
        if len(each.index) == 0 or not frames.all():
            result.append(None)
        else:
            variance = np.minimum(np.pi / 2, frames / 2 + 0.5) / frames
            measured = variance * np.nanmedian(np.delete(squares, place, axis=0)[:, each.index], axis=0)
            result.append(_Reference(np.nanmedian(rest, axis=0), variance, measured))
    return result


def _affine(places: Array) -> Array:
    return np.column_stack([places, np.ones(len(places))])


class _Fit:
    """A frame fitted by an affinity to a reference, in mm of the camera, on the marks kept (n,): off (all, 2), of every
    mark, residuals (n, 2) and sigma (n,) of those kept."""

    def __init__(self, seen: _Seen, reference: Array, kept: NDArray[np.bool_]) -> None:
        design = _affine(seen.camera_mm)
        solution = np.linalg.lstsq(design[kept], reference[kept], rcond=None)[0]
        self.off = reference - design @ solution  # of those left out, too
        self.residuals = self.off[kept]
        self.sigma = seen.sigma_mm[kept]


@dataclass(frozen=True, eq=False)
class _Apart:
    """How far each mark of a frame (n,) lies from where an affinity through the frame's others puts it: squares_mm2 of
    the distance. The variance of a coordinate of it is measured_mm2, and what film scatters a mark by times film."""

    squares_mm2: Array
    film: Array
    measured_mm2: Array

    @classmethod
    def of(cls, seen: _Seen, reference: _Reference) -> "_Apart":
        q = np.linalg.qr(_affine(seen.camera_mm))[0]
        own = np.maximum(1 - (q**2).sum(axis=1), 1e-6)  # of a mark's error what its residual shows
        from_marks = (np.eye(len(q)) - q @ q.T) / own[:, None]
        film = from_marks**2 @ (1 + reference.variance)
        measured = from_marks**2 @ (np.maximum(seen.sigma_mm, _LEAST_MM) ** 2 + reference.measured_mm2)
        squares = ((from_marks @ reference.mm) ** 2).sum(axis=1)
        return cls(squares, film, measured)

    @property
    def degrees(self) -> int:
        return 2 * (len(self.film) - 3)


@dataclass(frozen=True)
class _Scatter:
    """What film and scanner scatter a mark by, an axis, and on how many degrees of freedom that is known."""

    variance_mm2: float
    degrees: float

    @classmethod
    def of(cls, frames: Sequence[_Apart]) -> "_Scatter":
        """What there is more than the marks' own standard deviations, from the median of the squared distances: marks
        that are off do not widen it. Half of Rayleigh's squares are below 2 ln 2."""
        squares = np.concatenate([each.squares_mm2 for each in frames])
        film, measured = (
            np.concatenate(parts) for parts in zip(*((f.film, f.measured_mm2) for f in frames), strict=True)
        )

        def too_far(variance: float) -> float:
            return float(np.median(squares / (variance * film + measured)) - 2 * np.log(2))

        variance = 0.0 if too_far(0.0) <= 0 else float(brentq(too_far, 0.0, float((squares / film).max())))
        return cls(variance, MEDIAN_EFFICIENCY * sum(each.degrees for each in frames))

    def chi_square(self, fit: _Fit) -> float:
        variance = self.variance_mm2 + np.maximum(fit.sigma, _LEAST_MM) ** 2
        return float(((fit.residuals**2).sum(axis=1) / variance).sum())

    def chance(self, frame: _Apart) -> float:
        """The probability that a frame of good marks has one as far off."""
        squares = frame.squares_mm2 / (self.variance_mm2 * frame.film + frame.measured_mm2)
        return len(squares) * float(fdtrc(2, max(self.degrees, 1.0), squares.max() / 2))


def _strangers(seen: _Seen, reference: _Reference | None, scatter: _Scatter) -> tuple[list[int], list[float]]:
    """The mark of a frame that is off, or those that it cannot be told from, and how far, mm, each is."""
    assert reference is not None
    everything = np.ones(len(seen.index), dtype=bool)
    without = []
    for place in range(len(everything)):
        rest = everything.copy()
        rest[place] = False
        without.append(_Fit(seen, reference.mm, rest))
    misfits = np.array([scatter.chi_square(fit) for fit in without])
    alike = np.flatnonzero(misfits - misfits.min() < 2 * TOLD).tolist()
    fit = without[alike[0]] if len(alike) == 1 else _Fit(seen, reference.mm, everything)
    return alike, [float(np.hypot(*fit.off[place])) for place in alike]


def _by_midpoints(
    frames: Sequence[FrameMeasurement], layout: FiducialLayout, film_sigma_mm: float
) -> Iterator[dict[str, Doubt]]:
    """The midpoints of opposite marks lie in one point, as far as the given places have them there."""
    pairs = _opposite(layout)
    seen = [_seen(frame, layout) for frame in frames]
    whole = [[pair for pair in pairs if np.isin(pair, each.index).all()] for each in seen]
    tests = sum(len(own) for own in whole if len(own) > 1)
    for each, own in zip(seen, whole, strict=True):
        yield _off_midpoint(each, own, CHANCE / max(tests, 1), layout, film_sigma_mm) if len(own) > 1 else {}


def _opposite(layout: FiducialLayout) -> list[tuple[int, int]]:
    xy = np.array([mark.xy_mm for mark in layout.marks])
    middle = xy.mean(axis=0)
    return [
        (first, second)
        for first, second in combinations(range(len(xy)), 2)
        if np.hypot(*(xy[first] + xy[second] - 2 * middle)) < _OPPOSITE_MM
    ]


def _off_midpoint(
    seen: _Seen, pairs: Sequence[tuple[int, int]], chance: float, layout: FiducialLayout, film_sigma_mm: float
) -> dict[str, Doubt]:
    """The marks of the pair whose midpoint is farthest, in standard deviations, from that of the others."""
    given = np.array([mark.xy_mm for mark in layout.marks])
    sigma = np.array([min(max(mark.sigma_mm), MOST_GIVEN_SIGMA_MM) for mark in layout.marks])
    off = np.zeros((len(layout.marks), 2))
    variance = np.full(len(layout.marks), np.inf)
    off[seen.index] = seen.camera_mm - given[seen.index]
    variance[seen.index] = seen.sigma_mm**2 + sigma[seen.index] ** 2 + film_sigma_mm**2
    midpoints = np.array([off[list(pair)].mean(axis=0) for pair in pairs])
    spread = np.array([variance[list(pair)].sum() / 4 for pair in pairs])
    count = len(pairs)
    apart = (midpoints - midpoints.mean(axis=0)) * count / (count - 1)  # from the mean of the others
    spread = spread + (spread.sum() - spread) / (count - 1) ** 2
    squares = (apart**2).sum(axis=1) / spread
    worst = int(squares.argmax())
    if chdtrc(2, squares[worst]) > chance:
        return {}
    guilty = pairs if count == 2 else [pairs[worst]]
    distance = float(np.hypot(*apart[worst]))
    lines = " and ".join("-".join(layout.marks[place].id for place in pair) for pair in guilty)
    reason = (
        f"the lines of opposite marks do not meet: the midpoint of {lines} lies {distance:.3f} mm off, "
        f"{np.sqrt(squares[worst]):.1f} standard deviations: a mark of these is off, or film or "
        "scanner bent"
    )
    doubt = Doubt(reason, distance / seen.mm, Cause.GIVEN_PLACES)
    return {layout.marks[place].id: doubt for pair in guilty for place in pair}
