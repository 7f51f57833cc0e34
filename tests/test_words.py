"""The words of the program: no text that a user reads has an avoided phrase.

Texts are found, not listed: string literals of the packages with a blank in them, descriptions of keys, templates, the
review page, the files that `reseau template` prints and the documentation.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import pytest

from pipeline.cli import GROUPS

ROOT = Path(__file__).parents[1]
PACKAGES = ("measure", "adjust", "pipeline", "synthetic_images")
FOLDERS = [
    str(path.parent.relative_to(ROOT)) for name in PACKAGES for path in sorted((ROOT / name).rglob("__init__.py"))
]
SOURCES = (*FOLDERS, "help", "files", "docs")
KINDS = (ast.JoinedStr, ast.Constant, ast.Expr)
AVOIDED = {  # a pattern, and what to write
    r"(?<![-\w.])um(?![-\w.])": "µm",
    r"\b(?:IO|FID|SC|BD|PT|EO|JOIN)\.": "a quantity in words: x of fiducial 3, camera Wild RC8",
    r"\btold\b": "known, identified, estimable",
    r"\bseen\b|\bsight(?:ing|er)s?\b": "found, visible, measured, detection",
    r"\bchance\b": "false alarm, expected number of false alarms, p-value",
    r"\bwith a probability of\b": "p = 0.003",
    r"\blooks? (?:like|alike|plainly)\b|\blook(?:ed|ing) (?:again|at)\b|\bcloser look\b": "matches, second pass",
    r"\bsecond visit\b|\bvisits? (?:the|a) scan": "second pass",
    r"\bbelongs?\b|\bastray\b|\bslips?\b|\bfar points?\b": "outlier, gross error",
    r"\bunlike\b|\bown turn\b|\blandscape\b|\bborders? of the ground\b": "model misfit, background texture",
    r"\b(?:the|its|their|The|Its|Their) ground\b": "background (of a mark), terrain (of an image)",
    r"\bpower of\b(?! the test)|\bunround\b": "gamma, quantisation",
    r"\b(?:takes?|taken|took) up\b": "film deformation model, correlated with",
    r"\bjudg\w+|\bwitness\w*\b|\basked\b": "cross-scan checks",
    r"\bstores?\b": "results database, server",
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
ALLOWED = (  # names in files, which the contract keeps
    r"# pitch of .*",
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
    return any(re.search(allowed, text) for allowed in ALLOWED)


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
