"""The notebooks of docs/notebooks, executed and stored with what they show: python docs/run_notebooks.py [NAME...]

Cells are run in a folder of their own, Matplotlib draws without a screen. Of each cell are kept what it prints, the
last expression (as a table where it has one) and the figures that it leaves open.
"""

import ast
import base64
import io
import json
import os
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib as mpl

NOTEBOOKS = Path(__file__).with_name("notebooks")
DPI = 70


def executed(path: Path, folder: Path) -> dict[str, Any]:
    """The notebook with new outputs; its cells run in the folder, and what they raise is raised."""
    notebook = dict(json.loads(path.read_text(encoding="utf-8")))
    mpl.use("Agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    with chdir(folder), mpl.rc_context({"savefig.dpi": DPI}):
        for number, cell in enumerate(cells, start=1):
            cell["execution_count"] = number
            cell["outputs"] = list(_outputs("".join(cell["source"]), names, number))
    return notebook


def _outputs(code: str, names: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """Run a cell, and give what it shows."""
    import matplotlib.pyplot as plt

    shown: Any = None
    body, printed = ast.parse(code).body, io.StringIO()
    last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
    with redirect_stdout(printed):
        exec(compile(ast.Module(body, []), f"cell {number}", "exec"), names)
        if isinstance(last, ast.Expr):
            shown = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
    if printed.getvalue():
        yield {"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(keepends=True)}
    if hasattr(shown, "_repr_html_"):
        data = {"text/plain": [repr(shown)], "text/html": shown._repr_html_().splitlines(keepends=True)}
        yield {"output_type": "execute_result", "execution_count": number, "metadata": {}, "data": data}
    for figure in map(plt.figure, plt.get_fignums()):
        picture = io.BytesIO()
        figure.savefig(picture, format="png", metadata={"Software": None})
        data = {"image/png": base64.b64encode(picture.getvalue()).decode()}
        yield {"output_type": "display_data", "metadata": {}, "data": data}
    plt.close("all")


def main(names: list[str]) -> None:
    """Execute some notebooks, or all."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        with TemporaryDirectory() as folder:
            notebook = executed(path, Path(folder))
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(os.path.relpath(path))


if __name__ == "__main__":
    main(sys.argv[1:])
