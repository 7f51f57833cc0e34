"""What comes in from other programs: what was exported comes back with the same numbers, and hostile XML is refused."""

import csv
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from networks import FIDUCIALS
from projects import PITCH_MM, TRUTH, Capture, Refusal, adjusted_project, command, present, result_file
from studies import parametrize_with_studies

from adjust.functional_model.distortion_models import TORLEGARD_NAMES
from adjust.functional_model.lens import Lens, Prior
from adjust.problem.camera import FiducialDistance
from pipeline import InputError, read_images
from pipeline.cli import DONE, LOOK, WRONG_INPUT
from pipeline.exchange.certificate import fit, read_certificate
from pipeline.files.camera_file import CameraFile, read_camera
from pipeline.results.comparator_file import read_comparator, read_pitches

PITCH = ("--pitch-um", str(1000.0 * PITCH_MM))


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return adjusted_project(tmp_path_factory.mktemp("exported"))


def exported(project: Path, format: str, folder: Path, *options: str) -> Path:
    assert command("export", project, format, folder / f"{format}-out", *options) in (0, 1)
    return folder / f"{format}-out"


def imported(format: str, paths: list[Path], folder: Path, *options: str) -> Path:
    assert command("import", format, *paths, folder / format, *options) == DONE
    return folder / format


@parametrize_with_studies("format", ["mmvii", "micmac"], quick=(1,))
def test_marks_come_back_as_they_went(format: str, project: Path, tmp_path: Path) -> None:
    out = exported(project, format, tmp_path)
    files = {"mmvii": out.rglob("MesIm-*.xml"), "micmac": (out / "Ori-InterneScan").glob("*.xml")}[format]
    folder = imported(format, sorted(files), tmp_path, *PITCH)
    there = {(m.image, m.point, m.kind): m for m in read_comparator(folder / "comparator.csv")}
    here = {(m.image, m.point, m.kind): m for m in read_comparator(project.parent / "comparator.csv")}
    assert there.keys() == {key for key in here if format == "mmvii" or key[2] == "fiducial"}
    for key, mark in there.items():
        np.testing.assert_allclose(np.array([mark.xy_mm], float), np.array([here[key].xy_mm], float), atol=1e-9)
        np.testing.assert_allclose(np.array([mark.sigma_mm], float), np.array([here[key].sigma_mm], float), rtol=1e-9)
    assert read_pitches(folder / "comparator.csv")["f3"] == (100.0, 100.0)
    if format == "micmac":
        given = {one.id: one.xy_mm for one in read_camera(folder / "camera.toml").fiducials}
        for id, xy in FIDUCIALS.items():
            assert given[id] == pytest.approx(xy, abs=1e-6)


@pytest.mark.parametrize("name", ["MeasuresCamera.xml", "t11.xml"])
def test_fiducials_from_a_corner_give_no_principal_point(name: str, tmp_path: Path, capsys: Capture) -> None:
    """As published for a T-11, y down: the principal point lies near the middle of the marks, and is free."""
    places = {"P5": "0.000 117.521", "P6": "237.846 117.521", "P7": "120.428 0.000", "P8": "120.421 235.000"}
    one = "<OneMesureAF1I><NamePt>{}</NamePt><PtIm>{}</PtIm></OneMesureAF1I>"
    marks = "".join(one.format(id, xy) for id, xy in places.items())
    file = tmp_path / name
    file.write_text(f"<MesureAppuiFlottant1Im><NameIm>Glob</NameIm>{marks}</MesureAppuiFlottant1Im>")
    path = imported("micmac", [file], tmp_path) / "camera.toml"
    words = "the files give no principal point. Adjusting starts at the middle of the fiducials, (118.9, -117.5) mm"
    assert words in " ".join(capsys.readouterr().out.split())
    lines = path.read_text().splitlines()
    bare = tmp_path / "bare.toml"
    bare.write_text("\n".join(line for line in lines if not line.startswith("principal_point_mm")))
    for camera in map(read_camera, (path, bare)):
        assert camera.principal_point_mm == pytest.approx((118.923, -117.5))
        assert camera.principal_point_sigma_mm == (np.inf, np.inf)


