"""The marks of one frame sighted at full resolution from its placement, and the frame fitted to those that agree."""

from measure.fiducial_options import FiducialOptions
from measure.frames.faint_sighting import faint_reach_px, look_for_faint
from measure.frames.frame import Frame
from measure.frames.frame_settling import compare_shapes, compare_sizes, count_tone, settle, share_blur
from measure.frames.frame_sighter import MANY, FrameSighter
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan
from measure.search.constellation import Placement

_ROUNDS = 2  # of looking for faint marks: the first ones tell where the others are


def measure_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Sight all marks from the placement, fit the frame to those that agree, look again for the others, and settle
    all of them by what the frame and the other marks say."""
    sighter = _sighted(scan, layout, placement, options)
    settle(sighter)
    share_blur(sighter)
    count_tone(sighter)
    compare_sizes(sighter)
    compare_shapes(sighter)
    return sighter.frame()


def look_at_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """The same before its marks are settled: which of them are there, and how they look."""
    return _sighted(scan, layout, placement, options).frame()


def _sighted(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> FrameSighter:
    sighter = FrameSighter(scan, layout, placement, options)
    sighter.choose_channels()
    everything = range(len(layout.marks))
    sighter.look(everything, sighter.first_search_px)
    sighter.judge()
    if sighter.frame().accepted:
        sighter.look_closer()
        sighter.judge()
    if sighter.belongs.sum() >= 2 and not sighter.sure():
        if len(layout.marks) > MANY:
            look_for_faint(sighter, sighter.faint_px)
            sighter.certain[:] = False  # so far from its place a mark still has to agree with the others
        else:
            sighter.look_elsewhere([index for index in everything if not sighter.clear(index)])
        sighter.judge()
    for _ in range(_ROUNDS):
        if sighter.sure():
            look_for_faint(sighter, faint_reach_px(sighter))
            sighter.judge()
    return sighter
