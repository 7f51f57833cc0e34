"""Commands for scans: create projects, measure marks, report status, review, identify cameras."""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.archive.verdicts import Verdict
from pipeline.commands import shared
from pipeline.errors import InputError, missing_extra
from pipeline.terminal import PlainConsole, plain
from pipeline.text.files import make_folder, no_such_file
from pipeline.text.wording import counted

if TYPE_CHECKING:
    from pipeline.files.project_file import Project

PROJECT = "project.toml"
SCENE = ("scenes", "demo.toml")  # of the demonstration, in synthetic_images
LIBRARY_STEP = shared.command_step(
    "cameras NAME > camera.toml", why="a camera file to start from; or: reseau template camera"
)


def demo(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where the demonstration goes.")] = Path(
        "reseau-demo"
    ),
    as_json: shared.AsJson = False,
) -> int:
    """Render five film frames and run everything on them."""
    from pipeline.files.project_file import read_project
    from pipeline.rendered.scene_file import TRUTH, render_project
    from pipeline.stages import run_all
    from pipeline.terminal import Reporter

    make_folder(folder)
    if any(folder.iterdir()) and not (folder / TRUTH).exists():
        raise InputError(f"{folder}: holds something that is no demonstration. Name another folder: reseau demo DIR")
    scene = resources.as_file(resources.files("synthetic_images").joinpath(*SCENE))
    reporter, project = Reporter(), folder / PROJECT
    with scene as path, reporter.stage("rendering strip") as count:
        render_project(path, folder, count)
    return shared.finish(run_all(read_project(project), reporter), as_json, project)


def init(
    scans: Annotated[
        list[str],
        typer.Argument(
            metavar="FOLDER_OR_URL...",
            help="Folders with scans, or scans; addresses, s3:// or https://, of such; or lists of them, NAME.txt.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where project.toml and images.csv go.")] = Path(),
    max_pixels: shared.MaxPixels = None,
    quiet: shared.Quiet = False,
    as_json: shared.AsJson = False,
) -> int:
    """Write a project for a folder of scans, cameras named."""
    from measure.scans.remote import scan_path
    from pipeline.archive.new_project import init_project, print_new_project
    from pipeline.terminal import Reporter

    new = init_project([scan_path(text) for text in scans], out, Reporter(quiet=quiet), max_pixels)
    shared.show(as_json, new.as_json, lambda console: print_new_project(new, console))
    run_step = [shared.command_step("run", new.folder / PROJECT)] if new.named else []
    shared.print_next(as_json, *shared.init_steps(new), *run_step)
    return shared.LOOK if new.needs_review else shared.DONE


Shard = Annotated[
    str | None,
    typer.Option(metavar="K/N", help="The K-th of N parts of the scans, with a results database of its own."),
]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786, or `local`.")
]
Retry = Annotated[bool, typer.Option("--retry", help="Measure again the scans that failed.")]
Moved = Annotated[bool, typer.Option("--moved", help="Recognise moved files by a hash of their content.")]
Workers = Annotated[
    int | None, typer.Option(metavar="N", min=1, max=1024, help="Processes that measure; by default one a core.")
]


def run(
    project: Annotated[
        Path,
        typer.Argument(
            metavar="PROJECT.toml|FOLDER",
            help="The project file, or a folder with it; or a folder of film scans, of which a project is made.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where a folder's project goes; by default into the folder.")
    ] = None,
    shard: Shard = None,
    cluster: Cluster = None,
    retry: Retry = False,
    moved: Moved = False,
    workers: Workers = None,
    quiet: shared.Quiet = False,
    as_json: shared.AsJson = False,
    max_pixels: shared.MaxPixels = None,
) -> int:
    """Measure, adjust, check and report.

    Goes on where an earlier call stopped. A folder of film scans without a project gets one first, as by `reseau init`.
    """
    from pipeline.stages import run_all
    from pipeline.summary import print_summary
    from pipeline.terminal import Reporter
    from pipeline.workers import WorkOptions

    work, reporter = WorkOptions(_shard(shard), cluster, retry, moved, workers), Reporter(quiet=quiet)
    if out is not None and not project.is_dir():
        raise InputError(f"--out goes with a folder of scans, and {project} is none: its project file says `output`.")
    if not project.exists():
        raise InputError(f"{no_such_file(project)} Name project.toml, or a folder of scans.")
    file = (out or project) / PROJECT if project.is_dir() else project
    new = None
    if project.is_dir() and not file.exists():
        from pipeline.archive.new_project import init_project, print_new_project

        new = init_project([project], file.parent, reporter, max_pixels)
        if not as_json:
            print_new_project(new, PlainConsole())
        if not new.named:
            shared.show(as_json, new.as_json, lambda _: None)
            shared.print_next(as_json, *shared.init_steps(new))
            return shared.LOOK
    summary = run_all(shared.read(file, max_pixels), reporter, work)
    record = summary.as_json if new is None else lambda: {**summary.as_json(), "init": new.as_json()}
    shared.show(as_json, record, lambda console: print_summary(summary, console))
    shared.print_next(as_json, *(shared.init_steps(new) if new else ()), *shared.summary_steps(file, summary))
    return max(summary.verdict.exit_code, shared.LOOK) if new and new.needs_review else summary.verdict.exit_code