def test_marks_without_a_sigma_need_one_that_is_stated(tmp_path: Path, refusal: Refusal) -> None:
    file = tmp_path / "MeasuresIm-a.tif.xml"
    none = "</NamePt><PrecPointe>-1</PrecPointe>"  # no standard deviation of 1 px
    file.write_text(MARKS.format("10 20").replace("<NameIm>a<", "<NameIm>a.tif<").replace("</NamePt>", none))
    assert "say with --sigma-px" in refusal("import", "micmac", file, tmp_path / "o", *PITCH)
    assert "with --pitch-um" in refusal("import", "micmac", file, tmp_path / "o")
    folder = imported("micmac", [file], tmp_path, *PITCH, "--sigma-px", "0.2")
    (mark,) = read_comparator(folder / "comparator.csv")
    assert (mark.image, mark.kind) == ("a", "fiducial")
    np.testing.assert_allclose([*np.asarray(mark.xy_mm), *np.asarray(mark.sigma_mm)], [1.0, -2.0, 0.02, 0.02])


@pytest.mark.parametrize("format", ["opencv", "colmap"])
def test_poses_and_cameras_come_back_as_they_went(format: str, project: Path, tmp_path: Path) -> None:
    out = exported(project, format, tmp_path, "--lens")
    paths = {"opencv": [out / "f1.yml"], "colmap": [out / "sparse"]}[format]
    folder = imported(format, paths, tmp_path, *PITCH)
    exterior = present(read_images(folder / "images.csv").exterior["f1"])
    assert not np.isfinite(exterior.sigmas).any()
    known = result_file(project.parent)["images"]["f1"]["exterior"]
    np.testing.assert_allclose(exterior.values[:3], [known[axis]["value"] for axis in ("X0", "Y0", "Z0")], atol=1e-8)
    angles = [known[f"{angle}_deg"]["value"] for angle in ("omega", "phi", "kappa")]
    np.testing.assert_allclose(np.degrees(exterior.values[3:]), angles, atol=1e-9)
    camera = read_camera(folder / ("camera.toml" if format == "opencv" else "camera2.toml"))
    assert camera.principal_distance_mm == pytest.approx(TRUTH.c, abs=1e-7)
    storage = cv2.FileStorage(str(exported(project, "opencv", tmp_path, "--lens") / "f1.yml"), cv2.FILE_STORAGE_READ)
    point = storage.getNode("camera_matrix").mat()[:2, 2] * (PITCH_MM, -PITCH_MM)
    assert camera.principal_point_mm == pytest.approx(point, abs=1e-9)


@pytest.mark.parametrize("format", ["opencv", "colmap"])
def test_cameras_of_rectified_frames_come_back_together(format: str, project: Path, tmp_path: Path) -> None:
    """Each frame has a size and origin of its own."""
    out = exported(project, format, tmp_path, "--lens")
    folder = imported(format, sorted(out.glob("*.yml")) or [out / "sparse"], tmp_path, *PITCH)
    images = read_images(folder / "images.csv")
    assert len(images.exterior) > 1
    cameras = {image: read_camera(folder / Path(file).name) for image, file in images.camera.items()}
    assert {Path(file).parent for file in images.camera.values()} == {folder}
    assert len({camera.name for camera in cameras.values()}) == len(images.exterior)
    lone = exported(project, "opencv", tmp_path, "--lens")
    for image, camera in cameras.items():
        alone = imported("opencv", [lone / f"{image}.yml"], tmp_path / image, *PITCH) / "camera.toml"
        assert camera.principal_point_mm == pytest.approx(present(read_camera(alone).principal_point_mm), abs=1e-9)
    assert "from the folder of project.toml" in " ".join((folder / "README.txt").read_text().split())


