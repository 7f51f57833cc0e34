"""The user's files: what is right is read, what is wrong gets a message with file, line and the likely remedy."""

import errno
import hashlib
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from projects import comparator_points, present, write_tables

from measure.fiducials.options import SCATTER_MM, BelievedFilm
from measure.flags import Code, Reason, Status
from measure.marks.shapes import MarkShape, MarkTemplate, Polygon, rotate_mark
from measure.results import Covariance, FrameMeasurement, MarkMeasurement
from pipeline import InputError, read_images, read_points
from pipeline.archive.measure_archive import check_measurable
from pipeline.files.camera_file import camera_text, read_camera
from pipeline.files.mark_table import picture_writer
from pipeline.files.project_file import Project, read_project
from pipeline.provenance import hash_file
from pipeline.rendered.scene_file import read_scene
from pipeline.results import comparator_file, record_json
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.comparator_file import ComparatorPoint, read_comparator, read_pitches, write_comparator
from pipeline.text.files import MOST_MB, RESULT_MB, check_writable, read_bytes, write_atomically
from pipeline.text.toml_tables import read_toml

CAMERA = """
name = "C"
frame_mm = [228.0, 228.0]
principal_distance_mm = 153.0
[sigma]
principal_distance_mm = "free"
principal_point_mm = [0.0, 2.0]
[distortion]
family = "torlegard"
[distortion.sigma]
k3 = "free"
[[fiducial]]
id = "1"
xy_mm = [0.0, 106.0]
sigma_mm = [1.0, "free"]
mark = "side"
[mark.side]
kind = "cross"
arm_mm = 1.0
line_mm = 0.1
gap_mm = 0.5
rotate = "radial"
"""


DRAWN = 'kind = "cross"\narm_mm = 1.0\nline_mm = 0.1\ngap_mm = 0.5'
OTHER = '[[fiducial]]\nid = "2"\n'


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def refused(read: Callable[[Path], object], path: Path, words: Sequence[str]) -> None:
    """With a message that says all these words."""
    with pytest.raises(InputError) as error:
        read(path)
    assert [word for word in words if word not in str(error.value)] == [], error.value


def bare_project(folder: Path, text: str, *files: str) -> Project:
    """Of a camera without fiducials, marks that are given, and empty files."""
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    camera = 'name = "c"\nframe_mm = [24.0, 36.0]\nprincipal_distance_mm = 50.0'
    text, comparator = f'camera = "camera.toml"\n{text}', "image,point,kind,x_mm,y_mm"
    return read_project(write_tables(folder, text, camera=camera, comparator=comparator))


@pytest.mark.parametrize("key", ["pose", "scan_orientation"])
def test_the_scan_orientation_has_two_names(key: str, tmp_path: Path) -> None:
    assert bare_project(tmp_path, f'[measure]\n{key} = "90m"\n').pose == "90m"
    assert bare_project(tmp_path, "[measure]\n").pose == "auto"


def test_a_project_whose_camera_is_unknown_yet_is_refused_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.tif").touch()
    path = written(tmp_path, "project.toml", 'scans = ["a.tif"]\n')
    words = [f"{path}: camera: is missing: no camera is known", "reseau template camera"]
    refused(read_project, path, words)
    refused(read_project, written(tmp_path, "p.toml", 'camra = "c"\nscans = ["a.tif"]\n'), ["rename 'camra'"])


def test_a_folder_whose_name_says_nothing_is_titled_with_the_one_above(tmp_path: Path) -> None:
    assert bare_project(tmp_path / "roll_7" / "out", 'scans = ["a.tif"]', "a.tif").title == "roll_7/out"


def test_what_is_unusual_is_no_mistake(tmp_path: Path) -> None:
    for frame, distance in (("160.0, 160.0", 3437.0), ("40.0, 60.0", 10000.0)):
        path = written(tmp_path, "camera.toml", f'name = "c"\nframe_mm = [{frame}]\nprincipal_distance_mm = {distance}')
        assert read_camera(path).principal_distance_mm == distance
    assert read_camera(written(tmp_path, "camera.toml", f"\ufeff{CAMERA}")).name == "C"


