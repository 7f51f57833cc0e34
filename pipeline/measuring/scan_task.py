"""What one scan's result depends on: the task that a process gets which measures it, without the project."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Exterior
from measure.annotations.fields import KnownLine
from measure.errors import MissingError
from measure.fiducials.options import FiducialOptions
from measure.results import Pose
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
    """Values by keys, which name all that a value depends on."""

    def recall(self, key: str) -> Mapping[str, Any] | None:
        """The value of that key; None: there is none yet."""

    def remember(self, key: str, value: Mapping[str, object]) -> None:
        """Keep a value."""


@dataclass(frozen=True, eq=False)
class ScanOptions:
    """How a scan is measured, whichever it is.

    camera: its marks, its frame and, where targets are predicted or nothing else says where the picture is, its lens.
    pitch_um: as the project gives it; None: the file says it, or the marks. fiducials: pose, film and writing.
    known_pose: what is told of the pose of a scan from which marks were learned. tone: the curve as the project has it;
    said: by other scans of the scanner. exterior: an approximate orientation, which targets are named by.
    """

    camera: CameraFile
    pitch_um: tuple[float, float] | None
    fiducials: FiducialOptions
    known_pose: Pose | None = None
    tone: float | str = "auto"
    said: tuple[ToneInformation, ...] = ()
    targets: "SoughtTargets | None" = None
    exterior: Exterior | None = None

    def knowing(self, lines: tuple[KnownLine, ...]) -> "ScanOptions":
        """The same, with lines by which a frame is known to lie as others of its camera."""
        return replace(self, fiducials=replace(self.fiducials, known_lines=lines))

    @cached_property
    def json(self) -> str:
        """All of it as canonical JSON."""
        return canonical_json(self)


@dataclass(frozen=True, eq=False)
class ScanTask:
    """One scan to be measured.

    name: the image's. scan: the path or the address of its file; "" where images.csv names an image that has none.
    max_pixels: how many are read, as `open_scan` takes it: it changes nothing of a scan that is read.
    """

    name: str
    scan: str
    options: ScanOptions
    max_pixels: int | None = None

    def options_json(self) -> str:
        """Canonical JSON of all that the result depends on beside the scan itself: equal options give equal text, and
        whatever may change the result changes it."""
        return self.options.json

    @property
    def shown_scan(self) -> str:
        """The scan as it may be shown and kept."""
        return public_address(self.scan)

    def opened(self) -> "Scan":
        """The scan. Raises MeasurementError where it cannot be read."""
        if not self.scan:
            raise MissingError(_NO_SCAN)
        from measure.scans.opening import open_scan

        return open_scan(scan_path(self.scan), self.max_pixels).replace_name(self.name)

    def posed(self, pose: str) -> "ScanTask":
        """The same scan in a pose that is known, nothing read in it."""
        fiducials = replace(self.options.fiducials, pose=pose, writing="none", known_lines=())
        return replace(self, options=replace(self.options, fiducials=fiducials))

    def fiducials_alone(self, tone: float | str) -> "ScanTask":
        """The same scan, of which the fiducials alone are sought, seen through that curve."""
        fiducials = replace(self.options.fiducials, writing="none", known_lines=())
        options = replace(self.options, fiducials=fiducials, tone=tone, said=(), targets=None, exterior=None)
        return replace(self, options=options)


Measure = Callable[[Iterable[ScanTask]], Iterator[MeasuredScan]]  # how tasks get done: `measure_scans`, or from a store


def scan_tasks(
    project: Project, names: Sequence[str], said: Mapping[str, tuple[ToneInformation, ...]] | None = None
) -> tuple[ScanTask, ...]:
    """Tasks of these images, in their order; scans that have all in common share their options. said: by image what
    other scans say of its scanner's curve. Raises InputError for marks that cannot be sought."""
    options = image_options(project, said or {})
    scans = {name: project.scans.get(name) for name in names}
    return tuple(
        ScanTask(name, "" if scan is None else fetch_location(scan), options(name), project.max_pixels)
        for name, scan in scans.items()
    )


def image_options(project: Project, said: Mapping[str, tuple[ToneInformation, ...]]) -> Callable[[str], ScanOptions]:
    """How each image is to be measured, by its name; as `scan_tasks` has it."""
    cameras = {name: _sought(project, camera) for name, camera in project.cameras.items()}
    key_of = {id(camera): name for name, camera in project.cameras.items()}
    targets = _targets(project)
    shared: dict[tuple[object, ...], ScanOptions] = {}

    def options_for(name: str) -> ScanOptions:
        given = project.image_camera(name)
        pose, known = _pose(project, given, name)
        by_others = said.get(name, ())
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


def _targets(project: Project) -> "SoughtTargets | None":
    if project.targets is None:
        return None
    from pipeline.measuring.target_stage import SoughtTargets  # and all that looks for them

    return SoughtTargets.from_project(project)


def sample_names(names: Sequence[str], count: int) -> list[str]:
    """So many of them, in their order: the same ones where another name comes to them, but rarely."""
    chosen = set(sorted(names, key=lambda name: sha256(name.encode("utf-8", "surrogateescape")).digest())[:count])
    return [name for name in names if name in chosen]


def _pose(project: Project, camera: CameraFile, name: str) -> tuple[str, Pose | None]:
    """As the project sets it; a scan whose marks were clicked lies as these say, and what recurs in all scans, nobody
    having clicked, was looked for in one pose."""
    learned = camera.learned_from
    if learned is None or project.pose != "auto" or name not in learned.alike:
        return project.pose, None
    if learned.clicked:
        return learned.pose, Pose(learned.pose, True, ("the clicks in it say so.",))
    like = f"it is taken to lie as {learned.scan}, from which its marks were learned: {learned.pose} is assumed."
    return learned.pose, Pose(learned.pose, False, (like,))


def _sought(project: Project, camera: CameraFile) -> CameraFile:
    """What of a camera the measurement of a scan depends on: no name, no file, and of its lens only values."""
    if any(not one.passed_over for one in camera.fiducials):
        camera.layout()  # raises where a mark has no drawing
    camera = replace(
        camera,
        path=Path(),
        name="",
        number="",
        principal_distance_sigma_mm=0.0,
        principal_point_sigma_mm=(0.0, 0.0),
        distortion=_values(camera.distortion),
        calibration=None,
        source=None,
        clicks=None,
        learned_from=None,
    )
    if project.targets is not None:
        return camera
    camera = replace(camera, principal_distance_mm=None, distortion=Distortion())
    return replace(camera, principal_point_mm=None) if camera.fiducials else camera


def _values(distortion: Distortion) -> Distortion:
    return replace(distortion, parameters={name: Prior(one.value) for name, one in distortion.parameters.items()})
