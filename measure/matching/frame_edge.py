"""An edge of the exposed frame: a straight line, by many profiles across it; a corner of the frame, where two meet.

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

from measure.array_types import Array, Mask
from measure.flags import NO_REASON, Code, Reason
from measure.marks.shapes import FrameCorner
from measure.matching.window import FAINT
from measure.noise.robust_estimation import gauss_newton_step, tukey_fit
from measure.results import Covariance, MarkFit
from measure.scans.scan import Scan
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import MarkTone
from measure.tone.score import ToneScore, tone_score

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
_BLUR_RANGE_PX = (0.3, 4.0)  # from where pixels hide it to where an edge is no line
_SCATTER_FLOOR_PX = 0.01  # under the scatter about a line: clean pictures have none
_LEAST = 1e-6  # of the variance of all that edges show: what they hardly show
_DRAWN = 0.005  # of a step: what is left of it below that may be the drawing's own
_ROUNDED = 0.1  # of the reach: left out at every corner, for few are sharp


@dataclass(frozen=True, eq=False)
class EdgeTone:
    """What an edge says of the tone curve. score: of each profile; floor (k, k): the least covariance of one profile's;
    on_line (2, k): by how much the offset and slope change for each departure of 1. codes: the least and the greatest,
    shares of full scale, between which it steps."""

    score: ToneScore
    floor: Array
    on_line: Array
    codes: Array


@dataclass(frozen=True, eq=False)
class Edge:
    """across = offset + slope * along, px from the start, line (2,) being both, and covariance (2, 2); share: of the
    profiles that lie on it, of which there are count; contrast_dn, noise_dn, blur_px, likeness: medians over these;
    tone: None where the curve is known."""

    line: Array
    covariance: Array
    share: float
    count: int
    contrast_dn: float
    noise_dn: float
    blur_px: float
    likeness: float
    tone: EdgeTone | None


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
        samples = np.arange(-round(half / _STEP_PX), round(half / _STEP_PX) + 1) * _STEP_PX
        run = np.linspace(-0.5, 0.5, max(int(share), 2), endpoint=False) * share
        slope = np.gradient(offset, middle) if len(middle) > 1 else np.zeros(1)
        along = (middle[:, None] + run)[..., None, None] * self.along
        across = (offset[:, None] + slope[:, None] * run)[..., None] + samples
        places = self.start + along + across[..., None] * self.across  # (n, run, samples, 2)
        low = np.floor(places.min(axis=(0, 1, 2))).astype(int) - 2
        size = np.ceil(places.max(axis=(0, 1, 2))).astype(int) + 3 - low
        window = self.scan.light(int(low[0]), int(low[1]), int(size[0]), int(size[1]), self.weights)
        grey = map_coordinates(window, np.moveaxis(places - low, -1, 0)[::-1], order=1, mode="nearest")
        inside = (places >= 0) & (places <= np.array([self.scan.width_px, self.scan.height_px]) - 1)
        return np.asarray(np.median(grey, axis=1), dtype=float), np.asarray(inside.all(axis=(1, 2, 3)))


def edge_along(
    course: Course, extent: tuple[float, float], search_px: float, polarity: int, count: int = PROFILES
) -> Edge | None:
    """Measure the edge of the frame along a course.

    Parameters
    ----------
    course : Course
        Where it is expected.
    extent : (float, float)
        From which to which distance from the start, px.
    search_px : float
        How far from the course it may lie.
    polarity : int
        1 where the frame's inside is lighter than its outside, -1 where it is darker, 0 where nobody knows.
    count : int
        Of profiles.

    Returns
    -------
    Edge, or None where no straight line is to be seen.
    """
    share = (extent[1] - extent[0]) / count
    middle: Array = np.asarray(extent[0] + share * (np.arange(count) + 0.5), dtype=float)
    half = round(search_px + _ABOUT_PX)
    near, inside = course.profiles(middle, np.zeros(count), share, half)
    near, middle = near[inside], middle[inside]
    if len(middle) < _LEAST_SHARE * count:
        return None
    polarity = polarity or int(np.sign(np.median(near[:, -1] - near[:, 0])))
    offset, slope = _straightest(near * polarity, middle, half)
    steps = _fit_steps(course.profiles(middle, offset + slope * middle, share, _ABOUT_PX)[0])
    good = steps.good & (steps.contrast * polarity > FAINT * course.scan.full_scale_dn)
    good &= np.abs(steps.contrast) > _LEAST_SNR * steps.noise
    if good.sum() < _LEAST_SHARE * count:
        return None
    return _fit_line(course.scan, middle, offset + slope * middle + steps.place, steps, good)


def pool_edge_tones(edges: Sequence[EdgeTone], tone: Tone) -> ToneInformation:
    """What several of them say of the curve by which they were fitted, known as well as the scatter of their profiles
    says, and that from edge to edge: what is alike along an edge, a landscape or what JPEG made of it, counts once."""
    values = np.concatenate([edge.score.value for edge in edges])
    normals = np.concatenate([edge.score.normal for edge in edges])
    least = np.average([edge.floor for edge in edges], axis=0, weights=[len(edge.score.value) for edge in edges])
    by_profile = np.cov(values.T) + least + _LEAST * np.trace(least) * np.eye(len(least))
    off = np.array(
        [(edge.score.value - values.mean(axis=0)).sum(axis=0) / np.sqrt(len(edge.score.value)) for edge in edges]
    )
    square = float(np.sum(off * np.linalg.solve(by_profile, off.T).T))
    more = max(square / (len(least) * max(len(edges) - 1, 1)), 1.0)
    return ToneScore(off, values, normals, off).information(more * len(values) * by_profile, tone)


def _straightest(grey: Array, along: Array, half: float) -> tuple[float, float]:
    """Offset and slope of the straight line along which most profiles step up: a stone's edge may be stronger in some
    of them, and so counts no more there than the frame's does elsewhere."""
    rise = np.gradient(cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX / _STEP_PX, sigmaY=1e-3), axis=1)
    rise = np.clip(rise, 0.0, float(np.median(rise.max(axis=1))))
    middle, samples = float(along.mean()), np.arange(grey.shape[1])
    tilts = np.linspace(-_TILT, _TILT, 2 * int(np.ceil(_TILT * float(np.ptp(along)) / 2 / _STEP_PX)) + 1)
    votes = np.empty((len(tilts), grey.shape[1]))
    for index, tilt in enumerate(tilts):
        column = samples + np.rint(tilt * (along - middle) / _STEP_PX).astype(int)[:, None]
        inside = (column >= 0) & (column < len(samples))
        votes[index] = (np.take_along_axis(rise, np.clip(column, 0, len(samples) - 1), axis=1) * inside).sum(axis=0)
    best, place = np.unravel_index(int(votes.argmax()), votes.shape)
    return float(place * _STEP_PX - half - tilts[best] * middle), float(tilts[best])


