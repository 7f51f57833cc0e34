"""The command line: arguments in, exit codes and one clear message out.

Each command imports what it needs when it runs: numpy and what stands on it take longer than the help.
"""

import json
import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adjust.errors import AdjustmentError
from measure.errors import MeasurementError
from pipeline.archive.verdicts import Verdict
from pipeline.errors import InputError, what_to_do
from pipeline.exchange.convention import FORMATS, IMPORTED, LARGEST_MISFIT_PX, ExportOptions
from pipeline.files.pitch import FINEST_PITCH_UM
from pipeline.terminal import PlainConsole, plain, spell_out_missing_letters
from pipeline.text.finite import without_nan
from pipeline.text.wording import counted

if TYPE_CHECKING:
    from pipeline.files.project_file import Project
    from pipeline.progress import Reporter
    from pipeline.summary import Summary

DONE, LOOK, WRONG_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 3, 130
TEMPLATES = ("project", "camera", "scene")
LONGEST_LINE = 2000  # of a message: what a file has of any length may stand in it

app = typer.Typer(
    help="From scanned film photographs to comparator coordinates and a calibrated camera.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
ProjectFile = Annotated[Path, typer.Argument(metavar="PROJECT.toml", help="The project file.", show_default=False)]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")]
MaxPixels = Annotated[
    int | None,
    typer.Option("--max-pixels", metavar="N", min=1, help="Read scans of up to N pixels, whatever their file's size."),
]


Shard = Annotated[
    str | None, typer.Option(metavar="K/N", help="The K-th of N parts of the scans, into a store of its own.")
]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786, or `local`.")
]
Retry = Annotated[bool, typer.Option("--retry", help="Measure again the scans that failed.")]
Moved = Annotated[
    bool, typer.Option("--moved", help="Know moved or touched files by their content, which is read whole.")
]
Workers = Annotated[
    int | None, typer.Option(metavar="N", min=1, max=1024, help="Processes that measure; by default one a core.")
]


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 1 look at something, 2 wrong input, 3 a fault of ours,
    130 interrupted, as shells count it.

    arguments: what follows the program's name; by default what it was called with.
    """
    spell_out_missing_letters()
    try:
        code = app(args=arguments, standalone_mode=False)
        if code == INTERRUPTED:  # what typer makes of it
            told = "interrupted; files that were complete stay as they are, and scans that were measured are kept"
            return _message(told, INTERRUPTED)
        return code if isinstance(code, int) else DONE
    except typer.TyperException as error:
        return _message(error.format_message(), WRONG_INPUT)
    except (InputError, MeasurementError, AdjustmentError) as error:
        return _message(str(error), WRONG_INPUT)
    except BrokenExecutor:
        return _message(
            "a process was ended from outside, most likely because the memory was full; scans that were measured are "
            "kept. Close other programs, or take fewer --workers, and run it again.",
            WRONG_INPUT,
        )
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        return _message(f"{place}{error.strerror or error}. {what_to_do(error)}", WRONG_INPUT)
    except Exception:
        import traceback

        traceback.print_exc()
        return _message("this is a fault of reseau itself; please report it with the lines above", INTERNAL_ERROR)


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    show_version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Options that go before any command; without one, the help."""
    if show_version:
        from importlib.metadata import version

        typer.echo(f"reseau {version('reseau')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where the demonstration goes.")] = Path(
        "reseau-demo"
    ),
    as_json: AsJson = False,
) -> int:
    """Render a small scan folder with its truth, run everything on it, print the summary and the report's path."""
    from pipeline.demo import run_demo
    from pipeline.progress import Reporter

    return _finish(run_demo(folder, Reporter()), as_json)


