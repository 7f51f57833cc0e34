"""Installation test of wheel and sdist in fresh environments, with the lowest versions that pyproject.toml allows and
with the newest, on each Python. The demonstration is run, and then, with all extras, every command.

    python -m benchmarks installations [PYTHON...]

PYTHON: interpreters; by default every python3.11 and newer on the PATH. The committed state is built. Each lower bound
must be an existing version. Exit code 1 if anything fails.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
import zipfile
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.request import HTTPCookieProcessor, build_opener

from benchmarks.harness import ROOT

PACKAGES = ("reseau", "measure", "adjust", "compiled", "pipeline", "synthetic_images")
NEWEST_MINOR = 30  # newest Python 3 searched for
WITHOUT_ANSWER = {"http", "s3"}  # extras whose calls need a server
LAST_LINES = 5  # lines printed of a failure


def main(pythons: Sequence[str]) -> int:
    """Build, install and run; print a line for each installation."""
    problems = 0
    with TemporaryDirectory() as place:
        folder = Path(place)
        built = dict(zip(("sdist", "wheel"), build(folder), strict=True))
        for kind, path in built.items():
            missing = committed_files(folder / "source") - held_files(path)
            problems += len(missing)
            print(f"{kind}: {path.name}, {path.stat().st_size / 1e6:.1f} MB; not in it: {sorted(missing) or 'nothing'}")
        bounds = folder / "lowest.txt"
        bounds.write_text("\n".join(lowest_versions()), encoding="utf-8")
        print("python | distribution | versions | demonstration | s | with all extras", flush=True)
        for python in pythons:
            for kind, which in product(("wheel", "sdist"), ("lowest", "newest")):
                environment = folder / "environment"
                line, failed = tried(python, built[kind], bounds if which == "lowest" else None, environment)
                problems += failed
                print(f"{read_version(python)} | {kind} | {which} | {line}", flush=True)
                shutil.rmtree(environment, ignore_errors=True)
    return min(problems, 1)


def build(folder: Path) -> tuple[Path, Path]:
    """Build the sdist, and the wheel from it."""
    source, tools = folder / "source", folder / "tools"
    subprocess.run(["git", "clone", "--quiet", "--depth", "1", f"file://{ROOT}", str(source)], check=True)
    made_environment(sys.executable, tools)
    done = run([tools / "bin" / "pip", "install", "--quiet", "build"])
    assert done.returncode == 0, done.stderr
    done = run([tools / "bin" / "python", "-m", "build", "--outdir", folder / "dist", source])
    assert done.returncode == 0, done.stderr
    (sdist,), (wheel,) = (folder / "dist").glob("*.tar.gz"), (folder / "dist").glob("*.whl")
    return sdist, wheel


def committed_files(source: Path) -> set[str]:
    """Committed files of the packages, of all kinds."""
    command = ["git", "-C", str(source), "ls-files", *PACKAGES]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


def held_files(path: Path) -> set[str]:
    """Files in a distribution, relative to the project's root."""
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            return set(wheel.namelist())
    with tarfile.open(path) as sdist:
        return {name.partition("/")[2] for name in sdist.getnames()}


def lowest_versions() -> Iterator[str]:
    """Yield constraints for pip that pin all dependencies and extras to their lower bounds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for requirement in (*project["dependencies"], *(one for name in user_extras() for one in extras[name])):
        found = re.fullmatch(r"([\w.-]+)(?:\[\w+\])?>=([\w.]+)", requirement)
        assert found, f"{requirement} has no lower bound"
        yield f"{found[1]}=={found[2]}"


def user_extras() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [name for name in project["optional-dependencies"] if name != "dev"]


def tried(python: str, distribution: Path, bounds: Path | None, environment: Path) -> tuple[str, int]:
    """Install and run in a new environment; returns the outcome in words and the number of failures."""
    made_environment(python, environment)
    bin = environment / "bin"
    install: list[str | Path] = [bin / "pip", "install", "--quiet", "--only-binary", ":all:", "--no-binary", "reseau"]
    install += ["--constraint", bounds] if bounds else []
    done = run([*install, distribution])
    if done.returncode:
        return f"not installed: {last_lines(done.stderr)}", 1
    start = time.monotonic()
    demonstration = run([bin / "reseau", "demo", environment / "demo"])
    seconds = time.monotonic() - start
    message = "runs" if demonstration.returncode == 0 else f"ends with {last_lines(demonstration.stderr)}"
    done = run([*install, f"{distribution}[{','.join(user_extras())}]"])
    extras = f"not installed: {last_lines(done.stderr)}" if done.returncode else install_extras(environment)
    return f"{message} | {seconds:.0f} | {extras or 'all run'}", bool(demonstration.returncode) + bool(extras)


def install_extras(environment: Path) -> str:
    """Run all commands and import all modules; returns the failures, "" if there are none."""
    bin = environment / "bin"
    (environment / "small").mkdir()
    done = run([bin / "python", "-P", ROOT / "tests" / "every_command.py", environment / "small"])
    if done.returncode:
        return last_lines(done.stderr)
    found = json.loads(done.stdout)
    failed = [
        f"{call['arguments'][:2]} ends with {call['code']}: {last_lines(call['messages'])}"
        for call in found["calls"]
        if call["extra"] not in WITHOUT_ANSWER and (call["code"] == 3 or "pip install" in call["messages"])
    ]
    if not answers(bin / "reseau", environment / "demo" / "project.toml"):
        failed.append("reseau review does not answer")
    return "; ".join([*failed, *(f"{module}: {reason}" for module, reason in found["modules"].items())])


def answers(reseau: Path, project: Path) -> bool:
    """Whether the review page is served."""
    command = [str(reseau), "review", str(project), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        address = next((line.strip() for line in process.stdout if line.startswith("http")), "")
        try:
            with build_opener(HTTPCookieProcessor).open(address) as page:  # the page requires its cookie
                return bool(page.status == 200)
        except (OSError, ValueError):
            return False
        finally:
            process.terminate()


def made_environment(python: str, folder: Path) -> None:
    subprocess.run([python, "-m", "venv", str(folder)], check=True)


def run(command: Sequence[str | Path]) -> "subprocess.CompletedProcess[str]":
    variables = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, env=variables, cwd="/")


def last_lines(text: str) -> str:
    return " / ".join(line for line in text.strip().splitlines()[-LAST_LINES:])


def read_version(python: str) -> str:
    return run([python, "--version"]).stdout.strip().removeprefix("Python ")


def found_pythons() -> list[str]:
    """Working interpreters on the PATH; a name there may belong to a version that is not installed."""
    paths = filter(None, (shutil.which(f"python3.{minor}") for minor in range(11, NEWEST_MINOR)))
    return [path for path in paths if run([path, "--version"]).returncode == 0]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or found_pythons()))
