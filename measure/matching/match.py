"""Least-squares matching: a mark measured to the noise of the film, by fitting its own picture to the scan.

The model of a window is `gain * picture(mark) + offset + slopes`; unknown are the mark's place, if wished its rotation,
scale and shear, the blur, and four grey-value parameters, all in one Gauss-Newton adjustment. Dust and scratches
are first weighted down (Tukey's biweight), then cut out where smoothed residuals stand out; the rest decides.
Where grain correlates the noise, its autocovariance, from the residuals and from blank film beside the mark, weighs the
last steps and gives the covariance (generalised least squares).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from measure.flags import Cause
from measure.marks.rendering import extent_px, frame_pixel_mask, known_mask
from measure.marks.shapes import Mark, MarkTemplate
from measure.matching.covariance import (
    Landscape,
    LinearFit,
    covariance_of_changed_tone,
    edge_place,
    own_shape,
    second_order,
    sloping_place,
)
from measure.matching.gauss_newton import EDGE_BLURS, PictureFit
from measure.matching.models import GREY, PictureModel, State, background_px, is_round
from measure.matching.options import MatchOptions
from measure.matching.saturation import Sides, clear_of_ends
from measure.matching.tone_information import mark_tone_information, tone_without_information
from measure.matching.window import Coding, ScanWindow
from measure.noise.grain import blank_patches, grain_model, is_coloured, taken_out
from measure.noise.noise_model import NoiseModel, as_if_white, combined, factors, is_textured, products
from measure.results import Covariance, MarkFit, OwnShape, SecondPlace
from measure.tone.estimate import MarkTone

__all__ = ["MarkFit", "MatchOptions", "mark_window", "match"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SPARE_PX = 2.0  # beyond the margin: room for the mark to move


def match(window: ScanWindow, mark: Mark, pixel_from_mark: Array, options: MatchOptions | None = None) -> MarkFit:
    """Fit the mark to a window of the scan.

    pixel_from_mark: (2, 3) affine matrix from (x_mm, y_mm, 1) to the scan's (col, row): its last column is the
    approximate centre, right to a pixel or two. In a window that was compressed with loss grain tells nothing, and dust
    is seen otherwise. Never raises for what the picture holds.
    """
    options = options or MatchOptions()
    given = _match_input(window, mark, pixel_from_mark)
    part, fit = _fit_part(given, options)
    if not _is_right(fit):
        detail_part, detail = _fit_part(given, options, background_px(mark, given.start))
        if not detail.reason:
            whole = _refit_whole_ground(given, detail_part, detail) if fit.reason else fit
            part, fit = detail_part, whole if _is_right(whole) else detail
    result = _result(fit, _surroundings(given, part, fit))
    moved = np.array(result.pixel_from_mark)
    moved[:, 2] += part.corner_px + window.origin_px
    return replace(result, center_px=moved[:, 2], pixel_from_mark=moved)


class _Given(NamedTuple):
    """What is given of the scan about a mark, which is expected at start (2, 3) of the window. grey, usable, sides and
    blank (height, width): grey values, which of them are known, which are clipped, and which may be blank film."""

    grey: Array
    usable: Mask
    sides: Sides
    blank: Mask
    mark: Mark
    start: Array
    is_lossy: bool
    coding: Coding


def _match_input(window: ScanWindow, mark: Mark, pixel_from_mark: Array) -> _Given:
    start = np.array(pixel_from_mark, dtype=float)
    start[:, 2] -= window.origin_px
    usable, sides = window.usable, window.sides
    # A chip's picture is smoothed for the fit, and blank film beside it is not.
    has_none = window.is_lossy or isinstance(mark, MarkTemplate)
    blank = np.zeros_like(usable) if has_none else usable & (sides == 0)
    grey = np.where(usable, np.asarray(window.grey, dtype=float), 0.0)
    return _Given(grey, usable, sides, blank, mark, start, window.is_lossy, window.coding)


class _Part(NamedTuple):
    """The rows and columns of a window that a fit uses."""

    rows: slice
    cols: slice

    @property
    def corner_px(self) -> Array:
        return np.array([self.cols.start, self.rows.start], dtype=float)


def _fit_part(given: _Given, options: MatchOptions, coarse_px: float | None = None) -> tuple[_Part, PictureFit]:
    """The mark fitted, in the part of the window about it, in that part's pixels. coarse_px: of a background that does
    not count, if one does not."""
    part = _part(given, options)
    fit = _start_fit(given, part, options, coarse_px)
    fit.approach()
    reach_px = options.margin_blurs * fit.model.blur_px
    if not fit.reason and reach_px > options.margin_px:  # the blur spreads the mark beyond its margin
        wide = replace(options, margin_px=reach_px)
        narrow, part = part, _part(given, wide)
        fit = _start_fit(given, part, wide, coarse_px, fit.model.state.shifted(narrow.corner_px - part.corner_px))
        fit.choose_area()
    fit.refine()
    return part, fit


def _is_right(fit: PictureFit) -> bool:
    """Whether it came to an end and leaves no landscape."""
    return not fit.reason and not is_textured(fit.model.residuals, fit.telling, fit.floor_dn)


def _refit_whole_ground(given: _Given, part: _Part, detail: PictureFit) -> PictureFit:
    """The mark fitted with its ground from where its detail alone was fitted: a large speck carries the first steps,
    which are plain least squares, away from a mark, and not those of its detail."""
    state = detail.model.state.shifted(np.zeros(2))
    fit = _start_fit(given, part, detail.options, None, state)
    fit.choose_area()
    fit.refine()
    return fit


class _Surroundings(NamedTuple):
    """The whole window (height, width) about a mark: its grey values; free: what may be blank film as that under the
    mark; frame: where it shows the exposed frame that the mark is cut into."""

    grey: Array
    free: Mask
    frame: Mask


def _surroundings(given: _Given, part: _Part, fit: PictureFit) -> _Surroundings:
    place, (height, width) = fit.model.state.shifted(part.corner_px).pixel_from_mark, given.grey.shape
    where = given.mark, place, width, height, EDGE_BLURS * fit.model.total_blur_px
    free = given.blank & known_mask(*where)
    free[part.rows, part.cols] &= ~fit.area
    return _Surroundings(given.grey, free, given.usable & frame_pixel_mask(*where))


def _start_fit(
    given: _Given,
    part: _Part,
    options: MatchOptions,
    coarse_px: float | None,
    state: State | None = None,
) -> PictureFit:
    rows, cols = part
    start, ends, usable = given.start.copy(), given.sides[rows, cols], given.usable[rows, cols]
    start[:, 2] -= part.corner_px
    if coarse_px is not None:
        # What is left of a clipped grey value without its surroundings is no limit of anything.
        usable, ends = usable & (ends == 0), np.zeros_like(ends)
    model = PictureModel(given.grey[rows, cols], ends, given.mark, start, options, coarse_px)
    model.state = state or model.state
    return PictureFit(model, usable, given.is_lossy, given.coding.part(rows, cols))


def _part(given: _Given, options: MatchOptions) -> _Part:
    col0, row0, width, height = mark_window(given.mark, given.start, options.margin_px + _SPARE_PX)
    return _Part(
        *(
            slice(min(max(first, 0), size - 1), max(first + count, 1))
            for first, count, size in zip((row0, col0), (height, width), given.grey.shape, strict=True)
        )
    )


def mark_window(mark: Mark, pixel_from_mark: Array, margin_px: float) -> tuple[int, int, int, int]:
    """col0, row0, width, height of the window that holds the mark and margin_px about it."""
    least, greatest = extent_px(mark, np.asarray(pixel_from_mark, dtype=float))
    col0, row0 = np.floor(least - margin_px).astype(int)
    col1, row1 = np.ceil(greatest + margin_px).astype(int)
    return int(col0), int(row0), int(col1 - col0 + 1), int(row1 - row0 + 1)


def _result(fit: PictureFit, about: _Surroundings) -> MarkFit:
    """The match in the pixels of the fit's own window."""
    model, used = fit.model, fit.telling
    information = float(model.information[fit.used].sum())
    noise, is_white = as_if_white(model.scores, fit.used, len(model.design), information)
    noise = noise.floored(fit.rounding_variance_dn2)
    unknown = np.full((len(model.design),) * 2, np.inf)
    precision = _Precision(Covariance.from_noise(unknown[:2, :2]), unknown, np.inf)
    if not fit.reason:
        patches = blank_patches(about.grey, about.free, noise.variance_dn2)
        if not is_white or is_coloured(patches):
            taken = taken_out(used, model.design)
            noise = grain_model(model.residuals, used, taken, noise.neighbour_correlation, patches)
        precision = _estimate_precision(fit, used, noise, about)
    state, covariance = model.state, precision.covariance
    return MarkFit(
        converged=not fit.reason,
        reason=fit.reason,
        center_px=state.pixel_from_mark[:, 2],
        place_covariance=precision.place,
        pixel_from_mark=state.pixel_from_mark,
        contrast_dn=model.contrast_dn,
        stored_contrast_dn=fit.coding.stored_contrast_dn(model.ground_dn, model.contrast_dn),
        noise_dn=float(np.sqrt(noise.variance_dn2)),
        blur_px=model.scan_blur_px,
        damaged_fraction=fit.damaged_fraction,
        lost_fraction=1.0 if fit.reason else fit.lost_fraction,
        redundancy=int(used.sum()) - len(model.design),
        neighbour_correlation=noise.neighbour_correlation,
        covariance_is_white=noise.is_white,
        likeness=_likeness(fit),
        significance=fit.contrast_dn / precision.contrast_sigma,
        blur_sigma=_blur_sigma(model, covariance),
        size_sigma=float(np.sqrt(covariance[2, 2])) if model.tells_size else np.inf,
        edges=precision.edges,
        sloping=precision.sloping,
        own_shape=precision.own_shape,
        tone=precision.tone,
        covariance=covariance,
    )


