"""Camera library: files of common cameras that come with the program, named as `library:NAME`."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.camera_tables import written_place_text
from pipeline.text.wording import did_you_mean

PREFIX = "library:"
FOLDER = Path(__file__).parents[1] / "cameras"

Json = dict[str, Any]


def camera_path(text: str, folder: Path) -> Path:
    """File of a camera that a project names: `library:NAME`, or a path relative to the folder."""
    return library_path(text.removeprefix(PREFIX)) if text.startswith(PREFIX) else folder / text


def library_path(name: str) -> Path:
    """File of a camera of the library. Raises InputError with names similar to a misspelt one."""
    names = library_names()
    if name not in names:
        plain = name.casefold().replace(" ", "-").replace("_", "-")
        begun = [known for known in names if plain and known.startswith(plain)]
        near = f" Did you mean {' or '.join(map(repr, begun))}?" if begun else did_you_mean(plain, names)
        raise InputError(f"the camera library has no {name!r}.{near} `reseau cameras` lists them.")
    return FOLDER / f"{name}.toml"


def library_names() -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def read_library() -> dict[str, CameraFile]:
    """All cameras of the library, by name."""
    return {name: read_camera(library_path(name)) for name in library_names()}


def camera_words(camera: CameraFile) -> str:
    """Text that distinguishes a camera: frame, principal distance, marks, source of its numbers."""
    frame_mm = " x ".join(f"{side:g}" for side in camera.frame_mm or ())
    corners = sum(abs(x) > 0.5 * abs(y) and abs(y) > 0.5 * abs(x) for x, y in (one.xy_mm for one in camera.fiducials))
    sides = len(camera.fiducials) - corners
    marks = " and ".join(f"{number} {word}" for number, word in ((corners, "corner"), (sides, "side")) if number)
    c_mm = f"c {camera.principal_distance_mm:.1f} mm, " if camera.principal_distance_mm else ""
    return f"frame {frame_mm} mm, {c_mm}{marks} marks, {camera.source.text if camera.source else 'no source'}"


def library_json() -> list[Json]:
    return [_entry(name, camera) for name, camera in read_library().items()]


def print_library(console: Console) -> None:
    """Print the library: one line per camera, one source per kind of camera, and how to use one."""
    table, widest = Table(box=None, pad_edge=False), max(map(len, library_names()))
    for heading in ("camera", "frame, mm", "c, mm", "marks", "shape", "reports"):
        table.add_column(heading, no_wrap=True, min_width=widest if heading == "camera" else None)
    sources: dict[str, str] = {}
    for entry in library_json():
        c = entry["principal_distance_mm"]
        table.add_row(
            entry["name"],
            " x ".join(f"{side:g}" for side in dict.fromkeys(entry["frame_mm"])),
            f"{c['value']:.2f} ± {c['sigma']:.2f}",
            str(entry["fiducials"]),
            _shape(entry),
            str(entry["reports"]),
        )
        sources[entry["name"].rsplit("-", 1)[0]] = entry["source"]
    console.print(table)
    for kind, source in sources.items():
        console.print(f"{kind}: {source}", highlight=False)
    console.print(
        'camera = "library:NAME" in project.toml takes one. '
        "Marks whose shape is not known are learned from the scans, or passed over.",
        highlight=False,
    )


def _shape(entry: Json) -> str:
    drawn, learned = len(entry["drawn"]), len(entry["learned"])
    if learned:
        return "learned"
    return "known" if drawn == entry["fiducials"] else f"of {drawn}" if drawn else "not known"


def _entry(name: str, camera: CameraFile) -> Json:
    return {
        "name": name,
        "title": camera.name,
        "frame_mm": list(camera.frame_mm or ()),
        "writing": [written_place_text(place) for place in camera.writing],
        "principal_distance_mm": {
            "value": camera.principal_distance_mm,
            "sigma": camera.principal_distance_sigma_mm,
        },
        "fiducials": len(camera.fiducials),
        "drawn": [mark.id for mark in camera.layout_marks],
        "learned": [one.id for one in camera.learned],
        "reports": camera.source.reports if camera.source else 0,
        "source": camera.source.text if camera.source else "",
    }
