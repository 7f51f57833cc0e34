"""Entry point `python -m benchmarks NAME [OPTIONS]`; lists all benchmarks without a name."""

import ast
import os
import runpy
import sys
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")  # before NumPy is imported


def main(arguments: list[str]) -> None:
    """Run one benchmark, or list all."""
    harness = import_module("benchmarks.harness")
    files = {path.stem: path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("*.py"))}
    titles = {name: _title(text) for name, text in files.items() if "\ndef case(" in text or "\nif __name__" in text}
    del titles["__main__"]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(*(f"{name:20} {title}" for name, title in titles.items()), sep="\n")
        return
    name = arguments[0]
    if name not in titles:
        near = get_close_matches(name, titles)
        sys.exit(f"there is no benchmark {name!r}" + (f"; did you mean {near[0]!r}?" if near else ""))
    sys.path += harness.HELPERS
    if "\ndef case(" in files[name]:
        harness.run(import_module(f"benchmarks.{name}"), arguments[1:])
    else:
        sys.argv = arguments
        runpy.run_module(f"benchmarks.{name}", run_name="__main__", alter_sys=True)


def _title(text: str) -> str:
    return " ".join((ast.get_docstring(ast.parse(text)) or "").split("\n\n")[0].split())


if __name__ == "__main__":
    main(sys.argv[1:])
