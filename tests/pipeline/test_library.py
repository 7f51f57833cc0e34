"""The camera library: its files, a project that names one, and which camera a scan is of."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from truth_comparison import compare_with_truth

from measure import FiducialLayout, Scan
from measure.fiducials.camera_recognition import Answer, search_camera
from measure.scans.metadata import Pitch
from measure.scans.opening import ScanHead
from pipeline import InputError, read_project
from pipeline.archive.scan_groups import ScanGroup
from pipeline.cli import run
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.files.library import library_names, library_path, read_library
from pipeline.measuring import camera_trials
from pipeline.measuring.camera_identification import Identification, Trial, drawn_alike
from pipeline.measuring.camera_trials import LayoutSearch, Tried, _alike, identify
from pipeline.progress import Reporter
from pipeline.rendered.scene_file import render_project

LIBRARY = read_library()
SCENE = resources.files("pipeline").joinpath("templates", "scene.toml").read_text(encoding="utf-8")
RENDERED = "wild-rc10-153"
SEPARATION = re.compile(r"# Separation (.+): ([\d.]+) mm, spread ([\d.]+) \((\d+) reports\)")
SPREADS = {"fairchild": 0.3, "park": 0.35}  # mm, of models whose cameras differ
ENDS = {"left to right": ("5", "6"), "top to bottom": ("7", "8"), "1 to 2": ("1", "2"), "3 to 4": ("3", "4")}


def render_frame(folder: Path, camera: str) -> Path:
    """The project of one rendered frame of a library camera, which it names."""
    start, end = SCENE.index("[camera]\n"), SCENE.index("[field]\n")
    scene = SCENE[:start] + f'camera = "library:{camera}"\n' + SCENE[end:]
    scene = scene[: scene.rindex("[[image]]")].replace("pitch_um = 45.0", "pitch_um = 100.0")
    (folder / "scene.toml").write_text(scene, encoding="utf-8")
    render_project(folder / "scene.toml", folder)
    (folder / "project.toml").write_text(
        f'camera = "library:{camera}"\nscans = ["scans/*.tif"]\n[measure]\npose = "0"\n', encoding="utf-8"
    )
    return folder / "project.toml"


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_frame(tmp_path_factory.mktemp("library"), RENDERED)


def distance(camera: CameraFile, first: str, second: str) -> float:
    places = {one.id: np.array(one.xy_mm) for one in camera.fiducials}
    return float(np.hypot(*(places[first] - places[second])))


def test_every_camera_is_listed_with_its_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cameras", "--json"]) == 0
    listed = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert tuple(listed) == library_names()
    assert len(listed) >= 20
    assert all(entry["source"] for entry in listed.values())
    assert listed["wild-rc8-153"]["drawn"] == ["1", "2", "3", "4"]
    assert listed["jena-lmk-153"]["drawn"] == []
    assert run(["cameras"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in listed)
    assert "learned" in printed


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
    for words, mm, spread, _ in SEPARATION.findall(library_path(name).read_text(encoding="utf-8")):
        assert distance(camera, *ENDS[words]) == pytest.approx(float(mm), abs=max(0.02, 1.5 * float(spread)))


def test_the_reseau_is_a_lattice_of_ten_mm() -> None:
    camera = LIBRARY["hasselblad-reseau-60"]
    assert min(distance(camera, a.id, b.id) for a, b in combinations(camera.fiducials, 2)) == 10.0
    assert distance(camera, "11", "55") == pytest.approx(40.0 * np.sqrt(2.0))


def test_a_printed_camera_is_a_file_to_start_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cameras", "zeiss-rmk-a-153"]) == 0
    (tmp_path / "camera.toml").write_text(capsys.readouterr().out, encoding="utf-8")
    camera = read_camera(tmp_path / "camera.toml")
    assert camera.fiducials == LIBRARY["zeiss-rmk-a-153"].fiducials
    assert camera.source == LIBRARY["zeiss-rmk-a-153"].source


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("wild-rc8", "'wild-rc8-153'"),
        ("wild-rc10", "'wild-rc10-153' or 'wild-rc10-214'"),
        ("wild-rc9-87", "'wild-rc9-88'"),
        ("Wild RC9", "'wild-rc9-88'"),
    ],
)
def test_a_misspelt_camera_is_reported_its_neighbours(
    name: str, near: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "project.toml").write_text(f'output = "out"\ncamera = "library:{name}"\n', encoding="utf-8")
    assert run(["measure", str(tmp_path / "project.toml")]) == 2
    message = capsys.readouterr().err
    assert f"project.toml, line 2: camera: the camera library has no '{name}'. Did you mean {near}" in message
    assert "`reseau cameras`" in message
    assert run(["cameras", name]) == 2
    assert near in capsys.readouterr().err


def test_a_name_like_no_other_is_reported_where_they_stand() -> None:
    with pytest.raises(InputError, match=r"no 'xyz'\. `reseau cameras` lists them"):
        library_path("xyz")


@pytest.mark.parametrize("words", [["wild-rc9-88", "wild-rc8-153"], ["wild-rc9-88", "--json"], ["--pitch", "20"]])
def test_options_that_do_not_go_together(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cameras", *words]) == 2
    assert "give NAME alone" in capsys.readouterr().err


def test_images_may_name_a_camera_of_the_library(tmp_path: Path) -> None:
    (tmp_path / "images.csv").write_text("image,camera\na,library:wild-rc9-88\nb,\n", encoding="utf-8")
    (tmp_path / "comparator.csv").write_text("image,point,kind,x_mm,y_mm\n", encoding="utf-8")
    text = 'camera = "library:wild-rc8-153"\n[object]\nimages = "images.csv"\n'
    (tmp_path / "project.toml").write_text(text, encoding="utf-8")
    project = read_project(tmp_path / "project.toml")
    assert [project.image_camera(name).name for name in "ab"] == ["Wild RC9, 88 mm", "Wild RC8, 153 mm"]


def test_a_frame_of_a_library_camera_is_measured_right(frame: Path) -> None:
    """All drawn marks within a tenth of a pixel of the truth; those that are not drawn are passed over. The marks are
    weak, since the edge of their pads, which is not drawn, counts as damage."""
    assert run(["measure", str(frame)]) == 1
    measured = frame.parent / "out" / "measurement.db"
    (compared,) = compare_with_truth(frame.parent / "truth.json", measured).frames
    assert compared.observed["fiducial"] == 4
    assert compared.wrong == ()
    assert np.abs(compared.errors_px).max() < 0.1
    assert (frame.parent / "comparator.csv").read_text(encoding="utf-8").count(",fiducial,") == 4


def test_marks_of_unknown_shape_are_learned_and_not_from_one_scan_alone(
    frame: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = frame.with_name("other.toml")
    other.write_text(frame.read_text(encoding="utf-8").replace(RENDERED, "jena-lmk-153"), encoding="utf-8")
    assert run(["measure", str(other)]) == 2
    assert "jena-lmk-153.toml: the marks are to be learned, and with one scan nothing" in capsys.readouterr().err
    camera = LIBRARY["jena-lmk-153"]
    assert len(camera.learned) == 8
    # A template's origin lies somewhere on its mark, of which the reports know nothing.
    assert all(fiducial.x_mm.sigma > 1.0 for fiducial in camera.camera().fiducials.values())


@pytest.mark.study
def test_the_frame_is_distinguished_from_another_camera(frame: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ring with a cross holds the plain cross of older cameras too: the ring then counts as damage. No other pitch
    than the file's is tried."""
    monkeypatch.setattr(LayoutSearch, "longer_one_way", None)
    monkeypatch.setattr(LayoutSearch, "try_any_pitch", None)
    (scan,) = (frame.parent / "scans").glob("*.tif")
    few = {name: LIBRARY[name] for name in ("jena-lmk-153", "wild-rc5-153", "wild-rc8-153", RENDERED)}
    found = identify(scan, few, None, Reporter())
    assert [trial.cameras for trial in found.trials] == [(RENDERED,), ("wild-rc5-153", "wild-rc8-153")]
    assert [trial.cameras for trial in found.best] == [(RENDERED,)]
    best = found.trials[0]
    assert (best.found, best.drawn, best.chance) == (4, 4, None)
    assert best.expected < 1e-4
    assert best.likeness > 0.8
    assert best.residual_sigmas is not None
    assert best.residual_sigmas < 2.0
    assert RENDERED in found.sentence()