@dataclass(frozen=True, eq=False)
class _Steps:
    """(n,) of every profile: where it steps (px), by how much, under which blur, and how well that describes it; drawn,
    residuals (n, samples) and design (n, 4, samples): the light by that, what it leaves, and its derivatives."""

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
    s = _samples(grey)
    place, blur = np.zeros((len(grey), 1)), np.full((len(grey), 1), _START_BLUR_PX)
    for rounds_left in range(_ITERATIONS, -1, -1):
        z = (s - place) / blur
        step = (1 + erf(z / np.sqrt(2))) / 2
        slope = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) / blur
        centred = step - step.mean(axis=1, keepdims=True)
        squares = np.maximum((centred**2).sum(axis=1, keepdims=True), 1e-12)
        contrast = (centred * grey).sum(axis=1, keepdims=True) / squares
        residuals = grey - grey.mean(axis=1, keepdims=True) - contrast * centred
        design = np.stack([-contrast * slope, -contrast * slope * z, step, np.ones_like(step)], axis=1)
        if rounds_left:
            change = gauss_newton_step(design, residuals, np.ones_like(residuals), _DAMPING)
            place = place + np.clip(change[:, :1], -1.0, 1.0)
            blur = np.clip(blur + np.clip(change[:, 1:2], -0.5, 0.5), *_BLUR_RANGE_PX)
    noise = np.sqrt((residuals**2).mean(axis=1))
    likeness = np.sqrt(np.clip(1 - (noise / np.maximum(grey.std(axis=1), 1e-12)) ** 2, 0.0, 1.0))
    good = np.abs(place[:, 0]) < s[-1] - _RIM_PX
    return _Steps(place[:, 0], contrast[:, 0], blur[:, 0], noise, likeness, good, grey - residuals, residuals, design)


