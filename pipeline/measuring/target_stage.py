"""Targets of one scan: boards identify their own points; single disks and crosses are identified by prediction."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.network import Exterior
from measure.boards.measure import measure_board
from measure.boards.specs import BoardSpec
from measure.flags import Code, Reason
from measure.results import ON_FILM, MarkMeasurement
from measure.scans.scan import Scan
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring import target_field
from pipeline.measuring.coded_targets import CodedPoints, measure_coded_field, measure_sheet
from pipeline.measuring.target_field import (
    NamedField,
    camera_model,
    name_field,
    recognise,
)
from pipeline.results.measured_record import MeasuredScan

_MIRRORED = (
    "The board is mirrored: in a mirror, from its back, or the picture is flipped. Its points are named as on the "
    "board. If that is meant, write transparent = true under [targets]; else flip the picture."
)
LEAST_PAIRS = 4  # pairs of points and marks needed to identify an image's targets

_STRONGEST = 3  # candidates per target, by contrast: dust and texture are weaker than painted targets
_NEAR = 0.65  # of the scan's size, from its centre: targets predicted closer may be in the scan
_SIZES = 4.0  # largest ratio of a target's size to that in an image filled by the whole field
_SIZE_SLACK = 1.5  # largest factor of the error of a target's size due to the approximate distance


@dataclass(frozen=True, eq=False)
class SoughtTargets:
    """Targets to be measured.

    Attributes
    ----------
    field : the targets with coordinates, known at least approximately.
    coded : the points of a sheet or field with coded targets; None without codes.
    surveyed : whether a file of points gives their coordinates.
    """

    settings: TargetSettings
    field: target_field.TargetField
    coded: CodedPoints | None
    surveyed: bool
    unit: str
    unit_mm: float

    @classmethod
    def from_project(cls, project: Project) -> "SoughtTargets":
        """Build from a project. Raises InputError for single targets and rings that nothing in the project can
        identify."""
        settings = project.targets
        assert settings is not None
        coded = CodedPoints.from_project(project, settings) if settings.code is not None else None
        field = target_field.target_field(project)
        if settings.board is None and coded is None:
            if project.given_points is None:
                raise InputError(
                    f"{project.path}: [targets] kind {settings.kind!r} is named by the targets' coordinates, and there "
                    'is no [object] points = "...". Give the file of the points, or leave [targets] out to measure '
                    "fiducials only."
                )
            if len(field.ids) < LEAST_PAIRS:
                raise InputError(
                    f"{project.path}: [object] points: {len(field.ids)} points with X, Y and Z name no targets; give "
                    f"{LEAST_PAIRS}, if only roughly."
                )
            target_field.check_spacing(project, field)
        return cls(settings, field, coded, project.given_points is not None, project.unit, project.unit_mm)

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the marks to be measured."""
        if self.coded is not None:
            return self.coded.ids
        return tuple(self.settings.board.object_points()) if self.settings.board else self.field.ids


def measure_targets(
    sought: SoughtTargets, camera: CameraFile, exterior: Exterior | None, scan: Scan, measured: MeasuredScan
) -> MeasuredScan:
    """Measure the targets of a scan, in addition to its fiducials: one mark for each target that could be in it.

    exterior: approximate exterior orientation for the identification of targets.
    """
    if sought.settings.board is not None:
        return _board(sought, sought.settings.board, scan, measured)
    if sought.coded is not None and sought.coded.is_flat:
        return replace_targets(measured, *measure_sheet(scan, sought.coded))
    if sought.coded is not None:
        return replace_targets(measured, *measure_coded_field(scan, sought.coded, sought.field, camera, measured))
    named, notes = _identify_targets(sought, camera, exterior, scan, measured)
    if isinstance(named, str):
        absent = target_field.absent_targets(sought.field.ids, named)
        return replace_targets(measured, absent, (*notes, f"No target has a name: {named}."))
    fitted = target_field.measure_single_targets(scan, named.predictions(sought.field, measured), sought.settings)
    return replace_targets(measured, target_field.checked_places(fitted, sought.field, named.model, measured), notes)


