"""Measurement of frame edges as straight lines through many edge profiles, and of frame corners as their intersection.

Across an edge the light is a step blurred by the scanner, an error function, which is fitted to every profile. The line
through the profiles is fitted robustly (Tukey), since stamps, dust and marks lie on the edge, too. The contrast of the
background with the border differs from profile to profile, the place does not. The edge of a neighbouring frame has
the opposite polarity.

A wrong tone curve leaves the same residuals in all profiles; their scatter gives the covariance of its estimate.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import erf

from measure.array_types import Array, Indices, Mask
from measure.flags import NO_REASON, Code, Reason
from measure.marks.shapes import FrameCorner
from measure.matching.gauss_newton import FitModel, gauss_newton
from measure.matching.window import FAINT, Coding
from measure.noise.robust_estimation import tukey_fit
from measure.results import Covariance, MarkFit
from measure.scans.scan import Scan
from measure.tone.curve import ToneInformation
from measure.tone.estimate import MarkTone, tone_score

_PROFILES = 60  # profiles along an edge, each the median over its section
_LEAST_SHARE = 0.5  # fraction of the profiles that must lie on the line; with fewer it may be a different line
_LEAST_SNR = 3.0  # of the step in one profile; less may be texture
_ABOUT_PX = 5.0  # px on either side of the line, enough for an edge under any usual blur
_STEP_PX = 0.5  # px, sampling interval across the edge
_SMOOTH_PX = 1.5  # px, smoothing across the edge before differentiation
_TILT = 0.02  # rad, search range of the edge's direction around the predicted one
_ITERATIONS, _SETTLED_PX, _DAMPING = 12, 1e-4, 1e-9  # Gauss-Newton steps of the profiles, last one, and their damping
_ROUNDS = 20  # iterations of the robust line, which converges after a few
_START_BLUR_PX = 1.5  # px, typical of scans
_RIM_PX = 2.0  # px: a step so near the end of a profile may belong to a different edge
_MOST_ALIKE = 0.9  # limit of the correlation of neighbouring profiles: 19 then count as one
_BLUR_RANGE_PX = (0.3, 4.0)  # px: smaller blur is hidden by the pixel, with larger blur an edge is no line
_SCATTER_FLOOR_PX = 0.01  # px, floor of the scatter around a line, which is zero in clean images
_LEAST = 1e-6  # regularisation, fraction of the trace of the covariance floor
_DRAWN = 0.005  # fraction of the step: smaller residuals may be errors of the model
_ROUNDED = 0.1  # fraction of the reach excluded at every corner, since few corners are sharp


def fit_frame_corner(
    scan: Scan,
    mark: FrameCorner,
    pixel_from_mark: Array,
    search_px: float,
    polarity: int,
    weights: Sequence[float] | None = None,
) -> MarkFit:
    """Fit a corner of the exposed frame as the intersection of its two straight edges, excluding the rounded part.

    pixel_from_mark: predicted place, at most search_px off; polarity: 1 if the frame is lighter than its border, -1 if
    darker; weights: of the scan's channels.

    Returns
    -------
    MarkFit
        Not converged, with a reason, if either edge is not found.
    """
    inward = pixel_from_mark[:, :2] * np.array(mark.toward)  # columns: along x', y' into the frame, px per mm
    per_mm = np.hypot(*inward)
    unit, reach = inward / per_mm, mark.reach_mm * per_mm
    first = np.maximum(mark.radius_mm * per_mm, _ROUNDED * reach)
    edges = []
    for side in (0, 1):
        course = _Course(scan, pixel_from_mark[:, 2], unit[:, side], unit[:, 1 - side], weights)
        edge = _find_edge(course, (float(first[side]), float(reach[side])), search_px, polarity)
        if edge is None:
            unseen = Reason("an edge of the frame is not visible there as one line", Code.NOT_FOUND)
            nothing = Covariance.from_noise(np.full((2, 2), np.inf))
            return MarkFit(False, unseen, pixel_from_mark[:, 2], nothing, pixel_from_mark)
        edges.append(edge)
    return _intersect_edges(edges, unit, pixel_from_mark)


@dataclass(frozen=True, eq=False)
class _Course:
    """Expected course of an edge: start (2,) px in the scan, unit vectors along (2,) the edge and across (2,) towards
    the inside of the frame; weights: of the channels."""

    scan: Scan
    start: Array
    along: Array
    across: Array
    weights: Sequence[float] | None

    def profiles(self, middle: Array, offset: Array, share: float, half: float) -> tuple[Array, Mask]:
        """(n, samples) light across the edge around an offset (n,), each the median over its section of the edge, and
        mask (n,) of the profiles inside the scan. A median is invariant under any tone curve and under clipping at
        black."""
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


def _straightest(grey: Array, along: Array, half: float) -> tuple[float, float]:
    """Offset and slope of the straight line on which most profiles step up (Hough transform). Gradients are limited to
    their median maximum, so that a strong edge in a few profiles does not outweigh the frame's."""
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


