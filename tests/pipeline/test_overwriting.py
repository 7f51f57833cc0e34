"""No command replaces a file that it did not write itself."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import tifffile
from projects import Refusal, adjusted_project, command, copied, made_record, write_tables

from pipeline import InputError
from pipeline.blocks.block_stage import check_folder as check_block
from pipeline.blocks.block_stage import write_block
from pipeline.calibration.pictures import BoardPictureFiles, CameraPictures
from pipeline.calibration.project_files import CalibrationOptions, board_options, write_project
from pipeline.calibration.project_files import check_folder as check_calibration
from pipeline.files.project_file import read_project
from pipeline.resampling.resample_stage import BEST, resample_tasks
from pipeline.results.comparator_file import read_comparator


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return adjusted_project(tmp_path_factory.mktemp("adjusted"))


@pytest.fixture
def mine(tmp_path: Path) -> Callable[[str], Path]:
    """A file of the user's in a folder."""

    def made(name: str) -> Path:
        path = tmp_path / "out" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
        return path

    return made


def test_scans_are_not_replaced_by_resampled_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_tables(
        tmp_path, 'camera = "camera.toml"', camera='name = "K"\nframe_mm = [80.0, 80.0]', comparator="image,point\n"
    )
    monkeypatch.setattr("pipeline.resampling.resample_stage.current_adjustment", lambda *_: None)
    monkeypatch.setattr("pipeline.resampling.resample_stage.read_comparator", lambda *_: ())
    path = tmp_path / "scans" / "1.tif"
    path.parent.mkdir()
    scan = replace(made_record(1), scan=str(path))
    monkeypatch.setattr("pipeline.resampling.resample_stage.read_measurement", lambda _: [scan])
    project = read_project(tmp_path / "project.toml")
    description = '{"reseau": "1", "x_mm": 0, "y_mm": 0, "pitch_mm": 1}'
    for text in ("mine", description):  # a resampled frame may be a scan, too
        tifffile.imwrite(path, [[1, 2], [3, 4]], dtype="uint8", description=text)
        with pytest.raises(InputError, match="is a scan, or was not written by `reseau resample`"):
            resample_tasks(project, tmp_path / "scans", None, False, BEST)
        assert len(resample_tasks(project, tmp_path / "frames", None, False, BEST)[0]) == 1
    other = replace(scan, scan=str(tmp_path / "other.tif"))
    monkeypatch.setattr("pipeline.resampling.resample_stage.read_measurement", lambda _: [other])
    assert len(resample_tasks(project, tmp_path / "scans", None, False, BEST)[0]) == 1  # an earlier result


@pytest.mark.parametrize(
    "name", ["project.toml", "images.csv", "camera.toml", "a.toml", "a.yaml", "a-ros.yaml", "camera.yaml"]
)
def test_calibrate_writes_over_its_own_files_alone(name: str, mine: Callable[[str], Path]) -> None:
    cameras = tuple(CameraPictures(each, 40, 30, None, (f"{each}1",)) for each in "ab")
    path = mine(name)
    files = {f"{each}1": path.parents[1] / f"{each}1.png" for each in "ab"}
    for file in files.values():
        file.touch()
    pictures = BoardPictureFiles(files, cameras, {})
    with pytest.raises(InputError, match=f"{name}: .* was not written by reseau"):
        check_calibration(path.parent, pictures)
    path.unlink()
    options = CalibrationOptions(board_options("chessboard", "7x5", "20mm"))
    write_project(path.parent, pictures, options, {"a": "opencv4", "b": "opencv4"})
    check_calibration(path.parent, pictures)


def test_block_writes_over_no_comparator_and_images_but_its_own(
    adjusted: Path, tmp_path: Path, mine: Callable[[str], Path]
) -> None:
    project = read_project(copied(adjusted.parent, tmp_path / "p"))
    with pytest.raises(InputError, match=r"comparator\.csv: would be replaced"):
        check_block(project, project.path.parent)
    for name in ("comparator.csv", "images.csv", "pictures/K/f0.png", "colmap.db"):
        path = mine(name)
        with pytest.raises(InputError, match="would be replaced, and was not written by `reseau block`"):
            check_block(project, path.parents[len(Path(name).parts) - 1])
        path.unlink()
    folder = tmp_path / "block"
    folder.mkdir()
    own = write_block(project, folder, read_comparator(project.comparator), {})
    (folder / "pictures").mkdir()
    check_block(project, folder)
    with pytest.raises(InputError, match="or is the project's"):
        check_block(own, folder)


@pytest.mark.parametrize("words", [("export", "csv"), ("import", "opencv")])
def test_files_that_a_user_adds_to_an_export_stay(
    words: tuple[str, str], adjusted: Path, mine: Callable[[str], Path], tmp_path: Path, refusal: Refusal
) -> None:
    arguments: tuple[object, ...] = ("export", adjusted, "csv", tmp_path / "out")
    if words[0] == "import":
        assert command("export", adjusted, "opencv", tmp_path / "opencv") == 0
        arguments = ("import", "opencv", tmp_path / "opencv" / "f0.yml", tmp_path / "out", "--pitch-um", "100")
    for _ in range(2):  # over the earlier one
        assert command(*arguments) == 0
    path = mine("sub/project.toml")
    assert "holds something that is no export of reseau, sub/project.toml" in refusal(*arguments)
    assert path.read_text() == "mine"
