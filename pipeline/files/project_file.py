"""project.toml: which camera, which scans, what to measure, how to adjust, where to write."""

import dataclasses
import glob
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from adjust.functional_model.lens import Prior
from adjust.problem.network import ObjectPoint
from measure.fiducials.options import ANY_FILM, BelievedFilm, Reads
from pipeline.errors import InputError
from pipeline.files import object_files
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.decisions_file import FILE as DECISIONS
from pipeline.files.decisions_file import Decision, cut_short_line, decisions_bytes, learned_from, parse_decisions
from pipeline.files.library import PREFIX, camera_path
from pipeline.files.mark_table import Clicks
from pipeline.files.project_tables import UNITS_MM, AdjustSettings, ProjectTable
from pipeline.files.scan_files import add_cuts, as_named, find_scans
from pipeline.files.target_table import TargetSettings, TieSettings, read_targets
from pipeline.provenance import hash_content
from pipeline.results.adjustment_file import covariance_path
from pipeline.text.files import FilePath, no_such_file, path_below
from pipeline.text.table_models import read_model
from pipeline.text.toml_tables import Table, read_toml
from pipeline.text.wording import nearest

if TYPE_CHECKING:
    from measure.scans.scan import Scan
    from pipeline.files.opencv_file import CalibratedLens

ASSUMED_PITCH_UM = 5.0  # for digital cameras of unknown pitch: results are in pixels, so it cancels
_UNDRAWN = "camera.toml"  # name of a camera file that has yet to be drawn
_NO_CAMERA = (
    'is missing: no camera is known for these scans. Give camera = "camera.toml", a file that `reseau review` draws '
    "over a scan and `reseau template camera --marks cross --square 212` begins, or one of the library (`reseau "
    'cameras`), camera = "library:NAME".'
)
_GENERIC_NAMES = ("out", "output", "project", "reseau")  # of folders, which do not name what is in them
DEFAULT_SCANNER = "1"  # scanner of all images that name none


