"""Publish the results of a command together: they replace earlier ones when all are complete, or not at all."""

import os
import re
import shutil
import signal
import socket
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from pipeline.errors import WriteError
from pipeline.files.project_file import Project
from pipeline.text.files import FORMS, check_replaceable, writing

_HEADS = {
    **FORMS,
    ".db": rb"SQLite format 3\0",
    ".npz": rb"PK\x03\x04.{26}(fingerprint|names)\.npy",
    ".csv": rb"# written about the frames, reseau",
    ".html": rb"<!DOCTYPE html>.*<title>.*: (calibration|film|frame) report</title>",
    ".toml": rb"# Marks learned by reseau",
}
_COMPARATOR = rb'(\xef\xbb\xbf)?"?# comparator coordinates, reseau'


class Unpublished:
    """Results of a command that are not yet published, in a temporary folder beside the earlier results."""

    def __init__(self, output: Path, comparator: Path) -> None:
        self._output, self._comparator = output, comparator
        self.folder = output / f".unfinished.{socket.gethostname()}.{os.getpid()}"
        self._removed: list[Path] = []

    def place(self, path: Path) -> Path:
        """Temporary path of the result that will be published at `path`."""
        if path == self._comparator:
            return path.with_name(f".{path.stem}{self.folder.name}{path.suffix}")
        return self.folder / path.relative_to(self._output)

    def current_path(self, path: Path) -> Path:
        """Present path of the result of `path`: the unpublished one, if there is one, else the earlier one."""
        place = self.place(path)
        return place if place.exists() or path in self._removed else path

    def remove(self, path: Path) -> None:
        """Mark an earlier result that is no longer valid, to be deleted on publication."""
        self._removed.append(path)

    def publish(self) -> None:
        """Move all files to their final places.

        Raises InputError, before anything is changed, where an existing file may not be replaced, and WriteError where
        a file cannot be moved.
        """
        comparator = self._comparator
        files = {self.place(comparator): comparator} if self.place(comparator).exists() else {}
        for file in sorted(self.folder.rglob("*")):
            if file.is_file():
                files[file] = self._output / file.relative_to(self.folder)
        for path in (*files.values(), *self._removed):
            _check_replaceable(path, comparator)
        done: list[str] = []
        with _deferred_interrupts():
            try:
                for place, path in files.items():
                    with writing(path):
                        path.parent.mkdir(parents=True, exist_ok=True)
                        os.replace(place, path)
                    done.append(path.name)
                for path in self._removed:
                    with writing(path):
                        path.unlink(missing_ok=True)
            except WriteError as error:
                raise WriteError(f"{error} New are: {', '.join(done) or 'none'}. Run it again.") from error


@contextmanager
def unpublished(project: Project) -> Iterator[Unpublished]:
    """Context for the results of one command; results that are not published when the block ends are deleted.

    Raises InputError where they could not be written, before any work is done.
    """
    for path in project.results:
        _check_replaceable(path, project.comparator)
    _clear({project.output, project.comparator.parent})
    new, is_output_new = Unpublished(project.output, project.comparator), not project.output.exists()
    place = new.place(project.comparator)
    try:
        with writing(project.output):
            new.folder.mkdir(parents=True, exist_ok=True)
        if project.scans:
            with writing(project.comparator):
                place.touch()
                place.unlink()
        yield new
    except WriteError as error:  # names the final paths, not the temporary ones
        text = str(error).replace(str(place), str(project.comparator))
        raise WriteError(text.replace(f"{new.folder.name}{os.sep}", "")) from error
    finally:
        shutil.rmtree(new.folder, ignore_errors=True)
        if is_output_new:
            with suppress(OSError):  # it is not empty
                project.output.rmdir()
        with suppress(OSError):
            place.unlink(missing_ok=True)


@contextmanager
def _deferred_interrupts() -> Iterator[None]:
    """Defer interrupts until the short block ends, so that results are not published by halves."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    handlers = {each: signal.signal(each, lambda *what: came.append(what)) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
    for sign, frame in came:
        if callable(handler := handlers[signal.Signals(sign)]):
            handler(sign, frame)
        else:
            signal.raise_signal(sign)


def _check_replaceable(path: Path, comparator: Path) -> None:
    """Raise InputError for a path where something exists that is not a result of this kind."""
    form = _COMPARATOR if path == comparator else _HEADS.get(path.suffix, rb"(?!)")
    check_replaceable(path, form, f"name another {'comparator' if path == comparator else 'output'} in the project")


def outside_note(project: Project) -> str:
    """Note on folders outside the project's that are written to; "" where there are none."""
    home = project.path.resolve().parent
    folders = {project.output.resolve(), *({project.comparator.resolve().parent} if project.scans else ())}
    outside = sorted(str(folder) for folder in folders if not folder.is_relative_to(home))
    return f"Results are written outside the project's folder: to {', '.join(outside)}." if outside else ""


def _clear(folders: Iterable[Path]) -> None:
    """Delete temporary results of processes that ended before they could do so."""
    pattern = re.compile(rf".*\.unfinished\.{re.escape(socket.gethostname())}\.(\d+)(\..*)?")
    for folder in folders:
        for path in folder.glob(".*unfinished.*") if folder.is_dir() else ():
            found = pattern.fullmatch(path.name)
            if found is None or _is_alive(int(found[1])):
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def _is_alive(pid: int) -> bool:
    if os.name == "posix":  # on other systems signal 0 would end the process
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        except OSError:
            pass
    return True
