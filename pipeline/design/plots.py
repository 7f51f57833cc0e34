"""A picture of a sweep: the camera's standard deviations over the quantity that was varied."""

import math
from pathlib import Path

from pipeline.design.sweeps import Swept
from pipeline.text.atomic import atomic_path

WIDE_RANGE = 2.0  # ratio of the largest to the smallest value from which on the axis is logarithmic
STYLES = ("-", "--", ":", "-.")


def plot_sweep(swept: Swept, path: Path) -> None:
    """Write a PNG: every standard deviation as a share of that at the first value where it has one.

    Only so do quantities of different units go on one axis. Raises InputError where the file cannot be written.
    """
    # Slow to import, and nothing but pictures needs it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter, NullFormatter

    figure = Figure(figsize=(7.0, 4.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    values = [step.value for step in swept.steps]
    places = [float(value) for value in values] if swept.numeric else [float(i) for i in range(len(values))]
    for number, name in enumerate(swept.names):
        relative = _relative([step.sigmas.mean.get(name, math.nan) for step in swept.steps])
        axes.plot(places, relative, STYLES[number // 10 % len(STYLES)], marker="o", markersize=3.5, label=name)
    axes.set_yscale("log")
    if swept.numeric and min(places) > 0.0 and max(places) >= WIDE_RANGE * min(places):
        axes.set_xscale("log")
    axes.set_xticks(places, [f"{value:g}" if not isinstance(value, str) else value for value in values])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(FormatStrFormatter("%g"))
    axes.tick_params(axis="y", which="minor", labelsize=8)
    axes.set_xlabel(swept.quantity)
    axes.set_ylabel("expected standard deviation, first value = 1")
    axes.grid(visible=True, which="both", color="0.9")
    axes.legend(
        fontsize=8, ncols=1 + len(swept.names) // 9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _relative(sigmas: list[float]) -> list[float]:
    """Shares of the first that is finite; nan where there is none."""
    first = next((sigma for sigma in sigmas if 0.0 < sigma < math.inf), math.nan)
    return [sigma / first if math.isfinite(sigma) else math.nan for sigma in sigmas]
