"""Single targets of a project: coordinates, identification among the candidates of a scan, prediction of their images,
and checks of their measured places."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from scipy.spatial import cKDTree

from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_vector
from adjust.functional_model.transformation import Film
from adjust.target_identification.naming import name_marks
from measure.flags import TARGET_ELSEWHERE, TARGET_OFF_PLACE, Code, Reason, Status
from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from measure.targets.block_search import TargetCandidate
from measure.targets.consistency import TargetPlaces, compare_targets
from measure.targets.detection import CrossSearch, DiskSearch, cross_candidates, disk_candidates
from measure.targets.identification import TargetOptions, TargetPrediction, measure_crosses, measure_disks
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array, Indices, Mask

_ANGLES = np.arange(8) * np.pi / 4.0
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)  # enough to sample the lens distortion within a target
_FLAT = 1e-6  # fraction of the field's size: points this close to a plane lie on a board
LEAST_DIAMETER_PX = 2.5  # of a target in the scan: for a smaller one, size and blur are not separable
_TURN_RAD, _SHIFT = 0.1, 0.1  # standard deviations of an orientation, the shift as a fraction of the distance
_STEP = 1e-3  # fraction of these, for numerical derivatives
_SCALE, _LEAST_TURN_RAD = 0.15, 0.15  # tolerances of a predicted pattern: relative change of scale, rotation
_DISTORTION = 0.03  # residuals after these, due to tilt and relief, as a fraction of the pattern's size
_AS_GOOD = 0.95  # of the most targets: of such placements of a regular grid, the nearest to the prediction is taken
_NEAREST = 0.35  # fraction of them that an affine transformation leaves
_STEPS = 7  # scales and rotations tried within the tolerances
_SIGMA_PX = 0.5  # px, of a candidate, including locally varying effects of eccentricity and lens
_FOUND_WITHIN_PX = 2.0  # px, largest shift of the fit from the candidate
_STRAYS = 1.5  # candidates per target, the strongest: dust and texture are weaker than painted targets
_NEIGHBOURS = 4  # identified targets next to a missed one, from which its offset is estimated


def eccentricity_mm(model: ImageModel, centers: Array, normals: Array, radius: float) -> Array:
    """Eccentricity of disks: centre of each disk's image less the image of its centre, in the comparator, (n, 2) mm.

    Parameters
    ----------
    centers : (n, 3) in object units.
    normals : (n, 3) of unit length.
    radius : in object units.

    Notes
    -----
    With c the centre and n the normal in the camera frame, z forward, the centre of the perspective ellipse is off by
    `f r² [n_xy n_z + (c_xy / c_z) (1 - n_z²)] / (c_z² - r² (1 - n_z²))`: the pole of the disk's plane section, from the
    dual conic of its circle. The lens distorts this ellipse. A fitted ellipse gives its centre of gravity, which is
    computed from the outline after distortion and film deformation.
    """
    model, centers = model.reduced_to(centers)
    forward = np.array([1.0, 1.0, -1.0])
    c = ((centers - model.station) @ model.rotation.T) * forward
    n = (normals @ model.rotation.T) * forward
    tilt = 1.0 - n[:, 2] ** 2
    reach = c[:, 2] ** 2 - radius**2 * tilt
    off_axis = n[:, :2] * n[:, 2:] + c[:, :2] / c[:, 2:] * tilt[:, None]
    middle = c[:, :2] / c[:, 2:] + radius**2 * off_axis / reach[:, None]
    axes = np.stack([radius * (v[:, :2] - c[:, :2] / c[:, 2:] * v[:, 2:]) / c[:, 2:] for v in across(n)], axis=-1)

    def imaged(places: Array) -> Array:
        rays = np.column_stack([places, np.ones(len(places))]) * c[:, 2:]
        image, _ = model.comparator_from_object((rays * forward) @ model.rotation + model.station)
        return image

    outline = np.stack([imaged(middle + axes @ u) for u in _CIRCLE], axis=1)
    return _centre_of_gravity(outline) - imaged(c[:, :2] / c[:, 2:])


def _centre_of_gravity(outline: Array) -> Array:
    """(n, 2) centres of gravity of the areas within outlines (n, k, 2) that are nearly affine images of _CIRCLE.

    In the affine frame, a displacement of the unit circle moves its centre of gravity by twice the mean of its radial
    component times the radius vector.
    """
    mean = outline.mean(axis=1)
    linear = 2.0 * np.einsum("nki,kj->nij", outline - mean[:, None], _CIRCLE) / len(_CIRCLE)
    flat = np.einsum("nij,nkj->nki", np.linalg.inv(linear), outline - mean[:, None])
    outward = np.einsum("nki,ki->nk", flat, _CIRCLE) - 1.0
    shift = 2.0 * np.einsum("nk,ki->ni", outward, _CIRCLE) / len(_CIRCLE)
    return np.asarray(mean + np.einsum("nij,nj->ni", linear, shift))


def disk_images(
    model: ImageModel, pitch_um: tuple[float, float], centers: Array, normals: Array, radius: float
) -> tuple[Array, Array, Array, Mask]:
    """Predict the images of disks.

    Returns
    -------
    Centres (n, 2) px; maps (n, 2, 2) from each disk's two radius vectors to pixels; perspective (n, 2) per px, the
    relative change of scale across the disk; mask of the visible disks.
    """
    first, second = across(normals)
    place, visible = model.comparator_from_object(centers)
    columns = []
    for direction in (first, second):
        ahead, visible_ahead = model.comparator_from_object(centers + radius * direction)
        behind, visible_behind = model.comparator_from_object(centers - radius * direction)
        columns.append(pixel_from_comparator((ahead - behind) / 2.0, pitch_um))
        visible = visible & visible_ahead & visible_behind
    maps = np.stack(columns, axis=-1)
    depth = (model.station - centers) @ model.rotation[2]
    deeper = -np.stack([first, second], axis=1) @ model.rotation[2] * radius / depth[:, None]
    perspective = np.einsum("ni,nij->nj", deeper, np.linalg.inv(maps))
    return pixel_from_comparator(place, pitch_um), maps, perspective, visible


def disk_normals(
    ids: Sequence[str], coordinates: Array, given: Mapping[str, Array], plane: Array | None, station: Array
) -> tuple[Array, Mask]:
    """Unit normals (n, 3) of disks at coordinates (n, 3), and a mask of the known ones.

    Given normals are known, and those of a flat field: the normal of its plane. Other disks are assumed to face the
    station.
    """
    towards = station - coordinates
    normals = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    if plane is not None:
        normals = np.where((towards @ plane)[:, None] < 0.0, -plane, plane)
    known = np.array([plane is not None or id in given for id in ids], dtype=bool)
    for i, id in enumerate(ids):
        if id in given:
            normals[i] = given[id]
    return normals, known


def plane_normal(coordinates: Array) -> Array | None:
    """Normal of the plane that contains all points (n, 3); None where they are not coplanar or fewer than four."""
    if len(coordinates) < 4:
        return None
    spread = np.linalg.svd(coordinates - coordinates.mean(axis=0), full_matrices=False)
    flat = spread.S[2] <= _FLAT * spread.S[0] < spread.S[1]
    return np.asarray(spread.Vh[2], dtype=np.float64) if flat else None


def across(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors perpendicular to each of the unit vectors (n, 3) and to each other."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


@dataclass(frozen=True)
class TargetField:
    """Targets that can be predicted.

    Attributes
    ----------
    xyz : (n, 3) coordinates.
    sigmas : (n, 3) their standard deviations, inf where they are free.
    normals : by id.
    radius : of the disks, or half the length of the crosses.
    """

    ids: tuple[str, ...]
    xyz: Array
    sigmas: Array
    normals: Mapping[str, Array]
    radius: float

    def select(self, rows: Sequence[int]) -> "TargetField":
        """A subset of the targets."""
        return replace(self, ids=tuple(self.ids[row] for row in rows), xyz=self.xyz[rows], sigmas=self.sigmas[rows])

    def predictions(self, model: ImageModel, scan: MeasuredScan, search_px: float) -> tuple[TargetPrediction, ...]:
        """Predict the image of every target in front of the camera. Crosses are upright, with one arm horizontal."""
        normals, _ = disk_normals(self.ids, self.xyz, self.normals, plane_normal(self.xyz), model.station)
        centers, maps, perspective, visible = disk_images(model, scan.pitch_um, self.xyz, normals, self.radius)
        return tuple(
            TargetPrediction(self.ids[i], centers[i], maps[i], search_px, perspective[i])
            for i in np.flatnonzero(visible)
        )


def absent_targets(ids: Sequence[str], text: str, code: Code = Code.UNNAMED) -> tuple[MarkMeasurement, ...]:
    """Marks of targets that are not in a scan. text, code: why."""
    reason = Reason(text, code)
    return tuple(MarkMeasurement(id, "target", None, None, Status.ABSENT, reason) for id in ids)


def target_field(project: Project) -> TargetField:
    """Field of the targets whose coordinates are known, at least approximately."""
    places = {id: (point.X, point.Y, point.Z) for id, point in project.object_points.items()}
    known = {id: [prior for prior in priors if prior is not None] for id, priors in places.items()}
    complete = {id: priors for id, priors in known.items() if len(priors) == 3}
    xyz, sigmas = (
        np.array([[getattr(prior, what) for prior in priors] for priors in complete.values()], float).reshape(-1, 3)
        for what in ("value", "sigma")
    )
    normals = dict(project.given_points.normals) if project.given_points else {}
    return TargetField(tuple(complete), xyz, sigmas, normals, project.target_radius)


def check_spacing(project: Project, field: TargetField) -> None:
    """Raise InputError where most targets would cover one another."""
    if len(field.xyz) < 2:
        return
    nearest = cKDTree(field.xyz).query(field.xyz, k=[2])[0]
    spacing, diameter = float(np.quantile(nearest, 0.9)), 2.0 * field.radius
    if diameter > spacing:  # probably the unit of the coordinates is wrong
        raise InputError(
            f"{project.path}: [targets] of {diameter * project.unit_mm:g} mm would cover one another: nine of ten "
            f"points of [object] lie within {spacing * project.unit_mm:.3g} mm of the next one if their coordinates "
            f'are in {project.unit}. Give the unit that they are in, as [object] unit = "m".'
        )


def target_candidates(scan: Scan, settings: TargetSettings, diameters_px: tuple[float, float]) -> list[TargetCandidate]:
    """Candidates for the targets in the whole scan, the strongest first."""
    smallest = max(diameters_px[0], LEAST_DIAMETER_PX)
    sizes = (smallest, max(diameters_px[1], smallest))
    if settings.cross_line is None:
        return disk_candidates(scan, DiskSearch(sizes, settings.polarity))
    return cross_candidates(scan, CrossSearch((sizes[0] / 2.0, sizes[1] / 2.0), settings.cross_line, settings.polarity))


def measure_single_targets(
    scan: Scan, predictions: Sequence[TargetPrediction], settings: TargetSettings
) -> tuple[MarkMeasurement, ...]:
    """Measure each predicted target by the fit for its kind. Returns a mark for each."""
    options = TargetOptions(settings.polarity)
    if settings.cross_line is None:
        return measure_disks(scan, predictions, options)
    return measure_crosses(scan, predictions, settings.cross_line, options)


def checked_places(
    marks: Sequence[MarkMeasurement], field: TargetField, model: ImageModel, scan: MeasuredScan
) -> tuple[MarkMeasurement, ...]:
    """Compare the measured places with one another: improbable marks become weak, or are rejected.

    model: the image, with an orientation known to some degrees.
    """
    observed = {mark.point: mark for mark in marks if mark.status.is_observation}
    places_px = np.array([mark.center_px for mark in observed.values()]).reshape(-1, 2)
    covariances = np.array([mark.covariance_px2 for mark in observed.values()]).reshape(-1, 2, 2)
    if len(observed) < 2:
        return tuple(marks)
    row = {id: i for i, id in enumerate(field.ids)}
    targets = target_places(field.select([row[id] for id in observed]), model, scan)
    comparison = compare_targets(targets, places_px, covariances, (scan.width_px, scan.height_px))
    far = np.linalg.norm(comparison.off_px, axis=1)
    verdicts = dict(zip(observed, zip(far.tolist(), comparison.p_values.tolist(), strict=True), strict=True))
    checked = []
    for mark in marks:
        off_px, p_value = verdicts.get(mark.point, (0.0, 1.0))
        if p_value > TARGET_OFF_PLACE:
            checked.append(mark)
            continue
        how = f"it lies {off_px:.2f} px from where the other targets put it"
        if p_value < TARGET_ELSEWHERE:
            wrong = Reason(f"another mark, or the point's coordinates are wrong: {how}", Code.OFF_PLACE)
            checked.append(replace(mark, status=Status.REJECTED, reason=wrong))
        else:
            reason = Reason(f"{how}, as one of {1.0 / p_value:.0f} right ones does", Code.OFF_PLACE)
            checked.append(replace(mark, status=Status.WEAK, reason=Reason.combine((mark.reason, reason))))
    return tuple(checked)


def target_places(field: TargetField, model: ImageModel, scan: MeasuredScan) -> TargetPlaces:
    """Predicted places of a field's points, with their derivatives with respect to the orientation and their
    covariances from the coordinates."""

    def places(image: ImageModel, xyz: Array) -> Array:
        comparator, _ = image.comparator_from_object(xyz)
        return pixel_from_comparator(comparator, scan.pitch_um)

    distance = float(np.median(np.linalg.norm(field.xyz - model.station, axis=1)))
    ahead = places(model, field.xyz)
    by_orientation = []
    for axis in np.eye(3):
        turned = replace(model, rotation=rotation_from_vector(_STEP * _TURN_RAD * axis) @ model.rotation)
        shifted = replace(model, station=model.station + _STEP * _SHIFT * distance * axis)
        by_orientation += [(places(moved, field.xyz) - ahead) / _STEP for moved in (turned, shifted)]
    step = _STEP * distance
    by_point = np.stack([(places(model, field.xyz + step * axis) - ahead) / step for axis in np.eye(3)], axis=-1)
    is_free = np.asarray(~np.isfinite(field.sigmas).all(axis=1))
    moved = by_point * np.where(is_free[:, None], 0.0, field.sigmas)[:, None]
    return TargetPlaces(ahead, np.stack(by_orientation, axis=-1), moved @ moved.swapaxes(1, 2), is_free)


def recognise(predicted_px: Array, found_px: Array, shift_px: float) -> dict[int, int]:
    """Lay a predicted pattern (n, 2) on candidates (m, 2), most places on candidates, false alarm or not.

    The pattern is scaled and turned in steps; the shifts from its places to candidates vote. Of the shifts with about
    the most votes, the smallest is refined to an affine transformation.

    Returns
    -------
    Target (index) by candidate (index); empty where there are fewer than three of either, or no placement is within the
    tolerances. shift_px: largest shift of the pattern.
    """
    if min(len(predicted_px), len(found_px)) < 3:
        return {}
    middle, gate_px = predicted_px.mean(axis=0), _DISTORTION * float(np.linalg.norm(np.ptp(predicted_px, axis=0)))
    edges = np.arange(-shift_px - gate_px, shift_px + 2.0 * gate_px, gate_px / 2.0)
    placements, votes = list[Array](), list[float]()
    for scale, turn in product(
        np.linspace(-_SCALE, _SCALE, _STEPS), np.linspace(-_LEAST_TURN_RAD, _LEAST_TURN_RAD, _STEPS)
    ):
        cosine, sine = (1.0 + scale) * np.cos(turn), (1.0 + scale) * np.sin(turn)
        places = (predicted_px - middle) @ np.array([[cosine, sine], [-sine, cosine]]) + middle
        shifts = (found_px[None] - places[:, None]).reshape(-1, 2)
        counts = cv2.blur(
            np.histogram2d(shifts[:, 0], shifts[:, 1], bins=[edges, edges])[0], (3, 3), borderType=cv2.BORDER_CONSTANT
        )
        for column, row in np.argwhere(counts >= _AS_GOOD * counts.max()):
            shift = np.array([edges[column], edges[row]]) + gate_px / 4.0
            if np.hypot(*shift) <= shift_px:
                placements.append(places + shift)
                votes.append(float(counts[column, row]))
    if not placements:
        return {}
    as_good = np.array(placements)[np.array(votes) >= _AS_GOOD * max(votes)]
    off_px = np.median(np.linalg.norm(as_good - predicted_px, axis=2), axis=1)
    places, tree = as_good[off_px.argmin()], cKDTree(found_px)
    design = np.column_stack([predicted_px, np.ones(len(predicted_px))])
    for share in (1.0, 0.7, 0.5, _NEAREST, _NEAREST):
        hit, nearest = _hits(places, tree, share * gate_px)
        if hit.sum() < 4:
            break
        places = design @ np.linalg.lstsq(design[hit], found_px[nearest[hit]], rcond=None)[0]
    hit, nearest = _hits(places, tree, _NEAREST * gate_px)
    return dict(zip(nearest[hit].tolist(), np.flatnonzero(hit).tolist(), strict=True))


def _hits(places: Array, tree: cKDTree, gate_px: float) -> tuple[Mask, Indices]:
    """Mask of the targets with a candidate within the gate, each candidate once; index of the nearest candidate."""
    distances, nearest = (np.ravel(each) for each in tree.query(places))
    order = np.argsort(distances, kind="stable")
    once = np.zeros(len(places), dtype=bool)
    once[order[np.unique(nearest[order], return_index=True)[1]]] = True
    return once & (distances <= gate_px), nearest


@dataclass(frozen=True, eq=False)
class NamedField:
    """Oriented image with identified targets.

    candidates: the identified candidates, by point; gate_px: largest distance of a target from its place by the model.
    """

    model: ImageModel
    candidates: Mapping[str, TargetCandidate]
    gate_px: float

    def predictions(self, field: TargetField, measured: MeasuredScan) -> tuple[TargetPrediction, ...]:
        """Predict the targets: identified ones at their candidates, others at the model's place plus the median offset
        of the neighbours."""
        predicted = field.predictions(self.model, measured, self.gate_px)
        named = [one for one in predicted if one.point in self.candidates]
        off = np.array([self.candidates[one.point].center_px - one.center_px for one in named])
        tree = cKDTree([one.center_px for one in named])
        near = np.arange(1, min(_NEIGHBOURS, len(named)) + 1)
        return tuple(
            replace(one, center_px=one.center_px + np.median(off[tree.query(one.center_px, k=near)[1]], axis=0))
            if (found := self.candidates.get(one.point)) is None
            else replace(
                one, center_px=found.center_px, pixel_from_disk=found.pixel_from_disk, search_px=_FOUND_WITHIN_PX
            )
            for one in predicted
        )


def name_field(
    field: TargetField,
    model: ImageModel,
    camera: CameraFile,
    measured: MeasuredScan,
    candidates: Sequence[TargetCandidate],
    codes: Mapping[int, int] | None = None,
) -> NamedField | str:
    """Identify the candidates, which are sorted by strength.

    Parameters
    ----------
    model : camera and film of the image. Its exterior orientation is not used, nor its principal distance where the
        camera file gives none.
    codes : point, by index, of some candidates, by index, from their codes or an approximate orientation; some may be
        wrong.

    Returns
    -------
    The oriented image, or the reason of the failure.
    """
    places = np.array([one.center_px for one in candidates]).reshape(-1, 2)
    # mm, relative to the principal point, corrected for the known distortion
    camera_mm = model.camera_from_comparator(comparator_from_pixel(places, measured.pitch_um))
    observed, is_found = model.lens.ideal_from_observed(camera_mm)
    ideal = np.where(is_found[:, None], observed, camera_mm) - model.lens.interior[1:]
    frame = frame_mm(camera, model, measured) - model.lens.interior[1:]
    inside = np.flatnonzero(((ideal >= frame[0]) & (ideal <= frame[1])).all(axis=1))
    strongest = inside if codes else inside[: int(_STRAYS * len(field.ids)) + 1]
    normals = np.array([field.normals.get(id, np.full(3, np.nan)) for id in field.ids]).reshape(-1, 3)
    c, pitch_mm = camera.principal_distance_mm, min(measured.pitch_um) / 1000.0
    known = field.xyz, normals, ideal[strongest], (frame[0], frame[1]), c, _SIGMA_PX * pitch_mm
    row = {int(candidate): mark for mark, candidate in enumerate(strongest)}
    names = name_marks(*known, {row[one]: point for one, point in codes.items() if one in row} if codes else None)
    if isinstance(names, str):
        return names
    lens = replace(model.lens, interior=np.array([names.principal_distance_mm, *model.lens.interior[1:]]))
    oriented = replace(model, lens=lens, rotation=names.pose.rotation, station=names.pose.center)
    by_id = {field.ids[point]: candidates[strongest[mark]] for point, mark in names.mark.items()}
    return NamedField(oriented, by_id, max(names.gate_mm / pitch_mm, _FOUND_WITHIN_PX))


def camera_model(camera: CameraFile, measured: MeasuredScan) -> ImageModel | str:
    """Image model with the exterior orientation left open, or the reason why there is none.

    Where the camera file gives no principal distance, the scan's diagonal serves as a rough value.
    """
    if not camera.fiducials:
        film = Film("none", np.zeros(0), np.zeros(2))
    elif measured.frame.pixel_from_camera is None:
        return "too few fiducials were measured to know where the camera's frame lies in the scan"
    else:
        places = np.linalg.inv(np.vstack([measured.frame.pixel_from_camera, [0.0, 0.0, 1.0]]))[:2]
        linear = places[:, :2] @ np.diag(pixel_from_comparator(np.ones(2), measured.pitch_um))
        film = Film("affine", np.array([places[0, 2], *linear[0], places[1, 2], *linear[1]]), np.zeros(2))
    middle = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]) / 2.0, measured.pitch_um)
    c = camera.principal_distance_mm or 2.0 * float(np.linalg.norm(middle))
    x0, y0 = middle if camera.principal_point_mm is None else camera.principal_point_mm
    lens = Lens(camera.distortion, np.array([c, x0, y0], dtype=np.float64), camera.distortion.values)
    return ImageModel(lens, np.eye(3), np.zeros(3), film)


def frame_mm(camera: CameraFile, model: ImageModel, measured: MeasuredScan) -> Array:
    """(2, 2) mm, smallest and largest camera coordinates of the exposed frame within the scan."""
    last = np.array([measured.width_px - 1, measured.height_px - 1])
    corners = comparator_from_pixel(np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * last, measured.pitch_um)
    shown_mm = model.camera_from_comparator(corners)
    if camera.fiducials and camera.frame_mm is not None:
        half = np.array(camera.frame_mm) / 2.0
        shown_mm = np.clip(shown_mm, -half, half)
    return np.stack([shown_mm.min(axis=0), shown_mm.max(axis=0)])
