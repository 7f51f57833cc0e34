"""`reseau design`: what would help, sweeps, files and messages."""

import json
import math
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from projects import Capture, Printed, Refusal, command, fiducial_tables, present

from pipeline import InputError
from pipeline.cli import DONE, WRONG_INPUT
from pipeline.design.expected import alternatives, expect, rms, sigmas_of_images_alone
from pipeline.design.setup import planned_network, scene_setup
from pipeline.design.sweeps import Variations, sweep
from pipeline.rendered.scene_file import read_scene
from pipeline.rendered.scene_tables import Sweep
from pipeline.text.files import FORMS, check_replaceable

SCENES = Path(str(resources.files("synthetic_images").joinpath("scenes")))
SMALL = (
    """
[camera]
name = "K"
frame_mm = [60.0, 60.0]
principal_distance_mm = 60.0
distortion = {family = "torlegard", sigma = {k3 = "free"}}
"""
    + fiducial_tables({"a": (28, 28), "b": (-28, 28), "c": (-28, -28), "d": (28, -28)}, table="camera.fiducial")
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
    path.write_text(text)
    return path


def test_what_would_help_is_tried(tmp_path: Path) -> None:
    photo = '[[design.photo]]\nname = "third"\nposition = [-2.0, 0.0, 4.6]\nangles_deg = [0.0, -23.0, 0.0]\n[[image]]'
    basis = expect(Variations.read(small(tmp_path, ("[[image]]", photo))).setup())
    helpful = {one.change: one for one in alternatives(basis)}
    third = helpful["one more photo: third"]
    assert len(third.expected.network.images) == 3
    assert all(gain > 0.0 for gain in third.gain_percent.values())
    assert sum(change.startswith("one more photo: as ") for change in helpful) == 3
    better = present(helpful["given heights twice as good"].expected.network.points[0].Z)
    assert better.sigma == 0.0005
    targets = helpful["targets measured twice as well"].gain_percent
    assert 30.0 < targets["k3"] <= 50.0
    doubled = helpful["twice as many points, spread alike"].gain_percent
    assert doubled["k3"] == pytest.approx(100 * (1 - math.sqrt(0.5)), abs=1.0)


def swept(folder: Path) -> Path:
    """The scene with a sweep, and k3 given."""
    sweep = '[[design.sweep]]\nquantity = "design.transformation"\nvalues = ["similarity", "affine"]\n[[image]]'
    return small(folder, ("[[image]]", sweep), ('"torlegard", ', '"torlegard", value = {k3 = -6e-6}, '))


def test_design_writes_what_it_found(tmp_path: Path, capsys: Capture) -> None:
    assert command("design", swept(tmp_path), "--json") == DONE
    folder = tmp_path / "small-design"
    content = json.loads((folder / "design.json").read_text())
    assert content == json.loads(capsys.readouterr().out)
    files = {each.name: each for each in folder.iterdir()}
    assert files.keys() == {"design.json", "sweep-1-design.transformation.svg"}
    for path in files.values():  # its own files may be replaced, others not
        check_replaceable(path, FORMS[path.suffix], "")
    plot = files["sweep-1-design.transformation.svg"]
    svg = plot.read_bytes()
    plot.write_text("mine")
    assert command("design", swept(tmp_path)) == WRONG_INPUT
    plot.write_bytes(svg)
    camera, targets = content["cameras"]["K"], content["reliability"]["groups"]["target"]
    assert 0.0 < camera["principal_distance_mm"]["sigma"] < 1.0
    assert [at["radius_mm"] for at in camera["precision_at_radii"]] == pytest.approx(
        [np.hypot(30, 30) * quarter / 4 for quarter in (1, 2, 3, 4)]
    )
    assert content["marks"] == {"target": 32, "fiducial": 8}
    assert content["points"]["6"]["images"] == 2
    assert content["point_summary"]["X"]["estimated"] == 0
    assert 0.0 < content["point_summary"]["Z"]["rms"] < 0.001
    assert targets["smallest_error"]["median"] > 4.13 * 5.0  # delta0 times sigma, over the root of a part of 1
    assert {one["parameter"] for one in content["reliability"]["camera"]} >= {"IO.K.c", "IO.K.k3", "FID.K.a.x"}
    (sweep,) = content["sweeps"]
    assert [step["value"] for step in sweep["steps"]] == ["similarity", "affine"]
    drawn = ElementTree.parse(folder / sweep["picture"]).getroot()
    drawn_words = {word.text for word in drawn.iter("{http://www.w3.org/2000/svg}text")}
    assert drawn_words >= {"similarity", "affine", "design.transformation", "c", "k3"}


def test_design_prints_its_tables(tmp_path: Path, printed: Printed) -> None:
    table = printed("design", swept(tmp_path), tmp_path / "there")
    k3 = next(line for line in table.splitlines() if line.startswith("│ k3"))
    assert k3.count("e-6") == 3  # value, sigma, and that of the photographs alone, by the value's power of ten
    assert "minimal detectable errors" in table
    assert "Improvements: decrease of sigma" in table
    assert "Sigmas over design.transformation" in table


def test_the_network_is_what_the_frames_show(tmp_path: Path) -> None:
    setup = Variations.read(small(tmp_path)).setup()
    network, values = planned_network(setup)
    assert len(network.points) == 16
    assert present(network.point_by_id["1"].X).sigma == 0.0
    assert present(network.point_by_id["1"].Z).sigma == 0.001
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
        ("camera.principal_distance_mm", 45, lambda setup: setup.lens.principal_distance_mm),
        ("field.points", 36, lambda setup: len(setup.points)),
        ("field.grid.1.relief", 0, lambda setup: max(abs(point.xyz[2]) for point in setup.points)),
        ("design.sigma_fiducial_um", 45, lambda setup: setup.settings.sigma_fiducial_um),
    ],
)
def test_quantities_vary(tmp_path: Path, quantity: str, value: float, found: Callable[[object], float]) -> None:
    varied = Variations.read(small(tmp_path)).set_value(1, Sweep(quantity=quantity, values=(value, 99)), value)
    assert found(varied.setup()) == pytest.approx(value)


