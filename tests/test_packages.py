"""Who may import whom, and the words of the program: no text that a user reads has an avoided phrase."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache, partial
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from pipeline.cli import GROUPS

ROOT = Path(__file__).parents[1]
PACKAGES = {"measure", "adjust", "compiled", "pipeline", "synthetic_images", "reseau"}
ALLOWED = {
    "measure": {"compiled"},
    "adjust": {"compiled"},
    "compiled": set[str](),
    "synthetic_images": set[str](),
    "pipeline": PACKAGES - {"reseau"},
    "reseau": set[str](),  # by names alone
}
ADJUST_FROM_THE_GROUND_UP = (  # folders, and the files at the root
    "errors", "array_types", "linear_algebra", "functional_model", "problem", "least_squares", "rank_defect",
    "validation", "initial_values", "quality", "display", "solution", "target_identification", "model_selection",
)  # fmt: skip
TYPES_ALONE = {"_typeshed"}  # known to type checkers, and not to Python
USED_WHERE_INSTALLED = {"pandas"}  # tables are given in it; nothing needs it
LOADED_BY_OTHERS = {"s3fs"}  # by fsspec, for addresses of its scheme
FORBIDDEN_LIBRARIES = {"adjust": {"cv2", "skimage", "tifffile", "imagecodecs"}}


@cache
def nodes_of_imports(file: Path) -> tuple[ast.Import | ast.ImportFrom | ast.Call, ...]:
    """Import statements and calls of `import_module` of a file, wherever they stand in it."""
    nodes = ast.walk(ast.parse(file.read_text()))
    return tuple(
        node
        for node in nodes
        if isinstance(node, ast.Import | ast.ImportFrom)
        or (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "import_module")
    )


def import_statements(file: Path) -> list[ast.Import | ast.ImportFrom]:
    return [node for node in nodes_of_imports(file) if not isinstance(node, ast.Call)]


def imported(file: Path) -> set[str]:
    """The top-level names that a file imports."""
    names = set[str]()
    for node in import_statements(file):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        else:
            assert node.level == 0, f"{file}: relative imports hide who depends on whom"
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_package_imports_only_what_the_architecture_allows(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    for file in files:
        names = imported(file)
        forbidden = (names & PACKAGES) - ALLOWED[package] - {package}
        assert not forbidden, f"{file.relative_to(ROOT)} imports {sorted(forbidden)}"
        pictures = names & FORBIDDEN_LIBRARIES.get(package, set())
        assert not pictures, f"{file.relative_to(ROOT)} imports {sorted(pictures)}"


@pytest.mark.parametrize(
    ("package", "user", "used"),
    [
        ("measure", "fiducials", "detection"),
        ("adjust", "quality", "least_squares"),
        ("adjust", "validation", "problem"),
        ("pipeline", "files", "results"),
        ("pipeline", "adjusting", "measuring"),
    ],
)
def test_the_rooms_of_a_package_use_one_another_in_no_circle(package: str, user: str, used: str) -> None:
    """A room is a folder, or a file at the package's root; the package's own face stands above all of them."""
    rooms = [path for path in (ROOT / package).iterdir() if path.is_dir() or path.suffix == ".py"]
    uses = {room.stem: rooms_used(room, package) - {room.stem} for room in rooms if room.stem != "__init__"}
    assert used in uses[user]
    TopologicalSorter(uses).prepare()


@pytest.mark.parametrize("package", sorted(PACKAGES - {"reseau"}))
def test_no_files_import_one_another_in_a_circle(package: str) -> None:
    """Imports for types alone count, too: a file that needs its user's types belongs above it."""
    modules = {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in (ROOT / package).rglob("*.py")}
    uses = {name: {each.module for each in import_statements(file) if isinstance(each, ast.ImportFrom)} & modules.keys()
            for name, file in modules.items()}  # fmt: skip
    assert any(uses.values()) or package == "compiled"
    TopologicalSorter(uses).prepare()


def test_each_room_of_adjust_knows_only_those_below_it() -> None:
    rooms = [path for path in (ROOT / "adjust").iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()]
    assert {room.stem for room in rooms} == {*ADJUST_FROM_THE_GROUND_UP, "__init__"}
    upward = {
        room.stem: above
        for room in rooms
        if room.stem != "__init__"
        and (above := rooms_used(room, "adjust") - set(ADJUST_FROM_THE_GROUND_UP[: level(room) + 1]))
    }
    assert not upward


def level(room: Path) -> int:
    return ADJUST_FROM_THE_GROUND_UP.index(room.stem)


