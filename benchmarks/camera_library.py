"""Camera library: camera files generated from calibration reports.

python -m benchmarks camera_library REPORTS_FOLDER OUT_FOLDER

The folder holds usgs_reports.csv (one line per report: camera, focal length, coordinates and separations of the marks),
and cameras.json and OSL_1785.json (single cameras, transcribed). The data contain typing errors, and some cameras of a
model had other marks. Therefore medians are used, spreads are 1.4826 times the median absolute deviation, and values
outside a camera's gate are rejected and printed. The réseau plate hasselblad-reseau has no reports: its file is written
by hand.
"""

import csv
import json
import math
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.camera_kinds import CORNERS, KINDS, LEARNED, SIDES, Kind
from measure.noise.robust_estimation import SIGMA_OF_DEVIATION

# Numbers of the marks as in the reports of the US Geological Survey, x' to the right and y' up. Their form, as in
# OSL/1785, has the data strip on the left; that of other makers and of before 1960 is not known.
PLACES = {"ll": "1", "ur": "2", "ul": "3", "lr": "4", "ml": "5", "mr": "6", "mt": "7", "mb": "8"}
DIRECTIONS = {"ll": (-1, -1), "ur": (1, 1), "ul": (-1, 1), "lr": (1, -1)} | {
    "ml": (-1, 0),
    "mr": (1, 0),
    "mt": (0, 1),
    "mb": (0, -1),
}
SEPARATIONS = {"lr_dist": "left to right", "tb_dist": "top to bottom", "llur_dist": "1 to 2", "ullr_dist": "3 to 4"}
ENDS = {"lr_dist": ("ml", "mr"), "tb_dist": ("mb", "mt"), "llur_dist": ("ll", "ur"), "ullr_dist": ("ul", "lr")}

ENOUGH = 5  # smallest number of cameras for a spread
LEAST_SIGMA_MM = 0.005  # mm, accuracy stated in the reports
PRINCIPAL_POINT_MM = 0.02  # mm, sigma; the RMS of nine transcribed cameras is 0.013 mm per axis
CONE_MM = 6.0  # mm, largest deviation of a focal length from the nominal one of its cone
CONE_SPREAD = 0.002  # sigma as a fraction of the focal length, for cones with too few reports


@dataclass(frozen=True)
class Report:
    """Calibration report: coordinates of the marks by place and separations by name, mm."""

    source: str
    model: str
    serial: str
    focal_mm: float
    marks_mm: Mapping[str, tuple[float, float]]
    separations_mm: Mapping[str, float]

    def key(self) -> tuple[object, ...]:
        """Key for finding duplicates."""
        marks, separations = tuple(self.marks_mm.items()), tuple(self.separations_mm.items())
        return (self.model, self.serial, self.focal_mm, marks, separations)


@dataclass(frozen=True)
class TypicalMark:
    """Typical mark: median of a number of reports. spread: whether sigma_mm is the spread of the reports."""

    place: str
    xy_mm: tuple[float, float]
    sigma_mm: tuple[float, float]
    reports: int
    spread: bool  # whether sigma_mm is the reports' own

    def lines(self, kind: Kind) -> list[str]:
        x, y = self.xy_mm
        sx, sy = self.sigma_mm
        few = "" if self.spread else ": too few cameras for a spread"
        lines = [
            "[[fiducial]]",
            f'id = "{PLACES[self.place]}"',
            f"xy_mm = [{x:.3f}, {y:.3f}]",
            f"sigma_mm = [{sx:.3f}, {sy:.3f}]               # of {self.reports} report{'s' * (self.reports > 1)}{few}",
        ]
        if not kind.marks:
            return [*lines, 'mark = "learned"']
        name = kind.drawn.get(self.place, "none")
        return [*lines, f'mark = "{name}"' + ("" if name != "none" else " " * 27 + "# its shape is not known")]


LEARNED_NOTE = (
    "# They are learned from the scans, from what recurs in all of them or from clicks in one; or draw them. A learned",
    "# mark lies off the reported one by as much as its template does, and its sigma grows by that.",
)


def main() -> None:
    """Write all cameras of the library, and print the rejected reports."""
    reports_folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    reports = list({report.key(): report for report in [*_typed(reports_folder), *_single(reports_folder)]}.values())
    for kind in KINDS:
        own = [report for report in reports if report.model in kind.models]
        marks = _separated(kind, own) if kind.separated else _coordinates(kind, own)
        for cone_mm in kind.cones_mm:
            of_cone = [report for report in own if abs(report.focal_mm - cone_mm) < CONE_MM]
            path = out / f"{kind.file}-{cone_mm}.toml"
            path.write_text(_camera(kind, cone_mm, of_cone, own, marks), encoding="utf-8")
        no_cone = [
            f"{report.focal_mm:g}"
            for report in own
            if all(abs(report.focal_mm - cone) >= CONE_MM for cone in kind.cones_mm)
        ]
        print(f"{kind.title}: {len(own)} reports; focal lengths of no cone: {', '.join(no_cone) or 'none'}")


