"""Project files of a rendered scene: given values with random errors, as specified in the scene."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from adjust.functional_model.lens import Prior
from measure.marks import shapes
from pipeline.files.camera_file import CameraFile, camera_text
from pipeline.files.mark_table import picture_writer
from pipeline.files.object_files import ELEMENTS
from pipeline.files.opencv_file import yaml_text
from pipeline.files.project_tables import UNITS_MM
from pipeline.rendered.scene_tables import DesignSettings
from pipeline.text.csv_table import csv_line
from pipeline.text.files import write_atomically
from pipeline.text.table_models import NotNegative, NumberOrPair, WrongKey, table_model
from pipeline.types import Array
from synthetic_images import scene as scenes
from synthetic_images.film import frame_geometry
from synthetic_images.targets import Target, field_targets

TAKING_CAMERA = "taking-camera.yaml"
NEGATIVE: Mapping[shapes.Polarity, shapes.Polarity] = {"light": "dark", "dark": "light", "auto": "auto"}


@table_model
class Given:
    """The table [given] of a scene: standard deviations of the errors of the given values.

    Attributes
    ----------
    principal_distance_mm, principal_point_mm, fiducial_mm : of the given camera.
    point : of the given coordinates X, Y and Z, object units.
    control : heights: X and Y are approximations, except those of fixed_points, which are exact.
    position : of the given exterior orientations, as a fraction of the distance to the field.
    angle_deg : of the given exterior orientations, degrees.
    """

    principal_distance_mm: Annotated[NotNegative, Field(alias="principal_distance_error_mm")] = 0.0
    principal_point_mm: Annotated[NotNegative, Field(alias="principal_point_error_mm")] = 0.0
    fiducial_mm: Annotated[NotNegative, Field(alias="fiducial_error_mm")] = 0.0
    point: Annotated[NumberOrPair, Field(alias="point_sigma")] = (0.0, 0.0)
    control: Literal["full", "heights"] = "full"
    fixed_points: tuple[str, ...] = ()
    position: Annotated[NotNegative, Field(alias="position_error")] = 0.01
    angle_deg: Annotated[NotNegative, Field(alias="angle_error_deg")] = 1.0

    def __post_init__(self) -> None:
        """Raises WrongKey for a negative standard deviation."""
        if min(self.point) < 0.0:
            raise WrongKey("point_sigma", "is a standard deviation and cannot be negative.")

    @property
    def planimetry(self) -> bool:
        """Whether X and Y are control."""
        return self.control == "full"


@dataclass(frozen=True)
class SceneFile:
    """A scene file as read.

    Attributes
    ----------
    camera : the true camera, with the priors of the given one.
    unit : of the object coordinates.
    design : settings of the network design of these photographs.
    """

    path: Path
    scene: scenes.Scene
    camera: CameraFile
    unit: str
    given: Given
    design: DesignSettings


def write_project(scene_file: SceneFile, out_dir: Path) -> None:
    """Write camera.toml, points.csv, images.csv and project.toml. Raises InputError where that is not possible."""
    generator = np.random.default_rng([scene_file.scene.seed, 20])
    camera = replace(_given_camera(scene_file, generator), path=out_dir / "camera.toml")
    write_atomically(camera.path, camera_text(camera, picture_writer(out_dir)))
    targets = field_targets(scene_file.scene.field)
    if targets:
        write_atomically(out_dir / "points.csv", _points_csv(scene_file, targets, generator))
        middle = np.asarray(np.mean([target.center for target in targets], axis=0))  # of the field
    else:  # the ground below the photographs
        stations = [image.exterior[:2] for image in scene_file.scene.images]
        middle = np.array([*np.mean(stations, axis=0), scene_file.scene.ground])
    write_atomically(out_dir / "images.csv", _images_csv(scene_file, middle, generator))
    write_atomically(out_dir / "project.toml", _project_text(scene_file))
    if scene_file.scene.scanner.lens is not None:
        write_atomically(out_dir / TAKING_CAMERA, taking_camera_yaml(scene_file.scene, scene_file.scene.scanner.lens))


def taking_camera_yaml(scene: scenes.Scene, lens: scenes.SceneTakingLens) -> str:
    """The true lens of the camera that photographed the film, for cv2.FileStorage."""
    geometry = frame_geometry(scene, 0)
    width, height = geometry.width_px, geometry.height_px
    f, (cx, cy) = lens.focal_px, lens.center_px or ((width - 1) / 2.0, (height - 1) / 2.0)
    matrix = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
    distortion = np.array([[lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]])
    size = [("image_width", width), ("image_height", height)]
    return yaml_text([*size, ("camera_matrix", matrix), ("distortion_coefficients", distortion)])


def _given_camera(scene_file: SceneFile, generator: np.random.Generator) -> CameraFile:
    """The true camera with errors. Free distortion parameters are given as 0."""
    camera, given = scene_file.camera, scene_file.given
    true = scene_file.scene.camera
    distance = true.principal_distance_mm + generator.normal(0.0, given.principal_distance_mm)
    point = np.asarray(true.principal_point_mm) + generator.normal(0.0, given.principal_point_mm, 2)
    parameters = dict(sorted(camera.distortion.parameters.items()))
    for name, prior in parameters.items():
        if prior.sigma > 0.0:
            value = 0.0 if math.isinf(prior.sigma) else float(generator.normal(prior.value, prior.sigma))
            parameters[name] = Prior(value, prior.sigma)
    fiducials = []
    for fiducial in camera.fiducials:
        xy_mm, mark = np.asarray(fiducial.xy_mm) + generator.normal(0.0, given.fiducial_mm, 2), fiducial.mark
        if isinstance(mark, shapes.Mark) and scene_file.scene.scanner.negative:
            # The scene has the polarity of the positive, the project that of its scans.
            mark = replace(mark, polarity=NEGATIVE[mark.polarity])
        fiducials.append(replace(fiducial, xy_mm=_pair(xy_mm), mark=mark))
    return replace(
        camera,
        principal_distance_mm=round(float(distance), 4),
        # Without fiducials the camera frame is the comparator's, and the principal point is estimated from the points.
        principal_point_mm=_pair(point) if camera.fiducials else None,
        distortion=replace(camera.distortion, parameters=parameters),
        fiducials=tuple(fiducials),
    )


def _pair(values: Array) -> tuple[float, float]:
    """Rounded to 0.1 µm, like the values of calibration reports."""
    return (round(float(values[0]), 4), round(float(values[1]), 4))


def _points_csv(scene_file: SceneFile, targets: tuple[Target, ...], generator: np.random.Generator) -> str:
    given, rows = scene_file.given, []
    plane, height = given.point
    for target in targets:
        error = generator.normal(0.0, 1.0, 3) * (plane, plane, height)
        sigma = f"{plane:g}" if given.planimetry else ""
        if not given.planimetry and target.id in given.fixed_points:
            error, sigma = error * (0.0, 0.0, 1.0), "0"
        cells = [target.id, *(f"{value:.6f}" for value in target.center + error), sigma, sigma, f"{height:g}"]
        rows.append([*cells, *(f"{n:.6f}" for n in target.normal)])
    return _csv(("point", "X", "Y", "Z", "sX", "sY", "sZ", "nX", "nY", "nZ"), rows)


def _images_csv(scene_file: SceneFile, middle: Array, generator: np.random.Generator) -> str:
    """images.csv; the orientation of a frame scanned in parts is given for the first part only."""
    columns = ["image", *ELEMENTS]
    images = scene_file.scene.images
    has_parts = any(image.part_of for image in images)
    rows, written = [], set[str]()
    for image in images:
        exterior = [""] * 6
        if image.frame not in written:
            station = np.asarray(image.exterior[:3])
            spread = scene_file.given.position * float(np.linalg.norm(station - middle))
            station = station + generator.normal(0.0, 1.0, 3) * spread
            angles = np.rad2deg(image.exterior[3:]) + generator.normal(0.0, scene_file.given.angle_deg, 3)
            exterior = [f"{value:.4f}" for value in (*station, *angles)]
            written.add(image.frame)
        rows.append([image.name, *exterior, *([image.part_of] if has_parts else [])])
    return _csv([*columns, *(["part_of"] if has_parts else [])], rows)


def _csv(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "".join(f"{csv_line(cells)}\n" for cells in (columns, *rows))


def _project_text(scene_file: SceneFile) -> str:
    scene, targets = scene_file.scene, field_targets(scene_file.scene.field)
    names = ", ".join(f'"scans/{image.name}.tif"' for image in scene.images)
    # The file of a photograph has no pitch.
    pitch = f'pitch_um = {scene.scanner.pitch_um[0]!r}\n\n[scanner]\nlens = "{TAKING_CAMERA}"\n'
    # Natural points give no planimetric control.
    datum = "" if targets else 'datum = "minimal"\n'
    bend = 'scanner = "auto"\n' if scene.scanner.bend_um and scene_file.camera.fiducials else ""
    points = 'points = "points.csv"\n' if targets else ""
    return f"""# Rendered from the scene "{scene.name}"; the truth is in truth.json.
