"""Atomic writing of files."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import WriteError, what_to_do


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Temporary file in the folder of `path`, renamed to it if the block succeeds; otherwise `path` is unchanged.

    Raises WriteError, with the reason, if the folder cannot be created or the file cannot be written.
    """
    with _temporary_file(path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}"), path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextmanager
def _temporary_file(temporary: Path, told: Path) -> Iterator[Path]:
    """Temporary file, in a folder created if necessary; removed at the end. told: path named in a WriteError."""
    try:
        with writing(told):
            temporary.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(told: Path) -> Iterator[None]:
    """Convert errors of the operating system in the block to a WriteError that names the file."""
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
    """Write text (UTF-8) or bytes to `path` atomically. Raises WriteError if that fails."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def check_writable(folder: Path) -> None:
    """Check before a long computation that its results can be written. Raises WriteError if not."""
    with _temporary_file(folder / f".writable.{os.getpid()}.part", folder) as temporary:
        temporary.touch()
