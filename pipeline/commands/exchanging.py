"""Commands that write files: rectified scans, exchange formats, converted lenses, synthetic scans, templates."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import shared
from pipeline.errors import InputError
from pipeline.exchange.formats import FORMATS, IMPORTED, LARGEST_MISFIT_PX, ExportOptions
from pipeline.text.wording import counted, did_you_mean

TEMPLATES = ("project", "camera", "scene", "keys")
# `FAMILY_NAMES`, without numpy
FAMILIES = (
    "none, torlegard, brown, australis, aicon, opencv, opencv_fisheye, juhl, ebner, gruen, legendre(n), fourier(n)"
)


def resample(
    project: shared.ProjectFile,
    out_dir: shared.OutDir,
    pitch_um: Annotated[float | None, shared.pitch_option("The frames' pixel; by default the scan's.")] = None,
    lens: Annotated[bool, typer.Option("--lens", help="Take the distortion out, too.")] = False,
    fast: Annotated[bool, typer.Option("--fast", help="Splines of degree 3, not 5: faster, less exact.")] = False,
    max_pixels: shared.MaxPixels = None,
    as_json: shared.AsJson = False,
) -> int:
    """Rectify scans into the camera frame."""
    from pipeline.resampling.resample_stage import Resampled, resample, resampled_json
    from pipeline.terminal import Reporter

    def line(result: Resampled) -> str:
        outcome = result.problem or f"{result.width_px} x {result.height_px} px{', as it was' if result.kept else ''}"
        clamped = f", {result.clamped} samples clamped to what can be stored" if result.clamped else ""
        doubt = f"; needs a look: {result.doubt}" if result.doubt else ""
        return f"{result.image}: {outcome}{clamped}{doubt}"

    results = resample(shared.read(project, max_pixels), out_dir, pitch_um, lens, fast, Reporter())
    shared.show(as_json, lambda: resampled_json(results), lambda _: shared.say(*map(line, results)))
    same = [*(("--pitch-um", f"{pitch_um:g}") if pitch_um else ()), *(("--lens",) if lens else ())]
    shared.print_next(
        as_json,
        shared.command_step("export", project, "opencv", "DIR", *same, why="or colmap, asp: cameras of these frames"),
    )
    return shared.LOOK if any(result.problem or result.doubt for result in results) else shared.DONE


def export(
    project: shared.ProjectFile,
    format: Annotated[str, typer.Argument(metavar="FORMAT", help=shared.choices_help(FORMATS), show_default=False)],
    out_dir: shared.OutDir,
    pitch_um: Annotated[float | None, shared.pitch_option("As given to `reseau resample`.")] = None,
    lens: Annotated[bool, typer.Option("--lens", help="For frames of `reseau resample --lens`.")] = False,
    misfit_px: Annotated[
        float, typer.Option("--misfit-px", metavar="PX", min=0.0, help="How far another program's lens may be off.")
    ] = LARGEST_MISFIT_PX,
    max_pixels: shared.MaxPixels = None,
    as_json: shared.AsJson = False,
) -> int:
    """Write files for another program."""
    from pipeline.exchange.exchange_stage import run_export

    done = run_export(shared.read(project, max_pixels), format, out_dir, ExportOptions(pitch_um, lens, misfit_px))
    shared.show(
        as_json,
        lambda: {
            "folder": str(out_dir),
            "files": tuple(done.files),
            "lost": done.lost,
            "notes": done.notes,
            "left_out": done.left_out,
        },
        lambda _: shared.say(done.readme_text, f"{out_dir}: {counted(len(done.files), 'file')}"),
    )
    return shared.LOOK if done.left_out else shared.DONE


def import_(
    format: Annotated[str, typer.Argument(metavar="FORMAT", help=shared.choices_help(IMPORTED), show_default=False)],
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="FILE... OUT_DIR", help="Files to read, and where the results go.", show_default=False),
    ],
    pitch_um: Annotated[float | None, shared.pitch_option("Side of a pixel.")] = None,
    sigma_px: Annotated[
        float | None,
        typer.Option("--sigma-px", metavar="PX", min=1e-6, help="Standard deviation of marks that have none."),
    ] = None,
    from_middle: Annotated[
        bool, typer.Option("--from-middle", help="The principal point counts from the picture's middle.")
    ] = False,
    fiducials: Annotated[bool, typer.Option("--fiducials", help="The marks are fiducials.")] = False,
) -> int:
    """Read files of another program, or a certificate."""
    from pipeline.exchange.exchange_stage import run_import
    from pipeline.exchange.incoming import ImportOptions

    if len(paths) < 2:
        raise InputError("name at least one FILE, and then OUT_DIR: reseau import FORMAT FILE... OUT_DIR")
    *files, folder = paths
    done = run_import(format, files, folder, ImportOptions(pitch_um, sigma_px, from_middle, fiducials))
    shared.say(done.readme_text, f"{folder}: {counted(len(done.files), 'file')}")
    shared.print_next(
        False,
        shared.command_step("template project > project.toml", why=f"and name the files of {folder} in it"),
        shared.command_step("run", "project.toml"),
    )
    return shared.LOOK if done.left_out else shared.DONE


def convert(
    file: Annotated[Path, typer.Argument(metavar="CAMERA.toml|adjustment.json", help="The lens.", show_default=False)],
    family: Annotated[str, typer.Argument(metavar="FAMILY", help=f"One of {FAMILIES}.", show_default=False)],
    out_dir: shared.OutDir,
    r0_mm: Annotated[
        float,
        typer.Option(
            "--r0-mm", metavar="MM", min=0.0, help="Second zero of the radial distortion (torlegard, aicon, juhl)."
        ),
    ] = 0.0,
    parameters: Annotated[
        str, typer.Option(metavar="A,B,...", help="Parameters of the other family to fit; by default the usual ones.")
    ] = "",
    camera: shared.OfCamera = None,
    misfit_um: Annotated[
        float, typer.Option("--misfit-um", metavar="UM", min=0.0, help="How far the other family may be off.")
    ] = 0.1,
    as_json: shared.AsJson = False,
) -> int:
    """Convert a lens into another distortion family."""
    from pipeline.exchange.convert_stage import ConvertOptions, run_convert

    named = tuple(name.strip() for name in parameters.split(",") if name.strip())
    done = run_convert(file, out_dir, ConvertOptions(family, r0_mm, named, camera))
    files = f"{out_dir}: {counted(len(done.files), 'file')}"
    shared.show(as_json, done.as_json, lambda _: shared.say(*done.lines(), files))
    line = f'camera = "{out_dir / "camera.toml"}" in project.toml'
    if "camera.toml" not in done.files:
        line = f'calibration = "{out_dir / "adjustment.json"}" under [sigma] in the camera file'
    shared.print_next(as_json, f"{line}, then reseau run")
    return shared.LOOK if done.misfit_um > misfit_um else shared.DONE


def render(scene: shared.SceneFile, out_dir: shared.OutDir) -> int:
    """Render synthetic scans with their truth."""
    from pipeline.rendered.scene_file import render_project
    from pipeline.terminal import Reporter

    with Reporter().stage("rendering strip") as count:
        render_project(scene, out_dir, count)
    shared.say(str(out_dir / "project.toml"))
    shared.print_next(False, shared.command_step("run", out_dir / "project.toml"))
    return shared.DONE


def template(
    kind: Annotated[str, typer.Argument(metavar="KIND", help=shared.choices_help(TEMPLATES), show_default=False)],
    marks: Annotated[
        str | None,
        typer.Option(metavar="KIND[,KIND]", help="Kinds of the marks in corners and side middles (template camera)."),
    ] = None,
    square: Annotated[
        str | None, typer.Option(metavar="MM", help="Distance of the corner marks: 212, or 212x150.")
    ] = None,
    side: Annotated[str | None, typer.Option(metavar="MM", help="Distance of opposite side marks.")] = None,
    frame: Annotated[
        str | None, typer.Option(metavar="MM", help="The exposed frame; by default as the marks say.")
    ] = None,
    distance: Annotated[float | None, typer.Option("--c", metavar="MM", min=1.0, help="Principal distance.")] = None,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name of the camera.")] = "my camera",
) -> int:
    """Print a commented file to start from, or all keys."""
    if kind not in TEMPLATES:
        possible = f"{', '.join(TEMPLATES)}.{did_you_mean(kind, TEMPLATES)}"
        raise InputError(f"there is no template {kind!r}; possible are {possible}")
    is_sized = any(option is not None for option in (marks, square, side, frame, distance))
    if is_sized and (kind != "camera" or marks is None):
        raise InputError("--square, --side, --frame and --c go with `reseau template camera --marks KIND`.")
    if marks is not None:
        from pipeline.files.library import CameraSizes, camera_template

        text = camera_template(CameraSizes.from_words(marks, square, side, frame, distance, name))
    elif kind == "keys":
        from pipeline.files.project_tables import keys_text

        text = keys_text()
    else:
        from importlib import resources

        text = resources.files("pipeline").joinpath("templates", f"{kind}.toml").read_text(encoding="utf-8")
    typer.echo(text, nl=False)
    return shared.DONE
