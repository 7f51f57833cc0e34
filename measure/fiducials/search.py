"""Search for a camera's frame in a scan: pitch hypotheses, and the placements found under them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress, groupby
from operator import attrgetter

import numpy as np

from measure.array_types import Array
from measure.detection.correlation import WIDE, Surroundings, chance_of_marks
from measure.detection.responses import MarkView, Responses, SearchEffort, correlate_scan, correlate_windows
from measure.fiducials.constellation import Bounds, Placement, PlacementSearch, lattice_steps_mm, mark_sign
from measure.fiducials.options import FiducialOptions
from measure.geometry import POSES, UP_FROM_CAMERA, reduced_px
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan

Pair = tuple[float, float]

_PITCH_STRETCHES = (-0.015, 0.015, -0.03, 0.03)  # relative: an office scanner's carriage may be some per cent too fast
_SCALE_STEPS = (1.1, 1.0, 0.91, 0.83, 0.75)  # of the largest scale at which the frame fits into the scan
_STEP_TOLERANCE = 0.06  # relative tolerance of each scale step: it reaches the next step
_FOUND_TOLERANCE = 0.02  # relative, of a pitch found in a reduced scan
_LARGE_PX = 1 << 24  # px in a large scan; smaller ones are read whole in a short time
_REACH = 0.025  # fraction of the frame's side: film laid by hand is off by some millimetres and a degree
_LARGEST_SHARE = 0.25  # fraction of the scan: above it the whole scan is searched, for the additional evidence
_BEYOND_MM = 3.0  # mm beyond the scan's edge: a frame may be cut off there by less than its rim
_WINDOWS_SHARE = 0.6  # fraction of the scan: above it the whole scan takes no longer than the windows


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


def at_pitch(hypotheses: Hypotheses, pitch_mm: float) -> Hypotheses:
    """Hypotheses with the pixels' stretches of these, at a pitch that a search of a reduced scan found."""
    square = PitchHypothesis((pitch_mm, pitch_mm), _FOUND_TOLERANCE, (pitch_mm, pitch_mm))
    ratios = dict.fromkeys(tuple(np.round(np.divide(each.mm, each.drawn_mm), 9).tolist()) for each in hypotheses)
    return [replace(square, mm=(pitch_mm * x, pitch_mm * y)) for x, y in ratios]


def longer(given: PitchHypothesis, stretch: float) -> PitchHypothesis:
    """Stretch the pixels: longer across than down by a relative amount, or shorter if it is negative."""
    x, y = given.mm
    return replace(given, mm=(x * (1 + stretch / 2), y * (1 - stretch / 2)))


# Search in windows for a frame near the middle of its scan, or as far off as the scan has room for it. Of a large scan
# only the windows around the expected marks are read; if any mark is not clear there, the whole scan is searched.


def reach_mm(layout: FiducialLayout) -> float:
    """Search radius around the place of a mark in a centred frame."""
    return _REACH * max(layout.frame_mm)


def is_searched_by_windows(scan: Scan, layout: FiducialLayout, pitch_mm: tuple[float, float]) -> bool:
    """Whether the scan is large, the windows around the marks a small part of it, and the marks no lattice.

    In a lattice a window may hold the next mark instead.
    """
    side_px = 2 * reach_mm(layout) / np.asarray(pitch_mm)
    size_px = scan.width_px * scan.height_px
    share = len(layout.marks) * float(np.prod(side_px)) / size_px
    return size_px >= _LARGE_PX and share < _LARGEST_SHARE and not is_lattice(layout)


