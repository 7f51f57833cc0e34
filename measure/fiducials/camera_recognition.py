"""Response of a scan to the marks of a camera, as a criterion for recognising the camera.

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
from measure.fiducials.search import FrameSearch, PitchHypothesis
from measure.fiducials.stages import false_placements
from measure.flags import CAMERA_BY_NOISE, MAX_FALSE_CAMERAS
from measure.geometry import scan_px
from measure.marks.shapes import FiducialLayout
from measure.matching.models import MatchOptions
from measure.scans.scan import Scan

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
        frame = detect_frame(scan, layout, enlarged, _QUICK_OPTIONS)
        if frame.accepted:
            return frame
    return None


def likeness(frame: Frame) -> float:
    """Mean over all marks of the likeness times the undamaged fraction of the mark; a mark not found counts 0.

    Parts of another mark count as damage, such as a ring around a cross that is drawn without one.
    """
    scores = (fit.likeness * (1.0 - fit.damaged_fraction) for fit in frame.inlier_fits.values())
    return float(sum(scores) / len(frame.detections))
