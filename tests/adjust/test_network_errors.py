"""Bad input, one thing at a time: each is told with the name of the culprit and what to do."""

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
from simulated import Truth, simulated, with_errors

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Exterior, Image, Network, ObjectPoint
from adjust.solution.adjustment import Datum, Options, adjust

Change = Callable[[Network], Network]


def rows(network: Network, keep: list[int]) -> Network:
    """The network with some of its observations; a row may be repeated."""
    return replace(network, observations=network.observations.only(np.array(keep, dtype=np.intp)))


def drop_observations(network: Network, image: str, kind: str, left: int) -> Network:
    """All but some marks of a kind in an image."""
    observations = network.observations
    places = [i for i in range(len(observations)) if (observations.image[i], observations.kind[i]) == (image, kind)]
    return rows(network, [i for i in range(len(observations)) if i not in places[left:]])


def drop_fiducial(network: Network) -> Network:
    camera = network.cameras[0]
    marks = {id_: mark for id_, mark in camera.fiducials.items() if id_ != "3"}
    return replace(network, cameras=(replace(camera, fiducials=marks),))


def strange_parameter(network: Network) -> Network:
    distortion = Distortion("torlegard", {"k9": Prior(1.0)})
    return replace(network, cameras=(replace(network.cameras[0], distortion=distortion),))


def bad_covariance(network: Network) -> Network:
    covariance = network.observations.covariance_mm2.copy()
    covariance[8] = [[1e-6, 2e-6], [2e-6, 1e-6]]
    return replace(network, observations=replace(network.observations, covariance_mm2=covariance))


GALLERY: dict[str, tuple[Change, list[str]]] = {
    "no images": (lambda n: replace(n, images=()), ["nothing to adjust", "no image"]),
    "no observations": (lambda n: rows(n, []), ["nothing to adjust", "statuses"]),
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
    "observed twice": (lambda n: rows(n, [*range(len(n.observations)), 7]), ["point 2", "2 times", "image f0"]),
    "covariance": (bad_covariance, ["target 3", "image f0", "not positive definite"]),
    "nan": (lambda n: with_errors(n, {9: np.array([0.0, np.nan])}), ["target 4", "image f0", "not a finite number"]),
    "two targets": (lambda n: drop_observations(n, "f1", "target", 2), ["image f1", "2 object points", "needs 3"]),
    "two fiducials": (
        lambda n: drop_observations(n, "f3", "fiducial", 2),
        ["image f3", "2 fiducial", "affine", "needs 3"],
    ),
    "two of four": (
        lambda n: drop_observations(
            replace(n, images=tuple(replace(each, transformation="projective") for each in n.images)),
            "f3",
            "fiducial",
            2,
        ),
        ["image f3", "2 fiducial", "projective transformation needs 3", "4 where its targets tell nothing of it"],
    ),
    "no fiducials": (lambda n: drop_observations(n, "f3", "fiducial", 0), ["image f3", "0 fiducial", "needs 3"]),
    "parameter": (strange_parameter, ["camera K", "torlegard", "k9", "k3, k5"]),
    "rows do not go together": (
        lambda n: replace(n, observations=replace(n.observations, point=n.observations.point[:-1])),
        ["do not go together"],
    ),
}


@pytest.mark.parametrize("name", list(GALLERY))
def test_gallery(name: str) -> None:
    change, words = GALLERY[name]
    network, start = simulated(np.random.default_rng(1))
    with pytest.raises(AdjustmentError) as caught:
        adjust(change(network), start)
    for word in words:
        assert word in str(caught.value)


def test_a_negative_principal_distance() -> None:
    network, start = simulated(np.random.default_rng(1))
    camera = replace(network.cameras[0], principal_distance_mm=Prior(-153.0, 1.0))
    with pytest.raises(AdjustmentError, match=r"camera K: the principal distance must be positive"):
        adjust(replace(network, cameras=(camera,)), start)


def test_an_image_turned_away() -> None:
    """The station below the field: every point is behind the camera."""
    network, start = simulated(np.random.default_rng(1))
    below = dict(start.exterior) | {"f2": start.exterior["f2"] * np.array([1, 1, -1, 1, 1, 1])}
    with pytest.raises(AdjustmentError, match=r"point 0 lies behind the camera in image f2"):
        adjust(network, replace(start, exterior=below))


