"""Corners of the exposed frame: the edge of the frame along both sides, each a straight line, and where they meet.

Across an edge the grey value is a step under the scanner's blur, an error function; it is fitted to many profiles. The
line through them is a robust one (Tukey), for stamps, dust and other marks lie on the edge too; what is rounded at the
corner is left out. The landscape's contrast with the border differs from profile to profile, the place does not. A
neighbouring frame's edge steps the other way.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import erf

from measure.covariance import Covariance
from measure.fitting.matching import Match
from measure.marks.shapes import FrameCorner
from measure.noise.noise import robust_scale
from measure.noise.robust import tukey_weights
from measure.reason import NO_REASON, Code, Reason
from measure.scans.scan import Scan
from measure.search.candidates import FAINT
from measure.search.prediction import MarkPrediction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PROFILES = 60  # along an edge, each the mean over its share of it
_LEAST_SHARE = 0.5  # of the profiles that lie on the line: with fewer it may be another line
_LEAST_SNR = 3.0  # of the step in one profile: less is texture
_ABOUT_PX = 5.0  # about the line: what an edge under any usual blur takes
_STEP_PX = 0.5  # of the samples across the edge
_SMOOTH_PX = 1.5  # across the edge, before its slope is taken
_TILT = 0.02  # rad: the placement knows the edge's direction better
_ITERATIONS = 12  # of the steps across an edge
_ROUNDS = 20  # of Tukey's line, which rests after a few
_START_BLUR_PX = 1.5  # about that of scans
_RIM_PX = 2.0  # of a profile: a step so near its end may be another's
_MOST_ALIKE = 0.9  # correlation of neighbouring profiles: nineteen count as one
_BLUR_RANGE_PX = (0.3, 4.0)
_SCATTER_FLOOR_PX = 0.01  # under the scatter about a line: clean pictures have none
_UNSEEN = Reason("an edge of the frame is not to be seen there as one line", Code.NOT_FOUND)
_ROUNDED = 0.1  # of the reach: left out at every corner, for few are sharp


@dataclass(frozen=True, eq=False)
class _Edge:
    """across = offset + slope * along, px from the start; covariance (2, 2) of both; share: of the profiles that lie on
    it; contrast_dn, noise_dn, blur_px, likeness: medians over these."""

    offset: float
    slope: float
    covariance: Array
    share: float
    contrast_dn: float
    noise_dn: float
    blur_px: float
    likeness: float
    count: int


@dataclass(frozen=True, eq=False)
class _Course:
    """Where an edge is expected to run: from the start (2,) in the scan along, the frame's inside lying across, both
    (2,) of length 1."""

    scan: Scan
    start: Array
    along: Array
    across: Array
    weights: Sequence[float] | None

    def profiles(self, middle: Array, offset: Array, share: float, half: float) -> tuple[Array, Mask]:
        """(n, samples) light across the edge about an offset (n,), each the mean over its share of the edge, and
        which of them lie in the scan."""
        s = np.arange(-round(half / _STEP_PX), round(half / _STEP_PX) + 1) * _STEP_PX
        run = np.linspace(-0.5, 0.5, max(int(share), 2), endpoint=False) * share
        slope = np.gradient(offset, middle) if len(middle) > 1 else np.zeros(1)
        t = middle[:, None, None] + run[:, None]
        q = (offset[:, None] + slope[:, None] * run)[:, :, None] + s
        places = (
            self.start[:, None, None, None] + self.along[:, None, None, None] * t + self.across[:, None, None, None] * q
        )
        low = np.floor(places.min(axis=(1, 2, 3))).astype(int) - 2
        size = np.ceil(places.max(axis=(1, 2, 3))).astype(int) + 3 - low
        window = self.scan.light(int(low[0]), int(low[1]), int(size[0]), int(size[1]), self.weights)
        col, row = places - low[:, None, None, None]
        grey = map_coordinates(window, [row, col], order=1, mode="nearest").mean(axis=1)
        limit = np.array([self.scan.width_px, self.scan.height_px])[:, None, None, None] - 1
        inside = ((places >= 0) & (places <= limit)).all(axis=(0, 2, 3))
        return np.asarray(grey, dtype=float), np.asarray(inside)


def corner_of_edges(scan: Scan, mark: FrameCorner, expected: MarkPrediction) -> Match:
    """The mark, within the search radius of its predicted place, its frame being lighter than its border or darker as
    the polarity says. Not converged, with a reason, where either edge is not to be seen."""
    inward = expected.linear * np.array(mark.toward)  # columns: along x', y' into the frame, px per mm
    per_mm = np.hypot(*inward)
    unit = inward / per_mm
    edges = []
    for side in (0, 1):
        along, across = unit[:, side], unit[:, 1 - side]
        reach = mark.reach_mm * per_mm[side]
        first = max(mark.radius_mm * per_mm[side], _ROUNDED * reach)
        course = _Course(scan, expected.center_px, along, across, expected.weights)
        edge = _edge(course, (first, reach), expected.search_px, expected.polarity)
        if edge is None:
            return _missed(expected.pixel_from_mark, _UNSEEN)
        edges.append(edge)
    return _met(edges, unit, expected.pixel_from_mark)


def _edge(course: _Course, extent: tuple[float, float], search_px: float, polarity: int) -> _Edge | None:
    """The edge that runs along from the start, the frame's inside lying across."""
    share = (extent[1] - extent[0]) / _PROFILES
    middle: Array = np.asarray(extent[0] + share * (np.arange(_PROFILES) + 0.5), dtype=float)
    half = round(search_px + _ABOUT_PX)
    near, inside = course.profiles(middle, np.zeros(_PROFILES), share, half)
    near, middle = near[inside], middle[inside]
    if len(middle) < _LEAST_SHARE * _PROFILES:
        return None
    line = _straightest(near * polarity, middle, half)
    found, _ = course.profiles(middle, line[0] + line[1] * middle, share, _ABOUT_PX)
    steps = _fit_steps(found)
    good = steps.good & (steps.contrast * polarity > FAINT * course.scan.full_scale_dn)
    good &= np.abs(steps.contrast) > _LEAST_SNR * steps.noise
    if good.sum() < _LEAST_SHARE * _PROFILES:
        return None
    place = line[0] + line[1] * middle[good] + steps.place[good]
    return _line(middle[good], place, steps, good, len(middle))


