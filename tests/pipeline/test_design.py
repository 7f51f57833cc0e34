"""`reseau design`: Juhl's table and figures, what would help, sweeps, files and messages."""

import json
import math
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from pipeline import InputError
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.design.expected import alone, alternatives, expect, gains, rms
from pipeline.design.setup import planned_network, scene_setup
from pipeline.design.sweeps import Swept, Variations, over_layouts, sweep
from pipeline.rendered.scene_file import read_scene
from pipeline.rendered.scene_tables import Sweep

SCENES = Path(str(resources.files("synthetic_images").joinpath("scenes")))
JUHL = SCENES / "juhl_example.toml"
PAPER_UM = {"t1": 0.7, "t2": 0.7, "t3": 0.5, "t4": 0.4, "r1": 1.8, "r2": 1.7, "r3": 0.4, "af": 0.8, "sh": 0.6}

SMALL = (
    """
[camera]
name = "K"
frame_mm = [60.0, 60.0]
principal_distance_mm = 60.0
[camera.distortion]
family = "torlegard"
[camera.distortion.sigma]
k3 = "free"
[[camera.fiducial]]
id = "a"
xy_mm = [28.0, 28.0]
"""
    + "".join(
        f'[[camera.fiducial]]\nid = "{id}"\nxy_mm = [{x}, {y}]\n'
        for id, x, y in (("b", -28.0, 28.0), ("c", -28.0, -28.0), ("d", 28.0, -28.0))
    )
    + """[field]
diameter_mm = 10.0
[[field.grid]]
first = 1
columns = 4
rows = 4
right = [1.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
relief = 0.4
[design]
sigma_height = 0.001
[[image]]
name = "one"
position = [0.0, 0.0, 5.0]
angles_deg = [0.0, 0.0, 0.0]
[[image]]
name = "two"
position = [2.0, 0.0, 4.6]
angles_deg = [0.0, 23.0, 90.0]
"""
)


def small(folder: Path, *changes: tuple[str, str]) -> Path:
    text = SMALL
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def vary_juhl(quantity: str, values: tuple[float, ...], layouts: int) -> Swept:
    scene = Variations.read(JUHL)
    scene.values["design"]["layouts"] = layouts
    return sweep(scene, 1, Sweep(quantity=quantity, values=values))


@pytest.fixture(scope="module")
def over_points() -> Swept:
    """Juhl's figure 1."""
    return vary_juhl("field.points", (75, 100, 150, 200), layouts=10)


@pytest.mark.study
def test_juhls_table(over_points: Swept) -> None:
    step = next(step for step in over_points.steps if step.value == 150)
    for name, printed in PAPER_UM.items():
        assert step.sigmas.mean[name] == pytest.approx(printed, rel=0.1)
    assert step.sigmas.mean["r2"] == pytest.approx(PAPER_UM["r2"], abs=0.15)
    assert step.sigmas.spread["r1"] < 0.25


@pytest.mark.study
def test_juhls_first_figure_falls_with_the_number_of_points(over_points: Swept) -> None:
    for name in PAPER_UM:
        assert -0.62 < over_points.slope(name) < -0.5


def test_juhls_second_figure_is_r1_alone() -> None:
    """Heights of 0.003 to 0.1 per mille of the flying height: no matter at first, then in proportion; others hardly."""
    swept = vary_juhl("design.sigma_height", (0.005, 0.02, 0.15, 0.3), layouts=2)
    r1 = np.array([step.sigmas.mean["r1"] for step in swept.steps])
    assert r1[1] / r1[0] < 1.07
    assert r1[2] / r1[0] > 2.0
    assert r1[3] / r1[2] > 1.6
    for name in ("t1", "t2", "t3", "t4", "af", "sh"):
        assert swept.steps[2].sigmas.mean[name] / swept.steps[0].sigmas.mean[name] < 1.15


