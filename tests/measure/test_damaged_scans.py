"""Files that are no scan, or a damaged one, or of a kind that is not read: each is told by name, with what to do."""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from stored_picture import HEIGHT, WIDTH, picture

from measure import MeasurementError, open_scan
from measure.scans.parallel import map_in_threads


def set_tag(path: Path, tag: int, value: Any) -> None:
    with tifffile.TiffFile(path, mode="r+") as file:
        page = file.pages.first
        if tag in page.tags:
            kind = "s" if isinstance(value, str | bytes) else 3 if tag not in (256, 257, 278, 282) else 4
            page.tags[tag].overwrite(value, dtype=kind)


def zeros_png(side: int) -> bytes:
    """Of a picture of 8 bits that holds nothing but zeros."""
    rows = zlib.compress(bytes(1000))
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b"")]
    parts = [
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, r"no scan .*s\.tif.*searched at.*check its name"),
        (lambda path: path.write_bytes(b""), "empty"),
        (lambda path: path.mkdir(), "cannot be read"),
        (lambda path: path.symlink_to(path), "cannot be read"),
        (
            lambda path: path.write_text("These are my notes on the scans."),
            r"s\.tif is no TIFF, JPEG, JPEG 2000 or PNG.*These ar",
        ),
        (os.mkfifo, "no regular file, but a pipe or a device"),
    ],
    ids=["missing", "empty", "folder", "link to itself", "text", "pipe"],
)
def test_what_is_no_scan_is_named(make: Callable[[Path], object], words: str, tmp_path: Path) -> None:
    make(tmp_path / "s.tif")
    with pytest.raises(MeasurementError, match=words):
        open_scan(tmp_path / "s.tif")


@pytest.mark.parametrize("kept", [0.02, 0.5, 0.95])
@pytest.mark.parametrize("options", [{"compression": "lzw", "tile": (64, 64)}, {"compression": "lzw"}, {}])
def test_a_truncated_tiff_is_found_when_it_is_opened(tmp_path: Path, kept: float, options: dict[str, Any]) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), **options)
    data = (tmp_path / "s.tif").read_bytes()
    (tmp_path / "s.tif").write_bytes(data[: int(kept * len(data))])
    with pytest.raises(MeasurementError, match=r"damaged or truncated.*copy it again"):
        open_scan(tmp_path / "s.tif")


@pytest.mark.parametrize("compression", ["zstd", "zlib", "lzw", "packbits"])
def test_a_damaged_tile_is_unknown_and_costs_none_of_the_others(tmp_path: Path, compression: str) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=(64, 64), compression=compression)
    with tifffile.TiffFile(tmp_path / "s.tif") as file:
        offset, count = file.pages.first.dataoffsets[7], file.pages.first.databytecounts[7]
    data = bytearray((tmp_path / "s.tif").read_bytes())
    data[offset : offset + count // 2] = bytes(count // 2)
    (tmp_path / "s.tif").write_bytes(bytes(data))
    with open_scan(tmp_path / "s.tif") as scan:
        for _ in range(2):
            view = map_in_threads(lambda row: scan.window(0, row, WIDTH, 1)[0], range(HEIGHT))
            known = scan.inside(0, 0, WIDTH, HEIGHT)
        assert "tile 7" in scan.damage
        assert "tile 7" in scan.loss_reason(120, 120, 10, 10)
        assert scan.loss_reason(0, 0, 64, 200) == ""
    lost = np.zeros((HEIGHT, WIDTH), bool)
    lost[64:128, 128:192] = True
    np.testing.assert_array_equal(known, ~lost)
    np.testing.assert_array_equal(np.stack(view)[known], picture()[known])


@pytest.mark.parametrize("compression", [None, "lzw", "zlib", "zstd", "packbits"])
@pytest.mark.parametrize("predictor", [False, True])
def test_a_padded_last_strip_is_valid(tmp_path: Path, compression: str | None, predictor: bool) -> None:
    """It holds as many rows as the others, though the picture ends before (TIFF 6.0 asks for fewer, writers pad)."""
    padded = np.pad(picture(), ((0, 5), (0, 0)))
    predictor = predictor and compression is not None
    tifffile.imwrite(
        tmp_path / "s.tif", padded, rowsperstrip=len(padded) // 4, compression=compression, predictor=predictor
    )
    set_tag(tmp_path / "s.tif", 257, HEIGHT)
    with open_scan(tmp_path / "s.tif") as scan:
        np.testing.assert_array_equal(scan.window(0, 0, WIDTH, HEIGHT), picture())
        assert scan.damage == ""


@pytest.mark.parametrize(
    ("tag", "value", "words"),
    [
        (256, 0, "ImageWidth is 0"),
        (256, (200, 317), "ImageWidth holds 2 numbers, not one"),
        (256, "317", "ImageWidth is no whole number"),
        (262, (1, 1), "PhotometricInterpretation holds 2 numbers"),
        (277, 0, "SamplesPerPixel is 0"),
        (278, 0, "RowsPerStrip is 0"),
        (322, 0, "TileWidth is 0"),
        (323, 0, "TileLength is 0"),
        (258, 3, "hold 128702 bytes, and should 24157"),
        (259, 77, "compression 77"),
        (256, 318, "hold 128702 bytes, and should 129108"),
        (317, 9, "predictor 9"),
    ],
)
def test_tags_of_another_count_type_or_value(tmp_path: Path, tag: int, value: Any, words: str) -> None:
    tile = (64, 64) if tag in (322, 323) else None
    compression = "lzw" if tag == 317 else None
    tifffile.imwrite(tmp_path / "s.tif", picture(), tile=tile, predictor=tag == 317, compression=compression)
    set_tag(tmp_path / "s.tif", tag, value)
    with pytest.raises(MeasurementError, match=rf"s\.tif .*({words})"):
        open_scan(tmp_path / "s.tif")


@pytest.mark.parametrize(("tag", "value"), [(282, (20, 40)), (282, "300 dpi"), (296, "inch"), (283, b"")])
def test_a_resolution_that_is_none_is_no_pitch(tmp_path: Path, tag: int, value: Any) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), resolution=(1270, 1270), resolutionunit="INCH")
    set_tag(tmp_path / "s.tif", tag, value)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.pitch_um is None
        assert scan.pitch_note
        np.testing.assert_array_equal(scan.window(0, 0, WIDTH, HEIGHT), picture())


