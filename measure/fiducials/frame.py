"""One frame in one placement: its marks as they were seen, and those told apart that do not belong."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from measure.fiducials.constellation import Placement
from measure.fiducials.mark_fit import Sighting
from measure.fiducials.options import SCATTER_MM
from measure.flags import LARGE_ERROR, NO_REASON, Code, Reason, Status
from measure.results import MarkFit
from measure.tone.curve import LINEAR
from measure.tone.estimate import FrameTone

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLEAR_LIKENESS = 0.5  # below it a mark's picture has more in it that is not the mark
CLEAR_DAMAGE = 0.25  # of a mark: with more of it gone, what is left may be another's
_CLEAR_SNR = 3.0  # contrast over the noise of a pixel: with less a mark is weak
_AGREEING, _AGREEING_SHARE = 3, 0.3  # marks, and of those in the scan: two fit any similarity
_CHECKED = 4  # marks that agree: an affine transformation through them has a check
WRONG_PX = 0.5  # an error that a mark called measured must not have
_PLAIN_SIGMA_PX = 0.25  # in plain noise a standard deviation says all; on a landscape it knows of in part only
_MOST_LOST = 0.85  # of what tells a mark's place: what is left may be an end of a line, or another's
_MOST_UNLIKE = 0.03  # of a mark that its drawing may lack: with more gone, what is left may still be another's
_FAR = 4.0  # times the scatter of the others, a median: nearly five standard deviations
_LEAST_SCATTER_MM = 2 * SCATTER_MM  # of few marks, which may agree by chance better than film keeps them
_SAME_MARK_PX = 5.0  # two fits of one mark lie nearer to one another, two marks do not: each is some 14 px large


@dataclass(frozen=True, eq=False)
class Frame:
    """camera_mm: (n, 2) given. belongs: (n,) marks that were found and agree. misfit_mm: (n,) how far each mark found
    is from where the frame puts it, nan without one; scatter_mm: the median of those that belong. pixel_from_camera:
    (2, 3), the placement's own where fewer than two marks belong. part: whether the scan shows a part of it only."""

    placement: Placement
    camera_mm: Array
    sightings: tuple[Sighting, ...]
    belongs: Mask
    misfit_mm: Array
    scatter_mm: float
    pixel_from_camera: Array
    weights: tuple[float, ...] | None
    tone: FrameTone = field(default_factory=lambda: FrameTone(LINEAR))
    part: bool = False

    @property
    def fits(self) -> list[MarkFit | None]:
        """The fits of the marks that belong."""
        return [s.fit if ok else None for s, ok in zip(self.sightings, self.belongs, strict=True)]

    @property
    def fitted_placement(self) -> Placement:
        """Where the marks that belong put the frame."""
        return replace(self.placement, pixel_from_camera=self.pixel_from_camera)

    @property
    def all_clear(self) -> bool:
        """Whether every mark that belongs is plainly there."""
        return all(fit is None or fit.likeness >= CLEAR_LIKENESS for fit in self.fits)

    @property
    def missed_px(self) -> list[Array]:
        """Where the frame puts the marks in the scan that were not found."""
        places = [self.pixel_from_camera @ (*xy, 1.0) for xy in self.camera_mm]
        missed = [s.inside and not ok for s, ok in zip(self.sightings, self.belongs, strict=True)]
        return [np.asarray(place) for place, gone in zip(places, missed, strict=True) if gone]

    @property
    def inside(self) -> int:
        """How many marks it puts within the scan."""
        return sum(sighting.inside for sighting in self.sightings)

    @property
    def agrees(self) -> bool:
        """Whether enough marks agree, clear or not: three, and three in ten of those in the scan."""
        return int(self.belongs.sum()) >= max(self._least, int(np.ceil(_AGREEING_SHARE * self.inside)))

    @property
    def accepted(self) -> bool:
        """Whether enough marks agree for the frame not to be chance, three of them clear ones."""
        return self.agrees and self._clear >= self._least

    @property
    def unblemished(self) -> list[int]:
        """The marks that are measured, where the others have them."""
        near = self.belongs & (self.misfit_mm <= _FAR * max(self.scatter_mm, _LEAST_SCATTER_MM))
        return [index for index in np.flatnonzero(near).tolist() if self.verdict(index)[0] is Status.MEASURED]

    @property
    def measured(self) -> int:
        """How many marks are measured without blemish."""
        return len(self.unblemished)

    @property
    def is_sure(self) -> bool:
        """Whether it is accepted, as many marks being measured as have to agree: a frame that is seen elsewhere than it
        lies has hardly any."""
        return self.accepted and self.measured >= self._least

    @property
    def is_whole(self) -> bool:
        """Whether every mark that lies in the scan was plainly seen where the others put it."""
        return self.accepted and int(self.belongs.sum()) == self.inside and self.all_clear

    @property
    def is_complete(self) -> bool:
        """Whether it needs no other search: every mark plainly seen where the others put it."""
        return bool(self.accepted and len(self.belongs) >= _CHECKED and self.belongs.all() and self.all_clear)

    @property
    def _clear(self) -> int:
        """How many marks are plainly there."""
        return sum(fit is not None and fit.likeness >= CLEAR_LIKENESS for fit in self.fits)

    @property
    def _least(self) -> int:
        return 2 if self.part else max(min(_AGREEING, len(self.sightings)), 2)

    def has_all_of(self, other: "Frame") -> bool:
        """Whether the marks of the other frame are some of this one's, under other names: a frame moved on by the
        distance of two marks has its marks where this one has others."""
        own, others = ([fit.center_px for fit in frame.fits if fit] for frame in (self, other))
        if not others or len(others) >= len(own):
            return False
        nearest = [min(float(np.hypot(*(place - known))) for known in own) for place in others]
        return max(nearest) < _SAME_MARK_PX

    @property
    def _unlike_drawing(self) -> float:
        """What of their pictures the marks lack alike: not they are damaged, but drawn otherwise than they are."""
        fractions = [fit.damaged_fraction for fit in self.fits if fit is not None]
        return float(np.median(fractions)) if len(fractions) >= _CHECKED else 0.0

    def misfit(self, ids: Sequence[str]) -> str:
        """A sentence for a frame that is not accepted. ids: of its marks, in the order of the sightings."""
        found = f"{int(self.belongs.sum())} of {len(self.sightings)} marks were found where the others put them"
        if not self.agrees:
            return f"the constellation does not fit: only {found}{self._told_outside(ids)}"
        return (
            f"{found}, but only {self._clear} of them look plainly like their drawings, where {self._least} have to: "
            "compare the drawings with the scan, or say by which curve it stores light (tone)"
        )

    def _told_outside(self, ids: Sequence[str]) -> str:
        """A part of a sentence on marks that the others put outside of the scan."""
        outside = [
            id for id, sighting in zip(ids, self.sightings, strict=True) if Code.OUTSIDE in sighting.reason.codes
        ]
        if not outside or self.belongs.sum() < 2:
            return ""
        return (
            f", and these put {', '.join(outside)} outside of the scan: scan the whole frame, or say by part_of in "
            "images.csv that this scan is a part of it"
        )

    def verdict(self, index: int) -> tuple[Status, Reason]:
        """What became of a mark that was fitted, by its picture: where it lies beside the others tells of the frame."""
        fit = self.sightings[index].fit
        if fit is None or not self.belongs[index]:
            off = f"{self.misfit_mm[index]:.2f} mm from where the other {int(self.belongs.sum())} marks put it"
            return Status.REJECTED, Reason(f"what was measured lies {off}", Code.OFF_PLACE)
        reasons = [self.sightings[index].reason]
        if fit.likeness < CLEAR_LIKENESS:
            reasons.append(Reason(f"it correlates with its drawing by only {fit.likeness:.2f}", Code.LIKENESS))
        if fit.snr < _CLEAR_SNR:
            reasons.append(Reason(f"its contrast is only {fit.snr:.1f} times the noise", Code.CONTRAST))
        if fit.damaged_fraction > CLEAR_DAMAGE + min(self._unlike_drawing, _MOST_UNLIKE):
            reasons.append(Reason(f"{fit.damaged_fraction:.0%} of it is damaged", Code.COVERED))
        elif fit.lost_fraction > _MOST_LOST:
            told = f"{fit.lost_fraction:.0%} of what tells its place in one direction is damaged"
            reasons.append(Reason(told, Code.COVERED))
        sigma_px = largest_sigma_px(fit.covariance_px2)
        is_plain = fit.covariance_is_white and sigma_px <= _PLAIN_SIGMA_PX
        if may_be_wrong(fit.covariance_px2) and not is_plain:
            reasons.append(Reason(f"its standard deviation is {sigma_px:.2f} px", Code.IMPRECISE))
        reason = Reason.combine(reasons)
        return (Status.WEAK, reason) if reason else (Status.MEASURED, NO_REASON)


def may_be_wrong(covariance_px2: Array) -> bool:
    """Whether a mark so well known (2, 2) may have an error that one called measured must not have."""
    return bool(chdtrc(2, (WRONG_PX / largest_sigma_px(covariance_px2)) ** 2) > LARGE_ERROR)


def largest_sigma_px(covariance_px2: Array) -> float:
    """In the direction in which it is largest."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance_px2)[-1]))
