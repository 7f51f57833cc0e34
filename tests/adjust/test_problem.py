"""Bad input, one thing at a time, and the keys of quantities."""

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import matplotlib as mpl
import matplotlib.figure
import networks as nets
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from adjust import Adjustment, AdjustmentError, Distortion, Exterior, Network, ObjectPoint, Parameter, Prior, adjust
from adjust.display import contour_levels, distance_text
from adjust.errors import DatumError
from adjust.problem.camera import FiducialDistance
from adjust.problem.network import Board, Scanner
from adjust.problem.observations import Distance, Observations
from adjust.problem.parameter import object_coordinate, parameter_from_text, parameters_from_texts
from adjust.quality.critical_values import Probabilities, WeightFunction
from adjust.solution.adjustment import Datum, Options

Change = Callable[[Network], Network]


def test_mirrored_observations_scatter_as_their_covariances_say() -> None:
    """By the scatter of many places, mirrored one by one."""
    rng, covariance, signs = np.random.default_rng(2), np.array([[4.0, 1.5], [1.5, 1.0]]), np.array([[-1.0, 1.0]])
    places = rng.multivariate_normal([0.0, 0.0], covariance, 4000)
    one = Observations(("a",), ("1",), ("target",), np.array([[3.0, 2.0]]), covariance[None])
    mirrored = one.mirror(signs, np.array([[10.0, 0.0]]))
    np.testing.assert_allclose(mirrored.covariance_mm2[0], np.cov((places * signs).T), atol=0.3)
    np.testing.assert_allclose(mirrored.xy_mm, [[7.0, 2.0]])


def drop_observations(network: Network, image: str, kind: str, left: int) -> Network:
    """All but some marks of a kind in an image."""
    observations = network.observations
    places = [i for i in range(len(observations)) if (observations.image[i], observations.kind[i]) == (image, kind)]
    return nets.drop_rows(network, places[left:])


def drop_fiducial(network: Network) -> Network:
    return nets.set_camera(network, fiducials={k: mark for k, mark in network.cameras[0].fiducials.items() if k != "3"})


def bad_covariance(network: Network) -> Network:
    covariance = network.observations.covariance_mm2.copy()
    covariance[8] = [[1e-6, 2e-6], [2e-6, 1e-6]]
    return nets.set_observations(network, covariance_mm2=covariance)


def set_distance(network: Network, *distance: Any) -> Network:
    """Beside a known point that no image shows."""
    lonely = ObjectPoint("lonely", Prior(0.0), Prior(0.0), Prior(0.0))
    return replace(network, points=(*network.points, lonely), distances=(Distance(*distance),))


def set_fiducial_distance(network: Network, *distance: Any) -> Network:
    return nets.set_camera(network, distances=(FiducialDistance(*distance),))


def observed_twice(network: Network) -> Network:
    return replace(network, observations=network.observations.only(np.array([*range(len(network.observations)), 7])))