@app.command()
def init(
    scans: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="Folders with scans, or scans.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where project.toml and images.csv go.")] = Path(),
    max_pixels: MaxPixels = None,
    as_json: AsJson = False,
) -> int:
    """Look at the scans; write a project of them, with each one's camera, and say what could not be told."""
    from pipeline.archive.new_project import init_project, print_new_project
    from pipeline.progress import Reporter

    new = init_project(scans, out, Reporter(), max_pixels)
    if as_json:
        _echo_json(new.as_json())
    else:
        print_new_project(new, PlainConsole())
    return LOOK if any(cases for _, cases in new.remarks()) else DONE


@app.command("run")
def run_project(
    project: ProjectFile,
    shard: Shard = None,
    cluster: Cluster = None,
    retry: Retry = False,
    moved: Moved = False,
    workers: Workers = None,
    as_json: AsJson = False,
    max_pixels: MaxPixels = None,
) -> int:
    """The whole chain: measure, adjust, check, report. What is measured already stays."""
    from pipeline.archive.work_options import WorkOptions
    from pipeline.stages import run_all

    work = WorkOptions(_shard(shard), cluster, retry, moved, workers)
    return _with_project(project, partial(run_all, work=work), as_json, max_pixels)


@app.command()
def measure(
    project: ProjectFile,
    shard: Shard = None,
    cluster: Cluster = None,
    retry: Retry = False,
    moved: Moved = False,
    workers: Workers = None,
    as_json: AsJson = False,
    max_pixels: MaxPixels = None,
) -> int:
    """Scans to comparator coordinates. What is measured already stays: it goes on where an earlier call stopped."""
    from pipeline.archive.work_options import WorkOptions
    from pipeline.stages import run_measure

    work = WorkOptions(_shard(shard), cluster, retry, moved, workers)
    return _with_project(project, partial(run_measure, work=work), as_json, max_pixels)


@app.command()
def status(
    project: ProjectFile,
    verdict: Annotated[
        Verdict | None, typer.Option(metavar="V", help=f"Name the scans of one: {', '.join(Verdict)}.")
    ] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="A line a scan, on stdout.")] = False,
    as_json: AsJson = False,
) -> int:
    """How many scans stand where, what that means, and what to do next."""
    from pipeline.archive.status import archive_status, print_status, status_csv, status_json

    every = archive_status(_read(project, None))
    shown = every.of(verdict)
    if as_json:
        _echo_json(status_json(shown))
    elif as_csv:
        typer.echo(plain(status_csv(shown)), nl=False)
    else:
        print_status(shown, PlainConsole(), every=verdict is not None)
    return DONE if every.all_good else LOOK


@app.command()
def merge(
    project: ProjectFile,
    stores: Annotated[list[Path], typer.Argument(metavar="DB...", help="Stores of shards.", show_default=False)],
    as_json: AsJson = False,
) -> int:
    """Join the measurement stores of shards into that of the project."""
    from pipeline.progress import Reporter
    from pipeline.stages import run_merge

    taken, summary = run_merge(_read(project, None), stores, Reporter())
    for one in taken if not as_json else ():
        typer.echo(plain(f"{one.path}: {counted(one.results, 'result')}, {one.new} of them new"))
    return _finish(summary, as_json)


def _shard(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"--shard {text!r} is not K/N, the K-th of N parts, as 3/8; K goes from 1 to N.")
    return int(found[1]), int(found[2])


@app.command()
def adjust(project: ProjectFile, as_json: AsJson = False, max_pixels: MaxPixels = None) -> int:
    """Comparator coordinates to the adjusted camera, in adjustment.json."""
    from pipeline.stages import run_adjust

    return _with_project(project, run_adjust, as_json, max_pixels)


@app.command()
def check(project: ProjectFile, as_json: AsJson = False) -> int:
    """The adjustment against OpenCV's calibration, in check.json."""
    from pipeline.stages import run_check

    return _with_project(project, run_check, as_json)


