"""A mark that is barely there, at a place that the other marks give: its lines against the texture about it.

Alone such a mark cannot be told from the many places where noise looks like it. Where the constellation is sure, only
those as strong and as near to the predicted place are its rivals: how many the texture would give is known (Adler, The
Geometry of Random Fields, 1981: excursions of a Gaussian field), and so is, from the same texture, how far it pulls
the mark from its true place. How strong the texture is beside the lines depends on the tone curve: where that is not
known, the mark is sought by two curves, and how far apart it is seen is in its covariance.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.detection.localisation import MarkPrediction
from measure.detection.mark_views import detail_px
from measure.flags import NO_REASON, Cause
from measure.marks.rendering import extent_px, picture
from measure.matching.window import FAINT, Coding
from measure.results import Covariance, MarkFit
from measure.scans.scan import Scan, means

_BACKGROUND = 1.2  # times the finest detail: the standard deviation of the blur that is taken for background
_TEXTURE = 2.0  # times that: over which the strength of the texture is averaged
_CLIP = 3.0  # times the texture's strength: stones and edges count no more
_RING = 30.0  # times the background's: how far about the mark the texture is asked
_SELF = 0.1  # of the mark's own response: what is below it tells of the texture alone
_SHOWN = 0.2  # of the mark's own weight: elsewhere the ground is too dark to tell
_LINE = 0.25  # of the strongest: what counts as the mark's lines
_ROUNDS = 8  # of rendering the mark anew where it was found, at most
_SETTLED_PX = 1e-3  # a move that needs no further one: a fiftieth of what a faint mark is known to
_STEP_PX = 0.5  # between the places by which a response's top is told
_OWN_LINEAR = 0.01  # by so much marks are turned (rad) and larger than the frame says: a real register glass's by 0.012
_LEAST_DISTANCE_PX = 1.0  # predictions are no better
_LEAST_PLACES = 200  # of the texture that a covariance can be taken from
_LEAST_NORM = 1e-6  # squared: where nothing shows of the mark nothing is divided by nothing
_FINEST_PX = 16.0  # of a mark's lines: what is wider is sought in a picture that is reduced so far


@dataclass(frozen=True, eq=False)
class FaintMark:
    """fit: the mark; its significance is in standard deviations of what the texture about it answers, and its
    covariance comes from that texture. false_alarms: how many answers as strong and as near the
    texture alone would give."""

    fit: MarkFit
    false_alarms: float

    @property
    def sigma_px(self) -> float:
        """The standard deviation of its place, in the direction in which that is known least."""
        parts = self.fit.place_covariance.parts
        place_px2 = sum((part for cause, part in parts.items() if cause != Cause.OWN_TURN), np.zeros((2, 2)))
        return float(np.sqrt(np.linalg.eigvalsh(place_px2)[-1]))


def detect_faint(scan: Scan, expected: MarkPrediction, extreme_dn: float, blur_px: float) -> FaintMark | None:
    """Find the strongest response to a mark within the search radius of its predicted place.

    Parameters
    ----------
    extreme_dn : float
        The lightest or darkest grey value of the scan, which a mark of that polarity cannot pass: on ground as light or
        as dark it does not show.
    blur_px : float
        Of the scan.

    Returns
    -------
    FaintMark, or None where there is no contrast by any curve that the scan's may be.
    """
    curves = scan.tone.plausible_curves
    fields = (_Field(scan.replace_tone(curve), expected, extreme_dn, blur_px) for curve in curves)
    found = [mark for field in fields if (mark := field.detect(expected.search_px)) is not None]
    if len(found) < len(curves):
        return None
    less_sure = max(found, key=lambda each: each.false_alarms)
    centers = np.array([each.fit.center_px for each in found])
    half, center = (centers[0] - centers[-1]) / 2, centers.mean(axis=0)
    fit = replace(
        less_sure.fit,
        center_px=center,
        pixel_from_mark=np.column_stack([less_sure.fit.pixel_from_mark[:, :2], center]),
        place_covariance=less_sure.fit.place_covariance.plus(Cause.TONE, np.outer(half, half)),
    )
    return FaintMark(fit, less_sure.false_alarms)


class _Field:
    """The window about a predicted place, freed of everything coarser than the mark's lines, step pixels of the scan to
    one of its own, in which all its places are."""

    def __init__(self, scan: Scan, expected: MarkPrediction, extreme_dn: float, blur_px: float) -> None:
        self.blur_px = blur_px
        self.step = step = max(1, int(detail_px(expected.mark, expected.linear) / _FINEST_PX))
        self.mark, self.linear, self.polarity = expected.mark, expected.linear / step, expected.polarity
        self.coarse_px = _BACKGROUND * detail_px(self.mark, self.linear)
        least, greatest = extent_px(self.mark, np.column_stack([self.linear, np.zeros(2)]))
        self.half = int(np.ceil(max(-least.min(), greatest.max()) + 2 * self.coarse_px)) + 1
        moves_px = _ROUNDS * _STEP_PX + 1.0  # between the pixels its place may lie farther off than was searched
        side = self.half + int(np.ceil(max(expected.search_px / step, _RING) + moves_px))
        first = np.floor(expected.center_px).astype(int) - side * step - step // 2
        self.origin = first + (step - 1) / 2
        self.predicted = (expected.center_px - self.origin) / step
        window = (int(first[0]), int(first[1]), *((2 * side + 1) * step,) * 2)
        light = _reduced(scan.light(*window, expected.weights), step)
        self.coding = Coding(None, scan.tone, scan.full_scale_dn)
        self.ground_dn = ground = np.asarray(cv2.GaussianBlur(light, (0, 0), self.coarse_px), np.float32)
        detail = light - ground
        spread = cv2.GaussianBlur(detail**2, (0, 0), _TEXTURE * self.coarse_px)
        least_dn = np.abs(self.coding.light_of_step_dn(ground, FAINT * scan.full_scale_dn))
        self.texture_dn: Array = np.sqrt(spread + least_dn**2)
        extreme = float(scan.tone.light(np.array(extreme_dn), scan.full_scale_dn))
        inside = _reduced(scan.inside(*window).astype(np.float32), step) == 1.0
        room_dn = np.maximum(self.polarity * (extreme - ground), 0.0)
        self.room_dn = np.where(inside, room_dn, 0.0).astype(np.float32)
        self.room = self.room_dn / self.texture_dn  # what a mark could change, over what the texture changes
        self.detail: Array = np.asarray(np.clip(detail / self.texture_dn, -_CLIP, _CLIP) * self.polarity, dtype=float)
        self.weighted = self.detail * self.room

    def detect(self, search_px: float) -> FaintMark | None:
        """The mark where the response is highest about its predicted place, None where nothing of its polarity is."""
        response = _Response(self, self.predicted)
        rows, cols = np.indices(response.value.shape)
        fraction = self.predicted - np.rint(self.predicted)
        near = search_px / self.step >= np.hypot(*(np.stack([cols, rows], axis=-1) + fraction - self.predicted).T).T
        row, col = np.unravel_index(int(np.where(near, response.value, -np.inf).argmax()), near.shape)
        if response.value[row, col] <= 0:
            return None
        response = _Response(self, np.array([col, row]) + fraction)
        for _ in range(_ROUNDS):
            top = response.top()
            if np.hypot(*(top - response.center)) < _SETTLED_PX:
                break
            response = _Response(self, top)
        return self._faint_mark(response)

    def template(self, off: Array) -> Array:
        """The mark with its centre off the middle pixel's, freed of what is coarse."""
        size = 2 * self.half + 1
        pixel_from_mark = np.column_stack([self.linear, off + self.half])
        shown = picture(self.mark, pixel_from_mark, size, size, self.blur_px / self.step)
        return np.asarray(shown - cv2.GaussianBlur(shown, (0, 0), self.coarse_px), dtype=float)

    def _faint_mark(self, response: "_Response") -> FaintMark | None:
        """What the response at the mark's place is worth, against what the texture about it answers."""
        pixel, patch, center = response.pixel, response.patch, response.center
        height = float(response.value[pixel])
        amplitude = height / float(response.norm[pixel])
        own = np.zeros_like(self.detail)
        own[patch] = amplitude * self.room[patch] ** 2 * response.template
        texture = self._texture(response, _correlated(own, response.template) / response.norm)
        bend = response.bend(own)[1]
        if texture.sum() < _LEAST_PLACES or not np.all(np.linalg.eigvalsh(bend) < 0):
            return None
        slopes = np.asarray(np.cov(response.slopes()[:, texture]), dtype=float)
        scatter = float(np.sqrt(np.mean(response.value[texture] ** 2)))
        inverse, place = np.linalg.inv(bend) * self.step, center * self.step + self.origin
        covariance = Covariance.from_noise(inverse @ slopes @ inverse)
        lines = np.abs(response.template)
        lit = lines * self.room[patch]
        shown, drawn = lit > _LINE * lit.max(), lines > _LINE * lines.max()
        room_dn, ground_dn, texture_dn = (
            float(np.average(image[patch], weights=lit)) for image in (self.room_dn, self.ground_dn, self.texture_dn)
        )
        pairs = texture[:, 1:] & texture[:, :-1]
        contrast_dn = self.polarity * amplitude * room_dn
        fit = MarkFit(
            converged=True,
            reason=NO_REASON,
            center_px=place,
            place_covariance=covariance.plus(Cause.OWN_TURN, self._leaning_px2(response)),
            pixel_from_mark=np.column_stack([self.linear * self.step, place]),
            contrast_dn=contrast_dn,
            stored_contrast_dn=self.coding.stored_contrast_dn(ground_dn, contrast_dn),
            noise_dn=texture_dn,
            blur_px=self.blur_px,
            damaged_fraction=max(1 - float(shown.sum() / drawn.sum()), 0.0),
            redundancy=int((lit > 0).sum()) - 3,
            neighbour_correlation=float(np.corrcoef(self.detail[:, 1:][pairs], self.detail[:, :-1][pairs])[0, 1]),
            likeness=min(height / float(np.linalg.norm(self.detail[patch][lit > _LINE / 5 * lit.max()])), 1.0),
            significance=height / scatter,
        )
        distance_px = max(float(np.hypot(*(center - self.predicted))), _LEAST_DISTANCE_PX)
        return FaintMark(fit, _false_alarms(height / scatter, slopes / scatter**2, distance_px))

    def _leaning_px2(self, response: "_Response") -> Array:
        """What the place of a mark whose lines lie to one side of its point takes from a turn and a size that are not
        quite the frame's, as if its lines were all in their middle."""
        lit = np.abs(response.template) * self.room[response.patch] ** 2
        rows, cols = np.indices(lit.shape) - self.half
        middle_px = self.step * (np.array([(lit * cols).sum(), (lit * rows).sum()]) / lit.sum() - response.fraction)
        return np.asarray(_OWN_LINEAR**2 * (middle_px @ middle_px) * np.eye(2))

    def _texture(self, response: "_Response", signal: Array) -> Mask:
        """Where about the mark responses are the texture's alone: on ground where the mark could show."""
        (row, col), (rows, cols) = response.pixel, np.indices(signal.shape)
        near = np.hypot(rows - row, cols - col) <= _RING
        whole = np.zeros(signal.shape, dtype=bool)
        whole[self.half : -self.half, self.half : -self.half] = True
        alone = np.abs(signal) < _SELF * signal[row, col]
        return np.asarray(near & whole & alone & (response.norm > _SHOWN * response.norm[row, col]))


