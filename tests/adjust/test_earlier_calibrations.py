"""Earlier calibrations as observations: two adjustments one after the other are one of all their observations."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import field_points, join_observations, simulated

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Fiducial
from adjust.problem.network import Approximations, Network, Transformation
from adjust.problem.observations import Calibration
from adjust.problem.parameter import Parameter
from adjust.quality.significance import CalibrationTest
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment


def two_networks(kind: Transformation, noise: float) -> tuple[tuple[Network, Approximations], ...]:
    """Two data sets of one camera, their names with an A and a B, and both together; errors as small as one likes."""
    networks = []
    for prefix, seed in (("A", 1), ("B", 2)):
        rng = np.random.default_rng(seed)
        free = {"k3": np.inf, "p1": np.inf}
        network, start = simulated(rng, None, kind, field_points(rng, 14), 0.0, free, False, 0.002 * noise)
        rows = network.observations
        rows = replace(
            rows,
            image=tuple(prefix + name for name in rows.image),
            point=tuple(p if k == "fiducial" else prefix + p for p, k in zip(rows.point, rows.kind, strict=True)),
            xy_mm=rows.xy_mm + noise * rng.normal(0.0, 0.004, rows.xy_mm.shape),
            covariance_mm2=noise**2 * rows.covariance_mm2,
        )
        images = tuple(replace(image, name=prefix + image.name) for image in network.images)
        points = tuple(replace(point, id=prefix + point.id) for point in network.points)
        network = replace(network, images=images, points=points, observations=rows)
        exterior, films, known = (
            {prefix + k: v for k, v in each.items()} for each in (start.exterior, start.transformation, start.points)
        )
        networks.append((network, replace(start, exterior=exterior, transformation=films, points=known)))
    (a, start_a), (b, start_b) = networks
    rows = join_observations(a.observations, b.observations)
    joint = replace(a, images=a.images + b.images, points=a.points + b.points, observations=rows)
    start_joint = replace(
        start_a,
        exterior={**start_a.exterior, **start_b.exterior},
        transformation={**start_a.transformation, **start_b.transformation},
        points={**start_a.points, **start_b.points},
    )
    return (a, start_a), (b, start_b), (joint, start_joint)


def make_calibration(result: Adjustment, fiducials: bool) -> Calibration:
    kinds = ("interior", "fiducial") if fiducials else ("interior",)
    taken = [each for each in result.parameters if each.kind in kinds and result.cofactor_of([each])[0, 0] > 0.0]
    return Calibration(tuple(taken), result.values_of(taken), result.cofactor_of(taken))


def set_calibration(network: Network, calibration: Calibration) -> Network:
    """The network with that calibration in the place of the camera's priors."""
    value = dict(zip((each.text for each in calibration.parameters), calibration.values.tolist(), strict=True))

    def freed(name: str, prior: Prior) -> Prior:
        return Prior(value[name], np.inf) if name in value else prior

    (camera,) = network.cameras
    assert camera.principal_distance_mm is not None
    assert camera.x0_mm is not None
    assert camera.y0_mm is not None
    parameters = camera.distortion.parameters
    free = replace(
        camera,
        principal_distance_mm=freed("IO.K.c", camera.principal_distance_mm),
        x0_mm=freed("IO.K.x0", camera.x0_mm),
        y0_mm=freed("IO.K.y0", camera.y0_mm),
        distortion=replace(camera.distortion, parameters={n: freed(f"IO.K.{n}", p) for n, p in parameters.items()}),
        fiducials={
            id_: Fiducial(freed(f"FID.K.{id_}.x", mark.x_mm), freed(f"FID.K.{id_}.y", mark.y_mm))
            for id_, mark in camera.fiducials.items()
        },
    )
    return replace(network, cameras=(free,), calibrations=(calibration,))