def test_points_and_cameras_of_other_files_can_be_varied_and_natural_points_not(tmp_path: Path) -> None:
    setup = Variations.read(small(tmp_path)).set_value(1, Sweep(quantity="field.points", values=(100, 1)), 100).setup()
    assert np.ptp([point.xyz[:2] for point in setup.points], axis=0) == pytest.approx([4.0 * 9 / 10] * 2)
    sweep = Sweep(quantity="camera.principal_distance_mm", values=(210.0, 300.0))
    varied = Variations.read(SCENES / "aerial_five.toml").set_value(1, sweep, 210.0).setup()
    assert (varied.lens.principal_distance_mm, len(varied.camera.fiducials)) == (210.0, 8)
    camera = SMALL[SMALL.index("[camera]") : SMALL.index("[field]")]
    scene = small(tmp_path, (camera, 'camera = "library:wild-rc8-153"\n'))
    assert Variations.read(scene).set_value(1, sweep, 210.0).setup().lens.principal_distance_mm == 210.0
    with pytest.raises(InputError, match="has no targets"):
        scene_setup(read_scene(SCENES / "juhl_natural.toml"))


@pytest.mark.parametrize(
    ("quantity", "words"),
    [
        ("design.sigma_heigth", "Did you mean 'sigma_height'?"),
        ("exterior.tow.X0", "there is no image 'tow'. Did you mean 'two'? There are one, two."),
        ("exterior.two.kapa_deg", "Did you mean 'kappa_deg'?"),
        ("image.two.position.4", "has no '4'"),
        ("field.points", "counts things"),
    ],
)
def test_a_wrong_quantity_is_reported_with_what_is_near(tmp_path: Path, quantity: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        sweep(Variations.read(small(tmp_path)), 1, Sweep(quantity=quantity, values=(1.5, 2.5)))
    assert f"[design.sweep[1]] {quantity} = 1.5" in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("layouts = 0", "layouts: must be a whole number of at least 1"),
        ('transformation = "afine"', "Did you mean 'affine'?"),
        ('control_points = ["77"]', "the field has no target '77'"),
        ('[[design.sweep]]\nquantity = "images"\nvalues = [2]', "needs two different values"),
        ('[[design.sweep]]\nquantity = "design..x"\nvalues = [2, 3]', "write a dotted name"),
        ('[[design.distance]]\nfrom = "1"\nto = "three"\nsigma = 0.1', "'three' is neither a target nor an image"),
        ('[[design.distance]]\nfrom = "1"\nto = "1"\nsigma = 0.1', "two ends"),
        ('[[design.orientation]]\nimage = "ones"\nposition_sigma = 0.1', "no image 'ones'"),
        ('[[design.orientation]]\nimage = "one"', "nothing is observed"),
    ],
)
def test_a_wrong_table_is_reported(tmp_path: Path, refusal: Refusal, line: str, words: str) -> None:
    assert words in refusal("design", small(tmp_path, ("[[image]]", f"{line}\n[[image]]")))
    assert not (tmp_path / "small-design").exists()