@dataclasses.dataclass(frozen=True)
class Project:
    """Content of a project file; paths are resolved against the file's folder.

    Attributes
    ----------
    cameras : by file name; the first one is the default where images.csv names none.
    scans : by image name, in their order.
    comparator, output : comparator.csv and the folder of the results.
    pitch_um : pixel pitch of the scans; None: from the files.
    tone : tone curve of the scans: auto, one of TONES, or the exponent p of light ~ (grey value)^p.
    unit_mm : user's unit of object coordinates, mm.
    max_pixels : limit for a scan, if the user states one.
    writing : scans in which the writing about the frame is read, as in `FiducialOptions`.
    left_out : images that `exclude` leaves out.
    crs : coordinate reference system, as "EPSG:25832"; empty if not stated.
    board_bend_sigma : standard deviation of the board's middle off its plane, user's unit, for a board that holds all
        object points; 0: flat, inf: unknown.
    transparent : whether a flat field of object points is visible from both sides.
    decisions : review decisions about marks and poses, the oldest first.
    decisions_hash : SHA-256 of their file; "" where there are none.
    decisions_cut_short : number of a last line that was cut short and is ignored; else 0.
    missing_camera : default camera's file where it has yet to be drawn; then there are no cameras.
    lens : of the digital camera that photographed the film; None for film that was scanned.
    """

    path: Path
    cameras: Mapping[str, CameraFile]
    scans: Mapping[str, Path]
    comparator: Path
    pitch_um: tuple[float, float] | None
    output: Path
    pose: str
    tone: float | str
    targets: TargetSettings | None
    ties: TieSettings | None
    given_points: object_files.GivenPoints | None
    given_images: object_files.GivenImages | None
    given_distances: tuple[object_files.GivenDistance, ...]
    unit_mm: float
    adjust: AdjustSettings
    max_pixels: int | None = None
    writing: Reads = "pose"
    images_path: Path | None = None
    left_out: frozenset[str] = frozenset()
    crs: str = ""
    board_bend_sigma: float = 0.0
    transparent: bool = False
    decisions: tuple[Decision, ...] = ()
    decisions_hash: str = ""
    decisions_cut_short: int = 0
    missing_camera: str = ""
    lens: "CalibratedLens | None" = None

    def open_scan(self, name: str) -> "Scan":
        """Open the scan of an image. Raises MeasurementError where it cannot be read."""
        from measure.scans.opening import open_scan

        return open_scan(self.scans[name], self.max_pixels)

    @property
    def reads(self) -> Reads:
        """Scans in which writing is read: all if images.csv has a column for it, unless the user forbids it."""
        is_requested = self.given_images is not None and self.given_images.asks_writing
        return "all" if is_requested and self.writing == "pose" else self.writing

    @property
    def film(self) -> BelievedFilm:
        """Standard deviation of film and scanner and film deformation model: stated by the project, or default
        values."""
        stated_mm, model = self.adjust.film_sigma_um / 1000.0, self.adjust.transformation or ANY_FILM.model
        return BelievedFilm(stated_mm or ANY_FILM.sigma_mm, bool(stated_mm), model, self.lens)

    @property
    def list_pitch_um(self) -> tuple[float, float] | None:
        """Pixel pitch for a comparator.csv without mm: that of the project; assumed for digital cameras, whose results
        are in pixels; None for film, and where a camera file gives lengths in mm."""
        in_mm = any(each.fiducials or each.principal_distance_mm or each.frame_mm for each in self.cameras.values())
        is_digital = self.adjust.transformation in (None, "none") and not in_mm
        return self.pitch_um or ((ASSUMED_PITCH_UM, ASSUMED_PITCH_UM) if is_digital else None)

    @property
    def title(self) -> str:
        """Name of the project's folder, or of the project file unless it is called project.toml.

        A folder whose name says nothing is named with the one that it lies in.
        """
        folder = self.path.resolve().parent
        own = folder.name if folder.name.lower() not in _GENERIC_NAMES else "/".join(folder.parts[-2:])
        name = own if self.path.stem == "project" else self.path.stem
        return name.encode("utf-8", "replace").decode("utf-8")

    @property
    def decisions_path(self) -> Path:
        return self.path.parent / DECISIONS

    @property
    def adjustment_path(self) -> Path:
        return self.output / "adjustment.json"

    @property
    def check_path(self) -> Path:
        return self.output / "check.json"

    @property
    def choice_path(self) -> Path:
        return self.output / "choose.json"

    @property
    def measurement_path(self) -> Path:
        return self.output / "measurement.db"

    @property
    def thumbnails_path(self) -> Path:
        return self.output / "thumbnails.db"

    def shard_path(self, part: int, parts: int) -> Path:
        """Results database of one of several parts of the scans."""
        return self.output / f"measurement.{part}-of-{parts}.db"

    @property
    def frames_path(self) -> Path:
        return self.output / "frames.csv"

    @property
    def report_path(self) -> Path:
        return self.output / "report.html"

    def frame_page_path(self, image: str) -> Path:
        """HTML page of one image, in folders as in its name. Raises InputError for a name that is not a valid path."""
        return path_below(self.output / "frames", image, ".html")

    @property
    def results(self) -> tuple[Path, ...]:
        """Files that the program may write; only its own earlier results may exist there."""
        databases = (self.measurement_path, self.thumbnails_path)
        measured = (self.comparator, *databases, self.frames_path) if self.scans else ()
        adjusted = (self.adjustment_path, covariance_path(self.adjustment_path), self.check_path, self.choice_path)
        return (*measured, *adjusted, self.report_path)

    @property
    def unit(self) -> str:
        """User's unit of object coordinates."""
        return next(name for name, mm in UNITS_MM.items() if mm == self.unit_mm)

    @property
    def disk_radius(self) -> float:
        """Radius of the disk targets in object units; 0 if unknown."""
        diameter = self.targets.diameter_mm if self.targets else None
        return 0.0 if diameter is None else diameter / 2.0 / self.unit_mm

    @property
    def target_radius(self) -> float:
        """Radius of the disks, or half the length of the crosses, in object units."""
        arm = self.targets.arm_mm if self.targets else None
        return self.disk_radius if arm is None else arm / self.unit_mm

    @cached_property
    def object_points(self) -> Mapping[str, ObjectPoint]:
        """Object points of points.csv, or else of the board, by id."""
        if self.given_points is not None:
            return {point.id: point for point in self.given_points.points}
        if self.targets is None or self.targets.board is None:
            return {}
        scale = 1.0 / self.unit_mm
        board = self.targets.board.object_points()
        return {id: ObjectPoint(id, *(Prior(scale * value) for value in xyz)) for id, xyz in board.items()}

    @cached_property
    def default_camera(self) -> CameraFile:
        return next(iter(self.cameras.values()))

    def image_camera(self, image: str) -> CameraFile:
        name = self.given_images.camera.get(image, "") if self.given_images else ""
        return self.cameras[name] if name else self.default_camera

    def scanned_frame(self, image: str) -> str:
        """Frame of which an image is one of several scans; "" for a whole frame."""
        return self.given_images.part_of.get(image, "") if self.given_images else ""

    def image_frame(self, image: str) -> str:
        """Frame that an image shows, as a whole or in part."""
        return self.scanned_frame(image) or image

    def turned_deg(self, image: str) -> int:
        """Counter-clockwise rotation of a digital image relative to the sensor."""
        return self.given_images.turned_deg.get(image, 0) if self.given_images else 0

    @property
    def has_parts(self) -> bool:
        """Whether any frame was scanned in several parts."""
        return self.given_images is not None and any(self.given_images.part_of.values())

    def image_scanner(self, image: str) -> str:
        """Scanner of an image; all images that name none share one."""
        return (self.given_images.scanner.get(image, "") if self.given_images else "") or DEFAULT_SCANNER


