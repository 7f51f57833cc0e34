"""adjustment.json and adjustment.npz: what is written is what was adjusted, and what is broken is said."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import made_up_calibration
import networks as nets
import numpy as np
import pytest

from adjust import Adjustment, ObjectPoint, Prior, adjust
from adjust.problem.network import Image
from adjust.quality.run import Residuals
from pipeline import InputError, read_adjustment, write_adjustment
from pipeline.results import adjustment_content, stage_files
from pipeline.results.adjustment_file import covariance_path, read_covariance
from pipeline.results.adjustment_record import Quantity
from pipeline.results.record_json import json_text


@pytest.fixture
def adjustment() -> Adjustment:
    return made_up_calibration.adjustment()


def plain_json(record: object) -> Any:
    """What a file would hold."""
    return json.loads("".join(json_text(record)))


@pytest.fixture
def path(adjustment: Adjustment, tmp_path: Path) -> Path:
    write_adjustment(adjustment, tmp_path / "adjustment.json")
    return tmp_path / "adjustment.json"


def file_content(path: Path) -> Any:
    """What the file holds."""
    return json.loads(path.read_text())


def test_values_stand_with_a_posteriori_sigmas(adjustment: Adjustment, path: Path) -> None:
    camera = file_content(path)["cameras"]["RC 20"]
    sigma0 = np.sqrt(262.1 / 257)
    assert camera["principal_distance_mm"]["value"] == 153.664
    assert camera["principal_distance_mm"]["sigma"] == pytest.approx(0.0041 * sigma0, rel=1e-12)
    assert camera["principal_distance_mm"]["given"] == {"value": 153.6, "sigma": 1.0}
    assert camera["distortion"]["family"] == "torlegard"
    assert camera["distortion"]["k3"]["given"] == {"value": 0.0, "sigma": None}, "free: no sigma is given"
    assert camera["distortion"]["k7"] == {"value": 0.0, "sigma": 0.0, "given": {"value": 0.0, "sigma": 0.0}}
    assert set(camera["fiducials"]) == set("12345678")
    assert file_content(path)["points"]["3"]["Z"]["sigma"] == 0.0
    omega = file_content(path)["images"]["f3"]["exterior"]["omega_deg"]
    assert omega["value"] == pytest.approx(np.rad2deg(adjustment.value("EO.f3.omega")), rel=1e-14)
    assert omega["sigma"] == pytest.approx(np.rad2deg(3e-5) * adjustment.sigma0, rel=1e-12)
    variance = read_covariance(path).select(["EO.f3.omega"])
    assert variance[0, 0] == pytest.approx((3e-5 * adjustment.sigma0) ** 2, rel=1e-12)
    exterior = file_content(path)["images"]["f1"]["exterior"]
    assert exterior["Z0"]["given"] == {"value": 1500.0, "sigma": None}
    assert exterior["kappa_deg"]["given"]["sigma"] == pytest.approx(np.rad2deg(0.5))
    assert "given" not in file_content(path)["images"]["f2"]["exterior"]["Z0"]
    block = read_covariance(path).select(["IO.RC 20.c", "IO.RC 20.k3", "IO.RC 20.nothing"])
    assert block[0, 1] == pytest.approx(-0.95 * 0.0041 * 3.1e-9 * 262.1 / 257)
    assert np.all(block[2] == 0.0)
    assert np.all(block[:, 2] == 0.0)


def test_residuals_stand_in_the_scan_and_in_the_camera(adjustment: Adjustment, path: Path) -> None:
    """f2 is mirrored: x' = 0.1 - x + 0.02 y, y' = 0.2 + 0.02 x + y."""
    i = adjustment.network.observations.image.index("f2")
    row = file_content(path)["residuals"][i]
    x, y = adjustment.network.observations.xy_mm[i]
    assert (row["image"], row["point"], row["kind"]) == ("f2", "1", "fiducial")
    assert row["camera_x_mm"] == pytest.approx(0.1 - x + 0.02 * y)
    assert row["camera_y_mm"] == pytest.approx(0.2 + 0.02 * x + y)
    assert row["camera_vx_um"] == pytest.approx(-row["vx_um"] + 0.02 * row["vy_um"], abs=1e-9)
    assert row["sx_um"] == pytest.approx(4.0)
    assert row["vx_um"] == pytest.approx(1e3 * adjustment.residuals.v_mm[i, 0])


def test_w_is_the_larger_of_both_axes_and_unseen_points_are_left_out(adjustment: Adjustment, tmp_path: Path) -> None:
    w = adjustment.residuals.w.copy()
    w[0], w[1], w[2] = (1.0, -2.5), (np.nan, 0.5), (np.nan, np.nan)
    residuals = Residuals(adjustment.residuals.v_mm, adjustment.residuals.redundancy, w)
    made_up = made_up_calibration.adjustment()
    changed = replace(made_up, known={**made_up.known, "residuals": residuals})
    write_adjustment(changed, tmp_path / "adjustment.json")
    rows = file_content(tmp_path / "adjustment.json")["residuals"]
    assert [row["w"] for row in rows[:3]] == [-2.5, 0.5, None]
    unseen = ObjectPoint("unseen", Prior(1.0), Prior(2.0), None)
    network = replace(adjustment.network, points=(*adjustment.network.points, unseen))
    write_adjustment(replace(adjustment, network=network), tmp_path / "adjustment.json")
    assert "unseen" not in file_content(tmp_path / "adjustment.json")["points"]


def test_a_singular_result_has_its_causes_no_sigmas_and_no_nan(tmp_path: Path) -> None:
    path = tmp_path / "adjustment.json"
    write_adjustment(made_up_calibration.singular_adjustment(), path)

    def refuse(constant: str) -> NoReturn:
        raise AssertionError(f"{constant} is no JSON")

    json.loads(path.read_text(), parse_constant=refuse)
    content = file_content(path)
    assert not content["converged"]
    assert content["singular"][0]["parameters"] == ["IO.RC 20.c", "EO.f1.Z0"]
    assert content["singular"][0]["remedy"] == "Fix c."
    assert content["cameras"]["RC 20"]["principal_distance_mm"]["sigma"] is None


def test_what_is_read_is_what_was_written(adjustment: Adjustment, path: Path) -> None:
    before = path.read_bytes()
    write_adjustment(adjustment, path)
    assert path.read_bytes() == before
    assert sorted(file.name for file in path.parent.iterdir()) == ["adjustment.json", "adjustment.npz"]
    assert plain_json(read_adjustment(path)) == file_content(path)
    content = file_content(path)
    content["groups"]["target"]["rms_x_um"] = content["residuals"][0]["w"] = None
    path.write_text(json.dumps(content))
    record = read_adjustment(path)
    assert np.isnan([record.groups["target"].rms_x_um, record.residuals[0].w]).all()
    assert plain_json(record) == content


def test_the_file_has_the_keys_of_its_contract(path: Path) -> None:
    """As docs and users' scripts know them; more may come."""
    content = file_content(path)
    assert set(content) >= {
        "reseau", "made_from", "converged", "termination", "observations", "redundancy", "vpv", "sigma0", "covariance",
        "singular", "correlations", "warnings", "notes", "left_out", "variance_factors", "explanations", "suspects",
        "reliability", "cameras", "scanners", "boards", "images", "frames", "points", "residuals", "groups", "history",
    }  # fmt: skip
    assert list(content["images"]["f1"]) == ["camera", "scanner", "transformation", "exterior"]
    film = content["images"]["f1"]["transformation"]
    assert list(film) == ["kind", "mirrored", "a1", "a2", "a3", "b1", "b2", "b3"]
    assert list(content["residuals"][0])[:11] == [
        "image", "point", "kind", "vx_um", "vy_um", "redundancy_x", "redundancy_y", "w", "w_x", "w_y", "weight",
    ]  # fmt: skip
    assert list(content["history"][0]) == ["vpv", "largest_step_sigmas", "damping", "attempts"]
    assert list(content["groups"]["target"]) == ["sigma0", "rms_x_um", "rms_y_um", "redundancy"]


