"""Design study: tables and figures of docs/validation/design-study.md.

python -m benchmarks design_study [FOLDER]

Expected precision of fiducial marks, interior orientation and distortion: the study announced by Torlegård, "for
various testfields, cameras and photogrammetric network design"; and Juhl's table and figures 1 and 2.
"""

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import synthetic_images
from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.functional_model.lens import INTERIOR_NAMES
from adjust.problem.parameter import Parameter
from benchmarks.harness import table
from pipeline.design.expected import expect, gains, rms, sigmas_of_images_alone
from pipeline.design.sweeps import Swept, Variations, over_layouts, sweep
from pipeline.rendered.scene_tables import Sweep

Row = Sequence[str | float]

JUHL = Path(synthetic_images.__file__).parent / "scenes" / "juhl_example.toml"
PAPER_UM = {"t1": 0.7, "t2": 0.7, "t3": 0.5, "t4": 0.4, "r1": 1.8, "r2": 1.7, "r3": 0.4, "af": 0.8, "sh": 0.6}
LAYOUTS = 30


@dataclass(frozen=True)
class StudyCamera:
    """Camera (mm) and its object distance (m)."""

    name: str
    frame_mm: float
    c_mm: float
    distance: float


WIDE = StudyCamera("wide angle, 23 x 23 / 15", 230.0, 150.0, 1500.0)
NORMAL = StudyCamera("normal angle, 23 x 23 / 30", 230.0, 300.0, 3000.0)
HANDY = StudyCamera("6 x 6 / 60 (close range)", 55.0, 60.0, 4.0)


@dataclass(frozen=True)
class StudyPlan:
    """Network design of the study; the defaults are the standard one.

    Attributes
    ----------
    points, photos, fiducials, layouts : numbers of points, photographs, fiducial marks and random layouts.
    relief : height range of the field, fraction of the distance.
    control : "known", "heights" or "unknown".
    tilt_deg : of the outer photographs towards the centre.
    kappas_deg : of the outer photographs in turn, counter-clockwise.
    point_um : standard deviation of the given coordinates at image scale.
    transformation : film transformation.
    target_um, fiducial_um : standard deviations of image coordinates.
    """

    camera: StudyCamera = WIDE
    points: int = 100
    relief: float = 0.0
    control: str = "known"
    photos: int = 5
    tilt_deg: float = 0.0
    kappas_deg: tuple[float, ...] = (0.0, 180.0, 90.0, 270.0)
    point_um: float = 0.0
    fiducials: int = 8
    transformation: str = "affine"
    target_um: float = 5.0
    fiducial_um: float = 3.0
    layouts: int = 5

    def scene(self) -> dict[str, Any]:
        """Content of the scene file."""
        camera = self.camera
        half = camera.frame_mm / 2
        side = camera.frame_mm / camera.c_mm * camera.distance  # ground width of a vertical photograph
        sigma: float | str = self.point_um / 1000.0 * camera.distance / camera.c_mm
        plane = {"known": sigma, "heights": "free", "unknown": "free"}[self.control]
        height = {"known": sigma, "heights": sigma, "unknown": "free"}[self.control]
        marks = [(x, y) for x in (1, -1) for y in (1, -1)] + [(1, 0), (-1, 0), (0, 1), (0, -1)]
        return {
            "camera": {
                "name": camera.name,
                "frame_mm": [camera.frame_mm, camera.frame_mm],
                "principal_distance_mm": camera.c_mm,
                "sigma": {"principal_distance_mm": "free", "principal_point_mm": "free"},
                "distortion": {
                    "family": "torlegard",
                    "sigma": {"k3": "free", "k5": "free", "p1": "free", "p2": "free"},
                },
                "fiducial": [
                    {"id": str(i + 1), "xy_mm": [0.92 * half * x, 0.92 * half * y], "sigma_mm": "free"}
                    for i, (x, y) in enumerate(marks[: self.fiducials])
                ],
            },
            "field": {
                "diameter_mm": 10.0,
                "scatter": [
                    {
                        "first": 1,
                        "points": self.points,
                        "right": [0.9 * side, 0.0, 0.0],
                        "up": [0.0, 0.9 * side, 0.0],
                        "relief": self.relief / 2 * camera.distance,
                    }
                ],
            },
            "scan": {"pitch_um": 20.0},
            "image": [self._image(i) for i in range(self.photos)],
            "design": {
                "transformation": self.transformation,
                "datum": "control" if self.control == "known" else "minimal",
                "sigma_target_um": self.target_um,
                "sigma_fiducial_um": self.fiducial_um,
                "sigma_planimetry": plane,
                "sigma_height": height,
                "radii_mm": [0.435 * camera.frame_mm],
            },
        }

    def _image(self, number: int) -> dict[str, Any]:
        """Image table: the first over the centre, the others on a circle around it, with a radius of a tenth of the
        distance or as required by the tilt."""
        distance = self.camera.distance
        if number == 0:
            return {"name": "1", "position": [0.0, 0.0, distance], "angles_deg": [0.0, 0.0, 0.0]}
        kappa = self.kappas_deg[(number - 1) % len(self.kappas_deg)]
        around = 2 * math.pi * (number - 1) / max(self.photos - 1, 1)
        tilt = math.radians(self.tilt_deg)
        out = max(math.sin(tilt), 0.1) * distance
        # Tilted around the axis perpendicular to the outward direction, towards the centre of the field.
        axis = np.array([-math.sin(around), math.cos(around), 0.0])
        omega, phi, kappa_rad = _angles(axis, -tilt, math.radians(kappa))
        return {
            "name": str(number + 1),
            "position": [out * math.cos(around), out * math.sin(around), math.cos(tilt) * distance],
            "angles_deg": [math.degrees(omega), math.degrees(phi), math.degrees(kappa_rad)],
        }


