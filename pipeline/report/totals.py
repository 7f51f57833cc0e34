"""What the report shows of very many frames: how many stand where, and how residuals and sigmas are spread."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from pipeline.report.charts import histogram
from pipeline.report.data import ReportData
from pipeline.text.wording import counted

ROWS = 200  # cameras and kinds of file at most

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TotalsView:
    """Ready to print. verdicts: those that occur; rows: of cameras and kinds of file, with a number for each of them;
    left_out: further rows; all: of all frames. histograms: with what each shows."""

    frames: int
    needs_look: int
    shown: int
    verdicts: tuple[str, ...]
    rows: tuple[tuple[str, str, tuple[int, ...]], ...]
    left_out: int
    all: tuple[int, ...]
    histograms: tuple[tuple[str, Markup], ...]


def totals_view(data: ReportData) -> TotalsView:
    """Of data that has totals."""
    assert data.totals is not None
    counts = data.totals.verdicts
    named = dict.fromkeys(verdict for each in counts.values() for verdict in each)
    verdicts = tuple(verdict for verdict in named if any(each[verdict] for each in counts.values()))
    rows = tuple((*kind, tuple(each[verdict] for verdict in verdicts)) for kind, each in counts.items())
    residuals = data.adjustment.residuals if data.adjustment else ()
    v_um = dict(zip("xy", np.array([row.v_um for row in residuals]).reshape(-1, 2).T, strict=True))
    return TotalsView(
        frames=len(data.totals.marks),
        needs_look=data.totals.needs_look,
        shown=len({*(data.measurement or {}), *(row.image for row in data.comparator)}),
        verdicts=verdicts,
        rows=rows[:ROWS],
        left_out=max(len(rows) - ROWS, 0),
        all=tuple(sum(each[verdict] for each in counts.values()) for verdict in verdicts),
        histograms=(*_histograms("residual", v_um), *_histograms("σ", data.totals.sigmas_um)),
    )


def _histograms(what: str, by_axis: Mapping[str, Array]) -> Iterator[tuple[str, Markup]]:
    for axis, values in by_axis.items():
        if len(values):
            rms, largest = np.sqrt(np.mean(values**2)), np.abs(values).max()
            told = f"{counted(len(values), 'mark')}, rms {rms:.2f} µm, at most {largest:.2f} µm"
            yield told, histogram(f"{what} in {axis} (µm)", values)
