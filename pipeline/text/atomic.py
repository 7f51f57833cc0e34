"""Files that are written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import WriteError, what_to_do


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary file beside `path`, renamed to it when the block ends well; otherwise `path` stays as it was.

    Raises WriteError, with the reason, where the folder cannot be made or the file cannot be written.
    """
    with _temporary_file(path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}"), path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextmanager
def _temporary_file(temporary: Path, told: Path) -> Iterator[Path]:
    """In a folder that is made for it, gone when the block ends. told: what a WriteError says cannot be written."""
    try:
        with writing(told):
            temporary.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(told: Path) -> Iterator[None]:
    """What the operating system refuses in the block, as a WriteError that names the file."""
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        named = Path(error.filename)
        file = next(each for each in (named, *named.parents) if each.exists())
        raise WriteError(
            f"{told}: cannot be written: {file} is a file, and a folder is needed there. Set another output."
        ) from error
    except OSError as error:
        raise WriteError(
            f"{told}: cannot be written ({error.strerror or error}). Nothing was changed there. {what_to_do(error)}"
        ) from error


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text (UTF-8) or bytes to `path`, whole or not at all. Raises WriteError where that cannot be done."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def check_writable(folder: Path) -> None:
    """Know before long work whether its results can be written. Raises WriteError where they cannot."""
    with _temporary_file(folder / f".writable.{os.getpid()}.part", folder) as temporary:
        temporary.touch()