def _angles(axis: np.ndarray[Any, Any], turn: float, kappa: float) -> tuple[float, float, float]:
    """omega, phi, kappa of a vertical camera rotated around a horizontal axis, then around its own axis."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    tilted = np.eye(3) + math.sin(turn) * cross + (1 - math.cos(turn)) * cross @ cross
    roll = np.array([[math.cos(kappa), math.sin(kappa), 0], [-math.sin(kappa), math.cos(kappa), 0], [0, 0, 1]])
    m = roll @ tilted
    return math.atan2(-m[2, 1], m[2, 2]), math.asin(m[2, 0]), math.atan2(-m[1, 0], m[0, 0])


HEADS = ("fiducials", "c", "x0', y0'", "radial", "tangential")


def row(plan: StudyPlan) -> tuple[list[float], int]:
    """Expected sigmas in the order of HEADS, µm, mean over the layouts, and the number of undetermined quantities.

    They are those of the photographs alone, in the datum of the fiducials; inf: not determined. The distortion is at
    0.435 frame widths, 100 mm for an aerial camera.
    """
    scene = Variations(Path("study"), plan.scene())
    found = []
    defect = 0
    for layout in range(plan.layouts):
        expected = expect(scene.setup(layout))
        sigmas = sigmas_of_images_alone(expected)
        marks = [sigma for parameter, sigma in sigmas.items() if parameter.kind == "fiducial"]
        c, x0, y0 = (sigmas[Parameter.interior(expected.camera, name)] for name in INTERIOR_NAMES)
        at = expected.curve[0]
        found.append([UM_PER_MM * rms(marks), UM_PER_MM * c, UM_PER_MM * rms([x0, y0]), at.radial_um, at.tangential_um])
        defect = sum(sigma == math.inf for sigma in sigmas.values())
    return [float(value) for value in np.mean(found, axis=0)], defect


def study() -> Iterable[tuple[str, str, list[tuple[str, StudyPlan]]]]:
    """Yield key, title and designs of each table."""
    fields = [
        ("known, flat", StudyPlan()),
        ("known, relief 5 %", StudyPlan(relief=0.05)),
        ("known, relief 20 %", StudyPlan(relief=0.2)),
        ("heights only, flat", StudyPlan(control="heights")),
        ("heights only, relief 20 %", StudyPlan(control="heights", relief=0.2)),
        ("unknown (self-calibration), flat", StudyPlan(control="unknown")),
        ("unknown (self-calibration), relief 20 %", StudyPlan(control="unknown", relief=0.2)),
    ]
    yield "fields-vertical", "Test fields, five vertical photographs", fields
    convergent = [(words, replace(plan, tilt_deg=30.0)) for words, plan in fields]
    yield "fields-convergent", "Test fields, one vertical and four convergent photographs (30°)", convergent
    cameras = [
        (f"{camera.name}, {words}", replace(plan, camera=camera))
        for camera in (WIDE, NORMAL, HANDY)
        for words, plan in (
            ("vertical, relief 20 %", StudyPlan(relief=0.2)),
            ("convergent 30°, flat", StudyPlan(tilt_deg=30.0)),
        )
    ]
    yield "cameras", "Cameras, known field", cameras
    yield (
        "kappa",
        "Kappa, five convergent photographs (30°)",
        [
            (f"{words}, {kind}", StudyPlan(tilt_deg=30.0, kappas_deg=kappas, control=kind))
            for kind in ("known", "unknown")
            for words, kappas in (
                ("all alike", (0.0,)),
                ("0, 180", (0.0, 180.0)),
                ("0, 90", (0.0, 90.0)),
                ("0, 180, 90, 270", (0.0, 180.0, 90.0, 270.0)),
                ("0, 90, 180, 270: the same side of the camera towards the field", (0.0, 90.0, 180.0, 270.0)),
            )
        ],
    )
    yield (
        "transformations",
        "Fiducials and film transformations, five convergent photographs (30°), known field",
        [
            (f"{kind}, {count} fiducials", StudyPlan(tilt_deg=30.0, transformation=kind, fiducials=count))
            for kind in ("congruent", "similarity", "affine", "bilinear", "projective", "polynomial(2)")
            for count in (4, 8)
            if not (kind == "polynomial(2)" and count == 4)
        ],
    )
    base = StudyPlan(tilt_deg=30.0)
    yield (
        "photos",
        "Number of photographs, the first vertical, flat known field",
        [(f"{n}", replace(base, photos=n, kappas_deg=(0.0,))) for n in (2, 3, 4, 5, 9, 17)],
    )
    yield (
        "convergence",
        "Tilt of the outer four photographs over a flat known field, degrees",
        [(f"{t}", replace(base, tilt_deg=float(t))) for t in (0, 2, 5, 10, 20, 30, 40)],
    )
    yield "points", "Number of points", [(f"{n}", replace(base, points=n)) for n in (12, 25, 50, 100, 200)]
    yield (
        "control",
        "Standard deviation of the given coordinates, µm at image scale",
        [(f"{s:g}", replace(base, point_um=s)) for s in (0.0, 2.0, 5.0, 10.0, 20.0, 50.0)],
    )
    yield (
        "fiducial-sigma",
        "Standard deviation of the measured fiducials, µm",
        [(f"{s:g}", replace(base, fiducial_um=s)) for s in (1.0, 3.0, 5.0, 9.0)],
    )


def tables(folder: Path) -> str:
    """All tables in Markdown; those over a numeric quantity are also drawn as figures."""
    text = []
    for key, title, plans in study():
        rows = [(words, row(plan)[0]) for words, plan in plans]
        text.append(f"## {key}: {title}\n\n" + markdown(("", *HEADS), [(words, *values) for words, values in rows]))
        print(text[-1], flush=True)
        if key in ("photos", "convergence", "points", "control"):
            draw_study(folder / f"{key}.png", title, rows)
    return "\n".join(text)


def markdown(heads: Sequence[str], rows: Iterable[Row]) -> str:
    """Markdown table; numbers to two digits, a dash for undetermined ones."""
    lines = (dict(zip(heads, map(_cell, row), strict=True)) for row in rows)
    return "\n".join(table(dict.fromkeys(heads, ""), lines)) + "\n"


def _cell(cell: str | float) -> str:
    if isinstance(cell, str):
        return cell
    if not math.isfinite(cell):
        return "–"
    return f"{cell:.0f}" if abs(cell) >= 9.95 else f"{cell:.1f}" if abs(cell) >= 0.995 else f"{cell:.2f}"


def draw_study(path: Path, title: str, rows: list[tuple[str, list[float]]]) -> None:
    """Plot the standard deviations over the quantity of a table: logarithms on both axes, 0 a step below the least."""
    places = np.array([float(words) for words, _ in rows])
    axes = _draw(places, {head: [values[k] for _, values in rows] for k, head in enumerate(HEADS)})
    axes.set(yscale="log", xlabel=title)
    axes.set_xscale("symlog", linthresh=places[places > 0.0].min(), linscale=0.3)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(places, [words for words, _ in rows])
    _save(path, axes)


def juhl(folder: Path) -> str:
    """Juhl's table, figures and fourth photograph."""
    scene = Variations.read(JUHL)
    scene.values["design"]["layouts"] = LAYOUTS
    points = sweep(scene, 1, Sweep(quantity="field.points", values=(75, 100, 125, 150, 175, 200)))
    heights = sweep(
        scene, 2, Sweep(quantity="design.sigma_height", values=(0.001, 0.01, 0.02, 0.04, 0.075, 0.11, 0.15, 0.225, 0.3))
    )
    standard = next(step for step in points.steps if step.value == 150)
    fourth = Variations(scene.path, scene.values | {"image": [*scene.values["image"], _fourth(scene)]})
    after = over_layouts(fourth, expect(fourth.setup()))
    gain = gains(standard.sigmas.mean, after.mean)
    rows: list[Row] = [
        (
            name,
            paper,
            f"{standard.sigmas.mean[name]:.2f}",
            f"{standard.sigmas.spread[name]:.2f}",
            f"{100 * (standard.sigmas.mean[name] / paper - 1):+.0f} %",
            f"{points.slope(name):.2f}",
            f"{gain[name]:.0f} %",
        )
        for name, paper in PAPER_UM.items()
    ]
    heads = ("", "paper", "here, mean", "spread", "difference", "slope of figure 1", "fourth photograph")
    _draw_points(folder / "juhl-figure-1.png", points)
    _draw_heights(folder / "juhl-figure-2.png", heights)
    by_height: list[Row] = [
        (f"{1000 * float(step.value) / 1500:.4f}", *(f"{step.sigmas.mean[name]:.2f}" for name in PAPER_UM))
        for step in heights.steps
    ]
    return markdown(heads, rows) + "\n" + markdown(("heights, per mille of H", *PAPER_UM), by_height)


