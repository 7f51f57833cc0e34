"""Response of a scan to the marks of a camera, as a criterion for recognising the camera and the scan's pitch.

It consists of the best placements at reduced resolution, their expected number of false alarms, and the likeness of the
marks there. The repeated attempts of a measurement are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import comb

from measure.detection.localisation import localise
from measure.detection.responses import SearchEffort
from measure.fiducials.constellation import Placement, distinct_places
from measure.fiducials.measure_frame import Frame, detect_frame
from measure.fiducials.options import FiducialOptions
from measure.fiducials.search import (
    FrameSearch,
    Hypotheses,
    PitchHypothesis,
    at_pitch,
    false_placements,
    longer,
    pitch_hypotheses,
)
from measure.flags import CAMERA_BY_NOISE, MAX_FALSE_CAMERAS
from measure.geometry import linear_scale, scan_px
from measure.marks.shapes import FiducialLayout, LayoutMark, is_made_of_areas
from measure.matching.models import MatchOptions
from measure.scans.opening import thumbnail
from measure.scans.scan import Scan

_LARGEST_PX = 1600  # px, size of the searched image: for aerial film 1/7 mm per pixel, about the width of fine lines
_COARSE_PX = 1024  # px, while the pitch is unknown: fine lines are then half a pixel wide
_SOLID_PX = 800  # px, for solid marks, which have a size of some millimetres
_COARSE_SOLID_PX = 512  # px, for solid marks while the pitch is unknown
_ALIKE_MM = 0.1  # mm: cameras whose marks lie closer to one another cannot be distinguished in a scan
_BOLD = 4  # smallest number of marks to search
_ENOUGH = 12  # marks to measure: of layouts with more, such as réseaux, only every second mark is measured
_STRETCH = (1.08, 0.93)  # x and y scale of the null layout: no film is so deformed, so all its marks are false alarms

_COMPARED = 3  # best places: the one with the fewest false alarms is among them
_QUICK = SearchEffort(cache_bytes=40 << 20, half_px=16, every_pose=False)
_AT_LEAST = 3  # marks of a frame that must be detected
_PLACES = 2  # best places that are tried
_QUICK_OPTIONS = FiducialOptions(match=MatchOptions(damage_rounds=1))  # likeness needs less accuracy than the place


@dataclass(frozen=True, eq=False)
class CameraResponse:
    """Response of a scan to a camera's constellation of marks.

    expected: number of constellations as good expected in a similar scan without a frame of this camera, infinite
    without a placement. placements: best first.
    """

    expected: float
    placements: tuple[Placement, ...]


def search_camera(
    scan: Scan, layout: FiducialLayout, hypotheses: Sequence[PitchHypothesis], tried: int
) -> CameraResponse:
    """Search a scan for the constellation of a camera, under pitch hypotheses. tried: number of earlier hypotheses."""
    options, tried = FiducialOptions(), tried + len(hypotheses)
    result = FrameSearch(scan, layout, options, _QUICK).search_room(options, hypotheses)
    found = distinct_places(result.placements, _COMPARED)
    expected = [tried * false_placements(result, placement) for placement in found]
    return CameraResponse(min(expected, default=np.inf), tuple(found))


def recognise_frame(scan: Scan, layout: FiducialLayout, response: CameraResponse, times: float) -> Frame | None:
    """Detect the frame of a camera in the best placements; None if it is accepted in none.

    Parameters
    ----------
    answered : response of a thumbnail of the scan; at most two places are tried.
    times : pixels of the scan for one pixel of the thumbnail, along a side.
    """
    for placement in response.placements[:_PLACES]:
        linear, shift = placement.pixel_from_camera[:, :2], placement.pixel_from_camera[:, 2]
        pixel_from_camera = np.column_stack([times * linear, scan_px(shift, times)])
        enlarged = replace(
            placement,
            pixel_from_camera=pixel_from_camera,
            pitch_mm=(placement.pitch_mm[0] / times, placement.pitch_mm[1] / times),
            reduction=int(np.ceil(times * placement.reduction)),
        )
        if response.expected > MAX_FALSE_CAMERAS:
            # Whether its most significant peaks are improbable as noise is found ten times as fast as by a fit. Each
            # has a probability of its own: by `chance_of_marks` the weakest would stand for all.
            frame = Frame.from_placement(scan, layout, enlarged, _QUICK_OPTIONS)
            indices = range(len(layout.marks))
            peaks = [localise(scan, frame.prediction(index, frame.first_search_px)) for index in indices]
            false_alarms = np.sort([1.0 if peak is None else peak[1] for peak in peaks])[:_AT_LEAST]
            if not comb(len(peaks), len(false_alarms)) * false_alarms.prod() <= CAMERA_BY_NOISE:
                continue
        # All marks count in the score: without the missing ones, a camera of eight loses to one that has four.
        frame = detect_frame(scan, layout, enlarged, _QUICK_OPTIONS, is_quick=True)
        if frame.accepted:
            return frame
    return None


def likeness(frame: Frame) -> float:
    """Mean over all marks of the likeness times the undamaged fraction of the mark; a mark not found counts 0.

    Parts of another mark count as damage, such as a ring around a cross that is drawn without one.
    """
    scores = (fit.likeness * (1.0 - fit.damaged_fraction) for fit in frame.inlier_fits.values())
    return float(sum(scores) / len(frame.detections))


def find_pitch_mm(scan: Scan, layout: FiducialLayout) -> float | None:
    """Pitch under which the bold marks of a frame that fills its scan are significant in a thumbnail; None without one.

    Both searches can miss marks: the coarse one thin lines, the fine one solid marks larger than drawn.
    """
    search = LayoutSearch(scan)
    coarse = search.try_any_pitch(layout)
    best = min(coarse, search.refine(coarse), key=lambda each: each.answer.expected)
    if best.answer.expected > MAX_FALSE_CAMERAS:
        return None
    px_per_mm = linear_scale(best.answer.placements[0].pixel_from_camera)
    return best.picture.width_px / scan.width_px / px_per_mm


@dataclass(frozen=True, eq=False)
class Tried:
    """Search result of one layout.

    Attributes
    ----------
    bold : its boldest marks, which are searched.
    picture : the searched image, the scan at reduced size.
    hypotheses : pixel pitches that were tried.
    before : number of other hypotheses tried before, counted in the expected false alarms.
    answer : correlation result of the bold marks.
    """

    layout: FiducialLayout
    bold: FiducialLayout
    picture: Scan
    hypotheses: Hypotheses
    before: int
    answer: CameraResponse


class LayoutSearch:
    """Search for layouts in one scan, or in a thumbnail of it that is large enough to measure the marks."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self._fine = thumbnail(scan, _LARGEST_PX)
        self._coarse, self._solid, self._coarse_solid = (
            thumbnail(self._fine, side_px) for side_px in (_COARSE_PX, _SOLID_PX, _COARSE_SOLID_PX)
        )
        self._known: list[Tried] = []

    def try_pitch(
        self, layout: FiducialLayout, pitch_um: tuple[float, float], stretches: Sequence[float] = ()
    ) -> Tried:
        """Search at the scan's pitch.

        stretches: of pixels that are not square, beyond the affinity that this search allows; then only these are
        tried.
        """
        bold = boldest(layout)
        picture = self._solid if all(is_made_of_areas(mark) for mark in bold.marks) else self._fine
        times = self._scan.width_px / picture.width_px
        options = FiducialOptions(pitch_is_right=True)
        ((given,), *_) = pitch_hypotheses(picture, bold, (times * pitch_um[0], times * pitch_um[1]), options)
        hypotheses = [longer(given, each) for each in stretches] or [given]
        return self._try_layout(_some(layout), bold, picture, hypotheses, before=1 if stretches else 0)

    def try_any_pitch(self, layout: FiducialLayout) -> Tried:
        """Search without a pitch: the frame is assumed to fill the scan, and the pixels to be square."""
        bold = boldest(layout)
        picture = self._coarse_solid if all(is_made_of_areas(mark) for mark in bold.marks) else self._coarse
        return self._try_layout(
            _some(layout), bold, picture, pitch_hypotheses(picture, bold, None, FiducialOptions())[0]
        )

    def refine(self, coarse: Tried) -> Tried:
        """Repeat the search in a larger image, at the pitch of the best placement."""
        if not coarse.answer.placements:
            return coarse
        picture = self._solid if coarse.picture is self._coarse_solid else self._fine
        px_per_mm = linear_scale(coarse.answer.placements[0].pixel_from_camera)
        pitch_mm = coarse.picture.width_px / picture.width_px / px_per_mm
        hypotheses = at_pitch(coarse.hypotheses, pitch_mm)
        return self._try_layout(coarse.layout, coarse.bold, picture, hypotheses, len(coarse.hypotheses))

    def stretch(self, tried: Tried) -> Tried:
        """Repeat the search for the stretched layout, whose marks are in wrong places."""
        layout, bold = _stretched_layout(tried.layout), _stretched_layout(tried.bold)
        return self._try_layout(layout, bold, tried.picture, tried.hypotheses, tried.before)

    def recognise(self, tried: Tried) -> Frame | None:
        """Measure the marks of a layout at its best placement."""
        return recognise_frame(self._scan, tried.layout, tried.answer, self._scan.width_px / tried.picture.width_px)

    def _try_layout(
        self, layout: FiducialLayout, bold: FiducialLayout, picture: Scan, hypotheses: Hypotheses, before: int = 0
    ) -> Tried:
        for known in self._known:
            if known.picture is picture and known.hypotheses == hypotheses and same_marks(known.bold.marks, bold.marks):
                return replace(known, layout=layout)
        answered = search_camera(picture, bold, hypotheses, before)
        self._known.append(Tried(layout, bold, picture, hypotheses, before, answered))
        return self._known[-1]


