"""Paths of scans other than whole local files: parts of a file, objects in a store, files on a server."""

import hashlib
import os
import re
import stat
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from io import BufferedIOBase
from pathlib import Path, PosixPath
from threading import Lock
from typing import Any, TypeVar

from measure.errors import MeasurementError, MissingError, UnreachableError

Window = tuple[int, int, int, int]  # first column and row, width and height, px

_PART = re.compile(r"(.+)#(?=page|window)(?:page=(\d+))?,?(?:window=(\d+),(\d+),(\d+),(\d+))?")
Made = TypeVar("Made")
Extent = tuple[int, int]  # first byte, and the byte after the last

_EXTRAS = {"s3": "s3", "http": "http", "https": "http"}  # extras of reseau by the scheme of an address
_BLOCK_BYTES = 1 << 16  # heads, tags and tables are fetched in blocks
_MOST_BLOCKS = 256  # kept of an object
_LARGE_READ_BYTES = 4 * _BLOCK_BYTES  # reads of this size and more take one request, and are not kept
_KEPT_OBJECTS = 8  # objects whose blocks are kept
_WAITS_S = (0.1, 0.5, 2.0)  # before a request is repeated
_TIMEOUT_S = 30.0  # without any data
_CHECKSUMS = ("ETag", "Content-MD5", "Digest", "Last-Modified")  # most servers give at least one
_SECRET = re.compile(
    r"x-(amz|goog|oss|ms|cos)-.*|.*(token|secret|passw|credential|accesskey|signature|api_?-?key|auth).*|googleaccessid|"
    r"key-pair-id|policy|sig|expires|exp|pwd|hmac|md5|st|se|sp|sr|sv|spr|sip|ss|srt|sk[a-z]{1,3}|sdd|sas|ticket|"
    r"session.*|jwt|hdn.*|user(name)?",
    re.IGNORECASE,
)  # names of query parameters that belong to a signature, of stores and servers in use
_ADDRESS = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]*:/{1,2})([^\s/?#@'\"<>]*@)?([^\s?#'\"<>]*)(\?[^\s'\"<>]*)?")
_locations: dict[str, str] = {}  # by public address: the address with its credentials or signature


class ScanPart(PosixPath):
    """Path of one page of a file, or of a window of a page: `FILE#page=2` or `FILE#page=1,window=100,200,4000,4000`.
    Pages count from 1; the window is first column and row, width and height, as the page stores its pixels."""

    def __fspath__(self) -> str:
        return self._groups()[0]

    def __reduce__(self) -> tuple[type["ScanPart"], tuple[str]]:
        return ScanPart, (str(self),)

    @property
    def suffix(self) -> str:
        """Ending of the file."""
        return os.path.splitext(self._groups()[0])[1]

    @property
    def page(self) -> int | None:
        """Number of the page, from 1; None: the first picture."""
        page = self._groups()[1]
        return int(page) if page else None

    @property
    def window(self) -> Window | None:
        """Window of the page; None: all of it."""
        col, row, width, height = self._groups()[2:]
        return (int(col), int(row), int(width), int(height)) if col else None

    def _groups(self) -> tuple[str, ...]:
        match = _PART.fullmatch(str(self))
        assert match is not None, f"{self} is no part of a scan"
        return match.groups()


def whole_file(text: str) -> str:
    """File name without page and window."""
    match = _PART.fullmatch(text) if "#" in text else None
    return match.group(1) if match else text


def part_text(file: str, page: int | None, window: Window | None) -> str:
    """Text of a `ScanPart`."""
    parts = [f"page={page}"] if page else []
    parts += [f"window={','.join(map(str, window))}"] if window else []
    return f"{file}#{','.join(parts)}" if parts else file


def public_address(text: str) -> str:
    """Address that may be shown and stored: without user, password and signature, so that it does not change with the
    signature. The rest of its query is replaced by a hash. Any other text is returned unchanged."""
    if not is_address(text):
        return text
    scheme, _, rest = text.partition("://")
    rest, _, query = rest.partition("#")[0].partition("?")
    host, slash, path = rest.partition("/")
    own = [part for part in query.split("&") if part and not _SECRET.fullmatch(part.partition("=")[0])]
    query_hash = f"?query={hashlib.sha256('&'.join(sorted(own)).encode()).hexdigest()[:12]}" if own else ""
    return f"{scheme.lower()}://{host.rpartition('@')[2]}{slash}{path}{query_hash}"


def public_text(text: str) -> str:
    """Text with user, password and query removed from all its addresses."""
    return _ADDRESS.sub(r"\1\3", text) if ":/" in text else text


def _register(segment: Any) -> Any:
    """Return the public form of an address and remember its location, with credentials."""
    if not isinstance(segment, str) or not is_address(segment):
        return segment
    shown = public_address(segment)
    if shown != segment:
        _locations[shown] = segment
    return shown


class Address(PosixPath):
    """Path of a remote file: `s3://bucket/key`, `https://host/path` or `http://host/path`.

    Its text has no user, password or signature; `location` has them.

    Its methods raise MissingError if there is no such file, UnreachableError if it cannot be read after several tries,
    and MeasurementError if the extra of reseau for its scheme is not installed.
    """

    def __new__(cls, *segments: Any) -> "Address":
        return super().__new__(cls, *map(_register, segments))

    if sys.version_info >= (3, 12):

        def __init__(self, *segments: Any) -> None:
            super().__init__(*map(_register, segments))

    @property
    def location(self) -> str:
        """Address with credentials or signature, to fetch it by."""
        return _locations.get(str(self), str(self))

    def __str__(self) -> str:
        return super().__str__().replace(":/", "://", 1)

    def __fspath__(self) -> str:
        return str(self)

    def __reduce__(self) -> tuple[type["Address"], tuple[str]]:
        return Address, (self.location,)

    @property
    def etag(self) -> str:
        """Checksum or date of the content by the store, requested anew; "" if it gives none."""
        return _query_object(self).etag

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Status with the size, requested anew; all other fields are 0."""
        return os.stat_result((stat.S_IFREG, 0, 0, 0, 0, 0, _query_object(self).size, 0, 0, 0))

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        try:
            _query_object(self)
        except MissingError:
            return False
        return True

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        return self.exists()

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        return False

    def absolute(self) -> "Address":
        return self

    def resolve(self, strict: bool = False) -> "Address":
        return self

    def open(self, *args: Any, **kwargs: Any) -> Any:  # any modes, as for files
        """Open for reading bytes. The blocks read are kept, so this is meant for heads, tags and tables."""
        return _RemoteFile(self)

    def read_bytes(self) -> bytes:
        """Read the whole file by one request."""
        (data,) = self.ranges([(0, _remote_object(self).size)])
        return data

    def ranges(self, extents: Sequence[Extent]) -> list[bytes]:
        """Read the bytes of several extents, requested together."""
        system = _file_system(self)
        starts, ends = [first for first, _ in extents], [after for _, after in extents]

        def fetch() -> list[bytes]:
            fetched: list[bytes] = system.cat_ranges([self.location] * len(starts), starts, ends, on_error="raise")
            for part, start, end in zip(fetched, starts, ends, strict=True):
                if len(part) > end - start:
                    raise UnreachableError(
                        f"{self}: its server gives no parts of files (no ranges of bytes). Download it, and name the "
                        "file."
                    )
                if len(part) < end - start:
                    raise ConnectionError(f"{len(part)} bytes came in place of {end - start}")
            return fetched

        parts = _retry(self, fetch)
        with _holding:
            TRAFFIC.ranges += len(parts)
            TRAFFIC.bytes += sum(map(len, parts))
        return parts


@dataclass
class Traffic:
    """Ranges and bytes that this process has requested from stores and servers."""

    ranges: int = 0
    bytes: int = 0


TRAFFIC = Traffic()
_holding = Lock()


def scan_path(text: str | Path) -> Path:
    """Path of a file, of a part of a file, or an address, from its text."""
    if isinstance(text, Path):
        return text
    kind = ScanPart if _PART.fullmatch(text) else Address if is_address(text) else Path
    return kind(text)


def fetch_location(path: str | Path) -> str:
    """Text by which a file or an address can be opened in any process. It may hold credentials: do not show or store
    it."""
    known = scan_path(path)
    return known.location if isinstance(known, Address) else str(path)


def is_address(text: str) -> bool:
    scheme, colon, _ = text.partition("://")
    return bool(colon) and scheme.lower() in _EXTRAS


def find_addresses(pattern: str) -> list[Path]:
    """Find the objects of a store that match a pattern.

    Parameters
    ----------
    pattern : `**` stands for any number of folders. Servers list no files: an address on one is returned as it is.

    Raises
    ------
    MissingError, UnreachableError, MeasurementError
        As `Address` does.
    """
    address = Address(pattern)
    system = _file_system(address)
    if _scheme(address) != "s3" or not any(sign in pattern for sign in "*?["):
        return [address]
    names = _retry(address, lambda: list(system.glob(pattern)))
    return [Address(f"s3://{name}") for name in sorted(names)]


def list_addresses(address: Address) -> list[Path]:
    """List every object of a store below an address, at any depth, or every file listed on a server's pages there.

    Raises
    ------
    MissingError, UnreachableError, MeasurementError
        As `Address` does.
    """
    system = _file_system(address)
    if _scheme(address) == "s3":
        names = _retry(address, lambda: list(system.find(address.location)))
        return [Address(f"s3://{name}") for name in sorted(names)]
    files, visited, folders = set[str](), set[str](), [f"{address}/"]
    while folders:
        folder = folders.pop()
        visited.add(folder)
        listed = {str(entry["name"]) for entry in _retry(address, partial(system.ls, folder, detail=True))}
        below = {name for name in listed if name.startswith(folder) and "?" not in name and "#" not in name} - visited
        folders += sorted(name for name in below if name.endswith("/"))
        files |= {name for name in below if not name.endswith("/")}
    return [Address(name) for name in sorted(files)]


@dataclass
class _RemoteObject:
    """Object in a store: size, checksum of its content, and fsspec's cache of its blocks."""

    size: int
    etag: str
    blocks: Any


_objects: OrderedDict[str, _RemoteObject] = OrderedDict()


class _RemoteFile(BufferedIOBase):
    """Remote file, read by blocks."""

    def __init__(self, address: Address) -> None:
        self.name, self._address, self._object, self._place = str(address), address, _remote_object(address), 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._object.size}[whence]
        return self._place

    def read(self, size: int | None = -1) -> bytes:
        start, end = self._place, self._object.size
        if size is not None and size >= 0:
            end = min(start + size, end)
        self._place = max(start, end)
        if end - start < _LARGE_READ_BYTES:
            return bytes(self._object.blocks._fetch(start, end))
        return self._address.ranges([(start, end)])[0]


def _remote_object(address: Address) -> _RemoteObject:
    """Object as known from the last request of its size."""
    with _holding:
        known = _objects.get(str(address))
    return _query_object(address) if known is None else known


def _query_object(address: Address) -> _RemoteObject:
    """Request size and checksum anew; blocks of an unchanged content are kept."""
    system = _file_system(address)
    info: Mapping[str, Any] = _retry(address, lambda: system.info(address.location))
    size, etag = info.get("size"), next((str(info[key]) for key in _CHECKSUMS if info.get(key)), "")
    if size is None:
        raise UnreachableError(f"{address}: its server does not say how large it is. Download it, and name the file.")

    def fetch(start: int, end: int) -> bytes:
        return address.ranges([(start, min(end, int(size)))])[0]

    with _holding:
        known = _objects.get(str(address))
        if known is None or (known.size, known.etag) != (size, etag):
            blocks = import_module("fsspec.caching").BlockCache(_BLOCK_BYTES, fetch, int(size), _MOST_BLOCKS)
            known = _objects[str(address)] = _RemoteObject(int(size), etag, blocks)
        _objects.move_to_end(str(address))
        while len(_objects) > _KEPT_OBJECTS:
            _objects.popitem(last=False)
    return known


def _retry(address: Address, ask: Callable[[], Made]) -> Made:
    """Repeat a request that fails. Forbidden ones are repeated, too, since busy stores sometimes refuse requests."""
    for wait_s in (*_WAITS_S, None):
        try:
            return ask()
        except MeasurementError:
            raise
        except Exception as caught:  # each of fsspec's libraries has its own
            error: BaseException = caught
            if isinstance(error, FileNotFoundError):
                # fsspec reports any refusal of a server as a missing file, with the refusal as its cause.
                error = error.__cause__ or error
                if isinstance(error, FileNotFoundError) or _status(error) == 404:
                    message = f"there is no {address}: check its name, and that its server has it"
                    raise MissingError(message) from None
            if wait_s is None:
                raise UnreachableError(f"{address}: {_explanation(error)}. Tried {len(_WAITS_S) + 1} times.") from error
            time.sleep(wait_s)
    raise AssertionError


def _explanation(error: BaseException) -> str:
    if isinstance(error, PermissionError) or _status(error) in (401, 403):
        return "its server forbids to read it (403): check your credentials and its permissions"
    if isinstance(error, TimeoutError):
        return f"its server did not answer within {_TIMEOUT_S:g} s"
    return f"it cannot be reached ({type(error).__name__}: {public_text(str(error))})"


def _status(error: BaseException) -> int | None:
    """HTTP status code of an error of aiohttp."""
    return getattr(error, "status", None)


def _scheme(address: Address) -> str:
    return str(address).partition("://")[0].lower()


def _file_system(address: Address) -> Any:
    """File system of fsspec for the address's scheme, which fsspec caches."""
    scheme = _scheme(address)
    try:
        fsspec = import_module("fsspec")
        if scheme == "s3":
            config = {"read_timeout": _TIMEOUT_S, "connect_timeout": _TIMEOUT_S}
            return fsspec.filesystem("s3", config_kwargs=config, default_cache_type="none")
        timeout = import_module("aiohttp").ClientTimeout(sock_connect=_TIMEOUT_S, sock_read=_TIMEOUT_S)
        return fsspec.filesystem(scheme, client_kwargs={"timeout": timeout}, use_listings_cache=False)
    except ImportError:
        extra = _EXTRAS[scheme]
        raise MeasurementError(
            f"{address}: addresses that begin with {scheme}:// need the extra {extra!r}: pip install 'reseau[{extra}]'"
        ) from None
