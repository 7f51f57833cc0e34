"""What is written on the frames, through the files: frames.csv, images.csv, the camera's file, a roll's poses."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from projects import command, fiducial_tables, present
from rich.console import Console

from measure.annotations import text as networks_module
from measure.annotations.lines import Line, Reading
from measure.fiducials.options import FiducialOptions, Reads
from measure.fiducials.scan_orientation import side_in_camera, writing_likelihoods
from measure.flags import Cause, Code, Reason, Status
from measure.geometry import POSES, pose_in_camera
from measure.marks.shapes import Side, WrittenPlace
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from pipeline import read_measurement
from pipeline.files.camera_file import CameraFile, camera_text, parse_camera, read_camera
from pipeline.files.library import library_path
from pipeline.files.object_files import WRITTEN, fill_images, read_images
from pipeline.measuring.camera_identification import (
    Identification,
    Trial,
    add_plates,
    contradictions,
    fitting_cameras,
    parse_plate,
    tried_cameras,
)
from pipeline.measuring.roll import add_known_lines, known_lines, note_same_frames, poses_of_roll
from pipeline.measuring.scan_task import ScanOptions, ScanTask
from pipeline.rendered.scene_file import render_project
from pipeline.report.frame_views import writing_picture
from pipeline.results.measured_record import MeasuredScan, for_images, write_frames
from pipeline.terminal import Reporter
from pipeline.text.toml_tables import Table

WILD = (WrittenPlace("left", "90"), WrittenPlace("right", "270", plate=True))
TITLES = ("RUN 7", "8601-8639", "16.5.68", "14,000'", "8617", "AUSTRALIAN")


def line(text: str, pose: str = "0", side: Side = "top") -> Line:
    turn = int(pose.removesuffix("m")) % 180
    ways = [way for way in POSES if int(way.removesuffix("m")) % 180 == turn]
    outline = ((10.0, 20.0), (50.0, 20.0), (50.0, 30.0), (10.0, 30.0))
    return Line({way: Reading(text, 0.9, len(text) * (way == pose)) for way in ways}, pose, outline, side)


def scan(image: str, lines: Sequence[Line] | None, pose: ScanOrientation | None = None) -> MeasuredScan:
    mark = MarkMeasurement("1", "fiducial", np.zeros(2), Covariance({Cause.NOISE: np.eye(2)}), Status.MEASURED)
    frame = FrameMeasurement(image, (mark,), pose, writing=None if lines is None else tuple(lines))
    return MeasuredScan(f"{image}.tif", 100, 100, (20.0, 20.0), frame)


def plated(camera: CameraFile, cameras: Mapping[str, CameraFile], **lines: Sequence[str] | None) -> list[MeasuredScan]:
    """Scans with these lines, held against their camera's file."""
    texts = {image: None if own is None else [line(text) for text in own] for image, own in lines.items()}
    return list(add_plates(camera, [scan(image, own) for image, own in texts.items()], cameras))


def fiducial_scans(cameras: Sequence[CameraFile], apart_mm: float, seed: int = 1) -> list[MeasuredScan]:
    """Scans of frames of some cameras, on affine film that scatters by some mm, at 20 µm a pixel."""
    rng, scans = np.random.default_rng(seed), []
    for number, camera in enumerate(cameras):
        places = np.array([each.xy_mm for each in camera.fiducials])
        film = np.eye(2) + rng.normal(0.0, 3e-4, (2, 2))
        centers = (places + rng.normal(0.0, apart_mm, places.shape)) @ film.T / 0.02 * [1.0, -1.0] + 6000.0
        covariance = Covariance({Cause.NOISE: 0.05**2 * np.eye(2)})
        marks = tuple(
            MarkMeasurement(each.id, "fiducial", center, covariance, Status.MEASURED)
            for each, center in zip(camera.fiducials, centers, strict=True)
        )
        scans.append(MeasuredScan(f"s{number}.tif", 100, 100, (20.0, 20.0), FrameMeasurement(f"s{number}", marks)))
    return scans


