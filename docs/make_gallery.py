"""Write failure-gallery.md and failure-gallery.png: networks that fail, and what the program says of them.

python docs/make_gallery.py [FOLDER]. The networks are those of null_directions.py and mishaps.py in tests/adjust; the
words are the program's.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "adjust"))

from mishaps import MISHAPS, Mishap, sentences  # the tests' own networks
from null_directions import AXES, CATALOGUE, Failure

from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.estimates import NullDirection
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter, description
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

REPEATED = 3  # sentences of one kind that are printed, of many
COLUMNS = 3
TITLE_WIDTH = 36  # characters
OBLIQUE = np.array([[1.0, 0.45, 0.0], [0.0, 0.3, 1.0]])  # object to paper
AXIS, ARROW = 600.0, 260.0  # drawn lengths of a camera's axis and of its x', in m

INTRODUCTION = """# Failures, and what is said of them

Networks that leave something undetermined, with the program's own words. This page is written by
`docs/make_gallery.py` from the networks of `tests/adjust/null_directions.py` and `tests/adjust/mishaps.py`, where tests
count the null directions of each, compare the words, and try the remedies: a prior that is asked for ends exactly one
direction, a change of the network ends those that it is advised for.

Every network is simulated without errors. There are four images (or as many as are said) from 1500 m by a camera of
c = 153 mm with five fiducial marks, film transformations are affine, and nothing is given of fiducials, c, x0', y0'
(F5 to F9 are dropped). A minimal datum holds the object space where too little of it is known. What moves
together stands in parentheses. [The theory](theory.md) says why the directions are there.

![The networks](failure-gallery.png)

Stations are dots with the camera's axis (line) and its x' (arrow). Points are filled where they are known, hollow where
they are not, half filled where only their heights are. The number in a picture is that of its section.

## The directions of the camera's own axes

They are there in every network, whatever its geometry, for they are no property of it: fiducials, film transformations,
principal point, kappa and the principal distance change together, and no image can tell.
"""


def main() -> None:
    """Write text and picture."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    (folder / "failure-gallery.md").write_text(text(), encoding="utf-8")
    draw(folder / "failure-gallery.png")


def text() -> str:
    """The whole page."""
    parts = [INTRODUCTION]
    parts += [_direction(each) for each in _null(CATALOGUE["known-relief"])]
    parts.append("\n## What networks add\n\nOnly what is more than the four above.\n")
    parts += [_failure(number, failure) for number, failure in enumerate(CATALOGUE.values(), 1)]
    parts.append("\n## Other mishaps\n\nPriors of 1 mm, unless it says otherwise; observations with errors.\n")
    parts += [_mishap(mishap) for mishap in MISHAPS.values()]
    return "".join(parts)


def _null(failure: Failure) -> tuple[NullDirection, ...]:
    return adjust(*failure.setup.network(), failure.options).singular


def _failure(number: int, failure: Failure) -> str:
    found = _null(failure)
    more = [each for each in found if not each.cause.startswith(AXES)]
    lines = f"\n### {number}. {failure.title}\n\nDefect {len(found)}: 4 + {len(more)}.\n"
    return lines + "".join(_direction(each) for each in more)


def _direction(each: NullDirection) -> str:
    return f"\n- {each.cause} *{each.remedy}* ({_moving(each.parameters)})\n"


def _moving(parameters: Sequence[Parameter]) -> str:
    """What moves, the films as one: which of their parameters lead, rounding decides."""
    films = ["film transformations"] if any(each.kind == "film" for each in parameters) else []
    return "; ".join([*filter(None, [description(each for each in parameters if each.kind != "film")]), *films])


def _mishap(mishap: Mishap) -> str:
    result = adjust(*mishap.network(), mishap.options)
    said = sentences(result)
    shown = said[:REPEATED] + ([f"(and {len(said) - 2 * REPEATED} more)"] if len(said) > 2 * REPEATED else [])
    shown += said[max(REPEATED, len(said) - REPEATED) :]
    listed = "".join(f"\n- {sentence}" for sentence in shown)
    return f"\n### {mishap.title}\n\nThe adjustment ends: {result.termination}.\n{listed}\n"


def draw(path: Path) -> None:
    """All networks of the catalogue on one sheet."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = -(-len(CATALOGUE) // COLUMNS)
    figure, panels = pyplot.subplots(rows, COLUMNS, figsize=(9.0, 2.5 * rows), layout="constrained")
    for panel in panels.flat[len(CATALOGUE) :]:
        panel.axis("off")
    for number, (panel, failure) in enumerate(zip(panels.flat, CATALOGUE.values(), strict=False), 1):
        network, _ = failure.setup.network()
        _draw_network(panel, network, failure)
        panel.set_title("\n".join(wrap(f"{number}. {failure.title}", TITLE_WIDTH)), fontsize=8)
    figure.savefig(path, dpi=90)
    pyplot.close(figure)


def _draw_network(panel: Any, network: Network, failure: Failure) -> None:
    values = [[q.value for q in (p.X, p.Y, p.Z) if q is not None] for p in network.points]
    xyz = np.array(values)
    sigma = failure.setup.sigma
    style = "full" if sigma[0] == 0.0 else "bottom" if sigma[2] == 0.0 else "none"
    panel.plot(*(OBLIQUE @ xyz.T), "o", color="#1f5a93", fillstyle=style, markersize=4.5, markeredgewidth=0.8)
    for station, attitude in zip(failure.setup.stations, failure.setup.attitudes, strict=True):
        axes = rotation_from_angles(np.array(attitude))
        at = np.array(station)
        panel.plot(*(OBLIQUE @ np.stack([at, at - AXIS * axes[2]], axis=1)), color="0.5", linewidth=0.8)
        start, end = OBLIQUE @ at, OBLIQUE @ (at + ARROW * axes[0])
        panel.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": "#c9482b", "linewidth": 1.0})
        panel.plot(*start, ".", color="black", markersize=5)
    panel.set_aspect("equal")
    panel.margins(0.08)
    panel.axis("off")


if __name__ == "__main__":
    main()
