"""An edge of the exposed frame: a straight line, by many profiles across it.

Across an edge the light is a step under the scanner's blur, an error function; it is fitted to every profile. The line
through them is a robust one (Tukey), for stamps, dust and marks lie on the edge too. The landscape's contrast with the
border differs from profile to profile, the place does not. A neighbouring frame's edge steps the other way.

What a wrong tone curve leaves of a step is alike in all profiles, and the scatter among them says how well it is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import erf

from measure.flags import NO_REASON, Code, Reason
from measure.marks.shapes import FrameCorner
from measure.matching.window import FAINT
from measure.noise.robust_estimation import gauss_newton_step, tukey_fit
from measure.results import Covariance, MarkFit
from measure.scans.scan import Scan
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import MarkTone

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PROFILES = 60  # along an edge, each the median over its share of it
_LEAST_SHARE = 0.5  # of the profiles that lie on the line: with fewer it may be another line
_LEAST_SNR = 3.0  # of the step in one profile: less is texture
_ABOUT_PX = 5.0  # about the line: what an edge under any usual blur takes
_STEP_PX = 0.5  # of the samples across the edge
_SMOOTH_PX = 1.5  # across the edge, before its slope is taken
_TILT = 0.02  # rad: the placement knows the edge's direction better
_ITERATIONS, _DAMPING = 12, 1e-9  # of the steps across an edge
_ROUNDS = 20  # of Tukey's line, which rests after a few
_START_BLUR_PX = 1.5  # about that of scans
_RIM_PX = 2.0  # of a profile: a step so near its end may be another's
_MOST_ALIKE = 0.9  # correlation of neighbouring profiles: nineteen count as one
_BLUR_RANGE_PX = (0.3, 4.0)
_SCATTER_FLOOR_PX = 0.01  # under the scatter about a line: clean pictures have none
_LEAST = 1e-6  # of the variance of all that edges show: what they hardly show
_DRAWN = 0.005  # of a step: what is left of it below that may be the drawing's own
_UNSEEN = Reason("an edge of the frame is not to be seen there as one line", Code.NOT_FOUND)
_ROUNDED = 0.1  # of the reach: left out at every corner, for few are sharp


@dataclass(frozen=True, eq=False)
class EdgeTone:
    """What an edge says of the tone curve. Of each profile: scores (n, k), as `ToneInformation.from_score` takes them,
    normal (n, k, k), by which these grow with the departures, and floor (n, k, k), the least covariance that they have.
    on_line (2, k): by how much the offset and slope change for each departure of 1. least, greatest: the codes between
    which it steps, shares of full scale."""

    scores: Array
    normal: Array
    floor: Array
    on_line: Array
    least: float
    greatest: float


@dataclass(frozen=True, eq=False)
class Edge:
    """across = offset + slope * along, px from the start; covariance (2, 2) of both; share: of the profiles that lie on
    it; contrast_dn, noise_dn, blur_px, likeness: medians over these; tone: None where the curve is known."""

    offset: float
    slope: float
    covariance: Array
    share: float
    contrast_dn: float
    noise_dn: float
    blur_px: float
    likeness: float
    count: int
    tone: EdgeTone | None = None


@dataclass(frozen=True, eq=False)
class Course:
    """Where an edge is expected to run: from the start (2,) in the scan along, the frame's inside lying across, both
    (2,) of length 1."""

    scan: Scan
    start: Array
    along: Array
    across: Array
    weights: Sequence[float] | None

    def profiles(self, middle: Array, offset: Array, share: float, half: float) -> tuple[Array, Mask]:
        """(n, samples) light across the edge about an offset (n,), each the median over its share of the edge, and
        which of them lie in the scan. A median is the same through any curve, and where noise is cut off at black."""
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
        grey = map_coordinates(window, [row, col], order=1, mode="nearest")
        limit = np.array([self.scan.width_px, self.scan.height_px])[:, None, None, None] - 1
        inside = ((places >= 0) & (places <= limit)).all(axis=(0, 2, 3))
        return np.asarray(np.median(grey, axis=1), dtype=float), np.asarray(inside)


def edge_along(
    course: Course, extent: tuple[float, float], search_px: float, polarity: int, count: int = PROFILES
) -> Edge | None:
    """The edge that runs along from the start between two distances, px; None where it is not to be seen as one line.
    polarity: 1 where the frame's inside is lighter than its outside, -1 where it is darker, 0 where nobody knows;
    count: of profiles."""
    share = (extent[1] - extent[0]) / count
    middle: Array = np.asarray(extent[0] + share * (np.arange(count) + 0.5), dtype=float)
    half = round(search_px + _ABOUT_PX)
    near, inside = course.profiles(middle, np.zeros(count), share, half)
    near, middle = near[inside], middle[inside]
    if len(middle) < _LEAST_SHARE * count:
        return None
    if not polarity:
        polarity = int(np.sign(np.median(near[:, -1] - near[:, 0])))
    line = _straightest(near * polarity, middle, half)
    found, _ = course.profiles(middle, line[0] + line[1] * middle, share, _ABOUT_PX)
    steps = _fit_steps(found)
    good = steps.good & (steps.contrast * polarity > FAINT * course.scan.full_scale_dn)
    good &= np.abs(steps.contrast) > _LEAST_SNR * steps.noise
    if good.sum() < _LEAST_SHARE * count:
        return None
    place = line[0] + line[1] * middle[good] + steps.place[good]
    return _line(course.scan, middle[good], place, steps, good, len(middle))


def pool_edge_tones(edges: Sequence[EdgeTone], tone: Tone) -> ToneInformation:
    """What several of them say of the curve by which they were fitted, known as well as the scatter of their profiles
    says, and that from edge to edge: what is alike along an edge, a landscape or what JPEG made of it, counts once."""
    scores, normal, floor = (
        np.concatenate([getattr(edge, name) for edge in edges]) for name in ("scores", "normal", "floor")
    )
    least = floor.mean(axis=0)
    by_profile = np.cov(scores.T) + least + _LEAST * np.trace(least) * np.eye(len(least))
    off = np.array([(edge.scores - scores.mean(axis=0)).sum(axis=0) / np.sqrt(len(edge.scores)) for edge in edges])
    square = float(np.sum(off * np.linalg.solve(by_profile, off.T).T))
    more = max(square / (scores.shape[1] * max(len(edges) - 1, 1)), 1.0)
    total = normal.sum(axis=0)
    return ToneInformation.from_score(total, scores.sum(axis=0) + total @ tone.mean, more * len(scores) * by_profile)


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
    """(n,) of every profile: where it steps (px), by how much, under which blur, and how well that describes it; drawn,
    residuals (n, samples) and design (n, samples, 4): the light by that, what it leaves, and its derivatives."""

    place: Array
    contrast: Array
    blur: Array
    noise: Array
    likeness: Array
    good: Mask
    drawn: Array
    residuals: Array
    design: Array


def _fit_steps(grey: Array) -> _Steps:
    """The step level + contrast * Phi((s - place) / blur) in every profile, by Gauss-Newton."""
    s = (np.arange(grey.shape[1]) - (grey.shape[1] - 1) / 2) * _STEP_PX
    count = len(grey)
    place, blur = np.zeros(count), np.full(count, _START_BLUR_PX)
    contrast, level = np.zeros(count), np.zeros(count)
    for rounds_left in range(_ITERATIONS, -1, -1):
        z = (s - place[:, None]) / blur[:, None]
        step = (1 + erf(z / np.sqrt(2))) / 2
        slope = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) / blur[:, None]
        level, contrast = _linear(step, grey)
        by_place, by_blur = -contrast[:, None] * slope, -contrast[:, None] * slope * z
        design = np.stack([by_place, by_blur, step, np.ones_like(step)], axis=1)
        residuals = grey - level[:, None] - contrast[:, None] * step
        if not rounds_left:
            break
        change = gauss_newton_step(design, residuals, np.ones_like(residuals), _DAMPING)
        place = place + np.clip(change[:, 0], -1.0, 1.0)
        blur = np.clip(blur + np.clip(change[:, 1], -0.5, 0.5), *_BLUR_RANGE_PX)
    noise = np.sqrt((residuals**2).mean(axis=1))
    spread = np.maximum(grey.std(axis=1), 1e-12)
    likeness = np.sqrt(np.clip(1 - (noise / spread) ** 2, 0.0, 1.0))
    good = np.abs(place) < s[-1] - _RIM_PX
    return _Steps(place, contrast, blur, noise, likeness, good, grey - residuals, residuals, design.swapaxes(1, 2))


def _linear(step: Array, grey: Array) -> tuple[Array, Array]:
    """Level and contrast (n,) that put the steps best through the grey values."""
    centred = step - step.mean(axis=1, keepdims=True)
    contrast = (centred * grey).sum(axis=1) / np.maximum((centred**2).sum(axis=1), 1e-12)
    return grey.mean(axis=1) - contrast * step.mean(axis=1), contrast


def _line(scan: Scan, along: Array, across: Array, steps: _Steps, good: Mask, asked: int) -> Edge | None:
    """Tukey's line, its covariance from the scatter about it and from how far along the edge that is alike."""
    design = np.stack([np.ones_like(along), along])
    line = tukey_fit(design, across, _ROUNDS, _SCATTER_FLOOR_PX)
    residuals, on = line.residuals, line.weights > 0
    if on.sum() < _LEAST_SHARE * asked:
        return None
    weighted = design * line.weights
    inverse = np.linalg.inv(weighted @ design.T)
    variance = float((residuals[on] ** 2).sum() / max(int(on.sum()) - 2, 1)) + _SCATTER_FLOOR_PX**2
    kept = np.flatnonzero(good)[on]
    return Edge(
        float(line.factors[0]),
        float(line.factors[1]),
        np.asarray(inverse * variance * _alike(residuals, on), dtype=float),
        float(on.sum() / asked),
        float(np.median(steps.contrast[kept])),
        float(np.median(steps.noise[kept])),
        float(np.median(steps.blur[kept])),
        float(np.median(steps.likeness[kept])),
        int(on.sum()),
        None if scan.tone.is_known else _edge_tone(scan, steps, kept, np.asarray(inverse @ weighted)[:, on]),
    )