def test_a_file_of_another_stage_is_no_adjustment(tmp_path: Path) -> None:
    other = tmp_path / "check.json"
    other.write_text('{"reseau": "1", "verdict": "agrees", "cameras": {}}')
    with pytest.raises(InputError, match=r"lacks the keys 'converged', .* Name the adjustment\.json that is meant"):
        read_adjustment(other)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("cameras",), None, r"cameras is None; it should be a table"),
        (("sigma0",), "1.0", r"sigma0 is '1\.0'; it should be a number"),
        (("iterations",), True, r"iterations is True; it should be a whole number"),
        (("cameras", "RC 20", "principal_distance_mm"), {"value": 1.0}, r"\['RC 20'\]\.principal_distance_mm has no"),
        (("residuals",), [{"image": "f1"}], r"residuals\[0\] has no key 'point'"),
        (("cameras", "RC 20", "distortion", "family"), "no such", "a distortion family must be one of"),
        (("images", "f1", "camera"), "other", r"images\['f1'\].camera is 'other', which cameras do not hold"),
        (("images", "f1", "transformation"), {"kind": "affine"}, "transformation has no key 'a1'"),
        (("vpv",), 10**400, "vpv is .*; it should be a finite number"),
        (("groups", "target", "sigma0"), "x", r"groups\['target'\].sigma0 is 'x'; it should be a number or null"),
        (("cameras", "RC 20", "distortion", "decentering"), "x", "is 'x'; it should be 'reduced' or 'paper' or null"),
        (("scanners",), {"s": {"center_mm": [1.0]}}, r"scanners\['s'\].center_mm is \[1.0\]; .* a list of 2"),
    ],
)  # fmt: skip
def test_a_broken_file_names_the_place(path: Path, keys: tuple[Any, ...], value: object, message: str) -> None:
    content = file_content(path)
    inner = content
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        read_adjustment(path)