GALLERY: dict[str, tuple[Change, list[str]]] = {
    "no images": (lambda n: replace(n, images=()), ["nothing to adjust", "no image"]),
    "no observations": (lambda n: nets.keep_rows(n, lambda *_: False), ["nothing to adjust", "statuses"]),
    "camera twice": (lambda n: replace(n, cameras=n.cameras * 2), ["camera K", "more than once"]),
    "image twice": (lambda n: replace(n, images=(*n.images, n.images[2])), ["image f2", "more than once"]),
    "point twice": (lambda n: replace(n, points=(*n.points, n.points[4])), ["object point 4", "more than once"]),
    "unknown camera": (
        lambda n: replace(n, images=(replace(n.images[0], camera="RMK"), *n.images[1:])),
        ["image f0", "camera RMK", "given: K"],
    ),
    "unknown image": (lambda n: replace(n, images=n.images[1:]), ["image f0", "Add the image"]),
    "unknown point": (lambda n: replace(n, points=n.points[1:]), ["target 0", "image f0", "Add it to the points"]),
    "unknown fiducial": (drop_fiducial, ["fiducial 3", "image f0", "camera K"]),
    "observed twice": (observed_twice, ["point 2", "2 times", "image f0"]),
    "covariance": (bad_covariance, ["target 3", "image f0", "not positive definite"]),
    "nan": (
        lambda n: nets.add_errors(n, {9: np.array([0.0, np.nan])}),
        ["target 4", "image f0", "not a finite number"],
    ),
    "two targets": (lambda n: drop_observations(n, "f1", "target", 2), ["image f1", "2 object points", "needs 3"]),
    "two fiducials": (
        lambda n: drop_observations(n, "f3", "fiducial", 2),
        ["image f3", "2 fiducial", "affine", "needs 3"],
    ),
    "two of four": (
        lambda n: drop_observations(nets.set_images(n, transformation="projective"), "f3", "fiducial", 2),
        ["image f3", "2 fiducial", "projective transformation needs 3", "4 where its targets tell nothing of it"],
    ),
    "no fiducials": (lambda n: drop_observations(n, "f3", "fiducial", 0), ["image f3", "0 fiducial", "needs 3"]),
    "parameter": (
        lambda n: nets.set_camera(n, distortion=Distortion("torlegard", {"k9": Prior(1.0)})),
        ["camera K", "torlegard", "k9", "k3, k5"],
    ),
    "rows do not go together": (
        lambda n: nets.set_observations(n, point=n.observations.point[:-1]),
        ["do not go together"],
    ),
    "distance to what is not": (lambda n: set_distance(n, "0", "no", 1.0, 0.1), ["from 0 to no", "neither"]),
    "distance to itself": (lambda n: set_distance(n, "0", "0", 1.0, 0.1), ["same point"]),
    "distance below zero": (lambda n: set_distance(n, "0", "1", -1.0, 0.1), ["positive number"]),
    "exact distance": (
        lambda n: set_distance(n, "0", "1", 100.0, 0.0),
        ["exact distance is not offered", "a hundredth"],
    ),
    "free distance": (lambda n: set_distance(n, "0", "1", 100.0, np.inf), ["positive standard deviation"]),
    "distance to what is not seen": (
        lambda n: set_distance(n, "0", "lonely", 100.0, 0.1),
        ["no image shows the point lonely"],
    ),
    "distance to no fiducial": (lambda n: set_fiducial_distance(n, "1", "9", 150.0, 0.01), ["has no fiducial 9"]),
    "fiducial to itself": (lambda n: set_fiducial_distance(n, "1", "1", 150.0, 0.01), ["same point at both ends"]),
    "fiducials below zero": (lambda n: set_fiducial_distance(n, "1", "2", -150.0, 0.01), ["must be a positive number"]),
    "exact fiducials": (
        lambda n: set_fiducial_distance(n, "1", "2", 150.0, 0.0),
        ["needs a positive standard deviation"],
    ),
    "c": (
        lambda n: nets.set_camera(n, principal_distance_mm=Prior(-153.0, 1.0)),
        ["camera K: the principal distance must be positive"],
    ),
}


@pytest.mark.parametrize("name", list(GALLERY))
def test_gallery(name: str) -> None:
    change, words = GALLERY[name]
    network, start = nets.simulated(np.random.default_rng(1))
    with pytest.raises(AdjustmentError) as caught:
        adjust(change(network), start)
    for word in words:
        assert word in str(caught.value)


