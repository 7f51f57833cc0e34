"""What reseau design prints and draws: the expected precision, what would help, the sweeps."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from markupsafe import Markup
from rich.console import Console
from rich.table import Table
from rich.text import Text

from adjust.problem.parameter import Parameter, description
from pipeline.design.alternatives import FOUND, Alternative
from pipeline.design.expected import Expected, error_unit, rms
from pipeline.design.sweeps import Layouts, Swept
from pipeline.drawing import svg
from pipeline.report.numbers import NONE, fixed, significant, value_and_sigma

WIDE_RANGE = 2.0  # ratio of the largest to the smallest value from which on the axis is logarithmic
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555")  # told apart by the color-blind
DASHES = ("none", "7 3", "2 3", "7 3 2 3")
WIDTH_PX, HEIGHT_PX, KEY_PX = 760.0, 460.0, 160.0
ROW_PX = 17.0  # of a name beside the chart
UNDETERMINED = "not determined"
UM_PER_MM = 1000.0
KINDS = {
    "datum": "given fiducial",
    "control": "given point",
    "interior": "given interior",
    "scanner": "given scanner",
    "exterior": "given exterior",
}
UNIT_WORDS = {"um": " µm", "object unit": ""}
LABELS = {"c": "c", "x0": "x0'", "y0": "y0'", "fiducials": "fiducials", "ray": "ray", "scanner": "scanner"}
UNITS = {"c": "µm", "x0": "µm", "y0": "µm", "fiducials": "µm", "ray": "µm", "scanner": "µm"}


def plot_sweep(swept: Swept, path: Path) -> None:
    """Write an SVG: every standard deviation as a share of that at the first value where it has one.

    Only so do quantities of different units go on one axis. Raises InputError where the file cannot be written.
    """
    values = [step.value for step in swept.steps]
    places = [float(value) for value in values] if swept.numeric else [float(i) for i in range(len(values))]
    shares = {name: _relative([step.sigmas.mean.get(name, math.nan) for step in swept.steps]) for name in swept.names}
    axes = _axes(swept, places, shares)
    curves = [_curve(axes, number, places, each) for number, each in enumerate(shares.values())]
    key = [_key(axes, number, name) for number, name in enumerate(shares)]
    chart = axes.drawn(swept.quantity, "expected standard deviation, first value = 1")
    height = max(axes.height, axes.top + ROW_PX * (len(key) + 1))
    svg.write_picture(path, axes.width, height, f"Expected precision over {swept.quantity}", chart, *curves, *key)


def _axes(swept: Swept, places: list[float], shares: dict[str, list[float]]) -> svg.Axes:
    """The chart's plane, with room for the names at its right."""
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
    """A line through the values that there are, interrupted where there is none, and a dot at each."""
    pixels = [(float(axes.x(place)), float(axes.y(share))) for place, share in zip(places, shares, strict=True)]
    there = [math.isfinite(share) for share in shares]
    pairs = zip(pixels, pixels[1:], there, there[1:], strict=False)
    path = "".join(f"M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" for (x0, y0), (x1, y1), a, b in pairs if a and b)
    dots = [
        svg.tag("circle", cx=x, cy=y, r=2.5, fill=_color(number)) for (x, y), a in zip(pixels, there, strict=True) if a
    ]
    return _stroke(number, path) + Markup("").join(dots)


def _key(axes: svg.Axes, number: int, name: str) -> Markup:
    x, y = axes.width - axes.right + 10.0, axes.top + ROW_PX * (number + 0.5)
    return _stroke(number, f"M{x:.1f} {y:.1f}h26") + svg.words(x + 32.0, y + 4.0, name, "tick")


