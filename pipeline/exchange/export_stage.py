"""`reseau export`: write a project's marks, cameras and orientations as files of another program, all of them or
none."""

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from pipeline.errors import InputError
from pipeline.exchange.block import Block, read_block
from pipeline.exchange.formats import Convention, ExportOptions, Written, format_writer
from pipeline.files.project_file import Project
from pipeline.results.comparator_file import describe_decisions, read_decision_counts
from pipeline.text.atomic import write_atomically, writing
from pipeline.text.names import path_below

README = "README.txt"
_HEAD = "Written by reseau"


@dataclass(frozen=True)
class Exchanged:
    """Names of the written files and the text of their README. written: what was written, and what was lost."""

    files: tuple[str, ...]
    readme_text: str
    written: Written


def run_export(project: Project, format: str, folder: Path, options: ExportOptions) -> Exchanged:
    """Write a format's files into a folder, replacing an earlier export.

    Raises InputError for an unknown format, a folder that holds anything else, and whatever the format cannot
    represent.
    """
    write, convention = format_writer(format)
    check_folder(folder)
    block = read_block(project)
    _check_names(block)
    written = write(block, options)
    decisions = describe_decisions(read_decision_counts(project.comparator))
    written = replace(written, notes=tuple(filter(None, [*written.notes, *block.lens_reach.values(), decisions])))
    parts = {"Lost": written.lost, "Notes": written.notes, "Left out": written.left_out}
    readme_text = readme(format, _convention_lines(convention), parts)
    publish(folder, written.files, readme_text)
    return Exchanged(tuple(written.files), readme_text, written)


def _convention_lines(convention: Convention) -> list[str]:
    col, row = convention.first_pixel_px
    pixel = [] if col != col else [f"The centre of the first pixel is ({col:g}, {row:g})."]
    return [*pixel, f"Axes: {convention.axes}.", f"Source: {convention.source}."]


def readme(what: str, head: Sequence[str], parts: Mapping[str, Sequence[str]]) -> str:
    """Text of the README: a head, and lists by their titles."""
    lines = [f"{_HEAD} {version('reseau')}: {what}", "", *head]
    for title, sentences in parts.items():
        lines += ["", f"{title}:", *(f"- {sentence}" for sentence in sentences or ("nothing",))]
    return "\n".join(lines) + "\n"


def check_folder(folder: Path) -> None:
    """Raise InputError for a folder with anything other than an earlier export, which would be overwritten."""
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not _is_own(folder / README))):
        raise InputError(
            f"{folder}: holds something that is no export of reseau. Name another folder, or an empty one."
        )


def _is_own(path: Path) -> bool:
    return path.is_file() and re.match(_HEAD.encode(), path.read_bytes()[: len(_HEAD)]) is not None


def publish(folder: Path, files: Mapping[str, str | bytes], readme_text: str) -> None:
    """Write all files into a new folder that then replaces the earlier one.

    Raises InputError for file names that lead out of the folder.
    """
    new = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    old = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    try:
        all_files = {**files, README: readme_text}
        places = {path_below(folder, name).relative_to(folder): content for name, content in all_files.items()}
        for place, content in places.items():
            write_atomically(new / place, content)
        with writing(folder):
            if folder.exists():
                os.replace(folder, old)
            os.replace(new, folder)
    except BaseException:
        if old.exists() and not folder.exists():
            os.replace(old, folder)
        raise
    finally:
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)


def _check_names(block: Block) -> None:
    """Raise InputError for images with equal file names in different folders: other programs know images by the name
    only."""
    images: dict[str, str] = {}
    for frame in block.frames:
        other = images.setdefault(frame.file_name, frame.image)
        if other != frame.image:
            raise InputError(
                f"images {other!r} and {frame.image!r} have files of the same name {frame.file_name!r}, and other "
                "programs know images by it. Export them as projects of their own."
            )