def test_juhls_fourth_photograph_brings_a_quarter_on_r1() -> None:
    """ "All other parameters" gain less than half of it but for r2 and r3, which gain more than he says."""
    scene = Variations.read(JUHL)
    scene.values["design"]["layouts"] = 6
    fourth = Variations(scene.path, scene.values | {"image": scene.values["image"] + scene.values["design"]["photo"]})
    three, four = (over_layouts(each, expect(each.setup())).mean for each in (scene, fourth))
    gain = gains(three, four)
    assert gain["r1"] == pytest.approx(25.0, abs=3.0)
    for name in ("t1", "t2", "t3", "t4", "af", "sh"):
        assert gain[name] < gain["r1"] / 2


def test_what_would_help_is_tried(tmp_path: Path) -> None:
    photo = '[[design.photo]]\nname = "third"\nposition = [-2.0, 0.0, 4.6]\nangles_deg = [0.0, -23.0, 0.0]\n[[image]]'
    basis = expect(Variations.read(small(tmp_path, ("[[image]]", photo))).setup())
    helpful = {one.change: one for one in alternatives(basis)}
    third = helpful["one more photo: third"]
    assert len(third.expected.network.images) == 3
    assert all(gain > 0.0 for gain in third.gain_percent.values())
    assert sum(change.startswith("one more photo: as ") for change in helpful) == 3
    better = helpful["given heights twice as good"].expected.network.points[0].Z
    assert better is not None
    assert better.sigma == 0.0005
    targets = helpful["targets measured twice as well"].gain_percent
    assert 30.0 < targets["k3"] <= 50.0
    doubled = helpful["twice as many points, spread alike"].gain_percent
    assert doubled["k3"] == pytest.approx(100 * (1 - math.sqrt(0.5)), abs=1.0)


def test_design_writes_what_it_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    swept = '[[design.sweep]]\nquantity = "design.transformation"\nvalues = ["similarity", "affine"]\n[[image]]'
    scene = small(tmp_path, ("[[image]]", swept))
    assert run(["design", str(scene), "--json"]) == DONE
    printed = json.loads(capsys.readouterr().out)
    folder = tmp_path / "small-design"
    content = json.loads((folder / "design.json").read_text())
    assert content == printed
    camera = content["cameras"]["K"]
    assert camera["principal_distance_mm"]["value"] == 60.0
    assert 0.0 < camera["principal_distance_mm"]["sigma"] < 1.0
    assert set(camera["fiducials"]) == set("abcd")
    assert [at["radius_mm"] for at in camera["precision_at_radii"]] == pytest.approx(
        [np.hypot(30, 30) * quarter / 4 for quarter in (1, 2, 3, 4)]
    )
    assert content["marks"] == {"target": 32, "fiducial": 8}
    assert content["points"]["6"]["images"] == 2
    assert content["point_summary"]["X"]["estimated"] == 0
    assert 0.0 < content["point_summary"]["Z"]["rms"] < 0.001
    targets = content["reliability"]["groups"]["target"]
    assert targets["coordinates"] == 64
    assert 0.0 < targets["redundancy"] < 1.0
    assert targets["smallest_error"]["unit"] == "um"
    assert targets["smallest_error"]["median"] > 4.13 * 5.0  # delta0 times sigma, over the root of a part of 1
    assert {one["parameter"] for one in content["reliability"]["camera"]} >= {"IO.K.c", "IO.K.k3", "FID.K.a.x"}
    (swept,) = content["sweeps"]
    assert [step["value"] for step in swept["steps"]] == ["similarity", "affine"]
    drawn = ElementTree.parse(folder / swept["picture"]).getroot()
    drawn_words = {word.text for word in drawn.iter("{http://www.w3.org/2000/svg}text")}
    assert drawn_words >= {"similarity", "affine", "design.transformation", "c", "k3"}
    assert run(["design", str(scene), str(tmp_path / "there")]) == DONE
    table = capsys.readouterr().out
    for words in (
        "principal distance, mm",
        "Smallest gross errors",
        "c of camera K",
        "Fiducial marks",
        "What would help",
        "Sigmas over design.transformation",
    ):
        assert words in table