def _samples(profiles: Array) -> Array:
    """(samples,) px across the edge, of profiles (n, samples)."""
    return np.asarray((np.arange(profiles.shape[1]) - (profiles.shape[1] - 1) / 2) * _STEP_PX)


def _fit_line(scan: Scan, along: Array, across: Array, steps: _Steps, good: Mask) -> Edge | None:
    """Tukey's line through the good profiles, its covariance from the scatter about it and from how far along the edge
    that is alike."""
    design = np.stack([np.ones_like(along), along])[:, good]
    line = tukey_fit(design, across[good], _ROUNDS, _SCATTER_FLOOR_PX)
    residuals, on, share = line.residuals, line.weights > 0, float((line.weights > 0).sum() / len(along))
    if share < _LEAST_SHARE:
        return None
    weighted, kept, count = design * line.weights, np.flatnonzero(good)[on], int(on.sum())
    inverse = np.linalg.inv(weighted @ design.T)
    variance = float((residuals[on] ** 2).sum() / max(count - 2, 1)) + _SCATTER_FLOOR_PX**2
    contrast, noise, blur, likeness = (
        float(np.median(each[kept])) for each in (steps.contrast, steps.noise, steps.blur, steps.likeness)
    )
    return Edge(
        line.factors,
        np.asarray(inverse * variance * _alike(residuals, on), dtype=float),
        share,
        count,
        contrast,
        noise,
        blur,
        likeness,
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

    Light that is uneven on either side says nothing of the curve, nor does the shape of the blur, as long as it is
    even; pixels and what lies between them make it no Gaussian."""
    drawn, design = steps.drawn[kept], steps.design[kept]
    z = (_samples(drawn) - steps.place[kept, None]) / steps.blur[kept, None]
    changes = np.moveaxis(scan.tone.derivatives(drawn, scan.full_scale_dn), 0, 1)
    s, step, slope = np.linspace(-1.0, 1.0, drawn.shape[1]), design[:, 2], design[:, 0]
    uneven = [
        slope * z**3,
        slope * z**5,
        step * s,
        step * s**2,
        np.broadcast_to(s, z.shape),
        np.broadcast_to(s**2, z.shape),
    ]
    score = tone_score(np.concatenate([design, np.stack(uneven, axis=1)], axis=1), changes, steps.residuals[kept])
    own = score.left * (_DRAWN * steps.contrast[kept, None, None])
    moved = tone_score(design, changes, steps.residuals[kept]).by_unknown[:, 0]
    codes = scan.tone.code(np.quantile(drawn, (0.0, 1.0)), scan.full_scale_dn) / scan.full_scale_dn
    return EdgeTone(score, np.mean(own @ own.swapaxes(1, 2), axis=0), by_place @ moved, codes)


def fit_frame_corner(
    scan: Scan,
    mark: FrameCorner,
    pixel_from_mark: Array,
    search_px: float,
    polarity: int,
    weights: Sequence[float] | None = None,
) -> MarkFit:
    """Fit a corner of the exposed frame: the edges along both sides, each a straight line, and where they meet. What is
    rounded at the corner is left out.

    Parameters
    ----------
    pixel_from_mark, search_px
        Where the corner is predicted, (2, 3), and how far from there it may lie.
    polarity : int
        Whether its frame is lighter (1) or darker (-1) than its border.
    weights : optional
        Of the scan's channels.

    Returns
    -------
    MarkFit
        Not converged, with a reason, where either edge is not to be seen.
    """
    inward = pixel_from_mark[:, :2] * np.array(mark.toward)  # columns: along x', y' into the frame, px per mm
    per_mm = np.hypot(*inward)
    unit = inward / per_mm
    edges = []
    for side in (0, 1):
        reach = mark.reach_mm * per_mm[side]
        first = max(mark.radius_mm * per_mm[side], _ROUNDED * reach)
        course = Course(scan, pixel_from_mark[:, 2], unit[:, side], unit[:, 1 - side], weights)
        edge = edge_along(course, (first, reach), search_px, polarity)
        if edge is None:
            unseen = Reason("an edge of the frame is not visible there as one line", Code.NOT_FOUND)
            nothing = Covariance.from_noise(np.full((2, 2), np.inf))
            return MarkFit(False, unseen, pixel_from_mark[:, 2], nothing, pixel_from_mark)
        edges.append(edge)
    return _intersect_edges(edges, unit, pixel_from_mark, scan.tone)


def _intersect_edges(edges: Sequence[Edge], unit: Array, pixel_from_mark: Array, tone: Tone) -> MarkFit:
    """The corner: along the first edge x, y = a + b x, and along the second x = c + d y."""
    (a, b), (c, d) = (edge.line for edge in edges)
    scale = 1 / (1 - b * d)
    x, y = scale * (c + d * a), scale * (a + b * c)
    # Of column and row by each edge's offset and slope.
    by_lines = [unit @ (scale * np.array(by)) for by in ([[d, d * x], [1.0, x]], [[1.0, y], [b, b * y]])]
    covariance = sum(by @ edge.covariance @ by.T for by, edge in zip(by_lines, edges, strict=True))
    center = pixel_from_mark[:, 2] + unit @ (x, y)
    noise, least = max(edge.noise_dn for edge in edges), min(edge.count for edge in edges)
    contrast = min((edge.contrast_dn for edge in edges), key=abs)
    tones = [edge.tone for edge in edges if edge.tone is not None]
    return MarkFit(
        converged=True,
        reason=NO_REASON,
        center_px=center,
        place_covariance=Covariance.from_noise(np.asarray(covariance)),
        pixel_from_mark=np.column_stack([pixel_from_mark[:, :2], center]),
        contrast_dn=contrast,
        stored_contrast_dn=contrast,
        noise_dn=noise,
        blur_px=max(edge.blur_px for edge in edges),
        damaged_fraction=1.0 - min(edge.share for edge in edges),
        redundancy=sum(edge.count for edge in edges) - 4,
        likeness=min(edge.likeness for edge in edges),
        significance=abs(contrast) / max(noise, 1e-12) * float(np.sqrt(least)),
        tone=None if len(tones) < len(edges) else _corner_tone(tones, by_lines, tone),
    )


def _corner_tone(tones: Sequence[EdgeTone], by_lines: Sequence[Array], tone: Tone) -> MarkTone:
    """by_lines (2, 2) each: derivatives of the corner's column and row by an edge's offset and slope."""
    on_place = sum(by @ each.on_line for by, each in zip(by_lines, tones, strict=True))
    least, greatest = min(each.codes[0] for each in tones), max(each.codes[1] for each in tones)
    return MarkTone(pool_edge_tones(tones, tone), np.asarray(on_place), float(least), float(greatest))
