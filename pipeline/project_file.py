"""project.toml: which camera, which scans, what to measure, how to adjust, where to write."""

import glob
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, cast, get_args

from adjust.network import Transformation
from adjust.options import MEASURED_KINDS
from adjust.reweighting import WeightFunction
from adjust.tested import PRIOR_GROUPS
from adjust.transformation import film_kind
from pipeline.camera_file import CameraFile, read_camera
from pipeline.distances_file import GivenDistance, read_distances
from pipeline.errors import InputError
from pipeline.images_file import GivenImages, image_name, read_images
from pipeline.library import camera_path
from pipeline.points_file import GivenPoints, read_points
from pipeline.tables import Table, read_toml
from pipeline.target_table import TargetSettings, read_targets
from pipeline.tie_table import TieSettings, read_ties

POSES = ("0", "90", "180", "270", "0m", "90m", "180m", "270m")
UNITS_MM = {"m": 1000.0, "dm": 100.0, "cm": 10.0, "mm": 1.0}

Datum = Literal["control", "minimal", "free"]
Method = Literal["combined", "elements"]


@dataclass(frozen=True)
class AdjustSettings:
    """The table [adjust]: a-priori standard deviations in um at the film.

    transformation None: affine for a camera with fiducials, none for one without.
    """

    transformation: Transformation | None
    datum: Datum
    datum_coordinates: tuple[str, ...]
    datum_points: tuple[str, ...]
    sigma_target_um: float
    sigma_fiducial_um: float
    film_sigma_um: float
    refraction: bool
    earth_curvature: bool
    robust: bool | WeightFunction
    variance_components: bool | tuple[str, ...]
    snooping: bool
    method: Method


@dataclass(frozen=True)
class Project:
    """A project file as read; paths are resolved against the file's folder.

    cameras: by file name; the first one serves where images.csv names none. scans: by image name, in their order.
    unit_mm: how many mm the user's unit of object coordinates has.
    """

    path: Path
    cameras: Mapping[str, CameraFile]
    scans: Mapping[str, Path]
    comparator: Path
    pitch_um: tuple[float, float] | None
    output: Path
    pose: str
    targets: TargetSettings | None
    ties: TieSettings | None
    given_points: GivenPoints | None
    given_images: GivenImages | None
    given_distances: tuple[GivenDistance, ...]
    unit_mm: float
    adjust: AdjustSettings

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
        return self.output / "measurement.json"

    @property
    def report_path(self) -> Path:
        return self.output / "report.html"

    @property
    def disk_radius(self) -> float:
        """The radius of the disk targets in the unit of the object coordinates; 0 where nothing is said of it."""
        diameter = self.targets.diameter_mm if self.targets else None
        return 0.0 if diameter is None else diameter / 2.0 / self.unit_mm

    @property
    def target_radius(self) -> float:
        """That of the disks, or half the length of the crosses, in the unit of the object coordinates."""
        arm = self.targets.arm_mm if self.targets else None
        return self.disk_radius if arm is None else arm / self.unit_mm

    @cached_property
    def default_camera(self) -> CameraFile:
        return next(iter(self.cameras.values()))

    def camera_of(self, image: str) -> CameraFile:
        name = self.given_images.camera.get(image, "") if self.given_images else ""
        return self.cameras[name] if name else self.default_camera


def read_project(path: Path) -> Project:
    """Read project.toml and the camera, points and images files it names. Raises InputError with file, line and key."""
    table = read_toml(path)
    folder = path.parent
    objects = table.table("object")
    given_images = _given_images(objects, folder)
    measure = table.table("measure")
    project = Project(
        path=path,
        cameras=_cameras(table, folder, given_images),
        scans=_scans(table, folder),
        comparator=folder / table.text("comparator", "comparator.csv"),
        pitch_um=_pitch(table),
        output=folder / table.text("output", "out"),
        pose=measure.text("pose", "auto", ("auto", *POSES)),
        targets=read_targets(table.table("targets")) if "targets" in table else None,
        ties=read_ties(table.table("ties")) if "ties" in table else None,
        given_points=read_points(folder / objects.text("points")) if "points" in objects else None,
        given_images=given_images,
        given_distances=read_distances(folder / objects.text("distances")) if "distances" in objects else (),
        unit_mm=UNITS_MM[objects.text("unit", "m", tuple(UNITS_MM))],
        adjust=_adjust_settings(table.table("adjust")),
    )
    objects.text("images", "")
    measure.done()
    objects.done()
    table.done()
    if not project.scans and not project.comparator.exists():
        raise InputError(
            f"{path}: there are no scans and no comparator coordinates. Give scans = [...] to measure, or comparator = "
            f'"..." with the coordinates; looked for {project.comparator.resolve()}.'
        )
    return project