@pytest.mark.parametrize("kind", [pytest.param("none", marks=pytest.mark.study), "affine"])
def test_an_earlier_calibration_stands_for_its_observations(kind: Transformation) -> None:
    """A, then B with A's calibration, is A and B together: values, sigmas, v'Pv and redundancy.

    The calibration is A made linear, so that with real errors the difference is of second order, some 5e-4 of the
    standard deviations; with errors of a thousandth it must be a thousand times less.
    """
    differences = []
    for noise in (1.0, 1e-3):
        (a, start_a), (b, start_b), (joint, start_joint) = two_networks(kind, noise)
        first, both = adjust(a, start_a), adjust(joint, start_joint)
        second = adjust(set_calibration(b, make_calibration(first, kind != "none")), start_b)
        assert second.converged
        names = [name for name in second.names if both.cofactor_of([name])[0, 0] > 0.0]
        sigmas = np.sqrt([both.cofactor_of([name])[0, 0] for name in names])
        change = np.array([second.value(name) - both.value(name) for name in names]) / sigmas
        differences.append(float(np.abs(change).max()))
        np.testing.assert_allclose(np.sqrt([second.cofactor_of([n])[0, 0] for n in names]), sigmas, rtol=1e-4 * noise)
        assert first.vpv + second.vpv == pytest.approx(both.vpv, abs=1e-3 * noise)
        assert first.redundancy + second.redundancy == both.redundancy
        assert sum(group.redundancy for group in second.groups.values()) == pytest.approx(second.redundancy)
        assert second.warnings == ()
    assert differences[0] < 1e-3
    assert differences[1] < 1e-6


def test_a_fiducial_that_no_image_shows_has_no_part_in_a_calibration() -> None:
    """It is not tied to its calibrated place, which would hold the others as well."""
    (a, start_a), (b, start_b), _ = two_networks("affine", 1.0)
    calibration = make_calibration(adjust(a, start_a), fiducials=True)
    rows = b.observations
    keep = [i for i, (p, k) in enumerate(zip(rows.point, rows.kind, strict=True)) if (p, k) != ("5", "fiducial")]
    result = adjust(set_calibration(replace(b, observations=rows.only(np.array(keep))), calibration), start_b)
    assert not any(".5." in row.name for row in result.further)
    assert len(result.further) == len(calibration.parameters) - 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda n, c: replace(
                n, calibrations=(replace(c, parameters=(Parameter.interior("K", "q"), *c.parameters[1:])),)
            ),
            ["q of camera K", "no camera has"],
        ),
        (lambda n, c: replace(n, calibrations=(c,)), ["c of camera K", "standard deviation of its own (1)", "twice"]),
        (lambda n, c: replace(set_calibration(n, c), calibrations=(c, c)), ["c of camera K", "another calibration"]),
        (
            lambda n, c: set_calibration(n, replace(c, covariance=np.ones_like(c.covariance))),
            ["not positive definite", "c, x0 and y0 of camera K"],
        ),
        (lambda n, c: set_calibration(n, replace(c, covariance=c.covariance[:2])), ["shape (2, 5)"]),
    ],
)
def test_a_calibration_that_cannot_be_is_refused(
    change: Callable[[Network, Calibration], Network], words: list[str]
) -> None:
    network, start = simulated(np.random.default_rng(5), kind="none", free={"k3": np.inf, "p1": np.inf})
    own = tuple(Parameter.interior("K", name) for name in ("c", "x0", "y0", "k3", "p1"))
    calibration = Calibration(own, np.array([153.0, 0.0, 0.0, 1.5e-7, 0.0]), np.diag([1.0, 1.0, 1.0, 1e-18, 1e-16]))
    with pytest.raises(AdjustmentError) as error:
        adjust(change(network, calibration), start)
    for word in words:
        assert word in str(error.value)


def noisy(network: Network, rng: np.random.Generator, scale: float) -> Network:
    """A network without errors to speak of, its observations drawn by covariances so many times as large."""
    rows = network.observations
    covariance = scale**2 * rows.covariance_mm2
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return replace(
        network, observations=replace(rows, xy_mm=rows.xy_mm + rng.normal(0.0, sigma), covariance_mm2=covariance)
    )