def _typed(folder: Path) -> Iterable[Report]:
    with (folder / "usgs_reports.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            pairs = {place: (_number(row[f"{place}x"]), _number(row[f"{place}y"])) for place in PLACES}
            separations = {name: _number(row[name]) for name in SEPARATIONS}
            yield Report(
                "USGS",
                _model(row["camera_model"] or row["camera_make"]),
                row["camera_serial"],
                _number(row["focal"]),
                {place: pair for place, pair in pairs.items() if not math.isnan(sum(pair))},
                {name: value for name, value in separations.items() if not math.isnan(value)},
            )


def _single(folder: Path) -> Iterable[Report]:
    lmk = json.loads((folder / "OSL_1785.json").read_text(encoding="utf-8"))
    yield _single_report(lmk, "LMK", lmk["calibrated_focal_length_mm"], lmk["fiducials_mm"].values())
    for camera in json.loads((folder / "cameras.json").read_text(encoding="utf-8")):
        name, fiducials = camera["name"], camera.get("fiducials_mm", [])
        model = next((known for known in ("RC30", "RMK TOP", "RMK A") if known.lower() in name.lower()), None)
        if model is None:
            continue
        focal = camera["ppa_f_mm"][2] if "ppa_f_mm" in camera else camera.get("f_mm", math.nan)
        places = fiducials.values() if isinstance(fiducials, dict) else fiducials
        yield _single_report(camera, "RMK A 15/23" if model == "RMK A" else model, focal, places)


def _single_report(camera: Mapping[str, Any], model: str, focal_mm: float, xy: Iterable[Sequence[float]]) -> Report:
    marks = {_place(x, y): (x, y) for x, y in xy}
    serial = str(camera.get("camera_serial", camera.get("name")))
    return Report("single", model, serial, focal_mm, dict(sorted(marks.items())), {})


def _place(x_mm: float, y_mm: float) -> str:
    side = (round(x_mm / 100.0), round(y_mm / 100.0))
    return next(place for place, direction in DIRECTIONS.items() if direction == side)


def _model(model: str) -> str:
    if "LMK" in model:
        return "LMK"
    return "RMK TOP" if "TOP" in model else model


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _camera(
    kind: Kind, cone_mm: int, of_cone: Sequence[Report], own: Sequence[Report], marks: Sequence[TypicalMark]
) -> str:
    """camera.toml: the focal length of the cone's reports, the marks of all."""
    focal = np.array([report.focal_mm for report in of_cone])
    c_mm, c_sigma_mm = float(np.median(focal)), _spread(focal)
    c_note = f"the spread of {_count(focal, 'report')}"
    if _cameras(of_cone) < ENOUGH:
        c_sigma_mm = CONE_SPREAD * c_mm
        c_note = f"0.2 %, as of other cones: only {_count(focal, 'report')}"
    point_sigma = max(PRINCIPAL_POINT_MM, float(np.median([mark.sigma_mm for mark in marks])))
    lines = [
        f"# {kind.title}, the {cone_mm} mm cone. From the library of reseau: typical values, not those of one camera.",
        "# Sigmas are the spread over the reports about their median."
        + (" Seen with the data strip to the left." if kind.writing else ""),
        *(f"# {note}" for note in kind.notes),
        *_separation_lines(kind, own),
        *textwrap.wrap(f"# Shape of the marks: {kind.shape}.", 118, subsequent_indent="# "),
        *(() if kind.marks else LEARNED_NOTE),
        "",
        f'name = "{kind.title}, {cone_mm} mm"',
        f"frame_mm = [{kind.frame_mm}, {kind.frame_mm}]",
        *([kind.writing] if kind.writing else []),
        f"principal_distance_mm = {c_mm:.3f}",
        "principal_point_mm = [0.0, 0.0]         # the reports count from it",
        "",
        "[source]",
        f"reports = {len(own)}",
        f'text = "{_source(own)}"',
        "",
        "[sigma]",
        f"principal_distance_mm = {max(c_sigma_mm, LEAST_SIGMA_MM):.3f}           # {c_note}",
        f"principal_point_mm = {point_sigma:.3f}",
        "",
        "[distortion]                            # the reports' tables are not typed: the adjustment finds it",
        'family = "torlegard"',
        "[distortion.sigma]",
        *(f'{name} = "free"' for name in ("k3", "k5", "p1", "p2")),
    ]
    for mark in marks:
        lines += ["", *mark.lines(kind)]
    lines += _distance_lines(kind, own, marks)
    for name, drawing in (kind.marks or {"learned": LEARNED}).items():
        lines += ["", f"[mark.{name}]", drawing.rstrip()]
    return "\n".join(lines) + "\n"


def _coordinates(kind: Kind, own: Sequence[Report]) -> list[TypicalMark]:
    marks = []
    for group in (CORNERS, SIDES):
        places = [place for place in group if place in kind.places]
        used = _select_reports(kind, own, places) if places else []
        for place in places:
            xy = np.array([report.marks_mm[place] for report in used])
            x, y = np.median(xy, axis=0)
            sigma = (kind.sigma_mm, kind.sigma_mm)
            enough = _cameras(used) >= ENOUGH
            if enough:
                sigma = (max(_spread(xy[:, 0]), LEAST_SIGMA_MM), max(_spread(xy[:, 1]), LEAST_SIGMA_MM))
            marks.append(TypicalMark(place, (float(x), float(y)), sigma, len(xy), enough))
    return marks


def _select_reports(kind: Kind, own: Sequence[Report], places: Sequence[str]) -> list[Report]:
    """Select the reports with all of these marks, each within the gate around its median."""
    whole = [report for report in own if all(place in report.marks_mm for place in places)]
    xy = np.array([[report.marks_mm[place] for place in places] for report in whole])
    off = np.abs(xy - np.median(xy, axis=0)).max(axis=(1, 2))
    for report, distance in zip(whole, off, strict=True):
        if distance > kind.gate_mm:
            first = report.marks_mm[places[0]]
            print(f"  {kind.title} {report.serial}: off by {distance:.2f} mm, {places[0]} at {first}: left out")
    return [report for report, distance in zip(whole, off, strict=True) if distance <= kind.gate_mm]


def _separated(kind: Kind, own: Sequence[Report]) -> list[TypicalMark]:
    """Marks at half the median separations. Their sigma is that of a full separation, since its centre is uncertain,
    too."""
    marks = []
    for place in kind.places:
        right, up = DIRECTIONS[place]
        values = _separations(own, "lr_dist" if right else "tb_dist", kind.gate_mm)
        half, sigma = float(np.median(values)) / 2, _spread(values)
        marks.append(TypicalMark(place, (half * right, half * up), (sigma, sigma), len(values), True))
    return marks


def _separation_lines(kind: Kind, own: Sequence[Report]) -> list[str]:
    lines = []
    for name, words in SEPARATIONS.items():
        wanted = SIDES[0] if name in ("lr_dist", "tb_dist") else CORNERS[0]
        values = _separations(own, name, kind.gate_mm)
        if wanted in kind.places and len(values) > 1:
            median, spread = np.median(values), _spread(values)
            lines.append(f"# Separation {words}: {median:.3f} mm, spread {spread:.3f} ({len(values)} reports).")
    return lines


def _distance_lines(kind: Kind, own: Sequence[Report], marks: Sequence[TypicalMark]) -> Iterator[str]:
    """Yield distances between marks, weighted so that together with the coordinates they have the spread of the
    separations."""
    by_place = {mark.place: mark for mark in marks}
    for name, (start, end) in ENDS.items():
        values = _separations(own, name, kind.gate_mm)
        if not {start, end} <= by_place.keys() or len(values) < ENOUGH:
            continue
        direction = np.subtract(by_place[end].xy_mm, by_place[start].xy_mm)
        direction /= np.linalg.norm(direction)
        by_marks = sum(float(np.square(direction * by_place[place].sigma_mm).sum()) for place in (start, end))
        weight = 1.0 / max(_spread(values), LEAST_SIGMA_MM) ** 2 - 1.0 / by_marks
        if weight > 0.0:
            yield from ("", "[[fiducial_distance]]", f'from = "{PLACES[start]}"', f'to = "{PLACES[end]}"')
            yield f"mm = {np.median(values):.3f}"
            yield f"sigma_mm = {weight**-0.5:.3f}                        # of {len(values)} reports"


def _separations(own: Sequence[Report], name: str, gate_mm: float) -> np.ndarray:
    values = np.array([report.separations_mm[name] for report in own if name in report.separations_mm])
    return values[np.abs(values - np.median(values)) <= 2 * gate_mm] if len(values) else values


def _spread(values: np.ndarray) -> float:
    return SIGMA_OF_DEVIATION * float(np.median(np.abs(values - np.median(values))))


def _source(own: Sequence[Report]) -> str:
    typed = [report for report in own if report.source == "USGS"]
    single = [report for report in own if report.source != "USGS"]
    parts = []
    if typed:
        parts.append(_count(typed, "USGS calibration report"))
    if single:
        parts.append(f"{_count(single, 'calibration')} published singly")
    cameras = _cameras(own)
    return f"{' and '.join(parts)}, {cameras} camera{'s' * (cameras > 1)}"


def _cameras(reports: Sequence[Report]) -> int:
    """Number of different cameras: repeated calibrations of one tell little about the others."""
    return len({report.serial for report in reports})


def _count(things: Sequence[object] | np.ndarray, word: str) -> str:
    return f"{len(things)} {word}{'s' * (len(things) > 1)}"


if __name__ == "__main__":
    main()
