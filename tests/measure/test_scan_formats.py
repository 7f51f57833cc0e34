"""Scan files of every kind: each way of storing one picture gives the same grey values, pitch and size."""

import os
import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import PIL.Image
import pytest
import tifffile
from damaged_files import HEIGHT, WIDTH, picture, whole
from numpy.typing import NDArray

from measure import MeasurementError, open_scan
from measure.scans.opening import crop_scan, declared_tone, read_head
from measure.scans.parallel import map_in_threads


def luminance(picture: NDArray[Any]) -> NDArray[Any]:
    return picture @ np.array([0.299, 0.587, 0.114]) if picture.ndim == 3 else picture


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("compression", [None, "lzw", "deflate", "zstd", "packbits"])
@pytest.mark.parametrize("layout", [{"tile": (64, 48)}, {"rowsperstrip": 7}, {"rowsperstrip": HEIGHT}])
@pytest.mark.parametrize("options", [{}, {"bigtiff": True, "byteorder": ">"}, {"predictor": True}])
def test_every_storage_gives_the_same_values(
    tmp_path: Path,
    dtype: type[np.unsignedinteger[Any]],
    compression: str | None,
    layout: dict[str, Any],
    options: dict[str, Any],
) -> None:
    truth = picture(dtype)
    path = tmp_path / "scan.tif"
    if compression in (None, "packbits"):
        options = options | {"predictor": False}
    tifffile.imwrite(path, truth, compression=compression, photometric="minisblack", **layout, **options)
    with open_scan(path) as scan:
        assert (scan.width_px, scan.height_px, scan.channels) == (WIDTH, HEIGHT, 1)
        assert scan.full_scale_dn == np.iinfo(dtype).max
        assert scan.name == "scan"
        window = scan.window(40, 50, 61, 73)
    assert window.dtype == np.float32
    np.testing.assert_array_equal(window, truth[50:123, 40:101])


