"""A review of a small project, served by a thread, and what a person does on its page."""

import csv
import http.client
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import numpy as np
import tifffile
import uvicorn
from drawn import ALIKE, CORNERS, NOISE_DN, Array, frame_picture, pixel_from_camera
from playwright.sync_api import Page
from projects import CAMERA, PROJECT, command

from measure.fiducials.stages import find_frame
from measure.flags import NO_REASON
from pipeline.files.project_file import read_undrawn
from pipeline.review.server import serve

GOOD, BARE, SCRATCHED, TURNED = "good", "<img src=x onerror=alert(1)>", "scratched", "turned"
FAR_TURN_RAD = 0.35  # of TURNED: no search looks for a frame that is laid so


def write_faults(folder: Path) -> Path:
    """Four frames: one without fault; of one mark 3 is not there; of one it is scratched; one lies askew."""
    folder.mkdir(parents=True)
    (folder / "camera.toml").write_text(CAMERA)
    for seed, name in enumerate((GOOD, BARE, SCRATCHED, TURNED), 1):
        grey = frame_picture(ALIKE, mark_matrix(name), seed)
        col, row = np.rint(mark_px(name, "3")).astype(int)
        if name == BARE:
            noise = np.random.default_rng(seed).normal(0, NOISE_DN, (81, 81))
            grey[row - 40 : row + 41, col - 40 : col + 41] = 3000 + noise
        if name == SCRATCHED:
            grey[row - 30 : row + 31, col + 1 : col + 9] = 14000
        tifffile.imwrite(folder / f"{name}.tif", np.clip(np.rint(grey), 0, 65535).astype(np.uint16))
    (folder / "project.toml").write_text(PROJECT)
    return folder / "project.toml"


def measured_faults(folder: Path) -> Path:
    """The folder of these frames, measured. The long search that fails in the last one is left out."""
    project = write_faults(folder)

    def found(scan: Any, *rest: Any) -> Any:
        if scan.name == TURNED:
            return SimpleNamespace(frame=None, result=None, misfit=NO_REASON)
        return find_frame(scan, *rest)

    with patch("measure.fiducials.measurement.find_frame", found):
        assert command("measure", project) == 1
    return folder


def mark_matrix(name: str) -> Array:
    """Camera mm to pixels, as the frame was drawn."""
    return pixel_from_camera("0", FAR_TURN_RAD if name == TURNED else 0.004)


def mark_px(name: str, point: str) -> Array:
    """Where a mark was drawn."""
    return np.asarray(mark_matrix(name) @ (*CORNERS[int(point) - 1], 1.0))


@dataclass(frozen=True)
class Served:
    """address: with its token."""

    address: str

    @property
    def origin(self) -> str:
        return self.address.split("/?")[0]


@contextmanager
def served(project: Path) -> Iterator[Served]:
    """What `reseau review` serves, until the block ends."""
    addresses, servers = SimpleQueue[str](), list[uvicorn.Server]()

    class Kept(uvicorn.Server):
        def __init__(self, config: uvicorn.Config) -> None:
            super().__init__(config)
            servers.append(self)

    with patch.object(uvicorn, "Server", Kept):
        thread = Thread(target=serve, args=(read_undrawn(project), 0, "ann", False, addresses.put))
        thread.start()
        address = addresses.get(timeout=60)
        assert address.startswith("http://127.0.0.1:"), address
        try:
            yield Served(address)
        finally:
            servers[0].should_exit = servers[0].force_exit = True
            thread.join()


def steer(page: Page, view: str, place_px: Array) -> None:
    """Arrow keys until the cursor, which the page tells, is there to a step of them."""
    page.keyboard.press("ArrowRight")
    before = cursor(page, view)
    page.keyboard.press("ArrowRight")
    step = cursor(page, view) - before
    for axis, (less, more) in enumerate((("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"))):
        left = (place_px - cursor(page, view))[axis]
        for _ in range(round(abs(left) / step[0])):
            page.keyboard.press(more if left > 0 else less)


def cursor(page: Page, view: str) -> Array:
    return np.array(json.loads(page.locator(f"#{view}").get_attribute("data-cursor") or "null"), dtype=float)


def decisions(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "decisions.jsonl").read_text().splitlines()]


def comparator(folder: Path) -> Mapping[tuple[str, str], Mapping[str, str]]:
    lines = (folder / "comparator.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {(row["image"], row["point"]): row for row in rows}


def request(
    server: Served, path: str, headers: Mapping[str, str] | None = None, method: str = "GET", body: str = ""
) -> tuple[int, Mapping[str, str], str]:
    """Status, headers and text of an answer; 500 where there is none, as after a fault of the program."""
    where = urlsplit(server.address)
    connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=60)
    try:
        connection.request(method, path, body or None, dict(headers or {}))
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read().decode(errors="replace")
    except http.client.HTTPException as error:
        return 500, {}, repr(error)
    finally:
        connection.close()


def get_cookie(server: Served) -> str:
    status, headers, _ = request(server, f"/?{urlsplit(server.address).query}")
    assert (status, headers["location"]) == (303, "/")
    cookie = headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "samesite=strict" in cookie.lower()
    return cookie.split(";")[0]