def _fourth(scene: Variations) -> dict[str, Any]:
    return dict(scene.values["design"]["photo"][0])


def _draw_points(path: Path, swept: Swept) -> None:
    counts = np.array([float(step.value) for step in swept.steps])
    axes = _draw(counts, {name: [step.sigmas.mean[name] for step in swept.steps] for name in PAPER_UM})
    first = swept.steps[0].sigmas.mean["t1"]
    for slope, style, whose in ((-0.5, ":", "slope"), (-0.62, "--", "Juhl's slope")):
        axes.plot(counts, 1.8 * first * (counts / counts[0]) ** slope, style, color="0.5", label=f"{whose} {slope}")
    axes.set(xscale="log", yscale="log", xlabel="number of points")
    for axis, places in ((axes.xaxis, counts), (axes.yaxis, np.array([0.3, 0.5, 1.0, 2.0, 3.0]))):
        axis.set_ticks(places, [f"{place:g}" for place in places])
        axis.set_ticks([], minor=True)
    _save(path, axes)


def _draw_heights(path: Path, swept: Swept) -> None:
    per_mille = [1000 * float(step.value) / 1500 for step in swept.steps]
    curves = {name: [step.sigmas.mean[name] for step in swept.steps] for name in ("r1", "r2", "t1", "af")}
    axes = _draw(per_mille, curves)
    axes.axvline(0.05, color="0.5", linestyle=":", label='0.05 ‰, the paper\'s "maybe"')
    axes.set(xlabel="standard deviation of the heights, ‰ of the flying height", ylim=(0.0, None))
    _save(path, axes)


def _draw(places: Sequence[float] | np.ndarray[Any, Any], curves: dict[str, list[float]]) -> Axes:
    """Axes with standard deviations over a quantity; those not determined are left out."""
    figure = Figure(figsize=(6.0, 4.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, values in curves.items():
        axes.plot(places, np.where(np.isfinite(values), values, np.nan), marker="o", markersize=4, label=name)
    axes.set_ylabel("expected standard deviation, µm")
    axes.grid(visible=True, which="both", color="0.9")
    return axes


def _save(path: Path, axes: Axes) -> None:
    axes.figure.legend(frameon=False, fontsize=8, ncols=6, loc="outside upper center")
    axes.figure.canvas.print_figure(path)


def main() -> None:
    """Print the tables and write the figures."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/design")
    folder.mkdir(parents=True, exist_ok=True)
    print(juhl(folder), flush=True)
    tables(folder)


if __name__ == "__main__":
    main()