METASHAPE = "<calibration><width>9</width><height>9</height><f>3</f>{}</calibration>"
MARK = "<OneMesureAF1I><NamePt>1</NamePt><PtIm>{}</PtIm></OneMesureAF1I>"
MARKS = f"<MesureAppuiFlottant1Im><NameIm>a</NameIm>{MARK}</MesureAppuiFlottant1Im>"
PRECISION = MARKS.format("1 2").replace("</PtIm>", "</PtIm><PrecPointe>{}</PrecPointe>")
MESIM = (
    "<Root><Data><SetMesIm><NameIm>a.tif</NameIm><Measures><el><Name>p</Name><Pt>1 2</Pt><Sigma2>{}</Sigma2></el>"
    "</Measures></SetMesIm></Data></Root>"
)
PIXELS = "%YAML:1.0\n---\nK: !!opencv-matrix {{rows: 3, cols: 3, dt: d, data: [9, 0, 5, 0, 9, 5, 0, 0, 1]}}\n{}\n"
POSE = (
    "R: !!opencv-matrix {{rows: {}, cols: {}, dt: d, data: [{}]}}\n"
    "t: !!opencv-matrix {{rows: 1, cols: 3, dt: d, data: [{}]}}"
)
UNIT = "1, 0, 0, 0, 1, 0, 0, 0, 1"
CERTIFICATE = "calibrated_principal_distance_mm = 153.0\nangle_deg = [7.5, 15.0, 22.7]\nradial_um = [1.0, 2.0, 1.0]\n"
ENTITIES = '<!DOCTYPE a [<!ENTITY b "bbbbbbbb"><!ENTITY c "&b;&b;&b;&b;">]><a>&c;</a>'