def trial(cameras: tuple[str, ...], score: float, chance: float | None = 0.0) -> Trial:
    return Trial(cameras, 4, 4, 0.9, 10.0, score, chance, 1.0, 0.01, "", 2.0, 1e-6)


@pytest.mark.study
def test_of_many_scans_some_of_each_kind_are_tried_with_the_projects_own_cameras(
    frame: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four scans of one size and one of another, in a folder and below it: three and one are tried. A scan that cannot
    be read costs no other, and the project's camera, which the library has not, is named beside its twins. No other
    pitch than the files' is tried."""
    monkeypatch.setattr(LayoutSearch, "longer_one_way", LayoutSearch.try_pitch)
    monkeypatch.setattr(camera_trials, "_try_any_pitch", lambda *_: ([], {}))
    (scan,) = (frame.parent / "scans").glob("*.tif")
    folder = tmp_path / "scans"
    (folder / "b").mkdir(parents=True)
    for name in ("a1", "a2", "a3", "b/a4"):
        (folder / f"{name}.tif").symlink_to(scan)
    grey = tifffile.imread(scan)
    tifffile.imwrite(folder / "cut.tif", grey[200:-200, 200:-200], resolution=(100, 100), resolutionunit=3)
    (folder / "broken.tif").write_bytes(b"II*\0")
    own = library_path(RENDERED).read_text(encoding="utf-8").replace('name = "Wild RC10', 'name = "Our own RC10')
    (tmp_path / "ours.toml").write_text(own, encoding="utf-8")
    (tmp_path / "project.toml").write_text('camera = "ours.toml"\nscans = ["scans/a1.tif"]\n', encoding="utf-8")
    monkeypatch.setattr(
        "pipeline.files.library.read_library", lambda: {name: LIBRARY[name] for name in ("wild-rc5-153", RENDERED)}
    )
    assert run(["cameras", "--scan", str(folder), "--project", str(tmp_path / "project.toml"), "--json"]) == 1
    output = json.loads(capsys.readouterr().out)
    assert [len(kind["scans"]) for kind in output["kinds"]] == [4, 1]
    assert [len(kind["samples"]) for kind in output["kinds"]] == [3, 1]
    assert [kind["best"] for kind in output["kinds"]] == [sorted(["ours.toml", RENDERED]), []]
    assert [Path(each["scan"]).name for each in output["unread"]] == ["broken.tif"]


def test_a_folder_without_scans_is_reported_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cameras", "--scan", str(tmp_path)]) == 2
    assert "no scan there, nor below" in capsys.readouterr().err


@pytest.mark.study
@pytest.mark.parametrize(
    ("at_pitch", "looked_at"), [((1e-3, 5.0), [0]), ((0.5, 5.0), [1]), ((5.0, 0.5), [1, 0])], ids=str
)
def test_marks_are_inspected_at_once_a_search_answers_that_chance_does_not_make(
    frame: Path, monkeypatch: pytest.MonkeyPatch, at_pitch: tuple[float, float], looked_at: list[int]
) -> None:
    """The first search, with pixels alike, or else after the second, with pixels longer one way: then each camera's
    where it answers best."""
    (scan,) = (frame.parent / "scans").glob("*.tif")
    two = {name: LIBRARY[name] for name in (RENDERED, "fairchild-t5-153")}

    def answers(before: int, *expected: float) -> Callable[..., Tried]:
        left = iter(expected)
        return lambda search, layout, pitch_um: Tried(layout, layout, search._fine, [], before, Answer(next(left), ()))

    view = list[int]()

    def looked(_: LayoutSearch, names: tuple[str, ...], each: Tried, __: float) -> Trial:
        view.append(each.before)
        return replace(trial(names, 0.5, None), expected=each.answer.expected)

    monkeypatch.setattr(LayoutSearch, "try_pitch", answers(0, *at_pitch))
    monkeypatch.setattr(LayoutSearch, "longer_one_way", answers(1, 0.02 if at_pitch[0] > 1 else 1e-3, 7.0))
    monkeypatch.setattr(camera_trials, "_trial", looked)
    identify(scan, two, 100.0, Reporter())
    assert view == looked_at


@pytest.mark.parametrize(
    ("shown", "likely", "searched"),
    [
        ("wild-rc5-153", "wild-rc5-153", 2),  # beside the ring-crosses at the same places
        ("wild-rc10-153", "wild-rc5-153", 2),
        ("zeiss-rmk-a-153", "wild-rc5-153", 3),
        ("wild-rc5-153", "", 3),
    ],
)
def test_cameras_of_other_scans_are_tried_first_and_hide_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: str, likely: str, searched: int
) -> None:
    tifffile.imwrite(tmp_path / "scan.tif", np.full((60, 60), 9, np.uint8), resolution=(25, 25), resolutionunit=3)
    few = {name: LIBRARY[name] for name in ("wild-rc5-153", "wild-rc10-153", "zeiss-rmk-a-153")}
    known = list[FiducialLayout]()

    def answer(_: Scan, layout: FiducialLayout, *__: Any) -> Answer:
        known.append(layout)
        return Answer(1e-6 if _parts(layout) == _parts(few[shown].layout()) else 10.0, ())

    def measure_marks(_: LayoutSearch, names: tuple[str, ...], each: Tried, __: float) -> Trial:
        return replace(trial(names, 0.9 if each.answer.expected < 1 else 0.0, None), expected=each.answer.expected)

    monkeypatch.setattr(camera_trials, "search_camera", answer)
    monkeypatch.setattr(camera_trials, "_trial", measure_marks)
    monkeypatch.setattr(camera_trials, "networks", lambda: None)
    monkeypatch.setattr(camera_trials, "_alike_in_scan", lambda *_: {})
    found = identify(tmp_path / "scan.tif", few, None, Reporter(quiet=True), likely=(likely,))
    assert [each.cameras for each in found.best] == [(shown,)]
    assert len(known) == searched


