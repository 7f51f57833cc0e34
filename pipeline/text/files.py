"""Files: reading of whole regular ones of limited size, JSON with finite numbers, atomic writing; names of images and
paths below a folder."""

import json
import os
import re
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

from pipeline.errors import InputError, WriteError, what_to_do
from pipeline.text.wording import nearest

MOST_MB = 200  # MB; of what users write
RESULT_MB = 2000  # MB; adjustment.json of 50,000 film frames has 415, comparator.csv with 100 tie points each 550
SHOWN = 60  # characters of a wrong value quoted in a message
_HEAD_BYTES = 4096
FORMS = {  # beginnings of results, by the file's ending
    ".json": rb'\s*\{\s*("reseau"|"verdict": "[a-z ]+",\s*"(reason|prob)|"chosen": (null|\{\s*"transformation"))',
    ".tif": rb"(II|MM).*reseau",
    ".svg": rb'<svg class="plot" role="img"',
    ".png": rb"\x89PNG.*reseau",
    ".pdf": rb"%PDF-1\.4\n%\xac\xdc \xab\xba",  # by Matplotlib
}

_KINDS = {stat.S_ISFIFO: "a pipe", stat.S_ISCHR: "a device", stat.S_ISBLK: "a device", stat.S_ISSOCK: "a socket"}
LARGEST = 1e15  # limit of coordinates, sizes and standard deviations, any unit: squares of larger ones lose precision
FilePath = str | os.PathLike[str]
SMALLEST_SIGMA = 1e-9  # limit of standard deviations, mm, m or degrees: weights of smaller ones dominate all others
FINEST_PITCH_UM = 0.1  # µm; no scanner or sensor has smaller pixels, so that mm or m must have been meant


def split_lines(text: str) -> list[str]:
    """Split text at line ends, which are kept. `str.splitlines` also splits at U+2028, which names may have."""
    return re.findall(r"[^\r\n]*(?:\r\n?|\n)|[^\r\n]+", text)


@contextmanager
def regular_file(path: Path) -> Iterator[BufferedReader]:
    """Open a file for reading.

    Raises FileNotFoundError and IsADirectoryError, for which the caller has a better message, and InputError for a file
    that is not regular (a pipe would block, a device has no end) or unreadable.
    """
    try:
        found = path.stat()
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(path)
        if not stat.S_ISREG(found.st_mode):
            kind = next((kind for is_kind, kind in _KINDS.items() if is_kind(found.st_mode)), "something else")
            raise InputError(f"{path}: is {kind}; a regular file is needed here. Copy its content into one.")
        with path.open("rb") as file:
            yield file
    except (FileNotFoundError, IsADirectoryError):
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None


def read_bytes(path: Path, most_mb: int = MOST_MB) -> bytes:
    """Read the content of a file. Raises as `regular_file` does, and InputError for a file that is too large."""
    with regular_file(path) as file:
        size_mb = os.fstat(file.fileno()).st_size // 1_000_000
        data = file.read(min(most_mb, max(MOST_MB, size_mb + 1)) * 1_000_000 + 1)  # reserves as much memory
    if len(data) > most_mb * 1_000_000:
        raise InputError(
            f"{path}: has more than {most_mb} MB, the most that such a file may have. Is it the right one?"
        )
    return data


def parse_json(data: bytes, path: Path) -> Any:
    """Parse the content of a JSON file. path: for messages. Raises InputError, with the remedy, for invalid JSON, which
    includes NaN, infinite and overlong numbers, and excessive nesting."""
    try:
        return json.loads(data.decode("utf-8"), parse_constant=refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is not valid JSON ({error}). It is a file of another kind, or damaged: then run its stage again."
        ) from None


def refuse_constant(text: str) -> float:
    """Refuse NaN and infinities, which are no JSON. Raises ValueError."""
    raise ValueError(f"{text} is no number of JSON")


def quote_value(value: object) -> str:
    """Quote a wrong value in a message, on one line and shortened."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits" if isinstance(value, int) else "this"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Temporary file in the folder of `path`, renamed to it if the block succeeds; otherwise `path` is unchanged.

    Raises WriteError, with the reason, if the folder cannot be created or the file cannot be written.
    """
    with _temporary_file(path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}"), path) as temporary:
        yield temporary
        os.replace(temporary, path)


