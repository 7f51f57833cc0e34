"""Files that are no scan, or a damaged one, or of a kind that is not read: each is told by name, with what to do."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from stored_picture import picture

from measure.errors import MeasurementError
from measure.scans.scan import open_scan


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
