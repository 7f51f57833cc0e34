"""Scans in object stores and on servers give what local files give, by few requests and bytes; what does not answer is
told as such, and never as damage."""

import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from range_server import RangeServer, range_server
from studies import parametrize_with_studies

from measure.errors import MeasurementError, MissingError, UnreachableError
from measure.scans import remote
from measure.scans.opening import declared_tone, open_scan
from measure.scans.remote import Address, scan_path

SIDE_PX, TILE_PX = 2304, 128
LAYOUTS: dict[str, dict[str, Any]] = {
    "tiles": {"tile": (TILE_PX, TILE_PX), "compression": "zlib"},
    "rows": {},
    "strips": {"rowsperstrip": 16, "compression": "lzw"},
    "planes": {"tile": (TILE_PX, TILE_PX), "planarconfig": "separate", "photometric": "rgb"},
}
PLACES = [(200 + 1850 * (number % 2), 230 + 480 * (number // 2), 40, 40) for number in range(8)]


def noise(channels: tuple[int, ...] = ()) -> Any:
    return np.random.default_rng(1).integers(0, 256, (*channels, SIDE_PX, SIDE_PX), np.uint8)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "_WAITS_S", (0.01, 0.01))
    monkeypatch.setattr(remote, "_TIMEOUT_S", 0.3)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RangeServer]:
    with range_server(tmp_path) as server:
        yield server


@parametrize_with_studies("layout", LAYOUTS, quick=(1, 2))
def test_windows_are_those_of_the_local_file(tmp_path: Path, server: RangeServer, layout: str) -> None:
    picture = noise((3,) if layout == "planes" else ())
    tifffile.imwrite(tmp_path / "s.tif", picture, **LAYOUTS[layout])
    with open_scan(tmp_path / "s.tif") as local, open_scan(f"{server.url}/s.tif") as remote:
        for place in (*PLACES, (-20, -20, 50, 50), (SIDE_PX - 30, SIDE_PX - 30, 60, 60)):
            np.testing.assert_array_equal(remote.samples(*place), local.samples(*place))
        assert remote.name == "s"
        assert remote.notes == local.notes
        assert (remote.pitch_um, remote.is_lossy, remote.damage) == (local.pitch_um, local.is_lossy, "")


def test_eight_windows_take_few_requests_and_bytes(tmp_path: Path, server: RangeServer) -> None:
    tifffile.imwrite(tmp_path / "s.tif", noise(), **LAYOUTS["tiles"])
    with open_scan(f"{server.url}/s.tif") as scan:
        declared_tone(scan.path)
        opening, head_bytes = server.gets, server.sent_bytes
        for place in PLACES:
            scan.samples(*place)
    assert opening <= 3
    assert head_bytes <= 3 * (1 << 16)
    assert server.gets - opening <= 8 * 4
    assert server.sent_bytes - head_bytes <= 8 * 4 * 1.01 * TILE_PX**2


def test_bytes_are_fetched_by_blocks_and_once_and_large_reads_by_one_request(
    tmp_path: Path, server: RangeServer
) -> None:
    data = np.random.default_rng(2).bytes(1_000_001)
    (tmp_path / "a.bin").write_bytes(data)
    block = 1 << 16
    with scan_path(f"{server.url}/a.bin").open("rb") as file:
        for place, size, gets in ((block - 10, 20, 2), (100, 50, 0), (2 * block - 10, 10, 0), (len(data) - 5, 9, 1)):
            before = server.gets
            file.seek(place)
            assert file.read(size) == data[place : place + size]
            assert server.gets - before == gets
        before = server.gets
        file.seek(7)
        assert file.read() == data[7:]
        assert server.gets - before == 1
        assert file.read(3) == b""


def spotted() -> Any:
    """Ground with a few round spots, and where their middles are."""
    rng = np.random.default_rng(3)
    places = rng.uniform(200, SIDE_PX - 200, (12, 2))
    col, row = np.meshgrid(np.arange(SIDE_PX), np.arange(SIDE_PX))
    grey = np.full((SIDE_PX, SIDE_PX), 60.0)
    for x, y in places:
        near = np.s_[int(y) - 100 : int(y) + 100, int(x) - 100 : int(x) + 100]
        grey[near] += 150 * np.exp(-((col[near] - x) ** 2 + (row[near] - y) ** 2) / 2 / 25.0**2)
    return np.rint(grey + rng.normal(0, 3, grey.shape)).clip(0, 255).astype(np.uint8), places


def write_overviews(path: Path, picture: Any, below: bool = False) -> None:
    """Tiles, and the same picture at a half, a quarter and an eighth, as further pages or below its own."""
    small = [cv2.resize(picture, None, fx=1 / f, fy=1 / f, interpolation=cv2.INTER_AREA) for f in (2, 4, 8)]
    tiles: dict[str, Any] = {"tile": (TILE_PX, TILE_PX), "compression": "zlib", "metadata": None}
    with tifffile.TiffWriter(path) as file:
        file.write(picture, subifds=3 if below else 0, **tiles)
        for one in small:
            file.write(one, subfiletype=1, **tiles)


@parametrize_with_studies(("factor", "below"), [(3, False), (4, True), (5, False), (8, True), (20, False)], quick=(4,))
def test_a_scan_is_inspected_at_small_by_its_overviews(
    tmp_path: Path, server: RangeServer, factor: int, below: bool
) -> None:
    picture, places = spotted()
    write_overviews(tmp_path / "s.tif", picture, below)
    with open_scan(tmp_path / "s.tif") as local, open_scan(f"{server.url}/s.tif") as remote:
        opening = server.sent_bytes
        view, exact = remote.reduced(factor), local.reduced(factor)
        fetched = server.sent_bytes - opening
        assert np.array_equal(remote.samples(9, 9, 50, 50), local.samples(9, 9, 50, 50))
    assert view.shape == exact.shape
    assert np.abs(view - exact)[2:-2, 2:-2].max() < 6 + 0.3 * factor  # what is interpolated
    most = {3: 0.25, 4: 0.07, 5: 0.07, 8: 0.02, 20: 0.02}[factor]  # of the area, and so of what is stored
    assert fetched < 1.3 * most * SIDE_PX**2 + (1 << 17)
    with open_scan(f"{server.url}/s.tif") as remote:
        before = server.sent_bytes
        window = remote.reduced_window(factor, 5, 7, 12, 9)
        assert server.sent_bytes - before < 5 * TILE_PX**2  # of an overview
    np.testing.assert_allclose(window, view[7:16, 5:17], atol=2e-3)
    col, row = np.meshgrid(np.arange(view.shape[1]), np.arange(view.shape[0]))
    for place in (places - (factor - 1) / 2) / factor:
        near = np.hypot(col - place[0], row - place[1]) < 60 / factor
        weights = np.clip(view[near] - 70.0, 0, None)
        middle = np.array([np.average(axis[near], weights=weights) for axis in (col, row)])
        assert np.abs(middle - place).max() * factor < 0.1 * factor + 1.0


@pytest.mark.study
def test_a_thumbnail_of_another_form_is_no_overview(tmp_path: Path, server: RangeServer) -> None:
    picture, _ = spotted()
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        file.write(picture, tile=(TILE_PX, TILE_PX), metadata=None)
        file.write(picture[:300, :200].copy(), subfiletype=1, metadata=None)
        file.write(cv2.merge([picture[::4, ::4]] * 3), subfiletype=1, photometric="rgb", metadata=None)
    with open_scan(tmp_path / "s.tif") as local, open_scan(f"{server.url}/s.tif") as remote:
        np.testing.assert_array_equal(remote.reduced(4), local.reduced(4))


def test_a_picture_in_one_piece_is_fetched_whole_and_says_so(tmp_path: Path, server: RangeServer) -> None:
    tifffile.imwrite(tmp_path / "s.tif", noise(), compression="zlib", rowsperstrip=SIDE_PX)
    with open_scan(f"{server.url}/s.tif") as scan:
        scan.samples(10, 10, 20, 20)
        assert "fetched whole" in " ".join(scan.notes)
    with open_scan(tmp_path / "s.tif") as scan:
        assert not scan.notes


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("failures", [[403], [503, 500], [1.0]])
def test_what_fails_in_the_middle_is_requested_again(
    tmp_path: Path, server: RangeServer, failures: list[int | float]
) -> None:
    picture = noise()
    tifffile.imwrite(tmp_path / "s.tif", picture, **LAYOUTS["tiles"])
    with open_scan(f"{server.url}/s.tif") as scan:
        server.failures = list(failures)
        np.testing.assert_array_equal(scan.samples(300, 400, 20, 30)[..., 0], picture[400:430, 300:320])
        assert not scan.damage
    assert not server.failures


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("failure", "told"), [(403, "forbids to read it .403.*credentials"), (500, "cannot be reached"), (1.0, "0.3 s")]
)
def test_what_goes_on_failing_is_reported_and_is_no_damage(
    tmp_path: Path, server: RangeServer, failure: float, told: str
) -> None:
    tifffile.imwrite(tmp_path / "s.tif", noise(), **LAYOUTS["tiles"])
    with open_scan(f"{server.url}/s.tif") as scan:
        server.failures = [failure] * 3
        with pytest.raises(UnreachableError, match=rf"/s\.tif: .*{told}.*Tried 3 times"):
            scan.samples(300, 400, 20, 30)
        assert not scan.damage