def measure(
    project: shared.ProjectFile,
    shard: Shard = None,
    cluster: Cluster = None,
    retry: Retry = False,
    moved: Moved = False,
    workers: Workers = None,
    quiet: shared.Quiet = False,
    as_json: shared.AsJson = False,
    max_pixels: shared.MaxPixels = None,
) -> int:
    """Measure marks in the scans: comparator.csv.

    Goes on where an earlier call stopped.
    """
    from pipeline.stages import run_measure
    from pipeline.workers import WorkOptions

    work = WorkOptions(_shard(shard), cluster, retry, moved, workers)
    return shared.run_stage(project, partial(run_measure, work=work), as_json, max_pixels, quiet)


def status(
    project: shared.ProjectFile,
    verdict: Annotated[
        Verdict | None, typer.Option(metavar="V", help=f"List the scans with this verdict: {', '.join(Verdict)}.")
    ] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="A line a scan, on stdout.")] = False,
    as_json: shared.AsJson = False,
) -> int:
    """Count scans by verdict, with the next step for each."""
    from pipeline.archive.status import archive_status, print_status, status_csv, status_json

    def printed(console: PlainConsole) -> None:
        if as_csv:
            typer.echo(plain(status_csv(shown)), nl=False)
        else:
            print_status(shown, console, every=verdict is not None)

    given = shared.read(project)
    every = archive_status(given)
    shown = every.select(verdict)
    shared.show(as_json, partial(status_json, shown), printed)
    shared.print_next(
        as_json or as_csv, *shared.verdict_steps(project, shown.counts), shared.report_step(project, given.report_path)
    )
    return shared.DONE if every.all_good else shared.LOOK


def merge(
    project: shared.ProjectFile,
    databases: Annotated[
        list[Path], typer.Argument(metavar="DB...", help="Results databases of the parts.", show_default=False)
    ],
    as_json: shared.AsJson = False,
) -> int:
    """Join the results of several machines."""
    from pipeline.stages import run_merge
    from pipeline.terminal import Reporter

    taken, summary = run_merge(shared.read(project), databases, Reporter())
    if not as_json:
        left_out = {one.path: f", {one.damaged} damaged and left out" if one.damaged else "" for one in taken}
        shared.say(*(f"{o.path}: {counted(o.results, 'result')}, {o.new} of them new{left_out[o.path]}" for o in taken))
    return shared.finish(summary, as_json, project)


def report(
    project: shared.ProjectFile,
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", hidden=True, show_default=False)] = None,
    frames: Annotated[
        list[str] | None,
        typer.Option(
            "--frames", metavar="NAME", help="Only a page of this image, in out/frames, with all marks; repeatable."
        ),
    ] = None,
    plots: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write each camera's plots there as PNG and PDF (extra plots).")
    ] = None,
    as_json: shared.AsJson = False,
    max_pixels: shared.MaxPixels = None,
) -> int:
    """Write report.html, or a page of single frames."""
    from pipeline.stages import run_frame_pages, run_plots, run_report
    from pipeline.terminal import Reporter

    if plots is not None:
        run_plots(shared.read(project, max_pixels), plots, Reporter())
    if not frames:
        if names:
            raise InputError("images are named by --frames: reseau report PROJECT.toml --frames NAME --frames NAME")
        return shared.run_stage(project, run_report, as_json, max_pixels)
    pages = run_frame_pages(
        shared.read(project, max_pixels), list(dict.fromkeys([*frames, *(names or ())])), Reporter()
    )
    page_by_image = {image: str(path) for image, path in pages.items()}
    shared.show(
        as_json,
        lambda: {"frames": page_by_image},
        lambda _: shared.say(*(f"{image}: {path}" for image, path in page_by_image.items())),
    )
    return shared.DONE


def review(
    project: Annotated[
        Path,
        typer.Argument(
            metavar="PROJECT.toml", help="The project file, or a folder of scans to draw a camera.", show_default=False
        ),
    ],
    port: Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="Port, on this machine; 0: any free.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open no browser.")] = False,
    who: Annotated[str | None, typer.Option(metavar="NAME", help="Who decides; by default who is logged in.")] = None,
    max_pixels: shared.MaxPixels = None,
) -> int:
    """Settle doubtful marks, or draw a camera, in the browser."""
    try:
        from pipeline.review.server import serve
    except ModuleNotFoundError:
        raise missing_extra("reseau review", "Starlette and Uvicorn", "review") from None
    from pipeline.archive.scan_groups import find_scan_files
    from pipeline.files.project_file import read_undrawn

    file = project / "project.toml" if project.is_dir() else project
    scans = find_scan_files([project])[0] if project.is_dir() and not file.exists() else ()
    given = replace(read_undrawn(file, scans), max_pixels=max_pixels)
    step = shared.command_step("run", file, why="applies the decisions")

    def say_address(address: str) -> None:
        typer.echo(address)  # not by `say`, which would hide the token
        shared.print_next(False, "decide in the browser; end with Ctrl-C", *([] if scans else [step]))

    serve(given, port, who, not no_browser, say_address)
    return shared.DONE


