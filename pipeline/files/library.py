"""Camera files to start from: the library of common cameras that comes with the program, named as `library:NAME`; and a
short file from the kinds and distances of a camera's marks."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from measure.marks.shapes import Point
from pipeline.errors import InputError
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.camera_tables import written_place_text
from pipeline.files.mark_table import MARK_TABLES, MarkJson, scaled_mark
from pipeline.text.table_models import key_rows
from pipeline.text.wording import did_you_mean, quoted, table_lines

PREFIX = "library:"
FOLDER = Path(__file__).parents[1] / "cameras"

Json = dict[str, Any]
FORMATS_MM = (56.0, 60.0, 70.0, 100.0, 130.0, 180.0, 228.0, 232.0, 240.0, 300.0)  # usual sides of frames
_AERIAL_MM = 220.0  # approximate distance of marks of aerial cameras, to which the sizes below apply
_LEAST_SCALE = 0.5  # smallest factor of these sizes for small cameras
_RIM_MM = 1.0  # margin of the frame beyond its outermost mark


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


def library_json() -> list[Json]:
    return [
        {
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
        for name, camera in read_library().items()
    ]


def print_library(console: Console) -> None:
    """Print the library: one line per camera, one source per kind of camera, and how to use one."""
    table, widest = Table(box=None, pad_edge=False), max(map(len, library_names()))
    for heading in ("camera", "frame, mm", "c, mm", "marks", "shape", "reports"):
        table.add_column(heading, no_wrap=True, min_width=widest if heading == "camera" else None)
    sources: dict[str, str] = {}
    for entry in library_json():
        c, drawn = entry["principal_distance_mm"], len(entry["drawn"])
        shape = "known" if drawn == entry["fiducials"] else f"of {drawn}" if drawn else "not known"
        table.add_row(
            entry["name"],
            " x ".join(f"{side:g}" for side in dict.fromkeys(entry["frame_mm"])),
            f"{c['value']:.2f} ± {c['sigma']:.2f}",
            str(entry["fiducials"]),
            "learned" if entry["learned"] else shape,
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


_PLACES: Mapping[str, Mapping[str, Point]] = {  # in units of the distances, numbered as in calibration reports
    "square": {"1": (-0.5, -0.5), "2": (0.5, 0.5), "3": (-0.5, 0.5), "4": (0.5, -0.5)},
    "side": {"5": (-0.5, 0.0), "6": (0.5, 0.0), "7": (0.0, 0.5), "8": (0.0, -0.5)},
}
_NAMES = {"square": "corner", "side": "side"}  # of the tables [mark.NAME]


_CROSS = {"arm_mm": 1.75, "line_mm": 0.12, "gap_mm": 0.25, "angle_deg": 0.0}
_RING = {"ring_mm": 0.8, "ring_line_mm": 0.17}
_PARTS = [
    {"shape": "ring", "radius_mm": 1.6, "line_mm": 0.17},
    {"shape": "bar", "from_mm": [-1.2, 0.0], "to_mm": [1.2, 0.0], "line_mm": 0.12},
    {"shape": "bar", "from_mm": [0.0, -1.2], "to_mm": [0.0, 1.2], "line_mm": 0.12},
    {"shape": "disk", "center_mm": [2.4, 0.0], "radius_mm": 0.25},
]


@dataclass(frozen=True)
class MarkKind:
    """How the template draws a kind of mark.

    Attributes
    ----------
    drawing : content of the table [mark.NAME], for aerial cameras.
    reach_mm : extent from the mark's point.
    edge_mm : distance of the frame's edge beyond the point of a side mark; None for free-standing marks.
    at : where the kind is used: "square" (corners), "side".
    """

    drawing: MarkJson
    reach_mm: float = 0.0
    edge_mm: float | None = None
    at: tuple[str, ...] = ("square", "side")


def _line(text: str, comment: str) -> str:
    return f"{text:39} # {comment}"


def _polygon(*vertices_mm: Point) -> MarkKind:
    """Solid mark of a side, drawn for the right side, x outwards."""
    edge_mm = max(x for x, _ in vertices_mm) or min(x for x, _ in vertices_mm)
    drawing = {"kind": "polygon", "vertices_mm": list(map(list, vertices_mm)), "rotate": "radial"}
    return MarkKind(drawing, 0.0, edge_mm, ("side",))


MARK_KINDS: Mapping[str, MarkKind] = {
    "cross": MarkKind({"kind": "cross", **_CROSS}, 1.75),
    "dot": MarkKind({"kind": "dot", "radius_mm": 0.25}, 0.25),
    "ring-cross": MarkKind({"kind": "ring-cross", **_RING, **_CROSS}, 1.75),
    "ring-dot": MarkKind({"kind": "ring-dot", **_RING, "radius_mm": 0.2}, 0.9),
    "wedge": _polygon((0.0, 0.0), (3.0, 1.8), (3.0, -1.8)),
    "notch": _polygon((0.0, 0.0), (-2.5, 1.5), (-2.5, -1.5)),
    "wing": _polygon((0.0, 0.0), (0.0, 4.1), (3.15, 6.4), (3.15, -6.4), (-3.1, -2.0), (-3.15, -1.8), (-3.15, 0.0)),
    "parts": MarkKind({"kind": "parts", "part": _PARTS}, 2.65),
    "frame-corner": MarkKind({"kind": "frame-corner"}, 0.0, 0.0, ("square",)),
    "learned": MarkKind({"kind": "learned", "size_mm": 6.0}, 3.0),
}


@dataclass(frozen=True)
class CameraSizes:
    """What is known of a camera.

    Attributes
    ----------
    marks : kinds of the marks of corners and sides, in this order.
    square, side : distances of corner marks and of side marks (width, height), mm; None where there are none.
    frame : size of the frame (width, height), mm; None: derived from the marks.
    """

    marks: tuple[str, ...]
    square: Point | None = None
    side: Point | None = None
    frame: Point | None = None
    distance: float | None = None
    name: str = "my camera"

    @classmethod
    def from_words(
        cls, marks: str, square: str | None, side: str | None, frame: str | None, distance: float | None, name: str
    ) -> "CameraSizes":
        """Parse the arguments of the command line. Raises InputError."""
        kinds = tuple(kind.strip() for kind in marks.split(","))
        sizes = (_size("--square", square), _size("--side", side), _size("--frame", frame))
        return cls(kinds, *sizes, distance, name)

    def __post_init__(self) -> None:
        for kind in self.marks:
            if kind not in MARK_KINDS:
                raise InputError(
                    f"--marks {kind!r}: possible are {', '.join(MARK_KINDS)}.{did_you_mean(kind, MARK_KINDS)} Other "
                    "marks are drawn as polygon or parts in the file, or learned from clicks (`--marks learned`)."
                )
        if self.square is None and self.side is None:
            raise InputError(
                "the marks' distances are missing: --square 212 for four marks in the corners, --side 226 for four in "
                "the middles of the sides, or both; in mm from mark to mark, WIDTHxHEIGHT where they differ."
            )
        places = len(self.kinds)
        if len(self.marks) > places:
            raise InputError(f"--marks names {len(self.marks)} kinds: two are for --square and --side, in this order.")
        for place, (kind, _) in self.kinds.items():
            if place not in MARK_KINDS[kind].at:
                own = MARK_KINDS[kind].at[0]
                both = f" With both, name two kinds, as --marks cross,{kind}." if own == "side" else ""
                raise InputError(f"--marks {kind} goes with --{own}, not with --{place}.{both}")
        half_mm = [max(side) / 2 for side in (self.square, self.side) if side]
        if self.frame is not None and max(half_mm) > 0.6 * max(self.frame):
            raise InputError(f"--frame {self.frame[0]:g}: smaller than the distances of the marks.")

    @property
    def kinds(self) -> dict[str, tuple[str, Point]]:
        """{"square" or "side": (kind of the marks, their distances in mm)}."""
        given = [(place, size) for place, size in (("square", self.square), ("side", self.side)) if size]
        return {place: (self.marks[min(i, len(self.marks) - 1)], size) for i, (place, size) in enumerate(given)}

    @property
    def scale(self) -> float:
        """Factor of the marks' sizes relative to aerial cameras."""
        return min(1.0, max(_LEAST_SCALE, max(max(size) for _, size in self.kinds.values()) / _AERIAL_MM))

    @property
    def frame_mm(self) -> Point:
        """Size of the frame: as given, from marks at its edge, or the smallest usual format that holds all marks."""
        if self.frame is not None:
            return self.frame
        for kind, size in self.kinds.values():
            edge_mm = MARK_KINDS[kind].edge_mm
            if edge_mm is not None:
                return size[0] + 2 * self.scale * edge_mm, size[1] + 2 * self.scale * edge_mm
        least = [
            max(
                size[axis] + 2 * (self.scale * MARK_KINDS[kind].reach_mm + _RIM_MM)
                for kind, size in self.kinds.values()
            )
            for axis in (0, 1)
        ]
        usual = next((side for side in FORMATS_MM if max(least) <= side), None)
        if usual is not None and min(least) == max(least):
            return usual, usual
        return float(math.ceil(least[0])), float(math.ceil(least[1]))