def test_a_missing_approximation() -> None:
    network, start = simulated(np.random.default_rng(1))
    with pytest.raises(AdjustmentError, match=r"X0 of image f1 has neither a value nor an approximation"):
        adjust(network, replace(start, exterior={k: v for k, v in start.exterior.items() if k != "f1"}))
    with pytest.raises(AdjustmentError, match=r"image f1: .*affine has 6 parameters .*but 4"):
        adjust(network, replace(start, transformation=dict(start.transformation) | {"f1": np.zeros(4)}))


@pytest.mark.study
def test_unknown_point_without_approximation() -> None:
    network, start = simulated(np.random.default_rng(1))
    points = (ObjectPoint("0", None, None, Prior(3.0, 0.1)), *network.points[1:])
    with pytest.raises(AdjustmentError, match=r"X of point 0 has neither"):
        adjust(replace(network, points=points), replace(start, points={}))


def test_an_image_with_two_targets_and_a_known_orientation_is_adjusted() -> None:
    truth = Truth()
    network, start = simulated(np.random.default_rng(1), truth)
    known = Exterior(np.array([*truth.stations[1], *truth.attitudes[1]]), np.full(6, 0.01))
    images = tuple(replace(image, exterior=known) if image.name == "f1" else image for image in network.images)
    result = adjust(drop_observations(replace(network, images=images), "f1", "target", 2), start)
    assert result.converged


@pytest.mark.study
def test_wrong_point_numbers_diverge_or_show() -> None:
    """Two images whose points are numbered the other way round never end as if all were well."""
    network, start = simulated(np.random.default_rng(1))
    observations = network.observations
    swapped = tuple(
        str(11 - int(point)) if kind == "target" and image in ("f1", "f2") else point
        for image, point, kind in zip(observations.image, observations.point, observations.kind, strict=True)
    )
    result = adjust(replace(network, observations=replace(observations, point=swapped)), start)
    assert result.termination in ("diverged", "iteration limit", "converged")
    assert not result.converged or result.sigma0 > 100.0


def test_bad_options_are_refused() -> None:
    with pytest.raises(ValueError, match=r"datum must be one of control, minimal, free"):
        Options(datum=cast(Datum, "fixed"))
    with pytest.raises(ValueError, match="iteration limit must be at least 1"):
        Options(iteration_limit=0)


def test_bad_values_are_refused_when_they_are_made() -> None:
    with pytest.raises(ValueError, match="finite number"):
        Prior(np.nan)
    with pytest.raises(ValueError, match=r"0 \(fixed\), positive or inf"):
        Prior(1.0, -1.0)
    with pytest.raises(ValueError, match="six elements"):
        Exterior(np.zeros(5))
    with pytest.raises(ValueError, match=r"0 \(fixed\), positive or inf"):
        Exterior(np.zeros(6), np.array([1.0, 1.0, 1.0, 1.0, 1.0, np.nan]))
    with pytest.raises(ValueError, match="one of none, torlegard"):
        Distortion("fisheye")
    with pytest.raises(ValueError, match="r0 must be"):
        Distortion("torlegard", r0_mm=-80.0)


def test_a_single_resection() -> None:
    """One image, everything but its orientation fixed: the smallest network there is."""
    truth = Truth(distortion={})
    network, start = simulated(np.random.default_rng(2), truth, "none")
    camera = Camera("K", Prior(truth.c), Prior(truth.x0), Prior(truth.y0))
    observations = network.observations
    one = rows(replace(network, cameras=(camera,)), [i for i, name in enumerate(observations.image) if name == "f1"])
    result = adjust(replace(one, images=(Image("f1", "K", "none"),)), start)
    assert result.converged
    assert (result.conditions, result.unknowns) == (24, 6)
    assert result.value("EO.f1.Z0") == pytest.approx(truth.stations[1][2], abs=5 * result.sigma("EO.f1.Z0"))


def test_approximations_of_other_things_do_no_harm() -> None:
    network, start = simulated(np.random.default_rng(1))
    more = Approximations(
        dict(start.interior) | {"other": np.zeros(3)},
        dict(start.exterior) | {"other": np.zeros(6)},
        dict(start.transformation) | {"other": np.zeros(6)},
        dict(start.points) | {"other": np.zeros(3)},
    )
    assert adjust(network, more).vpv == adjust(network, start).vpv
