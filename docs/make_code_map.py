"""The lists of docs/code.md, from the modules' own docstrings: python docs/make_code_map.py

Under a heading that ends with a folder, `measure/scans/`, stands a line for each module of that folder: its name and
the first sentence of its docstring. The order of the page, that of the data flow, is kept; a new module comes last.
"""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "code.md"
PACKAGES = ("measure", "adjust", "pipeline", "synthetic_images", "benchmarks")
_LINE = re.compile(r"- `([\w.]+)`: ")


def first_sentences(folder: str) -> dict[str, str]:
    """Of every module of a folder, by its dotted name."""
    files = [file for file in sorted((ROOT / folder).glob("*.py")) if file.name != "__init__.py"]
    return {".".join(file.relative_to(ROOT).with_suffix("").parts): _first_sentence(file) for file in files}


def _first_sentence(path: Path) -> str:
    docstring = re.match(r'"""(.*?)"""', path.read_text(encoding="utf-8"), re.DOTALL)
    text = " ".join(docstring[1].split("\n\n")[0].split()) if docstring else ""
    sentence = re.match(r".*?[.!?](?=\s|$)", text)
    return sentence[0] if sentence else text


def mapped(page: str) -> str:
    """The page with its lists brought up to date. Raises ValueError for a folder without a heading."""
    sections = re.split(r"^(?=##)", page, flags=re.MULTILINE)
    folders = [_folder(section) for section in sections]
    modules = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py") if file.name != "__init__.py"]
    missing = {file.parent.relative_to(ROOT).as_posix() for file in modules} - set(folders)
    if missing:
        raise ValueError(f"docs/code.md has no heading that ends with {', '.join(sorted(missing))}: write one.")
    return "".join(map(_with_list, sections, folders)).rstrip() + "\n"


def _folder(section: str) -> str:
    heading = re.match(r"#+ .*`([\w/]+)/`$", section, re.MULTILINE)
    return heading[1] if heading else ""


def _with_list(section: str, folder: str) -> str:
    """A folder's section: its text, then its modules, those that it has listed so far first."""
    if not folder:
        return section
    sentences, lines = first_sentences(folder), section.splitlines()
    listed = [match[1] for line in lines if (match := _LINE.match(line)) and match[1] in sentences]
    names = dict.fromkeys([*listed, *sentences])
    text = "\n".join(line for line in lines if not _LINE.match(line)).strip()
    return "\n".join([text, "", *(f"- `{name}`: {sentences[name]}" for name in names), "", ""])


if __name__ == "__main__":
    PAGE.write_text(mapped(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
