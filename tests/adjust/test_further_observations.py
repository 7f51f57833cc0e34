"""Distances and observed orientations beside image points; expected precision."""

from dataclasses import replace

import numpy as np
import pytest
from networks import (
    ATTITUDES,
    STATIONS,
    Truth,
    camera_point,
    field_points,
    free_points,
    give_values,
    orient,
    rotation,
    set_camera,
    simulated,
)
from numpy.typing import NDArray
from reference_cases import CAMERA, case_approximations, case_network, load, own_name
from scipy.optimize import least_squares

from adjust import Adjustment, AdjustmentError, approximate
from adjust.problem.network import Exterior, Network
from adjust.problem.observations import Distance
from adjust.solution.adjustment import Options, adjust
from adjust.solution.planning import plan

Array = NDArray[np.float64]

NO_INTERIOR = dict.fromkeys(("c", "x0", "y0"), np.inf)
TRUTH = Truth(distortion={"k3": 1.5e-7})
ANTENNA = (0.4, -1.1, 2.3)
EO_SIGMAS = np.array([0.3, 0.3, 0.4, 2e-4, 2e-4, 3e-4])


def relative_rotation(a: Array | tuple[float, ...], b: Array | tuple[float, ...]) -> float:
    return float(np.linalg.norm(np.asarray(a) - np.asarray(b)))


def observed_network(rng: np.random.Generator) -> tuple[Network, Array]:
    """Unknown points and no film; orientations observed, distances of all three kinds; and the points' truth."""
    points = field_points(rng, 6)
    network, _ = simulated(rng, TRUTH, "none", points, np.inf, free={"k3": 1e-8})
    exteriors = TRUTH.exteriors + rng.normal(0.0, EO_SIGMAS, (4, 6))
    for i in (1, 3):
        exteriors[i, :3] += rotation(*ATTITUDES[i]).T @ ANTENNA
    given = {
        "f0": Exterior(exteriors[0], EO_SIGMAS),
        "f1": Exterior(exteriors[1], EO_SIGMAS, ANTENNA),
        "f2": Exterior(exteriors[2], EO_SIGMAS),
        "f3": Exterior(exteriors[3], np.where(EO_SIGMAS < 1e-3, np.inf, EO_SIGMAS), ANTENNA),  # by a rotation vector
    }
    distances = (
        Distance("0", "1", relative_rotation(points[0], points[1]) + 0.02, 0.02),
        Distance("2", "4", relative_rotation(points[2], points[4]) - 0.03, 0.05),
        Distance("f0", "f2", relative_rotation(STATIONS[0], STATIONS[2]) + 0.1, 0.1),
        Distance("5", "f3", relative_rotation(points[5], STATIONS[3]), 0.1),
    )
    return replace(set_camera(orient(network, given), fiducials={}), distances=distances), points


