"""Detection of a faint mark at the place predicted from a frame's other marks, against the texture around it.

Alone, such a mark cannot be distinguished from the many places where noise resembles it. With a certain constellation
only responses as strong and as close to the predicted place compete. Their expected number follows from the texture
(`measure.detection.correlation`), as does the covariance of the place. The strength of the texture relative to the
lines depends on the tone curve. Where that is unknown, the mark is searched with two curves, and the difference enters
the covariance.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask
from measure.detection.correlation import expected_peaks
from measure.detection.localisation import MarkPrediction
from measure.flags import NO_REASON, Cause, Code, Reason
from measure.marks.rendering import detail_px, extent_px, picture
from measure.matching.window import FAINT, Coding
from measure.results import Covariance, MarkFit, largest_sigma_px
from measure.scans.scan import Scan, means

_SHOWS = 1 / 3  # fraction of the usual contrast: a background that leaves less to a mark hides it
_BACKGROUND = 1.2  # in widths of the finest detail, standard deviation of the blur that estimates the background
_TEXTURE = 2.0  # times that, standard deviation of the average of the texture's strength
_CLIP = 3.0  # times the texture's strength, limit for stones and edges
_RING = 30.0  # px of the window, radius around the mark within which the texture is estimated
_SELF = 0.1  # fraction of the mark's response below which its own contribution is negligible
_SHOWN = 0.2  # fraction of the template's norm at the mark; elsewhere the background is too extreme to show a mark
_LINE = 0.25  # fraction of the maximum that delimits the mark's lines
_ROUNDS = 8  # largest number of renderings at refined places
_SETTLED_PX = 1e-3  # px, convergence limit: 1/50 of the standard deviation of a faint mark
_STEP_PX = 0.5  # px between the places that define the peak of a response
_OWN_LINEAR = 0.01  # rotation (rad) and scale of marks relative to the frame; 0.012 on a real register glass
_LEAST_DISTANCE_PX = 1.0  # px, accuracy of predictions
_LEAST_PLACES = 200  # places of texture needed to estimate a covariance
_LEAST_NORM = 1e-6  # added to squared norms, to divide by
_FINEST_PX = 16.0  # px, width of lines above which the window is reduced


@dataclass(frozen=True, eq=False)
class FaintMark:
    """Faint mark.

    fit: its significance is in standard deviations of the texture's response, from which its covariance is estimated,
    too; false_alarms: expected number of responses of the texture as strong and as close.
    """

    fit: MarkFit
    false_alarms: float

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the place in its least accurate direction, without the rotation uncertainty."""
        parts = self.fit.place_covariance.parts
        place_px2 = sum((part for cause, part in parts.items() if cause != Cause.ROTATION), np.zeros((2, 2)))
        return largest_sigma_px(place_px2)


def reason_not_found(
    expected: MarkPrediction, contrasts_dn: tuple[float, float, float], mark: FaintMark | None, is_certain: bool
) -> Reason:
    """Give the first reason that holds: no room for contrast, too little of it visible, rounding, or texture.

    contrasts_dn: largest one that the background leaves to a mark, usual one of the other marks, and standard deviation
    of the background.
    """
    room_dn, usual_dn, sigma_dn = contrasts_dn
    if room_dn < _SHOWS * usual_dn:
        shade = "light" if expected.polarity > 0 else "dark"
        return Reason(
            f"the background at its place is so {shade} that the mark could change it by "
            f"{_grey(room_dn)} only, the others by {usual_dn:.0f}",
            Code.GROUND,
        )
    if mark is not None and is_certain:
        return Reason(
            f"only {1 - mark.fit.damaged_fraction:.0%} of it shows: that gives its place to {mark.sigma_px:.1f} px "
            "only",
            Code.COVERED,
        )
    within, could = f"within {expected.search_px:.0f} px of its place", min(room_dn, usual_dn)
    if mark is not None and abs(mark.fit.stored_contrast_dn) < _SHOWS * could:
        return Reason(
            f"no candidate {within}: the best one changes the background by "
            f"{_grey(abs(mark.fit.stored_contrast_dn))}, where the mark could by {could:.0f}",
            Code.NOT_FOUND,
        )
    return Reason(
        f"nothing {within} stands out of the texture: the background there varies by {_grey(sigma_dn)}, and "
        f"a mark could change it by {could:.0f}",
        Code.CONTRAST,
    )