@pytest.mark.study
def test_a_singular_plan_names_what_is_missing_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flat = small(
        tmp_path,
        ("relief = 0.4", "relief = 0.0"),
        ("[2.0, 0.0, 4.6]", "[0.5, 0.0, 5.0]"),
        ("[0.0, 23.0, 90.0]", "[0.0, 0.0, 90.0]"),
        ("[camera.distortion]", '[camera.sigma]\nprincipal_distance_mm = "free"\n[camera.distortion]'),
    )
    assert run(["design", str(flat)]) == LOOK
    printed = capsys.readouterr().out
    assert "The principal distance of camera K" in " ".join(printed.split())
    assert "not determined" in printed
    content = json.loads((tmp_path / "small-design" / "design.json").read_text())
    assert content["cameras"]["K"]["principal_distance_mm"]["sigma"] is None
    assert content["cameras"]["K"]["distortion"]["k3"]["sigma"] > 0.0
    assert content["images"]["one"]["exterior"]["Z0"]["sigma"] is None
    assert content["singular"][0]["remedy"]
    convergent = next(one for one in content["what_would_help"] if "half round" in one["change"])
    assert convergent["gain_percent"]["c"] is None


def test_the_network_is_what_the_frames_show(tmp_path: Path) -> None:
    setup = Variations.read(small(tmp_path)).setup()
    network, values = planned_network(setup)
    assert len(network.points) == 16
    assert network.point_by_id["1"].X is not None
    assert network.point_by_id["1"].X.sigma == 0.0
    assert network.point_by_id["1"].Z is not None
    assert network.point_by_id["1"].Z.sigma == 0.001
    np.testing.assert_allclose(values.transformation["one"], [0, 1, 0, 0, 0, 1], atol=1e-12)
    near = small(tmp_path, ("[0.0, 0.0, 5.0]", "[0.0, 0.0, 2.1]"))
    assert len(Variations.read(near).setup().visible_points(Variations.read(near).setup().images[0])) == 4
    below = small(tmp_path, ("[0.0, 0.0, 5.0]", "[0.0, 0.0, -5.0]"), ("angles_deg = [0.0", "angles_deg = [180.0"))
    with pytest.raises(InputError, match="'one' would show 0 targets and needs 3"):
        planned_network(Variations.read(below).setup())


@pytest.mark.parametrize(
    ("quantity", "value", "found"),
    [
        ("exterior.two.kappa_deg", 45, lambda setup: math.degrees(setup.images[1].exterior[5])),
        ("image.two.position.3", 7, lambda setup: setup.images[1].exterior[2]),
        ("image.1.position.1", 7, lambda setup: setup.images[0].exterior[0]),
        ("camera.principal_distance_mm", 45, lambda setup: setup.lens.principal_distance_mm),
        ("camera.fiducials", 3, lambda setup: len(setup.camera.fiducials)),
        ("field.points", 36, lambda setup: len(setup.points)),
        ("images", 1, lambda setup: len(setup.images)),
        ("field.grid.1.relief", 0, lambda setup: max(abs(point.xyz[2]) for point in setup.points)),
        ("design.sigma_fiducial_um", 45, lambda setup: setup.settings.sigma_fiducial_um),
    ],
)
def test_any_quantity_of_the_scene_can_be_varied(tmp_path: Path, quantity: str, value: float, found: object) -> None:
    varied = Variations.read(small(tmp_path)).varied(1, Sweep(quantity=quantity, values=(value, 99)), value)
    assert callable(found)
    assert found(varied.setup()) == pytest.approx(value)


def test_as_many_points_stand_over_the_same_area(tmp_path: Path) -> None:
    scene = Variations.read(small(tmp_path))
    xyz = np.array(
        [point.xyz for point in scene.varied(1, Sweep(quantity="field.points", values=(100, 1)), 100).setup().points]
    )
    assert np.ptp(xyz[:, :2], axis=0) == pytest.approx([4.0 * 9 / 10] * 2)


def test_a_camera_in_a_file_of_its_own_can_be_varied() -> None:
    scene = Variations.read(SCENES / "aerial_five.toml")
    varied = scene.varied(1, Sweep(quantity="camera.principal_distance_mm", values=(210.0, 300.0)), 210.0)
    assert varied.setup().lens.principal_distance_mm == 210.0
    assert len(varied.setup().camera.fiducials) == 8


