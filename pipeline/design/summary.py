"""Printed tables and plots of reseau design: expected precision, improvements, sweeps."""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from markupsafe import Markup
from rich.console import Console
from rich.text import Text

from adjust.functional_model.distortion_models import UM_PER_MM
from adjust.problem.parameter import Parameter, description
from pipeline.design.design_file import Design
from pipeline.design.expected import (
    FOUND,
    Alternative,
    GroupReliability,
    alternatives,
    error_unit,
    expect,
    rms,
    sigmas_of_images_alone,
)
from pipeline.design.sweeps import Swept, Variations, over_layouts, sweep
from pipeline.drawing import svg
from pipeline.report.numbers import NONE, fixed, significant, typed, value_and_sigma
from pipeline.results.record_json import write_record
from pipeline.terminal import Reporter, uncut_table
from pipeline.text.files import FORMS, check_replaceable, check_writable

WIDE_RANGE = 2.0  # ratio of the largest to the smallest value, from which the axis is logarithmic
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555")  # colour-blind safe
DASHES = ("none", "7 3", "2 3", "7 3 2 3")
WIDTH_PX, HEIGHT_PX, KEY_PX = 760.0, 460.0, 160.0
ROW_PX = 17.0  # px, height of a name in the legend
UNDETERMINED = "not determined"
SLOPE = "slope"  # last row of the table of a sweep
KINDS = {
    "datum": "given fiducial",
    "control": "given point",
    "interior": "given interior",
    "scanner": "given scanner",
    "exterior": "given exterior",
}
UNIT_WORDS = {"um": " µm", "object unit": ""}
LABELS = {"x0": "x0'", "y0": "y0'"}
IN_UM = ("c", "x0", "y0", "fiducials", "ray", "scanner")
PrintedTable = tuple[str, Sequence[str], Iterable[Sequence[str]]]  # title, heads, rows


def plot_sweep(swept: Swept, path: Path) -> None:
    """Plot a sweep as SVG: every standard deviation relative to its first finite value.

    Quantities of different units thus share one axis. Raises InputError where the file cannot be written.
    """
    values = [step.value for step in swept.steps]
    places = [float(value) for value in values] if swept.numeric else [float(i) for i in range(len(values))]
    shares = {name: _relative([step.sigmas.mean.get(name, math.nan) for step in swept.steps]) for name in swept.names}
    axes = _axes(swept, places, shares)
    curves = [_curve(axes, number, places, each) for number, each in enumerate(shares.values())]
    key, x = [], axes.width - axes.right + 10.0
    for number, name in enumerate(shares):
        y = axes.top + ROW_PX * (number + 0.5)
        key.append(_stroke(number, f"M{x:.1f} {y:.1f}h26") + svg.words(x + 32.0, y + 4.0, name, "tick"))
    chart = axes.grid(swept.quantity, "expected standard deviation, first value = 1")
    height = max(axes.height, axes.top + ROW_PX * (len(key) + 1))
    svg.write_picture(path, axes.width, height, f"Expected precision over {swept.quantity}", chart, *curves, *key)


def _axes(swept: Swept, places: list[float], shares: dict[str, list[float]]) -> svg.Axes:
    """Axes of the chart, with space for the legend at the right."""
    drawn = [share for each in shares.values() for share in each if math.isfinite(share)] or [1.0]
    is_log = swept.numeric and min(places) > 0.0 and max(places) >= WIDE_RANGE * min(places)
    width = max(places) - min(places)
    if is_log:
        edge = (max(places) / min(places)) ** 0.04
        x_range = (min(places) / edge, max(places) * edge)
    else:
        x_range = (min(places) - 0.04 * width, max(places) + 0.04 * width) if width else (places[0] - 1, places[0] + 1)
    texts = [f"{step.value:g}" if not isinstance(step.value, str) else step.value for step in swept.steps]
    return svg.Axes(
        x_range,
        (min(drawn) / 1.1, max(drawn) * 1.1),
        width=WIDTH_PX,
        height=HEIGHT_PX,
        right=KEY_PX,
        x_is_log=is_log,
        y_is_log=True,
        x_ticks=dict(zip(places, texts, strict=True)),
    )


def _curve(axes: svg.Axes, number: int, places: list[float], shares: list[float]) -> Markup:
    """A line through the finite values, interrupted where there is none, and a dot at each."""
    pixels = [
        (float(axes.x(place)), float(axes.y(share))) if math.isfinite(share) else None
        for place, share in zip(places, shares, strict=True)
    ]
    path = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in pairwise(pixels) if a and b)
    color = COLORS[number % len(COLORS)]
    dots = [svg.tag("circle", cx=pixel[0], cy=pixel[1], r=2.5, fill=color) for pixel in pixels if pixel]
    return _stroke(number, path) + Markup("").join(dots)