def _alike(residuals: Array, on: Mask) -> float:
    """How many neighbouring residuals count as one, their correlation falling geometrically with the distance."""
    pairs = on[1:] & on[:-1]
    if not pairs.any():
        return 1.0
    next_to = float((residuals[1:] * residuals[:-1])[pairs].mean() / max((residuals[on] ** 2).mean(), 1e-12))
    alike = float(np.clip(next_to, 0.0, _MOST_ALIKE))
    return (1 + alike) / (1 - alike)


def _edge_tone(scan: Scan, steps: _Steps, kept: NDArray[np.intp], by_place: Array) -> EdgeTone:
    """By the profiles kept, (n,) of all; by_place (2, n): derivatives of the line's offset and slope by their places.

    As `fitting.tone_estimate` has it for marks. Light that is uneven on either side says nothing of the curve, nor does
    the shape of the blur, as long as it is even; pixels and what lies between them make it no Gaussian."""
    drawn, design = steps.drawn[kept], steps.design[kept]
    z = ((np.arange(drawn.shape[1]) - (drawn.shape[1] - 1) / 2) * _STEP_PX - steps.place[kept, None])[..., None]
    z = z / steps.blur[kept, None, None]
    changes = np.moveaxis(scan.tone.derivatives(drawn, scan.full_scale_dn), 0, -1)
    s = np.linspace(-1.0, 1.0, drawn.shape[1])[:, None]
    step, slope = design[:, :, 2:3], design[:, :, :1]
    by_shape = [slope * z**3, slope * z**5]
    uneven = np.concatenate([design, *by_shape, step * s, step * s**2, 0 * step + s, 0 * step + s**2], axis=2)
    left = changes - uneven @ np.linalg.pinv(uneven) @ changes
    own = left * (_DRAWN * steps.contrast[kept, None, None])
    codes = scan.tone.code(np.quantile(drawn, (0.0, 1.0)), scan.full_scale_dn) / scan.full_scale_dn
    return EdgeTone(
        scores=-np.einsum("nsk,ns->nk", left, steps.residuals[kept]),
        normal=np.einsum("nsk,nsj->nkj", left, changes),
        floor=np.einsum("nsk,nsj->nkj", own, own),
        on_line=by_place @ (np.linalg.pinv(design) @ changes)[:, 0],
        least=float(codes[0]),
        greatest=float(codes[1]),
    )


