"""The reference adjustments: an independent, dense implementation with complex-step derivatives."""

import random
from dataclasses import replace

import numpy as np
import pytest
from reference_cases import CAMERA, Case, case_approximations, case_network, load, own_name

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Network
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

CASES = (
    "i_five_images_affine_reduced",
    "i_five_images_affine_paper_noisefree",
    "i_five_images_similarity_reduced",
    "ii_juhl_3photos",
    "iii_selfcal_mixed",
    "iii_selfcal_all_unknown_datum_A",
    "iv_planar_board",
)


def adjust_network(case: Case, network: Network | None = None) -> Adjustment:
    network = network or case_network(case)
    return adjust(network, case_approximations(case, case["input"]["initial_approximations"]), Options())


def differences(case: Case, result: Adjustment) -> np.ndarray:
    """Estimates less the reference's, in the reference's a-priori standard deviations."""
    parameters = case["result"]["parameters"]
    return np.array(
        [(result.value(own_name(name)) - row["value"]) / row["std_apriori"] for name, row in parameters.items()]
    )


@pytest.mark.parametrize("name", CASES)
def test_reference_case(name: str) -> None:
    case = load(name)
    reference = case["result"]
    result = adjust_network(case)

    assert result.converged
    counts = (result.conditions, result.unknowns, result.redundancy)
    assert counts == (reference["conditions"], reference["unknowns"], reference["redundancy"])
    assert np.abs(differences(case, result)).max() < 1e-8
    sigmas = np.array(
        [np.sqrt(result.cofactor.variances[i]) for i in map(result.index, map(own_name, reference["parameters"]))]
    )
    expected = np.array([row["std_apriori"] for row in reference["parameters"].values()])
    np.testing.assert_allclose(sigmas, expected, rtol=1e-9)
    if reference["vpv"] > 1e-12:
        posterior = [row["std_aposteriori"] for row in reference["parameters"].values()]
        np.testing.assert_allclose([result.sigma(own_name(n)) for n in reference["parameters"]], posterior, rtol=1e-9)
    assert result.vpv == pytest.approx(reference["vpv"], rel=1e-8, abs=1e-15)
    v = np.array(reference["residuals_obs"] + reference["residuals_fobs"])
    np.testing.assert_allclose(result.residuals.v_mm, v, rtol=0, atol=1e-11)
    redundancy = reference["redundancy_numbers"][: v.size]
    np.testing.assert_allclose(result.residuals.redundancy.ravel(), redundancy, rtol=0, atol=1e-9)
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(result.redundancy)


def test_juhls_table_of_standard_deviations() -> None:
    """The paper's own figures, to the digits that it prints; its simulated points are others than the case's."""
    case = load("ii_juhl_3photos")
    result = adjust_network(case)
    for name, printed_um in case["paper_table_rmse_um"].items():
        assert result.sigma(f"IO.{CAMERA}.{name}") == pytest.approx(printed_um, rel=0.2)