def test_the_ground_and_the_formats_of_pipeline_know_no_project() -> None:
    text, results = (ROOT / "pipeline" / name for name in ("text", "results"))
    assert rooms_used(text, "pipeline") == {"text", "errors"}
    assert rooms_used(results, "pipeline") == {"text", "errors", "results", "provenance", "types"}


def rooms_used(room: Path, package: str) -> set[str]:
    """The rooms of a package from which the files of one import; the package's face is a room, too."""
    files = room.rglob("*.py") if room.is_dir() else [room]
    modules = set[str]()
    for file in files:
        for node in import_statements(file):
            if isinstance(node, ast.ImportFrom):
                named = node.module or ""
                modules |= {f"{named}.{alias.name}" for alias in node.names} if named == package else {named}
            else:
                modules |= {alias.name for alias in node.names}
    return {f"{name}.__init__".split(".")[1] for name in modules if name.split(".")[0] == package}


def test_what_the_packages_import_is_declared_and_what_is_declared_is_imported() -> None:
    """By the distributions that bring the modules: pip installs these."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = (one for name, own in project["optional-dependencies"].items() if name != "dev" for one in own)
    declared = {normal(re.split(r"[\[<>=]", requirement)[0]) for requirement in (*project["dependencies"], *extras)}
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    names = set[str]().union(*(imported(file) | imported_by_name(file) for file in files))
    brought_by = packages_distributions()
    used = {}
    for name in names - PACKAGES - TYPES_ALONE - USED_WHERE_INSTALLED - set(sys.stdlib_module_names):
        assert name in brought_by, f"{name} is imported, and not installed"
        used[name] = {normal(distribution) for distribution in brought_by[name]}
    assert [name for name, distributions in used.items() if not distributions & declared] == []
    assert declared - set[str]().union(*used.values()) == LOADED_BY_OTHERS


def imported_by_name(file: Path) -> set[str]:
    """The top-level names in calls of `import_module` with a text."""
    calls = (node for node in nodes_of_imports(file) if isinstance(node, ast.Call))
    names = [name.value for call in calls for name in call.args if isinstance(name, ast.Constant)]
    return {name.split(".")[0] for name in names if isinstance(name, str)}


def normal(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


WORDED = ("measure", "adjust", "pipeline", "synthetic_images")
FOLDERS = [str(path.parent.relative_to(ROOT)) for name in WORDED for path in sorted((ROOT / name).rglob("__init__.py"))]
SOURCES = (*FOLDERS, "help", "files", "docs")
KINDS = (ast.JoinedStr, ast.Constant, ast.Expr)
AVOIDED = {  # a pattern, and what to write
    r"(?<![-\w.])um(?![-\w.])": "µm",
    r"\b(?:IO|FID|SC|BD|PT|EO|JOIN)\.": "a quantity in words: x of fiducial 3, camera Wild RC8",
    r"\btold\b": "known, identified, estimable",
    r"\bseen\b|\b[Ss]ight(?:ing|er)?s?\b": "found, visible, measured, detection",
    r"\bchance\b": "false alarm, expected number of false alarms, p-value",
    r"\bwith a probability of\b": "p = 0.003",
    r"\blooks? (?:like|alike|plainly)\b|\blook(?:ed|ing) (?:again|at)\b|\bcloser look\b": "matches, second pass",
    r"\bsecond visit\b|\bvisits? (?:the|a) scan": "second pass",
    r"\bbelongs?\b|\bastray\b|\bslips?\b|\bfar points?\b": "outlier, gross error",
    r"\bunlike\b|\bown turn\b|\blandscape\b|\bborders? of the ground\b": "model misfit, background texture",
    r"\b(?:the|its|their|The|Its|Their) ground\b": "background (of a mark), terrain (of an image)",
    r"\bpower of\b(?! the test)|\bunround\b": "gamma, quantisation",
    r"\b(?:takes?|taken|took) (?:it |them )?up\b": "film deformation model, correlated with",
    r"\bjudg\w+|\bwitness\w*\b|\basked\b": "cross-scan checks",
    r"\b[Ss]tores?\b": "results database, server",
    r"\bbeside\b": "next to, after, from, in addition to",
    r"\bcounts? as known\b": "standard deviation set to",
    r"\bundetermined\b|\btrades? off\b": "rank defect, correlated",
    r"\bwithout strain\b|\bwould strain\b|\bholds? the object\b": "minimum constraints, inner constraints",
    r"\bclosed form\b|\bfree model\b": "space resection, DLT, model formation",
    r"\basymmetric(?!-circle| =)": "decentering",
    r"\bin the given figure\b|\bfree of what\b": "after a similarity (affine)",
    r"\bin the words of\b": "convert",
    r"\b(?:un)?certain(?:ty|ly)?\b(?! of)|\bclearly\b": "significant, ambiguous, standard deviation",
    r"\bspeaks?\b|\banew\b|\bmute\b|\bnobody said\b": "is evidence for, again, does not say",
}
ALLOWED_WORDS = (  # names in files, which the contract keeps
    r"^(?:unlike drawing|own turn)$",
)
SQL = re.compile(r"\b(?:select|insert into|update|delete from|create|alter table|where|pragma|row_digest|judging)\b")
CODE = re.compile(r"\\[bdws]|\(\?")


@cache
def texts(source: str) -> tuple[tuple[str, str], ...]:
    """Where each text of a folder, of its help or of its files stands, and the text on one line."""
    found = {"help": command_help, "files": other_files, "docs": pages}.get(source, partial(literals, source))()
    return tuple((where, " ".join(text.split())) for where, text in found if is_text(text))


def is_text(literal: str) -> bool:
    """Whether people read it: words with blanks, no SQL and no pattern."""
    return bool(re.search(r"[A-Za-z{}] +[A-Za-zµ{}]", literal)) and not SQL.search(literal) and not CODE.search(literal)


def literals(folder: str) -> Iterator[tuple[str, str]]:
    """Of the files of a folder, without docstrings; what is put into an f-string as {}."""
    for file in sorted((ROOT / folder).glob("*.py")):
        nodes = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, KINDS)]
        inside = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
        inside |= {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            if id(node) in inside or isinstance(node, ast.Expr):
                continue
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in parts)
            yield f"{file.relative_to(ROOT)}:{node.lineno}", text


def command_help() -> Iterator[tuple[str, str]]:
    """The docstrings that `--help` shows."""
    for commands in GROUPS.values():
        yield from ((f"help of {name}", command.__doc__ or "") for name, command in commands.items())


def other_files() -> Iterator[tuple[str, str]]:
    """Texts of pages between their tags, strings and tooltips of their scripts, and comments of TOML files."""
    for file in sorted((ROOT / "pipeline").rglob("*")):
        where, suffix = str(file.relative_to(ROOT)), file.suffix
        if suffix in (".j2", ".html"):
            page = re.sub(r"\{#.*?#\}|\{%.*?%\}|<(script|style).*?</\1>", " ", file.read_text(), flags=re.DOTALL)
            page = re.sub(r"\{\{.*?\}\}", "{}", page, flags=re.DOTALL)
            yield from ((where, text) for text in re.findall(r"(?:^|>)([^<>]+)", page))
            yield from ((where, text) for text in re.findall(r'(?:title|alt|placeholder|aria-label)="([^"]+)"', page))
        elif suffix == ".js":
            script = re.sub(r"^\s*//.*$", "", file.read_text(), flags=re.MULTILINE)
            yield from ((where, text) for _, text in re.findall(r"([\"'`])((?:(?!\1).)*)\1", script))
        elif suffix == ".toml":
            lines = file.read_text().splitlines()
            yield from ((where, line.partition("#")[2]) for line in lines if "#" in line)


def pages() -> Iterator[tuple[str, str]]:
    """Paragraphs of the documentation, without code. What the program says in generated pages stands in its own."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = page.read_text()
        if "generated" in text[:300].lower() or page.name == "code.md":
            continue
        text = re.sub(r"^```.*?^```|`[^`]*`|^    .*$", "", text, flags=re.DOTALL | re.MULTILINE)
        yield from ((str(page.relative_to(ROOT)), paragraph) for paragraph in text.split("\n\n"))


@pytest.mark.parametrize("source", SOURCES)
def test_no_text_has_an_avoided_phrase(source: str) -> None:
    found = [
        f"{where}: {text!r}: write {better}"
        for where, text in texts(source)
        for pattern, better in AVOIDED.items()
        if re.search(pattern, text) and not is_allowed(text)
    ]
    assert not found, "\n".join(found)


def is_allowed(text: str) -> bool:
    return any(re.search(allowed, text) for allowed in ALLOWED_WORDS)


def test_texts_of_every_kind_are_found() -> None:
    """A message, a help, a description of a key, a reason, a template, the review page, a file to start from."""
    found = [pair for source in SOURCES for pair in texts(source)]
    for where, words in {
        "pipeline/files/project_file.py": "there are no scans and no comparator coordinates",
        "help of status": "Count scans by verdict",
        "pipeline/commands/measuring.py": "The K-th of N parts",
        "pipeline/files/target_table.py": "Whether marks are lighter than their background",
        "measure/flags.py": "The scan orientation is ambiguous",
        "pipeline/report/templates/": "standard deviation",
        "pipeline/review/static/": "mark",
        "pipeline/templates/camera.toml": "standard deviation",
    }.items():
        assert any(place.startswith(where) and words in text for place, text in found), where