# Corners of the exposed frame: the edge of the frame along both sides, each a straight line, and where they meet.
#
# What is rounded at the corner is left out.


def fit_frame_corner(
    scan: Scan,
    mark: FrameCorner,
    pixel_from_mark: Array,
    search_px: float,
    polarity: int,
    weights: Sequence[float] | None = None,
) -> MarkFit:
    """The mark, within the search radius of its predicted place, its frame being lighter than its border or darker as
    the polarity says. Not converged, with a reason, where either edge is not to be seen."""
    inward = pixel_from_mark[:, :2] * np.array(mark.toward)  # columns: along x', y' into the frame, px per mm
    per_mm = np.hypot(*inward)
    unit = inward / per_mm
    edges = []
    for side in (0, 1):
        along, across = unit[:, side], unit[:, 1 - side]
        reach = mark.reach_mm * per_mm[side]
        first = max(mark.radius_mm * per_mm[side], _ROUNDED * reach)
        course = Course(scan, pixel_from_mark[:, 2], along, across, weights)
        edge = edge_along(course, (first, reach), search_px, polarity)
        if edge is None:
            return _missed(pixel_from_mark, _UNSEEN)
        edges.append(edge)
    return _intersect_edges(edges, unit, pixel_from_mark, scan.tone)


def _intersect_edges(edges: Sequence[Edge], unit: Array, pixel_from_mark: Array, tone: Tone) -> MarkFit:
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
    return MarkFit(
        converged=True,
        reason=NO_REASON,
        center_px=center,
        place_covariance=Covariance.from_noise(unit @ covariance @ unit.T),
        pixel_from_mark=np.column_stack([pixel_from_mark[:, :2], center]),
        contrast_dn=contrast,
        stored_contrast_dn=contrast,
        noise_dn=noise,
        blur_px=max(edge.blur_px for edge in edges),
        damaged_fraction=1.0 - min(edge.share for edge in edges),
        lost_fraction=0.0,
        redundancy=sum(edge.count for edge in edges) - 4,
        neighbour_correlation=0.0,
        covariance_is_white=False,
        likeness=min(edge.likeness for edge in edges),
        significance=abs(contrast) / max(noise, 1e-12) * float(np.sqrt(min(edge.count for edge in edges))),
        tone=_corner_tone(first, second, unit @ by_first, unit @ by_second, tone),
    )


def _corner_tone(first: Edge, second: Edge, by_first: Array, by_second: Array, tone: Tone) -> MarkTone | None:
    """by_first, by_second (2, 2): derivatives of the corner's column and row by an edge's offset and slope."""
    if first.tone is None or second.tone is None:
        return None
    return MarkTone(
        pool_edge_tones([first.tone, second.tone], tone),
        by_first @ first.tone.on_line + by_second @ second.tone.on_line,
        min(first.tone.least, second.tone.least),
        max(first.tone.greatest, second.tone.greatest),
    )


def _missed(pixel_from_mark: Array, reason: Reason) -> MarkFit:
    return MarkFit(
        converged=False,
        reason=reason,
        center_px=pixel_from_mark[:, 2],
        place_covariance=Covariance.from_noise(np.full((2, 2), np.inf)),
        pixel_from_mark=pixel_from_mark,
        contrast_dn=0.0,
        stored_contrast_dn=0.0,
        noise_dn=0.0,
        blur_px=0.0,
        damaged_fraction=1.0,
        lost_fraction=1.0,
        redundancy=0,
        neighbour_correlation=0.0,
        covariance_is_white=True,
        likeness=0.0,
        significance=0.0,
    )