@pytest.mark.parametrize("name", ["i_five_images_affine_reduced", "iii_selfcal_mixed"])
def test_the_order_of_inputs_does_not_matter(name: str) -> None:
    case = load(name)
    network = case_network(case)
    order = list(range(len(network.observations)))
    random.Random(7).shuffle(order)
    shuffled = Network(
        network.cameras,
        network.images[::-1],
        tuple(sorted(network.points, key=lambda point: point.id[::-1])),
        network.observations.only(np.array(order)),
    )
    plain, other = adjust_network(case), adjust_network(case, shuffled)
    for i, unknown in enumerate(plain.names):
        sigma = max(np.sqrt(plain.cofactor.variances[i]), 1e-30)
        assert abs(plain.values[i] - other.value(unknown)) <= 1e-9 * sigma
    np.testing.assert_allclose(other.residuals.w, plain.residuals.w[order], atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_poor_approximations_lead_to_the_same_result(seed: int) -> None:
    """Stations wrong by a tenth of the flying height, attitudes by 10 degrees, film by millimetres."""
    case = load("i_five_images_affine_reduced")
    rng = np.random.default_rng(seed)
    start = {}
    for name, value in case["input"]["initial_approximations"].items():
        owner, quantity = name.split(".")
        if owner.startswith("EO"):
            size = 150.0 if quantity in ("X0", "Y0", "Z0") else 0.17
        elif owner.startswith("T"):
            size = 3.0 if quantity in ("a1", "b1") else 0.02
        else:
            size = 0.0
        start[name] = value + rng.uniform(-size, size)
    result = adjust(case_network(case), case_approximations(case, start))
    assert result.converged
    assert np.abs(differences(case, result)).max() < 1e-7
    assert result.iterations < 20


def test_elements_are_the_combined_model_when_axes_are_parallel_and_distortion_small() -> None:
    """Torlegård's special case, A near I, as good as true of this case's 0.1 mm of distortion and 5 um of noise."""
    case = load("i_five_images_affine_reduced")
    start = case_approximations(case, case["input"]["initial_approximations"])
    result = adjust(case_network(case), start, Options(method="elements"))
    assert result.converged
    assert np.abs(differences(case, result)).max() < 0.05
    assert result.vpv == pytest.approx(case["result"]["vpv"], rel=0.01)


def test_history_ends_at_the_result() -> None:
    case = load("i_five_images_affine_reduced")
    result = adjust_network(case)
    assert len(result.history) == result.iterations
    assert result.history[-1][0] == pytest.approx(result.vpv)
    assert result.history[-1][1] < 1e-6


def test_an_iteration_limit_is_reported() -> None:
    case = load("i_five_images_affine_reduced")
    start = case_approximations(case, case["input"]["initial_approximations"])
    result = adjust(case_network(case), start, Options(iteration_limit=2))
    assert result.termination == "iteration limit"
    assert not result.converged
    assert "not final" in " ".join(result.warnings)


def set_distortion(network: Network, distortion: Distortion) -> Network:
    return replace(network, cameras=(replace(network.cameras[0], distortion=distortion),))


def test_brown_is_torlegards_without_r0() -> None:
    """The planar board with the same polynomial under Brown's names: the reference's result again."""
    case = load("iv_planar_board")
    names = {"k1": "k3", "k2": "k5", "k3": "k7", "p1": "p1", "p2": "p2"}
    network = case_network(case)
    given = network.cameras[0].distortion.parameters
    result = adjust_network(
        case, set_distortion(network, Distortion("brown", {brown: given[name] for brown, name in names.items()}))
    )
    assert result.vpv == pytest.approx(case["result"]["vpv"], rel=1e-9)
    for brown, name in names.items():
        reference = case["result"]["parameters"][f"IO.{name}"]
        position = result.index(f"IO.{CAMERA}.{brown}")
        assert result.values[position] == pytest.approx(reference["value"], abs=1e-7 * reference["std_apriori"])
        assert np.sqrt(result.cofactor.variances[position]) == pytest.approx(reference["std_apriori"], rel=1e-7)


def test_opencvs_own_calibration_of_the_planar_board() -> None:
    """The `opencv` family on OpenCV's observations: its parameters, its standard deviations, its rms per point."""
    case = load("iv_planar_board")
    opencv, pixel_mm = case["opencv"], case["pixels"]["pixel_mm"]
    names = ("k1", "k2", "p1", "p2", "k3")
    free = {name: Prior(0.0, np.inf) for name in names}
    result = adjust_network(case, set_distortion(case_network(case), Distortion("opencv", free)))
    assert result.converged

    half_width, half_height = (case["pixels"]["width"] - 1) / 2, (case["pixels"]["height"] - 1) / 2
    expected = {
        "c": (opencv["fx"] * pixel_mm, opencv["std"]["f"] * pixel_mm),
        "x0": ((opencv["cx"] - half_width) * pixel_mm, opencv["std"]["cx"] * pixel_mm),
        "y0": (-(opencv["cy"] - half_height) * pixel_mm, opencv["std"]["cy"] * pixel_mm),
    }
    expected |= dict(zip(names, zip(opencv["k1k2p1p2k3"], opencv["std"]["k1k2p1p2k3"], strict=True), strict=True))
    for name, (value, sigma) in expected.items():
        assert result.value(f"IO.{CAMERA}.{name}") == pytest.approx(value, abs=1e-3 * sigma)
        assert result.sigma(f"IO.{CAMERA}.{name}") == pytest.approx(sigma, rel=1e-3)
    rms_px = np.sqrt((result.residuals.v_mm**2).sum(axis=1).mean()) / pixel_mm
    assert rms_px == pytest.approx(opencv["rms_px"], rel=1e-6)