@pytest.mark.parametrize(
    ("format", "text", "words"),
    [
        *((format, ENTITIES, "entities are not expanded") for format in ("micmac", "mmvii", "metashape")),
        ("micmac", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "entities are not expanded"),
        ("micmac", '<!DOCTYPE a SYSTEM "http://localhost/a.dtd"><a/>', "entities are not expanded"),
        ("micmac", "<a>" * 200, "more than 100 deep"),
        ("micmac", "<a><b></a>", "is not valid XML"),
        ("micmac", "<a/>", "has no <MesureAppuiFlottant1Im>"),
        ("micmac", MARKS.format("1 x"), "should be 2 numbers"),
        ("micmac", MARKS.format("1 nan"), "should be 2 numbers"),
        *(("micmac", PRECISION.format(s), f"<PrecPointe> of mark '1' is {s}; a positive") for s in ("0", "-2")),
        *(
            ("mmvii", MESIM.format(s), f"<Sigma2> of mark 'p' is {s}; a covariance")
            for s in ("0 0 0", "1 5 1", "-4 0 -1")
        ),
        ("opencv", "%YAML:1.0\n---\nK: 5\n", "K is no matrix"),
        ("opencv", "no yaml \x01 at all", "cv2.FileStorage"),
        ("metashape", "<calibration><width>10</width><height>9</height><f>-3</f></calibration>", "no positive f"),
        ("metashape", METASHAPE.format("<k4>1</k4>"), "k4 is 1"),
        ("metashape", METASHAPE.format("<p3>2</p3>"), "p3 is 2"),
        ("metashape", METASHAPE.format("<k4>O.1</k4>"), "a.xml: <k4> is 'O.1'; it should be 1 number"),
        ("metashape", METASHAPE.format("<k1>1</k1><k1>2</k1>"), "a.xml: <calibration> has 2 times <k1>; once is right"),
        ("metashape", "<calibration><projection>fisheye</projection></calibration>", "only frame cameras"),
        ("opencv", PIXELS.format("distortion_model: inverse_brown_conrady"), "inverse_brown_conrady, is none of"),
        ("opencv", PIXELS.format("xi: 0.8"), "omnidirectional (xi), is none of"),
        ("opencv", PIXELS.format("M2: 1"), "holds two cameras"),
        ("opencv", PIXELS.format("R: 5\nt: 5"), "R is no matrix"),
        ("opencv", PIXELS.format(POSE.format(3, 1, "0, 0, 0", "1, 2, 3")), "R is to be a 3 x 3 rotation matrix"),
        ("opencv", PIXELS.format(POSE.format(3, 3, UNIT, "1").replace("1, cols: 3", "1, cols: 1")), "t three numbers"),
        ("opencv", PIXELS.format(POSE.format(3, 3, "1, 0, 0, 0, 1, 0, 0, 0, -1", "1, 2, 3")), "is no rotation matrix"),
        ("opencv", PIXELS.format(POSE.format(3, 3, UNIT, "1, .Nan, 3")), "is no rotation matrix"),
        ("opencv", PIXELS.format("").replace("9, 5, 0", "-9, 5, 0"), "fx and fy positive"),
        ("opencv", PIXELS.format("").replace("5, 0, 9, 5, 0, 0, 1", "0, 0, 9, 0, 5, 5, 1"), "is transposed"),
        ("opencv", PIXELS.format("").replace("0, 0, 1]", "0, 0, 2]"), "[0, 0, 1]], in px"),
        ("opencv", PIXELS.format("D: {rows: 1, cols: 6, data: [0, 0, 0, 0, 0, 1]}"), "6 distortion coefficients"),
        ("opencv", PIXELS.format("D: {rows: 1, cols: 4, data: [0, x, 0, 0]}"), "D is no matrix"),
        ("opencv", PIXELS.format('image_width: "10"\nimage_height: 9'), "sides in px"),
        ("colmap", "", "is no reconstruction"),
        ("certificate", CERTIFICATE.replace("7.5, 15.0", "1e-7, 2e-7"), "no curve can be fitted"),
        ("certificate", "radial_um = [1.0]", "calibrated principal distance"),
        ("certificate", f"{CERTIFICATE}symmetry_mm = [0.0, 0.01]", "needs autocollimation_mm"),
        ("certificate", f"{CERTIFICATE}principal_point_mm = [0, 0]\nsymmetry_mm = [0.0, 0.01]", "Give either"),
    ],
)
def test_wrong_files_are_refused(format: str, text: str, words: str, tmp_path: Path, capfd: Capture) -> None:
    file = tmp_path / "MeasuresIm-a.xml"
    file.write_text(text)
    assert command("import", format, file, tmp_path / "o", *PITCH, "--sigma-px", "1") == WRONG_INPUT
    assert words in capfd.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_mark_of_mmvii_without_a_covariance_takes_the_given_one(tmp_path: Path) -> None:
    (tmp_path / "MesIm-a.xml").write_text(MESIM.format("-1 0 -1"))
    folder = imported("mmvii", [tmp_path / "MesIm-a.xml"], tmp_path, "--pitch-um", "10", "--sigma-px", "0.2")
    (mark,) = read_comparator(folder / "comparator.csv")
    np.testing.assert_allclose(np.array([mark.sigma_mm], float), 0.002)


def test_matrices_without_a_type_and_empty_ones_are_read(tmp_path: Path) -> None:
    """ROS's camera info states no type; cv2.FileStorage writes a lens without distortion as an empty matrix."""
    lens = "D: {rows: 1, cols: 5, data: [-0.1, 0.02, 0, 3e-4, 7]}"
    (tmp_path / "ros.yaml").write_text(f"K: {{rows: 3, cols: 3, data: [9, 0, 5, 0, 8, 5, 0, 0, 1]}}\n{lens}\n")
    camera = read_camera(imported("opencv", [tmp_path / "ros.yaml"], tmp_path, *PITCH) / "camera.toml")
    values = {name: prior.value for name, prior in camera.distortion.parameters.items()}
    assert values == {"b1": 0.125, "k1": -0.1, "k2": 0.02, "p2": 3e-4, "k3": 7.0}
    (tmp_path / "none.yml").write_text(PIXELS.format("D: !!opencv-matrix {rows: 0, cols: 0, dt: d, data: []}"))
    camera = read_camera(imported("opencv", [tmp_path / "none.yml"], tmp_path, *PITCH) / "camera.toml")
    assert camera.distortion.family == "none"