def test_a_scan_that_is_no_table_is_refused(tmp_path: Path, refusal: Refusal) -> None:
    scene = small(tmp_path)
    scene.write_text("scan = 3\n" + scene.read_text())
    assert "scan" in refusal("design", scene)


def test_fiducials_of_photographs_alone_are_the_mean_of_as_many(tmp_path: Path) -> None:
    """Closed form where targets tell film and orientation: sigma over the root of the number of frames, less the four
    of 2 m coordinates that shift, turn and scale take."""
    for given in ("1.0", "0.002"):
        scene = small(
            tmp_path,
            ("[design]", "[design]\nsigma_target_um = 1e-4\nsigma_fiducial_um = 3.0"),
            ("sigma_height = 0.001", "sigma_height = 0"),
            ('id = "a"\n', f'id = "a"\nsigma_mm = {given}\n'),
        )
        sigmas = sigmas_of_images_alone(expect(Variations.read(scene).setup()))
        marks = [sigma for parameter, sigma in sigmas.items() if parameter.kind == "fiducial"]
        assert rms(marks) == pytest.approx(0.003 / math.sqrt(2) * math.sqrt(1 - 4 / 8), rel=1e-4)


def test_a_distance_has_the_part_that_its_variance_gives_it(tmp_path: Path) -> None:
    """Added to a plan by the law of least squares: N + a'a / sigma^2, by hand, for a base between two stations."""
    known = "sigma_height = 0.001\nsigma_planimetry = 0.001"
    before = expect(Variations.read(small(tmp_path, ("sigma_height = 0.001", known))).setup())
    sigma = 0.0002
    table = f'[[design.distance]]\nfrom = "one"\nto = "two"\nsigma = {sigma}\n'
    text = (tmp_path / "small.toml").read_text()
    (tmp_path / "base.toml").write_text(text + table)
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


def test_observed_orientations_hold(tmp_path: Path) -> None:
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


def test_frames_to_be_scanned_in_parts_are_planned_as_wholes(tmp_path: Path) -> None:
    whole = small(tmp_path).read_text()
    half = '[[image]]\nname = "two_b"\nposition = [2.0, 0.0, 4.6]\nangles_deg = [0.0, 23.0, 90.0]\n'
    parts = whole.replace('name = "two"\n', 'name = "two_a"\npart_of = "two"\npart = [0.0, 0.6]\n')
    (tmp_path / "parts.toml").write_text(parts + half + 'part_of = "two"\npart = [0.4, 1.0]\n')
    first, second = (expect(Variations.read(tmp_path / name).setup()) for name in ("small.toml", "parts.toml"))
    assert [image.name for image in second.network.images] == ["one", "two"]
    assert second.plan.sigma("IO.K.c") == pytest.approx(first.plan.sigma("IO.K.c"), rel=1e-9)