def test_approximations_that_are_missing_or_turned_away() -> None:
    """Of f2 the station lies below the field: every point is behind the camera."""
    network, start = nets.simulated(np.random.default_rng(1))
    below = dict(start.exterior) | {"f2": start.exterior["f2"] * np.array([1, 1, -1, 1, 1, 1])}
    with pytest.raises(AdjustmentError, match=r"point 0 lies behind the camera in image f2"):
        adjust(network, replace(start, exterior=below))
    with pytest.raises(AdjustmentError, match=r"X0 of image f1 has neither a value nor an approximation"):
        adjust(network, replace(start, exterior={k: v for k, v in start.exterior.items() if k != "f1"}))
    with pytest.raises(AdjustmentError, match=r"image f1: .*affine has 6 parameters .*but 4"):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": np.zeros(4)}))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Prior(np.nan), "finite number"),
        (lambda: Prior(1.0, -1.0), r"0 \(fixed\), positive or inf"),
        (lambda: Exterior(np.zeros(5)), "six elements"),
        (lambda: Exterior(np.zeros(6), np.array([1.0, 1.0, 1.0, 1.0, 1.0, np.nan])), r"0 \(fixed\), positive or inf"),
        (lambda: Distortion("fisheye"), "one of none, torlegard"),
        (lambda: Distortion("torlegard", r0_mm=-80.0), "r0 must be"),
        (lambda: Distortion("legendre(1)"), r"the order of legendre must be 2 to 9, not 1"),
        (lambda: Distortion("fourier(10)"), r"the order of fourier must be 1 to 9, not 10"),
        (lambda: Distortion("legendre"), r"one of none, .*legendre\(n\), fourier\(n\), not legendre"),
        (lambda: Distortion("ebner(3)"), "must be one of"),
        (lambda: Scanner("S", {"a10": Prior(0.0)}), "has no term a10"),
        (lambda: Scanner("S", {"a20": Prior(0.0)}, half_mm=(0.0, 1.0)), "two positive lengths"),
        (lambda: Board("b", {str(k): np.array([k, 0.0, 0.0]) for k in range(5)}), "four points about in a plane"),
        (lambda: Options(datum=cast(Datum, "fixed")), r"datum must be one of control, minimal, free"),
        (lambda: Options(iteration_limit=0), "iteration limit must be at least 1"),
        (lambda: Options(robust=True, snooping=True), "choose one of them"),
        (lambda: Options(variance_components=("bolts",)), "no group bolts"),
        (lambda: Options(robust=cast(WeightFunction, "tukey")), "huber, igg3"),
        (lambda: Probabilities(power=80.0), "power must lie between 0 and 1"),
    ],
)
def test_bad_values_are_refused_when_they_are_made(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_ordinary_names_are_written_as_they_always_were() -> None:
    keys = {
        "IO.Wild RC8 13.5.k3": Parameter.interior("Wild RC8 13.5", "k3"),
        "FID.Wild RC8 13.5.3.x": Parameter.fiducial("Wild RC8 13.5", "3", "x"),
        "SC.S 1.a20": Parameter.scanner("S 1", "a20"),
        "BD.board.bend_x": Parameter.board("board", "bend_x"),
        "PT.12.4.X": Parameter.point("12.4", "X"),
        "EO.roll 7/frame.8.Z0": Parameter.exterior("roll 7/frame.8", "Z0"),
        "T.f1.a1": Parameter.film("f1", "a1"),
        "JOIN.f.1.p3.y": Parameter.join("f.1", "p3", "y"),
    }
    assert {key.text: key for key in keys.values()} == keys
    assert parameters_from_texts(list(keys)) == tuple(keys.values())


def random_name(rng: np.random.Generator) -> str:
    """Of pieces that separators, escapes and codes are made of."""
    pieces = [*"Ab1.%*ß点x /,;=", "..", "%2E", "%25", "2E", "25", "IO.", "\\", '"']
    return "".join(rng.choice(pieces, rng.integers(1, 6)))


def test_texts_of_any_names_are_unique_and_are_read_back() -> None:
    rng = np.random.default_rng(38)
    keys: set[Parameter] = set()
    while len(keys) < 4000:
        owner, id, quantity = random_name(rng), random_name(rng), str(rng.choice(["c", "x", "k3", "X0"]))
        if owner != "*":  # many owners in a list of what moves together
            keys |= {Parameter.fiducial(owner, id, quantity), Parameter.join(owner, id, quantity)}
        keys |= {
            Parameter.interior(owner, quantity),
            Parameter.point(id, quantity),
            Parameter.exterior(owner, quantity),
        }
    assert len({each.text for each in keys}) == len(keys)
    assert all(parameter_from_text(each.text) == each for each in keys)


@pytest.mark.parametrize("text", ["", "IO", "IO.K", "XX.K.c", "FID.K.x", "IO.K.", "f1 X", "IO.f.1 X", "K.c"])
def test_what_names_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="names no quantity"):
        parameter_from_text(text)


def test_fiducials_of_earlier_files_are_known_by_their_camera() -> None:
    texts = ["IO.K.c", "IO.W.1.c", "FID.K.7.1.x", "FID.K.7.y", "FID.W.1.3.x", "FID.K.8%2E1.x"]
    marks = [(each.owner, each.id) for each in parameters_from_texts(texts)[2:]]
    assert marks == [("K", "7.1"), ("K", "7"), ("W.1", "3"), ("K", "8.1")]


def test_a_coordinate_is_called_by_its_point() -> None:
    assert object_coordinate("roll.1.X") == Parameter.point("roll.1", "X")
    with pytest.raises(DatumError, match=r"a dot and X, Y or Z"):
        object_coordinate("12")


PIXEL_MM = 0.005


@pytest.fixture(scope="module")
def board() -> Adjustment:
    mpl.use("Agg")
    return adjust(nets.board_network(np.random.default_rng(3), 6, 5e-4))


@pytest.fixture(scope="module")
def film() -> Adjustment:
    mpl.use("Agg")
    rng, truth = np.random.default_rng(2), nets.Truth()
    network, start = nets.simulated(
        rng, truth, points=nets.field_points(rng, 40), free=dict.fromkeys(truth.distortion, np.inf)
    )
    return adjust(
        replace(network, cameras=(replace(network.cameras[0], frame_mm=(2 * nets.HALF_MM, 2 * nets.HALF_MM)),)), start
    )


def vectors(axes: Axes) -> list[Any]:
    return [each for each in axes.collections if isinstance(each, Quiver)]


def rms_text(vectors: NDArray[np.float64]) -> str:
    x, y = np.sqrt(np.mean(vectors**2, axis=0))
    return f"{x:.3g} × {y:.3g}"


