"""Identification of targets among the candidates of a scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.transformation import Film
from adjust.target_identification.naming import name_marks
from measure.targets.block_search import Candidate
from measure.targets.identification import TargetPrediction
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.target_field import Field
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array, Indices, Mask

ComplexArray = NDArray[np.complex128]  # places in the plane: x + iy

_SCALE, _TURN_RAD = 0.15, 0.15  # tolerances of a predicted pattern: relative change of scale, rotation
_DISTORTION = 0.03  # residuals after these, due to tilt and relief, as a fraction of the pattern's size
_AS_GOOD = 0.95  # of the most targets: of such placements of a regular grid, the nearest to the prediction is taken
_NEAREST = 0.35  # fraction of them that an affine transformation leaves
_PAIRS = 60  # distant pairs of targets that generate hypotheses on the placement
_TESTED, _REFINED = 400, 8  # hypotheses that are tested on all targets, and that are refined
_SIGMA_PX = 0.5  # px, of a candidate, including locally varying effects of eccentricity and lens
_FOUND_WITHIN_PX = 2.0  # px, largest shift of the fit from the candidate
_STRAYS = 1.5  # candidates per target, the strongest: dust and texture are weaker than painted targets
_NEIGHBOURS = 4  # identified targets next to a missed one, from which its offset is estimated
_SIZES = 4.0  # largest ratio of a target's size to that in an image filled by the whole field


_IN_THE_PICTURE = 0.4  # of the scan's size: largest offset of the principal point from its centre, if not cropped


def recognise(predicted_px: Array, found_px: Array, shift_px: float) -> dict[int, int]:
    """Lay a predicted pattern (n, 2) on candidates (m, 2), most places on candidates, false alarm or not.

    Similarities that map distant pairs of targets onto pairs of candidates are refined to affine transformations.

    Returns
    -------
    Target (index) by candidate (index); empty where there are fewer than three of either, or no placement is within the
    tolerances. shift_px: largest shift of the pattern.
    """
    if min(len(predicted_px), len(found_px)) < 3:
        return {}
    scales, shifts = _similarities(_complex(predicted_px), _complex(found_px), shift_px)
    if not len(scales):
        return {}
    tree, gate_px = cKDTree(found_px), _DISTORTION * float(np.linalg.norm(np.ptp(predicted_px, axis=0)))
    placements = _plane(scales[:, None] * _complex(predicted_px) + shifts[:, None])
    counts = np.array([_hits(places, tree, gate_px)[0].sum() for places in placements])
    order = np.lexsort((_off_px(placements, predicted_px), -np.minimum(counts, _AS_GOOD * counts.max())))
    refined = [_tightened(places, predicted_px, found_px, tree, gate_px) for places in placements[order[:_REFINED]]]
    scores = np.array([_score(places, tree, gate_px) for places in refined])
    as_good = np.array(refined)[scores >= _AS_GOOD * scores.max()]
    chosen = as_good[_off_px(as_good, predicted_px).argmin()]
    hit, _, nearest = _hits(chosen, tree, _NEAREST * gate_px)
    return dict(zip(nearest[hit].tolist(), np.flatnonzero(hit).tolist(), strict=True))


def _off_px(placements: Array, predicted_px: Array) -> Array:
    """(k,) median distances of placements (k, n, 2) from the predicted places."""
    return np.asarray(np.median(np.linalg.norm(placements - predicted_px, axis=2), axis=1))


def _similarities(predicted: ComplexArray, found: ComplexArray, shift_px: float) -> tuple[ComplexArray, ComplexArray]:
    """Scales (with rotation) and shifts that map a distant pair of targets onto a pair of candidates."""
    # Of many, those with the most similar ones, in terms of the places of the pattern's corners, are returned.
    first, second = _long_pairs(predicted)
    start, end = np.nonzero(~np.eye(len(found), dtype=bool))
    across, between = predicted[second] - predicted[first], found[end] - found[start]
    pairs = cKDTree(_plane(between))
    near = pairs.query_ball_point(_plane(across), np.abs(across) * np.hypot(_SCALE, _TURN_RAD))
    row, pair = np.repeat(np.arange(len(near)), list(map(len, near))), np.concatenate(near).astype(np.intp)
    scales = between[pair] / across[row]
    shifts = found[start[pair]] - scales * predicted[first[row]]
    allowed = np.abs(scales * predicted.mean() + shifts - predicted.mean()) <= shift_px
    scales, shifts = scales[allowed], shifts[allowed]
    if len(scales) > _TESTED:
        x, y = predicted.real, predicted.imag
        corners = np.array([x.min() + 1j * y.min(), x.max() + 1j * y.max()])
        places = _plane(scales[:, None] * corners + shifts[:, None]).reshape(-1, 4)
        tolerance = 0.02 * float(np.linalg.norm(np.ptp(_plane(found), axis=0)))
        votes = cKDTree(places).query_ball_point(places, tolerance, return_length=True)
        chosen = np.argsort(-votes, kind="stable")[:_TESTED]
        scales, shifts = scales[chosen], shifts[chosen]
    return scales, shifts


def _complex(places: Array) -> ComplexArray:
    return np.asarray(places[:, 0] + 1j * places[:, 1], dtype=np.complex128)


def _plane(points: ComplexArray) -> Array:
    """(..., 2) real and imaginary parts."""
    return np.stack([points.real, points.imag], axis=-1)


def _long_pairs(points: ComplexArray) -> tuple[Indices, Indices]:
    """The longest pairs, with a limited number per point."""
    first, second = np.triu_indices(len(points), 1)
    uses, chosen = np.zeros(len(points), dtype=int), list[int]()
    for k in np.argsort(-np.abs(points[second] - points[first]), kind="stable"):
        if uses[first[k]] < 6 and uses[second[k]] < 6 and len(chosen) < _PAIRS:
            uses[[first[k], second[k]]] += 1
            chosen.append(k)
    return first[chosen], second[chosen]


def _hits(places: Array, tree: cKDTree, gate_px: float) -> tuple[Mask, Array, Indices]:
    """Mask of the targets with a candidate within the gate, each candidate once; distance and index of the nearest."""
    distances, nearest = (np.ravel(each) for each in tree.query(places))
    order = np.argsort(distances, kind="stable")
    once = np.zeros(len(places), dtype=bool)
    once[order[np.unique(nearest[order], return_index=True)[1]]] = True
    return once & (distances <= gate_px), distances, nearest


def _tightened(places: Array, predicted: Array, found: Array, tree: cKDTree, gate_px: float) -> Array:
    """Places after affine fits with a decreasing gate."""
    design = np.column_stack([predicted, np.ones(len(predicted))])
    for share in (1.0, 0.7, 0.5, _NEAREST, _NEAREST):
        hit, _, nearest = _hits(places, tree, share * gate_px)
        if hit.sum() < 4:
            break
        places = design @ np.linalg.lstsq(design[hit], found[nearest[hit]], rcond=None)[0]
    return places


def _score(places: Array, tree: cKDTree, gate_px: float) -> float:
    """Number of targets explained, with weights that decrease with distance."""
    hit, distances, _ = _hits(places, tree, gate_px)
    return float(np.sum(1.0 - (distances[hit] / gate_px) ** 2))


def likely_diameters_px(field: Field, measured: MeasuredScan) -> tuple[float, float]:
    """Smallest and largest plausible diameter of a target, if the field roughly fills the image."""
    size = float(np.linalg.norm(np.ptp(field.xyz, axis=0)))
    filling = 2.0 * field.radius / size * float(np.hypot(measured.width_px, measured.height_px))
    return filling / _SIZES, filling * _SIZES


@dataclass(frozen=True, eq=False)
class NamedField:
    """Oriented image with identified targets.

    candidates: the identified candidates, by point; gate_px: largest distance of a target from its place by the model.
    """

    model: ImageModel
    candidates: Mapping[str, Candidate]
    gate_px: float

    def predictions(self, field: Field, measured: MeasuredScan) -> tuple[TargetPrediction, ...]:
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
    field: Field,
    model: ImageModel,
    camera: CameraFile,
    measured: MeasuredScan,
    candidates: Sequence[Candidate],
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
    film = _camera_from_comparator(camera, measured)
    if film is None:
        return "too few fiducials were measured to know where the camera's frame lies in the scan"
    middle = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]) / 2.0, measured.pitch_um)
    c = camera.principal_distance_mm or 2.0 * float(np.linalg.norm(middle))
    x0, y0 = middle if camera.principal_point_mm is None else camera.principal_point_mm
    lens = Lens(camera.distortion, np.array([c, x0, y0], dtype=np.float64), camera.distortion.values)
    return ImageModel(lens, np.eye(3), np.zeros(3), film)


def misplaced_principal_point(camera: CameraFile, measured: MeasuredScan) -> str:
    """A sentence if the principal point of a camera without fiducials is hardly within the scan, as if counted from its
    centre."""
    if camera.fiducials or camera.principal_point_mm is None:
        return ""
    size = comparator_from_pixel(np.array([measured.width_px - 1, measured.height_px - 1]), measured.pitch_um)
    if (np.abs(np.array(camera.principal_point_mm) - size / 2.0) < _IN_THE_PICTURE * np.abs(size)).all():
        return ""
    given, middle = (f"[{x:.4g}, {y:.4g}]" for x, y in (camera.principal_point_mm, (size / 2.0).tolist()))
    return (
        f"principal_point_mm = {given} is at the edge of the scan or beyond it. A camera without fiducials has it in "
        f"comparator coordinates, from the scan's top-left pixel, x to the right and y up: the middle of this scan is "
        f"{middle}. Give it so, or leave it out."
    )


def frame_mm(camera: CameraFile, model: ImageModel, measured: MeasuredScan) -> Array:
    """(2, 2) mm, smallest and largest camera coordinates of the exposed frame within the scan."""
    last = np.array([measured.width_px - 1, measured.height_px - 1])
    corners = comparator_from_pixel(np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * last, measured.pitch_um)
    shown_mm = model.camera_from_comparator(corners)
    if camera.fiducials and camera.frame_mm is not None:
        half = np.array(camera.frame_mm) / 2.0
        shown_mm = np.clip(shown_mm, -half, half)
    return np.stack([shown_mm.min(axis=0), shown_mm.max(axis=0)])


def _camera_from_comparator(camera: CameraFile, measured: MeasuredScan) -> Film | None:
    """Film transformation from the measured fiducials; the identity for a camera without fiducials."""
    if not camera.fiducials:
        return Film("none", np.zeros(0), np.zeros(2))
    if measured.frame.pixel_from_camera is None:
        return None
    places = np.linalg.inv(np.vstack([measured.frame.pixel_from_camera, [0.0, 0.0, 1.0]]))[:2]
    linear = places[:, :2] @ np.diag(pixel_from_comparator(np.ones(2), measured.pitch_um))
    return Film("affine", np.array([places[0, 2], *linear[0], places[1, 2], *linear[1]]), np.zeros(2))