@pytest.mark.usefixtures("quick")
def test_missing_forbidden_and_silent_addresses_and_servers_without_ranges(tmp_path: Path, server: RangeServer) -> None:
    with pytest.raises(MissingError, match=r"there is no http.*nowhere\.tif"):
        open_scan(f"{server.url}/nowhere.tif")
    with pytest.raises(UnreachableError, match="forbids"):
        open_scan(f"{server.url}/closed/s.tif")
    with pytest.raises(UnreachableError, match="cannot be reached"):
        open_scan("http://127.0.0.1:9/s.tif")
    tifffile.imwrite(tmp_path / "s.tif", noise(), **LAYOUTS["tiles"])
    server.by_ranges = False
    with pytest.raises(UnreachableError, match="no parts of files"):
        open_scan(f"{server.url}/s.tif")


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(MeasurementError, match=r"pip install 'reseau\[s3\]'"):
        open_scan("s3://prints/1.tif")
    with pytest.raises(MeasurementError, match=r"pip install 'reseau\[http\]'"):
        open_scan("https://example.org/1.tif")


def test_an_address_stays_one_through_a_pickle() -> None:
    address = scan_path("s3://prints/1952/0001.tif")
    again = pickle.loads(pickle.dumps(address))
    assert isinstance(again, Address)
    assert str(again) == "s3://prints/1952/0001.tif"
    assert (again.stem, again.suffix) == ("0001", ".tif")
    assert not isinstance(scan_path("prints/0001.tif"), Address)
