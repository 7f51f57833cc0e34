"""Rendered scans against their truth, by means that know nothing of the renderer: centroids and symmetry."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.measure
from numpy.typing import NDArray
from small_scene import CAMERA, CROSS, FIELD, OBLIQUE, PLACES, SCANNER, hidden_field, rendered, scene
from studies import parametrize_with_studies

from pipeline.errors import InputError
from pipeline.rendered.scene_file import parse_scene
from pipeline.text.toml_tables import Table
from synthetic_images import scene as scenes
from synthetic_images.areas import coverage
from synthetic_images.background import scene_background
from synthetic_images.film import frame_geometry
from synthetic_images.frame import frame_truth
from synthetic_images.projection import object_rotation
from synthetic_images.truth import truth_json
from synthetic_images.writing import FONTS, written_area

Array = NDArray[np.float64]

CENTER_PX = 0.002  # what a rendered centre must keep to


def centroid(picture: Array, near_px: Array, half: int) -> Array:
    """(column, row) of the centre of gravity of what differs from the window's even surroundings."""
    col, row = np.rint(near_px).astype(int)
    window = picture[row - half : row + half + 1, col - half : col + half + 1]
    weights = window - np.median(np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]]))
    down, right = skimage.measure.centroid(weights)
    return np.array([right + col - half, down + row - half])


def test_disks_lie_where_the_truth_says(tmp_path: Path) -> None:
    """Oblique, distorted and on a film that has moved: the centre of the ellipse, not the projected centre."""
    film = scenes.FilmTransformation((1.002, 0.999), 3e-4, 0.01, (0.02, -0.03))
    made = scene(
        images=(replace(OBLIQUE, film=film, pose="270m", turn_rad=0.01),), film=scenes.SceneFilm(deformation_um=4.0)
    )
    picture, truth = rendered(tmp_path, made)
    targets = truth.frames[0].targets
    assert len(targets) == 9
    misses = [centroid(picture, p.figure_px, 13) - p.figure_px for p in targets.values() if not p.hidden]
    assert len(misses) == 9
    assert np.abs(misses).max() < CENTER_PX / 4
    # The test could not tell the two centres apart if they were the same.
    assert min(np.linalg.norm(p.figure_px - p.center_px) for p in targets.values()) > 10 * CENTER_PX


@parametrize_with_studies("pose", scenes.POSES, quick=(1, 6))
def test_a_fiducial_lies_where_its_pose_puts_it(tmp_path: Path, pose: str) -> None:
    made = scene(images=(replace(OBLIQUE, pose=pose, turn_rad=0.004, offset_mm=(0.11, -0.07)),))
    picture, truth = rendered(tmp_path, made)
    for id, (x, y) in PLACES.items():
        position = truth.frames[0].fiducials[id].center_px
        assert np.abs(centroid(picture, position, 18) - position).max() < CENTER_PX
        # By the definition of the pose alone, to the small turn: mirrored first, then turned counter-clockwise.
        z = complex(-x if pose.endswith("m") else x, y) * np.exp(1j * np.deg2rad(int(pose.rstrip("m"))))
        expected = np.array([174.5 + (z.real + 0.11) / 0.04, 174.5 - (z.imag - 0.07) / 0.04])
        assert np.linalg.norm(position - expected) < 0.0045 * np.hypot(x, y) / 0.04