def test_scans_whose_fiducials_fit_another_camera_of_the_project_are_named() -> None:
    own = read_camera(library_path("wild-rc8-eight-153"))
    rng, film_mm = np.random.default_rng(3), 0.005
    moved = tuple(replace(each, xy_mm=tuple(rng.normal(each.xy_mm, 0.05))) for each in own.fiducials)
    other = replace(own, name="another", fiducials=moved)
    cameras = {"own.toml": own, "other.toml": other}
    for wrong in ((), (1,), (0, 1, 2, 3)):
        scans = fiducial_scans([other if k in wrong else own for k in range(4)], film_mm)
        found = fitting_cameras(own, scans, cameras, film_mm)
        assert found.keys() == {f"s{k}" for k in wrong}
        for reason in found.values():
            assert "fit the camera other.toml to" in reason
            misfits_um = [float(each) for each in re.findall(r"to ([\d.]+) µm", reason)]
            assert misfits_um[0] == pytest.approx(1000.0 * film_mm, rel=0.6)
            assert misfits_um[1] == pytest.approx(50.0, rel=0.6)
    # Film that scatters more than is believed fits no camera better; four marks have residuals of one pattern alone.
    rng = np.random.default_rng(2)
    near = tuple(replace(each, xy_mm=tuple(rng.normal(each.xy_mm, 0.03))) for each in own.fiducials[:4])
    own, other = replace(own, fiducials=own.fiducials[:4]), replace(other, fiducials=near)
    cameras = {"own.toml": own, "other.toml": other}
    for seed in range(50):
        assert not fitting_cameras(own, fiducial_scans([own] * 8, 8.0 * film_mm, seed), cameras, film_mm)
        assert not fitting_cameras(own, fiducial_scans([own] * 8, film_mm, seed), cameras, film_mm)


def test_a_scan_without_a_frame_is_tried_as_that_of_another_camera() -> None:
    own, other = (read_camera(library_path(name)) for name in ("wild-rc8-153", "wild-rc8-eight-153"))
    lost = replace(scan("lost", None), frame=FrameMeasurement("lost", (), problems=(Reason("none", Code.NO_FRAME),)))
    tasks = [ScanTask(name, f"{name}.tif", ScanOptions(own, None, FiducialOptions())) for name in ("lost", "good")]

    def measured(tried: Sequence[ScanTask], status: Status = Status.MEASURED) -> Iterator[MeasuredScan]:
        assert [task.name for task in tried] == ["lost"]
        for task in tried:
            (result,) = fiducial_scans([task.options.camera], 0.005)
            marks = [replace(mark, status=status, reason=Reason("faint")) for mark in result.frame.marks]
            yield replace(result, frame=replace(result.frame, image=task.name, marks=tuple(marks)))

    found = tried_cameras([lost, scan("good", None)], tasks, {"other.toml": other}, measured)
    assert found.keys() == {"lost"}
    assert found["lost"].startswith("as a frame of the camera other.toml all its 8 fiducials are measured")
    weak = partial(measured, status=Status.WEAK)
    assert not tried_cameras([lost, scan("good", None)], tasks, {"other.toml": other}, weak)


def test_frames_csv_has_every_line_with_what_it_says(tmp_path: Path) -> None:
    path = tmp_path / "out" / "frames.csv"
    assert write_frames(path, [scan("a", [line("RUN 7"), line("1/3/85"), line("Survey, Office")]), scan("b", None)])
    rows = [row for row in path.read_text().splitlines() if not row.startswith("#")]
    assert rows == [
        "image,field,text,value,confidence,place,col_px,row_px",
        "a,run,RUN 7,7,0.90,top,30,25",
        "a,date,1/3/85,,0.90,top,30,25",
        'a,text,"Survey, Office",,0.90,top,30,25',
    ]
    assert not write_frames(path, [scan("a", []), scan("b", None)])