@pytest.mark.parametrize(
    ("compression", "options"),
    [
        ("lzw", {"rowsperstrip": 1624, "byteorder": ">"}),
        ("deflate", {"rowsperstrip": 900}),
        ("zstd", {"tile": (1024, 2560)}),
    ],
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
    np.testing.assert_allclose(grey, luminance(truth), rtol=1e-5)
    np.testing.assert_array_equal(blue, truth[..., 2])


@pytest.mark.parametrize("ending", [".png", ".tif"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_files_of_others(tmp_path: Path, ending: str, dtype: type[np.unsignedinteger[Any]], channels: int) -> None:
    truth = picture(dtype, channels)
    cv2.imwrite(str(tmp_path / f"s{ending}"), truth[..., ::-1] if channels == 3 else truth)
    np.testing.assert_allclose(whole(tmp_path / f"s{ending}"), luminance(truth), rtol=1e-5)


def test_jpeg_file_is_read_whatever_its_name(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(picture(np.uint8), (0, 0), 3)
    cv2.imwrite(str(tmp_path / "s.jpg"), smooth)
    (tmp_path / "s.jpg").rename(tmp_path / "s.tif")
    assert np.abs(whole(tmp_path / "s.tif") - smooth).max() < 8


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("options", [{}, {"compression": "lzw", "tile": (64, 64)}])
def test_white_is_zero_ignored(tmp_path: Path, dtype: type[np.unsignedinteger[Any]], options: dict[str, Any]) -> None:
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
    greys = np.repeat(np.arange(255, -1, -1, dtype=np.uint16)[None] * 257, 3, axis=0)
    tifffile.imwrite(tmp_path / "s.tif", indices, photometric="palette", colormap=greys)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.channels == 1
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), (255.0 - indices) * 257)


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_equal_channels_are_one(tmp_path: Path, ending: str) -> None:
    """A picture with one blue pixel of another grey value has three."""
    grey = picture(np.uint8)
    (tmp_path / f"s{ending}").write_bytes(cv2.imencode(ending, np.dstack([grey] * 3))[1].tobytes())
    expected = np.asarray(PIL.Image.open(tmp_path / f"s{ending}"))[..., 1]
    with open_scan(tmp_path / f"s{ending}") as scan:
        assert scan.channels == 1
        np.testing.assert_array_equal(scan.window(0, 0, WIDTH, HEIGHT), expected)
    spotted = np.dstack([grey] * 3)
    spotted[-1, -1, 0] ^= 255
    cv2.imwrite(str(tmp_path / "spotted.png"), spotted)
    with open_scan(tmp_path / "spotted.png") as scan:
        assert scan.channels == 3


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("extra", ["unassalpha", "assocalpha", "unspecified", "png"])
def test_trap_alpha_taken_for_light(tmp_path: Path, channels: int, extra: str) -> None:
    truth = picture(np.uint8, channels)
    stored = np.dstack([truth, np.full((HEIGHT, WIDTH), 9, np.uint8)])
    if extra == "png":
        (tmp_path / "s.tif").write_bytes(imagecodecs.png_encode(stored))
    else:
        kind = "rgb" if channels == 3 else "minisblack"
        tifffile.imwrite(tmp_path / "s.tif", stored, photometric=kind, planarconfig="contig", extrasamples=[extra])
    np.testing.assert_allclose(whole(tmp_path / "s.tif"), luminance(truth), rtol=1e-5)


@pytest.mark.parametrize(
    ("resolution", "unit", "pitch_um", "words"),
    [
        ((1270, 1270), "INCH", (20.0, 20.0), ""),
        ((1270, 635), "INCH", (20.0, 40.0), ""),
        ((500, 500), "CENTIMETER", (20.0, 20.0), ""),
        ((50, 50), 4, (20.0, 20.0), ""),
        (((1, 20), (1, 20)), 5, (20.0, 20.0), ""),
        (((25400, 7), (25400, 7)), "INCH", (7.0, 7.0), ""),
        ((72, 72), "INCH", None, "72 dpi"),
        ((96, 96), "INCH", None, "96 dpi"),
        ((28.35, 28.35), "CENTIMETER", None, "72 dpi"),
        ((1270, 1270), "NONE", None, "no unit"),
        ((0, 0), "INCH", None, "0 x 0"),
        ((50800000, 50800000), "INCH", None, "finer than any scanner"),
    ],
)
def test_traps_odd_dpi_units_and_default_dpi_believed(
    tmp_path: Path, resolution: Any, unit: Any, pitch_um: tuple[float, float] | None, words: str
) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), resolution=resolution, resolutionunit=unit)
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.pitch_um == (pitch_um and pytest.approx(pitch_um, rel=1e-9))
        assert words in scan.pitch_note
        assert bool(scan.pitch_note) == bool(words)


def test_trap_black_and_white_png(tmp_path: Path) -> None:
    black_and_white = 255 * (picture(np.uint8) > 127).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "s.png"), black_and_white, [cv2.IMWRITE_PNG_BILEVEL, 1])
    with pytest.raises(MeasurementError, match="black and white pixels only"):
        whole(tmp_path / "s.png")
    for name, values in {
        "two.tif": black_and_white,
        "many.tif": picture(np.uint8),
        "one.tif": 0 * black_and_white,
    }.items():
        tifffile.imwrite(tmp_path / name, values)
        with open_scan(tmp_path / name) as scan:
            assert scan.is_two_valued == (name == "two.tif")


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


def test_of_several_full_pictures_the_first_is_taken_and_the_others_need_attention(tmp_path: Path) -> None:
    """Those of reduced size and masks do not count, whether their tags say so or not; a path may name a page."""
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        file.write(picture()[::4, ::4], subfiletype=1)
        file.write(picture(), metadata=None)
        file.write(picture()[::2, ::2], metadata=None)
        file.write(np.zeros_like(picture()), metadata=None)
        file.write(np.zeros(picture().shape, bool), metadata=None, subfiletype=4, photometric="minisblack")
    with open_scan(tmp_path / "s.tif") as scan:
        (finding,) = scan.problems
        assert "holds 2 pictures of full size (pages 2, 4), and page 2 was measured" in finding
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())
    with open_scan(f"{tmp_path / 's.tif'}#page=4") as scan:
        assert not scan.problems
        assert not scan.window(0, 0, scan.width_px, scan.height_px).any()
    with pytest.raises(MeasurementError, match="page 3 of this file is no picture of full size"):
        open_scan(f"{tmp_path / 's.tif'}#page=3")


