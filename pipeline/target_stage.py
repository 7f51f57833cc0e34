"""The targets of one scan: boards name their own points; single disks and crosses get their names by prediction."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.families import parameter_names
from adjust.network import Exterior
from adjust.projection import ImageModel
from adjust.resection import resect
from adjust.rotation import rotation_from_angles
from adjust.transformation import Film
from measure.boards import measure_board
from measure.disk_search import DiskSearch, disk_candidates
from measure.results import MarkMeasurement
from measure.scan import Scan
from measure.shapes import Polarity
from measure.status import Status
from measure.targets import TargetOptions, TargetPrediction, measure_disks
from pipeline.camera_file import CameraFile
from pipeline.coded_sheet import CodedSheet, measure_sheet
from pipeline.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.disks import disk_images, disk_normals, plane_normal
from pipeline.identification import PatternOptions, assign, recognise
from pipeline.measurement_file import MeasuredScan
from pipeline.network import given_points
from pipeline.project_file import Project

Array = NDArray[np.float64]

_SEED = 1  # of the resection's random triples: a result must not depend on the run
_GATE_SHARE = 0.01  # of the scan's size: what tilt and relief leave between the pattern laid on and its marks
_SLACK_PX = 3.0  # beyond what the resection's residuals say, within which a mark is the target predicted there
_SLACK_SIGMAS = 6.0
_LEAST_PAIRS = 4
_STRONGEST = 3  # patches a target, by contrast: dust and texture are weaker than what was painted to be seen
_NEAR = 0.65  # of the scan's size from its middle: targets there may be in it
_LEAST_DIAMETER_PX = 2.5
_SIZE_SLACK = 1.5  # how wrong the approximate distance may make a target's size


@dataclass(frozen=True)
class Field:
    """The targets that a prediction can name: ids, coordinates (n, 3), normals by id, the radius of the disks."""

    ids: tuple[str, ...]
    xyz: Array
    normals: dict[str, Array]
    radius: float

    def predictions(self, model: ImageModel, scan: MeasuredScan, search_px: float) -> tuple[TargetPrediction, ...]:
        """Where and how every target before the camera should be seen."""
        normals, _ = disk_normals(self.ids, self.xyz, self.normals, plane_normal(self.xyz), model.station)
        centers, maps, visible = disk_images(model, scan.pitch_um, self.xyz, normals, self.radius)
        return tuple(
            TargetPrediction(self.ids[i], centers[i], maps[i], search_px) for i in np.flatnonzero(visible)
        )  # fmt: skip


def measure_targets(project: Project, scan: Scan, measured: MeasuredScan) -> MeasuredScan:
    """The scan with its targets beside its fiducials: a mark for each target that could be in it."""
    settings = project.targets
    if settings is None:
        return measured
    if settings.code is not None:
        return with_targets(measured, *measure_sheet(scan, CodedSheet.of(project, settings)))
    if settings.board is not None:
        board = measure_board(scan, settings.board)
        problems = (f"The board was not found: {board.reason}.",) if board.reason else ()
        # A board that is the same after a half turn may be named either way, unless its points were surveyed singly.
        notes = tuple(f"{note}." for note in board.notes) if project.given_points else ()
        return with_targets(measured, board.marks, (*problems, *notes))
    field = target_field(project)
    model, why = approximate_model(project, measured)
    if model is not None:
        model, why = _oriented(model, field, scan, measured, settings.polarity)
    if model is None:
        marks = tuple(MarkMeasurement(id, "target", None, None, Status.ABSENT, why) for id in field.ids)
        return with_targets(measured, marks, (f"No target has a name: {why}.",))
    return with_targets(
        measured, measure_disks(scan, field.predictions(model, measured, _SLACK_PX), TargetOptions(settings.polarity))
    )


def with_targets(
    measured: MeasuredScan, targets: Sequence[MarkMeasurement], problems: Sequence[str] = ()
) -> MeasuredScan:
    """The scan with these targets instead of the ones it has."""
    frame = measured.frame
    fiducials = tuple(mark for mark in frame.marks if mark.kind == "fiducial")
    return replace(
        measured, frame=replace(frame, marks=(*fiducials, *targets), problems=(*frame.problems, *problems))
    )  # fmt: skip


def target_field(project: Project) -> Field:
    """The targets whose coordinates are known at least roughly."""
    places = {id: (point.X, point.Y, point.Z) for id, point in given_points(project).items()}
    known = {id: [p.value for p in priors if p is not None] for id, priors in places.items()}
    complete = {id: xyz for id, xyz in known.items() if len(xyz) == 3}
    normals = dict(project.given_points.normals) if project.given_points else {}
    return Field(tuple(complete), np.array(list(complete.values())).reshape(-1, 3), normals, project.disk_radius)


def approximate_model(project: Project, measured: MeasuredScan) -> tuple[ImageModel | None, str]:
    """The image as the files and its fiducials say it is; or why that is not enough to predict anything."""
    image = measured.frame.image
    camera = project.camera_of(image)
    exterior = project.given_images.exterior.get(image) if project.given_images else None
    if exterior is None:
        return None, "the image has no approximate orientation in images.csv"
    if camera.principal_distance_mm is None:
        return None, f"{camera.path.name} gives no principal_distance_mm to predict the targets with"
    film = _camera_from_comparator(camera, measured)
    if film is None:
        return None, "too few fiducials were measured to know where the camera's frame lies in the scan"
    return _model(camera, exterior, film, measured), ""


def _camera_from_comparator(camera: CameraFile, measured: MeasuredScan) -> Film | None:
    """The film as the measurement of the fiducials took it to be; none for a camera that has none."""
    if not camera.fiducials:
        return Film("none", np.zeros(0), np.zeros(2))
    if measured.frame.pixel_from_camera is None:
        return None
    places = np.linalg.inv(np.vstack([measured.frame.pixel_from_camera, [0.0, 0.0, 1.0]]))[:2]
    linear = places[:, :2] @ np.diag(pixel_from_comparator(np.ones(2), measured.pitch_um))
    return Film("affine", np.array([places[0, 2], *linear[0], places[1, 2], *linear[1]]), np.zeros(2))


def _model(camera: CameraFile, exterior: Exterior, film: Film, measured: MeasuredScan) -> ImageModel:
    middle = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]) / 2.0, measured.pitch_um)
    x0, y0 = middle if camera.principal_point_mm is None else camera.principal_point_mm
    distortion = camera.distortion
    given = [distortion.parameters.get(name) for name in parameter_names(distortion.family)]
    return ImageModel(
        distortion,
        np.array([camera.principal_distance_mm, x0, y0], dtype=np.float64),
        np.array([0.0 if prior is None else prior.value for prior in given]),
        rotation_from_angles(exterior.values[3:]),
        exterior.center,
        film,
    )


def _search(predictions: Sequence[TargetPrediction], measured: MeasuredScan, polarity: Polarity) -> DiskSearch | None:
    """Disks of the sizes that the targets in or near the scan should have; None where none is large enough."""
    size = np.array([measured.width_px, measured.height_px])
    near = [p for p in predictions if np.all(np.abs(p.center_px - size / 2.0) < _NEAR * size)]
    axes = np.array([np.linalg.svd(p.pixel_from_disk, compute_uv=False) for p in near]).reshape(-1, 2)
    if not len(axes) or 2.0 * float(axes.max()) < _LEAST_DIAMETER_PX:
        return None
    smallest = max(2.0 * float(axes.min()) / _SIZE_SLACK, _LEAST_DIAMETER_PX)
    return DiskSearch((smallest, max(2.0 * float(axes.max()) * _SIZE_SLACK, smallest)), polarity)


def _oriented(
    model: ImageModel, field: Field, scan: Scan, measured: MeasuredScan, polarity: Polarity
) -> tuple[ImageModel | None, str]:
    """The image with an orientation good to a pixel or two, from the disks found and the pattern they make."""
    size = float(np.hypot(measured.width_px, measured.height_px))
    predictions = field.predictions(model, measured, _SLACK_PX)
    predicted = np.array([prediction.center_px for prediction in predictions]).reshape(-1, 2)
    search = _search(predictions, measured, polarity)
    if search is None:
        return None, "the approximate orientation puts no target of two pixels or more into the scan"
    strongest = disk_candidates(scan, search)[: _STRONGEST * len(predicted)]
    found = np.array([patch.center_px for patch in strongest]).reshape(-1, 2)
    placement = recognise(predicted, found, PatternOptions(shift_px=size / 2.0))
    if placement is None:
        return None, f"the {len(found)} disks found do not make the pattern of the {len(predicted)} targets predicted"
    gate_px = _GATE_SHARE * size
    places = predicted @ placement[:, :2].T + placement[:, 2]
    ids = [prediction.point for prediction in predictions]
    for _ in range(2):
        pairs = assign(places, found, gate_px)
        resection = _resected(model, field, [(ids[i], found[j]) for i, j in pairs], measured)
        if resection is None:
            return None, f"{len(pairs)} of the targets were recognised, but they do not orient the image"
        model, gate_px = resection
        predictions = field.predictions(model, measured, gate_px)
        places, ids = np.array([p.center_px for p in predictions]), [p.point for p in predictions]
    return model, ""


def _resected(
    model: ImageModel, field: Field, named: Sequence[tuple[str, Array]], measured: MeasuredScan
) -> tuple[ImageModel, float] | None:
    """The image oriented by named marks, and how far off they may lie from it, px."""
    if len(named) < _LEAST_PAIRS:
        return None
    row = {id: i for i, id in enumerate(field.ids)}
    xyz = field.xyz[[row[id] for id, _ in named]]
    comparator = comparator_from_pixel(np.array([place for _, place in named]), measured.pitch_um)
    ideal, _ = model.ideal_from_observed(model.camera_from_comparator(comparator))
    c = float(model.interior[0])
    resection = resect(xyz, ideal - model.interior[1:], c, np.random.default_rng(_SEED))
    if resection is None or resection.inliers.sum() < _LEAST_PAIRS:
        return None
    sigma_px = 1000.0 * resection.sigma_mm / min(measured.pitch_um)
    pose = resection.pose
    return replace(model, rotation=pose.rotation, station=pose.center), _SLACK_PX + _SLACK_SIGMAS * sigma_px
