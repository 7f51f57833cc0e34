"""The search for a camera's frame in a scan, under hypotheses about its pitch, and how often chance finds one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from scipy.special import comb

from measure.detection.candidates import FULL, Effort, Look, Responses, respond, respond_about
from measure.detection.correlation import WIDE, Map, Surroundings
from measure.detection.response_layers import Layer, Reach, layers_of
from measure.detection.scan_maps import Held
from measure.fiducials.constellation import NARROW, Bounds, Placement, PlacementSearch, same_picture, sign_of, signs_of
from measure.fiducials.hypotheses import PitchHypothesis, beside_mm, centred_places_px, reach_mm, room_mm, turned_mm
from measure.fiducials.options import FiducialOptions
from measure.geometry import POSES, up_from_camera
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Pair = tuple[float, float]

_TWIN = 0.1  # of the tolerance: poses whose marks lie so near to one another's have the same placements
_WINDOWS_SHARE = 0.6  # of the scan: where windows hold more, the whole of it takes no longer
_ANSWERS = 3  # of the mark that is looked for first, that are followed
_WAYS = 3  # of being as good: by heights, by the misfit, or by that under a stretch
_STRETCHES = np.linspace(-0.03, 0.03, 13)  # of pixels longer one way, in steps that move no mark by more than is narrow


@dataclass(frozen=True, eq=False)
class _Answers:
    """What a scan answers. look_of: the kinds of all marks' looks, in one pose after another; layers: of the responses,
    by kind and sign."""

    responses: Responses
    look_of: tuple[int, ...]
    layers: Mapping[tuple[int, int], Layer]


@dataclass(eq=False)
class _Searched:
    """One hypothesis searched, in one pose after another. looks: by pose, the kind of response of every mark; found: by
    pose, the placements, of twins of other poses only if twins says so; unlike: poses whose marks do not lie within the
    tolerance of another pose's before."""

    search: PlacementSearch
    twins: bool = True
    looks: dict[str, tuple[int, ...]] = field(default_factory=dict)
    found: dict[str, list[Placement]] = field(default_factory=dict)
    unlike: list[str] = field(default_factory=list)

    def try_pose(self, pose: str, own: tuple[int, ...]) -> None:
        """Search in a pose, own being the kinds of its marks' looks; if it is another one's twin, it has its places."""
        search, misfit_mm = self.search, self.search.bounds.misfit_mm
        twin, like = (
            next((name for name in self.found if self._same_picture(name, pose, own, within_mm)), "")
            for within_mm in (_TWIN * misfit_mm, misfit_mm)
        )
        if twin:
            camera_mm = np.array([mark.xy_mm for mark in search.marks])
            found = [place.posed(pose, camera_mm) for place in self.found[twin]] if self.twins else []
        else:
            found = search.of_pose(pose, own)
        self.looks[pose], self.found[pose] = own, found
        self.unlike += [] if like else [pose]

    def _same_picture(self, known: str, pose: str, own: tuple[int, ...], within_mm: float) -> bool:
        return same_picture(self.search.marks, (known, self.looks[known]), (pose, own), within_mm)

    def share(self, pose: str, index: int, sign: int, place: Array, tolerance_px: float) -> float:
        """Of all places, those that look as much like a mark as one does within the tolerance of a place (2,) of the
        reduced scan."""
        return self.search.layers[self.looks[pose][index], sign].within(tolerance_px).share(place)


