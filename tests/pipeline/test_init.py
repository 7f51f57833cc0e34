"""`reseau init` and `reseau run FOLDER`: what scans there are, and the project that is made of them."""

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from projects import CAMERA, Capture, Printed, Refusal, command, write_project
from range_server import range_server
from real_data import DATA, needs
from studies import parametrize_with_studies
from truth_comparison import compare_frames

from measure import FiducialOptions, Scan, measure_fiducials, open_scan
from measure.fiducials.camera_recognition import CameraResponse, LayoutSearch, Tried
from measure.fiducials.measurement import Coarseness
from measure.flags import Code
from measure.marks.rendering import known_picture
from measure.marks.shapes import FiducialLayout, Mark, MarkShape, Polygon
from measure.scans.metadata import Pitch
from measure.scans.opening import ScanHead, read_head
from pipeline import read_project, stages
from pipeline.archive.scan_groups import Catalogue, Sample, ScanGroup, catalogue, identify_sample, name_cameras
from pipeline.files import library
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.library import library_names, library_path, read_library
from pipeline.measuring.camera_identification import Identification, Trial, drawn_alike
from pipeline.measuring.camera_trials import _alike, _attempts, _trials, identify
from pipeline.rendered.scene_file import render_project
from pipeline.terminal import Reporter

RNG = np.random.default_rng(9)
REPORTS = {name: camera.source.reports for name, camera in read_library().items() if camera.source}