@contextmanager
def _temporary_file(temporary: Path, path: Path) -> Iterator[Path]:
    """Temporary file, in a folder created if necessary; removed at the end. path: named in a WriteError."""
    try:
        with writing(path):
            temporary.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert errors of the operating system in the block to a WriteError that names the file."""
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        named = Path(error.filename)
        file = next(each for each in (named, *named.parents) if each.exists())
        raise WriteError(
            f"{path}: cannot be written: {file} is a file, and a folder is needed there. Name another folder."
        ) from error
    except OSError as error:
        raise WriteError(
            f"{path}: cannot be written ({error.strerror or error}). Nothing was changed there. {what_to_do(error)}"
        ) from error


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write text (UTF-8) or bytes to `path` atomically. Raises WriteError if that fails."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def make_folder(folder: Path) -> None:
    """Create a folder, with those above it, if it does not exist. Raises WriteError, also for a file in its place."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def check_writable(folder: Path) -> None:
    """Check before a long computation that its results can be written. Raises WriteError if not."""
    with _temporary_file(folder / f".writable.{os.getpid()}.part", folder) as temporary:
        temporary.touch()


def check_replaceable(path: Path, form: bytes, remedy: str) -> None:
    """Raise InputError for a path where something exists that is no such result: a device, a user's file.

    form: regular expression at the beginning of such results. remedy: what to do if the file is not moved away.
    """
    if path.is_dir() or (path.exists() and not path.is_file()):
        raise InputError(f"{path}: a result is to be written there, but it is no regular file. Name another place.")
    if not path.exists():
        return
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if head and not re.match(form, head, re.DOTALL):
        raise InputError(
            f"{path}: a result is to be written there, but the file that stands there was not written by reseau. Move "
            f"it away, or {remedy}."
        )


def no_such_file(path: Path) -> str:
    """Message on a missing file, with the file of a similar name in its folder that was probably meant."""
    try:
        others = {other.stem: other.name for other in path.parent.iterdir() if nearest(path.suffix, [other.suffix])}
    except OSError:
        others = {}
    near = nearest(path.stem, others)
    meant = f" Did you mean {others[near]!r}?" if near else ""
    searched = "" if path.is_absolute() else f" (searched at {os.path.abspath(path)})"
    return f"{path}: there is no such file{searched}.{meant}"


SCAN_ENDINGS = (".tif", ".tiff", ".jpg", ".jpeg", ".jp2", ".j2k", ".png", ".bmp", ".pgm", ".ppm")


def image_name(text: str) -> str:
    """Name of an image from its file: folders separated by `/`, without the file ending of an image format, and without
    leading or trailing blanks, which tables do not preserve."""
    folder, slash, file = text.strip().rpartition("/")
    name, ending = os.path.splitext(file)
    return folder + slash + (name if ending.lower() in SCAN_ENDINGS else file).strip()


def names_below(files: Collection[str | Path], others: Collection[str | Path] | None = None) -> list[str]:
    """Names of images in the order of their files: paths relative to the common folder of all files. others: files to
    name instead, relative to the same folder."""
    given = {text[: text.rfind(os.sep) + 1] for text in map(str, files)}
    places = [text.rpartition(os.sep) for text in map(str, files if others is None else others)]
    folders = {folder: os.path.abspath(folder) for folder in given.union(folder + sign for folder, sign, _ in places)}
    shared = os.path.commonpath([folders[folder] for folder in given] or [os.sep])
    below = {folder: Path(os.path.relpath(path, shared)).as_posix() for folder, path in folders.items()}
    before = {folder: "" if path == os.curdir else f"{path}/" for folder, path in below.items()}
    return [image_name(before[folder + sign] + name) for folder, sign, name in places]


def path_below(folder: Path, name: str, suffix: str = "") -> Path:
    """Path of a name below a folder, with sub-folders for each `/`. suffix: appended to the name.

    Raises InputError for a name that would lead out of the folder, or that is no valid file name on some system.
    """
    parts = name.split("/")
    if not name.isprintable() or any(
        part.strip() in ("", ".", "..") or "\\" in part or part[1:2] == ":"  # a Windows drive
        for part in parts
    ):
        raise InputError(
            f"the name {quote_value(name)} cannot be that of a file below {folder}: nothing was written. A name is a "
            "file's, with folders before it and `/` between, without .. and backslash. Rename the image, frame or "
            "camera."
        )
    return folder.joinpath(*parts[:-1], f"{parts[-1]}{suffix}")


def file_word(name: str) -> str:
    """Convert a name to part of a file name: characters other than letters, digits, `-`, `_` and `.` become `-`."""
    word = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
    return word if word.strip(".") else "-"
