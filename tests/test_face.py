"""`import reseau`: the names of the three faces, and what is said where a file of the user's hides a package."""

import importlib
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import reseau

ROOT = Path(__file__).parents[1]
FACES = {name: importlib.import_module(name) for name in ("measure", "adjust", "pipeline")}


def test_it_gives_every_name_of_the_three_faces() -> None:
    names = [name for face in FACES.values() for name in face.__all__]
    assert len(names) == len(set(names)) > 50
    assert set(names) < set(dir(reseau))
    for face in FACES.values():
        for name in face.__all__:
            assert getattr(reseau, name) is getattr(face, name)
    with pytest.raises(AttributeError, match="measure_fiducial'"):
        getattr(reseau, "measure_fiducial")  # noqa: B009


@pytest.mark.parametrize("read", ["adjustment", "camera", "comparator", "images", "measurement", "points", "project"])
def test_a_file_may_be_named_by_text(read: str, tmp_path: Path) -> None:
    with pytest.raises(reseau.InputError, match="nowhere: there is no such file"):
        getattr(reseau, f"read_{read}")(str(tmp_path / "nowhere"))


def test_the_version_is_that_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {project['version']}\n" in (ROOT / "CHANGELOG.md").read_text()
    assert reseau.__version__


@pytest.mark.parametrize("arguments", [["-c", "import reseau; reseau.measure_fiducials"], ["-m", "reseau", "--help"]])
def test_a_file_that_hides_a_package_is_named(tmp_path: Path, arguments: list[str]) -> None:
    (tmp_path / "measure.py").write_text("x = 1\n")
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (tmp_path, ROOT)))}
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=variables, cwd=tmp_path)
    assert done.returncode == 2 if "-m" in arguments else done.returncode
    assert f"{tmp_path / 'measure.py'} hides the package 'measure' of reseau. Rename that file" in done.stderr
    assert ("Traceback" in done.stderr) == ("-c" in arguments)


@pytest.mark.study
def test_mypy_sees_types_in_a_script_that_uses_the_wheel(tmp_path: Path) -> None:
    """Of an installed wheel, not of the sources."""
    pip = [sys.executable, "-m", "pip", "--quiet"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path, ROOT], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", tmp_path / "site", wheel], check=True)
    script = tmp_path / "script.py"
    script.write_text(
        "import reseau\n"
        "reveal_type(reseau.__version__)\n"
        "reveal_type(reseau.read_points('points.csv'))\n"
        "reseau.adjust(5)\n"
    )
    variables = {**os.environ, "MYPYPATH": "", "PYTHONPATH": str(tmp_path / "site")}
    mypy = [sys.executable, "-m", "mypy", "--config-file", os.devnull, str(script)]
    done = subprocess.run(mypy, capture_output=True, text=True, env=variables, cwd=tmp_path)
    assert 'Revealed type is "str"' in done.stdout
    assert 'Revealed type is "pipeline.files.object_files' in done.stdout
    assert 'Argument 1 to "adjust" has incompatible type "int"; expected "Network"' in done.stdout