@pytest.mark.parametrize("flag", [0, 1])
def test_a_full_picture_below_a_thumbnail_is_read(flag: int, tmp_path: Path) -> None:
    """In a SubIFD, as cameras and scanners store it, whether the tags of the first page call it reduced or not."""
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        file.write(picture()[::8, ::8], subfiletype=flag, subifds=2, metadata=None)
        file.write(picture(), metadata=None)
        file.write(picture()[::2, ::2], subfiletype=1, metadata=None)
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())
    with open_scan(tmp_path / "s.tif") as scan:
        assert not scan.problems


def test_a_second_full_picture_below_a_page_is_reported(tmp_path: Path) -> None:
    """No column of images.csv names a SubIFD: without a word its frame would be lost."""
    with tifffile.TiffWriter(tmp_path / "s.tif") as file:
        file.write(picture(), subifds=2, metadata=None)
        file.write(np.zeros_like(picture()), metadata=None)
        file.write(picture()[::2, ::2], metadata=None)
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())
    for path in (tmp_path / "s.tif", f"{tmp_path / 's.tif'}#page=1"):
        with open_scan(path) as scan:
            (finding,) = scan.problems
            assert finding.startswith("page 1 holds 2 pictures of full size (SubIFDs), and one of them was measured")


def test_which_band_is_used_is_stated(tmp_path: Path) -> None:
    bands = np.stack([picture()] * 5, axis=-1)
    result = []
    for kind, samples, further in (
        ("minisblack", bands, [0] * 4),
        ("rgb", bands, [0] * 2),
        ("rgb", bands[..., :4], [2]),
    ):
        tifffile.imwrite(tmp_path / "s.tif", samples, photometric=kind, planarconfig="contig", extrasamples=further)
        with open_scan(tmp_path / "s.tif") as scan:
            result.append(scan.notes)
    assert result[0] == ("the picture has 5 bands: the first is used",)
    assert result[1] == ("the picture has 5 bands: the first three are used, as red, green and blue",)
    assert result[2] == ()


@pytest.mark.parametrize("pictures", [1, 3])
def test_a_stack_is_read_and_what_was_put_into_its_pixels_is_visible(tmp_path: Path, pictures: int) -> None:
    """tifffile leaves room behind the tags of a further picture, and says the numbers of the first one's instead."""
    tifffile.imwrite(tmp_path / "s.tif", np.stack([picture()] * pictures), photometric="minisblack")
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())
    data = (tmp_path / "s.tif").read_bytes()
    for put_in in (2, 12, 40):
        (tmp_path / "s.tif").write_bytes(data[:400] + bytes(put_in) + data[400:])
        with pytest.raises(MeasurementError, match="damaged or truncated"):
            open_scan(tmp_path / "s.tif")


def test_the_orientation_tag_is_stated_and_not_applied(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture(), extratags=[(274, 3, 1, 6, True)])
    with open_scan(tmp_path / "s.tif") as scan:
        assert "orientation tag (6) is not applied" in scan.notes[0]
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), picture())
    exif = PIL.Image.Exif()
    exif[274] = 8
    PIL.Image.fromarray(picture(np.uint8)).save(tmp_path / "s.jpg", exif=exif)
    with open_scan(tmp_path / "s.jpg") as scan:
        assert (scan.height_px, scan.width_px) == (HEIGHT, WIDTH)
        assert "orientation tag (8) is not applied" in scan.notes[0]