def _parts(layout: FiducialLayout) -> list[str]:
    return [repr(mark.mark)[:60] for mark in layout.marks]


@pytest.mark.study
def test_a_camera_of_eight_marks_does_not_lose_to_one_that_has_four_of_them(tmp_path: Path) -> None:
    """Also where some of its marks are found only once the others have placed the frame."""
    eight = "zeiss-rmk-a-eight-153"
    scan = next((render_frame(tmp_path, eight).parent / "scans").glob("*.tif"))
    two = {name: LIBRARY[name] for name in (eight, "zeiss-rmk-a-153")}
    (best, *_) = identify(scan, two, None, Reporter(quiet=True)).best
    assert best.cameras == (eight,)
    assert best.found == 8


@pytest.mark.study
@pytest.mark.parametrize(("found", "measured"), [(25, 1), (9, 2)])
def test_a_part_of_a_lattice_is_no_other_camera(
    frame: Path, monkeypatch: pytest.MonkeyPatch, found: int, measured: int
) -> None:
    """Unless no more of the lattice was found than the other camera has marks."""
    (scan,) = (frame.parent / "scans").glob("*.tif")
    two = {name: LIBRARY[name] for name in ("hasselblad-reseau-60", "register-glass-262")}
    monkeypatch.setattr(
        "pipeline.measuring.camera_trials.search_camera", lambda _, layout, *__: Answer(10.0 ** -len(layout.marks), ())
    )
    monkeypatch.setattr(
        camera_trials, "_trial", lambda *_: replace(trial(("lattice",), 0.5), found=found, expected=1e-25)
    )
    assert sum(each.cameras == ("lattice",) for each in identify(scan, two, 100.0, Reporter()).trials) == measured


