"""The pages of docs/ that speak of the code: what they name exists, and what they quote is what the program says."""

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from browser import browser_page, needs_browser, started_browser
from loaded_script import script

import reseau

DOCS = Path(__file__).parents[1] / "docs"
PAGES_OF_THE_DEMONSTRATION = (
    "start/film-scan.md",
    "how-to/plan-a-network.md",
    "how-to/choose-a-model.md",
    "notebooks/film-scan.ipynb",
)
MKDOCS = DOCS.parent / ".venv-docs" / "bin" / "mkdocs"


def test_every_name_in_the_pages_exists() -> None:
    text = "".join(page.read_text() for page in DOCS.rglob("*.md"))
    dotted = r"((?:adjust|pipeline|measure)(?:\.\w+)+)"
    names = {*re.findall(f"`{dotted}`", text), *re.findall(f"^ *{dotted}$", text, flags=re.MULTILINE)}
    assert {"adjust.functional_model.lens", "measure.fiducials.stages"} <= names
    missing = [name for name in sorted(names) if not (name.endswith(".py") or _exists(name))]
    assert not missing


def _exists(name: str) -> bool:
    """Whether a dotted name is a module, or defined in one, or in a class of one. Nothing is imported."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        path = DOCS.parent.joinpath(*parts[:count])
        file = next(filter(Path.exists, (path.with_suffix(".py"), path / "__init__.pyi", path / "__init__.py")), None)
        if file is not None:
            text = file.read_text(encoding="utf-8")
            return all(re.search(rf"^ *(?:class |def |from .* import )?{part}\b", text, re.M) for part in parts[count:])
    return False


def test_every_link_of_the_pages_leads_somewhere() -> None:
    for page in (*DOCS.rglob("*.md"), *DOCS.parent.glob("*.md")):
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.relative_to(DOCS.parent)}: {target}"


@pytest.mark.study
def test_the_gallery_quotes_the_program() -> None:
    page = (DOCS / "failure-gallery.md").read_text()
    assert leveled(page) == leveled(script(DOCS / "make_gallery.py").text()), "run python docs/make_gallery.py"


def leveled(text: str) -> str:
    """A text without what rounding decides: which unknown leads where several null vectors are equally good."""
    return re.sub(r"\(\w+ most\)", "", text)


@pytest.mark.parametrize(
    ("name", "shape", "filled"), [("A", (203, 203), 383), ("B", (203, 83), 2243), ("N", (83, 83), 2601)]
)
def test_the_matrices_of_the_figures(name: str, shape: tuple[int, int], filled: int) -> None:
    """Ten points, eight fiducials, five images: 2 x 2 blocks in A; in B 19 elements a target's row, 4 a fiducial's."""
    module = script(DOCS / "make_structure.py")
    matrix = module.structure().matrices[name]
    assert matrix.shape == shape
    if name == "B":
        assert filled == 100 * 19 + 80 * 4 + 23
    if name == "N":
        assert (abs(matrix - matrix.T) <= 1e-9 * abs(matrix).max()).all()
    assert (DOCS / f"figure-{'ABN'.index(name) + 1}-{name}.png").stat().st_size < 150_000


def test_the_figures_of_the_demonstration_are_those_of_one_run() -> None:
    """demo.json and the picture by docs/make_pictures.py, the notebook by docs/run_notebooks.py, two tables, a plan."""
    made = json.loads((DOCS / "demo.json").read_text(encoding="utf-8"))
    c, sigma, sigma0 = made["c_mm"], made["c_sigma_mm"], made["sigma0"]
    texts = {name: (DOCS / name).read_text(encoding="utf-8") for name in PAGES_OF_THE_DEMONSTRATION}
    assert f"c {c:.4f}, sigma0 {sigma0:.3f}".encode() in (DOCS / "report.png").read_bytes()
    assert f"c = {c:.3f} mm, with a standard deviation of {sigma:.3f}" in texts["start/film-scan.md"]
    assert f"Here it is {sigma0:.2f}." in texts["start/film-scan.md"]
    assert f"gets c to {sigma:.4f} mm" in texts["how-to/plan-a-network.md"]
    row = re.search(r"^\| \*\*affine, torlegard.*$", texts["how-to/choose-a-model.md"], re.MULTILINE)
    assert row
    assert f"| {made['redundancy']} | {sigma0:.2f} | {sigma0**2 * made['redundancy']:.1f} |" in row[0]
    assert f"redundancy {made['redundancy']}, sigma0 {sigma0:.3f})" in texts["notebooks/film-scan.ipynb"]
    shown = re.search(r"<td>c of camera metric 6 x 6</td><td>([\d.]+)</td>", texts["notebooks/film-scan.ipynb"])
    assert shown
    assert float(shown[1]) == pytest.approx(c, abs=0.1 * sigma)  # its disks are not corrected for eccentricity


def test_every_module_stands_on_the_map_of_the_code_with_its_own_words() -> None:
    page = (DOCS / "code.md").read_text()
    assert page == script(DOCS / "make_code_map.py").mapped(page), "run python docs/make_code_map.py"


def test_the_page_of_keys_is_current() -> None:
    page = (DOCS / "keys.md").read_text()
    assert page == script(DOCS / "make_keys.py").text(), "run python docs/make_keys.py"
    assert "| `film_sigma_um` | number, 0 or more | µm | 0 |" in page


def test_what_the_map_of_the_code_says_to_enter_by_exists() -> None:
    """Above the list of a folder's modules: a name with a dot is one of theirs, or a file."""
    named, folder = set(), ""
    for line in (DOCS / "code.md").read_text().splitlines():
        if line.startswith("#"):
            heading = re.match(r"### .*`([\w/]+)/`$", line)
            folder = heading[1].replace("/", ".") if heading else ""
        elif folder and not line.startswith("- "):
            named |= {f"{folder}.{name}" for name in re.findall(r"`(\w+\.\w+)`", line)}
    named = {name for name in named if not name.endswith((".csv", ".json", ".db"))}
    assert len(named) > 40
    missing = [name for name in sorted(named) if not _exists(name)]
    assert not missing


@pytest.mark.study
@pytest.mark.skipif(not MKDOCS.exists(), reason="there is no environment of the documentation: make docs")
@needs_browser
def test_the_site_is_built_without_a_warning_fetches_nothing_and_is_searched_from_disk(tmp_path: Path) -> None:
    command = [str(MKDOCS), "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    variables = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=DOCS.parent, env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = {page.relative_to(tmp_path).as_posix(): page.read_text() for page in tmp_path.rglob("*.html")}
    assert not [
        name for name, text in pages.items() if re.search(r"<(script|link|img)[^>]+(src|href)=\"?https?:", text)
    ]
    assert "measure_fiducials" in pages["reference/python.html"]
    assert "<math" in pages["method/theory.html"]
    with started_browser() as browser, browser_page(browser) as page:
        page.goto((tmp_path / "how-to" / "review.html").as_uri() + "?q=rank+defect")
        page.locator(".md-search-result__item", has_text="The theory").first.wait_for()


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
    notebook = json.loads(path.read_text())
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
    assert figures(made) == figures(json.loads(path.read_text()))
    assert [each for cell in code_cells(made) for each in cell["outputs"] if each["output_type"] == "execute_result"]
