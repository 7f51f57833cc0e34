"""Run every command on a small project and import every module: python -P every_command.py FOLDER

Prints one JSON object. calls: of each call its arguments, exit code, messages, the extra that the call needs, and the
next steps that it prints. modules: those that cannot be imported, with the package that is missing. Imports only what
a plain installation has.
"""

import importlib
import io
import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from pipeline.cli import run
from pipeline.exchange.formats import FORMATS
from pipeline.files.library import read_library

SCENE = Path(__file__).with_suffix(".toml")
ROOT = SCENE.parents[1]
PACKAGES = ("measure", "adjust", "pipeline", "synthetic_images")
POOLS = ("archive.measure_archive", "archive.new_project", "resampling.resample_stage")
CERTIFICATE = "calibrated_principal_distance_mm = 153\nangle_deg = [7.5, 15.0, 22.7, 30.0]\nradial_um = [1, 2, 1, -3]\n"


def chessboard(number: int, columns: int = 5, rows: int = 4) -> Any:
    """A picture of a board of so many inner corners, each number from another side."""
    squares, side = 40 + 170 * (np.indices((rows + 1, columns + 1)).sum(axis=0) % 2), 240 // (columns + 1)
    flat = np.pad(np.kron(squares, np.ones((side, side))), 60, constant_values=210).astype(np.uint8)
    turn = 0.45 * np.array([np.cos(1.3 * number), np.sin(1.3 * number), 0.1 * number])
    camera = np.array([[420.0, 0.0, 200.0], [0.0, 420.0, 160.0], [0.0, 0.0, 1.0]])
    shift = np.array([[-180.0], [-160.0], [600.0]])
    view = camera @ np.column_stack([np.asarray(cv2.Rodrigues(turn)[0])[:, :2], shift])
    return cv2.warpPerspective(flat, view, (400, 320), flags=cv2.INTER_AREA, borderValue=(210,))


def calls(folder: Path) -> Iterator[tuple[str, Sequence[str | Path]]]:
    """The extra that a call needs, "" for none, and its arguments. Each call comes after those whose files it reads."""
    small, out = folder / "small", folder / "small" / "out"
    project, adjustment = small / "project.toml", out / "adjustment.json"
    yield "", ("render", SCENE, small)
    other_font = folder / "font.toml"
    other_font.write_text(SCENE.read_text().replace("handwriting", "DejaVu Sans"))
    yield "fonts", ("render", other_font, folder / "font")
    for kind in ("project", "camera", "scene"):
        yield "", ("template", kind)
    yield "", ("measure", project, "--shard", "1/2")
    yield "", ("measure", project, "--shard", "2/2")
    yield "", ("merge", project, *sorted(out.glob("measurement.*of*.db")))
    yield "", ("measure", project)
    yield "", ("adjust", project)
    yield "", ("check", project)
    yield "", ("report", project)
    yield "", ("report", project, "--frames", "a")
    yield "plots", ("report", project, "--plots", folder / "plots")
    yield "", ("status", project)
    yield "", ("run", project, "--json")
    yield "cluster", ("measure", project, "--cluster", "local", "--retry")
    if find_spec("starlette") is None:  # else it serves until it is ended
        yield "review", ("review", project, "--no-browser")
    yield "", ("resample", project, folder / "resampled", "--lens")
    yield "blocks", ("block", project, folder / "block")
    project.write_text(project.read_text().replace("[object]", '[object]\ncrs = "EPSG:32633"'))
    for format in FORMATS:
        yield {"parquet": "parquet", "colmap": "blocks"}.get(format, ""), ("export", project, format, folder / format)
    exported = {
        "micmac": (*sorted((folder / "micmac" / "Ori-InterneScan").glob("*.xml")),),
        "mmvii": (*sorted((folder / "mmvii").rglob("MesIm-*.xml")),),
        "metashape": (folder / "metashape" / "small.xml",),
        "opencv": (folder / "opencv" / "a.yml",),
        "colmap": (folder / "colmap" / "sparse",),
    }
    for format, files in exported.items():
        extra = "blocks" if format == "colmap" else ""
        yield extra, ("import", format, *files, folder / f"from-{format}", "--pitch-um", "40")
    (folder / "certificate.toml").write_text(CERTIFICATE)
    yield "", ("import", "certificate", folder / "certificate.toml", folder / "from-certificate")
    yield "", ("demo", folder / "demo")
    film = folder / "film"  # of the fiducials alone: no lens is to choose
    film.mkdir()
    (film / "project.toml").write_text('camera = "../small/camera.toml"\n')
    rows = (small / "comparator.csv").read_text().splitlines(keepends=True)
    (film / "comparator.csv").write_text("".join(row for row in rows if ",target," not in row))
    yield "", ("choose", film / "project.toml")
    yield "", ("convert", adjustment, "brown", folder / "brown")
    yield "", ("compare", adjustment, folder / "demo" / "out" / "adjustment.json")
    yield "", ("design", SCENE, folder / "design")
    yield "", ("init", small / "scans", "--out", folder / "new")
    yield "http", ("init", "https://localhost:1/scan.tif", "--out", folder / "http")
    yield "s3", ("init", "s3://none/scan.tif", "--out", folder / "s3")
    board = folder / "board"
    board.mkdir()
    for number in range(4):
        cv2.imwrite(str(board / f"{number}.png"), chessboard(number))
    yield "", ("calibrate", board, "--board", "5x4", "--square", "20mm", "--lens", "opencv4", "--out", folder / "lens")
    yield "", ("cameras",)
    yield "", ("cameras", "wild-rc10-153")
    yield "", ("cameras", "--scan", small / "scans" / "a.tif")


def call(arguments: Sequence[str | Path]) -> dict[str, Any]:
    """Run one command here."""
    words, output, messages = [str(argument) for argument in arguments], io.StringIO(), io.StringIO()
    with redirect_stdout(output), redirect_stderr(messages):
        code = run(words)
    steps = [line for line in output.getvalue().splitlines() if line.startswith("Next: ")]
    return {"arguments": words, "code": code, "messages": messages.getvalue(), "steps": steps}


def modules_not_imported() -> dict[str, str]:
    """Modules of the packages that cannot be imported, each with the reason."""
    missing = {}
    for file in sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            missing[module] = error.name or str(error)
    return missing


def main(folder: Path) -> None:
    """Print it. To be quick, scans are measured in this process, the demonstration is the first frame of the scene, and
    the camera library has one camera."""
    first_frame = folder / "demo.toml"
    first_frame.write_text("[[image]]".join(SCENE.read_text().split("[[image]]")[:2]))
    cameras = dict(list(read_library().items())[:1])
    with ExitStack() as stack:
        for module in POOLS:
            stack.enter_context(patch(f"pipeline.{module}.worker_pool", lambda *_: ThreadPoolExecutor(1)))
        stack.enter_context(patch("pipeline.commands.measuring.SCENE", (str(first_frame),)))
        for module in ("files.library", "archive.new_project"):
            stack.enter_context(patch(f"pipeline.{module}.read_library", lambda: cameras))
        called = [{"extra": extra, **call(arguments)} for extra, arguments in calls(folder)]
    json.dump({"calls": called, "modules": modules_not_imported()}, sys.stdout)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
