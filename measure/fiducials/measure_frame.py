"""One frame of a scan, measured at full resolution: its value (`Frame`), and the steps from its placement to its fits.

The marks are detected and the interior orientation is estimated from the inliers. The other marks are detected where it
predicts them, faint ones against the texture there. All marks are then refitted with what they have in common,
rotation, scale and strain of the frame, width of the lines, sharpening, tone curve and blur, and are compared with one
another. Each step returns a new frame.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from measure.array_types import Array, Mask, Single
from measure.detection.correlation import CLOSE
from measure.detection.localisation import TEMPLATE_BLURS_PX, MarkPrediction, PeakSearch
from measure.fiducials.channel_weights import estimate_weights
from measure.fiducials.consistency import FrameMarks, Scatter, gross_errors
from measure.fiducials.constellation import NARROW, Placement, mark_sign
from measure.fiducials.faint_marks import FaintMark, detect_faint, reason_not_found
from measure.fiducials.interior_orientation import FilmFit, film_terms, fit_frame, interleaved
from measure.fiducials.mark_comparison import (
    SharedBlur,
    SharedShape,
    Touch,
    lines_and_rounds,
    measure_parts,
    parts_apart,
    shared_blurs,
    shared_line_width,
    shared_shapes,
    smear_px2,
    touch_of_round,
    unlike_blur,
    unlike_others,
)
from measure.fiducials.mark_fit import Detection, detect_mark, not_found, strain_error_px
from measure.fiducials.options import CLICK_SIGMA_PX, SCATTER_DEGREES, SCATTER_MM, FiducialOptions
from measure.flags import (
    FAINT_MARK_BY_NOISE,
    LARGE_ERROR,
    NO_REASON,
    TEXTURE_LIKE_A_FAINT_MARK,
    Cause,
    Code,
    Reason,
    Status,
)
from measure.geometry import UP_FROM_CAMERA, linear_scale
from measure.marks.rendering import extent_px, mark_window, reach_px
from measure.marks.shapes import (
    MOST_GIVEN_SIGMA_MM,
    Disk,
    FiducialLayout,
    FrameCorner,
    Mark,
    MarkShape,
    Ring,
    widen_lines,
)
from measure.matching.models import PIXEL_VARIANCE_PX2, MatchOptions
from measure.matching.window import read_window
from measure.noise.noise_model import may_be_noise
from measure.results import MarkFit, largest_sigma_px
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import FEWEST_MARKS, Sharpening, estimate_sharpening

MANY = 6  # inliers from which the predicted place of a faint mark is reliable
CLEAR_DAMAGE = 0.25  # fraction of a mark: with more of it damaged, the rest may belong to something else
_CLEAR_SNR = 3.0  # contrast over the noise of a pixel: with less a mark is weak,
_CLEAR_SIGNIFICANCE = 10.0  # unless its contrast has this many standard deviations
_LEAST_SIGNIFICANCE = 4.5  # standard deviations of the contrast: texture alone stays below it
_AGREEING, _AGREEING_SHARE = 3, 0.3  # least inliers; fraction of the marks in the scan; two fit any similarity
CHECKED = 4  # inliers from which an affine transformation has redundancy
_WRONG_PX = 0.5  # px, an error that a mark with status measured must not have
_PLAIN_SIGMA_PX = 0.25  # px; a standard deviation is reliable in white noise, but only in part on image texture
_MOST_LOST = 0.85  # fraction of the information on the place: the rest may be the end of a line, or something else
_MOST_UNLIKE = 0.03  # fraction of a mark that a wrong drawing may explain, added to CLEAR_DAMAGE
_FAR = 4.0  # times the median misfit of the inliers: nearly five standard deviations
_NEAR = 2.0  # times the same: one good mark in sixteen lies farther off
_LEAST_SCATTER_MM = 2 * SCATTER_MM  # mm, least median misfit: a few marks may agree by chance better than film allows
_FAILED = {Code.NO_FIT, Code.OFF_PLACE, Code.SIZE, Code.POLARITY}  # reasons that another tone curve may cure
SAME_MARK_PX = 5.0  # px between two fits of one mark at most; two marks lie farther apart: each is some 14 px large
REDUCED_PX = 1.5  # px of the reduced scan: accuracy of the places that a placement predicts
_CLICK_REACH_PX = 6 * CLICK_SIGMA_PX  # px around a click: three sigma, doubled for people who point less accurately
LEAST_LIKENESS = 0.35  # correlation with the drawing: below it texture, text and scratches are as similar
_FAINT_SIGNIFICANCE = 2.0  # _LEAST_SIGNIFICANCE where noise hardly gives such a peak: there is contrast, at 95 %
_TRIALS = 6  # about this many marks are used to choose the channels, or to test a placement
_FEWEST_SHARPENED = 4  # clear marks for a first estimate of the sharpening: of three, one may be taken for halos
_ROUNDS = 2  # of detecting faint marks: the first marks found improve the predictions of the others
_RESOUGHT_PX = 0.3  # px: predictions that moved by less give the same faint marks, at places within 0.003 px
_LEAST_REACH_PX = 3.0  # px: film deformation displaces single marks so far, however well most agree
_FAINT_CONTRAST = 1 / 250  # fraction of full scale: less is one grey level of 8 bits, or a compression artefact
_FAINT_SIGMA_PX = 0.75  # px, largest standard deviation of a measured faint mark
_SAME_PX = 1.0  # px between two places of one faint mark at most; each is more accurate than that
_EXTREMES = (0.5, 99.5)  # percentiles of the grey values taken as darkest and lightest
_SURROUND = 6.0  # times a mark's own extent: enough of the scan for its darkest and lightest grey values
RANDOM_PLACES = 64  # compared beside the marks: enough to test three marks found of four
_OFFSETS = (2.5, 4.5)  # in search radii, more for large marks: beyond the response of the mark itself
_LEAST_FALSE_ALARMS = 1e-300  # has a logarithm
FITTED_PX = 3.0  # px, largest distance between the fitted place and the correlation peak
_STRAINED = 1 / 3  # fraction of a mark's standard deviation: a larger strain error raises it by more than a twentieth
_BETTER_KNOWN = 2 / 3  # ratio of the standard deviations of rotation and scale after and before a refit for another one
_TONE_ROUNDS = 5  # largest number of refits with an improved tone curve
_OTHER_STARTS, _AGREED = (2.2, 1.0), 0.1  # gammas of further initial curves; disagreement up to which none is tried
_MOST_SIGNIFICANT = 8  # marks refitted until widths, sharpening and tone curve are settled: more cost time
_SHARED_ROUNDS = 8  # largest number of refits with improved widths and sharpening
_UNCHECKED = 3  # marks, which an affine transformation fits without residuals
_REFIT_PX = 1.5  # search range around a mark that was fitted already
_TOUCHED_PX = 0.3  # rms displacement of the edges of wedges and notches that the background touches
_MOST_UNEQUAL = 10.0  # logarithm of a size ratio: the edges of a wedge may leave its size open by any amount


@dataclass(frozen=True, eq=False)
class Frame:
    """Frame of n marks in one placement. Each step of the measurement returns a new value.

    Attributes
    ----------
    scan : with the tone curve through which the marks were fitted.
    placement : from the coarse search.
    pixel_from_camera : (2, 3) interior orientation; that of the placement if fewer than two marks agree.
    detections : of all n marks.
    inliers : (n,) marks that were found and agree.
    certain : (n,) marks that stand out from the texture clearly enough to be exempt from the outlier test.
    linear_sigma : standard deviation of the rotation (rad), scale, stretch and shear; inf before the adjustment.
    weights : of the channels.
    channel_note : note on channels that do not coincide.
    tone : tone curve estimated from the marks.
    film : terms of the project's film deformation model beyond pixel_from_camera, None for an affine one.
    """

    scan: Scan
    layout: FiducialLayout
    options: FiducialOptions
    placement: Placement
    pixel_from_camera: Array
    detections: tuple[Detection, ...]
    inliers: Mask
    certain: Mask
    linear_sigma: float = np.inf
    weights: tuple[float, ...] | None = None
    channel_note: str = ""
    tone: FrameTone = field(default_factory=lambda: FrameTone(LINEAR))
    film: FilmFit | None = None

    @classmethod
    def from_placement(
        cls, scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions
    ) -> "Frame":
        """Start a frame from a placement, with no mark detected yet."""
        none = np.zeros(len(layout.marks), dtype=bool)
        places = placement.places_px(layout.places_mm)
        detections = tuple(Detection(place, False, None) for place in places)
        tone = FrameTone(scan.tone.prior)
        start, film = placement.pixel_from_camera, placement.film
        return cls(scan, layout, options, placement, start, detections, none, none.copy(), tone=tone, film=film)

    @cached_property
    def camera_mm(self) -> Array:
        """(n, 2) given coordinates of the marks."""
        return self.layout.places_mm

    @property
    def pitch_mm(self) -> Array:
        """(2,) pixel pitch."""
        return np.asarray(self.placement.pitch_mm)

    @property
    def gate_px(self) -> float:
        """Search radius around a place predicted from the other marks."""
        return self.options.gate_mm / float(self.pitch_mm.mean())

    @property
    def largest_misfit_px(self) -> float:
        """Largest deviation of a mark from its given place that is allowed in the search."""
        return self.options.search_mm(self.layout) / float(self.pitch_mm.mean())

    @property
    def first_search_px(self) -> float:
        """Search radius around a place predicted from the placement."""
        return REDUCED_PX * self.placement.reduction + self.largest_misfit_px

    @cached_property
    def predicted_px(self) -> Array:
        """(n, 2) places of the marks predicted from the interior orientation."""
        return self.fitted_placement.places_px(self.camera_mm)

    def linear(self, index: int) -> Array:
        """(2, 2) derivatives of the interior orientation at a mark, px per mm."""
        return self.fitted_placement.linear(self.camera_mm[index])

    @cached_property
    def misfit_mm(self) -> Array:
        """(n,) distances of the fitted from the predicted places, nan for marks without a fit."""
        places = [np.full(2, np.nan) if each.fit is None else each.fit.center_px for each in self.detections]
        return np.asarray(np.hypot(*((np.array(places) - self.predicted_px) * self.pitch_mm).T))

    def up_mm(self, scan_px: Array) -> Array:
        """Convert scan places (n, 2), px, to mm right and up, corrected for the distortion of a taking lens."""
        lens = self.options.lens
        ideal = scan_px if lens is None else lens.ideal_px(scan_px)
        return np.asarray(ideal * self.pitch_mm * (1.0, -1.0))

    @property
    def scatter_mm(self) -> float:
        """Median misfit of the inliers; 0 without inliers."""
        return float(np.median(self.misfit_mm[self.inliers])) if self.inliers.any() else 0.0

    def prediction(self, index: int, search_px: float) -> MarkPrediction:
        """Predict a mark from the interior orientation, or from a click, which narrows the search radius."""
        mark, place = self.layout.marks[index], self.predicted_px[index]
        for click in self.options.clicks:
            if click.point == mark.id:
                place, search_px = np.array([click.col_px, click.row_px]), min(search_px, _CLICK_REACH_PX)
        start = np.column_stack([self.linear(index), place])
        sign = mark_sign(mark.mark, self.placement.polarity)
        return MarkPrediction(mark.mark, start, search_px, sign, self.weights, self.placement.surroundings)

    def peak(self, index: int, place_px: Array, radius_px: float, blur_px: float) -> PeakSearch:
        """Highest correlation of a mark, by index, rendered with a blur, within a radius of a place in the scan."""
        return PeakSearch(self.scan, self.prediction(index, radius_px).shift_to(place_px), blur_px)

    def response_px(self, index: int) -> float:
        """Distance from which a search does not respond to a mark, by index, itself."""
        low, high = extent_px(self.layout.marks[index].mark, self.prediction(index, 0.0).pixel_from_mark)
        return self.first_search_px + float((high - low).max()) / 2

    def fitted_peaks(self, places_px: Mapping[int, Array]) -> tuple[dict[int, float], float]:
        """Correlations of marks, by index, about the places where they were fitted, and the blur of their template:
        the one that stands out more from noise. Marks of one frame are equally wide."""
        peaks = [
            {index: self.peak(index, place, FITTED_PX, blur_px) for index, place in places_px.items()}
            for blur_px in TEMPLATE_BLURS_PX
        ]
        doubts = [sum(np.log(max(each.false_alarms, _LEAST_FALSE_ALARMS)) for each in own.values()) for own in peaks]
        best = int(np.argmin(doubts))
        return {index: each.height for index, each in peaks[best].items()}, TEMPLATE_BLURS_PX[best]

    def replace_detections(self, changed: Mapping[int, Detection]) -> "Frame":
        """Return the frame with the detections of some marks replaced, by index."""
        return replace(self, detections=tuple(changed.get(index, each) for index, each in enumerate(self.detections)))

    def replace_fits(self, changed: Mapping[int, MarkFit]) -> "Frame":
        """Return the frame with the fits of some marks replaced, by index."""
        return self.replace_detections(
            {index: replace(self.detections[index], fit=each) for index, each in changed.items()}
        )

    @cached_property
    def inlier_fits(self) -> dict[int, MarkFit]:
        """Fits of the inliers by index."""
        fits = ((index, self.detections[index].fit) for index in np.flatnonzero(self.inliers).tolist())
        return {index: fit for index, fit in fits if fit is not None}

    @cached_property
    def clear_fits(self) -> dict[int, MarkFit]:
        """Fits of the inliers that correlate clearly with their drawings, by index."""
        return {index: fit for index, fit in self.inlier_fits.items() if fit.is_clear}

    @cached_property
    def fitted_placement(self) -> Placement:
        """Placement by the interior orientation from the inliers."""
        return replace(self.placement, pixel_from_camera=self.pixel_from_camera, film=self.film)

    @cached_property
    def inside(self) -> Mask:
        """(n,) mask of the marks predicted within the scan."""
        return np.array([detection.inside for detection in self.detections])

    @property
    def inside_count(self) -> int:
        """Number of these marks."""
        return int(self.inside.sum())

    @property
    def is_certain_of_places(self) -> bool:
        """Whether enough marks agree, half of `MANY` of them clear, for the places of the others to be reliable."""
        return len(self.inlier_fits) >= MANY and len(self.clear_fits) >= MANY / 2

    @property
    def agrees(self) -> bool:
        """Whether enough marks are inliers, clear or not: three, and three in ten of those in the scan."""
        return len(self.inlier_fits) >= self._enough

    @property
    def failed_fits(self) -> list[int]:
        """Indices of the marks whose fit failed, if at most one would be missing for acceptance with all of them."""
        failed = [i for i, each in enumerate(self.detections) if each.fit is None and _FAILED & {*each.reason.codes}]
        found = sum(each.fit is not None for each in self.detections)
        return failed if found + len(failed) >= self._enough - 1 else []

    @property
    def accepted(self) -> bool:
        """Whether enough marks agree for the frame to be no false alarm, at least three of them clear."""
        return self.agrees and len(self.clear_fits) >= self.least

    @property
    def is_faint(self) -> bool:
        """Whether all its marks together decide on it: none of them need be clear."""
        return self.placement.surroundings.robust or not self.accepted

    @cached_property
    def unblemished(self) -> list[int]:
        """Indices of the marks with status measured that agree with the others."""
        near = self.inliers & (self.misfit_mm <= _FAR * max(self.scatter_mm, _LEAST_SCATTER_MM))
        return [index for index in np.flatnonzero(near).tolist() if self.verdict(index)[0] is Status.MEASURED]

    @property
    def is_sure(self) -> bool:
        """Whether it is accepted and has enough unblemished marks: a frame found at a wrong place has hardly any."""
        return self.accepted and len(self.unblemished) >= self.least

    @property
    def _enough(self) -> int:
        """Least number of inliers."""
        return max(self.least, int(np.ceil(_AGREEING_SHARE * self.inside_count)))

    @property
    def least(self) -> int:
        """Least number of clear marks."""
        return 2 if self.options.part else max(min(_AGREEING, len(self.detections)), 2)

    def contains(self, other: "Frame") -> bool:
        """Whether the other frame's inliers are a proper subset of this one's, under other names.

        A frame shifted by the distance of two marks has its marks at places of other marks of this one.
        """
        own, others = ([fit.center_px for fit in frame.inlier_fits.values()] for frame in (self, other))
        if not others or len(others) >= len(own):
            return False
        nearest = np.hypot(*np.moveaxis(np.array(others)[:, None] - np.array(own)[None], -1, 0)).min(axis=1)
        return bool(nearest.max() < SAME_MARK_PX)

    def verdict(self, index: int) -> tuple[Status, Reason]:
        """Status of a mark and the reasons for it.

        An inlier is judged by its image alone: its residual is evidence on the frame.
        """
        fit = self.detections[index].fit
        if fit is None or not self.inliers[index]:
            off = f"{self.misfit_mm[index]:.2f} mm from where the other {int(self.inliers.sum())} marks put it"
            return Status.REJECTED, Reason(f"what was measured lies {off}", Code.OFF_PLACE)
        reasons = [self.detections[index].reason]
        if not fit.is_clear:
            reasons.append(Reason(f"it correlates with its drawing by only {fit.likeness:.2f}", Code.LIKENESS))
        if fit.snr < _CLEAR_SNR and fit.significance < _CLEAR_SIGNIFICANCE:
            reasons.append(Reason(f"its contrast is only {fit.snr:.1f} times the noise", Code.CONTRAST))
        elif fit.significance < _LEAST_SIGNIFICANCE:
            texture = f"its contrast is only {fit.significance:.1f} standard deviations of the texture"
            reasons.append(Reason(texture, Code.CONTRAST))
        # Damage common to all means that the drawing is wrong.
        fractions = [each.damaged_fraction for each in self.inlier_fits.values()]
        usual_damage = float(np.median(fractions)) if len(fractions) >= CHECKED else 0.0
        if fit.damaged_fraction > CLEAR_DAMAGE + min(usual_damage, _MOST_UNLIKE):
            reasons.append(Reason(f"{fit.damaged_fraction:.0%} of it is damaged", Code.COVERED))
        elif fit.lost_fraction > _MOST_LOST:
            lost = f"{fit.lost_fraction:.0%} of its edges across one direction are damaged"
            reasons.append(Reason(lost, Code.COVERED))
        own_px2 = fit.place_covariance.without(Cause.SMEAR).px2  # a smear has a reason of its own
        sigma_px = largest_sigma_px(own_px2)
        is_plain = fit.covariance_is_white and sigma_px <= _PLAIN_SIGMA_PX
        if chdtrc(2, (_WRONG_PX / sigma_px) ** 2) > LARGE_ERROR and not is_plain:
            reasons.append(Reason(f"its standard deviation is {sigma_px:.2f} px", Code.IMPRECISE))
        reason = Reason.combine(reasons)
        return (Status.WEAK, reason) if reason else (Status.MEASURED, NO_REASON)


def measure_frame(
    scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions, begun: Frame | None = None
) -> Frame:
    """Measure a frame from its placement. begun: the frame with some of its marks detected, of `detect_some`."""
    frame = detect_frame(scan, layout, placement, options, begun)
    # A sharpening that is known by then is not estimated again: amount and radius trade off, and the marks hardly move.
    return refit_frame(frame if frame.scan.tone.sharpening.is_determined else fit_lines_and_sharpening(frame))


def detect_frame(
    scan: Scan,
    layout: FiducialLayout,
    placement: Placement,
    options: FiducialOptions,
    begun: Frame | None = None,
    is_quick: bool = False,
) -> Frame:
    """Detect the marks of a frame, clear and faint ones, without the refit. begun: as for `measure_frame`; is_quick:
    without the width of lines and the sharpening, which take longer than the marks."""
    frame = begun or start_frame(scan, layout, placement, options)
    pending = [index for index, each in enumerate(frame.detections) if not (each.inside or each.reason)]
    clear = orient_frame(_detect(frame, pending, frame.first_search_px))
    return detect_missing_marks(clear if is_quick else fit_lines_and_sharpening(clear, _FEWEST_SHARPENED))


def start_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Start a frame from its placement, with the channel weights of a colour scan, estimated from some of the marks.

    If no mark is drawn as light or dark, the weights also determine the polarity.
    """
    frame = Frame.from_placement(scan, layout, placement, options)
    if scan.channels == 1:
        return frame
    marks = layout.marks
    tried = range(0, len(marks), max(1, len(marks) // _TRIALS))
    signs = (1, -1) if all(mark.mark.polarity == "auto" for mark in marks) else (1,)
    found = estimate_weights(scan, [frame.prediction(index, frame.first_search_px) for index in tried], signs)
    if found is None:
        return frame
    weights, sign, note = found
    placement = replace(frame.placement, polarity=sign * frame.placement.polarity)
    return replace(frame, weights=weights, channel_note=note, placement=placement)


def _detect(
    frame: Frame,
    indices: Iterable[int],
    search_px: float,
    least_likeness: float = LEAST_LIKENESS,
    places_px: Mapping[int, Array] | None = None,
) -> Frame:
    """Detect marks again within search_px of their current predictions, or of places_px, by index.

    A fit that texture could give is dropped, unless all marks together decide on the frame. Faint marks of a frame of
    many are detected later, where the others predict them.
    """
    match, closer = replace(frame.options.match, estimate_sharpening=True), frame.placement.surroundings.robust

    def detection(index: int) -> Detection:
        """Detection of one mark."""
        expected = frame.prediction(index, search_px)
        found = detect_mark(frame.scan, expected if places_px is None else expected.shift_to(places_px[index]), match)
        sure = found.false_alarms <= FAINT_MARK_BY_NOISE
        likeness = (0.0 if closer else least_likeness) if sure else LEAST_LIKENESS
        is_faint = sure and (closer or len(frame.detections) <= MANY)
        significance = _FAINT_SIGNIFICANCE if is_faint else _LEAST_SIGNIFICANCE
        if found.fit is not None and (found.fit.likeness < likeness or found.fit.significance < significance):
            return Detection(found.predicted_px, True, None, not_found(expected.search_px))
        return found

    # From the bottom upwards: the search in windows ended there, and the rows read last are still decoded.
    upwards = sorted(indices, key=lambda index: -frame.predicted_px[index, 1])
    return frame.replace_detections(dict(zip(upwards, map_in_threads(detection, upwards), strict=True)))


def orient_frame(frame: Frame) -> Frame:
    """Separate inliers from gross errors and estimate the interior orientation from the inliers.

    Each place has the covariance of its fit and of its given coordinates; the film's scatter is added to the weights.
    Certain and clicked marks are never removed.
    """
    found = np.array([each.fit is not None for each in frame.detections])
    inliers = found.copy()
    if found.sum() < 2:
        return replace(frame, inliers=inliers)
    index = np.flatnonzero(found)
    fits = [frame.detections[i].fit for i in index]
    up = frame.up_mm(np.array([fit.center_px for fit in fits if fit]))
    up_from_px = np.diag(frame.pitch_mm * (1.0, -1.0))
    covariances = np.array([up_from_px @ fit.covariance_px2 @ up_from_px for fit in fits if fit])
    given = np.array([min(*frame.layout.marks[i].sigma_mm, MOST_GIVEN_SIGMA_MM) for i in index])
    covariances += given[:, None, None] ** 2 * np.eye(2)
    film = Scatter(frame.options.film_sigma_mm, SCATTER_DEGREES)
    camera, model = frame.camera_mm, frame.options.film_model
    clicked = {click.point for click in frame.options.clicks}
    known = frame.certain | [mark.id in clicked for mark in frame.layout.marks]
    out = gross_errors(FrameMarks.from_places(camera[index], up, covariances, model), film, frame.options.gate_mm)
    out &= ~known[index]
    inliers[index[out]] = False
    sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2 + film.sigma**2)
    fit = fit_frame(camera[index[~out]], up[~out], sigma[~out], UP_FROM_CAMERA[frame.placement.pose], model)
    pixel_from_camera = np.diag([1.0, -1.0]) @ fit.up_from_camera / frame.pitch_mm[:, None]
    return replace(
        frame, inliers=inliers, pixel_from_camera=pixel_from_camera, linear_sigma=fit.linear_sigma, film=fit.film
    )


def detect_missing_marks(frame: Frame) -> Frame:
    """Detect the missing and unclear marks around the places predicted from the inliers."""
    if frame.accepted:
        closer = {}
        for index, before in enumerate(frame.detections):
            if before.is_clear and frame.inliers[index]:
                continue
            # With narrow surroundings, since dust or an edge may lie beside.
            expected = replace(frame.prediction(index, frame.gate_px), surroundings=CLOSE)
            detection = detect_mark(frame.scan, expected, frame.options.match)
            fit, is_sure = detection.fit, detection.false_alarms <= TEXTURE_LIKE_A_FAINT_MARK
            if is_sure and fit and fit.is_clear and fit.significance >= _LEAST_SIGNIFICANCE:
                closer[index] = replace(detection, closer=True)
        frame = orient_frame(frame.replace_detections(closer))
    if frame.inliers.sum() >= 2 and not frame.is_certain_of_places:
        if len(frame.detections) > MANY:
            # If the frame itself is uncertain, the wide radius would turn texture into marks.
            narrow_px = REDUCED_PX * frame.placement.reduction + NARROW * frame.largest_misfit_px
            frame = detect_faint_marks(frame, narrow_px if frame.placement.surroundings.robust else frame.gate_px)
            # With such a search radius no mark is exempt from the outlier test.
            frame = replace(frame, certain=np.zeros_like(frame.certain))
        else:
            frame = _detect_elsewhere(frame)
        frame = orient_frame(frame)
    sought_px = np.full(frame.camera_mm.shape, np.inf)
    for _ in range(_ROUNDS):
        if frame.is_certain_of_places and np.abs(frame.predicted_px - sought_px).max() > _RESOUGHT_PX:
            film_px, sought_px = _FAR * frame.scatter_mm / float(frame.pitch_mm.mean()), frame.predicted_px
            frame = orient_frame(detect_faint_marks(frame, min(frame.gate_px, max(film_px, _LEAST_REACH_PX))))
    return frame


def _detect_elsewhere(frame: Frame) -> Frame:
    """Detect unclear marks within the gate of their predictions, then farther off, where only clear fits count.

    An unclear fit counts if no random place matches as well: halos, clipping and motion make a mark unlike its drawing.
    """
    affine = np.column_stack([frame.camera_mm, np.ones(len(frame.camera_mm))])
    for index in [index for index, each in enumerate(frame.detections) if not each.is_clear]:
        near = far = _detect(frame, [index], frame.gate_px, least_likeness=0.0)
        # In the adjustment with the mark itself, its residual is its distance from the prediction by the others, over
        # 1 + q, where q is the variance of that prediction in units of a mark's variance: it has to keep the gate.
        others = np.flatnonzero(frame.inliers & (np.arange(len(frame.inliers)) != index))
        far_px = frame.gate_px
        if np.linalg.matrix_rank(affine[others]) == affine.shape[1]:
            variance = float(affine[index] @ np.linalg.inv(affine[others].T @ affine[others]) @ affine[index])
            far_px = min((1 + variance) * frame.gate_px, frame.first_search_px)
        if not near.detections[index].is_clear and far_px > frame.gate_px:
            far = _detect(frame, [index], far_px)
        found = near.detections[index]
        if far.detections[index].is_clear:
            near = far
        elif found.fit is not None and any(random_matches(near, [index])[0].values()):
            near = near.replace_detections({index: replace(found, fit=None, reason=not_found(near.gate_px))})
        frame = near
    return frame


def random_matches(frame: Frame, indices: Iterable[int]) -> tuple[dict[int, int], int]:
    """Count the random places beside the marks that match as well as each of some marks, by index, where it was fitted.

    Returns also the number of these places: around the marks, in eight directions, each for the mark beside it.
    """
    radius_px = frame.first_search_px
    inside = np.flatnonzero(frame.inside).tolist()
    angles = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    size = np.array([frame.scan.width_px, frame.scan.height_px])
    unit_px = {index: max(radius_px, frame.response_px(index) / _OFFSETS[0]) for index in inside}
    every = [
        (index, np.asarray(frame.predicted_px[index] + off * unit_px[index] * direction))
        for off in _OFFSETS
        for direction in directions
        for index in inside
    ]
    within = [(index, place) for index, place in every if np.all(place >= 0) and np.all(place < size)]
    step = max(1, len(within) // RANDOM_PLACES)
    own, blur_px = frame.fitted_peaks(
        {index: fit.center_px for index in indices if (fit := frame.detections[index].fit)}
    )
    others = [frame.peak(*each, radius_px, blur_px).height for each in within[::step][:RANDOM_PLACES]]
    return {index: sum(each >= height for each in others) for index, height in own.items()}, len(others)


def detect_faint_marks(frame: Frame, reach_px: float) -> Frame:
    """Detect again every mark that is not clear or deviates from its predicted place.

    A candidate that stands out from the texture there is taken for the mark; its deviation is film deformation. A clear
    fit farther off may be a pattern beside the mark.
    """
    near = frame.inliers & (frame.misfit_mm <= _NEAR * max(frame.scatter_mm, frame.options.film_sigma_mm))
    inside = np.flatnonzero(frame.inside).tolist()
    marks, fits = [each.mark for each in frame.layout.marks], frame.inlier_fits
    faint = [
        index
        for index in inside
        if not (frame.detections[index].is_clear and near[index])
        if not isinstance(marks[index], FrameCorner)  # it has no lines that stand out from texture
    ]
    if not faint or not fits:
        return frame
    # Blur and contrast come from the inliers: a faint mark gives both less accurately.
    blur_px = float(np.median([fit.blur_px for fit in fits.values()]))
    usual_dn = float(np.median([abs(fit.stored_contrast_dn) for fit in fits.values()]))
    # Darkest and lightest grey values around the marks, which are spread over the scan.
    starts = [frame.prediction(index, 0.0).pixel_from_mark for index in inside]
    around = [_surrounding_grey(frame, marks[n], start, _SURROUND) for n, start in zip(inside, starts, strict=True)]
    extremes = np.percentile(np.concatenate(around), _EXTREMES, overwrite_input=True)  # spares a copy of much of a scan
    detections, certain = {}, frame.certain.copy()
    for index in faint:
        expected = frame.prediction(index, reach_px)
        extreme_dn = float(extremes[int(expected.polarity > 0)])
        mark = detect_faint(frame.scan, expected, extreme_dn, blur_px)
        grey = _surrounding_grey(frame, expected.mark, expected.pixel_from_mark, 1.0)
        room_dn = max(expected.polarity * (extreme_dn - float(np.median(grey))), 0.0)
        contrasts_dn = room_dn, usual_dn, float(grey.std())
        detections[index], certain[index] = _choose_detection(frame, index, expected, mark, contrasts_dn)
    return replace(frame.replace_detections(detections), certain=certain)


def _surrounding_grey(frame: Frame, mark: Mark, pixel_from_mark: Array, times: float) -> Single:
    """(n,) grey values in a mark's bounding rectangle, enlarged by a factor."""
    center = pixel_from_mark[:, 2]
    least, greatest = (center + times * (corner - center) for corner in extent_px(mark, pixel_from_mark))
    low, size = np.floor(least).astype(int), np.ceil(greatest - least).astype(int) + 1
    window = frame.scan.window(int(low[0]), int(low[1]), int(size[0]), int(size[1]), frame.weights)
    return np.asarray(window, np.float32).ravel()


def _choose_detection(
    frame: Frame,
    index: int,
    expected: MarkPrediction,
    mark: FaintMark | None,
    contrasts_dn: tuple[float, float, float],
) -> tuple[Detection, bool]:
    """Choose between the earlier detection of a mark and the faint one; returns also whether it is certain.

    contrasts_dn: as for `reason_not_found`.
    """
    before, is_clear, is_certain = frame.detections[index], frame.detections[index].is_clear, False
    if mark is not None:  # significant against texture and rounding
        strong = abs(mark.fit.stored_contrast_dn) >= _FAINT_CONTRAST * frame.scan.full_scale_dn
        is_certain = mark.false_alarms <= TEXTURE_LIKE_A_FAINT_MARK and strong
    if mark is None or not (is_certain and mark.sigma_px <= _FAINT_SIGMA_PX):
        why_not = reason_not_found(expected, contrasts_dn, mark, is_certain)
        return before if is_clear else Detection(before.predicted_px, True, None, why_not), False
    away_px = np.inf if before.fit is None else float(np.hypot(*(before.fit.center_px - mark.fit.center_px)))
    if is_clear and away_px <= _SAME_PX:
        # A second detection from the same pixels is no new evidence for a clear inlier.
        return before, bool(frame.certain[index]) or not frame.inliers[index]
    second = Reason(f"{away_px:.0f} px from it is a second candidate", Code.AMBIGUOUS)
    return Detection(before.predicted_px, True, mark.fit, second if is_clear else NO_REASON), True


def fit_lines_and_sharpening(frame: Frame, fewest: int = 0) -> Frame:
    """Estimate what all marks of the scan share, the width of their lines and its sharpening, and refit them with it.

    fewest: marks without which the sharpening is left for later.

    Exposure widens or narrows the lines of all crosses of a frame alike. Where a line is drawn too wide, the size of a
    cross takes that up, and the ends of its arms are taken for damage, as are the halos of a sharpened scan.
    """
    start, indices = frame, sorted(frame.clear_fits, key=lambda index: -frame.clear_fits[index].significance)
    options, significant = replace(frame.options.match, estimate_sharpening=True), indices
    before, last = frame.scan.tone.sharpening, None
    for _ in range(_SHARED_ROUNDS):
        drawn = _widen_drawings(frame, significant)
        fits = {index: frame.detections[index].fit for index in significant}
        scores = {index: fit.sharpening for index, fit in fits.items() if fit and fit.sharpening}
        found = before
        if start.agrees and len(scores) >= max(fewest, FEWEST_MARKS):
            found = estimate_sharpening(before, list(scores.values()), len(frame.scan.tone.mean)) or Sharpening()
        if drawn is frame and found.is_close_to(before):
            break
        significant = significant[:_MOST_SIGNIFICANT]
        if before and last:  # of the others only the detail is fitted, which is independent of it
            significant = [index for index in significant if index in scores] or significant
        last, before = (before, found), found.accelerate(before, last)
        toned = replace(drawn, scan=drawn.scan.replace_tone(drawn.scan.tone.replace_sharpening(before)))
        frame = _refit(toned, dict.fromkeys(significant, options), orient=False)
    if frame is start:
        return frame
    toned = replace(frame, scan=frame.scan.replace_tone(frame.scan.tone.replace_sharpening(found)))
    return _refit(toned, dict.fromkeys({*indices} - {*significant}, options))


def _widen_drawings(frame: Frame, among: Sequence[int]) -> Frame:
    """Draw the lines of crosses as wide as those among the marks show them; the same frame if they are so already."""
    groups: dict[Mark, list[tuple[float, float] | None]] = defaultdict(list)
    for index in among:
        fit = frame.detections[index].fit
        groups[frame.layout.marks[index].mark].append(None if fit is None else fit.line_width)
    ratios = {mark: shared_line_width(widths) for mark, widths in groups.items() if isinstance(mark, MarkShape)}
    if all(ratio == 1 for ratio in ratios.values()):
        return frame
    wider: dict[Mark, Mark] = {mark: widen_lines(mark, ratio) for mark, ratio in ratios.items()}
    marks = tuple(replace(each, mark=wider.get(each.mark, each.mark)) for each in frame.layout.marks)
    return replace(frame, layout=replace(frame.layout, marks=marks))


def refit_frame(frame: Frame) -> Frame:
    """Refit the marks of a frame with parameters estimated from all of them, and compare them with one another.

    Marks whose image does not determine rotation and scale take those of the frame, as do marks displaced by stretch
    and shear, which no single fit determines. Marks displaced by the tone curve are refitted with the curve estimated
    from all marks. Marks whose blur is poorly determined take that of the others.
    """
    if len(frame.inlier_fits) >= 2:
        frame = orient_frame(shift_to_curve(_refit_with_blur(_refit_with_tone(frame))))
    return compare_shapes(_compare_parts(_add_common_covariances(frame)))


def _refit_with_tone(frame: Frame) -> Frame:
    """Refit the marks with the tone curve estimated from all of them; if these disagree, from further curves."""
    sigma, options = _linear_sigma(frame), frame.options.match
    # With a film model or lens every fit depends on the frame; else those that its rotation, scale or strain displaces.
    is_affine, pending = frame.film is None and frame.options.lens is None, []
    for index, fit in frame.clear_fits.items():
        mark = frame.layout.marks[index].mark
        error_px = strain_error_px(mark, fit.pixel_from_mark[:, :2], frame.linear(index), sigma)
        if not is_affine or mark.is_held_by_frame or error_px > _STRAINED * fit.sigma_px:
            pending.append(index)
    best = _refit(frame, dict.fromkeys(pending, options))
    if _linear_sigma(best) < _BETTER_KNOWN * sigma:  # the uncertain places of before had left the frame's scale open
        best = _refit(best, dict.fromkeys(pending, options))
    best = _settle_tone(best)
    is_open = (
        best.tone.is_determined
        and best.tone.disagreement > _AGREED
        and any(tone.sensitivity_px > best.clear_fits[index].sigma_px for index, tone in _mark_tones(best).items())
    )
    for power in _OTHER_STARTS if is_open else ():
        start = replace(best, scan=best.scan.replace_tone(frame.scan.tone.prior.shift_to_power(power)))
        other = _settle_tone(_refit(start, dict.fromkeys(_mark_tones(best), options)))
        is_better = not other.tone.is_doubted and other.tone.disagreement < best.tone.disagreement
        best = other if is_better else best
    return best


def _settle_tone(frame: Frame) -> Frame:
    """Estimate the tone curve from the marks, and refit these with it as long as it moves any of them by much."""
    for rounds_left in range(_TONE_ROUNDS, -1, -1):
        tones, fits, before = _mark_tones(frame), frame.clear_fits, frame.scan.tone
        estimate = FrameTone.from_marks(before.prior, tones, before)
        frame = replace(frame, tone=estimate)
        is_moved = estimate.is_determined and any(
            estimate.moves(each, before, fits[n].covariance_px2) for n, each in tones.items()
        )
        if not (is_moved and rounds_left):
            break
        frame = replace(frame, scan=frame.scan.replace_tone(estimate.next_curve(before)))
        frame = _refit(frame, dict.fromkeys(tones, frame.options.match))
        if estimate.is_doubted:  # by the prior curve again, the marks would only lead to the same estimate
            break
    return frame


def _mark_tones(frame: Frame) -> dict[int, MarkTone]:
    """Information of the clear marks on the tone curve."""
    return {index: fit.tone for index, fit in frame.clear_fits.items() if fit.tone is not None}


def _refit_with_blur(frame: Frame) -> Frame:
    """Refit faint marks and those with a poorly determined blur, with the blur of the others as an observation."""
    marks, match, detections = frame.layout.marks, frame.options.match, frame.detections
    drawn = {index: fit for index, fit in frame.inlier_fits.items() if isinstance(marks[index].mark, MarkShape)}
    faint = {index: fit for index, fit in drawn.items() if fit.covariance is None}
    fits = {index: fit for index, fit in drawn.items() if index in faint or detections[index].is_clear}
    shared = dict(zip(fits, shared_blurs(list(fits.values())), strict=True))
    known = {index: blur for index, blur in shared.items() if blur is not None}
    options = {index: replace(match, blur_px=blur.blur_px, blur_sigma=blur.sigma) for index, blur in known.items()}
    matched = _refit(frame, {index: each for index, each in options.items() if index not in faint}, orient=False)
    sigma = _linear_sigma(frame)
    again = {index: _fit_again(frame, index, options.get(index, match), sigma) for index in faint}
    matched = matched.replace_fits(
        {index: choose_fit(faint[index], fit, shared[index]) for index, fit in again.items()}
    )
    amended = {}
    total_px = {index: float(np.sqrt(fit.blur_px**2 + PIXEL_VARIANCE_PX2)) for index, fit in fits.items()}
    usual_px = float(np.median(list(total_px.values()))) if total_px else 1.0
    for index, blur in shared.items():
        ratio, blur_sigma = total_px[index] / usual_px, fits[index].blur_sigma
        figures = {"blur_ratio": ratio, "blur_sigma": blur_sigma} if np.isfinite(blur_sigma) else {}
        reasons, parts = list[Reason](), dict[Cause, Array]()
        if blur is not None and blur.differs and index not in faint:
            reasons, parts = [unlike_blur(ratio)], {Cause.SMEAR: smear_px2(fits[index].blur_px, blur.blur_px)}
        amended[index] = matched.detections[index].amend(*reasons, parts=parts, figures=figures)
    return matched.replace_detections(amended)


def choose_fit(filtered: MarkFit, fit: MarkFit | None, blur: SharedBlur | None) -> MarkFit:
    """Choose between the filtered place of a faint mark and its fit, which has to have the others' blur.

    Both are of the same pixels. Where the fit is not taken, the difference is what the filter's template, of the
    others' sharpness and of lines as drawn, may have moved the place.
    """
    if fit is None or (blur is not None and not blur.is_confirmed(fit)):
        return filtered
    off = fit.center_px - filtered.center_px
    if fit.sigma_px < filtered.sigma_px and may_be_noise(off, filtered.covariance_px2 + fit.covariance_px2):
        return fit
    covariance = filtered.place_covariance.plus(Cause.SECOND_METHOD, np.outer(off, off))
    return replace(filtered, place_covariance=covariance)


def shift_to_curve(frame: Frame) -> Frame:
    """Move the marks by the last step of the tone curve, which was too short for a refit, as the linearised fits do."""
    fits = {index: each.fit for index, each in enumerate(frame.detections) if each.fit and each.fit.tone}
    by_curve = frame.tone.tone.mean - frame.scan.tone.mean
    return frame.replace_fits(
        {index: fit.shifted(fit.tone.on_place @ by_curve) for index, fit in fits.items() if fit.tone}
    )


def _add_common_covariances(frame: Frame) -> Frame:
    """Add the uncertainties of tone curve, sharpening and taking lens to the covariance of each mark."""
    fits, lens, sharpening = frame.inlier_fits, frame.options.lens, frame.scan.tone.sharpening
    by_lens: dict[int, Array] = {}
    if lens is not None and fits:
        covariance = lens.covariance_px2(np.array([fit.center_px for fit in fits.values()]))
        # Affine transformation and film model take up their part of it.
        given = frame.camera_mm[list(fits)] / np.abs(frame.camera_mm).max()
        (x, y), one, none = given.T, np.ones(len(given)), np.zeros(len(given))
        affine = interleaved((x, none), (y, none), (one, none), (none, x), (none, y), (none, one))
        free = np.hstack([affine, film_terms(frame.options.film_model, given)])
        left = np.eye(len(free)) - free @ np.linalg.pinv(free)
        parts = (left @ covariance @ left).reshape(len(fits), 2, len(fits), 2)
        by_lens = {index: parts[number, :, number] for number, index in enumerate(fits)}
    amended = {}
    for index, detection in enumerate(frame.detections):
        fit, added = detection.fit, {Cause.LENS: by_lens[index]} if index in by_lens else {}
        if fit is not None and fit.tone is not None:
            added[Cause.TONE] = frame.tone.covariance_px2(fit.tone)
        if fit is not None and fit.sharpening is not None and sharpening:
            added[Cause.SHARPENING] = fit.sharpening.covariance_px2(sharpening)
        amended[index] = detection.amend(parts=added)
    return frame.replace_detections(amended)


def _compare_parts(frame: Frame) -> Frame:
    """Doubt marks whose lines lie apart from their rings or disks; each covariance grows by what lies between both."""
    amended = {}
    for index, fit in frame.clear_fits.items():
        mark = frame.layout.marks[index].mark
        if isinstance(mark, MarkShape) and lines_and_rounds(mark):
            place = np.column_stack([frame.linear(index), fit.center_px])
            bounds = mark_window(mark, place, frame.options.match.margin_px)
            found = measure_parts(read_window(frame.scan, bounds, frame.weights), mark, place, fit)
            reason, px2 = parts_apart(*found) if found else (NO_REASON, np.zeros((2, 2)))
            amended[index] = frame.detections[index].amend(reason, parts={Cause.MODEL_MISFIT: px2})
    return frame.replace_detections(amended)


def compare_shapes(frame: Frame) -> Frame:
    """Doubt marks with an outlying size or rotation; each covariance grows by what an object touching it may cause."""
    fits = {index: fit for index, fit in frame.clear_fits.items() if fit.covariance is not None}
    groups: dict[Mark | None, list[int]] = defaultdict(list)
    for index, fit in fits.items():
        mark = frame.layout.marks[index].mark
        if isinstance(mark, MarkShape) and not mark.is_held_by_frame:
            groups[mark].append(index)
        elif isinstance(mark, MarkShape) and fit.own_shape is not None:
            groups[None].append(index)
    changed = {}
    for drawn, indices in groups.items():
        figures = []  # logarithm of the size over the frame's, rotation (rad) if the frame gave it; their sigmas
        for index in indices:
            fit, own_shape = fits[index], fits[index].own_shape
            if drawn is None and own_shape is not None:
                figures.append((own_shape.change, own_shape.sigma))
            else:
                size = np.log(linear_scale(fit.pixel_from_mark) / linear_scale(frame.linear(index)))
                figures.append((np.array([size]), np.array([fit.size_sigma])))
        own, sigmas = (np.array(each) for each in zip(*figures, strict=True))
        for index, shape, sigma in zip(indices, shared_shapes(own, sigmas), sigmas, strict=True):
            if shape is not None:
                changed[index] = _doubt_shape(frame, index, fits[index], shape, sigma)
    return frame.replace_detections(changed)


def _doubt_shape(frame: Frame, index: int, fit: MarkFit, shape: SharedShape, sigma: Array) -> Detection:
    """Store the shape of a mark relative to the others, and doubt an outlier. sigma (k,): of the mark's own figures."""
    mark, is_damaged, touch = frame.layout.marks[index].mark, fit.damaged_fraction > 0, None
    size_ratio = float(np.exp(np.clip(shape.off[0], -_MOST_UNEQUAL, _MOST_UNEQUAL)))
    figures = dict(zip(("size_ratio", "turn_rad"), (size_ratio, *shape.off[1:].tolist()), strict=False))
    figures |= dict(zip(("size_sigma", "turn_sigma"), sigma.tolist(), strict=False))
    if fit.own_shape is not None and mark.is_held_by_frame:
        middle_px = reach_px(mark, fit.pixel_from_mark[:, :2]) / 2
        moved_px = float(np.hypot(*(fit.own_shape.on_place @ shape.off)))
        touch = Touch(shape.touched(_TOUCHED_PX / middle_px, is_damaged), moved_px, 0.0)
    elif mark.is_round:
        px_per_mm = linear_scale(fit.pixel_from_mark)
        parts = mark.parts if isinstance(mark, MarkShape) else ()
        radius_mm = max(part.radius_mm for part in parts if isinstance(part, Disk | Ring))
        touch = touch_of_round(shape, radius_mm * px_per_mm, px_per_mm, is_damaged)
    reasons = [unlike_others(size_ratio, figures.get("turn_rad"))] if shape.differs else []
    if not reasons and touch and mark.is_round and is_damaged and touch.exceedance(_WRONG_PX) > LARGE_ERROR:
        unlike = unlike_others(size_ratio, figures.get("turn_rad"))
        near = f"and the picture next to it is damaged: something may touch it; error over {_WRONG_PX} px"
        reasons = [unlike.reword(f"{unlike.split(':')[0]}, {near}")]
    added = {} if touch is None else {Cause.TOUCHED: touch.variance_px2 * np.eye(2)}
    return frame.detections[index].amend(*reasons, parts=added, figures=figures)


def _linear_sigma(frame: Frame) -> float:
    """Standard deviation of the frame's rotation (rad), scale, stretch and shear at a mark, bending included."""
    places = frame.camera_mm[frame.inliers]
    radius_mm = float(np.hypot(*(places - places.mean(axis=0)).T).mean())
    bend = float(np.hypot(frame.options.film_sigma_mm, frame.scatter_mm)) / radius_mm
    unchecked = 0.0
    if frame.inliers.sum() <= _UNCHECKED:  # a wrong name or place appears as stretch and shear
        greater, less = np.linalg.svd(frame.pixel_from_camera[:, :2] * frame.pitch_mm[:, None], compute_uv=False)
        unchecked = (greater - less) / (greater + less)
    return float(np.linalg.norm([frame.linear_sigma, bend, unchecked]))


def _refit(frame: Frame, options: Mapping[int, MatchOptions], orient: bool = True) -> Frame:
    """Refit marks at their places, with options by index. A clear fit stays if the new one is not clear."""
    sigma = _linear_sigma(frame) if options else np.inf
    fits = {index: _fit_again(frame, index, each, sigma) for index, each in sorted(options.items())}
    kept = {
        index: fit
        for index, fit in fits.items()
        if fit is not None and (fit.is_clear or not frame.detections[index].is_clear)
    }
    frame = frame.replace_fits(kept)
    return orient_frame(frame) if orient else frame


def _fit_again(frame: Frame, index: int, options: MatchOptions, linear_sigma: float) -> MarkFit | None:
    """Refit a mark at its measured place, with the frame's rotation and scale if it is held by them."""
    before = frame.detections[index].fit
    if before is None:
        return None
    expected = frame.prediction(index, _REFIT_PX).shift_to(before.center_px)
    # Marks whose size, place and blur are less separate begin anew: they have further minima.
    begun = before if isinstance(expected.mark, MarkShape) and expected.mark.is_cross else None
    return detect_mark(frame.scan, expected, options, linear_sigma, begun).fit


def detect_some(
    scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions, among: Sequence[int]
) -> Frame | None:
    """Start a frame and detect some among its marks, spread evenly, up to a clear one; None if none is clear."""
    frame = start_frame(scan, layout, placement, options)
    for index in among[:: max(1, len(among) // _TRIALS)]:
        frame = _detect(frame, [index], frame.first_search_px)
        if frame.detections[index].is_clear:
            return frame
    return None


def rename_frame(frame: Frame, pose: str) -> Frame:
    """Name the marks of a frame as in another pose.

    Marks found are fitted at their places, the others are detected. The frame is kept unchanged if fewer marks agree
    under the new names.
    """
    placement = frame.fitted_placement.reorient(pose, frame.camera_mm)
    found = np.array([fit.center_px for fit in frame.inlier_fits.values()])
    names = placement.names(found, frame.camera_mm).tolist() if len(found) else []
    renamed = Frame.from_placement(frame.scan, frame.layout, placement, frame.options)
    renamed = replace(renamed, weights=frame.weights, channel_note=frame.channel_note)
    places = {name: place for name, place in zip(names, found, strict=True) if name >= 0}
    # The first fits have the strain of the interior orientation under the names before.
    for _ in range(2):
        renamed = orient_frame(_detect(renamed, places, 0.0, places_px=places))
    unclear = [index for index, each in enumerate(renamed.detections) if not each.is_clear]
    renamed = refit_frame(detect_missing_marks(orient_frame(_detect(renamed, unclear, renamed.first_search_px))))
    return renamed if renamed.inliers.sum() >= frame.inliers.sum() else frame