def test_a_directory_that_leads_back_to_itself(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture())
    data = bytearray((tmp_path / "s.tif").read_bytes())
    first = int.from_bytes(data[4:8], "little")
    following = first + 2 + 12 * int.from_bytes(data[first : first + 2], "little")
    data[following : following + 4] = data[4:8]
    (tmp_path / "s.tif").write_bytes(data)
    with pytest.raises(MeasurementError, match="leads back to itself"):
        open_scan(tmp_path / "s.tif")


def test_a_picture_that_claims_more_than_its_file_can_hold(tmp_path: Path) -> None:
    """Nothing is allocated for it: a decoder would take 4 GB for the first, and more than there is for the second."""
    jpeg = bytearray(cv2.imencode(".jpg", picture(np.uint8))[1].tobytes()[:380])
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = (65000).to_bytes(2, "big") * 2
    (tmp_path / "s.jpg").write_bytes(bytes(jpeg) + b"\xff\xd9")
    tifffile.imwrite(tmp_path / "s.tif", np.zeros((4, 4), np.uint8), compression="zstd")
    for tag in (256, 257, 278):
        set_tag(tmp_path / "s.tif", tag, 10**9)
    (tmp_path / "s.png").write_bytes(zeros_png(40_000))
    for name, size in (("s.jpg", "65000 x 65000"), ("s.tif", "1000000000 x 1000000000"), ("s.png", "40000 x 40000")):
        with pytest.raises(MeasurementError, match=rf"claims a picture of {size} pixels .*--max-pixels \d+"):
            open_scan(tmp_path / name)


def test_a_strip_of_zstd_that_decodes_to_gigabytes(tmp_path: Path) -> None:
    side = 12_000
    tifffile.imwrite(tmp_path / "s.tif", np.zeros((side, side), np.uint8), compression="zstd", rowsperstrip=side)
    assert (tmp_path / "s.tif").stat().st_size < 50_000
    with pytest.raises(MeasurementError, match="--max-pixels 144000000"):
        open_scan(tmp_path / "s.tif")
    with open_scan(tmp_path / "s.tif", max_pixels=side**2) as scan:
        assert not scan.window(0, 0, 9, 9).any()
    with pytest.raises(MeasurementError, match="--max-pixels allows 1000"):
        open_scan(tmp_path / "s.tif", max_pixels=1000)


def test_a_jpeg_that_decodes_to_nothing_is_unknown(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", picture(np.uint8))[1].tobytes()
    tables = data.index(b"\xff\xc4")
    (tmp_path / "s.jpg").write_bytes(data[: data.index(b"\xff\xda")] + b"\xff\xd9")
    with open_scan(tmp_path / "s.jpg") as scan:
        assert "nothing of it can be trusted" in scan.damage
        assert not scan.inside(0, 0, WIDTH, HEIGHT).any()
    (tmp_path / "s.jpg").write_bytes(data[:2] + data[tables : tables + 30] + b"\xff\xd9")
    with pytest.raises(MeasurementError, match="damaged or truncated"):
        open_scan(tmp_path / "s.jpg")


@pytest.mark.parametrize(
    ("values", "options", "words"),
    [
        (np.zeros((9, 9), np.complex64), {}, "numbers of 64 bits"),
        (np.zeros((9, 9), np.int32), {}, "signed integers of 32 bits"),
        (np.zeros((9, 9), np.uint32), {}, "32 bits"),
        (np.zeros((9, 9), np.bool_), {}, "1 bits"),
        (
            np.zeros((9, 9, 4), np.uint8),
            {"photometric": "separated", "extrasamples": (), "extratags": [(332, 3, 1, 2, True)]},  # of other inks
            "SEPARATED",
        ),
    ],
)
def test_unsupported_kinds_are_named(tmp_path: Path, values: Any, options: dict[str, Any], words: str) -> None:
    tifffile.imwrite(tmp_path / "s.tif", values, **options)
    with pytest.raises(MeasurementError, match=rf"kind that is not read \(.*{words}.*save it as grey or RGB"):
        open_scan(tmp_path / "s.tif")
