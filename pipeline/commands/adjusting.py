"""Commands for adjustment: adjust, check, choose models, orient blocks, compare, plan, calibrate digital cameras."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands import shared
from pipeline.errors import InputError

OUT = Path("calibration")


def adjust(project: shared.ProjectFile, as_json: shared.AsJson = False, max_pixels: shared.MaxPixels = None) -> int:
    """Adjust: orientations, camera, film and fiducials at once."""
    from pipeline.stages import run_adjust

    return shared.run_stage(project, run_adjust, as_json, max_pixels)


def check(project: shared.ProjectFile, as_json: shared.AsJson = False) -> int:
    """Compare the adjustment with OpenCV's calibration."""
    from pipeline.stages import run_check

    return shared.run_stage(project, run_check, as_json)


def choose(project: shared.ProjectFile, as_json: shared.AsJson = False) -> int:
    """Select lens and film models by tests and cross-validation."""
    from pipeline.adjusting.adjust_stage import print_choice, run_choose
    from pipeline.terminal import Reporter

    settings = shared.read(project)
    choice, record = run_choose(settings, Reporter())
    shared.show(as_json, lambda: record, lambda console: print_choice(choice, console, settings.choice_path))
    is_as_given = choice.chosen is not None and choice.chosen.model == choice.given
    set_first = "" if is_as_given else "after the selected model is set in project.toml and camera.toml"
    shared.print_next(as_json, shared.command_step("run", project, why=set_first))
    return shared.DONE if is_as_given else shared.LOOK


def block(
    project: shared.ProjectFile,
    out_dir: shared.OutDir,
    pitch_um: Annotated[float | None, shared.pitch_option("Pixel of the pictures; by default the scans'.")] = None,
    max_pixels: shared.MaxPixels = None,
    as_json: shared.AsJson = False,
) -> int:
    """Orient overlapping frames by COLMAP, and adjust them."""
    from pipeline.blocks.block_stage import run_block
    from pipeline.stages import run_adjust
    from pipeline.terminal import Reporter

    reporter = Reporter()
    oriented, left_out, lines = run_block(shared.read(project, max_pixels), out_dir, pitch_um, reporter)
    summary = run_adjust(oriented, reporter)
    if not as_json:
        shared.say(*lines)
    code = shared.finish(summary, as_json, None)
    files = f"{out_dir / 'comparator.csv'} and {out_dir / 'images.csv'}"
    shared.print_next(as_json, f"name {files} in a copy of project.toml without scans, then reseau run that copy")
    return max(code, shared.LOOK) if left_out else code


def compare(
    adjustments: Annotated[
        list[Path],
        typer.Argument(
            metavar="A/adjustment.json B/adjustment.json...", help="The calibrations' files.", show_default=False
        ),
    ],
    camera: shared.OfCamera = None,
    times: Annotated[str | None, typer.Option(metavar="T,T,...", help="When they were made: 1952,1958.5.")] = None,
    flat: Annotated[
        bool,
        typer.Option(
            "--flat", help="For flat ground, where height and position are correlated with c and the principal point."
        ),
    ] = False,
    level: Annotated[
        float, typer.Option(min=1e-12, max=0.5, help="Significance level of the test: drift below this p-value.")
    ] = 0.01,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Write compare.json and compare.svg there.")] = None,
    as_json: shared.AsJson = False,
) -> int:
    """Compare calibrations of a camera: `drift` or `no drift`."""
    from pipeline.adjusting.compare_stage import print_comparison, run_compare
    from pipeline.results.stage_files import DRIFT

    when = None if times is None else _numbers(times)
    comparison, record = run_compare(adjustments, camera, when, "flat" if flat else "space", level, out)
    shared.show(as_json, lambda: record, lambda console: print_comparison(comparison, record, console))
    has_drift = record.verdict == DRIFT
    shared.print_next(
        as_json,
        "use each calibration for the photographs of its time"
        if has_drift
        else "use any of them; one project with the photographs of all gives the smallest standard deviations",
    )
    return shared.LOOK if has_drift else shared.DONE


def design(
    scene: shared.SceneFile,
    out_dir: Annotated[
        Path | None, typer.Argument(metavar="[OUT_DIR]", help="Where design.json goes; SCENE-design by default.")
    ] = None,
    as_json: shared.AsJson = False,
) -> int:
    """Expected precision of planned photographs."""
    from pipeline.design.summary import print_design, run_design
    from pipeline.terminal import Reporter

    planned = run_design(scene, out_dir, Reporter())
    shared.show(as_json, planned.content, lambda console: print_design(planned, console))
    if planned.has_findings:
        shared.print_next(
            as_json, shared.command_step("design", scene, why="after the scene is changed as the tables suggest")
        )
    shared.print_next(as_json, shared.command_step("render", scene, "DIR", why="synthetic scans of this plan"))
    return shared.LOOK if planned.has_findings else shared.DONE


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--times {text!r} are not numbers with commas between them, as in 1952,1958.5.") from None


def calibrate(
    pictures: Annotated[
        list[Path], typer.Argument(metavar="FOLDER_OR_FILES...", help="Pictures of the board.", show_default=False)
    ],
    board: Annotated[str, typer.Option(metavar="9x6", help="Inner corners, squares (charuco), markers or circles.")],
    square: Annotated[
        str,
        typer.Option(
            metavar="25mm",
            help="Side of a square, or distance from one to the next; 10x17.3mm: of columns and of rows of circles.",
        ),
    ],
    kind: Annotated[
        str, typer.Option(help="chessboard, charuco, aprilgrid, aruco, circle-grid or asymmetric-circle-grid.")
    ] = "chessboard",
    marker: Annotated[str | None, typer.Option(metavar="18mm", help="Side of a marker, diameter of a circle.")] = None,
    dictionary: Annotated[str | None, typer.Option(metavar="4X4_50", help="Dictionary of the markers.")] = None,
    legacy: Annotated[bool, typer.Option("--legacy", help="The older ChArUco layout; else both are tried.")] = False,
    first_id: Annotated[int, typer.Option(metavar="N", min=0, help="Number of the first marker.")] = 0,
    lens: Annotated[str, typer.Option(help="auto, opencv4, opencv5, opencv8, fisheye.")] = "auto",
    square_pixels: Annotated[bool, typer.Option("--square-pixels", help="One focal length for x and y.")] = False,
    pitch_um: Annotated[float | None, typer.Option(metavar="UM", min=0.01, help="Side of a pixel, for mm.")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the results go.")] = OUT,
    ros: Annotated[bool, typer.Option("--ros", help="Write ROS's camera info as well.")] = False,
    workers: Annotated[int | None, typer.Option(metavar="N", min=1, max=1024, help="Processes.")] = None,
    as_json: shared.AsJson = False,
) -> int:
    """Calibrate a digital camera from pictures of a board."""
    from pipeline.calibration.calibrate_stage import calibrate

    found = calibrate(
        pictures,
        board,
        square,
        kind=kind,
        marker=marker,
        dictionary=dictionary,
        legacy=legacy,
        first_id=first_id,
        lens=lens,
        square_pixels=square_pixels,
        pitch_um=pitch_um,
        out=out,
        ros=ros,
        workers=workers,
    )
    shared.show(as_json, found.as_json, found.print)
    steps = [shared.page_step(found.report)]
    if found.summary.verdict.problems:
        steps.append(shared.command_step("run", found.project, why="after the remedies above"))
    steps.append(shared.command_step("export", found.project, "opencv", "DIR", why="or colmap, metashape, micmac, ..."))
    shared.print_next(as_json, *steps)
    return shared.LOOK if found.needs_review else shared.DONE
