"""A frame while its marks are sighted: what was seen of each so far, which of them agree, and the frame they make."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.detection.correlation import CLOSE
from measure.detection.first_look import strongest
from measure.detection.prediction import MarkPrediction
from measure.fiducials.channels import best_weights
from measure.fiducials.constellation import NARROW, Placement, sign_of
from measure.fiducials.frame import CLEAR_LIKENESS, Frame
from measure.fiducials.interior_orientation import fit_frame, outliers
from measure.fiducials.mark_fit import Sighting, nothing_within, sight
from measure.fiducials.options import CLICK_SIGMA_PX, FiducialOptions
from measure.flags import FAINT_MARK_BY_NOISE, TEXTURE_LIKE_A_FAINT_MARK, Cause, Reason
from measure.geometry import up_from_camera
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout
from measure.results import MarkFit
from measure.scans.parallel import map_in_threads
from measure.scans.scan import LUMINANCE, SINGLE_CHANNELS, Scan
from measure.tone.estimate import FrameTone

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_LIKENESS = 0.35  # below it texture, text and scratches look like a mark as well
_LEAST_SIGNIFICANCE = 4.5  # of the contrast: what texture feigns stays below it
_FAINT_SIGNIFICANCE = 2.0  # the same where noise hardly makes what is seen: contrast there is, at 95 %
MANY = 6  # marks that agree and tell where a faint one must be
_CLEAR_RESPONSE = 0.25  # correlation of marks before they are fitted, where likenesses are CLEAR_LIKENESS
_CHANNEL_TRIALS = 6  # marks that the channels are chosen from
_REDUCED_PX = 1.5  # of the reduced scan: how well a placement predicts
CLICK_REACH_PX = 6 * CLICK_SIGMA_PX  # about a click: its sigma three times, and as much for who points less well


def first_search_px(
    placement: Placement, layout: FiducialLayout, options: FiducialOptions, tolerance: float = 1.0
) -> float:
    """How far from where a placement puts it a mark is looked for; tolerance: a share of how far it may lie off."""
    search_px = tolerance * options.search_mm(layout) / float(np.mean(placement.pitch_mm))
    return _REDUCED_PX * placement.reduction + search_px


class FrameSighter:
    """A frame of n marks in the making.

    camera (n, 2): given places, mm; turn (2, 2): of the pose; pitch (2,): mm of a pixel. pixel_from_camera (2, 3): as
    the placement has it, or the marks that belong; linear_sigma: how well these know its rotation (rad), scale, stretch
    and shear, inf before. sightings: None for a mark that was not looked at yet. belongs (n,):
    marks that were seen and agree; certain (n,): those that stand out so much of their texture that they need not.
    weights: of the channels. prior_tone: what was believed of the scan's curve; tone: what its marks made of that.
    gate_px, first_search_px, near_px, faint_px: how far from its predicted place a mark is
    looked for: where the others give it, where only the placement does, there on film that is hardly deformed, and
    where it is faint.
    """

    def __init__(
        self,
        scan: Scan,
        layout: FiducialLayout,
        placement: Placement,
        options: FiducialOptions,
    ) -> None:
        self.scan, self.layout, self.placement, self.options = scan, layout, placement, options
        self.prior_tone, self.tone = scan.tone, FrameTone(scan.tone)
        self.pitch = np.asarray(placement.pitch_mm)
        self.camera = np.array([mark.xy_mm for mark in layout.marks])
        self.turn = up_from_camera(placement.pose)
        self.pixel_from_camera, self.linear_sigma = placement.pixel_from_camera, np.inf
        self.sightings: list[Sighting | None] = [None] * len(layout.marks)
        self.belongs: Mask = np.zeros(len(layout.marks), dtype=bool)
        self.certain: Mask = np.zeros(len(layout.marks), dtype=bool)
        self.weights: tuple[float, ...] | None = None
        gate_px = options.gate_mm / float(self.pitch.mean())
        self.clicked = {click.point: np.array([click.col_px, click.row_px]) for click in options.clicks}
        self.first_search_px = first_search_px(placement, layout, options)
        self.near_px = first_search_px(placement, layout, options, NARROW)
        # Where the frame is hardly known to be there, texture must not feign a mark of it so far off.
        self.faint_px = self.near_px if placement.surroundings.robust else gate_px
        self.gate_px = gate_px

    def choose_channels(self) -> None:
        """Of a colour scan: the channel in which some marks are most like their drawings, then from these the best
        combination. Where no mark is drawn light or dark, the polarity is that of the combination."""
        if self.scan.channels == 1:
            return
        step = max(1, len(self.layout.marks) // _CHANNEL_TRIALS)
        places = []
        for index in range(0, len(self.layout.marks), step):
            expected = self.expected(index, self.first_search_px)
            answers = [
                strongest(self.scan, replace(expected, weights=weights)) for weights in (LUMINANCE, *SINGLE_CHANNELS)
            ]
            place, height = max(answers, key=lambda answer: answer[1])
            if height > _CLEAR_RESPONSE:
                places.append((expected.mark, expected.moved(place).pixel_from_mark, expected.polarity))
        unsaid = all(mark.mark.polarity == "auto" for mark in self.layout.marks)
        best = best_weights(self.scan, places, (1, -1) if unsaid else (1,))
        if best is not None:
            self.weights, sign = best
            self.placement = replace(self.placement, polarity=sign * self.placement.polarity)

    def look(self, indices: Sequence[int], search_px: float) -> None:
        """Sight marks anew, within search_px of where they are predicted now."""
        # From below upwards: the search of windows ended there, and what it read last is still decoded.
        rows = self._predicted_px()[:, 1]
        upwards = sorted(indices, key=lambda index: -rows[index])
        sighted = map_in_threads(lambda index: self._sight(index, search_px), upwards)
        for index, sighting in zip(upwards, sighted, strict=True):
            self.sightings[index] = sighting

    def match_at(self, places_px: Mapping[int, Array]) -> None:
        """Match marks, by index, at places where they were found before."""
        for index, place in places_px.items():
            self.sightings[index] = self._sight_expected(self.expected(index, 0.0).moved(place))

    def look_closer(self) -> None:
        """Look closer, where the others put them, at marks that are not clear or do not belong: beside one may lie
        dust, or the frame's edge. Only what is plainly there counts."""
        for index in range(len(self.belongs)):
            if self.clear(index) and self.belongs[index]:
                continue
            expected = replace(self.expected(index, self.gate_px), surroundings=CLOSE)
            seen = sight(self.scan, expected, self.options.match)
            if seen.fit is not None and seen.chance <= TEXTURE_LIKE_A_FAINT_MARK and _is_plain(seen.fit):
                self.sightings[index] = replace(seen, closer=True)

    def look_elsewhere(self, indices: Sequence[int]) -> None:
        """Look at marks where the others put them, first near by, then as far off as one may lie that keeps the gate:
        so far only what is plainly there counts."""
        for index in indices:
            self.look([index], self.gate_px)
            near, far_px = self.sightings[index], self._elsewhere_px(index)
            if not self.clear(index) and far_px > self.gate_px:
                self.look([index], far_px)
                self.sightings[index] = self.sightings[index] if self.clear(index) else near

    def _elsewhere_px(self, index: int) -> float:
        """A mark that is fitted pulls the frame to itself, and the more the fewer the others are: its distance from
        where they alone put it is its residual times one more than their prediction's variance, a mark's being one."""
        others = np.flatnonzero(self.belongs & (np.arange(len(self.belongs)) != index))
        affine = np.column_stack([self.camera, np.ones(len(self.camera))])
        if np.linalg.matrix_rank(affine[others]) < affine.shape[1]:
            return self.gate_px
        variance = float(affine[index] @ np.linalg.inv(affine[others].T @ affine[others]) @ affine[index])
        return min((1 + variance) * self.gate_px, self.first_search_px)

    def judge(self) -> None:
        """Which marks found belong together, and the frame through them."""
        found = np.array([s is not None and s.fit is not None for s in self.sightings])
        self.belongs = found.copy()
        if found.sum() < 2:
            return
        index = np.flatnonzero(found)
        up, sigma = self._up_mm(index), self._sigma_mm(index)
        told = self.certain | [mark.id in self.clicked for mark in self.layout.marks]
        out = outliers(self.camera[index], up, sigma, self.turn, self.options.gate_mm) & ~told[index]
        self.belongs[index[out]] = False
        fit = fit_frame(self.camera[index[~out]], up[~out], sigma[~out], self.turn)
        self.linear_sigma = fit.linear_sigma
        self.pixel_from_camera = np.diag([1.0, -1.0]) @ fit.up_from_camera / self.pitch[:, None]

    def sure(self) -> bool:
        """Whether so many marks agree, some of them clear ones, that they tell where every other must be."""
        clear = sum(self.clear(index) for index in np.flatnonzero(self.belongs).tolist())
        return bool(self.belongs.sum() >= MANY and clear >= MANY / 2)

    def doubt(self, index: int, reason: Reason) -> None:
        """Say of a mark that was seen why it may be wrong."""
        sighting = self.sightings[index]
        if sighting is not None:
            self.sightings[index] = replace(sighting, reason=Reason.combine((sighting.reason, reason)))

    def widen(self, index: int, cause: Cause, px2: Array) -> None:
        """Count a covariance (2, 2) to a cause for the place of a mark that was seen."""
        sighting = self.sightings[index]
        if sighting is not None and sighting.fit is not None:
            covariance = sighting.fit.place_covariance.plus(cause, px2)
            self.sightings[index] = replace(sighting, fit=replace(sighting.fit, place_covariance=covariance))

    def clear(self, index: int) -> bool:
        """Whether a mark needs no second look: it is plainly there, be it where the others put it or not."""
        sighting = self.sightings[index]
        return sighting is not None and sighting.fit is not None and sighting.fit.likeness >= CLEAR_LIKENESS

    def scatter_mm(self) -> float:
        """The median misfit of the marks that belong; 0 where none does."""
        return float(np.median(self.misfit_mm()[self.belongs])) if self.belongs.any() else 0.0

    def frame(self) -> Frame:
        """As far as it has come."""
        sightings = tuple(sighting for sighting in self.sightings if sighting is not None)
        return Frame(
            self.placement,
            self.camera,
            sightings,
            self.belongs,
            self.misfit_mm(),
            self.scatter_mm(),
            self.pixel_from_camera,
            self.weights,
            self.tone,
            self.options.part,
        )

    def misfit_mm(self) -> Array:
        """(n,) how far each mark that was seen is from where the frame puts it, nan without a fit."""
        misfit = np.full(len(self.sightings), np.nan)
        predicted = self._predicted_px()
        for index, sighting in enumerate(self.sightings):
            if sighting is not None and sighting.fit is not None:
                misfit[index] = np.hypot(*((sighting.fit.center_px - predicted[index]) * self.pitch))
        return misfit

    def _sight(self, index: int, search_px: float) -> Sighting:
        """At a closer look what is not seen is looked for nearer by, too: noise feigns fewer marks there."""
        sighting = self._sight_within(index, search_px)
        if sighting.fit is None and self.placement.surroundings.robust and self.near_px < search_px:
            near = self._sight_within(index, self.near_px)
            return near if near.fit is not None else sighting
        return sighting

    def _sight_within(self, index: int, search_px: float) -> Sighting:
        return self._sight_expected(self.expected(index, search_px))

    def _sight_expected(self, expected: MarkPrediction) -> Sighting:
        """At a closer look a mark may be as faint as what texture feigns, where it seldom does so near by: all marks
        together decide of the frame."""
        sighting = sight(self.scan, expected, self.options.match)
        fit, closer = sighting.fit, self.placement.surroundings.robust
        sure = closer and sighting.chance <= FAINT_MARK_BY_NOISE
        least = (0.0, _FAINT_SIGNIFICANCE) if sure else (_LEAST_LIKENESS, _LEAST_SIGNIFICANCE)
        if fit is not None and (fit.likeness < least[0] or fit.significance < least[1]):
            return Sighting(sighting.predicted_px, True, None, nothing_within(expected.search_px))
        return sighting

    def expected(self, index: int, search_px: float) -> MarkPrediction:
        """A mark where the frame puts it now, or where a person sees it: then no farther off than that one points."""
        mark, click = self.layout.marks[index].mark, self.clicked.get(self.layout.marks[index].id)
        if click is not None:
            search_px = min(search_px, CLICK_REACH_PX)
        place = self._predicted_px()[index] if click is None else click
        start = np.column_stack([self.pixel_from_camera[:, :2], place])
        sign = sign_of(mark, self.placement.polarity)
        return MarkPrediction(mark, start, search_px, sign, self.weights, self.placement.surroundings)

    def _predicted_px(self) -> Array:
        return self.camera @ self.pixel_from_camera[:, :2].T + self.pixel_from_camera[:, 2]

    def _fits(self, index: NDArray[np.intp]) -> list[MarkFit]:
        """Of marks that were seen."""
        return [s.fit for s in (self.sightings[i] for i in index) if s is not None and s.fit is not None]

    def _up_mm(self, index: NDArray[np.intp]) -> Array:
        centers = np.array([fit.center_px for fit in self._fits(index)])
        return np.asarray(centers * self.pitch * (1.0, -1.0))

    def _sigma_mm(self, index: NDArray[np.intp]) -> Array:
        covariances = [fit.covariance_px2 for fit in self._fits(index)]
        measured = np.sqrt(np.trace(np.array(covariances), axis1=1, axis2=2) / 2) * self.pitch.mean()
        given = np.array([min(*self.layout.marks[i].sigma_mm, MOST_GIVEN_SIGMA_MM) for i in index])
        return np.asarray(np.sqrt(measured**2 + given**2 + self.options.film_sigma_mm**2))


def _is_plain(fit: MarkFit) -> bool:
    return fit.likeness >= CLEAR_LIKENESS and fit.significance >= _LEAST_SIGNIFICANCE