@pytest.mark.parametrize(
    ("others", "without"), [("", ""), ("2 1 0 0 0 1 2 3 2 b.jpg\n\n", " Images without a camera: b.")]
)
def test_a_camera_that_is_not_read_is_named_and_its_images_take_no_other(
    others: str, without: str, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 100 100 50 50 50 50\n2 FOV 100 100 50 50 50 50 0.1\n")
    (tmp_path / "images.txt").write_text(f"1 1 0 0 0 1 2 3 1 a.jpg\n\n{others}")
    (tmp_path / "points3D.txt").write_text("")
    assert command("import", "colmap", tmp_path, tmp_path / "out", *PITCH) == LOOK
    words = f"Left out: - Camera 2 is of the model FOV, which is not read.{without}"
    assert words in " ".join(capsys.readouterr().out.split())
    images = read_images(tmp_path / "out" / "images.csv")
    assert (tmp_path / "out" / (Path(images.camera["a"]).name if others else "camera.toml")).exists()
    assert ("b" in images.exterior) == bool(others)
    assert not images.camera.get("b")


def test_an_image_and_a_certificate_are_given_once(tmp_path: Path, refusal: Refusal) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.yml").write_text(PIXELS.format(POSE.format(3, 3, UNIT, "1, 2, 3")))
        (tmp_path / name / "c.toml").write_text(CERTIFICATE)
    for format, file, words in (("opencv", "1.yml", "image '1' is given twice"), ("certificate", "c.toml", "'c'")):
        files = (tmp_path / name / file for name in ("a", "b"))
        assert words in refusal("import", format, *files, tmp_path / "o", *PITCH)


def test_a_folder_that_is_a_link_stays_one_and_the_own_one_is_refused(
    tmp_path: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "certificate").symlink_to(tmp_path / "real")
    (tmp_path / "c.toml").write_text(CERTIFICATE)
    imported("certificate", [tmp_path / "c.toml"], tmp_path)
    assert (tmp_path / "certificate").is_symlink()
    assert (tmp_path / "real" / "camera.toml").exists()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["c.toml", "certificate", "real"]
    monkeypatch.chdir(tmp_path / "real")
    assert "is the folder that reseau runs in" in refusal("import", "certificate", tmp_path / "c.toml", ".")


def test_a_fisheye_of_opencv_s_own_program_is_one(tmp_path: Path) -> None:
    """Its calibration program tells the model by a flag."""
    (tmp_path / "fish.yml").write_text(PIXELS.format("fisheye_model: 1"))
    camera = read_camera(imported("opencv", [tmp_path / "fish.yml"], tmp_path, *PITCH) / "camera.toml")
    assert camera.distortion.family == "opencv_fisheye"


# A certificate

ANGLES = [7.5, 15.0, 22.7, 30.0, 35.0, 40.0]
TABLE = [1.0, 2.0, 1.0, -1.0, -2.0, 3.0]


def printed(path: Path, c: float, radial_um: list[float], **more: str) -> Path:
    lines = [f"calibrated_principal_distance_mm = {c!r}", f"angle_deg = {ANGLES}", f"radial_um = {radial_um}"]
    path.write_text("\n".join([*lines, *(f"{key} = {value}" for key, value in more.items())]) + "\n", encoding="utf-8")
    return path


def distortion_um(c: float, equivalent: float, k: tuple[float, float, float], angle_deg: float) -> float:
    """r - c tan t, where r - k3 r^3 - k5 r^5 - k7 r^7 = equivalent tan t, by fixed-point iteration."""
    tangent = np.tan(np.radians(angle_deg))
    r = equivalent * tangent
    for _ in range(50):
        r = equivalent * tangent + k[0] * r**3 + k[1] * r**5 + k[2] * r**7
    return float(1000.0 * (r - c * tangent))


def test_a_certificate_gives_back_the_lens_that_it_was_made_of_by_angles_and_radii(tmp_path: Path) -> None:
    k, c, equivalent = (2.0e-8, -1.5e-12, 2.0e-17), 153.00, 153.02
    table = [distortion_um(c, equivalent, k, angle) for angle in ANGLES]
    fitted = fit(read_certificate(printed(tmp_path / "c.toml", c, table)))
    assert fitted.equivalent_mm == pytest.approx(equivalent, abs=1e-8)
    np.testing.assert_allclose(fitted.coefficients, k, rtol=1e-6)
    np.testing.assert_allclose(fitted.residuals_um, 0.0, atol=1e-6)
    radii = [c * np.tan(np.radians(angle)) + um / 1000.0 for angle, um in zip(ANGLES, table, strict=True)]
    text = f"calibrated_principal_distance_mm = {c}\nradius_mm = {[float(r) for r in radii]}\nradial_um = {table}\n"
    (tmp_path / "r.toml").write_text(text)
    by_radius = fit(read_certificate(tmp_path / "r.toml"))
    assert by_radius.equivalent_mm == pytest.approx(fitted.equivalent_mm, abs=1e-7)
    np.testing.assert_allclose(by_radius.coefficients, fitted.coefficients, rtol=1e-6, atol=1e-20)
    # Noise in the table moves the lens by its standard deviation.
    rng, off = np.random.default_rng(4), []
    exact = read_certificate(printed(tmp_path / "c.toml", c, table, sigma_um="2.0"))
    for _ in range(300):
        noisy = np.array(exact.radial_um) + rng.normal(0.0, 2.0, len(table))
        off.append(fit(replace(exact, radial_um=tuple(noisy.tolist()))).equivalent_mm - equivalent)
    assert np.std(off) == pytest.approx(fit(exact).sigmas[0], rel=0.15)


def test_what_a_calibration_does_not_say_is_no_knowledge(tmp_path: Path, capsys: Capture) -> None:
    """A certificate without a principal point leaves it to the points; a calibration without standard deviations is
    held fixed, and says so."""

    def camera_and_words(format: str, file: Path, *options: str) -> tuple[CameraFile, str]:
        camera = read_camera(imported(format, [file], tmp_path, *options) / "camera.toml")
        return camera, " ".join(capsys.readouterr().out.split())

    camera, words = camera_and_words("certificate", printed(tmp_path / "c.toml", 153.0, TABLE))
    assert (camera.principal_point_mm, camera.principal_point_sigma_mm) == (None, (np.inf, np.inf))
    assert "gives no principal point: it is left to the points" in words
    table = printed(tmp_path / "c.toml", 153.0, TABLE, principal_point_mm="[0.01, 0.02]")
    camera, words = camera_and_words("certificate", table)
    assert camera.principal_point_mm == (0.01, 0.02)
    assert "no standard deviation of the principal point: 1 mm is assumed" in words
    table.write_text(f'{table.read_text()}[[fiducial]]\nid = "1"\nxy_mm = [-106, 106]\nsigma_mm = 0.01\n')
    camera, words = camera_and_words("certificate", table)
    assert camera.principal_point_mm == (0.01, 0.02)
    assert "the files give no principal point" not in words
    (tmp_path / "m.xml").write_text("<calibration><width>600</width><height>400</height><f>500</f></calibration>")
    _, words = camera_and_words("metashape", tmp_path / "m.xml", *PITCH)
    assert "no standard deviations. The calibration is held fixed" in words


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("= 153.0", "= 0.153", "reaches from the axis to 0.1314 mm"),
        ("= 153.0", "= 15.3", "to 12.84 mm (40 degrees), the fiducials to 149.9 mm"),
        (str(ANGLES), "[0.13, 0.26, 0.40, 0.52, 0.61, 0.70]", "Give degrees and mm"),
        (str(TABLE), "[0.003, 0.004, 0.001, -0.003, -0.004, 0.003]", "is 0.004 µm at most. Give µm"),
        ("-106", "-106000", "the fiducials to 1.06e+05 mm"),
    ],
)
def test_another_unit_in_a_certificate_is_refused(
    old: str, new: str, words: str, tmp_path: Path, refusal: Refusal
) -> None:
    table = printed(tmp_path / "c.toml", 153.0, TABLE)
    text = f'{table.read_text()}[[fiducial]]\nid = "1"\nxy_mm = [-106, 106]\n'
    assert old in text
    table.write_text(text.replace(old, new))
    assert words in refusal("import", "certificate", table, tmp_path / "out")


