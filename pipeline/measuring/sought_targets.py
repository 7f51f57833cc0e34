"""The targets of a project, as the measurement of a scan needs them: what they are, and where they stand."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring.coded_points import CodedPoints
from pipeline.measuring.target_field import Field, target_field

LEAST_PAIRS = 4  # of points and marks that name an image's targets


@dataclass(frozen=True, eq=False)
class SoughtTargets:
    """settings: what the targets are. field: those whose coordinates are known, if only roughly; coded: the same where
    some bear codes. surveyed: whether a file of points gives them one by one. unit: of their coordinates, which is that
    many mm."""

    settings: TargetSettings
    field: Field
    coded: CodedPoints | None
    surveyed: bool
    unit: str
    unit_mm: float

    @classmethod
    def of(cls, project: Project) -> "SoughtTargets":
        """Raises InputError for single targets and rings that nothing in the project could name."""
        settings = project.targets
        assert settings is not None
        coded = CodedPoints.of(project, settings) if settings.code is not None else None
        field = target_field(project)
        if settings.board is None and coded is None:
            _check(project, settings, field)
        return cls(settings, field, coded, project.given_points is not None, project.unit, project.unit_mm)

    @property
    def ids(self) -> tuple[str, ...]:
        """The names of the marks that are sought."""
        if self.coded is not None:
            return self.coded.ids
        return tuple(self.settings.board.object_points()) if self.settings.board else self.field.ids


def _check(project: Project, settings: TargetSettings, field: Field) -> None:
    if project.given_points is None:
        raise InputError(
            f"{project.path}: [targets] kind {settings.kind!r} is named by the targets' coordinates, and there is no "
            '[object] points = "...". Give the file of the points, or leave [targets] out to measure fiducials only.'
        )
    if len(field.ids) < LEAST_PAIRS:
        raise InputError(
            f"{project.path}: [object] points: {len(field.ids)} points with X, Y and Z name no targets; give "
            f"{LEAST_PAIRS}, if only roughly."
        )
    nearest = cKDTree(field.xyz).query(field.xyz, k=[2])[0]
    spacing, diameter = float(np.quantile(nearest, 0.9)), 2.0 * field.radius
    if diameter > spacing:  # coordinates in another unit than the project says
        raise InputError(
            f"{project.path}: [targets] of {diameter * project.unit_mm:g} mm would cover one another: nine of ten "
            f"points of [object] lie within {spacing * project.unit_mm:.3g} mm of the next one if their coordinates "
            f'are in {project.unit}. Give the unit that they are in, as [object] unit = "m".'
        )
