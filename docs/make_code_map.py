"""The lists of docs/code.md, from the modules' own docstrings: python docs/make_code_map.py

A line a module: its name and the first sentence of its docstring. The order on the page is that of the data's flow and
is kept; a module that is new comes last in its folder's list, to be moved where it belongs, and one that is gone goes.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "code.md"
PACKAGES = ("measure", "adjust", "compiled", "pipeline", "synthetic_images", "benchmarks")


def first_sentences() -> dict[str, str]:
    """Of every module, by its dotted name."""
    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): _first_sentence(path)
        for path in files
        if path.name != "__init__.py"
    }


def _first_sentence(path: Path) -> str:
    docstring = re.match(r'"""(.*?)"""', path.read_text(encoding="utf-8"), re.DOTALL)
    text = " ".join(docstring[1].split("\n\n")[0].split()) if docstring else ""
    found = re.match(r".*?[.!?](?=\s|$)", text)
    return found[0] if found else text


def mapped(page: str) -> str:
    """The page with its lists brought up to date. Raises ValueError for a module whose folder has no list."""
    told, lines, listed = first_sentences(), [], set[str]()
    for line in page.splitlines():
        name = _listed(line)
        if not name:
            lines.append(line)
        elif name in told and name not in listed:
            lines.append(f"- `{name}`: {told[name]}")
            listed.add(name)
    for name in told.keys() - listed:
        lines.insert(_end_of_list(lines, name), f"- `{name}`: {told[name]}")
    return "\n".join(lines) + "\n"


def _listed(line: str) -> str:
    found = re.match(r"- `([\w.]+)`: ", line)
    return found[1] if found and found[1].startswith(PACKAGES) else ""


def _end_of_list(lines: list[str], name: str) -> int:
    """Behind the last module of the same folder."""
    folder = name.rpartition(".")[0]
    same = [i for i, line in enumerate(lines) if _listed(line).rpartition(".")[0] == folder]
    if not same:
        raise ValueError(f"docs/code.md has no list of {folder}: write a heading for it, and a line `- `{name}`: `.")
    return same[-1] + 1


if __name__ == "__main__":
    PAGE.write_text(mapped(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
