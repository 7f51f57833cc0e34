"""Identification of targets among the candidates of a scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from scipy.spatial import cKDTree

from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.transformation import Film
from adjust.target_identification.naming import name_marks
from measure.targets.block_search import TargetCandidate
from measure.targets.identification import TargetPrediction
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.target_field import TargetField
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array, Indices, Mask

_SCALE, _TURN_RAD = 0.15, 0.15  # tolerances of a predicted pattern: relative change of scale, rotation
_DISTORTION = 0.03  # residuals after these, due to tilt and relief, as a fraction of the pattern's size
_AS_GOOD = 0.95  # of the most targets: of such placements of a regular grid, the nearest to the prediction is taken
_NEAREST = 0.35  # fraction of them that an affine transformation leaves
_STEPS = 7  # scales and rotations tried within the tolerances
_SIGMA_PX = 0.5  # px, of a candidate, including locally varying effects of eccentricity and lens
_FOUND_WITHIN_PX = 2.0  # px, largest shift of the fit from the candidate
_STRAYS = 1.5  # candidates per target, the strongest: dust and texture are weaker than painted targets
_NEIGHBOURS = 4  # identified targets next to a missed one, from which its offset is estimated


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
    for scale, turn in product(np.linspace(-_SCALE, _SCALE, _STEPS), np.linspace(-_TURN_RAD, _TURN_RAD, _STEPS)):
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