def test_an_earlier_calibration_is_tested_as_a_whole() -> None:
    """Against the calibration of the new images alone: d' (C_old + C_new)^-1 d, their sigma0, and d itself."""
    (a, start_a), (b, start_b), _ = two_networks("none", 1.0)
    calibration = make_calibration(adjust(a, start_a), False)
    changed = replace(calibration, values=calibration.values + 2.0 * np.sqrt(np.diag(calibration.covariance)))
    network = set_calibration(b, changed)
    alone = adjust(replace(network, calibrations=()), start_b)
    (found,) = adjust(network, start_b).contradictions
    names = list(calibration.parameters)
    difference = np.array([alone.value(name) for name in names]) - changed.values
    joint = changed.covariance + alone.cofactor_of(names)
    chi_square = difference @ np.linalg.solve(joint, difference)
    assert found.parameters == calibration.parameters
    assert found.freedom == len(names)
    assert found.statistic == pytest.approx(chi_square / len(names) / alone.sigma0**2, rel=0.02)
    sigma = alone.sigma0 * np.sqrt(np.diag(joint))
    np.testing.assert_allclose(found.sigma, sigma, rtol=0.02)
    np.testing.assert_allclose(found.difference / sigma, difference / sigma, atol=0.05)
    assert found.direction[0] == np.argmax(np.abs(difference) / sigma)


def contradicted(sigmas: float, draws: int, level: float = 0.05) -> float:
    """The share of calibrations that are told to be contradicted, of cameras whose c has changed by so many sigmas."""
    (a, start_a), (b, start_b), _ = two_networks("none", 1e-6)
    rng = np.random.default_rng(4)
    result = []
    for _ in range(draws):
        calibration = make_calibration(adjust(noisy(a, rng, 1e6), start_a), False)
        c = calibration.parameters.index(Parameter.interior("K", "c"))
        values = calibration.values.copy()
        values[c] += sigmas * np.sqrt(2.0 * calibration.covariance[c, c])
        network = set_calibration(noisy(b, rng, 1e6), replace(calibration, values=values))
        (found,) = adjust(network, start_b).contradictions
        result.append(found.probability < level)
    return float(np.mean(result))


@pytest.mark.study
@pytest.mark.parametrize(("sigmas", "draws", "least", "most"), [(0.0, 40, 0.005, 0.13), (4.0, 16, 0.5, 1.0)])
def test_a_contradiction_is_reported_as_often_as_stated(sigmas: float, draws: int, least: float, most: float) -> None:
    """At a level of 5 %: of calibrations of the same camera, and of ones whose c has changed by so many sigmas."""
    assert least < contradicted(sigmas, draws) <= most


def test_a_contradiction_is_reported_next_to_what_the_marks_show() -> None:
    """Fiducials, films and camera together can shift, turn and grow, of which images alone say nothing: what is told is
    what is left where the marks lie over one another."""
    (a, start_a), (b, start_b), _ = two_networks("affine", 1.0)
    calibration = make_calibration(adjust(a, start_a), True)
    c, x0 = (calibration.parameters.index(Parameter.interior("K", name)) for name in ("c", "x0"))
    along_x = np.array([each.quantity in ("x0", "x") for each in calibration.parameters])

    def find(change: NDArray[np.float64]) -> CalibrationTest:
        given = set_calibration(b, replace(calibration, values=calibration.values + change))
        (finding,) = adjust(given, start_b).contradictions
        return finding

    same, shifted = find(0.0 * along_x), find(0.05 * along_x)
    longer = find(0.3 * (np.arange(len(along_x)) == c))
    assert same.freedom == len(same.parameters) - 4
    assert same.probability > 1e-3
    assert np.isfinite(same.difference).all()
    np.testing.assert_allclose(shifted.difference / same.sigma, same.difference / same.sigma, atol=0.05)
    assert longer.direction[0] == c
    assert longer.difference[c] == pytest.approx(same.difference[c] - 0.3, abs=0.01)
    assert longer.difference[x0] == pytest.approx(same.difference[x0], abs=0.2 * same.sigma[x0])
