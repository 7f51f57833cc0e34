"""How a scan answers to the marks of a camera, so that cameras can be told apart: where they answer best at reduced
size, how often chance makes that, and how the marks look there. The retries of a measurement are no part of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.fiducial_options import FiducialOptions
from measure.fitting.matching import Match
from measure.frames.frame import Frame
from measure.frames.frame_measurement import look_at_frame
from measure.marks.shapes import FiducialLayout
from measure.match_options import MatchOptions
from measure.probabilities import CAMERA_BY_CHANCE
from measure.scans.scan import Scan
from measure.search.candidates import Effort
from measure.search.constellation import Placement
from measure.search.frame_search import FrameSearch
from measure.search.pitches import PitchHypothesis

_COMPARED = 5  # best placements: the one that chance makes least is among them
_QUICK = Effort(held_bytes=48 << 20, half_px=16)
_LOOKS = 3  # at the best of these
_PLACES = 2  # that are looked at, each in the poses that answer there
_LOOK = FiducialOptions(match=MatchOptions(damage_rounds=1))  # how a mark looks takes less than where it lies


@dataclass(frozen=True, eq=False)
class Answer:
    """expected: how many constellations that answer as well as the scan's best one chance would find in a scan like it
    without any frame of this camera, infinite where none answers. placements: those that chance makes least first."""

    expected: float
    placements: tuple[Placement, ...]


def answer(
    scan: Scan, layout: FiducialLayout, hypotheses: Sequence[Sequence[PitchHypothesis]], tried: int = 0
) -> Answer:
    """How the scan answers to the constellation under groups of hypotheses about its pitch, a later one being tried
    where chance may have made what answers to the earlier ones. tried: hypotheses that were tried before."""
    search, ranked = FrameSearch(scan, layout, FiducialOptions(), effort=_QUICK), list[tuple[float, Placement]]()
    for group in hypotheses:
        tried += len(group)
        found = search.within(group)[:_COMPARED]
        ranked += [(tried * search.expected_alike(placement), placement) for placement in found]
        ranked.sort(key=lambda each: each[0])
        if ranked and ranked[0][0] <= CAMERA_BY_CHANCE:
            break
    return Answer(ranked[0][0] if ranked else np.inf, tuple(placement for _, placement in ranked))


def seen(scan: Scan, layout: FiducialLayout, answered: Answer, times: float = 1.0) -> Frame | None:
    """The frame as its marks look at the first of the best placements where they agree, at one of two places in any of
    the poses that answer there, None where they do nowhere. times: how many pixels a side the scan has for one of what
    answered, a thumbnail of it."""
    places = list[Placement]()
    for placement in answered.placements[:_LOOKS]:
        if not any(placement.same_place(other) for other in places):
            places.append(placement)
        if len(places) > _PLACES:
            break
        frame = look_at_frame(scan, layout, _enlarged(placement, times), _LOOK)
        if frame.accepted:
            return frame
    return None


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


def _undamaged(fit: Match) -> float:
    return fit.likeness * (1.0 - fit.damaged_fraction)
