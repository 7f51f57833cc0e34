"""The marks of one frame sighted at full resolution from its placement, and the frame fitted to those that agree."""

import numpy as np

from measure.fiducials.constellation import Placement
from measure.fiducials.faint_marks import faint_reach_px, look_for_faint
from measure.fiducials.frame import Frame
from measure.fiducials.frame_sighter import MANY, FrameSighter
from measure.fiducials.options import FiducialOptions
from measure.fiducials.refit import compare_shapes, compare_sizes, count_tone, settle, share_blur
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan

_ROUNDS = 2  # of looking for faint marks: the first ones tell where the others are


def measure_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Sight all marks from the placement, fit the frame to those that agree, look again for the others, and settle
    all of them by what the frame and the other marks say."""
    return _settled_frame(_sighted(scan, layout, placement, options))


def rename_frame(scan: Scan, layout: FiducialLayout, frame: Frame, pose: str, options: FiducialOptions) -> Frame:
    """Name the marks of a frame as in another pose: they are matched where they were found, and the others are looked
    for. The frame is kept as it is where fewer of its marks agree under those names."""
    placement = frame.fitted_placement.posed(pose, frame.camera_mm)
    found = np.array([fit.center_px for fit in frame.fits if fit])
    names = placement.names(found, frame.camera_mm).tolist() if len(found) else []
    sighter = FrameSighter(scan, layout, placement, options)
    sighter.weights = frame.weights
    sighter.match_at({name: place for name, place in zip(names, found, strict=True) if name >= 0})
    sighter.judge()
    sighter.look([index for index in range(len(layout.marks)) if not sighter.clear(index)], sighter.first_search_px)
    renamed = _settled_frame(_look_again(sighter))
    return renamed if renamed.belongs.sum() >= frame.belongs.sum() else frame


def _settled_frame(sighter: FrameSighter) -> Frame:
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
    sighter.look(range(len(layout.marks)), sighter.first_search_px)
    return _look_again(sighter)


def _look_again(sighter: FrameSighter) -> FrameSighter:
    """Look again at the marks that are not clear, where the others put them."""
    everything = range(len(sighter.layout.marks))
    sighter.judge()
    if sighter.frame().accepted:
        sighter.look_closer()
        sighter.judge()
    if sighter.belongs.sum() >= 2 and not sighter.sure():
        if len(everything) > MANY:
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