def test_two_principal_points_of_a_certificate_are_one_lens(tmp_path: Path) -> None:
    """Distortion about the point of symmetry, a camera file with that of autocollimation: the same places where
    nothing but k3 is, and to a fifth of what it matters where k5 is."""
    ppa, pps = np.array([0.004, -0.012]), np.array([-0.076, 0.078])
    for k, left_um in (((4.0e-7, 0.0, 0.0), 0.01), ((4.0e-7, -5.0e-12, 0.0), 0.15)):
        table = [distortion_um(153.0, 153.0, k, angle) for angle in ANGLES]
        points = {"autocollimation_mm": f"{ppa.tolist()}", "symmetry_mm": f"{pps.tolist()}"}
        camera = read_camera(
            imported("certificate", [printed(tmp_path / "c.toml", 153.0, table, **points)], tmp_path) / "camera.toml"
        )
        assert camera.principal_point_mm == tuple(ppa)
        angle, radius = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False), np.array([40.0, 80.0, 110.0])
        xy = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).reshape(-1, 2)
        about, s2 = xy - (pps - ppa), np.square(xy).sum(axis=1, keepdims=True)
        r2 = np.square(about).sum(axis=1, keepdims=True)
        true_um = 1e3 * about * (k[0] * r2 + k[1] * r2**2 + k[2] * r2**3)
        assert camera.distortion.parameters.keys() >= {"p1", "p2"}
        values = [camera.distortion.parameters.get(name, Prior(0.0)).value for name in TORLEGARD_NAMES]
        lens = Lens(camera.distortion, np.array([153.0, *ppa]), np.array(values))
        found_um = lens.displacement(xy).value_um
        off = found_um - true_um
        assert np.abs(off - off.mean(axis=0)).max() < left_um
        assert np.abs(true_um - 1e3 * xy * (k[0] * s2 + k[1] * s2**2)).max() > 0.8  # it matters