def read_project(path: FilePath) -> Project:
    """Read project.toml and the camera, points, images and distances files that it names.

    Raises InputError with file, line and key; errors in the project file itself are reported first.
    """
    return _read_tables(read_toml(path, "project.toml"))


def read_undrawn(path: Path, scans: Sequence[Path] = ()) -> Project:
    """Read a project whose default camera may have yet to be drawn.

    scans: replace the content of the project file, whose path then only names the project. Raises InputError as
    `read_project` does.
    """
    if not scans:
        given = read_toml(path, "project.toml").values
        return _read_tables(Table({"camera": _UNDRAWN, **given}, path, ""), needs_camera=False)
    names = [glob.escape(os.path.relpath(scan, path.parent)) for scan in scans]
    return _read_tables(Table({"camera": _UNDRAWN, "scans": names}, path, ""), needs_camera=False)


def _read_tables(table: Table, needs_camera: bool = True) -> Project:
    path = table.file
    if "camera" not in table and ("fiducial" in table or "principal_distance_mm" in table):
        raise InputError(f'{path} is a camera file. Give the project file, which names it: camera = "{path.name}".')
    if "camera" not in table and "scans" in table and not nearest("camera", table.values):
        raise table.error("camera", _NO_CAMERA)
    given, objects = read_model(table, ProjectTable), table.table("object")
    folder = path.parent
    files = {key: getattr(given.object, key) for key in ("points", "images", "distances")}
    named = {key: folder / name for key, name in files.items() if name is not None}
    lacks_camera = not (needs_camera or given.camera.startswith(PREFIX) or (folder / given.camera).exists())
    _check_named(table, objects, "" if lacks_camera else given.camera, named)
    images = object_files.read_images(named["images"]) if "images" in named else None
    scans, left_out = find_scans(table, given.scans, given.exclude) if given.scans is not None else ({}, frozenset())
    project = Project(
        path=path,
        cameras={} if lacks_camera else _cameras(table, given.camera, images),
        missing_camera=given.camera if lacks_camera else "",
        scans=add_cuts(scans, images, named.get("images")),
        left_out=left_out,
        comparator=folder / given.comparator,
        pitch_um=given.pitch_um,
        output=folder / given.output,
        pose=given.measure.orientation,
        tone=given.measure.tone,
        targets=None if given.targets is None else read_targets(table.table("targets")),
        ties=given.ties,
        given_points=object_files.read_points(named["points"]) if "points" in named else None,
        given_images=images,
        given_distances=object_files.read_distances(named["distances"]) if "distances" in named else (),
        images_path=named.get("images"),
        unit_mm=UNITS_MM[given.object.unit],
        adjust=given.adjust,
        writing=given.measure.writing,
        crs=given.object.crs,
        board_bend_sigma=given.object.board_bend,
        transparent=given.object.transparent,
        lens=_taking_lens(table, given),
    )
    project = reload_decisions(project)
    if not project.scans and not project.comparator.exists():
        raise InputError(
            f"{path}: there are no scans and no comparator coordinates. Give scans = [...] to measure, or comparator = "
            f'"..." with the coordinates; searched {project.comparator.resolve()}.'
        )
    _check_written(table, project, named)
    return project