class _Steps(FitModel):
    """Steps ground + contrast * Phi((s - place) / blur) fitted to n profiles.

    place (px), contrast (light), stored_contrast (grey values of the file), blur (px), noise (light), likeness: (n,)
    each; drawn: (n, samples) model.
    """

    damping = _DAMPING

    def __init__(self, light: Array, coding: Coding) -> None:
        """Fit a step to every profile (n, samples) of light. coding: of the scan."""
        super().__init__(len(light))
        self.light, self.place, self.contrast = light, np.zeros(len(light)), np.zeros(len(light))
        self.blur = np.full(len(light), _START_BLUR_PX)
        self.design, self.residuals = np.zeros((len(light), 4, light.shape[1])), np.zeros_like(light)
        self.linearise(self.every)
        gauss_newton(self, self.every, _SETTLED_PX, _ITERATIONS)
        self.noise = np.sqrt((self.residuals**2).mean(axis=1))
        self.likeness = np.sqrt(np.clip(1 - (self.noise / np.maximum(light.std(axis=1), 1e-12)) ** 2, 0.0, 1.0))
        ground, self.drawn = (light - self.contrast[:, None] * self.design[:, 2]).mean(axis=1), light - self.residuals
        self.stored_contrast = np.array(list(map(coding.stored_contrast_dn, ground.tolist(), self.contrast.tolist())))

    def step(self, fits: Indices, steps: Array) -> Array:
        """Apply steps of limited length and linearise there."""
        moves = np.clip(steps[:, 0], -1.0, 1.0)
        self.place[fits] += moves
        self.blur[fits] = np.clip(self.blur[fits] + np.clip(steps[:, 1], -0.5, 0.5), *_BLUR_RANGE_PX)
        self.linearise(fits)
        return np.abs(moves)

    def linearise(self, fits: Indices) -> None:
        """Compute contrast and ground by linear least squares, derivatives, and residuals."""
        light, blur = self.light[fits], self.blur[fits, None]
        z = (_samples(light) - self.place[fits, None]) / blur
        step, slope = (1 + erf(z / np.sqrt(2))) / 2, np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) / blur
        centred = step - step.mean(axis=1, keepdims=True)
        squares = np.maximum((centred**2).sum(axis=1, keepdims=True), 1e-12)
        contrast = (centred * light).sum(axis=1, keepdims=True) / squares
        self.contrast[fits] = contrast[:, 0]
        self.residuals[fits] = light - light.mean(axis=1, keepdims=True) - contrast * centred
        self.design[fits] = np.stack([-contrast * slope, -contrast * slope * z, step, np.ones_like(step)], axis=1)

    def select(self, kept: Mask) -> Self:
        chosen = copy(self)
        vars(chosen).update({name: each[kept] for name, each in vars(self).items() if isinstance(each, np.ndarray)})
        return chosen