def test_empty_columns_of_images_csv_are_filled_and_nothing_else_is_touched(tmp_path: Path) -> None:
    path = tmp_path / "images.csv"
    before = "# by hand\r\nimage,camera,run,frame,date,height\r\na.tif,c.toml,,,1970-01-01,\r\nb,,5,,,\r\n"
    path.write_bytes(before.encode())
    result = for_images([scan("a", [line(t) for t in TITLES]), scan("b", [line("1/3/85"), line("RUN 8")])], WRITTEN)
    assert result == {"a": {"run": "7", "frame": "8617", "date": "1968-05-16", "height": "14000 ft"}, "b": {"run": "8"}}
    fill_images(path, result)
    assert path.read_bytes().decode() == before.replace("c.toml,,,1970-01-01,", "c.toml,7,8617,1970-01-01,14000 ft")
    assert dict(read_images(path).camera) == {"a": "c.toml", "b": ""}


def test_two_scans_that_say_the_same_frame_are_reported_unless_they_are_parts() -> None:
    lines = [line(text) for text in TITLES]
    first, second, other = note_same_frames([scan("a", lines), scan("b", lines), scan("c", lines[:-2])], lambda _: "")
    assert "frame 8617, run 7, frames 8601-8639, date 1968-05-16" in first.frame.problems[0]
    assert "that of b" in first.frame.problems[0]
    assert "that of a" in second.frame.problems[0]
    assert other.frame.problems == ()
    halves = note_same_frames([scan("a", lines), scan("b", lines)], lambda image: "8617")
    assert all(half.frame.problems == () for half in halves)


CAMERA = {"frame_mm": [230.0, 230.0], "fiducial": [{"id": "1", "xy_mm": [1.0, 2.0]}]}


def test_a_camera_file_says_where_it_writes(tmp_path: Path) -> None:
    requests = ["left: reads upward", "right: plate reads downward", "top"]
    camera = parse_camera(Table({**CAMERA, "writing": requests, "number": "13182"}, tmp_path / "camera.toml", ""))
    assert camera.layout if camera.writing == (*WILD, WrittenPlace("top")) else None
    camera.path.write_text(camera_text(camera, lambda name, _: name))
    assert read_camera(camera.path).writing == camera.writing
    assert read_camera(camera.path).number == "13182"


Written = tuple[str, str, Side]
TITLE: Written = ("DEVELOPMENT RECORD", "90", "left")
OTHER: Written = ("AUSTRALIAN CAPITAL", "90", "left")


def posed(
    image: str, pose: str, camera: Written, name: str = "", places: Sequence[WrittenPlace] = WILD
) -> MeasuredScan:
    """A frame that lies in a pose, its line given as the camera's frame has it, and what that says of the pose."""
    text, own, camera_side = camera
    sides: Sequence[Side] = ("left", "right", "top", "bottom")
    side = next(each for each in sides if side_in_camera(each, pose) == camera_side)
    lines = [line(text, next(each for each in POSES if pose_in_camera(each, pose) == own), side)]
    written = dict(zip(POSES, writing_likelihoods(lines, places, POSES).tolist(), strict=True))
    return scan(image, lines, ScanOrientation(name or pose, False, ("not told.",), written, lines[0].pose))


def test_frames_of_a_roll_are_named_alike_and_leave_one_question() -> None:
    """Nothing says where the camera writes; by itself one frame would be named otherwise."""
    scans = [posed(name, pose, TITLE, places=()) for name, pose in (("a", "0"), ("b", "90"), ("c", "180m"))]
    scans.append(posed("d", "0", TITLE, name="180", places=()))
    poses = poses_of_roll(scans, ())
    assert {image: pose.name for image, pose in poses.items()} == {"a": "0", "b": "90", "c": "180m", "d": "0"}
    assert len({pose.roll for pose in poses.values()} - {""}) == 1
    assert all(pose.roll and not pose.decided for pose in poses.values())


