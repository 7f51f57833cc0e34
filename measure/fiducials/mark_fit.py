"""Detection and least-squares matching of one mark around its predicted place, at full resolution."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from measure.array_types import Array
from measure.detection.localisation import MarkPrediction, localise
from measure.flags import NO_REASON, Cause, Code, Reason
from measure.marks.rendering import extent_px, mark_window
from measure.marks.shapes import FrameCorner, Mark, MarkShape, MarkTemplate
from measure.matching.frame_edge import fit_frame_corner
from measure.matching.match import match
from measure.matching.models import MatchOptions
from measure.matching.window import FAINT, pixels_beyond_edge, read_window
from measure.noise.noise_model import BESIDE_PX
from measure.results import MarkFit
from measure.scans.jpeg import covariance_of_compression, tone_variance
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR

_DRIFT_PX = 2.0  # px that a fit may move beyond the search radius: farther off it has found something else, e.g. dust
_MOST_CONTRAST = 2.0  # times full scale: more is impossible, and lines are hardly twice as wide as drawn
_SURE = 3.0  # standard deviations
_SOLID_MARGIN_PX = 7.0  # px of background: 6 would lose 1 % of the accuracy of a sharp dot and 2 % of a notch's
_SOLID_MARGIN_BLURS = 5.0  # in blurs: separates background and blur of a wide edge; 4 would lose a sixth at 1.6 px
_DRAWN_SIGMA = 0.04  # of angles (rad) and relative sizes of a drawing that is exact in part only, as seen on film


@dataclass(frozen=True, eq=False)
class Detection:
    """Result of the detection of one mark.

    Attributes
    ----------
    predicted_px : (2,) predicted place.
    inside : whether the predicted place lies in the scan and its pixels can be read.
    fit : None if nothing could be fitted.
    reason : why there is no fit, or why it may be wrong.
    false_alarms : expected number of places within the search radius at which noise correlates as well.
    closer : whether the mark was found only with narrow robust surroundings, where the other marks predict it.
    """

    predicted_px: Array
    inside: bool
    fit: MarkFit | None
    reason: Reason = NO_REASON
    false_alarms: float = 1.0
    closer: bool = False

    @property
    def is_clear(self) -> bool:
        """Whether the fit correlates clearly with the drawing."""
        return self.fit is not None and self.fit.is_clear

    def amend(
        self, *reasons: Reason, parts: Mapping[Cause, Array] | None = None, figures: Mapping[str, float] | None = None
    ) -> "Detection":
        """Add reasons why the fit may be wrong, parts (2, 2) of its covariance, and figures."""
        fit, reason = self.fit, Reason.combine((self.reason, *reasons))
        if fit is not None:
            covariance = fit.place_covariance
            for cause, px2 in (parts or {}).items():
                covariance = covariance.plus(cause, px2)
            fit = replace(fit, place_covariance=covariance, figures={**fit.figures, **(figures or {})})
        return replace(self, fit=fit, reason=reason)


def detect_mark(
    scan: Scan,
    expected: MarkPrediction,
    options: MatchOptions,
    frame_sigma: float | None = None,
    before: MarkFit | None = None,
) -> Detection:
    """Localise a mark within the search radius of its predicted place and fit it there.

    Parameters
    ----------
    expected : the predicted place; without a search radius the mark is fitted at that place.
    frame_sigma : standard deviation of the predicted rotation (rad), scale, stretch and shear; None unless they come
        from a frame fitted to all marks.
    before : an earlier fit at that place, from which the new one starts.
    """
    predicted, mark = expected.center_px.copy(), expected.mark
    if not (np.all(predicted >= -0.5) and np.all(predicted < np.array([scan.width_px, scan.height_px]) - 0.5)):
        return Detection(predicted, False, None, Reason("its place is outside of the scan", Code.OUTSIDE))
    fit: MarkFit | None = None
    false_alarms = 1.0
    if isinstance(mark, FrameCorner):
        fit = fit_frame_corner(
            scan, mark, expected.pixel_from_mark, expected.search_px, expected.polarity, expected.weights
        )
    elif peak := localise(scan, expected) if expected.search_px > 0 else (predicted, 0.0):
        start, false_alarms = expected.shift_to(peak[0]).pixel_from_mark, peak[1]
        options = options_for(mark, options, frame_sigma)
        coded = scan.replace_tone(LINEAR) if isinstance(mark, MarkTemplate) else scan  # stored values
        window = read_window(coded, mark_window(mark, start, options.margin_px + BESIDE_PX), expected.weights)
        if expected.surroundings.robust and isinstance(mark, MarkShape):
            inner = np.column_stack([start[:, :2], start[:, 2] - window.origin_px])
            window = window.exclude(pixels_beyond_edge(window.grey, mark, inner))
        fit = match(window, mark, start, options, before)
    place = expected.shift_to(fit.center_px) if fit is not None and fit.converged else expected
    if why := scan.loss_reason(*mark_window(mark, place.pixel_from_mark, 0.0)):
        lost = Reason(f"the scan's file is damaged at its place: {why}", Code.DAMAGED_FILE)
        return Detection(predicted, False, None, lost)
    if fit is None:
        return Detection(predicted, True, None, not_found(expected.search_px))
    reason = _unlike(fit, expected, scan.full_scale_dn) if fit.converged else fit.reason
    if reason:
        return Detection(predicted, True, None, reason)
    if fit.tone is not None:
        alike = tone_variance(scan.quantisation_step_dn, fit.stored_contrast_dn)
        fit = replace(fit, tone=replace(fit.tone, information=replace(fit.tone.information, common_variance=alike)))
    loss = covariance_of_compression(scan.quantisation_step_dn, fit.stored_contrast_dn)
    fit = replace(fit, place_covariance=fit.place_covariance.plus(Cause.COMPRESSION, loss))
    return Detection(predicted, True, fit, false_alarms=false_alarms)


def not_found(search_px: float) -> Reason:
    """Reason for a mark that was not found."""
    return Reason(f"no mark like its drawing within {search_px:.0f} px of the predicted position", Code.NOT_FOUND)


def _unlike(fit: MarkFit, expected: MarkPrediction, full_scale_dn: float) -> Reason:
    """Reason why the fit cannot be that of the mark; empty if it may be."""
    off_px = float(np.hypot(*(fit.center_px - expected.center_px)))
    if off_px > expected.search_px + _DRIFT_PX:
        return Reason(f"what lies there is {off_px:.0f} px from its place", Code.OFF_PLACE)
    contrast = abs(fit.stored_contrast_dn) / full_scale_dn
    if contrast < FAINT:
        return Reason("there is no contrast at its place", Code.CONTRAST)
    # On a background near black the tone curve enlarges small differences of light, and may be wrong.
    contrast = min(contrast, abs(fit.contrast_dn) / full_scale_dn)
    if contrast * (1 - _SURE / max(fit.significance, _SURE)) > _MOST_CONTRAST:
        return Reason(
            "what lies there is far wider than the mark's lines: as fine as these, it would have "
            f"{contrast:.1f} times the contrast that a scan can show",
            Code.SIZE,
        )
    if fit.contrast_dn * expected.polarity <= 0:
        return Reason("what lies there has the other polarity", Code.POLARITY)
    return NO_REASON


def options_for(mark: Mark, options: MatchOptions, frame_sigma: float | None) -> MatchOptions:
    """Adapt the options of least-squares matching to a mark.

    A solid mark gets a wider margin of background. Parameters that the mark's image may not determine keep their
    predicted values, or get the standard deviation of the frame as prior: rotation and scale if the mark is held by
    the frame, stretch and shear if its drawing is one-sided.
    """
    if mark.is_solid:
        options = replace(
            options,
            margin_px=max(options.margin_px, _SOLID_MARGIN_PX),
            margin_blurs=max(options.margin_blurs, _SOLID_MARGIN_BLURS),
        )
    leans = mark.is_held_by_frame
    if frame_sigma is None:
        return replace(options, freedom="shift") if leans else options
    if not leans and np.allclose(_one_sided_px(mark, np.eye(2)), 0.0):
        return options
    in_part = isinstance(mark, MarkShape) and mark.true_mm is not None
    held = float(np.hypot(frame_sigma, _DRAWN_SIGMA if in_part else 0.0))
    return replace(options, freedom="affine", linear_sigma=held if leans else options.linear_sigma, strain_sigma=held)


def strain_error_px(mark: Mark, fitted: Array, linear: Array, sigma: float) -> float:
    """Approximate error of a mark's place from the stretch and shear with which it was fitted.

    It is the shift of the drawing's one-sided part by the difference of stretch and shear between fitted (2, 2) and
    linear (2, 2), combined with sigma, their standard deviation in linear.
    """
    change = linear @ np.linalg.inv(fitted) - np.eye(2)
    strain = (change + change.T) / 2 - np.trace(change) / 2 * np.eye(2)
    one_sided = _one_sided_px(mark, linear)
    return float(np.hypot(np.hypot(*(strain @ one_sided)), sigma * np.hypot(*one_sided)))


def _one_sided_px(mark: Mark, linear: Array) -> Array:
    """(2,) difference between the extents of a mark's drawing to either side, in x and y."""
    least, greatest = extent_px(mark, np.column_stack([linear, np.zeros(2)]))
    return least + greatest
