"""The covariance by leaving out one picture after the other."""

from dataclasses import replace

import numpy as np
import pytest
from board_pictures import TRUTH, board_network

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

QUANTITIES = ("c", "x0", "y0", "k1", "k2")


def scatter(result: Adjustment) -> np.ndarray:
    covariance = result.cluster_covariance_of([Parameter.interior("desk", each) for each in (*QUANTITIES, "p1")])
    assert covariance is not None
    assert not covariance[-1].any()  # what is fixed
    return np.asarray(np.sqrt(np.diagonal(covariance)))[:-1]


def drop_image(network: Network, image: str) -> Network:
    rows = np.flatnonzero([name != image for name in network.observations.image])
    left = network.observations.only(rows)
    return replace(network, images=tuple(each for each in network.images if each.name != image), observations=left)


def values(result: Adjustment) -> list[float]:
    return [result.value(Parameter.interior("desk", each)) for each in QUANTITIES]


def test_it_is_the_jackknife_of_adjustments_without_one_picture_each() -> None:
    network = board_network(np.random.default_rng(3), 6, 5e-4)
    left = np.array([values(adjust(drop_image(network, image.name))) for image in network.images])
    spread = np.sqrt(5 / 6 * ((left - left.mean(axis=0)) ** 2).sum(axis=0))
    np.testing.assert_allclose(scatter(adjust(network)), spread, rtol=0.03)


def test_prediction_errors_are_those_of_adjustments_without_a_fold() -> None:
    """Each picture is oriented anew by the camera of the others, held fixed."""
    network = board_network(np.random.default_rng(3), 6, 5e-4)
    predicted = adjust(network).prediction_errors(3)
    assert predicted is not None
    names = [image.name for image in network.images]
    for fold in (names[first::3] for first in range(3)):
        fitted = values(adjust(drop_image(drop_image(network, fold[0]), fold[1])))
        priors = {name: Prior(value, 0.0) for name, value in zip(QUANTITIES, fitted, strict=True)}
        lens = Distortion("opencv", {name: priors[name] for name in ("k1", "k2")})
        (camera,) = network.cameras
        known = replace(camera, principal_distance_mm=priors["c"], x0_mm=priors["x0"], y0_mm=priors["y0"])
        for name in fold:
            one = keep_image(replace(network, cameras=(replace(known, distortion=lens),)), name)
            squares = (adjust(one).residuals.v_mm ** 2).sum(axis=1) / 5e-4**2
            assert predicted[names.index(name)] == pytest.approx(squares.mean(), rel=0.01)


def keep_image(network: Network, image: str) -> Network:
    for each in network.images:
        network = network if each.name == image else drop_image(network, each.name)
    return network


@pytest.mark.study
def test_it_holds_for_independent_errors_and_for_errors_that_pictures_share() -> None:
    """Shared is a shift of a picture's points along x that grows with y², which no orientation takes up.

    The jackknife overestimates a variance rather than not (Efron and Stein 1981), more so over twelve pictures.
    """
    rng = np.random.default_rng(8)
    truth = np.array([TRUTH[each] for each in QUANTITIES])
    claimed, clustered = [], []
    for shared in (0.0, 1.0):
        misses, model, robust = [], [], []
        for _ in range(60):
            network = board_network(rng, 12, 4e-4)
            own = np.repeat(rng.normal(size=12), 54)
            xy_mm = network.observations.xy_mm.copy()
            xy_mm[:, 0] += shared * 2e-3 * own * (xy_mm[:, 1] + 1.2) ** 2
            result = adjust(replace(network, observations=replace(network.observations, xy_mm=xy_mm)))
            misses.append(np.array(values(result)) - truth)
            model.append([result.sigma(Parameter.interior("desk", each)) for each in QUANTITIES])
            robust.append(scatter(result))
        rms = np.sqrt(np.mean(np.square(misses), axis=0))
        claimed.append(float(np.mean(rms / np.sqrt(np.mean(np.square(model), axis=0)))))
        clustered.append(float(np.mean(rms / np.sqrt(np.mean(np.square(robust), axis=0)))))
    assert 0.85 < claimed[0] < 1.15
    assert 0.65 < clustered[0] < 1.15
    assert claimed[1] > 1.6
    assert 0.65 < clustered[1] < 1.15


def test_few_pictures_tell_no_scatter() -> None:
    result = adjust(board_network(np.random.default_rng(1), 4, 5e-4))
    assert result.cluster_covariance_of([Parameter.interior("desk", "c")]) is None
    assert result.value(Parameter.interior("desk", "c")) == pytest.approx(2.7, abs=0.02)