def test_a_certificate_of_distances(tmp_path: Path) -> None:
    lines = ["[[fiducial]]", 'id = "1"', "xy_mm = [-106, 106]", "[[fiducial]]", 'id = "3"', "xy_mm = [106, -106]"]
    lines += ["[[fiducial_distance]]", 'from = "1"', 'to = "3"', "mm = 299.816", "sigma_mm = 0.005"]
    table = printed(tmp_path / "c.toml", 153.0, TABLE)
    table.write_text("\n".join([table.read_text(), *lines]) + "\n")
    camera = read_camera(imported("certificate", [table], tmp_path) / "camera.toml")
    assert camera.distances == (FiducialDistance("1", "3", 299.816, 0.005),)
    table.write_text(table.read_text().replace('to = "3"', 'to = "33"'))
    with pytest.raises(InputError, match=r"no fiducial '33'\. Did you mean '3'"):
        read_certificate(table)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"1-3": 213.0}, "in the figure that fits all best"),  # a misprint of 1 mm in a square of 212 mm
        ({"2-1": 299.95}, "mm, but 299.8"),  # one distance twice, 0.137 mm apart
        ({"1-3": 112.0, "1-4": 112.0, "2-3": 112.0, "2-4": 112.0}, "1 to 2 is 299.813 mm, but 22"),  # no triangle
    ],
)
def test_distances_of_a_certificate_that_contradict_each_other_are_refused(
    changed: dict[str, float], words: str, tmp_path: Path, refusal: Refusal
) -> None:
    known = {"1-2": 299.813, "3-4": 299.813, "1-3": 212.0, "1-4": 212.0, "2-3": 212.0, "2-4": 212.0} | changed
    file = tmp_path / "old.toml"
    file.write_text(CERTIFICATE + "[fiducial_distance_mm]\n" + "".join(f'"{p}" = {mm}\n' for p, mm in known.items()))
    assert words in refusal("import", "certificate", file, tmp_path / "o")


