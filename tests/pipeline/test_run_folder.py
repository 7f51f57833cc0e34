"""`reseau run FOLDER`: a folder of film scans to a result by one command, and what is left to decide."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_project import CAMERA, write_project
from PIL import Image
from test_init import identify_camera, scan

from measure.boards.find import recognise_board
from measure.scans.opening import open_scan, read_head
from pipeline import stages
from pipeline.archive import new_project
from pipeline.archive.scan_groups import GroupedScans, Sample, catalogue, group_scans, name_cameras, trial_of_cameras
from pipeline.cli import run
from pipeline.files import library
from pipeline.files.library import read_library
from pipeline.measuring.camera_identification import Identification
from pipeline.progress import Reporter

SAID = pytest.CaptureFixture[str]


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
    cameras = tmp_path / "cameras"
    cameras.mkdir()
    source = '[source]\ntext = "drawn for a test"\n'
    (cameras / "small.toml").write_text(f"{CAMERA}{source}", encoding="utf-8")
    monkeypatch.setattr(library, "FOLDER", cameras)

    def samples(grouped: GroupedScans, *_: object) -> GroupedScans:
        groups = []
        for group in grouped.groups:
            names = () if group.head.camera or group.head.height_px < 100 else ("small",)
            groups.append(replace(group, samples=(identify_camera(group.paths[0], *names),)))
        return replace(grouped, groups=tuple(groups))

    monkeypatch.setattr(new_project, "name_cameras", samples)
    folder = tmp_path / "box"
    write_project(folder, ["a"])
    (folder / "project.toml").unlink()
    (folder / "camera.toml").unlink()
    return folder


def test_a_folder_is_measured_by_one_command_and_by_the_same_again(
    drawn_library: Path, capsys: SAID, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a film scan of a known camera: a photograph, a scan of no camera, and a broken file. What follows the
    measuring is left out here."""
    monkeypatch.setattr(stages, "run_all", stages.run_measure)
    photograph(drawn_library / "IMG_1.jpg", board=(7, 5))
    scan(drawn_library / "odd.tif")
    (drawn_library / "broken.tif").write_bytes(b"II*\0")
    assert run(["run", str(drawn_library), "--quiet", "--workers", "1"]) == 1
    captured = capsys.readouterr()
    assert captured.err == ""
    assert (
        "4 files examined: 1 of 4 scans can be measured (1 without a camera, 1 by a digital camera, 1 broken)."
        in captured.out
    )
    assert "1 of 1 scan measured" in captured.out
    steps = [line for line in captured.out.splitlines() if line.startswith("Next: ")]
    assert captured.out.rstrip().splitlines()[-len(steps) :] == steps
    assert len(steps) <= 3
    assert steps[0].startswith(f"Next: edit {drawn_library / 'images.csv'}  # 1 scan without a camera")
    assert steps[1].startswith(f"Next: reseau calibrate {drawn_library} --board")
    assert run(["run", str(drawn_library), "--json", "--workers", "1"]) in (0, 1)  # the project that stands there
    again = capsys.readouterr()
    assert set(json.loads(again.out)["frames"]) == {"a"}
    assert "1 of 1 scan measured already" in again.err


def test_a_folder_of_photographs_alone_is_refused_with_the_command_that_takes_it(tmp_path: Path, capsys: SAID) -> None:
    photograph(tmp_path / "p" / "IMG_1.jpg", board=(7, 5))
    assert run(["run", str(tmp_path / "p"), "--out", str(tmp_path / "o")]) == 2
    message = capsys.readouterr().err
    assert f"reseau calibrate {tmp_path / 'p'} --board 7x5 --square SIZE" in message
    assert "taken by Canon EOS 80D, 35 mm" in message
    assert not (tmp_path / "o").exists()


def test_out_needs_a_folder(tmp_path: Path, capsys: SAID) -> None:
    assert run(["run", str(tmp_path / "project.toml"), "--out", str(tmp_path)]) == 2
    assert "--out goes with a folder of scans" in capsys.readouterr().err


def test_a_photograph_is_known_by_its_exif_and_no_scan_is(tmp_path: Path) -> None:
    assert read_head(photograph(tmp_path / "a.jpg")).camera == "Canon EOS 80D, 35 mm"
    exif = Image.Exif()
    exif[271], exif[272] = "EPSON", "Perfection V850"
    Image.fromarray(np.full((80, 80), 99, np.uint8)).save(tmp_path / "b.jpg", exif=exif)
    assert read_head(tmp_path / "b.jpg").camera == ""
    assert read_head(scan(tmp_path / "c.tif")).camera == ""


@pytest.mark.parametrize(("board", "words"), [((9, 6), "--board 9x6"), ((5, 7), "--board 7x5"), (None, "")])
def test_a_chessboard_is_recognised_with_its_count(board: tuple[int, int] | None, words: str, tmp_path: Path) -> None:
    with open_scan(photograph(tmp_path / "a.jpg", board=board)) as picture:
        assert recognise_board(picture) == words


def test_photographs_and_pictures_of_boards_are_not_tried_on_the_library(tmp_path: Path) -> None:
    photograph(tmp_path / "a.jpg", board=(9, 6))
    identified = trial_of_cameras({}, None, None)
    found = name_cameras(group_scans([tmp_path / "a.jpg"], lambda *_: None), identified, Reporter(quiet=True), None)
    (group,) = found.groups
    assert (group.camera, group.board) == ("", "--board 9x6")
    assert group.digital == "taken by Canon EOS 80D, 35 mm"


def test_at_most_three_candidates_are_named_with_what_tells_them_apart(tmp_path: Path) -> None:
    """Four samples show four sets of cameras, a dozen in all."""
    for number in range(4):
        scan(tmp_path / f"{number}.tif")
    names = sorted(read_library())
    (group,) = catalogue([tmp_path], lambda *_: None).groups
    samples = tuple(identify_camera(path, *names[3 * n : 3 * n + 3]) for n, path in enumerate(group.paths))
    group = replace(group, samples=samples)
    assert len(group.candidates) == 3
    assert group.why_not().count(" in 1") == 3
    (line,) = new_project._candidate_lines(["wild-rc8-153"])
    assert line.strip() == (
        "wild-rc8-153: frame 228 x 228 mm, c 152.4 mm, 4 corner and 4 side marks, 393 USGS calibration reports, "
        "99 cameras"
    )


def test_scans_that_were_all_tried_have_each_its_own_camera(tmp_path: Path) -> None:
    """Two scans of one size by different cameras are no group that shows none."""
    for number in range(2):
        scan(tmp_path / f"{number}.tif")

    def identified(sample: Sample) -> Identification | str:
        path = sample[0]
        return identify_camera(path, "wild-rc5-153" if path.stem == "0" else "zeiss-rmk-a-153")

    found = catalogue([tmp_path], lambda *_: None)
    named = name_cameras(GroupedScans(found.groups, {}), identified, Reporter(quiet=True), None)
    assert {(group.camera, *(path.stem for path in group.paths)) for group in named.groups} == {
        ("wild-rc5-153", "0"),
        ("zeiss-rmk-a-153", "1"),
    }
