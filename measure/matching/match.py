"""Least-squares matching of a mark: its rendered image is fitted to the scan.

The model of a window is `gain * picture(mark) + offset + slopes`. The unknowns are the mark's place, optionally its
rotation, scale and shear, the blur, and four grey-value parameters, all in one Gauss-Newton adjustment. Dust and
scratches are first weighted down (Tukey's biweight), then masked where smoothed residuals stand out.
Where grain correlates the noise, its autocovariance is estimated from the residuals and from blank film around the
mark. It weights the last steps and gives the covariance (generalised least squares).
"""

from dataclasses import replace
from typing import Any

import numpy as np

from measure.array_types import Array, Mask
from measure.marks.rendering import frame_pixel_mask, known_mask, mark_window, picture
from measure.marks.shapes import Mark, MarkShape, widen_lines
from measure.matching.covariance import (
    BackgroundTexture,
    LinearFit,
    line_width,
    own_shape,
    place_covariance,
    sloping_place,
)
from measure.matching.gauss_newton import EDGE_BLURS, PictureFit
from measure.matching.models import GREY, FitState, MatchOptions, PictureModel, background_px, smoothed_px2
from measure.matching.tone_information import mark_tone_information, sharpening_score
from measure.matching.window import ScanWindow
from measure.noise.noise_model import (
    NoiseModel,
    blank_patches,
    combine,
    grain_model,
    is_coloured,
    is_textured,
    least_squares_factors,
    white_noise_model,
)
from measure.results import Covariance, MarkFit

_WIDER = 1.05  # relative width of lines, step of the difference
_SPARE_PX = 2.0  # px beyond the margin, so that the mark can move


def match(
    window: ScanWindow,
    mark: Mark,
    pixel_from_mark: Array,
    options: MatchOptions | None = None,
    before: MarkFit | None = None,
) -> MarkFit:
    """Fit a mark to a window of the scan. Never raises because of the image content.

    Parameters
    ----------
    window : if it was compressed with loss, the grain model is not estimated from blank film and damage is detected by
        another rule.
    mark : the mark to fit.
    pixel_from_mark : (2, 3) affine matrix from (x_mm, y_mm, 1) to the scan's (col, row). Its last column is the
        approximate centre, correct to a pixel or two.
    options : MatchOptions, optional
    before : fit of the mark under another tone curve, blur or drawing, from which this one starts.

    Returns
    -------
    MarkFit
        In pixels of the scan. Not converged, with a reason, if the fit failed.
    """
    options, start = options or MatchOptions(), np.array(pixel_from_mark, dtype=float)
    usable = window.usable
    window = replace(window, grey=np.where(usable, np.asarray(window.grey, float), 0.0), valid=usable)
    begun = None
    if before is not None and before.covariance is not None:
        begun = FitState(before.pixel_from_mark, before.blur_px**2 + smoothed_px2(mark), np.zeros(GREY))
    fit = _fit(window, mark, start, options, begun=begun)
    if begun is not None and fit.reason:
        fit = _fit(window, mark, start, options)
    if not _is_right(fit):
        detail = _fit(window, mark, start, options, background_px(mark, start))
        if not detail.reason:
            # A large speck can carry the first steps, plain least squares, away from the mark. Its detail resists that.
            begun = detail.state.shifted(np.asarray(detail.window.origin_px))
            whole = _fit(window, mark, start, options, begun=begun) if fit.reason else fit
            fit = whole if _is_right(whole) else detail
    return _mark_fit(fit, window)


def _fit(
    window: ScanWindow,
    mark: Mark,
    start: Array,
    options: MatchOptions,
    coarse_px: float | None = None,
    begun: FitState | None = None,
) -> PictureFit:
    """Fit the mark in the part of the window around it. coarse_px: blur (px) whose result is subtracted as background;
    None: the background is modelled. begun: state in the scan, nearly the result."""
    fit = _start_fit(window, mark, start, options, coarse_px)
    if begun is None:
        fit.approach()
    else:
        fit.state = begun.shifted(-np.array(fit.window.origin_px))
        fit.choose_area()
    reach_px = options.margin_blurs * fit.model.blur_px
    if not fit.reason and reach_px > options.margin_px:  # the blur spreads the mark beyond the margin
        wide = _start_fit(window, mark, start, replace(options, margin_px=reach_px), coarse_px)
        wide.state = fit.state.shifted(np.subtract(fit.window.origin_px, wide.window.origin_px))
        wide.choose_area()
        fit = wide
    fit.refine()
    return fit


def _start_fit(
    window: ScanWindow, mark: Mark, start: Array, options: MatchOptions, coarse_px: float | None
) -> PictureFit:
    """Set up a fit of the part of the window around the mark's expected place."""
    local = start - np.column_stack([np.zeros((2, 2)), window.origin_px])
    col0, row0, width, height = mark_window(mark, local, options.margin_px + _SPARE_PX)
    rows, cols = (
        slice(min(max(first, 0), size - 1), max(first + count, 1))
        for first, count, size in zip((row0, col0), (height, width), window.grey.shape, strict=True)
    )
    part = window.part(rows, cols)
    if coarse_px is not None:
        # With the background subtracted, a clipped grey value is no longer a limit: exclude it.
        part = replace(part.exclude(part.ends != 0), clipped=None)
    local[:, 2] -= (cols.start, rows.start)
    return PictureFit(PictureModel(part, mark, local, options, coarse_px), part)


def _is_right(fit: PictureFit) -> bool:
    """Whether the fit converged and its residuals show no background texture."""
    return not fit.reason and not is_textured(fit.model.residuals, fit.informative, fit.floor_dn)