@pytest.mark.study
def test_a_camera_too_large_for_the_scan_is_reported_so_in_words_and_json(
    frame: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nowhere do its marks answer together: that is no number, which neither a sentence nor JSON could hold."""
    (scan,) = (frame.parent / "scans").glob("*.tif")
    few = {name: LIBRARY[name] for name in (RENDERED, "hasselblad-reseau-60")}
    monkeypatch.setattr("pipeline.files.library.read_library", lambda: few)
    answered = search_camera

    def small_only(scan: Scan, layout: FiducialLayout, *given: Any) -> Answer:
        return answered(scan, layout, *given) if len(layout.marks) == 4 else Answer(math.inf, ())

    monkeypatch.setattr("pipeline.measuring.camera_trials.search_camera", small_only)
    assert run(["cameras", "--scan", str(scan), "--json"]) == 0
    trials = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)["trials"]
    assert trials[0]["expected"] < 1e-4
    assert trials[1]["expected"] is None
    assert trials[1]["reason"] == "not measured: no constellation of its marks correlates anywhere in the scan"


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


@pytest.mark.study
def test_what_noise_answers_as_well_is_not_matched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor are marks reckoned with that a constellation puts outside of the scan."""
    grey = np.random.default_rng(3).normal(120.0, 25.0, (600, 600)).clip(0, 255).astype(np.uint8)
    tifffile.imwrite(tmp_path / "noise.tif", grey, resolution=(25, 25), resolutionunit=3)
    monkeypatch.setattr("measure.fiducials.camera_recognition.detect_frame", pytest.fail)
    few = {name: LIBRARY[name] for name in (RENDERED, "fairchild-t5-153", "wild-18x18-115")}
    found = identify(tmp_path / "noise.tif", few, None, Reporter())
    assert found.best == ()
    assert {trial.score for trial in found.trials} == {0.0}


def test_what_chance_finds_as_well_does_not_stand_out() -> None:
    found = Identification(Path("a.tif"), (trial(("a",), 0.5, 0.3), trial(("b",), 0.0, None)))
    assert found.best == ()
    assert "no camera of the library stands out" in found.sentence()
    assert found.best_names() == ()


def test_a_pitch_that_the_marks_contradict_is_reported() -> None:
    view = replace(trial(("a",), 0.8), expected=math.inf, pixel_um=127.3)
    right = Identification(Path("a.tif"), (view,), pitch_um=(126.0, 128.0))
    assert "um" not in right.sentence()
    wrong = replace(right, pitch_um=(63.5, 63.5))
    assert "only if a pixel measures 127.3 µm, not 63.5" in wrong.sentence()


@pytest.mark.parametrize(
    ("camera", "pixel_um", "named"),
    [("wing-large-flat-153", 45.1, True), ("wing-large-flat-153", 210.0, False), ("wild-rc10-153", 210.0, True)],
)
def test_solid_marks_alone_name_no_camera_against_the_pitch_of_the_file(
    camera: str, pixel_um: float, named: bool
) -> None:
    """Crosses do: then the file's pitch is wrong."""
    best = replace(trial((camera,), 0.8), pixel_um=pixel_um)
    sample = Identification(Path("a.tif"), (best,), pitch_um=(45.0, 45.0))
    group = ScanGroup(Path(), ScanHead("TIFF", 9, 9, 1, 8, Pitch((45.0, 45.0))), (Path("a.tif"),), (sample,))
    assert group.camera == (camera if named else "")
    assert named or "contradict the file's pitch" in group.why_not()


def test_cameras_that_come_close_are_all_named() -> None:
    found = Identification(Path("a.tif"), (trial(("a", "b"), 0.9), trial(("c",), 0.85), trial(("d",), 0.4)))
    assert found.best_names() == ("a", "b", "c")
    assert "c comes close with 0.85" in found.sentence()
    without_report = replace(found, unreported={"c": "made from one frame", "d": "nobody knows"})
    assert without_report.sentence().endswith("c rests on no calibration report: made from one frame.")


@pytest.mark.parametrize(("score", "alike"), [(0.75, {"a": ("b",), "A": ("b",)}), (0.6, {})])
def test_a_form_that_fits_the_scan_clearly_worse_is_not_reported_next_to_a_name(
    score: float, alike: dict[str, tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """a was found with 0.85. b, drawn much like it, is looked at where a lies; c, as much alike, has no mark there."""

    class Search:
        def recognise(self, tried: Tried) -> str | None:
            assert (tried.answer, tried.bold) == (of_a.answer, of_a.bold)
            return "frame" if tried.layout.marks[0].id == "b" else None

    picture: Any = None

    def make_trial(id: str) -> Tried:
        layout = FiducialLayout((replace(LIBRARY[RENDERED].layout().marks[0], id=id),), (10.0, 10.0))
        return Tried(layout, layout, picture, [], 0, Answer(0.1, ()))

    of_a = make_trial("a")
    monkeypatch.setattr(camera_trials, "likeness", lambda _: score)
    tries: Any = {("a", "A"): of_a, ("b", "B"): make_trial("b"), ("c",): make_trial("c")}
    drawn = {"a": ("b", "c"), "b": ("a",)}
    search: Any = Search()
    found = camera_trials._alike_in_scan(search, [trial(("a", "A"), 0.85), trial(("b", "B"), 0.0)], tries, drawn)
    assert found == alike


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
