"""XML of other programs: a parser that does not expand entities, and a writer that indents by two blanks per level."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np

from pipeline.errors import InputError
from pipeline.text.files import read_bytes
from pipeline.types import Array

Element = ElementTree.Element
Content: TypeAlias = "str | float | Array | Mapping[str, Content] | Sequence[tuple[str, Content]]"

DEEPEST = 100  # largest nesting depth of elements: no format here has ten


class _Builder(ElementTree.TreeBuilder):
    """Builder of a tree of limited depth, without a document type, since it may define entities."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.depth = path, 0

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        self.depth += 1
        if self.depth > DEEPEST:
            raise InputError(f"{self.path}: its elements are nested more than {DEEPEST} deep; no such file is read.")
        return super().start(tag, attrs)

    def end(self, tag: str) -> Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise InputError(
            f"{self.path}: has a document type (<!DOCTYPE>), and entities are not expanded here. No program's "
            "measurements have one: remove it, or export the file again."
        )


def read_xml(path: Path) -> Element:
    """Read the root element of a file. Raises InputError for a missing file, broken XML, and any document type."""
    try:
        return ElementTree.XML(read_bytes(path), ElementTree.XMLParser(target=_Builder(path)))
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; an XML file is needed here.") from None
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: is not valid XML ({error}). Export it again from the other program.") from None


def child_text(element: Element, name: str, path: Path) -> str:
    """Text of a child element. Raises InputError where there is none."""
    found = element.find(name)
    if found is None or found.text is None:
        raise InputError(f"{path}: <{element.tag}> has no <{name}>. Is it a file of this format?")
    return found.text.strip()


def child_numbers(element: Element, name: str, count: int, path: Path) -> list[float]:
    """The given count of numbers in the text of a child element. Raises InputError for any other text."""
    text = child_text(element, name, path)
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{path}: <{name}> is {text[:60]!r}; it should be {count} numbers.")
    return values


def xml_text(name: str, content: Content) -> str:
    """Document with one root element: text, numbers, or elements by their names (pairs, where a name recurs)."""
    root = _element(name, content)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode", short_empty_elements=False)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def _element(name: str, content: Content) -> Element:
    element = Element(name)
    if isinstance(content, str):
        element.text = content
    elif isinstance(content, float | np.ndarray):
        element.text = " ".join(repr(float(value)) for value in np.ravel(content))
    else:
        children = content.items() if isinstance(content, Mapping) else content
        element.extend(_element(*child) for child in children)
    return element