def _taking_lens(table: Table, given: ProjectTable) -> "CalibratedLens | None":
    """Lens of the digital camera that photographed the film. Raises InputError where other settings contradict it."""
    name, scanner = given.scanner.lens, table.table("scanner")
    if name is None:
        return None
    if given.adjust.transformation == "none":
        raise scanner.error(
            "lens", 'is of a camera that photographed film: with transformation "none" there is no film.'
        )
    if given.pitch_um is None or given.pitch_um[0] != given.pitch_um[1]:
        raise scanner.error(
            "lens", "goes with pitch_um, one number: how many µm of film a pixel shows. A photograph does not say it."
        )
    from pipeline.files.opencv_file import read_lens  # imports OpenCV, which few projects need here

    return read_lens(table.file.parent / name, given.pitch_um[0])


def reload_decisions(project: Project) -> Project:
    """Project with the present content of decisions.jsonl, including clicks on marks to be learned that the camera file
    lacks. Raises InputError with the line, or with the missing marks."""
    path = project.decisions_path
    data = decisions_bytes(path)
    decisions, cut_short = parse_decisions(path, data), cut_short_line(data)
    cameras = dict(project.cameras)
    for name, camera in project.cameras.items():
        if not camera.needs_clicks:
            continue
        shown = learned_from(decisions, {one for one in project.scans if project.image_camera(one) is camera})
        ids, clicks = [one.id for one in camera.learned], None
        if shown is not None:
            if missing := [id for id in ids if id not in shown.px]:
                raise InputError(
                    f"{path}: the decision to learn the marks of {camera.name} from {shown.image} says nothing of "
                    f"{', '.join(missing)}. Show all of them in `reseau review`, or take the line out."
                )
            px = {id: shown.px[id] for id in ids}
            clicks = Clicks(shown.image, px, shown.fingerprint, shown.who or "somebody")
        cameras[name] = replace(camera, clicks=clicks)
    decisions_hash = hash_content(data) if decisions else ""
    return replace(
        project, cameras=cameras, decisions=decisions, decisions_hash=decisions_hash, decisions_cut_short=cut_short
    )


def _check_named(table: Table, objects: Table, camera: str, named: Mapping[str, Path]) -> None:
    """Raise InputError that lists all missing files."""
    try:
        keys = {"camera": (table, camera_path(camera, table.file.parent))} if camera else {}
    except InputError as error:
        raise table.error("camera", str(error)) from None
    keys |= {key: (objects, path) for key, path in named.items()}
    hints = {"camera": " `reseau template camera` prints one to start from."}
    missing = [
        str(where.error(key, no_such_file(path) + hints.get(key, "")))
        for key, (where, path) in keys.items()
        if not path.exists()
    ]
    if missing:
        raise InputError("\n".join(missing))


def _check_written(table: Table, project: Project, named: Mapping[str, Path]) -> None:
    """Raise InputError where a result would overwrite an input or another result."""
    if project.scans and project.comparator.is_dir():
        raise table.error("comparator", f"{project.comparator} is a folder. Name a file to be written there.")
    given = {"the project itself": project.path, **{f"[object] {key}": path for key, path in named.items()}}
    for camera in project.cameras.values():
        given[f"the camera of {camera.name}"] = camera.path
        if camera.calibration is not None:
            given[f"the earlier calibration of {camera.name}"] = camera.calibration.path
            given[f"the covariance of {camera.name}'s earlier calibration"] = covariance_path(camera.calibration.path)
    if not project.scans:
        given["the comparator coordinates"] = project.comparator
    written = {path.resolve().name for path in project.results}  # only scans with these names are checked
    scans = as_named(project.scans).items()
    given |= {f"the scan {name}": Path(file) for name, file in scans if os.path.basename(file) in written}
    places = {path.resolve(): f"{what}, {path}" for what, path in given.items()}
    for path in project.results:
        what = places.get(path.resolve())
        if what is not None:
            key = "comparator" if path == project.comparator else "output"
            other = 'file, such as "comparator.csv"' if key == "comparator" else "folder"
            raise table.error(key, f"{path.name} would be written over {what}. Name another {other}.")
        places[path.resolve()] = f"another result, {path}"


def _cameras(table: Table, default: str, images: object_files.GivenImages | None) -> Mapping[str, CameraFile]:
    folder = table.file.parent
    names = [default, *sorted({name for name in images.camera.values() if name} if images else set())]
    cameras = {name: read_camera(camera_path(name, folder)) for name in dict.fromkeys(names)}
    titles: dict[str, str] = {}
    for name, camera in cameras.items():
        if camera.name in titles:
            raise InputError(
                f"{camera.path}: the name {camera.name!r} is also that of {titles[camera.name]}. "
                "Give every camera a name of its own."
            )
        titles[camera.name] = name
    return cameras
