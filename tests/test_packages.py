"""Who may import whom: measure, adjust and synthetic_images know none of the others, pipeline knows them all."""

import ast
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