def same_marks(first: Sequence[LayoutMark], second: Sequence[LayoutMark]) -> bool:
    """Whether the marks of two layouts cannot be distinguished in a scan."""
    return len(first) == len(second) and all(
        repr(a.mark) == repr(b.mark) and np.hypot(a.xy_mm[0] - b.xy_mm[0], a.xy_mm[1] - b.xy_mm[1]) < _ALIKE_MM
        for a, b in zip(first, second, strict=True)
    )


def boldest(layout: FiducialLayout) -> FiducialLayout:
    """The layout's most visible marks, if there are enough: solid ones, or else those with the widest lines."""
    groups: dict[float, list[LayoutMark]] = {}
    for mark in layout.marks:
        groups.setdefault(np.inf if is_made_of_areas(mark) else mark.mark.thinnest_mm, []).append(mark)
    enough = [width for width, marks in groups.items() if len(marks) >= _BOLD]
    return replace(layout, marks=tuple(groups[max(enough)])) if enough else layout


def _some(layout: FiducialLayout) -> FiducialLayout:
    """Thin out a layout with many marks: half of them suffice to detect it."""
    return replace(layout, marks=layout.marks[:: 1 if len(layout.marks) <= _ENOUGH else 2])


def _stretched_layout(layout: FiducialLayout) -> FiducialLayout:
    x, y = _STRETCH
    marks = tuple(replace(mark, xy_mm=(x * mark.xy_mm[0], y * mark.xy_mm[1])) for mark in layout.marks)
    return replace(layout, marks=marks)