class _Precision(NamedTuple):
    """How well a fit is known: its place by all causes, the covariance of its unknowns (unknowns, unknowns) and the
    standard deviation of the contrast by the noise, and what the linearised fit says beside the unknowns, as in
    `MarkFit`."""

    place: Covariance
    covariance: Array
    contrast_sigma: float
    edges: SecondPlace | None = None
    sloping: SecondPlace | None = None
    own_shape: OwnShape | None = None
    tone: MarkTone | None = None


def _estimate_precision(fit: PictureFit, used: Mask, noise: NoiseModel, about: _Surroundings) -> _Precision:
    """The fit ended with the weights of its noise. used: the pixels that said how large this is."""
    model = fit.model
    covariance, by_grey = fit.weigh(noise)
    priors_dn2 = model.prior_weights() * noise.variance_dn2
    more = second_order(model.design, model.slopes, fit.used, covariance, priors_dn2)
    by_noise = covariance[:2, :2]
    rounded = fit.rounding_variance_dn2 * np.trace(products(by_grey[:2], by_grey[:2]))
    share = min(float(rounded / np.trace(by_noise)), 1.0)
    place = Covariance.from_noise((1 - share) * by_noise).plus(Cause.ROUNDING, share * by_noise)
    place = place.plus(Cause.SECOND_ORDER, more * by_noise)
    if isinstance(model.mark, MarkTemplate) and model.mark.steadiness is not None:
        change = fit.contrast_dn / float(np.ptp(model.mark.image))
        place = place.plus(Cause.CHANGED_TONES, covariance_of_changed_tone(model.half_tones, by_grey, change))
    place = place.plus(Cause.LANDSCAPE, _landscape(model, about).covariance(by_grey[:2]))
    linear = LinearFit(model.residuals, used, model.design, by_grey, noise, model.steadiness)
    place = place.plus(Cause.UNLIKE_DRAWING, linear.unlike_drawing_px2(by_noise))
    freedom = model.options.freedom
    tells_shape = freedom in ("similarity", "affine") and not is_round(model.mark)
    shape, strain = slice(2, 4), slice(4, model.linear.stop)
    return _Precision(
        place,
        covariance,
        contrast_sigma=float(np.sqrt(max(float(covariance[-GREY, -GREY]), 1e-12))),
        edges=edge_place(linear, model.blur_px),
        sloping=sloping_place(linear) if freedom == "ellipse" and model.background_px is None else None,
        own_shape=own_shape(linear, shape, strain, model.departures()) if tells_shape else None,
        tone=_tone(fit, linear, priors_dn2, about),
    )


