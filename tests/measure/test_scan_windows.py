"""Scans by head, windows, blocks and reductions, and work shared among threads: no part of a file is decoded twice."""

import pickle
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from damaged_files import HEIGHT, WIDTH, picture
from drawn import make_scan
from range_server import RangeServer, range_server
from studies import parametrize_with_studies

from measure import MeasurementError, Scan
from measure.errors import MissingError, UnreachableError
from measure.scans import jpeg, remote
from measure.scans.opening import crop_scan, declared_tone, open_scan, read_head
from measure.scans.parallel import map_in_threads, map_or_replace
from measure.scans.remote import Address, scan_path
from measure.targets.block_search import Octave, Patches, ScanBlock, search_blocks
from measure.targets.detection import DiskSearch, disk_candidates


def test_parts_outside_of_the_scan_repeat_its_edge(tmp_path: Path) -> None:
    truth = picture()
    tifffile.imwrite(tmp_path / "s.tif", truth, tile=(64, 64))
    padded = np.pad(truth, 30, mode="edge")
    with open_scan(tmp_path / "s.tif") as scan:
        np.testing.assert_array_equal(scan.window(-30, -30, WIDTH + 60, HEIGHT + 60), padded)
        np.testing.assert_array_equal(scan.window(WIDTH + 9, -20, 5, 4), np.full((4, 5), truth[0, -1]))
        np.testing.assert_array_equal(scan.window(-9, 100, 12, 3)[:, 9:], truth[100:103, 0:3])


@pytest.mark.parametrize("factor", [1, 3, 8])
@pytest.mark.parametrize("tile", [None, (64, 48)])
def test_reduced_is_the_mean_of_its_pixels(tmp_path: Path, factor: int, tile: tuple[int, int] | None) -> None:
    truth = picture()
    tifffile.imwrite(tmp_path / "s.tif", truth, tile=tile, compression="zstd")
    height, width = HEIGHT // factor, WIDTH // factor
    blocks = truth[: height * factor, : width * factor].reshape(height, factor, width, factor).astype(float)
    with open_scan(tmp_path / "s.tif") as scan:
        np.testing.assert_allclose(scan.reduced(factor), blocks.mean(axis=(1, 3)), rtol=2e-6)


