"""Single targets named in a scan of which no orientation is known, by the pattern that their coordinates make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from adjust.functional_model.projection import ImageModel
from adjust.target_identification.naming import Names, name_coded, name_marks
from measure.targets.block_search import Candidate
from measure.targets.measure_targets import TargetPrediction
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.camera_model import frame_mm
from pipeline.measuring.target_field import Field
from pipeline.results.comparator_file import comparator_from_pixel
from pipeline.results.measured_scan import MeasuredScan

Array = NDArray[np.float64]

_SIGMA_PX = 0.5  # of a mark as the search has it, eccentricity and lens included as far as they change quickly
_FOUND_WITHIN_PX = 2.0  # how far the fit may move from where the search has a target
_STRAYS = 1.5  # strongest marks a target: dust and texture are weaker than what was painted to be seen
_NEIGHBOURS = 4  # named targets next to one that was missed, that tell how far off its place is
_SIZES = 4.0  # how far a target's size may be from that in a picture that the whole field fills


def likely_diameters_px(field: Field, measured: MeasuredScan) -> tuple[float, float]:
    """The smallest and the largest that a target may have, if the field fills the picture more or less."""
    size = float(np.linalg.norm(np.ptp(field.xyz, axis=0)))
    filling = 2.0 * field.radius / size * float(np.hypot(measured.width_px, measured.height_px))
    return filling / _SIZES, filling * _SIZES


@dataclass(frozen=True, eq=False)
class NamedField:
    """The image as oriented by the names; candidates: of the points that have one, by id; gate_px: how far a target
    may lie from the place that the image gives it."""

    model: ImageModel
    candidates: Mapping[str, Candidate]
    gate_px: float

    def predictions(self, field: Field, measured: MeasuredScan) -> tuple[TargetPrediction, ...]:
        """Named targets where they were found, the others where the image and the named ones about them put them."""
        predicted = field.predictions(self.model, measured, self.gate_px)
        named = [one for one in predicted if one.point in self.candidates]
        off = np.array([self.candidates[one.point].center_px - one.center_px for one in named])
        tree = cKDTree([one.center_px for one in named])
        near = np.arange(1, min(_NEIGHBOURS, len(named)) + 1)
        return tuple(
            self._as_found(one)
            if one.point in self.candidates
            else replace(one, center_px=one.center_px + np.median(off[tree.query(one.center_px, k=near)[1]], axis=0))
            for one in predicted
        )

    def _as_found(self, predicted: TargetPrediction) -> TargetPrediction:
        found = self.candidates[predicted.point]
        return replace(
            predicted,
            center_px=found.center_px,
            pixel_from_disk=found.pixel_from_disk,
            search_px=_FOUND_WITHIN_PX,
        )


def name_field(
    field: Field,
    model: ImageModel,
    camera: CameraFile,
    measured: MeasuredScan,
    candidates: Sequence[Candidate],
    codes: Mapping[int, int] | None = None,
) -> NamedField | str:
    """Name the candidates, which come in the order of their strength; or why they have no names.

    model: the image's camera and film, its orientation not used, nor its principal distance where the camera's file
    gives none; codes: the point (by index) that a code says some candidates (by index) are.
    """
    places = np.array([one.center_px for one in candidates]).reshape(-1, 2)
    ideal = _ideal(model, measured, places)
    frame = frame_mm(camera, model, measured) - model.lens.interior[1:]
    inside = np.flatnonzero(((ideal >= frame[0]) & (ideal <= frame[1])).all(axis=1))
    strongest = inside if codes else inside[: int(_STRAYS * len(field.ids)) + 1]
    normals = np.array([field.normals.get(id, np.full(3, np.nan)) for id in field.ids]).reshape(-1, 3)
    c, pitch_mm = camera.principal_distance_mm, min(measured.pitch_um) / 1000.0
    known = field.xyz, normals, ideal[strongest], (frame[0], frame[1]), c, _SIGMA_PX * pitch_mm
    if codes:
        row = {int(candidate): mark for mark, candidate in enumerate(strongest)}
        names = name_coded(*known, {row[one]: point for one, point in codes.items() if one in row})
    else:
        names = name_marks(*known)
    if isinstance(names, str):
        return names
    return _named(names, field, model, [candidates[i] for i in strongest], pitch_mm)


def _named(
    names: Names, field: Field, model: ImageModel, candidates: Sequence[Candidate], pitch_mm: float
) -> NamedField:
    lens = replace(model.lens, interior=np.array([names.principal_distance_mm, *model.lens.interior[1:]]))
    oriented = replace(model, lens=lens, rotation=names.pose.rotation, station=names.pose.center)
    by_id = {field.ids[point]: candidates[mark] for point, mark in names.mark.items()}
    return NamedField(oriented, by_id, max(names.gate_mm / pitch_mm, _FOUND_WITHIN_PX))


def _ideal(model: ImageModel, measured: MeasuredScan, places_px: Array) -> Array:
    """(n, 2) mm about the principal point, free of what is known of the distortion."""
    camera = model.camera_from_comparator(comparator_from_pixel(places_px, measured.pitch_um))
    ideal, found = model.lens.ideal_from_observed(camera)
    return np.asarray(np.where(found[:, None], ideal, camera) - model.lens.interior[1:])
