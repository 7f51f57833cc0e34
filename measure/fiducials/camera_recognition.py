"""How a scan answers to the marks of a camera, so that cameras can be told apart: where they answer best at reduced
size, how often chance makes that, and how the marks look there. The retries of a measurement are no part of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import comb

from measure.detection.localisation import localise
from measure.detection.responses import Effort
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import detect_clear_marks, detect_missing_marks
from measure.fiducials.options import FiducialOptions
from measure.fiducials.search import FrameSearch, PitchHypothesis
from measure.flags import CAMERA_BY_CHANCE, CAMERA_BY_NOISE
from measure.marks.shapes import FiducialLayout
from measure.matching.options import MatchOptions
from measure.results import MarkFit
from measure.scans.scan import Scan

_COMPARED = 3  # best placements: the one that chance makes least is among them
_QUICK = Effort(cache_bytes=48 << 20, half_px=16, all_orientations=False)
_AT_LEAST = 3  # marks that are seen of a frame
_TRIED = 3  # at the best of these
_PLACES = 2  # that are looked at, each in the poses that answer there
_QUICK_OPTIONS = FiducialOptions(match=MatchOptions(damage_rounds=1))  # how a mark looks takes less than where it lies


@dataclass(frozen=True, eq=False)
class Answer:
    """expected: how many constellations that answer as well as the scan's best one chance would find in a scan like it
    without any frame of this camera, infinite where none answers. placements: best first."""

    expected: float
    placements: tuple[Placement, ...]


def search_camera(scan: Scan, layout: FiducialLayout, hypotheses: Sequence[PitchHypothesis], tried: int = 0) -> Answer:
    """How the scan answers to the constellation under hypotheses about its pitch. tried: how many were before."""
    search, tried = FrameSearch(scan, layout, FiducialOptions(), effort=_QUICK), tried + len(hypotheses)
    found = search.search_room(hypotheses)[:_COMPARED]
    expected = [tried * search.false_placements(placement) for placement in found]
    return Answer(min(expected, default=np.inf), tuple(found))


def recognise_frame(scan: Scan, layout: FiducialLayout, answered: Answer, times: float = 1.0) -> Frame | None:
    """The frame as its marks look at the first of the best placements where they agree, at one of two places in any of
    the poses that answer there, None where they do nowhere. times: how many pixels a side the scan has for one of what
    answered, a thumbnail of it."""
    places = list[Placement]()
    for placement in answered.placements[:_TRIED]:
        if not any(placement.same_place(other) for other in places):
            places.append(placement)
        if len(places) > _PLACES:
            break
        enlarged = _enlarged(placement, times)
        if answered.expected <= CAMERA_BY_CHANCE or _may_be_there(scan, layout, enlarged):
            frame = detect_clear_marks(scan, layout, enlarged, _QUICK_OPTIONS)
            frame = frame if frame.accepted else detect_missing_marks(frame)
            if frame.accepted:
                return frame
    return None


def _may_be_there(scan: Scan, layout: FiducialLayout, placement: Placement) -> bool:
    """Whether noise hardly makes three of the marks look like themselves as much as they do. A fit takes ten times as
    long as to see that."""
    frame = Frame.from_placement(scan, layout, placement, _QUICK_OPTIONS)
    peaks = [localise(scan, frame.prediction(index, frame.first_search_px)) for index in range(len(layout.marks))]
    false_alarms = np.sort([1.0 if peak is None else peak[1] for peak in peaks])[:_AT_LEAST]
    return bool(comb(len(peaks), len(false_alarms)) * false_alarms.prod() <= CAMERA_BY_NOISE)


def _enlarged(placement: Placement, times: float) -> Placement:
    """The same in a scan of so many pixels a side for one."""
    pixel_from_camera = times * placement.pixel_from_camera
    pixel_from_camera[:, 2] += (times - 1) / 2
    x, y = placement.pitch_mm
    return replace(
        placement,
        pixel_from_camera=pixel_from_camera,
        pitch_mm=(x / times, y / times),
        reduction=int(np.ceil(times * placement.reduction)),
    )


def likeness(frame: Frame) -> float:
    """The mean, over all marks, of likeness times the share of the mark that is undamaged. What belongs to another
    mark, the ring about a cross that is drawn without one, counts as damage; a mark that is not found counts 0."""
    return float(np.mean([0.0 if fit is None else _undamaged(fit) for fit in frame.fits]))


def _undamaged(fit: MarkFit) -> float:
    return fit.likeness * (1.0 - fit.damaged_fraction)