def _stroke(number: int, path: str) -> Markup:
    dash = DASHES[number // len(COLORS) % len(DASHES)]
    return svg.tag("path", d=path, fill="none", stroke=_color(number), stroke_width=1.6, stroke_dasharray=dash)


def _color(number: int) -> str:
    return COLORS[number % len(COLORS)]


def _relative(sigmas: list[float]) -> list[float]:
    """Shares of the first that is finite; nan where there is none."""
    first = next((sigma for sigma in sigmas if 0.0 < sigma < math.inf), math.nan)
    return [sigma / first if math.isfinite(sigma) else math.nan for sigma in sigmas]


def print_design(
    expected: Expected,
    alone: Mapping[Parameter, float],
    layouts: Layouts,
    helpful: tuple[Alternative, ...],
    swept: Iterable[Swept],
    files: Mapping[str, Path],
    console: Console,
) -> None:
    """For a person; file paths are never folded."""
    adjustment = expected.plan.adjustment
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
    console.print(_camera_table(expected, alone, layouts))
    console.print(_curve_table(expected))
    if expected.fiducials:
        console.print(_fiducial_table(expected, alone))
    if expected.network.scanners:
        console.print(_scanner_table(expected))
    console.print(_point_table(expected))
    if expected.reliability.groups:
        console.print(_reliability_table(expected))
        console.print(_outer_table(expected))
    if helpful:
        console.print(_help_table(expected, helpful, layouts))
    for one in swept:
        console.print(_sweep_table(one))
    for word, path in files.items():
        console.print(f"{word}: {path}", soft_wrap=True, markup=False, highlight=False)


def _camera_table(expected: Expected, alone: Mapping[Parameter, float], layouts: Layouts) -> Table:
    """With fiducials beside it: what the photographs alone tell, in the frame that the fiducials make."""
    several = layouts.count > 1
    title = f"Expected precision of camera {expected.camera}"
    table = Table("quantity", "value", "sigma", title=title, title_justify="left")
    if expected.fiducials:
        table.add_column("photographs alone")
    if several:
        table.add_column(f"mean of {layouts.count} layouts")
        table.add_column("spread")
    plan = expected.plan
    rows = {"c": "principal distance, mm", "x0": "principal point x', mm", "y0": "principal point y', mm"}
    rows |= {name: name for name in expected.family_parameters}
    for name, label in rows.items():
        parameter = Parameter.interior(expected.camera, name)
        sigma = plan.sigma(parameter)
        cells = [label, *_told(plan.adjustment.value(parameter), sigma)]
        if expected.fiducials:
            cells.append(_sigma(alone[parameter]) if sigma > 0.0 else "")
        if several and name in layouts.mean:
            scale = UM_PER_MM if name in UNITS else 1.0
            cells += [_sigma(layouts.mean[name] / scale), _sigma(layouts.spread[name] / scale)]
        table.add_row(*cells)
    return table


def _curve_table(expected: Expected) -> Table:
    table = Table(
        "radius, mm", "radial", "tangential", "image of a ray", title="Distortion, sigma in µm", title_justify="left"
    )
    for at in expected.curve:
        table.add_row(f"{at.radius_mm:.1f}", _sigma(at.radial_um), _sigma(at.tangential_um), _sigma(at.ray_um))
    return table


def _fiducial_table(expected: Expected, alone: Mapping[Parameter, float]) -> Table:
    heads = ("x', µm", "y', µm", "photographs alone: x', µm", "y', µm")
    table = Table("fiducial", *heads, title="Fiducial marks, sigma", title_justify="left")
    for id in expected.fiducials:
        place = [Parameter.fiducial(expected.camera, id, axis) for axis in "xy"]
        sigmas = (*(expected.plan.sigma(each) for each in place), *(alone[each] for each in place))
        table.add_row(Text(id), *(_sigma(UM_PER_MM * sigma) for sigma in sigmas))
    return table


def _scanner_table(expected: Expected) -> Table:
    table = Table("term", "sigma, µm", title="Bend of the scanner", title_justify="left")
    for parameter, sigma in expected.scanner_sigmas.items():
        table.add_row(parameter.quantity, _sigma(UM_PER_MM * sigma))
    return table


def _point_table(expected: Expected) -> Table:
    table = Table("coordinate", "rms", "largest", title="Object points, sigma", title_justify="left")
    for axis, sigmas in zip("XYZ", expected.point_sigmas.T, strict=True):
        free = [float(sigma) for sigma in sigmas if sigma > 0.0]
        table.add_row(axis, _sigma(rms(free)) if free else "fixed", _sigma(max(free)) if free else "fixed")
    return table


def _reliability_table(expected: Expected) -> Table:
    title = "Smallest gross errors that are found"
    table = Table(
        "kind", "coordinates", "redundancy", "median", "largest", "unchecked", title=title, title_justify="left"
    )
    for one in expected.reliability.groups:
        unit = error_unit(one.group)
        sizes = () if unit == "mixed" else (one.median, one.largest)
        errors = [_sigma(size) + UNIT_WORDS[unit] if math.isfinite(size) else NONE for size in sizes] or [NONE, NONE]
        table.add_row(
            KINDS.get(one.group, one.group), str(one.coordinates), fixed(one.redundancy), *errors, str(one.unchecked)
        )
    return table


def _outer_table(expected: Expected) -> Table:
    """Of the fiducials the worst alone."""
    title = "What errors that are not found may do to the camera"
    table = Table("parameter", "in its sigmas", "error in", title=title, title_justify="left")
    effects = expected.reliability.camera
    marks = [one for one in effects if one.parameter.kind == "fiducial"]
    shown = [one for one in effects if one not in marks] + sorted(marks, key=lambda one: -one.in_sigmas)[:1]
    for one in shown:
        table.add_row(Text(one.parameter.label), f"{one.in_sigmas:.1f}", Text(one.cause))
    return table


def _help_table(expected: Expected, helpful: tuple[Alternative, ...], layouts: Layouts) -> Table:
    names = list(expected.camera_sigmas)
    title = "What would help: by how many percent the sigmas shrink"
    if layouts.count > 1:
        title += ", of the first layout"
    table = Table("change", *(LABELS.get(name, name) for name in names), title=title, title_justify="left")
    for one in helpful:
        table.add_row(Text(one.change), *(_gain(one.gain_percent[name]) for name in names))
    return table


def _sweep_table(swept: Swept) -> Table:
    names = swept.names
    heads = (f"{LABELS.get(name, name)}, {UNITS[name]}" if name in UNITS else name for name in names)
    layouts = swept.steps[0].sigmas.count
    title = f"Sigmas over {swept.quantity}" + (f", mean of {layouts} layouts" if layouts > 1 else "")
    table = Table(swept.quantity, "points", *heads, title=title, title_justify="left")
    for step in swept.steps:
        value = step.value if isinstance(step.value, str) else f"{step.value:g}"
        sigmas = (_sigma(step.sigmas.mean[name]) if name in step.sigmas.mean else "fixed" for name in names)
        table.add_row(Text(value), str(step.points), *sigmas)
    slopes = [swept.slope(name) for name in names]
    if not all(math.isnan(slope) for slope in slopes):
        table.add_section()
        table.add_row("slope", "", *("" if math.isnan(slope) else f"{slope:+.2f}" for slope in slopes))
    return table


def _told(value: float, sigma: float) -> tuple[str, str]:
    if math.isinf(sigma):
        return significant(value, 6), UNDETERMINED
    return value_and_sigma(value, sigma)


def _sigma(sigma: float) -> str:
    """To two digits."""
    if sigma == 0.0:
        return "0"
    return UNDETERMINED if math.isinf(sigma) else value_and_sigma(sigma, sigma)[1]


def _gain(percent: float) -> str:
    """Of a standard deviation; found: what was not determined is, lost: the reverse."""
    if math.isnan(percent):
        return NONE
    if percent == FOUND:
        return "found"
    return "lost" if math.isinf(percent) else fixed(percent, 0)
