"""SCENE.toml: the scene to be rendered, and the precision of its given camera, points and orientations."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar, cast, get_args

import numpy as np

from measure.marks import shapes
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, parse_camera, read_camera
from pipeline.files.library import camera_path
from pipeline.rendered.design_table import read_design
from pipeline.rendered.field_table import read_field
from pipeline.rendered.scene_project import Given, SceneFile, write_project
from pipeline.text.tables import Table, read_toml
from synthetic_images import areas, scene
from synthetic_images.render import Progress, render_scene

Made = TypeVar("Made")

TRUTH = "truth.json"
WRITTEN = ("project.toml", "camera.toml", "points.csv", "images.csv")


def render_project(scene_path: Path, out_dir: Path, progress: Progress | None = None) -> None:
    """Render a scene: scans, truth.json and the project's files (`reseau render`). Raises InputError.

    Parameters
    ----------
    progress : called with the image's name, the steps done and the steps of the whole scene.
    """
    scene_file = read_scene(scene_path)
    _check_free(out_dir)
    try:
        render_scene(scene_file.scene, out_dir, progress)
    except OSError as error:
        raise InputError(
            f"{out_dir}: cannot be written ({error.strerror or error}). Make room, or choose another folder."
        ) from error
    write_project(scene_file, out_dir)


def _check_free(out_dir: Path) -> None:
    """Raise InputError for a folder with a project that was not rendered: a rendered one holds truth.json."""
    own = [name for name in WRITTEN if (out_dir / name).exists()]
    if own and not (out_dir / TRUTH).exists():
        raise InputError(
            f"{out_dir}: holds {' and '.join(own)}, which would be overwritten, and nothing says that they were "
            "rendered. Name another folder."
        )


def read_scene(path: Path) -> SceneFile:
    """Read SCENE.toml. Raises InputError with file, line and key."""
    return parse_scene(read_toml(path))


def parse_scene(table: Table) -> SceneFile:
    """Build the scene from the root table of a file."""
    path = table.file
    seed = table.whole("seed", 1)
    camera = _camera(table)
    field_table = table.table("field")
    unit = field_table.text("unit", "m", ("m", "dm", "cm", "mm"))
    field = _build(path, lambda: read_field(field_table, unit, seed))
    field_table.done()
    film_table, scanner_table, picture = table.table("film"), table.table("scan"), table.table("picture")
    film = _build(path, lambda: _film(film_table))
    scanner = _build(path, lambda: _scanner(scanner_table))
    laws = _Laws.read(film_table, scanner_table, film.kind)
    images, on_all = table.tables("image"), _build(path, lambda: _writing(table))
    generators = [np.random.default_rng([seed, index, 0]) for index in range(len(images))]
    made = _build(
        path,
        lambda: scene.Scene(
            name=table.text("name", path.stem),
            seed=seed,
            camera=_scene_camera(camera),
            field=field,
            images=tuple(_image(image, laws, g, on_all) for image, g in zip(images, generators, strict=True)),
            scanner=scanner,
            film=film,
            tones=_tones(picture.table("tones")),
            background=cast(scene.Background, picture.text("background", "plain", get_args(scene.Background))),
            ground=picture.number("ground", 0.0),
            relief=picture.number("relief", 0.0, least=0.0),
            pad_mm=picture.number("pad_mm", 0.0, least=0.0),
            pocket_mm=picture.number("pocket_mm", 0.0, least=0.0),
            corner_radius_mm=picture.number("corner_radius_mm", 0.0, least=0.0),
        ),
    )
    given = _read_given(table.table("given"))
    design = read_design(table.table("design"), given.point[0] if given.planimetry else math.inf, given.point[1])
    for part in (film_table, scanner_table, picture, table):
        part.done()
    return SceneFile(path, made, camera, unit, given, design)


def _build(path: Path, make: Callable[[], Made]) -> Made:
    """Build a part of the scene; a ValueError becomes an InputError for the file."""
    try:
        return make()
    except ValueError as error:
        raise InputError(f"{path}: {error}. Correct the scene file.") from None


def _camera(table: Table) -> CameraFile:
    """Read the camera from the scene file, or from the camera file it names."""
    if isinstance(table.values.get("camera"), str):
        camera = read_camera(camera_path(table.text("camera"), table.file.parent))
    else:
        camera = parse_camera(table.table("camera"))
    if camera.frame_mm is None or camera.principal_distance_mm is None:
        raise table.error("camera", "a camera that is to take pictures needs frame_mm and principal_distance_mm.")
    return camera


def _scene_camera(camera: CameraFile) -> scene.SceneCamera:
    return scene.SceneCamera(
        name=camera.name,
        frame_mm=camera.frame_mm or (0.0, 0.0),
        principal_distance_mm=camera.principal_distance_mm or 0.0,
        principal_point_mm=camera.principal_point_mm or (0.0, 0.0),
        distortion=scene.Distortion(
            cast(scene.Family, camera.distortion.family),
            {name: prior.value for name, prior in camera.distortion.parameters.items()},
            camera.distortion.r0_mm,
            camera.distortion.decentering,
        ),
        fiducials=tuple(scene.SceneFiducial(one.id, one.xy_mm, _painted(one.mark)) for one in camera.fiducials),
    )


def _painted(mark: shapes.Mark | shapes.LearnedMark | None) -> scene.DrawnMark | scene.ChipMark | None:
    """Mark to be drawn; None for a corner of the frame, which is rendered anyway, and for a mark without a drawing."""
    return None if mark is None or isinstance(mark, shapes.LearnedMark | shapes.FrameCorner) else scene_mark(mark)


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


def _film(table: Table) -> scene.Film:
    return scene.Film(
        kind=cast(scene.FilmKind, table.text("transformation", "affine", get_args(scene.FilmKind))),
        tilt_deg=table.number("tilt_deg", 0.0),
        tilt_direction_deg=table.number("tilt_direction_deg", 0.0),
        photographed_from_mm=table.number("photographed_from_mm", 600.0, above=0.0),
        deformation_um=table.number("deformation_um", 0.0),
        grain=table.number("grain", 0.0),
        grain_px=table.number("grain_px", 1.0),
        dust=table.whole("dust", 0),
        scratches=table.whole("scratches", 0),
        hairs=table.whole("hairs", 0),
    )


def _scanner(table: Table) -> scene.Scanner:
    bend = table.table("bend_um")
    bend_um = {name: bend.number(name) for name in sorted(bend.values)}
    return scene.Scanner(
        pitch_um=table.number_or_pair("pitch_um"),
        margin_mm=table.number("margin_mm", 5.0),
        blur_px=table.number("blur_px", 0.7),
        noise=table.number("noise", 0.0),
        bit_depth=cast(Literal[8, 16], table.whole("bit_depth", 16)),
        colour=table.flag("colour", False),
        negative=table.flag("negative", False),
        white_is_zero=table.flag("white_is_zero", False),
        compression=cast(scene.Compression, table.text("compression", "none", get_args(scene.Compression))),
        tile_px=table.whole("tile_px", 256),
        tone=table.number_or_text("tone", 1.0, scene.TONES, above=0.0),
        bend_um=bend_um,
        sharpen=_unsharp_mask(table.table("sharpen")),
        lens=_taking_lens(table.table("lens")) if "lens" in table else None,
    )


def _taking_lens(table: Table) -> scene.TakingLens:
    lens = scene.TakingLens(
        focal_px=table.number("focal_px", above=0.0),
        center_px=table.pair("center_px") if "center_px" in table else None,
        **{name: table.number(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")},
    )
    table.done()
    return lens


def _unsharp_mask(table: Table) -> scene.UnsharpMask:
    usual = scene.UnsharpMask()
    mask = scene.UnsharpMask(
        amount=table.number("amount", usual.amount, least=0.0),
        radius_px=table.number("radius_px", usual.radius_px, above=0.0),
    )
    table.done()
    return mask


def _tones(table: Table) -> scene.Tones:
    usual = scene.Tones()
    tones = scene.Tones(**{name: table.number(name, value) for name, value in vars(usual).items()})
    table.done()
    return tones


@dataclass(frozen=True)
class _Laws:
    """Standard deviations of the random film transformation of each frame and its position on the scanner."""

    kind: scene.FilmKind
    scale_ppm: float
    shear_urad: float
    turn_deg: float
    offset_mm: float

    @staticmethod
    def read(film: Table, scan: Table, kind: scene.FilmKind) -> "_Laws":
        return _Laws(
            kind,
            film.number("scale_sigma_ppm", 0.0, least=0.0),
            film.number("shear_sigma_urad", 0.0, least=0.0),
            scan.number("turn_sigma_deg", 0.0, least=0.0),
            scan.number("offset_sigma_mm", 0.0, least=0.0),
        )


def _image(
    table: Table, laws: _Laws, generator: np.random.Generator, on_all: tuple[scene.Writing, ...]
) -> scene.SceneImage:
    """One frame. Film and position on the scanner are random where the file does not give them. on_all: text on all
    frames."""
    scale = 1.0 + generator.normal(0.0, laws.scale_ppm * 1e-6, 2)
    shear = float(generator.normal(0.0, laws.shear_urad * 1e-6))
    if laws.kind == "similarity":
        scale, shear = scale[[0, 0]], 0.0
    turn = float(generator.normal(0.0, laws.turn_deg))
    offset = generator.normal(0.0, laws.offset_mm, 2)
    film = table.table("film")
    scale_ppm = film.number_or_pair("scale_ppm", ((scale[0] - 1) * 1e6, (scale[1] - 1) * 1e6))
    image = scene.SceneImage(
        name=table.text("name"),
        exterior=_exterior(table),
        pose=table.text("pose", "0", scene.POSES),
        turn_rad=math.radians(table.number("turn_deg", turn)),
        offset_mm=table.pair("offset_mm", (float(offset[0]), float(offset[1]))),
        film=scene.FilmTransformation(
            scale=(1.0 + scale_ppm[0] * 1e-6, 1.0 + scale_ppm[1] * 1e-6),
            shear_rad=film.number("shear_urad", shear * 1e6) * 1e-6,
            rotation_rad=math.radians(film.number("rotation_deg", 0.0)),
            shift_mm=film.pair("shift_mm", (0.0, 0.0)),
        ),
        covered=table.texts("covered") if "covered" in table else (),
        neighbour=cast(scene.Side, table.text("neighbour", choices=get_args(scene.Side)))
        if "neighbour" in table
        else None,
        neighbour_gap_mm=table.number("neighbour_gap_mm", 3.0, least=0.0),
        writing=(*on_all, *_writing(table)),
        part_of=table.text("part_of", ""),
        part=table.pair("part", (0.0, 1.0)),
    )
    film.done()
    table.done()
    return image


def _writing(table: Table) -> tuple[scene.Writing, ...]:
    lines = []
    for entry in table.tables("writing"):
        line = scene.Writing(
            text=entry.text("text"),
            xy_mm=entry.pair("xy_mm"),
            height_mm=entry.number("height_mm"),
            turn_deg=entry.number("turn_deg", 0.0),
            mirrored=entry.flag("mirrored", False),
            font=entry.text("font", scene.Writing.font),
        )
        entry.done()
        lines.append(line)
    return tuple(lines)


def _exterior(table: Table) -> tuple[float, float, float, float, float, float]:
    x, y, z = table.triple("position")
    omega, phi, kappa = (math.radians(angle) for angle in table.triple("angles_deg"))
    return (x, y, z, omega, phi, kappa)


def _read_given(table: Table) -> Given:
    given = Given(
        principal_distance_mm=table.number("principal_distance_error_mm", 0.0, least=0.0),
        principal_point_mm=table.number("principal_point_error_mm", 0.0, least=0.0),
        fiducial_mm=table.number("fiducial_error_mm", 0.0, least=0.0),
        point=table.number_or_pair("point_sigma", (0.0, 0.0)),
        planimetry=table.text("control", "full", ("full", "heights")) == "full",
        fixed_points=table.texts("fixed_points") if "fixed_points" in table else (),
        position=table.number("position_error", 0.01, least=0.0),
        angle_deg=table.number("angle_error_deg", 1.0, least=0.0),
    )
    if min(given.point) < 0.0:
        raise table.error("point_sigma", "is a standard deviation and cannot be negative.")
    table.done()
    return given
