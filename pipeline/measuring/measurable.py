"""What of a project can be measured at all: known before anything is."""

from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.measuring.natural_points import check_tie_names
from pipeline.measuring.scan_task import scan_tasks


def check_measurable(project: Project) -> tuple[str, ...]:
    """The names of the images that are to be measured. Raises InputError for what is wrong in the user's own files."""
    if not project.scans:
        raise InputError(f'{project.path}: scans is missing: which pictures to measure, such as ["scans/*.tif"].')
    _check_anything_to_measure(project)
    check_tie_names(project)
    _check_marks(project)
    listed = project.given_images.exterior if project.given_images else {}
    names = (*project.scans, *(name for name in listed if name not in project.scans and name not in project.left_out))
    scan_tasks(project, names)  # raises for targets that nothing names and for marks that nobody has drawn
    return names


def _check_anything_to_measure(project: Project) -> None:
    """Without fiducials, targets and natural points comparator.csv would hold nothing."""
    sought = [one for camera in project.cameras.values() for one in camera.fiducials if not one.passed_over]
    if not sought and project.targets is None and project.ties is None:
        raise InputError(
            f"{project.path}: there is nothing to measure: {project.default_camera.path} has no fiducial that is not "
            "passed over, and the project neither [targets] nor [ties]. Add what the scans show."
        )


def _check_marks(project: Project) -> None:
    """One mark by itself tells neither the turn nor the scale of a frame."""
    for camera in project.cameras.values():
        if len(camera.drawn) + len(camera.learned) == 1:
            raise InputError(
                f"{camera.path} has one fiducial mark, and a frame is found by two or more. Add the others, or pass it "
                'over with mark = "none".'
            )
