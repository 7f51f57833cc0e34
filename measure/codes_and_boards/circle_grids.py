"""Grids of dots: the disks of the frame put in the grid's order, missing ones looked for where they should be."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.board_specs import CircleGridSpec
from measure.codes_and_boards.lattices import Place, grid_places, is_whole, other_grids, upright
from measure.reason import NO_REASON, Code, Reason
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.status import Status
from measure.targets.block_search import Candidate
from measure.targets.disk_detection import DiskSearch, disk_candidates
from measure.targets.disks import FittedDisk, fit_disk

Array = NDArray[np.float64]

_SMALLEST_DOT_PX = 5.0  # its diameter
_NEAREST_DOTS = 8  # whose places and shapes predict a missing one's


@dataclass(frozen=True)
class CircleGridMeasurement:
    """A grid in a scan: one mark for each of its dots; reason: why it was not found; notes: what the user should know;
    others_px: the middles of further grids that look the same."""

    marks: tuple[MarkMeasurement, ...]
    reason: Reason = NO_REASON
    notes: tuple[str, ...] = ()
    others_px: tuple[Array, ...] = ()


def measure_circle_grid(scan: Scan, spec: CircleGridSpec) -> CircleGridMeasurement:
    """Measure the dots of a grid, and say where else the scan shows one. A grid that is not there is no error."""
    names = {place: f"r{place[0]}c{place[1]}" for place in spec.places()}
    patches = disk_candidates(scan, DiskSearch((_SMALLEST_DOT_PX, _largest_dot_px(scan, spec))))
    centers = np.array([patch.center_px for patch in patches]).reshape(-1, 2)
    looks = _looks(patches)
    assignments = grid_places(centers, looks, spec.places())
    if not is_whole(assignments):
        told = f"no grid of {spec.columns} x {spec.rows} dots is wholly seen; {len(patches)} spots look like dots"
        if assignments:
            told = f"a grid of more than {spec.columns} x {spec.rows} dots is seen, or one with a line of it hidden"
        reason = Reason(told, Code.NO_BOARD)
        absent = (MarkMeasurement(name, "target", None, None, Status.ABSENT, reason) for name in names.values())
        return CircleGridMeasurement(tuple(absent), reason)
    assignment = max(assignments, key=lambda found: upright(found, centers))
    notes = (
        ("the grid looks the same when turned: it was taken as upright in the scan",) if len(assignments) > 1 else ()
    )
    seen = {place: (patches[index].center_px, patches[index].pixel_from_disk) for place, index in assignment.items()}
    gap = 1 - spec.diameter_mm / spec.shortest_distance_mm
    marks = []
    for place, name in names.items():
        center, shape = seen[place] if place in seen else _predicted(place, seen)
        margin = gap / (1 - gap) * 2 * float(np.linalg.svd(shape, compute_uv=False)[1])
        marks.append(_as_mark(name, fit_disk(scan, center, shape, longest_margin_px=margin), place in seen))
    others = other_grids(centers, looks, assignment, spec.places())
    return CircleGridMeasurement(tuple(marks), NO_REASON, notes, others)


def _looks(patches: list[Candidate]) -> Array:
    """(n, 3) logarithms of size and contrast, and which of both, light or dark."""
    return np.array(
        [(np.log(patch.radius_px), np.log(abs(patch.contrast_dn)), np.sign(patch.contrast_dn)) for patch in patches]
    )


def _largest_dot_px(scan: Scan, spec: CircleGridSpec) -> float:
    """The largest that a dot can be when the grid fills the scan."""
    places = min(spec.columns, spec.rows)
    share = spec.diameter_mm / spec.spacing_mm
    return max(2 * _SMALLEST_DOT_PX, share * max(scan.width_px, scan.height_px) / places)


def _predicted(place: Place, seen: dict[Place, tuple[Array, Array]]) -> tuple[Array, Array]:
    """Centre and shape of a dot by a homography of its nearest neighbours; the shape is their mean one."""
    others = sorted(seen, key=lambda other: np.hypot(other[0] - place[0], other[1] - place[1]))
    nearest = others[: max(_NEAREST_DOTS, len(others) // 3)]
    homography, _ = cv2.findHomography(np.array(nearest, float), np.array([seen[other][0] for other in nearest]))
    x, y, w = np.asarray(homography, float) @ (*place, 1.0)
    squares = [seen[other][1] @ seen[other][1].T for other in nearest[:_NEAREST_DOTS]]
    return np.array([x / w, y / w]), np.linalg.cholesky(np.mean(squares, axis=0))


def _as_mark(name: str, disk: FittedDisk, was_seen: bool) -> MarkMeasurement:
    """The row of a dot."""
    if disk.reason:
        status = Status.REJECTED if was_seen else Status.PREDICTED
        reason = disk.reason.told(f"not fitted: {disk.reason}")
        return MarkMeasurement(name, "target", disk.center_px, None, status, reason)
    weakness = disk.weakness or disk.lone_doubt
    status = Status.WEAK if weakness else Status.MEASURED
    return MarkMeasurement(name, "target", disk.center_px, disk.covariance, status, weakness, disk.quality)