@pytest.mark.parametrize("stored", [(3, 2, (8, 6)), (5, 1, (8, 1)), (3, 1, 0), (2, 2, b"8\0")])
def test_an_orientation_tag_that_is_none_counts_as_upright(stored: tuple[int, int, Any], tmp_path: Path) -> None:
    """Two numbers, a fraction, a number that is none of the eight, and text."""
    tifffile.imwrite(tmp_path / "s.tif", np.zeros((1, 1), np.uint8), extratags=[(274, *stored, True)])
    PIL.Image.fromarray(picture(np.uint8)).save(
        tmp_path / "s.jpg", exif=b"Exif\0\0" + (tmp_path / "s.tif").read_bytes()
    )
    with open_scan(tmp_path / "s.jpg") as scan:
        assert (scan.orientation, scan.notes) == (1, ())


def test_twelve_bits_have_their_own_full_scale(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", picture() >> 4, bitspersample=12, photometric="miniswhite")
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.full_scale_dn == 4095.0
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), 4095.0 - (picture() >> 4))


# --- formats of archives: inks, Lab, signed and floating-point samples, JPEG of 12 bits, JPEG 2000


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_inks_give_the_light_of_their_print(tmp_path: Path, dtype: type[np.unsignedinteger[Any]], planar: str) -> None:
    """Full cyan takes red away, and black everything."""
    full = np.iinfo(dtype).max
    inks = (np.random.default_rng(3).random((60, 70, 4)) * full).astype(dtype)
    inks[0, 0], inks[0, 1], inks[0, 2], inks[0, 3] = (0, 0, 0, 0), (full, 0, 0, 0), (0, 0, 0, full), (0, full, full, 0)
    stored = inks if planar == "contig" else np.moveaxis(inks, -1, 0)
    tifffile.imwrite(tmp_path / "s.tif", stored, photometric="separated", planarconfig=planar)
    with open_scan(tmp_path / "s.tif") as scan:
        assert (scan.channels, scan.full_scale_dn) == (1, 65535.0)
        assert scan.notes == ("its colours are inks (CMYK): the luminance of their print is used",)
    grey = whole(tmp_path / "s.tif")
    np.testing.assert_allclose(grey[0, :4] / 65535, [1.0, 0.701, 0.0, 0.299], atol=1e-5)
    share = 1 - inks / full
    np.testing.assert_allclose(grey / 65535, share[..., 3] * (share[..., :3] @ [0.299, 0.587, 0.114]), atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "dtype", "full"),
    [("cielab", np.uint8, 255.0), ("cielab", np.uint16, 65535.0), ("icclab", np.uint16, 65280.0)],
)
def test_lab_gives_its_lightness(tmp_path: Path, kind: str, dtype: type[np.unsignedinteger[Any]], full: float) -> None:
    lightness = np.minimum(picture(dtype), int(full)).astype(dtype)
    lab = np.dstack([lightness, *[np.full_like(lightness, 128)] * 2])
    tifffile.imwrite(tmp_path / "s.tif", lab, photometric=kind, compression="lzw")
    with open_scan(tmp_path / "s.tif") as scan:
        assert (scan.channels, scan.full_scale_dn) == (1, full)
        assert scan.notes == ("its colours are CIE L*a*b*: the lightness L* is used",)
    assert read_head(tmp_path / "s.tif").bits == np.iinfo(dtype).bits
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), lightness)


def test_signed_numbers_keep_their_values_and_negative_ones_are_black(tmp_path: Path) -> None:
    truth = picture().astype(np.int32) // 2 - 100
    tifffile.imwrite(tmp_path / "s.tif", truth.astype(np.int16), photometric="minisblack")
    with open_scan(tmp_path / "s.tif") as scan:
        assert scan.full_scale_dn == 32767.0
        assert "negative ones are taken for 0" in scan.notes[0]
    np.testing.assert_array_equal(whole(tmp_path / "s.tif"), np.maximum(truth, 0))