def _straightest(grey: Array, along: Array, half: float) -> tuple[float, float]:
    """Offset and slope of the straight line along which most profiles step up: a stone's edge may be stronger in some
    of them, and so counts no more there than the frame's does elsewhere."""
    rise = np.gradient(cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX / _STEP_PX, sigmaY=1e-3), axis=1)
    rise = np.clip(rise, 0.0, float(np.median(rise.max(axis=1))))
    middle = float(along.mean())
    tilts = np.linspace(-_TILT, _TILT, 2 * int(np.ceil(_TILT * float(np.ptp(along)) / 2 / _STEP_PX)) + 1)
    samples = np.arange(grey.shape[1])
    votes = np.empty((len(tilts), grey.shape[1]))
    for index, tilt in enumerate(tilts):
        moved = np.rint(tilt * (along - middle) / _STEP_PX).astype(int)
        column = samples[None, :] + moved[:, None]
        inside = (column >= 0) & (column < len(samples))
        votes[index] = (np.take_along_axis(rise, np.clip(column, 0, len(samples) - 1), axis=1) * inside).sum(axis=0)
    best, place = np.unravel_index(int(votes.argmax()), votes.shape)
    return float(place * _STEP_PX - half - tilts[best] * middle), float(tilts[best])


@dataclass(frozen=True, eq=False)
class _Steps:
    """(n,) of every profile: where it steps (px), by how much, under which blur, and how well that describes it."""

    place: Array
    contrast: Array
    blur: Array
    noise: Array
    likeness: Array
    good: Mask


def _fit_steps(grey: Array) -> _Steps:
    """The step level + contrast * Phi((s - place) / blur) in every profile, by Gauss-Newton."""
    s = (np.arange(grey.shape[1]) - (grey.shape[1] - 1) / 2) * _STEP_PX
    count = len(grey)
    place, blur = np.zeros(count), np.full(count, _START_BLUR_PX)
    contrast, level = np.zeros(count), np.zeros(count)
    for _ in range(_ITERATIONS):
        z = (s - place[:, None]) / blur[:, None]
        step = (1 + erf(z / np.sqrt(2))) / 2
        slope = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) / blur[:, None]
        level, contrast = _linear(step, grey)
        by_place, by_blur = -contrast[:, None] * slope, -contrast[:, None] * slope * z
        design = np.stack([by_place, by_blur, step, np.ones_like(step)], axis=2)
        residuals = grey - level[:, None] - contrast[:, None] * step
        normal = np.einsum("nsi,nsj->nij", design, design)
        normal += np.eye(4) * (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12)
        change = np.linalg.solve(normal, np.einsum("nsi,ns->ni", design, residuals)[..., None])[..., 0]
        place = place + np.clip(change[:, 0], -1.0, 1.0)
        blur = np.clip(blur + np.clip(change[:, 1], -0.5, 0.5), *_BLUR_RANGE_PX)
    step = (1 + erf((s - place[:, None]) / blur[:, None] / np.sqrt(2))) / 2
    level, contrast = _linear(step, grey)
    residuals = grey - level[:, None] - contrast[:, None] * step
    noise = np.sqrt((residuals**2).mean(axis=1))
    spread = np.maximum(grey.std(axis=1), 1e-12)
    likeness = np.sqrt(np.clip(1 - (noise / spread) ** 2, 0.0, 1.0))
    return _Steps(place, contrast, blur, noise, likeness, np.abs(place) < s[-1] - _RIM_PX)