def _size(option: str, text: str | None) -> Point | None:
    """Parse 212 or 212x150, mm. Raises InputError."""
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(?:mm)?(?:\s*[xX×]\s*(\d+(?:\.\d+)?)\s*(?:mm)?)?\s*", text)
    width, height = (0.0, 0.0) if found is None else (float(found[1]), float(found[2] or found[1]))
    if not 1.0 <= min(width, height) <= max(width, height) <= 2000.0:
        raise InputError(f"{option} {text!r} is no distance in mm, as 212 or 212x150, of 1 to 2000 mm.")
    return width, height


def camera_template(sizes: CameraSizes) -> str:
    """Text of a complete camera file, with comments on which values are typical ones and where to find better ones."""
    given = [f"{kind}, {width:g} x {height:g} mm" for kind, (width, height) in sizes.kinds.values()]
    distance = (
        "# principal_distance_mm = 153.0" if sizes.distance is None else f"principal_distance_mm = {sizes.distance:g}"
    )
    lines = [
        f"# Drawn by `reseau template camera`: {' and '.join(given)} from mark to mark.",
        "# The marks' own sizes are typical ones: measure them in a scan, or see in `reseau review` how they fit.",
        f"name = {quoted(sizes.name)}",
        _line(f"frame_mm = [{sizes.frame_mm[0]:g}, {sizes.frame_mm[1]:g}]", "the exposed frame, width and height"),
        _line(distance, "as on the plate: needed to orient frames from points"),
        _line('# writing = ["left: reads upward"]', "where the camera writes on its film: tells how a scan lies"),
        _line("fiducial = [", "sigma_mm: of a certificate some thousandths; 1.0 only places the datum"),
    ]
    for place, (_, size) in sizes.kinds.items():
        for id, (right, up) in _PLACES[place].items():
            xy_mm = f"[{right * size[0]:g}, {up * size[1]:g}]"
            lines.append(f'    {{id = "{id}", xy_mm = {xy_mm}, sigma_mm = 1.0, mark = "{_NAMES[place]}"}},')
    lines.append("]")
    for place, (kind, _) in sizes.kinds.items():
        drawing = scaled_mark(MARK_KINDS[kind].drawing, sizes.scale)
        polarity = {} if kind == "learned" else {"polarity": "auto"}
        turned = {"angle_deg": 45.0} if "angle_deg" in drawing and place == "square" else {}  # diagonal in corners
        drawing = {"kind": drawing["kind"], **polarity, **drawing, **turned}
        meanings = {row.name: row.meaning for row in key_rows(MARK_TABLES[drawing["kind"]]) if row.name != "kind"}
        for line in table_lines({"mark": {_NAMES[place]: drawing}}):
            meaning = meanings.get(line.partition(" = ")[0])
            lines.append(_line(line, meaning) if meaning and len(line) < 40 else line)
    return "\n".join(lines) + "\n"