def test_camera_file_gives_priors_and_marks_turned_with_their_place(tmp_path: Path) -> None:
    file = read_camera(written(tmp_path, "camera.toml", CAMERA))
    camera = file.camera()
    priors = (camera.principal_distance_mm, camera.x0_mm, camera.y0_mm)
    assert [prior and prior.sigma for prior in priors] == [math.inf, 0.0, 2.0]
    assert {name: prior.sigma for name, prior in camera.distortion.parameters.items()} == {"k3": math.inf}
    assert camera.fiducials["1"].y_mm.sigma == math.inf
    cross = file.layout().marks[0].mark
    assert isinstance(cross, MarkShape)
    assert len(cross.parts) == 4
    tip = 'kind = "polygon"\nvertices_mm = [[0.0, -1.0], [2.0, 0.0], [0.0, 1.0]]'
    mark = read_camera(written(tmp_path, "camera.toml", CAMERA.replace(DRAWN, tip))).layout().marks[0].mark
    assert isinstance(mark, MarkShape)
    (part,) = mark.parts
    assert isinstance(part, Polygon)
    # The tip points away from the centre of the frame: here up.
    assert any(np.allclose(vertex, (0.0, 2.0)) for vertex in part.vertices_mm)


def test_self_calibration_sets_count_in_halves_of_the_frame(tmp_path: Path) -> None:
    text = CAMERA.replace('"torlegard"', '"legendre(3)"').replace('k3 = "free"', 'all = "free"\na21 = 0.01\na22 = 0')
    distortion = read_camera(written(tmp_path, "camera.toml", text)).distortion
    assert distortion.half_mm == (114.0, 114.0)
    assert len(distortion.parameters) == 26
    sigmas = {name: prior.sigma for name, prior in distortion.parameters.items()}
    assert (sigmas["a21"], sigmas["a22"], sigmas["b33"]) == (0.01, 0.0, math.inf)
    own = text.replace("family =", "half_mm = [100.0, 90.0]\nfamily =")
    camera = read_camera(written(tmp_path, "camera.toml", own))
    assert camera.distortion.half_mm == (100.0, 90.0)
    again = camera_text(camera, picture_writer(tmp_path))
    assert read_camera(written(tmp_path, "again.toml", again)).distortion == camera.distortion