def _mark_fit(fit: PictureFit, window: ScanWindow) -> MarkFit:
    """Convert the fit of a part of a window to a result in pixels of the scan."""
    model, used = fit.model, fit.informative
    information = float(model.information[fit.used].sum())
    noise, is_white = white_noise_model(model.scores, fit.used, len(model.design), information)
    unknown = np.full((len(model.design),) * 2, np.inf)
    grey = np.asarray(window.grey, float)
    precision: dict[str, Any] = {
        "place_covariance": Covariance.from_noise(unknown[:2, :2]),
        "covariance": unknown,
        "lost_fraction": 1.0,
    }
    if not fit.reason:
        free, frame = _surroundings(fit, window)
        patches = blank_patches(grey, free, noise.variance_dn2)
        if not is_white or is_coloured(patches):
            noise = grain_model(model.residuals, used, model.design, noise.neighbour_correlation, patches)
        precision = _precision(fit, noise, BackgroundTexture(grey, frame, model.design[-GREY]))
    # The grain's weights may have moved the mark.
    place = fit.state.shifted(np.asarray(fit.window.origin_px)).pixel_from_mark
    stored_dn = fit.window.coding.stored_contrast_dn(float(fit.state.greys[1]), model.contrast_dn)
    return MarkFit(
        converged=not fit.reason,
        reason=fit.reason,
        center_px=place[:, 2],
        pixel_from_mark=place,
        contrast_dn=model.contrast_dn,
        stored_contrast_dn=stored_dn,
        noise_dn=float(np.sqrt(noise.variance_dn2)),
        # The blur of the scan; for a chip, only the blur in addition to the chip's own.
        blur_px=float(np.sqrt(max(fit.state.variance_px2 - model.smoothed_px2, 0.0))),
        damaged_fraction=fit.damaged_fraction,
        redundancy=int(used.sum()) - len(model.design),
        neighbour_correlation=noise.neighbour_correlation,
        covariance_is_white=noise.is_white,
        likeness=_likeness(fit),
        **precision,
    )


def _surroundings(fit: PictureFit, window: ScanWindow) -> tuple[Mask, Mask]:
    """Masks of the whole window: pixels that may be blank film like that under the mark, and pixels of the exposed
    frame, for a mark that is cut into it."""
    offset, (height, width) = np.subtract(fit.window.origin_px, window.origin_px), window.grey.shape
    where = fit.state.shifted(offset).pixel_from_mark, width, height, EDGE_BLURS * fit.model.total_blur_px
    free = window.usable & (window.ends == 0) & known_mask(fit.model.mark, *where)
    # A chip's window is smoothed for the fit, the blank film around it is not.
    free &= not (window.is_lossy or fit.model.is_chip)
    col, row = np.rint(offset).astype(int)
    free[row : row + fit.area.shape[0], col : col + fit.area.shape[1]] &= ~fit.area
    return free, window.usable & frame_pixel_mask(fit.model.mark, *where)


def _precision(fit: PictureFit, noise: NoiseModel, background: BackgroundTexture) -> dict[str, Any]:
    """Finish the fit with the weights of its noise. Returns its covariances and derived estimates, attributes of a
    `MarkFit`."""
    model, used = fit.model, fit.informative
    covariance, by_grey = fit.weigh(noise)
    linear = LinearFit(model.residuals, used, model.design, by_grey, noise, model.steadiness)
    freedom, blur = model.options.freedom, model.blur
    tells_shape = freedom in ("similarity", "affine") and not model.mark.is_round
    shape, strain = slice(2, 4), slice(4, model.linear.stop)
    by_width, width = _line_width_derivative(fit), None
    if len(by_width) and blur is not None and model.blur_is_at_limit:
        width = line_width(linear, by_width[0], blur)
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    blur_sigma = np.inf
    if blur is not None and not model.blur_is_at_limit:
        blur_sigma = float(sigmas[blur]) / (2 * model.total_blur_px**2)
    return {
        "place_covariance": place_covariance(fit, linear, covariance, background),
        "covariance": covariance,
        "lost_fraction": fit.lost_fraction,
        "significance": fit.contrast_dn / max(float(sigmas[-GREY]), 1e-6),
        "blur_sigma": blur_sigma,
        "size_sigma": float(sigmas[2]) if len(model.generators) else np.inf,
        "sloping": sloping_place(linear) if freedom == "ellipse" and model.background_px is None else None,
        "line_width": width,
        "own_shape": own_shape(linear, shape, strain, model.departures) if tells_shape else None,
        "tone": mark_tone_information(fit, linear, background, by_width),
        "sharpening": sharpening_score(fit, linear, by_width),
    }


def _line_width_derivative(fit: PictureFit) -> Array:
    """(n, height, width) derivative by the logarithm of the width of a cross's lines; n is 0 for other marks."""
    model = fit.model
    height, width = model.grey.shape
    if not (isinstance(model.mark, MarkShape) and model.mark.is_cross):
        return np.zeros((0, height, width))
    wider = picture(widen_lines(model.mark, _WIDER), fit.state.pixel_from_mark, width, height, model.blur_px)
    change = model.detail(wider) * model.steadiness * model.slopes - model.design[-GREY]
    return np.asarray(model.contrast_dn / np.log(_WIDER) * change)[None]


def _likeness(fit: PictureFit) -> float:
    """Correlation of the fitted model with the window after subtraction of its plane background."""
    counts = fit.used * fit.model.steadiness
    background, grey = fit.model.ground * counts, fit.model.grey * counts
    if fit.used.sum() <= len(background):
        return 0.0
    without = grey - combine(least_squares_factors(background, grey), background)
    unexplained = np.sum(fit.model.misfit[fit.used] ** 2) / max(np.sum(without**2), 1e-12)
    return float(np.sqrt(max(1 - unexplained, 0.0)))