def test_what_single_frames_do_not_tell_they_tell_together() -> None:
    """A line that may be anybody's tells by its place 4.6 at most; two of them tell enough."""
    scans = [posed("a", "0", TITLE), posed("b", "270m", OTHER)]
    assert poses_of_roll(scans[:1], WILD) == {}
    together = poses_of_roll(scans, WILD)
    assert {name: (p.name, p.decided) for name, p in together.items()} == {"a": ("0", True), "b": ("270m", True)}
    doubted = replace(scans[1], frame=replace(scans[1].frame, problems=(Reason("not told.", Code.CHANCE),)))
    assert not poses_of_roll([scans[0], doubted], WILD)["b"].decided
    (mark,) = scans[1].frame.marks
    weak = replace(mark, status=Status.WEAK, reason=Reason("it is blurred", Code.BLUR))
    faint = replace(scans[1], frame=replace(scans[1].frame, marks=(weak, replace(mark, kind="target"))))
    assert not poses_of_roll([scans[0], faint], WILD)["b"].decided  # a target says nothing of the frame
    stamp: Written = ("LIBRARY OF FILMS", "270", "right")
    scans = [posed(name, "0", (f"LIBRARY COPY {name}", *stamp[1:])) for name in "1234"]
    poses = poses_of_roll(scans, WILD)
    assert not any(pose.decided for pose in poses.values())
    known = posed("a", "90", TITLE, places=())
    known = replace(known, frame=replace(known.frame, pose=replace(known.frame.pose, decided=True)))  # type: ignore[type-var]
    poses = poses_of_roll([known, posed("b", "180", TITLE, name="90", places=())], ())
    assert {image: (pose.name, pose.decided) for image, pose in poses.items()} == {"b": ("180", True)}


def frame_of_roll(image: str, pose: str, *texts: str) -> FrameMeasurement:
    """ScanOrientation "0" or "180" of a frame of 10 x 10 mm in the middle of a scan of 100 px, a pixel being 0.1 mm."""
    scale = 10.0 if pose == "0" else -10.0
    matrix = np.array([[scale, 0.0, 50.0], [0.0, -scale, 50.0]])
    frame = scan(image, [line(text, pose) for text in texts], ScanOrientation(pose, False)).frame
    return replace(frame, pixel_from_camera=matrix)


def test_frames_are_known_by_the_line_that_all_have_and_that_tells_itself_best() -> None:
    frames = [frame_of_roll("a", "0", "ROLL OF 1", "DEVELOPMENT 17", "ONLY ON THIS ONE FRAME")]
    assert known_lines(frames) == ()
    frames.append(frame_of_roll("b", "0", "DEVELOPMENT 18", "ROLL OF 2"))
    (known,) = known_lines(frames)
    assert (known.text, known.pose, known.side) == ("DEVELOPMENT 17", "0", "top")
    assert np.array(known.outline_mm) == pytest.approx(np.array([[-4.0, 3.0], [0.0, 3.0], [0.0, 2.0], [-4.0, 2.0]]))
    frames += [frame_of_roll(image, "180", "DEVELOPMENT 19") for image in ("c", "d")]
    both = known_lines(frames)
    assert [each.pose for each in both] == ["0", "180"]
    outlines = [np.array(each.outline_mm) for each in (both[1], known)]
    assert outlines[0] == pytest.approx(outlines[1])  # as the scan shows it, whatever the pose
    assert known_lines([frame_of_roll(image, "0", "8601 8639") for image in "ab"]) == ()


def roll_tasks(images: Sequence[str], writing: Reads = "pose", has_marks: bool = True) -> list[ScanTask]:
    values = {key: value for key, value in CAMERA.items() if has_marks or key not in ("fiducial", "mark")}
    camera = parse_camera(Table(values, Path("camera.toml"), ""))
    options = ScanOptions(camera, None, FiducialOptions(writing=writing))
    return [ScanTask(image, f"{image}.tif", options) for image in images]