def _samples(profiles: Array) -> Array:
    """(samples,) positions (px) across the edge."""
    return np.asarray((np.arange(profiles.shape[1]) - (profiles.shape[1] - 1) / 2) * _STEP_PX)


@dataclass(frozen=True, eq=False)
class _Edge:
    """Straight edge: across = offset + slope * along, in px from the start.

    line (2,): offset and slope; covariance (2, 2); steps: of the profiles on the line; share: of all profiles; tone:
    information on the tone curve, with derivatives of the line in place of a point, None where it is known.
    """

    line: Array
    covariance: Array
    steps: _Steps
    share: float
    tone: MarkTone | None


def _find_edge(course: _Course, extent: tuple[float, float], search_px: float, polarity: int) -> _Edge | None:
    """Measure the edge of the frame within search_px of a course, between two distances from its start; None if there
    is no straight one."""
    share = (extent[1] - extent[0]) / _PROFILES
    middle: Array = np.asarray(extent[0] + share * (np.arange(_PROFILES) + 0.5), dtype=float)
    half = round(search_px + _ABOUT_PX)
    near, inside = course.profiles(middle, np.zeros(_PROFILES), share, half)
    near, middle = near[inside], middle[inside]
    if len(middle) < _LEAST_SHARE * _PROFILES:
        return None
    offset, slope = _straightest(near * polarity, middle, half)
    profiles, _ = course.profiles(middle, offset + slope * middle, share, _ABOUT_PX)
    steps = _Steps(profiles, Coding(course.scan.tone, course.scan.full_scale_dn))
    good = np.abs(steps.place) < _samples(profiles)[-1] - _RIM_PX
    good &= steps.stored_contrast * polarity > FAINT * course.scan.full_scale_dn
    good &= np.abs(steps.contrast) > _LEAST_SNR * steps.noise
    if good.sum() < _LEAST_SHARE * _PROFILES:
        return None
    across, steps = (offset + slope * middle + steps.place)[good], steps.select(good)
    # The covariance of the robust line comes from the scatter around it and the correlation of that along the edge.
    design = np.stack([np.ones_like(across), middle[good]])
    line = tukey_fit(design, across, _ROUNDS, _SCATTER_FLOOR_PX)
    residuals, on, weighted = line.residuals, line.weights > 0, design * line.weights
    if on.sum() < _LEAST_SHARE * len(middle):
        return None
    inverse = np.linalg.inv(weighted @ design.T)
    variance = float((residuals[on] ** 2).sum() / max(int(on.sum()) - 2, 1)) + _SCATTER_FLOOR_PX**2
    covariance = np.asarray(inverse * variance * _alike(residuals, on), dtype=float)
    steps, by_place = steps.select(on), np.asarray(inverse @ weighted)[:, on]
    tone = None if course.scan.tone.is_known else _edge_tone(course.scan, steps, by_place)
    return _Edge(line.factors, covariance, steps, float(on.sum() / len(middle)), tone)


def _alike(residuals: Array, on: Mask) -> float:
    """Number of neighbouring residuals per independent one, for correlations that fall geometrically with distance."""
    pairs = on[1:] & on[:-1]
    if not pairs.any():
        return 1.0
    next_to = float((residuals[1:] * residuals[:-1])[pairs].mean() / max((residuals[on] ** 2).mean(), 1e-12))
    alike = float(np.clip(next_to, 0.0, _MOST_ALIKE))
    return (1 + alike) / (1 - alike)


