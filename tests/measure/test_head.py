"""What a scan's head says, held against the scan as it is opened and decoded."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from measure import MeasurementError
from measure.scans import jpeg
from measure.scans.opening import open_scan, read_head

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