def _board(sought: SoughtTargets, spec: BoardSpec, scan: Scan, measured: MeasuredScan) -> MeasuredScan:
    board = measure_board(scan, spec)
    problems = [f"Of the board's markers {len(board.refused)} are not used: {one}." for one in board.refused[:1]]
    if board.reason:
        problems = [f"The board was not found: {board.reason}."]
    if board.ambiguous:
        problems = [f"No point of the board is used: {board.ambiguous}. Cover all but one, or cut the scan."]
    if board.is_mirrored and not sought.settings.transparent:
        problems.append(_MIRRORED)
    if board.contradiction:
        problems.append(board.contradiction)
    # A board with symmetry under a half turn may be named either way, unless its points were surveyed.
    notes = [f"{note}." for note in board.notes] if sought.surveyed else []
    return replace_targets(measured, board.marks, (*problems, *notes), Code.NO_BOARD)


def replace_targets(
    measured: MeasuredScan, targets: Sequence[MarkMeasurement], problems: Sequence[str] = (), code: Code = Code.UNNAMED
) -> MeasuredScan:
    """Replace the targets of a scan. code: of the problems."""
    fiducials = [mark for mark in measured.frame.marks if mark.kind in ON_FILM]
    return measured.changed([*fiducials, *targets], [Reason(problem, code) for problem in problems])


def _identify_targets(
    sought: SoughtTargets, camera: CameraFile, exterior: Exterior | None, scan: Scan, measured: MeasuredScan
) -> tuple[NamedField | str, tuple[str, ...]]:
    """Identify the targets by the approximate orientation, else by the field's pattern, or tell why not; notes."""
    field, notes = sought.field, tuple[str, ...]()
    model = camera_model(camera, measured)
    if isinstance(model, str):
        return model, ()
    if exterior is not None and camera.principal_distance_mm is not None:
        approximate = replace(model, rotation=rotation_from_angles(exterior.values[3:]), station=exterior.center)
        named = _named_by_orientation(approximate, sought, camera, scan, measured)
        if isinstance(named, NamedField):
            return named, ()
        notes = (f"Its orientation in images.csv was not used to name the targets: {named}.",)
    # diameter of a target where the field fills the image
    extent = float(np.linalg.norm(np.ptp(field.xyz, axis=0)))
    filling = 2.0 * field.radius / extent * float(np.hypot(measured.width_px, measured.height_px))
    diameters = filling / _SIZES, filling * _SIZES
    if diameters[1] < target_field.LEAST_DIAMETER_PX:
        too_small = (
            f"targets of {2.0 * field.radius * sought.unit_mm:g} mm in a field of {extent:g} {sought.unit} would have "
            f"{diameters[1]:.2g} px at most, and {target_field.LEAST_DIAMETER_PX} are needed; is [object] unit the one "
            f'of the coordinates? "{sought.unit}" is taken, "m" being the default'
        )
        return too_small, notes
    return name_field(
        field, model, camera, measured, target_field.target_candidates(scan, sought.settings, diameters)
    ), notes


def _named_by_orientation(
    approximate: ImageModel, sought: SoughtTargets, camera: CameraFile, scan: Scan, measured: MeasuredScan
) -> NamedField | str:
    """Identify the targets by the pattern that an approximate orientation predicts; or the reason of the failure."""
    field = sought.field
    predictions = field.predictions(approximate, measured, search_px=1.0)
    size = np.array([measured.width_px, measured.height_px])
    near = [one for one in predictions if np.all(np.abs(one.center_px - size / 2.0) < _NEAR * size)]
    axes = np.array([one.half_axes_px for one in near]).reshape(-1, 2)
    if not len(axes) or 2.0 * float(axes.max()) < target_field.LEAST_DIAMETER_PX:
        return (
            f"the approximate orientation puts no target of {target_field.LEAST_DIAMETER_PX} px or more into the scan"
        )
    diameters = 2.0 * float(axes.min()) / _SIZE_SLACK, 2.0 * float(axes.max()) * _SIZE_SLACK
    strongest = target_field.target_candidates(scan, sought.settings, diameters)[: _STRONGEST * len(predictions)]
    predicted, found = (np.array([one.center_px for one in some]).reshape(-1, 2) for some in (predictions, strongest))
    row = {id: i for i, id in enumerate(field.ids)}
    pattern = recognise(predicted, found, float(np.hypot(measured.width_px, measured.height_px)) / 2.0)
    codes = {candidate: row[predictions[target].point] for candidate, target in pattern.items()}
    named = name_field(field, approximate, camera, measured, strongest, codes) if codes else ""
    if isinstance(named, NamedField):
        return named
    doubt = ", except for possible false alarms" if named else ""
    return f"the {len(found)} marks found do not make the pattern of the {len(predicted)} targets predicted{doubt}"