camera = "camera.toml"
scans = [{names}]
comparator = "comparator.csv"
output = "out"
{pitch if scene.scanner.lens else ""}
{_targets_text(scene_file)}
[object]
{points}images = "images.csv"
unit = "{scene_file.unit}"

[adjust]
transformation = "{film_transformation(scene_file)}"
{datum}{bend}"""


def _targets_text(scene_file: SceneFile) -> str:
    field, mm = scene_file.scene.field, UNITS_MM[scene_file.unit]
    if not field_targets(field):
        # The sigma of heights includes that of the given ground and its relief.
        scene, sigma = scene_file.scene, scene_file.given.point[1]
        return f"[ties]\nheight = {scene.ground:.6g}\nheight_sigma = {np.hypot(sigma, scene.relief):.6g}\n"
    if isinstance(field, scenes.DiskField) and isinstance(field.figure, scenes.CrossFigure):
        arm = field.diameter / 2.0 * mm
        return f'[targets]\nkind = "cross"\narm_mm = {arm:.6g}\nline_mm = {field.figure.line * arm:.6g}\n'
    if isinstance(field, scenes.DiskField) and isinstance(field.figure, scenes.RingFigure):
        ring = f"[{field.figure.inner:g}, {field.figure.outer:g}]"
        return (
            f'[targets]\nkind = "coded-ring"\nbits = {field.figure.bits}\nring = {ring}\n'
            f"diameter_mm = {field.diameter * mm:.6g}\n"
        )
    if not isinstance(field, scenes.BoardField):
        return f'[targets]\nkind = "disk"\ndiameter_mm = {field.diameter * mm:.6g}\n'
    text = f'[targets]\nkind = "{field.kind}"\ncolumns = {field.columns}\nrows = {field.rows}\n'
    if field.kind == "chessboard":
        return f"{text}square_mm = {field.spacing * mm:.6g}\n"
    dots = f"spacing_mm = {field.spacing * mm:.6g}\ndiameter_mm = {field.diameter * mm:.6g}\n"
    return f"{text}{dots}asymmetric = {str(field.asymmetric).lower()}\n"


def film_transformation(scene_file: SceneFile) -> scenes.FilmKind | Literal["none"]:
    """Transformation of the scene's film; none for a camera without fiducials."""
    return scene_file.scene.film.kind if scene_file.camera.fiducials else "none"
