"""Scans by windows: every way of storing one picture gives the same grey values, pitch and size."""

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest
import tifffile
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.scans.scan import open_scan
from measure.scans.segment_cache import SegmentCache
from measure.single_targets.block import Block
from measure.single_targets.block_search import search_blocks
from measure.single_targets.disk_patches import Patches

HEIGHT, WIDTH = 203, 317


def picture(dtype: type[np.unsignedinteger[Any]] = np.uint16, channels: int = 1) -> NDArray[Any]:
    """Smooth and detailed, over the whole range of its type, no two channels alike."""
    rows, cols = np.mgrid[0:HEIGHT, 0:WIDTH]
    planes = [
        0.5 + 0.4 * np.sin(cols / (9 + k)) * np.cos(rows / 13) + 0.1 * ((rows + cols + k) % 2) for k in range(channels)
    ]
    top = float(np.iinfo(dtype).max)
    values = np.stack(planes, -1) * top
    return np.asarray(np.clip(values, 0, top).astype(dtype)[..., 0 if channels == 1 else slice(None)])


def whole(path: Path) -> NDArray[np.float32]:
    with open_scan(path) as scan:
        return scan.window(0, 0, scan.width_px, scan.height_px)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("compression", [None, "lzw", "deflate", "zstd", "packbits"])
@pytest.mark.parametrize("layout", [{"tile": (64, 48)}, {"rowsperstrip": 7}, {"rowsperstrip": HEIGHT}])
def test_every_storage_gives_the_same_values(
    tmp_path: Path, dtype: type[np.unsignedinteger[Any]], compression: str | None, layout: dict[str, Any]
) -> None:
    truth = picture(dtype)
    path = tmp_path / "scan.tif"
    tifffile.imwrite(path, truth, compression=compression, photometric="minisblack", **layout)
    with open_scan(path) as scan:
        assert (scan.width_px, scan.height_px, scan.channels) == (WIDTH, HEIGHT, 1)
        assert scan.full_scale_dn == np.iinfo(dtype).max
        assert scan.name == "scan"
        window = scan.window(40, 50, 61, 73)
    assert window.dtype == np.float32
    np.testing.assert_array_equal(window, truth[50:123, 40:101])


@pytest.mark.parametrize("options", [{"bigtiff": True}, {"byteorder": ">"}, {"predictor": True, "compression": "lzw"}])
@pytest.mark.parametrize("tile", [None, (32, 32)])
def test_byte_order_bigtiff_and_predictor(
    tmp_path: Path, options: dict[str, Any], tile: tuple[int, int] | None
) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), photometric="minisblack", tile=tile, **options)
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())