def test_residuals_are_vectors_along_the_axes_of_the_picture(board: Adjustment) -> None:
    axes = board.plots(pixel_mm=PIXEL_MM).plot_residuals()
    (quiver,) = vectors(axes)
    v_px = board.residuals.v_mm / PIXEL_MM * [1.0, -1.0]
    np.testing.assert_allclose(np.column_stack([quiver.U, quiver.V]), v_px)
    np.testing.assert_allclose(quiver.XY, board.network.observations.xy_mm / PIXEL_MM * [1.0, -1.0])
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # rows count downwards
    assert axes.get_title(loc="left").endswith(f"rms {rms_text(v_px)} px")


def test_of_film_both_kinds_of_marks_are_shown_in_the_camera_frame(film: Adjustment) -> None:
    axes = film.plot_residuals()
    kinds = vectors(axes)
    assert [len(each.U) for each in kinds] == [160, 20]
    assert np.abs(kinds[1].XY).max() == pytest.approx(113.0, abs=2.0)
    v_um = np.concatenate([np.column_stack([each.U, each.V]) for each in kinds])
    assert axes.get_title(loc="left").endswith(f"rms {rms_text(v_um)} µm")
    assert axes.get_xlabel() == "x' (mm)"


def test_a_camera_without_observations_has_no_residuals(film: Adjustment) -> None:
    plots, none = film.plots(), np.zeros((0, 2))
    axes = replace(plots, places_mm=none, vectors_mm=none, is_fiducial=plots.is_fiducial[:0]).plot_residuals()
    assert axes.get_title(loc="left") == "K: no residuals"


def test_the_distortion_is_the_polynomial_of_the_parameters(film: Adjustment) -> None:
    axes = film.plot_distortion()
    radius, um = np.array(axes.lines[0].get_data())
    k3, k5 = (film.value(Parameter.interior("K", name)) for name in ("k3", "k5"))
    np.testing.assert_allclose(um, 1e3 * (k3 * radius**3 + k5 * radius**5), atol=0.05)
    assert axes.get_legend_handles_labels()[1][-1] == "no targets"


def test_the_map_of_uncertainty_is_in_pixels_for_a_digital_camera(board: Adjustment) -> None:
    axes = board.plots(pixel_mm=PIXEL_MM).plot_uncertainty(350.0)
    assert axes.get_title(loc="left") == "desk: projected points at a distance of 350"
    sigma_px = board.projection_uncertainty(distance=350.0).sigma_mm / PIXEL_MM
    assert axes.collections[0].get_clim()[0] >= sigma_px.min()
    assert axes.collections[0].get_clim()[1] <= sigma_px.max()


def test_coverage_counts_targets_alone(film: Adjustment) -> None:
    axes = film.plot_coverage()
    assert axes.get_title(loc="left").startswith("K: 160 targets in 4 images")
    assert np.ma.sum(np.ma.asarray(axes.collections[0].get_array())) == 160


def test_plots_go_into_axes_that_are_given(board: Adjustment) -> None:
    axes = mpl.figure.Figure().subplots()
    assert board.plot_coverage(axes=axes) is axes


@pytest.mark.parametrize(
    ("values", "levels"),
    [
        ([0.012, 3.0], [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0]),
        ([0.06, 0.4], [0.07, 0.1, 0.15, 0.2, 0.3]),
        ([1.02, 1.49], [1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.35, 1.4, 1.45]),
    ],
)
def test_contours_have_round_levels(values: list[float], levels: list[float]) -> None:
    assert contour_levels(np.array([*values, np.nan])) == levels


def test_a_camera_of_which_nothing_was_estimated_has_no_contours_and_a_distance_no_exponent() -> None:
    with pytest.raises(AdjustmentError, match="nothing was estimated"):
        contour_levels(np.zeros((3, 3)))
    assert [distance_text(each) for each in (1500.0, 0.3456789, 12345.6)] == ["1500", "0.3457", "12350"]


@pytest.mark.parametrize(
    ("missing", "method", "words"),
    [
        *(
            ("matplotlib.pyplot", f"plot_{kind}", r'"reseau\[plots\]"\.')
            for kind in ("residuals", "distortion", "uncertainty", "coverage")
        ),
        ("pandas", "to_pandas", "pandas"),
    ],
)
def test_install(board: Adjustment, missing: str, method: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=f"Install: pip install {words}"):
        getattr(board, method)()


def test_tables_have_every_quantity_and_every_observation(board: Adjustment) -> None:
    pytest.importorskip("pandas", reason="pandas is missing: make test installs it")
    parameters = board.to_pandas()
    row = parameters[(parameters.kind == "interior") & (parameters.quantity == "c")].iloc[0]
    assert row.value == board.value("IO.desk.c")
    assert row.sigma == pytest.approx(board.sigma("IO.desk.c"))
    residuals = board.to_pandas("residuals")
    assert len(residuals) == len(board.network.observations)
    np.testing.assert_allclose(residuals[["vx_um", "vy_um"]], 1e3 * board.residuals.v_mm)