def scan(path: Path, height: int = 60, width: int = 90, **tags: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = RNG.integers(0, 255, (height, width)).astype(np.uint8)
    tifffile.imwrite(path, picture, **{"resolution": (500, 500), "resolutionunit": "CENTIMETER", **tags})
    return path


def no_count(*_: object) -> None:
    """Nobody looks."""


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """Two folders: in one two kinds, a copy, a broken file and what is no scan, in the other one kind, and a picture
    beside its smaller namesake."""
    folder = tmp_path / "box [1]"
    for name in ("0001.tif", "0002.tif", "sub/0001.tif"):
        scan(folder / "1952" / name)
    scan(folder / "1952" / "0003.tif", 61, 89)  # cut by hand
    scan(folder / "1952" / "0004.tif", 120, 90)
    shutil.copy(folder / "1952" / "0002.tif", folder / "1952" / "0002 Kopie.tif")
    (folder / "1952" / "broken.tif").write_bytes(b"II*\0")
    (folder / "1952" / "notes.txt").write_text("by hand")
    (folder / "1952" / ".hidden.tif").write_bytes(b"")
    scan(folder / "1958" / "0001.TIF")
    tifffile.imwrite(folder / "1958" / "0001.tiff", np.zeros((30, 40), np.uint8))
    return folder


def test_files_are_sorted_into_kinds_copies_and_broken_ones(box: Path, tmp_path: Path) -> None:
    counts = list[tuple[str, int, int]]()
    found = catalogue([box], lambda *shown: counts.append(shown))
    assert counts == [("", found.files, found.files)]  # never "0 of"
    kinds = {(group.folder.name, group.head.height_px): [path.name for path in group.paths] for group in found.groups}
    assert kinds == {
        ("1952", 60): ["0001.tif", "0002.tif", "0003.tif"],
        ("1952", 120): ["0004.tif"],
        ("sub", 60): ["0001.tif"],
        ("1958", 60): ["0001.TIF"],
        ("1958", 30): ["0001.tiff"],
    }
    assert found.copies == {box / "1952/0002 Kopie.tif": box / "1952/0002.tif"}
    assert [path.name for path in found.unread] == ["broken.tif"]
    assert found.endings == {".txt": 1}
    assert found.files == 9
    # What tells most files apart is the head and the middle; here nothing but a corner does.
    first = scan(tmp_path / "alike" / "a.tif", 600, 600)
    data = bytearray(first.read_bytes())
    data[-1] ^= 1
    first.with_name("b.tif").write_bytes(data)
    assert catalogue([first.parent], no_count).copies == {}
    (first.parent / "0.tif").symlink_to("b.tif")
    assert catalogue([first.parent], no_count).groups[0].paths == (first, first.with_name("b.tif"))


def identify_camera(
    path: Path, *names: str, plate: Mapping[str, str] | None = None, against: Sequence[str] = (), beside: str = ""
) -> Identification:
    trial = Trial(names, 4, 4, 0.9, 9.0, 0.9, None, None, None, "", 1.0, 1e-9, 20.0)
    contradicted = {name: ["another"] for name in against}
    alike = {name: [beside] for name in names if beside}
    return Identification(path, (trial,) if names else (), {}, (20.0, 20.0), plate or {}, contradicted, alike, REPORTS)


def fake_group(group: ScanGroup, *samples: Identification) -> ScanGroup:
    return replace(group, samples=samples)


def fake_cameras(monkeypatch: pytest.MonkeyPatch, sample: Callable[[ScanGroup], Identification]) -> None:
    """One sample a group, and what it says."""

    def samples(grouped: Catalogue, *_: object) -> Catalogue:
        return replace(grouped, groups=tuple(fake_group(group, sample(group)) for group in grouped.groups))

    monkeypatch.setattr("pipeline.archive.scan_groups.name_cameras", samples)


def test_a_camera_is_known_by_most_samples_and_by_what_its_plate_does_not_contradict(box: Path) -> None:
    group = catalogue([box / "1958"], no_count).groups[0]
    path = group.paths[0]
    alike = identify_camera(path, "wild-rc10-153", "wild-rc10-305", against=["wild-rc10-305"])
    assert fake_group(
        group, alike, identify_camera(path), identify_camera(path, "wild-rc10-153", "wild-rc10-305")
    ).cameras == ("wild-rc10-153",)
    for samples, why in [
        ((identify_camera(path), identify_camera(path)), "no camera stands out in 2 of them"),
        ((alike, identify_camera(path, "zeiss-rmk-a-153")), "not all show the same camera"),
        ((alike, identify_camera(path), identify_camera(path)), "not all show the same camera"),
        ((identify_camera(path, "wild-rc5-153", against=["wild-rc5-153"]),), "the camera's plate in the picture names"),
    ]:
        fake_identification = fake_group(group, *samples)
        assert fake_identification.cameras == ()
        assert why in fake_identification.why_not()
    coarse = replace(identify_camera(path), layouts_coarseness=[Coarseness(um, 313.0) for um in (1000.0, 300.0, 60.0)])
    assert "for 2 of 3 layouts. Scan at 20 µm or finer for all, at 100 µm" in fake_group(group, coarse).why_not()
    form = identify_camera(path, "zeiss-rmk-a-153", beside="arrow-153")
    assert fake_group(group, form).camera == ""
    assert "compare the drawings" in fake_group(group, form).sentence()
    plate = {"camera_type": "Zeiss"}
    assert fake_group(group, replace(form, plate=plate)).camera == "zeiss-rmk-a-153"
    solid, lines = (fake_group(group, identify_camera(path, name)).rests_on_form for name in ("arrow-153", "park-153"))
    assert (solid, lines) == (True, False)
    assert not fake_group(group, replace(identify_camera(path, "arrow-153"), plate=plate)).rests_on_form
    both = fake_group(group, identify_camera(path, "wild-rc30-153", "wild-rc10-153"))
    assert both.camera == "wild-rc10-153"  # by far the more reports
    assert fake_group(group, identify_camera(path), alike, alike).unlike == [path]
    assert not fake_group(group, alike, alike).unlike


@pytest.fixture
def fake_identification(monkeypatch: pytest.MonkeyPatch) -> None:
    """What samples say, by where they stand: those of 1952 are of one camera, all others of none that is known."""

    def sample(group: ScanGroup) -> Identification:
        names = ("wild-rc10-153",) if group.folder.name in ("1952", "sub") else ()
        plate, neighbour = {"camera_number": str(group.head.height_px)}, "arrow-153" * (group.folder.name == "sub")
        return identify_camera(group.paths[0], *names, plate=plate, beside=neighbour)

    fake_cameras(monkeypatch, sample)


@pytest.mark.usefixtures("fake_identification")
def test_the_project_has_each_scans_camera(box: Path, tmp_path: Path, printed: Printed, refusal: Refusal) -> None:
    out = tmp_path / "work" / "first"
    (box / "1952" / "3.tif").symlink_to("0003.tif")  # in `exclude` it would exclude the scan itself
    fake_identification = json.loads(printed("init", box, "--out", out, "--json", code=1))
    project = read_project(out / "project.toml")
    assert sorted(project.scans) == ["0001", "0002", "0003", "0004"]
    assert all(project.image_camera(name).name == "Wild RC10, 153 mm" for name in project.scans)
    lines = (out / "images.csv").read_text().splitlines()
    assert lines[:2] == ["image,camera", "0001,library:wild-rc10-153"]
    assert fake_identification["scans"] == len(lines) - 1 == 4
    observations = fake_identification["needs_a_look"]
    assert len(observations) == 3
    (forms,) = [case for cases in observations.values() for case in cases if str(box / "1952" / "sub") in case]
    assert "perhaps wild-rc10-153, 4 of 4 marks found, but that rests on the form of its marks alone" in forms
    assert "and arrow-153 has marks much like them" in forms
    assert any("broken.tif" in case for cases in observations.values() for case in cases)
    assert any("1958" in case and "no camera stands out" in case for cases in observations.values() for case in cases)
    assert any("Nr 120, 60" in case for cases in observations.values() for case in cases)
    text = (out / "project.toml").read_text()
    assert "# the same bytes as another scan\n" in text
    assert "0002 Kopie.tif" in text
    assert "init writes over nothing" in refusal("init", box, "--out", out)
    assert (out / "project.toml").read_text() == text


@pytest.mark.usefixtures("fake_identification")
def test_scans_are_of_the_camera_drawn(box: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    """The project stands among the scans: what it will write is not taken for one."""
    monkeypatch.chdir(box / "1958")
    assert "have its marks learned" in printed("init", ".", code=1)
    (box / "1958/camera.toml").write_text("frame_mm = [230.0, 230.0]\n")
    scan(box / "1958" / "out" / "learned" / "mark.TIF")
    text = Path("project.toml").read_text()
    assert '\n# camera = "camera.toml"' in text  # no name of a file that is not there
    Path("project.toml").write_text(text.replace("# camera", "camera"))
    project = read_project(Path("project.toml"))
    assert [path.name for path in project.scans.values()] == ["0001.TIF"]  # the larger of two of one name
    assert (box / "1958/images.csv").read_text() == "image,camera\n0001,\n"


def test_of_each_group_in_each_folder_three_are_tried(box: Path) -> None:
    likely = dict[str, tuple[str, ...]]()

    def identified(sample: Sample) -> Identification | str:
        path = sample[0]
        likely[path.name] = sample[1]
        return "cannot be decoded" if path.name == "0004.tif" else identify_camera(path, "wild-rc5-153")

    for number in range(5, 9):
        scan(box / "1952" / f"000{number}.tif")
    found = replace(catalogue([box], no_count), unread={})
    named = name_cameras(found, identified, Reporter(), None)
    tried = {(group.folder.name, group.head.height_px): len(group.samples) for group in named.groups}
    assert tried == {("1952", 60): 3, ("1952", 120): 0, ("sub", 60): 1, ("1958", 60): 1, ("1958", 30): 1}
    samples = next(group.samples for group in named.groups if len(group.paths) > 3)
    assert [sample.scan.name for sample in samples] == ["0001.tif", "0005.tif", "0008.tif"]
    assert named.unread == {box / "1952/0004.tif": "cannot be decoded"}
    assert likely["0005.tif"] == likely["0008.tif"] == ("wild-rc5-153",)


@pytest.mark.usefixtures("fake_identification")
def test_what_a_server_lists_is_inspected_at_as_a_folder_is(box: Path, tmp_path: Path) -> None:
    with range_server(box) as server:
        assert command("init", f"{server.url}/1952/", "--out", tmp_path / "p") == 1  # a broken file
        project = read_project(tmp_path / "p" / "project.toml")
    text = (tmp_path / "p" / "project.toml").read_text()
    assert "broken" not in text
    assert "**" not in text  # servers find nothing by patterns
    assert {name: str(path) for name, path in project.scans.items()} == {
        name: f"{server.url}/1952/{name}.tif" for name in ("0001", "0002", "0003", "0004")
    }
    assert project.image_camera("0001").name == read_library()["wild-rc10-153"].name


@pytest.mark.parametrize(
    ("given", "said"), [("nowhere", "there is no"), ("empty", "no scan there, nor below"), ("only", "none can be read")]
)
def test_what_holds_no_scan_is_reported(given: str, said: str, tmp_path: Path, refusal: Refusal) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "only").mkdir()
    (tmp_path / "only" / "a.tif").write_bytes(b"no scan")
    assert said in refusal("init", tmp_path / given, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert "only/a.tif is a file, and a folder is needed there" in refusal(  # before any scan is opened
        "init", tmp_path / given, "--out", tmp_path / "only" / "a.tif"
    )


def photograph(path: Path, size: tuple[int, int] = (400, 300), board: tuple[int, int] | None = None) -> Path:
    """A picture by a digital camera, with its Exif block; of a chessboard of so many inner corners or of nothing."""
    picture = np.full((size[1], size[0]), 200, np.uint8)
    if board is not None:
        squares = np.indices((board[1] + 1, board[0] + 1)).sum(axis=0) % 2
        cells = np.kron(np.where(squares, 20, 235), np.ones((24, 24))).astype(np.uint8)
        cells = np.pad(cells, 30, constant_values=235)
        turn = cv2.getRotationMatrix2D((cells.shape[1] / 2, cells.shape[0] / 2), 12.0, 0.9)
        turn[:, 2] += (size[0] / 2 - cells.shape[1] / 2, size[1] / 2 - cells.shape[0] / 2)
        picture = np.asarray(cv2.warpAffine(cells, turn, size, flags=cv2.INTER_AREA, borderValue=(200,)), np.uint8)
    exif = Image.Exif()
    exif[271], exif[272] = "Canon", "Canon EOS 80D"
    exif.get_ifd(0x8769)[37386] = 35.0
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, exif=exif, quality=95)
    return path


@pytest.fixture
def drawn_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a small film scan, and a library that has their camera, which all samples show."""
    (tmp_path / "cameras").mkdir()
    camera = f'{CAMERA}[source]\ntext = "drawn for a test"\n'
    (tmp_path / "cameras" / "small.toml").write_text(camera)
    monkeypatch.setattr(library, "FOLDER", tmp_path / "cameras")

    def sample(group: ScanGroup) -> Identification:
        names = () if group.head.camera or group.head.height_px < 100 else ("small",)
        return identify_camera(group.paths[0], *names)

    fake_cameras(monkeypatch, sample)
    folder = write_project(tmp_path / "box", ["a"]).parent
    for name in ("project.toml", "camera.toml"):
        (folder / name).unlink()
    return folder


def test_a_folder_is_measured(drawn_library: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside a film scan of a known camera: a photograph, a scan of no camera, and a broken file. What follows the
    measuring is left out here."""
    monkeypatch.setattr(stages, "run_all", stages.run_measure)
    photograph(drawn_library / "IMG_1.jpg", board=(7, 5))
    scan(drawn_library / "odd.tif")
    (drawn_library / "broken.tif").write_bytes(b"II*\0")
    assert command("run", drawn_library, "--quiet", "--workers", "1") == 1
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "1 of 4 scans can be measured (1 without a camera, 1 by a digital camera, 1 broken)." in captured.out
    assert "1 of 1 scan measured" in captured.out
    steps = [line for line in captured.out.splitlines() if line.startswith("Next: ")]
    assert captured.out.rstrip().splitlines()[-len(steps) :] == steps
    assert len(steps) <= 3
    assert steps[0].startswith(f"Next: edit {drawn_library / 'images.csv'}  # 1 scan without a camera")
    assert steps[1].startswith(f"Next: reseau calibrate {drawn_library} --board")
    assert command("run", drawn_library, "--json", "--workers", "1") in (0, 1)  # the project that stands there
    again = capsys.readouterr()
    assert set(json.loads(again.out)["frames"]) == {"a"}
    assert "1 of 1 scan measured (1 stored already)" in again.err


@pytest.mark.usefixtures("fake_identification")
def test_a_file_name_that_is_no_utf_8_is_refused_before_a_file_is_written(tmp_path: Path, refusal: Refusal) -> None:
    scan(tmp_path / "box" / "1952" / "a.tif")
    os.rename(tmp_path / "box" / "1952" / "a.tif", os.fsencode(tmp_path / "box" / "1952") + b"/b\xfc.tif")
    scan(tmp_path / "box" / "1952" / "a.tif")
    for _ in range(2):
        words = refusal("init", tmp_path / "box", "--out", tmp_path / "work")
        assert "is not text in UTF-8" in words
        assert "xfc.tif" in words or "udcfc.tif" in words
    assert not (tmp_path / "work").exists()


def test_photographs_alone_are_refused(tmp_path: Path, refusal: Refusal) -> None:
    photograph(tmp_path / "p" / "IMG_1.jpg", board=(7, 5))
    message = refusal("run", tmp_path / "p", "--out", tmp_path / "o")
    assert f"reseau calibrate {tmp_path / 'p'} --board 7x5 --square SIZE" in message
    assert "taken by Canon EOS 80D, 35 mm" in message
    assert not (tmp_path / "o").exists()
    assert "--out goes with a folder of scans" in refusal("run", tmp_path / "project.toml", "--out", tmp_path)


def test_photographs_are_known_by_their_exif_and_not_tried_on_the_library(tmp_path: Path) -> None:
    assert read_head(photograph(tmp_path / "a.jpg")).camera == "Canon EOS 80D, 35 mm"
    exif = Image.Exif()
    exif[271], exif[272] = "EPSON", "Perfection V850"
    Image.fromarray(np.full((80, 80), 99, np.uint8)).save(tmp_path / "b.jpg", exif=exif)
    assert read_head(tmp_path / "b.jpg").camera == ""
    assert read_head(scan(tmp_path / "c.tif")).camera == ""
    photograph(tmp_path / "a.jpg", board=(9, 6))
    identified = partial(identify_sample, cameras={}, pitch_um=None, max_pixels=None)
    found = name_cameras(catalogue([tmp_path / "a.jpg"], no_count), identified, Reporter(quiet=True), None)
    (group,) = found.groups
    assert (group.camera, group.board) == ("", "--board 9x6")
    assert group.digital == "taken by Canon EOS 80D, 35 mm"


def test_no_project_without_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    monkeypatch.setattr("pipeline.files.library.read_library", dict)
    scan(tmp_path / "a.tif")
    text = printed("cameras", "--scan", tmp_path, code=1)
    assert "reseau template camera" in text
    assert "reseau init" not in text


def test_scans_that_were_all_tried_have_each_its_own_camera(tmp_path: Path) -> None:
    """Two scans of one size by different cameras are no group that shows none."""
    cameras = {scan(tmp_path / f"{name}.tif"): name for name in ("wild-rc5-153", "zeiss-rmk-a-153")}

    def identified(sample: Sample) -> Identification | str:
        return identify_camera(sample[0], cameras[sample[0]])

    named = name_cameras(catalogue([tmp_path], no_count), identified, Reporter(quiet=True), None)
    assert {group.paths: group.camera for group in named.groups} == {(path,): name for path, name in cameras.items()}


LIBRARY = read_library()
SCENE = resources.files("pipeline").joinpath("templates", "scene.toml").read_text()
RENDERED = "wild-rc10-153"
SEPARATION = re.compile(r"# Separation (.+): ([\d.]+) mm, spread ([\d.]+) \((\d+) reports\)")
SPREADS = {"fairchild": 0.3, "park": 0.35}  # mm, of models whose cameras differ
ENDS = {"left to right": ("5", "6"), "top to bottom": ("7", "8"), "1 to 2": ("1", "2"), "3 to 4": ("3", "4")}


def scene_of(camera: str) -> str:
    """One frame of a library camera."""
    start, end = SCENE.index("[camera]\n"), SCENE.index("[field]\n")
    return SCENE[:start] + f'camera = "library:{camera}"\n' + SCENE[end : SCENE.rindex("[[image]]")]


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of one rendered frame of a library camera, which it names."""
    folder = tmp_path_factory.mktemp("library")
    scene = scene_of(RENDERED).replace("pitch_um = 45.0", "pitch_um = 125.0")
    (folder / "scene.toml").write_text(scene)
    render_project(folder / "scene.toml", folder)
    text = f'camera = "library:{RENDERED}"\nscans = ["scans/*.tif"]\n[measure]\npose = "0"\ntone = "linear"\n'
    (folder / "project.toml").write_text(text)
    return folder / "project.toml"


def test_every_camera_is_listed_and_printed_as_a_file_to_start_from(printed: Printed, tmp_path: Path) -> None:
    listed = {entry["name"]: entry for entry in json.loads(printed("cameras", "--json"))}
    assert tuple(listed) == library_names()
    assert len(listed) >= 20
    assert all(entry["source"] for entry in listed.values())
    assert listed["wild-rc8-153"]["drawn"] == ["1", "2", "3", "4"]
    assert listed["jena-lmk-153"]["drawn"] == []
    table = printed("cameras")
    assert all(name in table for name in listed)
    assert "learned" in table
    (tmp_path / "camera.toml").write_text(printed("cameras", "zeiss-rmk-a-153"))
    camera = read_camera(tmp_path / "camera.toml")
    assert camera.fiducials == LIBRARY["zeiss-rmk-a-153"].fiducials
    assert camera.source == LIBRARY["zeiss-rmk-a-153"].source


@pytest.mark.parametrize("name", library_names())
def test_a_camera_is_typical_and_its_spread_is_one_of_cameras(name: str) -> None:
    """Coordinates against the separations, which the reports give as figures of their own."""
    camera = LIBRARY[name]
    nominal = float(name.rsplit("-", 1)[1])
    assert camera.principal_distance_mm == pytest.approx(nominal, abs=1.2)
    assert 0.0 < camera.principal_distance_sigma_mm < 0.011 * nominal
    sigmas = np.array([one.sigma_mm for one in camera.fiducials])
    assert (sigmas >= 0.005).all()
    reported = camera.source is not None and camera.source.reports
    assert (sigmas < (SPREADS.get(name.split("-")[0], 0.05) if reported else 1.1)).all()
    assert len(camera.fiducials) in (4, 8, 9, 25)
    places = {one.id: np.array(one.xy_mm) for one in camera.fiducials}
    for words, mm, spread, _ in SEPARATION.findall(library_path(name).read_text()):
        first, second = (places[id] for id in ENDS[words])
        assert np.hypot(*(first - second)) == pytest.approx(float(mm), abs=max(0.02, 1.5 * float(spread)))


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("wild-rc8", "'wild-rc8-153'"),
        ("wild-rc10", "'wild-rc10-153' or 'wild-rc10-214'"),
        ("wild-rc9-87", "'wild-rc9-88'"),
        ("Wild RC9", "'wild-rc9-88'"),
    ],
)
def test_a_misspelt_camera(name: str, near: str, tmp_path: Path, refusal: Refusal) -> None:
    (tmp_path / "project.toml").write_text(f'output = "out"\ncamera = "library:{name}"\n')
    message = refusal("measure", tmp_path / "project.toml")
    assert f"project.toml, line 2: camera: the camera library has no '{name}'. Did you mean {near}" in message
    assert "`reseau cameras`" in message
    assert near in refusal("cameras", name)


@pytest.mark.parametrize("words", [["wild-rc9-88", "wild-rc8-153"], ["wild-rc9-88", "--json"], ["--pitch", "20"]])
def test_options_that_do_not_go_together(words: list[str], refusal: Refusal) -> None:
    assert "give NAME alone" in refusal("cameras", *words)


def test_images_may_name_a_camera_and_a_folder_without_scans_is_reported(tmp_path: Path, refusal: Refusal) -> None:
    (tmp_path / "images.csv").write_text("image,camera\na,library:wild-rc9-88\nb,\n")
    (tmp_path / "comparator.csv").write_text("image,point,kind,x_mm,y_mm\n")
    text = 'camera = "library:wild-rc8-153"\n[object]\nimages = "images.csv"\n'
    (tmp_path / "project.toml").write_text(text)
    project = read_project(tmp_path / "project.toml")
    assert [project.image_camera(name).name for name in "ab"] == ["Wild RC9, 88 mm", "Wild RC8, 153 mm"]
    assert "no scan there, nor below" in refusal("cameras", "--scan", tmp_path)


def test_a_frame_of_a_library_camera_is_measured_right(frame: Path) -> None:
    """All drawn marks within a tenth of a pixel of the truth; those that are not drawn are passed over. The marks are
    weak, since the edge of their pads, which is not drawn, counts as damage."""
    assert command("measure", frame) == 1
    (compared,) = compare_frames(frame.parent)
    assert compared.observed["fiducial"] == 4
    assert compared.wrong == []
    assert np.abs(compared.errors_px).max() < 0.1
    assert (frame.parent / "comparator.csv").read_text().count(",fiducial,") == 4


def test_marks_of_unknown_shape_are_learned_and_not_from_one_scan_alone(frame: Path, refusal: Refusal) -> None:
    other = frame.with_name("other.toml")
    other.write_text(frame.read_text().replace(RENDERED, "jena-lmk-153"))
    assert "jena-lmk-153.toml: the marks are to be learned, and with one scan nothing" in refusal("measure", other)
    camera = LIBRARY["jena-lmk-153"]
    assert len(camera.learned) == 8
    # A template's origin lies somewhere on its mark, of which the reports know nothing.
    assert all(fiducial.x_mm.sigma > 1.0 for fiducial in camera.camera().fiducials.values())


def trial(cameras: tuple[str, ...], score: float, chance: float | None = 0.0) -> Trial:
    return Trial(cameras, 4, 4, 0.9, 10.0, score, chance, 1.0, 0.01, "", 2.0, 1e-6)


@dataclass
class FakeSearch:
    """Search whose expected numbers of false alarms are given, by the number of marks of a layout."""

    expected: Mapping[int, float]
    tried: list[int] = field(default_factory=list)

    def try_any_pitch(self, layout: FiducialLayout) -> Tried:
        self.tried.append(len(layout.marks))
        answer = CameraResponse(self.expected.get(len(layout.marks), np.inf), ())
        return Tried(layout, layout, cast(Scan, None), [], 0, answer)

    def refine(self, tried: Tried) -> Tried:
        return tried


def test_without_a_pitch_lattices_come_first_and_end_the_search_if_most_of_one_is_found() -> None:
    layouts = {names: LIBRARY[names[0]].layout() for names in _alike(LIBRARY)}
    search = FakeSearch({25: 1e-4, 9: 0.5})  # the réseau's 25 crosses, the register glass's nine
    attempts = _attempts(cast(LayoutSearch, search), layouts, {}, None, no_count)
    first = next(attempts)
    assert {*search.tried} == {25, 9}
    standing = trial(("hasselblad-reseau-60",), 0.3)
    assert first.is_last([replace(standing, found=13, drawn=25)])
    assert not first.is_last([replace(standing, found=12, drawn=25)])
    assert not first.is_last([replace(standing, found=13, drawn=25, expected=0.02)])
    assert next(attempts).tries.keys() == layouts.keys()
    faint = FakeSearch({25: 0.02})
    assert next(_attempts(cast(LayoutSearch, faint), layouts, {}, None, no_count)).tries.keys() == layouts.keys()


def test_marks_of_a_negative_that_is_not_significant_are_not_measured() -> None:
    """It would not end the search. The search of the test cannot measure anything."""
    search, layout = cast(LayoutSearch, FakeSearch({4: 0.02})), LIBRARY["wild-rc5-153"].layout()
    last = [*_attempts(search, {("wild-rc5-153",): layout}, {}, None, no_count)][-1]
    assert last.is_negative
    (tried,) = _trials(search, last.tries, last.most, no_count)
    assert tried.reason == "not measured: 0.02 false alarms expected in such a scan"


def test_marks_finer_than_the_pixels_are_not_those_of_a_camera(tmp_path: Path) -> None:
    """Diagonal crosses as far apart as they should be, at 600 µm a pixel, but with lines five times too wide."""
    few = {"wild-rc5-153": LIBRARY["wild-rc5-153"]}
    grey = np.random.default_rng(1).normal(150.0, 4.0, (400, 400))
    for mark in few["wild-rc5-153"].layout().marks:
        column, row = np.rint(200.0 + np.array([1.0, -1.0]) * mark.xy_mm / 0.6).astype(int)
        for step in (-2, -1, 1, 2):
            grey[row + step, column + step] = grey[row - step, column + step] = 230.0
    tifffile.imwrite(tmp_path / "coarse.tif", grey.clip(0, 255).astype(np.uint8))
    found = identify(tmp_path / "coarse.tif", few, None, Reporter(quiet=True))
    assert found.best == ()
    assert found.trials[0].reason == "too coarse: the finest detail of its marks would be 0.20 px wide there"
    # Lines of 0.12 mm in a frame of 228 mm that fills 400 px.
    assert "too coarse: at 570 µm a pixel the finest detail" in found.sentence()
    assert "Scan at 40 µm or finer" in found.sentence()
    named = replace(found, trials=(trial(("wild-rc5-153",), 0.9),))
    assert "too coarse" not in named.sentence()


def test_a_negative_names_its_camera(tmp_path: Path) -> None:
    """Dark ring crosses on a lighter ground, of a camera whose file draws light ones."""
    places = [(-50.0, -50.0), (50.0, -50.0), (-50.0, 50.0), (50.0, 44.0)]
    fiducials = (f"{{id = '{id}', xy_mm = {list(xy)}, sigma_mm = 0.01, mark = 'm'}}" for id, xy in enumerate(places))
    shape = "kind = 'ring-cross'\nring_mm = 4.0\nring_line_mm = 1.25\narm_mm = 8.0\nline_mm = 1.25\npolarity = 'light'"
    file = tmp_path / "camera.toml"
    file.write_text(
        f"name = 'Big'\nframe_mm = [120.0, 120.0]\nfiducial = [{', '.join(fiducials)}]\n[mark.m]\n{shape}\n"
    )
    grey = np.random.default_rng(1).normal(160.0, 4.0, (528, 528))
    for x, y in places:
        column, row = round(264 + x / 0.25), round(264 - y / 0.25)
        cv2.circle(grey, (column, row), 16, 110.0, 5)
        cv2.line(grey, (column - 32, row), (column + 32, row), 110.0, 5)
        cv2.line(grey, (column, row - 32), (column, row + 32), 110.0, 5)
    cv2.imwrite(str(tmp_path / "a.png"), cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.uint8))
    found = identify(tmp_path / "a.png", {"big": read_camera(file)}, 250.0, Reporter(quiet=True))
    assert found.best_names() == ("big",), found.trials
    assert "a negative of their drawings" in found.sentence()


def test_what_an_identification_says_of_chance_pitch_and_close_cameras() -> None:
    found = Identification(Path("a.tif"), (trial(("a",), 0.5, 0.3), trial(("b",), 0.0, None)))
    assert found.best == ()
    assert "no camera of the library stands out" in found.sentence()
    assert found.best_names() == ()
    view = replace(trial(("a",), 0.8), expected=math.inf, pixel_um=127.3)
    right = Identification(Path("a.tif"), (view,), pitch_um=(126.0, 128.0))
    assert "um" not in right.sentence()
    wrong = replace(right, pitch_um=(63.5, 63.5))
    assert "only if a pixel measures 127.3 µm, not 63.5" in wrong.sentence()
    found = Identification(Path("a.tif"), (trial(("a", "b"), 0.9), trial(("c",), 0.85), trial(("d",), 0.4)))
    assert found.best_names() == ("a", "b", "c")
    assert "c comes close with 0.85" in found.sentence()
    without_report = replace(found, unreported={"c": "made from one frame", "d": "nobody knows"})
    assert without_report.sentence().endswith("c rests on no calibration report: made from one frame.")


@pytest.mark.parametrize(
    ("camera", "pixel_um", "named"),
    [("wing-large-flat-153", 45.1, True), ("wing-large-flat-153", 210.0, False), ("wild-rc10-153", 210.0, True)],
)
def test_solid_marks_name_no_camera_against_the_pitch(camera: str, pixel_um: float, named: bool) -> None:
    """Crosses do: then the file's pitch is wrong."""
    best = replace(trial((camera,), 0.8), pixel_um=pixel_um)
    sample = Identification(Path("a.tif"), (best,), pitch_um=(45.0, 45.0))
    group = ScanGroup(Path(), ScanHead("TIFF", 9, 9, 1, 8, Pitch((45.0, 45.0))), (Path("a.tif"),), (sample,))
    assert group.camera == (camera if named else "")
    assert named or "contradict the file's pitch" in group.why_not()
    solid = {"wing-large-flat-153"} & {camera}
    alone = replace(sample, solid=solid)
    assert alone.names_by_plate() == ([camera] if named else [])
    assert named or "no camera is named: perhaps wing-large-flat-153, 4 of 4 marks" in alone.sentence()


def test_wings_of_much_the_same_form_are_reported_next_to_a_name_that_rests_on_them() -> None:
    layouts = {names: LIBRARY[names[0]].layout() for names in _alike(LIBRARY)}
    alike = drawn_alike(layouts)
    assert "fairchild-k17-small-flat-153" in alike["fairchild-k17-curved-flat-305"]
    assert "fairchild-t12-notch-152" in alike["fairchild-t11-notch-153"]
    assert "wing-hollow-153" not in alike
    assert RENDERED not in alike  # its marks are lines
    found = Identification(Path("a.tif"), (trial(("a",), 0.9), trial(("c",), 0.4)), alike={"a": ("b", "d")})
    assert found.sentence().endswith(
        " That rests on the form of its marks alone, and b or d has marks much like them: compare the drawings."
    )
    assert "form of its marks" not in replace(found, alike={"c": ("a",)}).sentence()


Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

GALLERY = DATA / "mark_gallery"
MM_A_PIXEL = 0.0320
HALF_PX, SEARCH_PX, RIM_PX = 140, 9, 8
DOTS = {"1": (304, 1606), "2": (1617, 301), "3": (304, 301), "4": (1617, 1606)}
DOTS |= {"5": (304, 953), "6": (1617, 953), "7": (960, 301), "8": (960, 1606)}
SEEN = [
    ("small_flat_wing", "fairchild-k17-small-flat-153", "5678", 0.75),
    ("tall_flat_wing", "fairchild-k17-tall-flat-153", "5678", 0.7),
    ("curved_flat_wing", "fairchild-k17-curved-flat-153", "5678", 0.7),
    ("large_flat_wing", "wing-large-flat-153", "5678", 0.75),
    ("curved_wing", "wing-curved-153", "5678", 0.6),
    ("hollow_wing", "wing-hollow-153", "678", 0.5),
    ("fairchild_t11_notch", "fairchild-t11-notch-153", "678", 0.65),
    ("fairchild_t12_notch", "fairchild-t12-notch-152", "5678", 0.65),
    ("fairchild_t11_check", "fairchild-t11-check-153", "567", 0.85),
    ("fairchild_t12_cross", "fairchild-t12-cross-152", "56", 0.4),
    ("kc6a", "fairchild-kc6a-152", "5678", 0.7),
    ("t5_notch", "fairchild-t5-153", "5678", 0.65),
    ("arrow", "arrow-153", "5678", 0.65),
    ("park_crosshair", "park-153", "12345678", 0.65),
    ("wild_all_cross", "wild-rc8-eight-153", "12345678", 0.65),
    ("wild_mid_crosshair", "wild-rc10-eight-153", "12345678", 0.65),
    ("zeiss_corner", "zeiss-rmk-a-eight-153", "1234", 0.6),
]


def place_of_dot(picture: Picture, near: tuple[int, int]) -> Array:
    """(column, row) of the middle of the red dot about there."""
    col, row = near
    part = picture[row - 25 : row + 26, col - 25 : col + 26].astype(float)
    rows, cols = np.nonzero((part[..., 2] > 180) & (part[..., :2].max(axis=2) < 90))
    return np.array([col - 25 + cols.mean(), row - 25 + rows.mean()])


def likeness(picture: Picture, mark: Mark, dot: Array) -> float:
    """The largest correlation with the drawing within a third of a millimetre of the dot, about what is drawn; what is
    red is not asked."""
    first = np.rint(dot).astype(int) - HALF_PX - SEARCH_PX
    size = 2 * HALF_PX + 1
    matrix = np.column_stack([np.diag([1.0, -1.0]) / MM_A_PIXEL, dot - first - SEARCH_PX])
    drawn = known_picture(mark, matrix, size, size, 1.5)
    rows, cols = np.nonzero(np.nan_to_num(drawn) > 0.05)
    box = np.s_[max(rows.min() - RIM_PX, 0) : rows.max() + RIM_PX, max(cols.min() - RIM_PX, 0) : cols.max() + RIM_PX]
    beyond = HALF_PX + SEARCH_PX
    padded = cv2.copyMakeBorder(picture, beyond, beyond, beyond, beyond, cv2.BORDER_CONSTANT)
    best = 0.0
    for down in range(0, 2 * SEARCH_PX + 1, 3):
        for right in range(0, 2 * SEARCH_PX + 1, 3):
            row, col = first[1] + beyond + down, first[0] + beyond + right
            window = padded[row : row + size, col : col + size][box].astype(float)
            red = (window[..., 2] > 1.5 * window[..., 1] + 30).astype(np.uint8)
            known = ~np.isnan(drawn[box]) & (cv2.dilate(red, np.ones((5, 5), np.uint8)) == 0)
            best = max(best, abs(float(np.corrcoef(drawn[box][known], window.min(axis=2)[known])[0, 1])))
    return best


@needs("mark_gallery")
@parametrize_with_studies(("name", "camera", "marks", "least"), SEEN, quick=(6, 9, 11, 12))
def test_a_drawing_resembles_the_real_mark(name: str, camera: str, marks: str, least: float) -> None:
    picture = np.asarray(cv2.imread(str(GALLERY / f"{name}.png")))
    given = {mark.id: mark.mark for mark in LIBRARY[camera].layout().marks}
    like = {id: round(likeness(picture, given[id], place_of_dot(picture, DOTS[id])), 2) for id in marks}
    assert min(like.values()) > least, like


DRAWN = [names[0] for names in _alike(LIBRARY) if names[0] != "hasselblad-reseau-60"]


def scene_text(name: str) -> str:
    """One frame, in a scan that holds the marks beyond its edge. Light lines stand on pads; what is solid or dark has
    none, for it could not be seen there; what is dark beside the frame stands in exposed pockets."""
    layout = LIBRARY[name].layout()
    marks = [each.mark for each in layout.marks]
    solid = any(isinstance(part, Polygon) for mark in marks if isinstance(mark, MarkShape) for part in mark.parts)
    pad_mm = 0.0 if solid or any(mark.polarity == "dark" for mark in marks) else 3.0
    neighbour = min(max(map(abs, each.xy_mm)) for each in layout.marks) > max(layout.frame_mm) / 2
    pocket_mm = 6.0 if neighbour and all(mark.polarity == "dark" for mark in marks) else 0.0
    scene = scene_of(name)
    drawn = (("pad_mm", 1.9, pad_mm), ("pocket_mm", 0.0, pocket_mm))
    for key, old, new in (("pitch_um", 45.0, 125.0), ("margin_mm", 3.0, 9.0), *drawn):
        assert f"{key} = {old}" in scene
        scene = scene.replace(f"{key} = {old}", f"{key} = {new}")
    return scene


@pytest.mark.study
@pytest.mark.parametrize("name", DRAWN)
def test_a_drawn_camera_is_found_among_all(name: str, tmp_path: Path) -> None:
    """Rendered with another code, turned by half a degree, at 125 um."""
    (tmp_path / "scene.toml").write_text(scene_text(name))
    render_project(tmp_path / "scene.toml", tmp_path)
    (scan,) = (tmp_path / "scans").glob("*.tif")
    found = identify(scan, LIBRARY, None, Reporter())
    assert name in [each for trial in found.best for each in trial.cameras], found.sentence()


def test_the_wild_camera_with_eight_ringed_marks_has_corners_and_sides_of_others() -> None:
    """Ringed corners of one sibling, ringed sides of another; both have siblings with plain crosses there."""
    place, drawn = np.column_stack([np.diag([20.0, -20.0]), [50.0, 50.0]]), dict[tuple[str, str], Array]()
    names = [f"wild-{name}-153" for name in ("rc10-ringed", "rc10", "rc10-eight", "rc8-eight")]
    xy_mm = dict[tuple[str, str], Array]()
    for name in names:
        for mark in LIBRARY[name].layout().marks:
            drawn[name, mark.id] = known_picture(mark.mark, place, 101, 101, 1.0)
            xy_mm[name, mark.id] = np.array(mark.xy_mm)
    for id in "12345678":
        ringed, plain = (names[1], names[2]) if id in "1234" else (names[2], names[3])
        like = [np.corrcoef(drawn[names[0], id].ravel(), drawn[name, id].ravel())[0, 1] for name in (ringed, plain)]
        assert like[0] > 0.9 > 0.8 > like[1], (id, like)
        assert np.abs(xy_mm[names[0], id] - xy_mm[names[2], id]).max() < 0.01


@needs("film_scans", "aerial")
def test_notches_that_much_of_the_reduced_scan_resembles_are_no_false_alarm() -> None:
    """At full resolution few of these places answer as strongly."""
    layout = LIBRARY["zeiss-rmk-a-153"].layout()
    with open_scan(DATA / "film_scans" / "aerial" / "0b4cb981.jpeg") as scan:
        frame = measure_fiducials(scan, layout, None, FiducialOptions(pose="180"))
    assert sum(mark.status.is_observation for mark in frame.marks) == 4
    assert not any(Code.CHANCE in problem.codes for problem in frame.problems)


def test_one_thread_of_opencv_identifies_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second one takes memory for windows and networks of its own, and saves no CPU time."""
    threads, path = list[int](), tmp_path / "grey.png"
    cv2.imwrite(str(path), np.full((40, 40), 99, np.uint8))

    def no_layouts(_: Mapping[str, CameraFile]) -> list[tuple[str, ...]]:
        threads.append(cv2.getNumThreads())
        return []

    monkeypatch.setattr("pipeline.measuring.camera_trials._alike", no_layouts)
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        identify(path, {}, None, Reporter())
        assert (threads, cv2.getNumThreads()) == ([1], 2)
    finally:
        cv2.setNumThreads(before)