class FrameSearch:
    """The search in one scan; it draws and correlates the marks once for hypotheses that share a drawing."""

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
        self._drawn: tuple[Pair, _Answers] | None = None
        self._searched: dict[Pair, _Searched] = {}
        # Of reaches there are two for each of the looks of one pose.
        self._maps, self._reaches = Held[Map](2 * effort.held_bytes // 3), Held[Reach](effort.held_bytes // 3)
        self._effort = effort

    def anywhere(self, hypotheses: Sequence[PitchHypothesis]) -> list[Placement]:
        """The placements in the whole scan, of all poses asked for, best first."""
        found: list[Placement] = []
        for drawn_mm, alike in groupby(hypotheses, _drawn_mm):
            if self._drawn is None or self._drawn[0] != drawn_mm:
                looks = self._looks(drawn_mm)
                answers = respond(self.scan, looks, self._signs, self.surroundings, self._maps, self._effort.half_px)
                self._drawn = drawn_mm, self._answers(*answers)
            found += self._placements(list(alike), self._drawn[1])
        return _best_first(found)

    def in_the_middle(self, hypothesis: PitchHypothesis) -> list[Placement]:
        """The placements of a frame that lies about in the middle of the scan, best first. Only the windows are read
        in which its marks lie then."""
        return _best_first(self._placements([hypothesis], self._about_middle(hypothesis.mm, reach_mm(self.layout))))

    def beside_the_middle(self, hypothesis: PitchHypothesis) -> list[Placement]:
        """The placements of a frame that lies off the middle of the scan, best first: the mark toward the first corner
        is looked for farther about, and the others where one of its strongest answers puts them all."""
        linear, mm = _flip(hypothesis.mm), hypothesis.mm
        places = [centred_places_px(self.scan, self.layout, linear @ up_from_camera(pose)) for pose in self.poses]
        first = [int(each.sum(axis=1).argmin()) for each in places]
        looks = [
            Look(self.layout.marks[mark].mark, linear @ up_from_camera(pose))
            for pose, mark in zip(self.poses, first, strict=True)
        ]
        expected_px = np.array([each[mark] for each, mark in zip(places, first, strict=True)])
        reach_px = beside_mm(self.layout) / max(mm)
        responses, kind_of = respond_about(self.scan, looks, expected_px, reach_px, self._signs, self._effort.half_px)
        answers = [
            (height, responses.scan_px(top) - expected_px[kind_of.index(kind)])
            for (kind, _), layer in layers_of(responses, self._reaches).items()
            for top, height in zip(*layer.highest(layer.candidates[:_ANSWERS], 0.0), strict=True)
        ]
        for _, shift_px in sorted(answers, key=lambda answer: -answer[0])[:_ANSWERS]:
            about = self._about_middle(mm, turned_mm(self.layout), shift_px)
            found = _best_first(self._placements([hypothesis], about))
            if found and found[0].supported == len(self.layout.marks):
                return found
        return []

    def within(self, hypotheses: Sequence[PitchHypothesis]) -> list[Placement]:
        """The placements of a frame that the scan holds all of, best first: its marks are then looked for only where
        it has room for them, if that is a small part of the scan."""
        found: list[Placement] = []
        for drawn_mm, alike in groupby(hypotheses, _drawn_mm):
            own = list(alike)
            room = room_mm(self.scan, self.layout, drawn_mm) + self._slack_mm(own)
            window_px = float(np.prod(2 * room / np.asarray(drawn_mm)))
            if len(self.layout.marks) * window_px > _WINDOWS_SHARE * self.scan.width_px * self.scan.height_px:
                found += self.anywhere(own)
            else:
                found += self._placements(own, self._about_middle(drawn_mm, room))
        return _best_first(found)

    def expected_alike(self, placement: Placement) -> float:
        """How many placements that answer as well chance would find in a scan like this without any frame, by this
        placement's hypothesis alone.

        Of n marks in the scan k answer, the weakest of them as strongly as a share p of all places do: a frame at
        random has so many with a probability of about (n over k) p^k. The frames that differ are all pairs of places,
        one for each of two marks far apart, which the bounds of turn and scale allow.
        """
        search = self._searched[placement.pitch_mm].search
        places = self._camera_mm @ placement.pixel_from_camera[:, :2].T + placement.pixel_from_camera[:, 2]
        inside = np.all((places >= 0) & (places < (self.scan.width_px, self.scan.height_px)), axis=1)
        seen = {index: places[index] for index in np.flatnonzero(inside).tolist()}
        return self._expected(placement, seen, len(seen), search.tolerance_px)

    def was_everywhere(self, placement: Placement) -> bool:
        """Whether the frame was searched in the whole scan, not only in the middle of it."""
        searched = self._searched.get(placement.pitch_mm)
        return searched is not None and searched.search.responses.origins is None

    def expected_where_seen(self, placement: Placement, inside: int, seen_px: dict[int, Array]) -> float:
        """The same of a frame that was measured: of its marks inside the scan, those that count as seen, by index, and
        where. Chance puts marks anywhere within the tolerance: those that a similarity fits better, or one under one of
        the stretches, are the less likely, the more of them there are."""
        widest_px, expected = self._searched[placement.pitch_mm].search.tolerance_px, list[float]()
        for stretches in (np.zeros(1), _STRETCHES):
            misfit_px = self._misfit_px(placement, seen_px, stretches)
            tolerance_px = min(max(misfit_px, NARROW * widest_px), widest_px)
            expected.append(len(stretches) * self._expected(placement, seen_px, inside, tolerance_px))
        return _WAYS * min(expected)

    def places_as_good(self, placement: Placement, index: int, seen_px: Array) -> Array:
        """(n, 2) the strongest places of the scan that at reduced size answer to a mark, by index, as strongly as the
        one (2,) where it was seen."""
        searched = self._searched[placement.pitch_mm]
        sign = sign_of(self.layout.marks[index].mark, placement.polarity)
        layer, responses = (
            searched.search.layers[searched.looks[placement.pose][index], sign],
            searched.search.responses,
        )
        height = layer.within(searched.search.tolerance_px).height(responses.reduced_px(seen_px))
        heights = layer.highest(layer.candidates, 0.0)[1]
        return responses.scan_px(layer.candidates[heights >= height])

    def _misfit_px(self, placement: Placement, seen_px: dict[int, Array], stretches: Array) -> float:
        """How far from its place (px of the reduced scan) the best similarity leaves a mark that was seen, pixels being
        longer one way by the best of the stretches."""
        if not seen_px:
            return 0.0
        pitch = np.asarray(placement.pitch_mm)
        given = self._camera_mm[list(seen_px)] @ placement.pixel_from_camera[:, :2].T
        given, seen = ((each - each.mean(axis=0)) * pitch for each in (given, np.array([*seen_px.values()])))
        longer = np.stack([1 + stretches / 2, 1 - stretches / 2], axis=-1)
        given, seen = (given * longer[:, None]) @ (1, 1j), seen @ (1, 1j)
        turns = (given.conj() @ seen) / np.maximum((np.abs(given) ** 2).sum(axis=1), 1e-12)
        off = np.abs(seen - turns[:, None] * given).max(axis=1)
        return float(off.min() / pitch.mean() / placement.reduction)

    def _expected(self, placement: Placement, seen_px: dict[int, Array], inside: int, tolerance_px: float) -> float:
        """seen_px: by index, where marks were seen, within tolerance_px (of the reduced scan) of the frame's places."""
        searched, shares, same_px = self._searched[placement.pitch_mm], [], 1
        for index, place in seen_px.items():
            sign = sign_of(self.layout.marks[index].mark, placement.polarity)
            reduced = searched.search.responses.reduced_px(place)
            shares.append(searched.share(placement.pose, index, sign, reduced, tolerance_px))
            same_px = searched.search.layers[searched.looks[placement.pose][index], sign].within(tolerance_px).area_px
        counts = np.arange(max(min(3, inside), 1), len(shares) + 1)
        if len(counts) == 0:
            return np.inf
        likely = comb(inside, counts) * np.sort(shares)[counts - 1] ** counts
        return float(len(counts) * likely.min() * self._different_frames(searched, same_px))

    def _different_frames(self, searched: _Searched, same_px: int) -> float:
        """same_px: of the reduced scan: places so near to one another that they answer alike."""
        search = searched.search
        span_px = (
            float(np.hypot(*np.ptp(self._camera_mm, axis=0))) / float(search.pitch.mean()) / search.responses.reduction
        )
        places = next(iter(search.layers.values())).map.size
        of_other = 2 * search.bounds.rotation_rad * 2 * search.bounds.scale_tolerance * span_px**2
        polarities = 2 if len(self._signs) > 1 else 1
        return places / same_px * of_other / same_px * len(searched.unlike) * polarities

    def _slack_mm(self, hypotheses: Sequence[PitchHypothesis]) -> float:
        """How far a turn, and a pitch that is wrong or longer one way, move a mark from where the frame's middle puts
        it."""
        scale = max(each.tolerance + float(np.abs(np.divide(each.mm, each.drawn_mm) - 1).max()) for each in hypotheses)
        farthest_mm = float(np.abs(self._camera_mm).max())
        turn = float(np.deg2rad(self.options.rotation_deg))
        return (scale + turn) * farthest_mm + self.options.search_mm(self.layout)

    def _about_middle(self, drawn_mm: Pair, reach_mm: float, shift_px: Array | float = 0.0) -> _Answers:
        """What the windows answer that reach so far about the marks of a frame in the middle of the scan, or beside it
        by shift_px (2,)."""
        linear, looks = _flip(drawn_mm), self._looks(drawn_mm)
        places = [centred_places_px(self.scan, self.layout, linear @ up_from_camera(pose)) for pose in self.poses]
        reach_px = reach_mm / max(drawn_mm)
        places_px = np.concatenate(places) + shift_px
        about = respond_about(self.scan, looks, places_px, reach_px, self._signs, self._effort.half_px)
        return self._answers(*about)

    @property
    def _signs(self) -> set[int]:
        return signs_of(self.layout.marks)

    def _looks(self, drawn_mm: Pair) -> list[Look]:
        linear = _flip(drawn_mm)
        return [Look(mark.mark, linear @ up_from_camera(pose)) for pose in self.poses for mark in self.layout.marks]

    def _answers(self, responses: Responses, look_of: tuple[int, ...]) -> _Answers:
        return _Answers(responses, look_of, layers_of(responses, self._reaches))

    def _placements(self, hypotheses: Sequence[PitchHypothesis], answers: _Answers) -> list[Placement]:
        """The placements under hypotheses that share a drawing. Pose by pose, for the responses of all may be more
        than can be held."""
        marks, responses, look_of = self.layout.marks, answers.responses, answers.look_of
        rotation_rad, misfit_mm = float(np.deg2rad(self.options.rotation_deg)), self.options.search_mm(self.layout)
        tried = {
            each.mm: _Searched(PlacementSearch(marks, responses, each.mm, bounds, answers.layers), self._effort.twins)
            for each in hypotheses
            for bounds in [Bounds(each.tolerance, rotation_rad, misfit_mm)]
        }
        for number, pose in enumerate(self.poses):
            own, later = look_of[number * len(marks) : (number + 1) * len(marks)], look_of[(number + 1) * len(marks) :]
            responses.expect(own, later)
            for searched in tried.values():
                searched.try_pose(pose, own)
        self._searched |= tried
        every = [placement for searched in tried.values() for found in searched.found.values() for placement in found]
        return [placement for placement in every if self._may_be(placement)]

    def _may_be(self, placement: Placement) -> bool:
        """Whether the scan's middle is in the frame, where it shows a part of it: two marks fit others as well, whose
        frame would lie beside the scan."""
        if not self.options.part:
            return True
        linear, shift = placement.pixel_from_camera[:, :2], placement.pixel_from_camera[:, 2]
        middle_mm = np.linalg.solve(linear, np.array([self.scan.width_px, self.scan.height_px]) / 2 - shift)
        return bool((np.abs(middle_mm) < np.array(self.layout.frame_mm) / 2).all())


def _drawn_mm(hypothesis: PitchHypothesis) -> Pair:
    return hypothesis.drawn_mm


def _flip(pitch_mm: Pair) -> Array:
    """(2, 2) from mm right and up to pixels across and down."""
    return np.diag([1 / pitch_mm[0], -1 / pitch_mm[1]])


def _best_first(found: list[Placement]) -> list[Placement]:
    """Poses that score alike keep their order: of a symmetric camera's eight, "0" comes first."""
    return sorted(found, key=lambda placement: -round(placement.score, 2))
