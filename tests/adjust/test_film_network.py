"""Networks on films of every kind: perfect data, an independent solution of the same problem, null directions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from simulated import (
    ATTITUDES,
    STATIONS,
    Truth,
    camera_of_film,
    field_points,
    film_parameters,
    rotation,
    simulated,
    torlegard,
)

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.network import Network, Transformation
from adjust.problem.observations import Observations
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

BENT = ["projective", "bilinear", "conformal(2)", "conformal(3)", "polynomial(2)", "polynomial(3)"]
SCANS = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))
CONVERGENT = Truth(
    stations=(*STATIONS, (20.0, -500.0, 1550.0)),
    attitudes=(*ATTITUDES, (0.33, 0.02, 0.7)),
    mirrored=5 * (False,),
    family="none",
    distortion={},
)
DROPPED = ("F5-F9", "F5-F8", "F5,F6", "F5,F6,F9", "F7,F8", "F7-F9", "F9", "none")
RIGID = {
    "F5-F9": ["Shift x", "Shift y", "Rotation"],
    "F5-F8": ["Shift x", "Shift y", "Rotation"],
    "F5,F6": ["Rotation"],
    "F5,F6,F9": ["Rotation"],
}
SIMILAR = RIGID | {key: [*RIGID[key], "Scale"] for key in ("F5-F9", "F5,F6,F9")}
TILTED = {key: [*names, "Tilt x", "Tilt y"] for key, names in SIMILAR.items()}


@pytest.mark.parametrize("kind", BENT)
def test_perfect_data_leave_nothing_and_give_the_truth_back(kind: Transformation) -> None:
    """Comparator coordinates from 5 to 235 mm, one scan mirrored; three marks more make eight."""
    network, _ = simulated(
        np.random.default_rng(4), SCANS, kind, field_points(np.random.default_rng(5), 25), noise=False
    )
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert np.abs(result.residuals.v_mm).max() < 1e-9
    for i in range(4):
        expected = film_parameters(SCANS, i, kind)
        names = [name for name in result.names if name.startswith(f"T.f{i}.")]
        off = [abs(result.value(name) - value) for name, value in zip(names, expected, strict=True)]
        assert np.all(off <= np.array([1e-5 * result.sigma(name) / result.sigma0 for name in names]))
    assert result.mirrored == {"f1"}


@pytest.mark.parametrize("kind", [pytest.param("polynomial(3)", marks=pytest.mark.slow), "polynomial(5)"])
def test_the_origin_of_the_comparator_does_not_matter(kind: Transformation) -> None:
    """A metre and a half off, as on a film strip; with exact observations, which are moved without a rounding."""
    network, _ = simulated(
        np.random.default_rng(4), Truth(), "polynomial(3)", field_points(np.random.default_rng(5), 40), noise=False
    )
    network = replace(network, images=tuple(replace(image, transformation=kind) for image in network.images))
    results = [adjust(each, approximate(each)) for each in (network, moved_origin(network, 1500.0))]
    for result in results:
        assert result.converged
        assert np.abs(result.residuals.v_mm).max() < 1e-10
    for name in ("IO.K.c", "IO.K.x0", "FID.K.3.y", "EO.f2.omega"):
        near, far = (result.sigma(name) / result.sigma0 for result in results)
        assert far == pytest.approx(near, rel=1e-9)


def moved_origin(network: Network, off_mm: float) -> Network:
    observations = network.observations
    return replace(network, observations=replace(observations, xy_mm=observations.xy_mm + off_mm))


@pytest.mark.parametrize(("kind", "marks"), [("projective", 3), ("bilinear", 3), ("conformal(3)", 2)])
def test_targets_determine_what_too_few_marks_leave_open(kind: Transformation, marks: int) -> None:
    network, _ = simulated(
        np.random.default_rng(4), Truth(), kind, field_points(np.random.default_rng(5), 25), noise=False
    )
    network = with_marks(network, marks)
    result = adjust(network, approximate(network))
    assert result.converged
    assert result.vpv < 1e-12
    assert result.warnings == (
        f"Image f0 shows {marks} fiducial marks, and its {kind} transformation takes 4 of its own: the targets "
        f"determine the rest of it. 3 more images are alike.",
    )


def with_marks(network: Network, count: int, images_of_marks_alone: tuple[str, ...] = ()) -> Network:
    """The network with the first marks only, and some images without targets."""
    rows = network.observations
    keep = [
        i
        for i, (image, point, what) in enumerate(zip(rows.image, rows.point, rows.kind, strict=True))
        if (int(point) <= count if what == "fiducial" else image not in images_of_marks_alone)
    ]
    observations = Observations(
        tuple(rows.image[i] for i in keep),
        tuple(rows.point[i] for i in keep),
        tuple(rows.kind[i] for i in keep),
        rows.xy_mm[keep],
        rows.covariance_mm2[keep],
    )
    return replace(network, observations=observations)


def test_an_image_without_targets_needs_all_marks_of_its_own() -> None:
    network, _ = simulated(np.random.default_rng(4), Truth(), "projective", noise=False)
    with pytest.raises(AdjustmentError, match=r"image f2 shows 3 fiducial marks; its projective .* needs 4\. Measure"):
        approximate(with_marks(network, 3, ("f2",)))
    result = adjust(enough := with_marks(network, 4, ("f2",)), approximate(enough))
    assert result.converged


def test_a_film_that_folds_over_is_told() -> None:
    network, start = simulated(np.random.default_rng(4), Truth(), "polynomial(2)", noise=False)
    folded = start.transformation["f1"].copy()
    folded[3] = 0.02  # x' turns back at some 15 mm from the middle
    with pytest.raises(
        AdjustmentError, match=r"cannot start: .* polynomial\(2\) transformation of image f1 folds over"
    ):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": folded}))


@pytest.mark.parametrize(
    "kind",
    ["projective", "conformal(2)"]
    + [
        pytest.param(kind, marks=pytest.mark.slow)
        for kind in ("bilinear", "congruent", "conformal(3)", "polynomial(2)", "polynomial(3)")
    ],
)
def test_another_solver_on_an_explicit_model_agrees(kind: Transformation) -> None:
    """The comparator coordinates as functions of all unknowns, their Jacobian by complex steps, and its QR factor."""
    points = field_points(np.random.default_rng(7), 12)
    network, start = simulated(np.random.default_rng(6), SCANS, kind, points, free={"k3": np.inf})
    result = adjust(network, start)
    names, other = reference(network, kind, points, result)
    root = np.linalg.inv(np.linalg.qr(other.jac / (size := np.linalg.norm(other.jac, axis=0)), mode="r"))
    cofactor = root @ root.T / np.outer(size, size)
    sigmas = np.sqrt(np.diag(cofactor))
    assert result.converged
    assert result.vpv == pytest.approx(2.0 * other.cost, rel=1e-8)
    ours = np.array([result.value(name) for name in names])
    np.testing.assert_allclose((ours - other.x) / sigmas, 0.0, atol=1e-5)
    np.testing.assert_allclose((result.cofactor_of(names) - cofactor) / np.outer(sigmas, sigmas), 0.0, atol=1e-6)


def reference(network: Network, kind: Transformation, points: Array, result: Adjustment) -> tuple[list[str], Any]:
    """Names of the unknowns, and what scipy finds for them from some standard deviations away."""
    names = [name for name in result.names if result.sigma(name) > 0.0]
    given = prior_values(network)
    sigma_mm = np.sqrt(np.diagonal(network.observations.covariance_mm2, axis1=1, axis2=2))

    def residuals(x: Any) -> Any:
        values = dict(zip(names, x, strict=True))
        off = (computed(network, kind, points, values) - network.observations.xy_mm) / sigma_mm
        priors = [(values[name] - prior.value) / prior.sigma for name, prior in given.items()]
        return np.append(off.ravel(), priors)

    def real_residuals(x: Array) -> Array:
        return np.asarray(residuals(x).real)

    def jacobian(x: Array) -> Array:
        steps = 1e-30j * np.eye(len(x))
        return np.stack([residuals(x + step).imag / 1e-30 for step in steps], axis=1)

    away = np.random.default_rng(9).normal(0.0, 2.0, len(names))
    first = np.array([result.value(name) for name in names]) + away * [result.sigma(name) for name in names]
    tight = 1e-12  # of the sum of squares: the last step was below 1e-5 standard deviations
    return names, least_squares(real_residuals, first, jacobian, x_scale="jac", xtol=tight, ftol=tight, gtol=tight)


def prior_values(network: Network) -> dict[str, Prior]:
    camera = network.cameras[0]
    assert camera.principal_distance_mm is not None
    assert camera.x0_mm is not None
    assert camera.y0_mm is not None
    marks = {
        f"FID.K.{id_}.{axis}": getattr(mark, f"{axis}_mm") for id_, mark in camera.fiducials.items() for axis in "xy"
    }
    return {"IO.K.c": camera.principal_distance_mm, "IO.K.x0": camera.x0_mm, "IO.K.y0": camera.y0_mm} | marks


def computed(network: Network, kind: Transformation, points: Array, values: dict[str, Any]) -> Any:
    """Comparator coordinates (n, 2) of all observations, for complex values too."""
    lens = replace(
        SCANS,
        c=values["IO.K.c"],
        x0=values["IO.K.x0"],
        y0=values["IO.K.y0"],
        distortion=SCANS.distortion | {"k3": values["IO.K.k3"]},
    )
    rows = list(zip(network.observations.image, network.observations.point, network.observations.kind, strict=True))
    result = np.zeros((len(rows), 2), dtype=complex)
    for i in range(4):
        marks = [row for row, (image, _, what) in enumerate(rows) if (image, what) == (f"f{i}", "fiducial")]
        targets = [row for row, (image, _, what) in enumerate(rows) if (image, what) == (f"f{i}", "target")]
        x, y = np.array([[values[f"FID.K.{rows[row][1]}.{axis}"] for row in marks] for axis in "xy"])
        at_x, at_y = target_places(lens, i, points[[int(rows[row][1]) for row in targets]], values)
        film = np.array([value for name, value in values.items() if name.startswith(f"T.f{i}.")])
        places = inverted(kind, film, SCANS.mirrored[i], np.append(x, at_x), np.append(y, at_y))
        result[marks + targets] = np.stack(places, axis=1)
    return result


def target_places(lens: Truth, i: int, points: Array, values: dict[str, Any]) -> tuple[Any, Any]:
    """Where an image's targets are observed in the camera frame."""
    station = np.array([values[f"EO.f{i}.{element}"] for element in ("X0", "Y0", "Z0")])
    turn = rotation(*(values[f"EO.f{i}.{element}"] for element in ("omega", "phi", "kappa")))
    u, v, w = turn @ (points - station).T
    ideal_x, ideal_y = lens.x0 - lens.c * u / w, lens.y0 - lens.c * v / w
    x, y = ideal_x, ideal_y
    for _ in range(8):
        dx, dy = torlegard(lens, x, y)
        x, y = ideal_x + dx, ideal_y + dy
    return x, y


