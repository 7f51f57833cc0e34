"""Singular networks: as many null directions as an independent rank test finds, each named with cause and remedy."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from reference_cases import CAUSES, DROPPED, Case, case_approximations, case_network, load
from simulated import field_points, simulated

from adjust.problem.network import Network
from adjust.solution.adjustment import Datum, Options, adjust
from adjust.solution.result import Adjustment

SINGULAR = ("K2D_vert0", "K3D_conv", "U3D_vert0", "H2D_vertcross")


def dropped(case: Case, functions: set[int]) -> Case:
    """The case with priors of 1 mm, but for the pseudo-observations that are dropped."""
    case = copy.deepcopy(case)
    sigma = {number: None if number in functions else 1.0 for number in range(5, 10)}
    case["input"]["fid_sigma"] = [[sigma[5], sigma[6]]] * len(case["input"]["fid_obs"])
    case["input"]["io_sigma"][:3] = [sigma[7], sigma[8], sigma[9]]
    return case


def adjust_network(case: Case, options: Options | None = None) -> Adjustment:
    return adjust(case_network(case), case_approximations(case, case["state"]), options)


@pytest.mark.parametrize("priors", list(DROPPED))
@pytest.mark.parametrize("name", SINGULAR)
def test_null_directions_are_counted_and_named(name: str, priors: str) -> None:
    case = load(f"v_singular_{name}_affine")
    expected = case["expected_defects_by_dropped_pseudo_observations"][priors]
    result = adjust_network(dropped(case, DROPPED[priors]))

    assert len(result.singular) == expected["total_defect"]
    assert result.termination == ("singular" if expected["total_defect"] else "converged")
    datum, camera = np.split(np.array(result.singular, dtype=object), [expected["object_datum_defect"]])
    assert all("object space" in direction.cause for direction in datum)
    for direction, row in zip(camera, expected["directions"], strict=True):
        assert CAUSES[row["lead"]] in direction.cause
        assert direction.remedy
        named = {"T" if each.kind == "film" else kind(each.text) for each in direction.parameters}
        assert named - {"FID"} <= set(row["involved"]) | {"IO.x0", "IO.y0", "IO.c"}


def kind(name: str) -> str:
    """`EO.3.X0` is of the kind EO.X0, a fiducial of the kind FID."""
    owner, quantity = name.split(".")[0], name.rsplit(".", 1)[1]
    return "FID" if owner == "FID" else f"{owner}.{quantity}"


def test_a_singular_result_keeps_the_approximations() -> None:
    case = load("v_singular_K3D_conv_affine")
    result = adjust_network(dropped(case, {5, 6, 7, 8, 9}))
    assert result.value("EO.2.X0") == case["state"]["EO2.X0"]
    assert not result.converged
    assert result.history == ()


@pytest.mark.parametrize("datum", ["minimal", "free"])
def test_a_datum_for_the_object_leaves_the_camera_directions(datum: Datum) -> None:
    case = load("v_singular_U3D_vert0_affine")
    result = adjust_network(dropped(case, {9}), Options(datum=datum))
    assert [CAUSES["IO.c"] in direction.cause for direction in result.singular] == [True]


def test_a_flat_field_of_heights_needs_four_datum_values() -> None:
    """With noisy heights too, which make the equations formally regular with three."""
    case = dropped(load("v_singular_H2D_vertcross_affine"), set())
    rng = np.random.default_rng(1)
    for row, sigma in zip(case["input"]["pts_obs"], case["input"]["pts_sigma"], strict=True):
        row[2] += rng.normal(0.0, 0.02)
        sigma[2] = 0.02
    result = adjust_network(case, Options(datum="minimal"))
    assert result.converged
    fixed = [name for name in result.names if name.startswith("PT.") and result.sigma(name) == 0.0]
    assert sorted(name[-1] for name in fixed) == ["X", "X", "Y", "Y"]


def test_a_good_network_has_no_warning() -> None:
    network, start = simulated(np.random.default_rng(2), free={"k3": np.inf, "p1": np.inf})
    assert adjust(network, start).warnings == ()


@pytest.mark.parametrize("count", [9, 40])
def test_a_point_in_one_image_only_is_named(count: int) -> None:
    """Whether images or points are eliminated first: four images have 48 unknowns, nine points 27, forty 120."""
    rng = np.random.default_rng(6)
    network, start = simulated(rng, points=field_points(rng, count), point_sigma=np.inf, noise=False)
    rows = network.observations
    lonely = [(image, "3", "target") for image in ("f0", "f1", "f2")]
    keys = list(zip(rows.image, rows.point, rows.kind, strict=True))
    result = adjust(
        keep_points(network, [i for i, key in enumerate(keys) if key not in lonely]), start, Options(datum="minimal")
    )
    assert result.termination == "singular"
    (direction,) = result.singular
    assert {(each.kind, each.id) for each in direction.parameters} == {("point", "3")}


def keep_points(network: Network, keep: list[int]) -> Network:
    """The network with some of its observations."""
    return replace(network, observations=network.observations.only(np.array(keep)))


def test_what_no_image_shows_is_reported() -> None:
    network, start = simulated(np.random.default_rng(4))
    rows = network.observations
    keep = [
        i for i, (point, kind) in enumerate(zip(rows.point, rows.kind, strict=True)) if (point, kind) != ("3", "target")
    ]
    result = adjust(keep_points(network, keep), start)
    assert result.converged
    assert result.warnings == ("No image shows the object points 3: they take no part.",)