class _Response:
    """What a field answers to a mark whose centre is off the pixels by as much as a centre is."""

    def __init__(self, field: _Field, center: Array) -> None:
        self.field, self.center = field, center
        self.fraction = center - np.rint(center)
        col, row = np.rint(center).astype(int).tolist()
        self.pixel, half = (row, col), field.half
        self.patch = slice(row - half, row + half + 1), slice(col - half, col + half + 1)

    @cached_property
    def templates(self) -> Array:
        """(3, 3, rows, columns): the mark with its centre _STEP_PX less, not, and as much more off in row and column: a
        line may be finer than the pixels are far apart, and how its picture changes between them no picture of whole
        pixels tells."""
        off = (-_STEP_PX, 0.0, _STEP_PX)
        return np.array([[self.field.template(self.fraction + np.array([col, row])) for col in off] for row in off])

    @cached_property
    def template(self) -> Array:
        """The mark as it looks so."""
        return self.field.template(self.fraction)

    @cached_property
    def norm(self) -> Array:
        """Of the weighted template at every pixel."""
        return np.sqrt(np.maximum(_correlated(self.field.room**2, self.template**2), 0.0) + _LEAST_NORM)

    @cached_property
    def value(self) -> Array:
        """The weighted correlation at every pixel."""
        return _correlated(self.field.weighted, self.template) / self.norm

    def top(self) -> Array:
        """Of the paraboloid through the responses about the centre, as near as it tells."""
        gradient, hessian = self.bend(self.field.weighted)
        if not np.all(np.linalg.eigvalsh(hessian) < 0):
            return self.center
        return np.asarray(self.center + np.clip(-np.linalg.solve(hessian, gradient), -_STEP_PX, _STEP_PX))

    def bend(self, weighted: Array) -> tuple[Array, Array]:
        """Gradient (2,) by (col, row) and Hessian (2, 2) of what a weighted picture answers to a mark at a centre that
        moves: of the paraboloid through nine answers, by least squares."""
        norm = np.sqrt(((self.field.room[self.patch] * self.template) ** 2).sum() + _LEAST_NORM)
        nine = np.einsum("rcij,ij->rc", self.templates, weighted[self.patch]) / norm
        by_col, by_row = nine.mean(axis=0), nine.mean(axis=1)
        gradient = np.array([by_col[2] - by_col[0], by_row[2] - by_row[0]]) / (2 * _STEP_PX)
        mixed = (nine[2, 2] + nine[0, 0] - nine[0, 2] - nine[2, 0]) / 4
        bends = [side[2] - 2 * side[1] + side[0] for side in (by_col, by_row)]
        return gradient, np.array([[bends[0], mixed], [mixed, bends[1]]]) / _STEP_PX**2

    def slopes(self) -> Array:
        """(2, rows, cols) by column and row, of the values."""
        by_col, by_row = (self.templates[1, 2] - self.templates[1, 0], self.templates[2, 1] - self.templates[0, 1])
        return np.stack([_correlated(self.field.weighted, by) / (2 * _STEP_PX) / self.norm for by in (by_col, by_row)])


def _reduced(picture: NDArray[np.floating], step: int) -> NDArray[np.floating]:
    return picture if step == 1 else np.asarray(means(picture[..., None], step)[..., 0])


def _false_alarms(strength: float, slopes: Array, radius_px: float) -> float:
    """How many maxima of at least this strength a Gaussian field of unit variance has in a circle, slopes (2, 2) being
    the covariance of its gradient: Adler's expected Euler characteristic of the excursion set."""
    density = np.sqrt(np.linalg.det(slopes)) * (2 * np.pi) ** -1.5 * strength * np.exp(-(strength**2) / 2)
    return float(np.pi * radius_px**2 * density)


def _correlated(image: NDArray[np.floating], template: NDArray[np.floating]) -> Array:
    return np.asarray(cv2.filter2D(np.asarray(image, np.float32), cv2.CV_32F, np.asarray(template, np.float32)), float)