@pytest.mark.parametrize("compression", ["lzw", "deflate", "zstd"])
@pytest.mark.parametrize(
    "options", [{"rowsperstrip": 1624, "byteorder": ">"}, {"rowsperstrip": 900}, {"tile": (1024, 2560)}]
)
def test_strips_and_tiles_of_megabytes(tmp_path: Path, compression: str, options: dict[str, Any]) -> None:
    """In one; in two, the last of them a shorter one; in two of which the last reaches beyond the picture."""
    truth = np.tile(picture(), (8, 8))
    tifffile.imwrite(tmp_path / "s.tif", truth, photometric="minisblack", compression=compression, **options)
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), truth)


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("tile", [None, (64, 64)])
def test_planes_kept_apart_or_together(tmp_path: Path, planar: str, tile: tuple[int, int] | None) -> None:
    truth = picture(channels=3)
    stored = truth if planar == "contig" else np.moveaxis(truth, -1, 0)
    tifffile.imwrite(tmp_path / "s.tif", stored, photometric="rgb", planarconfig=planar, tile=tile, compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        grey = scan.window(0, 0, WIDTH, HEIGHT)
        blue = scan.window(0, 0, WIDTH, HEIGHT, weights=(0, 0, 1))
    np.testing.assert_allclose(grey, truth @ [0.299, 0.587, 0.114], rtol=1e-5)
    np.testing.assert_array_equal(blue, truth[..., 2])


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("writer", ["tifffile", "libtiff"])
def test_jpeg_in_tiff(tmp_path: Path, channels: int, writer: str) -> None:
    smooth = cv2.GaussianBlur(picture(np.uint8, channels), (0, 0), 3)
    path = tmp_path / "s.tif"
    if writer == "tifffile":
        kind = "rgb" if channels == 3 else "minisblack"
        tifffile.imwrite(
            path, smooth, photometric=kind, tile=(64, 64), compression="jpeg", compressionargs={"level": 95}
        )
    else:
        PIL.Image.fromarray(smooth).save(path, compression="jpeg", quality=95)
    truth = smooth @ [0.299, 0.587, 0.114] if channels == 3 else smooth
    assert np.sqrt(np.mean((whole(path) - truth) ** 2)) < 1.0


@pytest.mark.parametrize("ending", [".png", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_files_of_another_writer(
    tmp_path: Path, ending: str, dtype: type[np.unsignedinteger[Any]], channels: int
) -> None:
    truth = picture(dtype, channels)
    cv2.imwrite(str(tmp_path / f"s{ending}"), truth[..., ::-1] if channels == 3 else truth)
    expected = truth @ [0.299, 0.587, 0.114] if channels == 3 else truth
    np.testing.assert_allclose(whole(tmp_path / f"s{ending}"), expected, rtol=1e-5)


def test_jpeg_file_is_read_whatever_its_name(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(picture(np.uint8), (0, 0), 3)
    cv2.imwrite(str(tmp_path / "s.jpg"), smooth)
    (tmp_path / "s.jpg").rename(tmp_path / "s.tif")
    assert np.abs(whole(tmp_path / "s.tif") - smooth).max() < 8


def test_trap_16_bit_squeezed_or_wrapped_to_8(tmp_path: Path) -> None:
    truth = np.full((40, 50), 256, np.uint16)
    truth[10, 20] = 40001
    for name in ("s.tif", "s.png"):
        cv2.imwrite(str(tmp_path / name), truth)
        with open_scan(tmp_path / name) as scan:
            assert scan.full_scale_dn == 65535.0
            np.testing.assert_array_equal(scan.window(0, 0, 50, 40), truth)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("options", [{}, {"compression": "lzw", "tile": (64, 64)}])
def test_trap_white_is_zero_ignored(
    tmp_path: Path, dtype: type[np.unsignedinteger[Any]], options: dict[str, Any]
) -> None:
    stored = picture(dtype)
    tifffile.imwrite(tmp_path / "s.tif", stored, photometric="miniswhite", **options)
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), float(np.iinfo(dtype).max) - stored)


def test_trap_palette_read_as_grey(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    colours = rng.integers(0, 65536, (3, 256), dtype=np.uint16)
    indices = picture(np.uint8)
    tifffile.imwrite(tmp_path / "s.tif", indices, photometric="palette", colormap=colours)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.channels == 3
        assert scan.full_scale_dn == 65535.0
        green = scan.window(0, 0, WIDTH, HEIGHT, weights=(0, 1, 0))
    np.testing.assert_array_equal(green, colours[1][indices])


def test_trap_palette_of_greys_in_reverse(tmp_path: Path) -> None:
    colours = np.repeat(np.arange(255, -1, -1, dtype=np.uint16)[None] * 257, 3, axis=0)
    tifffile.imwrite(tmp_path / "s.tif", picture(np.uint8), photometric="palette", colormap=colours)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.channels == 1
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), (255 - picture(np.uint8).astype(float)) * 257)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("extra", ["unassalpha", "assocalpha", "unspecified"])
def test_trap_alpha_taken_for_light(tmp_path: Path, channels: int, extra: str) -> None:
    truth = picture(np.uint8, channels)
    stored = np.dstack([truth, np.full((HEIGHT, WIDTH), 255, np.uint8)])
    kind = "rgb" if channels == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "s.tif", stored, photometric=kind, planarconfig="contig", extrasamples=[extra])
    expected = truth @ [0.299, 0.587, 0.114] if channels == 3 else truth
    np.testing.assert_allclose(whole(tmp_path / "s.tif"), expected, rtol=1e-5)


def test_trap_alpha_of_a_png(tmp_path: Path) -> None:
    truth = picture(np.uint8, 3)
    cv2.imwrite(str(tmp_path / "s.png"), np.dstack([truth[..., ::-1], np.full((HEIGHT, WIDTH), 9, np.uint8)]))
    np.testing.assert_allclose(whole(tmp_path / "s.png"), truth @ [0.299, 0.587, 0.114], rtol=1e-5)