@app.command()
def choose(project: ProjectFile, as_json: AsJson = False) -> int:
    """Which transformation and distortion the observations ask for, in choose.json."""
    from pipeline.adjusting.choose_stage import choice_json, print_choice, run_choose
    from pipeline.progress import Reporter

    settings = _read(project)
    choice = run_choose(settings, Reporter())
    if as_json:
        _echo_json(choice_json(choice))
    else:
        print_choice(choice, PlainConsole(), settings.choice_path)
    return DONE if choice.chosen and choice.chosen.model == choice.given else LOOK


@app.command("resample")
def resample_scans(
    project: ProjectFile,
    out_dir: Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Where the frames go.", show_default=False)],
    pitch_um: Annotated[
        float | None,
        typer.Option("--pitch-um", metavar="UM", min=FINEST_PITCH_UM, help="The frames' pixel; by default the scan's."),
    ] = None,
    lens: Annotated[bool, typer.Option("--lens", help="Take the distortion out, too.")] = False,
    fast: Annotated[bool, typer.Option("--fast", help="Splines of degree 3 in place of 5: a tenth as true.")] = False,
    max_pixels: MaxPixels = None,
    as_json: AsJson = False,
) -> int:
    """The scans in their camera's frame: film transformation and pose taken out."""
    from pipeline.progress import Reporter
    from pipeline.resampling.resample_stage import resample, resampled_json

    results = resample(_read(project, max_pixels), out_dir, pitch_um, lens, fast, Reporter())
    if as_json:
        _echo_json(resampled_json(results))
    for result in results if not as_json else ():
        told = result.problem or f"{result.width_px} x {result.height_px} px{', as it was' if result.kept else ''}"
        clamped = f", {result.clamped} samples clamped to what can be stored" if result.clamped else ""
        typer.echo(f"{plain(result.image)}: {plain(told)}{clamped}")
    return LOOK if any(result.problem for result in results) else DONE


