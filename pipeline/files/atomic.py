"""Files that are written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import InputError, what_to_do


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary file beside `path`, renamed to it when the block ends well; otherwise `path` stays as it was.

    Raises InputError, with the reason, where the folder cannot be made or the file cannot be written.
    """
    with _temporary_file(path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}"), path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextmanager
def _temporary_file(temporary: Path, told: Path) -> Iterator[Path]:
    """In a folder that is made for it, gone when the block ends. told: what an InputError says cannot be written."""
    try:
        temporary.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(
            f"{told}: cannot be written: {error.filename} is a file, and a folder is needed there. Set another output."
        ) from error
    except OSError as error:
        raise InputError(
            f"{told}: cannot be written ({error.strerror or error}). Nothing was changed there. {what_to_do(error)}"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text (UTF-8) or bytes to `path`, whole or not at all. Raises InputError where that cannot be done."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def check_writable(folder: Path) -> None:
    """Know before long work whether its results can be written. Raises InputError where they cannot."""
    with _temporary_file(folder / f".writable.{os.getpid()}.part", folder) as temporary:
        temporary.touch()
