"""Who may import whom: measure, adjust and synthetic_images know none of the others, pipeline knows them all."""

import ast
import re
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {"measure", "adjust", "compiled", "pipeline", "synthetic_images", "reseau"}
ALLOWED = {
    "measure": set[str](),
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
