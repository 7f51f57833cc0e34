"""Scans by head, windows, blocks and reductions, and work shared among threads: no part of a file is decoded twice."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from drawn import make_scan
from stored_picture import HEIGHT, WIDTH, picture

from measure import MeasurementError, Scan
from measure.scans import jpeg
from measure.scans.opening import open_scan, read_head
from measure.scans.parallel import map_in_threads, map_or_replace
from measure.targets.block_search import Block, Octave, Patches, search_blocks
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


def test_a_window_decodes_only_its_tiles_and_a_whole_pass_each_tile_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_the_cache_keeps_to_its_limit_and_holds_two_rows_of_tiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        block = Block(scan, (12, 0), 12, scan.samples(12, 0, 72, 60))
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
def test_a_search_by_blocks_decodes_each_segment_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: dict[str, Any]
) -> None:
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
def test_the_head_says_what_the_opened_scan_does(
    name: str, picture: np.ndarray, tags: dict[str, object], tmp_path: Path
) -> None:
    path = written(tmp_path / name, picture, **tags)
    head = read_head(path)
    with open_scan(path) as scan:
        assert (head.width_px, head.height_px, head.channels) == (scan.width_px, scan.height_px, scan.channels)
        assert 2**head.bits - 1 == scan.full_scale_dn
        assert (head.pitch.um, head.pitch.note) == (scan.pitch_um, scan.pitch_note)
    assert head.file_format == {".tif": "TIFF", ".jpg": "JPEG", ".png": "PNG"}[path.suffix]


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
        with pytest.raises(MeasurementError, match=r"damaged or truncated|no TIFF, JPEG, JPEG 2000 or PNG"):
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