@pytest.mark.parametrize(("greatest", "full"), [(1.0, 1.0), (0.7, 1.0), (255.0, 255.0), (40000.0, 65535.0), (1e6, 1e6)])
@pytest.mark.parametrize(
    ("dtype", "options"),
    [
        (np.float32, {"rowsperstrip": 7, "compression": "lzw"}),
        (np.float64, {"tile": (64, 48), "compression": "zlib", "predictor": True}),
    ],
)
def test_floating_point_is_scaled_by_what_its_numbers_are(
    tmp_path: Path, greatest: float, full: float, dtype: type[np.floating[Any]], options: dict[str, Any]
) -> None:
    truth = (picture() / picture().max() * greatest).astype(dtype)
    tifffile.imwrite(tmp_path / "s.tif", truth, photometric="minisblack", **options)
    with open_scan(tmp_path / "s.tif") as scan:
        assert (scan.channels, scan.full_scale_dn) == (1, 65535.0)
        assert "floating-point" in scan.notes[0]
    np.testing.assert_allclose(whole(tmp_path / "s.tif") / 65535, truth / full, atol=0.6 / 65535)


def test_floating_point_with_holes_and_negative_numbers(tmp_path: Path) -> None:
    truth = np.linspace(-1.0, 3.0, 6000, dtype=np.float32).reshape(60, 100)
    holed = truth.copy()
    holed[5, 5] = np.nan
    tifffile.imwrite(tmp_path / "s.tif", np.stack([holed] * 3, axis=-1), photometric="rgb")
    grey = whole(tmp_path / "s.tif")
    assert grey[5, 5] == 0.0
    grey[5, 5] = (truth[5, 5] + 1) / 4 * 65535
    np.testing.assert_allclose(grey / 65535, (truth + 1) / 4, atol=2e-5)


