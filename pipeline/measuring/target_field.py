"""The single targets of a project: where they are in space, how they should look, and how they are found and fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.projection import ImageModel
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.block_search import Candidate
from measure.targets.crosses import CrossSearch, cross_candidates
from measure.targets.disk_detection import DiskSearch, disk_candidates
from measure.targets.measure_targets import TargetOptions, TargetPrediction, measure_crosses, measure_disks
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring.perspective_disks import disk_images, disk_normals, plane_normal
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]

LEAST_DIAMETER_PX = 2.5  # of a target in the scan: of a smaller one, size and blur cannot be told apart


@dataclass(frozen=True)
class Field:
    """The targets that a prediction can name: ids, coordinates (n, 3) and their standard deviations (n, 3), inf where
    they are free; normals by id, the radius of the disks or half the length of the crosses."""

    ids: tuple[str, ...]
    xyz: Array
    sigmas: Array
    normals: Mapping[str, Array]
    radius: float

    def of(self, rows: Sequence[int]) -> "Field":
        """Some of them."""
        return replace(self, ids=tuple(self.ids[row] for row in rows), xyz=self.xyz[rows], sigmas=self.sigmas[rows])

    def predictions(self, model: ImageModel, scan: MeasuredScan, search_px: float) -> tuple[TargetPrediction, ...]:
        """Where and how every target before the camera should be seen; crosses upright, their arms along the horizontal
        and at right angles to it."""
        normals, _ = disk_normals(self.ids, self.xyz, self.normals, plane_normal(self.xyz), model.station)
        centers, maps, perspective, visible = disk_images(model, scan.pitch_um, self.xyz, normals, self.radius)
        return tuple(
            TargetPrediction(self.ids[i], centers[i], maps[i], search_px, perspective[i])
            for i in np.flatnonzero(visible)
        )  # fmt: skip


def target_field(project: Project) -> Field:
    """The targets whose coordinates are known at least roughly."""
    places = {id: (point.X, point.Y, point.Z) for id, point in project.object_points.items()}
    known = {id: [prior for prior in priors if prior is not None] for id, priors in places.items()}
    complete = {id: priors for id, priors in known.items() if len(priors) == 3}
    xyz, sigmas = (
        np.array([[getattr(prior, what) for prior in priors] for priors in complete.values()], float).reshape(-1, 3)
        for what in ("value", "sigma")
    )
    normals = dict(project.given_points.normals) if project.given_points else {}
    return Field(tuple(complete), xyz, sigmas, normals, project.target_radius)


def target_candidates(scan: Scan, settings: TargetSettings, diameters_px: tuple[float, float]) -> list[Candidate]:
    """What looks like the targets anywhere in the scan, the strongest first."""
    smallest = max(diameters_px[0], LEAST_DIAMETER_PX)
    sizes = (smallest, max(diameters_px[1], smallest))
    if settings.cross_line is None:
        return disk_candidates(scan, DiskSearch(sizes, settings.polarity))
    return cross_candidates(
        scan, CrossSearch((sizes[0] / 2.0, sizes[1] / 2.0), settings.cross_line, settings.polarity)
    )  # fmt: skip


def measure_single_targets(
    scan: Scan, predictions: Sequence[TargetPrediction], settings: TargetSettings
) -> tuple[MarkMeasurement, ...]:
    """A mark for each prediction, fitted as the kind of target it is."""
    options = TargetOptions(settings.polarity)
    if settings.cross_line is None:
        return measure_disks(scan, predictions, options)
    return measure_crosses(scan, predictions, settings.cross_line, options)
