"""SCENE.toml: the scene to be rendered, and the precision of its given camera, points and orientations."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, cast

import numpy as np
from pydantic import Field

from measure.marks import shapes
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, parse_camera, read_camera
from pipeline.files.library import camera_path
from pipeline.rendered.scene_project import TAKING_CAMERA, Given, SceneFile, write_project
from pipeline.rendered.scene_tables import DesignSettings, read_field
from pipeline.text import table_models as models
from pipeline.text.files import make_folder, quote_value
from pipeline.text.toml_tables import Table, read_toml
from synthetic_images import areas, scene
from synthetic_images.render import Progress, render_scene

TRUTH = "truth.json"
WRITTEN = ("project.toml", "camera.toml", "points.csv", "images.csv", TAKING_CAMERA, "scans")


def render_project(scene_path: Path, out_dir: Path, progress: Progress | None = None) -> None:
    """Render a scene: scans, truth.json and the project's files (`reseau render`). Raises InputError.

    progress: called with the image's name, the steps done and the steps of the whole scene.
    """
    scene_file = read_scene(scene_path)
    own = [name for name in WRITTEN if (out_dir / name).exists()]
    if own and not (out_dir / TRUTH).exists():  # a project that was not rendered
        raise InputError(
            f"{out_dir}: holds {' and '.join(own)}, which would be overwritten, and nothing says that they were "
            "rendered. Name another folder."
        )
    make_folder(out_dir)
    try:
        render_scene(scene_file.scene, out_dir, progress)
    except OSError as error:
        raise InputError(
            f"{out_dir}: cannot be written ({error.strerror or error}). Make room, or choose another folder."
        ) from error
    write_project(scene_file, out_dir)


def read_scene(path: Path) -> SceneFile:
    """Read SCENE.toml. Raises InputError with file, line and key."""
    return parse_scene(read_toml(path, "scene.toml"))


@models.table_model
class FilmTable(scene.SceneFilm):
    """[film] of a scene: the film, and standard deviations of the random film transformation of each frame."""

    kind: Annotated[scene.FilmKind, Field(alias="transformation")] = "affine"
    scale_sigma_ppm: models.NotNegative = 0.0
    shear_sigma_urad: models.NotNegative = 0.0


@models.table_model
class ScanTable(scene.SceneScanner):
    """[scan] of a scene: the scanner, and standard deviations of the random position of each frame on it."""

    pitch_um: models.NumberOrPair
    tone: Annotated[float | str, models.number_or_word(*scene.TONES)] = 1.0
    turn_sigma_deg: models.NotNegative = 0.0
    offset_sigma_mm: models.NotNegative = 0.0


@models.table_model
class PictureTable:
    """[picture] of a scene."""

    tones: scene.Tones = scene.Tones()
    background: scene.Background = "plain"
    ground: float = 0.0
    relief: models.NotNegative = 0.0
    pad_mm: models.NotNegative = 0.0
    pocket_mm: models.NotNegative = 0.0
    corner_radius_mm: models.NotNegative = 0.0


@models.table_model
class ImageFilmTable:
    """[image.film] of a scene; absent keys: random."""

    scale_ppm: models.NumberOrPair | None = None
    shear_urad: float | None = None
    rotation_deg: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)


@models.table_model
class ImageTable:
    """[[image]] of a scene; the position on the scanner is random if absent."""

    name: str
    position: tuple[float, float, float]
    angles_deg: tuple[float, float, float]
    pose: Annotated[str, models.choice(*scene.POSES)] = "0"
    turn_deg: float | None = None
    offset_mm: tuple[float, float] | None = None
    film: ImageFilmTable = ImageFilmTable()
    covered: tuple[str, ...] = ()
    neighbour: scene.Side | None = None
    neighbour_gap_mm: models.NotNegative = 3.0
    writing: tuple[scene.Writing, ...] = ()
    part_of: str = ""
    part: tuple[float, float] = (0.0, 1.0)


def _camera_given(value: Any) -> Any:
    if not isinstance(value, str | Mapping):
        wanted = "must be a table, [{table}], or the name of a camera's file in quotes"
        raise ValueError(f"{wanted}, not {quote_value(value)}.")
    return value


@models.table_model
class SceneTable:
    """SCENE.toml. camera: its table or the name of its file; writing: on all frames."""

    file_kind: ClassVar[str] = "scene file (`reseau template scene` prints one)"

    name: str | None = None
    seed: int = 1
    camera: Annotated[str | Mapping[str, Any], models.Key("text or table", _camera_given)]
    field: models.Values
    film: FilmTable = FilmTable()
    scan: ScanTable
    picture: PictureTable = PictureTable()
    image: tuple[ImageTable, ...] = ()
    writing: tuple[scene.Writing, ...] = ()
    given: Given = Given()
    design: DesignSettings = DesignSettings()


def parse_scene(table: Table) -> SceneFile:
    """Build the scene from the root table of a file."""
    given = models.read_model(table, SceneTable)
    camera = _camera(table)
    try:
        field, unit = read_field(table.table("field"), given.seed)
        made = scene.Scene(
            name=given.name or table.file.stem,
            seed=given.seed,
            camera=_scene_camera(camera),
            field=field,
            images=tuple(_image(image, given, number) for number, image in enumerate(given.image)),
            scanner=given.scan,
            film=given.film,
            **vars(given.picture),
        )
    except ValueError as error:
        raise InputError(f"{table.file}: {error}. Correct the scene file.") from None
    errors, wanted = given.given, table.table("design")
    design, planimetry = given.design, errors.point[0] if errors.planimetry else math.inf
    design = replace(
        design,
        sigma_planimetry=design.sigma_planimetry if "sigma_planimetry" in wanted else planimetry,
        sigma_height=design.sigma_height if "sigma_height" in wanted else errors.point[1],
    )
    return SceneFile(table.file, made, camera, unit, errors, design)


def _camera(table: Table) -> CameraFile:
    """Read the camera from the scene file, or from the camera file it names."""
    given = table.values["camera"]
    if isinstance(given, str):
        camera = read_camera(camera_path(given, table.file.parent))
    else:
        camera = parse_camera(table.table("camera"))
    if camera.frame_mm is None or camera.principal_distance_mm is None:
        raise table.error("camera", "a camera that is to take pictures needs frame_mm and principal_distance_mm.")
    return camera


def _scene_camera(camera: CameraFile) -> scene.SceneCamera:
    distortion, fiducials = camera.distortion, []
    values = {name: prior.value for name, prior in distortion.parameters.items()}
    family = cast(scene.Family, distortion.family)
    for one in camera.fiducials:
        drawn = None  # of a corner of the frame, which is rendered anyway, and of a mark without a drawing
        if one.mark is not None and not isinstance(one.mark, shapes.LearnedMark | shapes.FrameCorner):
            drawn = scene_mark(one.mark)
        fiducials.append(scene.SceneFiducial(one.id, one.xy_mm, drawn))
    return scene.SceneCamera(
        name=camera.name,
        frame_mm=camera.frame_mm or (0.0, 0.0),
        principal_distance_mm=camera.principal_distance_mm or 0.0,
        principal_point_mm=camera.principal_point_mm or (0.0, 0.0),
        distortion=scene.SceneDistortion(family, values, distortion.r0_mm, distortion.decentering),
        fiducials=tuple(fiducials),
    )


def scene_mark(mark: shapes.Mark) -> scene.DrawnMark | scene.ChipMark:
    """Mark of the scene. One without polarity is light, as most are. Polarities are those of the positive."""
    light = mark.polarity != "dark"
    if isinstance(mark, shapes.MarkShape):
        return scene.DrawnMark(tuple(_area(part) for part in mark.parts), light)
    low, high = float(mark.image.min()), float(mark.image.max())
    chip = (mark.image - low) / (high - low) if high > low else np.zeros_like(mark.image)
    return scene.ChipMark(chip, mark.pitch_um, mark.origin_px, mark.turn_deg, light)


def _area(part: shapes.Part) -> areas.Area:
    if isinstance(part, shapes.Disk):
        return areas.disk(part.center_mm, part.radius_mm)
    if isinstance(part, shapes.Ring):
        return areas.ring(part.center_mm, part.radius_mm, part.line_mm)
    if isinstance(part, shapes.Bar):
        return areas.bar(part.from_mm, part.to_mm, part.line_mm)
    return areas.polygon(part.vertices_mm)


def _image(table: ImageTable, given: SceneTable, number: int) -> scene.SceneImage:
    """One frame. Film and position on the scanner are random where the file does not give them."""
    generator = np.random.default_rng([given.seed, number, 0])
    scale = 1.0 + generator.normal(0.0, given.film.scale_sigma_ppm * 1e-6, 2)
    shear = float(generator.normal(0.0, given.film.shear_sigma_urad * 1e-6))
    if given.film.kind == "similarity":
        scale, shear = scale[[0, 0]], 0.0
    turn = float(generator.normal(0.0, given.scan.turn_sigma_deg))
    offset = generator.normal(0.0, given.scan.offset_sigma_mm, 2)
    film, x_y_z = table.film, table.position
    scale_ppm = film.scale_ppm or ((scale[0] - 1) * 1e6, (scale[1] - 1) * 1e6)
    omega, phi, kappa = (math.radians(angle) for angle in table.angles_deg)
    return scene.SceneImage(
        name=table.name,
        exterior=(*x_y_z, omega, phi, kappa),
        pose=table.pose,
        turn_rad=math.radians(turn if table.turn_deg is None else table.turn_deg),
        offset_mm=table.offset_mm or (float(offset[0]), float(offset[1])),
        film=scene.FilmTransformation(
            scale=(1.0 + scale_ppm[0] * 1e-6, 1.0 + scale_ppm[1] * 1e-6),
            shear_rad=(shear * 1e6 if film.shear_urad is None else film.shear_urad) * 1e-6,
            rotation_rad=math.radians(film.rotation_deg),
            shift_mm=film.shift_mm,
        ),
        covered=table.covered,
        neighbour=table.neighbour,
        neighbour_gap_mm=table.neighbour_gap_mm,
        writing=(*given.writing, *table.writing),
        part_of=table.part_of,
        part=table.part,
    )
