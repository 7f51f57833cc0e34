"""`reseau init` and `reseau run FOLDER`: what scans there are, and the project that is made of them."""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image
from projects import CAMERA, Capture, Printed, Refusal, command, write_project
from range_server import range_server

from measure.scans.opening import read_head
from pipeline import read_project, stages
from pipeline.archive import new_project
from pipeline.archive.scan_groups import Catalogue, Sample, ScanGroup, catalogue, identify_sample, name_cameras
from pipeline.files import library
from pipeline.files.library import read_library
from pipeline.measuring.camera_identification import Identification, Trial
from pipeline.progress import Reporter

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
    found = catalogue([box], no_count)
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

    monkeypatch.setattr(new_project, "name_cameras", samples)


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
    fake_identification = json.loads(printed("init", box, "--out", out, "--json", code=1))
    project = read_project(out / "project.toml")
    assert sorted(project.scans) == ["0001", "0002", "0003", "0004"]
    assert all(project.image_camera(name).name == "Wild RC10, 153 mm" for name in project.scans)
    lines = (out / "images.csv").read_text(encoding="utf-8").splitlines()
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
    text = (out / "project.toml").read_text(encoding="utf-8")
    assert "# the same bytes as another scan\n" in text
    assert "0002 Kopie.tif" in text
    assert "init writes over nothing" in refusal("init", box, "--out", out)
    assert (out / "project.toml").read_text(encoding="utf-8") == text


@pytest.mark.usefixtures("fake_identification")
def test_scans_are_of_the_camera_drawn(box: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed) -> None:
    """The project stands among the scans: what it will write is not taken for one."""
    monkeypatch.chdir(box / "1958")
    assert "have its marks learned" in printed("init", ".", code=1)
    (box / "1958/camera.toml").write_text("frame_mm = [230.0, 230.0]\n", encoding="utf-8")
    scan(box / "1958" / "out" / "learned" / "mark.TIF")
    text = Path("project.toml").read_text(encoding="utf-8")
    assert '\n# camera = "camera.toml"' in text  # no name of a file that is not there
    Path("project.toml").write_text(text.replace("# camera", "camera"), encoding="utf-8")
    project = read_project(Path("project.toml"))
    assert [path.name for path in project.scans.values()] == ["0001.TIF"]  # the larger of two of one name
    assert (box / "1958/images.csv").read_text(encoding="utf-8") == "image,camera\n0001,\n"


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
    text = (tmp_path / "p" / "project.toml").read_text(encoding="utf-8")
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


def photograph(path: Path, size: tuple[int, int] = (640, 480), board: tuple[int, int] | None = None) -> Path:
    """A picture by a digital camera, with its Exif block; of a chessboard of so many inner corners or of nothing."""
    picture = np.full((size[1], size[0]), 200, np.uint8)
    if board is not None:
        squares = np.indices((board[1] + 1, board[0] + 1)).sum(axis=0) % 2
        cells = np.kron(np.where(squares, 20, 235), np.ones((40, 40))).astype(np.uint8)
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
    (tmp_path / "cameras" / "small.toml").write_text(camera, encoding="utf-8")
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
    assert "1 of 1 scan measured (1 in earlier runs)" in again.err


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


def test_no_project_is_offered_with_cameras_where_none_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
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