@pytest.mark.parametrize(
    ("resolution", "unit", "pitch_um"),
    [
        ((1270, 1270), "INCH", (20.0, 20.0)),
        ((1270, 635), "INCH", (20.0, 40.0)),
        ((500, 500), "CENTIMETER", (20.0, 20.0)),
        ((50, 50), 4, (20.0, 20.0)),
        (((1, 20), (1, 20)), 5, (20.0, 20.0)),
        (((25400, 7), (25400, 7)), "INCH", (7.0, 7.0)),
    ],
)
def test_trap_odd_dpi_units(tmp_path: Path, resolution: Any, unit: Any, pitch_um: tuple[float, float]) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), resolution=resolution, resolutionunit=unit)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.pitch_um == pytest.approx(pitch_um, rel=1e-9)
        assert scan.pitch_note == ""


@pytest.mark.parametrize(
    ("resolution", "unit", "words"),
    [
        ((72, 72), "INCH", "72 dpi"),
        ((96, 96), "INCH", "96 dpi"),
        ((28.35, 28.35), "CENTIMETER", "72 dpi"),
        ((1270, 1270), "NONE", "no unit"),
        ((0, 0), "INCH", "0 x 0"),
        ((50800000, 50800000), "INCH", "finer than any scanner"),
    ],
)
def test_trap_default_dpi_believed(tmp_path: Path, resolution: Any, unit: str, words: str) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), resolution=resolution, resolutionunit=unit)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.pitch_um is None
        assert words in scan.pitch_note


def test_pitch_of_png_and_jpeg(tmp_path: Path) -> None:
    png = cv2.imencode(".png", picture(np.uint8))[1].tobytes()
    density = struct.pack(">4sIIB", b"pHYs", 50000, 40000, 1)
    chunk = struct.pack(">I", 9) + density + struct.pack(">I", zlib.crc32(density))
    (tmp_path / "s.png").write_bytes(png[:33] + chunk + png[33:])
    jpeg = bytearray(cv2.imencode(".jpg", picture(np.uint8))[1].tobytes())
    assert jpeg[6:10] == b"JFIF"
    jpeg[13:18] = struct.pack(">BHH", 2, 500, 400)
    (tmp_path / "s.jpg").write_bytes(bytes(jpeg))
    for name in ("s.png", "s.jpg"):
        with open_scan(tmp_path / name) as scan:
            assert scan.pitch_um == pytest.approx((20.0, 25.0))


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