def _landscape(model: PictureModel, about: _Surroundings) -> Landscape:
    return Landscape(about.grey, about.frame, model.design[-GREY])


def _tone(fit: PictureFit, linear: LinearFit, priors_dn2: Array, about: _Surroundings) -> MarkTone | None:
    """What the picture says of the tone curve, None where that is known, or the mark is a chip, cut from scans of the
    same curve."""
    model, coding = fit.model, fit.coding
    if coding.tone.is_known or isinstance(model.mark, MarkTemplate):
        return None
    if model.background_px is not None:
        return tone_without_information(linear, model.light, model.detail, coding.tone, coding.full_scale_dn)
    drawn, linear = model.drawn_light, replace(linear, noise=linear.noise.floored(fit.floor_dn**2))
    clear = clear_of_ends(drawn, model.grey, model.clipped, model.noise_dn)
    landscape = _landscape(model, about)
    return mark_tone_information(
        linear, drawn, model.grey, clear, priors_dn2, model.departures(), coding.tone, coding.full_scale_dn, landscape
    )


def _blur_sigma(model: PictureModel, covariance: Array) -> float:
    if model.blur is None or model.blur_is_at_limit:
        return np.inf
    return float(np.sqrt(covariance[model.blur, model.blur]) / (2 * model.total_blur_px**2))


def _likeness(fit: PictureFit) -> float:
    counts = fit.used * fit.model.steadiness
    background, grey = fit.model.ground * counts, fit.model.grey * counts
    if fit.used.sum() <= len(background):
        return 0.0
    without = grey - combined(factors(background, grey), background)
    unexplained = np.sum(fit.model.residuals[fit.used] ** 2) / max(np.sum(without**2), 1e-12)
    return float(np.sqrt(max(1 - unexplained, 0.0)))