def test_a_few_frames_of_a_roll_are_read_and_the_others_know_by_what() -> None:
    requests = list[str]()

    def measure(tasks: Iterable[ScanTask]) -> Iterator[MeasuredScan]:
        for task in tasks:
            requests.append(task.name)
            yield replace(scan(task.name, None), frame=frame_of_roll(task.name, "0", f"DEVELOPMENT {task.name}"))

    tasks = roll_tasks([f"{number:04d}" for number in range(200)])
    knowing, read = add_known_lines(tasks, measure, Reporter(Console(quiet=True)))
    assert [task.name for task in knowing] == [task.name for task in tasks]
    assert sorted(requests) == sorted(read)
    assert len(read) == 4
    for task in knowing:
        known = task.options.fiducials.known_lines
        assert [each.text[:11] for each in known] == ([] if task.name in read else ["DEVELOPMENT"])
    assert len({id(task.options) for task in knowing}) == 2
    assert knowing[0].fix_orientation("90").options.fiducials.known_lines == ()
    nine = [f"{n}" for n in range(9)]
    for none in (roll_tasks(["a", "b", "c", "d"]), roll_tasks(nine, "all"), roll_tasks(nine, has_marks=False)):
        assert add_known_lines(none, measure, Reporter(Console(quiet=True))) == (tuple(none), {})


RC10 = parse_camera(
    Table({**CAMERA, "name": "Wild RC10, 153 mm", "principal_distance_mm": 153.0}, Path("camera.toml"), "")
)


def test_a_plate_is_held_against_the_cameras_file() -> None:
    own, unread = plated(RC10, {}, a=["WILD 15/4 UAG", "Nr 13043 152.75"], b=None)
    assert (own.frame.problems, unread.notes) == ((), ())
    assert "(Nr 13043) says a principal distance of 152.75 mm, the camera file 153 mm" in own.notes[0]
    wrong = ["it is of a camera by Zeiss", "it gives a principal distance of 305.12 mm"]
    assert contradictions(RC10, parse_plate([line("RMK A 30/23"), line("Nr 1234 305.12")])) == wrong
    (other,) = plated(RC10, {}, a=["Nr 1234 305.12"])
    assert f"not of Wild RC10, 153 mm: {wrong[1]}" in other.frame.problems[0]
    assert other.notes == ()
    first, second, mute = plated(RC10, {}, a=["Nr 13043"], b=["Nr 13022"], c=[])
    assert "Nr 13022, 13043" in first.frame.problems[0]
    assert first.frame.problems == second.frame.problems
    assert mute.frame.problems == ()


def test_a_number_tells_two_cameras_of_a_type_apart() -> None:
    first, second = replace(RC10, number="13043"), replace(RC10, number="13022")
    cameras = {"first.toml": first, "second.toml": second}
    own, other, unknown, mute = plated(first, cameras, a=["Nr 13043"], b=["Nr 13022"], c=["Nr 999"], d=["RUN 7"])
    assert own.frame.problems == mute.frame.problems == ()
    assert "it gives the number 13022, the file 13043. Give this scan the camera second.toml" in other.frame.problems[0]
    assert "it gives the number 999, the file 13043. Give this scan its own camera" in unknown.frame.problems[0]


def test_the_library_names_a_camera_by_its_plate_or_says_that_it_is_none() -> None:
    trial = Trial(("rc10-153", "rc10-305"), 4, 4, 0.9, 9.0, 0.9, None, None, None, "", 1.0, 1e-9)
    plate = {"camera_number": "13043", "principal_distance_mm": "152.75"}
    result = Identification(Path("a.tif"), (trial,), plate=plate, contradicted={"rc10-305": ["it gives 152.75 mm"]})
    assert result.sentence().endswith("says Nr 13043, principal distance 152.75 mm; of these that is rc10-153.")
    assert result.names_by_plate() == ["rc10-153"]
    none = replace(result, contradicted={name: ["another"] for name in trial.cameras})
    assert none.sentence().endswith("which none of them is.")
    assert none.names_by_plate() == []