@app.command("export")
def export_project(
    project: ProjectFile,
    format: Annotated[str, typer.Argument(metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.", show_default=False)],
    out_dir: Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Where the files go.", show_default=False)],
    pitch_um: Annotated[
        float | None,
        typer.Option("--pitch-um", metavar="UM", min=FINEST_PITCH_UM, help="As given to `reseau resample`."),
    ] = None,
    lens: Annotated[bool, typer.Option("--lens", help="For frames of `reseau resample --lens`.")] = False,
    misfit_px: Annotated[
        float,
        typer.Option("--misfit-px", metavar="PX", min=0.0, help="How far another program's lens may be off."),
    ] = LARGEST_MISFIT_PX,
    max_pixels: MaxPixels = None,
    as_json: AsJson = False,
) -> int:
    """Marks, camera and poses as the files of another program."""
    from pipeline.exchange.export_stage import run_export

    done = run_export(_read(project, max_pixels), format, out_dir, ExportOptions(pitch_um, lens, misfit_px))
    if as_json:
        _echo_json({"folder": str(done.folder), "files": done.files, **asdict(replace(done.written, files={}))})
    else:
        typer.echo(plain(f"{done.told}\n{out_dir}: {counted(len(done.files), 'file')}"))
    return LOOK if done.written.left_out else DONE


@app.command("import")
def import_files(
    format: Annotated[str, typer.Argument(metavar="FORMAT", help=f"One of {', '.join(IMPORTED)}.", show_default=False)],
    paths: Annotated[list[Path], typer.Argument(metavar="FILE... OUT_DIR", show_default=False)],
    pitch_um: Annotated[
        float | None, typer.Option("--pitch-um", metavar="UM", min=FINEST_PITCH_UM, help="A pixel of the pictures.")
    ] = None,
    sigma_px: Annotated[
        float | None, typer.Option("--sigma-px", metavar="PX", min=1e-6, help="Of marks that bring none.")
    ] = None,
    from_middle: Annotated[
        bool, typer.Option("--from-middle", help="The principal point counts from the picture's middle.")
    ] = False,
    fiducials: Annotated[bool, typer.Option("--fiducials", help="The marks are fiducials.")] = False,
) -> int:
    """Marks, cameras, poses and certificates of other programs as files of this one."""
    from pipeline.exchange.import_stage import run_import
    from pipeline.exchange.incoming import ImportOptions

    if len(paths) < 2:
        raise InputError("name at least one FILE, and then OUT_DIR: reseau import FORMAT FILE... OUT_DIR")
    *files, folder = paths
    done = run_import(format, files, folder, ImportOptions(pitch_um, sigma_px, from_middle, fiducials))
    typer.echo(plain(f"{done.told}\n{folder}: {counted(len(done.files), 'file')}"))
    return DONE


@app.command()
def convert(
    file: Annotated[Path, typer.Argument(metavar="CAMERA.toml|adjustment.json", show_default=False)],
    family: Annotated[str, typer.Argument(metavar="FAMILY", help="See docs/distortion.md.", show_default=False)],
    out_dir: Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Where the file goes.", show_default=False)],
    r0_mm: Annotated[float, typer.Option("--r0-mm", metavar="MM", min=0.0, help="Of torlegard, aicon, juhl.")] = 0.0,
    parameters: Annotated[
        str,
        typer.Option(metavar="A,B,...", help="Those of the other family that are fitted; by default the usual ones."),
    ] = "",
    camera: Annotated[str | None, typer.Option(metavar="NAME", help="Which one, where a file holds several.")] = None,
    misfit_um: Annotated[
        float, typer.Option("--misfit-um", metavar="UM", min=0.0, help="How far the other family may be off.")
    ] = 0.1,
    as_json: AsJson = False,
) -> int:
    """A camera's lens in the words of another distortion family, with its covariance."""
    from pipeline.exchange.convert_stage import ConvertOptions, conversion_json, conversion_lines, run_convert

    named = tuple(name.strip() for name in parameters.split(",") if name.strip())
    done = run_convert(file, out_dir, ConvertOptions(family, r0_mm, named, camera))
    if as_json:
        _echo_json(conversion_json(done))
    for line in () if as_json else (*conversion_lines(done), f"{out_dir}: {counted(len(done.files), 'file')}"):
        typer.echo(plain(line))
    return LOOK if done.misfit_um > misfit_um else DONE


@app.command()
def block(
    project: ProjectFile,
    out_dir: Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Where the block goes.", show_default=False)],
    pitch_um: Annotated[
        float | None,
        typer.Option("--pitch-um", metavar="UM", min=FINEST_PITCH_UM, help="Of the pictures; by default the scans'."),
    ] = None,
    max_pixels: MaxPixels = None,
    as_json: AsJson = False,
) -> int:
    """Overlapping frames without any orientation: oriented by COLMAP, then adjusted with films, lens and control."""
    from pipeline.blocks.block_stage import block_lines, run_block
    from pipeline.progress import Reporter
    from pipeline.stages import run_adjust

    reporter = Reporter()
    oriented = run_block(_read(project, max_pixels), out_dir, pitch_um, reporter)
    summary = run_adjust(oriented.project, reporter)
    for line in () if as_json else block_lines(oriented):
        typer.echo(plain(line))
    code = _finish(summary, as_json)
    return max(code, LOOK) if oriented.left_out else code


@app.command()
def compare(
    adjustments: Annotated[
        list[Path], typer.Argument(metavar="A/adjustment.json B/adjustment.json...", show_default=False)
    ],
    camera: Annotated[str | None, typer.Option(metavar="NAME", help="Which one, where a file holds several.")] = None,
    times: Annotated[str | None, typer.Option(metavar="T,T,...", help="When they were made: 1952,1958.5.")] = None,
    flat: Annotated[
        bool, typer.Option("--flat", help="For use over flat ground, where height and place take up c and the point.")
    ] = False,
    level: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Drift is said where chance makes as much more rarely than this.")
    ] = 0.01,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Write compare.json and compare.png there.")] = None,
    as_json: AsJson = False,
) -> int:
    """Calibrations of a camera: where and by how much they differ over the frame; `drift` or `no drift`."""
    from pipeline.adjusting.compare_stage import DRIFT, comparison_json, print_comparison, run_compare, verdict

    when = None if times is None else _numbers(times)
    comparison, remarks = run_compare(adjustments, camera, when, "flat" if flat else "space", level, out)
    if as_json:
        _echo_json(comparison_json(comparison, remarks, level))
    else:
        print_comparison(comparison, remarks, level, PlainConsole())
    return LOOK if verdict(comparison, level) == DRIFT else DONE


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--times {text!r} are not numbers with commas between them, as in 1952,1958.5.") from None


@app.command()
def report(
    project: ProjectFile,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="After --frames: more images.", show_default=False)
    ] = None,
    frames: Annotated[
        list[str] | None,
        typer.Option("--frames", metavar="NAME", help="Only pages of these images, in out/frames, with all marks."),
    ] = None,
    as_json: AsJson = False,
    max_pixels: MaxPixels = None,
) -> int:
    """What the earlier stages found, in report.html; or all of some images, each in a page of its own."""
    from pipeline.stages import run_frame_pages, run_report

    if frames:
        from pipeline.progress import Reporter

        images = list(dict.fromkeys([*frames, *(names or ())]))
        pages = run_frame_pages(_read(project, max_pixels), images, Reporter())
        if as_json:
            _echo_json({"frames": {image: str(path) for image, path in pages.items()}})
        for image, path in pages.items() if not as_json else ():
            typer.echo(plain(f"{image}: {path}"))
        return DONE
    if names:
        raise InputError("images are named after --frames: reseau report PROJECT.toml --frames NAME...")
    return _with_project(project, run_report, as_json, max_pixels)