def cameras(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]",
            help="Print this camera's file, to start from. After --scan: more scans; after --save: more projects.",
        ),
    ] = None,
    scan: Annotated[
        list[Path] | None,
        typer.Option(
            "--scan", metavar="PATH", help="Identify the camera of a scan, or of each scan group of a folder."
        ),
    ] = None,
    own: Annotated[
        Path | None,
        typer.Option("--project", metavar="PROJECT.toml", help="Try its camera files, too; its scans without --scan."),
    ] = None,
    pitch_um: Annotated[
        float | None, shared.pitch_option("The scan's pixel in µm, if its file does not say.", "--pitch")
    ] = None,
    saved: Annotated[
        list[Path] | None,
        typer.Option(
            "--save",
            metavar="PROJECT.toml",
            help="Write its adjusted cameras as files for later projects; several projects are joined.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where --save writes; by default out/cameras.")
    ] = None,
    max_pixels: shared.MaxPixels = None,
    as_json: shared.AsJson = False,
) -> int:
    """List film cameras, print one, name a scan's camera, or save adjusted ones."""
    if saved:
        if scan or own or pitch_um:
            raise InputError("--save goes without --scan, --project and --pitch: it identifies no camera.")
        return _save_cameras([shared.read(one) for one in (*saved, *map(Path, names or ()))], out, as_json)
    if own is not None or scan is not None:
        project = None if own is None else shared.read(own)
        given = [*(scan or ()), *(Path(name) for name in names or ())] or (project.scans.values() if project else ())
        return _name_cameras(list(given), project, pitch_um, max_pixels, as_json)
    if (names and (as_json or len(names) > 1)) or pitch_um is not None:
        raise InputError("give NAME alone, or --scan with or without --pitch, or neither for the list.")
    from pipeline.files.library import PREFIX, library_json, library_path, print_library

    if names:
        typer.echo(library_path(names[0].removeprefix(PREFIX)).read_text(encoding="utf-8"), nl=False)
    else:
        shared.show(as_json, library_json, print_library)
        shared.print_next(
            as_json, shared.command_step("init", "FOLDER", why="finds the camera of each scan"), LIBRARY_STEP
        )
    return shared.DONE


def _save_cameras(projects: "Sequence[Project]", out: Path | None, as_json: bool) -> int:
    from pipeline.exchange.saved_cameras import save_cameras

    cameras = save_cameras(projects, out or projects[0].output / "cameras")
    content = {one.name: {"file": str(one.path), "source": dataclasses.asdict(one.source)} for one in cameras}
    shared.show(as_json, lambda: {"cameras": content}, lambda _: shared.say(*(one.sentence() for one in cameras)))
    shared.print_next(as_json, f'camera = "{cameras[0].path}" in a later project')
    return shared.DONE


def _name_cameras(
    given: Sequence[Path], project: "Project | None", pitch_um: float | None, max_pixels: int | None, as_json: bool
) -> int:
    """Identify the cameras of scans: all trials of a single scan, or some scans of each group."""
    from pipeline.archive.scan_groups import catalogue, identify_sample, name_cameras, print_groups
    from pipeline.files.library import PREFIX, read_library
    from pipeline.measuring.camera_identification import print_identification
    from pipeline.measuring.camera_trials import identify
    from pipeline.terminal import Reporter

    own = {name: camera for name, camera in project.cameras.items() if PREFIX not in name} if project else {}
    tried, reporter = {**own, **read_library()}, Reporter()
    if len(given) == 1 and not given[0].is_dir():
        identification = identify(given[0], tried, pitch_um, reporter, max_pixels)
        shared.show(as_json, identification.as_json, lambda console: print_identification(identification, console))
        steps = [f'camera = "{PREFIX}{name}" in project.toml' for name in identification.names_by_plate()]
        shared.print_next(as_json, *(steps or [LIBRARY_STEP]))
        return shared.DONE if identification.best and not identification.is_likely_false else shared.LOOK
    with reporter.stage("examining file") as count:
        found = catalogue(given, count, max_pixels, by_folder=False)
    trial = partial(identify_sample, cameras=tried, pitch_um=pitch_um, max_pixels=max_pixels)
    grouped = name_cameras(found, trial, reporter, None)
    if not grouped.groups:
        raise InputError("\n".join(grouped.unread.values()))
    shared.show(as_json, grouped.as_json, lambda console: print_groups(grouped, console))
    is_any_named = any(group.camera for group in grouped.groups)
    step = (
        shared.command_step("init", *given, why="writes a project with these cameras") if is_any_named else LIBRARY_STEP
    )
    shared.print_next(as_json, step)
    return shared.DONE if grouped.all_named else shared.LOOK


def _shard(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"--shard {text!r} is not K/N, the K-th of N parts, as 3/8; K goes from 1 to N.")
    return int(found[1]), int(found[2])