def test_the_report_draws_lines_in_place_and_those_that_settled_it_stand_out() -> None:
    outline = ((10.0, 10.0), (20.0, 10.0), (20.0, 90.0), (10.0, 90.0))
    lines = [replace(line(text, "90m"), outline_px=outline) for text in ("RUN 7", "8617")]
    pose = ScanOrientation("0", True, ('of 2 lines of writing "RUN 7" speak most',))
    drawn = present(writing_picture(replace(scan("a", lines, pose), height_px=200)))
    assert 'transform="matrix(' in drawn
    # 5 page pixels a pixel. Right in its own frame is up in the scan after mirror and turn: down the page.
    matrix = [float(value) for value in drawn.split("matrix(")[1].split(")")[0].split()]
    assert matrix == pytest.approx([0.0, 1.0, 1.0, 0.0, 75.0, 250.0])
    assert 'class="evidence"' in drawn.split(">RUN 7<")[0].rsplit("<text", 1)[1]
    assert 'class="read"' in drawn.split(">8617<")[0].rsplit("<text", 1)[1]
    assert writing_picture(scan("a", None)) is None
    assert writing_picture(None) is None


SCENE = """
seed = 3
field = {kind = "natural"}
picture = {pad_mm = 1.4}
scan = {pitch_um = 40.0, margin_mm = 4.0, noise = 0.004}
writing = [{text = "RUN 7 16.5.68", xy_mm = [-13.5, -2.0], height_mm = 0.8, turn_deg = 90.0}]
image = [{name = "a", position = [0.0, 0.0, 100.0], angles_deg = [0.0, 0.0, 0.0], pose = "90m"}]
[camera]
name = "written"
frame_mm = [23.0, 23.0]
principal_distance_mm = 25.0
writing = ["left: reads upward"]
mark = {m = {kind = "ring-cross", ring_mm = 0.5, ring_line_mm = 0.1, arm_mm = 0.8, line_mm = 0.1}}
""" + fiducial_tables(
    {"1": (-10, -10), "2": (10, 10), "3": (-10, 10), "4": (10, -10)},
    'sigma_mm = 0.005\nmark = "m"\n',
    "camera.fiducial",
)


@pytest.mark.study
def test_a_rendered_frame_is_read_and_its_pose_settled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    render_project(tmp_path / "scene.toml", tmp_path / "p")
    project = tmp_path / "p" / "project.toml"
    project.write_text(
        'camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = 40.0\n[object]\nimages = "images.csv"\n'
    )
    (tmp_path / "p" / "images.csv").write_text("image,run,date\na,,\n")
    command("measure", project)
    (scan,) = read_measurement(tmp_path / "p" / "out" / "measurement.db")
    assert scan.frame.pose is not None
    assert (scan.frame.pose.name, scan.frame.pose.decided) == ("90m", True)
    assert "a,run," in (tmp_path / "p" / "out" / "frames.csv").read_text()
    assert (tmp_path / "p" / "images.csv").read_text() == "image,run,date\na,7,1968-05-16\n"
    monkeypatch.setattr("pipeline.measuring.scan_measurement.networks", lambda: None)
    monkeypatch.setattr("measure.fiducials.measurement.networks", lambda: None)
    command("measure", project)
    (scan,) = read_measurement(tmp_path / "p" / "out" / "measurement.db")
    assert not present(scan.frame.pose).decided
    assert any("pip install --no-deps rapidocr-onnxruntime" in note for note in scan.notes)
    assert networks_module.PACKAGE == "rapidocr_onnxruntime"
    assert not (tmp_path / "p" / "out" / "frames.csv").exists()