def _linear(step: Array, grey: Array) -> tuple[Array, Array]:
    """Level and contrast (n,) that put the steps best through the grey values."""
    centred = step - step.mean(axis=1, keepdims=True)
    contrast = (centred * grey).sum(axis=1) / np.maximum((centred**2).sum(axis=1), 1e-12)
    return grey.mean(axis=1) - contrast * step.mean(axis=1), contrast


def _line(along: Array, across: Array, steps: _Steps, good: Mask, asked: int) -> _Edge | None:
    """Tukey's line, its covariance from the scatter about it and from how far along the edge that is alike."""
    offset, slope, weights = float(np.median(across)), 0.0, np.ones(len(along))
    for _ in range(_ROUNDS):
        slope, offset = (float(value) for value in np.polyfit(along, across, 1, w=np.sqrt(weights)))
        residuals = across - offset - slope * along
        weights = tukey_weights(residuals, max(robust_scale(residuals), _SCATTER_FLOOR_PX))
        if (weights > 0).sum() < _LEAST_SHARE * asked:
            return None
    on = weights > 0
    design = np.stack([np.ones_like(along), along], axis=1)
    inverse = np.linalg.inv((design * weights[:, None]).T @ design)
    residuals = across - offset - slope * along
    variance = float((residuals[on] ** 2).sum() / max(int(on.sum()) - 2, 1)) + _SCATTER_FLOOR_PX**2
    kept = np.flatnonzero(good)[on]
    return _Edge(
        offset,
        slope,
        np.asarray(inverse * variance * _alike(residuals, on), dtype=float),
        float(on.sum() / asked),
        float(np.median(steps.contrast[kept])),
        float(np.median(steps.noise[kept])),
        float(np.median(steps.blur[kept])),
        float(np.median(steps.likeness[kept])),
        int(on.sum()),
    )


def _alike(residuals: Array, on: Mask) -> float:
    """How many neighbouring residuals count as one, their correlation falling geometrically with the distance."""
    pairs = on[1:] & on[:-1]
    if not pairs.any():
        return 1.0
    next_to = float((residuals[1:] * residuals[:-1])[pairs].mean() / max((residuals[on] ** 2).mean(), 1e-12))
    alike = float(np.clip(next_to, 0.0, _MOST_ALIKE))
    return (1 + alike) / (1 - alike)


def _met(edges: Sequence[_Edge], unit: Array, pixel_from_mark: Array) -> Match:
    """The corner: along the first edge x, y = a + b x, and along the second x = c + d y."""
    first, second = edges
    a, b, c, d = first.offset, first.slope, second.offset, second.slope
    x, y = (c + d * a) / (1 - b * d), (a + b * c) / (1 - b * d)
    scale = 1 / (1 - b * d)
    by_first = scale * np.array([[d, d * x], [1.0, x]])  # of (x, y) by a, b
    by_second = scale * np.array([[1.0, y], [b, b * y]])
    covariance = by_first @ first.covariance @ by_first.T + by_second @ second.covariance @ by_second.T
    center = pixel_from_mark[:, 2] + unit @ (x, y)
    noise = max(edge.noise_dn for edge in edges)
    contrast = min((edge.contrast_dn for edge in edges), key=abs)
    return Match(
        converged=True,
        reason=NO_REASON,
        center_px=center,
        place_covariance=Covariance.of_noise(unit @ covariance @ unit.T),
        pixel_from_mark=np.column_stack([pixel_from_mark[:, :2], center]),
        contrast_dn=contrast,
        stored_contrast_dn=contrast,
        noise_dn=noise,
        blur_px=max(edge.blur_px for edge in edges),
        damaged_fraction=1.0 - min(edge.share for edge in edges),
        redundancy=sum(edge.count for edge in edges) - 4,
        neighbour_correlation=0.0,
        covariance_is_white=False,
        likeness=min(edge.likeness for edge in edges),
        significance=abs(contrast) / max(noise, 1e-12) * float(np.sqrt(min(edge.count for edge in edges))),
    )


def _missed(pixel_from_mark: Array, reason: Reason) -> Match:
    return Match(
        converged=False,
        reason=reason,
        center_px=pixel_from_mark[:, 2],
        place_covariance=Covariance.of_noise(np.full((2, 2), np.inf)),
        pixel_from_mark=pixel_from_mark,
        contrast_dn=0.0,
        stored_contrast_dn=0.0,
        noise_dn=0.0,
        blur_px=0.0,
        damaged_fraction=1.0,
        redundancy=0,
        neighbour_correlation=0.0,
        covariance_is_white=True,
        likeness=0.0,
        significance=0.0,
    )