def recorded_reads(scan: Scan, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The segments, by row and column, that are decoded from now on."""
    reads, original = list[tuple[int, int]](), scan._segments.read

    def read(row: int, column: int, stored: Sequence[bytes] = ()) -> Any:
        reads.append((row, column))
        return original(row, column, stored)

    monkeypatch.setattr(scan._segments, "read", read)
    return reads


def test_a_window_decodes_its_tiles_and_a_pass_each_tile_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(32, 32), compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        reads = recorded_reads(scan, monkeypatch)
        scan.window(33, 34, 20, 40)
        assert reads == [(1, 1), (2, 1)]
        scan.window(40, 40, 5, 5)
        assert len(reads) == 2
        scan.reduced(5)
        assert len(reads) == len(set(reads)) == 7 * 10


@pytest.fixture
def four_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(4)
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("four_threads")
def test_threads_that_read_a_file_side_by_side_see_what_one_sees(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(32, 32), compression="zstd")
    places = [(col, row) for row in range(0, HEIGHT, 9) for col in range(0, WIDTH, 11)]
    with open_scan(tmp_path / "s.tif") as scan:
        scan._cache._limit = 10 * 32 * 32 * 2  # ten tiles: they are decoded over and over
        windows = map_in_threads(lambda place: scan.window(*place, 40, 30), places)
    with open_scan(tmp_path / "s.tif") as scan:
        for window, place in zip(windows, places, strict=True):
            np.testing.assert_array_equal(window, scan.window(*place, 40, 30))


def test_the_cache_holds_two_rows_of_tiles_and_keeps_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("measure.scans.cache.CACHE_BYTES", 1)
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(32, 32), compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        np.testing.assert_array_equal(scan.window(0, 0, WIDTH, HEIGHT), picture())
        assert scan._cache._held <= 2 * 32 * WIDTH * 2
        kept = [own.samples for own in scan._cache._kept.values() if own.samples is not None]
        assert scan._cache._held == sum(samples.nbytes for samples in kept)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_block_is_a_part_of_the_scan_and_of_its_reductions(tmp_path: Path, channels: int) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(np.uint16, channels), tile=(32, 48), compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        block = ScanBlock(scan, (12, 0), 12, scan.samples(12, 0, 72, 60))
        rows, cols = np.indices((40, 40)).reshape(2, 1, -1)
        for col0, row0 in ((20, 3), (31, 4)):
            grey = block.grey_values(np.array([[col0, row0]]), cols, rows)
            np.testing.assert_array_equal(grey.reshape(40, 40), scan.window(col0, row0, 40, 40))
        for factor, small in block.reductions({2, 3, 4}).items():
            row, col, height, width = 0, 12 // factor, 60 // factor, 72 // factor
            part = scan.reduced(factor)[row : row + height, col : col + width]
            rounding = 0.5 if factor % 2 == 0 else 0.0
            np.testing.assert_allclose(small, part, rtol=2e-6, atol=rounding)


@pytest.mark.parametrize("layout", [{"tile": (32, 48)}, {"rowsperstrip": 7}, {"rowsperstrip": HEIGHT}])
def test_blocks_decode_segments_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: dict[str, Any]) -> None:
    monkeypatch.setattr("measure.targets.block_search.BLOCK_BYTES", 40 * 100)
    monkeypatch.setattr("measure.targets.block_search.ROW_BYTES", 100)
    tifffile.imwrite(tmp_path / "s.tif", picture(), photometric="minisblack", compression="lzw", **layout)
    with open_scan(tmp_path / "s.tif") as scan:
        reads = recorded_reads(scan, monkeypatch)
        search_blocks(scan, [Octave(4, 2, lambda _: Patches.collect(()))])
        tall, wide = scan.segment_px
        assert len(reads) == len(set(reads)) == -(-HEIGHT // tall) * -(-WIDTH // wide)


GREY = np.random.default_rng(5).integers(0, 255, (60, 90)).astype(np.uint8)
COLOUR = np.stack([GREY, 255 - GREY, GREY // 2], axis=-1)
WIDE = GREY.astype(np.uint16) * 257
GREYS = np.tile(np.arange(256, dtype=np.uint16) * 257, (3, 1))


def written(path: Path, picture: np.ndarray, **tags: Any) -> Path:
    if path.suffix == ".tif":
        tifffile.imwrite(path, picture, **tags)
    else:
        cv2.imwrite(str(path), picture)
    return path


@pytest.mark.parametrize(
    ("name", "picture", "tags"),
    [
        ("grey.tif", GREY, {"resolution": (500, 500), "resolutionunit": "CENTIMETER"}),
        ("tiled.tif", WIDE, {"tile": (32, 32), "compression": "deflate"}),
        ("colour.tif", COLOUR, {"photometric": "rgb"}),
        ("palette.tif", GREY, {"photometric": "palette", "colormap": GREYS}),
        ("grey.jpg", GREY, {}),
        ("colour.jpg", COLOUR, {}),
        ("grey.png", GREY, {}),
        ("wide.png", WIDE, {}),
        ("colour.png", COLOUR, {}),
        ("clear.png", np.dstack([COLOUR, GREY]), {}),
    ],
)
def test_the_head_agrees_with_the_scan(name: str, picture: np.ndarray, tags: dict[str, object], tmp_path: Path) -> None:
    path = written(tmp_path / name, picture, **tags)
    head = read_head(path)
    with open_scan(path) as scan:
        assert (head.width_px, head.height_px, head.channels) == (scan.width_px, scan.height_px, scan.channels)
        assert head.bits == (8 if picture.dtype == np.uint8 else 16)
        assert (head.pitch.um, head.pitch.note) == (scan.pitch_um, scan.pitch_note)
    assert head.file_format == {".tif": "TIFF", ".jpg": "JPEG", ".png": "PNG"}[path.suffix]


def test_a_window_of_a_scan_keeps_its_weights_and_knows_its_place(tmp_path: Path) -> None:
    with open_scan(written(tmp_path / "colour.tif", COLOUR, photometric="rgb")) as scan:
        view = crop_scan(crop_scan(scan.green_channel(), (10, 7, 60, 40)), (5, 3, 20, 30))
        np.testing.assert_array_equal(view.window(0, 0, 20, 30), COLOUR[10:40, 15:35, 1])
        assert view.origin_px == (15, 10)
        with pytest.raises(ValueError, match="cannot be reduced by 0"):
            view.reduced(0)


def test_no_picture_is_decoded_for_its_head(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(jpeg, "decode_checked", refuse)
    assert read_head(written(tmp_path / "a.jpg", GREY)).width_px == 90


@pytest.mark.parametrize("name", ["a.tif", "a.jpg", "a.png"])
def test_a_file_that_is_cut_short_is_known_by_its_head_and_its_end(name: str, tmp_path: Path) -> None:
    path = written(tmp_path / name, GREY)
    data = path.read_bytes()
    for length in (len(data) - 200, 30, 3):
        path.write_bytes(data[:length])
        with pytest.raises(MeasurementError, match=r"damaged or truncated|no TIFF, JPEG, JPEG 2000, PNG, BMP"):
            read_head(path)
    path.write_bytes(b"")
    with pytest.raises(MeasurementError, match="is empty"):
        read_head(path)


def test_what_stands_behind_a_jpeg_picture_does_not_make_it_broken(tmp_path: Path) -> None:
    path = written(tmp_path / "a.jpg", GREY)
    path.write_bytes(path.read_bytes() + bytes(1 << 17))
    assert read_head(path).width_px == 90


@pytest.fixture(autouse=True)
def _threads_as_before() -> Iterator[None]:
    threads = cv2.getNumThreads()
    yield
    cv2.setNumThreads(threads)


@pytest.mark.parametrize("threads", [1, 3])
def test_every_item_is_worked_on_in_its_order_while_opencvs_threads_rest(threads: int) -> None:
    """All threads are at work at once: each waits for the others."""
    cv2.setNumThreads(threads)
    all_there = threading.Barrier(threads)

    def view(item: int) -> tuple[int, int, int]:
        all_there.wait(60.0)
        return item, threading.get_ident(), cv2.getNumThreads()

    found = map_in_threads(view, range(6))
    assert [item for item, _, _ in found] == list(range(6))
    assert len({thread for _, thread, _ in found}) == threads
    assert {own for _, _, own in found} == {1}
    assert cv2.getNumThreads() == threads


def test_any_number_of_threads_finds_the_same_disks() -> None:
    rng = np.random.default_rng(1)
    grey = rng.normal(20000.0, 300.0, (700, 900)).astype(np.float32)
    places = [(col, row) for row in range(60, 700, 120) for col in range(60, 900, 120)]
    for place in places:
        cv2.circle(grey, place, 8, 40000.0, -1)
    picture = np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), float)
    found = []
    for threads in (1, 3):
        cv2.setNumThreads(threads)
        scan = make_scan(picture)
        found.append(disk_candidates(scan, DiskSearch((10.0, 24.0), "light", 0.2)))
    one, other = (np.array([disk.center_px for disk in disks]) for disks in found)
    assert len(one) == len(places)
    np.testing.assert_array_equal(one, other)


class EndedOver(ThreadPoolExecutor):
    """Workers that are ended over one item, in whichever part it comes."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if 5 in args[1]:
            raise BrokenExecutor("its process was ended")
        return super().submit(fn, *args, **kwargs)


@pytest.mark.parametrize("chunk", [1, 4])
def test_an_item_that_its_worker_is_ended_over_costs_none_of_the_others(chunk: int) -> None:
    def lost(item: int, why: str) -> str:
        return f"{item}: {why}"

    with EndedOver(2) as workers:
        found = list(map_or_replace(workers, str, range(9), lost, chunk))
    assert found == ["0", "1", "2", "3", "4", "5: its process was ended", "6", "7", "8"]


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


def test_bytes_are_fetched_by_blocks_and_once_large_reads_in_one_request(tmp_path: Path, server: RangeServer) -> None:
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
def test_overviews_show_a_scan_at_small(tmp_path: Path, server: RangeServer, factor: int, below: bool) -> None:
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
def test_what_fails_midway_is_requested_again(tmp_path: Path, server: RangeServer, failures: list[int | float]) -> None:
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
def test_what_goes_on_failing_is_no_damage(tmp_path: Path, server: RangeServer, failure: float, told: str) -> None:
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