@pytest.mark.parametrize(
    ("quantity", "words"),
    [
        ("design.sigma_heigth", "Did you mean 'sigma_height'?"),
        ("fields.grid", "Did you mean 'field'?"),
        ("exterior.tow.X0", "there is no image 'tow'. Did you mean 'two'? There are one, two."),
        ("exterior.two.kapa_deg", "Did you mean 'kappa_deg'?"),
        ("image.three.position.1", "There are one, two."),
        ("image.two.position.4", "has no '4'"),
        ("field.points", "counts things"),
    ],
)
def test_a_wrong_quantity_is_reported_with_what_is_near(tmp_path: Path, quantity: str, words: str) -> None:
    scene = Variations.read(small(tmp_path))
    with pytest.raises(InputError) as caught:
        sweep(scene, 1, Sweep(quantity=quantity, values=(1.5, 2.5)))
    assert f"[design.sweep[1]] {quantity} = 1.5" in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("sigma0 = 0", "sigma0: must be greater than 0"),
        ("layouts = 0", "layouts: must be a whole number of at least 1"),
        ("radii_mm = [0.0]", "radii_mm: must be positive"),
        ('transformation = "afine"', 'there is no transformation "afine"'),
        ('control_points = ["77"]', "the field has no target '77'"),
        ("sigma_hight = 1", "Did you mean 'sigma_height'?"),
        ('[[design.sweep]]\nquantity = "images"\nvalues = [2]', "needs two different values"),
        ('[[design.sweep]]\nquantity = "design..x"\nvalues = [2, 3]', "write a dotted name"),
        ('[[design.distance]]\nfrom = "1"\nto = "one"\nsigma = 0.0', "sigma"),
        ('[[design.distance]]\nfrom = "1"\nto = "three"\nsigma = 0.1', "'three' is neither a target nor an image"),
        ('[[design.distance]]\nfrom = "1"\nto = "1"\nsigma = 0.1', "two ends"),
        ('[[design.orientation]]\nimage = "ones"\nposition_sigma = 0.1', "no image 'ones'"),
        ('[[design.orientation]]\nimage = "one"', "nothing is observed"),
        ("[[design.orientation]]\nposition_sigma = -1.0", "must be positive"),
    ],
)
def test_a_wrong_table_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str, words: str) -> None:
    assert run(["design", str(small(tmp_path, ("[[image]]", f"{line}\n[[image]]")))]) == WRONG_INPUT
    assert words in capsys.readouterr().err
    assert not (tmp_path / "small-design").exists()


def test_fiducials_of_photographs_alone_are_the_mean_of_as_many(tmp_path: Path) -> None:
    """Closed form, where targets tell everything of film and orientation: sigma over the root of the number of frames.

    Of the 2 m coordinates shift, turn and scale take four: the mean variance shrinks in that proportion. What is given
    of the fiducials and of the interior orientation has no say.
    """
    for given in ("1.0", "0.002"):
        scene = small(
            tmp_path,
            ("[design]", "[design]\nsigma_target_um = 1e-4\nsigma_fiducial_um = 3.0"),
            ("sigma_height = 0.001", "sigma_height = 0"),
            ('id = "a"\n', f'id = "a"\nsigma_mm = {given}\n'),
        )
        sigmas = alone(expect(Variations.read(scene).setup()))
        marks = [sigma for parameter, sigma in sigmas.items() if parameter.kind == "fiducial"]
        assert rms(marks) == pytest.approx(0.003 / math.sqrt(2) * math.sqrt(1 - 4 / 8), rel=1e-4)


def test_a_field_of_natural_points_cannot_be_planned() -> None:
    with pytest.raises(InputError, match="has no targets"):
        scene_setup(read_scene(SCENES / "juhl_natural.toml"))