def test_the_pixels_of_a_texture_come_at_no_regular_distance() -> None:
    """Else interpolation between them shows in the roughness of rows, as that of an enlarged scan."""
    scanner, tones = replace(SCANNER, pitch_um=(12.0, 12.0)), scenes.Tones(contrast=0.05)
    made = scene(background="wall", tones=tones, scanner=scanner)
    geometry = frame_geometry(made, 0)
    ground = scene_background(made).rows(geometry, 0, geometry.height_px)
    roughness = np.log(np.abs(np.diff(ground[:, 300:556], 2, axis=0)).mean(axis=1))
    power = np.abs(np.fft.rfft((roughness - roughness.mean()) * np.hanning(len(roughness)))) ** 2
    assert power[len(power) // 5 :].max() < 200 * np.median(power)  # texels of 3 px in rows: 100,000 times


def test_a_chip_lies_with_its_origin_on_the_mark(tmp_path: Path) -> None:
    chip = np.zeros((41, 51))
    rows, columns = np.indices(chip.shape)
    chip[:] = np.exp(-((columns - 27.3) ** 2 + (rows - 18.6) ** 2) / (2 * 3.0**2))
    mark = scenes.ChipMark(chip, 30.0, (27.3, 18.6), turn_deg=30.0)
    camera = replace(CAMERA, fiducials=tuple(scenes.SceneFiducial(id, xy, mark) for id, xy in PLACES.items()))
    picture, truth = rendered(tmp_path, scene(camera=camera, field=hidden_field()))
    for position in truth.frames[0].fiducials.values():
        assert np.abs(centroid(picture, position.center_px, 14) - position.center_px).max() < 0.01


def test_what_cannot_be_visible_is_stated(tmp_path: Path) -> None:
    camera = replace(CAMERA, fiducials=(*CAMERA.fiducials, scenes.SceneFiducial("e", (9.0, 0.0), CROSS)))
    targets = (
        scenes.DiskTarget("seen", (0.0, 0.0, 0.0)),
        scenes.DiskTarget("behind it", (0.0, 0.02, -0.5)),
        scenes.DiskTarget("from behind", (0.4, 0.0, 0.0), (0.0, 0.0, -1.0)),
        scenes.DiskTarget("outside", (1.33, 0.0, 0.0)),
        scenes.DiskTarget("under a mark", (0.9, -0.85, 0.0)),
        scenes.DiskTarget("under tape", (-0.6, -0.85, 0.0)),
        scenes.DiskTarget("above", (0.0, 0.0, 9.0)),
    )
    made = scene(
        camera=replace(camera, distortion=scenes.SceneDistortion()),
        field=scenes.DiskField(targets, 0.12),
        images=(scenes.SceneImage("f", (0.0, 0.0, 3.0, 0.0, 0.0, 0.0), covered=("b",)),),
        pad_mm=0.0,
    )
    _, truth = rendered(tmp_path, made)
    frame = truth.frames[0]
    assert {id: position.hidden for id, position in frame.fiducials.items()} == {
        "a": "",
        "b": "covered",
        "c": "",
        "d": "",
        "e": "off the scan",
    }
    assert {id: position.hidden for id, position in frame.targets.items()} == {
        "seen": "",
        "behind it": "behind another target",
        "from behind": "faces away",
        "outside": "not wholly inside of the exposed frame",
        "under a mark": "behind a fiducial",
        "under tape": "behind a fiducial",
    }
    written = json.loads((tmp_path / "truth.json").read_text())["images"]["f"]
    assert written["fiducials"]["b"]["visible"] is False
    assert written["fiducials"]["b"]["reason"] == "covered"


def test_a_neighbours_marks_stand_a_frame_further(tmp_path: Path) -> None:
    alone, _ = rendered(tmp_path / "a", scene(scanner=replace(SCANNER, margin_mm=6.0)))
    image = replace(OBLIQUE, neighbour="right", neighbour_gap_mm=1.0)
    both, truth = rendered(tmp_path / "b", scene(scanner=replace(SCANNER, margin_mm=6.0), images=(image,)))
    ours = truth.frames[0].fiducials["c"].center_px
    theirs = ours + np.array([13.0 / 0.04, 0.0])
    assert np.abs(centroid(both, theirs, 18) - theirs).max() < CENTER_PX
    assert np.array_equal(both[:, : int(ours[0]) + 200], alone[:, : int(ours[0]) + 200])


def test_a_chessboards_corners_are_points_of_symmetry(tmp_path: Path) -> None:
    board = scenes.BoardField("chessboard", 3, 2, 0.5)
    camera = replace(CAMERA, distortion=scenes.SceneDistortion(), principal_point_mm=(0.0, 0.0), fiducials=())
    image = scenes.SceneImage("f", (0.5, 0.5, 3.5, 0.0, 0.0, 0.0))
    picture, truth = rendered(tmp_path, scene(field=board, camera=camera, images=(image,)))
    corner = truth.frames[0].targets["r0c1"].center_px
    assert corner == pytest.approx((174.5, 174.5))
    window = picture[155:195, 155:195]
    assert np.abs(window - window[::-1, ::-1]).max() < 2e-5
    assert window[0, 0] > window[0, -1]  # the square left above r0c0 is black, and so the next one is white


@pytest.mark.parametrize(("asymmetric", "dots"), [(False, 15), (True, 8)])
def test_circle_grids_hold_their_dots(tmp_path: Path, asymmetric: bool, dots: int) -> None:
    board = scenes.BoardField("circle-grid", 5, 3, 0.3, 0.12, asymmetric)
    camera = replace(CAMERA, fiducials=())
    image = replace(OBLIQUE, exterior=(1.8, -0.2, 3.2, 0.16, 0.34, 0.4))
    picture, truth = rendered(tmp_path, scene(field=board, camera=camera, images=(image,)))
    targets = truth.frames[0].targets
    misses = [centroid(picture, p.figure_px, 9) - p.figure_px for p in targets.values() if not p.hidden]
    assert len(misses) == dots
    assert np.abs(misses).max() < CENTER_PX


def test_eccentricity_follows_the_closed_form() -> None:
    """The ellipse's centre less the projected centre, from the dual conic, with centre c and normal n in the camera's
    frame, z forwards, y down: f r^2 [n_xy n_z + c_xy / c_z (1 - n_z^2)] / (c_z^2 - r^2 (1 - n_z^2))."""
    camera = replace(CAMERA, distortion=scenes.SceneDistortion(), principal_point_mm=(0.0, 0.0))
    frame = frame_truth(scene(camera=camera), 0)
    into_camera = np.diag([1.0, -1.0, -1.0]) @ object_rotation(*OBLIQUE.exterior[3:])
    radius = FIELD.diameter / 2
    for target in FIELD.targets:
        c = into_camera @ (np.array(target.center) - OBLIQUE.exterior[:3])
        n = into_camera @ (np.array(target.normal) / np.linalg.norm(target.normal))
        tilt = 1 - n[2] ** 2
        e_mm = 14.0 * radius**2 * (n[:2] * n[2] + c[:2] / c[2] * tilt) / (c[2] ** 2 - radius**2 * tilt)
        position = frame.targets[target.id]
        assert position.figure_px - position.center_px == pytest.approx(e_mm / 0.04, abs=1e-5)


def test_light_reaches_pockets_next_to_the_frame_and_nowhere_twice(tmp_path: Path) -> None:
    """Of a mark 0.5 mm beyond the frame's edge: its pocket reaches 0.3 mm into the frame."""
    fiducials = (scenes.SceneFiducial("e", (6.5, 0.0), None),)
    image = scenes.SceneImage("f", (0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    camera = replace(CAMERA, fiducials=fiducials, distortion=scenes.SceneDistortion())
    clean = replace(SCANNER, margin_mm=2.0, noise=0.0)
    made = scene(camera=camera, field=hidden_field(), images=(image,), scanner=clean, pad_mm=0.0, pocket_mm=0.8)
    grey, truth = rendered(tmp_path, made)
    col, row = np.rint(truth.frames[0].fiducials["e"].center_px).astype(int)
    along = {mm: grey[row, col + round(mm / 0.04)] for mm in (-1.5, -0.65, -0.2, 0.6, 1.0)}
    light, dark = made.tones.background, made.tones.border
    assert along == pytest.approx({-1.5: light, -0.65: light, -0.2: light, 0.6: light, 1.0: dark}, abs=1e-3)
    assert grey[row + round(1.0 / 0.04), col + 5] == pytest.approx(dark, abs=1e-3)


def test_a_scanner_sharpens_its_codes_by_an_unsharp_mask_across_strips(tmp_path: Path) -> None:
    """Against OpenCV's Gaussian on the whole scan: amount times the codes less their mean under it."""
    plain, _ = rendered(tmp_path / "plain", scene())
    mask = scenes.UnsharpMask(amount=1.5, radius_px=1.2)
    sharp, _ = rendered(tmp_path / "sharp", scene(scanner=replace(SCANNER, sharpen=mask)))
    blurred = cv2.GaussianBlur(plain.astype(np.float64), (0, 0), 1.2, borderType=cv2.BORDER_REPLICATE)
    expected = np.clip(plain + 1.5 * (plain - blurred), 0.0, 1.0)
    assert np.abs(expected - plain).max() > 0.02
    np.testing.assert_allclose(sharp, expected, atol=5e-4)  # Gaussians that end at other places


def draw_text(text: str, font: str, size: int = 60) -> Array:
    """A line as a picture of 20 px a capital's height, its middle in the middle."""
    pixels = tuple(outline * (20.0, -20.0) + ((size - 1) / 2, (size - 1) / 2) for outline in written_area(text, font))
    return np.asarray(coverage((pixels,), 0, 0, size, size), float)


@pytest.mark.parametrize("font", FONTS)
def test_letters_are_as_high_as_requested_and_have_their_holes(font: str) -> None:
    high = draw_text("H", font).sum(axis=1)
    rows = np.flatnonzero(high > 0.1 * high.max())
    assert np.ptp(rows) + 1 == pytest.approx(20, abs=4)
    ring = draw_text("O", font)
    assert ring[30, 30] == 0.0
    assert ring[30].max() > 0.8


def test_letters_stand_upright() -> None:
    """Most of an L is low and left, of a T high."""
    letter, top = draw_text("L", "DejaVu Sans"), draw_text("T", "DejaVu Sans")
    assert letter[30:].sum() > 1.5 * letter[:30].sum()
    assert letter[:, :30].sum() > 1.5 * letter[:, 30:].sum()
    assert top[:30].sum() > 1.5 * top[30:].sum()


def written(folder: Path, **changes: Any) -> tuple[Array, scenes.SceneImage]:
    """A scan of the plain scene, written on above its frame, less the same without writing."""
    line = replace(scenes.Writing("LENS 7", (1.0, 6.5), 0.5), **changes)
    image = replace(OBLIQUE, writing=(line,))
    grey, truth = rendered(folder / "with", scene(images=(image,)))
    bare, _ = rendered(folder / "without", scene(images=(OBLIQUE,)))
    summary = json.loads(truth_json(truth))["images"]["f"]["writing"]
    assert [each["text"] for each in summary] == ["LENS 7"]
    difference = grey - bare
    row, col = np.nonzero(difference > 0.3)
    assert (col.min() + col.max()) / 2 == pytest.approx(summary[0]["col_px"], abs=1.0)
    assert (row.min() + row.max()) / 2 == pytest.approx(summary[0]["row_px"], abs=1.0)
    return difference[row.min() - 2 : row.max() + 3, col.min() - 2 : col.max() + 3], image


def test_a_line_is_painted_where_the_truth_says_turned_and_mirrored_as_requested(tmp_path: Path) -> None:
    upright, _ = written(tmp_path / "upright")
    mirrored, _ = written(tmp_path / "mirrored", mirrored=True)
    turned, _ = written(tmp_path / "turned", turn_deg=90.0, xy_mm=(-6.5, 1.0))
    assert np.abs(np.rot90(turned, -1) - upright).max() < 0.35  # half a pixel's shift
    assert np.abs(mirrored[:, ::-1] - upright).max() < 0.35
    assert np.abs(mirrored - upright).max() > 0.6


def test_writing_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="without any text"):
        scenes.Writing(" ", (0.0, 0.0), 1.0)
    with pytest.raises(ValueError, match="font"):
        scenes.Writing("A", (0.0, 0.0), 1.0, font="Comic Sans")


def scene_table(font: str = "cmr10") -> Table:
    pose = {"position": [0.0, 0.0, 4.0], "angles_deg": [0.0, 0.0, 0.0]}
    own = [{"text": "044", "xy_mm": [5.0, 6.5], "height_mm": 0.4, "mirrored": True}]
    return Table(
        {
            "camera": {"frame_mm": [12.0, 12.0], "principal_distance_mm": 14.0},
            "field": {"target": [{"id": "1", "xyz": [0.0, 0.0, 0.0]}], "diameter_mm": 30.0, "kind": "disks"},
            "scan": {"pitch_um": 40.0},
            "writing": [{"text": "RUN 7", "xy_mm": [-6.5, 0.0], "height_mm": 0.5, "turn_deg": 90.0, "font": font}],
            "image": [{"name": "a", **pose, "writing": own}, {"name": "b", **pose}],
        },
        Path("scene.toml"),
        "",
    )


def test_a_scene_file_writes_on_all_frames_and_on_single_ones() -> None:
    first, second = parse_scene(scene_table()).scene.images
    strip = scenes.Writing("RUN 7", (-6.5, 0.0), 0.5, 90.0, font="cmr10")
    assert first.writing == (strip, scenes.Writing("044", (5.0, 6.5), 0.4, mirrored=True))
    assert second.writing == (strip,)
    with pytest.raises(InputError, match="font"):
        parse_scene(scene_table("Comic Sans"))


BEND_UM = {"a20": 60.0, "b11": -50.0, "a03": 20.0, "b60": 2.0}
BENT = replace(SCANNER, bend_um=BEND_UM)
HALF_MM = 7.0  # of the bed: the frame is 12 mm wide, with a margin of 1 mm


def displaced_mm(x: float, y: float) -> tuple[float, float]:
    """The four terms as the polynomials are printed, x and y from the middle of the bed."""
    u, v = x / HALF_MM, y / HALF_MM
    p6 = (231 * u**6 - 315 * u**4 + 105 * u**2 - 5) / 16
    return 0.060 * (3 * u * u - 1) / 2 + 0.020 * (5 * v**3 - 3 * v) / 2, -0.050 * u * v + 0.002 * p6


@parametrize_with_studies("pose", ["0", "90", "180m"])
def test_a_mark_lies_where_film_and_scanner_put_it(tmp_path: Path, pose: str) -> None:
    """The bend stays in the scanner's axes however the frame is laid."""
    image = replace(OBLIQUE, pose=pose)
    picture, truth = rendered(tmp_path, scene(images=(image,), scanner=BENT))
    _, straight = rendered(tmp_path / "straight", scene(images=(image,)))
    middle_px = (np.array([truth.frames[0].geometry.width_px, truth.frames[0].geometry.height_px]) - 1) / 2
    for id in PLACES:
        bent_px = truth.frames[0].fiducials[id].center_px
        assert np.abs(centroid(picture, bent_px, 18) - bent_px).max() < 10 * CENTER_PX  # bent within itself, too
        x, y = (bent_px - middle_px) * [0.04, -0.04]
        dx, dy = displaced_mm(x, y)
        moved_px = bent_px - straight.frames[0].fiducials[id].center_px
        # The bed's middle is half a pixel from the scan's, for the origin is the centre of the first pixel.
        np.testing.assert_allclose(moved_px, [dx / 0.04, -dy / 0.04], atol=0.05)


def test_pixels_lead_back_to_the_camera() -> None:
    geometry = frame_geometry(scene(scanner=BENT, images=(replace(OBLIQUE, pose="90"),)), 0)
    camera_mm = np.random.default_rng(1).uniform(-5.5, 5.5, (20, 2))
    np.testing.assert_allclose(geometry.camera_from_scan(geometry.pixel_from_camera(camera_mm)), camera_mm, atol=1e-10)


def test_a_term_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="no term 'c20'"):
        replace(SCANNER, bend_um={"c20": 1.0})


@pytest.mark.parametrize("pose", ["0", "90m"])
def test_film_photographed_by_a_tilted_camera_is_visible_as_a_pinhole_sees_it(tmp_path: Path, pose: str) -> None:
    """The film's points turned about an axis in it and projected, by the collinearity of a pinhole 80 mm away."""
    image = replace(OBLIQUE, pose=pose)
    film = scenes.SceneFilm("projective", tilt_deg=8.0, tilt_direction_deg=30.0, photographed_from_mm=80.0)
    _, truth = rendered(tmp_path, scene(images=(image,), film=film))
    flat = frame_geometry(scene(images=(image,)), 0)
    axis = np.array([-np.sin(np.deg2rad(30.0)), np.cos(np.deg2rad(30.0)), 0.0])
    rotation = cv2.Rodrigues(-np.deg2rad(8.0) * axis)[0]
    for id, place in PLACES.items():
        turned = rotation @ (*(np.asarray(place) * image.film.scale), 0.0) + (0.0, 0.0, 80.0)
        pictured = 80.0 * turned[:2] / turned[2] / image.film.scale
        expected_px = flat.pixel_from_camera(pictured[None])[0]
        np.testing.assert_allclose(truth.frames[0].fiducials[id].center_px, expected_px, atol=1e-6)
    geometry = truth.frames[0].geometry
    camera_mm = np.random.default_rng(1).uniform(-5.5, 5.5, (20, 2))
    np.testing.assert_allclose(geometry.camera_from_scan(geometry.pixel_from_camera(camera_mm)), camera_mm, atol=1e-10)
    summary = json.loads((tmp_path / "truth.json").read_text())["images"][image.name]["transformation"]
    assert {"a1", "b3", "c1", "c2"} < summary.keys()


def test_film_that_a_tilted_camera_photographed_is_projective() -> None:
    with pytest.raises(ValueError, match="projective"):
        scenes.SceneFilm("affine", tilt_deg=2.0)