class Dense:
    """The same sum of squares by formulas of the simulation, minimised without any structure."""

    def __init__(self, network: Network, points: Array) -> None:
        self.network = network
        exteriors = TRUTH.exteriors
        start = np.concatenate([[TRUTH.c, TRUTH.x0, TRUTH.y0, 1.5], exteriors.ravel(), points.ravel()])
        found = least_squares(self.residuals, start, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        self.values = found.x
        self.vpv = 2.0 * found.cost
        jacobian = np.asarray(found.jac)
        self.cofactor = np.linalg.inv(jacobian.T @ jacobian)

    def residuals(self, x: Array) -> Array:
        (c, x0, y0, k3), exterior, points = x[:4], x[4:28].reshape(4, 6), x[28:].reshape(-1, 3)
        truth = Truth(c, x0, y0, distortion={"k3": 1e-7 * k3}, stations=tuple(map(tuple, exterior[:, :3])),
                      attitudes=tuple(map(tuple, exterior[:, 3:])))  # fmt: skip
        network = self.network
        rows = zip(network.observations.image, network.observations.point, network.observations.xy_mm, strict=True)
        result = [(camera_point(truth, int(image[1:]), points[int(point)]) - xy) / 0.004 for image, point, xy in rows]
        camera = network.cameras[0]
        given = [camera.principal_distance_mm, camera.x0_mm, camera.y0_mm, camera.distortion.parameters["k3"]]
        result += [[(v - p.value) / p.sigma] for v, p in zip((c, x0, y0, 1e-7 * k3), given, strict=True) if p]
        for row, image in zip(exterior, network.images, strict=True):
            if image.exterior is not None:
                observed = np.append(row[:3] + rotation(*row[3:]).T @ image.exterior.antenna, row[3:])
                result.append((observed - image.exterior.values) / image.exterior.sigmas)
        place = {f"f{i}": row[:3] for i, row in enumerate(exterior)} | {str(i): xyz for i, xyz in enumerate(points)}
        result += [[(relative_rotation(place[d.start], place[d.end]) - d.value) / d.sigma] for d in network.distances]
        return np.concatenate(result)


NAMES = (
    [f"IO.K.{name}" for name in ("c", "x0", "y0", "k3")]
    + [f"EO.f{i}.{name}" for i in range(4) for name in ("X0", "Y0", "Z0", "omega", "phi", "kappa")]
    + [f"PT.{i}.{axis}" for i in range(6) for axis in "XYZ"]
)


def test_observed_orientations_and_distances_as_in_a_dense_adjustment() -> None:
    network, points = observed_network(np.random.default_rng(1))
    dense = Dense(network, points)
    result = adjust(network, approximate(network))
    scale = np.ones(len(NAMES))
    scale[3] = 1e-7
    sigmas = np.sqrt(np.diag(dense.cofactor)) * scale
    difference = np.array([result.value(name) for name in NAMES]) - dense.values * scale
    assert np.abs(difference / sigmas).max() < 1e-5
    assert result.vpv == pytest.approx(dense.vpv, rel=1e-9)
    cofactor = dense.cofactor * np.outer(scale, scale)
    np.testing.assert_allclose(result.cofactor_of(NAMES) / np.outer(sigmas, sigmas),
                               cofactor / np.outer(sigmas, sigmas), atol=1e-6)  # fmt: skip
    conditions = 2 * 24 + 4 + 21 + 4
    assert (result.conditions, result.redundancy) == (conditions, conditions - len(NAMES))
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(result.redundancy)
    distances = dense.residuals(dense.values)[-4:]
    np.testing.assert_allclose([row.v / row.sigma for row in result.further[:4]], distances, atol=1e-6)
    assert [row.name for row in result.further[:4]] == [f"{each.start} to {each.end}" for each in network.distances]
    assert [row.name for row in result.further[4:]] == [f"{name} {axis}" for name in ("f1", "f3") for axis in "XYZ"]
    for row in result.further:
        assert row.w == pytest.approx(row.v / (row.sigma * np.sqrt(row.redundancy)))
        assert row.detectable == pytest.approx(4.13 * row.sigma / np.sqrt(row.redundancy), rel=1e-3)
    assert result.groups["distance"].redundancy == pytest.approx(sum(row.redundancy for row in result.further[:4]))


def scaled_by_bars(count: int) -> tuple[Network, Array]:
    """A free network of many or few points, with two scale bars."""
    rng = np.random.default_rng(5)
    points = field_points(rng, count)
    network, _ = simulated(rng, points=points, point_sigma=np.inf)
    bars = tuple(
        Distance(a, b, relative_rotation(points[int(a)], points[int(b)]), 0.01) for a, b in (("0", "1"), ("2", "3"))
    )
    return replace(network, distances=bars), points


def test_planned_distances_are_taken_to_be_true() -> None:
    """A plan has the cofactors of the adjustment at its values, and nothing to iterate, whatever the distances say."""
    network, points = observed_network(np.random.default_rng(1))
    start = approximate(network)
    exteriors = {f"f{i}": exterior for i, exterior in enumerate(TRUTH.exteriors)}
    values = replace(start, points={str(i): xyz for i, xyz in enumerate(points)}, exterior=exteriors)
    planned = plan(network, values).adjustment
    wrong = replace(network, distances=tuple(replace(each, value=each.value + 5.0) for each in network.distances))
    assert plan(wrong, values).adjustment.value("PT.0.X") == pytest.approx(points[0][0], abs=1e-9)
    assert all(abs(row.v) < 1e-9 for row in planned.further)
    sigma = np.sqrt(adjust(network, start).cofactor_of(["PT.0.X"])[0, 0])
    assert np.sqrt(planned.cofactor_of(["PT.0.X"])[0, 0]) == pytest.approx(sigma, rel=0.01)


@pytest.mark.parametrize("count", [9, 24])
def test_a_scale_bar_removes_the_scale_defect(count: int) -> None:
    """Whether images or points are eliminated first; the camera is that of the free network, the size that of the bars.

    One bar is no check of the network, two check each other.
    """
    network, points = scaled_by_bars(count)
    _, start = simulated(np.random.default_rng(5), points=points, point_sigma=np.inf)
    causes = [null.cause for null in adjust(network, start).singular]
    assert len(causes) == 6
    assert not any("grow" in cause for cause in causes)
    free = adjust(replace(network, distances=()), start, Options("free"))
    one = adjust(replace(network, distances=network.distances[:1]), start, Options("free"))
    two = adjust(network, start, Options("free"))
    assert one.vpv == pytest.approx(free.vpv, rel=1e-9)
    assert one.redundancy == free.redundancy
    assert one.further[0].redundancy == pytest.approx(0.0, abs=1e-7)
    assert (one.further[0].w, one.further[0].detectable) == (0.0, np.inf)
    assert two.redundancy == free.redundancy + 1
    assert camera(one) == pytest.approx(camera(free), rel=1e-9)
    size = relative_rotation(*(np.array([one.value(f"PT.{id}.{axis}") for axis in "XYZ"]) for id in "01"))
    assert size == pytest.approx(network.distances[0].value, abs=1e-7)


def camera(result: Adjustment) -> list[float]:
    names = [name for name in result.names if name.startswith(("IO.", "FID."))]
    return [result.value(name) for name in names] + [result.cofactor_of([name])[0, 0] for name in names]


def test_approximations_of_a_model_have_the_size_of_the_distances() -> None:
    """Nothing known but a distance: the model's arbitrary base is scaled, and the adjustment finds the truth."""
    network, points = scaled_by_bars(24)
    network = free_points(network, network.point_by_id)
    start = approximate(network)
    assert relative_rotation(start.points["4"], start.points["5"]) == pytest.approx(
        relative_rotation(points[4], points[5]), rel=0.02
    )
    result = adjust(network, start, Options("free"))
    assert result.converged
    found = relative_rotation(*(np.array([result.value(f"PT.{id}.{axis}") for axis in "XYZ"]) for id in "45"))
    assert found == pytest.approx(relative_rotation(points[4], points[5]), abs=0.1)


@pytest.mark.parametrize("name", ["i_five_images_affine_paper_noisefree", "ii_juhl_3photos"])
def test_a_priori_sigmas_of_the_reference(name: str) -> None:
    """At the true values: those of a case with noise were computed a little beside them."""
    case = load(name)
    expected = plan(case_network(case), case_approximations(case, case["truth"]))
    sigmas = {own_name(key): row["std_apriori"] for key, row in case["result"]["parameters"].items()}
    planned = [expected.sigma(key) for key in sigmas]
    tolerance = 1e-7 if case["result"]["vpv"] < 1e-12 else 2e-3
    np.testing.assert_allclose(planned, list(sigmas.values()), rtol=tolerance)
    redundancy = expected.adjustment.residuals.redundancy.ravel()
    np.testing.assert_allclose(redundancy, case["result"]["redundancy_numbers"][: len(redundancy)], atol=tolerance)


def test_a_singular_network_still_determines_the_rest() -> None:
    """Juhl's field of known heights: not c, x0', y0', but all nine deformations as if these were known."""
    case = load("ii_juhl_3photos")
    network, values = case_network(case), case_approximations(case, case["truth"])
    regular, singular = plan(network, values), plan(give_values(network, NO_INTERIOR), values)
    assert regular.singular == ()
    assert len(singular.singular) == 3
    for name in (f"IO.{CAMERA}.c", f"IO.{CAMERA}.x0", f"IO.{CAMERA}.y0", "EO.1.Z0"):
        assert singular.sigma(name) == np.inf
    for name in case["nine_parameters"]:
        expected = regular.sigma(f"IO.{CAMERA}.{name}")
        assert singular.sigma(f"IO.{CAMERA}.{name}") == pytest.approx(expected, rel=1e-6)
    # How high the stations are is not known, but by how much one is above the other.
    names, difference = ["EO.1.Z0", "EO.2.Z0"], np.array([[1.0, -1.0]])
    assert singular.sigmas(names, difference) == pytest.approx(regular.sigmas(names, difference), rel=1e-6)


def test_a_point_behind_the_camera_is_reported() -> None:
    network, values = simulated(np.random.default_rng(1))
    away = {**values.exterior, "f2": values.exterior["f2"] + np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0])}
    with pytest.raises(AdjustmentError, match=r"cannot be planned: point \d+ lies behind the camera in image f2"):
        plan(network, replace(values, exterior=away))