def inverted(kind: Transformation, film: Any, mirrored: bool, x: Any, y: Any) -> tuple[Any, Any]:
    """By the chord of the film about the middle of the scans, which is real and so leaves complex steps alone."""
    middle = np.array(SCANS.middle_mm)
    ends = [np.array(camera_of_film(kind, film, mirrored, *(middle + off))).real for off in 50.0 * np.eye(2)]
    chord = np.linalg.inv(
        np.stack(ends, axis=1) - np.array(camera_of_film(kind, film, mirrored, *middle)).real[:, None]
    )
    xy = np.tile(middle[:, None], (1, len(x))).astype(complex)
    for _ in range(8):  # the bend changes by less than a hundredth over an image: two digits a turn
        xy = xy + 50.0 * chord @ (np.stack([x, y]) - np.stack(camera_of_film(kind, film, mirrored, xy[0], xy[1])))
    return xy[0], xy[1]


def dropped(network: Network, functions: str) -> Network:
    """The network with priors of 1 mm, but for the pseudo-observations that are dropped."""
    first, _, last = functions.partition("-")
    gone = (
        range(int(first[1:]), int(last[1:]) + 1) if last else [int(f[1:]) for f in functions.split(",") if f != "none"]
    )
    x, y, x0, y0, c = (np.inf if number in gone else 1.0 for number in range(5, 10))
    camera = network.cameras[0]
    marks = {
        id_: replace(mark, x_mm=replace(mark.x_mm, sigma=x), y_mm=replace(mark.y_mm, sigma=y))
        for id_, mark in camera.fiducials.items()
    }
    assert camera.principal_distance_mm is not None
    assert camera.x0_mm is not None
    assert camera.y0_mm is not None
    camera = replace(
        camera,
        fiducials=marks,
        principal_distance_mm=replace(camera.principal_distance_mm, sigma=c),
        x0_mm=replace(camera.x0_mm, sigma=x0),
        y0_mm=replace(camera.y0_mm, sigma=y0),
    )
    return replace(network, cameras=(camera,))


@pytest.mark.parametrize(
    ("kind", "table"),
    [
        ("congruent", RIGID),
        ("similarity", SIMILAR),
        ("affine", SIMILAR),
        ("bilinear", SIMILAR),
        ("conformal(2)", SIMILAR),
        ("conformal(3)", SIMILAR),
        ("projective", TILTED),
    ],
)
def test_null_directions_by_transformation_and_dropped_priors(
    kind: Transformation, table: dict[str, list[str]]
) -> None:
    """Five convergent images of a field in three dimensions, without distortion, which would move too."""
    points = field_points(np.random.default_rng(8), 14)
    network, start = simulated(np.random.default_rng(3), CONVERGENT, kind, points, noise=False)
    for functions in DROPPED:
        result = adjust(dropped(network, functions), start)
        assert [each.cause.split(":")[0] for each in result.singular] == table.get(functions, []), functions
        assert result.converged == (functions not in table)