def test_a_certificate_of_distances_alone_places_its_marks(
    tmp_path: Path, refusal: Refusal, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five marks at uneven places, nine of ten distances: the figure comes back up to rotation and reflection."""
    xy = {"1": (-106.0, -105.0), "3": (-104.0, 107.0), "2": (106.0, 106.0), "4": (105.0, -106.0), "5": (112.0, 3.0)}
    pairs = list(combinations(xy, 2))[1:]
    known = {f"{a}-{b}": float(np.hypot(*np.subtract(xy[a], xy[b]))) for a, b in pairs}
    table = printed(tmp_path / "c.toml", 153.0, TABLE)
    lines = [table.read_text(), "[fiducial_distance_mm]", *(f'"{pair}" = {mm!r}' for pair, mm in known.items())]
    table.write_text("\n".join(lines) + "\n")
    camera, words = read_camera(imported("certificate", [table], tmp_path) / "camera.toml"), capsys.readouterr().out
    found = {mark.id: np.array(mark.xy_mm) for mark in camera.fiducials}
    assert np.linalg.norm(found["3"] - found["1"]) == pytest.approx(np.hypot(2.0, 212.0), abs=1e-5)  # not among them
    assert found["1"].max() < -100.0
    assert found["3"][0] < 0.0 < found["3"][1]
    assert {mark.sigma_mm for mark in camera.fiducials} == {(1.0, 1.0)}
    assert camera.distances[0] == FiducialDistance("1", "2", known["1-2"], 0.01)
    assert "approximated by the distances" in words
    assert "a standard deviation of 0.01 mm" in words
    folded = [line for line in lines[2:] if "5" not in line.split("=")[0]]  # of four marks, one of which can be folded
    for rows, message in (
        (['"1-2" = 299.8'], "does not tell where the 2 fiducials lie"),
        (['"1-2-3" = 299.8'], "has '1-2-3'"),
        (folded, "where the 4 fiducials lie"),
    ):
        table.write_text("\n".join([*lines[:2], *rows]) + "\n")
        assert message in refusal("import", "certificate", table, tmp_path / "out")


def test_a_published_table_is_fitted_to_its_rounding(tmp_path: Path) -> None:
    """U.S. Geological Survey, Report of Calibration OSL/1785 (1992): radial distortion of a Lamegon PI/C, mean of four
    half diagonals, in whole um and accurate within 5."""
    table = read_certificate(printed(tmp_path / "osl.toml", 152.299, [3.0, 4.0, 1.0, -3.0, -4.0, 3.0]))
    fitted = fit(table)
    assert np.abs(fitted.residuals_um).max() < 1.5
    assert fitted.calibrated_mm == pytest.approx(152.299, abs=0.005)
    assert fitted.equivalent_mm - 152.299 > 0.01  # its distortion begins by rising
    folder = imported("certificate", [tmp_path / "osl.toml"], tmp_path)
    camera = read_camera(folder / "camera.toml")
    assert camera.principal_distance_mm == pytest.approx(fitted.equivalent_mm)
    assert camera.distortion.family == "torlegard"
    rows = list(csv.reader((folder / "osl-residuals.csv").read_text().splitlines()[1:]))
    assert [float(row[2]) for row in rows[1:]] == [3.0, 4.0, 1.0, -3.0, -4.0, 3.0]
    assert "calibrated 152.29" in (folder / "README.txt").read_text()
