"""What `reseau design` prints: the expected precision, what would help, the sweeps, where the files are."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from adjust.problem.parameter import Parameter, description
from pipeline.design.alternatives import FOUND, Alternative
from pipeline.design.expected import Expected, rms
from pipeline.design.reliability import error_unit
from pipeline.design.sweeps import Layouts, Swept
from pipeline.report.numbers import NONE, fixed, significant, value_and_sigma

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
        told = [float(sigma) for sigma in sigmas if sigma > 0.0]
        table.add_row(axis, _sigma(rms(told)) if told else "fixed", _sigma(max(told)) if told else "fixed")
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
