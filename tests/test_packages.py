"""Who may import whom: measure, adjust and synthetic_images know none of the others, pipeline knows them all."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {"measure", "adjust", "pipeline", "synthetic_images"}
ALLOWED = {"measure": set[str](), "adjust": set[str](), "synthetic_images": set[str](), "pipeline": PACKAGES}
FORBIDDEN_LIBRARIES = {"adjust": {"cv2", "skimage", "tifffile", "imagecodecs"}}


def imported(file: Path) -> set[str]:
    """The top-level names that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative imports hide who depends on whom"
            names.add((node.module or "").split(".")[0])
    return names


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_package_imports_only_what_the_architecture_allows(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    for file in files:
        names = imported(file)
        strangers = (names & PACKAGES) - ALLOWED[package] - {package}
        assert not strangers, f"{file.relative_to(ROOT)} imports {sorted(strangers)}"
        pictures = names & FORBIDDEN_LIBRARIES.get(package, set())
        assert not pictures, f"{file.relative_to(ROOT)} imports {sorted(pictures)}"


@pytest.mark.parametrize(
    ("package", "user", "used"),
    [("measure", "pose", "frames"), ("adjust", "quality", "least_squares"), ("pipeline", "adjusting", "measuring")],
)
def test_the_folders_of_a_package_use_one_another_in_no_circle(package: str, user: str, used: str) -> None:
    folders = {
        folder.name: folders_used(folder) - {folder.name} for folder in (ROOT / package).iterdir() if folder.is_dir()
    }
    assert used in folders[user]
    TopologicalSorter(folders).prepare()


def folders_used(folder: Path) -> set[str]:
    """The folders of its package from which the files of one import."""
    modules = {
        node.module or ""
        for file in folder.glob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom)
    }
    return {
        name.split(".")[1] for name in modules if name.count(".") == 2 and name.startswith(f"{folder.parent.name}.")
    }
