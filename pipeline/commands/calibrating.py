"""Command that calibrates a digital camera from images of a board."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.commands.next_steps import command_step, page_step, print_next
from pipeline.commands.shared import DONE, LOOK, AsJson, show

if TYPE_CHECKING:
    from pipeline.calibration.calibrate_stage import Calibration

OUT = Path("calibration")


def calibrate(
    pictures: Annotated[
        list[Path], typer.Argument(metavar="FOLDER_OR_FILES...", help="Pictures of the board.", show_default=False)
    ],
    board: Annotated[str, typer.Option(metavar="9x6", help="Inner corners, squares (charuco), markers or circles.")],
    square: Annotated[str, typer.Option(metavar="25mm", help="Side of a square, or distance from one to the next.")],
    kind: Annotated[
        str, typer.Option(help="chessboard, charuco, aprilgrid, aruco, circle-grid or asymmetric-circle-grid.")
    ] = "chessboard",
    marker: Annotated[str | None, typer.Option(metavar="18mm", help="Side of a marker, diameter of a circle.")] = None,
    dictionary: Annotated[str | None, typer.Option(metavar="4X4_50", help="Of the markers.")] = None,
    legacy: Annotated[bool, typer.Option("--legacy", help="The older ChArUco layout; else both are tried.")] = False,
    first_id: Annotated[int, typer.Option(metavar="N", min=0, help="Number of the first marker.")] = 0,
    lens: Annotated[str, typer.Option(help="auto, opencv4, opencv5, opencv8, fisheye.")] = "auto",
    square_pixels: Annotated[bool, typer.Option("--square-pixels", help="One focal length for x and y.")] = False,
    pitch_um: Annotated[float | None, typer.Option(metavar="UM", min=0.01, help="Side of a pixel, for mm.")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the results go.")] = OUT,
    ros: Annotated[bool, typer.Option("--ros", help="Write ROS's camera info as well.")] = False,
    workers: Annotated[int | None, typer.Option(metavar="N", min=1, max=1024, help="Processes.")] = None,
    as_json: AsJson = False,
) -> int:
    """Calibrate a digital camera from pictures of a board."""
    from pipeline.calibration.board_calibration import calibrate

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
    show(as_json, found.as_json, found.print)
    print_next(as_json, *_steps(found))
    return LOOK if found.needs_look else DONE


def _steps(found: "Calibration") -> Iterator[str]:
    yield page_step(found.report)
    if found.summary.verdict.problems:
        yield command_step("run", found.project, why="after the remedies above")
    yield command_step("export", found.project, "opencv", "DIR", why="or colmap, metashape, micmac, ...")
