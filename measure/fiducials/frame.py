"""One frame of a scan as an immutable value: detections, inliers and the interior orientation from the inliers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from measure.array_types import Array, Mask
from measure.detection.localisation import MarkPrediction
from measure.fiducials.constellation import Placement, mark_sign
from measure.fiducials.interior_orientation import FilmFit
from measure.fiducials.mark_fit import Detection
from measure.fiducials.options import CLICK_SIGMA_PX, SCATTER_MM, FiducialOptions
from measure.flags import LARGE_ERROR, NO_REASON, Code, Reason, Status
from measure.marks.shapes import FiducialLayout
from measure.results import MarkFit
from measure.scans.scan import Scan
from measure.tone.curve import LINEAR
from measure.tone.estimate import FrameTone

MANY = 6  # inliers from which the predicted place of a faint mark is reliable
CLEAR_DAMAGE = 0.25  # fraction of a mark: with more of it damaged, the rest may belong to something else
_CLEAR_SNR = 3.0  # contrast over the noise of a pixel: with less a mark is weak,
_CLEAR_SIGNIFICANCE = 10.0  # unless its contrast has this many standard deviations
LEAST_SIGNIFICANCE = 4.5  # standard deviations of the contrast: texture alone stays below it
_AGREEING, _AGREEING_SHARE = 3, 0.3  # least inliers; fraction of the marks in the scan; two fit any similarity
_CHECKED = 4  # inliers from which an affine transformation has redundancy
WRONG_PX = 0.5  # px, an error that a mark with status measured must not have
_PLAIN_SIGMA_PX = 0.25  # px; a standard deviation is reliable in white noise, but only in part on image texture
_MOST_LOST = 0.85  # fraction of the information on the place: the rest may be the end of a line, or something else
_MOST_UNLIKE = 0.03  # fraction of a mark that a wrong drawing may explain, added to CLEAR_DAMAGE
_FAR = 4.0  # times the median misfit of the inliers: nearly five standard deviations
_LEAST_SCATTER_MM = 2 * SCATTER_MM  # mm, least median misfit: a few marks may agree by chance better than film allows
_FAILED = {Code.NO_FIT, Code.OFF_PLACE, Code.SIZE, Code.POLARITY}  # reasons that another tone curve may cure
_SAME_MARK_PX = 5.0  # px between two fits of one mark at most; two marks lie farther apart: each is some 14 px large
REDUCED_PX = 1.5  # px of the reduced scan: accuracy of the places that a placement predicts
_CLICK_REACH_PX = 6 * CLICK_SIGMA_PX  # px around a click: three sigma, doubled for people who point less accurately


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
        places = placement.places_px(np.array([mark.xy_mm for mark in layout.marks]))
        detections = tuple(Detection(place, False, None) for place in places)
        tone = FrameTone(scan.tone.prior)
        start, film = placement.pixel_from_camera, placement.film
        return cls(scan, layout, options, placement, start, detections, none, none.copy(), tone=tone, film=film)

    @cached_property
    def camera_mm(self) -> Array:
        """(n, 2) given coordinates of the marks."""
        return np.array([mark.xy_mm for mark in self.layout.marks])

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

    def replace_detections(self, changed: Mapping[int, Detection]) -> "Frame":
        """Return the frame with the detections of some marks replaced, by index."""
        return replace(self, detections=tuple(changed.get(index, each) for index, each in enumerate(self.detections)))

    def replace_fits(self, changed: Mapping[int, MarkFit]) -> "Frame":
        """Return the frame with the fits of some marks replaced, by index."""
        return self.replace_detections(
            {index: replace(self.detections[index], fit=each) for index, each in changed.items()}
        )

    @property
    def fits(self) -> list[MarkFit | None]:
        """Fits of all marks, None for those that are not inliers."""
        return [self.inlier_fits.get(index) for index in range(len(self.detections))]

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

    @property
    def inside(self) -> int:
        """Number of marks predicted within the scan."""
        return sum(detection.inside for detection in self.detections)

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

    def is_nearer_than(self, other: "Frame | None") -> bool:
        """Whether it is nearer to acceptance than another frame: more inliers, then more clear ones."""
        if other is None:
            return True
        own, others = ((len(frame.inlier_fits), len(frame.clear_fits)) for frame in (self, other))
        return own > others

    @property
    def accepted(self) -> bool:
        """Whether enough marks agree for the frame to be no false alarm, at least three of them clear."""
        return self.agrees and len(self.clear_fits) >= self.least

    @property
    def is_faint(self) -> bool:
        """Whether all its marks together decide on it: none of them need be clear."""
        return self.placement.surroundings.robust or not self.accepted

    @property
    def unblemished(self) -> list[int]:
        """Indices of the marks with status measured that agree with the others."""
        near = self.inliers & (self.misfit_mm <= _FAR * max(self.scatter_mm, _LEAST_SCATTER_MM))
        return [index for index in np.flatnonzero(near).tolist() if self.verdict(index)[0] is Status.MEASURED]

    @property
    def measured_count(self) -> int:
        """Number of unblemished marks."""
        return len(self.unblemished)

    @property
    def is_sure(self) -> bool:
        """Whether it is accepted and has enough unblemished marks: a frame found at a wrong place has hardly any."""
        return self.accepted and self.measured_count >= self.least

    @property
    def is_complete(self) -> bool:
        """Whether no further search is needed: every mark is a clear inlier."""
        return self.accepted and len(self.clear_fits) == len(self.inliers) >= _CHECKED

    @property
    def _enough(self) -> int:
        """Least number of inliers."""
        return max(self.least, int(np.ceil(_AGREEING_SHARE * self.inside)))

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
        return bool(nearest.max() < _SAME_MARK_PX)

    @cached_property
    def _usual_damage(self) -> float:
        """Median damaged fraction of the inliers: damage common to all means that the drawing is wrong."""
        fractions = [fit.damaged_fraction for fit in self.inlier_fits.values()]
        return float(np.median(fractions)) if len(fractions) >= _CHECKED else 0.0

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
        elif fit.significance < LEAST_SIGNIFICANCE:
            texture = f"its contrast is only {fit.significance:.1f} standard deviations of the texture"
            reasons.append(Reason(texture, Code.CONTRAST))
        if fit.damaged_fraction > CLEAR_DAMAGE + min(self._usual_damage, _MOST_UNLIKE):
            reasons.append(Reason(f"{fit.damaged_fraction:.0%} of it is damaged", Code.COVERED))
        elif fit.lost_fraction > _MOST_LOST:
            lost = f"{fit.lost_fraction:.0%} of its edges across one direction is damaged"
            reasons.append(Reason(lost, Code.COVERED))
        sigma_px = largest_sigma_px(fit.covariance_px2)
        is_plain = fit.covariance_is_white and sigma_px <= _PLAIN_SIGMA_PX
        if may_be_wrong(fit.covariance_px2) and not is_plain:
            reasons.append(Reason(f"its standard deviation is {sigma_px:.2f} px", Code.IMPRECISE))
        reason = Reason.combine(reasons)
        return (Status.WEAK, reason) if reason else (Status.MEASURED, NO_REASON)


def may_be_wrong(covariance_px2: Array) -> bool:
    """Whether a place with this covariance (2, 2) may have a larger error than a measured mark may have."""
    return bool(chdtrc(2, (WRONG_PX / largest_sigma_px(covariance_px2)) ** 2) > LARGE_ERROR)


def largest_sigma_px(covariance_px2: Array) -> float:
    """Standard deviation in the direction in which it is largest: semi-major axis of the error ellipse (2, 2)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance_px2)[-1]))
