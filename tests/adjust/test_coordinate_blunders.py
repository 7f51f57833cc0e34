"""Slips of the pen among given coordinates: named with the place where the rays put the point, whatever their size."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import Truth, field_points, simulated

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.network import Network, ObjectPoint
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

WRONG = 5
STOPPED = 15  # steps: those that find no minimum in a hundred need not take them all


def field(seed: int = 1, points: int = 15, sigma: float = 0.05) -> tuple[Network, Array]:
    """Four images of points given to 5 cm, and their true coordinates (points, 3)."""
    rng = np.random.default_rng(seed)
    xyz = field_points(rng, points)
    return simulated(rng, points=xyz, fiducial_sigma=0.01, point_sigma=sigma)[0], xyz


def set_given(network: Network, coordinates: dict[int, Array]) -> Network:
    points = list(network.points)
    for row, xyz in coordinates.items():
        old = points[row]
        priors = (
            Prior(float(value), each.sigma)
            for value, each in zip(xyz, (old.X, old.Y, old.Z), strict=True)
            if each is not None
        )
        points[row] = ObjectPoint(old.id, *priors)
    return replace(network, points=tuple(points))


def adjust_network(network: Network, **options: bool | str | int) -> Adjustment:
    return adjust(network, approximate(network), Options(**options))  # type: ignore[arg-type]


def place(sentence: str) -> Array:
    """What a sentence says of where the rays meet."""
    return np.array([float(part.split(" = ")[1]) for part in sentence.split("meet at ")[1].split(", ")[:3]])


@pytest.fixture
def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """No slip of the whole network is sought, which takes longer than all the rest."""
    monkeypatch.setattr("adjust.solution.adjustment.blunder_sentence", lambda *_: "")


@pytest.mark.usefixtures("one_by_one")
def test_a_slip_without_a_minimum_is_named() -> None:
    network, xyz = field()
    result = adjust_network(set_given(network, {WRONG: xyz[WRONG] * [1.0, -1.0, 1.0]}), iteration_limit=STOPPED)
    assert not result.converged
    (warning,) = result.warnings
    assert warning.startswith(f"Control point {WRONG} is not where it is given: its rays from 4 images meet at X = ")
    assert place(warning) == pytest.approx(xyz[WRONG], abs=0.5)
    assert "The sign of Y looks wrong." in warning


@pytest.mark.study
@pytest.mark.parametrize("offset", [60.0, 300.0])
def test_a_slip_with_a_wrong_minimum_is_named_alike(offset: float) -> None:
    network, xyz = field()
    result = adjust_network(set_given(network, {WRONG: xyz[WRONG] + [offset, 0.0, 0.0]}))
    assert result.converged
    assert result.warnings[0].startswith(f"Control point {WRONG} is not where it is given")
    assert place(result.warnings[0]) == pytest.approx(xyz[WRONG], abs=0.5)
    assert f"control point {WRONG} X" in [suspect.tested.name for suspect in result.suspects]


@pytest.mark.usefixtures("one_by_one")
@pytest.mark.parametrize("options", [{"snooping": True}, {"robust": "igg3"}])
def test_methods_that_leave_out_begin_without_a_slip(options: dict[str, bool | str]) -> None:
    network, xyz = field()
    result = adjust_network(set_given(network, {WRONG: xyz[WRONG][[1, 0, 2]]}), **options)
    assert result.converged
    assert result.warnings == ()
    assert sorted(suspect.tested.name for suspect in result.suspects)[:2] == [
        f"control point {WRONG} X",
        f"control point {WRONG} Y",
    ]
    found = np.array([result.value(f"PT.{WRONG}.{axis}") for axis in "XYZ"])
    assert found == pytest.approx(xyz[WRONG], abs=0.5)


@pytest.mark.usefixtures("one_by_one")
def test_a_redescending_method_begins_without_a_slip_among_few_points() -> None:
    network, xyz = field(5018, 18)
    result = adjust_network(set_given(network, {WRONG: xyz[WRONG] + [500.0, -400.0, 300.0]}), robust="igg3")
    assert result.sigma0 < 1.2
    assert {f"control point {WRONG} {axis}" for axis in "XYZ"} <= {each.tested.name for each in result.suspects}


@pytest.mark.usefixtures("one_by_one")
def test_a_point_behind_the_cameras_is_a_slip() -> None:
    network, xyz = field()
    spoilt = set_given(network, {WRONG: xyz[WRONG] + [0.0, 0.0, 3000.0]})
    with pytest.raises(AdjustmentError, match=f"Control point {WRONG} is not where .* lies behind the camera"):
        adjust_network(spoilt)
    result = adjust_network(spoilt, snooping=True)
    assert [(each.tested.name, each.removed) for each in result.suspects] == [(f"control point {WRONG} Z", True)]


@pytest.mark.usefixtures("one_by_one")
def test_exchanged_points_are_both_named() -> None:
    network, xyz = field()
    warnings = adjust_network(set_given(network, {0: xyz[WRONG], WRONG: xyz[0]}), iteration_limit=STOPPED).warnings
    assert len(warnings) == 2
    for name, other in ((0, WRONG), (WRONG, 0)):
        (own,) = (each for each in warnings if each.startswith(f"Control point {name} "))
        assert f"It lies where point {other} is given." in own


@pytest.mark.usefixtures("one_by_one")
def test_fixed_coordinates_are_slips_as_well() -> None:
    network, xyz = field(3, 20, sigma=0.0)
    result = adjust_network(set_given(network, {WRONG: xyz[WRONG][[1, 0, 2]]}), iteration_limit=STOPPED)
    assert f"Control point {WRONG} is not where it is given" in result.warnings[0]
    assert "X and Y look exchanged." in result.warnings[0]


@pytest.mark.study
def test_what_is_wrong_with_all_points_is_no_slip_of_one() -> None:
    network, xyz = field(3, 20)
    feet = adjust_network(set_given(network, {row: each * [1.0, 1.0, 3.2808] for row, each in enumerate(xyz)}))
    shifted = adjust_network(
        set_given(network, {row: each + np.array([500.0, -300.0, 20.0]) for row, each in enumerate(xyz)})
    )
    assert (feet.slips, shifted.slips) == ((), ())
    assert shifted.converged


@pytest.mark.study
@pytest.mark.usefixtures("one_by_one")
def test_four_points_do_not_tell_which_is_wrong() -> None:
    network, xyz = field(4, 12)
    few = replace(
        network, points=(*network.points[:4], *(ObjectPoint(p.id, None, None, None) for p in network.points[4:]))
    )
    result = adjust_network(set_given(few, {1: xyz[1][[1, 0, 2]]}), iteration_limit=STOPPED)
    assert not result.converged
    assert result.slips == ()
    assert "The points 0, 1, 2, 3 alone are given" in result.warnings[0]
    with pytest.raises(AdjustmentError, match="four points do not tell which of them is wrong"):
        adjust_network(set_given(few, {1: xyz[1] + [300.0, 0.0, 0.0]}))


@pytest.mark.usefixtures("one_by_one")
@pytest.mark.parametrize("seed", range(4))
def test_a_lens_that_is_not_known_makes_no_slips(seed: int) -> None:
    """Half a millimetre of distortion, adjusted without any: points at the border are off, but none stands alone."""
    rng = np.random.default_rng(1000 + seed)
    truth = Truth(distortion={"k3": 1.5e-7, "p1": 8e-7})
    network, _ = simulated(rng, truth, points=field_points(rng, 40), fiducial_sigma=0.01, point_sigma=0.05)
    bare = replace(network.cameras[0], distortion=replace(network.cameras[0].distortion, parameters={}))
    result = adjust_network(replace(network, cameras=(bare,)))
    assert result.sigma0 > 1.2
    assert result.slips == ()