def _given_images(objects: Table, folder: Path) -> GivenImages | None:
    antenna = objects.triple("antenna_offset", (0.0, 0.0, 0.0))
    if any(antenna) and "images" not in objects:
        raise objects.error("antenna_offset", 'goes with images = "...", the file of the observed stations. Give both.')
    return read_images(folder / objects.text("images"), antenna) if "images" in objects else None


def _cameras(table: Table, folder: Path, images: GivenImages | None) -> Mapping[str, CameraFile]:
    default = table.text("camera")
    try:
        camera_path(default, folder)
    except InputError as error:
        raise table.error("camera", str(error)) from None
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


def _scans(table: Table, folder: Path) -> Mapping[str, Path]:
    """The scan files that the patterns find, by image name."""
    if "scans" not in table:
        return {}
    scans: dict[str, Path] = {}
    for pattern in table.texts("scans"):
        whole = folder / pattern
        found = sorted(Path(name) for name in glob.glob(str(whole)) if Path(name).is_file())
        if not found:
            raise table.error("scans", _nothing_found(pattern, whole))
        for file in found:
            name = image_name(file.name)
            if scans.get(name, file) != file:
                raise table.error("scans", f"{scans[name]} and {file} have the same name {name!r}. Rename one of them.")
            scans[name] = file
    if not scans:
        raise table.error("scans", 'is an empty list. Name files or patterns, such as ["scans/*.tif"].')
    return scans


def _nothing_found(pattern: str, whole: Path) -> str:
    folder = whole.parent
    if glob.has_magic(str(folder)):
        return f"{pattern!r} finds no file. Looked for {whole}."
    if not folder.is_dir():
        return f"{pattern!r} finds no file: there is no folder {folder.resolve()}."
    endings = sorted({file.suffix for file in folder.iterdir() if file.is_file() and file.suffix})
    holds = f"It holds files that end in {', '.join(endings)}." if endings else "It is empty."
    return f"{pattern!r} finds no file in {folder.resolve()}. {holds}"


def _pitch(table: Table) -> tuple[float, float] | None:
    if "pitch_um" not in table:
        return None
    pitch = table.number_or_pair("pitch_um")
    if not all(0.0 < value < math.inf for value in pitch):
        raise table.error("pitch_um", f"must be positive, not {list(pitch)}.")
    return pitch


def _adjust_settings(table: Table) -> AdjustSettings:
    datum = cast(Datum, table.text("datum", "control", get_args(Datum)))
    settings = AdjustSettings(
        transformation=read_transformation(table),
        datum=datum,
        datum_coordinates=_datum_choice(table, "datum_coordinates", datum, "minimal"),
        datum_points=_datum_choice(table, "datum_points", datum, "free"),
        sigma_target_um=table.number("sigma_target_um", 5.0, above=0.0),
        sigma_fiducial_um=table.number("sigma_fiducial_um", 5.0, above=0.0),
        film_sigma_um=table.number("film_sigma_um", 0.0, least=0.0),
        refraction=table.flag("refraction", False),
        earth_curvature=table.flag("earth_curvature", False),
        robust=_robust(table),
        variance_components=_variance_components(table),
        snooping=table.flag("snooping", False),
        method=cast(Method, table.text("method", "combined", get_args(Method))),
    )
    table.done()
    if settings.robust and settings.snooping:
        raise table.error("snooping", "and robust both take out gross errors. Set one of the two to false.")
    return settings


def _robust(table: Table) -> bool | WeightFunction:
    """Huber's weights are those of `true`."""
    if "robust" not in table or table.is_flag("robust"):
        return table.flag("robust", False)
    return cast(WeightFunction, table.text("robust", choices=get_args(WeightFunction)))


def _variance_components(table: Table) -> bool | tuple[str, ...]:
    if "variance_components" not in table or table.is_flag("variance_components"):
        return table.flag("variance_components", False)
    names = table.texts("variance_components")
    known = (*MEASURED_KINDS, *PRIOR_GROUPS)
    strangers = [name for name in names if name not in known]
    if strangers:
        raise table.error("variance_components", f"names {strangers[0]!r}; possible are {', '.join(known)}.")
    return names


def _datum_choice(table: Table, key: str, datum: Datum, wanted: Datum) -> tuple[str, ...]:
    """The coordinates or points that a datum names; none where the program is to choose."""
    if key not in table:
        return ()
    if datum != wanted:
        raise table.error(key, f'goes with datum = "{wanted}", and the datum here is "{datum}". Change one of the two.')
    names = table.texts(key)
    if not names:
        raise table.error(key, "is an empty list. Leave it out where the program is to choose.")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise table.error(key, f"names {twice[0]!r} twice.")
    return names


def read_transformation(table: Table) -> Transformation | None:
    """The key `transformation`; None where it is absent. Raises InputError."""
    if "transformation" not in table:
        return None
    spelling = table.text("transformation")
    try:
        film_kind(spelling)
    except ValueError as error:
        raise table.error("transformation", f"{error}.") from None
    return spelling
