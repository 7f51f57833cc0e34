"""Whether a frame that shows only some of its marks may be chance: how often places beside the marks look like marks.

A dot on a rough ground is like many a speck, a ring-cross like nothing else; no threshold holds for both. So the marks
are sought, in the same way, where they are not, and the share of those places that answer says what a mark found where
the frame puts it is worth.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from measure.constellation import sign_of
from measure.fiducial_options import FiducialOptions
from measure.frame import CLEAR_LIKENESS, REDUCED_PX, Frame
from measure.matching import Match
from measure.refinement import sight
from measure.scan import Scan
from measure.shapes import FiducialLayout

Array = NDArray[np.float64]

LIKELY = 0.1  # probability of chance above which a frame is doubted: one with its other marks hidden is to pass
PLACES = 32  # that are looked at beside the marks
BESIDE = 2.5  # search radii off: beyond what the mark itself answers
FREE = 2  # marks that a similarity goes through wherever they lie
SURE = 12  # marks that agree: no speck feigns so many


def doubt(scan: Scan, layout: FiducialLayout, frame: Frame, options: FiducialOptions) -> str:
    """A sentence where chance may have made the frame; empty where every mark was found, or chance is unlikely."""
    inside = [index for index, sighting in enumerate(frame.sightings) if sighting.inside]
    found = sum(_is_clear(fit) for fit in frame.fits)
    if found == len(inside) or frame.belongs.sum() >= SURE:
        return ""
    radius = REDUCED_PX * frame.placement.reduction + options.search_mm(layout) / float(
        np.mean(frame.placement.pitch_mm)
    )
    places = _beside(scan, frame, inside, BESIDE * radius)
    hits = 0
    for index, place in places:
        mark = layout.marks[index].mark
        start = np.column_stack([frame.pixel_from_camera[:, :2], place])
        polarity = sign_of(mark, frame.placement.polarity)
        hits += _is_clear(sight(scan, mark, start, radius, polarity, frame.weights, options.match).fit)
    share = (hits + 1) / (len(places) + 2)  # Laplace: none of thirty does not mean never
    chance = float(stats.binom.sf(found - FREE - 1, len(inside) - FREE, share))
    if chance <= LIKELY:
        return ""
    return (
        f"only {found} of {len(inside)} marks were clearly found, and {hits} of {len(places)} places beside them look "
        f"like marks, too: chance finds as many with a probability of {chance:.2f}, and the frame may lie elsewhere"
    )


def _is_clear(fit: Match | None) -> bool:
    return fit is not None and fit.likeness >= CLEAR_LIKENESS


def _beside(scan: Scan, frame: Frame, inside: Sequence[int], off_px: float) -> list[tuple[int, Array]]:
    """Places about the marks in the scan, in eight directions, each with the mark that is sought there."""
    angles = np.arange(8) * np.pi / 4
    ring = off_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    size = np.array([scan.width_px, scan.height_px])
    every = [
        (index, np.asarray(frame.pixel_from_camera @ (*frame.camera_mm[index], 1.0) + step))
        for step in ring
        for index in inside
    ]
    within = [(index, place) for index, place in every if np.all(place >= 0) and np.all(place < size)]
    step = max(1, len(within) // PLACES)
    return within[::step][:PLACES]
