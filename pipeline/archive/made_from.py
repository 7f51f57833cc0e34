"""Inputs of measurements and adjustments, by fingerprints: whether results are of other inputs than there are now."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import fields
from pathlib import Path
from typing import Any

from pipeline.archive.checked_results import find_check_run, latest
from pipeline.archive.results_database import ResultsDatabase
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.provenance import FileIdentity, FileStates, file_state, fingerprint, hash_text, parts_hash
from pipeline.results.adjustment_file import covariance_path, read_adjustment, read_own_covariance
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.comparator_file import ComparatorPoint

MadeFrom = dict[str, str]

# The names are used in messages: "is of other ... than there are now".
CAMERAS, SETTINGS, SCAN, CAMERA = "cameras", "settings", "scan ", "camera "
MARKS, POINTS, IMAGES, DISTANCES = "marks", "points", "images", "distances"
DECISIONS = "decisions"
PLACES = "points, orientations or lenses"

# Fields of a project that are not settings; all others, including future ones, are.
_NO_SETTINGS = {
    "path", "cameras", "scans", "comparator", "output", "given_points", "given_images", "given_distances",
    "images_path", "decisions", "decisions_cut_short", "max_pixels", "crs",
}  # fmt: skip
# Fields of a camera that determine where its targets are expected, not what its marks look like.
_LENS = {
    "principal_distance_mm", "principal_point_mm", "principal_distance_sigma_mm", "principal_point_sigma_mm",
    "distortion", "calibration",
}  # fmt: skip
_ORIGIN = {"path", "source"}


def measured_from(project: Project) -> MadeFrom:
    """Inputs of a measurement: every scan, what is sought in it, and the approximate values used to predict targets.
    The latter do not change a measured mark, but determine which ones are found and how they are named."""
    known, files = dict[str, FileIdentity](), FileStates(project.path.resolve().parent)
    if project.measurement_path.exists():
        with ResultsDatabase(project.measurement_path) as database:
            known = database.identities()
    coordinates = {id: [prior and prior.value for prior in (p.X, p.Y, p.Z)] for id, p in project.object_points.items()}
    places = [
        coordinates,
        project.given_points and project.given_points.normals,
        project.given_images and project.given_images.exterior,
        {camera.name: {name: getattr(camera, name) for name in _LENS} for camera in project.cameras.values()},
        *([project.given_images.part_of] if project.given_images and project.has_parts else []),
    ]

    return {
        # Of the adjustment's settings those with which fiducials are measured.
        SETTINGS: fingerprint([_fields_except(project, _NO_SETTINGS | {"adjust"}), project.film]),
        PLACES: fingerprint(places),
        **({DECISIONS: project.decisions_hash} if project.decisions else {}),
        **{
            f"{CAMERA}{camera.name}": fingerprint(_fields_except(camera, _LENS | _ORIGIN))
            for camera in project.cameras.values()
        },
        **{
            f"{SCAN}{image}": hash_text(f"{_parts(path, known, files)} {project.image_camera(image).name}")
            for image, path in project.scans.items()
        },
    }


def changed_scans(project: Project, digest: str = "") -> list[str]:
    """Images measured from another file than there is now, or no longer of the project. A file that is missing may be
    the measured one.

    digest: of the check run; "" for the latest. Raises InputError where review decisions are not in the marks.
    """
    path = project.measurement_path
    if not project.scans or not path.exists():
        return []
    with ResultsDatabase(path) as database:
        check_run = find_check_run(database, digest) if digest else latest(database)
    if check_run is None:
        return []
    made, now = check_run.made_from, measured_from(project)
    if made.get(DECISIONS) != now.get(DECISIONS):
        raise InputError(
            f"{path}: is of other decisions than there are now. Run `reseau measure`, which takes them in."
        )
    images = [name.removeprefix(SCAN) for name in differing(made, now) if name.startswith(SCAN) and name in made]
    folder = project.path.resolve().parent
    return [name for name in images if name not in project.scans or file_state(project.scans[name], folder).bytes >= 0]


def current_adjustment(project: Project, marks: Sequence[ComparatorPoint]) -> AdjustmentRecord | None:
    """Read the adjustment of a project; None where none converged.

    Raises InputError for a stale one, made from other inputs, and for a file that was changed since it was written.
    """
    path = project.adjustment_path
    if not path.exists():
        return None
    adjustment = read_adjustment(path)
    if not adjustment.converged:
        return None
    made_from = adjustment.made_from
    changed = differing(made_from, adjusted_from(project, marks)) if made_from else []
    if changed:
        raise InputError(f"{path}: is of other {', '.join(changed)} than there are now. Run `reseau adjust` again.")
    if covariance_path(path).exists():
        read_own_covariance(path)
    return adjustment


def adjusted_from(project: Project, marks: Sequence[ComparatorPoint]) -> MadeFrom:
    """Inputs of an adjustment: the marks that are observations, the given values, and the settings."""
    observations = []
    for mark in marks:
        if mark.status.is_observation:
            assert mark.xy_mm is not None  # an observation has coordinates
            sigma_mm = [] if mark.sigma_mm is None else mark.sigma_mm.tolist()
            observations.append((mark.image, mark.kind, mark.point, *mark.xy_mm.tolist(), *sigma_mm, mark.rho))
    cameras = {name: [camera.camera(), camera.calibration, camera.frame_mm] for name, camera in project.cameras.items()}
    return {
        MARKS: fingerprint(sorted(observations)),
        CAMERAS: fingerprint(cameras),
        POINTS: fingerprint([project.object_points, project.given_points and project.given_points.normals]),
        IMAGES: fingerprint(project.given_images),
        DISTANCES: fingerprint({fingerprint(given.distance) for given in project.given_distances}),
        SETTINGS: fingerprint(_fields_except(project, _NO_SETTINGS)),
    }


def _parts(path: Path, known: Mapping[str, FileIdentity], files: FileStates) -> tuple[int, str]:
    """Size of a scan's file and hash of its parts, read only where its state differs from that in the database."""
    state = files.get(path)
    found = known.get(state.uri)
    is_known = found is not None and found.state == state
    return state.bytes, found.parts_hash if found and is_known else parts_hash(path)


def differing(made: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of the inputs that differ, or exist only in one of the two."""
    return sorted(name for name in made.keys() | now.keys() if made.get(name) != now.get(name))


def _fields_except(value: Any, names: Set[str]) -> dict[str, object]:
    return {field.name: getattr(value, field.name) for field in fields(value) if field.name not in names}