def _stroke(number: int, path: str) -> Markup:
    dash, color = DASHES[number // len(COLORS) % len(DASHES)], COLORS[number % len(COLORS)]
    return svg.tag("path", d=path, fill="none", stroke=color, stroke_width=1.6, stroke_dasharray=dash)


def _relative(sigmas: list[float]) -> list[float]:
    """Ratios to the first finite value; nan where there is none."""
    first = next((sigma for sigma in sigmas if 0.0 < sigma < math.inf), math.nan)
    return [sigma / first if math.isfinite(sigma) else math.nan for sigma in sigmas]


def print_design(design: Design, console: Console) -> None:
    """Print the tables of a design to the console; file paths are not wrapped."""
    expected, adjustment = design.expected, design.expected.plan.adjustment
    console.print(
        f"{len(expected.network.images)} photographs, {len(expected.network.points)} points, redundancy "
        f"{adjustment.redundancy}, sigma0 {expected.plan.sigma0:g} (given)",
        highlight=False,
    )
    for null in expected.plan.singular:
        console.print(Text(f"- {description(null.parameters)}: {null.cause}", style="bold yellow"))
        console.print(Text(f"  {null.remedy}", style="dim"))
    for warning in adjustment.warnings:
        console.print(Text(f"- {warning}"))
    for title, heads, rows in (*_tables(design), *map(_sweep_table, design.swept)):
        table = uncut_table(heads, title)
        for row in rows:
            if row[0] == SLOPE:
                table.add_section()
            table.add_row(*(Text(typed(cell)) for cell in row))
        if table.row_count:
            console.print(table)
    for word, path in design.files.items():
        console.print(f"{word}: {path}", soft_wrap=True, markup=False, highlight=False)


def _tables(design: Design) -> Iterator[PrintedTable]:
    """Yield the tables of a design, except those of its sweeps."""
    expected, alone, layouts = design.expected, design.alone, design.layouts
    camera, plan = expected.camera, expected.plan
    yield _camera_table(design)
    curve = [(f"{r.radius_mm:.1f}", *map(_sigma, (r.radial_um, r.tangential_um, r.ray_um))) for r in expected.curve]
    yield "Distortion, sigma in µm", ("radius, mm", "radial", "tangential", "image of a ray"), curve
    places = {id: [Parameter.fiducial(camera, id, axis) for axis in "xy"] for id in expected.fiducials}
    fiducials = [
        (
            id,
            *(_sigma(UM_PER_MM * sigma) for sigma in (*map(plan.sigma, place), *(alone[each] for each in place))),
        )
        for id, place in places.items()
    ]
    without = ("x', without given values", "y', without given values")
    yield "Fiducial marks, sigma in µm", ("fiducial", "x'", "y'", *without), fiducials
    bend = [(each.quantity, _sigma(UM_PER_MM * sigma)) for each, sigma in expected.scanner_sigmas.items()]
    yield "Bend of the scanner", ("term", "sigma, µm"), bend
    free = {axis: sigmas[sigmas > 0.0] for axis, sigmas in zip("XYZ", expected.point_sigmas.T, strict=True)}
    points = [
        (axis, *(map(_sigma, (rms(sigmas), float(sigmas.max()))) if len(sigmas) else ("fixed", "fixed")))
        for axis, sigmas in free.items()
    ]
    yield "Object points, sigma", ("coordinate", "rms", "largest"), points
    heads = ("kind", "coordinates", "redundancy", "median", "largest", "unchecked")
    yield "Internal reliability: minimal detectable errors", heads, map(_reliability_row, expected.groups)
    # Outer reliability of the camera; of the fiducials only the worst is shown.
    marks = [one for one in expected.outer_effects if one.parameter.kind == "fiducial"]
    effects = [one for one in expected.outer_effects if one not in marks]
    effects += sorted(marks, key=lambda one: -one.in_sigmas)[:1]
    outer = [(one.parameter.label, f"{one.in_sigmas:.1f}", one.cause) for one in effects]
    yield (
        "External reliability: largest effect of an undetected error",
        ("parameter", "in its sigmas", "error in"),
        outer,
    )
    names = list(expected.camera_sigmas)
    gains = [(one.change, *(_gain(one.gain_percent[name]) for name in names)) for one in design.helpful]
    title = "Improvements: decrease of sigma, %"
    first = ", of the first layout" if layouts.count > 1 else ""
    yield title + first, ("change", *(LABELS.get(name, name) for name in names)), gains


def _camera_table(design: Design) -> PrintedTable:
    """Expected precision of the camera; with fiducials also from the photographs alone, in their frame."""
    expected, layouts = design.expected, design.layouts
    several, rows = layouts.count > 1, []
    heads = ["quantity", "value", "sigma", *(["without given values"] if expected.fiducials else [])]
    heads += [f"mean of {layouts.count} layouts", "spread"] if several else []
    labels = {"c": "principal distance, mm", "x0": "principal point x', mm", "y0": "principal point y', mm"}
    for name, label in {**labels, **{name: name for name in expected.family_parameters}}.items():
        parameter = Parameter.interior(expected.camera, name)
        value, sigma = expected.plan.adjustment.value(parameter), expected.plan.sigma(parameter)
        cells = [
            label,
            *((significant(value, 6), UNDETERMINED) if math.isinf(sigma) else value_and_sigma(value, sigma)),
        ]
        if expected.fiducials:
            size = max(abs(value), sigma)  # what the value's power of ten comes from
            cells.append(_sigma(design.alone[parameter], size if math.isfinite(size) else 0.0) if sigma > 0.0 else "")
        if several and name in layouts.mean:
            scale = UM_PER_MM if name in IN_UM else 1.0
            cells += [_sigma(layouts.mean[name] / scale), _sigma(layouts.spread[name] / scale)]
        rows.append(cells)
    return f"Expected precision of camera {expected.camera}", heads, rows


def _reliability_row(one: GroupReliability) -> tuple[str, ...]:
    unit = error_unit(one.group)
    sizes = () if unit == "mixed" else (one.median, one.largest)
    errors = [_sigma(size) + UNIT_WORDS[unit] if math.isfinite(size) else NONE for size in sizes] or [NONE, NONE]
    return KINDS.get(one.group, one.group), str(one.coordinates), fixed(one.redundancy), *errors, str(one.unchecked)


def _sweep_table(swept: Swept) -> PrintedTable:
    names, layouts = swept.names, swept.steps[0].sigmas.count
    heads = (swept.quantity, "points", *(f"{LABELS.get(name, name)}, µm" if name in IN_UM else name for name in names))
    rows = [
        (
            step.value if isinstance(step.value, str) else f"{step.value:g}",
            str(step.points),
            *(_sigma(step.sigmas.mean[name]) if name in step.sigmas.mean else "fixed" for name in names),
        )
        for step in swept.steps
    ]
    slopes = [swept.slope(name) for name in names]
    if not all(math.isnan(slope) for slope in slopes):
        rows.append((SLOPE, "", *("" if math.isnan(slope) else f"{slope:+.2f}" for slope in slopes)))
    return f"Sigmas over {swept.quantity}" + (f", mean of {layouts} layouts" if layouts > 1 else ""), heads, rows


def _sigma(sigma: float, size: float = 0.0) -> str:
    """Format a standard deviation with two digits, and with the power of ten of a number of that size (0: its own)."""
    if sigma == 0.0:
        return "0"
    return UNDETERMINED if math.isinf(sigma) else value_and_sigma(sigma, sigma, size)[1]


def _gain(percent: float) -> str:
    """Gain of a standard deviation; "found": only the changed plan determines it, "lost": only the original one."""
    if math.isnan(percent):
        return NONE
    if percent == FOUND:
        return "found"
    return "lost" if math.isinf(percent) else fixed(percent, 0)


def run_design(scene_path: Path, out_dir: Path | None, reporter: Reporter) -> Design:
    """Plan a scene, vary it, and write design.json and the plots of its sweeps.

    out_dir: None: a folder next to the scene file, with its name and "-design". Raises InputError or AdjustmentError
    where the scene cannot be planned.
    """
    folder = out_dir or scene_path.with_name(f"{scene_path.stem}-design")
    scene = Variations.read(scene_path)
    setup = scene.setup()
    files = {"design": folder / "design.json"}
    for number, each in enumerate(setup.settings.sweep, 1):
        word = f"sweep of {each.quantity}" if f"sweep of {each.quantity}" not in files else f"sweep {number}"
        files[word] = folder / f"sweep-{number}-{each.quantity}.svg"
    for path in files.values():
        check_replaceable(path, FORMS[path.suffix], "name another folder")
    check_writable(folder)
    with reporter.stage("planning") as count:
        count(scene_path.name, 0, 1)
        expected = expect(setup)
        without_given = sigmas_of_images_alone(expected)
        layouts = over_layouts(scene, expected)
    helpful: tuple[Alternative, ...] = ()
    if setup.settings.alternatives:
        with reporter.stage("trying") as count:
            helpful = alternatives(expected, count)
    swept = []
    _, *plots = files.values()
    for number, (each, path) in enumerate(zip(setup.settings.sweep, plots, strict=True), 1):
        with reporter.stage("varying") as count:
            swept.append(sweep(scene, number, each, count))
        plot_sweep(swept[-1], path)
    design = Design(scene.path, expected, without_given, layouts, helpful, tuple(swept), files)
    write_record(design.content(), files["design"])
    return design
