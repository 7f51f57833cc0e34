"""A small server of files by ranges of bytes, in the process, which counts what it is asked for and fails as told."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread


@dataclass
class RangeServer:
    """gets, sent_bytes: of requests that were answered with a part of a file. failures: of the next GETs, in their
    order: a status, or how many seconds they are kept waiting. by_ranges: whether it knows them. signature: of a
    query, without which it refuses."""

    url: str = ""
    gets: int = 0
    sent_bytes: int = 0
    failures: list[int | float] = field(default_factory=list)
    by_ranges: bool = True
    signature: str = ""


@contextmanager
def range_server(folder: Path) -> Iterator[RangeServer]:
    counted = RangeServer()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            data = self._data()
            if data is not None:
                self._answer(200, b"", {"Content-Length": str(len(data)), "Accept-Ranges": "bytes"})

        def do_GET(self) -> None:
            if counted.failures:
                failure = counted.failures.pop(0)
                if isinstance(failure, int):
                    return self._answer(failure, b"")
                time.sleep(failure)
            data = self._data()
            if data is None:
                return None
            part = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", "")) if counted.by_ranges else None
            first, last = map(int, part.groups()) if part else (0, len(data) - 1)
            body = data[first : last + 1]
            counted.gets += 1
            counted.sent_bytes += len(body)
            result = {"Content-Range": f"bytes {first}-{last}/{len(data)}"} if part else {}
            return self._answer(206 if part else 200, body, result)

        def _data(self) -> bytes | None:
            """None where the refusal was sent."""
            path, _, query = self.path.partition("?")
            is_signed = counted.signature in query
            file, is_closed = folder / path.lstrip("/"), path.startswith("/closed/") or not is_signed
            if path.endswith("/") and file.is_dir() and not is_closed:
                names = [f"{one.name}{'/' * one.is_dir()}" for one in sorted(file.iterdir())]
                links = ["../", "?C=N;O=D", *names]
                return "".join(f'<a href="{name}">{name}</a>\n' for name in links).encode()
            if file.is_file() and not is_closed:
                return file.read_bytes()
            self._answer(403 if is_closed else 404, b"")
            return None

        def _answer(self, status: int, body: bytes, headers: dict[str, str] | None = None) -> None:
            try:
                self.send_response(status)
                for name, value in {"Content-Length": str(len(body)), "ETag": '"1"', **(headers or {})}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body)
            except (BrokenPipeError, ConnectionResetError):
                pass  # whoever asked has gone

        def log_message(self, format: str, *args: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    counted.url = f"http://127.0.0.1:{server.server_port}"
    try:
        yield counted
    finally:
        server.shutdown()
        server.server_close()