def test_a_window_decodes_only_its_tiles_and_a_whole_pass_each_tile_once(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(32, 32), compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        reads: list[tuple[int, int]] = []
        segments = scan._segments
        original = segments.read

        class Counting:
            height_px, width_px = segments.height_px, segments.width_px
            segment_height_px, segment_width_px = segments.segment_height_px, segments.segment_width_px
            channels, full_scale_dn = segments.channels, segments.full_scale_dn
            sample_bytes, rounding_step_dn = segments.sample_bytes, segments.rounding_step_dn

            def read(self, row: int, column: int) -> Any:
                reads.append((row, column))
                return original(row, column)

            def close(self) -> None: ...

        scan._cache = scan._source = SegmentCache(Counting())
        scan.window(33, 34, 20, 40)
        assert reads == [(1, 1), (2, 1)]
        scan.window(40, 40, 5, 5)
        assert len(reads) == 2
        scan.reduced(5)
        assert len(reads) == len(set(reads)) == 7 * 10


def test_threads_that_read_a_file_side_by_side_see_what_one_sees(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(32, 32), compression="zstd")
    places = [(col, row) for row in range(0, HEIGHT, 9) for col in range(0, WIDTH, 11)]
    with open_scan(tmp_path / "s.tif") as scan:
        scan._cache._limit = 10 * 32 * 32 * 2  # ten tiles: they are decoded over and over
        windows = scan.each(lambda place: scan.window(*place, 40, 30), places)
    with open_scan(tmp_path / "s.tif") as scan:
        for window, place in zip(windows, places, strict=True):
            np.testing.assert_array_equal(window, scan.window(*place, 40, 30))


def test_a_damaged_tile_is_told_to_every_thread_that_wants_it(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(64, 64), compression="zlib")
    with tifffile.TiffFile(tmp_path / "s.tif") as file:
        offset = file.pages.first.dataoffsets[0]
    content = bytearray((tmp_path / "s.tif").read_bytes())
    content[offset : offset + 40] = bytes(40)
    (tmp_path / "s.tif").write_bytes(content)
    with open_scan(tmp_path / "s.tif") as scan:
        for _ in range(2):
            with pytest.raises(MeasurementError, match="damaged"):
                scan.each(lambda row: scan.window(0, row, 20, 20), range(4))


def test_a_window_of_the_reduced_scan_is_that_part_of_it(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(np.uint8, 3), tile=(64, 64), photometric="rgb")
    with open_scan(tmp_path / "s.tif") as scan:
        whole = scan.reduced(3)
        np.testing.assert_allclose(scan.reduced_window(3, 20, 11, 31, 27), whole[11:38, 20:51], rtol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_block_is_a_part_of_the_scan_and_of_its_reductions(tmp_path: Path, channels: int) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(np.uint16, channels), tile=(32, 48), compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        block = Block(scan, 12, 0, 12, scan.samples(12, 0, 72, 60))
        rows, cols = np.indices((40, 40)).reshape(2, 1, -1)
        for col0, row0 in ((20, 3), (31, 4)):
            grey = block.grey_at(np.array([[col0, row0]]), cols, rows)
            np.testing.assert_array_equal(grey.reshape(40, 40), scan.window(col0, row0, 40, 40))
        for factor, small in block.reductions({2, 3, 4}).items():
            row, col, height, width = 0, 12 // factor, 60 // factor, 72 // factor
            part = scan.reduced(factor)[row : row + height, col : col + width]
            rounding = 0.5 if factor % 2 == 0 else 0.0
            np.testing.assert_allclose(small, part, rtol=2e-6, atol=rounding)


class Watched:
    """An octave that finds nothing."""

    factor, margin_px, widest_px = 4, 8, 100

    def patches(self, small: NDArray[np.float32]) -> Patches:
        return Patches.of(())


@pytest.mark.parametrize("layout", [{"tile": (32, 48)}, {"rowsperstrip": 7}, {"rowsperstrip": HEIGHT}])
def test_a_search_by_blocks_decodes_each_segment_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: dict[str, Any]
) -> None:
    monkeypatch.setattr("measure.single_targets.block_search.BLOCK_BYTES", 40 * 100)
    monkeypatch.setattr("measure.single_targets.block_search.ROW_BYTES", 100)
    tifffile.imwrite(tmp_path / "s.tif", picture(), photometric="minisblack", compression="lzw", **layout)
    with open_scan(tmp_path / "s.tif") as scan:
        reads: list[tuple[int, ...]] = []
        original = scan._segments.read

        def read(*key: int) -> Any:
            reads.append(key)
            return original(*key)

        monkeypatch.setattr(scan._segments, "read", read)
        search_blocks(scan, [Watched()])
        tall, wide = scan.segment_px
        assert len(reads) == len(set(reads)) == -(-HEIGHT // tall) * -(-WIDTH // wide)


def test_the_cache_keeps_to_its_limit_and_holds_two_rows_of_tiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("measure.scans.segment_cache.CACHE_BYTES", 1)
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(32, 32), compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        np.testing.assert_array_equal(scan.window(0, 0, WIDTH, HEIGHT), picture())
        assert scan._cache._held <= 2 * 32 * WIDTH * 2
        kept = [own.samples for own in scan._cache._kept.values() if own.samples is not None]
        assert scan._cache._held == sum(samples.nbytes for samples in kept)


def test_a_missing_file_is_named_with_the_place_looked_for(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"no scan .*nowhere\.tif.*looked for.*check its name"):
        open_scan(tmp_path / "nowhere.tif")


def test_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "s.tif").write_bytes(b"")
    with pytest.raises(MeasurementError, match="empty"):
        open_scan(tmp_path / "s.tif")


def test_a_folder_is_no_scan(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="cannot be read"):
        open_scan(tmp_path)


def test_a_text_file_named_tif(tmp_path: Path) -> None:
    (tmp_path / "s.tif").write_text("These are my notes on the scans.")
    with pytest.raises(MeasurementError, match=r"s\.tif is no TIFF, JPEG or PNG.*These ar"):
        open_scan(tmp_path / "s.tif")


@pytest.mark.parametrize("kept", [0.02, 0.5, 0.95])
@pytest.mark.parametrize("options", [{"compression": "lzw", "tile": (64, 64)}, {"compression": "lzw"}, {}])
def test_a_truncated_tiff_is_found_when_it_is_opened(tmp_path: Path, kept: float, options: dict[str, Any]) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), **options)
    data = (tmp_path / "s.tif").read_bytes()
    (tmp_path / "s.tif").write_bytes(data[: int(kept * len(data))])
    with pytest.raises(MeasurementError, match=r"damaged or truncated.*copy it anew"):
        open_scan(tmp_path / "s.tif")


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_a_truncated_picture(tmp_path: Path, ending: str) -> None:
    cv2.imwrite(str(tmp_path / f"s{ending}"), picture(np.uint8))
    data = (tmp_path / f"s{ending}").read_bytes()
    (tmp_path / f"s{ending}").write_bytes(data[: len(data) // 2])
    with pytest.raises(MeasurementError, match="damaged or truncated"):
        open_scan(tmp_path / f"s{ending}")


def test_a_damaged_tile_is_said_at_the_window_that_needs_it(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(64, 64), compression="zstd")
    with tifffile.TiffFile(tmp_path / "s.tif") as file:
        offset, count = file.pages.first.dataoffsets[7], file.pages.first.databytecounts[7]
    data = bytearray((tmp_path / "s.tif").read_bytes())
    data[offset : offset + count] = bytes(count)
    (tmp_path / "s.tif").write_bytes(bytes(data))
    with open_scan(tmp_path / "s.tif") as scan:
        scan.window(0, 0, 64, 64)
        with pytest.raises(MeasurementError, match="tile or strip 7"):
            scan.window(70, 70, 64, 64)


@pytest.mark.parametrize(
    ("values", "options", "words"),
    [
        (np.zeros((9, 9), np.float32), {}, "floating-point"),
        (np.zeros((9, 9), np.int16), {}, "signed"),
        (np.zeros((9, 9), np.uint32), {}, "32 bits"),
        (np.zeros((9, 9), np.bool_), {}, "1 bits"),
        (np.zeros((9, 9, 4), np.uint8), {"photometric": "separated", "extrasamples": ()}, "SEPARATED"),
    ],
)
def test_unsupported_kinds_are_named(tmp_path: Path, values: Any, options: dict[str, Any], words: str) -> None:
    tifffile.imwrite(tmp_path / "s.tif", values, **options)
    with pytest.raises(MeasurementError, match=rf"kind that is not read \(.*{words}.*save it as grey or RGB"):
        open_scan(tmp_path / "s.tif")


def test_the_first_full_picture_of_several_is_taken(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        file.write(picture()[::4, ::4], subfiletype=1)
        file.write(picture(), metadata=None)
        file.write(np.zeros_like(picture()), metadata=None)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.notes == ("the file holds 2 pictures: the first was taken",)
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())


def test_the_orientation_tag_is_said_and_not_applied(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), extratags=[(274, 3, 1, 6, True)])
    with open_scan(tmp_path / "s.tif") as scan:
        assert "orientation tag (6) is not applied" in scan.notes[0]
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())


def test_a_jpeg_says_its_orientation_too(tmp_path: Path) -> None:
    grey = (picture() >> 8).astype(np.uint8)
    exif = PIL.Image.Exif()
    exif[274] = 8
    PIL.Image.fromarray(grey).save(tmp_path / "s.jpg", exif=exif)
    with open_scan(tmp_path / "s.jpg") as scan:
        assert (scan.height_px, scan.width_px) == grey.shape
        assert "orientation tag (8) is not applied" in scan.notes[0]


def test_twelve_bits_have_their_own_full_scale(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture() >> 4, bitspersample=12, photometric="miniswhite")
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.full_scale_dn == 4095.0
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), 4095.0 - (picture() >> 4))
