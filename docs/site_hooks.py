"""What the site of the documentation has beside docs/: formulas as MathML, and pages from elsewhere in the project."""

import json
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PAGES = {  # of the project, by their names in the site
    "contributing.md": "CONTRIBUTING.md",
    "results-of-benchmarks.md": "benchmarks/RESULTS.md",
    "changelog.md": "CHANGELOG.md",
}
FACES = {"measure": "Scans and marks", "adjust": "Adjustment", "pipeline": "Files"}
_CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)
_FORMULA = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+?)\$", re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from elsewhere."""
    for name, source in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=re.sub(r"\]\((?:\.\./)?docs/", "](", text)))
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=_notebook(path)))
    files.append(File.generated(config, "reference/python.md", content=_names_of_faces()))
    return files


def _notebook(path: Path) -> str:
    """The page of a notebook: its cells, and what these show."""
    lines = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            lines.append(text)
            continue
        lines.append(f"```python\n{text}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                lines.append(f'<img alt="figure" src="data:image/png;base64,{data["image/png"].strip()}">')
            elif "text/html" in data:
                lines.append("".join(data["text/html"]))
            elif "text" in output:
                lines.append(f"```text\n{''.join(output['text'])}```")
    lines.append(f"[This page as a notebook]({path.name})")
    return "\n\n".join(lines)


def _names_of_faces() -> str:
    """The page of all names that `import reseau` gives, from the stubs of its packages."""
    lines = ["# Python\n", "`import reseau` gives every name below: [an example](../how-to/python.md).\n"]
    for package, title in FACES.items():
        lines.append(f"## {title}\n")
        stub = (ROOT / package / "__init__.pyi").read_text(encoding="utf-8")
        for module, name in re.findall(r"^from \.([\w.]+) import (\w+) as", stub, re.MULTILINE):
            lines.append(f"::: {package}.{module}.{name}\n")
    return "\n".join(lines)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Write formulas as MathML, which browsers draw by themselves, and point links to the added pages."""
    root = "../" * page.file.src_uri.count("/")
    for name, source in PAGES.items():
        markdown = re.sub(rf"\]\((?:\.\./)+{re.escape(source)}", f"]({root}{name}", markdown)
    markdown = re.sub(r"\]\(((?:\.\./)?notebooks/[\w-]+)\.ipynb\)", r"](\1.md)", markdown)
    parts = _CODE.split(markdown)  # every second one is code
    parts[::2] = [_FORMULA.sub(_mathml, part) for part in parts[::2]]
    return "".join(parts)


def _mathml(found: re.Match[str]) -> str:
    if found[1]:
        return f"\n\n{convert(' '.join(found[1].split()), display='block')}\n\n"
    return f"<span>{convert(found[2])}</span>"  # else a line that begins with it would be a block
