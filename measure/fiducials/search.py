"""Search for a camera's frame in a scan: pitch hypotheses, placements, expected numbers of false alarms."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import comb

from measure.array_types import Array
from measure.detection.correlation import WIDE, Map, Surroundings
from measure.detection.mark_views import MarkView
from measure.detection.responses import (
    FULL,
    ByteCache,
    Dilation,
    Effort,
    Responses,
    correlate_scan,
    correlate_windows,
)
from measure.fiducials.constellation import NARROW, Bounds, Placement, PlacementSearch, mark_signs
from measure.fiducials.options import FiducialOptions
from measure.geometry import POSES, up_from_camera
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan
from measure.tone.curve import Tone

Pair = tuple[float, float]

_PITCH_STRETCHES = (-0.015, 0.015, -0.03, 0.03)  # relative: an office scanner's carriage may be some per cent too fast
_SLIGHT = (-0.005, 0.005, -0.01, 0.01)  # relative stretches for faint marks, searched within narrow bounds only
_SCALE_STEPS = (1.1, 1.0, 0.91, 0.83, 0.75)  # of the largest scale at which the frame fits into the scan
_STEP_TOLERANCE = 0.06  # relative tolerance of each scale step: it reaches the next step
_LARGE_PX = 1 << 24  # px in a large scan; smaller ones are read whole in a short time
_REACH = 0.025  # fraction of the frame's side: film laid by hand is off by some millimetres and a degree
_LARGEST_SHARE = 0.25  # fraction of the scan: above it the whole scan is searched, for the additional evidence
_BEYOND_MM = 3.0  # mm beyond the scan's edge: a frame may be cut off there by less than its rim
_FINE = 0.05  # fraction of the distance within which steps are alike: to which they are rounded
_ALIKE = 0.5  # fraction of the marks that fall on others after one step: above it a lattice may be found one step off
_WINDOWS_SHARE = 0.6  # fraction of the scan: above it the whole scan takes no longer than the windows
_CRITERIA = 3  # by which a false frame may be as good: response heights, misfit, and misfit under a stretch
_STRETCHES = np.linspace(-0.03, 0.03, 13)  # relative, of non-square pixels; a step moves marks within narrow bounds


@dataclass(frozen=True)
class PitchHypothesis:
    """Hypothesis about the pixel pitch.

    Attributes
    ----------
    mm : pitch across and down.
    tolerance : relative error of the scale, common to both.
    drawn_mm : pitch at which the templates are rendered; for non-square pixels that of the square ones, so that several
        hypotheses share the templates, which hardly differ.
    """

    mm: tuple[float, float]
    tolerance: float
    drawn_mm: tuple[float, float]


Hypotheses = Sequence[PitchHypothesis]


def pitch_hypotheses(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Hypotheses]:
    """List groups of pitch hypotheses, likelier ones first; a later group is for scans in which the earlier ones fail.

    Parameters
    ----------
    pitch_um : given pitch in x and y; None if unknown. The pitches at which the frame roughly fills the scan are then
        all there is. They also follow a given pitch, unless it is certain or the scan shows a part of its frame.
    """
    long_mm, short_mm = max(layout.frame_mm), min(layout.frame_mm)
    long_px, short_px = max(scan.width_px, scan.height_px), min(scan.width_px, scan.height_px)
    largest = min(long_px / long_mm, short_px / short_mm)
    filling = [
        PitchHypothesis(pair, _STEP_TOLERANCE, pair) for s in _SCALE_STEPS for pair in [(1 / (s * largest),) * 2]
    ]
    filling_longer = [longer(each, stretch) for each in filling for stretch in _PITCH_STRETCHES]
    if pitch_um is None:
        return [filling, filling_longer]
    pair = (pitch_um[0] / 1000, pitch_um[1] / 1000)
    given = PitchHypothesis(pair, options.scale_tolerance, pair)
    as_given: list[Hypotheses] = [[given], [longer(given, stretch) for stretch in _PITCH_STRETCHES]]
    if options.pitch_is_right or options.part:
        return as_given
    fills = any(abs(pair[0] / each.mm[0] - 1) < _STEP_TOLERANCE for each in filling)
    return [*as_given, filling] if fills else [*as_given, filling, filling_longer]


def slightly_longer(given: PitchHypothesis, tolerance: float) -> tuple[Hypotheses, Hypotheses]:
    """Return the given pitch, and variants with slightly non-square pixels, each with a tolerance."""
    near = replace(given, tolerance=tolerance)
    return [near], [longer(near, stretch) for stretch in _SLIGHT]


def longer(given: PitchHypothesis, stretch: float) -> PitchHypothesis:
    """Stretch the pixels: longer across than down by a relative amount, or shorter if it is negative."""
    x, y = given.mm
    return replace(given, mm=(x * (1 + stretch / 2), y * (1 - stretch / 2)))


# Search in windows for a frame near the middle of its scan, or as far off as the scan has room for it. Of a large scan
# only the windows around the expected marks are read; if any mark is not clear there, the whole scan is searched.


def reach_mm(layout: FiducialLayout) -> float:
    """Search radius around the place of a mark in a centred frame."""
    return _REACH * max(layout.frame_mm)


def room_mm(scan: Scan, layout: FiducialLayout, pitch_mm: tuple[float, float]) -> float:
    """Largest distance between the centre of the scan and that of a frame wholly inside it."""
    scan_mm = scan.width_px * pitch_mm[0], scan.height_px * pitch_mm[1]
    return max((max(scan_mm) - min(layout.frame_mm)) / 2, 0.0) + _BEYOND_MM


def is_searched_by_windows(scan: Scan, layout: FiducialLayout, pitch_mm: tuple[float, float]) -> bool:
    """Whether the scan is large, the windows around the marks a small part of it, and the marks no lattice.

    In a lattice a window may hold the next mark instead.
    """
    side_px = 2 * reach_mm(layout) / np.asarray(pitch_mm)
    size_px = scan.width_px * scan.height_px
    share = len(layout.marks) * float(np.prod(side_px)) / size_px
    return size_px >= _LARGE_PX and share < _LARGEST_SHARE and not is_lattice(layout)


def is_lattice(layout: FiducialLayout) -> bool:
    """Whether one shift maps more than half of the marks to others."""
    xy, near = np.array([mark.xy_mm for mark in layout.marks]), reach_mm(layout) / 2
    steps = (xy[:, None] - xy[None]).reshape(-1, 2)
    # A large lattice has a million steps, few of them distinct: count rounded ones.
    rounded = np.round(steps[np.hypot(*steps.T) > near] / (_FINE * near))
    fine, times = np.unique(rounded @ [1, 1j], return_counts=True)
    places = _FINE * near * np.stack([fine.real, fine.imag], axis=1)
    alike = [times[others].sum() for others in cKDTree(places).query_ball_point(places, near)] if len(places) else []
    return max(alike, default=0) > _ALIKE * len(xy)


def centred_places_px(scan: Scan, layout: FiducialLayout, pixel_from_camera: Array) -> Array:
    """(n, 2) places of the marks if their constellation is centred in the scan.

    pixel_from_camera: (2, 2), of a pose.
    """
    xy = np.array([mark.xy_mm for mark in layout.marks])
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    return np.asarray((xy - middle) @ pixel_from_camera.T + np.array([scan.width_px - 1, scan.height_px - 1]) / 2)


class FrameSearch:
    """Search in one scan. Templates are rendered and correlated once for hypotheses with the same drawn_mm."""

    def __init__(
        self,
        scan: Scan,
        layout: FiducialLayout,
        options: FiducialOptions,
        surroundings: Surroundings = WIDE,
        effort: Effort = FULL,
    ) -> None:
        self.scan, self.layout, self.options, self.surroundings = scan, layout, options, surroundings
        self.poses = POSES if options.pose == "auto" else (options.pose,)
        self._camera_mm = np.array([mark.xy_mm for mark in layout.marks])
        self._signs = mark_signs(layout.marks)
        self._responses: tuple[Pair, Responses] | None = None
        self._searches: dict[Pair, PlacementSearch] = {}
        self._found: dict[tuple[PitchHypothesis, ...], list[Placement]] = {}
        # Two thirds for the correlation maps, one third for the dilations: two for each view of one pose.
        cache_bytes = effort.scan_cache_bytes(scan.width_px * scan.height_px)
        self._caches = ByteCache[Map](2 * cache_bytes // 3), ByteCache[Dilation](cache_bytes // 3)
        self._effort = effort

    def with_surroundings(self, surroundings: Surroundings) -> "FrameSearch":
        """Return a search with other surroundings of the marks; both share the caches."""
        search = FrameSearch(self.scan, self.layout, self.options, surroundings, self._effort)
        search._caches = self._caches
        return search

    def search_scan(self, hypotheses: Sequence[PitchHypothesis]) -> list[Placement]:
        """Find placements in the whole scan, of all poses, best first."""
        key, found = tuple(hypotheses), list[Placement]()
        if key in self._found:
            return self._found[key]
        for drawn_mm, alike in groupby(hypotheses, attrgetter("drawn_mm")):
            if self._responses is None or self._responses[0] != drawn_mm:
                effort = self._caches, self._effort.half_px, len(self.layout.marks)
                views = self._views(drawn_mm)
                self._responses = drawn_mm, correlate_scan(self.scan, views, self._signs, self.surroundings, *effort)
            found += self._placements(list(alike), self._responses[1])
        return self._found.setdefault(key, _best_first(found))

    def replace_tone(self, tone: Tone) -> "FrameSearch":
        """Return the search with another initial tone curve for the fits, in the same responses."""
        search = copy(self)
        search.scan = self.scan.replace_tone(tone)
        return search

    def replace_film_model(self, model: str) -> "FrameSearch":
        """Return the search with another film deformation model, in the same responses."""
        search = copy(self)
        search.options, search._searches, search._found = replace(self.options, film_model=model), {}, {}
        return search

    def search_middle(self, hypothesis: PitchHypothesis) -> list[Placement]:
        """Find placements of a frame near the middle of the scan, best first. Reads only windows around its marks."""
        return _best_first(self._placements([hypothesis], self._middle_responses(hypothesis.mm, reach_mm(self.layout))))

    def search_room(self, hypotheses: Sequence[PitchHypothesis]) -> list[Placement]:
        """Find placements of a frame that lies wholly inside the scan, best first.

        Each mark is searched only in the window that this leaves, if all windows together are clearly smaller than the
        scan.
        """
        found: list[Placement] = []
        for drawn_mm, alike in groupby(hypotheses, attrgetter("drawn_mm")):
            own = list(alike)
            room = room_mm(self.scan, self.layout, drawn_mm) + self._slack_mm(own)
            window_px = float(np.prod(2 * room / np.asarray(drawn_mm)))
            if len(self.layout.marks) * window_px > _WINDOWS_SHARE * self.scan.width_px * self.scan.height_px:
                found += self.search_scan(own)
            else:
                found += self._placements(own, self._middle_responses(drawn_mm, room))
        return _best_first(found)

    def is_exhaustive(self, placement: Placement) -> bool:
        """Whether the placement was found by a search of the whole scan, not of windows alone."""
        search = self._searches.get(placement.pitch_mm)
        return search is not None and search.responses.origins is None

    def false_placements(self, placement: Placement) -> float:
        """Expected number of placements as good in a similar scan without any frame, under this pitch hypothesis alone.

        Notes
        -----
        Of n marks in the scan k respond, the weakest at least as strongly as a share p of all places. A random frame
        has as many with a probability of about (n over k) p^k. The number of distinct frames is that of all pairs of
        places, for two marks far apart, that the bounds of rotation and scale allow.
        """
        places = placement.places_px(self._camera_mm)
        inside = np.all((places >= 0) & (places < (self.scan.width_px, self.scan.height_px)), axis=1)
        found = {index: places[index] for index in np.flatnonzero(inside).tolist()}
        return self._false_frames(placement, found, len(found), self._searches[placement.pitch_mm].tolerance_px)

    def false_frames(self, placement: Placement, inside: int, found_px: dict[int, Array]) -> float:
        """Expected number of false frames as good as one with marks found at given places.

        Null hypothesis: detections are uniform within the search tolerance. A good fit of many marks by a similarity,
        with or without a stretch, is then improbable.

        Parameters
        ----------
        inside : number of marks inside the scan.
        found_px : (2,) place of each mark found, by index.
        """
        widest_px, expected = self._searches[placement.pitch_mm].tolerance_px, list[float]()
        for stretches in (np.zeros(1), _STRETCHES):
            misfit_px = self._misfit_px(placement, found_px, stretches)
            tolerance_px = min(max(misfit_px, NARROW * widest_px), widest_px)
            expected.append(len(stretches) * self._false_frames(placement, found_px, inside, tolerance_px))
        return _CRITERIA * min(expected)

    def places_as_good(self, placement: Placement, index: int, found_px: Array) -> Array:
        """(n, 2) candidates of a mark that respond at least as strongly, at reduced resolution, as found_px (2,)."""
        search = self._searches[placement.pitch_mm]
        response_map, responses = search.response_map(placement, index), search.responses
        height = response_map.dilated(search.tolerance_px).height(responses.reduced_px(found_px))
        heights = response_map.highest_about(response_map.candidates, 0.0)[1]
        return responses.scan_px(response_map.candidates[heights >= height])

    def _misfit_px(self, placement: Placement, found_px: dict[int, Array], stretches: Array) -> float:
        """Largest residual, px of the reduced scan, of the marks found after a similarity with the best stretch."""
        if not found_px:
            return 0.0
        pitch = np.asarray(placement.pitch_mm)
        given = self._camera_mm[list(found_px)] @ placement.pixel_from_camera[:, :2].T
        found = np.array([*found_px.values()])
        found = found if placement.lens is None else placement.lens.ideal_px(found)
        given, found = ((each - each.mean(axis=0)) * pitch for each in (given, found))
        longer = np.stack([1 + stretches / 2, 1 - stretches / 2], axis=-1)
        given, found = (given * longer[:, None]) @ (1, 1j), found @ (1, 1j)
        turns = (given.conj() @ found) / np.maximum((np.abs(given) ** 2).sum(axis=1), 1e-12)
        off = np.abs(found - turns[:, None] * given).max(axis=1)
        return float(off.min() / pitch.mean() / placement.reduction)

    def _false_frames(
        self, placement: Placement, found_px: dict[int, Array], inside: int, tolerance_px: float
    ) -> float:
        """Expected number of false frames, from the shares of places that respond as strongly within tolerance_px."""
        search, shares, same_px = self._searches[placement.pitch_mm], [], 1
        for index, place in found_px.items():
            dilation = search.response_map(placement, index).dilated(tolerance_px)
            shares.append(dilation.share(search.responses.reduced_px(place)))
            same_px = dilation.area_px
        counts = np.arange(max(min(3, inside), 1), len(shares) + 1)
        if len(counts) == 0:
            return np.inf
        likely = comb(inside, counts) * np.sort(shares)[counts - 1] ** counts
        # Number of distinct frames: same_px neighbouring places of the reduced scan have the same dilated response.
        extent_mm = float(np.hypot(*np.ptp(self._camera_mm, axis=0)))
        span_px = extent_mm / float(search.pitch.mean()) / search.responses.reduction
        places = next(iter(search.responses.by_key.values())).map.size
        second = 2 * search.bounds.rotation_rad * 2 * search.bounds.scale_tolerance * span_px**2
        polarities = 2 if len(self._signs) > 1 else 1
        different = places / same_px * second / same_px * len(search.distinct) * polarities
        return float(len(counts) * likely.min() * different)

    def _slack_mm(self, hypotheses: Sequence[PitchHypothesis]) -> float:
        """Largest shift of a mark, relative to the frame's centre, by a rotation and a wrong or non-square pitch."""
        scale = max(each.tolerance + float(np.abs(np.divide(each.mm, each.drawn_mm) - 1).max()) for each in hypotheses)
        farthest_mm = float(np.abs(self._camera_mm).max())
        turn = float(np.deg2rad(self.options.rotation_deg))
        return (scale + turn) * farthest_mm + self.options.search_mm(self.layout)

    def _middle_responses(self, drawn_mm: Pair, reach: float) -> Responses:
        """Responses in windows of half-width reach, mm, around the marks of a frame centred in the scan."""
        linear, views = _pixel_from_up(drawn_mm), self._views(drawn_mm)
        places = [centred_places_px(self.scan, self.layout, linear @ up_from_camera(pose)) for pose in self.poses]
        effort = self._caches[1], self._effort.half_px
        return correlate_windows(self.scan, views, np.concatenate(places), reach / max(drawn_mm), self._signs, *effort)

    def _views(self, drawn_mm: Pair) -> list[MarkView]:
        """Views of all marks, pose by pose."""
        linear = _pixel_from_up(drawn_mm)
        return [MarkView(mark.mark, linear @ up_from_camera(pose)) for pose in self.poses for mark in self.layout.marks]

    def _placements(self, hypotheses: Sequence[PitchHypothesis], responses: Responses) -> list[Placement]:
        """Find placements under hypotheses that share templates, pose by pose: the responses may exceed the cache."""
        marks = self.layout.marks
        rotation_rad, misfit_mm = float(np.deg2rad(self.options.rotation_deg)), self.options.search_mm(self.layout)
        searches = {
            each.mm: PlacementSearch(
                marks,
                responses,
                each.mm,
                Bounds(each.tolerance, rotation_rad, misfit_mm),
                self._effort.all_orientations,
                self.options.lens,
            )
            for each in hypotheses
        }
        for number, pose in enumerate(self.poses):
            for search in searches.values():
                search.search_pose(pose, responses.kinds[number * len(marks) : (number + 1) * len(marks)])
        self._searches |= searches
        every = [each for search in searches.values() for own in search.placements.values() for each in own]
        return [placement for placement in every if self._shows_middle(placement)]

    def _shows_middle(self, placement: Placement) -> bool:
        """Whether the frame contains the centre of a scan of its part: two marks also fit frames beside the scan."""
        if not self.options.part:
            return True
        linear, shift = placement.pixel_from_camera[:, :2], placement.pixel_from_camera[:, 2]
        middle_mm = np.linalg.solve(linear, np.array([self.scan.width_px, self.scan.height_px]) / 2 - shift)
        return bool((np.abs(middle_mm) < np.array(self.layout.frame_mm) / 2).all())


def _pixel_from_up(pitch_mm: Pair) -> Array:
    """(2, 2) matrix from mm right and up to pixels across and down."""
    return np.diag([1 / pitch_mm[0], -1 / pitch_mm[1]])


def _best_first(found: list[Placement]) -> list[Placement]:
    """Sort by score. Equal scores keep their order: of a symmetric camera's eight poses, "0" comes first."""
    return sorted(found, key=lambda placement: -round(placement.score, 2))