def test_the_scale_of_floating_point_is_found_while_other_threads_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = (picture() / picture().max() * 200.0).astype(np.float32)
    tifffile.imwrite(tmp_path / "s.tif", truth, photometric="minisblack", rowsperstrip=HEIGHT // 2)
    read = tifffile.FileHandle.read
    with open_scan(tmp_path / "s.tif") as scan, ThreadPoolExecutor(1) as others:
        rows: Any = scan._segments

        def read_among_others(file: tifffile.FileHandle, size: int = -1) -> bytes:
            wait([others.submit(rows._stored_rows, 0, 1)], 0.05)
            return read(file, size)

        monkeypatch.setattr(tifffile.FileHandle, "read", read_among_others)
        grey = scan.window(0, 0, WIDTH, HEIGHT)
    np.testing.assert_allclose(grey / 65535, truth / 255.0, atol=0.6 / 65535)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_jpeg_of_twelve_bits_has_its_own_full_scale(tmp_path: Path, channels: int) -> None:
    smooth = np.asarray(cv2.GaussianBlur(picture(np.uint16, channels), (0, 0), 3), np.uint16) >> 4
    (tmp_path / "s.jpg").write_bytes(imagecodecs.jpeg_encode(smooth, level=97, bitspersample=12))
    with open_scan(tmp_path / "s.jpg") as scan:
        assert (scan.channels, scan.full_scale_dn, scan.damage) == (channels, 4095.0, "")
    assert np.sqrt(np.mean((whole(tmp_path / "s.jpg") - luminance(smooth)) ** 2)) < 6.0


@pytest.mark.parametrize("ending", ["jp2", "j2k"])
@pytest.mark.parametrize(("bits", "channels"), [(8, 1), (8, 3), (12, 1), (16, 1), (16, 3)])
def test_jpeg_2000_without_loss(tmp_path: Path, bits: int, channels: int, ending: str) -> None:
    truth = picture(np.uint16, channels) >> (16 - bits)
    truth = truth.astype(np.uint8) if bits == 8 else truth
    path = tmp_path / f"s.{ending}"
    path.write_bytes(imagecodecs.jpeg2k_encode(truth, codecformat=ending, bitspersample=bits, reversible=True))
    with open_scan(path) as scan:
        assert (scan.width_px, scan.height_px, scan.channels) == (WIDTH, HEIGHT, channels)
        assert (scan.full_scale_dn, scan.is_lossy, scan.notes) == (2.0**bits - 1, False, ())
    np.testing.assert_allclose(whole(path), luminance(truth), rtol=1e-5)
    head = read_head(path)
    assert (head.file_format, head.width_px, head.bits, head.channels) == ("JPEG 2000", WIDTH, bits, channels)
    assert declared_tone(path) is None  # its colour box, if it has one, names sRGB


def test_jpeg_2000_with_loss_says_so_and_its_resolution(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(picture(np.uint8), (0, 0), 3)
    data = imagecodecs.jpeg2k_encode(smooth, codecformat="jp2", level=60, reversible=False)
    at = data.index(b"jp2h") - 4
    (length,) = struct.unpack_from(">I", data, at)
    resolution = struct.pack(">I4sI4s4H2b", 26, b"res ", 18, b"resc", 500, 1, 400, 1, 2, 2)
    head = struct.pack(">I", length + len(resolution)) + data[at + 4 : at + length] + resolution
    (tmp_path / "s.jp2").write_bytes(data[:at] + head + data[at + length :])
    with open_scan(tmp_path / "s.jp2") as scan:
        assert scan.is_lossy
        assert "compressed as JPEG 2000 with loss" in scan.notes[0]
        assert scan.pitch_um == pytest.approx((25.0, 20.0))
    assert np.abs(whole(tmp_path / "s.jp2") - smooth).max() < 12


def test_a_jpeg_2000_that_is_cut_short_or_signed_is_refused(tmp_path: Path) -> None:
    data = imagecodecs.jpeg2k_encode(picture(np.uint8), codecformat="jp2", reversible=True)
    (tmp_path / "s.jp2").write_bytes(data[: len(data) // 2])
    with pytest.raises(MeasurementError, match="end marker is missing"):
        open_scan(tmp_path / "s.jp2")
    (tmp_path / "s.jp2").write_bytes(data[:60])
    with pytest.raises(MeasurementError, match="header is cut short"):
        open_scan(tmp_path / "s.jp2")
    (tmp_path / "s.jp2").write_bytes(imagecodecs.jpeg2k_encode(picture(np.uint8).astype(np.int8), codecformat="jp2"))
    with pytest.raises(MeasurementError, match="signed samples of 8 bits"):
        open_scan(tmp_path / "s.jp2")


def test_a_jpeg_of_inks_is_refused(tmp_path: Path) -> None:
    """Its first three are no RGB: what black ink alone has printed would be even."""
    inks = np.zeros((64, 64, 4), np.uint8)
    inks[20:40, 20:40, 3] = 255
    (tmp_path / "a.jpg").write_bytes(imagecodecs.jpeg8_encode(inks, colorspace="CMYK", outcolorspace="CMYK"))
    with pytest.raises(MeasurementError, match=r"JPEG of four inks.*save it as a grey or RGB"):
        open_scan(tmp_path / "a.jpg")


def set_tag(path: Path, tag: int, value: Any) -> None:
    with tifffile.TiffFile(path, mode="r+") as file:
        page = file.pages.first
        if tag in page.tags:
            kind = "s" if isinstance(value, str | bytes) else 3 if tag not in (256, 257, 278, 282) else 4
            page.tags[tag].overwrite(value, dtype=kind)


def zeros_png(side: int, bits: int = 8) -> bytes:
    """Of a picture that holds nothing but zeros."""
    rows = zlib.compress(bytes(1000))
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", side, side, bits, 0, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b"")]
    parts = [
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
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
            r"s\.tif is no TIFF, JPEG, JPEG 2000, PNG, BMP.*These ar",
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
        intact, cut = (crop_scan(scan, (*first, 64, 64)) for first in ((0, 0), (100, 80)))
        assert not intact.damage
        assert not intact.is_lost
        assert "(rows 80 to 127, tile 7" in cut.damage
        np.testing.assert_array_equal(cut.inside(-5, 0, 74, 64), np.pad(known[80:144, 100:164], ((0, 0), (5, 5))))
        assert crop_scan(scan, (130, 70, 20, 20)).is_lost
    lost = np.zeros((HEIGHT, WIDTH), bool)
    lost[64:128, 128:192] = True
    np.testing.assert_array_equal(known, ~lost)
    np.testing.assert_array_equal(np.stack(view)[known], picture()[known])


@pytest.mark.parametrize("packing", [None, "lzw", "zlib", "zstd", "packbits"])
@pytest.mark.parametrize("predictor", [False, True])
def test_a_padded_last_strip_is_valid(tmp_path: Path, packing: str | None, predictor: bool) -> None:
    """It holds as many rows as the others, though the picture ends before (TIFF 6.0 asks for fewer, writers pad)."""
    padded = np.pad(picture(), ((0, 5), (0, 0)))
    predictor = predictor and packing is not None
    tifffile.imwrite(
        tmp_path / "s.tif", padded, rowsperstrip=len(padded) // 4, compression=packing, predictor=predictor
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


def test_a_head_is_refused_where_the_picture_is(tmp_path: Path) -> None:
    """100 megapixels of 16 bits exceed the 128 MiB that are always allowed."""
    (tmp_path / "s.png").write_bytes(zeros_png(10_000, 16))
    (tmp_path / "s.jp2").write_bytes(imagecodecs.jpeg2k_encode(picture(np.uint16), codecformat="jp2"))
    data = bytearray((tmp_path / "s.jp2").read_bytes())
    at = data.index(b"\xff\x51") + 6
    data[at : at + 8] = (10_000).to_bytes(4, "big") * 2
    (tmp_path / "s.jp2").write_bytes(bytes(data[:5000]) + b"\xff\xd9")
    for name in ("s.png", "s.jp2"):
        for use in (read_head, open_scan):
            with pytest.raises(MeasurementError, match=r"claims a picture of 10000 x 10000 pixels \(200000000 bytes"):
                use(tmp_path / name)


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
        assert "none of it can be trusted" in scan.damage
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


def bmp(picture: NDArray[np.uint8], bits: int) -> bytes:
    """Rows from below, of blue, green and red or of an index into grey values, each filled up to four bytes."""
    height, width = picture.shape[:2]
    palette = bytes(value for grey in range(256) for value in (grey, grey, grey, 0)) if bits == 8 else b""
    stored = picture[..., ::-1] if bits == 24 else picture
    rows = b"".join(row.tobytes() + bytes(-row.nbytes % 4) for row in stored[::-1])
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, bits, 0, len(rows), 0, 0, 0, 0)
    offset = 14 + len(head) + len(palette)
    return b"BM" + struct.pack("<IHHI", offset + len(rows), 0, 0, offset) + head + palette + rows


@pytest.mark.parametrize("kind", ["BMP of 8 bits", "BMP of 24 bits", "PGM of 8 bits", "PGM of 12 bits", "PPM"])
def test_pictures_of_machine_vision_cameras(kind: str, tmp_path: Path) -> None:
    """Nine columns: rows of a BMP are filled up to twelve bytes. A PGM of more than 8 bits is big-endian."""
    rng, path = np.random.default_rng(1), tmp_path / "picture"
    largest = 4095 if "12" in kind else 255
    picture = rng.integers(0, largest, (7, 9, 3) if "24" in kind or kind == "PPM" else (7, 9), endpoint=True)
    if kind.startswith("BMP"):
        data = bmp(picture.astype(np.uint8), 24 if "24" in kind else 8)
    else:
        number = b"P6" if kind == "PPM" else b"P5"
        data = number + b"\n# a comment\n9 7\n%d\n" % largest
        data += picture.astype(">u2" if "12" in kind else "u1").tobytes()
    path.write_bytes(data)
    head = read_head(path)
    assert (head.width_px, head.height_px, head.bits) == (9, 7, 12 if "12" in kind else 8)
    with open_scan(path) as scan:
        assert scan.full_scale_dn == largest
        np.testing.assert_array_equal(scan.samples(0, 0, 9, 7).squeeze(), picture)
    path.write_bytes(data[:-1])
    with pytest.raises(MeasurementError, match="cut short"):
        open_scan(path)
    path.write_bytes(bmp(np.zeros((7, 9), np.uint8), 4))
    with pytest.raises(MeasurementError, match="a BMP of 4 bits a pixel: save it with 8 or 24"):
        open_scan(path)