def _edge_tone(scan: Scan, steps: _Steps, by_place: Array) -> MarkTone:
    """Information of n profiles on the tone curve. by_place (2, n): derivatives of the line by their places."""
    # Uneven light on either side and the symmetric part of the blur's shape are eliminated as further unknowns: pixels
    # and their interpolation make the blur non-Gaussian.
    drawn, design, residuals = steps.drawn, steps.design, steps.residuals
    z = (_samples(drawn) - steps.place[:, None]) / steps.blur[:, None]
    changes = np.moveaxis(scan.tone.derivatives(drawn, scan.full_scale_dn), 0, 1)
    s, step, slope = np.broadcast_to(np.linspace(-1.0, 1.0, drawn.shape[1]), z.shape), design[:, 2], design[:, 0]
    uneven = np.stack([slope * z**3, slope * z**5, step * s, step * s**2, s, s**2], axis=1)
    score = tone_score(np.concatenate([design, uneven], axis=1), changes, residuals)
    own = score.left * (_DRAWN * steps.contrast[:, None, None])
    least = np.mean(own @ own.swapaxes(1, 2), axis=0)
    by_profile = np.cov(score.value.T) + least + _LEAST * np.trace(least) * np.eye(len(least))
    moved = tone_score(design, changes, residuals).by_unknown[:, 0]
    codes = scan.tone.code(np.quantile(drawn, (0.0, 1.0)), scan.full_scale_dn) / scan.full_scale_dn
    information = score.information(len(drawn) * by_profile, scan.tone)
    return MarkTone(information, by_place @ moved, float(codes[0]), float(codes[1]))


def _intersect_edges(edges: Sequence[_Edge], unit: Array, pixel_from_mark: Array) -> MarkFit:
    """Intersect the first edge, y = a + b x, with the second, x = c + d y."""
    (a, b), (c, d) = (edge.line for edge in edges)
    scale = 1 / (1 - b * d)
    x, y = scale * (c + d * a), scale * (a + b * c)
    # Derivatives of column and row with respect to each edge's offset and slope.
    by_lines = [unit @ (scale * np.array(by)) for by in ([[d, d * x], [1.0, x]], [[1.0, y], [b, b * y]])]
    covariance = sum(by @ edge.covariance @ by.T for by, edge in zip(by_lines, edges, strict=True))
    center, counts = pixel_from_mark[:, 2] + unit @ (x, y), [len(edge.steps.place) for edge in edges]
    contrasts, stored_contrasts, noises, blurs, likenesses = (
        [float(np.median(getattr(edge.steps, name))) for edge in edges]
        for name in ("contrast", "stored_contrast", "noise", "blur", "likeness")
    )
    contrast, noise = min(contrasts, key=abs), max(noises)
    tones = [edge.tone for edge in edges if edge.tone is not None]
    return MarkFit(
        converged=True,
        reason=NO_REASON,
        center_px=center,
        place_covariance=Covariance.from_noise(np.asarray(covariance)),
        pixel_from_mark=np.column_stack([pixel_from_mark[:, :2], center]),
        contrast_dn=contrast,
        stored_contrast_dn=min(stored_contrasts, key=abs),
        noise_dn=noise,
        blur_px=max(blurs),
        damaged_fraction=1.0 - min(edge.share for edge in edges),
        redundancy=sum(counts) - 4,
        likeness=min(likenesses),
        significance=abs(contrast) / max(noise, 1e-12) * float(np.sqrt(min(counts))),
        tone=None if len(tones) < len(edges) else _corner_tone(tones, by_lines),
    )


def _corner_tone(tones: Sequence[MarkTone], by_lines: Sequence[Array]) -> MarkTone:
    """Combine the edges' information for a corner. by_lines: (2, 2) derivatives of the corner by each edge's line."""
    both = ToneInformation.pool([each.information for each in tones])
    # Errors common to an edge (background, JPEG) make the two disagree: a variance factor allows for them.
    misfit = both.sum_of_squares - both.right_side @ np.linalg.pinv(both.matrix, hermitian=True) @ both.right_side
    more = max(float(misfit) / (both.count - len(both.right_side)), 1.0)
    information = replace(
        both, matrix=both.matrix / more, right_side=both.right_side / more, sum_of_squares=both.sum_of_squares / more
    )
    on_place = np.asarray(sum(by @ each.on_place for by, each in zip(by_lines, tones, strict=True)))
    return MarkTone(information, on_place, min(each.least for each in tones), max(each.greatest for each in tones))