def test_a_missing_or_broken_file_is_named_with_what_to_do(path: Path) -> None:
    file = covariance_path(path)
    np.savez_compressed(file, names=np.array(["a", "b"]), values=np.zeros(2), matrix=np.zeros((3, 3)))
    with pytest.raises(InputError, match="2 names do not fit a matrix"):
        read_covariance(path)
    file.unlink()
    with pytest.raises(InputError, match="there is no such file"):
        read_covariance(path)
    path.write_text('{"reseau": "0.1",\n oh')
    with pytest.raises(InputError, match=r"is not valid JSON .*line 2"):
        read_adjustment(path)
    path.unlink()
    with pytest.raises(InputError, match=r"adjustment\.json: there is no such file\. Run `reseau adjust`"):
        read_adjustment(path)


def test_a_large_network_is_in_blocks(adjustment: Adjustment, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order in which they become too many: points first, then images; the cameras stay together."""
    whole = read_covariance(path)
    cameras = [name for name in adjustment.names if name.startswith(("IO.", "FID."))]
    images = [name for name in adjustment.names if name.startswith(("EO.", "T."))]
    for affordable, together, kinds in (
        (len(adjustment.names) - 1, [*cameras, *images], ("point",)),
        (len(cameras), cameras, ("point", "image")),
    ):
        monkeypatch.setattr(adjustment_content, "AFFORDABLE", affordable)
        write_adjustment(adjustment, path)
        covariance = read_covariance(path)
        assert sorted(each.text for each in covariance.parameters) == sorted(together)
        np.testing.assert_array_equal(covariance.select(cameras), whole.select(cameras))
        assert f"every {' and every '.join(kinds)} by itself" in file_content(path)["covariance"]
        with np.load(covariance_path(path)) as arrays:
            for kind in kinds:
                for names, matrix in zip(arrays[f"{kind}_names"], arrays[f"{kind}_matrices"], strict=True):
                    listed = [str(name) for name in names if name]
                    np.testing.assert_array_equal(matrix[: len(listed), : len(listed)], whole.select(listed))
                    assert not matrix[len(listed) :].any()
                    if kind == "image":
                        np.testing.assert_array_equal(covariance.select(listed), whole.select(listed))
            assert arrays["point_names"].shape == (24, 3)
    exterior = [f"EO.{image}.Z0" for image in ("f1", "f2")]  # each with the camera, and with the other: not in the file
    variances = np.diag(whole.select(exterior))
    np.testing.assert_array_equal(covariance.select([*exterior, cameras[0]])[:2, :2], np.diag(variances))
    np.testing.assert_array_equal(covariance.select([*exterior, cameras[0]])[2, :2], 0.0)
    with np.load(covariance_path(path)) as arrays:
        np.savez(covariance_path(path), **{**arrays, "image_values": arrays["image_values"][:-1]})
    with pytest.raises(InputError, match=r"names, values and matrices of images do not fit one another"):
        read_covariance(path)


def test_a_join_in_three_scans_has_two_differences_to_the_first() -> None:
    """The right half of a frame is scanned twice, with the same errors."""
    made = nets.halves(np.random.default_rng(3), join_count=25).network
    observations = made.observations
    rows = [row for row, image in enumerate(observations.image) if image == "f0.right"]
    order = [*range(len(observations)), *rows]
    again = observations.only(np.array(order))
    again = replace(again, image=(*observations.image, *["f0.again"] * len(rows)))
    images = (*made.images, Image("f0.again", "K", "affine", part_of="f0"))
    frame = adjustment_content.joined_frames(adjust(replace(made, images=images, observations=again)))["f0"]
    first = [row for row in frame.joins if row.images == ("f0.left", "f0.right")]
    second = [row for row in frame.joins if row.images == ("f0.left", "f0.again")]
    assert len(first) == len(second) == 25
    assert len(frame.joins) == 50
    np.testing.assert_allclose([row.dx_um for row in first], [row.dx_um for row in second], atol=1e-6)
    assert 1.0 < np.std([row.dx_um for row in first]) < 5.0  # each scan has 2 um


def test_a_check_is_read_as_it_was_written_and_a_wrong_value_refused_with_its_place(tmp_path: Path) -> None:
    pixels = stage_files.PixelCalibration(1.0, 2.0, 3.0, 4.0, 0.5)
    corners = stage_files.CornersCheck("findChessboardCorners", 3, 12, ("a",), pixels, pixels)
    row = stage_files.ComparedParameter.from_numbers("k1", "", Quantity(1.0, 0.1), Quantity(1.0, 0.1))
    camera = stage_files.CameraCheck("agrees", "All agree.", 3, 12, 1.0, 1.1, 0.1, (row,), corners)
    path = tmp_path / "check.json"

    def read(content: Any) -> stage_files.Check:
        path.write_text(json.dumps(content))
        return stage_files.read_check(path)

    content = plain_json(stage_files.Check.from_cameras({"K": camera}))
    assert plain_json(read(content)) == content
    of_camera = content["cameras"]["K"]
    (of_row,) = of_camera["rows"]
    for holder, key, value, words in (
        (content, "verdict", True, "verdict is True; it should be .* Run `reseau check` again"),
        (of_camera, "points", True, "points is True; it should be .* Run `reseau check` again"),
        (of_row["opencv"], "sigma", -0.1, r"opencv\.sigma is -0\.1; it should be a number of at least 0, or null"),
    ):
        right, holder[key] = holder[key], value
        with pytest.raises(InputError, match=words):
            read(content)
        holder[key] = right
    del of_camera["corners_px"]  # of an earlier version
    assert read(content).cameras["K"].corners_px is None
