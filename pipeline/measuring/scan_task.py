"""Tasks for measuring single scans: all that a result depends on, without the project."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Exterior
from measure.errors import MissingError
from measure.fiducials.options import FiducialOptions
from measure.results import ScanOrientation
from measure.scans.remote import fetch_location, public_address, scan_path
from measure.tone.curve import ToneInformation
from pipeline.files.camera_file import CameraFile
from pipeline.files.project_file import Project
from pipeline.provenance import canonical_json
from pipeline.results.measured_record import MeasuredScan

if TYPE_CHECKING:
    from measure.scans.scan import Scan
    from pipeline.measuring.target_stage import SoughtTargets

_NO_SCAN = "images.csv names it, and the project has no scan of that name. Look for the file, or take the line out."


class Memory(Protocol):
    """Values by keys; a key holds all that its value depends on."""

    def recall(self, key: str) -> Mapping[str, Any] | None:
        """The value of a key; None if there is none yet."""

    def remember(self, key: str, value: Mapping[str, object]) -> None:
        """Store a value."""


@dataclass(frozen=True, eq=False)
class ScanOptions:
    """Options for measuring a scan, shared by several scans.

    Attributes
    ----------
    camera : marks, frame and, where targets are predicted or nothing else locates the frame, the lens.
    pitch_um : as given in the project; None: from the file or the marks.
    fiducials : scan orientation, film and reading of text.
    known_pose : scan orientation of a scan from which marks were learned.
    tone_information : information on the curve from other scans of the scanner.
    exterior : approximate exterior orientation for the identification of targets.
    """

    camera: CameraFile
    pitch_um: tuple[float, float] | None
    fiducials: FiducialOptions
    known_pose: ScanOrientation | None = None
    tone: float | str = "auto"
    tone_information: tuple[ToneInformation, ...] = ()
    targets: "SoughtTargets | None" = None
    exterior: Exterior | None = None

    @cached_property
    def json(self) -> str:
        """Canonical JSON of all that a result depends on in addition to the scan. Equal options give equal text; any
        option that may change the result changes the text."""
        return canonical_json(self)


@dataclass(frozen=True, eq=False)
class ScanTask:
    """One scan to be measured.

    Attributes
    ----------
    scan : path or address of the file; "" where images.csv names an image without a file.
    max_pixels : limit for `open_scan`; it does not change the result of a scan that can be read.
    """

    name: str
    scan: str
    options: ScanOptions
    max_pixels: int | None = None

    @property
    def shown_scan(self) -> str:
        """The scan's address without secrets, for display and storage."""
        return public_address(self.scan)

    def open(self) -> "Scan":
        """Open the scan. Raises MeasurementError where it cannot be read."""
        if not self.scan:
            raise MissingError(_NO_SCAN)
        from measure.scans.opening import open_scan

        return open_scan(scan_path(self.scan), self.max_pixels).replace_name(self.name)

    def fix_orientation(self, pose: str) -> "ScanTask":
        """Copy with a known scan orientation; no text is read."""
        return self.change_options(pose=pose, writing="none", known_lines=())

    def change_options(self, **fiducials: Any) -> "ScanTask":
        """Copy with other options of the fiducials."""
        return replace(self, options=replace(self.options, fiducials=replace(self.options.fiducials, **fiducials)))

    def fiducials_alone(self, tone: float | str) -> "ScanTask":
        """Copy that measures only the fiducials, with the given tone curve."""
        task = self.change_options(writing="none", known_lines=())
        return replace(task, options=replace(task.options, tone=tone, tone_information=(), targets=None, exterior=None))


Measure = Callable[[Iterable[ScanTask]], Iterator[MeasuredScan]]  # runs tasks, or reads their results from a database


def scan_tasks(
    project: Project, names: Sequence[str], tone_information: Mapping[str, tuple[ToneInformation, ...]] | None = None
) -> tuple[ScanTask, ...]:
    """Tasks of these images, in their order; scans with the same options share one object.

    tone_information: by image, information on the scanner's tone curve from other scans. Raises InputError where some
    marks cannot be searched for.
    """
    options = image_options(project, tone_information or {})
    scans = {name: project.scans.get(name) for name in names}
    return tuple(
        ScanTask(name, "" if scan is None else fetch_location(scan), options(name), project.max_pixels)
        for name, scan in scans.items()
    )


def image_options(
    project: Project, tone_information: Mapping[str, tuple[ToneInformation, ...]]
) -> Callable[[str], ScanOptions]:
    """Function that returns the options of an image by its name; see `scan_tasks`."""
    cameras = {name: _sought(project, camera) for name, camera in project.cameras.items()}
    key_of = {id(camera): name for name, camera in project.cameras.items()}
    targets = None
    if project.targets is not None:
        from pipeline.measuring.target_stage import SoughtTargets  # late: it imports the detection of targets

        targets = SoughtTargets.from_project(project)
    shared: dict[tuple[object, ...], ScanOptions] = {}

    def options_for(name: str) -> ScanOptions:
        given = project.image_camera(name)
        pose, known = _pose(project, given, name)
        by_others = tone_information.get(name, ())
        exterior = project.given_images.exterior.get(name) if project.given_images and targets else None
        part = bool(project.scanned_frame(name))
        key = (key_of[id(given)], pose, known is None, part, *map(id, by_others), id(exterior))
        if key not in shared:
            film = project.film
            options = FiducialOptions(
                pose,
                film_sigma_mm=film.sigma_mm,
                film_model=film.model,
                writing=project.reads,
                part=part,
                lens=film.lens,
            )
            camera = cameras[key_of[id(given)]]
            shared[key] = ScanOptions(
                camera, project.pitch_um, options, known, project.tone, by_others, targets, exterior
            )
        return shared[key]

    return options_for


def sample_names(names: Sequence[str], count: int) -> list[str]:
    """A reproducible sample of count names, in their order. It rarely changes when names are added."""
    chosen = set(sorted(names, key=lambda name: sha256(name.encode("utf-8", "surrogateescape")).digest())[:count])
    return [name for name in names if name in chosen]


def _pose(project: Project, camera: CameraFile, name: str) -> tuple[str, ScanOrientation | None]:
    """Scan orientation of an image: as set in the project, or known from the learning of marks."""
    # Marks that recur in all scans, without clicks, were searched in one assumed orientation.
    learned = camera.learned_from
    if learned is None or project.pose != "auto" or name not in learned.alike:
        return project.pose, None
    if learned.clicked:
        return learned.pose, ScanOrientation(learned.pose, True, ("the clicks in it say so.",))
    like = f"it is taken to lie as {learned.scan}, from which its marks were learned: {learned.pose} is assumed."
    return learned.pose, ScanOrientation(learned.pose, False, (like,))


def _sought(project: Project, camera: CameraFile) -> CameraFile:
    """Reduce a camera to what the measurement of a scan depends on: no name, no file, and only values of its lens."""
    if any(not one.passed_over for one in camera.fiducials):
        camera.layout()  # raises where a mark has no drawing
    camera = replace(
        camera,
        path=Path(),
        name="",
        number="",
        principal_distance_sigma_mm=0.0,
        principal_point_sigma_mm=(0.0, 0.0),
        distortion=replace(
            camera.distortion, parameters={name: Prior(one.value) for name, one in camera.distortion.parameters.items()}
        ),
        calibration=None,
        source=None,
        clicks=None,
        learned_from=None,
    )
    if project.targets is not None:
        return camera
    camera = replace(camera, principal_distance_mm=None, distortion=Distortion())
    return replace(camera, principal_point_mm=None) if camera.fiducials else camera
