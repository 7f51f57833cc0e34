"""docs/notebooks: each runs to its end as it stands, names what there is, and is stored with what it shows."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from loaded_script import script

import reseau

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: str(path.stem))
def path(request: pytest.FixtureRequest) -> Path:
    return Path(request.param)


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def figures(notebook: dict[str, Any]) -> list[bool]:
    """Of each cell of code, whether it shows a figure."""
    return [any("image/png" in each.get("data", {}) for each in cell["outputs"]) for cell in code_cells(notebook)]


def test_it_is_stored_with_its_plots_and_names_what_there_is(path: Path) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    cells = code_cells(notebook)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert sum(figures(notebook)) >= 4
    code = "\n".join("".join(cell["source"]) for cell in cells)
    names = set(re.findall(r"\breseau\.(\w+)", code))
    assert names
    assert names <= set(dir(reseau))
    for method in ("plot_residuals", "plot_distortion", "plot_uncertainty", "plot_coverage"):
        assert f"result.{method}(" in code


@pytest.mark.study
def test_it_runs_to_its_end(path: Path, tmp_path: Path) -> None:
    made = script(path.parents[1] / "run_notebooks.py").executed(path, tmp_path)
    assert figures(made) == figures(json.loads(path.read_text(encoding="utf-8")))
    assert [each for cell in code_cells(made) for each in cell["outputs"] if each["output_type"] == "execute_result"]