def is_lattice(layout: FiducialLayout) -> bool:
    """Whether a step maps most marks to others: a lattice may be found one step off."""
    return len(lattice_steps_mm(layout.places_mm, reach_mm(layout) / 2)) > 0


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Placements found in a scan.

    Attributes
    ----------
    placements : of all scan orientations, best first.
    searches : by pixel pitch, with the responses from which false alarms are estimated.
    size_px : width and height of the scan.
    """

    placements: tuple[Placement, ...] = ()
    searches: Mapping[Pair, PlacementSearch] = field(default_factory=dict)
    size_px: tuple[int, int] = (0, 0)

    def is_exhaustive(self, placement: Placement) -> bool:
        """Whether the placement was found by a search of the whole scan, not of windows alone."""
        search = self.searches.get(placement.pitch_mm)
        return search is not None and search.responses.origins is None

    def join(self, other: "SearchResult") -> "SearchResult":
        """Join the placements under other hypotheses, best first."""
        # Equal scores keep their order: of a symmetric camera's eight poses, "0" comes first.
        placements = sorted((*self.placements, *other.placements), key=lambda placement: -round(placement.score, 2))
        return SearchResult(tuple(placements), {**self.searches, **other.searches}, other.size_px)


class FrameSearch:
    """Search in one scan, whose pixels are read here alone. Templates are rendered and correlated once for hypotheses
    with the same drawn_mm."""

    def __init__(
        self, scan: Scan, layout: FiducialLayout, options: FiducialOptions, effort: SearchEffort | None = None
    ) -> None:
        self.scan, self.layout, self._effort = scan, layout, effort or SearchEffort()
        self._poses = POSES if options.pose == "auto" else (options.pose,)
        self._camera_mm = layout.places_mm
        self._signs = {mark_sign(mark.mark, assumed) for mark in layout.marks for assumed in (1, -1)}
        self._cache = self._effort.make_cache(scan)
        self._last: tuple[tuple[Pair, Surroundings], Responses] | None = None

    def search_scan(
        self, options: FiducialOptions, hypotheses: Hypotheses, surroundings: Surroundings = WIDE
    ) -> SearchResult:
        """Find placements in the whole scan."""
        result = SearchResult()
        for drawn_mm, alike in groupby(hypotheses, attrgetter("drawn_mm")):
            result = result.join(self._placements(options, list(alike), self._scan_responses(drawn_mm, surroundings)))
        return result

    def search_middle(self, options: FiducialOptions, hypotheses: Hypotheses) -> SearchResult:
        """Find placements of a frame near the middle of the scan. Reads only windows around its marks."""
        responses = self._middle_responses(hypotheses[0].mm, reach_mm(self.layout))
        return SearchResult().join(self._placements(options, hypotheses, responses))

    def search_room(self, options: FiducialOptions, hypotheses: Hypotheses) -> SearchResult:
        """Find placements of a frame that lies wholly inside the scan.

        Each mark is searched only in the window that this leaves, if all windows together are clearly smaller than the
        scan.
        """
        scan_px, span_mm = np.array([self.scan.width_px, self.scan.height_px]), float(np.abs(self._camera_mm).max())
        result = SearchResult()
        for drawn_mm, alike in groupby(hypotheses, attrgetter("drawn_mm")):
            own = list(alike)
            # Distance between the centres of scan and frame, and of a mark from its place in the frame, by a rotation
            # and a wrong or non-square pitch.
            room = max((float((scan_px * drawn_mm).max()) - min(self.layout.frame_mm)) / 2, 0.0) + _BEYOND_MM
            scale = max(each.tolerance + float(np.abs(np.divide(each.mm, drawn_mm) - 1).max()) for each in own)
            turn = float(np.deg2rad(options.rotation_deg))
            room += (scale + turn) * span_mm + options.search_mm(self.layout)
            window_px = float(np.prod(2 * room / np.asarray(drawn_mm)))
            is_wide = len(self.layout.marks) * window_px > _WINDOWS_SHARE * self.scan.width_px * self.scan.height_px
            responses = self._scan_responses(drawn_mm, WIDE) if is_wide else self._middle_responses(drawn_mm, room)
            result = result.join(self._placements(options, own, responses))
        return result

    def _scan_responses(self, drawn_mm: Pair, surroundings: Surroundings) -> Responses:
        """Responses in the whole scan; the last ones are kept for the next attempt."""
        key = drawn_mm, surroundings
        if self._last is None or self._last[0] != key:
            how = self._signs, surroundings, self._cache, self._effort.half_px, len(self.layout.marks)
            self._last = key, correlate_scan(self.scan, self._views(drawn_mm), *how)
        return self._last[1]

    def _middle_responses(self, drawn_mm: Pair, reach: float) -> Responses:
        """Responses in windows of half-width reach, mm, around the marks of a frame centred in the scan."""
        middle = (self._camera_mm.min(axis=0) + self._camera_mm.max(axis=0)) / 2
        center = np.array([self.scan.width_px - 1, self.scan.height_px - 1]) / 2
        views = self._views(drawn_mm)
        offsets = np.tile(self._camera_mm - middle, (len(self._poses), 1))
        places = np.einsum("nij,nj->ni", [view.linear for view in views], offsets) + center
        how = self._signs, self._cache, self._effort.half_px
        return correlate_windows(self.scan, views, places, reach / max(drawn_mm), *how)

    def _views(self, drawn_mm: Pair) -> list[MarkView]:
        """Views of all marks, pose by pose."""
        linear = np.diag([1 / drawn_mm[0], -1 / drawn_mm[1]])  # from mm right and up to pixels across and down
        return [
            MarkView(mark.mark, linear @ UP_FROM_CAMERA[pose]) for pose in self._poses for mark in self.layout.marks
        ]

    def _placements(self, options: FiducialOptions, hypotheses: Hypotheses, responses: Responses) -> SearchResult:
        """Find placements under hypotheses that share templates, pose by pose: the responses may exceed the cache."""
        marks, misfit_mm = self.layout.marks, options.search_mm(self.layout)
        rotation_rad = float(np.deg2rad(options.rotation_deg))
        searches = {
            each.mm: PlacementSearch(
                marks,
                responses,
                each.mm,
                Bounds(each.tolerance, rotation_rad, misfit_mm),
                options.lens,
                self._effort.every_pose,
            )
            for each in hypotheses
        }
        for number, pose in enumerate(self._poses):
            for search in searches.values():
                search.search_pose(pose, responses.kinds[number * len(marks) : (number + 1) * len(marks)])
        found = [each for search in searches.values() for own in search.placements.values() for each in own]
        size_px = self.scan.width_px, self.scan.height_px
        if options.part:  # it shows its scan's centre in the frame: two marks also fit frames beside the scan
            matrices, middle_px = [each.pixel_from_camera for each in found], np.array(size_px) / 2
            middles_mm = [np.linalg.solve(matrix[:, :2], middle_px - matrix[:, 2]) for matrix in matrices]
            frame_mm = np.array(self.layout.frame_mm)
            within = [bool((np.abs(middle_mm) < frame_mm / 2).all()) for middle_mm in middles_mm]
            found = list(compress(found, within))
        return SearchResult(tuple(found), searches, size_px)


def false_placements(result: SearchResult, placement: Placement) -> float:
    """Expected number of placements as good in a similar scan without any frame, under this pitch hypothesis alone."""
    search = result.searches[placement.pitch_mm]
    places = placement.places_px(search.camera_mm)
    inside = np.all((places >= 0) & (places < result.size_px), axis=1)
    found = {index: places[index] for index in np.flatnonzero(inside).tolist()}
    return false_alarms(result, placement, found, len(found), search.tolerance_px)


def false_alarms(
    result: SearchResult, placement: Placement, found_px: Mapping[int, Array], inside: int, tolerance_px: float
) -> float:
    """Expected number of false frames, from the shares of places that respond as strongly within tolerance_px.

    The weakest mark found responds as strongly as a share of all places. The number of distinct frames is that of all
    pairs of places, for two marks far apart, that the bounds of rotation and scale allow.
    """
    search = result.searches[placement.pitch_mm]
    responses, shares, same_px = search.responses, [], 1
    for index, place in found_px.items():
        dilation = responses.dilated(search.key(placement, index), tolerance_px)
        shares.append(dilation.share(reduced_px(place, responses.reduction)))
        same_px = dilation.area_px
    counts = np.arange(max(min(3, inside), 1), len(shares) + 1)
    if len(counts) == 0:
        return np.inf
    likely = chance_of_marks(counts, inside, np.sort(shares)[counts - 1])
    # Number of distinct frames: same_px neighbouring places of the reduced scan have the same dilated response.
    extent_mm = float(np.hypot(*np.ptp(search.camera_mm, axis=0)))
    span_px = extent_mm / float(search.pitch.mean()) / responses.reduction
    places = next(iter(responses.maps.values())).size
    second = 2 * search.bounds.rotation_rad * 2 * search.bounds.scale_tolerance * span_px**2
    polarities = len({sign for _, sign in responses.maps})
    different = places / same_px * second / same_px * len(search.distinct) * polarities
    return float(len(counts) * likely.min() * different)