def test_a_distance_has_the_part_that_its_variance_gives_it(tmp_path: Path) -> None:
    """Added to a plan by the law of least squares: N + a'a / sigma^2, by hand, for a base between two stations."""
    known = "sigma_height = 0.001\nsigma_planimetry = 0.001"
    before = expect(Variations.read(small(tmp_path, ("sigma_height = 0.001", known))).setup())
    sigma = 0.0002
    table = f'[[design.distance]]\nfrom = "one"\nto = "two"\nsigma = {sigma}\n'
    text = (tmp_path / "small.toml").read_text(encoding="utf-8")
    (tmp_path / "base.toml").write_text(text + table, encoding="utf-8")
    after = expect(Variations.read(tmp_path / "base.toml").setup())
    names = list(before.plan.adjustment.names)
    cofactor = before.plan.adjustment.cofactor_of(names)
    along = np.array([2.0, 0.0, -0.4]) / np.hypot(2.0, 0.4)
    row = np.zeros(len(names))
    for i, axis in enumerate(("X0", "Y0", "Z0")):
        row[names.index(f"EO.one.{axis}")], row[names.index(f"EO.two.{axis}")] = -along[i], along[i]
    gain = cofactor @ row
    expected = cofactor - np.outer(gain, gain) / (sigma**2 + row @ gain)
    for name in ("IO.K.c", "EO.two.X0", "PT.6.Z"):
        i = names.index(name)
        assert after.plan.sigma(name) == pytest.approx(np.sqrt(expected[i, i]), rel=1e-6)
    (finding,) = after.plan.adjustment.further
    assert finding.redundancy == pytest.approx(sigma**2 / (sigma**2 + row @ gain), rel=1e-6)
    assert {group.group for group in after.groups} >= {"distance"}


def test_observed_orientations_hold_what_they_are_of(tmp_path: Path) -> None:
    """One frame's station is observed far better than targets give it; the other one's angles."""
    table = (
        '[[design.orientation]]\nimage = "one"\nposition_sigma = 1e-6\n'
        "[[design.orientation]]\nangles_sigma_deg = [1e-5, 1e-5, 1e-5]\n[[image]]"
    )
    plan = expect(Variations.read(small(tmp_path, ("[[image]]", table))).setup()).plan
    for axis in ("X0", "Y0", "Z0"):
        assert plan.sigma(f"EO.one.{axis}") == pytest.approx(1e-6, rel=0.01)
        assert plan.sigma(f"EO.two.{axis}") > 1e-5
    assert plan.sigma("EO.two.omega") == pytest.approx(math.radians(1e-5), rel=0.01)
    assert plan.sigma("EO.one.omega") > math.radians(1e-4)


def test_distances_hold_the_scale_of_a_free_network(tmp_path: Path) -> None:
    """Unknown points have no scale; one distance gives it, and design.json tells what would find an error of it."""
    free = 'sigma_height = "free"\nsigma_planimetry = "free"\ndatum = "minimal"'
    without = expect(Variations.read(small(tmp_path, ("sigma_height = 0.001", free))).setup())
    text = (tmp_path / "small.toml").read_text(encoding="utf-8")
    distances = "".join(
        f'[[design.distance]]\nfrom = "{start}"\nto = "{end}"\nsigma = 0.001\n'
        for start, end in (("1", "4"), ("13", "16"))
    )
    path = tmp_path / "free.toml"
    path.write_text(text + distances, encoding="utf-8")
    result = expect(Variations.read(path).setup())
    assert without.plan.adjustment.redundancy + 1 == result.plan.adjustment.redundancy  # one of both is needed
    assert run(["design", str(path)]) in (DONE, LOOK)
    content = json.loads((tmp_path / "free-design" / "design.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in content["distances"]] == ["1 to 4", "13 to 16"]
    assert all(each["detectable"] > 3.0 * 0.001 for each in content["distances"])


def test_frames_to_be_scanned_in_parts_are_planned_as_wholes(tmp_path: Path) -> None:
    whole = small(tmp_path).read_text(encoding="utf-8")
    half = '[[image]]\nname = "two_b"\nposition = [2.0, 0.0, 4.6]\nangles_deg = [0.0, 23.0, 90.0]\n'
    parts = whole.replace('name = "two"\n', 'name = "two_a"\npart_of = "two"\npart = [0.0, 0.6]\n')
    (tmp_path / "parts.toml").write_text(parts + half + 'part_of = "two"\npart = [0.4, 1.0]\n', encoding="utf-8")
    first, second = (expect(Variations.read(tmp_path / name).setup()) for name in ("small.toml", "parts.toml"))
    assert [image.name for image in second.network.images] == ["one", "two"]
    assert second.plan.sigma("IO.K.c") == pytest.approx(first.plan.sigma("IO.K.c"), rel=1e-9)
