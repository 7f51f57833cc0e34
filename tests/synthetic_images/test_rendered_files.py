"""Files of rendered scans: every way to store one picture holds it, in little memory, the same in every run."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from small_scene import CAMERA, SCANNER, hidden_field, rendered, scene

from synthetic_images.areas import rounded_rectangle
from synthetic_images.render import STRIP_PX, render_scene
from synthetic_images.scene import Compression, DrawnMark, SceneFiducial, SceneFilm, Tones
from synthetic_images.tiff import Grey, write_tiff


@pytest.fixture(scope="module")
def stored_plainly(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Grey]:
    """The grey values of the same scene in grey and in colour, rendered to uncompressed strips."""
    folder = tmp_path_factory.mktemp("plain")
    for colour in (False, True):
        render_scene(scene(scanner=replace(SCANNER, colour=colour, noise=0.01, tile_px=0)), folder / str(colour))
    return {colour: tifffile.imread(folder / str(colour) / "scans" / "f.tif") for colour in (False, True)}


@pytest.mark.parametrize("compression", ["none", "lzw", "deflate", "zstd"])
@pytest.mark.parametrize("tile_px", [0, 64, 384])
@pytest.mark.parametrize("colour", [False, True])
def test_the_same_picture(
    tmp_path: Path, stored_plainly: dict[bool, Grey], compression: Compression, tile_px: int, colour: bool
) -> None:
    scanner = replace(SCANNER, colour=colour, noise=0.01, compression=compression, tile_px=tile_px)
    grey = stored_plainly[colour]
    assert grey.shape == ((350, 350, 3) if colour else (350, 350))
    strips = (grey[row : row + STRIP_PX] for row in range(0, 350, STRIP_PX))
    write_tiff(tmp_path / "f.tif", strips, 350, 350, STRIP_PX, scanner)
    assert np.array_equal(tifffile.imread(tmp_path / "f.tif"), grey)
    with tifffile.TiffFile(tmp_path / "f.tif") as file:
        tags = file.pages.first.tags
        assert tags["XResolution"].value[0] / tags["XResolution"].value[1] == pytest.approx(250.0)  # a cm over 40 um
        assert ("TileWidth" in tags) == (tile_px > 0)


@pytest.mark.parametrize(("tile_px", "colour"), [(0, False), (64, True)])
def test_jpeg_is_near(tmp_path: Path, tile_px: int, colour: bool) -> None:
    scanner = replace(SCANNER, bit_depth=8, colour=colour, tile_px=tile_px)
    expected, _ = rendered(tmp_path / "a", scene(scanner=scanner))
    picture, _ = rendered(tmp_path / "b", scene(scanner=replace(scanner, compression="jpeg")))
    assert 0.0 < np.abs(picture - expected).max() < 0.06


def test_eight_bits_are_the_sixteen_rounded(tmp_path: Path) -> None:
    fine, _ = rendered(tmp_path / "16", scene())
    coarse, _ = rendered(tmp_path / "8", scene(scanner=replace(SCANNER, bit_depth=8)))
    assert np.abs(coarse - fine).max() < 0.51 / 255


def test_a_negative_is_the_positive_reversed(tmp_path: Path) -> None:
    positive, truth = rendered(tmp_path / "p", scene())
    negative, _ = rendered(tmp_path / "n", scene(scanner=replace(SCANNER, negative=True)))
    assert np.abs(negative - (1 - positive)).max() < 2e-5
    assert positive[tuple(np.rint(truth.frames[0].fiducials["a"].center_px[::-1]).astype(int))] > 0.5


def test_white_is_zero_changes_the_file_and_not_the_picture(tmp_path: Path) -> None:
    usual, _ = rendered(tmp_path / "b", scene())
    stored, _ = rendered(tmp_path / "w", scene(scanner=replace(SCANNER, white_is_zero=True)))
    assert np.abs(stored - (1 - usual)).max() < 2e-5
    with tifffile.TiffFile(tmp_path / "w" / "scans" / "f.tif") as file:
        assert file.pages.first.tags["PhotometricInterpretation"].value == 0


def test_grain_and_noise_have_the_strength_and_the_correlation_requested(tmp_path: Path) -> None:
    sigma = 1.2
    made = scene(
        film=SceneFilm(grain=0.03, grain_px=sigma),
        scanner=replace(SCANNER, noise=0.01, margin_mm=5.0, blur_px=0.0),
        field=hidden_field(),
        camera=replace(CAMERA, fiducials=()),
        tones=Tones(border=0.4, background=0.4, contrast=0.0),
    )
    picture, _ = rendered(tmp_path, made)
    noise = picture - picture.mean()
    assert noise.std() == pytest.approx(np.hypot(0.03, 0.01), rel=0.02)
    neighbour = float((noise[:, 1:] * noise[:, :-1]).mean())
    below = float((noise[2:] * noise[:-2]).mean())
    # White noise after a Gaussian is correlated by exp(-d^2 / (4 sigma^2)); across the seams of the strips too.
    assert neighbour == pytest.approx(0.03**2 * np.exp(-1 / (4 * sigma**2)), rel=0.05)
    assert below == pytest.approx(0.03**2 * np.exp(-4 / (4 * sigma**2)), rel=0.07)
    seam = float((noise[255] * noise[256]).mean())
    assert seam == pytest.approx(0.03**2 * np.exp(-1 / (4 * sigma**2)), rel=0.35)


def test_the_border_and_what_was_not_exposed_within_the_frame_have_one_texture(tmp_path: Path) -> None:
    shadow = DrawnMark(((rounded_rectangle(np.array([1.5, 1.5]), 0.0),),), light=False)
    made = scene(
        scanner=replace(SCANNER, blur_px=0.0, margin_mm=2.0),
        field=hidden_field(),
        pad_mm=0.0,
        camera=replace(CAMERA, fiducials=(SceneFiducial("a", (0.0, 0.0), shadow),)),
        tones=Tones(border=0.3, border_contrast=0.05, dark_mark=0.3, background=0.7, contrast=0.0),
    )
    picture, truth = rendered(tmp_path, made)
    row, col = np.rint(truth.frames[0].fiducials["a"].center_px[::-1]).astype(int)
    for part in (picture[:40, :], picture[row - 25 : row + 25, col - 25 : col + 25]):
        assert part.mean() == pytest.approx(0.3, abs=0.01)
        assert part.std() == pytest.approx(0.05, rel=0.15)
    exposed = picture[row + 60 : row + 100, col + 60 : col + 100]
    assert exposed.std() < 1e-4


@pytest.mark.study
def test_the_same_scene_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    film = SceneFilm(grain=0.02, dust=5, scratches=1, hairs=1)
    made = scene(film=film, background="terrain", tones=Tones())
    for name, one in (("a", made), ("b", made), ("c", replace(made, seed=5))):
        render_scene(one, tmp_path / name)
    scans = [(tmp_path / name / "scans" / "f.tif").read_bytes() for name in "abc"]
    assert scans[0] == scans[1]
    assert scans[0] != scans[2]
    assert (tmp_path / "a" / "truth.json").read_bytes() == (tmp_path / "b" / "truth.json").read_bytes()


@pytest.mark.study
def test_memory_does_not_grow_with_the_scans_length(tmp_path: Path) -> None:
    peaks = []
    for height_mm in (40.0, 160.0):
        camera = replace(CAMERA, frame_mm=(40.0, height_mm), fiducials=())
        made = scene(camera=camera, film=SceneFilm(grain=0.02), field=hidden_field())
        tracemalloc.start()
        render_scene(made, tmp_path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_a_failed_rendering_leaves_the_earlier_scan(tmp_path: Path) -> None:
    render_scene(scene(), tmp_path)
    before = (tmp_path / "scans" / "f.tif").read_bytes()

    def stop(image: str, done: int, total: int) -> None:
        raise OSError(f"{image} {done} {total}")

    with pytest.raises(OSError, match="f 1 2"):
        render_scene(scene(seed=9), tmp_path, stop)
    assert (tmp_path / "scans" / "f.tif").read_bytes() == before
    assert sorted(path.name for path in (tmp_path / "scans").iterdir()) == ["f.tif"]