@app.command()
def review(
    project: ProjectFile,
    port: Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="Of this machine; 0 takes any.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open no browser.")] = False,
    who: Annotated[str | None, typer.Option(metavar="NAME", help="Who decides; by default who is logged in.")] = None,
    max_pixels: MaxPixels = None,
) -> int:
    """A page on this machine to go through what needs a look; decisions stand in decisions.jsonl."""
    try:
        from pipeline.review.server import serve
    except ModuleNotFoundError:
        raise InputError("review needs starlette and uvicorn. Install them: pip install 'reseau[review]'.") from None
    serve(_read(project, max_pixels), port, who, not no_browser, typer.echo)
    return DONE


@app.command()
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene file.", show_default=False)],
    out_dir: Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Where the project goes.", show_default=False)],
) -> int:
    """Synthetic scans with their truth, as a project that can be run."""
    from pipeline.progress import Reporter
    from pipeline.rendered.scene_file import render_project

    with Reporter().stage("rendering") as count:
        render_project(scene, out_dir, count)
    typer.echo(plain(f"{out_dir / 'project.toml'}"))
    return DONE


@app.command()
def design(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene file.", show_default=False)],
    out_dir: Annotated[
        Path | None, typer.Argument(metavar="[OUT_DIR]", help="Where design.json goes; SCENE-design by default.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """The precision to be expected of a scene's photographs, without any picture, and what would improve it."""
    from pipeline.design.run import run_design
    from pipeline.progress import Reporter

    planned = run_design(scene, out_dir, Reporter())
    if as_json:
        _echo_json(planned.content)
    else:
        planned.print(PlainConsole())
    return LOOK if planned.needs_a_look else DONE


@app.command()
def template(
    kind: Annotated[str, typer.Argument(metavar="KIND", help=f"One of {', '.join(TEMPLATES)}.", show_default=False)],
) -> int:
    """Print a commented file to start from."""
    if kind not in TEMPLATES:
        raise InputError(f"there is no template {kind!r}; possible are {', '.join(TEMPLATES)}.")
    from importlib import resources

    typer.echo(resources.files("pipeline").joinpath("templates", f"{kind}.toml").read_text(encoding="utf-8"), nl=False)
    return DONE


@app.command()
def cameras(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]", help="Print this camera's file, to start from. After --scan: more scans."),
    ] = None,
    scan: Annotated[
        list[Path] | None,
        typer.Option(
            "--scan", metavar="PATH", help="Try the cameras on a scan, or on some of a folder's, of each kind."
        ),
    ] = None,
    own: Annotated[
        Path | None,
        typer.Option("--project", metavar="PROJECT.toml", help="Try its camera files, too; its scans without --scan."),
    ] = None,
    pitch_um: Annotated[
        float | None,
        typer.Option("--pitch", metavar="UM", min=FINEST_PITCH_UM, help="The scan's pixel in um, if its file is mute."),
    ] = None,
    max_pixels: MaxPixels = None,
    as_json: AsJson = False,
) -> int:
    """The camera library: its list, one of its files, or which of its cameras scans are of."""
    if own is not None or scan is not None:
        project = None if own is None else _read(own)
        given = [*(scan or ()), *(Path(name) for name in names or ())] or (project.scans.values() if project else ())
        return _name_cameras(list(given), project, pitch_um, max_pixels, as_json)
    if (names and (as_json or len(names) > 1)) or pitch_um is not None:
        raise InputError("give NAME alone, or --scan with or without --pitch, or neither for the list.")
    from pipeline.files.library import PREFIX, library_json, library_path, print_library

    if names:
        typer.echo(library_path(names[0].removeprefix(PREFIX)).read_text(encoding="utf-8"), nl=False)
    elif as_json:
        _echo_json(library_json())
    else:
        print_library(PlainConsole())
    return DONE


def _name_cameras(
    given: Sequence[Path], project: "Project | None", pitch_um: float | None, max_pixels: int | None, as_json: bool
) -> int:
    """One scan with all that was tried on it; of many some of each kind."""
    from pipeline.files.library import PREFIX, read_library
    from pipeline.measuring.camera_answer import print_identification
    from pipeline.measuring.camera_trials import identify
    from pipeline.measuring.scan_kinds import identify_kinds, print_kinds, scan_files
    from pipeline.progress import Reporter

    own = {name: camera for name, camera in project.cameras.items() if PREFIX not in name} if project else {}
    tried, reporter = {**own, **read_library()}, Reporter()
    if len(given) == 1 and not given[0].is_dir():
        identification = identify(given[0], tried, pitch_um, reporter, max_pixels)
        if as_json:
            _echo_json(identification.as_json())
        else:
            print_identification(identification, PlainConsole())
        return DONE if identification.best else LOOK
    many = identify_kinds(scan_files(given), lambda path: identify(path, tried, pitch_um, reporter, max_pixels))
    if as_json:
        _echo_json(many.as_json())
    else:
        print_kinds(many, PlainConsole())
    return DONE if many.all_named else LOOK


def _with_project(
    path: Path, stage: "Callable[[Project, Reporter], Summary]", as_json: bool, max_pixels: int | None = None
) -> int:
    from pipeline.progress import Reporter

    return _finish(stage(_read(path, max_pixels), Reporter()), as_json)


def _read(path: Path, max_pixels: int | None = None) -> "Project":
    from pipeline.files.project_file import read_project

    return replace(read_project(path), max_pixels=max_pixels)


def _finish(summary: "Summary", as_json: bool) -> int:
    from pipeline.summary import print_summary

    if as_json:
        _echo_json(summary.as_json())
    else:
        print_summary(summary, PlainConsole())
    return summary.verdict.exit_code


def _echo_json(content: Any) -> None:
    letters = (sys.stdout.encoding or "").lower().startswith("utf")  # others get them as JSON's own codes
    typer.echo(json.dumps(without_nan(content), indent=1, ensure_ascii=not letters, allow_nan=False))


def _message(text: str, code: int) -> int:
    lines = (line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..." for line in plain(text).split("\n"))
    typer.echo("reseau: " + "\n".join(lines), err=True)
    return code
