"""Scans by windows, blocks and reductions: each is a part of the whole, and no part of a file is decoded twice."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from stored_picture import HEIGHT, WIDTH, picture

from measure import Scan, open_scan
from measure.scans.parallel import map_in_threads
from measure.targets.block_search import Block, Octave, Patches, search_blocks


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