def test_marks_are_turned_with_their_place_and_written_so(tmp_path: Path) -> None:
    chip = 'kind = "template"\nimage = "chip.tif"\npitch_um = 20.0\norigin_px = [3, 4]'
    grey = np.arange(80, dtype=np.uint16).reshape(10, 8)
    tifffile.imwrite(tmp_path / "chip.tif", grey)
    camera = read_camera(written(tmp_path, "camera.toml", CAMERA.replace(DRAWN, chip)))
    again = read_camera(written(tmp_path, "again.toml", camera_text(camera, picture_writer(tmp_path))))
    for each in (camera, again):
        mark = each.fiducials[0].mark
        assert isinstance(mark, MarkTemplate)
        assert (mark.turn_deg, mark.origin_px) == (90.0, (3.0, 4.0))
        np.testing.assert_allclose(np.ptp(mark.image) * grey / 79, mark.image - mark.image.min(), atol=1.0)
    about = DRAWN + "\ntrue_mm = [[-0.5, -1.0], [2.0, 1.0]]"
    camera = read_camera(written(tmp_path, "camera.toml", CAMERA.replace(DRAWN, about)))
    again = read_camera(written(tmp_path, "again.toml", camera_text(camera, picture_writer(tmp_path))))
    for each in (camera, again):
        mark = each.fiducials[0].mark
        assert isinstance(mark, MarkShape)
        np.testing.assert_allclose(present(mark.true_mm), [[-1.0, -0.5], [1.0, 2.0]])  # outwards is up there
        askew = rotate_mark(mark, 30.0)
    assert isinstance(askew, MarkShape)
    scale = 2.0 / (2.0 * 3**0.5 / 2 + 1.25)
    np.testing.assert_allclose(np.ptp(present(askew.true_mm), axis=0), np.array([2.0, 2.5]) * scale)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('family = "torlegard"', 'famly = "torlegard"', ["line 9", "famly", "family"]),
        ('family = "torlegard"', 'family = "torlegaard"', ["line 9", "Did you mean 'torlegard'"]),
        ('family = "torlegard"', "family = 5", ["line 9", 'must be text in quotes, not 5. Write family = "..."']),
        ('family = "torlegard"', 'family = "legendre(1)"', ["line 9", "the order of legendre must be 2 to 9, not 1"]),
        ("frame_mm = [228.0, 228.0]", "frame_mm = 228.0", ["frame_mm", "[x, y]"]),
        ("principal_distance_mm = 153.0", "principal_distance_mm = -153.0", ["greater than 0"]),
        ("principal_distance_mm = 153.0", "principal_distance_mm = 0.153", ["line 4", "impossible", "Give both in mm"]),
        ("xy_mm = [0.0, 106.0]", "xy_mm = [0.0, 106000.0]", ["line 14", "far outside of the frame"]),
        ("[[fiducial]]", f"{OTHER}xy_mm = [0.0, 106.0]\n[[fiducial]]", ["line 17", "'2' has the same place"]),
        ("xy_mm = [0.0, 106.0]", f"xy_mm = [0.0, 0.106]\n{OTHER}xy_mm = [0.1, 0.0]", ["line 14", "within 0.106 mm"]),
        ("arm_mm = 1.0", "arm_mm = 1000", ["line 16", "2000 mm large", "sizes in mm"]),
        (DRAWN, 'kind = "polygon"\nvertices_mm = [[0, 0], [1, 1], [2, 2]]', ["line 19", "encloses no area"]),
        (DRAWN, f"{DRAWN}\ntrue_mm = [[1, 1], [-1, 2]]", ["true_mm", "two corners of the rectangle"]),
        ('mark = "side"', 'mark = "sid"', ["Did you mean 'side'"]),
        ('name = "C"', 'name = "C"\nwriting = ["left: upward"]', ["'left: upward'. A place is a side of the frame"]),
        ('name = "C"', 'name = "C"\nwriting = ["middle"]', ["A place is a side of the frame"]),
        ('name = "C"', 'name = "C"\nnumber = "RC20 13182"', ['digits in quotes, as the plate has them: "13182"']),
        ('name = "C"', 'name = "C"\ndata_strip = "left"', ['writing = ["left: reads upward"]']),
        ("arm_mm = 1.0", "arm_m = 1.0", ["arm_mm", "'arm_m'"]),
        ("gap_mm = 0.5", "gap_mm = 1.5", ["smaller than arm_mm"]),
        ('k3 = "free"', 'k9 = "free"', ["k9", "Known here"]),
        ("[[fiducial]]", '[[fiducial]]\nid = "1"\nxy_mm = [0.0, 1.0]\n[[fiducial]]', ["'1' is given twice"]),
    ],
)
def test_a_mistake_in_a_camera_file_is_named(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in CAMERA
    path = written(tmp_path, "camera.toml", CAMERA.replace(old, new, 1))
    refused(read_camera, path, [str(path), *words])


def test_what_is_missing_for_a_camera_or_a_project_is_reported(tmp_path: Path) -> None:
    text = CAMERA.replace("frame_mm = [228.0, 228.0]\n", "").replace('"torlegard"', '"ebner"')
    halves = "line 8: [distortion] family: ebner counts in halves of the frame"
    remedy = "Give the camera's frame_mm, or half_mm in this table."
    refused(read_camera, written(tmp_path, "camera.toml", text), [halves, remedy])
    tifffile.imwrite(tmp_path / "chip.tif", np.full((20, 20), 90, np.uint8))
    chip = 'kind = "template"\nimage = "chip.tif"\npitch_um = 20\norigin_px = [10, 10]'
    alike = written(tmp_path, "camera.toml", CAMERA.replace(DRAWN, chip))
    refused(read_camera, alike, ["all its pixels are alike"])
    path = written(tmp_path, "camera.toml", 'name = "K"\nprincipal_distance_mm = 60.0\n')
    refused(read_project, path, ['is a camera file. Give the project file, which names it: camera = "camera'])
    path = written(
        tmp_path, "project.toml", "\n".join(f"{key} = 1" for key in ("scans", "output", "exclude", "camera"))
    )
    refused(read_camera, path, [f"{path}: is a file of another kind, with the keys 'scans', 'output'", "'frame_mm'"])
    refused(read_scene, path, ["is a file of another kind", "A scene file (`reseau template scene` prints one)"])
    refused(read_toml, tmp_path / "poject.toml", ["there is no such file", "Did you mean 'project.toml'?"])
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    refused(read_toml, tmp_path / "loop.toml", ["loop.toml"])
    two = written(tmp_path, "camera.toml", CAMERA.replace('name = "C"', 'name = "C"\nlens = 1\nfilm = 2'))
    refused(read_camera, two, ["lens: is no key of this table.\n", "film: is no key of this table. Known"])
    missing = tmp_path / "no.toml"
    for read in (read_toml, read_points):
        refused(read, missing, [str(missing.resolve())])


def test_points_and_orientations_fixed_free_and_unknown(tmp_path: Path) -> None:
    text = "point,X,Y,Z,sX,sY,sZ\n# a comment\n1,\N{MINUS SIGN}1,2,3,0,0.5,\n2,,,7,,,0.02\n"
    points = {point.id: point for point in read_points(written(tmp_path, "points.csv", text)).points}
    sigmas = {id: [axis and axis.sigma for axis in (point.X, point.Y, point.Z)] for id, point in points.items()}
    assert sigmas == {"1": [0.0, 0.5, math.inf], "2": [None, None, 0.02]}
    assert present(points["1"].X).value == -1.0
    text = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,sX0\na.tif,1,2,3,10,20,90,0.1\nb.2,,,,,,,\n"
    images = read_images(written(tmp_path, "images.csv", text))
    exterior = present(images.exterior["a"])
    np.testing.assert_allclose(exterior.values, [1, 2, 3, *np.deg2rad([10, 20, 90])])
    assert exterior.sigmas[0] == 0.1
    assert np.isinf(exterior.sigmas[1:]).all()
    assert images.exterior["b.2"] is None


def test_comparator_coordinates_have_y_up_and_survive_writing(tmp_path: Path) -> None:
    covariance = np.array([[0.0004, 0.0001], [0.0001, 0.0009]])
    marks = (
        MarkMeasurement("1", "fiducial", np.array([100.25, 200.5]), Covariance.from_noise(covariance), Status.MEASURED),
        MarkMeasurement("7", "target", None, None, Status.ABSENT, Reason('outside, "far" off', Code.OUTSIDE)),
    )
    path = tmp_path / "comparator.csv"
    pitch_um = {"#1": (20.0, 10.0)}
    write_comparator(path, comparator_points([FrameMeasurement("#1", marks)], pitch_um), pitch_um)
    first, second = read_comparator(path)
    assert first.image == "#1"  # a line that begins with # would be a comment
    np.testing.assert_allclose(np.asarray(first.xy_mm), [2.005, -2.005], atol=1e-9)
    np.testing.assert_allclose(np.asarray(first.sigma_mm), [0.02 * 0.02, 0.01 * 0.03], rtol=1e-3)
    assert first.rho == pytest.approx(-0.0001 / (0.02 * 0.03), abs=1e-4)  # y is turned round
    assert second.xy_mm is None
    assert second.status is Status.ABSENT
    assert second.reason == 'outside, "far" off'


@pytest.mark.parametrize(
    ("sigma_mm", "rho", "wanted"),
    [((0.01, 0.02), 0.99997, 0.99997), ((0.01, 0.02), -1.0, -1.0 + 1e-7), ((2e-8, 0.02), 0.5, 0.5)],
)
def test_what_is_written_of_a_marks_precision_is_read(
    sigma_mm: tuple[float, float], rho: float, wanted: float, tmp_path: Path
) -> None:
    """Not rounded to a correlation of 1, or a standard deviation of 0."""
    point = ComparatorPoint("f", "1", "target", np.zeros(2), np.array(sigma_mm), rho, Status.MEASURED, "")
    write_comparator(tmp_path / "comparator.csv", [point], {})
    (mark,) = read_comparator(tmp_path / "comparator.csv")
    assert mark.rho == pytest.approx(wanted, abs=1e-9)
    np.testing.assert_allclose(np.asarray(mark.sigma_mm), sigma_mm)


def test_half_a_precision_and_a_pitch_that_is_no_number_are_refused(tmp_path: Path) -> None:
    text = "image,point,x_mm,y_mm,sx_mm,sy_mm\nf,1,2,3,0.1,\n"
    refused(read_comparator, written(tmp_path, "half.csv", text), ["line 2, column sy_mm: is blank", "Give both"])
    pitch = written(tmp_path, "pitch.csv", f"# pitch of f: 1.2.3 µm across, 20 µm down\n{text}")
    refused(read_pitches, pitch, ["line 1: the pitch of f is to be two numbers"])


def test_the_projects_film_is_what_measuring_believes_of_it(tmp_path: Path) -> None:
    film = [bare_project(tmp_path, f"[adjust]\nfilm_sigma_um = {sigma_um}").film for sigma_um in (12.0, 0.0)]
    assert film == [BelievedFilm(0.012, is_stated=True), BelievedFilm(SCATTER_MM)]


def test_a_list_of_pixels_is_read_with_y_up_by_the_pitch(tmp_path: Path) -> None:
    text = "image,point,col_px,row_px,scol_px,srow_px,rho\nf.png,1,100.5,200,0.1,0.2,0.3\n"
    path = written(tmp_path, "comparator.csv", text)
    (mark,) = read_comparator(path, (20.0, 10.0))
    assert (mark.kind, mark.status) == ("target", Status.MEASURED)
    found = [*np.asarray(mark.xy_mm), *np.asarray(mark.sigma_mm), mark.rho]
    np.testing.assert_allclose(found, [2.01, -2.0, 0.002, 0.002, -0.3])
    refused(read_comparator, path, ["Set pitch_um in project.toml"])
    nothing = written(tmp_path, "nothing.csv", "image,point,col_px\nf,1,2\n")
    refused(read_comparator, nothing, ["lacks the columns x_mm, y_mm or col_px, row_px"])
    blank = written(tmp_path, "blank.csv", "image,point,col_px,row_px\nf,1,2,\n")
    refused(lambda path: read_comparator(path, (20.0, 10.0)), blank, ["column col_px: is blank"])


def test_results_of_large_archives_are_larger_than_what_users_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "adjustment.json"
    with path.open("wb") as file:
        file.truncate((MOST_MB + 1) * 1_000_000)  # sparse
    assert hash_file(path) == hashlib.sha256(bytes((MOST_MB + 1) * 1_000_000)).hexdigest()
    with pytest.raises(InputError, match=f"more than {MOST_MB} MB"):
        read_bytes(path)
    assert len(read_bytes(path, RESULT_MB)) == (MOST_MB + 1) * 1_000_000
    written(tmp_path, "comparator.csv", "image,point\n")
    for module, read in ((record_json, read_adjustment), (comparator_file, read_comparator)):
        monkeypatch.setattr(module, "RESULT_MB", 0)
        refused(read, tmp_path / ("comparator.csv" if read is read_comparator else "adjustment.json"), ["than 0 MB"])


def test_writing_is_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, "out.json", "earlier")

    def full(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_atomically(path, "later")
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_trying_whether_a_folder_takes_results_touches_no_file_of_it(tmp_path: Path) -> None:
    (tmp_path / "trial").write_text("the user's own")
    check_writable(tmp_path)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["the user's own"]
    with pytest.raises(InputError, match="trial: cannot be written"):
        check_writable(tmp_path / "trial")


@pytest.mark.parametrize(
    ("said", "names"),
    [
        ('scans = ["box/**/*.tif"]', ["1952/deep/0001", "1952/0001", "1958/0001", "0000"]),
        ('scans = ["box/1952/*.tif"]', ["0001"]),  # in one flat folder the stem
        ('scans = ["box/1952/*.tif", "box/1958/0001.tif"]', ["1952/0001", "1958/0001"]),
        ('scans = ["box/**/*.tif"]\nexclude = ["box/1952/**/*.tif"]', ["1958/0001", "0000"]),
        ('scans = ["box/1952/*.tif", "./box//19*/0001.tif"]', ["1952/0001", "1958/0001"]),  # a file is one, found twice
        (
            'scans = ["box/**/*.tif"]\nexclude = ["box/1952/0001.tif", "no/such.tif"]',
            ["1952/deep/0001", "1958/0001", "0000"],
        ),
    ],
)
def test_images_are_called_by_their_path(tmp_path: Path, said: str, names: list[str]) -> None:
    files = ("box/1952/0001.tif", "box/1952/deep/0001.tif", "box/1958/0001.tif", "box/0000.tif", "box/notes.txt")
    assert set(bare_project(tmp_path, said, *files).scans) == set(names)


def test_images_that_are_left_out_or_called_alike(tmp_path: Path) -> None:
    """One that is neither found nor left out has no scan, and is told so."""
    written(tmp_path, "images.csv", "image\na\nb\nc\n")
    text = 'scans = ["scans/*.tif"]\nexclude = ["scans/b.tif"]\n[object]\nimages = "images.csv"\n[ties]'
    project = bare_project(tmp_path, text, "scans/a.tif", "scans/b.tif")
    assert project.left_out == {"b"}
    assert set(project.scans) == {"a"}
    assert check_measurable(project) == ("a", "c")
    with pytest.raises(InputError, match="have the same name 'a/1'"):
        bare_project(tmp_path, 'scans = ["**/*.*g"]', "a/1.jpg", "a/1.png", "b/1.png")
    with pytest.raises(InputError, match=r"exclude.*leaves no scan of those that scans names"):
        bare_project(tmp_path, 'scans = ["a/*"]\nexclude = ["a/*"]')


@pytest.mark.parametrize(
    ("columns", "said", "reads"),
    [
        ("image", "", "pose"),
        ("image,camera_number", "", "all"),
        ("image,run,date", 'writing = "none"', "none"),
        ("image,camera", 'writing = "all"', "all"),
    ],
)
def test_columns_tell_what_is_read_on_all_scans(tmp_path: Path, columns: str, said: str, reads: str) -> None:
    written(tmp_path, "images.csv", f"{columns}\na{',' * columns.count(',')}\n")
    project = f'scans = ["a.tif"]\n[object]\nimages = "images.csv"\n[measure]\n{said}'
    assert bare_project(tmp_path, project, "a.tif").reads == reads


COMPARATOR = "image,point,kind,x_mm,y_mm\n"
TONE = 'camera = "camera.toml"\n[measure]\ntone = '


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_points, "point,X,Y,Z\n1,1,2,3\n1,4,5,6\n", ["line 3", "'1'", "line 2"]),
        (read_points, "point,X,Y\n1,1,2\n", ["'Z'", "lacks"]),
        (read_points, "point,X,Y,Z,sx\n1,1,2,3,0\n", ["'sx'", "Did you mean 'sX'"]),
        (read_points, "point,X,Y,Z\n1,1,2,3a\n", ["line 2", "column Z", "'3a'"]),
        (read_points, "point,X,Y,Z\n1,1,5,2,0,3,0\n", ["line 2", "7 values", "4 columns", "commas"]),
        (read_points, "point,X,Y,Z\n1,1_000,2,3\n", ["line 2, column X: must be a number", "'1_000'"]),
        (read_points, "point,X,Y,Z,sX,sY,sZ\n1,1,2,3,-1,0,0\n", ["negative"]),
        (read_points, "point,X,Y,Z,sX,sY,sZ\n1,,2,3,1,0,0\n", ["X", "blank"]),
        (read_points, "point,X,Y,Z\n1,1,2,3\n2,4,5", ["line 3", "cut short", "3 of the 4 values"]),
        (read_points, "point;X;Y;Z\n1;1;2;3\n", ["line 1", "semicolons", "commas are needed"]),
        (read_points, "point,X,Y,Z\n", ["no point"]),
        (read_points, "", ["is empty"]),
        (read_points, "p\0o\0i\0n\0t\0,\0X\0", ["is not text in UTF-8"]),  # as of UTF-16 without its mark
        (read_comparator, f"{COMPARATOR}f,1,fiducial,1,2\nf,1,fiducial,3,4", ["line 3", "line 2", "fiducial '1'"]),
        (read_comparator, f"{COMPARATOR}f,1,fidu,1,2", ["'fidu'", "possible are"]),
        (read_comparator, f"{COMPARATOR}f,1,target,,2", ["x_mm", "blank"]),
        (
            read_comparator,
            "image,point,kind,x_mm,y_mm,sx_mm,sy_mm\nf,1,target,1,2,1e-12,1e-12",
            ["sx_mm", "too small", "Leave it blank"],
        ),
        (read_project, f'{TONE}"2.2"', ["tone", "linear", "A number above 0, without quotes"]),
        (read_project, f"{TONE}-1.0", ["tone", "greater than 0"]),
        (read_toml, "k3 = free", ['Text stands in quotes: k3 = "free".']),
        (read_toml, "unit = “m”", ['Quotes are straight here: "...".']),
        (read_toml, "k3 = 1\nk3 = 2", ["given twice: remove one"]),
        (read_toml, "c_mm = 60,5", ["decimal point: 60.5, not 60,5"]),
        (read_toml, "kind = ring-cross  # of the RC8", ['Text stands in quotes: kind = "ring-cross".']),
        (read_toml, "pitch_um = 5 um", ["A number stands without its unit, which the key names: pitch_um = 5."]),
        (read_toml, "frame_mm = [228.0, 228.0", ["Mend that line."]),
    ],
)
def test_a_wrong_table_is_named(read: Callable[[Path], object], text: str, words: list[str], tmp_path: Path) -> None:
    refused(read, written(tmp_path, "table", text), words)