def _grey(dn: float) -> str:
    if dn < 0.5:
        return "less than half a grey value"
    return f"{dn:.0f} grey value{'s' if round(dn) > 1 else ''}"


def detect_faint(scan: Scan, expected: MarkPrediction, extreme_dn: float, blur_px: float) -> FaintMark | None:
    """Find the strongest response to a mark within the search radius of its predicted place.

    Parameters
    ----------
    extreme_dn : lightest or darkest grey value of the scan, which a mark of that polarity cannot exceed. On a
        background of that value it is invisible.
    blur_px : blur of the scan.

    Returns
    -------
    FaintMark, or None if there is no contrast under one of the plausible tone curves.
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
    """Window around a predicted place with the background subtracted. Its pixels are step pixels of the scan wide; all
    places refer to it."""

    def __init__(self, scan: Scan, expected: MarkPrediction, extreme_dn: float, blur_px: float) -> None:
        self.blur_px = blur_px
        self.step = step = max(1, int(detail_px(expected.mark, expected.linear) / _FINEST_PX))
        self.mark, self.linear, self.polarity = expected.mark, expected.linear / step, expected.polarity
        self.coarse_px = _BACKGROUND * detail_px(self.mark, self.linear)
        least, greatest = extent_px(self.mark, np.column_stack([self.linear, np.zeros(2)]))
        self.half = int(np.ceil(max(-least.min(), greatest.max()) + 2 * self.coarse_px)) + 1
        moves_px = _ROUNDS * _STEP_PX + 1.0  # the refined place may lie outside the search radius
        side = self.half + int(np.ceil(max(expected.search_px / step, _RING) + moves_px))
        first = np.floor(expected.center_px).astype(int) - side * step - step // 2
        self.origin = first + (step - 1) / 2
        self.predicted = (expected.center_px - self.origin) / step
        window = (int(first[0]), int(first[1]), *((2 * side + 1) * step,) * 2)
        light, inside = (
            np.asarray(means(each[..., None], step)[..., 0])
            for each in (scan.light(*window, expected.weights), scan.inside(*window).astype(np.float32))
        )
        self.coding = Coding(scan.tone, scan.full_scale_dn)
        self.ground_dn = ground = np.asarray(cv2.GaussianBlur(light, (0, 0), self.coarse_px), np.float32)
        detail = light - ground
        spread = cv2.GaussianBlur(detail**2, (0, 0), _TEXTURE * self.coarse_px)
        least_dn = np.abs(self.coding.light_of_step_dn(ground, FAINT * scan.full_scale_dn))
        self.texture_dn: Array = np.sqrt(spread + least_dn**2)
        extreme = float(scan.tone.light(np.array(extreme_dn), scan.full_scale_dn))
        room_dn = np.maximum(self.polarity * (extreme - ground), 0.0)
        self.room_dn = np.where(inside == 1.0, room_dn, 0.0).astype(np.float32)
        self.room = self.room_dn / self.texture_dn  # largest possible contrast of a mark over the texture's strength
        self.detail: Array = np.asarray(np.clip(detail / self.texture_dn, -_CLIP, _CLIP) * self.polarity, dtype=float)
        self.weighted = self.detail * self.room

    def detect(self, search_px: float) -> FaintMark | None:
        """Detect the mark at the highest response around its predicted place. None without a positive response."""
        response = _Response(self, self.predicted)
        rows, cols = np.indices(response.value.shape)
        fraction = response.fraction
        near = np.hypot(cols + fraction[0] - self.predicted[0], rows + fraction[1] - self.predicted[1])
        best = np.where(near <= search_px / self.step, response.value, -np.inf)
        row, col = np.unravel_index(int(best.argmax()), best.shape)
        if best[row, col] <= 0:
            return None
        response = _Response(self, np.array([col, row]) + fraction)
        for _ in range(_ROUNDS):
            top = response.top()
            if np.hypot(*(top - response.center)) < _SETTLED_PX:
                break
            response = _Response(self, top)
        return self._faint_mark(response)

    def template(self, off: Array) -> Array:
        """Template of the mark with its centre offset from the centre pixel, background subtracted."""
        size = 2 * self.half + 1
        pixel_from_mark = np.column_stack([self.linear, off + self.half])
        shown = picture(self.mark, pixel_from_mark, size, size, self.blur_px / self.step)
        return np.asarray(shown - cv2.GaussianBlur(shown, (0, 0), self.coarse_px), dtype=float)

    def _faint_mark(self, response: "_Response") -> FaintMark | None:
        """Evaluate the response at the mark's place against the responses of the texture around it. None if the texture
        is not estimable or the peak is no maximum."""
        pixel, patch, center = response.pixel, response.patch, response.center
        height = float(response.value[pixel])
        amplitude = height / float(response.norm[pixel])
        own = np.zeros_like(self.detail)
        own[patch] = amplitude * self.room[patch] ** 2 * response.template
        texture = self._texture(response, _correlated(own, response.template) / response.norm)
        bend = response.bend(own)[1]
        if texture.sum() < _LEAST_PLACES or not np.all(np.linalg.eigvalsh(bend) < 0):
            return None
        # Derivatives of the correlation with respect to column and row.
        nine = response.templates
        by_col, by_row = (
            _correlated(self.weighted, by) / (2 * _STEP_PX) / response.norm
            for by in (nine[1, 2] - nine[1, 0], nine[2, 1] - nine[0, 1])
        )
        slopes = np.asarray(np.cov(np.stack([by_col, by_row])[:, texture]), dtype=float)
        scatter = float(np.sqrt(np.mean(response.value[texture] ** 2)))
        inverse, place = np.linalg.inv(bend) * self.step, center * self.step + self.origin
        lines = np.abs(response.template)
        lit = lines * self.room[patch]
        detail = float(np.linalg.norm(self.detail[patch][lit > _LINE / 5 * lit.max()]))
        if detail == 0.0:  # a patch of one grey value, painted over: the response is rounding
            return None
        shown, drawn = lit > _LINE * lit.max(), lines > _LINE * lines.max()
        room_dn, ground_dn, texture_dn = (
            float(np.average(image[patch], weights=lit)) for image in (self.room_dn, self.ground_dn, self.texture_dn)
        )
        pairs = texture[:, 1:] & texture[:, :-1]
        neighbours = np.stack([self.detail[:, 1:][pairs], self.detail[:, :-1][pairs]])
        is_varied = bool(neighbours.std(axis=1).all())
        contrast_dn = self.polarity * amplitude * room_dn
        fit = MarkFit(
            converged=True,
            reason=NO_REASON,
            center_px=place,
            place_covariance=Covariance.from_noise(inverse @ slopes @ inverse).plus(
                Cause.ROTATION, self._rotation_px2(response, lit)
            ),
            pixel_from_mark=np.column_stack([self.linear * self.step, place]),
            contrast_dn=contrast_dn,
            stored_contrast_dn=self.coding.stored_contrast_dn(ground_dn, contrast_dn),
            noise_dn=texture_dn,
            blur_px=self.blur_px,
            damaged_fraction=max(1 - float(shown.sum() / drawn.sum()), 0.0),
            redundancy=int((lit > 0).sum()) - 3,
            neighbour_correlation=float(np.asarray(np.corrcoef(neighbours))[0, 1]) if is_varied else 0.0,
            likeness=min(height / detail, 1.0),
            significance=height / scatter,
        )
        distance_px = max(float(np.hypot(*(center - self.predicted))), _LEAST_DISTANCE_PX)
        return FaintMark(fit, expected_peaks(height / scatter, slopes / scatter**2, distance_px))

    def _rotation_px2(self, response: "_Response", lit: Array) -> Array:
        """(2, 2) covariance of the place by the mark's own rotation and scale, for lines off to one side of its point,
        assumed at their centroid. lit: the template times the room for contrast."""
        rows, cols = np.indices(lit.shape) - self.half
        weights = lit * self.room[response.patch]
        middle_px = np.array([(weights * cols).sum(), (weights * rows).sum()]) / weights.sum() - response.fraction
        return np.asarray(_OWN_LINEAR**2 * self.step**2 * (middle_px @ middle_px) * np.eye(2))

    def _texture(self, response: "_Response", signal: Array) -> Mask:
        """Mask of the places around the mark whose response is that of the texture alone and where a mark could be
        visible."""
        (row, col), (rows, cols) = response.pixel, np.indices(signal.shape)
        near = np.hypot(rows - row, cols - col) <= _RING
        whole = np.zeros(signal.shape, dtype=bool)
        whole[self.half : -self.half, self.half : -self.half] = True
        alone = np.abs(signal) < _SELF * signal[row, col]
        return np.asarray(near & whole & alone & (response.norm > _SHOWN * response.norm[row, col]))


class _Response:
    """Response of a window to a mark with the sub-pixel phase of a centre."""

    def __init__(self, field: _Field, center: Array) -> None:
        self.field, self.center = field, center
        self.fraction = center - np.rint(center)
        col, row = np.rint(center).astype(int).tolist()
        self.pixel, half = (row, col), field.half
        self.patch = slice(row - half, row + half + 1), slice(col - half, col + half + 1)

    @cached_property
    def templates(self) -> Array:
        """(3, 3, rows, columns) templates with the centre shifted by -_STEP_PX, 0 and _STEP_PX in row and column. They
        are rendered, since thin lines are undersampled and cannot be interpolated."""
        off = (-_STEP_PX, 0.0, _STEP_PX)
        return np.array([[self.field.template(self.fraction + np.array([col, row])) for col in off] for row in off])

    @cached_property
    def template(self) -> Array:
        """Template of the mark at this phase."""
        return self.field.template(self.fraction)

    @cached_property
    def norm(self) -> Array:
        """Norm of the weighted template at every pixel."""
        return np.sqrt(np.maximum(_correlated(self.field.room**2, self.template**2), 0.0) + _LEAST_NORM)

    @cached_property
    def value(self) -> Array:
        """Weighted correlation at every pixel."""
        return _correlated(self.field.weighted, self.template) / self.norm

    def top(self) -> Array:
        """Vertex of the paraboloid through the responses around the centre, at most _STEP_PX away."""
        gradient, hessian = self.bend(self.field.weighted)
        if not np.all(np.linalg.eigvalsh(hessian) < 0):
            return self.center
        return np.asarray(self.center + np.clip(-np.linalg.solve(hessian, gradient), -_STEP_PX, _STEP_PX))

    def bend(self, weighted: Array) -> tuple[Array, Array]:
        """Gradient (2,) by (col, row) and Hessian (2, 2) of the response of a weighted image at the centre, from the
        least-squares paraboloid through nine responses."""
        norm = np.sqrt(((self.field.room[self.patch] * self.template) ** 2).sum() + _LEAST_NORM)
        nine = np.einsum("rcij,ij->rc", self.templates, weighted[self.patch]) / norm
        by_col, by_row = nine.mean(axis=0), nine.mean(axis=1)
        gradient = np.array([by_col[2] - by_col[0], by_row[2] - by_row[0]]) / (2 * _STEP_PX)
        mixed = (nine[2, 2] + nine[0, 0] - nine[0, 2] - nine[2, 0]) / 4
        bends = [side[2] - 2 * side[1] + side[0] for side in (by_col, by_row)]
        return gradient, np.array([[bends[0], mixed], [mixed, bends[1]]]) / _STEP_PX**2


def _correlated(image: NDArray[np.floating], template: NDArray[np.floating]) -> Array:
    return np.asarray(cv2.filter2D(np.asarray(image, np.float32), cv2.CV_32F, np.asarray(template, np.float32)), float)
